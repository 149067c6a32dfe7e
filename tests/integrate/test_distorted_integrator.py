"""Integration with undistorted outlines: brute force, conservation of power, sites outside the image circle."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.distortion import BrownConrady, Fisheye, Scaramuzza
from foveasim.errors import CoverageWarning, ParameterError

BARREL = BrownConrady(focal_um=200.0, k1=-0.12, k2=0.02, p1=0.03, p2=-0.02)
GRID = fs.Grid.centred((240, 240), 0.5)
LAYOUTS = {
    "hexagons": lambda: fs.layout.tiling(pitch_um=9.0, radius_um=50.0),
    "rings": lambda: fs.layout.log_polar(n_sectors=16, r_min_um=6.0, r_max_um=44.0, fovea="rings", chords_per_arc=3),
    "quads": lambda: fs.layout.quadtree(np.eye(16), pitch_um=6.0, limit=0.5, n_levels=3),
}


@cache
def layout_named(name):
    return LAYOUTS[name]()


def field(x_um, y_um):
    """Return a smooth irradiance in the ideal plane."""
    return 2.0 + np.sin(0.05 * x_um + 0.3) * np.cos(0.04 * y_um) + 0.01 * x_um


def field_means(grid, n=3):
    """Return means over cells by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    x, y = grid.x_um[np.newaxis, :], grid.y_um[:, np.newaxis]
    return sum(
        0.25 * wx * wy * field(x + 0.5 * grid.pitch_um * nx, y + 0.5 * grid.pitch_um * ny)
        for nx, wx in zip(nodes, weights, strict=True)
        for ny, wy in zip(nodes, weights, strict=True)
    )


def real_irradiance(lens, grid, *, density):
    """Return the irradiance in the sensor plane: the ideal field, times the Jacobian determinant if flux is conserved."""
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    points = np.stack((x.ravel(), y.ravel()), axis=1)
    h = 1e-4
    right, up = np.array([h, 0.0]), np.array([0.0, h])
    ideal = lens.undistort(points)
    dx = (lens.undistort(points + right) - lens.undistort(points - right)) / (2 * h)
    dy = (lens.undistort(points + up) - lens.undistort(points - up)) / (2 * h)
    stretch = 1.0 if density else dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
    return (field(*ideal.T) * stretch).reshape(grid.shape)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", LAYOUTS)
def test_distorted_maps_converge_to_undistorted_outlines(name):
    layout = layout_named(name)
    fine = fs.Grid.centred((1000, 1000), 0.14)
    undistorted = fs.Integrator(layout, fine, distortion=BARREL)(field_means(fine))
    errors = []
    for n in (48, 150, 600):
        grid = fs.Grid.centred((n, n), 120.0 / n)
        warped = fs.Integrator(layout, grid)(real_irradiance(BARREL, grid, density=False))
        errors.append(float(np.abs(warped / undistorted - 1).max()))

    assert errors[0] > 3 * errors[1]
    assert errors[1] > 3 * errors[2]
    assert errors[2] < 4e-5


@pytest.mark.parametrize("name", ["hexagons", "rings", "quads"])
def test_tiling_power_sums_to_union_power(name):
    layout = layout_named(name)
    union = fs.Layout.from_polygons([shapely.coverage_union_all(layout.polygons())])
    cells = field_means(GRID)
    parts = fs.Integrator(layout, GRID, distortion=BARREL)(cells)
    total = fs.Integrator(union, GRID, distortion=BARREL)(cells)

    assert parts.sum() == pytest.approx(total[0], rel=1e-9)


@pytest.mark.parametrize("name", LAYOUTS)
def test_conserving_density_preserves_uniform_field(name):
    layout = layout_named(name)
    density = fs.Integrator(layout, GRID, distortion=BARREL, conserve="density")(np.full(GRID.shape, 3.0))
    flux = fs.Integrator(layout, GRID, distortion=BARREL)(np.full(GRID.shape, 3.0))

    np.testing.assert_allclose(density, 3.0 * layout.area_um2, rtol=1e-12)
    assert np.ptp(flux / layout.area_um2) > 0.05


def test_ideal_lens_leaves_integrals_unchanged():
    for layout in map(layout_named, LAYOUTS):
        plain = fs.Integrator(layout, GRID)
        undistorted = fs.Integrator(layout, GRID, distortion=BrownConrady(focal_um=100.0))
        np.testing.assert_allclose(undistorted(field_means(GRID)), plain(field_means(GRID)), rtol=1e-12)
        assert undistorted.sites_outside_image_circle.size == 0


@pytest.mark.parametrize("conserve", ["flux", "density"])
def test_operator_adjoint_and_matrix_agree(conserve):
    layout = layout_named("hexagons")
    integrator = fs.Integrator(layout, GRID, distortion=BARREL, conserve=conserve)
    cells = field_means(GRID)
    values = np.linspace(1, 2, layout.n_sites)

    np.testing.assert_allclose(integrator.weights() @ cells.ravel(), integrator(cells), rtol=1e-12)
    assert (integrator.spread(values) * cells).sum() == pytest.approx((integrator(cells) * values).sum(), rel=1e-12)


