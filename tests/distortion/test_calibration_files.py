"""Calibration files of other programs: each key is read, irrelevant, or named in an error."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

import foveasim as fs
from foveasim.distortion import (
    BrownConrady,
    DoubleSphere,
    ExtendedUnified,
    FieldOfView,
    Omnidirectional,
    PolynomialFisheye,
    read_calibration,
)
from foveasim.errors import ConfigError

SIZE, PIXEL_UM = (640, 480), 3.0
MATRIX = np.array([[400.0, 0.0, 318.2], [0.0, 405.0, 243.9], [0.0, 0.0, 1.0]])
FISHEYE = np.array([-0.02, 0.004, -0.001, 0.0002])
PINHOLE = np.array([-0.2, 0.05, 0.003, -0.002, 0.01])
#: What OpenCV's calibration sample writes besides the lens.
OF_SAMPLE = {
    "calibration_time": "Fri Nov 27 12:00:00 2026", "nframes": 3, "board_width": 9, "board_height": 6, "square_size": 0.025,
    "marker_size": 0.0125, "flags": 4, "avg_reprojection_error": 0.3, "grid_points": np.zeros((2, 3)),
    "per_view_reprojection_errors": np.array([[0.3], [0.2], [0.4]]), "extrinsic_parameters": np.zeros((3, 6)),
}  # fmt: skip
KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.004, -0.001, 0.0002]
  distortion_model: equidistant
  intrinsics: [400.0, 405.0, 318.2, 243.9]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -8.1e-05
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: MODEL
  distortion_coeffs: [COEFFICIENTS]
  distortion_model: DISTORTION
  intrinsics: [INTRINSICS]
  resolution: [640, 480]
  rostopic: /cam1/image_raw
"""


def write(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def pixels(lens, xy):
    """Return the pixels, y down from the upper left one, of rays (x, y, 1) with y down."""
    ideal_um = xy * lens.focal_um * [1.0, -1.0] + lens.centre_um
    return lens.distort(ideal_um) / PIXEL_UM * [1.0, -1.0] + [0.5 * (SIZE[0] - 1), 0.5 * (SIZE[1] - 1)]


@pytest.fixture(scope="module")
def xy():
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 11), np.linspace(-0.6, 0.6, 9))
    return np.stack((x.ravel(), y.ravel()), axis=1)


@pytest.mark.parametrize("extension", ["yml", "xml", "json"])
@pytest.mark.parametrize("is_fisheye", [False, True])
def test_files_of_opencv_give_its_projection(tmp_path, xy, extension, is_fisheye):
    k = FISHEYE if is_fisheye else PINHOLE
    path = write(
        tmp_path / f"camera.{extension}", image_width=640, image_height=480, fisheye_model=int(is_fisheye),
        camera_matrix=MATRIX, distortion_coefficients=k, **OF_SAMPLE,
    )  # fmt: skip
    world = np.column_stack((xy, np.ones(len(xy))))
    if is_fisheye:
        expected = cv2.fisheye.projectPoints(world[np.newaxis], np.zeros(3), np.zeros(3), MATRIX, k)[0][0]
    else:
        expected = cv2.projectPoints(world, np.zeros(3), np.zeros(3), MATRIX, k)[0][:, 0]

    np.testing.assert_allclose(pixels(read_calibration(path, pixel_um=PIXEL_UM), xy), expected, atol=1e-9)


@pytest.mark.parametrize("names", [("M", "D"), ("K", "D"), ("cameraMatrix", "distCoeffs")])
def test_stereo_files_have_two_cameras(tmp_path, xy, names):
    matrix, coefficients = names
    other = MATRIX * [[1.1], [1.1], [1.0]]
    path = write(
        tmp_path / "stereo.yml",
        **{f"{matrix}1": MATRIX, f"{coefficients}1": PINHOLE, f"{matrix}2": other, f"{coefficients}2": -PINHOLE},
        R=np.eye(3), T=np.zeros((3, 1)), E=np.eye(3), F=np.eye(3), R1=np.eye(3), P1=np.zeros((3, 4)), Q=np.eye(4),
    )  # fmt: skip
    one, two = (read_calibration(path, pixel_um=PIXEL_UM, image_size=SIZE, camera=k) for k in (1, "2"))

    assert one == fs.distortion.from_opencv(MATRIX, PINHOLE, image_size=SIZE, pixel_um=PIXEL_UM)
    assert two == fs.distortion.from_opencv(other, -PINHOLE, image_size=SIZE, pixel_um=PIXEL_UM)
    with pytest.raises(ConfigError, match="contains several cameras; pass camera= one of 1, 2"):
        read_calibration(path, pixel_um=PIXEL_UM, image_size=SIZE)
    with pytest.raises(ConfigError, match="contains no camera 3; pass camera= one of 1, 2"):
        read_calibration(path, pixel_um=PIXEL_UM, image_size=SIZE, camera=3)


