"""Files of raw frames: the codes of a sensor, as they are stored."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from numpy.typing import NDArray

from foveasim._core.names import missing_path
from foveasim._core.work_arrays import work_array
from foveasim._io.formats import FormatError, as_file_error
from foveasim._io.images import TIFF_EXTENSIONS, read_picture
from foveasim._io.images._camera import read_mosaic
from foveasim._io.images._limits import RAW_EXTENSIONS, check_size
from foveasim._io.images._tiff import pixels_of_page
from foveasim._io.npz import read_array, read_header, read_into
from foveasim._io.rasters import max_decompressed_bytes
from foveasim._io.rasters.fits import open_fits, read_image, select_image
from foveasim._io.rasters.tiff import check_page
from foveasim._io.sandbox import read_in_sandbox
from foveasim.errors import FileError

__all__ = ["EXTENSIONS", "FirstRow", "stored_frames"]

FirstRow = Literal["top", "bottom"]
FITS_EXTENSIONS = (".fits", ".fit", ".fts")
#: Extensions of files with the codes of a sensor.
EXTENSIONS = (".npy", *TIFF_EXTENSIONS, ".png", *FITS_EXTENSIONS, *RAW_EXTENSIONS)
JPEG_MAGIC = b"\xff\xd8\xff"


def stored_frames(path: Path) -> tuple[Iterator[NDArray[Any]], FirstRow]:
    """
    Return the frames of a file, (n_y, n_x) each, and which of their rows is first.

    The codes of mosaics are not demosaiced, and those of camera raw files not rotated. Frames are read one after the other.
    Raises FileError when the file does not contain the codes of a sensor, or is corrupt; the iterator does so, too.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileError(path, missing_path(path))
    with path.open("rb") as file:
        is_jpeg = file.read(len(JPEG_MAGIC)) == JPEG_MAGIC
    if is_jpeg or suffix not in EXTENSIONS:
        raise FileError(
            path,
            "must contain the codes of the sensor, as npy, TIFF, PNG, FITS or camera raw file: JPEG files are lossy, and have "
            "another noise",
        )
    if suffix in FITS_EXTENSIONS:
        with as_file_error(path, "frame"), open_fits(path) as file:
            header = select_image(file, None, "the frames").header
            is_top = str(header.get("ROWORDER", "")).strip().upper() == "TOP-DOWN"
        return _frames(path, suffix), "top" if is_top else "bottom"
    return _frames(path, suffix), "top"


def _frames(path: Path, suffix: str) -> Iterator[NDArray[Any]]:
    """Yield the frames of a file."""
    with as_file_error(path, "frame"):
        if suffix in TIFF_EXTENSIONS:
            yield from _tiff(path)
            return
        if suffix == ".npy":
            yield from _npy(path)
            return
        if suffix in FITS_EXTENSIONS:
            with open_fits(path) as file:
                codes = read_image(select_image(file, None, "the frames"), path.stat().st_size)
        elif suffix in RAW_EXTENSIONS:
            limit = max_decompressed_bytes
            _, (codes,) = read_in_sandbox(read_mosaic, path, kind="raw", max_decompressed_bytes=limit)
        else:
            codes = read_picture(path)
            if codes.ndim != 2:
                raise FormatError(f"must have one channel, the codes of the mosaic, got {codes.shape[2]} channels")
        yield from codes if codes.ndim == 3 else [codes]


def _npy(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames of a ``.npy`` file, read one by one unless they are interleaved."""
    n_bytes = path.stat().st_size
    with path.open("rb") as file:
        shape, is_fortran, dtype = read_header(file, n_bytes)
        if len(shape) not in (2, 3) or not dtype.itemsize or (is_fortran and len(shape) == 3):
            file.seek(0)
            codes = read_array(file, n_bytes)
            yield from codes if codes.ndim == 3 else [codes]
            return
        for _ in range(shape[0] if len(shape) == 3 else 1):
            codes = work_array(shape[::-1] if is_fortran else shape[-2:], dtype)
            read_into(file, codes)
            yield codes.T if is_fortran else codes


def _tiff(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the pages of a TIFF file, the top row first."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        for page in file.pages:
            is_top_first = check_page(page)
            check_size(page.imagewidth, page.imagelength)
            codes = pixels_of_page(path, page)
            if codes.ndim != 2:
                raise FormatError(f"must have one channel, the codes of the mosaic, got the shape {codes.shape}")
            yield codes if is_top_first else codes[::-1]
