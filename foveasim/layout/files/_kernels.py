"""Numba kernel that follows the records of a GDSII file."""

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
    Follow the records up to type ``last``, an invalid record, or the end of the data.

    Returns
    -------
    at : int
        Final position, behind the last record; beyond the data if that record is incomplete.
    record : int
        Type of the last record, with its data type; -1 if no valid record begins at ``at``.
    """
    at, record = 0, 0
    while at + 4 <= data.size and record != last:
        length = np.int64(data[at]) << 8 | np.int64(data[at + 1])
        record = np.int64(data[at + 2]) << 8 | np.int64(data[at + 3])
        if length < 4 or length & 1 or not is_known[record]:
            return at, -1
        at += length
    return at, record
