"""Plans of studies: search ranges, objectives, constraints, and settings of a trial."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from foveasim._core.validation import check_count
from foveasim._io.yaml_files import read_yaml
from foveasim.config import check_settings, put_setting, resolve_files, validate
from foveasim.errors import ConfigError, ParameterError
from foveasim.explore._metrics import METRICS, Metric, gives, named_metrics, with_more_metrics
from foveasim.explore.sweeps.plan import MAX_POINTS, Plan, check_disjoint, plan_sweep, shot_of, with_file_context

if TYPE_CHECKING:
    import optuna

__all__ = ["Limits", "Search", "StudyPlan", "StudySection", "plan_study", "read_study"]

#: Search range of a setting: (low, high), a mapping with step or spacing, or a list of choices.
Search = tuple[float, float] | Mapping[str, Any] | Sequence[Any]
#: Lowest and highest value of results by name; either may be None.
Limits = Mapping[str, tuple[float | None, float | None]]
#: Value of a setting or result, in its unit; and limits in a file.
_Number = int | float
_Limit = tuple[float | None, float | None]
#: Keys of a range mapping.
RANGE_KEYS = {"from", "to", "step", "spacing"}
#: Items of a sweep plan that do not apply to studies.
NOT_OF_STUDIES = {"vary", "mode", "repeats"}


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
    folder : Path
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
    folder: Path
    files: Mapping[str, str]

    def settings_of(self, trial: optuna.Trial) -> dict[str, Any]:
        """Return all settings of a trial; the seed, and so the noise, is equal in all trials."""
        settings = json.loads(json.dumps(dict(self.base.settings))) | {"seed": self.base.seed}
        for path, where in self.search.items():
            value = resolve_files(self.folder, _suggested(trial, path, where), path)
            put_setting(self.base.source, settings, path, value)
        return dict(settings)

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the trials as plain data; resuming requires equality."""
        base = {key: value for key, value in self.base.to_dict().items() if key not in NOT_OF_STUDIES}
        return base | {
            "files": dict(self.files),
            "search": {path: _plain(where) for path, where in self.search.items()},
            "objectives": dict(self.objectives),
            "constraints": {key: list(limits) for key, limits in self.constraints.items()},
            "batch": self.batch,
        }


class _SearchRange(BaseModel):
    """Search range; integers where the setting accepts only integers."""

    model_config = ConfigDict(extra="forbid", strict=True)
    low: _Number = Field(alias="from")
    high: _Number = Field(alias="to")
    step: _Number | None = Field(None, description="step of the values; continuous by default")
    spacing: Literal["linear", "geometric"] | None = Field(None, description="linear by default; excludes step")


