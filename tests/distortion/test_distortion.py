"""Lens models: closed forms, inverses, fold radii, comparison with OpenCV, calibration files of other programs."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from foveasim import distortion
from foveasim.distortion import (
    BrownConrady,
    Fisheye,
    PolynomialFisheye,
    Scaramuzza,
    from_opencv,
    read_calibration,
    to_opencv,
)
from foveasim.errors import ConfigError, FileError, GeometryError, ParameterError

cv2 = pytest.importorskip("cv2")

relaxed = settings(max_examples=examples(30))
SIZE = (1920, 1080)
PIXEL_UM = 2.2


def disc(radius, n=400, seed=0):
    rng = np.random.default_rng(seed)
    r, a = radius * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return np.stack((r * np.cos(a), r * np.sin(a)), axis=1)


def to_pixels(xy_um):
    """Convert positions in the sensor plane to OpenCV pixel coordinates."""
    return np.stack(
        (xy_um[:, 0] / PIXEL_UM + 0.5 * (SIZE[0] - 1), 0.5 * (SIZE[1] - 1) - xy_um[:, 1] / PIXEL_UM), axis=1
    )


def to_um(pixels):
    x, y = pixels[:, 0], pixels[:, 1]
    return PIXEL_UM * np.stack((x - 0.5 * (SIZE[0] - 1), 0.5 * (SIZE[1] - 1) - y), axis=1)


# -- Brown-Conrady ---------------------------------------------------------------------------------------------------


def test_inverse_is_accurate_for_random_coefficients():
    rng = np.random.default_rng(1)
    worst_px = 0.0
    for i in range(200):
        tangential = rng.normal(0, 0.02, 2) * (i % 4 == 0)
        lens = BrownConrady(
            focal_um=1000.0, k1=rng.normal(0, 0.3), k2=rng.normal(0, 0.2), k3=rng.normal(0, 0.1) * (i % 2),
            p1=tangential[0], p2=tangential[1],
        )  # fmt: skip
        radius_um = 0.9999 * min(lens.max_radius_um[0], 2000.0)
        real_um = lens.distort(disc(radius_um, 50, i))
        again_um = lens.distort(lens.undistort(real_um))
        worst_px = max(worst_px, float(np.abs(again_um - real_um).max()))

    assert worst_px < 1e-10


@relaxed
@given(
    k=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), st.floats(-0.1, 0.1)),
    p=st.tuples(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03)),
)
def test_fold_is_smallest_radius_without_injectivity(k, p):
    """The determinant from finite differences is positive at all samples within the fold, and negative at some beyond."""
    lens = BrownConrady(focal_um=1.0, k1=k[0], k2=k[1], k3=k[2], p1=p[0], p2=p[1])
    ideal = lens.max_radius_um[0]
    angle = np.linspace(0, 2 * np.pi, 721)

    def determinant(radius):
        h = 1e-6
        right, up = np.array([h, 0.0]), np.array([0.0, h])
        xy = radius * np.stack((np.cos(angle), np.sin(angle)), axis=1)
        dx = (lens._map(xy + right) - lens._map(xy - right)) / (2 * h)
        dy = (lens._map(xy + up) - lens._map(xy - up)) / (2 * h)
        return dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]

    for fraction in np.linspace(0.05, 0.995, 20):
        assert determinant(fraction * min(ideal, 5.0)).min() > 0.0
    if ideal < 5.0:
        assert determinant(1.01 * ideal).min() < 0.0


def test_barrel_fold_matches_closed_form():
    lens = BrownConrady(focal_um=1000.0, k1=-0.3)
    fold = math.sqrt(1 / 0.9)  # 1 + 3 k1 r² = 0

    assert lens.max_radius_um == pytest.approx((1000 * fold, 1000 * fold * (1 - 0.3 * fold**2)))
    with pytest.raises(
        GeometryError, match=r"1 points cannot be distorted: the nearest lies 1100 µm .* valid up to 1054.09 µm"
    ):
        lens.distort([[1100.0, 0.0]])
    with pytest.raises(GeometryError, match=r"cannot be undistorted: .* or outside='mask'"):
        lens.undistort([[10.0, 0.0], [0.0, 800.0]])
    masked = lens.undistort([[10.0, 0.0], [0.0, 800.0]], outside="mask")
    assert np.isnan(masked[1]).all()
    assert lens.distort(masked[:1]) == pytest.approx(np.array([[10.0, 0.0]]))


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, 270.0])
def test_image_limit_is_smallest_over_directions(turn_deg):
    turn = math.radians(turn_deg)
    p2, p1 = 0.02 * math.cos(turn), 0.02 * math.sin(turn)
    lens = BrownConrady(focal_um=1000.0, k1=-0.3, p1=p1, p2=p2)
    ideal_um, real_um = lens.max_radius_um
    angle = np.linspace(0.0, 2.0 * np.pi, 3601)
    boundary_um = 0.99999 * ideal_um * np.stack((np.cos(angle), np.sin(angle)), axis=1)

    assert real_um == pytest.approx(np.hypot(*lens.distort(boundary_um).T).min(), rel=1e-4)


def test_lens_without_coefficients_is_identity():
    points_um = disc(5000.0)

    assert BrownConrady(focal_um=1000.0).distort(points_um) == pytest.approx(points_um, rel=1e-15)
    assert BrownConrady(focal_um=1000.0).max_radius_um == (math.inf, math.inf)


@pytest.mark.parametrize("n", [4, 5, 8])
def test_distorted_points_match_opencv_projection(n):
    matrix = np.array([[1480.3, 0, 948.2], [0, 1485.1, 561.7], [0, 0, 1]])
    k = np.array([-0.21, 0.08, 0.004, -0.003, 0.01, 0.05, -0.02, 0.003])[:n]
    lens = from_opencv(matrix, k, image_size=SIZE, pixel_um=PIXEL_UM)
    normalised = disc(0.7, 300)
    ideal_px = normalised * [matrix[0, 0], matrix[1, 1]] + matrix[:2, 2]
    world = np.concatenate((normalised, np.ones((300, 1))), axis=1)
    real_px = cv2.projectPoints(world, np.zeros(3), np.zeros(3), matrix, k)[0][:, 0]

    np.testing.assert_allclose(to_pixels(lens.distort(to_um(ideal_px))), real_px, atol=1e-6)
    np.testing.assert_allclose(to_pixels(lens.undistort(to_um(real_px))), ideal_px, atol=1e-6)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4 / OpenCV 5
    back = undistort(real_px[:, None], matrix, k, None, matrix, criteria=criteria)[:, 0]
    np.testing.assert_allclose(to_pixels(lens.undistort(to_um(real_px))), back, atol=1e-6)
    matrix_again, k_again = to_opencv(lens, image_size=SIZE, pixel_um=PIXEL_UM)
    np.testing.assert_allclose(matrix_again, matrix, rtol=1e-12)
    np.testing.assert_allclose(k_again[:n], k, rtol=1e-12)


def test_tangential_signs_match_opencv():
    """An asymmetric letter F with tangential terms only: up and down differ, and so do left and right."""
    letter_px = np.array([[900, 300], [900, 700], [1100, 300], [1020, 480], [900, 480]], float)
    matrix = np.array([[1000.0, 0, 960], [0, 1000.0, 540], [0, 0, 1]])
    k = np.array([0.0, 0.0, 0.05, -0.02])
    lens = from_opencv(matrix, k, image_size=(1921, 1081), pixel_um=1.0)
    world = np.concatenate(((letter_px - matrix[:2, 2]) / 1000.0, np.ones((5, 1))), axis=1)
    opencv_px = cv2.projectPoints(world, np.zeros(3), np.zeros(3), matrix, k)[0][:, 0]
    distorted = lens.distort(np.stack((letter_px[:, 0] - 960, 540 - letter_px[:, 1]), axis=1))

    np.testing.assert_allclose(np.stack((distorted[:, 0] + 960, 540 - distorted[:, 1]), axis=1), opencv_px, atol=1e-9)
    assert lens.p1 == -0.05
    # Points move down: a positive p1 of OpenCV displaces points towards +y of its image coordinates.
    assert np.all(opencv_px[:, 1] > letter_px[:, 1])


# -- fisheyes --------------------------------------------------------------------------------------------------------

HEIGHTS = {
    "equidistant": lambda t: t,
    "equisolid": lambda t: 2 * math.sin(t / 2),
    "stereographic": lambda t: 2 * math.tan(t / 2),
    "orthographic": math.sin,
}


@pytest.mark.parametrize("projection", HEIGHTS)
@pytest.mark.parametrize("degrees", [0.0, 1e-9, 5.0, 45.0, 80.0, 89.9])
def test_image_height_matches_projection(projection, degrees):
    lens = Fisheye(projection=projection, focal_um=1000.0)
    theta = math.radians(degrees)
    ideal_um = np.array([[0.6, -0.8]]) * 1000.0 * math.tan(theta)
    real_um = lens.distort(ideal_um)

    assert np.hypot(*real_um[0]) == pytest.approx(1000.0 * HEIGHTS[projection](theta), rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(lens.undistort(real_um), ideal_um, rtol=1e-10, atol=1e-12)


def test_points_beyond_image_circle_are_masked():
    lens = Fisheye(projection="orthographic", focal_um=1000.0)

    assert lens.max_radius_um == (math.inf, pytest.approx(1000.0))
    assert np.isnan(lens.undistort([[1000.1, 0.0]], outside="mask")).all()
    assert np.isfinite(lens.undistort([[999.9, 0.0]], outside="mask")).all()


def test_polynomial_fisheye_matches_opencv():
    matrix = np.array([[520.0, 0, 955.5], [0, 521.0, 544.2], [0, 0, 1]])
    k = np.array([0.05, -0.01, 0.004, -0.0007])
    lens = from_opencv(matrix, k, image_size=SIZE, pixel_um=PIXEL_UM, fisheye=True)
    normalised = disc(2.5, 300)
    ideal_px = normalised * [520.0, 521.0] + matrix[:2, 2]
    real_px = cv2.fisheye.distortPoints(normalised[:, None], matrix, k)[:, 0]

    np.testing.assert_allclose(to_pixels(lens.distort(to_um(ideal_px))), real_px, atol=1e-6)
    np.testing.assert_allclose(to_pixels(lens.undistort(to_um(real_px))), ideal_px, atol=1e-6)
    again, k_again = to_opencv(lens, image_size=SIZE, pixel_um=PIXEL_UM)
    np.testing.assert_allclose(again, matrix, rtol=1e-12)
    np.testing.assert_allclose(k_again, k)


@relaxed
@given(k=st.tuples(*[st.floats(-0.1, 0.1)] * 4))
def test_polynomial_fisheye_inverts_over_increasing_range(k):
    lens = PolynomialFisheye(k=k, focal_um=1000.0)
    theta = np.linspace(0, 0.9999 * lens._max_theta_rad(), 200)
    height = np.array([t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9 for t in theta])

    assert np.all(np.diff(height) > 0)
    real_um = np.stack((1000 * height, np.zeros(200)), axis=1)
    np.testing.assert_allclose(lens.undistort(real_um)[:, 0], 1000 * np.tan(theta), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(lens.distort(lens.undistort(real_um)), real_um, atol=1e-9)


# -- Scaramuzza ------------------------------------------------------------------------------------------------------

MOBIUS = {"a": (1.57e3, -2.75e-4, 3.76e-8, -3.64e-11), "pixel_um": 2.2, "focal_um": 22e3}


def test_scaramuzza_with_a0_only_is_pinhole():
    lens = Scaramuzza(a=(1000.0, 0, 0, 0), pixel_um=2.0, focal_um=2000.0)
    points_um = disc(4000.0)

    np.testing.assert_allclose(lens.distort(points_um), points_um, rtol=1e-12)
    np.testing.assert_allclose(lens.undistort(points_um), points_um, rtol=1e-12)


def test_scaramuzza_series_approximates_equidistant_projection():
    f = 1000.0
    lens = Scaramuzza(a=(f, -1 / (3 * f), 0, -1 / (45 * f**3)), pixel_um=1.0, focal_um=f)
    same = Fisheye(projection="equidistant", focal_um=f)
    points_um = disc(0.3 * f)

    np.testing.assert_allclose(lens.distort(points_um), same.distort(points_um), atol=2.2e-3 * 0.3**7 * f)


@pytest.mark.parametrize("stretch", [((1, 0), (0, 1)), ((1.01, 0.02), (-0.01, 1.0))])
def test_scaramuzza_inverse_is_accurate(stretch):
    lens = Scaramuzza(**MOBIUS, stretch=stretch, centre_um=(31.0, -12.0))
    real_um = disc(0.99 * min(lens.max_radius_um[1], 4000.0), 1000) + np.array([31.0, -12.0])
    ideal_um = lens.undistort(real_um)

    assert np.abs(lens.distort(ideal_um) - real_um).max() / 2.2 < 1e-10
    np.testing.assert_allclose(lens.undistort(lens.distort(ideal_um)), ideal_um, rtol=1e-12)


def test_scaramuzza_inverts_up_to_its_fold():
    # The depth 1 + 2 r² makes the angle of the rays largest at r = sqrt(1/2), in focal lengths.
    lens = Scaramuzza(a=(1000.0, 2e-3, 0.0, 0.0), pixel_um=1.0, focal_um=1000.0)
    assert lens.max_radius_um[1] == pytest.approx(1000.0 * math.sqrt(0.5))
    real_um = disc(0.999 * lens.max_radius_um[1], 200)

    np.testing.assert_allclose(lens.distort(lens.undistort(real_um)), real_um, atol=1e-6)


def test_ray_direction_matches_scaramuzza_polynomial():
    lens = Scaramuzza(**MOBIUS)
    a0, a2, a3, a4 = MOBIUS["a"]
    for r in (1.0, 300.0, 900.0):
        depth = a0 + a2 * r**2 + a3 * r**3 + a4 * r**4
        ideal_um = lens.undistort([[2.2 * r * 0.6, 2.2 * r * 0.8]])[0]
        assert ideal_um == pytest.approx(22e3 * r / depth * np.array([0.6, 0.8]), rel=1e-12)


def test_negative_a0_inverts_all_signs():
    negated = Scaramuzza(**{**MOBIUS, "a": tuple(-x for x in MOBIUS["a"])})

    assert negated == Scaramuzza(**MOBIUS)


# -- files -----------------------------------------------------------------------------------------------------------

MATRIX = [[1480.0, 0.0, 948.2], [0.0, 1485.0, 561.7], [0.0, 0.0, 1.0]]
COEFFICIENTS = [-0.21, 0.08, 0.004, -0.003, 0.01]
EXPECTED = from_opencv(MATRIX, COEFFICIENTS, image_size=SIZE, pixel_um=PIXEL_UM)
OPENCV_YAML = """%YAML:1.0
---
image_width: 1920
image_height: 1080
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1480., 0., 9.482e+02, 0., 1485., 561.7, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.21, 0.08, 0.004, -0.003, 0.01 ]
"""
ROS_YAML = """image_width: 1920
image_height: 1080
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [1480.0, 0.0, 948.2, 0.0, 1485.0, 561.7, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.21, 0.08, 0.004, -0.003, 0.01]}
"""
OCAMCALIB = """#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by cam2world

