"""Messages of a page: each changes the state as specified, and invalid ones give one line."""

from __future__ import annotations

import copy
import gc
import json
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from studio.conftest import ALL_VIEWS
from typer.testing import CliRunner
from waiting import DEADLINE_S, wait_until

import foveasim as fs
from foveasim._io.images import write_picture
from foveasim.cli import app
from foveasim.config import build_shot, read_settings
from foveasim.sensor import PRESETS
from foveasim.studio import _queue, _session, _views
from foveasim.studio._files import start_settings
from foveasim.studio._messages.encoding import decode_part
from foveasim.studio._session import Session, Start

LINE = 600


def codes_of(settings):
    shot = build_shot(None, settings)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code


def code_part(recorder):
    header, arrays = next(part for part in recorder.parts if part[0]["part"] == "columns")
    column = next(column for column in header["about"]["columns"] if column["key"] == "code")
    return arrays[column["array"]]


@ALL_VIEWS
def test_first_connection_receives_all_parts(recorder):
    assert recorder.part_names[:2] == ["sites", "columns"]
    parts = _session.PARTS.values()
    first = {
        part.name for part in parts if part.has_data and not (part.is_lazy or part.is_costly or part.is_of_variants)
    }
    assert set(recorder.part_names) == first
    assert not first & {"solid", "comparison"}
    kinds = [message["kind"] for message in recorder.messages if message["kind"] != "progress"]
    assert kinds == ["busy", "controls", "gaze_path", "state", "done"]
    assert {header["version"] for header, _ in recorder.parts} == {1}


def test_set_simulates_new_value(recorder, settings):
    state = recorder.do(do="set", key="exposure_s", value=0.02, final=True, id=7)

    assert (state["id"], state["changed"], state["can_undo"], state["errors"]) == (7, ["exposure_s"], True, {})
    assert state["summary"]["exposure_s"] == 0.02
    assert np.array_equal(code_part(recorder), codes_of({**settings, "exposure_s": 0.02}))


def test_integers_keep_the_controls(recorder):
    for value in (3.9, 4, 4.1):
        recorder.do(do="set", key="optics.f_number", value=value, final=False)

        assert "controls" not in [message["kind"] for message in recorder.messages], value


def test_only_changed_parts_are_sent(recorder):
    bundled = ["sites", "columns", "picture", "scene", "noise", "spectrum", "photon_transfer", "snr", "mtf", "rules"]
    recorder.do(do="views", names=bundled)
    recorder.do(do="set", key="exposure_s", value=0.02, final=True)
    assert set(recorder.part_names) == {"columns", "noise", "photon_transfer", "picture", "snr"}
    recorder.do(do="set", key="optics.f_number", value=4.0, final=True)
    assert set(recorder.part_names) == {"columns", "noise", "photon_transfer", "snr", "mtf", "picture", "scene"}
    recorder.do(do="set", key="layout.parameters.pitch_um", value=13.0, final=True)
    assert {"sites", "rules"} <= set(recorder.part_names)
    recorder.do(do="set", key="layout.parameters.pitch_um", value=13.0, final=True)
    assert recorder.part_names == []


def test_only_selected_views_are_computed(recorder):
    recorder.do(do="views", names=["picture"])
    recorder.do(do="set", key="exposure_s", value=0.02, final=True)
    assert recorder.part_names == ["picture"]
    recorder.do(do="views", names=["columns", "picture"])
    assert recorder.part_names == ["columns"]


@pytest.mark.slow
def test_hidden_views_retain_no_results(recorder):
    recorder.do(do="views", names=["picture"])
    earlier = weakref.ref(recorder.session.result.capture)
    recorder.do(do="set", key="optics.f_number", value=4.0, final=True)
    gc.collect()

    assert earlier() is None
    recorder.do(do="views", names=list(_session.PARTS))
    assert {"columns", "noise", "scene"} <= set(recorder.part_names)


