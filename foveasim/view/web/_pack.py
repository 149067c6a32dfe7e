"""Arrays as text in a page: their bytes sorted by significance, gzip, base64."""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Ints

__all__ = ["back_references", "packed", "smallest"]

#: Higher levels take several times longer for some hundredths of the size.
GZIP_LEVEL = 5


def packed(array: NDArray[Any]) -> tuple[dict[str, Any], str]:
    """
    An array for ``unpack.js``.

    Returns
    -------
    about : dict
        Its type and number of values.
    text : str
        base64 of gzip of all first bytes, all second bytes, and so on: neighbours' high bytes are much alike.
    """
    flat = np.ascontiguousarray(array).reshape(-1)
    flat = flat.astype(flat.dtype.newbyteorder("<"), copy=False)
    planes = flat.view(np.uint8).reshape(-1, flat.dtype.itemsize).T if flat.size else flat.view(np.uint8)
    told = {"type": flat.dtype.name, "size": int(flat.size)}
    return told, base64.b64encode(gzip.compress(planes.tobytes(), GZIP_LEVEL, mtime=0)).decode()


def smallest(values: NDArray[Any]) -> NDArray[Any]:
    """The same numbers in the smallest type that a page has and that holds all of them to the last bit."""
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


def back_references(place: Ints) -> Ints:
    """
    Places that rings come to, told so that they pack well: 0 for the next new one, else how many came since.

    Parameters
    ----------
    place : (n_vertex,) int64
        Numbered by their first occurrence.
    """
    n_seen = np.maximum.accumulate(place) + 1
    n_before = np.concatenate(([0], n_seen[:-1]))
    return np.where(place == n_before, 0, n_before - place)
