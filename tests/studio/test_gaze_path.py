"""Gaze paths in sessions without a thread: replay over pictures and videos, files, random paths, undo."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from films import random_pictures, write_film

from foveasim.config import build_shot, read_shot, run_video
from foveasim.studio._server import _exported
from foveasim.studio._settings.gaze import MAX_ROWS
from foveasim.video import FrameSource, GazePath, follow_gaze, read_recording, saccades

WIDTH, HEIGHT, N_FRAMES, FRAME_S = 40, 24, 10, 0.04
#: From frame 2 to frame 7 of the video; constant before and after.
ROWS = [[0.08, -20.0, 10.0], [0.28, 30.0, -15.0]]
#: No noise, so that frames do not differ in their number.
NOISELESS = {"read_noise_e": 0.0, "disabled": ["shot", "read", "reset"]}


def gaze_of(t_s, rows=ROWS):
    """Return the gaze on straight lines between rows."""
    times, x, y = np.transpose(rows)
    return [float(np.interp(t_s, times, each)) for each in (x, y)]


@pytest.fixture
def clip(tmp_path):
    """Write a video of 10 frames without losses."""
    return write_film(tmp_path / "clip.avi", random_pictures(N_FRAMES, WIDTH, HEIGHT))


def opened(recorder, clip):
    path = recorder.session.add_file(clip.name, clip.read_bytes())
    recorder.do(do="video", path=str(path), id=1)
    recorder.do(do="set", key="scene.gaze_range_um", value=[40.0, 20.0], id=2)  # the image covers all sites
    return recorder.do(do="set", key="gaze_path", value=ROWS, id=2)


def set_path(recorder, rows=ROWS):
    return recorder.do(do="set", key="gaze_path", value=rows, id=1)


def codes(recorder):
    return recorder.session.result.capture.code


def path_message(recorder):
    found = [message for message in recorder.messages if message["kind"] == "gaze_path"]
    return found[-1] if found else None


# -- pictures ---------------------------------------------------------------------------------------------------------


def test_replay_has_codes_of_the_library(recorder, settings):
    set_path(recorder)
    shot = build_shot(None, settings)
    for t_s in (0.0, 0.08, 0.1, 0.2, 0.28, 1.0):
        state = recorder.do(do="follow", t_s=t_s, final=False, id=2)
        x_um, y_um = state["settings"]["gaze_um"]
        expected = shot.camera.capture(shot.scene, exposure_s=0.01, seed=3, gaze_um=(x_um, y_um))

        assert [x_um, y_um] == pytest.approx(gaze_of(t_s), abs=1e-9)
        assert np.array_equal(codes(recorder), expected.code)


def test_replay_is_one_undo_step(recorder):
    before = set_path(recorder)["settings"]
    for k in range(1, 6):
        recorder.do(do="follow", t_s=0.05 * k, final=False, id=1 + k)
    assert len(recorder.session.history.states) == 2
    state = recorder.do(do="follow", t_s=0.25, final=True, id=9)

    assert len(recorder.session.history.states) == 3
    assert state["settings"]["gaze_um"] == pytest.approx(gaze_of(0.25))
    assert recorder.do(do="undo", id=10)["settings"] == before


def test_waiting_replays_are_simulated_once(recorder):
    set_path(recorder)
    version = recorder.session._version
    state = recorder.handle([{"do": "follow", "t_s": 0.01 * k, "final": False, "id": k} for k in range(10, 20)])

    assert state["settings"]["gaze_um"] == pytest.approx(gaze_of(0.19))
    assert recorder.session._version == version + 1


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        ({"do": "follow", "t_s": "soon", "final": False}, "(t_s)"),
        ({"do": "follow", "final": True}, "(t_s)"),
        ({"do": "saccades", "seed": -1, "duration_s": 1.0}, "(seed)"),
        ({"do": "saccades", "seed": 1, "duration_s": "long"}, "(duration_s)"),
        ({"do": "saccades", "seed": 1, "duration_s": 1e6}, "(duration_s) must be at most"),
        ({"do": "gaze_file", "path": "/etc/passwd"}, "is not available here"),
        ({"do": "set", "key": "gaze_path", "value": [[0, 0, 0], [0, 1, 1]]}, "0 s in row 2 after 0 s in row 1"),
    ],
)
def test_invalid_messages_keep_the_settings(recorder, message, problem):
    before = set_path(recorder)["settings"]
    state = recorder.do(**message, id=5)
    (text,) = state["errors"].values()

    assert problem in text
    assert "\n" not in text
    assert state["settings"] == before


def test_replay_needs_a_path(recorder):
    state = recorder.do(do="follow", t_s=0.0, final=False, id=1)

    assert state["errors"] == {"follow": "there is no gaze path; record or open one"}
    assert "no gaze path" in recorder.do(do="frame", n=0, follows=True, id=2)["errors"]["frame"]


# -- videos -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_frame_and_gaze_are_one_message(recorder, clip):
    opened(recorder, clip)
    session, seen = recorder.session, []
    for n in (0, 2, 5, 9, 4):
        recorder.do(do="frame", n=n, follows=True, final=False, id=10 + n)
        states = [message for message in recorder.messages if message["kind"] == "state"]
        seen += [(state["film"]["n"], state["settings"]["gaze_um"]) for state in states]
        assert session.result.settings["gaze_um"] == states[-1]["settings"]["gaze_um"]

    assert [n for n, _ in seen] == [0, 2, 5, 9, 4]
    np.testing.assert_allclose([gaze for _, gaze in seen], [gaze_of(n * FRAME_S) for n, _ in seen], atol=1e-9)
    assert not session.result.is_preview


@pytest.mark.slow
def test_frames_have_codes_of_video_command(recorder, clip, tmp_path):
    for name, value in NOISELESS.items():
        recorder.do(do="set", key=f"sensor.{name}", value=value, id=1)
    opened(recorder, clip)
    found, data = [], None
    for n in range(N_FRAMES):
        recorder.do(do="frame", n=n, follows=True, final=False, id=10 + n)
        found.append(codes(recorder))
        data = recorder.session.history.settings
    # The frames replace the picture of the shot.
    (tmp_path / "still.ppm").write_bytes(b"P6 %d %d 255\n" % (WIDTH, HEIGHT) + bytes(3 * WIDTH * HEIGHT))
    saved = {**data, "scene": {**data["scene"], "picture": "still.ppm"}}
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(saved))
    run_video(read_shot(tmp_path / "shot.yaml"), clip, tmp_path / "codes.zarr")
    recording = read_recording(tmp_path / "codes.zarr")

    assert np.array_equal(recording.code[:], found)
    np.testing.assert_allclose(recording.gaze_um, [gaze_of(n * FRAME_S) for n in range(N_FRAMES)], atol=1e-9)
    assert len({code.tobytes() for code in found}) == N_FRAMES


@pytest.mark.slow
def test_noisy_frames_have_the_seed_of_captures(recorder, clip):
    """Frame n of a video has the noise of frame n, single captures and those of the page that of frame 0."""
    opened(recorder, clip)
    settings = recorder.session.history.settings
    recorder.do(do="frame", n=5, follows=True, final=False, id=9)
    path = settings["scene"]["picture"]
    shot = build_shot(None, {**settings, "scene": {**settings["scene"], "picture": str(next(recorder.session.uploads.glob(".frames/*")))}})  # fmt: skip
    frames = list(FrameSource(clip, template=shot.scene))
    moving = list(follow_gaze(frames, GazePath.from_rows(ROWS), frame_s=FRAME_S))
    scene, gaze_um = moving[5]

    assert path.endswith(".png")
    expected = shot.camera.capture(scene, exposure_s=shot.exposure_s, seed=3, gaze_um=gaze_um)
    assert np.array_equal(codes(recorder), expected.code)


@pytest.mark.slow
def test_replayed_frames_are_one_undo_step(recorder, clip):
    opened(recorder, clip)
    n_states = len(recorder.session.history.states)
    for n in range(1, 6):
        recorder.do(do="frame", n=n, follows=True, final=False, id=10 + n)
    assert len(recorder.session.history.states) == n_states
    recorder.do(do="frame", n=5, follows=True, final=True, id=20)
    assert len(recorder.session.history.states) == n_states + 1
    state = recorder.do(do="undo", id=21)

    assert state["settings"].get("gaze_um") is None
    assert state["film"]["n"] == 5


@pytest.mark.slow
def test_failed_frames_keep_the_gaze(recorder, clip):
    opened(recorder, clip)
    before = recorder.do(do="frame", n=3, follows=True, final=True, id=9)
    state = recorder.do(do="frame", n=N_FRAMES, follows=True, final=False, id=10)

    assert state["errors"] == {"frame": "'n' must be 0 to 9"}
    assert (state["film"]["n"], state["settings"]) == (3, before["settings"])


# -- files and random paths -------------------------------------------------------------------------------------------


def test_rows_are_sent_when_they_change(recorder):
    set_path(recorder)
    assert path_message(recorder) == {"kind": "gaze_path", "rows": ROWS, "problem": "", "step_s": pytest.approx(1 / 30)}
    recorder.do(do="set", key="exposure_s", value=0.02, id=2)
    assert path_message(recorder) is None
    recorder.do(do="refresh", id=3)
    assert path_message(recorder)["rows"] == ROWS
    recorder.do(do="undo", id=4)
    recorder.do(do="undo", id=5)
    assert path_message(recorder)["rows"] == []


def test_step_is_a_frame_of_the_readout(recorder):
    readout = {"bits": 10, "frames_per_s": 120.0}
    recorder.do(do="set", key="layout.rules.readout", value=readout, id=1)

    assert path_message(recorder)["step_s"] == pytest.approx(1 / 120)


def test_opened_file_becomes_rows(recorder, tmp_path):
    lines = ["y_um,t_s,x_um", *(f"{y},{t},{x}" for t, x, y in ROWS)]
    path = recorder.session.add_file("eye.csv", "\n".join(lines).encode())
    state = recorder.do(do="gaze_file", path=str(path), id=1)
    content, name = _exported(recorder.session, "csv")
    (tmp_path / name).write_bytes(content)

    assert state["settings"]["gaze_path"] == ROWS
    assert name == "small.csv"
    assert GazePath.read(tmp_path / name).rows.tolist() == ROWS


def test_long_and_wrong_files_are_reported(recorder):
    for content, problem in (
        ("t_s,x_um,y_um\n0,1,2\n0,1,2\n", r"eye.csv: must have times in strictly ascending order"),
        ("\n".join(["t_s,x_um,y_um", *(f"{k},0,0" for k in range(MAX_ROWS + 1))]), "at most 10,000 rows"),
    ):
        path = recorder.session.add_file("eye.csv", content.encode())
        text = recorder.do(do="gaze_file", path=str(path), id=1)["errors"]["gaze_file"]
        assert problem.replace("eye", path.stem) in text
        assert str(recorder.session.uploads) not in text


def test_file_of_shot_is_saved(make_session, settings, tmp_path):
    GazePath.from_rows(ROWS).write(tmp_path / "eye.csv")
    start = {**settings, "gaze_path": str(tmp_path / "eye.csv")}
    recorder = make_session(directory=tmp_path, start=start, out=tmp_path / "out")

    assert path_message(recorder)["rows"] == ROWS
    recorder.do(do="follow", t_s=0.18, final=True, id=1)
    recorder.do(do="save", name="moved", id=2)
    shot = read_shot(tmp_path / "out" / "moved.yaml")
    assert shot.gaze_path.rows.tolist() == ROWS
    assert shot.camera.gaze_um == pytest.approx(gaze_of(0.18))


def test_missing_file_is_a_problem(make_session, settings, tmp_path):
    recorder = make_session(directory=tmp_path, start={**settings, "gaze_path": str(tmp_path / "eye.csv")})
    found = path_message(recorder)

    assert found["rows"] == []
    assert "eye.csv: no such file" in found["problem"]
    assert recorder.session.result is not None


def test_random_path_stays_on_the_image(recorder, settings):
    state = recorder.do(do="saccades", seed=7, duration_s=2.0, fixation_s=0.2, id=1)
    rows = np.array(state["settings"]["gaze_path"])
    shot = build_shot(None, settings)
    image_um, layout_um = (np.reshape(each, (2, 2)) for each in (
        shot.camera.image_grid(shot.scene).bounds_um, shot.camera.layout.bounds_um))  # fmt: skip
    free_um = np.minimum(layout_um[0] - image_um[0], image_um[1] - layout_um[1])

    assert np.all(np.abs(rows[:, 1:]) <= free_um)
    assert np.abs(rows[:, 1:]).max() > 0.3 * free_um.max()
    expected = saccades(duration_s=2.0, frame_s=1 / 30, size_um=tuple(2.0 * free_um), seed=7, fixation_s=0.2)
    np.testing.assert_allclose(rows, expected.rows, atol=1e-9)
    assert len(recorder.session.history.states) == 2


def test_random_path_needs_a_larger_image(recorder):
    recorder.do(do="set", key="scene.shape", value=[16, 16], id=1)
    state = recorder.do(do="saccades", seed=7, duration_s=2.0, id=2)

    assert "does not extend beyond the photosites" in state["errors"]["saccades"]


@pytest.mark.slow
def test_random_path_has_frames_of_video(recorder, clip):
    opened(recorder, clip)
    recorder.do(do="set", key="scene.pitch_um", value=2000.0, id=3)
    rows = recorder.do(do="saccades", seed=1, duration_s=N_FRAMES * FRAME_S, id=4)["settings"]["gaze_path"]

    np.testing.assert_allclose([row[0] for row in rows], FRAME_S * np.arange(N_FRAMES))
