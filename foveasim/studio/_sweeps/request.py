"""Sweeps that a page requests: the values of their settings, and their results."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from foveasim._core.short_repr import short_repr
from foveasim.config import RegionResult, validate
from foveasim.errors import ParameterError
from foveasim.explore.sweeps.plan import SEED, ValueRange
from foveasim.metrics import metric_info
from foveasim.studio._messages.models import SweptSetting
from foveasim.studio._settings.values import number_control

#: Largest number of points: a page shows the results of each, and a table of all.
MAX_POINTS = 1000
#: Significant digits of values between the ends.
DIGITS = 6


@dataclass(frozen=True, eq=False)
class Axis:
    """A setting with its values."""

    control: Mapping[str, Any]
    values: Sequence[Any]
    is_log: bool

    __repr__ = short_repr

    @property
    def key(self) -> str:
        """Path of the setting."""
        return str(self.control["key"])

    def about(self) -> dict[str, Any]:
        """Return the axis as plain data."""
        return {
            "key": self.key,
            "label": self.control["label"],
            "unit": self.control["unit"],
            "values": list(self.values),
            "is_log": self.is_log,
        }


def axes_of(settings: Sequence[SweptSetting], controls: Sequence[Mapping[str, Any]]) -> list[Axis]:
    """
    Return the settings of a sweep with their values.

    Raises ParameterError or ConfigError when a setting is not a number, its range is invalid, or there are too many points.
    """
    keys = [each.key for each in settings]
    if len(set(keys)) < len(keys):
        raise ParameterError("settings", "must differ", keys[0])
    if SEED in keys:
        raise ParameterError("settings", "must not contain the seed: all points of a sweep have the same one")
    found = [(number_control(controls, each.key), _range_of(each.model_extra or {})) for each in settings]
    n_points = math.prod(value_range.n for _, value_range in found)
    if n_points > MAX_POINTS:
        raise ParameterError("n", f"must give at most {MAX_POINTS:,} points, got {n_points:,}; use fewer values")
    return [Axis(control, _values(control, each), each.spacing == "geometric") for control, each in found]


def results_of(given: Sequence[Mapping[str, Any]]) -> list[RegionResult]:
    """Return the results of a sweep; raise an error when one is invalid."""
    found = [validate(None, RegionResult, each) for each in given]
    if found.count(found[0]) > 1:
        raise ParameterError("results", "must differ", found[0].subject)
    return found


def about_result(result: RegionResult) -> dict[str, Any]:
    """Return a result as plain data."""
    return {
        "measure": result.measure,
        "label": metric_info(result.measure).title,
        "subject": result.subject,
        "unit": result.unit,
    }


def _range_of(data: Mapping[str, Any]) -> ValueRange:
    found: ValueRange = validate(None, ValueRange, data)
    if not found.low < found.high:
        raise ParameterError("to", "must be above the first value", found.high)
    if found.n < 2:
        raise ParameterError("n", "must be at least 2", found.n)
    return found


def _values(control: Mapping[str, Any], value_range: ValueRange) -> list[Any]:
    """Return the values of a range: distinct integers, or numbers with few digits."""
    values = value_range.values()
    if control["kind"] == "integer":
        return sorted({round(value) for value in values})
    inner = [float(f"{value:.{DIGITS}g}") for value in values[1:-1]]
    return [value_range.low, *inner, value_range.high]
