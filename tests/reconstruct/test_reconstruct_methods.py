"""Interpolation and least-squares reconstruction: uniform fields, missing data, and agreement with measured values."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
import shapely
import skimage
from PIL import Image, features
from reference.neighbours import sibson_weights

import foveasim as fs
from foveasim._io.images import read_picture
from foveasim.errors import ParameterError, SimulationError
from foveasim.integrate import Integrator
from foveasim.metrics import psnr_db
from foveasim.reconstruct import (
    Picture,
    _kernels,
    blur_kernel,
    cells,
    estimate_from_charge,
    estimate_from_code,
    fill_channels,
    least_squares,
    linear,
    natural,
    raster_grid,
    reference,
)
from foveasim.reconstruct.picture import NO_DATA_COLOUR

FOVEAL = fs.layout.log_polar(n_sectors=40, min_size_um=2.0, r_max_um=80.0, stagger=True)
HEXAGONS = fs.layout.hexagonal(n_columns=14, n_rows=15, pitch_um=3.0)
ZONES = fs.layout.zones(side_um=(8, 16, 32, 64), pitch_um=(1, 2, 4, 8))
SQUARES = fs.layout.grid(n_x=12, n_y=9, pitch_um=2.0)
LAYOUTS = {"log-polar": FOVEAL, "hexagons": HEXAGONS, "zones": ZONES, "squares": SQUARES}
SMOOTH = {"linear": linear, "natural": natural}


def fit(layout, values, grid, **options):
    """Least squares with equal responses: values of a uniform scene are equal."""
    return least_squares(layout, values, grid, response=np.ones(layout.n_sites), **{"variance": 1.0, **options})


METHODS = {"cells": cells, **SMOOTH, "least squares": fit}
LAYOUT = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
METHOD = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
EACH_INTERPOLATION = pytest.mark.parametrize("method", SMOOTH.values(), ids=SMOOTH)


def plane(xy_um):
    return 50.0 + 0.3 * xy_um[..., 0] - 0.2 * xy_um[..., 1]


def centres_um(grid):
    return np.stack(np.meshgrid(grid.x_um, grid.y_um), axis=-1)


def grid_through(point_um, n=1, pitch_um=0.1):
    """Raster whose central pixel is centred on a point."""
    x, y = point_um
    return fs.Grid((n, n), pitch_um, (x - 0.5 * n * pitch_um, y - 0.5 * n * pitch_um))


# -- all methods ------------------------------------------------------------------------------------------------------


@LAYOUT
@METHOD
def test_flat_field_stays_flat(layout, method):
    picture = method(layout, np.full(layout.n_sites, 7.5), raster_grid(layout, 90))

    assert np.isfinite(picture.data).any()
    assert np.nanmax(np.abs(picture.data - 7.5)) <= 7.5e-6


@pytest.mark.slow(keep=2)
@METHOD
def test_uncovered_pixels_are_nan(method):
    grid = raster_grid(FOVEAL, 151)
    picture = method(FOVEAL, plane(FOVEAL.centroid_um), grid)
    covered = shapely.union_all(FOVEAL.polygons())
    x, y = np.moveaxis(centres_um(grid), -1, 0)
    half = 0.5 * grid.pitch_um
    covered_um2 = shapely.area(shapely.intersection(covered, shapely.box(x - half, y - half, x + half, y + half)))

    assert np.array_equal(np.isnan(picture.data[0]), covered_um2 < 1e-9)
    assert picture.coverage == pytest.approx(covered_um2 / grid.cell_area_um2, abs=1e-6)
    assert np.isnan(picture.data[0, 75, 75])


@METHOD
@pytest.mark.parametrize("layout", [FOVEAL, ZONES], ids=["log-polar", "zones"])
def test_result_independent_of_site_order(layout, method):
    values = np.random.default_rng(3).uniform(20.0, 90.0, layout.n_sites)
    order = np.random.default_rng(4).permutation(layout.n_sites)
    grid = raster_grid(layout, 60)
    options = {"mu": 1e-3, "tolerance": 1e-8} if method is fit else {}
    one = method(layout, values, grid, **options).data
    other = method(layout[order], values[order], grid, **options).data

    # Four centroids of squares lie on a circle: the diagonal of their triangulation depends on the order.
    if method is linear and layout is ZONES:
        assert np.nanmean(np.abs(one - other) > 1e-3) < 0.4
        return
    assert np.nanmax(np.abs(one - other)) < (0.02 if method is fit else 1e-3)


@METHOD
def test_result_independent_of_threads(method):
    values = np.random.default_rng(5).uniform(20.0, 90.0, (2, HEXAGONS.n_sites))
    grid = raster_grid(HEXAGONS, 160)
    one, two = (method(HEXAGONS, values, grid, n_threads=n).data for n in (1, 2))

    assert np.array_equal(one, two, equal_nan=True)


@METHOD
def test_translated_layout_translates_picture(method):
    values = np.random.default_rng(6).uniform(20.0, 90.0, HEXAGONS.n_sites)
    moved = HEXAGONS.translate(1000.0, -700.0)
    one, other = (method(layout, values, raster_grid(layout, 64)).data for layout in (HEXAGONS, moved))

    assert np.nanmax(np.abs(one - other)) < 0.05


# -- interpolation ----------------------------------------------------------------------------------------------------


@EACH_INTERPOLATION
@LAYOUT
def test_interpolation_exact_at_centroids(layout, method):
    values = np.random.default_rng(1).uniform(1.0, 9.0, layout.n_sites)

    for site in range(0, layout.n_sites, max(1, layout.n_sites // 10)):
        picture = method(layout, values, grid_through(layout.centroid_um[site]))
        assert picture.data[0, 0, 0] == pytest.approx(values[site], rel=1e-6)


@EACH_INTERPOLATION
@LAYOUT
def test_linear_field_exact_inside_hull_clamped_outside(layout, method):
    grid = raster_grid(layout, 120)
    picture = method(layout, plane(layout.centroid_um), grid)
    points_um = centres_um(grid)
    hull = shapely.MultiPoint(layout.centroid_um).convex_hull
    points = shapely.points(points_um)
    inside = shapely.covers(hull, points)
    nearest = shapely.get_coordinates(
        shapely.line_interpolate_point(hull.exterior, shapely.line_locate_point(hull.exterior, points.ravel()))
    ).reshape(points_um.shape)
    expected = plane(np.where(inside[..., np.newaxis], points_um, nearest))
    is_seen = np.isfinite(picture.data[0])

    assert (is_seen & ~inside).any()
    assert np.abs(picture.data[0] - expected)[is_seen].max() < 2e-5


@pytest.mark.parametrize("kind", ["random", "lattice", "ring", "almost collinear"])
def test_points_are_in_their_triangles(kind):
    rng = np.random.default_rng(4)
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    xy = {
        "random": rng.uniform(-0.5, 0.5, (300, 2)),
        "lattice": np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9)), axis=-1).reshape(-1, 2),
        "ring": 0.5 * np.stack((np.cos(angle), np.sin(angle)), axis=1),
        "almost collinear": np.stack((np.linspace(-0.5, 0.5, 40), 1e-9 * rng.uniform(-0.5, 0.5, 40)), axis=1),
    }[kind]
    mesh = scipy.spatial.Delaunay(xy)
    corners, neighbours = (np.ascontiguousarray(part, np.int64) for part in (mesh.simplices, mesh.neighbors))
    # Any points, the sites, and points on edges.
    points = np.concatenate((rng.uniform(-0.6, 0.6, (500, 2)), xy, xy[corners[:, :2]].mean(axis=1)))
    points[:500, 1] *= np.abs(xy[:, 1]).max() / 0.5
    found = np.empty(points.shape[0], np.int64)

    _kernels.find_triangles(points, xy, corners, neighbours, found)

    polygons = shapely.polygons(xy[corners[np.maximum(found, 0)]])
    outside_hull = shapely.distance(shapely.points(points), shapely.MultiPoint(xy).convex_hull)
    assert shapely.distance(shapely.points(points), polygons)[found >= 0].max() < 1e-12
    assert (outside_hull[found < 0] > 0.0).all()
    assert (outside_hull[found >= 0] < 1e-12).all()
    assert (found[500:] >= 0).all()


@pytest.mark.slow
def test_natural_neighbours_match_voronoi_reference():
    layout = fs.layout.sunflower(n_sites=40, spacing_um=2.0)
    xy = layout.centroid_um
    values = np.random.default_rng(2).uniform(1.0, 9.0, layout.n_sites)
    rng = np.random.default_rng(8)

    for _ in range(12):
        point = rng.uniform(-0.55, 0.55, 2) * np.abs(xy).max()
        picture = natural(layout, values, grid_through(point))
        assert picture.data[0, 0, 0] == pytest.approx(sibson_weights(xy, point) @ values, rel=1e-6)


def test_natural_neighbours_symmetric_on_square_grid():
    values = np.zeros(9)
    values[4] = 1.0
    layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=1.0)
    picture = natural(layout, values, fs.Grid.centred((21, 21), 0.1)).data[0]

    for mirrored in (picture[::-1], picture[:, ::-1], picture.swapaxes(0, 1)):
        assert mirrored == pytest.approx(picture, abs=1e-6)


def test_natural_neighbours_smoother_than_linear():
    xy = np.array([[0, 0], [4, 0], [4.2, 4], [0, 4.1], [8, 0.2], [8.1, 4.0], [4.1, 8], [4, -4.0], [-4, 2.0], [12, 2.0]])
    layout = fs.Layout.from_rectangles(xy, 0.01)
    # One pixel row through the sites, and one large site without a value that covers it.
    grid = fs.Grid((1, 4001), 0.001, (2.0, 2.0))
    around = fs.Layout.from_rectangles([[4.0, 2.0]], 14.0)
    rings = fs.Layout.from_polygons([*layout.polygons(), *around.polygons()])
    values = np.append(np.random.default_rng(9).uniform(0.0, 9.0, 10), np.nan)
    bends = {
        name: np.abs(np.diff(method(rings, values, grid).data[0, 0].astype(np.float64), 2)).max()
        for name, method in SMOOTH.items()
    }

    assert bends["natural"] < 0.2 * bends["linear"]


@EACH_INTERPOLATION
def test_missing_sites_interpolated_from_neighbours(method):
    values = plane(HEXAGONS.centroid_um)
    bad = int(np.hypot(*HEXAGONS.centroid_um.T).argmin())
    values[bad] = np.nan
    picture = method(HEXAGONS, values, grid_through(HEXAGONS.centroid_um[bad]))

    assert picture.data[0, 0, 0] == pytest.approx(plane(HEXAGONS.centroid_um[bad]), rel=1e-6)


@EACH_INTERPOLATION
def test_coincident_centroids_are_averaged(method):
    rings = [shapely.Point(0, 0).buffer(r + 1).difference(shapely.Point(0, 0).buffer(r)) for r in (1, 2)]
    others = [shapely.box(x - 1, y - 1, x + 1, y + 1) for x, y in ((9, 0), (-9, 1), (0, 9), (1, -9))]
    layout = fs.Layout.from_polygons([*rings, *others])
    picture = method(layout, np.array([2.0, 6.0, 4.0, 4.0, 4.0, 4.0]), fs.Grid.centred((41, 41), 0.5))

    assert np.nanmax(np.abs(picture.data - 4.0)) < 1e-5


@EACH_INTERPOLATION
@pytest.mark.parametrize(
    ("centres", "values", "at", "expected"),
    [
        ([[0.0, 0.0]], [5.0], (0.3, 0.3), 5.0),
        ([[0.0, 0.0], [1.0, 0.0]], [2.0, 4.0], (0.25, 0.3), 2.5),
        ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [2.0, 4.0, 3.0], (1.25, -0.2), 3.75),
        ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [2.0, 4.0, 3.0], (2.4, 0.0), 3.0),
    ],
    ids=["one", "two", "on a line", "beyond its end"],
)
def test_collinear_centroids_interpolate_along_line(method, centres, values, at, expected):
    layout = fs.Layout.from_rectangles(centres, 1.0)

    assert method(layout, np.array(values), grid_through(at)).data[0, 0, 0] == pytest.approx(expected)


# -- least squares ----------------------------------------------------------------------------------------------------


@LAYOUT
def test_least_squares_fits_noise_free_data(layout):
    grid = raster_grid(layout, 64)
    truth = 40.0 + 20.0 * np.sin(centres_um(grid)[..., 0] / 5.0) * np.cos(centres_um(grid)[..., 1] / 7.0)
    integrator = Integrator(layout, grid)
    values = integrator(truth)
    picture = least_squares(layout, values, grid, mu=1e-9, tolerance=1e-8)
    fit = integrator(np.nan_to_num(picture.data[0].astype(np.float64)))

    assert np.abs(fit / values - 1.0).max() < 1e-6


@pytest.mark.parametrize("layout", [FOVEAL, HEXAGONS], ids=["log-polar", "hexagons"])
def test_discrepancy_rule_misfit_equals_noise(layout):
    grid = raster_grid(layout, 80)
    integrator = Integrator(layout, grid)
    truth = 400.0 + 200.0 * np.sin(centres_um(grid)[..., 0] / 6.0)
    expected = integrator(truth)
    values = np.random.default_rng(1).poisson(expected).astype(float)
    picture = least_squares(layout, values, grid, variance=expected, mu="discrepancy")
    fit = integrator(np.nan_to_num(picture.data[0].astype(np.float64)))

    assert np.mean((fit - values) ** 2 / expected) == pytest.approx(1.0, abs=0.03)


def test_larger_mu_increases_misfit_decreases_roughness():
    grid = raster_grid(FOVEAL, 60)
    integrator = Integrator(FOVEAL, grid)
    values = np.random.default_rng(1).uniform(10.0, 90.0, FOVEAL.n_sites) * FOVEAL.area_um2
    misfits, roughness = [], []
    for mu in (1e-5, 1e-3, 1e-1, 10.0):
        picture = least_squares(FOVEAL, values, grid, variance=values, mu=mu, tolerance=1e-6).data[0]
        fit = integrator(np.nan_to_num(picture.astype(np.float64)))
        misfits.append(np.sum((fit - values) ** 2 / values))
        roughness.append(np.nansum(np.diff(picture, axis=0) ** 2) + np.nansum(np.diff(picture, axis=1) ** 2))

    assert np.all(np.diff(misfits) > 0.0)
    assert np.all(np.diff(roughness) < 0.0)


def test_least_squares_matches_dense_nnls():
    from scipy.optimize import nnls

    layout, grid = SQUARES, raster_grid(SQUARES, 24)
    rng = np.random.default_rng(7)
    values = np.maximum(rng.normal(2.0, 6.0, layout.n_sites), -3.0)
    variance = rng.uniform(0.5, 2.0, layout.n_sites)
    mu = 0.05
    picture = least_squares(layout, values, grid, variance=variance, mu=mu, tolerance=1e-9)
    n_y, n_x = grid.shape
    along_x = np.kron(np.eye(n_y), np.diff(np.eye(n_x), axis=0))
    along_y = np.kron(np.diff(np.eye(n_y), axis=0), np.eye(n_x))
    weights = Integrator(layout, grid).weights().toarray()
    rows = np.concatenate((weights / np.sqrt(variance)[:, None], np.sqrt(mu) * along_x, np.sqrt(mu) * along_y))
    right = np.concatenate((values / np.sqrt(variance), np.zeros(rows.shape[0] - values.size)))
    expected, _ = nnls(rows, right, maxiter=20_000)

    assert (expected == 0.0).sum() > 20
    assert picture.data[0].ravel() == pytest.approx(expected, abs=1e-5 * expected.max())


def test_least_squares_is_nonnegative():
    values = np.random.default_rng(2).normal(0.0, 5.0, FOVEAL.n_sites)
    picture = least_squares(FOVEAL, values, raster_grid(FOVEAL, 60), variance=25.0)

    assert np.nanmin(picture.data) == 0.0


def test_excluded_site_is_filled_smoothly():
    grid = raster_grid(HEXAGONS, 80)
    good = plane(HEXAGONS.centroid_um)
    bad = int(np.hypot(*HEXAGONS.centroid_um.T).argmin())
    one, other = (np.where(np.arange(good.size) == bad, wrong, good) for wrong in (np.nan, 1e6))
    left_out = fit(HEXAGONS, one, grid, mu=1e-3)
    x, y = HEXAGONS.centroid_um[bad]
    index = int((y - grid.origin_um[1]) / grid.pitch_um), int((x - grid.origin_um[0]) / grid.pitch_um)

    assert left_out.data[0][index] == pytest.approx(good[bad], rel=0.01)
    assert fit(HEXAGONS, other, grid, mu=1e-3).data[0][index] > 1e5


def test_response_normalises_site_areas():
    grid = raster_grid(ZONES, 64)
    picture = least_squares(ZONES, 3.0 * ZONES.area_um2, grid, variance=3.0 * ZONES.area_um2)

    assert picture.data == pytest.approx(np.full((1, 64, 64), 3.0), rel=1e-5)


def test_blur_is_deconvolved():
    layout = fs.layout.grid(n_x=64, n_y=64, pitch_um=1.0)
    grid = raster_grid(layout, 64)
    scene = np.full((64, 64), 5.0)
    scene[20:44, 28:36] = 60.0
    kernel = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256.0
    padded = np.pad(scene, 2, mode="edge")
    blurred = sum(kernel[i, j] * padded[i : i + 64, j : j + 64] for i in range(5) for j in range(5))
    values = Integrator(layout, grid)(blurred)
    sharp = least_squares(layout, values, grid, variance=1e-4, mu=1e-4, blur=kernel, tolerance=1e-6)
    as_seen = least_squares(layout, values, grid, variance=1e-4, mu=1e-4, tolerance=1e-6)

    assert psnr_db(sharp, scene[np.newaxis]) > psnr_db(as_seen, scene[np.newaxis]) + 6.0


def test_asymmetric_blur_deconvolved_in_correct_direction():
    layout = fs.layout.grid(n_x=21, n_y=21, pitch_um=1.0)
    grid = raster_grid(layout, 21)
    values = np.zeros((21, 21))
    values[10, 13] = 100.0  # signal of [10, 10], displaced by the lens by three pixels to the right
    kernel = np.zeros((1, 7))
    kernel[0, 6] = 1.0
    picture = least_squares(layout, values.ravel(), grid, variance=1.0, mu=1e-6, blur=kernel).data[0]

    assert np.unravel_index(picture.argmax(), picture.shape) == (10, 10)


def test_channels_use_their_own_sites():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=16, n_y=16, pitch_um=1.0), ("RG", "GB"))
    levels = np.array([100.0, 50.0, 20.0])
    values = np.where(layout.channel == np.arange(3)[:, np.newaxis], levels[:, np.newaxis], np.nan)
    picture = least_squares(layout, values, raster_grid(layout, 48), variance=np.nan_to_num(values, nan=1.0))

    assert picture.data == pytest.approx(np.broadcast_to(levels[:, None, None], (3, 48, 48)), rel=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "'mu' must be a number without 'variance'"),
        ({"mu": 0.0}, "'mu' must be > 0"),
        ({"mu": "magic"}, "'mu' must be one number, or one of 'roughness', 'discrepancy'"),
        ({"variance": 0.0}, "'variance' must be > 0.0 everywhere"),
        ({"variance": np.ones(3)}, "'variance' must be one number, or have the shape"),
        ({"variance": 1.0, "response": np.ones(3)}, "'response' must have the shape"),
        ({"variance": 1.0, "tolerance": 1.0}, "'tolerance' must be <= 0.1"),
        ({"variance": 1.0, "blur": np.ones((2, 3))}, "'blur' must have an odd number of pixels"),
        (
            {"variance": 1.0, "blur": np.zeros((3, 3))},
            "'blur' must have an odd number of pixels along each side and a positive sum",
        ),
        ({"variance": 1.0, "blur": np.ones((2, 3, 3))}, "'blur' must be one kernel, or one for each of the 1 channels"),
    ],
)
def test_invalid_least_squares_options_raise(options, message):
    with pytest.raises(ParameterError, match=message):
        least_squares(SQUARES, np.ones(SQUARES.n_sites), raster_grid(SQUARES, 20), **options)


@pytest.mark.parametrize("method", [linear, natural, fit], ids=["linear", "natural", "least squares"])
@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones(3), r"'values' must have the shape \(\.\.\., 108\), got \(3,\)"),
        (np.full(108, np.inf), "'values' must be finite, or NaN where a site has no value"),
        (np.full((2, 108), np.nan), "'values' must have a number for at least one site, got none in channel 0"),
        (["a"], "'values' must be an array of numbers"),
    ],
)
def test_invalid_values_raise_by_name(method, values, message):
    with pytest.raises(ParameterError, match=message):
        method(SQUARES, values, raster_grid(SQUARES, 20))


def test_nonconvergence_raises_simulation_error():
    values = np.random.default_rng(1).uniform(1.0, 9.0, FOVEAL.n_sites)

    with pytest.raises(SimulationError, match="did not converge in 2 steps; increase 'tolerance', 'mu' or 'max_steps'"):
        fit(FOVEAL, values, raster_grid(FOVEAL, 60), mu=1e-3, max_steps=2)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("name", ["astronaut", "coffee", "chelsea"])
@pytest.mark.parametrize(
    "layout",
    [
        fs.layout.log_polar(n_sectors=64, min_size_um=2.0, r_max_um=128.0, stagger=True),
        fs.layout.hexagonal(n_columns=42, n_rows=48, pitch_um=6.0),
        fs.layout.zones(side_um=(32, 64, 128, 256), pitch_um=(2, 4, 8, 16)),
    ],
    ids=["log-polar", "hexagons", "zones"],
)
def test_least_squares_has_higher_psnr_than_cells(layout, name):
    grid = fs.Grid.centred((128, 128), 2.0)
    grey = skimage.color.rgb2gray(getattr(skimage.data, name)())
    light = 1.0 + 99.0 * skimage.transform.resize(grey, (128, 128), anti_aliasing=True)[::-1] ** 2.2
    values = np.random.default_rng(1).poisson(Integrator(layout, grid)(light)).astype(float)
    sharp = least_squares(layout, values, grid, variance=values + 1.0)
    blocky = cells(layout, values / layout.area_um2, grid)

    assert (
        psnr_db(sharp, light[np.newaxis], min_coverage=1.0) > psnr_db(blocky, light[np.newaxis], min_coverage=1.0) + 1.0
    )


# -- rasters ----------------------------------------------------------------------------------------------------------


def test_reference_matches_integrator_on_squares():
    light = fs.PowerMap.from_array(
        np.random.default_rng(1).uniform(0, 9, (2, 23, 31)), pitch_um=0.7, wavelength_nm=[500, 600]
    )
    layout = fs.layout.grid(n_x=9, n_y=7, pitch_um=1.1).translate(0.3, -0.4)
    picture = reference(light, fs.Grid((7, 9), 1.1, layout.bounds_um[:2]))
    expected = Integrator(layout, light.grid)(light.data) / 1.1**2

    assert picture.data.reshape(2, -1) == pytest.approx(expected, rel=1e-6)
    assert picture.coverage == pytest.approx(np.ones((7, 9)))


def test_reference_conserves_power_nan_off_map():
    light = fs.PowerMap.from_array(np.arange(12.0).reshape(3, 4), pitch_um=1.0, wavelength_nm=500)
    picture = reference(light, fs.Grid.centred((9, 9), 0.8), weights=np.array([[2.0]]))
    total = np.nansum(picture.data[0] * picture.coverage, dtype=np.float64) * 0.64

    assert np.isnan(picture.data[0, 0, 0])
    assert total == pytest.approx(2.0 * 66.0, rel=1e-6)


def test_blur_kernel_matches_imaged_pixel():
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0, source_pixel="square", padding_cells=40, precision="double")
    picture = np.zeros((81, 81))
    picture[40, 40] = 1.0
    magnification = optics.magnification(0.5)
    scene = fs.Scene.from_picture(
        picture,
        pitch_um=1.5 / magnification,
        distance_m=0.5,
        peak_radiance_w_m2_sr_nm=1.0,
        wavelength_nm=(550.0,),
        band_width_nm=10.0,
        encoding="linear",
    )
    lit = optics.power_map(scene).data[0]
    kernel = blur_kernel(optics, optics.grid(scene), wavelength_nm=550.0, distance_m=0.5, radius=6)
    centre = lit[34:47, 34:47]

    assert kernel.shape == (13, 13)
    assert kernel == pytest.approx(centre / centre.sum(), abs=3e-3 * kernel.max())


# -- captures ---------------------------------------------------------------------------------------------------------


def capture_of(layout, **parameters):
    """Return camera, power map and capture of a uniform scene of 100 electrons per µm²."""
    sensor = fs.Sensor(layout, **{"bits": 12, "capacitance_f": 5e-14, "v_sat_v": 1.0, **parameters})
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    low, high = layout.xy_um.min(0), layout.xy_um.max(0)
    n = int((high - low).max()) + 20
    light = fs.PowerMap.from_array(np.full((n, n), 1.0), pitch_um=1.0, wavelength_nm=550.0)
    exposure_s = 100.0 / float(camera.reference(light, fs.Grid.centred((1, 1), 1.0), exposure_s=1.0).data[0, 0, 0])
    return camera, light, camera.capture(light, exposure_s=exposure_s, seed=3)


@pytest.mark.parametrize("method", ["cells", "linear", "natural", "least_squares"])
@pytest.mark.parametrize("of", ["code", "electrons", "expected_e", "light_e"])
def test_uniform_scene_is_uniform_per_area(method, of):
    _, _, capture = capture_of(ZONES)
    picture = capture.picture(method, of=of, per="um2", max_pixels=64)
    dn_per_e = 2.0**12 / 312_075.0  # full scale of 50 fF at 1 V
    expected = 100.0 * (dn_per_e if of == "code" else 1.0)

    assert np.mean(picture.data) == pytest.approx(expected, rel=0.2 if of == "code" else 0.05)
    if of == "expected_e":
        assert picture.data == pytest.approx(np.full_like(picture.data, 100.0), rel=1e-5)


def test_area_scaled_capacitances_give_uniform_codes():
    capacitance_f = 1e-15 * ZONES.area_um2
    camera, _, capture = capture_of(ZONES, capacitance_f=capacitance_f, shot_noise="off")
    site, area = (
        capture.picture("least_squares", per=per, max_pixels=64, sensor=camera.sensor).data for per in ("site", "um2")
    )

    assert capture.code.std() / capture.code.mean() < 0.01
    assert site == pytest.approx(np.full_like(site, capture.code.mean()), rel=0.01)
    assert area.std() / area.mean() < 0.01


def test_dark_signal_and_pedestal_are_subtracted():
    dark = {"dark_e_per_s": 2e6, "pedestal_v": 0.05}
    camera, _, capture = capture_of(SQUARES, **dark)
    for of in ("light_e", "electrons", "expected_e"):
        found = capture.picture("least_squares", of=of, per="um2", max_pixels=24)
        assert found.data.mean() == pytest.approx(100.0, rel=0.05)
    assert capture.expected_e.mean() > 400.0 + 0.5 * 2e6 * capture.settings["exposure_s"]
    assert camera.sensor.dark_e_per_s == 2e6


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"companding": "root"},
        {"companding": "log"},
        {"nonlinearity_fraction": 0.2},
        {"nonlinearity_fraction": -0.1},
        {"pedestal_v": 0.1},
    ],
    ids=["linear", "root", "log", "nonlinear", "rising", "pedestal"],
)
def test_photoelectrons_estimated_from_code_unbiased(parameters):
    layout = fs.layout.grid(n_x=50, n_y=40, pitch_um=2.0)
    sensor = fs.Sensor(
        layout, bits=12, capacitance_f=1e-15, v_sat_v=2.0, read_noise_e=5.0, dark_e_per_s=1e4, **parameters
    )
    light_e = np.linspace(200.0, 6000.0, layout.n_sites)
    code = sensor.read(sensor.collect(light_e + 100.0, seed=1), seed=1)
    estimates = estimate_from_code(code, sensor, 0.01)
    z = (estimates.light_e - light_e) / np.sqrt(estimates.variance_e2)

    assert abs(z.mean()) < 5.0 / math.sqrt(z.size)
    assert z.std() == pytest.approx(1.0, abs=5.0 / math.sqrt(2.0 * z.size))
    assert not estimates.is_saturated.any()


def test_saturated_sites_are_flagged():
    sensor = fs.Sensor(SQUARES, full_well_e=1000.0, bits=8, capacitance_f=1e-15, v_sat_v=0.1)
    charge = np.where(np.arange(SQUARES.n_sites) < 10, 1000.0, 500.0)

    assert np.flatnonzero(estimate_from_charge(charge, sensor, 0.01).is_saturated).tolist() == list(range(10))
    assert estimate_from_code(np.array([255] + [9] * (SQUARES.n_sites - 1)), sensor, 0.01).is_saturated.sum() == 1


def test_least_squares_excludes_saturated_sites():
    _, _, capture = capture_of(SQUARES)
    code = capture.code.copy()
    code[54] = 4095
    glaring = fs.Capture(
        **{
            f: getattr(capture, f)
            for f in (
                "layout",
                "electrons",
                "expected_e",
                "filter_of_site",
                "filter_names",
                "bits",
                "white_dn",
                "settings",
            )
        },
        code=code,
    )
    picture = glaring.picture("least_squares", max_pixels=24)

    assert np.nanmax(picture.data) < 100.0
    assert np.nanmax(glaring.picture("cells", max_pixels=24).data) == 4095.0


@pytest.mark.parametrize("method", ["cells", "linear", "natural", "least_squares"])
def test_mosaic_has_one_channel_per_filter(method):
    layout = fs.layout.mosaic(fs.layout.grid(n_x=16, n_y=12, pitch_um=2.0), ("RG", "GB"))
    camera, light, capture = capture_of(layout, filters="rgb")
    grid = raster_grid(layout, 32)
    picture = capture.picture(method, of="expected_e", per="um2", grid=grid)
    expected = camera.reference(light, grid, exposure_s=capture.settings["exposure_s"])

    assert picture.data.shape == (3, 24, 32)
    assert picture.data == pytest.approx(expected.data, rel=1e-4)


def test_loaded_capture_gives_same_picture(tmp_path):
    _, _, capture = capture_of(ZONES, read_noise_e=4.0)
    capture.save(tmp_path / "c.npz")
    one, other = (
        c.picture("least_squares", of="light_e", max_pixels=64).data
        for c in (capture, fs.Capture.load(tmp_path / "c.npz"))
    )

    assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda c, _: c.picture("natural", mu=1.0),
            "'mu' must be an option of the method 'natural'; possible: 'n_threads'",
        ),
        (
            lambda c, _: c.picture("least_squares", magic=1.0),
            "'magic' must be an option of the method 'least_squares'; possible: 'blur', 'max_steps'",
        ),
        (lambda c, _: c.picture(of="magic"), "'of' must be one of"),
        (lambda c, _: c.picture(per="magic"), "'per' must be one of"),
        (lambda c, _: c.picture(per="um2", sensor="magic"), "'sensor' must be a Sensor, got a str"),
        (
            lambda _, k: k.reference("magic", fs.Grid((2, 2), 1.0), exposure_s=1.0),
            "'light' must be a Scene or a PowerMap",
        ),
    ],
)
def test_invalid_picture_options_raise(call, message):
    camera, _, capture = capture_of(SQUARES, capacitance_f=np.full(SQUARES.n_sites, 5e-14))

    with pytest.raises(ParameterError, match=message):
        call(capture, camera)


# -- files ------------------------------------------------------------------------------------------------------------


def asymmetric(n_channels):
    """Picture without symmetry and with one uncovered pixel."""
    data = np.random.default_rng(1).uniform(0.0, 2.0, (n_channels, 5, 4)).astype(np.float32)
    data[:, 1, 2] = np.nan
    coverage = np.ones((5, 4), np.float32)
    coverage[1, 2] = 0.0
    return Picture(data, coverage, fs.Grid((5, 4), 1.0))


@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize("name", ["p.tif", "p.tiff", "p.exr"])
def test_float_files_preserve_values_and_nan(tmp_path, n_channels, name):
    picture = asymmetric(n_channels)
    picture.save(tmp_path / name)
    read = read_picture(tmp_path / name)

    assert read.dtype == np.float32
    assert np.array_equal(np.atleast_3d(read), np.moveaxis(picture.data[:, ::-1], 0, -1), equal_nan=True)


@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize("name", ["p.png", "p.tif"])
@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (16, np.uint16)])
def test_integer_files_preserve_values(tmp_path, n_channels, name, bits, kind):
    picture = asymmetric(n_channels)
    picture.save(tmp_path / name, 2.0, bits=bits, encode_srgb=False)
    image = picture.to_image(2.0, bits=bits, encode_srgb=False)

    assert image.dtype == kind
    assert image[-2, 2, -1] == 0
    assert image[0, 0, 0] == round(float(picture.data[0, -1, 0]) / 2.0 * (2**bits - 1))
    np.testing.assert_array_equal(read_picture(tmp_path / name), image, strict=True)


def test_float_file_is_relative_to_white(tmp_path):
    picture = asymmetric(3)
    picture.save(tmp_path / "p.tif", np.array([1.0, 2.0, 4.0]))
    expected = np.moveaxis(picture.data / np.array([1.0, 2.0, 4.0]).reshape(3, 1, 1), 0, -1)[::-1]

    assert read_picture(tmp_path / "p.tif") == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("n_channels", [2, 5])
def test_other_numbers_of_channels_are_averaged(n_channels):
    picture = asymmetric(n_channels)
    white = np.arange(1.0, n_channels + 1.0)
    grey = np.mean(picture.data / white.reshape(-1, 1, 1), axis=0, keepdims=True)

    assert picture.to_rgb(white).data == pytest.approx(grey, nan_ok=True)
    expected = Picture(np.asarray(grey), picture.coverage, picture.grid)
    np.testing.assert_array_equal(replace(picture, white=white).to_image(), expected.to_image())


@pytest.mark.parametrize(
    ("n_channels", "name", "options", "error", "message"),
    [
        (1, "p.png", {"bits": 12}, ParameterError, "'bits' must be one of 8, 16, 32"),
        (1, "p.png", {"bits": 32}, fs.errors.FileError, "only 1 to 4 channels of uint8 or uint16"),
        (1, "p.exr", {"bits": 16}, fs.errors.FileError, "only 1 to 4 channels of float32"),
        (1, "p.jpg", {"bits": 16}, fs.errors.FileError, "only 1 to 4 channels of uint8"),
        (1, "p.tif", {"encode_srgb": True}, ParameterError, "'encode_srgb' must be False for floating-point files"),
        (2, "p.tif", {}, ParameterError, "'data' must have 1 or 3 channels to be saved without 'white', got 2"),
        (1, "p.tif", {"background": "white"}, ParameterError, "'white' must be given with 'background'"),
        (1, "nowhere/p.exr", {}, fs.errors.FileError, "the directory .*nowhere does not exist"),
    ],
)
def test_unsupported_files_raise_without_output(tmp_path, n_channels, name, options, error, message):
    with pytest.raises(error, match=message):
        asymmetric(n_channels).save(tmp_path / name, **options)

    assert list(tmp_path.iterdir()) == []


def partly_covered(n_channels):
    """Picture with covered, partly covered and uncovered pixels."""
    picture = asymmetric(n_channels)
    coverage = np.array(picture.coverage)
    coverage[2, 1], coverage[3, 3] = 0.25, 0.5
    return Picture(picture.data, coverage, picture.grid)


def composed_by_pillow(picture, colour, **options):
    """Picture over a colour, composed by another program from the transparent PNG file."""
    image = picture.to_image(2.0, **options)
    rgba = image if image.shape[2] == 4 else np.dstack([image[..., :1]] * 3 + [image[..., 1:]])
    over = Image.new("RGBA", rgba.shape[1::-1], colour)
    return np.asarray(Image.alpha_composite(over, Image.fromarray(rgba)).convert("RGB")).astype(int)


@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize("encode_srgb", [False, True])
@pytest.mark.parametrize(
    ("background", "rgb"), [("white", (255, 255, 255)), ("#204060", (32, 64, 96)), ((9, 200, 0), (9, 200, 0))]
)
def test_background_equals_composition_by_pillow(n_channels, encode_srgb, background, rgb):
    picture = partly_covered(n_channels)
    image = picture.to_image(2.0, encode_srgb=encode_srgb, background=background)
    expected = composed_by_pillow(picture, rgb, encode_srgb=encode_srgb)

    assert image.shape[2] == (1 if n_channels == 1 and background == "white" else 3)
    assert np.abs(np.broadcast_to(image, expected.shape) - expected).max() <= 1
    assert tuple(np.broadcast_to(image, expected.shape)[-2, 2]) == rgb


@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize(
    ("name", "tolerance"), [("p.bmp", 0), ("p.ppm", 0), ("p.jpg", 20), ("p.jpeg", 20), ("p.gif", 0)]
)
def test_formats_without_alpha_are_pale_blue_outside(tmp_path, n_channels, name, tolerance):
    picture = asymmetric(n_channels)
    smooth = np.linspace(0.4, 1.6, picture.data.size).reshape(picture.data.shape).astype(np.float32)
    picture = Picture(np.where(np.isnan(picture.data), np.nan, smooth), picture.coverage, picture.grid)
    picture.save(tmp_path / name, 2.0)
    read = np.atleast_3d(read_picture(tmp_path / name)).astype(int)
    expected = composed_by_pillow(picture, NO_DATA_COLOUR)

    assert np.abs(np.broadcast_to(read, expected.shape) - expected)[:2].max() <= tolerance
    if tolerance == 0:
        assert (read[-2, 2] == NO_DATA_COLOUR).all()


@pytest.mark.parametrize("name", ["p.png", "p.webp", "p.jp2", "p.tga"])
def test_formats_with_alpha_preserve_coverage(tmp_path, name):
    if name == "p.webp" and not features.check("webp"):
        pytest.skip("Pillow without WebP")
    picture = partly_covered(3)
    picture.save(tmp_path / name, 2.0)
    read = read_picture(tmp_path / name)

    np.testing.assert_array_equal(read[..., 3], np.rint(255 * picture.coverage[::-1]))
    np.testing.assert_array_equal(read, picture.to_image(2.0))


@pytest.mark.parametrize("name", ["p.png", "p.webp", "p.tif", "p.jp2", "p.tga"])
@pytest.mark.parametrize("n_channels", [1, 3])
def test_background_removes_alpha(tmp_path, n_channels, name):
    picture = partly_covered(n_channels)
    picture.save(tmp_path / name, 2.0, bits=8, background="black")
    read = np.atleast_3d(read_picture(tmp_path / name)).astype(int)
    expected = composed_by_pillow(picture, "black")[..., : read.shape[2]]

    assert read.shape[2] in (n_channels, 3)
    assert np.abs(read - expected).max() <= 1


@pytest.mark.parametrize("name", ["p.png", "p.tif"])
def test_deep_background_has_16_bits(tmp_path, name):
    picture = partly_covered(3)
    picture.save(tmp_path / name, 2.0, bits=16, background=(255, 128, 1))
    read = read_picture(tmp_path / name)

    assert read.dtype == np.uint16
    assert read[-2, 2].tolist() == [65535, 128 * 257, 257]
    expected = fs.units.encode_srgb(float(picture.data[0, -1, 0]) / 2.0) * 65535
    assert read[0, 0, 0] == pytest.approx(expected, abs=0.51)


@pytest.mark.parametrize("name", ["p.tif", "p.exr"])
def test_float_background_is_linear(tmp_path, name):
    picture = partly_covered(3)
    picture.save(tmp_path / name, 2.0, background=(188, 188, 188))
    read = read_picture(tmp_path / name)[::-1]

    assert read[1, 2] == pytest.approx(0.5029, abs=1e-4)  # the sRGB value 188 is half of white
    assert read[2, 1] == pytest.approx(0.25 * picture.data[:, 2, 1] / 2.0 + 0.75 * 0.5029, abs=1e-4)
    np.testing.assert_array_equal(read[0, 0], picture.data[:, 0, 0] / np.float32(2.0))


def test_srgb_file_decodes_to_linear_values(tmp_path):
    picture = asymmetric(3)
    picture.save(tmp_path / "p.png", 2.0, bits=16)
    stored = read_picture(tmp_path / "p.png")[::-1, :, :3] / 65535
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)

    assert np.moveaxis(linear, -1, 0) == pytest.approx(np.nan_to_num(picture.data) / 2.0, abs=4e-5)


@pytest.mark.parametrize("n_channels", [1, 3])
def test_other_libraries_see_the_pixels(tmp_path, n_channels):
    import matplotlib.pyplot as plt

    picture = partly_covered(n_channels)
    picture.save(tmp_path / "p.png")
    stored = np.asarray(Image.open(tmp_path / "p.png").convert("RGBA"))
    ax = plt.figure().add_subplot()
    shown = ax.imshow(picture)

    np.testing.assert_array_equal(np.asarray(picture), stored, strict=True)
    np.testing.assert_array_equal(shown.get_array(), stored)
    np.testing.assert_array_equal(np.asarray(Image.fromarray(np.asarray(picture))), stored)
    assert np.asarray(picture)[-2, 2, 3] == 0  # row 1 from below has no photosite
    assert np.asarray(picture, np.float32).dtype == np.float32
    with pytest.raises(ValueError, match="always a copy"):
        np.array(picture, copy=False)
    plt.close("all")


@pytest.mark.parametrize("background", ["whit", "#12345", (1, 2), (0, 0, 300), (0.5, 0.5, 0.5), 3, "rgb(1,2)"])
def test_invalid_background_is_rejected(tmp_path, background):
    with pytest.raises(ParameterError, match="'background' must be"):
        asymmetric(1).save(tmp_path / "p.png", background=background)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "p.jpgg",
            r"p\.jpgg: must end in one of \.bmp, \.exr, \.gif, \.jp2, \.jpeg, \.jpg, .*; did you mean '\.jpg'\?$",
        ),
        ("p", r"must end in one of .*, \.webp$"),
    ],
)
def test_unknown_picture_format_lists_formats(tmp_path, name, message):
    with pytest.raises(fs.errors.FileError, match=message):
        asymmetric(1).save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_image_of_three_bits_raises():
    with pytest.raises(ParameterError, match="'bits' must be one of 8, 16, got 3"):
        asymmetric(1).to_image(bits=3)


def test_channel_without_sites_is_nan():
    filled = fill_channels(SQUARES, np.ones(SQUARES.n_sites), np.zeros(SQUARES.n_sites, np.int64), 2)

    assert np.isnan(filled[1]).all()
