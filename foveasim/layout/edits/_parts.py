"""Replacement of some sites of a layout by other polygons."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.validation import Ints
from foveasim.errors import GeometryError
from foveasim.layout.model import Layout, derived, layout_of

#: Area of a piece, relative to its site, below which it is a rounding artefact of the cut.
SLIVER = 1e-9


def separate_parts(layout: Layout, shapes: NDArray[Any], parent: Ints) -> tuple[NDArray[Any], Ints]:
    """
    Return all polygons of shapes, without slivers.

    ``shapes``: (n,) geometries, µm. ``parent`` (n,) int64: site that each shape belongs to. Returns ``polygons`` (m,) shapely
    polygons. ``shape`` (m,) int64: index of the shape of each polygon.
    """
    parts, shape = shapely.get_parts(shapes, return_index=True)
    is_real = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (
        shapely.area(parts) > SLIVER * layout.area_um2[parent[shape]]
    )
    return parts[is_real], shape[is_real]


def replace_sites(
    layout: Layout,
    sites: Ints,
    polygons: Any,
    parent: Ints,
    step: str,
    columns: Mapping[str, NDArray[Any]] | None = None,
) -> Layout:
    """
    Return a layout with polygons instead of some sites; the other sites are unchanged.

    ``sites`` (n,) int64: sites that are removed. ``polygons`` (m,) shapely polygons, or packed rings, µm: new sites, as for
    :meth:`Layout.from_polygons`. ``parent`` (m,) int64: site whose position and columns each new site has; ``layout.n_sites``
    is the position after all sites. ``step``: step of the provenance. ``columns`` (mapping of str to (m,) array): values of
    the new sites, which replace those of their parents. New sites at the end require all columns. Raises GeometryError when a
    polygon is not a valid site.
    """
    columns = columns or {}
    kept = np.delete(np.arange(layout.n_sites), sites)
    try:
        new = Layout.from_polygons(polygons) if parent.size else layout[:0]
    except GeometryError as error:
        raise GeometryError(
            f"a new outline is invalid: {error}", tuple(parent[list(error.site_ids)].tolist())
        ) from None
    order = np.argsort(np.concatenate((kept, parent)), kind="stable")
    xy_um, ring_offsets, site_offsets = concatenate_layouts([layout[kept], new])
    values = {
        name: np.concatenate(
            (column[kept], columns[name] if name in columns else column[np.minimum(parent, layout.n_sites - 1)])
        ).astype(column.dtype if name not in columns else np.result_type(column, columns[name]), copy=False)
        for name, column in layout.columns.items()
    }
    joined = layout_of(xy_um, ring_offsets, site_offsets, values)[order]
    return derived(layout, step, joined.rings_um, joined.columns)


def concatenate_layouts(layouts: list[Layout]) -> tuple[NDArray[Any], Ints, Ints]:
    """Return the packed rings of several layouts, one after the other."""
    return (
        np.concatenate([layout.xy_um for layout in layouts]),
        _concatenate_offsets([layout.ring_offsets for layout in layouts]),
        _concatenate_offsets([layout.site_offsets for layout in layouts]),
    )


def _concatenate_offsets(offsets: list[Ints]) -> Ints:
    steps = np.concatenate([np.diff(part) for part in offsets])
    return np.concatenate(([0], np.cumsum(steps)))
