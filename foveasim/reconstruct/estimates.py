"""
Estimation of photoelectrons and their noise from codes or charges.

Estimates use the nominal electronics of the sensor, without the deviations of an individual device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, check_per_site, finite_array
from foveasim.sensor import Sensor
from foveasim.sensor.calibration import nominal_e_per_dn
from foveasim.sensor.limits import EXPOSURE

__all__ = ["SiteEstimates", "electrons_per_code", "estimate_from_charge", "estimate_from_code"]


@dataclass(frozen=True, eq=False, kw_only=True)
class SiteEstimates:
    """
    Estimated photoelectrons of each photosite, with noise variance and saturation.

    Attributes
    ----------
    light_e : (n_site,) float64, e-
        Photoelectrons: charge minus the expected dark signal. Noise can make it negative.
    variance_e2 : (n_site,) float64, e-²
        Noise variance of ``light_e``. For shot noise, the charge plus one: the posterior mean of the expected charge.
    is_saturated : (n_site,) bool
        Whether a site is saturated, so that ``light_e`` is a lower bound.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=2, n_y=1, pitch_um=3.0), full_well_e=5000.0)
    >>> estimates = fs.reconstruct.estimate_from_charge(
    ...     [399, 2499], sensor, exposure_s=0.01
    ... )
    >>> (estimates.light_e / np.sqrt(estimates.variance_e2)).round(
    ...     1
    ... ).tolist()  # signal-to-noise ratio
    [20.0, 50.0]
    """

    light_e: Floats
    variance_e2: Floats
    is_saturated: Bools

    __repr__ = short_repr


def electrons_per_code(sensor: Sensor) -> Floats:
    """
    Return the electrons per linear code of the nominal sensor, (n_site,) e-/DN.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(2, 1, 3.0), capacitance_f=1.6e-15, v_sat_v=1.0, bits=12
    ... )
    >>> fs.reconstruct.electrons_per_code(sensor).round(3).tolist()
    [2.438, 2.438]
    """
    return np.broadcast_to(nominal_e_per_dn(sensor), sensor.layout.n_sites)


def estimate_from_charge(charge_e: ArrayLike, sensor: Sensor, exposure_s: Annotated[float, EXPOSURE]) -> SiteEstimates:
    """
    Estimate photoelectrons from charges before readout, with shot noise only.

    Parameters
    ----------
    charge_e : (n_site,), e-
    sensor : Sensor
        Nominal sensor: its fixed patterns are not used.
    exposure_s : float, s

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=3.0),
    ...     dark_e_per_s=100.0,
    ...     full_well_e=5000.0,
    ... )
    >>> estimates = fs.reconstruct.estimate_from_charge([410, 5000], sensor, exposure_s=0.1)
    >>> estimates.light_e.tolist(), estimates.is_saturated.tolist()
    ([400.0, 4990.0], [False, True])
    """
    charge = check_per_site("charge_e", finite_array("charge_e", charge_e), sensor.layout.n_sites)
    return _estimate(sensor, charge, 0.0, exposure_s, np.asarray(charge >= sensor.well_e))


def estimate_from_code(code: ArrayLike, sensor: Sensor, exposure_s: Annotated[float, EXPOSURE]) -> SiteEstimates:
    """
    Estimate photoelectrons from codes.

    Companding and response nonlinearity are inverted; pedestal and expected dark signal are subtracted.

    Parameters
    ----------
    code : (n_site,), DN
    sensor, exposure_s
        As for :func:`estimate_from_charge`.

    Notes
    -----
    Crosstalk, inter-pixel capacitance, differential nonlinearity and fixed patterns are not corrected. For fixed patterns
    see :meth:`foveasim.sensor.Calibration.correct`.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=3.0),
    ...     capacitance_f=1.602176634e-15,
    ...     v_sat_v=1.0,
    ...     bits=10,
    ... )
    >>> estimates = fs.reconstruct.estimate_from_code([512, 1023], sensor, exposure_s=0.01)
    >>> estimates.light_e.round().tolist(), estimates.is_saturated.tolist()
    ([5005.0, 9995.0], [False, True])
    """
    found = sensor.invert(check_per_site("code", finite_array("code", code), sensor.layout.n_sites))
    return _estimate(sensor, found.charge_e, found.noise_e2, exposure_s, found.is_saturated)


def _estimate(
    sensor: Sensor, charge_e: Floats, noise_e2: Floats | float, exposure_s: float, is_saturated: Bools
) -> SiteEstimates:
    """Return the photoelectrons for charges with noise of the readout."""
    light_e, variance_e2 = sensor.invert_collection(charge_e, noise_e2, exposure_s)
    dark_e = sensor.dark_response(exposure_s)
    return SiteEstimates(light_e=light_e - dark_e, variance_e2=variance_e2, is_saturated=is_saturated)
