"""Content of GDSII and OASIS files beyond what gdstk reads, and edits of their bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Ints
from foveasim.errors import FileError

Bytes: TypeAlias = NDArray[np.uint8]


class Edit(NamedTuple):
    """Replacement of the bytes from ``start`` to ``stop``."""

    start: int
    stop: int
    content: bytes


@dataclass(kw_only=True)
class Source:
    """
    Content of a file for gdstk, and what gdstk does not return.

    ``content``: bytes that gdstk reads in place of the file; None for the file itself. ``circles`` (n, 3) int64: cell, index
    among the polygons of the cell, radius in database units. ``ambiguous``: names of several cells that differ. ``notes``:
    sentences for warnings.
    """

    content: bytes | None = None
    circles: Ints = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    ambiguous: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)


def edited(content: bytes, edits: Sequence[Edit]) -> bytes | None:
    """Return the content after edits, of which the first wins; None without edits."""
    if not edits:
        return None
    parts: list[bytes] = []
    at = 0
    for edit in sorted(edits):
        if edit.start >= at:
            parts += [content[at : edit.start], edit.content]
            at = edit.stop
    return b"".join([*parts, content[at:]])


def repeated_names(path: Path, names: Sequence[bytes], where: Sequence[str], duplicates: str) -> dict[bytes, list[int]]:
    """
    Return the cells that share a name, by this name.

    ``where``: positions of the cells in words. Raises FileError unless ``duplicates`` is ``"rename"``.
    """
    cells: dict[bytes, list[int]] = {}
    for k, name in enumerate(names):
        cells.setdefault(name, []).append(k)
    shared = {name: found for name, found in cells.items() if len(found) > 1}
    if shared and duplicates != "rename":
        name, (first, second, *_) = next(iter(shared.items()))
        more = f" and {len(shared) - 1} more names" * (len(shared) > 1)
        raise FileError(
            path,
            f"has several cells {text(name)!r:.40}, at {where[first]} and {where[second]}{more}; give each cell its own name, "
            "or pass duplicates='rename' to read all of them",
        )
    return shared


def new_name(name: bytes, used: set[bytes]) -> bytes:
    """Return a name for a further cell, and mark it as used: ``A$1``, ``A$2``."""
    k = 1
    while (found := name + b"$%d" % k) in used:
        k += 1
    used.add(found)
    return found


def text(name: bytes) -> str:
    """Return a name as text."""
    return name.decode("utf-8", "replace")


def counted(what: str, positions: Sequence[Any]) -> str:
    """Return a number of records, and the position of the first."""
    n = len(positions)
    return f"{n} {what}{'s' * (n > 1)}, {'the first ' * (n > 1)}at {positions[0]},"
