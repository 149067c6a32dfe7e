"""
Numba kernels of the optics: relative illumination, padding, transfer functions.

The kernels operate on plain arrays and release the global interpreter lock. They are compiled for explicit types when this
module is imported; the machine code is cached on disk.
"""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit

__all__ = [
    "alias_sum",
    "alias_sum_plane",
    "apply_falloff",
    "multiply",
    "multiply_otf",
    "multiply_otf_plane",
    "replicate",
]

_floats = types.Array(types.float64, 1, "C", readonly=True)


@njit(
    [
        types.void(
            types.Array(cell, 2, "C", readonly=True),
            types.Array(real, 1, "C", readonly=True),
            types.Array(real, 1, "C", readonly=True),
            types.int64,
            types.Array(types.int64, 1, "C", readonly=True),
            types.int64,
            real[:, ::1],
        )
        for cell in (types.float32, types.float64)
        for real in (types.float32, types.float64)
    ],
    error_model="numpy",
)
def apply_falloff(rows, x2, y2, power, source_column, n_before, out):
    """
    Write rows of a picture times ``cos(theta) ** power``, padded on both sides.

    ``x2`` and ``y2`` are (x0/H)² of the picture columns and (y0/H)² of the rows, so that ``cos² = 1 / (1 + x2 + y2)``.
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
        for column in range(n_before):
            line[column] = inner[source_column[column]] if source_column[column] >= 0 else 0.0
        for column in range(n_before + n_x, line.size):
            line[column] = inner[source_column[column]] if source_column[column] >= 0 else 0.0


@njit(
    [
        types.void(
            types.Array(c, 2, "C", readonly=True),
            types.int64,
            types.Array(c, 1, "C", readonly=True),
            types.Array(c, 1, "C", readonly=True),
            types.int64,
            types.int64,
            c[:, ::1],
        )
        for c in (types.complex64, types.complex128)
    ],
)
def replicate(spectrum, n_columns, phase_x, phase_y, first_row, last_row, out):
    """
    Write rows of a periodically repeated spectrum, times a phase factor.

    The factor is ``phase_y[row] * phase_x[column]``. ``spectrum`` is the transform of ``n_columns`` real samples along x: its
    columns range from zero frequency to at most half a cycle per sample; the other half is its complex conjugate, mirrored.
    """
    n_rows = spectrum.shape[0]
    half = n_columns // 2
    for row in range(first_row, last_row):
        source = spectrum[row % n_rows]
        mirrored = spectrum[(n_rows - row % n_rows) % n_rows]
        for column in range(out.shape[1]):
            at = column % n_columns
            value = source[at] if at <= half else np.conj(mirrored[n_columns - at])
            out[row, column] = value * (phase_y[row] * phase_x[column])


@njit(
    [
        types.void(
            types.Array(c, 2, "C", readonly=True),
            types.Array(r, 1, "C", readonly=True),
            r,
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.boolean,
            types.int64,
            types.int64,
            c[:, ::1],
        )
        for c, r in ((types.complex64, types.float32), (types.complex128, types.float64))
    ],
)
def multiply_otf(spectrum, table, per_step, fx, fy, gain_x, gain_y, far_x, far_y, is_added, first_row, last_row, out):
    """
    Compute ``out = spectrum * H`` or ``out += spectrum * H`` over a range of rows.

    ``H`` is the sum of ``table(|f + k|) * gain_x[k] * gain_y[k]`` over the aliases ``k`` of each frequency, plus the sum of
    the products ``far_x[r] * far_y[r]``, a low-rank approximation of the remaining aliases. The table samples a radial
    function at equal steps, 0 beyond its end; ``per_step`` is the number of steps per unit of frequency. ``fx`` and
    ``gain_x`` are (n_alias, n_x), ``far_x`` is (n_rank, n_x), and likewise for y. ``out`` may be ``spectrum``.
    """
    n_alias, n_x = fx.shape
    last = table.size - 1
    h = np.empty(n_x, table.dtype)
    for row in range(first_row, last_row):
        h[:] = 0.0
        for r in range(far_x.shape[0]):
            for ix in range(n_x):
                h[ix] += far_x[r, ix] * far_y[r, row]
        for ky in range(n_alias):
            v = fy[ky, row] * per_step
            if abs(v) >= last:
                continue
            for kx in range(n_alias):
                for ix in range(n_x):
                    u = fx[kx, ix] * per_step
                    r = np.sqrt(u * u + v * v)
                    i = int(min(r, table.dtype.type(last)))
                    t = r - i
                    a = table[i]
                    b = table[min(i + 1, last)]
                    h[ix] += (a + t * (b - a)) * gain_x[kx, ix] * gain_y[ky, row] if i < last else table.dtype.type(0.0)
        if is_added:
            for ix in range(n_x):
                out[row, ix] += spectrum[row, ix] * h[ix]
        else:
            for ix in range(n_x):
                out[row, ix] = spectrum[row, ix] * h[ix]


@njit(
    [
        types.void(
            types.Array(c, 2, "C", readonly=True),
            types.Array(h, 2, "C", readonly=True),
            types.boolean,
            types.int64,
            types.int64,
            c[:, ::1],
        )
        for c, h in (
            (types.complex64, types.float32),
            (types.complex128, types.float64),
            (types.complex64, types.complex64),
            (types.complex128, types.complex128),
        )
    ],
)
def multiply(spectrum, factor, is_added, first_row, last_row, out):
    """
    Compute ``out = spectrum * factor`` or ``out += spectrum * factor`` for some rows.

    The order of operations is that of :func:`multiply_otf`, so that results are bit-identical.
    """
    for row in range(first_row, last_row):
        if is_added:
            for ix in range(spectrum.shape[1]):
                out[row, ix] += spectrum[row, ix] * factor[row, ix]
        else:
            for ix in range(spectrum.shape[1]):
                out[row, ix] = spectrum[row, ix] * factor[row, ix]


@njit(inline="always")
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
            types.Array(c, 2, "C", readonly=True),
            types.Array(c, 2, "C", readonly=True),
            r,
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(r, 2, "C", readonly=True),
            types.Array(c, 2, "C", readonly=True),
            types.Array(c, 2, "C", readonly=True),
            types.boolean,
            types.int64,
            types.int64,
            c[:, ::1],
        )
        for c, r in ((types.complex64, types.float32), (types.complex128, types.float64))
    ],
)
def multiply_otf_plane(
    spectrum, table, per_step, fx, fy, gain_x, gain_y, far_x, far_y, is_added, first_row, last_row, out
):
    """Compute :func:`multiply_otf` for a square complex table over (f_y, f_x)."""
    n_alias, n_x = fx.shape
    half = table.shape[0] // 2
    h = np.empty(n_x, table.dtype)
    for row in range(first_row, last_row):
        h[:] = 0.0
        for r in range(far_x.shape[0]):
            for ix in range(n_x):
                h[ix] += far_x[r, ix] * far_y[r, row]
        for ky in range(n_alias):
            v = fy[ky, row] * per_step
            if abs(v) >= half:
                continue
            for kx in range(n_alias):
                for ix in range(n_x):
                    h[ix] += _interpolate_plane(table, fx[kx, ix] * per_step, v) * (gain_x[kx, ix] * gain_y[ky, row])
        if is_added:
            for ix in range(n_x):
                out[row, ix] += spectrum[row, ix] * h[ix]
        else:
            for ix in range(n_x):
                out[row, ix] = spectrum[row, ix] * h[ix]


@njit(inline="always")
def _alias_gain(cycles, k, source_cells, is_alternating):
    """
    Return ``sinc(f) * sinc(source_cells * f)`` for ``f = cycles + k``, (n_alias, n).

    ``source_cells`` is the side of the source pixels in cells, 0 for points. ``is_alternating`` negates odd aliases.
    """
    gain = np.empty((k.size, cycles.size))
    for a in range(k.size):
        sign = -1.0 if is_alternating and k[a] % 2 else 1.0
        for i in range(cycles.size):
            f = cycles[i] + k[a]
            gain[a, i] = sign * np.sinc(f) * np.sinc(source_cells * f)
    return gain


@njit(
    types.complex128[:, ::1](
        types.Array(types.complex128, 2, "C", readonly=True),
        types.float64,
        _floats,
        types.int64,
        types.float64,
        types.boolean,
    ),
)
def alias_sum_plane(table, per_step, cycles, n_alias, source_cells, is_alternating):
    """Compute :func:`alias_sum` for a square complex table over (f_y, f_x)."""
    n = cycles.size
    k = np.arange(-n_alias, n_alias + 1)
    gain = _alias_gain(cycles, k, source_cells, is_alternating)
    total = np.zeros((n, n), np.complex128)
    for a in range(k.size):
        for b in range(k.size):
            if k[a] == 0 and k[b] == 0:
                continue
            for i in range(n):
                v = (cycles[i] + k[a]) * per_step
                for j in range(n):
                    total[i, j] += gain[a, i] * gain[b, j] * _interpolate_plane(table, (cycles[j] + k[b]) * per_step, v)
    return total


@njit(
    types.float64[:, ::1](
        types.Array(types.float64, 1, "C", readonly=True),
        types.float64,
        _floats,
        types.int64,
        types.float64,
        types.boolean,
    ),
)
def alias_sum(table, per_step, cycles, n_alias, source_cells, is_alternating):
    """
    Sum a radial table over all aliases except ``k = 0``.

    The terms are ``table(|f + k|) * gain(f_x + k_x) * gain(f_y + k_y)`` with the factors of :func:`_alias_gain`, evaluated at
    the frequencies ``cycles`` x ``cycles`` in cycles per cell; ``per_step`` is the number of table steps per cycle per cell.
    """
    n = cycles.size
    last = table.size - 1
    k = np.arange(-n_alias, n_alias + 1)
    gain = _alias_gain(cycles, k, source_cells, is_alternating)
    total = np.zeros((n, n))
    for a in range(k.size):
        for b in range(k.size):
            if k[a] == 0 and k[b] == 0:
                continue
            for i in range(n):
                v = (cycles[i] + k[a]) * per_step
                for j in range(n):
                    u = (cycles[j] + k[b]) * per_step
                    r = np.sqrt(u * u + v * v)
                    if r < last:
                        at = int(r)
                        total[i, j] += gain[a, i] * gain[b, j] * (table[at] + (r - at) * (table[at + 1] - table[at]))
    return total
