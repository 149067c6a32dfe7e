"""Layout summary, sorting, selection, data rate and routing demand."""

from __future__ import annotations

import io
import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import Readout, Routing, describe, grid, log_polar, mosaic, track_demand, zones

ZONES = zones(side_um=(64, 128, 256, 512), pitch_um=(1, 2, 4, 8))


def render(item):
    stream = io.StringIO()
    Console(file=stream, width=120).print(item)
    return stream.getvalue()


# -- describe --------------------------------------------------------------------------------------------------------


def test_summary_of_zones_matches_closed_form():
    found = describe(ZONES)

    assert (found.n_sites, found.n_vertices, found.n_lines) == (13_312, 4 * 13_312, 4 * 64)
    assert found.bounds_um == (-256.0, -256.0, 256.0, 256.0)
    assert found.area_um2 == 512.0**2
    assert found.fill_factor == pytest.approx(1.0)
    assert found.size_um.tolist() == [1.0, 1.0, 2.0, 4.0, 8.0]
    assert found.channels == {0: 13_312}
    assert found.size_counts.sum() == 13_312
    assert sorted(found.size_counts[found.size_counts > 0].tolist()) == [3072, 3072, 3072, 4096]


def test_fill_factor_excludes_trenches_and_blind_spot():
    trenched = grid(n_x=200, n_y=200, pitch_um=1.0, trench_um=0.1).describe()
    rings = log_polar(n_sectors=360, r_min_um=30.0, r_max_um=60.0).describe()

    assert trenched.fill_factor == pytest.approx(0.81, abs=1e-3)
    assert rings.fill_factor == pytest.approx(1 - (30 / rings.bounds_um[2]) ** 2, rel=1e-3)


def test_table_contains_all_fields():
    layout = mosaic(grid(n_x=20, n_y=10, pitch_um=2.0), "bayer")
    readout = Readout(frames_per_s=60.0, bits=12, blanking=0.25, n_lanes=2)
    text = render(layout.describe(readout))

    assert "200" in text
    assert "0: 50, 1: 100, 2: 50" in text
    assert "90 kbit/s" in text
    assert "on each of 2 lanes (60 frames/s, 12 bits, 25 % blanking)" in text
    assert "█" in text
    assert str(layout.describe()).splitlines()[1] == "photosites: 200"


def test_histogram_contains_all_sites():
    rng = np.random.default_rng(1)
    layout = fs.Layout.from_rectangles(100.0 * rng.random((500, 2)), 10.0 ** rng.uniform(-2, 1, 500))
    records = layout.describe().records()

    assert sum(row["n_sites"] for row in records) == 500
    assert all(a["to_um"] == b["from_um"] for a, b in pairwise(records))
    ratios = [row["to_um"] / row["from_um"] for row in records]
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-9)


def test_describe_rejects_invalid_input():
    with pytest.raises(GeometryError, match="the layout has no sites"):
        describe(ZONES[[]])
    with pytest.raises(ParameterError, match="'readout' must be a Readout"):
        describe(ZONES, 30.0)


# -- order and selection ---------------------------------------------------------------------------------------------


def test_sort_by_accepts_columns_and_values():
    layout = grid(n_x=3, n_y=2, pitch_um=1.0).with_columns(name=np.array(list("fdbeca")))

    assert layout.sort_by("name").columns["name"].tolist() == list("abcdef")
    assert layout.sort_by("name", descending=True).columns["name"].tolist() == list("fedcba")
    assert layout.sort_by("column", "row").readout_line.tolist() == [0, 0, 1, 1, 2, 2]
    reordered = layout.sort_by(-layout.centroid_um[:, 1], layout.centroid_um[:, 0])
    assert reordered.columns["row"].tolist() == [1, 1, 1, 0, 0, 0]
    assert reordered.provenance["steps"][-1] == "sorted by values, values"
    assert reordered.provenance["generator"] == "grid"


def test_sorting_is_stable():
    layout = ZONES.sort_by("zone", descending=True)
    zone = layout.columns["zone"]

    assert zone.tolist() == sorted(ZONES.columns["zone"].tolist(), reverse=True)
    for k in range(4):
        assert layout[zone == k].xy_um.tolist() == ZONES[ZONES.columns["zone"] == k].xy_um.tolist()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ((), "'keys' must be one or more columns or arrays"),
        (("nothing",), "'keys' must be values or columns of the layout, got 'nothing'; possible: "),
        (([1, 2],), "'keys' must have one value for each of the 13312 sites"),
    ],
)
def test_invalid_sort_key_raises(keys, message):
    with pytest.raises(ParameterError, match=message):
        ZONES.sort_by(*keys)


