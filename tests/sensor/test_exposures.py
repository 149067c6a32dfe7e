"""Merged exposures and ramp fits against simulated rates and theoretical variances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import scipy.constants

from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import (
    Calibration,
    InterPixelCapacitance,
    Sensor,
    calibrate,
    fit_ramp,
    merge_exposures,
    noise_budget,
    non_destructive_reads,
)
from foveasim.sensor.effects import AdditiveNoise, Effect

SIGMAS = 5.0
N = 20_000
ROW = grid(n_x=200, n_y=100, pitch_um=2.0)
E_PER_DN = 2.5
#: 12 bits, 2.5 electrons per code; read noise exceeds the code width, so that rounding errors are uniform.
SENSOR = {"bits": 12, "v_sat_v": 1.0, "capacitance_f": E_PER_DN * 4096 * scipy.constants.e, "read_noise_e": 6.0}
FULL_E = 4095 * E_PER_DN
EXPOSURES_S = [1e-3, 0.03, 1.0]
PEDESTAL_DN = 20.0


def pedestal_calibration(n_sites=N):
    """Return a calibration of a device with an offset of 20 codes and no other fixed pattern."""
    dark = np.full((2, n_sites), PEDESTAL_DN - 0.5)
    return Calibration.from_frames(dark, dark[:1] + 100.0, highest_dn=4095)


def simulate_exposures(rate_e_per_s, exposures_s, seed, n_sites=N, full_well_e=math.inf):
    """Simulate codes of Poisson charges with Gaussian read noise on a pedestal, with numpy only."""
    rng = np.random.default_rng(seed)
    codes = []
    for t_s in exposures_s:
        charge_e = np.minimum(rng.poisson(rate_e_per_s * t_s, n_sites), full_well_e) + rng.normal(0.0, 6.0, n_sites)
        codes.append(np.clip(np.floor(charge_e / E_PER_DN + PEDESTAL_DN), 0, 4095))
    return np.array(codes)


# -- HDR merge --------------------------------------------------------------------------------------------------------


def test_merge_without_noise_recovers_rate_exactly():
    """Non-integer codes, as from an ADC without quantisation; in the taper, the bias correction causes small deviations."""
    rate = np.geomspace(2e3, 1e7, 200)
    code = np.minimum(rate * np.array(EXPOSURES_S)[:, None] / E_PER_DN - 0.5, 4095.0)
    sensor = Sensor(ROW[:200], **{**SENSOR, "shot_noise": "off", "read_noise_e": 0.0})

    merged = merge_exposures(code, EXPOSURES_S, sensor)

    is_tapered = ((code > 3000.0) & (code < 4095.0)).any(axis=0)
    assert merged.rate_e_per_s[~is_tapered] == pytest.approx(rate[~is_tapered], rel=1e-12)
    assert merged.rate_e_per_s == pytest.approx(rate, rel=1e-4)
    assert set(merged.n_used) == {1, 2, 3}


@pytest.mark.parametrize("companding", ["linear", "root", "log"])
def test_merge_without_noise_is_within_rounding(companding):
    """Rounding errors are at most 1/2: 2.5 standard deviations in one exposure, at most 4.3 in three exposures together."""
    rate = np.geomspace(100.0, 1e7, 200)
    sensor = Sensor(ROW[:200], **{**SENSOR, "companding": companding, "shot_noise": "off", "read_noise_e": 0.0})
    charge_e = np.array([np.rint(rate * t_s).astype(np.int64) for t_s in EXPOSURES_S])
    code = np.array([sensor.read(row, seed=0) for row in charge_e])

    merged = merge_exposures(code, EXPOSURES_S, sensor)

    assert merged.n_used.min() >= 1
    assert np.abs((merged.rate_e_per_s - rate) / merged.sigma_e_per_s).max() < 4.3
    assert np.abs(merged.rate_e_per_s / rate - 1.0).max() < 0.02


@pytest.mark.parametrize("rate_e_per_s", [30.0, 300.0, 3e3, 9.5e3, 1.05e4, 3e4, 3.2e5, 3e6])
def test_merge_is_unbiased_with_predicted_variance(rate_e_per_s):
    sensor = Sensor(ROW, **SENSOR)

    merged = merge_exposures(
        simulate_exposures(rate_e_per_s, EXPOSURES_S, 1), EXPOSURES_S, sensor, calibration=pedestal_calibration()
    )

    rate, sigma = merged.rate_e_per_s, merged.sigma_e_per_s
    variance = np.mean(sigma**2)
    assert np.isfinite(rate).all()
    assert rate.mean() == pytest.approx(rate_e_per_s, abs=SIGMAS * math.sqrt(variance / N))
    assert rate.var() == pytest.approx(variance, rel=SIGMAS * math.sqrt(2.0 / N))


@pytest.mark.parametrize("fraction", [0.72, 0.76, 0.8, 0.9, 0.97, 0.99, 1.0, 1.01, 1.03])
def test_merge_is_unbiased_near_saturation(fraction):
    """Using exposures whenever their codes are below saturation would give a bias of 13 standard errors."""
    rate_e_per_s = fraction * (4095 - PEDESTAL_DN) * E_PER_DN

    merged = merge_exposures(
        simulate_exposures(rate_e_per_s, EXPOSURES_S, 11),
        EXPOSURES_S,
        Sensor(ROW, **SENSOR),
        calibration=pedestal_calibration(),
    )

    variance = np.mean(merged.sigma_e_per_s**2)
    assert merged.rate_e_per_s.mean() == pytest.approx(rate_e_per_s, abs=SIGMAS * math.sqrt(variance / N))
    assert 0.65 < merged.rate_e_per_s.var() / variance < 1.0 + SIGMAS * math.sqrt(2.0 / N)


def test_merge_variance_is_inverse_variance_sum():
    """Closed form for two exposures below saturation: the inverse of the sum of inverse variances."""
    sensor = Sensor(ROW, **SENSOR)
    rate, exposures_s = 2000.0, [0.2, 1.0]

    merged = merge_exposures(
        simulate_exposures(rate, exposures_s, 2), exposures_s, sensor, calibration=pedestal_calibration()
    )

    fixed_e2 = 36.0 + E_PER_DN**2 / 12
    information = sum(t_s**2 / (rate * t_s + fixed_e2) for t_s in exposures_s)
    assert (merged.n_used == 2).all()
    assert np.mean(merged.sigma_e_per_s**2) == pytest.approx(1 / information, rel=1e-3)
    assert merged.rate_e_per_s.var() == pytest.approx(1 / information, rel=SIGMAS * math.sqrt(2.0 / N))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_merge_ignores_saturated_codes(order):
    """With saturated longer exposures, the result equals that of the shortest exposure alone."""
    sensor = Sensor(ROW, **SENSOR)
    exposures_s = [1e-3, 0.1, 1.0]
    codes = simulate_exposures(2e6, exposures_s, 3)
    assert (codes[1:] == 4095).all()

    merged = merge_exposures(
        codes[list(order)], [exposures_s[k] for k in order], sensor, calibration=pedestal_calibration()
    )
    alone = merge_exposures(codes[:1], exposures_s[:1], sensor, calibration=pedestal_calibration())

    assert (merged.n_used == 1).all()
    assert merged.rate_e_per_s == pytest.approx(alone.rate_e_per_s, rel=1e-12)


def test_full_well_below_highest_code_saturates():
    sensor = Sensor(ROW, full_well_e=4000.0, **SENSOR)
    codes = simulate_exposures(1e5, [0.01, 0.1], 4, full_well_e=4000.0)
    assert codes.max() < 4095

    merged = merge_exposures(codes, [0.01, 0.1], sensor)

    assert (merged.n_used == 1).all()


def test_fully_saturated_sites_are_nan():
    merged = merge_exposures(np.full((2, 3), 4095), [0.1, 1.0], Sensor(ROW[:3], **SENSOR))

    assert np.isnan(merged.rate_e_per_s).all()
    assert np.isnan(merged.sigma_e_per_s).all()
    assert merged.n_used.tolist() == [0, 0, 0]


def test_noisy_short_exposure_does_not_bias_merge():
    """The read noise of the shortest exposure, scaled to the longest, is ten times the range."""
    sensor = Sensor(ROW, **SENSOR)
    exposures_s = [1e-4, 1.0]

    merged = merge_exposures(
        simulate_exposures(50.0, exposures_s, 5), exposures_s, sensor, calibration=pedestal_calibration()
    )

    assert (merged.n_used == 2).all()
    assert merged.rate_e_per_s.mean() == pytest.approx(50.0, abs=SIGMAS * math.sqrt((50.0 + 37.0) / N))


def test_calibration_removes_fixed_patterns_from_merge():
    """Uses all fixed patterns of the sensor chain."""
    sensor = Sensor(
        ROW,
        prnu_fraction=0.02,
        gain_fpn_fraction=0.01,
        pixel_fpn_fraction=0.002,
        dark_e_per_s=2000.0,
        dsnu_fraction=0.1,
        **SENSOR,
    )
    calibration = calibrate(sensor, exposure_s=0.1, flat_e=5000.0, n_frames=200, seed=1, long_exposure_s=0.4)
    exposures_s, rate = [0.05, 0.2], 2e4
    codes = []
    for k, t_s in enumerate(exposures_s):
        expected_e = sensor.expected_electrons(np.full(N, rate), t_s)
        codes.append(sensor.read(sensor.collect(expected_e, seed=9, frame=k), seed=9, frame=k))
    is_usable = ~calibration.clipped

    merged = merge_exposures(codes, exposures_s, sensor, calibration=calibration)

    off = (merged.rate_e_per_s - rate)[is_usable]
    assert is_usable.mean() > 0.9
    assert abs(off.mean()) < 2e-3 * rate
    # Errors of the calibration add a few percent to the variance.
    assert off.var() == pytest.approx(np.mean(merged.sigma_e_per_s[is_usable] ** 2), rel=0.1)


# -- ramps ------------------------------------------------------------------------------------------------------------

TIMES_S = [0.5, 1.0, 1.5, 2.5, 3.0, 4.0]


@pytest.mark.parametrize(("rate_e_per_s", "shot_noise"), [(15.0, "auto"), (15.0, "exact"), (900.0, "auto")])
def test_ramp_charge_covariance_has_uncorrelated_increments(rate_e_per_s, shot_noise):
    sensor = Sensor(ROW, shot_noise=shot_noise, **SENSOR)
    times = np.array(TIMES_S)

    electrons = non_destructive_reads(sensor, rate_e_per_s, times, seed=1).electrons.astype(float)

    covariance = np.cov(electrons)
    expected = rate_e_per_s * np.minimum(times[:, None], times)
    variance = np.diag(expected)
    # Standard error of the sample covariance of nearly Gaussian numbers; the Poisson kurtosis adds the mean.
    error = np.sqrt((np.outer(variance, variance) + expected**2 + expected) / N)
    assert np.abs((covariance - expected) / error).max() < SIGMAS
    increments = np.diff(electrons, axis=0, prepend=0.0)
    correlation = np.corrcoef(increments)
    assert np.abs(correlation[~np.eye(len(times), dtype=bool)]).max() < SIGMAS / math.sqrt(N)
    assert increments.min() >= 0.0
    assert electrons.mean(axis=1) == pytest.approx(
        rate_e_per_s * times, abs=SIGMAS * math.sqrt(rate_e_per_s * times[-1] / N)
    )


def test_read_noise_varies_and_reset_noise_persists():
    sensor = Sensor(
        ROW,
        bits=16,
        v_sat_v=1.0,
        capacitance_f=65_536 * scipy.constants.e,
        shot_noise="off",
        ktc_noise=True,
        read_noise_e=6.0,
    )
    reset_e = float(noise_budget(sensor, np.zeros(N), 0.0)["reset"][0])

    code = non_destructive_reads(sensor, 8000.0, TIMES_S, seed=2).code.astype(float)

    covariance = np.cov(code)
    expected = reset_e**2 + np.eye(len(TIMES_S)) * (36.0 + 1 / 12)
    assert np.abs(covariance / expected - 1.0).max() < SIGMAS * math.sqrt(2.0 / N)
    increments = np.diff(code, axis=0)
    assert np.cov(increments)[0, 0] == pytest.approx(72.0 + 2 / 12, rel=SIGMAS * math.sqrt(2.0 / N))
    assert np.cov(increments)[0, 1] == pytest.approx(-36.0 - 1 / 12, abs=SIGMAS * 72.0 * math.sqrt(1.25 / N))


def test_ramp_includes_full_well_and_dark_signal():
    sensor = Sensor(ROW[:3], shot_noise="off", full_well_e=[100.5, 1e4, 1e4], dark_e_per_s=[0.0, 0.0, 50.0])

    ramp = non_destructive_reads(sensor, [60.0, 60.0, 0.3], [1.0, 2.0, 3.0], seed=0)

    assert ramp.electrons.tolist() == [[60, 60, 50], [100, 120, 101], [100, 180, 151]]


def test_ramp_is_reproducible_from_seed_and_frame():
    sensor = Sensor(ROW, **SENSOR)
    code = non_destructive_reads(sensor, 300.0, TIMES_S, seed=3, frame=1, n_threads=1).code

    assert np.array_equal(code, non_destructive_reads(sensor, 300.0, TIMES_S, seed=3, frame=1).code)
    longer = non_destructive_reads(sensor, 300.0, [*TIMES_S, 9.0], seed=3, frame=1).code
    assert np.array_equal(code, longer[:-1])
    assert (code != non_destructive_reads(sensor, 300.0, TIMES_S, seed=3, frame=2).code).mean() > 0.5


def simulate_ramps(rate_e_per_s, times_s, seed):
    """Simulate codes of ramps on a pedestal, with numpy only."""
    rng = np.random.default_rng(seed)
    steps_s = np.diff(times_s, prepend=0.0)
    charge_e = rng.poisson(rate_e_per_s * steps_s[:, None], (steps_s.size, N)).cumsum(axis=0)
    codes = (charge_e + rng.normal(0.0, 6.0, charge_e.shape)) / E_PER_DN + PEDESTAL_DN
    return np.clip(np.floor(codes), 0, 4095)


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("rate_e_per_s", [0.0, 3.0, 30.0, 300.0, 2000.0])
def test_ramp_slope_matches_generalised_least_squares(rate_e_per_s):
    """The reference inverts the covariance matrix of the reads, with a free offset."""
    sensor = Sensor(ROW, **SENSOR)
    times = np.array(TIMES_S)
    code = simulate_ramps(rate_e_per_s, times, 4)

    fit = fit_ramp(code, times, sensor, weight_rate_e_per_s=rate_e_per_s)
    own = fit_ramp(code, times, sensor)

    noise_e2 = 36.0 + E_PER_DN**2 / 12
    covariance = rate_e_per_s * np.minimum(times[:, None], times) + noise_e2 * np.eye(times.size)
    design = np.stack([np.ones(times.size), times], axis=1)
    inverse = np.linalg.inv(covariance)
    normal = np.linalg.inv(design.T @ inverse @ design)
    reference = (normal @ design.T @ inverse @ ((code - PEDESTAL_DN + 0.5) * E_PER_DN))[1]
    sigma = math.sqrt(normal[1, 1])
    assert fit.sigma_e_per_s == pytest.approx(np.full(N, sigma), rel=1e-9)
    assert fit.rate_e_per_s == pytest.approx(reference, rel=1e-9, abs=1e-9)
    assert fit.rate_e_per_s.mean() == pytest.approx(rate_e_per_s, abs=SIGMAS * sigma / math.sqrt(N))
    assert fit.rate_e_per_s.var() == pytest.approx(sigma**2, rel=SIGMAS * math.sqrt(2.0 / N))
    # Weights from each site's own rate: bias below half an electron per ramp.
    assert own.rate_e_per_s.mean() == pytest.approx(rate_e_per_s, abs=0.5 / times[-1] + SIGMAS * sigma / math.sqrt(N))
    assert own.rate_e_per_s.var() == pytest.approx(sigma**2, rel=0.08)


def test_ramp_fit_ignores_reads_after_saturation():
    sensor = Sensor(ROW, **SENSOR)
    times = np.arange(1.0, 9.0)
    code = simulate_ramps(2000.0, times, 5)
    n_below = (code < 4095).sum(axis=0)

    fit = fit_ramp(code, times, sensor)
    first_five = fit_ramp(code[:5], times[:5], sensor)
    code[6:] = 4095
    assert n_below.max() < 8

    assert np.array_equal(fit.n_used, n_below)
    is_five = n_below == 5
    assert is_five.sum() > 1000
    assert fit.rate_e_per_s[is_five] == pytest.approx(first_five.rate_e_per_s[is_five], rel=1e-12)


def test_ramp_slope_is_unbiased_at_saturation_onset():
    rate_e_per_s, times = 2037.0, np.arange(1.0, 9.0)

    fit = fit_ramp(simulate_ramps(rate_e_per_s, times, 7), times, Sensor(ROW, **SENSOR))

    assert np.bincount(fit.n_used)[[4, 5]].min() > 0.4 * N
    sigma = fit.rate_e_per_s.std()
    assert fit.rate_e_per_s.mean() == pytest.approx(rate_e_per_s, abs=SIGMAS * sigma / math.sqrt(N))


def test_single_usable_read_gives_nan_slope():
    code = np.array([[100, 4095], [4095, 4095], [200, 4095]])

    fit = fit_ramp(code, [1.0, 2.0, 3.0], Sensor(ROW[:2], **SENSOR))

    assert np.isnan(fit.rate_e_per_s).all()
    assert fit.n_used.tolist() == [1, 0]


def test_simulated_ramp_slope_includes_dark_signal():
    sensor = Sensor(ROW, dark_e_per_s=100.0, ktc_noise=True, cds=False, **{**SENSOR, "v_sat_v": 4.0, "bits": 14})
    times = np.linspace(0.2, 4.0, 12)

    fit = fit_ramp(non_destructive_reads(sensor, 900.0, times, seed=6).code, times, sensor)

    variance = np.mean(fit.sigma_e_per_s**2)
    assert fit.rate_e_per_s.mean() == pytest.approx(1000.0, abs=SIGMAS * math.sqrt(variance / N) + 0.1)
    assert fit.rate_e_per_s.var() == pytest.approx(variance, rel=SIGMAS * math.sqrt(2.0 / N) + 0.01)


# -- effects in ramps -------------------------------------------------------------------------------------------------

#: Readings without noise other than those under test: 16 bits, 1 e- per code.
EXACT = {
    "bits": 16,
    "v_sat_v": 1.0,
    "capacitance_f": 65_536 * scipy.constants.e,
    "shot_noise": "off",
    "pedestal_v": 0.2,
}
RESET_E = math.sqrt(scipy.constants.k * 300.0 * EXACT["capacitance_f"]) / scipy.constants.e


@dataclass(frozen=True)
class NodeReset(AdditiveNoise):
    """Test effect: voltage noise of the reset of a sense node."""

    name: ClassVar[str] = "node_reset"
    stage: ClassVar[str] = "sense_node"
    is_drawn_at_reset: ClassVar[bool] = True

    sigma_v: float = 0.01

    def deviation(self, sites):
        return self.sigma_v


@dataclass(frozen=True)
class ResetGain(Effect):
    """Test effect: a factor on the output voltage that is drawn at the reset."""

    name: ClassVar[str] = "reset_gain"
    stage: ClassVar[str] = "output"
    is_temporal: ClassVar[bool] = True
    is_drawn_at_reset: ClassVar[bool] = True

    def apply(self, values, *, sites, rng):
        return values * (1.0 + 0.1 * rng.standard_normal(values.size))

    def moments(self, mean, variance, *, sites):
        return mean, variance * 1.01 + 0.01 * mean**2


@dataclass(frozen=True)
class Saturation(Effect):
    """Test effect: expected charge that saturates at 1000 e-."""

    name: ClassVar[str] = "saturation"
    stage: ClassVar[str] = "expected"
    is_temporal: ClassVar[bool] = False

    sign: float = 1.0

    def apply(self, values, *, sites, rng):
        return values / (1.0 + self.sign * values / 1000.0)

    def moments(self, mean, variance, *, sites):
        return mean / (1.0 + self.sign * mean / 1000.0), variance


def neighbour_correlation(values):
    """Return the correlation of horizontal neighbours."""
    rows = values.reshape(100, 200) - values.mean()
    return np.mean(rows[:, 1:] * rows[:, :-1]) / np.mean(rows**2)


@pytest.mark.parametrize("neighbour_fraction", [0.0, 0.1])
def test_reset_noise_of_ramp_follows_coupling(neighbour_fraction):
    """Inter-pixel capacitance precedes reset noise, which remains independent between sites."""
    coupling = InterPixelCapacitance(neighbour_fraction=neighbour_fraction)
    sensor = Sensor(ROW, **EXACT, ktc_noise=True, coupling=coupling)

    code = non_destructive_reads(sensor, 5000.0, [1.0, 2.0], seed=3).code.astype(float)

    for read in code:
        assert read.var() == pytest.approx(RESET_E**2 + 1.0 / 12.0, rel=SIGMAS * math.sqrt(2.0 / N))
        assert abs(neighbour_correlation(read)) < SIGMAS / math.sqrt(N)
    assert np.abs(code[1] - code[0] - 5000.0).max() <= 1.0


def test_reset_noise_acts_at_its_stage():
    sensor = Sensor(ROW, **EXACT, effects=[NodeReset()])

    code = non_destructive_reads(sensor, 5000.0, [1.0, 2.0], seed=3).code.astype(float)

    assert code[0].std() == pytest.approx(0.01 * 65_536, rel=SIGMAS * math.sqrt(0.5 / N))
    assert np.abs(code[1] - code[0] - 5000.0).max() <= 1.0


def test_factor_of_reset_is_common():
    sensor = Sensor(ROW, **EXACT | {"pedestal_v": 0.0}, effects=[ResetGain()])

    code = non_destructive_reads(sensor, 10_000.0, [1.0, 2.0], seed=3).code.astype(float)

    assert code[0].std() == pytest.approx(1000.0, rel=SIGMAS * math.sqrt(0.5 / N))
    assert np.abs(code[1] - 2.0 * code[0]).max() <= 2.0


@pytest.mark.parametrize("shot_noise", ["off", "auto"])
def test_reads_have_expected_charge_of_exposures(shot_noise):
    sensor = Sensor(ROW, **EXACT | {"shot_noise": shot_noise}, effects=[Saturation()])
    times = np.array([0.01, 0.1, 10.0])
    expected_e = 1e4 * times / (1.0 + 1e4 * times / 1000.0)

    electrons = non_destructive_reads(sensor, 1e4, times, seed=3).electrons

    if shot_noise == "off":
        assert np.array_equal(electrons, np.rint(np.broadcast_to(expected_e, (N, 3)).T))
        return
    assert electrons.mean(axis=1) == pytest.approx(expected_e, abs=SIGMAS * math.sqrt(expected_e.max() / N))
    covariance = np.minimum(expected_e[:, None], expected_e)
    error = np.sqrt((np.outer(expected_e, expected_e) + covariance**2 + covariance) / N)
    assert np.abs((np.cov(electrons) - covariance) / error).max() < SIGMAS


def test_decreasing_expected_charge_is_rejected():
    sensor = Sensor(ROW[:3], effects=[Saturation(sign=-0.9)])

    with pytest.raises(
        SimulationError, match=r"the expected charge of site 0 decreases from 1000 to .* at 3 s; effects at"
    ):
        non_destructive_reads(sensor, 1000.0 / 1.9, [1.0, 3.0], seed=0)


def test_ramp_noise_excludes_reset_noise():
    """Noise that is drawn at the reset cancels in the slope, at every stage."""
    sensor = Sensor(ROW, **EXACT | {"shot_noise": "auto"}, ktc_noise=True, effects=[NodeReset()], read_noise_e=5.0)
    times = np.linspace(0.5, 4.0, 8)

    fit = fit_ramp(non_destructive_reads(sensor, 500.0, times, seed=5).code, times, sensor)

    sigma = math.sqrt(np.mean(fit.sigma_e_per_s**2))
    assert sigma == pytest.approx(fit_ramp_sigma(500.0, times, 25.0 + 1.0 / 12.0), rel=1e-3)
    assert fit.rate_e_per_s.std() == pytest.approx(sigma, rel=SIGMAS * math.sqrt(0.5 / N) + 1e-3)


def fit_ramp_sigma(rate_e_per_s, times, noise_e2, shot_factor=1.0):
    """Return the standard deviation of the least-squares slope, from the covariance matrix of the reads."""
    shot = shot_factor * rate_e_per_s * np.minimum(times[:, None], times)
    design = np.stack([np.ones(times.size), times], axis=1)
    inverse = np.linalg.inv(shot + noise_e2 * np.eye(times.size))
    return math.sqrt(np.linalg.inv(design.T @ inverse @ design)[1, 1])


def inside(n_x=200, n_y=100):
    """Return whether sites are not at the boundary."""
    y, x = np.divmod(np.arange(n_x * n_y), n_x)
    return (x > 0) & (x < n_x - 1) & (y > 0) & (y < n_y - 1)


@pytest.mark.parametrize("fraction", [0.02, 0.1])
def test_ramp_noise_includes_coupling(fraction):
    """Four neighbours reduce the shot noise by ``(1 - 4 a)² + 4 a²``."""
    coupling = InterPixelCapacitance(neighbour_fraction=fraction)
    sensor = Sensor(ROW, **EXACT | {"shot_noise": "auto"}, coupling=coupling, read_noise_e=5.0)
    times = np.linspace(0.5, 4.0, 8)

    fit = fit_ramp(non_destructive_reads(sensor, 4000.0, times, seed=5).code, times, sensor)

    kernel = np.array([[0.0, fraction, 0.0], [fraction, 1.0 - 4.0 * fraction, fraction], [0.0, fraction, 0.0]])
    is_inside = inside()
    sigma = math.sqrt(np.mean(fit.sigma_e_per_s[is_inside] ** 2))
    assert sigma == pytest.approx(fit_ramp_sigma(4000.0, times, 25.0 + 1.0 / 12.0, np.sum(kernel**2)), rel=2e-3)
    correlation = scipy.signal.correlate2d(kernel, kernel) / np.sum(kernel**2)
    error = math.sqrt(0.5 * np.sum(correlation**2) / is_inside.sum())
    assert fit.rate_e_per_s[is_inside].std() == pytest.approx(sigma, rel=SIGMAS * error)


@pytest.mark.parametrize("estimate", ["ramp", "merge"])
def test_coupled_noise_agrees_next_to_bright_sites(estimate):
    """A neighbour of a bright site has a fraction of its charge, and the square of this fraction of its shot noise."""
    y, x = np.divmod(np.arange(N), 200)
    is_bright, is_next = (x % 4 == 1) & (y % 4 == 1), (x % 4 == 0) & (y % 4 == 1)
    rate = np.where(is_bright, 20_000.0, 100.0)
    coupling = InterPixelCapacitance(neighbour_fraction=0.03)
    sensor = Sensor(ROW, **EXACT | {"shot_noise": "auto", "pedestal_v": 0.0}, coupling=coupling, read_noise_e=3.0)
    if estimate == "ramp":
        times = np.linspace(0.25, 2.0, 8)
        found = fit_ramp(non_destructive_reads(sensor, rate, times, seed=5).code, times, sensor)
    else:
        exposures_s = [0.5, 1.0, 2.0]
        codes = [sensor.expose(rate, t_s, seed=6, frame=k)[2] for k, t_s in enumerate(exposures_s)]
        found = merge_exposures(codes, exposures_s, sensor)

    for chosen in (is_bright & inside(), is_next & inside()):
        ratio = found.rate_e_per_s[chosen].std() / math.sqrt(np.mean(found.sigma_e_per_s[chosen] ** 2))
        assert ratio == pytest.approx(1.0, abs=SIGMAS * math.sqrt(0.5 / chosen.sum()))


# -- random telegraph noise -------------------------------------------------------------------------------------------

#: Charges of 1,000 to 4,000 e-, far from both ends of the range.
RTS_RATE_E_PER_S, RTS_TIMES_S = 2e4, [0.05, 0.1, 0.2]


def assert_drawn_as_predicted(found, n_sites=N):
    """Check the standard deviation over sites to five standard errors."""
    sigma = np.broadcast_to(found.sigma_e_per_s, n_sites)
    spread = (found.rate_e_per_s - RTS_RATE_E_PER_S) / sigma
    assert spread.std() == pytest.approx(1.0, abs=SIGMAS / math.sqrt(2.0 * n_sites) + 1e-3)


def sensor_exposures(sensor):
    """Simulate codes of several exposures with the sensor."""
    rows = []
    for frame, t_s in enumerate(RTS_TIMES_S):
        electrons = sensor.collect(np.full(N, RTS_RATE_E_PER_S * t_s), seed=11, frame=frame)
        rows.append(sensor.read(electrons, seed=11, frame=frame))
    return np.stack(rows)


@pytest.mark.parametrize("shot_noise", ["auto", "off"])
@pytest.mark.parametrize("rts_fraction", [1.0, 0.5])
def test_merged_exposures_predict_rts_noise(rts_fraction, shot_noise):
    sensor = Sensor(ROW, **SENSOR, rts_fraction=rts_fraction, rts_e=200.0, shot_noise=shot_noise)
    merged = merge_exposures(sensor_exposures(sensor), RTS_TIMES_S, sensor)

    is_rts = sensor.pattern("rts") > 0.0
    assert_drawn_as_predicted(merged)
    assert merged.sigma_e_per_s[is_rts].min() > 2.0 * merged.sigma_e_per_s[~is_rts].max(initial=0.0)


@pytest.mark.parametrize("rts_fraction", [1.0, 0.5])
def test_ramp_fits_predict_rts_noise(rts_fraction):
    sensor = Sensor(ROW, **SENSOR, rts_fraction=rts_fraction, rts_e=200.0)
    times = np.linspace(0.05, 0.25, 6)
    ramp = non_destructive_reads(sensor, RTS_RATE_E_PER_S, times, seed=12)

    assert_drawn_as_predicted(fit_ramp(ramp.code, times, sensor, weight_rate_e_per_s=RTS_RATE_E_PER_S))


# -- invalid input ----------------------------------------------------------------------------------------------------

FEW = Sensor(grid(n_x=3, n_y=1, pitch_um=2.0), **SENSOR)
CODE = np.full((2, 3), 100)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: merge_exposures(CODE, [0.1], FEW), r"'code' must have one row per exposure and one column per site"),
        (lambda: merge_exposures(CODE, [0.1, 0.0], FEW), "'exposures_s' must be > 0"),
        (lambda: merge_exposures(CODE + 5000, [0.1, 1.0], FEW), "'code' must be <= 4095 everywhere"),
        (lambda: merge_exposures(CODE, [0.1, 1.0], None), "'sensor' must be a"),
        (lambda: merge_exposures(CODE, [0.1, 1e300], FEW), "'exposures_s' must be from .* got 1e\\+300 s at"),
        (lambda: fit_ramp(CODE, [1.0, 1e300], FEW), "'times_s' must be 0, or from .* got 1e\\+300 s at"),
        (
            lambda: fit_ramp(CODE, [1.0, 2.0], FEW, weight_rate_e_per_s=1e300),
            r"'weight_rate_e_per_s' must be from .* to 1e\+15, got 1e\+300 e-/s",
        ),
        (
            lambda: merge_exposures(CODE, [0.1, 1.0], FEW, calibration=pedestal_calibration(7)),
            "'calibration' must be a Calibration",
        ),
        (
            lambda: non_destructive_reads(FEW, 1.0, [1.0, 1.0], seed=0),
            "'times_s' must be one or more strictly increasing times",
        ),
        (
            lambda: non_destructive_reads(FEW, [1.0, 2.0], [1.0], seed=0),
            "'photo_e_per_s' must be one number, or",
        ),
        (lambda: non_destructive_reads(FEW, -1.0, [1.0], seed=0), "'photo_e_per_s' must be >= 0"),
        (lambda: non_destructive_reads(None, 1.0, [1.0], seed=0), "'sensor' must be a"),
        (lambda: fit_ramp(CODE[:1], [1.0], FEW), "'times_s' must have at least two values"),
        (lambda: fit_ramp(CODE, [1.0, 2.0, 3.0], FEW), "'code' must have one row per read"),
        (
            lambda: fit_ramp(CODE, [1.0, 2.0], FEW, weight_rate_e_per_s=[1.0]),
            "'weight_rate_e_per_s' must be one number, or",
        ),
    ],
)
def test_invalid_input_is_rejected(call, message):
    with pytest.raises(ParameterError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_unknown_dark_signal_is_rejected():
    calibration = Calibration.from_frames(np.full((2, 3), 9.0), np.full((1, 3), 99.0), exposure_s=0.1)

    with pytest.raises(SimulationError, match="the dark signal at 1 s is unknown; calibrate with"):
        merge_exposures(CODE, [0.1, 1.0], FEW, calibration=calibration)
