"""Directions of lens models, beyond 90° too, against published formulas, OpenCV and OCamCalib."""

from __future__ import annotations

import math

import numpy as np
import pytest

import foveasim as fs
from foveasim.distortion import (
    BrownConrady,
    DoubleSphere,
    ExtendedUnified,
    FieldOfView,
    Fisheye,
    Omnidirectional,
    PolynomialFisheye,
    Scaramuzza,
)
from foveasim.errors import GeometryError, ParameterError

N = 10_000
FOCAL_UM, CENTRE_UM = 700.0, (12.0, -7.0)
K = (-0.02, 0.003, -0.0007, 0.00004)


def directions_up_to(angle_deg, seed=3):
    """Return unit vectors of all azimuths up to an angle from the axis."""
    random = np.random.default_rng(seed)
    cosine = random.uniform(math.cos(math.radians(angle_deg)), 1.0, N)
    azimuth = random.uniform(-math.pi, math.pi, N)
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack((sine * np.cos(azimuth), sine * np.sin(azimuth), cosine), axis=1)


def radial(d, height_of_rad):
    """Return points whose distance from the centre is a function of the angle."""
    across = np.hypot(d[:, 0], d[:, 1])
    height = height_of_rad(np.arctan2(across, d[:, 2]))
    return d[:, :2] * (height / across)[:, np.newaxis]


def unified(d, xi):
    """Mei and Rives: from the unit sphere to the plane at 1, seen from (0, 0, -ξ)."""
    return d[:, :2] / (d[:, 2] + xi)[:, np.newaxis]


def extended(d, alpha, beta):
    x, y, z = d.T
    depth = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1.0 - alpha) * z
    return d[:, :2] / depth[:, np.newaxis]


def double_sphere(d, xi, alpha):
    x, y, z = d.T
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    return d[:, :2] / (alpha * d2 + (1.0 - alpha) * (xi * d1 + z))[:, np.newaxis]


def field_of_view(d, w):
    x, y, z = d.T
    r_u = np.hypot(x, y)
    r_d = np.arctan2(2.0 * r_u * math.tan(0.5 * w), z) / w
    return d[:, :2] * (r_d / r_u)[:, np.newaxis]


