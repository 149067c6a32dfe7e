"""
Cones of light at photosites: chief rays, exit pupils and tables of chief ray angles.

Directions are tangents: ``(t_x, t_y)`` is the lateral displacement of a ray per unit of depth, in its direction of propagation
and the frame of the sensor. A chief ray of an ordinary lens points away from the optical axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import Limits, OwnCheck, check_declared, publish
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, Ints, as_numbers, finite_array, frozen_array, read_only
from foveasim.errors import ParameterError

__all__ = ["ChiefRayTable", "Incidence"]

#: Image heights and angles of tables.
HEIGHT = Limits(at_least=0.0, at_most=1e7, hint="image heights are in µm")
ANGLE = Limits(at_least=-80.0, at_most=80.0, hint="chief ray angles are in degrees")
#: Largest tangent radius of a cone: that of f/0.5.
RADIUS = Limits(above=0.0, at_most=1.0)
#: Default number of rings of rays, for clear circular pupils and for others.
N_RINGS, N_RINGS_OF_PUPILS = 1, 8
#: Largest number of rings: 16,320 rays.
MAX_RINGS = 64
#: Image heights beyond a table by this fraction are rounding errors.
HEIGHT_ROUNDING = 1e-9


def check_heights(image_height_um: Sequence[float], name: str, values: Sequence[float]) -> None:
    """Check that the heights of a table ascend from 0, and that each has a value."""
    heights_um = np.asarray(image_height_um)
    if heights_um.size < 2 or heights_um[0] != 0.0 or not (np.diff(heights_um) > 0.0).all():
        raise ParameterError(
            "image_height_um", "must have at least two values that ascend from 0", list(image_height_um), "µm"
        )
    if len(values) != heights_um.size:
        raise ParameterError(name, f"must have one value for each of the {heights_um.size} heights, got {len(values)}")


@dataclass(frozen=True)
class ChiefRayTable:
    """
    Chief ray angles at image heights, as in data sheets of lenses and sensors.

    Parameters
    ----------
    image_height_um : sequence of float, µm
        Distances from the optical axis, ascending from 0.
    angle_deg : sequence of float, degrees
        Angle between chief ray and normal at each height, positive for rays that point away from the axis, 0 on the axis.

    Raises
    ------
    ParameterError
        When there are fewer than two heights, they do not ascend from 0, or the numbers of heights and angles differ.

    Notes
    -----
    The tangent of the angle is interpolated monotonically in the image height (F. N. Fritsch and J. Butland, A method for
    constructing local monotone piecewise cubic interpolants, SIAM J. Sci. Stat. Comput. 5, 300, 1984).

    Examples
    --------
    >>> table = ChiefRayTable(
    ...     image_height_um=(0.0, 1000.0, 2000.0), angle_deg=(0.0, 15.0, 25.0)
    ... )
    >>> table.tangents([[0.0, 1000.0]]).round(4).tolist()  # 15 degrees upwards
    [[0.0, 0.2679]]
    """

    image_height_um: Annotated[Sequence[float], HEIGHT]
    angle_deg: Annotated[Sequence[float], ANGLE]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        check_heights(self.image_height_um, "angle_deg", self.angle_deg)
        if self.angle_deg[0] != 0.0:
            raise ParameterError("angle_deg", "must be 0 on the axis", self.angle_deg[0], "degrees")

    def tangents(self, field_um: ArrayLike) -> Floats:
        """
        Interpolate the chief rays at positions relative to the optical axis.

        Parameters
        ----------
        field_um : (n, 2) float64, µm

        Returns
        -------
        tangents : (n, 2) float64

        Raises
        ------
        ParameterError
            When a position is beyond the last height of the table.
        """
        field_um = finite_array("field_um", field_um, ndim=2)
        height_um, last_um = np.hypot(field_um[:, 0], field_um[:, 1]), self.image_height_um[-1]
        if not self.covers(field_um).all():
            raise ParameterError(
                "image_height_um",
                f"must extend to {height_um.max():.6g} µm, the largest distance of a site",
                last_um,
                "µm",
            )
        tangent = _interpolant(self)(np.minimum(height_um, last_um))
        per_um = np.divide(tangent, height_um, out=np.zeros(height_um.size), where=height_um > 0.0)
        return np.asarray(field_um * per_um[:, np.newaxis])

    def covers(self, field_um: Floats) -> Bools:
        """Return whether positions (n, 2), µm, are within the heights of the table."""
        return np.hypot(field_um[:, 0], field_um[:, 1]) <= self.image_height_um[-1] * (1.0 + HEIGHT_ROUNDING)

    @property
    def um_per_tangent(self) -> float:
        """Smallest image height per change of the tangent, inf if constant."""
        tangent = np.tan(np.radians(self.angle_deg))
        per_um = float(np.abs(np.diff(tangent) / np.diff(self.image_height_um)).max())
        return 1.0 / per_um if per_um > 0.0 else math.inf


@lru_cache(maxsize=16)
def _interpolant(table: ChiefRayTable) -> Callable[[Floats], Floats]:
    from scipy.interpolate import PchipInterpolator

    found: Callable[[Floats], Floats] = PchipInterpolator(table.image_height_um, np.tan(np.radians(table.angle_deg)))
    return found


def cone_irradiance_sr(tangent: ArrayLike, radius: float) -> Floats:
    """
    Integrate a constant radiance over cones: irradiance over radiance, (n,) sr.

    ``tangent``: tangents of the chief rays, (n,). ``radius``: tangent radius ρ of the cones. With the tangents t of the rays, a
    cone is a disc around t₀, and the projected solid angle is ``dA / (1 + t²)²``: its integral is that of a uniform disc seen
    from a parallel surface, ``π/2 (1 - (1 + t₀² - ρ²) / sqrt((1 + t₀² + ρ²)² - 4 ρ² t₀²))`` (P. D. Foote, Bull. Bur. Stand. 12,
    583, 1915). For narrow cones it is ``π ρ² cos⁴``; on the axis it is ``π ρ² / (1 + ρ²)``, π sin² of the half-angle.
    """
    t2, r2 = np.square(np.asarray(tangent, np.float64)), radius * radius
    return np.asarray(0.5 * math.pi * (1.0 - (1.0 + t2 - r2) / np.sqrt((1.0 + t2 + r2) ** 2 - 4.0 * r2 * t2)))


@dataclass(frozen=True, eq=False)
class Incidence:
    """
    Cones of light at photosites, each around a chief ray.

    Created by :meth:`foveasim.Optics.incidence`.

    Parameters
    ----------
    field_um : (n_site, 2) float64, µm
        Positions of the sites relative to the optical axis, for a sensor that is not displaced.
    radius : float
        Tangent radius of the cone, ``1 / 2N``.
    exit_pupil_um : float, µm
        Distance of the exit pupil from the sensor; infinity for a telecentric lens.
    table : ChiefRayTable, optional
        Chief ray angles instead of an exit pupil.
    displacement_um : (x, y), µm
        Displacement of the sensor behind the lens, as by a gaze.
    transmission : callable, optional
        Power transmittance ``T(x, y)`` at points of the pupil, in units of its radius; by default a clear circle.
    n_rings : int
        Number of rings of rays; ring cubature with ``4 n_rings - 1`` rays per ring, at least 7: an odd number, so that no rays
        are opposite.

    Examples
    --------
    >>> cone = Incidence(
    ...     np.array([[0.0, 0.0], [1000.0, 0.0]]), radius=0.125, exit_pupil_um=8000.0
    ... )
    >>> cone.chief_ray.tolist(), cone.tangents.shape
    ([[0.0, 0.0], [0.125, 0.0]], (2, 7, 2))
    """

    field_um: Floats
    radius: Annotated[float, RADIUS]
    exit_pupil_um: OwnCheck[float] = math.inf
    table: ChiefRayTable | None = None
    displacement_um: tuple[float, float] = (0.0, 0.0)
    transmission: OwnCheck[Callable[[Floats, Floats], Any] | None] = None
    n_rings: Annotated[int, Limits(at_least=1, at_most=MAX_RINGS)] = N_RINGS
    #: Positions of rows and columns of sites, x (n_column,) and y (n_row,), instead of ``field_um``.
    axes_um: tuple[Floats, Floats] | None = field(default=None, init=False)

    def __getattr__(self, name: str) -> Floats:
        # Only called for attributes that are not set: the positions in rows and columns.
        if name != "field_um" or self.axes_um is None:
            raise AttributeError(f"'Incidence' object has no attribute '{name}'")
        object.__setattr__(self, name, frozen_array(self.positions_um(np.arange(self.n_sites))))
        return self.field_um

    def __post_init__(self) -> None:
        check_declared(self)
        field_um = np.ascontiguousarray(as_numbers("field_um", self.field_um), np.float64)
        if field_um.ndim != 2 or field_um.shape[1] != 2:
            raise ParameterError("field_um", f"must have the shape (n_site, 2), got {field_um.shape}")
        if not math.isfinite(field_um.sum()):
            finite_array("field_um", field_um)  # raises an error with the position
        object.__setattr__(self, "field_um", frozen_array(field_um))
        if not self.exit_pupil_um > 0.0:
            raise ParameterError("exit_pupil_um", "must be > 0", self.exit_pupil_um, "µm")

    def __repr__(self) -> str:
        return f"Incidence({self.n_sites} sites, cones of f/{0.5 / self.radius:.3g}, {self.n_rings} rings)"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.field_um.shape[0] if self.axes_um is None else self.axes_um[0].size * self.axes_um[1].size

    def with_rings(self, n_rings: int) -> Incidence:
        """Return the same cones with another number of rings of rays."""
        if self.axes_um is None:
            return replace(self, n_rings=n_rings)
        return replace(self.at(np.zeros((0, 2))), n_rings=n_rings).on_axes(*self.axes_um)

    def at(self, field_um: Floats) -> Incidence:
        """Return the cones of the same lens at other positions, (n, 2) µm."""
        return replace(self, field_um=field_um)

    def on_axes(self, x_um: Floats, y_um: Floats) -> Incidence:
        """
        Return the cones of the same lens at positions in rows and columns.

        Site ``row * n_column + column`` is at ``x_um[column]`` and ``y_um[row]``; :attr:`field_um` is created when it is read.
        """
        found = self.at(np.zeros((0, 2)))
        object.__delattr__(found, "field_um")
        object.__setattr__(found, "axes_um", (read_only(x_um), read_only(y_um)))
        return found

    def positions_um(self, selection: Ints) -> Floats:
        """Return the positions of some sites relative to the optical axis, (n, 2) µm."""
        if self.axes_um is None:
            return np.asarray(self.field_um[selection])
        x_um, y_um = self.axes_um
        row, column = np.divmod(selection, x_um.size)
        return np.stack((x_um[column], y_um[row]), axis=1)

    @property
    def image_height_um(self) -> Floats:
        """Distance of each site from the optical axis, (n_site,) µm."""
        return np.hypot(*(self.field_um + np.array(self.displacement_um)).T)

    @property
    def chief_ray(self) -> Floats:
        """Tangents of the chief rays at the sites, (n_site, 2)."""
        return self._chief_rays_at(self.field_um + np.array(self.displacement_um))

    @property
    def largest_tangent(self) -> float:
        """Largest tangent of a chief ray between the optical axis and the outermost site."""
        if self.axes_um is None:
            height_um = float(self.image_height_um.max(initial=0.0))
        else:
            ends = (np.abs(at + by).max(initial=0.0) for at, by in zip(self.axes_um, self.displacement_um, strict=True))
            height_um = math.hypot(*ends)
        if self.table is None:
            return abs(height_um / self.exit_pupil_um)
        knots_um = np.array(self.table.image_height_um)  # between them, tangents are monotonic
        heights_um = np.append(knots_um[knots_um < height_um], min(height_um, knots_um[-1]))
        return float(np.abs(_interpolant(self.table)(heights_um)).max())

    def design(self, table: ChiefRayTable | None = None) -> Floats:
        """
        Return the chief rays for which microlenses of the sensor are designed.

        Parameters
        ----------
        table : ChiefRayTable, optional
            By default the chief rays of the lens.

        Returns
        -------
        tangents : (n_site, 2) float64
            At the positions of the sites without displacement.

        Raises
        ------
        ParameterError
            When a site is beyond the table.
        """
        return self._chief_rays_at(self.field_um) if table is None else table.tangents(self.field_um)

    def covers(self, field_um: Floats, design: ChiefRayTable | None = None) -> Bools:
        """
        Return whether positions are within the table of the lens, and that of a design.

        ``field_um``: (n, 2) µm; with the displacement of the sensor, and without.
        """
        found = np.ones(field_um.shape[0], np.bool_)
        for table in (self.table, design):
            if table is not None:
                found &= table.covers(field_um)
        return found if self.table is None else found & self.table.covers(field_um + np.array(self.displacement_um))

    def _chief_rays_at(self, field_um: Floats) -> Floats:
        return np.asarray(field_um / self.exit_pupil_um) if self.table is None else self.table.tangents(field_um)

    @property
    def um_per_tangent(self) -> float:
        """Smallest displacement in the image per change of a chief ray tangent, inf if constant."""
        return self.exit_pupil_um if self.table is None else self.table.um_per_tangent

    @property
    def tangents(self) -> Floats:
        """Tangents of the rays, (n_site, n_ray, 2)."""
        points, _ = self.rays()
        return np.asarray(self.chief_ray[:, np.newaxis] + self.radius * points)

    @property
    def weights(self) -> Floats:
        """Weights of the rays, (n_site, n_ray): (1 + t²)⁻² over its sum."""
        weights = self.rays()[1] / (1.0 + np.square(self.tangents).sum(axis=2)) ** 2
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def rays(self, n_rings: int | None = None, n_directions: int | None = None) -> tuple[Floats, Floats]:
        """
        Return a cubature of the cone that all sites share.

        Parameters
        ----------
        n_rings, n_directions : int, optional
            Numbers of rings, and of rays in each; by default those of the rays.

        Returns
        -------
        points : (n_ray, 2) float64
            Points of the unit disc: the tangent of a ray is that of the chief ray plus :attr:`radius` times its point.
        weights : (n_ray,) float64
            Areas times transmittance, without the factor (1 + t²)⁻².

        Raises
        ------
        ParameterError
            When the pupil transmits none of the rays.
        """
        n_rings = self.n_rings if n_rings is None else n_rings
        points, weights = disc_cubature(n_rings, max(4 * n_rings - 1, 7) if n_directions is None else n_directions)
        if self.transmission is None:
            return points, weights
        # A ray from the point x of the pupil propagates towards -x.
        transmitted = np.asarray(self.transmission(-points[:, 0], -points[:, 1]), np.float64)
        weights = weights * np.broadcast_to(transmitted, weights.shape)
        if not weights.sum() > 0.0:
            raise ParameterError("n_rings", "must be larger: the pupil transmits none of the rays", n_rings)
        return points, read_only(weights / weights.sum())


@lru_cache(maxsize=16)
def disc_cubature(n_rings: int, n_directions: int) -> tuple[Floats, Floats]:
    """
    Return points (n, 2) and weights (n,) of a cubature of the unit disc.

    It is exact for polynomials. Radii are nodes of Gauss and Legendre in the squared radius. Rings are rotated against each
    other by half a step, and by an eighth of a step against the axes, at which the overlap of rectangles has kinks.
    """
    node, weight = np.polynomial.legendre.leggauss(n_rings)
    radius = np.sqrt(0.5 * (1.0 + node))
    step = 2.0 * np.pi / n_directions
    angle = step * (np.arange(n_directions) + 0.125 + 0.5 * (np.arange(n_rings)[:, np.newaxis] % 2))
    points = np.stack((radius[:, np.newaxis] * np.cos(angle), radius[:, np.newaxis] * np.sin(angle)), axis=-1)
    weights = np.repeat(0.5 * weight / n_directions, n_directions)
    return read_only(points.reshape(-1, 2)), read_only(weights)


publish(__name__)
