"""Calibrations against the faults that were put into a device, and what is left of them against error propagation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim._core.random_streams import Streams
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Calibration, Diffusion, InterPixelCapacitance, Sensor, calibrate, linearise

SIGMAS = 5.0
N_X, N_Y = 200, 100
N = N_X * N_Y
MANY = grid(n_x=N_X, n_y=N_Y, pitch_um=2.0).with_columns(readout_line=np.tile(np.arange(N_X), N_Y))
#: 14 bits of 1 electron each.
FINE = {"bits": 14, "v_sat_v": 1.0, "capacitance_f": 16_384 * scipy.constants.e}
#: Every kind of fixed pattern, on a pedestal of 1000 e- of dark charge.
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
    """Relative response of a device, of mean 1."""
    gain = sensor.response * gain_of(sensor) * expected_e
    return gain / gain.mean()


# -- linear codes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [1, 8, 16])
def test_linear_codes_are_themselves(bits):
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
def test_linear_codes_are_the_middle_of_the_voltages_that_give_a_code(parameters):
    """The oracle reads a fine staircase of charges, and takes each code's middle."""
    n_charges = 400_000
    row = grid(n_x=1000, n_y=1, pitch_um=2.0)
    sensor = Sensor(row, bits=8, v_sat_v=1.0, capacitance_f=n_charges * scipy.constants.e, **parameters)
    charge = np.arange(n_charges)
    code = np.concatenate([sensor.read(part, streams=Streams(0)) for part in charge.reshape(-1, 1000)])
    middle_dn = np.array([charge[code == k][[0, -1]].mean() if (code == k).any() else np.nan for k in range(256)])

    off = linearise(np.arange(256), sensor) - (middle_dn * 256 / n_charges - 0.5)

    assert np.isfinite(off).sum() >= 250
    assert np.nanmax(np.abs(off)) < 3 * 256 / n_charges


# -- fixed patterns ---------------------------------------------------------------------------------------------------


def test_offsets_and_gains_are_those_of_the_device():
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
def test_what_is_left_of_the_fixed_pattern_falls_with_the_root_of_the_frames(n_frames):
    """Codes without temporal noise at any level, by prediction, against the propagated errors of the calibration."""
    sensor = Sensor(MANY, **FINE, **FAULTY)
    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=n_frames, seed=2)
    dark_dn2, flat_dn2 = 1000.0 + 64.0 + 1 / 12, 8000.0 + 64.0 + 1 / 12

    for share in (0.0, 0.5, 1.0, 1.5):
        mean_dn, _ = sensor.predict(sensor.expected_electrons(np.full(N, 7e4 * share), 0.1))
        corrected_dn = calibration.correct(mean_dn)

        left_dn2 = ((1 - share) ** 2 * dark_dn2 + share**2 * flat_dn2) / n_frames
        # Five standard errors, and the spread of gains of a few percent in the propagated error.
        rel = SIGMAS * math.sqrt(2.0 / N) + 0.01
        assert corrected_dn.var() == pytest.approx(left_dn2, rel=rel)
        assert corrected_dn.mean() == pytest.approx(7000.0 * share, rel=2e-3, abs=1.0)
        assert mean_dn.var() > 5.0 * corrected_dn.var()


def test_the_dark_rate_carries_offsets_to_other_exposures():
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


def test_injected_hot_and_dead_sites_are_found_and_hardly_any_others():
    """Hot sites of 2000 e- stand 20 robust standard deviations out; dead sites give nothing."""
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


def test_hot_sites_below_the_offsets_spread_are_found_by_their_rate():
    """Offsets spread by 80 DN hide 200 e- in the dark frame; 0.9 s more show them."""
    parameters = {**FAULTY, "dsnu_fraction": 0.0, "dark_e_per_s": 1e3}
    sensor = Sensor(MANY, **FINE, **parameters, hot_fraction=0.01, hot_e_per_s=2e3)
    is_hot = sensor.dark_rate_e_per_s > 2e3

    short = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=20, seed=5)
    both = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=20, seed=5, long_exposure_s=1.0)

    assert short.hot[is_hot].mean() < 0.2
    assert np.array_equal(both.hot, is_hot)


