"""Registry of the views of the studio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim.studio._engine import Simulated

__all__ = ["PARTS", "Part", "PartData", "capture_of", "curves_of", "layout_of", "part"]

#: Data of a part: plain data, and arrays by name.
PartData = tuple[dict[str, Any], dict[str, NDArray[Any]]]


@dataclass(frozen=True)
class Part:
    """
    A view.

    Attributes
    ----------
    name : str
    label : str
        Heading on the page.
    make : function of Simulated
        Returns the data.
    depends : function of Simulated
        Returns objects that determine the data: the part is computed again when one of them is another object, or a tuple
        that is not equal.
    is_costly : bool
        Whether the part is computed only when a page asks for it, and not for previews.
    """

    name: str
    label: str
    make: Callable[[Simulated], PartData]
    depends: Callable[[Simulated], tuple[Any, ...]]
    is_costly: bool = False

    __repr__ = short_repr


#: Views by name.
PARTS: dict[str, Part] = {}


def part(
    label: str, depends: Callable[[Simulated], tuple[Any, ...]], *, is_costly: bool = False
) -> Callable[[Callable[[Simulated], PartData]], Callable[[Simulated], PartData]]:
    """Register a function as the view with its name."""

    def register(make: Callable[[Simulated], PartData]) -> Callable[[Simulated], PartData]:
        name = make.__name__
        PARTS[name] = Part(name, label, make, depends, is_costly)
        return make

    return register


def capture_of(result: Simulated) -> tuple[Any, ...]:
    """Return the dependencies of views of a capture."""
    return (result.capture,)


def layout_of(result: Simulated) -> tuple[Any, ...]:
    """Return the dependencies of views of a layout."""
    return (result.capture.layout,)


def curves_of(curves: list[dict[str, Any]], x: Sequence[NDArray[Any]], y: Sequence[NDArray[Any]]) -> PartData:
    """Return curves with their arrays."""
    arrays = {
        f"{axis}-{k}": np.asarray(v, np.float32) for axis, each in (("x", x), ("y", y)) for k, v in enumerate(each)
    }
    return {"curves": curves}, arrays
