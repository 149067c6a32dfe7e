"""Contract of effects: draws, moments and noise budget agree, and effects are independent of each other."""

from __future__ import annotations

import inspect
import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim._core.random_streams import Streams
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Sensor, effects, noise_budget, signal_to_noise
from foveasim.sensor.effects import AdditiveNoise, Effect, FixedFactor, FixedOffset, GroupedNoise, ShotNoise, Sites
from foveasim.testing import check_sensor_effect

SIGMAS = 5.0
N = 40_000
ROW = grid(n_x=N, n_y=1, pitch_um=2.0).with_columns(readout_line=np.arange(N))
PHOTO_E, EXPOSURE_S = 5000.0, 0.5
#: 16 bits, 1 e- per code, with a pedestal; signals are far from both ends of the range.
FINE = {"bits": 16, "v_sat_v": 3.0, "capacitance_f": 65_536 * scipy.constants.e / 3.0, "pedestal_v": 0.5}


@dataclass(frozen=True)
class LampFlicker(AdditiveNoise):
    """Test effect: Gaussian noise of the output voltage that increases from left to right."""

    name: ClassVar[str] = "flicker"
    stage: ClassVar[str] = "output"

    sigma_v: float = 4e-4

    def deviation(self, sites):
        return self.sigma_v * np.linspace(0.5, 1.5, sites.n_sites)


@dataclass(frozen=True)
class LensShading(FixedFactor):
    """Test effect: fixed pattern with mean response 0.9 and a random part."""

    name: ClassVar[str] = "shading"
    stage: ClassVar[str] = "photo"

    def pattern(self, sites):
        return 0.9 + 0.05 * sites.device.normals(self.name)

    def pattern_moments(self, sites):
        return 0.9, 0.05**2


@dataclass(frozen=True)
class Hum(Effect):
    """Test effect derived from Effect only: multiplicative temporal noise of the charge, a sequence over all sites."""

    name: ClassVar[str] = "hum"
    stage: ClassVar[str] = "charge"
    is_temporal: ClassVar[bool] = True
    reach: ClassVar[str] = "group"

    sigma: float = 0.02

    def apply(self, values, *, sites, rng):
        return values * (1.0 + self.sigma * sites.select(rng.standard_normal(sites.layout.n_sites)))

    def moments(self, mean, variance, *, sites):
        return mean, variance * (1.0 + self.sigma**2) + (mean * self.sigma) ** 2


#: Keywords that enable a single effect, by its name.
CASES = {effect.name: effect.example for effect in (*effects.STANDARD, ShotNoise)} | {
    effect.name: {"effects": [effect]} for effect in (LampFlicker(), LensShading(), Hum())
}
every_effect = pytest.mark.parametrize("name", CASES)


def make_sensor(name="", *, shot_noise="off", **more):
    keywords = CASES.get(name, {})
    return Sensor(ROW, **FINE, **{"shot_noise": shot_noise, **keywords, **more})


def codes(sensor, frame=0, seed=1):
    expected_e = sensor.expected_electrons(np.full(N, PHOTO_E / EXPOSURE_S), EXPOSURE_S)
    return sensor.read(sensor.collect(expected_e, seed=seed, frame=frame), seed=seed, frame=frame).astype(float)


@every_effect
def test_draws_moments_and_budget_agree(name):
    check_sensor_effect(name, CASES[name])


def test_fixed_patterns_of_effects_are_uncorrelated():
    """Two effects with the same random numbers would agree with their own moments, but not together."""
    names = [effect.name for effect in effects.STANDARD if not effect.is_temporal]
    sensors = {name: make_sensor(name) for name in names}
    patterns = [e.pattern(sensors[name].sites) for name in names for e in sensors[name].chain if e.name == name]

    assert len(patterns) == 8
    assert np.abs(np.corrcoef(patterns) - np.eye(8)).max() < 5.0 / np.sqrt(N)


