"""Asynchronous photosites: closed forms of events and spikes, invariance, and files."""

from __future__ import annotations

import itertools
import math
import sys

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, FoveasimWarning, ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.modes import EventPixels, Events, SpikingPixels, write_events
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C


def sensor_of(n_sites=1, **changes):
    return fs.Sensor(fs.layout.grid(n_x=n_sites, n_y=1, pitch_um=4.0), **changes)


def pixels_of(n_sites=1, sensor=None, **changes):
    return EventPixels(sensor or sensor_of(n_sites), **({"floor_e_per_s": 0.0} | changes))


def walk(n_frames, n_sites, seed=0, step=0.3):
    """Return rates whose logarithm is a random walk."""
    steps = step * np.random.default_rng(seed).standard_normal((n_frames, n_sites))
    return 1e6 * np.exp(np.cumsum(steps, axis=0))


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("t_s", "site", "polarity"))


# -- changes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("capacitance_f", [0.0, 1e-14])
def test_constant_light_gives_no_events(capacitance_f):
    pixels = pixels_of(3, capacitance_f=capacitance_f)

    assert len(pixels.events([[1e3, 1e4, 1e5]] * 50, frame_s=0.01, seed=0)) == 0


@pytest.mark.parametrize("contrast", [0.1, 0.23, 0.5])
@pytest.mark.parametrize("change", [0.05, 0.3, 1.0, 2.7, -0.3, -1.0, -2.7])
def test_log_step_gives_one_event_per_threshold(change, contrast):
    pixels = pixels_of(contrast_on=contrast, contrast_off=contrast)
    events = pixels.events([[100.0], [100.0 * math.exp(change * 1.000001)]], frame_s=1.0, seed=0)

    assert len(events) == math.floor(abs(change) * 1.000001 / contrast)
    assert np.all(events.polarity == np.sign(change))


def test_on_and_off_thresholds_are_independent():
    pixels = pixels_of(contrast_on=0.3, contrast_off=0.15)
    events = pixels.events([[100.0], [100.0 * math.exp(1.0)], [100.0]], frame_s=1.0, seed=0)

    # Up: 0.3, 0.6, 0.9 with a remainder of 0.1; down by 1, of which 0.1 returns to the level of the last event.
    assert events.counts(polarity=1).tolist() == [3]
    assert events.counts(polarity=-1).tolist() == [6]


def test_log_ramp_gives_equidistant_times():
    slope_per_s, contrast, n = 3.0, 0.25, 41
    rates = 100.0 * np.exp(slope_per_s * 0.01 * np.arange(n))[:, None]
    events = pixels_of(contrast_on=contrast).events(rates, frame_s=0.01, seed=0)

    assert np.allclose(events.t_s, contrast / slope_per_s * np.arange(1, len(events) + 1), rtol=1e-12)
    assert len(events) == 4


def test_scaled_light_gives_same_events():
    rates = walk(30, 5)
    pixels = pixels_of(5)

    weak, strong = (pixels.events(factor * rates, frame_s=0.01, seed=0) for factor in (1.0, 1024.0))
    assert np.array_equal(weak.site, strong.site)
    assert np.allclose(weak.t_s, strong.t_s, rtol=1e-9)


@pytest.mark.parametrize("polarity", [1, -1])
def test_low_pass_is_faster_at_higher_current(polarity):
    capacitance_f, contrast = 2e-14, 0.13
    light = np.array([2e5, 8e5])
    tau_s = capacitance_f * BOLTZMANN_J_PER_K * 300.0 / (ELEMENTARY_CHARGE_C**2 * math.e * light)
    frame_s, n = 1e-3, 200
    thresholds = dict(zip(("contrast_on", "contrast_off"), (contrast, 0.5)[::polarity], strict=True))
    pixels = pixels_of(2, **thresholds, capacitance_f=capacitance_f)
    events = pixels.events([math.exp(1 - polarity) * light, *([math.e * light] * n)], frame_s=frame_s, seed=0)
    assert set(events.polarity.tolist()) == {polarity}
    for site in (0, 1):
        times_s = events.t_s[events.site == site]
        late = times_s[times_s > frame_s]
        # After the ramp |V| = 1 - a exp(-(t - frame) / tau): the time between two levels is tau ln of the ratio of distances to 1.
        level = 1.0 - contrast * (np.arange(len(times_s))[times_s > frame_s] + 1)
        steps = np.log(level[:-1] / level[1:])
        assert len(times_s) == 7
        assert np.allclose(np.diff(late), tau_s[site] * steps, rtol=1e-9)


@pytest.mark.parametrize("rise_s", [1e-10, 1e-12, 1e-14])
def test_low_pass_resolves_times_after_fast_steps(rise_s):
    capacitance_f, light, contrast, step = 2e-14, 2e5, 0.25, 2.0
    tau_s = capacitance_f * BOLTZMANN_J_PER_K * 300.0 / (ELEMENTARY_CHARGE_C**2 * light)
    pixels = pixels_of(contrast_on=contrast, capacitance_f=capacitance_f)
    events = pixels.events([[math.exp(-step) * light], [light], [light]], times_s=[0.0, rise_s, 1.0], seed=0)

    expected_s = -tau_s * np.log(1.0 - contrast * np.arange(1, 8) / step)
    np.testing.assert_allclose(events.t_s[:7], expected_s, rtol=1e-7)


def test_change_faster_than_low_pass_is_undetected():
    pixels = pixels_of(capacitance_f=2e-14)

    assert len(pixels.events([[1e5], [1e6], [1e5]], frame_s=1e-9, seed=0)) == 0


