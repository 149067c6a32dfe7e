"""Lookup of metrics of sweeps and studies by name or function."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from foveasim._core.names import DEVICES, possible_names
from foveasim.errors import ParameterError
from foveasim.metrics.registry import METRICS, Metric, metric_info, options_of

#: Variables and dimensions of results that are not metrics.
RESERVED = ("seed", "error", "warning", "point", "repeat")
#: Hint for functions that are not registered.
OTHER_METRICS = "pass other functions in Python, or with --metric module:function"
#: Default metrics of a sweep.
DEFAULT_METRICS = ("mean_code_dn", "saturated_fraction", "snr", "n_sites")


def import_metric(name: str) -> Metric:
    """
    Import the function that ``"module:function"`` names, for the command line.

    The import runs the code of the module. The current directory is searched too.

    Raises
    ------
    ParameterError
        When the module cannot be imported or has no such function.
    """
    module, _, function = name.partition(":")
    directory = str(Path.cwd())
    if directory not in sys.path:
        sys.path.insert(0, directory)
    try:
        found = getattr(importlib.import_module(module), function)
    except Exception as error:  # noqa: BLE001 -- a module may raise anything while it is imported
        raise ParameterError("metric", f"must be module:function of an importable module ({error})", name) from None
    if not callable(found):
        raise ParameterError("metric", "must name a function", name)
    metric: Metric = found
    return metric


def resolve_metrics(metrics: Iterable[str | Metric] | Mapping[str, Metric] | None) -> dict[str, Metric]:
    """Return metrics by the names of their results."""
    if metrics is None:
        metrics = DEFAULT_METRICS
    if isinstance(metrics, str) or callable(metrics):
        metrics = (metrics,)
    if isinstance(metrics, Mapping):
        pairs = list(metrics.items())
    else:
        pairs = [
            (metric, METRICS.get(metric)) if isinstance(metric, str) else (getattr(metric, "__name__", ""), metric)
            for metric in metrics
        ]
    found: dict[str, Metric] = {}
    for name, metric in pairs:
        if metric is None:
            raise ParameterError(
                "metrics",
                "must be names of metrics",
                name,
                hint=f"{possible_names(name, sorted(METRICS))}; {OTHER_METRICS}",
            )
        if not callable(metric):
            raise ParameterError("metrics", "must be names of metrics or functions", metric)
        if not isinstance(name, str) or not name.isidentifier():
            raise ParameterError("metrics", "must have names that are identifiers (use a mapping of names)", name)
        if name in METRICS and metric is METRICS[name] and "frequency_per_mm" in options_of(metric):
            raise ParameterError("metrics", "must not need a frequency; specify it under 'results'", name)
        if name in RESERVED:
            raise ParameterError("metrics", f"must not have the reserved name '{name}'")
        if name in found:
            raise ParameterError("metrics", "must have unique names", name)
        if name.casefold() in map(str.casefold, found) or DEVICES.fullmatch(name):
            # Results are stored in directories of these names, which some file systems do not distinguish.
            raise ParameterError(
                "metrics", "must have names of files, which differ by more than the case of letters", name
            )
        found[name] = metric
    if not found:
        raise ParameterError("metrics", "must contain at least one metric")
    return found


def add_metrics(metrics: Mapping[str, Metric], names: Iterable[str]) -> dict[str, Metric]:
    """
    Return the metrics of a file and those of the command line.

    ``metrics``: metrics of the file. ``names``: names in :data:`METRICS`, or ``module:function``. The import of a module runs
    its code. Raises ParameterError when a metric does not exist, or its name is already used.
    """
    found = dict(metrics)
    for name in names:
        for result, metric in resolve_metrics([import_metric(name) if ":" in name else name]).items():
            if result in found:
                raise ParameterError("metric", "must have a unique name; another metric has this name", result)
            found[result] = metric
    return found


def has_result(metric: str, result: str) -> bool:
    """Return whether a result name is that of a metric, or of an item of its mapping."""
    return result == metric or result.startswith(metric + "_")


def reference_of(metric: Metric) -> Callable[..., Any] | None:
    """Return the function that computes the reference of a registered metric, if it has one."""
    name = next((name for name, registered in METRICS.items() if registered is metric), None)
    return None if name is None else metric_info(name).reference
