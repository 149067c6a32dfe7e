"""
Numba kernels for axis-aligned rectangles: recognition, and integration without a plan.

Coordinates are in cells of the grid, as in ``_kernels``. The overlap of a rectangle with a cell is the product of the overlaps
along x and along y. Along an axis a rectangle covers the cells ``first`` to ``last``, the outermost ones partly:

    low                          high             weight 1 between, w_first and w_last at the ends
     ├────┼─────────┼─────────┼───┤               moments about the centre of a cell: m_first, m_last
    first                      last

At second order the integral over a cell is ``mean * area + gradient_u * moment_u + gradient_v * moment_v``.
"""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLAGS, FLOATS_2D, INTS, array_of
from foveasim.integrate._kernels import ONE, ZERO, _sum_cells

#: Covered fractions of the outermost cells up to this value are rounding errors.
NO_COVERAGE = 4e-15


@njit(types.float64[:, ::1](FLOATS_2D, INTS, INTS))
def find_rectangles(xy, ring_offsets, site_offsets):
    """
    Return x_min, y_min, x_max, y_max of every site, (n_site, 4).

    The result is (0, 4) if a site is not an axis-aligned rectangle. Clockwise outlines, and rectangles without an area, are not
    recognised.
    """
    n_sites = site_offsets.size - 1
    n_points = xy.shape[0]
    if site_offsets[n_sites] != n_sites or ring_offsets[n_sites] != n_points or n_points != 4 * n_sites:
        return np.empty((0, 4))
    out = np.empty((n_sites, 4))
    for site in range(n_sites):
        i = ring_offsets[site]
        if ring_offsets[site + 1] != i + 4:
            return np.empty((0, 4))
        if xy[i, 1] != xy[i + 1, 1]:  # the first edge is vertical
            i += 1
        a, b, c, d = i, i + 1, i + 2, i + 3
        d = d if d < ring_offsets[site + 1] else ring_offsets[site]
        if not (xy[a, 1] == xy[b, 1] and xy[b, 0] == xy[c, 0] and xy[c, 1] == xy[d, 1] and xy[d, 0] == xy[a, 0]):
            return np.empty((0, 4))
        width, height = xy[b, 0] - xy[a, 0], xy[c, 1] - xy[b, 1]
        if not ((width > 0.0 and height > 0.0) or (width < 0.0 and height < 0.0)):
            return np.empty((0, 4))
        out[site, 0], out[site, 1] = min(xy[a, 0], xy[c, 0]), min(xy[a, 1], xy[c, 1])
        out[site, 2], out[site, 3] = max(xy[a, 0], xy[c, 0]), max(xy[a, 1], xy[c, 1])
    return out


@njit()
def _covered_cells(low, high, n):
    """
    Return (first, last, w_first, w_last, m_first, m_last) of an interval on ``n`` cells.

    ``last < first`` if it covers none.
    """
    low, high = max(low, 0.0), min(high, float(n))
    if not high > low:
        return 0, -1, 0.0, 0.0, 0.0, 0.0
    first, last = int(np.floor(low)), int(np.ceil(high)) - 1
    if first < last and first + 1 - low <= NO_COVERAGE:
        first += 1
        low = float(first)
    if first < last and high - last <= NO_COVERAGE:
        high = float(last)
        last -= 1
    if first == last:
        return first, last, high - low, 0.0, (high - low) * (0.5 * (low + high) - first - 0.5), 0.0
    w_first, w_last = first + 1 - low, high - last
    return first, last, w_first, w_last, 0.5 * w_first * (low - first), 0.5 * w_last * (high - last - 1.0)


@njit()
def _along_row(cells, row, first, last, w_first, w_last):
    """Return the integral of a row over an interval, from unsigned indices."""
    total = w_first * cells[row, first]
    if last > first:
        total += w_last * cells[row, last]
        if last > first + ONE:
            total += _sum_cells(cells, row, first + ONE, last)
    return total


@njit()
def _neighbours(index, n):
    """Return the indices before and after an unsigned one, within ``n``."""
    return index - ONE if index > ZERO else ZERO, index + ONE if index + ONE < np.uintp(n) else index


@njit()
def _difference(cells, row, c):
    """Return the gradient of a row at a cell, per cell; 0 along a single cell."""
    before, after = _neighbours(c, cells.shape[1])
    step = np.float64(cells[row, after]) - np.float64(cells[row, before])
    return 0.5 * step if after > before + ONE else step


@njit()
def _tilt(cells, row, first, last, w_first, w_last):
    """Return the integral over an interval of a row's gradient along v, per cell."""
    below, above = _neighbours(row, cells.shape[0])
    if below == above:
        return 0.0
    step = _along_row(cells, above, first, last, w_first, w_last) - _along_row(
        cells, below, first, last, w_first, w_last
    )
    return 0.5 * step if above > below + ONE else step


