"""
Files of raw numbers mapped into memory, with a check for changes.

A mapped array shows later changes of its file, and a process that reads a mapped page beyond the end of a truncated file ends
with the signal SIGBUS. Mapped arrays of the package therefore refer to an open file with its size and its time of modification
(:func:`check_unchanged`), and their values are read with ``preadv`` (:func:`in_memory`), which returns an error instead. A file
that is replaced by another of the same name does not change: the mapping refers to the previous one.
"""

from __future__ import annotations

import mmap
import os
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import Images
from foveasim.errors import FileError

_Array = TypeVar("_Array", bound=NDArray[Any])

#: Values whose range is computed at once, about 1 MB: within the second-level cache.
BLOCK_VALUES = 2**18
#: Bytes that a thread reads, or whose range it computes, at a time.
PART_BYTES = 2**24
#: Known ranges of the values of constant arrays, by identity.
_ranges: dict[int, tuple[weakref.ref[NDArray[Any]], tuple[float, float]]] = {}


class MappedFile(mmap.mmap):
    """Read-only mapping of a file; the last base of all arrays that show it."""

    path: Path
    _fd: int
    _state: tuple[int, int]

    @classmethod
    def open(cls, path: Path) -> MappedFile:
        """Map a file, which must not be empty."""
        fd = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        try:
            mapped = cls(fd, 0, access=mmap.ACCESS_READ)
        except BaseException:
            os.close(fd)
            raise
        weakref.finalize(mapped, os.close, fd)
        mapped.path, mapped._fd = path, fd
        mapped._state = mapped._current_state()
        return mapped

    def _current_state(self) -> tuple[int, int]:
        status = os.fstat(self._fd)
        return status.st_size, status.st_mtime_ns

    def check(self) -> None:
        """Raise a :class:`FileError` if the file has another size or time of modification."""
        state = self._current_state()
        if state != self._state:
            how = (
                "was modified"
                if state[0] == self._state[0]
                else f"has {state[0]:,} bytes instead of {self._state[0]:,}"
            )
            raise FileError(self.path, f"{how} since it was opened; open it again")

    def read_into(self, values: NDArray[Any], offset: int) -> None:
        """Read contiguous values at an offset in bytes."""
        target = values.reshape(-1).view(np.uint8).data
        while target:
            n_bytes = os.preadv(self._fd, [target], offset)
            if n_bytes == 0:
                self.check()
                raise FileError(self.path, "was truncated while it was read; open it again")
            target, offset = target[n_bytes:], offset + n_bytes


def map_file(path: Path, dtype: np.dtype[Any], shape: tuple[int, ...], offset: int) -> NDArray[Any]:
    """
    Map an array in a file of raw numbers into memory.

    ``shape``: shape in C order. ``offset``: position of the first number. Returns ``array``: it and its views are accepted by
    :func:`check_unchanged` and :func:`in_memory`.
    """
    return np.ndarray(shape, dtype, MappedFile.open(path), offset)


def check_unchanged(array: _Array) -> _Array:
    """
    Return the same array, after a check that the file it is mapped from has not changed.

    Raises FileError if the file of an array of :func:`map_file` has another size or time of modification than when it was
    opened.
    """
    mapped = _mapping(array)
    if mapped is not None:
        mapped.check()
    return array


