"""Design rules: planted violations are found with their sites and values, and clean layouts pass."""

from __future__ import annotations

import io
import math
import pickle
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rich.console import Console
from shapely import affinity

from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import DesignRules, Layout, grid, hexagonal, log_polar, zones
from foveasim.layout.drc.rules import min_width_um

relaxed = settings(max_examples=examples(40))

#: All rules of this file; a layout of 25 unit squares around the origin satisfies them.
ALL_RULES = DesignRules(
    min_size_um=0.9, min_width_um=0.2, max_overlap_um2=0.0, max_gap_um2=0.0, die_um=(-2.5, -2.5, 2.5, 2.5)
)
RULE_NAMES = ("min_size_um", "min_width_um", "max_overlap_um2", "max_gap_um2", "die_um")


def squares():
    """Return 25 unit squares that tile the die: site 12 is the centre, 13 to its right, 24 at the upper right."""
    return list(grid(n_x=5, n_y=5, pitch_um=1.0).polygons())


def replaced(changes, dropped=()):
    """Return the 25 squares, some replaced and others dropped."""
    shapes = [changes.get(i, square) for i, square in enumerate(squares()) if i not in dropped]
    return Layout.from_polygons(shapes)


def box_at(left_um, low_um, width_um, height_um):
    return shapely.box(left_um, low_um, left_um + width_um, low_um + height_um)


def found(layout, rules=ALL_RULES):
    """Return all violations as (rule, sites, value)."""
    return [(v.rule, v.site_ids, pytest.approx(v.value, rel=1e-9)) for v in layout.check(rules).violations]


def regular(n_corners, radius_um=1.0, turn_rad=0.0):
    angle = 2 * np.pi * np.arange(n_corners) / n_corners + turn_rad
    return shapely.Polygon(radius_um * np.stack((np.cos(angle), np.sin(angle)), axis=1))


# -- planted violations ----------------------------------------------------------------------------------------------

ARM = box_at(0.5, -0.02, 0.4, 0.05)

PLANTED = {
    "small site": (
        # A quarter of the centre square belongs to its neighbour: the size sqrt(0.75) is too small, the width 0.75 is not.
        replaced({12: box_at(-0.5, -0.5, 0.75, 1), 13: box_at(0.25, -0.5, 1.25, 1)}),
        ("min_size_um", (12,), math.sqrt(0.75)),
    ),
    "thin arm": (
        replaced({12: squares()[12].union(ARM), 13: squares()[13].difference(ARM)}),
        ("min_width_um", (12,), 0.05),
    ),
    "overlap": (
        replaced({12: box_at(-0.5, -0.5, 1.25, 1)}),
        ("max_overlap_um2", (12, 13), 0.25),
    ),
    "site missing in the centre": (
        replaced({}, dropped=(12,)),
        ("max_gap_um2", (6, 7, 8, 11, 12, 15, 16, 17), 1.0),
    ),
    "site missing in the corner": (
        replaced({}, dropped=(24,)),
        ("max_gap_um2", (18, 19, 23), 1.0),
    ),
    "hole in a site": (
        replaced({12: squares()[12].difference(box_at(-0.1, -0.1, 0.2, 0.2))}),
        ("max_gap_um2", (12,), 0.04),
    ),
    "site outside the die": (
        Layout.from_polygons([*squares(), box_at(2.5, 0.5, 0.95, 1)]),
        ("die_um", (25,), 0.95),
    ),
    "site across the edge of the die": (
        replaced({24: box_at(1.5, 1.5, 1, 1.125)}),
        ("die_um", (24,), 0.125),
    ),
}


def test_unit_squares_satisfy_every_rule():
    report = replaced({}).check(ALL_RULES)

    assert report.ok
    assert report.violations == ()
    assert [result.rule for result in report.results] == list(RULE_NAMES)


