"""
Wave aberrations: deviation of the wavefront in the pupil from the reference sphere.

A wavefront ``W(x, y)`` in µm is the optical path difference at points of the aperture, in units of its radius, x to the right
and y up as in the picture on the sensor. The amplitude has the phase factor ``exp(2πi W / λ)``. The PSF moves in the
direction in which W increases: a positive tilt in y moves the image point up, and the flare of positive coma in y points up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import Declared, Limits, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import (
    Floats,
    as_broadcast,
    check_count,
    check_number,
    check_point,
    finite_array,
    wavelengths_nm,
)
from foveasim.errors import ParameterError
from foveasim.units import um_from_nm

__all__ = ["LateralColour", "Seidel", "Zernike", "noll_to_nm", "osa_to_nm", "zernike"]

#: Highest index, of radial order 100; polynomials up to this order are accurate to 1e-12.
MAX_INDEX = 5151
#: Largest radial order: that of this index.
MAX_ORDER = 100
#: Largest wavefront error, µm or waves: 10 cm is beyond any lens.
MAX_PATH = 1e5
#: Indices of both schemes.
NOLL, OSA = Limits(at_least=1, at_most=MAX_INDEX), Limits(at_least=0, at_most=MAX_INDEX)
PATH = Limits(at_least=-MAX_PATH, at_most=MAX_PATH)


def noll_to_nm(j: Annotated[int, NOLL]) -> tuple[int, int]:
    """
    Convert a Noll index to the orders (n, m) of a Zernike polynomial.

    The index j counts from 1; n is the radial order, and m the azimuthal order, negative for sines.
    R. J. Noll, Zernike polynomials and atmospheric turbulence, J. Opt. Soc. Am. 66 (1976) 207, Table I.

    Examples
    --------
    Defocus, coma in y, spherical aberration:

    >>> noll_to_nm(4), noll_to_nm(7), noll_to_nm(11)
    ((2, 0), (3, -1), (4, 0))
    """
    n = (math.isqrt(8 * j - 7) - 1) // 2
    # |m| increases in steps of two within a radial order; even j are cosines.
    k = j - n * (n + 1) // 2
    m = 2 * (k // 2) if n % 2 == 0 else 2 * ((k - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def osa_to_nm(j: Annotated[int, OSA]) -> tuple[int, int]:
    """
    Convert an OSA/ANSI index to the orders (n, m) of a Zernike polynomial.

    The index j counts from 0; n is the radial order, and m the azimuthal order, negative for sines.
    Thibos et al., Standards for reporting the optical aberrations of eyes, J. Refract. Surg. 18 (2002) S652; ANSI Z80.28.

    Examples
    --------
    Defocus, coma in y, spherical aberration:

    >>> osa_to_nm(4), osa_to_nm(7), osa_to_nm(12)
    ((2, 0), (3, -1), (4, 0))
    """
    n = (math.isqrt(8 * j + 1) - 1) // 2
    return n, 2 * j - n * (n + 2)


def zernike(n: int, m: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """
    Evaluate a Zernike polynomial of unit variance over the unit disc.

    Parameters
    ----------
    n, m : int
        Radial and azimuthal order, ``n >= |m|`` of the same parity; sines for negative m.
    x, y : array
        Points in units of the aperture radius.

    Returns
    -------
    value : array, float64
        ``sqrt(n + 1) R(r)`` for m = 0, else ``sqrt(2 (n + 1)) R(r) cos(m t)`` or ``sin(|m| t)``, as in Noll and OSA/ANSI.

    Raises
    ------
    ParameterError
        When n and m are not the orders of a Zernike polynomial, or the shapes of x and y cannot be broadcast together.

    Notes
    -----
    ``R`` is computed from Jacobi polynomials, which are numerically stable at high orders: Born and Wolf, Principles of
    Optics, section 9.2.1.

    Examples
    --------
    >>> import foveasim as fs
    >>> (
    ...     round(float(fs.optics.zernike(2, 0, 0.0, 0.0)), 4),
    ...     round(float(fs.optics.zernike(2, 0, 1.0, 0.0)), 4),
    ... )
    (-1.7321, 1.7321)
    """
    from scipy.special import eval_jacobi

    check_count("n", n, at_least=0, at_most=MAX_ORDER)
    if n < abs(m) or (n - m) % 2:
        raise ParameterError("m", f"must be from -n to n = {n} in steps of two", m)
    x, y = as_broadcast(x=x, y=y)
    r2 = x * x + y * y
    k = (n - abs(m)) // 2
    radial = (-1) ** k * eval_jacobi(k, abs(m), 0, 1.0 - 2.0 * r2)
    if m == 0:
        return np.asarray(math.sqrt(n + 1) * radial)
    power = (x + 1j * y) ** abs(m)  # r^|m| (cos |m|t + i sin |m|t)
    return np.asarray(math.sqrt(2 * (n + 1)) * radial * (power.real if m > 0 else power.imag))


@dataclass(frozen=True, kw_only=True)
class Zernike:
    """
    Wavefront as a sum of Zernike polynomials of unit variance, constant over the field.

    Parameters
    ----------
    coefficients : {index: number, or one number per wavelength}
        RMS wavefront error of each polynomial.
    index : {"noll", "osa"}
        Index scheme: Noll (defocus 4, coma 7 in y and 8 in x, spherical aberration 11), or OSA/ANSI (4; 7, 8; 12).
    unit : {"um", "waves"}
    wavelength_nm : number or sequence, optional, nm
        Reference wavelength of coefficients in "waves"; by default the wavelength of the light itself. For sequences of
        coefficients: their wavelengths, increasing. The wavefront is interpolated linearly and is constant outside the range.

    Raises
    ------
    ParameterError
        When an index does not exist, or the numbers of coefficients and wavelengths differ.

    Examples
    --------
    A quarter wave of coma with the flare upwards, and defocus that depends on the wavelength:

    >>> coma = Zernike(coefficients={7: 0.25}, unit="waves", wavelength_nm=550.0)
    >>> colour = Zernike(
    ...     coefficients={4: [0.1, 0.0, 0.05]}, wavelength_nm=[450.0, 550.0, 650.0]
    ... )
    >>> coma.coefficients_um(550.0)
    {(3, -1): 0.1375}
    """

    coefficients: Mapping[int, float | Sequence[float]] = field(hash=False)
    index: Literal["noll", "osa"] = "noll"
    unit: Literal["um", "waves"] = "um"
    wavelength_nm: float | Sequence[float] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        if not isinstance(self.coefficients, Mapping) or not self.coefficients:
            raise ParameterError(
                "coefficients", "must be a mapping of indices to numbers, such as {4: 0.1}", self.coefficients
            )
        waves_nm = None if self.wavelength_nm is None else wavelengths_nm("wavelength_nm", self.wavelength_nm)
        if waves_nm is not None and np.any(np.diff(waves_nm) <= 0.0):
            raise ParameterError("wavelength_nm", "must be strictly increasing", self.wavelength_nm, "nm")
        n_waves = 1 if waves_nm is None else waves_nm.size
        clean: dict[int, float | tuple[float, ...]] = {}
        for j, value in self.coefficients.items():
            self._orders(j)
            numbers = finite_array(f"coefficients[{j}]", value, at_least=-MAX_PATH, at_most=MAX_PATH)
            if numbers.ndim > 1 or (numbers.ndim == 1 and numbers.size != n_waves):
                raise ParameterError(
                    f"coefficients[{j}]", f"must be one number, or one for each of the {n_waves} wavelengths", value
                )
            clean[int(j)] = float(numbers) if numbers.ndim == 0 else tuple(numbers.tolist())
        object.__setattr__(self, "coefficients", MappingProxyType(clean))
        if waves_nm is not None:
            is_one = np.ndim(self.wavelength_nm) == 0  # type: ignore[arg-type]
            object.__setattr__(self, "wavelength_nm", float(waves_nm[0]) if is_one else tuple(waves_nm.tolist()))

    def __reduce__(self) -> tuple[Any, ...]:
        return _zernike, (dict(self.coefficients), self.index, self.unit, self.wavelength_nm)

    def _orders(self, j: Any) -> tuple[int, int]:
        try:
            limits, orders_of = (NOLL, noll_to_nm) if self.index == "noll" else (OSA, osa_to_nm)
            if isinstance(j, str):
                raise ParameterError("coefficients", "must be an integer", j)
            return orders_of(limits.check_count("coefficients", j))
        except ParameterError as error:
            raise ParameterError("coefficients", f"has an index that {error.detail}") from None

    def coefficients_um(self, wavelength_nm: float) -> dict[tuple[int, int], float]:
        """Return the coefficients at a wavelength in µm, keyed by the orders (n, m)."""
        own_um = float(um_from_nm(check_number("wavelength_nm", wavelength_nm)))
        table_nm = None if self.wavelength_nm is None else np.atleast_1d(np.asarray(self.wavelength_nm, np.float64))
        um = {}
        for j, value in self.coefficients.items():
            if table_nm is None:
                number = float(np.ravel(value)[0]) * (own_um if self.unit == "waves" else 1.0)
            else:
                table_um = np.broadcast_to(value, table_nm.shape) * (
                    um_from_nm(table_nm) if self.unit == "waves" else 1.0
                )
                number = float(np.interp(wavelength_nm, table_nm, table_um))
            um[self._orders(j)] = number
        return um

    def wavefront_um(self, x: Floats, y: Floats, wavelength_nm: float, field_um: tuple[float, float]) -> Floats:  # noqa: ARG002
        """Return the path difference in µm at points of the aperture."""
        x, y = as_broadcast(x=x, y=y)
        total_um = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        for (n, m), number_um in self.coefficients_um(wavelength_nm).items():
            if number_um:
                total_um += number_um * zernike(n, m, x, y)
        return total_um


def _zernike(coefficients: Any, index: Any, unit: Any, wavelength_nm: Any) -> Zernike:
    return Zernike(coefficients=coefficients, index=index, unit=unit, wavelength_nm=wavelength_nm)


@dataclass(frozen=True, kw_only=True)
class Seidel(Declared):
    """
    Third-order (Seidel) wave aberrations, which depend on the field position.

    For an image point at h times ``field_radius_um`` from the axis, in the direction t, and an aperture point at the radius r
    in the direction t + u: ``W = spherical r⁴ + coma h r³ cos u + astigmatism h² r² cos² u + field_curvature h² r²``.

    Parameters
    ----------
    spherical_um, coma_um, astigmatism_um, field_curvature_um : float, µm
        Path difference of each aberration at the edge of the aperture, for an image point at ``field_radius_um``.
    field_radius_um : float, µm
        Reference distance from the axis on the sensor.

    Notes
    -----
    W. T. Welford, Aberrations of Optical Systems, chapter 7: the wave aberration coefficients W040, W131, W222, W220. The
    fifth, distortion, is a lens model of ``foveasim.distortion``.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.Optics(
    ...     focal_length_mm=8.0, f_number=2.8, seidel=fs.optics.Seidel(coma_um=0.1)
    ... )
    >>> [
    ...     round(lens.strehl(550.0, field_um=(x_um, 0.0)), 3)
    ...     for x_um in (0.0, 500.0, 1000.0)
    ... ]
    [1.0, 0.995, 0.982]
    """

    spherical_um: Annotated[float, PATH] = 0.0
    coma_um: Annotated[float, PATH] = 0.0
    astigmatism_um: Annotated[float, PATH] = 0.0
    field_curvature_um: Annotated[float, PATH] = 0.0
    field_radius_um: Annotated[float, Limits(above=0.0, at_most=1e7)] = 1000.0

    @property
    def is_varying(self) -> bool:
        """Whether the aberrations vary over the field."""
        return any((self.coma_um, self.astigmatism_um, self.field_curvature_um))

    def wavefront_um(self, x: Floats, y: Floats, wavelength_nm: float, field_um: tuple[float, float]) -> Floats:  # noqa: ARG002
        """Return the path difference in µm at points of the aperture, for an image point."""
        x, y = as_broadcast(x=x, y=y)
        hx, hy = (c / self.field_radius_um for c in check_point("field_um", field_um))
        r2 = x * x + y * y
        along = x * hx + y * hy  # h r cos u
        return np.asarray(
            self.spherical_um * r2 * r2
            + self.coma_um * r2 * along
            + self.astigmatism_um * along * along
            + self.field_curvature_um * (hx * hx + hy * hy) * r2
        )


@dataclass(frozen=True, kw_only=True)
class LateralColour:
    """
    Lateral chromatic aberration: image size as a function of wavelength.

    Parameters
    ----------
    wavelength_nm : sequence, nm, increasing
    magnification : sequence
        Image size at each wavelength, relative to the ideal lens; interpolated linearly, constant outside the range.

    Raises
    ------
    ParameterError
        When the lengths of the sequences differ, or a size differs from 1 by more than 0.1.

    Examples
    --------
    >>> import foveasim as fs
    >>> colour = fs.optics.LateralColour(
    ...     wavelength_nm=[450.0, 550.0, 650.0], magnification=[0.998, 1.0, 1.001]
    ... )
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8, lateral_colour=colour)
    >>> lens.lateral_colour.at([500.0, 700.0]).round(4).tolist()
    [0.999, 1.001]
    """

    wavelength_nm: Sequence[float]
    magnification: Sequence[float]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        waves_nm = wavelengths_nm("wavelength_nm", self.wavelength_nm)
        sizes = finite_array("magnification", self.magnification, ndim=1)
        if sizes.shape != waves_nm.shape or np.any(np.diff(waves_nm) <= 0.0):
            raise ParameterError(
                "wavelength_nm",
                "must be strictly increasing and have one value per magnification",
                self.wavelength_nm,
                "nm",
            )
        if np.any(np.abs(sizes - 1.0) > 0.1):
            raise ParameterError(
                "magnification", "must be from 0.9 to 1.1, relative to the ideal lens", self.magnification
            )
        object.__setattr__(self, "wavelength_nm", tuple(waves_nm.tolist()))
        object.__setattr__(self, "magnification", tuple(sizes.tolist()))

    def at(self, wavelength_nm: Any) -> Floats:
        """Return the relative image size at the given wavelengths."""
        return np.asarray(np.interp(wavelength_nm, self.wavelength_nm, self.magnification))
