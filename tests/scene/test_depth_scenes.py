"""Scenes with depth: files and units of distances, and their use in cameras, videos, tiles, settings and sweeps."""

import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import yaml

import foveasim as fs
from foveasim._io.images import write_picture
from foveasim.errors import FileError, ParameterError

LIGHT = {"distance_m": 2.0, "illuminance_lux": 500.0}


def disc_before_wall(shape=(48, 64)):
    """Return a colour picture, and distances of 0.5 m in a disc and 2 m around it."""
    y, x = (np.arange(n) - 0.5 * (n - 1) for n in shape)
    depth_m = np.where(np.add.outer(y**2, x**2) < (0.3 * shape[0]) ** 2, 0.5, 2.0)
    return np.random.default_rng(0).random((*shape, 3)), depth_m


def camera(**optics):
    layout = fs.layout.grid(n_x=16, n_y=12, pitch_um=6.0)
    return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.0, **optics), sensor=fs.Sensor(layout))


def distances_of(depth, **options):
    """Return the distances of a scene, top row first."""
    shape = np.shape(depth) if not isinstance(depth, str) else options.pop("shape")
    return fs.Scene.from_rgbd(np.ones(shape), depth, **LIGHT, **options).depth_m[::-1]


def test_distances_are_top_row_first():
    scene = fs.Scene.from_rgbd(np.ones((2, 3)), [[1.0, 1.0, 1.0], [2.0, 2.0, np.inf]], **LIGHT)

    assert scene.depth_m[0].tolist() == [2.0, 2.0, np.inf]
    assert scene.depth_range_m == (1.0, np.inf)
    assert "depth 1 to inf m" in repr(scene)


def test_missing_distances_are_explicit():
    depth_m = [[1.0, 0.0, 3.0], [1.0, np.nan, 3.0]]

    with pytest.raises(ParameterError, match="2 of 6 are 0 or NaN; pass missing="):
        distances_of(depth_m)
    assert distances_of(depth_m, missing="far").tolist() == [[1.0, np.inf, 3.0]] * 2
    assert distances_of(depth_m, missing="nearest")[0, [0, 2]].tolist() == [1.0, 3.0]
    assert np.isfinite(distances_of(depth_m, missing="nearest")).all()


@pytest.mark.parametrize(
    ("convention", "stored", "expected_m"),
    [
        ("mm", 1500, 1.5),
        ("nyu", 1500, 1.5),
        ("tum", 5000, 1.0),  # "a pixel value of 5000 in the depth image corresponds to a distance of 1 meter"
        ("nyu_raw", 800, 1.2010),  # 351.3 / 292.5
        ("nyu_raw", 1057, 9.8958),
        ("nyu_raw", 1084, 10.0),  # the limit of the toolbox, camera_params.m
    ],
)
def test_conventions_of_integers(tmp_path, convention, stored, expected_m):
    write_picture(tmp_path / "depth.png", np.full((4, 4), stored, np.uint16))

    found = distances_of(str(tmp_path / "depth.png"), shape=(4, 4), depth_format=convention)

    np.testing.assert_allclose(found, expected_m, rtol=1e-4)


def test_nyu_pictures_agree_with_raw_values():
    """A raw value of 600 is the nearest that the toolbox keeps, 0.71 m."""
    raw = distances_of(np.array([[600]]), depth_format="nyu_raw")
    assert raw[0, 0] == pytest.approx(0.7133, abs=1e-4)
    assert distances_of(np.array([[713]], np.uint16), depth_format="nyu")[0, 0] == pytest.approx(raw[0, 0], abs=1e-3)


def test_raw_value_without_distance_is_missing():
    assert distances_of([[2047, 800]], depth_format="nyu_raw", missing="far")[0, 0] == np.inf


def test_middlebury_disparities_follow_calibration(tmp_path):
    """Z = baseline f / (d + doffs), in mm; unknown disparities are infinite."""
    (tmp_path / "calib.txt").write_text(
        "cam0=[3979.911 0 1244.772; 0 3979.911 1019.507; 0 0 1]\ndoffs=124.343\nbaseline=193.001\n"
    )
    disparity = np.array([[100.0, np.inf], [200.0, 100.0]])

    found = distances_of(disparity, depth_format="middlebury", calibration=tmp_path / "calib.txt", missing="far")

    assert found[0, 0] == pytest.approx(1e-3 * 193.001 * 3979.911 / 224.343, rel=1e-12)
    assert found[0, 1] == np.inf


