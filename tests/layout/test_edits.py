"""Edits of layouts: preserved areas and columns, no gaps and no overlaps."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import clip, cut_out, inset, merge, node, snap, split, union

GRID = fs.layout.grid(n_x=10, n_y=8, pitch_um=2.0)
RINGS = fs.layout.log_polar(n_sectors=24, r_min_um=4.0, r_max_um=33.0, stagger=True, chords_per_arc=2)
ZONES = fs.layout.zones(side_um=(4, 12, 28), pitch_um=(1, 2, 4))
TILINGS = {"grid": GRID, "rings": RINGS, "zones": ZONES}
DISC = shapely.Point(1.3, 0.7).buffer(6.1)


def overlap_um2(layout):
    return layout.area_um2.sum() - shapely.union_all(layout.polygons()).area


@pytest.mark.parametrize("name", TILINGS)
def test_clip_and_cut_out_are_complementary(name):
    layout = TILINGS[name]
    inside, outside = clip(layout, DISC), cut_out(layout, DISC)

    assert inside.area_um2.sum() + outside.area_um2.sum() == pytest.approx(layout.area_um2.sum(), rel=1e-12)
    assert inside.area_um2.sum() == pytest.approx(
        shapely.union_all(layout.polygons()).intersection(DISC).area, rel=1e-12
    )
    assert overlap_um2(inside) == pytest.approx(0.0, abs=1e-9)


def test_dropping_cut_sites_preserves_complete_ones():
    clipped = clip(GRID, DISC, cut="drop")
    is_inside = shapely.covers(DISC, GRID.polygons())

    assert 0 < is_inside.sum() < GRID.n_sites
    assert np.array_equal(clipped.xy_um, GRID[is_inside].xy_um)
    assert cut_out(GRID, DISC, cut="drop").n_sites == shapely.disjoint(DISC, GRID.polygons()).sum()


def test_pieces_inherit_columns_of_site():
    bar = fs.Layout.from_rectangles([[0.0, 0.0], [0.0, 10.0]], [[20.0, 2.0], [20.0, 2.0]], channel=[1, 2])
    pieces = cut_out(bar, shapely.box(-1, -20, 1, 20))

    assert pieces.n_sites == 4
    assert pieces.channel.tolist() == [1, 1, 2, 2]
    assert pieces.area_um2 == pytest.approx(18.0)


@pytest.mark.parametrize("margin_um", [0.05, 0.2])
def test_inset_has_fill_factor_of_trench(margin_um):
    fill = inset(GRID, margin_um).area_um2 / GRID.area_um2

    assert fill == pytest.approx((1 - margin_um) ** 2)  # (1 - t/p)² with t = 2 margins and p = 2 µm


def test_inset_offsets_boundaries_by_site_margins():
    margins_um = np.linspace(0.1, 0.3, RINGS.n_sites)
    shrunk = inset(RINGS, margins_um)
    away_um = shapely.distance(shrunk.polygons(), shapely.boundary(RINGS.polygons()))

    assert away_um == pytest.approx(margins_um, abs=1e-9)


def test_inset_lists_sites_narrower_than_margin():
    with pytest.raises(GeometryError, match=r"site 0 would vanish or split into parts \(and 15 more\)") as caught:
        inset(ZONES, 0.6)
    assert caught.value.site_ids == tuple(np.flatnonzero(ZONES.columns["zone"] == 0))


def test_binning_doubles_the_pitch():
    groups = GRID.columns["row"] // 2 * 5 + GRID.columns["column"] // 2
    binned = merge(GRID, groups)

    assert binned.n_sites == 20
    assert binned.area_um2 == pytest.approx(16.0)
    assert binned.columns["column"].tolist() == [0, 2, 4, 6, 8] * 4
    assert overlap_um2(binned) == pytest.approx(0.0, abs=1e-12)


def test_merging_all_sites_gives_outline():
    ring = merge(RINGS, np.zeros(RINGS.n_sites, int))

    assert ring.n_sites == 1
    assert ring.area_um2[0] == pytest.approx(RINGS.area_um2.sum(), rel=1e-12)
    assert np.diff(ring.site_offsets)[0] == 2  # the outline and the blind spot


def test_merging_almost_touching_sites_keeps_all():
    """Three sites whose corners are 1e-5 µm apart: GEOS 3.14 omits one of them from their union."""
    corners_um = [
        [(-6.758490333564913, 19.748722176826735), (-29.748722176826735, 19.748722176826735),
         (-29.748722176826735, -19.748722176826735), (-6.722685417952121, -19.748722176826735),
         (0.1012090988071385, -0.0139799906228933)],
        [(0.101201867852465, -0.0140009025853924), (-6.7447407214700625, -19.812506241439117),
         (29.812506241439117, -19.812506241439117), (29.812506241439117, 0.0333580044926785)],
        [(29.81255548136612, 0.0333580829796105), (29.81255548136612, 19.81255548136612),
         (-6.780647085167256, 19.81255548136612), (0.1012163494064031, -0.0140008795022399)],
    ]  # fmt: skip
    layout = fs.Layout.from_polygons([shapely.Polygon(corners) for corners in corners_um])

    assert fs.layout.merge(layout, [0, 0, 0]).area_um2 == pytest.approx(layout.area_um2.sum(), abs=1e-3)


def test_merging_disconnected_sites_raises():
    with pytest.raises(GeometryError, match="site 0 must be connected to the other sites") as caught:
        merge(GRID, np.where(np.isin(np.arange(80), (0, 79)), 1, 2 + np.arange(80)))
    assert caught.value.site_ids == (0, 79)


@pytest.mark.parametrize(("n_x", "n_y"), [(2, 1), (1, 2), (2, 2), (3, 2)])
@pytest.mark.parametrize("name", TILINGS)
def test_split_parts_sum_to_sites(name, n_x, n_y):
    layout = TILINGS[name]
    parts = split(layout, n_x=n_x, n_y=n_y)
    sums = np.bincount(parts.columns["parent"], parts.area_um2, layout.n_sites)

    assert sums == pytest.approx(layout.area_um2, rel=1e-12)
    assert overlap_um2(parts) == pytest.approx(0.0, abs=1e-9)


def test_dual_pixels_are_left_and_right_halves():
    halves = split(GRID, n_x=2)

    assert halves.n_sites == 160
    assert halves.area_um2 == pytest.approx(2.0)
    assert halves.columns["part"].tolist() == [0, 1] * 80
    assert np.all(halves.centroid_um[0::2, 0] < halves.centroid_um[1::2, 0])


@pytest.mark.parametrize("angle_deg", [0.0, 17.3])
def test_noding_t_junctions_gives_valid_coverage(angle_deg):
    rotated = node(ZONES).rotate(angle_deg)

    assert not shapely.coverage_is_valid(ZONES.polygons())
    assert shapely.coverage_is_valid(rotated.polygons())
    assert rotated.area_um2 == pytest.approx(ZONES.area_um2, rel=1e-12)


@settings(max_examples=examples(25))
@given(angle_deg=st.floats(0, 90), grid_um=st.sampled_from([0.001, 0.005, 0.02]), name=st.sampled_from(sorted(TILINGS)))
def test_snapping_creates_no_gaps_or_overlaps(angle_deg, grid_um, name):
    layout = node(TILINGS[name]).rotate(angle_deg).translate(0.3, 0.7)
    snapped = snap(layout, grid_um)
    steps = snapped.xy_um / grid_um

    assert np.abs(steps - np.round(steps)).max() < 1e-6
    assert shapely.coverage_is_valid(snapped.polygons())
    assert abs(overlap_um2(snapped)) < 1e-9
    assert snapped.n_sites == layout.n_sites


def test_snapping_reports_site_below_grid():
    with pytest.raises(GeometryError, match="site 0 "):
        snap(fs.Layout.from_rectangles([[0.3, 0.3], [10.0, 10.0]], [0.1, 4.0]), 1.0)


def test_union_has_all_sites_and_common_columns():
    fovea = clip(fs.layout.hexagonal(n_columns=9, n_rows=9, pitch_um=0.9), shapely.Point(0, 0).buffer(3.5))
    joined = union(
        [RINGS.with_columns(extra=np.zeros(RINGS.n_sites)), fovea.with_columns(channel=np.ones(fovea.n_sites, int))]
    )

    assert joined.n_sites == RINGS.n_sites + fovea.n_sites
    assert joined.area_um2.sum() == pytest.approx(RINGS.area_um2.sum() + fovea.area_um2.sum(), rel=1e-12)
    assert sorted(joined.columns) == ["readout_line"]
    assert joined.check(fs.DesignRules(max_overlap_um2=0.0)).ok


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: union([]), "'layouts' must be one or more layouts"),
        (lambda: union([GRID, 3]), r"'layouts(\[1\])?' must be (one or more layouts|a Layout)"),
        (lambda: clip(GRID, (0, 0, 1, 1)), "'region' must have 2 dimensions, got the shape"),
        (lambda: clip(GRID, shapely.Point(0, 0)), "'region' must be a shapely Polygon or MultiPolygon, got a Point"),
        (lambda: clip(GRID, shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)])), "'region' must be a valid"),
        (lambda: clip(GRID, DISC, cut="shrink"), "'cut' must be one of 'pieces', 'drop'"),
        (lambda: inset(GRID, -0.1), "'margin_um' must be >= 0"),
        (lambda: inset(GRID, [0.1, 0.2]), "'margin_um' must be one number, or one for each of the 80 sites"),
        (lambda: merge(GRID, [1, 2]), "'groups' must be 80 integers >= 0"),
        (lambda: merge(GRID, np.full(80, -1)), "'groups' must be 80 integers >= 0"),
        (lambda: split(GRID, n_x=0), "'n_x' must be >= 1"),
        (lambda: snap(GRID, 0.0), "'grid_um' must be > 0"),
    ],
)
def test_invalid_argument_raises_with_name(call, message):
    with pytest.raises(ParameterError, match=message):
        call()


@pytest.mark.parametrize("min_size_um", [1.5, 2.0, 6.0])
def test_merge_small_closes_gaps_of_rounding(min_size_um):
    layout = fs.layout.log_polar(n_sectors=36, min_size_um=1.0, r_max_um=18.0, fovea="hexagons")
    merged = fs.layout.merge_small(layout, min_size_um=min_size_um)

    assert merged.area_um2.min() >= min_size_um**2 * (1.0 - 1e-9)
    assert merged.area_um2.sum() == pytest.approx(layout.area_um2.sum(), abs=1e-4)
    assert shapely.area(shapely.make_valid(merged.polygons())).sum() == pytest.approx(layout.area_um2.sum(), abs=1e-4)


def test_merge_small_joins_slivers_across_cut():
    """Both sides of a cut are computed separately, so their boundaries agree only within rounding."""
    disc = shapely.Point(0.0, 0.0).buffer(50.0)
    hexagons = fs.layout.hexagonal(n_columns=40, n_rows=40, pitch_um=3.0)
    zones = fs.layout.zones(pitch_um=(2.0, 4.0, 8.0), side_um=(48.0, 144.0, 288.0))
    both = fs.layout.union([fs.layout.clip(hexagons, disc), fs.layout.cut_out(zones, disc)])

    merged = fs.layout.merge_small(both, min_size_um=1.0)

    assert both.area_um2.min() < 0.1
    assert merged.area_um2.min() >= 1.0
    assert merged.area_um2.sum() == pytest.approx(both.area_um2.sum(), abs=1e-3)
    assert merged.n_sites > 0.9 * both.n_sites
