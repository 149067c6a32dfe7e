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
from foveasim.sensor.adc import ConversionTables
from foveasim.sensor.effects.shot import PoissonTables
from foveasim.sensor.model.prediction import ChargeDistributions, Quadrature, Transfer

#: ADC transfer functions, as numbered by ``ConversionTables.companding_index``.
ADC_LINEAR, ADC_ROOT, ADC_LOG, ADC_TABLE = range(4)
#: Tolerance of code transitions, in codes: covers the rounding error of a division.
CODE_ROUNDING = 1e-9
#: Variance of rounding to integers: a uniform distribution of width 1.
ROUNDING_VARIANCE = np.float32(1.0 / 12.0)
#: Quadratic coefficient of the Poisson approximation and its 1/λ correction: see foveasim.sensor.effects.ShotNoise.
QUADRATIC, QUADRATIC_CORRECTION = np.float32(1.0 / 6.0), np.float32(11.0 / 648.0)
ONE, TWO = np.float32(1.0), np.float32(2.0)
#: Upper limit of Poisson draws with a mean below 1: larger ones have a probability below 1e-18.
MAX_ADDED = 20
#: Upper limit of charges: 2**62 fits int64 with headroom for sums.
MAX_CHARGE_E = 2.0**62
#: Upper limit of a Poisson draw above its mean: this many standard deviations plus this many electrons.
MAX_DRAW_SIGMAS, MAX_DRAW_MARGIN_E = 12.0, 40
#: Probabilities further than this many standard deviations from the mean are neglected.
RANGE_SIGMAS = 9.0
#: Maximum number of nodes of a discrete charge distribution; smallest probability included; tolerance of integer charges.
MAX_NODES, MIN_PROBABILITY, INTEGER_TOLERANCE = 2048, 1e-18, 1e-6
#: Sites per pass of :func:`convert`: its buffers and the table of quantiles fit the L1 cache.
PIECE = 512
#: Bisections that determine a float64 to its last bit.
BISECTIONS = 60
SQRT_HALF, SQRT_TWO_PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi)

_floats = types.Array(types.float64, 1, "C", readonly=True)
_ints = types.Array(types.int64, 1, "C", readonly=True)
_lines = types.Array(types.int32, 1, "C", readonly=True)
_words = types.Array(types.uint64, 1, "C", readonly=True)
_points = types.Array(types.float64, 2, "C", readonly=True)
_number, _count = types.float64, types.int64
_adc = types.NamedTuple(
    (_number, _count, _number, _floats, _count, _floats, _number, types.uint64, _floats), ConversionTables
)
_charges = types.NamedTuple((_floats, _floats, _floats, _floats, _floats, _number, types.boolean), ChargeDistributions)
_poisson_tables = types.NamedTuple(
    (types.Array(types.float64, 2, "C", readonly=True), types.Array(types.uint16, 2, "C", readonly=True)), PoissonTables
)
_transfer = types.NamedTuple((_floats, _floats, _floats, _floats, _number, _number), Transfer)
_quadrature = types.NamedUniTuple(_floats, 2, Quadrature)

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
    [types.void(_floats, index, index, _floats, types.int64, types.float64[::1]) for index in (_lines, _ints)],
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
    if nonlinearity > 0.0 and v > 0.0:
        v = (
            0.5 * v_sat_v * (1.0 - math.sqrt(1.0 - 4.0 * nonlinearity * v / v_sat_v)) / nonlinearity
            if v < v_sat_v * (1.0 - nonlinearity)
            else v / (1.0 - nonlinearity)
        )
    return (v - sense_v) / per_e


@njit([types.void(_floats, _lines, _adc, code[::1]) for code in (types.uint8, types.uint16)])
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
def _edgeworth_cdf(x, skewness):
    """Return the standardised Gaussian CDF with the first Edgeworth term (skewness)."""
    gaussian = 0.5 * math.erfc(-x * SQRT_HALF)
    if skewness == 0.0:
        return gaussian
    return gaussian - skewness / 6.0 * (x * x - 1.0) * math.exp(-0.5 * x * x) / SQRT_TWO_PI


@njit()
def _probability_below(q, nodes, weights, n_nodes, mean, deviation, third, well_e, sigma, half_step):
    """
    Return the probability that a charge plus readout noise is below ``q``.

    The charge distribution consists of ``n_nodes`` discrete values. For ``n_nodes = 0`` it is a Gaussian with Edgeworth
    correction, given by its mean, standard deviation and third central moment, and truncated at the full well. The readout
    noise is Gaussian with standard deviation ``sigma``, plus RTS noise of ``+half_step`` or ``-half_step``.
    """
    total = 0.0
    n_states = 2 if half_step > 0.0 else 1
    for state in range(n_states):
        at = q + half_step if state else q - half_step
        if n_nodes == 0:
            if sigma == 0.0 and at > well_e:
                total += 1.0
            else:
                spread = math.sqrt(deviation**2 + sigma**2)
                total += _edgeworth_cdf((at - mean) / spread, third / spread**3)
        else:
            for j in range(n_nodes):
                if sigma == 0.0:
                    total += weights[j] if nodes[j] < at - INTEGER_TOLERANCE else 0.0
                else:
                    total += weights[j] * 0.5 * math.erfc((nodes[j] - at) / sigma * SQRT_HALF)
    return total / n_states


