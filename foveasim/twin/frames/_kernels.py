"""Numba kernels of twins: sums over the frames of a stack, and over classes of pixels."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import INTS, array_of

#: Codes whose sum has 32 bits.
MAX_SUMMED = 1 << 16

_codes = [array_of(kind, 2) for kind in (types.uint8, types.uint16)]
_any = types.Array(types.float64, 2, "A", readonly=True)


@njit(
    [
        types.void(
            *[codes] * 8, types.int64, types.int64, types.int64, types.float64, types.uint32[:, ::1], types.float64[:, ::1],
            types.int64[:, ::1], types.uint32[:, ::1], types.int64[::1], INTS, types.uint16[:, :, ::1],
        )
        for codes in _codes
    ],
    allocates=False,
    fastmath={"contract"},
)  # fmt: skip
def add_frames(
    a, b, c, d, e, f, g, h, n_frames, first, last, centre, sums, squares, rows, columns, found, chosen, samples
):
    """
    Add rows ``first`` to ``last`` of eight frames to the sums of pixels and lines.

    Codes are (n_y, n_x). Only ``n_frames`` frames count; the others must be 0. ``sums`` and ``squares`` (n_y, n_x): ``sums``
    and ``squares_dn2`` of ``StackSums``, with ``centre``. ``rows`` (8, n_y), ``columns`` (8, n_x): sums of lines. ``found``
    (3,): number of zeros, highest code, and bits that occur. ``samples`` (8, n_row, n_column): codes of every second row in
    ``chosen`` columns.

    Sums of pixels are read and written once for all frames, whose rows then are in the cache.
    """
    frames = (a, b, c, d, e, f, g, h)
    n_x = sums.shape[1]
    width = np.float64(n_x)
    for y in range(first, last):
        for k in range(n_frames):
            codes, column = frames[k][y], columns[k]
            for start in range(0, n_x, MAX_SUMMED):
                part, of_part = codes[start : start + MAX_SUMMED], column[start : start + MAX_SUMMED]
                total = np.uint32(0)
                for x in range(part.size):
                    of_part[x] = np.uint32(of_part[x] + part[x])
                    total = np.uint32(total + part[x])
                rows[k, y] += total
            if y % 2 == 0:
                for j in range(chosen.size):
                    samples[k, y // 2, j] = codes[chosen[j]]
            lowest, highest, bits = codes[0], codes[0], np.uint16(0)
            for x in range(n_x):
                lowest, highest = min(lowest, codes[x]), max(highest, codes[x])
            for x in range(n_x):
                bits = np.uint16(bits | codes[x])
            if lowest == 0:
                for x in range(n_x):
                    found[0] += codes[x] == 0
            found[1] = max(found[1], np.int64(highest))
            found[2] |= np.int64(bits)
        a_y, b_y, c_y, d_y, e_y, f_y, g_y, h_y = a[y], b[y], c[y], d[y], e[y], f[y], g[y], h[y]
        sums_y, squares_y = sums[y], squares[y]
        for x in range(n_x):
            first_four = (np.uint32(a_y[x]) + b_y[x]) + (np.uint32(c_y[x]) + d_y[x])
            last_four = (np.uint32(e_y[x]) + f_y[x]) + (np.uint32(g_y[x]) + h_y[x])
            sums_y[x] = np.uint32(sums_y[x] + (first_four + last_four))
        # A frame of zeros adds -centre (0 - twice) = 0.
        shift = width * centre
        a_t = 2.0 * rows[0, y] - shift if n_frames > 0 else 0.0
        b_t = 2.0 * rows[1, y] - shift if n_frames > 1 else 0.0
        c_t = 2.0 * rows[2, y] - shift if n_frames > 2 else 0.0
        d_t = 2.0 * rows[3, y] - shift if n_frames > 3 else 0.0
        e_t = 2.0 * rows[4, y] - shift if n_frames > 4 else 0.0
        f_t = 2.0 * rows[5, y] - shift if n_frames > 5 else 0.0
        g_t = 2.0 * rows[6, y] - shift if n_frames > 6 else 0.0
        h_t = 2.0 * rows[7, y] - shift if n_frames > 7 else 0.0
        for x in range(n_x):
            a_v, b_v = np.float64(np.int32(a_y[x])), np.float64(np.int32(b_y[x]))
            c_v, d_v = np.float64(np.int32(c_y[x])), np.float64(np.int32(d_y[x]))
            e_v, f_v = np.float64(np.int32(e_y[x])), np.float64(np.int32(f_y[x]))
            g_v, h_v = np.float64(np.int32(g_y[x])), np.float64(np.int32(h_y[x]))
            ab = (a_v - centre) * (width * a_v - a_t) + (b_v - centre) * (width * b_v - b_t)
            cd = (c_v - centre) * (width * c_v - c_t) + (d_v - centre) * (width * d_v - d_t)
            ef = (e_v - centre) * (width * e_v - e_t) + (f_v - centre) * (width * f_v - f_t)
            gh = (g_v - centre) * (width * g_v - g_t) + (h_v - centre) * (width * h_v - h_t)
            squares_y[x] += (ab + cd) + (ef + gh)


@njit(types.void(array_of(types.uint16, 3), types.uint32[:, ::1]), allocates=False)
def count_codes(samples, counts):
    """Count codes (n_frame, n_row, n_column) in each column, (n_column, n_code)."""
    for k in range(samples.shape[0]):
        for y in range(samples.shape[1]):
            for j in range(samples.shape[2]):
                counts[j, samples[k, y, j]] += np.uint32(1)


@njit(
    types.void(_any, array_of(types.int8, 2), _any, types.int64, types.int64, types.float64[:, :, ::1]), allocates=False
)
def add_classes(values, classes, share, first, last, totals):
    """
    Add the weights and weighted values of rows to those of their classes.

    ``values``, ``classes``, ``share`` (n_y, n_x): classes from 0, or -1 for none. ``totals`` (n_class, n_y, 2): of each row.
    """
    for y in range(first, last):
        for x in range(classes.shape[1]):
            k = classes[y, x]
            if k >= 0:
                totals[k, y, 0] += share[y, x]
                totals[k, y, 1] += share[y, x] * values[y, x]
