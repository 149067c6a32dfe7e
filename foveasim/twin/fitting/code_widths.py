"""
Differential nonlinearity (DNL) of the ADC from the frequencies of codes.

Where noise covers several codes, the number of samples of a code is proportional to its width, times a smooth density (code
density test, IEEE 1241). With the counts N of a column over a Gaussian density S, the third differences of N / S contain no
smooth errors of the density. Their mean square, less that of Poisson numbers, is the variance of widths, which follows from the
standard deviation of the offsets of codes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.special import ndtr

from foveasim._core.validation import Floats, Ints
from foveasim.twin.fitting.intervals import Estimate, Uncertain, of_mean

__all__ = ["fit_code_widths"]

#: Third differences, and standard deviations of codes within which a column is compared with its density.
DIFFERENCES, MAX_SIGMAS = np.array([1.0, -3.0, 3.0, -1.0]), 1.5
#: Smallest standard deviation of the codes of a column, number of samples of a code, and number of columns.
MIN_SIGMA_DN, MIN_COUNT, MIN_COLUMNS = 3.0, 25, 8
#: Quartiles of a Gaussian number, in standard deviations.
QUARTILE = 0.6744897501960817
#: Standard deviations of offsets that are tabulated, DN, and nodes of their distribution. Mean squares hardly grow above.
OFFSETS_DN, NODES = np.linspace(0.0, 1.0, 101), np.linspace(-6.0, 6.0, 1201)


def fit_code_widths(histograms: Sequence[Ints]) -> Estimate | Uncertain:
    """
    Return the standard deviation of the offsets of codes, DN.

    ``histograms``: (n_column, n_codes) of each stack whose codes are not clipped.
    """
    n_columns = len(histograms[0])
    squares, weights = np.zeros(n_columns), np.zeros(n_columns)
    for counts in histograms:
        for j, column in enumerate(counts):
            differences = _third_differences(column)
            if differences is None:
                continue
            excess, share = differences
            squares[j] += share @ excess
            weights[j] += share.sum()
    used = weights > 0.0
    if np.count_nonzero(used) < MIN_COLUMNS:
        return Uncertain(
            f"it needs {MIN_COUNT} samples of each code in {MIN_COLUMNS} columns, and noise over {MIN_SIGMA_DN:g} codes: more "
            "frames, or more levels of light"
        )
    values, shares = squares[used] / weights[used], weights[used] / weights[used].sum()
    mean = float(shares @ values)
    n = values.size
    error = math.sqrt(float((shares**2) @ (values - mean) ** 2) * n / (n - 1))
    found = Estimate(*(float(np.interp(each, _mean_squares(), OFFSETS_DN)) for each in of_mean(mean, error, n)))
    if found.high == OFFSETS_DN[-1]:
        return Uncertain(f"codes are in no order: it is above {found.low:.2g} DN")
    return found


def _third_differences(counts: Ints) -> tuple[Floats, Floats] | None:
    """
    Return squares of third differences of the counts of a column, and their weights.

    The counts are relative to their density, and the squares without Poisson noise. None without enough counts.
    """
    total = int(counts.sum())
    if total < MIN_COUNT:
        return None
    cumulative = np.cumsum(counts) / total
    low, middle, high = np.interp((0.25, 0.5, 0.75), cumulative, np.arange(counts.size) + 0.5)
    sigma = (high - low) / (2.0 * QUARTILE)
    first, last = math.ceil(middle - MAX_SIGMAS * sigma), math.floor(middle + MAX_SIGMAS * sigma)
    if sigma < MIN_SIGMA_DN or first < 1 or last > counts.size - 2:
        return None
    edges = (np.arange(first, last + 2) - 0.5 - middle) / sigma
    density = total * np.diff(ndtr(edges))
    if density.min() < MIN_COUNT:
        return None
    relative = counts[first : last + 1] / density
    noise = np.convolve(relative / density, DIFFERENCES**2, "valid")
    weights = 1.0 / np.convolve(1.0 / density, DIFFERENCES**2, "valid") ** 2
    return np.convolve(relative, DIFFERENCES, "valid") ** 2 - noise, weights


@cache
def _mean_squares() -> Floats:
    """
    Return the mean squares of third differences of code widths for ``OFFSETS_DN``.

    An offset d moves the fraction 1 - f of the samples of a code by m codes and the fraction f by m + 1 codes, with the whole
    part m and the fraction f of d. Fractions of different codes are independent.
    """
    weights = np.exp(-0.5 * NODES**2)
    weights /= weights.sum()
    reach = math.ceil(NODES[-1] * OFFSETS_DN[-1]) + 2
    between = np.correlate(DIFFERENCES, DIFFERENCES, "full")
    found = np.empty(OFFSETS_DN.size)
    rows = np.arange(NODES.size)
    for k, sigma in enumerate(OFFSETS_DN):
        offset = sigma * NODES
        whole = np.floor(offset).astype(int)
        moved = np.zeros((NODES.size, 2 * reach + 1))
        moved[rows, whole + reach] = 1.0 - (offset - whole)
        moved[rows, whole + reach + 1] = offset - whole
        off = moved - weights @ moved
        covariance = (off * weights[:, None]).T @ off
        found[k] = sum(factor * np.trace(covariance, lag) for factor, lag in zip(between, range(-3, 4), strict=True))
    return found
