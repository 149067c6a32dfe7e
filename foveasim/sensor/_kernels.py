"""
Numba kernels of the sensor: device random numbers, shot noise, conversion to codes.

The kernels accept arrays and named tuples of arrays and numbers. Arrays of per-site parameters have size n, or size 1 for a
value common to all sites.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core._kernels import BATCH, fill_normals, fill_uniforms, philox_2x32, philox_4x64, uniform
from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, INTS, array_of
from foveasim.sensor.adc import CODE_ROUNDING, ConversionTables
from foveasim.sensor.effects.shot import PoissonTables
from foveasim.sensor.model.prediction import ChargeDistributions, ChargeTables, Transfer

#: ADC transfer functions, as numbered by ``ConversionTables.companding_index``.
ADC_LINEAR, ADC_ROOT, ADC_LOG, ADC_TABLE = range(4)
#: Variance of rounding to integers: a uniform distribution of width 1.
ROUNDING_VARIANCE = np.float32(1.0 / 12.0)
#: Quadratic coefficient of the Poisson approximation and its 1/λ correction: see foveasim.sensor.effects.ShotNoise.
QUADRATIC, QUADRATIC_CORRECTION = np.float32(1.0 / 6.0), np.float32(11.0 / 648.0)
ONE, TWO = np.float32(1.0), np.float32(2.0)
#: Upper limit of Poisson draws with a mean below 1: larger ones have a probability below 1e-18.
MAX_ADDED = 20
#: Upper limit of charges: 2**62 fits int64 with headroom for sums.
MAX_CHARGE_E = 2.0**62
#: Probabilities further than this many standard deviations from the mean are neglected: 6e-16 for a Gaussian distribution.
RANGE_SIGMAS = 8.0
#: The same as the exponent of Chernoff's bound.
RANGE_EXPONENT = 0.5 * RANGE_SIGMAS**2
#: Maximum number of tabulated cumulative probabilities: Poisson distributions up to a mean of 1e6 e-.
MAX_NODES = 2**14
#: From this readout noise, charges need not be integers: exp(-2 pi² sigma²) is 4e-11.
CONTINUOUS_ABOVE_E = 1.1
#: Above these means, cumulative probabilities are those of the Edgeworth series at half-integers, and of the continuous charge:
#: its steps are then below 1e-6 of the standard deviation.
MAX_TABULATED_E, MAX_LATTICE_E = 1e6, 1e12
#: Terms of Edgeworth series: maximum number, and the size that is neglected.
MAX_TERMS, MIN_TERM = 48, 1e-11
#: Coefficients of the powers of z from z³ of the logarithm of (z/2) / sinh(z/2); that of z² is -1/24.
LATTICE = (0.0, 1.0 / 2880.0, 0.0, -1.0 / 181440.0, 0.0, 1.0 / 9676800.0)
#: From this readout noise, Gaussian probabilities of intervals of 1 e- are series about their centres, to 1e-13.
SERIES_ABOVE_E = 2.0
#: Harmonics of the quantisation error below exp(-HARMONIC_EXPONENT) are neglected. The sum over codes is faster than more
#: harmonics than a number, plus a number per code.
HARMONIC_EXPONENT, MAX_HARMONICS, MAX_HARMONICS_PER_CODE = 30.0, 8.0, 2.0
#: Smallest probability of a companding inverse; tolerance of integer charges.
MIN_PROBABILITY, INTEGER_TOLERANCE = 1e-18, 1e-6
#: Sites per pass of :func:`convert`: its buffers and the table of quantiles fit the L1 cache.
PIECE = 512
#: Bisections that determine a float64 to its last bit.
BISECTIONS = 60
SQRT_HALF, SQRT_TWO_PI, TWO_PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi), 2.0 * math.pi

_lines = array_of(types.int32)
_words = array_of(types.uint64)
_number, _count = types.float64, types.int64
_adc = types.NamedTuple(
    (_number, _count, _number, FLOATS, _count, FLOATS, _number, types.uint64, FLOATS), ConversionTables
)
_charges = types.NamedTuple((FLOATS, FLOATS, FLOATS, FLOATS, FLOATS, types.boolean), ChargeDistributions)
_charge_tables = types.NamedTuple((INTS, INTS, FLOATS), ChargeTables)
_poisson_tables = types.NamedTuple((FLOATS_2D, array_of(types.uint16, 2)), PoissonTables)
_transfer = types.NamedTuple((FLOATS, FLOATS, FLOATS, FLOATS, _number, _number), Transfer)

_LOW, _ONE_IN_2_32 = np.uint64(0xFFFFFFFF), 2.0**-32


@njit(types.float64[::1](types.uint64, types.uint64, _words, types.uint64))
def device_uniforms(key_0, key_1, first, second):
    """
    Return a reproducible uniform number, in (0, 1), for each first word of the counter.

    The second word is common.
    """
    out = np.empty(first.size, np.float64)
    for i in range(first.size):
        word, _, _, _ = philox_4x64(key_0, key_1, first[i], second, np.uint64(0), np.uint64(0))
        out[i] = uniform(word)
    return out


@njit()
def _poisson(mean, first, second, tables):
    """
    Draw a Poisson number from two uniform numbers.

    It is the sum of draws of the integral and of the fractional part of the mean. Both are inversions of the cumulative
    distribution, the first one by a table.
    """
    row = int(mean)
    n = np.int64(tables.guide[row, int(first * tables.guide.shape[1])])
    while tables.cumulative_fraction[row, n] <= first:
        n += 1
    fraction = mean - row
    probability = math.exp(-fraction)
    cumulated = probability
    added = 0
    while cumulated <= second and added < MAX_ADDED:
        added += 1
        probability *= fraction / added
        cumulated += probability
    return np.float64(n + added)


@njit(types.void(types.float64[::1], types.float64, _poisson_tables, types.uint64))
def draw_poisson(charge_e, gaussian_above_e, tables, key):
    """
    Replace expectations by Poisson draws, in whole electrons.

    Draws are exact up to the mean ``gaussian_above_e``; above it, their first three moments are correct.
    """
    words, normals, drawn = np.empty(BATCH, np.uint32), np.empty(BATCH, np.float32), np.empty(BATCH)
    first, second = np.empty(BATCH), np.empty(BATCH)
    lowest = np.float32(gaussian_above_e)
    for begin in range(0, charge_e.size, BATCH):
        charges = charge_e[begin : begin + BATCH]
        n_exact = 0
        n_zero = 0
        for j in range(charges.size):
            n_exact += charges[j] <= gaussian_above_e
            n_zero += charges[j] <= 0.0
        if n_exact < charges.size:
            fill_normals(key, begin // BATCH, words, normals)
            # This loop has no branches so that the compiler vectorises it. The deviation from the mean is a float32.
            for j in range(charges.size):
                mean, z = max(np.float32(charges[j]), lowest), normals[j]
                c = QUADRATIC + QUADRATIC_CORRECTION / mean
                deviation = np.sqrt(mean - ROUNDING_VARIANCE - TWO * c * c) * z + c * (z * z - ONE)
                drawn[j] = np.rint(min(max(charges[j] + np.float64(deviation), 0.0), MAX_CHARGE_E))
        if n_exact > n_zero:
            fill_uniforms(key, begin // BATCH, first, second)
        for j in range(charges.size):
            if charges[j] > gaussian_above_e:
                charges[j] = drawn[j]
            elif charges[j] > 0.0:
                charges[j] = _poisson(charges[j], first[j], second[j], tables)
            else:
                charges[j] = 0.0


@njit(
    [types.void(FLOATS, index, index, FLOATS, types.int64, types.float64[::1]) for index in (_lines, INTS)],
)
def mix(fractions, columns, offsets, charge_e, first, mixed_e):
    """Multiply rows of a sparse matrix, from row ``first``, by the charges of all sites."""
    # Unsigned indices avoid the check for negative ones.
    k = np.uint64(offsets[first])
    for i in range(mixed_e.size):
        end = np.uint64(offsets[first + i + 1])
        total = 0.0
        while k < end:
            total += fractions[k] * charge_e[np.uint64(columns[k])]
            k += np.uint64(1)
        mixed_e[i] = total


@njit()
def _value_of_site(values, i):
    return values[i] if values.size > 1 else values[0]


@njit()
def _compand(fraction, adc):
    """Map a fraction of the voltage range to a fraction of the code range."""
    if adc.companding_index == ADC_ROOT:
        return math.sqrt(fraction)
    if adc.companding_index == ADC_LOG:
        return math.log1p(adc.log_strength * fraction) / math.log1p(adc.log_strength)
    if adc.companding_index == ADC_TABLE:
        position = fraction * (adc.curve.size - 1)
        k = min(int(position), adc.curve.size - 2)
        return adc.curve[k] + (position - k) * (adc.curve[k + 1] - adc.curve[k])
    return fraction


@njit()
def _apply_nonlinearity(v, nonlinearity, v_sat_v):
    """Return the voltage after the nonlinearity."""
    return v * (1.0 - nonlinearity * min(max(v / v_sat_v, 0.0), 1.0))


@njit(types.void(types.float64[::1], types.float64, types.float64))
def apply_nonlinearity(voltage_v, nonlinearity, v_sat_v):
    """Apply the nonlinearity, the relative signal loss at full range, in place."""
    for i in range(voltage_v.size):
        voltage_v[i] = _apply_nonlinearity(voltage_v[i], nonlinearity, v_sat_v)


@njit()
def _relative_voltage(v, v_sat_v):
    """Return the fraction of the voltage range, clipped to 0 .. 1."""
    return min(max(v / v_sat_v, 0.0), 1.0)


@njit()
def _index(position):
    """Truncate to an index; unsigned integers avoid the check for negative indices."""
    return np.uint32(np.int32(position))


@njit()
def _interpolate(values, cell, fraction):
    """Interpolate between two values linearly."""
    return values[cell] + fraction * (values[cell + np.uint32(1)] - values[cell])


@njit()
def _inl_position(value, n_codes, inl):
    """Return the fractional index into the INL for an unquantised code."""
    # The number of codes is a power of 2: its inverse is exact.
    return min(value * (1.0 / n_codes), 1.0) * (inl.size - 1)


@njit()
def _add_inl(value, n_codes, inl):
    """Add the integral nonlinearity to an unquantised code."""
    position = _inl_position(value, n_codes, inl)
    k = _index(min(position, inl.size - 2.0))
    return value + _interpolate(inl, k, position - k)


@njit()
def _unquantised_code(charge, site, adc):
    """Return the code of a charge before quantisation; ``site``: transfer parameters."""
    per_e, sense_v, scale, output_v, nonlinearity = site
    v = _apply_nonlinearity(charge * per_e + sense_v, nonlinearity, adc.v_sat_v) * scale + output_v
    value = _compand(_relative_voltage(v, adc.v_sat_v), adc) * adc.n_codes
    return _add_inl(value, adc.n_codes, adc.inl) if adc.inl.size > 1 else value


@njit()
def _dnl_position(key, line, code, n_quantiles):
    """Return the fractional index into the Gaussian quantiles for a readout line and a code."""
    word, _ = philox_2x32(key, np.uint64(line) & _LOW, np.uint64(code))
    return np.float64(word) * (_ONE_IN_2_32 * (n_quantiles - 1))


@njit()
def _dnl_normal(key, line, code, quantiles):
    """Return the standard Gaussian DNL number of a readout line and a code."""
    position = _dnl_position(key, line, code, quantiles.size)
    k = _index(position)
    return _interpolate(quantiles, k, position - k)


@njit(types.void(_adc, _lines, types.float64[:, ::1]))
def dnl_offsets(adc, line, offset_dn):
    """Write the DNL offset of each readout line and code, (n_line, n_code)."""
    for i in range(line.size):
        for code in range(adc.n_codes):
            offset_dn[i, code] = adc.dnl_dn * _dnl_normal(adc.dnl_key, line[i], code, adc.quantiles)


@njit()
def _quantise(value, n_codes):
    """Quantise to a code in float64."""
    return np.float64(np.int32(min(max(value + CODE_ROUNDING, 0.0), n_codes - 1.0)))


@njit()
def _quantise_with_dnl(value, line, adc):
    """Quantise to a code, with differential nonlinearity."""
    code = _quantise(value, adc.n_codes)
    if adc.dnl_dn > 0.0:
        code = _quantise(value + adc.dnl_dn * _dnl_normal(adc.dnl_key, line, code, adc.quantiles), adc.n_codes)
    return code


@njit()
def _charge_at_code(value, site, adc):
    """Invert :func:`_unquantised_code`; codes outside the range give infinite charges."""
    per_e, sense_v, scale, output_v, nonlinearity = site
    v_sat_v, inl = adc.v_sat_v, adc.inl
    code_fraction = value / adc.n_codes
    if inl.size > 1:
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            centre = 0.5 * (low + high)
            position = centre * (inl.size - 1)
            k = min(int(position), inl.size - 2)
            if centre * adc.n_codes + inl[k] + (position - k) * (inl[k + 1] - inl[k]) < value:
                low = centre
            else:
                high = centre
        code_fraction = high if high < 1.0 else 1.0 + MIN_PROBABILITY
        if low == 0.0:
            code_fraction = 0.0
    if code_fraction <= 0.0:
        return -np.inf
    if code_fraction > 1.0:
        return np.inf
    fraction = code_fraction
    if adc.companding_index == ADC_ROOT:
        fraction = code_fraction * code_fraction
    elif adc.companding_index == ADC_LOG:
        fraction = math.expm1(code_fraction * math.log1p(adc.log_strength)) / adc.log_strength
    elif adc.companding_index == ADC_TABLE:
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            fraction = 0.5 * (low + high)
            if _compand(fraction, adc) < code_fraction:
                low = fraction
            else:
                high = fraction
    v = (fraction * v_sat_v - output_v) / scale
    if nonlinearity != 0.0 and v > 0.0:
        v = (
            0.5 * v_sat_v * (1.0 - math.sqrt(1.0 - 4.0 * nonlinearity * v / v_sat_v)) / nonlinearity
            if v < v_sat_v * (1.0 - nonlinearity)
            else v / (1.0 - nonlinearity)
        )
    return (v - sense_v) / per_e


@njit([types.void(FLOATS, _lines, _adc, code[::1]) for code in (types.uint8, types.uint16)])
def convert(voltage_v, line, adc, code):
    """
    Convert voltages to codes: clipping, companding, INL, DNL, quantisation.

    ``adc.dnl_dn`` is the standard deviation, in codes, of the Gaussian offset of each code transition in each readout line.
    """
    # One short loop per step over buffers that fit the cache. The compiler vectorises the loops because numpy's error model
    # does not check divisions; those that look up a table, which it does not vectorise, do nothing else.
    value, fraction, cell = np.empty(PIECE), np.empty(PIECE), np.empty(PIECE, np.uint32)
    n_codes, inl, dnl, quantiles = adc.n_codes, adc.inl, adc.dnl_dn, adc.quantiles
    log_range = math.log1p(adc.log_strength)
    for first in range(0, voltage_v.size, PIECE):
        n = min(PIECE, voltage_v.size - first)
        sites = slice(first, first + n)
        volts, lines, codes = voltage_v[sites], line[sites], code[sites]
        for j in range(n):
            value[j] = _relative_voltage(volts[j], adc.v_sat_v)
        if adc.companding_index == ADC_ROOT:
            for j in range(n):
                value[j] = math.sqrt(value[j])
        elif adc.companding_index == ADC_LOG:
            for j in range(n):
                value[j] = math.log1p(adc.log_strength * value[j]) / log_range
        elif adc.companding_index == ADC_TABLE:
            for j in range(n):
                value[j] = _compand(value[j], adc)
        for j in range(n):
            value[j] *= n_codes
        if inl.size > 1:
            for j in range(n):
                position = _inl_position(value[j], n_codes, inl)
                cell[j] = _index(min(position, inl.size - 2.0))
                fraction[j] = position - cell[j]
            for j in range(n):
                value[j] += _interpolate(inl, cell[j], fraction[j])
        for j in range(n):
            codes[j] = np.int32(_quantise(value[j], n_codes))
        if dnl > 0.0:
            for j in range(n):
                position = _dnl_position(adc.dnl_key, lines[j], codes[j], quantiles.size)
                cell[j] = _index(position)
                fraction[j] = position - cell[j]
            for j in range(n):
                value[j] += dnl * _interpolate(quantiles, cell[j], fraction[j])
            for j in range(n):
                codes[j] = np.int32(_quantise(value[j], n_codes))


@njit()
def _gaussian_cdf(x):
    return 0.5 * math.erfc(-x * SQRT_HALF)


@njit()
def _edgeworth_coefficients(mean, variance, is_lattice, coefficients):
    """
    Compute the Edgeworth series of a Poisson number plus Gaussian noise.

    ``variance`` is the total variance. The characteristic function at u, about the mean, is
    ``exp(-s² u²/2) sum c_n (i s u)^n``. The coefficients c_n, to any order, are those of the exponential of a power series
    with the cumulants, ``mean z^j / j!`` from j = 3. With ``is_lattice``, the series is that of the cumulative probability of
    integers, at half-integers, and ``variance`` is the mean. The inversion of a lattice distribution adds the factor
    ``(z/2) / sinh(z/2)`` (J. E. Kolassa and P. McCullagh, Edgeworth series for lattice distributions, Ann. Statist. 18, 981,
    1990).

    Returns the standard deviation and the number of coefficients, or 0 where the series does not reach ``MIN_TERM``.
    """
    spread = math.sqrt(variance - 1.0 / 12.0 if is_lattice else variance)
    scale = 1.0 / spread
    # Coefficients j b_j of the cumulants, in the upper half of the array, and c_n in the lower half.
    coefficients[0], coefficients[1], coefficients[2] = 1.0, 0.0, 0.0
    cumulant = 0.5 * mean * scale * scale
    # Hermite polynomials of degree n - 1, times the Gaussian density, are below sqrt((n - 1)! / (2 pi)).
    largest, limit = 0.0, 1.0 / (TWO_PI * MIN_TERM**2)
    for n in range(3, MAX_TERMS):
        cumulant *= scale / (n - 1.0) if n > 3 else scale
        term = cumulant
        if is_lattice and n < 3 + len(LATTICE):
            term += n * LATTICE[n - 3] * scale**n
        coefficients[np.uint64(MAX_TERMS + n)] = term
        # c_0 is 1, and c_1 and c_2 are 0.
        for j in range(3, n - 2):
            term += coefficients[np.uint64(MAX_TERMS + j)] * coefficients[np.uint64(n - j)]
        term /= n
        coefficients[np.uint64(n)] = term
        limit *= n - 1.0
        size = term * term * limit
        # Terms vary in groups of three.
        largest = size if n % 3 == 0 else max(largest, size)
        if n % 3 == 2 and largest < 1.0:
            return spread, n - 2
    return spread, 0


@njit()
def _edgeworth_cdf(x, coefficients, n_terms):
    """Return the standardised Gaussian CDF, with the terms of :func:`_edgeworth_coefficients`."""
    if x < -RANGE_SIGMAS - 1.0 or x > RANGE_SIGMAS + 3.0:
        return 0.0 if x < 0.0 else 1.0
    if n_terms <= 3:
        return _gaussian_cdf(x)
    total, previous, hermite = 0.0, 1.0, x
    for n in range(3, n_terms):
        previous, hermite = hermite, x * hermite - (n - 2.0) * previous
        total += coefficients[np.uint64(n)] * hermite
    return _gaussian_cdf(x) - total * math.exp(-0.5 * x * x) / SQRT_TWO_PI


@njit()
def _range_below(variance):
    """Return the largest deviation below the mean of Poisson plus Gaussian numbers."""
    return RANGE_SIGMAS * math.sqrt(variance)


@njit()
def _range_above(variance):
    """
    Return the largest deviation above the mean of Poisson plus Gaussian numbers.

    By Bernstein's inequality, the probability of a distance x is below ``exp(-x² / (2 (variance + x/3)))``.
    """
    third = RANGE_EXPONENT / 3.0
    return third + math.sqrt(third * third + 2.0 * RANGE_EXPONENT * variance)


@njit()
def _accumulate(cumulative, n):
    """Replace probabilities by cumulative ones, normalised."""
    total = 0.0
    for j in range(n):
        total += cumulative[np.uint64(j)]
        cumulative[np.uint64(j)] = total
    scale = 1.0 / total
    for j in range(n):
        cumulative[np.uint64(j)] *= scale


@njit()
def _tabulate(tables, i, cumulative):
    """
    Compute the cumulative probabilities of the table of a site.

    Returns the number of integers, mean minus the first integer, and variance.
    """
    begin, n = tables.offset[i], tables.offset[i + 1] - tables.offset[i]
    weight, first, second = 0.0, 0.0, 0.0
    for j in range(n):
        probability = tables.probability_fraction[np.uint64(begin + j)]
        cumulative[np.uint64(j)] = probability
        weight += probability
        first += probability * j
    first /= weight
    for j in range(n):
        second += cumulative[np.uint64(j)] * (j - first) ** 2
    _accumulate(cumulative, n)
    return n, first, second / weight


@njit()
def _tabulate_poisson(mean, cumulative):
    """
    Compute cumulative Poisson probabilities of consecutive integers.

    Probabilities are computed by recursion from the mode, so that they need no logarithm of the gamma function.
    Returns the first integer and their number.
    """
    mode = math.floor(mean)
    first = max(math.floor(mean - _range_below(mean)), 0.0)
    n, centre = int(math.ceil(mean + _range_above(mean)) - first), int(mode - first)
    cumulative[np.uint64(centre)] = 1.0
    probability, k = 1.0, mode
    for j in range(centre + 1, n):
        k += 1.0
        probability *= mean / k
        cumulative[np.uint64(j)] = probability
    probability, k = 1.0, mode
    inverse = 1.0 / max(mean, 1.0)
    for j in range(centre):
        probability *= k * inverse
        k -= 1.0
        cumulative[np.uint64(centre - 1 - j)] = probability
    _accumulate(cumulative, n)
    return first, n


@njit()
def _cumulative_probability(k, charge, cumulative, coefficients):
    """Return the probability that a charge is at most the integer ``k``."""
    first, n, end, mean, spread, n_terms = charge
    if k >= end:
        return 1.0
    if k < first:
        return 0.0
    if n > 0:
        return cumulative[np.uint64(np.int64(k - first))]
    return _edgeworth_cdf((k + 0.5 - mean) / spread, coefficients, n_terms)


@njit()
def _mean_of_intervals(q, k, last, charge, cumulative, coefficients, sigma):
    """
    Return the weighted mean of cumulative probabilities of integers k.

    Weights are the probabilities that ``q`` minus the noise is between k and k + 1: the density at the centre, by recursion,
    times a series in ``1/sigma²`` with the Hermite polynomials of even degree. The mean is that of their sum, from which the
    rounding error of the recursion cancels.
    """
    step = 1.0 / sigma
    step2, step4, step6 = step**2 / 24.0, step**4 / 1920.0, step**6 / 322560.0
    step8, step10 = step**8 / 92897280.0, step**10 / 40874803200.0
    x = (q - k - 0.5) * step
    density = math.exp(-0.5 * x * x) * step / SQRT_TWO_PI
    ratio, decay = math.exp((x - 0.5 * step) * step), math.exp(-step * step)
    weight, total = 0.0, 0.0
    while k < last:
        u = x * x
        series = 1.0 + step2 * (u - 1.0) + step4 * ((u - 6.0) * u + 3.0) + step6 * (((u - 15.0) * u + 45.0) * u - 15.0)
        series += step8 * ((((u - 28.0) * u + 210.0) * u - 420.0) * u + 105.0)
        series += step10 * (((((u - 45.0) * u + 630.0) * u - 3150.0) * u + 4725.0) * u - 945.0)
        series *= density
        weight += series
        total += series * _cumulative_probability(k, charge, cumulative, coefficients)
        density *= ratio
        ratio *= decay
        x -= step
        k += 1.0
    return total / weight if weight > 0.0 else 0.0


@njit()
def _probability_below(q, is_discrete, charge, cumulative, coefficients, sigma, half_step):
    """
    Return the probability that a charge plus readout noise is below ``q``.

    ``charge`` is the first integer, the number of integers in ``cumulative``, the integer from which the cumulative probability
    is 1 (the full well, or the end of the table), and mean, standard deviation and number of terms of the Edgeworth series. It
    is that of the charge at half-integers if ``is_discrete`` and the number of integers is 0, or that of charge plus noise if
    not ``is_discrete``. The readout noise is Gaussian with standard deviation ``sigma``, plus RTS noise of ``+half_step`` or
    ``-half_step``.

    For integer charges, the sum of probabilities p(k) times ``Phi((q - k) / sigma)`` is that of cumulative probabilities of k
    times the probability that ``q`` minus the noise is between k and k + 1.
    """
    total = 0.0
    n_states = 2 if half_step > 0.0 else 1
    for state in range(n_states):
        at = q + half_step if state else q - half_step
        if not is_discrete:
            mean, spread, n_terms = charge[3], charge[4], charge[5]
            if spread > 0.0:
                total += _edgeworth_cdf((at - mean) / spread, coefficients, n_terms)
            elif mean < at - INTEGER_TOLERANCE:
                total += 1.0
        elif sigma == 0.0:
            total += _cumulative_probability(math.ceil(at - INTEGER_TOLERANCE) - 1.0, charge, cumulative, coefficients)
        else:
            last = min(math.floor(at + RANGE_SIGMAS * sigma) + 1.0, charge[2])
            k = min(max(math.ceil(at - RANGE_SIGMAS * sigma) - 1.0, charge[0]), last)
            upper = _gaussian_cdf((at - k) / sigma)
            if sigma >= SERIES_ABOVE_E and k < last:
                lower = _gaussian_cdf((at - last) / sigma)
                total += (upper - lower) * _mean_of_intervals(at, k, last, charge, cumulative, coefficients, sigma)
                k, upper = last, lower
            while k < last:
                lower = _gaussian_cdf((at - k - 1.0) / sigma)
                total += (upper - lower) * _cumulative_probability(k, charge, cumulative, coefficients)
                upper = lower
                k += 1.0
            total += upper
    return total / n_states


@njit()
def _integer_moments(mean, well_e, half_step, dn_per_e, offset_dn, n_codes):
    """
    Return code mean and variance of a Poisson charge, for a linear ADC.

    Without Gaussian noise: the sums over all integers, by recursion from the mode to both sides.
    """
    mode = math.floor(mean)
    n = int(_range_above(mean)) + 2
    inverse = 1.0 / max(mean, 1.0)
    reference = _quantise(dn_per_e * min(mode, well_e) + offset_dn, n_codes)
    weight, first, second = 0.0, 0.0, 0.0
    n_states = 2 if half_step > 0.0 else 1
    for state in range(n_states):
        offset = offset_dn + (half_step if state else -half_step) * dn_per_e
        code = _quantise(dn_per_e * min(mode, well_e) + offset, n_codes) - reference
        weight += 1.0
        first += code
        second += code * code
        above, below, up, down = 1.0, 1.0, mode, mode
        for _ in range(n):
            up += 1.0
            above *= mean / up
            # 0 below the charge 0.
            below *= down * inverse
            down -= 1.0
            upper = _quantise(dn_per_e * min(up, well_e) + offset, n_codes) - reference
            lower = _quantise(dn_per_e * min(down, well_e) + offset, n_codes) - reference
            weight += above + below
            first += above * upper + below * lower
            second += above * upper * upper + below * lower * lower
    first /= weight
    return reference + first, second / weight - first * first


@njit()
def _count_harmonics(mean, sigma, dn_per_e, n_transitions):
    """
    Return the largest relevant harmonic of the quantisation error.

    Also returns the distance from integers, in cycles per e-, within which harmonics are relevant.
    The modulus of the characteristic function of a Poisson number plus Gaussian noise, at f cycles per e-, is
    ``exp(-mean (1 - cos 2 pi f) - 2 pi² sigma² f²)``: only frequencies close to integers are relevant. The largest harmonic is
    infinite where too many are.
    """
    last = math.sqrt(0.5 * HARMONIC_EXPONENT) / (math.pi * sigma * dn_per_e)
    if last < 1.0:
        return last, 0.0
    near = math.acos(1.0 - HARMONIC_EXPONENT / mean) / TWO_PI if 2.0 * mean > HARMONIC_EXPONENT else 0.5
    n = min(last, near / dn_per_e + 2.0 * near * last) + last * min(dn_per_e, 1.0)
    return (last if n <= MAX_HARMONICS + MAX_HARMONICS_PER_CODE * n_transitions else np.inf), near


@njit()
def _quantisation_moments(mean, sigma, half_step, dn_per_e, offset_dn, last, near):
    """
    Return mean of the quantisation error, and the variance that it adds.

    The value is a Poisson number plus Gaussian and RTS noise, converted linearly.
    The code of the value y is ``y - 1/2 + S``, with the Fourier series ``S = sum sin(2 pi m y) / (pi m)`` and
    ``S² = 1/12 + sum cos(2 pi m y) / (pi m)²``. Their means are values of the characteristic function at the harmonics m, and
    the covariance of y and S its derivatives (B. Widrow and I. Kollár, Quantization Noise, Cambridge, 2008, chapters 4 to 6).
    The first harmonics to ``last`` within ``near`` cycles per e- of an integer are added.
    """
    first, second, covariance = 0.0, 0.0, 0.0
    m = 1.0
    while m <= last:
        turns = dn_per_e * m
        whole = math.floor(turns)
        if near < turns - whole < 1.0 - near:
            m = max(math.ceil((whole + 1.0 - near) / dn_per_e), m + 1.0)
            continue
        half = math.pi * (turns - whole)
        sine, versine = math.sin(half), math.cos(half)
        sine, versine = 2.0 * sine * versine, 2.0 * sine * sine
        modulus = math.exp(-mean * versine - 0.5 * (TWO_PI * turns * sigma) ** 2)
        phase = TWO_PI * (offset_dn * m - math.floor(offset_dn * m)) + mean * sine
        real, imaginary = modulus * math.cos(phase), modulus * math.sin(phase)
        # Imaginary part of the mean of (y - mean of y) exp(2 pi i m y), in units of dn_per_e.
        moment = mean * (real * sine - imaginary * versine) + TWO_PI * turns * sigma * sigma * real
        if half_step > 0.0:
            rts = TWO_PI * turns * half_step
            cosine = math.cos(rts)
            moment = cosine * moment + half_step * math.sin(rts) * real
            real, imaginary = cosine * real, cosine * imaginary
        first += imaginary / (math.pi * m)
        second += real / (math.pi * m) ** 2
        covariance += dn_per_e * moment / (math.pi * m)
        m += 1.0
    return first - 0.5, 1.0 / 12.0 + second - first * first + 2.0 * covariance


@njit(types.void(_charges, _charge_tables, _transfer, _lines, _adc, types.float64[::1], types.float64[::1]))
def predict_codes(charges, tables, transfer, line, adc, mean_dn, variance_dn2):
    """
    Compute mean and variance of the code of each site.

    With ``charges.is_drawn``, charges are integers, clipped at the full well: those of ``tables``, or Poisson-distributed
    where it is empty. Otherwise they are Gaussian with variance ``variance_e2``, or equal to their mean where it is 0.
    """
    is_tabulated = charges.is_drawn and tables.first_e.size > 0
    n_nodes = np.int64(MAX_NODES)
    if is_tabulated:
        for i in range(charges.mean_e.size):
            n_nodes = max(n_nodes, tables.offset[i + 1] - tables.offset[i])
    cumulative, coefficients = np.empty(n_nodes), np.empty(2 * MAX_TERMS)
    n_codes, nonlinearity = adc.n_codes, transfer.nonlinearity_fraction
    # With INL and DNL, the order of codes may differ from that of transitions.
    is_curved = adc.inl.size > 1 or adc.dnl_dn > 0.0
    is_linear = adc.companding_index == ADC_LINEAR and nonlinearity == 0.0 and not is_curved
    for i in range(charges.mean_e.size):
        site = (
            _value_of_site(transfer.v_per_e, i),
            _value_of_site(transfer.sense_v, i),
            _value_of_site(transfer.scale, i),
            _value_of_site(transfer.output_v, i),
            nonlinearity,
        )
        if site[0] * site[2] == 0.0:
            mean_dn[i], variance_dn2[i] = (
                _quantise_with_dnl(_unquantised_code(0.0, site, adc), _value_of_site(line, i), adc),
                0.0,
            )
            continue
        mean, variance = charges.mean_e[i], _value_of_site(charges.variance_e2, i)
        well, sigma = _value_of_site(charges.well_e, i), _value_of_site(charges.sigma_e, i)
        half_step = _value_of_site(charges.half_step_e, i)
        reach = RANGE_SIGMAS * sigma + half_step
        is_discrete = charges.is_drawn
        is_poisson = is_discrete and not is_tabulated and well > mean - _range_below(mean)
        first, n, n_terms = 0.0, np.int64(0), np.int64(0)
        # Integer from which the cumulative probability is 1 (minus 1 for a table), and range of charge plus noise.
        end = well
        if is_tabulated:
            n, mean, variance = _tabulate(tables, i, cumulative)
            first = np.float64(tables.first_e[i])
            mean += first
            end = min(well, first + n - 1.0)
            low, high = min(first, end) - reach, first + n - 1.0 + reach
        elif is_poisson:
            variance = mean
            # A charge above the full well is the full well, with the noise around it.
            low = max(min(mean - _range_below(mean + sigma * sigma) - half_step, well - reach), -reach)
            high = mean + _range_above(mean + sigma * sigma) + half_step
        else:
            if is_discrete or variance == 0.0:
                mean, variance = min(mean, well), 0.0
            is_discrete = False
            low = mean - _range_below(variance + sigma * sigma) - half_step
            high = mean + _range_below(variance + sigma * sigma) + half_step
        start, stop = _unquantised_code(low, site, adc), _unquantised_code(min(high, well + reach), site, adc)
        if start == stop:  # saturated, or a charge without deviations
            mean_dn[i], variance_dn2[i] = _quantise_with_dnl(start, _value_of_site(line, i), adc), 0.0
            continue
        is_below_well = not is_discrete or high < well
        spread = math.sqrt(variance + sigma * sigma)
        if is_linear:
            dn_per_e = site[0] * site[2] / adc.v_sat_v * n_codes
            offset_dn = (site[1] * site[2] + site[3]) / adc.v_sat_v * n_codes
            noise = sigma if is_discrete else spread
            if is_poisson and noise == 0.0 and mean <= MAX_TABULATED_E:
                mean_dn[i], variance_dn2[i] = _integer_moments(mean, well, half_step, dn_per_e, offset_dn, n_codes)
                continue
            if (
                noise > 0.0
                and is_below_well
                and dn_per_e > 0.0
                and dn_per_e * low + offset_dn >= 0.0
                and dn_per_e * high + offset_dn < n_codes
            ):
                poisson = mean if is_poisson else 0.0
                last, near = _count_harmonics(poisson, noise, dn_per_e, dn_per_e * (high - low))
                if last < 1.0 or (last < np.inf and not is_tabulated):
                    offset = offset_dn + dn_per_e * (mean - poisson)
                    added, added2 = _quantisation_moments(poisson, noise, half_step, dn_per_e, offset, last, near)
                    mean_dn[i] = mean * dn_per_e + offset_dn + added
                    variance = (spread * spread + half_step * half_step) * dn_per_e * dn_per_e + added2
                    variance_dn2[i] = max(variance, 0.0)
                    continue
        if is_poisson:
            if mean > MAX_LATTICE_E or (sigma >= CONTINUOUS_ABOVE_E and is_below_well):
                spread, n_terms = _edgeworth_coefficients(mean, mean + sigma * sigma, False, coefficients)
                is_discrete = n_terms == 0
            if is_discrete and mean <= MAX_TABULATED_E:
                first, n = _tabulate_poisson(mean, cumulative)
                end = min(well, first + n - 1.0)
            elif is_discrete:
                first = math.floor(mean - _range_below(mean))
                spread, n_terms = _edgeworth_coefficients(mean, mean, True, coefficients)
                end = min(well, math.ceil(mean + _range_above(mean)))
        charge = (first, n, end, mean, spread, n_terms)
        k_first, k_last = max(math.floor(start) - 1, 0), min(math.floor(stop) + 1, n_codes - 1)
        # Codes are relative to that of the mean: squares of large codes would lose digits of a small variance.
        reference = math.floor(_unquantised_code(min(mean, well), site, adc))
        total, squares = 0.0, 0.0
        at, cumulated = low, 0.0
        for k in range(k_first, k_last + 1):
            # DNL adds at most one transition inside each code interval.
            jump = 1.0
            if adc.dnl_dn > 0.0:
                moved = adc.dnl_dn * _dnl_normal(adc.dnl_key, _value_of_site(line, i), k, adc.quantiles)
                jump = math.ceil(k + moved) - (k + moved)
            for part in range(2):
                transition = k + jump if part == 0 else k + 1.0
                if part == 1 and jump == 1.0:
                    continue
                end_e = _charge_at_code(transition, site, adc)
                if k == k_last and (part == 1 or jump == 1.0):
                    end_e = np.inf
                if end_e <= at:
                    continue
                below = 1.0
                if end_e < np.inf:
                    below = _probability_below(end_e, is_discrete, charge, cumulative, coefficients, sigma, half_step)
                code = k - reference
                if is_curved:
                    centre = 0.5 * (at + end_e) if end_e < np.inf else max(at, high) + 1.0
                    code = _quantise_with_dnl(_unquantised_code(centre, site, adc), _value_of_site(line, i), adc)
                    code -= reference
                total += code * (below - cumulated)
                squares += code * code * (below - cumulated)
                at, cumulated = end_e, below
        mean_dn[i] = reference + total
        variance_dn2[i] = max(squares - total * total, 0.0)