def test_pfm_of_middlebury_is_read(tmp_path):
    """Rows of PFM start at the bottom; calib.txt is that of the scene Motorcycle."""
    disparity = np.array([[100.0, np.inf, 50.0], [200.0, 100.0, np.inf]], "<f4")
    (tmp_path / "disp0.pfm").write_bytes(b"Pf\n3 2\n-1.0\n" + disparity[::-1].tobytes())
    (tmp_path / "calib.txt").write_text(
        "cam0=[3979.911 0 1244.772; 0 3979.911 1019.507; 0 0 1]\n"
        "cam1=[3979.911 0 1369.115; 0 3979.911 1019.507; 0 0 1]\n"
        "doffs=124.343\nbaseline=193.001\nwidth=2964\nheight=2000\nndisp=280\nisint=0\nvmin=31\nvmax=257\n"
    )

    found = distances_of(
        str(tmp_path / "disp0.pfm"), shape=(2, 3), depth_format="middlebury",
        calibration=tmp_path / "calib.txt", missing="far",
    )  # fmt: skip

    np.testing.assert_allclose(found, [[3.42389, np.inf, 4.40584], [2.36825, 3.42389, np.inf]], rtol=1e-5)


def test_depth_channel_of_exr_is_read(tmp_path):
    exr = pytest.importorskip("OpenEXR")
    depth = np.array([[1.0, 2.0], [3.0, np.inf]], np.float32)
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    with exr.File(header, {"Z": depth}) as file:
        file.write(str(tmp_path / "depth.exr"))

    found = distances_of(str(tmp_path / "depth.exr"), shape=(2, 2), depth_scale=1.0)

    np.testing.assert_array_equal(found, depth)


def test_ambiguous_depth_files_are_refused(tmp_path):
    write_picture(tmp_path / "deep.png", np.full((4, 4), 1500, np.uint16))
    write_picture(tmp_path / "grey.png", np.full((4, 4), 150, np.uint8))

    with pytest.raises(FileError, match=r"deep\.png: does not state the unit .* pass depth_scale"):
        distances_of(str(tmp_path / "deep.png"), shape=(4, 4))
    with pytest.raises(FileError, match="has 8 bits"):
        distances_of(str(tmp_path / "grey.png"), shape=(4, 4), depth_scale=0.01)
    with pytest.raises(ParameterError, match="'calibration' must be the file"):
        distances_of(np.ones((4, 4)), depth_format="middlebury")
    with pytest.raises(ParameterError, match="'depth_scale' must not be given together"):
        distances_of(np.ones((4, 4)), depth_format="mm", depth_scale=1.0)


@pytest.mark.parametrize(
    ("depth_m", "sentence"),
    [
        (np.full((48, 64), -1.0), "'depth_m' must be > 0"),
        (np.ones((4, 4)), r"'depth_m' must have the shape of the picture, \(48, 64\)"),
        (np.ones(4), r"'depth_m' must have the shape \(n_y, n_x\)"),
    ],
)
def test_wrong_distances_give_sentence(depth_m, sentence):
    with pytest.raises(ParameterError, match=sentence):
        fs.Scene.from_rgbd(disc_before_wall()[0], depth_m, **LIGHT)


def test_distance_within_focal_length_is_refused():
    picture, depth_m = disc_before_wall()
    scene = fs.Scene.from_rgbd(picture, 1e-3 * depth_m, **LIGHT)

    with pytest.raises(ParameterError, match="'depth_m' must be larger than the focal length"):
        camera().predict(scene, exposure_s=0.01)


