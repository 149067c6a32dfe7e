"""The noise budget: how much each source of noise adds, in electrons, to tell which one to fight."""

from __future__ import annotations

import math

import numpy as np

from foveasim._core.validation import Floats, as_numbers
from foveasim.errors import ParameterError
from foveasim.sensor.limits import check_plausible
from foveasim.sensor.sensor import Sensor
from foveasim.sensor.signal_to_noise import local_step_e
from foveasim.units import electrons_to_volts

__all__ = ["FIXED", "TEMPORAL", "noise_budget"]

#: Sources that change from frame to frame, and those that stay.
TEMPORAL = ("shot of light", "shot of dark charge", "reset", "read", "telegraph", "quantisation")
FIXED = ("photo response", "dark signal", "gain", "offset of pixels", "offset of lines")


def noise_budget(sensor: Sensor, photo_e_per_s: Floats, exposure_s: float) -> dict[str, Floats]:
    """
    Standard deviation that each source of noise alone gives to a site's charge.

    Parameters
    ----------
    sensor : Sensor
    photo_e_per_s : (n_site,) float64, e-/s
        Photoelectrons of a site without fixed patterns, as a camera expects them.
    exposure_s : float, s

    Returns
    -------
    noise_e : dict of (n_site,) float64, e-
        By source, in the order of :data:`TEMPORAL` and :data:`FIXED`. What comes after the charge is converted back by the
        slope of the whole chain at the site's mean: offsets, and the noise of conversion, a step over the root of 12 and
        differential non-linearity. Squares add up, as
        long as nothing is clipped: the temporal ones to the variance of a site, the fixed ones to that between like sites.

    Raises
    ------
    ParameterError
        When there is not one number a site, or the exposure is negative.

    Notes
    -----
    Charge diffusion and coupling, which mix sites, are left out.
    """
    exposure_s = check_plausible("exposure_s", exposure_s)
    photo_e_per_s = as_numbers("photo_e_per_s", photo_e_per_s)
    n_sites = sensor.layout.n_sites
    if photo_e_per_s.shape != (n_sites,):
        raise ParameterError("photo_e_per_s", f"must be {n_sites} numbers, one a site, got {photo_e_per_s.shape}")
    photo_e = photo_e_per_s * exposure_s * sensor.sensitivity
    # Before DSNU and hot sites.
    dark_e = np.broadcast_to(np.asarray(sensor.dark_e_per_s) * sensor.heat * exposure_s, (n_sites,))
    volts_per_e = np.broadcast_to(electrons_to_volts(1.0, sensor.capacitance_f), (n_sites,))
    charge_e = photo_e + dark_e
    share = np.clip(charge_e * volts_per_e / sensor.v_sat_v, 0.0, 1.0)
    bent_v_per_e = volts_per_e * (1.0 - 2.0 * sensor.nonlinearity_fraction * share)
    step_e = local_step_e(sensor, charge_e, volts_per_e, np.full(1, sensor.pedestal_v))
    is_drawn = sensor.shot_noise != "off"
    noise_e = {
        "shot of light": np.sqrt(photo_e) * is_drawn,
        "shot of dark charge": np.sqrt(dark_e) * is_drawn,
        "reset": sensor.ktc_noise_e,
        "read": np.asarray(sensor.read_noise_e, np.float64),
        "telegraph": sensor.rts_noise_e,
        "quantisation": math.sqrt(sensor.converter.noise_dn2) * step_e,
        "photo response": sensor.prnu_fraction * photo_e,
        "dark signal": sensor.dsnu_fraction * dark_e,
        "gain": sensor.gain_fpn_fraction * charge_e,
        "offset of pixels": 0.0 if sensor.cds else sensor.pixel_fpn_fraction * sensor.v_sat_v / bent_v_per_e,
        "offset of lines": sensor.line_fpn_fraction * sensor.v_sat_v / bent_v_per_e,
    }
    return {name: np.broadcast_to(noise_e[name], (n_sites,)).copy() for name in (*TEMPORAL, *FIXED)}