@every_effect
def test_disabled_effect_leaves_other_draws(name):
    everything = {key: value for case in CASES.values() for key, value in case.items()}
    del everything["pixel_fpn_fraction" if name == "dark_offset" else "dsnu_e"]  # at most one of them
    everything["effects"] = [LampFlicker(), LensShading(), Hum()]
    sensor = make_sensor(**everything)
    without = sensor.without(name)

    assert [e.name for e in without.chain if e.name != "shot"] == [
        e.name for e in sensor.chain if e.name not in {name, "shot"}
    ]
    for effect in without.chain:
        values = np.linspace(0.1, 2000.0, N)
        drawn = [
            e.apply(values.copy(), sites=s.sites, rng=Streams(3).of(e.name, 0))
            for s in (sensor, without)
            for e in s.chain
            if e.name == effect.name and e.name != name
        ]
        assert all(np.array_equal(drawn[0], other) for other in drawn)
    alone = make_sensor(name)
    assert not np.array_equal(codes(alone), codes(alone.without(name)))


def test_additional_effect_changes_only_its_sites():
    """Two sensors that differ by one effect have different codes only at the sites of that effect."""
    few = make_sensor(shot_noise="auto", read_noise_e=3.0, ktc_noise=True)
    more = make_sensor(shot_noise="auto", read_noise_e=3.0, ktc_noise=True, rts_fraction=0.1, rts_e=100.0)

    moved = codes(few) != codes(more)

    assert np.array_equal(moved, more.pattern("rts") > 0.0)


@pytest.mark.parametrize("mean_e", [30.0, 99.9, 100.1, 150.0, 1000.0, 1e5])
def test_shot_noise_has_poisson_moments(mean_e):
    """Includes the third central moment, which equals the mean (0 for a Gaussian)."""
    n = 2_000_000
    rng = np.random.default_rng(5)

    drawn = ShotNoise().apply(np.full(n, mean_e), sites=None, rng=rng) - mean_e

    for power, expected in ((1, 0.0), (2, mean_e), (3, mean_e)):
        values = drawn.astype(float) ** power
        assert abs(values.mean() - expected) < SIGMAS * values.std() / np.sqrt(n)


def test_shot_noise_tails_are_poisson():
    n, mean_e = 2_000_000, 120.0
    drawn = ShotNoise().apply(np.full(n, mean_e), sites=None, rng=np.random.default_rng(6))

    for limit in (80, 90, 150, 165):
        probability = scipy.stats.poisson.cdf(limit, mean_e)
        error = np.sqrt(probability * (1.0 - probability) / n)
        assert abs(np.mean(drawn <= limit) - probability) < SIGMAS * error + 0.04 * min(probability, 1.0 - probability)


def test_added_effects_enter_all_estimates():
    plain, noisy = make_sensor(shot_noise="auto"), make_sensor("flicker", shot_noise="auto")
    expected_e, dark_e = np.full(N, PHOTO_E), np.zeros(N)
    added_e2 = np.square(LampFlicker().deviation(noisy.sites) / 3.0 * 65_536)
    ratios = [signal_to_noise(sensor, expected_e, dark_e).ratio for sensor in (plain, noisy)]

    np.testing.assert_allclose(np.square(PHOTO_E / ratios[1]) - np.square(PHOTO_E / ratios[0]), added_e2, rtol=1e-6)
    merged = [fs.sensor.merge_exposures([np.full(N, 20_000)], [0.5], sensor).sigma_e_per_s for sensor in (plain, noisy)]
    np.testing.assert_allclose(np.square(0.5 * merged[1]) - np.square(0.5 * merged[0]), added_e2, rtol=1e-5)


def test_fixed_patterns_must_define_pattern_moments():
    @dataclass(frozen=True)
    class Undeclared(FixedOffset):
        name: ClassVar[str] = "undeclared"
        stage: ClassVar[str] = "output"

        def pattern(self, sites):
            return 1e-3 * sites.device.normals(self.name)

    with pytest.raises(SimulationError, match=r"must define pattern_moments\(\), its mean and variance over devices"):
        noise_budget(make_sensor(effects=[Undeclared()]), np.full(N, 100.0), 1.0)


