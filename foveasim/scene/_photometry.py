"""Photometry: radiance of white from its luminance, or from illuminance."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import FRACTION, Limits
from foveasim._core.validation import Floats, wavelengths_nm
from foveasim.errors import ParameterError
from foveasim.scene._illuminants import read_table

#: Maximum luminous efficacy K_m of radiation, lm/W.
MAX_EFFICACY_LM_PER_W = 683.0
#: The luminance of the sun is 1.6e9 cd/m².
LUMINANCE = Limits(at_least=0.0, at_most=1e15)


def photopic(wavelength_nm: ArrayLike) -> Floats:
    """
    Return the photopic luminous efficiency V(λ), 1 at 555 nm.

    Parameters
    ----------
    wavelength_nm : (n,), nm

    Returns
    -------
    efficiency : (n,) float64
        Interpolated linearly between steps of 5 nm; 0 outside 380 to 780 nm.

    Notes
    -----
    CIE 1924 photopic observer, CIE 15:2004, Table T.4. Its integral is 106.857 nm.

    Examples
    --------
    >>> from foveasim.scene.charts import photopic
    >>> photopic([450.0, 555.0, 620.0]).tolist()
    [0.038, 1.0, 0.381]
    """
    at_nm, _, efficiency, _ = read_table("cie_observer")
    return np.interp(wavelengths_nm("wavelength_nm", wavelength_nm), at_nm, efficiency, left=0.0, right=0.0)


def luminance_of(radiance_w_m2_sr_nm: Floats, wavelength_nm: Floats, band_width_nm: Floats) -> Floats:
    """Return the luminance of spectra (..., n_wavelength), 683 lm/W times the sum of L V Δλ."""
    return np.asarray(MAX_EFFICACY_LM_PER_W * (radiance_w_m2_sr_nm @ (photopic(wavelength_nm) * band_width_nm)))


def the_only(values: Mapping[str, float | None]) -> str:
    """Return the name of the one value that is not None, or raise a ParameterError."""
    chosen = [name for name, value in values.items() if value is not None]
    if not chosen:
        first, *others = values
        raise ParameterError(first, f"must be given, or {' or '.join(map(repr, others))} instead")
    if len(chosen) > 1:
        raise ParameterError(chosen[1], f"must not be given together with '{chosen[0]}'", values[chosen[1]])
    return chosen[0]


def level_of_white(
    name: str,
    radiance_w_m2_sr_nm: float | None,
    spectrum: Floats,
    wavelength_nm: Floats,
    band_width_nm: Floats,
    *,
    luminance_cd_m2: float | None = None,
    illuminance_lux: float | None = None,
    reflectance: float = 1.0,
) -> float:
    """
    Return the factor of the relative spectrum of white (n_wavelength,), in W/(m² sr nm).

    ``name``: parameter of the radiance, of which one is given: the factor itself, the luminance of white in cd/m², or the
    illuminance in lux of a diffuse white (Lambert) with this reflectance, whose luminance is ``E reflectance / π``. Raises
    ParameterError when none or several are given, or no band is visible.
    """
    given = {name: radiance_w_m2_sr_nm, "luminance_cd_m2": luminance_cd_m2, "illuminance_lux": illuminance_lux}
    chosen = the_only(given)
    fraction = FRACTION.check("reflectance", reflectance)
    if fraction != 1.0 and illuminance_lux is None:
        raise ParameterError("reflectance", "requires 'illuminance_lux'", fraction)
    if radiance_w_m2_sr_nm is not None:
        return float(radiance_w_m2_sr_nm)
    target = LUMINANCE.check(chosen, given[chosen])
    if illuminance_lux is not None:
        target *= fraction / math.pi
    per_unit = float(luminance_of(spectrum, wavelength_nm, band_width_nm))
    if per_unit == 0.0:
        raise ParameterError(
            chosen,
            "must be used with a band between 380 and 780 nm",
            wavelength_nm.tolist(),
            "nm",
            f"specify '{name}' for other wavelengths",
        )
    return target / per_unit
