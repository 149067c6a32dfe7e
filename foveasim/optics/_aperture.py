"""
Complex amplitude in the aperture, and the OTF and PSF computed from it.

Point images are integrals over the aperture, by :mod:`foveasim.optics._quadrature`. OTF tables for power maps, and pupils that
are discontinuous at unknown edges, use equidistant samples.

The amplitude ``P(r)`` in the aperture of radius a produces the amplitude ``∫ P(r) exp(-2πi x·r / (λD)) dr`` at the point x
of the sensor, at the image distance D. The OTF is the normalised autocorrelation of P, at lags ``λ D f``. In units of the
aperture radius, with the image-side f-number ``N = D / 2a``, the lag is ``2 λN f``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats
from foveasim.errors import ParameterError, type_name
from foveasim.optics._quadrature import Nodes, PupilEdges, joined, plane_waves, pupil_nodes
from foveasim.optics.pupils import Annulus, Blades, Half, Pupil, PupilImage, Slit, Spider
from foveasim.units import um_from_nm

#: Samples across an unaberrated aperture; the OTF is then accurate to 4e-4.
MIN_ACROSS = 192
#: Samples across the aperture per λN of geometric blur; the PSF at the blur radius is then too low by 1.3 %.
ACROSS_PER_BLUR = 16
#: Upper limit of the samples across the aperture, which limits the geometric blur to 128 λN.
MAX_ACROSS = 2048
#: Points across the aperture at which pupil callables are evaluated; odd, so that edges at simple fractions lie between points.
PUPIL_POINTS = 1535
#: Largest number of cached samples of a pupil: the wavelengths of a picture.
MAX_CACHED_MEANS = 4
#: Points across the aperture at which the wavefront slope is evaluated.
SLOPE_POINTS = 193
#: Half the distance of the points of a central difference, in radii.
SLOPE_STEP = 1e-4
#: Frequencies of the quadrature in radians per radius: the first beyond the geometric blur, the factor between attempts, and
#: the limit beyond which a pupil is sampled.
FIRST_RADIANS, RADIANS_STEP, MAX_RADIANS = 8.0, 1.5, 500.0
#: Relative difference of the power from that of samples above which the quadrature has missed edges; smooth pupils: 3e-5.
MISSED_POWER = 5e-5
#: Largest number of nodes of OTFs without sampling: some seconds.
MAX_OTF_NODES = 1 << 27
#: Error of converged integrals over the aperture, relative to that of the modulus.
INTEGRAL_ERROR = 1e-8
#: Waves whose integrals are compared, in radians per radius: without a symmetry that would cancel errors.
PROBES = ((0.0, 0.0), (3.1, 1.3), (-4.2, 5.7))
#: Largest number of pixel edges along a side of a pupil whose OTF is computed without sampling: 0.1 s per frequency.
MAX_OTF_LINES = 128
#: Power transmittance below which a pupil counts as empty.
MIN_TRANSMITTANCE = 1e-9


class Wavefront(Protocol):
    """Aberration as optical path difference over the aperture."""

    def wavefront_um(self, x: Floats, y: Floats, wavelength_nm: float, field_um: tuple[float, float]) -> Floats:
        """
        Return the path difference in µm for the image point ``field_um`` (x, y) on the sensor.

        ``x`` and ``y`` are in aperture radii.
        """


class PSFModel(Protocol):
    """
    PSFs of a lens at all positions of the field, from its aperture or from samples.

    Lengths are in units of λN, or of two samples if these are coarser.
    """

    @property
    def is_clear_circle(self) -> bool:
        """Whether the OTF is that of a clear circle in focus."""

    @property
    def is_achromatic(self) -> bool:
        """Whether the same samples serve all wavelengths."""

    def transmittance(self, wavelength_nm: float) -> float:
        """Return the transmitted power relative to that of the clear circle."""

    def edge(self, wavelength_nm: float) -> float:
        """Return the edge length per area of the pupil, relative to a clear circle."""

    def illumination(self, field_um: Floats) -> Floats | None:
        """Return the relative illumination at positions (n, 2), None for that of a thin lens."""

    def relative_power(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the relative illumination at a wavelength over that of :meth:`illumination`."""

    def blur_lambda_n(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the radius of the blur without diffraction."""

    def n_across(self, wavelength_nm: float, field_um: tuple[float, float]) -> int:
        """Return the frequency steps per cut-off frequency that the table of an OTF requires."""

    def sampled_psf(
        self, wavelength_nm: float, n_across: int, radius: int, field_um: tuple[float, float], real: Any
    ) -> NDArray[np.floating[Any]]:
        """Sample the PSF at multiples of half a unit, up to ``radius`` of them along each axis."""

    def compute_otf(
        self,
        wavelength_nm: float,
        n_across: float,
        n_lags: int,
        field_um: tuple[float, float],
        real: type[np.floating[Any]],
    ) -> NDArray[np.complexfloating[Any]]:
        """Compute the OTF at frequencies ``k / n_across``, k from -n_lags to n_lags."""

    def psf_per_um2(
        self, wavelength_nm: float, lambda_n_um: float, x_um: Floats, y_um: Floats, field_um: tuple[float, float]
    ) -> Floats:
        """Sample the PSF, 1/µm², at points (y, x), (n_y, n_x)."""

    def strehl(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the PSF at the image point relative to that without aberrations."""

    def ideal_peak_per_um2(self, wavelength_nm: float, lambda_n_um: float, field_um: tuple[float, float]) -> float:
        """Return the PSF at the image point without aberrations, 1/µm²."""

    def otf(
        self, wavelength_nm: float, s_x: Floats, s_y: Floats, field_um: tuple[float, float]
    ) -> NDArray[np.complex128] | None:
        """Return the OTF at frequencies, or None if it must be interpolated."""


@runtime_checkable
class EdgedPupil(Protocol):
    """Pupil that specifies where it is discontinuous."""

    def edges(self) -> PupilEdges:
        """Return the curves at which the amplitude, or its derivative, is discontinuous."""


def _edges_of(pupil: EdgedPupil) -> PupilEdges:
    """Return the edges of a pupil after checking their type."""
    try:
        found: object = pupil.edges()
    except TypeError as error:
        raise ParameterError("pupil", f"must have a method edges() without arguments; {error}") from error
    if not isinstance(found, PupilEdges):
        raise ParameterError("pupil", f"must return PupilEdges from edges(), got {type_name(found)}")
    return found


def overlaps(n_to: int, to_step: float, n_from: int, from_step: float, offset: float = 0.0) -> Any:
    """
    Compute the overlaps of two rows of cells, as fractions of the target cells.

    ``offset`` is the distance from the centre of the source row to that of the target row.

    Returns ``fractions`` (n_to, n_from) sparse array.
    """
    from scipy.sparse import coo_array, diags_array

    to_edges = (np.arange(n_to + 1) - 0.5 * n_to) * to_step + offset
    from_edges = (np.arange(n_from + 1) - 0.5 * n_from) * from_step
    cuts = np.unique(np.concatenate((to_edges, from_edges)))
    centres, lengths = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)
    row = np.searchsorted(to_edges, centres) - 1
    column = np.searchsorted(from_edges, centres) - 1
    is_both = (row >= 0) & (row < n_to) & (column >= 0) & (column < n_from)
    lengths_of_overlap = coo_array((lengths[is_both], (row[is_both], column[is_both])), shape=(n_to, n_from))
    return diags_array(np.full(n_to, 1.0 / to_step)) @ lengths_of_overlap.tocsr()


