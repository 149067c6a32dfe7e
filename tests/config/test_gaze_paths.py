"""Gaze paths of settings files: rows, CSV files, videos, captures and generated source."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import yaml
from films import random_pictures, write_film
from PIL import Image
from typer.testing import CliRunner

import foveasim as fs
from foveasim.cli import app
from foveasim.config import build_shot, check_settings, get_setting, read_settings, read_shot, schema, to_python
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.video import GazePath, read_recording

SETTINGS = {
    "scene": {
        "kind": "picture", "picture": "scene.png", "fit": "cover", "gaze_range_um": [30.0, 20.0],
        "distance_m": 0.5, "peak_radiance_w_m2_sr_nm": 0.05, "wavelength_nm": [550.0], "band_width_nm": 10.0,
    },
    "optics": {"focal_length_mm": 22.0, "f_number": 4.0},
    "layout": {"generator": "hexagonal", "parameters": {"n_columns": 12, "n_rows": 10, "pitch_um": 5.0}},
    "sensor": {"read_noise_e": 3.0, "bits": 12, "capacitance_f": 1e-13},
    "exposure_s": 0.01,
    "seed": 1,
}  # fmt: skip
#: At 25 frames per second, with the gaze of frame 1 between two rows.
ROWS = [[0.0, -20.0, 10.0], [0.08, 20.0, -10.0]]
GAZES_UM = [[-20.0, 10.0], [0.0, 0.0], [20.0, -10.0], [20.0, -10.0]]
N_FRAMES, FRAME_S = 4, 0.04


def picture(k):
    return np.random.default_rng(k).integers(0, 255, (81, 111), dtype=np.uint8)


@pytest.fixture
def files(tmp_path):
    """Write a picture, four frames, the shot, and its path as a CSV file."""
    Image.fromarray(picture(0)).save(tmp_path / "scene.png")
    (tmp_path / "frames").mkdir()
    for k in range(N_FRAMES):
        Image.fromarray(picture(k)).save(tmp_path / "frames" / f"{k}.png")
    write_shot(tmp_path, "still")
    lines = ["t_s,x_um,y_um", *(",".join(map(str, row)) for row in ROWS)]
    (tmp_path / "path.csv").write_text("\n".join(lines))
    return tmp_path


def write_shot(directory, name, **changes):
    (directory / f"{name}.yaml").write_text(yaml.safe_dump(SETTINGS | changes))
    return directory / f"{name}.yaml"


def video_of(path, *options):
    """Return the recording of ``foveasim video`` with the frames next to a shot."""
    out = path.with_suffix(".zarr")
    command = ["video", str(path), "--frames", str(path.parent / "frames"), "--out", str(out), "--fps", "25"]
    found = CliRunner().invoke(app, [*command, *options])
    assert found.exit_code == 0, found.output
    return read_recording(out)


def rows_before(n):
    """Return valid rows before a wrong one."""
    return [[0.5 * k, 1.0, 2.0] for k in range(n)]


# -- settings ---------------------------------------------------------------------------------------------------------


def test_rows_and_files_give_the_same_path(files):
    by_rows = read_shot(write_shot(files, "rows", gaze_path=ROWS)).gaze_path
    by_file = read_shot(write_shot(files, "file", gaze_path="path.csv")).gaze_path

    for path in (by_rows, by_file):
        assert path.t_s.tolist() == [0.0, 0.08]
        assert path.xy_um.tolist() == [[-20.0, 10.0], [20.0, -10.0]]
        assert path.rows.tolist() == ROWS
    assert read_shot(files / "still.yaml").gaze_path is None


def test_changes_set_the_gaze_path(files, monkeypatch):
    monkeypatch.chdir(files.parent)
    for value in (json.dumps(ROWS), str(files / "path.csv")):
        assert read_shot(files / "still.yaml", [f"gaze_path={value}"]).gaze_path.rows.tolist() == ROWS


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ([*rows_before(2), [0.25, 0.0, 0.0]], "ascending order, got 0.25 s in row 3 after 0.5 s in row 2"),
        ([*rows_before(2), [0.5, 0.0, 0.0]], "ascending order, got 0.5 s in row 3 after 0.5 s in row 2"),
        ([*rows_before(1), [1.0, 0.0]], "three finite numbers, t_s, x_um and y_um, in row 2, got [1.0, 0.0]"),
        ([[0.0, 0.0, 0.0, 0.0]], "three finite numbers, t_s, x_um and y_um, in row 1"),
        ([*rows_before(3), [2.0, math.nan, 0.0]], "three finite numbers, t_s, x_um and y_um, in row 4"),
        ([[math.inf, 1.0, 0.0]], "three finite numbers, t_s, x_um and y_um, in row 1"),
        ([], "must have one or more rows"),
    ],
)
def test_invalid_rows_are_named(rows, problem):
    for check in (lambda: check_settings(None, SETTINGS | {"gaze_path": rows}), lambda: GazePath.from_rows(rows)):
        with pytest.raises((ConfigError, ParameterError)) as caught:
            check()
        assert problem in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rows", [[[0.0, "left", 1.0]], [[0.0, None, 1.0]], [[True, 0.0, 1.0]]])
def test_rows_of_other_types_are_named(rows):
    with pytest.raises(ConfigError, match=r"^gaze_path\.0\.[01]: must be a valid number"):
        check_settings(None, SETTINGS | {"gaze_path": rows})
    with pytest.raises(ParameterError, match=r"three finite numbers.* in row 1"):
        GazePath.from_rows(rows)


def test_invalid_file_is_reported_by_videos(files):
    (files / "path.csv").write_text("t_s,x_um,y_um\n0,1,2\n0.5,1,2\n\n0.25,3,4\n")
    path = write_shot(files, "wrong", gaze_path="path.csv")
    shot = read_shot(path)  # single captures do not read it

    with pytest.raises(FileError, match=r"path\.csv: .* got 0\.25 s in line 5 after 0\.5 s in line 3"):
        shot.gaze_path  # noqa: B018
    with pytest.raises(FileError, match=r"none\.csv: no such file"):
        read_shot(write_shot(files, "none", gaze_path="none.csv")).gaze_path  # noqa: B018


def test_schema_describes_rows_and_files():
    described = schema()["properties"]["gaze_path"]
    rows, name, _ = described["anyOf"]

    assert (rows["type"], name["type"]) == ("array", "string")
    assert rows["items"] == {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
    assert "a single capture has the gaze gaze_um" in described["description"]


# -- captures and videos ----------------------------------------------------------------------------------------------


def test_captures_do_not_depend_on_the_path(files):
    from foveasim.explore.worker_cache import ShotRunner

    still, moving = (read_shot(write_shot(files, name, gaze_um=[5.0, 5.0], **more))
                     for name, more in (("one", {}), ("two", {"gaze_path": ROWS})))  # fmt: skip
    codes = [each.camera.capture(each.scene, exposure_s=each.exposure_s, seed=1).code for each in (still, moving)]
    assert np.array_equal(*codes)
    # Sweeps reuse the power on the sites.
    runner = ShotRunner(files / "one.yaml", {}, n_threads=1)
    for name in ("one", "two"):
        settings = read_settings(files / f"{name}.yaml")
        settings["scene"]["picture"] = str(files / "scene.png")
        runner.simulate_capture(settings)
    assert runner.cache.n_built["power on sites"] == 1


def test_command_of_videos_follows_the_shot(files):
    recording = video_of(write_shot(files, "moving", gaze_path=ROWS))
    shot = read_shot(files / "still.yaml")

    assert recording.gaze_um.tolist() == pytest.approx(np.array(GAZES_UM), abs=1e-12)
    for k, gaze_um in enumerate(GAZES_UM):
        scene = fs.Scene.from_picture(files / "frames" / f"{k}.png",
                                      **{name: value for name, value in SETTINGS["scene"].items() if name not in ("kind", "picture")})  # fmt: skip
        expected = shot.camera.capture(scene, exposure_s=0.01, seed=1, frame=k, gaze_um=tuple(gaze_um))
        assert np.array_equal(recording.code[k], expected.code)


def test_gaze_option_replaces_the_path(files):
    GazePath.from_rows([[0.0, 7.0, 8.0]]).write(files / "other.csv")
    path = write_shot(files, "moving", gaze_path=ROWS)
    by_option = video_of(path, "--gaze", str(files / "other.csv"))
    still = video_of(files / "still.yaml")

    assert by_option.gaze_um.tolist() == [[7.0, 8.0]] * N_FRAMES
    assert still.gaze_um.tolist() == [[0.0, 0.0]] * N_FRAMES


@pytest.mark.slow
def test_video_file_has_its_frame_times(files):
    write_film(files / "clip.avi", random_pictures(3, 40, 24), rate=50)
    colour = {**SETTINGS["scene"], "wavelength_nm": [620.0, 550.0, 450.0], "band_width_nm": 80.0}
    shot = read_shot(write_shot(files, "film", gaze_path=ROWS, scene=colour))
    fs.config.run_video(shot, files / "clip.avi", files / "film.zarr")

    found = read_recording(files / "film.zarr").gaze_um
    np.testing.assert_allclose(found, [[-20.0, 10.0], [-10.0, 5.0], [0.0, 0.0]], atol=1e-12)


# -- generated source -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gaze_path", [ROWS, "path.csv"])
def test_generated_python_has_the_path(files, monkeypatch, gaze_path):
    monkeypatch.chdir(files)
    names = {}
    exec(compile(to_python(SETTINGS | {"gaze_path": gaze_path}), "shot.py", "exec"), names)
    shot = read_shot(files / "still.yaml")
    expected = [
        shot.camera.capture(shot.scene, exposure_s=0.01, seed=1, frame=k, gaze_um=(x, y)).code
        for k, (_, x, y) in enumerate(ROWS)
    ]

    assert names["gaze_path"].rows.tolist() == ROWS
    assert np.array_equal(names["capture"].code, shot.camera.capture(shot.scene, exposure_s=0.01, seed=1).code)
    assert np.array_equal([capture.code for capture in names["video"]], expected)


def test_python_without_a_path_has_no_video(files):
    source = to_python(SETTINGS)

    assert "gaze_path" not in source
    assert "video" not in source
    assert get_setting(SETTINGS, "gaze_path") is None
    assert build_shot(files / "still.yaml", SETTINGS).gaze_source is None
