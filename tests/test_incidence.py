"""Cones of light: chief rays, tables, cubature of the pupil."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gamma

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.incidence import disc_cubature

FIELD_UM = np.array([[0.0, 0.0], [1000.0, 0.0], [-600.0, 800.0]])


def disc_moment(p, q):
    """Return the mean of x^p y^q over the unit disc in closed form."""
    if p % 2 or q % 2:
        return 0.0
    return 2.0 / (p + q + 2.0) * gamma((p + 1) / 2) * gamma((q + 1) / 2) / gamma((p + q) / 2 + 1) / np.pi


@pytest.mark.parametrize(("n_rings", "degree"), [(1, 3), (2, 5), (3, 9), (8, 29)])
def test_disc_cubature_is_exact_for_polynomials(n_rings, degree):
    points, weights = disc_cubature(n_rings, max(4 * n_rings - 2, 6))
    x, y = points.T

    assert len(weights) == n_rings * max(4 * n_rings - 2, 6)
    for p in range(degree + 1):
        for q in range(degree + 1 - p):
            assert weights @ (x**p * y**q) == pytest.approx(disc_moment(p, q), abs=1e-14)


@pytest.mark.parametrize("angle_deg", [(0.0, 12.0, 30.0, 22.0), (0.0, -5.0, -2.0, -1.0)])
@pytest.mark.parametrize("is_table", [False, True])
def test_largest_tangent_of_chief_rays(angle_deg, is_table):
    table = fs.optics.ChiefRayTable(image_height_um=(0.0, 400.0, 1000.0, 2000.0), angle_deg=angle_deg)
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.0, chief_ray=table if is_table else None)
    x_um, y_um = np.linspace(-700.0, 1100.0, 901), np.linspace(-300.0, 500.0, 401)
    cone = replace(optics.incidence(FIELD_UM), displacement_um=(30.0, -250.0)).on_axes(x_um, y_um)
    slope = np.hypot(*cone.chief_ray.T)

    assert cone.largest_tangent == pytest.approx(slope.max(), rel=1e-5)
    at = cone.at(np.stack(np.meshgrid(x_um, y_um), axis=-1).reshape(-1, 2))
    assert at.largest_tangent == pytest.approx(slope.max(), rel=1e-5)
    assert cone.at(np.zeros((0, 2))).largest_tangent == 0.0


def test_chief_rays_come_from_exit_pupil():
    cone = fs.Optics(focal_length_mm=8.0, f_number=2.0, exit_pupil_mm=12.5).incidence(FIELD_UM)

    np.testing.assert_allclose(cone.chief_ray, FIELD_UM / 12_500.0, rtol=1e-14)


def test_thin_lens_is_its_exit_pupil():
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.0)
    image_um = 1000.0 / (1.0 / 8.0 - 1.0 / 200.0)  # thin lens, scene at 0.2 m
    cone = lens.incidence(FIELD_UM, 0.2)

    np.testing.assert_allclose(cone.chief_ray, FIELD_UM / image_um, rtol=1e-13)
    assert cone.radius == pytest.approx(0.5 * 8000.0 / 2.0 / image_um, rel=1e-13)


def test_telecentric_lens_has_normal_chief_rays():
    cone = fs.Optics(focal_length_mm=8.0, f_number=2.0, exit_pupil_mm=np.inf).incidence(FIELD_UM)

    np.testing.assert_array_equal(cone.chief_ray, 0.0)


def test_rows_and_columns_are_positions():
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.0)
    x_um, y_um = np.array([-3.0, 0.0, 4.0]), np.array([1.0, 2.0])
    cone = pickle.loads(pickle.dumps(lens.incidence(FIELD_UM).on_axes(x_um, y_um))).with_rings(3)
    expected = np.stack(np.meshgrid(x_um, y_um), axis=-1).reshape(-1, 2)

    assert (cone.n_sites, cone.n_rings) == (6, 3)
    np.testing.assert_array_equal(cone.positions_um(np.array([4, 2])), expected[[4, 2]])
    np.testing.assert_array_equal(cone.field_um, expected)
    np.testing.assert_array_equal(cone.chief_ray, lens.incidence(expected).chief_ray)


def test_displacement_moves_field_but_not_design():
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.0, exit_pupil_mm=10.0)
    cone = lens.incidence(FIELD_UM, displacement_um=(50.0, -20.0))

    np.testing.assert_allclose(cone.chief_ray, (FIELD_UM + np.array([50.0, -20.0])) / 10_000.0, rtol=1e-13)
    np.testing.assert_allclose(cone.design(), FIELD_UM / 10_000.0, rtol=1e-13)


def test_table_interpolates_tangent_monotonically():
    heights_um, angles_deg = (0.0, 500.0, 1000.0, 1500.0, 2000.0), (0.0, 12.0, 20.0, 20.0, 20.5)
    table = fs.optics.ChiefRayTable(image_height_um=heights_um, angle_deg=angles_deg)
    height_um = np.linspace(0.0, 2000.0, 401)
    tangents = table.tangents(np.column_stack((0.6 * height_um, -0.8 * height_um)))
    tangent = np.hypot(*tangents.T)

    np.testing.assert_allclose(tangent[::100], np.tan(np.radians(angles_deg)), rtol=1e-13)
    assert (np.diff(tangent) >= -1e-15).all()
    np.testing.assert_allclose(tangents[1:, 1] / tangents[1:, 0], -0.8 / 0.6, rtol=1e-12)  # radial


def test_linear_table_equals_exit_pupil():
    heights_um = np.linspace(0.0, 2000.0, 9)
    table = fs.optics.ChiefRayTable(image_height_um=heights_um, angle_deg=np.degrees(np.arctan(heights_um / 9000.0)))
    options = {"focal_length_mm": 8.0, "f_number": 2.0}
    by_table = fs.Optics(**options, chief_ray=table).incidence(FIELD_UM)
    by_pupil = fs.Optics(**options, exit_pupil_mm=9.0).incidence(FIELD_UM)

    np.testing.assert_allclose(by_table.chief_ray, by_pupil.chief_ray, atol=1e-13)
    assert by_table.um_per_tangent == pytest.approx(by_pupil.um_per_tangent)


def test_ray_weights_are_those_of_irradiance():
    # Irradiance behind a pupil, ∫ dt / (1 + t²)², in closed form.
    cone = fs.Optics(focal_length_mm=8.0, f_number=1.0, exit_pupil_mm=2.0).incidence([[0.0, 0.0], [1200.0, 0.0]])
    cone = cone.with_rings(12)
    rho, c = cone.radius, cone.chief_ray[:, 0]
    plus = 1.0 + c**2 + rho**2
    expected = 0.5 * (1.0 - (1.0 + c**2 - rho**2) / np.sqrt(plus**2 - 4.0 * c**2 * rho**2))
    squared = np.square(cone.tangents).sum(axis=2)
    total = (cone.rays()[1] / (1.0 + squared) ** 2).sum(axis=1) * rho**2

    np.testing.assert_allclose(total, expected, rtol=1e-10)
    np.testing.assert_allclose(cone.weights.sum(axis=1), 1.0, rtol=1e-13)


def test_pupils_weigh_rays_from_their_side():
    # A pupil that is open at x > 0: light propagates from there towards -x.
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.0, pupil=lambda x, y, wavelength_nm: x > 0.0)
    cone = lens.incidence([[0.0, 0.0]])

    assert cone.weights[0][cone.tangents[0, :, 0] > 0.0].sum() == 0.0
    assert cone.weights.sum() == pytest.approx(1.0)


def test_pupils_without_light_raise_errors():
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.0, pupil=lambda x, y, wavelength_nm: np.zeros_like(x))

    with pytest.raises(ParameterError, match="'n_rings' must be larger: the pupil transmits none of the rays, got 8"):
        _ = lens.incidence([[0.0, 0.0]]).weights


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"exit_pupil_mm": -3.0}, "'exit_pupil_mm' must be > 0, got -3.0 mm; distances of exit pupils are in mm"),
        (
            {"exit_pupil_mm": 9.0, "chief_ray": fs.optics.ChiefRayTable((0.0, 9.0), (0.0, 5.0))},
            "'exit_pupil_mm' must not be given with 'chief_ray', got 9.0 mm",
        ),
    ],
)
def test_lens_rejects_wrong_exit_pupils(parameters, match):
    with pytest.raises(ParameterError, match=match):
        fs.Optics(focal_length_mm=8.0, f_number=2.8, **parameters)


@pytest.mark.parametrize(
    ("heights_um", "angles_deg", "match"),
    [
        ((0.0, 500.0, 400.0), (0.0, 5.0, 6.0), "'image_height_um' must have at least two values that ascend from 0"),
        ((10.0, 500.0), (0.0, 5.0), "'image_height_um' must have at least two values that ascend from 0"),
        ((0.0, 500.0), (0.0, 5.0, 9.0), "'angle_deg' must have one value for each of the 2 heights, got 3"),
        ((0.0, 500.0), (2.0, 5.0), "'angle_deg' must be 0 on the axis, got 2.0 degrees"),
        ((0.0, 500.0), (0.0, 95.0), "'angle_deg' must be <= 80 everywhere, got 95"),
    ],
)
def test_table_rejects_wrong_values(heights_um, angles_deg, match):
    with pytest.raises(ParameterError, match=match):
        fs.optics.ChiefRayTable(heights_um, angles_deg)


def test_sites_beyond_table_raise_errors():
    table = fs.optics.ChiefRayTable((0.0, 900.0), (0.0, 20.0))

    with pytest.raises(
        ParameterError, match="'image_height_um' must extend to 1000 µm, the largest distance of a site"
    ):
        _ = fs.Optics(focal_length_mm=8.0, f_number=2.0, chief_ray=table).incidence(FIELD_UM).chief_ray


# -- irradiance ----------------------------------------------------------------------------------------------------------


def irradiance_by_rays(tangent, radius, n=400):
    """Sum the radiance 1 over the rays of a cone: midpoint rule over its disc in the plane of tangents."""
    r, angle = (np.arange(n) + 0.5) / n * radius, 2.0 * np.pi * (np.arange(n) + 0.5) / n
    x, y = tangent + r[:, None] * np.cos(angle), r[:, None] * np.sin(angle)
    return float((r[:, None] / (1.0 + x * x + y * y) ** 2).sum() * radius / n * 2.0 * np.pi / n)


def falloff(lens, height_um):
    """Return the irradiance of a uniform scene at a height over that on the axis."""
    scene = fs.Scene.flat(
        shape=(3, 401), pitch_um=2.0 * height_um / 400 / lens.magnification(1.0), distance_m=1.0,
        radiance_w_m2_sr_nm=1.0, wavelength_nm=[550.0], band_width_nm=1.0,
    )  # fmt: skip
    row = np.asarray(lens.power_map(scene).data[0, 1])
    return float(row[-1] / row[200])


@pytest.mark.filterwarnings("ignore:the image of the scene is only")
@pytest.mark.parametrize("kind", ["thin", "aplanatic"])
@pytest.mark.parametrize("exit_pupil_mm", [8.0, 12.0, np.inf])
def test_irradiance_is_integral_over_the_cone(exit_pupil_mm, kind):
    lens = fs.Optics(
        focal_length_mm=8.0,
        f_number=1.4,
        exit_pupil_mm=exit_pupil_mm,
        lens=kind,
        padding="edge",
        precision="double",
        oversample=1,
    )
    height_um = 2000.0
    radius = float(lens.incidence([[0.0, 0.0]], 1.0).radius)
    expected = irradiance_by_rays(height_um / (1e3 * exit_pupil_mm), radius) / irradiance_by_rays(0.0, radius)

    assert falloff(lens, height_um) == pytest.approx(expected, abs=2e-4)
    sine2 = radius**2 / (1.0 + radius**2)
    assert lens.irradiance_per_radiance(1.0) == pytest.approx(np.pi * sine2, rel=1e-9)
    assert irradiance_by_rays(0.0, radius) == pytest.approx(np.pi * sine2, rel=1e-4)


@pytest.mark.filterwarnings("ignore:the image of the scene is only")
def test_table_of_chief_rays_determines_irradiance():
    options = {"focal_length_mm": 8.0, "f_number": 2.0, "padding": "edge", "precision": "double", "oversample": 1}
    angles = np.degrees(np.arctan(np.linspace(0.0, 0.25, 30)))
    table = fs.optics.ChiefRayTable(np.linspace(0.0, 3000.0, 30).tolist(), angles.tolist())
    by_pupil, by_table = fs.Optics(**options, exit_pupil_mm=12.0), fs.Optics(**options, chief_ray=table)

    assert falloff(by_table, 2000.0) == pytest.approx(falloff(by_pupil, 2000.0), abs=1e-5)
    assert falloff(fs.Optics(**options), 2000.0) < falloff(by_pupil, 2000.0) - 0.03
