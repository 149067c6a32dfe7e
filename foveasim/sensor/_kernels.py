"""
The sensor's numba kernels: numbers of a device by place, shot noise, and the way from charge to code.

They know arrays only, release the interpreter lock, and are compiled for explicit types when this module is
imported; the machine code is cached on disk. What is one number for all sites, or one a site, is an array of the size 1
or n.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

__all__ = ["ADC_LINEAR", "ADC_LOG", "ADC_ROOT", "ADC_TABLE", "device_uniforms", "poisson_or_gaussian", "read_out"]

#: Ways of a converter from a share of the range to a share of the codes.
ADC_LINEAR, ADC_ROOT, ADC_LOG, ADC_TABLE = range(4)
#: A charge this share of a code below a code's border is on it: the rounding of a division.
CODE_ROUNDING = 1e-9
#: Variance that rounding to whole electrons adds; taken off the Gaussian's, so that the sum is Poisson's.
ROUNDING_VARIANCE = 1.0 / 12.0
#: No charge is larger: 2**62 fits int64 with room for sums.
LARGEST_CHARGE_E = 2.0**62
#: One draw of a Poisson law is at most so many of its standard deviations, and so many electrons more, above its mean.
FAR_SIGMAS, FAR_ELECTRONS = 12.0, 40

_floats = types.Array(types.float64, 1, "C", readonly=True)
_ints = types.Array(types.int64, 1, "C", readonly=True)
_words = types.Array(types.uint64, 1, "C", readonly=True)

#: Philox 4x64: multipliers and Weyl steps.
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_M, _W = np.uint64(0xD256D193), np.uint64(0x9E3779B9)
_LOW, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_11 = np.uint64(11)
_ONE_IN_2_53, _ONE_IN_2_32 = 2.0**-53, 2.0**-32


@njit(cache=True, nogil=True, inline="always")
def _high_word(a, b):
    """Upper half of the product of two 64-bit numbers."""
    a_low, a_high, b_low, b_high = a & _LOW, a >> _32, b & _LOW, b >> _32
    middle = a_high * b_low + ((a_low * b_low) >> _32)
    low = (middle & _LOW) + a_low * b_high
    return a_high * b_high + (middle >> _32) + (low >> _32)


@njit(cache=True, nogil=True)
def _philox(key_0, key_1, c0, c1, c2, c3):
    """
    Four random words of a counter and a key: Philox 4x64 with ten rounds.

    J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, Parallel random numbers: as easy as 1, 2, 3 (SC11), section 3.3.
    """
    for _ in range(10):
        high_0, low_0 = _high_word(_M0, c0), _M0 * c0
        high_1, low_1 = _high_word(_M1, c2), _M1 * c2
        c0, c1, c2, c3 = high_1 ^ c1 ^ key_0, low_1, high_0 ^ c3 ^ key_1, low_0
        key_0 += _W0
        key_1 += _W1
    return c0, c1, c2, c3


@njit(cache=True, nogil=True, inline="always")
def _philox_2x32(key, c0, c1):
    """Two random words of 32 bits, in 64-bit numbers: Philox 2x32 with ten rounds (as above), at a fifth of the cost."""
    for _ in range(10):
        product = _M * c0
        c0, c1 = (product >> _32) ^ key ^ c1, product & _LOW
        key = (key + _W) & _LOW
    return c0, c1


@njit(cache=True, nogil=True, inline="always")
def _uniform(word):
    """Number between 0 and 1, neither of them."""
    return (np.float64(word >> _11) + 0.5) * _ONE_IN_2_53


@njit(types.float64[::1](types.uint64, types.uint64, _words, _words), cache=True, nogil=True)
def device_uniforms(key_0, key_1, first, second):
    """A number between 0 and 1 for every pair of words: always the same for the same key and pair."""
    out = np.empty(first.size, np.float64)
    for i in range(first.size):
        word, _, _, _ = _philox(key_0, key_1, first[i], second[i], np.uint64(0), np.uint64(0))
        out[i] = _uniform(word)
    return out


@njit(cache=True, nogil=True, inline="always")
def _poisson(mean, z):
    """Poisson's law at the probability of a Gaussian number: the same number gives more where more is expected."""
    share = 0.5 * math.erfc(-z * math.sqrt(0.5))
    chance = math.exp(-mean)
    reached = chance
    n = 0
    last = int(mean + FAR_SIGMAS * math.sqrt(mean)) + FAR_ELECTRONS
    while share > reached and n < last:
        n += 1
        chance *= mean / n
        reached += chance
    return n


