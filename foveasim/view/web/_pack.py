"""Text encoding of arrays in a page: bytes sorted by significance, gzip, base64."""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Ints

#: Higher levels take several times longer and save a few per cent.
GZIP_LEVEL = 5


def pack(array: NDArray[Any]) -> tuple[dict[str, Any], str]:
    """
    Encode an array for ``unpack.js``.

    Returns ``about``: type and number of values. ``text``: base64 of gzip of all first bytes, all second bytes, and so on: the
    high bytes of adjacent values are similar.
    """
    flat = np.ascontiguousarray(array).reshape(-1)
    flat = flat.astype(flat.dtype.newbyteorder("<"), copy=False)
    planes = flat.view(np.uint8).reshape(-1, flat.dtype.itemsize).T if flat.size else flat.view(np.uint8)
    metadata = {"type": flat.dtype.name, "size": int(flat.size)}
    return metadata, base64.b64encode(gzip.compress(planes.tobytes(), GZIP_LEVEL, mtime=0)).decode()


def to_smallest_type(values: NDArray[Any]) -> NDArray[Any]:
    """Convert numbers to the smallest JavaScript array type that represents them exactly."""
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind in "iu":
        low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
        for kind in (np.uint8, np.int8, np.uint16, np.int16, np.uint32, np.int32):
            if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
                return values.astype(kind)
        return values.astype(np.float64)
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    is_same = np.array_equal(single.astype(values.dtype), values, equal_nan=True)
    return single if is_same else values.astype(np.float64)


def back_references(position: Ints) -> Ints:
    """
    Encode positions as back references, which compress well.

    0 is the next new position; n is the n-th last of the distinct positions so far.

    ``position`` (n_vertex,) int64: numbered by their first occurrence.
    """
    n_distinct = np.maximum.accumulate(position) + 1
    n_before = np.concatenate(([0], n_distinct[:-1]))
    return np.where(position == n_before, 0, n_before - position)
