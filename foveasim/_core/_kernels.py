"""
Counter-based random numbers: Philox generators, and Gaussian numbers from their words.

A Philox generator maps a counter and a key to random words: J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, Parallel
random numbers: as easy as 1, 2, 3 (SC11), section 3.3. All generators use ten rounds. Words of 32 bits are stored in 64-bit
integers.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core.jit import njit

__all__ = ["philox_2x32", "philox_4x32", "philox_4x64", "standard_normal", "uniform"]

#: Multipliers and Weyl increments of Philox 4x64.
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
#: Multipliers and Weyl increments of Philox 4x32 and 2x32.
_M0_32, _M1_32 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0_32, _W1_32 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_M_32 = np.uint64(0xD256D193)
_LOW, _32, _11 = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(11)
_ONE_IN_2_53, _ONE_IN_2_32, _ONE_IN_2_64, _2_31 = 2.0**-53, 2.0**-32, 2.0**-64, 2.0**31
#: Pairs of Gaussian numbers per block: the buffers of a block fit in the L1 cache.
BLOCK_PAIRS = 512
#: Lowest bit of the exponent of a float64; bit patterns of 1.0 and sqrt(1/2); mask of the mantissa.
_EXPONENT = 52
_ONE = np.float64(1.0).view(np.int64)
_SQRT_HALF = np.float64(math.sqrt(0.5)).view(np.int64)
_MANTISSA = np.int64((1 << _EXPONENT) - 1)
_BIAS = 1023
_LN_2 = math.log(2.0)
_HALF_PI_IN_2_32 = 0.5 * math.pi * _ONE_IN_2_32
#: Taylor series of sine and cosine, error 2e-14 up to pi / 4, and of 2 artanh, error 1e-14 up to 0.172.
_S3, _S5, _S7, _S9, _S11, _S13 = ((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 7))
_C2, _C4, _C6, _C8, _C10, _C12, _C14 = ((-1.0) ** k / math.factorial(2 * k) for k in range(1, 8))
_L1, _L3, _L5, _L7, _L9, _L11, _L13, _L15, _L17 = (2.0 / k for k in range(1, 18, 2))


@njit(inline="always")
def _high_word(a, b):
    """Return the upper 64 bits of the product of two 64-bit integers."""
    a_low, a_high, b_low, b_high = a & _LOW, a >> _32, b & _LOW, b >> _32
    cross = a_high * b_low + ((a_low * b_low) >> _32)
    low = (cross & _LOW) + a_low * b_high
    return a_high * b_high + (cross >> _32) + (low >> _32)


@njit()
def philox_4x64(key_0, key_1, c0, c1, c2, c3):
    """Return four random words of 64 bits."""
    for _ in range(10):
        high_0, low_0 = _high_word(_M0, c0), _M0 * c0
        high_1, low_1 = _high_word(_M1, c2), _M1 * c2
        c0, c1, c2, c3 = high_1 ^ c1 ^ key_0, low_1, high_0 ^ c3 ^ key_1, low_0
        key_0 += _W0
        key_1 += _W1
    return c0, c1, c2, c3


@njit(inline="always")
def philox_4x32(key_0, key_1, c0, c1, c2, c3):
    """
    Return four random words of 32 bits.

    The compiler vectorises a loop over counters.
    """
    for _ in range(10):
        first, second = _M0_32 * c0, _M1_32 * c2
        c0, c1, c2, c3 = (second >> _32) ^ c1 ^ key_0, second & _LOW, (first >> _32) ^ c3 ^ key_1, first & _LOW
        key_0 = (key_0 + _W0_32) & _LOW
        key_1 = (key_1 + _W1_32) & _LOW
    return c0, c1, c2, c3


@njit(inline="always")
def philox_2x32(key, c0, c1):
    """
    Return two random words of 32 bits, at a fifth of the cost of Philox 4x64.

    The compiler vectorises a loop over counters.
    """
    for _ in range(10):
        product = _M_32 * c0
        c0, c1 = (product >> _32) ^ key ^ c1, product & _LOW
        key = (key + _W0_32) & _LOW
    return c0, c1


@njit(inline="always")
def uniform(word):
    """Convert a word of 64 bits to a number in the open interval (0, 1)."""
    return (np.float64(word >> _11) + 0.5) * _ONE_IN_2_53


@njit(types.void(types.uint64, types.float64[::1]), error_model="numpy")
def standard_normal(key, out):
    """
    Fill an array with standard Gaussian numbers.

    Number ``i`` depends only on the key and ``i``. Counter ``i // 2`` of Philox 4x32 gives a pair of numbers by the method of
    G. E. P. Box and M. E. Muller, A note on the generation of random normal deviates (Ann. Math. Statist. 29, 1958): the radius
    is ``sqrt(-2 ln u)`` with u from 64 bits, the angle is in the first quadrant, and two bits give the signs.

    Notes
    -----
    With the angle ``pi/4 + a`` and ``r = sqrt(-ln u)``, the pair is ``r (cos a + sin a)`` and ``r (cos a - sin a)``: ``a`` is
    at most pi/4, so sine and cosine need no range reduction. Logarithm, sine and cosine are evaluated by sums and products in a
    fixed order: the compiler vectorises them, and results are bit-identical on every machine.
    """
    u, angle, signs = np.empty(BLOCK_PAIRS), np.empty(BLOCK_PAIRS), np.empty(BLOCK_PAIRS, np.int32)
    mantissa, exponent = np.empty(BLOCK_PAIRS), np.empty(BLOCK_PAIRS)
    u_bits, mantissa_bits = u.view(np.int64), mantissa.view(np.int64)
    key_0, key_1, zero = key & _LOW, key >> _32, np.uint64(0)
    n_pairs = (out.size + 1) // 2
    for first in range(0, n_pairs, BLOCK_PAIRS):
        n = min(BLOCK_PAIRS, n_pairs - first)
        for j in range(n):
            counter = np.uint64(first + j)
            a, b, c, d = philox_4x32(key_0, key_1, counter & _LOW, counter >> _32, zero, zero)
            # One vector instruction converts signed 32-bit integers to floating-point numbers.
            low = (np.float64(np.int32(b)) + (_2_31 + 0.5)) * _ONE_IN_2_64
            u[j] = (np.float64(np.int32(a)) + _2_31) * _ONE_IN_2_32 + low
            angle[j] = (np.float64(np.int32(c)) + 0.5) * _HALF_PI_IN_2_32
            signs[j] = np.int32(d)
        for j in range(n):
            bits = u_bits[j] + (_ONE - _SQRT_HALF)
            exponent[j] = np.float64(np.int32(bits >> _EXPONENT) - _BIAS)
            mantissa_bits[j] = (bits & _MANTISSA) + _SQRT_HALF
        for j in range(n):
            # ln m = 2 artanh y, with the mantissa m between sqrt(1/2) and sqrt(2).
            y = (mantissa[j] - 1.0) / (mantissa[j] + 1.0)
            z = y * y
            log = _L9 + z * (_L11 + z * (_L13 + z * (_L15 + z * _L17)))
            log = y * (_L1 + z * (_L3 + z * (_L5 + z * (_L7 + z * log))))
            radius = math.sqrt(-(exponent[j] * _LN_2 + log))
            z = angle[j] * angle[j]
            sine = angle[j] * (1.0 + z * (_S3 + z * (_S5 + z * (_S7 + z * (_S9 + z * (_S11 + z * _S13))))))
            cosine = 1.0 + z * (_C2 + z * (_C4 + z * (_C6 + z * (_C8 + z * (_C10 + z * (_C12 + z * _C14))))))
            u[j] = math.copysign(radius * (cosine + sine), np.float64(signs[j]))
            angle[j] = math.copysign(radius * (cosine - sine), np.float64(np.int32(signs[j] << 1)))
        begin = 2 * first
        n_complete = min(n, (out.size - begin) // 2)
        for j in range(n_complete):
            out[begin + 2 * j] = u[j]
            out[begin + 2 * j + 1] = angle[j]
        if n_complete < n:
            out[begin + 2 * n_complete] = u[n_complete]
