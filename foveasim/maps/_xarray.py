"""Power maps as labelled arrays (wavelength, y, x) with cell-centre coordinates."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._core.validation import Floats
from foveasim._io.formats import FormatError
from foveasim._io.rasters import pitch_of_axes
from foveasim._io.rasters.labels import (
    coordinate,
    in_order,
    is_unnamed,
    length_of_coordinate,
    squeeze,
    unit_of_array,
    wavelengths_of_array,
    with_attributes,
)
from foveasim.errors import ParameterError
from foveasim.fields import Grid, Pitch, PowerMap
from foveasim.maps._common import Found, Given, to_power_map
from foveasim.maps._units import Unit

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

#: Name of the map in a file with several arrays.
NAME = "irradiance"
#: Largest rounding error, in cells, between coordinates and the grid of the pitch and origin in attributes.
ROUNDING = 1e-6


def to_xarray(power_map: PowerMap) -> xr.DataArray:
    """
    Convert a power map to a labelled array.

    Parameters
    ----------
    power_map : PowerMap

    Returns
    -------
    xarray.DataArray (wavelength, y, x), W/m² per band
        The coordinates are wavelengths in nm and cell centres in µm, each with the attribute ``units``. The exact pitch and
        origin are also stored as attributes.

    Raises
    ------
    ParameterError
        If ``power_map`` is not a PowerMap, or xarray is missing.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> light = fs.PowerMap.from_array(np.ones((4, 6)), pitch_um=2.0, wavelength_nm=550.0)
    >>> array = fs.maps.to_xarray(light)
    >>> array.dims, array.attrs["units"]
    (('wavelength', 'y', 'x'), 'W m-2')
    """
    xr = import_optional("xarray", "xarray", "maps")
    grid = power_map.grid
    return xr.DataArray(
        power_map.data,
        dims=("wavelength", "y", "x"),
        coords={
            "wavelength": ("wavelength", power_map.wavelength_nm, {"units": "nm"}),
            "y": ("y", grid.y_um, {"units": "um"}),
            "x": ("x", grid.x_um, {"units": "um"}),
        },
        name=NAME,
        attrs={
            "units": "W m-2",
            "long_name": "irradiance per band",
            "pitch_um": np.asarray(grid.pitch_um).tolist(),
            "origin_um": list(grid.origin_um),
        },
    )


def from_xarray(
    data_array: xr.DataArray,
    *,
    pitch_um: Pitch | None = None,
    wavelength_nm: ArrayLike | None = None,
    band_width_nm: ArrayLike | None = None,
    unit: Unit | None = None,
    origin_um: tuple[float, float] | None = None,
) -> PowerMap:
    """
    Convert a labelled array to a power map.

    Parameters
    ----------
    data_array : xarray.DataArray (y, x) or (wavelength, y, x), in any order
        Coordinates with ``units`` specify pitch, origin and wavelengths. Positions may increase or decrease in uniform steps.
    pitch_um, wavelength_nm, band_width_nm, unit, origin_um
        As for :func:`read_power_map`.

    Returns
    -------
    PowerMap

    Raises
    ------
    ParameterError
        If the array has other dimensions or invalid values, or metadata are missing.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> light = fs.PowerMap.from_array(np.ones((4, 6)), pitch_um=2.0, wavelength_nm=550.0)
    >>> fs.maps.from_xarray(fs.maps.to_xarray(light)).grid == light.grid
    True
    """
    given = Given(
        pitch_um=pitch_um, wavelength_nm=wavelength_nm, band_width_nm=band_width_nm, unit=unit, origin_um=origin_um
    )
    try:
        return to_power_map(found_in_array(data_array), given)
    except FormatError as error:
        raise ParameterError("data_array", str(error)) from None


def found_in_array(array: xr.DataArray) -> Found:
    """
    Return data and metadata of a labelled array.

    Raises FormatError if the dimensions are not those of a map, or the coordinates are not uniform.
    """
    array = with_attributes(squeeze(array))
    if is_unnamed(array):
        return Found(data=array.to_numpy(), unit=unit_of_array(array))
    array, band, (y, x) = in_order(array)
    along_x, along_y = (coordinate(array, d) for d in (x, y))
    if along_x is None or along_y is None:
        descending = (along is not None and bool(along[0] > along[-1]) for along in (along_x, along_y))
        metadata: dict[str, Any] = dict(zip(("is_x_descending", "is_y_descending"), descending, strict=True))
    else:
        metadata = _axis_metadata(array, along_x, along_y, (x, y))
    return Found(
        data=array.to_numpy(),
        wavelength_nm=wavelengths_of_array(array, band),
        unit=unit_of_array(array),
        **metadata,
    )


def _axis_metadata(array: xr.DataArray, x: Floats, y: Floats, names: tuple[Hashable, Hashable]) -> dict[str, Any]:
    """Return axis directions, and pitch and origin if the coordinates have units of length."""
    step_x, step_y = pitch_of_axes(x, y)
    metadata: dict[str, Any] = {"is_x_descending": (step_x or 1.0) < 0.0, "is_y_descending": (step_y or 1.0) < 0.0}
    units_um = [length_of_coordinate(array.coords[name], name) for name in names]
    if None in units_um:
        return metadata
    unit_x_um, unit_y_um = (unit for unit in units_um if unit is not None)
    exact = _exact_grid(array, x * unit_x_um, y * unit_y_um)
    if exact is not None:
        return {**metadata, "pitch_um": (exact.pitch_x_um, exact.pitch_y_um), "origin_um": exact.origin_um}
    if step_x is None and step_y is None:
        return metadata
    pitch_x = abs(step_x) * unit_x_um if step_x is not None else None
    pitch_y = abs(step_y) * unit_y_um if step_y is not None else None
    pitch = (pitch_x or pitch_y or 0.0, pitch_y or pitch_x or 0.0)
    origin = (float(x.min()) * unit_x_um - 0.5 * pitch[0], float(y.min()) * unit_y_um - 0.5 * pitch[1])
    return {**metadata, "pitch_um": pitch, "origin_um": origin}


def _exact_grid(array: xr.DataArray, x_um: Floats, y_um: Floats) -> Grid | None:
    """
    Return the exact grid from the attributes, or None if the coordinates differ from it.

    They differ in a slice, which keeps the attributes of the complete array.
    """
    pitch, origin = array.attrs.get("pitch_um"), array.attrs.get("origin_um")
    if pitch is None or origin is None:
        return None
    try:
        x0, y0 = np.asarray(origin, dtype=np.float64).tolist()
        grid = Grid((y_um.size, x_um.size), np.asarray(pitch, dtype=np.float64).tolist(), (x0, y0))
    except (TypeError, ValueError):
        return None
    far_x = np.abs(np.sort(x_um) - grid.x_um).max() / grid.pitch_x_um
    far_y = np.abs(np.sort(y_um) - grid.y_um).max() / grid.pitch_y_um
    return grid if max(far_x, far_y) <= ROUNDING else None
