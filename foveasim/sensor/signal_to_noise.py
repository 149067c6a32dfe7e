"""
The signal-to-noise ratio of photosites: one definition for tables, metrics, plots and web pages.

It is EMVA 1288's (Release 4.0 Linear, equation 17), site by site and referred to the charge: the light's part of the expected
charge over its temporal noise, quantisation included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Bools, Floats
from foveasim.sensor.prediction import LEAST_SLOPE, ReadoutModel
from foveasim.sensor.sensor import Sensor

__all__ = ["SiteSignals", "local_step_e", "signal_to_noise"]

#: Within this many standard deviations of the full well or of the highest code, noise is cut off: its variance falls from there
#: on, which is EMVA 1288's saturation.
CUT_OFF_SIGMAS = 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class SiteSignals:
    """
    Signal and temporal noise of every site, referred to its charge.

    Attributes
    ----------
    signal_e : (n_site,) float64, e-
        Expected charge less that of a dark frame.
    noise_e : (n_site,) float64, e-
        Standard deviation from frame to frame, of conversion to codes too.
    gain_dn_per_e : (n_site,) or (1,) float64, DN/e-
        Linear codes per electron.
    is_saturated : (n_site,) bool
        Whether the full well or the highest code cuts off noise: within two standard deviations.
    """

    signal_e: Floats
    noise_e: Floats
    gain_dn_per_e: Floats
    is_saturated: Bools

    @property
    def ratio(self) -> Floats:
        """Signal-to-noise ratio, (n_site,); 0 where there is neither signal nor noise."""
        return np.divide(self.signal_e, self.noise_e, out=np.zeros_like(self.signal_e), where=self.noise_e > 0.0)


def signal_to_noise(sensor: Sensor, expected_e: ArrayLike, dark_e: ArrayLike) -> SiteSignals:
    """
    Return signal and temporal noise of every site, without a draw.

    Parameters
    ----------
    sensor : Sensor
    expected_e : (n_site,) float64, e-
        Expected charge, as :meth:`Sensor.expected_electrons` gives it.
    dark_e : (n_site,) float64, e-
        The same of a dark frame of the same exposure.

    Returns
    -------
    SiteSignals

    Raises
    ------
    ParameterError
        When there is not one charge of at least 0 for each site.

    Notes
    -----
    For an expected charge N of which D is dark charge, and a system gain K in codes per electron,

    ::

        SNR = (N - D) / sqrt(N + reset² + read² + rts² / 4 + q² / K²),    q² = 1/12 DN² + dnl²

    The variance is that of the signal before conversion, and conversion adds to it once. It is not the variance of the codes,
    which has quantisation in it only where noise spans several codes, and vanishes inside one code: over all positions of the
    charge within a code, variance and squared error of the codes together are ``K² sigma² + 1/12`` for any sigma, the second
    moment of a Gaussian and a uniform distribution that are independent. Where noise spans more than one code the
    ratio is that of the codes.

    Since the denominator is at least the root of N, and N at least the signal, ``SNR <= sqrt(N - D)``. It grows with
    exposure as long as the step ``1 / K`` grows no faster than the charge: so for linear, square-root and logarithmic
    converters. A companding table with a kink has a fall of the ratio there, as such sensors have.

    - Companding: K is the local slope, from the width of the codes at the site's mean. The ratio in companded codes would be
      twice as high for a square root.
    - Bent response: K has its local slope.
    - Saturation: clips reduce neither noise nor signal here before they are reached. Beyond the full well, or the charge at
      which the highest code begins, the ratio stays at its value there, EMVA's highest, and :attr:`SiteSignals.is_saturated`
      holds. Clips at code 0 are not counted: give a pedestal.
    - Differential non-linearity: its variance in squares of a code adds to that of quantisation, of which it is a further part:
      each line adds a number of its own before each code.
    - Without shot noise charges are rounded to integers, of the variance 1/12 e-².
    - Inter-pixel coupling mixes drawn charges, so that a site's variance is below its charge and ratios may pass its root.

    Fixed patterns of the device count where they change gain or dark charge, but not as noise: the ratio is temporal.

    Examples
    --------
    Eight bits of 100 e- each hide the shot noise of 400 e-:

    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0)
    >>> sensor = fs.Sensor(layout, bits=8, v_sat_v=1.0, capacitance_f=25_600 * 1.602176634e-19)
    >>> signal_to_noise(sensor, [400.0], [0.0]).ratio.round(2).tolist()
    [11.39]
    """
    n_sites = sensor.layout.n_sites
    charge_e, dark = (
        sensor.checked_charges(name, values) for name, values in (("expected_e", expected_e), ("dark_e", dark_e))
    )
    shot, well_e = sensor.shot, sensor.well_e
    is_saturated = charge_e + CUT_OFF_SIGMAS * np.sqrt(charge_e * shot.is_drawn) >= well_e
    charge_e, dark = np.minimum(charge_e, well_e), np.minimum(dark, well_e)
    model = sensor.readout_model(*shot.moments(charge_e, np.zeros(n_sites)))
    charge_e, shot_e2 = (np.broadcast_to(part, n_sites) for part in (model.mean_e, model.variance_e2))
    dark = sensor.readout_model(dark).mean_e

    top_e = _top_e(sensor, model)
    step_e = _step_e(sensor, charge_e, model)
    noise_e = np.sqrt(shot_e2 + model.noise_e2 + step_e**2 * sensor.converter.noise_dn2)
    is_saturated |= charge_e + CUT_OFF_SIGMAS * noise_e >= top_e
    is_complete = charge_e > top_e
    # A site beyond its range has the ratio of its end.
    part = np.divide(top_e, charge_e, out=np.ones(n_sites), where=is_complete)
    charge_e, dark = np.minimum(charge_e, top_e), np.minimum(dark, top_e)
    step_e = np.where(is_complete, _step_e(sensor, charge_e, model), step_e)
    noise_e = np.sqrt(
        shot_e2 * (part if shot.is_drawn else 1.0) + model.noise_e2 + step_e**2 * sensor.converter.noise_dn2
    )
    gain_v_per_e = model.transfer.v_per_e * model.transfer.scale
    return SiteSignals(
        signal_e=np.maximum(charge_e - dark, 0.0),
        noise_e=np.broadcast_to(noise_e, (n_sites,)),
        gain_dn_per_e=np.asarray(gain_v_per_e / sensor.v_sat_v * 2.0**sensor.bits),
        is_saturated=np.asarray(is_saturated),
    )


def local_step_e(sensor: Sensor, charge_e: Floats, volts_per_e: Floats, offset_v: Floats) -> Floats:
    """
    Width of a code at every site's mean, (n_site,) e-: the inverse of the local gain of the whole chain.

    Parameters
    ----------
    sensor : Sensor
        Its converter and its bent response count.
    charge_e : (n_site,) float64, e-
        Mean charge.
    volts_per_e, offset_v : (n_site,) or (1,) float64, V
        As they are in the device, or as they are meant.
    """
    offset = np.asarray(offset_v, np.float64)
    return _local_step_e(sensor, charge_e, volts_per_e, np.zeros(1), np.ones(1), offset)


def _step_e(sensor: Sensor, charge_e: Floats, model: ReadoutModel) -> Floats:
    """Width of a code at given charges on this device, e-."""
    way = model.transfer
    return _local_step_e(sensor, charge_e, way.v_per_e, way.sense_v, way.scale, way.output_v)


def _local_step_e(
    sensor: Sensor, charge_e: Floats, v_per_e: Floats, sense_v: Floats, scale: Floats, output_v: Floats
) -> Floats:
    with np.errstate(divide="ignore"):
        fraction = np.clip((charge_e * v_per_e + sense_v) / sensor.v_sat_v, 0.0, 1.0)
        bend = sensor.nonlinearity_fraction
        lifted = np.clip(fraction * (1.0 - bend * fraction) * scale + output_v / sensor.v_sat_v, 0.0, 1.0)
        slope_v_per_e = v_per_e * scale * np.maximum(1.0 - 2.0 * bend * fraction, LEAST_SLOPE)
        step_v = sensor.converter.width_at_dn(lifted) * sensor.v_sat_v / 2.0**sensor.bits
        return np.asarray(step_v / slope_v_per_e)


def _top_e(sensor: Sensor, model: ReadoutModel) -> Floats:
    """Charge at which the highest code begins, at least 0, infinite where no charge gives it."""
    way = model.transfer
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.maximum((sensor.converter.borders[-2] - way.output_v / sensor.v_sat_v) / way.scale, 0.0)
        bend = sensor.nonlinearity_fraction
        if bend:
            is_within = fraction < 1.0 - bend
            bent = 0.5 * (1.0 - np.sqrt(np.maximum(1.0 - 4.0 * bend * fraction, 0.0))) / bend
            fraction = np.where(is_within, bent, fraction / (1.0 - bend))
        top_v = np.maximum(fraction * sensor.v_sat_v - way.sense_v, 0.0)
        return np.where(way.v_per_e > 0.0, top_v / way.v_per_e, np.inf)
