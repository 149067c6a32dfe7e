"""
Projections of ideal images: image height as a function of the angle to the axis.

Directions are unit vectors (x, y, z): x to the right and y up, as in the upright image, z along the optical axis towards the
scene. Points are in focal lengths from the axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError

#: Projections of fisheye lenses.
FisheyeProjection = Literal["equidistant", "equisolid", "stereographic", "orthographic"]
#: Projections of ideal images.
ImageProjection = Literal["rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"]
#: Points within this normalised radius are scaled linearly, which avoids a division by 0.
MIN_RADIUS = 1e-12
#: Limits of directions of a camera.
MAX_AZIMUTH_DEG, MAX_ELEVATION_DEG = 360.0, 90.0


@dataclass(frozen=True)
class Law:
    """
    Image height ρ(θ) of a projection, in focal lengths.

    ``height``, ``angle_rad``: ρ(θ) and its inverse. ``solid_angle_sr``: solid angle per normalised area of the image as a
    function of the angle, ``sin θ / (ρ ρ')``. ``max_rad``: largest angle.
    """

    height: Callable[[Floats], Floats]
    angle_rad: Callable[[Floats], Floats]
    solid_angle_sr: Callable[[Floats], Floats]
    max_rad: float

    @property
    def max_height(self) -> float:
        """Image height at the largest angle, infinite if it grows without limit."""
        limit = float(self.height(np.array([self.max_rad]))[0])
        return limit if limit < 1.0 / MIN_RADIUS else math.inf

    def angles_rad(self, radius: Floats) -> Floats:
        """Return the angles to the axis at image heights; NaN beyond the image."""
        is_inside = radius <= self.max_height
        return np.where(is_inside, self.angle_rad(np.where(is_inside, radius, 0.0)), np.nan)

    def directions(self, xy: Floats) -> Floats:
        """Return the directions (n, 3) of points (n, 2) of the image; NaN beyond it."""
        radius = np.hypot(xy[:, 0], xy[:, 1])
        return directions_at(xy, radius, self.angles_rad(radius), 1.0)

    def points(self, directions: Floats) -> Floats:
        """Return the points (n, 2) of directions (n, 3) in the image; NaN beyond it."""
        across, theta_rad = angles_of(directions)
        is_inside = theta_rad <= self.max_rad
        height = np.where(is_inside, self.height(np.where(is_inside, theta_rad, 0.0)), np.nan)
        height = np.where(height < 1.0 / MIN_RADIUS, height, np.nan)
        return points_at(directions, across, height, 1.0)


def angles_of(directions: Floats) -> tuple[Floats, Floats]:
    """Return the sine of directions (n, 3) from the optical axis and their angle to it, rad."""
    across = np.hypot(directions[:, 0], directions[:, 1])
    return across, np.arctan2(across, directions[:, 2])


def directions_at(xy: Floats, radius: Floats, theta_rad: Floats, slope: float) -> Floats:
    """
    Return the directions (n, 3) of points (n, 2) at angles to the axis.

    ``radius``: distance of the points from the axis; ``slope``: derivative of the angle with respect to it, at the axis.
    """
    is_central = radius < MIN_RADIUS
    across = np.where(is_central, slope, np.sin(theta_rad) / np.where(is_central, 1.0, radius))
    return np.stack((xy[:, 0] * across, xy[:, 1] * across, np.cos(theta_rad)), axis=1)


def points_at(directions: Floats, across: Floats, height: Floats, slope: float) -> Floats:
    """
    Return the points (n, 2) of directions (n, 3) at image heights.

    ``across``: their sine; ``slope``: derivative of the height with respect to the angle, at the axis. The direction
    opposite to the axis has no point, as it has no azimuth.
    """
    is_central = across < MIN_RADIUS
    central = np.where(directions[:, 2] > 0.0, slope, np.nan)
    scale = np.where(is_central, central, height / np.where(is_central, 1.0, across))
    return np.asarray(directions[:, :2] * scale[:, np.newaxis])


def check_direction(name: str, value: Any) -> tuple[float, float]:
    """Return an azimuth and an elevation in degrees after validation."""
    found = finite_array(name, value)
    if found.shape != (2,) or abs(found[0]) > MAX_AZIMUTH_DEG or abs(found[1]) > MAX_ELEVATION_DEG:
        raise ParameterError(
            name, "must be two numbers: the azimuth, within ±360, and the elevation, within ±90", value, "degrees"
        )
    return float(found[0]), float(found[1])


def turned(azimuth_rad: float, elevation_rad: float) -> Floats:
    """Return the rotation (3, 3) of a camera to the right, then upwards."""
    c, s = math.cos(azimuth_rad), math.sin(azimuth_rad)
    right = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    c, s = math.cos(elevation_rad), math.sin(elevation_rad)
    return right @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


#: Projections by name.
LAWS: dict[ImageProjection, Law] = {
    "rectilinear": Law(np.tan, np.arctan, lambda theta_rad: np.cos(theta_rad) ** 3, 0.5 * math.pi),
    "equidistant": Law(
        lambda theta_rad: theta_rad,
        lambda height: height,
        lambda theta_rad: np.sinc(theta_rad / math.pi),
        math.pi,
    ),
    "equisolid": Law(
        lambda theta_rad: 2.0 * np.sin(0.5 * theta_rad),
        lambda height: 2.0 * np.arcsin(0.5 * height),
        np.ones_like,
        math.pi,
    ),
    "stereographic": Law(
        lambda theta_rad: 2.0 * np.tan(0.5 * theta_rad),
        lambda height: 2.0 * np.arctan(0.5 * height),
        lambda theta_rad: np.cos(0.5 * theta_rad) ** 4,
        math.pi,
    ),
    "orthographic": Law(np.sin, np.arcsin, lambda theta_rad: 1.0 / np.cos(theta_rad), 0.5 * math.pi),
}
