"""Lenses: from the radiance of a scene to the irradiance on the sensor plane."""

from __future__ import annotations

from foveasim.optics._optics import Optics
from foveasim.optics.otf import circular_otf

__all__ = ["Optics", "circular_otf"]
