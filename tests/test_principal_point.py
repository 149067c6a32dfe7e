"""The optical axis meets the sensor at the principal point: images, relative illumination and fields are centred there."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim.distortion import BrownConrady, Fisheye, from_opencv, read_calibration

#: Sites are smaller than λN, so that points are located precisely.
pytestmark = pytest.mark.filterwarnings("ignore:automatic oversampling chooses")

cv2 = pytest.importorskip("cv2")

SIZE = N_X, N_Y = 160, 120
PIXEL_UM, DISTANCE_M = 5.0, 2.0
FOCAL_PX = 200.0
CENTRE_PX = 99.5, 44.5
#: Where a principal point at (99.5, 44.5) lies in the sensor frame: y is up, and the middle of the picture is the origin.
CENTRE_UM = 20.0 * PIXEL_UM, 15.0 * PIXEL_UM
BROWN_CONRADY = (-0.21, 0.08, 0.004, -0.003, 0.01)
FISHEYE = (0.05, -0.02, 0.003, -0.001)


def matrix_of(focal_px=(FOCAL_PX, FOCAL_PX)):
    return np.array([[focal_px[0], 0.0, CENTRE_PX[0]], [0.0, focal_px[1], CENTRE_PX[1]], [0.0, 0.0, 1.0]])


def optics_of(focal_px=FOCAL_PX, **optics):
    """A lens whose image distance is the focal length of the calibration, focused on the scene."""
    image_m = 1e-6 * focal_px * PIXEL_UM
    return fs.Optics(focal_length_mm=1e3 / (1.0 / image_m + 1.0 / DISTANCE_M), f_number=4.0, **optics)


def points_of(shape, pixels, pitch_um):
    return fs.Scene.point_sources(
        shape=shape, pixels=pixels, intensity_w_sr_nm=1.0, pitch_um=pitch_um, distance_m=DISTANCE_M, band_width_nm=10.0
    )


def centroid_px(optics, distortion, scene, near_px):
    """Centroid of the image of a point on photosites of a tenth of a pixel, 6 pixels around a position; y down."""
    near_um = (np.asarray(near_px) - 0.5 * (np.array(SIZE) - 1)) * PIXEL_UM * [1, -1]
    layout = fs.layout.grid(n_x=121, n_y=121, pitch_um=0.1 * PIXEL_UM).translate(*near_um)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout), distortion=distortion)
    rate = camera.photoelectrons_per_s(scene)
    x_um, y_um = (rate @ layout.centroid_um) / rate.sum()
    return np.array([x_um / PIXEL_UM + 0.5 * (N_X - 1), 0.5 * (N_Y - 1) - y_um / PIXEL_UM])


def opencv_file(path, matrix, coefficients, model):
    path.write_text(
        json.dumps(
            {
                "image_width": N_X,
                "image_height": N_Y,
                "camera_matrix": {"rows": 3, "cols": 3, "data": matrix.ravel().tolist()},
                "distortion_model": model,
                "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": list(coefficients)},
            }
        )
    )
    return read_calibration(path, pixel_um=PIXEL_UM)


@pytest.mark.parametrize(
    ("source", "model", "focal_px"),
    [
        ("arrays", "plumb_bob", (FOCAL_PX, FOCAL_PX)),
        ("arrays", "fisheye", (1.03 * FOCAL_PX, FOCAL_PX / 1.03)),
        ("file", "plumb_bob", (1.03 * FOCAL_PX, FOCAL_PX / 1.03)),
        ("file", "fisheye", (FOCAL_PX, FOCAL_PX)),
    ],
)
def test_points_land_where_opencv_projects_them(tmp_path, source, model, focal_px):
    matrix, k = matrix_of(focal_px), np.array(FISHEYE if model == "fisheye" else BROWN_CONRADY)
    if source == "file":
        distortion = opencv_file(tmp_path / "camera.json", matrix, k, model)
    else:
        distortion = from_opencv(matrix, k, image_size=SIZE, pixel_um=PIXEL_UM, fisheye=model == "fisheye")
    optics = optics_of()
    n_y, n_x = 401, 601
    pitch_um = 0.5e6 * DISTANCE_M / FOCAL_PX  # half a pixel in the image
    for row, column in ((200, 300), (200, 380), (120, 150), (260, 250), (150, 330)):
        scene = points_of((n_y, n_x), [(row, column)], pitch_um)
        # y is up in the scene, and down in OpenCV.
        world_m = np.array([(column - 300) * pitch_um * 1e-6, -(row - 200) * pitch_um * 1e-6, DISTANCE_M])
        if model == "fisheye":
            expected_px = cv2.fisheye.projectPoints(world_m.reshape(1, 1, 3), np.zeros(3), np.zeros(3), matrix, k)[0]
        else:
            expected_px = cv2.projectPoints(world_m.reshape(1, 3), np.zeros(3), np.zeros(3), matrix, k)[0]

        expected_px = expected_px.ravel()
        assert centroid_px(optics, distortion, scene, expected_px) == pytest.approx(expected_px, abs=0.1)


def test_axis_point_lands_on_the_principal_point():
    lens = from_opencv(matrix_of(), BROWN_CONRADY, image_size=SIZE, pixel_um=PIXEL_UM)

    assert lens.centre_um == CENTRE_UM
    scene = points_of((201, 201), [(100, 100)], 1e4)
    assert centroid_px(optics_of(), lens, scene, CENTRE_PX) == pytest.approx(CENTRE_PX, abs=1e-3)


@pytest.mark.parametrize(("emission", "power"), [("lambertian", 4), ("isotropic", 3)])
def test_relative_illumination_falls_from_principal_point(emission, power):
    """An undistorting lens with its axis 1.5 mm off the middle of the sensor: cosines of the angles to that axis."""
    centre_um, image_um = (1500.0, -900.0), 4000.0
    optics = fs.Optics(focal_length_mm=1e3 / (1e6 / image_um + 1.0 / DISTANCE_M), f_number=1.4, emission=emission)
    layout = fs.layout.grid(n_x=48, n_y=48, pitch_um=40.0)
    lens = BrownConrady(focal_um=image_um, centre_um=centre_um)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout), distortion=lens)
    scene = fs.Scene.flat(
        shape=(400, 400), pitch_um=8000.0, distance_m=DISTANCE_M, radiance_w_m2_sr_nm=1.0, band_width_nm=10.0
    )
    rate = camera.photoelectrons_per_s(scene)
    x, y = (layout.centroid_um - centre_um).T / (1e6 * DISTANCE_M * optics.magnification(DISTANCE_M))
    expected = (1.0 + x**2 + y**2) ** (-0.5 * power)
    nearest = np.argmin(x**2 + y**2)

    # The means over sites, and the wings of the PSF: 1e-4.
    assert rate / rate[nearest] == pytest.approx(expected / expected[nearest], rel=3e-4)


@pytest.mark.slow
def test_field_dependent_aberrations_centre_on_axis():
    """Coma vanishes on the axis: the image of the axial point is symmetric about the principal point."""
    lens = Fisheye(projection="equidistant", focal_um=FOCAL_PX * PIXEL_UM, centre_um=CENTRE_UM)
    seidel = fs.optics.Seidel(coma_um=0.1, field_radius_um=300.0)
    scene = points_of((201, 201), [(100, 100)], 1e4)

    assert centroid_px(optics_of(seidel=seidel), lens, scene, CENTRE_PX) == pytest.approx(CENTRE_PX, abs=2e-3)


def test_scene_capture_equals_capture_of_its_map():
    lens = from_opencv(matrix_of((201.0, 199.0)), BROWN_CONRADY, image_size=SIZE, pixel_um=PIXEL_UM)
    scene = points_of((301, 401), [(100, 100), (150, 250)], 1e4)
    sensor = fs.Sensor(fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=PIXEL_UM))
    camera = fs.Camera(optics=optics_of(), sensor=sensor, distortion=lens, order=1)

    assert camera.photoelectrons_per_s(camera.power_map(scene)) == pytest.approx(
        camera.photoelectrons_per_s(scene), rel=1e-5, abs=1e-5 * camera.photoelectrons_per_s(scene).max()
    )


def test_reference_picture_centres_on_principal_point():
    lens = BrownConrady(focal_um=FOCAL_PX * PIXEL_UM, centre_um=CENTRE_UM)
    sensor = fs.Sensor(fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=PIXEL_UM))
    camera = fs.Camera(optics=optics_of(), sensor=sensor, distortion=lens)
    grid = fs.Grid.centred((N_Y, N_X), PIXEL_UM)
    picture = camera.reference(points_of((201, 201), [(100, 100)], 1e4), grid, exposure_s=1.0)
    # The principal point is a corner of pixels: a window of an even number of them is symmetric about it.
    rows, columns = (slice(n // 2 + at - 20, n // 2 + at + 20) for n, at in ((N_Y, 15), (N_X, 20)))
    cells = picture.data[0, rows, columns]
    x_um = cells.sum(axis=0) @ grid.x_um[columns] / cells.sum()
    y_um = cells.sum(axis=1) @ grid.y_um[rows] / cells.sum()

    assert (x_um, y_um) == pytest.approx(CENTRE_UM, abs=1e-3)


@pytest.mark.parametrize("focus_m", [None, 0.4])
def test_contradicting_focal_length_warns(focus_m):
    """The reference is the image distance of a thin lens, 1 / f = 1 / H + 1 / D."""
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0, focus_distance_m=focus_m)
    image_um = 1e6 / (1.0 / 8e-3 - 1.0 / (focus_m or DISTANCE_M))
    sensor = fs.Sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0))
    scene = fs.Scene.flat(
        shape=(60, 60), pitch_um=1000.0, distance_m=DISTANCE_M, radiance_w_m2_sr_nm=1.0, band_width_nm=10.0
    )

    def rates(light=scene, lens=optics, **distortion):
        camera = fs.Camera(optics=lens, sensor=sensor, distortion=BrownConrady(k1=-0.1, **distortion))
        return camera.photoelectrons_per_s(light), camera

    # Within 2 %, also of the geometric mean of unequal axes; the suite turns warnings into errors.
    for focal_um in (0.981 * image_um, 1.019 * image_um, (1.5 * image_um, image_um / 1.5)):
        rates(focal_um=focal_um)
    for focal_um in (0.979 * image_um, 1.021 * image_um, 0.49 * image_um, (1.03 * image_um, 1.03 * image_um)):
        with pytest.warns(fs.errors.FoveasimWarning, match="the focal length of the lens model is") as caught:
            _, camera = rates(focal_um=focal_um)
        # Both remedies of the message remove the contradiction.
        message = str(caught[0].message)
        rates(focal_um=float(re.search(r"focal_um=([\d.]+)", message).group(1)))
        focal_mm = float(re.search(r"focal_length_mm=([\d.]+)", message).group(1))
        rates(focal_um=focal_um, lens=replace(optics, focal_length_mm=focal_mm))
    with pytest.warns(fs.errors.FoveasimWarning, match="the focal length of the lens model is"):
        next(fs.tiles.capture_tiles(camera, scene, exposure_s=0.01, seed=0))
    # The optics do not take part in the image of another program.
    rates(camera.power_map(scene), focal_um=4000.0)
