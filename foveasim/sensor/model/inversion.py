"""Inversion of the nominal sensor: charges from codes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats
from foveasim.sensor.effects.collection import MAX_CHARGE_E, Collection
from foveasim.sensor.effects.contract import Sites
from foveasim.sensor.model.prediction import MIN_SLOPE
from foveasim.sensor.model.records import readout_model, slope_of, walk_from_node

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

__all__ = ["Inverse"]

#: Relative step at which Newton's method ends, and maximum number of steps: a double root halves the error in each.
INVERSION_ROUNDING, MAX_INVERSIONS = 1e-14, 60
#: Largest charge in units of the range of a linear response.
MAX_RANGES = 10.0


class Inverse(NamedTuple):
    """
    Charges at the sense nodes that codes correspond to, on the nominal sensor.

    Attributes
    ----------
    charge_e : (..., n_site) float64, e-
        Charge whose voltage is at the centre of the code.
    noise_e2 : (..., n_site) float64, e-²
        Temporal variance of readout and conversion, without that of the collection.
    is_saturated : (..., n_site) bool
        Whether a code is the highest one, or the charge is the full well.
    """

    charge_e: Floats
    noise_e2: Floats
    is_saturated: Bools

    def __repr__(self) -> str:
        return short_repr(self)


def invert(sensor: Sensor, sites: Sites, code_dn: Floats) -> Inverse:
    """
    Invert the chain after the sense node: see :meth:`foveasim.Sensor.invert`.

    Newton's method starts at no charge: for a response that bends towards saturation it converges from below. Charges are
    limited, for codes that a response does not reach.
    """
    target_v = sensor.adc.fraction_of_code(code_dn) * sensor.v_sat_v
    charge_e: Floats = np.zeros(np.broadcast_shapes(target_v.shape, (sites.n_sites,)))
    slope, limit_e = np.ones(1), np.zeros(1)
    for _ in range(MAX_INVERSIONS):
        records, output_v = walk_from_node(sensor, sites, charge_e)
        slope = slope_of(records)
        if not limit_e.any():  # that of a linear response with the slope at no charge
            limit_e = MAX_RANGES * sensor.v_sat_v / np.maximum(slope, MIN_SLOPE * sensor.v_per_e)
        step_e = np.divide(target_v - output_v, slope, out=np.zeros_like(charge_e), where=slope != 0.0)
        step_e = np.clip(step_e, -limit_e - charge_e, limit_e - charge_e)
        charge_e = charge_e + step_e
        if np.all(np.abs(step_e) <= INVERSION_ROUNDING * (1.0 + np.abs(charge_e))):
            break
    readout = readout_model(sensor, np.maximum(charge_e, 0.0), 0.0, sites, is_reset=True)
    step_v = sensor.adc.width_of_code_dn(code_dn) * sensor.v_sat_v / 2.0**sensor.bits
    with np.errstate(divide="ignore"):  # codes that the response does not reach
        noise_e2 = readout.noise_e2 + np.square(step_v / slope) * sensor.adc.noise_dn2
    return Inverse(charge_e, noise_e2, (charge_e >= sensor.well_e) | (code_dn >= 2.0**sensor.bits - 1.0))


def invert_collection(
    collection: Collection, sites: Sites, charge_e: Floats, noise_e2: Floats | float
) -> tuple[Floats, Floats]:
    """Invert the collection: see :meth:`foveasim.Sensor.invert_collection`."""
    added = noise_e2 + float(collection.is_drawn)
    if collection.validate_linear(np.zeros(1), sites).slope is None:
        return charge_e, collection.moments(np.maximum(charge_e, 0.0), added + np.zeros_like(charge_e), sites=sites)[1]
    expected_e = np.empty(np.shape(charge_e))
    variance_e2 = np.empty(np.shape(charge_e))
    for index in np.ndindex(expected_e.shape[:-1]):
        found = collection.invert(np.maximum(charge_e[index], 0.0), sites=sites)
        is_beyond = np.isinf(found)
        if is_beyond.any():
            found = np.where(is_beyond, collection.invert(np.maximum(charge_e[index] - 0.5, 0.0), sites=sites), found)
        found = np.where(np.isinf(found), MAX_CHARGE_E, found)
        slope = np.asarray(collection.validate_linear(found, sites).slope)
        expected_e[index] = found
        spread2 = collection.moments(found, np.zeros(1), sites=sites)[1] + np.broadcast_to(added, charge_e.shape)[index]
        variance_e2[index] = spread2 / np.square(np.maximum(slope, MIN_SLOPE))
    return expected_e, variance_e2
