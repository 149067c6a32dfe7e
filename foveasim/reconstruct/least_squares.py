"""
Regularised least-squares reconstruction with exact overlaps of sites and pixels.

The value of a site is modelled as its response times the mean of the picture over its area. Sites of any size, including
several sites within one pixel, thus contribute to the pixels under them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import POSITIVE, Limits
from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError
from foveasim.fields import Grid, PackedRings
from foveasim.integrate import Integrator
from foveasim.reconstruct._bounded import minimise_nonnegative
from foveasim.reconstruct.interpolation import site_values
from foveasim.reconstruct.picture import Gaps, Picture, raster_of

__all__ = ["least_squares"]

#: Sites with less than this fraction of their area on the raster are ignored.
MIN_RASTER_FRACTION = 1e-6
#: Relative tolerance of the misfit, compared with the noise, in the discrepancy rule.
MISFIT_TOLERANCE = 0.02
#: Largest number of regularisation strengths that are tried, and ratio of the first strength to the smallest.
MAX_STRENGTHS, MAX_STRENGTH_RATIO = 12, 1e8
#: Largest strength, as a multiple of the largest curvature of the data term: beyond it the picture is constant.
MAX_RELATIVE_STRENGTH = 1e6
#: Upper bound of a picture's roughness along one axis over its sum of squares; and largest number of pixels across the
#: coarsest level of the preconditioner.
MAX_ROUGHNESS, MAX_COARSEST_PIXELS = 4.0, 4
#: Factor by which the tolerance is relaxed during the search for the strength.
SEARCH_TOLERANCE_FACTOR = 3.0


def least_squares(
    layout: PackedRings,
    values: Floats,
    grid: Grid,
    *,
    variance: ArrayLike | None = None,
    response: ArrayLike | None = None,
    mu: float | Literal["roughness", "discrepancy"] = "roughness",
    blur: ArrayLike | None = None,
    tolerance: Annotated[float, Limits(above=0.0, at_most=0.1)] = 1e-4,
    max_steps: Annotated[int, Limits(at_least=1)] = 5000,
    gaps: Gaps = "fill",
    n_threads: int | None = None,
) -> Picture:
    """
    Compute the picture x >= 0 that minimises ``|C^-1/2 (r W x - y)|² + mu |grad x|²``.

    Parameters
    ----------
    layout : Layout
    values : (n_site,) or (n_channel, n_site)
        y: linear in irradiance, 0 at zero irradiance. NaN excludes a site, for example one of another colour, a saturated or
        a dead one.
    grid : Grid
        Pixels of the picture.
    variance : number, (n_site,) or (n_channel, n_site), optional
        C: noise variance of the values. By default the noise is the same fraction of the response at all sites.
    response : (n_site,), optional
        r: value of each site for a picture of 1 everywhere. By default its area in µm², so that charges in electrons give a
        picture in electrons per µm². With ones, values that are equal for a uniform scene are not rescaled.
    mu : float, "roughness" or "discrepancy"
        Strength of the regularisation. ``|grad x|²`` is the sum of the squared differences of neighbouring pixels over the
        complete raster, weighted by pixel height over width along x, and by the inverse along y. It approximates the integral
        of the squared gradient for pixels of any aspect ratio and does not depend on the pixel pitch. Both rules need the
        variance; see Notes.
    blur : (m_y, m_x) or (n_channel, m_y, m_x), optional
        Response of the lens to one pixel, on the pixels of the raster, with an odd number along each side and the pixel in
        the centre (see :func:`blur_kernel`). W then includes the convolution with this kernel, and the picture is the
        deblurred one. The raster is padded by unknown pixels to the reach of the kernel.
    tolerance : float
        The iteration stops when the root of ``g·M g`` is below this fraction of ``|C^-1/2 y|``, with the projected gradient g
        and a preconditioner M. The objective then exceeds its minimum by about the square of this limit.
    max_steps : int
        Largest number of applications of the operator per solution.
    gaps : {"fill", "empty"}
        As for :func:`cells`.
    n_threads : int, optional
        All cores by default. Channels are solved in parallel.

    Returns
    -------
    Picture
        In the unit of the values divided by that of the response. NaN where no photosite lies, despite the regularisation.

    Raises
    ------
    SimulationError
        When the iteration does not converge within ``max_steps``.

    Notes
    -----
    ``"roughness"`` sets mu to the number of values over the sum of squared differences of neighbouring pixels of the
    cell-filled picture. In Bayesian terms, mu is the prior of the roughness, with ``mu |grad x|²`` of about the number of
    values, and the cell-filled picture estimates the roughness. ``"discrepancy"`` (Morozov) chooses mu so that the misfit
    equals the noise, that is ``|C^-1/2 (r W x - y)|²`` equals the number of values within 2 %, or uses the largest possible
    mu. It takes several solutions and depends on the noise alone: it oversmooths photographs at low signal levels.

    A site that extends beyond the raster is represented by its part on the raster.

    Solved by conjugate gradients with bounds (see ``_bounded``) and a multilevel preconditioner.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout, grid = (
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=4.0),
    ...     fs.Grid.centred((16, 16), 2.0),
    ... )
    >>> expected_e = 50.0 * layout.area_um2  # a uniform image of 50 e-/µm²
    >>> charge_e = np.random.default_rng(0).poisson(expected_e)
    >>> picture = fs.reconstruct.least_squares(
    ...     layout, charge_e, grid, variance=expected_e, mu=10.0
    ... )
    >>> round(float(picture.data.mean()), 1), round(float(picture.data.std()), 2)
    (50.4, 0.07)
    """
    from scipy import fft

    raster = raster_of(layout, grid, gaps, n_threads)
    integrator = raster.sites
    channels = site_values(values, integrator.n_sites)
    n_channels, n_sites = channels.shape
    if not isinstance(mu, str):
        mu = POSITIVE.check("mu", mu)
    elif variance is None:
        raise ParameterError("mu", "must be a number without 'variance', as both rules depend on the noise")
    kernel_of = _kernels_of(blur, n_channels)
    pad = tuple(n // 2 for n in kernel_of[0].shape) if kernel_of else (0, 0)
    shape = tuple(fft.next_fast_len(n + 2 * p, real=True) if p else n for n, p in zip(grid.shape, pad, strict=True))
    overlaps = _padded_overlaps(integrator, pad, shape)
    covered_um2 = np.asarray(overlaps.sum(axis=1)).ravel()
    area_um2 = covered_um2 + integrator.uncovered_um2
    gain = area_um2 if response is None else finite_array("response", response, ndim=1, at_least=0.0)
    if gain.shape != (n_sites,):
        raise ParameterError("response", f"must have the shape ({n_sites},), got {gain.shape}")
    is_used = (covered_um2 > MIN_RASTER_FRACTION * area_um2) & (gain > 0.0)
    noise = _noise(variance, gain, channels.shape)

    def solve(channel: int) -> Floats:
        known = np.flatnonzero(is_used & ~np.isnan(channels[channel]))
        if known.size == 0:
            raise ParameterError(
                "values", f"must have a number for a site on the raster, got none in channel {channel}"
            )
        weight = gain[known] / covered_um2[known] / np.sqrt(noise[channel, known])
        problem = _Problem(
            overlaps=_scale_rows(overlaps[known], weight),
            right=channels[channel, known] / np.sqrt(noise[channel, known]),
            shape=shape,
            weights=(grid.pitch_y_um / grid.pitch_x_um, grid.pitch_x_um / grid.pitch_y_um),
            transfer=_transfer(kernel_of[channel], shape) if kernel_of else None,
            tolerance=tolerance,
            max_steps=max_steps,
        )
        if mu == "discrepancy":
            x = problem.solve_discrepancy()
        else:
            x = problem.solve(problem.natural_strength if isinstance(mu, str) else float(mu))
        return x.reshape(shape)[pad[0] : pad[0] + grid.shape[0], pad[1] : pad[1] + grid.shape[1]]

    data = np.array(parallel_map(solve, range(n_channels), thread_count(n_threads)))
    data[:, raster.covered_fraction == 0.0] = np.nan
    return raster.picture(data)


@dataclass(frozen=True, eq=False)
class _Problem:
    """
    Least-squares problem of one channel, with values in units of their noise.

    ``overlaps`` (n_value, n_pixel), sparse: contribution of each pixel to each value, divided by the noise of the value.
    ``right`` (n_value,): values divided by their noise. ``weights`` (along x, along y): of the squared differences of
    neighbours, 1 for square pixels. ``transfer`` (n_y, n_x // 2 + 1): transfer function of the blur, None without.
    """

    overlaps: Any
    right: Floats
    shape: tuple[int, ...]
    weights: tuple[float, float]
    transfer: Any
    tolerance: float
    max_steps: int

    @cached_property
    def _transposed(self) -> Any:
        return self.overlaps.T.tocsr()

    def _blur(self, x: Floats, transfer: Any) -> Floats:
        if transfer is None:
            return x
        from scipy import fft

        plane = fft.rfft2(x.reshape(self.shape))
        return np.asarray(fft.irfft2(plane * transfer, s=self.shape)).ravel()

    def forward(self, x: Floats) -> Floats:
        """Return the values of a picture, divided by their noise."""
        return np.asarray(self.overlaps @ self._blur(x, self.transfer))

    def backward(self, y: Floats) -> Floats:
        """Apply the adjoint of :meth:`forward`."""
        return self._blur(np.asarray(self._transposed @ y), None if self.transfer is None else self.transfer.conj())

    @cached_property
    def _normal_right(self) -> Floats:
        return self.backward(self.right)

    @cached_property
    def _row_sums(self) -> Floats:
        """Row sums of the data term of the normal equations, a diagonal that bounds it."""
        return np.maximum(self.backward(self.forward(np.ones(self.overlaps.shape[1]))), 0.0)

    def _levels(self, mu: float) -> list[Floats]:
        """Return inverse diagonals of the preconditioner, from the finest level to the coarsest."""
        level, levels = self._row_sums.reshape(self.shape), []
        while True:
            levels.append(1.0 / (level + MAX_ROUGHNESS * sum(self.weights) * mu))
            if min(level.shape) <= MAX_COARSEST_PIXELS:
                return levels
            level = _coarsen(level)

    @cached_property
    def first_guess(self) -> Floats:
        """Area-weighted mean of the site values over each pixel."""
        total = np.asarray(self._transposed @ np.ones(self.right.size))
        means = self.right / np.asarray(self.overlaps.sum(axis=1)).ravel()
        weighted = np.asarray(self._transposed @ means)
        flat = float(np.median(means))
        return np.maximum(np.where(total > 0.0, weighted / np.where(total > 0.0, total, 1.0), flat), 0.0)

    def solve(self, mu: float, start: Floats | None = None, tolerance: float | None = None) -> Floats:
        """Return the picture for one regularisation strength."""
        from foveasim.reconstruct import _kernels

        add_roughness: Callable[..., None] = _kernels.add_roughness
        levels = self._levels(mu)
        mu_x, mu_y = (mu * weight for weight in self.weights)

        def normal(x: Floats) -> Floats:
            out = self.backward(self.forward(x))
            add_roughness(x.reshape(self.shape), mu_x, mu_y, out.reshape(self.shape))
            return out

        def precondition(gradient: Floats) -> Floats:
            planes = [gradient.reshape(self.shape)]
            for _ in levels[1:]:
                planes.append(_coarsen(planes[-1]))
            out = planes[-1] * levels[-1]
            for plane, level in zip(planes[-2::-1], levels[-2::-1], strict=True):
                out = _refine(out, plane.shape) + plane * level
            return out.ravel()

        x, self.__dict__["n_steps"] = minimise_nonnegative(
            normal,
            1.0 / levels[0].ravel(),
            precondition,
            self._normal_right,
            self.first_guess if start is None else start,
            threshold=(tolerance or self.tolerance) * math.sqrt(self.right @ self.right),
            max_steps=self.max_steps,
        )
        return x

    def misfit(self, x: Floats) -> float:
        """Return the mean squared residual in units of the noise, whose expectation is 1."""
        residual = self.forward(x) - self.right
        return float(residual @ residual) / self.right.size

    def roughness(self, x: Floats) -> float:
        """Return the weighted sum of the squared differences of neighbouring pixels."""
        picture, (weight_x, weight_y) = x.reshape(self.shape), self.weights
        along_x, along_y = (np.diff(picture, axis=1) ** 2).sum(), (np.diff(picture, axis=0) ** 2).sum()
        return float(weight_y * along_y + weight_x * along_x)

    @cached_property
    def natural_strength(self) -> float:
        """
        Strength of the rule ``"roughness"``: number of values over that of the first guess.

        For a uniform first guess, which has no roughness, it is the largest strength.
        """
        return self.right.size / max(
            self.roughness(self.first_guess), self.right.size / (MAX_RELATIVE_STRENGTH * float(self._row_sums.max()))
        )

    def solve_discrepancy(self) -> Floats:
        """
        Return the picture whose misfit equals the noise (discrepancy principle).

        The strength is found by a bracketed secant method in the logarithms of strength and misfit.
        """
        x, mu = self.first_guess, self.natural_strength
        low, high = math.log(mu / MAX_STRENGTH_RATIO), math.log(MAX_RELATIVE_STRENGTH * float(self._row_sums.max()))
        before: tuple[float, float] | None = None
        for _ in range(MAX_STRENGTHS):
            x = self.solve(mu, x, min(SEARCH_TOLERANCE_FACTOR * self.tolerance, 0.1))
            at, value = math.log(mu), math.log(max(self.misfit(x), 1e-300))
            low, high = (at, high) if value < 0.0 else (low, at)
            if abs(value) <= MISFIT_TOLERANCE or high - low < 1e-3:
                break
            slope = 1.0 if before is None or at == before[0] else (value - before[1]) / (at - before[0])
            before = at, value
            # The misfit increases with the strength, at most with its square.
            following = at - value / min(max(slope, 0.1), 2.0)
            mu = math.exp(following if low < following < high else 0.5 * (low + high))
        return self.solve(mu, x)


# -- levels -----------------------------------------------------------------------------------------------------------


def _coarsen(plane: Floats) -> Floats:
    """Apply the adjoint of :func:`_refine`."""
    for axis in (0, 1):
        plane = np.moveaxis(_downsample(np.moveaxis(plane, axis, 0)), 0, axis)
    return plane


def _refine(plane: Floats, shape: tuple[int, ...]) -> Floats:
    """Interpolate linearly between pixel centres to pixels of half the size."""
    for axis in (0, 1):
        plane = np.moveaxis(_upsample(np.moveaxis(plane, axis, 0), shape[axis]), 0, axis)
    return plane


def _upsample(rows: Floats, n: int) -> Floats:
    before, after = np.concatenate((rows[:1], rows[:-1])), np.concatenate((rows[1:], rows[-1:]))
    out = np.empty((2 * rows.shape[0], *rows.shape[1:]))
    out[0::2], out[1::2] = 0.75 * rows + 0.25 * before, 0.75 * rows + 0.25 * after
    return out[:n]


def _downsample(rows: Floats) -> Floats:
    if rows.shape[0] % 2:
        rows = np.concatenate((rows, np.zeros((1, *rows.shape[1:]))))
    even, odd = rows[0::2], rows[1::2]
    out = 0.75 * (even + odd)
    out[:-1] += 0.25 * even[1:]
    out[0] += 0.25 * even[0]
    out[1:] += 0.25 * odd[:-1]
    out[-1] += 0.25 * odd[-1]
    return out


# -- parts ------------------------------------------------------------------------------------------------------------


def _noise(variance: ArrayLike | None, gain: Floats, shape: tuple[int, int]) -> Floats:
    """Return the noise variance of every value, (n_channel, n_site)."""
    if variance is None:
        typical = float(np.median(gain[gain > 0.0])) if (gain > 0.0).any() else 1.0
        return np.broadcast_to(np.where(gain > 0.0, gain / typical, 1.0) ** 2, shape)
    values = finite_array("variance", variance, above=0.0)
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise ParameterError(
            "variance", f"must be one number, or have the shape (..., {shape[1]}), got {values.shape}"
        ) from None


def _scale_rows(matrix: Any, weight: Floats) -> Any:
    """Return a sparse matrix with its rows multiplied by weights."""
    scaled = matrix.copy()
    scaled.data *= np.repeat(weight, np.diff(scaled.indptr))
    return scaled


def _padded_overlaps(integrator: Integrator, pad: tuple[int, ...], shape: tuple[int, ...]) -> Any:
    """Return the overlaps as a sparse matrix on a padded raster."""
    from scipy.sparse import csr_array

    matrix = integrator.weights()
    row, column = np.divmod(matrix.indices, integrator.grid.shape[1])
    index = (row + pad[0]) * shape[1] + column + pad[1]
    return csr_array((matrix.data, index, matrix.indptr), shape=(matrix.shape[0], shape[0] * shape[1]))


def _kernels_of(blur: ArrayLike | None, n_channels: int) -> list[Floats]:
    """Return one kernel per channel, not normalised; empty without a blur."""
    if blur is None:
        return []
    kernel = finite_array("blur", blur, at_least=0.0)
    if kernel.ndim not in (2, 3) or any(n % 2 == 0 for n in kernel.shape[-2:]) or kernel.sum() <= 0.0:
        raise ParameterError(
            "blur", f"must have an odd number of pixels along each side and a positive sum, got {kernel.shape}"
        )
    if kernel.ndim == 3 and kernel.shape[0] not in (1, n_channels):
        raise ParameterError(
            "blur", f"must be one kernel, or one for each of the {n_channels} channels, got {kernel.shape[0]}"
        )
    return list(np.broadcast_to(kernel, (n_channels, *kernel.shape[-2:])))


def _transfer(kernel: Floats, shape: tuple[int, ...]) -> Any:
    """Return the transfer function of a kernel centred on the first pixel of a raster."""
    from scipy import fft

    plane = np.zeros(shape)
    plane[: kernel.shape[0], : kernel.shape[1]] = kernel
    return fft.rfft2(np.roll(plane, (-(kernel.shape[0] // 2), -(kernel.shape[1] // 2)), axis=(0, 1)))
