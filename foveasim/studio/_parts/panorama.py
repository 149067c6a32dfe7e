"""Panorama with the field of the sensor at its gaze."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from foveasim._core.validation import Bools, Floats
from foveasim._projections import LAWS
from foveasim.camera import Camera
from foveasim.distortion._projected import projected
from foveasim.reconstruct import cells, raster_grid
from foveasim.scene import Scene
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.picture import pixels_of
from foveasim.studio._parts.registry import PartData, part
from foveasim.units import um_from_m

#: Rows of the preview, pixels of the field, and light outside the field.
N_Y, N_FIELD, OUTSIDE = 180, 256, 0.25
#: Fraction of the pixels that are not brighter than white.
WHITE_QUANTILE = 0.995


def _gaze_of(result: Simulated) -> tuple[Any, ...]:
    camera, source = result.shot.camera, result.shot.scene
    if not isinstance(source, Scene) or source.panorama is None:
        return (False,)
    numbers = (*camera.gaze_um, *camera.gaze_deg, camera.axis)
    return source, camera.layout, camera.optics, camera.distortion, numbers


@part("Panorama", _gaze_of, order=980, group="Explore", is_lazy=True)
def panorama(result: Simulated) -> PartData:
    """Return the panorama, 360° by 180°, darker outside the field of the sensor."""
    camera, scene = result.shot.camera, result.shot.scene
    if not isinstance(scene, Scene) or scene.panorama is None:
        return {"width": 0, "height": 0, "note": "The scene is not a panorama."}, {
            "rgba": np.zeros((0, 0, 4), np.uint8)
        }
    elevation, azimuth = np.meshgrid(
        ((np.arange(N_Y) + 0.5) / N_Y - 0.5) * math.pi,
        ((np.arange(2 * N_Y) + 0.5) / N_Y - 1.0) * math.pi,
        indexing="ij",
    )
    cosine = np.cos(elevation)
    directions = np.stack((cosine * np.sin(azimuth), np.sin(elevation), cosine * np.cos(azimuth)), axis=-1)
    directions = directions.reshape(-1, 3)
    shape = scene.basis.shape[1], scene.basis.shape[2]
    at = [
        np.clip(np.round(each).astype(np.int64), 0, n - 1)
        for each, n in zip(scene.panorama.pixels_at(directions, shape), shape, strict=True)
    ]
    colours = scene.basis if scene.is_rgb else scene.luminance_cd_m2[np.newaxis]
    light = np.asarray(colours[:, at[0], at[1]], np.float64)
    is_seen = _is_seen(camera, scene, directions @ camera.seen_panorama(scene).rotation)
    white = float(np.quantile(light, WHITE_QUANTILE)) or 1.0
    light = (light / white * np.where(is_seen, 1.0, OUTSIDE)).reshape(-1, N_Y, 2 * N_Y)
    about, arrays = pixels_of(light, np.ones((N_Y, 2 * N_Y), np.float32), (-180.0, -90.0, 180.0, 90.0))
    solid = cosine.ravel() / cosine.sum()
    covered = 100.0 * float(solid[is_seen].sum())
    return about | {"note": f"360° by 180°; the sensor covers {covered:.2g} % of all directions"}, arrays


def _is_seen(camera: Camera, scene: Scene, directions: Floats) -> Bools:
    """Return which directions (n, 3) in the frame of the camera the photosites cover."""
    frame = camera.sensor_frame(scene)
    if camera.distortion is None:
        focal_um = camera.optics.magnification(scene.distance_m) * float(um_from_m(scene.distance_m))
        at_um = LAWS[camera.projection(scene)].points(directions) * focal_um + frame.axis_um
    else:
        at_um = projected(camera.distortion, directions)
    grid = raster_grid(camera.layout, N_FIELD)
    coverage = cells(camera.layout, np.ones(camera.layout.n_sites), grid).coverage
    place: Floats = (at_um - camera.position_um - grid.origin_um) / grid.pitch_xy_um
    is_inside = np.asarray(((place >= 0.0) & (place < grid.shape[::-1])).all(axis=1))  # False for NaN
    column, row = np.where(is_inside[:, np.newaxis], place, 0.0).astype(np.int64).T
    return np.asarray(is_inside & (coverage[row, column] > 0.0))
