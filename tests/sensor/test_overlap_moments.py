"""Kernel of overlaps: areas and moments of A ∩ (B - d) against closed forms and shapely."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st

import foveasim as fs
from foveasim.sensor.pixel_optics import _kernels
from foveasim.sensor.pixel_optics._shapes import as_outlines

SQUARE = shapely.box(-1.5, -1.5, 1.5, 1.5)
#: A concave outline with a hole.
FRAME = shapely.Polygon(
    [(-2, -2), (2, -2), (2, 0.5), (0.3, 0.5), (0.3, 2), (-2, 2.2)],
    [[(-1.2, -1.2), (-1.2, -0.4), (-0.2, -0.4), (0, -1.2)]],
)
STAR = shapely.Polygon(
    [
        (
            (2.0 if k % 2 else 0.8) * math.cos(0.2 + k * math.pi / 5),
            (2.0 if k % 2 else 0.8) * math.sin(0.2 + k * math.pi / 5),
        )
        for k in range(10)
    ]
)
SECTOR = shapely.Polygon([(1.0, -1.0), (2.6, -1.4), (2.7, 1.3), (1.05, 0.9)])
SHAPES = {
    "square": SQUARE,
    "frame": FRAME,
    "star": STAR,
    "sector": SECTOR,
    "hexagon": shapely.Point(0, 0).buffer(1.4, 3),
}


def overlaps(one, other, displacements):
    """Return the moments of overlaps of two polygons, (n, 6), which both methods agree on."""
    rings = []
    for polygon in (one, other):
        outlines = as_outlines("polygon", fs.Layout.from_polygons([polygon]))
        rings += [outlines.xy_um, outlines.ring_offsets, outlines.site_offsets]
    displacements = np.ascontiguousarray(displacements, np.float64)
    found, from_pairs = np.empty((2, len(displacements), 6))
    _kernels.overlap_moments(*rings, displacements, found, from_pairs)
    np.testing.assert_allclose(found, from_pairs, rtol=0.0, atol=1e-12)
    return found


def moments_of(polygon):
    """Return area and moments of a polygon of shapely from a triangulation."""
    total = np.zeros(6)
    for triangle in shapely.constrained_delaunay_triangles(polygon).geoms:
        vertices = np.array(triangle.exterior.coords)[:3]
        # Exact for second order: the midpoints of the sides.
        middle = 0.5 * (vertices + np.roll(vertices, 1, axis=0))
        x, y = middle.T
        total += triangle.area * np.array([np.ones(3), x, y, x * x, x * y, y * y]).mean(axis=1)
    return total


@pytest.mark.parametrize("d_x", [-3.5, -2.0, -0.3, 0.0, 1e-9, 1.1, 2.9])
@pytest.mark.parametrize("d_y", [-1.0, 0.0, 0.7])
def test_squares_overlap_in_closed_form(d_x, d_y):
    expected = max(0.0, 3.0 - abs(d_x)) * max(0.0, 3.0 - abs(d_y))

    assert overlaps(SQUARE, SQUARE, [(d_x, d_y)])[0, 0] == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("one", SHAPES)
@pytest.mark.parametrize("other", SHAPES)
def test_overlap_moments_agree_with_shapely(one, other):
    displacements = np.random.default_rng(3).uniform(-2.0, 2.0, (40, 2))
    expected = [
        moments_of(shapely.intersection(SHAPES[one], shapely.affinity.translate(SHAPES[other], -d_x, -d_y)))
        for d_x, d_y in displacements
    ]

    np.testing.assert_allclose(overlaps(SHAPES[one], SHAPES[other], displacements), expected, atol=2e-13)


# Their edges meet in parallel, and coincide in part: each piece of the boundary counts once.
@pytest.mark.parametrize("shape", ["square", "sector", "hexagon"])
@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_displacements_along_edges_are_exact(shape, scale):
    one = SHAPES[shape]
    other = shapely.affinity.scale(one, scale, scale, origin=(one.exterior.coords[0]))
    edges = np.diff(np.array(one.exterior.coords), axis=0)
    fractions = np.array([-1.0, -0.7, -1e-9, -1e-17, 0.0, 1e-17, 1e-9, 0.4, 1.0])
    displacements = (edges[:, np.newaxis] * fractions[:, np.newaxis]).reshape(-1, 2)
    expected = [shapely.intersection(one, shapely.affinity.translate(other, *-d)).area for d in displacements]

    np.testing.assert_allclose(overlaps(one, other, displacements)[:, 0], expected, atol=1e-12)


# On a lattice, where edges coincide often.
LATTICE_POINT = st.tuples(st.integers(-16, 16), st.integers(-16, 16)).map(lambda point: np.array(point) / 8)


@given(st.lists(LATTICE_POINT, min_size=3, max_size=8), st.lists(LATTICE_POINT, min_size=3, max_size=8), LATTICE_POINT)
def test_any_convex_polygons_overlap_as_in_shapely(one, other, displacement):
    one, other = (shapely.MultiPoint(points).convex_hull for points in (one, other))
    assume(one.area > 0.0 and other.area > 0.0)
    moved = shapely.affinity.translate(other, -displacement[0], -displacement[1])

    found = overlaps(one, other, [displacement])[0, 0]
    assert found == pytest.approx(shapely.intersection(one, moved).area, abs=1e-12)


def test_circles_overlap_in_closed_form():
    n, radius = 1_000, 2.0
    angle = 2.0 * np.pi * np.arange(n) / n
    circle = shapely.Polygon(radius * np.column_stack((np.cos(angle), np.sin(angle))))
    s = np.array([0.1, 0.4, 0.8])
    expected = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    displacements = 2.0 * radius * s[:, np.newaxis] * [0.6, 0.8]

    found = overlaps(circle, circle, displacements)[:, 0] / (np.pi * radius**2)
    np.testing.assert_allclose(found, expected, atol=1e-5)  # the polygon has 6.6e-6 less area


@pytest.mark.parametrize("other", ["square", "frame"])
def test_overlaps_conserve_etendue(other):
    # Edges parallel to the axes at integers: overlaps are bilinear between integer displacements, so that their sum is the
    # integral over all displacements.
    corners = [(0, 0), (5, 0), (5, 2), (3, 2), (3, 5), (0, 5)]
    frame = shapely.Polygon(corners, [[(1, 1), (1, 2), (2, 2), (2, 1)]])
    shape = {"square": shapely.box(0, 0, 3, 2), "frame": frame}[other]
    steps = np.arange(-6.0, 7.0)
    displacements = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)

    assert overlaps(frame, shape, displacements)[:, 0].sum() == pytest.approx(frame.area * shape.area, rel=7e-14)


def test_small_displacements_lose_half_widths():
    d = 1e-7 * np.array([0.6, -0.8])
    vertices = [np.array(ring.coords) for ring in (FRAME.exterior, *FRAME.interiors)]
    lost = 0.5 * sum(abs(e[0] * d[1] - e[1] * d[0]) for ring in vertices for e in np.diff(ring, axis=0))

    assert FRAME.area - overlaps(FRAME, FRAME, [d])[0, 0] == pytest.approx(lost, rel=1e-5)
