"""Second-order integration against rational clipping, closed forms, conservation, symmetry and diffraction patterns."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from reference.polygons import POLYGONS, polygons
from reference.tilings import tiling

import foveasim as fs
from foveasim.distortion import BrownConrady
from foveasim.errors import ParameterError
from foveasim.layout.model import layout_of

SHAPE = (7, 9)
GRID = fs.Grid(SHAPE, 1.0)
MAP = np.random.default_rng(5).uniform(0.5, 1.5, SHAPE)
#: Coefficients of a field a + b x + c y that is positive on the map.
LINEAR = (20.0, 1.3, -2.1)
EXACT = 1e-11
BARREL = BrownConrady(focal_um=200.0, k1=-0.12, k2=0.02, p1=0.03, p2=-0.02)

FAMILIES = ("hexagonal", "grid", "log_polar with fovea", "voronoi", "penrose")


def second(polygon, grid=GRID, **options):
    return fs.Integrator(fs.Layout.from_polygons([polygon]), grid, order=2, **options)


def weights_of(polygon, grid=GRID):
    return second(polygon, grid).weights().toarray().reshape(grid.shape)


# -- reference implementation: rational clipping ------------------------------------------------------------------------


def clip(ring, axis, bound, side):
    """Clip a ring to one side of a line (Sutherland and Hodgman) in rational arithmetic."""
    clipped = []
    for a, b in pairwise([*ring, ring[0]] if ring else []):
        a_in, b_in = side * (a[axis] - bound) >= 0, side * (b[axis] - bound) >= 0
        if a_in:
            clipped.append(a)
        if a_in != b_in:
            t = (bound - a[axis]) / (b[axis] - a[axis])
            clipped.append((a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])))
    return clipped


def integrals(ring):
    """Return ∬ 1, ∬ x and ∬ y over a ring, independent of its winding."""
    area = x_sum = y_sum = Fraction(0)
    for a, b in pairwise([*ring, ring[0]] if ring else []):
        cross = a[0] * b[1] - b[0] * a[1]
        area += cross / 2
        x_sum += cross * (a[0] + b[0]) / 6
        y_sum += cross * (a[1] + b[1]) / 6
    return (area, x_sum, y_sum) if area >= 0 else (-area, -x_sum, -y_sum)


def exact_integrals(polygon, bands):
    """Return the same integrals over a polygon clipped to rectangles (x0, y0, x1, y1)."""
    rings = [
        [(Fraction(float(x)), Fraction(float(y))) for x, y in ring.coords[:-1]]
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    found = []
    for x0, y0, x1, y1 in bands:
        total = [Fraction(0)] * 3
        for i, ring in enumerate(rings):
            piece = clip(clip(clip(clip(ring, 1, y0, 1), 1, y1, -1), 0, x0, 1), 0, x1, -1)
            total = [t + (1 if i == 0 else -1) * p for t, p in zip(total, integrals(piece), strict=True)]
        found.append(total)
    return found


def linear_integral(polygon, shape=SHAPE, field=LINEAR):
    """Return ∬ a + b x + c y over the part of a polygon on a map of unit cells."""
    ((area, x_sum, y_sum),) = exact_integrals(polygon, [(0, 0, shape[1], shape[0])])
    a, b, c = map(Fraction, field)
    return float(a * area + b * x_sum + c * y_sum)


def linear_means(shape=SHAPE, field=LINEAR):
    x, y = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    return field[0] + field[1] * x + field[2] * y


def second_order_by_clipping(polygon, cells):
    """Integrate mean and gradient of every cell over its part of the polygon, cell by cell."""
    gy, gx = np.gradient(cells)
    at = [(iy, ix) for iy in range(cells.shape[0]) for ix in range(cells.shape[1])]
    parts = exact_integrals(polygon, [(ix, iy, ix + 1, iy + 1) for iy, ix in at])
    half = Fraction(1, 2)
    return sum(
        float(area) * cells[c] + float(x - (c[1] + half) * area) * gx[c] + float(y - (c[0] + half) * area) * gy[c]
        for c, (area, x, y) in zip(at, parts, strict=True)
    )


# -- linear fields -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", POLYGONS)
def test_linear_fields_are_exact_over_the_zoo(name):
    assert second(POLYGONS[name])(linear_means())[0] == pytest.approx(
        linear_integral(POLYGONS[name]), rel=EXACT, abs=0.0
    )


@settings(max_examples=examples(300))
@given(polygon=polygons(SHAPE))
def test_linear_fields_are_exact_over_random_polygons(polygon):
    assert second(polygon)(linear_means())[0] == pytest.approx(linear_integral(polygon), rel=EXACT, abs=0.0)


@pytest.mark.parametrize("name", POLYGONS)
def test_random_map_equals_clipping_over_zoo(name):
    assert second(POLYGONS[name])(MAP)[0] == pytest.approx(
        second_order_by_clipping(POLYGONS[name], MAP), rel=EXACT, abs=1e-15
    )


@pytest.mark.slow
@settings(max_examples=examples(60))
@given(polygon=polygons(SHAPE))
def test_random_map_equals_clipping_over_polygons(polygon):
    expected = second_order_by_clipping(polygon, MAP)
    for compiled in (True, False):
        assert second(polygon, compiled=compiled)(MAP)[0] == pytest.approx(expected, rel=EXACT, abs=1e-15)


@settings(max_examples=examples(100))
@given(polygon=polygons((2, 2)))
def test_two_by_two_map_is_exact(polygon):
    got = second(polygon, fs.Grid((2, 2), 1.0))(linear_means((2, 2)))[0]

    assert got == pytest.approx(linear_integral(polygon, (2, 2)), rel=EXACT, abs=0.0)


@pytest.mark.parametrize(
    ("shape", "field"), [((1, 9), (20.0, 1.3, 0.0)), ((7, 1), (20.0, 0.0, 1.3)), ((1, 1), (2.0, 0.0, 0.0))]
)
@pytest.mark.parametrize(
    "name", ["star", "off to the left and right", "tiny triangle inside one cell", "long sliver along a row"]
)
def test_single_row_or_column_is_exact(shape, field, name):
    for dx, dy in ((0.0, 0.0), (0.0, -3.2), (-4.4, 0.0), (-4.3, -3.1)):
        polygon = shapely.transform(POLYGONS[name], lambda xy, d=(dx, dy): xy + np.array(d))
        got = second(polygon, fs.Grid(shape, 1.0))(linear_means(shape, field))[0]
        assert got == pytest.approx(linear_integral(polygon, shape, field), rel=EXACT, abs=1e-15)


def test_overlapping_rings_count_twice():
    a, b = shapely.box(1.2, 1.3, 5.4, 4.6), shapely.Polygon([(3.1, 2.2), (7.7, 2.9), (4.2, 6.4)])
    rings = fs.Layout.from_polygons([a, b])
    # Two outlines as one site: the constructor would reject the second, which is not a hole.
    both = layout_of(rings.xy_um, rings.ring_offsets, np.array([0, 2]))

    got = fs.Integrator(both, GRID, order=2)(linear_means())[0]

    assert got == pytest.approx(linear_integral(a) + linear_integral(b), rel=EXACT)


@pytest.mark.parametrize("order", [1, 2])
def test_cell_without_weight_can_have_moments(order):
    """A self-intersecting outline covers cell [3, 4] with two equal triangles of opposite sign."""
    ring = np.array([[2.0, 1.0], [6.0, 1.0], [6.0, 3.0], [4.2, 3.0], [4.8, 4.0], [4.2, 4.0], [4.8, 3.0], [2.0, 3.0]])
    layout = fs.Layout(ring, np.array([0, 8]), np.array([0, 1]))
    right = [shapely.box(2, 1, 6, 3), shapely.Polygon([(4.5, 3.5), (4.8, 4), (4.2, 4)])]
    left = shapely.Polygon([(4.2, 3), (4.8, 3), (4.5, 3.5)])
    expected = {
        1: linear_integral(shapely.box(2, 1, 6, 3)),
        2: sum(linear_integral(p) for p in right) - linear_integral(left),
    }

    assert fs.Integrator(layout, GRID, order=order)(linear_means())[0] == pytest.approx(expected[order], rel=EXACT)


# -- conservation and symmetry -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FAMILIES)
def test_tiling_conserves_power_of_map(name):
    grid = fs.Grid((23, 31), 0.1, (-1.5, -1.1))
    cells = np.random.default_rng(3).random(grid.shape)
    integrator = fs.Integrator(tiling(name), grid, order=2)

    assert fs.Integrator(tiling(name), grid)(np.ones(grid.shape)).sum() == pytest.approx(23 * 31 * 0.01, rel=1e-12)
    assert integrator(cells).sum() == pytest.approx(cells.sum() * grid.cell_area_um2, rel=1e-12)


@pytest.mark.parametrize("name", FAMILIES)
def test_tiling_moments_sum_to_zero(name):
    grid = fs.Grid((23, 31), 0.1, (-1.5, -1.1))
    plan = fs.Integrator(tiling(name), grid, order=2)._compiled
    sums = np.zeros((*grid.shape, 2))
    row = np.repeat(np.arange(grid.shape[0]), np.diff(plan.row_cuts))
    np.add.at(sums, (row, plan.cuts[:, 1]), plan.moments)

    assert plan.cuts.shape[0] > 200
    assert np.abs(sums).max() <= 1e-14


@pytest.mark.parametrize("name", [*FAMILIES, "zoo"])
def test_overlaps_are_bit_identical_to_first_order(name):
    layout = fs.Layout.from_polygons(list(POLYGONS.values())) if name == "zoo" else tiling(name)
    one, two = (fs.Integrator(layout, fs.Grid((40, 40), 0.3, (-6.0, -6.0)), order=order)._compiled for order in (1, 2))

    assert np.array_equal(one.spans, two.spans)
    assert np.array_equal(one.weights, two.weights)
    assert one.cuts.size == one.moments.size == 0


@pytest.mark.parametrize("name", ["star", "two holes in a row", "comb with teeth in one row", "ring"])
def test_integer_cell_shift_shifts_weights(name):
    grid = fs.Grid((25, 35), 1.0)
    near, far = (
        shapely.transform(POLYGONS[name], lambda xy, d=d: xy + np.array(d)) for d in ((2.0, 3.0), (18.0, 11.0))
    )

    assert weights_of(far, grid)[9:, 17:] == pytest.approx(weights_of(near, grid)[1:-8, 1:-16], abs=8e-15)


# -- operator, adjoint and matrix --------------------------------------------------------------------------------------


@pytest.mark.parametrize("conserve", ["flux", "density"])
@pytest.mark.parametrize("distortion", [None, BARREL])
@pytest.mark.parametrize("shape", [(70, 90), (300, 280), (1, 90), (70, 1), (2, 3)])
def test_operator_adjoint_and_matrix_agree(shape, distortion, conserve):
    layout = tiling("log_polar with fovea")
    grid = fs.Grid.centred(shape, 12.0 / max(shape))
    integrator = fs.Integrator(layout, grid, order=2, distortion=distortion, conserve=conserve)
    rng = np.random.default_rng(1)
    cells, values = rng.random(shape), rng.normal(size=(2, layout.n_sites))
    matrix = integrator.weights()

    np.testing.assert_allclose(matrix @ cells.ravel(), integrator(cells), rtol=1e-12, atol=1e-14)
    spread = integrator.spread(values).reshape(2, -1)
    np.testing.assert_allclose(spread, values @ matrix.toarray(), rtol=1e-12, atol=1e-14)


def test_spread_crosses_band_boundaries(monkeypatch):
    from foveasim.integrate import _plan

    grid = fs.Grid((70, 50), 0.2, (-5.0, -7.0))
    values = np.random.default_rng(1).normal(size=tiling("hexagonal").n_sites)
    monkeypatch.setattr(_plan, "MIN_ROWS_PER_BAND", 1)
    monkeypatch.setattr(_plan, "SMALL_MAP", 0)
    integrator = fs.Integrator(tiling("hexagonal"), grid, order=2)

    assert integrator.spread(values).ravel() == pytest.approx(values @ integrator.weights().toarray(), abs=1e-13)


# -- cells that are read -----------------------------------------------------------------------------------------------


def test_site_without_cut_cells_ignores_neighbours():
    cells = np.full((5, 5), np.nan)
    cells[1:4, 1:3] = 2.0
    integrator = second(shapely.box(1.0, 1.0, 3.0, 4.0), fs.Grid((5, 5), 1.0))

    assert integrator(cells)[0] == 12.0
    assert integrator.weights().nnz == 6


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nonfinite_cell_reaches_sites_cutting_neighbours_only(bad):
    cells = np.ones((40, 40))
    cells[20, 20] = bad
    centre = np.stack(np.meshgrid(np.arange(12) + 15.0, np.arange(12) + 15.0), axis=-1).reshape(-1, 2)
    layout = fs.Layout.from_rectangles(centre, 0.6)  # each cuts four cells around a corner
    power = fs.Integrator(layout, fs.Grid((40, 40), 1.0), order=2)(cells)

    is_bad = ~np.isfinite(power)
    dx, dy = np.abs(centre - 20.5).T
    is_adjacent = ((dx == 0.5) & (dy <= 1.5)) | ((dy == 0.5) & (dx <= 1.5))
    assert is_bad.sum() == 12
    assert np.array_equal(is_bad, is_adjacent)
    assert power[~is_bad] == pytest.approx(0.36)


def test_moment_buffer_grows_for_long_edges():
    """A site that covers part of a row has a moment in each cell of the row; this includes the last of many sites."""
    boxes = [shapely.box(0.0, y + 0.1, 5000.0, y + 0.4) for y in range(60)]
    integrator = fs.Integrator(fs.Layout.from_polygons(boxes), fs.Grid((60, 5000), 1.0), order=2)
    up = np.broadcast_to(np.arange(60.0)[:, np.newaxis] + 0.5, (60, 5000))

    assert integrator(up) == pytest.approx(5000 * 0.3 * (np.arange(60) + 0.25), rel=1e-12)


def test_covered_cells_have_no_moments():
    x = np.arange(1000) * 7.0 + 1.3
    finger = np.array([[0, 90.2], [3.1, 90.2], [3.1, 5.7], [7.0, 5.7]])
    teeth = (finger + np.stack((x, np.zeros(1000)), axis=1)[:, np.newaxis]).reshape(-1, 2)
    comb = shapely.Polygon(np.concatenate((teeth, [[x[-1] + 7.0, 2.5], [1.3, 2.5]])))
    plan = second(comb, fs.Grid((100, 7020), 1.0))._compiled
    row = np.repeat(np.arange(plan.grid.shape[0]), np.diff(plan.row_cuts))
    column = plan.cuts[(row > 10) & (row < 90), 1]

    # Two cut cells per finger and row, except where an edge lies on a cell boundary.
    assert column.size <= 79 * 2000
    assert np.all(np.abs((column + 0.5 - 1.3) % 7.0 - 1.55) > 0.8)


# -- diffraction patterns ----------------------------------------------------------------------------------------------


@cache
def airy_means(cells_per_lambda_n, parts):
    """
    Return cell means of a diffraction pattern on a grid ``parts`` times finer, as fractions of the total power.

    The point source is at the centre of cell [n // 2, n // 2]. Means are exact for any cell size, and so are means of means.
    """
    optics = fs.Optics(focal_length_mm=22.0, f_number=4.0, precision="double", padding="periodic")
    lambda_n_um = 0.55 * optics.working_f_number(0.56)
    n = 2 * int(25 * cells_per_lambda_n * parts) + 1
    scene = fs.Scene.point_sources(
        shape=(n, n),
        pixels=[(n // 2, n // 2)],
        intensity_w_sr_nm=1e-9,
        pitch_um=lambda_n_um / (cells_per_lambda_n * parts) / optics.magnification(0.56),
        distance_m=0.56,
        wavelength_nm=[550.0],
        band_width_nm=1.0,
    )
    fine = optics.power_map(scene).data[0]
    centre, half = n // 2, 20 * parts
    return fine[centre - half : centre + half + parts, centre - half : centre + half + parts] / fine.sum()


def ensquared_energy(cells_per_lambda_n, parts, offset, order):
    """Return the ensquared energy in a side of λN for a point ``offset`` fine cells from the corner of a cell."""
    dx, dy = offset
    fine = airy_means(cells_per_lambda_n, parts)
    n = fine.shape[0] // parts - 1
    coarse = fine[dy : dy + n * parts, dx : dx + n * parts].reshape(n, parts, n, parts).sum(axis=(1, 3))
    point = (20 * parts + 0.5 - np.array(offset)) / parts
    square = fs.Layout.from_rectangles([point], cells_per_lambda_n)
    return fs.Integrator(square, fs.Grid((n, n), 1.0), order=order)(coarse)[0]


@pytest.mark.parametrize(
    ("cells_per_lambda_n", "parts", "second_order", "first_order"), [(8.2, 5, 4e-4, 3e-3), (16.2, 3, 3e-5, 8e-4)]
)
def test_ensquared_energy_of_airy_disc_is_accurate(cells_per_lambda_n, parts, second_order, first_order):
    offsets = [(dx, dy) for dx in range(parts) for dy in range(parts)]
    errors = {
        order: np.abs([ensquared_energy(cells_per_lambda_n, parts, o, order) - 0.528891 for o in offsets]).max()
        for order in (1, 2)
    }

    assert errors[2] <= second_order
    assert errors[1] >= first_order


# -- with distortion ---------------------------------------------------------------------------------------------------


def test_second_order_reduces_error_with_distortion():
    layout = fs.layout.tiling(pitch_um=9.0, radius_um=50.0)

    def means(grid):
        # Cell means of 2 + sin(0.15 x + 0.3) cos(0.1 y): the varying part at the centre times a sinc along each axis.
        x, y = np.meshgrid(grid.x_um, grid.y_um)
        sincs = np.sinc(0.15 * grid.pitch_um / (2 * np.pi)) * np.sinc(0.1 * grid.pitch_um / (2 * np.pi))
        return 2.0 + sincs * np.sin(0.15 * x + 0.3) * np.cos(0.1 * y)

    fine, coarse = fs.Grid.centred((1500, 1500), 0.08), fs.Grid.centred((75, 75), 1.6)
    truth = fs.Integrator(layout, fine, distortion=BARREL, order=2)(means(fine))
    errors = {}
    for order in (1, 2):
        got = fs.Integrator(layout, coarse, distortion=BARREL, order=order)(means(coarse))
        errors[order] = np.abs(got / truth - 1).max()

    assert errors[2] < errors[1] / 20
    assert errors[2] < 2e-4


# -- invalid arguments ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0, 3, 1.5, "two", None, True])
def test_integrator_rejects_invalid_order(order):
    with pytest.raises(ParameterError, match="'order' must be"):
        fs.Integrator(tiling("grid"), GRID, order=order)
