"""Types of the arrays that kernels receive: C-contiguous, read-only or writeable."""

from __future__ import annotations

from typing import Any

from numba import types


def array_of(dtype: Any, n_dimensions: int = 1) -> Any:
    """Return the type of an input array."""
    return types.Array(dtype, n_dimensions, "C", readonly=True)


FLOATS, FLOATS_2D, FLOATS_3D = (array_of(types.float64, n) for n in (1, 2, 3))
INTS, INTS_2D = (array_of(types.int64, n) for n in (1, 2))
FLAGS = array_of(types.boolean)
