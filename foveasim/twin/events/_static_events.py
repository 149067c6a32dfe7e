"""Leak, noise and refractory time from events at constant irradiance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from foveasim._core.validation import Floats, Ints, read_only
from foveasim.errors import ParameterError
from foveasim.metrics.emva_intervals import CONFIDENCE, Jackknife
from foveasim.modes.step_response import leak_events_per_s, noise_and_leak_per_s
from foveasim.twin.events._s_curves import Found
from foveasim.twin.events.recordings import StaticRecording

__all__ = ["fit_static", "noise_at"]

#: Jackknife blocks of pixels, OFF intervals that show a refractory time, and robust standard deviations of hot pixels.
N_BLOCKS, MIN_INTERVALS, HOT_SIGMAS = 100, 200, 6.0


def noise_at(found: Found, current_e_per_s: float | None) -> float:
    """Return the noise rate at a photocurrent."""
    if "noise_per_s" not in found:
        return 0.0
    half = found["noise_half_e_per_s"][0] if "noise_half_e_per_s" in found else np.inf
    return float(found["noise_per_s"][0] / (1.0 + (current_e_per_s or 0.0) / half))


def fit_static(
    static: Sequence[StaticRecording], found: Found, reasons: dict[str, str]
) -> tuple[tuple[Floats, Floats] | None, Ints]:
    """Fit static recordings; return leak and noise rates of the pixels, and the hot pixels."""
    names = ("leak_per_s", "leak_spread_fraction", "noise_per_s", "noise_half_e_per_s", "refractory_s")
    if not static:
        reasons |= dict.fromkeys(names, "there are no static recordings")
        return None, np.zeros(0, np.int64)
    if len({recording.n_on.shape[1] for recording in static}) > 1:
        raise ParameterError("static", "must be recordings of the same pixels", [r.n_on.shape[1] for r in static])
    _fit_refractory(static, found, reasons)
    refractory_s = found["refractory_s"][0] if "refractory_s" in found else 0.0
    durations_s = np.array([r.bin_s * r.n_on.shape[0] for r in static])
    on, off = (
        np.array([getattr(r, name).sum(axis=0) for r in static]) / durations_s[:, None] for name in ("n_on", "n_off")
    )
    hot = _hot_pixels(np.rint((on + off).T @ durations_s).astype(np.int64))
    cool = np.delete(np.arange(on.shape[1]), hot)
    # Row 0 is the mean over all pixels, the others are means without one block of them.
    n_blocks = min(cool.size, N_BLOCKS)
    fractions = np.vstack([np.ones(cool.size), np.arange(cool.size) % n_blocks != np.arange(n_blocks)[:, None]])
    fractions /= fractions.sum(axis=1, keepdims=True)
    noise_per_s, _ = noise_and_leak_per_s(fractions @ on[:, cool].T, fractions @ off[:, cool].T, refractory_s)
    excess_per_s = fractions @ (on - off)[:, cool].T / (1.0 - refractory_s * (fractions @ (on + off)[:, cool].T))
    jackknife = Jackknife(np.array([n_blocks]))
    weights = durations_s / durations_s.sum()
    n_off = np.array([recording.n_off[:, cool].sum() for recording in static])
    _fit_noise(static, noise_per_s, n_off, weights, jackknife, found, reasons)
    _fit_leak(static, noise_per_s, excess_per_s, fractions, cool, weights, jackknife, found, reasons)
    rates = [np.asarray(weights @ rate) for rate in noise_and_leak_per_s(on, off, refractory_s)[::-1]]
    return (read_only(rates[0]), read_only(rates[1])), hot


def _hot_pixels(counts: Ints) -> Ints:
    """Return pixels with far more events than others, also beyond Poisson noise."""
    logs, median = np.log(counts + 0.5), float(np.median(counts))
    spread = 1.4826 * np.median(np.abs(logs - np.median(logs)))
    is_hot = logs > np.median(logs) + HOT_SIGMAS * max(spread, 1e-3)
    return np.flatnonzero(is_hot & (counts > median + HOT_SIGMAS * np.sqrt(median + 1.0)))


def _interval(jackknife: Jackknife, values: Floats) -> tuple[float, float]:
    """Return limits from jackknife values, on a logarithmic scale if it is resolved."""
    half = float((jackknife.quantile() * jackknife.error(values[:, None]))[0])
    value = float(values[0])
    if value > 0.0 and half < 0.5 * value:
        return value * float(np.exp(-half / value)), value * float(np.exp(half / value))
    return max(value - half, 0.0), max(value + half, 0.0)


def _fit_noise(
    static: Sequence[StaticRecording],
    noise_per_s: Floats,
    n_events: Ints,
    weights: Floats,
    jackknife: Jackknife,
    found: Found,
    reasons: dict[str, str],
) -> None:
    """Fit noise rates (1 + n_block, n_recording) as a function of the photocurrent."""
    currents = [r.current_e_per_s for r in static]
    known = [c for c in currents if c is not None]
    reasons["noise_half_e_per_s"] = "two or more known photocurrents are needed"
    if not n_events.sum():
        reasons["noise_per_s"] = "there are no OFF events"
        return
    if len(known) == len(static) and len(set(known)) > 1 and n_events.min() > 0:
        # 1 / rate is linear in the photocurrent; its variance is 1 / (rate^2 n).
        weight = noise_per_s[0] ** 2 * n_events
        x = np.array(known) - np.average(known, weights=weight)
        slope = (1.0 / noise_per_s) @ (weight * x) / (weight @ x**2)
        intercept = np.average(1.0 / noise_per_s, axis=1, weights=weight) - slope * np.average(known, weights=weight)
        low, high = _interval(jackknife, slope / intercept)
        if low > 0.0 and intercept.min() > 0.0:
            found["noise_per_s"] = float(1.0 / intercept[0]), _interval(jackknife, 1.0 / intercept)
            found["noise_half_e_per_s"] = float(intercept[0] / slope[0]), (1.0 / high, 1.0 / low)
            del reasons["noise_half_e_per_s"]
            return
        reasons["noise_half_e_per_s"] = (
            f"the noise does not decrease with irradiance; it is at least {1 / high:.3g} e-/s"
        )
    mean = noise_per_s @ weights
    found["noise_per_s"] = float(mean[0]), _interval(jackknife, mean)


def _fit_leak(
    static: Sequence[StaticRecording],
    noise_per_s: Floats,
    excess_per_s: Floats,
    fractions: Floats,
    cool: Ints,
    weights: Floats,
    jackknife: Jackknife,
    found: Found,
    reasons: dict[str, str],
) -> None:
    """Fit leak rate and spread to ON events in excess of OFF events per active second."""
    low, high = _interval(jackknife, excess_per_s @ weights)
    if low <= 0.0:
        value = max(float(excess_per_s[0] @ weights), 0.0)
        found["leak_per_s"] = value, (0.0, high)
        reasons["leak_spread_fraction"] = "ON events are not more frequent than OFF events"
        return
    variance = np.zeros(excess_per_s.shape)
    for k, r in enumerate(static):
        rate, n_bins = (r.n_on - r.n_off)[:, cool] / r.bin_s, r.n_on.shape[0]
        # Covariance of bins that are not neighbours: the leak of a pixel is the same, the noise of its counts independent.
        products = rate.sum(axis=0) ** 2 - (rate**2).sum(axis=0) - 2.0 * (rate[1:] * rate[:-1]).sum(axis=0)
        means = fractions @ rate.T
        squares = means.sum(axis=1) ** 2 - (means**2).sum(axis=1) - 2.0 * (means[:, 1:] * means[:, :-1]).sum(axis=1)
        variance[:, k] = (fractions @ products - squares) / max((n_bins - 1) * (n_bins - 2), 1)
    leak, spread2 = _leak_and_spread(excess_per_s, noise_per_s, variance, weights)
    found["leak_per_s"] = float(leak[0]), _interval(jackknife, leak)
    if min(r.n_on.shape[0] for r in static) < 3:
        reasons["leak_spread_fraction"] = (
            "static recordings must have three or more bins, to separate it from counting noise"
        )
        return
    low, high = _interval(jackknife, spread2)
    found["leak_spread_fraction"] = float(np.sqrt(max(spread2[0], 0.0))), (float(np.sqrt(low)), float(np.sqrt(high)))


def _leak_and_spread(
    excess_per_s: Floats, noise_per_s: Floats, variance: Floats, weights: Floats
) -> tuple[Floats, Floats]:
    """
    Return mean and squared relative spread of log-normal leak rates, (n,) each.

    ``excess_per_s``, ``variance`` (n, n_recording): mean and variance over pixels of the rates of leak events, which noise
    diminishes.
    """
    z, share = np.polynomial.hermite_e.hermegauss(15)
    share /= share.sum()
    target, total = excess_per_s @ weights, variance @ weights
    leak, spread2 = target.copy(), np.where(total > 0.0, total, 0.0) / target**2
    # The exponent of the rate of events in the leak rate is at most 1 + noise / leak.
    for _ in range(60):
        sigma2 = np.log1p(spread2)[:, None]
        leaks = leak[:, None] * np.exp(np.sqrt(sigma2) * z - 0.5 * sigma2)
        events = leak_events_per_s(leaks[:, None, :], noise_per_s[:, :, None])
        mean = events @ share
        spread2 *= np.where(total > 0.0, total, 1.0) / np.maximum((events**2 @ share - mean**2) @ weights, 1e-300)
        spread2 = np.minimum(spread2, 100.0)
        leak *= (target / (mean @ weights)) ** (1.0 / (1.0 + noise_per_s.max(axis=1) / leak))
    return leak, np.where(total > 0.0, spread2, total / target**2)


def _fit_refractory(static: Sequence[StaticRecording], found: Found, reasons: dict[str, str]) -> None:
    """Fit the lower end of the intervals before OFF events from order statistics."""
    recording = max(static, key=lambda r: r.n_intervals)
    k = min(recording.interval_s.size, recording.n_intervals // 20)
    if recording.n_intervals < MIN_INTERVALS or k < 2:
        reasons["refractory_s"] = (
            f"{recording.n_intervals} intervals end with an OFF event, and {MIN_INTERVALS} are needed; record for a longer time"
        )
        return
    first, last = float(recording.interval_s[0]), float(recording.interval_s[k - 1])
    # With uniform intervals near the end c, (x_1 - c) / (x_k - c) has the distribution Beta(1, k - 1).
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = ((first - t * last) / (1.0 - t) for t in (1.0 - p ** (1.0 / (k - 1)) for p in (tail, 1.0 - tail)))
    low, high = low - recording.tick_s, high + recording.tick_s
    if low <= 0.0:
        reasons["refractory_s"] = f"noise events are too rare: it is at most {high:.3g} s"
        return
    found["refractory_s"] = first - (last - first) / (k - 1), (low, high)
