"""Spectra of CIE illuminants, and tables of spectra."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, read_only, wavelengths_nm
from foveasim.errors import ParameterError

Illuminant = Literal["A", "D50", "D55", "D65", "D75", "E"]

#: Revision of Planck's second constant since the definition of the daylight illuminants, from 1.438 to 1.4388 cm K: their
#: correlated colour temperatures are the nominal ones times this ratio, not rounded (CIE 15:2004, section 3.1).
PLANCK_REVISION = 1.4388 / 1.4380
DAYLIGHTS_K = {
    name: nominal_k * PLANCK_REVISION
    for name, nominal_k in {"D50": 5000.0, "D55": 5500.0, "D65": 6500.0, "D75": 7500.0}.items()
}
#: Normalisation wavelength of relative spectra.
REFERENCE_NM = 560.0
#: Range of the tables of daylight, of the standard observer, and of the colour chart.
TABLES_NM = (380.0, 780.0)
#: Planck's second constant and the temperature that define illuminant A (CIE 15).
PLANCK_NM_K, ILLUMINANT_A_K = 1.435e7, 2848.0


def illuminant(name: Illuminant, wavelength_nm: ArrayLike) -> Floats:
    """
    Return the relative spectrum of a CIE illuminant, 1 at 560 nm.

    Parameters
    ----------
    name : {"A", "D50", "D55", "D65", "D75", "E"}
        Incandescent light (A), daylight by colour temperature (D), or equal energy (E).
    wavelength_nm : (n,), nm
        From 380 to 780 for daylight.

    Returns
    -------
    relative : (n,) float64

    Raises
    ------
    ParameterError
        If the illuminant is unknown, or a wavelength lies outside the table.

    Notes
    -----
    Daylight according to CIE 15:2004: S0 + M1 S1 + M2 S2 with M1 and M2 rounded to three decimals; the components are
    interpolated linearly between steps of 10 nm. The published tables of D50, D55, D65 and D75 in steps of 5 nm agree to
    1e-5 of the value at 560 nm.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.scene.charts.illuminant("D65", [450.0, 560.0]).round(3).tolist()
    [1.17, 1.0]
    """
    waves_nm = wavelengths_nm("wavelength_nm", wavelength_nm)
    if name == "E":
        return np.ones(waves_nm.size)
    if name == "A":
        planck = np.expm1(PLANCK_NM_K / (ILLUMINANT_A_K * REFERENCE_NM)) / np.expm1(
            PLANCK_NM_K / (ILLUMINANT_A_K * waves_nm)
        )
        return np.asarray((REFERENCE_NM / waves_nm) ** 5 * planck)
    # S0 is 100 at 560 nm, and the other components are 0.
    return np.asarray(
        _daylight_weights(DAYLIGHTS_K[name]) @ interpolate_table(read_table("cie_daylight"), waves_nm) / 100.0
    )


def _daylight_weights(temperature_k: float) -> Floats:
    """Return the weights (3,) of the daylight components, CIE 15:2004, section 3.1."""
    # Chromaticity x as a polynomial in 1/T, up to 7000 K and above.
    below, above = (0.244063, 99.11, 2.9678e6, -4.6070e9), (0.237040, 247.48, 1.9018e6, -2.0064e9)
    x = float(np.polynomial.Polynomial(below if temperature_k <= 7000.0 else above)(1.0 / temperature_k))
    y = -3.0 * x * x + 2.87 * x - 0.275
    m = 0.0241 + 0.2562 * x - 0.7341 * y
    m1, m2 = (-1.3515 - 1.7703 * x + 5.9114 * y) / m, (0.03 - 31.4424 * x + 30.0717 * y) / m
    return np.array([1.0, round(m1, 3), round(m2, 3)])


@cache
def read_table(name: str) -> Floats:
    """Return the columns (n_column, n_wavelength) of a data file, wavelengths in nm first."""
    with (files("foveasim.scene") / "data" / f"{name}.csv").open(encoding="utf-8") as file:
        lines = [line for line in file if not line.startswith("#")]
    return read_only(np.loadtxt(lines[1:], delimiter=",").T.copy())


def interpolate_table(values: Floats, wavelength_nm: ArrayLike) -> Floats:
    """Return the columns (n_column, n) of a table, interpolated at wavelengths."""
    waves_nm = wavelengths_nm("wavelength_nm", wavelength_nm)
    first, last = values[0, 0], values[0, -1]
    is_outside = (waves_nm < first) | (waves_nm > last)
    if is_outside.any():
        raise ParameterError(
            "wavelength_nm",
            f"must be from {first:g} to {last:g}, the range of the tables",
            waves_nm[is_outside].tolist()[:3],
            "nm",
        )
    return np.array([np.interp(waves_nm, values[0], column) for column in values[1:]])
