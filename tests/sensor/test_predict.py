"""Prediction of codes against Monte Carlo draws and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants
import scipy.special

import foveasim as fs
from foveasim._core.validation import read_only
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance, Sensor
from foveasim.sensor.model.prediction import NO_TABLES, ChargeDistributions, ChargeTables

SIGMAS = 5.0
N_DRAWS = 500
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
    """
    Check mean and variance to five standard errors, which are estimated from the draws.

    Those of each site, and of sums over the sites of similar charges, since frames are independent.
    """
    mean_dn, variance_dn2 = sensor.predict(expected_e)
    codes = draw_codes(sensor, expected_e)
    off = codes - mean_dn
    # Rare codes need more frames.
    is_common = variance_dn2 > 1e-2
    for group in np.split(np.argsort(expected_e, kind="stable"), 11 if expected_e.size % 11 == 0 else 1):
        sites = group[is_common[group]]
        sums, squares = off[:, sites].sum(axis=1), (off[:, sites] ** 2 - variance_dn2[sites]).sum(axis=1)
        # Squares of a code with two values of probability 1/2 are constant.
        for values, unit in ((sums, np.sqrt(variance_dn2)), (squares, variance_dn2)):
            rounding = 1e-5 * unit[sites].sum()
            assert abs(values.mean()) <= SIGMAS * values.std() / np.sqrt(N_DRAWS) + rounding
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
    assert (~is_nearly_constant).mean() > 0.09


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
PHOTO_E = np.repeat([0.0, 0.5, 3.0, 40.0, 99.0, 101.0, 900.0, 3000.0, 4950.0, 5100.0, 20_000.0], 14)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("bits", [4, 8, 12])
@pytest.mark.parametrize("companding", ["linear", "root", "log"])
def test_prediction_with_all_effects_matches_draws(bits, companding):
    sensor = Sensor(
        line_of(PHOTO_E.size), bits=bits, companding=companding, v_sat_v=1.0, capacitance_f=9e-16, **ALL_EFFECTS
    )

    assert_agree(sensor, sensor.expected_electrons(PHOTO_E, 1.0))


@pytest.mark.slow(keep=12)
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
        {"nonlinearity_fraction": -0.2, "read_noise_e": 3.0},
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


def sensor_at(dn_per_e, n_sites=1, *, bits=16, **parameters):
    """Create a sensor of a given system gain."""
    capacitance_f = 2**bits / dn_per_e * scipy.constants.e / 3.0
    return Sensor(line_of(n_sites), bits=bits, capacitance_f=capacitance_f, **parameters)


def charge_probabilities(mean_e):
    """Return all integers with a probability above 1e-30, and their Poisson probabilities."""
    charge = np.arange(max(0, int(mean_e - 13 * np.sqrt(mean_e) - 40)), int(mean_e + 13 * np.sqrt(mean_e) + 90))
    # For large means, the logarithm of the probability has rounding errors above 1e-10.
    if mean_e > 5e3:
        probability = np.diff(scipy.special.pdtr(np.append(charge[0] - 1, charge), mean_e))
    else:
        probability = np.exp(scipy.special.xlogy(charge, mean_e) - mean_e - scipy.special.gammaln(charge + 1.0))
    return charge, probability / probability.sum()


def moments_by_sums(sensor, mean_e, sigma_e=0.0):
    """Sum over all integers and all code transitions; the variance is relative to a value near the mean code."""
    charge, probability = charge_probabilities(mean_e)
    if sensor.full_well_e is not None:
        charge = np.minimum(charge, sensor.well_e[0])
    transitions_e = sensor.adc.transition_levels[1:-1] * sensor.v_sat_v / sensor.v_per_e[0]
    reach = 12.0 * sigma_e + 2.0
    first, last = np.searchsorted(transitions_e, [charge[0] - reach, charge[-1] + reach])
    transitions_e = transitions_e[first:last, np.newaxis] - 1e-7 * (sigma_e == 0.0)
    above = (charge >= transitions_e) if sigma_e == 0.0 else scipy.special.ndtr((charge - transitions_e) / sigma_e)
    survival = above @ probability
    weights = -np.diff(np.concatenate([[1.0], survival, [0.0]]))
    codes = np.arange(weights.size)
    mean = weights @ codes
    return first + mean, weights @ (codes - mean) ** 2


def assert_equals_sums(sensor, means_e, sigma_e=0.0):
    """Compare with sums over all integers: mean to 1e-9 DN, variance to 1e-9 relative or 1e-9 DN²."""
    for mean_e in means_e:
        mean_dn, variance_dn2 = sensor.predict(np.array([float(mean_e)]))
        mean, variance = moments_by_sums(sensor, mean_e, sigma_e)
        assert mean_dn[0] == pytest.approx(mean, abs=1e-9, rel=0.0), mean_e
        assert variance_dn2[0] == pytest.approx(variance, abs=1e-9, rel=1e-9), mean_e


#: On both sides of 100 e-, where draws change, and up to 1e4 e-.
CHARGES_E = [0.3, 1.0, 7.0, 40.0, 99.9, 100.0, 100.1, 130.0, 200.0, 300.0, 1000.0, 10_000.0]


def test_prediction_at_unit_gain_is_poisson():
    mean_e = np.array([0.0, 0.2, 5.0, 80.0, 300.0, 9000.0])

    mean_dn, variance_dn2 = Sensor(line_of(6), **ONE_E_PER_CODE).predict(mean_e)

    assert mean_dn == pytest.approx(mean_e, abs=1e-9, rel=0.0)
    assert variance_dn2 == pytest.approx(mean_e, abs=1e-9, rel=1e-9)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("dn_per_e", [0.08, 0.33, 0.5, 1.0])
def test_noise_free_prediction_matches_many_draws(dn_per_e):
    n_sites = 200_000
    sensor = sensor_at(dn_per_e, n_sites)
    for k, mean_e in enumerate(CHARGES_E[1:]):
        mean_dn, variance_dn2 = (part[0] for part in sensor_at(dn_per_e).predict(np.array([mean_e])))
        electrons = sensor.collect(np.full(n_sites, mean_e), seed=3, frame=k)
        codes = sensor.read(electrons, seed=3, frame=k).astype(float)
        fourth = np.mean((codes - codes.mean()) ** 4)

        assert abs(codes.mean() - mean_dn) < SIGMAS * np.sqrt(variance_dn2 / n_sites) + 1e-6
        assert abs(codes.var() - variance_dn2) < SIGMAS * np.sqrt((fourth - codes.var() ** 2) / n_sites) + 1e-6


@pytest.mark.parametrize("dn_per_e", [0.08, 0.33, 0.5, 1.0])
@pytest.mark.parametrize("sigma_e", [0.0, 0.3, 0.7, 1.0999, 1.1, 1.5])
def test_linear_prediction_equals_integer_sums(dn_per_e, sigma_e):
    assert_equals_sums(sensor_at(dn_per_e, read_noise_e=sigma_e), CHARGES_E[:-1], sigma_e)


@pytest.mark.parametrize("sigma_e", [0.0, 0.3, 1.0, 1.5, 3.0])
def test_prediction_near_full_well_equals_sums(sigma_e):
    sensor = sensor_at(0.33, read_noise_e=sigma_e, full_well_e=1000.0)

    assert_equals_sums(sensor, [850.0, 950.0, 999.0, 1000.5, 1040.0, 1200.0, 5000.0], sigma_e)


def clipped_moments_by_sums(sensor, mean_e, sigma_e):
    """Return code mean and variance of a charge clipped at an integer full well, as :func:`moments_by_sums`, but quickly."""
    charge, probability = charge_probabilities(mean_e)
    well_e = int(sensor.well_e[0])
    is_full = charge >= well_e
    charge = np.append(charge[~is_full], well_e)
    probability = np.append(probability[~is_full], probability[is_full].sum())
    transitions_e = sensor.adc.transition_levels[1:-1] * sensor.v_sat_v / sensor.v_per_e[0]
    reach = math.ceil(9.0 * sigma_e)
    first, last = np.searchsorted(transitions_e, [charge[0] - reach, well_e + reach])
    survival = np.zeros(last - first)
    for start in range(first, last, 4096):
        at_e = transitions_e[start : min(start + 4096, last), np.newaxis]
        # All charges from 9 standard deviations above a transition are above it, and those as far below are below it.
        near = np.searchsorted(charge, at_e - reach) + np.arange(2 * reach + 2)
        weight = np.where(near < charge.size, probability[np.minimum(near, charge.size - 1)], 0.0)
        above = np.append(np.cumsum(probability[::-1])[::-1], 0.0)[np.minimum(near[:, -1] + 1, charge.size)]
        normal = scipy.special.ndtr((charge[np.minimum(near, charge.size - 1)] - at_e) / sigma_e)
        survival[start - first : start - first + at_e.size] = (weight * normal).sum(axis=1) + above
    weights = -np.diff(np.concatenate([[1.0], survival, [0.0]]))
    codes = np.arange(weights.size)
    mean = weights @ codes
    return first + mean, weights @ (codes - mean) ** 2


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    ("well_e", "bits"), [*zip(np.geomspace(100.0, 20_000.0, 20).round().tolist(), (8, 14, 10, 12, 8) * 4, strict=True)]
)
def test_prediction_around_full_well_equals_sums(well_e, bits):
    """Levels from 0.3 to 3 wells, and those whose distribution begins just below the well, which noise crosses."""
    sigma_e, distances = 3.0, np.linspace(5.0, 9.0, 16)
    # The distance is in standard deviations of the level.
    above_e = np.square(0.5 * distances + np.sqrt(0.25 * distances**2 + well_e))
    levels_e = np.append(np.geomspace(0.3, 3.0, 24) * well_e, above_e)
    options = {"bits": bits, "read_noise_e": sigma_e, "full_well_e": well_e}
    sensor = sensor_at(0.9 * 2**bits / well_e, **options)
    found = sensor_at(0.9 * 2**bits / well_e, levels_e.size, **options).predict(levels_e)
    for level_e, mean_dn, variance_dn2 in zip(levels_e, *found, strict=True):
        mean, variance = clipped_moments_by_sums(sensor, level_e, sigma_e)
        assert mean_dn == pytest.approx(mean, abs=1e-6, rel=1e-9), level_e
        assert variance_dn2 == pytest.approx(variance, abs=1e-6, rel=1e-6), level_e


@pytest.mark.parametrize("sigma_e", [0.0, 0.3, 1.0, 1.5, 3.0])
def test_prediction_near_range_end_equals_sums(sigma_e):
    sensor = sensor_at(1.0, bits=10, read_noise_e=sigma_e)

    assert_equals_sums(sensor, [850.0, 950.0, 1000.0, 1024.0, 1100.0, 1200.0], sigma_e)


@pytest.mark.parametrize(("mean_e", "dn_per_e"), [(2e4, 0.33), (2e4, 1.0), (1e6, 0.004), (1.2e6, 0.004)])
def test_large_charges_without_noise_equal_sums(mean_e, dn_per_e):
    assert_equals_sums(sensor_at(dn_per_e), [mean_e])


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("companding", ["root", "log"])
@pytest.mark.parametrize("sigma_e", [0.0, 0.3, 1.0, 1.1, 1.5, 2.5])
def test_companded_prediction_equals_integer_sums(companding, sigma_e):
    sensor = sensor_at(0.33, bits=12, companding=companding, read_noise_e=sigma_e)

    assert_equals_sums(sensor, CHARGES_E[1:-1], sigma_e)


@pytest.mark.parametrize("sigma_e", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("companding", ["linear", "root"])
def test_prediction_is_continuous_at_100_e(companding, sigma_e):
    """Steps of 1e-3 e- change moments by no more than a smooth function of the charge does."""
    mean_e = 100.0 + 1e-3 * np.arange(-20, 21)
    sensor = sensor_at(0.33, mean_e.size, companding=companding, read_noise_e=sigma_e)

    for values in sensor.predict(mean_e):
        second = np.diff(values, 2)
        assert np.abs(second).max() < 1e-5
        assert np.ptp(np.diff(values)) < 1e-4


def test_exact_shot_noise_has_equal_prediction():
    mean_e = np.array([50.0, 150.0, 900.0])

    auto, exact = (sensor_at(0.33, 3, shot_noise=how).predict(mean_e) for how in ("auto", "exact"))

    assert np.array_equal(auto, exact)


@pytest.mark.parametrize("dn_per_e", [0.05, 0.7])
@pytest.mark.parametrize("sigma_e", [0.0, 0.4, 2.0])
def test_rts_states_average_shifted_codes(dn_per_e, sigma_e):
    """Two equally probable states: the moments are those of two sensors with offsets of half a step."""
    mean_e = np.array([30.0, 400.0, 2000.0])
    arguments = kernel_arguments(sensor_at(dn_per_e, 3, pedestal_v=1.0, read_noise_e=sigma_e), mean_e)
    charges, transfer = arguments["charges"], arguments["transfer"]
    half_step_e = 6.3
    states = []
    for sign in (-1.0, 1.0):
        sense_v = transfer.sense_v + sign * half_step_e * transfer.v_per_e
        states.append(predict(**arguments | {"transfer": transfer._replace(sense_v=sense_v)}))
    mean = np.mean([state[0] for state in states], axis=0)
    second = np.mean([state[1] + (state[0] - mean) ** 2 for state in states], axis=0)

    predicted = predict(**arguments | {"charges": charges._replace(half_step_e=np.array([half_step_e]))})

    assert predicted[0] == pytest.approx(mean, abs=1e-9, rel=0.0)
    assert predicted[1] == pytest.approx(second, abs=1e-9, rel=1e-9)


def kernel_arguments(sensor, mean_e):
    """Return arguments of the kernel for Poisson-distributed charges."""
    model = sensor.readout_model(mean_e, mean_e)
    charges = ChargeDistributions(
        mean_e=mean_e,
        variance_e2=np.zeros(1),
        well_e=sensor.well_e,
        sigma_e=np.sqrt(model.gaussian_e2),
        half_step_e=model.half_step_e,
        is_drawn=True,
    )
    line = sensor.layout.readout_line.astype(np.int32)
    return {
        "charges": charges,
        "tables": NO_TABLES,
        "transfer": model.transfer,
        "line": line,
        "adc": sensor.adc.tables(sensor.v_sat_v, np.uint64(7)),
    }


def predict(charges, tables, transfer, line, adc):
    from foveasim.sensor import _kernels

    n_sites = charges.mean_e.size
    mean_dn, variance_dn2 = np.empty(n_sites), np.empty(n_sites)
    charges, tables, transfer = (
        type(group)(*(read_only(part.view()) if isinstance(part, np.ndarray) else part for part in group))
        for group in (charges, tables, transfer)
    )
    _kernels.predict_codes(charges, tables, transfer, read_only(line), adc, mean_dn, variance_dn2)
    return mean_dn, variance_dn2


def tables_of(means_e):
    """Return Poisson distributions as tables."""
    charges, probabilities = zip(*map(charge_probabilities, means_e), strict=True)
    return ChargeTables(
        first_e=np.array([charge[0] for charge in charges]),
        offset=np.cumsum([0, *map(len, charges)]),
        probability_fraction=np.concatenate(probabilities),
    )


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"read_noise_e": 0.4},
        {"read_noise_e": 2.0},
        {"read_noise_e": 0.4, "full_well_e": 1010.0},
        {"read_noise_e": 3.0, "full_well_e": 1010.0, "rts_fraction": 1.0, "rts_e": 5.0},
        {"companding": "root"},
        {"companding": "log", "read_noise_e": 0.4, "dnl_dn": 0.5, "inl_dn": [0.0, 1.0, 0.0]},
        {"dnl_dn": 0.5, "nonlinearity_fraction": 0.02},
    ],
    ids=str,
)
def test_tabulated_charges_equal_poisson_charges(parameters):
    mean_e = np.array([0.5, 20.0, 99.0, 101.0, 400.0, 1000.0, 1500.0])
    arguments = kernel_arguments(sensor_at(0.4, mean_e.size, bits=12, **parameters), mean_e)

    poisson = predict(**arguments)
    tabulated = predict(**arguments | {"tables": tables_of(mean_e)})

    assert tabulated[0] == pytest.approx(poisson[0], abs=1e-12, rel=1e-12)
    assert tabulated[1] == pytest.approx(poisson[1], abs=1e-12, rel=1e-12)


def test_tabulated_charges_without_poisson_match_sums():
    """Two charges with unequal probabilities, which need not sum to 1: a linear ADC without noise returns their codes."""
    sensor = sensor_at(1.0, 2)
    tables = ChargeTables(np.array([5, 70_000]), np.array([0, 3, 4]), np.array([1.0, 0.0, 3.0, 2.0]))

    mean_dn, variance_dn2 = predict(**kernel_arguments(sensor, np.array([9.0, 9.0])) | {"tables": tables})

    assert mean_dn == pytest.approx([6.5, 65_535.0], abs=1e-9, rel=0.0)
    assert variance_dn2 == pytest.approx([0.75, 0.0], abs=1e-9)


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

    n_frames = 100
    frames = np.stack([camera.capture(scene, exposure_s=0.02, seed=1, frame=k).code for k in range(n_frames)]).astype(
        float
    )

    off = (frames.mean(axis=0) - mean_dn) / np.sqrt(variance_dn2 / n_frames)
    assert np.abs(off).max() < SIGMAS
    # Sites are independent: the relative standard error of a variance.
    error = np.sqrt(2.0 * (variance_dn2**2).sum() / n_frames) / variance_dn2.sum()
    assert frames.var(axis=0, ddof=1).sum() == pytest.approx(variance_dn2.sum(), rel=SIGMAS * error)


def test_predicted_covariance_matches_draws():
    """Neighbours share charge; the noise spans two codes, and the ADC is 3 % nonlinear."""
    n = 60
    sensor = Sensor(
        line_of(n), bits=8, v_sat_v=1.0, capacitance_f=2**8 * 16 * scipy.constants.e, nonlinearity_fraction=0.03,
        coupling=InterPixelCapacitance(neighbour_fraction=0.05),
    )  # fmt: skip
    expected_e = np.full(n, 1000.0)
    predicted = sensor.predict_covariance(expected_e, np.arange(n))
    off = draw_codes(sensor, expected_e) - sensor.predict(expected_e)[0]

    for lag in (0, 1, 2):
        products = (off[:, : n - lag] * off[:, lag:]).mean(axis=1)
        error = products.std() / np.sqrt(N_DRAWS)
        assert products.mean() == pytest.approx(np.diagonal(predicted, lag).mean(), abs=SIGMAS * error)
        assert lag == 2 or products.mean() > 2.0 * SIGMAS * error