def test_pictures_have_the_requested_size(recorder):
    for pixels in (64, 200):
        recorder.do(do="views", names=["picture", "scene"], pixels=pixels)

        assert set(recorder.part_names) <= {"picture", "scene"}
        about = next(header["about"] for header, _ in recorder.parts if header["part"] == "picture")
        assert max(about["width"], about["height"]) == pixels
    recorder.do(do="views", names=["picture", "scene"], pixels=200)
    assert recorder.part_names == []
    for pixels in (0, 10**9, 1.5, "many", True):
        recorder.do(do="views", names=["picture"], pixels=pixels)
        assert "pixels" in recorder.messages[0]["text"]


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("optics.f_number", -1.0, "must be > 0"),
        ("optics.f_number", "wide", "must be a valid number"),
        ("optics.f_number", 10**400, "f_number"),
        ("optics.f_number", [1, 2], "must be a valid number"),
        ("optics.f_nmber", 2.8, "unknown parameter"),
        ("sensor.bits", 99, "bits"),
        ("layout.generator", "grrid", "must be one of"),
        ("exposure_s", None, "exposure_s"),
        ("layout.parameters.n_x", 10**9, "must be <="),
        ("exposure_s.value", 1, "must be a section"),
        ("scene.kind", "flat", "square_mm"),
        ("nothing", 1, "unknown key"),
        ("", 1, "path of a setting"),
        ("a..b", 1, "path of a setting"),
        ("optics", 5, "optics"),
    ],
)
def test_invalid_values_keep_last_state(recorder, settings, key, value, text):
    state = recorder.do(do="set", key=key, value=value, final=True, id=3)

    line = state["errors"][key]
    assert text in line
    assert "\n" not in line
    assert len(line) < LINE
    assert (state["id"], state["settings"], state["can_undo"], recorder.parts) == (3, settings, False, [])


def test_errors_disappear_with_valid_change(recorder):
    recorder.do(do="set", key="optics.f_number", value=-1.0, final=True)

    assert recorder.do(do="set", key="optics.f_number", value=4.0, final=True)["errors"] == {}


@pytest.mark.slow(keep=6)
@pytest.mark.parametrize(
    "message",
    [
        None,
        5,
        [],
        {},
        {"do": None},
        {"do": ["set"]},
        {"do": "explode"},
        {"do": "text", "what": "word"},
        {"do": "text"},
        {"do": "views", "names": ["nothing"]},
        {"do": "views", "names": 3},
        {"do": "views", "names": [["sites"]]},
        {"do": "save", "name": "a.yaml"},
    ],
)
def test_malformed_messages_give_one_line(recorder, message):
    recorder.handle([message])
    errors = [message for message in recorder.messages if message["kind"] == "error"]

    assert len(errors) == 1
    assert "\n" not in errors[0]["text"]
    assert recorder.do(do="set", key="seed", value=9, final=True)["errors"] == {}


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize(
    "message",
    [
        {"do": "set"},
        {"do": "set", "key": 5, "value": 1},
        {"do": "set", "key": "optics.f_number"},
        {"do": "reset", "key": {}},
        {"do": "delete"},
        {"do": "delete", "key": "optics"},
        {"do": "undo"},
        {"do": "redo"},
        {"do": "preset", "name": "shot:other"},
        {"do": "preset", "name": 5},
        {"do": "restore"},
        {"do": "restore", "settings": []},
        {"do": "restore", "settings": {}},
        {"do": "restore", "settings": {"scene": 1}},
        {"do": "file", "path": "/etc/passwd", "as": "settings"},
        {"do": "file", "path": "/etc/passwd", "as": "layout"},
        {"do": "file", "path": "/etc/passwd", "as": "scene"},
        {"do": "file", "path": "x", "as": "program"},
        {"do": "file"},
    ],
)
def test_malformed_changes_give_one_line(recorder, settings, message):
    state = recorder.do(**message)

    assert len(state["errors"]) == 1
    assert "\n" not in next(iter(state["errors"].values()))
    assert state["settings"] == settings


def test_deep_values_are_rejected(recorder, settings):
    value = 1
    for _ in range(50):
        value = [value]

    state = recorder.do(do="set", key="sensor.qe", value=value, final=True)

    assert "levels" in state["errors"]["sensor.qe"]
    assert state["settings"] == settings


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("scene", {"kind": "picture", "picture": "/etc/passwd", "fit": "cover", "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.02}),
        ("scene", {"kind": "cube", "path": "../../cube.hdr"}),
        ("layout", {"file": "/etc/passwd"}),
        ("layout", "/etc/passwd"),
        ("layout", "../layouts/x_trans.yaml"),
        ("layout.parameters", {"density": "/etc/passwd"}),
        ("sensor.qe", {"kind": "file", "path": "/etc/passwd"}),
        ("sensor.filters", {"path": "/proc/self/environ"}),
        ("sensor.datasheet", "/etc/passwd"),
        ("sensor.twin", "/etc/passwd"),
        ("optics.pupil", [{"kind": "image", "picture": "/etc/passwd"}]),
    ],
)  # fmt: skip
def test_other_files_are_rejected(recorder, settings, key, value):
    state = recorder.do(do="set", key=key, value=value, final=True)

    assert state["errors"]
    assert "not available" in state["errors"][key] or "preset" in state["errors"][key]
    assert state["settings"] == settings