@pytest.mark.parametrize(("layout", "violation"), PLANTED.values(), ids=PLANTED)
def test_planted_violation_found_alone_with_value(layout, violation):
    assert found(layout) == [violation]
    assert not layout.check(ALL_RULES).ok


@pytest.mark.parametrize(("layout", "violation"), PLANTED.values(), ids=PLANTED)
def test_disabled_rule_reports_no_violations(layout, violation):
    assert found(layout, replace(ALL_RULES, **{violation[0]: None})) == []


@pytest.mark.parametrize(("layout", "violation"), PLANTED.values(), ids=PLANTED)
def test_violation_contains_limit_unit_and_marker(layout, violation):
    (v,) = layout.check(ALL_RULES).violations
    rule, sites, value = violation
    polygons = layout.polygons()

    assert v.limit == (0.0 if rule == "die_um" else getattr(ALL_RULES, rule))
    assert v.unit == ("µm²" if rule.endswith("um2") else "µm")
    if rule.endswith("um2"):
        assert v.marker.area == pytest.approx(value, rel=1e-9)
        assert all(v.marker.intersects(polygons[site]) for site in sites)
    else:
        assert v.marker.equals_exact(polygons[sites[0]], 1e-9)


# -- min_size --------------------------------------------------------------------------------------------------------


def test_small_sites_sorted_worst_first():
    layout = Layout.from_rectangles([[0, 0], [10, 0], [20, 0], [30, 0]], [1.0, 3.0, 0.5, 2.0])

    assert found(layout, DesignRules(min_size_um=2.5)) == [
        ("min_size_um", (2,), 0.5),
        ("min_size_um", (0,), 1.0),
        ("min_size_um", (3,), 2.0),
    ]


@pytest.mark.parametrize(
    ("width_um", "height_um", "limit_um", "ok"),
    [(2.0, 2.0, 2.0, True), (1.0, 4.0, 2.0, True), (1.0, 4.0, 2.001, False), (2.0, 2.0, 2.0 + 1e-8, True)],
)
def test_site_at_minimum_size_passes(width_um, height_um, limit_um, ok):
    layout = Layout.from_rectangles([[0, 0]], [[width_um, height_um]])

    assert layout.check(DesignRules(min_size_um=limit_um)).ok is ok


def test_site_size_excludes_holes():
    layout = Layout.from_polygons([box_at(0, 0, 5, 5).difference(box_at(1, 1, 3, 3))])

    assert found(layout, DesignRules(min_size_um=4.5)) == [("min_size_um", (0,), 4.0)]


# -- min_width -------------------------------------------------------------------------------------------------------