@pytest.mark.parametrize(("step", "seed", "n_least"), [(0.5, 5, 25), (2.0, 6, 1000)])
def test_low_pass_matches_small_step_integration(step, seed, n_least):
    capacitance_f, frame_s, contrast = 3e-14, 2e-3, 0.06
    rates = walk(40, 1, seed=seed, step=step)[:, 0]
    events = pixels_of(contrast_on=contrast, contrast_off=contrast, capacitance_f=capacitance_f).events(
        rates[:, None], frame_s=frame_s, seed=0
    )

    n, log_light = 4000, np.log(rates)
    level = reference = log_light[0]
    expected = []
    for k in range(39):
        dt_s = frame_s / n
        for j in range(n):
            light = log_light[k] + (log_light[k + 1] - log_light[k]) * (j + 0.5) / n
            # Time constant of the instantaneous current.
            tau_s = capacitance_f * BOLTZMANN_J_PER_K * 300.0 / (ELEMENTARY_CHARGE_C**2 * math.exp(light))
            level = light + (level - light) * math.exp(-dt_s / tau_s)
            if abs(level - reference) >= contrast:
                expected.append((k * frame_s + (j + 1) * dt_s, np.sign(level - reference)))
                reference += math.copysign(contrast, level - reference)

    assert len(expected) > n_least
    assert events.polarity.tolist() == [p for _, p in expected]
    # Each part of a frame has one time constant; where the level changes slowly, times are sensitive to small differences.
    assert np.allclose(events.t_s, [t_s for t_s, _ in expected], rtol=0.0, atol=0.15 * frame_s)


@pytest.mark.parametrize("noise_per_s", [0.0, 1e4])
@pytest.mark.parametrize("capacitance_f", [0.0, 1e-14])
def test_event_rate_is_limited_by_refractory_time(noise_per_s, capacitance_f):
    refractory_s = 2e-3
    pixels = pixels_of(
        8, refractory_s=refractory_s, noise_per_s=noise_per_s, noise_half_e_per_s=1e12, capacitance_f=capacitance_f
    )
    light = 1e7 * np.exp(3.0 * np.random.default_rng(0).standard_normal((200, 8)))
    events = pixels.events(light, frame_s=1e-3 * math.pi, seed=0)

    for site in range(8):
        times_s = events.t_s[events.site == site]
        assert times_s.size > 10
        assert np.diff(times_s).min() >= refractory_s * (1 - 1e-9)


def test_reference_follows_level_during_refractory_time():
    slope_per_s, contrast, refractory_s = 2.0, 0.2, 0.05
    rates = 100.0 * np.exp(slope_per_s * np.arange(3))[:, None]
    events = pixels_of(contrast_on=contrast, refractory_s=refractory_s).events(rates, frame_s=1.0, seed=0)

    # 0.1 s to a threshold, and 0.05 s of refractory time.
    assert np.allclose(np.diff(events.t_s), 0.15, rtol=1e-12)


def test_leakage_gives_on_events_at_rate():
    events = pixels_of(2, leak_per_s=5.0).events([[1e3, 1e4]] * 21, frame_s=0.1, seed=0)

    assert events.counts(polarity=-1).tolist() == [0, 0]
    for site in (0, 1):
        times_s = events.t_s[events.site == site]
        assert times_s.size == 10
        assert times_s[0] <= 0.2
        assert np.allclose(np.diff(times_s), 0.2, rtol=1e-12)


def test_leak_events_of_sites_are_asynchronous():
    n_sites, leak_per_s = 10_000, 0.1
    pixels = pixels_of(sensor=fs.Sensor(fs.layout.grid(n_x=100, n_y=100, pitch_um=4.0)), leak_per_s=leak_per_s)
    one, other = (pixels.events(np.full((11, n_sites), 1e4), frame_s=1.0, seed=s) for s in (0, 1))

    # In one period each site emits one event at a uniformly distributed time: distance of the Kolmogorov test at 5 sigma.
    assert np.array_equal(np.sort(one.site), np.arange(n_sites))
    assert np.abs(one.t_s * leak_per_s - np.arange(n_sites) / n_sites).max() < 2.7 / math.sqrt(n_sites)
    assert abs(np.corrcoef(one.t_s[np.argsort(one.site)], other.t_s[np.argsort(other.site)])[0, 1]) < 0.05


def test_leak_spread_is_fixed_and_preserves_mean():
    n_sites, spread = 40_000, 0.5
    layout = fs.layout.grid(n_x=200, n_y=200, pitch_um=4.0)
    one, other = (
        EventPixels(fs.Sensor(layout, device_seed=s), leak_per_s=2.0, leak_spread_fraction=spread) for s in (1, 2)
    )
    leaks = one.leaks_per_s

    assert leaks.min() > 0.0
    assert abs(leaks.mean() - 2.0) < 5.0 * 2.0 * spread / math.sqrt(n_sites)
    # Kurtosis of a log-normal distribution: for w = 1 + 0.5², w⁴ + 2w³ + 3w² - 3.
    w = 1.0 + spread**2
    kurtosis = w**4 + 2.0 * w**3 + 3.0 * w**2 - 3.0
    assert abs(leaks.var() / (2.0 * spread) ** 2 - 1.0) < 5.0 * math.sqrt((kurtosis - 1.0) / n_sites)
    assert abs(np.corrcoef(leaks, other.leaks_per_s)[0, 1]) < 5.0 / math.sqrt(n_sites)
    part = EventPixels(fs.Sensor(layout[:50], device_seed=1), leak_per_s=2.0, leak_spread_fraction=spread)
    events = part.events(np.full((101, 50), 1e4), frame_s=1.0, seed=0)
    for site in (0, 17, 49):
        assert np.allclose(np.diff(events.t_s[events.site == site]), 1.0 / leaks[site], rtol=1e-9)


