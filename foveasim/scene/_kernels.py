"""Numba kernels of pictures."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_3D, array_of

_images = types.float32[:, :, ::1]
_table = array_of(types.float32)


@njit([types.void(types.Array(of, 3, "A", readonly=True), _table, _images) for of in (types.uint8, types.uint16)])
def look_up(pixels, table, out):
    """Write the values of a table at pixels (n_channel, n_y, n_x), in any memory order."""
    for y in range(pixels.shape[1]):
        for channel in range(pixels.shape[0]):
            for x in range(pixels.shape[2]):
                out[channel, y, x] = table[pixels[channel, y, x]]


@njit()
def _below(sums, u, v):
    """Return the sum of a picture to the left of u and below v, bilinear in pixels."""
    n_y, n_x = sums.shape[0] - 1, sums.shape[1] - 1
    row, column = min(max(int(np.floor(v)), 0), n_y - 1), min(max(int(np.floor(u)), 0), n_x - 1)
    t, s = v - row, u - column
    low = (1.0 - s) * sums[row, column] + s * sums[row, column + 1]
    high = (1.0 - s) * sums[row + 1, column] + s * sums[row + 1, column + 1]
    return (1.0 - t) * low + t * high


@njit()
def _below_turns(sums, u, v, is_periodic):
    """Return the sum to the left of u; periodic pictures continue at their sides."""
    if not is_periodic:
        return _below(sums, u, v)
    n_x = float(sums.shape[1] - 1)
    turns = np.floor(u / n_x)
    return turns * _below(sums, n_x, v) + _below(sums, u - turns * n_x, v)


@njit(
    types.void(
        FLOATS_3D,
        FLOATS,
        FLOATS,
        FLOATS,
        FLOATS,
        FLOATS,
        FLOATS,
        types.int64,
        types.boolean,
        types.Array(types.float32, 3, "A"),
    )
)
def box_means(table, of_rows, u0, u1, v0, v1, weight, n_points, is_periodic, out):
    """
    Write the means of cells (n_basis, n_y, n_x): weighted means of boxes of a picture.

    Each cell has n_points x n_points boxes. ``table`` (n_basis, n_row + 1, n_column + 1): sums of the picture times the weight
    of its rows. ``of_rows`` (n_row + 1,): sums of these weights. ``u0`` to ``v1``: sides of the boxes, in the order of points
    (n_y n_points, n_x n_points). Empty boxes are 0.
    """
    n_y, n_x = out.shape[1], out.shape[2]
    last = of_rows.size - 2
    for y in range(n_y):
        for x in range(n_x):
            total = 0.0
            for k in range(n_points * n_points):
                total += weight[((y * n_points + k // n_points) * n_x + x) * n_points + k % n_points]
            if total <= 0.0:
                continue
            for k in range(n_points * n_points):
                p = ((y * n_points + k // n_points) * n_x + x) * n_points + k % n_points
                low, high = min(int(v0[p]), last), min(int(v1[p]), last)
                height = (of_rows[high] + (v1[p] - high) * (of_rows[high + 1] - of_rows[high])) - (
                    of_rows[low] + (v0[p] - low) * (of_rows[low + 1] - of_rows[low])
                )
                area = (u1[p] - u0[p]) * height
                if area <= 0.0 or weight[p] <= 0.0:
                    continue
                scale = weight[p] / (total * area)
                for b in range(out.shape[0]):
                    found = (
                        _below_turns(table[b], u1[p], v1[p], is_periodic)
                        - _below_turns(table[b], u0[p], v1[p], is_periodic)
                        - _below_turns(table[b], u1[p], v0[p], is_periodic)
                        + _below_turns(table[b], u0[p], v0[p], is_periodic)
                    )
                    out[b, y, x] += max(found, 0.0) * scale
