"""
Spectral curves in closed form, and their products and band means.

A curve is a function of the wavelength in nm with values from 0 to 1: a quantum efficiency, the transmission of a filter, or
the product of both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import FRACTION, NOT_NEGATIVE, POSITIVE, Declared, Limits, Usual
from foveasim._core.registry import Registry
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, as_numbers, check_number
from foveasim.errors import FoveasimError, ParameterError


class CurveError(ParameterError):
    """Error of a user-defined curve: it raises, or does not return one number per wavelength."""


class Curve(Protocol):
    """Function of wavelength with values from 0 to 1."""

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Return the values at the wavelengths, of the same shape."""


PEAK = Limits(above=0.0, at_most=1.0)
#: Valid factors of a curve: another curve, or a constant from 0 to 1.
Factor = Curve | float


class CurveBase(Declared, ABC):
    """Base class of curves that defines products: ``curve * curve`` and ``0.9 * curve``."""

    #: Makes numpy scalars defer multiplication to the curve.
    __array_ufunc__ = None

    def __call__(self, wavelength_nm: ArrayLike, /) -> Floats:
        """Return the values at the wavelengths, of the same shape."""
        return self._at(as_numbers("wavelength_nm", wavelength_nm))

    @abstractmethod
    def _at(self, waves_nm: Floats) -> Floats:
        """Return the values at wavelengths of any shape."""

    def __mul__(self, other: Factor) -> ProductCurve:
        """Return the product with another curve, or with a number from 0 to 1."""
        return ProductCurve((self, other))

    def __rmul__(self, other: Factor) -> ProductCurve:
        """Return the product of another curve, or of a number from 0 to 1, with this curve."""
        return ProductCurve((other, self))


#: Spectral curves by their names in settings files. Installed packages add curves by entry points of the group
#: ``foveasim.curves``.
CURVES: Registry[Callable[..., Any]] = Registry("curve", "foveasim.curves")


@CURVES.register("constant", example={"value": 0.4}, expected={550.0: 0.4})
@dataclass(frozen=True)
class ConstantCurve(CurveBase):
    """
    Constant curve.

    Parameters
    ----------
    value : float
        Value at all wavelengths, from 0 to 1.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.sensor.ConstantCurve(0.6)([450.0, 550.0]).tolist()
    [0.6, 0.6]
    """

    value: Annotated[float, FRACTION] = 1.0

    def _at(self, waves_nm: Floats) -> Floats:
        return np.full(waves_nm.shape, self.value)


@CURVES.register(
    "gaussian", example={"centre_nm": 550.0, "fwhm_nm": 80.0, "peak": 0.8}, expected={550.0: 0.8, 590.0: 0.4}
)
@dataclass(frozen=True, kw_only=True)
class GaussianCurve(CurveBase):
    """
    Gaussian band.

    Parameters
    ----------
    centre_nm, fwhm_nm : float, nm
        Centre wavelength and full width at half maximum.
    peak : float
        Value at the centre.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.sensor.GaussianCurve(centre_nm=550.0, fwhm_nm=80.0, peak=0.9)(
    ...     [550.0, 590.0]
    ... ).round(3).tolist()
    [0.9, 0.45]
    """

    centre_nm: Annotated[float, POSITIVE]
    fwhm_nm: Annotated[float, POSITIVE, Usual(10.0, 300.0)]
    peak: Annotated[float, PEAK] = 1.0

    def _at(self, waves_nm: Floats) -> Floats:
        offset = (waves_nm - self.centre_nm) / self.fwhm_nm
        return np.asarray(self.peak * np.exp(-4.0 * np.log(2.0) * offset**2))


