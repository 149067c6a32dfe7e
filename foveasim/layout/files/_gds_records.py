"""
Records of GDSII files: which are understood, irrelevant or rejected.

gdstk reads some of the understood records otherwise than the manual and other programs. The bytes that it receives are then
edited: a path without WIDTH has the width 0, not that of the path before; an array that is neither rotated nor mirrored may be
skewed; an array with a pitch of 0 has one column or row.

Source: Calma, GDSII Stream Format Manual 6.0 (1987).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from foveasim.errors import FileError
from foveasim.layout.files._source import Edit, Source, counted, edited, new_name, repeated_names, text

#: Data types: none, bit array, 16-bit and 32-bit integers, 64-bit floating point, string.
NONE, BITS, SHORT, LONG, REAL, STRING = 0, 1, 2, 3, 5, 6
#: Records that decide what is read, with their names and data types.
UNDERSTOOD = {
    0x03: ("UNITS", REAL),
    0x04: ("ENDLIB", NONE),
    0x05: ("BGNSTR", SHORT),
    0x06: ("STRNAME", STRING),
    0x07: ("ENDSTR", NONE),
    0x08: ("BOUNDARY", NONE),
    0x09: ("PATH", NONE),
    0x0A: ("SREF", NONE),
    0x0B: ("AREF", NONE),
    0x0D: ("LAYER", SHORT),
    0x0E: ("DATATYPE", SHORT),
    0x0F: ("WIDTH", LONG),
    0x10: ("XY", LONG),
    0x11: ("ENDEL", NONE),
    0x12: ("SNAME", STRING),
    0x13: ("COLROW", SHORT),
    0x1A: ("STRANS", BITS),
    0x1B: ("MAG", REAL),
    0x1C: ("ANGLE", REAL),
    0x21: ("PATHTYPE", SHORT),
    0x2B: ("PROPATTR", SHORT),
    0x2C: ("PROPVALUE", STRING),
    0x2D: ("BOX", NONE),
    0x2E: ("BOXTYPE", SHORT),
    0x30: ("BGNEXTN", LONG),
    0x31: ("ENDEXTN", LONG),
}
#: Records without influence on the shapes: dates, names, texts, nodes of nets, properties of editors, tapes, and the list of
#: layers in a filtered file. Reference libraries matter only for missing cells, which are an error of their own.
IRRELEVANT = {
    0x00: ("HEADER", SHORT),
    0x01: ("BGNLIB", SHORT),
    0x02: ("LIBNAME", STRING),
    0x0C: ("TEXT", NONE),
    0x15: ("NODE", NONE),
    0x16: ("TEXTTYPE", SHORT),
    0x17: ("PRESENTATION", BITS),
    0x19: ("STRING", STRING),
    0x1F: ("REFLIBS", STRING),
    0x20: ("FONTS", STRING),
    0x22: ("GENERATIONS", SHORT),
    0x23: ("ATTRTABLE", STRING),
    0x24: ("STYPTABLE", STRING),
    0x25: ("STRTYPE", SHORT),
    0x26: ("ELFLAGS", BITS),
    0x27: ("ELKEY", LONG),
    0x2A: ("NODETYPE", SHORT),
    0x2F: ("PLEX", LONG),
    0x32: ("TAPENUM", SHORT),
    0x33: ("TAPECODE", SHORT),
    0x34: ("STRCLASS", BITS),
    0x36: ("FORMAT", SHORT),
    0x37: ("MASK", STRING),
    0x38: ("ENDMASKS", NONE),
    0x39: ("LIBDIRSIZE", SHORT),
    0x3A: ("SRFNAME", STRING),
    0x3B: ("LIBSECUR", SHORT),
}
#: Records that would change the shapes, or whose meaning the manual does not define, by their names; and all other numbers.
REJECTED = {
    0x14: "TEXTNODE",
    0x18: "SPACING",
    0x1D: "UINTEGER",
    0x1E: "USTRING",
    0x28: "LINKTYPE",
    0x29: "LINKKEYS",
    0x35: "RESERVED",
    0x56: "RAITHMBMSPATH",
    0x62: "RAITHPXXDATA",
}
END_OF_LIBRARY = 0x0400
#: Maximum number of columns or rows of an array.
MAX_SIDE = 32767
ZERO_WIDTH = struct.pack(">HHi", 8, 0x0F03, 0)
#: ANGLE of 360°: gdstk then takes both vectors of an array as they are.
FULL_TURN = struct.pack(">HHQ", 12, 0x1C05, 0x4316800000000000)


def read_records(path: Path, data: bytes, duplicates: str) -> Source:
    """
    Check the records, and return what gdstk shall read.

    Raises FileError when the file is truncated or corrupt, a record is rejected, or several cells have one name, unless
    ``duplicates`` is ``"rename"``.
    """
    from foveasim.layout.files import _kernels as k

    _check_types(path, data)
    content = np.frombuffer(data, np.uint8)
    events = np.empty((k.gds_events(content, np.empty((0, 3), np.int64)), 3), np.int64)
    k.gds_events(content, events)
    at = {kind: events[events[:, 0] == kind, 1:].tolist() for kind in range(k.CELL, k.FLAT_ARRAY + 1)}

    edits = [Edit(start, start, ZERO_WIDTH) for start, _ in at[k.NO_WIDTH]]
    edits += [Edit(start, start, FULL_TURN) for start, _ in at[k.SKEWED]]
    edits += [Edit(start + 4, start + 6, b"\0\0") for start, _ in at[k.PATH_TYPE]]
    sizes = {start: [number & 0xFFFF, number >> 16] for start, number in [*at[k.ARRAY_SIZE], *at[k.FLAT_ARRAY]]}
    for start, sides in sizes.items():
        if max(sides) > MAX_SIDE:
            raise FileError(
                path,
                f"has an array of {sides[0]} x {sides[1]} cells at byte {start}, more than {MAX_SIDE} in a direction",
            )
        edits.append(Edit(start + 4, start + 8, struct.pack(">HH", max(sides[0], 1), max(sides[1], 1))))
    source = Source()
    edits += _renamed(path, data, at[k.CELL], at[k.CELL_NAME], duplicates, source)
    source.content = edited(data, edits)

    bytes_of = {kind: [f"byte {start}" for start, _ in found] for kind, found in at.items()}
    if at[k.ABSOLUTE]:
        source.notes.append(
            f"{counted('reference', bytes_of[k.ABSOLUTE])} with an absolute magnification or angle; read as relative ones, "
            "as in KLayout"
        )
    if at[k.ABSOLUTE_WIDTH] and at[k.MAGNIFIED]:
        source.notes.append(
            f"{counted('path', bytes_of[k.ABSOLUTE_WIDTH])} with an absolute width; it is magnified with its cell, "
            "as in KLayout"
        )
    if at[k.PATH_TYPE]:
        number = at[k.PATH_TYPE][0][1]
        source.notes.append(
            f"{counted('path', bytes_of[k.PATH_TYPE])} of the unknown type {number}; read with flush ends, as in KLayout"
        )
    if at[k.EXTENSION]:
        source.notes.append(
            f"{counted('extension', bytes_of[k.EXTENSION])} of a path of another type than 4; ignored, as in the manual"
        )
    return source


def _check_types(path: Path, data: bytes) -> None:
    """Check that the records have known types and are complete up to ENDLIB."""
    from foveasim.layout.files import _kernels

    known = UNDERSTOOD | IRRELEVANT
    is_known = np.zeros(2**16, bool)
    is_known[[record << 8 | kind for record, (_, kind) in known.items()]] = True
    at, record = _kernels.walk_records(np.frombuffer(data, np.uint8), is_known, END_OF_LIBRARY)
    if record == -1:
        length, number, kind = struct.unpack_from(">HBB", data, at)
        if length < 4 or length & 1 or number in known:
            what = f": {known[number][0]} cannot have data of type {kind}" if number in known and length >= 4 else ""
            raise FileError(path, f"is corrupt: no valid GDSII record begins at byte {at}{what}")
        name = f"{REJECTED[number]} (0x{number:02X})" if number in REJECTED else f"0x{number:02X}"
        raise FileError(
            path,
            f"contains the GDSII record {name} at byte {at}, which may change the shapes and is not understood; write the file "
            "without it, for example with KLayout",
        )
    if record != END_OF_LIBRARY or at > len(data):
        raise FileError(path, "is truncated: the GDSII record ENDLIB is missing or incomplete")
    if data[at:].strip(b"\0"):
        raise FileError(path, f"is corrupt: unexpected data after the end of the GDSII library at byte {at}")


def _renamed(
    path: Path, data: bytes, cells: list[list[int]], names: list[list[int]], duplicates: str, source: Source
) -> list[Edit]:
    """
    Return the edits that give each cell its own name.

    Further copies of a cell with equal content are removed. References to a name of cells that differ cannot be told apart.
    """
    found = [data[start + 4 : start + 4 + length].removesuffix(b"\0") for start, length in names]
    shared = repeated_names(path, found, [f"byte {start}" for start, _ in names], duplicates)
    if not shared:
        return []
    if len(cells) != len(names):
        raise FileError(path, "is corrupt: a GDSII cell has no name, or several")
    used, edits = set(found), []
    ends = [*(start for start, _ in cells[1:]), len(data)]
    # The last cell ends with ENDLIB, and with padding.
    contents = [data[start + 4 + length : end] for (start, length), end in zip(names, ends, strict=True)]
    contents[-1] = contents[-1][: contents[-1].rfind(b"\0\4\4\0")]
    different = []
    for name, (first, *others) in shared.items():
        for k in others:
            start, length = names[k]
            if contents[k] == contents[first]:
                edits.append(Edit(cells[k][0], start + 4 + length + len(contents[k]), b""))
                continue
            renamed = new_name(name, used)
            renamed += b"\0" * (len(renamed) % 2)
            edits.append(Edit(start, start + 4 + length, struct.pack(">HH", 4 + len(renamed), 0x0606) + renamed))
            different.append(name)
    source.ambiguous = tuple(dict.fromkeys(map(text, different)))
    source.notes.append(
        f"{len(shared)} names of several cells; {len(different)} cells are renamed, and equal ones read once"
    )
    return edits