def test_files_next_to_settings_are_accepted(tmp_path, settings, make_session):
    picture = tmp_path / "own.png"
    write_picture(picture, np.full((40, 40, 3), 128, np.uint8))
    outside = tmp_path.parent / f"{tmp_path.name}.png"
    outside.write_bytes(picture.read_bytes())
    (tmp_path / "link.png").symlink_to(outside)
    shot = tmp_path / "shot.yaml"
    scene = {"kind": "picture", "picture": "own.png", "fit": "cover", "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.02, "wavelength_nm": [620.0, 550.0, 450.0]}  # fmt: skip
    shot.write_text(yaml.safe_dump({**settings, "scene": scene}))
    start, name = start_settings(shot)
    recorder = make_session(start=start, directory=tmp_path)

    assert name == "shot"
    assert recorder.part_names[0] == "sites"
    assert recorder.do(do="set", key="scene.picture", value=str(picture), final=True)["errors"] == {}
    for path in (outside, tmp_path / "link.png"):
        assert "not available" in recorder.do(do="set", key="scene.picture", value=str(path))["errors"]["scene.picture"]


def test_layout_files_cannot_name_other_files(recorder):
    content = "generator: voronoi\nparameters: {n_sites: 10, size_um: [9.0, 9.0], density: /etc/passwd}\n"
    path = recorder.session.add_file("layout.yaml", content.encode())

    state = recorder.do(do="file", path=str(path), **{"as": "layout"})

    assert "'/etc/passwd' is not available" in state["errors"]["file"]


def test_uploaded_picture_becomes_scene(recorder, tmp_path):
    write_picture(tmp_path / "photo.png", np.full((30, 30, 3), 90, np.uint8))
    path = recorder.session.add_file("My photo.PNG", (tmp_path / "photo.png").read_bytes())

    state = recorder.do(do="file", path=str(path), **{"as": "scene"})

    assert path.name == "My_photo.png"
    assert state["errors"] == {}
    assert state["settings"]["scene"]["picture"] == str(path)
    assert "picture" in recorder.part_names


def test_corrupt_picture_keeps_last_scene(recorder, settings):
    path = recorder.session.add_file("photo.png", b"\x89PNG\r\n\x1a\n broken")

    state = recorder.do(do="file", path=str(path), **{"as": "scene"})

    assert len(state["errors"]) == 1
    assert state["settings"] == settings


def test_uploaded_layout_replaces_layout(recorder, tmp_path):
    fs.layout.mosaic(fs.layout.grid(9, 8, 10.0), ["RG", "GB"]).write(tmp_path / "sites.npz")
    path = recorder.session.add_file("sites.npz", (tmp_path / "sites.npz").read_bytes())

    state = recorder.do(do="file", path=str(path), **{"as": "layout"})

    assert state["errors"] == {}
    assert state["summary"]["n_sites"] == 72


def test_uploaded_settings_replace_all(recorder, settings):
    changed = {**settings, "exposure_s": 0.5}
    path = recorder.session.add_file("own.yaml", yaml.safe_dump(changed).encode())

    state = recorder.do(do="file", path=str(path), **{"as": "settings"})

    assert state["settings"] == changed


def test_undo_and_redo_restore_codes(recorder):
    codes = [recorder.session.result.capture.code]
    for k in range(5):
        recorder.do(do="set", key="seed", value=10 + k, final=True)
        codes.append(code_part(recorder))
    for k in range(4, -1, -1):
        recorder.do(do="undo")
        assert np.array_equal(code_part(recorder), codes[k])
    for k in range(1, 6):
        recorder.do(do="redo")
        assert np.array_equal(code_part(recorder), codes[k])


def test_drag_is_one_step(recorder, settings):
    for k in range(5):
        recorder.do(do="set", key="optics.f_number", value=3.0 + k / 10, final=False)
    recorder.do(do="set", key="optics.f_number", value=3.6, final=True)

    assert recorder.do(do="undo")["settings"] == settings


def test_waiting_previews_are_simulated_once(recorder):
    built = recorder.session.engine.n_built["optics"]
    state = recorder.handle(
        [{"do": "set", "key": "optics.f_number", "value": 3.0 + k / 10, "final": k == 9, "id": k} for k in range(10)]
    )

    assert recorder.session.engine.n_built["optics"] == built + 1
    assert (state["id"], state["settings"]["optics"]["f_number"]) == (9, 3.9)


def test_invalid_change_leaves_others_of_batch(recorder):
    recorder.handle(
        [
            {"do": "set", "key": "exposure_s", "value": 0.02, "final": True, "id": 1},
            {"do": "set", "key": "optics.f_number", "value": -2, "final": True, "id": 2},
            {"do": "set", "key": "sensor.bits", "value": 8, "final": True, "id": 3},
        ]
    )
    states = [message for message in recorder.messages if message["kind"] == "state"]

    assert [list(state["errors"]) for state in states] == [[], ["optics.f_number"], []]
    assert states[-1]["settings"]["exposure_s"] == 0.02
    assert states[-1]["settings"]["sensor"]["bits"] == 8


def test_reset_restores_start_value(recorder, settings):
    recorder.do(do="set", key="optics.f_number", value=4.0, final=True)
    recorder.do(do="set", key="sensor.prnu_fraction", value=0.01, final=True)
    recorder.do(do="reset", key="optics.f_number")
    state = recorder.do(do="reset", key="sensor.prnu_fraction")

    assert state["settings"] == settings
    assert state["changed"] == []


def test_delete_removes_optional_value(recorder):
    state = recorder.do(do="delete", key="layout.rules")

    assert "rules" not in state["settings"]["layout"]
    assert state["errors"] == {}


@pytest.mark.parametrize("name", ["layout:prima_75", "layout:giotto_1", "layout:x_trans", "shot:four_zones"])
def test_presets_give_valid_states(recorder, name):
    state = recorder.do(do="preset", name=name)

    assert state["errors"] == {}
    assert state["summary"]["n_sites"] > 100


def test_electronics_are_replaced_by_a_preset(recorder):
    recorder.do(do="set", key="sensor.read_noise_e", value=50.0, final=True)
    for name, bits in (("mobile", 10), ("scientific", 16), ("paper_foveal", 8)):
        sensor = recorder.do(do="set", key="sensor.preset", value=name, final=True)["settings"]["sensor"]
        assert sensor["bits"] == bits
        assert {key: sensor[key] for key in PRESETS[name].settings()} == PRESETS[name].settings()
        assert sensor["filters"] == "rgb"
    assert "pedestal_v" not in sensor  # of the preset before


def test_quantum_efficiency_remains_without_another(recorder):
    """That of a preset without one; the data sheet of the IMX273 has 64 %."""
    qe = {"kind": "silicon", "depth_um": 4.0}
    recorder.do(do="set", key="sensor.qe", value=qe, final=True)
    found = [
        recorder.do(do="set", key="sensor.preset", value=name, final=True)["settings"]["sensor"]["qe"]
        for name in ("mobile", "imx273")
    ]

    assert found == [qe, 0.64]


def test_restored_settings_give_same_codes(recorder, make_session):
    recorder.do(do="set", key="optics.f_number", value=22.5, final=True)
    recorder.do(do="set", key="optics.focus_distance_m", value=".inf", final=True)
    state = recorder.do(do="set", key="seed", value=5, final=True)
    expected = code_part(recorder)
    other = make_session()

    restored = other.do(do="restore", settings=json.loads(json.dumps(state["settings"])))

    assert restored["settings"] == state["settings"]
    assert np.array_equal(code_part(other), expected)


@pytest.mark.slow
def test_alternatives_from_page_are_valid(recorder):
    controls = next(message for message in recorder.messages if message["kind"] == "controls")["controls"]
    control = next(control for control in controls if control["id"] == "layout")
    for label in ("hexagonal", "sunflower", "log polar", "zones", "bundled: prima 75"):
        value = next(choice["value"] for choice in control["choices"] if choice["label"] == label)
        state = recorder.do(do="set", key="layout", value=value, final=True)

        assert state["errors"] == {}, label


def fail(*_):
    raise RuntimeError("two\nlines")


@ALL_VIEWS
@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"make": fail}, "RuntimeError: two lines"),
        ({"make": lambda _: ({"n": object()}, {})}, "TypeError: Object of type object is not JSON serializable"),
        ({"make": lambda _: ({}, {"x": np.zeros(3, complex)})}, "'arrays' must be one of uint8"),
        ({"make": lambda _: None}, "TypeError: cannot unpack"),
        ({"depends": fail}, "RuntimeError: two lines"),
        ({"depends": lambda result: result}, "TypeError: 'Simulated' object is not iterable"),
    ],
    ids=["exception", "object", "complex", "nothing", "dependencies", "no tuple"],
)
def test_failing_view_leaves_others(recorder, monkeypatch, wrong, text):
    recorder.do(do="set", key="exposure_s", value=0.03, final=True)
    names = set(recorder.part_names)
    monkeypatch.setitem(_session.PARTS, "noise", replace(_session.PARTS["noise"], **wrong))
    recorder.do(do="set", key="exposure_s", value=0.02, final=True)

    assert set(recorder.part_names) == names - {"noise"}
    (error,) = [message for message in recorder.messages if message["kind"] == "error"]
    assert error["part"] == "noise"
    assert error["text"].startswith(f"Noise: {text}")
    assert recorder.messages[-1]["kind"] == "done"


