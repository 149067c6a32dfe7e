"""Recovery of the parameters of simulated event pixels, coverage of the intervals, and recordings that are rejected."""

from __future__ import annotations

import math

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.modes import EventPixels, Events
from foveasim.twin import StaticRecording, StepResponses, fit_event_pixels

STEPS = np.concatenate((np.linspace(0.13, 0.31, 9), -np.linspace(0.1, 0.26, 9)))
PIXELS = {
    "contrast_on": 0.22, "contrast_off": 0.18, "mismatch_fraction": 0.06, "contrast_noise": 0.012, "refractory_s": 1e-3,
    "floor_e_per_s": 0.0,
}  # fmt: skip
WINDOW_S, REST_S = 0.019, 0.012


def record(pixels, steps=STEPS, n_trials=10, current_e_per_s=1e4, seed=0):
    """Return responses to steps from the same level, before each of which the light goes up and down by e^3 in 1 us."""
    levels, times_s, begins_s, t_s = [0.0], [0.0], [], 0.01
    for step in (contrasts := np.tile(steps, n_trials)):
        for level, rest_s in ((3.0, 2e-3), (0.0, REST_S), (step, WINDOW_S + 1e-3)):
            times_s += [t_s, t_s + 1e-6]
            levels += [levels[-1], level]
            begins_s += [t_s] if level == step else []
            t_s += rest_s
    light = (np.full(pixels.sensor.layout.n_sites, current_e_per_s * math.exp(level)) for level in levels)
    events = pixels.events(light, times_s=times_s, seed=seed)
    return StepResponses.from_events(
        events, begins_s, contrasts, window_s=WINDOW_S, rest_s=REST_S, current_e_per_s=current_e_per_s
    )


def row(n_sites, **changes):
    sensor = fs.Sensor(fs.layout.grid(n_x=n_sites, n_y=1, pitch_um=4.0), device_seed=changes.pop("device_seed", 0))
    return EventPixels(sensor, **PIXELS | changes)


def coverage(fits, true):
    """Return the fraction of intervals that contain the parameter, and the mean error in standard errors, by parameter."""
    found = {}
    for name, value in true.items():
        limits = np.array([fit.intervals[name] for fit in fits])
        errors = np.array([fit.values[name] for fit in fits]) - value
        is_inside = (limits[:, 0] <= value) & (value <= limits[:, 1])
        found[name] = float(is_inside.mean()), float(errors.mean() / errors.std())
    return found


# -- recovery -----------------------------------------------------------------------------------------------------------


def test_all_parameters_are_recovered_from_recordings():
    true = {
        "leak_per_s": 0.5, "leak_spread_fraction": 0.3, "noise_per_s": 1.0, "noise_half_e_per_s": 4e5,
        "contrast_noise_changes_per_s": 40.0, "capacitance_f": 2e-16,
    }  # fmt: skip
    pixels = row(200, **true)
    far = [0.4, 0.6, 0.9, 1.2, -0.4, -0.6, -0.8, -1.0]
    static = [
        StaticRecording.from_events(
            pixels.events([np.full(200, current)] * 2, frame_s=200.0, seed=20 + k), 0.0, 200.0, current_e_per_s=current
        )
        for k, current in enumerate((1e4, 3e5, 1e6))
    ]
    steps = record(pixels, np.concatenate((STEPS, far)), n_trials=6, current_e_per_s=3e5)
    fit = fit_event_pixels(steps, static, contrast_noise_changes_per_s=40.0)

    assert dict(fit.not_identifiable) == {}
    for name, value in (PIXELS | true).items():
        if name in fit.values:
            low, high = fit.intervals[name]
            assert abs(fit.values[name] - value) < 4.0 * (high - low) / 3.92, name
            assert high - low < 0.8 * value
    assert len(fit.values) == 10
    thresholds = pixels.thresholds
    for found, expected in zip((fit.thresholds_on, fit.thresholds_off), thresholds, strict=True):
        assert np.corrcoef(found, expected)[0, 1] > 0.9
    assert np.corrcoef(fit.leak_rates_per_s, pixels.leaks_per_s)[0, 1] > 0.7

    same = fit.pixels(fs.Sensor(fs.layout.hexagonal(4, 4, pitch_um=3.0)))
    assert same.contrast_on == fit.values["contrast_on"]
    assert same.contrast_noise_changes_per_s == 40.0
    assert abs(same.noise_per_s - 1.0) < 0.1


