"""Collections of a user: draws, tables and inverse against scipy, on every route."""

from __future__ import annotations

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
import scipy
from reference.own_effects import Gates

import foveasim as fs
from foveasim._core.random_streams import Streams
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Sensor, non_destructive_reads
from foveasim.sensor.effects import EFFECTS, Collection, ShotNoise
from foveasim.testing import check_sensor_effect

N = 100_000
LAYOUT = grid(n_x=400, n_y=250, pitch_um=2.0)
SITES = Sensor(LAYOUT).sites


EFFECTS.register("gates of test_collection", example={"n_gates": 900})(Gates)


@dataclass(frozen=True)
class DeadTime(Collection):
    """Poisson draw with a mean that the dead time reduces."""

    name = "dead_time"
    needs_exposure = True

    dead_s: float = 1e-3

    def factor(self, mean, sites):
        return 1.0 / (1.0 + mean * self.dead_s / sites.exposure_s)

    def cumulative(self, count, mean, *, sites):
        return scipy.stats.poisson.cdf(count, mean * self.factor(mean, sites))

    def moments(self, mean, variance, *, sites):
        factor = self.factor(mean, sites)
        return mean * factor, variance * factor**4 + mean * factor


def assert_binomial(drawn, n_gates, mean_e):
    """Chi-square test of counts against the binomial distribution."""
    expected = scipy.stats.binom(n_gates, -np.expm1(-mean_e / n_gates))
    low, high = expected.ppf(1e-3), expected.ppf(1 - 1e-3)
    inner = np.arange(low, high + 1)
    observed = np.array([np.sum(drawn <= low), *(np.sum(drawn == k) for k in inner[1:]), np.sum(drawn > high)])
    probability = np.diff([0.0, *expected.cdf(inner), 1.0])
    some = probability > 0.0
    assert observed[~some].sum() == 0
    assert scipy.stats.chisquare(observed[some], probability[some] * drawn.size).pvalue > 1e-4
    assert abs(drawn.mean() - expected.mean()) < 5.0 * expected.std() / np.sqrt(drawn.size)
    assert drawn.var() == pytest.approx(expected.var(), rel=5.0 * np.sqrt(2.0 / drawn.size))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(("n_gates", "mean_e"), [(100, 0.3), (100, 60.0), (100, 400.0), (5000, 900.0)])
def test_draws_are_binomial(n_gates, mean_e):
    sensor = Sensor(LAYOUT, effects=[Gates(n_gates)])

    drawn = sensor.collect(np.full(N, mean_e), seed=3)

    assert_binomial(drawn, n_gates, mean_e)
    assert np.array_equal(drawn, sensor.collect(np.full(N, mean_e), seed=3, n_threads=1))
    assert np.array_equal(drawn, pickle.loads(pickle.dumps(sensor)).collect(np.full(N, mean_e), seed=3))


@pytest.mark.parametrize("mean_e", [0.4, 8.0, 80.0, 3000.0])
def test_draws_of_default_bisection_invert_cumulative(mean_e):
    u = np.random.default_rng(1).random(20_000)
    sites = SITES.block(slice(0, u.size))

    found = ShotNoise("exact").quantile(u, np.full(u.size, mean_e), sites=sites)

    assert np.array_equal(found, scipy.stats.poisson.ppf(u, mean_e))


def test_draws_do_not_depend_on_other_sites():
    sensor = Sensor(LAYOUT, effects=[Gates()])
    mean_e = np.geomspace(0.01, 500.0, N)

    few = sensor.part(slice(0, 1000)).collect(mean_e[:1000], seed=3)

    assert np.array_equal(few, sensor.collect(mean_e, seed=3)[:1000])


@pytest.mark.slow
def test_captures_tiles_and_video_are_binomial():
    sensor = Sensor(LAYOUT, effects=[Gates()], bits=12)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    light = fs.PowerMap.from_array(np.full((100, 100), 1e-3), pitch_um=10.0, wavelength_nm=550.0)
    mean_e = float(camera.photoelectrons_per_s(light)[0] * 0.005)

    capture = camera.capture(light, exposure_s=0.005, seed=2)
    tiles = list(fs.tiles.capture_tiles(camera, light, exposure_s=0.005, seed=2, tile_sites=1))
    frames = list(camera.video([light, light], exposure_s=0.005, seed=2))

    assert_binomial(capture.electrons, 100, mean_e)
    assert_binomial(frames[1].electrons, 100, mean_e)
    assert np.array_equal(frames[0].electrons, capture.electrons)
    assert len(tiles) == 2
    assert np.array_equal(np.concatenate([tile.electrons for tile in tiles]), capture.electrons)


