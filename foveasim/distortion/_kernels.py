"""The distortion room's numba kernel: Newton's method for the inverse of the Brown-Conrady model."""

from __future__ import annotations

import numpy as np
from numba import njit, types

__all__ = ["brown_conrady_inverse"]

_points = types.Array(types.float64, 2, "C", readonly=True)
_numbers = types.Array(types.float64, 1, "C", readonly=True)

#: Newton's steps, and how often one is halved.
MAX_STEPS, MAX_HALVINGS = 60, 30
#: A residual of this share of a point's distance from the centre is rounding.
RESIDUAL = 4e-16


@njit(cache=True, nogil=True)
def _map(x, y, k, p1, p2):
    """Distorted position of a point, and the Jacobian: x_d, y_d, dx/dx, dx/dy, dy/dy."""
    r2 = x * x + y * y
    above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
    below = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]))
    factor = above / below
    slope = (k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[2]) - factor * (k[3] + r2 * (2.0 * k[4] + 3.0 * r2 * k[5]))) / below
    x_d = x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    y_d = y * factor + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    xx = factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    xy = 2.0 * (x * y * slope + p1 * x + p2 * y)
    yy = factor + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y
    return x_d, y_d, xx, xy, yy


@njit(
    types.float64[:, ::1](_points, _points, _numbers, types.float64, types.float64, types.float64),
    cache=True,
    nogil=True,
)
def brown_conrady_inverse(xy, start, k, p1, p2, max_r2):
    """
    Ideal points (n, 2) whose distorted positions are ``xy``, or the nearest that Newton's steps come from ``start``.

    Steps that do not come nearer, leave the circle of ``max_r2``, or reach a point where the determinant is not positive are
    halved.
    """
    found = np.empty_like(start)
    for i in range(xy.shape[0]):
        x, y = start[i, 0], start[i, 1]
        x_d, y_d, xx, xy_, yy = _map(x, y, k, p1, p2)
        ex, ey = x_d - xy[i, 0], y_d - xy[i, 1]
        error = ex * ex + ey * ey
        goal = RESIDUAL * max(np.hypot(xy[i, 0], xy[i, 1]), 1e-3)
        goal *= goal
        for _ in range(MAX_STEPS):
            determinant = xx * yy - xy_ * xy_
            if error <= goal or determinant <= 0.0:
                break
            step_x, step_y = (yy * ex - xy_ * ey) / determinant, (xx * ey - xy_ * ex) / determinant
            length, is_better = 1.0, False
            for _ in range(MAX_HALVINGS):
                new_x, new_y = x - length * step_x, y - length * step_y
                x_d, y_d, a, b, c = _map(new_x, new_y, k, p1, p2)
                fx, fy = x_d - xy[i, 0], y_d - xy[i, 1]
                if fx * fx + fy * fy < error and a * c - b * b > 0.0 and new_x * new_x + new_y * new_y <= max_r2:
                    is_better = True
                    break
                length *= 0.5
            if not is_better:
                break
            x, y, xx, xy_, yy, ex, ey = new_x, new_y, a, b, c, fx, fy
            error = ex * ex + ey * ey
        found[i, 0], found[i, 1] = x, y
    return found