def in_memory(array: NDArray[Any], seen: Callable[[NDArray[Any]], None] | None = None) -> NDArray[Any]:
    """
    Return the same array, or a copy in memory of an array of :func:`map_file`.

    The copy has the memory order of the file. It contains the values of the unchanged file, or the function raises.

    ``seen``: is called with each part of a copy in some thread, while the part is in the cache of the processor. Raises
    FileError as :func:`check_unchanged`, also for changes while the file is read.
    """
    mapped = _mapping(array)
    if mapped is None:
        return array
    mapped.check()
    # In the order of the file: axes by descending stride, all of them positive.
    order = sorted(range(array.ndim), key=lambda axis: -abs(array.strides[axis]))
    forwards = tuple(slice(None, None, -1 if stride < 0 else 1) for stride in array.strides)
    view = array[forwards].transpose(order)
    copy = np.empty(view.shape, view.dtype)
    n_outer, n_bytes = view.ndim, view.itemsize
    while n_outer and view.strides[n_outer - 1] == n_bytes and n_bytes * view.shape[n_outer - 1] <= PART_BYTES:
        n_outer -= 1
        n_bytes *= view.shape[n_outer]
    if hasattr(os, "preadv") and array.size:
        start = _address(view) - _address(np.frombuffer(mapped, np.uint8))
        rows, steps = copy.reshape(-1, n_bytes // view.itemsize), view.strides[:n_outer]

        def read(part: range) -> None:
            for row in part:
                index = np.unravel_index(row, view.shape[:n_outer])
                offset = start + sum(int(i) * step for i, step in zip(index, steps, strict=True))
                for first in range(0, rows.shape[1], BLOCK_VALUES):
                    values = rows[row, first : first + BLOCK_VALUES]
                    mapped.read_into(values, offset + first * view.itemsize)
                    if seen is not None:
                        seen(values)

        parallel_map(read, _parts(rows.shape[0], n_bytes), thread_count())
    else:  # on Windows, where a mapped file cannot be truncated
        copy[...] = view
        if seen is not None and array.size:
            seen(copy)
    mapped.check()
    back = np.argsort(order)
    return copy.transpose(back)[forwards]


def range_and_values(images: Images) -> tuple[tuple[float, float], Images]:
    """
    Return the lowest and the highest value, and :func:`in_memory`, in one pass over a file.

    Callers without changes to the copy pass the range to :func:`remember_range`.
    """
    ranges: list[tuple[Any, Any]] = []
    copy = in_memory(images, lambda values: ranges.append((values.min(), values.max())))
    return _joined(ranges) if ranges else value_range(copy), copy


def remember_range(images: Images, limits: tuple[float, float]) -> None:
    """Let :func:`value_range` know the range of an array that nobody changes any more."""
    owner = _owner(images)
    if owner.flags.owndata and _is_complete(images, owner):
        key = id(owner)
        _ranges[key] = weakref.ref(owner, lambda _: _ranges.pop(key, None)), limits


def value_range(images: Images) -> tuple[float, float]:
    """
    Return the lowest and the highest value; NaN if there is a NaN.

    It is known for the arrays of :func:`remember_range`, in any order of their axes.

    ``images`` (n_band, n_y, n_x): read band by band if it is mapped from a file. Raises FileError as :func:`in_memory`.
    """
    owner = _owner(images)
    known = _ranges.get(id(owner))
    if known is not None and known[0]() is owner and _is_complete(images, owner):
        return known[1]
    n_bytes = images.shape[2] * images.itemsize
    parts = [(image, rows) for image in images for rows in _parts(images.shape[1], n_bytes)]
    return _joined(parallel_map(_range_of_rows, parts, thread_count()))


def _is_complete(view: NDArray[Any], owner: NDArray[Any]) -> bool:
    """Return whether a view contains every value once, in any order of the axes."""
    return view.size == owner.size and sorted(map(abs, view.strides)) == sorted(owner.strides)


def _owner(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array whose memory a view shows."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _joined(ranges: Iterable[tuple[Any, Any]]) -> tuple[float, float]:
    low, high = (f(values) for f, values in zip((np.min, np.max), zip(*ranges, strict=True), strict=True))
    return float(low), float(high)


def _range_of_rows(part: tuple[NDArray[Any], range]) -> tuple[Any, Any]:
    """Return the lowest and the highest value of some rows, in blocks that fit into a cache."""
    image, rows = part
    values = in_memory(image[rows.start : rows.stop])
    n_rows = max(1, BLOCK_VALUES // values.shape[1])
    blocks = [values[first : first + n_rows] for first in range(0, values.shape[0], n_rows)]
    return np.min([block.min() for block in blocks]), np.max([block.max() for block in blocks])


def _parts(n_rows: int, n_bytes: int) -> list[range]:
    """Return runs of rows of ``n_bytes`` each, of about :data:`PART_BYTES` together."""
    step = max(1, PART_BYTES // n_bytes)
    return [range(first, min(first + step, n_rows)) for first in range(0, n_rows, step)]


def _mapping(array: NDArray[Any]) -> MappedFile | None:
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base if isinstance(base, MappedFile) else None


def _address(array: NDArray[Any]) -> int:
    address: int = array.__array_interface__["data"][0]
    return address
