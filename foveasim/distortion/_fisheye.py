"""Fisheye lenses: image height as a function of the angle to the optical axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from foveasim._core.calls import POSITIVE, OwnCheck
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_number, finite_array
from foveasim._projections import LAWS, MIN_RADIUS, FisheyeProjection, angles_of, directions_at, points_at
from foveasim.distortion._lens import LensBase
from foveasim.distortion._registry import LENSES
from foveasim.distortion._solve import invert_monotonic, smallest_roots
from foveasim.errors import ParameterError

#: Largest image height of models without a fold, in focal lengths.
MAX_HEIGHT = 1e6
#: Largest number of coefficients of Scaramuzza's polynomial.
MAX_COEFFICIENTS = 10
#: Margin below 90° in radians, where the pinhole projection diverges.
ANGLE_MARGIN_RAD = 1e-9


class _AngularLens(LensBase):
    """Base of models with an image height that depends only on the angle θ to the axis."""

    def _height(self, theta_rad: Floats) -> Floats:
        raise NotImplementedError

    def _theta_rad(self, height: Floats) -> Floats:
        raise NotImplementedError

    def _largest_rad(self) -> float:
        """Return the largest angle to the axis, beyond 90° where the model allows it."""
        raise NotImplementedError

    def _wide_height(self, theta_rad: Floats) -> Floats:
        """Return the image height at angles that may exceed 90°."""
        return self._height(theta_rad)

    def _wide_theta_rad(self, height: Floats) -> Floats:
        """Return the angle at image heights that may lie beyond that of 90°."""
        return self._theta_rad(height)

    def _max_theta_rad(self) -> float:
        """Return the largest angle of points of a plane in front of the lens."""
        return min(self._largest_rad(), 0.5 * math.pi - ANGLE_MARGIN_RAD)

    def _limits(self) -> tuple[float, float]:
        max_rad = self._max_theta_rad()
        ideal = math.inf if max_rad >= 0.5 * math.pi - ANGLE_MARGIN_RAD else math.tan(max_rad)
        return ideal, self._max_image_height

    @cached_property
    def _max_image_height(self) -> float:
        """Image height at the largest angle."""
        return float(self._height(np.array([self._max_theta_rad()]))[0])

    def _forward(self, xy: Floats) -> Floats:
        radius = np.hypot(xy[:, 0], xy[:, 1])
        theta_rad = np.arctan(radius)
        is_inside = theta_rad <= self._max_theta_rad()
        height = self._height(np.where(is_inside, theta_rad, 0.0))
        return _scale_radially(xy, radius, np.where(is_inside, height, np.nan), float(self._slope()))

    def _backward(self, xy: Floats) -> Floats:
        radius = np.hypot(xy[:, 0], xy[:, 1])
        is_inside = radius <= self._max_image_height
        theta_rad = self._theta_rad(np.where(is_inside, radius, 0.0))
        return _scale_radially(xy, radius, np.where(is_inside, np.tan(theta_rad), np.nan), 1.0 / float(self._slope()))

    @cached_property
    def _largest_height(self) -> float:
        """Image height at the largest angle, beyond 90° where the model allows it."""
        return float(self._wide_height(np.array([self._largest_rad()]))[0])

    def _wide_limits(self) -> tuple[float, float]:
        return self._largest_rad(), self._largest_height

    def _to_directions(self, xy: Floats) -> Floats:
        radius = np.hypot(xy[:, 0], xy[:, 1])
        is_inside = radius <= self._largest_height
        theta_rad = self._wide_theta_rad(np.where(is_inside, radius, 0.0))
        return directions_at(xy, radius, np.where(is_inside, theta_rad, np.nan), 1.0 / float(self._slope()))

    def _from_directions(self, directions: Floats) -> Floats:
        across, theta_rad = angles_of(directions)
        is_inside = theta_rad <= self._largest_rad()
        height = self._wide_height(np.where(is_inside, theta_rad, 0.0))
        return points_at(directions, across, np.where(is_inside, height, np.nan), float(self._slope()))

    def _slope(self) -> float:
        """Return the derivative of the image height with respect to the angle at the axis."""
        return 1.0


def _scale_radially(xy: Floats, radius: Floats, new_radius: Floats, slope: float) -> Floats:
    """Move points radially to new radii."""
    is_central = radius < MIN_RADIUS
    scale = np.where(is_central, slope, new_radius / np.where(is_central, 1.0, radius))
    return np.asarray(xy * scale[:, np.newaxis])


@LENSES.register(
    "fisheye",
    example={"projection": "equidistant", "focal_um": 60.0},
    expected={(60.0, 0.0): (15.0 * math.pi, 0.0)},
)
@dataclass(frozen=True, kw_only=True)
class Fisheye(_AngularLens):
    """
    Fisheye lens with one of the classical projections.

    Parameters
    ----------
    projection : {"equidistant", "equisolid", "stereographic", "orthographic"}
        Image height f θ, 2 f sin(θ/2), 2 f tan(θ/2) or f sin θ for a ray at the angle θ to the axis.
    focal_um : float or (x, y), µm
        Distance of the image plane, f.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Raises
    ------
    ParameterError
        If a value is out of range or the projection is unknown.

    Notes
    -----
    Rays at less than 90° to the axis have the position f tan θ in the plane of :meth:`distort`. :meth:`direction` and
    :meth:`project` are valid up to 180°, with the orthographic projection up to 90°.

    Examples
    --------
    >>> lens = Fisheye(projection="equidistant", focal_um=1000.0)
    >>> lens.distort([[1000.0, 0.0]]).round(3).tolist()
    [[785.398, 0.0]]
    """

    projection: FisheyeProjection
    focal_um: OwnCheck[float | tuple[float, float]]
    centre_um: tuple[float, float] = (0.0, 0.0)

    def _height(self, theta_rad: Floats) -> Floats:
        return LAWS[self.projection].height(theta_rad)

    def _theta_rad(self, height: Floats) -> Floats:
        return LAWS[self.projection].angle_rad(height)

    def _largest_rad(self) -> float:
        law = LAWS[self.projection]
        return law.max_rad - (ANGLE_MARGIN_RAD if math.isinf(law.max_height) else 0.0)


@LENSES.register(
    "polynomial_fisheye",
    example={"k": [-0.1, 0.02, 0.0, 0.0], "focal_um": 60.0},
    expected={(0.0, 60.0): (0.0, 15.0 * math.pi * (1.0 - 0.1 * (math.pi / 4.0) ** 2 + 0.02 * (math.pi / 4.0) ** 4))},
)
@dataclass(frozen=True, kw_only=True)
class PolynomialFisheye(_AngularLens):
    """
    Fisheye lens with an odd polynomial of the angle as image height.

    OpenCV's ``fisheye`` model (Kannala and Brandt 2006).

    Parameters
    ----------
    k : (4,)
        ``height = f · (θ + k[0] θ³ + k[1] θ⁵ + k[2] θ⁷ + k[3] θ⁹)``.
    focal_um : float or (x, y), µm
        Distance of the image plane, f.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Notes
    -----
    The model is valid up to the angle at which the height stops increasing; :meth:`distort` and :meth:`undistort` up to 90°.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.PolynomialFisheye(
    ...     k=(0.0, 0.0, 0.0, 0.0), focal_um=2000.0
    ... )  # equidistant: r = f θ
    >>> lens.distort([[2000.0, 0.0]]).round(1).tolist()  # 45 degrees
    [[1570.8, 0.0]]
    """

    k: Sequence[float]
    focal_um: OwnCheck[float | tuple[float, float]]
    centre_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        k = finite_array("k", self.k, ndim=1)
        if k.shape != (4,):
            raise ParameterError("k", "must be four numbers", self.k)
        object.__setattr__(self, "k", tuple(k.tolist()))
        super().__post_init__()

    @cached_property
    def _series(self) -> np.polynomial.Polynomial:
        k = self.k
        return np.polynomial.Polynomial([0, 1, 0, k[0], 0, k[1], 0, k[2], 0, k[3]])

    @cached_property
    def _max_angle_rad(self) -> float:
        return self._max_theta_rad()

    @cached_property
    def _fold_rad(self) -> float:
        """Angle at which the height stops increasing, at most 180°."""
        return min(float(smallest_roots(self._series.deriv().coef)[0]), math.pi)

    def _largest_rad(self) -> float:
        return self._fold_rad

    def _wide_theta_rad(self, height: Floats) -> Floats:
        return invert_monotonic(self._series, self._series.deriv(), height, self._fold_rad)

    def _height(self, theta_rad: Floats) -> Floats:
        return np.asarray(self._series(theta_rad))

    def _theta_rad(self, height: Floats) -> Floats:
        return invert_monotonic(self._series, self._series.deriv(), height, self._max_angle_rad)


@LENSES.register(
    "scaramuzza",
    example={"a": [72.0, -0.004, 0.0, 0.0], "pixel_um": 1.0, "focal_um": 60.0},
    expected={(600.0 / 71.6, 0.0): (10.0, 0.0)},
)
@dataclass(frozen=True, kw_only=True)
class Scaramuzza(_AngularLens):
    """
    Scaramuzza's omnidirectional camera model, as fitted by OCamCalib and MATLAB.

    The direction of the ray through a pixel is a polynomial of the distance of the pixel from the centre.

    Parameters
    ----------
    a : (n,), pixels
        ``a0, a2, a3, ...`` of ``f(r) = a0 + a2 r² + a3 r³ + ...``, up to the tenth power, r in pixels: the ray of the pixel at
        (x, y) has the direction (x, y, f(r)). The signs of all coefficients are inverted if a0 is negative (axis pointing into
        the camera).
    pixel_um : float, µm
        Pixel size, the unit of the coefficients.
    focal_um : float, µm
        Distance of the ideal image plane behind the pupil. A value other than the focal length of the optics also scales the
        image.
    stretch : (2, 2)
        Matrix S of Eq. 8: distorted positions are S times the above positions, with x to the right and y up.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Raises
    ------
    ParameterError
        If a value is out of range, a0 is 0, or the determinant of the stretch matrix is not positive.

    Notes
    -----
    Equations 7 and 8 of the paper, with r̃ = sqrt(x̃² + ỹ²). The model is valid up to the radius r at which the angle stops
    increasing; :meth:`distort` and :meth:`undistort` for angles of less than 90°.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.Scaramuzza(
    ...     a=(700.0, -4e-4, 0.0, 0.0), pixel_um=3.0, focal_um=2100.0
    ... )
    >>> lens.distort([[900.0, 0.0]]).round(1).tolist()
    [[857.9, 0.0]]
    """

    a: Sequence[float]
    pixel_um: Annotated[float, POSITIVE]
    focal_um: OwnCheck[float]
    stretch: Sequence[Sequence[float]] = ((1.0, 0.0), (0.0, 1.0))
    centre_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        a = finite_array("a", self.a, ndim=1)
        if not 1 <= a.size <= MAX_COEFFICIENTS or a[0] == 0.0:
            rule = f"must be 1 to {MAX_COEFFICIENTS} numbers a0, a2, a3, ..., a0 not 0"
            raise ParameterError("a", rule, self.a)
        stretch = finite_array("stretch", self.stretch, ndim=2)
        if stretch.shape != (2, 2) or not np.linalg.det(stretch) > 0.0:
            raise ParameterError("stretch", "must be a 2 x 2 matrix with a positive determinant", self.stretch)
        object.__setattr__(self, "a", tuple((a * np.sign(a[0])).tolist()))
        object.__setattr__(self, "stretch", tuple(map(tuple, stretch.tolist())))
        object.__setattr__(
            self, "focal_um", check_number("focal_um", self.focal_um, hint="use 'stretch' for unequal axes")
        )
        super().__post_init__()

    @cached_property
    def _matrix(self) -> Floats:
        return np.array(self.stretch)

    @cached_property
    def _depth(self) -> np.polynomial.Polynomial:
        """Ray depth f(r) as a polynomial of the image height, both in focal lengths."""
        unit = self.pixel_um / self.focal_um
        first, *others = self.a
        return np.polynomial.Polynomial([first * unit, 0.0, *(a / unit**k for k, a in enumerate(others, 1))])

    @cached_property
    def _max_height(self) -> float:
        """Image height at the fold or at 90°, whichever is smaller."""
        return float(min(*smallest_roots(self._depth.coef), self._fold_height))

    @cached_property
    def _fold_height(self) -> float:
        """Image height at which the angle stops increasing."""
        growth = self._depth - np.polynomial.Polynomial([0.0, 1.0]) * self._depth.deriv()
        return float(smallest_roots(growth.coef)[0])

    def _limits(self) -> tuple[float, float]:
        # The stretched image circle is an ellipse: use the radius of its largest inscribed circle.
        ideal, height = super()._limits()
        return ideal, height * float(np.linalg.svd(self._matrix, compute_uv=False).min())

    def _slope(self) -> float:
        return 1.0 / float(self._depth.coef[0])

    def _largest_rad(self) -> float:
        height = min(self._fold_height, MAX_HEIGHT)
        angle_rad = float(self._angle_rad(np.array([height]))[0])
        # Without a fold, the angle approaches 90° (a pinhole) or 180°.
        return angle_rad if height < MAX_HEIGHT else max(angle_rad, 0.5 * math.pi - ANGLE_MARGIN_RAD)

    def _angle_rad(self, height: Floats) -> Floats:
        return np.asarray(np.arctan2(height, self._depth(height)))

    def _angle_slope(self, height: Floats) -> Floats:
        depth = self._depth(height)
        return np.asarray((depth - height * self._depth.deriv()(height)) / (depth**2 + height**2))

    def _theta_rad(self, height: Floats) -> Floats:
        return self._angle_rad(height)

    def _height(self, theta_rad: Floats) -> Floats:
        return self._height_up_to(self._max_height, theta_rad)

    def _wide_height(self, theta_rad: Floats) -> Floats:
        return self._height_up_to(self._fold_height, theta_rad)

    def _height_up_to(self, upper: float, theta_rad: Floats) -> Floats:
        if math.isinf(upper):  # without a limit, double until the height covers the largest angle
            upper = 1.0
            max_rad = float(np.max(theta_rad, initial=0.0))
            while float(self._angle_rad(np.array([upper]))[0]) < max_rad and upper < 1e12:
                upper *= 2.0
        return invert_monotonic(self._angle_rad, self._angle_slope, theta_rad, upper)

    def _forward(self, xy: Floats) -> Floats:
        return np.asarray(super()._forward(xy) @ self._matrix.T)

    def _backward(self, xy: Floats) -> Floats:
        return super()._backward(xy @ np.linalg.inv(self._matrix).T)

    def _wide_limits(self) -> tuple[float, float]:
        angle_rad, height = super()._wide_limits()
        return angle_rad, height * float(np.linalg.svd(self._matrix, compute_uv=False).min())

    def _to_directions(self, xy: Floats) -> Floats:
        return super()._to_directions(xy @ np.linalg.inv(self._matrix).T)

    def _from_directions(self, directions: Floats) -> Floats:
        return np.asarray(super()._from_directions(directions) @ self._matrix.T)
