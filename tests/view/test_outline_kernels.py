"""Kernels of the outlines of pages, against plain Python."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import foveasim as fs
from foveasim.studio._parts.sites import _boundary_of
from foveasim.view._kernels import encode_pixels, number_points, outer_edges, smallest_fan_triangles
from foveasim.view.web._shapes import shapes_of


@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), max_size=60))
def test_points_are_numbered_by_first_occurrence(points):
    xy_um = np.array(points, float).reshape(-1, 2)
    position, first = np.empty((2, len(points)), np.int64)

    n_distinct = number_points(xy_um.view(np.uint64), position, first)

    distinct = list(dict.fromkeys(points))
    assert n_distinct == len(distinct)
    assert [distinct[k] for k in position] == points
    assert [points[k] for k in first[:n_distinct]] == distinct


@given(st.lists(st.lists(st.integers(0, 9), min_size=3, max_size=6, unique=True), max_size=12))
def test_outer_edges_occur_once(rings):
    position = np.array([v for ring in rings for v in ring], np.int64)
    offsets = np.cumsum([0, *(len(ring) for ring in rings)])
    edges = [(a, b) for ring in rings for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]
    counts = Counter(frozenset(edge) for edge in edges)

    found = outer_edges(position, offsets)

    assert sorted(map(tuple, found)) == sorted(edge for edge in edges if counts[frozenset(edge)] == 1)


@pytest.mark.parametrize("n_sectors", [3, 16, 17, 40])
def test_sectors_have_edges_at_their_circle(n_sectors):
    # Sectors from a common centre, 0: only the chords from one corner to the next belong to a single sector.
    corners = 1 + np.arange(n_sectors)
    sectors = np.stack((np.zeros(n_sectors, np.int64), corners, np.roll(corners, -1)), axis=1)

    found = outer_edges(sectors.ravel(), 3 * np.arange(n_sectors + 1))

    assert sorted(map(tuple, found)) == sorted(map(tuple, sectors[:, 1:]))


def test_pixels_are_bytes_of_light():
    light = np.array([[[0.0, 0.25, 1.0], [np.nan, -3.0, 7.0]]], np.float32)
    coverage = np.array([[0.0, 0.5, 1.0], [1.0, -1.0, 2.0]], np.float32)
    pixels = np.empty((2, 3, 4), np.uint8)
    encode_pixels(light, coverage, np.arange(5, dtype=np.uint8), pixels)
    colours = np.concatenate((light, 2.0 * light, 0.5 * light))
    coloured = np.empty((2, 3, 4), np.uint8)
    encode_pixels(colours, coverage, np.arange(5, dtype=np.uint8), coloured)

    assert pixels[::-1, :, 0].tolist() == [[0, 1, 4], [0, 0, 4]]  # levels of the table, top row first
    assert (pixels[..., :3] == pixels[..., :1]).all()
    assert pixels[::-1, :, 3].tolist() == [[0, 128, 255], [255, 0, 255]]
    assert coloured[1].tolist() == [[0, 0, 0, 0], [1, 2, 0, 128], [4, 4, 2, 255]]


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=3, max_size=8))
def test_smallest_triangle_of_a_fan(points):
    xy_um = np.array(points)
    (x, y), *rest = points
    areas_um2 = [0.5 * ((ax - x) * (by - y) - (ay - y) * (bx - x)) for (ax, ay), (bx, by) in pairwise(rest)]

    found = smallest_fan_triangles(xy_um, np.array([0]), np.array([len(points)]))

    assert found[0] == pytest.approx(min(areas_um2), abs=1e-12)


def test_boundary_is_the_rim_of_a_grid():
    shapes = shapes_of(fs.layout.grid(n_x=5, n_y=3, pitch_um=2.0))

    edges = shapes.xy_um[_boundary_of(shapes)["boundary"]]

    assert len(edges) == 2 * (5 + 3)
    assert np.linalg.norm(np.diff(edges, axis=1), axis=2).sum() == pytest.approx(2 * (5 + 3) * 2.0)
    assert np.all((np.abs(edges[..., 0]) == 5.0).all(axis=1) | (np.abs(edges[..., 1]) == 3.0).all(axis=1))


def test_photosites_with_gaps_have_no_boundary():
    layout = fs.layout.inset(fs.layout.grid(n_x=40, n_y=40, pitch_um=2.0), 0.2)

    assert _boundary_of(shapes_of(layout)) == {}
