"""Requirements and goal seek: results of regions, limits, margins, and values that meet them."""

from __future__ import annotations

import json
import math
import re
import sys

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import foveasim as fs
from foveasim import explore
from foveasim.cli import app
from foveasim.config import Requirement, build_shot
from foveasim.errors import ConfigError, ParameterError, SimulationError
from foveasim.explore.solving import search_value
from foveasim.metrics import METRICS, metric_info

SHOT = {
    "scene": {"kind": "flat", "shape": [80, 80], "pitch_um": 400.0, "distance_m": 1.0, "illuminance_lux": 300.0},
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {
        "generator": "log_polar",
        "parameters": {"n_sectors": 32, "min_size_um": 4.0, "r_max_um": 90.0},
        "rules": {"min_size_um": 5.0},
    },
    "sensor": {"preset": "machine_vision"},
    "exposure_s": 0.002,
    "seed": 1,
}


@pytest.fixture(scope="module")
def taken():
    shot = build_shot(None, SHOT)
    return shot, shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)


def of(measure, **options):
    return Requirement(measure=measure, at_least=0.0, **options)


# -- results ------------------------------------------------------------------------------------------------------------


def test_results_of_regions_have_closed_forms(taken):
    """On a uniform scene with shot noise only, the SNR is the root of the charge."""
    shot, capture = taken
    quiet = build_shot(None, {**SHOT, "sensor": {"bits": 16, "capacitance_f": 1e-12, "v_sat_v": 30.0}})
    seen = quiet.camera.capture(quiet.scene, exposure_s=quiet.exposure_s, seed=0)
    radius_um = np.hypot(*seen.layout.centroid_um.T)
    inner, outer = radius_um < 40.0, radius_um >= 60.0
    for chosen, annulus_um in ((inner, (0.0, 40.0)), (outer, (60.0, 200.0))):
        ratio = explore.result_of(of("snr", annulus_um=annulus_um), quiet, seen)
        step_e = 30.0 * 1e-12 / 1.602176634e-19 / 2**16
        expected = seen.expected_e / np.sqrt(seen.expected_e + step_e**2 / 12.0)
        assert ratio == pytest.approx(np.median(expected[chosen]), rel=1e-3)
        assert explore.result_of(of("snr_db", annulus_um=annulus_um), quiet, seen) == pytest.approx(
            20 * math.log10(ratio)
        )
        assert explore.result_of(of("n_sites", annulus_um=annulus_um), quiet, seen) == chosen.sum()

    half = capture.layout.centroid_um[:, 0] > 0
    rectangle_um = (0.0, -200.0, 200.0, 200.0)
    assert explore.result_of(of("n_sites", rectangle_um=rectangle_um), shot, capture) == half.sum()
    assert explore.result_of(of("mean_code_dn", rectangle_um=rectangle_um), shot, capture) == pytest.approx(
        capture.code[half].mean()
    )
    assert explore.result_of(of("mean_code_dn", site=5), shot, capture) == capture.code[5]
    assert explore.result_of(of("smallest_size_um"), shot, capture) == pytest.approx(capture.layout.size_um.min())
    assert explore.result_of(of("violations"), shot, capture) == (capture.layout.size_um < 5.0 - 1e-9).sum()
    assert explore.result_of(of("exposure_s"), shot, capture) == 0.002


