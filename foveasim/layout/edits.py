"""
Composing layouts: join, cut to a region, set sites apart, merge, split, put on a manufacturing grid.

Every edit takes a layout and gives a new one; columns go with their sites, and the provenance notes the step. Regions are
shapely polygons in µm.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.validation import (
    MAX_LENGTH_UM,
    Ints,
    check_choice,
    check_count,
    check_length_um,
    check_sites,
    finite_array,
    unmasked,
)
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout._noding import points_on_edges
from foveasim.layout._regions import as_region
from foveasim.layout.adjacency import TOUCHING_UM, adjacency
from foveasim.layout.drc.measurements import is_below_size
from foveasim.layout.model import INTEGER_RANGES, Layout

__all__ = ["clip", "cut_out", "inset", "joining_groups", "merge", "merge_small", "node", "snap", "split", "union"]

#: A piece of a site smaller than this fraction of it is rounding at the border of a cut.
SLIVER = 1e-9


def union(layouts: Sequence[Layout]) -> Layout:
    """
    One layout of the sites of several, in their order.

    Parameters
    ----------
    layouts : sequence of Layout

    Returns
    -------
    Layout
        With the columns that all of them have. Whether sites overlap is not looked at: check the rule ``max_overlap_um2``.

    Raises
    ------
    ParameterError
        When there is none, one is no layout, or no type contains all integers of a column.
    """
    layouts = list(layouts)
    if not layouts or not all(isinstance(layout, Layout) for layout in layouts):
        raise ParameterError("layouts", "must be one or more layouts", layouts)
    check_sites(sum(layout.n_sites for layout in layouts) or 1)
    names = set.intersection(*(set(layout.columns) for layout in layouts))
    return Layout._derived(  # noqa: SLF001 -- of the same room
        np.concatenate([layout.xy_um for layout in layouts]),
        _joined([layout.ring_offsets for layout in layouts]),
        _joined([layout.site_offsets for layout in layouts]),
        {name: _joined_columns(name, [layout.columns[name] for layout in layouts]) for name in sorted(names)},
        {"made_by": "union", "parts": [dict(layout.provenance) for layout in layouts]},
    )


def clip(layout: Layout, region: Any, *, cut: Literal["pieces", "drop"] = "pieces") -> Layout:
    """
    The part of a layout inside a region.

    Parameters
    ----------
    layout : Layout
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm
        A die, a zone, an image circle.
    cut : {"pieces", "drop"}
        What becomes of sites that the border cuts: their pieces inside, each a site of its own; or nothing.

    Returns
    -------
    Layout

    Raises
    ------
    ParameterError
        When the region is no valid polygon.
    """
    return _kept(layout, as_region("region", region), shapely.intersection, shapely.covers, cut, "clipped to a region")


def cut_out(layout: Layout, region: Any, *, cut: Literal["pieces", "drop"] = "pieces") -> Layout:
    """
    The part of a layout outside a region; parameters and errors as for :func:`clip`.

    Parameters
    ----------
    layout : Layout
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm
        What is taken out: room for a circuit, a fiducial mark, a fovea to be filled.
    cut : {"pieces", "drop"}
        As for :func:`clip`.
    """
    return _kept(layout, as_region("region", region), shapely.difference, shapely.disjoint, cut, "punched by a region")


def inset(layout: Layout, margin_um: ArrayLike) -> Layout:
    """
    Every site with its border moved inwards: a trench of twice the margin between neighbours.

    Parameters
    ----------
    layout : Layout
    margin_um : number or (n_site,), µm
        How far each border moves. Corners stay sharp.

    Returns
    -------
    Layout

    Raises
    ------
    GeometryError
        When a site would vanish or fall into parts; ``.site_ids`` names them.
    ParameterError
        When a margin is negative.
    """
    margins_um = finite_array("margin_um", margin_um, at_least=0.0)
    if margins_um.ndim > 1 or (margins_um.ndim == 1 and margins_um.size != layout.n_sites):
        raise ParameterError("margin_um", f"must be one number, or one for each of the {layout.n_sites} sites")
    shrunk = shapely.buffer(layout.polygons(), -margins_um, join_style="mitre", mitre_limit=100.0)
    gone = np.flatnonzero(shapely.is_empty(shrunk) | (shapely.get_type_id(shrunk) != shapely.GeometryType.POLYGON))
    if gone.size:
        raise GeometryError(
            f"site {gone[0]} would vanish or fall into parts{f' (and {gone.size - 1} more)' if gone.size > 1 else ''}: it is "
            "too narrow for the margin",
            tuple(int(i) for i in gone),
        )
    return _rebuilt(layout, shrunk, np.arange(layout.n_sites), "inset")


def merge(layout: Layout, groups: ArrayLike) -> Layout:
    """
    Sites of the same group made into one: binning, wells shared by sub-pixels.

    Parameters
    ----------
    layout : Layout
    groups : (n_site,) int
        Group of each site, at least 0.

    Returns
    -------
    Layout
        One site a group, in the order of the groups' numbers, with the columns of each group's first site.

    Raises
    ------
    GeometryError
        When the sites of a group do not hang together; ``.site_ids`` names them.
    ParameterError
        When there is not one group a site.
    """
    labels = np.asarray(unmasked("groups", groups))
    if labels.shape != (layout.n_sites,) or labels.dtype.kind not in "iu" or labels.min(initial=0) < 0:
        raise ParameterError("groups", f"must be {layout.n_sites} integers from 0, one per site", groups)
    _, first, group, count = np.unique(labels, return_index=True, return_inverse=True, return_counts=True)
    # One row a group, filled up with nothing, so that GEOS joins all groups in one call.
    order = np.argsort(group, kind="stable")
    rows = np.full((count.size, int(count.max(initial=1))), None, dtype=object)
    rows[group[order], positions_in_runs(count)] = layout.polygons()[order]
    joined = shapely.union_all(rows, axis=1) if count.size else np.zeros(0, dtype=object)
    apart = shapely.get_type_id(joined) != shapely.GeometryType.POLYGON
    # Edges that were cut apart are neighbours' up to rounding: on a fine grid they are one.
    joined[apart] = shapely.union_all(rows[apart], axis=1, grid_size=TOUCHING_UM)
    apart = shapely.get_type_id(joined) != shapely.GeometryType.POLYGON
    if apart.any():
        bad = np.flatnonzero(apart[group])
        raise GeometryError(
            f"site {bad[0]} does not hang together with the other sites of its group", tuple(int(i) for i in bad)
        )
    return _rebuilt(layout, joined, first, "merged by groups")


def merge_small(layout: Layout, *, min_size_um: float) -> Layout:
    """
    Sites below a size made part of the neighbour with which they share most edge, as often as it takes.

    Parameters
    ----------
    layout : Layout
    min_size_um : float, µm
        Smallest size, the square root of a site's area. Sites that the design rule ``min_size_um`` accepts stay as they
        are.

    Returns
    -------
    Layout
        In the order of each site's first part, with that part's columns. A small site without neighbours stays.

    Raises
    ------
    ParameterError
        When the size is not positive.
    """
    min_size_um = check_length_um("min_size_um", min_size_um)
    while True:
        small = np.flatnonzero(is_below_size(layout.area_um2, min_size_um))
        groups = joining_groups(layout, small[np.argsort(layout.area_um2[small], kind="stable")])
        if np.array_equal(groups, np.arange(layout.n_sites)):
            return layout
        layout = merge(layout, groups)


def joining_groups(layout: Layout, small: Ints) -> Ints:
    """
    Groups for :func:`merge` that join each small site, in this order, to the neighbour with which it shares most edge.

    A site is joined once: later ones that need it stay alone for now.
    """
    groups = np.arange(layout.n_sites)
    if small.size == 0:
        return groups
    shared_um = adjacency(layout)
    is_taken = np.zeros(layout.n_sites, bool)
    for site in small.tolist():
        row = slice(shared_um.indptr[site], shared_um.indptr[site + 1])
        others, lengths_um = shared_um.indices[row], shared_um.data[row]
        is_free = ~is_taken[others]
        if is_taken[site] or not is_free.any():
            continue
        partner = int(others[is_free][lengths_um[is_free].argmax()])
        is_taken[[site, partner]] = True
        groups[max(site, partner)] = min(site, partner)
    return groups


def split(layout: Layout, *, n_x: int = 2, n_y: int = 1) -> Layout:
    """
    Every site cut into ``n_x`` by ``n_y`` parts of equal width and height: dual pixels, quad pixels.

    Parameters
    ----------
    layout : Layout
    n_x, n_y : int
        Parts from left to right and from bottom to top of each site's bounding box.

    Returns
    -------
    Layout
        The parts of site 0, then those of site 1, ..., with the columns ``parent`` (the site's number) and ``part``
        (``iy * n_x + ix``).

    Raises
    ------
    ParameterError
        When a number is below 1.
    """
    n_x, n_y = check_count("n_x", n_x, at_most=64), check_count("n_y", n_y, at_most=64)
    check_sites(max(1, layout.n_sites * n_x * n_y))
    box = layout.site_bounds_um[:, np.newaxis, :]
    iy, ix = np.divmod(np.arange(n_x * n_y), n_x)
    # Inner cuts are at the same numbers from both sides; the outermost reach beyond the box.
    x = box[..., 0:1] + (box[..., 2:3] - box[..., 0:1]) * np.arange(n_x + 1) / n_x
    y = box[..., 1:2] + (box[..., 3:4] - box[..., 1:2]) * np.arange(n_y + 1) / n_y
    x[..., 0], x[..., -1], y[..., 0], y[..., -1] = x[..., 0] - 1.0, x[..., -1] + 1.0, y[..., 0] - 1.0, y[..., -1] + 1.0
    frames = shapely.box(x[:, 0, ix], y[:, 0, iy], x[:, 0, ix + 1], y[:, 0, iy + 1])
    parts = shapely.intersection(layout.polygons()[:, np.newaxis], frames)
    parent, part = (index.ravel() for index in np.indices(parts.shape))
    return _pieces(layout.with_columns(parent=np.arange(layout.n_sites)), parts.ravel(), parent, "split", part=part)


def node(layout: Layout) -> Layout:
    """
    The layout with every vertex that lies on a neighbour's edge made a vertex of the neighbour too.

    Parameters
    ----------
    layout : Layout

    Returns
    -------
    Layout
        The same sites. T-junctions have a vertex on both sides afterwards, so that turning, snapping or a chip file's
        database unit can open no gap there.
    """
    points, _ = np.unique(layout.xy_um, axis=0, return_index=True)
    after = next_vertex(layout.ring_offsets)
    begin, end = layout.xy_um, layout.xy_um[after]
    edge, point, t = points_on_edges(points, begin, end)
    # The new vertices come behind the edge's first one, in the order along it.
    owner = np.concatenate((np.arange(begin.shape[0]), edge))
    order = np.lexsort((np.concatenate((np.zeros(begin.shape[0]), t)), owner))
    n_new = np.bincount(edge, minlength=begin.shape[0])
    return Layout._derived(  # noqa: SLF001 -- of the same room
        np.concatenate((begin, points[point]))[order],
        np.concatenate(([0], np.cumsum(n_new + 1)))[layout.ring_offsets],
        layout.site_offsets,
        layout.columns,
        layout._then("noded"),  # noqa: SLF001 -- of the same room
    )


def snap(layout: Layout, grid_um: float) -> Layout:
    """
    The layout with every vertex on a manufacturing grid.

    Parameters
    ----------
    layout : Layout
    grid_um : float, µm
        Every coordinate becomes a multiple of it: 0.005 for the 5 nm of many processes.

    Returns
    -------
    Layout
        Neighbours that shared a vertex share the snapped one, and vertices on a neighbour's edge are shared first
        (:func:`node`): nothing is opened, and nothing covered twice.

    Raises
    ------
    GeometryError
        When a site has no area left on the grid, or crosses itself.
    ParameterError
        When the grid is not positive.
    """
    grid_um = check_length_um("grid_um", grid_um, at_most=MAX_LENGTH_UM)
    noded = node(layout)
    xy_um = np.round(noded.xy_um / grid_um) * grid_um
    snapped = Layout.from_polygons((xy_um, noded.ring_offsets, noded.site_offsets))
    return Layout(
        snapped.xy_um,
        snapped.ring_offsets,
        snapped.site_offsets,
        layout.columns,
        layout._then(f"snapped to {grid_um:g} µm"),  # noqa: SLF001 -- of the same room
    )


# -- parts ---------------------------------------------------------------------------------------------------------------


def _joined(offsets: Sequence[Ints]) -> Ints:
    steps = np.concatenate([np.diff(part) for part in offsets])
    return np.concatenate(([0], np.cumsum(steps)))


def _joined_columns(name: str, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Parts of a column one after the other; signed and unsigned integers exactly, of which numpy makes floats."""
    if {part.dtype.kind for part in parts} == {"i", "u"} and np.result_type(*parts).kind == "f":
        used = [part for part in parts if part.size]
        low, high = (min(int(p.min()) for p in used), max(int(p.max()) for p in used)) if used else (0, 0)
        if low < 0 and high >= 2**63:
            raise ParameterError(name, f"must contain {INTEGER_RANGES}", high)
        parts = [part.astype(np.int64 if high < 2**63 else np.uint64) for part in parts]
    return np.concatenate(parts)


def _kept(layout: Layout, region: Any, operation: Any, keeps_whole: Any, cut: str, step: str) -> Layout:
    check_choice("cut", cut, ("pieces", "drop"))
    shapely.prepare(region)
    polygons = layout.polygons()
    is_whole = keeps_whole(region, polygons)
    if cut == "drop":
        return layout[is_whole]
    pieces = polygons.copy()
    pieces[~is_whole] = operation(polygons[~is_whole], region)
    return _pieces(layout, pieces, np.arange(layout.n_sites), step)


def _pieces(layout: Layout, shapes: NDArray[Any], parent: Ints, step: str, **columns: NDArray[Any]) -> Layout:
    """Layout of all polygons that shapes consist of, each with the columns of its parent site."""
    parts, shape = shapely.get_parts(shapes, return_index=True)
    is_real = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (
        shapely.area(parts) > SLIVER * layout.area_um2[parent[shape]]
    )
    own = {name: values[shape[is_real]] for name, values in columns.items()}
    rebuilt = _rebuilt(layout, parts[is_real], parent[shape[is_real]], step)
    return Layout._derived(  # noqa: SLF001
        rebuilt.xy_um, rebuilt.ring_offsets, rebuilt.site_offsets, {**rebuilt.columns, **own}, rebuilt.provenance
    )


def _rebuilt(layout: Layout, polygons: NDArray[Any], parent: Ints, step: str) -> Layout:
    """Layout of these polygons, each with the columns of its parent site."""
    rings = Layout.from_polygons(polygons)
    columns = {name: values[parent] for name, values in layout.columns.items()}
    return Layout._derived(rings.xy_um, rings.ring_offsets, rings.site_offsets, columns, layout._then(step))  # noqa: SLF001
