"""Analytic sensor chain: moments of charges, and a first-order model of the readout."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, read_only
from foveasim.sensor.effects.contract import Effect, Sites, Stage

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

#: Number of quadrature nodes for charges clipped at the full well.
QUADRATURE_NODES = 96
#: Minimum slope of a nonlinear response, relative to the slope at zero signal.
MIN_SLOPE = 1e-6


class ChargeDistributions(NamedTuple):
    """Charge distributions for the kernels: read-only arrays (n,) or (1,)."""

    mean_e: Floats
    variance_e2: Floats
    well_e: Floats
    sigma_e: Floats
    half_step_e: Floats
    poisson_below_e: float
    is_drawn: bool


class Transfer(NamedTuple):
    """
    Transfer function from charge to ADC voltage, for the kernels.

    ``v = f(charge * v_per_e + sense_v) * scale + output_v``, with the response nonlinearity f. Arrays are read-only, (n,) or
    (1,).
    """

    v_per_e: Floats
    sense_v: Floats
    scale: Floats
    output_v: Floats
    nonlinearity_fraction: float
    v_sat_v: float


class Quadrature(NamedTuple):
    """Gauss-Legendre nodes and weights on the interval -1 to 1."""

    points: Floats
    weights: Floats


class ReadoutModel(NamedTuple):
    """
    First-order model of the readout at the mean collected charges.

    Attributes
    ----------
    mean_e, variance_e2 : (..., n_site), e- and e-²
        Moments of the charges after effects that mix sites, such as inter-pixel capacitance.
    is_mixed : bool
        Whether such an effect is present, so that charges are no longer Poisson-distributed.
    transfer : Transfer
        Transfer function of these charges, including effects of the signal chain.
    gaussian_e2 : (..., n_site) or (1,), e-²
        Variance of the Gaussian temporal noise of the readout, referred to the charge.
    half_step_e : (..., n_site) or (1,), e-
        Half the difference between two equally probable (RTS) states, referred to the charge.
    """

    mean_e: Floats
    variance_e2: Floats
    is_mixed: bool
    transfer: Transfer
    gaussian_e2: Floats
    half_step_e: Floats

    @property
    def noise_e2(self) -> Floats:
        """Variance of the total temporal noise of the readout, referred to the charge, e-²."""
        return np.asarray(self.gaussian_e2 + self.half_step_e**2)


class _LinearModel:
    """First-order model of a stage: ``factor * value + offset``, Gaussian and RTS noise."""

    def __init__(
        self, effects: Iterable[Effect], mean: Floats, variance: Floats, sites: Sites, *, is_reset: bool
    ) -> None:
        self.factor, self.offset = np.ones(1), np.zeros(1)
        self.noise, self.half_step2 = np.zeros(1), np.zeros(1)
        self.mean, self.variance = mean, variance
        for effect in effects:
            mean, slope, deviation, _ = effect.validate_linear(self.mean, sites)
            factor = np.ones(1) if slope is None else slope
            spread2 = np.zeros(1) if deviation is None else deviation**2
            # Draws at the reset are constants in differences of reads.
            is_drawn = effect.is_temporal and (is_reset or not effect.is_drawn_at_reset)
            added, half_step = np.zeros(1), None
            if is_drawn:
                added = spread2
                half_step = effect.half_step(sites.of(effect)) if sites.known_device is not None else None
            self.half_step2 = factor**2 * self.half_step2
            if half_step is not None:
                self.half_step2 = self.half_step2 + half_step**2
                added = np.maximum(added - half_step**2, 0.0)
            self.offset = mean - factor * (self.mean - self.offset)
            self.factor = factor * self.factor
            self.noise = factor**2 * self.noise + added
            # Without a device, fixed patterns are unknown, but do not contribute to temporal noise.
            self.mean, self.variance = mean, factor**2 * self.variance + added


def readout_model(
    sensor: Sensor, mean_e: ArrayLike, variance_e2: ArrayLike, sites: Sites, *, is_reset: bool
) -> ReadoutModel:
    """
    Compute the first-order readout model at the mean collected charges.

    ``mean_e``, ``variance_e2`` (..., n_site) or number, e- and e-²: moments of collected charges. ``sites``: all sites, with a
    device or without. ``is_reset``: whether to include the noise of effects that are drawn at the reset.
    """
    mean_e, variance_e2 = (np.atleast_1d(np.asarray(part, np.float64)) for part in (mean_e, variance_e2))
    v_per_e, v_sat_v, pedestal_v = sensor.v_per_e, sensor.v_sat_v, sensor.pedestal_v

    def linear(effects: Iterable[Effect], mean: Floats, variance: Floats) -> _LinearModel:
        return _LinearModel(effects, mean, variance, sites, is_reset=is_reset)

    def at(stage: Stage) -> Iterable[Effect]:
        return (effect for effect in sensor.chain if effect.stage == stage)

    is_mixed = False
    local: list[Effect] = []
    for effect in at("charge"):
        if effect.reach != "all":
            local.append(effect)
            continue
        before = linear(local, mean_e, variance_e2)
        mean_e, variance_e2 = effect.validate_moments(before.mean, before.variance + before.half_step2, sites)
        is_mixed, local = True, []
    charges = linear(local, mean_e, variance_e2)
    variance_v2 = (charges.variance + charges.half_step2) * v_per_e**2
    sense = linear(at("sense_node"), charges.mean * v_per_e, variance_v2)
    output_v, slope = apply_nonlinearity(sensor, sense.mean)
    last = linear(at("output"), output_v, sense.variance * slope**2)
    total_v_per_e = charges.factor * v_per_e * sense.factor
    per_v2 = np.divide(1.0, total_v_per_e**2, out=np.zeros(np.shape(total_v_per_e)), where=total_v_per_e != 0.0)
    noise_v2 = charges.noise * (v_per_e * sense.factor) ** 2 + sense.noise
    half_step_v2 = charges.half_step2 * (v_per_e * sense.factor) ** 2 + sense.half_step2
    output_slope2 = (slope * last.factor) ** 2
    per_output2 = np.divide(1.0, output_slope2, out=np.zeros(np.shape(output_slope2)), where=output_slope2 != 0.0)
    return ReadoutModel(
        mean_e=mean_e,
        variance_e2=variance_e2,
        is_mixed=is_mixed,
        transfer=Transfer(
            v_per_e=total_v_per_e,
            sense_v=charges.offset * v_per_e * sense.factor + sense.offset,
            scale=last.factor,
            output_v=pedestal_v * last.factor + last.offset,
            nonlinearity_fraction=sensor.nonlinearity_fraction,
            v_sat_v=v_sat_v,
        ),
        gaussian_e2=(noise_v2 + last.noise * per_output2) * per_v2,
        half_step_e=np.sqrt((half_step_v2 + last.half_step2 * per_output2) * per_v2),
    )


def apply_nonlinearity(sensor: Sensor, sense_v: Floats) -> tuple[Floats, Floats]:
    """Return voltages after nonlinearity and pedestal, and the slope of the nonlinearity."""
    fraction = np.clip(sense_v / sensor.v_sat_v, 0.0, 1.0)
    slope = np.maximum(1.0 - 2.0 * sensor.nonlinearity_fraction * fraction, MIN_SLOPE)
    return sense_v * (1.0 - sensor.nonlinearity_fraction * fraction) + sensor.pedestal_v, slope


@cache
def quadrature() -> Quadrature:
    """
    Compute Gauss-Legendre nodes and weights.

    The result is cached because the eigenvalue problem takes longer than the prediction for a small sensor.
    """
    return Quadrature(*(read_only(part) for part in np.polynomial.legendre.leggauss(QUADRATURE_NODES)))


def clipped_gaussian_moments(mean_e: Floats, variance_e2: Floats, limit_e: Floats) -> tuple[Floats, Floats]:
    """Compute mean and variance of a Gaussian variable clipped at an upper limit."""
    from scipy.special import ndtr

    deviation = np.sqrt(np.maximum(variance_e2, 1e-12))
    z = np.clip((limit_e - mean_e) / deviation, -40.0, 40.0)
    below, at = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    # First and second moments of the distance to the limit; without clipping, the Gaussian moments themselves.
    distance = deviation * (z * below + at)
    distance2 = deviation**2 * ((1.0 + z * z) * below + z * at)
    is_unclipped = z >= 40.0
    clipped_mean = np.where(is_unclipped, mean_e, np.where(is_unclipped, 0.0, limit_e) - distance)
    return clipped_mean, np.where(is_unclipped, variance_e2, np.maximum(distance2 - distance**2, 0.0))
