"""Cubes from arrays in memory, numpy files, and TIFF files of many bands."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.validation import Floats, as_any_array
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.images import TIFF_EXTENSIONS, check_picture_size
from foveasim._io.npz import read_array
from foveasim._io.rasters.tiff import check_page, missing_value
from foveasim.errors import ParameterError
from foveasim.scene.cubes._cube import EXAMPLE_NM, EXAMPLE_UNIT, Cube, example_radiance
from foveasim.scene.cubes._formats import CUBE_FORMATS
from foveasim.scene.cubes._labelled import cube_of_array

#: First bytes of numpy files, and of TIFF and BigTIFF files of either byte order.
NUMPY_MAGIC = b"\x93NUMPY"
TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def cube_of(array: Any, axis: int) -> Cube:
    """
    Return the cube of an array (n_y, n_x, n_band), top row first.

    ``axis``: axis of the bands; an xarray.DataArray has named dimensions instead. Raises ParameterError for other arrays.
    """
    xarray = sys.modules.get("xarray")
    if xarray is not None and isinstance(array, xarray.DataArray):
        return cube_of_array(array)
    values = as_any_array("path", array)
    if values.ndim not in (2, 3):
        raise ParameterError("path", f"must be a file, or an array of rows, columns and bands, got {values.shape}")
    if values.ndim == 2:
        return Cube(data=np.array(values[np.newaxis]))
    if not -3 <= axis < 3:
        raise ParameterError("axis", "must be an axis of the array, from -3 to 2", axis)
    return Cube(data=np.array(np.moveaxis(values, axis, 0), order="C"))


@contextmanager
def array_errors() -> Iterator[None]:
    """Convert the problems of a cube in an array to errors of the parameter."""
    try:
        yield
    except FormatError as error:
        raise ParameterError("path", f"is an array that {error}") from None


def _read_numpy(path: Path, _name: str | None) -> Cube:
    with path.open("rb") as file:
        return cube_of(read_array(file, path.stat().st_size), -1)


def _read_tiff(path: Path, _name: str | None) -> Cube:
    """Read the samples of one page, or pages of one sample each, as bands."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        series = file.series[0]
        shape, axes = series.shape, series.axes
        if len(shape) != 3 or axes.count("Y") + axes.count("X") != 2:
            raise FormatError(f"contains an array of the axes {axes!r:.20}, expected rows, columns and bands")
        check_picture_size(path, int(np.prod(shape)), 1)
        is_top_first = {check_page(page.keyframe) for page in series.pages if page is not None}
        if len(is_top_first) > 1:
            raise FormatError("contains pages of different orientations; write one equal page per band")
        missing = missing_value(file.pages[0])
        values = series.asarray()
    band = next(k for k, name in enumerate(axes) if name not in "YX")
    order = (band, axes.index("Y"), axes.index("X"))
    return Cube(data=values.transpose(order), is_y_descending=is_top_first.pop(), missing=missing)


#: Metadata that these files lack.
_METADATA = {"wavelength_nm": EXAMPLE_NM, "unit": EXAMPLE_UNIT}


def _example_numpy(path: Path) -> tuple[Floats, dict[str, Any]]:
    radiance = example_radiance()
    np.save(path, np.moveaxis(radiance[:, ::-1], 0, -1))
    return radiance, _METADATA


def _example_tiff(path: Path) -> tuple[Floats, dict[str, Any]]:
    import tifffile

    radiance = example_radiance()
    tifffile.imwrite(path, radiance[:, ::-1].astype(np.float32), photometric="minisblack")
    return radiance, _METADATA


NUMPY = FileFormat(title="numpy array", suffixes=(".npy",), signatures=(NUMPY_MAGIC,), read=_read_numpy)
TIFF = FileFormat(title="TIFF", suffixes=TIFF_EXTENSIONS, signatures=TIFF_MAGIC, read=_read_tiff)
CUBE_FORMATS.register("numpy", NUMPY, example=_example_numpy)
CUBE_FORMATS.register("tiff", TIFF, example=_example_tiff)
