"""
Pixel optics: openings, layers and microlenses above photodiodes, one frozen class each.

Further kinds derive from :class:`PixelOptics`. They are passed to a sensor as ``pixel_optics=...``, or specified in settings
files by their names in :data:`PIXEL_OPTICS`.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.fields import Outlines
from foveasim.sensor.pixel_optics.aperture_stack import ApertureStack
from foveasim.sensor.pixel_optics.contract import PIXEL_OPTICS, Footprints, PixelOptics
from foveasim.sensor.pixel_optics.microlens import Microlens

__all__ = ["PIXEL_OPTICS", "ApertureStack", "Footprints", "Microlens", "Outlines", "PixelOptics"]

import_all(__name__, __path__)

publish(__name__)
