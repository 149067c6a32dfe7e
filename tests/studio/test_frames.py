"""Frames of videos and cameras, comparison, notebook and archive, in sessions without a thread."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import yaml
from films import write_film
from PIL import Image
from reference.twins import small_twin
from typer.testing import CliRunner

from foveasim.capture import Capture
from foveasim.cli import app
from foveasim.errors import ParameterError
from foveasim.scene import Scene
from foveasim.studio._comparison import compare, fovea_um
from foveasim.studio._engine import Engine
from foveasim.studio._exports import notebook
from foveasim.studio._frames import camera_frame
from foveasim.studio._server import _exported, _message
from foveasim.studio._settings.unknowns import with_n_sites
from foveasim.video import FrameSource

WIDTH, HEIGHT = 40, 24


def pixels(k):
    return np.random.default_rng(k).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def message(k, **header):
    head = json.dumps({"id": k, "width": WIDTH, "height": HEIGHT, **header}).encode()
    return len(head).to_bytes(4, "little") + head + pixels(k).tobytes()


def png(array):
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.fixture
def clip(tmp_path):
    """Write a video of 10 frames without losses."""
    return write_film(tmp_path / "clip.avi", [pixels(k) for k in range(10)])


def opened(recorder, clip):
    path = recorder.session.add_file(clip.name, clip.read_bytes())
    return recorder.do(do="video", path=str(path), id=1)


def codes(recorder):
    return recorder.session.result.capture.code


def run_settings(path, out):
    """Return the codes of ``foveasim run``."""
    result = CliRunner().invoke(app, ["run", str(path), "--out", str(out)])
    assert result.exit_code == 0, result.output
    return Capture.load(out / f"{path.stem}_capture.npz").code


# -- videos -----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_video_frames_are_exact(recorder, clip):
    state = opened(recorder, clip)
    assert state["film"] == {
        "kind": "video", "name": "clip.avi", "n": 0, "n_frames": 10, "frame_s": 0.04, "width": WIDTH, "height": HEIGHT,
    }  # fmt: skip
    session = recorder.session
    for n in (3, 9, 2, 3, 0):
        state = recorder.do(do="frame", n=n, id=n)
        uploaded = session.add_file("frame.png", png(pixels(n)))
        picture = {**session.history.settings, "scene": {**session.history.settings["scene"], "picture": str(uploaded)}}

        assert state["film"]["n"] == n
        assert np.array_equal(codes(recorder), Engine(n_threads=1).simulate(picture).capture.code)


@pytest.mark.slow
def test_frames_have_time_stamps_and_depth(recorder, tmp_path):
    times_s = [0.0, 0.1, 0.5, 0.6]
    path = write_film(tmp_path / "a.mkv", [pixels(k) for k in range(4)], pixels="gbrp10le", times_s=times_s)
    state = opened(recorder, path)
    (sent,) = (message for message in recorder.messages if message["kind"] == "film_times")
    np.testing.assert_allclose(sent["times_s"], times_s)
    assert state["film"]["frame_s"] == pytest.approx(0.2)
    rows = [[0.0, 0.0, 0.0], [1.0, 10.0, -5.0]]
    recorder.do(do="set", key="gaze_path", value=rows, id=2)
    state = recorder.do(do="frame", n=2, follows=True, id=3)

    assert recorder.session.frames.time_s == pytest.approx(0.5)
    assert state["settings"]["gaze_um"] == pytest.approx([5.0, -2.5])
    assert recorder.session.frames._pixels.dtype == np.uint16
    (frame,) = list(FrameSource(path, start=2, stop=3, pitch_um=1.0, distance_m=1.0, peak_radiance_w_m2_sr_nm=1.0))
    stored = recorder.session.frames.stored_name
    scene = Scene.from_picture(stored, pitch_um=1.0, distance_m=1.0, peak_radiance_w_m2_sr_nm=1.0)
    assert np.array_equal(scene.basis, frame.basis)
    recorder.messages.clear()
    recorder.session.send_again()
    recorder.do(do="frame", n=1, id=4)
    assert any(message["kind"] == "film_times" for message in recorder.messages)


@pytest.mark.slow
def test_frames_leave_the_undo_steps(recorder, clip):
    first = recorder.session.history.settings
    opened(recorder, clip)
    for n in range(1, 10):
        recorder.do(do="frame", n=n, id=n)
    recorder.do(do="set", key="exposure_s", value=0.02, id=20)
    recorder.do(do="undo", id=21)
    state = recorder.do(do="undo", id=22)

    assert recorder.session.history.settings == first
    assert not state["can_undo"]
    assert state["film"] is None
    assert recorder.do(do="redo", id=23)["film"]["n"] == 9


@pytest.mark.slow
def test_frames_use_constant_disk_and_cache(recorder, clip):
    opened(recorder, clip)
    sizes = []
    for n in (1, 5, 9, 4, 7):
        recorder.do(do="frame", n=n, id=n)
        cache = recorder.session.engine._runner.cache
        sizes.append((len(list((recorder.session.uploads / ".frames").iterdir())), len(cache._parts)))

    assert set(sizes) == {(1, sizes[0][1])}


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("n", "text"),
    [
        (10, "'n' must be 0 to 9"),
        (-1, "'n' must be 0 to 9"),
        (1.0, "'n' must be the number of a frame, got 1.0"),
        (True, "'n' must be the number of a frame, got True"),
        (None, "'n' must be the number of a frame"),
        ("1", "'n' must be the number of a frame, got '1'"),
    ],
)
def test_missing_frames_give_one_line(recorder, clip, n, text):
    opened(recorder, clip)
    before = codes(recorder)
    state = recorder.do(do="frame", n=n, id=5)

    assert state["errors"] == {"frame": text}
    assert np.array_equal(codes(recorder), before)


@pytest.mark.slow
def test_only_newest_waiting_frame_is_decoded(recorder, clip):
    opened(recorder, clip)
    version = recorder.session._version
    state = recorder.handle([{"do": "frame", "n": n, "id": n} for n in range(1, 9)])

    assert state["film"]["n"] == 8
    assert recorder.session._version == version + 1


@pytest.mark.slow
def test_saved_settings_name_the_frame(make_session, tmp_path, clip):
    recorder = make_session(out=tmp_path / "out")
    opened(recorder, clip)
    for n in (4, 6):
        recorder.do(do="frame", n=n, id=n)
        recorder.do(do="save", name=f"shot_{n}", id=n + 10)
        found = run_settings(tmp_path / "out" / f"shot_{n}.yaml", tmp_path / "results")

        assert np.array_equal(found, codes(recorder))
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {"clip_frame_4.png", "clip_frame_6.png"}


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("name", "content"), [("a.mp4", b"text " * 99), ("b.avi", b"RIFF" + bytes(99)), ("c.gif", b"")]
)
def test_corrupt_videos_keep_the_scene(recorder, name, content):
    pytest.importorskip("av")
    path = recorder.session.add_file(name, content)
    before = recorder.session.history.settings
    state = recorder.do(do="video", path=str(path), id=1)

    assert len(state["errors"]["video"].splitlines()) == 1
    assert state["errors"]["video"].startswith(f"{name}: ")
    assert recorder.session.history.settings == before


@pytest.mark.slow
def test_videos_are_decoded_outside(recorder, clip, monkeypatch):
    av = pytest.importorskip("av")
    monkeypatch.setattr(av, "open", None)
    opened(recorder, clip)

    assert recorder.do(do="frame", n=3, id=1)["film"]["n"] == 3


def test_other_files_are_not_available(recorder):
    state = recorder.do(do="video", path="/etc/passwd", id=1)

    assert "is not available here" in state["errors"]["video"]


def test_single_gif_is_a_picture(recorder):
    pytest.importorskip("av")
    buffer = io.BytesIO()
    Image.fromarray(pixels(1)).save(buffer, "GIF")
    path = recorder.session.add_file("one.gif", buffer.getvalue())
    state = recorder.do(do="video", path=str(path), id=1)

    assert state["errors"] == {}
    assert state["film"] is None
    assert state["settings"]["scene"]["picture"] == str(path)


# -- camera -----------------------------------------------------------------------------------------------------------------


def test_camera_frames_replace_the_scene(recorder):
    recorder.handle([camera_frame(message(1, is_first=True))])
    state = recorder.handle([camera_frame(message(k)) for k in (2, 3, 4)])
    uploaded = recorder.session.add_file("frame.png", png(pixels(4)))
    settings = recorder.session.history.settings
    picture = {**settings, "scene": {**settings["scene"], "picture": str(uploaded)}}

    assert (state["film"]["kind"], state["film"]["n"]) == ("camera", 1)
    assert np.array_equal(codes(recorder), Engine(n_threads=1).simulate(picture).capture.code)
    recorder.do(do="undo", id=9)
    assert recorder.session.history.settings["scene"]["kind"] == "checkerboard"
    state = recorder.handle([camera_frame(message(5))])
    assert state["settings"]["scene"]["kind"] == "checkerboard"


def test_camera_frames_that_wait_are_replaced(recorder):
    for k in range(5):
        recorder.session.post(camera_frame(message(k, is_first=k == 0)))
    (waiting,) = recorder.session.queue.waiting

    assert (waiting.id, waiting.is_first) == (4, True)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xff\xff\xff",
        message(1)[:-1],
        message(1, width=-40, height=-24),
        message(1, width=2**20, height=2**20),
        message(1, width=40.0),
        message(1, width=True, height=40 * 24),
        (2).to_bytes(4, "little") + b"[]",
        (2).to_bytes(4, "little") + b"\xff\xff",
    ],
)
def test_invalid_camera_frames_are_rejected(recorder, content):
    with pytest.raises(ParameterError, match="'frame' must be a header and the pixels that it specifies"):
        camera_frame(content)
    assert _message({"type": "websocket.receive", "bytes": content}) is None
    recorder.handle([None])
    assert recorder.messages[0]["kind"] == "error"


def test_pixels_in_json_are_rejected(recorder):
    state = recorder.do(do="frame", pixels=[[1]], is_first=True, id=1)

    assert "frame" in state["errors"]
    assert state["film"] is None


# -- comparison -------------------------------------------------------------------------------------------------------------


def table(recorder):
    for header, _ in recorder.parts:
        if header["part"] == "comparison":
            return {row["name"]: row["values"] for row in header["about"]["rows"]}
    return None


def test_comparison_has_closed_form_budgets(recorder):
    recorder.do(do="freeze", id=1)
    recorder.do(do="set", key="sensor.bits", value=8, id=2)
    recorder.do(do="set", key="layout.parameters.n_x", value=32, id=3)
    found = table(recorder)

    assert found["n_sites"] == [224, 448]
    assert found["bits_per_frame"] == [2240, 3584]
    # B has one frame per exposure of 10 ms, 358,400 bit/s, and A as many bits per second.
    assert found["frames_per_s"] == pytest.approx([160.0, 100.0])
    assert found["area_mm2"] == pytest.approx([224 * 144e-6, 448 * 144e-6])
    assert found["readout_steps"] == [14, 14]
    # Of a site, whatever their number.
    assert found["read_noise_e"] == pytest.approx([2.0, 2.0])
    assert found["median_e"][1] == np.median(recorder.session.result.capture.electrons)


def test_match_solves_for_the_budget_of_a(recorder):
    recorder.do(do="freeze", id=1)
    recorder.do(do="set", key="layout.parameters", value={"n_x": 30, "n_y": 30, "pitch_um": 6.0}, id=2)
    state = recorder.do(do="match", what="n_sites", id=3)
    found = table(recorder)

    assert state["errors"] == {}
    assert found["n_sites"] == [224, 225]
    assert state["summary"]["width_um"] == pytest.approx(180.0)
    recorder.do(do="undo", id=4)
    assert table(recorder)["n_sites"] == [224, 900]
    recorder.do(do="unfreeze", id=5)
    assert table(recorder) is None
    assert "no variant A" in recorder.do(do="match", id=6)["errors"]["match"]


def comparison(recorder):
    return next(header["about"] for header, _ in recorder.parts if header["part"] == "comparison")


@pytest.mark.parametrize(
    ("generator", "parameters", "what"),
    [
        ("grid", {"n_x": 30, "n_y": 20, "pitch_um": 3.0}, "field"),
        ("grid", {"n_x": 30, "n_y": 20, "pitch_um": 3.0}, "both"),
        ("sunflower", {"n_sites": 300, "spacing_um": 5.0}, "field"),
        ("sunflower", {"n_sites": 300, "spacing_um": 5.0}, "both"),
        ("log_polar", {"n_sectors": 32, "min_size_um": 4.0, "r_max_um": 150.0}, "field"),
    ],
)
def test_match_gives_the_field_of_a(recorder, generator, parameters, what):
    """A is a grid of 16 x 14 sites of 12 µm; layouts that do not fill a rectangle are inscribed in it."""
    recorder.do(do="set", key="sensor.filters", value=None)
    recorder.do(do="freeze")
    recorder.do(do="set", key="layout", value={"generator": generator, "parameters": parameters})
    before = recorder.session.result.capture.layout.n_sites
    assert not comparison(recorder)["has_equal_fields"]
    state = recorder.do(do="match", **({"what": what} if what != "field" else {}))
    x0_um, y0_um, x1_um, y1_um = recorder.session.result.capture.layout.bounds_um

    assert state["errors"] == {}
    expected_um = (192.0, 168.0) if generator == "grid" else (168.0, 168.0)
    # Numbers of rows and rings are integers.
    assert (x1_um - x0_um, y1_um - y0_um) == pytest.approx(expected_um, rel=0.06)
    assert (x1_um - x0_um) <= expected_um[0] * (1.0 + 1e-9)
    assert state["summary"]["n_sites"] == pytest.approx(before if what == "field" else 224, rel=0.04)
    assert comparison(recorder)["has_equal_fields"] == (generator == "grid")


def test_match_gives_the_data_rate_of_a(recorder):
    recorder.do(do="freeze")
    recorder.do(do="set", key="sensor.bits", value=5)
    recorder.do(do="match", what="data_rate")

    # Twice as many sites of half the bits.
    assert table(recorder)["bits_per_frame"] == pytest.approx([2240, 2240], rel=0.05)


def test_better_values_are_marked(recorder):
    recorder.do(do="freeze")
    recorder.do(do="set", key="sensor.read_noise_e", value=30.0)
    best = {row["name"]: row["best"] for row in comparison(recorder)["rows"]}

    assert best["read_noise_e"] == [0]
    assert best["n_sites"] == best["area_mm2"] == best["readout_steps"] == []


def test_comparison_shows_saturation(recorder):
    recorder.do(do="freeze")
    recorder.do(do="set", key="exposure_s", value=10.0)
    code = recorder.session.result.capture.code

    assert table(recorder)["saturated_percent"][1] == 100.0 * np.mean(code == 1023) > 10.0


@pytest.mark.parametrize(
    ("generator", "parameters"),
    [
        ("hexagonal", {"n_columns": 20, "n_rows": 20, "pitch_um": 8.0}),
        ("octagonal", {"n_x": 20, "n_y": 20, "pitch_um": 8.0}),
        ("penrose", {"size_um": 200.0, "side_um": 12.0}),
        ("sunflower", {"n_sites": 500, "spacing_um": 8.0}),
        ("tiling", {"pitch_um": 8.0, "radius_um": 100.0}),
        ("log_polar", {"n_sectors": 20, "min_size_um": 4.0, "r_max_um": 150.0}),
    ],
)
def test_every_generator_can_match(settings, generator, parameters):
    engine = Engine(n_threads=1)
    settings["layout"] = {"generator": generator, "parameters": parameters}
    settings["sensor"].pop("filters")
    settings["scene"]["wavelength_nm"] = 550.0
    layout = engine.simulate(settings).capture.layout
    matched = with_n_sites(settings, 1000, layout)

    assert engine.simulate(matched).capture.layout.n_sites == pytest.approx(1000, rel=0.05)


def test_layout_files_cannot_match(settings):
    with pytest.raises(ParameterError, match="'layout' must have a generator"):
        with_n_sites({**settings, "layout": {"file": "chip.gds"}}, 100, None)


def test_finer_sites_have_better_pictures(settings):
    engine = Engine(n_threads=1)
    settings["scene"]["square_mm"] = 8.0
    coarse = engine.simulate(settings)
    settings["layout"]["parameters"] = {"n_x": 64, "n_y": 56, "pitch_um": 3.0}
    fine = engine.simulate(settings)
    found = {row["name"]: row["values"] for row in compare([("coarse", coarse), ("fine", fine)])["rows"]}

    for name in ("fovea_psnr_db", "field_psnr_db", "field_ssim"):
        assert found[name][1] > found[name][0]
    assert fovea_um(fine.capture.layout) == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("fit", ["cover", "contain"])
def test_comparison_is_independent_of_variant_order(settings, fit):
    engine = Engine(n_threads=1)
    settings["scene"] = {
        "kind": "picture",
        "picture": "skimage:astronaut",
        "fit": fit,
        "distance_m": 1.0,
        "illuminance_lux": 2000.0,
    }
    wide = engine.simulate(settings)
    settings["layout"]["parameters"] = {"n_x": 30, "n_y": 60, "pitch_um": 4.0}
    high = engine.simulate(settings)

    (first, second) = (
        {row["name"]: row["values"] for row in compare(order)["rows"]}
        for order in ([("wide", wide), ("high", high)], [("high", high), ("wide", wide)])
    )

    assert all(values[::-1] == second[name] for name, values in first.items())
    # Both see the same image: the field of the union is larger than that of each.
    assert wide.shot.camera.fit_scene(wide.shot.scene).pitch_um != high.shot.camera.fit_scene(high.shot.scene).pitch_um


# -- notebook, archive, links -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_notebook_gives_identical_codes(recorder, clip, tmp_path, monkeypatch):
    import matplotlib as mpl

    nbformat = pytest.importorskip("nbformat")
    mpl.use("Agg")
    opened(recorder, clip)
    recorder.do(do="frame", n=5, id=5)
    settings, files = recorder.session.exported()
    content = nbformat.reads(recorder.session.text("notebook"), as_version=4)
    nbformat.validate(content)
    monkeypatch.chdir(tmp_path)
    for name, path in files.items():
        (tmp_path / name).write_bytes(path.read_bytes())
    names = {}
    for cell in content.cells:
        if cell.cell_type == "code" and not cell.source.startswith("%"):
            exec(cell.source, names)

    assert settings["scene"]["picture"] == "clip_frame_5.png"
    assert "`clip_frame_5.png`" in content.cells[0].source
    assert np.array_equal(names["capture"].code, codes(recorder))


def test_notebook_without_files_names_none(settings):
    first = json.loads(notebook(settings, "small", []))["cells"][0]

    assert "Required" not in first["source"]


@pytest.mark.slow
def test_archive_runs_unchanged(recorder, tmp_path):
    path = recorder.session.add_file("photo.png", png(pixels(8)))
    recorder.do(do="file", path=str(path), **{"as": "scene"}, id=1)
    content, name = _exported(recorder.session, "zip")
    assert name == "small.zip"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert set(archive.namelist()) >= {"small.yaml", "small.py", "small.ipynb", "photo.png"}
        assert any(each.startswith("small_layout.") for each in archive.namelist())
        archive.extractall(tmp_path / "all")
    script = "import runpy, sys, numpy as np; np.save(sys.argv[2], runpy.run_path(sys.argv[1])['capture'].code)"
    subprocess.run([sys.executable, "-c", script, "small.py", "codes.npy"], check=True, cwd=tmp_path / "all")

    assert np.array_equal(run_settings(tmp_path / "all" / "small.yaml", tmp_path / "out"), codes(recorder))
    assert np.array_equal(np.load(tmp_path / "all" / "codes.npy"), codes(recorder))


def test_archive_contains_the_twin(recorder, tmp_path):
    """Its settings have names of files next to them."""
    small_twin().save(tmp_path / "twin.npz")
    path = recorder.session.add_file("twin.npz", (tmp_path / "twin.npz").read_bytes())
    recorder.do(do="file", path=str(path), id=1)
    content, _ = _exported(recorder.session, "zip")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path / "all")
    found = yaml.safe_load((tmp_path / "all" / "small.yaml").read_text())

    assert found["sensor"]["twin"] == "twin.npz"
    assert (tmp_path / "all" / "twin.npz").read_bytes() == (tmp_path / "twin.npz").read_bytes()
    assert np.array_equal(run_settings(tmp_path / "all" / "small.yaml", tmp_path / "out"), codes(recorder))


def test_link_has_names_of_uploads(recorder, make_session):
    path = recorder.session.add_file("photo.png", png(pixels(8)))
    recorder.do(do="file", path=str(path), **{"as": "scene"}, id=1)
    recorder.do(do="text", what="link", id=2)
    answer = next(each for each in recorder.messages if each["kind"] == "text")
    restored = json.loads(answer["text"])

    assert answer["files"] == ["photo.png"]
    assert str(recorder.session.uploads) not in answer["text"]
    other = make_session()
    state = other.do(do="restore", settings=restored, id=1)
    assert "'photo.png' is not available here; upload the file" in state["errors"]["restore"]
    assert state["settings"] == yaml.safe_load(yaml.safe_dump(other.session.start.settings))
    other.session.add_file("photo.png", png(pixels(8)))
    assert other.do(do="restore", settings=restored, id=2)["errors"] == {}
    assert np.array_equal(codes(other), codes(recorder))
