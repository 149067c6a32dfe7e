"""
Numba kernels that decode the words of event cameras.

Both kernels count events when the output arrays are too short, so that the caller can repeat the call with arrays of this
length. Results: number of events, number of events before the first time, number of trigger words, number of words of vendors,
index of the first wrong word, or -1, and whether its time falls; otherwise its type is unknown.
"""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import array_of

_times, _addresses, _flags = types.int64[::1], types.uint16[::1], types.boolean[::1]
_result = types.UniTuple(types.int64, 6)
#: A time that falls by more than half of its range has begun anew.
HALF = 2


@njit(_result(array_of(types.uint32), array_of(types.uint32), _times, _addresses, _addresses, _flags))
def decode_evt2(words, valid, t_us, x, y, is_on):
    """
    Decode EVT 2.0, or 2.1 with masks of 32 pixels.

    ``words`` (n,) uint32; ``valid`` (n,) uint32 for EVT 2.1, (0,) for EVT 2.0.
    """
    n = n_before = n_triggers = n_vendor = 0
    capacity, is_vector = t_us.size, valid.size > 0
    high = np.int64(-1)
    loops = np.int64(0)
    for k in range(words.size):
        word = words[k]
        kind = word >> np.uint32(28)
        if kind <= 1:
            base = np.int64((word >> np.uint32(11)) & np.uint32(0x7FF))
            row = word & np.uint32(0x7FF)
            time = (high << 6) | np.int64((word >> np.uint32(22)) & np.uint32(0x3F))
            mask = valid[k] if is_vector else np.uint32(1)
            bit = 0
            while mask:
                if mask & np.uint32(1):
                    if high < 0:
                        n_before += 1
                    else:
                        if n < capacity:
                            t_us[n] = time + loops
                            x[n], y[n], is_on[n] = base + bit, row, kind == 1
                        n += 1
                mask >>= np.uint32(1)
                bit += 1
        elif kind == 8:
            new = np.int64(word & np.uint32(0xFFFFFFF))
            if new < high:
                if high - new <= (1 << 28) // HALF:
                    return n, n_before, n_triggers, n_vendor, k, 1
                loops += 1 << 34
            high = new
        elif kind == 0xA:
            n_triggers += 1
        elif kind in (0xE, 0xF):
            n_vendor += 1
        else:
            return n, n_before, n_triggers, n_vendor, k, 0
    return n, n_before, n_triggers, n_vendor, -1, 0


@njit(_result(array_of(types.uint16), _times, _addresses, _addresses, _flags))
def decode_evt3(words, t_us, x, y, is_on):
    """Decode EVT 3.0: ``words`` (n,) uint16."""
    n = n_before = n_triggers = n_vendor = 0
    capacity = t_us.size
    high, low, loops = np.int64(-1), np.int64(0), np.int64(0)
    row = base = np.int64(0)
    is_base_on = False
    for k in range(words.size):
        word = np.int64(words[k])
        kind, payload = word >> 12, word & 0xFFF
        if kind in (0x2, 0x4, 0x5):
            if kind == 0x2:
                mask, step, first, is_event_on = 1, 0, payload & 0x7FF, payload >> 11 == 1
            elif kind == 0x4:
                mask, step, first, is_event_on = payload, 12, base, is_base_on
            else:
                mask, step, first, is_event_on = payload & 0xFF, 8, base, is_base_on
            base += step
            while mask:
                if mask & 1:
                    if high < 0:
                        n_before += 1
                    else:
                        if n < capacity:
                            t_us[n] = loops + (high << 12) + low
                            x[n], y[n], is_on[n] = first, row, is_event_on
                        n += 1
                mask >>= 1
                first += 1
        elif kind == 0x0:
            row = payload & 0x7FF
        elif kind == 0x3:
            base, is_base_on = payload & 0x7FF, payload >> 11 == 1
        elif kind == 0x6:
            if payload < low and high >= 0:
                # Some programs write no high bits when the low ones begin anew.
                if low - payload <= (1 << 12) // HALF:
                    return n, n_before, n_triggers, n_vendor, k, 1
                high += 1
                if high == 1 << 12:
                    high, loops = 0, loops + (1 << 24)
            low = payload
        elif kind == 0x8:
            if payload != high:
                if payload < high:
                    if high - payload <= (1 << 12) // HALF:
                        return n, n_before, n_triggers, n_vendor, k, 1
                    loops += 1 << 24
                high, low = payload, 0  # the low bits follow
        elif kind == 0xA:
            n_triggers += 1
        elif kind in (0x7, 0xE, 0xF):
            n_vendor += 1
        else:
            return n, n_before, n_triggers, n_vendor, k, 0
    return n, n_before, n_triggers, n_vendor, -1, 0
