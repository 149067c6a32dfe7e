"""
Records of OASIS files: which are understood, irrelevant or rejected.

gdstk stops at extension records without a meaning for the shapes: they are replaced by padding in the bytes that it receives.
It converts circles with an absolute tolerance: their radii are returned, and the sandbox process draws them.

Source: SEMI P39, OASIS.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from foveasim.errors import FileError
from foveasim.layout.files._source import Edit, Source, edited, new_name, repeated_names, text

OASIS_MAGIC = b"%SEMI-OASIS\r\n"
#: Records that decide what is read.
UNDERSTOOD = {
    0: "PAD",
    1: "START",
    2: "END",
    3: "CELLNAME",
    4: "CELLNAME",
    7: "PROPNAME",
    8: "PROPNAME",
    9: "PROPSTRING",
    10: "PROPSTRING",
    13: "CELL",
    14: "CELL",
    15: "XYABSOLUTE",
    16: "XYRELATIVE",
    17: "PLACEMENT",
    18: "PLACEMENT",
    20: "RECTANGLE",
    21: "POLYGON",
    22: "PATH",
    23: "TRAPEZOID",
    24: "TRAPEZOID",
    25: "TRAPEZOID",
    26: "CTRAPEZOID",
    27: "CIRCLE",
    28: "PROPERTY",
    29: "PROPERTY",
    34: "CBLOCK",
}
#: Records without influence on the shapes: texts, names of layers, and extensions that are not geometry.
IRRELEVANT = {
    5: "TEXTSTRING",
    6: "TEXTSTRING",
    11: "LAYERNAME",
    12: "LAYERNAME",
    19: "TEXT",
    30: "XNAME",
    31: "XNAME",
    32: "XELEMENT",
}
#: Records whose shapes only the program knows that wrote them; and all other numbers.
REJECTED = {33: "XGEOMETRY"}
START, END, CBLOCK = 1, 2, 34
#: Size of the END record, which ends the file, and number of the validation scheme CRC-32.
OASIS_END_BYTES = 256
CRC32_SCHEME = 1
#: Maximum decompressed size of the file, for small ones and per byte.
MIN_EXPANDED_BYTES, EXPANDED_PER_BYTE = 2**28, 128
#: Maximum bits of an integer that is used.
MAX_BITS = 63
#: Events that are returned at a time.
N_EVENTS = 2**16


def read_records(path: Path, data: bytes, duplicates: str) -> Source:
    """
    Check the records, and return what gdstk shall read.

    Raises FileError when the file is truncated or corrupt, a record is rejected, or several cells have one name, unless
    ``duplicates`` is ``"rename"``.
    """
    _check_end(path, data)
    return _Records(path, data, duplicates).source()


def _check_end(path: Path, data: bytes) -> None:
    """Check that the END record exists, and that its CRC-32, if any, matches the file."""
    end = data[-OASIS_END_BYTES:]
    if len(data) < len(OASIS_MAGIC) + OASIS_END_BYTES or end[0] != END:
        raise FileError(path, "is truncated or corrupt: it does not end with the END record of OASIS")
    if end[-5] == CRC32_SCHEME and int.from_bytes(end[-4:], "little") != zlib.crc32(memoryview(data)[:-4]):
        raise FileError(path, "is corrupt: its CRC-32 does not match its content")


class _Records:
    """Records of a file with all blocks decompressed, which follow each other in ``parts``."""

    def __init__(self, path: Path, data: bytes, duplicates: str) -> None:
        self.path, self.data, self.duplicates = path, data, duplicates
        self.stop = len(data) - OASIS_END_BYTES
        self.max_bytes = max(MIN_EXPANDED_BYTES, EXPANDED_PER_BYTE * len(data))
        #: Beginning of each part in the decompressed file, and its position in the file; -1 in a block: that of the block.
        self.parts: list[bytes] = []
        self.starts: list[int] = []
        self.positions: list[tuple[int, int]] = []
        self.n_bytes = 0

    def source(self) -> Source:
        events = self._walk(with_placements=False)
        kind = events[:, 0]
        from foveasim.layout.files import _kernels as k

        circles = events[kind == k.CIRCLE, 1:]
        edits = [Edit(a, b, bytes(b - a)) for a, b in events[kind == k.EXTENSION_RECORD, 1:3].tolist()]
        source = Source(circles=circles)
        edits += self._renamed(events, source)
        source.content = edited(b"".join(self.parts), edits) if edits else None
        return source

    def _walk(self, *, with_placements: bool) -> Any:
        """Follow all records; return the events."""
        from foveasim.layout.files import _kernels as k

        self.parts, self.starts, self.positions, self.n_bytes = [], [], [], 0
        state = np.zeros(4, np.int64)
        state[k.CELL_INDEX], state[k.WITH_PLACEMENTS] = -1, with_placements
        found = []
        content = np.frombuffer(self.data, np.uint8)
        at, start = self._after_start(), 0
        while True:
            end = at
            for rows, end in self._events(content, at, self.stop, state, (0, -1)):  # noqa: B007 -- used below
                found.append(_shifted(rows, self.n_bytes - start))
            at = end
            if at == self.stop:
                break
            self._append(self.data[start:at], (start, -1))
            block, behind = self._block(at)
            inner = np.frombuffer(block, np.uint8)
            for rows, end in self._events(inner, 0, len(block), state, (0, at)):
                found.append(_shifted(rows, self.n_bytes))
                if end != len(block) and len(rows) < N_EVENTS:
                    raise self._unread(inner, end, (0, at))
            self._append(block, (0, at))
            at = start = behind
        self._append(self.data[start:], (start, -1))
        return np.concatenate(found) if found else np.zeros((0, 4), np.int64)

    def _append(self, part: bytes, position: tuple[int, int]) -> None:
        self.parts.append(part)
        self.starts.append(self.n_bytes)
        self.positions.append(position)
        self.n_bytes += len(part)
        if self.n_bytes > self.max_bytes:
            raise FileError(self.path, f"would decompress to more than the maximum of {self.max_bytes} bytes")

    def _events(
        self, content: Any, at: int, stop: int, state: Any, origin: tuple[int, int]
    ) -> Iterator[tuple[Any, int]]:
        """Yield events, and the position of the next record: at last a CBLOCK or the end."""
        from foveasim.layout.files import _kernels as k

        events = np.empty((N_EVENTS, 4), np.int64)
        reason = k.IS_FULL
        while reason == k.IS_FULL:
            at, n, reason = k.walk_oasis(content, at, stop, state, events)
            if reason == k.IS_TRUNCATED or (reason == k.IS_OTHER and content[at] != CBLOCK):
                raise self._unread(content, at, origin)
            yield events[:n].copy(), at

    def _unread(self, content: Any, at: int, origin: tuple[int, int]) -> FileError:
        """Return the error of a record that is not read."""
        number, where = int(content[at]), _place(at + origin[0], origin[1])
        if number in REJECTED or number not in UNDERSTOOD | IRRELEVANT:
            name = f"{REJECTED[number]} ({number})" if number in REJECTED else str(number)
            return FileError(
                self.path,
                f"contains the OASIS record {name} at {where}, which may change the shapes and is not understood; write the "
                "file without it, for example with KLayout",
            )
        name = (UNDERSTOOD | IRRELEVANT)[number]
        return FileError(self.path, f"is truncated or corrupt: no valid OASIS record {name} begins at {where}")

    def _after_start(self) -> int:
        """Return the position behind the START record."""
        at = len(OASIS_MAGIC)
        if self.data[at] != START:
            raise FileError(self.path, "is corrupt: it does not begin with the START record of OASIS")
        version, at = self._string(self.data, at + 1)
        if version != b"1.0":
            raise FileError(self.path, f"has the OASIS version {text(version[:20])!r}, expected '1.0'")
        kind, at = self._integer(self.data, at)
        # The grid is one or two integers, or a number of 32 or 64 bits.
        for _ in range((1, 1, 1, 1, 2, 2, 0, 0)[min(kind, 7)]):
            at = self._integer(self.data, at)[1]
        at += {6: 4, 7: 8}.get(kind, 0)
        are_at_end, at = self._integer(self.data, at)
        for _ in range(0 if are_at_end else 12):
            at = self._integer(self.data, at)[1]
        if at > self.stop:
            raise FileError(self.path, "is truncated or corrupt: its START record is incomplete")
        return at

    def _block(self, at: int) -> tuple[bytes, int]:
        """Decompress a block; return its content and the position behind it."""
        method, begin = self._integer(self.data, at + 1)
        size, begin = self._integer(self.data, begin)
        n_bytes, begin = self._integer(self.data, begin)
        if n_bytes > self.stop - begin:
            raise FileError(self.path, f"is truncated or corrupt: the OASIS record CBLOCK at byte {at} is incomplete")
        if method != 0:
            raise FileError(self.path, f"has a block with the compression {method} at byte {at}, expected 0 (DEFLATE)")
        if self.n_bytes + size > self.max_bytes:
            raise FileError(self.path, f"would decompress to more than the maximum of {self.max_bytes} bytes")
        decompressor = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            block = decompressor.decompress(self.data[begin : begin + n_bytes], max(size, 1))
        except zlib.error:
            block = b""
        if len(block) != size:
            raise FileError(self.path, f"is corrupt: the OASIS record CBLOCK at byte {at} cannot be decompressed")
        return block, begin + n_bytes

    def _where(self, at: int) -> str:
        """Return a position of the decompressed file in words."""
        part = int(np.searchsorted(self.starts, at, side="right")) - 1
        first, block = self.positions[part]
        return _place(at - self.starts[part] + first, block)

    # -- names of cells ------------------------------------------------------------------------------------------------

    def _renamed(self, events: Any, source: Source) -> list[Edit]:
        """
        Return the edits that give each cell its own name.

        Cells of one name with different numbers are told apart by the references that use numbers. References by a shared
        name, or by a shared number, cannot be told apart.
        """
        from foveasim.layout.files import _kernels as k

        content = b"".join(self.parts)
        numbers: dict[int, tuple[bytes, int, int]] = {}
        for _, start, stop, number in events[events[:, 0] == k.NAME].tolist():
            numbers[len(numbers) if number < 0 else number] = (self._string(content, start + 1)[0], start, stop)
        rows = events[(events[:, 0] == k.CELL_BY_NUMBER) | (events[:, 0] == k.CELL_BY_NAME)].tolist()
        names, number_of = [], []
        for kind, start, _, number in rows:
            is_numbered = kind == k.CELL_BY_NUMBER
            if is_numbered and number not in numbers:
                raise FileError(
                    self.path, f"is corrupt: the cell at {self._where(start)} has the number {number} without a name"
                )
            names.append(numbers[number][0] if is_numbered else self._string(content, start + 1)[0])
            number_of.append(number if is_numbered else -1)
        if len(set(names)) == len(names):
            return []
        shared = repeated_names(self.path, names, [self._where(row[1]) for row in rows], self.duplicates)
        placed = self._walk(with_placements=True)
        by_number = set(placed[placed[:, 0] == k.PLACED_BY_NUMBER, 3].tolist())
        by_name = {self._string(content, at)[0] for at in placed[placed[:, 0] == k.PLACED_BY_NAME, 3].tolist()}
        used, edits, ambiguous = {*names, *(name for name, _, _ in numbers.values())}, [], set()
        for name, cells in shared.items():
            if name in by_name:
                ambiguous.add(name)
            for j, cell in enumerate(cells):
                number = number_of[cell]
                is_own = number >= 0 and number not in [number_of[other] for other in cells if other != cell]
                if number in by_number and not is_own:
                    ambiguous.add(name)
                if j == 0:
                    continue
                renamed = new_name(name, used)
                string = _varint(len(renamed)) + renamed
                _, start, stop, _ = rows[cell]
                if is_own:
                    _, start, stop = numbers[number]
                    behind = self._string(content, start + 1)[1]
                    edits.append(Edit(start + 1, behind, string))
                else:
                    edits.append(Edit(start, stop, b"\x0e" + string))
        source.ambiguous = tuple(sorted(map(text, ambiguous)))
        n_renamed = sum(map(len, shared.values())) - len(shared)
        source.notes.append(f"{len(shared)} names of several cells; {n_renamed} cells are renamed")
        return edits

    def _string(self, content: bytes, at: int) -> tuple[bytes, int]:
        """Return a string, and the position behind it."""
        length, at = self._integer(content, at)
        return content[at : at + length], at + length

    def _integer(self, content: bytes, at: int) -> tuple[int, int]:
        """Return an unsigned integer, and the position behind it."""
        number, shift = 0, 0
        while at < len(content) and shift < MAX_BITS:
            byte = content[at]
            at += 1
            number |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return number, at
        raise FileError(self.path, f"is truncated or corrupt: no valid integer ends at byte {at}")


def _shifted(events: Any, by: int) -> Any:
    """Return events with positions in the decompressed file."""
    from foveasim.layout.files import _kernels as k

    is_place = events[:, 0] != k.CIRCLE
    events[is_place, 1:3] += by
    events[events[:, 0] == k.PLACED_BY_NAME, 3] += by
    return events


def _place(at: int, block: int) -> str:
    return f"byte {at}" if block < 0 else f"byte {at} of the block at byte {block}"


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 127:
        found.append(number & 127 | 128)
        number >>= 7
    return bytes([*found, number])
