"""
PSFs that vary over the field, as a sum of modes.

The PSF at the point x of the field is ``h(x) = h̄ + Σ_k w_k(x) u_k``: h̄ is the mean PSF, u_k are the singular vectors of the
deviations from it, and w_k their weights, interpolated between the points at which PSFs are computed. The map of a source S is
then ``h̄ ∗ S + Σ_k u_k ∗ (w_k S)``, which takes one more forward transform per mode, and one inverse transform in all. Each u_k
has the sum 0, so that the power is exact for any number of modes.

Sources: T. R. Lauer, Deconvolution with a spatially-variant PSF, Proc. SPIE 4847, 167 (2002); R. C. Flicker and F. J. Rigaut,
Anisoplanatic deconvolution of adaptive optics images, J. Opt. Soc. Am. A 22, 504 (2005); L. Denis et al., Fast approximations
of shift-variant blur, Int. J. Comput. Vis. 115, 253 (2015).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.threads import parallel_map
from foveasim._core.validation import Floats, as_numbers, frozen_array
from foveasim.fields import Grid
from foveasim.optics._aperture import PSFModel, overlaps

#: Numbers of points along each side of the picture at which PSFs are computed; the first that reaches the tolerance is used.
FIELD_POINTS = (9, 17)
#: PSFs are compared up to this radius beyond the geometric blur, in λN, which contains 99 % of the power of a clear circle.
REACH_LAMBDA_N = 20.0
#: Largest number of wavelengths whose PSFs determine the modes.
MAX_WAVELENGTHS = 3
#: Largest number of samples of all PSFs, 1 GiB in single precision: fewer wavelengths, and fewer points, are used so as not to
#: exceed it. Largest number in double precision.
MAX_SAMPLES, MAX_DOUBLE_SAMPLES = 1 << 28, 1 << 22
#: Largest number of samples across the aperture (a blur of 24 λN) for the larger number of points: the first frame then takes
#: some 30 s.
MAX_ACROSS = 384
#: If no number of modes reaches the tolerance, the modes may displace this multiple of the least possible fraction.
UNREACHED = 1.02
#: Samples whose products are computed in double precision together.
SAMPLES_TOGETHER = 1 << 16


@dataclass(frozen=True, eq=False)
class FieldWeight:
    """
    Function of the field at the pixels of a picture, ``along_y @ profiles``.

    ``along_y`` (n_y, n): functions along y, of which at most four in succession differ from 0 in each row. ``profiles``
    (n, n_x): their factors along x.
    """

    along_y: Floats
    profiles: Floats

    def at_pixels(self) -> Floats:
        """Return the values at all pixels, (n_y, n_x)."""
        return np.einsum("yi,ix->yx", self.along_y, self.profiles)


def field_weights(at_points: Floats, shape: tuple[int, int], degree: int = 3) -> list[FieldWeight]:
    """Return splines through values (m, n, n) at equidistant points of a picture."""
    # B-splines along y are local. A spline through 1 at one point and 0 at all others is not: it is nowhere 0 in between.
    along_y, coefficients = splines(at_points.shape[1], (np.arange(shape[0]) + 0.5) / shape[0], degree)
    along_x = interpolation(at_points.shape[2], (np.arange(shape[1]) + 0.5) / shape[1], degree)
    # Not as matrix products: the threads of BLAS would compete with ours.
    of_splines = np.einsum("ki,mij->mkj", coefficients, at_points)
    return [FieldWeight(along_y, np.einsum("kj,xj->kx", each, along_x)) for each in of_splines]


@dataclass(frozen=True, eq=False)
class FieldModes:
    """
    Modes of the PSFs at the points of a field.

    Attributes
    ----------
    points_um : (n_point, 2) float64, µm
        x and y of the points, row by row from the bottom.
    combinations : (n_mode, n_point) float64
        Coefficients of each mode as a sum of the PSFs at the points. The first mode is the mean; the coefficients of each
        other mode have the sum 0.
    at_points : (n_mode, n, n) float64
        Weights of the modes at the points.
    singular_values : (n_point - 1,) float64
        Singular values of the deviations from the mean PSF, sampled at λN/2, divided by the square root of the number of
        wavelengths; descending.
    displaced : float
        Largest fraction of the light of a point that the modes displace, at the points and between them.
    """

    points_um: Floats
    combinations: Floats
    at_points: Floats
    singular_values: Floats
    displaced: float

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for name in ("points_um", "combinations", "at_points", "singular_values"):
            object.__setattr__(self, name, frozen_array(as_numbers(name, getattr(self, name))))

    @property
    def n_modes(self) -> int:
        """Number of modes, including the mean."""
        return len(self.combinations)

    def weights(self, shape: tuple[int, int]) -> list[FieldWeight]:
        """Return the weights of all modes but the mean at the pixels of a picture."""
        return field_weights(self.at_points[1:], shape)


def splines(n_points: int, at: Floats, degree: int = 3) -> tuple[Floats, Floats]:
    """
    Return B-splines at positions from 0 to 1, (n, n_spline), and their coefficients.

    The coefficients (n_spline, n_points) are those of the splines through unit values at equidistant points.
    """
    from scipy.interpolate import BSpline, make_interp_spline

    spline = make_interp_spline(np.linspace(0.0, 1.0, n_points), np.eye(n_points), k=min(degree, n_points - 1))
    return BSpline.design_matrix(at, spline.t, spline.k).toarray(), np.asarray(spline.c)


def interpolation(n_points: int, at: Floats, degree: int = 3) -> Floats:
    """Return the matrix (n, n_points) that interpolates values at equidistant points."""
    along, coefficients = splines(n_points, at, degree)
    return np.einsum("nk,kp->np", along, coefficients)


def field_points_um(grid: Grid, n_points: int) -> Floats:
    """Return x and y of equidistant points from edge to edge of a picture, (n, n, 2) µm."""
    x0_um, y0_um, x1_um, y1_um = grid.bounds_um
    return np.stack(np.meshgrid(np.linspace(x0_um, x1_um, n_points), np.linspace(y0_um, y1_um, n_points)), axis=-1)


def find_modes(
    aperture: PSFModel,
    grid: Grid,
    wavelength_nm: Floats,
    lambda_n_um: Floats,
    *,
    tolerance: float,
    n_modes: int | None,
    n_threads: int,
) -> FieldModes:
    """
    Return the modes of the PSFs over the field of a picture, a grid of map cells.

    ``n_modes``: number of modes besides the mean; by default the smallest number that displaces at most the fraction
    ``tolerance`` of the light. The displaced fraction is half the L1 norm of the difference between the PSF and its sum of
    modes, evaluated at the points and midway between them. Cells wider than λN/2 are compared instead of samples. The larger
    number of points is used only if the smaller does not reach the tolerance.
    """
    first_um = field_points_um(grid, FIELD_POINTS[0]).reshape(-1, 2)
    sampling = Sampling.of(aperture, first_um, wavelength_nm, lambda_n_um, grid.pitch_x_um)
    found: FieldModes | None = None
    for n_points in FIELD_POINTS:
        is_affordable = sampling.n_across <= MAX_ACROSS and 2 * n_points * n_points * sampling.n_samples <= MAX_SAMPLES
        if found is None:
            found = _modes_at(aperture, grid, sampling, n_points, tolerance, n_modes, n_threads)
        elif is_affordable:
            finer = _modes_at(aperture, grid, sampling, n_points, tolerance, n_modes, n_threads)
            found = min(found, finer, key=attrgetter("displaced"))
        if n_modes is not None or found.displaced <= tolerance:
            break
    assert found is not None
    return found


def _modes_at(
    aperture: PSFModel,
    grid: Grid,
    sampling: Sampling,
    n_points: int,
    tolerance: float,
    n_modes: int | None,
    n_threads: int,
) -> FieldModes:
    """Return the modes of the PSFs at n x n points of a picture."""
    finer_um = field_points_um(grid, 2 * n_points - 1)
    is_point, is_midway = (np.zeros(finer_um.shape[:2], bool) for _ in range(2))
    is_point[::2, ::2], is_midway[1::2, 1::2] = True, True
    used = is_point | is_midway
    psfs = sampled_psfs(aperture, finer_um[used], sampling, n_threads)
    of_point = is_point[used]
    psfs -= psfs[of_point].mean(axis=0)
    at_points = psfs[of_point].reshape(n_points * n_points, -1)
    sizes, fields = _singular_vectors(at_points)
    weights = everywhere(fields.reshape(-1, n_points, n_points))[:, used]
    modes = fields.astype(psfs.dtype) @ at_points
    if n_modes is None:
        least = _displaced(psfs - _sum_of_modes(weights, modes, psfs.shape))
        goal, n_most = max(tolerance, UNREACHED * least), len(fields)
    else:
        goal, n_most = 0.0, min(n_modes, len(fields))
    n_found, displaced = _number_of_modes(psfs, weights, modes, goal, n_most)
    n_all = n_points * n_points
    return FieldModes(
        finer_um[is_point],
        np.concatenate((np.full((1, n_all), 1.0 / n_all), fields[:n_found])),
        np.concatenate((np.ones((1, n_all)), fields[:n_found])).reshape(-1, n_points, n_points),
        sizes / math.sqrt(psfs.shape[1]),
        displaced,
    )


def _singular_vectors(deviations: NDArray[Any]) -> tuple[Floats, Floats]:
    """
    Return the singular values and vectors of deviations from a mean.

    Their shapes are (n_point - 1,) and (n_point - 1, n_point). There are far fewer points than samples, so they are computed
    as eigenvectors of the scalar products of the points, orthogonal to the mean.
    """
    n_points, n_samples = deviations.shape
    products = np.zeros((n_points, n_points))
    for first in range(0, n_samples, SAMPLES_TOGETHER):
        part = deviations[:, first : first + SAMPLES_TOGETHER].astype(np.float64)
        products += part @ part.T
    # All directions but that of the mean.
    basis = np.linalg.qr(np.column_stack((np.ones(n_points), np.eye(n_points)[:, 1:])))[0][:, 1:]
    squares, vectors = np.linalg.eigh(basis.T @ products @ basis)
    return np.sqrt(np.maximum(squares[::-1], 0.0)), np.ascontiguousarray((basis @ vectors[:, ::-1]).T)


def everywhere(fields: Floats) -> Floats:
    """Interpolate values (..., n, n) midway between the points: (..., 2n - 1, 2n - 1)."""
    n_points = fields.shape[-1]
    along = interpolation(n_points, np.linspace(0.0, 1.0, 2 * n_points - 1))
    along[::2] = np.eye(n_points)
    return np.asarray(along @ fields @ along.T)


def _displaced(residual: NDArray[Any]) -> float:
    """Return the largest fraction of light that differences of PSFs displace."""
    return 0.5 * float(np.abs(residual).sum(axis=2).max())


def _sum_of_modes(weights: Floats, modes: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the sum of modes with weights (n_mode, n_point)."""
    return np.asarray(weights.T.astype(modes.dtype) @ modes).reshape(shape)


