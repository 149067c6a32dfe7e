"""Sensor: statistics of electrons and code transitions against closed forms and published values."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout, grid
from foveasim.sensor import ConstantCurve, FilterSet, Sensor, SiliconQE, draw_shot_noise

#: Number of sites for statistics to 0.3 %.
N = 200_000
MANY = grid(n_x=500, n_y=400, pitch_um=2.0)
FOUR = grid(n_x=4, n_y=1, pitch_um=2.0)
COLOURED = FOUR.with_columns(channel=[0, 1, 1, 0])
#: Five standard errors: false-alarm probability 1 in 1.7 million.
SIGMAS = 5.0
GREEN_NM = np.array([550.0])
#: 16 bits, 1 electron per code.
ONE_E_PER_CODE = {"bits": 16, "v_sat_v": 3.0, "capacitance_f": 65_536 * scipy.constants.e / 3.0}


def green_power_w(photons_per_s):
    """Return the power of green photons (550 nm)."""
    return photons_per_s * scipy.constants.h * scipy.constants.c / 550e-9


def electrons_of(sensor, photons, *, seed):
    """Draw the charge of each site for a number of expected photons in one second."""
    photo_e_per_s = sensor.responsivity_e_per_j(GREEN_NM)[0, 0] * np.full(sensor.layout.n_sites, green_power_w(photons))
    return sensor.collect(sensor.expected_electrons(photo_e_per_s, 1.0), seed=seed)


def collected(expected_e, *, seed=0, **parameters):
    """Draw the charge of each site for a number of expected electrons."""
    sensor = Sensor(MANY, **parameters)
    return sensor.collect(np.broadcast_to(np.asarray(expected_e, float), N).copy(), seed=seed)


def codes(charge_e, *, seed=0, layout=None, **parameters):
    charge_e = np.asarray(charge_e, np.int64)
    sensor = Sensor(grid(n_x=charge_e.size, n_y=1, pitch_um=2.0) if layout is None else layout, **parameters)
    return sensor.read(charge_e, seed=seed)


def charge_for(voltage_v, capacitance_f):
    return np.rint(np.asarray(voltage_v) * capacitance_f / scipy.constants.e).astype(np.int64)


# -- photons to electrons -------------------------------------------------------------------------------------------


def test_photon_rate_matches_si_conversion():
    sensor = Sensor(FOUR, qe=1.0)
    rate_e_per_s = sensor.responsivity_e_per_j(GREEN_NM)[0] * 1e-12
    assert math.isclose(sensor.expected_electrons(rate_e_per_s, 1.0)[0], 2.76876e6, rel_tol=2e-6)


def test_responsivity_follows_changed_wavelengths():
    sensor, wavelength_nm = Sensor(FOUR), np.array([400.0])
    first = sensor.responsivity_e_per_j(wavelength_nm).copy()
    wavelength_nm[0] = 800.0

    # At equal quantum efficiency it is proportional to the wavelength.
    np.testing.assert_allclose(sensor.responsivity_e_per_j(wavelength_nm), 2.0 * first, rtol=1e-15)
    np.testing.assert_allclose(
        sensor.responsivity_e_per_j(np.array([400.0, 800.0])), [[first[0, 0], 2.0 * first[0, 0]]]
    )


def test_responsivity_is_proportional_to_wavelength():
    responsivity = Sensor(FOUR).responsivity_e_per_j(np.array([400.0, 800.0]))[0]
    assert math.isclose(responsivity[1] / responsivity[0], 2.0, rel_tol=1e-15)


def test_responsivity_multiplies_efficiency_and_filter():
    filters = FilterSet([ConstantCurve(0.25), ConstantCurve(1.0)])
    responsivity = Sensor(COLOURED, qe=SiliconQE(depth_um=1.561), filters=filters).responsivity_e_per_j(GREEN_NM)[:, 0]
    np.testing.assert_allclose(
        responsivity * green_power_w(1.0), [0.25 * (1.0 - 1.0 / math.e), 1.0 - 1.0 / math.e], rtol=1e-9
    )


def test_channel_selects_filter():
    sensor = Sensor(FOUR.with_columns(channel=[2, 0, 1, 2]), filters="rgb")
    assert [sensor.filter_names[k] for k in sensor.filter_of_site] == ["B", "R", "G", "B"]


def test_dark_signal_adds_to_photoelectrons():
    sensor = Sensor(FOUR, dark_e_per_s=np.array([0.0, 10.0, 20.0, 30.0]))
    expected_e = sensor.expected_electrons(np.full(4, 100.0), 0.5)
    assert expected_e.tolist() == [50.0, 55.0, 60.0, 65.0]


def test_zero_exposure_gives_zero_charge():
    expected_e = Sensor(FOUR, dark_e_per_s=99.0).expected_electrons(np.full(4, 1e6), 0.0)
    assert expected_e.tolist() == [0.0] * 4


# -- shot noise -----------------------------------------------------------------------------------------------------

MEANS_E = [3.0, 60.0, 99.0, 101.0, 1e3, 1e6]  # below and above the limit of exact Poisson draws, 100 e-


@pytest.mark.parametrize("mean_e", MEANS_E)
@pytest.mark.parametrize("qe", [0.3, 1.0])
@pytest.mark.parametrize("how", ["auto", "exact"])
def test_electron_variance_equals_mean(how, qe, mean_e):
    electrons = electrons_of(Sensor(MANY, qe=qe, shot_noise=how), mean_e / qe, seed=17)
    # (n - 1) variance / mean of Poisson counts has a chi-squared distribution with n - 1 degrees of freedom.
    assert abs(electrons.var(ddof=1) / electrons.mean() - 1.0) < SIGMAS * math.sqrt(2.0 / (N - 1))


@pytest.mark.parametrize("mean_e", MEANS_E)
@pytest.mark.parametrize("qe", [0.3, 1.0])
@pytest.mark.parametrize("how", ["auto", "exact"])
def test_electron_mean_equals_expectation(how, qe, mean_e):
    electrons = electrons_of(Sensor(MANY, qe=qe, shot_noise=how), mean_e / qe, seed=23)
    assert abs(electrons.mean() - mean_e) < SIGMAS * math.sqrt(mean_e / N)


@pytest.mark.parametrize("mean_e", [0.4, 3.0, 60.0, 99.0])
def test_small_charges_are_poisson_distributed(mean_e):
    electrons = collected(mean_e, seed=5)
    distribution = scipy.stats.poisson(mean_e)
    # Bins with at least 20 expected sites; the outer bins are open.
    low, high = distribution.ppf(20.0 / N), distribution.isf(20.0 / N) - 1
    edges = np.arange(low, high + 1)
    counted = np.histogram(electrons, np.concatenate(([-np.inf], edges + 0.5, [np.inf])))[0]
    expected = N * np.diff(np.concatenate(([0.0], distribution.cdf(edges), [1.0])))
    assert scipy.stats.chisquare(counted, expected).pvalue > 2.0 * scipy.stats.norm.sf(SIGMAS)


def test_large_charges_have_gaussian_quartiles():
    electrons = collected(1e6, seed=6)
    inside = np.abs(electrons - 1e6) < 0.6744897501960817 * 1e3
    assert abs(inside.mean() - 0.5) < SIGMAS * math.sqrt(0.25 / N)


def test_rounding_to_electrons_adds_no_variance():
    n = 4_000_000
    electrons = draw_shot_noise(np.full(n, 12.0), "auto", 10.0, seed=7)
    # Uncorrected rounding would add 1 / 12 to the variance of 12, twice the threshold.
    assert abs(electrons.var(ddof=1) / 12.0 - 1.0) < SIGMAS * math.sqrt(2.0 / n)


@pytest.mark.parametrize("mean_e", [0.0, 0.01, 3.0, 11.0, 30.0])
@pytest.mark.parametrize("how", ["auto", "exact"])
def test_electrons_are_never_negative(how, mean_e):
    assert collected(mean_e, shot_noise=how, gaussian_above_e=10.0).min() >= 0


@pytest.mark.parametrize("how", ["auto", "exact", "off"])
def test_zero_expectation_gives_zero_charge(how):
    assert not collected(0.0, shot_noise=how).any()


def test_charge_without_shot_noise_is_rounded_expectation():
    expected_e = np.linspace(0.0, 1e4, N)
    assert np.abs(collected(expected_e, shot_noise="off") - expected_e).max() <= 0.5


def test_snr_of_7000_electrons_is_83_7():
    electrons = collected(7000.0, seed=8)
    # The relative standard error of a standard deviation is 1 / sqrt(2 n).
    assert abs(electrons.mean() / electrons.std() / 83.7 - 1.0) < SIGMAS / math.sqrt(2.0 * N) + 0.05 / 83.7


def test_neighbouring_sites_are_uncorrelated():
    electrons = collected(1e3, seed=9).reshape(400, 500)
    for near, far in ((electrons[:, 1:], electrons[:, :-1]), (electrons[1:], electrons[:-1])):
        assert abs(np.corrcoef(near.ravel(), far.ravel())[0, 1]) < SIGMAS / math.sqrt(near.size)


def test_dark_signal_has_shot_noise():
    sensor = Sensor(MANY, dark_e_per_s=50.0)
    electrons = sensor.collect(sensor.expected_electrons(np.zeros(N), 2.0), seed=3)
    assert abs(electrons.mean() - 100.0) < SIGMAS * math.sqrt(100.0 / N)
    assert abs(electrons.var(ddof=1) / electrons.mean() - 1.0) < SIGMAS * math.sqrt(2.0 / (N - 1))


# -- full well ------------------------------------------------------------------------------------------------------


def test_charge_never_exceeds_full_well():
    full_well_e = np.linspace(900.0, 1100.0, N)
    electrons = collected(1000.0, full_well_e=full_well_e)
    assert np.all(electrons <= full_well_e)


def test_excess_charge_equals_full_well():
    assert np.all(collected(1e5, full_well_e=7000.0) == 7000)


def test_full_well_clips_only_excess_charge():
    unlimited = collected(1000.0, seed=4)
    clipped = collected(1000.0, seed=4, full_well_e=1000.0)
    np.testing.assert_array_equal(clipped, np.minimum(unlimited, 1000))


@pytest.mark.parametrize("full_well_e", [1e9, 1e15])
def test_large_full_well_has_no_effect(full_well_e):
    np.testing.assert_array_equal(collected(1000.0, full_well_e=full_well_e), collected(1000.0))


# -- read noise -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_e", [5.0, 50.0, 200.0])
def test_read_noise_has_stated_standard_deviation(noise_e):
    code = codes(np.full(N, 30_000), layout=MANY, read_noise_e=noise_e, **ONE_E_PER_CODE)
    # Quantisation to codes of 1 electron adds 1 / 12 to the variance.
    variance = noise_e**2 + 1.0 / 12.0
    assert abs(code.astype(float).var(ddof=1) / variance - 1.0) < SIGMAS * math.sqrt(2.0 / (N - 1))


def test_read_noise_has_zero_mean():
    code = codes(np.full(N, 30_000), layout=MANY, read_noise_e=50.0, **ONE_E_PER_CODE)
    # Code k covers the charges from k to k + 1 electrons.
    assert abs(code.mean() + 0.5 - 30_000.0) < SIGMAS * 50.0 / math.sqrt(N)


def test_read_noise_acts_after_full_well():
    sensor = Sensor(MANY, full_well_e=7000.0, read_noise_e=50.0, **ONE_E_PER_CODE)
    electrons = sensor.collect(np.full(N, 1e6), seed=2)
    code = sensor.read(electrons, seed=2).astype(float)
    assert abs(code.var(ddof=1) / (50.0**2 + 1.0 / 12.0) - 1.0) < SIGMAS * math.sqrt(2.0 / (N - 1))


def test_dark_codes_clip_negative_read_noise():
    code = codes(np.zeros(N), layout=MANY, read_noise_e=100.0, **ONE_E_PER_CODE)
    probability = scipy.stats.norm.sf(1.0 / 100.0)  # of at least code 1
    assert abs(np.mean(code > 0) - probability) < SIGMAS * math.sqrt(probability * (1.0 - probability) / N)


def test_read_noise_is_per_site():
    noise_e = np.where(np.arange(N) % 2 == 0, 50.0, 0.0)
    code = codes(np.full(N, 30_000), layout=MANY, read_noise_e=noise_e, **ONE_E_PER_CODE)
    assert np.unique(code[1::2]).size == 1
    assert abs(code[::2].astype(float).var(ddof=1) / (50.0**2 + 1.0 / 12.0) - 1.0) < SIGMAS * math.sqrt(
        2.0 / (N / 2 - 1)
    )


# -- volts to codes -------------------------------------------------------------------------------------------------


def test_code_width_matches_published_7314_electrons():
    assert codes([7314, 7315, 14_628, 14_629], capacitance_f=1e-13).tolist() == [0, 1, 1, 2]


def test_saturation_charge_matches_published_value():
    assert codes([1_865_000, 1_870_000], capacitance_f=1e-13).tolist() == [254, 255]


def test_default_capacitance_follows_area():
    sizes_um = np.array([[1.0, 1.0], [2.0, 3.0], [8.0, 8.0]])
    sensor = Sensor(Layout.from_rectangles([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]], sizes_um), bits=12, shot_noise="off")
    per_um2 = 3.0 * 1.5e-16 / scipy.constants.e  # full well

    for level, code in ((0.25, 1024), (0.5, 2048), (0.999, 4091)):
        found = sensor.read(np.ceil(level * per_um2 * sizes_um.prod(axis=1)).astype(int), seed=0)
        assert np.abs(found.astype(int) - code).max() <= 2
    few = replace(sensor, layout=sensor.layout[1:])
    assert few.v_per_e.tolist() == sensor.v_per_e[1:].tolist()


def test_sites_of_a_lattice_share_one_capacitance():
    sensor = Sensor(grid(n_x=40, n_y=30, pitch_um=1.7, width_um=1.5))
    part = sensor.part(np.arange(37, 250, 3))
    again = pickle.loads(pickle.dumps(part.part(slice(5, 20))))

    node_f = sensor.node_f.tolist()
    assert node_f == pytest.approx([1.5e-16 * 1.5**2], rel=1e-9)
    assert part.node_f.tolist() == again.node_f.tolist() == node_f
    polygons = Sensor(Layout.from_polygons(sensor.layout.polygons()))
    np.testing.assert_allclose(polygons.node_f, np.full(1200, 1.5e-16 * 1.5**2), rtol=1e-9)


@pytest.mark.parametrize("bits", [4, 8, 12])
def test_quantisation_error_variance_is_one_twelfth(bits):
    capacitance_f, n_codes = 1e-10, 2**bits
    voltage_v = np.random.default_rng(12).uniform(0.0, 3.0, N)
    code = codes(charge_for(voltage_v, capacitance_f), layout=MANY, bits=bits, capacitance_f=capacitance_f)
    error = voltage_v * n_codes / 3.0 - code - 0.5
    # The fourth central moment of a uniform distribution of width 1 is 1 / 80.
    assert abs(np.mean(error**2) - 1.0 / 12.0) < SIGMAS * math.sqrt((1.0 / 80.0 - 1.0 / 144.0) / N)


@pytest.mark.parametrize("bits", range(1, 17))
def test_every_code_occurs_at_its_centre(bits):
    capacitance_f, n_codes = 1e-10, 2**bits
    charge_e = charge_for((np.arange(n_codes) + 0.5) * 3.0 / n_codes, capacitance_f)
    code = codes(charge_e, bits=bits, capacitance_f=capacitance_f)
    np.testing.assert_array_equal(code, np.arange(n_codes))


@pytest.mark.parametrize("read_noise_e", [0.0, 3.0])
@pytest.mark.parametrize(
    "adc",
    [
        {},
        {"companding": "root"},
        {"companding": "log"},
        {"nonlinearity_fraction": 0.05},
        {"nonlinearity_fraction": -0.1},
        {"inl_dn": (0.0, 1.5, -40.0)},
    ],
    ids=["linear", "root", "log", "nonlinear", "rising", "inl"],
)
def test_prediction_of_saturated_sites_is_certain(adc, read_noise_e):
    sensor = Sensor(MANY[:100], bits=10, capacitance_f=1e-15, read_noise_e=read_noise_e, **adc)
    mean_dn, variance_dn2 = sensor.predict(np.full(100, 60_000.0), exposure_s=1.0)  # full scale: 18,725 e-

    read_dn = sensor.read(np.full(100, 60_000), seed=1)
    assert mean_dn.tolist() == read_dn.tolist()
    assert read_dn.max() == (984 if "inl_dn" in adc else 1023)
    assert not variance_dn2.any()


@pytest.mark.parametrize("bits", range(1, 17))
@pytest.mark.parametrize("read_noise_e", [0.0, 10.0])
def test_codes_are_clipped_to_range(bits, read_noise_e):
    full_e = charge_for(3.0, 6e-16)
    charge_e = np.array([-(2**62), -1, 0, full_e - 1, full_e, full_e + 1, 2 * full_e, 2**40, 2**63 - 1])
    code = codes(charge_e, bits=bits, read_noise_e=read_noise_e).astype(int)
    assert code.min() == code[0] == 0
    assert code.max() == code[-1] == 2**bits - 1


@pytest.mark.parametrize("how", ["auto", "exact", "off"])
@pytest.mark.parametrize("expected_e", [1e12, 1e18, 1e19, 1e25])
def test_extreme_charges_give_highest_code(how, expected_e):
    sensor = Sensor(FOUR, shot_noise=how)
    electrons = sensor.collect(np.full(4, expected_e), seed=1)
    assert sensor.read(electrons, seed=1).tolist() == [255] * 4


def test_codes_are_monotonic_in_charge():
    code = codes(np.linspace(0, 13e3, 5000), bits=10).astype(int)
    assert np.all(np.diff(code) >= 0)


@pytest.mark.parametrize("bits", range(1, 17))
def test_codes_have_smallest_sufficient_dtype(bits):
    assert codes([0], bits=bits).dtype == np.min_scalar_type(2**bits - 1)


def test_double_capacitance_halves_code():
    code = codes([1_000_000] * 2, bits=16, capacitance_f=np.array([1e-13, 2e-13])).astype(int)
    assert abs(code[0] - 2 * code[1]) <= 1


def test_double_voltage_range_halves_code():
    low, high = (int(codes([6_000], bits=16, v_sat_v=v)[0]) for v in (3.0, 6.0))
    assert abs(low - 2 * high) <= 1


# -- independence of effects ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed",
    [
        {"read_noise_e": 50.0},
        {"bits": 12},
        {"v_sat_v": 1.0},
        {"capacitance_f": 1e-15},
        {"full_well_e": 1e6},
    ],
    ids=lambda changed: next(iter(changed)),
)
@pytest.mark.parametrize("mean_e", [20.0, 500.0])
def test_readout_parameters_do_not_change_electrons(mean_e, changed):
    np.testing.assert_array_equal(collected(mean_e, **changed), collected(mean_e))


def test_shot_noise_does_not_change_read_noise():
    noise_e = []
    for how in ("auto", "off"):
        quiet, noisy = (Sensor(MANY, shot_noise=how, read_noise_e=e, **ONE_E_PER_CODE) for e in (0.0, 50.0))
        electrons = quiet.collect(np.full(N, 30_000.0), seed=6)
        code, code_with_noise = (sensor.read(electrons, seed=6).astype(int) for sensor in (quiet, noisy))
        noise_e.append(code_with_noise - code)
    # Both differences are the same read noise to within one code.
    assert np.abs(noise_e[0] - noise_e[1]).max() <= 1


def test_zero_read_noise_has_no_effect():
    charge_e = np.arange(0, 2 * N, 2)
    quiet = codes(charge_e, layout=MANY, bits=12)
    np.testing.assert_array_equal(codes(charge_e, layout=MANY, bits=12, read_noise_e=np.zeros(N)), quiet)


def test_draws_are_independent_of_other_expectations():
    expected_e = np.full(N, 1e4)
    other_e = np.where(np.arange(N) % 2 == 0, 1e4, 7.0)
    np.testing.assert_array_equal(collected(expected_e, seed=2)[::2], collected(other_e, seed=2)[::2])


def test_same_seed_gives_identical_codes():
    runs = [codes(collected(500.0, seed=3), layout=MANY, seed=3, read_noise_e=50.0, **ONE_E_PER_CODE) for _ in range(2)]
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("other", [{"seed": 2}, {"seed": 1, "frame": 1}], ids=["seed", "frame"])
@pytest.mark.parametrize("mean_e", [20.0, 1e4])
def test_seeds_and_frames_give_independent_electrons(mean_e, other):
    sensor = Sensor(MANY)
    a, b = (sensor.collect(np.full(N, mean_e), **draws) for draws in ({"seed": 1}, other))
    assert abs(np.corrcoef(a, b)[0, 1]) < SIGMAS / math.sqrt(N)


@pytest.mark.parametrize("other", [{"seed": 2}, {"seed": 1, "frame": 1}], ids=["seed", "frame"])
def test_seeds_and_frames_give_independent_noise(other):
    sensor = Sensor(MANY, read_noise_e=50.0, **ONE_E_PER_CODE)
    a, b = (sensor.read(np.full(N, 30_000), **draws) for draws in ({"seed": 1}, other))
    assert abs(np.corrcoef(a, b)[0, 1]) < SIGMAS / math.sqrt(N)


@pytest.mark.parametrize("mean_e", [20.0, 1e4])
def test_shot_noise_and_read_noise_are_independent(mean_e):
    sensor = Sensor(MANY, read_noise_e=50.0, **ONE_E_PER_CODE)
    electrons = sensor.collect(np.full(N, mean_e), seed=1)
    noise_e = sensor.read(np.full(N, 30_000), seed=1)
    assert abs(np.corrcoef(electrons, noise_e)[0, 1]) < SIGMAS / math.sqrt(N)


# -- invalid input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("qe", 1.1, "must be <= 1"),
        ("qe", -0.1, "must be >= 0"),
        ("qe", math.nan, "must be finite"),
        ("qe", "high", "must be one number"),
        ("qe", None, "must be one number"),
        ("filters", "cmy", "must be a FilterSet, or one of 'rgb'"),
        ("filters", [ConstantCurve()], "must be a FilterSet, or one of 'rgb'"),
        ("filters", np.ones(3), "must be a FilterSet, or one of 'rgb'"),
        ("dark_e_per_s", -1.0, "must be >= 0"),
        ("dark_e_per_s", [1.0, 2.0], "must be one number, or one for each of the 4 sites, got 2"),
        ("dark_e_per_s", [1.0, 2.0, -3.0, 4.0], r"must be >= 0.* got -3.0 e-/s at \[2\]"),
        ("dark_e_per_s", np.ones((4, 1)), "must have 1 dimension"),
        ("full_well_e", 0.0, "must be > 0"),
        ("full_well_e", [1.0, 1.0, math.nan, 1.0], r"must be finite everywhere, got nan e- at \[2\]"),
        ("read_noise_e", -1.0, "must be >= 0"),
        ("read_noise_e", None, "must be one number"),
        ("capacitance_f", 0.0, "must be > 0"),
        ("capacitance_f", [1e-13, 1e-13, 0.0, 1e-13], "must be > 0"),
        ("v_sat_v", 0.0, "must be > 0"),
        ("v_sat_v", math.inf, "must be finite"),
        ("bits", 0, "must be >= 1"),
        ("bits", 17, "must be <= 16"),
        ("bits", 7.5, "must be an integer"),
        ("bits", "8", "must be an integer"),
        ("shot_noise", "poisson", "must be one of 'auto', 'exact', 'off', got 'poisson'"),
        ("shot_noise", None, "must be one of 'auto', 'exact', 'off'"),
        ("gaussian_above_e", 5.0, "must be >= 10"),
        ("gaussian_above_e", math.nan, "must be finite"),
    ],
)
def test_invalid_sensor_parameters_are_rejected(name, value, rule):
    with pytest.raises(ParameterError, match=rf"^'{name}' {rule}[^\n]*$"):
        Sensor(FOUR, **{name: value})


def test_channel_without_filter_is_rejected():
    with pytest.raises(SimulationError, match=r"channel 3, but the sensor has only filters 0 to 2 \(R, G, B\)$"):
        Sensor(FOUR.with_columns(channel=[0, 1, 2, 3]), filters="rgb")


@pytest.mark.parametrize("exposure_s", [-1.0, math.nan, math.inf, "1/30", None])
def test_invalid_exposure_is_rejected(exposure_s):
    with pytest.raises(ParameterError, match=r"^'exposure_s' must be"):
        Sensor(FOUR).expected_electrons(np.ones(4), exposure_s)


@pytest.mark.parametrize("value", [1.5, -0.5, math.nan])
@pytest.mark.parametrize("filters", [None, "rgb"])
def test_quantum_efficiency_outside_range_is_rejected(value, filters):
    sensor = Sensor(COLOURED, qe=lambda wavelength_nm: np.full(np.shape(wavelength_nm), value), filters=filters)
    with pytest.raises(ParameterError, match=r"values from 0 to 1 at every wavelength[^\n]*$") as caught:
        sensor.responsivity_e_per_j(np.array([450.0, 540.0, 610.0]))
    assert "\n" not in str(caught.value)


def curve_returning(value):
    """Return a user-defined curve that returns a fixed value."""

    def my_curve(_wavelength_nm):
        return value

    return my_curve


def failing_curve(_wavelength_nm):
    raise KeyError("no such filter")


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        (
            failing_curve,
            r"'{name}' must be a function of wavelength that returns numbers, but failing_curve raised KeyError",
        ),
        (curve_returning("high"), r"'{name}' must return one number per wavelength, got 'high'; correct .*my_curve"),
        (
            curve_returning(["a", "b", "c"]),
            r"'{name}' must return one number per wavelength, got \['a', 'b', 'c'\]; correct .*my_curve",
        ),
        (curve_returning(None), r"'{name}' must return one number per wavelength, got None; correct .*my_curve"),
        (
            curve_returning([0.5, 0.5]),
            r"'{name}' must return one number per wavelength, got the shape \(2,\) for \(3,\); correct",
        ),
        (
            curve_returning(0.5 + 0.5j),
            r"'{name}' must return one number per wavelength, got \(0.5\+0.5j\); correct .*my_curve",
        ),
        (
            lambda: 0.5,
            r"'{name}' must be a function of wavelength that returns numbers, but .*lambda.* raised TypeError",
        ),
    ],
)
@pytest.mark.parametrize("name", ["qe", "filters"])
def test_curve_errors_name_function(name, curve, message):
    given = curve if name == "qe" else FilterSet((SiliconQE(depth_um=3.0), curve))
    sensor = Sensor(COLOURED, **{"filters": "rgb", name: given})

    with pytest.raises(ParameterError, match="^" + message.format(name=name) + r"[^\n]*$") as caught:
        sensor.responsivity_e_per_j(np.array([450.0, 540.0, 610.0]))

    assert (caught.value.__cause__ is not None) == ("raised" in message)


def test_scalar_curves_are_constant():
    sensor = Sensor(FOUR, qe=lambda _: 0.5)

    assert np.array_equal(sensor.responsivity_e_per_j(GREEN_NM), Sensor(FOUR, qe=0.5).responsivity_e_per_j(GREEN_NM))


def test_per_site_arrays_are_copied():
    noise_e = np.full(4, 1.0)
    sensor = Sensor(FOUR, read_noise_e=noise_e)
    noise_e[...] = 99.0
    assert sensor.read_noise_e.tolist() == [1.0] * 4


@pytest.mark.parametrize("v_sat_v", [1.0, 1.8, 3.0, 3.3])
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("e_per_dn", [1, 2, 4])
def test_transition_charges_have_higher_code(v_sat_v, bits, e_per_dn):
    """With an integer number of electrons per code, charges coincide with code transitions."""
    layout = fs.layout.grid(n_x=2**bits, n_y=1, pitch_um=1.0)
    capacitance_f = 1.602176634e-19 * e_per_dn * 2**bits / v_sat_v
    sensor = fs.Sensor(layout, capacitance_f=capacitance_f, v_sat_v=v_sat_v, bits=bits)
    codes = np.arange(2**bits)

    assert np.array_equal(sensor.read(codes * e_per_dn, seed=0), codes)
    if e_per_dn > 1:
        assert np.array_equal(sensor.read(codes * e_per_dn + e_per_dn - 1, seed=0), codes)


@pytest.mark.parametrize("n_filters", [2, 3])
def test_filters_require_channel_column(n_filters):
    filters = FilterSet([ConstantCurve(0.5)] * n_filters)
    with pytest.raises(SimulationError, match=f"has {n_filters} filters, but the layout has no column 'channel'"):
        fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=1.0), filters=filters)


def test_single_filter_rejects_three_channel_mosaic():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=2, n_y=2, pitch_um=1.0), ("RG", "GB"))

    with pytest.raises(SimulationError, match="sites of channel 2, but the sensor has only filters 0 to 0"):
        fs.Sensor(layout, filters=fs.FilterSet((fs.GaussianCurve(centre_nm=550, fwhm_nm=80),)))


@pytest.mark.parametrize("capacitance_f", [100.0, 1e-30])
def test_implausible_capacitance_is_rejected(capacitance_f):
    with pytest.raises(ParameterError, match=r"'capacitance_f' must be from .* capacitances are in farad"):
        fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=1.0), capacitance_f=capacitance_f)


def test_arrays_are_those_of_parameters_without_layout():
    layout = fs.layout.grid(n_x=50, n_y=50, pitch_um=1.0)
    sensitivity = np.linspace(0.9, 1.0, 2500)

    assert dict(Sensor(layout).arrays) == {}
    (found,) = Sensor(layout, sensitivity=sensitivity).arrays.values()
    np.testing.assert_array_equal(found, sensitivity)
