"""Effects common to groups of sites, and effects that mix them: parts and tiles, operators, and their checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import CrosstalkOperator, Diffusion, Sensor, non_destructive_reads
from foveasim.sensor.effects import AdditiveNoise, Effect, GroupedNoise, Mixing
from foveasim.testing import check_sensor_effect

N_X, N_Y = 500, 400
N = N_X * N_Y
LAYOUT = grid(n_x=N_X, n_y=N_Y, pitch_um=2.0).with_columns(readout_line=np.arange(N) // N_X)
FINE = {"bits": 14, "v_sat_v": 1.0, "capacitance_f": 1e-15, "shot_noise": "off"}


@dataclass(frozen=True)
class RowNoise(GroupedNoise):
    name = "row_noise"
    stage = "charge"

    sigma_e: float = 20.0

    def deviation(self, sites):
        return self.sigma_e * np.linspace(0.5, 1.5, sites.n_sites)


@dataclass(frozen=True)
class FarLabels(RowNoise):
    """Labels of any size, in another order than the sites."""

    def groups(self, sites):
        return np.array([-(2**63), 2**63 - 1, 2**60, -5], np.int64)[np.arange(sites.n_sites) % 4]


@dataclass(frozen=True)
class ResetRows(RowNoise):
    is_drawn_at_reset = True


@dataclass(frozen=True)
class OwnRows(Effect):
    """Row noise with an apply() of its own."""

    name = "own_rows"
    stage = "charge"
    is_temporal = True
    reach = "group"

    def apply(self, values, *, sites, rng):
        return values + 20.0 * rng.standard_normal(N_Y)[sites.select(sites.layout.readout_line)]

    def moments(self, mean, variance, *, sites):
        return mean, variance + 400.0


EFFECTS = [RowNoise(), FarLabels(), OwnRows()]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: type(effect).__name__)
def test_group_noise_of_parts_equals_sensor(effect):
    sensor = Sensor(LAYOUT, effects=[effect], **FINE)
    charge_e = np.full(N, 3000)
    complete = sensor.read(charge_e, seed=1, frame=2)

    assert complete.std() > 1.0
    assert np.array_equal(complete, sensor.read(charge_e, seed=1, frame=2, n_threads=1))
    for selection in (slice(70_000, 140_000), slice(5, None, 3), np.random.default_rng(1).permutation(N)[:5000]):
        part = sensor.part(selection)
        found = part.read(charge_e[: part.layout.n_sites], seed=1, frame=2)
        assert np.array_equal(found, complete[selection])
    assert not np.array_equal(complete, sensor.read(charge_e, seed=1, frame=3))


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: type(effect).__name__)
def test_group_noise_of_tiles_equals_capture(effect):
    sensor = Sensor(LAYOUT, effects=[effect], read_noise_e=2.0, **FINE)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    light = fs.PowerMap.from_array(np.full((100, 100), 1e-3), pitch_um=10.0, wavelength_nm=550.0)

    capture = camera.capture(light, exposure_s=0.2, seed=2)
    tiles = list(fs.tiles.capture_tiles(camera, light, exposure_s=0.2, seed=2, tile_sites=1))

    assert len(tiles) == 4
    assert np.array_equal(np.concatenate([tile.code for tile in tiles]), capture.code)


def test_group_noise_has_gaussian_draws():
    sites = Sensor(LAYOUT).sites
    rng = np.random.Generator(np.random.PCG64DXSM(4))

    @dataclass(frozen=True)
    class PerSite(RowNoise):
        def deviation(self, sites):
            return 1.0

        def groups(self, sites):
            return np.arange(sites.n_sites) * 1_000_003

    z = PerSite().apply(np.zeros(N), sites=sites, rng=rng)

    assert abs(z.mean()) < 5.0 / np.sqrt(N)
    assert z.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / N))
    assert np.abs(np.corrcoef(z[1:], z[:-1])[0, 1]) < 5.0 / np.sqrt(N)


def test_reset_noise_of_groups_cancels_in_ramps():
    sensor = Sensor(LAYOUT, effects=[ResetRows()], **FINE)

    code = non_destructive_reads(sensor, 3000.0, [1.0, 2.0], seed=1).code.astype(int)

    assert np.ptp(code[0]) > 10
    assert np.ptp(code[1] - code[0]) <= 1
    part = non_destructive_reads(sensor.part(slice(70_000, 140_000)), 3000.0, [1.0, 2.0], seed=1).code
    assert np.array_equal(part, code[:, 70_000:140_000])


def test_model_of_groups_has_their_labels():
    sites = Sensor(LAYOUT).sites.block(slice(700, 1300))

    model = FarLabels().validate_linear(np.full(600, 3.0), sites)
    rows = RowNoise().validate_linear(np.full(600, 3.0), sites)

    assert model.groups.tolist() == FarLabels().groups(Sensor(LAYOUT).sites)[700:1300].tolist()
    assert rows.groups.tolist() == (np.arange(700, 1300) // N_X).tolist()
    assert np.array_equal(rows.deviation, RowNoise().deviation(Sensor(LAYOUT).sites)[700:1300])


def test_groups_without_readout_lines_are_rejected():
    pair = fs.Layout.from_rectangles([[0.0, 0.0], [3.0, 0.0]], [[2.0, 2.0], [2.0, 2.0]])
    sensor = Sensor(pair, effects=[RowNoise()])

    with pytest.raises(SimulationError, match=r"'row_noise' requires a readout line .* add it, .* or define groups"):
        sensor.read(np.zeros(2), seed=0)


@pytest.mark.parametrize("labels", [0.5 * np.arange(16), np.arange(3), np.full(16, 2**63, np.uint64)])
def test_wrong_labels_are_rejected(labels):
    class Wrong(RowNoise):
        def groups(self, sites):
            return labels

    with pytest.raises(
        SimulationError, match=r"'row_noise' must have one label per site, int64 .*; check its groups\(\)"
    ):
        Sensor(grid(n_x=4, n_y=4, pitch_um=2.0), effects=[Wrong()]).read(np.zeros(16), seed=0)


# -- mixing ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lag(Mixing):
    """A tenth of each site's charge moves to the next site."""

    name = "lag"
    stage = "charge"

    n_steps: int = 1

    def operator(self, sites):
        n = sites.layout.n_sites
        rest = fs.sensor.CrosstalkOperator
        from scipy.sparse import csr_array, eye_array

        return rest(csr_array(0.9 * eye_array(n) + 0.1 * eye_array(n, k=-1)), self.n_steps)


