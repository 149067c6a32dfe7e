"""Calibrations against the simulated device, and residual fixed patterns against error propagation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Calibration, Diffusion, InterPixelCapacitance, Sensor, calibrate, linearise

SIGMAS = 5.0
N_X, N_Y = 200, 100
N = N_X * N_Y
MANY = grid(n_x=N_X, n_y=N_Y, pitch_um=2.0).with_columns(readout_line=np.tile(np.arange(N_X), N_Y))
#: 14 bits, 1 electron per code.
FINE = {"bits": 14, "v_sat_v": 1.0, "capacitance_f": 16_384 * scipy.constants.e}
#: All fixed patterns, with a dark signal of 1000 e- in 0.1 s.
FAULTY = {
    "prnu_fraction": 0.02,
    "gain_fpn_fraction": 0.01,
    "pixel_fpn_fraction": 0.005,
    "line_fpn_fraction": 0.005,
    "dark_e_per_s": 1e4,
    "dsnu_fraction": 0.05,
    "read_noise_e": 8.0,
}


def gain_of(sensor):
    return sensor.pattern("gain_fpn") if sensor.gain_fpn_fraction else 1.0


def response_of(sensor, expected_e=1.0):
    """Return the relative response of a device, normalised to mean 1."""
    gain = sensor.response * gain_of(sensor) * expected_e
    return gain / gain.mean()


# -- linear codes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [1, 8, 16])
def test_linearise_linear_codes_is_identity(bits):
    codes = np.arange(2**bits)

    assert linearise(codes, Sensor(MANY[:1], bits=bits)) == pytest.approx(codes, abs=1e-9)


TABLE = [0.0, 0.5, 0.8, 0.8, 1.0]


@pytest.mark.parametrize(
    "parameters",
    [
        {"companding": "root"},
        {"companding": "log", "log_strength": 30.0},
        {"companding": "table", "companding_table": TABLE},
        {"inl_dn": [0.0, 3.0, -2.0, 0.0]},
        {"companding": "root", "inl_dn": [0.0, -2.0, 0.0]},
    ],
    ids=str,
)
def test_linearised_codes_are_voltage_interval_centres(parameters):
    """The reference reads finely spaced charges, and computes the centre of each code's interval."""
    n_charges = 400_000
    row = grid(n_x=1000, n_y=1, pitch_um=2.0)
    sensor = Sensor(row, bits=8, v_sat_v=1.0, capacitance_f=n_charges * scipy.constants.e, **parameters)
    charge = np.arange(n_charges)
    code = np.concatenate([sensor.read(part, seed=0) for part in charge.reshape(-1, 1000)])
    centre_dn = np.array([charge[code == k][[0, -1]].mean() if (code == k).any() else np.nan for k in range(256)])

    off = linearise(np.arange(256), sensor) - (centre_dn * 256 / n_charges - 0.5)

    assert np.isfinite(off).sum() >= 250
    assert np.nanmax(np.abs(off)) < 3 * 256 / n_charges


# -- fixed patterns ---------------------------------------------------------------------------------------------------


def test_offset_and_gain_match_device():
    sensor = Sensor(MANY, **FINE, **FAULTY)
    n_frames = 100

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=n_frames, seed=1)

    offset_dn, _ = sensor.predict(sensor.expected_electrons(np.zeros(N), 0.1))
    noise_dn = math.sqrt(1000.0 + 64.0 + 1 / 12)
    off = (calibration.offset_dn - offset_dn) / (noise_dn / math.sqrt(n_frames))
    assert off.mean() == pytest.approx(0.0, abs=SIGMAS / math.sqrt(N))
    assert off.std() == pytest.approx(1.0, rel=0.04)
    gain_error = math.sqrt((8000.0 + 1000.0 + 128.0) / n_frames) / 7000.0
    off = (calibration.gain - response_of(sensor)) / gain_error
    assert off.mean() == pytest.approx(0.0, abs=SIGMAS / math.sqrt(N))
    assert off.std() == pytest.approx(1.0, rel=0.04)
    assert calibration.read_noise_dn.mean() == pytest.approx(noise_dn, rel=0.01)
    assert calibration.defective.sum() == 0
    assert calibration.clipped.sum() == 0