def _number_of_modes(
    deviations: NDArray[Any], weights: Floats, modes: NDArray[Any], goal: float, n_most: int
) -> tuple[int, float]:
    """
    Return the smallest number of modes for a fraction of displaced light.

    Also returns the fraction that they displace. ``deviations`` from the mean PSF are overwritten.
    """
    displaced = _displaced(deviations)
    for k in range(n_most):
        if displaced <= goal:
            return k, displaced
        deviations -= _sum_of_modes(weights[k : k + 1], modes[k : k + 1], deviations.shape)
        displaced = _displaced(deviations)
    return n_most, displaced


@dataclass(frozen=True)
class Sampling:
    """
    Sampling of PSFs at multiples of λN/2, or by sums over map cells if these are wider.

    The samples cover a square that contains the geometric blur. ``wavelength_nm``, ``lambda_n_um``: at most three wavelengths
    from the shortest to the longest, and λN of each. ``n_across``: number of samples across the aperture. ``radius``: number
    of samples on each side of the centre. ``cell_um``: width of the cells of a map, which does not resolve how light is
    distributed within them.
    """

    wavelength_nm: tuple[float, ...]
    lambda_n_um: tuple[float, ...]
    n_across: int
    radius: int
    cell_um: float

    @classmethod
    def of(
        cls, aperture: PSFModel, points_um: Floats, wavelength_nm: Floats, lambda_n_um: Floats, cell_um: float
    ) -> Sampling:
        """Return the samples for points of the field, (n, 2)."""
        points = [(float(x_um), float(y_um)) for x_um, y_um in points_um]
        waves_nm, which = np.unique(wavelength_nm, return_index=True)
        blur = max(aperture.blur_lambda_n(float(wave_nm), point) for wave_nm in waves_nm for point in points)
        n_across = max(aperture.n_across(float(wave_nm), point) for wave_nm in waves_nm for point in points)
        radius = min(math.ceil(2.0 * (blur + REACH_LAMBDA_N)), n_across - 1)
        single = cls((0.0,), (float(lambda_n_um.max()),), n_across, radius, cell_um)
        # Twice the points, because PSFs are also sampled midway between them.
        n_waves = max(1, min(waves_nm.size, MAX_WAVELENGTHS, MAX_SAMPLES // (2 * single.n_samples * len(points))))
        chosen = np.linspace(0, waves_nm.size - 1, n_waves).round().astype(int) if n_waves > 1 else np.zeros(1, int)
        return replace(
            single,
            wavelength_nm=tuple(waves_nm[chosen].tolist()),
            lambda_n_um=tuple(lambda_n_um[which[chosen]].tolist()),
        )

    @property
    def n_side(self) -> int:
        """Number of samples or cells along a side."""
        widest_um = 0.5 * max(self.lambda_n_um)
        if self.cell_um <= widest_um:
            return 2 * self.radius + 1
        return 2 * math.ceil((self.radius + 0.5) * widest_um / self.cell_um - 0.5) + 1

    @property
    def n_samples(self) -> int:
        """Number of samples per point, at all wavelengths."""
        return len(self.wavelength_nm) * self.n_side**2

    def sums(self, psf: NDArray[Any], wave: int) -> NDArray[Any]:
        """Return samples of a PSF, or their sums over cells."""
        step_um = 0.5 * self.lambda_n_um[wave]
        if self.cell_um <= 0.5 * max(self.lambda_n_um):
            return psf
        onto = overlaps(self.n_side, self.cell_um / step_um, psf.shape[0], 1.0) * (self.cell_um / step_um)
        return np.asarray((onto @ (onto @ psf).T).T)


def sampled_psfs(aperture: PSFModel, points_um: Floats, sampling: Sampling, n_threads: int) -> NDArray[Any]:
    """Return samples of the PSFs at points of the field, (n_point, n_wavelength, n_sample)."""
    points = [(float(x_um), float(y_um)) for x_um, y_um in points_um]
    n_waves = len(sampling.wavelength_nm)
    real: Any = np.float64 if len(points) * sampling.n_samples <= MAX_DOUBLE_SAMPLES else np.float32
    psfs = np.empty((len(points), n_waves, sampling.n_samples // n_waves), real)
    for w, wave_nm in enumerate(sampling.wavelength_nm):

        def compute(k: int, w: int = w, wave_nm: float = wave_nm) -> None:
            psf = aperture.sampled_psf(wave_nm, sampling.n_across, sampling.radius, points[k], real)
            psfs[k, w] = sampling.sums(psf, w).ravel() * real(aperture.relative_power(wave_nm, points[k]))

        compute(0)  # samples the pupil, which all points share
        parallel_map(compute, range(1, len(points)), n_threads)
    return psfs