def test_noise_is_poisson_process_halved_by_light():
    noise_per_s, n_sites = 20.0, 2000
    pixels = pixels_of(n_sites, noise_per_s=noise_per_s, noise_half_e_per_s=1000.0)
    light = np.where(np.arange(n_sites) < 1000, 1e-3, 1000.0)
    events = pixels.events([light] * 11, frame_s=0.1, seed=3)

    counts = events.counts()
    for part, mean in ((counts[:1000], 20.0), (counts[1000:], 10.0)):
        assert abs(part.mean() - mean) < 5.0 * math.sqrt(mean / 1000)
        # Variance of the sample variance of a Poisson distribution: (mean + 2 mean²) / n.
        assert abs(part.var() - mean) < 5.0 * math.sqrt((mean + 2.0 * mean**2) / 1000)
    ups = (events.polarity == 1).sum()
    assert abs(ups - 0.5 * len(events)) < 5.0 * 0.5 * math.sqrt(len(events))


def test_threshold_mismatch_is_fixed_in_device():
    layout = fs.layout.grid(n_x=60, n_y=50, pitch_um=4.0)
    one, same_device, other = (
        EventPixels(fs.Sensor(layout, device_seed=seed), mismatch_fraction=0.1).thresholds for seed in (1, 1, 2)
    )

    assert np.array_equal(one[0], same_device[0])
    assert not np.array_equal(one[0], other[0])
    assert abs(np.corrcoef(one)[0, 1]) < 5.0 / math.sqrt(3000)
    assert abs(one[0].mean() - 0.2) < 5.0 * 0.02 / math.sqrt(3000)
    assert abs(one[0].std() - 0.02) < 5.0 * 0.02 / math.sqrt(6000)
    part = EventPixels(fs.Sensor(layout[100:200], device_seed=1), mismatch_fraction=0.1).thresholds
    assert np.array_equal(part[0], one[0][100:200])


NOISY = {
    "capacitance_f": 1e-14,
    "mismatch_fraction": 0.05,
    "refractory_s": 1e-3,
    "leak_per_s": 2.0,
    "noise_per_s": 30.0,
    "noise_half_e_per_s": 1e7,
}


def doubling(n_frames, n_sites):
    """Return rates whose events at a threshold of ln 2 are at frame boundaries."""
    return np.repeat(100.0 * 2.0 ** np.arange(n_frames)[:, None], n_sites, axis=1)


@pytest.mark.parametrize("batch", [1, 2, 7, 100])
@pytest.mark.parametrize(
    ("changes", "light"),
    [
        ({}, walk),
        (NOISY, walk),
        # Events of leakage, and of doubled rates, at frame boundaries apart from rounding errors.
        ({"leak_per_s": 10.0, "mismatch_fraction": 0.1}, lambda n, m: np.full((3 * n, m), 1e4)),
        ({"contrast_on": math.log(2.0), "refractory_s": 1e-9}, doubling),
    ],
)
def test_events_are_independent_of_batch_size(batch, changes, light):
    pixels = pixels_of(30, **changes)
    rates = light(25, 30)
    frame_s = 0.1 if light is not walk else 0.01
    expected = pixels.events(rates, frame_s=frame_s, seed=4)

    assert len(expected) > 500
    assert same(Events.concatenate(pixels.stream(rates, frame_s=frame_s, seed=4, batch=batch)), expected)


def test_boundary_events_belong_to_earlier_frame():
    pixels = pixels_of(30, contrast_on=math.log(2.0))
    for k, events in enumerate(pixels.stream(doubling(25, 30), frame_s=0.1, seed=0, batch=1)):
        assert np.all((events.t_s > (k - 1) * 0.1) & (events.t_s <= k * 0.1))


@pytest.mark.parametrize("batch", [1, 2, 7])
def test_boundary_spikes_are_independent_of_batch_size(batch):
    sensor = sensor_of(40, shot_noise="off")
    threshold_e = 100.0 * (1.0 + 0.037 * np.arange(40))
    # Three spikes per frame, the last of them at its end apart from rounding errors.
    pixels = SpikingPixels(sensor, threshold_e=threshold_e)
    rates = [30.0 * threshold_e] * 41
    expected = pixels.events(rates, frame_s=0.1, seed=4)

    assert len(expected) >= 3 * 40 * 40
    assert same(Events.concatenate(pixels.stream(rates, frame_s=0.1, seed=4, batch=batch)), expected)


def test_simultaneous_events_are_in_site_order():
    # All sites cross at the same times, the odd sites twice as often.
    pixels = pixels_of(500)
    rates = np.full((3, 500), 100.0)
    rates[1:] *= np.where(np.arange(500) % 2, math.exp(1.6), math.exp(0.8))
    events = pixels.events(rates, frame_s=1.0, seed=0)
    order = np.lexsort((events.site, events.t_s))

    assert np.unique(events.t_s).size < 20 < len(events)
    assert np.array_equal(order, np.arange(len(events)))


def test_events_are_independent_of_threads_and_pieces(monkeypatch):
    pixels = pixels_of(50, **NOISY)
    rates = walk(25, 50)
    expected = pixels.events(rates, frame_s=0.01, seed=4, n_threads=1)
    monkeypatch.setattr(sys.modules[EventPixels.__module__], "BLOCK_SITES", 7)

    assert same(pixels.events(rates, frame_s=0.01, seed=4, n_threads=2), expected)


