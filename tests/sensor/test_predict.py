"""Prediction of codes against Monte Carlo draws and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants
import scipy.stats

import foveasim as fs
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance, Sensor

SIGMAS = 5.0
N_DRAWS = 2000
ONE_E_PER_CODE = {"bits": 16, "v_sat_v": 3.0, "capacitance_f": 65_536 * scipy.constants.e / 3.0}


def line_of(n):
    return grid(n_x=n, n_y=1, pitch_um=2.0).with_columns(readout_line=np.arange(n) % 7)


def draw_codes(sensor, expected_e, n_draws=N_DRAWS):
    """Simulate codes of many frames, (n_draw, n_site)."""
    return np.stack(
        [
            sensor.read(sensor.collect(expected_e, seed=5, frame=k, n_threads=1), seed=5, frame=k, n_threads=1)
            for k in range(n_draws)
        ]
    ).astype(float)


def assert_agree(sensor, expected_e):
    """Check mean and variance of each site to five standard errors, which are estimated from the draws."""
    mean_dn, variance_dn2 = sensor.predict(expected_e)
    codes = draw_codes(sensor, expected_e)
    mean_error = np.sqrt(variance_dn2 / N_DRAWS) + 1e-3 / np.sqrt(N_DRAWS)
    excess = (codes - codes.mean(axis=0)) ** 2
    # The second term is the error of the sample mean, squared: the only one of a code with two values of probability 1/2.
    variance_error = np.sqrt(np.maximum(excess.var(axis=0), 1e-12) / N_DRAWS) + SIGMAS * variance_dn2 / N_DRAWS

    off_mean = np.abs(codes.mean(axis=0) - mean_dn) / np.maximum(mean_error, 1e-9)
    off_variance = np.abs(codes.var(axis=0) - variance_dn2) / np.maximum(variance_error, 1e-9)
    # With fewer than 50 draws off the mode, the error of the sample variance cannot be estimated.
    modes = np.array([np.bincount(column.astype(int)).argmax() for column in codes.T])
    is_nearly_constant = (codes != modes).sum(axis=0) < 50
    assert off_mean.max() < SIGMAS + 1.0 * is_nearly_constant.any()
    assert off_variance[~is_nearly_constant].max(initial=0.0) < SIGMAS
    assert np.sqrt(np.mean(off_mean[~is_nearly_constant] ** 2)) < 1.5
    assert (~is_nearly_constant).mean() > 0.15


ALL_EFFECTS = {
    "prnu_fraction": 0.02,
    "dark_e_per_s": 30.0,
    "dsnu_fraction": 0.1,
    "ktc_noise": True,
    "read_noise_e": 6.0,
    "rts_fraction": 0.3,
    "rts_e": 40.0,
    "gain_fpn_fraction": 0.02,
    "pixel_fpn_fraction": 0.01,
    "line_fpn_fraction": 0.01,
    "nonlinearity_fraction": 0.03,
    "inl_dn": [0.0, 0.7, -0.4, 0.0],
    "dnl_dn": 0.5,
    "full_well_e": 5000.0,
}
#: Zero, a few electrons, mid-range, near the full well, far above it.
PHOTO_E = np.repeat([0.0, 0.5, 3.0, 40.0, 99.0, 101.0, 900.0, 3000.0, 4950.0, 5100.0, 20_000.0], 7)


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("bits", [4, 8, 12])
@pytest.mark.parametrize("companding", ["linear", "root", "log"])
def test_prediction_with_all_effects_matches_draws(bits, companding):
    sensor = Sensor(
        line_of(PHOTO_E.size), bits=bits, companding=companding, v_sat_v=1.0, capacitance_f=9e-16, **ALL_EFFECTS
    )

    assert_agree(sensor, sensor.expected_electrons(PHOTO_E, 1.0))


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"read_noise_e": 0.3},
        {"read_noise_e": 20.0},
        {"full_well_e": 1000.0},
        {"full_well_e": 1000.0, "read_noise_e": 10.0},
        {"shot_noise": "off", "read_noise_e": 2.0},
        {"shot_noise": "exact"},
        {"dnl_dn": 0.8},
        {"companding": "table", "companding_table": [0.0, 0.7, 1.0], "read_noise_e": 3.0},
        {"inl_dn": [0.0, 3.0, 0.0], "read_noise_e": 3.0},
        {"nonlinearity_fraction": 0.5, "read_noise_e": 3.0},
        {"rts_fraction": 1.0, "rts_e": 30.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("e_per_code", [0.7, 7.3, 60.0])
def test_prediction_with_single_effect_matches_draws(parameters, e_per_code):
    bits = 10
    capacitance_f = e_per_code * 2**bits * scipy.constants.e / 3.0
    sensor = Sensor(line_of(PHOTO_E.size), bits=bits, capacitance_f=capacitance_f, **parameters)

    assert_agree(sensor, sensor.expected_electrons(PHOTO_E, 1.0))


def test_prediction_at_unit_gain_is_poisson():
    mean_e = np.array([0.0, 0.2, 5.0, 80.0, 300.0, 9000.0])
    sensor = Sensor(line_of(6), **ONE_E_PER_CODE)

    mean_dn, variance_dn2 = sensor.predict(mean_e)

    assert mean_dn[:4] == pytest.approx(mean_e[:4], abs=1e-6)
    assert variance_dn2[:4] == pytest.approx(mean_e[:4], abs=1e-4)
    # Gaussian approximation above 100 e-: quantisation lowers the mean by 1/2 and adds a variance of 1/12.
    assert mean_dn[4:] == pytest.approx(mean_e[4:] - 0.5, abs=1e-3)
    assert variance_dn2[4:] == pytest.approx(mean_e[4:] + 1 / 12, abs=1e-2)


def test_clipped_read_noise_matches_censored_moments():
    """In dark frames, half of the read noise is clipped: mean σ/sqrt(2π), second moment σ²/2."""
    sensor = Sensor(line_of(3), read_noise_e=50.0, shot_noise="off", **ONE_E_PER_CODE)

    mean_dn, variance_dn2 = sensor.predict(np.zeros(3))

    # Quantisation lowers the unclipped half by 1/2 DN on average and adds a variance of 1/12.
    unquantised = 50.0 / math.sqrt(2 * math.pi)
    mean, second = unquantised - 0.25, 1250.0 - unquantised + 0.5 / 3.0
    assert mean_dn == pytest.approx(np.full(3, mean), abs=1e-3)
    assert variance_dn2 == pytest.approx(np.full(3, second - mean**2), rel=1e-4)


def test_quantisation_adds_variance_of_one_twelfth():
    charge = np.linspace(2000.0, 2007.0, 71)
    sensor = Sensor(
        line_of(71), bits=12, capacitance_f=7.0 * 4096 * scipy.constants.e / 3.0, read_noise_e=20.0, shot_noise="off"
    )

    _, variance_dn2 = sensor.predict(charge)

    assert variance_dn2 == pytest.approx(np.full(71, (20.0 / 7.0) ** 2 + 1 / 12), rel=1e-3)


def test_prediction_includes_diffusion_and_coupling():
    layout = grid(n_x=9, n_y=9, pitch_um=3.0)
    photo_e = np.full(81, 500.0)
    photo_e[40] = 20_000.0
    sensor = Sensor(
        layout,
        crosstalk=Diffusion(spread_um=0.5),
        coupling=InterPixelCapacitance(neighbour_fraction=0.02),
        read_noise_e=4.0,
        **ONE_E_PER_CODE,
    )
    expected_e = sensor.expected_electrons(photo_e, 1.0)

    assert expected_e.sum() == pytest.approx(photo_e.sum(), rel=1e-12)
    assert expected_e[41] > 600.0
    assert_agree(sensor, expected_e)


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("photo_e", [0.0, 60.0, 1500.0, 4990.0, 5100.0, 12_000.0])
def test_prediction_with_crosstalk_and_all_effects(photo_e):
    layout = grid(n_x=8, n_y=8, pitch_um=3.0)
    sensor = Sensor(
        layout,
        bits=12,
        v_sat_v=1.0,
        capacitance_f=9e-16,
        crosstalk=Diffusion(spread_um=0.5),
        coupling=InterPixelCapacitance(neighbour_fraction=0.01),
        pedestal_v=0.05,
        **ALL_EFFECTS,
    )

    assert_agree(sensor, sensor.expected_electrons(np.linspace(0.7, 1.0, 64) * photo_e, 1.0))


def test_camera_prediction_matches_captures():
    layout = fs.layout.mosaic(fs.layout.hexagonal(n_columns=8, n_rows=8, pitch_um=4.0), ("RG", "GB"))
    scene = fs.Scene.flat(
        shape=(80, 80), pitch_um=60.0, distance_m=1.0, radiance_w_m2_sr_nm=0.01, wavelength_nm=[450.0, 550.0, 620.0]
    )
    sensor = Sensor(layout, filters="rgb", bits=10, capacitance_f=4e-15, read_noise_e=5.0, prnu_fraction=0.02)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    mean_dn, variance_dn2 = camera.predict(scene, exposure_s=0.02)

    frames = np.stack([camera.capture(scene, exposure_s=0.02, seed=1, frame=k).code for k in range(400)]).astype(float)

    off = (frames.mean(axis=0) - mean_dn) / np.sqrt(variance_dn2 / 400)
    assert np.abs(off).max() < SIGMAS
    assert frames.var(axis=0).sum() == pytest.approx(variance_dn2.sum(), rel=0.05)
