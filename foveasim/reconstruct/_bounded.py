"""
Least squares under x >= 0, by conjugate gradients that know the bound.

MPRGP, modified proportioning with reduced gradient projections, preconditioned in the face (Dostál 2009, Optimal Quadratic
Programming Algorithms, sections 5.7 and 5.10): conjugate gradients among the unknowns that are above 0, a projected step of
fixed length where one would fall below, and a step that frees unknowns at 0 when their part of the gradient prevails. It
converges to the one minimum from anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from foveasim._core.validation import Floats
from foveasim.errors import SimulationError

__all__ = ["least_nonnegative"]

Operator = Callable[[Floats], Floats]


def least_nonnegative(
    matrix: Operator,
    bound: Floats,
    precondition: Operator,
    right: Floats,
    start: Floats,
    *,
    enough: float,
    max_steps: int,
) -> tuple[Floats, int]:
    """
    The x >= 0 that minimises ``x·A x / 2 - b·x``.

    Parameters
    ----------
    matrix : callable
        A, symmetric and positive semi-definite: from x to A x, (n,).
    bound : (n,) float64
        A diagonal matrix that is nowhere below A, so that ``x·A x <= x·D x``.
    precondition : callable
        About the inverse of A, symmetric and positive definite.
    right, start : (n,) float64
        b, and where to begin.
    enough : float
        The end is where the root of ``g·M g``, with the projected gradient g and the preconditioner M (of unknowns at 0,
        the bound's inverse), is below this: about the distance from the minimum in the norm of A.
    max_steps : int

    Returns
    -------
    x : (n,) float64
    n_steps : int
        Times that A was applied.

    Raises
    ------
    SimulationError
        When the steps do not suffice.
    """
    x = np.maximum(start, 0.0)
    gradient = matrix(x) - right
    n_steps = 1
    direction: Floats | None = None
    image, curvature = gradient, 1.0
    while True:
        is_free = x > 0.0
        free = np.where(is_free, gradient, 0.0)
        chopped = np.where(is_free, 0.0, np.minimum(gradient, 0.0))
        steep = np.where(is_free, precondition(free), 0.0)
        free2, chopped2 = _dot(free, steep), _dot(chopped, chopped / bound)
        if math.sqrt(free2 + chopped2) <= enough:
            return x, n_steps
        if n_steps >= max_steps:
            raise SimulationError(
                f"the picture did not converge in {max_steps} steps; give a larger 'tolerance' or 'mu', or more 'max_steps'"
            )
        if chopped2 > _dot(np.minimum(x, free / bound), free):
            down = chopped / bound
            image = matrix(down)
            n_steps += 1
            length = _dot(gradient, down) / _dot(down, image)
            x = np.maximum(x - length * down, 0.0)  # grows where it was 0; the clip is for rounding
            gradient -= length * image
            direction = None
            continue
        direction = steep if direction is None else steep - (_dot(steep, image) / curvature) * direction
        image = matrix(direction)
        n_steps += 1
        curvature = _dot(direction, image)
        if curvature <= 0.0:  # A does not see this direction: only rounding is left of the gradient
            return x, n_steps
        length = _dot(gradient, direction) / curvature
        falls = direction > 0.0
        room = float(np.min(x[falls] / direction[falls], initial=np.inf))
        if length <= room:
            x = np.maximum(x - length * direction, 0.0)
            gradient -= length * image
            continue
        # All that would fall below stops at 0 at once, as long as that leads down; if not, only as far as the first of them.
        tried = np.maximum(x - length * direction, 0.0)
        tried_gradient = matrix(tried) - right
        n_steps += 1
        if _dot(tried, tried_gradient - right) < _dot(x, gradient - right):
            x, gradient = tried, tried_gradient
        else:
            x = np.maximum(x - room * direction, 0.0)
            gradient -= room * image
            x = np.where(x > 0.0, np.maximum(x - gradient / bound, 0.0), 0.0)
            gradient = matrix(x) - right
            n_steps += 1
        direction = None


def _dot(x: Floats, y: Floats) -> float:
    """Scalar product, by one thread: those of a library would wait for each other longer than they work."""
    return float(np.einsum("i,i->", x, y))
