"""Curves over wavelength: quantum efficiencies and colour filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from foveasim.arrays import Floats, check_count, check_number, finite_array
from foveasim.errors import ParameterError

__all__ = ["ConstantCurve", "Curve", "FilterSet", "GaussianCurve", "PolynomialCurve", "SiliconQE", "rgb_filters"]


class Curve(Protocol):
    """A function of wavelength with values from 0 to 1."""

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Values at the wavelengths, of the same shape."""


@dataclass(frozen=True)
class ConstantCurve:
    """
    The same value at every wavelength.

    Parameters
    ----------
    value : float
        From 0 to 1.

    Raises
    ------
    ParameterError
        When it is not.
    """

    value: float = 1.0

    def __post_init__(self) -> None:
        check_number("value", self.value, at_least=0.0, at_most=1.0)

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Values at the wavelengths, of the same shape."""
        return np.full(np.shape(wavelength_nm), float(self.value))


@dataclass(frozen=True, kw_only=True)
class PolynomialCurve:
    """
    A polynomial fitted to a table by least squares: the paper's quantum efficiency (Fig. 5).

    Parameters
    ----------
    wavelength_nm, value : sequences of the same length
        The table. Values from 0 to 1.
    degree : int
        Degree of the polynomial, below the number of values.

    Raises
    ------
    ParameterError
        When the table is out of range; on a call, for a wavelength outside the table, where a polynomial means nothing.

    Notes
    -----
    What the polynomial makes of a table near 0 or 1 is limited to that range.
    """

    wavelength_nm: Sequence[float]
    value: Sequence[float]
    degree: int = 5

    def __post_init__(self) -> None:
        waves_nm = finite_array("wavelength_nm", self.wavelength_nm, ndim=1, above=0.0)
        values = finite_array("value", self.value, ndim=1, at_least=0.0)
        if values.size != waves_nm.size or values.size < 2:
            raise ParameterError("value", f"must have as many values as 'wavelength_nm', at least 2, got {values.size}")
        if values.max() > 1.0:
            raise ParameterError("value", "must be <= 1 everywhere", float(values.max()))
        if np.unique(waves_nm).size != waves_nm.size:
            raise ParameterError("wavelength_nm", "must not repeat a wavelength", self.wavelength_nm, "nm")
        object.__setattr__(self, "degree", check_count("degree", self.degree, at_least=0, at_most=values.size - 1))
        object.__setattr__(self, "wavelength_nm", tuple(float(x) for x in waves_nm))
        object.__setattr__(self, "value", tuple(float(x) for x in values))

    @cached_property
    def _fit(self) -> np.polynomial.Polynomial:
        return np.polynomial.Polynomial.fit(self.wavelength_nm, self.value, self.degree)

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Values at the wavelengths, of the same shape."""
        _check_range(wavelength_nm, min(self.wavelength_nm), max(self.wavelength_nm), "the table of the fit")
        return np.clip(self._fit(np.asarray(wavelength_nm, dtype=np.float64)), 0.0, 1.0)


