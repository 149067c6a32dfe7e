"""Closed forms of event pixels against their simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.modes import EventPixels, event_probability
from foveasim.modes.step_response import leak_part, noise_and_leak_per_s

N_SITES = 20_000
SENSOR = fs.Sensor(fs.layout.grid(n_x=200, n_y=100, pitch_um=4.0))
DARK = np.full(N_SITES, 1e4)


def pixels_of(**changes):
    return EventPixels(SENSOR, **({"floor_e_per_s": 0.0} | changes))


def below(x):
    """Return the Gaussian distribution function."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


@pytest.mark.parametrize("step", [0.14, 0.18, 0.2, 0.23, -0.16, -0.2])
@pytest.mark.parametrize("changes_per_s", [0.0, 50.0])
def test_step_gives_events_with_probability(step, changes_per_s):
    noise, rest_s, window_s = 0.03, 0.01, 0.05
    pixels = pixels_of(
        contrast_off=0.18, contrast_noise=noise, contrast_noise_changes_per_s=changes_per_s, refractory_s=1e-3
    )
    after = DARK * math.exp(step)
    times_s = [0.0, rest_s, rest_s + 1e-7, rest_s + window_s]
    events = pixels.events([DARK, DARK, after, after], times_s=times_s, seed=1).between(rest_s, 1.0)

    theta = 0.2 if step > 0.0 else 0.18
    part = below((theta - abs(step)) / noise)
    expected = 1.0 - part * math.exp(-changes_per_s * window_s * (1.0 - part))
    fraction = np.unique(events.site[events.polarity == np.sign(step)]).size / N_SITES
    assert abs(fraction - expected) < 5.0 * math.sqrt(expected * (1.0 - expected) / N_SITES) + 1e-3
    found = event_probability(step, theta, contrast_noise=noise, changes_per_s=changes_per_s, window_s=window_s)
    assert abs(found - expected) < 1e-6


def test_mismatch_and_noise_add_to_width():
    pixels = pixels_of(mismatch_fraction=0.1, contrast_noise=0.015)
    probability = event_probability([[0.18], [0.2], [0.21]], pixels.thresholds[0], contrast_noise=0.015).mean(axis=1)

    width = math.hypot(0.02, 0.015)
    expected = [below((step - 0.2) / width) for step in (0.18, 0.2, 0.21)]
    assert np.abs(probability - expected).max() < 5.0 * 0.4 / math.sqrt(N_SITES)


def test_changes_of_noise_cause_static_events():
    pixels = pixels_of(contrast_on=0.1, contrast_off=0.12, contrast_noise=0.04, contrast_noise_changes_per_s=100.0)
    events = pixels.events([DARK] * 2, frame_s=1.0, seed=2)

    for sign, theta in ((1, 0.1), (-1, 0.12)):
        # Each event draws the noise again, too: a geometric series.
        expected = 100.0 * below(-theta / 0.04) / (1.0 - below(-0.1 / 0.04) - below(-0.12 / 0.04))
        assert abs(events.counts(polarity=sign).mean() - expected) < 5.0 * math.sqrt(expected / N_SITES)


def test_events_with_contrast_noise_ignore_batches():
    pixels = pixels_of(contrast_noise=0.05, contrast_noise_changes_per_s=200.0, capacitance_f=1e-14, leak_per_s=3.0)
    light = [DARK * math.exp(0.3 * math.sin(k)) for k in range(12)]
    whole = pixels.events(light, frame_s=0.01, seed=4)
    parts = fs.modes.Events.concatenate(list(pixels.stream(light, frame_s=0.01, seed=4, batch=5)))

    assert len(whole) > 10_000
    assert all(np.array_equal(getattr(whole, name), getattr(parts, name)) for name in ("t_s", "site", "polarity"))


def test_noise_delays_leak_events():
    pixels = pixels_of(leak_per_s=0.5, noise_per_s=1.0, noise_half_e_per_s=1e12, refractory_s=5e-3)
    events = pixels.events([DARK] * 2, frame_s=20.0, seed=3)
    on, off = (np.array([events.counts(polarity=sign).mean() / 20.0]) for sign in (1, -1))

    # Cycles end after 1 / 0.5 s or by noise: exp(-2) of them by the leak.
    active = (1.0 - math.exp(-2.0)) / 1.0
    assert abs(on[0] - off[0] - math.exp(-2.0) / (active + 5e-3)) < 0.01
    noise, leak = noise_and_leak_per_s(on, off, 5e-3)
    assert abs(noise[0] - 1.0) < 0.01
    assert abs(leak[0] - 0.5) < 0.01


def test_changes_of_noise_advance_leak_events():
    pixels = pixels_of(leak_per_s=0.5, contrast_noise=0.02, contrast_noise_changes_per_s=40.0)
    rate_per_s = pixels.events([DARK] * 2, frame_s=40.0, seed=3).counts().mean() / 40.0

    assert rate_per_s > 0.55
    assert abs(rate_per_s * leak_part(rate_per_s, 0.2, 0.02, 40.0) - 0.5) < 0.005


def test_leak_lowers_on_and_raises_off_threshold():
    at = {"contrast_noise": 0.01, "leak_per_s": 1.0, "rest_s": 0.05, "window_s": 0.05}

    assert abs(event_probability(0.18, 0.2, **at) - 0.5) < 1e-9
    assert abs(event_probability(-0.21, 0.2, **at) - 0.5) < 1e-9


def test_impossible_steps_are_rejected():
    with pytest.raises(ParameterError, match="'log_contrast' must be finite"):
        event_probability([np.nan], 0.2)
    with pytest.raises(ParameterError, match="'contrast_noise' must be >= 0"):
        event_probability(0.1, 0.2, contrast_noise=-0.1)


def test_leak_rate_is_constant_from_first_frame():
    pixels = pixels_of(leak_per_s=0.5, noise_per_s=2.0, noise_half_e_per_s=1e12)
    events = pixels.events([DARK] * 2, frame_s=4.0, seed=5)
    counts = events.histogram([0.0, 0.5, 2.0, 4.0], polarity=1).sum(axis=1) / np.array([0.5, 1.5, 2.0]) / N_SITES

    # Noise of 1 and leak of 2 / (exp(2 / 0.5) - 1) ON events per second, less frequent than Poisson events.
    expected = 1.0 + 2.0 / math.expm1(4.0)
    assert np.all(np.abs(counts - expected) < 5.0 * math.sqrt(expected / 0.5 / N_SITES))
