"""Kernel of overlaps: areas and moments of A ∩ (B - d) against closed forms and shapely."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

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
SHAPES = {"square": SQUARE, "frame": FRAME, "star": STAR}


def overlaps(one, other, displacements):
    """Return the moments of overlaps of two polygons, (n, 6)."""
    n = len(displacements)
    rings = []
    for polygon in (one, other):
        outlines = as_outlines("polygon", fs.Layout.from_polygons([polygon]))
        rings += [outlines.xy_um, outlines.ring_offsets, np.zeros(n + 1, np.int64)]
    # The same site for each displacement.
    found = np.empty((n, 6))
    for k, displacement in enumerate(np.asarray(displacements, np.float64)):
        row = np.empty((1, 6))
        sites = [np.array([0, rings[1].size - 1]), np.array([0, rings[4].size - 1])]
        _kernels.overlap_moments(*rings[:2], sites[0], *rings[3:5], sites[1], displacement[np.newaxis], row)
        found[k] = row[0]
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


def test_circles_overlap_in_closed_form():
    n, radius = 16_000, 2.0
    angle = 2.0 * np.pi * np.arange(n) / n
    circle = shapely.Polygon(radius * np.column_stack((np.cos(angle), np.sin(angle))))
    s = np.array([0.1, 0.4, 0.8])
    expected = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    displacements = 2.0 * radius * s[:, np.newaxis] * [0.6, 0.8]

    found = overlaps(circle, circle, displacements)[:, 0] / (np.pi * radius**2)
    np.testing.assert_allclose(found, expected, atol=8e-8)  # the polygon has 2.6e-8 less area


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
