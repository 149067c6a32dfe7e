"""
Test charts as scenes, in physical sizes.

Each function gives a :class:`foveasim.Scene`. The chart's origin is the middle of the picture, x to the right, y up. A pixel
has the *mean* of the ideal chart over its square, so that edges have no steps and the light is right; each function says
whether that mean is exact.

All take the picture's ``shape`` and ``pitch_um``, its ``distance_m``, the ``radiance_w_m2_sr_nm`` of white, ``wavelength_nm``
and ``band_width_nm``. ``contrast`` is Michelson's, (white - black) / (white + black), everywhere: white keeps its
radiance, and black has ``(1 - contrast) / (1 + contrast)`` of it. A pattern with less than 2 pixels a period is averaged
away, as on any print; then there is a :class:`foveasim.errors.SamplingWarning`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from foveasim._core.registry import import_all
from foveasim.scene.charts._colours import PATCH_NAMES, illuminant, patch_reflectance
from foveasim.scene.charts._edges import BarElement, bar_elements, bars, checkerboard, letter_f, slanted_edge
from foveasim.scene.charts._patches import colour_chart, grey_scale
from foveasim.scene.charts._points import point_grid
from foveasim.scene.charts._waves import siemens_star, sine, zone_plate
from foveasim.scene.registry import SCENES

__all__ = [
    "PATCH_NAMES",
    "BarElement",
    "bar_elements",
    "bars",
    "checkerboard",
    "colour_chart",
    "grey_scale",
    "illuminant",
    "letter_f",
    "patch_reflectance",
    "point_grid",
    "siemens_star",
    "sine",
    "slanted_edge",
    "zone_plate",
]

import_all(__name__, __path__)
# A chart comes before a module of its name.
globals().update(SCENES.within(__name__))
if not TYPE_CHECKING:  # charts of other packages, and new ones of this
    __getattr__ = SCENES.attributes_of(__name__)