@pytest.mark.parametrize("n_frames", [3, 30])
def test_sites_with_telegraph_noise_are_noisy_and_others_are_not(n_frames):
    sensor = Sensor(MANY, **FINE, dark_e_per_s=1e4, read_noise_e=5.0, rts_fraction=0.01, rts_e=600.0)
    is_noisy = sensor.pattern("rts") > 0.0

    calibration = calibrate(sensor, exposure_s=0.01, flat_e=7000.0, n_frames=n_frames, seed=6)

    assert (calibration.noisy & ~is_noisy).sum() <= 2
    # In three frames both states show in three of four.
    assert calibration.noisy[is_noisy].mean() > (0.99 if n_frames > 10 else 0.6)


def test_sites_at_the_ends_of_the_codes_are_told_and_have_no_part_in_the_mean():
    dark, flat = np.full((4, 25), 10.0), np.full((4, 25), 110.0)
    dark[2, 4] = 0.0
    flat[1, 7] = 255.0

    calibration = Calibration.from_frames(dark, flat, highest_dn=255)

    assert np.flatnonzero(calibration.clipped).tolist() == [4, 7]
    assert calibration.gain[0] == pytest.approx(1.0, rel=1e-12)
    assert Calibration.from_frames(dark, flat, highest_dn=255, max_clipped_fraction=0.3).clipped.sum() == 0


def test_a_perfect_sensor_has_no_defects():
    calibration = calibrate(Sensor(MANY, bits=8), exposure_s=0.1, flat_e=9e5, n_frames=4, seed=0)

    assert calibration.defective.sum() == 0
    assert calibration.gain.mean() == pytest.approx(1.0, abs=1e-12)


# -- sites that differ by design --------------------------------------------------------------------------------------


def test_sites_of_two_sizes_are_alike_where_they_give_what_they_were_to_give():
    """Large sites of three times the light, dark charge and capacitance twice: no fixed pattern, no hot site."""
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


def test_with_one_expectation_for_all_sites_they_are_made_alike():
    rng = np.random.default_rng(0)
    size = rng.uniform(0.5, 2.0, 500)
    frames = [100.0 + rng.normal(0, 3.0, (40, 500)), 100.0 + 4000.0 * size + rng.normal(0, 3.0, (40, 500))]

    alike = Calibration.from_frames(*frames, dead_fraction=0.1)
    by_size = Calibration.from_frames(*frames, expected_dn=size)

    assert alike.correct(100.0 + 1000.0 * size) == pytest.approx(np.full(500, 1000.0 * size.mean()), rel=3e-3)
    assert by_size.correct(100.0 + 1000.0 * size) == pytest.approx(1000.0 * size, rel=3e-3)
    assert by_size.gain == pytest.approx(np.ones(500), abs=3e-3)


def test_a_mosaic_with_crosstalk_and_coupling_has_the_gains_of_its_sites():
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
    light_e = np.array([8000.0, 5000.0, 2000.0])[sensor.filter_of_site]

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=light_e, n_frames=100, seed=8)

    ratio = calibration.gain / response_of(sensor)
    for colour in range(3):
        group = ratio[sensor.filter_of_site == colour]
        assert group.mean() == pytest.approx(1.0, abs=SIGMAS * group.std() / math.sqrt(group.size) + 1e-4)
    assert ratio.std() < 0.005