5 -7.5e+02 0.0 4.1e-04 -1.2e-07 3.3e-10

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

3 1000.0 500.0 10.0

#center: "row" and "column", starting from 0 (C convention)

520.5 970.25

#affine parameters "c", "d", "e"

1.001 0.002 -0.003

#image size: "height" and "width"

1080 1920
"""


def test_calibration_written_by_opencv_is_read(tmp_path):
    path = tmp_path / "calibration.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 1920), ("image_height", 1080), ("camera_matrix", np.array(MATRIX))):
        storage.write(name, value)
    storage.write("distortion_coefficients", np.array(COEFFICIENTS))
    storage.release()

    assert read_calibration(path, pixel_um=PIXEL_UM) == EXPECTED


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(OPENCV_YAML, id="OpenCV YAML"),
        pytest.param(ROS_YAML, id="ROS camera_info"),
        pytest.param(
            json.dumps({"K": np.ravel(MATRIX).tolist(), "D": COEFFICIENTS, "width": 1920, "height": 1080}), id="ROS JSON"
        ),
        pytest.param(
            json.dumps(
                {
                    "RadialDistortion": [-0.21, 0.08, 0.01], "TangentialDistortion": [0.004, -0.003], "ImageSize": [1080, 1920],
                    "IntrinsicMatrix": [[1480.0, 0, 0], [0, 1485.0, 0], [949.2, 562.7, 1]],
                }
            ),
            id="MATLAB",
        ),
    ],
)  # fmt: skip
def test_calibration_formats_yield_equal_lens(tmp_path, text):
    path = tmp_path / "calibration"
    path.write_text(text)
    lens = read_calibration(path, pixel_um=PIXEL_UM)

    assert lens.focal_um == pytest.approx(EXPECTED.focal_um)
    assert lens.centre_um == pytest.approx(EXPECTED.centre_um)
    assert [lens.k1, lens.k2, lens.k3, lens.p1, lens.p2] == pytest.approx([-0.21, 0.08, 0.01, -0.004, -0.003])


def test_ros_fisheye_yields_polynomial_fisheye(tmp_path):
    path = tmp_path / "fisheye.yaml"
    text = ROS_YAML.replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4").replace(", 0.01]", "]")
    path.write_text(text)

    assert read_calibration(path, pixel_um=PIXEL_UM).k == (-0.21, 0.08, 0.004, -0.003)


def ocam_ray(row, column):
    """Return the ray of a pixel as OCamCalib's cam2world: x down, y to the right, z into the camera."""
    c, d, e, xc, yc = 1.001, 0.002, -0.003, 520.5, 970.25
    inverse = np.linalg.inv(np.array([[c, d], [e, 1.0]]))
    x, y = inverse @ np.array([row - xc, column - yc])
    r = math.hypot(x, y)
    return x, y, -7.5e2 + 4.1e-4 * r**2 - 1.2e-7 * r**3 + 3.3e-10 * r**4


