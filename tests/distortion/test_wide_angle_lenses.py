"""Wide-angle lens models against their defining formulas, thin prisms and tilts against OpenCV."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

import foveasim as fs
from foveasim.distortion import BrownConrady, DoubleSphere, ExtendedUnified, FieldOfView, Omnidirectional
from foveasim.errors import ParameterError

SIZE, PIXEL_UM = (640, 480), 3.0
MATRIX = np.array([[400.0, 0.0, 318.2], [0.0, 405.0, 243.9], [0.0, 0.0, 1.0]])
COEFFICIENTS = np.array([-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.001, 0.004, -0.003, 0.002, 0.005, 0.05, -0.03])


@pytest.fixture(scope="module")
def rays():
    """Return directions (x, y, 1), y down as in the formulas, up to 50 degrees from the axis along x and y."""
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 13), np.linspace(-1.2, 1.2, 13))
    return np.stack((x.ravel(), y.ravel(), np.ones(x.size)), axis=1)


def in_plane(lens, rays, focal_px):
    """Return pixels from the centre, y down, that a lens gives for rays; focal lengths of its calibration in pixels."""
    ideal = rays[:, :2] * np.broadcast_to(lens.focal_um, 2) * [1.0, -1.0]
    return lens.distort(ideal) / PIXEL_UM * [1.0, -1.0]


@pytest.mark.parametrize("n", [8, 12, 14])
def test_prisms_and_tilts_match_opencv(rays, n):
    k = COEFFICIENTS[:n]
    lens = fs.distortion.from_opencv(MATRIX, k, image_size=SIZE, pixel_um=PIXEL_UM)
    narrow = rays * [0.5, 0.5, 1.0]
    expected_px = cv2.projectPoints(narrow, np.zeros(3), np.zeros(3), MATRIX, k)[0][:, 0]

    centre_um = np.array(lens.centre_um)
    ideal_um = narrow[:, :2] * lens.focal_um * [1.0, -1.0] + centre_um
    real_um = lens.distort(ideal_um)
    found_px = real_um / PIXEL_UM * [1.0, -1.0] + [319.5, 239.5]
    np.testing.assert_allclose(found_px, expected_px, atol=1e-9)
    np.testing.assert_allclose(lens.undistort(real_um), ideal_um, atol=1e-8)
    matrix, again = fs.distortion.to_opencv(lens, image_size=SIZE, pixel_um=PIXEL_UM)
    np.testing.assert_allclose(matrix, MATRIX, atol=1e-9)
    np.testing.assert_allclose(again, np.pad(k, (0, again.size - n)), atol=1e-15)


def test_determinant_vanishes_at_the_fold():
    """Numerical derivatives of the map, independent of the polynomials of the fold."""
    lens = BrownConrady(focal_um=1000.0, k1=-0.3, s1=0.05, s2=-0.02, s3=0.03, s4=0.01)
    limit_um, _ = lens.max_radius_um
    step = 1e-3
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)

    def determinants(radius_um):
        at = radius_um * np.stack((np.cos(angle), np.sin(angle)), axis=1)
        dx, dy = (
            (lens.distort(at + each, outside="mask") - lens.distort(at - each, outside="mask")) / (2.0 * step)
            for each in ([step, 0.0], [0.0, step])
        )
        return dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]

    assert np.nanmin(determinants(0.999 * limit_um)) > 0.0
    assert np.nanmin(determinants(0.999 * limit_um)) < 0.02


@pytest.mark.parametrize("tau_rad", [0.2, -0.5])
def test_tilted_sensors_have_a_horizon(tau_rad):
    """Rays parallel to the sensor, at f cot τ from the axis, have no image."""
    lens = BrownConrady(focal_um=1000.0, tau_x_rad=tau_rad)
    limit_um = 1000.0 / math.tan(abs(tau_rad))

    assert lens.max_radius_um[0] == pytest.approx(limit_um, rel=1e-6)
    beyond = [[0.0, math.copysign(1.01 * limit_um, tau_rad)]]
    assert np.isnan(lens.distort(beyond, outside="mask")).all()
    with pytest.raises(fs.errors.GeometryError, match=rf"the model is valid up to {limit_um:.4g}"):
        lens.distort(beyond)
    bent = BrownConrady(focal_um=1000.0, k1=0.2, tau_x_rad=tau_rad)  # radial distortion, then the tilt: r + 0.2 r³
    reached = bent.max_radius_um[0] / 1000.0
    assert reached + 0.2 * reached**3 == pytest.approx(limit_um / 1000.0, rel=1e-6)


def test_omnidirectional_follows_mei(rays):
    xi, gamma, k1, k2, p1, p2 = 1.1, 500.0, -0.1, 0.02, 0.003, -0.002
    lens = Omnidirectional(xi=xi, focal_um=gamma * PIXEL_UM / (1.0 + xi), k1=k1, k2=k2, p1=-p1, p2=p2)
    unit = rays / np.linalg.norm(rays, axis=1)[:, np.newaxis]
    x, y = (unit[:, :2] / (unit[:, 2:] + xi)).T
    r2 = x**2 + y**2
    radial = 1.0 + k1 * r2 + k2 * r2**2
    expected = gamma * np.stack(
        (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2), y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y), axis=1
    )  # fmt: skip

    np.testing.assert_allclose(in_plane(lens, rays, gamma), expected, atol=1e-9)


def test_extended_unified_follows_khomutenko(rays):
    alpha, beta, focal = 0.6, 1.3, 300.0
    x, y, z = rays.T
    depth = alpha * np.sqrt(beta * (x**2 + y**2) + z**2) + (1.0 - alpha) * z
    lens = ExtendedUnified(alpha=alpha, beta=beta, focal_um=focal * PIXEL_UM)

    np.testing.assert_allclose(
        in_plane(lens, rays, focal), focal * np.stack((x, y), axis=1) / depth[:, np.newaxis], atol=1e-9
    )


@pytest.mark.parametrize(("xi", "alpha"), [(-0.2, 0.6), (0.3, 0.4), (0.0, 0.5)])
def test_double_sphere_follows_usenko(rays, xi, alpha):
    focal = 300.0
    x, y, z = rays.T
    first = np.sqrt(x**2 + y**2 + z**2)
    second = np.sqrt(x**2 + y**2 + (xi * first + z) ** 2)
    depth = alpha * second + (1.0 - alpha) * (xi * first + z)
    lens = DoubleSphere(xi=xi, alpha=alpha, focal_um=focal * PIXEL_UM / (1.0 + xi))

    np.testing.assert_allclose(
        in_plane(lens, rays, focal), focal * np.stack((x, y), axis=1) / depth[:, np.newaxis], atol=1e-9
    )


def test_field_of_view_follows_devernay(rays):
    w, focal = 0.93, 300.0
    radius = np.hypot(rays[:, 0], rays[:, 1])
    distorted = np.arctan(2.0 * radius * math.tan(0.5 * w)) / w
    scale = np.divide(distorted, radius, out=np.full_like(radius, 2.0 * math.tan(0.5 * w) / w), where=radius > 0.0)
    lens = FieldOfView(w_rad=w, focal_um=focal * PIXEL_UM * 2.0 * math.tan(0.5 * w) / w)

    np.testing.assert_allclose(in_plane(lens, rays, focal), focal * rays[:, :2] * scale[:, np.newaxis], atol=1e-9)


def test_models_agree_where_they_are_the_same():
    """On a unit sphere seen from its surface, all are the stereographic projection; at 0, a pinhole."""
    xy_um = np.array([[500.0, -200.0], [1500.0, 900.0], [0.0, 0.0]])
    stereographic = fs.distortion.Fisheye(projection="stereographic", focal_um=1000.0).distort(xy_um)
    for lens in (
        Omnidirectional(xi=1.0, focal_um=1000.0),
        ExtendedUnified(alpha=0.5, beta=1.0, focal_um=1000.0),
        DoubleSphere(xi=0.0, alpha=0.5, focal_um=1000.0),
    ):
        np.testing.assert_allclose(lens.distort(xy_um), stereographic, atol=1e-9)
    for lens in (
        Omnidirectional(xi=0.0, focal_um=1000.0),
        ExtendedUnified(alpha=0.0, beta=1.0, focal_um=1000.0),
        DoubleSphere(xi=0.5, alpha=0.0, focal_um=1000.0),
    ):
        expected = (
            xy_um if not isinstance(lens, DoubleSphere) else Omnidirectional(xi=0.5, focal_um=1000.0).distort(xy_um)
        )
        np.testing.assert_allclose(lens.distort(xy_um), expected, atol=1e-9)


@pytest.mark.parametrize(
    "lens",
    [
        Omnidirectional(
            xi=1.4, focal_um=(900.0, 1000.0), k1=-0.08, k2=0.01, p1=0.002, p2=-0.003, centre_um=(12.0, -7.0)
        ),
        Omnidirectional(xi=0.8, focal_um=1000.0, k1=-0.6),
        ExtendedUnified(alpha=0.7, beta=1.5, focal_um=1000.0),
        DoubleSphere(xi=-0.3, alpha=0.65, focal_um=1000.0),
        FieldOfView(w_rad=1.2, focal_um=1000.0),
        BrownConrady(focal_um=1000.0, k1=-0.1, s1=0.02, s3=-0.01, tau_x_rad=0.1, tau_y_rad=-0.2),
    ],
    ids=repr,
)
def test_directions_are_inverse_within_the_limits(lens):
    ideal_um, real_um = lens.max_radius_um
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, 300), np.sqrt(rng.uniform(0.0, 1.0, 300))
    points = np.stack((np.cos(angle), np.sin(angle)), axis=1) * radius[:, np.newaxis]
    xy_um = points * 0.99 * min(ideal_um, 3000.0) + lens.centre_um
    real = lens.distort(xy_um)

    np.testing.assert_allclose(lens.undistort(real), xy_um, atol=1e-6)
    inside = points * 0.99 * min(real_um, 1500.0) + lens.centre_um
    np.testing.assert_allclose(lens.distort(lens.undistort(inside)), inside, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Omnidirectional(xi=-0.1, focal_um=1e3), "'xi' must be >= 0"),
        (lambda: ExtendedUnified(alpha=1.1, beta=1.0, focal_um=1e3), "'alpha' must be <= 1"),
        (lambda: ExtendedUnified(alpha=0.5, beta=0.0, focal_um=1e3), "'beta' must be > 0"),
        (lambda: DoubleSphere(xi=-1.0, alpha=0.5, focal_um=1e3), "'xi' must be > -1"),
        (lambda: FieldOfView(w_rad=57.0, focal_um=1e3), "'w_rad' must be <= 3.1, got 57.0 rad; angles are in rad"),
        (lambda: BrownConrady(focal_um=1e3, tau_x_rad=5.0), "tilts are in rad"),
    ],
)
def test_parameters_beyond_their_ranges_are_rejected(call, message):
    with pytest.raises(ParameterError, match=message):
        call()
