"""Photosites that speak for themselves: closed forms of events and spikes, and what must not change them."""

from __future__ import annotations

import itertools
import math
import sys

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FileError, ParameterError, SimulationError
from foveasim.modes import EventPixels, Events, SpikingPixels, write_events
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C


def sensor_of(n_sites=1, **changes):
    return fs.Sensor(fs.layout.grid(n_x=n_sites, n_y=1, pitch_um=4.0), **changes)


def pixels_of(n_sites=1, sensor=None, **changes):
    return EventPixels(sensor or sensor_of(n_sites), **({"floor_e_per_s": 0.0} | changes))


def walk(n_frames, n_sites, seed=0, step=0.3):
    """Light whose logarithm goes at random."""
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
def test_a_step_of_log_light_gives_its_whole_thresholds(change, contrast):
    pixels = pixels_of(contrast_on=contrast, contrast_off=contrast)
    events = pixels.events([[100.0], [100.0 * math.exp(change * 1.000001)]], frame_s=1.0, seed=0)

    assert len(events) == math.floor(abs(change) * 1.000001 / contrast)
    assert np.all(events.polarity == np.sign(change))


def test_thresholds_for_brighter_and_darker_are_their_own():
    pixels = pixels_of(contrast_on=0.3, contrast_off=0.15)
    events = pixels.events([[100.0], [100.0 * math.exp(1.0)], [100.0]], frame_s=1.0, seed=0)

    # Up: 0.3, 0.6, 0.9 with 0.1 left over; down from there by 1, of which 0.1 goes back to the last event's level.
    assert events.counts(polarity=1).tolist() == [3]
    assert events.counts(polarity=-1).tolist() == [6]


def test_a_ramp_of_log_light_gives_evenly_spaced_times():
    slope_per_s, contrast, n = 3.0, 0.25, 41
    rates = 100.0 * np.exp(slope_per_s * 0.01 * np.arange(n))[:, None]
    events = pixels_of(contrast_on=contrast).events(rates, frame_s=0.01, seed=0)

    assert np.allclose(events.t_s, contrast / slope_per_s * np.arange(1, len(events) + 1), rtol=1e-12)
    assert len(events) == 4


def test_light_of_another_strength_gives_the_same_events():
    rates = walk(30, 5)
    pixels = pixels_of(5)

    weak, strong = (pixels.events(factor * rates, frame_s=0.01, seed=0) for factor in (1.0, 1024.0))
    assert np.array_equal(weak.site, strong.site)
    assert np.allclose(weak.t_s, strong.t_s, rtol=1e-9)


def test_the_low_pass_follows_a_step_with_a_time_constant_in_inverse_proportion_to_the_light():
    capacitance_f, contrast = 2e-14, 0.13
    light = np.array([2e5, 8e5])
    tau_s = capacitance_f * BOLTZMANN_J_PER_K * 300.0 / (ELEMENTARY_CHARGE_C**2 * math.e * light)
    frame_s, n = 1e-3, 200
    pixels = pixels_of(2, contrast_on=contrast, capacitance_f=capacitance_f)
    events = pixels.events([light, *([math.e * light] * n)], frame_s=frame_s, seed=0)
    for site in (0, 1):
        times_s = events.t_s[events.site == site]
        late = times_s[times_s > frame_s]
        # Behind the ramp V = 1 - a exp(-(t - frame) / tau): the time from level to level is tau ln of the distances' ratio.
        level = 1.0 - contrast * (np.arange(len(times_s))[times_s > frame_s] + 1)
        steps = np.log(level[:-1] / level[1:])
        assert len(times_s) == 7
        assert np.allclose(np.diff(late), tau_s[site] * steps, rtol=1e-9)


def test_a_change_much_faster_than_the_low_pass_is_not_seen():
    pixels = pixels_of(capacitance_f=2e-14)

    assert len(pixels.events([[1e5], [1e6], [1e5]], frame_s=1e-9, seed=0)) == 0


