"""Arrays with one value for each photosite, and objects with such arrays."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import own, unmasked
from foveasim.errors import ParameterError

_Array = TypeVar("_Array", bound=NDArray[Any])


def check_per_site(name: str, values: _Array, n_sites: int, *, or_one: bool = False, or_rows: bool = False) -> _Array:
    """
    Return an array after checking that its shape is (n_site,).

    With ``or_one``, it may also be one number; with ``or_rows``, have further axes before, (..., n_site). Raises ParameterError
    for other shapes.
    """
    shape = values.shape
    if (shape[-1:] == (n_sites,) and (or_rows or values.ndim == 1)) or (or_one and shape == ()):
        return values
    rule = "be one number, or one for each" if or_one else "have one value for each"
    raise ParameterError(name, f"must {rule} of the {n_sites} sites, got the shape {shape}")


def own_arrays(instance: Any) -> None:
    """Replace the arrays of a frozen dataclass by read-only ones, independent of the caller's."""
    for field in fields(instance):
        values = unmasked(field.name, getattr(instance, field.name))
        if isinstance(values, np.ndarray | list | tuple):
            object.__setattr__(instance, field.name, own(np.asarray(values)))