def test_freeze_keeps_summary(recorder):
    frozen = recorder.do(do="freeze")["frozen"]
    state = recorder.do(do="set", key="exposure_s", value=0.02, final=True)

    assert state["frozen"] == frozen
    assert (frozen["summary"]["exposure_s"], state["summary"]["exposure_s"]) == (0.01, 0.02)
    assert recorder.do(do="unfreeze")["frozen"] is None


def text_of(recorder, what):
    recorder.do(do="text", what=what, id=1)
    return next(message["text"] for message in recorder.messages if message["kind"] == "text")


def test_texts_describe_current_settings(recorder, settings):
    recorder.do(do="set", key="optics.f_number", value=4.0, final=True)
    names = {}
    exec(text_of(recorder, "python"), names)

    assert yaml.safe_load(text_of(recorder, "yaml"))["optics"]["f_number"] == 4.0
    assert "-optics: {focal_length_mm: 8.0, f_number: 2.8}" in text_of(recorder, "diff")
    assert np.array_equal(names["capture"].code, recorder.session.result.capture.code)


@pytest.mark.slow
def test_saved_settings_give_same_codes(make_session, tmp_path):
    out = tmp_path / "out"
    recorder = make_session(out=out)
    write_picture(tmp_path / "photo.png", np.random.default_rng(1).integers(0, 255, (40, 40, 3)).astype(np.uint8))
    path = recorder.session.add_file("photo.png", (tmp_path / "photo.png").read_bytes())
    recorder.do(do="file", path=str(path), **{"as": "scene"})
    recorder.do(do="set", key="optics.f_number", value=3.7, final=True)
    recorder.do(do="save", name="../../my shot", id=1)
    saved = out / "my_shot.yaml"

    assert sorted(each.name for each in out.iterdir()) == ["my_shot.yaml", "photo.png"]
    assert read_settings(saved)["scene"]["picture"] == "photo.png"
    result = CliRunner().invoke(app, ["run", str(saved), "--out", str(tmp_path / "run")])
    assert result.exit_code == 0
    codes = fs.Capture.load(tmp_path / "run" / "my_shot_capture.npz").code
    assert np.array_equal(codes, recorder.session.result.capture.code)


