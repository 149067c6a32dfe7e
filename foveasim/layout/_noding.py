"""Points on edges within rounding, for noding of layouts and for the detection of gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.rings import next_vertex
from foveasim._core.validation import Floats, Ints

#: Tolerance within which a point lies on an edge, and two points are the same.
ON_EDGE_UM = 1e-6
#: Grid on which GEOS intersects robustly, and relative difference of areas beyond its rounding.
FINE_GRID_UM, AGREEMENT = 1e-9, 0.01


def intersections(first: NDArray[Any], second: NDArray[Any], min_um2: Floats | float) -> NDArray[Any]:
    """
    Return the intersections of pairs of polygons (n_pair,).

    GEOS, up to 3.14 at least, can return parts of only one of two polygons whose boundaries nearly coincide. Areas above
    ``min_um2`` are therefore computed again on a fine grid, whose result is used where the areas disagree.
    """
    found: NDArray[Any] = np.atleast_1d(shapely.intersection(first, second))
    again = np.flatnonzero(shapely.area(found) > min_um2)
    on_grid = shapely.intersection(first[again], second[again], grid_size=FINE_GRID_UM)
    is_wrong = shapely.area(on_grid) < (1.0 - AGREEMENT) * shapely.area(found[again])
    found[again[is_wrong]] = on_grid[is_wrong]
    return found


def points_on_edges(
    points_um: Floats, begin_um: Floats, end_um: Floats, tolerance_um: float = ON_EDGE_UM
) -> tuple[Ints, Ints, Floats]:
    """
    Return the points that lie on edges, end points excluded.

    ``points_um``: (n_point, 2) float64, µm. ``begin_um``, ``end_um``: (n_edge, 2) float64, µm. ``tolerance_um`` (float, µm):
    distance within which a point lies on an edge. Returns ``edge``, ``point`` (n,) int64. ``fraction`` (n,) float64: position
    along the edge, from 0 to 1.
    """
    edges = shapely.linestrings(np.stack((begin_um, end_um), axis=1))
    edge, point = shapely.STRtree(shapely.points(points_um)).query(edges, predicate="dwithin", distance=tolerance_um)
    along = end_um[edge] - begin_um[edge]
    length2 = np.einsum("ij,ij->i", along, along)
    fraction = np.einsum("ij,ij->i", points_um[point] - begin_um[edge], along) / length2
    margin = tolerance_um / np.sqrt(length2)
    is_inside = (fraction > margin) & (fraction < 1.0 - margin)
    return edge[is_inside], point[is_inside], fraction[is_inside]


def insert_points(
    xy_um: Floats, ring_offsets: Ints, points_um: Floats, tolerance_um: float = ON_EDGE_UM
) -> tuple[Floats, Ints, Ints]:
    """
    Insert points as vertices into the edges on which they lie.

    ``xy_um``: (n_vertex, 2) float64, µm. ``ring_offsets``: (n_ring + 1,) int64. ``points_um``: (n_point, 2) float64, µm.
    ``tolerance_um`` (float, µm): distance within which a point lies on an edge. Returns ``xy_um`` (n, 2) float64, µm.
    ``ring_offsets`` (n_ring + 1,) int64. ``point`` (n - n_vertex,) int64: inserted points, those of several edges repeatedly.
    """
    n_vertices = xy_um.shape[0]
    edge, point, fraction = points_on_edges(points_um, xy_um, xy_um[next_vertex(ring_offsets)], tolerance_um)
    # The new vertices follow the first one of the edge, in order along it.
    owner = np.concatenate((np.arange(n_vertices), edge))
    order = np.lexsort((np.concatenate((np.zeros(n_vertices), fraction)), owner))
    starts = np.concatenate(([0], np.cumsum(np.bincount(edge, minlength=n_vertices) + 1)))
    return np.concatenate((xy_um, points_um[point]))[order], starts[ring_offsets], point


def node_edges(begin_um: Floats, end_um: Floats) -> tuple[Floats, Floats]:
    """
    Return edges with coincident end points merged, split at end points of other edges.

    ``begin_um``, ``end_um``: (n_edge, 2) float64, µm. Returns ``begin_um``, ``end_um`` (n, 2) float64, µm.
    """
    points, ends = merge_coincident_points(np.concatenate((begin_um, end_um)))
    first, last = np.split(ends, 2)
    is_edge = first != last
    first, last = first[is_edge], last[is_edge]
    if first.size == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    edge, point, fraction = points_on_edges(points, points[first], points[last])
    # Each edge becomes a run of points: its start, the points on it in order, its end.
    owner = np.concatenate((np.arange(first.size), edge, np.arange(first.size)))
    order = np.lexsort((np.concatenate((np.full(first.size, -1.0), fraction, np.full(first.size, 2.0))), owner))
    run = np.concatenate((first, point, last))[order]
    is_step = np.diff(owner[order]) == 0
    return points[run[:-1][is_step]], points[run[1:][is_step]]


def merge_coincident_points(xy_um: Floats) -> tuple[Floats, Ints]:
    """Return the points without duplicates within rounding, and the index of each in them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    points, index = np.unique(xy_um, axis=0, return_inverse=True)
    pairs = cKDTree(points).query_pairs(ON_EDGE_UM, output_type="ndarray")
    if pairs.size == 0:
        return points, index.ravel()
    graph = coo_array((np.ones(pairs.shape[0], bool), (pairs[:, 0], pairs[:, 1])), shape=(points.shape[0],) * 2)
    group = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
    _, first = np.unique(group, return_index=True)
    return points[first], group[index.ravel()]