@pytest.mark.parametrize("n_frames", [4, 16, 64])
def test_residual_fixed_pattern_matches_error_propagation(n_frames):
    """Predicted codes without temporal noise at several levels, against the propagated errors of the calibration."""
    sensor = Sensor(MANY, **FINE, **FAULTY)
    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=n_frames, seed=2)
    dark_dn2, flat_dn2 = 1000.0 + 64.0 + 1 / 12, 8000.0 + 64.0 + 1 / 12

    for fraction in (0.0, 0.5, 1.0, 1.5):
        mean_dn, _ = sensor.predict(sensor.expected_electrons(np.full(N, 7e4 * fraction), 0.1))
        corrected_dn = calibration.correct(mean_dn)

        residual_dn2 = ((1 - fraction) ** 2 * dark_dn2 + fraction**2 * flat_dn2) / n_frames
        # Five standard errors, plus the effect of gain differences of a few percent on the propagated error.
        rel = SIGMAS * math.sqrt(2.0 / N) + 0.01
        assert corrected_dn.var() == pytest.approx(residual_dn2, rel=rel)
        assert corrected_dn.mean() == pytest.approx(7000.0 * fraction, rel=2e-3, abs=1.0)
        assert mean_dn.var() > 5.0 * corrected_dn.var()


def test_dark_rate_extrapolates_offsets():
    sensor = Sensor(MANY, **FINE, **FAULTY)
    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=50, seed=3, long_exposure_s=0.5)

    rate = calibration.dark_rate_dn_per_s
    error = math.sqrt((5064.0 + 1064.0) / 50) / 0.4
    off = (rate - sensor.dark_rate_e_per_s * gain_of(sensor)) / error
    assert off.std() == pytest.approx(1.0, rel=0.04)
    assert off.mean() == pytest.approx(0.0, abs=SIGMAS / math.sqrt(N))
    mean_dn, _ = sensor.predict(sensor.expected_electrons(np.zeros(N), 0.3))
    # Half of each dark signal: (0.25 * 1064 + 0.25 * 5064) / 50.
    corrected_dn = calibration.correct(mean_dn, exposure_s=0.3)
    assert corrected_dn.var() == pytest.approx((1064.0 + 5064.0) / 200, rel=SIGMAS * math.sqrt(2.0 / N) + 0.01)
    assert calibration.offset_at(0.1) is calibration.offset_dn


# -- defects ----------------------------------------------------------------------------------------------------------


def test_injected_hot_and_dead_sites_are_detected():
    """Hot sites with 2000 e- exceed the median by 20 robust standard deviations; dead sites have no response."""
    sensor = Sensor(MANY, **FINE, **FAULTY, hot_fraction=0.005, hot_e_per_s=2e4, dead_fraction=0.005)
    is_hot = sensor.dark_rate_e_per_s > 2e4
    is_dead = sensor.response == 0.0

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=20, seed=4)

    assert is_hot.sum() > 50
    assert is_dead.sum() > 50
    assert np.array_equal(calibration.hot, is_hot)
    assert np.array_equal(calibration.dead, is_dead)
    assert (calibration.noisy & ~is_hot).sum() <= 3
    assert np.median(calibration.gain[~is_dead]) == pytest.approx(1.0, abs=2e-3)


def test_dark_rate_reveals_weak_hot_sites():
    """Offsets with a standard deviation of 80 DN mask 200 e- in the dark frame; an exposure longer by 0.9 s reveals them."""
    parameters = {**FAULTY, "dsnu_fraction": 0.0, "dark_e_per_s": 1e3}
    sensor = Sensor(MANY, **FINE, **parameters, hot_fraction=0.01, hot_e_per_s=2e3)
    is_hot = sensor.dark_rate_e_per_s > 2e3

    short = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=20, seed=5)
    both = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=20, seed=5, long_exposure_s=1.0)

    assert short.hot[is_hot].mean() < 0.2
    assert np.array_equal(both.hot, is_hot)


@pytest.mark.parametrize("n_frames", [3, 30])
def test_rts_sites_are_classified_as_noisy(n_frames):
    sensor = Sensor(MANY, **FINE, dark_e_per_s=1e4, read_noise_e=5.0, rts_fraction=0.01, rts_e=600.0)
    is_noisy = sensor.pattern("rts") > 0.0

    calibration = calibrate(sensor, exposure_s=0.01, flat_e=7000.0, n_frames=n_frames, seed=6)

    assert (calibration.noisy & ~is_noisy).sum() <= 2
    # In three frames, both states occur with a probability of 3/4.
    assert calibration.noisy[is_noisy].mean() > (0.99 if n_frames > 10 else 0.6)