WIDTHS = {
    "square": (box_at(0, 0, 3, 3), 3.0),
    "bar": (box_at(0, 0, 30, 0.5), 0.5),
    "equilateral triangle": (regular(3), 0.0),
    "right triangle": (shapely.Polygon([(0, 0), (3, 0), (0, 4)]), 0.0),
    "needle": (shapely.Polygon([(0, 0), (100, 0), (0, 1)]), 0.0),
    # The edges on both sides of a third one enclose 36 and 60 degrees: the width is the length of the third one.
    "pentagon": (regular(5), 2 * math.sin(math.pi / 5)),
    "hexagon": (regular(6), 1.0),
    # Those on both sides of two edges enclose 45 degrees.
    "octagon": (regular(8), math.sqrt(2)),
    "rhombus": (shapely.Polygon([(0, 0), (2, 0), (3, math.sqrt(3)), (1, math.sqrt(3))]), 0.0),
    "flat rhombus": (shapely.Polygon([(-5, 0), (0, -1), (5, 0), (0, 1)]), 0.0),
    "parallelogram": (shapely.Polygon([(0, 0), (10, 0), (30, 1), (20, 1)]), 0.0),
    "L": (shapely.Polygon([(0, 0), (5, 0), (5, 0.3), (1, 0.3), (1, 5), (0, 5)]), 0.3),
    "U": (shapely.Polygon([(0, 0), (6, 0), (6, 5), (5.6, 5), (5.6, 2), (2, 2), (2, 5), (0, 5)]), 0.4),
    "U with a thin foot": (shapely.Polygon([(0, 0), (6, 0), (6, 5), (4, 5), (4, 0.1), (2, 0.1), (2, 5), (0, 5)]), 0.1),
    "U with a foot tapering to the left": (
        shapely.Polygon([(0, 0), (6, 0), (6, 5), (4, 5), (4, 0.3), (2, 0.1), (2, 5), (0, 5)]),
        0.1,
    ),
    "U with a foot tapering to the right": (
        shapely.Polygon([(0, 0), (6, 0), (6, 5), (4, 5), (4, 0.1), (2, 0.3), (2, 5), (0, 5)]),
        0.1,
    ),
    "U with a narrow slot": (
        shapely.Polygon([(0, 0), (6, 0), (6, 5), (3.1, 5), (3.1, 2), (2.9, 2), (2.9, 5), (0, 5)]),
        2.0,
    ),
    "T": (shapely.Polygon([(0, 4), (0, 3), (2, 3), (2, 0), (2.7, 0), (2.7, 3), (6, 3), (6, 4)]), 0.7),
    "cross": (box_at(0, 2, 5, 0.9).union(box_at(2, 0, 0.6, 5)), 0.6),
    "hourglass": (
        shapely.Polygon([(0, 0), (4, 0), (4, 1), (2.2, 2), (4, 3), (4, 4), (0, 4), (0, 3), (1.8, 2), (0, 1)]),
        0.4,
    ),
    "frame": (box_at(0, 0, 10, 10).difference(box_at(1, 2, 8, 5)), 1.0),
    "frame with a thin wall": (box_at(0, 0, 10, 10).difference(box_at(1, 2, 8.75, 5)), 0.25),
    "wall between two holes": (
        box_at(0, 0, 10, 10).difference(box_at(2, 2, 2.9, 6)).difference(box_at(5, 2, 3, 6)),
        0.1,
    ),
    "notch down to a neck": (
        shapely.Polygon([(0, 0), (10, 0), (10, 10), (5.5, 10), (5, 0.1), (4.5, 10), (0, 10)]),
        0.1,
    ),
    "square with vertices on its sides": (
        shapely.Polygon([(0, 0), (1, 0), (2, 0), (3, 0), (3, 1.5), (3, 3), (0.2, 3), (0.1, 3), (0, 3), (0, 2)]),
        3.0,
    ),
}


@pytest.mark.parametrize(("shape", "width_um"), WIDTHS.values(), ids=WIDTHS)
def test_width_matches_known_shapes(shape, width_um):
    assert min_width_um(Layout.from_polygons([shape]))[0] == pytest.approx(width_um, abs=2e-3)


def test_width_ignores_coincident_vertices():
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 1e-14), (4.0, 3.0), (0.0, 3.0)]
    shifted = Layout.from_polygons([shapely.Polygon(corners)]).translate(1000.0, 1000.0)

    assert np.array_equal(shifted.xy_um[1], shifted.xy_um[2])
    assert min_width_um(shifted)[0] == pytest.approx(3.0)


@pytest.mark.slow(keep=8)
@pytest.mark.parametrize("shape", [shape for shape, _ in WIDTHS.values()], ids=WIDTHS)
@given(angle_deg=st.floats(0, 360), factor=st.floats(0.1, 10), shift_um=st.integers(-1000, 1000))
@settings(relaxed, max_examples=examples(15))
def test_width_follows_rotation_and_scale(shape, angle_deg, factor, shift_um):
    layout = Layout.from_polygons([shape])
    moved = layout.rotate(angle_deg).scale(factor).translate(shift_um, -shift_um)

    options = {"angle_limit_deg": 80.0, "dbu_um": 1e-6}  # right angles may be smaller on the grid

    assert min_width_um(moved, **options)[0] == pytest.approx(factor * min_width_um(layout, **options)[0], abs=1e-5)


