"""Colour boxes of files of the ISO base media format: JPEG 2000 and AVIF."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

from foveasim._io.images._colour import SRGB, Colour, h273_colour

#: Boxes that contain the boxes of colours, with the bytes before their first box.
JP2_PATH, AVIF_PATH = ((b"jp2h", 0),), ((b"meta", 4), (b"iprp", 0), (b"ipco", 0))
COLOUR_BOX = b"colr"
#: Enumerated colour spaces of JPEG 2000 (ISO/IEC 15444-1, table I.10; 15444-2, table M.25): sRGB, grey and sYCC, which the
#: decoder converts; CMYK, which needs a profile.
JP2_SRGB, JP2_CMYK = (16, 17, 18), 12


def jp2_colour(content: bytes) -> Colour:
    """Return the colours of the first colour box of a JPEG 2000 file; sRGB without one."""
    for body in _bodies(content, JP2_PATH):
        method = body[0] if body else 0
        if method == 1 and len(body) >= 7:
            space = int.from_bytes(body[3:7])
            is_known = space in JP2_SRGB or space == JP2_CMYK
            return SRGB if is_known else Colour(problem=f"has the unsupported colour space {space} of JPEG 2000")
        if method in (2, 3):
            return Colour(profile=body[3:]) if body[3:] else Colour(problem="has a broken colour profile")
        if method == 5 and len(body) >= 10:
            primaries, transfer = struct.unpack(">HH", body[3:7])
            return h273_colour(primaries, transfer)
        return Colour(problem=f"has a colour box of the unsupported method {method}")
    return SRGB


def avif_colour(content: bytes) -> Colour:
    """Return the colours of an AVIF file, whose pictures must not differ in them."""
    found = {body[4:8] for body in _bodies(content, AVIF_PATH) if body[:4] == b"nclx" and len(body) >= 10}
    if len(found) > 1:
        return Colour(problem="contains pictures of different colours")
    return h273_colour(*struct.unpack(">HH", found.pop())) if found else SRGB


def _bodies(content: bytes, path: Sequence[tuple[bytes, int]]) -> Iterator[bytes]:
    """Yield the bodies of the colour boxes in the boxes of a path."""
    if not path:
        yield from (body for kind, body in _boxes(content) if kind == COLOUR_BOX)
        return
    (name, n_skipped), *rest = path
    for kind, body in _boxes(content):
        if kind == name:
            yield from _bodies(body[n_skipped:], rest)


def _boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield kinds and bodies of boxes, up to the first invalid one."""
    offset = 0
    while offset + 8 <= len(content):
        size, kind, begin = int.from_bytes(content[offset : offset + 4]), content[offset + 4 : offset + 8], offset + 8
        if size == 1:
            size, begin = int.from_bytes(content[offset + 8 : offset + 16]), offset + 16
        end = len(content) if size == 0 else offset + size
        if end < begin or end > len(content):
            return
        yield kind, content[begin:end]
        offset = end
