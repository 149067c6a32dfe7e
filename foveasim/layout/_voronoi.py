"""Voronoi cells of any points in any region, as packed rings: what the irregular families share."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim.arrays import Bools, Floats, Ints
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout._model import Layout
from foveasim.rings import ring_moments

if TYPE_CHECKING:
    from scipy.spatial import Voronoi

__all__ = ["cells_of", "disc"]

#: Points outside that close the outer cells: further from every point of the region than any centre is.
N_FAR, FAR_RADII = 8, 4.0
#: Edges shorter than this share of their centres' distance are one corner that rounding split, as on a square grid.
SHORT_EDGE = 1e-9
#: Areas of all cells together, against the region's.
AREA_ROUNDING = 1e-9


def cells_of(centres_um: Floats, region: shapely.Polygon) -> tuple[Floats, Ints]:
    """
    Voronoi cells of points, clipped to a region: one cell a point, in the points' order.

    Parameters
    ----------
    centres_um : (n, 2) float64, µm
        Points inside the region, no two the same.
    region : shapely Polygon, µm
        Convex or not.

    Returns
    -------
    xy_um : (n_vertex, 2) float64, µm
        Corners, cell after cell, counter-clockwise. Neighbours' corners are the same numbers, bit for bit.
    ring_offsets : (n + 1,) int64
        Cell i has the corners ``ring_offsets[i] : ring_offsets[i + 1]``.

    Raises
    ------
    GeometryError
        When a point lies outside, two are the same or too close for float64, or a cell goes round a hole
        of the region.

    Notes
    -----
    Cells inside the region come from arrays of corner numbers. The few at its border are the faces of all their edges
    and the region's outline, cut where they cross once for both neighbours. A part that a region's notch cuts off its
    cell goes to the neighbour with which it shares the longest border.
    """
    centres_um = np.ascontiguousarray(centres_um, np.float64)
    n = centres_um.shape[0]
    _require_apart_and_inside(centres_um, region)
    low, high = np.reshape(region.bounds, (2, 2))
    middle = 0.5 * (low + high)
    turn = 2.0 * math.pi * (np.arange(N_FAR) + 0.5) / N_FAR
    far = FAR_RADII * 0.5 * math.hypot(*(high - low)) * np.stack((np.cos(turn), np.sin(turn)), axis=1)
    from scipy.spatial import Voronoi

    diagram = Voronoi(np.concatenate((centres_um - middle, far)))
    xy_um = diagram.vertices + middle
    sites, corners = _edges(diagram, n)
    site, start, stop = _walks(centres_um, xy_um, sites, corners)
    offsets = np.concatenate(([0], np.cumsum(np.bincount(site, minlength=n))))
    _require_closed(start, stop, offsets)

    cells = _polygons(xy_um[start], offsets)
    shapely.prepare(region)
    is_inside = shapely.contains_properly(region, cells)
    border = np.flatnonzero(~is_inside)
    if border.size:
        is_border_edge = ~is_inside[site]
        ends = np.unique(np.sort(np.stack((start, stop), axis=1)[is_border_edge], axis=1), axis=0)
        clipped = _clipped(centres_um, xy_um[ends], region, ~is_inside)
        rings_um, clipped_offsets = _rings(clipped, border)
    else:
        rings_um, clipped_offsets = np.zeros((0, 2)), np.zeros(1, np.int64)
    return _merged(xy_um[start], offsets, rings_um, clipped_offsets, border, float(region.area))


def disc(radius_um: float, n_chords: int) -> shapely.Polygon:
    """Disc around the axis as a regular polygon with its corners on the circle, the first at angle 0."""
    angle_rad = 2.0 * math.pi * np.arange(n_chords) / n_chords
    return shapely.Polygon(radius_um * np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1))


def _require_apart_and_inside(centres_um: Floats, region: shapely.Polygon) -> None:
    if centres_um.ndim != 2 or centres_um.shape[1] != 2 or centres_um.shape[0] == 0:
        raise ParameterError("centres_um", f"must have the shape (n, 2) with n >= 1, got {centres_um.shape}")
    shapely.prepare(region)
    outside = np.flatnonzero(~shapely.contains_xy(region, centres_um))
    if outside.size:
        x, y = centres_um[outside[0]]
        raise GeometryError(
            f"centre {outside[0]} at ({x:g}, {y:g}) µm does not lie inside the region", tuple(outside.tolist())
        )
    order = np.lexsort(centres_um.T)
    is_same = (np.diff(centres_um[order], axis=0) == 0.0).all(axis=1)
    if is_same.any():
        first = int(np.flatnonzero(is_same)[0])
        pair = sorted(order[first : first + 2].tolist())
        raise GeometryError(
            f"centres {pair[0]} and {pair[1]} are the same point; every cell needs its own", tuple(pair)
        )


def _edges(diagram: Voronoi, n_centres: int) -> tuple[Ints, Ints]:
    """Centres (n, 2) on both sides of each edge, and its two corners (n, 2), corners that are one having one number."""
    sites = np.asarray(diagram.ridge_points, dtype=np.int64)
    corners = np.asarray(diagram.ridge_vertices, dtype=np.int64)
    # Edges of far points alone belong to no cell, and only they can be endless.
    is_ours = (sites < n_centres).any(axis=1)
    sites, corners = sites[is_ours], corners[is_ours]
    if (corners < 0).any():
        raise GeometryError("the centres lie too close together for float64")
    length_um = np.hypot(*(diagram.vertices[corners[:, 0]] - diagram.vertices[corners[:, 1]]).T)
    distance_um = np.hypot(*(diagram.points[sites[:, 0]] - diagram.points[sites[:, 1]]).T)
    is_short = length_um <= SHORT_EDGE * distance_um
    if is_short.any():
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        n_vertices = diagram.vertices.shape[0]
        graph = coo_array(
            (np.ones(int(is_short.sum()), bool), (corners[is_short, 0], corners[is_short, 1])),
            shape=(n_vertices, n_vertices),
        )
        group = np.asarray(connected_components(graph, directed=False, return_labels=True)[1], dtype=np.int64)
        _, first = np.unique(group, return_index=True)
        corners = np.asarray(first, dtype=np.int64)[group][corners]
        is_left = corners[:, 0] != corners[:, 1]
        sites, corners = sites[is_left], corners[is_left]
    return sites, corners


def _walks(centres_um: Floats, xy_um: Floats, sites: Ints, corners: Ints) -> tuple[Ints, Ints, Ints]:
    """All edges of all cells, cell by cell and counter-clockwise: cell, first corner, second corner."""
    site = sites.ravel()
    start, stop = np.repeat(corners, 2, axis=0).T
    is_ours = site < centres_um.shape[0]
    site, start, stop = site[is_ours], start[is_ours], stop[is_ours]
    a, b = xy_um[start] - centres_um[site], xy_um[stop] - centres_um[site]
    is_clockwise = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    start, stop = np.where(is_clockwise, stop, start), np.where(is_clockwise, start, stop)
    a = np.where(is_clockwise[:, np.newaxis], b, a)
    order = np.lexsort((np.arctan2(a[:, 1], a[:, 0]), site))
    return site[order], start[order], stop[order]


def _require_closed(start: Ints, stop: Ints, offsets: Ints) -> None:
    """Each edge of a cell must end where the next begins: the corners' order is not left to rounding."""
    is_bad = np.diff(offsets) < 3
    if not is_bad.any():
        after = np.roll(start, -1)
        after[offsets[1:] - 1] = start[offsets[:-1]]
        is_bad = np.logical_or.reduceat(after != stop, offsets[:-1])
    bad = np.flatnonzero(is_bad)
    if bad.size:
        raise GeometryError(f"centre {bad[0]} lies too close to others for float64", tuple(bad.tolist()))