@pytest.mark.filterwarnings(
    "ignore::foveasim.errors.LayoutWarning"
)  # with coarse ratios, the last ring lies inside r_max_um
@given(st.integers(3, 16), st.floats(1.05, 2.0), st.integers(1, 4), st.booleans())
@example(n_sectors=8, ring_ratio=2.0, chords_per_arc=1, stagger=False)
@relaxed
def test_width_is_equal_within_ring(n_sectors, ring_ratio, chords_per_arc, stagger):
    layout = log_polar(
        n_sectors=n_sectors,
        r_min_um=10.0,
        r_max_um=40.0,
        ring_ratio=ring_ratio,
        chords_per_arc=chords_per_arc,
        stagger=stagger,
    )
    width_um = min_width_um(layout, angle_limit_deg=57.0, dbu_um=1e-6).reshape(-1, n_sectors)

    np.testing.assert_allclose(width_um, np.broadcast_to(width_um[:, :1], width_um.shape), atol=1e-5)


@given(st.floats(0.1, 50.0), st.floats(0.1, 50.0), st.floats(-180, 180))
@relaxed
def test_rectangle_width_is_shorter_side(width_um, height_um, angle_deg):
    layout = Layout.from_rectangles([[0, 0]], [[width_um, height_um]]).rotate(angle_deg)

    options = {"angle_limit_deg": 80.0, "dbu_um": 1e-6}

    assert min_width_um(layout, **options)[0] == pytest.approx(min(width_um, height_um), abs=1e-5)


@pytest.mark.parametrize("n_corners", [32, 64, 257])
def test_disc_width_approximates_diameter(n_corners):
    disc = Layout.from_polygons([regular(n_corners, 3.0)])

    assert min_width_um(disc, angle_limit_deg=20.0)[0] == pytest.approx(6.0, rel=0.05)
    # Edges that enclose up to 90 degrees face each other: the diameter times the sine of 45 degrees.
    assert min_width_um(disc)[0] == pytest.approx(6.0 * math.sqrt(0.5), rel=0.05)


@pytest.mark.parametrize("orientation", ["pointy", "flat"])
def test_hexagon_width_is_distance_across_flats(orientation):
    layout = hexagonal(n_columns=3, n_rows=4, pitch_um=100.0, width_um=85.0, orientation=orientation)

    np.testing.assert_allclose(min_width_um(layout, angle_limit_deg=40.0), 85.0, atol=1e-3)
    np.testing.assert_allclose(min_width_um(layout), 85.0 / math.sqrt(3.0), atol=1e-3)
    assert layout.check(DesignRules(min_width_um=84.99, angle_limit_deg=40.0)).ok
    assert len(layout.check(DesignRules(min_width_um=85.01, angle_limit_deg=40.0)).violations) == 12


def test_width_is_independent_of_other_sites():
    shapes = [affinity.translate(shape, 200.0 * k, 0.0) for k, (shape, _) in enumerate(WIDTHS.values())]
    together = min_width_um(Layout.from_polygons(shapes))

    assert together.tolist() == pytest.approx(
        [min_width_um(Layout.from_polygons([shape]))[0] for shape in shapes], rel=1e-12
    )


