"""Simulation of settings: the same codes as the command line, and only what changed is computed."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from foveasim.config import build_shot
from foveasim.errors import FoveasimError, GeometryError
from foveasim.studio import _engine
from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS, summary_of
from foveasim.view.web._content import describe_sites


@pytest.fixture
def engine():
    return Engine(n_threads=1)


def with_value(settings, key, value):
    changed = copy.deepcopy(settings)
    *above, last = key.split(".")
    section = changed
    for name in above:
        section = section[name]
    section[last] = value
    return changed


def test_codes_equal_those_of_files(engine, settings):
    for changed in (settings, with_value(settings, "optics.f_number", 5.6), settings):
        shot = build_shot(None, changed)
        expected = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)

        assert np.array_equal(engine.simulate(changed).capture.code, expected.code)


@pytest.mark.parametrize(
    ("key", "value", "stages"),
    [
        ("exposure_s", 0.02, set()),
        ("seed", 4, set()),
        ("sensor.read_noise_e", 5.0, {"sensor"}),
        ("sensor.qe", 0.5, {"sensor", "images", "power on sites"}),
        ("optics.f_number", 4.0, {"optics", "images", "power on sites"}),
        ("layout.parameters.pitch_um", 13.0, {"generated layout", "layout", "sensor", "camera", "power on sites"}),
        ("scene.square_mm", 5.0, {"scene", "images", "power on sites"}),
    ],
)
def test_only_changed_stages_are_computed(engine, settings, key, value, stages):
    engine.simulate(settings)
    before = dict(engine.n_built)
    engine.simulate(with_value(settings, key, value))

    assert {name for name, n in engine.n_built.items() if n != before[name]} == stages


def test_earlier_settings_are_not_computed_again(engine, settings):
    engine.simulate(settings)
    engine.simulate(with_value(settings, "optics.f_number", 4.0))
    before = dict(engine.n_built)
    engine.simulate(settings)

    assert engine.n_built == before


def test_invalid_settings_leave_engine_usable(engine, settings):
    with pytest.raises(FoveasimError, match="f_number"):
        engine.simulate(with_value(settings, "optics.f_number", -1.0))

    assert engine.simulate(settings).capture.layout.n_sites == 224


def test_large_layouts_are_rejected(engine, settings, monkeypatch):
    monkeypatch.setattr(_engine, "MAX_SITES", 100)
    with pytest.raises(GeometryError, match="1 to 100 photosites, got 224"):
        engine.simulate(settings)


def test_columns_are_values_of_capture(engine, settings):
    result = engine.simulate(settings)
    about, arrays = PARTS["columns"].make(result)
    columns = {column["key"]: arrays[column["array"]] for column in about["columns"] if "array" in column}
    columns |= PARTS["signals"].make(result)[1]
    page, _, _ = describe_sites(result.capture.layout)

    assert np.array_equal(columns["code"], result.capture.code)
    assert np.array_equal(columns["electrons"], result.capture.electrons)
    assert np.allclose(columns["snr"], result.capture.signal_to_noise(sensor=result.shot.camera.sensor), rtol=1e-6)
    assert PARTS["sites"].make(result)[0]["bounds_um"] == page["bounds_um"]


def test_picture_is_that_of_capture(engine, settings):
    result = engine.simulate(settings)
    about, arrays = PARTS["picture"].make(result)
    pixels = arrays["rgba"].reshape(about["height"], about["width"], 4).astype(int)
    expected = result.capture.picture(max_pixels=max(about["width"], about["height"])).to_image(result.capture.white_dn)

    assert pixels.shape == expected.shape
    assert np.abs(pixels - expected).max() <= 2  # a table of levels instead of the exact transfer function
    assert np.allclose(about["bounds_um"], result.capture.layout.bounds_um)


def test_optical_image_of_uniform_scene_is_uniform(engine, settings):
    flat = {key: value for key, value in settings["scene"].items() if key != "square_mm"} | {"kind": "flat"}
    about, arrays = PARTS["scene"].make(engine.simulate({**settings, "scene": flat}))
    pixels = arrays["rgba"].reshape(about["height"], about["width"], 4)
    middle = pixels[about["height"] // 2, about["width"] // 2].astype(int)
    image_um = 8.0 / (1000.0 - 8.0) * 64 * 500.0

    assert middle.min() > 250
    assert np.allclose(about["bounds_um"], np.array([-1, -1, 1, 1]) * image_um / 2, rtol=1e-9)


def test_noise_of_dark_frame_is_read_noise(engine, settings):
    dark = with_value(with_value(settings, "scene.radiance_w_m2_sr_nm", 0.0), "sensor.read_noise_e", 7.0)
    about, _ = PARTS["noise"].make(engine.simulate(dark))

    values = {source["name"]: source["values"] for source in about["sources"]}
    assert values["read"] == pytest.approx(7.0)
    assert "photon_shot" not in values


def test_mtf_curves_have_closed_forms(engine, settings):
    about, arrays = PARTS["mtf"].make(engine.simulate(settings))
    curves = {curve["label"]: (arrays[f"x-{k}"], arrays[f"y-{k}"]) for k, curve in enumerate(about["curves"])}
    frequency_per_mm, site = curves["median site"]

    assert np.allclose(site, np.abs(np.sinc(frequency_per_mm * 0.012)), atol=1e-5)
    x, lens = curves["lens, 550 nm"]
    s = x * 0.55e-3 * 2.8 * 1000 / (1000 - 8)
    assert np.allclose(lens, 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s)), atol=2e-3)


def test_spectrum_is_response_per_photon(engine, settings):
    about, arrays = PARTS["spectrum"].make(engine.simulate(settings))

    assert [curve["label"] for curve in about["curves"]] == ["R", "G", "B"]
    assert 0.3 < max(arrays[f"y-{k}"].max() for k in range(3)) <= 0.6 + 1e-6


def test_rules_list_violations(engine, settings):
    good = PARTS["rules"].make(engine.simulate(settings))[0]
    bad = PARTS["rules"].make(engine.simulate(with_value(settings, "layout.rules.min_size_um", 13.0)))[0]
    none = PARTS["rules"].make(engine.simulate(with_value(settings, "layout.rules", None)))[0]

    assert good["is_satisfied"]
    assert [rule["count"] for rule in good["rules"]] == [0]
    assert [rule["count"] for rule in bad["rules"]] == [224]
    assert none == {"rules": [], "repairs": []}


def test_summary_contains_numbers_of_capture(engine, settings):
    result = engine.simulate(settings)
    summary = summary_of(result)

    assert summary["n_sites"] == 224
    assert summary["width_um"] == pytest.approx(16 * 12.0)
    assert summary["max_size_um"] == pytest.approx(12.0)
    assert summary["mean_dn"] == result.capture.code.mean()


@pytest.mark.parametrize("axis", ["image", "sensor"])
def test_gaze_keeps_layout_and_scale(engine, settings, axis):
    settings |= {"axis": axis}
    first = engine.simulate(settings)
    moved = engine.simulate(settings | {"gaze_um": [3.25, -7.5]})
    about, other = (PARTS["scene"].make(each)[0] for each in (first, moved))

    assert moved.capture.layout is first.capture.layout
    assert moved.capture.settings["light"]["pitch_um"] == first.capture.settings["light"]["pitch_um"]
    place_um = [np.array(each["position_um"]) - each["bounds_um"][:2] for each in (about, other)]
    assert place_um[1] - place_um[0] == pytest.approx((3.25, -7.5), abs=1e-9)
    assert engine.n_built["images"] == (1 if axis == "image" else 2)
    assert not np.array_equal(moved.capture.code, first.capture.code)
