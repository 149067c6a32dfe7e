"""Fixed patterns of the photo response: non-uniformity (PRNU) and dead sites."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from foveasim._core.validation import Floats
from foveasim.sensor.effects.contract import FixedFactor, Sites, Stage

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

__all__ = ["DeadSites", "PhotoResponse"]


@dataclass(frozen=True)
class PhotoResponse(FixedFactor):
    """
    Photo-response non-uniformity (PRNU): Gaussian factors of mean 1, clipped at 0.

    Parameters
    ----------
    prnu_fraction : float
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"prnu_fraction": 0.02}
    name: ClassVar[str] = "prnu"
    stage: ClassVar[Stage] = "photo"
    needs_layout: ClassVar[bool] = False

    prnu_fraction: float

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        return cls(sensor.prnu_fraction) if sensor.prnu_fraction else None

    def pattern(self, sites: Sites) -> Floats:
        """Return the factors, (n,)."""
        return np.maximum(1.0 + self.prnu_fraction * sites.device.normals(self.name), 0.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 1 and the square of ``prnu_fraction``."""
        _ = sites
        return 1.0, self.prnu_fraction**2


@dataclass(frozen=True)
class DeadSites(FixedFactor):
    """
    Dead sites: sites without photo response.

    Parameters
    ----------
    dead_fraction : float
        Probability that a site is dead.
    """

    example: ClassVar[Mapping[str, Any]] = {"dead_fraction": 0.1}
    name: ClassVar[str] = "dead"
    stage: ClassVar[Stage] = "photo"
    needs_layout: ClassVar[bool] = False

    dead_fraction: float

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        return cls(sensor.dead_fraction) if sensor.dead_fraction else None

    def pattern(self, sites: Sites) -> Floats:
        """Return 0 for dead sites and 1 for others, (n,)."""
        return np.where(sites.device.uniforms(self.name) < self.dead_fraction, 0.0, 1.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return the moments of a Bernoulli distribution."""
        _ = sites
        return 1.0 - self.dead_fraction, self.dead_fraction * (1.0 - self.dead_fraction)
