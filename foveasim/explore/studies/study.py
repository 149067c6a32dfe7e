"""Studies: the settings that make a shot best, searched by Optuna, and kept so that any end leaves them resumable."""

from __future__ import annotations

import json
import math
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from foveasim._core.extras import needs
from foveasim._core.random_streams import derived_seed
from foveasim._core.validation import check_count
from foveasim._io.atomic import lock
from foveasim.errors import FileError, FoveasimError, ParameterError, printable
from foveasim.explore._metrics import Metric
from foveasim.explore._records import ENDED_ITS_WORKER, Record, Value, check_same_plan
from foveasim.explore.executor import KILLED, executor
from foveasim.explore.studies.plan import Limits, Search, StudyPlan, plan_study
from foveasim.explore.worker_cache import ShotRunner

if TYPE_CHECKING:
    import optuna
    from rich.table import Table

__all__ = ["best_table", "finished_trials", "run_study", "storage_name", "study"]

#: Rows of the table of the best trials, and characters of a choice in it.
MOST_ROWS, LONGEST_CHOICE = 20, 40
#: Attributes of a study and of its trials.
PLAN, WRITER, ERROR, IS_CUT = "plan", "writer", "error", "ended with the program"


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
    batch: int = 1,
    storage: str | Path | None = None,
    name: str = "study",
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> optuna.Study:
    """
    Search the settings that make a shot best.

    Parameters
    ----------
    shot, changes
        As for :func:`plan_sweep`.
    search : mapping of str to range
        By the settings' paths: ``(low, high)``, ``{"from": 1, "to": 64, "spacing": "geometric"}`` or
        ``{"from": 0, "to": 64, "step": 8}``, in integers where the setting takes no others; or a list of choices.
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
    batch : int
        Trials that are sampled together, without each other's results, so that as many workers can compute them at once.
    storage : path or str, optional
        An SQLite file, or any URL that Optuna takes. By default memory.
    name : str
        Of the study in its storage.
    scheduler : str, optional
        Address of a dask scheduler, whose workers have this package and see the files that the settings name.
    workers : int, optional
        Processes of this machine instead. By default trials are computed in this process.
    progress : callable, optional
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
    The sampler (tree-structured Parzen estimators) is seeded again for every trial, from the seed and the trial's number: an
    interrupted study resumes as if it had not been, and any number of workers finds the same. One program at a time may write
    a study.
    """
    plan = plan_study(
        shot,
        search,
        objectives,
        n_trials=n_trials,
        constraints=constraints,
        metrics=metrics,
        changes=changes,
        seed=seed,
        batch=batch,
        name=name,
    )
    return run_study(plan, storage=storage, scheduler=scheduler, workers=workers, progress=progress)


