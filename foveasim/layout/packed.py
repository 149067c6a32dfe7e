"""Conversion of layouts to and from named arrays, for files with several objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.layout.model import Layout

__all__ = ["is_layout_array", "layout_from_arrays", "layout_to_arrays"]

OUTLINES = ("xy_um", "ring_offsets", "site_offsets")
#: Prefix of the array name of a column.
COLUMN_PREFIX = "column_"


def layout_to_arrays(layout: Layout) -> dict[str, NDArray[Any]]:
    """Return the outlines and columns of a layout as arrays by name."""
    arrays = {name: np.asarray(getattr(layout, name)) for name in OUTLINES}
    return arrays | {COLUMN_PREFIX + name: values for name, values in layout.columns.items()}


def layout_from_arrays(arrays: Mapping[str, NDArray[Any]], provenance: Mapping[str, Any]) -> Layout:
    """
    Build a layout from named arrays; only structure and holes of the outlines are checked.

    Raises
    ------
    KeyError
        When an array of the outlines is missing.
    GeometryError, ParameterError
        When array sizes are inconsistent, holes do not lie in their outlines, or a column is malformed.
    """
    from foveasim.layout.files._common import check_sizes

    columns = {
        name.removeprefix(COLUMN_PREFIX): values for name, values in arrays.items() if name.startswith(COLUMN_PREFIX)
    }
    xy_um, ring_offsets, site_offsets = (arrays[name] for name in OUTLINES)
    has_holes = np.diff(site_offsets) > 1
    if has_holes.any():
        check_sizes(np.diff(site_offsets)[has_holes], np.diff(ring_offsets[site_offsets])[has_holes])
    return Layout(xy_um, ring_offsets, site_offsets, columns, provenance)


def is_layout_array(name: str) -> bool:
    """Return whether an array of this name belongs to a layout."""
    return name in OUTLINES or name.startswith(COLUMN_PREFIX)
