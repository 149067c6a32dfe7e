"""
Edits of all sites of layouts: union, clip, cut out, inset, merge, split, node, snap.

Each function returns a new layout: sites retain their columns, and the provenance records the step. Regions are shapely
polygons in µm.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import LENGTH, Limits
from foveasim._core.rings import positions_in_runs, shrink_polygons
from foveasim._core.validation import Bools, Ints, check_per_site, check_sites, finite_array, unmasked
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout._noding import insert_points
from foveasim.layout._regions import as_region
from foveasim.layout.adjacency import TOUCHING_UM, adjacency
from foveasim.layout.drc.measurements import is_below_size
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.edits._parts import SLIVER, concatenate_layouts, replace_sites, separate_parts
from foveasim.layout.model import INTEGER_RANGES, Layout, derived, layout_of

__all__ = ["clip", "cut_out", "inset", "joining_groups", "merge", "merge_small", "node", "snap", "split", "union"]

PARTS = Limits(at_least=1, at_most=64)
#: Relative area below which a union lacks a polygon.
AREA_ROUNDING = 1e-9


def union(layouts: Iterable[Layout]) -> Layout:
    """
    Concatenate the sites of several layouts, in order.

    Parameters
    ----------
    layouts : iterable of Layout

    Returns
    -------
    Layout
        With the columns that all of them have. Overlaps are not checked: use the rule ``max_overlap_um2``.

    Raises
    ------
    ParameterError
        When the sequence is empty or contains another object, or no integer type fits all values of a column.

    Examples
    --------
    >>> import foveasim as fs
    >>> left, right = (
    ...     fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0).translate(x_um, 0.0)
    ...     for x_um in (-5.0, 5.0)
    ... )
    >>> fs.layout.union([left, right]).n_sites
    8
    """
    layouts = list(layouts)
    if not layouts or not all(isinstance(layout, Layout) for layout in layouts):
        raise ParameterError("layouts", "must be one or more layouts", layouts)
    check_sites(sum(layout.n_sites for layout in layouts) or 1)
    names = set.intersection(*(set(layout.columns) for layout in layouts))
    return layout_of(
        *concatenate_layouts(layouts),
        {name: _concatenate_columns(name, [layout.columns[name] for layout in layouts]) for name in sorted(names)},
        {"made_by": "union", "parts": [dict(layout.provenance) for layout in layouts]},
    )


@layout_edit(example={"region": [[-10.0, -10.0], [15.0, -10.0], [0.0, 15.0]]})
def clip(layout: Layout, region: Any, *, cut: Literal["pieces", "drop"] = "pieces") -> Layout:
    """
    Return the part of a layout inside a region.

    Parameters
    ----------
    layout : Layout
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm
        A die, a zone, an image circle.
    cut : {"pieces", "drop"}
        Result for sites that the boundary cuts: their pieces inside, each a separate site; or none.

    Raises
    ------
    ParameterError
        When the region is not a valid polygon.

    Examples
    --------
    >>> import foveasim as fs
    >>> import shapely
    >>> layout = fs.layout.grid(n_x=10, n_y=10, pitch_um=2.0)
    >>> fs.layout.clip(layout, shapely.Point(0, 0).buffer(6.0), cut="drop").n_sites
    16
    """
    return _clip_sites(
        layout, as_region("region", region), shapely.intersection, shapely.covers, cut, "clipped to a region"
    )


@layout_edit(example={"region": [[-10.0, -10.0], [15.0, -10.0], [0.0, 15.0]]})
def cut_out(layout: Layout, region: Any, *, cut: Literal["pieces", "drop"] = "pieces") -> Layout:
    """
    Return the part of a layout outside a region; parameters and errors as for :func:`clip`.

    Parameters
    ----------
    layout : Layout
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm
        Area to remove: for a circuit, a fiducial mark, or a fovea that is filled later.
    cut : {"pieces", "drop"}
        As for :func:`clip`.

    Examples
    --------
    >>> import foveasim as fs
    >>> import shapely
    >>> layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    >>> fs.layout.cut_out(layout, shapely.box(-2.0, -2.0, 2.0, 2.0)).n_sites
    12
    """
    return _clip_sites(layout, as_region("region", region), shapely.difference, shapely.disjoint, cut, "region cut out")


@layout_edit(example={"margin_um": 1.0})
def inset(layout: Layout, margin_um: ArrayLike) -> Layout:
    """
    Offset the boundary of each site inwards, for trenches of twice the margin.

    Parameters
    ----------
    layout : Layout
    margin_um : number or (n_site,), µm
        Inward offset of the boundary. Corners remain sharp.

    Raises
    ------
    GeometryError
        When a site would vanish or split into parts; ``.site_ids`` are their indices.
    ParameterError
        When a margin is negative.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.inset(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), 0.1
    ... )  # a trench of 0.2 µm
    >>> layout.area_um2.round(4).tolist()
    [3.24, 3.24]
    """
    margins_um = finite_array("margin_um", margin_um, at_least=0.0)
    check_per_site("margin_um", margins_um, layout.n_sites, or_one=True)
    shrunk, bad = shrink_polygons(layout.polygons(), margins_um)
    if bad.size:
        raise GeometryError(
            f"site {bad[0]} would vanish or split into parts{f' (and {bad.size - 1} more)' if bad.size > 1 else ''}: it is "
            "too narrow for the margin",
            tuple(int(i) for i in bad),
        )
    return _rebuild(layout, shrunk, np.arange(layout.n_sites), "inset")


def merge(layout: Layout, groups: ArrayLike) -> Layout:
    """
    Merge the sites of each group into one, for binning or wells shared by sub-pixels.

    Parameters
    ----------
    layout : Layout
    groups : (n_site,) int
        Group of each site, at least 0.

    Returns
    -------
    Layout
        One site per group, in the order of the group numbers, with the columns of the first site of each group.

    Raises
    ------
    GeometryError
        When the sites of a group are not connected; ``.site_ids`` are their indices.
    ParameterError
        When ``groups`` does not contain one non-negative integer per site.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=4, n_y=1, pitch_um=2.0)
    >>> fs.layout.merge(layout, [0, 0, 1, 1]).area_um2.tolist()  # binning of pairs
    [8.0, 8.0]
    """
    labels = np.asarray(unmasked("groups", groups))
    if labels.shape != (layout.n_sites,) or labels.dtype.kind not in "iu" or labels.min(initial=0) < 0:
        raise ParameterError("groups", f"must be {layout.n_sites} integers >= 0, one per site", groups)
    _, first, group, count = np.unique(labels, return_index=True, return_inverse=True, return_counts=True)
    # One row per group, padded with None, so that GEOS merges all groups in one call.
    order = np.argsort(group, kind="stable")
    rows = np.full((count.size, int(count.max(initial=1))), None, dtype=object)
    rows[group[order], positions_in_runs(count)] = layout.polygons()[order]
    joined = shapely.union_all(rows, axis=1) if count.size else np.zeros(0, dtype=object)
    # Shared edges that coincide only within rounding leave gaps, which are closed on a fine grid. GEOS 3.14 can omit polygons
    # whose vertices are 1e-5 µm apart.
    is_incomplete = shapely.area(joined) < (1.0 - AREA_ROUNDING) * np.bincount(group, layout.area_um2, count.size)
    has_gaps = (shapely.get_type_id(joined) != shapely.GeometryType.POLYGON) | _has_slivers(joined) | is_incomplete
    joined[has_gaps] = shapely.union_all(rows[has_gaps], axis=1, grid_size=TOUCHING_UM)
    is_disconnected = shapely.get_type_id(joined) != shapely.GeometryType.POLYGON
    if is_disconnected.any():
        bad = np.flatnonzero(is_disconnected[group])
        raise GeometryError(
            f"site {bad[0]} must be connected to the other sites of its group", tuple(int(i) for i in bad)
        )
    return _rebuild(layout, joined, first, "merged by groups")


def _has_slivers(shapes: NDArray[Any]) -> Bools:
    """Whether polygons have holes without area, within rounding, (n,)."""
    has_slivers = np.zeros(shapes.size, bool)
    rings, index = shapely.get_rings(shapes, return_index=True)
    is_hole = np.zeros(index.size, bool)
    is_hole[1:] = index[1:] == index[:-1]
    shape = index[is_hole]
    area_um2 = shapely.area(shapely.polygons(rings[is_hole]))
    has_slivers[shape[area_um2 <= SLIVER * shapely.area(shapes)[shape]]] = True
    return has_slivers


@layout_edit(example={"min_size_um": 12.0})
def merge_small(layout: Layout, *, min_size_um: Annotated[float, LENGTH]) -> Layout:
    """
    Merge each site below a size with the neighbour of the longest shared edge, repeatedly.

    Parameters
    ----------
    layout : Layout
    min_size_um : float, µm
        Minimum size, the square root of the area of a site. Sites that satisfy the design rule ``min_size_um`` are
        unchanged.

    Returns
    -------
    Layout
        In the order of the first part of each site, with its columns. A small site without neighbours is unchanged.

    Raises
    ------
    ParameterError
        When the size is not positive.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.split_at(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), [(1.0, 0.0)], n_x=4
    ... )
    >>> fs.layout.merge_small(layout, min_size_um=1.2).area_um2.tolist()
    [5.0, 3.0]
    """
    while True:
        small = np.flatnonzero(is_below_size(layout.area_um2, min_size_um))
        groups = joining_groups(layout, small[np.argsort(layout.area_um2[small], kind="stable")])
        if np.array_equal(groups, np.arange(layout.n_sites)):
            return layout
        layout = merge(layout, groups)


def joining_groups(layout: Layout, small: Ints) -> Ints:
    """
    Return groups for :func:`merge` that join each small site to a neighbour, in order.

    The neighbour is the one with the longest shared edge. A site is joined at most once: later small sites that require it
    remain single.
    """
    groups = np.arange(layout.n_sites)
    if small.size == 0:
        return groups
    shared_um = adjacency(layout)
    is_joined = np.zeros(layout.n_sites, bool)
    for site in small.tolist():
        row = slice(shared_um.indptr[site], shared_um.indptr[site + 1])
        others, lengths_um = shared_um.indices[row], shared_um.data[row]
        is_free = ~is_joined[others]
        if is_joined[site] or not is_free.any():
            continue
        partner = int(others[is_free][lengths_um[is_free].argmax()])
        is_joined[[site, partner]] = True
        groups[max(site, partner)] = min(site, partner)
    return groups


@layout_edit(example={"n_x": 2})
def split(layout: Layout, *, n_x: Annotated[int, PARTS] = 2, n_y: Annotated[int, PARTS] = 1) -> Layout:
    """
    Split each site into ``n_x`` by ``n_y`` parts, for dual pixels and quad pixels.

    Parameters
    ----------
    layout : Layout
    n_x, n_y : int
        Number of parts from left to right and from bottom to top, of equal width and height in the bounding box of each
        site.

    Returns
    -------
    Layout
        The parts of site 0, then those of site 1, ..., with the columns ``parent`` (index of the site) and ``part``
        (``iy * n_x + ix``).

    Raises
    ------
    ParameterError
        When a number is below 1.

    Examples
    --------
    >>> import foveasim as fs
    >>> dual = fs.layout.split(fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), n_x=2)
    >>> dual.n_sites, dual.area_um2.tolist()
    (4, [2.0, 2.0, 2.0, 2.0])
    """
    check_sites(max(1, layout.n_sites * n_x * n_y))
    box = layout.site_bounds_um[:, np.newaxis, :]
    iy, ix = np.divmod(np.arange(n_x * n_y), n_x)
    # Inner cuts have identical coordinates on both sides; the outermost lie outside the box.
    x = box[..., 0:1] + (box[..., 2:3] - box[..., 0:1]) * np.arange(n_x + 1) / n_x
    y = box[..., 1:2] + (box[..., 3:4] - box[..., 1:2]) * np.arange(n_y + 1) / n_y
    x[..., 0], x[..., -1], y[..., 0], y[..., -1] = x[..., 0] - 1.0, x[..., -1] + 1.0, y[..., 0] - 1.0, y[..., -1] + 1.0
    frames = shapely.box(x[:, 0, ix], y[:, 0, iy], x[:, 0, ix + 1], y[:, 0, iy + 1])
    parts = shapely.intersection(layout.polygons()[:, np.newaxis], frames)
    parent, part = (index.ravel() for index in np.indices(parts.shape))
    pieces, shape = separate_parts(layout, parts.ravel(), parent)
    marked = layout.with_columns(parent=np.arange(layout.n_sites), part=np.zeros(layout.n_sites, np.int64))
    return replace_sites(marked, np.arange(layout.n_sites), pieces, parent[shape], "split", {"part": part[shape]})


@layout_edit(example={})
def node(layout: Layout) -> Layout:
    """
    Insert each vertex that lies on the edge of a neighbour into that edge.

    Parameters
    ----------
    layout : Layout

    Returns
    -------
    Layout
        The same sites. T-junctions have a vertex on both sides afterwards, so rotation, snapping and the database unit of
        a GDSII file do not open gaps there.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles(
    ...     [[0.0, 0.0], [3.0, 0.0]], [[4.0, 4.0], [2.0, 2.0]]
    ... )
    >>> fs.layout.node(layout).xy_um.shape[
    ...     0
    ... ]  # the corners of the small square are vertices of the large one, too
    10
    """
    xy_um, ring_offsets, _ = insert_points(layout.xy_um, layout.ring_offsets, np.unique(layout.xy_um, axis=0))
    return derived(layout, "noded", (xy_um, ring_offsets, layout.site_offsets))


@layout_edit(example={"grid_um": 0.5})
def snap(layout: Layout, grid_um: Annotated[float, LENGTH]) -> Layout:
    """
    Snap each vertex to a manufacturing grid.

    Parameters
    ----------
    layout : Layout
    grid_um : float, µm
        Coordinates are rounded to multiples of it: 0.005 for the 5 nm of many processes.

    Returns
    -------
    Layout
        Neighbours that share a vertex share the snapped one, and vertices on the edge of a neighbour are inserted first
        (:func:`node`): no gaps and no overlaps arise.

    Raises
    ------
    GeometryError
        When a snapped site has no area, or crosses itself.
    ParameterError
        When the grid is not positive.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.snap(
    ...     fs.layout.hexagonal(n_columns=1, n_rows=1, pitch_um=3.0), 0.005
    ... )
    >>> layout.xy_um[:2].tolist()
    [[1.5, -0.865], [1.5, 0.865]]
    """
    noded = node(layout)
    xy_um = np.round(noded.xy_um / grid_um) * grid_um
    snapped = Layout.from_polygons((xy_um, noded.ring_offsets, noded.site_offsets))
    return derived(layout, f"snapped to {grid_um:g} µm", snapped.rings_um)


# -- parts ---------------------------------------------------------------------------------------------------------------


def _concatenate_columns(name: str, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate parts of a column; signed and unsigned integers remain exact."""
    if {part.dtype.kind for part in parts} == {"i", "u"} and np.result_type(*parts).kind == "f":
        used = [part for part in parts if part.size]
        low, high = (min(int(p.min()) for p in used), max(int(p.max()) for p in used)) if used else (0, 0)
        if low < 0 and high >= 2**63:
            raise ParameterError(name, f"must contain {INTEGER_RANGES}", high)
        parts = [part.astype(np.int64 if high < 2**63 else np.uint64) for part in parts]
    return np.concatenate(parts)


def _clip_sites(layout: Layout, region: Any, operation: Any, predicate: Any, cut: str, step: str) -> Layout:
    shapely.prepare(region)
    polygons = layout.polygons()
    changed = np.flatnonzero(~predicate(region, polygons))
    if cut == "drop":
        return layout[np.delete(np.arange(layout.n_sites), changed)]
    parts, shape = separate_parts(layout, operation(polygons[changed], region), changed)
    return replace_sites(layout, changed, parts, changed[shape], step)


def _rebuild(layout: Layout, polygons: NDArray[Any], parent: Ints, step: str) -> Layout:
    """Return the layout of these polygons, each with the columns of its parent site."""
    columns = {name: values[parent] for name, values in layout.columns.items()}
    return derived(layout, step, Layout.from_polygons(polygons).rings_um, columns)