def test_ocamcalib_file_yields_same_rays(tmp_path):
    path = tmp_path / "calib_results.txt"
    path.write_text(OCAMCALIB)
    lens = read_calibration(path, pixel_um=PIXEL_UM, focal_um=1650.0)
    for row, column in ((100.0, 200.0), (520.5, 970.25), (900.0, 300.0), (700.0, 1500.0)):
        x, y, z = ocam_ray(row, column)
        ideal_um = lens.undistort(to_um(np.array([[column, row]])))[0] - np.array(lens.centre_um)
        assert ideal_um == pytest.approx(1650.0 * np.array([y / -z, -x / -z]), abs=1e-8)


def test_matlab_fisheye_yields_same_rays(tmp_path):
    path = tmp_path / "fisheye.json"
    intrinsics = {
        "MappingCoefficients": list(MOBIUS["a"]), "StretchMatrix": [[1.001, 0.002], [-0.003, 1.0]],
        "DistortionCenter": [971.25, 521.5], "ImageSize": [1080, 1920],
    }  # fmt: skip
    path.write_text(json.dumps({"Intrinsics": intrinsics}))
    lens = read_calibration(path, pixel_um=2.2, focal_um=22e3)
    u, v = 1500.0, 200.0  # pixels counted from 0
    x, y = np.linalg.inv([[1.001, 0.002], [-0.003, 1.0]]) @ np.array([u - 970.25, v - 520.5])
    r = math.hypot(x, y)
    depth = np.polynomial.Polynomial([MOBIUS["a"][0], 0, *MOBIUS["a"][1:]])(r)

    ideal_um = lens.undistort(to_um(np.array([[u, v]])))[0] - np.array(lens.centre_um)
    assert ideal_um == pytest.approx(22e3 / depth * np.array([x, -y]), rel=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("just text", "contains no calibration; provide the keys"),
        ("camera_matrix: 3", "the camera matrix must have 9 numbers, got 1"),
        ("distortion_coefficients: [1, 2, 3, 4]", "lacks a camera matrix"),
        (ROS_YAML.replace("plumb_bob", "magic"), "has the unknown distortion model 'magic'; possible: "),
        (ROS_YAML.replace("image_width: 1920\n", ""), "must specify image_width and image_height; pass 'image_size'"),
        (ROS_YAML.replace("-0.21", ".nan"), "must contain finite numbers"),
        (ROS_YAML.replace(", 0.01]", "]").replace("0.08, ", ""), "has a matrix of 1 x 5 with 3 numbers"),
        (
            ROS_YAML.replace(", 0.01]", "]").replace("cols: 5", "cols: 4").replace("0.08, ", "0.08, 1, 2, "),
            "has a matrix of 1 x 4 with 6",
        ),
        (ROS_YAML.replace("0.0, 0.0, 1.0]", "0.0, 1.0, 1.0]"), "'camera_matrix' must be"),
        (ROS_YAML.replace("1480.0", "-1480.0"), "'focal_um' must be > 0"),
        ("a: &x [1]\nb: *x", "anchors and aliases are not allowed"),
        ("a: !!python/object/apply:os.system ['true']", "is not YAML"),
        (OCAMCALIB, "contains Scaramuzza's model, which has no focal length; pass 'focal_um'"),
        (
            OCAMCALIB.replace("520.5 970.25", "520.5"),
            "must have the (coefficients|five lines of numbers of calib_results)",
        ),
        ("#polynomial\n5 1 2", "must have the five lines of numbers of calib_results.txt"),
        ("%YAML:1.0\n---\n", "contains no calibration"),
    ],
)
def test_invalid_calibration_raises_one_line_error(tmp_path, text, message):
    path = tmp_path / "calibration"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_calibration(path, pixel_um=PIXEL_UM)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: BrownConrady(focal_um=0.0), "'focal_um' must be > 0"),
        (lambda: BrownConrady(focal_um=1e3, k1=math.nan), "'k1' must be finite"),
        (lambda: BrownConrady(focal_um=1e3, centre_um=(1, 2, 3)), "'centre_um' must be two numbers"),
        (lambda: BrownConrady(focal_um=(1.0, 2.0, 3.0)), "'focal_um' must be one number, or two"),
        (lambda: Fisheye(projection="flat", focal_um=1.0), "'projection' must be one of 'equidistant'"),
        (lambda: PolynomialFisheye(k=(1, 2), focal_um=1.0), "'k' must be four numbers"),
        (lambda: Scaramuzza(a=(0, 1, 2, 3), pixel_um=1, focal_um=1), "'a' must be 1 to 10 numbers"),
        (lambda: Scaramuzza(**MOBIUS, stretch=((1, 0), (0, -1))), "'stretch' must be a 2 x 2 matrix"),
        (lambda: EXPECTED.distort([1.0, 2.0, 3.0]), r"'xy_um' must have the shape \(..., 2\)"),
        (lambda: EXPECTED.distort([[math.nan, 2.0]]), "'xy_um' must be finite"),
        (lambda: EXPECTED.distort([[1.0, 2.0]], outside="zero"), "'outside' must be one of 'error', 'mask'"),
        (lambda: to_opencv(Scaramuzza(**MOBIUS), image_size=SIZE, pixel_um=1.0), "'lens' must be a BrownConrady"),
    ],
)
def test_lens_models_reject_invalid_arguments(call, message):
    with pytest.raises(ParameterError, match=message):
        call()


