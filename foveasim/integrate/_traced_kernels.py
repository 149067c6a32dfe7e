"""
Numba kernels for the integral over outlines that are traced once, without spans.

Coordinates are in cells of the grid, as in ``_kernels``. Let ``F(u, v)`` be the integral of the map along a row from a
reference line ``u = r`` to ``u``. By Green's theorem the integral over a polygon within the row is the integral of
``F dv`` along its edges, for every ``r``, since the heights of the edges sum to 0.

An outline that is **monotone** along v, such as every convex one, has one left and one right chain of edges in each row. With
the reference at the right end of the left chain, the integral over the row is a sum of positive terms; it requires no
accumulators and reads each cell once (:func:`_integrate_chain`). The cells between the chains are full: at second order
their gradients contribute nothing. All other outlines, and those across the boundary of the map, are accumulated in a box of
cells as by :func:`foveasim.integrate._kernels.trace_sites`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLAGS, FLOATS_2D, INTS, array_of
from foveasim._core.validation import Bools, Ints
from foveasim.integrate._kernels import (
    BOX_CELLS,
    NO_COVERAGE,
    _add_rings,
    _box,
    _clear_row,
    _gradient_scale,
    _sum_cells,
    _sum_gradients,
    _sum_row,
    _touched_columns,
    accumulators,
)

#: Cells of float32 in a cache line.
LINE_CELLS = 16
#: Larger boxes are not read ahead.
PREFETCH_CELLS = 2**16
#: A sum of cells that does not occur.
NEVER = 1.2345678e300


@njit()
def _ends(uv, start, stop):
    """Return lowest and highest vertex of a ring, and whether it is monotone along v."""
    low, high = start, start
    for i in range(start + 1, stop):
        if uv[i, 1] < uv[low, 1]:
            low = i
        if uv[i, 1] > uv[high, 1]:
            high = i
    is_monotone = True
    is_rising = True
    a = low
    for _ in range(stop - start):
        if a == high:
            is_rising = False
        b = a + 1 if a + 1 < stop else start
        if (uv[b, 1] < uv[a, 1]) if is_rising else (uv[b, 1] > uv[a, 1]):
            is_monotone = False
        a = b
    return low, high, is_monotone


@njit()
def _gradient_u(cells, row, column):
    """Return the change of the map per cell along u at a cell."""
    n_x = cells.shape[1]
    before, after = np.uintp(max(column - 1, 0)), np.uintp(min(column + 1, n_x - 1))
    row = np.uintp(row)
    return _gradient_scale(column, n_x) * (np.float64(cells[row, after]) - np.float64(cells[row, before]))


@njit()
def _gradient_v(cells, row, column):
    """Return the change of the map per cell along v at a cell."""
    n_y = cells.shape[0]
    below, above = np.uintp(max(row - 1, 0)), np.uintp(min(row + 1, n_y - 1))
    column = np.uintp(column)
    return _gradient_scale(row, n_y) * (np.float64(cells[above, column]) - np.float64(cells[below, column]))


@njit()
def _sum_between(cells, row, start, stop):
    """Return the sum of the cells from ``start`` to ``stop`` of a row, signed."""
    first, end = np.uintp(min(start, stop)), np.uintp(max(start, stop))
    total = _sum_cells(cells, np.uintp(row), first, end)
    return total if stop >= start else -total


@njit()
def _sum_gradients_v(cells, row, start, stop):
    """Return the sum of the changes of the map along v over cells of a row, signed."""
    n_y = cells.shape[0]
    above, below = (
        _sum_between(cells, min(row + 1, n_y - 1), start, stop),
        _sum_between(cells, max(row - 1, 0), start, stop),
    )
    return _gradient_scale(row, n_y) * (above - below)


@njit()
def _integrate_chain(cells, uv, start, stop, first, last, is_right, bottom, order, reference):
    """
    Return the integral of F dv along a chain of edges, upwards from ``first`` to ``last``.

    The left chain is called first and writes the reference column of every row, the first one on its right.
    """
    n_x = cells.shape[1]
    total = 0.0
    i = first
    while i != last:
        k = np.uintp(i)
        ua, va = uv[k, 0], uv[k, 1]
        if is_right:
            i = i + 1 if i + 1 < stop else start
        else:
            i = i - 1 if i > start else stop - 1
        k = np.uintp(i)
        ub, vb = uv[k, 0], uv[k, 1]
        if va == vb:
            continue
        slope = (ub - ua) / (vb - va)
        steepness = (vb - va) / abs(ub - ua) if ub != ua else 0.0
        if not np.isfinite(steepness):  # vertical up to rounding
            steepness = 0.0
        u_low, u_high = min(ua, ub), max(ua, ub)
        row = int(va)
        end_u = ua
        while row < vb:
            low, high = max(va, float(row)), min(vb, row + 1.0)
            left_u = end_u
            right_u = end_u = ub if high == vb else min(max(ua + (high - va) * slope, u_low), u_high)
            v_first, v_last = low - (row + 0.5), high - (row + 0.5)  # relative to the centre of the row
            if left_u > right_u:
                left_u, right_u = right_u, left_u
                v_first, v_last = v_last, v_first
            rise = high - low
            column = min(int(left_u), n_x - 1)
            i_row = np.uintp(row - bottom)
            r = reference[i_row]
            if not is_right:
                new = min(int(right_u), n_x - 1) + 1
                if low == row or va == uv[first, 1]:
                    r = new
                elif new > r:  # the chain has been integrated from r up to here
                    below = low - max(uv[first, 1], float(row))
                    total -= below * _sum_between(cells, row, r, new)
                    if order == 2:
                        v_mean = 0.5 * (low + max(uv[first, 1], float(row))) - (row + 0.5)
                        total -= below * v_mean * _sum_gradients_v(cells, row, r, new)
                    r = new
                reference[i_row] = r
            before = _sum_between(cells, row, r, column)
            before_v = 0.0
            if order == 2:
                v_mean = 0.5 * (v_first + v_last)
                if v_mean != 0.0:
                    total += rise * v_mean * _sum_gradients_v(cells, row, r, column)
            u, climbed = left_u, 0.0
            while True:
                value = np.float64(cells[np.uintp(row), np.uintp(column)])
                is_last = right_u <= column + 1.0 or column == n_x - 1
                u_next = right_u if is_last else column + 1.0
                climbed_next = rise if is_last else (u_next - left_u) * steepness
                height = climbed_next - climbed
                total += height * before
                weight = 0.5 * (u + u_next) - column
                if weight > NO_COVERAGE:  # else an edge on the left boundary of a cell, which may be NaN
                    total += height * weight * value
                if order == 2:
                    direction = 1.0 if v_last >= v_first else -1.0
                    v, v_next = v_first + direction * climbed, v_first + direction * climbed_next
                    u_mean, v_mean = 0.5 * (u + u_next) - (column + 0.5), 0.5 * (v + v_next)
                    spread = (u_next - u) / 12.0
                    total += height * v_mean * before_v
                    gradient_v = _gradient_v(cells, row, column)
                    before_v += gradient_v
                    if weight > NO_COVERAGE:
                        moment_u = 0.5 * (u_mean * u_mean + (u_next - u) * spread - 0.25)
                        moment_v = v_mean * (u_mean + 0.5) + (v_next - v) * spread
                        total += height * (moment_u * _gradient_u(cells, row, column) + moment_v * gradient_v)
                if is_last:
                    break
                before += value
                u, climbed = u_next, climbed_next
                column += 1
            row += 1
    return total


@njit()
def _prefetch(cells, bottom, top, left, right):
    """
    Read one cell of each cache line of a box.

    These loads overlap, while those of the rows would be waited for one after another.
    """
    probe = 0.0
    for row in range(bottom, top):
        for c in range(left, right, LINE_CELLS):
            probe += cells[row, c]
    return 1.0 if probe == NEVER else 0.0  # used, so that the loop is not optimised away


@njit()
def _is_within(uv, start, stop, n_y, n_x):
    """Whether all vertices of a ring are on the map."""
    is_within = True
    for i in range(start, stop):
        is_within &= 0.0 <= uv[i, 0] <= n_x and 0.0 <= uv[i, 1] <= n_y
    return is_within


@njit(
    [
        types.void(
            array_of(cell, 2),
            FLOATS_2D,
            INTS,
            INTS,
            FLAGS,
            types.float64,
            types.float64[:, ::1],
            types.float64[:, ::1],
            types.float64[:, ::1],
            types.uint64[::1],
            types.int64[::1],
            types.int64[::1],
            types.float64[::1],
        )
        for cell in (types.float32, types.float64)
    ],
    allocates=False,
)
def _integrate_sites(
    cells, uv, ring_offsets, site_offsets, where, scale, rows, cover, moment, touched, columns, references, out
):
    """Write scale x integral of sites; see :func:`integrate_sites`."""
    n_y, n_x = cells.shape
    has_moments = moment.shape[0] > 0
    order = 2 if has_moments else 1
    for i_site in range(site_offsets.size - 1):
        if where.size > 0 and not where[i_site]:
            continue
        first_ring, last_ring = site_offsets[i_site], site_offsets[i_site + 1]
        first_row, last_row, left, n_columns = _box(uv, ring_offsets[first_ring], ring_offsets[last_ring], n_y, n_x)
        n_words = (n_columns + 63) >> 6
        step = max(1, BOX_CELLS // max(n_columns, 1))
        total = 0.0
        start, stop = ring_offsets[first_ring], ring_offsets[first_ring + 1]
        if last_row > first_row and last_ring - first_ring == 1 and _is_within(uv, start, stop, n_y, n_x):
            lowest, highest, is_monotone = _ends(uv, start, stop)
            if is_monotone:
                if (last_row - first_row) * n_columns <= PREFETCH_CELLS:
                    total += _prefetch(cells, first_row, last_row, left, min(left + n_columns, n_x))
                for side in range(2):  # a constant would be a further type
                    along = _integrate_chain(
                        cells, uv, start, stop, lowest, highest, side == 1, first_row, order, references
                    )
                    total += along if side == 1 else -along
                out[i_site] = scale * total
                continue
        for bottom in range(first_row, last_row, step):
            top = min(bottom + step, last_row)
            total += _prefetch(cells, bottom, top, left, min(left + n_columns, n_x))
            _add_rings(
                uv, ring_offsets, first_ring, last_ring, n_x, bottom, top, left, n_columns, rows, cover, moment, touched
            )
            for row in range(bottom, top):
                i_row, base = np.uintp(row - bottom), (row - bottom) * n_columns
                n_touched = _touched_columns(touched, (row - bottom) * n_words, n_words, columns)
                total += _sum_row(columns, n_touched, left, cover, base, rows, i_row, cells, row)
                if has_moments:
                    total += _sum_gradients(columns, n_touched, left, moment, base, rows, i_row, cells, row)
                _clear_row(columns, n_touched, base, i_row, rows, cover, moment)
        out[i_site] = scale * total


def integrate_sites(
    cells: NDArray[np.floating],
    uv: NDArray[Any],
    ring_offsets: Ints,
    site_offsets: Ints,
    where: Bools,
    order: int,
    scale: float,
    out: NDArray[Any],
) -> None:
    """
    Write scale x integral of sites, without spans.

    Sites where ``where`` is False are not computed; an empty array stands for all True. Outlines are traced as by
    :func:`trace_sites`, and the cells of a row are summed as soon as it has been traced.
    """
    n_y, n_x = cells.shape
    references = np.empty(n_y, np.int64)
    boxes = accumulators(n_y, n_x, order)
    _integrate_sites(cells, uv, ring_offsets, site_offsets, where, scale, *boxes, references, out)
