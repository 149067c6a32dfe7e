"""
PSFs at any position of the field, from those of a :class:`foveasim.optics.PSFGrid`.

:class:`FieldPSFs` has the methods of :class:`foveasim.optics._aperture.Aperture` with which point images, power maps and modes
of the field are computed. Frequencies are in units of ``1 / u``: u is λN, or two samples if these are coarser.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError, SamplingWarning, warn
from foveasim.optics._aperture import ACROSS_PER_BLUR, MAX_ACROSS, MIN_ACROSS, check_reach
from foveasim.units import um_from_nm

if TYPE_CHECKING:
    from foveasim.optics.psfs._grid import PSFGrid

#: Fraction of the light within the radius that counts as blur, and this radius in an Airy pattern, in λN.
BLUR_FRACTION, AIRY_LAMBDA_N = 0.95, 4.25
#: Samples per sample before PSFs are turned, and order of the spline: 1e-4 of the amplitude at λN/2 per sample.
FINER, SPLINE_ORDER = 3, 5
#: Largest ratio of the distances of points that are interpolated by cubic splines: those through others overshoot.
MAX_STEP_RATIO = 2.0
#: Relative rounding error of distances of samples in files.
ROUNDING = 1e-3


@dataclass(frozen=True, eq=False)
class FieldPSFs:
    """PSFs over the field at the working f-number of a lens."""

    psfs: PSFGrid
    f_number: float

    @classmethod
    def at(cls, psfs: PSFGrid, f_number: float) -> FieldPSFs:
        """Create the PSFs, with a warning if samples are coarser than λN/2."""
        needed_um = 0.5 * um_from_nm(psfs.wavelength_nm) * f_number
        worst = int(np.argmax(psfs.pitches_um / needed_um))
        if psfs.pitches_um[worst] > (1.0 + ROUNDING) * needed_um[worst]:
            warn(
                f"the PSFs have samples of {psfs.pitches_um[worst]:.4g} µm, coarser than λN/2 = {needed_um[worst]:.4g} µm at "
                f"{psfs.wavelength_nm[worst]:g} nm and f/{f_number:.4g}: fine detail is lost or displaced; export finer "
                "samples, or check f_number",
                SamplingWarning,
            )
        return cls(psfs, f_number)

    @property
    def is_achromatic(self) -> bool:
        """Whether no samples of a pupil depend on the wavelength: there are none."""
        return True

    @property
    def is_clear_circle(self) -> bool:
        """Whether the OTF is that of a clear circle, which is unknown."""
        return False

    def unit_um(self, wavelength_nm: Any) -> Any:
        """Return λN, or two samples if these are coarser."""
        return self.psfs.cut_off_um(wavelength_nm, um_from_nm(wavelength_nm) * self.f_number)

    def transmittance(self, wavelength_nm: float) -> float:  # noqa: ARG002
        """Return the transmitted power; that of the lens follows from its f-number."""
        return 1.0

    def edge(self, wavelength_nm: float) -> float:  # noqa: ARG002
        """Return the edge length of the pupil relative to a circle, which is unknown."""
        return 1.0

    def blur_lambda_n(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:  # noqa: ARG002
        """Return the radius of all PSFs beyond that of an Airy pattern, in units."""
        unit_um = float(self.unit_um(wavelength_nm))
        return max(0.0, self._blur_um / unit_um - AIRY_LAMBDA_N)

    @cached_property
    def _blur_um(self) -> float:
        """Largest radius around the image point of :data:`BLUR_FRACTION` of the light."""
        psf, pitches_um = self.psfs.psf, self.psfs.pitches_um
        # Varying PSFs are centred on their centroids.
        offset_x, offset_y = (0.0, 0.0) if self.psfs.is_varying else self.psfs.middle_offset
        n_y, n_x = psf.shape[2:]
        row, column = np.arange(n_y) - n_y // 2 + offset_y, np.arange(n_x) - n_x // 2 + offset_x
        radius = np.hypot(row[:, np.newaxis], column).ravel()
        order = np.argsort(radius)
        displaced_um = np.hypot(*np.moveaxis(self.psfs.centroid_um, -1, 0)) * self.psfs.is_varying
        largest_um = 0.0
        for p in range(psf.shape[0]):
            for w in range(psf.shape[1]):
                enclosed = np.cumsum(self._central[p, w].ravel()[order], dtype=np.float64)
                within = float(radius[order][min(int(np.searchsorted(enclosed, BLUR_FRACTION)), radius.size - 1)])
                largest_um = max(largest_um, within * float(pitches_um[w]) + float(displaced_um[p, w]))
        return largest_um

    def n_across(self, wavelength_nm: float, field_um: tuple[float, float]) -> int:
        """Return the frequency steps per unit that the table of an OTF requires."""
        blur = self.blur_lambda_n(wavelength_nm, field_um)
        if blur * ACROSS_PER_BLUR > MAX_ACROSS:
            limit = MAX_ACROSS // ACROSS_PER_BLUR
            raise ParameterError(
                "psfs",
                f"must spread {BLUR_FRACTION:.0%} of the light over a radius of at most {limit} λN or {2 * limit} samples, got "
                f"{self._blur_um:.4g} µm at {wavelength_nm:g} nm",
                hint="give coarser samples, or a part of the PSF",
            )
        return max(MIN_ACROSS, math.ceil(blur * ACROSS_PER_BLUR))

    # -- interpolation --------------------------------------------------------------------------------------------

    @cached_property
    def _central(self) -> NDArray[Any]:
        """PSFs with their centroids at the centre, if they vary over the field."""
        psf = self.psfs.psf
        if not self.psfs.is_varying:
            return psf
        n_y, n_x = psf.shape[2:]
        # From the middle sample to the centroid, in samples.
        shift = self.psfs.centroid_um / self.psfs.pitches_um[:, np.newaxis] - self.psfs.middle_offset
        phase_x, phase_y = (
            np.exp(2j * np.pi * shift[..., axis, np.newaxis] * np.fft.fftfreq(n)) for axis, n in ((0, n_x), (1, n_y))
        )
        found = np.empty_like(psf)
        for p in range(psf.shape[0]):
            spectra = np.fft.fft2(psf[p]) * phase_y[p, :, :, np.newaxis] * phase_x[p, :, np.newaxis, :]
            found[p] = np.fft.ifft2(spectra).real
        return found

    @property
    def _turned_side(self) -> int:
        """Odd number of samples along a side that contains turned PSFs."""
        return 2 * math.ceil(0.5 * math.hypot(*self.psfs.psf.shape[2:])) + 1

    @cached_property
    def _splines(self) -> NDArray[Any]:
        """Spline coefficients of finer samples, (n_point, n_wavelength, k n_y, k n_x)."""
        from scipy.ndimage import spline_filter
        from scipy.signal import resample

        psf = self._central
        half = [(self._turned_side - n) // 2 for n in psf.shape[2:]]
        psf = np.pad(psf, [(0, 0), (0, 0), *((each, each) for each in half)])
        for axis in (2, 3):
            # From the first to the last sample, symmetric around the centre.
            finer = resample(psf, FINER * psf.shape[axis], axis=axis)
            psf = np.take(finer, np.arange(FINER * (psf.shape[axis] - 1) + 1), axis)
        found = np.empty_like(psf)
        for at in np.ndindex(*psf.shape[:2]):
            spline_filter(psf[at], SPLINE_ORDER, output=found[at])  # type: ignore[call-overload]
        return found

    def _weights(self, field_um: Floats) -> tuple[Floats, Floats]:
        """Return weights of the points at positions (n, 2), and the angles of their PSFs."""
        from scipy.interpolate import make_interp_spline

        axes, n = self.psfs.axes, len(field_um)
        if not axes:
            return np.ones((n, 1)), np.zeros(n)
        height_um = np.hypot(field_um[:, 0], field_um[:, 1])
        at_um = field_um.T if len(axes) == 2 else height_um[np.newaxis]
        along = [
            make_interp_spline(axis, np.eye(axis.size), k=_degree(axis))(np.clip(at, axis[0], axis[-1]))
            for axis, at in zip(axes, at_um, strict=True)
        ]
        weights = np.empty((n, self.psfs.x_um.size))
        weights[:, self.psfs.order] = (
            along[0] if len(axes) == 1 else np.einsum("ny,nx->nyx", *along[::-1]).reshape(n, -1)
        )
        angles_rad = np.arctan2(field_um[:, 1], field_um[:, 0]) - self.psfs.azimuth_rad
        return weights, np.where((height_um > 0.0) & (len(axes) == 1), angles_rad, 0.0)

    def _of_wavelength(self, wavelength_nm: float) -> Floats:
        """Return the weights of the wavelengths, (n_wavelength,)."""
        waves_nm = self.psfs.wavelength_nm
        return np.array([np.interp(wavelength_nm, waves_nm, row) for row in np.eye(waves_nm.size)])

    def illumination(self, field_um: Floats) -> Floats | None:
        """Return the mean relative illumination at positions (n, 2); None if unknown."""
        fraction = self.psfs.relative_illumination
        return None if fraction is None else np.maximum(self._weights(field_um)[0] @ fraction.mean(axis=1), 0.0)

    def relative_power(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the relative illumination at a wavelength over the mean of all."""
        fraction = self.psfs.relative_illumination
        if fraction is None or not np.ptp(fraction, axis=1).any():
            return 1.0
        weights = self._weights(np.array([field_um], np.float64))[0][0]
        mean = float(weights @ fraction.mean(axis=1))
        return max(0.0, float(weights @ fraction @ self._of_wavelength(wavelength_nm)) / mean) if mean > 0.0 else 1.0

    def _sample(
        self, wavelength_nm: float, field_um: tuple[float, float]
    ) -> list[tuple[NDArray[Any], float, tuple[float, float]]]:
        """
        Return the terms of a PSF, one for each pitch.

        Each has values (n_y, n_x), the pitch, and the position (x, y) of the middle sample relative to the image point, µm.
        """
        (weights,), (angle_rad,) = self._weights(np.array([field_um], np.float64))
        waves, pitches_um = self._of_wavelength(wavelength_nm), self.psfs.pitches_um
        source = self._splines if angle_rad else self._central
        x_um, y_um = np.einsum("p,pwi,w->i", weights, self.psfs.centroid_um, waves)
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        centroid_um = cos * x_um - sin * y_um, sin * x_um + cos * y_um
        found = []
        for pitch_um in dict.fromkeys(pitches_um[waves > 0.0].tolist()):
            psf = np.zeros(source.shape[2:], source.dtype)
            has_pitch = (waves > 0.0) & (pitches_um == pitch_um)
            for w in np.flatnonzero(has_pitch):
                psf += np.einsum("p,pyx->yx", (waves[w] * weights).astype(source.dtype), source[:, w])
            if angle_rad:
                psf = self._turn(psf, float(angle_rad)) * float(waves[has_pitch].sum())
            # The samples of one PSF for the whole field contain their displacement.
            offset_x, offset_y = self.psfs.middle_offset
            middle_um = centroid_um if self.psfs.is_varying else (offset_x * pitch_um, offset_y * pitch_um)
            found.append((psf, pitch_um, middle_um))
        return found

    def _turn(self, coefficients: NDArray[Any], angle_rad: float) -> NDArray[Any]:
        """Return samples of a spline, turned counter-clockwise around the centre."""
        from scipy.ndimage import affine_transform

        n = self._turned_side
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        # From rows and columns of the result to those of the finer samples.
        matrix = FINER * np.array([[cos, -sin], [sin, cos]])
        centre = np.array([n // 2, n // 2])
        turned = affine_transform(  # type: ignore[call-overload]
            coefficients,
            matrix,
            FINER * centre - matrix @ centre,
            (n, n),
            order=SPLINE_ORDER,
            mode="constant",
            prefilter=False,
        )
        return np.asarray(turned / turned.sum())

    # -- the methods of an aperture -------------------------------------------------------------------------------

    def compute_otf(
        self,
        wavelength_nm: float,
        n_across: float,
        n_lags: int,
        field_um: tuple[float, float],
        real: type[np.floating[Any]],
    ) -> NDArray[np.complexfloating[Any]]:
        """
        Compute the OTF at frequencies ``k / (n_across u)``, k from -n_lags to n_lags.

        Returns (2 n_lags + 1, 2 n_lags + 1) complex64 or complex128, rows along y: 0 from the cut-off frequency ``1 / u``.
        """
        lags = np.arange(-n_lags, n_lags + 1)
        upper = np.zeros((n_lags + 1, lags.size), np.complex128)
        for psf, pitch_um, middle_um in self._sample(wavelength_nm, field_um):
            step = pitch_um / (n_across * float(self.unit_um(wavelength_nm)))
            # The OTF of a real PSF at -f is the complex conjugate: rows k >= 0 suffice. Chirp z-transforms instead of matrix
            # products, since the threads of BLAS would compete with ours.
            term = _fourier(_fourier(psf, lags * step, 1), lags[n_lags:] * step, 0)
            for axis, (k, at_um) in enumerate(zip((lags[n_lags:], lags), middle_um[::-1], strict=True)):
                factor = np.exp(-2j * np.pi * (at_um / pitch_um) * step * k)
                if self.psfs.samples == "bins":
                    factor /= np.sinc(k * step)
                term *= np.expand_dims(factor, 1 - axis)
            upper += term
        upper[np.hypot(lags[n_lags:, np.newaxis], lags) >= n_across] = 0.0
        upper = np.ascontiguousarray(upper, np.result_type(real, np.complex64))
        return np.concatenate((np.conj(upper[:0:-1, ::-1]), upper))

    def sampled_psf(
        self, wavelength_nm: float, n_across: int, radius: int, field_um: tuple[float, float], real: Any
    ) -> NDArray[np.floating[Any]]:
        """Sample the PSF at multiples of u/2, up to ``radius`` of them along each axis."""
        # Fewer frequencies than for interpolation suffice, so that copies of the PSF, 2 n multiples apart, do not overlap it.
        half = self._turned_side * float(self.psfs.pitches_um.max()) / float(self.unit_um(wavelength_nm))
        n = min(n_across, math.ceil(0.5 * (radius + half)) + 1)
        otf = self.compute_otf(wavelength_nm, n, n, field_um, np.float64)
        at = np.arange(-radius, radius + 1) * (-0.5 / n)
        return np.asarray(_fourier(_fourier(otf, at, 1), at, 0).real / (4 * n * n), real)

    def psf_per_um2(
        self, wavelength_nm: float, lambda_n_um: float, x_um: Floats, y_um: Floats, field_um: tuple[float, float]
    ) -> Floats:
        """Sample the PSF, 1/µm², at points (y, x), (n_y, n_x)."""
        reach = check_reach(lambda_n_um, x_um, y_um)
        n = max(self.n_across(wavelength_nm, field_um), math.ceil(2.0 * reach))
        otf = self.compute_otf(wavelength_nm, n, n, field_um, np.float64)
        s = np.arange(-n, n + 1) / (n * lambda_n_um)
        waves = [np.exp(2j * np.pi * np.outer(at_um, s)) for at_um in (y_um, x_um)]
        return np.asarray((waves[0] @ otf @ waves[1].T).real / (n * lambda_n_um) ** 2)

    def strehl(self, wavelength_nm: float, field_um: tuple[float, float]) -> float:
        """Return the PSF at the image point relative to that of a clear circle of the f-number."""
        at, unit_um = np.zeros(1), float(self.unit_um(wavelength_nm))
        peak = self.psf_per_um2(wavelength_nm, unit_um, at, at, field_um)
        return float(peak[0, 0]) / self.ideal_peak_per_um2(wavelength_nm, unit_um, field_um)

    def ideal_peak_per_um2(
        self,
        wavelength_nm: float,
        lambda_n_um: float,  # noqa: ARG002
        field_um: tuple[float, float],  # noqa: ARG002
    ) -> float:
        """Return the peak of a clear circle of the f-number, 1/µm²."""
        return 0.25 * math.pi / (float(um_from_nm(wavelength_nm)) * self.f_number) ** 2

    def otf(
        self, wavelength_nm: float, s_x: Floats, s_y: Floats, field_um: tuple[float, float]
    ) -> NDArray[np.complex128]:
        """Return the OTF at frequencies in units of ``1 / u``."""
        x, y = np.broadcast_arrays(np.asarray(s_x, np.float64), np.asarray(s_y, np.float64))
        unit_um = float(self.unit_um(wavelength_nm))
        found = np.zeros(x.size, np.complex128)
        for psf, pitch_um, middle_um in self._sample(wavelength_nm, field_um):
            along_y, along_x = (
                np.exp(-2j * np.pi / unit_um * np.outer(s.ravel(), (np.arange(n) - n // 2) * pitch_um + at_um))
                for s, n, at_um in zip((y, x), psf.shape, middle_um[::-1], strict=True)
            )
            term = np.einsum("fy,yx,fx->f", along_y, psf, along_x, optimize=True)
            if self.psfs.samples == "bins":
                term /= (np.sinc(x * pitch_um / unit_um) * np.sinc(y * pitch_um / unit_um)).ravel()
            found += term
        return np.where(np.hypot(x, y) < 1.0, found.reshape(x.shape), 0.0)


def _degree(axes: Floats) -> int:
    """Return the degree of splines: cubic through about equidistant coordinates, or linear."""
    steps = np.diff(axes)
    return min(3, axes.size - 1) if steps.max() <= MAX_STEP_RATIO * steps.min() else 1


def _fourier(values: NDArray[Any], cycles: NDArray[Any], axis: int) -> NDArray[np.complex128]:
    """Transform values around the middle one, at equidistant cycles per value."""
    from scipy.signal import czt

    step = float(cycles[1] - cycles[0]) if cycles.size > 1 else 0.0
    found = czt(values, cycles.size, np.exp(-2j * np.pi * step), np.exp(2j * np.pi * float(cycles[0])), axis=axis)
    centre = np.exp(2j * np.pi * cycles * (values.shape[axis] // 2))
    return np.asarray(found * np.expand_dims(centre, 1 - axis))