def test_the_low_pass_agrees_with_small_steps_of_its_equation():
    capacitance_f, frame_s, contrast = 3e-14, 2e-3, 0.06
    rates = walk(40, 1, seed=5, step=0.5)[:, 0]
    events = pixels_of(contrast_on=contrast, contrast_off=contrast, capacitance_f=capacitance_f).events(
        rates[:, None], frame_s=frame_s, seed=0
    )

    n, log_light = 20_000, np.log(rates)
    level = reference = log_light[0]
    expected = []
    for k in range(39):
        tau_s = capacitance_f * BOLTZMANN_J_PER_K * 300.0 / (ELEMENTARY_CHARGE_C**2 * 0.5 * (rates[k] + rates[k + 1]))
        decay, dt_s = math.exp(-frame_s / n / tau_s), frame_s / n
        for j in range(n):
            light = log_light[k] + (log_light[k + 1] - log_light[k]) * (j + 0.5) / n
            level = light + (level - light) * decay
            if abs(level - reference) >= contrast:
                expected.append((k * frame_s + (j + 1) * dt_s, np.sign(level - reference)))
                reference += math.copysign(contrast, level - reference)

    assert len(expected) > 30
    assert events.polarity.tolist() == [p for _, p in expected]
    assert np.allclose(events.t_s, [t_s for t_s, _ in expected], atol=2e-6)


@pytest.mark.parametrize("noise_per_s", [0.0, 1e4])
@pytest.mark.parametrize("capacitance_f", [0.0, 1e-14])
def test_the_rate_never_passes_the_inverse_of_the_refractory_time(noise_per_s, capacitance_f):
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


def test_after_an_event_the_reference_follows_until_the_refractory_time_is_over():
    slope_per_s, contrast, refractory_s = 2.0, 0.2, 0.05
    rates = 100.0 * np.exp(slope_per_s * np.arange(3))[:, None]
    events = pixels_of(contrast_on=contrast, refractory_s=refractory_s).events(rates, frame_s=1.0, seed=0)

    # 0.1 s to a threshold and 0.05 s of rest.
    assert np.allclose(np.diff(events.t_s), 0.15, rtol=1e-12)


def test_leakage_gives_its_rate_of_brightening_in_constant_light():
    events = pixels_of(2, leak_per_s=5.0).events([[1e3, 1e4]] * 22, frame_s=0.1, seed=0)

    assert events.counts(polarity=-1).tolist() == [0, 0]
    for site in (0, 1):
        assert np.allclose(events.t_s[events.site == site], 0.2 * np.arange(1, 11), rtol=1e-12)


def test_noise_events_are_a_poisson_process_that_light_halves():
    noise_per_s, n_sites = 20.0, 2000
    pixels = pixels_of(n_sites, noise_per_s=noise_per_s, noise_half_e_per_s=1000.0)
    light = np.where(np.arange(n_sites) < 1000, 1e-3, 1000.0)
    events = pixels.events([light] * 11, frame_s=0.1, seed=3)

    counts = events.counts()
    for part, mean in ((counts[:1000], 20.0), (counts[1000:], 10.0)):
        assert abs(part.mean() - mean) < 5.0 * math.sqrt(mean / 1000)
        # The variance of a variance of Poisson's law: (mean + 2 mean²) / n.
        assert abs(part.var() - mean) < 5.0 * math.sqrt((mean + 2.0 * mean**2) / 1000)
    ups = (events.polarity == 1).sum()
    assert abs(ups - 0.5 * len(events)) < 5.0 * 0.5 * math.sqrt(len(events))


def test_mismatch_is_fixed_in_the_device():
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


@pytest.mark.parametrize("batch", [1, 2, 7, 100])
@pytest.mark.parametrize("changes", [{}, NOISY])
def test_batches_of_any_size_give_the_same_events(batch, changes):
    pixels = pixels_of(30, **changes)
    rates = walk(25, 30)
    whole = pixels.events(rates, frame_s=0.01, seed=4)

    assert len(whole) > 500
    assert same(Events.joined(pixels.stream(rates, frame_s=0.01, seed=4, batch=batch)), whole)


