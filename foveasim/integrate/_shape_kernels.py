"""
Numba kernels for the derivatives of integrals with respect to the vertices of outlines.

Coordinates are in cells of the grid, as in ``_kernels``. An edge from a to b has the points ``a + τ (b - a)``. Its
**moments** are
the integrals of ``(1 - τ) P`` and of ``τ P`` over τ from 0 to 1, where P is the map along the edge: the mean of the
cell at first
order, with its gradient at second order, and 0 outside the map. On an edge along a cell boundary P is the mean of both sides.
"""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS_2D, FLOATS_3D, array_of
from foveasim.integrate._kernels import _gradient_scale

_count = types.int64
_out3 = types.float64[:, :, ::1]
_out2 = types.float64[:, ::1]


@njit()
def _clip(start, step, size, first, last):
    """Return the part of a range of τ in which ``start + τ step`` is from 0 to ``size``."""
    if step == 0.0:
        if start < 0.0 or start > size:
            return 1.0, 0.0
        return first, last
    enter, leave = -start / step, (size - start) / step
    if enter > leave:
        enter, leave = leave, enter
    return max(first, enter), min(last, leave)


@njit()
def _first_cell(start, step, t, size, side):
    """Return the cell that a line enters at τ = t; ``side`` 1 is below a boundary."""
    position = start + t * step
    cell = int(np.floor(position))
    if (step < 0.0 or (step == 0.0 and side == 1)) and cell == position:
        cell -= 1
    if step == 0.0:
        return cell
    return min(max(cell, 0), size - 1)


@njit()
def _n_sides(ua, va, ub, vb):
    """Return 2 for an edge along a cell boundary, else 1."""
    return 2 if (ua == ub and ua == np.floor(ua)) or (va == vb and va == np.floor(va)) else 1


@njit()
def _next(start, inverse, cell, step):
    """Return τ at which a line leaves a cell along one axis."""
    if step == 0.0:
        return np.inf
    return ((cell + 1 if step > 0.0 else cell) - start) * inverse


@njit()
def _gradient(cells, i_map, row, column):
    """Return the change of the map per cell along u and v."""
    n_y, n_x = cells.shape[1], cells.shape[2]
    right, left = cells[i_map, row, min(column + 1, n_x - 1)], cells[i_map, row, max(column - 1, 0)]
    above, below = cells[i_map, min(row + 1, n_y - 1), column], cells[i_map, max(row - 1, 0), column]
    return (
        _gradient_scale(column, n_x) * (np.float64(right) - np.float64(left)),
        _gradient_scale(row, n_y) * (np.float64(above) - np.float64(below)),
    )


@njit(
    [
        types.void(array_of(cell, 3), _count, FLOATS_2D, FLOATS_2D, _count, _count, _count, _out2)
        for cell in (types.float32, types.float64)
    ],
)
def measure_moments(cells, i_map, begin, end, first_edge, last_edge, order, out):
    """Write the moments (n_edge, 2) of a range of edges in one of the maps (n_map, n_y, n_x)."""
    n_y, n_x = cells.shape[1], cells.shape[2]
    for edge in range(first_edge, last_edge):
        ua, va, ub, vb = begin[edge, 0], begin[edge, 1], end[edge, 0], end[edge, 1]
        du, dv = ub - ua, vb - va
        out[edge, 0] = 0.0
        out[edge, 1] = 0.0
        t_first, t_last = _clip(ua, du, float(n_x), 0.0, 1.0)
        t_first, t_last = _clip(va, dv, float(n_y), t_first, t_last)
        if t_first >= t_last:
            continue
        inverse_u = 1.0 / du if du != 0.0 else 0.0
        inverse_v = 1.0 / dv if dv != 0.0 else 0.0
        n_sides = _n_sides(ua, va, ub, vb)
        from_a, from_b = 0.0, 0.0
        for side in range(n_sides):
            column = _first_cell(ua, du, t_first, n_x, side)
            row = _first_cell(va, dv, t_first, n_y, side)
            t = t_first
            while 0 <= column < n_x and 0 <= row < n_y:
                t_u, t_v = _next(ua, inverse_u, column, du), _next(va, inverse_v, row, dv)
                t_next = max(min(t_u, t_v, t_last), t)
                width, middle = t_next - t, 0.5 * (t + t_next)
                value = np.float64(cells[i_map, row, column])
                if order == 1:
                    from_b += width * middle * value
                    from_a += width * (1.0 - middle) * value
                else:
                    along_u, along_v = _gradient(cells, i_map, row, column)
                    change = along_u * du + along_v * dv
                    at_middle = (
                        value
                        + along_u * (ua + middle * du - (column + 0.5))
                        + along_v * (va + middle * dv - (row + 0.5))
                    )
                    tilt = change * width * width * width / 12.0
                    from_b += width * middle * at_middle + tilt
                    from_a += width * (1.0 - middle) * at_middle - tilt
                if t_next >= t_last:
                    break
                if t_u <= t_next:
                    column += 1 if du > 0.0 else -1
                if t_v <= t_next:
                    row += 1 if dv > 0.0 else -1
                t = t_next
        out[edge, 0] = from_a / n_sides
        out[edge, 1] = from_b / n_sides