def test_scaramuzza_rejects_two_focal_lengths():
    """The model is rotationally symmetric; the stretch matrix describes unequal axes."""
    with pytest.raises(ParameterError, match=r"'focal_um' must be one number, .*use 'stretch' for unequal axes"):
        distortion.Scaramuzza(a=[1500.0, 0.0, 0.0, 0.0], pixel_um=2.0, focal_um=(3000.0, 6000.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"K": [1, 2, 3], "RadialDistortion": [0.1, 0.2], "ImageSize": [480, 640]}', "must have a matrix of 3 x 3 numbers, got 3"),
        ('{"K": [[500,0,1],[0,500,1],[0,0,1]], "RadialDistortion": [0.1, 0.2], "ImageSize": [480.5, 640]}', "must be an integer"),
        ('{"MappingCoefficients": [700, 0, 0, 0], "DistortionCenter": [320, 240], "ImageSize": [480, 640], "StretchMatrix": [1, 0, 1]}', "must have a matrix of 2 x 2"),
        ("#polynomial\ninf 1 0 0 0 0\n1\n1 1\n1 0 0\n480 640\n", "must have the five lines of numbers of calib_results.txt"),
        ("#polynomial\n5 -1500 0 0 0 0\n1 2\n240 320\n1 0 0\ninf 640\n", "must be finite"),
    ],
)  # fmt: skip
def test_wrong_number_count_raises_one_line_error(tmp_path, text, message):
    path = tmp_path / "calibration.txt"
    path.write_text(text)

    with pytest.raises(FileError, match=message) as caught:
        distortion.read_calibration(path, pixel_um=2.0, focal_um=1000.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("image_size", [(640,), 5, (640.5, 480), ("640", "480")])
def test_read_calibration_rejects_invalid_image_size(tmp_path, image_size):
    path = tmp_path / "calibration.yaml"
    path.write_text("camera_matrix: [500, 0, 320, 0, 500, 240, 0, 0, 1]\ndistortion_coefficients: [0.1, 0, 0, 0]\n")

    with pytest.raises((FileError, ParameterError), match="'image_size"):
        distortion.read_calibration(path, pixel_um=2.0, image_size=image_size)