# -- overlap ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        pytest.param([box_at(0, 0, 2, 2), box_at(2, 0, 2, 2)], [], id="common edge"),
        pytest.param([box_at(0, 0, 2, 2), box_at(2, 2, 2, 2)], [], id="common corner"),
        pytest.param([box_at(0, 0, 2, 2), box_at(5, 0, 2, 2)], [], id="apart"),
        pytest.param([box_at(0, 0, 2, 2), box_at(0, 0, 2, 2)], [((0, 1), 4.0)], id="same site twice"),
        pytest.param([box_at(0, 0, 4, 4), box_at(1, 1, 1, 1)], [((0, 1), 1.0)], id="one in the other"),
        pytest.param([box_at(0, 0, 4, 4).difference(box_at(1, 1, 1, 1)), box_at(1, 1, 1, 1)], [], id="one in a hole"),
        pytest.param([box_at(0, 1, 3, 1), box_at(1, 0, 1, 3)], [((0, 1), 1.0)], id="crossed bars"),
        pytest.param(
            [box_at(0, 0, 2, 2), box_at(1, 0, 2, 2), box_at(1.5, 0, 2, 2)],
            [((1, 2), 3.0), ((0, 1), 2.0), ((0, 2), 1.0)],
            id="three, worst first",
        ),
    ],
)
def test_overlaps_report_pairs_with_common_area(shapes, expected):
    layout = Layout.from_polygons(shapes)

    assert found(layout, DesignRules(max_overlap_um2=0.0)) == [("max_overlap_um2", *pair) for pair in expected]


@pytest.mark.parametrize(("limit_um2", "ok"), [(0.24, False), (0.25, True), (0.3, True)])
def test_overlap_up_to_limit_passes(limit_um2, ok):
    layout = PLANTED["overlap"][0]

    assert layout.check(DesignRules(max_overlap_um2=limit_um2)).ok is ok


@given(st.integers(0, 2**32 - 1))
@relaxed
def test_random_overlaps_match_all_pairs(seed):
    rng = np.random.default_rng(seed)
    centre, size = rng.integers(-5000, 5000, (12, 2)) / 1000, rng.integers(250, 2000, (12, 2)) / 500
    violations = Layout.from_rectangles(centre, size).check(DesignRules(max_overlap_um2=0.0)).violations
    expected = {}
    for i, j in combinations(range(12), 2):
        reach = np.minimum(centre[i] + size[i] / 2, centre[j] + size[j] / 2)
        common = reach - np.maximum(centre[i] - size[i] / 2, centre[j] - size[j] / 2)
        if np.all(common > 0):
            expected[i, j] = pytest.approx(common[0] * common[1], rel=1e-7)

    assert {v.site_ids: v.value for v in violations} == expected


# -- gap -------------------------------------------------------------------------------------------------------------


def test_gaps_without_die_are_enclosed():
    missing = replaced({}, dropped=(7, 24))

    assert found(missing, DesignRules(max_gap_um2=0.0)) == [("max_gap_um2", (1, 2, 3, 6, 7, 10, 11, 12), 1.0)]


def test_gaps_with_die_include_open_boundary():
    missing = replaced({}, dropped=(7, 24))
    rules = DesignRules(max_gap_um2=0.0, die_um=(-2.5, -2.5, 3.5, 2.5))

    assert found(missing, rules) == [
        ("max_gap_um2", (4, 8, 13, 17, 18, 22), 6.0),
        ("max_gap_um2", (1, 2, 3, 6, 7, 10, 11, 12), 1.0),
    ]


@pytest.mark.parametrize("die_um", [None, (0.0, 0.0, 10.0, 10.0)])
def test_gap_excludes_enclosed_island(die_um):
    ring = box_at(0, 0, 10, 10).difference(box_at(2, 2, 6, 6))
    layout = Layout.from_polygons([ring, box_at(4, 4, 2, 2)])

    assert found(layout, DesignRules(max_gap_um2=0.0, die_um=die_um)) == [("max_gap_um2", (0, 1), 32.0)]


@pytest.mark.parametrize(
    ("dropped", "sites_um2"),
    [
        ((6, 17, 18), [((10, 11, 12, 13, 15, 16, 18, 19, 20, 21), 2.0), ((0, 1, 2, 5, 6, 9, 10, 11), 1.0)]),
        ((6, 7, 18), [((0, 1, 2, 3, 5, 6, 8, 9, 10, 11), 2.0), ((10, 11, 12, 15, 16, 19, 20, 21), 1.0)]),
    ],
)
@pytest.mark.parametrize("die_um", [None, ALL_RULES.die_um])
def test_gaps_sorted_worst_first(dropped, sites_um2, die_um):
    layout = replaced({}, dropped=dropped)

    assert found(layout, DesignRules(max_gap_um2=0.0, die_um=die_um)) == [
        ("max_gap_um2", sites, value) for sites, value in sites_um2
    ]