def test_noise_depends_on_seed():
    pixels = pixels_of(5, noise_per_s=50.0)
    one, again, other = (pixels.events([[100.0] * 5] * 10, frame_s=0.1, seed=s) for s in (1, 1, 2))

    assert same(one, again)
    assert not same(one, other)


def test_events_are_independent_of_site_area():
    layout = fs.layout.log_polar(n_sectors=16, n_rings=6, r_min_um=5.0, r_max_um=40.0)
    grid = fs.Grid.centred((200, 200), 0.5)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout))
    lights = [fs.PowerMap(np.full((1, 200, 200), level), grid, np.array([550.0])) for level in (1.0, 2.0, 4.0)]
    pixels = EventPixels(camera.sensor, contrast_on=0.3, floor_e_per_s=0.0)
    events = pixels.events(camera.rates(lights), frame_s=0.1, seed=0)

    assert events.counts().tolist() == [4] * layout.n_sites
    # With the low pass, larger sites respond faster.
    slow = EventPixels(camera.sensor, contrast_on=0.3, capacitance_f=1e-12).events(
        camera.rates([*lights, *[lights[-1]] * 20]), frame_s=1e-3, seed=0
    )
    first_s = np.array([slow.t_s[slow.site == s][0] for s in range(layout.n_sites)])
    assert np.corrcoef(np.log(layout.area_um2), first_s)[0, 1] < -0.9


def test_zero_current_without_floor_is_rejected():
    with pytest.raises(SimulationError, match="floor_e_per_s"):
        pixels_of(2).events([[1.0, 0.0]], frame_s=0.1, seed=0)
    assert len(EventPixels(sensor_of(2)).events([[0.0, 0.0]] * 3, frame_s=0.1, seed=0)) == 0


# -- spikes -----------------------------------------------------------------------------------------------------------


def test_spike_rate_is_current_per_threshold():
    currents = np.array([0.0, 701.0, 12_345.0, 1.00013e6])
    sensor = sensor_of(4, shot_noise="off")
    spikes = SpikingPixels(sensor, threshold_e=250.0).events([currents] * 10, frame_s=1.0, seed=0)

    assert np.array_equal(spikes.counts(), np.floor(currents * 10.0 / 250.0))
    times_s = spikes.t_s[spikes.site == 2]
    assert np.allclose(times_s, 250.0 / 12_345.0 * np.arange(1, times_s.size + 1), rtol=1e-12)


def test_spikes_without_disabled_shot_noise_are_uniform():
    sensor = sensor_of(1).without("shot")
    spikes = SpikingPixels(sensor, threshold_e=400.0).events([[1000.0], [500.0]], frame_s=1.0, seed=0)

    assert np.allclose(spikes.t_s, [0.4, 0.8, 1.4], rtol=1e-12)


def test_charge_is_retained_between_frames():
    sensor = sensor_of(1, shot_noise="off")
    spikes = SpikingPixels(sensor, threshold_e=100.0).events(
        [[30.0], [40.0], [50.0], [0.0], [80.0]], frame_s=1.0, seed=0
    )

    # 30 + 40, then 30 of 50 in 0.6 s; the remaining 20 and 80 reach 100 at the end of the last frame, which is excluded.
    assert np.allclose(spikes.t_s, [2.6])


def test_refractory_time_is_added_to_intervals():
    sensor = sensor_of(1, shot_noise="off")
    pixels = SpikingPixels(sensor, threshold_e=100.0, refractory_s=0.013)
    spikes = pixels.events([[2000.0]] * 100, frame_s=0.01 * math.sqrt(2.0), seed=0)

    assert np.allclose(np.diff(spikes.t_s), 0.05 + 0.013, rtol=1e-9)


@pytest.mark.parametrize("threshold_e", [1.0, 3.0, 400.0])
def test_intervals_follow_gamma_distribution(threshold_e):
    n_sites, rate = 500, 1000.0 * threshold_e
    pixels = SpikingPixels(sensor_of(n_sites), threshold_e=threshold_e)
    spikes = pixels.events([np.full(n_sites, rate)] * 7, frame_s=0.01, seed=2)
    mean_s = threshold_e / rate
    # The first 30 of about 70 intervals per site: no bias towards short intervals.
    intervals = np.concatenate([np.diff(spikes.t_s[spikes.site == s])[:30] for s in range(n_sites)]) / mean_s

    n = intervals.size
    assert n == 30 * n_sites
    assert abs(intervals.mean() - 1.0) < 5.0 / math.sqrt(threshold_e * n)
    # The kurtosis of the gamma distribution of shape N is 6/N above 3.
    assert abs(intervals.var() * threshold_e - 1.0) < 5.0 * math.sqrt((2.0 + 6.0 / threshold_e) / n)


@pytest.mark.parametrize("batch", [1, 3, 50])
def test_spikes_are_independent_of_batch_size(batch):
    pixels = SpikingPixels(sensor_of(20), threshold_e=50.0, refractory_s=1e-4)
    rates = walk(20, 20)
    expected = pixels.events(rates, frame_s=0.01, seed=4)

    assert len(expected) > 1000
    assert same(Events.concatenate(pixels.stream(rates, frame_s=0.01, seed=4, batch=batch)), expected)


def test_threshold_may_differ_per_site():
    sensor = sensor_of(3, shot_noise="off")
    spikes = SpikingPixels(sensor, threshold_e=np.array([10.0, 20.0, 40.0])).events([[401.0] * 3], frame_s=1.0, seed=0)

    assert spikes.counts().tolist() == [40, 20, 10]