#: Models, their published formulas in focal lengths of the calibration, its focal length over ours, and the largest angle.
MODELS = {
    "equidistant": (Fisheye, {"projection": "equidistant"}, lambda d: radial(d, lambda t: t), 1.0, 180.0),
    "equisolid": (Fisheye, {"projection": "equisolid"}, lambda d: radial(d, lambda t: 2 * np.sin(t / 2)), 1.0, 180.0),
    "stereographic": (
        Fisheye,
        {"projection": "stereographic"},
        lambda d: 2.0 * d[:, :2] / (1.0 + d[:, 2:]),
        1.0,
        180.0,
    ),
    "orthographic": (Fisheye, {"projection": "orthographic"}, lambda d: d[:, :2], 1.0, 90.0),
    "polynomial": (
        PolynomialFisheye,
        {"k": K},
        lambda d: radial(d, lambda t: t * (1 + K[0] * t**2 + K[1] * t**4 + K[2] * t**6 + K[3] * t**8)),
        1.0,
        180.0,
    ),
    "unified": (Omnidirectional, {"xi": 0.8}, lambda d: unified(d, 0.8), 1.8, math.degrees(math.acos(-0.8))),
    "catadioptric": (Omnidirectional, {"xi": 1.6}, lambda d: unified(d, 1.6), 2.6, math.degrees(math.acos(-1 / 1.6))),
    "extended": (
        ExtendedUnified,
        {"alpha": 0.6, "beta": 1.1},
        lambda d: extended(d, 0.6, 1.1),
        1.0,
        180.0 - math.degrees(math.atan(math.sqrt((1.0 - (2 / 3) ** 2) / ((2 / 3) ** 2 * 1.1)))),
    ),
    "double_sphere": (
        DoubleSphere,
        {"xi": -0.2, "alpha": 0.6},
        lambda d: double_sphere(d, -0.2, 0.6),
        0.8,
        math.degrees(math.acos(-(2 / 3 - 0.2) / math.sqrt(2 * 2 / 3 * -0.2 + 0.04 + 1.0))),
    ),
    "field_of_view": (
        FieldOfView,
        {"w_rad": 0.9},
        lambda d: field_of_view(d, 0.9),
        0.9 / (2.0 * math.tan(0.45)),
        180.0,
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_directions_match_published_formulas(name):
    model, parameters, formula, focal_ratio, largest_deg = MODELS[name]
    lens = model(focal_um=(FOCAL_UM, 1.1 * FOCAL_UM), centre_um=CENTRE_UM, **parameters)
    assert lens.max_angle_deg == pytest.approx(largest_deg, abs=1e-6)

    # Near the largest angle the height does not grow, or grows without limit: the direction is not determined to 1e-9 rad.
    d = directions_up_to(0.97 * largest_deg)
    expected_um = formula(d) * np.multiply(lens.focal_um, focal_ratio) + CENTRE_UM
    found_um = lens.project(3.0 * d)
    np.testing.assert_allclose(found_um, expected_um, rtol=1e-11, atol=1e-8)
    found = lens.direction(expected_um)
    np.testing.assert_allclose(np.square(found).sum(axis=1), 1.0, atol=1e-14)
    assert np.abs(found - d).max() < 1e-9


def test_distorted_unified_model_inverts_beyond_90_degrees():
    """OpenCV's omnidir: x_d = x (1 + k1 r² + k2 r⁴) + 2 p1 x y + p2 (r² + 2 x²), with y down."""
    lens = Omnidirectional(xi=1.1, focal_um=FOCAL_UM, k1=-0.05, k2=0.004, p1=-0.001, p2=0.002)
    d = directions_up_to(105.0)
    x, y = (unified(d, 1.1) * [1.0, -1.0]).T
    r2 = x * x + y * y
    factor = 1.0 - 0.05 * r2 + 0.004 * r2**2
    p1, p2 = 0.001, 0.002  # for y down
    x_d = x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    y_d = y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    expected_um = 2.1 * FOCAL_UM * np.stack((x_d, -y_d), axis=1)
    np.testing.assert_allclose(lens.project(d), expected_um, atol=1e-8)
    assert np.abs(lens.direction(expected_um) - d).max() < 1e-9


def test_fisheye_directions_match_opencv():
    """``cv2.fisheye`` projects points in front of the camera only."""
    cv2 = pytest.importorskip("cv2")
    matrix = np.array([[400.0, 0.0, 318.2], [0.0, 405.0, 243.9], [0.0, 0.0, 1.0]])
    lens = fs.distortion.from_opencv(matrix, K, image_size=(640, 480), pixel_um=3.0, fisheye=True)
    d = directions_up_to(85.0)
    down = (d * [1.0, -1.0, 1.0])[np.newaxis]
    px = cv2.fisheye.projectPoints(down, np.zeros(3), np.zeros(3), matrix, np.array(K))[0][0]
    at_um = (px - [319.5, 239.5]) * [3.0, -3.0]
    np.testing.assert_allclose(lens.project(d), at_um, atol=1e-8)
    assert np.abs(lens.direction(at_um) - d).max() < 1e-9


def test_unified_directions_match_opencv_beyond_90_degrees():
    cv2 = pytest.importorskip("cv2")
    if not hasattr(cv2, "omnidir"):
        pytest.skip("cv2.omnidir is part of opencv-contrib-python")
    lens = Omnidirectional(xi=1.1, focal_um=FOCAL_UM, k1=-0.05, k2=0.004, p1=-0.001, p2=0.002)
    d = directions_up_to(105.0)
    matrix = np.diag([2.1 * FOCAL_UM, 2.1 * FOCAL_UM, 1.0])
    down = (d * [1.0, -1.0, 1.0])[np.newaxis]
    at = cv2.omnidir.projectPoints(
        down, np.zeros(3), np.zeros(3), matrix, 1.1, np.array([[-0.05, 0.004, 0.001, 0.002]])
    )[0]
    at_um = at.reshape(-1, 2) * [1.0, -1.0]
    np.testing.assert_allclose(lens.project(d), at_um, atol=1e-8)
    assert np.abs(lens.direction(at_um) - d).max() < 1e-9


def test_scaramuzza_directions_match_ocamcalib_beyond_90_degrees():
    """OCamCalib's cam2world: the ray of the point (x, y) is (x, y, f(r)), after the inverse of the stretch."""
    a, pixel_um = (-209.2, 0.0, 0.00213, -4.2e-06, 1.77e-08), 2.0
    lens = Scaramuzza(
        a=[a[0], *a[2:]],
        pixel_um=pixel_um,
        focal_um=420.0,
        stretch=((1.001, 0.002), (-0.001, 1.0)),
        centre_um=CENTRE_UM,
    )
    radius, azimuth = np.random.default_rng(5).uniform((1.0, -math.pi), (370.0, math.pi), (N, 2)).T
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    # The axis of OCamCalib points into the camera.
    ray = np.stack((x, y, -np.polynomial.polynomial.polyval(radius, a)), axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    assert math.degrees(math.acos(ray[:, 2].min())) > 95.0

    at_um = pixel_um * np.stack((x, y), axis=1) @ np.array(lens.stretch).T + CENTRE_UM
    assert np.abs(lens.direction(at_um) - ray).max() < 1e-9
    np.testing.assert_allclose(lens.project(ray), at_um, atol=1e-7)


@pytest.mark.parametrize(
    "lens",
    [
        BrownConrady(focal_um=FOCAL_UM, k1=-0.1, p1=0.002, centre_um=CENTRE_UM),
        Fisheye(projection="equisolid", focal_um=(FOCAL_UM, 800.0)),
        DoubleSphere(xi=0.3, alpha=0.55, focal_um=FOCAL_UM),
    ],
)
def test_directions_of_ideal_points_are_theirs(lens):
    """In front of the lens, the direction of a point is that of its ideal position in the plane."""
    ideal_um = np.random.default_rng(1).uniform(-500.0, 500.0, (4, 5, 2))
    tangents = (ideal_um - lens.centre_um) / np.broadcast_to(lens.focal_um, 2)
    found = lens.direction(lens.distort(ideal_um))
    assert found.shape == (4, 5, 3)
    np.testing.assert_allclose(found[..., :2] / found[..., 2:], tangents, atol=1e-11)
    np.testing.assert_allclose(lens.project(found), lens.distort(ideal_um), atol=1e-8)


def test_points_beyond_the_field_are_errors():
    lens = Fisheye(projection="equidistant", focal_um=100.0)
    with pytest.raises(
        GeometryError, match=r"1 points have no direction: the nearest lies 320 µm .* up to 314\.159 µm"
    ):
        lens.direction([[320.0, 0.0], [100.0, 0.0]])
    assert np.isnan(lens.direction([[320.0, 0.0]], outside="mask")).all()
    assert np.isnan(lens.project([[0.0, 0.0, -1.0]], outside="mask")).all()

    plane = BrownConrady(focal_um=100.0, k1=-0.1)
    with pytest.raises(GeometryError, match=r"2 directions cannot be projected: the nearest is at 90° to the axis"):
        plane.project([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.1, 0.0, 1.0]])
    assert np.isnan(plane.direction([[500.0, 0.0]], outside="mask")).all()
    with pytest.raises(ParameterError, match="'directions' must not be 0"):
        lens.project([0.0, 0.0, 0.0])
    with pytest.raises(ParameterError, match=r"'directions' must have the shape \(\.\.\., 3\), got \(2,\)"):
        lens.project([1.0, 0.0])
