"""
Fraunhofer integrals over pupils in polar coordinates, slow and independent of the package's quadrature.

The discontinuities of a pupil lie on circles around the axis and on straight lines. On each circle of radius r, the integrand
is analytic between the angles at which it crosses these lines; as a function of r, the integral over the angle is analytic
between the radii of the circles, the distances of the lines from the axis, and the radii at which two lines intersect.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from foveasim.optics import Annulus, Blades, PupilImage, Slit, Spider


def discontinuities(pupil):
    """Return radii, and lines ``x cos(a) + y sin(a) = d`` as (a, d), at which a pupil is discontinuous."""
    if isinstance(pupil, Annulus):
        return [pupil.obscuration], []
    if isinstance(pupil, Blades):
        angles = np.radians(pupil.angle_deg) + 2.0 * np.pi / pupil.n_blades * (np.arange(pupil.n_blades) + 0.5)
        return [], [(a, np.cos(np.pi / pupil.n_blades)) for a in angles]
    if isinstance(pupil, Slit):
        across = np.radians(pupil.angle_deg) + 0.5 * np.pi
        return [], [(across, pupil.width_fraction), (across, -pupil.width_fraction)]
    if isinstance(pupil, Spider):
        angles = np.radians(pupil.angle_deg) + 2.0 * np.pi / pupil.n_vanes * np.arange(pupil.n_vanes)
        sides = [(a + 0.5 * np.pi, s * pupil.width_fraction) for a in angles for s in (-1.0, 1.0)]
        return [], [*sides, *((a, 0.0) for a in angles)]
    assert isinstance(pupil, PupilImage)
    n = np.shape(pupil.picture)[0]
    grid = np.arange(1, n) * (2.0 / n) - 1.0
    return [], [(a, d) for a in (0.0, 0.5 * np.pi) for d in grid]


def pupil_nodes(pupils, n_radial=48, n_angular=16, width=0.15):
    """Return nodes x, y and weights of a quadrature over the unit disc, for discontinuities of the given pupils."""
    found = [discontinuities(pupil) for pupil in pupils]
    radii = [r for part, _ in found for r in part]
    lines = np.array([line for _, part in found for line in part] or np.zeros((0, 2))).reshape(-1, 2)
    normal, offset = np.stack((np.cos(lines[:, 0]), np.sin(lines[:, 0])), axis=1), lines[:, 1]
    i, j = np.triu_indices(len(lines), 1)
    cross = normal[i, 0] * normal[j, 1] - normal[i, 1] * normal[j, 0]
    i, j, cross = (part[np.abs(cross) > 1e-9] for part in (i, j, cross))
    corner_x = (offset[i] * normal[j, 1] - offset[j] * normal[i, 1]) / cross
    corner_y = (offset[j] * normal[i, 0] - offset[i] * normal[j, 0]) / cross
    breaks = np.concatenate(([0.0, 1.0], radii, np.abs(offset), np.hypot(corner_x, corner_y)))
    breaks = np.unique(np.round(breaks[breaks <= 1.0], 13))

    node, weight = np.polynomial.legendre.leggauss(n_radial)
    t = 0.5 * np.pi * node
    angular = np.polynomial.legendre.leggauss(n_angular)
    xs, ys, ws = [], [], []
    for low, high in pairwise(breaks):
        # Square roots at both ends become analytic.
        half = 0.5 * (high - low)
        for r, dr in zip(0.5 * (low + high) + half * np.sin(t), half * np.cos(t) * 0.5 * np.pi * weight, strict=True):
            reach = np.arccos(np.clip(offset / r, -1.0, 1.0))
            cuts = np.concatenate((lines[:, 0] - reach, lines[:, 0] + reach)) % (2.0 * np.pi)
            cuts = np.unique(np.concatenate((cuts, np.arange(0.0, 2.0 * np.pi, width), [2.0 * np.pi])))
            centre, half_arc = 0.5 * (cuts[1:] + cuts[:-1]), 0.5 * np.diff(cuts)
            angle = (centre[:, np.newaxis] + half_arc[:, np.newaxis] * angular[0]).ravel()
            xs.append(r * np.cos(angle))
            ys.append(r * np.sin(angle))
            ws.append((half_arc[:, np.newaxis] * angular[1]).ravel() * r * dr)
    return np.concatenate(xs), np.concatenate(ys), np.concatenate(ws)


def pupil_integrals(pupils, path_waves, points, wavelength_nm=550.0, **accuracy):
    """
    Return the PSF at points (x, y) in λN, times (λN)², and the Strehl ratio.

    ``path_waves`` is a function of x and y, or None.
    """
    x, y, weight = pupil_nodes(pupils, **accuracy)
    amplitude = weight * np.ones_like(x)
    power = weight.copy()
    for pupil in pupils:
        values = 1.0 * pupil(x, y, wavelength_nm)
        amplitude = amplitude * values
        power = power * np.abs(values) ** 2
    is_open = amplitude != 0.0
    x, y, amplitude = x[is_open], y[is_open], amplitude[is_open]
    phase = 2.0 * np.pi * path_waves(x, y) if path_waves is not None else 0.0
    wave = amplitude * np.exp(1j * phase)
    psf = np.array([np.abs(wave @ np.exp(-1j * np.pi * (px * x + py * y))) ** 2 for px, py in points])
    # Unit energy: the PSF of a pupil of area A in units of the squared radius is |sum|² / (4 A).
    return psf / (4.0 * power.sum()), float(np.abs(wave.sum()) ** 2 / np.abs(amplitude).sum() ** 2)
