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
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.sensor.sensor import Sensor
from foveasim.units import electrons_to_volts

__all__ = ["SiteSignals", "local_step_e", "signal_to_noise"]

#: Within this many standard deviations of the full well or of the highest code, noise is cut off: its variance falls from there
#: on, which is EMVA 1288's saturation.
CUT_OFF_SIGMAS = 2.0
#: Least slope of a bent response at its end, relative to that at 0.
LEAST_SLOPE = 1e-6


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
    is_drawn = sensor.shot_noise != "off"
    well_e = np.full(1, np.inf) if sensor.full_well_e is None else np.floor(np.atleast_1d(sensor.full_well_e))
    is_saturated = charge_e + CUT_OFF_SIGMAS * np.sqrt(charge_e * is_drawn) >= well_e
    charge_e, dark = np.minimum(charge_e, well_e), np.minimum(dark, well_e)
    shot_e2 = charge_e if is_drawn else np.full(n_sites, QUANTISATION_DN2)
    charge_e, shot_e2 = sensor.coupled(charge_e, shot_e2)
    dark, _ = sensor.coupled(dark, np.zeros(n_sites))

    per_e = electrons_to_volts(1.0, sensor.capacitance_f) * sensor.gain
    line = sensor.line_offset_v
    offset_v = sensor.pixel_offset_v + (line[sensor.layout.readout_line] if line.size > 1 else line)
    readout_e2 = sensor.readout_noise_e2()
    top_e = _top_e(sensor, per_e, offset_v)
    step_e = local_step_e(sensor, charge_e, per_e, offset_v)
    noise_e = np.sqrt(shot_e2 + readout_e2 + step_e**2 * sensor.converter.noise_dn2)
    is_saturated |= charge_e + CUT_OFF_SIGMAS * noise_e >= top_e
    is_over = charge_e > top_e
    # A site beyond its range has the ratio of its end.
    part = np.divide(top_e, charge_e, out=np.ones(n_sites), where=is_over)
    charge_e, dark = np.minimum(charge_e, top_e), np.minimum(dark, top_e)
    step_e = np.where(is_over, local_step_e(sensor, charge_e, per_e, offset_v), step_e)
    noise_e = np.sqrt(shot_e2 * (part if is_drawn else 1.0) + readout_e2 + step_e**2 * sensor.converter.noise_dn2)
    return SiteSignals(
        signal_e=np.maximum(charge_e - dark, 0.0),
        noise_e=np.broadcast_to(noise_e, (n_sites,)),
        gain_dn_per_e=np.asarray(per_e / sensor.v_sat_v * 2.0**sensor.bits),
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
    with np.errstate(divide="ignore"):
        fraction = np.clip(charge_e * volts_per_e / sensor.v_sat_v, 0.0, 1.0)
        bend = sensor.nonlinearity_fraction
        lifted = np.clip(fraction * (1.0 - bend * fraction) + offset_v / sensor.v_sat_v, 0.0, 1.0)
        slope_v_per_e = volts_per_e * np.maximum(1.0 - 2.0 * bend * fraction, LEAST_SLOPE)
        step_v = sensor.converter.width_at_dn(lifted) * sensor.v_sat_v / 2.0**sensor.bits
        return np.asarray(step_v / slope_v_per_e)


def _top_e(sensor: Sensor, volts_per_e: Floats, offset_v: Floats) -> Floats:
    """Charge at which the highest code begins, at least 0, infinite where no charge gives it."""
    fraction = np.maximum(sensor.converter.borders[-2] - offset_v / sensor.v_sat_v, 0.0)
    bend = sensor.nonlinearity_fraction
    if bend:
        is_within = fraction < 1.0 - bend
        bent = 0.5 * (1.0 - np.sqrt(np.maximum(1.0 - 4.0 * bend * fraction, 0.0))) / bend
        fraction = np.where(is_within, bent, fraction / (1.0 - bend))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(volts_per_e > 0.0, fraction * sensor.v_sat_v / volts_per_e, np.inf)
