"""What all lens models share: their place in the sensor plane, and what becomes of points that they cannot map."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.rings import from_frame, to_frame
from foveasim._core.validation import Floats, check_choice, check_length_um, finite_array
from foveasim.errors import GeometryError, ParameterError

__all__ = ["Lens", "Outside", "Placed"]

#: What becomes of points that a lens cannot map: an error that names the radius, or NaN.
Outside: TypeAlias = Literal["error", "mask"]


@runtime_checkable
class Lens(Protocol):
    """A lens model as cameras take it; those of this package and any other class with these members."""

    @property
    def focal_um(self) -> float | tuple[float, float]:
        """Focal length in µm; two of them, along x and y, where the image is stretched."""

    @property
    def centre_um(self) -> tuple[float, float]:
        """Where the optical axis meets the sensor, µm."""

    def distort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """Return real positions, (..., 2) µm, of ideal ones."""

    def undistort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """Return ideal positions, (..., 2) µm, of real ones."""


class Placed:
    """
    A model in units of the focal length around a centre, placed in the sensor plane.

    Models give ``_forward`` and ``_backward`` from (n, 2) normalised points to such points, NaN where there is no answer, and
    ``_limits``, the radii (normalised) that the two are right up to.
    """

    focal_um: float | tuple[float, float]
    centre_um: tuple[float, float]

    def _check_place(self) -> None:
        focal = np.atleast_1d(finite_array("focal_um", self.focal_um, above=0.0))
        if focal.shape not in ((1,), (2,)):
            raise ParameterError("focal_um", "must be one number, or two (along x and y)", self.focal_um, "µm")
        for length_um in focal:
            check_length_um("focal_um", length_um)
        object.__setattr__(self, "focal_um", float(focal[0]) if focal.size == 1 else tuple(focal.tolist()))
        centre = finite_array("centre_um", self.centre_um, ndim=1)
        if centre.shape != (2,):
            raise ParameterError("centre_um", "must be two numbers (x, y)", self.centre_um, "µm")
        object.__setattr__(self, "centre_um", (float(centre[0]), float(centre[1])))

    def distort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """
        Where the lens puts points that an ideal lens would put at ``xy_um``.

        Parameters
        ----------
        xy_um : (..., 2), µm
            Ideal positions in the sensor plane.
        outside : {"error", "mask"}
            Whether points beyond the model's reach raise, or become NaN.

        Returns
        -------
        (..., 2) float64, µm

        Raises
        ------
        GeometryError
            When a point lies beyond the radius up to which the model can be inverted, and ``outside`` is ``"error"``.
        """
        return self._mapped(xy_um, self._forward, 0, outside)

    def undistort(self, xy_um: ArrayLike, *, outside: Outside = "error") -> Floats:
        """
        Where an ideal lens would put what this one puts at ``xy_um``; as :meth:`distort`.

        Parameters
        ----------
        xy_um : (..., 2), µm
            Real positions in the sensor plane.
        outside : {"error", "mask"}
            As for :meth:`distort`: beyond the image circle there is no light.

        Returns
        -------
        (..., 2) float64, µm
        """
        return self._mapped(xy_um, self._backward, 1, outside)

    @property
    def max_radius_um(self) -> tuple[float, float]:
        """Radii around the centre up to which every point can be distorted and undistorted, µm; infinite without end."""
        ideal, real = self._limits()
        least_um = float(np.min(self.focal_um))
        return ideal * least_um, real * least_um

    def _forward(self, xy: Floats) -> Floats:
        raise NotImplementedError

    def _backward(self, xy: Floats) -> Floats:
        raise NotImplementedError

    def _limits(self) -> tuple[float, float]:
        raise NotImplementedError

    def _mapped(self, xy_um: ArrayLike, function: object, which: int, outside: Outside) -> Floats:
        check_choice("outside", outside, get_args(Outside))
        points = finite_array("xy_um", xy_um)
        if points.ndim == 0 or points.shape[-1] != 2:
            raise ParameterError("xy_um", f"must have the shape (..., 2), got {points.shape}")
        centre = np.asarray(self.centre_um)
        focal = np.broadcast_to(np.asarray(self.focal_um), (2,))
        normalised = to_frame(points.reshape(-1, 2), centre, focal)
        mapped: Floats = function(normalised)  # type: ignore[operator]
        is_lost = np.isnan(mapped[:, 0]) if outside == "error" else np.zeros(1, bool)
        if is_lost.any():
            at = np.hypot(*(normalised[is_lost] * focal).T).min()
            limit = self.max_radius_um[which]
            raise GeometryError(
                f"{int(is_lost.sum())} points cannot be {('distorted', 'undistorted')[which]}: the nearest lies {at:.6g} µm "
                f"from the lens's centre, and the model is right up to {limit:.6g} µm; keep to that, or take outside='mask'"
            )
        return from_frame(mapped, centre, focal).reshape(points.shape)
