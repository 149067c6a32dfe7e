"""Integrator: comparison with clipped polygons, closed forms, conservation and symmetry, the last also at second order."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.clipping import exact_weights, shapely_weights
from reference.polygons import POLYGONS, polygons
from reference.tilings import TILINGS, tiling

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.integrate import _plan

SHAPE = (7, 9)
GRID = fs.Grid(SHAPE, 1.0)
MAP = np.random.default_rng(5).uniform(0.5, 1.5, SHAPE)
#: Relative tolerance of exact results.
EXACT = 1e-11

FAMILIES = tuple(name for name in TILINGS if name != "log_polar with fovea")

ORDERS = pytest.mark.parametrize("order", [1, 2])


@cache
def zoo_weights(name):
    return exact_weights(POLYGONS[name], SHAPE)


def weights_of(polygon, grid=GRID, order=1):
    layout = fs.Layout.from_polygons([polygon])
    return fs.Integrator(layout, grid, order=order).weights().toarray().reshape(grid.shape)


@pytest.mark.parametrize("name", POLYGONS)
def test_zoo_weights_equal_rational_clipping(name):
    expected = zoo_weights(name)

    assert weights_of(POLYGONS[name]) == pytest.approx(expected, rel=EXACT, abs=1e-15)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("name", POLYGONS)
def test_zoo_sums_equal_rational_clipping(name, compiled):
    expected = float((zoo_weights(name) * MAP).sum())
    layout = fs.Layout.from_polygons([POLYGONS[name]])

    assert fs.Integrator(layout, GRID, compiled=compiled)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=0.0)


@settings(max_examples=examples(120))
@given(polygon=polygons(SHAPE))
def test_random_polygons_equal_rational_clipping(polygon):
    expected = float((exact_weights(polygon, SHAPE) * MAP).sum())
    layout = fs.Layout.from_polygons([polygon])

    for compiled in (True, False):
        assert fs.Integrator(layout, GRID, compiled=compiled)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=0.0)


@settings(max_examples=examples(450))
@given(polygon=polygons(SHAPE))
def test_random_polygons_agree_with_shapely_clipping(polygon):
    expected = float((shapely_weights(polygon, SHAPE) * MAP).sum())
    layout = fs.Layout.from_polygons([polygon])

    assert fs.Integrator(layout, GRID)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=0.0)


def test_half_overlapped_square_has_textbook_weights():
    weights = weights_of(shapely.box(0.5, 0.5, 2.5, 2.5), fs.Grid((3, 3), 1.0))

    assert weights.tolist() == [[0.25, 0.5, 0.25], [0.5, 1.0, 0.5], [0.25, 0.5, 0.25]]


@pytest.mark.parametrize("name", FAMILIES)
def test_tiling_weights_sum_to_cell_area(name):
    grid = fs.Grid((40, 40), 0.317, (-0.5 * 40 * 0.317, -0.5 * 40 * 0.317))
    layout = tiling(name)
    cell_sums = np.asarray(fs.Integrator(layout, grid).weights().sum(axis=0)).reshape(grid.shape)
    x0, y0 = np.meshgrid(grid.x_um - grid.pitch_um / 2, grid.y_um - grid.pitch_um / 2)
    cells = shapely.box(x0, y0, x0 + grid.pitch_um, y0 + grid.pitch_um)
    is_covered = shapely.covers(shapely.union_all(layout.polygons()).buffer(-1e-9), cells)

    assert is_covered.sum() > 100
    assert np.abs(cell_sums[is_covered] / grid.cell_area_um2 - 1).max() <= 1e-12


@pytest.mark.parametrize("name", FAMILIES)
def test_operator_rows_sum_to_site_area(name):
    layout = tiling(name)
    integrator = fs.Integrator(layout, fs.Grid((60, 60), 0.31, (-9.3, -9.3)))
    row_sums = np.asarray(integrator.weights().sum(axis=1)).ravel()

    assert row_sums == pytest.approx(shapely.area(layout.polygons()), rel=1e-12)
    assert integrator.uncovered_um2.max() == 0.0


@pytest.mark.parametrize("name", FAMILIES)
def test_uniform_map_yields_covered_site_area(name):
    layout = tiling(name)
    grid = fs.Grid((23, 31), 0.25, (-2.0, -1.5))  # covers every layout only partly
    on_map_um2 = shapely.area(shapely.intersection(layout.polygons(), shapely.box(*grid.bounds_um)))
    integrator = fs.Integrator(layout, grid)

    assert integrator(np.full(grid.shape, 3.0)) == pytest.approx(3.0 * on_map_um2, rel=EXACT, abs=1e-13)
    assert integrator.uncovered_um2 == pytest.approx(shapely.area(layout.polygons()) - on_map_um2, abs=1e-12)


@pytest.mark.parametrize(("order", "rel"), [(1, 1e-14), (2, 1e-12)])
@pytest.mark.parametrize("name", POLYGONS)
def test_matrix_product_equals_integrator_call(name, order, rel):
    integrator = fs.Integrator(fs.Layout.from_polygons([POLYGONS[name]]), GRID, order=order)

    assert integrator(MAP) == pytest.approx(integrator.weights() @ MAP.ravel(), rel=rel, abs=1e-15)


def test_spread_equals_matrix_transpose():
    integrator = fs.Integrator(tiling("log_polar"), fs.Grid((70, 50), 0.2, (-5.0, -7.0)))
    values = np.random.default_rng(1).normal(size=(2, integrator.n_sites))

    assert integrator.spread(values).reshape(2, -1) == pytest.approx(values @ integrator.weights().toarray(), abs=1e-13)


@ORDERS
@pytest.mark.parametrize("name", ["star", "two holes in a row", "off to the left and right", "U shape"])
def test_weights_ignore_winding_and_start_vertex(name, order):
    polygon = POLYGONS[name]
    reordered = shapely.Polygon(
        np.roll(polygon.exterior.coords[:-1], 2, axis=0)[::-1],
        [np.roll(h.coords[:-1], 1, axis=0) for h in polygon.interiors],
    )

    assert weights_of(reordered, order=order) == pytest.approx(weights_of(polygon, order=order), abs=1e-15)


@pytest.mark.parametrize("name", ["star", "two holes in a row", "comb with teeth in one row", "ring"])
def test_integer_cell_shift_shifts_weights(name):
    shifted = shapely.transform(POLYGONS[name], lambda xy: xy + np.array([16.0, 8.0]))
    grid = fs.Grid((15, 25), 1.0)

    assert weights_of(shifted, grid)[8:, 16:] == pytest.approx(weights_of(POLYGONS[name]), abs=4e-15)


@ORDERS
@pytest.mark.parametrize("name", ["star", "L shape", "hole", "long sliver along a row", "off to the left and right"])
def test_quarter_rotation_rotates_weights(name, order):
    rotated = shapely.transform(POLYGONS[name], lambda xy: np.stack((7.0 - xy[:, 1], xy[:, 0]), axis=1))

    assert weights_of(rotated, fs.Grid((9, 7), 1.0), order) == pytest.approx(
        np.rot90(weights_of(POLYGONS[name], order=order), -1), abs=1e-14
    )


@ORDERS
@pytest.mark.parametrize("name", ["star", "circle", "U shape", "hole"])
def test_split_site_parts_add_up(name, order):
    knife = shapely.Polygon([(-20, -20), (30, -20), (30, 4.1), (-20, 2.3)])
    lower = shapely.get_parts(shapely.intersection(POLYGONS[name], knife))
    upper = shapely.get_parts(shapely.difference(POLYGONS[name], knife))
    unsplit = fs.Integrator(fs.Layout.from_polygons([POLYGONS[name]]), GRID, order=order)(MAP)[0]
    parts = fs.Integrator(fs.Layout.from_polygons([*lower, *upper]), GRID, order=order)(MAP)

    assert parts.sum() == pytest.approx(unsplit, rel=EXACT)


@settings(max_examples=examples(50))
@given(
    pitch_um=st.floats(2.0, 1e3),
    x0=st.floats(-1e4, 1e4),
    y0=st.floats(-1e4, 1e4),
    name=st.sampled_from(sorted(POLYGONS)),
)
def test_pitch_and_origin_scale_and_translate(pitch_um, x0, y0, name):
    moved = shapely.transform(POLYGONS[name], lambda xy: xy * pitch_um + np.array([x0, y0]))
    layout = fs.Layout.from_polygons([moved])
    # The rounding error of vertices at |x0| is |x0| / pitch x 2**-53 of a cell.
    rounding = 2.0**-50 * (1 + max(abs(x0), abs(y0)) / pitch_um)
    expected = fs.Integrator(fs.Layout.from_polygons([POLYGONS[name]]), GRID)(MAP)[0] * pitch_um**2

    got = fs.Integrator(layout, fs.Grid(SHAPE, pitch_um, (x0, y0)))(MAP)[0]

    assert got == pytest.approx(expected, rel=EXACT, abs=rounding * POLYGONS[name].length * 4 * pitch_um**2 + 1e-300)


@ORDERS
def test_float32_map_agrees_with_float64(order):
    integrator = fs.Integrator(tiling("hexagonal"), fs.Grid((50, 50), 0.25, (-6.0, -6.0)), order=order)
    cells = np.random.default_rng(2).random((50, 50), dtype=np.float32)

    assert integrator(cells) == pytest.approx(integrator(cells.astype(np.float64)), rel=1e-14, abs=1e-16)


def test_leading_dimensions_are_integrated_independently():
    integrator = fs.Integrator(tiling("zones"), fs.Grid((50, 50), 0.25, (-6.0, -6.0)))
    cells = np.random.default_rng(3).random((2, 3, 50, 50))

    together = integrator(cells)

    assert together.shape == (2, 3, integrator.n_sites)
    assert np.array_equal(together[1, 2], integrator(cells[1, 2]))


@pytest.mark.parametrize(
    "view", [np.asfortranarray, lambda a: a[::-1][::-1], lambda a: np.repeat(a, 2, axis=1)[:, ::2]]
)
def test_result_is_independent_of_memory_order(view):
    integrator = fs.Integrator(fs.Layout.from_polygons(list(POLYGONS.values())), GRID)

    assert np.array_equal(integrator(view(MAP)), integrator(MAP))


def test_integer_map_is_accepted():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 2, 2)])

    assert fs.Integrator(layout, GRID)(np.full(SHAPE, 7, np.int32))[0] == 28.0


@ORDERS
@pytest.mark.parametrize("n_threads", [2, 3, 8])
def test_results_are_bit_identical_across_threads(n_threads, order):
    grid = fs.Grid.centred((700, 900), 0.5)
    layout = fs.layout.log_polar(n_sectors=120, r_min_um=3.0, r_max_um=160.0)
    cells = np.random.default_rng(4).random(grid.shape, dtype=np.float32)

    one, many = (fs.Integrator(layout, grid, order=order, n_threads=n) for n in (1, n_threads))

    assert np.array_equal(many(cells), one(cells))
    assert np.array_equal(many.spread(np.arange(layout.n_sites)), one.spread(np.arange(layout.n_sites)))


def test_result_is_independent_of_piece_size(monkeypatch):
    grid = fs.Grid.centred((300, 300), 0.1)
    cells = np.random.default_rng(6).random(grid.shape)
    expected = fs.Integrator(tiling("log_polar"), grid)(cells)

    monkeypatch.setattr(_plan, "SITES_PER_PIECE", 7)
    monkeypatch.setattr(_plan, "MIN_ROWS_PER_BAND", 3)
    monkeypatch.setattr(_plan, "SMALL_MAP", 0)

    assert fs.Integrator(tiling("log_polar"), grid)(cells) == pytest.approx(expected, rel=1e-13)


@ORDERS
def test_dark_site_is_precise_near_bright_cells(order):
    cells = np.full((8, 400), 1.0)
    cells[:, :200] = 1e12
    layout = fs.Layout.from_polygons([shapely.box(300.25, 2.25, 380.5, 6.5)])

    power = fs.Integrator(layout, fs.Grid((8, 400), 1.0), order=order)(cells)

    assert power[0] == pytest.approx(80.25 * 4.25, rel=1e-14)


def test_nan_reaches_overlapping_sites_only():
    cells = np.ones((10, 200))
    cells[5, 50] = np.nan
    layout = fs.Layout.from_rectangles([[50.5, 5.5], [150.0, 5.5]], [3.0, 80.0])
    power = fs.Integrator(layout, fs.Grid((10, 200), 1.0))(cells)

    assert np.isnan(power[0])
    assert power[1] == pytest.approx(80 * 10)


def test_adjacent_nan_does_not_affect_site():
    layout = fs.Layout.from_rectangles([[1.5, 1.5]], 1.0)
    integrator = fs.Integrator(layout, fs.Grid((3, 3), 1.0))
    cells = np.full((3, 3), np.nan)
    cells[1, 1] = 2.0

    assert integrator(cells)[0] == 2.0
    assert integrator.weights().nnz == 1


@pytest.mark.parametrize("angle_deg", [0, 180])
def test_comb_with_many_edges_is_exact(angle_deg):
    """Many edges cross each row, in ascending column order at 0° and in descending order at 180°."""
    x = np.arange(1000) * 7.0 + 1.3
    finger = np.array([[0, 90.2], [3.1, 90.2], [3.1, 5.7], [7.0, 5.7]])
    teeth = (finger + np.stack((x, np.zeros(1000)), axis=1)[:, np.newaxis]).reshape(-1, 2)
    ring = np.concatenate((teeth, [[x[-1] + 7.0, 2.5], [1.3, 2.5]]))
    comb = fs.Layout.from_polygons([shapely.Polygon(ring)]).rotate(angle_deg, (3510.0, 50.0))
    integrator = fs.Integrator(comb, fs.Grid((100, 7020), 1.0))

    # Back of height 3.2 and fingers of height 84.5 and width 3.1.
    assert integrator(np.ones((100, 7020)))[0] == pytest.approx(1000 * (7.0 * 3.2 + 3.1 * 84.5), rel=1e-11)


def test_almost_vertical_edge_counts_as_vertical():
    layout = fs.Layout.from_polygons([shapely.Polygon([(0, 0), (1, 0), (1, 1), (1e-310, 1)])])

    assert fs.Integrator(layout, fs.Grid((2, 2), 1.0))(np.ones((2, 2)))[0] == 1.0


def test_rounding_adds_no_weights_outside():
    angle = np.linspace(0, 2 * np.pi, 100_000, endpoint=False)
    ring = np.stack((1002.0 + 2.0 * np.cos(angle), 0.5 + 0.4 * np.sin(angle)), axis=1)
    layout = fs.Layout.from_polygons([shapely.Polygon(ring)])
    weights = fs.Integrator(layout, fs.Grid((1, 1200), 1.0)).weights().tocoo()

    assert weights.coords[1].min() == 1000
    assert weights.sum() == pytest.approx(np.pi * 0.8, rel=1e-8)


def test_small_sites_far_away_are_covered():
    rng = np.random.default_rng(8)
    grid = fs.Grid((400, 8000), 0.37, (-1500.0, -100.0))
    centre = rng.uniform((-1499, -99), (1400, 40), (2000, 2))

    assert fs.Integrator(fs.Layout.from_rectangles(centre, 0.01), grid).uncovered_um2.max() == 0.0


def test_integrator_rejects_clockwise_outline():
    layout = fs.Layout(np.array([[0.0, 0], [0, 1], [1, 1], [1, 0]]), np.array([0, 4]), np.array([0, 1]))

    with pytest.raises(GeometryError, match="the outline of site 0 must be counter-clockwise with a positive area"):
        fs.Integrator(layout, GRID)


@pytest.mark.parametrize(
    ("layout", "grid", "message"),
    [
        (GRID, "grid", "'layout' must be a Layout or packed rings, got a Grid"),
        ([shapely.box(0, 0, 1, 1)], GRID, "'layout' must be a Layout or packed rings, got a list"),
        ("grid", (7, 9), "'grid' must be a Grid, got a tuple"),
    ],
)
def test_integrator_rejects_swapped_or_wrong_arguments(layout, grid, message):
    layout, grid = (tiling("grid") if argument == "grid" else argument for argument in (layout, grid))

    with pytest.raises(ParameterError, match=message):
        fs.Integrator(layout, grid)


def test_many_edges_in_one_cell_add_up():
    ring = shapely.Point(3.5, 3.5).buffer(0.4, quad_segs=3000)

    assert weights_of(ring).sum() == pytest.approx(ring.area, rel=1e-12)
    assert np.count_nonzero(weights_of(ring)) == 1


def test_layout_without_sites_yields_empty_result():
    empty = tiling("grid")[np.zeros(13 * 11, bool)]
    integrator = fs.Integrator(empty, GRID)

    assert integrator(MAP).shape == (0,)
    assert integrator.weights().shape == (0, MAP.size)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (np.ones((7, 8)), r"'power_map' must have the shape .* \(7, 9\), got \(7, 8\)"),
        (np.ones(63), r"'power_map' must have the shape"),
        (np.ones(SHAPE, complex), r"'power_map' must contain real numbers, got the dtype complex128"),
        (np.full(SHAPE, "a"), r"'power_map' must contain real numbers"),
    ],
)
def test_integrator_rejects_mismatched_map(cells, message):
    with pytest.raises(ParameterError, match=message):
        fs.Integrator(tiling("grid"), GRID)(cells)


@pytest.mark.parametrize("n_threads", [0, -1, 1.5, "two"])
def test_integrator_rejects_invalid_thread_count(n_threads):
    with pytest.raises(ParameterError, match="'n_threads' must be"):
        fs.Integrator(tiling("grid"), GRID, n_threads=n_threads)
