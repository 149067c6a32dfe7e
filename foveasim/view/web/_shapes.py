"""Outlines and triangles of photosites for pages, with shared vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.layout import Layout
from foveasim.view.meshes import delaunay, triangle_fans

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

    ``layout``: with at least one site.

    A fan from a vertex fills a simple ring when none of its triangles is reversed. Convex sites therefore need no explicit
    triangles, nor do sites that the fan from their sharpest reflex vertex fills.
    """
    xy_um, ring_offsets = layout.xy_um, layout.ring_offsets
    first_ring = layout.site_offsets[:-1]
    has_one_ring = np.diff(layout.site_offsets) == 1
    is_filled = has_one_ring.copy()
    is_filled[is_filled] = _is_filled(layout, np.flatnonzero(is_filled))
    left = np.flatnonzero(~is_filled & has_one_ring)
    if left.size:
        order = np.arange(xy_um.shape[0])
        part = layout[left]
        fans, smallest = triangle_fans(part.xy_um, part.ring_offsets)
        is_filled[left] = smallest >= -ROUNDING
        counts, starts = np.diff(part.ring_offsets), part.ring_offsets[:-1]
        shift = fans[starts - 2 * np.arange(left.size), 0] - starts
        begin, within = np.repeat(ring_offsets[first_ring[left]], counts), positions_in_runs(counts)
        order[begin + within] = begin + (within + np.repeat(shift, counts)) % np.repeat(counts, counts)
        xy_um = xy_um[order]
    xy_um, position = _unique_positions(xy_um)
    cut_sites = np.flatnonzero(~is_filled)
    # Self-intersecting outlines, which only the plain constructor accepts, are drawn as their enclosed area.
    cuts, owner, *_ = delaunay(layout, cut_sites, is_repaired=True)
    cut_offsets = np.searchsorted(owner, np.append(cut_sites, layout.n_sites))
    return Shapes(xy_um, position, layout.ring_offsets, layout.site_offsets, cut_sites, cut_offsets, cuts)


def _unique_positions(xy_um: Floats) -> tuple[Floats, Ints]:
    """Return distinct positions in order of their first vertex, and each vertex's position."""
    from foveasim.view._kernels import number_points

    xy_um = np.ascontiguousarray(xy_um) + 0.0  # replaces -0 by 0
    position, first = np.empty((2, xy_um.shape[0]), np.int64)
    n_distinct = number_points(xy_um.view(np.uint64), position, first)
    return xy_um.take(first[:n_distinct], axis=0), position


def _is_filled(layout: Layout, sites: Ints) -> Bools:
    """
    Return whether the fan from the first vertex of a site has no reversed triangle.

    ``sites``: with one ring each.
    """
    from foveasim.view._kernels import smallest_fan_triangles

    rings = layout.site_offsets[sites]
    smallest_um2 = smallest_fan_triangles(layout.xy_um, layout.ring_offsets[rings], layout.ring_offsets[rings + 1])
    return np.asarray(smallest_um2 >= -ROUNDING * np.abs(layout.area_um2[sites]))
