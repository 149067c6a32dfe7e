"""Studies: the settings that make a shot best, searched by Optuna, and kept so that any end leaves them resumable."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from foveasim.arrays import check_count
from foveasim.config import files_from, put_setting
from foveasim.errors import FileError, ParameterError
from foveasim.explore._bench import Bench, Job, Task
from foveasim.explore._metrics import METRICS, Metric
from foveasim.explore._plan import Plan, plan_sweep
from foveasim.explore._records import Record, check_same_plan
from foveasim.parallel import thread_count
from foveasim.streams import derived_seed

if TYPE_CHECKING:
    import optuna

__all__ = ["study"]

#: Where a setting is searched: numbers from one to another, the same with steps or spacing, or a list of choices.
Search = tuple[float, float] | Mapping[str, Any] | Sequence[Any]
#: Lowest and highest value of results, either of them None.
Limits = Mapping[str, tuple[float | None, float | None]]
#: Keys of a range that is a mapping.
RANGE_KEYS = {"from", "to", "step", "spacing"}
#: Attributes of a study and of its trials.
PLAN, ERROR, IS_CUT = "plan", "error", "ended with the program"


def study(
    shot: str | Path | Mapping[str, Any],
    search: Mapping[str, Search],
    objectives: Mapping[str, Literal["maximize", "minimize"]],
    *,
    n_trials: int,
    constraints: Limits | None = None,
    metrics: Sequence[str | Metric] | Mapping[str, Metric] | None = None,
    changes: Mapping[str, Any] | None = None,
    seed: int = 0,
    storage: str | Path | None = None,
    name: str = "study",
    tell: Callable[[int, int], None] | None = None,
) -> optuna.Study:
    """
    Search the settings that make a shot best.

    Parameters
    ----------
    shot, changes
        As for :func:`plan_sweep`.
    search : mapping of str to range
        By the settings' paths: ``(low, high)``, whole numbers where both are; ``{"from": 1, "to": 64, "spacing": "geometric"}``
        or ``{"from": 0, "to": 64, "step": 8}``; or a list of choices.
    objectives : mapping of str to {"maximize", "minimize"}
        By the names that results of metrics have, such as ``"snr_mean"``. Of several, the study finds the Pareto front.
    n_trials : int
        Trials that the study has at its end, those of earlier calls with the same storage included.
    constraints : mapping of str to (low, high), optional
        Limits of results, either of them None. Trials that break them are not among the best.
    metrics : names or functions, or mapping of names to functions, optional
        By default those that give the objectives and constraints.
    seed : int
        Of the search, and of the noise of all captures, which is the same in all: differences are those of settings.
    storage : path or str, optional
        An SQLite file, or any URL that Optuna takes. By default memory.
    name : str
        Of the study in its storage.
    tell : callable, optional
        Called with the numbers of trials that are done and of all.

    Returns
    -------
    optuna.Study
        ``best_trials`` is the Pareto front. Trials that failed have their message in ``user_attrs["error"]``, all others all
        results of the metrics.

    Raises
    ------
    ParameterError, ConfigError
        When a path, a range or a name is none.
    FileError
        When the storage cannot be used, or holds another study of this name.

    Notes
    -----
    The sampler (tree-structured Parzen estimators) is seeded anew for every trial from the seed and the trial's number: a study
    that was ended and goes on finds the same as one that was not. One program at a time may write a study.
    """
    optuna = _optuna()
    n_trials = check_count("n_trials", n_trials)
    seed = check_count("seed", seed, at_least=0)
    constraints = dict(constraints or {})
    _check_names(objectives, constraints)
    plan = _planned(shot, search, [*objectives, *constraints], metrics, changes, seed)
    found = _opened(optuna, storage, name, list(objectives.values()))
    described = {
        **{key: value for key, value in plan.described().items() if key not in {"vary", "mode", "repeats"}},
        "search": {path: _plain(where) for path, where in search.items()},
        "objectives": dict(objectives),
        "constraints": {key: list(limits) for key, limits in constraints.items()},
    }
    before = found.user_attrs.get(PLAN)
    if before is None:
        found.set_user_attr(PLAN, json.loads(json.dumps(described)))
    else:
        check_same_plan(Path(str(storage)), before, described)
    for trial in found.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,)):
        # A program was ended in the middle of it: it counts for nothing, and its place is taken by the next.
        optuna.trial.Trial(found, trial._trial_id).set_user_attr(IS_CUT, True)  # noqa: SLF001 -- Optuna has no other way
        found.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    job = Job(plan.source, plan.metrics, thread_count(), True)
    bench = Bench()
    while (n_done := sum(not trial.user_attrs.get(IS_CUT) for trial in found.get_trials(deepcopy=False))) < n_trials:
        if tell is not None:
            tell(n_done, n_trials)
        found.sampler = optuna.samplers.TPESampler(seed=derived_seed(seed, n_done) % 2**32)
        trial = found.ask()
        settings = json.loads(json.dumps(dict(plan.settings))) | {"seed": seed}
        for path, where in search.items():
            put_setting(plan.source, settings, path, files_from(Path(), _suggested(trial, path, where), path))
        _told(optuna, found, trial, bench.record(job, Task(n_done, settings)), list(objectives), constraints)
    if tell is not None:
        tell(n_trials, n_trials)
    return found


def _told(
    optuna: Any,
    found: optuna.Study,
    trial: optuna.Trial,
    record: Record,
    objectives: Sequence[str],
    constraints: Limits,
) -> None:
    """Tell a study what a trial gave."""
    numbers: dict[str, float] = {}
    error = record.error
    for name in (*objectives, *constraints):
        value = record.values.get(name)
        if not isinstance(value, int | float) or not math.isfinite(value):
            given = ", ".join(record.values) or "nothing"
            error = error or (
                f"'{name}' is {value!r:.40}, no finite number"
                if name in record.values
                else f"no '{name}' among {given}"
            )
            break
        numbers[name] = float(value)
    if error:
        trial.set_user_attr(ERROR, error)
        found.tell(trial, state=optuna.trial.TrialState.FAIL)
        return
    for name, value in record.values.items():
        if isinstance(value, bool | int | float | str):
            trial.set_user_attr(name, value)
    for name, (low, high) in constraints.items():
        if low is not None:
            trial.set_constraint(f"{name} >= {low:g}", low - numbers[name])
        if high is not None:
            trial.set_constraint(f"{name} <= {high:g}", numbers[name] - high)
    found.tell(trial, [numbers[name] for name in objectives])


def _check_names(objectives: Mapping[str, str], constraints: Limits) -> None:
    if not isinstance(objectives, Mapping) or not objectives:
        raise ParameterError("objectives", 'must be names of results with "maximize" or "minimize"', objectives)
    for name, way in objectives.items():
        if way not in ("maximize", "minimize"):
            raise ParameterError(str(name), 'must be "maximize" or "minimize"', way)
    for name, limits in constraints.items():
        is_pair = isinstance(limits, tuple | list) and len(limits) == 2
        if (
            not is_pair
            or all(limit is None for limit in limits)
            or not all(limit is None or (isinstance(limit, int | float) and math.isfinite(limit)) for limit in limits)
        ):
            raise ParameterError(str(name), "must have limits (low, high), one of which may be None", limits)


def _planned(
    shot: str | Path | Mapping[str, Any],
    search: Mapping[str, Search],
    names: Sequence[str],
    metrics: Sequence[str | Metric] | Mapping[str, Metric] | None,
    changes: Mapping[str, Any] | None,
    seed: int,
) -> Plan:
    """The settings and metrics, all ranges checked at their ends."""
    if not isinstance(search, Mapping) or not search:
        raise ParameterError("search", "must be ranges by settings' paths: nothing is searched", search)
    wanted: Any = metrics
    if wanted is None:
        wanted = [own for own in METRICS if any(name == own or name.startswith(own + "_") for name in names)]
        unknown = [name for name in names if not any(name == own or name.startswith(own + "_") for own in METRICS)]
        if unknown:
            raise ParameterError(
                "objectives",
                f"must be results of metrics ({', '.join(METRICS)}), or of 'metrics' that are given",
                unknown[0],
            )
    plans = [
        plan_sweep(shot, {path: _ends(path, where)}, mode="zip", metrics=wanted, changes=changes, seed=seed)
        for path, where in search.items()
    ]
    return plans[0]


def _ends(path: str, where: Search) -> list[Any]:
    """Values at the ends of a range, or all choices."""
    if isinstance(where, Mapping):
        if set(where) - RANGE_KEYS or not {"from", "to"} <= set(where) or {"step", "spacing"} <= set(where):
            raise ParameterError(path, "must have 'from' and 'to', and may have 'step' or 'spacing'", dict(where))
        if where.get("spacing", "linear") not in ("linear", "geometric"):
            raise ParameterError(path, "must have a spacing that is linear or geometric", where["spacing"])
        if "step" in where and not (isinstance(where["step"], int | float) and where["step"] > 0):
            raise ParameterError(path, "must have a step > 0", where["step"])
        ends = [where["from"], where["to"]]
    elif isinstance(where, tuple):
        ends = list(where)
    elif isinstance(where, list) and where:
        return where
    else:
        raise ParameterError(path, "must be searched in (low, high), in a range, or in a list of choices", where)
    is_pair = len(ends) == 2 and all(isinstance(end, int | float) and math.isfinite(end) for end in ends)
    if not is_pair or not ends[0] < ends[1]:
        raise ParameterError(path, "must have two ends, the first the smaller", where)
    if isinstance(where, Mapping) and where.get("spacing") == "geometric" and ends[0] <= 0:
        raise ParameterError(path, "must be above 0 for geometric spacing", where["from"])
    return ends


def _suggested(trial: optuna.Trial, path: str, where: Search) -> Any:
    """A trial's value of a setting."""
    if isinstance(where, list):
        texts = [json.dumps(choice) for choice in where]
        return json.loads(trial.suggest_categorical(path, texts))
    low, high = _ends(path, where)
    step = where.get("step") if isinstance(where, Mapping) else None
    is_log = isinstance(where, Mapping) and where.get("spacing") == "geometric"
    if all(isinstance(number, int) for number in (low, high, step or 1)):
        return trial.suggest_int(path, low, high, step=step or 1, log=is_log)
    return trial.suggest_float(path, low, high, step=step, log=is_log)


def _plain(where: Search) -> Any:
    return dict(where) if isinstance(where, Mapping) else list(where)


def _opened(optuna: Any, storage: str | Path | None, name: str, directions: list[str]) -> optuna.Study:
    url = storage if storage is None or "://" in str(storage) else f"sqlite:///{Path(storage).absolute()}"
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        if url is not None and url != storage and not Path(str(storage)).absolute().parent.is_dir():
            raise FileError(str(storage), "cannot be written: its folder does not exist")
        if url is not None and name in optuna.get_all_study_names(storage=url):
            found = optuna.load_study(storage=url, study_name=name)
            if [direction.name.lower() for direction in found.directions] != directions:
                raise FileError(str(storage), f"holds a study '{name}' with other objectives; take another name")
            return found
        return optuna.create_study(storage=url, study_name=name, directions=directions)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 -- databases fail in many ways
        reason = str(error).partition("\n")[0]
        raise FileError(str(storage), f"cannot be used as a study's storage ({reason:.200})") from None
    finally:
        optuna.logging.set_verbosity(verbosity)


def _optuna() -> Any:
    try:
        import optuna
    except ImportError:
        raise ParameterError("study", "needs optuna; install it with: pip install 'foveasim[explore]'") from None
    return optuna
