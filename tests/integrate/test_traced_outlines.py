"""Integration over outlines that are traced at every call, against compiled overlaps and closed forms."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import GeometryError
from foveasim.integrate._outlines import outlines_of
from foveasim.integrate._traced import TracedOutlines

LAYOUTS = {
    "hexagonal": fs.layout.hexagonal(n_columns=60, n_rows=40, pitch_um=0.9),
    "log_polar": fs.layout.log_polar(n_sectors=80, r_min_um=1.2, r_max_um=24.7),
    "voronoi": fs.layout.voronoi(n_sites=700, size_um=(49.0, 49.0), n_iterations=1),
    "penrose": fs.layout.penrose(side_um=2.0, size_um=45.0),
}
GRID = fs.Grid((90, 110), (0.5, 0.55), (-25.0, -22.0))
CELLS = np.random.default_rng(3).uniform(0.5, 1.5, GRID.shape)
#: Its image circle of radius 22.6 µm excludes corners of the layouts.
BARREL = fs.distortion.BrownConrady(focal_um=40.0, k1=-0.46)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("lens", [None, BARREL], ids=["straight", "distorted"])
def test_traced_outlines_equal_compiled_outlines(name, order, lens):
    options = {"distortion": lens, "order": order}
    compiled = fs.Integrator(LAYOUTS[name], GRID, **options)
    traced = fs.Integrator(LAYOUTS[name], GRID, compiled=False, **options)
    where = np.arange(compiled.n_sites) % 3 > 0

    assert isinstance(traced._overlaps, TracedOutlines)
    scale = compiled(CELLS).max()
    np.testing.assert_allclose(traced(CELLS), compiled(CELLS), rtol=1e-12, atol=1e-13 * scale)
    np.testing.assert_allclose(
        traced(CELLS.astype(np.float32), where=where),
        compiled(CELLS.astype(np.float32), where=where),
        atol=1e-13 * scale,
    )
    np.testing.assert_allclose(traced.uncovered_um2, compiled.uncovered_um2, atol=1e-12)
    np.testing.assert_array_equal(traced.sites_outside_image_circle, compiled.sites_outside_image_circle)
    assert traced.n_uncovered == compiled.n_uncovered > 0
    np.testing.assert_array_equal(traced.bounds_um, compiled.bounds_um)


@pytest.mark.parametrize("compiled", [True, False])
def test_large_sites_integrate_linear_maps_exactly(compiled):
    # Boxes of 720,000 cells exceed what is accumulated at once.
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    radius = np.where(np.arange(40) % 2, 480.0, 200.0)
    star = np.stack((radius * np.cos(angle), 0.7 * radius * np.sin(angle)), 1)
    polygon = shapely.Polygon(star, [0.3 * star[::-1]])
    grid = fs.Grid((700, 1000), 1.0, (-500.0, -350.0))
    x_um, y_um = np.meshgrid(grid.x_um, grid.y_um)
    integrator = fs.Integrator(fs.Layout.from_polygons([polygon]), grid, order=2, compiled=compiled)

    power = integrator(3.0 + 0.01 * x_um - 0.002 * y_um)

    x, y = polygon.centroid.coords[0]
    assert power[0] == pytest.approx(polygon.area * (3.0 + 0.01 * x - 0.002 * y), rel=1e-12)


@pytest.mark.parametrize("compiled", [True, False])
def test_wide_sites_sum_all_cells(compiled):
    # More than 64 columns and long runs of covered cells: the area of a sheared strip.
    polygon = shapely.Polygon([(0.2, 0.1), (900.3, 3.7), (903.0, 40.2), (5.0, 37.9)])
    layout = fs.Layout.from_polygons([polygon])

    power = fs.Integrator(layout, fs.Grid((50, 950), 1.0), compiled=compiled)(np.full((50, 950), 2.0))

    assert power[0] == pytest.approx(2.0 * polygon.area, rel=1e-12)


def _traced_sum(polygon, cells, order):
    """Return the sum over the only site, without the recognition of rectangles."""
    layout, grid = fs.Layout.from_polygons([polygon]), fs.Grid(cells.shape, 1.0)
    traced = TracedOutlines(partial(outlines_of, layout), 1, grid, order, 1)
    power = np.empty(1)
    traced.gather(cells, power, 1.0, np.zeros(0, bool), 1)
    return power[0]


@pytest.mark.parametrize("order", [1, 2])
def test_traced_site_ignores_adjacent_nan(order):
    # At second order the gradients of covered cells are not needed.
    cells = np.full((5, 6), np.nan)
    cells[1:3, 2:5] = 2.0

    assert _traced_sum(shapely.box(2, 1, 5, 3), cells, order) == 12.0


@pytest.mark.parametrize("order", [1, 2])
def test_dark_traced_site_is_precise(order):
    cells = np.full((8, 400), 1.0)
    cells[:, :200] = 1e12
    cells[:, 390:] = 1e12

    total = _traced_sum(shapely.box(300.25, 2.25, 380.5, 6.5), cells, order)

    assert total == pytest.approx(80.25 * 4.25, rel=1e-14)


@pytest.mark.parametrize("order", [1, 2])
def test_left_side_bending_within_row(order):
    # The lowest vertex and the bend are in one row, and the left side reaches further right above the bend.
    polygon = shapely.Polygon([(2.2, 0.1), (9.7, 0.4), (9.5, 0.95), (7.6, 0.8), (1.1, 0.3)])
    x, y = np.meshgrid(np.arange(11) + 0.5, np.arange(3) + 0.5)
    centroid = polygon.centroid

    total = _traced_sum(polygon, 5.0 + x - 0.4 * y if order == 2 else np.full((3, 11), 5.0), order)

    mean = 5.0 + centroid.x - 0.4 * centroid.y if order == 2 else 5.0
    assert total == pytest.approx(polygon.area * mean, rel=1e-13)


@pytest.mark.parametrize("n_threads", [2, 3])
def test_threads_do_not_change_traced_sums(n_threads):
    layout = fs.layout.hexagonal(n_columns=80, n_rows=60, pitch_um=0.5)
    one, other = (fs.Integrator(layout, GRID, compiled=False, n_threads=n)(CELLS) for n in (1, n_threads))

    np.testing.assert_array_equal(one, other)


def test_traced_outlines_have_adjoint_and_matrix():
    integrator = fs.Integrator(LAYOUTS["voronoi"], GRID, compiled=False)
    values = np.random.default_rng(4).random(integrator.n_sites)

    assert np.vdot(integrator.spread(values), CELLS) == pytest.approx(values @ integrator(CELLS), rel=1e-12)
    np.testing.assert_allclose(integrator.weights() @ CELLS.ravel(), integrator(CELLS), rtol=1e-12, atol=1e-14)


def test_clockwise_outlines_are_rejected_untraced():
    layout = fs.Layout(np.array([[0, 0], [1, 2], [2, 0]], float), [0, 3], [0, 1])

    with pytest.raises(GeometryError, match="site 0 must be counter-clockwise"):
        fs.Integrator(layout, GRID, compiled=False)
