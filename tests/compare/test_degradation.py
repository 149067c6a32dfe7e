"""A sensor whose sites saturate, or are dead, never has a better result in any metric."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import foveasim as fs
from foveasim.compare.metrics import COMPARED
from foveasim.config import RegionResult, Requirement, Shot
from foveasim.metrics import METRICS, metric_info

OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8)
LAYOUT = fs.layout.grid(n_x=24, n_y=24, pitch_um=2.0)
GOOD_S = 0.02
#: Exposures from none to nearly all sites saturated, and fractions of dead sites.
EXPOSURES_S, DEAD_FRACTIONS = (GOOD_S, 0.2, 0.4, 2.0), (0.0, 0.2, 0.6)


@cache
def scene():
    picture = gaussian_filter(np.random.default_rng(0).random((60, 60)), 2)
    picture = (picture - picture.min()) / np.ptp(picture)
    return fs.Scene.from_picture(picture, fit="cover", distance_m=1.0, illuminance_lux=500.0)


def camera_of(dead_fraction=0.0):
    sensor = fs.Sensor(
        LAYOUT, qe=0.6, capacitance_f=1.5e-16 * LAYOUT.area_um2, read_noise_e=2.0, bits=10, dead_fraction=dead_fraction
    )
    return fs.Camera(optics=OPTICS, sensor=sensor)


@cache
def qualities(dead_fraction, exposure_s):
    """Return all results of a camera, of which higher ones are better."""
    camera = camera_of(dead_fraction)
    compared = fs.compare.cameras(
        {"one": camera, "same": camera}, {"s": scene()}, exposure_s=exposure_s, n_annuli=1, max_pixels=48
    )
    found = {
        name: (-1.0 if metric_info(name).better == "low" else 1.0) * float(np.ravel(compared.values[name][0])[0])
        for name in COMPARED
    }
    shot = Shot(name="s", scene=scene(), camera=camera, rules=None, requested_s=exposure_s, seed=0)
    capture = camera.capture(scene(), exposure_s=exposure_s, seed=0)
    found |= {f"metric snr {key}": value for key, value in METRICS["snr"](shot, camera, capture).items()}
    for name in METRICS:
        info = metric_info(name)
        if info.has_scene and info.is_number and info.better is not None:
            options = {"frequency_per_mm": 50.0} if name == "mtf" else {}
            value = fs.explore.result_of(RegionResult(measure=name, **options), shot, capture)
            found[f"result {name}"] = -value if info.better == "low" else value
    found["snr_by_class"] = float(fs.metrics.snr_by_class(camera, scene(), exposure_s=exposure_s).snr[0])
    return found, capture.saturated_fraction


@pytest.mark.filterwarnings("ignore::foveasim.errors.ExposureWarning")
def test_saturated_sites_improve_no_result():
    worst = [qualities(0.0, exposure_s) for exposure_s in EXPOSURES_S]
    fractions = [fraction for _, fraction in worst]

    assert fractions[0] == 0.0
    assert fractions == sorted(fractions)
    assert fractions[-1] > 0.9
    for name, value in worst[-1][0].items():
        # Measures of layouts are equal.
        assert value <= worst[0][0][name], name
    for name in ("metric snr median", "result snr", "result snr_db"):
        assert worst[-1][0][name] == (-np.inf if name.endswith("_db") else 0.0)


@pytest.mark.slow
def test_dead_sites_improve_no_result():
    found = [qualities(fraction, GOOD_S)[0] for fraction in DEAD_FRACTIONS]

    for fewer, more in pairwise(found):
        for name, value in more.items():
            assert value <= fewer[name] + 1e-12, name


@pytest.mark.filterwarnings("ignore::foveasim.errors.ExposureWarning")
def test_saturated_sites_contribute_no_signal_to_noise():
    """The mean over the sites is that over the unsaturated ones times their fraction."""
    camera = camera_of()
    expected_e = camera.sensor.expected_electrons(camera.photoelectrons_per_s(scene()), EXPOSURES_S[2])
    signals = fs.sensor.signal_to_noise(camera.sensor, expected_e, np.zeros(LAYOUT.n_sites))
    kept = signals.ratio[~signals.is_saturated]

    assert 0 < kept.size < LAYOUT.n_sites
    assert signals.unsaturated_ratio.mean() == pytest.approx(kept.mean() * kept.size / LAYOUT.n_sites)
    assert qualities(0.0, EXPOSURES_S[2])[0]["metric snr mean"] == pytest.approx(signals.unsaturated_ratio.mean())


def test_goal_seek_never_chooses_saturated_frames():
    settings = {
        "scene": {"kind": "flat", "shape": [40, 40], "pitch_um": 400.0, "distance_m": 1.0, "illuminance_lux": 500.0},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
        "layout": {"generator": "grid", "parameters": {"n_x": 12, "n_y": 12, "pitch_um": 3.0}},
        "sensor": {"preset": "machine_vision"},
        "exposure_s": 1.0,
    }
    best = Requirement(measure="snr", at_least=60.0)
    found = fs.explore.solve(settings, "exposure_s", best, bounds=(1e-4, 10.0))
    at = {**settings, "exposure_s": found.value}
    shot = fs.config.build_shot(None, at)

    assert shot.camera.capture(shot.scene, exposure_s=found.value, seed=0).saturated_fraction < 0.05  # shot noise
    with pytest.raises(fs.errors.SimulationError, match="no result"):
        fs.explore.solve(settings, "exposure_s", best, bounds=(1.0, 10.0))
