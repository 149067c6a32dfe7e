"""
Numba kernels of reconstruction: natural neighbours and the roughness gradient.

A **triangulation** is three arrays with one row per triangle: ``corners`` (its sites, counter-clockwise), ``neighbours`` (the
triangle across the edge opposite each corner, -1 where there is none) and ``circles`` (centre and squared radius of the
circumcircle). The kernels take arrays only, and release the interpreter lock.
"""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS_2D, INTS, INTS_2D

#: Largest number of natural neighbours: a random point has six, and the centre of a ring of sites has the complete ring.
MAX_TRIANGLES = 4096
#: Values are linear between the ends of a hull edge at points closer to it than this fraction of its length, where
#: circumcircles become too large.
HULL_FRACTION = 1e-5
#: A point closer to a corner than this fraction of its triangle's longest edge coincides with the corner.
CORNER_FRACTION = 1e-10
#: A point outside the hull by less than this fraction of the squared extent of the sites, as the area of the triangle with the
#: hull edge, is on the hull.
HULL_AREA = 1e-14


@njit()
def _cross(ax, ay, bx, by):
    return ax * by - ay * bx


@njit()
def _step(x, y, t, xy, corners, neighbours):
    """
    Return the next triangle on a walk towards a point.

    It is across an edge that has the point on its other side: -1 outside the hull, and the same triangle if it contains the
    point.
    """
    for k in range(3):
        a, b = corners[t, (k + 1) % 3], corners[t, (k + 2) % 3]
        area = _cross(xy[a, 0] - x, xy[a, 1] - y, xy[b, 0] - x, xy[b, 1] - y)
        other = neighbours[t, k]
        if area < 0.0 and (other >= 0 or area < -HULL_AREA):
            return other
    return t


@njit(types.void(FLOATS_2D, FLOATS_2D, INTS_2D, INTS_2D, types.int64[::1]))
def find_triangles(points, xy, corners, neighbours, found):
    """
    Find the triangle of a Delaunay triangulation that contains each point, -1 outside.

    Each search walks towards the point from the triangle of the previous one. In a Delaunay triangulation every such walk
    ends (O. Devillers, S. Pion and M. Teillaud, Walking in a triangulation, 2002, section 2.2), except for rounding errors in
    flat triangles: after as many steps as there are triangles, all are searched.
    """
    start = 0
    for p in range(points.shape[0]):
        x, y = points[p, 0], points[p, 1]
        at = start
        for _ in range(corners.shape[0]):
            before, at = at, _step(x, y, at, xy, corners, neighbours)
            if at < 0 or at == before:
                break
        else:
            at = -1
            for t in range(corners.shape[0]):
                if _step(x, y, t, xy, corners, neighbours) == t:
                    at = t
                    break
        found[p] = at
        if at >= 0:
            start = at