def test_too_many_events_stop_early(monkeypatch):
    """Test a site that would take hours to count, and pieces that exceed the limit only in total."""
    monkeypatch.setattr(sys.modules[EventPixels.__module__], "MAX_EVENTS", 1000)
    endless = pixels_of(1, noise_per_s=1e9)
    with pytest.raises(SimulationError, match=r"more than 1,000 events in 1 frames do not fit in memory"):
        endless.events([[1e-3]] * 2, frame_s=1.0, seed=0)
    monkeypatch.setattr(sys.modules[EventPixels.__module__], "BLOCK_SITES", 10)
    pixels = pixels_of(50, noise_per_s=30.0)
    assert 100 < len(pixels.events([[1e-3] * 50] * 2, frame_s=0.1, seed=0)) < 1000
    for n_threads in (1, 2):
        with pytest.raises(SimulationError, match=r"more than 1,000 events"):
            pixels.events([[1e-3] * 50] * 2, frame_s=1.0, seed=0, n_threads=n_threads)


def test_too_many_spikes_are_rejected():
    with pytest.raises(SimulationError, match="do not fit in memory"):
        SpikingPixels(sensor_of(1), threshold_e=1.0).events([[1e12]], frame_s=1.0, seed=0)


# -- invalid arguments -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (EventPixels, {"contrast_on": 0.0}),
        (EventPixels, {"contrast_off": 1e-9}),
        (EventPixels, {"refractory_s": -1.0}),
        (EventPixels, {"leak_per_s": math.nan}),
        (EventPixels, {"leak_spread_fraction": -0.1}),
        (EventPixels, {"mismatch_fraction": 5.0}),
        (EventPixels, {"capacitance_f": 1.0}),
        (EventPixels, {"temperature_k": 0.0}),
        (SpikingPixels, {"threshold_e": 0.5}),
        (SpikingPixels, {"threshold_e": [1.0, 2.0]}),
        (SpikingPixels, {"refractory_s": -1.0}),
        (EventPixels, {"contrast_on": 1e300}),
        (EventPixels, {"contrast_off": 1e300}),
        (EventPixels, {"refractory_s": 1e300}),
        (EventPixels, {"leak_per_s": 1e300}),
        (EventPixels, {"leak_spread_fraction": 1e9}),
        (EventPixels, {"noise_per_s": 1e300}),
        (EventPixels, {"noise_half_e_per_s": 1e300}),
        (EventPixels, {"floor_e_per_s": 1e300}),
        (EventPixels, {"temperature_k": 1e300}),
        (EventPixels, {"capacitance_f": 1e-30}),
        (SpikingPixels, {"threshold_e": 1e300}),
        (SpikingPixels, {"refractory_s": 1e300}),
    ],
)
def test_parameters_out_of_range_are_rejected(kind, change):
    with pytest.raises(ParameterError, match=next(iter(change))):
        kind(sensor_of(3), **change)
    with pytest.raises(ParameterError, match="sensor"):
        kind(sensor_of(3).layout)


@pytest.mark.parametrize("kind", [EventPixels, SpikingPixels])
def test_invalid_stream_arguments_are_rejected(kind):
    pixels = kind(sensor_of(3))
    for wrong in ({"frame_s": 0.0}, {"seed": -1}, {"batch": 0}):
        with pytest.raises(ParameterError, match=next(iter(wrong))):
            pixels.stream([], **({"frame_s": 0.1, "seed": 0} | wrong))
    for frame in ([1.0, 2.0], [1.0, 2.0, -1.0], [1.0, 2.0, math.nan]):
        with pytest.raises(ParameterError, match="rates"):
            pixels.events([frame], frame_s=0.1, seed=0)
    for rates in (None, 3.0):
        with pytest.raises(ParameterError, match=r"'rates' must be an iterable of frames"):
            pixels.stream(rates, frame_s=0.1, seed=0)
    assert len(pixels.events([], frame_s=0.1, seed=0)) == 0


# -- files ------------------------------------------------------------------------------------------------------------


def some_events():
    layout = fs.layout.grid(n_x=6, n_y=4, pitch_um=4.0).with_columns(readout_order=np.arange(24))
    pixels = EventPixels(fs.Sensor(layout), noise_per_s=40.0)
    return pixels.events(walk(30, 24), frame_s=0.01, seed=1)


def test_npz_round_trip_is_exact(tmp_path):
    events = some_events()
    events.save(tmp_path / "e.npz")
    read = Events.load(tmp_path / "e.npz")

    assert same(read, events)
    assert np.array_equal(read.layout.xy_um, events.layout.xy_um)
    assert np.array_equal(read.layout.columns["readout_order"], np.arange(24))


def test_hdf5_contains_arrays_of_event_tools(tmp_path):
    h5py = pytest.importorskip("h5py")
    events = some_events()
    events.save(tmp_path / "e.h5")

    with h5py.File(tmp_path / "e.h5") as file:
        t_us, x, y, p = (file[f"events/{name}"][:] for name in "txyp")
        ms_to_idx = file["ms_to_idx"][:]
        assert np.array_equal(file["events/site"][:], events.site)
    centroid_um = events.layout.centroid_um[events.site]
    assert np.array_equal(t_us, np.floor(events.t_s * 1e6))
    # Addresses of grid sites are columns and rows, top row first.
    assert np.array_equal(x, np.rint((centroid_um[:, 0] + 10.0) / 4.0))
    assert np.array_equal(y, np.rint((6.0 - centroid_um[:, 1]) / 4.0))
    assert set(p) == {0, 1}
    assert np.array_equal(p == 1, events.polarity == 1)
    for ms in (0, 3, 100, len(ms_to_idx) - 1):
        assert ms_to_idx[ms] == np.count_nonzero(t_us < 1000 * ms)