def test_clipped_sites_are_excluded_from_mean_gain():
    dark, flat = np.full((4, 25), 10.0), np.full((4, 25), 110.0)
    dark[2, 4] = 0.0
    flat[1, 7] = 255.0

    calibration = Calibration.from_frames(dark, flat, highest_dn=255)

    assert np.flatnonzero(calibration.clipped).tolist() == [4, 7]
    assert calibration.gain[0] == pytest.approx(1.0, rel=1e-12)
    assert Calibration.from_frames(dark, flat, highest_dn=255, max_clipped_fraction=0.3).clipped.sum() == 0


def test_ideal_sensor_has_no_defects():
    calibration = calibrate(Sensor(MANY, bits=8), exposure_s=0.1, flat_e=5e3, n_frames=4, seed=0)

    assert calibration.defective.sum() == 0
    assert calibration.gain.mean() == pytest.approx(1.0, abs=1e-12)


# -- sites of different design ----------------------------------------------------------------------------------------


def test_expected_size_differences_leave_gain_unchanged():
    """Large sites with triple power and dark signal and double capacitance: neither fixed pattern nor hot sites."""
    is_large = np.arange(N) % 10 == 0
    size = np.where(is_large, 3.0, 1.0)
    sensor = Sensor(
        MANY,
        bits=14,
        v_sat_v=1.0,
        capacitance_f=FINE["capacitance_f"] * np.where(is_large, 2.0, 1.0),
        dark_e_per_s=1e4 * size,
        read_noise_e=8.0,
        prnu_fraction=0.01,
    )

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=3000.0 * size, n_frames=50, seed=7, long_exposure_s=0.2)

    assert calibration.defective.sum() == 0
    for group in (is_large, ~is_large):
        ratio = (calibration.gain / response_of(sensor))[group]
        assert ratio.mean() == pytest.approx(1.0, abs=SIGMAS * ratio.std() / math.sqrt(group.sum()))
    mean_dn, _ = sensor.predict(sensor.expected_electrons(2000.0 * size / 0.1, 0.1))
    corrected_dn = calibration.correct(mean_dn)
    assert corrected_dn[is_large].mean() == pytest.approx(1.5 * 2000.0, rel=1e-3)
    assert corrected_dn[~is_large].mean() == pytest.approx(2000.0, rel=1e-3)


def test_common_expectation_equalises_all_sites():
    rng = np.random.default_rng(0)
    size = rng.uniform(0.5, 2.0, 500)
    frames = [100.0 + rng.normal(0, 3.0, (40, 500)), 100.0 + 4000.0 * size + rng.normal(0, 3.0, (40, 500))]

    equalised = Calibration.from_frames(*frames, dead_fraction=0.1)
    by_size = Calibration.from_frames(*frames, expected_dn=size)

    assert equalised.correct(100.0 + 1000.0 * size) == pytest.approx(np.full(500, 1000.0 * size.mean()), rel=3e-3)
    assert by_size.correct(100.0 + 1000.0 * size) == pytest.approx(1000.0 * size, rel=3e-3)
    assert by_size.gain == pytest.approx(np.ones(500), abs=3e-3)


def test_gain_excludes_expected_crosstalk_and_ipc():
    layout = fs.layout.mosaic(grid(n_x=40, n_y=40, pitch_um=2.0), ("RG", "GB"))
    sensor = Sensor(
        layout,
        filters="rgb",
        crosstalk=Diffusion(spread_um=0.2),
        coupling=InterPixelCapacitance(neighbour_fraction=0.01),
        gain_fpn_fraction=0.02,
        dark_e_per_s=1e4,
        **FINE,
    )
    flat_e = np.array([8000.0, 5000.0, 2000.0])[sensor.filter_of_site]

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=flat_e, n_frames=100, seed=8)

    ratio = calibration.gain / response_of(sensor)
    for colour in range(3):
        group = ratio[sensor.filter_of_site == colour]
        assert group.mean() == pytest.approx(1.0, abs=SIGMAS * group.std() / math.sqrt(group.size) + 1e-4)
    assert ratio.std() < 0.005


