"""Plans of studies: search ranges, objectives, constraints, and settings of a trial."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from foveasim._core.calls import OwnCheck
from foveasim._core.names import did_you_mean, possible_names
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import check_count
from foveasim._io.yaml_files import read_yaml
from foveasim.config import Source, put_setting, resolve_files, validate
from foveasim.config._models import Section
from foveasim.errors import ParameterError
from foveasim.explore._metrics import OTHER_METRICS, add_metrics, has_result, resolve_metrics
from foveasim.explore.sweeps.plan import (
    MAX_POINTS,
    Plan,
    check_disjoint,
    copy_settings,
    plan_sweep,
    takes_integers,
    with_file_context,
)
from foveasim.metrics import METRICS, Metric

if TYPE_CHECKING:
    import optuna

__all__ = ["Limits", "Search", "StudyPlan", "StudySection", "plan_study", "read_study", "typed_choice"]

#: Search range of a setting: (low, high), a mapping with step or spacing, or a list of choices.
Search = tuple[float, float] | Mapping[str, Any] | Sequence[Any]
#: Lowest and highest value of results by name; either may be None.
Limits = Mapping[str, tuple[float | None, float | None]]
#: Value of a setting or result, in its unit; and limits in a file.
_Number = int | float
_Limit = tuple[float | None, float | None]
#: Key of the search ranges in a file.
SEARCH = "search"
#: Keys of a range mapping.
RANGE_KEYS = {"from", "to", "step", "spacing"}
#: Items of a sweep plan that do not apply to studies.
SWEEP_ONLY_KEYS = {"vary", "mode", "repeats"}


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyPlan:
    """
    Validated plan of a study.

    Attributes
    ----------
    base : Plan
        Settings, seed, metrics and files, as in the plan of a sweep.
    search : mapping of str to range
        Search ranges by setting path.
    objectives : mapping of str to {"maximize", "minimize"}
        Directions by name of the result.
    constraints : mapping of str to (low, high)
        Limits by name of the result; either limit may be None.
    n_trials : int
        Total number of trials, including those of earlier runs.
    batch : int
        Number of trials that are sampled together.
    name : str
        Name of the study in its storage.
    directory : Path
        Directory for relative file paths in choices.
    files : mapping of str to str
        SHA-256 of the files that settings and choices reference.
    """

    base: Plan
    search: Mapping[str, Search]
    objectives: Mapping[str, Literal["maximize", "minimize"]]
    constraints: Limits
    n_trials: int
    batch: int
    name: str
    directory: Path
    files: Mapping[str, str]

    __repr__ = short_repr

    @property
    def source(self) -> Source:
        """Origin of the settings of all trials."""
        return self.base.source.with_replaced({path: self.base.written.at(path) for path in self.search})

    def settings_of(self, trial: optuna.Trial) -> dict[str, Any]:
        """Return all settings of a trial; the seed, and so the noise, is equal in all trials."""
        settings: dict[str, Any] = copy_settings(self.base.settings) | {"seed": self.base.seed}
        for path, search_range in self.search.items():
            value = resolve_files(self.directory, _suggest(trial, path, search_range), path)
            put_setting(self.base.source, settings, path, value)
        return settings

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the trials as plain data; resuming requires equality."""
        base = {key: value for key, value in self.base.to_dict().items() if key not in SWEEP_ONLY_KEYS}
        return base | {
            "files": dict(self.files),
            "search": {path: _to_plain_data(search_range) for path, search_range in self.search.items()},
            "objectives": dict(self.objectives),
            "constraints": {key: list(limits) for key, limits in self.constraints.items()},
            "batch": self.batch,
        }


class _SearchRange(Section):
    """Search range; integers where the setting accepts only integers."""

    low: _Number = Field(alias="from")
    high: _Number = Field(alias="to")
    step: _Number | None = Field(None, description="step of the values; continuous by default")
    spacing: Literal["linear", "geometric"] | None = Field(None, description="linear by default; excludes step")