@njit(types.void(FLOATS_3D, _count, FLOATS_2D, FLOATS_2D, _count, _out3))
def spread_moments(weights, i_map, begin, end, order, cells):
    """Add the adjoint of :func:`measure_moments` for its weights to one of the maps."""
    n_y, n_x = cells.shape[1], cells.shape[2]
    for edge in range(begin.shape[0]):
        ua, va, ub, vb = begin[edge, 0], begin[edge, 1], end[edge, 0], end[edge, 1]
        du, dv = ub - ua, vb - va
        t_first, t_last = _clip(ua, du, float(n_x), 0.0, 1.0)
        t_first, t_last = _clip(va, dv, float(n_y), t_first, t_last)
        if t_first >= t_last:
            continue
        inverse_u = 1.0 / du if du != 0.0 else 0.0
        inverse_v = 1.0 / dv if dv != 0.0 else 0.0
        n_sides = _n_sides(ua, va, ub, vb)
        weight_a, weight_b = weights[i_map, edge, 0] / n_sides, weights[i_map, edge, 1] / n_sides
        for side in range(n_sides):
            column = _first_cell(ua, du, t_first, n_x, side)
            row = _first_cell(va, dv, t_first, n_y, side)
            t = t_first
            while 0 <= column < n_x and 0 <= row < n_y:
                t_u, t_v = _next(ua, inverse_u, column, du), _next(va, inverse_v, row, dv)
                t_next = max(min(t_u, t_v, t_last), t)
                width, middle = t_next - t, 0.5 * (t + t_next)
                mean = width * (middle * weight_b + (1.0 - middle) * weight_a)
                cells[i_map, row, column] += mean
                if order == 2:
                    # Integrals of the weight times the position relative to the centre of the cell.
                    tilt = width * width * width / 12.0 * (weight_b - weight_a)
                    u = _gradient_scale(column, n_x) * (mean * (ua + middle * du - (column + 0.5)) + tilt * du)
                    v = _gradient_scale(row, n_y) * (mean * (va + middle * dv - (row + 0.5)) + tilt * dv)
                    cells[i_map, row, min(column + 1, n_x - 1)] += u
                    cells[i_map, row, max(column - 1, 0)] -= u
                    cells[i_map, min(row + 1, n_y - 1), column] += v
                    cells[i_map, max(row - 1, 0), column] -= v
                if t_next >= t_last:
                    break
                if t_u <= t_next:
                    column += 1 if du > 0.0 else -1
                if t_v <= t_next:
                    row += 1 if dv > 0.0 else -1
                t = t_next


@njit()
def _value(cells, i_map, row, column, u, v, order):
    """Return the map at a point, as seen from one cell; 0 outside the map."""
    n_y, n_x = cells.shape[1], cells.shape[2]
    if not (0 <= row < n_y and 0 <= column < n_x):
        return 0.0
    value = np.float64(cells[i_map, row, column])
    if order == 2:
        along_u, along_v = _gradient(cells, i_map, row, column)
        value += along_u * (u - (column + 0.5)) + along_v * (v - (row + 0.5))
    return value


