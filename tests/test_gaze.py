"""Gaze: the scale of an image and its position, on every route from a scene to codes; closed forms and OpenCV."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import yaml
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.config import read_shot, to_python
from foveasim.errors import CoverageWarning, FileError, ParameterError
from foveasim.video import GazePath, follow_gaze, saccades, shift_sensor

DISTANCE_M, EXPOSURE_S = 0.56, 0.01
OPTICS = fs.Optics(focal_length_mm=22.0, f_number=4.0)
HEXAGONS = fs.layout.hexagonal(n_columns=12, n_rows=10, pitch_um=5.0)
PICTURE = np.random.default_rng(2).random((120, 160)).astype(np.float32)
GAZE_UM = (13.7, -8.2)


def scene_of(picture=PICTURE, **framing):
    framing = framing or {"fit": "cover", "gaze_range_um": (30.0, 20.0)}
    return fs.Scene.from_picture(
        picture, distance_m=DISTANCE_M, peak_radiance_w_m2_sr_nm=0.05, band_width_nm=10.0, encoding="linear", **framing
    )


def camera_of(layout=HEXAGONS, optics=OPTICS, *, read_noise_e=3.0, **parts):
    return fs.Camera(optics=optics, sensor=fs.Sensor(layout, read_noise_e=read_noise_e, bits=12), **parts)


# -- scale and position ------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("fit", ["cover", "contain", "width"])
def test_scale_does_not_depend_on_gaze(fit):
    camera, scene = camera_of(optics=replace(OPTICS, f_number=2.0)), scene_of(fit=fit)
    pitch_um = camera.fit_scene(scene).pitch_um
    gazes_um = np.random.default_rng(0).uniform(-200.0, 200.0, (50, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CoverageWarning)
        for gaze_um in gazes_um.tolist():
            capture = camera.capture(scene, exposure_s=EXPOSURE_S, seed=0, gaze_um=gaze_um)
            assert capture.settings["light"]["pitch_um"] == pitch_um
            assert (capture.settings["gaze_um"], capture.settings["axis"]) == (gaze_um, "image")


@pytest.mark.parametrize("axis", ["image", "sensor"])
def test_points_land_at_position_minus_gaze(axis):
    """Centroids by OpenCV, of a blob between the cells."""
    cv2 = pytest.importorskip("cv2")
    rows, columns = np.mgrid[:120, :160]
    blob = np.exp(-((rows - 70.3) ** 2 + (columns - 92.6) ** 2) / (2.0 * 4.0**2))
    grid = fs.layout.grid(n_x=80, n_y=60, pitch_um=2.0)
    camera = camera_of(grid, replace(OPTICS, f_number=1.0), axis=axis)
    scene = scene_of(blob, fit="cover")

    def centroid_um(gaze_um):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CoverageWarning)
            found = camera.with_gaze(gaze_um).photoelectrons_per_s(scene).reshape(60, 80)
        moments = cv2.moments(found)
        return np.array([moments["m10"], moments["m01"]]) / moments["m00"] * 2.0

    still_um = centroid_um((0.0, 0.0))
    for gaze_um in ((10.0, 0.0), (-7.3, 4.9), (0.123, -11.7)):
        np.testing.assert_allclose(
            centroid_um(gaze_um), still_um - gaze_um, atol=0.03
        )  # the tails of the PSF leave the layout


def test_gaze_by_whole_sites_is_a_translation():
    cv2 = pytest.importorskip("cv2")
    large = camera_of(fs.layout.grid(n_x=80, n_y=60, pitch_um=2.0))
    scene = scene_of(fit="cover")
    pitched = large.fit_scene(scene).with_pitch(large.fit_scene(scene).pitch_um)
    small = camera_of(fs.layout.grid(n_x=40, n_y=30, pitch_um=2.0))
    whole = large.photoelectrons_per_s(pitched).reshape(60, 80)

    for columns, rows in ((5, -7), (-12, 3)):
        found = small.with_gaze((2.0 * columns, 2.0 * rows)).photoelectrons_per_s(pitched).reshape(30, 40)
        by_opencv = cv2.warpAffine(whole, np.float64([[1, 0, -columns], [0, 1, -rows]]), (80, 60))
        np.testing.assert_allclose(found, by_opencv[15:45, 20:60], rtol=1e-6)


@pytest.mark.parametrize("lens", [None, fs.distortion.BrownConrady(focal_um=22.9e3, k1=-20.0)], ids=["ideal", "lens"])
@pytest.mark.parametrize("order", [1, 2])
def test_gaze_equals_layout_moved_in_the_image(lens, order):
    camera, scene = camera_of(distortion=lens, order=order), scene_of()
    pitched = camera.fit_scene(scene).with_pitch(camera.fit_scene(scene).pitch_um)
    moved = camera_of(HEXAGONS.translate(*GAZE_UM), distortion=lens, order=order)
    arguments = {"exposure_s": EXPOSURE_S, "seed": 1}

    capture = camera.capture(scene, **arguments, gaze_um=GAZE_UM)
    expected = moved.capture(pitched, **arguments)
    assert np.array_equal(capture.expected_e, expected.expected_e)
    assert np.array_equal(capture.code, expected.code)
    of_map = camera.power_map(pitched)
    np.testing.assert_array_equal(
        camera.with_gaze(GAZE_UM).photoelectrons_per_s(of_map), moved.photoelectrons_per_s(of_map)
    )


def test_range_of_gazes_is_covered():
    """The image has the size of the layout plus twice the range, at least along one axis."""
    camera, range_um = camera_of(), (30.0, 20.0)
    scene = scene_of(fit="cover", gaze_range_um=range_um)
    x0, y0, x1, y1 = camera.image_grid(scene).bounds_um
    left, bottom, right, top = HEXAGONS.bounds_um

    spare = np.array([x1 - x0 - (right - left) - 60.0, y1 - y0 - (top - bottom) - 40.0])
    assert spare.min() == pytest.approx(0.0, abs=1e-9)
    for gaze_um in ((30.0, 20.0), (-30.0, 20.0), (-30.0, -20.0)):
        camera.with_gaze(gaze_um).photoelectrons_per_s(scene)  # without a CoverageWarning
    with pytest.warns(CoverageWarning, match=r"outside the image at the gaze \(30, 40\) µm.*gaze_range_um=\(30, 40\)"):
        camera.with_gaze((30.0, 40.0)).photoelectrons_per_s(scene)


# -- axis --------------------------------------------------------------------------------------------------------------


def test_relative_illumination_stays_with_its_axis():
    """cos⁴ of the angle to the optical axis, on a uniform scene."""
    optics = fs.Optics(focal_length_mm=2.0, f_number=4.0)
    layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=1.0)
    scene = fs.Scene.flat(
        shape=(400, 400), pitch_um=5000.0, distance_m=1.0, radiance_w_m2_sr_nm=0.05, band_width_nm=10.0
    )
    camera, gaze_um = camera_of(layout, optics, order=2), (600.0, -300.0)
    image_distance_um = 2e3 / (1.0 - 2e-3)

    centre = camera.photoelectrons_per_s(scene)[4]
    by_image = camera.with_gaze(gaze_um).photoelectrons_per_s(scene)[4]
    by_sensor = camera.with_gaze(gaze_um, "sensor").photoelectrons_per_s(scene)[4]
    assert by_image / centre == pytest.approx((1.0 + np.dot(gaze_um, gaze_um) / image_distance_um**2) ** -2, rel=2e-3)
    assert by_sensor == pytest.approx(centre, rel=1e-4)


@pytest.mark.parametrize(
    "optics",
    [
        OPTICS,
        replace(
            OPTICS, lateral_colour=fs.optics.LateralColour(wavelength_nm=(450.0, 650.0), magnification=(0.99, 1.01))
        ),
    ],
    ids=["ideal", "lateral colour"],
)
def test_turned_camera_sees_displaced_picture(optics):
    """The picture with zero padding, displaced by whole pixels, at the gaze."""
    camera = camera_of(optics=replace(optics, padding="zero"), axis="sensor", order=1)
    scene = fs.Scene.from_picture(
        np.pad(PICTURE, 20), pitch_um=20.0, distance_m=DISTANCE_M, peak_radiance_w_m2_sr_nm=0.05,
        wavelength_nm=[450.0, 550.0, 650.0], encoding="linear",
    )  # fmt: skip
    cell_um = optics.grid(scene).pitch_x_um
    columns, rows = 7, -4
    displaced = replace(scene, basis=np.roll(scene.basis, (-rows, -columns), axis=(1, 2)))

    found = camera.with_gaze((columns * cell_um, rows * cell_um)).photoelectrons_per_s(scene)
    np.testing.assert_allclose(found, camera.photoelectrons_per_s(displaced), rtol=2e-5)


@pytest.mark.slow
def test_coma_stays_with_its_axis():
    """A point in the corner of the picture: without coma for a camera that turns towards it."""
    sharp = replace(OPTICS, padding="zero")
    optics = replace(sharp, seidel=fs.optics.Seidel(coma_um=1.0, field_radius_um=100.0), field_patches=9)
    point = np.zeros((81, 111))
    point[20, 85] = 1.0  # from the top
    scene = scene_of(point, pitch_um=50.0)
    cell_um = optics.grid(scene).pitch_x_um
    gaze_um = (30.0 * cell_um, 20.0 * cell_um)
    camera, ideal = camera_of(optics=optics, order=1), camera_of(optics=sharp, order=1)

    expected = ideal.with_gaze(gaze_um).photoelectrons_per_s(scene)
    by_sensor, by_image = (camera.with_gaze(gaze_um, axis).photoelectrons_per_s(scene) for axis in ("sensor", "image"))
    difference = [np.abs(each - expected).sum() / expected.sum() for each in (by_sensor, by_image)]
    assert difference[0] < 0.1
    assert difference[1] > 1.0


def test_power_map_cannot_turn():
    camera = camera_of()
    power_map = camera.power_map(scene_of())

    with pytest.raises(ParameterError, match="'axis' must be 'image' for a power map"):
        camera.with_gaze(GAZE_UM, "sensor").photoelectrons_per_s(power_map)


# -- all routes --------------------------------------------------------------------------------------------------------

SETTINGS = {
    "scene": {
        "kind": "picture", "picture": "scene.png", "fit": "cover", "gaze_range_um": [30.0, 20.0], "encoding": "linear",
        "distance_m": DISTANCE_M, "peak_radiance_w_m2_sr_nm": 0.05, "wavelength_nm": [550.0], "band_width_nm": 10.0,
    },
    "optics": {"focal_length_mm": 22.0, "f_number": 4.0},
    "layout": {"generator": "hexagonal", "parameters": {"n_columns": 12, "n_rows": 10, "pitch_um": 5.0}},
    "sensor": {"read_noise_e": 3.0, "bits": 12},
    "exposure_s": EXPOSURE_S,
    "seed": 1,
}  # fmt: skip


@pytest.fixture(params=["image", "sensor"])
def axis(request):
    return request.param


@pytest.fixture
def files(tmp_path):
    from PIL import Image

    Image.fromarray((255 * PICTURE).astype(np.uint8)).save(tmp_path / "scene.png")
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(SETTINGS))
    return tmp_path


def with_gaze(axis):
    return {**SETTINGS, "gaze_um": list(GAZE_UM), "axis": axis}


def capture_of(shot):
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)


@pytest.fixture
def expected(files, axis):
    shot = read_shot(files / "shot.yaml")
    return shot.camera.capture(shot.scene, exposure_s=EXPOSURE_S, seed=1, gaze_um=GAZE_UM, axis=axis)


def test_settings_files_have_the_gaze(files, axis, expected):
    (files / "gaze.yaml").write_text(yaml.safe_dump(with_gaze(axis)))
    by_file = read_shot(files / "gaze.yaml")
    changes = [f"gaze_um=[{GAZE_UM[0]}, {GAZE_UM[1]}]", f"axis={axis}"]
    by_option = read_shot(files / "shot.yaml", changes)

    for shot in (by_file, by_option):
        assert np.array_equal(capture_of(shot).code, expected.code)
        assert capture_of(shot).settings["gaze_um"] == list(GAZE_UM)
    assert not np.array_equal(capture_of(read_shot(files / "shot.yaml")).code, expected.code)


def test_generated_python_has_the_gaze(files, axis, expected, monkeypatch):
    monkeypatch.chdir(files)
    names = {}
    exec(compile(to_python(with_gaze(axis)), "shot.py", "exec"), names)

    assert np.array_equal(names["capture"].code, expected.code)


def test_predictions_have_the_gaze(files, axis, expected):
    shot = read_shot(files / "shot.yaml")
    gaze = {"exposure_s": EXPOSURE_S, "gaze_um": GAZE_UM, "axis": axis}
    sensor, sites = shot.camera.sensor, [3, 7, 50]

    np.testing.assert_array_equal(shot.camera.predict(shot.scene, **gaze), sensor.predict(expected.expected_e))
    turned = shot.camera.with_gaze(GAZE_UM, axis)
    np.testing.assert_array_equal(
        turned.predict_covariance(shot.scene, sites, exposure_s=EXPOSURE_S),
        sensor.predict_covariance(expected.expected_e, sites),
    )
    budget = turned.noise_budget(shot.scene, exposure_s=EXPOSURE_S)
    np.testing.assert_allclose(budget["photon_shot"] ** 2 + budget["dark_shot"] ** 2, expected.expected_e, rtol=1e-9)


def test_videos_have_the_gaze(files, axis, expected):
    shot = read_shot(files / "shot.yaml")
    camera = shot.camera.replace(axis=axis)
    path = GazePath([0.0, 0.04], [GAZE_UM, (0.0, 0.0)])
    videos = (
        shift_sensor(shot.scene, path),
        follow_gaze([shot.scene, shot.scene], path, frame_s=0.04),
        [(shot.scene, GAZE_UM), (shot.scene, (0.0, 0.0))],
    )
    for video in videos:
        frames = list(video)
        for ahead in (0, 2):
            found = list(camera.video(frames, exposure_s=EXPOSURE_S, seed=1, ahead=ahead))
            assert np.array_equal(found[0].code, expected.code)
            assert found[0].settings["gaze_um"] == list(GAZE_UM)
            assert found[1].settings["gaze_um"] == [0.0, 0.0]


def test_tiles_have_the_gaze(files, axis, expected):
    shot = read_shot(files / "shot.yaml")
    (tile,) = fs.tiles.capture_tiles(shot.camera.with_gaze(GAZE_UM, axis), shot.scene, exposure_s=EXPOSURE_S, seed=1)

    assert np.array_equal(tile.code, expected.code)
    assert tile.settings["gaze_um"] == list(GAZE_UM)


def test_sweeps_have_the_gaze(files, axis, expected):
    from foveasim.explore.worker_cache import ShotRunner

    runner = ShotRunner(files / "shot.yaml", {}, n_threads=1)
    base = read_shot(files / "shot.yaml")
    for gaze_um in ([0.0, 0.0], list(GAZE_UM), [5.0, 5.0], list(GAZE_UM)):
        data = {
            **SETTINGS,
            "scene": SETTINGS["scene"] | {"picture": str(files / "scene.png")},
            "gaze_um": gaze_um,
            "axis": axis,
        }
        _, capture = runner.simulate_capture(data)
        assert capture.settings["light"]["pitch_um"] == base.camera.fit_scene(base.scene).pitch_um
    assert np.array_equal(capture.code, expected.code)
    # Images of a fixed lens are computed once.
    assert runner.cache.n_built["images"] == (1 if axis == "image" else 3)


def test_datasets_have_the_gaze(files, axis, expected):
    from foveasim import explore

    shot = {name: value for name, value in with_gaze(axis).items() if name not in ("seed", "scene")}
    scene = {name: value for name, value in SETTINGS["scene"].items() if name not in ("encoding", "picture")}
    pictures = [(255 * PICTURE).astype(np.uint8)]
    varied = explore.Dataset(
        pictures, {**shot, "scene": {**scene, "encoding": "linear"}},
        {"gaze_um.0": {"uniform": [-20.0, 20.0]}, "gaze_um.1": {"uniform": [-10.0, 10.0]}},
        cameras=3, seed=1, fields=("expected_e",), boxes=[[[40, 30, 90, 70, 1]]],
    )  # fmt: skip
    fixed = explore.Dataset(
        pictures, {**shot, "scene": {**scene, "encoding": "linear"}}, cameras=1, seed=1, fields=("expected_e",)
    )
    base = read_shot(files / "shot.yaml")

    np.testing.assert_array_equal(fixed[0]["expected_e"], expected.expected_e)
    for sample in varied:
        gaze_um = (sample["settings"]["gaze_um.0"], sample["settings"]["gaze_um.1"])
        found = base.camera.with_gaze(gaze_um, axis).photoelectrons_per_s(base.scene) * EXPOSURE_S
        np.testing.assert_allclose(sample["expected_e"], found, rtol=1e-12)
        # Boxes are positions on the layout.
        x0, _, x1, y1 = base.camera.image_grid(base.scene).bounds_um
        pixel_um = (x1 - x0) / PICTURE.shape[1]
        left_um, top_um = x0 + 40 * pixel_um - gaze_um[0], y1 - 30 * pixel_um - gaze_um[1]
        assert sample["box_um"][0, [0, 3]] == pytest.approx([left_um, top_um], abs=1e-9)


def test_command_of_videos_follows_a_path(files, axis):
    from PIL import Image
    from typer.testing import CliRunner

    from foveasim.cli import app
    from foveasim.video import read_recording

    (files / "frames").mkdir()
    for k in range(2):
        Image.fromarray((255 * PICTURE).astype(np.uint8)).save(files / "frames" / f"{k}.png")
    GazePath([0.0, 0.04], [GAZE_UM, (0.0, 0.0)]).write(files / "path.csv")
    command = ["video", str(files / "shot.yaml"), "--frames", str(files / "frames"), "--gaze", str(files / "path.csv")]
    options = ["--out", str(files / "codes.zarr"), "--set", f"axis={axis}", "--fps", "25"]
    found = CliRunner().invoke(app, [*command, *options])

    assert found.exit_code == 0, found.output
    recording = read_recording(files / "codes.zarr")
    shot = read_shot(files / "shot.yaml")
    expected = shot.camera.capture(shot.scene, exposure_s=EXPOSURE_S, seed=1, gaze_um=GAZE_UM, axis=axis)
    assert recording.gaze_um.tolist() == [list(GAZE_UM), [0.0, 0.0]]
    assert np.array_equal(recording.code[0], expected.code)
    failed = CliRunner().invoke(app, [*command[:-1], str(files / "none.csv"), "--out", str(files / "other.zarr")])
    assert isinstance(failed.exception, FileError)
    assert "none.csv: no such file" in str(failed.exception)


def test_comparisons_have_the_gaze(files):
    from foveasim import compare

    square = fs.layout.grid(n_x=12, n_y=10, pitch_um=5.0)
    named = {"hexagonal": camera_of().with_gaze(GAZE_UM), "square": camera_of(square).with_gaze(GAZE_UM)}
    light = camera_of().fit_scene(scene_of())
    scenes = {"noise": light.with_pitch(light.pitch_um)}
    found = compare.cameras(named, scenes, exposure_s=EXPOSURE_S, max_pixels=32, n_annuli=2)
    still = compare.cameras(
        {name: camera.with_gaze((0.0, 0.0)) for name, camera in named.items()},
        scenes,
        exposure_s=EXPOSURE_S,
        max_pixels=32,
        n_annuli=2,
    )
    # The scene displaced against the gaze, and no gaze.
    magnification = OPTICS.magnification(DISTANCE_M)
    centre_um = (-GAZE_UM[0] / magnification, -GAZE_UM[1] / magnification)
    displaced = compare.cameras(
        {name: camera.with_gaze((0.0, 0.0)) for name, camera in named.items()},
        {"noise": scenes["noise"].with_centre(centre_um)}, exposure_s=EXPOSURE_S, max_pixels=32, n_annuli=2,
    )  # fmt: skip

    assert found.settings["cameras"]["square"]["gaze_um"] == list(GAZE_UM)
    psnr, other, same = (each.values["psnr_db"] for each in (found, still, displaced))
    assert not np.allclose(psnr, other, rtol=1e-3)
    np.testing.assert_allclose(psnr, same, rtol=1e-3)  # relative illumination differs


def test_ideal_pictures_have_the_gaze(axis):
    camera, scene = camera_of(), scene_of()
    grid = fs.Grid.centred((6, 8), 4.0)
    sites = fs.layout.grid(n_x=8, n_y=6, pitch_um=4.0)
    ideal = camera.with_gaze(GAZE_UM, axis).reference(scene, grid, exposure_s=EXPOSURE_S)
    seen = camera_of(sites, order=1).with_gaze(GAZE_UM, axis)
    pitched = camera.fit_scene(scene).with_pitch(camera.fit_scene(scene).pitch_um)
    found = seen.photoelectrons_per_s(pitched) * EXPOSURE_S / 16.0

    np.testing.assert_allclose(ideal.data[0].ravel(), found, rtol=1e-5)
    assert ideal.grid == grid


def test_cameras_share_their_compiled_layouts():
    camera, scene = camera_of(), scene_of()
    turned = camera.with_gaze(GAZE_UM)
    first = turned.photoelectrons_per_s(scene)
    assert turned.with_gaze(None) is turned
    assert any(key[2] == GAZE_UM for key in camera._integrators)
    assert np.array_equal(camera.with_gaze(GAZE_UM).photoelectrons_per_s(scene), first)
    assert turned.replace(optics=replace(OPTICS, f_number=8.0)).gaze_um == GAZE_UM


@pytest.mark.parametrize("gaze_um", [(1.0,), (np.nan, 0.0), "left", ((0.0, 0.0), (1.0, 1.0))])
def test_wrong_gaze_is_one_line(gaze_um):
    with pytest.raises(ParameterError, match=r"^'gaze_um'") as caught:
        camera_of().capture(scene_of(), exposure_s=EXPOSURE_S, seed=0, gaze_um=gaze_um)
    assert "\n" not in str(caught.value)


def test_video_warns_once_of_sites_outside_image():
    camera, scene = camera_of(), scene_of(fit="cover")
    path = saccades(duration_s=1.0, frame_s=0.05, size_um=(200.0, 200.0), seed=1)
    with pytest.warns(CoverageWarning) as caught:
        list(camera.rates(shift_sensor(scene, path)))

    assert len(caught) == 1
    assert "outside the image at the gaze" in str(caught[0].message)


# -- files -------------------------------------------------------------------------------------------------------------


@given(st.integers(1, 20), st.integers(0, 2**32 - 1))
@settings(max_examples=examples(10))
def test_paths_are_read_as_written(tmp_path_factory, n, seed):
    rng = np.random.default_rng(seed)
    path = GazePath(np.sort(rng.random(n)), rng.normal(scale=100.0, size=(n, 2)))
    file = tmp_path_factory.mktemp("paths") / "path.csv"
    path.write(file)

    found = GazePath.read(file)
    assert np.array_equal(found.t_s, path.t_s)
    assert np.array_equal(found.xy_um, path.xy_um)


@pytest.mark.parametrize(
    "text",
    [
        "\ufefft_s;x_um;y_um;\r\n0;1,5;2\r\n0,5;-3;4,25\r\n",
        "y_um\tt_s\tx_um\n2\t0\t1,5\n4,25\t0,5\t-3\n",
        "t_s,x_um,y_um,\n0,1.5,2,\n0.5,-3,4.25,\n",
    ],
)
def test_paths_of_spreadsheets_are_read(tmp_path, text):
    (tmp_path / "path.csv").write_text(text, encoding="utf-8", newline="")
    found = GazePath.read(tmp_path / "path.csv")
    assert found.t_s.tolist() == [0.0, 0.5]
    assert found.xy_um.tolist() == [[1.5, 2.0], [-3.0, 4.25]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have the columns 't_s', 'x_um' and 'y_um' in its first line"),
        ("t_s,x_um\n0,1\n", "must have the columns"),
        ("t_s,x_um,y_um\n0,1,left\n", "must have numbers in line 2, got 0, 1, left"),
        ("t_s,x_um,y_um\n1,0,0\n0,0,0\n", "ascending"),
        ("t_s,x_um,y_um\n0,nan,0\n", "three finite numbers, t_s, x_um and y_um, in line 2"),
        ("t_s,x_um,y_um\n", "one or more rows"),
    ],
)
def test_invalid_path_file_is_one_line(tmp_path, text, message):
    (tmp_path / "path.csv").write_text(text)

    with pytest.raises(FileError, match=message) as caught:
        GazePath.read(tmp_path / "path.csv")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["chip.gds", "chip.npz", "chip.geojson", "chip.yaml"])
def test_layouts_are_centred_when_read(tmp_path, name):
    layout = fs.layout.grid(n_x=4, n_y=3, pitch_um=2.0).translate(500.0, -70.0)
    if name.endswith(".yaml"):
        generated = {
            "generator": "grid",
            "parameters": {"n_x": 4, "n_y": 3, "pitch_um": 2.0},
            "move_um": [500.0, -70.0],
        }
        (tmp_path / name).write_text(yaml.safe_dump(generated))
    else:
        layout.write(tmp_path / name)

    assert fs.read_layout(tmp_path / name).bounds_um == pytest.approx((496.0, -73.0, 504.0, -67.0))
    found = fs.read_layout(tmp_path / name, centre=True)
    assert found.bounds_um == pytest.approx((-4.0, -3.0, 4.0, 3.0), abs=1e-9)
    if not name.endswith(".yaml"):
        settings = {**SETTINGS, "layout": {"file": str(tmp_path / name), "centre": True}}
        assert read_shot_of(tmp_path, settings).camera.layout.bounds_um == found.bounds_um
    assert layout[:0].centre().n_sites == 0


def read_shot_of(directory, data):
    from PIL import Image

    Image.fromarray((255 * PICTURE).astype(np.uint8)).save(directory / "scene.png")
    (directory / "shot.yaml").write_text(yaml.safe_dump(data))
    return read_shot(directory / "shot.yaml")
