"""The integrator against clipped polygons, closed forms, conservation and symmetry."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.clipping import exact_weights, shapely_weights
from reference.polygons import ZOO, polygons

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.integrate import _plan

SHAPE = (7, 9)
GRID = fs.Grid(SHAPE, 1.0)
MAP = np.random.default_rng(5).uniform(0.5, 1.5, SHAPE)
#: Exact up to this fraction of the result.
EXACT = 1e-11

TILINGS = {
    "grid": fs.layout.grid(n_x=13, n_y=11, pitch_um=0.77),
    "hexagonal": fs.layout.hexagonal(n_columns=12, n_rows=13, pitch_um=0.9),
    "hexagonal flat": fs.layout.hexagonal(n_columns=11, n_rows=12, pitch_um=1.1, orientation="flat"),
    "log_polar": fs.layout.log_polar(n_sectors=24, r_min_um=0.2, r_max_um=4.7),
    "log_polar staggered, odd chords": fs.layout.log_polar(
        n_sectors=20, r_min_um=0.4, r_max_um=5.5, stagger=True, chords_per_arc=3
    ),
    "zones": fs.layout.zones(side_um=(1.4, 4.2, 9.8), pitch_um=(0.35, 0.7, 1.4)),
    "octagonal": fs.layout.octagonal(n_x=9, n_y=9, pitch_um=1.1, border="cut"),
    "giotto": fs.layout.giotto(n_rho=12, n_theta=40, n_fovea=5, n_across=40, unit_um=0.25),
    "fovi": fs.layout.fovi(fov_um=9.0, a_um=0.5, n_rings=14),
    "foveal_cartesian": fs.layout.foveal_cartesian(n_rings=7, ring_ratio=1.4, pitch_um=0.4, n_fovea=3),
    "sunflower": fs.layout.sunflower(n_sites=250, spacing_um=0.6),
    "voronoi": fs.layout.voronoi(n_sites=200, size_um=(9.0, 9.0), n_iterations=3).translate(0.1, 0.1),
    "quadtree": fs.layout.quadtree(np.random.default_rng(1).random((32, 32)), pitch_um=0.3, limit=9.0, n_levels=5),
    "penrose": fs.layout.penrose(side_um=0.9, size_um=10.0),
}


def weights_of(polygon, grid=GRID):
    layout = fs.Layout.from_polygons([polygon])
    return fs.Integrator(layout, grid).weights().toarray().reshape(grid.shape)


@pytest.mark.parametrize("name", ZOO)
def test_zoo_weights_are_those_of_rational_clipping(name):
    expected = exact_weights(ZOO[name], SHAPE)

    assert weights_of(ZOO[name]) == pytest.approx(expected, rel=EXACT, abs=1e-15)


@pytest.mark.parametrize("name", ZOO)
def test_zoo_sums_are_those_of_rational_clipping(name):
    expected = float((exact_weights(ZOO[name], SHAPE) * MAP).sum())
    layout = fs.Layout.from_polygons([ZOO[name]])

    assert fs.Integrator(layout, GRID)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=0.0)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(polygon=polygons(SHAPE))
def test_random_polygons_agree_with_rational_clipping(polygon):
    expected = float((exact_weights(polygon, SHAPE) * MAP).sum())
    layout = fs.Layout.from_polygons([polygon])

    assert fs.Integrator(layout, GRID)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=0.0)


@settings(max_examples=2500, deadline=None, derandomize=True)
@given(polygon=polygons(SHAPE))
def test_random_polygons_agree_with_clipping_by_shapely(polygon):
    expected = float((shapely_weights(polygon, SHAPE) * MAP).sum())
    layout = fs.Layout.from_polygons([polygon])

    assert fs.Integrator(layout, GRID)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=0.0)


def test_half_overlapped_square_has_its_textbook_weights():
    weights = weights_of(shapely.box(0.5, 0.5, 2.5, 2.5), fs.Grid((3, 3), 1.0))

    assert weights.tolist() == [[0.25, 0.5, 0.25], [0.5, 1.0, 0.5], [0.25, 0.5, 0.25]]


@pytest.mark.parametrize("name", TILINGS)
def test_weights_of_a_tiling_sum_to_the_cell_area_in_every_covered_cell(name):
    grid = fs.Grid((40, 40), 0.317, (-0.5 * 40 * 0.317, -0.5 * 40 * 0.317))
    layout = TILINGS[name]
    cell_sums = np.asarray(fs.Integrator(layout, grid).weights().sum(axis=0)).reshape(grid.shape)
    x0, y0 = np.meshgrid(grid.x_um - grid.pitch_um / 2, grid.y_um - grid.pitch_um / 2)
    cells = shapely.box(x0, y0, x0 + grid.pitch_um, y0 + grid.pitch_um)
    is_covered = shapely.covers(shapely.union_all(layout.polygons()).buffer(-1e-9), cells)

    assert is_covered.sum() > 100
    assert np.abs(cell_sums[is_covered] / grid.cell_area_um2 - 1).max() <= 1e-12


@pytest.mark.parametrize("name", TILINGS)
def test_rows_of_the_operator_sum_to_the_area_on_the_grid(name):
    layout = TILINGS[name]
    integrator = fs.Integrator(layout, fs.Grid((60, 60), 0.31, (-9.3, -9.3)))
    row_sums = np.asarray(integrator.weights().sum(axis=1)).ravel()

    assert row_sums == pytest.approx(shapely.area(layout.polygons()), rel=1e-12)
    assert integrator.uncovered_um2.max() == 0.0


@pytest.mark.parametrize("name", TILINGS)
def test_uniform_light_gives_each_site_its_area_on_the_map(name):
    layout = TILINGS[name]
    grid = fs.Grid((23, 31), 0.25, (-2.0, -1.5))  # much of every layout lies off it
    on_map_um2 = shapely.area(shapely.intersection(layout.polygons(), shapely.box(*grid.bounds_um)))
    integrator = fs.Integrator(layout, grid)

    assert integrator(np.full(grid.shape, 3.0)) == pytest.approx(3.0 * on_map_um2, rel=EXACT, abs=1e-13)
    assert integrator.uncovered_um2 == pytest.approx(shapely.area(layout.polygons()) - on_map_um2, abs=1e-12)


@pytest.mark.parametrize("name", ZOO)
def test_the_map_and_the_matrix_give_the_same(name):
    integrator = fs.Integrator(fs.Layout.from_polygons([ZOO[name]]), GRID)

    assert integrator(MAP) == pytest.approx(integrator.weights() @ MAP.ravel(), rel=1e-14, abs=1e-15)


def test_spread_is_the_transpose():
    integrator = fs.Integrator(TILINGS["log_polar"], fs.Grid((70, 50), 0.2, (-5.0, -7.0)))
    values = np.random.default_rng(1).normal(size=(2, integrator.n_sites))

    assert integrator.spread(values).reshape(2, -1) == pytest.approx(values @ integrator.weights().toarray(), abs=1e-13)


@pytest.mark.parametrize("name", ["star", "two holes in a row", "off to the left and right", "U shape"])
def test_winding_and_start_vertex_change_nothing(name):
    polygon = ZOO[name]
    turned = shapely.Polygon(
        np.roll(polygon.exterior.coords[:-1], 2, axis=0)[::-1],
        [np.roll(h.coords[:-1], 1, axis=0) for h in polygon.interiors],
    )

    assert weights_of(turned) == pytest.approx(weights_of(polygon), abs=1e-15)


@pytest.mark.parametrize("name", ["star", "two holes in a row", "comb with teeth in one row", "ring"])
def test_shifting_by_whole_cells_shifts_the_weights(name):
    shifted = shapely.transform(ZOO[name], lambda xy: xy + np.array([16.0, 8.0]))
    grid = fs.Grid((15, 25), 1.0)

    assert weights_of(shifted, grid)[8:, 16:] == pytest.approx(weights_of(ZOO[name]), abs=4e-15)


@pytest.mark.parametrize("name", ["star", "L shape", "hole", "long sliver along a row"])
def test_a_quarter_turn_turns_the_weights(name):
    turned = shapely.transform(ZOO[name], lambda xy: np.stack((7.0 - xy[:, 1], xy[:, 0]), axis=1))

    assert weights_of(turned, fs.Grid((9, 7), 1.0)) == pytest.approx(np.rot90(weights_of(ZOO[name]), -1), abs=1e-14)


@pytest.mark.parametrize("name", ["star", "circle", "U shape", "hole"])
def test_the_parts_of_a_split_site_add_up(name):
    knife = shapely.Polygon([(-20, -20), (30, -20), (30, 4.1), (-20, 2.3)])
    lower = shapely.get_parts(shapely.intersection(ZOO[name], knife))
    upper = shapely.get_parts(shapely.difference(ZOO[name], knife))
    whole = fs.Integrator(fs.Layout.from_polygons([ZOO[name]]), GRID)(MAP)[0]

    assert fs.Integrator(fs.Layout.from_polygons([*lower, *upper]), GRID)(MAP).sum() == pytest.approx(whole, rel=EXACT)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    pitch_um=st.floats(2.0, 1e3), x0=st.floats(-1e4, 1e4), y0=st.floats(-1e4, 1e4), name=st.sampled_from(sorted(ZOO))
)
def test_pitch_and_origin_only_scale_and_move(pitch_um, x0, y0, name):
    moved = shapely.transform(ZOO[name], lambda xy: xy * pitch_um + np.array([x0, y0]))
    layout = fs.Layout.from_polygons([moved])
    # Corners at |x0| have lost |x0| / pitch x 2**-53 of a cell.
    lost = 2.0**-50 * (1 + max(abs(x0), abs(y0)) / pitch_um)
    expected = fs.Integrator(fs.Layout.from_polygons([ZOO[name]]), GRID)(MAP)[0] * pitch_um**2

    got = fs.Integrator(layout, fs.Grid(SHAPE, pitch_um, (x0, y0)))(MAP)[0]

    assert got == pytest.approx(expected, rel=EXACT, abs=lost * ZOO[name].length * 4 * pitch_um**2 + 1e-300)


def test_float32_maps_are_read_as_they_are():
    integrator = fs.Integrator(TILINGS["hexagonal"], fs.Grid((50, 50), 0.25, (-6.0, -6.0)))
    cells = np.random.default_rng(2).random((50, 50), dtype=np.float32)

    assert integrator(cells) == pytest.approx(integrator(cells.astype(np.float64)), rel=1e-14, abs=1e-16)


def test_many_bands_are_done_one_by_one():
    integrator = fs.Integrator(TILINGS["zones"], fs.Grid((50, 50), 0.25, (-6.0, -6.0)))
    cells = np.random.default_rng(3).random((2, 3, 50, 50))

    together = integrator(cells)

    assert together.shape == (2, 3, integrator.n_sites)
    assert np.array_equal(together[1, 2], integrator(cells[1, 2]))


@pytest.mark.parametrize(
    "view", [np.asfortranarray, lambda a: a[::-1][::-1], lambda a: np.repeat(a, 2, axis=1)[:, ::2]]
)
def test_maps_of_any_memory_order_give_the_same(view):
    integrator = fs.Integrator(fs.Layout.from_polygons(list(ZOO.values())), GRID)

    assert np.array_equal(integrator(view(MAP)), integrator(MAP))


def test_whole_numbers_are_taken_as_a_map():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 2, 2)])

    assert fs.Integrator(layout, GRID)(np.full(SHAPE, 7, np.int32))[0] == 28.0


@pytest.mark.parametrize("n_threads", [2, 3, 8])
def test_results_do_not_depend_on_the_number_of_threads(n_threads):
    grid = fs.Grid.centred((700, 900), 0.5)
    layout = fs.layout.log_polar(n_sectors=120, r_min_um=3.0, r_max_um=160.0)
    cells = np.random.default_rng(4).random(grid.shape, dtype=np.float32)

    one = fs.Integrator(layout, grid, n_threads=1)
    many = fs.Integrator(layout, grid, n_threads=n_threads)

    assert np.array_equal(many(cells), one(cells))
    assert np.array_equal(many.spread(np.arange(layout.n_sites)), one.spread(np.arange(layout.n_sites)))


def test_pieces_of_work_do_not_change_the_plan(monkeypatch):
    grid = fs.Grid.centred((300, 300), 0.1)
    cells = np.random.default_rng(6).random(grid.shape)
    expected = fs.Integrator(TILINGS["log_polar"], grid)(cells)

    monkeypatch.setattr(_plan, "SITES_PER_PIECE", 7)
    monkeypatch.setattr(_plan, "MIN_ROWS_PER_BAND", 3)
    monkeypatch.setattr(_plan, "SMALL_MAP", 0)

    assert fs.Integrator(TILINGS["log_polar"], grid)(cells) == pytest.approx(expected, rel=1e-13)


def test_a_bright_neighbour_costs_a_dark_site_no_digits():
    cells = np.full((8, 400), 1.0)
    cells[:, :200] = 1e12
    layout = fs.Layout.from_polygons([shapely.box(300.25, 2.25, 380.5, 6.5)])

    assert fs.Integrator(layout, fs.Grid((8, 400), 1.0))(cells)[0] == pytest.approx(80.25 * 4.25, rel=1e-14)


def test_a_nan_stays_with_the_sites_that_see_it():
    cells = np.ones((10, 200))
    cells[5, 50] = np.nan
    layout = fs.Layout.from_rectangles([[50.5, 5.5], [150.0, 5.5]], [3.0, 80.0])
    power = fs.Integrator(layout, fs.Grid((10, 200), 1.0))(cells)

    assert np.isnan(power[0])
    assert power[1] == pytest.approx(80 * 10)


def test_a_nan_beside_a_site_is_none_of_its_business():
    layout = fs.Layout.from_rectangles([[1.5, 1.5]], 1.0)
    integrator = fs.Integrator(layout, fs.Grid((3, 3), 1.0))
    cells = np.full((3, 3), np.nan)
    cells[1, 1] = 2.0

    assert integrator(cells)[0] == 2.0
    assert integrator.weights().nnz == 1


@pytest.mark.parametrize("turn", [0, 180])
def test_a_comb_of_a_thousand_fingers_is_exact_either_way_up(turn):
    """Many edges cross each row, in ascending order of columns one way up and in descending the other."""
    x = np.arange(1000) * 7.0 + 1.3
    finger = np.array([[0, 90.2], [3.1, 90.2], [3.1, 5.7], [7.0, 5.7]])
    teeth = (finger + np.stack((x, np.zeros(1000)), axis=1)[:, np.newaxis]).reshape(-1, 2)
    ring = np.concatenate((teeth, [[x[-1] + 7.0, 2.5], [1.3, 2.5]]))
    comb = fs.Layout.from_polygons([shapely.Polygon(ring)]).rotate(turn, (3510.0, 50.0))
    integrator = fs.Integrator(comb, fs.Grid((100, 7020), 1.0))

    # A back of 3.2 and fingers of 84.5, each 3.1 wide.
    assert integrator(np.ones((100, 7020)))[0] == pytest.approx(1000 * (7.0 * 3.2 + 3.1 * 84.5), rel=1e-11)


def test_an_almost_vertical_edge_is_vertical():
    layout = fs.Layout.from_polygons([shapely.Polygon([(0, 0), (1, 0), (1, 1), (1e-310, 1)])])

    assert fs.Integrator(layout, fs.Grid((2, 2), 1.0))(np.ones((2, 2)))[0] == 1.0


def test_many_edges_in_a_row_leave_nothing_outside():
    angle = np.linspace(0, 2 * np.pi, 100_000, endpoint=False)
    ring = np.stack((1002.0 + 2.0 * np.cos(angle), 0.5 + 0.4 * np.sin(angle)), axis=1)
    layout = fs.Layout.from_polygons([shapely.Polygon(ring)])
    weights = fs.Integrator(layout, fs.Grid((1, 1200), 1.0)).weights().tocoo()

    assert weights.coords[1].min() == 1000
    assert weights.sum() == pytest.approx(np.pi * 0.8, rel=1e-8)


def test_small_sites_far_from_the_origin_are_wholly_covered():
    rng = np.random.default_rng(8)
    grid = fs.Grid((400, 8000), 0.37, (-1500.0, -100.0))
    centre = rng.uniform((-1499, -99), (1400, 40), (2000, 2))

    assert fs.Integrator(fs.Layout.from_rectangles(centre, 0.01), grid).uncovered_um2.max() == 0.0


def test_a_clockwise_outline_is_refused():
    layout = fs.Layout(np.array([[0.0, 0], [0, 1], [1, 1], [1, 0]]), np.array([0, 4]), np.array([0, 1]))

    with pytest.raises(GeometryError, match="site 0 has no positive area: its outline must be counter-clockwise"):
        fs.Integrator(layout, GRID)


@pytest.mark.parametrize(
    ("layout", "grid", "message"),
    [
        (GRID, TILINGS["grid"], "'layout' must be a Layout, or packed rings, got a Grid"),
        ([shapely.box(0, 0, 1, 1)], GRID, "'layout' must be a Layout, or packed rings, got a list"),
        (TILINGS["grid"], (7, 9), "'grid' must be a Grid, got a tuple"),
    ],
)
def test_swapped_or_wrong_arguments_are_refused(layout, grid, message):
    with pytest.raises(ParameterError, match=message):
        fs.Integrator(layout, grid)


def test_thousands_of_edges_in_one_cell_add_up():
    ring = shapely.Point(3.5, 3.5).buffer(0.4, quad_segs=3000)

    assert weights_of(ring).sum() == pytest.approx(ring.area, rel=1e-12)
    assert np.count_nonzero(weights_of(ring)) == 1


def test_a_layout_without_sites_gives_nothing():
    empty = TILINGS["grid"][np.zeros(TILINGS["grid"].n_sites, bool)]
    integrator = fs.Integrator(empty, GRID)

    assert integrator(MAP).shape == (0,)
    assert integrator.weights().shape == (0, MAP.size)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (np.ones((7, 8)), r"'power_map' must have the shape .* \(7, 9\), got \(7, 8\)"),
        (np.ones(63), r"'power_map' must have the shape"),
        (np.ones(SHAPE, complex), r"'power_map' must have real numbers, got the type complex128"),
        (np.full(SHAPE, "a"), r"'power_map' must have real numbers"),
    ],
)
def test_a_map_that_does_not_fit_is_refused_in_one_sentence(cells, message):
    with pytest.raises(ParameterError, match=message):
        fs.Integrator(TILINGS["grid"], GRID)(cells)


@pytest.mark.parametrize("n_threads", [0, -1, 1.5, "two"])
def test_a_number_of_threads_that_cannot_be_is_refused(n_threads):
    with pytest.raises(ParameterError, match="'n_threads' must be"):
        fs.Integrator(TILINGS["grid"], GRID, n_threads=n_threads)
