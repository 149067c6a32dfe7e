"""The layout room's numba kernels: widths of photosites, lengths of the edges that they share, colours of neighbours."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numba import njit, types

__all__ = ["colour_greedily", "min_widths", "shared_lengths"]

_ints = types.Array(types.int64, 1, "C", readonly=True)
_floats = types.Array(types.float64, 1, "C", readonly=True)
_points = types.Array(types.float64, 2, "C", readonly=True)

#: Edges face each other across the site when they run opposite ways within 26 degrees. At 45 degrees, say, the corners of
#: octagons and the near-right corners between a chord and a side would be measured as widths; this cosine is that of no
#: angle between edges of a regular figure.
MIN_OPPOSITION = 0.9


@njit(cache=True, nogil=True)
def _point_to_edge(px, py, ax, ay, bx, by):
    """Distance of a point from a segment."""
    dx, dy = bx - ax, by - ay
    t = ((px - ax) * dx + (py - ay) * dy) / (dx * dx + dy * dy)
    t = min(max(t, 0.0), 1.0)
    return np.hypot(px - ax - t * dx, py - ay - t * dy)


@njit(cache=True, nogil=True)
def _across_from_inward_corner(xy, a, b, after, first, last):
    """Distance from an inward corner b, straight across the site, to the nearest edge; infinite for an outward one."""
    bx, by = xy[b, 0], xy[b, 1]
    in_x, in_y = bx - xy[a, 0], by - xy[a, 1]
    out_x, out_y = xy[after[b], 0] - bx, xy[after[b], 1] - by
    nearest = np.inf
    if in_x * out_y - in_y * out_x >= 0.0:
        return nearest
    for k in range(first, last):
        if k in (a, b):
            continue
        cx, cy = xy[k, 0], xy[k, 1]
        ex, ey = xy[after[k], 0] - cx, xy[after[k], 1] - cy
        if ex * (by - cy) - ey * (bx - cx) <= 0.0:  # the corner is not on the edge's inner side
            continue
        t = min(max(((bx - cx) * ex + (by - cy) * ey) / (ex * ex + ey * ey), 0.0), 1.0)
        vx, vy = cx + t * ex - bx, cy + t * ey - by
        # Straight across: between the continuations of the corner's two edges into the site.
        if vx * in_x + vy * in_y >= 0.0 and vx * out_x + vy * out_y <= 0.0:
            nearest = min(nearest, np.hypot(vx, vy))
    return nearest


@njit(types.float64[::1](_points, _ints, _ints, _ints, _ints), cache=True, nogil=True)
def min_widths(xy, after, before, ring_offsets, site_offsets):
    """
    Smallest width of every site: between edges that face each other, from inward corners across, of a strip that holds it.

    ``after[i]`` and ``before[i]`` are the neighbours of vertex i in its ring. O(edges squared) a site.
    """
    n_sites = site_offsets.size - 1
    widths = np.empty(n_sites)
    for site in range(n_sites):
        first = ring_offsets[site_offsets[site]]
        last = ring_offsets[site_offsets[site + 1]]
        smallest = np.inf
        for i in range(first, last):
            ax, ay = xy[i, 0], xy[i, 1]
            bx, by = xy[after[i], 0], xy[after[i], 1]
            length = np.hypot(bx - ax, by - ay)
            ex, ey = (bx - ax) / length, (by - ay) / length
            low, high = np.inf, -np.inf
            for k in range(first, last):
                across = ex * (xy[k, 1] - ay) - ey * (xy[k, 0] - ax)
                low, high = min(low, across), max(high, across)
            smallest = min(smallest, high - low)
            for k in range(i + 1, last):
                if after[i] == k or after[k] == i:
                    continue
                cx, cy = xy[k, 0], xy[k, 1]
                dx, dy = xy[after[k], 0], xy[after[k], 1]
                other = np.hypot(dx - cx, dy - cy)
                fx, fy = (dx - cx) / other, (dy - cy) / other
                if ex * fx + ey * fy > -MIN_OPPOSITION:
                    continue
                # The site lies on the left of its edges; each edge must reach the left side of the other.
                if max(ex * (cy - ay) - ey * (cx - ax), ex * (dy - ay) - ey * (dx - ax)) <= 0.0:
                    continue
                if max(fx * (ay - cy) - fy * (ax - cx), fx * (by - cy) - fy * (bx - cx)) <= 0.0:
                    continue
                near = min(_point_to_edge(ax, ay, cx, cy, dx, dy), _point_to_edge(bx, by, cx, cy, dx, dy))
                near = min(near, _point_to_edge(cx, cy, ax, ay, bx, by))
                near = min(near, _point_to_edge(dx, dy, ax, ay, bx, by))
                smallest = min(smallest, near)
        for b in range(first, last):
            smallest = min(smallest, _across_from_inward_corner(xy, before[b], b, after, first, last))
        widths[site] = smallest
    return widths


#: Edges that overlap by less than this share of their length meet in a corner.
CORNER = 1e-9


@njit(types.float64[::1](_points, _ints, _ints, _ints, _ints, types.float64), cache=True, nogil=True)
def shared_lengths(xy, after, first_vertex, first, second, max_gap):
    """
    Length over which the outlines of two sites run along each other, for every pair (first[i], second[i]).

    ``first_vertex[s] : first_vertex[s + 1]`` are a site's vertices, ``after[v]`` the one that follows in its ring. Edges run
    along each other when they go opposite ways and are nowhere further apart than ``max_gap`` where they overlap.
    """
    lengths = np.zeros(first.size)
    for pair in range(first.size):
        i, j = first[pair], second[pair]
        for a in range(first_vertex[i], first_vertex[i + 1]):
            ax, ay = xy[a, 0], xy[a, 1]
            ex, ey = xy[after[a], 0] - ax, xy[after[a], 1] - ay
            length = np.hypot(ex, ey)
            ex, ey = ex / length, ey / length
            for c in range(first_vertex[j], first_vertex[j + 1]):
                cx, cy = xy[c, 0] - ax, xy[c, 1] - ay
                dx, dy = xy[after[c], 0] - ax, xy[after[c], 1] - ay
                high = cx * ex + cy * ey  # the other edge comes back: it begins where this one ends
                low = dx * ex + dy * ey
                begin, end = max(low, 0.0), min(high, length)
                if end - begin <= CORNER * length:
                    continue
                slope = ((cy - dy) * ex - (cx - dx) * ey) / (high - low)
                away = dy * ex - dx * ey - slope * low  # distance of the other edge's line at the start of this one
                if abs(away + slope * begin) <= max_gap and abs(away + slope * end) <= max_gap:
                    lengths[pair] += end - begin
    return lengths


@njit(types.int64[::1](_ints, _ints, _floats, types.int64), cache=True, nogil=True)
def colour_greedily(first, neighbour, shared, n_colours):
    """
    A colour for every site: the one with the least shared edge to coloured neighbours, and of those the rarest so far.

    ``neighbour[first[s] : first[s + 1]]`` are a site's neighbours, ``shared`` the lengths of the common edges. Next comes the
    site whose neighbours have the most different colours already (Brélaz, Commun. ACM 22, 1979), then the lowest number.
    """
    n_sites = first.size - 1
    colour = np.full(n_sites, -1, np.int64)
    used = np.zeros(n_colours, np.int64)
    conflict = np.empty(n_colours)
    seen = np.zeros(n_sites, np.uint64)  # colours of the neighbours, a bit each
    variety = np.zeros(n_sites, np.int64)  # and how many they are
    queue = [(0, s) for s in range(n_sites)]
    while len(queue) > 0:
        saturation, site = heappop(queue)
        if colour[site] >= 0 or -saturation < variety[site]:
            continue  # told again with more colours around it
        conflict[:] = 0.0
        for k in range(first[site], first[site + 1]):
            if colour[neighbour[k]] >= 0:
                conflict[colour[neighbour[k]]] += shared[k]
        best = 0
        for c in range(1, n_colours):
            if conflict[c] < conflict[best] or (conflict[c] == conflict[best] and used[c] < used[best]):
                best = c
        colour[site] = best
        used[best] += 1
        bit = np.uint64(1) << np.uint64(best)
        for k in range(first[site], first[site + 1]):
            other = neighbour[k]
            if colour[other] < 0 and not seen[other] & bit:
                seen[other] |= bit
                variety[other] += 1
                heappush(queue, (-variety[other], other))
    return colour