def test_save_keeps_pictures_of_earlier_saves(make_session, tmp_path):
    out = tmp_path / "out"
    codes = {}
    for n, name in enumerate(("first", "second", "again")):
        recorder = make_session(out=out)
        pixels = np.random.default_rng(min(n, 1)).integers(0, 255, (40, 40, 3)).astype(np.uint8)
        write_picture(tmp_path / "photo.png", pixels)
        path = recorder.session.add_file("photo.png", (tmp_path / "photo.png").read_bytes())
        recorder.do(do="file", path=str(path), **{"as": "scene"})
        recorder.do(do="save", name=name)
        codes[name] = recorder.session.result.capture.code

    assert {each.name for each in out.glob("*.png")} == {"photo.png", "photo_2.png"}
    for name, expected in codes.items():
        assert np.array_equal(codes_of(start_settings(out / f"{name}.yaml")[0]), expected)


def test_saved_pictures_never_share_a_name(make_session, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    recorder = make_session(out=out)
    pixels = np.random.default_rng(1).integers(0, 255, (3, 40, 40, 3)).astype(np.uint8)
    write_picture(out / "photo.png", pixels[0])
    files = {}
    for name, each in zip(("photo.png", "photo_2.png"), pixels[1:], strict=True):
        write_picture(tmp_path / name, each)
        files[name] = recorder.session.add_file(name, (tmp_path / name).read_bytes())
    # The picture of the scene becomes photo_2.png, which is the name of the other.
    recorder.do(do="file", path=str(files["photo.png"]), **{"as": "scene"})
    settings = recorder.session.history.settings
    layout = {"generator": "voronoi", "parameters": {"density": str(files["photo_2.png"])}}
    recorder.session.history.commit({**settings, "layout": layout})
    recorder.do(do="save", name="both")
    saved = read_settings(out / "both.yaml")

    assert (out / saved["scene"]["picture"]).read_bytes() == files["photo.png"].read_bytes()
    assert (out / saved["layout"]["parameters"]["density"]).read_bytes() == files["photo_2.png"].read_bytes()
    assert (out / "photo.png").read_bytes() not in {path.read_bytes() for path in files.values()}


@pytest.mark.parametrize("name", ["lines.yaml", "LINES.yaml"])
def test_saved_settings_replace_no_upload(make_session, name, tmp_path):
    """Also where the file system ignores the case of letters."""
    recorder = make_session(out=tmp_path / "out")
    path = recorder.session.add_file("lines.yaml", b"generator: grid\n")
    recorder.session.history.commit({**recorder.session.history.settings, "layout": {"file": str(path)}})
    recorder.do(do="save", name=name)
    saved = read_settings(tmp_path / "out" / name)

    assert saved["layout"]["file"] == "lines_2.yaml"
    assert (tmp_path / "out" / "lines_2.yaml").read_bytes() == path.read_bytes()


def test_failed_upload_returns_its_bytes(recorder, monkeypatch):
    def fail(path, content):
        raise OSError(28, "No space left on device")

    n_free_bytes = recorder.session.n_free_bytes
    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space left"):
        recorder.session.add_file("a.bin", bytes(300))

    assert recorder.session.n_free_bytes == n_free_bytes
    assert not list(recorder.session.uploads.iterdir())


def groups_of(recorder):
    return [(header["part"], header.get("has_more", False)) for header, _ in recorder.parts]


@ALL_VIEWS
def test_fast_parts_are_shown_in_one_frame(recorder, monkeypatch):
    monkeypatch.setattr(_views, "TOGETHER_S", 60.0)
    monkeypatch.setattr(_views, "SOON_S", 60.0)
    recorder.do(do="set", key="layout.parameters.pitch_um", value=13.0, final=True)
    groups = groups_of(recorder)

    # The message "done" ends the group.
    assert [name for name, _ in groups[:2]] == ["sites", "columns"]
    assert len(groups) > 4
    assert all(has_more for _, has_more in groups)
    assert recorder.messages[-1]["kind"] == "done"


@ALL_VIEWS
def test_sites_are_shown_before_slow_parts(recorder, monkeypatch):
    monkeypatch.setattr(_views, "TOGETHER_S", 60.0)
    key = "layout.parameters.pitch_um"
    recorder.do(do="set", key=key, value=13.0, final=True)
    recorder.session.costs.add_part(key, "picture", 0.5)
    recorder.do(do="set", key=key, value=14.0, final=True)
    groups = groups_of(recorder)

    assert groups[:2] == [("sites", True), ("columns", False)]
    assert all(has_more for _, has_more in groups[2:])


@ALL_VIEWS
def test_late_parts_are_shown_at_once(recorder, monkeypatch):
    monkeypatch.setattr(_views, "TOGETHER_S", 0.0)
    recorder.do(do="set", key="optics.f_number", value=4.0, final=True)

    assert not any(has_more for _, has_more in groups_of(recorder))


def test_uploads_never_share_a_path(recorder):
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda n: recorder.session.add_file("a.bin", b"%d" % n), range(40)))

    assert sorted(path.read_bytes() for path in paths) == sorted(b"%d" % n for n in range(40))


