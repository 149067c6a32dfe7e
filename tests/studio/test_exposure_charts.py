"""Charts over signal and exposure: closed forms of shot noise, read noise, saturation and sampling."""

from __future__ import annotations

import json

import numpy as np
import pytest

from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS

#: Elementary charge, C.
CHARGE_C = 1.602176634e-19


@pytest.fixture
def simulate(settings):
    def simulate(exposure_s=1e-4, **sensor):
        changed = json.loads(json.dumps(settings))
        # 40,000 e- at the highest code, of which the pedestal is 400 e-, in a uniform scene.
        changed["sensor"] |= {
            "capacitance_f": 40_000 * CHARGE_C,
            "v_sat_v": 1.0,
            "bits": 14,
            "read_noise_e": 5.0,
            "pedestal_v": 0.01,
            **sensor,
        }
        changed["scene"] = {key: v for key, v in changed["scene"].items() if key != "square_mm"} | {"kind": "flat"}
        changed["exposure_s"] = exposure_s
        return Engine(n_threads=1).simulate(changed)

    return simulate


def curves_of(result, name):
    about, arrays = PARTS[name].make(result)
    return about, {curve["label"]: (arrays[f"x-{k}"], arrays[f"y-{k}"]) for k, curve in enumerate(about["curves"])}


def test_temporal_variance_is_linear_in_signal(simulate):
    _, curves = curves_of(simulate(), "photon_transfer")
    signal_e, noise_e = curves["temporal noise"]
    e_per_dn = 40_000 / 2**14

    assert noise_e**2 == pytest.approx(signal_e + 25.0 + e_per_dn**2 / 12.0, rel=1e-4)
    assert 0.8 * 39_600 < signal_e[-1] < 39_600


def test_saturation_is_in_the_note(simulate):
    about, _ = curves_of(simulate(exposure_s=1.0), "photon_transfer")

    assert "; now saturated" in about["note"]
    assert about["marks"][0]["x"] == pytest.approx(39_600, rel=1e-3)


def test_components_have_slopes_of_their_kind(simulate):
    _, curves = curves_of(simulate(prnu_fraction=0.02), "photon_transfer")
    slopes = {name: np.polyfit(np.log(x), np.log(y), 1)[0] for name, (x, y) in curves.items()}
    shot, read = curves["photon shot"], curves["dark and read"]

    expected = {"photon shot": 0.5, "dark and read": 0.0, "quantisation": 0.0, "fixed pattern": 1.0}
    assert {name: slopes[name] for name in expected} == pytest.approx(expected, abs=1e-3)
    assert shot[1] ** 2 == pytest.approx(shot[0], rel=0.1)  # the site has its own sensitivity
    assert read[1] == pytest.approx(5.0)
    assert curves["quantisation"][1] == pytest.approx(40_000 / 2**14 / np.sqrt(12.0), rel=1e-3)
    assert curves["fixed pattern"][1] == pytest.approx(0.02 * shot[1] ** 2, rel=1e-3)


def test_mark_is_on_the_noise_curve(simulate):
    about, curves = curves_of(simulate(), "photon_transfer")
    (mark,) = about["marks"]
    x, y = curves["temporal noise"]

    assert mark["y"] == pytest.approx(np.interp(mark["x"], x, y), rel=0.01)


def test_ratio_has_closed_form(simulate):
    result = simulate()
    about, curves = curves_of(result, "snr")
    exposure_s, ratio_db = curves["G"]
    of_filter = result.capture.filter_of_site == result.capture.filter_names.index("G")
    charge_e = np.median(result.capture.expected_e[of_filter]) / result.shot.exposure_s * exposure_s
    k = 2**14 / 40_000

    assert list(curves) == ["R", "G", "B"]
    expected = charge_e / np.sqrt(charge_e + 25.0 + 1.0 / (12.0 * k * k))
    assert ratio_db == pytest.approx(20.0 * np.log10(expected), abs=0.05)
    assert all(mark["y"] <= 20.0 * np.log10(np.sqrt(40_000)) for mark in about["marks"])


def test_dynamic_range_is_saturation_over_threshold(simulate):
    about, _ = curves_of(simulate(), "snr")
    variance_e2 = 25.0 + (40_000 / 2**14) ** 2 / 12.0
    threshold_e = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * variance_e2))
    # Noise is clipped from two standard deviations below the highest code.
    top_e = 40_000 * (1.0 - 2.0**-14 - 0.01)
    saturation_e = top_e - 2.0 * np.sqrt(top_e)

    assert about["dynamic_range_db"].keys() == {"R", "G", "B"}
    assert about["dynamic_range_db"]["R"] == pytest.approx(20.0 * np.log10(saturation_e / threshold_e), abs=0.1)
    assert "Dynamic range / dB: R" in about["note"]


@pytest.mark.parametrize("name", ["photon_transfer", "snr"])
def test_charts_without_light_are_finite(settings, name):
    settings["scene"]["radiance_w_m2_sr_nm"] = 0.0
    about, arrays = PARTS[name].make(Engine(n_threads=1).simulate(settings))

    assert bool(about["curves"]) == (name == "photon_transfer")
    assert not any(np.isinf(values).any() for values in arrays.values())


def test_charts_ignore_exchange_between_sites(simulate):
    _, alone = curves_of(simulate(), "photon_transfer")
    _, mixed = curves_of(simulate(crosstalk={"kind": "diffusion", "spread_um": 2.0}), "photon_transfer")

    assert np.allclose(alone["photon shot"][0], mixed["photon shot"][0], rtol=1e-6)


def test_nyquist_of_grid_is_half_per_pitch(settings):
    about, _ = PARTS["mtf"].make(Engine(n_threads=1).simulate(settings))

    assert [line["label"] for line in about["lines"]] == ["smallest site", "median site", "largest site"]
    assert [line["x"] for line in about["lines"]] == pytest.approx([1.0 / (2.0 * 0.012)] * 3)
