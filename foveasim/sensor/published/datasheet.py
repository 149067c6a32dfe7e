"""
Data sheets in the terms of EMVA 1288: values, what they imply, and contradictions.

Symbols and equations are those of EMVA Standard 1288, Release 4.0 Linear (https://www.emva.org/standards-technology/emva-1288/):
with the quantum efficiency η, the system gain K in DN/e-, the temporal dark noise σ_d in e- and the quantisation noise of
1/√12 DN, the absolute sensitivity threshold is μ_e.min = √(σ_d² + 1 / (12 K²)) + 1/2, the maximum SNR √μ_e.sat, and the dynamic
range μ_e.sat / μ_e.min. Photons are electrons over η. Nonuniformities are the root of the sum of the squares of their parts
of rows, columns and pixels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.names import did_you_mean
from foveasim._core.quantities import format_quantity
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_count, check_number
from foveasim.errors import FoveasimWarning, ParameterError, warn
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.sensor.published.response import (
    Response,
    limit_of_saturation,
    linearity_errors,
    loss_of_linearity_errors,
    response_of,
    saturation_of_limit,
)
from foveasim.sensor.spectral.tables import TableCurve
from foveasim.units import ELEMENTARY_CHARGE_C

__all__ = ["DataSheet", "read_datasheet"]

#: Black level of a sensor without one in its data sheet, in standard deviations of dark frames.
BLACK_SIGMA = 5
#: Position of the mean dark signal within a code: the first harmonic of the quantisation error vanishes there, so that noise
#: below one code is measured as such, with 1/12 DN² of quantisation.
WITHIN_CODE_DN = 0.25
#: Largest relative rounding of a whole number that ends in zeros, which may be exact or not.
ROUND_FRACTION = 0.005
#: Difference from what other values imply, above which a value has a wrong unit, or belongs to another gain.
MAX_FRACTION = 0.25
#: Signal at an SNR of 1 without dark noise, e- (the approximation of the standard).
THRESHOLD_E = 0.5
#: Voltage range of pixels whose data sheets state charges: only its product with the capacitance matters.
SWING_V = 1.0
#: Quantities that a sensor needs; without a gain, the codes end at the saturation.
NEEDED = ("dark_noise_e", "saturation_e")

#: Quantities of a sheet with their limits and units.
QUANTITIES: Mapping[str, Limits] = MappingProxyType(
    {
        "pixel_um": Limits(above=0.0, low=0.1, at_most=1e3, hint="the side of a pixel, in µm"),
        "qe_percent": Limits(above=0.0, at_most=100.0, hint="60 is 60 %"),
        "wavelength_nm": Limits(above=0.0, low=100.0, at_most=1e5, hint="wavelengths are in nm"),
        "gain_dn_per_e": Limits(above=0.0, low=1e-6, at_most=1e6, hint="its inverse is 'inverse_gain_e_per_dn'"),
        "inverse_gain_e_per_dn": Limits(above=0.0, low=1e-6, at_most=1e6, hint="K itself is 'gain_dn_per_e'"),
        "dark_noise_e": Limits(above=0.0, at_most=1e6),
        "dark_noise_dn": Limits(above=0.0, at_most=1e5),
        "threshold_ph": Limits(above=0.0, at_most=1e7),
        "threshold_e": Limits(above=0.0, at_most=1e7),
        "saturation_ph": Limits(above=0.0, low=10.0, at_most=1e8),
        "saturation_e": Limits(above=0.0, low=10.0, at_most=1e8),
        "full_well_e": Limits(above=0.0, low=10.0, at_most=1e8),
        "snr_max_db": Limits(above=0.0, at_most=200.0, hint="in dB: 20 log10 of the ratio"),
        "dynamic_range_db": Limits(above=0.0, at_most=200.0, hint="in dB: 20 log10 of the ratio; a bit is 6.02 dB"),
        "noise_dynamic_range_db": Limits(above=0.0, at_most=200.0, hint="in dB: 20 log10 of the ratio"),
        "dsnu_e": Limits(at_least=0.0, at_most=1e6),
        "dsnu_dn": Limits(at_least=0.0, at_most=1e5),
        "dsnu_row_e": Limits(at_least=0.0, at_most=1e6),
        "dsnu_column_e": Limits(at_least=0.0, at_most=1e6),
        "dsnu_pixel_e": Limits(at_least=0.0, at_most=1e6),
        "prnu_percent": Limits(at_least=0.0, at_most=30.0, hint="1 is 1 %"),
        "prnu_row_percent": Limits(at_least=0.0, at_most=30.0, hint="1 is 1 %"),
        "prnu_column_percent": Limits(at_least=0.0, at_most=30.0, hint="1 is 1 %"),
        "prnu_pixel_percent": Limits(at_least=0.0, at_most=30.0, hint="1 is 1 %"),
        "linearity_error_min_percent": Limits(at_least=-50.0, at_most=0.0, hint="the smallest deviation is negative"),
        "linearity_error_max_percent": Limits(at_least=0.0, at_most=50.0, hint="the largest deviation is positive"),
        "dark_current_e_per_s": Limits(at_least=0.0, at_most=1e9),
        "temperature_k": Limits(above=0.0, low=1.0, at_most=1000.0, hint="temperatures are in kelvin: 20 °C is 293.15 K"),
        "doubling_k": Limits(above=0.0, low=1.0, at_most=100.0),
        "black_level_dn": Limits(at_least=0.0, at_most=65_535.0),
        "frames_per_s": Limits(above=0.0, at_most=1e9),
    }
)  # fmt: skip


class Range(NamedTuple):
    """Smallest and largest value that is printed as a number, and the number."""

    low: float
    high: float
    value: float


class Relation(NamedTuple):
    """A quantity that follows from others, by a monotonic function of each, and how."""

    name: str
    others: tuple[str, ...]
    function: Callable[..., float]
    reason: str


def _ratio(value_db: float) -> float:
    return float(10.0 ** (value_db / 20.0))


def _decibels(ratio: float) -> float:
    return 20.0 * math.log10(ratio)


def _times(value_e: float, value_db: float) -> float:
    return value_e * _ratio(value_db)


def _over(value_e: float, value_db: float) -> float:
    return value_e / _ratio(value_db)


def _decibels_of(one_e: float, other_e: float) -> float:
    return _decibels(one_e / other_e)


def _threshold(noise_e: float, gain_dn_per_e: float) -> float:
    return math.sqrt(noise_e**2 + QUANTISATION_DN2 / gain_dn_per_e**2) + THRESHOLD_E


def _noise_at(threshold_e: float, gain_dn_per_e: float) -> float:
    return math.sqrt(max((threshold_e - THRESHOLD_E) ** 2 - QUANTISATION_DN2 / gain_dn_per_e**2, 0.0))


#: Relations of the standard; those of a quantity are in order of preference.
RELATIONS = (
    Relation("gain_dn_per_e", ("inverse_gain_e_per_dn",), lambda e: 1.0 / e, "1 / inverse_gain_e_per_dn"),
    Relation("inverse_gain_e_per_dn", ("gain_dn_per_e",), lambda dn: 1.0 / dn, "1 / gain_dn_per_e"),
    Relation("saturation_e", ("saturation_ph", "qe_percent"), lambda ph, qe: 0.01 * qe * ph, "qe x saturation_ph"),
    Relation("saturation_e", ("threshold_e", "dynamic_range_db"), _times, "threshold_e x dynamic_range"),
    Relation("saturation_e", ("snr_max_db",), lambda db: _ratio(db) ** 2, "the square of snr_max"),
    Relation("saturation_e", ("dark_noise_e", "noise_dynamic_range_db"), _times, "dark_noise_e x noise_dynamic_range"),
    Relation("saturation_ph", ("saturation_e", "qe_percent"), lambda e, qe: 100.0 * e / qe, "saturation_e / qe"),
    Relation("snr_max_db", ("saturation_e",), lambda e: _decibels(math.sqrt(e)), "the root of saturation_e"),
    Relation("threshold_e", ("threshold_ph", "qe_percent"), lambda ph, qe: 0.01 * qe * ph, "qe x threshold_ph"),
    Relation("threshold_e", ("dark_noise_e", "gain_dn_per_e"), _threshold, "dark_noise_e, quantisation and 1/2"),
    Relation("threshold_e", ("saturation_e", "dynamic_range_db"), _over, "saturation_e / dynamic_range"),
    Relation("threshold_ph", ("threshold_e", "qe_percent"), lambda e, qe: 100.0 * e / qe, "threshold_e / qe"),
    Relation("dynamic_range_db", ("saturation_e", "threshold_e"), _decibels_of, "saturation_e / threshold_e"),
    Relation("dark_noise_e", ("dark_noise_dn", "gain_dn_per_e"),
             lambda dn, gain: math.sqrt(max(dn**2 - QUANTISATION_DN2, 0.0)) / gain, "dark_noise_dn without quantisation"),
    Relation("dark_noise_e", ("threshold_e", "gain_dn_per_e"), _noise_at, "threshold_e without quantisation and 1/2"),
    Relation("dark_noise_e", ("full_well_e", "noise_dynamic_range_db"), _over, "full_well_e / noise_dynamic_range"),
    Relation("dark_noise_e", ("saturation_e", "noise_dynamic_range_db"), _over, "saturation_e / noise_dynamic_range"),
    Relation("noise_dynamic_range_db", ("full_well_e", "dark_noise_e"), _decibels_of, "full_well_e / dark_noise_e"),
    Relation("noise_dynamic_range_db", ("saturation_e", "dark_noise_e"), _decibels_of, "saturation_e / dark_noise_e"),
    Relation("dark_noise_dn", ("dark_noise_e", "gain_dn_per_e"),
             lambda e, gain: math.sqrt((e * gain) ** 2 + QUANTISATION_DN2), "dark_noise_e and quantisation"),
    Relation("qe_percent", ("saturation_e", "saturation_ph"), lambda e, ph: 100.0 * e / ph, "saturation_e / saturation_ph"),
    Relation("qe_percent", ("threshold_e", "threshold_ph"), lambda e, ph: 100.0 * e / ph, "threshold_e / threshold_ph"),
    Relation("dsnu_e", ("dsnu_dn", "gain_dn_per_e"), lambda dn, gain: dn / gain, "dsnu_dn / gain_dn_per_e"),
    Relation("dsnu_dn", ("dsnu_e", "gain_dn_per_e"), lambda e, gain: e * gain, "dsnu_e x gain_dn_per_e"),
)  # fmt: skip


#: Parts of nonuniformities, whose total is the root of the sum of their squares.
PARTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "dsnu_e": ("dsnu_row_e", "dsnu_column_e", "dsnu_pixel_e"),
        "prnu_percent": ("prnu_row_percent", "prnu_column_percent", "prnu_pixel_percent"),
    }
)
SUM_OF_PARTS = "the root of the sum of squares of its parts"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class DataSheet:
    """
    Values of a data sheet, as they are printed.

    Parameters
    ----------
    title, source : str
        Name of the product, and where the values are printed.
    pixel_um : float, µm
        Side of a pixel.
    bits : int
        Bits of the codes for which the gain holds.
    qe_percent, wavelength_nm : float
        Quantum efficiency, and the wavelength at which it holds.
    qe_curve : sequence of (wavelength, percent)
        Quantum efficiency at wavelengths in nm, in ascending order; linear between them.
    gain_dn_per_e, inverse_gain_e_per_dn : float
        System gain K, or its inverse.
    dark_noise_e, dark_noise_dn : float
        Temporal dark noise: without quantisation, e-; or with it, DN.
    threshold_ph, threshold_e : float
        Absolute sensitivity threshold, photons or e-.
    saturation_ph, saturation_e : float
        Saturation capacity, photons or e-: the mean at which the temporal variance is highest.
    full_well_e : float
        Largest charge of a pixel, which is higher than the saturation capacity; where the codes end before it, they limit the
        charge.
    snr_max_db, dynamic_range_db : float
        Maximum SNR and dynamic range, ``20 log10``.
    noise_dynamic_range_db : float
        Full well or saturation over the dark noise, ``20 log10``: the dynamic range of many manufacturers, which is larger
        than that of EMVA 1288.
    dsnu_e, dsnu_dn, prnu_percent : float
        DSNU1288 and PRNU1288.
    dsnu_row_e, dsnu_column_e, dsnu_pixel_e, prnu_row_percent, prnu_column_percent, prnu_pixel_percent : float
        Their parts.
    linearity_error_min_percent, linearity_error_max_percent : float
        Smallest and largest relative deviation from a line, of which the first is negative.
    dark_current_e_per_s, temperature_k, doubling_k : float
        Dark current at a temperature, and the rise that doubles it.
    black_level_dn : float
        Code of dark frames.
    frames_per_s : float
    shutter : str
        For information.

    Numbers as text, ``"10.0"``, keep their printed digits, which say how exact they are; a whole number that ends in zeros is
    exact to 0.5 %. All but pixel and bits may be omitted where others imply dark noise and saturation; :attr:`assumptions`
    says what a sensor has instead.

    Raises
    ------
    ParameterError
        When a value is out of range, dark noise or saturation are neither given nor implied, or a value differs from what
        others imply by more than a quarter: a wrong unit, or a value for another gain.

    Warns
    -----
    FoveasimWarning
        For each value that differs from what others imply by more than their rounding.

    Examples
    --------
    >>> import foveasim as fs
    >>> sheet = fs.sensor.DataSheet(
    ...     title="acA1920-155um",
    ...     pixel_um="5.86",
    ...     bits=12,
    ...     qe_percent=70,
    ...     inverse_gain_e_per_dn="8.4",
    ...     dark_noise_e="6.8",
    ...     saturation_e=32700,
    ... )
    >>> round(sheet.value("dynamic_range_db"), 1), sheet.derived["dynamic_range_db"]
    (72.5, 'saturation_e / threshold_e')
    """

    title: str = ""
    source: str = ""
    pixel_um: float | str
    bits: int
    qe_percent: float | str | None = None
    wavelength_nm: float | str | None = None
    qe_curve: Sequence[Sequence[float | str]] | None = None
    gain_dn_per_e: float | str | None = None
    inverse_gain_e_per_dn: float | str | None = None
    dark_noise_e: float | str | None = None
    dark_noise_dn: float | str | None = None
    threshold_ph: float | str | None = None
    threshold_e: float | str | None = None
    saturation_ph: float | str | None = None
    saturation_e: float | str | None = None
    full_well_e: float | str | None = None
    snr_max_db: float | str | None = None
    dynamic_range_db: float | str | None = None
    noise_dynamic_range_db: float | str | None = None
    dsnu_e: float | str | None = None
    dsnu_dn: float | str | None = None
    dsnu_row_e: float | str | None = None
    dsnu_column_e: float | str | None = None
    dsnu_pixel_e: float | str | None = None
    prnu_percent: float | str | None = None
    prnu_row_percent: float | str | None = None
    prnu_column_percent: float | str | None = None
    prnu_pixel_percent: float | str | None = None
    linearity_error_min_percent: float | str | None = None
    linearity_error_max_percent: float | str | None = None
    dark_current_e_per_s: float | str | None = None
    temperature_k: float | str | None = None
    doubling_k: float | str | None = None
    black_level_dn: float | str | None = None
    frames_per_s: float | str | None = None
    shutter: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", check_count("bits", self.bits, at_most=16))
        if self.qe_curve is not None:
            object.__setattr__(self, "qe_curve", _check_curve(self.qe_curve))
        for name in NEEDED:
            if name not in self._ranges:
                ways = [" and ".join(each.others) for each in RELATIONS if each.name == name]
                ways += ["full_well_e"] if name == "saturation_e" else []
                raise ParameterError(name, f"must be in the data sheet, or follow from {' or from '.join(ways)}")
        for name in self._ranges:  # values that follow may be impossible, too
            QUANTITIES[name].check(name, self.value(name))
        if self._codes < 1:
            rule = f"must be below the last code of {self.bits} bits, {2**self.bits - 1}"
            raise ParameterError("black_level_dn", rule, self.black_dn)
        for name, text, fraction in self._contradictions():
            if fraction > MAX_FRACTION:
                raise ParameterError(name, text)
            warn(f"{self.title or 'data sheet'}: '{name}' {text}", FoveasimWarning)

    def __repr__(self) -> str:
        return f"DataSheet({self.title!r}, {self.bits} bits)"

    def value(self, name: str) -> float:
        """
        Return a quantity, as printed or as it follows from others.

        Raises
        ------
        ParameterError
            When there is no such quantity, or it is not known.
        """
        if name not in QUANTITIES:
            raise ParameterError("name", "must be a quantity", name, hint=did_you_mean(name, QUANTITIES))
        if name not in self._ranges:
            raise ParameterError("name", "must be a quantity that the data sheet contains or implies", name)
        return self._ranges[name].value

    @property
    def derived(self) -> Mapping[str, str]:
        """Quantities that follow from others, and how."""
        return MappingProxyType(self._solution[1])

    @property
    def assumptions(self) -> tuple[str, ...]:
        """Sentences about what the data sheet leaves open, or a sensor cannot have."""
        found = []
        if "gain_dn_per_e" not in self._ranges:
            found.append(f"The gain is {self.gain:.4g} DN/e-: the codes end where the saturation requires it.")
        if self.black_level_dn is None:
            found.append(f"The black level is {self.black_dn} DN, {BLACK_SIGMA} times the noise of dark frames.")
        if "qe_percent" not in self._ranges:
            found.append("The quantum efficiency is 1, unless another one is given.")
        elif self.qe_curve is None and self.wavelength_nm is not None:
            found.append(f"The quantum efficiency at {self.value('wavelength_nm'):g} nm holds at all wavelengths.")
        reached_e = saturation_of_limit(self._end_e, self._prnu) / self._response.true_fraction
        if reached_e < (1.0 - ROUND_FRACTION) * self.value("saturation_e"):
            found.append(f"The codes end so early that the saturation of the sensor is {reached_e:.4g} e-.")
        if self._has_well and self._end_e < (1.0 - ROUND_FRACTION) * self._limit_e:
            found.append(f"The codes end at {self._end_e:.4g} e-, before the full well.")
        found += self._linearity_sentences()
        for name in ("dsnu_row_e", "prnu_row_percent", "prnu_column_percent"):
            if self._printed.get(name, NOTHING).high > 0.0:
                found.append(f"A sensor has no {name}: this part is among the pixels.")
        if self._printed.get("dsnu_column_e", NOTHING).high > 0.0:
            found.append("Without readout lines in the layout, dsnu_column_e is among the pixels.")
        for name in ("shutter", "frames_per_s"):
            if getattr(self, name):
                found.append(f"A sensor does not contain {name}, {getattr(self, name)}.")
        found += [text for name, text in OPEN.items() if name not in self._ranges]
        return tuple(found)

    def _linearity_sentences(self) -> list[str]:
        """Return a sentence about a linearity error that a sensor does not have."""
        printed = [name for name in LINEARITY if name in self._printed]
        loss = self._response.loss_fraction
        found = [100.0 * error for error in linearity_errors(loss)]
        if all(abs(found[LINEARITY.index(name)] - self.value(name)) <= 0.1 * abs(self.value(name)) for name in printed):
            return []
        text = ", ".join(f"{name} = {getattr(self, name)}" for name in printed)
        return [f"The response is quadratic, with linearity errors of {found[0]:.2g} to {found[1]:.2g} %, not {text}."]

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Source, printed and derived quantities, and assumptions, as plain data."""
        skipped = ("title", "source", "qe_curve")
        given = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in skipped}
        printed = {name: str(value) for name, value in given.items() if value not in (None, "")}
        if self.qe_curve is not None:
            printed["qe_curve"] = ", ".join(
                f"{percent:g} % at {wavelength:g} nm" for wavelength, percent in self._curve
            )
        return MappingProxyType(
            {
                "title": self.title,
                "source": self.source,
                "printed": printed,
                "derived": dict(self.derived),
                "assumptions": list(self.assumptions),
            }
        )

    @cached_property
    def gain(self) -> float:
        """System gain K, DN/e-; by default, the codes end where the saturation requires it."""
        needed_dn_per_e = self._codes / (
            self._limit_e * (1.0 - self._response.loss_fraction * self._limit_e / self._saturated_e)
        )
        known = self._ranges.get("gain_dn_per_e")
        # Within its printed digits, a gain whose codes reach the saturation.
        return needed_dn_per_e * self._response.gain if known is None else self._chosen(known, needed_dn_per_e)

    def _chosen(self, known: Range, needed_dn_per_e: float) -> float:
        return (
            max(known.low, min(known.value, needed_dn_per_e * self._response.gain)) if known.low > 0.0 else known.value
        )

    @cached_property
    def black_dn(self) -> int:
        """Black level, DN; by default, a multiple of the noise of dark frames."""
        return self._black_of(self._ranges)

    def _black_of(self, ranges: Mapping[str, Range]) -> int:
        """Return the black level for known quantities."""
        if "black_level_dn" in ranges:
            return round(ranges["black_level_dn"].value)
        known, full_e = ranges.get("gain_dn_per_e"), ranges["full_well_e" if self._has_well else "saturation_e"]
        gain = 2**self.bits / full_e.value if known is None else known.value
        spread_dn = gain * math.hypot(*(ranges.get(name, NOTHING).value for name in ("dark_noise_e", "dsnu_e")))
        return math.ceil(BLACK_SIGMA * math.hypot(spread_dn, math.sqrt(QUANTISATION_DN2)))

    @cached_property
    def _response(self) -> Response:
        """Response with the linearity errors; linear where no quadratic one has them."""
        smallest, largest = (0.01 * self._printed.get(name, NOTHING).value for name in LINEARITY)
        return response_of(loss_of_linearity_errors(smallest, largest) or 0.0)

    @property
    def _signal_fraction(self) -> float:
        """Signal at saturation over that of a linear response with the measured gain."""
        return (1.0 - self._response.loss_fraction) / self._response.signal_fraction

    @cached_property
    def _saturated_e(self) -> float:
        """Charge at saturation; with a nonlinear response, not that of the measured gain."""
        return self.value("saturation_e") * self._response.true_fraction

    @cached_property
    def _limit_e(self) -> float:
        """Largest charge: the full well, or the limit that causes the saturation."""
        if self._has_well:
            return self.value("full_well_e")
        return limit_of_saturation(self._saturated_e, self._prnu)

    @property
    def _has_well(self) -> bool:
        """Whether the saturation follows from a full well."""
        return "saturation_e" not in self._printed and "full_well_e" in self._printed

    @cached_property
    def _end_e(self) -> float:
        """Charge at which the codes end."""
        ratio, response = self._codes * self._response.gain / self.gain, self._response
        if not response.loss_fraction:
            return ratio
        # x (1 - loss x / saturation) = ratio, of which the smaller root increases with the charge.
        slope = response.loss_fraction / self._saturated_e
        inner = 1.0 - 4.0 * slope * ratio
        return (1.0 - math.sqrt(inner)) / (2.0 * slope) if inner > 0.0 else math.inf

    @property
    def _prnu(self) -> float:
        """Standard deviation of the response over its mean."""
        return 0.01 * self._ranges.get("prnu_percent", NOTHING).value

    @property
    def _codes(self) -> float:
        """Number of codes above the black level."""
        return 2**self.bits - 1 - self.black_dn

    def settings(self, *, has_lines: bool = False) -> dict[str, Any]:
        """
        Return the parameters of a sensor as in settings files.

        Full well, dark current and the steps of the ADC in electrons are proportional to the area, ``{"per_um2": value}``; read
        noise, DSNU, bits and relative nonuniformities are those of the pixel.

        Parameters
        ----------
        has_lines : bool
            Whether the sites have readout lines, which receive the DSNU of columns.

        Notes
        -----
        EMVA 1288 measures the saturation at the highest temporal variance, which is below the full well, since that cuts
        fluctuations off. A charge of mean μ, Gaussian of variance μ, that is cut at L has with z = (L - μ) / √μ the variance
        μ g(z). It is highest where g = g' (√μ + z / 2), with g' = 2 Q (z - m), the mean m = z Q - φ of the cut standard
        normal distribution, and Q = 1 - Φ(z); with PRNU, in the mean over sites, whose μ differ. Where the codes end before
        this full well, they limit the charge.

        A linearity error is that of a quadratic response, whose relative loss at saturation causes the larger deviation of
        the sheet, at 50 levels. Gain, quantum efficiency and charges are then those at zero signal, of which EMVA 1288
        measures slopes up to 70 % of saturation.
        """
        n_codes, ranges, response = 2**self.bits, self._ranges, self._response
        gain, per_um2 = self.gain / response.gain, self.value("pixel_um") ** -2
        found: dict[str, Any] = {
            "read_noise_e": self.value("dark_noise_e") * response.gain,
            "capacitance_f": {"per_um2": n_codes * ELEMENTARY_CHARGE_C / (gain * SWING_V) * per_um2},
            "v_sat_v": SWING_V,
            "bits": self.bits,
            "pedestal_v": SWING_V * (self.black_dn + WITHIN_CODE_DN) / n_codes,
        }
        if "qe_percent" in ranges:
            scale = 0.01 * response.true_fraction
            found["qe"] = self.value("qe_percent") * scale
            if self.qe_curve is not None:
                waves, percents = zip(*self._curve, strict=True)
                values = [min(scale * percent, 1.0) for percent in percents]
                found["qe"] = {"kind": "table", "wavelength_nm": list(waves), "value": values}
        if self._limit_e < self._end_e:
            found["full_well_e"] = {"per_um2": self._limit_e * per_um2}
        if response.loss_fraction:
            found["nonlinearity_fraction"] = response.loss_fraction * n_codes / (gain * self._saturated_e)
        if "dsnu_e" in ranges:
            column_e = min(ranges.get("dsnu_column_e", NOTHING).value if has_lines else 0.0, self.value("dsnu_e"))
            found["dsnu_e"] = math.sqrt(self.value("dsnu_e") ** 2 - column_e**2) * response.gain
            if column_e:
                found["line_fpn_fraction"] = column_e * self.gain / n_codes
        for name, parameter, factor in COPIED:
            if name in ranges:
                found[parameter] = ranges[name].value * factor
        if "dark_current_e_per_s" in ranges:
            found["dark_e_per_s"] = {"per_um2": self.value("dark_current_e_per_s") * response.gain * per_um2}
        return {**found, "provenance": dict(self.provenance)}

    def parameters(self, area_um2: Floats, *, has_lines: bool = False) -> dict[str, Any]:
        """Return :meth:`settings` for sites of these areas, (n_site,) µm²."""
        return for_areas(self.settings(has_lines=has_lines), area_um2)

    @cached_property
    def _printed(self) -> dict[str, Range]:
        """Quantities that are printed."""
        given = {name: getattr(self, name) for name in QUANTITIES}
        return {name: _range_of(name, value) for name, value in given.items() if value is not None}

    @cached_property
    def _curve(self) -> tuple[tuple[float, float], ...]:
        """Wavelengths and percents of the curve."""
        return tuple((float(wavelength), float(percent)) for wavelength, percent in self.qe_curve or ())

    def _qe_of_curve(self) -> tuple[Range, str]:
        """Return the quantum efficiency of the curve at the wavelength of the sheet, or its peak."""
        waves = [wavelength for wavelength, _ in self._curve]
        ends = [_range_of("qe_percent", percent) for _, percent in self.qe_curve or ()]
        if "wavelength_nm" not in self._printed:
            return max(ends, key=lambda each: each.value), "the peak of qe_curve"
        at_nm = self._printed["wavelength_nm"].value
        if not waves[0] <= at_nm <= waves[-1]:
            raise ParameterError("wavelength_nm", f"must be on qe_curve, {waves[0]:g} to {waves[-1]:g} nm", at_nm, "nm")
        at_ends = (float(np.interp(at_nm, waves, each)) for each in zip(*ends, strict=True))
        return Range(*at_ends), "qe_curve at wavelength_nm"

    @cached_property
    def _solution(self) -> tuple[dict[str, Range], dict[str, str]]:
        """Return all quantities, and how those follow that are not printed."""
        found = dict(self._printed)
        derived: dict[str, str] = {}
        if self.qe_curve is not None and "qe_percent" not in found:
            found["qe_percent"], derived["qe_percent"] = self._qe_of_curve()
        for name, parts in PARTS.items():
            if name not in found and (implied := _sum_of(parts, found)) is not None:
                found[name], derived[name] = implied, SUM_OF_PARTS
        skipped = {"saturation_e"} if self._has_well else set()
        while True:
            new = next(
                (each for each in RELATIONS if each.name not in {*found, *skipped} and found.keys() >= {*each.others}),
                None,
            )
            if new is not None:
                found[new.name], derived[new.name] = _follows(new, found), new.reason
            elif self._has_well and "saturation_e" not in found:
                found["saturation_e"], derived["saturation_e"] = self._saturation_of_well(found)
            else:
                return found, derived

    def _saturation_of_well(self, known: Mapping[str, Range]) -> tuple[Range, str]:
        """Return the saturation that a full well causes, or the end of the codes before it."""
        well, gain = known["full_well_e"], known.get("gain_dn_per_e")
        prnu = 0.01 * known.get("prnu_percent", NOTHING).value
        ends = ENDLESS
        if gain is not None:
            codes = max(2**self.bits - 1 - self._black_of(known), 1)
            ends = Range(codes / gain.high, codes / max(gain.low, 1e-9), codes / gain.value)
        limits = [min(each, end) for each, end in zip(well, ends, strict=True)]
        if min(limits) < 1.0:
            raise ParameterError("full_well_e", "must be larger than a code", self.full_well_e, "e-")
        reason = "the highest temporal variance below full_well_e"
        reason += " or the end of the codes" if limits[0] < well.low else ""
        return Range(*(saturation_of_limit(each, prnu) for each in limits)), reason

    @property
    def _ranges(self) -> dict[str, Range]:
        return self._solution[0]

    def _contradictions(self) -> Iterator[tuple[str, str, float]]:
        """Yield printed values that contradict others: name, sentence, relative difference."""
        seen: set[frozenset[str]] = set()
        for relation in RELATIONS:
            names = frozenset((relation.name, *relation.others))
            if names in seen or relation.name not in self._printed or not self._ranges.keys() >= {*relation.others}:
                continue
            if self._has_well and names >= {"saturation_e", "noise_dynamic_range_db"}:
                continue  # its range is that of the full well
            own, implied = self._printed[relation.name], _follows(relation, self._ranges)
            if own.high < implied.low or implied.high < own.low:
                seen.add(names)
                text = f"must agree with {relation.reason}, {self._of(relation.others)}: {_shown(implied.value)}"
                text = f"{text}, got {getattr(self, relation.name)}{self._range_hint(names)}"
                yield relation.name, text, _difference(relation.name, own, implied)
        if self.qe_curve is not None and self._printed.keys() >= {"qe_percent", "wavelength_nm"}:
            own, (implied, reason) = self._printed["qe_percent"], self._qe_of_curve()
            if own.high < implied.low or implied.high < own.low:
                text = f"must agree with {reason}: {_shown(implied.value)}, got {self.qe_percent}"
                yield "qe_percent", text, _difference("qe_percent", own, implied)
        threshold, noise = self._ranges.get("threshold_e", ENDLESS), self._ranges["dark_noise_e"]
        least = Range(*(each + THRESHOLD_E for each in noise))
        if threshold.high < least.low:  # also without a gain, which only increases the threshold
            name = next((name for name in ("threshold_e", "threshold_ph") if name in self._printed), "dynamic_range_db")
            text = f"must not imply a threshold below dark_noise_e + 1/2 = {_shown(least.value)} e-, got {getattr(self, name)}"
            yield name, text + self._range_hint(frozenset([name])), _difference("threshold_e", threshold, least)
        for name, parts in PARTS.items():
            implied_sum = _sum_of(parts, self._printed)
            if name in self._printed and implied_sum is not None:
                own, is_complete = self._printed[name], self._printed.keys() >= {*parts}
                if own.high < implied_sum.low or (is_complete and implied_sum.high < own.low):
                    text = f"must agree with {SUM_OF_PARTS}: {_shown(implied_sum.value)}, got {getattr(self, name)}"
                    yield name, text, _difference(name, own, implied_sum)
        if self._printed.get("saturation_e", NOTHING).low > self._printed.get("full_well_e", ENDLESS).high:
            text = f"must be at most full_well_e = {self.full_well_e}, got {self.saturation_e}"
            yield "saturation_e", text, self.value("saturation_e") / self.value("full_well_e") - 1.0
        gain, saturation = (self._ranges.get(name, NOTHING) for name in ("gain_dn_per_e", "saturation_e"))
        black_dn = 0.0 if self.black_level_dn is None else self.value("black_level_dn")
        last_dn = 2.0**self.bits - 1.0
        if gain.low * saturation.low * self._signal_fraction + black_dn > last_dn:
            reached_dn = gain.value * saturation.value * self._signal_fraction + black_dn
            text = f"x saturation_e and the black level must be at most the last of {self.bits} bits, {last_dn:,.0f} DN"
            hint = f"got {reached_dn:,.0f} DN; is K of other bits, or its inverse?"
            yield "gain_dn_per_e", f"{text}, {hint}", reached_dn / last_dn - 1.0

    def _range_hint(self, names: frozenset[str]) -> str:
        """Return a hint where a dynamic range is that of many manufacturers."""
        known = self._ranges
        if "dynamic_range_db" not in names or not known.keys() >= {"saturation_e", "dark_noise_e"}:
            return ""
        noise = Relation("", ("saturation_e", "dark_noise_e"), _decibels_of, "")
        implied, own = _follows(noise, known), self._printed["dynamic_range_db"]
        is_of_noise = implied.low <= own.high and own.low <= implied.high
        return "; it is saturation_e / dark_noise_e: use 'noise_dynamic_range_db'" if is_of_noise else ""

    def _of(self, names: tuple[str, ...]) -> str:
        given = ((name, getattr(self, name)) for name in names)
        return ", ".join(f"{name} = {_shown(self.value(name)) if text is None else text}" for name, text in given)