@njit(
    types.void(
        FLOATS_2D,
        INTS,
        FLOATS_2D,
        FLOATS_2D,
        INTS_2D,
        INTS_2D,
        FLOATS_2D,
        types.boolean,
        types.float64[:, ::1],
    ),
)
def interpolate(points, start, xy, values, corners, neighbours, circles, is_smooth, out):
    """
    Evaluate the linear interpolant, or Sibson's, at points in known triangles.

    The latter for ``is_smooth``. ``points`` (n, 2) lie in the triangles ``start``; sites at ``xy`` (n_site, 2) have ``values``
    (n_site, n_channel); results are written to ``out`` (n, n_channel). The linear interpolant does not use ``circles``.

    Inserting a point replaces the triangles whose circumcircles contain it. Its Voronoi cell takes a polygon from the cell of
    each of their sites. The polygon vertices are the circumcentres of those triangles, and the centres of the circles through
    the point and each edge of their union. Areas are summed edge by edge about the point, so that the vertices need no sorting.
    """
    n_channels = values.shape[1]
    triangles = np.empty(MAX_TRIANGLES, np.int64)
    edge_from = np.empty(MAX_TRIANGLES + 2, np.int64)
    edge_to = np.empty(MAX_TRIANGLES + 2, np.int64)
    edge_x = np.empty(MAX_TRIANGLES + 2, np.float64)
    edge_y = np.empty(MAX_TRIANGLES + 2, np.float64)
    # Area taken from each site; allocated once and cleared where it was used.
    area = np.zeros(xy.shape[0], np.float64)
    is_inside = np.zeros(corners.shape[0], np.bool_)
    barycentric = np.empty(3)

    for p in range(points.shape[0]):
        px, py = points[p, 0], points[p, 1]
        containing = start[p]

        # Linear interpolation where the triangle, or the point's distance from the hull, is too small for circumcircles.
        longest2 = 0.0
        for k in range(3):
            a, b = corners[containing, k], corners[containing, (k + 1) % 3]
            longest2 = max(longest2, (xy[a, 0] - xy[b, 0]) ** 2 + (xy[a, 1] - xy[b, 1]) ** 2)
        double_area = 0.0
        is_straight = not is_smooth
        for k in range(3):
            a, b = corners[containing, (k + 1) % 3], corners[containing, (k + 2) % 3]
            barycentric[k] = _cross(xy[a, 0] - px, xy[a, 1] - py, xy[b, 0] - px, xy[b, 1] - py)
            double_area += barycentric[k]
            if neighbours[containing, k] < 0 and barycentric[k] < HULL_FRACTION * longest2:
                is_straight = True
        for k in range(3):
            a = corners[containing, k]
            if (xy[a, 0] - px) ** 2 + (xy[a, 1] - py) ** 2 <= CORNER_FRACTION**2 * longest2:
                is_straight = True
        if double_area < 100.0 * HULL_FRACTION * longest2:
            is_straight = True

        n_triangles, n_edges, has_capacity = 0, 0, True
        if not is_straight:
            triangles[0], n_triangles, done = containing, 1, 0
            is_inside[containing] = True
            while done < n_triangles and has_capacity:
                t = triangles[done]
                done += 1
                for k in range(3):
                    other = neighbours[t, k]
                    if other < 0 or is_inside[other]:
                        continue
                    distance2 = (circles[other, 0] - px) ** 2 + (circles[other, 1] - py) ** 2
                    if distance2 < circles[other, 2] * (1.0 - 1e-12):
                        if n_triangles == MAX_TRIANGLES:
                            has_capacity = False
                            break
                        triangles[n_triangles] = other
                        n_triangles += 1
                        is_inside[other] = True

            for i in range(n_triangles):
                t = triangles[i]
                cx, cy = circles[t, 0] - px, circles[t, 1] - py
                for k in range(3):
                    a, b = corners[t, (k + 1) % 3], corners[t, (k + 2) % 3]
                    other = neighbours[t, k]
                    if other >= 0 and is_inside[other]:
                        # Boundary of the old cells of a and b, from the adjacent circumcentre to this one, a on its left.
                        area[a] += _cross(circles[other, 0] - px, circles[other, 1] - py, cx, cy)
                        continue
                    ax, ay, bx, by = xy[a, 0] - px, xy[a, 1] - py, xy[b, 0] - px, xy[b, 1] - py
                    edge_cross = 2.0 * _cross(ax, ay, bx, by)
                    a2, b2 = ax * ax + ay * ay, bx * bx + by * by
                    if edge_cross <= 1e-14 * (a2 + b2):  # the point lies on the edge within rounding error
                        is_straight = True
                        continue
                    nx, ny = (a2 * by - b2 * ay) / edge_cross, (b2 * ax - a2 * bx) / edge_cross
                    area[a] += _cross(nx, ny, cx, cy)
                    area[b] += _cross(cx, cy, nx, ny)
                    if n_edges < MAX_TRIANGLES + 2:
                        edge_from[n_edges], edge_to[n_edges] = a, b
                        edge_x[n_edges], edge_y[n_edges] = nx, ny
                        n_edges += 1
            for i in range(n_edges):
                for j in range(n_edges):
                    if edge_to[j] == edge_from[i]:
                        area[edge_from[i]] += _cross(edge_x[j], edge_y[j], edge_x[i], edge_y[i])
                        break

        for c in range(n_channels):
            out[p, c] = 0.0
        if is_straight or not has_capacity:
            for k in range(3):
                for c in range(n_channels):
                    out[p, c] += barycentric[k] / double_area * values[corners[containing, k], c]
        else:
            total = 0.0
            for i in range(n_edges):
                total += area[edge_from[i]]
            for i in range(n_edges):
                for c in range(n_channels):
                    out[p, c] += area[edge_from[i]] / total * values[edge_from[i], c]
        for i in range(n_triangles):
            is_inside[triangles[i]] = False
            for k in range(3):
                area[corners[triangles[i], k]] = 0.0


@njit(types.void(FLOATS_2D, types.float64, types.float64, types.float64[:, ::1]))
def add_roughness(picture, weight_x, weight_y, out):
    """
    Add the gradient of half the weighted sum of squared neighbour differences.

    ``picture`` and ``out`` (n_y, n_x): the differences from its two to four neighbours are added to each pixel, multiplied by
    ``weight_x`` in the row and ``weight_y`` in the column.
    """
    n_y, n_x = picture.shape
    for row in range(n_y):
        for column in range(n_x - 1):
            difference = weight_x * (picture[row, column + 1] - picture[row, column])
            out[row, column] -= difference
            out[row, column + 1] += difference
        if row + 1 < n_y:
            for column in range(n_x):
                difference = weight_y * (picture[row + 1, column] - picture[row, column])
                out[row, column] -= difference
                out[row + 1, column] += difference
