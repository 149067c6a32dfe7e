"""Numba kernels of the metrics: Fourier transforms of polygons."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, INTS

#: Angle (rad) below which the truncated series of sin(v)/v - 1 is exact to float64.
SERIES_BELOW = 1e-2
#: Phase (rad) across a site below which the normalised transform is 1.
MIN_PHASE = 1e-140


@njit()
def _sinc_less_one(v):
    """Compute sin(v) / v - 1 without cancellation."""
    if abs(v) < SERIES_BELOW:
        v2 = v * v
        return -v2 / 6.0 * (1.0 - v2 / 20.0 * (1.0 - v2 / 42.0 * (1.0 - v2 / 72.0)))
    return np.sin(v) / v - 1.0


@njit(types.complex128[:, ::1](FLOATS_2D, INTS, INTS, FLOATS_2D, FLOATS, FLOATS_2D))
def polygon_transforms(xy, ring_offsets, site_offsets, centre, area, wave):
    """
    Compute the mean of exp(-i k·(x - centre)) over each site, (n_site, n_wave).

    ``wave`` contains vectors k in rad per unit of length. By Green's theorem the integral is ``(i/k²) Σ (k × e) exp(-i k·m)
    sin(v)/v`` over edges e with midpoints m and ``v = k·e/2``. The sum of ``k × e`` around a ring is 0, so 1 can be
    subtracted from each factor. The differences are small for small k, which avoids cancellation near k = 0.
    """
    out = np.empty((site_offsets.size - 1, wave.shape[0]), np.complex128)
    for site in range(site_offsets.size - 1):
        first, last = ring_offsets[site_offsets[site]], ring_offsets[site_offsets[site + 1]]
        size = 0.0
        for j in range(first, last):
            size = max(size, abs(xy[j, 0] - centre[site, 0]), abs(xy[j, 1] - centre[site, 1]))
        for w in range(wave.shape[0]):
            kx, ky = wave[w, 0], wave[w, 1]
            k = np.hypot(kx, ky)
            if k * size < MIN_PHASE:
                out[site, w] = 1.0
                continue
            nx, ny = kx / k, ky / k
            real, imag = 0.0, 0.0
            for ring in range(site_offsets[site], site_offsets[site + 1]):
                stop = ring_offsets[ring + 1]
                ax, ay = xy[stop - 1, 0] - centre[site, 0], xy[stop - 1, 1] - centre[site, 1]
                for j in range(ring_offsets[ring], stop):
                    bx, by = xy[j, 0] - centre[site, 0], xy[j, 1] - centre[site, 1]
                    cross = nx * (by - ay) - ny * (bx - ax)
                    u = 0.5 * (kx * (ax + bx) + ky * (ay + by))
                    less = _sinc_less_one(0.5 * (kx * (bx - ax) + ky * (by - ay)))
                    half = np.sin(0.5 * u)
                    real += cross * np.sin(u) * (1.0 + less)
                    imag += cross * (less - 2.0 * half * half * (1.0 + less))
                    ax, ay = bx, by
            out[site, w] = complex(real, imag) / (k * area[site])
    return out
