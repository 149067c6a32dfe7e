"""
Counter-based random numbers, moments of outlines, and positions of points in them.

A Philox generator maps a counter and a key to random words: J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, Parallel
random numbers: as easy as 1, 2, 3 (SC11), section 3.3. All generators use ten rounds. Words of 32 bits are stored in 64-bit
integers.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, INTS

#: Multipliers and Weyl increments of Philox 4x64.
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
#: Multipliers and Weyl increments of Philox 4x32 and 2x32.
_M0_32, _M1_32 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0_32, _W1_32 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_M_32 = np.uint64(0xD256D193)
_LOW, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_12, _ONE_IN_2_52 = np.uint64(12), 2.0**-52
#: Number of random numbers that are computed at a time: their buffers fit in the L1 cache.
BATCH = 1024
#: Moments of an area: 1, x, y, x², xy, y².
N_MOMENTS = 6
_SIXTH, _TWELFTH = 1.0 / 6.0, 1.0 / 12.0
_QUARTER, _HALF = BATCH // 4, BATCH // 2
#: Last words of the counters, so that Gaussian and uniform numbers of a key are independent.
_NORMALS, _UNIFORMS = np.uint64(0), np.uint64(1)
#: Lowest bit of the exponent of a float32; bit patterns of 1.0 and sqrt(1/2); mask of the mantissa.
_EXPONENT, _BIAS = np.int32(23), np.int32(127)
_ONE = np.float32(1.0).view(np.int32)
_SQRT_HALF = np.float32(math.sqrt(0.5)).view(np.int32)
_MANTISSA = np.int32((1 << 23) - 1)
_LN_2, _ONE_IN_2_32, _ONE_IN_2_33 = np.float32(math.log(2.0)), np.float32(2.0**-32), np.float32(2.0**-33)
_QUARTER_PI_IN_2_31 = np.float32(0.25 * math.pi * 2.0**-31)
_1 = np.float32(1.0)
#: Taylor series of sine and cosine up to pi / 4, and of 2 artanh up to 0.172: errors below the resolution of float32.
_S3, _S5, _S7, _S9 = (np.float32((-1.0) ** k / math.factorial(2 * k + 1)) for k in range(1, 5))
_C2, _C4, _C6, _C8, _C10 = (np.float32((-1.0) ** k / math.factorial(2 * k)) for k in range(1, 6))
_L1, _L3, _L5, _L7, _L9 = (np.float32(2.0 / k) for k in range(1, 10, 2))


@njit()
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


@njit()
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


@njit()
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


@njit()
def uniform(word):
    """
    Convert a word of 64 bits to a number in the open interval (0, 1).

    Numbers are odd multiples of 2**-53, from 2**-53 to 1 - 2**-53, and symmetric: words that are complements give ``u`` and
    ``1 - u``. Of 53 bits, float64 would round the half away: the largest word would give 1.
    """
    return (np.float64(word >> _12) + 0.5) * _ONE_IN_2_52


@njit(types.void(types.uint64, types.int64, types.uint32[::1], types.float32[::1]))
def fill_normals(key, batch, words, out):
    """
    Compute a batch of standard Gaussian numbers.

    Number ``i`` of batch ``b`` depends only on the key, ``b`` and ``i``. ``words``, a buffer, and ``out`` have size ``BATCH``.
    Each counter of Philox 4x32 gives two pairs of numbers by the method of G. E. P. Box and M. E. Muller, A note on the
    generation of random normal deviates (Ann. Math. Statist. 29, 1958): the radius is ``sqrt(-2 ln u)`` with u from one word,
    so that numbers are below 6.8. Of a second word, 30 bits are the angle in the first quadrant, and two bits the signs.

    With the angle ``pi/4 + a`` and ``r = sqrt(-ln u)``, the pair is ``r (cos a + sin a)`` and ``r (cos a - sin a)``: ``a`` is
    at most pi/4, so sine and cosine need no range reduction. Logarithm, sine and cosine are evaluated by sums and products in a
    fixed order: the compiler vectorises them, and results are bit-identical on every machine.
    """
    key_0, key_1, zero = key & _LOW, key >> _32, np.uint64(0)
    first = np.uint64(batch * _QUARTER)
    w0, w1, w2, w3 = words[:_QUARTER], words[_QUARTER:_HALF], words[_HALF : 3 * _QUARTER], words[3 * _QUARTER :]
    for j in range(_QUARTER):
        counter = first + np.uint64(j)
        a, b, c, d = philox_4x32(key_0, key_1, counter & _LOW, counter >> _32, zero, _NORMALS)
        w0[j], w1[j], w2[j], w3[j] = np.uint32(a), np.uint32(b), np.uint32(c), np.uint32(d)
    # The first half of the words gives radii, the second half angles and signs.
    x, y, angles = out[:_HALF], out[_HALF:], words[_HALF:]
    for j in range(_HALF):
        x[j] = np.float32(words[j]) * _ONE_IN_2_32 + _ONE_IN_2_33
    for j in range(_HALF):
        bits = np.int32(np.float32(x[j]).view(np.int32) + (_ONE - _SQRT_HALF))
        y[j] = np.float32(np.int32((bits >> _EXPONENT) - _BIAS))
        x[j] = np.int32((bits & _MANTISSA) + _SQRT_HALF).view(np.float32)
    for j in range(_HALF):
        # ln m = 2 artanh t, with the mantissa m between sqrt(1/2) and sqrt(2).
        t = (x[j] - _1) / (x[j] + _1)
        z = t * t
        radius = np.sqrt(-(y[j] * _LN_2 + t * (_L1 + z * (_L3 + z * (_L5 + z * (_L7 + z * _L9))))))
        word = np.int32(angles[j])
        angle = np.float32(np.int32(word << np.int32(2))) * _QUARTER_PI_IN_2_31
        z = angle * angle
        sine = angle * (_1 + z * (_S3 + z * (_S5 + z * (_S7 + z * _S9))))
        cosine = _1 + z * (_C2 + z * (_C4 + z * (_C6 + z * (_C8 + z * _C10))))
        x[j] = np.copysign(radius * (cosine + sine), np.float32(word))
        y[j] = np.copysign(radius * (cosine - sine), np.float32(np.int32(word << np.int32(1))))


@njit(types.void(types.uint64, types.int64, types.float64[::1], types.float64[::1]))
def fill_uniforms(key, batch, first, second):
    """
    Compute a batch of pairs of uniform numbers in the open interval (0, 1).

    See :func:`uniform`. Pair ``i`` of batch ``b`` depends only on the key, ``b`` and ``i``: one counter of Philox 4x32. The
    arrays have size ``BATCH``.
    """
    key_0, key_1, zero = key & _LOW, key >> _32, np.uint64(0)
    for j in range(BATCH):
        counter = np.uint64(batch * BATCH + j)
        a, b, c, d = philox_4x32(key_0, key_1, counter & _LOW, counter >> _32, zero, _UNIFORMS)
        first[j], second[j] = uniform((a << _32) | b), uniform((c << _32) | d)


@njit(types.void(types.float64[::1], FLOATS, types.uint64))
def add_normals(values, deviation, key):
    """Add Gaussian numbers in place; ``sigma`` has a standard deviation per value, or one."""
    words, normals = np.empty(BATCH, np.uint32), np.empty(BATCH, np.float32)
    for first in range(0, values.size, BATCH):
        fill_normals(key, first // BATCH, words, normals)
        part = values[first : first + BATCH]
        if deviation.size == 1:
            for j in range(part.size):
                part[j] += deviation[0] * np.float64(normals[j])
        else:
            sigma = deviation[first : first + BATCH]
            for j in range(part.size):
                part[j] += sigma[j] * np.float64(normals[j])


@njit(types.void(FLOATS_2D, INTS, types.float64[::1], types.float64[:, ::1]))
def ring_moments(xy, ring_offsets, area, moment):
    """
    Store the signed area and the first moments of every ring, (n_ring,) and (n_ring, 2).

    Computed relative to the first vertex of each ring.
    """
    for ring in range(area.size):
        first, last = ring_offsets[ring], ring_offsets[ring + 1]
        x0, y0 = xy[first, 0], xy[first, 1]
        x, y = 0.0, 0.0
        twice, moment_x, moment_y = 0.0, 0.0, 0.0
        for k in range(first + 1, last):
            next_x, next_y = xy[k, 0] - x0, xy[k, 1] - y0
            cross = x * next_y - y * next_x
            twice += cross
            moment_x += (x + next_x) * cross
            moment_y += (y + next_y) * cross
            x, y = next_x, next_y
        area[ring] = 0.5 * twice
        moment[ring, 0] = moment_x / 6.0 + x0 * area[ring]
        moment[ring, 1] = moment_y / 6.0 + y0 * area[ring]


@njit(types.void(FLOATS_2D, INTS, types.float64, types.int8[::1]))
def convexity(xy, ring_offsets, min_sine, sign):
    """
    Store the orientation of every strictly convex ring, (n_ring,): 1 or -1.

    It is 1 for counter-clockwise rings, -1 for clockwise ones, and 0 for rings that are not strictly convex.
    """
    limit = min_sine * min_sine
    for ring in range(sign.size):
        first, last = ring_offsets[ring], ring_offsets[ring + 1]
        b = last - 2 if last - first > 1 else first
        dx, dy = xy[last - 1, 0] - xy[b, 0], xy[last - 1, 1] - xy[b, 1]
        x, y = xy[last - 1, 0], xy[last - 1, 1]
        square = dx * dx + dy * dy
        is_upwards = dy > 0.0 or (dy == 0.0 and dx > 0.0)
        n_left, n_right, n_rounds = 0, 0, 0
        for k in range(first, last):
            next_dx, next_dy = xy[k, 0] - x, xy[k, 1] - y
            next_square = next_dx * next_dx + next_dy * next_dy
            turn = dx * next_dy - dy * next_dx
            if turn * turn > limit * square * next_square:
                n_left += turn > 0.0
                n_right += turn < 0.0
            was_upwards = is_upwards
            is_upwards = next_dy > 0.0 or (next_dy == 0.0 and next_dx > 0.0)
            n_rounds += is_upwards and not was_upwards
            x, y, dx, dy, square = xy[k, 0], xy[k, 1], next_dx, next_dy, next_square
        sign[ring] = 0
        if n_rounds == 1 and n_left == last - first:
            sign[ring] = 1
        elif n_rounds == 1 and n_right == last - first:
            sign[ring] = -1


@njit()
def moments_below(x_a, x_b, y_a, y_b, sign):
    """Return the moments between a line from (x_a, y_a) to (x_b, y_b) and y = 0."""
    h = sign * (x_b - x_a)
    total, square_a, square_b, product = y_a + y_b, y_a * y_a, y_b * y_b, y_a * y_b
    x_ab, xx_a, xx_b = x_a + x_b, x_a * x_a, x_b * x_b
    xx = (x_ab * x_ab + 2.0 * xx_a, x_ab * x_ab + 2.0 * xx_b)
    return (
        0.5 * h * total,
        _SIXTH * h * (x_a * (total + y_a) + x_b * (total + y_b)),
        _SIXTH * h * (square_a + product + square_b),
        _TWELFTH * h * (y_a * xx[0] + y_b * xx[1]),
        0.5 * _TWELFTH * h * (square_a * (x_ab + 2.0 * x_a) + 2.0 * product * x_ab + square_b * (x_ab + 2.0 * x_b)),
        _TWELFTH * h * total * (square_a + square_b),
    )


@njit()
def add_outline(xy, start, stop, x_0, y_0, sums):
    """Add the moments of a ring, relative to a point, to six sums."""
    x_a, y_a = xy[stop - 1, 0] - x_0, xy[stop - 1, 1] - y_0
    for k in range(start, stop):
        x_b, y_b = xy[k, 0] - x_0, xy[k, 1] - y_0
        part = moments_below(x_a, x_b, y_a, y_b, -1.0)
        for m in range(N_MOMENTS):
            sums[m] += part[m]
        x_a, y_a = x_b, y_b


@njit(types.void(FLOATS_2D, INTS, INTS, FLOATS_2D, types.float64[:, ::1]))
def outline_moments(xy, ring_offsets, site_offsets, centre, out):
    """Write the moments of sites, (n, 6), about centres (n, 2)."""
    for s in range(out.shape[0]):
        out[s] = 0.0
        for ring in range(site_offsets[s], site_offsets[s + 1]):
            add_outline(xy, ring_offsets[ring], ring_offsets[ring + 1], centre[s, 0], centre[s, 1], out[s])


@njit(types.int64[::1](FLOATS_2D, INTS, INTS, FLOATS_2D, FLOATS_2D))
def count_ray_intersections(xy, ring_offsets, site_offsets, centroid, directions):
    """
    Count the rays from each site's centroid that intersect the site's outline.

    The count is 0 for sites that contain their centroid (even-odd rule along the first ray). ``directions`` are unit vectors.
    """
    n_intersecting = np.zeros(site_offsets.size - 1, np.int64)
    for i in range(n_intersecting.size):
        for d in range(directions.shape[0]):
            cos, sin = directions[d, 0], directions[d, 1]
            n_crossed = 0
            for r in range(site_offsets[i], site_offsets[i + 1]):
                last = ring_offsets[r + 1] - 1
                x, y = xy[last, 0] - centroid[i, 0], xy[last, 1] - centroid[i, 1]
                u, v = cos * x + sin * y, cos * y - sin * x
                for k in range(ring_offsets[r], ring_offsets[r + 1]):
                    x, y = xy[k, 0] - centroid[i, 0], xy[k, 1] - centroid[i, 1]
                    next_u, next_v = cos * x + sin * y, cos * y - sin * x
                    if (v > 0.0) != (next_v > 0.0) and u - v * (next_u - u) / (next_v - v) > 0.0:
                        n_crossed += 1
                    u, v = next_u, next_v
            if d == 0 and n_crossed % 2 == 1:
                break
            n_intersecting[i] += n_crossed > 0
    return n_intersecting
