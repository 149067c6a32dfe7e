"""Numba kernels of the information: covariances of site means, spectra in rings."""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, FLOATS_3D, INTS, INTS_2D

#: Distance, in standard deviations, beyond which a Gaussian is 0: exp(-21) = 7e-10.
REACH_SIGMAS = 6.5


@njit(types.float64[:, ::1](INTS_2D, FLOATS_2D, FLOATS_2D, types.int64))
def ring_sums(ring, y, x, n_rings):
    """
    Sum products y[i, k] x[j, k] over the elements (i, j) of each ring, (n_ring, n_k).

    ``ring[i, j]`` is -1 for elements outside all rings.
    """
    n_k = y.shape[1]
    out = np.zeros((n_rings, n_k))
    for i in range(ring.shape[0]):
        for j in range(ring.shape[1]):
            r = ring[i, j]
            if r >= 0:
                for k in range(n_k):
                    out[r, k] += y[i, k] * x[j, k]
    return out


@njit(types.float64[:, ::1](INTS, FLOATS_2D, FLOATS_3D, FLOATS_2D, INTS_2D, FLOATS_2D, FLOATS, FLOATS))
def signal_covariance(members, centre, axes, spread, order, nodes, amplitude, sigma):
    """
    Compute the covariances of the means over sites, (n_member, n_member).

    A site is ``order[site, k]``² equal Gaussians for component k. They have the second moments of the site times
    ``spread[site, order - 1]``, and are centred on ``nodes[order - 1]`` along the principal ``axes`` of the site, whose lengths
    are its standard deviations.
    """
    n = members.size
    out = np.zeros((n, n))
    limit = REACH_SIGMAS * REACH_SIGMAS
    for a in range(n):
        i = members[a]
        for b in range(a + 1):
            j = members[b]
            dx, dy = centre[j, 0] - centre[i, 0], centre[j, 1] - centre[i, 1]
            distance = math.hypot(dx, dy)
            total = 0.0
            for k in range(sigma.size):
                qi, qj = order[i, k], order[j, k]
                ci, cj = spread[i, qi - 1], spread[j, qj - 1]
                xx = sigma[k] * sigma[k] + ci * (axes[i, 0, 0] ** 2 + axes[i, 1, 0] ** 2)
                yy = sigma[k] * sigma[k] + ci * (axes[i, 0, 1] ** 2 + axes[i, 1, 1] ** 2)
                xy = ci * (axes[i, 0, 0] * axes[i, 0, 1] + axes[i, 1, 0] * axes[i, 1, 1])
                xx += cj * (axes[j, 0, 0] ** 2 + axes[j, 1, 0] ** 2)
                yy += cj * (axes[j, 0, 1] ** 2 + axes[j, 1, 1] ** 2)
                xy += cj * (axes[j, 0, 0] * axes[j, 0, 1] + axes[j, 1, 0] * axes[j, 1, 1])
                si, sj = math.sqrt(max(0.0, 1.0 - ci)), math.sqrt(max(0.0, 1.0 - cj))
                extent = si * nodes[qi - 1, qi - 1] * (math.hypot(axes[i, 0, 0], axes[i, 0, 1]))
                extent += si * nodes[qi - 1, qi - 1] * (math.hypot(axes[i, 1, 0], axes[i, 1, 1]))
                extent += sj * nodes[qj - 1, qj - 1] * (math.hypot(axes[j, 0, 0], axes[j, 0, 1]))
                extent += sj * nodes[qj - 1, qj - 1] * (math.hypot(axes[j, 1, 0], axes[j, 1, 1]))
                if distance > extent + REACH_SIGMAS * math.sqrt(max(xx, yy) + abs(xy)):
                    continue
                det = xx * yy - xy * xy
                part = 0.0
                for p in range(qi):
                    for q in range(qi):
                        ux = dx - si * (nodes[qi - 1, p] * axes[i, 0, 0] + nodes[qi - 1, q] * axes[i, 1, 0])
                        uy = dy - si * (nodes[qi - 1, p] * axes[i, 0, 1] + nodes[qi - 1, q] * axes[i, 1, 1])
                        for r in range(qj):
                            for s in range(qj):
                                vx = ux + sj * (nodes[qj - 1, r] * axes[j, 0, 0] + nodes[qj - 1, s] * axes[j, 1, 0])
                                vy = uy + sj * (nodes[qj - 1, r] * axes[j, 0, 1] + nodes[qj - 1, s] * axes[j, 1, 1])
                                form = (yy * vx * vx - 2.0 * xy * vx * vy + xx * vy * vy) / det
                                if form < limit:
                                    part += math.exp(-0.5 * form)
                total += amplitude[k] * sigma[k] * sigma[k] / math.sqrt(det) * part / (qi * qi * qj * qj)
            out[a, b] = total
            out[b, a] = total
    return out
