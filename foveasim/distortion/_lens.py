"""Common interface of lens models: position in the sensor plane, points outside the model."""

from __future__ import annotations

import math
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import check_declared
from foveasim._core.rings import from_frame, to_frame
from foveasim._core.validation import Floats, check_length_um, check_point, finite_array
from foveasim._projections import LAWS, angles_of
from foveasim.errors import GeometryError, ParameterError

#: Treatment of points outside the valid radius of a lens: raise an error, or return NaN.
Outside: TypeAlias = Literal["error", "mask"]


@runtime_checkable
class Lens(Protocol):
    """
    Protocol of lens models for cameras.

    Models that also have ``direction`` and ``project``, as those of this package, are not limited to 90° from the axis.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.BrownConrady(focal_um=8000.0, k1=-0.1)
    >>> (
    ...     isinstance(lens, fs.distortion.Lens),
    ...     lens.distort([[1000.0, 0.0]]).round(2).tolist(),
    ... )
    (True, [[998.44, 0.0]])
    """

    @property
    def focal_um(self) -> float | tuple[float, float]:
        """Focal length, µm; one value each for x and y if the image is stretched."""

    @property
    def centre_um(self) -> tuple[float, float]:
        """Intersection of the optical axis with the sensor plane, µm."""

    def distort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """Return real positions, (..., 2) µm, of ideal ones."""

    def undistort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """Return ideal positions, (..., 2) µm, of real ones."""


