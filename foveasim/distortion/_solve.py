"""Vectorised inverses of increasing functions and roots of polynomials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from foveasim._core.validation import Floats

#: Maximum number of bracketed Newton steps; bisection alone needs 60.
MAX_STEPS = 100
#: Largest ratio of imaginary and absolute value of a real root; roots above 1 / MIN_RECIPROCAL are ignored.
IMAGINARY_TOLERANCE, MIN_RECIPROCAL = 1e-9, 1e-12


def invert_monotonic(
    function: Callable[[Floats], Floats], slope: Callable[[Floats], Floats], values: Floats, upper: float
) -> Floats:
    """
    Invert an increasing function with f(0) = 0 for values up to f(``upper``).

    Newton's method, with bisection for steps that leave the bracket.
    """
    low, high = np.zeros_like(values), np.full_like(values, upper)
    x = np.minimum(values / max(float(slope(np.zeros(1))[0]), 1e-300), 0.5 * upper)
    for _ in range(MAX_STEPS):
        excess = function(x) - values
        low, high = np.where(excess <= 0.0, x, low), np.where(excess >= 0.0, x, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = x - excess / slope(x)
        new = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        new = np.where(excess == 0.0, x, new)
        if np.all(np.abs(new - x) <= 2.0 * np.spacing(np.maximum(x, 1e-300))):
            return new
        x = new
    return x


def smallest_roots(coefficients: Any) -> Floats:
    """
    Return the smallest positive root of each polynomial, infinite where there is none.

    Coefficients are (n, degree + 1), lowest power first.
    """
    table = np.atleast_2d(np.asarray(coefficients, dtype=np.float64))
    roots = np.full(table.shape[0], np.inf)
    # The reversed polynomial has the reciprocal roots and no leading 0, because the constant term is not 0.
    degree = table.shape[1] - 1
    if degree == 0:
        return roots
    companion = np.zeros((table.shape[0], degree, degree))
    companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[:, 0, :] = -table[:, 1:] / table[:, :1]
    reciprocal = np.linalg.eigvals(companion)
    is_real = (np.abs(reciprocal.imag) <= IMAGINARY_TOLERANCE * np.abs(reciprocal)) & (reciprocal.real > MIN_RECIPROCAL)
    largest = np.where(is_real, reciprocal.real, 0.0).max(axis=1)
    return np.divide(1.0, largest, out=roots, where=largest > 0.0)
