"""Numba kernels of GDSII and OASIS files: records of a file, and regular arrays."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit

_bytes = types.Array(types.uint8, 1, "C", readonly=True)
_flags = types.Array(types.boolean, 1, "C", readonly=True)


@njit(types.UniTuple(types.int64, 2)(_bytes, _flags, types.int64))
def walk_records(data, is_known, last):
    """
    Follow the records up to type ``last``, an invalid record, or the end of the data.

    Returns ``at``: final position, behind the last record; beyond the data if that record is incomplete. ``record``: type of
    the last record, with its data type; -1 if no valid record begins at ``at``.
    """
    at, record = 0, 0
    while at + 4 <= data.size and record != last:
        length = np.int64(data[at]) << 8 | np.int64(data[at + 1])
        record = np.int64(data[at + 2]) << 8 | np.int64(data[at + 3])
        if length < 4 or length & 1 or not is_known[record]:
            return at, -1
        at += length
    return at, record


_table = types.Array(types.int64, 2, "C", readonly=True)
_keys = types.Array(types.int64, 1, "C", readonly=True)


@njit(types.Array(types.boolean, 1, "C")(_table, _keys, types.int64))
def progressions(rows, group, at_most):
    """
    Divide rows into arithmetic progressions.

    Successive rows of a progression have a constant difference, and are in the same group.

    ``rows``: (n, k) int64. ``group`` (n,) int64: rows of different groups are in different progressions. ``at_most``: maximum
    length of a progression. Returns ``is_first`` (n,) bool: whether a row is the first of its progression.
    """
    n, k = rows.shape
    is_first = np.zeros(n, np.bool_)
    start = 0
    while start < n:
        is_first[start] = True
        stop = start + 1
        while stop < n and stop - start < at_most and group[stop] == group[start]:
            if stop > start + 1:
                is_regular = True
                for c in range(k):
                    if rows[stop, c] - rows[stop - 1, c] != rows[start + 1, c] - rows[start, c]:
                        is_regular = False
                        break
                if not is_regular:
                    break
            stop += 1
        start = stop
    return is_first
