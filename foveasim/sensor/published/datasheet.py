"""
Data sheets in the terms of EMVA 1288: values, what they imply, and contradictions.

Symbols and equations are those of EMVA Standard 1288, Release 4.0 Linear (https://www.emva.org/standards-technology/emva-1288/):
with the quantum efficiency η, the system gain K in DN/e-, the temporal dark noise σ_d in e- and the quantisation noise of
1/√12 DN, the absolute sensitivity threshold is μ_e.min = √(σ_d² + 1 / (12 K²)) + 1/2, the maximum SNR √μ_e.sat, and the dynamic
range μ_e.sat / μ_e.min. Photons are electrons over η.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, special

from foveasim._core.calls import Limits
from foveasim._core.names import did_you_mean
from foveasim._core.quantities import format_quantity
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_count, check_number, read_only
from foveasim.errors import FoveasimWarning, ParameterError, warn
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.sensor.published.presets import SWING_V
from foveasim.units import ELEMENTARY_CHARGE_C

__all__ = ["DataSheet", "read_datasheet"]

#: Black level of a sensor without one in its data sheet, in standard deviations of dark frames.
BLACK_SIGMA = 5
#: Largest relative rounding of a whole number that ends in zeros, which may be exact or not.
ROUND_FRACTION = 0.005
#: Difference from what other values imply, above which a value has a wrong unit, or belongs to another gain.
MAX_FRACTION = 0.25
#: Signal at an SNR of 1 without dark noise, e- (the approximation of the standard).
THRESHOLD_E = 0.5
#: Nodes of means over a standard normal distribution, so dense that sites reach their limit one after the other, and weights.
NODES = read_only(np.linspace(-5.0, 5.0, 2001))
WEIGHTS = read_only(np.exp(-0.5 * NODES**2) / np.exp(-0.5 * NODES**2).sum())
#: Quantities that a sensor needs; without a gain, the codes end at the saturation.
NEEDED = ("qe_percent", "dark_noise_e", "saturation_e")

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
        "snr_max_db": Limits(above=0.0, at_most=200.0, hint="in dB: 20 log10 of the ratio"),
        "dynamic_range_db": Limits(above=0.0, at_most=200.0, hint="in dB: 20 log10 of the ratio; a bit is 6.02 dB"),
        "dsnu_e": Limits(at_least=0.0, at_most=1e6),
        "dsnu_dn": Limits(at_least=0.0, at_most=1e5),
        "prnu_percent": Limits(at_least=0.0, at_most=30.0, hint="1 is 1 %"),
        "dark_current_e_per_s": Limits(at_least=0.0, at_most=1e9),
        "temperature_k": Limits(above=0.0, low=1.0, at_most=1000.0, hint="temperatures are in kelvin: 20 °C is 293.15 K"),
        "doubling_k": Limits(above=0.0, low=1.0, at_most=100.0),
        "black_level_dn": Limits(at_least=0.0, at_most=65_535.0),
    }
)  # fmt: skip


class Range(NamedTuple):
    """Smallest and largest value that is printed as a number."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """The number."""
        return 0.5 * (self.low + self.high)


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


def _threshold(noise_e: float, gain_dn_per_e: float) -> float:
    return math.sqrt(noise_e**2 + QUANTISATION_DN2 / gain_dn_per_e**2) + THRESHOLD_E


def _noise_at(threshold_e: float, gain_dn_per_e: float) -> float:
    return math.sqrt(max((threshold_e - THRESHOLD_E) ** 2 - QUANTISATION_DN2 / gain_dn_per_e**2, 0.0))


#: Relations of the standard; those of a quantity are in order of preference.
RELATIONS = (
    Relation("gain_dn_per_e", ("inverse_gain_e_per_dn",), lambda e: 1.0 / e, "1 / inverse_gain_e_per_dn"),
    Relation("inverse_gain_e_per_dn", ("gain_dn_per_e",), lambda dn: 1.0 / dn, "1 / gain_dn_per_e"),
    Relation("saturation_e", ("saturation_ph", "qe_percent"), lambda ph, qe: 0.01 * qe * ph, "qe x saturation_ph"),
    Relation("saturation_e", ("threshold_e", "dynamic_range_db"), lambda e, db: e * _ratio(db), "threshold_e x dynamic_range"),
    Relation("saturation_e", ("snr_max_db",), lambda db: _ratio(db) ** 2, "the square of snr_max"),
    Relation("saturation_ph", ("saturation_e", "qe_percent"), lambda e, qe: 100.0 * e / qe, "saturation_e / qe"),
    Relation("snr_max_db", ("saturation_e",), lambda e: _decibels(math.sqrt(e)), "the root of saturation_e"),
    Relation("threshold_e", ("threshold_ph", "qe_percent"), lambda ph, qe: 0.01 * qe * ph, "qe x threshold_ph"),
    Relation("threshold_e", ("dark_noise_e", "gain_dn_per_e"), _threshold, "dark_noise_e, quantisation and 1/2"),
    Relation("threshold_e", ("saturation_e", "dynamic_range_db"), lambda e, db: e / _ratio(db), "saturation_e / dynamic_range"),
    Relation("threshold_ph", ("threshold_e", "qe_percent"), lambda e, qe: 100.0 * e / qe, "threshold_e / qe"),
    Relation("dynamic_range_db", ("saturation_e", "threshold_e"), lambda e, t: _decibels(e / t), "saturation_e / threshold_e"),
    Relation("dark_noise_e", ("dark_noise_dn", "gain_dn_per_e"),
             lambda dn, gain: math.sqrt(max(dn**2 - QUANTISATION_DN2, 0.0)) / gain, "dark_noise_dn without quantisation"),
    Relation("dark_noise_e", ("threshold_e", "gain_dn_per_e"), _noise_at, "threshold_e without quantisation and 1/2"),
    Relation("dark_noise_dn", ("dark_noise_e", "gain_dn_per_e"),
             lambda e, gain: math.sqrt((e * gain) ** 2 + QUANTISATION_DN2), "dark_noise_e and quantisation"),
    Relation("qe_percent", ("saturation_e", "saturation_ph"), lambda e, ph: 100.0 * e / ph, "saturation_e / saturation_ph"),
    Relation("qe_percent", ("threshold_e", "threshold_ph"), lambda e, ph: 100.0 * e / ph, "threshold_e / threshold_ph"),
    Relation("dsnu_e", ("dsnu_dn", "gain_dn_per_e"), lambda dn, gain: dn / gain, "dsnu_dn / gain_dn_per_e"),
    Relation("dsnu_dn", ("dsnu_e", "gain_dn_per_e"), lambda e, gain: e * gain, "dsnu_e x gain_dn_per_e"),
)  # fmt: skip


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
    gain_dn_per_e, inverse_gain_e_per_dn : float
        System gain K, or its inverse.
    dark_noise_e, dark_noise_dn : float
        Temporal dark noise: without quantisation, e-; or with it, DN.
    threshold_ph, threshold_e : float
        Absolute sensitivity threshold, photons or e-.
    saturation_ph, saturation_e : float
        Saturation capacity, photons or e-.
    snr_max_db, dynamic_range_db : float
        Maximum SNR and dynamic range, ``20 log10``.
    dsnu_e, dsnu_dn, prnu_percent : float
        DSNU1288 and PRNU1288.
    dark_current_e_per_s, temperature_k, doubling_k : float
        Dark current at a temperature, and the rise that doubles it.
    black_level_dn : float
        Code of dark frames.

    Numbers as text, ``"10.0"``, keep their printed digits, which say how exact they are; a whole number that ends in zeros is
    exact to 0.5 %. All but pixel and bits may be omitted where others imply quantum efficiency, gain, dark noise and
    saturation.

    Raises
    ------
    ParameterError
        When a value is out of range, one of these four is neither given nor implied, or a value differs from what others imply
        by more than a quarter: a wrong unit, or a value for another gain.

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
    gain_dn_per_e: float | str | None = None
    inverse_gain_e_per_dn: float | str | None = None
    dark_noise_e: float | str | None = None
    dark_noise_dn: float | str | None = None
    threshold_ph: float | str | None = None
    threshold_e: float | str | None = None
    saturation_ph: float | str | None = None
    saturation_e: float | str | None = None
    snr_max_db: float | str | None = None
    dynamic_range_db: float | str | None = None
    dsnu_e: float | str | None = None
    dsnu_dn: float | str | None = None
    prnu_percent: float | str | None = None
    dark_current_e_per_s: float | str | None = None
    temperature_k: float | str | None = None
    doubling_k: float | str | None = None
    black_level_dn: float | str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", check_count("bits", self.bits, at_most=16))
        for name in NEEDED:
            if name not in self._ranges:
                ways = [" and ".join(each.others) for each in RELATIONS if each.name == name]
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
        return self._ranges[name].middle

    @property
    def derived(self) -> Mapping[str, str]:
        """Quantities that follow from others, and how."""
        return MappingProxyType(self._solution[1])

    @property
    def assumptions(self) -> tuple[str, ...]:
        """Sentences about what the data sheet leaves open, with the values of a sensor."""
        found = []
        if "gain_dn_per_e" not in self._ranges:
            found.append(f"The gain is {self.gain:.4g} DN/e-: the codes end where the saturation requires it.")
        if self.black_level_dn is None:
            found.append(f"The black level is {self.black_dn} DN, up to {BLACK_SIGMA} times the noise of dark frames.")
        if self.wavelength_nm is not None:
            found.append(f"The quantum efficiency at {self.value('wavelength_nm'):g} nm holds at all wavelengths.")
        reached_e = saturation_of_limit(self._codes / self.gain, self._prnu)
        if reached_e < (1.0 - ROUND_FRACTION) * self.value("saturation_e"):
            found.append(f"The codes end so early that the saturation of the sensor is {reached_e:.4g} e-.")
        found += [text for name, text in OPEN.items() if name not in self._ranges]
        return tuple(found)

    @cached_property
    def gain(self) -> float:
        """System gain K, DN/e-; by default, the codes end where the saturation requires it."""
        known = self._ranges.get("gain_dn_per_e")
        full_well_e = limit_of_saturation(self.value("saturation_e"), self._prnu)
        return self._codes / full_well_e if known is None else known.middle

    @cached_property
    def black_dn(self) -> int:
        """Black level, DN; by default, a multiple of the noise of dark frames."""
        ranges = self._ranges
        if "black_level_dn" in ranges:
            return round(ranges["black_level_dn"].middle)
        nothing, saturation, known = Range(0.0, 0.0), ranges["saturation_e"], ranges.get("gain_dn_per_e")
        gain = 2**self.bits / saturation.middle if known is None else known.middle
        spread_dn = gain * math.hypot(*(ranges.get(name, nothing).middle for name in ("dark_noise_e", "dsnu_e")))
        wanted_dn = math.ceil(BLACK_SIGMA * math.hypot(spread_dn, math.sqrt(QUANTISATION_DN2)))
        free_dn = wanted_dn if known is None else int(2**self.bits - 1 - known.low * saturation.low)
        return max(0, min(wanted_dn, free_dn))

    @property
    def _prnu(self) -> float:
        """Standard deviation of the response over its mean."""
        return 0.01 * self._ranges.get("prnu_percent", Range(0.0, 0.0)).middle

    @property
    def _codes(self) -> float:
        """Number of codes above the black level."""
        return 2**self.bits - 1 - self.black_dn

    def parameters(self, area_um2: Floats) -> dict[str, Any]:
        """
        Return the parameters of a sensor whose sites have these areas, (n_site,) µm².

        Full well, dark current and the steps of the ADC in electrons are proportional to the area; read noise, bits and
        relative nonuniformities are those of the pixel.

        Notes
        -----
        EMVA 1288 measures the saturation at the highest temporal variance, which is below the full well, since that cuts
        fluctuations off. A charge of mean μ, Gaussian of variance μ, that is cut at L has with z = (L - μ) / √μ the variance
        μ g(z). It is highest where g = g' (√μ + z / 2), with g' = 2 Q (z - m), the mean m = z Q - φ of the cut standard
        normal distribution, and Q = 1 - Φ(z); with PRNU, in the mean over sites, whose μ differ. Where the codes end before
        this full well, they limit the charge.
        """
        n_codes, scale = 2**self.bits, area_um2 / self.value("pixel_um") ** 2
        found: dict[str, Any] = {
            "qe": 0.01 * self.value("qe_percent"),
            "read_noise_e": self.value("dark_noise_e"),
            "capacitance_f": n_codes * ELEMENTARY_CHARGE_C / (self.gain * SWING_V) * scale,
            "v_sat_v": SWING_V,
            "bits": self.bits,
            "pedestal_v": SWING_V * self.black_dn / n_codes,
        }
        full_well_e = limit_of_saturation(self.value("saturation_e"), self._prnu)
        if full_well_e < self._codes / self.gain:
            found["full_well_e"] = full_well_e * scale
        ranges = self._ranges
        if "dsnu_e" in ranges:
            found["dsnu_e"] = ranges["dsnu_e"].middle
        for name, parameter, factor in COPIED:
            if name in ranges:
                found[parameter] = ranges[name].middle * factor
        if "dark_current_e_per_s" in ranges:
            found["dark_e_per_s"] = ranges["dark_current_e_per_s"].middle * scale
        return found

    @cached_property
    def _printed(self) -> dict[str, Range]:
        """Quantities that are printed."""
        given = {name: getattr(self, name) for name in QUANTITIES}
        return {name: _range_of(name, value) for name, value in given.items() if value is not None}

    @cached_property
    def _solution(self) -> tuple[dict[str, Range], dict[str, str]]:
        """Return all quantities, and how those follow that are not printed."""
        found = dict(self._printed)
        derived: dict[str, str] = {}
        while True:
            new = next((each for each in RELATIONS if each.name not in found and found.keys() >= {*each.others}), None)
            if new is None:
                return found, derived
            found[new.name], derived[new.name] = _follows(new, found), new.reason

    @property
    def _ranges(self) -> dict[str, Range]:
        return self._solution[0]

    def _contradictions(self) -> Iterator[tuple[str, str, float]]:
        """Yield printed values that contradict others: name, sentence, relative difference."""
        seen: set[frozenset[str]] = set()
        for relation in RELATIONS:
            names = frozenset((relation.name, *relation.others))
            if names in seen or not self._printed.keys() >= names:
                continue
            own, implied = self._printed[relation.name], _follows(relation, self._printed)
            if own.high < implied.low or implied.high < own.low:
                seen.add(names)
                text = f"must agree with {relation.reason}, {self._of(relation.others)}: {_shown(implied.middle)}"
                yield (
                    relation.name,
                    f"{text}, got {getattr(self, relation.name)}",
                    _difference(relation.name, own, implied),
                )
        gain, saturation = (self._ranges.get(name, Range(0.0, 0.0)) for name in ("gain_dn_per_e", "saturation_e"))
        black_dn = 0.0 if self.black_level_dn is None else self.value("black_level_dn")
        last_dn = 2.0**self.bits - 1.0
        if gain.low * saturation.low + black_dn > last_dn:
            reached_dn = gain.middle * saturation.middle + black_dn
            text = f"x saturation_e and the black level must be at most the last of {self.bits} bits, {last_dn:,.0f} DN"
            hint = f"got {reached_dn:,.0f} DN; is K of other bits, or its inverse?"
            yield "gain_dn_per_e", f"{text}, {hint}", reached_dn / last_dn - 1.0

    def _of(self, names: tuple[str, ...]) -> str:
        return ", ".join(f"{name} = {getattr(self, name)}" for name in names)


#: Quantities that are parameters of sensors, and their factors.
COPIED = (
    ("prnu_percent", "prnu_fraction", 0.01),
    ("temperature_k", "temperature_k", 1.0),
    ("temperature_k", "dark_reference_k", 1.0),
    ("doubling_k", "dark_doubling_k", 1.0),
)
#: What a sensor has where a data sheet contains no value.
OPEN: Mapping[str, str] = MappingProxyType(
    {
        "dsnu_e": "There is no DSNU.",
        "prnu_percent": "There is no PRNU.",
        "dark_current_e_per_s": "There is no dark current.",
        "temperature_k": "The temperature is 300 K.",
        "doubling_k": "The dark current doubles every 8 K.",
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


def limit_of_saturation(saturation_e: float, prnu_fraction: float = 0.0) -> float:
    """Return the limit of charges whose temporal variance is highest at a mean, e-."""
    high_e = saturation_e + 12.0 * (math.sqrt(saturation_e) + prnu_fraction * saturation_e)
    return float(optimize.brentq(lambda limit_e: _slope(saturation_e, limit_e, prnu_fraction), saturation_e, high_e))


def saturation_of_limit(limit_e: float, prnu_fraction: float = 0.0) -> float:
    """Return the mean of the highest temporal variance for a limit, e-."""
    low_e = limit_e / (1.0 + 12.0 * (1.0 / math.sqrt(limit_e) + prnu_fraction))
    return float(optimize.brentq(lambda mean_e: _slope(mean_e, limit_e, prnu_fraction), low_e, limit_e))


def _slope(mean_e: float, limit_e: float, prnu_fraction: float) -> float:
    """Return the derivative of the variance of limited charges by their mean."""
    factor = np.maximum(1.0 + prnu_fraction * NODES, 1e-3)
    own_e = mean_e * factor
    z = (limit_e - own_e) / np.sqrt(own_e)
    above, density = special.ndtr(-z), np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    mean = z * above - density
    variance = special.ndtr(z) - z * density + z**2 * above - mean**2
    slope = variance - 2.0 * above * (z - mean) * (np.sqrt(own_e) + 0.5 * z)
    return float(WEIGHTS @ (factor * slope))


def _follows(relation: Relation, known: Mapping[str, Range]) -> Range:
    """Return the range of a quantity for the ranges of others; functions are monotonic."""
    corners = [relation.function(*each) for each in itertools.product(*(known[name] for name in relation.others))]
    return Range(min(corners), max(corners))


def _range_of(name: str, value: object) -> Range:
    """Return the numbers that are printed as a value."""
    number = check_number(name, _number(name, value))
    QUANTITIES[name].check(name, number)
    mantissa, _, exponent = str(value).strip().lower().partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    if "." not in mantissa:
        zeros = len(mantissa) - len(mantissa.rstrip("0"))
        unit = min(10.0**zeros, max(1.0, 2.0 * ROUND_FRACTION * number)) if number else 0.0
    return Range(number - 0.5 * unit, number + 0.5 * unit)


def _number(name: str, value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        raise ParameterError(name, "must be a number, without its unit", value) from None


def _difference(name: str, own: Range, implied: Range) -> float:
    """Return the relative difference of two values; of decibels, that of the ratios."""
    first, second = own.middle, implied.middle
    if name.endswith("_db"):
        first, second = _ratio(first), _ratio(second)
    return abs(first - second) / max(first, second)


def _shown(value: float) -> str:
    return format_quantity(value, "", digits=4).strip()