def _polygons(xy_um: Floats, offsets: Ints) -> NDArray[Any]:
    return Layout(xy_um, offsets, np.arange(offsets.size)).polygons()


def _clipped(centres_um: Floats, edges_um: Floats, region: shapely.Polygon, is_border: Bools) -> NDArray[Any]:
    """The cells at the border within the region, in order, as polygons: faces of the edges (n, 2, 2) and the outline."""
    lines = np.append(shapely.linestrings(edges_um), region.boundary)
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.union_all(lines))))
    points = shapely.point_on_surface(faces)
    is_inside = shapely.contains(region, points)
    faces, points = faces[is_inside], points[is_inside]
    from scipy.spatial import cKDTree

    owner = np.asarray(cKDTree(centres_um).query(shapely.get_coordinates(points))[1], dtype=np.int64)
    is_border_face = is_border[owner]
    faces, owner = faces[is_border_face], owner[is_border_face]
    # The first face of each owner is the one with its centre, the others are parts that the outline cut off.
    has_centre = shapely.intersects(faces, shapely.points(centres_um[owner]))
    order = np.lexsort((-shapely.area(faces), ~has_centre, owner))
    faces, owner = faces[order], owner[order]
    is_first = np.append(True, owner[1:] != owner[:-1])
    cells, left = faces[is_first], faces[~is_first]
    border = np.flatnonzero(is_border)
    if not np.array_equal(owner[is_first], border):
        lost = np.setdiff1d(border, owner)
        raise GeometryError(f"centre {lost[0]} lies too close to others for float64", tuple(lost.tolist()))
    for _ in range(left.size):
        # A part may hang on another part: those with a neighbour go first, round by round.
        shared_um = np.array([shapely.length(shapely.intersection(cells, part)) for part in left])
        if shared_um.size == 0:
            break
        part, cell = np.unravel_index(int(shared_um.argmax()), shared_um.shape)
        cells[cell] = shapely.union(cells[cell], left[part])
        left = np.delete(left, part)
    return np.asarray(shapely.orient_polygons(cells))


