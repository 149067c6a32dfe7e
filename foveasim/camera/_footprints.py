"""Light that photosites collect through pixel optics, shared by the camera and its tiles."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.caches import BoundedCache
from foveasim._core.validation import read_only
from foveasim.camera._steps import SensorFrame
from foveasim.camera._warnings import warn_of_oblique_rays, warn_of_small_openings
from foveasim.fields import PackedRings, PowerMap
from foveasim.incidence import Incidence
from foveasim.layout.model import Layout, layout_of
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor.pixel_optics.contract import Footprints, PixelOptics, check_footprints

if TYPE_CHECKING:
    from foveasim.camera._camera import Camera
    from foveasim.camera._frames import Position

#: Number of cached footprints: one per lens, distance and gaze.
MAX_FOOTPRINTS = 4


class FootprintCache:
    """Recent footprints of a layout, shared by cameras with this layout."""

    def __init__(self) -> None:
        self._found = BoundedCache(MAX_FOOTPRINTS)
        self._openings_um = BoundedCache(MAX_FOOTPRINTS)

    def get(
        self, pixel_optics: PixelOptics, layout: Layout, optics: Optics, incidence: Incidence, axis_um: Any
    ) -> Footprints:
        """Return the footprints of a layout for the cones of a lens."""
        cone = incidence.radius, incidence.exit_pupil_um, incidence.table, incidence.displacement_um, tuple(axis_um)
        key = id(pixel_optics), id(optics.pupil), cone
        owner = pixel_optics, optics.pupil
        found: Footprints = self._found.get(key, lambda: check_footprints(pixel_optics, layout, incidence), owner=owner)
        return found

    def opening_um(self, pixel_optics: PixelOptics, layout: Layout) -> float:
        """Return the narrowest opening of the pixel optics on a layout, in its layer."""
        compute = partial(pixel_optics.optical_opening_um, layout)
        return float(self._openings_um.get(id(pixel_optics), compute, owner=pixel_optics))


def find_footprints(
    camera: Camera,
    layout: Layout,
    pixel_optics: PixelOptics | None,
    light: Scene | PowerMap,
    position_um: Position,
    cache: FootprintCache | None = None,
) -> Footprints | None:
    """
    Return the light that the sites of a layout collect; None without pixel optics.

    ``position_um``: that of the layout in the image. ``layout``: photosites in the frame of the sensor. ``light``: a scene with
    its pitch, or a power map.
    """
    if pixel_optics is None:
        return None
    incidence, axis_um = find_incidence(camera, layout, light, position_um)
    cache = FootprintCache() if cache is None else cache
    warn_of_oblique_rays(incidence, camera._warned)
    warn_of_small_openings(cache.opening_um(pixel_optics, layout), light)
    return cache.get(pixel_optics, layout, camera.optics, incidence, axis_um)


def find_incidence(
    camera: Camera, layout: Layout, light: Scene | PowerMap, position_um: Position
) -> tuple[Incidence, tuple[float, float]]:
    """Return the cones of light at the sites, and the position of the optical axis, µm."""
    frame = camera.sensor_frame(light) if isinstance(light, Scene) else SensorFrame.of(camera.distortion)
    distance_m = light.distance_m if isinstance(light, Scene) else None
    none = np.zeros((0, 2))
    cones = camera.optics.incidence(none, distance_m, displacement_um=position_um)
    if layout.lattice is None:
        return cones.at(read_only(layout.centroid_um - np.array(frame.axis_um))), frame.axis_um
    axes = zip((layout.lattice.x_um, layout.lattice.y_um), frame.axis_um, strict=True)
    return cones.on_axes(*(0.5 * axis.sum(axis=1) - origin for axis, origin in axes)), frame.axis_um


def placed(layout: Layout, footprints: Footprints | None, position_um: Position) -> Layout:
    """Return the outlines for integration, at a position in the image."""
    outlines: PackedRings | None = None if footprints is None else footprints.outlines
    if outlines is not None:
        xy_um = outlines.xy_um + np.array(position_um) if any(position_um) else outlines.xy_um
        return layout_of(xy_um, outlines.ring_offsets, outlines.site_offsets)
    return layout.translate(*position_um) if any(position_um) else layout
