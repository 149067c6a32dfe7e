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
from foveasim._io.rasters.tiff import check_page, missing_value
from foveasim.fields import PowerMap, to_file_rows
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._json_metadata import found_in_metadata, map_metadata

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
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
        check_size((n_pages, *first.shape), first.dtype.itemsize, n_bytes)
        if n_pages > 1 and first.ndim != 2:
            raise FormatError(f"contains {n_pages} pages of shape {first.shape}, expected (n_y, n_x) per band")
        images = [pixels_of_page(path, page) for page in pages]
        data = images[0][np.newaxis] if n_pages == 1 else np.stack(images)
        if first.ndim == 3:
            data = _samples_first(data[0], first, tifffile)
        is_top_first = {check_page(page) for page in pages}
        missing = missing_value(first)
        description = str(first.description)
    if len(is_top_first) > 1:
        raise FormatError("contains pages of different orientations; write one equal page per band")
    if missing is not None and (data == missing).any():
        raise FormatError(f"contains pixels without data, {missing:g} by GDAL_NODATA; replace them")
    return found_in_metadata(description, data, is_y_descending=is_top_first.pop())


def _samples_first(data: NDArray[Any], page: Any, tifffile: Any) -> NDArray[Any]:
    return data if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE else np.moveaxis(data, -1, 0)


MAP_FORMATS.register(
    "tiff", FileFormat(title="TIFF", suffixes=(".tif", ".tiff"), signatures=MAGICS, read=read, write=write)
)
