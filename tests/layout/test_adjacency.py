"""Adjacency: lengths of shared edges, including T-junctions."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.layout.adjacency import near_boxes
from foveasim.layout.model import layout_of

TILINGS = {
    "grid": fs.layout.grid(n_x=7, n_y=5, pitch_um=1.7),
    "hexagonal": fs.layout.hexagonal(n_columns=7, n_rows=6, pitch_um=2.3),
    "log_polar": fs.layout.log_polar(n_sectors=16, r_min_um=3.0, r_max_um=22.0),
    "log_polar staggered": fs.layout.log_polar(
        n_sectors=14, r_min_um=3.0, r_max_um=18.4, stagger=True, chords_per_arc=3
    ),
    "zones": fs.layout.zones(side_um=(4, 12, 28), pitch_um=(1, 2, 4)),
}


@pytest.mark.parametrize("angle_deg", [0.0, 17.3, 90.0])
@pytest.mark.parametrize("name", TILINGS)
def test_shared_and_boundary_edges_sum_to_perimeters(name, angle_deg):
    layout = TILINGS[name].rotate(angle_deg).translate(321.0, -123.0)
    polygons = layout.polygons()
    unshared_um = 2 * shapely.length(polygons).sum() - 2 * layout.adjacency().sum()
    boundary_um = 2 * shapely.length(shapely.union_all(shapely.set_precision(polygons, 1e-7)))

    assert unshared_um == pytest.approx(boundary_um, rel=1e-6)


def test_central_hexagon_shares_sides_with_six():
    shared_um = TILINGS["hexagonal"].adjacency().toarray()
    centre = shared_um[3 * 7 + 3]

    assert np.count_nonzero(centre) == 6
    assert centre[centre > 0] == pytest.approx(2.3 / np.sqrt(3))


def test_squares_touching_in_corner_are_not_adjacent():
    shared_um = fs.layout.grid(n_x=2, n_y=2, pitch_um=1.0).adjacency().toarray()

    assert shared_um.tolist() == [[0, 1, 1, 0], [1, 0, 0, 1], [1, 0, 0, 1], [0, 1, 1, 0]]


@pytest.mark.parametrize("angle_deg", [0.0, 31.7])
def test_long_edge_is_shared_with_short_ones(angle_deg):
    boxes = [shapely.box(0, 0, 4, 2), shapely.box(0, 2, 1, 3), shapely.box(1, 2, 3, 3), shapely.box(3, 2, 4.5, 3)]
    layout = fs.Layout.from_polygons(boxes).rotate(angle_deg, (7.0, -3.0))

    assert layout.adjacency().toarray()[0] == pytest.approx([0, 1, 2, 1], abs=1e-9)


def test_site_in_hole_is_adjacent():
    frame = shapely.box(0, 0, 8, 8).difference(shapely.box(2, 2, 5, 5))
    layout = fs.Layout.from_polygons([frame, shapely.box(2, 2, 5, 5)])

    assert layout.adjacency().toarray().tolist() == [[0, 12], [12, 0]]


def test_max_gap_includes_sites_across_trench():
    layout = fs.layout.grid(n_x=3, n_y=1, pitch_um=2.0, width_um=1.8)

    assert layout.adjacency().nnz == 0
    assert layout.adjacency(max_gap_um=0.25).toarray() == pytest.approx(
        np.array([[0, 1.8, 0], [1.8, 0, 1.8], [0, 1.8, 0]])
    )


@settings(max_examples=examples(40))
@given(seed=st.integers(0, 10_000), angle_deg=st.floats(0, 360))
def test_random_tilings_agree_with_shapely(seed, angle_deg):
    """Random guillotine cuts; the reference is the common line of each pair before the rotation."""
    rng = np.random.default_rng(seed)
    boxes = [(0.0, 0.0, 16.0, 16.0)]
    for _ in range(12):
        x0, y0, x1, y1 = boxes.pop(int(rng.integers(len(boxes))))
        cut = float(rng.integers(1, 16)) / 16
        if rng.random() < 0.5:
            boxes += [(x0, y0, x0 + cut * (x1 - x0), y1), (x0 + cut * (x1 - x0), y0, x1, y1)]
        else:
            boxes += [(x0, y0, x1, y0 + cut * (y1 - y0)), (x0, y0 + cut * (y1 - y0), x1, y1)]
    polygons = [shapely.box(*box) for box in boxes]
    expected = [[0.0 if a is b else shapely.length(shapely.intersection(a, b)) for b in polygons] for a in polygons]

    shared_um = fs.Layout.from_polygons(polygons).rotate(angle_deg).adjacency().toarray()

    assert shared_um == pytest.approx(np.array(expected), abs=1e-9)
    assert np.array_equal(shared_um, shared_um.T)


def test_empty_layout_has_empty_adjacency():
    assert TILINGS["grid"][[]].adjacency().shape == (0, 0)


def test_negative_gap_raises():
    with pytest.raises(ParameterError, match="'max_gap_um' must be >= 0"):
        TILINGS["grid"].adjacency(max_gap_um=-1.0)


def test_corners_overlapping_by_rounding_share_nothing():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 2, 2), shapely.box(2 + 1e-8, 2 - 1e-8, 4, 4)])

    assert layout.adjacency().nnz == 0


def test_edges_without_length_share_nothing():
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    xy_um = np.concatenate((square[[0, 1, 1, 2, 3]], square + np.array([2.0, 0.0])))
    layout = layout_of(xy_um, np.array([0, 5, 9]), np.arange(3))

    assert layout.adjacency().toarray().tolist() == [[0.0, 2.0], [2.0, 0.0]]


def test_rotated_voronoi_cells_share_same_edges():
    layout = fs.layout.fovi(fov_um=36.0, a_um=3.0, n_rings=12)

    assert abs(layout.rotate(30.0).adjacency() - layout.adjacency()).max() < 1e-9
    assert layout.check(fs.DesignRules(min_width_um=0.4, angle_limit_deg=26.0)).ok


@given(
    st.lists(st.tuples(*[st.integers(-20, 20)] * 2, *[st.integers(0, 9)] * 2, st.integers(0, 6)), max_size=40),
    st.booleans(),
)
@settings(max_examples=examples(60))
def test_near_boxes_match_plain_loop(described, has_own_reach):
    low = np.array([box[:2] for box in described], float).reshape(-1, 2)
    side = np.array([box[2:4] for box in described], float).reshape(-1, 2)
    boxes, reach = np.concatenate((low, low + side), axis=1), np.array([box[4] for box in described], float)
    reach = reach if has_own_reach else np.full(len(described), 3.0)

    first, second = near_boxes(boxes, reach if has_own_reach else 3.0)

    expected = []
    for i in range(len(described)):
        for j in range(i + 1, len(described)):
            gap = np.maximum(boxes[i, :2] - boxes[j, 2:], boxes[j, :2] - boxes[i, 2:]).max()
            if gap <= 0.5 * (reach[i] + reach[j]):
                expected.append((i, j))
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == expected