def _rings(polygons: NDArray[Any], ids: Ints) -> tuple[Floats, Ints]:
    """Packed outlines of polygons, which must have no holes."""
    is_odd = (shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON) | (
        shapely.get_num_interior_rings(polygons) > 0
    )
    if is_odd.any():
        bad = tuple(int(i) for i in ids[is_odd])
        raise GeometryError(
            f"the cell of centre {bad[0]} would be no simple outline within the region; take more centres", bad
        )
    closed_um, ring_of = shapely.get_coordinates(shapely.get_exterior_ring(polygons), return_index=True)
    is_last = np.append(ring_of[1:] != ring_of[:-1], True)
    counts = np.bincount(ring_of[~is_last], minlength=polygons.size)
    return closed_um[~is_last], np.concatenate(([0], np.cumsum(counts)))


def _merged(
    xy_um: Floats, offsets: Ints, border_um: Floats, border_offsets: Ints, border: Ints, region_um2: float
) -> tuple[Floats, Ints]:
    """Packed rings of all cells, those at the border replaced."""
    counts = np.diff(offsets)
    is_inside = np.ones(counts.size, bool)
    is_inside[border] = False
    new_counts = counts.copy()
    new_counts[border] = np.diff(border_offsets)
    merged_offsets = np.concatenate(([0], np.cumsum(new_counts)))
    merged_um = np.empty((int(merged_offsets[-1]), 2))
    is_from_inside = np.repeat(is_inside, new_counts)
    merged_um[is_from_inside] = xy_um[np.repeat(is_inside, counts)]
    merged_um[~is_from_inside] = border_um
    area_um2, _ = ring_moments(merged_um, merged_offsets)
    bad = np.flatnonzero(area_um2 <= 0.0)
    if bad.size or abs(area_um2.sum() - region_um2) > AREA_ROUNDING * region_um2:
        raise GeometryError("the centres lie too close together for float64", tuple(bad.tolist()))
    return merged_um, merged_offsets
