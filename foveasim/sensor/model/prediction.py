"""Analytic sensor chain: moments of charges, and arguments of the kernels for predictions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Floats, Ints, read_only

#: Minimum slope of a nonlinear response, relative to the slope at zero signal.
MIN_SLOPE = 1e-6


class ChargeDistributions(NamedTuple):
    """Charge distributions for the kernels: read-only arrays (n,) or (1,)."""

    mean_e: Floats
    variance_e2: Floats
    well_e: Floats
    sigma_e: Floats
    half_step_e: Floats
    is_drawn: bool


class ChargeTables(NamedTuple):
    """
    Discrete charge distributions for the kernels; empty for Poisson distributions.

    Read-only arrays. Site i has the probabilities ``probability_fraction[offset[i] : offset[i + 1]]`` of consecutive charges
    from ``first_e[i]``, in whole electrons: ``first_e`` (n,) int64, ``offset`` (n + 1,) int64, ``probability_fraction``
    (offset[n],) float64. A sum other than 1 is normalised.
    """

    first_e: Ints
    offset: Ints
    probability_fraction: Floats


#: Tables of Poisson-distributed charges.
NO_TABLES = ChargeTables(read_only(np.zeros(0, np.int64)), read_only(np.zeros(0, np.int64)), read_only(np.zeros(0)))


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

    def linear_gain_dn_per_e(self, n_codes: int) -> Floats:
        """Return the linear codes per electron at the slope of the response at zero."""
        return self.v_per_e * self.scale / self.v_sat_v * n_codes


class ReadoutModel(NamedTuple):
    """
    First-order model of the readout at the mean collected charges.

    Attributes
    ----------
    mean_e, variance_e2 : (..., n_site), e- and e-²
        Moments of the charges after effects that mix sites, such as inter-pixel capacitance.
    is_mixed : bool
        Whether such an effect is present, so that charges are no longer Poisson-distributed.
    own_fraction : (n_site,) or None
        Fraction of each site's own charge after a single such effect; None for none or several.
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
    own_fraction: Floats | None
    transfer: Transfer
    gaussian_e2: Floats
    half_step_e: Floats

    @property
    def noise_e2(self) -> Floats:
        """Variance of the total temporal noise of the readout, referred to the charge, e-²."""
        return np.asarray(self.gaussian_e2 + self.half_step_e**2)


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
