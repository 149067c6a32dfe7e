"""Sweeps of the studio, in sessions without a thread: points, interruptions, atomic changes and files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from studio.conftest import SETTINGS
from typer.testing import CliRunner
from waiting import wait_until

from foveasim import explore
from foveasim.cli import app
from foveasim.config import build_shot, put_setting
from foveasim.explore.sweeps.plan import copy_settings
from foveasim.studio._messages.models import SetValue, ShowFrame
from foveasim.studio._session import Session, Start

EXPOSURES = {"key": "exposure_s", "from": 0.001, "to": 0.1, "n": 3, "spacing": "geometric"}
F_NUMBERS = {"key": "optics.f_number", "from": 2, "to": 4, "n": 2}
CODE, RATE = {"measure": "mean_code_dn", "annulus_um": [0, 60]}, {"measure": "data_rate_gbit_per_s"}


def finish(recorder):
    """Compute the points that remain as the thread of a session does; return the last message."""
    session = recorder.session
    while session.sweeps.is_running:
        session.sweeps.compute_next(session.engine.simulate)
    return last(recorder)


def last(recorder):
    return [message for message in recorder.messages if message["kind"] == "sweep"][-1]


def run(recorder, settings, results, number=7):
    recorder.do(do="sweep", settings=settings, results=results, id=number)
    return finish(recorder)


def problem(recorder):
    (text,) = [message["text"] for message in recorder.messages if message["kind"] == "error"]
    assert "\n" not in text
    return text


def captured(settings):
    shot = build_shot(None, settings)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)


def central_code_dn(capture):
    centre_um = np.reshape(capture.layout.bounds_um, (2, 2)).mean(axis=0)
    return capture.code[np.hypot(*(capture.layout.centroid_um - centre_um).T) < 60.0].mean()


# -- points -----------------------------------------------------------------------------------------------------------------


def test_points_equal_captures_of_changed_shots(recorder):
    found = run(recorder, [EXPOSURES, F_NUMBERS], [CODE, RATE])
    expected = []
    for exposure_s in (0.001, 0.01, 0.1):
        for f_number in (2.0, 4.0):
            changed = copy_settings(SETTINGS)
            put_setting(None, changed, "exposure_s", exposure_s)
            put_setting(None, changed, "optics.f_number", f_number)
            expected.append([central_code_dn(captured(changed)), 224 * 10 / exposure_s * 1e-9])

    assert found["axes"][0]["values"] == [0.001, 0.01, 0.1]
    assert (found["state"], found["n_points"], found["n_failed"], found["problem"]) == ("done", 6, 0, "")
    np.testing.assert_array_equal(np.array(found["points"])[:, 0], np.array(expected)[:, 0])
    np.testing.assert_allclose(np.array(found["points"])[:, 1], np.array(expected)[:, 1], rtol=1e-12)
    assert found["start"]["settings"] == [0.01, 2.8]
    assert found["start"]["results"][0] == central_code_dn(captured(SETTINGS))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    "axis",
    [
        {"key": "layout.parameters.n_sites", "from": 60, "to": 300, "n": 3},
        {"key": "layout.parameters.n_x", "from": 7, "to": 10, "n": 9},
        {"key": "optics.f_number", "from": 2, "to": 11, "n": 4},
    ],
)
def test_points_equal_results_of_set_values(recorder, make_session, axis):
    """A number of photosites replaces numbers of columns and rows, also in points."""
    count = {"measure": "n_sites"}
    found = run(recorder, [axis], [CODE, count])
    for value, results in zip(found["axes"][0]["values"], found["points"], strict=True):
        other = make_session()
        state = other.do(do="set", key=axis["key"], value=value, id=1)
        assert state["errors"] == {}
        capture = other.session.result.capture
        assert results == [central_code_dn(capture), capture.layout.n_sites]
        assert (capture.code == captured(state["settings"]).code).all()


def test_points_of_signals_have_saturation(recorder):
    exposure = [{"key": "exposure_s", "from": 0.001, "to": 0.5, "n": 3, "spacing": "geometric"}]
    found = run(recorder, exposure, [{"measure": "snr"}])
    codes = [captured({**SETTINGS, "exposure_s": value}).code for value in found["axes"][0]["values"]]

    assert found["saturated"] == [float(np.mean(each == 1023)) for each in codes]
    assert found["saturated"][0] == 0.0 < found["saturated"][-1]
    assert run(recorder, exposure, [{"measure": "n_sites"}], number=8)["saturated"] is None


def test_integers_are_distinct(recorder):
    found = run(recorder, [{"key": "sensor.bits", "from": 8, "to": 10, "n": 9}], [CODE])
    assert found["axes"][0]["values"] == [8, 9, 10]
    assert all(type(value) is int for value in found["axes"][0]["values"])


def test_sweep_changes_no_settings(recorder):
    before, result = recorder.session.history.settings, recorder.session.result
    run(recorder, [EXPOSURES], [CODE])
    assert (recorder.session.history.settings, recorder.session.history.can_undo) == (before, False)
    assert recorder.session.result is result


def test_failed_points_have_a_reason(recorder):
    site = {"measure": "mean_code_dn", "site": 100}
    found = run(
        recorder, [{"key": "layout.parameters.n_x", "from": 4, "to": 16, "n": 4}], [site, {"measure": "n_sites"}]
    )

    assert [results[0] is None for results in found["points"]] == [True, False, False, False]
    assert [results[1] for results in found["points"]] == [56, 112, 168, 224]
    assert (found["state"], found["n_failed"]) == ("done", 1)
    assert found["problem"] == "mean code of photosite 100: the layout has only 56 photosites"


def test_simulation_errors_leave_other_points(recorder):
    """Photosites of 500 µm do not fit into a circle of 90 µm."""
    recorder.do(do="set", key="layout.rules", value=None, id=1)
    recorder.do(
        do="set", key="layout", value={"generator": "log_polar", "parameters": {"n_sectors": 16, "min_size_um": 8.0, "r_max_um": 90.0}}, id=2
    )  # fmt: skip
    found = run(
        recorder, [{"key": "layout.parameters.min_size_um", "from": 5, "to": 500, "n": 3}], [{"measure": "n_sites"}]
    )
    assert found["points"][0][0] > 0
    assert found["points"][-1] == [None]
    assert found["problem"]


def test_infinite_results_are_not_failures(recorder):
    """The ratio of a sensor without quantum efficiency, in dB."""
    found = run(recorder, [{"key": "sensor.qe", "from": 0.0, "to": 0.6, "n": 2}], [{"measure": "snr_db"}])
    assert found["points"][0] == ["-.inf"]
    assert found["n_failed"] == 0


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"settings": [EXPOSURES] * 3}, "'settings' must be a list of 1 to 2 mappings"),
        ({"settings": "x"}, "'settings' must be a list"),
        ({"settings": [EXPOSURES, EXPOSURES]}, "'settings' must differ"),
        ({"settings": [{**EXPOSURES, "key": "scene.kind"}]}, "must be the key of a number"),
        ({"settings": [{**EXPOSURES, "key": "seed"}]}, "must not contain the seed"),
        ({"settings": [{**EXPOSURES, "n": 1001}]}, "must give at most 1,000 points, got 1,001; use fewer values"),
        ({"settings": [{**EXPOSURES, "n": 1}]}, "'n' must be at least 2"),
        ({"settings": [{**EXPOSURES, "from": "x"}]}, "from"),
        ({"settings": [{**EXPOSURES, "to": 0.0001}]}, "'to' must be above the first value"),
        ({"settings": [{**EXPOSURES, "from": -1.0}]}, "geometric spacing"),
        ({"results": []}, "'results' must be a list of 1 to 2 mappings"),
        ({"results": [CODE, CODE]}, "'results' must differ"),
        ({"results": [{"measure": "srn"}]}, "did you mean 'snr'"),
        ({"results": [{**CODE, "at_least": 3.0}]}, "at_least"),
    ],
)
def test_wrong_sweeps_are_one_line(recorder, message, text):
    recorder.do(**{"do": "sweep", "settings": [EXPOSURES], "results": [CODE], "id": 1, **message})
    assert text in problem(recorder)
    assert not recorder.session.sweeps.is_running


# -- interruptions -----------------------------------------------------------------------------------------------------------


def test_stopped_sweep_keeps_its_points(recorder):
    recorder.do(do="sweep", settings=[EXPOSURES], results=[CODE], id=1)
    for _ in range(2):
        recorder.session.sweeps.compute_next(recorder.session.engine.simulate)
    recorder.do(do="stop_sweep", id=2)

    assert (last(recorder)["state"], len(last(recorder)["points"])) == ("stopped", 1)
    assert not recorder.session.sweeps.is_running


def test_later_changes_do_not_affect_a_sweep(recorder, make_session):
    expected = run(make_session(), [EXPOSURES, F_NUMBERS], [CODE])["points"]
    recorder.do(do="sweep", settings=[EXPOSURES, F_NUMBERS], results=[CODE], id=1)
    for k in range(3):
        recorder.session.sweeps.compute_next(recorder.session.engine.simulate)
        state = recorder.do(do="set", key="layout.parameters.n_x", value=8 + k, id=2 + k)
        assert state["settings"]["layout"]["parameters"]["n_x"] == 8 + k
    recorder.do(do="preset", name="shot:foveal", id=9)

    assert finish(recorder)["points"] == expected


def test_new_sweep_replaces_a_running_one(recorder):
    recorder.do(do="sweep", settings=[EXPOSURES], results=[CODE], id=1)
    recorder.session.sweeps.compute_next(recorder.session.engine.simulate)
    found = run(recorder, [F_NUMBERS], [RATE], number=2)
    assert (found["id"], found["n_points"], len(found["points"])) == (2, 2, 2)


def test_messages_interrupt_a_point(recorder):
    """The point is repeated after the message; frames of a video wait for its end."""
    recorder.do(do="sweep", settings=[F_NUMBERS], results=[CODE], id=1)
    session = recorder.session
    session.queue.add(SetValue(key="exposure_s", value=0.02))
    for _ in range(2):
        session.sweeps.compute_next(session.engine.simulate)
    assert session.sweeps.is_running
    session.engine.forget("")
    session.queue.waiting.clear()
    session.queue.add(ShowFrame(n=1))
    assert len(finish(recorder)["points"]) == 2


def test_page_receives_the_sweep_again(recorder):
    found = run(recorder, [F_NUMBERS], [CODE])
    recorder.do(do="refresh")
    assert last(recorder) == found


def test_thread_computes_points_between_messages(settings):
    messages = []
    session = Session("test", Start(settings), n_threads=1)
    try:
        session.attach(lambda message: None if isinstance(message, bytes) else messages.append(yaml.safe_load(message)))
        session.post({"do": "sweep", "settings": [EXPOSURES, F_NUMBERS], "results": [CODE], "id": 1})
        session.post({"do": "set", "key": "exposure_s", "value": 0.03, "id": 2})
        wait_until(lambda: any(message.get("state") == "done" for message in list(messages)))
        assert session.history.settings["exposure_s"] == 0.03
    finally:
        session.close()
    assert next(message for message in messages if message["kind"] == "sweep")["state"] == "running"


# -- several values at once ----------------------------------------------------------------------------------------------------


def test_values_of_a_point_are_one_step(recorder):
    found = run(recorder, [EXPOSURES, F_NUMBERS], [CODE])
    before = recorder.session.history.settings
    values = [{"key": "exposure_s", "value": 0.1}, {"key": "optics.f_number", "value": 4}]
    state = recorder.do(do="assign", values=values, id=8)

    assert state["errors"] == {}
    assert (state["settings"]["exposure_s"], state["settings"]["optics"]["f_number"]) == (0.1, 4)
    assert central_code_dn(recorder.session.result.capture) == found["points"][-1][0]
    state = recorder.do(do="undo", id=9)
    assert (state["settings"], state["can_undo"]) == (before, False)


def test_wrong_value_changes_none(recorder):
    before = recorder.session.history.settings
    values = [{"key": "exposure_s", "value": 0.1}, {"key": "optics.f_number", "value": -4}]
    state = recorder.do(do="assign", values=values, id=8)
    assert "f_number" in state["errors"]["assign"]
    assert (state["settings"], state["can_undo"]) == (before, False)


@pytest.mark.parametrize("values", [None, [], [3], [{"value": 3}], [{"key": "seed", "value": 1}] * 101])
def test_wrong_assignments_are_one_line(recorder, values):
    state = recorder.do(do="assign", values=values, id=8)
    (text,) = state["errors"].values()
    assert "must be" in text
    assert "\n" not in text


# -- files -------------------------------------------------------------------------------------------------------------------


def file_of(recorder):
    recorder.do(do="sweep_file", id=30)
    return next(message for message in recorder.messages if message["kind"] == "text")


def command_results(path, tmp_path, *, has_failures=False):
    """Return the results of the command by name, flat, in the order of the points."""
    out = tmp_path / "results.zarr"
    outcome = CliRunner().invoke(app, ["sweep", str(path), "--out", str(out), "--workers", "0"])
    assert outcome.exit_code == int(has_failures), outcome.output
    found = explore.open_results(out)
    return {name: found[name].values.reshape(-1) for name in found if name.startswith("result")}, found


@pytest.mark.parametrize(
    ("axes", "results", "names"),
    [
        ([EXPOSURES, F_NUMBERS], [CODE, {"measure": "psnr_db"}], ["result_mean_code_dn", "result_psnr_db"]),
        (
            [{"key": "layout.parameters.n_sites", "from": 60, "to": 300, "n": 3}, F_NUMBERS],
            [{"measure": "snr", "annulus_um": [0, 60]}, {"measure": "snr", "annulus_um": [60, 200]}],
            ["result_1_snr", "result_2_snr"],
        ),
        ([{"key": "layout.parameters.n_x", "from": 4, "to": 16, "n": 4}], [{"measure": "mean_code_dn", "site": 100}], ["result_mean_code_dn"]),
    ],
    ids=["all combinations", "other parameters follow", "failed point"],
)  # fmt: skip
def test_file_gives_the_results_of_the_page(recorder, tmp_path, axes, results, names):
    points = run(recorder, axes, results)["points"]
    path = tmp_path / "sweep.yaml"
    path.write_text(file_of(recorder)["text"], encoding="utf-8")
    has_failures = any(value is None for point in points for value in point)
    found, dataset = command_results(path, tmp_path, has_failures=has_failures)

    assert sorted(found) == sorted(names)
    for k, name in enumerate(names):
        expected = [math.nan if point[k] is None else point[k] for point in points]
        np.testing.assert_array_equal(found[name], expected)
    assert set(dataset["seed"].values.reshape(-1).tolist()) == {SETTINGS["seed"]}


def test_file_names_uploaded_pictures(recorder, tmp_path):
    """The file is for the settings at the start, and its picture is next to it."""
    from PIL import Image

    recorder.session.add_file("ramp.png", b"")
    picture = recorder.session.uploads / "ramp.png"
    Image.fromarray(np.tile(np.arange(0, 256, 4, dtype=np.uint8), (64, 1))).save(picture)
    recorder.do(do="file", path=str(picture), **{"as": "scene"}, id=1)
    points = run(recorder, [EXPOSURES], [CODE])["points"]
    recorder.do(do="undo", id=3)
    answer = file_of(recorder)
    assert answer["files"] == ["ramp.png"]
    assert answer["text"].splitlines()[2] == "# Uploaded files, next to this file: ramp.png"
    assert str(recorder.session.uploads) not in answer["text"]
    (tmp_path / "ramp.png").write_bytes(picture.read_bytes())
    path = tmp_path / "sweep.yaml"
    path.write_text(answer["text"], encoding="utf-8")
    np.testing.assert_array_equal(command_results(path, tmp_path)[0]["result_mean_code_dn"], np.array(points)[:, 0])


def test_file_requires_a_sweep(recorder):
    recorder.do(do="sweep_file", id=1)
    assert "there is no sweep; run one first" in problem(recorder)