def test_threads_and_pieces_change_nothing(monkeypatch):
    pixels = pixels_of(50, **NOISY)
    rates = walk(25, 50)
    whole = pixels.events(rates, frame_s=0.01, seed=4, n_threads=1)
    monkeypatch.setattr(sys.modules[EventPixels.__module__], "PIECE_SITES", 7)

    assert same(pixels.events(rates, frame_s=0.01, seed=4, n_threads=2), whole)


def test_a_seed_gives_the_same_noise_and_another_another():
    pixels = pixels_of(5, noise_per_s=50.0)
    one, again, other = (pixels.events([[100.0] * 5] * 10, frame_s=0.1, seed=s) for s in (1, 1, 2))

    assert same(one, again)
    assert not same(one, other)


def test_larger_sites_of_even_light_tell_the_same_changes():
    layout = fs.layout.log_polar(n_sectors=16, n_rings=6, r_min_um=5.0, r_max_um=40.0)
    grid = fs.Grid.centred((200, 200), 0.5)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout))
    lights = [fs.PowerMap(np.full((1, 200, 200), level), grid, np.array([550.0])) for level in (1.0, 2.0, 4.0)]
    pixels = EventPixels(camera.sensor, contrast_on=0.3, floor_e_per_s=0.0)
    events = pixels.events(camera.rates(lights), frame_s=0.1, seed=0)

    assert events.counts().tolist() == [4] * layout.n_sites
    # With the low pass larger sites are faster.
    slow = EventPixels(camera.sensor, contrast_on=0.3, capacitance_f=1e-12).events(
        camera.rates([*lights, *[lights[-1]] * 20]), frame_s=1e-3, seed=0
    )
    first_s = np.array([slow.t_s[slow.site == s][0] for s in range(layout.n_sites)])
    assert np.corrcoef(np.log(layout.area_um2), first_s)[0, 1] < -0.9


def test_darkness_without_a_floor_is_told():
    with pytest.raises(SimulationError, match="floor_e_per_s"):
        pixels_of(2).events([[1.0, 0.0]], frame_s=0.1, seed=0)
    assert len(EventPixels(sensor_of(2)).events([[0.0, 0.0]] * 3, frame_s=0.1, seed=0)) == 0


# -- spikes -----------------------------------------------------------------------------------------------------------


def test_the_rate_of_spikes_is_the_current_over_the_charge_of_one():
    currents = np.array([0.0, 701.0, 12_345.0, 1.00013e6])
    sensor = sensor_of(4, shot_noise="off")
    spikes = SpikingPixels(sensor, threshold_e=250.0).events([currents] * 10, frame_s=1.0, seed=0)

    assert np.array_equal(spikes.counts(), np.floor(currents * 10.0 / 250.0))
    times_s = spikes.t_s[spikes.site == 2]
    assert np.allclose(times_s, 250.0 / 12_345.0 * np.arange(1, times_s.size + 1), rtol=1e-12)


def test_charge_stays_from_frame_to_frame():
    sensor = sensor_of(1, shot_noise="off")
    spikes = SpikingPixels(sensor, threshold_e=100.0).events(
        [[30.0], [40.0], [50.0], [0.0], [80.0]], frame_s=1.0, seed=0
    )

    # 30 + 40, 30 of 50 in 0.6 s; 20 left, and 80 more exactly at the end of the last frame, which is not of it.
    assert np.allclose(spikes.t_s, [2.6])


def test_the_refractory_time_adds_to_every_interval():
    sensor = sensor_of(1, shot_noise="off")
    pixels = SpikingPixels(sensor, threshold_e=100.0, refractory_s=0.013)
    spikes = pixels.events([[2000.0]] * 100, frame_s=0.01 * math.sqrt(2.0), seed=0)

    assert np.allclose(np.diff(spikes.t_s), 0.05 + 0.013, rtol=1e-9)


