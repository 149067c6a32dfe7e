"""Colour filters and readout lines: published counts, exact fractions, distinct neighbours."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import MOSAICS, graph_colouring, mosaic, nearest_bus, random_channels, readout_by, readout_order

GRID = fs.layout.grid(n_x=12, n_y=12, pitch_um=1.0)
HEXAGONS = fs.layout.hexagonal(n_columns=20, n_rows=18, pitch_um=2.0)
RINGS = fs.layout.log_polar(n_sectors=30, r_min_um=4.0, r_max_um=50.0, stagger=True)


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("bayer", [36, 72, 36]),
        ("quad_bayer", [36, 72, 36]),
        ("nona", [36, 72, 36]),
        ("x_trans", [32, 80, 32]),
        ("rgbw", [36] * 4),
    ],
)
def test_named_mosaics_have_published_counts(name, counts):
    assert np.bincount(mosaic(GRID, name).channel).tolist() == counts


@pytest.mark.parametrize(
    ("letters", "names", "top"),
    [
        ("RGGB", "RGB", "RG"),
        ("BGGR", "RGB", "BG"),
        ("GRBG", "RGB", "GR"),
        ("RCCB", "RBC", "RC"),
        ("RGBW", "RGBW", "RG"),
    ],
)
def test_letters_are_read_from_top_left(letters, names, top):
    channel = mosaic(GRID, letters).channel.reshape(12, 12)

    assert "".join(names[k] for k in channel[-1, :2]) == top
    assert "".join(names[k] for k in [*channel[1, :2], *channel[0, :2]]) == letters
    assert np.array_equal(channel, np.tile(channel[:2, :2], (6, 6)))


def test_first_letter_is_filter_at_top_left():
    odd = fs.layout.grid(n_x=5, n_y=5, pitch_um=2.0)
    top_first = odd.with_columns(row=4 - odd.columns["row"])
    bare = fs.Layout.from_polygons(odd.polygons())
    cropped = odd[(odd.columns["row"] > 0) & (odd.columns["column"] > 0)]

    for layout in (odd, top_first, bare):
        channel = mosaic(layout, "RGGB").channel.reshape(5, 5)
        assert channel[::-1].tolist() == [[0, 1, 0, 1, 0], [1, 2, 1, 2, 1]] * 2 + [[0, 1, 0, 1, 0]]
    assert mosaic(cropped, "RGGB").channel.reshape(4, 4)[-1].tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(("name", "side"), [("spectral_16", 4), ("spectral_25", 5)])
def test_spectral_block_has_different_filters(name, side):
    channel = mosaic(fs.layout.grid(n_x=2 * side, n_y=side, pitch_um=1.0), name).channel.reshape(side, 2 * side)

    assert channel[::-1, :side].ravel().tolist() == list(range(side**2))
    assert np.array_equal(channel[:, side:], channel[:, :side])


def test_x_trans_lines_contain_all_colours():
    channel = mosaic(GRID, "x_trans").channel.reshape(12, 12)

    assert all(set(line) == {0, 1, 2} for line in [*channel, *channel.T])


def test_binned_quad_bayer_is_bayer():
    binned = fs.layout.merge(mosaic(GRID, "quad_bayer"), GRID.columns["row"] // 2 * 6 + GRID.columns["column"] // 2)

    assert binned.channel.reshape(6, 6)[:2, :2].tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize("fractions", [(1, 2, 1), (1, 1, 1, 1), (0.3, 0.0, 0.7)])
def test_random_channels_have_exact_fractions(fractions):
    layout = random_channels(RINGS, fractions, seed=3)
    counts = np.bincount(layout.channel, minlength=len(fractions))

    assert np.abs(counts - np.array(fractions) / sum(fractions) * RINGS.n_sites).max() < 1
    assert np.array_equal(random_channels(RINGS, fractions, seed=3).channel, layout.channel)
    assert not np.array_equal(random_channels(RINGS, fractions, seed=4).channel, layout.channel)


@pytest.mark.parametrize(("layout", "n_channels"), [(GRID, 2), (HEXAGONS, 3), (RINGS, 4)])
def test_graph_colouring_separates_neighbours(layout, n_channels):
    coloured = graph_colouring(layout, n_channels)
    pairs = coloured.adjacency().tocoo()
    a, b = pairs.coords

    assert np.all(coloured.channel[a] != coloured.channel[b])
    assert np.bincount(coloured.channel).min() > 0.8 * layout.n_sites / n_channels - 15


def test_graph_colouring_balances_isolated_sites():
    isolated = fs.layout.grid(n_x=6, n_y=1, pitch_um=3.0, width_um=1.0)

    assert np.bincount(graph_colouring(isolated, 3).channel).tolist() == [2, 2, 2]


def test_nearest_bus_assigns_ordered_sites():
    buses = [shapely.LineString([(x, -10), (x, 10)]) for x in (-3.0, 3.0)]
    layout = nearest_bus(GRID, buses)

    assert np.array_equal(layout.readout_line, (GRID.centroid_um[:, 0] > 0).astype(int))
    for line in (0, 1):
        is_on_line = layout.readout_line == line
        order = np.argsort(layout.columns["readout_order"][is_on_line])
        y_um = layout.centroid_um[is_on_line][order, 1]
        assert sorted(layout.columns["readout_order"][is_on_line]) == list(range(72))
        assert np.all(np.diff(y_um) < 1e-9)  # the top site first


def test_readout_by_column_uses_its_indices():
    assert np.array_equal(readout_by(RINGS, "ring").readout_line, RINGS.columns["ring"])
    assert readout_order(GRID).columns["readout_order"].tolist() == (11 - GRID.columns["row"]).tolist()


@pytest.mark.parametrize("column", [None, "row", "column"])
def test_rows_are_read_from_top(column):
    layout = readout_by(GRID, column)

    assert layout.columns["readout_order"].tolist() == (11 - GRID.columns["row"]).tolist()
    assert layout.readout_line.tolist() == GRID.columns[column or "column"].tolist()


@pytest.mark.parametrize(
    ("scan", "axis", "sign", "lines"),
    [
        ("rows_from_top", 1, -1, "column"),
        ("rows_from_bottom", 1, 1, "column"),
        ("columns_from_left", 0, 1, "row"),
        ("columns_from_right", 0, -1, "row"),
    ],
)
def test_scan_orders_rows_and_columns(scan, axis, sign, lines):
    bare = fs.Layout.from_polygons(GRID.polygons())
    top_first = GRID.with_columns(row=11 - GRID.columns["row"])
    disc = GRID[np.hypot(*GRID.centroid_um.T) < 0.4 * np.ptp(GRID.centroid_um)]
    for layout in (GRID, bare, top_first, disc):
        found = readout_by(layout, scan=scan)
        position_um = sign * layout.centroid_um[:, axis]
        assert np.allclose(found.columns["readout_order"], (position_um - position_um.min()) / 1.0)
        if lines in layout.columns:
            assert np.array_equal(found.readout_line, layout.columns[lines])
    along = readout_order(GRID.with_columns(readout_line=GRID.columns[lines]), scan=scan).columns["readout_order"]
    assert np.array_equal(along, readout_by(GRID, scan=scan).columns["readout_order"])


def test_sites_without_rows_are_read_in_strips():
    bounds_um = np.concatenate((RINGS.site_bounds_um[:, :2].min(axis=0), RINGS.site_bounds_um[:, 2:].max(axis=0)))
    pitch_um = np.sqrt(np.prod(bounds_um[2:] - bounds_um[:2]) / RINGS.n_sites)
    order = readout_by(RINGS).columns["readout_order"]
    strip = np.floor((RINGS.centroid_um[:, 1] - bounds_um[1]) / pitch_um)

    assert np.array_equal(order, strip.max() - strip)
    # A column of equal numbers does not contain rows.
    assert np.array_equal(
        readout_by(RINGS.with_columns(row=np.zeros(RINGS.n_sites, int))).columns["readout_order"], order
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mosaic(GRID, "bayer", names="RRGB"), "'names' must not contain a letter twice"),
        (lambda: mosaic(GRID, "RGGX"), "'block' must use letters of colours, R, G, .* got 'X'; pass names='RGX'"),
        (lambda: mosaic(GRID, "XXXX"), "'block' must use letters of colours, .* got 'X'"),
        (lambda: mosaic(GRID, ("rg", "gb")), "got 'b', 'g', 'r'"),
        (lambda: random_channels(GRID, (0, 0), seed=0), "'fractions' must not all be 0"),
        (lambda: random_channels(GRID, (1, -1), seed=0), "'fractions' must be >= 0"),
        (lambda: graph_colouring(GRID, 0), "'n_channels' must be >= 1"),
        (lambda: nearest_bus(GRID, []), "'buses' must be one or more shapely geometries"),
        (lambda: readout_by(GRID, "spoke"), "'spoke' must be a column of the layout"),
    ],
)
def test_invalid_argument_raises_with_name(call, message):
    with pytest.raises(ParameterError, match=message):
        call()


def test_named_blocks_are_rectangular():
    assert all(len({len(row) for row in block}) == 1 for block in MOSAICS.values())


def filters_of(*names):
    return fs.FilterSet([fs.sensor.ConstantCurve(0.5)] * len(names), names or None)


@pytest.mark.parametrize(
    ("block", "names", "filters"),
    [
        ("RGGB", None, ("red", "green", "blue")),
        ("RGGB", None, ("R", "G1", "B")),
        ("RRRR", None, ("red", "green", "blue")),
        ("RCCB", None, ("red", "blue", "clear")),
        ("rgbw", None, ("red", "green", "blue", "panchromatic")),
        ("RGGB", "RGB", ("long", "medium", "short")),
        ("RGGX", "RXG", ("red", "infrared", "green")),
        ("ABCD", None, ("blue", "green", "red", "infrared")),
    ],
)
def test_filters_with_names_of_letters_are_accepted(block, names, filters):
    sensor = fs.Sensor(mosaic(GRID, block, names), filters=filters_of(*filters))

    assert sensor.n_filters == len(filters)


@pytest.mark.parametrize(
    ("block", "filters", "message"),
    [
        ("RCCB", ("red", "clear", "blue"), "letters RBC, but filter 1 of the sensor is 'clear', not of the colour 'B'"),
        ("RGGB", ("cyan", "magenta", "yellow"), "filter 0 of the sensor is 'cyan', not of the colour 'R'"),
        ("ABBA", ("red", "green", "blue"), "filter 0 of the sensor is 'red', not of the colour 'A'"),
    ],
)
def test_filters_of_other_colours_are_rejected(block, filters, message, tmp_path):
    mosaic(GRID, block).write(tmp_path / "mosaic.npz")
    for layout in (
        mosaic(GRID, block),
        mosaic(GRID, block)[:40].translate(1.0, 0.0),
        fs.read_layout(tmp_path / "mosaic.npz"),
    ):
        with pytest.raises(SimulationError, match=message):
            fs.Sensor(layout, filters=filters_of(*filters))
        fs.Sensor(layout, filters=fs.FilterSet(filters_of(*filters).curves))  # without names, the order counts
        fs.Sensor(layout.with_columns(channel=layout.channel), filters=filters_of(*filters))
