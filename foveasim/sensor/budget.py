"""The noise budget: how much each source of noise adds, in electrons, to tell which one to fight."""

from __future__ import annotations

import math

import numpy as np

from foveasim.arrays import Floats, check_number
from foveasim.errors import ParameterError
from foveasim.sensor._sensor import Sensor
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
        slope of the whole chain at the site's mean: offsets, and steps of the converter over the root of 12. Squares add up, as
        long as nothing is clipped: the temporal ones to the variance of a site, the fixed ones to that between like sites.

    Raises
    ------
    ParameterError
        When there is not one number a site, or the exposure is negative.

    Notes
    -----
    Charge diffusion and coupling, which mix sites, are left out.
    """
    exposure_s = check_number("exposure_s", exposure_s, at_least=0.0)
    photo_e_per_s = np.asarray(photo_e_per_s, np.float64)
    n_sites = sensor.layout.n_sites
    if photo_e_per_s.shape != (n_sites,):
        raise ParameterError("photo_e_per_s", f"must be {n_sites} numbers, one a site, got {photo_e_per_s.shape}")
    photo_e = photo_e_per_s * exposure_s * sensor.sensitivity
    # Before DSNU and hot sites.
    heat = 2.0 ** ((sensor.temperature_k - sensor.dark_reference_k) / sensor.dark_doubling_k)
    dark_e = np.broadcast_to(np.asarray(sensor.dark_e_per_s) * heat * exposure_s, (n_sites,))
    volts_per_e = np.broadcast_to(electrons_to_volts(1.0, sensor.capacitance_f), (n_sites,))
    charge_e = photo_e + dark_e
    share = np.clip(charge_e * volts_per_e / sensor.v_sat_v, 0.0, 1.0)
    bent_v_per_e = volts_per_e * (1.0 - 2.0 * sensor.nonlinearity_fraction * share)
    lifted = np.clip(
        share * (1.0 - sensor.nonlinearity_fraction * share) + sensor.pedestal_v / sensor.v_sat_v, 0.0, 1.0
    )
    dn_per_e = _slope_dn(sensor, lifted) / sensor.v_sat_v * bent_v_per_e
    is_telegraph = np.zeros(n_sites)
    is_telegraph[sensor.telegraph_sites] = 1.0
    is_drawn = sensor.shot_noise != "off"
    noise_e = {
        "shot of light": np.sqrt(photo_e) * is_drawn,
        "shot of dark charge": np.sqrt(dark_e) * is_drawn,
        "reset": sensor.ktc_noise_e,
        "read": np.asarray(sensor.read_noise_e, np.float64),
        "telegraph": 0.5 * sensor.rts_e * is_telegraph,
        "quantisation": 1.0 / math.sqrt(12.0) / dn_per_e,
        "photo response": sensor.prnu_fraction * photo_e,
        "dark signal": sensor.dsnu_fraction * dark_e,
        "gain": sensor.gain_fpn_fraction * charge_e,
        "offset of pixels": 0.0 if sensor.cds else sensor.pixel_fpn_fraction * sensor.v_sat_v / bent_v_per_e,
        "offset of lines": sensor.line_fpn_fraction * sensor.v_sat_v / bent_v_per_e,
    }
    return {name: np.broadcast_to(noise_e[name], (n_sites,)).copy() for name in (*TEMPORAL, *FIXED)}


def _slope_dn(sensor: Sensor, share: Floats) -> Floats:
    """Slope of the converter, codes for the whole range of voltage, at shares of it."""
    convert = sensor.converter
    if convert.companding == "root":
        slope = 0.5 / np.sqrt(np.maximum(share, 1e-12))
    elif convert.companding == "log":
        slope = convert.log_strength / (1.0 + convert.log_strength * share) / math.log1p(convert.log_strength)
    elif convert.companding == "table":
        steps = np.diff(convert.curve) * (convert.curve.size - 1)
        slope = np.maximum(steps[np.minimum((share * steps.size).astype(np.int64), steps.size - 1)], 1e-12)
    else:
        slope = np.ones_like(share)
    return np.asarray(slope * convert.n_codes)
