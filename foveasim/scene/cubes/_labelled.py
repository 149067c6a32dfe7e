"""
Cubes in netCDF files and zarr directories.

The dimensions are wavelength, y and x, in any order; without names they are y, x and wavelength. The attribute ``units`` of
the array is the unit of its values, and that of the coordinates is the unit of wavelengths and positions. Rows and columns with
positions in a unit of length specify the pixel pitch.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._core.validation import Floats
from foveasim._io.rasters import pitch_of_axes
from foveasim._io.rasters.datasets import NETCDF, ZARR, open_netcdf, open_zarr, select_array
from foveasim._io.rasters.labels import (
    BAND,
    coordinate,
    in_order,
    is_unnamed,
    length_of_coordinate,
    squeeze,
    text_of,
    unit_of_array,
    with_attributes,
)
from foveasim.scene.cubes._cube import EXAMPLE_NM, EXAMPLE_UNIT, Cube, example_radiance
from foveasim.scene.cubes._formats import CUBE_FORMATS

if TYPE_CHECKING:
    import xarray as xr


def _read(
    open_dataset: Callable[[Path], AbstractContextManager[tuple[xr.Dataset, int]]], path: Path, name: str | None
) -> Cube:
    """Read the named array, or the only one of three dimensions."""
    with ExitStack() as stack:
        dataset, n_bytes = stack.enter_context(open_dataset(path))
        array = select_array(dataset, name, n_bytes, min_ndim=3, what="the cube")
        # Values are read when they are selected, and the file is then closed.
        return cube_of_array(array, close=stack.pop_all().close)


def cube_of_array(array: xr.DataArray, close: Callable[[], None] | None = None) -> Cube:
    """
    Return the cube of a labelled array; the values are not read.

    Raises FormatError if the dimensions are not those of a cube, or the positions are not uniform.
    """
    array = with_attributes(array)
    if array.ndim == 3 and is_unnamed(array):  # datasets of HDF5 files without dimension scales, as numpy arrays
        array = array.rename(dict(zip(array.dims, ("y", "x", "band"), strict=True)))
    array, band, (y, x) = in_order(squeeze(array))
    along_x, along_y = (coordinate(array, d) for d in (x, y))
    metadata: dict[str, Any] = {}
    if along_x is not None and along_y is not None:
        per = [length_of_coordinate(array.coords[d], d) for d in (x, y)]
        if None not in per:
            steps = pitch_of_axes(along_x, along_y)
            pitch = [
                abs(step) * one for step, one in zip(steps, per, strict=True) if step is not None and one is not None
            ]
            metadata["pitch_um"] = (pitch[0], pitch[-1]) if pitch else None
    wavelength, unit = _wavelengths(array, band)
    return Cube(
        data=array,
        # Rows without positions have the top row first, as in pictures.
        is_y_descending=along_y is None or bool(along_y[0] > along_y[-1]),
        is_x_descending=along_x is not None and bool(along_x[0] > along_x[-1]),
        wavelength=wavelength,
        wavelength_unit=unit,
        unit=unit_of_array(array),
        close=close,
        **metadata,
    )


def _wavelengths(array: xr.DataArray, band: Hashable | None) -> tuple[list[float] | None, str | None]:
    """Return wavelengths and their unit from a coordinate of the bands."""
    for name in (*BAND[:6], band):
        if name is None or name not in array.coords:
            continue
        along = array.coords[name]
        if along.dims not in ((band,), ()) or along.dtype.kind not in "iuf":
            continue
        unit = text_of(along.attrs.get("units", "nm" if str(name).endswith("_nm") else None))
        return along.to_numpy().astype(float).ravel().tolist(), unit
    return None, None


def _example(path: Path) -> Floats:
    """Write an array with ascending y."""
    xr, radiance = import_optional(path, "xarray", "maps"), example_radiance()
    coords = {"wavelength": ("wavelength", list(EXAMPLE_NM), {"units": "nm"}), "y": np.arange(4.0), "x": np.arange(5.0)}
    array = xr.DataArray(radiance, coords, ("wavelength", "y", "x"), "radiance", {"units": EXAMPLE_UNIT})
    if path.suffix == ".zarr":
        array.to_dataset().to_zarr(path, zarr_format=3, consolidated=False)
    else:
        array.to_netcdf(path, engine="h5netcdf")
    return radiance


CUBE_FORMATS.register(
    "netcdf",
    replace(NETCDF, suffixes=(*NETCDF.suffixes, ".h5"), read=partial(_read, open_netcdf)),
    example=_example,
)
CUBE_FORMATS.register("zarr", replace(ZARR, read=partial(_read, open_zarr)), example=_example)