@CURVES.register(
    "pass_band", example={"from_nm": 500.0, "to_nm": 600.0, "peak": 0.8}, expected={500.0: 0.4, 550.0: 0.8}
)
@dataclass(frozen=True, kw_only=True)
class PassBand(CurveBase):
    """
    Band-pass, long-pass or short-pass (infrared-cut) filter.

    Parameters
    ----------
    from_nm, to_nm : float, optional, nm
        Cut-on and cut-off wavelengths, at half of the peak. Without ``from_nm`` the filter is a short-pass, without ``to_nm``
        a long-pass.
    edge_nm : float, nm
        Width of the edges from 10 % to 90 %; 0 for sharp edges.
    peak : float
        Transmission in the pass band.

    Raises
    ------
    ParameterError
        If neither wavelength is given, or a value is out of range.

    Notes
    -----
    Edges are logistic functions, and a band is the difference of two edges: adjacent bands add up to the combined band, the
    area is ``peak * (to_nm - from_nm)``, and a band narrower than its edges does not reach its peak.

    Examples
    --------
    >>> infrared_cut = PassBand(to_nm=650.0, edge_nm=20.0)
    >>> infrared_cut([640.0, 650.0, 660.0]).round(3)
    array([0.9, 0.5, 0.1])
    """

    from_nm: Annotated[float | None, POSITIVE] = None
    to_nm: Annotated[float | None, POSITIVE] = None
    edge_nm: Annotated[float, NOT_NEGATIVE] = 10.0
    peak: Annotated[float, PEAK] = 1.0

    def __post_init__(self) -> None:
        if self.from_nm is None and self.to_nm is None:
            raise ParameterError(
                "from_nm", "or 'to_nm' must be given; for the same transmission at all wavelengths use ConstantCurve"
            )
        super().__post_init__()
        if self.from_nm is not None and self.to_nm is not None:
            check_number("to_nm", self.to_nm, above=self.from_nm)

    def _at(self, waves_nm: Floats) -> Floats:
        begun = 1.0 if self.from_nm is None else self._step(waves_nm - self.from_nm)
        ended = 0.0 if self.to_nm is None else self._step(waves_nm - self.to_nm)
        return np.asarray(self.peak * np.maximum(begun - ended, 0.0))

    def _step(self, offset_nm: Floats) -> Floats:
        """Return the edge function: 0 far below the edge, 1 far above."""
        if self.edge_nm == 0.0:
            return np.heaviside(offset_nm, 0.5)
        return 0.5 + 0.5 * np.tanh(np.log(9.0) * offset_nm / self.edge_nm)


#: Absorption lengths of crystalline silicon at room temperature, µm by nm; interpolated logarithmically.
SILICON_NM = (400, 450, 500, 550, 600, 650, 700, 750, 800, 850, 900, 950, 1000, 1050)
SILICON_ABSORPTION_UM = (
    0.0971, 0.3755, 0.8195, 1.561, 2.578, 3.580, 5.243, 7.838, 12.09, 19.55, 33.96, 66.35, 162.3, 640.7,
)  # fmt: skip


@CURVES.register("silicon", example={"depth_um": 1.561}, expected={550.0: 0.6321205588})
@dataclass(frozen=True, kw_only=True)
class SiliconQE(CurveBase):
    """
    Quantum efficiency of a silicon layer: its absorbed fraction of the photons.

    Parameters
    ----------
    depth_um : float, µm
        Collection depth: thickness from which all charge is collected.
    transmission : float
        Fraction of the photons that enter the silicon.

    Raises
    ------
    ParameterError
        If a value is out of range; when called, if a wavelength is outside the absorption table, 400 to 1050 nm.

    Notes
    -----
    ``transmission * (1 - exp(-depth / l))`` with the absorption length ``l(wavelength)`` (Beer-Lambert law).

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.SiliconQE(depth_um=3.0)([450.0, 550.0, 850.0]).round(3).tolist()
    [1.0, 0.854, 0.142]
    """

    depth_um: Annotated[float, Limits(above=0.0, at_most=1e5), Usual(0.5, 10.0)]
    transmission: Annotated[float, PEAK] = 1.0

    def _at(self, waves_nm: Floats) -> Floats:
        check_within(waves_nm, SILICON_NM[0], SILICON_NM[-1], "the absorption table of silicon")
        length_um = np.exp(np.interp(waves_nm, SILICON_NM, np.log(SILICON_ABSORPTION_UM)))
        return np.asarray(self.transmission * -np.expm1(-self.depth_um / length_um))


@dataclass(frozen=True)
class ProductCurve(CurveBase):
    """
    Product of curves, such as stacked filters and a quantum efficiency.

    ``curve * curve`` creates the same product.

    Parameters
    ----------
    curves : sequence of curves or numbers
        Numbers from 0 to 1 are constants. Nested products are flattened.

    Raises
    ------
    ParameterError
        If there is no curve, or a number is out of range; when called, if one of the curves rejects a wavelength.

    Examples
    --------
    >>> import foveasim as fs
    >>> stack = fs.sensor.ProductCurve(
    ...     [fs.sensor.ConstantCurve(0.9), fs.sensor.SiliconQE(depth_um=3.0)]
    ... )
    >>> stack([550.0]).round(3).tolist()
    [0.768]
    """

    curves: Sequence[Factor]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        given = tuple(self.curves) if isinstance(self.curves, list | tuple) else ()
        if not given:
            raise ParameterError("curves", "must be one or more curves or numbers", self.curves)
        flat: list[Curve] = []
        for curve in (as_curve("curves", c) for c in given):
            flat += [as_curve("curves", c) for c in curve.curves] if isinstance(curve, ProductCurve) else [curve]
        object.__setattr__(self, "curves", tuple(flat))

    def _at(self, waves_nm: Floats) -> Floats:
        return np.asarray(reduce(np.multiply, (curve_values(as_curve("curves", c), waves_nm) for c in self.curves)))


