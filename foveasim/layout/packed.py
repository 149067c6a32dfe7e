"""Conversion of layouts to and from named arrays, for files with several objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import GeometryError
from foveasim.layout.lattice import RectangleLattice
from foveasim.layout.model import Layout

__all__ = ["is_layout_array", "layout_from_arrays", "layout_to_arrays"]

OUTLINES = ("xy_um", "ring_offsets", "site_offsets")
#: Columns and rows of a lattice of rectangles.
LATTICE = ("lattice_x_um", "lattice_y_um")
#: Prefix of the array name of a column.
COLUMN_PREFIX = "column_"
#: Rings and edges of a site are tested in pairs for intersection: maximum number of pairs, and maximum per ring or vertex.
MAX_RING_PAIRS, PAIRS_PER_RING = 2_000_000, 100
MAX_VERTEX_PAIRS, PAIRS_PER_VERTEX = 1_000_000_000, 1000


def layout_to_arrays(layout: Layout, *, is_compact: bool = False) -> dict[str, NDArray[Any]]:
    """
    Return the outlines and columns of a layout as arrays by name.

    Compact outlines of lattices are the intervals of columns and rows instead of vertices.
    """
    if is_compact and layout.lattice is not None:
        arrays = {LATTICE[0]: layout.lattice.x_um, LATTICE[1]: layout.lattice.y_um}
    else:
        arrays = {name: np.asarray(getattr(layout, name)) for name in OUTLINES}
    return arrays | {COLUMN_PREFIX + name: values for name, values in layout.columns.items()}


def check_sizes(n_rings: NDArray[Any], n_vertices: NDArray[Any]) -> None:
    """
    Reject sites with too many rings or vertices.

    Tests for intersections between them would take minutes.
    """
    for what, n, at_most, at_most_per_item in (
        ("rings", n_rings, MAX_RING_PAIRS, PAIRS_PER_RING),
        ("vertices", n_vertices, MAX_VERTEX_PAIRS, PAIRS_PER_VERTEX),
    ):
        if np.sum(n.astype(np.float64) ** 2) > at_most + at_most_per_item * n.sum():
            site = int(np.argmax(n))
            raise GeometryError(f"site {site} has {n[site]} {what}, too many for a photosite", (site,))


def layout_from_arrays(arrays: Mapping[str, NDArray[Any]], provenance: Mapping[str, Any]) -> Layout:
    """
    Build a layout from named arrays; only structure and holes of the outlines are checked.

    Raises KeyError when an array of the outlines is missing. Raises GeometryError, ParameterError when array sizes are
    inconsistent, holes do not lie in their outlines, or a column is malformed.
    """
    columns = {
        name.removeprefix(COLUMN_PREFIX): values for name, values in arrays.items() if name.startswith(COLUMN_PREFIX)
    }
    if LATTICE[0] in arrays:
        x_um, y_um = (arrays[name] for name in LATTICE)
        return Layout.from_lattice(RectangleLattice(x_um, y_um), columns, provenance)
    xy_um, ring_offsets, site_offsets = (arrays[name] for name in OUTLINES)
    has_holes = np.diff(site_offsets) > 1
    if has_holes.any():
        check_sizes(np.diff(site_offsets)[has_holes], np.diff(ring_offsets[site_offsets])[has_holes])
    return Layout(xy_um, ring_offsets, site_offsets, columns, provenance)


def is_layout_array(name: str) -> bool:
    """Return whether an array of this name belongs to a layout."""
    return name in OUTLINES or name.startswith(COLUMN_PREFIX)
