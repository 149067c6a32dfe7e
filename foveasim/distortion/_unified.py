"""Wide-angle lenses of computer vision: unified, double-sphere and field-of-view models."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from foveasim._core.calls import FINITE, Limits, OwnCheck
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats
from foveasim.distortion._brown_conrady import BrownConrady, directions
from foveasim.distortion._fisheye import ANGLE_MARGIN_RAD, _AngularLens
from foveasim.distortion._registry import LENSES

#: Margin below 180° in radians, where the sum of 1 and the cosine is not accurate.
BACK_MARGIN_RAD = 1e-6


def _with_margin(largest_rad: float) -> float:
    """Return an angle below the largest one, at which heights diverge or stop increasing."""
    return min(largest_rad - ANGLE_MARGIN_RAD, math.pi - BACK_MARGIN_RAD)


@LENSES.register(
    "omnidirectional",
    example={"xi": 1.0, "focal_um": 60.0},
    expected={(60.0, 0.0): (120.0 * math.tan(math.pi / 8.0), 0.0)},
)
@dataclass(frozen=True, kw_only=True)
class Omnidirectional(_AngularLens):
    """
    Unified omnidirectional model: a sphere, seen from a point on its axis.

    C. Mei and P. Rives, Single view point omnidirectional camera calibration from planar grids (2007); OpenCV's ``omnidir``,
    Kalibr's ``omni`` and the ``MEI`` of VINS.

    Parameters
    ----------
    xi : float
        Distance of the point from the centre of the sphere, in radii: 0 is a pinhole, 1 a stereographic projection.
    k1, k2, p1, p2 : float
        Radial and tangential coefficients of the distortion after the projection, p1 for y pointing up (see
        :class:`BrownConrady`).
    focal_um : float or (x, y), µm
        Focal length on the axis: the γ of these programs over 1 + ξ.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Notes
    -----
    A ray at the angle θ to the axis meets the plane of the distortion at ``sin θ / (ξ + cos θ)`` from the axis. Without
    distortion the image height is ``f (1 + ξ) sin θ / (ξ + cos θ)``.

    Examples
    --------
    The stereographic projection, 2 f tan(θ/2):

    >>> import foveasim as fs
    >>> lens = fs.distortion.Omnidirectional(xi=1.0, focal_um=1000.0)
    >>> lens.distort([[1000.0, 0.0]]).round(3).tolist()
    [[828.427, 0.0]]
    """

    xi: Annotated[float, Limits(at_least=0.0, at_most=100.0)]
    focal_um: OwnCheck[float | tuple[float, float]]
    k1: Annotated[float, FINITE] = 0.0
    k2: Annotated[float, FINITE] = 0.0
    p1: Annotated[float, FINITE] = 0.0
    p2: Annotated[float, FINITE] = 0.0
    centre_um: tuple[float, float] = (0.0, 0.0)

    def _height(self, theta_rad: Floats) -> Floats:
        return np.asarray((1.0 + self.xi) * np.sin(theta_rad) / (self.xi + np.cos(theta_rad)))

    def _theta_rad(self, height: Floats) -> Floats:
        # sin θ - u cos θ = u ξ, with u = height / (1 + ξ)
        u = height / (1.0 + self.xi)
        return np.asarray(np.arctan(u) + np.arcsin(np.clip(u * self.xi / np.hypot(1.0, u), -1.0, 1.0)))

    def _largest_rad(self) -> float:
        # The ray is parallel to the plane, or beyond ξ = 1 touches the sphere.
        return _with_margin(math.acos(-min(self.xi, 1.0 / self.xi) if self.xi > 0.0 else 0.0))

    @cached_property
    def _distortion(self) -> BrownConrady | None:
        """Distortion of the plane at unit distance."""
        if self.k1 == self.k2 == self.p1 == self.p2 == 0.0:
            return None
        return BrownConrady(focal_um=1.0, k1=self.k1, k2=self.k2, p1=self.p1, p2=self.p2)

    def _forward(self, xy: Floats) -> Floats:
        found = super()._forward(xy)
        if self._distortion is None:
            return found
        scale = 1.0 + self.xi
        return scale * self._distortion._forward(found / scale)  # noqa: SLF001 -- normalised points

    def _backward(self, xy: Floats) -> Floats:
        if self._distortion is None:
            return super()._backward(xy)
        scale = 1.0 + self.xi
        return super()._backward(scale * self._distortion._backward(xy / scale))  # noqa: SLF001 -- normalised points

    def _to_directions(self, xy: Floats) -> Floats:
        if self._distortion is None:
            return super()._to_directions(xy)
        scale = 1.0 + self.xi
        return super()._to_directions(scale * self._distortion._backward(xy / scale))  # noqa: SLF001 -- normalised points

    def _from_directions(self, directions: Floats) -> Floats:
        found = super()._from_directions(directions)
        if self._distortion is None:
            return found
        scale = 1.0 + self.xi
        return scale * self._distortion._forward(found / scale)  # noqa: SLF001 -- normalised points

    def _wide_limits(self) -> tuple[float, float]:
        largest_rad, height = super()._wide_limits()
        if self._distortion is None:
            return largest_rad, height
        scale = 1.0 + self.xi
        fold, real = self._distortion._limits()  # noqa: SLF001 -- normalised radii
        if scale * fold < height:
            return float(self._theta_rad(np.array([scale * fold]))[0]), scale * real
        boundary = height / scale * directions()
        return largest_rad, scale * float(np.hypot(*self._distortion._forward(boundary).T).min())  # noqa: SLF001

    def _limits(self) -> tuple[float, float]:
        ideal, height = super()._limits()
        if self._distortion is None:
            return ideal, height
        scale = 1.0 + self.xi
        fold, real = self._distortion._limits()  # noqa: SLF001 -- normalised radii
        if scale * fold < height:
            return math.tan(float(self._theta_rad(np.array([scale * fold]))[0])), scale * real
        boundary = height / scale * directions()
        return ideal, scale * float(np.hypot(*self._distortion._forward(boundary).T).min())  # noqa: SLF001


@LENSES.register(
    "extended_unified",
    example={"alpha": 0.5, "beta": 1.0, "focal_um": 60.0},
    expected={(60.0, 0.0): (120.0 * math.tan(math.pi / 8.0), 0.0)},
)
@dataclass(frozen=True, kw_only=True)
class ExtendedUnified(_AngularLens):
    """
    Extended unified camera model (EUCM): a quadric, seen from a point.

    B. Khomutenko, G. Garcia and P. Martinet, An enhanced unified camera model (2016).

    Parameters
    ----------
    alpha : float
        From 0, a pinhole, to 1.
    beta : float
        Shape of the quadric, 1 for a sphere.
    focal_um : float or (x, y), µm
        Focal length on the axis.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Notes
    -----
    A ray through (x, y, 1), with r² = x² + y², has the image height ``f r / (α sqrt(β r² + 1) + 1 - α)``.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.ExtendedUnified(alpha=0.5, beta=1.0, focal_um=1000.0)
    >>> lens.distort([[1000.0, 0.0]]).round(3).tolist()
    [[828.427, 0.0]]
    """

    alpha: Annotated[float, Limits(at_least=0.0, at_most=1.0)]
    beta: Annotated[float, Limits(above=0.0, at_most=100.0)]
    focal_um: OwnCheck[float | tuple[float, float]]
    centre_um: tuple[float, float] = (0.0, 0.0)

    def _height(self, theta_rad: Floats) -> Floats:
        sine, cosine = np.sin(theta_rad), np.cos(theta_rad)
        depth = self.alpha * np.sqrt(self.beta * sine**2 + cosine**2) + (1.0 - self.alpha) * cosine
        return np.asarray(sine / depth)

    def _theta_rad(self, height: Floats) -> Floats:
        a, b, h2 = self.alpha, self.beta, height**2
        root = np.sqrt(np.maximum(1.0 - (2.0 * a - 1.0) * b * h2, 0.0))
        depth = (1.0 - b * a**2 * h2) / (a * root + 1.0 - a)
        return np.asarray(np.arctan2(height, depth))

    def _largest_rad(self) -> float:
        ratio = self.alpha / (1.0 - self.alpha) if self.alpha <= 0.5 else (1.0 - self.alpha) / self.alpha
        depth = -ratio * math.sqrt(self.beta)
        return _with_margin(math.atan2(math.sqrt(max(1.0 - ratio * ratio, 0.0)), depth))


@LENSES.register(
    "double_sphere",
    example={"xi": 0.0, "alpha": 0.5, "focal_um": 60.0},
    expected={(60.0, 0.0): (120.0 * math.tan(math.pi / 8.0), 0.0)},
)
@dataclass(frozen=True, kw_only=True)
class DoubleSphere(_AngularLens):
    """
    Double-sphere model: projections on two spheres, then through a point.

    V. Usenko, N. Demmel and D. Cremers, The double sphere camera model (2018).

    Parameters
    ----------
    xi : float
        Distance between the centres of the spheres, in radii.
    alpha : float
        From 0 to 1, as in :class:`ExtendedUnified`.
    focal_um : float or (x, y), µm
        Focal length on the axis: that of these calibrations over 1 + ξ.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Notes
    -----
    A ray at the angle θ to the axis has the image height ``f (1 + ξ) sin θ / (α d + (1 - α) (ξ + cos θ))``, with the distance
    from the second centre ``d² = 1 + ξ² + 2 ξ cos θ``.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.DoubleSphere(xi=-0.2, alpha=0.6, focal_um=1000.0)
    >>> lens.distort([[1000.0, 0.0]]).round(1).tolist()
    [[780.3, 0.0]]
    """

    xi: Annotated[float, Limits(above=-1.0, at_most=1.0)]
    alpha: Annotated[float, Limits(at_least=0.0, at_most=1.0)]
    focal_um: OwnCheck[float | tuple[float, float]]
    centre_um: tuple[float, float] = (0.0, 0.0)

    def _height(self, theta_rad: Floats) -> Floats:
        cosine = np.cos(theta_rad)
        distance = np.sqrt(1.0 + self.xi**2 + 2.0 * self.xi * cosine)
        depth = self.alpha * distance + (1.0 - self.alpha) * (self.xi + cosine)
        return np.asarray((1.0 + self.xi) * np.sin(theta_rad) / depth)

    def _theta_rad(self, height: Floats) -> Floats:
        a, xi, r = self.alpha, self.xi, height / (1.0 + self.xi)
        root = np.sqrt(np.maximum(1.0 - (2.0 * a - 1.0) * r**2, 0.0))
        depth = (1.0 - a**2 * r**2) / (a * root + 1.0 - a)
        along = (depth * xi + np.sqrt(depth**2 + (1.0 - xi**2) * r**2)) / (depth**2 + r**2)
        return np.asarray(np.arctan2(along * r, along * depth - xi))

    def _largest_rad(self) -> float:
        ratio = self.alpha / (1.0 - self.alpha) if self.alpha <= 0.5 else (1.0 - self.alpha) / self.alpha
        highest = (ratio + self.xi) / math.sqrt(2.0 * ratio * self.xi + self.xi**2 + 1.0)
        return _with_margin(math.acos(max(-1.0, min(-highest, 1.0))))


@LENSES.register(
    "field_of_view",
    example={"w_rad": 0.9, "focal_um": 60.0},
    expected={(60.0, 0.0): (60.0 * math.atan(2.0 * math.tan(0.45)) / (2.0 * math.tan(0.45)), 0.0)},
)
@dataclass(frozen=True, kw_only=True)
class FieldOfView(_AngularLens):
    """
    Field-of-view model: image heights nearly proportional to the angle.

    F. Devernay and O. Faugeras, Straight lines have to be straight (2001).

    Parameters
    ----------
    w_rad : float, rad
        Angle w, which determines the strength of the distortion.
    focal_um : float or (x, y), µm
        Focal length on the axis: that of these calibrations times ``2 tan(w/2) / w``.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Notes
    -----
    The image height is ``f atan(2 tan(w/2) tan θ) / (2 tan(w/2))``.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.FieldOfView(w_rad=0.9, focal_um=1000.0)
    >>> lens.distort([[1000.0, 0.0]]).round(1).tolist()
    [[795.1, 0.0]]
    """

    w_rad: Annotated[float, Limits(above=0.0, at_most=3.1, hint="angles are in rad")]
    focal_um: OwnCheck[float | tuple[float, float]]
    centre_um: tuple[float, float] = (0.0, 0.0)

    @property
    def _strength(self) -> float:
        return 2.0 * math.tan(0.5 * self.w_rad)

    def _height(self, theta_rad: Floats) -> Floats:
        return np.asarray(np.arctan(self._strength * np.tan(theta_rad)) / self._strength)

    def _theta_rad(self, height: Floats) -> Floats:
        return np.asarray(np.arctan(np.tan(self._strength * height) / self._strength))

    def _largest_rad(self) -> float:
        return math.pi

    def _wide_height(self, theta_rad: Floats) -> Floats:
        return np.asarray(np.arctan2(self._strength * np.sin(theta_rad), np.cos(theta_rad)) / self._strength)

    def _wide_theta_rad(self, height: Floats) -> Floats:
        angle_rad = self._strength * height
        return np.asarray(np.arctan2(np.sin(angle_rad), self._strength * np.cos(angle_rad)))
