"""The layout room's numba kernel: widths of photosites."""

from __future__ import annotations

import numpy as np
from numba import njit, types

__all__ = ["min_widths"]

_ints = types.Array(types.int64, 1, "C", readonly=True)
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