@pytest.mark.parametrize(
    ("model", "intrinsics", "distortion", "coefficients", "expected"),
    [
        ("pinhole", "", "radtan", "-0.2, 0.05, 0.003, -0.002", BrownConrady(focal_um=(1200.0, 1215.0), k1=-0.2, k2=0.05, p1=-0.003, p2=-0.002)),
        ("pinhole", "", "none", "", BrownConrady(focal_um=(1200.0, 1215.0))),
        ("pinhole", "", "fov", "0.9", FieldOfView(w_rad=0.9, focal_um=tuple(np.array([1200.0, 1215.0]) * 2.0 * np.tan(0.45) / 0.9))),
        ("omni", "1.5, ", "radtan", "-0.2, 0.05, 0.003, -0.002", Omnidirectional(xi=1.5, focal_um=(480.0, 486.0), k1=-0.2, k2=0.05, p1=-0.003, p2=-0.002)),
        ("omni", "1.5, ", "none", "", Omnidirectional(xi=1.5, focal_um=(480.0, 486.0))),
        ("eucm", "0.6, 1.1, ", "none", "", ExtendedUnified(alpha=0.6, beta=1.1, focal_um=(1200.0, 1215.0))),
        ("ds", "-0.2, 0.6, ", "none", "", DoubleSphere(xi=-0.2, alpha=0.6, focal_um=(1500.0, 1518.75))),
    ],
)  # fmt: skip
def test_models_of_kalibr(tmp_path, model, intrinsics, distortion, coefficients, expected):
    path = tmp_path / "camchain.yaml"
    text = KALIBR.replace("MODEL", model).replace("DISTORTION", distortion).replace("COEFFICIENTS", coefficients)
    path.write_text(text.replace("INTRINSICS", f"{intrinsics}400.0, 405.0, 318.2, 243.9"))
    lens = read_calibration(path, pixel_um=PIXEL_UM, camera="cam1")

    assert type(lens) is type(expected)
    assert lens.focal_um == pytest.approx(expected.focal_um)
    assert lens.centre_um == pytest.approx(((318.2 - 319.5) * 3.0, (239.5 - 243.9) * 3.0))
    names = [name for name in ("k1", "k2", "p1", "p2", "xi", "alpha", "beta", "w_rad") if hasattr(expected, name)]
    assert [getattr(lens, name) for name in names] == pytest.approx([getattr(expected, name) for name in names])
    assert read_calibration(path, pixel_um=PIXEL_UM, camera="cam0").k == pytest.approx(FISHEYE)


