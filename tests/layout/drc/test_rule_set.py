"""Rules other than size and overlap: planted violations, values, waivers and reports."""

from __future__ import annotations

import pickle
from itertools import combinations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout.drc.rules import RULES

SQUARES = fs.layout.grid(n_x=20, n_y=20, pitch_um=3.0, width_um=2.0)


def planted(polygon):
    """Return a hundred squares of 2 µm, 1 µm apart, and one shape next to them."""
    squares = list(fs.layout.grid(n_x=10, n_y=10, pitch_um=3.0, width_um=2.0).polygons())
    return fs.Layout.from_polygons([*squares, shapely.transform(polygon, lambda xy: xy + np.array([100.0, 0.0]))])


PLANTS = {
    "max_size_um": (shapely.box(0, 0, 3, 3), 2.5, 3.0),
    "min_area_um2": (shapely.box(0, 0, 1.5, 1.5), 3.0, 2.25),
    "min_hole_um2": (shapely.box(0, 0, 8, 8).difference(shapely.box(2, 2, 3, 2.5)), 1.0, 0.5),
    "max_aspect_ratio": (rotate(shapely.box(0, 0, 6, 2), 33), 2.0, 3.0),
    "min_angle_deg": (shapely.Polygon([(0, 0), (4, 0), (4, 4)]), 60.0, 45.0),
    "edge_angle_step_deg": (shapely.Polygon([(0, 0), (4, 0), (4, 3)]), 45.0, 0.0),
    "grid_um": (shapely.box(0, 0, 2.003, 2), 0.005, 0.002),
}  # fmt: skip


@pytest.mark.parametrize("rule", [r for r in PLANTS if r != "edge_angle_step_deg"])
def test_planted_violation_found_alone_with_value(rule):
    shape, limit, value = PLANTS[rule]
    report = planted(shape).check(fs.DesignRules(**{rule: limit}))

    assert [v.site_ids for v in report.violations] == [(100,)]
    assert report.violations[0].value == pytest.approx(value, abs=1e-9)
    assert planted(shapely.box(0, 0, 2, 2)).check(fs.DesignRules(**{rule: limit})).ok


def test_edge_angle_deviation_is_measured():
    report = planted(PLANTS["edge_angle_step_deg"][0]).check(fs.DesignRules(edge_angle_step_deg=45.0))

    assert [v.site_ids for v in report.violations] == [(100,)]
    assert report.violations[0].value == pytest.approx(45.0 - np.degrees(np.arctan2(3, 4)))


def test_edge_angle_rule_can_be_waived():
    rings = fs.layout.log_polar(n_sectors=16, r_min_um=3.0, r_max_um=22.0)
    rules = {"edge_angle_step_deg": 45.0, "min_size_um": 0.5}
    report = rings.check(fs.DesignRules(**rules))
    waived = rings.check(fs.DesignRules(**rules, waivers={"edge_angle_step_deg": "drawn as curves"}))

    assert not report.ok
    assert str(report).count("\n") == 2
    assert waived.ok
    assert len(waived.violations) == len(report.violations)
    assert "waived: drawn as curves" in str(waived)
    waived.raise_if_failed()


def test_abutting_sites_have_no_space():
    abutting = fs.layout.grid(n_x=5, n_y=5, pitch_um=2.0)
    report = abutting.check(fs.DesignRules(min_space_um=0.5))
    assert not report.ok
    assert [v.value for v in report.violations] == [0.0] * (2 * 4 * 5 + 2 * 4 * 4)  # edges and corners in common

    layout = fs.Layout.from_polygons([shapely.box(0, 0, 2, 2), shapely.box(2.3, 0, 4, 2), shapely.box(0, 2.5, 2, 4)])
    report = layout.check(fs.DesignRules(min_space_um=0.5))
    assert [(v.site_ids, round(v.value, 9)) for v in report.violations] == [((0, 1), 0.3)]
    assert report.violations[0].marker.length == pytest.approx(0.3)


@settings(max_examples=examples(40))
@given(seed=st.integers(0, 10_000), limit_um=st.floats(0.1, 2.0))
def test_spaces_match_pairwise_distances(seed, limit_um):
    rng = np.random.default_rng(seed)
    layout = fs.Layout.from_rectangles(rng.integers(0, 20_000, (25, 2)) / 1000, rng.integers(100, 1000, (25, 2)) / 500)
    polygons = layout.polygons()
    expected = {
        pair
        for pair in combinations(range(25), 2)
        if shapely.distance(polygons[pair[0]], polygons[pair[1]]) < limit_um - 1e-6
    }

    assert {v.site_ids for v in layout.check(fs.DesignRules(min_space_um=limit_um)).violations} == expected


def test_log_polar_growth_equals_ring_ratio():
    rings = fs.layout.log_polar(n_sectors=30, r_min_um=5.0, r_max_um=80.0, ring_ratio=1.0945)
    ratio = float(np.sqrt(rings.area_um2[30] / rings.area_um2[0]))

    assert ratio == pytest.approx(1.0945)
    assert rings.check(fs.DesignRules(min_growth=1.0944, max_growth=1.0946)).ok
    report = rings.check(fs.DesignRules(max_growth=1.09))
    assert len(report.violations) == rings.columns["ring"].max()
    assert report.violations[0].value == pytest.approx(1.0945)
    assert len(report.violations[0].site_ids) == 30