def test_open_trenches_are_gaps_only_with_die():
    layout = grid(n_x=3, n_y=3, pitch_um=1.0, width_um=0.9)

    assert layout.check(DesignRules(max_gap_um2=0.0)).ok
    assert found(layout, DesignRules(max_gap_um2=0.0, die_um=(-1.5, -1.5, 1.5, 1.5))) == [
        ("max_gap_um2", tuple(range(9)), 9 * 0.19)
    ]


@pytest.mark.parametrize(("limit_um2", "ok"), [(0.9, False), (1.0, True), (2.0, True)])
def test_gap_up_to_limit_passes(limit_um2, ok):
    layout = PLANTED["site missing in the centre"][0]

    assert layout.check(DesignRules(max_gap_um2=limit_um2)).ok is ok


@pytest.mark.parametrize("stagger", [False, True])
@pytest.mark.parametrize("n_sectors", [8, 33])
def test_log_polar_gap_is_blind_spot(n_sectors, stagger):
    layout = log_polar(n_sectors=n_sectors, r_min_um=10.0, r_max_um=50.0, n_rings=4, stagger=stagger, chords_per_arc=2)
    n_corners = 2 * n_sectors
    blind_um2 = 0.5 * n_corners * math.sin(2 * math.pi / n_corners) * 100.0

    (gap,) = layout.check(DesignRules(max_gap_um2=0.0)).violations
    assert gap.site_ids == tuple(range(n_sectors))
    assert gap.value == pytest.approx(blind_um2, rel=1e-3)  # with 1 nm


def test_empty_die_is_single_gap():
    report = replaced({})[:0].check(DesignRules(max_gap_um2=0.0, die_um=(0, 0, 3, 2)))

    assert [(v.site_ids, v.value) for v in report.violations] == [((), 6.0)]


# -- die -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("die_um", "expected"),
    [
        pytest.param((-1, -1, 1, 1), [], id="touching"),
        pytest.param((-0.75, -1, 1, 1), [((0,), 0.25), ((2,), 0.25)], id="left"),
        pytest.param((-1, -0.75, 1, 1), [((0,), 0.25), ((1,), 0.25)], id="low"),
        pytest.param((-1, -1, 0.5, 1), [((1,), 0.5), ((3,), 0.5)], id="right"),
        pytest.param((-1, -1, 1, 0.5), [((2,), 0.5), ((3,), 0.5)], id="high"),
        pytest.param((-1, -1, 0.5, 0.25), [((2,), 0.75), ((3,), 0.75), ((1,), 0.5)], id="two sides, worst first"),
        pytest.param((10, 10, 11, 11), [((0,), 11.0), ((1,), 11.0), ((2,), 11.0), ((3,), 10.0)], id="outside"),
    ],
)
def test_die_rule_measures_protrusion(die_um, expected):
    layout = grid(n_x=2, n_y=2, pitch_um=1.0)

    assert found(layout, DesignRules(die_um=die_um)) == [("die_um", *violation) for violation in expected]


# -- clean layouts ---------------------------------------------------------------------------------------------------

TILING = DesignRules(max_overlap_um2=0.0, max_gap_um2=0.0)


