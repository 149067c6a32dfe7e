"""Numba kernel of the distortion models: inverse Brown-Conrady by Newton's method."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D

#: Maximum number of Newton steps, and of halvings per step.
MAX_STEPS, MAX_HALVINGS = 60, 30
#: Maximum number of times that a start value beyond the fold is moved inwards.
MAX_MOVES = 30
#: Residuals relative to the distance from the centre: the level of rounding errors, and the tolerance of a solution.
RESIDUAL, SOLVED = 1e-15, 1e-12
#: Number of preceding points that are compared, to reuse the result of an equal point.
N_COMPARED = 8
#: Shorter steps cannot reduce a squared residual below this multiple of the squared rounding error.
ROUNDING_FACTOR = 1e4
#: Relative size of the last Newton step: convergence is quadratic, so the remaining error is the square of this fraction.
LAST_STEP = 1e-9
#: Relative margin of the fold radius between the sampled directions.
FOLD_MARGIN = 1e-3


@njit()
def _map(x, y, k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4):
    """Return the distorted position x_d, y_d, and dx_d/dx, dx_d/dy, dy_d/dx, dy_d/dy."""
    r2 = x * x + y * y
    over_below = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    factor = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * over_below
    slope = (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - factor * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) * over_below
    x_d = x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + s2 * r2)
    y_d = y * factor + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y) + r2 * (s3 + s4 * r2)
    prism_x, prism_y = 2.0 * (s1 + 2.0 * s2 * r2), 2.0 * (s3 + 2.0 * s4 * r2)
    xx = factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x
    across = 2.0 * (x * y * slope + p1 * x + p2 * y)
    yy = factor + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y + prism_y * y
    return x_d, y_d, xx, across + prism_x * y, across + prism_y * x, yy


@njit()
def _is_inside(x, y, determinant, fold, min_fold):
    """Return whether an ideal point lies within the fold radii of equally spaced directions."""
    if not determinant > 0.0:
        return False
    radius = np.sqrt(x * x + y * y)
    if radius <= min_fold:
        return True
    direction = np.arctan2(y, x) / (2.0 * np.pi) * fold.size
    low = int(np.floor(direction))
    # The fold is curved between two directions: compare with the larger radius; the determinant is positive.
    return radius <= max(fold[low % fold.size], fold[(low + 1) % fold.size]) * (1.0 + FOLD_MARGIN)


@njit(
    types.float64[:, ::1](FLOATS_2D, FLOATS, types.float64, types.float64, FLOATS, FLOATS, types.float64),
)
def brown_conrady_inverse(xy, k, p1, p2, fold, ideal, per_step):
    """
    Return the ideal points (n, 2) within the fold of distorted points ``xy``.

    ``k``: k1 to k6, s1 to s4. Points without a solution are NaN. ``ideal`` contains the ideal radii at equally spaced distorted
    radii without tangential terms, the start values of Newton's method. Steps that do not reduce the residual, leave the circle
    around the fold, or reach a point with a determinant that is not positive are halved.
    """
    found = np.empty_like(xy)
    min_fold, max_fold = fold.min(), fold.max() * (1.0 + FOLD_MARGIN)
    k1, k2, k3, k4, k5, k6 = k[0], k[1], k[2], k[3], k[4], k[5]
    s1, s2, s3, s4 = k[6], k[7], k[8], k[9]
    last = ideal.size - 1
    for i in range(xy.shape[0]):
        u, v = xy[i, 0], xy[i, 1]
        # Adjacent sites of a layout share corners. Unsigned indices avoid the check for negative ones.
        same = np.uintp(i)
        for back in range(1, min(i, N_COMPARED) + 1):
            j = np.uintp(i - back)
            if xy[j, 0] == u and xy[j, 1] == v:
                same = j
                break
        if same != np.uintp(i):
            found[i, 0], found[i, 1] = found[same, 0], found[same, 1]
            continue
        distance = np.sqrt(u * u + v * v)
        position = distance * per_step
        at = int(min(position, float(last - 1)))
        radius = ideal[at] + min(position - at, 1.0) * (ideal[at + 1] - ideal[at])
        scale = radius / distance if distance > 0.0 else 1.0
        # Tangential terms can move a start value near the fold beyond it.
        for _ in range(MAX_MOVES):
            x, y = u * scale, v * scale
            x_d, y_d, xx, xy_, yx, yy = _map(x, y, k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4)
            if _is_inside(x, y, xx * yy - xy_ * yx, fold, min_fold):
                break
            scale *= 0.8
        ex, ey = x_d - u, y_d - v
        error = ex * ex + ey * ey
        size = max(distance, 1e-3)
        goal = (RESIDUAL * size) * (RESIDUAL * size)
        last_step = (LAST_STEP * size) * (LAST_STEP * size)
        for _ in range(MAX_STEPS):
            determinant = xx * yy - xy_ * yx
            if error <= goal or determinant <= 0.0:
                break
            step_x, step_y = (yy * ex - xy_ * ey) / determinant, (xx * ey - yx * ex) / determinant
            if step_x * step_x + step_y * step_y <= last_step:
                x, y, error = x - step_x, y - step_y, 0.0
                break
            length, is_better = 1.0, False
            for _ in range(MAX_HALVINGS):
                new_x, new_y = x - length * step_x, y - length * step_y
                x_d, y_d, a, b, c, d = _map(new_x, new_y, k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4)
                fx, fy = x_d - u, y_d - v
                if (
                    fx * fx + fy * fy < error
                    and a * d - b * c > 0.0
                    and new_x * new_x + new_y * new_y <= max_fold * max_fold
                ):
                    is_better = True
                    break
                if error <= ROUNDING_FACTOR * goal:  # at the level of rounding errors shorter steps do not help
                    break
                length *= 0.5
            if not is_better:
                break
            x, y, xx, xy_, yx, yy, ex, ey = new_x, new_y, a, b, c, d, fx, fy
            error = ex * ex + ey * ey
        is_solved = np.sqrt(error) <= SOLVED * max(distance, 1.0)
        if is_solved and _is_inside(x, y, xx * yy - xy_ * yx, fold, min_fold):
            found[i, 0], found[i, 1] = x, y
        else:
            found[i, 0], found[i, 1] = np.nan, np.nan
    return found
