"""
Test charts as scenes, in physical sizes.

Each function returns a :class:`foveasim.Scene`. The origin of a chart is the centre of the picture, x to the right, y up.
The value of a pixel is the *mean* of the ideal chart over its square, so that edges are anti-aliased and the total power is
correct. The documentation of each function states whether this mean is exact.

All functions have the parameters ``shape``, ``pitch_um``, ``distance_m``, ``wavelength_nm``, ``band_width_nm``, and
``radiance_w_m2_sr_nm`` of white, or ``luminance_cd_m2`` or ``illuminance_lux`` instead. ``contrast`` is the Michelson
contrast, (white - black) / (white + black): the radiance of white is fixed, and the radiance of black is the fraction
``(1 - contrast) / (1 + contrast)`` of it. A pattern with fewer than 2 pixels per period averages to grey and issues a
:class:`foveasim.errors.SamplingWarning`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.scene._illuminants import illuminant
from foveasim.scene._photometry import photopic
from foveasim.scene.charts._colours import PATCH_NAMES, patch_reflectance
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
    "photopic",
    "point_grid",
    "siemens_star",
    "sine",
    "slanted_edge",
    "zone_plate",
]

import_all(__name__, __path__)
# A chart takes precedence over a module of the same name.
globals().update(SCENES.within(__name__))
if not TYPE_CHECKING:  # charts of other packages and charts registered later
    __getattr__ = SCENES.attributes_of(__name__)

publish(__name__)