def run_study(
    plan: StudyPlan,
    *,
    storage: str | Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> optuna.Study:
    """
    Run a study that was planned, or go on with one that was ended.

    Parameters
    ----------
    plan : StudyPlan
    storage, scheduler, workers, progress
        As for :func:`study`.

    Returns
    -------
    optuna.Study
        See :func:`study`.

    Raises
    ------
    ParameterError
        When Optuna or dask is missing, or no scheduler answers.
    FileError
        When the storage cannot be used, or holds another study of this name.
    SimulationError
        When the scheduler or all workers are gone. Trials that are done are stored.
    """
    if workers is not None:
        workers = min(check_count("workers", workers, at_most=1024), plan.batch)
    optuna = _optuna()
    url = _url(storage)
    with _alone(storage, url):
        token = secrets.token_hex(8)
        with _silent(optuna), _using(storage):
            found = _opened(optuna, storage, url, plan)
            trials = _begin(optuna, storage, found, plan, token)
        runner = ShotRunner(plan.base.source, plan.base.metrics)
        users = list(plan.base.metrics.values())
        with executor(runner, what="the metrics", users=users, scheduler=scheduler, workers=workers) as run:
            n_done = len(finished_trials(found))
            while n_done < plan.n_trials:
                if progress is not None:
                    progress(n_done, plan.n_trials)
                with _using(storage, n_done):
                    trials = trials or [_asked(optuna, found, plan, n_done + k) for k in range(plan.batch)]
                    _check_writer(optuna, storage, trials[-1], token)
                    points = [(trial.number, plan.settings_of(trial)) for trial in trials]
                records = {
                    number: Record(number, {}, ENDED_ITS_WORKER) if record is KILLED else record
                    for (number, _), record in run(points, ())
                }
                with _using(storage, n_done):
                    for trial in trials:
                        _check_writer(optuna, storage, trial, token)
                        _store_result(
                            optuna, found, trial, records[trial.number], list(plan.objectives), plan.constraints
                        )
                n_done += len(trials)
                trials = []
    if progress is not None:
        progress(plan.n_trials, plan.n_trials)
    return found


def finished_trials(found: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """
    Trials of a study, without those that ended with the program that they were in.

    Those that failed have their message in ``user_attrs["error"]``.
    """
    trials = found.get_trials(deepcopy=False)
    return [trial for trial in trials if trial.state.is_finished() and not trial.user_attrs.get(IS_CUT)]


def storage_name(storage: str | Path | None) -> str:
    """What messages call a storage: its URL without the user's name and password."""
    return re.sub(r"://[^/@]*@", "://", str(storage))


def best_table(plan: StudyPlan, found: optuna.Study) -> Table:
    """Table of the best trials: objectives, the results that have limits, settings; the best in the first objective on top."""
    from rich.table import Table
    from rich.text import Text

    from foveasim._io.terminal import text_of

    limited = [name for name in plan.constraints if name not in plan.objectives]
    table = Table(box=None)
    table.add_column("trial", justify="right")
    for name, way in plan.objectives.items():
        table.add_column(Text(f"{printable(name)}\n{way}d"), justify="right", overflow="fold")
    for heading in (*limited, *_short(plan.search)):
        table.add_column(text_of(heading), justify="right", overflow="fold")
    sign = -1.0 if next(iter(plan.objectives.values())) == "maximize" else 1.0
    best = sorted(found.best_trials, key=lambda trial: sign * trial.values[0])
    rows: dict[tuple[str, ...], int] = {}
    for trial in best:
        results = [*trial.values, *(trial.user_attrs[name] for name in limited)]
        chosen = [_shown(trial.params[path], where) for path, where in plan.search.items()]
        # The same settings may have been tried twice, and gave the same.
        rows.setdefault((*(f"{value:.6g}" for value in results), *chosen), trial.number)
    for cells, number in list(rows.items())[:MOST_ROWS]:
        table.add_row(f"{number}", *map(text_of, cells))
    if len(rows) > MOST_ROWS:
        table.caption = f"and {len(rows) - MOST_ROWS:,} more that are as good"
    return table


def _short(paths: Iterable[str]) -> list[str]:
    """The last parts of settings' paths, as many as tell them apart."""
    split = [path.split(".") for path in paths]
    return [
        next(
            ".".join(parts[-n:])
            for n in range(1, len(parts) + 1)
            if n == len(parts) or sum(other[-n:] == parts[-n:] for other in split) == 1
        )
        for parts in split
    ]


def _shown(value: Any, where: Search) -> str:
    """A trial's value of a setting, for a table; of choices the text of JSON is what Optuna keeps."""
    chosen = json.loads(value) if isinstance(where, list) else value
    if isinstance(chosen, float):
        return f"{chosen:.6g}"
    text = chosen if isinstance(chosen, str) else json.dumps(chosen)
    return text if len(text) <= LONGEST_CHOICE else text[: LONGEST_CHOICE - 3] + "..."


def _store_result(
    optuna: Any,
    found: optuna.Study,
    trial: optuna.Trial,
    record: Record,
    objectives: Sequence[str],
    constraints: Limits,
) -> None:
    """Progress a study what a trial gave."""
    numbers: dict[str, float] = {}
    error = record.error
    for name in (*objectives, *constraints):
        value = record.values.get(name)
        if not isinstance(value, int | float) or not math.isfinite(value):
            given = ", ".join(record.values) or "nothing"
            error = error or (
                f"'{name}' is {'an array' if isinstance(value, Value) else repr(value):.40}, no finite number"
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


def _opened(optuna: Any, storage: str | Path | None, url: str | None, plan: StudyPlan) -> optuna.Study:
    """The study in its storage, or a new one."""
    directions = list(plan.objectives.values())
    if url is None or plan.name not in optuna.get_all_study_names(storage=url):
        return optuna.create_study(storage=url, study_name=plan.name, directions=directions)
    found = optuna.load_study(storage=url, study_name=plan.name)
    if [direction.name.lower() for direction in found.directions] != directions:
        raise FileError(storage_name(storage), f"holds a study '{plan.name}' with other objectives; take another name")
    return found


def _asked(optuna: Any, found: optuna.Study, plan: StudyPlan, n: int) -> optuna.Trial:
    """Sample the settings of the n-th trial, with a sampler of its own seed."""
    found.sampler = optuna.samplers.TPESampler(seed=derived_seed(plan.base.seed, n) % 2**32)
    trial = found.ask()
    plan.settings_of(trial)
    return trial


def _begin(
    optuna: Any, storage: str | Path | None, found: optuna.Study, plan: StudyPlan, token: str
) -> list[optuna.Trial]:
    """
    Check that a study is this one, and sign as its writer.

    Returns
    -------
    trials : list of optuna.Trial
        The rest of a batch whose results were being stored when the study was interrupted: their settings are sampled already.
        Trials of a batch without results are given up, and sampled again.
    """
    plan_dict = plan.to_dict()
    before = found.user_attrs.get(PLAN)
    if before is not None:
        check_same_plan(Path(storage_name(storage)), before, plan_dict)
    elif found.get_trials(deepcopy=False):
        raise FileError(
            storage_name(storage), f"holds a study '{found.study_name}' of another program; take another name"
        )
    else:
        found.set_user_attr(PLAN, json.loads(json.dumps(plan_dict)))
    found.set_user_attr(WRITER, token)
    running = found.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,))
    trials = [optuna.trial.Trial(found, trial._trial_id) for trial in running]  # noqa: SLF001 -- Optuna has no other way
    if len(finished_trials(found)) % plan.batch:
        return trials
    for trial in trials:
        _give_up(optuna, trial)
    return []


def _give_up(optuna: Any, trial: optuna.Trial) -> None:
    trial.set_user_attr(IS_CUT, True)
    trial.study.tell(trial.number, state=optuna.trial.TrialState.FAIL)


def _check_writer(optuna: Any, storage: str | Path | None, trial: optuna.Trial, token: str) -> None:
    """
    Whether no other program has begun to write the study.

    Raises
    ------
    FileError
        When one has: the trial, which the other does not know, is given up, if it was not already by the other.
    """
    if trial.study.user_attrs.get(WRITER) == token:
        return
    with suppress(Exception):
        _give_up(optuna, trial)
    raise FileError(storage_name(storage), "is being written by another program, which has begun to run the same study")


@contextmanager
def _alone(storage: str | Path | None, url: str | None) -> Iterator[None]:
    """
    While no other program on this machine writes the file of a study, which no data base on another machine has.

    Raises
    ------
    FileError
        When one does.
    """
    file = None if url is None else _file_of(url)
    if file is None:
        yield
        return
    # Not the file itself: to close it here would end SQLite's own locks on it.
    beside = file.with_name(file.name + ".lock")
    with ExitStack() as opened:
        is_ours = False
        while not is_ours:
            with _using(storage):
                held = opened.enter_context(beside.open("ab"))
                if not lock(held):
                    raise FileError(storage_name(storage), "is being written by another program that runs a study")
                # A program that ends takes the file away, perhaps after we opened it.
                is_ours = beside.exists() and os.path.samestat(beside.stat(), os.fstat(held.fileno()))
        opened.callback(partial(beside.unlink, missing_ok=True))
        yield


def _file_of(url: str) -> Path | None:
    """The file of an SQLite data base; None of another."""
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        parts = make_url(url)
    except ArgumentError:
        return None  # Optuna tells
    if not parts.drivername.startswith("sqlite") or parts.database in {None, "", ":memory:"}:
        return None
    return Path(str(parts.database))


def _url(storage: str | Path | None) -> str | None:
    """The URL of a storage; None of memory."""
    if storage is None or "://" in str(storage):
        return storage if storage is None else str(storage)
    path = Path(storage).absolute()
    if not path.parent.is_dir():
        raise FileError(storage_name(storage), "cannot be written: its folder does not exist")
    return f"sqlite:///{path}"


@contextmanager
def _using(storage: str | Path | None, n_done: int | None = None) -> Iterator[None]:
    """What goes wrong with a storage, in one sentence; with what is kept in it, once there is something."""
    try:
        yield
    except FoveasimError:
        raise
    except Exception as error:  # noqa: BLE001 -- databases fail in many ways
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        reason = str(cause).partition("\n")[0]
        kept = "" if n_done is None else f"; {n_done:,} trials are kept in it, and the same study goes on from there"
        raise FileError(storage_name(storage), f"cannot be used as a study's storage ({reason:.200}){kept}") from None


@contextmanager
def _silent(optuna: Any) -> Iterator[None]:
    """Without what Optuna logs of a study that it makes."""
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        yield
    finally:
        optuna.logging.set_verbosity(verbosity)


def _optuna() -> Any:
    try:
        import optuna
    except ImportError:
        raise ParameterError("study", needs("optuna")) from None
    return optuna
