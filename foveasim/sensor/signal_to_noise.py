"""
Signal-to-noise ratio of photosites, as used in tables, metrics, plots and web pages.

The definition is that of EMVA 1288 (Release 4.0 Linear, equation 17) for each site, referred to the charge: photoelectrons over
the temporal noise of the charge, including quantisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats
from foveasim.sensor.prediction import MIN_SLOPE, ReadoutModel
from foveasim.sensor.sensor import Sensor

__all__ = ["SiteSignals", "local_step_e", "signal_to_noise"]

#: Noise is clipped within this number of standard deviations of the full well or the highest code. Its variance decreases from
#: there on, which is the saturation criterion of EMVA 1288.
CLIPPING_SIGMAS = 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class SiteSignals:
    """
    Signal and temporal noise of each site, referred to its charge.

    Attributes
    ----------
    signal_e : (n_site,) float64, e-
        Expected charge minus that of a dark frame.
    noise_e : (n_site,) float64, e-
        Temporal standard deviation, including conversion to codes.
    gain_dn_per_e : (n_site,) or (1,) float64, DN/e-
        System gain: linear codes per electron.
    is_saturated : (n_site,) bool
        Whether noise is clipped by the full well or the highest code, within two standard deviations.
    """

    signal_e: Floats
    noise_e: Floats
    gain_dn_per_e: Floats
    is_saturated: Bools

    __repr__ = short_repr

    @property
    def ratio(self) -> Floats:
        """Signal-to-noise ratio, (n_site,); 0 for sites without noise."""
        return np.divide(self.signal_e, self.noise_e, out=np.zeros_like(self.signal_e), where=self.noise_e > 0.0)


def signal_to_noise(sensor: Sensor, expected_e: ArrayLike, dark_e: ArrayLike) -> SiteSignals:
    """
    Compute signal and temporal noise of each site analytically.

    Parameters
    ----------
    sensor : Sensor
    expected_e : (n_site,) float64, e-
        Expected charge from :meth:`Sensor.expected_electrons`.
    dark_e : (n_site,) float64, e-
        Expected charge of a dark frame with the same exposure.

    Notes
    -----
    For an expected charge N, which includes a dark signal D, and a system gain K in codes per electron,

    ::

        SNR = (N - D) / sqrt(N + reset² + read² + rts² / 4 + q² / K²),    q² = 1/12 DN² + dnl²

    The variance is that of the signal before conversion, plus the variance of conversion. It is not the variance of the codes,
    which includes quantisation only if noise spans several codes, and vanishes for noise within one code. Averaged over all
    positions of the charge within a code, the mean squared error of the codes is ``K² sigma² + 1/12`` for any sigma: the
    second moment of independent Gaussian and uniform distributions. If noise spans more than one code, the ratio is that of
    the codes.

    Since the denominator is at least ``sqrt(N)``, and N is at least the signal, ``SNR <= sqrt(N - D)``. The SNR increases with
    exposure if the step ``1 / K`` does not increase faster than the charge, as for linear, square-root and logarithmic
    companding. At a kink of a companding table the SNR drops, as in real sensors of this kind.

    - Companding: K is the local slope, from the width of the codes at the site's mean. For square-root companding, the ratio
      in companded codes would be twice as high.
    - Response nonlinearity: K includes its local slope.
    - Saturation: clipping reduces neither noise nor signal before saturation. Above the full well, or above the first charge
      with the highest code, the SNR remains at its value there, the maximum SNR of EMVA 1288, and
      :attr:`SiteSignals.is_saturated` is True. Clipping at code 0 is not included: use a pedestal.
    - Differential nonlinearity: its variance in squared codes adds to that of quantisation, because each code transition of a
      readout line has its own offset.
    - Without shot noise, charges are rounded to integers, with a variance of 1/12 e-².
    - Inter-pixel capacitance mixes drawn charges: the variance of a site is below its charge, and its SNR may exceed
      ``sqrt(N)``.

    Fixed patterns of the device affect gain and dark signal, but do not count as noise: the SNR is temporal.

    Examples
    --------
    Quantisation with 100 e- per code (8 bits) dominates the shot noise of 400 e-:

    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0)
    >>> sensor = fs.Sensor(layout, bits=8, v_sat_v=1.0, capacitance_f=25_600 * 1.602176634e-19)
    >>> signal_to_noise(sensor, [400.0], [0.0]).ratio.round(2).tolist()
    [11.39]
    """
    n_sites = sensor.layout.n_sites
    charge_e, dark = (
        sensor.validate_charges(name, values) for name, values in (("expected_e", expected_e), ("dark_e", dark_e))
    )
    shot, well_e = sensor.shot, sensor.well_e
    is_saturated = charge_e + CLIPPING_SIGMAS * np.sqrt(charge_e * shot.is_drawn) >= well_e
    charge_e, dark = np.minimum(charge_e, well_e), np.minimum(dark, well_e)
    model = sensor.readout_model(*shot.moments(charge_e, np.zeros(n_sites)))
    charge_e, shot_e2 = (np.broadcast_to(part, n_sites) for part in (model.mean_e, model.variance_e2))
    dark = sensor.readout_model(dark).mean_e

    top_e = _top_e(sensor, model)
    step_e = _step_e(sensor, charge_e, model)
    noise_e = np.sqrt(shot_e2 + model.noise_e2 + step_e**2 * sensor.adc.noise_dn2)
    is_saturated |= charge_e + CLIPPING_SIGMAS * noise_e >= top_e
    is_complete = charge_e > top_e
    # Sites above their range have the SNR of the end of the range.
    part = np.divide(top_e, charge_e, out=np.ones(n_sites), where=is_complete)
    charge_e, dark = np.minimum(charge_e, top_e), np.minimum(dark, top_e)
    step_e = np.where(is_complete, _step_e(sensor, charge_e, model), step_e)
    noise_e = np.sqrt(shot_e2 * (part if shot.is_drawn else 1.0) + model.noise_e2 + step_e**2 * sensor.adc.noise_dn2)
    gain_v_per_e = model.transfer.v_per_e * model.transfer.scale
    return SiteSignals(
        signal_e=np.maximum(charge_e - dark, 0.0),
        noise_e=np.broadcast_to(noise_e, (n_sites,)),
        gain_dn_per_e=np.asarray(gain_v_per_e / sensor.v_sat_v * 2.0**sensor.bits),
        is_saturated=np.asarray(is_saturated),
    )


def local_step_e(
    sensor: Sensor,
    charge_e: Floats,
    v_per_e: Floats,
    *,
    sense_v: Floats | float = 0.0,
    scale: Floats | float = 1.0,
    output_v: Floats | float = 0.0,
) -> Floats:
    """
    Compute the code width at each site's mean charge, (n_site,) e-.

    The width is the inverse of the local gain of the complete chain; ``v_per_e`` and the following parameters are those of
    :class:`~foveasim.sensor.prediction.Transfer`, of the device or nominal.
    """
    with np.errstate(divide="ignore"):
        fraction = np.clip((charge_e * v_per_e + sense_v) / sensor.v_sat_v, 0.0, 1.0)
        nonlinearity = sensor.nonlinearity_fraction
        after_offset = np.clip(fraction * (1.0 - nonlinearity * fraction) * scale + output_v / sensor.v_sat_v, 0.0, 1.0)
        slope_v_per_e = v_per_e * scale * np.maximum(1.0 - 2.0 * nonlinearity * fraction, MIN_SLOPE)
        step_v = sensor.adc.width_at_dn(after_offset) * sensor.v_sat_v / 2.0**sensor.bits
        return np.asarray(step_v / slope_v_per_e)


def _step_e(sensor: Sensor, charge_e: Floats, model: ReadoutModel) -> Floats:
    """Compute the code width at given charges on this device, e-."""
    v_per_e, sense_v, scale, output_v, *_ = model.transfer
    return local_step_e(sensor, charge_e, v_per_e, sense_v=sense_v, scale=scale, output_v=output_v)


def _top_e(sensor: Sensor, model: ReadoutModel) -> Floats:
    """Compute the lowest charge with the highest code, at least 0; infinite if none has it."""
    transfer = model.transfer
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.maximum(
            (sensor.adc.transition_levels[-2] - transfer.output_v / sensor.v_sat_v) / transfer.scale, 0.0
        )
        nonlinearity = sensor.nonlinearity_fraction
        if nonlinearity:
            is_within = fraction < 1.0 - nonlinearity
            relative = 0.5 * (1.0 - np.sqrt(np.maximum(1.0 - 4.0 * nonlinearity * fraction, 0.0))) / nonlinearity
            fraction = np.where(is_within, relative, fraction / (1.0 - nonlinearity))
        top_v = np.maximum(fraction * sensor.v_sat_v - transfer.sense_v, 0.0)
        return np.where(transfer.v_per_e > 0.0, top_v / transfer.v_per_e, np.inf)
