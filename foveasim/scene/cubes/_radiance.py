"""Spectral radiance of a cube: units, illuminants, and interpolation of bands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from foveasim._core.validation import Floats, band_widths_nm, check_number, finite_array, wavelengths_nm
from foveasim._io.formats import FormatError
from foveasim._io.mapped_files import value_range
from foveasim._io.rasters.units import Powers, parse_unit, round_factor
from foveasim.errors import FoveasimWarning, ParameterError, warn
from foveasim.scene._illuminants import TABLES_NM, Illuminant
from foveasim.scene._illuminants import illuminant as cie_illuminant
from foveasim.scene._photometry import level_of_white, the_only
from foveasim.scene.cubes._cube import Cube, Quantity
from foveasim.scene.cubes._selection import interpolation_weights
from foveasim.units import photon_energy_j

#: Table of an illuminant: ``wavelength_nm`` and ``value``.
IlluminantTable = Mapping[str, Sequence[float]]

#: Spectral radiance in power and in photons, by powers of watt, metre, second, photon and steradian; W/(m² sr nm) in SI.
POWER: Powers = (1, -3, 0, 0, -1)
PHOTONS: Powers = (0, -3, -1, 1, -1)
PER_M_FROM_PER_NM = 1e9
#: Radiance without a spectral unit, as some spectral renderers write for values per nm.
NOT_SPECTRAL: tuple[Powers, ...] = ((1, -2, 0, 0, -1), (0, -2, -1, 1, -1))
#: Units of reflectance.
REFLECTANCE = {
    **dict.fromkeys(("", "1", "dimensionless", "unitless", "none", "reflectance", "fraction"), 1.0),
    **dict.fromkeys(("%", "percent"), 0.01),
}
EXAMPLE = "'W m-2 sr-1 nm-1'"
#: Reflectance above this is an error of the scale, or a highlight.
MAX_REFLECTANCE = 1.01


@dataclass(frozen=True, kw_only=True)
class Radiance:
    """
    Spectra of the bands of a cube, as those of a scene, and the largest reflectance or 0.

    ``illuminant``: relative spectrum of white, for a reflectance.
    """

    spectrum_w_m2_sr_nm: Floats
    wavelength_nm: Floats
    band_width_nm: Floats
    max_fraction: float
    illuminant: Floats | None

    def warn_above_one(self) -> None:
        """Warn of a reflectance above 1."""
        if self.max_fraction > MAX_REFLECTANCE:
            warn(
                f"the reflectance of the cube is up to {self.max_fraction:.4g}, above 1; pass scale=... if the file lacks its "
                "scale factor",
                FoveasimWarning,
            )


def spectral_radiance(
    cube: Cube,
    *,
    quantity: Quantity | None,
    unit: str | None,
    scale: float | None,
    illuminant: Illuminant | IlluminantTable | None,
    radiance_w_m2_sr_nm: float | None,
    luminance_cd_m2: float | None,
    illuminance_lux: float | None,
    resample_nm: Sequence[float] | None,
    band_width_nm: float | Sequence[float] | None,
) -> Radiance:
    """
    Return the spectra of a cube; parameters as for :meth:`foveasim.Scene.from_cube`.

    Raises FormatError if the cube does not specify its quantity or unit, or the unit is not supported, and ParameterError
    if an argument is invalid, or inconsistent with the quantity.
    """
    bands_nm = np.asarray(cube.wavelength, np.float64)
    kind, factor = _quantity(cube, bands_nm, quantity, unit)
    own = cube.scale if scale is None else check_number("scale", scale, above=0.0)
    factor = factor * np.asarray(own)
    if resample_nm is None:
        waves_nm, weights = bands_nm, np.eye(bands_nm.size)
    else:
        waves_nm = wavelengths_nm("resample_nm", resample_nm)
        weights = interpolation_weights(bands_nm, waves_nm)
    spectrum, max_fraction, relative = factor[:, np.newaxis] * weights, 0.0, None
    own_nm = cube.band_width_nm if band_width_nm is None and resample_nm is None else band_width_nm
    level = {"luminance_cd_m2": luminance_cd_m2, "illuminance_lux": illuminance_lux}
    if kind == "reflectance":
        bands = (cube.data[k : k + 1] for k in range(factor.size))
        max_fraction = max(f * value_range(band)[1] for f, band in zip(factor.tolist(), bands, strict=True))
        white, name = radiance_w_m2_sr_nm, "radiance_w_m2_sr_nm"
        the_only({name: white, **level})
        if white is not None:
            white = check_number(name, white, at_least=0.0)
        relative, range_nm = _illumination(waves_nm, illuminant)
        widths_nm = band_widths_nm(waves_nm, own_nm, range_nm)
        spectrum = (
            spectrum
            * relative
            * level_of_white(
                name,
                white,
                relative,
                waves_nm,
                widths_nm,
                luminance_cd_m2=luminance_cd_m2,
                illuminance_lux=illuminance_lux,
            )
        )
    else:
        widths_nm = band_widths_nm(waves_nm, own_nm)
        given = {"illuminant": illuminant, "radiance_w_m2_sr_nm": radiance_w_m2_sr_nm, **level}
        for name, value in given.items():
            if value is not None:
                raise ParameterError(name, "must be omitted for a cube of radiance", value)
    return Radiance(
        spectrum_w_m2_sr_nm=spectrum,
        wavelength_nm=waves_nm,
        band_width_nm=widths_nm,
        max_fraction=max_fraction,
        illuminant=relative,
    )


def _quantity(cube: Cube, bands_nm: Floats, quantity: Quantity | None, unit: str | None) -> tuple[Quantity, Floats]:
    """Return the quantity, and the factors to reflectance or W/(m² sr nm), (n_band,)."""
    text = unit if unit is not None else cube.unit
    expected = quantity if quantity is not None else cube.quantity
    if text is None and expected == "reflectance":
        return "reflectance", np.ones(bands_nm.size)
    if text is None:
        both = "" if expected else ", or quantity='reflectance'"
        raise FormatError(f"does not specify the unit of its values; pass unit=..., such as {EXAMPLE}{both}")
    if not isinstance(text, str):
        raise ParameterError("unit", "must be a string", unit)
    kind, factor, problem = _parse(text, bands_nm)
    if kind is not None and expected not in (None, kind):
        problem = f"is a unit of {kind}, not of {expected}"
    if problem:
        cure = f"a {expected or 'radiance or reflectance'} has a unit such as " + (
            "'1' or '%'" if expected == "reflectance" else EXAMPLE
        )
        if unit is not None:
            raise ParameterError("unit", f"must be a unit of {expected or 'radiance or reflectance'}", unit, hint=cure)
        raise FormatError(f"has the unit {text!r:.40}, which {problem}; pass unit=...: {cure}")
    assert kind is not None
    return kind, factor


def _parse(text: str, bands_nm: Floats) -> tuple[Quantity | None, Floats, str]:
    """Return quantity, factors and problem of a unit."""
    ones = np.ones(bands_nm.size)
    plain = text.strip().lower()
    if plain in REFLECTANCE:
        return "reflectance", REFLECTANCE[plain] * ones, ""
    size, powers = parse_unit(text) or (1.0, None)
    if powers in (POWER, PHOTONS):
        per_photon = photon_energy_j(bands_nm) if powers == PHOTONS else ones
        return "radiance", round_factor(size / PER_M_FROM_PER_NM) * per_photon, ""
    if powers in NOT_SPECTRAL:
        return None, ones, "is not per nm"
    return None, ones, "is neither a spectral radiance nor a reflectance"


def _illumination(
    waves_nm: Floats, illuminant: Illuminant | IlluminantTable | None
) -> tuple[Floats, tuple[float, float]]:
    """Return the relative spectrum of white, (n_wavelength,), and the range of its table, nm."""
    if isinstance(illuminant, Mapping):
        return _table(illuminant, waves_nm)
    try:
        relative = cie_illuminant(illuminant or "D65", waves_nm)
    except ParameterError as error:
        raise ParameterError(
            "illuminant",
            f"'{illuminant or 'D65'}' {error.detail}; select range_nm=, or pass 'A', 'E', or a table "
            "{'wavelength_nm': [...], 'value': [...]}",
        ) from None
    return relative, (0.0, math.inf) if illuminant in ("A", "E") else TABLES_NM


def _table(table: IlluminantTable, waves_nm: Floats) -> tuple[Floats, tuple[float, float]]:
    """Return a table of an illuminant, interpolated linearly, and its range."""
    if set(table) != {"wavelength_nm", "value"}:
        raise ParameterError("illuminant", "must have the keys 'wavelength_nm' and 'value'", sorted(map(str, table)))
    at_nm = wavelengths_nm("illuminant.wavelength_nm", table["wavelength_nm"])
    value = finite_array("illuminant.value", table["value"], ndim=1, at_least=0.0)
    if value.size != at_nm.size or np.any(np.diff(at_nm) <= 0.0):
        raise ParameterError("illuminant", f"must have ascending wavelengths and one value for each, got {value.size}")
    if waves_nm.min() < at_nm[0] or waves_nm.max() > at_nm[-1]:
        raise ParameterError(
            "illuminant",
            f"must be tabulated from {waves_nm.min():g} to {waves_nm.max():g}, the wavelengths of the scene",
            [float(at_nm[0]), float(at_nm[-1])],
            "nm",
        )
    return np.interp(waves_nm, at_nm, value), (float(at_nm[0]), float(at_nm[-1]))
