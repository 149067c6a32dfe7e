"""Names of picture files, and checks of all formats: size, orientation, square pixels."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable
from typing import Any

from numpy.typing import NDArray

from foveasim._io.formats import FormatError

#: Larger pictures are rejected: 2**28 pixels are 3 GiB as three float32 channels.
MAX_PIXELS = 2**28
#: Limit of decompressed EXR data: a constant, plus the maximum compression ratio of deflate per byte of the file.
MIN_DECOMPRESSED_BYTES, MAX_DECOMPRESSION_RATIO = 2**28, 1032
#: Orientation tag of TIFF and EXIF.
ORIENTATION_TAG = 274
TIFF_EXTENSIONS = (".tif", ".tiff")
#: Extensions of camera raw files, most of which are TIFF files by their first bytes.
RAW_EXTENSIONS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".dng", ".erf", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw", ".orf"),
    *(".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
#: Extensions of picture files in directories.
PICTURE_EXTENSIONS = (
    *(".avif", ".bmp", ".exr", ".hdr", ".heic", ".heif", ".jp2", ".jpeg", ".jpg", ".png", ".ppm", ".tga"),
    *TIFF_EXTENSIONS,
    ".webp",
    *RAW_EXTENSIONS,
)
#: Ratios of width and height of pixels that are square: rounded resolutions.
SQUARE_TOLERANCE = 0.02


def picture_names(names: Iterable[str]) -> list[str]:
    """
    Return the names of pictures in natural order, ``2.png`` before ``10.png``.

    Hidden files are skipped.
    """
    pictures = (
        name
        for name in names
        if posixpath.splitext(name)[1].lower() in PICTURE_EXTENSIONS
        and not any(part != "." and part.startswith((".", "__MACOSX")) for part in name.split("/"))
    )

    def key(name: str) -> tuple[list[tuple[int, str]], str]:
        # Without leading zeros, integers compare by length and then digits; equal keys compare by name.
        pieces = enumerate(re.split(r"([0-9]+)", name))
        return [(len(n := p.lstrip("0")), n) if k % 2 else (-1, p) for k, p in pieces if p], name

    return sorted(set(pictures), key=key)


def check_size(width: int, height: int) -> None:
    """
    Check the picture size in a file header, before memory is allocated.

    Raises FormatError when the number of pixels exceeds ``MAX_PIXELS``.
    """
    if width * height > MAX_PIXELS:
        raise FormatError(f"has {width} x {height} pixels, more than the limit of {MAX_PIXELS}")


def check_square_pixels(x: float, y: float, name: str) -> None:
    """
    Check a resolution, or the size of pixels, along x and y; 0 is unknown.

    ``name``: of the entry of the file. Raises FormatError when the pixels are not square.
    """
    if x > 0.0 and y > 0.0 and abs(x / y - 1.0) > SQUARE_TOLERANCE:
        raise FormatError(f"has pixels that are not square ({name} {x:g} x {y:g}); save it with square pixels")


def apply_orientation(picture: NDArray[Any], orientation: object) -> NDArray[Any]:
    """Apply the orientation tag 274 of EXIF and TIFF; values other than 2 to 8 mean upright."""
    if orientation in (5, 6, 7, 8):
        picture = picture.swapaxes(0, 1)
    return picture[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def max_decompressed_bytes(n_bytes: int) -> int:
    """Return the maximum size of the pixels of a file of this size, for the sandbox process."""
    return min(MIN_DECOMPRESSED_BYTES + MAX_DECOMPRESSION_RATIO * n_bytes, 16 * MAX_PIXELS)