def test_uploads_never_exceed_the_limit(recorder):
    recorder.session.n_free_bytes = 1000
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda n: recorder.session.add_file("a.bin", bytes([n]) * 300), range(20)))

    assert sum(path is not None for path in paths) == 3


def test_frozen_variant_is_sent_before_changes(recorder):
    recorder.handle([
        {"do": "set", "key": "exposure_s", "value": 0.02, "final": True, "id": 1},
        {"do": "freeze", "id": 2},
        {"do": "set", "key": "exposure_s", "value": 0.005, "final": True, "id": 3},
    ])  # fmt: skip
    done = [message["id"] for message in recorder.messages if message["kind"] == "done"]
    columns = [arrays for header, arrays in recorder.parts if header["part"] == "columns"]
    frozen = [message["frozen"] for message in recorder.messages if message["kind"] == "state"][-1]

    assert done == [2, 3]
    assert len(columns) == 2
    assert frozen["summary"]["exposure_s"] == 0.02


def test_comparison_without_exposure_has_no_rate(recorder):
    recorder.do(do="set", key="exposure_s", value=0.0, final=True)
    recorder.do(do="views", names=["comparison"])
    recorder.do(do="freeze")
    about = next(header["about"] for header, _ in recorder.parts if header["part"] == "comparison")
    values = {row["name"]: row["values"] for row in about["rows"]}

    assert values["frames_per_s"] == [None, None]
    assert values["bits_per_frame"][0] > 0