@njit()
def _integral(cells, u, v, order):
    """Return the integral over a rectangle, from its covered cells along x and along y."""
    total = 0.0
    if u[1] < u[0] or v[1] < v[0]:
        return total
    first, last, bottom, top = np.uintp(u[0]), np.uintp(u[1]), np.uintp(v[0]), np.uintp(v[1])
    w_first, w_last, m_first, m_last = u[2:]
    w_bottom, w_top, m_bottom, m_top = v[2:]
    row = bottom
    while row <= top:
        weight = w_bottom if row == bottom else (w_top if row == top else 1.0)
        value = _along_row(cells, row, first, last, w_first, w_last)
        if order == 2:
            if m_first != 0.0:
                value += m_first * _difference(cells, row, first)
            if m_last != 0.0:
                value += m_last * _difference(cells, row, last)
        total += weight * value
        row += ONE
    if order == 2:
        if m_bottom != 0.0:
            total += m_bottom * _tilt(cells, bottom, first, last, w_first, w_last)
        if m_top != 0.0:
            total += m_top * _tilt(cells, top, first, last, w_first, w_last)
    return total


@njit(
    [
        types.void(
            array_of(cell, 2),
            FLOATS_2D,
            types.int64,
            types.int64,
            FLAGS,
            types.float64,
            types.int64,
            types.float64[::1],
        )
        for cell in (types.float32, types.float64)
    ],
    allocates=False,
)
def gather_rectangles(cells, bounds, first_site, last_site, where, scale, order, out):
    """
    Write scale x integral of the sites ``first_site`` to ``last_site - 1``.

    ``bounds`` is (n_site, 4), in cells; ``where`` is empty, or False at sites that are not written.
    """
    n_y, n_x = cells.shape
    for site in range(first_site, last_site):
        if where.size == 0 or where[site]:
            u = _covered_cells(bounds[site, 0], bounds[site, 2], n_x)
            v = _covered_cells(bounds[site, 1], bounds[site, 3], n_y)
            out[site] = scale * _integral(cells, u, v, order)


@njit(
    [
        types.void(
            array_of(cell, 2),
            FLOATS_2D,
            FLOATS_2D,
            types.int64,
            types.int64,
            FLAGS,
            types.float64,
            types.int64,
            types.float64[::1],
        )
        for cell in (types.float32, types.float64)
    ]
)
def gather_lattice(cells, u, v, first_row, last_row, where, scale, order, out):
    """
    Write scale x integral of the sites in some rows of a lattice.

    The rows are ``first_row`` to ``last_row - 1``. ``u`` is (n_column, 2) and ``v`` is (n_row, 2), in cells. At first order,
    without ``where``, a row of the map is integrated once over all columns.
    """
    n_y, n_x = cells.shape
    n_columns = u.shape[0]
    columns = np.empty((n_columns, 2), np.int64)
    weights = np.empty((n_columns, 4))
    is_narrow = True
    for i in range(n_columns):
        columns[i, 0], columns[i, 1], weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3] = _covered_cells(
            u[i, 0], u[i, 1], n_x
        )
        is_narrow &= 0 <= columns[i, 1] - columns[i, 0] <= 1
    is_covered = columns[:, 1] >= columns[:, 0]
    firsts, lasts = np.empty(n_columns, np.uintp), np.empty(n_columns, np.uintp)
    w_first, w_last = np.empty(n_columns), np.empty(n_columns)
    for i in range(n_columns):
        firsts[i], lasts[i] = np.uintp(columns[i, 0]), np.uintp(max(columns[i, 1], columns[i, 0]))
        w_first[i], w_last[i] = weights[i, 0], weights[i, 1]
    along = np.empty(n_columns)
    done = -1  # the row of the map in ``along``
    chosen, n_chosen = np.arange(n_columns, dtype=np.uintp), n_columns
    for j in range(first_row, last_row):
        covered = _covered_cells(v[j, 0], v[j, 1], n_y)
        bottom, top, w_bottom, w_top = covered[:4]
        start = j * n_columns
        sums = out[start : start + n_columns]
        if where.size > 0:
            n_chosen = 0
            for i in range(n_columns):
                chosen[n_chosen] = np.uintp(i)
                n_chosen += 1 if where[start + i] else 0
        if order == 2:
            for k in range(n_chosen):
                i = chosen[k]
                interval = (columns[i, 0], columns[i, 1], weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3])
                sums[i] = scale * _integral(cells, interval, covered, order)
            continue
        if n_chosen < n_columns:
            for k in range(n_chosen):
                sums[chosen[k]] = 0.0
        else:
            sums[:] = 0.0
        for row in range(bottom, top + 1):
            line = cells[row]
            weight = scale * (w_bottom if row == bottom else (w_top if row == top else 1.0))
            if n_chosen < n_columns:
                for k in range(n_chosen):
                    i = chosen[k]
                    value = 0.0
                    if is_narrow:
                        value = w_first[i] * line[firsts[i]] + w_last[i] * line[lasts[i]]
                    elif is_covered[i]:
                        value = _along_row(cells, np.uintp(row), firsts[i], lasts[i], w_first[i], w_last[i])
                    sums[i] += weight * value
                continue
            if row != done:
                done = row
                if is_narrow:
                    for i in range(n_columns):
                        along[i] = w_first[i] * line[firsts[i]] + w_last[i] * line[lasts[i]]
                else:
                    for i in range(n_columns):
                        along[i] = (
                            _along_row(cells, np.uintp(row), firsts[i], lasts[i], w_first[i], w_last[i])
                            if is_covered[i]
                            else 0.0
                        )
            for i in range(n_columns):
                sums[i] += weight * along[i]
