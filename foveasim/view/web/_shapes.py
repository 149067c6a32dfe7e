"""Outlines and triangles of photosites for pages, with shared vertices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.layout import Layout

__all__ = ["Shapes", "shapes_of"]

#: Tolerance for reversed triangles of a fan, as a fraction of the site's area.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Shapes:
    """
    Outlines and triangles of photosites.

    Attributes
    ----------
    xy_um : (n_place, 2) float64, µm
        Distinct vertex positions, in the order of their first use by a ring.
    position : (n_vertex,) int64
        Position of each vertex of each ring. Sites with one ring may begin at another vertex than in the layout.
    ring_offsets, site_offsets : int64
        As in the layout.
    cut_sites : (n_cut,) int64
        Sites that the fan from their first vertex does not fill, in ascending order. Fans fill all others.
    cut_offsets : (n_cut + 1,) int64
        Site ``cut_sites[i]`` has the triangles ``cut_offsets[i] : cut_offsets[i + 1]``.
    cuts : (n_triangle, 3) int64
        Vertices of these triangles.
    """

    xy_um: Floats
    position: Ints
    ring_offsets: Ints
    site_offsets: Ints
    cut_sites: Ints
    cut_offsets: Ints
    cuts: Ints


def shapes_of(layout: Layout) -> Shapes:
    """
    Return the outlines and triangles of a layout for a page.

    Parameters
    ----------
    layout : Layout
        With at least one site.

    Notes
    -----
    A fan from a vertex fills a simple ring when none of its triangles is reversed. Convex sites therefore need no explicit
    triangles, nor do sites that the fan from their deepest reflex vertex fills.
    """
    order, is_filled = _fans(layout, np.diff(layout.site_offsets) == 1)
    xy_um, position = _unique_positions(layout.xy_um[order])
    cut_sites = np.flatnonzero(~is_filled)
    cut_offsets, cuts = _triangulate(layout, cut_sites, position, xy_um)
    return Shapes(xy_um, position, layout.ring_offsets, layout.site_offsets, cut_sites, cut_offsets, cuts)


def _unique_positions(xy_um: Floats) -> tuple[Floats, Ints]:
    """Return distinct positions in order of their first vertex, and each vertex's position."""
    keys = (np.ascontiguousarray(xy_um) + 0.0).view(np.complex128)[:, 0]  # + 0.0 replaces -0 by 0
    _, first, position = np.unique(keys, return_index=True, return_inverse=True)
    rank = np.empty(first.size, np.int64)
    by_first = np.argsort(first)
    rank[by_first] = np.arange(first.size)
    return xy_um[first[by_first]], rank[position]


def _fans(layout: Layout, may_fan: Bools) -> tuple[Ints, Bools]:
    """Reorder vertices so that fans fill more sites; also return whether they fill each."""
    xy_um, ring_offsets = layout.xy_um, layout.ring_offsets
    n_vertices = np.diff(ring_offsets)
    first_ring = layout.site_offsets[:-1]
    tolerance_um2 = ROUNDING * np.abs(layout.area_um2)
    order = np.arange(xy_um.shape[0])
    is_filled = np.zeros(layout.n_sites, bool)
    is_filled[may_fan] = _is_filled(xy_um, ring_offsets, order, first_ring[may_fan], tolerance_um2[may_fan])
    left = np.flatnonzero(may_fan & ~is_filled)
    if left.size:
        # The deepest reflex vertex: the strongest right turn of the outline.
        after = next_vertex(ring_offsets)
        before = np.empty_like(after)
        before[after] = np.arange(after.size)
        a, b = xy_um - xy_um[before], xy_um[after] - xy_um
        turn_um2 = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        rings = first_ring[left]
        vertices = np.repeat(ring_offsets[rings], n_vertices[rings]) + positions_in_runs(n_vertices[rings])
        starts = np.cumsum(n_vertices[rings]) - n_vertices[rings]
        deepest_um2 = np.minimum.reduceat(turn_um2[vertices], starts)
        is_deepest = turn_um2[vertices] == np.repeat(deepest_um2, n_vertices[rings])
        step = np.where(is_deepest, positions_in_runs(n_vertices[rings]), vertices.size)
        shift = np.repeat(np.minimum.reduceat(step, starts), n_vertices[rings])
        within = (positions_in_runs(n_vertices[rings]) + shift) % np.repeat(n_vertices[rings], n_vertices[rings])
        order[vertices] = np.repeat(ring_offsets[rings], n_vertices[rings]) + within
        is_filled[left] = _is_filled(xy_um, ring_offsets, order, rings, tolerance_um2[left])
    return order, is_filled


def _is_filled(xy_um: Floats, ring_offsets: Ints, order: Ints, rings: Ints, tolerance_um2: Floats) -> Bools:
    """Return whether the fan from the first vertex of each ring has no reversed triangle."""
    if rings.size == 0:
        return np.zeros(0, bool)
    n_triangles = ring_offsets[rings + 1] - ring_offsets[rings] - 2
    apex = np.repeat(ring_offsets[rings], n_triangles)
    second = apex + 1 + positions_in_runs(n_triangles)
    centre = xy_um[order[apex]]
    a, b = xy_um[order[second]] - centre, xy_um[order[second + 1]] - centre
    area_um2 = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    starts = np.cumsum(n_triangles) - n_triangles
    return np.asarray(np.minimum.reduceat(area_um2, starts) >= -tolerance_um2)


def _triangulate(layout: Layout, sites: Ints, position: Ints, xy_um: Floats) -> tuple[Ints, Ints]:
    """Triangulate sites that fans do not fill (constrained Delaunay triangulation)."""
    if sites.size == 0:
        return np.zeros(1, np.int64), np.zeros((0, 3), np.int64)
    polygons = layout[sites].polygons()
    # Self-intersecting outlines, which only the plain constructor accepts, are drawn as their enclosed area.
    is_valid = shapely.is_valid(polygons)
    polygons[~is_valid] = shapely.buffer(polygons[~is_valid], 0.0)
    parts, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    corners_um = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    owner = sites[owner]
    # Corners are matched to vertices of their site by position; corners without a match come from the repair above.
    sorted_keys, by_key = _keys(xy_um)
    corner_keys = np.ascontiguousarray(corners_um.reshape(-1, 2) + 0.0).view(np.complex128)[:, 0]
    found = np.minimum(np.searchsorted(sorted_keys, corner_keys), sorted_keys.size - 1)
    is_known = sorted_keys[found] == corner_keys
    site_of_vertex = np.repeat(np.arange(layout.n_sites), np.diff(layout.ring_offsets[layout.site_offsets]))
    pair = site_of_vertex * xy_um.shape[0] + position
    by_pair = np.argsort(pair, kind="stable")
    target = np.repeat(owner, 3) * xy_um.shape[0] + by_key[found]
    at = np.minimum(np.searchsorted(pair[by_pair], target), pair.size - 1)
    vertex = by_pair[at]
    is_known &= pair[vertex] == target
    is_complete = is_known.reshape(-1, 3).all(axis=1)
    counts = np.bincount(np.searchsorted(sites, owner[is_complete]), minlength=sites.size)
    return np.concatenate(([0], np.cumsum(counts))), vertex.reshape(-1, 3)[is_complete]


def _keys(xy_um: Floats) -> tuple[NDArray[Any], Ints]:
    keys = np.ascontiguousarray(xy_um + 0.0).view(np.complex128)[:, 0]
    by_key = np.argsort(keys)
    return keys[by_key], by_key
