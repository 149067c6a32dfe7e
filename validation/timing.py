"""
Rolling shutters, event pixels and spiking pixels.

Light changes linearly between frames here, or exponentially, so that exposures and threshold crossings have closed forms.
Random events are compared in standard errors of their expected scatter. None of the other programs has rolling shutters,
event pixels or spiking pixels; where a distribution is elementary, NumPy draws from it, too.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from records import ERRORS, OWN, Section, in_errors, largest_absolute, largest_relative, version_of
from scipy.constants import elementary_charge
from scipy.constants import k as boltzmann
from scipy.special import ndtr
from scipy.stats import poisson

import foveasim as fs

N_SITES = 20_000
SITES = fs.layout.grid(n_x=200, n_y=100, pitch_um=4.0)
LICHTSTEINER = "Lichtsteiner, Posch and Delbruck, IEEE J. Solid-State Circuits 43, 566 (2008)"


# -- rolling shutter --------------------------------------------------------------------------------------------------


def compare_shutter(section: Section) -> None:
    """Compare the exposure of a moving edge in each row with its closed form."""
    n_x, n_y, rate_e_per_s = 64, 48, 1e4
    frame_s, line_s, exposure_s = 1e-3, 0.13e-3, 4.7e-3
    # The edge moves by a quarter of a pixel in a frame: light of each pixel is linear between frames.
    pixels_per_s, start = 0.25 / frame_s, 5.0
    layout = fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=3.0)
    row = np.rint(layout.centroid_um[:, 1] / 3.0 - layout.centroid_um[:, 1].min() / 3.0)
    column = np.rint(layout.centroid_um[:, 0] / 3.0 - layout.centroid_um[:, 0].min() / 3.0)
    layout = layout.with_columns(readout_order=row.astype(np.int64))

    def covered(t_s: np.ndarray | float) -> np.ndarray:
        """Return the part of each pixel that the edge has passed."""
        return np.clip(start + pixels_per_s * t_s - column, 0.0, 1.0)

    def own() -> np.ndarray:
        shutter = fs.modes.Shutter(layout, frame_s=frame_s, line_s=line_s, between="linear")
        exposure, k = fs.modes.Exposure(shutter, exposure_s), 0
        while not exposure.is_complete:
            exposure.add(rate_e_per_s * covered(k * frame_s))
            k += 1
        return exposure.mean_e_per_s(np.zeros(layout.n_sites))

    def integral(x: np.ndarray) -> np.ndarray:
        """Return the integral of min(max(x, 0), 1)."""
        return np.where(x > 1.0, x - 0.5, 0.5 * np.clip(x, 0.0, None) ** 2)

    at = start - column
    begin, end = (at + pixels_per_s * (line_s * row + t_s) for t_s in (0.0, exposure_s))
    truth = rate_e_per_s * (integral(end) - integral(begin)) / (pixels_per_s * exposure_s)
    frames = "32 frames in each exposure, NumPy"

    def by_frames() -> np.ndarray:
        times = exposure_s * (np.arange(32) + 0.5) / 32
        return rate_e_per_s * np.mean([covered(line_s * row + each) for each in times], axis=0)

    section.compare(
        f"rolling shutter: light of {n_x} x {n_y} pixels behind an edge that moves by 250 pixels per second",
        {OWN: own, frames: by_frames},
        truth,
        by="integral of the covered part over the exposure of each row",
        source="closed form",
        tolerance=1e-12,
        explanation="foveasim interpolates between frames, and weights them by their part of each exposure.",
    )
    skew = start + pixels_per_s * (line_s * np.arange(n_y) + 0.5 * exposure_s)

    def positions(light: np.ndarray) -> np.ndarray:
        """Return the position of the edge in each row, pixels."""
        return np.bincount(row.astype(int), weights=light) / rate_e_per_s

    section.compare(
        "rolling shutter: position of the edge in each row (skew)",
        {OWN: lambda: positions(own()), frames: lambda: positions(by_frames())},
        skew,
        by="x₀ + v (row x line time + T/2)",
        source="mean over the exposure",
        tolerance=1e-10,
        deviation=largest_absolute,
        of="pixels",
    )


# -- event pixels -----------------------------------------------------------------------------------------------------


def event_pixels(n_sites: int, **parameters: float) -> fs.modes.EventPixels:
    """Return event pixels without a floor of the current."""
    sensor = fs.Sensor(SITES if n_sites == N_SITES else fs.layout.grid(n_x=n_sites, n_y=1, pitch_um=4.0))
    return fs.modes.EventPixels(sensor, **({"floor_e_per_s": 0.0} | parameters))


def compare_event_times(section: Section) -> None:
    """Compare events of ramps and steps with threshold crossings."""
    slope_per_s, threshold, n_frames = 3.0, 0.25, 401
    ramp = 100.0 * np.exp(slope_per_s * 0.01 * np.arange(n_frames))[:, np.newaxis]
    n_events = math.floor(slope_per_s * 0.01 * (n_frames - 1) / threshold * (1.0 + 1e-12))

    def ramp_times() -> np.ndarray:
        return event_pixels(1, contrast_on=threshold).events(ramp, frame_s=0.01, seed=0).t_s

    # The last crossing is at the end of the last frame, where rounding decides.
    n_events = min(n_events, 47)
    section.compare(
        "events of a ramp of ln I from 0 to 12, threshold 0.25: times of the first 47",
        {OWN: lambda: ramp_times()[:n_events]},
        threshold / slope_per_s * np.arange(1, n_events + 1),
        by="k threshold / slope",
        source=LICHTSTEINER,
        tolerance=1e-12,
        deviation=largest_relative,
    )
    changes = np.array([0.31, 0.55, 1.01, 2.71, 4.25, -0.32, -1.01, -2.73])

    def numbers() -> np.ndarray:
        pixels = event_pixels(changes.size, contrast_on=0.2, contrast_off=0.15)
        return pixels.events([np.full(changes.size, 1e3), 1e3 * np.exp(changes)], frame_s=1.0, seed=0).counts()

    section.compare(
        "number of events of eight changes of ln I from -2.73 to 4.25",
        {OWN: numbers},
        np.floor(np.abs(changes) / np.where(changes > 0.0, 0.2, 0.15)),
        by="⌊change/threshold⌋",
        source=LICHTSTEINER,
        tolerance=0.0,
        deviation=largest_absolute,
        of="events",
    )
    capacitance_f, step = 2e-14, 2.0
    light = np.array([2e5, 1e6, 5e6])
    tau_s = capacitance_f * boltzmann * 300.0 / (elementary_charge**2 * light)
    order = np.arange(1, 8)

    def low_pass() -> np.ndarray:
        pixels = event_pixels(light.size, contrast_on=threshold, capacitance_f=capacitance_f)
        dark, times_s = math.exp(-step) * light, [0.0, 1e-12, 1.0]
        events = pixels.events([dark, light, light], times_s=times_s, seed=0)
        return np.array([events.t_s[events.site == k][: order.size] for k in range(light.size)])

    section.compare(
        "events after a step of ln I by 2 through the low pass of the photoreceptor, three currents",
        {OWN: low_pass},
        -tau_s[:, np.newaxis] * np.log(1.0 - threshold * order / step),
        by="-τ ln(1 - k threshold/step), τ = C (kT/q)/I",
        source="first-order low pass; constants of CODATA by SciPy",
        tolerance=1e-7,
        deviation=largest_relative,
    )


def compare_s_curves(section: Section, directory: Path) -> None:
    """Compare the probability of an event after a step with the Gaussian distribution function."""
    threshold, noise, mismatch = 0.2, 0.02, 0.1
    steps = np.linspace(0.12, 0.28, 17)
    dark = np.full(N_SITES, 1e4)

    def simulated(mismatch_fraction: float) -> np.ndarray:
        pixels = event_pixels(N_SITES, contrast_on=threshold, contrast_noise=noise, mismatch_fraction=mismatch_fraction)
        found = []
        for k, step in enumerate(steps):
            events = pixels.events([dark, dark, dark * math.exp(step)], times_s=[0.0, 0.01, 0.010001], seed=k)
            found.append(np.count_nonzero(events.counts(polarity=1)) / N_SITES)
        return np.array(found)

    figure = Figure(figsize=(5.2, 3.0), layout="constrained")
    axes = figure.subplots()
    for what, fraction, width in (
        ("noise of 0.02", 0.0, noise),
        ("noise of 0.02 and threshold mismatch of 10 %", mismatch, math.hypot(noise, mismatch * threshold)),
    ):
        truth = ndtr((steps - threshold) / width)
        calls = {
            OWN: lambda fraction=fraction: simulated(fraction),
            f"NumPy {version_of('numpy')}": lambda width=width: np.array(
                [
                    np.mean(threshold + width * np.random.default_rng(k).normal(size=N_SITES) <= step)
                    for k, step in enumerate(steps)
                ]
            ),
        }
        found = section.compare(
            f"S-curve: {N_SITES:,} event pixels after steps of ln I, threshold 0.2, {what}",
            calls,
            truth,
            by="Φ((step - threshold)/σ), σ² = noise² + mismatch²",
            source="Gaussian distribution; Posch and Matolin, Proc. IEEE ISCAS (2011)",
            tolerance=4.0,
            of=ERRORS,
            deviation=in_errors(np.sqrt(truth * (1.0 - truth) / N_SITES)),
            repeats=1,
            explanation="The largest of 17 deviations."
            + (" The device has the same thresholds at all steps." if fraction else ""),
        )
        axes.plot(steps, truth, lw=3, alpha=0.3, label=f"Φ, {what}")
        axes.plot(steps, found[OWN], "k.", label="foveasim" if fraction else None)
    axes.set(xlabel="step of ln I", ylabel="probability of an event")
    axes.legend(fontsize="x-small")
    section.draw("s_curves", figure, "Probability of an ON event after a step of irradiance.", directory)
    section.compare(
        "S-curve: fs.modes.event_probability",
        {OWN: lambda: fs.modes.event_probability(steps, threshold, contrast_noise=noise)},
        ndtr((steps - threshold) / noise),
        by="Φ((step - threshold)/σ)",
        source="Gaussian distribution",
        tolerance=1e-12,
        deviation=largest_absolute,
        of="of 1",
    )


def compare_rates(section: Section) -> None:
    """Compare rates of noise events, and numbers of spikes, with their distributions."""
    noise_per_s, refractory_s, duration_s, ratio = 20.0, 2e-3, 5.0, 0.5
    light = np.full(N_SITES, 1e4 * ratio)
    rate = noise_per_s / (1.0 + ratio)
    busy = 1.0 + rate * refractory_s

    def noise_events() -> float:
        pixels = event_pixels(N_SITES, noise_per_s=noise_per_s, noise_half_e_per_s=1e4, refractory_s=refractory_s)
        return float(pixels.events([light, light], frame_s=duration_s, seed=1).counts().mean())

    section.compare(
        f"noise events of {N_SITES:,} event pixels in 5 s, with a refractory time",
        {OWN: noise_events},
        # The second term belongs to the first event, before which there is no dead time.
        rate * duration_s / busy + 0.5 * (rate * refractory_s / busy) ** 2,
        by="r T/(1 + r τ), r = r₀/(1 + I/I½)",
        source="Müller, Nucl. Instrum. Methods 112, 47 (1973)",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(math.sqrt(rate * duration_s / busy**3 / N_SITES)),
        repeats=1,
    )
    threshold_e, current = 100.0, np.array([250.0, 3e3, 4.7e4])
    sensor = fs.Sensor(fs.layout.grid(n_x=current.size, n_y=1, pitch_um=4.0), shot_noise="off")
    order = np.arange(1, 21)

    def regular() -> np.ndarray:
        pixels = fs.modes.SpikingPixels(sensor, threshold_e=threshold_e, refractory_s=1e-3)
        spikes = pixels.events([current] * 9, frame_s=1.0, seed=0)
        return np.array([spikes.t_s[spikes.site == k][: order.size] for k in range(current.size)])

    section.compare(
        "integrate and fire without noise: times of 20 spikes, refractory time of 1 ms",
        {OWN: regular},
        order * threshold_e / current[:, np.newaxis] + (order - 1) * 1e-3,
        by="k N/I + (k - 1) τ",
        source="charge balance",
        tolerance=1e-12,
        deviation=largest_relative,
    )
    spiking = fs.modes.SpikingPixels(fs.Sensor(SITES), threshold_e=10.0)
    expected_e = 234.0
    charge = np.arange(1000)
    probability = poisson.pmf(charge, expected_e)
    number = charge // 10
    mean = float(probability @ number)
    second, fourth = (float(probability @ (number - mean) ** order) for order in (2, 4))

    def moments(counts: np.ndarray) -> np.ndarray:
        return np.array([counts.mean(), np.mean((counts - mean) ** 2)])

    def spikes() -> np.ndarray:
        found = spiking.events([np.full(N_SITES, expected_e / 0.3)] * 3, frame_s=0.1, seed=3)
        return moments(found.counts().astype(np.float64))

    section.compare(
        f"integrate and fire with shot noise: mean and variance of spikes of {N_SITES:,} pixels, 234 e-, threshold 10 e-",
        {
            OWN: spikes,
            f"NumPy {version_of('numpy')}": lambda: moments(
                np.random.default_rng(1).poisson(expected_e, N_SITES).astype(np.float64) // 10.0
            ),
        },
        np.array([mean, second]),
        by="⌊M/N⌋ of Poisson numbers M",
        source="Poisson process: every 10th electron",
        tolerance=4.0,
        of=ERRORS,
        deviation=in_errors(np.sqrt(np.array([second, fourth - second**2]) / N_SITES)),
    )


def validate(section: Section, directory: Path) -> None:
    """Compare exposures, events and spikes with closed forms."""
    compare_shutter(section)
    compare_event_times(section)
    compare_s_curves(section, directory)
    compare_rates(section)
