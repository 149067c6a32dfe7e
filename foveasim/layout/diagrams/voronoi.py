"""Voronoi cells of points in a region, as packed rings, for irregular layouts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.rings import collapse_short_edges, next_vertex, ring_area_um2
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout.diagrams.power import N_AUXILIARY, PowerDiagram, auxiliary_points_um
from foveasim.layout.model import Layout

__all__ = ["CellEdges", "IncrementalCells", "clipped_cells", "ring_edges", "voronoi_cells"]

#: Edges shorter than this fraction of the distance of their centres are one corner split by rounding, as on a square grid.
SHORT_EDGE = 1e-9
#: Relative tolerance of the total area of all cells, against the area of the region.
AREA_ROUNDING = 1e-9


def voronoi_cells(centres_um: Floats, region: shapely.Polygon) -> tuple[Floats, Ints]:
    """
    Compute the Voronoi cells of points, clipped to a region, one per point in their order.

    ``centres_um`` (n, 2) float64, µm: distinct points inside the region. ``region`` (shapely Polygon, µm): convex or concave.
    Returns ``xy_um`` (n_vertex, 2) float64, µm: corners, cell after cell, counter-clockwise. Corners that neighbours share are
    bit-identical. ``ring_offsets`` (n + 1,) int64: cell i has the corners ``ring_offsets[i] : ring_offsets[i + 1]``. Raises
    GeometryError when a point lies outside, two are equal or too close for float64, or a cell encloses a hole of the region.

    Cells inside the region are assembled from arrays of corner indices. The few cells at its boundary are the faces of
    their edges and the outline of the region; each intersection is computed once for both neighbours. A part that a notch
    of the region separates from its cell is assigned to the neighbour with which it shares the longest boundary.
    """
    centres_um = np.ascontiguousarray(centres_um, np.float64)
    _check_centres(centres_um, region)
    return _without_holes(*clipped_cells(centres_um, region))


def clipped_cells(
    centres_um: Floats, region: shapely.Polygon | shapely.MultiPolygon, *, separated: SeparatedParts = "neighbour"
) -> tuple[Floats, Ints, Ints]:
    """
    Compute the Voronoi cells of distinct points in a region, as packed rings, with holes.

    ``centres_um`` (n, 2) float64, µm: in the region or on its boundary. ``separated``: a part of a cell that the region
    separates from its centre is assigned to a neighbour, or an error. Returns ``xy_um``, ``ring_offsets``, ``site_offsets``
    as for :class:`foveasim.Layout`, one site per point. Raises GeometryError as :func:`voronoi_cells`.
    """
    diagram = _voronoi(centres_um, region)
    unclipped = _unclipped_rings(diagram, centres_um)
    shapely.prepare(region)
    is_inside = shapely.contains_properly(region, _polygons(*unclipped))
    return _clip(diagram, *unclipped, is_inside, region, separated=separated)


@dataclass(frozen=True)
class CellEdges:
    """
    Edges of all cells, each with the orientation that is counter-clockwise around its cell.

    ``cell`` (n_edge,): index of the cell. ``owner`` (n_edge,): the centre nearest to the part of the cell at this edge, another
    one than the cell's own where a notch of the region separates the part. ``start_um``, ``stop_um`` (n_edge, 2): end points.
    ``n_twins``: number of first edges that are equal to as many next ones, with the opposite orientation.
    """

    cell: Ints
    owner: Ints
    start_um: Floats
    stop_um: Floats
    n_twins: int = 0

    def twins(self) -> tuple[Ints, Ints]:
        """Return the indices of all pairs of coincident edges of opposite orientation."""
        one, other = np.arange(self.n_twins), np.arange(self.n_twins, 2 * self.n_twins)
        ends = np.concatenate((self.start_um, self.stop_um), axis=1)[2 * self.n_twins :]
        is_backward = (ends[:, 0] > ends[:, 2]) | ((ends[:, 0] == ends[:, 2]) & (ends[:, 1] > ends[:, 3]))
        ends[is_backward] = ends[is_backward][:, (2, 3, 0, 1)]
        order = np.lexsort(ends.T)
        at = np.flatnonzero((ends[order][1:] == ends[order][:-1]).all(axis=1))
        rest = order + 2 * self.n_twins
        return np.concatenate((one, rest[at])), np.concatenate((other, rest[at + 1]))


def ring_edges(xy_um: Floats, ring_offsets: Ints) -> CellEdges:
    """Return the edges of cells given as packed rings."""
    cell = np.repeat(np.arange(ring_offsets.size - 1), np.diff(ring_offsets))
    return CellEdges(cell, cell, xy_um, xy_um[next_vertex(ring_offsets)])


#: What happens to parts of cells that the region separates from their centres.
SeparatedParts: TypeAlias = Literal["error", "neighbour"]
#: Function that returns the masses (n,) of n polygons from their edges.
MassOf: TypeAlias = Callable[[CellEdges, int], Any]


class IncrementalCells:
    """
    Voronoi or power cells in a region, updated incrementally as unordered edges.

    Unordered edges are sufficient for areas and masses, and faster to compute than rings. Parts of cells that notches of the
    region separate are assigned to neighbours as in :func:`voronoi_cells`, and have edges of their own.

    ``region`` (shapely Polygon, µm): convex or concave. ``mass_of``: returns the masses (n,) of n polygons from their edges.
    Of a cell that a notch divides, the heaviest part is then the cell; otherwise the part that contains the centre.
    ``centres_um`` (n, 2) float64, µm: the centres of the last update.
    """

    def __init__(self, region: shapely.Polygon, mass_of: MassOf | None = None) -> None:
        self.region: shapely.Polygon = region
        self._boundary, self._mass_of = region.boundary, mass_of
        self._power = PowerDiagram(*np.reshape(region.bounds, (2, 2)))
        self._weights_um2: Floats | None = None
        self.centres_um: Floats = np.zeros((0, 2))
        self._clearance_um = np.zeros(0)
        self._is_inside = np.zeros(0, bool)
        shapely.prepare(self.region)
        shapely.prepare(self._boundary)

    def update(self, centres_um: Floats, weights_um2: Floats | None = None) -> CellEdges | None:
        """
        Compute the edges of the Voronoi or power cells of centres (n, 2) inside the region.

        With weights (n,) a point x belongs to the centre c of the least power ``|x - c|² - weight``. The result is None if a
        centre has no cell in the region; :meth:`rings` is not available then.
        """
        if not self._power.update(centres_um, weights_um2):
            return None
        is_inside = self._certainly_inside(centres_um)
        self.centres_um, self._weights_um2 = centres_um, weights_um2
        diagram = self._diagram()
        parts, is_inside = _boundary_parts(diagram, is_inside, self.region, self._mass_of)
        inner, self._is_inside = _inner_edges(diagram, is_inside), is_inside
        if parts is None:
            return inner
        if parts.missing.size:
            return None
        outer = parts.edges
        return CellEdges(
            np.concatenate((inner.cell, parts.cell[outer.cell])),
            np.concatenate((inner.owner, parts.owner[outer.cell])),
            np.concatenate((inner.start_um, outer.start_um)),
            np.concatenate((inner.stop_um, outer.stop_um)),
            inner.n_twins,
        )

    def rings(self) -> tuple[Floats, Ints]:
        """
        Return the last cells as packed rings, like :func:`voronoi_cells`.

        Returns ``xy_um`` (n_vertex, 2) float64, µm. ``ring_offsets`` (n + 1,) int64. Raises GeometryError when centres are too
        close for float64, or a cell encloses a hole of the region.
        """
        diagram = _without_short_edges(self._diagram())
        unclipped = _unclipped_rings(
            diagram, self.centres_um if self._weights_um2 is None else _inner_points_um(diagram)
        )
        return _without_holes(*_clip(diagram, *unclipped, self._is_inside, self.region, self._mass_of))

    def _diagram(self) -> _Diagram:
        power = self._power
        return _Diagram(self.centres_um, self._weights_um2, power.points_um, power.corners_um, power.sites, power.ends)

    def _certainly_inside(self, centres_um: Floats) -> Bools:
        """Return whether each cell certainly is inside: its corners are closer than the boundary."""
        reach_um = self._power.reach_um()
        if self.centres_um.shape == centres_um.shape:
            # The distance to the boundary decreases by at most the displacement of the centre.
            self._clearance_um = self._clearance_um - np.hypot(*(centres_um - self.centres_um).T)
        else:
            self._clearance_um = np.zeros(centres_um.shape[0])
        unsure = np.flatnonzero(reach_um >= self._clearance_um)
        self._clearance_um[unsure] = shapely.distance(self._boundary, shapely.points(centres_um[unsure]))
        return np.asarray(reach_um < (1.0 - SHORT_EDGE) * self._clearance_um)


def _check_centres(centres_um: Floats, region: shapely.Polygon) -> None:
    if centres_um.ndim != 2 or centres_um.shape[1] != 2 or centres_um.shape[0] == 0:
        raise ParameterError("centres_um", f"must have the shape (n, 2) with n >= 1, got {centres_um.shape}")
    shapely.prepare(region)
    outside = np.flatnonzero(~shapely.contains_xy(region, centres_um))
    if outside.size:
        x, y = centres_um[outside[0]]
        raise GeometryError(
            f"centre {outside[0]} at ({x:g}, {y:g}) µm must lie inside the region", tuple(outside.tolist())
        )
    order = np.lexsort(centres_um.T)
    is_same = (np.diff(centres_um[order], axis=0) == 0.0).all(axis=1)
    if is_same.any():
        first = int(np.flatnonzero(is_same)[0])
        pair = sorted(order[first : first + 2].tolist())
        raise GeometryError(f"centres {pair[0]} and {pair[1]} must be distinct points, one per cell", tuple(pair))


@dataclass(frozen=True)
class _Diagram:
    """
    Edges of Voronoi or power cells, not clipped.

    Fields: centres (n, 2), weights (n,), centres and auxiliary points (n + N_AUXILIARY, 2), corners of cells (n_corner, 2), and
    for each edge the points on its two sides (n_edge, 2) and the corners at its ends (n_edge, 2).
    """

    centres_um: Floats
    weights_um2: Floats | None
    points_um: Floats
    xy_um: Floats
    sites: Ints
    corners: Ints

    def with_edges(self, is_chosen: Bools) -> _Diagram:
        return replace(self, sites=self.sites[is_chosen], corners=self.corners[is_chosen])


def _voronoi(centres_um: Floats, region: shapely.Polygon) -> _Diagram:
    from scipy.spatial import Voronoi

    low, high = np.reshape(region.bounds, (2, 2))
    centre = 0.5 * (low + high)
    found = Voronoi(np.concatenate((centres_um - centre, auxiliary_points_um(low, high))))
    sites = np.asarray(found.ridge_points, dtype=np.int64)
    corners = np.asarray(found.ridge_vertices, dtype=np.int64)
    # Edges between two auxiliary points belong to no cell, and only these can be infinite.
    has_centre = (sites < centres_um.shape[0]).any(axis=1)
    if (corners[has_centre] < 0).any():
        raise GeometryError("the centres are too close together for float64; increase their distances")
    diagram = _Diagram(centres_um, None, found.points, found.vertices, sites[has_centre], corners[has_centre])
    return replace(_without_short_edges(diagram), xy_um=found.vertices + centre)


def _without_short_edges(diagram: _Diagram) -> _Diagram:
    """Return the diagram without edges shorter than rounding; their corners are merged."""
    sites, corners = diagram.sites, diagram.corners
    length_um = np.hypot(*(diagram.xy_um[corners[:, 0]] - diagram.xy_um[corners[:, 1]]).T)
    distance_um = np.hypot(*(diagram.points_um[sites[:, 0]] - diagram.points_um[sites[:, 1]]).T)
    is_short = length_um <= SHORT_EDGE * distance_um
    if not is_short.any():
        return diagram
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n_corners = diagram.xy_um.shape[0]
    graph = coo_array(
        (np.ones(int(is_short.sum()), bool), (corners[is_short, 0], corners[is_short, 1])), shape=(n_corners, n_corners)
    )
    group = np.asarray(connected_components(graph, directed=False, return_labels=True)[1], dtype=np.int64)
    _, first = np.unique(group, return_index=True)
    corners = np.asarray(first, dtype=np.int64)[group][corners]
    return replace(diagram, corners=corners).with_edges(corners[:, 0] != corners[:, 1])


def _split_at_boundary(diagram: _Diagram, is_inside: Bools) -> tuple[_Diagram, _Diagram]:
    """Split the diagram into edges of boundary cells and edges between inner cells."""
    is_inner = np.append(is_inside, np.zeros(N_AUXILIARY, bool))
    is_both = np.asarray(is_inner[diagram.sites[:, 0]] & is_inner[diagram.sites[:, 1]])
    return _without_short_edges(diagram.with_edges(~is_both)), diagram.with_edges(is_both)


def _inner_edges(diagram: _Diagram, is_inside: Bools) -> CellEdges:
    """Return the edges around inner cells: paired ones, then those to boundary cells."""
    one, both = _split_at_boundary(diagram, is_inside)
    is_inner = np.append(is_inside, np.zeros(N_AUXILIARY, bool))
    first, second = is_inner[one.sites[:, 0]], is_inner[one.sites[:, 1]]
    cell = np.concatenate((both.sites[:, 0], both.sites[:, 1], one.sites[first, 0], one.sites[second, 1]))
    start, stop = (
        np.concatenate((both.corners[:, i], both.corners[:, j], one.corners[first, i], one.corners[second, j]))
        for i, j in ((0, 1), (1, 0))
    )
    return CellEdges(cell, cell, both.xy_um.take(start, 0), both.xy_um.take(stop, 0), both.sites.shape[0])


def _inner_points_um(diagram: _Diagram) -> Floats:
    """Return the mean (n, 2) of the corners of each cell, a point inside it."""
    n = diagram.centres_um.shape[0]
    midpoint_um = diagram.xy_um[diagram.corners].mean(axis=1)
    total_um, count = np.zeros((n, 2)), np.zeros(n)
    for site in diagram.sites.T:
        is_centre = site < n
        count += np.bincount(site[is_centre], minlength=n)
        for i in (0, 1):
            total_um[:, i] += np.bincount(site[is_centre], midpoint_um[is_centre, i], minlength=n)
    return total_um / np.maximum(count, 1.0)[:, np.newaxis]


def _unclipped_rings(diagram: _Diagram, inside_um: Floats) -> tuple[Floats, Ints]:
    """Return packed rings of the unclipped cells, given a point (n, 2) inside each."""
    site, start, stop = _sort_edges(inside_um, diagram.xy_um, diagram.sites, diagram.corners)
    offsets = np.concatenate(([0], np.cumsum(np.bincount(site, minlength=inside_um.shape[0]))))
    _require_closed(start, stop, offsets)
    return diagram.xy_um[start], offsets


def _sort_edges(inside_um: Floats, xy_um: Floats, sites: Ints, corners: Ints) -> tuple[Ints, Ints, Ints]:
    """Sort all edges by cell and counter-clockwise: cell, first corner, second corner."""
    site = sites.ravel()
    start, stop = np.repeat(corners, 2, axis=0).T
    is_centre = site < inside_um.shape[0]
    site, start, stop = site[is_centre], start[is_centre], stop[is_centre]
    a, b = xy_um[start] - inside_um[site], xy_um[stop] - inside_um[site]
    is_clockwise = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    start, stop = np.where(is_clockwise, stop, start), np.where(is_clockwise, start, stop)
    a = np.where(is_clockwise[:, np.newaxis], b, a)
    order = np.lexsort((np.arctan2(a[:, 1], a[:, 0]), site))
    return site[order], start[order], stop[order]


def _require_closed(start: Ints, stop: Ints, offsets: Ints) -> None:
    """Check that each edge of a cell ends where the next begins, so rounding changed no order."""
    is_bad = np.diff(offsets) < 3
    if not is_bad.any():
        after = np.roll(start, -1)
        after[offsets[1:] - 1] = start[offsets[:-1]]
        is_bad = np.logical_or.reduceat(after != stop, offsets[:-1])
    bad = np.flatnonzero(is_bad)
    if bad.size:
        raise GeometryError(f"centre {bad[0]} is too close to another centre for float64", tuple(bad.tolist()))


def _polygons(xy_um: Floats, offsets: Ints) -> NDArray[Any]:
    return Layout(xy_um, offsets, np.arange(offsets.size)).polygons()


def _without_holes(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> tuple[Floats, Ints]:
    """Return packed rings of cells, one each; raise for cells with holes."""
    bad = np.flatnonzero(np.diff(site_offsets) > 1)
    if bad.size:
        raise GeometryError(
            f"the cell of centre {bad[0]} within the region must be one polygon without holes; use more centres",
            tuple(bad.tolist()),
        )
    return xy_um, ring_offsets


def _clip(
    diagram: _Diagram,
    unclipped_um: Floats,
    offsets: Ints,
    is_inside: Bools,
    region: shapely.Polygon | shapely.MultiPolygon,
    mass_of: MassOf | None = None,
    separated: SeparatedParts = "neighbour",
) -> tuple[Floats, Ints, Ints]:
    """Return packed rings of the cells within the region: those not inside are clipped."""
    parts, is_inside = _boundary_parts(diagram, is_inside, region, mass_of)
    boundary = np.flatnonzero(~is_inside)
    rings = np.zeros((0, 2)), np.zeros(1, np.int64), np.zeros(1, np.int64)
    if parts is not None:
        if parts.missing.size:
            raise GeometryError(
                f"centre {parts.missing[0]} is too close to another centre for float64", tuple(parts.missing.tolist())
            )
        n_parts = np.bincount(parts.owner, minlength=is_inside.size)
        if separated == "error" and (n_parts > 1).any():
            bad = np.flatnonzero(n_parts > 1)
            raise GeometryError(
                f"the cell of point {bad[0]} has {n_parts[bad[0]]} parts in the region"
                f"{f' (and {bad.size - 1} more)' if bad.size > 1 else ''}; take parts='neighbour', which adds them to the "
                "cells that they touch, or add points",
                tuple(bad.tolist()),
            )
        rings = _rings(parts.join(boundary), boundary)
    area_um2 = float(region.area)
    xy_um, ring_offsets, site_offsets = _merge_rings(unclipped_um, offsets, *rings, boundary, area_um2)
    # Cuts through a vertex of the region, within rounding.
    xy_um, ring_offsets = collapse_short_edges(xy_um, ring_offsets, SHORT_EDGE * math.sqrt(area_um2 / is_inside.size))
    return xy_um, ring_offsets, site_offsets


@dataclass(frozen=True)
class _Parts:
    """
    Parts of the boundary cells within the region.

    Fields: the polygons of the parts, their nearest centre (of least power), the cell to which each is assigned, their
    edges, and the centres without a part.
    """

    polygons: NDArray[Any]
    owner: Ints
    cell: Ints
    edges: CellEdges
    missing: Ints

    def join(self, boundary: Ints) -> NDArray[Any]:
        """Return the cells with these indices, each a single polygon if its parts touch."""
        order = np.argsort(self.cell, kind="stable")
        polygons, cell = self.polygons[order], self.cell[order]
        is_first = np.append(True, cell[1:] != cell[:-1])
        cells = polygons[is_first]
        for i in np.flatnonzero(~is_first):
            at = int(np.searchsorted(boundary, cell[i]))
            cells[at] = shapely.union(cells[at], polygons[i])
        return np.asarray(shapely.orient_polygons(cells))


def _boundary_parts(
    diagram: _Diagram, is_inside: Bools, region: shapely.Polygon, mass_of: MassOf | None
) -> tuple[_Parts | None, Bools]:
    """Return the parts of boundary cells, or None, and a mask of the unaffected inner cells."""
    if is_inside.all():
        return None, is_inside
    parts = _parts(_split_at_boundary(diagram, is_inside)[0], region, ~is_inside, mass_of)
    if np.unique(parts.owner).size < parts.owner.size:
        owner, count = np.unique(parts.owner, return_counts=True)
        is_divided = np.zeros(diagram.points_um.shape[0], bool)
        is_divided[owner[count > 1]] = True
        neighbours = np.unique(diagram.sites[is_divided[diagram.sites[:, 0]] | is_divided[diagram.sites[:, 1]]])
        neighbours = neighbours[neighbours < is_inside.size]
        if is_inside[neighbours].any():
            is_inside = is_inside.copy()
            is_inside[neighbours] = False
            parts = _parts(_split_at_boundary(diagram, is_inside)[0], region, ~is_inside, mass_of)
    return parts, is_inside


def _parts(diagram: _Diagram, region: shapely.Polygon, is_boundary: Bools, mass_of: MassOf | None) -> _Parts:
    """Return the faces between the edges of boundary cells and the outline of the region."""
    ends = np.unique(np.sort(diagram.corners, axis=1), axis=0)
    lines = np.append(shapely.linestrings(diagram.xy_um[ends]), region.boundary)
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.union_all(lines))))
    points = shapely.point_on_surface(faces)
    is_inside = shapely.contains(region, points)
    faces, points = faces[is_inside], points[is_inside]
    owner = _least_power_centre(shapely.get_coordinates(points), diagram)
    is_boundary_part = is_boundary[owner]
    faces, owner = shapely.orient_polygons(faces[is_boundary_part]), owner[is_boundary_part]
    # The first face of each owner contains its centre, or is the heaviest; the outline separates the others from it.
    edges = _edges_of(faces)
    if mass_of is None:
        size, has_centre = shapely.area(faces), shapely.intersects(faces, shapely.points(diagram.centres_um[owner]))
    else:
        size, has_centre = mass_of(edges, faces.size), np.zeros(faces.size, bool)
    order = np.lexsort((-size, ~has_centre, owner))
    is_first = np.append(True, np.diff(owner[order]) != 0)
    cell = np.full(faces.size, -1)
    cell[order[is_first]] = owner[order[is_first]]
    return _Parts(
        faces, owner, _assign_parts(cell, owner, edges), edges, np.setdiff1d(np.flatnonzero(is_boundary), owner)
    )


def _least_power_centre(points_um: Floats, diagram: _Diagram) -> Ints:
    """Return the centre of least power for each point, of those with edges in the diagram."""
    from scipy.spatial import cKDTree

    near = np.unique(diagram.sites)
    near = near[near < diagram.centres_um.shape[0]]
    centres_um = diagram.centres_um[near]
    if diagram.weights_um2 is not None:
        # Power as distance: each centre is lifted by the root of the difference of its weight from the largest.
        weights_um2 = diagram.weights_um2[near]
        centres_um = np.column_stack((centres_um, np.sqrt(weights_um2.max() - weights_um2)))
        points_um = np.column_stack((points_um, np.zeros(points_um.shape[0])))
    return np.asarray(near[cKDTree(centres_um).query(points_um)[1]], dtype=np.int64)


def _assign_parts(cell: Ints, owner: Ints, edges: CellEdges) -> Ints:
    """Assign each part without a cell (-1) to the neighbour with the longest shared boundary."""
    cell = cell.copy()
    if (cell >= 0).all():
        return cell
    one, other = edges.twins()
    length_um = np.hypot(*(edges.stop_um[one] - edges.start_um[one]).T)
    part, neighbour = edges.cell[np.stack((np.append(one, other), np.append(other, one)))]
    length_um = np.append(length_um, length_um)
    while True:
        # A part may touch only other parts: in each round, the parts with an assigned neighbour come first.
        is_open = (cell[part] < 0) & (cell[neighbour] >= 0)
        if not is_open.any():
            return np.where(cell < 0, owner, cell)
        pairs, number = np.unique(np.stack((part, cell[neighbour])).T[is_open], axis=0, return_inverse=True)
        shared_um = np.bincount(number.ravel(), length_um[is_open])
        at = int(shared_um.argmax())
        cell[pairs[at, 0]] = pairs[at, 1]


def _edges_of(polygons: NDArray[Any]) -> CellEdges:
    """Return the edges of polygons with outlines counter-clockwise and holes clockwise."""
    rings, polygon = shapely.get_rings(polygons, return_index=True)
    closed_um, ring = shapely.get_coordinates(rings, return_index=True)
    is_start = ring[1:] == ring[:-1]
    cell = np.asarray(polygon[ring[:-1][is_start]], dtype=np.int64)
    return CellEdges(cell, cell, closed_um[:-1][is_start], closed_um[1:][is_start])


def _rings(polygons: NDArray[Any], ids: Ints) -> tuple[Floats, Ints, Ints]:
    """Return the packed rings of polygons; raise for multiple parts."""
    is_odd = shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON
    if is_odd.any():
        bad = tuple(int(i) for i in ids[is_odd])
        raise GeometryError(f"the cell of centre {bad[0]} within the region must be one polygon; use more centres", bad)
    rings, polygon = shapely.get_rings(polygons, return_index=True)
    closed_um, ring_of = shapely.get_coordinates(rings, return_index=True)
    is_last = np.append(ring_of[1:] != ring_of[:-1], True)
    ring_offsets = np.concatenate(([0], np.cumsum(np.bincount(ring_of[~is_last], minlength=rings.size))))
    return closed_um[~is_last], ring_offsets, np.searchsorted(polygon, np.arange(polygons.size + 1))


def _merge_rings(
    xy_um: Floats,
    offsets: Ints,
    boundary_um: Floats,
    boundary_offsets: Ints,
    boundary_sites: Ints,
    boundary: Ints,
    region_um2: float,
) -> tuple[Floats, Ints, Ints]:
    """Return packed rings of all cells, with those at the boundary replaced."""
    counts = np.diff(offsets)
    is_inside = np.ones(counts.size, bool)
    is_inside[boundary] = False
    n_rings = np.ones(counts.size, np.int64)
    n_rings[boundary] = np.diff(boundary_sites)
    site_offsets = np.concatenate(([0], np.cumsum(n_rings)))
    is_ring_inside = np.repeat(is_inside, n_rings)
    new_counts = np.empty(is_ring_inside.size, np.int64)
    new_counts[is_ring_inside] = counts[is_inside]
    new_counts[~is_ring_inside] = np.diff(boundary_offsets)
    merged_offsets = np.concatenate(([0], np.cumsum(new_counts)))
    merged_um = np.empty((int(merged_offsets[-1]), 2))
    is_from_inside = np.repeat(is_ring_inside, new_counts)
    merged_um[is_from_inside] = xy_um[np.repeat(is_inside, counts)]
    merged_um[~is_from_inside] = boundary_um
    area_um2 = ring_area_um2(merged_um, merged_offsets)  # of holes negative
    bad = np.flatnonzero(area_um2[site_offsets[:-1]] <= 0.0)
    if bad.size or abs(area_um2.sum() - region_um2) > AREA_ROUNDING * region_um2:
        raise GeometryError(
            "the centres are too close together for float64; increase their distances", tuple(bad.tolist())
        )
    return merged_um, merged_offsets, site_offsets