@njit(
    [
        types.void(array_of(cell, 3), _count, FLOATS_2D, FLOATS_2D, FLOATS_3D, _count, _count, _count, _out3)
        for cell in (types.float32, types.float64)
    ],
)
def differentiate_moments(cells, i_map, begin, end, weights, first_edge, last_edge, order, out):
    """
    Add the gradient of ``sum weights * moments`` by both ends to ``out``, (n_edge, 2, 2).

    Moments change with the position of the crossings of the edge and cell boundaries, where the map jumps, and at
    second order with
    the gradient in each cell. They have no derivative where an edge passes through a corner of cells or lies on a boundary.
    """
    n_y, n_x = cells.shape[1], cells.shape[2]
    for edge in range(first_edge, last_edge):
        ua, va, ub, vb = begin[edge, 0], begin[edge, 1], end[edge, 0], end[edge, 1]
        du, dv = ub - ua, vb - va
        weight_a, weight_b = weights[i_map, edge, 0], weights[i_map, edge, 1]
        inverse_u = 1.0 / du if du != 0.0 else 0.0
        inverse_v = 1.0 / dv if dv != 0.0 else 0.0
        t_first, t_last = _clip(ua, du, float(n_x), 0.0, 1.0)
        t_first, t_last = _clip(va, dv, float(n_y), t_first, t_last)
        if t_first >= t_last or _n_sides(ua, va, ub, vb) == 2:
            continue
        column = _first_cell(ua, du, t_first, n_x, 0)
        row = _first_cell(va, dv, t_first, n_y, 0)
        t = t_first
        if t_first > 0.0:  # the edge enters the map
            u, v = ua + t * du, va + t * dv
            jump = -_value(cells, i_map, row, column, u, v, order) * (weight_a * (1.0 - t) + weight_b * t)
            enter_u = min(-ua / du, (n_x - ua) / du) if du != 0.0 else -np.inf
            enter_v = min(-va / dv, (n_y - va) / dv) if dv != 0.0 else -np.inf
            axis = 0 if enter_u >= enter_v else 1
            inverse = inverse_u if axis == 0 else inverse_v
            out[edge, 0, axis] -= jump * (1.0 - t) * inverse
            out[edge, 1, axis] -= jump * t * inverse
        while 0 <= column < n_x and 0 <= row < n_y:
            t_u, t_v = _next(ua, inverse_u, column, du), _next(va, inverse_v, row, dv)
            t_next = max(min(t_u, t_v, t_last), t)
            if order == 2:
                along_u, along_v = _gradient(cells, i_map, row, column)
                width, middle = t_next - t, 0.5 * (t + t_next)
                for k in range(3):  # Simpson's rule, exact for the square of τ
                    s = t if k == 0 else (middle if k == 1 else t_next)
                    weight = width * (4.0 if k == 1 else 1.0) / 6.0 * (weight_a * (1.0 - s) + weight_b * s)
                    out[edge, 0, 0] += weight * (1.0 - s) * along_u
                    out[edge, 0, 1] += weight * (1.0 - s) * along_v
                    out[edge, 1, 0] += weight * s * along_u
                    out[edge, 1, 1] += weight * s * along_v
            if t_next >= 1.0:
                break
            u, v = ua + t_next * du, va + t_next * dv
            before = _value(cells, i_map, row, column, u, v, order)
            axis = 0 if t_u <= t_v else 1
            if axis == 0:
                column += 1 if du > 0.0 else -1
            else:
                row += 1 if dv > 0.0 else -1
            # A crossing at τ moves by -(1 - τ) / d for a displacement of a, and by -τ / d for one of b.
            jump = before - _value(cells, i_map, row, column, u, v, order)
            jump *= weight_a * (1.0 - t_next) + weight_b * t_next
            inverse = inverse_u if axis == 0 else inverse_v
            out[edge, 0, axis] -= jump * (1.0 - t_next) * inverse
            out[edge, 1, axis] -= jump * t_next * inverse
            t = t_next