class StudySection(BaseModel):
    """Settings of a study: shot, search ranges, objectives, constraints and trials."""

    model_config = ConfigDict(extra="forbid", strict=True)
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
    """
    path = Path(path)
    section: StudySection = validate(path, StudySection, read_yaml(path))
    source, shot = shot_of(path, section.shot)
    with with_file_context(path):
        # Names in the file are looked up in METRICS, and never imported.
        named = _wanted([*section.objectives, *section.constraints], section.metrics)
    wanted = with_more_metrics(named, metrics)
    if n_trials is not None:
        n_trials = check_count("trials", n_trials, at_most=MAX_POINTS)
    with with_file_context(path):
        return plan_study(
            shot,
            {
                name: where if isinstance(where, list) else where.model_dump(by_alias=True, exclude_none=True)
                for name, where in section.search.items()
            },
            section.objectives,
            n_trials=section.trials if n_trials is None else n_trials,
            constraints=section.constraints,
            metrics=None if section.metrics is None and not metrics else wanted,
            changes={name: resolve_files(path.parent, value, name) for name, value in section.set.items()},
            seed=section.seed,
            batch=section.batch,
            name=section.name,
            source=source,
            folder=path.parent,
        )


def plan_study(
    shot: str | Path | Mapping[str, Any],
    search: Mapping[str, Search],
    objectives: Mapping[str, Literal["maximize", "minimize"]],
    *,
    n_trials: int,
    constraints: Limits | None = None,
    metrics: Sequence[str | Metric] | Mapping[str, Metric] | None = None,
    changes: Mapping[str, Any] | None = None,
    seed: int = 0,
    batch: int = 1,
    name: str = "study",
    source: str | Path = "settings",
    folder: str | Path = ".",
) -> StudyPlan:
    """
    Create the plan of a study, with all checks that do not require building a camera.

    Parameters
    ----------
    shot, changes, source
        As for :func:`plan_sweep`.
    search, objectives, n_trials, constraints, metrics, seed, batch, name
        As for :func:`study`.
    folder : path
        Directory for relative file paths in choices.

    Returns
    -------
    StudyPlan

    Raises
    ------
    ParameterError, ConfigError
        When a path, a range or a name is invalid.
    """
    n_trials = check_count("n_trials", n_trials, at_most=MAX_POINTS)
    batch = check_count("batch", batch, at_most=MAX_POINTS)
    if n_trials % batch:
        raise ParameterError("n_trials", f"must be a multiple of the batch size {batch}", n_trials)
    if not isinstance(name, str) or not name:
        raise ParameterError("name", "must be a non-empty string", name)
    constraints = dict(constraints or {})
    _check_names(objectives, constraints)
    wanted = _wanted([*objectives, *constraints], metrics)
    for place, names in (("objectives", objectives), ("constraints", constraints)):
        _check_given(place, names, METRICS if metrics is None else wanted)
    if not isinstance(search, Mapping) or not search:
        raise ParameterError("search", "must be a non-empty mapping of setting paths to ranges", search)
    if "seed" in search:
        raise ParameterError("seed", "must not be searched: the noise is equal in all trials")
    plans = [
        plan_sweep(
            shot,
            {path: _ends(path, where)},
            mode="zip",
            metrics=wanted,
            changes=changes,
            seed=seed,
            source=source,
            folder=folder,
        )
        for path, where in search.items()
    ]
    check_disjoint(plans[0].source, search, "be searched")
    return StudyPlan(
        base=plans[0],
        search={path: _as_taken(plan, path, search[path]) for path, plan in zip(search, plans, strict=True)},
        objectives=dict(objectives),
        constraints=constraints,
        n_trials=n_trials,
        batch=batch,
        name=name,
        folder=Path(folder).absolute(),
        files={file: digest for plan in plans for file, digest in plan.files.items()},
    )


def _wanted(names: Sequence[str], metrics: Any) -> dict[str, Metric]:
    """Return the given metrics, or by default those with the named results."""
    if metrics is not None:
        return named_metrics(metrics)
    return {own: METRICS[own] for own in METRICS if any(gives(own, name) for name in names)}


def _check_given(place: str, names: Iterable[str], metrics: Iterable[str]) -> None:
    for name in names:
        if not any(gives(own, name) for own in metrics):
            raise ParameterError(
                place,
                f"must be results of metrics ({', '.join(metrics)}), or of those in 'metrics'",
                name,
                hint="pass other functions in Python, or with --metric module:function",
            )


def _check_names(objectives: Mapping[str, str], constraints: Limits) -> None:
    if not isinstance(objectives, Mapping) or not objectives:
        raise ParameterError("objectives", 'must map names of results to "maximize" or "minimize"', objectives)
    for name, way in objectives.items():
        if way not in ("maximize", "minimize"):
            raise ParameterError(str(name), 'must be "maximize" or "minimize"', way)
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


def _ends(path: str, where: Search) -> list[Any]:
    """Return the bounds of a range, or all choices."""
    if isinstance(where, Mapping):
        if set(where) - RANGE_KEYS or not {"from", "to"} <= set(where) or {"step", "spacing"} <= set(where):
            raise ParameterError(path, "must have 'from' and 'to', and optionally 'step' or 'spacing'", dict(where))
        if where.get("spacing", "linear") not in ("linear", "geometric"):
            raise ParameterError(path, "must have a linear or geometric spacing", where["spacing"])
        ends = [where["from"], where["to"]]
    elif isinstance(where, tuple):
        ends = list(where)
    elif isinstance(where, list) and where:
        return where
    else:
        raise ParameterError(path, "must be searched in (low, high), a range mapping, or a list of choices", where)
    if len(ends) != 2 or not all(map(_is_number, ends)) or not ends[0] < ends[1]:
        raise ParameterError(path, "must have two finite bounds in ascending order", where)
    if isinstance(where, Mapping):
        if where.get("spacing") == "geometric" and ends[0] <= 0:
            raise ParameterError(path, "must be > 0 for geometric spacing", where["from"])
        if "step" in where and not (_is_number(where["step"]) and 0 < where["step"] <= ends[1] - ends[0]):
            raise ParameterError(path, "must have a step > 0 that is at most the width of the range", where["step"])
    return ends


def _as_taken(plan: Plan, path: str, where: Search) -> Search:
    """Return a range with integer bounds for integer settings, and float bounds for others."""
    low, *others = _ends(path, where)
    if isinstance(where, list) or not all(isinstance(end, int) for end in (low, *others)):
        return where
    settings = json.loads(json.dumps(dict(plan.settings)))
    put_setting(plan.source, settings, path, low + 0.5)
    try:
        check_settings(plan.source, settings)
    except ConfigError:
        return where
    if isinstance(where, Mapping):
        return {key: float(value) if key in {"from", "to"} else value for key, value in where.items()}
    return float(low), float(others[0])


def _is_number(value: Any) -> bool:
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) < 2**63  # the range of integers that Optuna can store
    return isinstance(value, float) and math.isfinite(value)


def _suggested(trial: optuna.Trial, path: str, where: Search) -> Any:
    """Sample the value of a setting for a trial."""
    if isinstance(where, list):
        texts = [json.dumps(choice) for choice in where]
        return json.loads(trial.suggest_categorical(path, texts))
    low, high = _ends(path, where)
    step = where.get("step") if isinstance(where, Mapping) else None
    is_log = isinstance(where, Mapping) and where.get("spacing") == "geometric"
    is_whole = all(isinstance(number, int) for number in (low, high, step or 1))
    if step is not None:
        # Optuna requires a range that is a multiple of the step, in decimal arithmetic.
        first, each = Decimal(str(low)), Decimal(str(step))
        last = first + (Decimal(str(high)) - first) // each * each
        high = int(last) if is_whole else float(last)
    if is_whole:
        return trial.suggest_int(path, low, high, step=step or 1, log=is_log)
    return trial.suggest_float(path, low, high, step=step, log=is_log)


def _plain(where: Search) -> Any:
    return dict(where) if isinstance(where, Mapping) else list(where)