def test_hdf5_is_independent_of_batches(tmp_path):
    h5py = pytest.importorskip("h5py")
    layout = fs.layout.grid(n_x=6, n_y=4, pitch_um=4.0)
    pixels = EventPixels(fs.Sensor(layout), noise_per_s=40.0)
    # Constant rates for 100 ms in between.
    rates = np.concatenate((walk(30, 24), np.repeat(walk(30, 24)[-1:], 10, axis=0), walk(20, 24)))
    expected = pixels.events(rates, frame_s=0.01, seed=1)
    expected.save(tmp_path / "single.h5")

    assert write_events(pixels.stream(rates, frame_s=0.01, seed=1, batch=3), tmp_path / "batches.h5") == len(expected)
    names = [
        "events/t",
        "events/x",
        "events/y",
        "events/p",
        "events/site",
        "ms_to_idx",
        "t_offset",
        "sites/x_um",
        "sites/area_um2",
    ]
    with h5py.File(tmp_path / "single.h5") as a, h5py.File(tmp_path / "batches.h5") as b:
        for name in names:
            assert np.array_equal(a[name][()], b[name][()])
            assert a[name].dtype == b[name].dtype


def test_hdf5_rejects_unordered_or_missing_batches(tmp_path):
    h5py = pytest.importorskip("h5py")
    events = some_events()
    with pytest.raises(ParameterError, match="must be consecutive in time"):
        write_events([events, events], tmp_path / "e.h5")
    with pytest.raises(ParameterError, match="at least one batch"):
        write_events([], tmp_path / "e.h5")
    with pytest.raises(FileError, match="must end in"):
        write_events([events], tmp_path / "e.npz")
    assert list(tmp_path.iterdir()) == []
    assert write_events([events.between(5.0, 6.0)], tmp_path / "e.h5") == 0
    with h5py.File(tmp_path / "e.h5") as file:
        assert file["ms_to_idx"][:].tolist() == [0]


def test_hdf5_round_trip_rounds_to_microseconds(tmp_path):
    pytest.importorskip("h5py")
    events = some_events()
    events = Events(
        events.t_s,
        events.site,
        events.polarity,
        events.layout.with_columns(name=[f"sité {k}" for k in range(24)], is_on=np.arange(24) % 2 == 0),
    )
    events.save(tmp_path / "e.h5")
    read = Events.load(tmp_path / "e.h5")

    assert np.array_equal(read.site, events.site)
    assert np.array_equal(read.polarity, events.polarity)
    assert np.all((events.t_s - read.t_s >= 0.0) & (events.t_s - read.t_s < 1e-6))
    assert np.array_equal(read.layout.xy_um, events.layout.xy_um)
    assert read.layout.provenance["generator"] == "grid"
    for name in ("readout_order", "name", "is_on", "row"):
        assert np.array_equal(read.layout.columns[name], events.layout.columns[name])
        assert read.layout.columns[name].dtype == events.layout.columns[name].dtype
    read.save(tmp_path / "again.h5")
    assert same(Events.load(tmp_path / "again.h5"), read)


def write_corrupt_hdf5(path, defect):
    h5py = pytest.importorskip("h5py")
    some_events().save(path)
    if defect == "truncated":
        path.write_bytes(path.read_bytes()[:3000])
        return
    with h5py.File(path, "a") as file:
        if defect == "other format":
            del file.attrs["format"]
        elif defect == "version":
            file.attrs["version"] = 7
        elif defect == "link":
            del file["events/t"]
            file["events/t"] = h5py.ExternalLink("other.h5", "/t")
        elif defect == "external":
            del file["events/t"]
            file.create_dataset("events/t", (8,), "i8", external=[("/etc/passwd", 0, 64)])
        elif defect == "text":
            del file["events/t"]
            file["events/t"] = "now"
        elif defect == "order":
            file["events/t"][0] = 10**9
        elif defect == "site":
            file["events/site"][3] = 24
        elif defect == "group":
            del file["layout"]
        elif defect == "large":
            del file["events/p"]
            file.create_dataset("events/p", (10**11,), "u1", chunks=(10**6,), compression="gzip")


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("truncated", "is corrupt"),
        ("other format", "does not contain events of foveasim; read it with Events.read"),
        ("version", "has the format version 7, expected 2"),
        ("link", "must contain the numbers 'events/t', not a link"),
        ("external", "must contain the numbers 'events/t', not a link or external data"),
        ("text", "must contain the numbers 'events/t'"),
        ("order", "e.h5: 't_s' must be finite, at least 0, and ascending"),
        ("site", "e.h5: 'site' must be from 0 to 23"),
        ("group", "must contain the group 'layout'"),
        ("large", "would decompress to more than a file of its size can contain"),
    ],
)
def test_malformed_hdf5_is_rejected(tmp_path, defect, message):
    write_corrupt_hdf5(tmp_path / "e.h5", defect)
    with pytest.raises(FileError, match=message):
        Events.load(tmp_path / "e.h5")


def test_hdf5_rejects_times_since_epoch(tmp_path):
    pytest.importorskip("h5py")
    layout = fs.layout.grid(n_x=2, n_y=1, pitch_um=4.0)
    with pytest.raises(ParameterError, match=r"must end before 100,000 s.*subtract the start time"):
        Events([1e9], [0], [1], layout).save(tmp_path / "e.h5")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("join", [Events.concatenate, lambda parts: write_events(parts, "out/e.h5")])