def test_table_contains_all_probabilities():
    mean = np.concatenate([[0.0, 1e-9], np.geomspace(1e-3, 3000.0, 200), [1e5]])
    for collection, distribution in (
        (Gates(500), scipy.stats.binom(500, -np.expm1(-mean / 500))),
        (ShotNoise(), scipy.stats.poisson(mean)),
    ):
        first, probability, offsets = collection.table(mean, sites=SITES.block(slice(0, mean.size)))

        site = np.repeat(np.arange(mean.size), np.diff(offsets))
        count = np.arange(probability.size) - offsets[site] + first[site]
        pmf = distribution.args[0], *distribution.args[1:]
        expected = distribution.dist.pmf(count, *(np.broadcast_to(part, mean.shape)[site] for part in pmf))
        np.testing.assert_allclose(probability, expected, atol=2e-12)
        assert np.all(distribution.cdf(first - 1.0) <= 1.2e-16)
        assert np.all(distribution.sf(first + np.diff(offsets) - 1.0) <= 3e-16)


def test_mean_is_inverted():
    mean = np.geomspace(1e-3, 2000.0, 300)
    sites = SITES.block(slice(0, 300))
    gates = Gates(100)

    found = gates.invert(gates.moments(mean, 0.0, sites=sites)[0], sites=sites)

    is_resolved = mean < 1000.0
    np.testing.assert_allclose(found[is_resolved], mean[is_resolved], rtol=1e-5)
    assert np.isinf(gates.invert(np.full(300, 101.0), sites=sites)).all()
    assert ShotNoise().invert(mean, sites=sites) == pytest.approx(mean)


def test_linear_model_is_that_of_moments():
    mean = np.geomspace(0.5, 300.0, 50)

    found = Gates(100).validate_linear(mean, SITES.block(slice(0, 50)))

    np.testing.assert_allclose(found.slope, np.exp(-mean / 100), rtol=1e-5)
    np.testing.assert_allclose(found.deviation**2, 100 * np.exp(-mean / 100) * -np.expm1(-mean / 100))
    assert np.isfinite(Gates(100).validate_linear(np.zeros(50), SITES.block(slice(0, 50))).slope).all()


@pytest.mark.parametrize("name", ["gates", "shot"])
def test_disabled_collection_is_rounded_mean(name):
    sensor = Sensor(LAYOUT, effects=[Gates()]).without(name)

    assert not sensor.collection.is_drawn
    assert np.unique(sensor.collect(np.full(N, 80.0))) == [np.rint(100 * -np.expm1(-0.8))]
    assert [effect.name for effect in sensor.chain] == ["gates"]


def test_exposure_time_is_required_where_needed():
    sensor = Sensor(LAYOUT, effects=[DeadTime()])

    with pytest.raises(ParameterError, match="'exposure_s' must be given: the collection 'dead_time' depends on it"):
        sensor.collect(np.full(N, 80.0), seed=1)
    for exposure_s in (0.1, 1.0):  # the second one does not have cached results of the first
        drawn = sensor.collect(np.full(N, 80.0), seed=1, exposure_s=exposure_s)
        mean_e = 80.0 / (1.0 + 0.08 / exposure_s)
        assert abs(drawn.mean() - mean_e) < 5.0 * np.sqrt(mean_e / N)
        _, exposed, _ = sensor.expose(np.full(N, 80.0 / exposure_s), exposure_s, seed=1)
        assert np.array_equal(exposed, drawn)


def test_reads_require_independent_increments():
    sensor = Sensor(LAYOUT, effects=[Gates()])

    with pytest.raises(SimulationError, match="require a collection with independent increments, but those of 'gates'"):
        non_destructive_reads(sensor, 10.0, [1.0, 2.0], seed=0)
    assert non_destructive_reads(sensor.without("gates"), 10.0, [1.0, 2.0], seed=0).electrons[1, 0] == 18


