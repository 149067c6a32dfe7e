"""
Signal-to-noise ratio of photosites, as used in tables, metrics, plots and web pages.

The definition is that of EMVA 1288 (Release 4.0 Linear, equation 17) for each site, referred to the charge: photoelectrons over
the temporal noise of the charge, including quantisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.model.linearisation import Linearisation
from foveasim.sensor.sensor import Sensor

__all__ = ["SiteSignals", "signal_to_noise"]


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

    @property
    def unsaturated_ratio(self) -> Floats:
        """
        Signal-to-noise ratio of sites that measure light, (n_site,); 0 for saturated ones.

        Means and medians over sites use it, so that a result does not improve when more sites saturate.
        """
        return np.where(self.is_saturated, 0.0, self.ratio)


def signal_to_noise(
    sensor: Sensor, expected_e: ArrayLike, dark_e: ArrayLike, *, exposure_s: Annotated[float | None, EXPOSURE] = None
) -> SiteSignals:
    """
    Compute signal and temporal noise of each site analytically.

    Parameters
    ----------
    sensor : Sensor
    expected_e : (n_site,) float64, e-
        Expected charge from :meth:`Sensor.expected_electrons`.
    dark_e : (n_site,) float64, e-
        Expected charge of a dark frame with the same exposure.
    exposure_s : float, optional, s
        Required by collections that depend on it.

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
    >>> sensor = fs.Sensor(
    ...     layout, bits=8, v_sat_v=1.0, capacitance_f=25_600 * 1.602176634e-19
    ... )
    >>> signal_to_noise(sensor, [400.0], [0.0]).ratio.round(2).tolist()
    [11.39]
    """
    charge_e, dark = (
        sensor.validate_charges(name, values) for name, values in (("expected_e", expected_e), ("dark_e", dark_e))
    )
    return site_signals(sensor.linearise(charge_e, exposure_s=exposure_s), dark)


def site_signals(model: Linearisation, dark_e: Floats) -> SiteSignals:
    """Return signal and noise of :func:`signal_to_noise` for a model at the expected charge."""
    charge_e = model.node_e
    dark_model = model.sensor.linearise(dark_e, exposure_s=model.exposure_s)
    dark_node_e = np.minimum(dark_model.node_e, model.top_e)
    return SiteSignals(
        signal_e=np.maximum(model.node_e - dark_node_e, 0.0),
        noise_e=np.broadcast_to(np.sqrt(model.variance_e2()), charge_e.shape),
        gain_dn_per_e=model.linear_gain_dn_per_e,
        is_saturated=model.is_saturated,
    )
