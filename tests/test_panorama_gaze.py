"""Cameras that turn in panoramas: ``gaze_deg``."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from PIL import Image

import foveasim as fs
from foveasim.compare.metrics import ComparedShot
from foveasim.config import to_python
from foveasim.errors import FileError, ParameterError
from foveasim.metrics.registry import number_of
from foveasim.scene._panorama import Panorama
from foveasim.video import DirectionPath, follow_gaze, read_gaze_path, turn_camera

SHOT = """
scene: {kind: panorama, picture: sky.png, luminance_cd_m2: 500.0, cells: 64}
optics: {focal_length_mm: 1.0, f_number: 2.8}
distortion: {kind: fisheye, projection: equidistant, focal_um: 1000.0}
layout: {generator: grid, parameters: {n_x: 6, n_y: 4, pitch_um: 400.0}}
gaze_deg: [70.0, -20.0]
exposure_s: 0.001
"""
GAZE_DEG = (70.0, -20.0)


@pytest.fixture
def sky():
    picture = np.random.default_rng(0).integers(0, 255, (16, 32), np.uint8)
    return fs.Scene.from_panorama(picture, luminance_cd_m2=500.0, cells=64)


@pytest.fixture
def camera():
    return fs.Camera(
        optics=fs.Optics(focal_length_mm=1.0, f_number=2.8),
        sensor=fs.Sensor(fs.layout.grid(n_x=6, n_y=4, pitch_um=400.0), read_noise_e=2.0),
        distortion=fs.distortion.Fisheye(projection="equidistant", focal_um=1000.0),
    )


@pytest.fixture
def n_resampled(monkeypatch):
    """Return a list with one entry per resampled panorama."""
    found, original = [], Panorama.cell_means

    def counted(self, *arguments):
        found.append(self.gaze_deg)
        return original(self, *arguments)

    monkeypatch.setattr(Panorama, "cell_means", counted)
    return found


def test_gaze_equals_turned_panorama(sky, camera):
    """Azimuth and elevation turn the camera as yaw and pitch do, from the orientation of the scene."""
    turned = sky.turned(yaw_deg=70.0, pitch_deg=-20.0)
    expected = camera.capture(turned, exposure_s=0.001, seed=1)
    found = camera.capture(sky, exposure_s=0.001, seed=1, gaze_deg=GAZE_DEG)
    np.testing.assert_array_equal(found.code, expected.code)
    assert found.settings["gaze_deg"] == list(GAZE_DEG)
    assert "gaze_deg" not in expected.settings

    mean_dn, _ = camera.predict(sky, exposure_s=0.001, gaze_deg=GAZE_DEG)
    np.testing.assert_array_equal(mean_dn, camera.predict(turned, exposure_s=0.001)[0])
    aside = camera.with_gaze(gaze_deg=(-70.0, 0.0))
    back = aside.photoelectrons_per_s(sky.turned(yaw_deg=70.0))
    np.testing.assert_allclose(back, camera.photoelectrons_per_s(sky), rtol=1e-6)
    assert aside.gaze_deg == (-70.0, 0.0)


@pytest.mark.parametrize("ahead", [0, 2])
def test_moving_gaze_resamples_once_per_frame(sky, camera, n_resampled, ahead):
    path = DirectionPath([0.0, 0.1, 0.2, 0.3], [[0.0, 0.0], [30.0, 10.0], [30.0, 10.0], [-60.0, 0.0]])
    captures = list(camera.video(turn_camera(sky, path), exposure_s=0.001, seed=0, ahead=ahead))
    assert sorted(n_resampled) == [(-60.0, 0.0), (0.0, 0.0), (30.0, 10.0)]
    assert [capture.settings["time_s"] for capture in captures] == [0.0, 0.1, 0.2, 0.3]
    for capture, gaze_deg in zip(captures, path.direction_deg.tolist(), strict=True):
        expected = camera.photoelectrons_per_s(sky.turned(yaw_deg=gaze_deg[0], pitch_deg=gaze_deg[1]))
        np.testing.assert_allclose(capture.expected_e, camera.sensor.expected_electrons(expected, 0.001), rtol=1e-12)


@pytest.mark.parametrize("ahead", [0, 2])
def test_turning_sensor_resamples_once_per_frame(sky, camera, n_resampled, ahead):
    turning = camera.replace(axis="sensor")
    frames = [(sky, (100.0 * k, 50.0)) for k in range(4)]
    assert len(list(turning.video(frames, exposure_s=0.001, seed=0, ahead=ahead))) == 4
    assert len(n_resampled) == 4


def test_frames_of_videos_follow_directions(sky, camera):
    """The gaze of a frame is instead of that of the camera."""
    path = DirectionPath([0.0, 0.2], [[0.0, 0.0], [40.0, 0.0]])
    frames = list(follow_gaze([sky] * 3, path, frame_s=0.1))
    assert [frame.panorama.gaze_deg for frame in frames] == [(0.0, 0.0), (20.0, 0.0), (40.0, 0.0)]
    aside = camera.with_gaze(gaze_deg=(100.0, 0.0))
    found = [capture.expected_e for capture in aside.video(frames, exposure_s=0.001, seed=0)]
    expected = camera.photoelectrons_per_s(sky.turned(yaw_deg=20.0))
    np.testing.assert_allclose(found[1], camera.sensor.expected_electrons(expected, 0.001), rtol=1e-12)
    power_map = fs.PowerMap.from_array(np.ones((8, 8)), pitch_um=500.0, wavelength_nm=550.0)
    with pytest.raises(ParameterError, match="'scene' must be a panorama for a path of directions, got a power map"):
        list(follow_gaze([power_map], path, frame_s=0.1))


def test_gaze_without_panorama_is_an_error(sky, camera):
    plane = fs.Scene.flat(shape=(64, 64), pitch_um=1e5, distance_m=10.0, luminance_cd_m2=1.0)
    power_map = fs.PowerMap.from_array(np.ones((8, 8)), pitch_um=500.0, wavelength_nm=550.0)
    aside = camera.with_gaze(gaze_deg=GAZE_DEG)
    for light in (plane, power_map, camera.fit_scene(sky)):
        with pytest.raises(
            ParameterError,
            match=r"'gaze_deg' must be \(0, 0\) for a plane, a power map, and a panorama that a camera has",
        ):
            aside.photoelectrons_per_s(light)
    with pytest.raises(
        ParameterError, match=r"'gaze_um' must be .* for axis='sensor' and a camera that turns by 'gaze"
    ):
        aside.capture(sky, exposure_s=0.001, seed=0, gaze_um=(100.0, 0.0), axis="sensor")
    with pytest.raises(ParameterError, match="the azimuth, within ±360, and the elevation, within ±90"):
        camera.with_gaze(gaze_deg=(0.0, 91.0))
    with pytest.raises(ParameterError, match="must be a panorama, which Scene"):
        turn_camera(plane, DirectionPath([0.0], [[1.0, 2.0]]))
    with pytest.raises(ParameterError, match="'path' must be a GazePath, got a DirectionPath"):
        fs.video.shift_sensor(sky, DirectionPath([0.0], [[1.0, 2.0]]))


def test_gaze_moves_sensor_behind_turned_camera(sky, camera):
    """With the axis of the image, ``gaze_um`` moves the sensor, and ``gaze_deg`` turns the camera."""
    wide = fs.Scene.from_panorama(
        np.random.default_rng(0).integers(0, 255, (16, 32), np.uint8),
        luminance_cd_m2=500.0,
        cells=64,
        gaze_range_um=(300.0, 300.0),
    )
    gazes = {"gaze_um": (200.0, -100.0)}
    expected = camera.capture(wide.turned(yaw_deg=70.0, pitch_deg=-20.0), exposure_s=0.001, seed=0, **gazes)
    found = camera.capture(wide, exposure_s=0.001, seed=0, gaze_deg=GAZE_DEG, **gazes)
    np.testing.assert_array_equal(found.code, expected.code)


def test_settings_files_turn_the_camera(tmp_path, camera):
    sky = np.random.default_rng(0).integers(0, 255, (16, 32), np.uint8)
    Image.fromarray(sky).save(tmp_path / "sky.png")
    (tmp_path / "shot.yaml").write_text(SHOT)
    shot = fs.config.read_shot(tmp_path / "shot.yaml")
    scene = fs.Scene.from_panorama(sky, luminance_cd_m2=500.0, cells=64)
    expected = camera.with_gaze(gaze_deg=GAZE_DEG).photoelectrons_per_s(scene)
    np.testing.assert_array_equal(shot.camera.photoelectrons_per_s(shot.scene), expected)
    assert "gaze_deg=[70.0, -20.0]" in to_python(yaml.safe_load(SHOT))

    (tmp_path / "gaze.csv").write_text("t_s,azimuth_deg,elevation_deg\n0,0,0\n1,90,10\n")
    path = read_gaze_path(tmp_path / "gaze.csv")
    assert path.at(0.5).tolist() == [45.0, 5.0]
    (tmp_path / "frames").mkdir()
    for k in range(2):
        Image.fromarray(sky).save(tmp_path / "frames" / f"{k}.png")
    fs.config.run_video(shot, tmp_path / "frames", tmp_path / "out.zarr", frame_s=1.0, gaze=tmp_path / "gaze.csv")
    code = fs.video.read_recording(tmp_path / "out.zarr").code[1]
    again = shot.camera.capture(scene, exposure_s=0.001, seed=0, frame=1, gaze_deg=(90.0, 10.0)).code
    np.testing.assert_array_equal(code, again)

    moving = tmp_path / "moving.yaml"
    moving.write_text(SHOT.replace("gaze_deg: [70.0, -20.0]", "gaze_path: gaze.csv"))
    names: dict = {}
    exec(to_python(yaml.safe_load(moving.read_text()), source=moving), names)
    assert fs.config.read_shot(moving).gaze_path.rows.tolist() == path.rows.tolist()
    np.testing.assert_array_equal(list(names["video"])[1].code, again)

    (tmp_path / "gaze.csv").write_text("t_s,azimuth_deg,elevation_deg\n0,0,95\n")
    with pytest.raises(FileError, match="the elevation, within ±90"):
        read_gaze_path(tmp_path / "gaze.csv")


@pytest.fixture
def pair(camera):
    hexagons = fs.layout.hexagonal(n_columns=6, n_rows=4, pitch_um=430.0)
    return {"grid": camera, "hexagons": camera.replace(sensor=fs.Sensor(hexagons, read_noise_e=2.0))}


def test_turned_cameras_are_compared(pair, sky):
    options = {"exposure_s": 1e-3, "n_annuli": 2, "max_pixels": 32}
    turned = {name: one.with_gaze(gaze_deg=GAZE_DEG) for name, one in pair.items()}
    found = fs.compare.cameras(turned, {"sky": sky}, **options)
    expected = fs.compare.cameras(pair, {"sky": sky.turned(gaze_deg=GAZE_DEG)}, **options)

    for name, values in expected.values.items():
        np.testing.assert_array_equal(found.values[name], values, err_msg=name)
    assert found.settings["cameras"]["grid"]["gaze_deg"] == list(GAZE_DEG)
    ahead = fs.compare.cameras(pair, {"sky": sky}, **options)
    assert np.all(ahead.values["snr_mean_db"] != found.values["snr_mean_db"])


def test_comparison_requires_one_direction(pair, sky):
    flat = fs.Scene.flat(shape=(40, 40), pitch_um=100_000.0, distance_m=1.0, illuminance_lux=500.0)
    turned = {name: one.with_gaze(gaze_deg=GAZE_DEG) for name, one in pair.items()}
    with pytest.raises(ParameterError, match=r"'cameras' must have the same gaze_deg.* 'grid' and 'hexagons' differ"):
        fs.compare.cameras(turned | {"grid": pair["grid"]}, {"sky": sky}, exposure_s=1e-3)
    with pytest.raises(ParameterError, match=r"'gaze_deg' must be \(0, 0\) for a plane"):
        fs.compare.cameras(turned, {"flat": flat}, exposure_s=1e-3)
    moved = {name: one.with_gaze((100.0, 0.0), "sensor") for name, one in pair.items()}
    with pytest.raises(ParameterError, match=r"'gaze_um' must be \(0, 0\) for panoramas.*'grid'.*'gaze_deg'"):
        fs.compare.cameras(moved, {"sky": sky}, exposure_s=1e-3)


@pytest.mark.parametrize("name", ["shift_sigma_um", "information_bit_per_site"])
@pytest.mark.parametrize("gaze", [{"gaze_deg": GAZE_DEG}, {"gaze_um": (300.0, -200.0), "axis": "sensor"}])
def test_metrics_of_turned_cameras(camera, sky, name, gaze):
    away = camera.with_gaze(**gaze)
    ahead_deg = away.seen_panorama(sky).gaze_deg
    found, expected = (
        number_of(name, ComparedShot(scene, one, 1e-3), one, one.capture(scene, exposure_s=1e-3, seed=0))
        for one, scene in ((away, sky), (camera, sky.turned(gaze_deg=ahead_deg)))
    )
    assert found == pytest.approx(expected, rel=1e-6)
    assert ahead_deg[0] > 5.0
