"""Requirements and goal seek of the studio, in sessions without a thread."""

from __future__ import annotations

import pytest
from studio.conftest import ALL_VIEWS
from studio.test_session import codes_of

from foveasim.config import build_shot


def rows(recorder):
    return next(header["about"]["rows"] for header, _ in reversed(recorder.parts) if header["part"] == "requirements")


@ALL_VIEWS
def test_requirements_follow_the_settings(recorder):
    limits = [{"measure": "n_sites", "at_least": 300}, {"measure": "snr", "at_least": 1e9, "site": 500}]
    state = recorder.do(do="set", key="requirements", value=limits, id=1)
    first, second = rows(recorder)

    assert state["errors"] == {}
    assert (first["text"], first["value"], first["margin"], first["is_met"]) == (
        "photosites: at least 300",
        224,
        -76,
        False,
    )
    assert (second["value"], second["is_met"]) == (None, False)
    assert "has only 224 photosites" in second["problem"]
    recorder.do(do="set", key="layout.parameters.n_x", value=32, id=2)
    assert rows(recorder)[0]["is_met"]
    assert build_shot(None, recorder.session.history.settings).requirements[0].at_least == 300.0


def test_requirements_change_no_code(recorder, settings):
    recorder.do(do="set", key="requirements", value=[{"measure": "n_sites", "at_least": 1}], id=1)
    assert (recorder.session.result.capture.code == codes_of(settings)).all()


def test_goal_seek_is_one_step(recorder):
    before = recorder.session.history.settings
    state = recorder.do(
        do="seek", key="exposure_s", requirement={"measure": "snr", "at_least": 20, "at_most": 20}, id=1
    )
    found = next(message for message in recorder.messages if message["kind"] == "sought")

    assert state["errors"] == {}
    assert state["settings"]["exposure_s"] == found["value"] != before["exposure_s"]
    assert found["result"] == pytest.approx(20.0, rel=2e-3)
    assert [value for value, _ in found["curve"]] == sorted(value for value, _ in found["curve"])
    assert any("goal seek" in message["text"] for message in recorder.messages if message["kind"] == "progress")
    assert (recorder.session.result.capture.code == codes_of(state["settings"])).all()
    state = recorder.do(do="undo", id=2)
    assert (state["settings"], state["can_undo"]) == (before, False)


def test_goal_seek_reports_the_range(recorder):
    state = recorder.do(do="seek", key="optics.f_number", requirement={"measure": "snr", "at_least": 1e6}, id=1)
    assert "cannot be reached with optics.f_number from 1 to 32" in state["errors"]["optics.f_number"]
    assert not state["can_undo"]


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"key": "scene.kind", "requirement": {"measure": "snr", "at_least": 1}}, "must be the key of a number"),
        ({"key": "exposure_s", "requirement": {"measure": "srn", "at_least": 1}}, "did you mean 'snr'"),
        ({"key": "exposure_s", "requirement": {"measure": "snr"}}, "'at_least' or 'at_most' must be given"),
        ({"key": "exposure_s", "requirement": 3}, "must be a mapping"),
        (
            {"key": "exposure_s", "requirement": {"measure": "snr", "at_least": 1}, "bounds": [2, 1]},
            "must be ascending",
        ),
        ({"key": "exposure_s", "requirement": {"measure": "snr", "at_least": 1}, "bounds": "x"}, ""),
    ],
)
def test_wrong_goals_are_one_line(recorder, message, text):
    state = recorder.do(do="seek", id=1, **message)
    (problem,) = state["errors"].values()

    assert text in problem
    assert "\n" not in problem
    assert not state["can_undo"]


def test_cancelled_goal_seek_changes_nothing(recorder):
    before = recorder.session.history.settings
    receive = recorder._receive

    def cancel(message):
        receive(message)
        if not isinstance(message, bytes) and "goal seek, step 3" in message:
            recorder.session.post({"do": "cancel"})

    recorder.session._listeners = {cancel: False}
    state = recorder.do(
        do="seek", key="exposure_s", requirement={"measure": "snr", "at_least": 20, "at_most": 20}, id=1
    )
    assert (state["settings"], state["errors"], state["can_undo"]) == (before, {}, False)


# -- pinned photosites ---------------------------------------------------------------------------------------------------------


def curves(recorder, name):
    return [
        curve["label"] for header, _ in recorder.parts if header["part"] == name for curve in header["about"]["curves"]
    ]


@ALL_VIEWS
def test_pinned_photosites_have_their_curves(recorder):
    recorder.do(do="pin", sites=[3, 200, 3], id=1)
    assert curves(recorder, "snr") == curves(recorder, "photon_transfer") == ["photosite 3", "photosite 200"]
    assert curves(recorder, "mtf")[1:] == ["photosite 3", "photosite 200"]
    assert "columns" not in recorder.part_names
    recorder.do(do="set", key="layout.parameters.n_x", value=8, id=2)  # 112 photosites
    assert curves(recorder, "snr") == ["photosite 3"]


@pytest.mark.parametrize("sites", [None, ["3"], [1.5], list(range(7)), [True]])
def test_wrong_pins_are_one_line(recorder, sites):
    recorder.do(do="pin", sites=sites, id=1)
    (problem,) = [message["text"] for message in recorder.messages if message["kind"] == "error"]
    assert "must be a list of at most 6 indices" in problem


# -- list of changes -------------------------------------------------------------------------------------------------------------


def test_changes_are_listed(recorder):
    """Undone steps are not part of the list, and several keys of a step are one line."""
    recorder.do(do="set", key="optics.f_number", value=4.0, id=1)
    recorder.do(do="set", key="layout.parameters.n_sites", value=300, id=2)
    recorder.do(do="set", key="seed", value=9, id=3)
    recorder.do(do="undo", id=4)
    recorder.do(do="set", key="exposure_s", value=0.02, final=False, id=5)
    recorder.do(do="set", key="exposure_s", value=0.03, id=6)
    first, second, third = recorder.session.text("log").splitlines()

    assert first == "1. optics.f_number: 2.8 → 4.0"
    assert "layout.parameters.n_sites: – → 304" in second  # the nearest possible number
    assert "layout.parameters.n_x: 16 → –" in second
    assert third == "3. exposure_s: 0.01 → 0.03"