class StudySection(Section):
    """Settings of a study: shot, search ranges, objectives, constraints and trials."""

    shot: str | dict[str, Any] = Field(description="settings file, relative to this file, or the settings")
    set: dict[str, Any] = Field({}, description="settings that are replaced in all trials, by path")
    search: dict[str, _SearchRange | list[Any]] = Field(description="ranges or lists of choices, by setting path")
    objectives: dict[str, Literal["maximize", "minimize"]] = Field(description="directions by name of the result")
    constraints: dict[str, _Limit] = Field({}, description="[low, high] by name of the result; either may be null")
    trials: int = Field(ge=1, le=MAX_POINTS, description="total number of trials")
    batch: int = Field(
        1, ge=1, le=MAX_POINTS, description="trials that are sampled together; trials must be a multiple of it"
    )
    seed: int = 0
    metrics: list[str] | None = Field(None, description="by default those of the objectives and constraints")
    name: str = Field("study", min_length=1, description="name of the study in its storage")


def read_study(path: str | Path, *, metrics: Sequence[str] = (), n_trials: int | None = None) -> StudyPlan:
    """
    Read the YAML file of a study.

    Parameters
    ----------
    path : path
        File with the keys ``shot`` (a settings file, or the settings), ``search`` (setting paths to
        ``{from: 2, to: 16, step: 2}``, to ``{from: 0.5, to: 4, spacing: geometric}``, or to a list of choices; integer settings
        are searched among integers), ``objectives`` (names of results to ``maximize`` or ``minimize``), ``trials``, ``batch``,
        ``constraints`` (names of results to ``[low, high]``, either may be ``null``), ``seed``, ``metrics``, ``name``, and
        ``set`` (settings that are replaced in all trials). Metrics in the file must be names in :data:`METRICS`, so that
        reading a file never imports code.
    metrics : sequence of str
        Further metrics: names, or ``module:function``, which is imported.
    n_trials : int, optional
        Number of trials instead of that of the file.

    Returns
    -------
    StudyPlan

    Raises
    ------
    ConfigError
        When a setting is invalid; with the file, the key, the expected and the actual value.
    ParameterError
        When a metric does not exist.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = fs.config.write_starting_file("study", Path(directory, "study.yaml"))
    ...     plan = fs.explore.read_study(path)
    >>> dict(plan.objectives), plan.n_trials
    ({'psnr_db': 'maximize', 'n_sites': 'minimize'}, 40)
    """
    path = Path(path)
    section: StudySection = validate(path, StudySection, read_yaml(path))
    with with_file_context(path):
        # Names in the file are looked up in METRICS, and never imported.
        file_metrics = _select_metrics([*section.objectives, *section.constraints], section.metrics)
    selected = add_metrics(file_metrics, metrics)
    if n_trials is not None:
        n_trials = check_count("trials", n_trials, at_most=MAX_POINTS)
    with with_file_context(path):
        return plan_study(
            path.parent / section.shot if isinstance(section.shot, str) else section.shot,
            {
                name: search_range
                if isinstance(search_range, list)
                else search_range.model_dump(by_alias=True, exclude_none=True)
                for name, search_range in section.search.items()
            },
            section.objectives,
            n_trials=section.trials if n_trials is None else n_trials,
            constraints=section.constraints,
            metrics=None if section.metrics is None and not metrics else selected,
            changes=section.set,
            seed=section.seed,
            batch=section.batch,
            name=section.name,
            source=path,
        )


