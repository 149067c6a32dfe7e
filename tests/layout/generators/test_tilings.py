"""Tilings of regions, filled foveas and zones: exact tilings, minimum sizes, closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import example, given, reject, settings
from hypothesis import strategies as st
from reference.overlaps import overlaps_um2

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import fill, giotto, grid, hexagonal, log_polar, merge_small, tiling, zones

relaxed = settings(max_examples=examples(40))

NOTCHED = shapely.Polygon([(-20, -15), (25, -18), (22, 4), (3, 2), (6, 20), (-18, 17)])
HOLED = NOTCHED.difference(shapely.Point(-8, -2).buffer(5.0))
TWO_PARTS = shapely.MultiPolygon([shapely.box(-20, -5, -4, 9), shapely.box(3, -7, 15, 4)])
REGIONS = {"notched": NOTCHED, "holed": HOLED, "two parts": TWO_PARTS}


def assert_tiles(layout, region):
    """Assert that valid sites cover exactly the region: they do not overlap, have its area and no area outside."""
    polygons = layout.polygons()
    common_um2 = overlaps_um2(polygons)
    shapely.prepare(region)
    crossing = polygons[~shapely.covers(region, polygons)]

    assert bool(np.all(shapely.is_valid(polygons)))
    assert common_um2.max(initial=0.0) <= 1e-9 * layout.area_um2.min()
    assert layout.area_um2.sum() == pytest.approx(region.area, rel=1e-9)
    assert common_um2.sum() <= 1e-9 * region.area
    assert shapely.area(shapely.difference(crossing, region)).sum() <= 1e-9 * region.area


def hull_disc(layout):
    """Outer boundary of a round layout as a polygon without holes."""
    return shapely.Polygon(shapely.union_all(layout.polygons()).exterior)


def size_um(layout):
    return np.sqrt(layout.area_um2)


# -- lattices in a region --------------------------------------------------------------------------------------------


@pytest.mark.slow
@relaxed
@given(
    name=st.sampled_from(sorted(REGIONS)),
    cells=st.sampled_from(["hexagons", "squares"]),
    border=st.sampled_from(["merge", "cut"]),
    pitch_um=st.floats(1.2, 9.0),
    origin_um=st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
)
@example(name="holed", cells="hexagons", border="cut", pitch_um=2.0, origin_um=(5e-324, 0.0))
def test_tiling_fills_region(name, cells, border, pitch_um, origin_um):
    layout = tiling(pitch_um=pitch_um, cells=cells, region=REGIONS[name], border=border, origin_um=origin_um)

    assert_tiles(layout, REGIONS[name])


@settings(relaxed, max_examples=examples(24))
@given(cells=st.sampled_from(["hexagons", "squares"]), pitch_um=st.floats(1.2, 6.0), fraction=st.floats(0.3, 1.0))
@example(cells="squares", pitch_um=2.0000000596046448, fraction=1.0)
@example(cells="hexagons", pitch_um=2.999999999999999, fraction=1.0)
def test_merged_sites_satisfy_minimum_size(cells, pitch_um, fraction):
    cell_um2 = pitch_um**2 * (1.0 if cells == "squares" else 0.5 * math.sqrt(3.0))
    smallest_um = math.sqrt(fraction * cell_um2)
    layout = tiling(pitch_um=pitch_um, cells=cells, region=NOTCHED, min_size_um=smallest_um)

    # The rule has a tolerance of 1e-6 µm.
    assert size_um(layout).min() >= smallest_um - 1e-6
    # A corner of the region on the side of a cell leaves a neck that the database grid closes: another rule.
    report = layout.check(fs.DesignRules(min_size_um=smallest_um))
    assert [found for found in report.violations if found.rule == "min_size_um"] == []
    assert_tiles(layout, NOTCHED)


def test_dropping_pieces_leaves_regular_cells_inside():
    layout = tiling(pitch_um=3.0, region=NOTCHED, border="drop")

    assert bool(shapely.covers(NOTCHED, layout.polygons()).all())
    np.testing.assert_allclose(layout.area_um2, 9.0 * 0.5 * math.sqrt(3.0), rtol=1e-12)


def test_square_tiling_of_rectangle_is_grid():
    layout = tiling(pitch_um=2.0, cells="squares", size_um=(12.0, 8.0), origin_um=(1.0, 1.0))
    same = grid(n_x=6, n_y=4, pitch_um=2.0)

    assert layout.centroid_um.tolist() == same.centroid_um.tolist()
    assert all(layout.columns[name].tolist() == same.columns[name].tolist() for name in same.columns)


def test_hexagonal_tiling_agrees_with_hexagonal_layout():
    layout = tiling(pitch_um=2.0, size_um=(30.0, 30.0), border="drop")
    same = hexagonal(n_columns=40, n_rows=41, pitch_um=2.0)
    centre_um = {tuple(xy) for xy in np.round(same.centroid_um - same.centroid_um[20 * 40 + 20], 9).tolist()}

    assert {tuple(xy) for xy in np.round(layout.centroid_um, 9).tolist()} <= centre_um


def test_tiling_accepts_mosaic():
    layout = fs.layout.mosaic(
        tiling(pitch_um=2.0, cells="squares", size_um=(16.0, 16.0), origin_um=(1.0, 1.0)), ["RG", "GB"]
    )

    assert np.bincount(layout.channel).tolist() == [16, 32, 16]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"radius_um": None}, ParameterError, "'region' or 'size_um' or 'radius_um' must be given, but only one of them"),
        ({"size_um": (3, 3)}, ParameterError, "'region' or 'size_um' or 'radius_um' must be given, but only one of them"),
        ({"pitch_um": 0.0}, ParameterError, "'pitch_um' must be > 0, got 0.0 µm"),
        ({"pitch_um": 1e-4}, ParameterError, "'n_sites' must be <= 50000000"),
        ({"cells": "triangles"}, ParameterError, "'cells' must be one of 'hexagons', 'squares', got 'triangles'"),
        ({"border": "keep"}, ParameterError, "'border' must be one of 'merge', 'cut', 'drop', got 'keep'"),
        ({"origin_um": (1, 2, 3)}, ParameterError, "'origin_um' must be two numbers"),
        ({"min_size_um": -1.0}, ParameterError, "'min_size_um' must be > 0"),
        ({"radius_um": 0.5, "min_size_um": 3.0}, GeometryError, "the region is too small for a single site"),
        ({"radius_um": None, "region": "nowhere"}, ParameterError, "'region' must be a polygon as well-known text .WKT., got 'nowhere'"),
        ({"radius_um": None, "region": [(0, 0), (1, 1)]}, ParameterError, r"'region' must have the shape \(n, 2\)"),
    ],
)  # fmt: skip
def test_tiling_rejects_invalid_parameters(changes, error, message):
    with pytest.raises(error, match=message):
        tiling(**{"pitch_um": 2.0, "radius_um": 20.0, **changes})


# -- small sites and filled regions ------------------------------------------------------------------------------------


def test_small_site_joins_longest_shared_edge():
    parts = [shapely.box(0, 0, 4, 4), shapely.box(4, 0, 5, 4), shapely.box(4, 4, 9, 9), shapely.box(5, 0, 9, 4)]
    layout = fs.Layout.from_polygons(parts, channel=[0, 1, 2, 3])
    merged = merge_small(layout, min_size_um=2.5)

    assert merged.area_um2.tolist() == [20.0, 25.0, 16.0]
    assert merged.channel.tolist() == [0, 2, 3]


def test_isolated_small_site_remains():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 4, 4), shapely.box(9, 9, 10, 10)])

    assert merge_small(layout, min_size_um=2.0).n_sites == 2


def test_fill_covers_gap_with_nearest_columns():
    layout = grid(n_x=20, n_y=20, pitch_um=2.0).with_columns(channel=np.repeat([0, 1], 200))
    hole = shapely.Point(0, 0).buffer(9.0)
    remaining = fs.layout.cut_out(layout, hole, cut="drop")
    open_part = shapely.box(-20, -20, 20, 20).difference(shapely.union_all(remaining.polygons()))
    filled = fill(remaining, shapely.box(-20, -20, 20, 20), size_um=1.0)
    new = filled[remaining.n_sites :]

    assert_tiles(filled, shapely.box(-20, -20, 20, 20))
    assert_tiles(new, open_part)
    assert size_um(new).min() >= 1.0
    assert (new.channel == (new.centroid_um[:, 1] > 0)).mean() > 0.95
    assert filled.provenance["generator"] == "grid"


# -- foveas ----------------------------------------------------------------------------------------------------------


@st.composite
def filled_log_polar(draw):
    n_sectors = draw(st.integers(8, 72))
    min_size_um = draw(st.floats(0.5, 5.0))
    return {
        "n_sectors": n_sectors,
        "min_size_um": min_size_um,
        "r_max_um": min_size_um * n_sectors * draw(st.floats(0.5, 1.5)),
        "stagger": draw(st.booleans()),
        "chords_per_arc": draw(st.sampled_from([1, 2, 3, 4, 7])),
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")  # large ratios end below r_max_um
@settings(relaxed, max_examples=examples(20))
@given(parameters=filled_log_polar(), fovea=st.sampled_from(["rings", "linear", "hexagons"]))
def test_filled_fovea_tiles_with_minimum_size(parameters, fovea):
    layout = log_polar(**parameters, fovea=fovea)
    around = log_polar(**parameters)
    fovea_sites = layout[: layout.n_sites - around.n_sites]
    disc = hull_disc(layout)

    assert_tiles(layout, disc)
    assert around.n_sites < layout.n_sites
    assert size_um(fovea_sites).min() >= parameters["min_size_um"]
    assert layout.area_um2[fovea_sites.n_sites :].sum() + fovea_sites.area_um2.sum() == pytest.approx(
        disc.area, rel=1e-9
    )
    assert "blind_radius_um" not in layout.provenance


@pytest.mark.parametrize("fovea", ["rings", "linear"])
def test_number_of_fovea_rings_follows_ratio(fovea):
    layout = log_polar(n_sectors=60, r_min_um=20.0, r_max_um=80.0, ring_ratio=1.1, fovea=fovea)
    radius_um = np.hypot(*layout.xy_um.T)
    site = np.repeat(np.arange(layout.n_sites), np.diff(layout.ring_offsets))
    ring = layout.columns["ring"]
    edges_um = np.array([radius_um[ring[site] == k].max() for k in range(ring.max() + 1)])
    heights_um = np.diff(edges_um)

    # λ / (λ - 1) = 11 rings of equal height, ring 0 with half of it: the outer radius is 10.5 heights.
    assert edges_um[10] == pytest.approx(20.0, rel=1e-12)
    np.testing.assert_allclose(heights_um[:10], 20.0 / 10.5, rtol=1e-12)
    assert heights_um[10] == pytest.approx(2.0, rel=1e-12)


def test_log_polar_fovea_has_6_rho_sites():
    layout = log_polar(n_sectors=60, min_size_um=2.0, r_max_um=60.0, fovea="rings")
    n_sites = np.bincount(layout.columns["ring"])
    n_fovea = int(np.flatnonzero(n_sites == 60)[0])

    assert n_sites[:n_fovea].tolist() == [1, *(6 * rho for rho in range(1, n_fovea))]
    assert set(n_sites[n_fovea:].tolist()) == {60}


def test_linear_polar_fovea_uses_outer_sectors():
    layout = log_polar(n_sectors=48, min_size_um=2.0, r_max_um=54.0, fovea="linear")
    n_sites = np.bincount(layout.columns["ring"])

    assert all(48 % n == 0 for n in n_sites)
    assert np.all(np.diff(n_sites) >= 0)
    inside = layout.columns["ring"] < np.flatnonzero(n_sites == 48)[0]
    assert inside.any()
    assert np.all(layout.readout_line[inside] % (48 // n_sites[layout.columns["ring"][inside]]) == 0)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("fovea", "chords_per_arc"),
    [("rings", 1), ("rings", 4), ("linear", 2), ("linear", 7), ("hexagons", 1), ("hexagons", 2), ("hexagons", 3)],
)
def test_giotto_1_fills_disc_with_fovea(fovea, chords_per_arc):
    layout = giotto(
        n_rho=76, n_theta=128, n_fovea=20, n_across=600, unit_um=1.0, fovea=fovea, chords_per_arc=chords_per_arc
    )

    assert layout.area_um2.sum() == pytest.approx(hull_disc(layout).area, rel=1e-9)
    assert (layout.columns["ring"] >= 20).sum() == 56 * 128
    if fovea == "hexagons":
        assert size_um(layout[layout.columns["ring"] < 20]).min() >= 1.0


def test_inner_fovea_hexagons_have_minimum_size():
    layout = log_polar(n_sectors=90, min_size_um=2.0, r_max_um=90.0, fovea="hexagons")
    fovea = layout[layout.columns["ring"] == 0]
    is_inside = np.hypot(*fovea.centroid_um.T) < 0.8 * np.hypot(*fovea.centroid_um.T).max()

    np.testing.assert_allclose(fovea.area_um2[is_inside], 4.0, rtol=1e-6)
    assert is_inside.sum() > 100


def test_fovea_too_small_for_hexagon_raises():
    with pytest.raises(ParameterError, match="'fovea' must fit a hexagon of 5 µm inside the first ring"):
        log_polar(n_sectors=4, r_min_um=2.0, r_max_um=19.0, min_size_um=5.0, ring_ratio=9.0, fovea="hexagons")


# -- grids -----------------------------------------------------------------------------------------------------------


@relaxed
@given(
    n_x=st.integers(1, 6),
    n_y=st.integers(1, 6),
    pitch_um=st.floats(0.5, 9.0),
    pitch_y_um=st.floats(0.5, 9.0),
    stagger=st.booleans(),
)
def test_staggered_rectangles_tile_their_rows(n_x, n_y, pitch_um, pitch_y_um, stagger):
    layout = grid(n_x=n_x, n_y=n_y, pitch_um=pitch_um, pitch_y_um=pitch_y_um, stagger=stagger)
    rows = [shapely.box(*layout[layout.columns["row"] == row].bounds_um) for row in range(n_y)]

    assert_tiles(layout, shapely.union_all(rows))
    low, high = np.reshape(layout.bounds_um, (2, 2))
    np.testing.assert_allclose(low, -high, atol=1e-9)
    assert high[0] - low[0] == pytest.approx(pitch_um * (n_x + 0.5 * (stagger and n_y > 1)))


def test_stagger_shifts_every_second_row():
    layout = grid(n_x=3, n_y=4, pitch_um=2.0, stagger=True)
    first_um = layout.centroid_um[layout.columns["column"] == 0, 0]

    assert first_um.tolist() == [-2.5, -1.5, -2.5, -1.5]


@pytest.mark.parametrize(("pitch_um", "fill"), [(1.0, 0.81), (0.7, 0.734694)])
def test_trench_gives_published_fill_factor(pitch_um, fill):
    layout = grid(n_x=5, n_y=4, pitch_um=pitch_um, trench_um=0.1)
    same = grid(n_x=5, n_y=4, pitch_um=pitch_um, fill_factor=fill)

    assert layout.area_um2 / pitch_um**2 == pytest.approx(fill, abs=1e-6)
    np.testing.assert_allclose(layout.xy_um, same.xy_um, atol=1e-6)
    distance_um = shapely.distance(*layout.polygons()[:2])
    assert distance_um == pytest.approx(0.1, rel=1e-9)


def test_trench_width_is_equal_along_both_pitches():
    layout = grid(n_x=2, n_y=2, pitch_um=2.0, pitch_y_um=5.0, trench_um=0.5)

    assert layout.area_um2 == pytest.approx(1.5 * 4.5)
    assert shapely.distance(layout.polygons()[0], layout.polygons()[2]) == pytest.approx(0.5)


@pytest.mark.parametrize("orientation", ["pointy", "flat"])
def test_hexagon_trench_is_distance_of_sides(orientation):
    layout = hexagonal(n_columns=2, n_rows=1, pitch_um=75.0, trench_um=5.0, orientation=orientation)

    assert shapely.distance(*layout.polygons()) == pytest.approx(5.0)
    assert layout.area_um2 / (75.0**2 * 0.5 * math.sqrt(3.0)) == pytest.approx(0.8711, abs=1e-4)
    same = hexagonal(n_columns=2, n_rows=1, pitch_um=75.0, fill_factor=(70 / 75) ** 2, orientation=orientation)
    np.testing.assert_allclose(layout.xy_um, same.xy_um, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"width_um": 1.0, "trench_um": 0.1},
            "'width_um' and 'trench_um' and 'fill_factor' exclude each other; give one",
        ),
        ({"trench_um": 2.0}, "'trench_um' must be < 2, the pitch, got 2.0 µm"),
        ({"trench_um": -0.1}, "'trench_um' must be >= 0"),
        ({"fill_factor": 1.1}, "'fill_factor' must be <= 1"),
        ({"fill_factor": 0.0}, "'fill_factor' must be > 0"),
        ({"pitch_y_um": 3.0, "width_um": 1.0}, "'width_um' must be replaced by 'trench_um' if 'pitch_y_um' is given"),
    ],
)
def test_grid_rejects_invalid_trenches(changes, message):
    with pytest.raises(ParameterError, match=message):
        grid(n_x=2, n_y=2, pitch_um=2.0, **changes)


# -- zones -----------------------------------------------------------------------------------------------------------

OUTLINES = [
    shapely.Point(1, 0).buffer(8.0, quad_segs=5),
    shapely.box(-15, -12, 14, 13),
    shapely.Polygon([(-40, -30), (40, -30), (45, 25), (0, 40), (-42, 20)]),
]


@pytest.mark.slow
@settings(relaxed, max_examples=examples(15))
@given(
    pitches_um=st.tuples(st.floats(0.8, 2.0), st.floats(1.5, 4.0), st.floats(3.0, 8.0)),
    cells=st.tuples(*[st.sampled_from(["hexagons", "squares"])] * 3),
)
@example(pitches_um=(1.999999970430508, 3.875, 3.0), cells=("hexagons",) * 3)  # GEOS 3.14 finds an overlap
def test_zones_of_outlines_tile_outermost(pitches_um, cells):
    layout = zones(outlines_um=OUTLINES, pitch_um=pitches_um, cells=cells)

    assert_tiles(layout, OUTLINES[-1])
    try:
        snapped = fs.layout.snap(layout, 0.001)
    except GeometryError:  # a corner of less than 1 nm crosses itself
        reject()
    assert snapped.check(fs.DesignRules(max_overlap_um2=0.0)).ok
    for zone, inner in enumerate([shapely.Polygon(), *OUTLINES[:-1]]):
        ring_um2 = OUTLINES[zone].area - inner.area
        assert layout.area_um2[layout.columns["zone"] == zone].sum() == pytest.approx(ring_um2, rel=1e-9)


def test_hexagons_fill_zone_of_any_side():
    layout = zones(side_um=(10.0, 33.3), pitch_um=(1.0, 3.0), cells=("squares", "hexagons"))

    assert_tiles(layout, shapely.box(-16.65, -16.65, 16.65, 16.65))
    np.testing.assert_allclose(layout.area_um2[layout.columns["zone"] == 0], 1.0, rtol=1e-9)


def test_zone_lines_are_numbered_consecutively():
    layout = zones(outlines_um=OUTLINES, pitch_um=(1.0, 2.0, 4.0))
    ends = [
        (layout.readout_line[layout.columns["zone"] == k].min(), layout.readout_line[layout.columns["zone"] == k].max())
        for k in range(3)
    ]

    assert ends[0][0] == 0
    assert ends[1][0] == ends[0][1] + 1
    assert ends[2][0] == ends[1][1] + 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"side_um": (1, 2, 3)}, "'side_um' or 'outlines_um' must be given, but only one of them"),
        ({"outlines_um": OUTLINES[:2]}, "'outlines_um' and 'pitch_um' must have the same length of at least 1, got 2"),
        ({"outlines_um": OUTLINES[::-1]}, r"'outlines_um\[1\]' must lie around 'outlines_um\[0\]' and be larger"),
        ({"cells": "triangles"}, "'cells' must be one of 'hexagons', 'squares'"),
        ({"cells": ("squares", "squares")}, "'cells' must be one shape, or one for each of the 3 zones, got 2"),
        ({"cells": ("squares", "squares", "x")}, r"'cells\[2\]' must be one of 'hexagons', 'squares'"),
    ],
)
def test_zones_reject_invalid_outlines_or_cells(changes, message):
    with pytest.raises(ParameterError, match=message):
        zones(**{"outlines_um": OUTLINES, "pitch_um": (1.0, 2.0, 4.0), **changes})