def test_mtf_is_that_of_lens_and_square():
    shot = build_shot(
        None, {**SHOT, "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 6.0}}}
    )
    capture = shot.camera.capture(shot.scene, exposure_s=0.002, seed=0)
    found = explore.result_of(of("mtf", frequency_per_mm=50.0), shot, capture)
    cut_off = 50e-3 * 0.55 * shot.camera.optics.working_f_number(1.0)  # frequency times λN
    lens = 2.0 / math.pi * (math.acos(cut_off) - cut_off * math.sqrt(1.0 - cut_off**2))

    assert found == pytest.approx(lens * np.sinc(50e-3 * 6.0), rel=1e-4)


def test_metrics_and_requirements_agree(taken):
    shot, capture = taken
    for name in ("n_sites", "saturated_fraction", "mean_code_dn", "data_rate_gbit_per_s"):
        assert explore.result_of(of(name), shot, capture) == pytest.approx(METRICS[name](shot, shot.camera, capture))
    assert explore.result_of(of("snr"), shot, capture) == METRICS["snr"](shot, shot.camera, capture)["median"]


def test_picture_quality_is_of_the_region():
    """A fovea resolves a chart that the periphery does not."""
    scene = {
        "kind": "siemens_star",
        "n_spokes": 24,
        "shape": [200, 200],
        "pitch_um": 150.0,
        "distance_m": 1.0,
        "illuminance_lux": 300.0,
    }
    shot = build_shot(None, {**SHOT, "scene": scene})
    capture = shot.camera.capture(shot.scene, exposure_s=0.002, seed=0)
    whole = explore.result_of(of("psnr_db"), shot, capture)
    ring = explore.result_of(of("psnr_db", annulus_um=(40.0, 80.0)), shot, capture)
    box = explore.result_of(of("psnr_db", rectangle_um=(30.0, -20.0, 70.0, 20.0)), shot, capture)
    disc = explore.result_of(of("psnr_db", annulus_um=(0.0, 60.0)), shot, capture)
    square = explore.result_of(of("psnr_db", rectangle_um=(-60.0, -60.0, 60.0, 60.0)), shot, capture)
    corners = explore.result_of(of("psnr_db", annulus_um=(60.0, 60.0 * 2.0**0.5)), shot, capture)

    # The square is the disc and its corners; those outside the layout have no values.
    assert min(disc, corners) - 1.0 < square < max(disc, corners) + 1.0
    assert whole == pytest.approx(METRICS["psnr_db"](shot, shot.camera, capture))
    assert all(5.0 < value < 50.0 for value in (whole, ring, box))
    with pytest.raises(SimulationError, match="needs an annulus or a rectangle"):
        explore.result_of(of("psnr_db", site=0), shot, capture)


def test_margins_are_distances_from_the_nearest_limit():
    both = Requirement(measure="n_sites", at_least=10.0, at_most=20.0)
    assert [both.margin(value) for value in (5.0, 12.0, 19.0, 25.0)] == [-5.0, 2.0, 1.0, -5.0]
    assert math.isnan(both.margin(math.nan))
    checked = explore.CheckedRequirement(both, math.nan)
    assert not checked.is_met
    assert str(explore.CheckedRequirement(both, 25.0)) == "NOT met: photosites: at least 10 and at most 20; got 25"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"measure": "size", "at_least": 1.0}, "'measure' must be one of 'mean_code_dn'"),
        ({"measure": "snr"}, "'at_least' or 'at_most' must be given"),
        ({"measure": "snr", "at_least": 2.0, "at_most": 1.0}, "'at_least' must be <= at_most"),
        ({"measure": "snr", "at_least": math.inf}, "'at_least' must be finite"),
        ({"measure": "snr", "at_least": 1.0, "site": 0, "annulus_um": (0.0, 1.0)}, "'site' excludes annulus_um"),
        ({"measure": "snr", "at_least": 1.0, "annulus_um": (2.0, 1.0)}, "'annulus_um' must be two increasing radii"),
        ({"measure": "snr", "at_least": 1.0, "rectangle_um": (0.0, 0.0, 0.0, 1.0)}, "'rectangle_um' must be"),
        ({"measure": "violations", "at_most": 0.0, "site": 1}, "'site' must not be given"),
        ({"measure": "mtf", "at_least": 0.3}, "'frequency_per_mm' must be given if and only if"),
        (
            {"measure": "snr", "at_least": 0.3, "frequency_per_mm": 3.0},
            "'frequency_per_mm' must be given if and only if",
        ),
    ],
)
def test_wrong_requirements_are_one_line(options, message):
    with pytest.raises(ParameterError, match=message):
        Requirement(**options)


