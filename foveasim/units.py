"""
Physical constants, conversions of units, and the encoding of pictures.

Constants are the exact values of the 2019 SI (CODATA 2018).
"""

from __future__ import annotations

import numpy as np

from foveasim._core.calls import publish
from foveasim._core.validation import Floats, as_numbers, check_broadcast
from foveasim.errors import ParameterError

__all__ = [
    "BOLTZMANN_J_PER_K",
    "ELEMENTARY_CHARGE_C",
    "LIGHT_SPEED_M_PER_S",
    "PLANCK_J_S",
    "decode_srgb",
    "electrons_to_volts",
    "encode_srgb",
    "m_from_mm",
    "m_from_nm",
    "m_from_um",
    "per_mm_from_per_um",
    "per_um_from_per_mm",
    "photon_energy_j",
    "um_from_m",
    "um_from_nm",
    "volts_to_electrons",
    "w_from_w_m2_um2",
]

#: Planck constant.
PLANCK_J_S = 6.62607015e-34
#: Speed of light in vacuum.
LIGHT_SPEED_M_PER_S = 299_792_458.0
#: Charge of an electron, without its sign.
ELEMENTARY_CHARGE_C = 1.602176634e-19
#: Boltzmann constant.
BOLTZMANN_J_PER_K = 1.380649e-23


def m_from_um(length_um: Floats | float) -> Floats:
    """
    Convert micrometres to metres.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.m_from_um(250.0))
    0.00025
    """
    return as_numbers("length_um", length_um) * 1e-6


def m_from_mm(length_mm: Floats | float) -> Floats:
    """
    Convert millimetres to metres.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.m_from_mm(8.0))  # focal length of a lens
    0.008
    """
    return as_numbers("length_mm", length_mm) * 1e-3


def m_from_nm(length_nm: Floats | float) -> Floats:
    """
    Convert nanometres to metres.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.m_from_nm(550.0))
    5.5e-07
    """
    return as_numbers("length_nm", length_nm) * 1e-9


def um_from_m(length_m: Floats | float) -> Floats:
    """
    Convert metres to micrometres.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.um_from_m(0.5))
    500000.0
    """
    return as_numbers("length_m", length_m) * 1e6


def um_from_nm(length_nm: Floats | float) -> Floats:
    """
    Convert nanometres to micrometres.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> fs.units.um_from_nm(np.array([450.0, 550.0])).tolist()
    [0.45, 0.55]
    """
    return as_numbers("length_nm", length_nm) * 1e-3


def per_um_from_per_mm(frequency_per_mm: Floats | float) -> Floats:
    """
    Convert line pairs per millimetre to line pairs per micrometre.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.per_um_from_per_mm(100.0))
    0.1
    """
    return as_numbers("frequency_per_mm", frequency_per_mm) * 1e-3


def per_mm_from_per_um(frequency_per_um: Floats | float) -> Floats:
    """
    Convert line pairs per micrometre to line pairs per millimetre.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.per_mm_from_per_um(0.1))
    100.0
    """
    return as_numbers("frequency_per_um", frequency_per_um) * 1e3


def w_from_w_m2_um2(power_w_m2_um2: Floats | float) -> Floats:
    """
    Convert (W/m²)·µm², irradiance in W/m² integrated over an area in µm², to watts.

    Examples
    --------
    >>> import foveasim as fs
    >>> float(fs.units.w_from_w_m2_um2(2.0))
    2e-12
    """
    return as_numbers("power_w_m2_um2", power_w_m2_um2) * 1e-12


def photon_energy_j(wavelength_nm: Floats | float) -> Floats:
    """
    Return the energy of a photon in joules, ``h c / wavelength``.

    Examples
    --------
    An irradiance of 1 W/m² on 1 µm² for 1 s at 550 nm corresponds to 2.769 million photons:

    >>> float(round(1e-12 / photon_energy_j(550.0)))
    2768764.0
    """
    return PLANCK_J_S * LIGHT_SPEED_M_PER_S / m_from_nm(wavelength_nm)


def electrons_to_volts(charge_e: Floats | float, capacitance_f: Floats | float) -> Floats:
    """
    Convert a charge in electrons on a capacitance to a voltage, ``q n / C``.

    Examples
    --------
    >>> import foveasim as fs
    >>> round(float(fs.units.electrons_to_volts(10_000.0, 1.6e-15)), 4)
    1.0014
    """
    charge_e, capacitance_f = as_numbers("charge_e", charge_e), as_numbers("capacitance_f", capacitance_f)
    check_broadcast(charge_e=charge_e, capacitance_f=capacitance_f)
    return ELEMENTARY_CHARGE_C * charge_e / capacitance_f


def volts_to_electrons(voltage_v: Floats | float, capacitance_f: Floats | float) -> Floats:
    """
    Convert a voltage on a capacitance to a charge in electrons, ``C U / q``.

    Examples
    --------
    >>> import foveasim as fs
    >>> round(float(fs.units.volts_to_electrons(1.0, 1.6e-15)))  # full well at 1 V
    9986
    """
    voltage_v, capacitance_f = as_numbers("voltage_v", voltage_v), as_numbers("capacitance_f", capacitance_f)
    check_broadcast(voltage_v=voltage_v, capacitance_f=capacitance_f)
    return voltage_v * capacitance_f / ELEMENTARY_CHARGE_C


def encode_srgb(value: Floats | float) -> Floats:
    """
    Encode relative radiance as sRGB values, IEC 61966-2-1.

    The values 0 and 1 are black and white; larger ones are extrapolated. Floating-point types are kept.

    Examples
    --------
    >>> round(float(encode_srgb(0.18)), 3)
    0.461

    Raises
    ------
    ParameterError
        When there is a value below 0.
    """
    value = _relative(value)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)


def decode_srgb(value: Floats | float) -> Floats:
    """
    Decode sRGB values to relative radiance, the inverse of :func:`encode_srgb`.

    Examples
    --------
    The value 128 of 255 is 22 % of white:

    >>> round(float(decode_srgb(128 / 255)), 2)
    0.22

    Raises
    ------
    ParameterError
        When there is a value below 0.
    """
    value = _relative(value)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _relative(value: Floats | float) -> Floats:
    value = as_numbers("value", value, keep_type=True)
    if value.min(initial=0.0) < 0.0:
        raise ParameterError("value", "must be >= 0", float(value.min()))
    return value


publish(__name__)
