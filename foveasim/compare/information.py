"""
Information in the readings of a sensor about its scenes, by a Gaussian model.

The mutual information is ``I = H(Y) - H(Y | X)`` for readings Y and scenes X. With Gaussian scenes and noise it has a closed
form; for other scenes, the entropy of a Gaussian of the same covariance is an upper bound of H(Y).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError
from foveasim.layout import Layout

__all__ = ["SceneCovariance", "gaussian_information_bits", "scene_covariance", "site_information_bits"]

#: Preceding sites on which a site is conditioned, and neighbours among which they are searched.
N_CONDITIONS, N_CANDIDATES = 14, 44
#: Matrix elements that are computed at a time; limits the memory.
BLOCK_ELEMENTS = 1 << 21
#: Ratio of the widths of adjacent Gaussian components of a covariance.
WIDTH_RATIO = 1.5
#: Largest distance of the covariance as a fraction of the field, beyond which too few pairs contribute.
MAX_DISTANCE_FRACTION = 0.4


def gaussian_information_bits(
    signal_covariance: ArrayLike,
    noise_variance: ArrayLike | None = None,
    *,
    noise_covariance: ArrayLike | None = None,
) -> float:
    """
    Compute the information of readings about scenes by a Gaussian model.

    Parameters
    ----------
    signal_covariance : (n, n)
        Covariance of the expected readings over the scenes.
    noise_variance : (n,) or (n_scene, n)
        Noise variance of each reading; for noise that depends on the scene, in a sample of scenes.
    noise_covariance : (n, n), optional
        Instead of the variances: covariance of correlated noise.

    Returns
    -------
    information : float, bit

    Raises
    ------
    ParameterError
        When shapes do not match, a covariance is not positive definite, or not exactly one kind of noise is given.

    Notes
    -----
    ``½ log₂ det Σ_Y - ½ mean_x log₂ det Σ_{Y|x}`` with ``Σ_Y`` the sum of the signal covariance and the mean noise covariance.
    For noise that does not depend on the scene, this is ``½ log₂ det(1 + D^{-½} S D^{-½})``, which does not change with any
    invertible map of the readings.

    Examples
    --------
    >>> gaussian_information_bits([[3.0]], [1.0])
    1.0
    """
    signal = finite_array("signal_covariance", signal_covariance, ndim=2)
    n = signal.shape[0]
    if signal.shape != (n, n):
        raise ParameterError("signal_covariance", "must be square", list(signal.shape))
    if (noise_variance is None) == (noise_covariance is None):
        raise ParameterError("noise_variance", "or 'noise_covariance' must be given, but only one of them")
    if noise_variance is None:
        assert noise_covariance is not None
        noise = finite_array("noise_covariance", noise_covariance, ndim=2)
        if noise.shape != (n, n):
            raise ParameterError("noise_covariance", f"must have the shape {(n, n)}", list(noise.shape))
        conditional = _log2_det("noise_covariance", noise)
    else:
        variances = np.atleast_2d(finite_array("noise_variance", noise_variance, above=0.0))
        if variances.ndim != 2 or variances.shape[1] != n:
            raise ParameterError(
                "noise_variance", f"must have the shape ({n},) or (n_scene, {n})", list(variances.shape)
            )
        noise = np.diag(variances.mean(axis=0))
        conditional = float(np.log2(variances).sum(axis=1).mean())
    return 0.5 * (_log2_det("signal_covariance", signal + noise) - conditional)


def _log2_det(name: str, matrix: NDArray[np.float64]) -> float:
    try:
        root = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ParameterError(name, "must be positive definite together with the noise") from None
    return 2.0 * float(np.log2(np.diagonal(root)).sum())


class SceneCovariance:
    """
    Isotropic covariance of irradiance, a sum of Gaussians ``Σ a_k exp(-d² / 2 σ_k²)``.

    Parameters
    ----------
    amplitude : (n_component,)
        a_k >= 0, in squared units of the irradiance.
    sigma_um : (n_component,), µm
    """

    def __init__(self, amplitude: ArrayLike, sigma_um: ArrayLike) -> None:
        self.amplitude, self.sigma_um = np.asarray(amplitude, np.float64), np.asarray(sigma_um, np.float64)

    def __repr__(self) -> str:
        return f"SceneCovariance({self.amplitude.size} Gaussians)"

    def at(self, distance_um: ArrayLike) -> Floats:
        """Return the covariance of two points at a distance in µm."""
        d2 = np.square(np.asarray(distance_um, np.float64))[..., np.newaxis]
        return np.asarray((self.amplitude * np.exp(-0.5 * d2 / self.sigma_um**2)).sum(axis=-1))

    def of_means(self, offset_um: Floats, spread_um2: Floats) -> Floats:
        """
        Return the covariance of the means over two apertures.

        Parameters
        ----------
        offset_um : (..., 2), µm
            From one centroid to the other.
        spread_um2 : (..., 3), µm²
            Sum of the central second moments of both apertures: xx, yy, xy.

        Notes
        -----
        Exact for apertures with Gaussian sensitivity, otherwise for the same second moments.
        """
        dx, dy = offset_um[..., 0], offset_um[..., 1]
        xx, yy, xy = (spread_um2[..., k] for k in range(3))
        total = np.zeros(dx.shape)
        for a, sigma2 in zip(self.amplitude, self.sigma_um**2, strict=True):
            sxx, syy = xx + sigma2, yy + sigma2
            det = sxx * syy - xy * xy
            form = (syy * dx * dx - 2.0 * xy * dx * dy + sxx * dy * dy) / det
            total += a * sigma2 / np.sqrt(det) * np.exp(-0.5 * form)
        return total


def scene_covariance(images: ArrayLike, pitch_um: float) -> SceneCovariance:
    """
    Fit an isotropic covariance to images.

    Parameters
    ----------
    images : (n_image, n_y, n_x)
        Irradiance on square pixels; NaN where unknown.
    pitch_um : float, µm
        Pixel pitch.

    Returns
    -------
    SceneCovariance
        Non-negative least-squares fit of Gaussians to the autocovariance, averaged over images and directions.
    """
    from scipy.fft import irfft2, rfft2
    from scipy.optimize import nnls

    stack = np.asarray(images, np.float64)
    is_known = np.isfinite(stack)
    mean = np.where(is_known, stack, 0.0).sum(axis=(1, 2)) / is_known.sum(axis=(1, 2))
    deviation = np.where(is_known, stack - mean[:, np.newaxis, np.newaxis], 0.0)
    shape = tuple(2 * n for n in stack.shape[1:])
    products, pairs = (
        irfft2(np.square(np.abs(rfft2(part, shape))), shape).sum(axis=0) for part in (deviation, is_known.astype(float))
    )
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    distance = np.hypot(x, y[:, np.newaxis])
    reach = MAX_DISTANCE_FRACTION * min(stack.shape[1:])
    bins = np.rint(distance).astype(np.int64).ravel()
    is_near = (distance.ravel() <= reach) & (pairs.ravel() > 0.5)
    sums, counts, distances = (
        np.bincount(bins[is_near], weights=part.ravel()[is_near]) for part in (products, pairs, pairs * distance)
    )
    used = counts > 0.0
    radius_um, covariance = distances[used] / counts[used] * pitch_um, sums[used] / counts[used]
    n_widths = max(1, math.ceil(math.log(reach / 0.5, WIDTH_RATIO)))
    sigma_um = 0.5 * pitch_um * WIDTH_RATIO ** np.arange(n_widths + 1)
    # Each distance counts alike; the variance at distance 0 is that of pixels.
    basis = np.exp(-0.5 * np.square(radius_um[:, np.newaxis] / sigma_um))
    amplitude, _ = nnls(basis, covariance)
    return SceneCovariance(amplitude[amplitude > 0.0], sigma_um[amplitude > 0.0])


def site_information_bits(
    layout: Layout,
    covariance: SceneCovariance,
    gain: ArrayLike,
    noise_variance: ArrayLike,
    *,
    n_conditions: int = N_CONDITIONS,
) -> Floats:
    """
    Compute the information of each site given its preceding neighbours.

    Parameters
    ----------
    layout : Layout
    covariance : SceneCovariance
        Covariance of the irradiance.
    gain : (n_site,)
        Mean reading of a site for an irradiance of 1: its area times its sensitivity.
    noise_variance : (n_scene, n_site)
        Noise variance of the readings, in squared units of the readings.
    n_conditions : int
        Number of neighbours.

    Returns
    -------
    information : (n_scene, n_site) float64, bit
        The sum over the sites is the information of all readings. It is exact, up to apertures, when every site has at most
        ``n_conditions`` preceding sites, and otherwise an upper bound that decreases with ``n_conditions``.

    Notes
    -----
    Chain rule of the entropy, in the order of x, with the conditional variance of each reading given the nearest preceding
    ones (Vecchia 1988).
    """
    from scipy.spatial import cKDTree

    n = layout.n_sites
    order = np.lexsort((layout.centroid_um[:, 1], layout.centroid_um[:, 0]))
    xy_um, spread_um2 = layout.centroid_um[order], _second_moments_um2(layout)[order]
    scale, noise = np.asarray(gain, np.float64)[order], np.asarray(noise_variance, np.float64)[:, order]
    m = min(n_conditions, n - 1)
    n_near = min(n, max(N_CANDIDATES, 3 * m + 2))
    near = np.asarray(cKDTree(xy_um).query(xy_um, k=np.arange(1, n_near + 1))[1], np.int64).reshape(n, n_near)
    is_before = near < np.arange(n)[:, np.newaxis]
    chosen = np.take_along_axis(near, np.argsort(~is_before, axis=1, kind="stable")[:, :m], axis=1)
    n_before = np.minimum(is_before.sum(axis=1), m)
    members = np.concatenate((chosen, np.arange(n)[:, np.newaxis]), axis=1)
    is_used = np.concatenate((np.arange(m) < n_before[:, np.newaxis], np.ones((n, 1), bool)), axis=1)
    found = np.empty(noise.shape)
    block = max(1, BLOCK_ELEMENTS // (m + 1) ** 2)
    for start in range(0, n, block):
        part, used = members[start : start + block], is_used[start : start + block]
        offset_um = xy_um[part][:, :, np.newaxis] - xy_um[part][:, np.newaxis]
        spread = spread_um2[part][:, :, np.newaxis] + spread_um2[part][:, np.newaxis]
        both = used[:, :, np.newaxis] & used[:, np.newaxis]
        signal = np.where(both, covariance.of_means(offset_um, spread), 0.0)
        signal *= scale[part][:, :, np.newaxis] * scale[part][:, np.newaxis]
        for k, variance in enumerate(noise):
            own = np.where(used, variance[part], 1.0)
            # In units of the noise, for a good condition.
            root = np.sqrt(own)
            total = signal / (root[:, :, np.newaxis] * root[:, np.newaxis]) + np.eye(m + 1)
            found[k, start : start + block] = np.log2(np.linalg.cholesky(total)[:, -1, -1])
    bits = np.empty(found.shape)
    bits[:, order] = found
    return bits


def _second_moments_um2(layout: Layout) -> Floats:
    """Return the second moments xx, yy, xy of the sites over their area, (n_site, 3) µm²."""
    n_vertices = np.diff(layout.ring_offsets)
    n_rings = np.diff(layout.site_offsets)
    site = np.repeat(np.repeat(np.arange(layout.n_sites), n_rings), n_vertices)
    ring_start = np.repeat(layout.ring_offsets[:-1], n_vertices)
    position = np.arange(site.size) - ring_start
    following = ring_start + (position + 1) % np.repeat(n_vertices, n_vertices)
    x, y = (layout.xy_um - layout.centroid_um[site]).T
    x1, y1 = (layout.xy_um[following] - layout.centroid_um[site]).T
    cross = x * y1 - x1 * y
    integrals = (
        (x * x + x * x1 + x1 * x1) * cross / 12.0,
        (y * y + y * y1 + y1 * y1) * cross / 12.0,
        (x * y1 + 2.0 * x * y + 2.0 * x1 * y1 + x1 * y) * cross / 24.0,
    )
    sums = np.stack([np.bincount(site, part, minlength=layout.n_sites) for part in integrals], axis=1)
    return np.asarray(sums / layout.area_um2[:, np.newaxis])
