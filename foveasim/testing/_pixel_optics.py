"""Checks of pixel optics: responses, outlines, parts of a sensor, and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from foveasim._core.provenance import to_plain_data
from foveasim._core.rings import site_area_um2
from foveasim.layout import Layout, log_polar
from foveasim.optics import Optics
from foveasim.sensor import Sensor
from foveasim.sensor.pixel_optics import PIXEL_OPTICS, PixelOptics
from foveasim.sensor.pixel_optics.contract import check_footprints
from foveasim.testing._extension import Extension, check_of, require, shot_with

#: Tolerance of responses of parts and of areas, relative.
ROUNDING = 1e-9
#: Tolerance of the expected response, of a square of 10 µm on the axis at f/2.8.
EXPECTED_TOLERANCE = 2e-3


@check_of(PIXEL_OPTICS)
def check_pixel_optics(extension: Extension) -> None:
    """Check the light that sites collect through pixel optics."""
    optics = extension.make()
    require(isinstance(optics, PixelOptics), f"must return PixelOptics, got {type(optics).__name__}")
    extension.check_dataclass(optics)
    lens = Optics(focal_length_mm=8.0, f_number=2.8, exit_pupil_mm=0.5)
    layout = log_polar(n_sectors=24, r_min_um=20.0, r_max_um=90.0, n_rings=6)
    cones = lens.incidence(layout.centroid_um)
    found = check_footprints(optics, layout, cones)
    if found.outlines is not None:
        rings = found.outlines.xy_um, found.outlines.ring_offsets, found.outlines.site_offsets
        ratio = site_area_um2(*rings) / layout.area_um2
        require(
            np.allclose(found.area_ratio, ratio, rtol=ROUNDING),
            "must return the areas of its outlines over those of the sites as 'area_ratio'",
        )
    if not optics.has_mixing:
        chosen = np.arange(1, layout.n_sites, 3)
        part = optics.part(chosen).footprints(layout[chosen], cones.at(cones.field_um[chosen]))
        require(
            np.allclose(part.response, found.response[chosen], rtol=ROUNDING, atol=ROUNDING),
            "must give each site the response that it has in any part of a sensor; check footprints() and part()",
        )
    if extension.expected is not None:
        square = Layout.from_rectangles([[0.0, 0.0]], 10.0)
        on_axis = float(optics.footprints(square, lens.incidence([[0.0, 0.0]])).response[0])
        require(
            abs(on_axis - extension.expected) <= EXPECTED_TOLERANCE,
            f"has the response {on_axis:.4f} of a square of 10 µm on the axis, expected {extension.expected:.4f}",
        )
    shot = shot_with("sensor", {"pixel_optics": extension.settings})
    again = Sensor.from_settings(layout, to_plain_data(Sensor(layout, pixel_optics=optics)), {})
    for restored, where in ((shot.camera.sensor, "in settings files"), (again, "in the settings of a capture")):
        require(to_plain_data(restored.pixel_optics) == to_plain_data(optics), f"differs {where}")
    bare = shot.camera.replace(sensor=replace(shot.camera.sensor, pixel_optics=None))
    rate, all_light = (camera.photoelectrons_per_s(shot.scene) for camera in (shot.camera, bare))
    response = shot.camera.angular_response(shot.scene)
    require(
        np.allclose(rate, response * all_light, rtol=1e-3),
        "must collect its response from the uniform image of a flat scene; check 'outlines' and 'area_ratio'",
    )
