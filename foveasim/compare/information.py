"""
Information in the readings of a sensor about its scenes, by a Gaussian model.

The mutual information is ``I = H(Y) - H(Y | X)`` for readings Y and scenes X. With Gaussian scenes and noise it has a closed
form; for other scenes, the entropy of a Gaussian of the same covariance is an upper bound of H(Y).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import POSITIVE, Limits
from foveasim._core.rings import site_moments_about
from foveasim._core.validation import Bools, Floats, Ints, as_numbers, check_per_site, finite_array
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.sensor.model.linearisation import Linearisation

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

__all__ = ["SceneCovariance", "gaussian_information_bits", "scene_covariance", "site_information_bits"]

#: Number of sites of a block, number of preceding sites on which a block is conditioned, and number of nearest sites among
#: which these are searched, as a multiple of the sum of both.
BLOCK_SITES, N_CONDITIONS, CANDIDATE_RATIO = 128, 128, 4
#: Ratio of the widths of adjacent Gaussian components of a covariance, and the smallest width in pixels.
WIDTH_RATIO, MIN_WIDTH_PIXELS = 1.08, 0.25
#: Fraction of the width of images on each side along which their window rises from 0 to 1.
TAPER_FRACTION = 0.05
#: For Gaussians from this width in pixels on, the mean over a pixel is represented by its second moment: exact to 2e-6.
MOMENT_WIDTH_PIXELS = 8.0
#: Lowest frequency of the fit in periods per field, and highest frequency in cycles per pixel.
MIN_PERIODS, MAX_FREQUENCY = 2.0, 0.5
#: Spectral density below which errors do not matter, relative to the mean density up to a frequency in cycles per pixel; and
#: number of fits, each with weights from the fit before.
DENSITY_FLOOR, FLOOR_FREQUENCY, N_FITS = 3e-3, 0.125, 5
#: A site is represented by 1 Gaussian per axis if the component of the covariance is wider than the first ratio times the
#: longer side of the site, by 2 if wider than the second ratio, and else by 3.
MIN_WIDTH_RATIOS = (1.5, 0.25)


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

    Examples
    --------
    >>> import foveasim as fs
    >>> covariance = fs.compare.SceneCovariance(amplitude=[0.8, 0.2], sigma_um=[5.0, 40.0])
    >>> covariance.at([0.0, 5.0, 40.0]).round(3).tolist()
    [1.0, 0.684, 0.121]
    """

    def __init__(self, amplitude: ArrayLike, sigma_um: ArrayLike) -> None:
        self.amplitude: Floats = np.ascontiguousarray(finite_array("amplitude", amplitude, ndim=1, at_least=0.0))
        self.sigma_um: Floats = np.ascontiguousarray(finite_array("sigma_um", sigma_um, ndim=1, above=0.0))
        if self.amplitude.shape != self.sigma_um.shape:
            raise ParameterError(
                "sigma_um", f"must have one width per amplitude, {self.amplitude.size}, got {self.sigma_um.size}"
            )

    def __repr__(self) -> str:
        return f"SceneCovariance({self.amplitude.size} Gaussians)"

    def at(self, distance_um: ArrayLike) -> Floats:
        """Return the covariance of two points at a distance in µm."""
        d2 = np.square(np.asarray(distance_um, np.float64))[..., np.newaxis]
        return np.asarray((self.amplitude * np.exp(-0.5 * d2 / self.sigma_um**2)).sum(axis=-1))