@dataclass(frozen=True, kw_only=True)
class BandMean(CurveBase):
    """
    Mean of a curve over a band around each wavelength, for scenes with few broad bands.

    Parameters
    ----------
    curve : Curve
    band_width_nm : float, nm
        Width of the bands, such as that of the scene.
    n_points : int
        Number of wavelengths per band at which the curve is evaluated.

    Raises
    ------
    ParameterError
        If a value is out of range; when called, if a band extends beyond the domain of the curve, or below 0 nm.

    Notes
    -----
    Wavelengths are weighted with their number of photons per energy: for constant spectral radiance within the band, the
    number of electrons equals that of a wavelength-by-wavelength calculation. The mean of a band is the photon-weighted mean
    of its halves. A filter narrower than the wavelength interval of the scene must not be evaluated at these wavelengths
    alone: for a filter of 10 nm and an interval of 20 nm, this gives 0.2 to 1.9 times the true number of electrons, whereas
    the band mean is exact.

    Examples
    --------
    >>> import foveasim as fs
    >>> green = fs.sensor.GaussianCurve(centre_nm=540.0, fwhm_nm=80.0)
    >>> round(float(fs.sensor.BandMean(curve=green, band_width_nm=100.0)(550.0)), 3)
    0.71
    """

    curve: Curve
    band_width_nm: Annotated[float, POSITIVE]
    n_points: Annotated[int, Limits(at_least=1, at_most=100_000)] = 64

    __repr__ = short_repr

    def _at(self, waves_nm: Floats) -> Floats:
        centre_nm = waves_nm[..., np.newaxis]
        if np.any(centre_nm <= 0.5 * self.band_width_nm):
            raise ParameterError(
                "wavelength_nm",
                f"must be > {0.5 * self.band_width_nm:g}, half the band width",
                float(np.min(centre_nm)),
                "nm",
            )
        middles = (np.arange(self.n_points) + 0.5) / self.n_points - 0.5
        points_nm = centre_nm + self.band_width_nm * middles
        return np.asarray((curve_values(self.curve, points_nm) * points_nm / centre_nm).mean(axis=-1))


def as_curve(name: str, value: object) -> Curve:
    """
    Return the value as a curve; numbers become constant curves.

    Raises ParameterError if the value is neither a function nor a number from 0 to 1; ``name`` is its name in the message.
    """
    if callable(value):
        return value
    return ConstantCurve(check_number(name, value, at_least=0.0, at_most=1.0))


def curve_values(curve: Curve, wavelength_nm: ArrayLike) -> Floats:
    """
    Return the values of a curve at wavelengths, of the same shape.

    A curve that returns a single number is constant.

    Raises CurveError if the function raises (its exception is the cause), or does not return one real number per wavelength.
    Raises ParameterError if a curve of this package rejects a wavelength.
    """
    curve_name = getattr(curve, "__qualname__", None) or type(curve).__qualname__
    try:
        given = curve(wavelength_nm)
    except FoveasimError:
        raise
    except Exception as error:
        problem = " ".join(f"{type(error).__name__}: {error}".split())
        raise CurveError(
            "curve", f"must be a function of wavelength that returns numbers, but {curve_name} raised {problem}"
        ) from error
    try:
        values = np.asarray(given)
        if values.dtype.kind not in "biuf":
            raise TypeError
    except (TypeError, ValueError):
        raise CurveError(
            "curve", "must return one number per wavelength", given, hint=f"correct {curve_name}"
        ) from None
    if values.shape not in ((), np.shape(wavelength_nm)):
        raise CurveError(
            "curve",
            f"must return one number per wavelength, got the shape {values.shape} for {np.shape(wavelength_nm)}",
            hint=f"correct {curve_name}",
        )
    return np.broadcast_to(values.astype(np.float64, copy=False), np.shape(wavelength_nm))


def check_within(waves_nm: Floats, low_nm: float, high_nm: float, domain: str, hint: str = "") -> None:
    """
    Reject wavelengths outside a range, including NaN.

    Raises ParameterError if a wavelength is outside; the message states the first one.
    """
    outside = waves_nm[~((waves_nm >= low_nm) & (waves_nm <= high_nm))]
    if outside.size:
        raise ParameterError(
            "wavelength_nm", f"must be within {domain}, {low_nm:g} to {high_nm:g} nm", float(outside[0]), "nm", hint
        )