def simulated_fits(n_cases, n_pixels, n_trials, **changes):
    steps = record(row(n_cases * n_pixels, **changes), n_trials=n_trials)
    return [
        fit_event_pixels(StepResponses(steps.log_contrast, steps.n_trials, part))
        for part in np.split(steps.n_responses, n_cases, axis=1)
    ]


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("mismatch", "noise", "n_trials"), [(0.06, 0.012, 10), (0.1, 0.025, 6), (0.04, 0.03, 12)])
def test_intervals_cover_simulated_pixels(mismatch, noise, n_trials):
    changes = {"mismatch_fraction": mismatch, "contrast_noise": noise, "device_seed": 7}
    found = coverage(simulated_fits(200, 50, n_trials, **changes), {
        "contrast_on": 0.22, "contrast_off": 0.18, "mismatch_fraction": mismatch, "contrast_noise": noise,
    })  # fmt: skip

    # Of 800 intervals; those of each parameter at 4 standard deviations of a binomial number.
    assert 0.93 <= np.mean([inside for inside, _ in found.values()]) <= 0.97
    assert all(abs(inside - 0.95) < 4.0 * math.sqrt(0.95 * 0.05 / 200) for inside, _ in found.values())
    assert all(abs(bias) < 0.3 for _, bias in found.values()), found


@pytest.mark.slow
@pytest.mark.nightly
def test_intervals_cover_static_parameters():
    true = {
        "leak_per_s": 0.4, "leak_spread_fraction": 0.2, "noise_per_s": 0.6, "noise_half_e_per_s": 3e4, "refractory_s": 2e-3,
    }  # fmt: skip
    fits = []
    for seed in range(200):
        pixels = row(256, **true, device_seed=seed, contrast_noise=0.0)
        static = [
            StaticRecording.from_events(
                pixels.events([np.full(256, current)] * 2, frame_s=60.0, seed=3 * seed + k),
                0.0,
                60.0,
                current_e_per_s=current,
            )
            for k, current in enumerate((1e3, 3e4, 1e5))
        ]
        fits.append(fit_event_pixels(static=static))
    found = coverage(fits, true)

    assert 0.93 <= np.mean([inside for inside, _ in found.values()]) <= 0.97
    assert all(abs(bias) < 0.3 for _, bias in found.values()), found


@pytest.mark.slow
@pytest.mark.nightly
def test_intervals_cover_drawn_binomials():
    rng, step = np.random.default_rng(5), np.linspace(0.1, 0.3, 9)
    probability = np.array([0.5 * math.erfc((0.2 - s) / 0.03 / math.sqrt(2.0)) for s in step])
    drawn = (StepResponses(step, np.full(9, 60), rng.binomial(60, probability)) for _ in range(500))
    fits = [fit_event_pixels(steps, contrast_noise=0.0) for steps in drawn]
    found = coverage(fits, {"contrast_on": 0.2, "mismatch_fraction": 0.15})

    assert 0.93 <= np.mean([inside for inside, _ in found.values()]) <= 0.97
    assert all(abs(bias) < 0.3 for _, bias in found.values()), found


def test_drawn_binomials_are_separated_by_pixel():
    # Independent of the package: thresholds and responses by numpy, probabilities by math.erfc.
    rng, step = np.random.default_rng(6), np.linspace(0.1, 0.3, 11)
    thresholds = 0.2 * (1.0 + 0.08 * rng.standard_normal(300))
    argument = (thresholds - step[:, None]) / 0.02 / math.sqrt(2.0)
    responses = rng.binomial(20, 0.5 * np.vectorize(math.erfc)(argument))
    fit = fit_event_pixels(StepResponses(step, np.full(11, 20), responses))

    for name, value in (("contrast_on", 0.2), ("mismatch_fraction", 0.08), ("contrast_noise", 0.02)):
        low, high = fit.intervals[name]
        assert abs(fit.values[name] - value) < 4.0 * (high - low) / 3.92
        assert high - low < 0.2 * value
    assert fit.not_identifiable["contrast_off"] == "there are no OFF steps"

    pooled = StepResponses(step, np.full(11, 6000), responses.sum(axis=1), n_pixels=300)
    both = fit_event_pixels(pooled)
    assert abs(both.values["s_curve_width_on"] - math.hypot(0.016, 0.02)) < 0.002
    assert "sum of the variances" in both.not_identifiable["mismatch_fraction"]
    assert abs(fit_event_pixels(pooled, contrast_noise=0.02).values["mismatch_fraction"] - 0.08) < 0.01
    with pytest.raises(ParameterError, match="'mismatch_fraction' must be given: it is not identifiable"):
        both.pixels(fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=4.0)), contrast_off=0.2)


def test_many_pixels_have_thresholds_of_their_own(monkeypatch):
    pixels = row(300)
    steps = record(pixels)
    monkeypatch.setattr("foveasim.twin.events._s_curves.MAX_PIXELS", 100)
    fit = fit_event_pixels(steps)

    assert np.corrcoef(fit.thresholds_on, pixels.thresholds[0])[0, 1] > 0.9
    low, high = fit.intervals["contrast_on"]
    assert 0.5 < (high - low) / (2.0 * 1.96 * 0.06 * 0.22 / 10.0) < 1.5


