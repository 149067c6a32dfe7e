"""Exposure times: automatic exposure, fractions and exposure values, in captures, settings files and videos."""

from __future__ import annotations

import pickle
import re
import warnings
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import skimage.data
import yaml
from scipy.special import bdtr

import foveasim as fs
from foveasim.config import build_shot, run_shot
from foveasim.errors import ExposureWarning, ParameterError, SamplingWarning
from foveasim.explore import Dataset
from foveasim.sensor.effects import Collection

LAYOUT = fs.layout.grid(n_x=24, n_y=20, pitch_um=4.0)
ELECTRONICS = {"capacitance_f": 6e-16, "v_sat_v": 3.0, "full_well_e": 1e4, "bits": 12, "read_noise_e": 2.0}
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.0)
PHOTOGRAPH = skimage.data.camera()
SETTINGS = {
    "scene": {"kind": "picture", "picture": "skimage:camera", "distance_m": 1.0, "illuminance_lux": 300.0},
    "optics": {"focal_length_mm": 8.0, "f_number": 2.0},
    "layout": {"generator": "grid", "parameters": {"n_x": 24, "n_y": 20, "pitch_um": 4.0}},
    "sensor": ELECTRONICS,
    "exposure_s": "auto",
}


@dataclass(frozen=True)
class Gates(Collection):
    """Test collection: 5,000 gates, each of which counts at most one photon."""

    name: ClassVar[str] = "gates"
    needs_layout: ClassVar[bool] = False

    n_gates: int = 5000

    def cumulative(self, count, mean, *, sites):
        return bdtr(np.minimum(count, self.n_gates), self.n_gates, -np.expm1(-mean / self.n_gates))

    def moments(self, mean, variance, *, sites):
        dark = np.exp(-mean / self.n_gates)
        return self.n_gates * (1.0 - dark), variance * dark**2 + self.n_gates * dark * (1.0 - dark)


def camera_of(**changes):
    return fs.Camera(optics=OPTICS, sensor=fs.Sensor(LAYOUT, **ELECTRONICS | changes))


def photograph(**light):
    return fs.Scene.from_picture(PHOTOGRAPH, distance_m=1.0, **light or {"illuminance_lux": 300.0})


@pytest.mark.parametrize(("target", "percentile"), [(0.7, 99.0), (0.5, 50.0), (0.3, 90.0)])
def test_percentile_reaches_the_target(target, percentile):
    camera, scene = camera_of(), photograph()
    exposure_s = camera.auto_exposure(scene, target=target, percentile=percentile)
    mean_dn, _ = camera.predict(scene, exposure_s=exposure_s)
    highest_dn = 1e4 * 1.602176634e-19 / 6e-16 / 3.0 * 4096  # the full well

    assert np.percentile(mean_dn, percentile) == pytest.approx(target * highest_dn, rel=2e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {"pedestal_v": 0.4},
        {"companding": "root"},
        {"nonlinearity_fraction": 0.2},
        {"full_well_e": None},
        {"dead_fraction": 0.05, "prnu_fraction": 0.02},
        {"effects": [Gates()]},
    ],
    ids=str,
)
def test_target_is_relative_to_the_range(changes):
    """The range is from the code in the dark to that of a bright light."""
    camera, scene = camera_of(**changes), photograph()
    exposure_s = camera.auto_exposure(scene, percentile=90.0)
    mean_dn, _ = camera.predict(scene, exposure_s=exposure_s)
    sensor = camera.sensor
    dark_dn, bright_dn = (sensor.predict(np.full(LAYOUT.n_sites, e), exposure_s=exposure_s)[0] for e in (0.0, 1e9))
    lives = bright_dn - dark_dn > 0.5
    level = (mean_dn - dark_dn)[lives] / (bright_dn - dark_dn)[lives]

    assert np.percentile(level, 90.0) == pytest.approx(0.7, abs=2e-3)


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_time_is_inverse_to_the_light(factor):
    """A long exposure of a dim scene has more dark signal, here none."""
    camera = camera_of()
    one_s, other_s = (camera.auto_exposure(photograph(illuminance_lux=lux)) for lux in (300.0, 300.0 * factor))

    assert other_s == pytest.approx(one_s / factor, rel=1e-3)


def test_automatic_exposure_is_the_same_everywhere(tmp_path):
    camera, scene = camera_of(), photograph()
    exposure_s = camera.auto_exposure(scene)
    expected = camera.capture(scene, exposure_s=exposure_s, seed=3)
    capture = camera.capture(scene, exposure_s="auto", seed=3)
    frames = list(camera.video([scene, scene], exposure_s="auto", seed=3))
    rolling = next(iter(camera.video([scene, scene], exposure_s="auto", seed=3, frame_s=1.0)))
    shot = build_shot(None, SETTINGS | {"seed": 3})
    result, _ = run_shot(shot, tmp_path)
    dataset = Dataset(
        [PHOTOGRAPH],
        SETTINGS | {"scene": {"kind": "picture", "distance_m": 1.0, "illuminance_lux": 300.0}},
        {},
        fit="cover",
    )
    sample = dataset[0]

    for found in (capture, frames[0], rolling, result.capture):
        assert np.array_equal(found.code, expected.code)
        assert found.settings["exposure_s"] == exposure_s
        assert found.settings["auto_exposure"] == {"target": 0.7, "percentile": 99.0}
    assert result.shot.exposure_s == shot.exposure_s == pickle.loads(pickle.dumps(shot)).exposure_s == exposure_s
    assert "auto_exposure" not in expected.settings
    assert np.percentile(sample["code"], 99.0) == pytest.approx(np.percentile(expected.code, 99.0), rel=0.05)
    for method in (camera.predict, lambda *light, **time: list(camera.noise_budget(*light, **time).values())):
        assert np.array_equal(method(scene, exposure_s="auto")[0], method(scene, exposure_s=exposure_s)[0])


