"""
Numba kernels of the optics: relative illumination, padding, transfer functions.

The kernels operate on plain arrays and release the global interpreter lock.
"""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, INTS, INTS_2D, array_of

#: Columns per pass of a transposition: a cache line of complex64.
COLUMNS_TOGETHER = 8
#: Terms of a cubic spline at a point.
TERMS_TOGETHER = 4


@njit()
def _weigh(line, factors, profiles):
    """
    Multiply a row of a picture by ``factors @ profiles``, (n,) and (n, n_x).

    The nonzero factors are within :data:`TERMS_TOGETHER` in succession.
    """
    n = factors.size
    first = 0
    while first < n - 1 and factors[first] == 0.0:
        first += 1
    first = max(0, min(first, n - TERMS_TOGETHER))
    if n >= TERMS_TOGETHER:
        a, b, c, d = factors[first], factors[first + 1], factors[first + 2], factors[first + 3]
        p, q, r, s = profiles[first], profiles[first + 1], profiles[first + 2], profiles[first + 3]
        for ix in range(line.size):
            line[ix] *= (a * p[ix] + b * q[ix]) + (c * r[ix] + d * s[ix])
    else:
        for ix in range(line.size):
            total = factors[0] * profiles[0, ix]
            for i in range(1, n):
                total += factors[i] * profiles[i, ix]
            line[ix] *= total


@njit(
    [
        types.void(
            array_of(cell, 2),
            array_of(real),
            array_of(real),
            types.int64,
            array_of(real, 3),
            array_of(real, 3),
            INTS,
            types.int64,
            real[:, ::1],
        )
        for cell in (types.float32, types.float64)
        for real in (types.float32, types.float64)
    ],
)
def apply_falloff(rows, x2, y2, power, along_y, profiles, source_column, n_before, out):
    """
    Write rows of a picture times ``cos(theta) ** power`` and functions, padded.

    ``x2`` and ``y2`` are (x0/H)² of the picture columns and (y0/H)² of the rows, so that ``cos² = 1 / (1 + x2 + y2)``. The
    functions are ``along_y[k] @ profiles[k]``, (n_function, n_row, n) and (n_function, n, n_x).
    ``source_column`` contains the picture column of each column of ``out``, -1 for zero. Picture column 0 is written to
    column ``n_before``.
    """
    n_x = rows.shape[1]
    one = x2.dtype.type(1.0)
    for row in range(out.shape[0]):
        source = rows[row]
        line = out[row]
        inner = line[n_before : n_before + n_x]
        base = one + y2[row]
        if power == 4:
            for ix in range(n_x):
                cos2 = one / (base + x2[ix])
                inner[ix] = source[ix] * (cos2 * cos2)
        else:
            for ix in range(n_x):
                cos2 = one / (base + x2[ix])
                inner[ix] = source[ix] * (cos2 * np.sqrt(cos2))
        for k in range(along_y.shape[0]):
            _weigh(inner, along_y[k, row], profiles[k])
        for column in range(n_before):
            line[column] = inner[source_column[column]] if source_column[column] >= 0 else 0.0
        for column in range(n_before + n_x, line.size):
            line[column] = inner[source_column[column]] if source_column[column] >= 0 else 0.0


_PAIRS = ((types.complex64, types.float32), (types.complex128, types.float64))


@njit([types.void(array_of(c, 2), types.int64, c[:, ::1]) for c, _ in _PAIRS])
def store_rows(rows, first, lines):
    """
    Write rows ``first, first + 1, ...`` of a spectrum to its columns, ``lines``.

    Columns of ``rows`` beyond those of the spectrum are omitted.
    """
    for begin in range(0, lines.shape[0], COLUMNS_TOGETHER):
        for row in range(rows.shape[0]):
            for column in range(begin, min(begin + COLUMNS_TOGETHER, lines.shape[0])):
                lines[column, first + row] = rows[row, column]


@njit([types.void(array_of(c, 2), types.int64, c[:, ::1]) for c, _ in _PAIRS])
def load_rows(lines, first, rows):
    """Read rows of a spectrum from its columns: the inverse of :func:`store_rows`."""
    for begin in range(0, lines.shape[0], COLUMNS_TOGETHER):
        for row in range(rows.shape[0]):
            for column in range(begin, min(begin + COLUMNS_TOGETHER, lines.shape[0])):
                rows[row, column] = lines[column, first + row]