#: Linearity errors in the order of :func:`foveasim.sensor.published.response.linearity_errors`.
LINEARITY = ("linearity_error_min_percent", "linearity_error_max_percent")
NOTHING, ENDLESS = Range(0.0, 0.0, 0.0), Range(math.inf, math.inf, math.inf)
#: Quantities that are parameters of sensors, and their factors.
COPIED = (
    ("prnu_percent", "prnu_fraction", 0.01),
    ("temperature_k", "temperature_k", 1.0),
    ("temperature_k", "dark_reference_k", 1.0),
    ("doubling_k", "dark_doubling_k", 1.0),
)
#: Parameters of sensors that data sheets specify.
PARAMETERS = frozenset(
    {
        "bits", "capacitance_f", "dark_e_per_s", "dsnu_e", "full_well_e", "line_fpn_fraction", "nonlinearity_fraction",
        "pedestal_v", "provenance", "qe", "read_noise_e", "v_sat_v", *(parameter for _, parameter, _ in COPIED),
    }
)  # fmt: skip
#: What a sensor has where a data sheet contains no value.
OPEN: Mapping[str, str] = MappingProxyType(
    {
        "dsnu_e": "There is no DSNU, since the sheet has none.",
        "prnu_percent": "There is no PRNU, since the sheet has none.",
        "dark_current_e_per_s": "There is no dark current, since the sheet has none.",
        "temperature_k": "The temperature is 300 K, the default of sensors.",
        "doubling_k": "The dark current doubles every 8 K, the default of sensors.",
    }
)