def test_regions_without_sites_are_errors(taken):
    with pytest.raises(SimulationError, match="from 500 to 600 µm: the region contains no photosite"):
        explore.result_of(of("snr", annulus_um=(500.0, 600.0)), *taken)
    with pytest.raises(SimulationError, match="has only"):
        explore.result_of(of("snr", site=10**6), *taken)


# -- files, commands, sweeps --------------------------------------------------------------------------------------------------


def test_command_checks_requirements(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[fs.config.run_shot.__module__], "write_results", lambda *_: ([], 0.0))
    path = tmp_path / "shot.yaml"
    limits = [{"measure": "n_sites", "at_most": 10_000}, {"measure": "snr", "at_least": 10, "annulus_um": [60, 90]}]
    path.write_text(yaml.safe_dump({**SHOT, "requirements": limits}))

    def run(*arguments):
        return CliRunner().invoke(app, ["run", str(path), "--out", str(tmp_path / "out"), *arguments])

    met = run("--require")
    assert met.exit_code == 0
    assert "met: photosites: at most 10,000; got" in met.output
    failed = run("--require", "--set", "exposure_s=1e-5")
    assert failed.exit_code == 1
    assert "NOT met: signal-to-noise ratio from 60 to 90 µm: at least 10; got" in failed.output
    assert run("--set", "exposure_s=1e-5").exit_code == 0
    assert run("--require", "--set", "requirements=[]").exit_code == 2
    assert "did you mean 'snr'" in str(run("--set", "requirements=[{measure: srn, at_least: 1}]").exception)


def test_settings_report_the_path_of_a_requirement():
    wrong = [{"measure": "snr", "at_least": 1.0}, {"measure": "snr", "at_least": 1.0, "annulus_um": [3.0, 1.0]}]
    with pytest.raises(ConfigError, match=r"requirements\[1\]\.annulus_um: must be two increasing radii"):
        build_shot(None, {**SHOT, "requirements": wrong})


def test_sweeps_have_the_margins():
    limits = [{"measure": "snr", "at_least": 10.0}, {"measure": "n_sites", "at_most": 10_000}]
    found = explore.sweep(
        {**SHOT, "requirements": limits}, {"exposure_s": [1e-5, 1e-3]}, metrics=["requirements", "snr"], workers=0
    )

    assert found["requirements_are_met"].values.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(found["requirements_margin_1"], found["snr_median"] - 10.0)
    json.dumps(found.attrs)


def test_sweep_files_contain_results_of_photosites(tmp_path):
    """Points with the seed of the shot are captures of the changed shot."""
    inner, all_sites = {"measure": "mean_code_dn", "annulus_um": [0.0, 40.0]}, {"measure": "psnr_db"}
    file = {"shot": SHOT, "vary": {"exposure_s": [1e-4, 1e-3]}, "seed": "shot"}
    file["results"] = {"inner_dn": inner, "quality_db": all_sites}
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(file))
    found = explore.run_sweep(explore.read_sweep(path), workers=0)

    assert {"inner_dn", "quality_db", "seed"} <= set(found)
    assert "n_sites" not in found
    assert found["seed"].values.tolist() == [SHOT["seed"]] * 2
    for exposure_s in (1e-4, 1e-3):
        shot = build_shot(None, {**SHOT, "exposure_s": exposure_s})
        capture = shot.camera.capture(shot.scene, exposure_s=exposure_s, seed=SHOT["seed"])
        point = found.sel(exposure_s=exposure_s)
        radius_um = np.hypot(
            *(capture.layout.centroid_um - np.reshape(capture.layout.bounds_um, (2, 2)).mean(axis=0)).T
        )
        assert float(point["inner_dn"]) == capture.code[radius_um < 40.0].mean()
        assert float(point["quality_db"]) == METRICS["psnr_db"](shot, shot.camera, capture)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": "shot", "repeats": 2}, "'repeats' must be 1 with the seed of the shot"),
        ({"seed": "short"}, "seed"),
        ({"results": {"a": {"measure": "srn"}}}, r"results\.a\.measure: must be one of '"),
        ({"results": {"a": {"measure": "snr", "at_least": 2.0}}}, r"results\.a\.at_least"),
        ({"results": {"a b": {"measure": "snr"}}}, "must have names that are identifiers"),
        ({"metrics": ["snr"], "results": {"snr": {"measure": "snr"}}}, "'results' must not have the name of a metric"),
    ],
)
def test_wrong_results_of_files_are_one_line(tmp_path, change, message):
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump({"shot": SHOT, "vary": {"exposure_s": [1e-4, 1e-3]}, **change}))
    with pytest.raises(ConfigError, match=message) as caught:
        explore.read_sweep(path)
    assert "\n" not in str(caught.value)


