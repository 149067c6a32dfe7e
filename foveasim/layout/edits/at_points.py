"""
Edits of the sites, edges and vertices at given points.

Points address sites, so that an edit is valid for every layout with sites at these points.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import shapely
from numpy.typing import ArrayLike

from foveasim._core.calls import LENGTH, NOT_NEGATIVE
from foveasim._core.validation import MAX_LENGTH_UM, Floats, Ints, finite_array
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout._noding import insert_points
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.edits._parts import replace_sites, separate_parts
from foveasim.layout.edits.all_sites import PARTS, merge, split
from foveasim.layout.model import Layout, layout_of

__all__ = [
    "cut_along",
    "merge_at",
    "move_sites",
    "move_vertices",
    "remove_at",
    "remove_vertices",
    "set_channel",
    "sites_at",
    "split_at",
]

#: Distance within which a point is a vertex, or lies on an edge, µm.
VERTEX_UM = 1e-3


def sites_at(layout: Layout, points_um: ArrayLike) -> Ints:
    """
    Return the site at each point.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm

    Returns
    -------
    site : (n,) int64
        Where sites overlap, the last one.

    Raises
    ------
    ParameterError
        When a point lies outside all sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.sites_at(
    ...     fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0), [(0.0, 0.0), (2.0, 2.0)]
    ... ).tolist()
    [4, 8]
    """
    points_um = _points("points_um", points_um)
    candidates = _near(layout, points_um, 0.0)
    tree = shapely.STRtree(layout[candidates].polygons())
    point, found = tree.query(shapely.points(points_um), predicate="intersects")
    site = np.full(points_um.shape[0], -1, np.int64)
    np.maximum.at(site, point, candidates[found])
    if (site < 0).any():
        i = int(np.argmin(site))
        raise ParameterError(f"points_um[{i}]", "must lie in a photosite", points_um[i].tolist(), "µm")
    return site


@layout_edit(example={"points_um": [[-5.0, 5.0]]})
def remove_at(layout: Layout, points_um: ArrayLike) -> Layout:
    """
    Remove the sites at points.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm
        One point in each site.

    Raises
    ------
    ParameterError
        When a point lies outside all sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.remove_at(
    ...     fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0), [(0.0, 0.0)]
    ... ).n_sites
    8
    """
    sites = np.unique(sites_at(layout, points_um))
    none = np.zeros(0, np.int64)
    return replace_sites(layout, sites, none, none, f"{sites.size} sites removed")


@layout_edit(example={"points_um": [[-5.0, 5.0], [5.0, 5.0]]})
def merge_at(layout: Layout, points_um: ArrayLike) -> Layout:
    """
    Merge the sites at points into one.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm
        One point in each site.

    Returns
    -------
    Layout
        The new site has the position and the columns of the first of the merged sites.

    Raises
    ------
    GeometryError
        When the sites are not connected; ``.site_ids`` are their indices.
    ParameterError
        When a point lies outside all sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=3, n_y=1, pitch_um=2.0)
    >>> fs.layout.merge_at(layout, [(0.0, 0.0), (2.0, 0.0)]).n_sites
    2
    """
    sites = np.unique(sites_at(layout, points_um))
    try:
        joined = merge(layout[sites], np.zeros(sites.size, int)).polygons()
    except GeometryError:
        raise GeometryError(
            "the sites at the points must be connected by shared edges; merge fewer sites", tuple(sites.tolist())
        ) from None
    return replace_sites(layout, sites, joined, sites[:1], f"{sites.size} sites merged")


@layout_edit(example={"points_um": [[-5.0, 5.0]], "n_x": 2})
def split_at(
    layout: Layout, points_um: ArrayLike, *, n_x: Annotated[int, PARTS] = 2, n_y: Annotated[int, PARTS] = 1
) -> Layout:
    """
    Split the sites at points into ``n_x`` by ``n_y`` parts.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm
        One point in each site.
    n_x, n_y : int
        Number of parts from left to right and from bottom to top, of equal width and height in the bounding box of each
        site.

    Returns
    -------
    Layout
        The parts have the position and the columns of their site.

    Raises
    ------
    ParameterError
        When a point lies outside all sites, or a number is below 1.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.split_at(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), [(1.0, 0.0)], n_x=2, n_y=2
    ... ).n_sites
    5
    """
    sites = np.unique(sites_at(layout, points_um))
    parts = split(layout[sites], n_x=n_x, n_y=n_y)
    parent = sites[parts.columns["parent"]]
    return replace_sites(layout, sites, parts.polygons(), parent, f"{sites.size} sites split")


@layout_edit(example={"line_um": [[-12.0, -13.0], [12.0, 13.0]]})
def cut_along(layout: Layout, line_um: ArrayLike, *, points_um: ArrayLike | None = None) -> Layout:
    """
    Split sites along a line.

    Parameters
    ----------
    layout : Layout
    line_um : (n, 2), µm
        Vertices of the line. Sites in which it ends are not cut.
    points_um : (m, 2), optional, µm
        One point in each site that is cut; by default all sites that the line crosses.

    Returns
    -------
    Layout
        The parts have the position and the columns of their site.

    Raises
    ------
    ParameterError
        When the line does not cut a site, or a point lies outside all sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0)
    >>> fs.layout.cut_along(layout, [(-2.0, 1.0), (2.0, 1.0)]).area_um2.tolist()
    [4.0, 4.0, 2.0, 2.0, 2.0, 2.0]
    """
    vertices = _points("line_um", line_um, at_least=2)
    line = shapely.LineString(vertices)
    if points_um is None:
        sites = _in_box(layout, vertices.min(axis=0), vertices.max(axis=0))
    else:
        sites = np.unique(sites_at(layout, points_um))
    polygons = layout[sites].polygons()
    is_crossed = shapely.crosses(line, polygons)
    sites, polygons = sites[is_crossed], polygons[is_crossed]
    # The faces of the arrangement of boundary and line that lie in the site.
    faces = [shapely.polygonize(shapely.get_parts(shapely.union(shapely.boundary(p), line))) for p in polygons]
    inside = [
        shapely.multipolygons([f for f in shapely.get_parts(each) if p.contains(f.representative_point())])
        for each, p in zip(faces, polygons, strict=True)
    ]
    is_cut = np.array([shapely.get_num_geometries(each) > 1 for each in inside], bool)
    sites, shapes = sites[is_cut], np.array(inside, dtype=object)[is_cut]
    if sites.size == 0:
        raise ParameterError("line_um", "must cut at least one site from boundary to boundary")
    parts, shape = separate_parts(layout, shapes, sites)
    return replace_sites(layout, sites, parts, sites[shape], f"{sites.size} sites cut along a line")


@layout_edit(example={"points_um": [[15.0, 15.0]], "by_um": [1.0, 2.0]})
def move_sites(layout: Layout, points_um: ArrayLike, by_um: tuple[float, float]) -> Layout:
    """
    Move the sites at points.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm
        One point in each site, before the move.
    by_um : (dx, dy), µm

    Returns
    -------
    Layout
        Vertices of neighbours do not move: gaps and overlaps are possible.

    Raises
    ------
    ParameterError
        When a point lies outside all sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)
    >>> fs.layout.move_sites(layout, [(1.0, 0.0)], (0.5, 0.0)).centroid_um.tolist()
    [[-1.0, 0.0], [1.5, 0.0]]
    """
    sites = np.unique(sites_at(layout, points_um))
    moved = layout[sites].translate(*finite_array("by_um", by_um).tolist())
    return replace_sites(layout, sites, moved.polygons(), sites, f"{sites.size} sites moved")


@layout_edit(example={"from_um": [[0.0, 0.0], [5.0, 10.0]], "to_um": [[2.0, 1.0], [5.0, 12.0]]})
def move_vertices(
    layout: Layout, from_um: ArrayLike, to_um: ArrayLike, *, tolerance_um: Annotated[float, LENGTH] = VERTEX_UM
) -> Layout:
    """
    Move vertices; neighbours that share them remain without gaps and overlaps.

    Parameters
    ----------
    layout : Layout
    from_um : (n, 2), µm
        Vertices, or points on edges, which become vertices of all sites at this edge.
    to_um : (n, 2), µm
        New positions. A vertex that reaches the next one of its outline is removed.
    tolerance_um : float, µm
        Distance within which a point is a vertex or lies on an edge.

    Raises
    ------
    GeometryError
        When an outline would cross itself or vanish; ``.site_ids`` contains the index of its site.
    ParameterError
        When a point is neither a vertex nor on an edge, or the numbers of points differ.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)
    >>> fs.layout.move_vertices(layout, [(0.0, 1.0)], [(0.5, 1.0)]).area_um2.tolist()
    [4.5, 3.5]
    """
    from_um, to_um = _points("from_um", from_um), _points("to_um", to_um)
    if from_um.shape != to_um.shape:
        raise ParameterError("to_um", f"must have one point for each of the {from_um.shape[0]} points of 'from_um'")
    sites, part = _with_vertices_at(layout, from_um, tolerance_um)
    point, vertex = _vertices_at(part, from_um, tolerance_um)
    xy_um = part.xy_um.copy()
    xy_um[vertex] = to_um[point]
    rings = (xy_um, part.ring_offsets, part.site_offsets)
    return replace_sites(layout, sites, rings, sites, f"{from_um.shape[0]} vertices moved")


@layout_edit(example={"points_um": [[20.0, 20.0]]})
def remove_vertices(
    layout: Layout, points_um: ArrayLike, *, tolerance_um: Annotated[float, LENGTH] = VERTEX_UM
) -> Layout:
    """
    Remove vertices from all sites that share them.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm
    tolerance_um : float, µm
        Distance within which a point is a vertex.

    Raises
    ------
    GeometryError
        When an outline would cross itself or vanish; ``.site_ids`` contains the index of its site.
    ParameterError
        When there is no vertex at a point.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0)
    >>> fs.layout.remove_vertices(layout, [(1.0, 1.0)]).area_um2.tolist()  # a triangle
    [2.0]
    """
    points_um = _points("points_um", points_um)
    sites = _near(layout, points_um, tolerance_um)
    part = layout[sites]
    point, vertex = _vertices_at(part, points_um, tolerance_um)
    _require_all("points_um", points_um, point, "must be a vertex")
    is_kept = np.ones(part.xy_um.shape[0], bool)
    is_kept[vertex] = False
    ring_offsets = np.concatenate(([0], np.cumsum(is_kept)))[part.ring_offsets]
    if (np.diff(ring_offsets) < 3).any():
        ring = int(np.argmax(np.diff(ring_offsets) < 3))
        site = int(sites[np.searchsorted(part.site_offsets, ring, side="right") - 1])
        raise GeometryError(f"site {site} would have fewer than 3 vertices; remove the site instead", (site,))
    rings = (part.xy_um[is_kept], ring_offsets, part.site_offsets)
    return replace_sites(layout, sites, rings, sites, f"{points_um.shape[0]} vertices removed")


@layout_edit(example={"points_um": [[-5.0, 5.0]], "channel": 2})
def set_channel(layout: Layout, points_um: ArrayLike, channel: Annotated[int, NOT_NEGATIVE]) -> Layout:
    """
    Set the colour filter of the sites at points.

    Parameters
    ----------
    layout : Layout
    points_um : (n, 2), µm
        One point in each site.
    channel : int
        Index of the colour filter.

    Raises
    ------
    ParameterError
        When a point lies outside all sites, or the index is negative.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.mosaic(fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0), "RGGB")
    >>> fs.layout.set_channel(layout, [(-1.0, -1.0)], 2).channel.tolist()
    [2, 2, 0, 1]
    """
    channels = layout.channel.copy()
    channels[sites_at(layout, points_um)] = channel
    return layout.with_columns(channel=channels)


def _points(name: str, points_um: Any, at_least: int = 1) -> Floats:
    """Return points as an (n, 2) array."""
    points = finite_array(name, points_um, ndim=2)
    if points.shape[1] != 2 or points.shape[0] < at_least:
        raise ParameterError(name, f"must have the shape (n, 2) with n >= {at_least}, got {points.shape}")
    if np.abs(points).max() > MAX_LENGTH_UM:
        raise ParameterError(name, f"must lie within {MAX_LENGTH_UM:g} µm of the origin", hint="coordinates are in µm")
    return points


def _in_box(layout: Layout, low_um: Floats, high_um: Floats) -> Ints:
    """Return the sites whose bounding boxes touch a box."""
    bounds_um = layout.site_bounds_um
    return np.flatnonzero(((bounds_um[:, :2] <= high_um) & (bounds_um[:, 2:] >= low_um)).all(axis=1))


def _near(layout: Layout, points_um: Floats, distance_um: float) -> Ints:
    """Return the sites whose bounding boxes are near points."""
    sites = _in_box(layout, points_um.min(axis=0) - distance_um, points_um.max(axis=0) + distance_um)
    boxes = shapely.box(*(layout.site_bounds_um[sites].T + distance_um * np.array([[-1.0], [-1.0], [1.0], [1.0]])))
    found = shapely.STRtree(boxes).query(shapely.points(points_um), predicate="intersects")[1]
    return np.asarray(sites[np.unique(found)], dtype=np.int64)


def _vertices_at(layout: Layout, points_um: Floats, tolerance_um: float) -> tuple[Ints, Ints]:
    """Return pairs of a point and a vertex at it."""
    tree = shapely.STRtree(shapely.points(layout.xy_um))
    point, vertex = tree.query(shapely.points(points_um), predicate="dwithin", distance=tolerance_um)
    return point, vertex


def _with_vertices_at(layout: Layout, points_um: Floats, tolerance_um: float) -> tuple[Ints, Layout]:
    """Return the sites at points, and their layout with a vertex at each point on their edges."""
    sites = _near(layout, points_um, tolerance_um)
    part = layout[sites]
    found, vertex = _vertices_at(part, points_um, tolerance_um)
    # An edge through a vertex of a neighbour receives this vertex, which the point is replaced by.
    exact_um = points_um.copy()
    exact_um[found] = part.xy_um[vertex]
    xy_um, ring_offsets, point = insert_points(part.xy_um, part.ring_offsets, exact_um, tolerance_um)
    _require_all("from_um", points_um, np.concatenate((found, point)), "must be a vertex or a point on an edge")
    return sites, layout_of(xy_um, ring_offsets, part.site_offsets)


def _require_all(name: str, points_um: Floats, found: Ints, rule: str) -> None:
    """Raise an error when a point is not among those found."""
    is_found = np.zeros(points_um.shape[0], bool)
    is_found[found] = True
    if not is_found.all():
        i = int(np.argmin(is_found))
        raise ParameterError(f"{name}[{i}]", rule, points_um[i].tolist(), "µm")
