"""Registry of the views of the studio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim.config import Shot
from foveasim.studio._engine import Simulated

__all__ = [
    "PARTS",
    "Part",
    "PartData",
    "capture_of",
    "curves_of",
    "label_of",
    "layout_of",
    "page_part",
    "part",
    "pinned_of",
    "saturation_of",
]

#: Order of the first view in a tile.
FIRST_TILE = 10
#: Data of a part: plain data, and arrays by name.
PartData = tuple[dict[str, Any], dict[str, NDArray[Any]]]


@dataclass(frozen=True)
class Part:
    """
    A view.

    Attributes
    ----------
    name : str
        Also of its module in ``static/views``.
    label : str
        Heading on the page.
    make : function of Simulated
        Returns the data; :func:`of_page` if the page has them.
    depends : function of Simulated
        Returns objects that determine the data: the part is computed again when one of them is another object, or a tuple
        that is not equal.
    order : int
        Position on the page; views below :data:`FIRST_TILE` are always shown, others in tiles.
    is_first : bool
        Whether the tile is shown at first.
    is_wide : bool
        Whether the tile is shown at first on wide pages.
    is_lazy : bool
        Whether the part is computed only when a page asks for it.
    is_costly : bool
        Whether the part is not computed for previews either.
    is_of_variants : bool
        Whether the part is computed only when there are variants to compare with.
    group : str
        Group of the tab: "See", "Measure", "Check", "Explore", or another one.
    work_ahead : function of Shot
        Starts work that depends on the layout before the shot is simulated.
    """

    name: str
    label: str
    make: Callable[[Simulated], PartData]
    depends: Callable[[Simulated], tuple[Any, ...]]
    order: int = 1000
    is_first: bool = False
    is_wide: bool = False
    is_lazy: bool = False
    is_costly: bool = False
    is_of_variants: bool = False
    group: str = "Explore"
    work_ahead: Callable[[Shot], None] | None = None

    __repr__ = short_repr

    @property
    def has_data(self) -> bool:
        """Whether the server sends data."""
        return self.make is not of_page

    def about(self) -> dict[str, Any]:
        """Return what the page needs to know."""
        return {
            "name": self.name,
            "label": self.label,
            "group": self.group,
            "is_tile": self.order >= FIRST_TILE,
            "is_first": self.is_first,
            "is_wide": self.is_first or self.is_wide,
            "is_lazy": self.is_lazy or self.is_costly,
            "has_data": self.has_data,
        }


#: Views by name, in their order on the page.
PARTS: dict[str, Part] = {}


def _add(added: Part) -> None:
    PARTS[added.name] = added
    for each in sorted(PARTS.values(), key=lambda each: each.order):
        PARTS[each.name] = PARTS.pop(each.name)


def part(
    label: str, depends: Callable[[Simulated], tuple[Any, ...]], **options: Any
) -> Callable[[Callable[[Simulated], PartData]], Callable[[Simulated], PartData]]:
    """Register a function as the view with its name; options are attributes of :class:`Part`."""

    def register(make: Callable[[Simulated], PartData]) -> Callable[[Simulated], PartData]:
        _add(Part(make.__name__, label, make, depends, **options))
        return make

    return register


def page_part(name: str, label: str, **options: Any) -> None:
    """Register a view whose data the page has."""
    _add(Part(name, label, of_page, lambda _: (), **options))


def of_page(_result: Simulated) -> PartData:
    """Return nothing: the page has the data."""
    return {}, {}


def capture_of(result: Simulated) -> tuple[Any, ...]:
    """Return the dependencies of views of a capture."""
    return (result.capture,)


def pinned_of(result: Simulated) -> tuple[Any, ...]:
    """Return the dependencies of views of a capture that compare pinned photosites."""
    return (result.capture, result.pinned)


def label_of(site: int) -> str:
    """Return the label of the curve of a photosite."""
    return f"photosite {site:,}"


def layout_of(result: Simulated) -> tuple[Any, ...]:
    """Return the dependencies of views of a layout."""
    return (result.capture.layout,)


def saturation_of(result: Simulated) -> str:
    """Return the fraction of saturated photosites as the end of a note; empty if none is."""
    fraction = result.capture.saturated_fraction
    return f"; {100.0 * fraction:.3g} % of the photosites are saturated" if fraction else ""


def curves_of(curves: list[dict[str, Any]], x: Sequence[NDArray[Any]], y: Sequence[NDArray[Any]]) -> PartData:
    """Return curves with their arrays."""
    arrays = {
        f"{axis}-{k}": np.asarray(v, np.float32) for axis, each in (("x", x), ("y", y)) for k, v in enumerate(each)
    }
    return {"curves": curves}, arrays