def read_datasheet(path: str | Path) -> DataSheet:
    """
    Read a data sheet from a YAML file, whose keys are the parameters of :class:`DataSheet`.

    Parameters
    ----------
    path : path

    Raises
    ------
    ParameterError
        When a key is unknown, or a value is not valid; see :class:`DataSheet`.
    FileError
        When the file cannot be read, or is no mapping.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "imx900.yaml")
    ...     _ = path.write_text(
    ...         "{pixel_um: '2.25', bits: 12, qe_percent: '91.25', gain_dn_per_e: '0.399',"
    ...         " dark_noise_e: '5.560', saturation_e: '9458'}"
    ...     )
    ...     sheet = fs.sensor.read_datasheet(path)
    >>> round(sheet.value("threshold_ph"), 2)
    6.69
    """
    from foveasim._io.yaml_files import read_yaml

    found = read_yaml(Path(path))
    names = {each.name for each in fields(DataSheet)}
    for key in found:
        if key not in names:
            raise ParameterError(
                str(key), f"must be a quantity of a data sheet, in {path}", hint=did_you_mean(str(key), names)
            )
    for key in ("pixel_um", "bits"):
        if key not in found:
            raise ParameterError(key, f"must be in the data sheet {path}")
    return DataSheet(**found)


def for_areas(settings: Mapping[str, Any], area_um2: Floats) -> dict[str, Any]:
    """Return parameters of settings for sites with these areas, (n_site,) µm²."""
    found = dict(settings)
    for name, value in settings.items():
        if isinstance(value, Mapping) and "per_um2" in value:
            found[name] = value["per_um2"] * area_um2
    if isinstance(found.get("qe"), Mapping):
        found["qe"] = TableCurve(**{name: value for name, value in found["qe"].items() if name != "kind"})
    return found