@pytest.mark.parametrize("companding", ["root", "log"])
def test_companded_codes_are_calibrated_as_linear_ones(companding):
    sensor = Sensor(MANY, bits=14, v_sat_v=1.0, capacitance_f=FINE["capacitance_f"], companding=companding, **FAULTY)

    calibration = calibrate(sensor, exposure_s=0.1, flat_e=7000.0, n_frames=30, seed=9)

    assert np.corrcoef(calibration.gain, response_of(sensor))[0, 1] > 0.95
    expected_e = sensor.expected_electrons(np.full(N, 4e4), 0.1)
    code = sensor.read(sensor.collect(expected_e, streams=Streams(1)), streams=Streams(1))
    # One frame's noise, that of the calibration, and no fixed pattern; gains spread the noise by 0.3 %.
    left_dn2 = 5064.0 + ((3 / 7) ** 2 * 1064.0 + (4 / 7) ** 2 * 8064.0) / 30
    corrected_dn = calibration.correct(code)
    assert corrected_dn.var() == pytest.approx(left_dn2, rel=SIGMAS * math.sqrt(2.0 / N) + 0.01)
    assert corrected_dn.mean() == pytest.approx(4000.0, abs=SIGMAS * math.sqrt(left_dn2 / N) + 2.0)


# -- correction -------------------------------------------------------------------------------------------------------


def small(**kinds):
    """A calibration of a 5 by 5 grid without noise, with defects put in."""
    dark, flat = np.full((2, 25), 10.0), np.full((1, 25), 110.0)
    for site, value in kinds.get("dark", {}).items():
        dark[:, site] = value
    for site, value in kinds.get("flat", {}).items():
        flat[:, site] = value
    return Calibration.from_frames(dark, flat, highest_dn=255, expected_dn=kinds.get("expected_dn", 1.0))


def test_saturated_codes_are_not_a_number():
    code = np.full(25, 60.0)
    code[[3, 7]] = 255.0

    corrected_dn = small().correct(code)

    assert np.flatnonzero(np.isnan(corrected_dn)).tolist() == [3, 7]
    assert corrected_dn[0] == pytest.approx(50.0)
    assert code[3] == 255.0


def test_a_defective_site_takes_the_mean_of_its_good_neighbours():
    calibration = small(dark={12: 90.0}, flat={11: 10.0})
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


def test_a_site_is_filled_by_what_it_would_give_of_its_neighbours_light():
    """The site in the middle is expected to give three times as much."""
    expected = np.ones(25)
    expected[12] = 3.0
    calibration = small(flat={12: 10.0}, expected_dn=expected)

    corrected_dn = calibration.correct(np.full(25, 50.0), fill=grid(n_x=5, n_y=5, pitch_um=2.0))

    assert corrected_dn[12] == pytest.approx(120.0)


def test_on_a_mosaic_sites_are_filled_from_their_own_colour_two_steps_away():
    layout = fs.layout.mosaic(grid(n_x=5, n_y=5, pitch_um=2.0), ("RG", "GB"))
    calibration = small(flat={12: 10.0})
    code = 10.0 + np.where(layout.channel == layout.channel[12], 70.0, 20.0)

    assert calibration.correct(code, fill=layout)[12] == pytest.approx(20.0)
    assert calibration.correct(code, fill=layout, kind=layout.channel)[12] == pytest.approx(70.0)


def test_nothing_that_is_given_is_changed_and_nothing_that_is_held_can_be():
    frames = np.full((2, 25), 10.0), np.full((1, 25), 110.0)
    calibration = Calibration.from_frames(*frames)

    assert (frames[0] == 10.0).all()
    assert all(not getattr(calibration, name).flags.writeable for name in ("offset_dn", "gain", "hot", "expected_dn"))


# -- bad input --------------------------------------------------------------------------------------------------------

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
def test_bad_frames_get_one_clear_sentence(dark, flat, parameters, message):
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
def test_bad_codes_get_one_clear_sentence(arguments, message):
    calibration = small(flat={12: 10.0})

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
def test_bad_calibrations_get_one_clear_sentence(parameters, message):
    with pytest.raises((ParameterError, SimulationError), match=message):
        calibrate(Sensor(MANY[:9]), **{"exposure_s": 0.1, "flat_e": 1e6, "n_frames": 3, "seed": 0, **parameters})


def test_only_sensors_codes_are_linearised():
    with pytest.raises(ParameterError, match="'sensor' must be a"):
        linearise([1], None)
    with pytest.raises(ParameterError, match="'code' must be <= 255"):
        linearise([256], Sensor(MANY[:1]))
