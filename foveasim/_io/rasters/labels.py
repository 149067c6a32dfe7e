"""
Dimensions, coordinates, units and attributes of labelled arrays (wavelength, y, x).

xarray applies ``scale_factor``, ``add_offset``, ``_FillValue``, ``missing_value`` and ``_Unsigned`` of files (CF conventions,
section 8.1); values outside ``valid_range``, ``valid_min`` and ``valid_max`` are missing. Other attributes do not change the
values, unless one of :data:`RELEVANT` is in their names, which is an error.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.validation import Floats
from foveasim._io.formats import FormatError
from foveasim._io.rasters.units import length_in_um

if TYPE_CHECKING:
    import xarray as xr

#: Accepted names of dimensions; the first is the name that is written.
X = ("x", "x_um", "col", "cols", "column", "n_x")
Y = ("y", "y_um", "row", "rows", "n_y")
BAND = ("wavelength", "wavelength_nm", "wavelengths", "wave", "wl", "lambda", "band", "bands", "channel")
#: Prefixes of names that libraries generate for unnamed dimensions.
UNNAMED_PREFIXES = ("phony_dim_", "dim_")
#: Attributes that are read; pitch and origin are those of foveasim's maps.
UNDERSTOOD = frozenset(("units", "unit", "valid_range", "valid_min", "valid_max", "pitch_um", "origin_um"))
#: Attributes with parts of :data:`RELEVANT` in their names that do not change the values: how they are displayed.
IRRELEVANT = frozenset(
    ("colour_scale", "color_scale", "scale_type", "units_metadata", "wavelength_units", "long_units")
)
#: Parts of the names of attributes that change the values.
RELEVANT = re.compile(
    r"gain|offset|scal|factor|slope|intercept|unit|fill|missing|nodata|no_data|mask|invalid|calib|quanti|gamma|log10|linear|dark",
    re.IGNORECASE,
)


def with_attributes(array: xr.DataArray) -> xr.DataArray:
    """
    Return an array with the values that its attributes describe.

    Values outside of the valid range are NaN. Raises FormatError for an attribute that may change the values and is not known,
    or a range that is not numbers.
    """
    for name in map(str, array.attrs):
        if name.lower() not in UNDERSTOOD | IRRELEVANT and RELEVANT.search(name):
            raise FormatError(f"has the attribute {name!r:.60}, which may change the values; apply it, and remove it")
    low, high = _range(array, "valid_min", 0), _range(array, "valid_max", 1)
    if low is not None:
        array = array.where(array >= low)
    if high is not None:
        array = array.where(array <= high)
    return array


def _range(array: xr.DataArray, name: str, end: int) -> float | None:
    """Return an end of the valid range, which a file specifies for its packed values."""
    value: Any = array.attrs.get(name)
    if value is None and "valid_range" in array.attrs:
        both = np.asarray(array.attrs["valid_range"])
        value = both[end] if both.shape == (2,) else both
    if value is None:
        return None
    if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf":
        raise FormatError(f"has an invalid attribute 'valid_range' or '{name}', expected numbers")
    return float(value) * float(array.encoding.get("scale_factor", 1.0)) + float(array.encoding.get("add_offset", 0.0))


def text_of(value: Any) -> str | None:
    """Return an attribute as text; None for other values."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else None


def squeeze(array: xr.DataArray) -> xr.DataArray:
    """Drop dimensions of size 1 other than rows, columns and bands."""
    return array.squeeze([d for d in array.dims if array.sizes[d] == 1 and d not in (*X, *Y, *BAND)], drop=True)


def is_unnamed(array: xr.DataArray) -> bool:
    """Return whether an array has two or three dimensions without names."""
    return array.ndim in (2, 3) and all(str(d).startswith(UNNAMED_PREFIXES) for d in array.dims)


def in_order(array: xr.DataArray) -> tuple[xr.DataArray, Hashable | None, tuple[Hashable, Hashable]]:
    """
    Return the array as ([band,] y, x), and its dimensions.

    Those are the dimension of the bands or None, and those of rows and columns.

    Raises FormatError if the array is empty, or has other dimensions.
    """
    if 0 in array.shape:
        raise FormatError(f"contains an empty array of shape {array.shape}")
    names = list(array.dims)
    x, y = _one_of(names, X), _one_of(names, Y)
    rest = [d for d in names if d not in (x, y)]
    if x is None or y is None or len(rest) > 1:
        dims = ", ".join(str(d)[:20] for d in names[:6])
        raise FormatError(f"has the dimensions ({dims}), expected (wavelength, y, x); rename them")
    return array.transpose(*rest, y, x), rest[0] if rest else None, (y, x)


def _one_of(names: list[Hashable], known: tuple[str, ...]) -> Hashable | None:
    found = [name for name in names if str(name).lower() in known]
    return found[0] if len(found) == 1 else None


def coordinate(array: xr.DataArray, name: Hashable) -> Floats | None:
    """Return the coordinates of a dimension, or None."""
    if name not in array.coords or array.coords[name].dims != (name,):
        return None
    values = array.coords[name].to_numpy()
    if values.dtype.kind not in "iuf":
        raise FormatError(f"has non-numeric coordinates along {name!s:.20}")
    return values.astype(np.float64)


def length_of_coordinate(along: xr.DataArray, name: Hashable) -> float | None:
    """Return the unit of a coordinate in µm, or None if it is not a length."""
    units = text_of(along.attrs.get("units"))
    return length_in_um(units) if units is not None else 1.0 if str(name).endswith("_um") else None


def wavelengths_of_array(array: xr.DataArray, dimension: Hashable | None) -> list[float] | None:
    """Return the wavelengths from the coordinate of the dimension, or from a known name."""
    for name in (dimension, *BAND[:6]):
        if name not in array.coords:
            continue
        along = array.coords[name]
        is_along = along.dims in ((dimension,), ()) and along.dtype.kind in "iuf"
        per_um = length_of_coordinate(along, str(name))
        if per_um is None and str(name).endswith("_nm") and "units" not in along.attrs:
            per_um = 1e-3
        if is_along and per_um is not None:
            waves_nm = np.atleast_1d(along.to_numpy()).astype(np.float64)
            per_nm = per_um * 1e3
            return (waves_nm if per_nm == 1.0 else waves_nm * per_nm).tolist()
    return None


def unit_of_array(array: xr.DataArray) -> str | None:
    """Return the attribute ``units`` or ``unit``, or None."""
    units = text_of(array.attrs.get("units", array.attrs.get("unit")))
    return units if units is not None and units.strip() else None