@pytest.mark.parametrize("returned", [None, np.zeros(3)])
def test_wrong_result_of_effect_is_rejected(returned):
    class Wrong(Hum):
        reach = "site"

        def apply(self, values, *, sites, rng):
            return returned

    with pytest.raises(SimulationError, match=r"the effect 'hum' must return an array of shape .*; check its apply"):
        codes(make_sensor(effects=[Wrong()]))


@dataclass(frozen=True)
class RowNoise(GroupedNoise):
    """Temporal row noise: one draw per readout line."""

    name = "row_noise"
    stage = "charge"

    sigma_e: float = 5.0

    def deviation(self, sites):
        return self.sigma_e


def test_shared_draws_span_site_blocks():
    """Readout lines that are longer than a block have one draw per frame."""
    n_x = 40_000
    layout = grid(n_x=n_x, n_y=3, pitch_um=2.0).with_columns(readout_line=np.repeat(np.arange(3), n_x))
    sensor = Sensor(layout, effects=[RowNoise()], bits=16, v_sat_v=1.0, capacitance_f=1e-15)
    charge_e = np.full(layout.n_sites, 1000)

    codes = [sensor.read(charge_e, seed=seed).reshape(3, n_x) for seed in range(2)]

    assert all(np.all(each == each[:, :1]) for each in codes)
    assert len(np.unique(np.stack(codes)[:, :, 0])) == 6
    assert noise_budget(sensor, np.full(layout.n_sites, 1e3), 1.0)["row_noise"] == pytest.approx(5.0)


@dataclass(frozen=True)
class ChannelGain(Effect):
    """Test effect: a factor per channel, cached under computed names."""

    name: ClassVar[str] = "channel_gain"
    stage: ClassVar[str] = "charge"
    is_temporal: ClassVar[bool] = False

    def apply(self, values, *, sites, rng):
        channel = sites.select(sites.layout.channel)
        for c in range(3):
            gain = sites.cached((self, "gain of " + str(c)), lambda all_sites, c=c: np.full(all_sites.n_sites, 1.0 + c))
            values[channel == c] *= sites.select(gain)[channel == c]
        return values

    def moments(self, mean, variance, *, sites):
        return mean, variance


def test_cached_names_compare_by_value():
    layout = ROW[:300].with_columns(channel=np.arange(300) % 3)
    sensor = Sensor(layout, effects=[ChannelGain()], **FINE | {"pedestal_v": 0.0})
    expected = 350 * (1 + layout.channel)

    for frame in range(100):
        code = sensor.read(np.full(300, 350), seed=0, frame=frame)
        assert np.abs(code - expected).max() <= 1.0
    assert len(sensor.sites._cache) == 3


def test_cached_names_compare_by_type():
    sites, effect = make_sensor().sites, Hum()

    assert [sites.cached((effect, name), lambda _, name=name: repr(name)) for name in (1, True, 1.0)] == [
        "1",
        "True",
        "1.0",
    ]


def test_cached_effects_compare_by_identity():
    """New objects may have the address, and may have the value, of a deleted one."""
    sites = make_sensor().sites

    assert [sites.cached(Hum(sigma=0.0), lambda _, k=k: k) for k in range(500)] == list(range(500))
    assert len(sites._cache) < 100


def test_functions_of_effect_have_separate_patterns():
    sites, effect = make_sensor().sites, LampFlicker()

    one, other = (sites.pattern(effect, function) for function in (effect.deviation, lambda _: 7.0))

    assert np.array_equal(one, effect.deviation(sites))
    assert other.tolist() == [7.0]


@pytest.mark.parametrize("is_known_first", [True, False])
def test_cached_patterns_are_separate_without_device(is_known_first):
    sites, effect = make_sensor().sites, LampFlicker()

    def numbers(sites):
        return sites.cached(effect, lambda all_sites: all_sites.device.normals("numbers"))

    if is_known_first:
        assert numbers(sites).shape == (N,)
    with pytest.raises(SimulationError, match="differs between devices"):
        numbers(sites.without_device())
    assert numbers(sites).shape == (N,)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("gain", "'key' must be the effect, or a tuple of the effect and hashable values, got 'gain'"),
        ((), "'key' must be the effect, or a tuple of the effect and hashable values, got"),
        ((Hum(), [1]), r"'key' must contain only hashable values after the effect, got \(\[1\],\)"),
    ],
)
def test_invalid_cache_keys_are_rejected(key, message):
    with pytest.raises(ParameterError, match=message):
        make_sensor().sites.cached(key, lambda _: 1.0)