@pytest.mark.parametrize("companding", ["root", "log"])
def test_companded_codes_calibrate_like_linear_codes(companding):
    sensor = Sensor(MANY, bits=14, v_sat_v=1.0, capacitance_f=FINE["capacitance_f"], companding=companding, **FAULTY)

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=30, seed=9)

    assert np.corrcoef(calibration.gain, response_of(sensor))[0, 1] > 0.95
    expected_e = sensor.expected_electrons(np.full(N, 4e4), 0.1)
    code = sensor.read(sensor.collect(expected_e, seed=1), seed=1)
    # Noise of one frame and of the calibration, without fixed pattern; gain differences change the noise by 0.3 %.
    residual_dn2 = 5064.0 + ((3 / 7) ** 2 * 1064.0 + (4 / 7) ** 2 * 8064.0) / 30
    corrected_dn = calibration.correct(code)
    assert corrected_dn.var() == pytest.approx(residual_dn2, rel=SIGMAS * math.sqrt(2.0 / N) + 0.01)
    assert corrected_dn.mean() == pytest.approx(4000.0, abs=SIGMAS * math.sqrt(residual_dn2 / N) + 2.0)


# -- correction -------------------------------------------------------------------------------------------------------


def small_calibration(**kinds):
    """Return a noise-free calibration of a 5 by 5 grid with injected defects."""
    dark, flat = np.full((2, 25), 10.0), np.full((1, 25), 110.0)
    for site, value in kinds.get("dark", {}).items():
        dark[:, site] = value
    for site, value in kinds.get("flat", {}).items():
        flat[:, site] = value
    return Calibration.from_frames(dark, flat, highest_dn=255, expected_dn=kinds.get("expected_dn", 1.0))


def test_saturated_codes_become_nan():
    code = np.full(25, 60.0)
    code[[3, 7]] = 255.0

    corrected_dn = small_calibration().correct(code)

    assert np.flatnonzero(np.isnan(corrected_dn)).tolist() == [3, 7]
    assert corrected_dn[0] == pytest.approx(50.0)
    assert code[3] == 255.0


def test_defective_site_is_mean_of_good_neighbours():
    calibration = small_calibration(dark={12: 90.0}, flat={11: 10.0})
    code = 10.0 + np.arange(25.0)
    code = np.stack([code, code])
    code[1, 7] = 255.0

    corrected_dn = calibration.correct(code, fill=grid(n_x=5, n_y=5, pitch_um=2.0))

    assert np.flatnonzero(calibration.hot).tolist() == [12]
    assert np.flatnonzero(calibration.dead).tolist() == [11, 12]
    assert corrected_dn[0, 12] == pytest.approx((7 + 13 + 17) / 3)
    assert corrected_dn[1, 12] == pytest.approx((13 + 17) / 2)
    assert corrected_dn[0, 11] == pytest.approx((6 + 10 + 16) / 3)
    assert corrected_dn[0, 3] == pytest.approx(3.0)
    assert np.isnan(calibration.correct(code[0])[11])


def test_replacement_scales_with_expected_signal():
    """The expected signal of the central site is three times that of the others."""
    expected = np.ones(25)
    expected[12] = 3.0
    calibration = small_calibration(flat={12: 10.0}, expected_dn=expected)

    corrected_dn = calibration.correct(np.full(25, 50.0), fill=grid(n_x=5, n_y=5, pitch_um=2.0))

    assert corrected_dn[12] == pytest.approx(120.0)


def test_mosaic_sites_are_replaced_by_same_colour():
    layout = fs.layout.mosaic(grid(n_x=5, n_y=5, pitch_um=2.0), ("RG", "GB"))
    calibration = small_calibration(flat={12: 10.0})
    code = 10.0 + np.where(layout.channel == layout.channel[12], 70.0, 20.0)

    assert calibration.correct(code, fill=layout)[12] == pytest.approx(20.0)
    assert calibration.correct(code, fill=layout, kind=layout.channel)[12] == pytest.approx(70.0)


def test_inputs_unchanged_and_results_read_only():
    frames = np.full((2, 25), 10.0), np.full((1, 25), 110.0)
    calibration = Calibration.from_frames(*frames)

    assert (frames[0] == 10.0).all()
    assert all(not getattr(calibration, name).flags.writeable for name in ("offset_dn", "gain", "hot", "expected_dn"))