@pytest.mark.parametrize(
    ("layout", "size_um", "width_um"),
    [
        pytest.param(grid(n_x=9, n_y=7, pitch_um=0.7), 0.7, 0.7, id="grid"),
        pytest.param(grid(n_x=9, n_y=7, pitch_um=0.7, width_um=0.6), 0.6, 0.6, id="grid with trenches"),
        pytest.param(
            hexagonal(n_columns=9, n_rows=7, pitch_um=0.7), 0.7 * math.sqrt(math.sqrt(0.75)), 0.7, id="hexagons"
        ),
        pytest.param(zones(side_um=(6.4, 12.8, 25.6), pitch_um=(0.8, 1.6, 3.2)), 0.8, 0.8, id="zones"),
    ],
)
@pytest.mark.parametrize("angle_deg", [0.0, 33.0])
@pytest.mark.parametrize("shift_um", [0.0, 12_345.678])
def test_clean_layouts_pass_after_rotation_and_translation(layout, size_um, width_um, angle_deg, shift_um):
    moved = layout.rotate(angle_deg).translate(shift_um, -shift_um)
    limits = {"min_size_um": size_um, "min_width_um": width_um - 2e-3, "angle_limit_deg": 40.0}
    die_um = np.add(moved.bounds_um, (-1.0, -1.0, 1.0, 1.0))

    assert found(moved, TILING) == []
    assert found(moved, DesignRules(**limits, die_um=tuple(die_um))) == []


@given(st.integers(3, 14), st.integers(1, 5), st.integers(1, 4), st.booleans(), st.floats(0, 360))
@relaxed
def test_rotated_log_polar_has_single_gap(n_sectors, n_rings, chords_per_arc, stagger, angle_deg):
    layout = log_polar(
        n_sectors=n_sectors,
        r_min_um=3.0,
        r_max_um=40.0,
        n_rings=n_rings,
        chords_per_arc=chords_per_arc,
        stagger=stagger,
    )
    violations = layout.rotate(angle_deg).check(TILING).violations

    assert [(v.rule, v.site_ids) for v in violations] == [("max_gap_um2", tuple(range(n_sectors)))]


def test_empty_layout_violates_only_gap_rule():
    none = replaced({})[:0]
    report = none.check(ALL_RULES)

    assert report.n_sites == 0
    assert [v.rule for v in report.violations] == ["max_gap_um2"]
    assert none.check(DesignRules(min_size_um=1, min_width_um=1, max_overlap_um2=0, max_gap_um2=0)).ok


# -- report ----------------------------------------------------------------------------------------------------------


def test_report_contains_only_enabled_rules():
    layout = replaced({})

    assert layout.check(DesignRules()).results == ()
    assert layout.check(DesignRules()).ok
    assert [r.rule for r in layout.check(DesignRules(die_um=(0, 0, 1, 1), min_size_um=0)).results] == [
        "min_size_um",
        "die_um",
    ]


def test_raise_if_failed_accepts_clean_layout():
    report = replaced({}).check(ALL_RULES)

    assert (report.raise_if_failed(), report.n_sites) == (None, 25)


def test_raise_if_failed_lists_violated_rules():
    layout = Layout.from_rectangles([[0, 0], [5, 0], [10, 0]], [[1, 1], [0.5, 3], [0.25, 30]])
    report = layout.check(DesignRules(min_size_um=1.5, min_width_um=0.75, max_overlap_um2=0.0, die_um=(-9, -9, 9, 9)))

    with pytest.raises(GeometryError, match="the layout violates its design rules: ") as caught:
        report.raise_if_failed()
    assert caught.value.site_ids == (0, 1, 2)
    assert str(caught.value).split(": ", 1)[1].split("; ") == [
        "min_size_um: 2 violations, worst 1 µm, limit 1.5 µm",
        "min_width_um: 2 violations, worst 0.25 µm, limit 0.75 µm",
        "die_um: 1 violation, worst 6 µm, limit 0 µm",
    ]


def test_worst_value_is_furthest_beyond_limit():
    layout = Layout.from_rectangles([[0, 0], [5, 0], [10, 0]], [1.0, 0.5, 2.0])
    size, die = layout.check(DesignRules(min_size_um=1.5, die_um=(0, -9, 9, 9))).results

    assert (size.worst, die.worst) == (0.5, 2.0)
    assert layout.check(DesignRules(min_size_um=0.1)).results[0].worst is None


