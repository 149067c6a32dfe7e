"""Colour filters of a sensor: one spectral curve for each channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError
from foveasim.sensor.spectral.curves import (
    BandMean,
    Curve,
    Factor,
    GaussianCurve,
    ProductCurve,
    as_curve,
    curve_values,
)

__all__ = ["FilterSet", "rgb_filters"]


@dataclass(frozen=True)
class FilterSet:
    """
    Set of colour filters of a sensor; the ``channel`` of a site is the index of its filter.

    ``filters * curve`` multiplies all filters by a curve (an infrared-cut filter, a quantum efficiency) or a number;
    ``filters * [curve, ...]`` multiplies each filter by its own curve, such as a quantum efficiency per channel.

    Parameters
    ----------
    curves : sequence of Curve
        Transmissions, with or without quantum efficiency.
    names : sequence of str, optional
        One name per curve; "0", "1", ... by default.

    Examples
    --------
    >>> import foveasim as fs
    >>> bands = [
    ...     fs.sensor.GaussianCurve(centre_nm=centre_nm, fwhm_nm=60.0)
    ...     for centre_nm in (450.0, 550.0)
    ... ]
    >>> filters = fs.sensor.FilterSet(bands, ["B", "G"])
    >>> filters.names
    ('B', 'G')
    """

    curves: Sequence[Curve]
    names: Sequence[str] | None = None

    __repr__ = short_repr

    #: Makes numpy scalars and arrays defer multiplication to the set.
    __array_ufunc__ = None

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

    def __mul__(self, other: Factor | Sequence[Factor]) -> FilterSet:
        """Return the set with all filters times a curve or number, or times one curve each."""
        factors = [other] * len(self) if callable(other) or not isinstance(other, Sequence | np.ndarray) else other
        if len(factors) != len(self):
            raise ParameterError(
                "factor", f"must be one curve or number, or one for each of the {len(self)} filters, got {len(factors)}"
            )
        curves = [
            ProductCurve((curve, as_curve("factor", factor)))
            for curve, factor in zip(self.curves, factors, strict=True)
        ]
        return FilterSet(curves, self.names)

    __rmul__ = __mul__

    def over_bands(self, band_width_nm: float) -> FilterSet:
        """Return the set of the filters' band means: :class:`foveasim.sensor.BandMean`."""
        return FilterSet([BandMean(curve=curve, band_width_nm=band_width_nm) for curve in self.curves], self.names)

    def transmission(self, wavelength_nm: Floats) -> Floats:
        """
        Compute the transmission of each filter, (n_filter, n_wavelength).

        Raises
        ------
        ParameterError
            If a curve raises (its exception is the cause), or does not return one number per wavelength.
        """
        waves_nm = finite_array("wavelength_nm", wavelength_nm)
        return np.stack([curve_values(curve, waves_nm) for curve in self.curves])


def rgb_filters() -> FilterSet:
    """
    Return generic red, green and blue filters with Gaussian bands.

    The bands have a typical shape, but are not measured: centres 610, 540 and 460 nm, FWHM 90 nm. For measured filters see
    :func:`foveasim.sensor.camera_filters`.

    Examples
    --------
    >>> import foveasim as fs
    >>> filters = fs.sensor.rgb_filters()
    >>> filters.names, round(float(filters.curves[1](540.0)), 2)
    (('R', 'G', 'B'), 1.0)
    """
    return FilterSet(tuple(GaussianCurve(centre_nm=c, fwhm_nm=90.0) for c in (610.0, 540.0, 460.0)), ("R", "G", "B"))