def plan_study(
    shot: str | Path | Mapping[str, Any],
    search: Mapping[str, Search],
    objectives: OwnCheck[Mapping[str, Literal["maximize", "minimize"]]],
    *,
    n_trials: int,
    constraints: Limits | None = None,
    metrics: Sequence[str | Metric] | Mapping[str, Metric] | None = None,
    changes: Mapping[str, Any] | None = None,
    seed: int = 0,
    batch: int = 1,
    name: str = "study",
    source: Source | str | Path | None = None,
) -> StudyPlan:
    """
    Create the plan of a study, with all checks that do not require building a camera.

    Parameters
    ----------
    shot, changes, source
        As for :func:`plan_sweep`, with relative paths in choices.
    search, objectives, n_trials, constraints, metrics, seed, batch, name
        As for :func:`study`.

    Returns
    -------
    StudyPlan

    Raises
    ------
    ParameterError, ConfigError
        When a path, a range or a name is invalid.

    Examples
    --------
    >>> import foveasim as fs
    >>> shot = fs.config.demo_settings()[0]
    >>> search = {"optics.f_number": (1.4, 8.0), "sensor.bits": [8, 10, 12]}
    >>> plan = fs.explore.plan_study(shot, search, {"snr_mean": "maximize"}, n_trials=50)
    >>> plan.n_trials, dict(plan.objectives), list(plan.base.metrics)
    (50, {'snr_mean': 'maximize'}, ['snr'])
    """
    n_trials = check_count("n_trials", n_trials, at_most=MAX_POINTS)
    batch = check_count("batch", batch, at_most=MAX_POINTS)
    if n_trials % batch:
        raise ParameterError("n_trials", f"must be a multiple of the batch size {batch}", n_trials)
    if not isinstance(name, str) or not name:
        raise ParameterError("name", "must be a non-empty string", name)
    constraints = dict(constraints or {})
    _check_names(objectives, constraints)
    selected = _select_metrics([*objectives, *constraints], metrics)
    for parameter, names in (("objectives", objectives), ("constraints", constraints)):
        _check_results(parameter, names, METRICS if metrics is None else selected)
    if not isinstance(search, Mapping) or not search:
        raise ParameterError("search", "must be a non-empty mapping of setting paths to ranges", search)
    if "seed" in search:
        raise ParameterError("seed", "must not be searched: the noise is equal in all trials")
    plans = [
        plan_sweep(
            shot,
            {path: _bounds(path, search_range)},
            mode="zip",
            metrics=selected,
            changes=changes,
            seed=seed,
            source=source,
            written_as=SEARCH,
        )
        for path, search_range in search.items()
    ]
    check_disjoint(plans[0].written, search, "be searched")
    return StudyPlan(
        base=plans[0],
        search={path: _typed_range(plan, path, search[path]) for path, plan in zip(search, plans, strict=True)},
        objectives=dict(objectives),
        constraints=constraints,
        n_trials=n_trials,
        batch=batch,
        name=name,
        directory=Source.of(source).directory.absolute(),
        files={file: digest for plan in plans for file, digest in plan.files.items()},
    )


def _select_metrics(names: Sequence[str], metrics: Any) -> dict[str, Metric]:
    """Return the given metrics, or by default those with the named results."""
    if metrics is not None:
        return resolve_metrics(metrics)
    return {own: METRICS[own] for own in METRICS if any(has_result(own, name) for name in names)}


def _check_results(parameter: str, names: Iterable[str], metrics: Iterable[str]) -> None:
    for name in names:
        if not any(has_result(own, name) for own in metrics):
            raise ParameterError(
                parameter,
                "must be results of metrics, or of those in 'metrics'",
                name,
                hint=f"{possible_names(name, list(metrics))}; {OTHER_METRICS}",
            )


def _check_names(objectives: Mapping[str, str], constraints: Limits) -> None:
    if not isinstance(objectives, Mapping) or not objectives:
        raise ParameterError("objectives", 'must map names of results to "maximize" or "minimize"', objectives)
    for name, direction in objectives.items():
        if direction not in ("maximize", "minimize"):
            hint = did_you_mean(direction, ("maximize", "minimize"))
            raise ParameterError(str(name), 'must be "maximize" or "minimize"', direction, hint=hint)
    for name, limits in constraints.items():
        is_pair = isinstance(limits, tuple | list) and len(limits) == 2
        if (
            not is_pair
            or all(limit is None for limit in limits)
            or not all(limit is None or _is_number(limit) for limit in limits)
        ):
            raise ParameterError(str(name), "must have limits (low, high), of which one may be None", limits)
        low, high = limits
        if low is not None and high is not None and low > high:
            raise ParameterError(str(name), "must have limits (low, high) with low <= high", limits)


