"""
Sequences of a million strings, files and boxes in few arrays.

Each process that computes samples has a copy of the names of all pictures and of all labels. Lists of Python objects would take
hundreds of bytes per picture, and seconds to send.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from foveasim._core.validation import Floats, Ints

__all__ = ["PackedBoxes", "PackedFiles", "PackedStrings"]

#: Strings per block of a checksum.
BLOCK = 1 << 14


class PackedStrings(Sequence[str]):
    """Immutable sequence of strings in one buffer."""

    def __init__(self, strings: Iterable[str]) -> None:
        # File names may contain bytes that are not UTF-8.
        encoded = [text.encode("utf-8", "surrogateescape") for text in strings]
        self._content = b"".join(encoded)
        self._offsets = np.concatenate(([0], np.cumsum([len(text) for text in encoded], dtype=np.int64)))

    def __len__(self) -> int:
        return self._offsets.size - 1

    @overload
    def __getitem__(self, k: int) -> str: ...
    @overload
    def __getitem__(self, k: slice) -> Sequence[str]: ...
    def __getitem__(self, k: int | slice) -> str | Sequence[str]:
        if isinstance(k, slice):
            return [self[i] for i in range(*k.indices(len(self)))]
        k = range(len(self))[k]
        return self._content[self._offsets[k] : self._offsets[k + 1]].decode("utf-8", "surrogateescape")

    def digest(self) -> str:
        """Return the SHA-256 of the strings in order, separated by line feeds."""
        digest = hashlib.sha256()
        for start in range(0, len(self), BLOCK):
            text = "\n".join(self[start : start + BLOCK])
            digest.update(f"{text if start == 0 else chr(10) + text}".encode("utf-8", "surrogateescape"))
        return digest.hexdigest()


class PackedFiles(Sequence[Path]):
    """
    Immutable sequence of files in one directory and its subdirectories.

    ``names``: paths relative to the directory.
    """

    def __init__(self, directory: Path, names: Iterable[str]) -> None:
        self._directory, self._names = directory, PackedStrings(names)

    def __len__(self) -> int:
        return len(self._names)

    @overload
    def __getitem__(self, k: int) -> Path: ...
    @overload
    def __getitem__(self, k: slice) -> Sequence[Path]: ...
    def __getitem__(self, k: int | slice) -> Path | Sequence[Path]:
        names = self._names[k]
        return self._directory / names if isinstance(names, str) else [self._directory / name for name in names]


class PackedBoxes:
    """
    Boxes of all pictures, with their classes.

    ``most``: largest number of boxes of a picture.
    """

    def __init__(self, boxes_px: Iterable[tuple[Floats, Ints]]) -> None:
        each = list(boxes_px)
        counts = [len(classes) for _, classes in each]
        self._offsets = np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))
        self._boxes_px = np.concatenate([np.zeros((0, 4)), *(corners for corners, _ in each)])
        self._classes = np.concatenate([np.zeros(0, np.int64), *(classes for _, classes in each)])
        self.most: int = max(counts, default=0)

    def __getitem__(self, k: int) -> tuple[Floats, Ints]:
        """Return the boxes (n_box, 4) of a picture in pixels, and their classes (n_box,)."""
        of_picture = slice(self._offsets[k], self._offsets[k + 1])
        return self._boxes_px[of_picture], self._classes[of_picture]

    def arrays(self) -> tuple[Any, ...]:
        """Return all arrays, for a checksum."""
        return self._offsets, self._boxes_px, self._classes