def test_sampled_psfs_are_refused_with_depth():
    spot = np.exp(-0.5 * np.add.outer(np.arange(-8, 9) ** 2, np.arange(-8, 9) ** 2))
    psfs = fs.optics.PSFGrid.from_arrays(spot, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0)

    sentence = "'psfs' must not be given for a scene with depth: PSFs sampled .* pass the Zernike coefficients"
    with pytest.raises(ParameterError, match=sentence):
        camera(psfs=psfs).predict(fs.Scene.from_rgbd(*disc_before_wall(), **LIGHT), exposure_s=0.01)


def test_near_disc_is_blurred_by_focus():
    """The wall is sharp and the disc blurred, or the reverse, as the lens is focused."""
    scene = fs.Scene.from_rgbd(*disc_before_wall(), **LIGHT)
    plane = fs.Scene.from_picture(disc_before_wall()[0], **LIGHT)
    is_near = scene.depth_m == 0.5
    inner = np.add.outer((np.arange(48) - 23.5) ** 2, (np.arange(64) - 31.5) ** 2) < 8.0**2

    def contrast(optics, light, where):
        data = optics.power_map(light.with_pitch(400.0)).data[1]
        return data[where].std() / data[where].mean()

    near, far = (
        fs.Optics(focal_length_mm=16.0, f_number=12.0, focus_distance_m=f_m, oversample=1) for f_m in (0.5, 2.0)
    )
    corner = ~is_near & (np.add.outer((np.arange(48) - 23.5) ** 2, (np.arange(64) - 31.5) ** 2) > 30.0**2)
    assert contrast(near, scene, inner) > 2.0 * contrast(far, scene, inner)
    assert contrast(far, scene, corner) > 2.0 * contrast(near, scene, corner)
    assert contrast(far, scene, corner) == pytest.approx(contrast(far, plane, corner), rel=1e-2)


def test_layers_are_limited_in_number():
    picture = np.random.default_rng(0).random((32, 64))
    depth_m = np.linspace(0.4, 3.0, 64) * np.ones((32, 1))
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.0)
    maps = {
        n: optics.power_map(fs.Scene.from_rgbd(picture, depth_m, depth_layers=n, pitch_um=500.0, **LIGHT)).data
        for n in (1, 4, None)
    }

    error = {n: np.abs(maps[n] - maps[None]).max() for n in (1, 4)}
    assert error[1] > error[4] > 0.0


def test_capture_prediction_and_tiles_agree():
    scene = fs.Scene.from_rgbd(*disc_before_wall(), **LIGHT)
    cam = camera()

    capture = cam.capture(scene, exposure_s=0.01, seed=3)
    mean, _ = cam.predict(scene, exposure_s=0.01)
    tiles = list(fs.tiles.capture_tiles(cam, scene, exposure_s=0.01, seed=3, tile_sites=64))

    assert np.corrcoef(mean, capture.code)[0, 1] > 0.9
    np.testing.assert_array_equal(np.concatenate([tile.code for tile in tiles]), capture.code)
    assert capture.settings["light"]["depth_m"]["shape"] == [48, 64]
    assert pickle.loads(pickle.dumps(scene)).depth_range_m == (0.5, 2.0)


def test_video_follows_depth_of_each_frame():
    picture, depth_m = disc_before_wall()
    frames = [fs.Scene.from_rgbd(picture, np.where(depth_m < 1.0, z_m, 2.0), **LIGHT) for z_m in (2.0, 0.5)]

    still, moved = camera().video(frames, exposure_s=0.01, seed=0)
    alone = camera().capture(frames[1], exposure_s=0.01, seed=0, frame=1)

    np.testing.assert_array_equal(moved.code, alone.code)
    assert (still.expected_e != moved.expected_e).any()


def test_frames_of_video_have_depth_of_template():
    picture, depth_m = disc_before_wall()
    template = fs.Scene.from_rgbd(picture, depth_m, **LIGHT)

    (frame,) = fs.video.FrameSource([picture[::-1]], template=template, encoding="linear")

    np.testing.assert_array_equal(frame.depth_m, template.depth_m)
    with pytest.raises(ParameterError, match="'depth_m' must have the shape of the picture"):
        next(iter(fs.video.FrameSource([picture[:20]], template=template, encoding="linear")))


