"""Spectral curves from tables: polynomial fits, linear and spline interpolation, steps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_count, finite_array, wavelengths_nm
from foveasim.errors import ParameterError
from foveasim.sensor.spectral.curves import CURVES, CurveBase, check_within

__all__ = ["Beyond", "PolynomialCurve", "SplineCurve", "StepCurve", "TableCurve"]

#: Example of curves with a table.
TABLE = {"wavelength_nm": [400.0, 500.0, 700.0], "value": [0.2, 0.6, 0.4]}
#: Values outside the table: raise an error, 0, or the value at the end.
Beyond = Literal["raise", "zero", "hold"]
BEYOND_HINT = "set beyond='zero' or beyond='hold' to extrapolate"


@dataclass(frozen=True, kw_only=True)
class _Sampled(CurveBase):
    """Curve from values at wavelengths, in ascending order."""

    wavelength_nm: Sequence[float]
    value: Sequence[float]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        waves_nm = finite_array("wavelength_nm", self.wavelength_nm, ndim=1, above=0.0)
        values = _check_fractions(self.value)
        if values.size != waves_nm.size or values.size < 2:
            raise ParameterError(
                "value", f"must have the same length as 'wavelength_nm', at least 2, got {values.size}"
            )
        waves_nm = wavelengths_nm("wavelength_nm", waves_nm)
        order = np.argsort(waves_nm)
        if np.any(np.diff(waves_nm[order]) == 0.0):
            raise ParameterError("wavelength_nm", "must not repeat a wavelength", self.wavelength_nm, "nm")
        object.__setattr__(self, "wavelength_nm", tuple(waves_nm[order].tolist()))
        object.__setattr__(self, "value", tuple(values[order].tolist()))


@CURVES.register("polynomial", example={**TABLE, "degree": 2}, expected={500.0: 0.6, 700.0: 0.4})
@dataclass(frozen=True, kw_only=True, repr=False)
class PolynomialCurve(_Sampled):
    """
    Least-squares polynomial fit of a table, as for the paper's quantum efficiency (Fig. 5).

    Parameters
    ----------
    wavelength_nm, value : sequences of the same length
        Table, in any order. Values from 0 to 1.
    degree : int
        Degree of the polynomial, less than the number of values.

    Raises
    ------
    ParameterError
        If the table is invalid; when called, if a wavelength is outside the table, where the polynomial is not meaningful.

    Notes
    -----
    Values of the polynomial are clipped to 0 .. 1.

    Examples
    --------
    >>> import foveasim as fs
    >>> curve = fs.sensor.PolynomialCurve(
    ...     wavelength_nm=[400, 500, 600, 700], value=[0.3, 0.6, 0.6, 0.4], degree=2
    ... )
    >>> curve([550.0]).round(3).tolist()
    [0.631]
    """

    degree: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "degree", check_count("degree", self.degree, at_least=0, at_most=len(self.value) - 1))

    @cached_property
    def _fit(self) -> np.polynomial.Polynomial:
        return np.polynomial.Polynomial.fit(self.wavelength_nm, self.value, self.degree)

    def _at(self, waves_nm: Floats) -> Floats:
        check_within(waves_nm, self.wavelength_nm[0], self.wavelength_nm[-1], "the table of the fit")
        return np.clip(self._fit(waves_nm), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, repr=False)
class _Table(_Sampled):
    """Table with an interpolation."""

    beyond: Beyond = "raise"
    source: str = field(default="", compare=False)

    @abstractmethod
    def _interpolate(self, waves_nm: Floats) -> Floats:
        """Return the values at wavelengths within the table."""

    def _at(self, waves_nm: Floats) -> Floats:
        inside_nm, is_known = _clip_to_table(waves_nm, self.wavelength_nm, self.beyond)
        return np.where(is_known, self._interpolate(inside_nm), 0.0)


@CURVES.register("table", example=TABLE, expected={450.0: 0.4, 600.0: 0.5})
class TableCurve(_Table):
    """
    Table with linear interpolation.

    Parameters
    ----------
    wavelength_nm, value : sequences of the same length
        Table, in any order. Values from 0 to 1.
    beyond : {"raise", "zero", "hold"}
        Behaviour outside the table: raise an error, return 0, or return the value at the end.
    source : str
        Source of the data; stored with the results.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.sensor.TableCurve(wavelength_nm=[400, 500, 700], value=[0.2, 0.6, 0.4])(
    ...     [450.0, 600.0]
    ... ).round(3).tolist()
    [0.4, 0.5]
    """

    def _interpolate(self, waves_nm: Floats) -> Floats:
        return np.interp(waves_nm, self.wavelength_nm, self.value)


@CURVES.register("spline", example=TABLE, expected={500.0: 0.6, 700.0: 0.4})
class SplineCurve(_Table):
    """
    Table with shape-preserving (monotone) cubic interpolation.

    Parameters
    ----------
    wavelength_nm, value : sequences of the same length
        Table, in any order. Values from 0 to 1.
    beyond : {"raise", "zero", "hold"}
        Behaviour outside the table: raise an error, return 0, or return the value at the end.
    source : str
        Source of the data; stored with the results.

    Notes
    -----
    Cubic pieces with the slopes of Fritsch and Butland (SIAM J. Sci. Stat. Comput. 5, 1984): the curve is monotonic between
    adjacent values, and therefore stays within 0 to 1. As with linear interpolation, a peak between two values is lost.

    Examples
    --------
    >>> import foveasim as fs
    >>> curve = fs.sensor.SplineCurve(
    ...     wavelength_nm=[400, 500, 600, 700], value=[0.3, 0.6, 0.6, 0.4]
    ... )
    >>> curve([450.0, 550.0]).round(3).tolist()
    [0.506, 0.6]
    """

    @cached_property
    def _interpolator(self) -> Any:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.wavelength_nm, self.value)

    def _interpolate(self, waves_nm: Floats) -> Floats:
        return np.clip(self._interpolator(waves_nm), 0.0, 1.0)


@CURVES.register(
    "step", example={"edge_nm": [400.0, 500.0, 700.0], "value": [0.2, 0.6]}, expected={450.0: 0.2, 500.0: 0.6}
)
@dataclass(frozen=True, kw_only=True)
class StepCurve(CurveBase):
    """
    Piecewise constant curve, the simplest model of a quantum efficiency.

    Parameters
    ----------
    edge_nm : sequence of n + 1 floats, nm
        Interval edges, ascending.
    value : sequence of n floats
        Values from 0 to 1 in the half-open intervals ``[edge_nm[k], edge_nm[k + 1])``; the last interval includes its end.
    beyond : {"raise", "zero", "hold"}
        Behaviour outside the edges: raise an error, return 0, or return the value at the end.
    source : str
        Source of the data; stored with the results.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.sensor.StepCurve(edge_nm=[400, 500, 700], value=[0.4, 0.6])(
    ...     [450.0, 550.0]
    ... ).tolist()
    [0.4, 0.6]
    """

    edge_nm: Sequence[float]
    value: Sequence[float]
    beyond: Beyond = "raise"
    source: str = field(default="", compare=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        values = _check_fractions(self.value)
        edges_nm = wavelengths_nm("edge_nm", self.edge_nm)
        if values.size < 1 or edges_nm.size != values.size + 1:
            raise ParameterError(
                "edge_nm", f"must have one element more than 'value', which has {values.size}", edges_nm.size
            )
        if np.any(np.diff(edges_nm) <= 0.0):
            raise ParameterError("edge_nm", "must ascend", self.edge_nm, "nm")
        object.__setattr__(self, "edge_nm", tuple(edges_nm.tolist()))
        object.__setattr__(self, "value", tuple(values.tolist()))

    def _at(self, waves_nm: Floats) -> Floats:
        inside_nm, is_known = _clip_to_table(waves_nm, self.edge_nm, self.beyond)
        step = np.minimum(np.searchsorted(self.edge_nm, inside_nm, side="right") - 1, len(self.value) - 1)
        return np.where(is_known, np.asarray(self.value)[step], 0.0)


def _check_fractions(value: ArrayLike) -> Floats:
    """Return validated values (n,) from 0 to 1."""
    values = finite_array("value", value, ndim=1, at_least=0.0)
    if values.size and values.max() > 1.0:
        raise ParameterError("value", "must be <= 1 everywhere", float(values.max()), hint="divide percentages by 100")
    return values


def _clip_to_table(waves_nm: Floats, table_nm: Sequence[float], beyond: Beyond) -> tuple[Floats, Any]:
    """Return wavelengths clipped to the table, and the mask of those that are not set to 0."""
    low_nm, high_nm = table_nm[0], table_nm[-1]
    if beyond == "raise":
        check_within(waves_nm, low_nm, high_nm, "the table", BEYOND_HINT)
    check_within(waves_nm, 0.0, np.finfo(np.float64).max, "the spectrum")
    inside_nm = np.clip(waves_nm, low_nm, high_nm)
    return inside_nm, (inside_nm == waves_nm) | (beyond != "zero")