@njit(types.void(_floats, _floats, types.float64, types.int64[::1]), cache=True, nogil=True)
def poisson_or_gaussian(expected_e, z, gaussian_above_e, electrons):
    """Draws of Poisson's law up to a mean, and above it of the Gaussian of its mean and variance, rounded."""
    for i in range(expected_e.size):
        mean = expected_e[i]
        if mean <= gaussian_above_e:
            electrons[i] = _poisson(mean, z[i])
        else:
            charge = mean + math.sqrt(mean - ROUNDING_VARIANCE) * z[i]
            electrons[i] = int(np.rint(min(max(charge, 0.0), LARGEST_CHARGE_E)))


@njit(cache=True, nogil=True, inline="always")
def _at(values, i):
    return values[i] if values.size > 1 else values[0]


@njit(cache=True, nogil=True, inline="always")
def _converted(share, way, strength, table):
    """Share of the codes for a share of the range."""
    if way == ADC_ROOT:
        return math.sqrt(share)
    if way == ADC_LOG:
        return math.log1p(strength * share) / math.log1p(strength)
    if way == ADC_TABLE:
        place = share * (table.size - 1)
        k = min(int(place), table.size - 2)
        return table[k] + (place - k) * (table[k + 1] - table[k])
    return share


@njit(
    [
        types.void(
            _floats,
            _floats,
            _floats,
            _floats,
            _floats,
            _ints,
            types.float64,
            types.float64,
            types.int64,
            types.float64,
            _floats,
            types.int64,
            _floats,
            types.float64,
            types.uint64,
            _floats,
            code[::1],
        )
        for code in (types.uint8, types.uint16)
    ],
    cache=True,
    nogil=True,
)
def read_out(
    charge_e,
    v_per_e,
    offset_v,
    line_offset_v,
    gain,
    line,
    v_sat_v,
    bend,
    way,
    strength,
    table,
    n_codes,
    inl,
    dnl,
    dnl_key,
    quantiles,
    code,
):
    """
    Codes of charges: volts, bend, offsets of site and line, clip, conversion with its faults.

    ``bend`` is the share that the response lacks at full range. ``inl`` holds deviations in codes at equal steps of the
    codes (size 1: none); ``dnl`` is the standard deviation, in codes, of a number that each line adds before each code, a
    Gaussian by its ``quantiles``.
    """
    for i in range(charge_e.size):
        v = charge_e[i] * _at(v_per_e, i) * _at(gain, i)
        v *= 1.0 - bend * min(max(v / v_sat_v, 0.0), 1.0)
        v += _at(offset_v, i) + (line_offset_v[line[i]] if line_offset_v.size > 1 else line_offset_v[0])
        share = min(max(v / v_sat_v, 0.0), 1.0)
        value = _converted(share, way, strength, table) * n_codes
        if inl.size > 1:
            place = min(value / n_codes, 1.0) * (inl.size - 1)
            k = min(int(place), inl.size - 2)
            value += inl[k] + (place - k) * (inl[k + 1] - inl[k])
        step = min(max(math.floor(value + CODE_ROUNDING), 0.0), n_codes - 1.0)
        if dnl > 0.0:
            word, _ = _philox_2x32(dnl_key, np.uint64(line[i]) & _LOW, np.uint64(step))
            place = np.float64(word) * (_ONE_IN_2_32 * (quantiles.size - 1))
            k = int(place)
            z = quantiles[k] + (place - k) * (quantiles[k + 1] - quantiles[k])
            step = min(max(math.floor(value + dnl * z + CODE_ROUNDING), 0.0), n_codes - 1.0)
        code[i] = int(step)
