"""Common parts of the map formats: size limits, metadata and their validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import (
    Floats,
    Images,
    band_widths_nm,
    check_number,
    check_pitch_um,
    finite_array,
    read_only,
    wavelengths_nm,
)
from foveasim._io.formats import FormatError
from foveasim._io.rasters import as_images
from foveasim.errors import ParameterError
from foveasim.fields import Grid, Pitch, PowerMap, with_ascending_axes
from foveasim.maps._units import PER_NM, UNITS, Unit, irradiance_unit, per_band_w_m2

#: Relative tolerance of square cells: rounding error of a pitch from float32 coordinates.
SQUARE_TOLERANCE = 1e-6
#: Largest negative value relative to the maximum: rounding error of Fourier transforms in float32.
NEGATIVE_TOLERANCE = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """
    Data and metadata of a map in a file; None for missing metadata.

    Attributes
    ----------
    data : (n_y, n_x) or (n_band, n_y, n_x)
        Values of any numeric dtype, rows and columns in file order.
    is_y_descending, is_x_descending : bool
        Whether the first row is the top row, and the first column the rightmost column.
    pitch_um : (along x, along y), µm
    origin_um : (x0, y0), µm
    pitch_deg, origin_deg : (along x, along y), degrees
        Pitch and origin of a file in angles, instead of lengths.
    wavelength_nm, band_width_nm : (n_band,), nm
    unit : str
        Unit as written in the file: ``w_m2``, ``W m-2 nm-1``, ``uW/cm^2``, ...
    """

    data: NDArray[Any]
    is_y_descending: bool = False
    is_x_descending: bool = False
    pitch_um: tuple[float, float] | None = None
    origin_um: tuple[float, float] | None = None
    pitch_deg: tuple[float, float] | None = None
    origin_deg: tuple[float, float] | None = None
    wavelength_nm: Sequence[float] | None = None
    band_width_nm: Sequence[float] | None = None
    unit: str | None = None

    __repr__ = short_repr


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """Metadata of a map passed by the caller, which override the file; None if not passed."""

    pitch_um: Pitch | None = None
    wavelength_nm: ArrayLike | None = None
    band_width_nm: ArrayLike | None = None
    unit: Unit | None = None
    origin_um: tuple[float, float] | None = None
    top_row_first: bool | None = None
    focal_length_mm: float | None = None

    def __post_init__(self) -> None:
        if self.pitch_um is not None:
            check_pitch_um("pitch_um", self.pitch_um)
        if self.wavelength_nm is not None:
            wavelengths_nm("wavelength_nm", self.wavelength_nm)
        if self.band_width_nm is not None:
            finite_array("band_width_nm", self.band_width_nm, above=0.0)
        if self.origin_um is not None:
            Grid((1, 1), 1.0, self.origin_um)
        if self.focal_length_mm is not None:
            check_number("focal_length_mm", self.focal_length_mm, above=0.0)


def to_power_map(found: Found, given: Given) -> PowerMap:
    """
    Return the validated map in W/m² per band.

    Raises FormatError if the data are not an irradiance, or metadata are missing, and ParameterError if passed metadata are
    inconsistent with the data.
    """
    images = as_images(found.data)
    found = _in_lengths(found, given)
    pitch_um = _pitch_um(found, given)
    waves_nm = _wavelengths_nm(images, found, given)
    data = _in_w_m2(images, waves_nm, found, given)
    check_numbers(data)
    is_y_descending = found.is_y_descending if given.top_row_first is None else given.top_row_first
    origin_um = (
        given.origin_um if given.origin_um is not None else None if given.pitch_um is not None else found.origin_um
    )
    return PowerMap.from_array(
        with_ascending_axes(data, is_x_falling=found.is_x_descending, is_y_falling=is_y_descending),
        pitch_um=pitch_um,
        wavelength_nm=waves_nm,
        origin_um=origin_um,
    )


def _in_lengths(found: Found, given: Given) -> Found:
    """Return a map in lengths: angles times the focal length, the scale on the axis."""
    focal_mm = given.focal_length_mm
    if found.pitch_deg is None:
        if focal_mm is not None:
            raise ParameterError("focal_length_mm", "must be omitted for a map without cells in angles", focal_mm)
        return found
    if focal_mm is None:
        if given.pitch_um is not None:
            return found
        raise FormatError(
            f"has cells of {found.pitch_deg[0] * 3600.0:.6g} arcsec, an angle; pass focal_length_mm=..., or pitch_um=..."
        )
    per_deg = math.radians(1.0) * 1e3 * focal_mm
    pitch_um, origin_um = (
        None if at is None else (at[0] * per_deg, at[1] * per_deg) for at in (found.pitch_deg, found.origin_deg)
    )
    return replace(found, pitch_um=pitch_um, origin_um=origin_um)


def _pitch_um(found: Found, given: Given) -> Pitch:
    if given.pitch_um is not None:
        return given.pitch_um
    if found.pitch_um is None:
        raise FormatError("does not specify the cell size; pass pitch_um=..., the side or (width, height) in µm")
    try:
        along_x, along_y = check_pitch_um("pitch_um", found.pitch_um)
    except ParameterError as error:
        raise FormatError(f"has a cell size outside the allowed range ({error})") from None
    return along_x if abs(along_x - along_y) <= SQUARE_TOLERANCE * max(along_x, along_y) else (along_x, along_y)


def _wavelengths_nm(images: Images, found: Found, given: Given) -> Floats:
    n_band = images.shape[0]
    if given.wavelength_nm is not None:
        waves_nm = wavelengths_nm("wavelength_nm", given.wavelength_nm)
        if waves_nm.size != n_band:
            raise ParameterError(
                "wavelength_nm", f"must have {n_band} values, one per band of the map, got {waves_nm.size}"
            )
        return waves_nm
    if found.wavelength_nm is None:
        raise FormatError(
            f"does not specify the wavelengths of its bands; pass wavelength_nm=..., {n_band} values in nm"
        )
    try:
        waves_nm = wavelengths_nm("wavelength_nm", np.asarray(found.wavelength_nm, dtype=np.float64))
    except ParameterError as error:
        raise FormatError(f"contains invalid wavelengths ({error})") from None
    if waves_nm.size != n_band:
        raise FormatError(f"contains {waves_nm.size} wavelengths for {n_band} bands")
    return waves_nm


def _in_w_m2(images: Images, waves_nm: Floats, found: Found, given: Given) -> Images:
    unit, size = (given.unit, 1.0) if given.unit is not None else _parse_unit(found.unit)
    width_nm = _band_widths_nm(waves_nm, found, given) if unit in PER_NM else None
    factor = size * per_band_w_m2(unit, waves_nm, width_nm)
    if np.all(factor == 1.0):
        return images
    # float32 represents photon rates and powers, but intermediate products can overflow: multiply in float64.
    data = np.empty_like(images)
    for band, scale in enumerate(factor):
        np.multiply(images[band], scale, out=data[band], dtype=np.float64, casting="same_kind")
    return read_only(data)


def _parse_unit(text: str | None) -> tuple[Unit, float]:
    choices = ", ".join(map(repr, UNITS))
    if text is None:
        raise FormatError(f"does not specify its unit; pass unit=..., one of {choices}")
    unit = irradiance_unit(text)
    if unit is None:
        raise FormatError(
            f"has the unit {text!r:.40}, which is not an irradiance; to override it pass unit=..., one of {choices}"
        )
    return unit


def _band_widths_nm(waves_nm: Floats, found: Found, given: Given) -> Floats:
    """Return the specified widths, or widths that extend halfway to the adjacent wavelengths."""
    if given.band_width_nm is not None:
        return band_widths_nm(waves_nm, given.band_width_nm)
    try:
        return band_widths_nm(waves_nm, found.band_width_nm)
    except ParameterError as error:
        if found.band_width_nm is not None:
            raise FormatError(f"contains invalid band widths ({error})") from None
        raise FormatError("has a unit per nm and does not specify the band widths; pass band_width_nm=...") from None


def check_numbers(data: Images) -> None:
    """
    Reject invalid irradiance.

    Raises FormatError if a value is not finite, or negative by more than the rounding error.
    """
    lowest, highest = float(data.min()), float(data.max())
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        where = np.unravel_index(int(np.argmin(np.isfinite(data))), data.shape)
        raise FormatError(
            f"irradiance must be finite, got {data[where]} at [band, row, column] = {[int(i) for i in where]}; replace it"
        )
    if lowest < -NEGATIVE_TOLERANCE * max(highest, 0.0):
        where = np.unravel_index(int(np.argmin(data)), data.shape)
        raise FormatError(
            f"irradiance must be >= 0, got {lowest:.6g} W/m² at [band, row, column] = {[int(i) for i in where]}; clip it"
        )
