"""Repair of layouts in the studio: previews, the edit, its report, and the copied Python."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs

METHODS = ("best", "drop", "shrink", "merge", "refill")
#: The outermost column of a grid of 12 µm is cut; strips of 4 µm are too narrow.
PARAMETERS = {"n_x": 16, "n_y": 14, "pitch_um": 12.0}
NARROW = {"kind": "cut_along", "line_um": [[92.0, -85.0], [92.0, 85.0]]}
RULES = {"min_width_um": 5.0, "angle_limit_deg": 60.0}
N_SITES, N_NARROW, NARROW_UM2 = 16 * 14, 14, 14 * 4.0 * 12.0


@pytest.fixture
def views():
    return ("sites", "columns", "rules")


@pytest.fixture
def narrow(recorder):
    """A session whose 14 outermost sites are cut: each leaves a strip of 4 µm."""
    state = recorder.do(do="set", key="layout", value={
        "generator": "grid", "parameters": PARAMETERS, "edits": [NARROW], "rules": RULES, "mosaic": ["RG", "GB"],
    })  # fmt: skip
    assert state["errors"] == {}
    assert state["summary"]["n_sites"] == N_SITES + N_NARROW
    return recorder


def previews(recorder):
    recorder.do(do="preview_repairs", id=7)
    return {message["method"]: message for message in recorder.messages if message["kind"] == "repair"}


def rules_part(recorder):
    return next(header["about"] for header, _ in reversed(recorder.parts) if header["part"] == "rules")


def test_previews_show_what_is_lost(narrow):
    found = previews(narrow)

    assert tuple(found) == METHODS
    total_um2 = N_SITES * 144.0
    for method, n_sites, area_um2 in (
        ("best", N_SITES, total_um2),
        ("merge", N_SITES, total_um2),
        ("drop", N_SITES, total_um2 - NARROW_UM2),
    ):
        before, after = found[method]["before"], found[method]["after"]
        assert before == {
            "n_sites": N_SITES + N_NARROW,
            "area_um2": pytest.approx(total_um2),
            "min_size_um": pytest.approx(48**0.5),
        }
        assert (after["n_sites"], after["area_um2"]) == (n_sites, pytest.approx(area_um2))
    assert found["drop"]["after"]["min_size_um"] == pytest.approx(96**0.5)
    assert found["best"]["after"]["min_size_um"] == pytest.approx(12.0)
    assert "14 sites dropped" in found["drop"]["text"]
    assert {message["id"] for message in found.values()} == {7}


def test_previews_change_nothing(narrow):
    before = narrow.session.history.settings, narrow.session.result
    previews(narrow)

    assert (narrow.session.history.settings, narrow.session.result) == before
    assert {message["kind"] for message in narrow.messages} >= {"busy", "repair", "state", "done"}


@pytest.mark.parametrize("method", ["best", "drop"])
def test_repair_is_that_of_its_preview(narrow, method):
    found = previews(narrow)[method]
    n_built = narrow.session.engine.n_built["layout"]
    state = narrow.do(do="repair", method=method, id=8)
    layout = narrow.session.result.capture.layout

    assert state["errors"] == {}
    assert state["settings"]["layout"]["edits"] == [NARROW, {"kind": "repair", "method": method}]
    assert (layout.n_sites, layout.area_um2.sum()) == (
        found["after"]["n_sites"],
        pytest.approx(found["after"]["area_um2"]),
    )
    assert layout.check(narrow.session.result.shot.rules).ok
    # The report remains in the view; the layout of the preview is not computed again.
    assert [repair["text"] for repair in rules_part(narrow)["repairs"]] == [found["text"]]
    assert narrow.session.engine.n_built["layout"] == n_built
    assert narrow.do(do="undo", id=9)["summary"]["n_sites"] == N_SITES + N_NARROW


def test_another_method_replaces_the_repair(narrow):
    narrow.do(do="repair", method="drop", id=8)
    assert previews(narrow)["best"]["before"]["n_sites"] == N_SITES + N_NARROW
    state = narrow.do(do="repair", method="best", id=9)

    assert state["settings"]["layout"]["edits"] == [NARROW, {"kind": "repair", "method": "best"}]
    assert narrow.session.result.capture.layout.area_um2.sum() == pytest.approx(N_SITES * 144.0)


def test_impossible_repairs_say_why(narrow):
    narrow.do(do="set", key="layout.rules", value={"max_sites": 10})
    found = previews(narrow)

    assert {message["text"] for message in found.values()} != {""}
    for message in found.values():
        assert "after" not in message
        assert "removing sites cannot repair" in message["text"]
    state = narrow.do(do="repair", method="best", id=8)
    assert "removing sites cannot repair" in state["errors"]["repair"]
    assert state["settings"]["layout"]["edits"] == [NARROW]


def test_repair_without_rules_is_an_error(narrow):
    narrow.do(do="delete", key="layout.rules")

    assert "'layout.rules' must be given" in narrow.do(do="repair", method="best")["errors"]["repair"]
    assert "must be best, drop" in narrow.do(do="repair", method="all")["errors"]["repair"]


def test_waiting_change_ends_the_previews(narrow):
    narrow.session.post({"do": "undo"})

    assert previews(narrow) == {}


def test_cancel_ends_the_previews(narrow):
    before = narrow.session.history.settings
    receive = narrow._receive

    def cancel(message):
        receive(message)
        if not isinstance(message, bytes) and "repair: drop" in message:
            narrow.session.queue.cancel()

    narrow.session._listeners = {cancel: False}
    found = previews(narrow)

    assert "best" in found
    assert "refill" not in found
    assert narrow.session.history.settings == before


# -- Python ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [None, "best", "refill"])
def test_python_has_rules_and_report(narrow, method):
    if method is not None:
        narrow.do(do="repair", method=method)
    text = narrow.session.text("python")
    names = {}
    exec(compile(text, "shot.py", "exec"), names)
    result = narrow.session.result

    assert np.array_equal(names["capture"].code, result.capture.code)
    assert names["rules"] == result.shot.rules
    assert str(names["report"]) == str(result.capture.layout.check(result.shot.rules))
    assert names["report"].ok == (method is not None) == rules_part(narrow)["is_satisfied"]
    assert [line for line in text.splitlines() if line.startswith(("import", "from"))] == ["import foveasim as fs"]
    assert ("fs.layout.repair(" in text) == (method is not None)


def test_python_without_rules_checks_nothing(narrow):
    narrow.do(do="delete", key="layout.rules")

    assert "rules" not in narrow.session.text("python")


def test_python_uses_public_names(narrow):
    """The scene of these tests is a chart, in a module of its own."""
    text = narrow.session.text("python")

    assert "fs.scene.charts.checkerboard(" in text
    assert callable(fs.scene.charts.checkerboard)
