"""Arrays with one value for each photosite."""

from __future__ import annotations

from typing import Any, TypeVar

from numpy.typing import NDArray

from foveasim.errors import ParameterError

__all__ = ["check_per_site"]

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
