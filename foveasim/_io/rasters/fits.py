"""FITS files, opened with astropy: size limits of images, without compressed parts."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.rasters import check_size

MAGIC = b"SIMPLE  ="


@contextlib.contextmanager
def open_fits(path: Path) -> Iterator[Any]:
    """Open a FITS file; yield its header-data units, which are read on access."""
    fits = import_optional(path, "astropy.io.fits")
    with (
        warnings.catch_warnings(),
        path.open("rb") as binary,  # astropy does not close truncated files
        fits.open(binary, mode="readonly", memmap=False, disable_image_compression=True, lazy_load_hdus=True) as file,
    ):
        warnings.simplefilter("ignore")  # warns about deviations from the standard
        yield file


def read_image(hdu: Any, n_bytes: int) -> NDArray[Any]:
    """
    Return the image of a header-data unit of a file of ``n_bytes``.

    Raises FormatError, before memory is allocated, if the image is too large or truncated.
    """
    itemsize = abs(int(hdu.header["BITPIX"])) // 8
    check_size(hdu.shape, max(itemsize, 1), n_bytes)
    if math.prod(hdu.shape) * itemsize > n_bytes:
        raise FormatError("is truncated")
    return np.asarray(hdu.data)
