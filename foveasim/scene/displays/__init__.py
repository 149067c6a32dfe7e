"""Displays: their light for digital values, and the arrangement of their subpixels."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.scene.displays._bundled import lcd, oled
from foveasim.scene.displays._display import Display, Transfer, display_of
from foveasim.scene.displays._raster import Raster, raster_of

__all__ = ["Display", "Raster", "Transfer", "display_of", "lcd", "oled", "raster_of"]

publish(__name__)