def test_number_of_pixels_widens_pooled_intervals():
    step, responses = np.linspace(0.1, 0.3, 5), [20, 1600, 5000, 8400, 9980]
    one, other = (
        fit_event_pixels(StepResponses(step, np.full(5, 10_000), responses, n_pixels=n)).intervals for n in (None, 100)
    )

    # With mismatch alone, the mean of 100 thresholds has a tenth of their standard deviation, 0.05.
    low, high = other["contrast_on"]
    assert abs(high - low - 2 * 1.96 * 0.005) < 0.001
    assert one["contrast_on"][1] - one["contrast_on"][0] < 0.2 * (high - low)


def test_absent_mismatch_has_limit_of_zero():
    rng, step = np.random.default_rng(8), np.linspace(0.1, 0.3, 9)
    probability = [0.5 * math.erfc((0.2 - s) / 0.03 / math.sqrt(2.0)) for s in step]
    responses = rng.binomial(10, np.repeat(np.array(probability)[:, None], 40, axis=1))
    fit = fit_event_pixels(StepResponses(step, np.full(9, 10), responses))

    assert fit.intervals["mismatch_fraction"][0] == 0.0
    assert fit.intervals["mismatch_fraction"][1] < 0.06


def test_missed_and_false_responses_are_separated():
    rng, step = np.random.default_rng(9), np.concatenate(([0.02, 0.04], np.linspace(0.13, 0.27, 8), [0.6, 0.9]))
    thresholds = 0.2 * (1.0 + 0.05 * rng.standard_normal(200))
    event = 0.5 * np.vectorize(math.erfc)((thresholds - step[:, None]) / 0.012 / math.sqrt(2.0))
    responses = rng.binomial(20, 0.03 + 0.95 * event)
    fit = fit_event_pixels(StepResponses(step, np.full(12, 20), responses))

    for name, value in (("contrast_on", 0.2), ("mismatch_fraction", 0.05), ("contrast_noise", 0.012)):
        low, high = fit.intervals[name]
        assert abs(fit.values[name] - value) < 4.0 * (high - low) / 3.92


def test_published_parameters_of_imx636_are_recovered():
    # O. Root, J. Mujo and M. Xu, Noise2Params (arXiv 2605.16317), configs/params_published.yaml at commit 6db1310 of
    # github.com/yagoiroot/Noise2Params, Prophesee EVK4: log-contrast threshold 0.15, standard deviation of the thresholds
    # 0.00651, dead time 79 us. The temporal noise is not among them.
    published = {"contrast_on": 0.15, "mismatch_fraction": 0.00651 / 0.15, "refractory_s": 79e-6}
    pixels = row(150, **published, contrast_off=0.15, contrast_noise=0.01, noise_per_s=5.0, noise_half_e_per_s=1e9)
    static = StaticRecording.from_events(pixels.events([np.full(150, 1e4)] * 2, frame_s=100.0, seed=1), 0.0, 100.0)
    fit = fit_event_pixels(record(pixels, np.linspace(0.1, 0.2, 9)), [static])

    for name, value in published.items():
        low, high = fit.intervals[name]
        assert abs(fit.values[name] - value) < 4.0 * (high - low) / 3.92


def test_hot_and_dead_pixels_are_excluded():
    rng = np.random.default_rng(2)
    on, off = rng.poisson(20, (10, 100)), rng.poisson(8, (10, 100))
    on[:, 17], off[:, 17] = 4000, 4000
    fit = fit_event_pixels(static=[StaticRecording(on, off, bin_s=10.0)])
    assert fit.hot_pixels.tolist() == [17]
    assert abs(fit.values["noise_per_s"] - 1.6) < 0.1

    steps = record(row(60), n_trials=4)
    responses = steps.n_responses.copy()
    responses[:, 5] = 0
    fit = fit_event_pixels(StepResponses(steps.log_contrast, steps.n_trials, responses))
    assert fit.dead_pixels.tolist() == [5]
    assert np.isnan(fit.thresholds_on[5])
    assert abs(fit.values["mismatch_fraction"] - 0.06) < 0.03


def test_unidentifiable_parameters_have_reasons():
    fit = fit_event_pixels(StepResponses(STEPS[:9], np.full(9, 50), [0, 1, 5, 14, 29, 40, 47, 49, 50]))

    assert "no static recordings" in fit.not_identifiable["refractory_s"]
    assert "latencies" in fit.not_identifiable["capacitance_f"]
    assert {"contrast_on", "s_curve_width_on"} == fit.values.keys()
    records = fit.records()
    assert len(records) == len(fit.values) + len(fit.not_identifiable)
    with pytest.raises(ParameterError, match=r"'contrast_off' must be given: .* there are no OFF steps"):
        fit.pixels(fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=4.0)))


