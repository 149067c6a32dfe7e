"""Common interface of lens models: position in the sensor plane, points outside the model."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import check_declared
from foveasim._core.rings import from_frame, to_frame
from foveasim._core.validation import Floats, check_length_um, check_point, finite_array
from foveasim.errors import GeometryError, ParameterError

#: Treatment of points outside the valid radius of a lens: raise an error, or return NaN.
Outside: TypeAlias = Literal["error", "mask"]


@runtime_checkable
class Lens(Protocol):
    """
    Protocol of lens models for cameras.

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
    model is not valid), and ``_limits``, the normalised radii up to which the two are valid.
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

    def _map_points(self, xy_um: ArrayLike, function: object, which: int, outside: Outside) -> Floats:
        points = finite_array("xy_um", xy_um)
        if points.ndim == 0 or points.shape[-1] != 2:
            raise ParameterError("xy_um", f"must have the shape (..., 2), got {points.shape}")
        centre = np.asarray(self.centre_um)
        focal = np.broadcast_to(np.asarray(self.focal_um), (2,))
        normalised = to_frame(points.reshape(-1, 2), centre, focal)
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
