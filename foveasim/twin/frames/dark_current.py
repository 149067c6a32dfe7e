"""
Log-normal dark current of pixels, from slopes of dark frames over the exposure time.

A slope is the dark current of a pixel plus noise, whose variance grows with the current by shot noise. The likelihood of all
slopes is maximised over the mean and the relative spread of the currents.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Floats

__all__ = ["DarkSpread", "fit_dark_spread"]

#: Nodes of the distribution of currents, in standard deviations of the logarithm, and number of bins of slopes.
NODES = np.linspace(-5.0, 5.0, 401)
N_BINS = 300
#: Step of second derivatives, and smallest spread in units of its error.
STEP, MIN_SIGMAS = 0.02, 3.0
#: Largest logarithms of mean and spread in a search.
LARGEST = np.array([30.0, 3.0])


class DarkSpread(NamedTuple):
    """Mean, and standard deviation over mean, with the standard error of its logarithm."""

    mean: float
    fraction: float
    log_error: float


def fit_dark_spread(slopes: Floats, noise: Floats) -> DarkSpread | None:
    """
    Fit the distribution of dark currents; None if the noise hides their spread.

    ``slopes`` (n_pixel,), in any unit, and variances of their ``noise``, in its square.
    """
    from scipy import optimize
    from scipy.special import ndtr

    mean, variance = float(slopes.mean()), float(slopes.var() - noise.mean())
    if variance <= 0.0 or mean < MIN_SIGMAS * math.sqrt(float(noise.mean()) / slopes.size):
        return None
    rise = np.cov(slopes, noise)[0, 1] / float(slopes.var())
    rise = min(max(float(rise), 0.0), float(noise.mean()) / mean)
    floor = float(noise.mean()) - rise * mean
    edges = np.linspace(slopes.min(), slopes.max(), N_BINS + 1)
    counts = np.histogram(slopes, edges)[0]
    is_used = counts > 0
    inner = edges[1:-1]
    weights = np.exp(-0.5 * NODES**2)
    weights /= weights.sum()

    def negative(vector: Floats) -> float:
        centre, fraction = np.exp(np.clip(vector, -30.0, LARGEST))
        sigma = math.sqrt(math.log1p(fraction**2))
        current = centre * np.exp(sigma * NODES - 0.5 * sigma**2)
        width = np.sqrt(max(floor, 1e-12 * mean**2) + rise * current)
        below = weights @ ndtr((inner - current[:, None]) / width[:, None])
        masses = np.diff(np.concatenate(([0.0], below, [1.0])))
        return -float(counts[is_used] @ np.log(np.maximum(masses[is_used], 1e-300)))

    start = np.array([math.log(mean), 0.5 * math.log(variance) - math.log(mean)])
    found = optimize.minimize(negative, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-3})
    curvature = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            total = 0.0
            for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
                moved = found.x.copy()
                moved[i] += a * STEP
                moved[j] += b * STEP
                total += a * b * negative(moved)
            curvature[i, j] = total / (4.0 * STEP**2)
    error = math.sqrt(max(float(np.linalg.pinv(curvature)[1, 1]), 0.0))
    if error <= 0.0 or error > 1.0 / MIN_SIGMAS:
        return None
    return DarkSpread(math.exp(found.x[0]), math.exp(found.x[1]), error)