# -- invalid input ----------------------------------------------------------------------------------------------------

DARK, FLAT = np.full((2, 25), 10.0), np.full((1, 25), 110.0)


@pytest.mark.parametrize(
    ("dark", "flat", "parameters", "message"),
    [
        (DARK[:1], FLAT, {}, "'dark' must be at least 2 frames"),
        (DARK[0], FLAT, {}, "'dark' must have 2 dimensions"),
        (DARK, FLAT[:, :7], {}, "'flat' must have the 25 sites of the dark frames, got 7"),
        (DARK, DARK, {}, "the flat signal is not above the dark signal"),
        (DARK, FLAT, {"highest_dn": 110}, "the flat frames saturate 100 % of the sites"),
        (DARK, FLAT, {"expected_dn": np.zeros(25)}, "'expected_dn' must be > 0"),
        (DARK, FLAT, {"expected_dn": np.ones(3)}, "'expected_dn' must be one number, or one for each of the 25 sites"),
        (DARK, FLAT, {"dark_long": DARK}, "'exposure_s' must be given with 'dark_long'"),
        (
            DARK,
            FLAT,
            {"exposure_s": 1.0, "dark_long": DARK},
            "'long_exposure_s' must be given if and only if 'dark_long' is",
        ),
        (DARK, FLAT, {"exposure_s": 2.0, "dark_long": DARK, "long_exposure_s": 1.0}, "'long_exposure_s' must be > 2"),
        (DARK, FLAT, {"hot_sigmas": 0.0}, "'hot_sigmas' must be > 0"),
        (DARK, FLAT, {"dead_fraction": 2.0}, "'dead_fraction' must be <= 1"),
        (DARK, FLAT, {"noisy_ratio": 0.5}, "'noisy_ratio' must be >= 1"),
        (DARK, FLAT, {"linear_dn": np.arange(64.0)}, "'flat' must be <= 63 everywhere, got 110.0 DN"),
    ],
)
def test_invalid_frames_are_rejected(dark, flat, parameters, message):
    with pytest.raises((ParameterError, SimulationError), match=message) as caught:
        Calibration.from_frames(dark, flat, **parameters)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"code": np.zeros(7)}, "'code' must have one value for each of the 25 sites"),
        ({"exposure_s": 3.0}, "the dark signal at 3 s is unknown"),
        ({"fill": grid(n_x=2, n_y=2, pitch_um=2.0)}, "'fill' must be the layout of these 25 sites"),
        ({"fill": grid(n_x=5, n_y=5, pitch_um=2.0, trench_um=0.5)}, "no two sites of the layout share an edge"),
        ({"fill": grid(n_x=5, n_y=5, pitch_um=2.0), "kind": [1, 2]}, "'kind' must have one value for each"),
    ],
)
def test_invalid_correction_arguments_are_rejected(arguments, message):
    calibration = small_calibration(flat={12: 10.0})

    with pytest.raises((ParameterError, SimulationError), match=message):
        calibration.correct(arguments.pop("code", np.zeros(25)), **arguments)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_frames": 1}, "'n_frames' must be >= 2"),
        ({"exposure_s": 0.0}, "'exposure_s' must be > 0"),
        ({"flat_e": np.ones(3)}, "'flat_e' must be one number, or one for each"),
        ({"flat_e": 0.0}, "'flat_e' must be > 0"),
        ({"flat_e": 1e9}, "the flat frames saturate 100 %"),
        ({"long_exposure_s": 0.1}, "'long_exposure_s' must be > 0.1"),
    ],
)
def test_invalid_calibrate_arguments_are_rejected(parameters, message):
    with pytest.raises((ParameterError, SimulationError), match=message):
        calibrate(Sensor(MANY[:9]), **{"exposure_s": 0.1, "flat_e": 1e6, "n_frames": 3, "seed": 0, **parameters})


def test_linearise_rejects_invalid_sensor_and_code():
    with pytest.raises(ParameterError, match="'sensor' must be a"):
        linearise([1], None)
    with pytest.raises(ParameterError, match="'code' must be <= 255"):
        linearise([256], Sensor(MANY[:1]))