def scene_covariance(images: ArrayLike, pitch_um: Annotated[float, POSITIVE]) -> SceneCovariance:
    """
    Fit an isotropic covariance of points to images of pixel means.

    Parameters
    ----------
    images : (n_image, n_y, n_x)
        Irradiance on square pixels, means over their areas; NaN where unknown.
    pitch_um : float, µm
        Pixel pitch.

    Returns
    -------
    SceneCovariance

    Raises
    ------
    ParameterError
        When the images do not have three axes, or the pitch is not positive.

    Notes
    -----
    The radial means of the periodograms are fitted by non-negative sums of the periodograms that are expected for Gaussian
    covariances: with the aperture of the pixels, aliasing and the window (Guillaumin et al., J. R. Stat. Soc. B 84, 2022). The
    covariance is therefore that of points, and independent of the pixel pitch as long as the pixels resolve the images. The
    weights are those of Whittle's likelihood (Biometrika 41, 1954), with the means of the previous fit.

    Examples
    --------
    White noise blurred by a Gaussian of 4 µm has a covariance with √2 times this width:

    >>> import foveasim as fs
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> noise = np.random.default_rng(0).normal(size=(8, 64, 64))
    >>> images = 10.0 + gaussian_filter(noise, sigma=(0, 2.0, 2.0), mode="wrap")
    >>> covariance = fs.compare.scene_covariance(images, pitch_um=2.0)
    >>> round(float(covariance.sigma_um[covariance.amplitude.argmax()]), 1)
    5.9
    """
    from scipy.optimize import nnls

    stack = as_numbers("images", images, keep_type=True, missing_is_nan=True)
    if stack.ndim != 3 or not stack.size:
        raise ParameterError("images", "must have the shape (n_image, n_y, n_x)", list(stack.shape))
    spectrum = _RadialSpectrum(stack)
    n_widths = max(1, math.ceil(math.log(0.5 * max(stack.shape[1:]) / MIN_WIDTH_PIXELS, WIDTH_RATIO)))
    sigma = MIN_WIDTH_PIXELS * WIDTH_RATIO ** np.arange(n_widths + 1, dtype=np.float64)
    basis = spectrum.of_gaussians(np.asarray(sigma, np.float64))
    is_low = spectrum.frequency <= max(FLOOR_FREQUENCY, float(spectrum.frequency[0]))
    floor = DENSITY_FLOOR * float(np.average(spectrum.density[is_low], weights=spectrum.n_modes[is_low]))
    if floor <= 0.0:
        return SceneCovariance(np.empty(0), np.empty(0))
    expected = spectrum.density
    for _ in range(N_FITS):
        weight = np.sqrt(spectrum.n_modes) / (expected + floor)
        columns = basis * weight[:, np.newaxis]
        length = np.linalg.norm(columns, axis=0)
        amplitude = nnls(columns / length, spectrum.density * weight, maxiter=100 * sigma.size)[0] / length
        expected = basis @ amplitude
    is_used = amplitude > 0.0
    return SceneCovariance(amplitude[is_used], sigma[is_used] * pitch_um)


class _RadialSpectrum:
    """
    Mean spectral density of images in rings of frequencies, in pixels and cycles per pixel.

    ``frequency``, ``density``, ``n_modes`` (n_ring,) float64: mean frequency, mean of the periodograms, and number of
    frequencies of each ring.
    """

    def __init__(self, images: NDArray[np.float64]) -> None:
        from scipy.fft import fftfreq, rfft2, rfftfreq
        from scipy.signal.windows import tukey

        shape = images.shape[1:]
        radius = np.hypot(fftfreq(shape[0])[:, np.newaxis], rfftfreq(shape[1]))
        # Frequencies that a real transform omits count twice.
        self._count = np.where(2 * np.arange(radius.shape[1]) % shape[1] == 0, 1.0, 2.0)
        lowest = min(MIN_PERIODS / min(shape), 0.5 * MAX_FREQUENCY)
        is_used = (radius >= lowest) & (radius <= MAX_FREQUENCY)
        self._ring = np.full(radius.shape, -1, np.int64)
        ring = np.floor(radius[is_used] * min(shape)).astype(np.int64)
        self._ring[is_used] = np.unique(ring, return_inverse=True)[1].ravel()
        self.n_modes: Floats = self._sums(np.ones(radius.shape))
        self._windows = [tukey(n + 2, 2.0 * TAPER_FRACTION)[1:-1] for n in shape]
        power, n_used = np.zeros(radius.shape), 0
        for image in images:
            window = np.outer(*self._windows)
            is_known = np.isfinite(image)
            if not is_known.all():
                window *= _taper(is_known)
            if not window.any():
                continue
            values = np.where(is_known, image, 0.0).astype(np.float64)
            values -= float((window * values).sum() / window.sum())
            power += np.square(np.abs(rfft2(window * values))) / np.square(window).sum()
            n_used += 1
        self.frequency: Floats = self._means(radius)
        self.density: Floats = self._means(power / max(n_used, 1))

    def _sums(self, values: Floats) -> Floats:
        is_used = self._ring >= 0
        return np.asarray(np.bincount(self._ring[is_used], (values * self._count)[is_used]), np.float64)

    def _means(self, values: Floats) -> Floats:
        return self._sums(values) / self.n_modes

    def of_gaussians(self, sigma: Floats) -> Floats:
        """Return the densities expected for Gaussian covariances of variance 1, (n_ring, n_sigma)."""
        from foveasim.compare import _kernels

        y, x = (
            np.stack([_expected_periodogram(window, width) for width in sigma.tolist()], axis=1)
            for window in self._windows
        )
        x = np.ascontiguousarray(x[: self._count.size] * self._count[:, np.newaxis])
        sums = _kernels.ring_sums(self._ring, y, x, self.n_modes.size)
        return np.asarray(sums / self.n_modes[:, np.newaxis])


