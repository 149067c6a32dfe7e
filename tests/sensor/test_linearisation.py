"""First-order model of a sensor: against draws, dense matrices, predictions, and itself transposed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import scipy.constants
from reference.own_effects import RowNoise

from foveasim import Sensor
from foveasim.errors import ParameterError
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance, noise_budget, signal_to_noise
from foveasim.sensor.effects import AdditiveNoise, Effect, FixedFactor

N_X, N_Y = 12, 10
LAYOUT = grid(n_x=N_X, n_y=N_Y, pitch_um=4.0).with_columns(readout_line=np.repeat(np.arange(N_Y), N_X))
N = LAYOUT.n_sites
ELEMENTARY_CHARGE_C = scipy.constants.e
PHOTO = np.linspace(2000.0, 9000.0, N)
#: 1 V of range for 20,000 e-, with a pedestal.
BASE = {
    "bits": 12,
    "v_sat_v": 1.0,
    "capacitance_f": 2e4 * ELEMENTARY_CHARGE_C,
    "pedestal_v": 0.05,
    "dark_e_per_s": 300.0,
}
IPC = InterPixelCapacitance(neighbour_fraction=0.03)


class Columns(RowNoise):
    """Test effect: noise common to columns of the layout."""

    def groups(self, sites):
        return np.arange(sites.layout.n_sites) % N_X


ROW_VOLTS = RowNoise(2e-3, stage="output", name="row_volts")


class Shading(FixedFactor):
    """Test effect: transmission that falls towards the corner."""

    name, stage = "corner_shading", "photo"

    def pattern(self, sites):
        return SHADING


SHADING = 1.0 - 0.6 * np.hypot(*(LAYOUT.centroid_um - LAYOUT.centroid_um[0]).T) / 60.0
#: Chains of all kinds of steps.
CHAINS = {
    "plain": {"read_noise_e": 5.0},
    "rows": {"read_noise_e": 5.0, "effects": [RowNoise(), Columns(1e-3, stage="sense_node", name="columns")]},
    "mixed": {"read_noise_e": 5.0, "coupling": IPC, "crosstalk": Diffusion(spread_um=1.5)},
    "all": {
        "read_noise_e": np.linspace(3.0, 9.0, N),
        "coupling": IPC,
        "crosstalk": Diffusion(spread_um=1.5),
        "ktc_noise": True,
        "gain_fpn_fraction": 0.05,
        "prnu_fraction": 0.05,
        "nonlinearity_fraction": 0.1,
        "capacitance_f": BASE["capacitance_f"] * np.linspace(0.9, 1.1, N),
        "effects": [RowNoise(), ROW_VOLTS, Shading()],
    },
}
every_chain = pytest.mark.parametrize("chain", CHAINS)


def sensor_of(chain, **changes):
    return Sensor(LAYOUT, **{**BASE, **CHAINS[chain], **changes})


def model_of(sensor, *, is_device_known=True):
    return sensor.linearise(photo_e_per_s=PHOTO, exposure_s=1.0, is_device_known=is_device_known)


def codes_of(sensor, n_frames, photo=PHOTO):
    """Return codes (n_frame, n_site)."""
    return np.stack([sensor.expose(photo, 1.0, seed=3, frame=k)[2] for k in range(n_frames)]).astype(np.float64)


def dense_covariance(model):
    """Return the covariance of the codes, by application to unit vectors."""
    return model.apply_covariance(np.eye(N))


# -- consistency ------------------------------------------------------------------------------------------------------


@every_chain
@pytest.mark.parametrize("start", ["light", "charge", "collected", "node"])
def test_backward_is_transpose_of_forward(chain, start):
    model, rng = model_of(sensor_of(chain)), np.random.default_rng(1)
    x, y = rng.standard_normal((2, N))

    assert y @ model.forward(x, start) == pytest.approx(x @ model.backward(y, start), rel=1e-10, abs=1e-12)


@every_chain
def test_forward_is_difference_of_predicted_means(chain):
    """The noise spans more than one code, so that predicted means are smooth."""
    sensor = sensor_of(chain)
    change = 20.0 * np.random.default_rng(2).standard_normal(N)
    ahead, behind = (sensor.predict(sensor.expected_electrons(PHOTO + part, 1.0))[0] for part in (change, -change))

    found = model_of(sensor).forward(change, "light")

    assert found == pytest.approx(0.5 * (ahead - behind), rel=2e-5, abs=2e-5)


@every_chain
def test_variance_is_diagonal_of_covariance(chain):
    model = model_of(sensor_of(chain))
    covariance = dense_covariance(model)
    i, j = np.divmod(np.arange(N * N), N)

    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-12, atol=1e-12)
    assert model.variance_dn2() == pytest.approx(np.diagonal(covariance), rel=1e-12)
    np.testing.assert_allclose(model.covariance_dn2(i, j), covariance.ravel(), rtol=1e-10, atol=1e-12)
    assert model.covariance_matrix_dn2(np.arange(5)) == pytest.approx(covariance[:5, :5], rel=1e-10, abs=1e-12)


@every_chain
def test_solutions_invert_covariance(chain):
    model, rng = model_of(sensor_of(chain)), np.random.default_rng(1)
    values, known = rng.standard_normal((3, N)), np.flatnonzero(rng.random(N) < 0.6)
    covariance = dense_covariance(model)

    assert model.solve_covariance(values) == pytest.approx(np.linalg.solve(covariance, values.T).T, rel=1e-7, abs=1e-9)
    part = np.zeros_like(values)
    part[:, known] = np.linalg.solve(covariance[np.ix_(known, known)], values[:, known].T).T
    assert model.solve_covariance(values, known) == pytest.approx(part, rel=1e-7, abs=1e-9)
    derivatives = model.forward(values)
    assert model.information(values) == pytest.approx(
        derivatives @ np.linalg.solve(covariance, derivatives.T), rel=1e-7, abs=1e-9
    )
    assert values @ model.weigh(values).T == pytest.approx(model.information(values), rel=1e-9, abs=1e-12)


@every_chain
def test_sources_sum_to_variance(chain):
    model = model_of(sensor_of(chain))
    temporal = [name for name, kind in model.sources.items() if kind != "fixed"]

    parts = sum(model.variance_dn2([name]) for name in temporal)

    assert parts == pytest.approx(model.variance_dn2(), rel=1e-12)
    without = model.variance_dn2(is_reset=False)
    assert (
        np.all(without < model.variance_dn2()) if "reset" in temporal else np.array_equal(without, model.variance_dn2())
    )


@every_chain
def test_temporal_budget_sums_to_prediction(chain):
    sensor = sensor_of(chain, nonlinearity_fraction=0.0, bits=14)
    model, budget = model_of(sensor), noise_budget(sensor, PHOTO, 1.0)
    _, variance_dn2 = sensor.predict(sensor.expected_electrons(PHOTO, 1.0))

    total_e2 = sum(budget[name] ** 2 for name in budget.temporal)

    assert total_e2 * model.gain_dn_per_e**2 == pytest.approx(variance_dn2, rel=1e-9)
    assert model.variance_dn2() == pytest.approx(variance_dn2, rel=1e-9)


def test_several_charges_take_one_call():
    sensor = sensor_of("all")
    charges = np.stack([0.3 * PHOTO, PHOTO, 1.4 * PHOTO])

    together, apart = sensor.linearise(charges), [sensor.linearise(charge) for charge in charges]

    for name in ("variance_dn2", "variance_e2"):
        assert getattr(together, name)() == pytest.approx(
            np.stack([getattr(each, name)() for each in apart]), rel=1e-12
        )
    assert together.forward(np.ones(N)) == pytest.approx(np.stack([each.forward(np.ones(N)) for each in apart]))
    with pytest.raises(ParameterError, match="must be one charge per site for covariances"):
        together.solve_covariance(np.ones(N))


# -- against draws ----------------------------------------------------------------------------------------------------


#: Differences of columns and rows of two sites.
OFFSETS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (5, 4))


def pairs_of(offset):
    """Return the indices of all pairs of sites with an offset."""
    row, column = np.divmod(np.arange(N), N_X)
    first = np.flatnonzero((column + offset[0] < N_X) & (row + offset[1] < N_Y))
    return first, first + offset[0] + N_X * offset[1]


def sums_over_pairs(codes, covariance):
    """
    Compare products of codes, summed over all pairs of sites with the same offset, with their covariances.

    Yields the offset, the sum of covariances, that of products less it, and its standard error: frames are independent. First for
    the codes, then for their differences to the mean of their row, without the noise of rows, which hides all other.
    """
    n_frames = len(codes)
    of_row = np.kron(np.eye(N_Y), np.full((N_X, N_X), 1.0 / N_X))
    for keep in (np.eye(N), np.eye(N) - of_row):
        off, expected = (codes - codes.mean(axis=0)) @ keep, keep @ covariance @ keep
        for offset in OFFSETS:
            i, j = pairs_of(offset)
            products = (off[:, i] * off[:, j]).sum(axis=1) * n_frames / (n_frames - 1)
            total = expected[i, j].sum()
            yield offset, total, products.mean() - total, products.std(ddof=1) / np.sqrt(n_frames)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("bits", [8, 12])
def test_covariance_matches_draws(bits):
    n_frames, full_e = 2000, 2e4 * (16 if bits == 8 else 1) / 16
    # At least one code of noise at both resolutions.
    sensor = sensor_of(
        "mixed", bits=bits, capacitance_f=full_e * ELEMENTARY_CHARGE_C, effects=[RowNoise(60.0 if bits == 8 else 30.0)]
    )
    photo = PHOTO * 0.4 * full_e / 9000.0
    codes = codes_of(sensor, n_frames, photo)
    covariance = dense_covariance(sensor.linearise(photo_e_per_s=photo, exposure_s=1.0))
    row = np.zeros((N_Y, N))
    row[np.arange(N) // N_X, np.arange(N)] = 1.0

    centred = codes - codes.mean(axis=0)
    drawn = centred.T @ centred / (n_frames - 1)
    variance = np.diagonal(covariance)
    # Standard error of a covariance of Gaussian variables.
    error = np.sqrt((np.multiply.outer(variance, variance) + covariance**2) / n_frames)
    z = (drawn - covariance) / error
    assert np.abs(z[np.triu_indices(N)]).max() < 5.0
    for offset, _, difference, standard_error in sums_over_pairs(codes, covariance):
        assert abs(difference) < 5.0 * standard_error, offset
    sums, expected = centred @ row.T, np.einsum("ri,ij,rj->r", row, covariance, row)
    assert np.abs(sums.var(axis=0, ddof=1) / expected - 1.0).max() < 5.0 * np.sqrt(2.0 / n_frames)


@pytest.mark.slow
def test_fixed_entries_match_variance_over_devices():
    """With crosstalk before and after the collection, and without temporal noise of the mean."""
    n_devices, n_x, n_y = 60, 20, 60
    layout = grid(n_x=n_x, n_y=n_y, pitch_um=4.0).with_columns(readout_line=np.repeat(np.arange(n_y), n_x))
    photo = np.linspace(2000.0, 9000.0, layout.n_sites)
    changes = {
        "crosstalk": Diffusion(spread_um=1.5), "coupling": IPC, "prnu_fraction": 0.03, "dsnu_fraction": 0.3,
        "hot_fraction": 0.2, "hot_e_per_s": 400.0, "dead_fraction": 0.1, "gain_fpn_fraction": 0.02,
        "pixel_fpn_fraction": 0.01, "line_fpn_fraction": 0.01, "read_noise_e": 20.0, "bits": 14,
    }  # fmt: skip
    sensor = Sensor(layout, **{**BASE, **changes})
    budget = noise_budget(sensor, photo, 1.0)
    fixed = [name for name in budget if name not in budget.temporal]

    for names in (["prnu"], ["dead"], ["dsnu"], ["hot"], ["gain_fpn"], ["pixel_fpn"], ["column_fpn"], ["prnu", "dead"]):
        others = sensor.without(*(name for name in fixed if name not in names))
        mean_dn = np.stack([
            each.predict(each.expected_electrons(photo, 1.0))[0]
            for each in (Sensor(layout, **{**BASE, **changes, "device_seed": k, "disabled": others.disabled}) for k in range(n_devices))
        ])  # fmt: skip
        model = others.linearise(photo_e_per_s=photo, exposure_s=1.0, is_device_known=False)
        own = noise_budget(others, photo, 1.0)
        expected = sum(own[name] ** 2 for name in names) * model.gain_dn_per_e**2
        # Mean over the sites of each device: the sites are correlated, the devices are not.
        squares = ((mean_dn - mean_dn.mean(axis=0)) ** 2 / expected).mean(axis=1) * n_devices / (n_devices - 1)
        assert squares.mean() == pytest.approx(1.0, abs=5.0 * squares.std() / np.sqrt(n_devices)), names


# -- effects and parameters -------------------------------------------------------------------------------------------


def test_effect_and_sensitivity_are_equal():
    keywords = {
        **BASE, "prnu_fraction": 0.05, "crosstalk": Diffusion(spread_um=1.5), "coupling": IPC, "read_noise_e": 5.0,
        "capacitance_f": BASE["capacitance_f"] * np.linspace(0.9, 1.1, N),
    }  # fmt: skip
    by_effect = Sensor(LAYOUT, **keywords, effects=[RowNoise(), Shading()])
    by_keyword = Sensor(LAYOUT, **keywords, effects=[RowNoise()], sensitivity=SHADING)
    patterns = np.random.default_rng(5).standard_normal((2, N))

    one, other = (model_of(sensor) for sensor in (by_effect, by_keyword))

    assert one.variance_dn2() == pytest.approx(other.variance_dn2(), rel=1e-12)
    assert one.forward(patterns, "light") == pytest.approx(other.forward(patterns, "light"), rel=1e-12)
    assert one.information(patterns, "light") == pytest.approx(other.information(patterns, "light"), rel=1e-9)
    for is_known in (True, False):
        assert by_effect.light_response(is_device_known=is_known) == pytest.approx(
            by_keyword.light_response(is_device_known=is_known), rel=1e-12
        )
    budgets = [noise_budget(sensor, PHOTO, 1.0) for sensor in (by_effect, by_keyword)]
    for name, noise_e in budgets[1].items():
        assert budgets[0][name] == pytest.approx(noise_e, rel=1e-10, abs=1e-12), name
    assert by_effect.calibrate(exposure_s=1.0, flat_e=8000.0, n_frames=3, seed=1).expected_dn == pytest.approx(
        by_keyword.calibrate(exposure_s=1.0, flat_e=8000.0, n_frames=3, seed=1).expected_dn, rel=1e-12
    )


def test_own_effects_change_all_noise_alike():
    class Hiss(AdditiveNoise):
        name, stage = "hiss", "charge"

        def deviation(self, sites):
            return 12.0

    own, keyword = (Sensor(LAYOUT, **BASE, **noise) for noise in ({"effects": [Hiss()]}, {"read_noise_e": 12.0}))
    charge_e, dark_e = own.expected_electrons(PHOTO, 1.0), own.expected_electrons(np.zeros(N), 1.0)

    assert signal_to_noise(own, charge_e, dark_e).ratio == pytest.approx(
        signal_to_noise(keyword, charge_e, dark_e).ratio, rel=1e-14
    )


# -- predictions ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("bits", [1, 8, 12])
def test_predicted_covariance_matches_draws(bits):
    """At one bit the covariance is a lower bound; the mean is at the threshold."""
    n_frames = 2000
    changes = {"v_sat_v": 0.6, "pedestal_v": 0.05} if bits == 1 else {"v_sat_v": 1.0}
    sensor = sensor_of(
        "mixed", bits=bits, effects=[RowNoise(60.0)], **{"v_sat_v": 1.0, **changes, "read_noise_e": 40.0},
    )  # fmt: skip
    charge_e = np.full(N, 5000.0)
    codes = np.stack([
        sensor.read(sensor.collect(charge_e, seed=3, frame=k), seed=3, frame=k) for k in range(n_frames)
    ]).astype(float)  # fmt: skip

    predicted = sensor.predict_covariance(charge_e, np.arange(N))

    assert np.array_equal(np.diagonal(predicted), sensor.predict(charge_e)[1])
    some = np.array([60, 0, 13])
    assert np.array_equal(sensor.predict_covariance(charge_e, some), predicted[np.ix_(some, some)])
    for offset, expected, difference, error in sums_over_pairs(codes, predicted):
        if bits > 1:
            assert abs(difference) < 5.0 * error, offset
        else:
            assert difference > -5.0 * error, offset
            is_variance = offset == (0, 0)
            assert is_variance or abs(difference) < 0.25 * abs(expected) + 5.0 * error, offset


@pytest.mark.parametrize("name", ["conversion", "nonlinearity", "sensitivity", "exposure", "collected"])
def test_names_of_effects_have_no_meaning(name):
    """Steps of the chain that are not effects are not identified by names."""

    @dataclass(frozen=True)
    class Affine(Effect):
        name: ClassVar[str] = "other"
        is_temporal: ClassVar[bool] = False

        stage: str

        def apply(self, values, *, sites, rng):
            return 0.5 * values + 0.01

        def moments(self, mean, variance, *, sites):
            return 0.5 * mean + 0.01, 0.25 * variance

    renamed = type("Renamed", (Affine,), {"name": name})
    for stage in ("charge", "sense_node", "output"):
        sensors = [sensor_of("plain", effects=[kind(stage)]) for kind in (Affine, renamed)]
        one, other = (sensor.predict(PHOTO) for sensor in sensors)
        assert np.array_equal(one, other)
        assert np.array_equal(*(sensor.linearise(PHOTO).variance_dn2() for sensor in sensors))


# -- saturation -------------------------------------------------------------------------------------------------------


def test_saturated_sites_have_no_derivative():
    sensor = sensor_of("rows")
    charge_e = np.where(np.arange(N) % 3 == 0, 1e6, PHOTO)
    model = sensor.linearise(charge_e)

    assert np.array_equal(model.is_saturated, np.arange(N) % 3 == 0)
    assert np.all(model.forward(np.ones(N))[model.is_saturated] == 0.0)
    assert np.all(model.node_e[model.is_saturated] == pytest.approx(model.saturation_e[0]))
    assert np.isfinite(model.information(np.ones((1, N)))).all()


@pytest.mark.parametrize("companding", ["linear", "root", "log"])
def test_information_falls_with_light(companding):
    rng = np.random.default_rng(7)
    patterns = rng.standard_normal((1, N)) * PHOTO
    for _ in range(20):
        sensor = sensor_of(
            "plain", companding=companding, read_noise_e=float(rng.uniform(0.5, 30.0)), bits=int(rng.integers(6, 14)),
            prnu_fraction=float(rng.uniform(0.0, 0.1)), effects=[RowNoise(float(rng.uniform(0.0, 30.0)))],
        )  # fmt: skip
        share = rng.uniform(0.2, 1.0, N) * (rng.random(N) > 0.2)  # a fifth of the sites is dead
        lit, dim = (
            sensor.linearise(photo_e_per_s=PHOTO * part, exposure_s=1.0).information(patterns * part, "light")[0, 0]
            for part in (1.0, share)
        )
        assert dim <= lit


# -- inversion --------------------------------------------------------------------------------------------------------


class Compression(Effect):
    """Test effect: output that flattens at tenths of a volt."""

    name, stage, is_temporal = "compression", "output", False

    def apply(self, values, *, sites, rng):
        return 0.4 * np.log1p(values / 0.4)

    def moments(self, mean, variance, *, sites):
        return 0.4 * np.log1p(mean / 0.4), variance / (1.0 + mean / 0.4) ** 2


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"companding": "root", "nonlinearity_fraction": 0.2},
        {"companding": "log", "nonlinearity_fraction": 0.5},
        {"inl_dn": (0.0, 3.0, -2.0, 0.0), "effects": [Compression()]},
        {"gain_fpn_fraction": 0.1, "pixel_fpn_fraction": 0.05},
    ],
)
def test_inverse_reproduces_mean_codes(changes):
    """The nominal chain maps the charge of a code to the centre of this code."""
    sensor = Sensor(LAYOUT, **{**BASE, "v_sat_v": 1.0, **changes})
    code = sensor.linearise(np.linspace(1000.0, 14_000.0, N), is_device_known=False).mean_dn.round()

    found = sensor.invert(code)

    assert sensor.linearise(np.maximum(found.charge_e, 0.0), is_device_known=False).mean_dn == pytest.approx(
        code, abs=1e-6
    )
    assert not found.is_saturated.any()


def test_codes_out_of_reach_have_no_weight():
    """A response that ends at half the range: higher codes have a finite charge, and an infinite variance."""

    class Ending(Effect):
        name, stage, is_temporal = "ending", "output", False

        def apply(self, values, *, sites, rng):
            return 0.5 * np.tanh(values / 0.5)

        def moments(self, mean, variance, *, sites):
            return 0.5 * np.tanh(mean / 0.5), variance * (1.0 - np.tanh(mean / 0.5) ** 2) ** 2

    found = sensor_of("plain", effects=[Ending()]).invert(np.where(np.arange(N) % 2, 1000, 3000))

    assert np.isfinite(found.charge_e).all()
    assert np.array_equal(np.isinf(found.noise_e2), np.arange(N) % 2 == 0)


def test_wrong_arguments_are_rejected():
    sensor = sensor_of("plain")
    model = sensor.linearise(PHOTO)
    for call, message in (
        (sensor.linearise, "'expected_e' must be given, or 'photo_e_per_s', but not both"),
        (lambda: sensor.linearise(PHOTO, photo_e_per_s=PHOTO), "'expected_e' must be given, or 'photo_e_per_s'"),
        (lambda: sensor.linearise(photo_e_per_s=PHOTO), "'exposure_s' must be given with 'photo_e_per_s'"),
        (lambda: sensor.linearise(-PHOTO), "'expected_e' must be >= 0"),
        (lambda: sensor.linearise(PHOTO[:3]), "'expected_e' must have"),
        (lambda: sensor.linearise("many"), "'expected_e' must be an array of numbers, got 'many'"),
        (lambda: sensor.predict_covariance(PHOTO, [0.5]), "'sites' must be indices of the 120 sites"),
        (
            lambda: model.forward(np.ones(N), "light"),
            "'start' must be 'charge', 'collected' or 'node', or 'light' with",
        ),
        (lambda: model.variance_dn2(["raed"]), "'sources' must be names from .*'read'"),
        (lambda: model.covariance_dn2([0, 1], [2]), "'others' must have as many elements as 'sites'"),
        (lambda: model.covariance_dn2([N], [0]), "'sites' must be indices of the 120 sites"),
        (lambda: sensor.invert(np.full(N, 4096.0)), "'code' must be <= 4095"),
    ):
        with pytest.raises(ParameterError, match=message):
            call()