@pytest.mark.parametrize("deviation", [np.ones(3), np.nan])
def test_wrong_deviation_is_rejected(deviation):
    class Wrong(LampFlicker):
        def deviation(self, sites):
            return deviation

    with pytest.raises(
        SimulationError, match="the effect 'flicker' must return one finite number, or one for each of the"
    ):
        codes(make_sensor(effects=[Wrong()]))


@pytest.mark.parametrize("returned", [None, 3.0, (np.ones(3), np.ones(3))])
def test_wrong_moments_are_rejected(returned):
    class Wrong(Hum):
        def moments(self, mean, variance, *, sites):
            return returned

    with pytest.raises(SimulationError, match="the effect 'hum' must return a mean and a variance of shape"):
        make_sensor(effects=[Wrong()]).predict(np.full(N, 100.0))


class Nameless(LampFlicker):
    name = None


class Early(LampFlicker):
    name, stage = "early", "photo"


class Elsewhere(LampFlicker):
    name, stage = "elsewhere", "lens"


class Duplicate(LampFlicker):
    name = "read"


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"effects": [3.0]}, r"'effects\[0\]' must be an Effect, got a float"),
        ({"effects": LampFlicker()}, "'effects' must be a list of Effect objects, got"),
        ({"effects": [Nameless()]}, "'effects' must define the class attribute 'name' of type str"),
        ({"effects": [Early()]}, "'early' at the stage 'photo' is temporal; use the stage 'charge'"),
        ({"effects": [Elsewhere()]}, "'effects' must have a stage from photo, dark, .*; 'elsewhere' has 'lens'"),
        ({"effects": [Duplicate()]}, "'effects' must have unique names, got 'read' twice"),
        ({"effects": [LampFlicker(), LampFlicker()]}, "got 'flicker' twice"),
        ({"disabled": ["raed"]}, "'disabled' must contain names of effects, got 'raed'; did you mean 'read'"),
        ({"disabled": 3}, "'disabled' must be a list of strings, got 3"),
    ],
)
def test_invalid_effects_are_rejected(keywords, message):
    with pytest.raises(ParameterError, match=message):
        Sensor(ROW[:4], **keywords)


def test_unknown_pattern_lists_patterns():
    with pytest.raises(
        ParameterError, match=r"'name' must be one of the sensor's fixed patterns, got 'gain'; possible: 'prnu', 'rts'"
    ):
        make_sensor("prnu", **CASES["rts"]).pattern("gain")


def test_block_contains_its_sites():
    sites = make_sensor("prnu").sites
    block = sites.block(slice(10, 20))

    assert block.n_sites == 10
    assert np.array_equal(block.select(np.arange(N)), np.arange(10, 20))
    assert block.select(3.0) == 3.0


def test_settings_describe_registered_effects():
    layout = ROW[:10]
    sensor = Sensor(
        layout,
        **FINE,
        read_noise_e=2.0,
        coupling=fs.sensor.InterPixelCapacitance(neighbour_fraction=0.01),
        effects=[Registered(2.5)],
    )
    from foveasim._core.provenance import to_plain_data

    settings = to_plain_data(sensor)
    again = Sensor.from_settings(layout, settings)

    assert again.chain[-1] == Registered(2.5)
    assert again.coupling == sensor.coupling
    with pytest.raises(
        ParameterError, match="'sensor' cannot be restored: effect 'LampFlicker' is not registered; pass sensor="
    ):
        Sensor.from_settings(layout, to_plain_data(Sensor(layout, effects=[LampFlicker()])))


