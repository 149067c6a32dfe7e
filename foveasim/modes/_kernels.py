"""
Numba kernels of asynchronous photosites: change events, and spikes of collected charge.

The kernels use arrays only, and release the GIL. Each kernel processes some sites frame by frame and updates the state of
every site. Events are written to arrays in this order, site by site in each frame; ``ends`` contains the number of events up
to the end of each frame. When the arrays are full, events are only counted, so that the caller can repeat the call with longer
arrays; counting stops above ``max_events``.

An event whose time would be rounded to another frame is moved to the nearest time in its own frame: change events are in
``(begin, end]`` of a frame, spikes in ``[begin, end)``. The order of events therefore does not depend on the batches.

Random numbers, in the open interval (0, 1), depend on the key, the site and the number of previous draws of the site, not on
the batches.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core._kernels import philox_4x64, uniform
from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D

#: State of a change-detecting site: low-pass level, its difference from the level of the last event, end of the refractory
#: time, integrated noise rate until the next noise event, contrast noise, and the time of its next change.
LEVEL, DIFFERENCE, REFRACTORY_END, HAZARD, CONTRAST_NOISE, CHANGE_AT = range(6)
#: State of an integrating site: charge until the next spike; and REFRACTORY_END, as above.
MISSING = 0
#: With a low pass, frames are divided into parts in which the log current changes by at most this: one time constant each.
MAX_PART_CHANGE = 0.25
#: For smaller changes of the logarithm, the mean of both ends is the mean current to 1e-9.
MIN_CHANGE = 1e-4
#: Maximum steps of the bracketed Newton method, enough to find a crossing to machine precision.
MAX_STEPS = 80

_bytes, _sites, _counts = types.int8[::1], types.int32[::1], types.int64[::1]


@njit()
def _random_words(key_0, key_1, site, number):
    return philox_4x64(key_0, key_1, np.uint64(site), np.uint64(number), np.uint64(0), np.uint64(0))


@njit()
def _contrast_noise(sigma, changes_per_s, after_s, word_0, word_1, word_2):
    """Return a Gaussian number of standard deviation ``sigma``, and the time of the next one."""
    noise = sigma * math.sqrt(-2.0 * math.log(uniform(word_0))) * math.cos(2.0 * math.pi * uniform(word_1))
    return noise, after_s - math.log(uniform(word_2)) / changes_per_s if changes_per_s > 0.0 else math.inf


@njit()
def _rise(slope, swing, tau, begin, end):
    """Return the rise of ``slope * u + swing * exp(-u / tau)``; without swing if tau is 0."""
    rise = slope * (end - begin)
    if tau > 0.0:
        rise += swing * math.exp(-begin / tau) * math.expm1(-(end - begin) / tau)
    return rise


@njit()
def _crossing(slope, swing, tau, begin, difference, on, off, end):
    """
    Return the first time at which the difference reaches a threshold, and the polarity.

    The thresholds are ``on`` and ``-off``. The time is between ``begin`` and ``end``, or later if there is no crossing.
    """
    # Rounding may have left the difference above a threshold at the end of the last frame.
    if difference >= on:
        return begin, 1
    if difference <= -off:
        return begin, -1
    if tau == 0.0:
        if slope > 0.0:
            return begin + (on - difference) / slope, 1
        if slope < 0.0:
            return begin - (off + difference) / slope, -1
        return math.inf, 0
    # The difference has at most one extremum.
    extremum = end
    ratio = slope * tau / swing if swing != 0.0 else 0.0
    if ratio > 0.0:
        extremum = min(max(-tau * math.log(ratio), begin), end)
    for piece in range(2):
        low = begin if piece == 0 else extremum
        high = extremum if piece == 0 else end
        reached = difference + _rise(slope, swing, tau, begin, high)
        if -off < reached < on or high <= low:
            continue
        polarity = 1 if reached >= on else -1
        level = (on if polarity > 0 else -off) - difference
        u = 0.5 * (low + high)
        for _ in range(MAX_STEPS):
            excess = _rise(slope, swing, tau, begin, u) - level
            if excess * polarity >= 0.0:
                high = u
            else:
                low = u
            derivative = slope - swing / tau * math.exp(-u / tau)
            step = u - excess / derivative if derivative != 0.0 else low
            last = u
            u = step if low < step < high else 0.5 * (low + high)
            if u == last or high - low <= 1e-16 * end:
                break
        return u, polarity
    return math.inf, 0


@njit(
    types.int64(
        FLOATS_2D, FLOATS_2D, FLOATS, FLOATS, FLOATS, FLOATS, FLOATS, types.float64, types.float64,
        types.float64, types.float64, types.float64, types.float64, types.uint64, types.uint64, types.int64, types.int64,
        types.float64[:, ::1], _counts, _counts, types.float64[::1], _sites, _bytes,
    ),
)  # fmt: skip
def change_events(
    log_current, current, begins_s, steps_s, on, off, leak_per_s, refractory_s, tau_e, noise_per_s, noise_half,
    sigma, changes_per_s, key_0, key_1, first_site, max_events, memory, n_drawn, ends, t_s, site, polarity,
):  # fmt: skip
    """
    Compute the change events of some sites between the first and the last of some frames.

    ``log_current`` and ``current`` are (n_frame, n_site); frame k is at ``begins_s[k]``, and the next one ``steps_s[k]`` later.
    The log current is interpolated linearly between frames. ``tau_e`` divided by the current is the time constant of the low
    pass; 0 disables it. ``sigma`` is the standard deviation of the contrast noise, which is drawn again at each event and
    ``changes_per_s`` times per second. Returns the number of events, including those that did not fit the arrays.
    """
    n = 0
    for k in range(log_current.shape[0] - 1):
        begin_s, end_s, frame_s = begins_s[k], begins_s[k + 1], steps_s[k]
        after_s = np.nextafter(begin_s, math.inf)
        for i in range(log_current.shape[1]):
            up, down = on[i if on.size > 1 else 0], off[i if off.size > 1 else 0]
            leak = leak_per_s[i if leak_per_s.size > 1 else 0] * up
            if n_drawn[i] == 0:
                n_drawn[i] = 1
                word_0, word_1, _, _ = _random_words(key_0, key_1, first_site + i, 0)
                memory[i, HAZARD] = -math.log(uniform(word_0))
                if leak > 0.0:
                    # The initial phase of the leak is uniformly distributed between two events; early ones are more frequent
                    # with noise, which restarts it.
                    phase = uniform(word_1)
                    n_noise = noise_per_s / (1.0 + current[k, i] / noise_half) * up / leak
                    if n_noise > 0.0:
                        phase = -math.log1p(phase * math.expm1(-n_noise)) / n_noise
                    memory[i, DIFFERENCE] = phase * up
                if sigma > 0.0:
                    words = _random_words(key_0, key_1, first_site + i, 1)
                    memory[i, CONTRAST_NOISE], memory[i, CHANGE_AT] = _contrast_noise(
                        sigma, changes_per_s, begin_s, words[0], words[1], words[2]
                    )
                    n_drawn[i] = 2
            change = log_current[k + 1, i] - log_current[k, i]
            slope = change / frame_s
            total = slope + leak
            n_parts = max(1, math.ceil(abs(change) / MAX_PART_CHANGE)) if tau_e > 0.0 else 1
            part_s, part_change = frame_s / n_parts, change / n_parts
            end_current = current[k, i]
            for part in range(n_parts):
                part_begin_s = part * part_s
                log_level = log_current[k, i] + part * part_change
                begin_current, end_current = end_current, current[k + 1, i]
                if part < n_parts - 1:
                    end_current = current[k, i] * math.exp((part + 1) * part_change)
                # Mean of a current with linear logarithm; with it the low pass decays correctly.
                mean = 0.5 * (begin_current + end_current)
                if abs(part_change) > MIN_CHANGE:
                    mean = (end_current - begin_current) / part_change
                tau = tau_e / mean
                swing = memory[i, LEVEL] - log_level + slope * tau if tau > 0.0 else 0.0
                noise = noise_per_s / (1.0 + mean / noise_half)
                u = min(max(memory[i, REFRACTORY_END] - begin_s - part_begin_s, 0.0), part_s)
                while u < part_s:
                    offset, change_at = 0.0, math.inf
                    if sigma > 0.0:
                        offset = memory[i, CONTRAST_NOISE]
                        change_at = max(memory[i, CHANGE_AT] - begin_s - part_begin_s, u)
                    end = min(change_at, part_s)
                    at, sign = _crossing(total, swing, tau, u, memory[i, DIFFERENCE], up - offset, down + offset, end)
                    noise_at = u + memory[i, HAZARD] / noise if noise > 0.0 else math.inf
                    if change_at <= part_s and at > change_at and noise_at > change_at:
                        memory[i, DIFFERENCE] += _rise(total, swing, tau, u, change_at)
                        memory[i, HAZARD] -= noise * (change_at - u)
                        words = _random_words(key_0, key_1, first_site + i, n_drawn[i])
                        n_drawn[i] += 1
                        memory[i, CONTRAST_NOISE], memory[i, CHANGE_AT] = _contrast_noise(
                            sigma, changes_per_s, begin_s + part_begin_s + change_at, words[0], words[1], words[2]
                        )
                        u = change_at
                        continue
                    if at > part_s and noise_at > part_s:
                        memory[i, DIFFERENCE] += _rise(total, swing, tau, u, part_s)
                        memory[i, HAZARD] -= noise * (part_s - u)
                        break
                    if noise_at < at:
                        word_0, word_1, _, _ = _random_words(key_0, key_1, first_site + i, n_drawn[i])
                        n_drawn[i] += 1
                        memory[i, HAZARD] = -math.log(uniform(word_0))
                        at, sign = noise_at, 1 if word_1 & np.uint64(1) else -1
                    else:
                        memory[i, HAZARD] -= noise * (at - u)
                    at_s = begin_s + (part_begin_s + at)
                    if n < t_s.size:
                        t_s[n], site[n], polarity[n] = min(max(at_s, after_s), end_s), first_site + i, sign
                    n += 1
                    if n > max_events:
                        return n
                    memory[i, DIFFERENCE] = 0.0
                    memory[i, REFRACTORY_END] = at_s + refractory_s
                    if sigma > 0.0:
                        words = _random_words(key_0, key_1, first_site + i, n_drawn[i])
                        n_drawn[i] += 1
                        memory[i, CONTRAST_NOISE], memory[i, CHANGE_AT] = _contrast_noise(
                            sigma, changes_per_s, at_s + refractory_s, words[0], words[1], words[2]
                        )
                    u = at + refractory_s
                if tau > 0.0:
                    # As a rise: in a frame much shorter than tau, slope * tau is much larger than the level.
                    memory[i, LEVEL] += _rise(slope, swing, tau, 0.0, part_s)
        ends[k] = n
    return n


@njit()
def _gamma(shape, key_0, key_1, site, number):
    """
    Draw from a gamma distribution of shape >= 1; return the number and the new draw count.

    G. Marsaglia and W. W. Tsang, A simple method for generating gamma variables (ACM Trans. Math. Softw. 26, 363, 2000).
    """
    d = shape - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    while True:
        word_0, word_1, word_2, _ = _random_words(key_0, key_1, site, number)
        number += 1
        x = math.sqrt(-2.0 * math.log(uniform(word_0))) * math.cos(2.0 * math.pi * uniform(word_1))
        v = (1.0 + c * x) ** 3
        if v > 0.0 and math.log(uniform(word_2)) < 0.5 * x * x + d - d * v + d * math.log(v):
            return d * v, number


@njit(
    types.int64(
        FLOATS_2D, FLOATS, FLOATS, FLOATS, types.float64, types.boolean, types.uint64, types.uint64, types.int64,
        types.int64, types.float64[:, ::1], _counts, _counts, types.float64[::1], _sites, _bytes,
    ),
)  # fmt: skip
def charge_spikes(
    current, begins_s, steps_s, threshold_e, refractory_s, is_noisy, key_0, key_1, first_site,
    max_events, memory, n_drawn, ends, t_s, site, polarity,
):  # fmt: skip
    """
    Compute the spikes of some sites during some frames.

    ``current`` is (n_frame, n_site) and constant during each frame, which begins at ``begins_s[k]`` and lasts ``steps_s[k]``.
    With noise, electrons arrive as a Poisson process, and the time to a threshold of N electrons follows the gamma distribution
    of shape N. Returns the number of spikes, including those that did not fit the arrays.
    """
    n = 0
    for k in range(current.shape[0]):
        begin_s, frame_s = begins_s[k], steps_s[k]
        last_s = np.nextafter(begins_s[k + 1], -math.inf)
        for i in range(current.shape[1]):
            rate, threshold = current[k, i], threshold_e[i if threshold_e.size > 1 else 0]
            u = min(max(memory[i, REFRACTORY_END] - begin_s, 0.0), frame_s)
            while u < frame_s:
                if n_drawn[i] == 0:
                    n_drawn[i] = 1
                    memory[i, MISSING] = threshold
                    if is_noisy:
                        memory[i, MISSING], n_drawn[i] = _gamma(threshold, key_0, key_1, first_site + i, n_drawn[i])
                # A negative missing charge is due to rounding: it was complete at the end of the last frame.
                at = u + max(memory[i, MISSING], 0.0) / rate if rate > 0.0 else math.inf
                if at >= frame_s:
                    memory[i, MISSING] -= rate * (frame_s - u)
                    break
                if n < t_s.size:
                    t_s[n], site[n], polarity[n] = min(begin_s + at, last_s), first_site + i, 1
                n += 1
                if n > max_events:
                    return n
                memory[i, MISSING] = threshold
                if is_noisy:
                    memory[i, MISSING], n_drawn[i] = _gamma(threshold, key_0, key_1, first_site + i, n_drawn[i])
                memory[i, REFRACTORY_END] = begin_s + at + refractory_s
                u = at + refractory_s
        ends[k] = n
    return n
