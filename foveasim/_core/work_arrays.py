"""
Reuse of the memory of large arrays.

The first access to fresh memory takes longer than a pass over it. Arrays of :func:`work_array` reuse the memory of earlier ones
that no object refers to any more, so that repeated captures of one size need no fresh memory.
"""

from __future__ import annotations

import ctypes
import gc
import math
import sys
import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from foveasim._core.threads import ForkSafeLock

#: Smaller arrays are allocated as usual: the allocator reuses their memory.
MIN_BYTES = 1 << 20
#: Options of mallopt of the C library of GNU: M_ARENA_MAX, the number of heaps; M_MMAP_THRESHOLD, the size of blocks outside
#: the heap, at its maximum; M_TRIM_THRESHOLD, the free memory at the end of the heap that is returned.
HEAP_OPTIONS = {-8: 1, -3: 1 << 25, -1: (1 << 31) - 1}
#: Limit of the unused memory that is retained; the memory that has been unused for longest is released first.
MAX_UNUSED_BYTES = 1 << 28
#: Seconds between returns of free pages of heaps.
TRIM_INTERVAL_S = 5.0


class _Memory:
    """Memory of one array, which returns to the pool with its last view."""

    def __init__(self, pool: _Pool, buffer: NDArray[np.uint8]) -> None:
        self._pool, self._buffer = pool, buffer
        self.__array_interface__ = buffer.__array_interface__

    def __del__(self) -> None:
        self._pool.put(self._buffer)


class _Pool:
    """Unused buffers, in the order in which they became unused."""

    def __init__(self) -> None:
        # Reentrant: garbage collection may delete an array, and thus call put, at any allocation.
        self._lock = ForkSafeLock()
        self._unused: list[NDArray[np.uint8]] = []
        # Not read from the module in put: variables of modules are None while the interpreter exits.
        self.max_unused_bytes = MAX_UNUSED_BYTES

    def get(self, n_bytes: int) -> NDArray[np.uint8]:
        with self._lock:
            for i in reversed(range(len(self._unused))):
                if self._unused[i].size == n_bytes:
                    return self._unused.pop(i)
        return np.empty(n_bytes, np.uint8)

    def put(self, buffer: NDArray[np.uint8]) -> None:
        with self._lock:
            self._unused.append(buffer)
            while sum(unused.size for unused in self._unused) > self.max_unused_bytes:
                del self._unused[0]

    def clear(self) -> None:
        with self._lock:
            self._unused.clear()


_POOL = _Pool()


def work_array(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """
    Return an uninitialised C-contiguous array.

    Its memory is reused after the last reference to the array and its views is gone.
    """
    dtype = np.dtype(dtype)
    n_bytes = math.prod(shape) * dtype.itemsize
    if n_bytes < MIN_BYTES:
        return np.empty(shape, dtype)
    return np.asarray(_Memory(_POOL, _POOL.get(n_bytes))).view(dtype).reshape(shape)


def share_heap() -> None:
    """
    Let all threads allocate from one heap, which grows until :func:`release_memory`.

    By default, the C library of GNU gives threads separate heaps (arenas), each of which retains parts of pages between used
    blocks: hundreds of megabytes after some thousand different captures. It also returns large blocks and the end of a heap to
    the system at once, so that the next capture needs fresh memory. For servers; no effect with other C libraries.
    """
    if sys.platform.startswith("linux"):
        with suppress(AttributeError, OSError):
            library = ctypes.CDLL(None)
            for option, value in HEAP_OPTIONS.items():
                library.mallopt(option, value)
    _trims.interval_s = math.inf


class _Trims:
    """Interval of the returns of free pages, and the time of the last one."""

    def __init__(self) -> None:
        self.interval_s, self.last_s = TRIM_INTERVAL_S, time.monotonic()


_trims = _Trims()


def trim_heaps() -> None:
    """
    Return free pages of heaps to the operating system, at most once in 5 s.

    Each capture calls it. The C library of GNU keeps pages between used blocks, more with each frame of another size.
    """
    now_s = time.monotonic()
    if now_s - _trims.last_s >= _trims.interval_s:
        _trims.last_s = now_s
        _trim()


def _trim() -> None:
    if sys.platform.startswith("linux"):
        with suppress(AttributeError, OSError):  # other C libraries
            ctypes.CDLL(None).malloc_trim(0)


def release_memory() -> None:
    """
    Return unused memory to the operating system.

    This is the memory that work arrays retain, and with the C library of GNU also that of the allocator, which else keeps what
    small arrays between used ones have freed. The next arrays need fresh memory: for a process that waits.
    """
    gc.collect()
    _POOL.clear()
    _trim()