def _expected_periodogram(window: Floats, sigma: float) -> Floats:
    """
    Return the expected periodogram of windowed pixel means, (n,).

    The covariance of points is exp(-d² / 2 σ²), with d and σ in pixels.
    """
    from scipy.fft import fft, irfft, next_fast_len, rfft
    from scipy.special import erf

    n = window.size
    lag = np.arange(n, dtype=np.float64)
    if sigma < MOMENT_WIDTH_PIXELS:
        # The second integral of the covariance, and its differences over a pixel.
        d = np.arange(-1.0, n + 1.0)
        root = math.sqrt(2.0) * sigma
        integral = sigma**2 * np.exp(-np.square(d / root)) + math.sqrt(0.5 * math.pi) * sigma * d * erf(d / root)
        covariance = integral[2:] - 2.0 * integral[1:-1] + integral[:-2]
    else:
        variance = sigma**2 + 1.0 / 6.0
        covariance = sigma / math.sqrt(variance) * np.exp(-0.5 * np.square(lag) / variance)
    size = next_fast_len(2 * n, real=True)
    products = irfft(np.square(np.abs(rfft(window, size))), size)[:n]
    part = covariance * products / products[0]
    folded = part + np.concatenate(([0.0], part[:0:-1]))
    return np.asarray(np.maximum(fft(folded).real, 0.0))


def _taper(is_known: Bools) -> Floats:
    """Return a window that decreases to 0 at unknown pixels."""
    from scipy.ndimage import distance_transform_edt

    distance = distance_transform_edt(is_known)
    return np.asarray(np.square(np.sin(0.5 * np.pi * np.minimum(1.0, distance / (min(is_known.shape) / 8.0)))))


