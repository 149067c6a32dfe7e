"""The layout files' numba kernel: a walk along the records of GDSII."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit

__all__ = ["walk_records"]

_bytes = types.Array(types.uint8, 1, "C", readonly=True)
_flags = types.Array(types.boolean, 1, "C", readonly=True)


@njit(types.UniTuple(types.int64, 2)(_bytes, _flags, types.int64))
def walk_records(data, is_known, last):
    """
    Walk to the end of the record that has the number ``last``, to a record that is none, or to the end of the data.

    Returns
    -------
    at : int
        Where the walk ended; beyond the data if that is where the record's length leads.
    record : int
        Number of the record walked last, with its data type; -1 if what begins there is no record.
    """
    at, record = 0, 0
    while at + 4 <= data.size and record != last:
        length = np.int64(data[at]) << 8 | np.int64(data[at + 1])
        record = np.int64(data[at + 2]) << 8 | np.int64(data[at + 3])
        if length < 4 or length & 1 or not is_known[record]:
            return at, -1
        at += length
    return at, record
