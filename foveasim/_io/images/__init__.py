"""
Reading and writing of picture files.

Arrays have the shape (n_y, n_x) or (n_y, n_x, n_channel), top row first. Each reader knows three classes of what a file states
besides its pixels: what is understood, what is irrelevant, and what is rejected by name, which is the rest.
"""

from __future__ import annotations

from pathlib import Path

from foveasim._io.formats import FormatError
from foveasim._io.images._colour import EncodedPicture
from foveasim._io.images._limits import (
    MAX_PIXELS,
    ORIENTATION_TAG,
    PICTURE_EXTENSIONS,
    TIFF_EXTENSIONS,
    check_size,
    picture_names,
)
from foveasim._io.images._reading import as_encoded, read_picture
from foveasim._io.images._tiff import pixels_of_page
from foveasim._io.images._writing import PictureFormat, picture_format, write_picture
from foveasim.errors import FileError

__all__ = [
    "MAX_PIXELS",
    "ORIENTATION_TAG",
    "PICTURE_EXTENSIONS",
    "TIFF_EXTENSIONS",
    "EncodedPicture",
    "PictureFormat",
    "as_encoded",
    "check_picture_size",
    "picture_format",
    "picture_names",
    "pixels_of_page",
    "read_picture",
    "write_picture",
]


def check_picture_size(path: Path, width: int, height: int) -> None:
    """
    Check the picture size in a file header, before memory is allocated.

    Raises FileError when the number of pixels exceeds ``MAX_PIXELS``.
    """
    try:
        check_size(width, height)
    except FormatError as error:
        raise FileError(path, str(error)) from None
