"""Measurements of packed rings against exact rational arithmetic, closed forms and plain loops."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from foveasim._core import _kernels
from foveasim._core.rings import (
    KERNEL_VERTICES,
    collapse_short_edges,
    convexity,
    next_vertex,
    positions_in_runs,
    ring_moments,
    site_bounds_um,
    site_moments,
)

relaxed = settings(max_examples=examples(60))

#: Multiples of 2^-16 µm, which shifts by integer µm preserve exactly.
dyadic = st.integers(-(2**20), 2**20).map(lambda k: k / 2**16)
points = st.tuples(dyadic, dyadic)
rings = st.lists(points, min_size=3, max_size=9)
sites = st.lists(st.lists(rings, min_size=1, max_size=3), min_size=1, max_size=5)


def packed(nested):
    """Convert sites as nested lists to packed rings."""
    all_rings = [ring for site in nested for ring in site]
    xy_um = np.array([point for ring in all_rings for point in ring], float).reshape(-1, 2)
    ring_offsets = np.cumsum([0, *map(len, all_rings)])
    return xy_um, ring_offsets, np.cumsum([0, *map(len, nested)])


def exact_area_and_moment(ring):
    """Return signed area and first moments of a ring as fractions, from triangles with the point (1, 2)."""
    px, py = Fraction(1), Fraction(2)
    area, moment = Fraction(0), [Fraction(0), Fraction(0)]
    exact = [(Fraction(x), Fraction(y)) for x, y in ring]
    for (ax, ay), (bx, by) in pairwise([*exact, exact[0]]):
        triangle = ((ax - px) * (by - py) - (bx - px) * (ay - py)) / 2
        area += triangle
        moment[0] += triangle * (px + ax + bx) / 3
        moment[1] += triangle * (py + ay + by) / 3
    return area, moment


@pytest.mark.parametrize(
    ("lengths", "after"),
    [
        ((), []),
        ((1,), [0]),
        ((3,), [1, 2, 0]),
        ((3, 4), [1, 2, 0, 4, 5, 6, 3]),
        ((4, 1, 3), [1, 2, 3, 0, 4, 6, 7, 5]),
    ],
)
def test_next_vertex_closes_each_ring(lengths, after):
    assert next_vertex(np.cumsum([0, *lengths])).tolist() == after


@given(sites)
@relaxed
def test_ring_moments_match_exact_arithmetic(nested):
    xy_um, ring_offsets, _ = packed(nested)
    area_um2, moment_um3 = ring_moments(xy_um, ring_offsets)
    expected = [exact_area_and_moment(ring) for site in nested for ring in site]

    np.testing.assert_allclose(area_um2, [float(a) for a, _ in expected], rtol=1e-13, atol=1e-11)
    np.testing.assert_allclose(moment_um3, [[float(m) for m in ms] for _, ms in expected], rtol=1e-12, atol=1e-9)


@given(sites)
@relaxed
def test_kernel_of_moments_matches_exact_arithmetic(nested):
    xy_um, ring_offsets, _ = packed(nested)
    n_rings = ring_offsets.size - 1
    area_um2, moment_um3 = np.empty(n_rings), np.empty((n_rings, 2))
    _kernels.ring_moments(xy_um, ring_offsets, area_um2, moment_um3)
    expected = [exact_area_and_moment(ring) for site in nested for ring in site]

    np.testing.assert_allclose(area_um2, [float(a) for a, _ in expected], rtol=1e-13, atol=1e-11)
    np.testing.assert_allclose(moment_um3, [[float(m) for m in ms] for _, ms in expected], rtol=1e-12, atol=1e-9)


def test_many_sites_have_moments_of_few():
    ring_um = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (0.0, 3.0)])
    shift_um = np.random.default_rng(3).integers(-500, 500, (KERNEL_VERTICES, 2)).astype(float)
    many_um = (ring_um + shift_um[:, np.newaxis]).reshape(-1, 2)
    few_um, _ = ring_moments(ring_um, np.array([0, 4]))
    area_um2, centroid_um = site_moments(
        many_um, 4 * np.arange(shift_um.shape[0] + 1), np.arange(shift_um.shape[0] + 1)
    )
    _, (at_origin_um,) = site_moments(ring_um, np.array([0, 4]), np.array([0, 1]))

    assert (area_um2 == few_um).all()
    np.testing.assert_allclose(centroid_um - shift_um, np.broadcast_to(at_origin_um, shift_um.shape), rtol=1e-12)


@given(rings)
@relaxed
def test_reversed_ring_has_negated_area(ring):
    offsets = np.array([0, len(ring)])
    forward, _ = ring_moments(np.array(ring), offsets)
    backward, _ = ring_moments(np.array(ring[::-1]), offsets)

    np.testing.assert_allclose(backward, -forward, rtol=1e-13, atol=1e-11)


@given(sites, st.integers(-(10**7), 10**7), st.integers(-(10**7), 10**7))
@relaxed
def test_areas_are_exact_far_from_origin(nested, dx_um, dy_um):
    xy_um, ring_offsets, _ = packed(nested)
    near, _ = ring_moments(xy_um, ring_offsets)
    far, _ = ring_moments(xy_um + np.array([dx_um, dy_um]), ring_offsets)

    assert far.tolist() == near.tolist()


@given(st.lists(rings, min_size=1, max_size=6))
@relaxed
def test_ring_moments_are_independent_of_other_rings(all_rings):
    xy_um, ring_offsets, _ = packed([all_rings])
    area_um2, moment_um3 = ring_moments(xy_um, ring_offsets)
    alone = [ring_moments(np.array(ring), np.array([0, len(ring)])) for ring in all_rings]

    assert area_um2.tolist() == [float(area[0]) for area, _ in alone]
    assert moment_um3.tolist() == [moment[0].tolist() for _, moment in alone]


@pytest.mark.parametrize(
    ("site", "area_um2", "centroid_um"),
    [
        pytest.param([[(0, 0), (4, 0), (4, 2), (0, 2)]], 8.0, (2.0, 1.0), id="rectangle"),
        pytest.param([[(0, 0), (6, 0), (0, 3)]], 9.0, (2.0, 1.0), id="triangle"),
        pytest.param([[(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]], 5.0, (1.1, 1.1), id="L"),
        pytest.param(
            [[(0, 0), (4, 0), (4, 4), (0, 4)], [(1, 1), (1, 3), (3, 3), (3, 1)]], 12.0, (2.0, 2.0), id="central hole"
        ),
        pytest.param(
            [[(0, 0), (4, 0), (4, 4), (0, 4)], [(0, 0), (0, 4), (2, 4), (2, 0)]],
            8.0,
            (3.0, 2.0),
            id="left half removed",
        ),
        pytest.param(
            [
                [(0, 0), (6, 0), (6, 2), (0, 2)],
                [(1, 0.5), (1, 1.5), (2, 1.5), (2, 0.5)],
                [(4, 0.5), (4, 1.5), (5, 1.5), (5, 0.5)],
            ],
            10.0,
            (3.0, 1.0),
            id="two holes",
        ),
    ],
)
def test_area_and_centroid_of_known_shapes(site, area_um2, centroid_um):
    area, centroid = site_moments(*packed([site]))

    assert area.tolist() == pytest.approx([area_um2], rel=1e-14)
    assert centroid[0].tolist() == pytest.approx(centroid_um, rel=1e-14)


def test_parts_of_site_sum_to_total():
    site = [(0, 0), (7, 1), (9, 6), (3, 8), (-2, 4)]
    parts = [[site[0], site[1], site[2]], [site[0], site[2], site[3]], [site[0], site[3], site[4]]]
    area, centroid = site_moments(*packed([[site]]))
    part_area, part_centroid = site_moments(*packed([[part] for part in parts]))

    assert part_area.sum() == pytest.approx(area[0], rel=1e-14)
    assert (part_area @ part_centroid / part_area.sum()).tolist() == pytest.approx(centroid[0].tolist(), rel=1e-14)


@given(sites)
@relaxed
def test_bounds_are_vertex_extremes(nested):
    bounds = site_bounds_um(*packed(nested))
    expected = []
    for site in nested:
        xs = [x for ring in site for x, _ in ring]
        ys = [y for ring in site for _, y in ring]
        expected.append([min(xs), min(ys), max(xs), max(ys)])

    assert bounds.tolist() == expected


def test_empty_rings_give_empty_measurements():
    empty = np.zeros((0, 2)), np.zeros(1, np.int64)

    assert [a.shape for a in ring_moments(*empty)] == [(0,), (0, 2)]
    assert [a.shape for a in site_moments(*empty, np.zeros(1, np.int64))] == [(0,), (0, 2)]
    assert site_bounds_um(*empty, np.zeros(1, np.int64)).shape == (0, 4)


def test_measurements_accept_read_only_arrays():
    arrays = packed([[[(0, 0), (2, 0), (2, 2)]], [[(5, 5), (6, 5), (6, 7), (5, 7)]]])
    before = [array.copy() for array in arrays]
    for array in arrays:
        array.flags.writeable = False

    assert site_moments(*arrays)[0].tolist() == [2.0, 2.0]
    assert site_bounds_um(*arrays)[1].tolist() == [5.0, 5.0, 6.0, 7.0]
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))


def test_positions_in_runs_restart_at_zero():
    assert positions_in_runs(np.array([3, 0, 1, 2])).tolist() == [0, 1, 2, 0, 0, 1]


# -- convexity --------------------------------------------------------------------------------------------------------

small = st.tuples(st.integers(-4, 4), st.integers(-4, 4))


def signs(xy_um, ring_offsets):
    """Return the orientations of convex rings, equal with arrays and with the kernel of many vertices."""
    found = convexity(xy_um, ring_offsets).tolist()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("foveasim._core.rings.KERNEL_VERTICES", 0)
        assert convexity(xy_um, ring_offsets).tolist() == found
    return found


@given(st.lists(st.lists(small, min_size=3, max_size=7), min_size=1, max_size=6))
@settings(max_examples=examples(400))
def test_convex_rings_equal_their_hulls(all_rings):
    all_rings = [ring for ring in all_rings if all(a != b for a, b in pairwise([*ring, ring[0]]))]
    if not all_rings:
        return
    xy_um, ring_offsets, _ = packed([[ring] for ring in all_rings])
    polygons = [shapely.Polygon(ring) for ring in all_rings]
    # Every vertex is a corner of the hull, without duplicates.
    expected = [
        (1 if p.exterior.is_ccw else -1)
        if p.is_valid and p.convex_hull.geom_type == "Polygon" and len(p.convex_hull.exterior.coords) == len(ring) + 1
        else 0
        for p, ring in zip(polygons, all_rings, strict=True)
    ]

    assert signs(xy_um, ring_offsets) == expected


@pytest.mark.parametrize("far_um", [0.0, 1e6])
@pytest.mark.parametrize("n", [3, 4, 6, 50])
def test_regular_polygons_are_convex(n, far_um):
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = np.stack((np.cos(angle), np.sin(angle)), axis=1) + far_um

    assert signs(ring, np.array([0, n])) == [1]
    assert signs(ring[::-1], np.array([0, n])) == [-1]


def test_pentagram_is_not_convex():
    angle = 2.0 * np.pi * 2.0 * np.arange(5) / 5

    assert signs(np.stack((np.cos(angle), np.sin(angle)), axis=1), np.array([0, 5])) == [0]


def test_short_edges_collapse_alike_in_all_rings():
    tiny = 1e-12
    xy = np.array(
        [[0, 0], [1, 0], [1, 1], [1 - tiny, 1 + tiny], [0, 1], [1, 0], [2, 0], [2, 1], [1 - tiny, 1 + tiny], [1, 1]]
    )
    found, offsets = collapse_short_edges(xy.astype(float), np.array([0, 5, 10]), 1e-9)

    corner = [1 - tiny, 1 + tiny]
    assert offsets.tolist() == [0, 4, 8]
    assert found.tolist() == [[0, 0], [1, 0], corner, [0, 1], [1, 0], [2, 0], [2, 1], corner]
