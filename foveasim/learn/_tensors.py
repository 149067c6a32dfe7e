"""Checks of tensors, and their conversion to arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from foveasim.errors import ParameterError, type_name

#: Number of times that a step is halved before it is cancelled.
MAX_HALVINGS = 8


def check_tensor(name: str, value: object, shape: Sequence[int | None], description: str = "") -> Tensor:
    """
    Check that a value is a floating-point tensor of a shape on the CPU, and return it.

    ``None`` in the shape stands for any size; a leading ``...`` in the description for further axes, which
    the caller flattens.
    """
    if not isinstance(value, Tensor):
        raise ParameterError(name, f"must be a torch.Tensor, got {type_name(value)}", hint="use torch.as_tensor")
    if not value.is_floating_point():
        raise ParameterError(
            name, f"must be a tensor of floating-point numbers, got {value.dtype}", hint="use .double() or .float()"
        )
    if value.device.type != "cpu":
        raise ParameterError(
            name, f"must be on the CPU, got a tensor on {value.device}", hint="use .cpu(); gradients follow it back"
        )
    sizes = tuple(value.shape)
    if len(sizes) != len(shape) or any(n is not None and n != m for n, m in zip(shape, sizes, strict=True)):
        expected = ", ".join("n" if n is None else str(n) for n in shape)
        raise ParameterError(name, f"must have the shape ({expected}){description}, got {sizes}")
    return value


def as_array(tensor: Tensor) -> NDArray[Any]:
    """Return the numbers of a tensor as a C-contiguous array, without a copy where possible."""
    return np.ascontiguousarray(tensor.detach().numpy())


def constant(values: Any) -> Tensor:
    """Return a float64 tensor with a copy of numbers."""
    return torch.from_numpy(np.array(values, np.float64))


def shorten_steps(start: Tensor, target: Tensor, find_invalid: Callable[[Tensor], Tensor | None]) -> Tensor:
    """
    Return the fraction of the step of each row that gives a valid state, (n, 1) or (n,).

    ``find_invalid`` sets a state, and returns the rows whose steps make it invalid, as a mask, or None. Their steps are halved,
    and cancelled after 8 times; then those of all others, which moved further.
    """
    target = torch.where(torch.isfinite(target), target, start)
    fraction = torch.ones_like(target[..., :1] if target.ndim > 1 else target)
    while (is_blocked := find_invalid(start + fraction * (target - start))) is not None:
        if not bool((fraction[is_blocked] > 0.0).any()):
            is_blocked = torch.ones_like(is_blocked)
            if not bool((fraction > 0.0).any()):
                break
        halved = 0.5 * fraction
        fraction = torch.where(is_blocked, torch.where(halved < 0.5**MAX_HALVINGS, 0.0, halved), fraction)
    return fraction