@njit()
def _discretise_charge(mean, is_poisson, well_e, quadrature, nodes, weights):
    """
    Compute nodes and probabilities of a Poisson charge clipped at the full well.

    Returns the number of nodes. They are integers for ``is_poisson``; otherwise quadrature points of the Edgeworth series.
    """
    points, gauss = quadrature
    n = 0
    rest = 1.0
    if is_poisson:
        probability = math.exp(-mean)
        k = 0
        last = int(mean + MAX_DRAW_SIGMAS * math.sqrt(mean)) + MAX_DRAW_MARGIN_E
        while k <= last and k < well_e and n < nodes.size - 1:
            if probability > MIN_PROBABILITY:
                nodes[n], weights[n] = k, probability
                n += 1
            rest -= probability
            k += 1
            probability *= mean / k
        if k >= well_e:
            nodes[n], weights[n] = well_e, max(rest, 0.0)
            n += 1
        return n
    deviation = math.sqrt(mean)
    low, high = mean - RANGE_SIGMAS * deviation, min(well_e, mean + RANGE_SIGMAS * deviation)
    if high > low:
        for j in range(points.size):
            charge = low + 0.5 * (points[j] + 1.0) * (high - low)
            z = (charge - mean) / deviation
            nodes[n] = charge
            edgeworth = 1.0 + (z * z - 3.0) * z / (6.0 * deviation)
            weights[n] = 0.5 * (high - low) * gauss[j] * edgeworth * math.exp(-0.5 * z * z) / (deviation * SQRT_TWO_PI)
            rest -= weights[n]
            n += 1
    nodes[n], weights[n] = well_e, max(rest, 0.0)
    return n + 1


@njit(types.void(_charges, _transfer, _lines, _adc, _quadrature, types.float64[::1], types.float64[::1]))
def predict_codes(charges, transfer, line, adc, quadrature, mean_dn, variance_dn2):
    """
    Compute mean and variance of the code of each site.

    With ``charges.is_drawn``, charges are Poisson-distributed and clipped at the full well. Otherwise they are Gaussian with
    variance ``variance_e2``, or equal to their mean where the variance is 0.
    """
    nodes, weights = np.empty(MAX_NODES), np.empty(MAX_NODES)
    n_codes, nonlinearity = adc.n_codes, transfer.nonlinearity_fraction
    for i in range(charges.mean_e.size):
        mean, well = charges.mean_e[i], _value_of_site(charges.well_e, i)
        sigma, half_step = _value_of_site(charges.sigma_e, i), _value_of_site(charges.half_step_e, i)
        third = 0.0
        n_nodes = 0
        deviation = math.sqrt(_value_of_site(charges.variance_e2, i))
        if charges.is_drawn:
            deviation, third = math.sqrt(mean), mean
            if mean <= charges.poisson_below_e:
                n_nodes = _discretise_charge(mean, True, well, quadrature, nodes, weights)
            elif well < mean + RANGE_SIGMAS * deviation and sigma > 0.0:
                n_nodes = _discretise_charge(mean, False, well, quadrature, nodes, weights)
        elif deviation == 0.0:
            n_nodes = 1
            nodes[0], weights[0] = min(mean, well), 1.0
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
        reach = (
            RANGE_SIGMAS * math.sqrt(deviation**2 + sigma**2) + half_step + (MAX_DRAW_MARGIN_E if n_nodes > 1 else 1.0)
        )
        low, high = min(mean, well) - reach, min(mean, well) + reach
        first, last = _unquantised_code(low, site, adc), _unquantised_code(high, site, adc)
        # Closed form for a linear ADC where noise exceeds one code and nothing is clipped: quantisation lowers the mean by
        # 1/2 DN and adds a variance of 1/12 DN², to 1e-8.
        dn_per_e = site[0] * site[2] / adc.v_sat_v * n_codes
        smooth_dn = dn_per_e * (sigma if n_nodes > 0 else math.sqrt(deviation**2 + sigma**2))
        is_uniform = (
            adc.companding_index == ADC_LINEAR and adc.inl.size == 1 and adc.dnl_dn == 0.0 and nonlinearity == 0.0
        )
        if is_uniform and smooth_dn >= 1.0 and first > 0.0 and last < n_codes and mean + reach < well:
            offset_v = site[1] * site[2] + site[3]
            mean_dn[i] = mean * dn_per_e + offset_v / adc.v_sat_v * n_codes - 0.5
            variance_dn2[i] = (deviation**2 + sigma**2 + half_step**2) * dn_per_e**2 + 1.0 / 12.0
            continue
        k_first, k_last = max(math.floor(first) - 1, 0), min(math.floor(last) + 1, n_codes - 1)
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
                end = _charge_at_code(transition, site, adc)
                if k == k_last and (part == 1 or jump == 1.0):
                    end = np.inf
                if end <= at:
                    continue
                below = (
                    1.0
                    if end == np.inf
                    else _probability_below(
                        end, nodes, weights, n_nodes, mean, deviation, third, well, sigma, half_step
                    )
                )
                centre = 0.5 * (at + end) if end < np.inf else max(at, high) + 1.0
                code = _quantise_with_dnl(_unquantised_code(centre, site, adc), _value_of_site(line, i), adc)
                total += code * (below - cumulated)
                squares += code * code * (below - cumulated)
                at, cumulated = end, below
        mean_dn[i] = total
        variance_dn2[i] = max(squares - total * total, 0.0)
