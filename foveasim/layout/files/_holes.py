"""
Polygons without holes, as GDSII and OASIS require them.

Sites with holes are divided into parts; keyholes of other programs are converted to holes.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.rings import positions_in_runs, ring_area_um2
from foveasim._core.validation import Floats, Ints
from foveasim.layout.model import Layout, layout_of, valid_sites
from foveasim.layout.packed import check_sizes

Point: TypeAlias = tuple[float, float]

#: Maximum number of vertices after noding an outline with slits, as a multiple of its own.
MAX_NODING_RATIO = 16


# -- writing ----------------------------------------------------------------------------------------------------------


def hole_free_rings(layout: Layout, max_vertices: int | None) -> tuple[Ints, Ints, Ints, list[Floats]]:
    """
    Return hole-free rings of all sites, in their order.

    Returns ``site``, ``part``, ``n_parts`` (n_ring,) int64: index of the site, number of the part from 1, and number of parts;
    0 and 0 for an undivided site. ``rings_um``, list of (n, 2), µm.
    """
    rings_of_site = np.diff(layout.site_offsets)
    outline = layout.site_offsets[:-1]
    starts, stops = layout.ring_offsets[outline], layout.ring_offsets[outline + 1]
    rings_um = [layout.xy_um[a:b] for a, b in zip(starts.tolist(), stops.tolist(), strict=True)]
    is_cut = rings_of_site > 1
    if max_vertices is not None:
        is_cut |= stops - starts > max_vertices
    n_parts = np.zeros(layout.n_sites, np.int64)
    if not is_cut.any():
        return np.arange(layout.n_sites), n_parts, n_parts, rings_um
    cut = np.flatnonzero(is_cut)
    parts_of = _halves(layout, np.flatnonzero(rings_of_site == 2), max_vertices)
    others = [s for s in cut.tolist() if s not in parts_of]
    parts_of |= {
        s: _hole_free_parts(polygon, max_vertices) for s, polygon in zip(others, layout[others].polygons(), strict=True)
    }
    n_parts[cut] = [len(parts_of[s]) for s in cut.tolist()]
    n_rings = np.maximum(n_parts, 1)
    site = np.repeat(np.arange(layout.n_sites), n_rings)
    part = positions_in_runs(n_rings) + 1
    pieces = [ring for s, undivided in enumerate(rings_um) for ring in parts_of.get(s, [undivided])]
    return site, np.where(n_parts[site] > 0, part, 0), n_parts[site], pieces


def _halves(layout: Layout, sites: Ints, max_vertices: int | None) -> dict[int, list[Floats]]:
    """
    Divide polygons with one hole into two rings, where this requires no additional vertex.

    The first and the middle vertex of the outline are connected to the nearest vertices of the hole. Polygons that contain
    these segments, and whose halves are valid, are in the result.
    """
    if sites.size == 0:
        return {}
    outline = layout.site_offsets[sites]
    (start, hole_start), (n, n_hole) = (
        (each[outline], each[outline + 1]) for each in (layout.ring_offsets[:-1], np.diff(layout.ring_offsets))
    )
    owner = np.repeat(np.arange(sites.size), n_hole)
    hole_xy = layout.xy_um[hole_start[owner] + positions_in_runs(n_hole)]
    anchor = np.stack((np.zeros_like(n), n // 2))
    nearest = np.empty_like(anchor)
    for k in (0, 1):
        distance = np.hypot(*(hole_xy - layout.xy_um[start + anchor[k]][owner]).T)
        nearest[k] = np.lexsort((distance, owner))[np.cumsum(n_hole) - n_hole] - (np.cumsum(n_hole) - n_hole)
    # The first half follows the outline from anchor 0 to 1, and the hole, in its own direction, from 1 back to 0.
    n_outer = np.stack((anchor[1] + 1, n - anchor[1] + 1)).ravel()
    n_inner = np.concatenate([(nearest[k] - nearest[1 - k]) % n_hole + 1 for k in (0, 1)])
    size = n_outer + n_inner
    half = np.repeat(np.arange(size.size), size)
    site, position = half % sites.size, positions_in_runs(size)
    inner = position - n_outer[half]
    on_outer = start[site] + (anchor.ravel()[half] + position) % n[site]
    on_hole = hole_start[site] + (nearest[::-1].ravel()[half] + inner) % n_hole[site]
    xy_um, ring_offsets = layout.xy_um[np.where(inner < 0, on_outer, on_hole)], np.concatenate(([0], np.cumsum(size)))
    rings = layout_of(xy_um, ring_offsets, np.arange(size.size + 1))
    polygons = layout[sites].polygons()
    is_divided = (nearest[0] != nearest[1]) & valid_sites(rings).reshape(2, -1).all(axis=0)
    if max_vertices is not None:
        is_divided &= (size.reshape(2, -1) <= max_vertices).all(axis=0)
    for k in (0, 1):
        ends = np.stack((layout.xy_um[start + anchor[k]], layout.xy_um[hole_start + nearest[k]]), axis=1)
        is_divided &= shapely.covers(polygons, shapely.linestrings(ends))
    offsets = ring_offsets.tolist()
    return {
        int(sites[i]): [xy_um[offsets[k] : offsets[k + 1]] for k in (i, i + sites.size)]
        for i in np.flatnonzero(is_divided).tolist()
    }


def _hole_free_parts(polygon: Any, max_vertices: int | None) -> list[Floats]:
    """
    Divide a polygon into rings without holes and without additional vertices.

    Triangles of a constrained Delaunay triangulation are merged as long as each adds a new vertex. Such a part has no
    repeated vertex, and is therefore simple and without holes.
    """
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corners = shapely.get_coordinates(shapely.normalize(triangles)).reshape(-1, 4, 2)[:, :3]
    points, ids = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    corner_ids = ids.reshape(-1, 3).tolist()
    neighbours: dict[tuple[int, int], list[int]] = {}
    for t, (a, b, c) in enumerate(corner_ids):
        for u, v in ((a, b), (b, c), (c, a)):
            neighbours.setdefault((min(u, v), max(u, v)), []).append(t)
    is_free = [True] * len(corner_ids)
    parts = []
    for first in range(len(corner_ids)):
        if is_free[first]:
            is_free[first] = False
            parts.append(points[_grow_part(first, corner_ids, neighbours, is_free, max_vertices)])
    return parts


def _grow_part(
    first: int,
    corner_ids: list[list[int]],
    neighbours: dict[tuple[int, int], list[int]],
    is_free: list[bool],
    max_vertices: int | None,
) -> list[int]:
    """Return the vertices, in order, of a part grown from one triangle; mark its triangles."""
    after = dict(zip(corner_ids[first], [*corner_ids[first][1:], corner_ids[first][0]], strict=True))
    edges = list(after.items())
    while edges and (max_vertices is None or len(after) < max_vertices):
        u, v = edges.pop()
        for t in neighbours[min(u, v), max(u, v)]:
            apex = next(w for w in corner_ids[t] if w not in (u, v))
            if is_free[t] and apex not in after:
                is_free[t] = False
                after[u], after[apex] = apex, v
                edges += [(u, apex), (apex, v)]
                break
    start = next(iter(after))
    ring = [start]
    while after[ring[-1]] != start:
        ring.append(after[ring[-1]])
    return ring


# -- reading ----------------------------------------------------------------------------------------------------------


def without_keyholes(polygons: NDArray[Any]) -> NDArray[Any]:
    """
    Convert outlines with keyholes to polygons with holes; other polygons are unchanged.

    Other programs write holes as keyholes: the outline reaches the hole through a slit of zero width.
    """
    invalid = np.flatnonzero(~shapely.is_valid(polygons) & (shapely.get_num_interior_rings(polygons) == 0))
    repaired = np.full(len(polygons), None)
    for i in invalid:
        repaired[i] = _polygon_from_rings(
            _split_into_rings(_node_path(list(map(tuple, shapely.get_coordinates(polygons[i]).tolist()))))
        )
    check_sizes(np.maximum(shapely.get_num_interior_rings(repaired), 0) + 1, shapely.get_num_coordinates(repaired))
    return np.where(shapely.is_valid(repaired), repaired, polygons)


def _node_path(path: list[Point]) -> list[Point]:
    """Node a closed path: insert its vertices that lie on its horizontal and vertical edges."""
    nodes: tuple[dict[float, list[float]], ...] = ({}, {})
    for axis, of_line in enumerate(nodes):
        for vertex in set(path):
            of_line.setdefault(vertex[axis], []).append(vertex[1 - axis])
        for values in of_line.values():
            values.sort()
    noded = path[:1]
    for a, b in pairwise(path):
        axis = 0 if a[0] == b[0] else 1
        # A path with too many nodes is not a valid outline.
        if a[axis] == b[axis] and len(noded) < MAX_NODING_RATIO * len(path):
            values, (low, high) = nodes[axis][a[axis]], sorted((a[1 - axis], b[1 - axis]))
            passed = values[bisect_right(values, low) : bisect_left(values, high)]
            on_line = [(a[0], v) if axis == 0 else (v, a[1]) for v in passed]
            noded += on_line if a < b else on_line[::-1]
        noded.append(b)
    return noded


def _split_into_rings(closed_path: list[Point]) -> list[list[Point]]:
    """Return the rings of a closed path without the edges traversed in both directions."""
    n_times = Counter(pairwise(closed_path))
    successors: dict[Point, list[Point]] = {}
    for (a, b), n in n_times.items():
        if a != b:
            successors.setdefault(a, []).extend([b] * (n - n_times[b, a]))
    rings = []
    for start in successors:
        path, index_of = [start], {start: 0}
        while successors[path[-1]]:
            vertex = successors[path[-1]].pop()
            at = index_of.setdefault(vertex, len(path))
            if at == len(path):
                path.append(vertex)
                continue
            rings.append(path[at:])
            for passed in path[at + 1 :]:
                del index_of[passed]
            del path[at + 1 :]
    return rings


def _polygon_from_rings(rings: list[list[Point]]) -> Any:
    """
    Return the polygon of the largest ring, with the others as holes.

    The result is None if another ring has the same winding order as the largest.
    """
    if not rings:
        return None
    offsets = np.cumsum([0, *map(len, rings)])
    area_um2 = ring_area_um2(np.array([vertex for ring in rings for vertex in ring]), offsets)
    outline = int(np.argmax(np.abs(area_um2)))
    is_hole = area_um2 * area_um2[outline] < 0.0
    if np.count_nonzero(is_hole) != len(rings) - 1:
        return None
    return shapely.Polygon(rings[outline], [ring for ring, is_in in zip(rings, is_hole, strict=True) if is_in])
