"""Results of sensors with collections of a user: each follows from the collection, without further code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.constants
from reference.own_effects import Gates

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.explore.worker_cache import ShotRunner
from foveasim.layout import grid
from foveasim.reconstruct.estimates import estimate_from_code
from foveasim.sensor import InterPixelCapacitance, Sensor, merge_exposures, noise_budget, signal_to_noise
from foveasim.sensor.effects import EFFECTS, Collection

LAYOUT = grid(n_x=60, n_y=50, pitch_um=4.0)
N, N_GATES = LAYOUT.n_sites, 400
#: 1 e- per code with a pedestal, so that noise of the readout is resolved.
ELECTRONICS = {
    "bits": 12, "v_sat_v": 1.0, "capacitance_f": 4096.0 * scipy.constants.e, "pedestal_v": 0.1, "read_noise_e": 3.0,
}  # fmt: skip


EFFECTS.register("gates of results", example={"n_gates": 900})(Gates)


@dataclass(frozen=True)
class DeadTime(Collection):
    """Poisson counts with a mean that a dead time reduces."""

    name = "dead_time"
    needs_exposure = True

    dead_s: float = 1e-5

    def _mean(self, mean, sites):
        return mean / (1.0 + mean * self.dead_s / sites.exposure_s)

    def cumulative(self, count, mean, *, sites):
        return scipy.stats.poisson.cdf(count, self._mean(mean, sites))

    def moments(self, mean, variance, *, sites):
        after = self._mean(mean, sites)
        return after, variance * (after / np.maximum(mean, 1e-300)) ** 4 + after


COLLECTIONS = pytest.mark.parametrize("collection", [Gates(N_GATES), DeadTime()], ids=["gates", "dead_time"])


def sensor_of(collection, **changes):
    return Sensor(LAYOUT, **{**ELECTRONICS, **changes}, effects=[collection])


@pytest.mark.slow(keep=1)
@COLLECTIONS
@pytest.mark.parametrize("coupling", [None, InterPixelCapacitance(neighbour_fraction=0.02)])
def test_prediction_and_model_match_draws(collection, coupling):
    sensor, n_frames = sensor_of(collection, coupling=coupling), 40
    rate = np.full(N, 300.0 / 0.01)
    codes = np.stack([sensor.expose(rate, 0.01, seed=5, frame=k)[2] for k in range(n_frames)]).astype(float)
    inner = np.hypot(*(LAYOUT.centroid_um - LAYOUT.centroid_um.mean(axis=0)).T) < 90.0
    n = n_frames * inner.sum()
    mean_dn, variance_dn2 = sensor.predict(sensor.expected_electrons(rate, 0.01), exposure_s=0.01)
    model = sensor.linearise(photo_e_per_s=rate, exposure_s=0.01)

    drawn = codes[:, inner]
    error = 5.0 * np.sqrt(2.0 / n) * (3.0 if coupling else 1.0)  # neighbours are correlated
    for expected, where in ((variance_dn2, "predict"), (model.variance_dn2(), "linearise")):
        assert drawn.var(axis=0, ddof=1).mean() == pytest.approx(expected[inner].mean(), rel=error), where
    for expected in (mean_dn, model.mean_dn):
        limit = 5.0 * drawn.std() / np.sqrt(n) * (3.0 if coupling else 1.0)
        assert drawn.mean() == pytest.approx(expected[inner].mean(), abs=limit)


@COLLECTIONS
def test_slope_of_model_is_that_of_means(collection):
    sensor = sensor_of(collection)
    rate = np.linspace(1e3, 6e4, N)
    ahead, behind = (
        sensor.predict(sensor.expected_electrons(rate + d, 0.01), exposure_s=0.01)[0] for d in (50.0, -50.0)
    )

    change = sensor.linearise(photo_e_per_s=rate, exposure_s=0.01).forward(np.ones(N), "light")

    assert change == pytest.approx((ahead - behind) / 100.0, rel=1e-3)
    assert change[-1] < 0.99 * change[0]


@COLLECTIONS
def test_budget_sums_to_prediction(collection):
    sensor = sensor_of(collection, dark_e_per_s=2000.0)
    rate = np.linspace(1e3, 6e4, N)
    budget = noise_budget(sensor, rate, 0.01)
    variance_dn2 = sensor.predict(sensor.expected_electrons(rate, 0.01), exposure_s=0.01)[1]

    total_e2 = sum(budget[name] ** 2 for name in budget.temporal)

    assert total_e2 == pytest.approx(variance_dn2, rel=1e-7)  # 1 DN per e-
    assert budget["dark_shot"][0] / budget["photon_shot"][0] == pytest.approx(np.sqrt(2.0))


@COLLECTIONS
def test_signal_to_noise_is_that_of_counts(collection):
    sensor = sensor_of(collection, read_noise_e=0.0)
    found = signal_to_noise(sensor, np.full(N, 200.0), np.zeros(N), exposure_s=0.01)
    mean, variance = collection.moments(np.full(N, 200.0), np.zeros(1), sites=sensor.sites.during(0.01))

    assert found.ratio == pytest.approx(mean / np.sqrt(variance + 1.0 / 12.0), rel=1e-9)


@COLLECTIONS
def test_estimates_and_merges_are_unbiased(collection):
    """Exposures of 0.5 to 2 expected counts per gate, or losses of 20 %."""
    sensor, rate, times_s = sensor_of(collection, pedestal_v=0.0), np.full(N, 2e4), [0.01, 0.02, 0.04]
    codes = np.stack([sensor.expose(rate, t_s, seed=6, frame=k)[2] for k, t_s in enumerate(times_s)])

    merged = merge_exposures(codes, times_s, sensor)

    # Weights contain the square of each charge's own noise: a bias of a fraction of an electron per exposure.
    assert merged.rate_e_per_s.mean() == pytest.approx(2e4, rel=0.003)
    assert merged.sigma_e_per_s.mean() == pytest.approx(merged.rate_e_per_s.std(), rel=0.05)
    for code, t_s in zip(codes, times_s, strict=True):
        found = estimate_from_code(code, sensor, t_s)
        assert found.light_e.mean() == pytest.approx(2e4 * t_s, rel=0.01)
        assert found.variance_e2.mean() == pytest.approx(found.light_e.var(), rel=0.1)


def test_calibrated_merge_follows_gates():
    sensor, rate, times_s = sensor_of(Gates(N_GATES)), np.full(N, 2e4), [0.005, 0.01, 0.02]
    calibration = sensor.calibrate(exposure_s=0.01, flat_e=300.0, n_frames=40, seed=2)
    codes = np.stack([sensor.expose(rate, t_s, seed=6, frame=k)[2] for k, t_s in enumerate(times_s)])

    merged = merge_exposures(codes, [0.01, 0.01, 0.01], sensor, calibration=calibration)
    apart = merge_exposures(codes[1:2], [0.01], sensor, calibration=calibration)

    assert np.nanmean(apart.rate_e_per_s) == pytest.approx(2e4, rel=0.02)
    assert np.isfinite(merged.rate_e_per_s).all()


@pytest.mark.slow
def test_collection_works_in_cameras_and_comparisons():
    def camera(layout, effects):
        return fs.Camera(
            optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=Sensor(layout, **ELECTRONICS, effects=effects)
        )

    cameras = {
        "gates": camera(LAYOUT, [Gates(N_GATES)]),
        "dead": camera(LAYOUT, [DeadTime()]),
        "plain": camera(LAYOUT, []),
    }
    scene = fs.Scene.flat(shape=(64, 64), pitch_um=600.0, distance_m=1.0, radiance_w_m2_sr_nm=0.05, band_width_nm=10.0)
    exposure_s = 300.0 / float(cameras["plain"].photoelectrons_per_s(scene).mean())
    few = grid(n_x=15, n_y=12, pitch_um=4.0)
    compared = {name: camera(few, each.sensor.effects) for name, each in cameras.items()}
    comparison = fs.compare.cameras(compared, {"flat": scene}, exposure_s=exposure_s, max_pixels=32)

    assert np.isfinite(comparison.values["snr_mean_db"]).all()
    for each in cameras.values():
        mean_dn, variance_dn2 = each.predict(scene, exposure_s=exposure_s)
        capture = each.capture(scene, exposure_s=exposure_s, seed=1)
        z = (capture.code - mean_dn) / np.sqrt(variance_dn2)
        assert z.mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(N))
        assert z.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / N))
        assert capture.signal_to_noise(sensor=each.sensor).mean() > 1.0
        assert capture.picture(of="light_e", sensor=each.sensor).data.max() > 0.0


def test_collection_works_in_sweeps_and_video(tmp_path):
    shot = {
        "scene": {"kind": "flat", "radiance_w_m2_sr_nm": 0.02, "shape": [32, 32], "pitch_um": 500.0, "distance_m": 1.0, "band_width_nm": 50.0},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
        "layout": {"generator": "grid", "parameters": {"n_x": 40, "n_y": 40, "pitch_um": 2.0}},
        "sensor": {"capacitance_f": 2e-16, "effects": [{"kind": "gates of results", "n_gates": 200}]},
        "exposure_s": 0.001,
    }  # fmt: skip
    plan = fs.explore.plan_sweep(shot, {"sensor.effects.0.n_gates": [50, 200]}, metrics=["snr"])
    runner = ShotRunner(plan.source, plan.metrics, is_geometry_varied=plan.is_geometry_varied, n_threads=1)
    ratio = [runner.record(k, plan.settings_of(k)).values for k in range(plan.n_points)]

    assert 0.0 < ratio[0]["snr_mean"] < ratio[1]["snr_mean"]
    made = fs.config.build_shot("shot.yaml", shot)
    camera, scene = made.camera, made.scene
    capture = camera.capture(scene, exposure_s=0.001, seed=3)
    (frame,) = camera.video([scene], exposure_s=0.001, seed=3)
    assert np.array_equal(frame.code, capture.code)
    assert capture.electrons.max() <= 200


@pytest.mark.slow
def test_photon_transfer_follows_collection():
    levels_e = [50.0, 200.0, 600.0]
    for collection in (Gates(N_GATES), DeadTime()):
        sensor = sensor_of(collection)
        measured = fs.metrics.photon_transfer(sensor, levels_e, n_frames=16, seed=4, exposure_s=0.01)
        predicted = fs.metrics.predicted_photon_transfer(sensor, levels_e, exposure_s=0.01)

        assert measured.mean_dn == pytest.approx(predicted.mean_dn, rel=0.01)
        assert measured.temporal_variance_dn2 == pytest.approx(predicted.temporal_variance_dn2, rel=0.05)


def test_spikes_reject_other_collections():
    with pytest.raises(ParameterError, match="'sensor' must have shot noise for spikes, got the collection 'gates'"):
        fs.modes.SpikingPixels(sensor_of(Gates(N_GATES)), threshold_e=100.0)
