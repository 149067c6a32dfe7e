"""Numba kernels of twins: sums over the frames of a stack."""

from __future__ import annotations

from numba import types

from foveasim._core.jit import njit

_codes = [types.Array(kind, 3, "C", readonly=True) for kind in (types.uint8, types.uint16)]
_sums = types.int64[:, ::1]


@njit([types.void(codes, _sums, _sums, _sums, _sums, _sums, types.int64[::1]) for codes in _codes])
def add_frames(codes, sums, squares, products, rows, columns, found):
    """
    Add codes (n_frame, n_y, n_x) to the sums of pixels and lines.

    Of pixels: sums, squares and products with the sum of the row, (n_y, n_x).

    ``rows`` (n_frame, n_y) and ``columns`` (n_frame, n_x). Rows of a frame are next to each other in memory, so that sums of
    one row stay in the cache for all frames. ``found`` (3,): number of zeros, highest code, and bits that occur.
    """
    for y in range(codes.shape[1]):
        for k in range(codes.shape[0]):
            total, n_zeros, highest, bits = types.int64(0), types.int64(0), types.int64(0), types.int64(0)
            for x in range(codes.shape[2]):
                value = types.int64(codes[k, y, x])
                total += value
                sums[y, x] += value
                squares[y, x] += value * value
                columns[k, x] += value
                n_zeros += value == 0
                highest = max(highest, value)
                bits |= value
            rows[k, y] += total
            found[0] += n_zeros
            found[1] = max(found[1], highest)
            found[2] |= bits
            for x in range(codes.shape[2]):
                products[y, x] += total * types.int64(codes[k, y, x])
