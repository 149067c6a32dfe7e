"""Framing: pitch and optical axis of a scene with ``fit``, for one or several cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from foveasim._core.provenance import to_plain_data
from foveasim._core.validation import Floats
from foveasim._projections import LAWS, ImageProjection
from foveasim.camera._frames import Position
from foveasim.camera._steps import SensorFrame
from foveasim.camera._warnings import format_point, size_um
from foveasim.distortion import Lens
from foveasim.distortion._projected import directions_of
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.scene._panorama import Panorama
from foveasim.units import um_from_m

if TYPE_CHECKING:
    from foveasim.camera._camera import Camera

#: Distance of the centre of a layout from its origin, relative to its size, that counts as rounding.
CENTRE_ROUNDING = 1e-9
#: Margin of a picture that covers undistorted outlines: their edges are curves of limited accuracy.
COVER_MARGIN = 1e-5
#: Cells of the image of a panorama beyond the outlines of the photosites.
MARGIN_CELLS = 4


def axis_of(bounds_um: Floats) -> Position:
    """
    Return the optical axis of a framed scene without a lens model, (x, y) µm.

    It is the centre of the bounding box (4,) µm.
    """
    centre_um = 0.5 * (bounds_um[:2] + bounds_um[2:])
    is_centred = np.abs(centre_um) <= CENTRE_ROUNDING * (bounds_um[2:] - bounds_um[:2])
    x_um, y_um = np.where(is_centred, 0.0, centre_um).tolist()
    return x_um, y_um


def different_part(one: Camera, other: Camera) -> str:
    """Return the part in which two cameras differ: ``"optics"``, ``"distortion"`` or ``""``."""
    for part in ("optics", "distortion"):
        part_of_one, part_of_other = getattr(one, part), getattr(other, part)
        if part_of_one is not part_of_other and to_plain_data(part_of_one) != to_plain_data(part_of_other):
            return part
    return ""


def turned_instead(camera: Camera, light: Scene | PowerMap) -> tuple[Camera, Scene | PowerMap]:
    """
    Return a camera that looks ahead, and a panorama that is turned instead.

    The camera then sees power maps of the panorama, and what :meth:`Camera.fit_scene` returns. Planes and power maps are
    returned as they are; ParameterError is raised for a ``gaze_deg`` towards them.
    """
    if isinstance(light, Scene) and light.panorama is not None:
        seen_deg = camera.seen_panorama(light).gaze_deg
        ahead = (0.0, 0.0)
        return camera.with_gaze(ahead if camera.axis == "sensor" else None, gaze_deg=ahead), light.turned(
            gaze_deg=seen_deg
        )
    if any(camera.gaze_deg):
        camera.light_at_gaze(light)  # raises the error
    return camera, light


def common_bounds_um(cameras: Sequence[Camera], fit: str, projection: ImageProjection = "rectilinear") -> Floats:
    """
    Return the bounds of the undistorted outlines of all cameras in an image, (4,) µm.

    Raises ParameterError when lenses differ, or when no camera has photosites in the image circle.
    """
    first, *others = cameras
    for camera in others:
        if part := different_part(first, camera):
            raise ParameterError("others", f"must be cameras with the same {part}")
    bounds_um = np.array([camera.bounds_in_um(projection) for camera in cameras])
    known_um = bounds_um[~np.isnan(bounds_um).any(axis=1)]
    if not known_um.size:
        required = "photosites in the image circle" if any(c.layout.n_sites for c in cameras) else "photosites"
        raise ParameterError("fit", f"must be used with a layout that has {required}", fit)
    return np.concatenate((known_um[:, :2].min(axis=0), known_um[:, 2:].max(axis=0)))


def fit_scene(scene: Scene, optics: Optics, lens: Lens | None, bounds_um: Floats) -> Scene:
    """
    Return a scene with the pitch and the optical axis that fit it to a field.

    ``bounds_um``: bounds of the field, (4,). See :meth:`foveasim.Camera.fit_scene`.
    """
    fit, frame = scene.fit, SensorFrame.of(lens, axis_of(bounds_um))
    axis_um, range_um = np.array(frame.axis_um), np.array(scene.gaze_range_um)
    below_um, above_um = axis_um - bounds_um[:2] + range_um, bounds_um[2:] - axis_um + range_um
    # The size of the image is proportional to the pitch. With this pitch, the pixels of the image are about 1 µm wide.
    unit_um = 1.0 / optics.magnification(scene.distance_m)
    trial = scene.framed(unit_um, frame.axis_um)
    images = [optics.grid(trial)] if fit == "width" else [grid for grid, _ in optics.image_grids(trial)]
    half_um = 0.5 * np.array([size_um(frame.image(grid).bounds_um) for grid in images])
    if fit == "width":
        scale = 0.5 * (below_um + above_um)[0] / half_um[0, 0]
    elif fit == "cover":
        margin = 0.0 if lens is None else COVER_MARGIN
        scale = (1.0 + margin) * (np.maximum(below_um, above_um) / half_um.min(axis=0)).max()
    else:
        scale = (np.minimum(below_um, above_um) / half_um.max(axis=0)).min()
        if not scale > 0.0:
            raise ParameterError(
                "fit",
                f"must not be 'contain' with the optical axis, at {format_point(axis_um)} µm, outside the layout, which "
                f"extends from {format_point(bounds_um[:2])} to {format_point(bounds_um[2:])} µm; use 'cover' or "
                "'width', or move the layout",
            )
    return scene.framed(float(scale) * unit_um, frame.axis_um)


class Turn(NamedTuple):
    """
    Gaze of a camera that turns.

    ``gaze_um`` is a point of the sensor, ``gaze_deg`` azimuth and elevation. At most one of them differs from (0, 0).
    """

    gaze_um: Position = (0.0, 0.0)
    gaze_deg: tuple[float, float] = (0.0, 0.0)


def fit_panorama(
    scene: Scene,
    optics: Optics,
    lens: Lens | None,
    bounds_um: Floats,
    projection: ImageProjection,
    turn: Turn | None,
    n_threads: int,
) -> Scene:
    """
    Return the image of a panorama in a projection, as a scene of its cells.

    ``bounds_um``: bounds of the field, (4,), in the image; its cells extend a few cells beyond. ``turn``: gaze of the camera,
    or None for the geometry only, with cells that are 0.
    """
    panorama = scene.panorama
    assert panorama is not None
    law, frame = LAWS[projection], SensorFrame.of(lens, axis_of(bounds_um))
    axis_um, distance_um = np.array(frame.axis_um), float(um_from_m(scene.distance_m))
    focal_um = optics.magnification(scene.distance_m) * distance_um
    reach_um = np.maximum(axis_um - bounds_um[:2], bounds_um[2:] - axis_um) + np.array(scene.gaze_range_um)
    # In focal lengths, along the axes of the optics. Images of other colours may be smaller.
    reach = reach_um / frame.scale / focal_um
    if optics.lateral_colour is not None:
        reach = reach / min(float(optics.lateral_colour.at(scene.wavelength_nm).min()), 1.0)
    reach = np.minimum(reach, law.max_height)
    n_along = panorama.n_cells(scene.basis.shape[1:], 2.0 * float(reach.max()))
    pitch = 2.0 * float(reach.max()) / n_along
    n_x, n_y = (2 * (math.ceil(0.5 * each) + MARGIN_CELLS) for each in 2.0 * reach / pitch - CENTRE_ROUNDING)
    if turn is None:
        cells = np.broadcast_to(np.float32(0.0), (scene.basis.shape[0], n_y, n_x))
    else:
        seen = turned_panorama(panorama, lens, projection, axis_um, focal_um, turn)
        cells = seen.cell_means(scene.basis, projection, (n_y, n_x), pitch, n_threads)
    return scene.resampled(cells, pitch * distance_um, frame.axis_um, projection)


def turned_panorama(
    panorama: Panorama, lens: Lens | None, projection: ImageProjection, axis_um: Floats, focal_um: float, turn: Turn
) -> Panorama:
    """Return a panorama as a camera sees it at its gaze."""
    if any(turn.gaze_um):
        return panorama.towards(_gaze_direction(lens, projection, axis_um, focal_um, turn.gaze_um))
    return replace(panorama, gaze_deg=turn.gaze_deg) if panorama.gaze_deg is None else panorama


def _gaze_direction(
    lens: Lens | None, projection: ImageProjection, axis_um: Floats, focal_um: float, gaze_um: Position
) -> Floats:
    """Return the direction (3,) of a gaze from the axis."""
    at_um = np.array([gaze_um])
    found = LAWS[projection].directions(at_um / focal_um) if lens is None else directions_of(lens, axis_um + at_um)
    if np.isnan(found).any():
        raise ParameterError("gaze_um", "must be within the field of the lens", gaze_um, "µm")
    return np.asarray(found[0])