def test_requirements_repeat_no_simulation(taken):
    runner = explore.worker_cache.ShotRunner(None, {})
    runner.simulate_capture(SHOT)
    n_built = dict(runner.cache.n_built)
    runner.simulate_capture({**SHOT, "requirements": [{"measure": "snr", "at_least": 1.0}]})
    assert runner.cache.n_built == n_built


# -- goal seek -------------------------------------------------------------------------------------------------------------------


def between(low, high, measure="snr"):
    return Requirement(measure=measure, at_least=low, at_most=high)


def test_exposure_has_a_closed_form():
    """Shot noise only: the ratio is the root of the charge, which is proportional to the exposure."""
    sensor = {"bits": 16, "capacitance_f": 1e-14, "v_sat_v": 3.0}
    settings = {**SHOT, "sensor": sensor}
    shot = build_shot(None, settings)
    charge_e = np.median(shot.camera.capture(shot.scene, exposure_s=0.001, seed=0).expected_e) / 0.001
    found = explore.solve(settings, "exposure_s", between(10.0, 10.0), bounds=(1e-6, 1.0))

    assert found.result == pytest.approx(10.0, rel=2e-3)
    assert found.value == pytest.approx(100.0 / charge_e, rel=0.03)  # and the quantisation
    assert [value for value, _ in found.curve] == sorted(value for value, _ in found.curve)
    assert build_shot(None, {**settings, "exposure_s": found.value}).exposure_s == found.value


@pytest.mark.parametrize(
    ("requirement", "expected"),
    [
        (Requirement(measure="snr", at_least=9.0), 9.0),
        (Requirement(measure="snr", at_most=4.0), 5.0),
        (between(10.0, 10.0), 10.0),
        (between(7.0, 8.0), 7.0),
        (Requirement(measure="snr", at_least=3.0), 5.0),
    ],
)
def test_nearest_value_is_found(requirement, expected):
    """Of a monotonic function from 5: the limit, or the present value where it is met already."""
    found = search_value(
        "x",
        5.0,
        requirement,
        lambda x: x if expected >= 5.0 and requirement.at_most != 4.0 else x - 1.0,
        bounds=(1.0, 40.0),
    )
    assert found.value == pytest.approx(expected, rel=1e-3)
    assert requirement.margin(found.result) >= -0.011


def test_nearest_of_several_solutions_is_found():
    found = search_value("x", 7.0, Requirement(measure="snr", at_most=0.0), math.sin, bounds=(0.1, 12.0))
    assert found.value == pytest.approx(2.0 * math.pi, rel=1e-3)


def test_integers_remain_integers():
    found = explore.solve(SHOT, "layout.parameters.n_sectors", between(400.0, 400.0, "n_sites"), bounds=(8, 128))
    assert found.value == round(found.value)
    assert isinstance(found.value, int)
    other = {n: build_shot(None, {**SHOT, "layout": {**SHOT["layout"], "parameters": {**SHOT["layout"]["parameters"], "n_sectors": n}}})
             .camera.layout.n_sites for n in (found.value - 1, found.value, found.value + 1)}  # fmt: skip
    assert abs(found.result - 400.0) == min(abs(n_sites - 400.0) for n_sites in other.values())


