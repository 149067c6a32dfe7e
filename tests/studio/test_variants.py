"""Named variants in sessions without a thread: files, notes, comparison."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from foveasim.cli import app
from foveasim.config import build_shot

HEXAGONS = {
    "generator": "hexagonal",
    "parameters": {"n_columns": 14, "n_rows": 16, "pitch_um": 12.0},
    "mosaic": ["RG", "GB"],
}


def keep(recorder, name, note=""):
    return recorder.do(do="variant", action="keep", name=name, note=note)


def named(state):
    return [each["name"] for each in state["variants"]]


def rows(recorder):
    for header, _ in recorder.parts:
        if header["part"] == "comparison":
            about = header["about"]
            return about["names"], {row["name"]: row["values"] for row in about["rows"]}
    return None


def codes_of(settings):
    shot = build_shot(None, settings)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code


def test_variant_is_applied_as_one_step(make_session):
    recorder = make_session()
    keep(recorder, "short")
    recorder.do(do="set", key="exposure_s", value=0.5, final=True)
    recorder.do(do="set", key="sensor.bits", value=8, final=True)
    state = recorder.do(do="apply", variant="short")

    assert state["errors"] == {}
    assert (state["settings"]["exposure_s"], state["settings"]["sensor"]["bits"]) == (0.01, 10)
    assert recorder.do(do="undo")["settings"]["sensor"]["bits"] == 8
    assert "one of the session" in recorder.do(do="apply", variant="../shot")["errors"]["apply"]


def test_variants_survive_a_restart(make_session, tmp_path):
    recorder = make_session(out=tmp_path)
    photo = recorder.session.add_file("photo.png", _png())
    recorder.do(do="file", path=str(photo), **{"as": "scene"})
    keep(recorder, "Höhe 8 µm", "two lines:\nthe second")
    before = recorder.session.result.capture.code
    recorder.session.close()
    again = make_session(out=tmp_path)
    state = again.do(do="apply", variant="Höhe_8_µm")

    assert [(each["name"], each["note"]) for each in state["variants"]] == [("Höhe 8 µm", "two lines:\nthe second")]
    assert state["errors"] == {}
    assert np.array_equal(again.session.result.capture.code, before)
    # Not the file of the earlier session, which is deleted.
    assert state["settings"]["scene"]["picture"] == str(tmp_path / "variants" / "photo.png")
    assert again.session.exported()[0]["scene"]["picture"] == "photo.png"


def test_command_simulates_files_of_variants(make_session, tmp_path):
    recorder = make_session(out=tmp_path)
    recorder.do(do="set", key="layout", value=HEXAGONS, final=True)
    keep(recorder, "hexagons")
    path = tmp_path / "variants" / "hexagons.yaml"
    done = CliRunner().invoke(app, ["run", str(path), "--out", str(tmp_path / "results")])

    assert done.exit_code == 0, done.output
    with np.load(next((tmp_path / "results").glob("*.npz"))) as results:
        assert np.array_equal(results["code"], recorder.session.result.capture.code)


def test_names_and_notes_are_changed(make_session, tmp_path):
    recorder = make_session(out=tmp_path)
    keep(recorder, "one")
    path = tmp_path / "variants" / "one.yaml"
    settings = yaml.safe_load(path.read_text())
    state = recorder.do(do="variant", action="describe", variant="one", name="# uno: {", note="why\n\nnot")

    assert [(each["id"], each["name"], each["note"]) for each in state["variants"]] == [
        ("one", "# uno: {", "why\n\nnot")
    ]
    assert yaml.safe_load(path.read_text()) == settings
    recorder.do(do="set", key="exposure_s", value=0.25, final=True)
    state = recorder.do(do="variant", action="update", variant="one")
    assert state["variants"][0]["note"] == "why\n\nnot"
    assert yaml.safe_load(path.read_text()) == {**settings, "exposure_s": 0.25}


def test_equal_names_have_different_files(make_session):
    recorder = make_session()
    keep(recorder, "variant 10")
    keep(recorder, "variant 2")
    state = keep(recorder, "variant 2")

    assert [each["id"] for each in state["variants"]] == ["variant_2", "variant_2_2", "variant_10"]
    assert named(state) == ["variant 2", "variant 2", "variant 10"]


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"action": "keep", "name": "  "}, "'name' must have 1 to 80 characters"),
        ({"action": "keep", "name": "x" * 81}, "'name' must have 1 to 80 characters"),
        ({"action": "keep", "name": "x", "note": 3}, "'note' must be a string, got 3"),
        ({"action": "delete", "variant": "../shot"}, "'variant' must be one of the session, got '../shot'"),
        ({"action": "burn"}, "'action' must be keep, update, describe or delete, got 'burn'"),
    ],
)
def test_invalid_messages_have_one_line(make_session, message, text):
    recorder = make_session()
    recorder.do(do="variant", id=7, **message)

    assert [each["text"] for each in recorder.messages if each["kind"] == "error"] == [text]


def test_three_variants_are_compared(make_session):
    recorder = make_session()
    keep(recorder, "squares")
    recorder.do(do="set", key="layout", value=HEXAGONS, final=True)
    keep(recorder, "hexagons")
    recorder.do(do="set", key="layout.parameters.n_rows", value=8, final=True)
    recorder.do(do="views", names=["comparison"])
    recorder.do(do="freeze")
    state = recorder.do(do="compare", variants=["squares", "hexagons"])
    names, found = rows(recorder)

    assert names == ["A", "squares", "hexagons", "B"]
    assert found["n_sites"] == [112, 224, 224, 112]
    # At the highest data rate: 224 sites of 10 bits in 10 ms.
    assert found["frames_per_s"] == pytest.approx([200.0, 100.0, 100.0, 200.0])
    assert found["area_mm2"][1] == pytest.approx(224 * 144e-6)
    assert [each["is_compared"] for each in state["variants"]] == [True, True]


def test_update_changes_the_comparison(make_session):
    recorder = make_session()
    keep(recorder, "bits")
    recorder.do(do="views", names=["comparison"])
    recorder.do(do="compare", variants=["bits"])
    assert rows(recorder)[1]["bits_per_frame"] == [2240, 2240]
    recorder.do(do="set", key="sensor.bits", value=8, final=True)
    recorder.do(do="variant", action="update", variant="bits")

    assert rows(recorder)[1]["bits_per_frame"] == [1792, 1792]
    recorder.do(do="variant", action="delete", variant="bits")
    assert rows(recorder) is None
    recorder.do(do="set", key="sensor.bits", value=9, final=True)
    assert rows(recorder) is None


def test_variant_that_fails_has_a_reason(make_session, tmp_path):
    recorder = make_session(out=tmp_path)
    keep(recorder, "good")
    (tmp_path / "variants" / "bad.yaml").write_text("scene: [1, 2")
    state = recorder.do(do="compare", variants=["bad", "good"])

    assert {each["id"]: (each["is_compared"], each["problem"]) for each in state["variants"]}["good"] == (True, None)
    problem = {each["id"]: each["problem"] for each in state["variants"]}["bad"]
    assert "bad.yaml:1:13: is not YAML" in problem


def test_variant_is_shown_as_a(make_session):
    recorder = make_session()
    keep(recorder, "first")
    first = recorder.session.result.capture.code
    recorder.do(do="set", key="layout", value=HEXAGONS, final=True)
    state = recorder.do(do="freeze", variant="first", id=5)
    sent = [
        (header["part"], header["version"], arrays) for header, arrays in recorder.parts if header["part"] == "columns"
    ]
    kinds = [(each["is_freeze"], each["is_followed"]) for each in recorder.messages if each["kind"] == "done"]

    assert kinds == [(True, True), (False, False)]
    # The page keeps the first ones as A, and shows the second ones.
    assert [np.array_equal(next(iter(arrays.values())), first) for _, _, arrays in sent] == [True, False]
    assert sent[0][1] < sent[1][1]
    assert state["frozen"]["summary"]["n_sites"] == 224
    assert state["settings"]["layout"]["generator"] == "hexagonal"
    assert np.array_equal(recorder.session.result.capture.code, codes_of(state["settings"]))


def test_pictures_of_deleted_variants_are_deleted(make_session, tmp_path):
    recorder = make_session(out=tmp_path)
    photo = recorder.session.add_file("photo.png", _png())
    recorder.do(do="file", path=str(photo), **{"as": "scene"})
    keep(recorder, "one")
    keep(recorder, "two")
    recorder.do(do="variant", action="delete", variant="one")
    assert (tmp_path / "variants" / "photo.png").exists()
    recorder.do(do="variant", action="delete", variant="two")

    assert list((tmp_path / "variants").iterdir()) == []


def test_duplicated_session_has_the_variants(make_session):
    from foveasim.studio._session import Session

    recorder = make_session()
    keep(recorder, "mine")
    other = Session("other", recorder.session.start, n_threads=1, origin=recorder.session)
    try:
        recorder.do(do="variant", action="delete", variant="mine")
        assert [each.name for each in other.variants] == ["mine"]
    finally:
        other.close()


def _png():
    import io

    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (40, 48, 3), np.uint8)).save(file, "PNG")
    return file.getvalue()
