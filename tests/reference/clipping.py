"""Integration over polygons by clipping against every cell, in rational arithmetic and with shapely."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import shapely


def _half_plane(ring, axis, bound, keep_above):
    """Clip a ring (list of points) to coordinates >= bound or <= bound (Sutherland and Hodgman)."""
    clipped = []
    for a, b in pairwise([*ring, ring[0]] if ring else []):
        a_in = a[axis] >= bound if keep_above else a[axis] <= bound
        b_in = b[axis] >= bound if keep_above else b[axis] <= bound
        if a_in:
            clipped.append(a)
        if a_in != b_in:
            t = (bound - a[axis]) / (b[axis] - a[axis])
            clipped.append((a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])))
    return clipped


def _signed_area(ring):
    return (
        sum((a[0] * b[1] - b[0] * a[1] for a, b in pairwise([*ring, ring[0]])), Fraction(0)) / 2
        if ring
        else Fraction(0)
    )


def exact_weights(polygon, shape):
    """Return overlap areas of a polygon with unit cells of a grid at the origin, (n_y, n_x), in rational arithmetic."""
    weights = np.zeros(shape)
    rings = [polygon.exterior, *polygon.interiors]
    for k, ring in enumerate(rings):
        points = [(Fraction(float(x)), Fraction(float(y))) for x, y in ring.coords[:-1]]
        sign = 1 if k == 0 else -1
        for iy in range(shape[0]):
            row = _half_plane(_half_plane(points, 1, Fraction(iy), True), 1, Fraction(iy + 1), False)
            if not row:
                continue
            for ix in range(shape[1]):
                cell = _half_plane(_half_plane(row, 0, Fraction(ix), True), 0, Fraction(ix + 1), False)
                weights[iy, ix] += sign * float(abs(_signed_area(cell)))
    return weights


def shapely_weights(polygon, shape):
    """Return the same overlap areas computed with GEOS, cell by cell."""
    iy, ix = np.mgrid[: shape[0], : shape[1]]
    return shapely.area(shapely.intersection(polygon, shapely.box(ix, iy, ix + 1, iy + 1)))
