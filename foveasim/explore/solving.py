"""Goal seek: the value of a setting at which a result of a shot meets a requirement."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from foveasim._core.short_repr import short_repr
from foveasim.config import Requirement, Source, get_setting, put_setting, read_settings
from foveasim.errors import FoveasimError, ParameterError, SimulationError
from foveasim.explore.requirements import result_of
from foveasim.explore.sweeps.plan import copy_settings, takes_integers
from foveasim.explore.worker_cache import ShotRunner
from foveasim.metrics.registry import metric_info

__all__ = ["Solution", "search_value", "solve"]

#: Number of values over the range, and of refinements between two of them.
N_VALUES, N_REFINEMENTS = 9, 24
#: Relative width of the last interval, and of a result that equals its target.
WIDTH, CLOSE = 1e-4, 1e-3
#: Ratio of the ends of a range from which values are spaced geometrically.
GEOMETRIC_RATIO = 50.0


@dataclass(frozen=True, eq=False)
class Solution:
    """
    A value of a setting at which a requirement is met.

    Attributes
    ----------
    setting : str
        Path of the setting.
    value : float
        The solution, in the unit of the setting.
    result : float
        Result at the solution, in its unit.
    curve : sequence of (float, float)
        Values of the setting, ascending, and results; NaN where a simulation failed.
    """

    setting: str
    value: float
    result: float
    curve: Sequence[tuple[float, float]]

    __repr__ = short_repr


def solve(
    shot: str | Path | Mapping[str, Any],
    setting: str,
    requirement: Requirement,
    *,
    bounds: tuple[float, float],
) -> Solution:
    """
    Return the value of a setting at which a requirement is met.

    Of several values, that is the one nearest to the present value.

    Parameters
    ----------
    shot : path or mapping
        Settings file of a shot, or its settings.
    setting : str
        Path of a number, such as ``"exposure_s"`` or ``"layout.parameters.n_sectors"``. Without a present number, the
        solution is the nearest to the middle of the range.
    requirement : Requirement
        Equal limits demand a result that equals them within 0.1 %; where results have steps, the nearest one is accepted.
    bounds : (low, high)
        Range of the setting.

    Raises
    ------
    ParameterError
        When the setting is not a number, or the bounds are not ascending.
    SimulationError
        When the requirement is met nowhere in the range; with the range of results.

    Examples
    --------
    The exposure at which the signal-to-noise ratio is 20:

    >>> import foveasim as fs
    >>> settings = {
    ...     "scene": {
    ...         "kind": "flat",
    ...         "shape": [60, 60],
    ...         "pitch_um": 300.0,
    ...         "distance_m": 1.0,
    ...         "illuminance_lux": 500.0,
    ...     },
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {
    ...         "generator": "grid",
    ...         "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0},
    ...     },
    ...     "sensor": {"preset": "machine_vision"},
    ...     "exposure_s": 0.002,
    ... }
    >>> requirement = fs.config.Requirement(measure="snr", at_least=20.0, at_most=20.0)
    >>> found = fs.explore.solve(settings, "exposure_s", requirement, bounds=(1e-5, 0.1))
    >>> print(f"{found.value:.2g} s")
    0.00072 s
    """
    settings = read_settings(shot) if isinstance(shot, str | Path) else copy_settings(dict(shot))
    source = Source.of(Path(shot) if isinstance(shot, str | Path) else None)
    runner = ShotRunner(source, {})

    def result_at(value: float) -> float:
        changed = copy_settings(settings)
        put_setting(source, changed, setting, value)
        return result_of(requirement, *runner.simulate_capture(changed))

    present = _number_at(settings, setting, bounds)
    is_integer = takes_integers(source, settings, setting)
    return search_value(setting, present, requirement, result_at, bounds=bounds, is_integer=is_integer)


def search_value(
    setting: str,
    start: float,
    requirement: Requirement,
    result_at: Callable[[float], float],
    *,
    bounds: tuple[float, float],
    is_integer: bool = False,
) -> Solution:
    """
    Return the value nearest to the present one at which a requirement is met.

    Values over the range bracket the limits; intervals are then halved.

    ``result_at``: returns the result of a value. ``is_integer``: whether values are integers.
    Raises ParameterError when the bounds are not ascending, and SimulationError when the requirement is met nowhere.
    """
    low, high = bounds
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ParameterError("bounds", "must be ascending and finite", bounds)
    target = _Target(requirement)
    jumps_to_zero = metric_info(requirement.measure).jumps_to_zero
    results: dict[float, float] = {}
    problems: list[str] = []

    def at(value: float) -> float:
        value = min(max(round(value), math.ceil(low)), math.floor(high)) if is_integer else float(f"{value:.6g}")
        if value not in results:
            try:
                result = float(result_at(value))
                # No signal, or saturation: a jump to 0 does not cross a limit, and the largest results are next to it.
                results[value] = math.nan if result == 0.0 and jumps_to_zero else result
            except FoveasimError as error:  # such as a generator without sites: the other values may be valid
                problems.append(str(error))
                results[value] = math.nan
        return value

    start = min(max(start, low), high)
    values = sorted({at(value) for value in [*_spaced(low, high), start]})
    for one, other in pairwise(values):  # results may be finite up to a limit, such as saturation
        if math.isfinite(results[one]) != math.isfinite(results[other]):
            _approach(one, other, results, at)
    values = sorted(results)
    met = [value for value in values if target.is_met(results[value])]
    for one, other in pairwise(values):
        if target.is_between(results[one], results[other]):
            met += _refined(one, other, target, results, at)
    if not met:
        known = [result for result in results.values() if math.isfinite(result)]
        if not known:
            raise SimulationError(f"{setting} from {low:g} to {high:g}: {problems[0] if problems else 'no result'}")
        unit = f" {requirement.unit}" if requirement.unit else ""
        raise SimulationError(
            f"{requirement} cannot be reached with {setting} from {low:g} to {high:g}: results are from {min(known):.4g} to "
            f"{max(known):.4g}{unit}"
        )
    # The nearest result to a limit is that of a step, or next to a jump: at saturation, a ratio falls to 0.
    met = [value for value in met if target.is_met(results[value])] or met
    found = min(met, key=lambda value: (abs(_position(value, low, high) - _position(start, low, high)), value))
    return Solution(setting, found, results[found], sorted(results.items()))


class _Target:
    """Limits of a result; equal limits have a tolerance."""

    def __init__(self, requirement: Requirement) -> None:
        low = -math.inf if requirement.at_least is None else requirement.at_least
        high = math.inf if requirement.at_most is None else requirement.at_most
        self.is_equality = low == high
        self.middle = (
            0.5 * (low + high) if math.isfinite(low) and math.isfinite(high) else low if math.isfinite(low) else high
        )
        slack = CLOSE * abs(self.middle) if self.is_equality else 0.0
        self.low, self.high = low - slack, high + slack

    def is_met(self, result: float) -> bool:
        return self.low <= result <= self.high

    def is_between(self, one: float, other: float) -> bool:
        """Return whether a limit lies between two results, unless both meet the target."""
        if not (math.isfinite(one) and math.isfinite(other)) or (self.is_met(one) and self.is_met(other)):
            return False
        return any(min(one, other) <= limit <= max(one, other) for limit in (self.low, self.high))


def _refined(
    one: float,
    other: float,
    target: _Target,
    results: Mapping[float, float],
    at: Callable[[float], float],
) -> list[float]:
    """
    Return values between two of them, near the limit, that meet the target.

    Where no result equals the target, the nearest one is returned.
    """
    for _ in range(N_REFINEMENTS):
        middle = at(math.sqrt(one * other) if one > 0.0 and other / one > 2.0 else 0.5 * (one + other))
        if middle in (one, other) or not math.isfinite(results[middle]):
            break
        if target.is_equality and target.is_met(results[middle]):
            return [middle]
        if target.is_between(results[one], results[middle]):
            other = middle
        else:
            one = middle
        if abs(other - one) <= WIDTH * max(abs(one), abs(other)):
            break
    found = [value for value in (one, other) if target.is_met(results[value])]
    if not found and target.is_equality:
        found = [min((one, other), key=lambda value: abs(results[value] - target.middle))]
    return found


def _approach(one: float, other: float, results: Mapping[float, float], at: Callable[[float], float]) -> None:
    """Simulate values towards the limit between a finite result and none."""
    for _ in range(N_REFINEMENTS // 2):
        middle = at(0.5 * (one + other))
        if middle in (one, other):
            return
        if math.isfinite(results[middle]) == math.isfinite(results[one]):
            one = middle
        else:
            other = middle


def _spaced(low: float, high: float) -> list[float]:
    if low > 0.0 and high / low >= GEOMETRIC_RATIO:
        return [low * (high / low) ** (k / (N_VALUES - 1)) for k in range(N_VALUES)]
    return [low + (high - low) * k / (N_VALUES - 1) for k in range(N_VALUES)]


def _position(value: float, low: float, high: float) -> float:
    """Return a position in the range, from 0 to 1, as values are spaced."""
    if low > 0.0 and high / low >= GEOMETRIC_RATIO and value > 0.0:
        return math.log(value / low) / math.log(high / low)
    return (value - low) / (high - low)


def _number_at(settings: Mapping[str, Any], setting: str, bounds: tuple[float, float]) -> float:
    """Return the present number of a setting; for none, or a text, the middle of its range."""
    value = get_setting(settings, setting)
    if value is None or (setting == "exposure_s" and isinstance(value, str)):
        return math.sqrt(bounds[0] * bounds[1]) if bounds[0] > 0.0 else 0.5 * (bounds[0] + bounds[1])
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError("setting", "must be the path of a number in the settings", setting)
    return value
