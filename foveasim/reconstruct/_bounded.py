"""
Quadratic minimisation under x >= 0 by preconditioned conjugate gradients.

MPRGP, modified proportioning with reduced gradient projections, preconditioned in the face (Dostál 2009, Optimal Quadratic
Programming Algorithms, sections 5.7 and 5.10): conjugate gradient steps among the unknowns above 0, a projected step of fixed
length when an unknown would become negative, and a step that frees unknowns at 0 when their part of the gradient dominates. It
converges to the unique minimum from any starting point.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from foveasim._core.validation import Floats
from foveasim.errors import SimulationError

Operator = Callable[[Floats], Floats]


def minimise_nonnegative(
    matrix: Operator,
    bound: Floats,
    precondition: Operator,
    right: Floats,
    start: Floats,
    *,
    threshold: float,
    max_steps: int,
) -> tuple[Floats, int]:
    """
    Minimise ``x·A x / 2 - b·x`` subject to x >= 0.

    ``matrix``: A, symmetric and positive semi-definite: maps x to A x, (n,). ``bound`` (n,) float64: diagonal of a matrix D
    with ``x·A x <= x·D x`` for all x. ``precondition``: approximate inverse of A, symmetric and positive definite. ``right``,
    ``start`` (n,) float64: b, and the starting point. ``threshold``: convergence threshold of the root of ``g·M g``, with the
    projected gradient g and the preconditioner M (the inverse of D for unknowns at 0): approximately the distance from the
    minimum in the norm of A. Returns ``x`` (n,) float64. ``n_steps``: number of applications of A. Raises SimulationError when
    the iteration does not converge within ``max_steps``.
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
        preconditioned = np.where(is_free, precondition(free), 0.0)
        free2, chopped2 = _dot(free, preconditioned), _dot(chopped, chopped / bound)
        if math.sqrt(free2 + chopped2) <= threshold:
            return x, n_steps
        if n_steps >= max_steps:
            raise SimulationError(
                f"the picture did not converge in {max_steps} steps; increase 'tolerance', 'mu' or 'max_steps'"
            )
        if chopped2 > _dot(np.minimum(x, free / bound), free):
            descent = chopped / bound
            image = matrix(descent)
            n_steps += 1
            length = _dot(gradient, descent) / _dot(descent, image)
            x = np.maximum(x - length * descent, 0.0)  # unknowns at 0 increase; the clip is for rounding
            gradient -= length * image
            direction = None
            continue
        direction = (
            preconditioned
            if direction is None
            else preconditioned - (_dot(preconditioned, image) / curvature) * direction
        )
        image = matrix(direction)
        n_steps += 1
        curvature = _dot(direction, image)
        if curvature <= 0.0:  # null space of A: the gradient is rounding error
            return x, n_steps
        length = _dot(gradient, direction) / curvature
        is_decreasing = direction > 0.0
        max_length = float(np.min(x[is_decreasing] / direction[is_decreasing], initial=np.inf))
        if length <= max_length:
            x = np.maximum(x - length * direction, 0.0)
            gradient -= length * image
            continue
        # Clip all negative unknowns to 0 if this decreases the objective; otherwise step to the first unknown at 0.
        trial = np.maximum(x - length * direction, 0.0)
        trial_gradient = matrix(trial) - right
        n_steps += 1
        if _dot(trial, trial_gradient - right) < _dot(x, gradient - right):
            x, gradient = trial, trial_gradient
        else:
            x = np.maximum(x - max_length * direction, 0.0)
            gradient -= max_length * image
            x = np.where(x > 0.0, np.maximum(x - gradient / bound, 0.0), 0.0)
            gradient = matrix(x) - right
            n_steps += 1
        direction = None


def _dot(x: Floats, y: Floats) -> float:
    """Return the scalar product, in one thread: synchronising BLAS threads takes longer."""
    return float(np.einsum("i,i->", x, y))