@njit([types.void(INTS, types.int64, types.int64, c[:, ::1]) for c, _ in _PAIRS])
def pad_lines(source_row, n_before, n_rows, lines):
    """
    Write the padding of columns before and after their picture rows.

    The picture rows are ``n_before`` to ``n_before + n_rows``. ``source_row`` contains the picture row of each row, -1 for
    zero.
    """
    for column in range(lines.shape[0]):
        line = lines[column]
        for row in range(n_before):
            line[row] = line[n_before + source_row[row]] if source_row[row] >= 0 else 0.0
        for row in range(n_before + n_rows, line.size):
            line[row] = line[n_before + source_row[row]] if source_row[row] >= 0 else 0.0


@njit(
    [
        types.void(array_of(real, 3), INTS, INTS_2D, array_of(real, 2), real[:, :, ::1])
        for real in (types.float32, types.float64)
    ]
)
def pad_pictures(pictures, source_row, runs, window, out):
    """
    Write padded pictures (n, n_row, n_column), times a window (n_row, n_column).

    ``source_row`` contains the picture row of each row. ``runs`` are the columns: the first picture column, the number and the
    step, 1, -1 or 0, of each run.
    """
    for picture in range(out.shape[0]):
        for row in range(out.shape[1]):
            source, line, begin = pictures[picture, source_row[row]], out[picture, row], 0
            for run in range(runs.shape[0]):
                first, n, step = runs[run]
                target, weight = line[begin : begin + n], window[row, begin : begin + n]
                if step == 1:
                    values = source[first : first + n]
                    for k in range(n):
                        target[k] = values[k] * weight[k]
                elif step == -1:
                    values, last = source[first - n + 1 : first + 1], np.uint64(n - 1)
                    for k in range(n):  # unsigned indices: none is counted from the end
                        target[k] = values[last - np.uint64(k)] * weight[k]
                else:
                    for k in range(n):
                        target[k] = source[first] * weight[k]
                begin += n


@njit([types.void(array_of(c, 2), types.int64, array_of(c), array_of(c), types.int64, c[:, ::1]) for c, _ in _PAIRS])
def replicate(lines, n_columns, phase_x, phase_y, first, out):
    """
    Write columns of a periodically repeated spectrum, times a phase factor.

    The columns are ``first, first + 1, ...``; the factor is ``phase_y[row] * phase_x[column]``. ``lines`` are columns of
    the transform of ``n_columns`` real samples along x, from zero frequency to at most half a cycle per sample; the other
    half is its complex conjugate, mirrored.
    """
    n_rows = lines.shape[1]
    for column in range(out.shape[0]):
        at = (first + column) % n_columns
        is_mirrored = at > n_columns // 2
        line = lines[n_columns - at if is_mirrored else at]
        for begin in range(0, out.shape[1], n_rows):
            for row in range(n_rows):
                value = np.conj(line[(n_rows - row) % n_rows]) if is_mirrored else line[row]
                out[column, begin + row] = value * (phase_y[begin + row] * phase_x[first + column])


@njit()
def _count_below(values, row, limit):
    """Return the number of values below a limit in a row, which is ascending."""
    low, high = 0, values.shape[1]
    while low < high:
        middle = (low + high) // 2
        if values[row, middle] < limit:
            low = middle + 1
        else:
            high = middle
    return low


