"""Gaps between neighbouring photosites, such as trenches, and outlines that close them."""

from __future__ import annotations

import numpy as np
import shapely

from foveasim._core.rings import next_vertex, positions_in_runs, site_area_um2, site_bounds_um
from foveasim._core.validation import Bools, Floats, Ints, freeze
from foveasim.fields import Outlines, PackedRings
from foveasim.layout.adjacency import TOUCHING_UM, near_boxes
from foveasim.layout.lattice import RectangleLattice
from foveasim.layout.model import Layout

__all__ = ["close_gaps", "edge_gaps_um"]

#: Largest gap relative to the size (root of the area) of the smaller neighbour. A missing site of a grid, or the blind spot of
#: a log-polar layout, is at least twice as wide.
MAX_GAP_FRACTION = 0.5
#: Largest displacement of a vertex relative to that of its edges: sharper corners are not extended as far.
MITRE_LIMIT = 10.0
#: Sine of the angle between edges that count as one straight line.
STRAIGHT = 1e-3


def edge_gaps_um(layout: PackedRings, sites: Ints | None = None) -> Floats:
    """
    Return the width of the gap in front of each edge.

    (n_vertex,) µm, infinite without a neighbour. The edge of a vertex leads to the next one of its ring. A neighbour is a site
    with an edge of opposite direction in front of this one, whose distance is at most :data:`MAX_GAP_FRACTION` of the size of
    the smaller site; the nearest one counts. ``sites`` limits the search to gaps between these sites.
    """
    from foveasim.layout import _kernels

    xy_um, ring_offsets, site_offsets = layout.xy_um, layout.ring_offsets, layout.site_offsets
    sites = np.arange(site_offsets.size - 1) if sites is None else sites
    limit_um = MAX_GAP_FRACTION * np.sqrt(site_area_um2(xy_um, ring_offsets, site_offsets)) + TOUCHING_UM
    first, second = near_boxes(site_bounds_um(xy_um, ring_offsets, site_offsets)[sites], limit_um[sites])
    gap_um = np.full(xy_um.shape[0], np.inf)
    _kernels.edge_gaps(
        xy_um,
        next_vertex(ring_offsets),
        ring_offsets[site_offsets],
        sites[np.concatenate((first, second))],
        sites[np.concatenate((second, first))],
        limit_um,
        TOUCHING_UM,
        gap_um,
    )
    return gap_um


def close_gaps(layout: PackedRings, sites: Ints | None = None) -> PackedRings | None:
    """
    Return outlines with edges moved outwards by half the gap to their neighbours.

    None if there are no gaps. Edges without a neighbour stay where they are, so that blind spots remain. ``sites`` as for
    :func:`edge_gaps_um`. The inverse of :func:`foveasim.layout.inset` where sites tile: equal up to rounding at all vertices
    between two edges with neighbours. Sites that would lose area, or whose outline would cross itself, keep theirs.
    """
    lattice: RectangleLattice | None = getattr(layout, "lattice", None)
    if lattice is not None:
        return _close_lattice(lattice)
    gap_um = edge_gaps_um(layout, sites)
    offset_um = 0.5 * np.where(np.isfinite(gap_um), gap_um, 0.0)
    if not (offset_um > TOUCHING_UM).any():
        return None
    moved_um = layout.xy_um + _mitred(layout.xy_um, layout.ring_offsets, offset_um)
    before_um2 = site_area_um2(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    is_kept = site_area_um2(moved_um, layout.ring_offsets, layout.site_offsets) < before_um2
    is_kept |= ~_are_simple(moved_um, layout.ring_offsets, layout.site_offsets)
    is_kept = np.repeat(is_kept, np.diff(layout.ring_offsets[layout.site_offsets]))[:, np.newaxis]
    return Outlines(freeze(np.where(is_kept, layout.xy_um, moved_um)), layout.ring_offsets, layout.site_offsets)


def _are_simple(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> Bools:
    """Return whether no ring of a site crosses itself, (n_site,)."""
    n_vertices = np.diff(ring_offsets) + 1  # with the first one again
    ring_of = np.repeat(np.arange(n_vertices.size), n_vertices)
    vertices = ring_offsets[ring_of] + positions_in_runs(n_vertices) % (n_vertices - 1)[ring_of]
    is_simple = shapely.is_valid(shapely.polygons(shapely.linearrings(xy_um[vertices], indices=ring_of)))
    return np.logical_and.reduceat(is_simple, site_offsets[:-1])


def _mitred(xy_um: Floats, ring_offsets: Ints, offset_um: Floats) -> Floats:
    """Return the displacements of vertices by which each edge moves outwards by its offset."""
    following = next_vertex(ring_offsets)
    edge_um = xy_um[following] - xy_um
    length_um = np.hypot(*edge_um.T)[:, np.newaxis]
    outwards = np.stack((edge_um[:, 1], -edge_um[:, 0]), axis=1) / np.where(length_um == 0.0, 1.0, length_um)
    before = np.empty_like(following)
    before[following] = np.arange(following.size)
    (n1, n2), (o1, o2) = (outwards[before], outwards), (offset_um[before], offset_um)
    sine = n1[:, 0] * n2[:, 1] - n1[:, 1] * n2[:, 0]
    is_straight = np.abs(sine) < STRAIGHT
    divisor = np.where(is_straight, 1.0, sine)
    # The point whose distances from both edges are their offsets; on straight lines the mean offset.
    corner_um = (
        np.stack((o1 * n2[:, 1] - o2 * n1[:, 1], o2 * n1[:, 0] - o1 * n2[:, 0]), axis=1) / divisor[:, np.newaxis]
    )
    along_um = (0.5 * (o1 + o2))[:, np.newaxis] * n2
    moved_um = np.where(is_straight[:, np.newaxis], along_um, corner_um)
    longest_um = MITRE_LIMIT * np.maximum(o1, o2)
    distance_um = np.hypot(*moved_um.T)
    factor = np.minimum(1.0, longest_um / np.where(distance_um == 0.0, 1.0, distance_um))
    return np.asarray(moved_um * factor[:, np.newaxis])


def _close_lattice(lattice: RectangleLattice) -> Layout | None:
    """Return the lattice without gaps between rows and columns, None if it has none."""
    closed = RectangleLattice(_close_intervals(lattice.x_um), _close_intervals(lattice.y_um))
    if np.array_equal(closed.x_um, lattice.x_um) and np.array_equal(closed.y_um, lattice.y_um):
        return None
    return Layout.from_lattice(closed)


def _close_intervals(intervals_um: Floats) -> Floats:
    """Extend intervals (n, 2), in any order, to the centres of the gaps between them."""
    order = np.argsort(intervals_um[:, 0], kind="stable")
    low, high = intervals_um[order].T.copy()
    width = high - low
    gap = low[1:] - high[:-1]
    is_gap = (gap > TOUCHING_UM) & (gap <= MAX_GAP_FRACTION * np.minimum(width[1:], width[:-1]))
    half = np.where(is_gap, 0.5 * gap, 0.0)
    low[1:] -= half
    high[:-1] += half
    found = np.empty_like(intervals_um)
    found[order] = np.stack((low, high), axis=1)
    return found
