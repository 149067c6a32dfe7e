"""Estimates with intervals of 95 % confidence."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["CONFIDENCE", "HALF_WIDTH", "Estimate", "Uncertain", "of_fraction", "of_mean", "of_squares", "of_variance"]

#: Probability that an interval contains the parameter.
CONFIDENCE = 0.95
TAIL = 0.5 * (1.0 - CONFIDENCE)
#: Half an interval of a Gaussian estimate, in standard errors.
HALF_WIDTH = 1.959963984540054


class Estimate(NamedTuple):
    """Value, and limits of its interval of 95 % confidence."""

    value: float
    low: float
    high: float


class Uncertain(NamedTuple):
    """Why the frames do not determine a parameter."""

    reason: str


def _quantile(n_blocks: int | None) -> float:
    """Return the two-sided quantile of Student's distribution; None for the normal one."""
    from scipy.special import stdtrit

    return HALF_WIDTH if n_blocks is None else float(stdtrit(max(n_blocks - 1, 1), 1.0 - TAIL))


def of_mean(value: float, error: float, n_blocks: int | None = None, *, is_log: bool = False) -> Estimate:
    """
    Return the interval of a Gaussian estimate.

    ``error`` is that of the logarithm with ``is_log``.
    """
    half = _quantile(n_blocks) * error
    if is_log:
        return Estimate(value, value * math.exp(-half), value * math.exp(half))
    return Estimate(value, value - half, value + half)


def of_variance(variance: float, error: float, n_blocks: int | None = None) -> Estimate:
    """
    Return a standard deviation and its interval.

    It begins at 0 where that of the variance contains 0.
    """
    half = _quantile(n_blocks) * error
    return Estimate(*(math.sqrt(max(each, 0.0)) for each in (variance, variance - half, variance + half)))


def of_squares(square: float, degrees: int, other: float, n: int) -> Estimate:
    """
    Return the standard deviation of lines of n pixels by their mean square.

    It is ``n`` times the variance of lines plus ``other``.

    Mean squares of Gaussian values have chi-square distributions; that of pixels has so many degrees that it is known.
    """
    from scipy.special import chdtri

    low = square * degrees / float(chdtri(degrees, TAIL))
    # A mean square below that of pixels is one of no lines at least: the upper limit is not 0.
    high = max(square, other) * degrees / float(chdtri(degrees, 1.0 - TAIL))
    return Estimate(*(math.sqrt(max((each - other) / n, 0.0)) for each in (square, low, high)))


def of_fraction(count: int, n: int) -> Estimate:
    """Return a fraction and its interval of Clopper and Pearson, Biometrika 26, 404 (1934)."""
    from scipy.special import betaincinv

    low = 0.0 if count == 0 else float(betaincinv(count, n - count + 1, TAIL))
    high = 1.0 if count == n else float(betaincinv(count + 1, n - count, 1.0 - TAIL))
    return Estimate(count / n, low, high)
