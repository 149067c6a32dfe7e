"""Design rules against a slow reference implementation, and with one violation among 100,000 sites."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from reference.rules import MASK_RULES, REFERENCES, layouts, on_grid
from shapely.affinity import rotate

import foveasim as fs
from foveasim.errors import GeometryError
from foveasim.layout.drc.rules import RULES

relaxed = settings(max_examples=examples(30))

#: Steps, and the tolerances of deviations from them (degrees, µm).
STEPS = {
    "edge_angle_step_deg": (90.0, 45.0, 30.0, 22.5, 180.0, 7.5),
    "grid_um": (1.0, 0.005, 0.5, 0.1, 2.0, 1 / 3),
}
DEVIATIONS = {"edge_angle_step_deg": 1e-9, "grid_um": 1e-6, "die_um": 1e-6}

#: Position of a limit within the range of measured values, 0 to 1.
fractions = st.integers(0, 99).map(lambda percent: percent / 100)


def die_in(layout, fraction):
    """Return a die that cuts off sites on some sides and leaves open area on others."""
    x0, y0, x1, y1 = shapely.total_bounds(layout.polygons()).tolist()
    width, height = x1 - x0, y1 - y0
    return (
        x0 + 0.5 * (fraction - 0.305) * width,
        y0 + 0.5 * (0.405 - fraction) * height,
        x1 + 0.5 * (0.505 - fraction) * width,
        y1 - 0.1 * height,
    )


def between(values, fraction):
    """Return a limit below, between or above the values, not close to any of them."""
    ordered = sorted(value for value in values if value > 1e-5)
    if not ordered:
        return 0.5
    # In gaps between neighbours: values may follow each other closely over a long range.
    between_values = [0.5 * (a + b) for a, b in pairwise(ordered) if b - a > 1e-5 * max(1.0, b)]
    limits = [0.5 * ordered[0], *between_values, 1.5 * ordered[-1]]
    return limits[int(fraction * len(limits))]


def limited(rule, layout, fraction, has_field):
    """Return design rules with one limit; optionally with a second limit that changes its meaning."""
    if rule in STEPS:
        return fs.DesignRules(**{rule: STEPS[rule][int(fraction * len(STEPS[rule]))]})
    field = {"die_um": die_in(layout, fraction)}
    if rule == "die_um":
        return fs.DesignRules(**field)
    other = {"max_gap_um2": field, "min_width_um": {"angle_limit_deg": 40.0}}.get(rule, {}) if has_field else {}
    limit = between([value for _, value in measured_by_reference(rule, layout, fs.DesignRules(**other))], fraction)
    limit = {"min_angle_deg": min(limit, 180.0), "max_sites": int(limit)}.get(rule, limit)
    return fs.DesignRules(**{rule: limit}, **other)


def measured_by_reference(rule, layout, rules):
    try:
        mask = on_grid(layout)
    except GeometryError:  # a site collapses or crosses itself on the database grid
        assume(False)
    return REFERENCES[rule](mask if rule in MASK_RULES else layout, rules)


def compare(rule, layout, rules):
    """Compare sites and values of the violations with the reference implementation."""
    is_upper = rule.startswith("max_") or rule in DEVIATIONS
    limit = DEVIATIONS.get(rule, getattr(rules, rule))
    measured = measured_by_reference(rule, layout, rules)
    unclear = {sites for sites, value in measured if math.isnan(value)}
    expected = sorted((s, v) for s, v in measured if s not in unclear and (v > limit if is_upper else v < limit))
    (result,) = [result for result in layout.check(rules).results if result.rule == rule]
    found = sorted((v.site_ids, v.value) for v in result.violations if v.site_ids not in unclear)
    values = [violation.value for violation in result.violations]

    assert [sites for sites, _ in found] == [sites for sites, _ in expected]
    assert [value for _, value in found] == pytest.approx([value for _, value in expected], rel=1e-6, abs=1e-6)
    assert values == pytest.approx(sorted(values, reverse=is_upper), rel=1e-9)


# -- reference implementations ------------------------------------------------------------------------------------------


#: Rules for the complete field; their reference implementations are in test_field_rules.py.
FIELD_RULES = {"min_density", "max_density", "max_data_rate_gbit_per_s", "max_track_utilisation"}


def test_every_rule_has_reference_implementation():
    assert set(REFERENCES) | FIELD_RULES == set(RULES)


def test_limits_are_far_from_values():
    values = [1.0 + 9e-6 * k for k in range(3)]

    assert [between(values, fraction) for fraction in (0.0, 0.99)] == [0.5, 1.5 * values[-1]]
    assert between([*values, 2.0], 0.5) == 0.5 * (values[-1] + 2.0)


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("rule", sorted(set(REFERENCES) - {"max_gap_um2"}))
@given(layout=layouts(), fraction=fractions, has_field=st.booleans())
@relaxed
def test_violations_match_reference_implementation(rule, layout, fraction, has_field):
    compare(rule, layout, limited(rule, layout, fraction, has_field))


@given(layout=layouts(turns=False), fraction=fractions, has_field=st.booleans())
@relaxed
def test_gaps_match_reference_without_rotation(layout, fraction, has_field):
    compare("max_gap_um2", layout, limited("max_gap_um2", layout, fraction, has_field))


@given(layout=layouts(), fraction=fractions, has_field=st.booleans())
@relaxed
def test_gap_areas_match_reference_with_rotation(layout, fraction, has_field):
    rules = limited("max_gap_um2", layout, fraction, has_field)
    expected = [
        area_um2 for _, area_um2 in measured_by_reference("max_gap_um2", layout, rules) if area_um2 > rules.max_gap_um2
    ]
    found = [violation.value for violation in layout.check(rules).violations if violation.rule == "max_gap_um2"]

    assert found == pytest.approx(sorted(expected, reverse=True), rel=1e-6, abs=1e-5)


# -- one violation among 100,000 sites ----------------------------------------------------------------------------------

#: Index of the planted site, and its ring.
PLANT, RING = 61_803, 108
PITCH_UM = {"spaced": 3.0, "abutting": 2.0}


@pytest.fixture(scope="module")
def squares():
    """99,999 squares of 2 µm, spaced or abutting, with rows as rings and a 3 × 3 vacancy in the centre of row 108."""
    n_x, n_y = 463, 216
    row, column = np.divmod(np.arange(n_x * n_y), n_x)
    is_unchanged = (np.abs(row - RING) > 1) | (np.abs(column - 231) > 1)
    return {
        name: fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=pitch_um, width_um=2.0).with_columns(ring=row)[is_unchanged]
        for name, pitch_um in PITCH_UM.items()
    }


def planted_site(_layout):
    return (PLANT,)


def with_site_at(x_um, y_um):
    """Return a function for the planted site and the site at a position."""

    def sites(layout):
        low, high = layout.site_bounds_um[:, :2], layout.site_bounds_um[:, 2:]
        is_there = ((low < (x_um, y_um)) & (high > (x_um, y_um))).all(axis=1)
        is_there[PLANT] = True
        return tuple(np.flatnonzero(is_there).tolist())

    return sites


def ring(number):
    return lambda layout: tuple(np.flatnonzero(layout.columns["ring"] == number).tolist())


def square(side_um):
    return shapely.box(-side_um / 2, -side_um / 2, side_um / 2, side_um / 2)


DUMBBELL = shapely.union_all([shapely.box(-3, -1, -1, 1), shapely.box(-1, -0.25, 1, 0.25), shapely.box(1, -1, 3, 1)])
FRAME = square(8).difference(shapely.box(-0.5, -0.25, 0.5, 0.25))
RIGHT_TRIANGLE = shapely.Polygon([(-2, -2), (2, -2), (2, 2)])
FLAT_TRIANGLE = shapely.Polygon([(-2, -2), (2, -2), (2, 1)])
#: Ratio of the mean site size in the ring of the planted 3 µm square to that of other rings.
GROWTH = (460 + 1.5) / 461

#: For each rule: the squares, the planted site around the centre of the vacancy (10 µm wide between spaced squares, 6 µm
#: between abutting ones), the limit, and the expected sites and value.
PLANTS = {
    "min_size_um": ("spaced", square(1), 1.5, planted_site, 1.0),
    "max_size_um": ("spaced", square(3), 2.5, planted_site, 3.0),
    "min_area_um2": ("spaced", square(1.5), 3.0, planted_site, 2.25),
    "min_hole_um2": ("spaced", FRAME, 1.0, planted_site, 0.5),
    "min_width_um": ("spaced", DUMBBELL, 1.0, planted_site, 0.5),
    "min_space_um": ("spaced", shapely.box(-4.6, -1, -2.6, 1), 0.8, with_site_at(-6, 1.5), 0.4),
    "max_aspect_ratio": ("spaced", rotate(shapely.box(-3, -1, 3, 1), 33), 2.0, planted_site, 3.0),
    "min_angle_deg": ("spaced", RIGHT_TRIANGLE, 60.0, planted_site, 45.0),
    "edge_angle_step_deg": ("spaced", FLAT_TRIANGLE, 45.0, planted_site, 45.0 - math.degrees(math.atan2(3, 4))),
    "grid_um": ("spaced", shapely.box(-1, -1, 1.002, 1), 0.5, planted_site, 0.002),
    "max_overlap_um2": ("abutting", square(6).union(shapely.box(3, -0.25, 4, 0.25)), 0.0, with_site_at(4, 1), 0.5),
    "max_gap_um2": ("abutting", square(6).difference(shapely.box(-3, -0.25, -2, 0.25)), 0.0, with_site_at(-4, 1), 0.5),
    "die_um": ("spaced", shapely.box(694.5, 0, 696.5, 2), (-695.0, -325.0, 695.0, 325.0), planted_site, 1.5),
    "min_growth": ("spaced", square(3), 0.9999, ring(RING + 1), 1 / GROWTH),
    "max_growth": ("spaced", square(3), 1.0001, ring(RING), GROWTH),
    "max_neighbour_ratio": ("abutting", shapely.box(-3, -0.5, -2, 0.5), 1.5, with_site_at(-4, 1), 2.0),
    "max_sites": ("spaced", square(2), 99_999, lambda _layout: (), 100_000),
}


@pytest.mark.parametrize("rule", PLANTS)
def test_single_violation_found_among_100000_sites(rule, squares):
    name, shape, limit, sites, value = PLANTS[rule]
    plant = fs.Layout.from_polygons([shape], ring=[RING]).translate(0.0, 0.5 * PITCH_UM[name])
    layout = fs.layout.union([squares[name][:PLANT], plant, squares[name][PLANT:]])
    violations = layout.check(fs.DesignRules(**{rule: limit})).violations

    assert layout.n_sites == 100_000
    assert [(v.rule, v.site_ids) for v in violations] == [(rule, sites(layout))]
    assert violations[0].value == pytest.approx(value, rel=1e-9)
