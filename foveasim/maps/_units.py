"""Units of irradiance in files of other programs, and their conversion."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np

from foveasim._core.validation import Floats
from foveasim._io.rasters.units import Powers, parse_unit, round_factor
from foveasim.units import photon_energy_j

#: Units of a map: power or photons per second, per square metre, per band or per nanometre.
Unit: TypeAlias = Literal["w_m2", "w_m2_nm", "photons_s_m2", "photons_s_m2_nm"]
UNITS: tuple[Unit, ...] = get_args(Unit)
PER_NM: tuple[Unit, ...] = ("w_m2_nm", "photons_s_m2_nm")

#: Units of irradiance by their powers of the base units, with their sizes in SI.
_IRRADIANCE_UNITS: dict[Powers, tuple[Unit, float]] = {
    (1, -2, 0, 0, 0): ("w_m2", 1.0),
    (1, -3, 0, 0, 0): ("w_m2_nm", 1e9),
    (0, -2, -1, 1, 0): ("photons_s_m2", 1.0),
    (0, -3, -1, 1, 0): ("photons_s_m2_nm", 1e9),
}


def irradiance_unit(text: str) -> tuple[Unit, float] | None:
    """
    Parse a unit of irradiance; return the supported unit and the factor, or None.

    Examples
    --------
    >>> irradiance_unit("uW/cm2")
    ('w_m2', 0.01)
    >>> irradiance_unit("W.m^-2.nm^-1")
    ('w_m2_nm', 1.0)
    >>> irradiance_unit("W m-2 sr-1") is None
    True
    """
    if text in UNITS:
        return text, 1.0
    quantity = parse_unit(text)
    if quantity is None or quantity[1] not in _IRRADIANCE_UNITS:
        return None
    unit, size = _IRRADIANCE_UNITS[quantity[1]]
    return unit, round_factor(quantity[0] / size)


def per_band_w_m2(unit: Unit, wavelength_nm: Floats, band_width_nm: Floats | None) -> Floats:
    """
    Return the factors that convert a unit to W/m² per band, (n_band,).

    Units per nm are multiplied by the band width, photon rates by the photon energy.
    """
    factor = np.ones_like(wavelength_nm)
    if band_width_nm is not None and unit in PER_NM:
        factor = factor * band_width_nm
    return factor * photon_energy_j(wavelength_nm) if unit.startswith("photons") else factor