def test_table_has_row_per_rule():
    layout = Layout.from_rectangles([[0, 0], [5, 0]], [[1, 1], [0.5, 3]])
    report = layout.check(DesignRules(min_size_um=1.1, min_width_um=0.25))
    screen = io.StringIO()
    Console(file=screen, width=120, color_system=None).print(report)
    lines = [line.split() for line in screen.getvalue().replace("│", " ").splitlines()]

    assert ["Design", "rules", "on", "2", "photosites"] in lines
    assert ["min_size_um", "fail", "1", "1", "1.1", "µm"] in lines
    assert ["min_width_um", "pass", "0", "0.25", "µm"] in lines


# -- invalid limits --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["min_size_um", "min_width_um", "max_overlap_um2", "max_gap_um2"])
@pytest.mark.parametrize(
    ("limit", "message"),
    [
        (-1.0, "must be >= 0, got -1.0 µm"),
        (np.nan, "must be finite, got nan µm"),
        (np.inf, "must be finite, got inf µm"),
        ("1", "must be one number, got '1'"),
        (True, "must be one number, got True"),
    ],
)
def test_invalid_limits_are_rejected(name, limit, message):
    with pytest.raises(ParameterError, match=f"'{name}' {message}"):
        DesignRules(**{name: limit})


@pytest.mark.parametrize(
    ("die_um", "message"),
    [
        ((0, 0, 1), r"'die_um' must be \(x_min, y_min, x_max, y_max\)"),
        ((1, 0, 0, 1), r"'die_um' must be \(x_min, y_min, x_max, y_max\), got \(1, 0, 0, 1\) µm"),
        ((0, 0, 1, 0), r"'die_um' must be \(x_min, y_min, x_max, y_max\)"),
        (((0, 0), (1, 1)), "'die_um' must have 1 dimension, got the shape"),
        ((0, 0, np.nan, 1), r"'die_um' must be finite .* at \[2\]"),
        ("all", "'die_um' must be an array of numbers, got 'all'"),
        (5.0, "'die_um' must have 1 dimension, got the shape"),
    ],
)
def test_invalid_dies_are_rejected(die_um, message):
    with pytest.raises(ParameterError, match=message):
        DesignRules(die_um=die_um)


def test_worst_violations_are_the_first_ones():
    sites = Layout.from_rectangles(np.arange(40.0).reshape(20, 2) * 10.0, np.linspace(1.0, 3.0, 20))
    (result,) = sites.check(DesignRules(min_size_um=2.9)).results
    located = []
    locate = result._locate
    counted = replace(result, _locate=lambda part: located.append(part) or locate(part))
    worst = counted.worst_violations(3)

    assert [violation.site_ids for violation in worst] == [(0,), (1,), (2,)]
    assert located == [slice(3)]
    assert worst == result.violations[:3]
    assert counted.worst_violations(100) == result.violations
    with pytest.raises(ParameterError, match="'n' must be >= 1, got 0"):
        counted.worst_violations(0)


@pytest.mark.parametrize(
    ("trench_um", "text"),
    [
        # Sites also touch at corners: 2 x 2 squares have 4 edges and 2 diagonals in contact, or 0.1 and 0.14 µm apart.
        (
            0.0,
            "min_space_um: 6 violations, worst 0 µm, limit 0.2 µm (6 pairs of sites touch or overlap; apply inset first)",
        ),
        (0.3, "min_space_um: satisfied"),
        (0.1, "min_space_um: 6 violations, worst 0.1 µm, limit 0.2 µm"),
    ],
)
def test_minimum_space_notes_touching_sites(trench_um, text):
    layout = Layout.from_rectangles([[0, 0], [2, 0], [0, 2], [2, 2]], 2.0 - trench_um)
    (result,) = layout.check(DesignRules(min_space_um=0.2)).results

    assert str(result) == text
    assert str(pickle.loads(pickle.dumps(result))) == text
