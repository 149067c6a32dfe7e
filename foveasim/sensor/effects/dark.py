"""Dark current: temperature dependence, non-uniformity (DSNU) and hot sites."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from foveasim._core.calls import FRACTION, NOT_NEGATIVE, Declared, Limits
from foveasim._core.validation import Floats
from foveasim.sensor.effects.contract import FixedFactor, FixedOffset, Sites, Stage
from foveasim.sensor.limits import SHARE, TEMPERATURE
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C

__all__ = ["DarkLaw", "DarkSignal", "HotSites", "dark_current_factor"]

#: Temperature dependence of the dark current.
DarkLaw = Literal["doubling", "arrhenius", "diffusion_generation"]

DOUBLING = Limits(above=0.0, low=0.1, at_most=1000.0, hint="dark current doubles every 5 to 10 K")
ACTIVATION = Limits(above=0.0, low=0.01, at_most=10.0, hint="in silicon, generation has 0.63 eV and diffusion 1.27 eV")
BOLTZMANN_EV_PER_K = BOLTZMANN_J_PER_K / ELEMENTARY_CHARGE_C
#: Band gap of silicon at 0 K, and the coefficients of its temperature dependence: Y. P. Varshni, Physica 34, 149 (1967).
BAND_GAP_0_EV, BAND_GAP_EV_PER_K, BAND_GAP_K = 1.1557, 7.021e-4, 1108.0


def dark_current_factor(
    temperature_k: Annotated[float, TEMPERATURE],
    reference_k: Annotated[float, TEMPERATURE],
    law: DarkLaw = "doubling",
    *,
    doubling_k: Annotated[float, DOUBLING] = 8.0,
    activation_ev: Annotated[float, ACTIVATION] = 0.67,
    diffusion_fraction: Annotated[float, SHARE] = 0.5,
) -> float:
    """
    Compute the ratio of the dark currents at two temperatures.

    Parameters
    ----------
    temperature_k, reference_k : float, K
        Temperature T and reference temperature T₀.
    law : {"doubling", "arrhenius", "diffusion_generation"}
        ``"doubling"``: ``2 ** ((T - T₀) / doubling_k)``, the empirical rule of EMVA 1288. Use it near T₀: in silicon, the
        doubling temperature decreases on cooling, so that the rule is too bright there. ``"arrhenius"``:
        ``exp(-activation_ev / k (1 / T - 1 / T₀))``. ``"diffusion_generation"``: the sum of generation in the depletion region,
        proportional to the intrinsic carrier density ``n ~ T**1.5 exp(-E_g(T) / 2 k T)``, and diffusion from the neutral bulk,
        proportional to ``n**2``, with the band gap of silicon, ``E_g = 1.1557 eV - 7.021e-4 T**2 / (1108 + T)``.
    doubling_k : float, K
        Temperature rise that doubles the dark current; for ``"doubling"``.
    activation_ev : float, eV
        Activation energy E; for ``"arrhenius"``. The current doubles in ``k T² ln 2 / E``: in 8.0 K at 300 K for 0.67 eV. Near
        300 K, the generation current of the third law has 0.63 eV and the diffusion current 1.27 eV.
    diffusion_fraction : float
        Fraction of the diffusion current at T₀, from 0 to 1; for ``"diffusion_generation"``. At 300 K, generation doubles in
        8.48 K and diffusion in 4.24 K; at 233 K in 5.23 and 2.62 K.

    Returns
    -------
    factor : float
        At least 0; infinite on overflow.

    Notes
    -----
    Sources: EMVA Standard 1288, release 4.0 linear, for the doubling rule; J. R. Janesick, Scientific charge-coupled devices
    (SPIE, 2001), chapter 7, for depletion and diffusion dark current; R. Widenhorn, M. M. Blouke, A. Weber, A. Rest and
    E. Bodegom, Temperature dependence of dark current in a CCD, Proc. SPIE 4669, 193 (2002), for measured activation energies;
    Y. P. Varshni, Physica 34, 149 (1967), for the band gap.

    Examples
    --------
    At -40 °C, the doubling rule is 3.2 times as bright as generation alone:

    >>> generation = dark_current_factor(
    ...     233.0, 300.0, "diffusion_generation", diffusion_fraction=0.0
    ... )
    >>> round(dark_current_factor(233.0, 300.0) / generation, 1)
    3.2
    """
    try:
        if law == "doubling":
            return float(2.0 ** ((temperature_k - reference_k) / doubling_k))
        if law == "arrhenius":
            return math.exp(activation_ev / BOLTZMANN_EV_PER_K * (1.0 / reference_k - 1.0 / temperature_k))
        carriers = math.exp(_log_carriers(temperature_k) - _log_carriers(reference_k))
        return (1.0 - diffusion_fraction) * carriers + diffusion_fraction * carriers**2
    except OverflowError:
        return math.inf


def _log_carriers(temperature_k: float) -> float:
    """Return the logarithm of the intrinsic carrier density of silicon, up to a constant."""
    gap_ev = BAND_GAP_0_EV - BAND_GAP_EV_PER_K * temperature_k**2 / (BAND_GAP_K + temperature_k)
    return 1.5 * math.log(temperature_k) - gap_ev / (2.0 * BOLTZMANN_EV_PER_K * temperature_k)


@dataclass(frozen=True)
class DarkSignal(Declared, FixedFactor):
    """
    Dark-signal non-uniformity (DSNU): log-normal factors of mean 1 on the dark current.

    Parameters
    ----------
    dsnu_fraction : float
        Ratio of standard deviation to mean.
    """

    example: ClassVar[Mapping[str, Any]] = {"dark_e_per_s": 4000.0, "dsnu_fraction": 0.3}
    name: ClassVar[str] = "dsnu"
    stage: ClassVar[Stage] = "dark"
    needs_layout: ClassVar[bool] = False

    dsnu_fraction: Annotated[float, NOT_NEGATIVE]

    def pattern(self, sites: Sites) -> Floats:
        """Return the factors, (n,)."""
        return sites.device.log_normals(self.name, self.dsnu_fraction)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 1 and the square of ``dsnu_fraction``."""
        return 1.0, self.dsnu_fraction**2


@dataclass(frozen=True)
class HotSites(Declared, FixedOffset):
    """
    Hot sites: sites with additional dark current.

    Parameters
    ----------
    hot_fraction : float
        Probability that a site is hot.
    hot_e_per_s : float, e-/s
        Additional dark current at the sensor's temperature.
    """

    example: ClassVar[Mapping[str, Any]] = {"hot_fraction": 0.05, "hot_e_per_s": 3000.0}
    name: ClassVar[str] = "hot"
    stage: ClassVar[Stage] = "dark"
    is_defect: ClassVar[bool] = True
    needs_layout: ClassVar[bool] = False

    hot_fraction: Annotated[float, FRACTION]
    hot_e_per_s: Annotated[float, NOT_NEGATIVE]

    def pattern(self, sites: Sites) -> Floats:
        """Return the additional dark current, (n,) e-/s."""
        return np.where(sites.device.uniforms(self.name) < self.hot_fraction, self.hot_e_per_s, 0.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return the moments of a Bernoulli distribution times the additional current."""
        probability = self.hot_fraction
        return probability * self.hot_e_per_s, probability * (1.0 - probability) * self.hot_e_per_s**2