def _bounds(path: str, search_range: Search) -> list[Any]:
    """Return the bounds of a range, or all choices."""
    if isinstance(search_range, Mapping):
        if (
            set(search_range) - RANGE_KEYS
            or not {"from", "to"} <= set(search_range)
            or {"step", "spacing"} <= set(search_range)
        ):
            raise ParameterError(
                path,
                "must have 'from' and 'to', and optionally 'step' or 'spacing'",
                dict(search_range),
                hint=next((did_you_mean(key, RANGE_KEYS) for key in search_range if key not in RANGE_KEYS), ""),
            )
        if search_range.get("spacing", "linear") not in ("linear", "geometric"):
            raise ParameterError(path, "must have a linear or geometric spacing", search_range["spacing"])
        bounds = [search_range["from"], search_range["to"]]
    elif isinstance(search_range, tuple):
        bounds = list(search_range)
    elif isinstance(search_range, list) and search_range:
        return search_range
    else:
        raise ParameterError(
            path, "must be searched in (low, high), a range mapping, or a list of choices", search_range
        )
    if len(bounds) != 2 or not all(map(_is_number, bounds)) or not bounds[0] < bounds[1]:
        raise ParameterError(path, "must have two finite bounds in ascending order", search_range)
    if isinstance(search_range, Mapping):
        if search_range.get("spacing") == "geometric" and bounds[0] <= 0:
            raise ParameterError(path, "must be > 0 for geometric spacing", search_range["from"])
        if "step" in search_range and not (
            _is_number(search_range["step"]) and 0 < search_range["step"] <= bounds[1] - bounds[0]
        ):
            raise ParameterError(
                path, "must have a step > 0 that is at most the width of the range", search_range["step"]
            )
    return bounds


def _typed_range(plan: Plan, path: str, search_range: Search) -> Search:
    """Return a range with integer bounds for integer settings, and float bounds for others."""
    low, *others = _bounds(path, search_range)
    if isinstance(search_range, list) or not all(isinstance(bound, int) for bound in (low, *others)):
        return search_range
    if takes_integers(plan.source, plan.settings, path, low + 0.5):
        return search_range
    if isinstance(search_range, Mapping):
        return {key: float(value) if key in {"from", "to"} else value for key, value in search_range.items()}
    return float(low), float(others[0])


def _is_number(value: Any) -> bool:
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) < 2**63  # the range of integers that Optuna can store
    return isinstance(value, float) and math.isfinite(value)


def _suggest(trial: optuna.Trial, path: str, search_range: Search) -> Any:
    """Sample the value of a setting for a trial."""
    if isinstance(search_range, list):
        is_native = _is_stored_natively(search_range)
        choices = search_range if is_native else [json.dumps(choice) for choice in search_range]
        return typed_choice(trial.suggest_categorical(path, choices), search_range)
    low, high = _bounds(path, search_range)
    step = search_range.get("step") if isinstance(search_range, Mapping) else None
    is_log = isinstance(search_range, Mapping) and search_range.get("spacing") == "geometric"
    is_integer = all(isinstance(number, int) for number in (low, high, step or 1))
    if step is not None:
        # Optuna requires a range that is a multiple of the step, in decimal arithmetic.
        first, each = Decimal(str(low)), Decimal(str(step))
        last = first + (Decimal(str(high)) - first) // each * each
        high = int(last) if is_integer else float(last)
    if is_integer:
        return trial.suggest_int(path, low, high, step=step or 1, log=is_log)
    return trial.suggest_float(path, low, high, step=step, log=is_log)


def _is_stored_natively(choices: Sequence[Any]) -> bool:
    """Return whether Optuna stores choices as they are: unique numbers, strings, None."""
    return (
        all(isinstance(choice, bool | int | float | str | None) for choice in choices)
        and all(math.isfinite(choice) for choice in choices if isinstance(choice, float))
        and len(set(choices)) == len(choices)  # 1, 1.0 and true are equal
    )


def typed_choice(stored: Any, choices: Sequence[Any]) -> Any:
    """Return the value of a choice from its value in Optuna, which may be JSON."""
    return stored if _is_stored_natively(choices) else json.loads(stored)


def _to_plain_data(search_range: Search) -> Any:
    return dict(search_range) if isinstance(search_range, Mapping) else list(search_range)
