"""Rules for complete fields: density in a moving window, data rate, routing capacity; and presets."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.config import read_layout_file, read_rules
from foveasim.errors import ConfigError, ParameterError
from foveasim.layout import PRESETS, DesignRules, Readout, Routing, grid, log_polar


def values(layout, **rules):
    return [violation.value for violation in layout.check(DesignRules(**rules)).violations]


# -- density ---------------------------------------------------------------------------------------------------------


def test_periodic_layout_density_equals_fill_factor():
    layout = grid(n_x=40, n_y=40, pitch_um=1.0, width_um=0.6)
    die = (-20.0, -20.0, 20.0, 20.0)

    assert values(layout, max_density=0.0, density_window_um=4.0, die_um=die) == pytest.approx([0.36] * 19**2)
    assert layout.check(DesignRules(min_density=0.36, max_density=0.36, density_window_um=4.0, die_um=die)).ok


def test_low_density_found_only_around_hole():
    squares = grid(n_x=320, n_y=320, pitch_um=2.0, width_um=1.0)
    is_removed = (np.abs(squares.centroid_um - np.array([103.0, -51.0])) < 4.5).all(axis=1)
    report = squares[~is_removed].check(
        DesignRules(min_density=0.249, density_window_um=20.0, die_um=(-320.0, -320.0, 320.0, 320.0))
    )
    hole = shapely.box(98, -56, 108, -46)  # 25 cells

    assert report.n_sites == 102_400 - 25
    assert len(report.violations) == 9
    assert all(shapely.intersects(violation.marker, hole) for violation in report.violations)
    removed_fraction = [shapely.area(shapely.intersection(v.marker, hole)) / 4.0 / 400.0 for v in report.violations]
    assert [0.25 - v.value for v in report.violations] == pytest.approx(removed_fraction)


@settings(max_examples=examples(40))
@given(seed=st.integers(0, 10_000), window_um=st.floats(3.0, 30.0), has_die=st.booleans())
def test_densities_match_clipped_site_areas(seed, window_um, has_die):
    rng = np.random.default_rng(seed)
    layout = fs.layout.voronoi(n_sites=30, size_um=(20.0, 14.0), n_iterations=1, seed=seed)
    layout = layout[rng.random(30) < 0.7]
    die = (-11.0, -6.0, 9.0, 12.0) if has_die else None
    x0, y0, x1, y1 = die or layout.bounds_um
    w_um, h_um = min(window_um, x1 - x0), min(window_um, y1 - y0)
    expected = []
    for k in range(1000):
        y = min(y0 + 0.5 * h_um * k, y1 - h_um)
        for i in range(1000):
            x = min(x0 + 0.5 * w_um * i, x1 - w_um)
            window = shapely.box(x, y, x + w_um, y + h_um)
            expected.append(sum(polygon.intersection(window).area for polygon in layout.polygons()) / window.area)
            if x >= x1 - w_um - 1e-9:
                break
        if y >= y1 - h_um - 1e-9:
            break
    found = layout.check(DesignRules(max_density=0.0, density_window_um=window_um, die_um=die)).results[-1]

    assert sorted(v.value for v in found.violations) == pytest.approx(sorted(e for e in expected if e > 1e-9), abs=1e-9)


# -- data rate -------------------------------------------------------------------------------------------------------


def test_data_rate_limit_is_checked():
    layout = grid(n_x=2592 // 8, n_y=1944 // 8, pitch_um=1.0)
    readout = Readout(frames_per_s=30, bits=10, blanking=0.2)

    assert values(layout, max_data_rate_gbit_per_s=0.02, readout=readout) == pytest.approx([1.814 / 64], abs=1e-5)
    two = Readout(frames_per_s=30, bits=10, blanking=0.2, n_lanes=2)
    assert layout.check(DesignRules(max_data_rate_gbit_per_s=0.02, readout=two)).ok


# -- routing capacity ------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings(
    "ignore::foveasim.errors.LayoutWarning"
)  # with coarse ratios, the last ring lies inside r_max_um
@settings(max_examples=examples(30))
@given(n_sectors=st.integers(20, 400), pitch_um=st.floats(0.2, 2.0), n_layers=st.integers(1, 4))
def test_log_polar_lines_cross_first_ring(n_sectors, pitch_um, n_layers):
    layout = log_polar(n_sectors=n_sectors, min_size_um=2.0, r_max_um=2.0 * n_sectors)
    routing = Routing(width_um=0.6 * pitch_um, space_um=0.4 * pitch_um, n_layers=n_layers)
    outer_um = math.hypot(*layout.xy_um[0])
    n_tracks = n_layers * math.floor(2 * math.pi * outer_um / pitch_um + 1e-9)
    report = layout.check(DesignRules(max_track_utilisation=0.0, routing=routing))

    assert [v.value for v in report.violations] == pytest.approx([n_sectors / n_tracks])
    assert report.violations[0].site_ids == tuple(range(n_sectors))
    assert report.violations[0].marker.length == pytest.approx(2 * math.pi * outer_um, rel=0.01)
    assert layout.check(DesignRules(max_track_utilisation=1.0, routing=routing)).ok == (n_sectors <= n_tracks)


def test_columns_exceeding_layout_width_are_reported():
    layout = grid(n_x=100, n_y=3, pitch_um=0.5)
    rules = {"max_track_utilisation": 1.0}
    narrow = Routing(width_um=0.14, space_um=0.14, direction="upwards")
    wide = Routing(width_um=0.4, space_um=0.4, direction="upwards")

    assert layout.check(DesignRules(**rules, routing=narrow)).ok
    report = layout.check(DesignRules(**rules, routing=wide))
    assert [v.value for v in report.violations] == pytest.approx([100 / math.floor(50 / 0.8)])
    assert report.violations[0].marker.length == 50.0


def test_single_excess_found_among_100000_sites():
    layout = log_polar(n_sectors=500, r_min_um=100.0, r_max_um=1300.0, n_rings=200)
    readout = Readout(frames_per_s=1000.0, bits=10)
    outer_um = math.hypot(*layout.xy_um[0])
    pitch_um = 2 * math.pi * outer_um / 499.5
    routing = Routing(width_um=0.5 * pitch_um, space_um=0.5 * pitch_um)
    rules = DesignRules(max_data_rate_gbit_per_s=0.99999, readout=readout, max_track_utilisation=1.0, routing=routing)
    report = layout.check(rules)

    assert layout.n_sites == 100_000
    assert [v.value for v in report.violations] == pytest.approx([1.0, 500 / 499])
    assert [v.site_ids for v in report.violations] == [(), tuple(range(500))]
    one_less = layout[(layout.readout_line != 7) | (layout.columns["ring"] > 0)]
    assert [v.rule for v in one_less[1:].check(rules).violations] == []


def test_lines_without_tracks_are_reported():
    layout = log_polar(n_sectors=12, r_min_um=1.0, r_max_um=24.5)
    routing = Routing(width_um=20.0, space_um=20.0)

    assert layout.check(DesignRules(max_track_utilisation=1.0, routing=routing)).results[0].worst == math.inf


# -- limits and presets ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"min_density": 0.2}, "'density_window_um' must be given for 'min_density'"),
        ({"max_density": 1.2, "density_window_um": 9.0}, "'max_density' must be <= 1"),
        ({"max_density": 0.2, "density_window_um": 0.0}, "'density_window_um' must be > 0"),
        ({"max_data_rate_gbit_per_s": 1.0}, "'readout' must be given for 'max_data_rate_gbit_per_s'"),
        ({"max_data_rate_gbit_per_s": 1.0, "readout": 30}, "'readout' must be a Readout, got an int"),
        ({"max_track_utilisation": 1.0}, "'routing' must be given for 'max_track_utilisation'"),
        ({"routing": "up"}, "'routing' must be a Routing, got a str"),
        ({"preset": "sky"}, "'preset' must be one of 'sky130_met1', .*, got 'sky'"),
    ],
)
def test_invalid_field_limits_are_rejected(limits, message):
    with pytest.raises(ParameterError, match=message):
        DesignRules(**limits)


@pytest.mark.parametrize("name", PRESETS)
def test_preset_has_limits_and_source(name):
    rules = DesignRules(preset=name)

    assert len(PRESETS[name].source) > 30
    assert all(getattr(rules, limit) == value for limit, value in PRESETS[name].limits.items())


def test_presets_match_published_limits():
    metal, diff, well = (DesignRules(preset=f"sky130_{layer}") for layer in ("met1", "diff", "dnwell"))

    assert (metal.min_width_um, metal.min_space_um, metal.min_area_um2, metal.min_hole_um2) == (0.14, 0.14, 0.083, 0.14)
    assert (diff.min_width_um, diff.min_space_um, diff.edge_angle_step_deg) == (0.15, 0.27, 90.0)
    assert well.min_width_um == 3.0
    assert DesignRules(preset="ihp_sg13g2").min_angle_deg == 87.0
    assert {DesignRules(preset=name).grid_um for name in ("sky130_met1", "ihp_sg13g2")} == {0.005}
    assert DesignRules(preset="paper").min_size_um == 2.2


def test_explicit_limits_override_preset():
    rules = DesignRules(preset="sky130_met1", min_width_um=0.5)

    assert (rules.min_width_um, rules.min_space_um) == (0.5, 0.14)


def test_rule_files_accept_presets_readout_routing(tmp_path):
    (tmp_path / "rules.yaml").write_text(
        "preset: sky130_diff\nmin_width_um: 0.2\nmax_data_rate_gbit_per_s: 2.0\n"
        "readout: {frames_per_s: 30.0, bits: 10, n_lanes: 4}\n"
        "max_track_utilisation: 1.0\nrouting: {width_um: 0.14, space_um: 0.14, direction: upwards}\n"
    )
    (tmp_path / "layout.yaml").write_text(
        "generator: grid\nparameters: {n_x: 3, n_y: 3, pitch_um: 2.0}\nrules: {preset: paper}\n"
    )
    rules = read_rules(tmp_path / "rules.yaml")

    assert (rules.min_width_um, rules.min_space_um) == (0.2, 0.27)
    assert rules.readout == Readout(frames_per_s=30.0, bits=10, n_lanes=4)
    assert rules.routing == Routing(width_um=0.14, space_um=0.14, direction="upwards")
    assert read_layout_file(tmp_path / "layout.yaml").rules == DesignRules(min_size_um=2.2)
    (tmp_path / "rules.yaml").write_text("preset: sky\n")
    with pytest.raises(ConfigError, match=r"rules.yaml:1:1: preset: must be one of 'sky130_met1'"):
        read_rules(tmp_path / "rules.yaml")
    (tmp_path / "rules.yaml").write_text("max_track_utilisation: 1.0\nrouting: {width_um: -0.14, space_um: 0.14}\n")
    with pytest.raises(ConfigError, match=r"routing.width_um: must be > 0, got -0.14"):
        read_rules(tmp_path / "rules.yaml")


def test_rules_are_read_by_preset_name():
    assert read_rules("sky130_met1") == DesignRules(preset="sky130_met1")
