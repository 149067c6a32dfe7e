"""Repair: repaired layouts satisfy their rules, and the changes are complete."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError

RINGS = fs.layout.log_polar(n_sectors=32, r_min_um=2.0, r_max_um=50.0)


def changed(changes):
    return {site for change in changes for site in change.site_ids}


def test_minimum_size_drops_blind_spot_sites():
    legal, changes = RINGS.enforce(fs.DesignRules(min_size_um=1.0), repair="drop")
    is_small = np.sqrt(RINGS.area_um2) < 1.0

    assert [change.action for change in changes] == ["dropped"]
    assert changed(changes) == set(np.flatnonzero(is_small))
    assert legal.n_sites == np.count_nonzero(~is_small)
    assert legal.columns["ring"].min() == RINGS.columns["ring"][is_small].max() + 1


def test_merging_preserves_area_and_reaches_size():
    rules = fs.DesignRules(min_size_um=1.0, max_overlap_um2=0.0)
    legal, changes = RINGS.enforce(rules, repair="merge")

    assert legal.check(rules).ok
    assert legal.area_um2.sum() == pytest.approx(RINGS.area_um2.sum(), rel=1e-12)
    assert {change.action for change in changes} == {"merged"}
    assert set(np.flatnonzero(np.sqrt(RINGS.area_um2) < 1.0)) <= changed(changes)


def test_smaller_of_two_overlapping_sites_dropped():
    layout = fs.Layout.from_rectangles([[0, 0], [1.5, 0], [10, 0]], [2.0, 1.8, 2.0])
    legal, changes = layout.enforce(fs.DesignRules(max_overlap_um2=0.0), repair="drop")

    assert [(change.rule, change.action, change.site_ids) for change in changes] == [
        ("max_overlap_um2", "dropped", (1,))
    ]
    assert legal.n_sites == 2


def test_site_overlapping_several_is_dropped_alone():
    layout = fs.Layout.from_rectangles(
        [[0, 0], [2, 0], [-2, 0], [0, 2]], [[1.0, 1.0], [3.2, 0.7], [3.2, 0.7], [0.7, 3.2]]
    )
    legal, changes = layout.enforce(fs.DesignRules(max_overlap_um2=0.0), repair="drop")

    assert legal.check(fs.DesignRules(max_overlap_um2=0.0)).ok
    assert changed(changes) == {0}


@settings(max_examples=examples(30))
@given(seed=st.integers(0, 10_000), repair=st.sampled_from(["best", "drop", "shrink", "merge", "refill"]))
def test_repair_satisfies_rules_and_preserves_rest(seed, repair):
    rng = np.random.default_rng(seed)
    layout = fs.Layout.from_rectangles(rng.uniform(0, 15, (30, 2)), rng.uniform(0.3, 2.5, (30, 2)))
    rules = fs.DesignRules(min_width_um=0.6, max_overlap_um2=0.0, min_space_um=0.3, die_um=(0, 0, 15, 15))
    legal, changes = layout.enforce(rules, repair=repair)
    untouched = [i for i in range(30) if i not in changed(changes)]

    assert legal.check(rules).ok
    # Refilling may add vertices to edges.
    remaining = {polygon.simplify(0.0).normalize() for polygon in legal.polygons()}
    assert {polygon.simplify(0.0).normalize() for polygon in layout.polygons()[untouched]} <= remaining


def test_refill_covers_blind_spot():
    rules = fs.DesignRules(min_size_um=1.0, max_overlap_um2=0.0, max_gap_um2=0.0)
    legal, changes = RINGS.enforce(rules, repair="refill")
    n_remaining = int((np.sqrt(RINGS.area_um2) >= 1.0).sum())
    new = legal[n_remaining:]

    assert legal.check(rules).ok
    assert [(change.rule, change.action) for change in changes] == [("min_size_um", "replaced")]
    assert changed(changes) == set(np.flatnonzero(np.sqrt(RINGS.area_um2) < 1.0))
    assert legal.area_um2.sum() == pytest.approx(shapely.Polygon(shapely.union_all(RINGS.polygons()).exterior).area)
    assert np.median(new.area_um2) == pytest.approx(1.0, rel=1e-6)
    assert set(legal.columns) == set(RINGS.columns)
    assert new.columns["ring"].max() < legal.columns["ring"][:n_remaining].min()
    assert legal.provenance["generator"] == "log_polar"


def test_refill_satisfies_minimum_width():
    rules = fs.DesignRules(min_size_um=1.0, min_width_um=0.9, angle_limit_deg=40.0, max_overlap_um2=0.0)
    legal, changes = RINGS.enforce(rules, repair="refill")

    assert legal.check(rules).ok
    assert {change.action for change in changes} == {"replaced"}
    hole_um2 = shapely.Polygon(shapely.union_all(RINGS.polygons()).exterior).area - legal.area_um2.sum()
    assert 0.0 <= hole_um2 < 0.02 * legal.area_um2.sum()


def test_waived_rules_are_not_repaired():
    rules = fs.DesignRules(min_size_um=1.0, waivers={"min_size_um": "test structures"})

    legal, changes = RINGS.enforce(rules)

    assert legal == RINGS
    assert list(changes) == []


def test_legal_layout_is_unchanged():
    legal, changes = RINGS.enforce(fs.DesignRules(min_size_um=0.1))

    assert legal == RINGS
    assert list(changes) == []
    assert changes.before == changes.after


def test_irreparable_violations_raise_error():
    with pytest.raises(GeometryError, match="rules that removing sites cannot repair: max_gap_um2: 1 violation"):
        RINGS.enforce(fs.DesignRules(min_size_um=1.0, max_gap_um2=0.0))
    with pytest.raises(GeometryError, match="max_sites: 1 violation"):
        RINGS.enforce(fs.DesignRules(max_sites=10))


def test_unknown_repair_is_rejected():
    with pytest.raises(
        ParameterError, match="'repair' must be one of 'best', 'drop', 'shrink', 'merge', 'refill', got 'grow'"
    ):
        RINGS.enforce(fs.DesignRules(), repair="grow")


def test_site_in_hole_merges_with_frame():
    frame = shapely.box(0, 0, 9, 9).difference(shapely.box(4, 4, 4.5, 4.5))
    layout = fs.Layout.from_polygons([frame, shapely.box(4, 4, 4.5, 4.5)])
    legal, changes = layout.enforce(fs.DesignRules(min_size_um=1.0), repair="merge")

    assert legal.area_um2.tolist() == [81.0]
    assert changes[0].site_ids == (0, 1)


def test_repair_may_drop_all_sites():
    rules = fs.DesignRules(
        min_size_um=1e3, max_size_um=2e3, min_area_um2=1.0, min_hole_um2=1.0, min_width_um=1.0, min_space_um=1.0,
        max_aspect_ratio=9.0, min_angle_deg=1.0, edge_angle_step_deg=45.0, grid_um=0.1, max_overlap_um2=0.0, max_gap_um2=0.0,
        die_um=(0, 0, 1, 1), max_growth=3.0, min_growth=0.1, max_neighbour_ratio=2.0, max_sites=5,
        waivers={"max_gap_um2": "no site remains to cover the die"},
    )  # fmt: skip
    legal, changes = RINGS.enforce(rules, repair="drop")

    assert legal.n_sites == 0
    assert changed(changes) == set(range(RINGS.n_sites))


# -- shrinking -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space_um", "limit_um", "grid_um", "retreat_um"),
    [(0.4, 1.0, None, 0.3), (0.4, 1.0, 0.1, 0.3), (0.5, 0.9, 0.25, 0.25)],
)
def test_sites_retreat_equally_on_the_grid(space_um, limit_um, grid_um, retreat_um):
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [2.0 + space_um, 0.0], [20.0, 0.0]], 2.0)
    rules = fs.DesignRules(min_space_um=limit_um, grid_um=grid_um)
    legal, changes = layout.enforce(rules, repair="shrink")

    assert legal.check(rules).ok
    assert [(change.rule, change.action, change.site_ids) for change in changes] == [("min_space_um", "shrunk", (0, 1))]
    assert changes[0].lost_um2 == pytest.approx([2.0 * retreat_um] * 2, rel=1e-5)
    assert legal.bounds_um == layout.bounds_um
    assert legal.area_um2 == pytest.approx([4.0 - 2.0 * retreat_um, 4.0 - 2.0 * retreat_um, 4.0], rel=1e-5)


def test_larger_of_two_overlapping_sites_is_cut():
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [1.5, 0.0]], [2.0, 1.8])
    legal, changes = layout.enforce(fs.DesignRules(max_overlap_um2=0.0), repair="shrink")

    assert [(change.action, change.site_ids) for change in changes] == [("shrunk", (0,))]
    assert changes[0].lost_um2 == pytest.approx([0.4 * 1.8])
    assert legal.area_um2 == pytest.approx([4.0 - 0.72, 1.8**2])


@pytest.mark.parametrize("margin_um", [0.02, 0.1])
def test_trenches_are_widened_without_losing_sites(margin_um):
    layout = fs.layout.inset(fs.layout.log_polar(n_sectors=24, min_size_um=1.5, r_max_um=20.0, stagger=True), margin_um)
    rules = fs.DesignRules(min_space_um=0.3, min_size_um=0.5)
    legal, changes = layout.enforce(rules, repair="shrink")

    assert legal.check(rules).ok
    assert legal.n_sites == layout.n_sites
    assert {change.action for change in changes} == {"shrunk"}
    assert legal.columns.keys() == layout.columns.keys()
    # At least the area of half the missing width along the facing edges, at most three times as much.
    missing_um2 = (0.15 - margin_um) * shapely.length(layout.polygons())
    lost_um2 = layout.area_um2 - legal.area_um2
    assert (lost_um2 <= 3.0 * missing_um2).all()
    assert np.median(lost_um2 / missing_um2) > 0.8


def test_sites_that_vanish_are_dropped():
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [1.2, 0.0]], [2.0, 0.2])
    rules = fs.DesignRules(min_space_um=1.0, min_size_um=0.15)
    legal, changes = layout.enforce(rules, repair="shrink")

    assert legal.check(rules).ok
    assert {change.action for change in changes} == {"shrunk", "dropped"}
    assert legal.n_sites == 1


# -- what will be manufactured -------------------------------------------------------------------------------------------


def test_touching_sites_are_separated_in_files(tmp_path):
    """Rings around rings of other sectors touch in edges and corners: before, repaired layouts still touched in KLayout."""
    rings = fs.layout.log_polar(n_sectors=40, r_min_um=12.0, r_max_um=40.0)
    core = fs.layout.hexagonal(n_columns=9, n_rows=9, pitch_um=2.0).rotate(17.0)
    layout = fs.layout.union([fs.Layout(*part.rings_um) for part in (rings, core)])
    rules = fs.DesignRules(min_space_um=0.3, max_overlap_um2=0.0)
    legal, changes = layout.enforce(rules, repair="shrink")
    legal.write(tmp_path / "a.gds")
    polygons = fs.read_layout(tmp_path / "a.gds").polygons()
    first, second = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=0.3 - 1e-6)

    assert legal.check(rules).ok
    assert legal.n_sites == layout.n_sites
    assert (first == second).all()
    assert changes.after.area_um2 < changes.before.area_um2


def test_best_repair_loses_no_area():
    rings = fs.layout.log_polar(n_sectors=96, r_min_um=30.0, r_max_um=300.0)
    rules = fs.DesignRules(min_size_um=4.0, max_overlap_um2=0.0)
    legal, changes = rings.enforce(rules)
    _, dropped = rings.enforce(rules, repair="drop")

    assert legal.check(rules).ok
    assert changes.after.area_um2 == pytest.approx(changes.before.area_um2, rel=1e-9)
    assert changes.after.min_size_um >= 4.0 > changes.before.min_size_um
    assert dropped.after.area_um2 < 0.99 * dropped.before.area_um2
    assert f"{rings.n_sites:,} -> {legal.n_sites:,} sites" in str(changes)


def test_collapsed_sites_are_violations():
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [5.0, 0.0]], [[2.0, 2.0], [2.0, 0.0004]])
    report = layout.check(fs.DesignRules(max_sites=5))

    assert not report.ok
    assert [(v.rule, v.site_ids) for v in report.violations] == [("dbu_um", (1,))]
    assert layout.check(fs.DesignRules(max_sites=5, dbu_um=1e-4)).ok
    assert layout.enforce(fs.DesignRules(min_size_um=0.01))[0].n_sites == 1


def test_sharp_corners_are_not_merged():
    """At 90 degrees all annular sites have the width 0: merging would end with one site, which has no corners."""
    rules = fs.DesignRules(min_width_um=1.0)
    with pytest.raises(
        GeometryError, match=r"drop all sites: 512 of 512 have corners sharper than angle_limit_deg = 90, .* such as 25"
    ):
        RINGS.enforce(rules)
    assert RINGS.enforce(rules, repair="merge")[0].n_sites == 0
    legal, changes = RINGS.enforce(fs.DesignRules(min_width_um=1.0, angle_limit_deg=25.0))

    assert legal.n_sites > 300
    assert changes.after.area_um2 > 0.99 * changes.before.area_um2
    assert legal.size_um.max() == RINGS.size_um.max()  # the fovea does not become one site


def test_narrow_sites_join_wide_neighbours():
    """Of 12 slivers around a square opening, 8 strips join the square behind them; the 4 angles would stay narrow."""
    layer = fs.layout.grid(n_x=1, n_y=1, pitch_um=31.0)
    squares = fs.layout.overlay(fs.layout.grid(n_x=12, n_y=12, pitch_um=10.0), layer, margin_um=3.0)
    legal, changes = squares.enforce(fs.DesignRules(min_size_um=2.5, min_width_um=2.0))

    assert (squares.n_sites, legal.n_sites) == (141, 129)
    assert changes.before.area_um2 - changes.after.area_um2 == pytest.approx(4 * (10.0**2 - 8.5**2))
    assert [len(change.site_ids) for change in changes] == [2] * 8 + [4]


def test_sharp_sites_among_others_are_dropped():
    sharp = fs.Layout.from_polygons(
        [[[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]], [[20.0, 0.0], [29.0, 0.0], [29.0, 9.0], [20.0, 9.0]]]
    )
    legal, changes = sharp.enforce(fs.DesignRules(min_width_um=1.0))

    assert legal.n_sites == 1
    assert [(change.action, change.site_ids) for change in changes] == [("dropped", (0,))]


@pytest.mark.parametrize("repair", ["best", "drop", "shrink", "merge", "refill"])
def test_collapsed_sites_are_dropped_by_all_repairs(repair):
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [5.0, 0.0]], [[2.0, 2.0], [2.0, 0.0004]])
    legal, changes = layout.enforce(fs.DesignRules(max_size_um=9.0), repair=repair)

    assert legal.n_sites == 1
    assert [(change.rule, change.action, change.site_ids) for change in changes] == [("dbu_um", "dropped", (1,))]
