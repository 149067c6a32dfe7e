"""
TIFF pictures: TIFF 6.0 with ICC profiles.

Integers are in sRGB, as cameras and scanners write them, unless the file has a profile or a transfer function. Floating-point
numbers are linear light in the primaries of sRGB, unless it has a profile: so they mean it in Photoshop, libvips and Blender.
scikit-image, OpenCV and tifffile write numbers as they are: choose ``encoding="srgb"`` for photographs as floats by these.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import needs
from foveasim._io.formats import FormatError
from foveasim._io.images._colour import LINEAR, SRGB, Colour, FilePicture
from foveasim._io.images._limits import ORIENTATION_TAG, apply_orientation, check_size, check_square_pixels
from foveasim._io.primaries import SRGB_XY

#: First bytes of TIFF and BigTIFF files of either byte order.
MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
#: Tags of the colours.
TRANSFER_FUNCTION, WHITE_POINT, PRIMARIES, ICC_PROFILE = 301, 318, 319, 34_675
COLOUR_TAGS = frozenset((TRANSFER_FUNCTION, WHITE_POINT, PRIMARIES, ICC_PROFILE))
X_RESOLUTION, Y_RESOLUTION = 282, 283
#: Entries of a page that are searched.
MAX_TAGS = 4096
#: Tags that are understood, here or by tifffile: sizes, layout and compression of the pixels, photometric interpretation, kinds
#: of samples, palette, orientation, resolution, colours.
UNDERSTOOD = frozenset((
    *(254, 255, 256, 257, 258, 259, 262, 266, 273, ORIENTATION_TAG, 277, 278, 279, X_RESOLUTION, Y_RESOLUTION, 284, 288, 289),
    *(292, 293, 296, 317, 320, 322, 323, 324, 325, 332, 334, 336, 338, 339, 347, 512, 513, 514, 515, 517, 518, 519, 520, 521),
    *(TRANSFER_FUNCTION, WHITE_POINT, PRIMARIES, ICC_PROFILE, 342, 529, 530, 531, 532, 326, 327, 328),
))  # fmt: skip
#: Tags that do not change the pixels: texts, positions on a page, statistics of the samples, inks' names, thumbnails.
IRRELEVANT = frozenset((
    *(263, 264, 265, 269, 270, 271, 272, 280, 281, 285, 286, 287, 297, 305, 306, 315, 316, 321, 333, 337, 340, 341, 700),
    *(343, 344, 345, 346, 351, 433, 434, 400, 401, 402, 403, 404, 405, 559, 32_781),
))  # fmt: skip
#: Tags that change the meaning of pixels, and what they are. Other tags below FIRST_PRIVATE are rejected by number; private
#: ones are notes of programs, which readers ignore (TIFF 6.0, section 8).
REJECTED = {
    290: "GrayResponseUnit, optical densities",
    291: "GrayResponseCurve, optical densities",
    300: "ColorResponseUnit",
    330: "SubIFDs with further pictures",
    33_421: "CFARepeatPatternDim, a mosaic of colour filters",
    33_422: "CFAPattern, a mosaic of colour filters",
    50_706: "DNGVersion, a camera raw file",
}
FIRST_PRIVATE = 32_768
#: Tags with values that are read only if they are the default, with functions of the largest sample that return it.
DEFAULTS: dict[int, tuple[str, Callable[[int], tuple[int, ...]]]] = {
    332: ("InkSet", lambda _: (1,)),
    336: ("DotRange", lambda peak: (0, peak)),
    342: ("TransferRange", lambda peak: (0, peak) * 3),
    532: ("ReferenceBlackWhite", lambda peak: (0, peak) * 3),
}
INK_TAGS = (332, 336)


def read_tiff(path: Path) -> FilePicture:
    """Read the picture of a TIFF file, upright."""
    import tifffile
    from tifffile import PHOTOMETRIC

    with tifffile.TiffFile(path) as file:
        if len(file.pages) != 1:
            raise FormatError(f"contains {len(file.pages)} pictures; provide a file with one picture")
        page: Any = file.pages[0]
        check_size(page.imagewidth, page.imagelength)
        photometric = page.photometric
        if photometric not in (
            *(
                PHOTOMETRIC.MINISWHITE,
                PHOTOMETRIC.MINISBLACK,
                PHOTOMETRIC.RGB,
                PHOTOMETRIC.PALETTE,
                PHOTOMETRIC.SEPARATED,
            ),
        ):
            name = getattr(photometric, "name", photometric)
            raise FormatError(f"is a TIFF with the colour space {name}; save it as grey, RGB or CMYK")
        has_inks = photometric == PHOTOMETRIC.SEPARATED
        if page.samplesperpixel > 4 or (has_inks and page.samplesperpixel != 4):
            raise FormatError(f"must be one picture of 1 to 4 channels, got {page.samplesperpixel}")
        _check_tags(page, has_inks=has_inks)
        picture = pixels_of_page(path, page)
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and picture.ndim == 3:
            picture = np.moveaxis(picture, 0, -1)
        if photometric == PHOTOMETRIC.PALETTE:
            picture = np.moveaxis(np.asarray(page.colormap)[:, picture], 0, -1)
        orientation = page.tags[ORIENTATION_TAG].value if ORIENTATION_TAG in page.tags else 1
        is_inverted = photometric == PHOTOMETRIC.MINISWHITE
        has_premultiplied_alpha = tifffile.EXTRASAMPLE.ASSOCALPHA in (page.extrasamples or ())
        colour = _colour(page, picture)
    if picture.dtype == np.bool_:
        picture = picture.astype(np.uint8) * np.uint8(255)
    if picture.dtype not in (np.uint8, np.uint16) and picture.dtype.kind != "f":
        raise FormatError(f"must contain 8-bit, 16-bit or floating-point numbers, got {picture.dtype}")
    if is_inverted:
        picture = (1 if picture.dtype.kind == "f" else np.iinfo(picture.dtype).max) - picture
    if has_premultiplied_alpha and picture.ndim == 3:
        picture = picture[..., :-1]  # premultiplied alpha: the colours are already composed with black
    pixels = picture.astype(np.float32) if picture.dtype.kind == "f" else picture
    return FilePicture(pixels=apply_orientation(pixels, orientation), colour=colour, has_inks=has_inks)


def _check_tags(page: Any, *, has_inks: bool) -> None:
    """Reject tags that change pixels and are not known, and pixels that are not square."""
    peak = 2 ** int(np.max(page.bitspersample)) - 1
    for tag in page.tags:
        if tag.code in REJECTED:
            raise FormatError(f"has the tag {tag.code}, {REJECTED[tag.code]}; save it as plain grey or RGB")
        if tag.code in DEFAULTS and (has_inks or tag.code not in INK_TAGS):
            name, default = DEFAULTS[tag.code]
            values = _numbers(page, tag.code)
            if values != default(peak) and values != default(peak) * (len(values) // 2):
                raise FormatError(f"has the tag {name} with {list(values)!s:.60}, expected {list(default(peak))}")
        if (
            tag.code < FIRST_PRIVATE
            and tag.code not in UNDERSTOOD
            and tag.code not in IRRELEVANT
            and tag.code not in DEFAULTS
        ):
            raise FormatError(f"has the unknown tag {tag.code}; save it as plain grey or RGB")
    resolutions = [_numbers(page, code) for code in (X_RESOLUTION, Y_RESOLUTION)]
    if all(len(pair) == 1 for pair in resolutions):
        check_square_pixels(1.0 / (resolutions[0][0] or np.inf), 1.0 / (resolutions[1][0] or np.inf), "resolution")


def _numbers(page: Any, code: int) -> tuple[float, ...]:
    """Return the numbers of a tag; rationals, which tifffile returns as pairs, as quotients."""
    if code not in page.tags:
        return ()
    tag = page.tags[code]
    values = np.atleast_1d(np.asarray(tag.value, np.float64)).ravel()
    if getattr(tag.dtype, "name", "") in ("RATIONAL", "SRATIONAL"):
        pairs = values.reshape(-1, 2)
        values = np.divide(pairs[:, 0], pairs[:, 1], out=np.zeros(len(pairs)), where=pairs[:, 1] != 0.0)
    return tuple(values.tolist())


def _colour(page: Any, picture: NDArray[Any]) -> Colour:
    """Return the colours that a page states."""
    # tifffile omits tags that it cannot read.
    lost = (_stored_codes(page) & COLOUR_TAGS) - {tag.code for tag in page.tags}
    if lost:
        return Colour(problem=f"has a broken colour profile or colour tag ({min(lost)})")
    if ICC_PROFILE in page.tags:
        profile = page.tags[ICC_PROFILE].value
        return (
            Colour(profile=profile)
            if isinstance(profile, bytes) and profile
            else Colour(problem="has a broken colour profile")
        )
    white, primaries = _numbers(page, WHITE_POINT), _numbers(page, PRIMARIES)
    if len(white) not in (0, 2) or len(primaries) not in (0, 6):
        return Colour(problem="has a broken tag WhitePoint or PrimaryChromaticities")
    rgb = primaries or tuple(SRGB_XY[:3].ravel().tolist())
    xy = (*rgb, *(white or tuple(SRGB_XY[3].tolist()))) if primaries or white else None
    if picture.dtype.kind == "f":
        return Colour(transfer="linear", primaries=xy)
    transfer: str | NDArray[Any] = "srgb"
    if TRANSFER_FUNCTION in page.tags:
        table = _transfer_tables(page, picture)
        if table is None:
            return Colour(problem="has a broken tag TransferFunction")
        transfer = table
        peak = table.shape[1] - 1
        if np.abs(table - np.arange(peak + 1) / peak).max() < 1.0 / 65535.0:
            transfer = "linear"
    if isinstance(transfer, str) and xy is None:
        return LINEAR if transfer == "linear" else SRGB
    return Colour(transfer=transfer, primaries=xy)


def _stored_codes(page: Any) -> set[int]:
    """Return the codes of the entries of a page in the file."""
    file, format_ = page.parent.filehandle, page.parent.tiff
    file.seek(page.offset)
    n = struct.unpack(format_.tagnoformat, file.read(format_.tagnosize))[0]
    entries = file.read(min(n, MAX_TAGS) * format_.tagsize)
    starts = range(0, len(entries) - format_.tagsize + 1, format_.tagsize)
    return {struct.unpack_from(f"{format_.byteorder}H", entries, start)[0] for start in starts}


def _transfer_tables(page: Any, picture: NDArray[Any]) -> NDArray[Any] | None:
    """Return the light of integers by TransferFunction, (1 or 3, 2**bits); None if broken."""
    values = np.atleast_1d(np.asarray(page.tags[TRANSFER_FUNCTION].value))
    n = int(np.iinfo(picture.dtype).max) + 1 if picture.dtype.kind == "u" else 2
    if (
        values.size not in (n, 3 * n)
        or values.dtype.kind not in "iu"
        or (values.size != n and page.samplesperpixel < 3)
    ):
        return None
    return values.reshape(-1, n) / 65535.0


def pixels_of_page(path: Path, page: Any) -> NDArray[Any]:
    """
    Return the pixels of a TIFF page, after checking that the file contains all of them.

    ``path``: the file. ``page``: page of the open file; tifffile would read missing data as 0. Raises FormatError when a strip
    or tile is outside the file or missing in the metadata.
    """
    n_bytes = path.stat().st_size
    segments = list(zip(page.dataoffsets, page.databytecounts, strict=False))
    n_expected = 1 if page.is_contiguous else math.prod(page.chunked)
    if len(segments) < n_expected or any(at <= 0 or n <= 0 or at + n > n_bytes for at, n in segments):
        raise FormatError("is corrupt or truncated")
    try:
        return np.asarray(page.asarray())
    except ValueError as error:
        if "imagecodecs" in str(error):
            raise FormatError(f"has a compression that {needs('imagecodecs')}") from None
        raise
