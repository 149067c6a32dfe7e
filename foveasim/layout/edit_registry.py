"""Registry of layout edits: functions of a layout and parameters that return a new layout."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

from foveasim._core.calls import check_arguments
from foveasim._core.registry import Registry
from foveasim.layout.model import Layout

__all__ = ["EDITS", "layout_edit"]

E = TypeVar("E", bound=Callable[..., Layout])

#: Edits of layouts by their name in settings files. The first parameter of an edit is the layout. Installed packages register
#: more as entry points of the group ``foveasim.edits``.
EDITS: Registry[Callable[..., Layout]] = Registry("layout edit", "foveasim.edits")


def layout_edit(*, example: Mapping[str, Any], name: str | None = None) -> Callable[[E], E]:
    """
    Register a function as an edit of settings files.

    Parameters
    ----------
    example : mapping
        Parameters that are valid for a grid of 4 x 4 squares of 10 µm around the optical axis; used by the checks of all edits.
    name : str, optional
        Name of the edit; by default that of the function.

    Examples
    --------
    >>> @layout_edit(example={"margin_um": 1.0})  # doctest: +SKIP
    ... def grow(layout, *, margin_um: float) -> Layout:
    ...     return fs.Layout.from_polygons(shapely.buffer(layout.polygons(), margin_um))
    """

    def register(edit: E) -> E:
        checked = cast("E", check_arguments(edit))
        EDITS.register(name or edit.__name__, checked, example=example)
        return checked

    return register
