"""Test polygons: a fixed collection of special cases, and random polygons."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import strategies as st

#: Polygons by name, for a grid of 7 rows and 9 columns of unit cells.
POLYGONS = {
    "square across boundaries": shapely.box(0.5, 0.5, 2.5, 2.5),
    "square on boundaries": shapely.box(1, 1, 3, 3),
    "one complete cell": shapely.box(4, 3, 5, 4),
    "inside one cell": shapely.box(4.25, 3.25, 4.5, 3.75),
    "tiny triangle inside one cell": shapely.Polygon([(4.5, 3.5), (4.501, 3.5), (4.5, 3.501)]),
    "triangle with vertex on a grid point": shapely.Polygon([(2, 2), (5.3, 2.9), (3.1, 4.7)]),
    "long sliver along a row": shapely.Polygon([(0.1, 3.2), (8.9, 3.25), (8.9, 3.3)]),
    "long sliver along a row boundary": shapely.Polygon([(0.1, 3.0), (8.9, 2.999), (8.9, 3.001)]),
    "long sliver along a column boundary": shapely.Polygon([(3.0, 0.2), (3.001, 6.8), (2.999, 6.8)]),
    "diamond on grid points": shapely.Polygon([(4, 1), (6, 3), (4, 5), (2, 3)]),
    "L shape": shapely.Polygon([(1, 1), (6, 1), (6, 2.5), (2.5, 2.5), (2.5, 6), (1, 6)]),
    "U shape": shapely.Polygon([(1.2, 1), (7.3, 1), (7.3, 6), (5.5, 6), (5.5, 2.2), (3.1, 2.2), (3.1, 6), (1.2, 6)]),
    "comb with teeth in one row": shapely.Polygon(
        [(1, 2), (8, 2), (8, 2.8), (7, 2.8), (7, 2.3), (5.5, 2.3), (5.5, 2.9), (4, 2.9), (4, 2.1), (2, 2.1), (2, 2.7), (1, 2.7)]
    ),
    "star": shapely.Polygon([(4, 6.5), (3.2, 4), (0.7, 4), (2.7, 2.4), (1.9, 0.3), (4, 1.7), (6, 0.4), (5.2, 2.5), (7.6, 4), (4.9, 4)]),
    "hole": shapely.Polygon(shapely.box(1, 1, 7, 6).exterior, [shapely.box(2.5, 2.5, 5.25, 4.75).exterior]),
    "hole on boundaries": shapely.Polygon(shapely.box(1, 1, 7, 6).exterior, [shapely.box(3, 3, 5, 5).exterior]),
    "two holes in a row": shapely.Polygon(
        shapely.box(0.5, 0.5, 8.5, 6.5).exterior, [shapely.box(1.5, 2, 3, 4).exterior, shapely.box(5, 2.2, 7.7, 4).exterior]
    ),
    "hole larger than the map": shapely.Polygon(shapely.box(-9, -9, 19, 19).exterior, [shapely.box(-1, -2, 10, 8).exterior]),
    "hole half off the map": shapely.Polygon(shapely.box(-3, -3, 12, 10).exterior, [shapely.box(-1, 2, 3.5, 20).intersection(shapely.box(-2, -2, 9, 9.5)).exterior]),
    "larger than the map": shapely.box(-5, -4, 20, 15),
    "equal to the map": shapely.box(0, 0, 9, 7),
    "off to the left": shapely.box(-3, 2, 2.5, 5),
    "off to the right": shapely.Polygon([(7.5, 1), (14, 2), (13, 6), (8.1, 5)]),
    "off to the left and right": shapely.Polygon([(-3, 2.2), (12, 1.1), (13, 5.5), (-2, 4.4)]),
    "off below": shapely.Polygon([(2, -4), (6, -3), (5, 1.5)]),
    "off above": shapely.Polygon([(2, 5.5), (6, 8), (1, 12)]),
    "completely left": shapely.box(-5, 1, -2, 4),
    "completely right": shapely.box(10, 1, 12, 4),
    "completely below": shapely.box(1, -5, 4, -1),
    "completely above": shapely.box(1, 8, 4, 9),
    "touching the left boundary from outside": shapely.box(-2, 1, 0, 4),
    "touching the upper right corner": shapely.box(9, 7, 11, 9),
    "circle": shapely.Point(4.3, 3.4).buffer(2.7, quad_segs=32),
    "ring": shapely.Point(4.3, 3.4).buffer(2.7).difference(shapely.Point(4.3, 3.4).buffer(2.6)),
}  # fmt: skip


@st.composite
def polygons(draw, shape):
    """Draw star-shaped polygons, convex or concave, with or without a hole, of random size and position near a grid."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n_y, n_x = shape
    n = draw(st.integers(3, 14))
    size = draw(st.sampled_from([0.02, 0.3, 1.0, 3.0, 2.0 * max(n_y, n_x)]))
    centre = rng.uniform((-2, -2), (n_x + 2, n_y + 2))
    angle = np.sort(rng.uniform(0, 2 * np.pi, n)) if draw(st.booleans()) else np.arange(n) * 2 * np.pi / n
    ring = centre + size * rng.uniform(0.3, 1.0, (n, 1)) * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    lattice = draw(st.sampled_from([None, None, 1, 2, 4]))
    if lattice is not None:  # vertices and edges on cell boundaries and centres
        ring = np.round(ring * lattice) / lattice
    if draw(st.booleans()):
        ring = ring[::-1]
    hole = [centre + 0.2 * (ring - centre)] if draw(st.booleans()) and lattice is None else []
    polygon = shapely.Polygon(ring, hole)
    return polygon if polygon.is_valid and polygon.area > 1e-6 else shapely.box(0.25, 0.5, 1.5, 2.0)