def check_reach(lambda_n_um: float, x_um: Floats, y_um: Floats) -> float:
    """Return the largest distance of points in λN/2; raise a ParameterError beyond a limit."""
    reach = 2.0 * float(max(np.abs(x_um).max(), np.abs(y_um).max())) / lambda_n_um
    if reach > 0.5 * MAX_ACROSS:
        raise ParameterError(
            "pitch_um",
            f"times (n_points - 1) / 2 must be at most {MAX_ACROSS // 4} λN = "
            f"{0.25 * MAX_ACROSS * lambda_n_um:.4g} µm for a sampled pupil, got {0.5 * reach * lambda_n_um:.4g} µm",
        )
    return reach


@dataclass(frozen=True, eq=False)
class Aperture:
    """
    Amplitude transmission and wavefront of an aperture.

    ``pupils``: amplitude transmissions, multiplied; 0 outside the unit circle. ``wavefronts``: path differences, added.
    ``defocus_um`` (float, µm): path difference at the edge of the aperture; proportional to the squared radius.
    """

    pupils: Sequence[Pupil]
    wavefronts: Sequence[Wavefront]
    defocus_um: float

    @property
    def is_clear_circle(self) -> bool:
        """Whether the OTF is that of a clear circle in focus."""
        return not self.pupils and not self.wavefronts and self.defocus_um == 0.0

    @property
    def is_defocused_circle(self) -> bool:
        """Whether the OTF is that of a clear circle, in focus or not."""
        return not self.pupils and not self.wavefronts

    def illumination(self, field_um: Floats) -> None:
        """Return None: the relative illumination is that of the thin lens."""

    def relative_power(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:  # noqa: ARG002
        """Return 1: the relative illumination is that of all wavelengths."""
        return 1.0

    @cached_property
    def is_achromatic(self) -> bool:
        """Whether all pupils are known to be independent of the wavelength."""
        plain = (Annulus, Blades, Half, Slit, Spider)
        return all(isinstance(p, plain) or (isinstance(p, PupilImage) and p.wavefront_um is None) for p in self.pupils)

    @cached_property
    def _cache(self) -> dict[Any, Any]:
        """Cache: the last sampled shape, and transmittance and slope per wavelength."""
        return {}

    def _sample_pupil(self, wavelength_nm: float, n: int) -> NDArray[Any]:
        """Sample the amplitudes on an (n, n) grid over the square around the aperture."""
        key = 0.0 if self.is_achromatic else wavelength_nm, n
        known = self._cache.get("shape")  # with its key in one object, since threads replace it
        if known is None or known[0] != key:
            at: Floats = np.asarray((np.arange(n) + 0.5) * (2.0 / n) - 1.0, np.float64)
            x, y = at[np.newaxis, :], at[:, np.newaxis]
            disc = x * x + y * y <= 1.0
            shape: NDArray[Any] = disc.astype(np.float64)
            for i, pupil in enumerate(self.pupils):
                shape = shape * self._evaluate_pupil(i, pupil, x, y, wavelength_nm, disc)
            known = self._cache["shape"] = key, shape
        return np.asarray(known[1])

    def _evaluate_pupil(
        self, i: int, pupil: Pupil, x: Floats, y: Floats, wavelength_nm: float, disc: Bools
    ) -> NDArray[Any]:
        name = "pupil" if len(self.pupils) == 1 else f"pupil[{i}]"
        values = np.asarray(pupil(x, y, wavelength_nm))
        if values.dtype.kind not in "biufc":
            raise ParameterError(name, f"must return real or complex amplitudes, got dtype {values.dtype}")
        try:
            values = np.where(disc, values, 0.0)
        except ValueError:
            raise ParameterError(
                name, f"must return amplitudes that broadcast with x and y, got shape {values.shape}"
            ) from None
        highest = float(np.abs(values).max())
        if not highest <= 1.0 + 1e-9:
            raise ParameterError(name, f"must return amplitudes <= 1 at {wavelength_nm:g} nm", highest)
        return values

    def _transmittance_slope_edge(self, wavelength_nm: float) -> tuple[float, float, float]:
        """Return transmittance, phase slope in waves per radius, and relative edge length."""
        key = 0.0 if self.is_achromatic else wavelength_nm
        if key not in self._cache:
            shape = self._sample_pupil(wavelength_nm, PUPIL_POINTS)
            at = (np.arange(PUPIL_POINTS) + 0.5) * (2.0 / PUPIL_POINTS) - 1.0
            transmittance = float(np.sum(np.abs(shape) ** 2) / np.count_nonzero(at**2 + at[:, np.newaxis] ** 2 <= 1.0))
            if transmittance < MIN_TRANSMITTANCE:
                raise ParameterError("pupil", f"must transmit power, got an empty pupil at {wavelength_nm:g} nm")
            slope = 0.0
            for a, b in ((shape[1:], shape[:-1]), (shape[:, 1:], shape[:, :-1])) if np.iscomplexobj(shape) else ():
                phase_step = np.abs(np.angle(a * np.conj(b)))[(a != 0.0) & (b != 0.0)]
                # The 99 % quantile excludes phase steps, which diffract but do not displace the PSF.
                slope += (
                    float(np.quantile(phase_step, 0.99)) / (2.0 * np.pi) * 0.5 * PUPIL_POINTS
                    if phase_step.size
                    else 0.0
                )
            # Crofton: the steps along both axes count an edge of random direction 4/π times its length.
            steps = sum(float(np.sum(np.abs(np.diff(shape, axis=axis)) ** 2)) for axis in (0, 1))
            edge = 0.25 * np.pi * steps * (2.0 / PUPIL_POINTS) / (transmittance * np.pi)
            self._cache[key] = transmittance, slope, max(0.5 * edge, 1.0)
        transmittance, slope, edge = self._cache[key]
        return transmittance, slope, edge

    def transmittance(self, wavelength_nm: float) -> float:
        """
        Return the transmitted power relative to that of the clear circle.

        Raises ParameterError when no power is transmitted.
        """
        return self._transmittance_slope_edge(wavelength_nm)[0] if self.pupils else 1.0

    def edge(self, wavelength_nm: float) -> float:
        """Return the edge length per area of the pupil, relative to a clear circle; at least 1."""
        return self._transmittance_slope_edge(wavelength_nm)[2] if self.pupils else 1.0

    def path_um(self, x: Floats, y: Floats, wavelength_nm: float, field_um: tuple[float, float]) -> Floats:
        """Return the total path difference in µm, defocus included, at points of the aperture."""
        total_um = self.defocus_um * (x * x + y * y)
        for part in self.wavefronts:
            total_um = total_um + part.wavefront_um(x, y, wavelength_nm, field_um)
        return np.asarray(total_um)

    def ray_slopes(self, points: Floats, wavelength_nm: float, field_um: tuple[float, float]) -> Floats:
        """Return the slope of the wavefront along x and y, µm per radius, at points (n, 2)."""
        x, y = points.T
        step = SLOPE_STEP
        path_um = partial(self.path_um, wavelength_nm=wavelength_nm, field_um=field_um)
        along_x, along_y = path_um(x + step, y) - path_um(x - step, y), path_um(x, y + step) - path_um(x, y - step)
        return np.stack((along_x, along_y), axis=1) / (2.0 * step)

    def blur_lambda_n(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the largest geometric ray displacement in units of λN: twice the slope in waves."""
        slope = self._transmittance_slope_edge(wavelength_nm)[1] if self.pupils else 0.0
        key = wavelength_nm, field_um
        if (self.wavefronts or self.defocus_um) and key not in self._cache:
            at = np.linspace(-1.0, 1.0, SLOPE_POINTS)
            x, y = at[np.newaxis, :], at[:, np.newaxis]
            step_waves = (at[1] - at[0]) * float(um_from_nm(wavelength_nm))
            dy, dx = np.gradient(self.path_um(x, y, wavelength_nm, field_um) / step_waves)
            self._cache[key] = float(np.hypot(dx, dy)[x * x + y * y <= 1.0].max())
        return 2.0 * (slope + float(self._cache.get(key, 0.0)))

    def _checked_blur(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """
        Return :meth:`blur_lambda_n` within the limit of the largest transform.

        Raises ParameterError when the blur is larger.
        """
        blur = self.blur_lambda_n(wavelength_nm, field_um)
        if blur * ACROSS_PER_BLUR > MAX_ACROSS:
            raise ParameterError(
                "aberrations",
                f"must blur a point by at most {MAX_ACROSS // ACROSS_PER_BLUR} λN, got {blur:.0f} λN at {wavelength_nm:g} nm",
                hint="check the unit of the coefficients and that focus_distance_m is in m; diffraction is negligible "
                "in a larger blur, so the picture can be blurred beforehand instead",
            )
        return blur

    def n_across(self, wavelength_nm: float, field_um: tuple[float, float]) -> int:
        """
        Return the number of samples across the aperture that the OTF requires.

        Raises ParameterError when the geometric blur exceeds the limit of the largest transform.
        """
        return max(MIN_ACROSS, math.ceil(self._checked_blur(wavelength_nm, field_um) * ACROSS_PER_BLUR))

    def samples(
        self, wavelength_nm: float, n_across: float, field_um: tuple[float, float]
    ) -> tuple[NDArray[np.complex128], Floats, float]:
        """
        Sample the complex amplitude in the aperture.

        ``n_across``: samples across the diameter, not necessarily an integer. Returns ``amplitude`` (n, n) complex128: pupil
        transmission, averaged over the squares around the points, times the phase factor at the points. ``at`` (n,) float64:
        sample positions along either axis, in aperture radii. ``power``: sum of the squared amplitudes in the limit of fine
        sampling.
        """
        pitch = 2.0 / n_across
        shape = self._mean_pupil(wavelength_nm, n_across)
        n = shape.shape[0]
        at: Floats = np.asarray((np.arange(n) - 0.5 * (n - 1)) * pitch, np.float64)
        amplitude = shape * np.exp(
            2j
            * np.pi
            / float(um_from_nm(wavelength_nm))
            * self.path_um(at[np.newaxis, :], at[:, np.newaxis], wavelength_nm, field_um)
        )
        return amplitude, at, self.transmittance(wavelength_nm) * np.pi / pitch**2

    def _mean_pupil(self, wavelength_nm: float, n_across: float) -> NDArray[Any]:
        """Return the amplitudes of the pupil, averaged over the squares around the samples."""
        key = 0.0 if self.is_achromatic else wavelength_nm, n_across
        known: dict[Any, NDArray[Any]] = self._cache.get("mean", {})
        found = known.get(key)
        if found is None:
            n = math.ceil(n_across)
            fine = self._sample_pupil(wavelength_nm, max(PUPIL_POINTS, n))
            mean = overlaps(n, 2.0 / n_across, fine.shape[0], 2.0 / fine.shape[0])
            found = (mean @ (mean @ fine).T).T
            # The most recent ones, in another object, since threads read it.
            self._cache["mean"] = dict([*known.items(), (key, found)][-MAX_CACHED_MEANS:])
        return found

    def sampled_psf(
        self, wavelength_nm: float, n_across: int, radius: int, field_um: tuple[float, float], real: Any
    ) -> NDArray[np.floating[Any]]:
        """
        Sample the PSF at multiples of λN/2, up to ``radius`` of them along each axis.

        ``n_across``: samples across the aperture. Returns (2 radius + 1, 2 radius + 1), of unit sum over all multiples.
        """
        import scipy.fft

        amplitude, _, power = self.samples(wavelength_nm, n_across, field_um)
        amplitude = amplitude.astype(np.result_type(real, np.complex64))
        wave = scipy.fft.fft2(amplitude, (2 * n_across, 2 * n_across), overwrite_x=True)
        multiples = np.arange(-radius, radius + 1)
        near = wave[np.ix_(multiples, multiples)]
        return np.asarray((near.real**2 + near.imag**2) / real(4 * n_across * n_across * power))

    def compute_otf(
        self,
        wavelength_nm: float,
        n_across: float,
        n_lags: int,
        field_um: tuple[float, float],
        real: type[np.floating[Any]],
    ) -> NDArray[np.complexfloating[Any]]:
        """
        Compute the OTF at integer lags, as the normalised autocorrelation of the amplitude.

        Returns ``otf`` (2 n_lags + 1, 2 n_lags + 1) complex64 or complex128: at frequencies ``k / (n_across λN)``, k from
        -n_lags to n_lags, rows along y.
        """
        import scipy.fft

        amplitude, _, power = self.samples(wavelength_nm, n_across, field_um)
        n = amplitude.shape[0]
        size = scipy.fft.next_fast_len(2 * n)
        complex_type = np.result_type(real, np.complex64)
        wave = scipy.fft.fft2(amplitude.astype(complex_type), (size, size), overwrite_x=True)
        psf = wave.real**2 + wave.imag**2
        otf = scipy.fft.fft2(psf, overwrite_x=True)
        otf /= size * size * power
        k = min(n_lags, n - 1)
        table = np.zeros((2 * n_lags + 1, 2 * n_lags + 1), complex_type)
        lags = np.arange(-k, k + 1)
        table[n_lags - k : n_lags + k + 1, n_lags - k : n_lags + k + 1] = otf[np.ix_(lags, lags)]
        table[n_lags, n_lags] = 1.0  # conserves energy exactly
        return table

    @cached_property
    def _edges(self) -> PupilEdges:
        """Known edges of all pupils."""
        parts: Sequence[object] = self.pupils
        return joined([_edges_of(pupil) for pupil in parts if isinstance(pupil, EdgedPupil)])

    def _transmission(self, x: Floats, y: Floats, wavelength_nm: float) -> NDArray[np.complex128]:
        """Return the amplitude transmission of all pupils at points (n,) of the aperture."""
        total = np.ones((1, x.size), np.complex128)
        if x.size:
            x, y = x[np.newaxis], y[np.newaxis]
            disc = x * x + y * y <= 1.0
            for i, pupil in enumerate(self.pupils):
                total = total * self._evaluate_pupil(i, pupil, x, y, wavelength_nm, disc)
        return np.broadcast_to(total, (1, x.size))[0]

    def _amplitude(
        self, x: Floats, y: Floats, wavelength_nm: float, field_um: tuple[float, float]
    ) -> NDArray[np.complex128]:
        """Return transmission times phase factor at points (n,) of the aperture."""
        amplitude = self._transmission(x, y, wavelength_nm)
        if not self.wavefronts and not self.defocus_um:
            return amplitude
        path_um = self.path_um(x, y, wavelength_nm, field_um)
        return np.asarray(amplitude * np.exp(2j * np.pi / float(um_from_nm(wavelength_nm)) * path_um))

    def _resolve(
        self, wavelength_nm: float, field_um: tuple[float, float]
    ) -> tuple[float | None, NDArray[np.complex128]]:
        """
        Return the highest frequency of the amplitude, and integrals over the aperture.

        The frequency is in radians per radius. It is None if the integrals do not converge: a pupil is discontinuous at
        unknown edges. The integrals are those of the amplitude times each of :data:`PROBES`, of its modulus, and of the
        squared modulus.
        """
        key = "integrals", wavelength_nm, field_um
        if key not in self._cache:
            first = FIRST_RADIANS + np.pi * self._checked_blur(wavelength_nm, field_um)
            radians: float | None = first
            integrals = self._integrals(wavelength_nm, field_um, first)
            while radians is not None:
                finer = self._integrals(wavelength_nm, field_um, RADIANS_STEP * radians)
                error = np.abs(finer - integrals).max() / max(finer[-2].real, MIN_TRANSMITTANCE)
                integrals = finer
                if error <= INTEGRAL_ERROR:
                    break
                radians = RADIANS_STEP * radians if radians < max(MAX_RADIANS, 4.0 * first) else None
            if radians is not None and not all(isinstance(pupil, EdgedPupil) for pupil in self.pupils):
                # Coarse quadratures may agree although both miss an edge of a callable.
                sampled = math.pi * self.transmittance(wavelength_nm)
                if abs(integrals[-1].real - sampled) > MISSED_POWER * sampled:
                    radians = None
            self._cache[key] = radians, integrals
        found: tuple[float | None, NDArray[np.complex128]] = self._cache[key]
        return found

    def _integrals(self, wavelength_nm: float, field_um: tuple[float, float], radians: float) -> NDArray[np.complex128]:
        total = np.zeros(len(PROBES) + 2, np.complex128)
        for nodes in self._nodes(wavelength_nm, radians):
            amplitude = self._amplitude(nodes.x, nodes.y, wavelength_nm, field_um)
            weighted = nodes.weight * amplitude
            total += [
                *(weighted @ np.exp(-1j * (kx * nodes.x + ky * nodes.y)) for kx, ky in PROBES),
                np.abs(weighted).sum(),
                np.vdot(amplitude, weighted),
            ]
        return total

    def _nodes(self, wavelength_nm: float, radians: float) -> Iterator[Nodes]:
        """Yield the nodes of a quadrature for a highest frequency in radians per radius."""
        return pupil_nodes(self._edges, partial(self._transmission, wavelength_nm=wavelength_nm), radians)

    def psf_per_um2(
        self, wavelength_nm: float, lambda_n_um: float, x_um: Floats, y_um: Floats, field_um: tuple[float, float]
    ) -> Floats:
        """Sample the PSF of unit energy, 1/µm², at equidistant points (y, x), (n_y, n_x)."""
        reach = check_reach(lambda_n_um, x_um, y_um)
        # At the image distance D of an aperture of radius a, the phase of the point x changes by 2π a x / (λ D) per radius.
        along_y, along_x = (np.pi / lambda_n_um * at for at in (y_um, x_um))
        radians, integrals = self._resolve(wavelength_nm, field_um)
        if radians is None:
            n_across = max(
                self.n_across(wavelength_nm, field_um), min(MAX_ACROSS, PUPIL_POINTS, math.ceil(4.0 * reach))
            )
            amplitude, at, power = self.samples(wavelength_nm, n_across, field_um)
            wave_y, wave_x = (np.exp(-1j * np.outer(along, at)) for along in (along_y, along_x))
            return np.asarray(np.abs(wave_y @ amplitude @ wave_x.T) ** 2 / power / (n_across * lambda_n_um) ** 2)
        wave = np.zeros((y_um.size, x_um.size), np.complex128)
        for nodes in self._nodes(wavelength_nm, radians + 0.5 * np.pi * reach):
            amplitude = self._amplitude(nodes.x, nodes.y, wavelength_nm, field_um)
            wave += np.exp(-1j * np.outer(along_y, nodes.row_y)) @ plane_waves(nodes, nodes.weight * amplitude, along_x)
        return np.asarray(np.abs(wave) ** 2 / integrals[-1].real / (2.0 * lambda_n_um) ** 2)

    def strehl(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the PSF at the image point relative to that of the same aperture without phase."""
        radians, integrals = self._resolve(wavelength_nm, field_um)
        total, size = integrals[0], integrals[-2]
        if radians is None:
            n_across = max(self.n_across(wavelength_nm, field_um), PUPIL_POINTS)
            amplitude, _, _ = self.samples(wavelength_nm, n_across, field_um)
            total, size = amplitude.sum(), np.abs(amplitude).sum()
        return min(1.0, float(np.abs(total / size) ** 2))  # 1 exceeded by rounding

    def ideal_peak_per_um2(self, wavelength_nm: float, lambda_n_um: float, field_um: tuple[float, float]) -> float:
        """Return the PSF at the image point of the same aperture without phase, 1/µm²."""
        radians, integrals = self._resolve(wavelength_nm, field_um)
        if radians is None:
            n_across = max(self.n_across(wavelength_nm, field_um), PUPIL_POINTS)
            amplitude, _, power = self.samples(wavelength_nm, n_across, field_um)
            return float(np.abs(amplitude).sum() ** 2 / power / (n_across * lambda_n_um) ** 2)
        return float(np.abs(integrals[-2]) ** 2 / integrals[-1].real / (2.0 * lambda_n_um) ** 2)

    def otf(
        self, wavelength_nm: float, s_x: Floats, s_y: Floats, field_um: tuple[float, float]
    ) -> NDArray[np.complex128] | None:
        """
        Return the OTF at frequencies in units of 1/λN, or None if it must be sampled.

        Each frequency is a quadrature over the overlap of two copies of the aperture.
        """
        n_lines = max(np.size(self._edges.lines_x), np.size(self._edges.lines_y))
        if n_lines > MAX_OTF_LINES:
            return None
        radians, integrals = self._resolve(wavelength_nm, field_um)
        if radians is None:
            return None
        shape = np.broadcast_shapes(s_x.shape, s_y.shape)
        lags, of_frequency = np.unique(
            np.stack([np.broadcast_to(s, shape).ravel() for s in (s_x, s_y)], axis=1), axis=0, return_inverse=True
        )
        if len(lags) * (2.0 * radians + 4.0 * n_lines) ** 2 > MAX_OTF_NODES:
            return None
        found = [self._overlap(wavelength_nm, (float(x), float(y)), field_um, 2.0 * radians) for x, y in lags]
        power = integrals[-1].real
        return np.asarray(np.array(found, np.complex128)[of_frequency.ravel()].reshape(shape) / power)

    def _overlap(
        self, wavelength_nm: float, shift: tuple[float, float], field_um: tuple[float, float], radians: float
    ) -> complex:
        """Return the correlation of the amplitude at the lag ``2 * shift``."""
        if math.hypot(*shift) >= 1.0:
            return 0.0j

        def product(
            amplitude: Callable[[Floats, Floats], NDArray[np.complex128]], x: Floats, y: Floats
        ) -> NDArray[np.complex128]:
            dx, dy = shift
            both = amplitude(np.concatenate((x - dx, x + dx)), np.concatenate((y - dy, y + dy)))
            return np.asarray(both[: x.size] * np.conj(both[x.size :]))

        transmission = partial(self._transmission, wavelength_nm=wavelength_nm)
        amplitude = partial(self._amplitude, wavelength_nm=wavelength_nm, field_um=field_um)
        copies = (shift, (-shift[0], -shift[1]))
        every = pupil_nodes(self._edges, partial(product, transmission), radians, copies)
        return sum((complex(nodes.weight @ product(amplitude, nodes.x, nodes.y)) for nodes in every), 0.0j)
