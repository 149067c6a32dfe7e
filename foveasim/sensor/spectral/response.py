"""The colour filters of a sensor: one curve over wavelength for each channel of its sites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from foveasim._core.validation import Floats
from foveasim.errors import ParameterError
from foveasim.sensor.spectral.curves import (
    BandMean,
    ConstantCurve,
    Curve,
    Factor,
    GaussianCurve,
    ProductCurve,
    as_curve,
    curve_values,
)

__all__ = ["ConstantCurve", "Curve", "FilterSet", "rgb_filters"]


@dataclass(frozen=True)
class FilterSet:
    """
    The colour filters of a sensor; a site's ``channel`` is the position of its filter.

    ``filters * curve`` is the set with every filter times a curve (an infrared cut, a quantum efficiency) or a number;
    ``filters * [curve, ...]`` with each filter times its own, which gives every channel a quantum efficiency of its own.

    Parameters
    ----------
    curves : sequence of Curve
        Transmissions, with or without the quantum efficiency behind them.
    names : sequence of str, optional
        One a curve; "0", "1", ... by default.

    Raises
    ------
    ParameterError
        When there is no curve, or names and curves differ in number.
    """

    curves: Sequence[Curve]
    names: Sequence[str] | None = None

    #: numpy's numbers and arrays leave the product to the set.
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
        """The set with every filter times a curve or number, or each times its own of a list."""
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
        """
        The set with every filter as its mean over the bands of a scene: :class:`foveasim.sensor.BandMean`.

        Raises
        ------
        ParameterError
            When the width is not above 0.
        """
        return FilterSet([BandMean(curve=curve, band_width_nm=band_width_nm) for curve in self.curves], self.names)

    def transmission(self, wavelength_nm: Floats) -> Floats:
        """
        Transmission of every filter, (n_filter, n_wavelength).

        Raises
        ------
        ParameterError
            When a curve fails, or returns other than one number per wavelength; its own error is the cause.
        """
        return np.stack([curve_values(curve, wavelength_nm) for curve in self.curves])


def rgb_filters() -> FilterSet:
    """
    Red, green and blue filters as three smooth overlapping bands.

    A stand-in of the usual shape, no measured product: Gaussians at 610, 540 and 460 nm, 90 nm wide at half maximum. For
    those of a camera see :func:`foveasim.sensor.camera_filters`.
    """
    return FilterSet(tuple(GaussianCurve(centre_nm=c, fwhm_nm=90.0) for c in (610.0, 540.0, 460.0)), ("R", "G", "B"))