def test_text_without_format_gives_one_line(recorder):
    recorder.do(do="text", id=4)

    assert [(m["id"], m["text"]) for m in recorder.messages if m["kind"] == "error"] == [(4, "'what' must be a string")]


def test_thread_survives_unexpected_exceptions(settings, monkeypatch):
    session = Session("threaded", Start(settings), n_threads=1)
    messages = []
    session.attach(messages.append)

    def kinds():
        return [json.loads(message)["kind"] for message in messages if isinstance(message, str)]

    try:
        wait_until(lambda: "done" in kinds())
        monkeypatch.setattr(_session, "summary_of", lambda _: 1 / 0)
        session.post({"do": "set", "key": "seed", "value": 2, "final": True})
        wait_until(lambda: "error" in kinds())
        monkeypatch.undo()
        messages.clear()
        session.post({"do": "set", "key": "seed", "value": 3, "final": True})
        wait_until(lambda: "done" in kinds())
        assert session.history.settings["seed"] == 3
    finally:
        session.close()
    wait_until(lambda: not session._thread.is_alive())
    assert not session.uploads.exists()
    assert threading.active_count() < 50


@pytest.mark.slow
def test_session_without_page_releases_its_results(settings, monkeypatch):
    monkeypatch.setattr(_session, "FORGET_S", 0.05)
    monkeypatch.setattr(_session, "RELEASE_S", 0.05)
    session, messages = Session("threaded", Start(settings), n_threads=1), []

    def is_done():
        return any(isinstance(message, str) and json.loads(message)["kind"] == "done" for message in messages)

    try:
        session.attach(messages.append)
        wait_until(is_done)
        session.post({"do": "freeze"})
        session.post({"do": "set", "key": "exposure_s", "value": 0.002, "final": True})
        wait_until(lambda: session.history.settings["exposure_s"] == 0.002 and session.result.shot.exposure_s == 0.002)
        code, frozen_code = session.result.capture.code, session.compared.frozen_result.capture.code
        assert not np.array_equal(code, frozen_code)
        session.post({"do": "variant", "action": "keep", "name": "one"})
        wait_until(lambda: list(session.variants))
        session.post({"do": "compare", "variants": [each.id for each in session.variants]})
        wait_until(lambda: session.compared.results)
        results = [
            session.result,
            session.compared.frozen_result,
            *(found for _, found in session.compared.results.values()),
        ]
        captures = [weakref.ref(each.capture) for each in results]
        del results
        # Its thread has nothing more to do.
        wait_until(lambda: session._idle_work() is None)
        assert session.result is not None
        session.detach(messages.append)
        wait_until(lambda: session.result is None and all(each() is None for each in captures))
        messages.clear()
        session.attach(messages.append)
        wait_until(is_done)
        assert np.array_equal(session.result.capture.code, code)
        assert np.array_equal(session.compared.frozen_result.capture.code, frozen_code)
    finally:
        session.close()


def test_signals_are_sent_when_requested(recorder):
    capture = recorder.session.result.capture
    names = ["sites", "columns"]
    recorder.do(do="views", names=names)
    recorder.do(do="set", key="exposure_s", value=0.02, final=True)
    about = next(header["about"] for header, _ in recorder.parts if header["part"] == "columns")
    keys = {column["key"] for column in about["columns"] if column.get("is_signal")}
    assert keys == {"electrons", "expected_e", "snr"}
    assert not any(column.get("array") for column in about["columns"] if column["key"] in keys)

    recorder.do(do="views", names=[*names, "signals"])
    capture = recorder.session.result.capture
    assert recorder.part_names == ["signals"]
    found = recorder.parts[0][1]
    assert np.array_equal(found["electrons"], capture.electrons)
    assert np.array_equal(found["expected_e"], capture.expected_e)
    assert found["snr"] == pytest.approx(capture.signal_to_noise(sensor=recorder.session.result.shot.camera.sensor))