def site_information_bits(
    layout: Layout,
    covariance: SceneCovariance,
    gain: ArrayLike,
    noise: ArrayLike | Sequence[Linearisation],
    *,
    n_conditions: Annotated[int, Limits(at_least=0)] = N_CONDITIONS,
) -> Floats:
    """
    Compute the information of each site given its preceding neighbours.

    Parameters
    ----------
    layout : Layout
    covariance : SceneCovariance
        Covariance of the irradiance.
    gain : (n_site,) or (n_scene, n_site)
        Mean reading of a site for an irradiance of 1: its area times its response to light; 0 for dead and saturated sites.
    noise : (n_scene, n_site), or sequence of Linearisation
        Noise variance of the readings, in squared units of the readings; or the model of the sensor for each scene, with
        readings in codes, whose noise may be correlated.
    n_conditions : int
        Number of preceding sites on which a block of sites is conditioned.

    Returns
    -------
    information : (n_scene, n_site) float64, bit
        The sum over the sites is the information of all readings. It is exact, up to apertures, when every block has at most
        ``n_conditions`` preceding sites, and otherwise an upper bound that decreases with ``n_conditions``.

    Raises
    ------
    ParameterError
        When an array has another shape, a variance is not positive, or the covariance is singular within rounding.

    Notes
    -----
    Chain rule of the entropy, over blocks of adjacent sites, with the conditional covariance of each block given the nearest
    preceding sites (Vecchia, J. R. Stat. Soc. B 50, 1988; blocks as by Stein et al., ibid. 66, 2004).

    The aperture of a site is represented by a sum of equal Gaussians with the same second moments and the same integral of the
    square, the inverse area. This is exact for structure that is much larger or much smaller than the site.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> covariance = fs.compare.SceneCovariance([1.0], [5.0])
    >>> for pitch_um in (2.0, 4.0):
    ...     layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=pitch_um)
    ...     bits = fs.compare.site_information_bits(
    ...         layout, covariance, layout.area_um2, np.ones((1, 64))
    ...     )
    ...     print(f"{bits.sum():.0f} bit")
    37 bit
    157 bit
    """
    from scipy.spatial import cKDTree

    n = layout.n_sites
    xy_um = np.asarray(layout.centroid_um, np.float64)
    order, starts = _blocks(xy_um)
    position = np.empty(n, np.int64)
    position[order] = np.arange(n)
    scale = np.atleast_2d(finite_array("gain", gain))
    models = [one for one in noise if isinstance(one, Linearisation)] if isinstance(noise, list | tuple) else []
    variances: Any = [np.broadcast_to(one.variance_dn2(), n) for one in models] or noise
    variance = finite_array("noise", variances, ndim=2, above=0.0)
    for name, values in (("gain", scale), ("noise", variance)):
        check_per_site(name, values, n, or_rows=True)
    if scale.shape[0] not in (1, variance.shape[0]):
        raise ParameterError("gain", f"must have one row, or one per scene, {variance.shape[0]}", scale.shape[0])
    scale = np.broadcast_to(scale, variance.shape)
    apertures = _Apertures(layout, covariance)
    tree = cKDTree(xy_um)
    bits = np.empty(variance.shape)
    for start, stop in pairwise(starts):
        block = order[start:stop]
        members = np.concatenate((_preceding(xy_um, tree, block, position, start, n_conditions), block))
        signal = apertures.covariance(members)
        for k, scene_variance in enumerate(variance[:, members]):
            # In units of the noise, the matrices are well conditioned.
            deviation = np.sqrt(scene_variance)
            ratio = scale[k, members] / deviation
            total = signal * (ratio[:, np.newaxis] * ratio)
            entropy: Floats | float = 0.0
            if models and models[k].is_correlated:
                correlation = models[k].covariance_matrix_dn2(members) / (deviation[:, np.newaxis] * deviation)
                entropy = np.log2(np.diagonal(np.linalg.cholesky(correlation))[-block.size :])
                total += correlation
            else:
                total[np.diag_indices_from(total)] += 1.0
            try:
                cholesky = np.linalg.cholesky(total)
            except np.linalg.LinAlgError:
                rule = "must not be so small that the covariance is singular within rounding"
                raise ParameterError("noise", rule, float(scene_variance.min())) from None
            bits[k, block] = np.log2(np.diagonal(cholesky)[-block.size :]) - entropy
    return bits


def _blocks(xy_um: Floats) -> tuple[Ints, Ints]:
    """
    Return the sites in blocks of neighbours, (n,), and where each block begins.

    The layout is halved repeatedly across the longer side of each part. The last entry of the beginnings is n.
    """
    order, starts = np.arange(len(xy_um)), [0]
    pending = [(0, len(xy_um))]
    while pending:
        start, stop = pending.pop()
        if stop - start <= BLOCK_SITES:
            starts.append(stop)
            continue
        part = order[start:stop]
        axis = int(np.ptp(xy_um[part], axis=0).argmax())
        order[start:stop] = part[np.lexsort((xy_um[part, 1 - axis], xy_um[part, axis]))]
        middle = (start + stop) // 2
        pending += [(middle, stop), (start, middle)]
    return order, np.array(starts)


