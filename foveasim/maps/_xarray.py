"""Power maps as labelled arrays (wavelength, y, x) with cell-centre coordinates."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.extras import install_hint
from foveasim._core.validation import Floats
from foveasim._io.formats import FormatError
from foveasim.errors import ParameterError, type_name
from foveasim.fields import Grid, Pitch, PowerMap
from foveasim.maps._common import Found, Given, pitch_of_axes, to_power_map
from foveasim.maps._units import Unit, length_in_um

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

__all__ = ["NAME", "found_in_array", "from_xarray", "to_xarray"]

#: Name of the map in a file with several arrays.
NAME = "irradiance"
#: Accepted names of dimensions; the first is the name that is written.
X = ("x", "x_um", "col", "cols", "column", "n_x")
Y = ("y", "y_um", "row", "rows", "n_y")
BAND = ("wavelength", "wavelength_nm", "wavelengths", "wave", "wl", "lambda", "band", "bands", "channel")
#: Prefixes of names that libraries generate for unnamed dimensions.
UNNAMED_PREFIXES = ("phony_dim_", "dim_")
#: Largest difference, in cells, of coordinates from the pitch and origin in attributes: rounding errors.
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
    """
    if not isinstance(power_map, PowerMap):
        raise ParameterError("power_map", f"must be a PowerMap, got {type_name(power_map)}")
    xr = _import_xarray()
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
    """
    xr = _import_xarray()
    if not isinstance(data_array, xr.DataArray):
        raise ParameterError("data_array", f"must be an xarray.DataArray, got {type_name(data_array)}")
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

    Raises
    ------
    FormatError
        If the dimensions are not those of a map, or the coordinates are not uniform.
    """
    array = array.squeeze([d for d in array.dims if array.sizes[d] == 1 and d not in (*X, *Y, *BAND)], drop=True)
    names = list(array.dims)
    if len(names) in (2, 3) and all(str(d).startswith(UNNAMED_PREFIXES) for d in names):
        return Found(data=array.to_numpy(), unit=_unit(array))
    if 0 in array.shape:
        raise FormatError(f"contains an empty array of shape {array.shape}")
    x, y = _one_of(names, X), _one_of(names, Y)
    rest = [d for d in names if d not in (x, y)]
    if x is None or y is None or len(rest) > 1:
        dims = ", ".join(str(d)[:20] for d in names[:6])
        raise FormatError(f"has the dimensions ({dims}), expected (wavelength, y, x); rename them")
    array = array.transpose(*rest, y, x)
    along_x, along_y = (_coordinate(array, d) for d in (x, y))
    if along_x is None or along_y is None:
        descending = (along is not None and bool(along[0] > along[-1]) for along in (along_x, along_y))
        metadata: dict[str, Any] = dict(zip(("is_x_descending", "is_y_descending"), descending, strict=True))
    else:
        metadata = _axis_metadata(array, along_x, along_y, (x, y))
    return Found(
        data=array.to_numpy(),
        wavelength_nm=_wavelengths_nm(array, rest[0] if rest else None),
        unit=_unit(array),
        **metadata,
    )


def _one_of(names: list[Hashable], known: tuple[str, ...]) -> Hashable | None:
    found = [name for name in names if str(name).lower() in known]
    return found[0] if len(found) == 1 else None


def _coordinate(array: xr.DataArray, name: Hashable) -> Floats | None:
    if name not in array.coords or array.coords[name].dims != (name,):
        return None
    values = array.coords[name].to_numpy()
    if values.dtype.kind not in "iuf":
        raise FormatError(f"has non-numeric coordinates along {name!s:.20}")
    return values.astype(np.float64)


def _axis_metadata(array: xr.DataArray, x: Floats, y: Floats, names: tuple[Hashable, Hashable]) -> dict[str, Any]:
    """Return axis directions, and pitch and origin if the coordinates have units of length."""
    step_x, step_y = pitch_of_axes(x, y)
    metadata: dict[str, Any] = {"is_x_descending": (step_x or 1.0) < 0.0, "is_y_descending": (step_y or 1.0) < 0.0}
    per = [_per_um(array.coords[name], name) for name in names]
    if None in per:
        return metadata
    per_x, per_y = (p for p in per if p is not None)
    exact = _exact_grid(array, x * per_x, y * per_y)
    if exact is not None:
        return {**metadata, "pitch_um": (exact.pitch_x_um, exact.pitch_y_um), "origin_um": exact.origin_um}
    if step_x is None and step_y is None:
        return metadata
    pitch_x = abs(step_x) * per_x if step_x is not None else None
    pitch_y = abs(step_y) * per_y if step_y is not None else None
    pitch = (pitch_x or pitch_y or 0.0, pitch_y or pitch_x or 0.0)
    low = (float(x.min()) * per_x - 0.5 * pitch[0], float(y.min()) * per_y - 0.5 * pitch[1])
    return {**metadata, "pitch_um": pitch, "origin_um": low}


def _per_um(coordinate: xr.DataArray, name: Hashable) -> float | None:
    units = coordinate.attrs.get("units")
    return length_in_um(units) if isinstance(units, str) else 1.0 if str(name).endswith("_um") else None


def _exact_grid(array: xr.DataArray, x_um: Floats, y_um: Floats) -> Grid | None:
    """
    Return the exact grid from the attributes, or None if the coordinates differ from it.

    A slice of an array has the attributes of the complete array.
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


def _wavelengths_nm(array: xr.DataArray, dimension: Hashable | None) -> list[float] | None:
    """Return the wavelengths from the coordinate of the dimension, or from a known name."""
    for name in (dimension, *BAND[:6]):
        if name not in array.coords:
            continue
        coordinate = array.coords[name]
        is_along = coordinate.dims in ((dimension,), ()) and coordinate.dtype.kind in "iuf"
        per_um = _per_um(coordinate, str(name))
        if per_um is None and str(name).endswith("_nm") and "units" not in coordinate.attrs:
            per_um = 1e-3
        if is_along and per_um is not None:
            waves_nm = np.atleast_1d(coordinate.to_numpy()).astype(np.float64)
            per_nm = per_um * 1e3
            return (waves_nm if per_nm == 1.0 else waves_nm * per_nm).tolist()
    return None


def _unit(array: xr.DataArray) -> str | None:
    units = array.attrs.get("units", array.attrs.get("unit"))
    return units if isinstance(units, str) and units.strip() else None


def _import_xarray() -> Any:
    try:
        import xarray as xr
    except ImportError:
        raise ParameterError("xarray", f"must be installed; {install_hint('xarray', 'maps')}") from None
    return xr