def test_failed_values_are_left_out():
    def result_at(x):
        if x < 3.0:
            raise SimulationError("too small")
        return x

    found = search_value("x", 9.0, Requirement(measure="snr", at_most=4.0), result_at, bounds=(1.0, 10.0))
    assert found.value == pytest.approx(4.0, rel=1e-3)
    assert any(math.isnan(result) for _, result in found.curve)


def test_unreachable_goals_state_the_range():
    with pytest.raises(
        SimulationError, match=r"at least 1,000 cannot be reached with x from 1 to 10: results are from 1 to 10"
    ):
        search_value("x", 2.0, Requirement(measure="snr", at_least=1000.0), lambda x: x, bounds=(1.0, 10.0))
    with pytest.raises(ParameterError, match="'bounds' must be ascending"):
        search_value("x", 2.0, Requirement(measure="snr", at_least=1000.0), lambda x: x, bounds=(10.0, 1.0))
    with pytest.raises(ParameterError, match="'setting' must be the path of a number"):
        explore.solve(SHOT, "scene.kind", between(1.0, 2.0), bounds=(0.0, 1.0))


def test_all_measures_have_words():
    names = [name for name in METRICS if metric_info(name).is_number]
    assert {"snr", "psnr_db", "ssim", "information_bit_per_mm2"} <= set(names) < set(METRICS)
    for name in names:
        options = {"frequency_per_mm": 10.0} if name == "mtf" else {}
        assert str(Requirement(measure=name, at_least=1.0, **options)).endswith(
            f"at least 1{' ' + metric_info(name).unit if metric_info(name).unit else ''}"
        )
    assert fs.config.Requirement is Requirement


def test_exact_solution_is_preferred_to_jump():
    """As a ratio that falls where sites saturate: the jump at 4 is nearer to the start than the solution."""
    found = search_value("x", 8.0, between(10.0, 10.0), lambda x: 20.0 * x if x < 4.0 else 7.0, bounds=(0.1, 9.0))

    assert found.value == pytest.approx(0.5, rel=2e-3)
    assert found.result == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize("setting", ["optics.f_number", "exposure_s"])
def test_numbers_of_files_are_continuous(setting):
    """A value such as 4 in a file does not restrict the solution."""
    settings = {**SHOT, "optics": {"focal_length_mm": 8, "f_number": 4}, "exposure_s": 1}
    found = explore.solve(
        settings, setting, between(20.0, 20.0), bounds=(1.5, 400.0) if setting != "exposure_s" else (1e-6, 1.0)
    )
    assert found.value != round(found.value)
    assert found.result == pytest.approx(20.0, rel=0.01)


def test_results_near_zero_are_found():
    found = search_value(
        "x", 5.0, between(0.0, 0.0, "snr_db"), lambda x: 20.0 * math.log10(x / 3.0), bounds=(0.1, 100.0)
    )
    assert found.value == pytest.approx(3.0, rel=1e-3)


def test_results_just_below_saturation_are_found():
    found = search_value(
        "x", 1.0, Requirement(measure="snr", at_least=6.9), lambda x: x if x < 7.0 else math.nan, bounds=(0.5, 40.0)
    )
    assert 6.9 <= found.value < 7.0


@pytest.mark.parametrize("region", [{"annulus_um": (0.0, math.inf)}, {"rectangle_um": (0.0, 0.0, math.nan, 1.0)}])
def test_regions_are_finite(region):
    with pytest.raises(ParameterError, match="must be finite"):
        Requirement(measure="snr", at_least=1.0, **region)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"results": {"a": {"measure": "snr", "at_least": 3}}}, "results.a.at_least: unknown key; possible: 'measure'"),
        ({"results": {"a": {"measure": "sharpness"}}}, "results.a.measure: must be one of '"),
        ({"seed": "random"}, "seed: must be an integer, or one of 'shot', got \"random\""),
    ],
)
def test_wrong_results_of_sweeps_are_one_line(tmp_path, keys, message):
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump({"shot": SHOT, "vary": {"sensor.bits": [8, 10]}, **keys}))
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        fs.explore.read_sweep(path)

    assert "\n" not in str(caught.value)
