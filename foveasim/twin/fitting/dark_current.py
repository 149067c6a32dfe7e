"""
Log-normal dark current of pixels, from slopes of dark frames over the exposure time.

A slope is the dark current of a pixel plus noise, whose variance grows with the current by shot noise. The likelihood of all
slopes is maximised over the mean and the relative spread of the currents; the interval of the spread contains the values whose
profile likelihood is large enough (Wilks, Ann. Math. Stat. 9, 60, 1938).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Floats
from foveasim.twin.fitting.intervals import HALF_WIDTH

__all__ = ["DarkSpread", "fit_dark_spread"]

#: Nodes of the distribution of currents, in standard deviations of the logarithm, and number of bins of slopes.
NODES = np.linspace(-5.0, 5.0, 401)
N_BINS = 300
#: Logarithms of the smallest and the largest spread.
SMALLEST, LARGEST = math.log(1e-3), math.log(10.0)
#: Standard errors of the mean below which there is no current, relative step of its derivative.
MIN_SIGMAS, STEP = 3.0, 0.02


class DarkSpread(NamedTuple):
    """Mean, and standard deviation over mean, with the limits of its interval of 95 %."""

    mean: float
    fraction: float
    low: float
    high: float

    @property
    def relative_error(self) -> float:
        """Standard error of the fraction over the fraction, at most 1."""
        return min((self.high - self.low) / (2.0 * HALF_WIDTH * self.fraction), 1.0) if self.fraction else 0.0


def fit_dark_spread(slopes: Floats, noise: Floats) -> DarkSpread | None:
    """
    Fit the distribution of dark currents.

    ``slopes`` (n_pixel,), in any unit, and variances of their ``noise``, in its square. None if there is no current, or no
    limit to its spread.
    """
    from scipy import optimize
    from scipy.special import ndtr

    mean, variance = float(slopes.mean()), float(slopes.var())
    if mean < MIN_SIGMAS * math.sqrt(variance / slopes.size):
        return None
    covariance = float((slopes - mean) @ noise) / (slopes.size - 1)
    rise = covariance / variance if variance > 0.0 else 0.0
    rise = min(max(rise, 0.0), float(noise.mean()) / mean)
    floor = float(noise.mean()) - rise * mean
    edges = np.linspace(slopes.min(), slopes.max(), N_BINS + 1)
    counts = np.histogram(slopes, edges)[0]
    is_used = counts > 0
    inner = edges[1:-1]
    weights = np.exp(-0.5 * NODES**2)
    weights /= weights.sum()

    def negative(log_mean: float, log_fraction: float) -> float:
        sigma = math.sqrt(math.log1p(math.exp(2.0 * log_fraction)))
        current = math.exp(log_mean) * np.exp(sigma * NODES - 0.5 * sigma**2)
        width = np.sqrt(max(floor, 1e-12 * mean**2) + rise * current)
        below = weights @ ndtr((inner - current[:, None]) / width[:, None])
        masses = np.diff(np.concatenate(([0.0], below, [1.0])))
        return -float(counts[is_used] @ np.log(np.maximum(masses[is_used], 1e-300)))

    def profile(log_fraction: float) -> tuple[float, float]:
        """Return the smallest value over means, and that mean."""
        found = optimize.minimize_scalar(
            lambda log_mean: negative(log_mean, log_fraction),
            bracket=(math.log(mean), math.log(mean) + STEP),
            method="brent",
            options={"xtol": 1e-6},
        )
        return float(found.fun), float(found.x)

    best = optimize.minimize_scalar(
        lambda log_fraction: profile(log_fraction)[0], bounds=(SMALLEST, LARGEST), method="bounded",
        options={"xatol": 1e-3},
    )  # fmt: skip
    log_fraction, least = float(best.x), float(best.fun)

    def above(log_fraction: float) -> float:
        return profile(log_fraction)[0] - least - 0.5 * HALF_WIDTH**2

    if above(LARGEST) < 0.0:
        return None
    high = math.exp(optimize.brentq(above, log_fraction, LARGEST, xtol=1e-3))
    low = math.exp(optimize.brentq(above, SMALLEST, log_fraction, xtol=1e-3)) if above(SMALLEST) > 0.0 else 0.0
    fraction = math.exp(log_fraction) if log_fraction > SMALLEST + 1e-2 else 0.0
    return DarkSpread(math.exp(profile(log_fraction)[1]), fraction, low, high)
