"""Lenses whose ideal image has another projection than the rectilinear one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.rings import from_frame, to_frame
from foveasim._core.validation import Floats, finite_array
from foveasim._projections import LAWS, ImageProjection
from foveasim.distortion._lens import Lens, LensBase, Outside
from foveasim.errors import GeometryError

#: Largest angles of images: a rectilinear image beyond 80° consists of almost empty cells, near their largest angle
#: orthographic and stereographic images are compressed, or stretched, without limit.
MAX_CHOICE_DEG: dict[ImageProjection, float] = {
    "rectilinear": 80.0,
    "equidistant": 180.0,
    "equisolid": 178.0,
    "stereographic": 160.0,
    "orthographic": 80.0,
}
#: Number of angles at which projections are compared with a lens.
N_ANGLES = 64


class ProjectedLens:
    """
    Lens model with ideal positions in the image plane of a projection.

    ``distort`` and ``undistort`` map between this plane and the sensor, as those of a lens model do for a rectilinear image.
    Beyond 90° they require a model with ``direction`` and ``project``, such as those of :class:`LensBase`.
    """

    #: Largest deviation of edges from chords, in cells. The area of a site of ten cells is then accurate to 4e-6.
    chord_tolerance = 3e-5

    def __init__(self, lens: Lens, projection: ImageProjection) -> None:
        self._lens, self._law = lens, LAWS[projection]
        self.focal_um, self.centre_um = lens.focal_um, lens.centre_um

    def _frame(self) -> tuple[Floats, Floats]:
        return np.asarray(self.centre_um), np.broadcast_to(np.asarray(self.focal_um), (2,))

    def distort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """Return real positions, (..., 2) µm, of points of the image."""
        points = finite_array("xy_um", xy_um)
        directions = self._law.directions(to_frame(points.reshape(-1, 2), *self._frame()))
        is_inside = ~np.isnan(directions[:, 2])
        found = np.full((is_inside.size, 2), np.nan)
        found[is_inside] = projected(self._lens, directions[is_inside])
        return _checked(found, outside).reshape(points.shape)

    def undistort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """Return points of the image, (..., 2) µm, of real positions."""
        points = finite_array("xy_um", xy_um)
        found = self._law.points(directions_of(self._lens, points.reshape(-1, 2)))
        return _checked(from_frame(found, *self._frame()), outside).reshape(points.shape)


def _checked(xy_um: Floats, outside: Outside) -> Floats:
    if outside == "error" and np.isnan(xy_um).any():
        n = int(np.isnan(xy_um[:, 0]).sum())
        raise GeometryError(f"{n} points lie outside the field of the lens or of the image; use outside='mask'")
    return xy_um


def directions_of(lens: Any, xy_um: Floats) -> Floats:
    """Return the directions (n, 3) of points (n, 2) of the sensor; NaN beyond the model."""
    if hasattr(lens, "direction"):
        return np.asarray(lens.direction(xy_um, outside="mask"))
    frame = np.asarray(lens.centre_um), np.broadcast_to(np.asarray(lens.focal_um), (2,))
    ideal = np.pad(to_frame(lens.undistort(xy_um, outside="mask"), *frame), ((0, 0), (0, 1)), constant_values=1.0)
    return np.asarray(ideal / np.sqrt(np.square(ideal).sum(axis=1, keepdims=True)))


def projected(lens: Any, directions: Floats) -> Floats:
    """Return the points (n, 2), µm, of directions (n, 3) on the sensor; NaN beyond the model."""
    if hasattr(lens, "project"):
        return np.asarray(lens.project(directions, outside="mask"))
    frame = np.asarray(lens.centre_um), np.broadcast_to(np.asarray(lens.focal_um), (2,))
    ideal = LAWS["rectilinear"].points(directions)
    found = lens.distort(from_frame(np.nan_to_num(ideal), *frame), outside="mask")
    return np.where(np.isnan(ideal), np.nan, found)


def max_angle_rad(lens: Lens, bounds_um: Floats) -> float:
    """
    Return the largest angle of a ray to the axis within bounds (4,) µm of the sensor.

    It is that of the model if the bounds exceed its image circle.
    """
    x0_um, y0_um, x1_um, y1_um = bounds_um
    along = np.linspace(0.0, 1.0, N_ANGLES)
    x_um, y_um = x0_um + along * (x1_um - x0_um), y0_um + along * (y1_um - y0_um)
    edges = [np.stack((x_um, np.full(N_ANGLES, at_um)), axis=1) for at_um in (y0_um, y1_um)]
    edges += [np.stack((np.full(N_ANGLES, at_um), y_um), axis=1) for at_um in (x0_um, x1_um)]
    z = directions_of(lens, np.concatenate(edges))[:, 2]
    if np.isnan(z).any() and isinstance(lens, LensBase):
        return math.radians(lens.max_angle_deg)
    return float(np.arccos(np.clip(np.nanmin(z), -1.0, 1.0))) if not np.isnan(z).all() else 0.5 * math.pi


def nearest_projection(lens: Lens, max_rad: float) -> ImageProjection:
    """
    Return the projection that displaces image points least, up to an angle to the axis.

    Outlines of photosites then change little between the sensor and the image, and so does the PSF.
    """
    theta_rad = max_rad * (np.arange(N_ANGLES) + 0.5) / N_ANGLES
    directions = np.stack((np.sin(theta_rad), np.zeros(N_ANGLES), np.cos(theta_rad)), axis=1)
    frame = np.asarray(lens.centre_um), np.broadcast_to(np.asarray(lens.focal_um), (2,))
    height = to_frame(projected(lens, directions), *frame)[:, 0]
    possible = [name for name, limit_deg in MAX_CHOICE_DEG.items() if max_rad <= math.radians(limit_deg)]
    difference = {name: np.nanmax(np.abs(LAWS[name].height(theta_rad) - height)) for name in possible}
    return min(possible, key=lambda name: difference[name])