@pytest.mark.parametrize(
    ("text", "expected_s"), [("1/50", 0.02), ("0.5", 0.5), ("1e-3", 1e-3), ("EV 10", 4.0 / 1024), ("ev -1", 8.0)]
)
def test_texts_are_exposure_times(text, expected_s):
    shot = build_shot(None, SETTINGS | {"exposure_s": yaml.safe_load(f"[{text}]")[0]})
    capture = camera_of().capture(photograph(illuminance_lux=1e-6), exposure_s=text, seed=0)

    assert shot.exposure_s == pytest.approx(expected_s, rel=1e-12)
    assert capture.settings["exposure_s"] == pytest.approx(expected_s, rel=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda c: c.capture(photograph(), exposure_s="soon", seed=0),
            "'exposure_s' must be a time in seconds, a fraction",
        ),
        (
            lambda c: c.capture(photograph(), exposure_s="1/0", seed=0),
            "'exposure_s' must be a time in seconds, a fraction",
        ),
        (lambda c: c.capture(photograph(), exposure_s=-1.0, seed=0), "'exposure_s' must be >= 0, got -1"),
        (
            lambda c: c.capture(photograph(illuminance_lux=0.0), exposure_s="auto", seed=0),
            "'exposure_s' must be given: perc",
        ),
        (lambda c: c.auto_exposure(photograph(), target=1.5), r"'target' must be <= 0\.99, got 1\.5"),
    ],
)
def test_impossible_exposures_give_one_line(call, message):
    with pytest.raises(ParameterError, match=message):
        call(camera_of())


def test_unreachable_target_is_named():
    """A full well of 7,000 e- is less than one of 256 codes for 1.87 million electrons."""
    sensor = fs.Sensor.from_preset(LAYOUT, "paper_read_noise", capacitance_f=1e-13)
    with pytest.raises(ParameterError, match="'target' must be a level that the sites reach"):
        sensor.exposure_for(np.full(LAYOUT.n_sites, 1e6))


@pytest.mark.parametrize(
    ("exposure_s", "message"),
    [
        (10.0, r"\d+ % of the photosites are saturated at an exposure of 10 s; use exposure_s=[\d.e-]+, or 'auto'"),
        (1e-9, "more than half of the photosites receive less than one electron or one code at an exposure of 1e-09 s"),
    ],
)
def test_wrong_exposure_warns_once(exposure_s, message):
    camera = camera_of()
    scene = fs.Scene.from_picture(PHOTOGRAPH, distance_m=1.0, illuminance_lux=300.0, gaze_range_um=(1.0, 0.0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        camera.capture(scene, exposure_s=exposure_s, seed=0)
        camera.capture(scene, exposure_s=exposure_s, seed=1, gaze_um=(1.0, 0.0))
        list(camera.video([scene, scene], exposure_s=exposure_s, seed=0))

    (found,) = [each for each in caught if each.category is ExposureWarning]
    assert re.match(message, str(found.message))


def chart_of(**light):
    return fs.Scene.flat(shape=(200, 200), pitch_um=100.0, distance_m=1.0, band_width_nm=50.0, **light)


def test_right_exposures_do_not_warn():
    camera = camera_of()
    dark = chart_of(radiance_w_m2_sr_nm=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera.capture(photograph(), exposure_s="auto", seed=0)
        camera.capture(chart_of(illuminance_lux=1e6), exposure_s="auto", seed=0)
        camera.capture(dark, exposure_s=1.0, seed=0)  # a dark frame
        camera.capture(photograph(), exposure_s=0.0, seed=0)


@pytest.mark.parametrize(
    ("exposure_s", "problem"),
    [
        (1e-9, "all photosites receive less than one electron or one code"),
        (10.0, "100 % of the photosites are saturated"),
    ],
)
def test_charts_without_signal_or_contrast_warn(exposure_s, problem):
    with pytest.warns(ExposureWarning, match=f"{problem} at an exposure of .* use exposure_s="):
        camera_of().capture(chart_of(illuminance_lux=1e3), exposure_s=exposure_s, seed=0)


def test_pixels_wider_than_photosites_warn_once():
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(LAYOUT, **ELECTRONICS))
    coarse = fs.Scene.from_picture(PHOTOGRAPH[::32, ::32], distance_m=1.0, illuminance_lux=300.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for seed in range(2):
            camera.capture(coarse, exposure_s="auto", seed=seed)

    (found,) = [each for each in caught if "smaller than the pixels" in str(each.message)]
    assert found.category is SamplingWarning
    assert str(found.message).startswith("100 % of the photosites are smaller than the pixels of the picture, of ")