def test_sensor_file_of_euroc(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text(
        "sensor_type: camera\ncomment: VI-Sensor cam0\nT_BS:\n  cols: 4\n  rows: 1\n  data: [1.0, 0.0, 0.0, 0.0]\nrate_hz: 20\n"
        "resolution: [640, 480]\ncamera_model: pinhole\nintrinsics: [400.0, 405.0, 318.2, 243.9]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.2, 0.05, 0.003, -0.002]\n"
    )

    expected = fs.distortion.from_opencv(MATRIX, PINHOLE[:4], image_size=SIZE, pixel_um=PIXEL_UM)
    assert read_calibration(path, pixel_um=PIXEL_UM) == expected


@pytest.mark.parametrize(
    ("model", "parameters", "kind", "checked"),
    [
        ("PINHOLE", "distortion_parameters: {k1: -0.2, k2: 0.05, p1: 0.003, p2: -0.002}\nprojection_parameters: {fx: 400.0, fy: 405.0, cx: 318.2, cy: 243.9}", BrownConrady, {"k1": -0.2, "p1": -0.003}),
        ("KANNALA_BRANDT", "projection_parameters: {k2: -0.02, k3: 0.004, k4: -0.001, k5: 0.0002, mu: 400.0, mv: 405.0, u0: 318.2, v0: 243.9}", PolynomialFisheye, {"k": tuple(FISHEYE)}),
        ("MEI", "mirror_parameters: {xi: 1.5}\ndistortion_parameters: {k1: -0.2, k2: 0.05, p1: 0.003, p2: -0.002}\nprojection_parameters: {gamma1: 1000.0, gamma2: 1000.0, u0: 318.2, v0: 243.9}", Omnidirectional, {"xi": 1.5, "k1": -0.2, "focal_um": (1200.0, 1200.0)}),
    ],
)  # fmt: skip
def test_models_of_vins(tmp_path, model, parameters, kind, checked):
    path = tmp_path / "cam0.yaml"
    path.write_text(
        f"%YAML:1.0\n---\nmodel_type: {model}\ncamera_name: camera\nimage_width: 640\nimage_height: 480\n{parameters}\n"
    )
    lens = read_calibration(path, pixel_um=PIXEL_UM)

    assert isinstance(lens, kind)
    for name, value in checked.items():
        assert getattr(lens, name) == pytest.approx(value)
    path.write_text(path.read_text().replace(model, "SCARAMUZZA"))
    with pytest.raises(ConfigError, match=r"has the unknown camera model 'SCARAMUZZA'; possible: 'pinhole', 'mei'"):
        read_calibration(path, pixel_um=PIXEL_UM)


ROS = """header: {seq: 1, stamp: {secs: 0, nsecs: 0}, frame_id: camera}
height: 480
width: 640
distortion_model: "MODEL"
D: [COEFFICIENTS]
K: [400.0, 0.0, 318.2, 0.0, 405.0, 243.9, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [400.0, 0.0, 318.2, 0.0, 0.0, 405.0, 243.9, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 1
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""


def test_camera_info_of_ros(tmp_path):
    path = tmp_path / "info.yaml"
    path.write_text(ROS.replace("MODEL", "").replace("COEFFICIENTS", ""))
    assert read_calibration(path, pixel_um=PIXEL_UM) == BrownConrady(
        focal_um=(1200.0, 1215.0), centre_um=((318.2 - 319.5) * 3.0, (239.5 - 243.9) * 3.0)
    )
    filled = ROS.replace("MODEL", "plumb_bob").replace("COEFFICIENTS", ", ".join(map(str, PINHOLE)))
    path.write_text(filled)
    assert read_calibration(path, pixel_um=PIXEL_UM).k3 == 0.01
    for old, new, message in (
        ("binning_x: 0", "binning_x: 2", "has binned pixels ('binning_x')"),
        ("x_offset: 0", "x_offset: 8", "has a region of interest ('roi')"),
        ("D: [", "p1: 0.1\nD: [", "has the key 'p1', which is not known"),
        ("binning_y: 1", "binning_y: 1\nmirrored: true", "has the key 'mirrored', which is not known"),
    ):
        path.write_text(filled.replace(old, new))
        with pytest.raises(ConfigError, match=message.replace("(", r"\(").replace(")", r"\)")):
            read_calibration(path, pixel_um=PIXEL_UM)
    assert read_calibration(path, pixel_um=PIXEL_UM, ignore=["mirrored"]).k3 == 0.01


def test_omnidirectional_file_of_opencv(tmp_path):
    path = write(
        tmp_path / "omni.yml", image_width=640, image_height=480, camera_matrix=MATRIX, xi=np.array([1.2]),
        distortion_coefficients=PINHOLE[:4],
    )  # fmt: skip
    lens = read_calibration(path, pixel_um=PIXEL_UM)

    assert (lens.xi, lens.k1, lens.p1) == (1.2, -0.2, -0.003)
    assert lens.focal_um == pytest.approx((1200.0 / 2.2, 1215.0 / 2.2))


@pytest.mark.parametrize("n", [2, 5, 7])
def test_ocamcalib_polynomials_of_any_degree(tmp_path, n):
    coefficients = [-200.0, 0.0, 1.1e-3, -1e-6, 3e-9, -1e-12, 1e-15][:n]
    path = tmp_path / "calib_results.txt"
    path.write_text(
        f"#polynomial\n{n} {' '.join(map(str, coefficients))}\n\n#inverse\n2 1.0 2.0\n#center\n240.0 320.0\n"
        "#affine\n1.0 0.0 0.0\n#size\n480 640\n"
    )
    lens = read_calibration(path, pixel_um=PIXEL_UM, focal_um=600.0)

    for radius in (10.0, 100.0, 180.0):  # along the columns: x of the image
        depth = -np.polynomial.Polynomial(coefficients)(radius)
        ideal_um = lens.undistort([[radius * PIXEL_UM + lens.centre_um[0], lens.centre_um[1]]])[0]
        assert ideal_um[0] - lens.centre_um[0] == pytest.approx(600.0 * radius / depth, rel=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<?xml version='1.0'?>\n<!DOCTYPE a [<!ENTITY b 'c'>]>\n<opencv_storage/>", "declares XML entities"),
        ("<opencv_storage><a></opencv_storage>", "is corrupt, or not a calibration of OpenCV"),
        ("<calibration/>", "is not a calibration of OpenCV, whose root is opencv_storage; got 'calibration'"),
        ("<opencv_storage>" + "<a>" * 20000 + "</a>" * 20000 + "</opencv_storage>", "has elements in more than 50 levels"),
        (KALIBR.replace("MODEL", "pinhole").replace("DISTORTION", "radtan").replace("COEFFICIENTS", "0.1").replace("INTRINSICS", "1, 2, 3"), "contains several cameras; pass camera= one of cam0, cam1"),
        ("camera_model: magic\nintrinsics: [1, 2, 3, 4]", "has the unknown camera model 'magic'; possible: "),
        ("camera_model: eucm\nintrinsics: [1, 2, 3, 4]\nresolution: [64, 48]", "intrinsics must have 6 numbers, got 4"),
        ("camera_model: omni\ndistortion_model: equidistant\ndistortion_coeffs: [0, 0, 0, 0]\nintrinsics: [1, 400, 400, 32, 24]\nresolution: [64, 48]", "has an omnidirectional model with the unknown distortion 'equidistant'"),
        ("model_type: MEI\nimage_width: 64\nimage_height: 48\nprojection_parameters: {gamma1: 1.0}", "lacks the number 'gamma2' of the model 'mei'"),
        (json.dumps({"RadialDistortion": [0.1, 0.2], "ImageSize": [48, 64], "K": [[50, 1, 32], [0, 50, 24], [0, 0, 1]]}), "has a skew"),
    ],
)  # fmt: skip
def test_files_that_are_not_understood_are_named(tmp_path, text, message):
    path = tmp_path / "calibration"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_calibration(path, pixel_um=PIXEL_UM)
    assert "\n" not in str(caught.value)


def test_settings_name_a_calibration_file(tmp_path):
    write(
        tmp_path / "left.yml", image_width=640, image_height=480, camera_matrix=MATRIX, distortion_coefficients=PINHOLE
    )
    (tmp_path / "shot.yaml").write_text(
        "scene: {kind: flat, shape: [64, 64], pitch_um: 500.0, distance_m: 1.0, illuminance_lux: 300.0}\n"
        "optics: {focal_length_mm: 1.2, f_number: 4.0}\n"
        "distortion: {kind: calibration, path: left.yml, pixel_um: 3.0}\n"
        "layout: {generator: grid, parameters: {n_x: 8, n_y: 8, pitch_um: 3.0}}\n"
        "exposure_s: 0.01\n"
    )
    shot = fs.config.read_shot(tmp_path / "shot.yaml")

    assert shot.camera.distortion == read_calibration(tmp_path / "left.yml", pixel_um=3.0)
    (tmp_path / "shot.yaml").write_text((tmp_path / "shot.yaml").read_text().replace("left.yml", "right.yml"))
    with pytest.raises(ConfigError, match=r"right\.yml"):
        fs.config.read_shot(tmp_path / "shot.yaml")