def test_zone_neighbours_have_size_ratio_two():
    zones = fs.layout.zones(side_um=(4, 12, 28), pitch_um=(1, 2, 4))

    assert zones.check(fs.DesignRules(max_neighbour_ratio=2.0)).ok
    report = zones.check(fs.DesignRules(max_neighbour_ratio=1.9))
    zone = zones.columns["zone"]
    assert report.violations
    assert all(abs(int(zone[a]) - int(zone[b])) == 1 for a, b in (v.site_ids for v in report.violations))
    assert {round(v.value, 9) for v in report.violations} == {2.0}


def test_number_of_sites_is_limited():
    report = SQUARES.check(fs.DesignRules(max_sites=399))

    assert [(v.site_ids, v.value, v.limit) for v in report.violations] == [((), 400.0, 399.0)]
    assert SQUARES.check(fs.DesignRules(max_sites=400)).ok


def test_hole_corner_angle_measured_inside_site():
    wedge = shapely.Polygon([(2, 2), (6, 2.5), (2, 3)])  # 14 degrees in the hole, 346 in the site
    frame = shapely.box(0, 0, 9, 9).difference(wedge)

    assert fs.Layout.from_polygons([frame]).check(fs.DesignRules(min_angle_deg=80.0)).ok


def test_every_rule_finds_violation_among_100000_sites():
    big = fs.layout.grid(n_x=400, n_y=250, pitch_um=3.0, width_um=2.0)
    sliver = fs.Layout.from_polygons([shapely.Polygon([(900, 0), (900.9, 0.0), (900.9, 0.33), (900, 0.3)])])
    layout = fs.layout.union([big, sliver])
    rules = fs.DesignRules(
        min_size_um=1.0, min_area_um2=1.0, min_width_um=1.0, max_aspect_ratio=1.5, min_angle_deg=89.0,
        edge_angle_step_deg=45.0, grid_um=0.5, max_overlap_um2=0.0, die_um=(-601.0, -400.0, 900.5, 400.0),
    )  # fmt: skip
    report = layout.check(rules)

    assert {result.rule: [v.site_ids for v in result.violations] for result in report.results} == {
        **{result.rule: [(100_000,)] for result in report.results},
        "max_overlap_um2": [],
    }


def test_records_have_row_per_violation():
    records = planted(shapely.box(0, 0, 3, 3)).check(fs.DesignRules(max_size_um=2.5)).records()

    assert records == [
        {
            "rule": "max_size_um",
            "site_ids": (100,),
            "value": 3.0,
            "limit": 2.5,
            "unit": "µm",
            "x_um": 101.5,
            "y_um": 1.5,
        }
    ]


def test_every_rule_has_field_and_description():
    for name, rule in RULES.items():
        assert hasattr(fs.DesignRules(), name)
        assert rule.description
        assert name in fs.DesignRules.__doc__


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"min_angle_deg": 0.0}, "'min_angle_deg' must be > 0"),
        ({"edge_angle_step_deg": 200.0}, "'edge_angle_step_deg' must be <= 180"),
        ({"grid_um": 0.0}, "'grid_um' must be > 0"),
        ({"max_growth": -1.0}, "'max_growth' must be >= 0"),
        ({"waivers": {"min_widht_um": "typo"}}, "'waivers' must have names of rules as keys"),
        ({"waivers": {"min_width_um": " "}}, "'waivers' must give a reason for 'min_width_um'"),
    ],
)
def test_invalid_limits_are_rejected(values, message):
    with pytest.raises(ParameterError, match=message):
        fs.DesignRules(**values)


def test_growth_requires_ring_column():
    with pytest.raises(ParameterError, match="'ring' must be a column of the layout"):
        SQUARES.check(fs.DesignRules(max_growth=1.1))


def test_only_unwaived_violations_raise_error():
    layout = planted(shapely.box(0, 0, 3, 3))
    rules = fs.DesignRules(max_size_um=2.5, max_sites=50, waivers={"max_size_um": "the reference site"})

    with pytest.raises(GeometryError, match=r"max_sites: 1 violation, worst 101, limit 50$"):
        layout.check(rules).raise_if_failed()


def test_giotto_has_504_sites_below_minimum_width():
    """At a unit pixel of 6.45 µm, KLayout's width check finds the same sites: the two innermost of the 110 rings."""
    rings = fs.layout.giotto(n_rho=152, n_theta=252, n_fovea=42, n_across=1090, unit_um=6.45, fovea="none")
    report = rings.check(fs.DesignRules(min_width_um=6.8, angle_limit_deg=80.0))
    ids = [violation.site_ids[0] for violation in report.violations]

    assert rings.n_sites == 27_720
    assert len(ids) == len(set(ids)) == 504
    assert np.unique(rings.columns["ring"][ids]).tolist() == [42, 43]


@pytest.mark.parametrize("step_deg", [50.0, 75.0, 90.0, 45.0, 7.0])
def test_edge_angle_ignores_direction(step_deg):
    upright = SQUARES.check(fs.DesignRules(edge_angle_step_deg=step_deg))
    expected = min(90.0 % step_deg, step_deg - 90.0 % step_deg)

    # Less the rounding of an edge to the database grid.
    assert np.unique([v.value for v in upright.violations]) == pytest.approx([expected] if expected else [], abs=0.1)


def test_report_can_be_pickled():
    report = planted(shapely.box(0, 0, 3, 3)).check(fs.DesignRules(max_size_um=2.5, max_sites=50))
    back = pickle.loads(pickle.dumps(report))

    assert back.records() == report.records()
    assert str(back) == str(report)
    assert [len(result) for result in back.results] == [1, 1]