def test_slow_views_wait_for_the_page(settings, monkeypatch):
    """Until the page has drawn the photosites, or a newer message waits."""
    monkeypatch.setattr(_views, "AWAITED_S", -1.0)
    monkeypatch.setattr(_queue, "DRAWN_S", DEADLINE_S)
    session, parts, waits = Session("threaded", Start(settings), n_threads=1), [], threading.Event()
    wait_for_page = session.views._wait_for_page
    session.views._wait_for_page = lambda: (waits.set(), wait_for_page())

    def listen(message):
        if isinstance(message, bytes):
            parts.append(decode_part(message)[0])

    def names():
        return [header["part"] for header in parts]

    try:
        session.attach(listen, answers=True)
        assert waits.wait(DEADLINE_S)
        assert names() == ["sites", "columns"]
        assert [header.get("is_awaited", False) for header in parts] == [False, True]
        session.post({"do": "drawn", "version": parts[-1]["version"]})
        wait_until(lambda: "picture" in names())
        parts.clear()
        waits.clear()
        session.post({"do": "set", "key": "exposure_s", "value": 0.02, "final": True})
        assert waits.wait(DEADLINE_S)
        assert "columns" in names()
        assert "picture" not in names()
        session.post({"do": "set", "key": "exposure_s", "value": 0.03, "final": True})
        wait_until(lambda: names().count("columns") == 2)
    finally:
        session.close()


def test_stages_of_short_changes_are_not_reported(recorder, monkeypatch):
    monkeypatch.setattr(_session, "PROGRESS_S", 60.0)
    recorder.do(do="set", key="exposure_s", value=0.02, final=True)
    assert "progress" not in [message["kind"] for message in recorder.messages]
    monkeypatch.setattr(_session, "PROGRESS_S", -1.0)
    recorder.do(do="set", key="exposure_s", value=0.03, final=True)

    assert "progress" in [message["kind"] for message in recorder.messages]


def test_failing_listener_leaves_others(recorder):
    def fail(_message):
        raise OSError

    recorder.session.attach(fail)
    assert recorder.do(do="set", key="seed", value=2, final=True)["errors"] == {}


def test_settings_are_not_shared(recorder, settings):
    before = copy.deepcopy(recorder.session.history.settings)
    recorder.do(do="set", key="layout.mosaic", value=["GR", "BG"], final=True)
    recorder.do(do="undo")

    assert recorder.session.history.settings == before == settings


def other_values(control):
    """Return values of a control that differ from the current one."""
    match control["kind"]:
        case "number" | "integer":
            low, high = control["suggested"]
            value = low + 0.3 * (high - low)
            return [round(value) if control["kind"] == "integer" else value]
        case "choice":
            # The PSF of a picture as pupil takes seconds.
            return [each["value"] for each in control["choices"] if "skimage:" not in str(each["value"])][-2:]
        case "boolean":
            return [not control.get("default", False)]
        case "list" if control.get("default"):
            return [[number + 2.5 for number in control["default"]]]
        case _:
            return []


@pytest.mark.nightly
def test_no_setting_leaves_stale_views(make_session, settings):
    lens = {"kind": "brown_conrady", "focal_um": 8000.0, "k1": -0.1, "centre_um": [1.0, 0.5]}
    settings = {**settings, "distortion": lens}
    recorder = make_session(start=settings)
    names = [name for name, part in _session.PARTS.items() if not part.is_costly]
    recorder.do(do="views", names=names)
    shown, stale, n_changes = {}, [], 0

    def receive():
        shown.update({header["part"]: (header["about"], arrays) for header, arrays in recorder.parts})

    def is_same(one, other):
        return one[0] == other[0] and all(np.array_equal(one[1][k], other[1][k], equal_nan=True) for k in other[1])

    recorder.do(do="refresh")
    receive()
    controls = [control for control in recorder.session.controls if other_values(control)]
    for control in controls:
        for value in other_values(control):
            state = recorder.do(do="set", key=control["key"], value=value, final=True)
            receive()
            if state["errors"]:
                continue
            n_changes += 1
            before = dict(shown)
            for name in set(names) - set(recorder.part_names):  # those sent are of the new state
                recorder.session.views.forget(name)
            recorder.do(do="views", names=names)
            receive()
            stale += [(control["key"], name) for name in shown if not is_same(before[name], shown[name])]
        assert recorder.do(do="restore", settings=settings)["errors"] == {}, control["key"]
        receive()

    assert stale == []
    assert n_changes > len(controls), (n_changes, len(controls))
