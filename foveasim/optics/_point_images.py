"""
Point images: PSF, OTF, encircled and ensquared energy.

A clear circular pupil in focus has closed forms. For all other apertures, the PSF and the OTF are integrated over the pupil,
and the encircled and ensquared energy are computed from a sampled pupil.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FINITE, POSITIVE, Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, check_choice, finite_array
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.optics._aperture import PSFModel
from foveasim.optics._quadrature import gauss_nodes
from foveasim.optics.otf import circular_otf

#: Default number of PSF samples along either axis, and their pitch in λN.
PSF_POINTS, PSF_LAMBDA_N = 257, 0.125
#: Minimum number of samples across the aperture for encircled and ensquared energy, with half the error of power maps.
POINT_ACROSS = 384
#: Minimum number of samples across an aperture that cannot be integrated, for the OTF.
OTF_ACROSS = 768
#: Radial and angular quadratures of the ensquared energy: minimum number of nodes, and additional nodes per λN of the side. The
#: number is rounded up to a multiple of the third value, so that squares of similar sides share nodes.
QUADRATURE_NODES, NODES_PER_LAMBDA_N, NODES_STEP = 64, 8, 32
#: Side (λN) above which the asymptotic PSF gives the ensquared energy to 1e-5.
MIN_ASYMPTOTIC_SIDE = 100.0
#: Largest circle or square (λN) for a sampled pupil, whose PSF is periodic with eight times this size.
MAX_EXTENT = 256.0
#: Search of the peak of a PSF: coarse steps in λN, and their number beyond the blur radius and at most; values that may be the
#: peak, relative to the largest of the coarse samples, and their number; zooms with points along a side, down to 4e-4 λN, an
#: error of 1e-6.
PEAK_STEP, PEAK_MARGIN, MAX_PEAK_STEPS = 0.25, 6, 512
PEAK_CANDIDATES, MAX_CANDIDATES, PEAK_ZOOMS, PEAK_POINTS = 0.75, 16, 4, 11
_STEPS = (-1, 0, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class PointSpread:
    """
    Sampled point spread function.

    Attributes
    ----------
    psf_per_um2 : (n_y, n_x) float64, 1/µm²
        PSF of unit total energy at the cell centres; row 0 is the bottom row.
    grid : Grid
        Cells around the image point.
    wavelength_nm : float, nm

    Examples
    --------
    >>> import foveasim as fs
    >>> point = fs.Optics(focal_length_mm=8.0, f_number=2.8).psf(550.0)
    >>> round(float(point.psf_per_um2.max()), 3)  # π / (2 λ N)²
    0.331
    """

    psf_per_um2: Floats
    grid: Grid
    wavelength_nm: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class Point:
    """Point source imaged at ``field_um`` on the sensor; N in λN is the image-side f-number."""

    aperture: PSFModel
    is_clear_circle: bool
    wavelength_nm: float
    lambda_n_um: float
    field_um: tuple[float, float]

    def psf_per_um2(self, x_um: Floats, y_um: Floats) -> Floats:
        """Sample the PSF at the points (y, x), (n_y, n_x)."""
        if not self.is_clear_circle:
            return self.aperture.psf_per_um2(self.wavelength_nm, self.lambda_n_um, x_um, y_um, self.field_um)
        from scipy.special import j1

        v = np.pi * np.hypot(x_um[np.newaxis, :], y_um[:, np.newaxis]) / self.lambda_n_um
        v = np.maximum(v, 1e-9)
        return np.asarray(0.25 * np.pi * (2.0 * j1(v) / v) ** 2 / self.lambda_n_um**2)

    def compute_otf(self, s_x: Floats, s_y: Floats) -> NDArray[np.complex128]:
        """Return the OTF at frequencies in units of 1/λN."""
        if self.is_clear_circle:
            return circular_otf(np.hypot(s_x, s_y)).astype(np.complex128)
        exact = self.aperture.otf(self.wavelength_nm, s_x, s_y, self.field_um)
        if exact is not None:
            return exact
        from scipy.ndimage import map_coordinates

        n = max(OTF_ACROSS, self.aperture.n_across(self.wavelength_nm, self.field_um))
        otf = self.aperture.compute_otf(self.wavelength_nm, n, n, self.field_um, np.float64)
        at = [np.ravel(s_y) * n + n, np.ravel(s_x) * n + n]
        real, imaginary = (map_coordinates(part, at, order=1, mode="constant") for part in (otf.real, otf.imag))
        return np.asarray(real + 1j * imaginary).reshape(np.shape(s_x))

    def strehl_at_peak(self) -> float:
        """Return the maximum of the PSF relative to that without aberrations."""
        n = math.ceil(self.aperture.blur_lambda_n(self.wavelength_nm, self.field_um) / PEAK_STEP) + PEAK_MARGIN
        n = min(n, MAX_PEAK_STEPS)
        at_um = np.arange(-n, n + 1, dtype=np.float64) * (PEAK_STEP * self.lambda_n_um)
        coarse = self.psf_per_um2(at_um, at_um)
        inner = np.pad(coarse, 1)
        neighbours = [
            inner[1 + i : inner.shape[0] - 1 + i, 1 + j : inner.shape[1] - 1 + j] for i in _STEPS for j in _STEPS
        ]
        is_maximum = (coarse >= PEAK_CANDIDATES * coarse.max()) & np.all(
            [coarse >= each for each in neighbours], axis=0
        )
        rows, columns = np.nonzero(is_maximum)
        order = np.argsort(coarse[rows, columns])[::-1][:MAX_CANDIDATES]
        ideal = self.aperture.ideal_peak_per_um2(self.wavelength_nm, self.lambda_n_um, self.field_um)
        peaks = [self._peak_near(at_um[columns[k]], at_um[rows[k]]) for k in order]
        return min(1.0, max(peaks) / ideal)

    def _peak_near(self, x_um: float, y_um: float) -> float:
        """Return the maximum of the PSF within one coarse step of a point, 1/µm²."""
        step_um, found = PEAK_STEP * self.lambda_n_um, 0.0
        for _ in range(PEAK_ZOOMS):
            offset_um = np.linspace(-step_um, step_um, PEAK_POINTS)
            values = self.psf_per_um2(x_um + offset_um, y_um + offset_um)
            row, column = np.unravel_index(int(values.argmax()), values.shape)
            x_um, y_um = x_um + float(offset_um[column]), y_um + float(offset_um[row])
            step_um, found = 2.0 * step_um / (PEAK_POINTS - 1), float(values[row, column])
        return found

    def encircled_energy(self, radius_um: Floats) -> Floats:
        """Return the encircled energy."""
        from scipy.special import j0, j1

        radius = radius_um / self.lambda_n_um
        if self.is_clear_circle:
            v = np.pi * radius
            return np.asarray(1.0 - j0(v) ** 2 - j1(v) ** 2)  # Rayleigh; Born and Wolf, section 8.5.2
        otf, n = self._plane(float(radius.max(initial=0.0)), "radius_um")
        s = np.arange(-n, n + 1) / n
        frequency = np.maximum(np.hypot(s[:, np.newaxis], s), 1e-9)
        # Fourier transform of a disc of radius R: R J1(2π R f) / f.
        fractions = [
            np.sum(otf.real * (r * j1(2.0 * np.pi * r * frequency) / frequency)) / n**2 for r in radius.ravel()
        ]
        return np.array(fractions).reshape(radius.shape)

    def ensquared_energy(self, side_um: Floats) -> Floats:
        """Return the ensquared energy of squares parallel to the axes."""
        side = side_um / self.lambda_n_um
        if self.is_clear_circle:
            return np.array([_airy_in_square(float(a)) for a in side.ravel()]).reshape(side.shape)
        otf, n = self._plane(float(side.max(initial=0.0)), "side_um")
        boxes = side.reshape(-1, 1) * np.sinc(side.reshape(-1, 1) * np.arange(-n, n + 1) / n)
        return np.einsum("ij,jk,ik->i", boxes, otf.real, boxes, optimize=True).reshape(side.shape) / n**2

    def _plane(self, extent: float, name: str) -> tuple[NDArray[np.complexfloating], int]:
        """Return the OTF at the frequencies ``k / n`` along both axes, k from -n to n, and n."""
        if extent > MAX_EXTENT:
            raise ParameterError(
                name, f"must be <= {MAX_EXTENT:.0f} λN for a sampled pupil", extent * self.lambda_n_um, "µm"
            )
        # Sampling in frequency makes the PSF periodic: the period must exceed ``extent`` (λN) by a wide margin.
        n = max(POINT_ACROSS, self.aperture.n_across(self.wavelength_nm, self.field_um), int(8.0 * extent))
        return self.aperture.compute_otf(self.wavelength_nm, n, n, self.field_um, np.float64), n


def _airy_in_square(side: float) -> float:
    """
    Compute the ensquared energy of the Airy pattern.

    By Parseval's theorem, this is the integral of the OTF times the transform of the square, in polar coordinates.
    """
    if side > MIN_ASYMPTOTIC_SIDE:
        # Asymptotic mean of the Airy pattern: 1 / (π³ r³), integrated outside the square.
        return 1.0 - 8.0 * math.sqrt(2.0) / (math.pi**3 * side)
    nodes, weights = gauss_nodes(NODES_STEP * math.ceil((QUADRATURE_NODES + NODES_PER_LAMBDA_N * side) / NODES_STEP))
    s, ds = 0.5 * (nodes + 1.0), 0.5 * weights
    angle, angle_weights = 0.25 * np.pi * 0.5 * (nodes + 1.0), 0.25 * np.pi * 0.5 * weights  # an eighth of the circle
    square = np.sinc(side * np.outer(s, np.cos(angle))) * np.sinc(side * np.outer(s, np.sin(angle)))
    return float(8.0 * side**2 * (circular_otf(s) * s * ds) @ square @ angle_weights)


class PointImages:
    """Point-image methods of :class:`foveasim.Optics`."""

    __slots__ = ()

    def _point(self, wavelength_nm: float, distance_m: float | None, field_um: tuple[float, float]) -> Point:
        """Return a point source with validated parameters."""
        raise NotImplementedError

    def psf(
        self,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
        pitch_um: Annotated[float, POSITIVE] | None = None,
        n_points: Annotated[int, Limits(at_least=1, at_most=8192)] = PSF_POINTS,
    ) -> PointSpread:
        """
        Compute the point spread function.

        Parameters
        ----------
        wavelength_nm : float, nm
        distance_m : float, optional, m
            Distance of the point; by default the focus distance, or infinity.
        field_um : (x, y), µm
            Position of the image point on the sensor.
        pitch_um : float, optional, µm
            Sampling pitch; by default λN/8.
        n_points : int
            Number of samples along either axis, centred on the image point.

        Returns
        -------
        PointSpread
            Samples of the PSF, normalised to unit energy (1/µm²).

        Notes
        -----
        The amplitude is integrated over the pupil by Gauss quadrature between the edges of the pupil. For the pupils of this
        package with aberrations of 0.5 waves rms, the error is below 1e-6 of the peak at every point. The number of nodes
        follows from the aberrations and from the distance of the points, so that values do not depend on ``n_points``.
        Callables are integrated with the same error if they are smooth, or if they specify their discontinuities by a method
        ``edges()`` that returns :class:`foveasim.optics.PupilEdges`; others are sampled, with an error up to 1e-3 of the peak.
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        grid = Grid.centred((n_points, n_points), PSF_LAMBDA_N * point.lambda_n_um if pitch_um is None else pitch_um)
        return PointSpread(
            psf_per_um2=point.psf_per_um2(grid.x_um, grid.y_um), grid=grid, wavelength_nm=point.wavelength_nm
        )

    def otf(
        self,
        frequency_per_mm: ArrayLike,
        wavelength_nm: float,
        *,
        angle_deg: Annotated[float, FINITE] = 0.0,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.complex128]:
        """
        Compute the optical transfer function.

        Parameters
        ----------
        frequency_per_mm : array, cycles per mm on the sensor
        wavelength_nm : float, nm
        angle_deg : float, degrees
            Direction of the frequency vector, counter-clockwise from the x axis.
        distance_m, field_um
            As for :meth:`psf`.

        Returns
        -------
        otf : array of the same shape, complex128
            ``∫ PSF(r) exp(-2πi f·r) dr``, 1 at zero frequency.

        Notes
        -----
        Each frequency is a quadrature as for :meth:`psf`, over the overlap of two displaced copies of the pupil (Hopkins, Proc.
        R. Soc. A 231 (1955) 91), with an error below 1e-6; it takes 1 to 6 ms, 25 ms for the largest aberrations, or 30 ms for
        an aperture given as a picture of 64 x 64 pixels. Apertures given as pictures of more than 128 x 128 pixels (counted
        together with a picture of the wavefront), computations of more than 2^27 nodes, and callables with discontinuities at
        unspecified edges are sampled, with an error up to 1e-3.
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        s = finite_array("frequency_per_mm", frequency_per_mm) * 1e-3 * point.lambda_n_um
        angle = math.radians(angle_deg)
        return point.compute_otf(s * math.cos(angle), s * math.sin(angle))

    def mtf(
        self,
        frequency_per_mm: ArrayLike,
        wavelength_nm: float,
        *,
        angle_deg: Annotated[float, FINITE] = 0.0,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> Floats:
        """Compute the MTF, the absolute value of :meth:`otf`; parameters as for :meth:`otf`."""
        return np.asarray(
            np.abs(
                self.otf(frequency_per_mm, wavelength_nm, angle_deg=angle_deg, distance_m=distance_m, field_um=field_um)
            )
        )

    def strehl(
        self,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
        reference: Literal["peak", "image_point"] = "peak",
    ) -> float:
        """
        Compute the Strehl ratio: peak of the PSF, relative to that without aberrations.

        Parameters
        ----------
        wavelength_nm, distance_m, field_um
            As for :meth:`psf`.
        reference : {"peak", "image_point"}
            Position at which the PSF is taken. ``"peak"``: its maximum, as lens design programs report it; a tilt of the
            wavefront, which is part of coma and of distortion, displaces an image and does not change it. ``"image_point"``:
            the point without aberrations, for light in a fixed pinhole, fibre or photosite.

        Returns
        -------
        float
            From 0 to 1; approximately ``exp(-(2πσ)²)`` for a wavefront error of σ waves rms without tilt (Mahajan, J. Opt. Soc.
            Am. 73 (1983) 860).

        Raises
        ------
        ParameterError
            As for :meth:`psf`.

        Examples
        --------
        >>> import foveasim as fs
        >>> coma = fs.optics.Seidel(coma_um=0.165, field_radius_um=100.0)  # 0.3 waves at 550 nm
        >>> lens = fs.Optics(focal_length_mm=8.0, f_number=4.0, seidel=coma)
        >>> [
        ...     round(lens.strehl(550.0, field_um=(100.0, 0.0), reference=at), 3)
        ...     for at in ("peak", "image_point")
        ... ]
        [0.952, 0.647]
        """
        check_choice("reference", reference, ("peak", "image_point"))
        point = self._point(wavelength_nm, distance_m, field_um)
        if point.is_clear_circle:
            return 1.0
        if reference == "image_point":
            return point.aperture.strehl(point.wavelength_nm, point.field_um)
        return point.strehl_at_peak()

    def encircled_energy(
        self,
        radius_um: ArrayLike,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> Floats:
        """
        Compute the encircled energy around the image point.

        Parameters
        ----------
        radius_um : array, µm
        wavelength_nm, distance_m, field_um
            As for :meth:`psf`.

        Returns
        -------
        fraction : array of the same shape, float64
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        return point.encircled_energy(finite_array("radius_um", radius_um, at_least=0.0))

    def ensquared_energy(
        self,
        side_um: ArrayLike,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> Floats:
        """
        Compute the ensquared energy around the image point, for squares parallel to the axes.

        Parameters
        ----------
        side_um : array, µm
        wavelength_nm, distance_m, field_um
            As for :meth:`psf`.

        Returns
        -------
        fraction : array of the same shape, float64
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        return point.ensquared_energy(finite_array("side_um", side_um, at_least=0.0))
