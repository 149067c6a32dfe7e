"""First values of a fit of the chain, by the photon transfer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from foveasim._core.validation import Bools, Floats
from foveasim.errors import ParameterError
from foveasim.sensor.adc import ADC, QUANTISATION_DN2
from foveasim.twin.fitting.levels import Levels
from foveasim.twin.fitting.pooled import Exposures
from foveasim.twin.fitting.recording import LINEAR_FRACTION

__all__ = ["CLOSE_FRACTION", "Start", "first_values"]

#: Fraction of the variance that shot noise would have, below which pixels of a level are full.
SATURATING = 0.6
#: Fraction of the full well above which the first fit leaves out levels.
CLOSE_FRACTION = 0.85
#: Doubling temperature of the dark current, K.
DOUBLING_K = 8.0


@dataclass(frozen=True, eq=False)
class Start:
    """
    First values of a fit.

    ``light_e`` (n_level,): charges. ``is_used``, ``is_close``: levels below the highest codes, and those close to the full
    well.
    """

    values: dict[str, float]
    light_e: Floats
    is_used: Bools
    is_close: Bools


def first_values(levels: Levels, exposures: Exposures, adc: ADC, *, has_dark_series: bool) -> Start:
    """
    Return first values of the fit, by the photon transfer in linear codes.

    Raises ParameterError without levels of shot noise, or dark frames, below the highest code.
    """
    width = adc.width_of_code_dn(levels.mean_dn.clip(0.0, adc.n_codes - 1.0))
    mean = adc.linear_of_code_dn(levels.mean_dn.clip(0.0, adc.n_codes - 1.0))
    variance = np.maximum(levels.variance_dn2 - QUANTISATION_DN2, 1e-6) * width**2
    is_dark = exposures.is_dark
    black, noise = float(mean[is_dark].min()), float(variance[is_dark].min())
    signal, shot = mean - black, variance - noise
    ratio = np.where((signal > 0.0) & ~is_dark, shot / np.maximum(signal, 1e-9), np.nan)
    is_clear = ~is_dark & (shot > 2.0 * noise) & (mean < LINEAR_FRACTION * adc.n_codes)
    if not is_clear.any():
        is_clear = ~is_dark & (shot > 0.0) & (mean < 0.95 * adc.n_codes)
    if not is_clear.any():
        raise ParameterError(
            "frames",
            "must contain levels with shot noise between the dark and the highest code; check light and bits",
        )
    gain = float(np.median(np.sort(ratio[is_clear])[-max(3, int(0.6 * is_clear.sum())) :]))
    top_dn = adc.n_codes - 1.0
    is_clipped = levels.mean_dn > top_dn - np.maximum(3.0 * np.sqrt(np.maximum(levels.variance_dn2, 0.0)), 1.0)
    relative = np.where(is_dark, 1.0, ratio / gain)
    highest = float(signal[~is_dark].max())
    is_saturating = ~is_dark & (relative < SATURATING) & (signal > 0.4 * highest) & ~is_clipped
    values: dict[str, float] = {
        "gain_dn_per_e": gain,
        "read_noise_e2": max(noise / gain**2, 1e-3),
        "black_level_dn": black,
    }
    if is_saturating.any():
        values["full_well_e"] = float(signal[is_saturating].max()) / gain
    is_used = ~is_clipped
    if not (is_used & is_dark).any():
        raise ParameterError("frames", "must contain dark frames below the highest code; check light and bits")
    known = is_used & ~exposures.is_free & ~is_dark
    for name in sorted({exposures.light_parameter[k] for k in np.flatnonzero(known)}):
        own = [k for k in np.flatnonzero(known & ~is_saturating) if exposures.light_parameter[k] == name]
        own = own or [k for k in np.flatnonzero(known) if exposures.light_parameter[k] == name]
        values[name] = float(np.median(signal[own] / gain / exposures.light[own]))
    if has_dark_series:
        times = exposures.exposure_s[is_dark]
        slope = np.polyfit(times, mean[is_dark], 1)[0]
        values["dark_e_per_s"] = max(float(slope) / gain, 0.0)
        if len({each for each in exposures.temperature_k[is_dark] if not math.isnan(each)}) > 1:
            values["dark_doubling_k"] = DOUBLING_K
    if len({round(float(x), 12) for x in exposures.light[known]}) >= 3 or np.count_nonzero(is_used & ~is_dark) >= 6:
        values["nonlinearity_fraction"] = 0.0
    light_e = np.maximum(signal / gain, 1.0)
    is_close = ~is_dark & (light_e > CLOSE_FRACTION * values.get("full_well_e", math.inf))
    return Start(values, light_e, is_used, is_close)