def test_mismatched_or_missing_batches_are_rejected(join, tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    layout, other = (fs.layout.grid(n_x=2, n_y=1, pitch_um=pitch) for pitch in (4.0, 5.0))
    one = Events([1.0], [0], [1], layout)
    for parts, message in (
        ([one, Events([2.0], [0], [1], other)], "must have the same layout"),
        ([one, Events([0.5], [0], [1], layout)], "must be consecutive in time"),
        (one, "got an Events; pass a list of batches"),
        (None, "got a NoneType"),
        ([one, 3], "must be Events, got an int"),
        ([], "at least one batch"),
    ):
        with pytest.raises(ParameterError, match=message):
            join(parts)
    assert list((tmp_path / "out").iterdir()) == []
    # Equal layouts need not be identical objects.
    again = fs.layout.grid(n_x=2, n_y=1, pitch_um=4.0)
    join([one, Events([1.0], [1], [1], again)])


def test_structured_array_matches_events(tmp_path):
    events = some_events()
    x, y = events.addresses()
    found = events.to_structured_array()

    assert found.dtype == np.dtype([("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", bool)])
    assert np.array_equal(found["x"], x[events.site])
    assert np.array_equal(found["y"], y[events.site])
    assert np.array_equal(found["t"], np.floor(events.t_s * 1e6))
    assert np.array_equal(found["p"], events.polarity == 1)
    events.save(tmp_path / "e.npy")
    assert np.array_equal(np.load(tmp_path / "e.npy", allow_pickle=False), found)
    events.save(tmp_path / "e.txt")
    t_s, *addresses, p = np.loadtxt(tmp_path / "e.txt").T
    assert np.abs(t_s - events.t_s).max() < 1e-9
    assert np.array_equal(addresses, [found["x"], found["y"]])
    assert np.array_equal(p, found["p"])


def test_structured_array_out_of_range_is_rejected():
    layout = fs.layout.grid(n_x=40_000, n_y=1, pitch_um=1.0)
    with pytest.raises(ParameterError, match="at most 32768 columns and rows"):
        Events([1.0], [0], [1], layout).to_structured_array()
    with pytest.raises(ParameterError, match="'t_s' must be at most"):
        Events([1e12], [0], [1], fs.layout.grid(n_x=2, n_y=1, pitch_um=1.0)).to_structured_array()


def test_events_from_addresses_match_layout():
    events = some_events()
    found = events.to_structured_array()
    read = Events.from_addresses(events.t_s, found["x"], found["y"], 2 * found["p"] - 1, events.layout)

    assert same(read, events)
    # Row 0 is the top row.
    layout = fs.layout.grid(n_x=3, n_y=2, pitch_um=4.0)
    (site,) = Events.from_addresses([0.1], [2], [0], [1], layout).site
    assert layout.centroid_um[site].tolist() == [4.0, 2.0]
    for x, y, message in (
        ([3], [0], "got 0 at"),
        ([0.5], [0], "'x' must be one integer per event"),
        ([0], [-1], "'y' must be from 0"),
    ):
        with pytest.raises(ParameterError, match=message):
            Events.from_addresses([0.1], x, y, [1], layout)


LATTICES = {
    "square": lambda: fs.layout.grid(n_x=10, n_y=8, pitch_um=4.0),
    "trenches": lambda: fs.layout.grid(n_x=10, n_y=8, pitch_um=4.0, trench_um=0.4),
    "fill factor": lambda: fs.layout.grid(n_x=10, n_y=8, pitch_um=4.0, fill_factor=0.5),
    "oblong": lambda: fs.layout.grid(n_x=10, n_y=8, pitch_um=4.0, pitch_y_um=8.0),
    "staggered": lambda: fs.layout.grid(n_x=10, n_y=8, pitch_um=4.0, stagger=True),
    "hexagonal": lambda: fs.layout.hexagonal(n_columns=10, n_rows=8, pitch_um=4.0),
}


@pytest.mark.parametrize("name", LATTICES)
def test_lattice_addresses_are_columns_and_rows(name):
    layout = LATTICES[name]()
    order = np.random.default_rng(0).permutation(80)
    for sites, upwards in ((np.arange(80), 1.0), (order, 1.0), (order[:40], 1.0), (np.arange(80), -1.0)):
        part = layout[sites]
        if upwards < 0:  # flipped: the lowest row becomes the top row
            part = Layout(part.xy_um * [1.0, -1.0], part.ring_offsets, part.site_offsets, part.columns)
        x, y = Events([], [], [], part).addresses()
        row = sites // 10
        assert np.array_equal(x, sites % 10 - (sites % 10).min())
        assert np.array_equal(y, row.max() - row if upwards > 0 else row - row.min())


@pytest.mark.parametrize("name", LATTICES)
def test_addresses_without_columns_are_unique(name):
    layout = LATTICES[name]()
    layout = Layout(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    x, y = Events([], [], [], layout).addresses()

    assert len(set(zip(x.tolist(), y.tolist(), strict=True))) == 80
    if name in {"square", "trenches", "fill factor"}:
        assert (x.max(), y.max()) == (9, 7)


def test_ring_addresses_are_unique_and_ordered():
    layout = fs.layout.log_polar(n_sectors=64, min_size_um=4.0, r_max_um=150.0)
    x, y = Events([], [], [], layout).addresses()

    assert len(set(zip(x.tolist(), y.tolist(), strict=True))) == layout.n_sites
    assert np.corrcoef(x, layout.centroid_um[:, 0])[0, 1] > 0.999
    assert np.corrcoef(y, layout.centroid_um[:, 1])[0, 1] < -0.999


def test_duplicate_addresses_give_warning():
    layout = fs.layout.grid(n_x=10, n_y=8, pitch_um=4.0)
    events = Events([], [], [], layout)
    with pytest.warns(FoveasimWarning, match="80 sites have only 1 addresses on the raster"):
        events.addresses(100.0)
    assert [a.size for a in Events([], [], [], layout[:0]).addresses()] == [0, 0]


def test_histogram_matches_counts_of_intervals(monkeypatch):
    events = some_events()
    monkeypatch.setattr(sys.modules[Events.__module__], "MAX_COUNTS", 100 * 24)
    edges_s = np.array([0.01, 0.02, 0.05, 0.25, 9.0])
    for polarity in (None, 1, -1):
        found = events.histogram(edges_s, polarity=polarity)
        assert found.shape == (4, 24)
        for k, (begin_s, end_s) in enumerate(itertools.pairwise(edges_s)):
            assert np.array_equal(found[k], events.between(begin_s, end_s).counts(polarity=polarity))
    assert events.histogram(edges_s).sum() == len(events.between(0.01, 9.0))
    for wrong in ([0.0], [1.0, 0.5], [[0.0, 1.0]], np.linspace(0.0, 1.0, 102)):
        with pytest.raises(ParameterError, match="edges_s"):
            events.histogram(wrong)
    for call in (events.counts, lambda polarity: events.histogram([0.0, 1.0], polarity=polarity)):
        for polarity in ("on", 0):
            with pytest.raises(ParameterError, match="'polarity' must be 1 or -1"):
                call(polarity=polarity)


@pytest.mark.parametrize(
    ("t_s", "site", "polarity", "message"),
    [
        ([math.nan], [0], [1], "t_s"),
        ([math.inf], [0], [1], "t_s"),
        ([1.0, math.nan, 2.0], [0, 0, 0], [1, 1, 1], "t_s"),
        ([-1.0], [0], [1], "'t_s' must be finite, at least 0, and ascending"),
        ([2.0, 1.0], [0, 0], [1, 1], "sort the events by time"),
        ([1.0], [7], [1], "'site' must be from 0 to 2, the sites of the layout, got 7"),
        ([1.0], [-1], [1], "site"),
        ([1.0], [2**33], [1], "got 8589934592"),
        ([1.0], [0.0], [1], "'site' must be integers"),
        ([1.0], [0], [0], "'polarity' must be 1 or -1, got 0; convert 0 and 1"),
        ([1.0], [0], [257], "polarity"),
        ([1.0], [0, 1], [1], "'site' must be one number for each of 1 times"),
        ([[1.0]], [0], [1], "t_s"),
    ],
)
def test_invalid_events_are_rejected(t_s, site, polarity, message, tmp_path):
    layout = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0)
    with pytest.raises(ParameterError, match=message):
        Events(t_s, site, polarity, layout)
    with pytest.raises(ParameterError, match="layout"):
        Events([1.0], [0], [1], None)
    # The same from a file.
    Events([1.0], [0], [1], layout).save(tmp_path / "e.npz")
    with np.load(tmp_path / "e.npz") as file:
        arrays = dict(file) | {"t_s": np.array(t_s), "site": np.array(site), "polarity": np.array(polarity)}
    np.savez(tmp_path / "e.npz", **arrays)
    with pytest.raises(FileError, match=f"e.npz: .*{message}"):
        Events.load(tmp_path / "e.npz")


def test_events_copy_writeable_arrays():
    t_s, site, polarity = np.array([1.0, 2.0]), np.array([0, 1], np.int32), np.array([1, -1], np.int8)
    window = t_s[:]
    window.flags.writeable = False
    layout = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0)
    one, other = Events(t_s, site, polarity, layout), Events(window, site, polarity, layout)
    t_s[0] = 99.0

    assert one.t_s.tolist() == other.t_s.tolist() == [1.0, 2.0]
    assert not one.t_s.flags.writeable
    assert t_s.flags.writeable
    # Read-only arrays are not copied.
    assert np.shares_memory(one.between(0.0, 1.5).t_s, one.t_s)


