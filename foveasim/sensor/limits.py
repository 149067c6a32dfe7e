"""
Plausible ranges of sensor and exposure parameters, in one table.

Values outside these ranges indicate errors of units or digits. The ranges are wide: no sensor in use reaches their limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import check_number, finite_array, unit_of
from foveasim.errors import ParameterError

__all__ = ["LIMITS", "MAX_SPREAD", "Limits", "check_plausible", "check_plausible_array"]

#: Maximum relative standard deviation of Gaussian factors: 1 in 2,300 values is then below 0 and clipped.
MAX_SPREAD = 0.3
_GAUSSIAN = "0.03 is 3 %; a Gaussian distribution with a standard deviation above 0.3 would be clipped at 0"
_ELECTRONS = "charges are in electrons: 1 fC is 6242 e-"
_RATES = "rates are in electrons per second: 1 fA is 6242 e-/s"
_SECONDS = "times are in seconds: 1 ms is 1e-3"
_VOLTS = "voltages are in volts: 1 mV is 1e-3"
_KELVIN = "temperatures are in kelvin: 0 °C is 273.15 K"
_PER_SECOND = "rates are per second and photosite"


@dataclass(frozen=True, kw_only=True)
class Limits:
    """
    Plausible range of a parameter.

    Parameters
    ----------
    high : float
        Largest plausible value, in the parameter's unit.
    low : float
        Smallest plausible value; negative only for parameters of both signs.
    is_positive : bool
        Whether 0 is excluded; otherwise 0 is valid for any ``low``.
    hint : str
        Reminder of the unit, for error messages.
    """

    high: float
    low: float = 0.0
    is_positive: bool = False
    hint: str = ""

    @property
    def rule(self) -> str:
        """Rule of the range for error messages."""
        if self.low == 0.0:
            return f"must be <= {self.high:g}"
        is_zero_separate = self.low > 0.0 and not self.is_positive
        return f"must be {'0, or ' if is_zero_separate else ''}from {self.low:g} to {self.high:g}"


_FRACTION = Limits(high=1.0, hint="fractions are from 0 to 1")
_SPREAD = Limits(high=MAX_SPREAD, hint=_GAUSSIAN)
#: Relative standard deviation of log-normal distributions.
_WIDE_SPREAD = Limits(high=10.0, hint="the value is the ratio of standard deviation to mean: 0.1 is 10 %")
_RATE_E = Limits(high=1e15, hint=_RATES)
_CHARGE_E = Limits(high=1e15, hint=_ELECTRONS)
#: For comparison: the reset noise of a microfarad at room temperature is 4e5 e-.
_NOISE_E = Limits(high=1e7, hint=_ELECTRONS)
_TIME_S = Limits(low=1e-12, high=1e7, hint=_SECONDS)
_DURATION_S = Limits(low=1e-12, high=1e7, is_positive=True, hint=_SECONDS)
_EVENTS = Limits(high=1e9, hint=_PER_SECOND)
#: Thresholds below 1e-3 are below the noise of any circuit, and would emit too many events for memory.
_CONTRAST = Limits(low=1e-3, high=20.0, is_positive=True, hint="contrasts are natural logarithms: 0.2 is 22 %")
_OFFSET = Limits(high=1.0, hint="offsets are fractions of v_sat_v: 0.02 is 2 %")

#: Ranges by keyword; keywords with different meanings in two classes are prefixed with the class.
LIMITS: Mapping[str, Limits] = MappingProxyType(
    {
        # Sensor
        "sensitivity": _FRACTION,
        "hot_fraction": _FRACTION,
        "dead_fraction": _FRACTION,
        "rts_fraction": _FRACTION,
        "nonlinearity_fraction": Limits(high=0.5, hint="above 0.5 the voltage would decrease with charge"),
        "prnu_fraction": _SPREAD,
        "gain_fpn_fraction": _SPREAD,
        "dsnu_fraction": _WIDE_SPREAD,
        "pixel_fpn_fraction": _OFFSET,
        "line_fpn_fraction": _OFFSET,
        "dark_e_per_s": _RATE_E,
        "hot_e_per_s": _RATE_E,
        "temperature_k": Limits(low=0.01, high=1000.0, is_positive=True, hint=_KELVIN),
        "dark_reference_k": Limits(low=0.01, high=1000.0, is_positive=True, hint=_KELVIN),
        "dark_doubling_k": Limits(low=0.1, high=1000.0, is_positive=True, hint="dark current doubles every 5 to 10 K"),
        "dark_activation_ev": Limits(
            low=0.01, high=10.0, is_positive=True, hint="in silicon, generation has 0.63 eV and diffusion 1.27 eV"
        ),
        "dark_diffusion_fraction": _FRACTION,
        "full_well_e": Limits(low=0.0, high=1e15, is_positive=True, hint=_ELECTRONS),
        "read_noise_e": _NOISE_E,
        "rts_e": _NOISE_E,
        "capacitance_f": Limits(
            low=1e-18, high=1e-6, is_positive=True, hint="capacitances are in farad: 1 fF is 1e-15"
        ),
        "pedestal_v": Limits(high=1e3, hint=_VOLTS),
        "v_sat_v": Limits(low=1e-6, high=1e3, is_positive=True, hint=_VOLTS),
        # ADC
        "log_strength": Limits(high=1e9, is_positive=True),
        "dnl_dn": Limits(high=2.0**16, hint="deviations are in codes"),
        "inl_dn": Limits(low=-(2.0**16), high=2.0**16, hint="deviations are in codes"),
        # Exposures, ramps and calibrations
        "exposure_s": _TIME_S,
        "exposures_s": _DURATION_S,
        "long_exposure_s": _DURATION_S,
        "times_s": _TIME_S,
        "photo_e_per_s": _RATE_E,
        "weight_rate_e_per_s": Limits(low=-1e15, high=1e15, hint=_RATES),
        "flat_e": Limits(high=1e15, is_positive=True, hint=_ELECTRONS),
        "charge_e": _CHARGE_E,
        "hot_sigmas": Limits(high=1e6, is_positive=True, hint="a number of standard deviations"),
        "noisy_ratio": Limits(high=1e6, is_positive=True, hint="a ratio of standard deviations"),
        # Event and spiking photosites
        "contrast_on": _CONTRAST,
        "contrast_off": _CONTRAST,
        "mismatch_fraction": _SPREAD,
        "refractory_s": _TIME_S,
        "frame_s": _DURATION_S,
        "line_s": _TIME_S,
        "EventPixels.capacitance_f": Limits(low=1e-18, high=1e-9, hint="capacitances are in farad: 1 fF is 1e-15"),
        "leak_per_s": _EVENTS,
        "leak_spread_fraction": _WIDE_SPREAD,
        "noise_per_s": _EVENTS,
        "noise_half_e_per_s": Limits(high=1e15, is_positive=True, hint=_RATES),
        "floor_e_per_s": _RATE_E,
        "threshold_e": Limits(low=1.0, high=1e15, is_positive=True, hint=_ELECTRONS),
    }
)


def check_plausible(name: str, value: object, *, class_name: str = "") -> float:
    """
    Return the value as a float after checking its plausible range.

    Parameters
    ----------
    name : str
        Keyword, a key of :data:`LIMITS`.
    value : object
    class_name : str
        Class of the keyword, for keywords that are prefixed with their class in the table.

    Raises
    ------
    ParameterError
        If the value is not one finite number, or outside the range; the message states range and unit.
    """
    limits = LIMITS[f"{class_name}.{name}" if class_name else name]
    number = check_number(name, value, above=0.0 if limits.is_positive else None, at_least=0.0, hint=limits.hint)
    _check_range(name, np.asarray(number), limits)
    return number


def check_plausible_array(name: str, value: ArrayLike, *, ndim: int | None = None) -> NDArray[np.float64]:
    """
    Return the values as a float64 array after checking their plausible range.

    Parameters
    ----------
    name : str
        Keyword, a key of :data:`LIMITS`.
    value : array_like
    ndim : int, optional
        Required number of dimensions; any by default.

    Raises
    ------
    ParameterError
        If a value is not finite, or outside the range; the message states the index of the first such value.
    """
    limits = LIMITS[name]
    at_least = 0.0 if limits.low >= 0.0 else None
    array = finite_array(name, value, ndim=ndim, at_least=at_least, above=0.0 if limits.is_positive else None)
    _check_range(name, array, limits)
    return array


def _check_range(name: str, values: NDArray[np.float64], limits: Limits) -> None:
    is_outside = (values > limits.high) | (values < limits.low)
    if not limits.is_positive:
        is_outside &= values != 0.0
    if not np.any(is_outside):
        return
    position = tuple(int(i) for i in np.argwhere(is_outside)[0])
    index = f" at [{', '.join(map(str, position))}]" if position else ""
    everywhere = " everywhere" if values.ndim else ""
    raise ParameterError(
        name, limits.rule + everywhere, float(values[position]), (unit_of(name) + index).strip(), limits.hint
    )
