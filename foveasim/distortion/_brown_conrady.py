"""Brown-Conrady model: radial and tangential distortion of a nearly ideal lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from foveasim._core.calls import FINITE, Limits, OwnCheck
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Bools, Floats
from foveasim.distortion._lens import LensBase
from foveasim.distortion._registry import LENSES
from foveasim.distortion._solve import smallest_roots

#: Number of directions in which the fold radius is computed.
N_DIRECTIONS = 720
#: Points per work item of a thread.
POINTS_PER_PIECE = 50_000
#: Size of the table of start values for the inverse.
START_POINTS = 4097
#: Tilts of a sensor.
TILT = Limits(at_least=-1.5, at_most=1.5, hint="tilts are in rad")
#: Largest radius of the table of start values, in focal lengths: 89.4 degrees from the axis.
MAX_RADIUS = 100.0


@LENSES.register(
    "brown_conrady", example={"focal_um": 60.0, "k1": -0.2, "k2": 0.05}, expected={(6.0, 0.0): (5.98803, 0.0)}
)
@dataclass(frozen=True, kw_only=True)
class BrownConrady(LensBase):
    """
    Radial and tangential distortion, with thin prisms and a tilted sensor.

    The model of Brown (1966), Eq. 6 of the paper; equal to OpenCV's model with up to fourteen coefficients.

    Parameters
    ----------
    focal_um : float or (x, y), µm
        Distance of the image plane, by which positions are normalised. Two values if the calibration has one per axis.
    k1, k2, k3 : float
        Radial coefficients of the numerator ``1 + k1 r² + k2 r⁴ + k3 r⁶``.
    k4, k5, k6 : float
        Radial coefficients of the denominator ``1 + k4 r² + k5 r⁴ + k6 r⁶`` of the rational model.
    p1, p2 : float
        Tangential coefficients for y pointing **up**: the paper's r1 and r2. OpenCV's p1, for y pointing down, has the
        opposite sign.
    s1, s2, s3, s4 : float
        Coefficients of thin prisms along x (s1, s2) and y (s3, s4), for y pointing up: those of OpenCV with the opposite signs
        of s3 and s4.
    tau_x_rad, tau_y_rad : float, rad
        Tilt of the sensor about x and y (Scheimpflug), for y pointing up: OpenCV's τx has the opposite sign.
    centre_um : (x, y), µm
        Intersection of the optical axis with the sensor plane.

    Raises
    ------
    ParameterError
        If a parameter is not finite or the focal length is not positive.

    Notes
    -----
    With the ideal position (x, y), its radius r and the radial factor R, all normalised by the focal length::

        x_d = x R + 2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴
        y_d = y R + 2 p2 x y + p1 (r² + 2 y²) + s3 r² + s4 r⁴

    A tilted sensor maps these points by the homography of Louhichi et al. (2007), as OpenCV does. The model is invertible up to
    its fold, where the determinant of the Jacobian is 0. The inverse uses Newton's method.

    Examples
    --------
    >>> barrel = BrownConrady(focal_um=1000.0, k1=-0.1)
    >>> barrel.distort([[500.0, 0.0]]).tolist()
    [[487.5, 0.0]]
    >>> round(barrel.max_radius_um[0], 3)
    1825.742
    """

    focal_um: OwnCheck[float | tuple[float, float]]
    k1: Annotated[float, FINITE] = 0.0
    k2: Annotated[float, FINITE] = 0.0
    k3: Annotated[float, FINITE] = 0.0
    k4: Annotated[float, FINITE] = 0.0
    k5: Annotated[float, FINITE] = 0.0
    k6: Annotated[float, FINITE] = 0.0
    p1: Annotated[float, FINITE] = 0.0
    p2: Annotated[float, FINITE] = 0.0
    s1: Annotated[float, FINITE] = 0.0
    s2: Annotated[float, FINITE] = 0.0
    s3: Annotated[float, FINITE] = 0.0
    s4: Annotated[float, FINITE] = 0.0
    tau_x_rad: Annotated[float, TILT] = 0.0
    tau_y_rad: Annotated[float, TILT] = 0.0
    centre_um: tuple[float, float] = (0.0, 0.0)

    __repr__ = short_repr

    def _radial(self, r2: Floats) -> tuple[Floats, Floats]:
        """Return the radial factor and its derivative with respect to r²."""
        above = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        below = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        above_slope = self.k1 + r2 * (2.0 * self.k2 + 3.0 * r2 * self.k3)
        below_slope = self.k4 + r2 * (2.0 * self.k5 + 3.0 * r2 * self.k6)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = above / below
            return factor, (above_slope - factor * below_slope) / below

    def _map(self, xy: Floats) -> Floats:
        flat = self._map_before_tilt(xy)
        return flat if self._tilt is None else _project(self._tilt, flat)

    def _map_before_tilt(self, xy: Floats) -> Floats:
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        factor, _ = self._radial(r2)
        return np.stack(
            (
                x * factor + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x) + r2 * (self.s1 + self.s2 * r2),
                y * factor + 2.0 * self.p2 * x * y + self.p1 * (r2 + 2.0 * y * y) + r2 * (self.s3 + self.s4 * r2),
            ),
            axis=1,
        )

    @cached_property
    def _tilt(self) -> Floats | None:
        """Homography of the tilted sensor, (3, 3); None without a tilt."""
        if self.tau_x_rad == self.tau_y_rad == 0.0:
            return None
        (c_x, s_x), (c_y, s_y) = ((math.cos(tau), math.sin(tau)) for tau in (self.tau_x_rad, self.tau_y_rad))
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, c_x, s_x], [0.0, -s_x, c_x]])
        turned = np.array([[c_y, 0.0, -s_y], [0.0, 1.0, 0.0], [s_y, 0.0, c_y]]) @ about_x
        to_sensor = np.array([[turned[2, 2], 0.0, -turned[0, 2]], [0.0, turned[2, 2], -turned[1, 2]], [0.0, 0.0, 1.0]])
        return to_sensor @ turned

    def _jacobian(self, xy: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the derivatives of x_d and y_d, before the tilt, with respect to x and y."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        factor, slope = self._radial(r2)
        across = 2.0 * (x * y * slope + self.p1 * x + self.p2 * y)
        prism_x, prism_y = 2.0 * (self.s1 + 2.0 * self.s2 * r2), 2.0 * (self.s3 + 2.0 * self.s4 * r2)
        return (
            factor + 2.0 * x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x + prism_x * x,
            across + prism_x * y,
            across + prism_y * x,
            factor + 2.0 * y * y * slope + 2.0 * self.p2 * x + 6.0 * self.p1 * y + prism_y * y,
        )

    def _determinant(self, xy: Floats) -> Floats:
        a, b, c, d = self._jacobian(xy)
        return np.asarray(a * d - b * c)

    @cached_property
    def _fold(self) -> Floats:
        """Smallest ideal radius with determinant 0 per direction; infinite without a fold."""
        if self.p1 == self.p2 == self.s1 == self.s2 == self.s3 == self.s4 == 0.0:
            return np.full(N_DIRECTIONS, self._radial_fold)
        # Along each direction the determinant times the fourth power of the denominator is a polynomial in the radius.
        c, s = directions().T[:, :, np.newaxis]
        above, below, r = self._parts()
        plain = above * below
        # Products of the square of the denominator with r dR/dr, with r, and (above) with R.
        slope = (r * (above.deriv() * below - above * below.deriv())).coef
        linear, cubic = (below * below * r).coef, (below * below * r**3).coef
        size = max(slope.size, cubic.size, plain.coef.size)
        slope, linear, cubic, base = (
            np.pad(part, (0, size - part.size)) for part in (slope, linear, cubic, plain.coef)
        )
        prism_x = 2.0 * self.s1 * linear + 4.0 * self.s2 * cubic
        prism_y = 2.0 * self.s3 * linear + 4.0 * self.s4 * cubic
        xx = base + c * c * slope + linear * (2.0 * self.p1 * s + 6.0 * self.p2 * c) + c * prism_x
        yy = base + s * s * slope + linear * (2.0 * self.p2 * c + 6.0 * self.p1 * s) + s * prism_y
        across = c * s * slope + linear * (2.0 * self.p1 * c + 2.0 * self.p2 * s)
        parts = zip(xx, yy, across + s * prism_x, across + c * prism_y, strict=True)
        product = [np.convolve(a, b) - np.convolve(d, e) for a, b, d, e in parts]
        return np.minimum(smallest_roots(np.array(product)), smallest_roots(below.coef)[0])

    def _parts(self) -> tuple[Any, Any, Any]:
        """Return numerator and denominator of R as polynomials in r, and the polynomial r."""
        polynomial = np.polynomial.Polynomial
        return (
            polynomial([1.0, 0.0, self.k1, 0.0, self.k2, 0.0, self.k3]),
            polynomial([1.0, 0.0, self.k4, 0.0, self.k5, 0.0, self.k6]),
            polynomial([0.0, 1.0]),
        )

    @cached_property
    def _radial_fold(self) -> float:
        """
        Fold radius without tangential terms.

        The smallest radius at which r R(r) stops increasing or R has a pole.
        """
        above, below, r = self._parts()
        growth = (above + r * above.deriv()) * below - r * above * below.deriv()
        return float(min(smallest_roots(p.coef)[0] for p in (growth, above, below)))

    def _limits(self) -> tuple[float, float]:
        ideal = min(float(self._fold.min()), self._horizon)
        if math.isinf(ideal):
            return math.inf, math.inf
        return ideal, float(np.nanmin(np.hypot(*self._map(ideal * directions()).T)))  # NaN at the horizon

    @cached_property
    def _horizon(self) -> float:
        """Smallest ideal radius whose image on a tilted sensor is infinitely far away."""
        if self._tilt is None:
            return math.inf
        from scipy.optimize import brentq  # its import is slow

        *slope, at_centre = self._tilt[2]

        def depth(radius: float) -> float:
            return float((self._map_before_tilt(radius * directions()) @ slope).min()) + float(at_centre)

        radii = np.geomspace(1e-3, min(float(self._fold.min()), MAX_RADIUS), N_DIRECTIONS)
        first = next((k for k, radius in enumerate(radii) if depth(radius) <= 0.0), 0)
        return float(brentq(depth, radii[first - 1], radii[first])) if first else math.inf

    def _is_inside(self, xy: Floats) -> Bools:
        """Return whether points lie within the fold."""
        direction = np.arctan2(xy[:, 1], xy[:, 0]) / (2.0 * math.pi) * N_DIRECTIONS
        low = np.floor(direction).astype(np.int64)
        # The fold is curved between two directions: compare with the larger radius, and check the determinant's sign.
        max_radius = np.maximum(self._fold[low % N_DIRECTIONS], self._fold[(low + 1) % N_DIRECTIONS])
        return np.asarray((np.hypot(xy[:, 0], xy[:, 1]) <= max_radius * (1.0 + 1e-3)) & (self._determinant(xy) > 0.0))

    def _forward(self, xy: Floats) -> Floats:
        return np.where(self._is_inside(xy)[:, np.newaxis], self._map(xy), np.nan)

    def _backward(self, xy: Floats) -> Floats:
        from foveasim.distortion import _kernels

        points = np.ascontiguousarray(xy if self._tilt is None else _project(np.linalg.inv(self._tilt), xy))
        k = np.array([self.k1, self.k2, self.k3, self.k4, self.k5, self.k6, self.s1, self.s2, self.s3, self.s4])
        inverse = _kernels.brown_conrady_inverse
        pieces = [points[i : i + POINTS_PER_PIECE] for i in range(0, max(len(points), 1), POINTS_PER_PIECE)]
        found = parallel_map(
            lambda p: inverse(p, k, self.p1, self.p2, self._fold, *self._start_radii), pieces, thread_count()
        )
        return np.concatenate(found) if len(found) > 1 else np.asarray(found[0])

    @cached_property
    def _start_radii(self) -> tuple[Floats, float]:
        """
        Table of start values for the inverse.

        Ideal radii at equally spaced distorted radii, without tangential terms, and the number of steps per distorted radius.
        """
        end = min(self._radial_fold, float(self._fold.max()), MAX_RADIUS)
        table = end * np.linspace(0.0, 1.0, START_POINTS)
        factor, _ = self._radial(table * table)
        reach = np.maximum.accumulate(table * factor)
        ideal = np.interp(reach[-1] * np.linspace(0.0, 1.0, START_POINTS), reach, table)
        return np.minimum(ideal, 0.98 * end), (START_POINTS - 1) / float(reach[-1])


def directions() -> Floats:
    """Return unit vectors in all directions, (N_DIRECTIONS, 2)."""
    angle_rad = 2.0 * math.pi * np.arange(N_DIRECTIONS) / N_DIRECTIONS
    return np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1)


def _project(homography: Floats, xy: Floats) -> Floats:
    """Return points (n, 2) after a homography (3, 3); NaN behind its horizon."""
    mapped = xy @ homography[:, :2].T + homography[:, 2]
    depth = np.where(mapped[:, 2] > 0.0, mapped[:, 2], np.nan)
    return np.asarray(mapped[:, :2] / depth[:, np.newaxis])