@pytest.mark.parametrize("threshold_e", [1.0, 3.0, 400.0])
def test_intervals_follow_the_gamma_law(threshold_e):
    n_sites, rate = 500, 1000.0 * threshold_e
    pixels = SpikingPixels(sensor_of(n_sites), threshold_e=threshold_e)
    spikes = pixels.events([np.full(n_sites, rate)] * 7, frame_s=0.01, seed=2)
    mean_s = threshold_e / rate
    # Spikes that begin an interval in the first half have its end in the second.
    intervals = np.concatenate([np.diff(spikes.t_s[spikes.site == s])[:30] for s in range(n_sites)]) / mean_s

    n = intervals.size
    assert n == 30 * n_sites
    assert abs(intervals.mean() - 1.0) < 5.0 / math.sqrt(threshold_e * n)
    # The kurtosis of the gamma law of shape N is 6/N above 3.
    assert abs(intervals.var() * threshold_e - 1.0) < 5.0 * math.sqrt((2.0 + 6.0 / threshold_e) / n)


@pytest.mark.parametrize("batch", [1, 3, 50])
def test_batches_of_any_size_give_the_same_spikes(batch):
    pixels = SpikingPixels(sensor_of(20), threshold_e=50.0, refractory_s=1e-4)
    rates = walk(20, 20)
    whole = pixels.events(rates, frame_s=0.01, seed=4)

    assert len(whole) > 1000
    assert same(Events.joined(pixels.stream(rates, frame_s=0.01, seed=4, batch=batch)), whole)


def test_each_site_may_have_its_own_threshold():
    sensor = sensor_of(3, shot_noise="off")
    spikes = SpikingPixels(sensor, threshold_e=np.array([10.0, 20.0, 40.0])).events([[401.0] * 3], frame_s=1.0, seed=0)

    assert spikes.counts().tolist() == [40, 20, 10]


def test_more_spikes_than_memory_are_told():
    with pytest.raises(SimulationError, match="do not fit the memory"):
        SpikingPixels(sensor_of(1), threshold_e=1.0).events([[1e12]], frame_s=1.0, seed=0)


# -- what both refuse -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (EventPixels, {"contrast_on": 0.0}),
        (EventPixels, {"contrast_off": 1e-9}),
        (EventPixels, {"refractory_s": -1.0}),
        (EventPixels, {"leak_per_s": math.nan}),
        (EventPixels, {"capacitance_f": 1.0}),
        (EventPixels, {"temperature_k": 0.0}),
        (SpikingPixels, {"threshold_e": 0.5}),
        (SpikingPixels, {"threshold_e": [1.0, 2.0]}),
        (SpikingPixels, {"refractory_s": -1.0}),
    ],
)
def test_parameters_out_of_range_are_told(kind, change):
    with pytest.raises(ParameterError, match=next(iter(change))):
        kind(sensor_of(3), **change)
    with pytest.raises(ParameterError, match="sensor"):
        kind(sensor_of(3).layout)


@pytest.mark.parametrize("kind", [EventPixels, SpikingPixels])
def test_wrong_calls_are_told_at_once_and_wrong_frames_when_they_come(kind):
    pixels = kind(sensor_of(3))
    for wrong in ({"frame_s": 0.0}, {"seed": -1}, {"batch": 0}):
        with pytest.raises(ParameterError, match=next(iter(wrong))):
            pixels.stream([], **({"frame_s": 0.1, "seed": 0} | wrong))
    for frame in ([1.0, 2.0], [1.0, 2.0, -1.0], [1.0, 2.0, math.nan]):
        with pytest.raises(ParameterError, match="rates"):
            pixels.events([frame], frame_s=0.1, seed=0)
    assert len(pixels.events([], frame_s=0.1, seed=0)) == 0


# -- files ------------------------------------------------------------------------------------------------------------


def some_events():
    layout = fs.layout.grid(n_x=6, n_y=4, pitch_um=4.0).with_columns(readout_order=np.arange(24))
    pixels = EventPixels(fs.Sensor(layout), noise_per_s=40.0)
    return pixels.events(walk(30, 24), frame_s=0.01, seed=1)


def test_events_come_back_from_npz_to_the_last_bit(tmp_path):
    events = some_events()
    events.save(tmp_path / "e.npz")
    read = Events.load(tmp_path / "e.npz")

    assert same(read, events)
    assert np.array_equal(read.layout.xy_um, events.layout.xy_um)
    assert np.array_equal(read.layout.columns["readout_order"], np.arange(24))