def test_threads_and_processes_agree():
    scene, cam = fs.Scene.from_rgbd(*disc_before_wall(), **LIGHT), camera(focus_distance_m=0.5)
    expected = cam.predict(scene, exposure_s=0.01)[0]

    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: cam.predict(scene, exposure_s=0.01)[0], range(3)))
    code = (
        "import pickle, sys; cam, scene = pickle.load(sys.stdin.buffer); "
        "sys.stdout.buffer.write(pickle.dumps(cam.predict(scene, exposure_s=0.01)[0]))"
    )
    other = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps((cam, scene)), capture_output=True, check=True
    )

    for mean in (*found, pickle.loads(other.stdout)):
        np.testing.assert_array_equal(mean, expected)


@pytest.mark.parametrize("padding", ["reflect", "zero"])
def test_maps_do_not_depend_on_threads(padding):
    scene = fs.Scene.from_rgbd(*disc_before_wall((200, 96)), pitch_um=400.0, **LIGHT)
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.0, padding=padding)

    np.testing.assert_array_equal(optics.power_map(scene, n_threads=1).data, optics.power_map(scene, n_threads=3).data)


def test_dual_pixels_share_electrons():
    """The halves of each pair of photodiodes collect what the full pupil does, up to their displacement."""
    scene = fs.Scene.from_rgbd(*disc_before_wall(), **LIGHT)
    left, right, full = (
        camera(pupil_part=part).capture(scene, exposure_s=0.01, seed=0).expected_e for part in ("left", "right", "full")
    )

    assert left.sum() + right.sum() == pytest.approx(full.sum(), rel=2e-3)
    assert np.abs(left - right).max() > 0.05 * full.mean()


def test_sweep_varies_focus_and_layers(settings):
    values = {"optics.focus_distance_m": [0.5, 2.0], "scene.depth_layers": [1, 100]}

    found = fs.explore.sweep(settings, values, metrics=["snr"], workers=0)["snr_median"]

    assert len(np.unique(found)) == 4


def test_datasets_refuse_depth(settings):
    with pytest.raises(
        (FileError, ParameterError), match="must be 'picture' for a dataset, which supplies the pictures"
    ):
        fs.explore.Dataset([np.ones((48, 64))], settings)


def test_panoramas_refuse_depth():
    panorama = fs.Scene.from_panorama(np.ones((16, 32)), luminance_cd_m2=100.0)
    with pytest.raises(ParameterError, match="'depth_m' must not be given for a panorama"):
        replace(panorama, depth_m=np.ones((16, 32)))


def test_crops_of_gaze_paths_keep_depth():
    picture, depth_m = disc_before_wall()
    scene = fs.Scene.from_rgbd(picture, depth_m, pitch_um=500.0, **LIGHT)
    path = fs.video.GazePath([0.0, 1.0], [[0.0, 0.0], [0.0, 0.0]])

    part, _ = next(iter(fs.video.pan_camera(scene, path, fs.Optics(focal_length_mm=8.0, f_number=2.0), shape=(24, 32))))

    np.testing.assert_array_equal(part.depth_m, scene.depth_m[12:36, 16:48])


@pytest.fixture
def settings(tmp_path):
    picture, depth_m = disc_before_wall()
    write_picture(tmp_path / "picture.png", (255 * picture).astype(np.uint8))
    write_picture(tmp_path / "depth.png", (1000 * depth_m).astype(np.uint16))
    shot = {
        "scene": {"kind": "rgbd", "picture": "picture.png", "depth_m": "depth.png", "depth_format": "mm", **LIGHT},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.0, "focus_distance_m": 1.0},
        "layout": {"generator": "grid", "parameters": {"n_x": 16, "n_y": 12, "pitch_um": 6.0}},
        "exposure_s": 0.01,
    }
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(shot))
    return tmp_path / "shot.yaml"


def test_settings_file_runs_with_depth(settings):
    run = subprocess.run(
        [sys.executable, "-m", "foveasim", "run", "shot.yaml", "--out", "out"],
        cwd=settings.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip

    assert run.returncode == 0, run.stderr
    shot = fs.config.read_shot(settings)
    assert shot.scene.depth_range_m == (0.5, 2.0)
