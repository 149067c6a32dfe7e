"""Edits that add sites: drawn outlines, and layouts as layers with boolean operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.calls import NOT_NEGATIVE, Limits
from foveasim._core.validation import MAX_LENGTH_UM, Ints, check_sites
from foveasim.errors import ParameterError
from foveasim.layout._regions import as_region
from foveasim.layout.adjacency import TOUCHING_UM
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.edits._parts import replace_sites, separate_parts
from foveasim.layout.edits.all_sites import clip, cut_out
from foveasim.layout.model import Layout

__all__ = ["draw", "overlay"]


@layout_edit(example={"outlines_um": [[[-4.0, -4.0], [6.0, -4.0], [0.0, 7.0]]], "channel": 1})
def draw(
    layout: Layout,
    outlines_um: Sequence[Any],
    *,
    channel: Annotated[int | None, NOT_NEGATIVE] = None,
    overlap: Literal["cut", "fill", "keep"] = "cut",
) -> Layout:
    """
    Add sites with given outlines.

    Parameters
    ----------
    layout : Layout
    outlines_um : sequence of (n, 2) vertices or shapely polygons, µm
    channel : int, optional
        Index of the colour filter; by default that of the nearest site.
    overlap : {"cut", "fill", "keep"}
        ``"cut"`` removes the area of the outlines from existing sites, ``"fill"`` the area of existing sites from the
        outlines; ``"keep"`` permits overlaps.

    Returns
    -------
    Layout
        The new sites are the last ones. They have the columns of the nearest site.

    Raises
    ------
    ParameterError
        When an outline is not a valid polygon, or no area of the outlines remains.

    Examples
    --------
    >>> import foveasim as fs
    >>> import shapely
    >>> layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)
    >>> drawn = fs.layout.draw(
    ...     layout, [shapely.box(-1.5, -1.5, 1.5, 1.5)]
    ... )  # the others lose what it covers
    >>> drawn.n_sites, float(drawn.area_um2.sum())
    (9, 36.0)
    """
    if isinstance(outlines_um, str) or not isinstance(outlines_um, Sequence | np.ndarray) or len(outlines_um) == 0:
        raise ParameterError("outlines_um", "must be a list of one or more outlines")
    check_sites(layout.n_sites + len(outlines_um))
    regions = np.array([as_region(f"outlines_um[{i}]", outline) for i, outline in enumerate(outlines_um)], dtype=object)
    shapes = shapely.get_parts(regions)
    if overlap == "cut":
        layout = _without(layout, shapely.union_all(shapes))
    elif overlap == "fill":
        shapes, _ = _parts_outside(shapes, layout, 0.0)
        if shapes.size == 0:
            raise ParameterError("outlines_um", "must contain an area outside existing sites", hint="use overlap: cut")
    drawn = Layout.from_polygons(shapes)
    if channel is not None:
        layout = layout if "channel" in layout.columns else layout.with_columns(channel=layout.channel)
        drawn = drawn.with_columns(channel=np.full(drawn.n_sites, channel))
    return _append(layout, drawn, f"{drawn.n_sites} sites drawn")


@layout_edit(
    example={"layer": Layout.from_rectangles([[-4.0, 0.0], [4.0, 0.0]], 8.0), "operation": "replace", "margin_um": 1.0}
)
def overlay(
    layout: Layout,
    layer: Layout,
    *,
    operation: Literal["replace", "fill", "union", "clip", "cut_out"] = "replace",
    margin_um: Annotated[float, Limits(at_least=0.0, at_most=MAX_LENGTH_UM)] = 0.0,
    region: Any = None,
) -> Layout:
    """
    Combine a layout with another one as layer.

    Parameters
    ----------
    layout : Layout
    layer : Layout
    operation : {"replace", "fill", "union", "clip", "cut_out"}
        ``"replace"`` removes the area of the layer from the sites, and adds those of the layer: a fovea in a periphery.
        ``"fill"`` adds the parts of the layer where there are no sites: a periphery around a fovea. ``"union"`` adds all sites
        of the layer; overlaps are possible. ``"clip"`` returns the sites inside the area of the layer, ``"cut_out"`` those
        outside.
    margin_um : float, µm
        Distance by which the area of the layer, or for ``"fill"`` that of the sites, is enlarged: a trench, or for ``"clip"``
        a larger area.
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm, optional
        The part of the layer inside it is used, with the pieces of sites that its boundary cuts; by default the whole layer.

    Returns
    -------
    Layout
        Sites of the layer are the last ones. Columns that the layer does not have are those of the nearest site.

    Raises
    ------
    ParameterError
        When the layer has no sites, also in the region, or no site remains.

    Examples
    --------
    >>> import foveasim as fs
    >>> coarse = fs.layout.grid(n_x=4, n_y=4, pitch_um=4.0)
    >>> fine = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    >>> both = fs.layout.overlay(coarse, fine)  # a fine centre
    >>> both.n_sites, float(both.area_um2.sum())
    (28, 256.0)
    """
    if layer.n_sites == 0:
        raise ParameterError("layer", "must be a layout with sites", layer)
    if region is not None:
        layer = clip(layer, region)
        if layer.n_sites == 0:
            raise ParameterError("region", "must contain a part of the layer")
    check_sites(layout.n_sites + layer.n_sites)
    if operation == "fill":
        polygons = layer.polygons()
        parts, site = _parts_outside(polygons, layout, margin_um)
        added = replace_sites(layer, np.arange(layer.n_sites), parts, site, "filled") if site.size else layer[:0]
        return _append(layout, added, f"filled with {added.n_sites} sites of {_origin(layer)}")
    if operation == "union":
        return _append(layout, layer, f"{layer.n_sites} sites of {_origin(layer)} added")
    area = _area(layer, margin_um)
    if operation in ("clip", "cut_out"):
        found = (clip if operation == "clip" else cut_out)(layout, area)
        if found.n_sites == 0:
            raise ParameterError("layer", f"must leave at least one site after {operation}")
        return found
    return _append(_without(layout, area), layer, f"{layer.n_sites} sites of {_origin(layer)} set in")


def _origin(layer: Layout) -> str:
    return str(layer.provenance.get("generator", layer.provenance.get("made_by", "a layout")))


def _area(layout: Layout, margin_um: float) -> Any:
    """Return the area of all sites, enlarged by a margin."""
    polygons = layout.polygons()
    if margin_um:
        polygons = shapely.buffer(polygons, margin_um, join_style="mitre")
    return shapely.union_all(polygons)


def _without(layout: Layout, area: Any) -> Layout:
    """Return a layout without an area; sites outside are unchanged."""
    low_x, low_y, high_x, high_y = area.bounds
    box = layout.site_bounds_um
    near = np.flatnonzero((box[:, 0] < high_x) & (box[:, 2] > low_x) & (box[:, 1] < high_y) & (box[:, 3] > low_y))
    polygons = layout[near].polygons()
    shapely.prepare(area)
    is_cut = shapely.intersects(area, polygons) & ~shapely.touches(area, polygons)
    near, polygons = near[is_cut], polygons[is_cut]
    # Vertices of the area that lie on an outline up to rounding would leave necks of this width.
    is_crossed = ~shapely.contains_properly(area, polygons)
    polygons[is_crossed] = shapely.snap(polygons[is_crossed], area, TOUCHING_UM)
    parts, shape = separate_parts(layout, shapely.difference(polygons, area), near)
    parts = shapely.remove_repeated_points(parts, TOUCHING_UM)
    return replace_sites(layout, near, parts, near[shape], f"area of {near.size} sites cut out")


def _parts_outside(polygons: NDArray[Any], layout: Layout, margin_um: float) -> tuple[NDArray[Any], Ints]:
    """Return the parts of polygons outside all sites of a layout, and the polygon of each."""
    if layout.n_sites == 0:
        return polygons, np.arange(polygons.size)
    area = _area(layout, margin_um)
    shapely.prepare(area)
    shapes = polygons.copy()
    is_cut = shapely.intersects(area, polygons)
    shapes[is_cut] = shapely.difference(polygons[is_cut], area)
    parts, shape = separate_parts(Layout.from_polygons(polygons), shapes, np.arange(polygons.size))
    return shapely.remove_repeated_points(parts, TOUCHING_UM), shape


def _append(layout: Layout, added: Layout, step: str) -> Layout:
    """Return a layout with the sites of another one at its end, with values in all columns."""
    if "channel" in added.columns and "channel" not in layout.columns:
        layout = layout.with_columns(channel=layout.channel)
    nearest = _nearest_sites(layout, added)
    columns = {}
    for name, values in layout.columns.items():
        own = added.columns.get(name)
        if own is not None and (own.dtype.kind in "biuf") == (values.dtype.kind in "biuf"):
            columns[name] = own
        else:
            columns[name] = values[nearest] if layout.n_sites else np.zeros(added.n_sites, values.dtype)
    end = np.full(added.n_sites, layout.n_sites)
    rings = (added.xy_um, added.ring_offsets, added.site_offsets)
    return replace_sites(layout, np.zeros(0, np.int64), rings, end, step, columns)


def _nearest_sites(layout: Layout, added: Layout) -> Ints:
    """Return the site whose centroid is nearest to that of each added site."""
    from scipy.spatial import cKDTree

    if layout.n_sites == 0 or added.n_sites == 0:
        return np.zeros(added.n_sites, np.int64)
    return np.asarray(cKDTree(layout.centroid_um).query(added.centroid_um)[1], dtype=np.int64)