def _preceding(xy_um: Floats, tree: cKDTree, block: Ints, position: Ints, start: int, n_conditions: int) -> Ints:
    """Return the sites before ``start`` that are nearest to the bounding box of a block."""
    if n_conditions == 0 or start == 0:
        return np.empty(0, np.int64)
    low, high = xy_um[block].min(axis=0), xy_um[block].max(axis=0)
    n_near = min(len(xy_um), CANDIDATE_RATIO * (block.size + n_conditions))
    near = np.asarray(tree.query(0.5 * (low + high), k=np.arange(1, n_near + 1))[1], np.int64)
    near = near[position[near] < start]
    outside_um = np.maximum(np.maximum(low - xy_um[near], xy_um[near] - high), 0.0)
    return near[np.argsort(np.hypot(*outside_um.T), kind="stable")[:n_conditions]]


class _Apertures:
    """Sites as sums of Gaussians, with the covariances of their means."""

    def __init__(self, layout: Layout, covariance: SceneCovariance) -> None:
        xx, xy, yy = _second_moments_um2(layout).T
        # Principal axes of the second moments.
        mean, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
        angle_rad = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        long_um, short_um = np.sqrt(mean + half), np.sqrt(np.maximum(mean - half, 0.0))
        unit = np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1)
        across = np.stack((-unit[:, 1], unit[:, 0]), axis=1)
        axes_um = np.stack((long_um[:, np.newaxis] * unit, short_um[:, np.newaxis] * across), axis=1)
        # Integral of the squared aperture per axis, relative to a rectangle with the same moments: 1 for rectangles, larger for
        # other shapes.
        norm: Floats = np.asarray(np.sqrt(12.0 * long_um * short_um / layout.area_um2), np.float64)
        n_orders = len(MIN_WIDTH_RATIOS) + 1
        nodes, spread = np.zeros((n_orders, n_orders)), np.ones((layout.n_sites, n_orders))
        for order in range(2, n_orders + 1):
            node = np.arange(order) - 0.5 * (order - 1)
            node /= math.sqrt(float(np.mean(np.square(node))))
            nodes[order - 1, :order] = node
            spread[:, order - 1] = _spread_of_norm(np.asarray(node, np.float64), norm)
        amplitude, sigma_um = covariance.amplitude, covariance.sigma_um
        width = sigma_um / (math.sqrt(12.0) * long_um[:, np.newaxis])
        orders = 1 + np.sum([width < ratio for ratio in MIN_WIDTH_RATIOS], axis=0, dtype=np.int64)
        centre_um = np.ascontiguousarray(layout.centroid_um)
        #: Arguments of the kernel.
        self._arrays = centre_um, axes_um, spread, orders, nodes, amplitude, sigma_um

    def covariance(self, members: Ints) -> Floats:
        """Return the covariances of the means over sites, (n_member, n_member)."""
        from foveasim.compare import _kernels

        return np.asarray(_kernels.signal_covariance(members, *self._arrays))


def _spread_of_norm(node: Floats, norm: Floats) -> Floats:
    """
    Return the variance of each Gaussian of a site, relative to the variance of the site.

    The centres of the Gaussians have the variance 1 - fraction, so that their sum has the variance 1. ``norm`` is the integral
    of the square of the aperture times √12.
    """
    fraction = np.geomspace(1.0, 1e-4, 2000)
    apart = np.square(node[:, np.newaxis] - node)[..., np.newaxis] * (1.0 - fraction)
    # The integral of the product of two Gaussians of variance s² at a distance d is exp(-d²/4s²) / (2 s √π).
    squares = np.exp(-0.25 * apart / fraction).mean(axis=(0, 1)) * np.sqrt(12.0 / fraction) / (2.0 * math.sqrt(math.pi))
    least = int(squares.argmin())
    return np.asarray(np.interp(norm, squares[least:], fraction[least:]))


def _second_moments_um2(layout: Layout) -> Floats:
    """Return the second moments xx, xy, yy of the sites over their area, (n_site, 3) µm²."""
    rings = layout.xy_um, layout.ring_offsets, layout.site_offsets
    return site_moments_about(*rings, layout.centroid_um)[:, 3:] / layout.area_um2[:, np.newaxis]