#: Absorption lengths of crystalline silicon at room temperature, nm to µm; interpolated in the logarithm.
SILICON_NM = (400, 450, 500, 550, 600, 650, 700, 750, 800, 850, 900, 950, 1000, 1050)
SILICON_ABSORPTION_UM = (
    0.0971, 0.3755, 0.8195, 1.561, 2.578, 3.580, 5.243, 7.838, 12.09, 19.55, 33.96, 66.35, 162.3, 640.7,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SiliconQE:
    """
    Quantum efficiency of a silicon layer: the share of the light that it absorbs.

    Parameters
    ----------
    depth_um : float, µm
        Thickness from which all charge is collected.
    transmission : float
        Share of the light that enters the silicon.

    Raises
    ------
    ParameterError
        When a value is out of range; on a call, for a wavelength outside 400 to 1050 nm, where no absorption is known here.

    Notes
    -----
    ``transmission * (1 - exp(-depth / l))`` with the absorption length ``l(wavelength)`` (Beer and Lambert).
    """

    depth_um: float
    transmission: float = 1.0

    def __post_init__(self) -> None:
        check_number("depth_um", self.depth_um, above=0.0, at_most=1e5)
        check_number("transmission", self.transmission, above=0.0, at_most=1.0)

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Values at the wavelengths, of the same shape."""
        _check_range(wavelength_nm, SILICON_NM[0], SILICON_NM[-1], "the table of silicon's absorption")
        length_um = np.exp(
            np.interp(np.asarray(wavelength_nm, dtype=np.float64), SILICON_NM, np.log(SILICON_ABSORPTION_UM))
        )
        return np.asarray(self.transmission * -np.expm1(-self.depth_um / length_um))


@dataclass(frozen=True, kw_only=True)
class GaussianCurve:
    """
    A smooth band: a Gaussian over wavelength.

    Parameters
    ----------
    centre_nm, fwhm_nm : float, nm
        Where it is highest, and its full width at half maximum.
    peak : float
        Its value there.

    Raises
    ------
    ParameterError
        When a value is out of range.
    """

    centre_nm: float
    fwhm_nm: float
    peak: float = 1.0

    def __post_init__(self) -> None:
        check_number("centre_nm", self.centre_nm, above=0.0)
        check_number("fwhm_nm", self.fwhm_nm, above=0.0)
        check_number("peak", self.peak, above=0.0, at_most=1.0)

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Values at the wavelengths, of the same shape."""
        offset = (np.asarray(wavelength_nm, dtype=np.float64) - self.centre_nm) / self.fwhm_nm
        return np.asarray(self.peak * np.exp(-4.0 * np.log(2.0) * offset**2))


@dataclass(frozen=True)
class FilterSet:
    """
    The colour filters of a sensor; a site's ``channel`` is the position of its filter.

    Parameters
    ----------
    curves : sequence of Curve
        Transmissions.
    names : sequence of str, optional
        One a curve; "0", "1", ... by default.

    Raises
    ------
    ParameterError
        When there is no curve, or names and curves differ in number.
    """

    curves: Sequence[Curve]
    names: Sequence[str] | None = None

    def __post_init__(self) -> None:
        curves = tuple(self.curves) if isinstance(self.curves, Sequence) else ()
        if not curves or not all(callable(curve) for curve in curves):
            raise ParameterError("curves", "must be one or more functions of wavelength", self.curves)
        names = tuple(str(k) for k in range(len(curves))) if self.names is None else tuple(self.names)
        if len(names) != len(curves):
            raise ParameterError("names", f"must have one name for each of the {len(curves)} curves", self.names)
        object.__setattr__(self, "curves", curves)
        object.__setattr__(self, "names", names)

    def __len__(self) -> int:
        return len(self.curves)

    def transmission(self, wavelength_nm: Floats) -> Floats:
        """Transmission of every filter, (n_filter, n_wavelength)."""
        return np.stack([curve(wavelength_nm) for curve in self.curves])


def rgb_filters() -> FilterSet:
    """
    Red, green and blue filters as three smooth overlapping bands.

    A stand-in of the usual shape, no measured product: Gaussians at 610, 540 and 460 nm, 90 nm wide at half maximum.
    """
    return FilterSet(tuple(GaussianCurve(centre_nm=c, fwhm_nm=90.0) for c in (610.0, 540.0, 460.0)), ("R", "G", "B"))


def _check_range(wavelength_nm: ArrayLike, low_nm: float, high_nm: float, what: str) -> None:
    waves_nm = np.asarray(wavelength_nm, dtype=np.float64)
    outside = waves_nm[~((waves_nm >= low_nm) & (waves_nm <= high_nm))]
    if outside.size:
        raise ParameterError(
            "wavelength_nm", f"must lie in {what}, {low_nm:g} to {high_nm:g} nm", float(outside[0]), "nm"
        )
