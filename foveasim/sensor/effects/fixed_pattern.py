"""Fixed-pattern noise (FPN) of the readout: pixel gain, pixel offset and column offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from foveasim._core.validation import Floats
from foveasim.sensor.effects.contract import FixedFactor, FixedOffset, Sites, Stage

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

__all__ = ["ColumnOffset", "PixelGain", "PixelOffset"]


@dataclass(frozen=True)
class PixelGain(FixedFactor):
    """
    Gain FPN: Gaussian factors of mean 1 on the conversion gain, clipped at 0.

    Parameters
    ----------
    gain_fpn_fraction : float
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"gain_fpn_fraction": 0.02}
    name: ClassVar[str] = "gain_fpn"
    stage: ClassVar[Stage] = "sense_node"
    needs_layout: ClassVar[bool] = False

    gain_fpn_fraction: float

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        return cls(sensor.gain_fpn_fraction) if sensor.gain_fpn_fraction else None

    def pattern(self, sites: Sites) -> Floats:
        """Return the factors, (n,)."""
        return np.maximum(1.0 + self.gain_fpn_fraction * sites.device.normals(self.name), 0.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 1 and the square of ``gain_fpn_fraction``."""
        _ = sites
        return 1.0, self.gain_fpn_fraction**2


@dataclass(frozen=True)
class PixelOffset(FixedOffset):
    """
    Pixel FPN: Gaussian offsets, which correlated double sampling removes.

    Parameters
    ----------
    offset_v : float, V
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"pixel_fpn_fraction": 1e-3}
    name: ClassVar[str] = "pixel_fpn"
    stage: ClassVar[Stage] = "output"
    needs_layout: ClassVar[bool] = False

    offset_v: float

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        is_on = sensor.pixel_fpn_fraction and not sensor.cds
        return cls(sensor.v_sat_v * sensor.pixel_fpn_fraction) if is_on else None

    def pattern(self, sites: Sites) -> Floats:
        """Return the offsets, (n,) V."""
        return self.offset_v * sites.device.normals(self.name)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 0 and the square of ``offset_v``."""
        _ = sites
        return 0.0, self.offset_v**2


@dataclass(frozen=True)
class ColumnOffset(FixedOffset):
    """
    Column FPN: Gaussian offsets, the same for all sites of a readout line.

    Parameters
    ----------
    offset_v : float, V
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"line_fpn_fraction": 1e-3}
    name: ClassVar[str] = "column_fpn"
    stage: ClassVar[Stage] = "output"
    needs_layout: ClassVar[bool] = False

    offset_v: float

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> Self | None:
        """Return the effect that a sensor's keywords specify, or None."""
        return cls(sensor.v_sat_v * sensor.line_fpn_fraction) if sensor.line_fpn_fraction else None

    def pattern(self, sites: Sites) -> Floats:
        """Return the offset of each site's readout line, (n,) V."""
        lines, line_of_site = np.unique(sites.layout.readout_line, return_inverse=True)
        return (self.offset_v * sites.device.line_normals(self.name, lines))[line_of_site]

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 0 and the square of ``offset_v``."""
        _ = sites
        return 0.0, self.offset_v**2
