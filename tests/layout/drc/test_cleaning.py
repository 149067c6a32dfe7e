"""Cleaning of layouts: gaps, overlaps, T-junctions, slivers, and the record of the changes."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import Layout

NO_OVERLAP = fs.DesignRules(max_overlap_um2=0.0)
TOLERANCE_UM = 0.005


def squares(pitch_um, side_um=4.0, n=4):
    y, x = np.divmod(np.arange(n * n), n)
    return Layout.from_rectangles(
        pitch_um * np.stack((x, y), axis=1), side_um, number=np.arange(n * n), channel=(x + y) % 2
    )


def assert_clean(layout, before, tolerance_um=TOLERANCE_UM):
    """Check what holds for every cleaned layout."""
    total = shapely.union_all(before.polygons())
    perimeter_um = shapely.length(before.polygons()).sum()
    again, changes = layout.clean(tolerance_um)

    assert layout.check(NO_OVERLAP).ok
    assert abs(layout.area_um2.sum() - total.area) <= tolerance_um * perimeter_um
    assert (list(changes), again) == ([], layout)
    for name, values in before.columns.items():
        np.testing.assert_array_equal(layout.columns[name], values)


# -- closed forms -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error_um", [0.002, -0.003], ids=["gaps of 2 nm", "overlaps of 3 nm"])
def test_gaps_and_overlaps_of_grid_close(error_um):
    before = squares(4.0 + error_um)
    layout, changes = before.clean(TOLERANCE_UM)
    inner = (4.0 + error_um) ** 2

    assert_clean(layout, before)
    assert layout.area_um2[[5, 6, 9, 10]] == pytest.approx(inner, rel=1e-12)
    assert layout.area_um2.sum() == pytest.approx((4.0 + 3 * (4.0 + error_um)) ** 2, rel=1e-12)
    assert layout.adjacency()[[5], :].sum() == pytest.approx(4 * (4.0 + error_um))
    assert [change.action for change in changes] == ["snapped"]
    assert changes[0].lost_um2[5] == pytest.approx(16.0 - inner)


def test_t_junction_closes_with_vertex():
    before = Layout.from_rectangles([[0.0, 0.0], [3.002, 1.0], [3.002, -1.0]], [[4.0, 4.0], [2.0, 2.0], [2.0, 2.0]])
    layout, changes = before.clean(TOLERANCE_UM)

    assert_clean(layout, before)
    assert layout.adjacency().toarray() == pytest.approx(np.array([[0, 2, 2], [2, 0, 2], [2, 2, 0]]), abs=2e-3)
    assert np.diff(layout.ring_offsets).tolist() == [5, 4, 4]
    assert [(change.action, change.site_ids) for change in changes] == [("snapped", (0, 1, 2))]


def test_exact_t_junction_is_noded():
    before = Layout.from_rectangles([[0.0, 0.0], [3.0, 1.0], [3.0, -1.0]], [[4.0, 4.0], [2.0, 2.0], [2.0, 2.0]])
    layout, changes = before.clean(TOLERANCE_UM)

    assert_clean(layout, before)
    assert [(change.action, change.site_ids, change.lost_um2) for change in changes] == [("noded", (0,), (0.0,))]
    assert str(changes).endswith("tolerance_um: 1 site noded")


def test_sliver_of_site_vanishes():
    spike = Layout.from_polygons([[(0, 0), (4, 0), (4, 1.999), (9, 2), (4, 2.001), (4, 4), (0, 4)]])
    layout, changes = spike.clean(TOLERANCE_UM)

    assert layout.area_um2 == pytest.approx(16.0, abs=1e-9)
    assert layout.bounds_um == pytest.approx((0, 0, 4, 4))
    assert changes[0].action == "snapped"


def test_wide_gaps_remain():
    before = squares(4.02)
    layout, changes = before.clean(TOLERANCE_UM)

    assert layout is before
    assert len(changes) == 0


def test_tapering_gap_remains_open():
    before = Layout.from_polygons([[(0, 0), (4, 0), (4, 4), (0, 4)], [(4.001, 0), (8, 0), (8, 4), (4.1, 4)]])
    layout, _ = before.clean(TOLERANCE_UM)

    assert_clean(layout, before)
    assert 0.5 * 0.1 * 4 * 0.8 < layout.bounds_um[2] * 4.0 - layout.area_um2.sum() < 0.5 * 0.1 * 4


def test_wide_overlap_belongs_to_smallest_site():
    before = Layout.from_rectangles([[0.0, 0.0], [3.0, 0.0], [0.0, 5.0]], [[4.0, 4.0], [4.0, 2.0], [1.0, 1.0]])
    layout, changes = before.clean(TOLERANCE_UM)

    assert_clean(layout, before)
    assert layout.area_um2 == pytest.approx([14.0, 8.0, 1.0])
    assert [(change.rule, change.action, change.site_ids) for change in changes][-1] == ("overlaps", "cut", (0,))


def test_site_inside_another_leaves_hole():
    layout, _ = Layout.from_rectangles([[0.0, 0.0], [0.0, 0.0]], [9.0, 3.0]).clean(TOLERANCE_UM)

    assert layout.area_um2 == pytest.approx([72.0, 9.0])
    assert np.diff(layout.site_offsets).tolist() == [2, 1]


# -- properties -----------------------------------------------------------------------------------------------------------


def disturbed(seed, amplitude_um):
    """Return Voronoi cells whose vertices are displaced, each site by itself."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (60, 2))
    cells = fs.layout.voronoi_of(points, size_um=(40.0, 40.0))
    moved = cells.xy_um + rng.uniform(-amplitude_um, amplitude_um, cells.xy_um.shape)
    return Layout.from_polygons((moved, cells.ring_offsets, cells.site_offsets), number=np.arange(60)), cells


