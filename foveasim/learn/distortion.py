"""Lens distortion as a differentiable function of positions and coefficients."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from foveasim._core.names import possible_names
from foveasim._core.validation import Floats
from foveasim.distortion import Lens
from foveasim.errors import GeometryError, ParameterError
from foveasim.learn._tensors import as_array, check_tensor

__all__ = ["coefficient_names", "coefficient_values", "undistort", "with_coefficients"]

#: Step of the difference quotients, relative to the focal length for positions, and to the size of coefficients.
POSITION_STEP, COEFFICIENT_STEP = 2e-3, 2e-3
#: Parameters of lens models that are lengths, or a transformation of the sensor.
GEOMETRY = {"focal_um", "centre_um", "pixel_um", "projection", "stretch"}
#: Nodes and weights of the central difference of fourth order.
STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -8.0 / 12.0), (1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))


def coefficient_names(lens: Lens) -> tuple[str, ...]:
    """Return the names of a lens model's coefficients, such as k1, p2 and a[2]."""
    parameters: Any = lens
    names: list[str] = []
    for field in fields(parameters) if is_dataclass(parameters) else ():
        value = getattr(lens, field.name)
        if not field.init or field.name in GEOMETRY:
            continue
        if isinstance(value, float):
            names.append(field.name)
        elif isinstance(value, tuple):
            names.extend(f"{field.name}[{k}]" for k in range(len(value)))
    return tuple(names)


def coefficient_values(lens: Lens, names: Iterable[str]) -> list[float]:
    """Return the values of some coefficients of a lens model."""
    return [_get(lens, name) for name in names]


def _get(lens: Lens, name: str) -> float:
    key, _, index = name.rstrip("]").partition("[")
    value = getattr(lens, key)
    return float(value[int(index)] if index else value)


def with_coefficients(lens: Lens, names: Iterable[str], values: Any) -> Lens:
    """Return a lens model with other values of some coefficients."""
    changes: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        key, _, index = name.rstrip("]").partition("[")
        if index:
            sequence = list(changes.get(key, getattr(lens, key)))
            sequence[int(index)] = float(value)
            changes[key] = tuple(sequence)
        else:
            changes[key] = float(value)
    return replace(lens, **changes) if changes else lens  # type: ignore[type-var]


def _scale(lens: Lens, name: str) -> float:
    """Return the size of a coefficient that distorts strongly at a radius of a focal length."""
    if name.startswith("a["):  # of Scaramuzza: a0 + a2 r² + a3 r³ + ..., in pixels
        focal, k = abs(_get(lens, "a[0]")), int(name[2:-1])
        return focal ** (1.0 - (k + 1 if k else 0))
    return 1.0


def undistort(lens: Lens, points: Tensor, coefficients: Tensor | None = None, names: Iterable[str] = ()) -> Tensor:
    """
    Return the ideal positions of real positions.

    Parameters
    ----------
    lens : lens model of foveasim.distortion
    points : (n, 2) tensor, µm
        Positions in the sensor plane.
    coefficients : (n_coefficient,) tensor, optional
        Values of some coefficients of the lens model, in the order of ``names``.
    names : iterable of str
        Names of these coefficients, such as ``("k1", "k2")`` or, for elements of sequences, ``("a[0]", "a[1]")``.

    Returns
    -------
    (n, 2) tensor, µm
        First derivatives exist for positions and coefficients.

    Raises
    ------
    GeometryError
        If a point lies outside the image circle.

    Notes
    -----
    Derivatives are central differences of fourth order of the lens model, which is smooth on the scale of its focal
    length. Their relative error is about 1e-9.
    """
    points = check_tensor("points", points, (None, 2), any_device=True)
    names = tuple(names)
    known = coefficient_names(lens)
    for name in names:
        if name not in known:
            hint = possible_names(str(name), list(known))
            raise ParameterError("names", f"must be coefficients of {type(lens).__name__}", name, hint=hint)
    if coefficients is None:
        coefficients = torch.tensor(coefficient_values(lens, names), dtype=torch.float64)
    coefficients = check_tensor("coefficients", coefficients, (len(names),), ", one per name", any_device=True)
    if points.device.type == "meta":  # without values: only the shape
        return points + coefficients.sum()
    return _Undistort.apply(points, coefficients, lens, names)  # type: ignore[no-any-return, no-untyped-call]


class _Undistort(torch.autograd.Function):
    """Inverse lens model."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, coefficients: Tensor, lens: Lens, names: tuple[str, ...]) -> Tensor:
        ctx.save_for_backward(points, coefficients)
        ctx.lens, ctx.names = lens, names
        current = with_coefficients(lens, names, coefficients.detach().tolist())
        return torch.from_numpy(np.array(current.undistort(as_array(points).astype(np.float64)))).to(points)

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        points, coefficients = ctx.saved_tensors
        weights, xy_um = as_array(gradients[0]).astype(np.float64), as_array(points).astype(np.float64)
        values = as_array(coefficients).astype(np.float64)
        lens = with_coefficients(ctx.lens, ctx.names, values)
        of_points = of_coefficients = None
        if ctx.needs_input_grad[0]:
            step_um = POSITION_STEP * float(np.min(np.asarray(lens.focal_um)))
            columns = []
            for axis in range(2):

                def moved(t: float, axis: int = axis) -> Floats:
                    return lens.undistort(xy_um + t * np.eye(2)[axis], outside="mask")

                columns.append((_differentiate(moved, step_um) * weights).sum(axis=1))
            of_points = torch.from_numpy(np.stack(columns, axis=1)).to(points)
        if ctx.needs_input_grad[1]:
            found = []
            for k, value in enumerate(values):

                def shifted(t: float, k: int = k) -> Floats:
                    changed = values + t * (np.arange(values.size) == k)
                    return with_coefficients(lens, ctx.names, changed).undistort(xy_um, outside="mask")

                step = COEFFICIENT_STEP * max(abs(float(value)), _scale(ctx.lens, ctx.names[k]))
                found.append(float((_differentiate(shifted, step) * weights).sum()))
            of_coefficients = torch.tensor(found, dtype=coefficients.dtype, device=coefficients.device)
        return of_points, of_coefficients, None, None


def _differentiate(function: Callable[[float], Floats], step: float) -> Floats:
    """Return the derivative of a function of one number at 0."""
    total: Floats = sum(weight * function(node * step) for node, weight in STENCIL) / step  # type: ignore[assignment]
    if not np.isfinite(total).all():
        raise GeometryError(
            f"point {int(np.argmax(~np.isfinite(total).all(axis=1)))} lies too close to the boundary of the image circle for a "
            "derivative of the distortion; use a smaller layout"
        )
    return total