def _check_curve(curve: Sequence[Sequence[float | str]]) -> tuple[tuple[float | str, ...], ...]:
    """Return the rows of a curve after validation."""
    rows = tuple(tuple(row) if isinstance(row, list | tuple) else () for row in curve)
    if len(rows) < 2 or any(len(row) != 2 for row in rows):
        raise ParameterError("qe_curve", "must have at least two rows of a wavelength in nm and a percentage", curve)
    waves = [_range_of("wavelength_nm", wavelength).value for wavelength, _ in rows]
    for _, percent in rows:
        QUANTITIES["dsnu_e" if _number("qe_curve", percent) == 0.0 else "qe_percent"].check(
            "qe_curve", check_number("qe_curve", _number("qe_curve", percent))
        )
    if any(second <= first for first, second in itertools.pairwise(waves)):
        raise ParameterError("qe_curve", "must have wavelengths in ascending order", waves, "nm")
    return rows


def _follows(relation: Relation, known: Mapping[str, Range]) -> Range:
    """Return the range of a quantity for the ranges of others; functions are monotonic."""
    given = [known[name] for name in relation.others]
    corners = [relation.function(*each) for each in itertools.product(*((each.low, each.high) for each in given))]
    return Range(min(corners), max(corners), relation.function(*(each.value for each in given)))