@given(st.integers(0, 10**6), st.sampled_from([1e-4, 1e-3, 2e-3]))
@settings(deadline=None, max_examples=40)
def test_disturbed_cells_become_partition(seed, amplitude_um):
    try:
        before, _ = disturbed(seed, amplitude_um)
    except GeometryError:  # a short edge crosses another one
        return
    smallest = before.area_um2.min()
    layout = before if smallest < 0.1 else before.clean(TOLERANCE_UM)[0]
    if smallest < 0.1:
        return
    assert_clean(layout, before)
    assert layout.area_um2.sum() == pytest.approx(1600.0, abs=160 * TOLERANCE_UM)
    assert shapely.coverage_is_valid(layout.polygons())


def test_order_of_sites_does_not_matter():
    before, _ = disturbed(3, 2e-3)
    order = np.random.default_rng(0).permutation(60)
    layout, shuffled = before.clean(TOLERANCE_UM)[0], before[order].clean(TOLERANCE_UM)[0]

    assert (shapely.normalize(layout[order].polygons()) == shapely.normalize(shuffled.polygons())).all()


def test_overlapping_discs_become_disjoint():
    x = np.arange(8.0)
    discs = [shapely.Point(3.0 * i, 0.0).buffer(2.0 + 0.1 * i) for i in x]
    before = Layout.from_polygons(discs)
    layout, _ = before.clean(0.001)

    assert_clean(layout, before, 0.001)
    assert layout.area_um2[0] == pytest.approx(before.area_um2[0], rel=1e-3)  # the smallest keeps its overlap


def test_many_sites_are_clean_in_seconds():
    layout = fs.layout.hexagonal(n_columns=100, n_rows=100, pitch_um=3.0)
    rounded = Layout.from_polygons((np.round(layout.xy_um, 3), layout.ring_offsets, layout.site_offsets))
    found, _ = rounded.clean(0.003)

    assert found.adjacency().nnz == layout.adjacency().nnz


# -- errors, settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layout", "tolerance_um", "match", "sites"),
    [
        (
            Layout.from_rectangles([[0.0, 0.0], [9.0, 0.0]], [[4.0, 4.0], [4.0, 0.004]]),
            0.005,
            "site 1 would vanish",
            (1,),
        ),
        (Layout.from_rectangles([[0.0, 0.0], [0.0, 0.0]], 4.0), 0.005, "vanish, as it lies below", None),
        (
            Layout.from_rectangles([[0.0, 0.0], [0.0, 0.0]], [[9.0, 2.0], [1.0, 9.0]]),
            0.005,
            "site 0 would be divided",
            (0,),
        ),
    ],
    ids=["sliver", "duplicate", "cross"],
)
def test_lost_sites_are_named(layout, tolerance_um, match, sites):
    with pytest.raises(GeometryError, match=match) as error:
        layout.clean(tolerance_um)
    assert sites is None or error.value.site_ids == sites


@pytest.mark.parametrize("tolerance_um", [0.0, -1.0, float("nan"), "1 nm"])
def test_invalid_tolerance_is_rejected(tolerance_um):
    with pytest.raises(ParameterError, match="tolerance_um"):
        squares(4.0).clean(tolerance_um)


def test_settings_clean_layout(tmp_path):
    text = "generator: grid\nparameters: {n_x: 3, n_y: 3, pitch_um: 4.0}\nedits:\n"
    text += "- {kind: inset, margin_um: 0.001}\n- {kind: clean, tolerance_um: 0.005}\n"
    (tmp_path / "a.yaml").write_text(text)
    layout = fs.read_layout(tmp_path / "a.yaml")

    assert layout.area_um2.sum() == pytest.approx(11.998**2)
    assert layout.provenance["steps"][-1] == "cleaned within 0.005 µm"
