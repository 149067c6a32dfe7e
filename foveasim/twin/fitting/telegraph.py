"""
Random telegraph (RTS) noise from the variances of pixels over dark frames.

The sum of squares of n Gaussian codes about their mean, over their variance V, has the chi-square distribution of n - 1 degrees
of freedom. A pixel with two equally probable states, a apart, is in the upper one in k of n frames with the binomial
probability, and its sum has the noncentral chi-square distribution of noncentrality a² k (n - k) / (n V). The variances of all
pixels are a mixture, whose likelihood is maximised.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from foveasim._core.validation import Floats

__all__ = ["TelegraphFit", "fit_telegraph"]

#: Twice the logarithm of the likelihood ratio above which a mixture is better than one distribution: three parameters more than
#: the quantile of 1e-4 of chi-square with two degrees of freedom.
MIN_RATIO = 18.4
#: Number of bins of the variances.
N_BINS = 400
#: Variances at which the probabilities of RTS noise are computed; others are between them, within 1e-4.
N_PROBABILITIES = 4096
#: First amplitudes of the search, in standard deviations of the noise, and first fractions.
AMPLITUDES, FRACTIONS = (3.0, 6.0, 12.0, 25.0, 60.0), (0.003, 0.03, 0.2)
#: Step of numerical derivatives of logarithms.
STEP = 2e-3
#: Smallest number of frames, and of pixels with RTS noise for an interval.
MIN_FRAMES, MIN_PIXELS = 4, 5


@dataclass(frozen=True, eq=False)
class TelegraphFit:
    """
    Mixture of pixels with and without RTS noise.

    ``noise_dn2``: variance without RTS noise, and its standard error. ``fraction`` and ``step_dn``, with standard errors of
    their logarithms (``fraction`` as odds). ``probability`` (n_pixel,): that a pixel has RTS noise.
    """

    noise_dn2: float
    noise_error_dn2: float
    fraction: float
    step_dn: float
    log_odds_error: float
    log_step_error: float
    probability: Floats


def fit_telegraph(variance_dn2: Floats, n_frames: int) -> TelegraphFit | None:
    """
    Fit the mixture to variances of pixels; None where one distribution explains them.

    ``variance_dn2`` (n_pixel,). ``n_frames``: frames of each variance; at least ``MIN_FRAMES``.
    """
    from scipy import optimize

    values = variance_dn2[variance_dn2 > 0.0]
    if n_frames < MIN_FRAMES or values.size < 100:
        return None
    typical = float(np.median(values)) / _median_ratio(n_frames)
    edges = np.concatenate(([0.0], np.geomspace(values.min() * 0.999, values.max() * 1.001, N_BINS)))
    counts = np.histogram(values, edges)[0].astype(np.float64)
    is_used = counts > 0.0

    def log_masses(vector: Floats) -> Floats:
        return np.log(np.maximum(_masses(edges, n_frames, *_unpack(vector))[is_used], 1e-300))

    def negative(vector: Floats) -> float:
        return -float(counts[is_used] @ log_masses(vector))

    single = optimize.minimize_scalar(
        lambda log: (
            -float(counts[is_used] @ np.log(np.maximum(_single(edges, n_frames, math.exp(log))[is_used], 1e-300)))
        ),
        bounds=(math.log(typical) - 1.0, math.log(max(values.mean(), typical)) + 0.5),
        method="bounded",
        options={"xatol": 1e-6},
    )
    starts = [
        np.array([math.log(typical), math.log(f / (1.0 - f)), math.log(a) + 0.5 * math.log(typical)])
        for a in AMPLITUDES
        for f in FRACTIONS
    ]
    best = min(starts, key=negative)
    found = optimize.minimize(
        negative, best, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-4, "maxiter": 600}
    )
    noise, fraction, step = _unpack(found.x)
    if 2.0 * (single.fun - found.fun) < MIN_RATIO or fraction * values.size < MIN_PIXELS or fraction > 0.6:
        return None
    # Pixels are not exactly of the mixture, such as those of companded codes: errors by the scores of pixels ("sandwich").
    inverse = np.linalg.pinv(_hessian(negative, found.x))
    scores = np.stack([log_masses(found.x + each) - log_masses(found.x - each) for each in STEP * np.eye(3)]) / (
        2.0 * STEP
    )
    covariance = inverse @ (counts[is_used] * scores) @ scores.T @ inverse
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    grid = np.geomspace(values.min(), values.max(), N_PROBABILITIES)
    with_rts = fraction * _density(grid, n_frames, noise, step)
    without = (1.0 - fraction) * _density(grid, n_frames, noise, 0.0)
    probability = np.interp(variance_dn2, grid, with_rts / np.maximum(with_rts + without, 1e-300), left=0.0)
    return TelegraphFit(noise, noise * errors[0], fraction, step, errors[1], errors[2], probability)


def _unpack(vector: Floats) -> tuple[float, float, float]:
    return math.exp(vector[0]), 1.0 / (1.0 + math.exp(-vector[1])), math.exp(vector[2])


def _median_ratio(n_frames: int) -> float:
    from scipy.special import chdtri

    return float(chdtri(n_frames - 1, 0.5)) / (n_frames - 1)


def _single(edges: Floats, n_frames: int, noise: float) -> Floats:
    """Return the probabilities of bins without RTS noise."""
    from scipy.special import chdtr

    return np.diff(chdtr(n_frames - 1, edges * (n_frames - 1) / noise))


def _states(n_frames: int, ratio: float) -> tuple[Floats, Floats]:
    """Return probabilities and noncentralities of the numbers of frames in the upper state."""
    from scipy.stats import binom

    k = np.arange(n_frames + 1)
    return np.asarray(binom.pmf(k, n_frames, 0.5)), ratio**2 * k * (n_frames - k) / n_frames


def _masses(edges: Floats, n_frames: int, noise: float, fraction: float, step: float) -> Floats:
    """Return the probabilities of bins of the mixture."""
    from scipy.special import chndtr

    shares, off = _states(n_frames, step / math.sqrt(noise))
    half = (n_frames + 2) // 2  # k and n - k have the same distribution
    x = edges * (n_frames - 1) / noise
    total = np.zeros(edges.size)
    for k in range(half):
        share = shares[k] * (2.0 if k != n_frames - k else 1.0)
        total += share * chndtr(x, n_frames - 1, max(off[k], 1e-9))
    return (1.0 - fraction) * _single(edges, n_frames, noise) + fraction * np.maximum(np.diff(total), 0.0)


def _density(values: Floats, n_frames: int, noise: float, step: float) -> Floats:
    """Return the density of variances, up to a common factor."""
    from scipy.stats import chi2, ncx2

    x = values * (n_frames - 1) / noise
    if step == 0.0:
        return np.asarray(chi2.pdf(x, n_frames - 1))
    shares, off = _states(n_frames, step / math.sqrt(noise))
    return np.asarray(sum(s * ncx2.pdf(x, n_frames - 1, max(o, 1e-9)) for s, o in zip(shares, off, strict=True)))


def _hessian(function: object, at: Floats) -> Floats:
    """Return second derivatives by central differences."""
    n, step = at.size, STEP
    found = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            total = 0.0
            for a in (1, -1):
                for b in (1, -1):
                    moved = at.copy()
                    moved[i] += a * step
                    moved[j] += b * step
                    total += a * b * function(moved)  # type: ignore[operator]
            found[i, j] = total / (4.0 * step * step)
    return 0.5 * (found + found.T)
