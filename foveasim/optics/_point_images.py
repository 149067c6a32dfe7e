"""
The image of one point: its pattern, its transfer function, the light in circles and squares around it.

The clear circle in focus has closed forms; every other aperture is sampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import Floats, check_count, check_number, finite_array
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.optics._aperture import Aperture
from foveasim.optics.otf import circular_otf

__all__ = ["Point", "PointImages", "PointSpread"]

#: Points along either axis of a point spread function, and their distance in λN, unless told otherwise.
PSF_POINTS, PSF_LAMBDA_N = 257, 0.125
#: Samples across the aperture for the numbers of one point, at least: half the error that maps have.
POINT_ACROSS = 384
#: Nodes of the radial and angular quadratures of a circle's light in squares, at least, and more for each λN of the side.
QUADRATURE_NODES, NODES_PER_LAMBDA_N = 64, 8
#: From this side on (λN) the pattern's mean fall tells the rest, to 1e-5.
FAR_SIDE = 100.0
#: Circles and squares that a sampled pupil's light is told of (λN): its pattern repeats at eight times this.
MAX_EXTENT = 256.0


@dataclass(frozen=True, eq=False, kw_only=True)
class PointSpread:
    """
    The image of a point.

    Attributes
    ----------
    psf_per_um2 : (n_y, n_x) float64, 1/µm²
        Fraction of the light in a µm², at the cells' centres; row 0 lowest.
    grid : Grid
        Cells around the image point.
    wavelength_nm : float, nm
    """

    psf_per_um2: Floats
    grid: Grid
    wavelength_nm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Point:
    """A point of light behind an aperture, imaged at ``field_um`` on the sensor; λN is with the image-side f-number N."""

    aperture: Aperture
    is_clear_circle: bool
    wavelength_nm: float
    lambda_n_um: float
    field_um: tuple[float, float]

    def pattern_per_um2(self, x_um: Floats, y_um: Floats) -> Floats:
        """Fraction of the light in a µm² at the points of a rectangle, (n_y, n_x)."""
        if not self.is_clear_circle:
            return self.aperture.pattern_per_um2(self.wavelength_nm, self.lambda_n_um, x_um, y_um, self.field_um)
        from scipy.special import j1

        v = np.pi * np.hypot(x_um[np.newaxis, :], y_um[:, np.newaxis]) / self.lambda_n_um
        v = np.maximum(v, 1e-9)
        return np.asarray(0.25 * np.pi * (2.0 * j1(v) / v) ** 2 / self.lambda_n_um**2)

    def transfer(self, s_x: Floats, s_y: Floats) -> NDArray[np.complex128]:
        """Transfer function at frequencies in units of 1/λN."""
        if self.is_clear_circle:
            return circular_otf(np.hypot(s_x, s_y)).astype(np.complex128)
        from scipy.ndimage import map_coordinates

        otf, n = self._plane(0.0, "")
        at = [np.ravel(s_y) * n + n, np.ravel(s_x) * n + n]
        real, imaginary = (map_coordinates(part, at, order=1, mode="constant") for part in (otf.real, otf.imag))
        return np.asarray(real + 1j * imaginary).reshape(np.shape(s_x))

    def in_circles(self, radius_um: Floats) -> Floats:
        """Fraction of the light within radii."""
        from scipy.special import j0, j1

        radius = radius_um / self.lambda_n_um
        if self.is_clear_circle:
            v = np.pi * radius
            return np.asarray(1.0 - j0(v) ** 2 - j1(v) ** 2)  # Rayleigh; Born and Wolf, section 8.5.2
        otf, n = self._plane(float(radius.max(initial=0.0)), "radius_um")
        s = np.arange(-n, n + 1) / n
        frequency = np.maximum(np.hypot(s[:, np.newaxis], s), 1e-9)
        # A disc's transform is R J1(2π R f) / f.
        shares = [np.sum(otf.real * (r * j1(2.0 * np.pi * r * frequency) / frequency)) / n**2 for r in radius.ravel()]
        return np.array(shares).reshape(radius.shape)

    def in_squares(self, side_um: Floats) -> Floats:
        """Fraction of the light in upright squares of sides."""
        side = side_um / self.lambda_n_um
        if self.is_clear_circle:
            return np.array([_airy_in_square(float(a)) for a in side.ravel()]).reshape(side.shape)
        otf, n = self._plane(float(side.max(initial=0.0)), "side_um")
        boxes = side.reshape(-1, 1) * np.sinc(side.reshape(-1, 1) * np.arange(-n, n + 1) / n)
        return np.einsum("ij,jk,ik->i", boxes, otf.real, boxes, optimize=True).reshape(side.shape) / n**2

    def _plane(self, extent: float, name: str) -> tuple[NDArray[np.complexfloating], int]:
        """Transfer function on a square of frequencies ``k / n``, k from -n to n, and n."""
        if extent > MAX_EXTENT:
            raise ParameterError(
                name, f"must be <= {MAX_EXTENT:.0f} λN where the pupil is sampled", extent * self.lambda_n_um, "µm"
            )
        # The step makes the pattern repeat: no copy of it may touch what is looked at, up to ``extent`` in λN.
        n = max(POINT_ACROSS, self.aperture.n_across(self.wavelength_nm, self.field_um), int(8.0 * extent))
        return self.aperture.transfer(self.wavelength_nm, n, n, self.field_um, np.float64), n


def _airy_in_square(side: float) -> float:
    """Fraction of a clear circle's light in a square: the product of their transfer functions, in polar coordinates."""
    if side > FAR_SIDE:
        # Far out the pattern falls as 1 / (π³ r³) on the mean; outside the square lies its integral.
        return 1.0 - 8.0 * math.sqrt(2.0) / (math.pi**3 * side)
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_NODES + int(NODES_PER_LAMBDA_N * side))
    s, ds = 0.5 * (nodes + 1.0), 0.5 * weights
    angle, turn = 0.25 * np.pi * 0.5 * (nodes + 1.0), 0.25 * np.pi * 0.5 * weights  # an eighth of the circle
    square = np.sinc(side * np.outer(s, np.cos(angle))) * np.sinc(side * np.outer(s, np.sin(angle)))
    return float(8.0 * side**2 * (circular_otf(s) * s * ds) @ square @ turn)