@dataclass(frozen=True)
class More(Gates):
    name = "more"


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"effects": [Gates(), More()]}, "'effects' must have at most one Collection, got 'gates', 'more'"),
        (
            {"effects": [Gates()], "shot_noise": "exact"},
            "'shot_noise' and 'gaussian_above_e' must be the defaults with",
        ),
        (
            {"effects": [Gates()], "gaussian_above_e": 50.0},
            "'shot_noise' and 'gaussian_above_e' must be the defaults with",
        ),
    ],
)
def test_other_draws_are_rejected(keywords, message):
    with pytest.raises(ParameterError, match=message):
        Sensor(LAYOUT, **keywords)


def test_shot_noise_is_accepted_as_effect():
    sensor = Sensor(LAYOUT, effects=[ShotNoise("exact")])

    drawn = sensor.collect(np.full(N, 30.0), seed=2)

    assert np.array_equal(drawn, Sensor(LAYOUT, shot_noise="exact").collect(np.full(N, 30.0), seed=2))


def test_seed_is_required_for_draws():
    sensor = Sensor(LAYOUT, read_noise_e=2.0)

    with pytest.raises(ParameterError, match="'seed' must be given for the draws of 'shot'"):
        sensor.collect(np.full(N, 30.0))
    with pytest.raises(ParameterError, match="'seed' must be given for the draws of 'read'"):
        sensor.read(np.full(N, 30))
    with pytest.raises(ParameterError, match="'seed' must be given for the draws of 'shot', 'read'"):
        sensor.expose(np.full(N, 30.0), 1.0)
    quiet = sensor.without("shot", "read")
    assert quiet.collect(np.full(N, 30.2))[0] == 30


class Inconsistent(Gates):
    def moments(self, mean, variance, *, sites):
        after, spread2 = super().moments(mean, variance, sites=sites)
        return after, 1.05 * spread2


class Incomplete(Gates):
    def cumulative(self, count, mean, *, sites):
        return 0.9 * super().cumulative(count, mean, sites=sites)


class OtherDraws(Gates):
    def apply(self, values, *, sites, rng):
        return rng.poisson(self.moments(values, 0.0, sites=sites)[0]).astype(float)


def test_consistent_collection_passes_check():
    check_sensor_effect("gates", {"effects": [Gates(900)]})


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (Inconsistent, AssertionError, r"has a cumulative\(\) whose variance differs from that of its moments"),
        (Incomplete, SimulationError, "must have a cumulative probability that reaches 1"),
        (OtherDraws, AssertionError, r"has draws whose variance differs by .* from that of moments\(\)"),
    ],
)
def test_check_finds_wrong_collections(wrong, error, message):
    with pytest.raises(error, match=message):
        check_sensor_effect("gates", {"effects": [wrong(900)]})


def test_settings_files_accept_collections(tmp_path):
    (tmp_path / "shot.yaml").write_text(
        "scene: {kind: flat, radiance_w_m2_sr_nm: 0.02, shape: [32, 32], pitch_um: 500.0, distance_m: 1.0,"
        " wavelength_nm: [550.0], band_width_nm: 50.0}\n"
        "optics: {focal_length_mm: 8.0, f_number: 2.8}\n"
        "layout: {generator: grid, parameters: {n_x: 40, n_y: 40, pitch_um: 2.0}}\n"
        "sensor: {effects: [{kind: gates of test_collection, n_gates: 900}]}\n"
        "exposure_s: 0.001\n"
    )
    shot = fs.config.read_shot(tmp_path / "shot.yaml")
    capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=1)

    assert shot.camera.sensor.collection == Gates(900)
    assert capture.electrons.max() <= 900
    expected = scipy.stats.binom(900, -np.expm1(-capture.expected_e / 900))
    z = (capture.electrons - expected.mean()) / expected.std()
    assert abs(z.mean()) < 5.0 / np.sqrt(z.size)
    assert z.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / z.size))


def test_streams_of_blocks_are_those_of_tiles():
    sites = SITES.block(slice(0, 10))
    drawn = Gates().apply(np.full(10, 50.0), sites=sites, rng=Streams(1).of("gates", 0))

    assert np.array_equal(drawn, Sensor(LAYOUT, effects=[Gates()]).collect(np.full(N, 50.0), seed=1)[:10])
