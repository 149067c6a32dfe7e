"""
Power maps in TIFF files: bands as pages, or as samples of one page; top row first.

Pitch, origin, wavelengths and unit are stored as JSON in the description of the first page.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.images import pixels_of_page
from foveasim._io.rasters import MAX_BANDS, check_size
from foveasim.fields import PowerMap, to_file_rows
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._json_metadata import found_in_metadata, map_metadata

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
#: TIFF tag of the orientation, and its values for top row first and bottom row first.
ORIENTATION_TAG, TOP_FIRST, BOTTOM_FIRST = 274, 1, 4
#: Maximum data size of a classic TIFF: 4 GiB minus a reserve for metadata.
CLASSIC_BYTES = 2**32 - 2**24


def write(power_map: PowerMap, path: Path) -> None:
    """Write one uncompressed page per band."""
    import tifffile

    description = json.dumps(map_metadata(power_map))
    is_big = power_map.data.nbytes > CLASSIC_BYTES
    with tifffile.TiffWriter(path, bigtiff=is_big) as file:
        for band, image in enumerate(power_map.data):
            file.write(
                np.ascontiguousarray(to_file_rows(image)),
                photometric="minisblack",
                description=description if band == 0 else "",
                metadata=None,
                contiguous=False,
            )


def read(path: Path, name: str | None) -> Found:
    """Read all pages as bands, or the samples of one page."""
    import tifffile

    if name is not None:
        raise FormatError("contains one unnamed map; omit name=")
    n_bytes = path.stat().st_size
    with tifffile.TiffFile(path) as file:
        n_pages = len(file.pages)
        if not 1 <= n_pages <= MAX_BANDS:
            raise FormatError(f"contains {n_pages} pages, expected 1 to {MAX_BANDS}, one per band")
        pages = [file.pages[i] for i in range(n_pages)]
        first: Any = pages[0]
        for page in pages:
            if page.shape != first.shape or page.dtype != first.dtype or page.dtype is None:
                raise FormatError("contains pages of different sizes or dtypes; write one equal page per band")
            if page.photometric not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB):
                raise FormatError("has an unsupported photometric interpretation; save values with 0 as black")
        check_size((n_pages, *first.shape), first.dtype.itemsize, n_bytes)
        if n_pages > 1 and first.ndim != 2:
            raise FormatError(f"contains {n_pages} pages of shape {first.shape}, expected (n_y, n_x) per band")
        images = [pixels_of_page(path, page) for page in pages]
        data = images[0][np.newaxis] if n_pages == 1 else np.stack(images)
        if first.ndim == 3:
            data = _samples_first(data[0], first, tifffile)
        orientation = first.tags[ORIENTATION_TAG].value if ORIENTATION_TAG in first.tags else TOP_FIRST
        description = str(first.description)
    if orientation not in (TOP_FIRST, BOTTOM_FIRST):
        raise FormatError(f"has the unsupported orientation {orientation!s:.10}; save it with orientation 1 or 4")
    return found_in_metadata(description, data, is_y_descending=orientation == TOP_FIRST)


def _samples_first(data: NDArray[Any], page: Any, tifffile: Any) -> NDArray[Any]:
    return data if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE else np.moveaxis(data, -1, 0)


MAP_FORMATS.register(
    "tiff", FileFormat(title="TIFF", suffixes=(".tif", ".tiff"), signatures=MAGICS, read=read, write=write)
)
