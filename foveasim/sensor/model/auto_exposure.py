"""Automatic exposure: the time at which the bright sites reach a fraction of their range."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError
from foveasim.sensor.limits import EXPOSURE

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

TARGET, PERCENTILE = Limits(above=0.0, at_most=0.99), Limits(at_least=0.0, at_most=100.0)
#: Default target and percentile.
AUTO_TARGET, AUTO_PERCENTILE = 0.7, 99.0
#: Accuracy of the logarithm of the exposure time, and factor by which a bracket grows.
ACCURACY, GROWTH = 1e-4, 4.0
#: Charge of a saturated site, relative to its range; and smallest range of a site that counts, for instance not a dead one.
BEYOND_RANGE, MIN_RANGE_DN = 4.0, 0.5


def exposure_for(
    sensor: Sensor, photo_e_per_s: Floats, target: float, percentile: float, n_threads: int | None
) -> float:
    """Return the exposure time in seconds, as :meth:`foveasim.Sensor.exposure_for`."""
    full_e = np.broadcast_to(np.minimum(sensor.well_e, sensor.v_sat_v / sensor.v_per_e), photo_e_per_s.shape)
    brightness_per_s = float(np.percentile(photo_e_per_s / full_e, percentile)) if photo_e_per_s.size else 0.0
    if not brightness_per_s > 0.0:
        raise ParameterError(
            "exposure_s",
            f"must be given: percentile {percentile:g} of the sites receives no light, so 'auto' has no solution",
        )

    def codes(expected_e: Floats, exposure_s: float) -> Floats:
        return sensor.predict(expected_e, exposure_s=exposure_s, n_threads=n_threads)[0]

    @cache
    def range_dn(exposure_s: float) -> tuple[Floats, Floats]:
        black_dn = codes(np.zeros(full_e.shape), exposure_s)
        return black_dn, codes(BEYOND_RANGE * full_e, exposure_s) - black_dn

    @cache
    def excess(log_s: float) -> float:
        exposure_s = min(math.exp(log_s), EXPOSURE.high)  # rounding
        expected_e = sensor.expected_electrons(photo_e_per_s, exposure_s, n_threads=n_threads)
        # The range depends on the time for collections that depend on it, such as counters.
        black_dn, span_dn = range_dn(exposure_s if sensor.collection.needs_exposure else 1.0)
        counts = span_dn > MIN_RANGE_DN
        level = (codes(expected_e, exposure_s)[counts] - black_dn[counts]) / span_dn[counts]
        return float(np.percentile(level, percentile)) - target if level.size else -target

    low, high = math.log(EXPOSURE.low), math.log(EXPOSURE.high)
    first = last = min(max(math.log(target / brightness_per_s), low), high)
    while excess(first) > 0.0 and first > low:
        first = max(first - math.log(GROWTH), low)
    while excess(last) < 0.0 and last < high:
        last = min(last + math.log(GROWTH), high)
    if excess(first) > 0.0 or excess(last) < 0.0:
        raise ParameterError(
            "target", "must be a level that the sites reach", target, hint="see the noise and the range of the sensor"
        )
    if first == last:
        return math.exp(first)
    from scipy.optimize import brentq  # its import is slow

    return math.exp(brentq(excess, first, last, xtol=ACCURACY))
