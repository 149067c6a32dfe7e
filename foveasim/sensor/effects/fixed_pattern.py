"""Fixed patterns: photo response (PRNU), dead sites, and fixed-pattern noise (FPN)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from foveasim._core.calls import FRACTION, NOT_NEGATIVE, Declared
from foveasim._core.validation import Floats
from foveasim.sensor.effects.contract import FixedFactor, FixedOffset, Sites, Stage

__all__ = ["ColumnOffset", "DarkOffset", "DeadSites", "PhotoResponse", "PixelGain", "PixelOffset"]


@dataclass(frozen=True)
class _GaussianFactor(Declared, FixedFactor):
    """Gaussian factors of mean 1, clipped at 0, of the standard deviation ``fraction``."""

    needs_layout: ClassVar[bool] = False

    fraction: Annotated[float, NOT_NEGATIVE]

    def pattern(self, sites: Sites) -> Floats:
        """Return the factors, (n,)."""
        return np.maximum(1.0 + self.fraction * sites.device.normals(self.name), 0.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 1 and the square of ``fraction``."""
        return 1.0, self.fraction**2


class PhotoResponse(_GaussianFactor):
    """
    Photo-response non-uniformity (PRNU): Gaussian factors of mean 1, clipped at 0.

    Parameters
    ----------
    fraction : float
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"prnu_fraction": 0.02}
    name: ClassVar[str] = "prnu"
    stage: ClassVar[Stage] = "photo"


class PixelGain(_GaussianFactor):
    """
    Gain FPN: Gaussian factors of mean 1 on the conversion gain, clipped at 0.

    Parameters
    ----------
    fraction : float
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"gain_fpn_fraction": 0.02}
    name: ClassVar[str] = "gain_fpn"
    stage: ClassVar[Stage] = "sense_node"


@dataclass(frozen=True)
class DeadSites(Declared, FixedFactor):
    """
    Dead sites: sites without photo response.

    Parameters
    ----------
    fraction : float
        Probability that a site is dead.
    """

    example: ClassVar[Mapping[str, Any]] = {"dead_fraction": 0.1}
    name: ClassVar[str] = "dead"
    stage: ClassVar[Stage] = "photo"
    is_defect: ClassVar[bool] = True
    needs_layout: ClassVar[bool] = False

    fraction: Annotated[float, FRACTION]

    def pattern(self, sites: Sites) -> Floats:
        """Return 0 for dead sites and 1 for others, (n,)."""
        return np.where(sites.device.uniforms(self.name) < self.fraction, 0.0, 1.0)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return the moments of a Bernoulli distribution."""
        return 1.0 - self.fraction, self.fraction * (1.0 - self.fraction)


@dataclass(frozen=True)
class DarkOffset(Declared, FixedOffset):
    """
    DSNU of EMVA 1288: Gaussian offsets, which correlated double sampling does not remove.

    Parameters
    ----------
    dsnu_e : float, e-
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"dsnu_e": 50.0}
    name: ClassVar[str] = "dark_offset"
    stage: ClassVar[Stage] = "charge"
    needs_layout: ClassVar[bool] = False

    dsnu_e: Annotated[float, NOT_NEGATIVE]

    def pattern(self, sites: Sites) -> Floats:
        """Return the offsets, (n,) e-."""
        return self.dsnu_e * sites.device.normals(self.name)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 0 and the square of ``dsnu_e``."""
        return 0.0, self.dsnu_e**2


@dataclass(frozen=True)
class PixelOffset(Declared, FixedOffset):
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

    offset_v: Annotated[float, NOT_NEGATIVE]

    def pattern(self, sites: Sites) -> Floats:
        """Return the offsets, (n,) V."""
        return self.offset_v * sites.device.normals(self.name)

    def pattern_moments(self, sites: Sites) -> tuple[float, float]:
        """Return 0 and the square of ``offset_v``."""
        return 0.0, self.offset_v**2


class ColumnOffset(PixelOffset):
    """
    Column FPN: Gaussian offsets, the same for all sites of a readout line.

    Parameters
    ----------
    offset_v : float, V
        Standard deviation.
    """

    example: ClassVar[Mapping[str, Any]] = {"line_fpn_fraction": 1e-3}
    name: ClassVar[str] = "column_fpn"

    def pattern(self, sites: Sites) -> Floats:
        """Return the offset of each site's readout line, (n,) V."""
        lines, line_of_site = np.unique(sites.layout.readout_line, return_inverse=True)
        return (self.offset_v * sites.device.line_normals(self.name, lines))[line_of_site]