def test_missing_hdf5_library_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FileError, match=r"pip install 'foveasim\[video\]'"):
        some_events().save(tmp_path / "e.h5")


def test_intervals_partition_events():
    events = some_events()
    parts = [events.between(a, b) for a, b in itertools.pairwise([-1.0, 0.05, 0.1, 9.0])]

    assert same(Events.concatenate(parts), events)
    assert np.array_equal(events.counts(polarity=1) + events.counts(polarity=-1), events.counts())


def test_oversized_npz_is_rejected(tmp_path, monkeypatch):
    some_events().save(tmp_path / "e.npz")
    monkeypatch.setattr("foveasim._io.npz.MAX_DECOMPRESSED_BYTES", 1000)
    with pytest.raises(FileError, match="would decompress to more"):
        Events.load(tmp_path / "e.npz")


def test_files_without_events_are_rejected(tmp_path):
    with pytest.raises(FileError, match="must end in"):
        some_events().save(tmp_path / "e.mat")
    with pytest.raises(FileError, match="no such file"):
        Events.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"no zip")
    with pytest.raises(FileError, match="is corrupt or not a valid event file"):
        Events.load(tmp_path / "bad.npz")
    with pytest.raises(ParameterError, match="pitch_um"):
        some_events().addresses(1e-6)