@effects.EFFECTS.register("registered of test_effects")
@dataclass(frozen=True)
class Registered(AdditiveNoise):
    name: ClassVar[str] = "registered"
    stage: ClassVar[str] = "charge"

    sigma_e: float

    def deviation(self, sites):
        return self.sigma_e


@effects.EFFECTS.register("shading of test_effects")
@dataclass(frozen=True, eq=False)
class Shading(FixedFactor):
    name: ClassVar[str] = "shading"
    stage: ClassVar[str] = "photo"

    factor: np.ndarray

    def pattern(self, sites):
        return sites.select(np.asarray(self.factor))


@pytest.mark.parametrize("extension", ["npz", "zarr"])
@pytest.mark.parametrize("n", [64, 65])
def test_loaded_capture_has_parameters_per_site(tmp_path, extension, n):
    row = grid(n_x=n, n_y=1, pitch_um=2.0)
    noise_e = np.linspace(1.0, 9.0, n)
    curve = fs.sensor.TableCurve(wavelength_nm=np.arange(400.0, 700.0), value=np.linspace(0.5, 0.9, 300))
    sensor = Sensor(row, **FINE, qe=curve, read_noise_e=noise_e, effects=[Shading(np.linspace(0.5, 1.0, n))])
    light = fs.PowerMap(np.full((1, 10, 200), 1e-3), fs.Grid.centred((10, 200), 1.0), [550.0])
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    capture = camera.capture(light, exposure_s=0.01, seed=1)
    capture.save(tmp_path / f"capture.{extension}")
    loaded = fs.Capture.load(tmp_path / f"capture.{extension}")

    expected = capture.signal_to_noise(sensor=sensor)
    loaded.save(tmp_path / f"again.{extension}")
    again = fs.Capture.load(tmp_path / f"again.{extension}")
    for each in (capture, loaded, again, pickle.loads(pickle.dumps(loaded))):
        assert np.array_equal(each.signal_to_noise(), expected)
    found = [c.picture("least_squares", max_pixels=80).data for c in (capture, loaded)]
    assert np.array_equal(*found)
    assert len(loaded.sensor_arrays) == (2 if n > 64 else 0)
    missing = replace(loaded, sensor_arrays={})
    if n > 64:
        message = r"^'sensor' must be given: .* do not contain all values of 'read_noise_e'$"
        with pytest.raises(ParameterError, match=message):
            missing.signal_to_noise()


def test_capture_of_unregistered_effect_has_sensor(tmp_path):
    sensor = Sensor(ROW, **FINE, effects=[LampFlicker()])
    light = fs.PowerMap(np.full((1, 10, 2 * N), 1e-3), fs.Grid.centred((10, 2 * N), 1.0), [550.0])
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    capture = camera.capture(light, exposure_s=0.01, seed=1)
    capture.save(tmp_path / "capture.npz")

    assert np.array_equal(capture.signal_to_noise(), capture.signal_to_noise(sensor=sensor))
    with pytest.raises(
        ParameterError, match="'sensor' cannot be restored: effect 'LampFlicker' is not registered; pass sensor="
    ):
        fs.Capture.load(tmp_path / "capture.npz").signal_to_noise()


def test_settings_of_changed_effects_are_rejected():
    from foveasim._core.provenance import to_plain_data

    settings = to_plain_data(Sensor(ROW[:10], **FINE, effects=[Registered(2.5)]))
    settings["effects"][0]["former_e"] = 1.0

    with pytest.raises(ParameterError, match="effect 'Registered' has no parameter 'former_e' any more"):
        Sensor.from_settings(ROW[:10], settings)


def test_public_effects_have_no_long_signatures():
    for name in effects.__all__:
        parts = getattr(effects, name)
        if inspect.isclass(parts) and issubclass(parts, Effect | Sites):
            assert sum(not name.startswith("_") for name in inspect.signature(parts).parameters) <= 7


def test_disabled_effect_is_not_checked():
    with pytest.raises(
        ParameterError, match="'name' must be an effect of the sensor, got 'prnuu'; did you mean 'prnu'"
    ):
        check_sensor_effect("prnuu", {"prnu_fraction": 0.1})