def _sum_of(parts: Sequence[str], known: Mapping[str, Range]) -> Range | None:
    """Return the root of the sum of squares of known parts; None without one."""
    found = [known[name] for name in parts if name in known]
    return Range(*(math.hypot(*(max(each[k], 0.0) for each in found)) for k in range(3))) if found else None


def _range_of(name: str, value: object) -> Range:
    """Return the numbers that are printed as a value."""
    number = check_number(name, _number(name, value))
    QUANTITIES[name].check(name, number)
    mantissa, _, exponent = str(value).strip().lower().partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    if "." not in mantissa:
        zeros = len(mantissa) - len(mantissa.rstrip("0"))
        unit = min(10.0**zeros, max(1.0, 2.0 * ROUND_FRACTION * number)) if number else 0.0
    return Range(number - 0.5 * unit, number + 0.5 * unit, number)


def _number(name: str, value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        raise ParameterError(name, "must be a number, without its unit", value) from None


def _difference(name: str, own: Range, implied: Range) -> float:
    """Return the relative difference of two values; of decibels, that of the ratios."""
    first, second = own.value, implied.value
    if name.endswith("_db"):
        first, second = _ratio(first), _ratio(second)
    return abs(first - second) / max(first, second)


def _shown(value: float) -> str:
    return format_quantity(value, "", digits=4).strip()