def test_plot_has_curves_and_points():
    fit = fit_event_pixels(record(row(20), n_trials=3))
    axes = fit.plot()

    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["ON", "OFF"]
    x, y = axes.get_lines()[0].get_data()
    assert abs(np.interp(0.5, y, x) - fit.values["contrast_on"]) < 1e-3
    assert len(axes.containers) == 2


# -- errors -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("contrast", "trials", "responses", "message"),
    [
        ([10.0, 20.0], [9, 9], [1, 2], r"'log_contrast' must be natural .* got 20.0; convert a contrast in percent"),
        ([0.1, 0.0], [9, 9], [1, 2], "'log_contrast' must not be 0; the polarity of a step is its sign"),
        ([], [], [], "'log_contrast' must contain at least one step"),
        ([0.1, 0.2], [9], [1, 2], "'n_trials' must be one number of at least 1 for each of 2 steps"),
        ([0.1, 0.2], [9, 9], [1, 2, 3], r"'n_responses' must be \(2, n_pixel\), or \(2,\) if pooled"),
        ([0.1, 0.2], [9, 9], [1, 10], "'n_responses' must be at most the number of trials"),
        ([0.1, 0.2], [9, 9], [0.1, 0.9], "'n_responses' must be integers >= 0"),
    ],
)
def test_invalid_responses_are_rejected(contrast, trials, responses, message):
    with pytest.raises(ParameterError, match=message):
        StepResponses(contrast, trials, responses)


@pytest.mark.parametrize(
    ("contrast", "responses", "message"),
    [
        ([0.1, 0.2], [0, 0], "'steps' must have events, got none"),
        ([0.1, 0.2], [0, 3], "ON steps are too small: at most 0.03 of the trials cause one, at 0.2"),
        ([-0.1, -0.2], [95, 99], "OFF steps are too large: at least 0.95 of the trials cause one, at 0.1"),
        ([0.1, 0.2], [0, 100], "ON steps are too coarse: the threshold is between 0.1 and 0.2; add steps between"),
        ([0.2], [50], "'steps' must have two or more ON steps of different contrast"),
    ],
)
def test_steps_without_s_curve_are_rejected(contrast, responses, message):
    with pytest.raises(ParameterError, match=message):
        fit_event_pixels(StepResponses(contrast, np.full(len(contrast), 100), responses))


def test_invalid_recordings_are_rejected():
    sites = fs.layout.grid(n_x=9, n_y=1, pitch_um=4.0)
    empty = Events(np.zeros(0), np.zeros(0, np.int32), np.zeros(0, np.int8), sites)
    for call, message in [
        (lambda: StepResponses.from_events(empty, [0.1], [0.1], window_s=0.1), "'events' must contain events, got none"),
        (lambda: StepResponses.from_events(empty, [0.1], [0.1, 0.2], window_s=0.1), "'times_s' must be one time for each of 2"),
        (lambda: StepResponses.from_events(empty, [0.1, 0.15], [0.1, 0.2], window_s=0.1), "'times_s' must be ascending, 0.1 s"),
        (lambda: StaticRecording.from_events(empty, 1.0, 0.5), "'stop_s' must be > 1, the start, got 0.5 s"),
        (lambda: StaticRecording.from_events(empty, 0.0, 0.5), "'n_on' must contain events, got none"),
        (lambda: StaticRecording([1, 2], [3, 4], bin_s=1.0), "'n_on' must have 8 or more pixels, got 2"),
        (lambda: StaticRecording(np.ones(9, int), np.ones(8, int), bin_s=1.0), "'n_off' must have the shape"),
        (fit_event_pixels, "'steps' must be given, or 'static'"),
    ]:  # fmt: skip
        with pytest.raises(ParameterError, match=message):
            call()


def test_events_of_files_give_responses(tmp_path):
    sites = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0)
    events = Events(np.array([0.1001, 0.1002, 0.1003, 0.2001]), np.array([0, 0, 1, 2]), np.array([1, 1, -1, -1]), sites)
    events.save(tmp_path / "steps.txt")
    steps = StepResponses.from_events(
        Events.read(tmp_path / "steps.txt", sites), [0.1, 0.2], [0.3, -0.3], window_s=0.01
    )

    assert steps.log_contrast.tolist() == [-0.3, 0.3]
    assert steps.n_responses.tolist() == [[0, 0, 1], [1, 0, 0]]
    assert np.allclose(steps.latency_s, [1e-4, 1e-4])