class PointImages:
    """What a lens makes of one point: methods of :class:`foveasim.Optics`."""

    __slots__ = ()

    def _point(self, wavelength_nm: float, distance_m: float | None, field_um: tuple[float, float]) -> Point:
        """A point of light, its parameters checked."""
        raise NotImplementedError

    def psf(
        self,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
        pitch_um: float | None = None,
        n_points: int = PSF_POINTS,
    ) -> PointSpread:
        """
        Point spread function.

        Parameters
        ----------
        wavelength_nm : float, nm
        distance_m : float, optional, m
            Of the point; by default the distance of the focus, or infinity.
        field_um : (x, y), µm
            Where on the sensor the point is imaged.
        pitch_um : float, optional, µm
            Distance of the samples; by default λN/8.
        n_points : int
            Samples along either axis, the middle one at the image point.

        Returns
        -------
        PointSpread
            Samples of the fraction of the light in a µm².

        Raises
        ------
        ParameterError
            When a value is out of range.
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        pitch_um = (
            PSF_LAMBDA_N * point.lambda_n_um if pitch_um is None else check_number("pitch_um", pitch_um, above=0.0)
        )
        n_points = check_count("n_points", n_points, at_most=8192)
        grid = Grid.centred((n_points, n_points), pitch_um)
        return PointSpread(
            psf_per_um2=point.pattern_per_um2(grid.x_um, grid.y_um), grid=grid, wavelength_nm=point.wavelength_nm
        )

    def otf(
        self,
        frequency_per_mm: ArrayLike,
        wavelength_nm: float,
        *,
        angle_deg: float = 0.0,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.complex128]:
        """
        Optical transfer function.

        Parameters
        ----------
        frequency_per_mm : array, cycles per mm on the sensor
        wavelength_nm : float, nm
        angle_deg : float, degrees
            Direction in which the grating varies, counter-clockwise from the x axis.
        distance_m, field_um
            As for :meth:`psf`.

        Returns
        -------
        otf : array of the same shape, complex128
            ``∫ PSF(r) exp(-2πi f·r) dr``, 1 at zero frequency.

        Raises
        ------
        ParameterError
            When a value is out of range.
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        s = finite_array("frequency_per_mm", frequency_per_mm) * 1e-3 * point.lambda_n_um
        angle = math.radians(check_number("angle_deg", angle_deg))
        return point.transfer(s * math.cos(angle), s * math.sin(angle))

    def mtf(
        self,
        frequency_per_mm: ArrayLike,
        wavelength_nm: float,
        *,
        angle_deg: float = 0.0,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> Floats:
        """Modulation transfer function: the absolute value of :meth:`otf`, whose parameters it has."""
        return np.asarray(
            np.abs(
                self.otf(frequency_per_mm, wavelength_nm, angle_deg=angle_deg, distance_m=distance_m, field_um=field_um)
            )
        )

    def strehl(
        self, wavelength_nm: float, *, distance_m: float | None = None, field_um: tuple[float, float] = (0.0, 0.0)
    ) -> float:
        """
        Strehl ratio: the pattern's height at the image point over that of the same pupil without aberrations.

        Parameters and errors as for :meth:`psf`. About ``exp(-(2πσ)²)`` for a wavefront error of σ waves rms (Mahajan, J. Opt.
        Soc. Am. 73 (1983) 860).
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        return 1.0 if point.is_clear_circle else point.aperture.strehl(point.wavelength_nm, point.field_um)

    def encircled_energy(
        self,
        radius_um: ArrayLike,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> Floats:
        """
        Fraction of a point's light in circles around its image point.

        Parameters
        ----------
        radius_um : array, µm
        wavelength_nm, distance_m, field_um
            As for :meth:`psf`.

        Returns
        -------
        share : array of the same shape, float64
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        return point.in_circles(finite_array("radius_um", radius_um, at_least=0.0))

    def ensquared_energy(
        self,
        side_um: ArrayLike,
        wavelength_nm: float,
        *,
        distance_m: float | None = None,
        field_um: tuple[float, float] = (0.0, 0.0),
    ) -> Floats:
        """
        Fraction of a point's light in upright squares around its image point.

        Parameters
        ----------
        side_um : array, µm
        wavelength_nm, distance_m, field_um
            As for :meth:`psf`.

        Returns
        -------
        share : array of the same shape, float64
        """
        point = self._point(wavelength_nm, distance_m, field_um)
        return point.in_squares(finite_array("side_um", side_um, at_least=0.0))