class LensBase:
    """
    Base of lens models that are normalised by the focal length around a centre.

    Subclasses define ``_forward`` and ``_backward``, which map (n, 2) normalised points to normalised points (NaN where the
    model is not valid), and ``_limits``, the normalised radii up to which the two are valid. Models of fields beyond 90° also
    define ``_to_directions`` and ``_from_directions``, from and to normalised points of the sensor, and ``_wide_limits``, the
    largest angle and radius.
    """

    focal_um: float | tuple[float, float]
    centre_um: tuple[float, float]

    def __post_init__(self) -> None:
        check_declared(self)
        focal = np.atleast_1d(finite_array("focal_um", self.focal_um, above=0.0))
        if focal.shape not in ((1,), (2,)):
            raise ParameterError("focal_um", "must be one number, or two (along x and y)", self.focal_um, "µm")
        for length_um in focal:
            check_length_um("focal_um", length_um)
        object.__setattr__(self, "focal_um", float(focal[0]) if focal.size == 1 else tuple(focal.tolist()))
        object.__setattr__(self, "centre_um", check_point("centre_um", self.centre_um))

    def distort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """
        Return the real positions of ideal positions.

        Parameters
        ----------
        xy_um : (..., 2), µm
            Ideal positions in the sensor plane.
        outside : {"error", "mask"}
            Whether points outside the valid radius raise an error or become NaN.

        Returns
        -------
        (..., 2) float64, µm

        Raises
        ------
        GeometryError
            If a point lies outside the radius up to which the model is invertible, and ``outside`` is ``"error"``.
        """
        return self._map_points(xy_um, self._forward, 0, outside)

    def undistort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """
        Return the ideal positions of real positions.

        Parameters
        ----------
        xy_um : (..., 2), µm
            Real positions in the sensor plane.
        outside : {"error", "mask"}
            As for :meth:`distort`; the irradiance outside the image circle is 0.

        Returns
        -------
        (..., 2) float64, µm
        """
        return self._map_points(xy_um, self._backward, 1, outside)

    def direction(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """
        Return the directions of the rays that meet the sensor at real positions.

        Parameters
        ----------
        xy_um : (..., 2), µm
            Real positions in the sensor plane.
        outside : {"error", "mask"}
            Whether points outside the valid radius raise an error or become NaN.

        Returns
        -------
        (..., 3) float64
            Unit vectors in the scene: x to the right, y up, z along the optical axis. Beyond 90° z is negative.

        Raises
        ------
        GeometryError
            If a point lies outside the radius up to which the model is valid, and ``outside`` is ``"error"``.

        Examples
        --------
        >>> import foveasim as fs
        >>> lens = fs.distortion.Fisheye(projection="equisolid", focal_um=1000.0)
        >>> (lens.direction([[1732.0508, 0.0]]) + 0.0).round(4).tolist()  # 120 degrees
        [[0.866, 0.0, -0.5]]
        """
        points, normalised = self._normalised(xy_um)
        found = self._to_directions(normalised)
        is_outside = np.isnan(found[:, 2]) if outside == "error" else np.zeros(1, bool)
        if is_outside.any():
            focal = np.broadcast_to(np.asarray(self.focal_um), (2,))
            limit = self._wide_limits()[1] * float(focal.min())
            at = np.hypot(*(normalised[is_outside] * focal).T).min()
            raise GeometryError(
                f"{int(is_outside.sum())} points have no direction: the nearest lies {at:.6g} µm from the lens centre, and the "
                f"model is valid up to {limit:.6g} µm; use points within, or outside='mask'"
            )
        return found.reshape(*points.shape[:-1], 3)

    def project(self, directions: ArrayLike, *, outside: Outside = "error") -> Floats:
        """
        Return the real positions of directions.

        Parameters
        ----------
        directions : (..., 3)
            Vectors of any length in the scene: x to the right, y up, z along the optical axis.
        outside : {"error", "mask"}
            Whether directions at a larger angle than :attr:`max_angle_deg` raise an error or become NaN.

        Returns
        -------
        (..., 2) float64, µm

        Raises
        ------
        GeometryError
            If a direction lies outside the field of the model, and ``outside`` is ``"error"``.
        ParameterError
            If a vector is 0.

        Examples
        --------
        >>> import foveasim as fs
        >>> lens = fs.distortion.Fisheye(projection="equidistant", focal_um=1000.0)
        >>> lens.project([[1.0, 0.0, 0.0], [0.0, -1.0, -1.0]]).round(1).tolist()
        [[1570.8, 0.0], [0.0, -2356.2]]
        """
        vectors = finite_array("directions", directions)
        if vectors.ndim == 0 or vectors.shape[-1] != 3:
            raise ParameterError("directions", f"must have the shape (..., 3), got {vectors.shape}")
        flat = vectors.reshape(-1, 3)
        length = np.sqrt(np.square(flat).sum(axis=1))
        if not (length > 0.0).all():
            raise ParameterError("directions", "must not be 0", vectors)
        found = self._from_directions(flat / length[:, np.newaxis])
        is_outside = np.isnan(found[:, 0]) if outside == "error" else np.zeros(1, bool)
        if is_outside.any():
            at_deg = np.degrees(angles_of(flat[is_outside])[1]).min()
            raise GeometryError(
                f"{int(is_outside.sum())} directions cannot be projected: the nearest is at {at_deg:.6g}° to the axis, and the "
                f"model is valid up to {self.max_angle_deg:.6g}°; use directions within, or outside='mask'"
            )
        focal = np.broadcast_to(np.asarray(self.focal_um), (2,))
        return from_frame(found, np.asarray(self.centre_um), focal).reshape(*vectors.shape[:-1], 2)

    @property
    def max_angle_deg(self) -> float:
        """Largest angle of a ray to the optical axis, degrees."""
        return math.degrees(self._wide_limits()[0])

    @property
    def max_radius_um(self) -> tuple[float, float]:
        """Largest valid radii of ``distort`` and ``undistort``, µm; may be infinite."""
        ideal, real = self._limits()
        min_um = float(np.min(self.focal_um))
        return ideal * min_um, real * min_um

    def _forward(self, xy: Floats) -> Floats:
        raise NotImplementedError

    def _backward(self, xy: Floats) -> Floats:
        raise NotImplementedError

    def _limits(self) -> tuple[float, float]:
        raise NotImplementedError

    def _to_directions(self, xy: Floats) -> Floats:
        """Return the directions (n, 3) of normalised points (n, 2); NaN beyond the model."""
        ideal = np.pad(self._backward(xy), ((0, 0), (0, 1)), constant_values=1.0)
        return np.asarray(ideal / np.sqrt(np.square(ideal).sum(axis=1, keepdims=True)))

    def _from_directions(self, directions: Floats) -> Floats:
        """Return the normalised points (n, 2) of unit vectors (n, 3); NaN beyond the model."""
        ideal = LAWS["rectilinear"].points(directions)
        return np.where(np.isnan(ideal), np.nan, self._forward(np.nan_to_num(ideal)))

    def _wide_limits(self) -> tuple[float, float]:
        """Return the largest angle to the axis, rad, and the normalised radius of the sensor."""
        ideal, real = self._limits()
        return math.atan(ideal), real

    def _normalised(self, xy_um: ArrayLike) -> tuple[Floats, Floats]:
        """Return points (..., 2), µm, and their normalised positions (n, 2)."""
        points = finite_array("xy_um", xy_um)
        if points.ndim == 0 or points.shape[-1] != 2:
            raise ParameterError("xy_um", f"must have the shape (..., 2), got {points.shape}")
        focal = np.broadcast_to(np.asarray(self.focal_um), (2,))
        return points, to_frame(points.reshape(-1, 2), np.asarray(self.centre_um), focal)

    def _map_points(self, xy_um: ArrayLike, function: object, which: int, outside: Outside) -> Floats:
        points, normalised = self._normalised(xy_um)
        centre = np.asarray(self.centre_um)
        focal = np.broadcast_to(np.asarray(self.focal_um), (2,))
        mapped: Floats = function(normalised)  # type: ignore[operator]
        is_outside = np.isnan(mapped[:, 0]) if outside == "error" else np.zeros(1, bool)
        if is_outside.any():
            at = np.hypot(*(normalised[is_outside] * focal).T).min()
            limit = self.max_radius_um[which]
            raise GeometryError(
                f"{int(is_outside.sum())} points cannot be {('distorted', 'undistorted')[which]}: the nearest lies {at:.6g} µm "
                f"from the lens centre, and the model is valid up to {limit:.6g} µm; use points within, or outside='mask'"
            )
        return from_frame(mapped, centre, focal).reshape(points.shape)