@settings(max_examples=examples(12))
@given(x_um=st.floats(-40, 40), y_um=st.floats(-40, 40))
def test_point_source_appears_at_distorted_position(x_um, y_um):
    """An asymmetric lens, points in all four quadrants: neither axis is mirrored."""
    layout = fs.layout.grid(n_x=100, n_y=100, pitch_um=1.0)
    grid = fs.Grid.centred((400, 400), 0.3)
    column, row = (int(np.floor((v + 60.0) / 0.3)) for v in (x_um, y_um))
    cells = np.zeros(grid.shape)
    cells[row, column] = 1.0
    lens = BrownConrady(focal_um=100.0, k1=-0.2, p1=0.1, p2=-0.05)
    power = fs.Integrator(layout, grid, distortion=lens)(cells)
    expected_um = lens.distort([[grid.x_um[column], grid.y_um[row]]])[0]
    centroid_um = (layout.centroid_um * power[:, np.newaxis]).sum(axis=0) / power.sum()

    assert power.sum() == pytest.approx(grid.cell_area_um2, rel=1e-9)
    assert np.hypot(*(centroid_um - expected_um)) < 0.8


def test_sites_outside_image_circle_are_reported():
    layout = fs.layout.grid(n_x=30, n_y=30, pitch_um=10.0)
    lens = Fisheye(projection="orthographic", focal_um=100.0)
    grid = fs.Grid.centred((400, 400), 4.0)
    integrator = fs.Integrator(layout, grid, distortion=lens)
    power = integrator(np.ones(grid.shape))
    corner_um = np.hypot(*np.abs(layout.xy_um.reshape(-1, 4, 2)).max(axis=1).T)

    # Points on the image circle are at infinity.
    assert set(integrator.sites_outside_image_circle) == set(np.flatnonzero(corner_um >= 100.0))
    assert np.all(power[integrator.sites_outside_image_circle] == 0.0)
    assert np.all(integrator.uncovered_um2[integrator.sites_outside_image_circle] > 0.0)
    inner = np.flatnonzero(corner_um < 60.0)
    assert np.all(power[inner] > layout.area_um2[inner])


def test_camera_accepts_any_lens_model():
    layout = fs.layout.hexagonal(n_columns=12, n_rows=12, pitch_um=8.0)
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    scene = fs.Scene.flat(
        shape=(150, 150), pitch_um=200.0, distance_m=1.0, radiance_w_m2_sr_nm=0.2, band_width_nm=100.0
    )
    plain = fs.Camera(optics=optics, sensor=fs.Sensor(layout))
    lens = Scaramuzza(a=(3600.0, -2e-5, 0.0, 0.0), pixel_um=2.2, focal_um=8000.0)
    distorted = fs.Camera(optics=optics, sensor=fs.Sensor(layout), distortion=lens)
    captures = [camera.capture(scene, exposure_s=0.01, seed=1) for camera in (plain, distorted)]

    assert captures[1].settings["distortion"]["a"] == list(lens.a)
    assert captures[0].settings["distortion"] is None
    assert distorted.distortion == lens
    assert not np.allclose(captures[0].expected_e, captures[1].expected_e, rtol=1e-6)


@pytest.mark.filterwarnings("ignore:the focal length of the lens model")  # a short one, for strong distortion
def test_camera_warns_of_sites_outside_image_circle():
    layout = fs.layout.hexagonal(n_columns=12, n_rows=12, pitch_um=8.0)
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    scene = fs.Scene.flat(
        shape=(600, 600), pitch_um=800.0, distance_m=1.0, radiance_w_m2_sr_nm=0.2, band_width_nm=100.0
    )
    camera = fs.Camera(
        optics=optics, sensor=fs.Sensor(layout), distortion=Fisheye(projection="orthographic", focal_um=40.0)
    )
    with pytest.warns(CoverageWarning, match=r"\d+ of 144 photosites lie outside the image circle of the lens"):
        camera.capture(scene, exposure_s=0.01, seed=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distortion": 3.0}, "'distortion' must be a lens of foveasim.distortion, got 3.0"),
        ({"distortion": BARREL, "conserve": "light"}, "'conserve' must be one of 'flux', 'density', got 'light'"),
    ],
)
def test_integrator_rejects_invalid_distortion(options, message):
    with pytest.raises(ParameterError, match=message):
        fs.Integrator(layout_named("hexagons"), GRID, **options)


@pytest.mark.parametrize("kind", ["grid", "log_polar"])
def test_selections_have_identical_integrals(kind):
    """Edges are split independently of the other sites, with a different lens curvature in every part of the field."""
    layout = (
        fs.layout.grid(n_x=30, n_y=30, pitch_um=6.0)
        if kind == "grid"
        else fs.layout.log_polar(n_sectors=24, r_max_um=90.0, r_min_um=8.0, n_rings=9)
    )
    lens = BrownConrady(focal_um=300.0, k1=-0.3, k2=0.05, p1=0.01, centre_um=(10.0, -5.0))
    grid = fs.Grid.centred((300, 300), 1.0)
    cells = np.random.default_rng(0).random(grid.shape)
    power = fs.Integrator(layout, grid, distortion=lens)(cells)
    for low, high in ((-20.0, 60.0), (0.0, 15.0)):
        sites = np.flatnonzero((np.abs(layout.centroid_um - 0.5 * (low + high)) < 0.5 * (high - low)).all(axis=1))
        assert 0 < sites.size < layout.n_sites
        crop = fs.Integrator(layout[sites], grid, distortion=lens)(cells)
        np.testing.assert_allclose(crop, power[sites], rtol=1e-12)