def spread(n_steps):
    layout = grid(n_x=12, n_y=9, pitch_um=2.0)
    matrix = Diffusion(spread_um=0.5).compile(layout).matrix
    return CrosstalkOperator(matrix, n_steps), np.linalg.matrix_power(matrix.toarray(), n_steps)


@pytest.mark.parametrize("n_steps", [1, 2, 7])
def test_operator_equals_matrix_power(n_steps, monkeypatch):
    monkeypatch.setattr("foveasim.sensor.effects.crosstalk.MAX_ELEMENTS", 4000)  # several blocks of rows
    operator, power = spread(n_steps)
    values = np.random.default_rng(1).random((3, 108))

    np.testing.assert_allclose(operator.variance(values), values @ (power**2).T, rtol=1e-12)
    np.testing.assert_allclose(operator.transpose().apply(values), values @ power, rtol=1e-12)
    assert operator.transpose() is operator.transpose()
    np.testing.assert_allclose(operator.rows([5, 100, 5]).toarray(), power[[5, 100, 5]], atol=1e-15)
    left = operator.rows(np.array([1, 2]))
    np.testing.assert_allclose(operator.rows(left).toarray(), power[[1, 2]] @ power, atol=1e-15)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_user_mixing_is_compiled_once(n_steps):
    layout = LAYOUT[:2000]
    sensor = Sensor(layout, effects=[Lag(n_steps)], **FINE)
    charge_e = np.zeros(2000)
    charge_e[10] = 3000.0

    code = sensor.read(charge_e)
    model = sensor.chain[-1].validate_linear(charge_e, sensor.sites)
    other = sensor.chain[-1].validate_linear(charge_e, sensor.sites.without_device())

    assert code[10] > code[11] > code[12] >= code[0]
    assert model.slope is other.slope
    assert np.array_equal(model.mean, model.slope.apply(charge_e))
    check_sensor_effect("lag", {"effects": [Lag(n_steps)]})


class OldFlag(AdditiveNoise):
    name, stage, is_local = "old", "charge", False

    def deviation(self, sites):
        return 1.0


class WrongReach(RowNoise):
    reach = "row"


class TemporalAll(RowNoise):
    reach = "all"


class NotMixing(Effect):
    name, stage, is_temporal, reach = "smear", "charge", False, "all"

    def apply(self, values, *, sites, rng):
        return values

    def moments(self, mean, variance, *, sites):
        return mean, variance


class LateMixing(Lag):
    stage = "output"


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (OldFlag(), "'effects' must define 'reach' instead of 'is_local'"),
        (WrongReach(), "'effects' must have a reach of \"site\", \"group\" or \"all\"; 'row_noise' has 'row'"),
        (TemporalAll(), "must be deterministic, but 'row_noise' is temporal; use the reach \"group\""),
        (NotMixing(), r"must derive from Mixing and define operator\(\); change 'smear'"),
        (LateMixing(), "that mix sites must have a stage up to 'charge'; 'lag' has 'output'"),
    ],
)
def test_wrong_reach_is_rejected(effect, message):
    with pytest.raises(ParameterError, match=message):
        Sensor(LAYOUT[:4], effects=[effect])


@dataclass(frozen=True)
class Saturating(Effect):
    name = "saturating"
    stage = "expected"
    is_temporal = False

    def apply(self, values, *, sites, rng):
        return values / (1.0 + values / 1e5)

    def moments(self, mean, variance, *, sites):
        return mean / (1.0 + mean / 1e5), variance


def test_check_finds_nonlinear_light():
    with pytest.raises(AssertionError, match="is not affine in the light"):
        check_sensor_effect("saturating", {"effects": [Saturating()]})
