"""
Numba kernels of the integrator: outline tracing, span sorting, map integration.

Coordinates are in *cells* of the grid, ``u = (x - x0) / pitch_x`` to the right and ``v = (y - y0) / pitch_y`` up, so
that cell ``[iy, ix]`` is the unit square from ``(ix, iy)`` to ``(ix + 1, iy + 1)``.

By Green's theorem the overlap of a site with a cell is a sum over the edges of the site (:func:`trace_sites`). The
result is stored run-length encoded. A **span** is one row of ``spans``, integers: a site, a first column, the number
``n_partial`` of cells with individual weights (their overlap with the site, 0 to 1), the number ``n_run`` of subsequent
cells with one common weight (the interior of the site: 1), and while sites are traced the row of the grid. A frame then
costs one pass over the map, a multiplication for each cell that an outline cuts, and additions in the interior
(:func:`gather`). No sum runs along a complete row, so a bright source does not reduce the precision of a dark site in the
same row.

At **second order** the cells that an outline cuts are also listed as rows of ``cuts`` (a site, a column, and while sites
are traced a row), each with a row of ``moments``: the first moments of the overlap about the cell centre, along u and along
v, divided by the distance in cells between the two neighbours whose difference is the gradient (2; 1 at the boundary of the
map, where the cell itself replaces the missing neighbour). Cells that are covered completely have no moments, and their
neighbours are not read. At first order both arrays are empty.

The kernels use arrays only, release the global interpreter lock, and are compiled for explicit types when this module
is imported; the machine code is cached on disk.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLAGS, FLOATS, FLOATS_2D, INTS, array_of
from foveasim._core.validation import Ints

#: Columns of ``spans``. A finished plan is in the order of the rows and has no column ``ROW``; its first column is the index of
#: the accumulator instead of the site.
SITE, COLUMN, N_PARTIAL, N_RUN, ROW = range(5)
#: Third column of ``cuts`` while sites are traced; the first two are as in ``spans``.
CUT_ROW = 2

#: Cells per block of the partial sums of a row: fastest measured value (eight float32 convert to one vector of float64).
BLOCK = 8
#: Unsigned constants: with a signed one, an unsigned index would become a float.
ZERO, ONE, TWO, THREE, FOUR, FIVE, SIX, SEVEN, EIGHT = map(np.uintp, range(BLOCK + 1))
TWO_BLOCKS = np.uintp(2 * BLOCK)
#: Shorter runs are stored cell by cell, which is faster than a separate sum.
MIN_RUN = 12
#: Weights below this fraction of the total height of the edges in a row are rounding errors. The limit is for up to eight
#: pieces and increases in proportion to their number.
NO_COVERAGE = 2e-15
#: Largest number of cells of a box that are accumulated together; larger boxes are divided into strips of rows.
BOX_CELLS = 2**14
#: Multiplication by this sequence maps a power of 2 to a unique value of 6 bits.
DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
BIT_POSITIONS = np.zeros(64, np.int64)
for _bit in range(64):
    BIT_POSITIONS[(0x03F79D71B4CB0A89 << _bit & (2**64 - 1)) >> 58] = _bit


_spans = array_of(types.int32, 2)
_cuts = array_of(types.int32, 2)
_count = types.int64
_span_list = types.int32[:, ::1]
_cut_list = types.int32[:, ::1]
_float_list = types.float64[::1]
_moment_list = types.float64[:, ::1]
_int_list = types.int64[::1]


@njit()
def _lowest_bit(word):
    """Return the position of the lowest bit of a word that is not 0."""
    return BIT_POSITIONS[((word & (~word + np.uint64(1))) * DE_BRUIJN) >> np.uint64(58)]


@njit()
def _set_bits(words, offset, first, last):
    """Set the bits ``first`` to ``last`` of the words from ``offset`` on."""
    ones = ~np.uint64(0)
    for k in range(first >> 6, (last >> 6) + 1):
        low, high = max(first - 64 * k, 0), min(last - 64 * k, 63)
        words[np.uintp(offset + k)] |= (ones >> np.uint64(63 - high + low)) << np.uint64(low)


@njit()
def _touched_columns(touched, offset, n_words, columns):
    """List the columns whose bits are set from ``offset`` on, ascending, and clear them."""
    n = ZERO
    for k in range(n_words):
        at = np.uintp(offset + k)
        word = touched[at]
        touched[at] = ZERO
        while word != ZERO:
            columns[n] = 64 * k + _lowest_bit(word)
            n += ONE
            word &= word - ONE
    return np.int64(n)


@njit()
def _add_edge(ua, va, ub, vb, n_x, bottom, top, left, n_columns, n_words, rows, cover, moment, touched):
    """
    Add one edge to the cells of a box.

    The box has the rows ``bottom`` to ``top - 1`` and ``n_columns`` columns from ``left`` on.
    ``cover[cell]`` is (height, area): the signed height of the edge pieces in the cell, and the area between them and the left
    boundary of the cell. ``rows[row]`` is (sum of the signed heights, sum of the unsigned heights, number of pieces). At second
    order ``moment[cell]`` is the moment along v of every cell to the left, and the moments along u and along v of the area
    between the pieces and the left boundary of the cell, all about the centre of the cell; the moment along u of the cells to
    the left is 0. A bit of ``touched`` is set for each cell.
    """
    sign = 1.0
    if va > vb:  # always upwards, so that adjacent sites split a shared edge at the same points
        ua, va, ub, vb = ub, vb, ua, va
        sign = -1.0
    if va == vb or va >= top or vb <= bottom:
        return
    slope = (ub - ua) / (vb - va)
    steepness = (vb - va) / abs(ub - ua) if ub != ua else 0.0
    if not steepness < np.inf:  # vertical up to rounding
        steepness = 0.0
    u_low, u_high = min(ua, ub), max(ua, ub)
    end = min(vb, float(top))
    row = int(max(va, float(bottom)))
    while row < end:
        low = max(va, float(row))
        high = min(vb, row + 1.0)
        left_u = ua if low == va else min(max(ua + (low - va) * slope, u_low), u_high)
        right_u = ub if high == vb else min(max(ua + (high - va) * slope, u_low), u_high)
        v_left = low - (row + 0.5)  # relative to the centre of the row
        direction = 1.0
        if left_u > right_u:
            left_u, right_u = right_u, left_u
            v_left = high - (row + 0.5)
            direction = -1.0
        if right_u > 0.0 or left_u == 0.0:  # pieces left of the map have no cell on their left
            rise = high - low
            i_row = row - bottom
            u = max(left_u, 0.0)
            climbed = (u - left_u) * steepness
            first = int(min(u, float(n_x)))
            column = first
            cell = np.uintp(i_row * n_columns + first - left)
            before = climbed
            while True:
                # An edge right of the map has every cell of the row on its left: it is assigned to column n_x.
                is_last = right_u <= column + 1.0 or column == n_x
                u_next = right_u if is_last else column + 1.0
                height = rise if is_last else (u_next - left_u) * steepness
                piece = sign * (height - climbed)
                cover[cell, 0] += piece
                if column < n_x:
                    cover[cell, 1] += piece * (0.5 * (u + u_next) - column)
                if moment.shape[0] > 0:
                    u_a, u_b = u - (column + 0.5), u_next - (column + 0.5)
                    v_a, v_b = v_left + direction * climbed, v_left + direction * height
                    u_mean, v_mean, spread = 0.5 * (u_a + u_b), 0.5 * (v_a + v_b), (u_b - u_a) / 12.0
                    moment[cell, 0] += piece * v_mean
                    moment[cell, 1] += 0.5 * piece * (u_mean * u_mean + (u_b - u_a) * spread - 0.25)
                    moment[cell, 2] += piece * (v_mean * (u_mean + 0.5) + (v_b - v_a) * spread)
                if is_last:
                    break
                u = u_next
                climbed = height
                column += 1
                cell += ONE
            k = np.uintp(i_row)
            rows[k, 0] += sign * (rise - before)
            rows[k, 1] += rise
            rows[k, 2] += column - first + 1
            _set_bits(touched, i_row * n_words, first - left, column - left)
        row += 1


@njit()
def _rounding(rows, i_row):
    """Return the rounding error of weights and moments in a row."""
    return NO_COVERAGE * rows[i_row, 1] * max(rows[i_row, 2] / 8.0, 1.0)


@njit()
def _write_row(columns, n_touched, left, cover, base, rows, i_row, n_x, site, row, spans, n_spans, weights, n_weights):
    """Append the spans of one row of one site; return the new counts and the covered area."""
    winding = rows[i_row, 0]  # weight of the cells before the next touched cell: sum of the heights from that cell on
    rounding = _rounding(rows, i_row)
    covered = 0.0
    column = 0  # the next column to be written
    is_open = False  # whether the last span can be extended
    i_span, i_weight = np.uintp(n_spans), np.uintp(n_weights)
    for k in range(np.uintp(n_touched)):
        at = left + columns[k]
        cell = np.uintp(base + columns[k])
        height = cover[cell, 0]
        is_run = at - column >= MIN_RUN
        n_cells, weight = at - column, winding
        for part in range(2):  # the cells before the touched one; the touched one
            if part == 1:
                column = at
                n_cells = 1 if at < n_x else 0
                weight = cover[cell, 1] + (winding - height)
            if n_cells == 0:
                continue
            if abs(weight) <= rounding:
                is_open = False
                continue
            if not is_open:
                spans[i_span, SITE] = site
                spans[i_span, ROW] = row
                spans[i_span, COLUMN] = column
                spans[i_span, N_PARTIAL] = 0
                spans[i_span, N_RUN] = 0
                i_span += ONE
            covered += weight * n_cells
            is_open = part == 1 or not is_run
            if is_open:
                spans[i_span - ONE, N_PARTIAL] += n_cells
                for _ in range(n_cells):
                    weights[i_weight] = weight
                    i_weight += ONE
            else:
                spans[i_span - ONE, N_RUN] = n_cells
                weights[i_weight] = weight
                i_weight += ONE
        winding -= height
        column = at + 1
    return np.int64(i_span), np.int64(i_weight), covered


@njit()
def _gradient_scale(index, n):
    """Return the reciprocal distance of the neighbours of the gradient; 0 along a single cell."""
    if n == 1:
        return 0.0
    return 0.5 if 0 < index < n - 1 else 1.0


@njit()
def _write_cuts(columns, n_touched, left, moment, base, rows, i_row, n_y, n_x, site, row, cuts, moments, n_cuts):
    """Append the cuts of one row of one site; return their new number."""
    tilt = 0.0  # moment along v of the cells before the next touched cell
    for k in range(np.uintp(n_touched)):
        tilt += moment[np.uintp(base + columns[k]), 0]
    rounding = _rounding(rows, i_row)
    column = 0  # the next column to be written
    along_v = _gradient_scale(row, n_y)
    i_cut = np.uintp(n_cuts)
    for k in range(np.uintp(n_touched)):
        at = left + columns[k]
        cell = np.uintp(base + columns[k])
        if abs(tilt) <= rounding:
            column = at
        for c in range(column, min(at + 1, n_x)):
            u_moment, v_moment = 0.0, tilt
            if c == at:
                u_moment, v_moment = moment[cell, 1], moment[cell, 2] + (tilt - moment[cell, 0])
            u_moment = u_moment if abs(u_moment) > rounding else 0.0
            v_moment = v_moment if abs(v_moment) > rounding else 0.0
            if u_moment != 0.0 or v_moment != 0.0:
                cuts[i_cut, SITE] = site
                cuts[i_cut, CUT_ROW] = row
                cuts[i_cut, COLUMN] = c
                moments[i_cut, 0] = u_moment * _gradient_scale(c, n_x)
                moments[i_cut, 1] = v_moment * along_v
                i_cut += ONE
        tilt -= moment[cell, 0]
        column = at + 1
    return np.int64(i_cut)


@njit()
def _sum_cells(cells, row, start, end):
    """Return the sum of the cells ``start`` to ``end - 1`` of a row, unsigned indices."""
    c = start
    total = 0.0
    if c + TWO_BLOCKS <= end:
        a0, a1, a2, a3, a4, a5, a6, a7 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        while c + EIGHT <= end:
            a0 += cells[row, c]
            a1 += cells[row, c + ONE]
            a2 += cells[row, c + TWO]
            a3 += cells[row, c + THREE]
            a4 += cells[row, c + FOUR]
            a5 += cells[row, c + FIVE]
            a6 += cells[row, c + SIX]
            a7 += cells[row, c + SEVEN]
            c += EIGHT
        total = ((a0 + a1) + (a2 + a3)) + ((a4 + a5) + (a6 + a7))
    # The first cells of a short rest without a loop, which the compiler would unroll, with a test for each number of cells.
    if c < end:
        total += cells[row, c]
        c += ONE
        if c < end:
            total += cells[row, c]
            c += ONE
            if c < end:
                total += cells[row, c]
                c += ONE
                while c < end:
                    total += cells[row, c]
                    c += ONE
    return total


@njit()
def _sum_row(columns, n_touched, left, cover, base, rows, i_row, cells, row):
    """Return the sum of weight x cell over one row of one site; as :func:`_write_row`."""
    n_x = cells.shape[1]
    winding = rows[i_row, 0]
    rounding = _rounding(rows, i_row)
    total = 0.0
    column = 0
    for k in range(np.uintp(n_touched)):
        at = left + columns[k]
        cell = np.uintp(base + columns[k])
        height = cover[cell, 0]
        if at > column and abs(winding) > rounding:
            total += winding * _sum_cells(cells, np.uintp(row), np.uintp(column), np.uintp(at))
        weight = cover[cell, 1] + (winding - height)
        if at < n_x and abs(weight) > rounding:
            total += weight * cells[np.uintp(row), np.uintp(at)]
        winding -= height
        column = at + 1
    return total


@njit()
def _sum_gradients(columns, n_touched, left, moment, base, rows, i_row, cells, row):
    """Return the sum of moment x gradient over one row of one site; as :func:`_write_cuts`."""
    n_y, n_x = cells.shape
    below, above = np.uintp(max(row - 1, 0)), np.uintp(min(row + 1, n_y - 1))
    along_v = _gradient_scale(row, n_y)
    tilt = 0.0
    for k in range(np.uintp(n_touched)):
        tilt += moment[np.uintp(base + columns[k]), 0]
    rounding = _rounding(rows, i_row)
    total = 0.0
    column = 0
    for k in range(np.uintp(n_touched)):
        at = left + columns[k]
        cell = np.uintp(base + columns[k])
        if at > column and abs(tilt) > rounding:
            start, end = np.uintp(column), np.uintp(at)
            total += along_v * tilt * (_sum_cells(cells, above, start, end) - _sum_cells(cells, below, start, end))
        if at < n_x:
            u_moment, v_moment = moment[cell, 1], moment[cell, 2] + (tilt - moment[cell, 0])
            if abs(u_moment) > rounding:
                before, after = np.uintp(max(at - 1, 0)), np.uintp(min(at + 1, n_x - 1))
                step = np.float64(cells[np.uintp(row), after]) - np.float64(cells[np.uintp(row), before])
                total += _gradient_scale(at, n_x) * u_moment * step
            if abs(v_moment) > rounding:
                c = np.uintp(at)
                total += along_v * v_moment * (np.float64(cells[above, c]) - np.float64(cells[below, c]))
        tilt -= moment[cell, 0]
        column = at + 1
    return total


@njit()
def _box(uv, start, stop, n_y, n_x):
    """Return bottom and top row, left column and number of columns of the cells in a box."""
    u_low, v_low, u_high, v_high = np.inf, np.inf, -np.inf, -np.inf
    for i in range(start, stop):
        u_low, u_high = min(u_low, uv[i, 0]), max(u_high, uv[i, 0])
        v_low, v_high = min(v_low, uv[i, 1]), max(v_high, uv[i, 1])
    if not (v_high > 0.0 and v_low < n_y):
        return 0, 0, 0, 0
    left = int(min(max(u_low, 0.0), float(n_x)))
    n_columns = int(min(max(u_high, 0.0), float(n_x))) - left + 1
    return int(np.floor(max(v_low, 0.0))), int(np.ceil(min(v_high, float(n_y)))), left, n_columns


@njit(types.Tuple((_float_list, _moment_list))(FLOATS_2D, INTS, INTS))
def measure_sites(xy, ring_offsets, site_offsets):
    """
    Return the signed area (n_site,) and the bounds (n_site, 4) of every site.

    Areas exclude holes and are negative for clockwise outlines. Bounds are x_min, y_min, x_max, y_max. Coordinates are taken
    relative to the first vertex of each ring, which preserves the precision of small rings far from the origin.
    """
    n_sites = site_offsets.size - 1
    areas = np.empty(n_sites, np.float64)
    bounds = np.empty((n_sites, 4), np.float64)
    for site in range(n_sites):
        twice = 0.0
        x_low, y_low, x_high, y_high = np.inf, np.inf, -np.inf, -np.inf
        for ring in range(site_offsets[site], site_offsets[site + 1]):
            start, stop = ring_offsets[ring], ring_offsets[ring + 1]
            x_0, y_0 = xy[start, 0], xy[start, 1]
            x_a, y_a = xy[stop - 1, 0] - x_0, xy[stop - 1, 1] - y_0
            for b in range(start, stop):
                x_low, x_high = min(x_low, xy[b, 0]), max(x_high, xy[b, 0])
                y_low, y_high = min(y_low, xy[b, 1]), max(y_high, xy[b, 1])
                x_b, y_b = xy[b, 0] - x_0, xy[b, 1] - y_0
                twice += x_a * y_b - y_a * x_b
                x_a, y_a = x_b, y_b
        areas[site] = 0.5 * twice
        bounds[site, 0], bounds[site, 1], bounds[site, 2], bounds[site, 3] = x_low, y_low, x_high, y_high
    return areas, bounds


@njit(types.boolean[::1](FLOATS_2D, INTS))
def find_reversed_edges(xy, ring_offsets):
    """Return whether the edge after each vertex begins at its lexicographically larger one."""
    is_reversed = np.empty(xy.shape[0], np.bool_)
    for ring in range(ring_offsets.size - 1):
        stop = ring_offsets[ring + 1]
        for a in range(ring_offsets[ring], stop):
            b = a + 1 if a + 1 < stop else ring_offsets[ring]
            is_reversed[a] = xy[b, 0] < xy[a, 0] or (xy[b, 0] == xy[a, 0] and xy[b, 1] < xy[a, 1])
    return is_reversed


@njit(types.Tuple((_moment_list, _moment_list))(FLOATS_2D, INTS, FLAGS))
def edges(xy, ring_offsets, is_reversed):
    """Return the start (n, 2) of the edge after each vertex, and the vector (n, 2) to its end."""
    start, along = np.empty((xy.shape[0], 2)), np.empty((xy.shape[0], 2))
    for ring in range(ring_offsets.size - 1):
        stop = ring_offsets[ring + 1]
        for a in range(ring_offsets[ring], stop):
            b = a + 1 if a + 1 < stop else ring_offsets[ring]
            first, last = (b, a) if is_reversed[a] else (a, b)
            start[a, 0], start[a, 1] = xy[first, 0], xy[first, 1]
            along[a, 0], along[a, 1] = xy[last, 0] - xy[first, 0], xy[last, 1] - xy[first, 1]
    return start, along


@njit()
def _add_rings(
    uv, ring_offsets, first_ring, last_ring, n_x, bottom, top, left, n_columns, rows, cover, moment, touched
):
    """Add the edges of rings to the cells of a box; see :func:`_add_edge`."""
    n_words = (n_columns + 63) >> 6
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        a = stop - 1
        for b in range(start, stop):
            _add_edge(
                uv[a, 0],
                uv[a, 1],
                uv[b, 0],
                uv[b, 1],
                n_x,
                bottom,
                top,
                left,
                n_columns,
                n_words,
                rows,
                cover,
                moment,
                touched,
            )
            a = b


@njit()
def _clear_row(columns, n_touched, base, i_row, rows, cover, moment):
    """Set the accumulators of a row to 0."""
    rows[i_row, 0] = 0.0
    rows[i_row, 1] = 0.0
    rows[i_row, 2] = 0.0
    for k in range(np.uintp(n_touched)):
        cell = np.uintp(base + columns[k])
        cover[cell, 0] = 0.0
        cover[cell, 1] = 0.0
        if moment.shape[0] > 0:
            moment[cell, 0] = 0.0
            moment[cell, 1] = 0.0
            moment[cell, 2] = 0.0


def accumulators(n_y: int, n_x: int, order: int) -> tuple[NDArray[Any], ...]:
    """Return the arrays of :func:`_add_edge` for the largest box, and a list of columns."""
    n_rows, n_cells = min(BOX_CELLS, n_y), min(max(BOX_CELLS, n_x + 1), n_y * (n_x + 1))
    return (
        np.zeros((n_rows, 3)),
        np.zeros((n_cells, 2)),
        np.zeros((n_cells if order == 2 else 0, 3)),
        np.zeros(n_rows + n_cells // 64 + 1, np.uint64),
        np.empty(n_x + 1, np.int64),
    )


@njit(
    types.void(
        FLOATS_2D,
        INTS,
        INTS,
        _count,
        _count,
        _count,
        _moment_list,
        _moment_list,
        _moment_list,
        types.uint64[::1],
        _int_list,
        _float_list,
        _span_list,
        _float_list,
        _cut_list,
        _moment_list,
        _int_list,
    ),
    allocates=False,
)
def trace_rows(
    uv,
    ring_offsets,
    site_offsets,
    first_site,
    n_y,
    n_x,
    rows,
    cover,
    moment,
    touched,
    columns,
    covered,
    spans,
    weights,
    cuts,
    moments,
    progress,
):
    """
    Append rows of sites to lists, until all are written or a further row may not fit.

    The lists are those of :func:`trace_sites`, the other arrays those of :func:`accumulators`. ``progress``: the site and the
    row with which a next call continues (-1: the first row), and the numbers of spans, weights and cuts.
    """
    has_moments = moment.shape[0] > 0
    row, is_added = progress[1], progress[1] >= 0
    n_spans, n_weights, n_cuts = np.int64(0), np.int64(0), np.int64(0)  # a literal 0 would be a further type
    for i_site in range(progress[0], site_offsets.size - 1):
        first_ring, last_ring = site_offsets[i_site], site_offsets[i_site + 1]
        first_row, last_row, left, n_columns = _box(uv, ring_offsets[first_ring], ring_offsets[last_ring], n_y, n_x)
        n_words = (n_columns + 63) >> 6
        step = max(1, BOX_CELLS // max(n_columns, 1))
        if not is_added:
            row = first_row
        while row < last_row:
            bottom = first_row + (row - first_row) // step * step
            top = min(bottom + step, last_row)
            if not is_added:
                _add_rings(
                    uv,
                    ring_offsets,
                    first_ring,
                    last_ring,
                    n_x,
                    bottom,
                    top,
                    left,
                    n_columns,
                    rows,
                    cover,
                    moment,
                    touched,
                )
            is_added = False
            while row < top:
                # A touched cell adds at most two spans, its own weight, and one weight of a run or the weights of a short run.
                is_full = n_spans + 2 * n_columns > spans.shape[0] or n_weights + MIN_RUN * n_columns > weights.size
                if is_full or (has_moments and n_cuts + n_x > cuts.shape[0]):
                    progress[0], progress[1], progress[2], progress[3], progress[4] = (
                        i_site,
                        row,
                        n_spans,
                        n_weights,
                        n_cuts,
                    )
                    return
                i_row, base = np.uintp(row - bottom), (row - bottom) * n_columns
                n_touched = _touched_columns(touched, (row - bottom) * n_words, n_words, columns)
                n_spans, n_weights, area = _write_row(
                    columns,
                    n_touched,
                    left,
                    cover,
                    base,
                    rows,
                    i_row,
                    n_x,
                    first_site + i_site,
                    row,
                    spans,
                    n_spans,
                    weights,
                    n_weights,
                )
                covered[i_site] += area
                if has_moments:
                    n_cuts = _write_cuts(
                        columns,
                        n_touched,
                        left,
                        moment,
                        base,
                        rows,
                        i_row,
                        n_y,
                        n_x,
                        first_site + i_site,
                        row,
                        cuts,
                        moments,
                        n_cuts,
                    )
                _clear_row(columns, n_touched, base, i_row, rows, cover, moment)
                row += 1
    progress[0], progress[1], progress[2], progress[3], progress[4] = (
        site_offsets.size - 1,
        -1,
        n_spans,
        n_weights,
        n_cuts,
    )


def trace_sites(
    uv: NDArray[Any], ring_offsets: Ints, site_offsets: Ints, first_site: int, n_y: int, n_x: int, order: int
) -> tuple[NDArray[Any], ...]:
    """
    Return the spans of sites on a grid of ``n_y`` rows and ``n_x`` columns.

    ``first_site`` is the index of the first site. Let ``F(u)`` be the integral of the map along a row from its left end to
    ``u``. The integral over a polygon is then the sum over its edges of (signed height) x (mean of F). Edges are split at
    cell boundaries; a piece of height ``d`` with its midpoint at ``u_m`` in column ``c`` adds the weight ``d * (u_m - c)``
    to cell ``c`` and ``d`` to every cell to the left. Areas outside the grid contribute 0. The moments are computed from the
    same pieces.

    Returns ``spans`` (n_span, 5) int32: site by site, sorted by row and column within each site. ``weights`` (n_weight,)
    float64: per span its ``n_partial`` weights, followed by one weight for the run if ``n_run > 0``. ``cuts`` (n_cut, 3)
    int32: in the order of the spans at second order; empty at first order. ``moments`` (n_cut, 2) float64. ``covered``
    (n_site,) float64, cells: area of each site on the grid.
    """
    n_sites = site_offsets.size - 1
    covered = np.zeros(n_sites)
    boxes = accumulators(n_y, n_x, order)
    progress = np.array([0, -1, 0, 0, 0])
    parts = []
    while progress[0] < n_sites:
        n_cuts = 16 * n_sites + n_x if order == 2 else 0
        lists: tuple[NDArray[Any], ...] = (
            np.empty((16 * n_sites + 2 * (n_x + 1), 5), np.int32),
            np.empty(64 * n_sites + MIN_RUN * (n_x + 1)),
            np.empty((n_cuts, 3), np.int32),
            np.empty((n_cuts, 2)),
        )
        trace_rows(uv, ring_offsets, site_offsets, first_site, n_y, n_x, *boxes, covered, *lists, progress)
        parts.append([array[:n] for array, n in zip(lists, progress[[2, 3, 4, 4]], strict=True)])
    return *map(np.concatenate, zip(*parts, strict=True)), covered


@njit(
    types.void(_spans, FLOATS, _int_list, _int_list, INTS, _count, _span_list, _float_list),
)
def sort_spans(spans, weights, next_span, next_weight, first_slot, rows_per_band, out_spans, out_weights):
    """
    Copy spans from site order into row order.

    ``next_span[row]`` and ``next_weight[row]`` are the positions of the next span and weights of the row; they are advanced.
    A site has one accumulator, a *slot*, for each band of rows that it reaches. The index of the site is replaced by
    ``first_slot[site]`` minus the first band of the site plus the band.
    """
    p = 0
    for i in range(spans.shape[0]):
        row = spans[i, ROW]
        to = next_span[row]
        next_span[row] += 1
        out_spans[to, SITE] = first_slot[spans[i, SITE]] + row // rows_per_band
        out_spans[to, COLUMN] = spans[i, COLUMN]
        out_spans[to, N_PARTIAL] = spans[i, N_PARTIAL]
        out_spans[to, N_RUN] = spans[i, N_RUN]
        n = spans[i, N_PARTIAL] + (1 if spans[i, N_RUN] > 0 else 0)
        at = next_weight[row]
        next_weight[row] += n
        for k in range(n):
            out_weights[at + k] = weights[p + k]
        p += n


@njit(
    types.void(_cuts, FLOATS_2D, _int_list, INTS, _count, _cut_list, _moment_list),
)
def sort_cuts(cuts, moments, next_cut, first_slot, rows_per_band, out_cuts, out_moments):
    """Copy cuts and their moments into row order, as :func:`sort_spans`."""
    i = 0
    while i < cuts.shape[0]:
        site, row = cuts[i, SITE], cuts[i, CUT_ROW]
        slot = first_slot[site] + row // rows_per_band
        to = next_cut[row]
        while i < cuts.shape[0] and cuts[i, CUT_ROW] == row and cuts[i, SITE] == site:
            out_cuts[to, SITE] = slot
            out_cuts[to, COLUMN] = cuts[i, COLUMN]
            out_moments[to, 0] = moments[i, 0]
            out_moments[to, 1] = moments[i, 1]
            to += 1
            i += 1
        next_cut[row] = to


@njit()
def _add_gradients(cells, row, cuts, first, last, moments, slots):
    """Add moment x gradient over cuts of a row to the slots, from unsigned indices."""
    n_y, n_x = np.uintp(cells.shape[0]), np.uintp(cells.shape[1])
    below, above = row - ONE if row > ZERO else row, row + ONE if row + ONE < n_y else row
    for i in range(first, last):
        c = np.uintp(cuts[i, COLUMN])
        before, after = c - ONE if c > ZERO else c, c + ONE if c + ONE < n_x else c
        # numpy's type: ``float`` of a float32 is a float32 in numba.
        along_u = np.float64(cells[row, after]) - np.float64(cells[row, before])
        along_v = np.float64(cells[above, c]) - np.float64(cells[below, c])
        slots[np.uintp(cuts[i, SITE])] += moments[i, 0] * along_u + moments[i, 1] * along_v


@njit()
def _add_spans(cells, row, spans, first, last, weights, p, where, blocks, slots):
    """Add weight x cell over spans of a row to the slots, from unsigned indices."""
    for b in range(np.uintp(blocks.size)):
        total = 0.0
        for k in range(EIGHT):
            total += cells[row, b * EIGHT + k]
        blocks[b] = total
    is_chosen = where.size > 0
    for i in range(first, last):
        slot, column = np.uintp(spans[i, SITE]), np.uintp(spans[i, COLUMN])
        n_partial, n_run = np.uintp(spans[i, N_PARTIAL]), np.uintp(spans[i, N_RUN])
        if is_chosen and not where[slot]:
            p += n_partial + (ONE if n_run > ZERO else ZERO)
            continue
        total = 0.0
        for _ in range(n_partial):
            total += weights[p] * cells[row, column]
            p += ONE
            column += ONE
        if n_run > ZERO:
            end = column + n_run
            first_block, last_block = (column + SEVEN) // EIGHT, end // EIGHT
            inside = 0.0
            if last_block > first_block:
                while column < first_block * EIGHT:
                    inside += cells[row, column]
                    column += ONE
                for b in range(first_block, last_block):
                    inside += blocks[b]
                column = last_block * EIGHT
            while column < end:
                inside += cells[row, column]
                column += ONE
            total += weights[p] * inside
            p += ONE
        slots[slot] += total


@njit(
    [
        types.void(
            array_of(cell, 2), _count, _count, INTS, INTS, _spans, FLOATS, INTS, _cuts, FLOATS_2D, FLAGS, _float_list
        )
        for cell in (types.float32, types.float64)
    ],
)
def gather(cells, first_row, last_row, row_spans, row_weights, spans, weights, row_cuts, cuts, moments, where, slots):
    """
    Add weight x cell over the rows ``first_row .. last_row - 1`` of a map to the slots.

    Slots where ``where`` is False are not computed; an empty array stands for all True.

    The map is read in a single pass: each row is summed in blocks of ``BLOCK`` cells, which the runs of spans use. The four
    neighbours of a cell in ``cuts`` are read again for moment x gradient while they are in the processor cache.
    """
    blocks = np.empty(cells.shape[1] // BLOCK, np.float64)
    for row in range(first_row, last_row + 2):
        if row >= first_row + 2:  # both adjacent rows have been read
            first, last = np.uintp(row_cuts[row - 2]), np.uintp(row_cuts[row - 1])
            _add_gradients(cells, np.uintp(row - 2), cuts, first, last, moments, slots)
        if row < last_row and row_spans[row] < row_spans[row + 1]:
            first, last = np.uintp(row_spans[row]), np.uintp(row_spans[row + 1])
            p = np.uintp(row_weights[row])
            _add_spans(cells, np.uintp(row), spans, first, last, weights, p, where, blocks, slots)


@njit(
    types.void(FLOATS, _count, _count, INTS, INTS, _spans, FLOATS, INTS, _cuts, FLOATS_2D, _moment_list),
)
def scatter(values, first_row, last_row, row_spans, row_weights, spans, weights, row_cuts, cuts, moments, cells):
    """
    Add weight x (value of the slot) to the cells of rows: the adjoint of gather.

    Cuts in the adjacent rows outside the range contribute to the rows inside. Rows outside the range are not written, because
    another call computes them.
    """
    n_y, n_x = cells.shape
    for row in range(first_row, last_row):
        p = row_weights[row]
        for i in range(row_spans[row], row_spans[row + 1]):
            value = values[spans[i, SITE]]
            column = spans[i, COLUMN]
            for _ in range(spans[i, N_PARTIAL]):
                cells[row, column] += weights[p] * value
                column += 1
                p += 1
            if spans[i, N_RUN] > 0:
                for _ in range(spans[i, N_RUN]):
                    cells[row, column] += weights[p] * value
                    column += 1
                p += 1
        for i in range(row_cuts[row], row_cuts[row + 1]):
            c = cuts[i, COLUMN]
            along_u = moments[i, 0] * values[cuts[i, SITE]]
            cells[row, min(c + 1, n_x - 1)] += along_u
            cells[row, max(c - 1, 0)] -= along_u
    for row in range(max(first_row - 1, 0), min(last_row + 1, n_y)):
        for neighbour, sign in ((min(row + 1, n_y - 1), 1.0), (max(row - 1, 0), -1.0)):
            if first_row <= neighbour < last_row:
                for i in range(row_cuts[row], row_cuts[row + 1]):
                    cells[neighbour, cuts[i, COLUMN]] += sign * moments[i, 1] * values[cuts[i, SITE]]


@njit(
    [
        types.void(array_of(types.int32), array_of(types.int32), array_of(real), array_of(real, 2), real[:, ::1])
        for real in (types.float32, types.float64)
    ]
)
def multiply_rows(row_begin, column, weights, cells, sums):
    """
    Write the products of a sparse matrix in CSR format with rows of cells.

    ``cells`` is (n, n_column), ``sums`` (n, n_row).
    """
    for site in range(sums.shape[1]):
        for k in range(sums.shape[0]):
            total = 0.0  # in double precision: a site may have many cells
            for i in range(np.uintp(row_begin[site]), np.uintp(row_begin[site + 1])):
                total += weights[i] * cells[k, np.uintp(column[i])]
            sums[k, site] = total