def test_hdf5_has_the_arrays_of_event_tools(tmp_path):
    h5py = pytest.importorskip("h5py")
    events = some_events()
    events.save(tmp_path / "e.h5")

    with h5py.File(tmp_path / "e.h5") as file:
        t_us, x, y, p = (file[f"events/{name}"][:] for name in "txyp")
        ms_to_idx = file["ms_to_idx"][:]
        assert np.array_equal(file["events/site"][:], events.site)
    centroid_um = events.layout.centroid_um[events.site]
    assert np.array_equal(t_us, np.floor(events.t_s * 1e6))
    # Sites of a grid are its columns and rows, the top row first.
    assert np.array_equal(x, np.rint((centroid_um[:, 0] + 10.0) / 4.0))
    assert np.array_equal(y, np.rint((6.0 - centroid_um[:, 1]) / 4.0))
    assert set(p) == {0, 1}
    assert np.array_equal(p == 1, events.polarity == 1)
    for ms in (0, 3, 100, len(ms_to_idx) - 1):
        assert ms_to_idx[ms] == np.count_nonzero(t_us < 1000 * ms)


def test_batches_make_the_same_hdf5_as_all_events_at_once(tmp_path):
    h5py = pytest.importorskip("h5py")
    layout = fs.layout.grid(n_x=6, n_y=4, pitch_um=4.0)
    pixels = EventPixels(fs.Sensor(layout), noise_per_s=40.0)
    # In the middle no event for 100 ms.
    rates = np.concatenate((walk(30, 24), np.repeat(walk(30, 24)[-1:], 10, axis=0), walk(20, 24)))
    whole = pixels.events(rates, frame_s=0.01, seed=1)
    whole.save(tmp_path / "whole.h5")

    assert write_events(pixels.stream(rates, frame_s=0.01, seed=1, batch=3), tmp_path / "batches.h5") == len(whole)
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
    with h5py.File(tmp_path / "whole.h5") as a, h5py.File(tmp_path / "batches.h5") as b:
        for name in names:
            assert np.array_equal(a[name][()], b[name][()])
            assert a[name].dtype == b[name].dtype


def test_hdf5_of_no_events_or_of_batches_that_do_not_follow_each_other(tmp_path):
    h5py = pytest.importorskip("h5py")
    events = some_events()
    with pytest.raises(ParameterError, match="follow each other"):
        write_events([events, events], tmp_path / "e.h5")
    with pytest.raises(ParameterError, match="at least one batch"):
        write_events([], tmp_path / "e.h5")
    with pytest.raises(FileError, match="must end in"):
        write_events([events], tmp_path / "e.npz")
    assert list(tmp_path.iterdir()) == []
    assert write_events([events.between(5.0, 6.0)], tmp_path / "e.h5") == 0
    with h5py.File(tmp_path / "e.h5") as file:
        assert file["ms_to_idx"][:].tolist() == [0]


def test_a_missing_hdf5_library_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FileError, match=r"pip install 'foveasim\[video\]'"):
        some_events().save(tmp_path / "e.h5")


def test_parts_in_time_are_whole_and_disjoint():
    events = some_events()
    parts = [events.between(a, b) for a, b in itertools.pairwise([-1.0, 0.05, 0.1, 9.0])]

    assert same(Events.joined(parts), events)
    assert np.array_equal(events.counts(polarity=1) + events.counts(polarity=-1), events.counts())


def test_events_that_would_unpack_to_too_much_are_refused(tmp_path, monkeypatch):
    some_events().save(tmp_path / "e.npz")
    monkeypatch.setattr("foveasim.archives.MAX_UNPACKED_BYTES", 1000)
    with pytest.raises(FileError, match="would unpack to more"):
        Events.load(tmp_path / "e.npz")


def test_files_that_hold_no_events_are_told(tmp_path):
    with pytest.raises(FileError, match="must end in"):
        some_events().save(tmp_path / "e.txt")
    with pytest.raises(FileError, match="no such file"):
        Events.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"no zip")
    with pytest.raises(FileError, match="is broken or no file of events"):
        Events.load(tmp_path / "bad.npz")
    with pytest.raises(ParameterError, match="pitch_um"):
        some_events().addresses(1e-6)
