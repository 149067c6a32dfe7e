"""Units in files of other programs, and their conversion."""

from __future__ import annotations

import re
from typing import Literal, TypeAlias, get_args

import numpy as np

from foveasim._core.validation import Floats
from foveasim.units import photon_energy_j

__all__ = ["PER_NM", "UNITS", "Unit", "irradiance_unit", "length_in_um", "per_band_w_m2"]

#: Units of a map: power or photons per second, per square metre, per band or per nanometre.
Unit: TypeAlias = Literal["w_m2", "w_m2_nm", "photons_s_m2", "photons_s_m2_nm"]
UNITS: tuple[Unit, ...] = get_args(Unit)
PER_NM: tuple[Unit, ...] = ("w_m2_nm", "photons_s_m2_nm")

#: Size in SI and powers of watt, metre, second and photon.
_Quantity: TypeAlias = tuple[float, tuple[int, int, int, int]]
_WATT, _METRE, _SECOND, _PHOTON = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
_BASE: dict[str, _Quantity] = {
    **{name: (size, _WATT) for name, size in (("W", 1.0), ("mW", 1e-3), ("uW", 1e-6), ("nW", 1e-9), ("kW", 1e3))},
    **dict.fromkeys(("watt", "watts", "Watt", "Watts"), (1.0, _WATT)),
    "J": (1.0, (1, 0, 1, 0)),
    "erg": (1e-7, (1, 0, 1, 0)),
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), (1.0, _METRE)),
    "cm": (1e-2, _METRE),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), (1e-3, _METRE)),
    **dict.fromkeys(
        ("um", "micron", "microns", "micrometre", "micrometres", "micrometer", "micrometers"), (1e-6, _METRE)
    ),
    **dict.fromkeys(("nm", "nanometre", "nanometres", "nanometer", "nanometers"), (1e-9, _METRE)),
    **dict.fromkeys(("Angstrom", "angstrom", "Angstroms", "AA"), (1e-10, _METRE)),
    **dict.fromkeys(("s", "sec", "second", "seconds"), (1.0, _SECOND)),
    **dict.fromkeys(("photon", "photons", "ph", "quanta"), (1.0, _PHOTON)),
}
#: Units of irradiance by their powers of the base units, with their sizes in SI.
_IRRADIANCE_UNITS: dict[tuple[int, int, int, int], tuple[Unit, float]] = {
    (1, -2, 0, 0): ("w_m2", 1.0),
    (1, -3, 0, 0): ("w_m2_nm", 1e9),
    (0, -2, -1, 1): ("photons_s_m2", 1.0),
    (0, -3, -1, 1): ("photons_s_m2_nm", 1e9),
}
_TOKEN = re.compile(r"(?P<name>[A-Za-z]+)(?P<power>[-+]?[0-9]{1,2}(?![0-9]))?|(?P<sign>[/()1])")
#: Maximum length of a unit string.
_MAX_CHARS = 64


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
    quantity = _quantity(text)
    if quantity is None or quantity[1] not in _IRRADIANCE_UNITS:
        return None
    unit, size = _IRRADIANCE_UNITS[quantity[1]]
    return unit, _round(quantity[0] / size)


def length_in_um(text: str) -> float | None:
    """
    Parse a unit of length; return its size in µm, or None.

    Examples
    --------
    >>> length_in_um("mm"), length_in_um("µm"), length_in_um("deg")
    (1000.0, 1.0, None)
    """
    quantity = _quantity(text)
    return None if quantity is None or quantity[1] != _METRE else _round(quantity[0] * 1e6)


def per_band_w_m2(unit: Unit, wavelength_nm: Floats, band_width_nm: Floats | None) -> Floats:
    """
    Return the factors that convert a unit to W/m² per band, (n_band,).

    Units per nm are multiplied by the band width, photon rates by the photon energy.
    """
    factor = np.ones_like(wavelength_nm)
    if band_width_nm is not None and unit in PER_NM:
        factor = factor * band_width_nm
    return factor * photon_energy_j(wavelength_nm) if unit.startswith("photons") else factor


def _round(factor: float) -> float:
    """Round to 12 digits: 1e-6 / 1e-4 differs from 0.01 in the last bit."""
    return float(f"{factor:.12g}")


def _quantity(text: str) -> _Quantity | None:
    """
    Parse a product of units with powers; return its size and powers of the base units.

    A slash applies to the next unit or bracket only.
    """
    plain = text.strip()
    for other, ours in (("²", "2"), ("µ", "u"), ("μ", "u"), ("⁻", "-"), ("¹", "1"), ("**", ""), ("^", "")):
        plain = plain.replace(other, ours)
    plain = re.sub(r"[·.*\s_]+", " ", plain)
    size, powers = 1.0, np.zeros(4, int)
    sign, brackets, at = 1, [1], 0
    if not plain or len(plain) > _MAX_CHARS:
        return None
    while at < len(plain):
        if plain[at] == " ":
            at += 1
            continue
        token = _TOKEN.match(plain, at)
        if token is None:
            return None
        at = token.end()
        match token["sign"]:
            case "/":
                sign = -1
            case "(":
                brackets.append(brackets[-1] * sign)
                sign = 1
            case ")" if len(brackets) > 1:
                brackets.pop()
            case ")":
                return None
            case "1":  # as in 1/s
                sign = 1
            case _:
                if token["name"] not in _BASE:
                    return None
                one, its_powers = _BASE[token["name"]]
                n = sign * brackets[-1] * int(token["power"] or 1)
                size, powers, sign = size * one**n, powers + n * np.array(its_powers), 1
    return (size, tuple(powers.tolist())) if len(brackets) == 1 else None
