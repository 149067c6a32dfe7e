"""Metrics of shots and of comparisons: the same values, and own ones."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import foveasim as fs
from foveasim.compare.metrics import ComparedShot, best_cameras
from foveasim.errors import ParameterError, SimulationError
from foveasim.metrics import METRICS, MetricInfo, metric_info
from foveasim.metrics.registry import number_of

#: Metrics that comparisons do not compute on a common field.
SAME = (
    "snr_mean_db", "information_bit_per_site", "information_bit_per_mm2", "shift_sigma_um", "nyquist_per_mm", "mtf50_per_mm",
    "alias_fraction",
)  # fmt: skip


@pytest.fixture(scope="module")
def camera():
    layout = fs.layout.grid(32, 32, 8.0)
    sensor = fs.compare.default_sensor(layout)
    return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(2)
    picture = np.uint8(np.kron(rng.integers(10, 250, (12, 12)), np.ones((8, 8))))
    return fs.compare.photograph_scenes(280.0, pictures={"blocks": picture})["blocks"]


@pytest.fixture(scope="module")
def compared(camera, scene):
    pair = {"one": camera, "other": camera}
    return fs.compare.cameras(
        pair,
        {"blocks": scene},
        exposure_s=0.01,
        max_pixels=64,
        metrics=["snr", "n_sites", "exposure_s", "mean_code_dn"],
    )


def test_metrics_equal_those_of_comparisons(camera, scene, compared):
    capture = camera.capture(scene, exposure_s=0.01, seed=0)
    shot = ComparedShot(scene, camera, 0.01)
    for name in SAME:
        assert number_of(name, shot, camera, capture) == pytest.approx(
            float(np.ravel(compared.values[name])[0]), rel=1e-9
        )


@pytest.mark.parametrize("axis", ["image", "sensor"])
def test_metrics_follow_the_gaze(camera, scene, axis):
    """Camera and comparison agree for a gaze, behind a fixed lens and for a camera that turns."""
    away = camera.with_gaze((8.0, -4.0), axis)
    pair = fs.compare.cameras({"one": away, "other": away}, {"blocks": scene}, exposure_s=0.01, max_pixels=64)
    capture = away.capture(scene, exposure_s=0.01, seed=0)
    for name in SAME:
        value = number_of(name, ComparedShot(scene, away, 0.01), away, capture)
        assert value == pytest.approx(float(np.ravel(pair.values[name])[0]), rel=1e-9), name


def test_further_metrics_are_by_annulus(camera, scene, compared):
    capture = camera.capture(scene, exposure_s=0.01, seed=0)
    ratio = capture.signal_to_noise()
    edges_um, r_um = compared.edges_um, np.hypot(*camera.layout.centroid_um.T)
    expected = [np.median(ratio[(r_um >= a) & (r_um < b)]) for a, b in itertools.pairwise(edges_um)]

    assert compared.values["snr"].tolist() == [[np.median(ratio)]] * 2
    np.testing.assert_allclose(compared.values["snr_by_eccentricity"][0, 0], expected)
    assert compared.values["n_sites"].tolist() == [camera.layout.n_sites] * 2
    assert compared.values["n_sites_by_eccentricity"][0].sum() == camera.layout.n_sites
    assert np.isnan(compared.values["exposure_s_by_eccentricity"]).all()
    assert "signal-to-noise ratio" in str(compared)
    assert best_cameras(("mean_code_dn",), compared.summary) == [None]  # neither direction is better
    assert {"snr", "n_sites", "n_sites_by_eccentricity"} <= set(compared.to_xarray().variables)


@pytest.mark.parametrize("names", [["snr_dB"], ["requirements"], [3]])
def test_unknown_further_metrics_are_errors(camera, scene, names):
    with pytest.raises(ParameterError, match=r"'metrics.* must be"):
        fs.compare.cameras({"a": camera, "b": camera}, {"x": scene}, exposure_s=0.01, metrics=names)


def test_facts_of_metrics_have_defaults(monkeypatch, camera, scene):
    monkeypatch.setattr(METRICS, "_objects", dict(METRICS._all()))

    @METRICS.register("largest_charge_e")
    def largest(shot, camera, capture):
        """Return the largest charge."""
        return capture.electrons.max()

    METRICS.register("two", lambda shot, camera, capture: {"a": 1.0, "b": 2.0})
    METRICS.register("words", lambda shot, camera, capture: "none", info=MetricInfo(title="words"))
    info = metric_info("largest_charge_e")
    assert (info.title, info.unit) == ("largest charge", "e-")
    assert (info.definition, info.better) == ("the largest charge", None)
    capture = camera.capture(scene, exposure_s=0.01, seed=0)
    shot = ComparedShot(scene, camera, 0.01)
    assert number_of("largest_charge_e", shot, camera, capture) == capture.electrons.max()
    with pytest.raises(SimulationError, match="has several numbers, a, b; register one"):
        number_of("two", shot, camera, capture)
    with pytest.raises(SimulationError, match="must return one number, got str"):
        number_of("words", shot, camera, capture)
    with pytest.raises(ParameterError, match="'annulus_um' must not be given"):
        fs.config.RegionResult(measure="largest_charge_e", annulus_um=(0.0, 1.0))
