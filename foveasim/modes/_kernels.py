"""
Numba kernels of asynchronous photosites: events of changes of log light, and spikes of collected charge.

They know arrays only, release the interpreter lock, and are compiled for explicit types when this module is imported. Each
takes some sites through some frames, one frame after the other, and changes what it remembers of every site. Events go to
arrays in that order; where these are full, events are only counted, so that the caller can begin anew with longer ones.

Random numbers hang on the key, the site and how many the site drew before: not on how frames come in batches.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from foveasim.sensor._kernels import _philox, _uniform

__all__ = ["DIFFERENCE", "HAZARD", "HELD", "LEVEL", "MISSING", "change_events", "charge_spikes"]

#: What is remembered of a site that tells changes: the level behind the low pass, how far it is from the last event's, until
#: when the site is held, and the noise that is still to come before an event of it.
LEVEL, DIFFERENCE, HELD, HAZARD = range(4)
#: Of a site that collects charge: what is missing to the next spike, and HELD.
MISSING = 0
#: Steps that find a crossing to its last bits, where Newton's are kept within brackets.
STEPS = 80

_bytes, _sites = types.int8[::1], types.int32[::1]
_row = types.Array(types.float64, 1, "C", readonly=True)
_rows = types.Array(types.float64, 2, "C", readonly=True)


@njit(cache=True, nogil=True, inline="always")
def _words(key_0, key_1, site, number):
    return _philox(key_0, key_1, np.uint64(site), np.uint64(number), np.uint64(0), np.uint64(0))


@njit(cache=True, nogil=True)
def _risen(slope, swing, tau, begin, end):
    """Rise of ``slope * u + swing * exp(-u / tau)`` from one time to another; without swing where tau is 0."""
    rise = slope * (end - begin)
    if tau > 0.0:
        rise += swing * math.exp(-begin / tau) * math.expm1(-(end - begin) / tau)
    return rise


@njit(cache=True, nogil=True)
def _crossing(slope, swing, tau, begin, difference, on, off, end):
    """First time from ``begin`` to ``end`` at which the difference reaches ``on`` or ``-off``, and which; beyond it if none."""
    if tau == 0.0:
        if slope > 0.0:
            return begin + (on - difference) / slope, 1
        if slope < 0.0:
            return begin - (off + difference) / slope, -1
        return math.inf, 0
    # Where it turns, at most once.
    turn = end
    ratio = slope * tau / swing if swing != 0.0 else 0.0
    if ratio > 0.0:
        turn = min(max(-tau * math.log(ratio), begin), end)
    for piece in range(2):
        low = begin if piece == 0 else turn
        high = turn if piece == 0 else end
        reached = difference + _risen(slope, swing, tau, begin, high)
        if -off < reached < on or high <= low:
            continue
        polarity = 1 if reached >= on else -1
        level = (on if polarity > 0 else -off) - difference
        u = 0.5 * (low + high)
        for _ in range(STEPS):
            excess = _risen(slope, swing, tau, begin, u) - level
            if excess * polarity >= 0.0:
                high = u
            else:
                low = u
            bend = slope - swing / tau * math.exp(-u / tau)
            step = u - excess / bend if bend != 0.0 else low
            last = u
            u = step if low < step < high else 0.5 * (low + high)
            if u == last or high - low <= 1e-16 * end:
                break
        return u, polarity
    return math.inf, 0


@njit(
    types.int64(
        _rows, _rows, types.float64, types.int64, _row, _row, types.float64, types.float64, types.float64,
        types.float64, types.float64, types.uint64, types.uint64, types.int64,
        types.float64[:, ::1], types.int64[::1], types.float64[::1], _sites, _bytes,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def change_events(
    log_light, current, frame_s, first_frame, on, off, refractory_s, leak_per_s, tau_e, noise_per_s, noise_half,
    key_0, key_1, first_site, memory, n_drawn, t_s, site, polarity,
):  # fmt: skip
    """
    Events of some sites from the first to the last of some frames; how many, written or not.

    ``log_light`` and ``current`` are (n_frame, n_site); frame k is that of ``(first_frame + k) * frame_s``. Between frames the
    logarithm of the light is a straight line. ``tau_e`` over the current is the time constant of the low pass, 0 for none.
    """
    n = 0
    for k in range(log_light.shape[0] - 1):
        begin_s = (first_frame + k) * frame_s
        for i in range(log_light.shape[1]):
            mean = 0.5 * (current[k, i] + current[k + 1, i])
            slope = (log_light[k + 1, i] - log_light[k, i]) / frame_s
            tau = tau_e / mean
            swing = 0.0
            if tau > 0.0:
                swing = memory[i, LEVEL] - log_light[k, i] + slope * tau
            up, down = on[i if on.size > 1 else 0], off[i if off.size > 1 else 0]
            total = slope + leak_per_s * up
            noise = noise_per_s / (1.0 + mean / noise_half)
            u = min(max(memory[i, HELD] - begin_s, 0.0), frame_s)
            if noise > 0.0 and n_drawn[i] == 0:
                n_drawn[i] = 1
                memory[i, HAZARD] = -math.log(_uniform(_words(key_0, key_1, first_site + i, 0)[0]))
            while u < frame_s:
                at, sign = _crossing(total, swing, tau, u, memory[i, DIFFERENCE], up, down, frame_s)
                noise_at = u + memory[i, HAZARD] / noise if noise > 0.0 else math.inf
                if at > frame_s and noise_at > frame_s:
                    memory[i, DIFFERENCE] += _risen(total, swing, tau, u, frame_s)
                    memory[i, HAZARD] -= noise * (frame_s - u)
                    break
                if noise_at < at:
                    word_0, word_1, _, _ = _words(key_0, key_1, first_site + i, n_drawn[i])
                    n_drawn[i] += 1
                    memory[i, HAZARD] = -math.log(_uniform(word_0))
                    at, sign = noise_at, 1 if word_1 & np.uint64(1) else -1
                else:
                    memory[i, HAZARD] -= noise * (at - u)
                if n < t_s.size:
                    t_s[n], site[n], polarity[n] = begin_s + at, first_site + i, sign
                n += 1
                memory[i, DIFFERENCE] = 0.0
                memory[i, HELD] = begin_s + at + refractory_s
                u = at + refractory_s
            if tau > 0.0:
                memory[i, LEVEL] = log_light[k + 1, i] - slope * tau + swing * math.exp(-frame_s / tau)
    return n


@njit(cache=True, nogil=True)
def _gamma(shape, key_0, key_1, site, number):
    """
    Draw of the gamma law of a shape of at least 1, and how many numbers were drawn then.

    G. Marsaglia and W. W. Tsang, A simple method for generating gamma variables (ACM Trans. Math. Softw. 26, 363, 2000).
    """
    d = shape - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    while True:
        word_0, word_1, word_2, _ = _words(key_0, key_1, site, number)
        number += 1
        x = math.sqrt(-2.0 * math.log(_uniform(word_0))) * math.cos(2.0 * math.pi * _uniform(word_1))
        v = (1.0 + c * x) ** 3
        if v > 0.0 and math.log(_uniform(word_2)) < 0.5 * x * x + d - d * v + d * math.log(v):
            return d * v, number


@njit(
    types.int64(
        _rows, types.float64, types.int64, _row, types.float64, types.boolean, types.uint64, types.uint64, types.int64,
        types.float64[:, ::1], types.int64[::1], types.float64[::1], _sites,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def charge_spikes(
    current,
    frame_s,
    first_frame,
    threshold_e,
    refractory_s,
    is_noisy,
    key_0,
    key_1,
    first_site,
    memory,
    n_drawn,
    t_s,
    site,
):
    """
    Spikes of some sites during some frames; how many, written or not.

    ``current`` is (n_frame, n_site), and stays from each frame to the next. With noise, a charge comes electron by electron,
    and the time to a threshold of N of them follows the gamma law of the shape N.
    """
    n = 0
    for k in range(current.shape[0]):
        begin_s = (first_frame + k) * frame_s
        for i in range(current.shape[1]):
            rate, threshold = current[k, i], threshold_e[i if threshold_e.size > 1 else 0]
            u = min(max(memory[i, HELD] - begin_s, 0.0), frame_s)
            while u < frame_s:
                if n_drawn[i] == 0:
                    n_drawn[i] = 1
                    memory[i, MISSING] = threshold
                    if is_noisy:
                        memory[i, MISSING], n_drawn[i] = _gamma(threshold, key_0, key_1, first_site + i, n_drawn[i])
                at = u + memory[i, MISSING] / rate if rate > 0.0 else math.inf
                if at >= frame_s:
                    memory[i, MISSING] -= rate * (frame_s - u)
                    break
                if n < t_s.size:
                    t_s[n], site[n] = begin_s + at, first_site + i
                n += 1
                memory[i, MISSING] = threshold
                if is_noisy:
                    memory[i, MISSING], n_drawn[i] = _gamma(threshold, key_0, key_1, first_site + i, n_drawn[i])
                memory[i, HELD] = begin_s + at + refractory_s
                u = at + refractory_s
    return n
