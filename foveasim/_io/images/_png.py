"""
PNG files: chunks, their checksums, and colours (PNG specification, third edition).

Of the chunks about colours, cICP takes precedence over iCCP, iCCP over sRGB, and sRGB over gAMA and cHRM. Ancillary chunks
that are not known are ignored, as the format permits; critical ones are rejected.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.images._colour import SRGB, Colour, FilePicture, h273_colour
from foveasim._io.images._limits import apply_orientation, check_size, check_square_pixels
from foveasim._io.images._profiles import MAX_PROFILE_BYTES
from foveasim.errors import printable

MAGIC = b"\x89PNG\r\n\x1a\n"
#: Chunks that are understood, here or by the decoder.
UNDERSTOOD = frozenset((
    *(b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"cHRM", b"gAMA", b"iCCP", b"sRGB", b"cICP", b"pHYs", b"eXIf"),
    *(b"acTL", b"fcTL", b"fdAT"),  # animations are rejected: a file has one picture
))  # fmt: skip
#: Chunks that do not change the pixels: texts, a display's background and palette, precision of a source, mastering display.
IRRELEVANT = frozenset(
    (b"bKGD", b"hIST", b"sBIT", b"sPLT", b"tEXt", b"zTXt", b"iTXt", b"tIME", b"mDCV", b"cLLI", b"oFFs", b"sCAL")
)
#: Chunks that change the meaning of pixels, and what they say.
REJECTED = {b"pCAL": "physical values of its numbers", b"sTER": "two views side by side"}
#: Bit of the first letter of chunks that may be ignored.
ANCILLARY = 0x20
#: gAMA of sRGB: by the specification, files in sRGB have this value for programs that do not know sRGB.
SRGB_GAMMA, GAMMA_TOLERANCE, UNIT = 0.45455, 1e-3, 100_000
#: Maximum size of the metadata of EXIF.
MAX_EXIF_BYTES = 2**20


def chunks_of(content: bytes) -> dict[bytes, bytes]:
    """
    Return the first chunk of each kind but image data, after checking all.

    Raises FormatError when image data are corrupt, or a chunk changes the meaning and is not known.
    """
    found: dict[bytes, bytes] = {}
    offset, view = len(MAGIC), memoryview(content)
    while offset + 12 <= len(content):
        begin = offset + 4
        end = begin + 4 + int.from_bytes(view[offset:begin])
        kind = content[begin : begin + 4]
        if kind == b"IDAT" and zlib.crc32(view[begin:end]) != int.from_bytes(view[end : end + 4]):
            raise FormatError("is corrupt or truncated")
        if kind in REJECTED:
            raise FormatError(f"has the chunk {kind.decode()}, {REJECTED[kind]}; save it without")
        if kind not in UNDERSTOOD and kind not in IRRELEVANT and not kind[0] & ANCILLARY:
            raise FormatError(
                f"has the unknown critical chunk {printable(kind.decode('latin-1'))!r}; save it as a standard PNG"
            )
        if kind != b"IDAT":
            found.setdefault(kind, content[begin + 4 : end])
        offset = end + 4
    if b"pHYs" in found and len(found[b"pHYs"]) == 9:
        x, y = struct.unpack(">II", found[b"pHYs"][:8])
        check_square_pixels(x, y, "pHYs")
    return found


def colour_of_chunks(chunks: dict[bytes, bytes]) -> Colour:
    """Return the colours that the chunks of a file state."""
    for kind, read in (
        (b"cICP", _from_cicp),
        (b"iCCP", _from_profile),
        (b"sRGB", lambda _: SRGB),
    ):
        if kind in chunks:
            return read(chunks[kind])
    gamma, primaries = chunks.get(b"gAMA"), chunks.get(b"cHRM")
    if (gamma is not None and (len(gamma) != 4 or not any(gamma))) or (primaries is not None and len(primaries) != 32):
        return Colour(problem="has a broken chunk gAMA or cHRM")
    return colour_of_gamma(
        None if gamma is None else int.from_bytes(gamma) / UNIT,
        None if primaries is None else [number / UNIT for number in struct.unpack(">8i", primaries)],
    )


def colour_of_gamma(gamma: float | None, primaries: Sequence[float] | None) -> Colour:
    """Return the colours of the numbers of gAMA and cHRM; cHRM begins with white."""
    transfer: str | float = "srgb"
    if gamma is not None and abs(gamma - SRGB_GAMMA) > GAMMA_TOLERANCE:
        transfer = "linear" if gamma == 1.0 else 1.0 / gamma
    if primaries is None:
        return Colour(transfer=transfer)
    return Colour(transfer=transfer, primaries=(*primaries[2:], *primaries[:2]))


def _from_cicp(body: bytes) -> Colour:
    if len(body) != 4:
        return Colour(problem="has a broken chunk cICP")
    primaries, transfer, matrix, is_full = body
    if matrix != 0 or is_full != 1:
        return Colour(
            problem=f"has a chunk cICP with matrix {matrix} and range {is_full}, expected RGB of full range, 0 and 1"
        )
    return h273_colour(primaries, transfer)


def _from_profile(body: bytes) -> Colour:
    begin = body.find(b"\0") + 2
    decompressor = zlib.decompressobj()
    try:
        profile = decompressor.decompress(body[begin:], MAX_PROFILE_BYTES + 1)
    except zlib.error:
        profile = b""
    return Colour(profile=profile) if profile else Colour(problem="has a broken colour profile")


def read_deep_png(path: Path, content: bytes, chunks: dict[bytes, bytes]) -> FilePicture:
    """Read a 16-bit PNG, which Pillow would reduce to 8 bits in colour."""
    from PIL import Image

    imagecodecs = import_optional(path, "imagecodecs")
    check_size(*struct.unpack(">II", content[16:24]))
    if b"acTL" in chunks:
        raise FormatError("contains several pictures; provide a file with one picture")
    pixels: Any = np.asarray(imagecodecs.png_decode(content))
    exif = Image.Exif()
    orientation = 1
    if 0 < len(chunks.get(b"eXIf", b"")) < MAX_EXIF_BYTES:
        try:
            exif.load(chunks[b"eXIf"])
            orientation = exif.get(0x0112, 1)
        except Exception:  # noqa: BLE001 -- the picture may be valid although its metadata are corrupt
            orientation = 1
    return FilePicture(pixels=apply_orientation(pixels, orientation), colour=colour_of_chunks(chunks))