@njit(
    [
        types.void(
            array_of(r),
            r,
            array_of(r, 2),
            array_of(r, 2),
            array_of(r, 2),
            array_of(r, 2),
            array_of(r, 2),
            array_of(r, 2),
            types.int64,
            r[:, ::1],
        )
        for _, r in _PAIRS
    ],
)
def radial_factor(table, per_step, fx, fy, gain_x, gain_y, far_x, far_y, first, out):
    """
    Compute columns of the transfer function H from a radial table.

    The columns are ``first, first + 1, ...``. ``H`` is the sum of ``table(|f + k|) * gain_x[k] * gain_y[k]`` over the
    aliases ``k`` of each frequency, plus the sum of the products ``far_x[r] * far_y[r]``, a low-rank approximation of the
    remaining aliases. The table samples a radial function at equal steps, 0 beyond its end; ``per_step`` is the number of
    steps per unit of frequency. ``fx`` and ``gain_x`` are (n_alias, n_x), ``far_x`` is (n_rank, n_x), and likewise for y.
    Each row of ``fy`` is ascending.
    """
    last = table.dtype.type(table.size - 1)
    for column in range(out.shape[0]):
        ix = first + column
        h = out[column]
        h[:] = 0.0
        for r in range(far_x.shape[0]):
            for iy in range(h.size):
                h[iy] += far_x[r, ix] * far_y[r, iy]
        for kx in range(fx.shape[0]):
            u = fx[kx, ix] * per_step
            if abs(u) >= last:
                continue
            reach = np.sqrt((last - u) * (last + u)) / per_step
            for ky in range(fy.shape[0]):
                for iy in range(_count_below(fy, ky, -reach), _count_below(fy, ky, reach)):
                    v = fy[ky, iy] * per_step
                    s = np.sqrt(u * u + v * v)
                    i = min(np.int32(s), np.int32(table.size - 2))
                    t = s - table.dtype.type(i)
                    a = table[i]
                    h[iy] += (a + t * (table[i + 1] - a)) * (gain_x[kx, ix] * gain_y[ky, iy])


@njit()
def _interpolate_plane(table, u, v):
    """
    Interpolate a table over (f_y, f_x) bilinearly; 0 outside.

    ``u`` and ``v`` are in steps of the table, whose centre is zero frequency.
    """
    half = table.shape[0] // 2
    u += half
    v += half
    last = table.shape[0] - 1
    if u < 0 or v < 0 or u >= last or v >= last:
        return table.dtype.type(0.0)
    i = int(u)
    j = int(v)
    u -= i
    v -= j
    low = table[j, i] + u * (table[j, i + 1] - table[j, i])
    high = table[j + 1, i] + u * (table[j + 1, i + 1] - table[j + 1, i])
    return low + v * (high - low)


@njit(
    [
        types.void(
            array_of(c, 2),
            r,
            array_of(r, 2),
            array_of(r, 2),
            array_of(r, 2),
            array_of(r, 2),
            array_of(c, 2),
            array_of(c, 2),
            types.int64,
            c[:, ::1],
        )
        for c, r in _PAIRS
    ],
)
def plane_factor(table, per_step, fx, fy, gain_x, gain_y, far_x, far_y, first, out):
    """Compute :func:`radial_factor` for a square complex table over (f_x, f_y)."""
    half = table.shape[0] // 2
    for column in range(out.shape[0]):
        ix = first + column
        h = out[column]
        h[:] = 0.0
        for r in range(far_x.shape[0]):
            for iy in range(h.size):
                h[iy] += far_x[r, ix] * far_y[r, iy]
        for kx in range(fx.shape[0]):
            u = fx[kx, ix] * per_step
            if abs(u) >= half:
                continue
            for ky in range(fy.shape[0]):
                for iy in range(h.size):
                    v = fy[ky, iy] * per_step
                    if abs(v) < half:
                        h[iy] += _interpolate_plane(table, v, u) * (gain_x[kx, ix] * gain_y[ky, iy])


@njit()
def _add_product(line, factor, size, is_first, total):
    """
    Add a column of a spectrum times ``size * factor``.

    Of an even factor, only the rows of frequencies >= 0 are stored.
    """
    n_half = factor.size
    n_mirrored = line.size - n_half
    if is_first:
        for iy in range(n_half):
            total[iy] = line[iy] * (size * factor[iy])
        for iy in range(n_mirrored):
            total[n_half + iy] = line[n_half + iy] * (size * factor[n_mirrored - iy])
    else:
        for iy in range(n_half):
            total[iy] += line[iy] * (size * factor[iy])
        for iy in range(n_mirrored):
            total[n_half + iy] += line[n_half + iy] * (size * factor[n_mirrored - iy])


