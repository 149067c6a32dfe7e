"""Numbers next to those that they qualify: saturated photosites, coarse quantisation, goals that are met."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs

#: Exposure at which most photosites of these tests are saturated.
LONG_S = 0.3


@pytest.fixture
def views():
    return ("sites", "noise", "snr", "photon_transfer", "requirements")


@pytest.fixture
def bright(recorder):
    recorder.do(do="set", key="exposure_s", value=LONG_S)
    return recorder


def about(recorder, name):
    return next(header["about"] for header, _ in reversed(recorder.parts) if header["part"] == name)


def saturated(recorder, sites=slice(None)):
    """Fraction of the sites with the highest code of 10 bits."""
    return float(np.mean(recorder.session.result.capture.code[sites] == 1023))


def test_notes_of_charts_name_saturation(bright):
    expected = f"{100.0 * saturated(bright):.3g} % of the photosites are saturated"

    assert 0.1 < saturated(bright) < 1.0
    for name in ("snr", "photon_transfer"):
        assert about(bright, name)["note"].endswith(expected)
    assert about(bright, "noise")["saturation"].endswith(expected)


def test_notes_without_saturation_name_none(recorder):
    recorder.do(do="set", key="exposure_s", value=1e-3)

    assert saturated(recorder) == 0.0
    assert "saturated" not in about(recorder, "snr")["note"]
    assert about(recorder, "noise")["saturation"] == ""


def test_requirements_of_signals_have_saturation(bright):
    inside = np.hypot(*bright.session.result.capture.layout.centroid_um.T) <= 50.0
    limits = [
        {"measure": "mean_code_dn", "at_least": 1, "annulus_um": [0.0, 50.0]},
        {"measure": "snr", "at_least": 1},
        {"measure": "n_sites", "at_least": 1},
    ]
    bright.do(do="set", key="requirements", value=limits)
    found = [row["saturated_fraction"] for row in about(bright, "requirements")["rows"]]

    assert found == pytest.approx([saturated(bright, inside), saturated(bright), 0.0])


@pytest.mark.parametrize(("bits", "is_coarse"), [(8, True), (16, False)])
def test_coarse_quantisation_is_reported(recorder, bits, is_coarse):
    """Full range of 144 µm² at 1e-17 F/µm² and 1 V: 8,988 e-; a step of 8 bits is 35 e-, with a noise of 10 e-."""
    recorder.do(do="assign", values=[
        {"key": "sensor.bits", "value": bits}, {"key": "sensor.capacitance_f", "value": {"per_um2": 1e-17}},
        {"key": "sensor.v_sat_v", "value": 1.0},
    ])  # fmt: skip
    found = about(recorder, "noise")
    quantisation_e = next((s["values"] for s in found["sources"] if s["name"] == "quantisation"), 0.0)

    assert quantisation_e == pytest.approx(1.44e-15 / 1.602e-19 / 2**bits / 12**0.5, rel=0.02)
    assert (found["is_coarse"], found["read_e"]) == (is_coarse, pytest.approx(2.0))


@pytest.mark.parametrize("name", ["machine_vision", "paper_foveal"])
def test_presets_say_what_they_scale(name):
    preset = fs.sensor.PRESETS[name]
    small, large = (preset.values(np.array([area_um2]))["capacitance_f"] for area_um2 in (1.0, 4.0))

    assert ("proportional to the area" in preset.scaling) == bool(np.all(large == 4.0 * small))


def test_met_goal_changes_nothing(recorder):
    requirement = {"measure": "mean_code_dn", "at_least": 1.0}
    before = recorder.session.history.settings
    state = recorder.do(do="seek", key="exposure_s", requirement=requirement, id=1)
    found = next(message for message in recorder.messages if message["kind"] == "sought")

    assert (state["settings"], state["can_undo"], state["errors"]) == (before, False, {})
    assert found["is_present"]
    assert (found["value"], found["limits"]) == (0.01, [1.0, None])
    assert found["result"] == pytest.approx(recorder.session.result.capture.code.mean())


def test_goal_says_what_is_saturated(recorder):
    requirement = {"measure": "mean_code_dn", "at_least": 900.0}
    state = recorder.do(do="seek", key="exposure_s", requirement=requirement, bounds=[0.001, 20.0], id=1)
    found = next(message for message in recorder.messages if message["kind"] == "sought")

    assert state["errors"] == {}
    assert not found["is_present"]
    assert found["saturated_fraction"] == saturated(recorder) > 0.1
