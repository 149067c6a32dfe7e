"""Derivatives of integrals with respect to vertices: difference quotients, closed forms, conservation."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.integrate import EdgeMoments, SharedEdges, vertex_gradient

GRID = fs.Grid((24, 30), 0.8, (-12.0, -9.6))


def random_map(seed, shape=GRID.shape):
    return np.random.default_rng(seed).random(shape)


def moved(layout, vertex, step):
    xy = layout.xy_um.copy()
    xy[vertex] += step
    return fs.Layout(xy, layout.ring_offsets, layout.site_offsets)


def loss(layout, cells, weights, order, grid=GRID):
    return float(fs.Integrator(layout, grid, order=order)(cells) @ weights)


def star(rng, centre, n, size):
    """Polygon around a centre with random radii: concave in general."""
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, n)) + np.linspace(0.0, 0.3, n)
    radius = size * rng.uniform(0.3, 1.0, n)
    polygon = shapely.Polygon(np.stack((np.cos(angle), np.sin(angle)), 1) * radius[:, None] + centre)
    return polygon if polygon.is_valid and polygon.area > 0.05 * size**2 else shapely.Point(centre).buffer(size, 2)


def random_layout(seed):
    """Concave sites, one with a hole, one partly off the map, and two that share an edge."""
    rng = np.random.default_rng(seed)
    polygons = [star(rng, rng.uniform(-6.0, 6.0, 2), int(rng.integers(4, 9)), 4.0) for _ in range(2)]
    outer = star(rng, (0.3, -0.2), 7, 5.0)
    hole = shapely.Point(0.31, -0.23).buffer(0.4, 2)
    polygons.append(outer.difference(hole) if outer.contains(hole) else outer)
    polygons.append(star(rng, (11.0, 8.0), 6, 4.0))
    corner = rng.uniform(-2.0, 2.0, (4, 2))
    corner += np.array([[-6.1, -3.3], [0.2, -3.7], [6.3, -2.9], [0.1, 3.1]])
    polygons.extend(shapely.Polygon(triangle) for triangle in (corner[[0, 1, 3]], corner[[1, 2, 3]]))
    return fs.Layout.from_polygons(
        [p if p.geom_type == "Polygon" else max(p.geoms, key=lambda q: q.area) for p in polygons]
    )


def check_against_differences(layout, cells, order, rng, n_checks):
    """Compare with central differences at two steps, where they agree: elsewhere an edge passes a corner of cells."""
    weights = rng.uniform(-1.0, 1.0, layout.n_sites)
    gradient = vertex_gradient(layout, GRID, cells, weights, order=order)
    scale, n_compared = np.abs(gradient).max(), 0
    for vertex in rng.integers(0, layout.xy_um.shape[0], n_checks):
        for axis in (0, 1):
            slopes = []
            for h in (1e-4, 5e-5):
                step = np.zeros(2)
                step[axis] = h
                after, before = (loss(moved(layout, vertex, s * step), cells, weights, order) for s in (1, -1))
                slopes.append((after - before) / (2.0 * h))
            if abs(slopes[0] - slopes[1]) < 1e-8 * scale:
                n_compared += 1
                assert abs(slopes[1] - gradient[vertex, axis]) < 1e-8 * scale, (vertex, axis, slopes, gradient[vertex])
    return n_compared


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_gradient_agrees_with_difference_quotients(order):
    rng = np.random.default_rng(order)
    n_compared = 0
    for seed in range(12):
        n_compared += check_against_differences(random_layout(seed), random_map(seed), order, rng, 12)

    assert n_compared >= 240


@pytest.mark.parametrize("order", [1, 2])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=examples(15))
def test_drawn_outlines_agree_with_differences(order, seed):
    check_against_differences(random_layout(seed), random_map(seed % 1000), order, np.random.default_rng(seed), 3)


@pytest.mark.parametrize("order", [1, 2])
def test_site_sum_is_minus_map_motion(order):
    layout, cells = random_layout(3), random_map(3)
    edges = SharedEdges.from_layout(layout)
    for site in range(layout.n_sites):
        weights = np.eye(layout.n_sites)[site]
        total = vertex_gradient(layout, GRID, cells, weights, order=order)[edges.site == site].sum(axis=0)
        for axis in (0, 1):
            h = 1e-6
            found = []
            for sign in (1, -1):
                origin = list(GRID.origin_um)
                origin[axis] += sign * h
                found.append(loss(layout, cells, weights, order, fs.Grid(GRID.shape, GRID.pitch_um, tuple(origin))))
            assert total[axis] == pytest.approx(-(found[0] - found[1]) / (2 * h), rel=1e-6, abs=1e-6)


def test_uniform_map_gives_area_gradient():
    layout = random_layout(5)
    inside = fs.Grid((80, 80), 0.8, (-32.0, -32.0))
    gradient = vertex_gradient(layout, inside, np.full((80, 80), 3.0), np.ones(layout.n_sites))
    edges = SharedEdges.from_layout(layout)
    after, before = layout.xy_um[edges.after], layout.xy_um[edges.before]
    expected = 1.5 * np.stack((after[:, 1] - before[:, 1], before[:, 0] - after[:, 0]), axis=1)

    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    # An area is homogeneous of degree 2.
    assert (gradient * layout.xy_um).sum() == pytest.approx(2 * 3.0 * layout.area_um2.sum(), rel=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_inner_vertices_of_tiling_cancel(order):
    layout = fs.layout.hexagonal(n_columns=5, n_rows=4, pitch_um=2.3).rotate(9.0)
    weights = np.ones(layout.n_sites)
    for cells, limit in ((np.ones(GRID.shape), 1e-12), (random_map(0), 1e-12)):
        gradient = vertex_gradient(layout, GRID, cells, weights, order=order)
        position = np.round(layout.xy_um, 6)
        _, point, n_sites = np.unique(position, axis=0, return_inverse=True, return_counts=True)
        total = np.stack([np.bincount(point.ravel(), gradient[:, axis]) for axis in (0, 1)], axis=1)
        assert (n_sites == 3).sum() > 10
        assert np.abs(total[n_sites == 3]).max() < limit * 100 * np.abs(gradient).max()


def test_linear_map_has_constant_force():
    layout = random_layout(7)[:3]
    grid = fs.Grid((60, 60), 0.6, (-18.0, -18.0))
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    gradient = vertex_gradient(layout, grid, 2.0 + 0.3 * x - 0.2 * y, np.ones(layout.n_sites), order=2)
    site = SharedEdges.from_layout(layout).site
    for k in range(layout.n_sites):
        expected = layout.area_um2[k] * np.array([0.3, -0.2])
        np.testing.assert_allclose(gradient[site == k].sum(axis=0), expected, rtol=1e-11, atol=1e-11)


def test_edge_on_border_gives_mean_derivative():
    grid = fs.Grid((1, 2), 1.0)
    square = fs.Layout.from_rectangles([[0.5, 0.5]], 1.0)
    gradient = vertex_gradient(square, grid, np.array([[2.0, 6.0]]), [1.0])

    # The right edge lies between the cells of 2 and 6, half of it belongs to each of its vertices.
    np.testing.assert_allclose(gradient[[1, 2], 0], 0.5 * 0.5 * (2.0 + 6.0))


@pytest.mark.parametrize("order", [1, 2])
def test_batch_sums_over_its_maps(order):
    layout, maps = random_layout(1), random_map(2, (3, *GRID.shape)).astype(np.float32)
    weights = np.random.default_rng(3).random((3, layout.n_sites))
    together = vertex_gradient(layout, GRID, maps, weights, order=order)

    separate = sum(vertex_gradient(layout, GRID, m, w, order=order) for m, w in zip(maps, weights, strict=True))
    np.testing.assert_allclose(together, separate, rtol=1e-12, atol=1e-12)


def test_threads_do_not_change_gradient():
    layout = fs.layout.hexagonal(n_columns=60, n_rows=60, pitch_um=0.3)
    weights = np.random.default_rng(0).random(layout.n_sites)
    one, four = (vertex_gradient(layout, GRID, random_map(0), weights, n_threads=n) for n in (1, 4))

    np.testing.assert_array_equal(one, four)


@pytest.mark.parametrize("order", [1, 2])
def test_spread_is_adjoint_of_measure(order):
    rng = np.random.default_rng(0)
    begin, end = rng.uniform(-14.0, 14.0, (2, 200, 2))
    operator = EdgeMoments(GRID, begin, end, order, 1)
    cells, weights = rng.random((2, *GRID.shape)), rng.random((2, 200, 2))

    assert (operator.spread(weights) * cells).sum() == pytest.approx(
        (operator.measure(cells) * weights).sum(), rel=1e-12
    )


@pytest.mark.parametrize("order", [1, 2])
def test_moment_derivatives_agree_with_differences(order):
    rng = np.random.default_rng(4)
    begin, end = rng.uniform(-13.0, 13.0, (2, 60, 2))
    cells, weights = rng.random((1, *GRID.shape)), rng.random((1, 60, 2))
    found = EdgeMoments(GRID, begin, end, order, 1).differentiate(cells, weights)
    h, n_close = 1e-6, 0
    for which, axis in np.ndindex(2, 2):
        step = np.zeros((2, 1, 2))
        step[which, 0, axis] = h
        after, before = (
            EdgeMoments(GRID, begin + s * step[0], end + s * step[1], order, 1).measure(cells) for s in (1, -1)
        )
        slope = ((after - before) * weights).sum(axis=(0, 2)) / (2 * h)
        n_close += np.isclose(found[which][:, axis], slope, rtol=1e-5, atol=1e-6).sum()

    # Where an edge passes a corner of cells within the step, the difference quotient differs.
    assert n_close >= 0.99 * 4 * 60


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"power_map": np.ones((3, 3))}, r"must have the shape \(..., n_y, n_x\)"),
        ({"site_weights": np.ones(3)}, "'site_weights' must have the shape"),
        ({"site_weights": [np.nan] * 6}, "'site_weights' must be finite"),
        ({"grid": 3}, "'grid' must be a Grid"),
        ({"layout": 3}, "'layout' must be a Layout"),
        ({"order": 3}, "'order'"),
    ],
)
def test_invalid_gradient_arguments_are_rejected(change, message):
    arguments = {"layout": random_layout(0), "grid": GRID, "power_map": random_map(0), "site_weights": np.ones(6)}
    with pytest.raises(fs.FoveasimError, match=message):
        vertex_gradient(**{**arguments, **change})