@njit(
    [
        types.void(array_of(c, 3), array_of(h, 3), array_of(r, 3), types.int64, types.boolean, c[:, :, ::1])
        for c, r in _PAIRS
        for h in (r, c)
    ],
)
def filter_and_sum(lines, factors, coefficients, first, is_added, out):
    """
    Compute weighted sums of spectra times transfer functions, or add them to ``out``.

    The sums are ``out[c] = sum_br coefficients[c, b, r] * factors[r] * lines[b]``. ``lines`` and ``factors`` are the
    columns ``first, first + 1, ...`` of spectra and transfer functions. A transfer function that is even along y has only
    the rows of frequencies >= 0. ``out`` may be ``lines``, if both are one complete spectrum.
    """
    n_outputs, n_basis, n_factors = coefficients.shape
    one = coefficients.dtype.type(1.0)
    h = np.empty(factors.shape[2], factors.dtype)
    for column in range(lines.shape[1]):
        for c in range(n_outputs):
            is_first = not is_added
            total = out[c, first + column]
            for b in range(n_basis):
                n_needed, only = 0, 0
                for r in range(n_factors):
                    if coefficients[c, b, r] != 0.0:
                        n_needed, only = n_needed + 1, r
                if n_needed == 0:
                    continue
                if n_needed == 1:
                    _add_product(lines[b, column], factors[only, column], coefficients[c, b, only], is_first, total)
                else:
                    h[:] = 0.0
                    for r in range(n_factors):
                        size, factor = coefficients[c, b, r], factors[r, column]
                        if size != 0.0:
                            for iy in range(h.size):
                                h[iy] += size * factor[iy]
                    _add_product(lines[b, column], h, one, is_first, total)
                is_first = False
            if is_first:
                total[:] = 0.0


@njit([types.void(array_of(r), INTS, INTS, r[::1]) for _, r in _PAIRS])
def copy_pixels(values, source, target, out):
    """Write ``out[target] = values[source]``."""
    for k in range(target.size):
        out[target[k]] = values[source[k]]


@njit([types.void(r, INTS, r[::1]) for _, r in _PAIRS])
def fill_pixels(value, target, out):
    """Write ``out[target] = value``."""
    for k in range(target.size):
        out[target[k]] = value


@njit([types.boolean(r[:, ::1], r[:, ::1], r, r[:, ::1], r[:, ::1]) for _, r in _PAIRS])
def add_layer(share, light, scale, total, left):
    """
    Add rows of a layer to a map, and fill what nearer layers have left of the pupil.

    ``share`` times ``scale`` is the part of the pupil that the layer would fill alone, and ``light`` its irradiance then. A
    share within what is left keeps its light as it is, rounding errors included, which conserves energy. Returns whether
    nothing is left in any cell.
    """
    is_filled = True
    for iy in range(total.shape[0]):
        for ix in range(total.shape[1]):
            alone, room, value = share[iy, ix] * scale, left[iy, ix], light[iy, ix]
            if alone > room:
                total[iy, ix] += value * (room / alone)
                left[iy, ix] = room - room
            else:
                total[iy, ix] += value
                left[iy, ix] = room - alone
                is_filled &= room == alone
    return is_filled


@njit(
    types.void(
        array_of(types.complex128, 2),
        types.float64,
        FLOATS,
        INTS,
        FLOATS_2D,
        types.complex128[:, ::1],
    ),
)
def add_plane_aliases(table, per_step, cycles, k, gain, total):
    """Compute :func:`add_aliases` for a square complex table over (f_y, f_x)."""
    for a in range(k.size):
        for b in range(k.size):
            if k[a] == 0 and k[b] == 0:
                continue
            for i in range(cycles.size):
                v = (cycles[i] + k[a]) * per_step
                for j in range(cycles.size):
                    total[i, j] += gain[a, i] * gain[b, j] * _interpolate_plane(table, (cycles[j] + k[b]) * per_step, v)


@njit(types.void(FLOATS, types.float64, FLOATS, INTS, FLOATS_2D, types.float64[:, ::1]))
def add_aliases(table, per_step, cycles, k, gain, total):
    """
    Add a radial table at all aliases except ``k = 0``.

    The terms are ``table(|f + k|) * gain(f_x + k_x) * gain(f_y + k_y)`` at the frequencies ``cycles`` x ``cycles`` in cycles
    per cell; ``per_step`` is the number of table steps per cycle per cell, and ``gain`` is (n_alias, n_frequency).
    """
    last = table.size - 1
    for a in range(k.size):
        for b in range(k.size):
            if k[a] == 0 and k[b] == 0:
                continue
            for i in range(cycles.size):
                v = (cycles[i] + k[a]) * per_step
                for j in range(cycles.size):
                    u = (cycles[j] + k[b]) * per_step
                    r = np.sqrt(u * u + v * v)
                    if r < last:
                        at = np.int64(r)
                        total[i, j] += gain[a, i] * gain[b, j] * (table[at] + (r - at) * (table[at + 1] - table[at]))
