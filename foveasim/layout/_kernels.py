"""Numba kernels: photosite widths, aspect ratios, contacts, shared edges, graph colouring."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, INTS

_flags = types.Array(types.boolean, 1, "C")

#: Length, in µm, up to which edges are those of vertices that differ by rounding, and common edges touch in a corner only.
MIN_EDGE_UM = 1e-6


@njit(types.void(FLOATS_2D, FLOATS_2D, types.int64, types.float64[:, ::1]))
def fill_rectangles(x, y, first, xy):
    """
    Write the corners of the sites of a lattice from site ``first`` on.

    Each site has four rows of ``xy``, counter-clockwise.
    """
    n_x = x.shape[0]
    for k in range(xy.shape[0] // 4):
        row, column = (first + k) // n_x, (first + k) % n_x
        x0, x1, y0, y1 = x[column, 0], x[column, 1], y[row, 0], y[row, 1]
        xy[4 * k, 0], xy[4 * k, 1] = x0, y0
        xy[4 * k + 1, 0], xy[4 * k + 1, 1] = x1, y0
        xy[4 * k + 2, 0], xy[4 * k + 2, 1] = x1, y1
        xy[4 * k + 3, 0], xy[4 * k + 3, 1] = x0, y1


@njit(types.float64[::1](FLOATS_2D, INTS, INTS, INTS, FLOATS_2D))
def areas_in_boxes(xy, ring_offsets, site_offsets, sites, boxes):
    """
    Return the areas of sites (n,) within boxes (n, 4).

    A row of ``boxes`` is x_min, y_min, x_max, y_max; ``sites`` are indices. By Green's theorem, the area is the sum over the
    edges of the integral of ``clip(x, x_min, x_max) - x_min`` dy, between y_min and y_max. Outer rings are counter-clockwise,
    and holes clockwise.
    """
    areas = np.zeros(sites.size)
    for i in range(sites.size):
        x0, y0, x1, y1 = boxes[i]
        for ring in range(site_offsets[sites[i]], site_offsets[sites[i] + 1]):
            a = ring_offsets[ring + 1] - 1
            for b in range(ring_offsets[ring], ring_offsets[ring + 1]):
                areas[i] += _area_beside_edge(xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1], x0, y0, x1, y1)
                a = b
    return areas


@njit()
def _area_beside_edge(ax, ay, bx, by, x0, y0, x1, y1):
    """Return the area of a box to the left of an edge; negative for a falling edge."""
    sign = 1.0
    if ay > by:
        ax, ay, bx, by, sign = bx, by, ax, ay, -1.0
    low, high = max(ay, y0), min(by, y1)
    if not low < high:
        return 0.0
    slope = (bx - ax) / (by - ay)
    start = ax if low == ay else ax + (low - ay) * slope
    end = bx if high == by else ax + (high - ay) * slope
    left, right = min(start, end), max(start, end)
    if right <= x0:
        return 0.0
    if left >= x1:
        return sign * (high - low) * (x1 - x0)
    first, last = max(left, x0), min(right, x1)
    width = right - left
    within = (last - first) / width if width > 0.0 else 1.0
    beyond = (right - last) / width if width > 0.0 else 0.0
    return sign * (high - low) * (within * (0.5 * (first + last) - x0) + beyond * (x1 - x0))


@njit()
def _point_to_edge(px, py, ax, ay, bx, by):
    """Return the distance of a point from a segment."""
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    t = 0.0
    if length2 > 0.0:
        t = min(max(((px - ax) * dx + (py - ay) * dy) / length2, 0.0), 1.0)
    x, y = px - ax - t * dx, py - ay - t * dy
    return np.sqrt(x * x + y * y)  # faster than hypot, and far from overflow


@njit()
def _segment_distance(ax, ay, bx, by, cx, cy, dx, dy):
    """Return the distance between the segments a-b and c-d, which do not cross."""
    near = min(_point_to_edge(ax, ay, cx, cy, dx, dy), _point_to_edge(bx, by, cx, cy, dx, dy))
    near = min(near, _point_to_edge(cx, cy, ax, ay, bx, by))
    return min(near, _point_to_edge(dx, dy, ax, ay, bx, by))


@njit()
def _distance_inwards(ax, ay, bx, by, cx, cy, dx, dy):
    """Return the distance of edge a-b to the part of edge c-d on its left, or infinity."""
    ex, ey = bx - ax, by - ay
    left_c, left_d = ex * (cy - ay) - ey * (cx - ax), ex * (dy - ay) - ey * (dx - ax)
    if left_c <= 0.0 and left_d <= 0.0:
        is_overlap = left_c == 0.0 and left_d == 0.0 and _segment_distance(ax, ay, bx, by, cx, cy, dx, dy) == 0.0
        return 0.0 if is_overlap else np.inf
    if left_c < 0.0:
        t = left_c / (left_c - left_d)
        cx, cy = cx + t * (dx - cx), cy + t * (dy - cy)
    elif left_d < 0.0:
        t = left_d / (left_d - left_c)
        dx, dy = dx + t * (cx - dx), dy + t * (cy - dy)
    return _segment_distance(ax, ay, bx, by, cx, cy, dx, dy)


@njit(types.float64[::1](FLOATS_2D, INTS, INTS, types.float64, types.float64, types.float64))
def facing_distances(xy, after, first_vertex, side, min_cosine, reach):
    """
    Return the smallest distance of facing edges of each site, at most ``reach``.

    Edges face each other across the site for ``side`` 1, and across the space outside it (notches, slits, holes) for -1. They
    enclose an angle whose cosine is above ``min_cosine``, and each counts as far as it is in front of the other. Edges with a
    common vertex have the distance 0 where they enclose such an angle. O(n_edge²) per site.
    """
    distances = np.empty(first_vertex.size - 1)
    for site in range(distances.size):
        first, last = first_vertex[site], first_vertex[site + 1]
        smallest = reach
        has_pairs = side > 0.0
        for i in range(first, last):  # convex outlines have nothing in front of their outer sides
            j = after[i]
            k = after[j]
            ex, ey, fx, fy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1], xy[k, 0] - xy[j, 0], xy[k, 1] - xy[j, 1]
            has_pairs = has_pairs or ex * fy - ey * fx < 0.0
        for i in range(first, last if has_pairs else first):
            a, b = (i, after[i]) if side > 0.0 else (after[i], i)
            ax, ay, bx, by = xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1]
            ex, ey = bx - ax, by - ay
            left, right = min(ax, bx) - smallest, max(ax, bx) + smallest
            low, high = min(ay, by) - smallest, max(ay, by) + smallest
            for k in range(i + 1, last):
                c, d = (k, after[k]) if side > 0.0 else (after[k], k)
                cx, cy, dx, dy = xy[c, 0], xy[c, 1], xy[d, 0], xy[d, 1]
                fx, fy = dx - cx, dy - cy
                opposed = -(ex * fx + ey * fy)
                if (
                    opposed <= 0.0
                    or min(cx, dx) >= right
                    or max(cx, dx) <= left
                    or min(cy, dy) >= high
                    or max(cy, dy) <= low
                ):
                    continue
                if opposed * opposed <= min_cosine * min_cosine * (ex * ex + ey * ey) * (fx * fx + fy * fy):
                    continue
                near = _distance_inwards(ax, ay, bx, by, cx, cy, dx, dy)
                if near < smallest:
                    near = max(near, _distance_inwards(cx, cy, dx, dy, ax, ay, bx, by))
                    if near < smallest:
                        smallest = near
                        left, right = min(ax, bx) - smallest, max(ax, bx) + smallest
                        low, high = min(ay, by) - smallest, max(ay, by) + smallest
        distances[site] = smallest
    return distances


#: Relative difference of area below which two rectangles count as equal.
AREA_RTOL = 1e-9


@njit()
def _next_hull_corner(xy, corner, first, last):
    """Return the next vertex of the convex hull, counter-clockwise; skip collinear ones."""
    best = -1
    for k in range(first, last):
        kx, ky = xy[k, 0] - xy[corner, 0], xy[k, 1] - xy[corner, 1]
        if kx == 0.0 and ky == 0.0:
            continue
        if best >= 0:
            bx, by = xy[best, 0] - xy[corner, 0], xy[best, 1] - xy[corner, 1]
            turn = bx * ky - by * kx
            if turn > 0.0 or (turn == 0.0 and kx * kx + ky * ky <= bx * bx + by * by):
                continue
        best = k
    return best


@njit(types.float64[::1](FLOATS_2D, INTS, INTS))
def aspect_ratios(xy, ring_offsets, site_offsets):
    """
    Return the aspect ratio of the minimum-area rectangle around each site.

    The ratio is that of the longer to the shorter side; of rectangles of equal area the least elongated counts. The
    minimum-area rectangle has a side along an edge of the convex hull. O(n_vertex n_hull_vertex) per site.
    """
    n_sites = site_offsets.size - 1
    ratios = np.empty(n_sites)
    for site in range(n_sites):
        first, last = ring_offsets[site_offsets[site]], ring_offsets[site_offsets[site] + 1]
        start = first
        for k in range(first, last):
            if xy[k, 0] < xy[start, 0] or (xy[k, 0] == xy[start, 0] and xy[k, 1] < xy[start, 1]):
                start = k
        smallest, ratio = np.inf, np.inf
        corner = start
        for _ in range(first, last):
            beyond = _next_hull_corner(xy, corner, first, last)
            ex, ey = xy[beyond, 0] - xy[corner, 0], xy[beyond, 1] - xy[corner, 1]
            length = np.hypot(ex, ey)
            ex, ey = ex / length, ey / length
            low, high, depth = 0.0, 0.0, 0.0
            for k in range(first, last):
                kx, ky = xy[k, 0] - xy[corner, 0], xy[k, 1] - xy[corner, 1]
                along = ex * kx + ey * ky
                low, high, depth = min(low, along), max(high, along), max(depth, ex * ky - ey * kx)
            area = (high - low) * depth
            shape = max(high - low, depth) / min(high - low, depth)
            if area < (1.0 - AREA_RTOL) * smallest or (area < (1.0 + AREA_RTOL) * smallest and shape < ratio):
                smallest, ratio = min(area, smallest), shape
            corner = beyond
            if corner == start:
                break
        ratios[site] = ratio
    return ratios


@njit(types.int64[::1](FLOATS_2D, INTS))
def intersecting_boxes(box, order):
    """
    Return the pairs (i, j), i < j, of boxes that intersect or touch, encoded as i n + j.

    Boxes are (x_min, y_min, x_max, y_max), and ``order`` sorts them by x_min. The plane is divided into horizontal strips
    about as high as the mean box, and each strip is swept from left to right; a pair counts in its lowest common strip.
    """
    n = box.shape[0]
    bottom, top, mean = np.inf, -np.inf, 0.0
    for i in range(n):
        bottom, top, mean = min(bottom, box[i, 1]), max(top, box[i, 3]), mean + (box[i, 3] - box[i, 1]) / n
    n_strips = max(min(n, int((top - bottom) / mean)), 1) if mean > 0.0 else 1
    per_height = n_strips / (top - bottom) if mean > 0.0 else 0.0
    lowest, highest = np.empty(n, np.int64), np.empty(n, np.int64)
    start = np.zeros(n_strips + 2, np.int64)
    for i in range(n):
        lowest[i] = min(int((box[i, 1] - bottom) * per_height), n_strips - 1)
        highest[i] = min(int((box[i, 3] - bottom) * per_height), n_strips - 1)
        for strip in range(lowest[i], highest[i] + 1):
            start[strip + 2] += 1
    for strip in range(n_strips):
        start[strip + 2] += start[strip + 1]
    listed = np.empty(start[n_strips + 1], np.int64)
    for i in order:
        for strip in range(lowest[i], highest[i] + 1):
            listed[start[strip + 1]] = i
            start[strip + 1] += 1
    pairs = np.empty(0, np.int64)
    for is_filling in range(2):
        found = 0
        for strip in range(n_strips):
            for p in range(start[strip], start[strip + 1]):
                i = listed[p]
                for q in range(p + 1, start[strip + 1]):
                    j = listed[q]
                    if box[j, 0] > box[i, 2]:
                        break
                    if box[j, 1] <= box[i, 3] and box[i, 1] <= box[j, 3] and max(lowest[i], lowest[j]) == strip:
                        if is_filling:
                            pairs[found] = min(i, j) * n + max(i, j)
                        found += 1
        if not is_filling:
            pairs = np.empty(found, np.int64)
    return pairs


@njit(types.float64[::1](FLOATS_2D, INTS, INTS))
def overhangs(xy, after, first_vertex):
    """Return the extent of a site to the right of each edge line; 0 for convex sites."""
    reach = np.zeros(xy.shape[0])
    for site in range(first_vertex.size - 1):
        first, last = first_vertex[site], first_vertex[site + 1]
        for a in range(first, last):
            ex, ey = xy[after[a], 0] - xy[a, 0], xy[after[a], 1] - xy[a, 1]
            furthest = 0.0
            for k in range(first, last):
                furthest = max(furthest, ey * (xy[k, 0] - xy[a, 0]) - ex * (xy[k, 1] - xy[a, 1]))
            if furthest > 0.0:
                reach[a] = furthest / np.hypot(ex, ey)
    return reach


@njit()
def _is_same(xy, a, c):
    """Return whether two vertices are bit-identical."""
    return xy[a, 0] == xy[c, 0] and xy[a, 1] == xy[c, 1]


@njit()
def _edge_to_edge(xy, a, b, c, d):
    """Return the distance between the segments a-b and c-d; 0 where they cross."""
    ax, ay, bx, by = xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1]
    cx, cy, dx, dy = xy[c, 0], xy[c, 1], xy[d, 0], xy[d, 1]
    ex, ey, fx, fy = bx - ax, by - ay, dx - cx, dy - cy
    # End points on both sides of each other; for segments collinear within rounding, the bounding boxes decide.
    if (
        (ex * (cy - ay) - ey * (cx - ax)) * (ex * (dy - ay) - ey * (dx - ax)) < 0.0
        and (fx * (ay - cy) - fy * (ax - cx)) * (fx * (by - cy) - fy * (bx - cx)) < 0.0
        and min(ax, bx) <= max(cx, dx)
        and min(cx, dx) <= max(ax, bx)
        and min(ay, by) <= max(cy, dy)
        and min(cy, dy) <= max(ay, by)
    ):
        return 0.0
    return _segment_distance(ax, ay, bx, by, cx, cy, dx, dy)


@njit()
def _edge_distances(xy, a, b, c, d):
    """Return the distance of edges a-b and c-d, also with a common end point excluded."""
    is_ac, is_ad, is_bc, is_bd = _is_same(xy, a, c), _is_same(xy, a, d), _is_same(xy, b, c), _is_same(xy, b, d)
    if is_ac and is_bd:
        return 0.0, 0.0
    if not (is_ac or is_ad or is_bc or is_bd):
        near = _edge_to_edge(xy, a, b, c, d)
        return near, near
    p = b if is_ac or is_ad else a
    q = d if is_ac or is_bc else c
    near = _point_to_edge(xy[p, 0], xy[p, 1], xy[c, 0], xy[c, 1], xy[d, 0], xy[d, 1])
    return 0.0, min(near, _point_to_edge(xy[q, 0], xy[q, 1], xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1]))


@njit()
def _is_inside(xy, after, first, last, x, y):
    """Return whether a point lies in a site."""
    is_inside = False
    for a in range(first, last):
        ay, by = xy[a, 1], xy[after[a], 1]
        if (ay > y) != (by > y) and x < xy[a, 0] + (y - ay) / (by - ay) * (xy[after[a], 0] - xy[a, 0]):
            is_inside = not is_inside
    return is_inside


@njit()
def _is_in_box(x, y, box, site):
    """Return whether a point lies in the bounding box of a site."""
    return box[site, 0] <= x <= box[site, 2] and box[site, 1] <= y <= box[site, 3]


@njit()
def _has_edge_inside(xy, after, box, i_first, i_last, j, j_first, j_last):
    """Return whether the midpoint of any unshared edge of one site lies in the other."""
    for a in range(i_first, i_last):
        b = after[a]
        x, y = 0.5 * (xy[a, 0] + xy[b, 0]), 0.5 * (xy[a, 1] + xy[b, 1])
        if not _is_in_box(x, y, box, j):
            continue
        is_common = False
        for c in range(j_first, j_last):
            is_common = is_common or (_is_same(xy, a, after[c]) and _is_same(xy, b, c))
        if not is_common and _is_inside(xy, after, j_first, j_last, x, y):
            return True
    return False


@njit()
def _is_separated(xy, after, overhang, depth, i_first, i_last, j_first, j_last):
    """Return whether an edge of the first site separates both sites, up to a strip."""
    for a in range(i_first, i_last):
        if overhang[a] > depth:
            continue
        ex, ey = xy[after[a], 0] - xy[a, 0], xy[after[a], 1] - xy[a, 1]
        lowest = 0.0
        for c in range(j_first, j_last):
            lowest = min(lowest, ey * (xy[c, 0] - xy[a, 0]) - ex * (xy[c, 1] - xy[a, 1]))
        length = np.hypot(ex, ey)
        if length > MIN_EDGE_UM and overhang[a] - lowest / length <= depth:
            return True
    return False


@njit()
def _common_edges(xy, after, box, overhang, depth, i_first, i_last, j, j_first, j_last, is_shared):
    """Return whether sites share a vertex and a separating edge; flag shared edges."""
    shares_vertex, is_separated = False, False
    for a in range(i_first, i_last):
        if not _is_in_box(xy[a, 0], xy[a, 1], box, j):
            continue
        for c in range(j_first, j_last):
            if _is_same(xy, a, after[c]):
                shares_vertex = True
                if _is_same(xy, after[a], c):
                    is_shared[a] = is_shared[c] = True
                    is_separated = is_separated or overhang[a] + overhang[c] <= depth
    return shares_vertex, is_separated


@njit()
def _nearest_edges(xy, after, box, i_first, i_last, j, j_first, j_last, nearest, reach, touching):
    """Return the outline distance, also with common vertices and edges excluded."""
    nearest_other = np.inf
    for a in range(i_first, i_last):
        b = after[a]
        within = max(min(reach, nearest), touching)
        left, right = min(xy[a, 0], xy[b, 0]) - within, max(xy[a, 0], xy[b, 0]) + within
        low, high = min(xy[a, 1], xy[b, 1]) - within, max(xy[a, 1], xy[b, 1]) + within
        if left > box[j, 2] or right < box[j, 0] or low > box[j, 3] or high < box[j, 1]:
            continue
        for c in range(j_first, j_last):
            d = after[c]
            if min(xy[c, 0], xy[d, 0]) > right or max(xy[c, 0], xy[d, 0]) < left:
                continue
            if min(xy[c, 1], xy[d, 1]) > high or max(xy[c, 1], xy[d, 1]) < low:
                continue
            if not (_is_same(xy, a, d) and _is_same(xy, b, c)):
                near, near_other = _edge_distances(xy, a, b, c, d)
                nearest, nearest_other = min(nearest, near), min(nearest_other, near_other)
    return nearest, nearest_other


@njit(
    types.Tuple((types.float64[::1], types.boolean[::1]))(
        FLOATS_2D, INTS, INTS, FLOATS_2D, FLOATS, FLOATS, INTS, INTS, types.float64, types.float64, _flags
    ),
)
def contacts(xy, after, first_vertex, box, overhang, depth, first, second, reach, touching, is_shared):
    """
    Return the distance of each pair of sites, and whether they certainly do not overlap.

    Pairs are (first[i], second[i]). Distances above ``reach`` are infinite, and overlapping sites have the distance 0. Sites
    do not overlap if a line along an edge separates them up to a strip of the smaller ``depth`` of both. Nor do they overlap
    if no edge of one lies in the other and their outlines, apart from common vertices and edges, are further apart than
    ``touching``.

    Edges that coincide with a reversed edge of the other site are flagged in ``is_shared``.
    """
    distances = np.zeros(first.size)
    is_non_overlapping = np.ones(first.size, np.bool_)
    for pair in range(first.size):
        i, j = first[pair], second[pair]
        i_first, i_last, j_first, j_last = first_vertex[i], first_vertex[i + 1], first_vertex[j], first_vertex[j + 1]
        strip = min(depth[i], depth[j])
        shares_vertex, is_separated = _common_edges(
            xy, after, box, overhang, strip, i_first, i_last, j, j_first, j_last, is_shared
        )
        for _ in range(2):
            if shares_vertex and not is_separated:
                is_separated = _is_separated(xy, after, overhang, strip, i_first, i_last, j_first, j_last)
            i, i_first, i_last, j, j_first, j_last = j, j_first, j_last, i, i_first, i_last
        if shares_vertex and is_separated:
            continue
        nearest, nearest_other = _nearest_edges(
            xy, after, box, i_first, i_last, j, j_first, j_last, 0.0 if shares_vertex else np.inf, reach, touching
        )
        is_clean = nearest_other > touching
        for _ in range(2):
            if nearest > touching:
                x, y = xy[i_first, 0], xy[i_first, 1]
                if _is_in_box(x, y, box, j) and _is_inside(xy, after, j_first, j_last, x, y):
                    nearest, is_clean = 0.0, False
            elif is_clean:
                is_clean = not _has_edge_inside(xy, after, box, i_first, i_last, j, j_first, j_last)
            elif not is_separated:
                is_separated = _is_separated(xy, after, overhang, strip, i_first, i_last, j_first, j_last)
            i, i_first, i_last, j, j_first, j_last = j, j_first, j_last, i, i_first, i_last
        is_non_overlapping[pair] = is_separated or is_clean
        distances[pair] = nearest if nearest <= reach else np.inf
    return distances, is_non_overlapping


@njit(types.float64[::1](FLOATS_2D, INTS, INTS, INTS, INTS, types.float64))
def shared_lengths(xy, after, first_vertex, first, second, max_gap):
    """
    Return the length of the common boundary of each pair of sites (first[i], second[i]).

    ``first_vertex[s] : first_vertex[s + 1]`` are the vertices of a site, and ``after[v]`` is the next vertex of the ring.
    Edges are common where they have opposite directions and are nowhere further apart than ``max_gap``.
    """
    lengths = np.zeros(first.size)
    for pair in range(first.size):
        i, j = first[pair], second[pair]
        for a in range(first_vertex[i], first_vertex[i + 1]):
            ax, ay = xy[a, 0], xy[a, 1]
            ex, ey = xy[after[a], 0] - ax, xy[after[a], 1] - ay
            length = np.hypot(ex, ey)
            if length <= MIN_EDGE_UM:  # vertices that differ by rounding
                continue
            ex, ey = ex / length, ey / length
            for c in range(first_vertex[j], first_vertex[j + 1]):
                cx, cy = xy[c, 0] - ax, xy[c, 1] - ay
                dx, dy = xy[after[c], 0] - ax, xy[after[c], 1] - ay
                high = cx * ex + cy * ey  # the other edge has the opposite direction
                low = dx * ex + dy * ey
                begin, end = max(low, 0.0), min(high, length)
                if end - begin <= MIN_EDGE_UM:
                    continue
                slope = ((cy - dy) * ex - (cx - dx) * ey) / (high - low)
                away = dy * ex - dx * ey - slope * low  # distance of the line of the other edge at (ax, ay)
                if abs(away + slope * begin) <= max_gap and abs(away + slope * end) <= max_gap:
                    lengths[pair] += end - begin
    return lengths


@njit(types.void(FLOATS_2D, INTS, INTS, INTS, INTS, FLOATS, types.float64, types.float64[::1]))
def edge_gaps(xy, after, first_vertex, first, second, limit, touching, gap):
    """
    Update the smallest distances of edges to facing edges of another site.

    An edge of the site first[i] faces one of second[i] where it has the opposite direction and is in front of it, at most
    ``limit`` of both sites away, within ``touching``. Vertices are as in ``shared_lengths``; the edge of a vertex leads to the
    next one.
    """
    for pair in range(first.size):
        i, j = first[pair], second[pair]
        largest = min(limit[i], limit[j])
        for a in range(first_vertex[i], first_vertex[i + 1]):
            ax, ay = xy[a, 0], xy[a, 1]
            ex, ey = xy[after[a], 0] - ax, xy[after[a], 1] - ay
            length = np.hypot(ex, ey)
            if length <= MIN_EDGE_UM:
                continue
            ex, ey = ex / length, ey / length
            for c in range(first_vertex[j], first_vertex[j + 1]):
                cx, cy = xy[c, 0] - ax, xy[c, 1] - ay
                dx, dy = xy[after[c], 0] - ax, xy[after[c], 1] - ay
                high = cx * ex + cy * ey
                low = dx * ex + dy * ey
                begin, end = max(low, 0.0), min(high, length)
                if end - begin <= MIN_EDGE_UM:
                    continue
                # Interiors are to the left.
                slope = ((dy - cy) * ex - (dx - cx) * ey) / (high - low)
                away = dx * ey - dy * ex - slope * low
                at_begin, at_end = away + slope * begin, away + slope * end
                if min(at_begin, at_end) >= -touching and max(at_begin, at_end) <= largest:
                    gap[a] = min(gap[a], max(0.5 * (at_begin + at_end), 0.0))


@njit(types.int64[::1](INTS, INTS, FLOATS, types.int64))
def colour_greedily(first, neighbour, shared, n_colours):
    """
    Colour sites greedily, to minimise the edge length shared by sites of equal colour.

    Of equally good colours the least used one is taken. ``neighbour[first[s] : first[s + 1]]`` are the neighbours of a site,
    and ``shared`` contains the lengths of their common edges. The next site is the one whose neighbours have the most
    different colours (Brélaz, Commun. ACM 22, 1979), and of those the one with the lowest index.
    """
    n_sites = first.size - 1
    colour = np.full(n_sites, -1, np.int64)
    used = np.zeros(n_colours, np.int64)
    conflict = np.empty(n_colours)
    neighbour_colours = np.zeros(n_sites, np.uint64)  # bit mask of the colours of the neighbours
    variety = np.zeros(n_sites, np.int64)  # number of different colours of the neighbours
    queue = [(0, s) for s in range(n_sites)]
    while len(queue) > 0:
        saturation, site = heappop(queue)
        if colour[site] >= 0 or -saturation < variety[site]:
            continue  # outdated: the queue contains a newer entry of this site
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
            if colour[other] < 0 and not neighbour_colours[other] & bit:
                neighbour_colours[other] |= bit
                variety[other] += 1
                heappush(queue, (-variety[other], other))
    return colour
