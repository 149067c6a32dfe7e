"""Cleaning of layouts: snapped vertices, filled gaps, resolved overlaps, and the changes."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.calls import LENGTH, check_arguments
from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.validation import Bools, Floats, Ints, freeze
from foveasim.errors import GeometryError
from foveasim.layout.adjacency import near_boxes
from foveasim.layout.drc.repair import Change, Changes, Stock
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.edits._parts import concatenate_layouts
from foveasim.layout.model import Layout, derived, layout_of

__all__ = ["clean", "cleaned"]

#: Distance of vertices that become one, relative to the tolerance: the diagonal of a crossing of two gaps of this width. With
#: less than 1 / 0.87, the height of an equilateral triangle, two of its edges could pass through each other's ends in turns.
VERTEX_DISTANCE = 2.0**0.5
#: Rounds of snapping, each of which removes vertices or divides edges at vertices; a few suffice.
MAX_ROUNDS = 60
#: Largest number of vertices, relative to that of the input.
MAX_GROWTH = 64
#: Error of the width of a gap, relative to the tolerance.
WIDTH_ERROR = 1e-3

#: Two vertices of each edge, the lower one first.
Edges: TypeAlias = Ints


class _Mesh(NamedTuple):
    """
    Rings as indices of shared points.

    ``points_um`` (n_point, 2). ``weight`` (n_point,): number of input points that each stands for. ``vertex`` (n_vertex,):
    points of the rings. ``ring_offsets``, ``site_offsets``: as those of a layout. ``of_input``: point of each input vertex.
    """

    points_um: Floats
    weight: Floats
    vertex: Ints
    ring_offsets: Ints
    site_offsets: Ints
    of_input: Ints


@check_arguments
def clean(layout: Layout, tolerance_um: Annotated[float, LENGTH]) -> tuple[Layout, Changes]:
    """
    Return a layout without gaps and overlaps up to a tolerance, and the changes.

    Parameters
    ----------
    layout : Layout
    tolerance_um : float, µm
        Width of gaps and overlaps. Edges within this distance of a vertex pass through it, and vertices within √2 of it, the
        diagonal of a crossing of gaps, become one at their mean. Gaps that are nowhere wider are filled; wider ones remain.

    Returns
    -------
    layout : Layout
        The same sites in the same order, with their columns. Neighbours share vertices and edges exactly. Sites without
        changes have the same vertices.
    changes : Changes
        Sequence of :class:`Change` with the action ``"snapped"`` (vertices moved), ``"noded"`` (only vertices added),
        ``"filled"`` (area of gaps added) or ``"cut"`` (area of overlaps removed), and the area that each site lost.

    Raises
    ------
    GeometryError
        When a site would vanish, as it is narrower than the tolerance or lies below another one, or would be divided;
        ``.site_ids`` are their indices.

    Notes
    -----
    Areas wider than the tolerance in which sites overlap belong to the smallest of these sites; of sites of equal area, to the
    one whose centroid has the lower x, then y. Gaps that remain after snapping belong to the neighbour with the longest
    common boundary. The order of the sites does not matter. Cleaning a clean layout changes nothing.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles([[0.0, 0.0], [4.002, 0.0]], 4.0)  # a gap of 2 nm
    >>> closed, changes = fs.layout.clean(layout, 0.005)
    >>> closed.area_um2.round(3).tolist(), changes[0].action
    ([16.004, 16.004], 'snapped')
    """
    mesh = _snap(layout, tolerance_um)
    rings_um, is_cut, is_filled = _resolve(mesh, tolerance_um)
    result = layout_of(*rings_um)
    is_moved = np.zeros(layout.n_sites, bool)
    moved = (mesh.points_um[mesh.of_input] != layout.xy_um).any(axis=1)
    is_moved[_site_of_vertex(layout)[moved]] = True
    n_vertices = np.diff(result.ring_offsets[result.site_offsets])
    is_noded = n_vertices != np.diff(layout.ring_offsets[layout.site_offsets])
    is_noded &= ~(is_moved | is_cut | is_filled)
    is_changed = is_moved | is_cut | is_filled | is_noded
    if not is_changed.any():
        return layout, Changes((), Stock.of(layout), Stock.of(layout))
    result = _with_unchanged(layout, result, is_changed)
    lost_um2 = layout.area_um2 - result.area_um2
    actions: tuple[tuple[str, Literal["snapped", "noded", "filled", "cut"], Bools], ...] = (
        ("tolerance_um", "snapped", is_moved),
        ("tolerance_um", "noded", is_noded),
        ("gaps", "filled", is_filled),
        ("overlaps", "cut", is_cut),
    )
    changes = [
        Change(rule, action, tuple(sites.tolist()), tuple(lost_um2[sites].tolist()))
        for rule, action, chosen in actions
        if (sites := np.flatnonzero(chosen)).size
    ]
    found = derived(layout, f"cleaned within {tolerance_um:g} µm", result.rings_um)
    return found, Changes(tuple(changes), Stock.of(layout), Stock.of(found))


@layout_edit(example={"tolerance_um": 0.005}, name="clean")
def cleaned(layout: Layout, *, tolerance_um: Annotated[float, LENGTH]) -> Layout:
    """
    Return a layout without gaps and overlaps up to a tolerance, as :func:`clean`.

    Parameters
    ----------
    layout : Layout
    tolerance_um : float, µm
        As for :func:`clean`.

    Raises
    ------
    GeometryError
        As for :func:`clean`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles(
    ...     [[0.0, 0.0], [3.997, 0.0]], 4.0
    ... )  # an overlap of 3 nm
    >>> fs.layout.cleaned(layout, tolerance_um=0.005).check(
    ...     fs.DesignRules(max_overlap_um2=0.0)
    ... ).ok
    True
    """
    return clean(layout, tolerance_um)[0]


def _with_unchanged(layout: Layout, result: Layout, is_changed: Bools) -> Layout:
    """Return the result with the unchanged sites of the input, bit by bit."""
    kept, changed = np.flatnonzero(~is_changed), np.flatnonzero(is_changed)
    order = np.argsort(np.concatenate((kept, changed)))
    return layout_of(*concatenate_layouts([layout[kept], result[changed]]))[order]


def _site_of_vertex(layout: Layout) -> Ints:
    return np.repeat(np.arange(layout.n_sites), np.diff(layout.ring_offsets[layout.site_offsets]))


def _require_sites(is_bad: Bools, what: str) -> None:
    bad = np.flatnonzero(is_bad)
    if bad.size:
        others = f" (and {bad.size - 1} more)" if bad.size > 1 else ""
        raise GeometryError(
            f"site {bad[0]} would {what}{others}; correct it, or take a smaller tolerance", tuple(bad.tolist())
        )


# -- snapping -----------------------------------------------------------------------------------------------------------


def _snap(layout: Layout, tolerance_um: float) -> _Mesh:
    """Return rings whose edges meet at common vertices only, further apart than the tolerance."""
    points_um, vertex = np.unique(layout.xy_um, axis=0, return_inverse=True)
    vertex = np.asarray(vertex.ravel(), np.int64)
    mesh = _Mesh(points_um, np.ones(points_um.shape[0]), vertex, layout.ring_offsets, layout.site_offsets, vertex)
    for _ in range(MAX_ROUNDS):
        mesh, n_merged = _merge_points(mesh, VERTEX_DISTANCE * tolerance_um)
        mesh = _without_spikes(mesh)
        mesh, n_inserted = _insert_points(mesh, tolerance_um)
        mesh = _without_spikes(mesh)
        if not n_merged and not n_inserted:
            crossings_um = _crossings_um(mesh)
            if not crossings_um.size:
                return mesh
            weight = np.concatenate((mesh.weight, np.ones(crossings_um.shape[0])))
            mesh = mesh._replace(points_um=np.concatenate((mesh.points_um, crossings_um)), weight=weight)
            mesh, _ = _insert_points(mesh, tolerance_um)
        if mesh.vertex.size > MAX_GROWTH * vertex.size:
            break
    raise GeometryError("snapping does not settle; take another tolerance")


def _merge_points(mesh: _Mesh, tolerance_um: float) -> tuple[_Mesh, int]:
    """Merge points within the tolerance, repeatedly, and return the number of merged ones."""
    from scipy.spatial import cKDTree

    n_before = mesh.points_um.shape[0]
    while True:
        # Points in the order of their coordinates, so that the order of sites does not decide.
        order = np.lexsort(mesh.points_um.T[::-1])
        pairs = cKDTree(mesh.points_um[order]).query_pairs(tolerance_um, output_type="ndarray")
        if pairs.size == 0:
            return mesh, n_before - mesh.points_um.shape[0]
        group = np.empty(order.size, np.int64)
        group[order] = _groups(order.size, pairs)
        labels, group = np.unique(group, return_inverse=True)
        total = np.asarray(np.bincount(group, mesh.weight), np.float64)
        first = np.empty(labels.size, np.int64)
        first[group[::-1]] = np.arange(group.size)[::-1]
        mean_um = np.stack([np.bincount(group, mesh.weight * mesh.points_um[:, i]) / total for i in (0, 1)], axis=1)
        is_single = np.bincount(group) == 1
        mean_um[is_single] = mesh.points_um[first[is_single]]
        mesh = mesh._replace(points_um=mean_um, weight=total, vertex=group[mesh.vertex], of_input=group[mesh.of_input])


def _groups(n: int, pairs: Ints) -> Ints:
    """
    Return the number of the group of each of n points.

    In their order, each point that is in no group yet starts one with its neighbours that are in none. Groups are no larger
    than the tolerance around this point, which chains of neighbours would be.
    """
    both = np.concatenate((pairs, pairs[:, ::-1]))
    both = both[np.lexsort(both.T[::-1])]
    near, starts = np.unique(both[:, 0], return_index=True)
    stops = np.append(starts[1:], both.shape[0]).tolist()
    group = np.arange(n)
    is_grouped = np.zeros(n, bool)
    neighbours = both[:, 1]
    for point, start, stop in zip(near.tolist(), starts.tolist(), stops, strict=True):
        if not is_grouped[point]:
            others = neighbours[start:stop]
            others = others[~is_grouped[others]]
            is_grouped[point] = True
            is_grouped[others] = True
            group[others] = point
    return group


def _without_spikes(mesh: _Mesh) -> _Mesh:
    """Remove repeated vertices, ends of edges there and back, and rings without area."""
    while True:
        following = next_vertex(mesh.ring_offsets)
        before = np.empty_like(following)
        before[following] = np.arange(following.size)
        is_removed = mesh.vertex == mesh.vertex[following]
        if not is_removed.any():
            is_removed = mesh.vertex[before] == mesh.vertex[following]
        if not is_removed.any():
            return mesh
        n_left = np.add.reduceat((~is_removed).astype(np.int64), mesh.ring_offsets[:-1])
        ring_of = np.repeat(np.arange(n_left.size), np.diff(mesh.ring_offsets))
        is_ring = n_left >= 3
        outlines = mesh.site_offsets[:-1]
        _require_sites(~is_ring[outlines], "vanish, as it is narrower than the tolerance")
        n_rings = np.add.reduceat(is_ring.astype(np.int64), outlines)
        mesh = mesh._replace(
            vertex=mesh.vertex[~is_removed & is_ring[ring_of]],
            ring_offsets=np.concatenate(([0], np.cumsum(n_left[is_ring]))),
            site_offsets=np.concatenate(([0], np.cumsum(n_rings))),
        )


def _edges(mesh: _Mesh) -> tuple[Edges, Ints, Bools]:
    """Return distinct edges (n, 2), and for each vertex its edge, and if it is its lower end."""
    start, stop = mesh.vertex, mesh.vertex[next_vertex(mesh.ring_offsets)]
    key = np.minimum(start, stop) * mesh.points_um.shape[0] + np.maximum(start, stop)
    keys, edge = np.unique(key, return_inverse=True)
    return np.stack(np.divmod(keys, mesh.points_um.shape[0]), axis=1), edge.ravel(), start < stop


def _insert_points(mesh: _Mesh, tolerance_um: float) -> tuple[_Mesh, int]:
    """Let edges pass through points within the tolerance; return the number of pairs."""
    edges, edge_of, is_forward = _edges(mesh)
    ends_um = mesh.points_um[edges]
    tree = shapely.STRtree(shapely.points(mesh.points_um))
    edge, point = tree.query(shapely.linestrings(ends_um), predicate="dwithin", distance=tolerance_um)
    is_other = (point != edges[edge, 0]) & (point != edges[edge, 1])
    edge, point = edge[is_other], point[is_other]
    begin_um = ends_um[edge, 0]
    along_um = ends_um[edge, 1] - begin_um
    fraction = np.einsum("ij,ij->i", mesh.points_um[point] - begin_um, along_um) / np.einsum(
        "ij,ij->i", along_um, along_um
    )
    is_between = (fraction > 0.0) & (fraction < 1.0)
    order = np.lexsort((fraction[is_between], edge[is_between]))
    edge, point = edge[is_between][order], point[is_between][order]
    if edge.size == 0:
        return mesh, 0
    count = np.bincount(edge, minlength=edges.shape[0])
    first = np.cumsum(count) - count
    n_new = 1 + count[edge_of]
    owner, position = np.repeat(np.arange(edge_of.size), n_new), positions_in_runs(n_new)
    vertex = mesh.vertex[owner]
    is_inserted = position > 0
    of, k = owner[is_inserted], position[is_inserted] - 1
    k = np.where(is_forward[of], k, count[edge_of[of]] - 1 - k)
    vertex[is_inserted] = point[first[edge_of[of]] + k]
    ring_offsets = np.concatenate(([0], np.cumsum(n_new)))[mesh.ring_offsets]
    return mesh._replace(vertex=vertex, ring_offsets=ring_offsets), edge.size


def _crossings_um(mesh: _Mesh) -> Floats:
    """Return the points (n, 2) in which edges cross; no vertex is near another edge."""
    edges, _, _ = _edges(mesh)
    begin_um, end_um = mesh.points_um[edges[:, 0]], mesh.points_um[edges[:, 1]]
    boxes_um = np.concatenate((np.minimum(begin_um, end_um), np.maximum(begin_um, end_um)), axis=1)
    one, other = near_boxes(boxes_um, 0.0)
    along_um, across_um = (end_um - begin_um)[one], (end_um - begin_um)[other]
    first, last = (_cross(along_um, xy[other] - begin_um[one]) for xy in (begin_um, end_um))
    begin, end = (_cross(across_um, xy[one] - begin_um[other]) for xy in (begin_um, end_um))
    is_crossing = (first * last < 0.0) & (begin * end < 0.0)
    fraction = (first / np.where(is_crossing, first - last, 1.0))[is_crossing, np.newaxis]
    return np.unique(begin_um[other][is_crossing] + fraction * across_um[is_crossing], axis=0)


def _cross(u: Floats, v: Floats) -> Floats:
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


# -- gaps and overlaps ------------------------------------------------------------------------------------------------------


def _polygons(mesh: _Mesh) -> NDArray[Any]:
    """Return the polygons of the sites, which may touch themselves."""
    rings = shapely.linearrings(
        mesh.points_um[mesh.vertex],
        indices=np.repeat(np.arange(mesh.ring_offsets.size - 1), np.diff(mesh.ring_offsets)),
    )
    polygons = shapely.polygons(
        rings, indices=np.repeat(np.arange(mesh.site_offsets.size - 1), np.diff(mesh.site_offsets))
    )
    return np.asarray(polygons)


def _resolve(mesh: _Mesh, tolerance_um: float) -> tuple[tuple[Floats, Ints, Ints], Bools, Bools]:
    """
    Return packed rings of the sites without narrow gaps and overlaps.

    Also returns whether each site is cut, and whether it is filled. The faces between all edges have one owner each.
    """
    polygons = _polygons(mesh)
    n_sites = polygons.size
    is_invalid = ~shapely.is_valid(polygons)
    polygons[is_invalid] = shapely.make_valid(polygons[is_invalid])
    edges, _, _ = _edges(mesh)
    faces = shapely.get_parts(shapely.polygonize(shapely.linestrings(mesh.points_um[edges])))
    inside = shapely.point_on_surface(faces)
    face, site = shapely.STRtree(polygons).query(inside, predicate="intersects")
    priority = _priority(polygons)
    order = np.lexsort((priority[site], face))
    face, site = face[order], site[order]
    owner = np.full(faces.size, -1)
    owner[face[::-1]] = site[::-1]  # the first one of each face
    is_cut, is_filled = np.zeros(n_sites, bool), np.zeros(n_sites, bool)
    is_cut[site[owner[face] != site]] = True
    gaps = np.flatnonzero(owner < 0)
    gaps = gaps[_are_narrow(faces[gaps], tolerance_um)]
    if gaps.size:
        owner[gaps] = _longest_neighbours(faces, owner, gaps, priority)
        is_filled[owner[gaps][owner[gaps] >= 0]] = True
    is_rebuilt = is_cut | is_filled | is_invalid
    owned = np.flatnonzero(owner >= 0)
    owned = owned[is_rebuilt[owner[owned]]]
    owned = owned[np.argsort(owner[owned], kind="stable")]
    sites, starts, counts = np.unique(owner[owned], return_index=True, return_counts=True)
    _require_sites(is_rebuilt & ~np.isin(np.arange(n_sites), sites), "vanish, as it lies below other sites")
    for number, start, count in zip(sites.tolist(), starts.tolist(), counts.tolist(), strict=True):
        part = owned[start : start + count]
        polygons[number] = faces[part[0]] if part.size == 1 else shapely.coverage_union_all(faces[part])
    is_divided = shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON
    _require_sites(is_divided, "be divided into several parts")
    plain = layout_of(mesh.points_um[mesh.vertex], freeze(mesh.ring_offsets), freeze(mesh.site_offsets))
    if not is_rebuilt.any():
        return plain.rings_um, is_cut, is_filled
    rebuilt = Layout.from_polygons(polygons[is_rebuilt])
    return _with_unchanged(plain, _spread(rebuilt, is_rebuilt, plain), is_rebuilt).rings_um, is_cut, is_filled


def _spread(rebuilt: Layout, is_rebuilt: Bools, plain: Layout) -> Layout:
    """Return the rebuilt sites at their numbers, with any sites at the others."""
    order = np.argsort(np.concatenate((np.flatnonzero(~is_rebuilt), np.flatnonzero(is_rebuilt))))
    return layout_of(*concatenate_layouts([plain[~is_rebuilt], rebuilt]))[order]


def _priority(polygons: NDArray[Any]) -> Ints:
    """Return ranks (n,) by area, then centroid: the lowest one has the area of an overlap."""
    centroid = shapely.get_coordinates(shapely.centroid(polygons))
    order = np.lexsort((centroid[:, 1], centroid[:, 0], shapely.area(polygons)))
    rank = np.empty(order.size, np.int64)
    rank[order] = np.arange(order.size)
    return rank


def _are_narrow(faces: NDArray[Any], tolerance_um: float) -> Bools:
    """Return whether no circle of the tolerance as diameter fits into each face."""
    # The inscribed circle has a radius of at least area / perimeter.
    is_narrow = 2.0 * shapely.area(faces) <= tolerance_um * shapely.length(faces)
    for i in np.flatnonzero(is_narrow):
        radius = shapely.maximum_inscribed_circle(faces[i], tolerance=WIDTH_ERROR * tolerance_um)
        is_narrow[i] = 2.0 * shapely.length(radius) <= tolerance_um
    return np.asarray(is_narrow)


def _longest_neighbours(faces: NDArray[Any], owner: Ints, gaps: Ints, priority: Ints) -> Ints:
    """Return the site with the longest common boundary with each gap, -1 without one."""
    rings, face = shapely.get_rings(faces, return_index=True)
    closed_um, ring = shapely.get_coordinates(rings, return_index=True)
    is_start = ring[1:] == ring[:-1]
    edge_face = face[ring[:-1][is_start]]
    start, stop = (
        np.ascontiguousarray(xy).view(np.complex128).ravel()
        for xy in (closed_um[:-1][is_start], closed_um[1:][is_start])
    )
    swap = (start.real > stop.real) | ((start.real == stop.real) & (start.imag > stop.imag))
    ends = np.stack((np.where(swap, stop, start), np.where(swap, start, stop)), axis=1).view(np.float64)
    _, edge = np.unique(ends, axis=0, return_inverse=True)
    order = np.argsort(edge.ravel(), kind="stable")
    edge = edge.ravel()[order]
    pair = np.flatnonzero(edge[1:] == edge[:-1])
    one, other = edge_face[order[pair]], edge_face[order[pair + 1]]
    length_um = np.abs(start - stop)[order[pair]]
    gap, site = np.concatenate((one, other)), owner[np.concatenate((other, one))]
    length_um = np.concatenate((length_um, length_um))
    is_gap = np.isin(gap, gaps) & (site >= 0)
    found = np.full(faces.size, -1)
    pairs, number = np.unique(np.stack((gap, site))[:, is_gap], axis=1, return_inverse=True)
    total_um = np.bincount(number.ravel(), length_um[is_gap])
    order = np.lexsort((priority[pairs[1]], -total_um, pairs[0]))
    found[pairs[0][order][::-1]] = pairs[1][order][::-1]
    return found[gaps]