def test_selection_by_function_of_layout():
    small = ZONES[lambda layout: layout.area_um2 < 3.0]

    assert small.n_sites == 4096
    assert small.area_um2.max() == 1.0


# -- readout and routing ---------------------------------------------------------------------------------------------


def test_data_rate_matches_published_value():
    assert Readout(frames_per_s=30, bits=10, blanking=0.2).gbit_per_s(2592 * 1944) == pytest.approx(1.814, abs=5e-4)
    assert Readout(frames_per_s=30, bits=10, blanking=0.2, n_lanes=4).gbit_per_s(2592 * 1944) == pytest.approx(
        0.4535, abs=5e-4
    )


def test_all_lines_cross_first_ring():
    layout = log_polar(n_sectors=120, r_min_um=20.0, r_max_um=90.0)
    found = track_demand(layout, Routing(width_um=0.14, space_um=0.14))
    first_um = np.hypot(*layout.xy_um[: layout.ring_offsets[1]].T).max()

    assert found.n_nets.tolist() == [120]
    assert found.position_um == pytest.approx(first_um)
    assert found.n_tracks.tolist() == [math.floor(2 * math.pi * first_um / 0.28)]
    assert sorted(found.first_sites.tolist()) == list(range(120))


@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")  # large ratios end below r_max_um
@settings(max_examples=examples(40))
@given(
    n_sectors=st.integers(10, 40),
    fovea=st.sampled_from(["none", "rings", "linear", "hexagons"]),
    pitch_um=st.floats(0.2, 3.0),
    n_layers=st.integers(1, 3),
)
def test_track_demand_agrees_with_counting(n_sectors, fovea, pitch_um, n_layers):
    layout = log_polar(n_sectors=n_sectors, min_size_um=2.0, r_max_um=2.0 * n_sectors, fovea=fovea)
    routing = Routing(width_um=0.5 * pitch_um, space_um=0.5 * pitch_um, n_layers=n_layers)
    found = track_demand(layout, routing)
    ends = {}
    for polygon, line in zip(layout.polygons(), layout.readout_line.tolist(), strict=True):
        end_um = max(math.hypot(x, y) for x, y in polygon.exterior.coords)
        ends[line] = min(ends.get(line, math.inf), end_um)

    assert found.n_nets[-1] == len(ends)
    for position_um, n_nets, n_tracks in zip(found.position_um, found.n_nets, found.n_tracks, strict=True):
        assert n_nets == sum(end_um <= position_um + 1e-5 for end_um in ends.values())
        assert n_tracks == n_layers * int(2 * math.pi * position_um / pitch_um + 1e-9)


def test_upward_columns_cross_layout_width():
    layout = grid(n_x=50, n_y=4, pitch_um=1.0)
    found = track_demand(layout, Routing(width_um=0.25, space_um=0.25, n_layers=2, direction="upwards"))

    assert (found.position_um.tolist(), found.n_nets.tolist(), found.n_tracks.tolist()) == ([-1.0], [50], [200])


def test_routing_requires_readout_lines():
    with pytest.raises(ParameterError, match="'readout_line' must be a column of the layout"):
        track_demand(fs.Layout.from_polygons([shapely.box(0, 0, 1, 1)]), Routing(width_um=1.0, space_um=1.0))


@pytest.mark.parametrize(
    ("make", "values", "message"),
    [
        (Readout, {"frames_per_s": 0.0, "bits": 10}, "'frames_per_s' must be > 0"),
        (Readout, {"frames_per_s": 30.0, "bits": 0}, "'bits' must be >= 1"),
        (Readout, {"frames_per_s": 30.0, "bits": 10, "blanking": -0.1}, "'blanking' must be >= 0"),
        (Readout, {"frames_per_s": 30.0, "bits": 10, "n_lanes": 0}, "'n_lanes' must be >= 1"),
        (Routing, {"width_um": 0.0, "space_um": 1.0}, "'width_um' must be > 0"),
        (Routing, {"width_um": 1.0, "space_um": -1.0}, "'space_um' must be > 0"),
        (Routing, {"width_um": 1.0, "space_um": 1.0, "n_layers": 0}, "'n_layers' must be >= 1"),
        (Routing, {"width_um": 1.0, "space_um": 1.0, "direction": "in"}, "'direction' must be one of 'outwards'"),
    ],
)
def test_invalid_readout_or_routing_raises(make, values, message):
    with pytest.raises(ParameterError, match=message):
        make(**values)
