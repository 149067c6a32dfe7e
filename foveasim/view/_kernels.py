"""Numba kernels that rasterise photosites and average the colours of pixels."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, INTS, array_of

_ids = array_of(types.int32, 2)
_colours = array_of(types.float32, 2)
_encoded = array_of(types.uint8)
_light = array_of(types.float32, 3)
_bits = array_of(types.uint64, 2)
#: Odd multipliers of hashes: 2⁶⁴ divided by the golden ratio, and a prime of xxHash64.
_MIX, _PRIME = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)
_HALF_WORD = np.uint64(32)
_ZERO, _HALF, _ONE, _BYTES = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)
#: Places of a hash table that are read at once.
LOOKAHEAD = 64
#: More edges of one position are sorted.
MANY_EDGES = 16
#: Samples over a shorter length than this are at one position.
MIN_LENGTH = 1e-200


@njit()
def _samples_per_length(samples):
    """Return the number of evenly spaced samples per unit length; 0 for a single sample."""
    length = samples[-1] - samples[0]
    return (samples.size - 1) / length if length > MIN_LENGTH else 0.0


@njit()
def _searchsorted_uniform(samples, samples_per_length, value):
    """Return the index of the first of ascending, evenly spaced samples >= a value; exact."""
    if value <= samples[0]:
        return 0
    if value > samples[-1]:
        return samples.size
    k = int((value - samples[0]) * samples_per_length) + 1
    # The estimate has rounding errors; comparison with the samples makes it exact.
    while k == samples.size or samples[k - 1] >= value:
        k -= 1
    while samples[k] < value:
        k += 1
    return k


@njit(types.void(FLOATS_2D, INTS, FLOATS, FLOATS, types.int64, types.int32[:, ::1]))
def rows_of_sites(xy, starts, x, y, first, rows):
    """
    Compute the range of sample rows that each site covers.

    The range is empty for a site between rows, or outside all columns. Site ``first + i`` has the vertices
    ``starts[first + i] : starts[first + i + 1]``; first row and end of its range are written to ``rows[i]``.
    """
    per_y = _samples_per_length(y)
    for i in range(rows.shape[0]):
        low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
        for k in range(starts[first + i], starts[first + i + 1]):
            low_x, high_x = min(low_x, xy[k, 0]), max(high_x, xy[k, 0])
            low_y, high_y = min(low_y, xy[k, 1]), max(high_y, xy[k, 1])
        rows[i] = 0
        if low_x <= x[-1] and high_x >= x[0]:
            rows[i, 0] = _searchsorted_uniform(y, per_y, low_y)
            rows[i, 1] = _searchsorted_uniform(y, per_y, high_y)


@njit(types.void(FLOATS_2D, INTS, INTS, _ids, FLOATS, FLOATS, types.int64, types.int32[:, ::1]))
def paint_sites(xy, ring_offsets, site_offsets, rows, x, y, first_row, ids):
    """
    Write the index of the site at each sample of a band of rows.

    Where sites overlap, the highest index is written; samples without a site are not changed. Even-odd rule: an edge is crossed
    by the rows from its lower end (included) to its upper end (excluded), and toggles inside and outside for the samples at and
    beyond the crossing. The crossing is always computed from the lower end, so that both sites of a shared edge find the same
    samples.
    """
    n_rows, n_columns = ids.shape
    per_x, per_y = _samples_per_length(x), _samples_per_length(y)
    crossed = np.zeros((n_rows, n_columns + 1), np.bool_)
    left = np.full(n_rows, n_columns + 1)
    right = np.full(n_rows, -1)
    for site in range(site_offsets.size - 1):
        bottom, top = max(rows[site, 0] - first_row, 0), min(rows[site, 1] - first_row, n_rows)
        if bottom >= top:
            continue
        for ring in range(site_offsets[site], site_offsets[site + 1]):
            a = ring_offsets[ring + 1] - 1
            for b in range(ring_offsets[ring], ring_offsets[ring + 1]):
                low, high = (a, b) if xy[a, 1] < xy[b, 1] else (b, a)
                a = b
                low_y, high_y = xy[low, 1], xy[high, 1]
                if low_y == high_y or high_y <= y[first_row + bottom] or low_y > y[first_row + top - 1]:
                    continue
                run, rise = xy[high, 0] - xy[low, 0], high_y - low_y
                r = max(_searchsorted_uniform(y, per_y, low_y) - first_row, bottom)
                while r < top and y[first_row + r] < high_y:
                    # Multiply before dividing: exact for integer coordinates with an integer crossing.
                    c = _searchsorted_uniform(x, per_x, xy[low, 0] + (y[first_row + r] - low_y) * run / rise)
                    crossed[r, c] = not crossed[r, c]
                    left[r], right[r] = min(left[r], c), max(right[r], c)
                    r += 1
        for r in range(bottom, top):
            is_inside = False
            for c in range(left[r], right[r] + 1):
                if crossed[r, c]:
                    is_inside = not is_inside
                    crossed[r, c] = False
                if is_inside:
                    ids[r, c] = site
            left[r], right[r] = n_columns + 1, -1


@njit(types.void(_ids, _colours, _encoded, types.int64, types.boolean, types.int64, types.uint8[:, :, ::1]))
def blend(ids, colours, encoded, n_samples, has_boundaries, first_row, band):
    """
    Average the samples of each pixel in a band of rows, in linear light.

    A pixel has ``n_samples`` x ``n_samples`` samples. ``colours[i + 1]`` (red, green, blue, weight) is the colour of site i
    from 0 to 1, ``colours[0]`` that of the background, and the last one, if ``has_boundaries``, that of samples whose left or
    lower neighbour belongs to another site. Weights are 0 or 1; alpha is their mean. ``encoded`` is the byte of each of evenly
    spaced levels from 0 to 1.
    """
    boundary = colours.shape[0] - 1
    levels = encoded.size - 1
    for row in range(band.shape[0]):
        for column in range(band.shape[1]):
            red, green, blue, n = 0.0, 0.0, 0.0, 0
            for i in range((first_row + row) * n_samples, (first_row + row + 1) * n_samples):
                for j in range(column * n_samples, (column + 1) * n_samples):
                    k = ids[i, j] + 1
                    if has_boundaries and (ids[i, max(j - 1, 0)] != k - 1 or ids[max(i - 1, 0), j] != k - 1):
                        k = boundary
                    if colours[k, 3] != 0.0:
                        red += colours[k, 0]
                        green += colours[k, 1]
                        blue += colours[k, 2]
                        n += 1
            scale = levels / max(n, 1)
            band[row, column, 0] = encoded[int(red * scale + 0.5)]
            band[row, column, 1] = encoded[int(green * scale + 0.5)]
            band[row, column, 2] = encoded[int(blue * scale + 0.5)]
            band[row, column, 3] = (255 * n + n_samples * n_samples // 2) // (n_samples * n_samples)


@njit(types.void(_light, array_of(types.float32, 2), _encoded, types.uint8[:, :, ::1]))
def encode_pixels(light, coverage, encoded, pixels):
    """
    Store linear light and coverage as bytes (n_y, n_x, 4), top row first.

    ``light``: (1 or 3, n_y, n_x). Light and coverage are limited to 0 to 1, NaN is 0. ``encoded`` is the byte of each of
    evenly spaced levels from 0 to 1.
    """
    n_y, n_x = coverage.shape
    n_levels = np.float32(encoded.size - 1)
    for row in range(n_y):
        for channel in range(3):
            part = light[min(channel, light.shape[0] - 1), n_y - 1 - row]
            for column in range(n_x):
                level = part[column] * n_levels
                pixels[row, column, channel] = encoded[int(min(level, n_levels)) if level > _ZERO else 0]
        for column in range(n_x):
            covered = min(max(coverage[n_y - 1 - row, column], _ZERO), _ONE)
            pixels[row, column, 3] = int(_BYTES * covered + _HALF)


@njit(types.float64[::1](FLOATS_2D, INTS, INTS))
def smallest_fan_triangles(xy, first, end):
    """
    Return the smallest signed area of the triangles of fans, (n,).

    Each fan is that from the first vertex of a ring. The i-th ring has the vertices ``first[i] : end[i]``.
    """
    smallest = np.empty(first.size)
    for i in range(first.size):
        x, y = xy[first[i], 0], xy[first[i], 1]
        ax, ay = xy[first[i] + 1, 0] - x, xy[first[i] + 1, 1] - y
        found = np.inf
        for v in range(first[i] + 2, end[i]):
            bx, by = xy[v, 0] - x, xy[v, 1] - y
            found = min(found, 0.5 * (ax * by - ay * bx))
            ax, ay = bx, by
        smallest[i] = found
    return smallest


@njit()
def _slot(a, b, mask):
    """Return the first place of a pair of 64-bit integers in a hash table."""
    mixed = (a * _MIX) ^ ((b + _MIX) * _PRIME)
    return np.int64((mixed ^ (mixed >> _HALF_WORD)) * _PRIME >> _HALF_WORD) & mask


@njit()
def _table_size(n):
    """Return the size of a hash table of n values, at most half full, a power of 2."""
    size = 16
    while size < 2 * n:
        size *= 2
    return size


@njit(types.int64(_bits, types.int64[::1], types.int64[::1]))
def number_points(bits, position, first):
    """
    Number points by their first occurrence, and return the number of distinct ones.

    ``bits`` (n, 2): their coordinates, equal where the points are. The number of each point is written to ``position``, and the
    first point of each number to ``first``.
    """
    table = np.full(_table_size(bits.shape[0]), -1, np.int32)
    places, entries = np.empty(LOOKAHEAD, np.int64), np.empty(LOOKAHEAD, np.int32)
    n_found = 0
    for begin in range(0, bits.shape[0], LOOKAHEAD):
        n = min(LOOKAHEAD, bits.shape[0] - begin)
        for k in range(n):
            places[k] = _slot(bits[begin + k, 0], bits[begin + k, 1], table.size - 1)
        for k in range(n):  # without branches: the processor waits for all of them at once
            entries[k] = table[places[k]]
        for k in range(n):
            i, at, entry = begin + k, places[k], entries[k]
            if entry < 0:  # unless one of the points before is there now
                entry = table[at]
            while entry >= 0:
                known = first[entry]
                if bits[known, 0] == bits[i, 0] and bits[known, 1] == bits[i, 1]:
                    break
                at = (at + 1) & (table.size - 1)
                entry = table[at]
            if entry < 0:
                table[at] = entry = n_found
                first[n_found] = i
                n_found += 1
            position[i] = entry
    return n_found


@njit(types.int64[:, ::1](INTS, INTS))
def outer_edges(position, ring_offsets):
    """
    Return the edges of rings that no other edge coincides with, pairs of positions (n, 2).

    ``position``: number of each vertex of the rings, equal where the vertices are.
    """
    n_edges, n_positions = position.size, 0
    for v in range(n_edges):
        n_positions = max(n_positions, position[v] + 1)
    # The edges by their lower position: twice the higher one, and 1 if it is the first one. The numbers of edges of each
    # lower position, then their ends.
    end, edges = np.zeros(n_positions + 1, np.int64), np.empty(n_edges, np.int64)
    for is_filling in range(2):
        for ring in range(ring_offsets.size - 1):
            a = position[ring_offsets[ring + 1] - 1]
            for v in range(ring_offsets[ring], ring_offsets[ring + 1]):
                b = position[v]
                low = min(a, b)
                if is_filling:
                    edges[end[low]] = 2 * max(a, b) + (a > b)
                    end[low] += 1
                else:
                    end[low + 1] += 1
                a = b
        if not is_filling:
            for low in range(n_positions):
                end[low + 1] += end[low]
    outer, n_outer, begin = np.empty((n_edges, 2), np.int64), 0, 0
    for low in range(n_positions):
        is_sorted = end[low] - begin > MANY_EDGES  # such as those at the centre of sectors
        if is_sorted:
            edges[begin : end[low]].sort()
        for k in range(begin, end[low]):
            high, n_equal = edges[k] >> 1, 0
            first, last = (max(begin, k - 1), min(k + 2, end[low])) if is_sorted else (begin, end[low])
            for other in range(first, last):
                n_equal += edges[other] >> 1 == high
            if n_equal == 1:
                outer[n_outer, 0] = high if edges[k] & 1 else low
                outer[n_outer, 1] = low if edges[k] & 1 else high
                n_outer += 1
        begin = end[low]
    return outer[:n_outer].copy()
