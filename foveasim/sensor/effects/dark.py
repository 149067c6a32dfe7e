"""Dark current: temperature dependence, non-uniformity (DSNU) and hot sites."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from foveasim._core.validation import Floats
from foveasim.sensor.effects.contract import FixedFactor, FixedOffset, Sites, Stage

__all__ = ["DarkSignal", "HotSites", "dark_current_factor"]


def dark_current_factor(temperature_k: float, reference_k: float, doubling_k: float) -> float:
    """
    Compute the ratio of the dark currents at two temperatures.

    Parameters
    ----------
    temperature_k, reference_k, doubling_k : float, K

    Returns
    -------
    factor : float
        ``2 ** ((temperature_k - reference_k) / doubling_k)``; infinite on overflow.
    """
    try:
        return float(2.0 ** ((temperature_k - reference_k) / doubling_k))
    except OverflowError:
        return float("inf")


@dataclass(frozen=True)
class DarkSignal(FixedFactor):
    """
    Dark-signal non-uniformity (DSNU): log-normal factors of mean 1 on the dark current.

    Parameters
    ----------
    dsnu_fraction : float
        Ratio of standard deviation to mean.
    """

    name: ClassVar[str] = "dsnu"
    stage: ClassVar[Stage] = "dark"

    dsnu_fraction: float

    @classmethod
    def from_sensor(cls, sensor: Any) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        return cls(sensor.dsnu_fraction) if sensor.dsnu_fraction else None

    def pattern(self, sites: Sites) -> Floats:
        """Return the factors, (n,)."""
        return sites.device.log_normals(self.name, self.dsnu_fraction)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 1 and the square of ``dsnu_fraction``."""
        _ = sites
        return 1.0, self.dsnu_fraction**2


@dataclass(frozen=True)
class HotSites(FixedOffset):
    """
    Hot sites: sites with additional dark current.

    Parameters
    ----------
    hot_fraction : float
        Probability that a site is hot.
    hot_e_per_s : float, e-/s
        Additional dark current at the sensor's temperature.
    """

    name: ClassVar[str] = "hot"
    stage: ClassVar[Stage] = "dark"

    hot_fraction: float
    hot_e_per_s: float

    @classmethod
    def from_sensor(cls, sensor: Any) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        is_on = sensor.hot_fraction and sensor.hot_e_per_s
        return cls(sensor.hot_fraction, sensor.hot_e_per_s * sensor.dark_current_ratio) if is_on else None

    def pattern(self, sites: Sites) -> Floats:
        """Return the additional dark current, (n,) e-/s."""
        return np.where(sites.device.uniforms(self.name) < self.hot_fraction, self.hot_e_per_s, 0.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return the moments of a Bernoulli distribution times the additional current."""
        _ = sites
        probability = self.hot_fraction
        return probability * self.hot_e_per_s, probability * (1.0 - probability) * self.hot_e_per_s**2
