"""Optimisation of settings with Optuna, in resumable studies."""

from __future__ import annotations

import json
import logging
import math
import os
import re
import secrets
import sqlite3
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from foveasim._core.calls import OwnCheck
from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._core.random_streams import derive_seed
from foveasim._io.atomic import lock, rename_or_remove
from foveasim.errors import FileError, FoveasimError, printable
from foveasim.explore._records import WORKER_LOST, Record, Value, check_same_plan
from foveasim.explore.executor import KILLED, WORKERS, executor
from foveasim.explore.studies.plan import Limits, Search, StudyPlan, plan_study
from foveasim.explore.studies.trials import ERROR, INTERRUPTED, PLAN, completed_trials, with_typed_params
from foveasim.explore.worker_cache import ShotRunner
from foveasim.metrics import Metric

if TYPE_CHECKING:
    import optuna
    from rich.table import Table

__all__ = ["best_table", "run_study", "storage_name", "study"]

#: Limits of the table of the best trials: rows, and characters of a choice.
MAX_ROWS, MAX_CHOICE_LENGTH = 20, 40
#: Attribute of a study with the program that writes it.
WRITER = "writer"


def study(
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
    storage: str | Path | None = None,
    name: str = "study",
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> optuna.Study:
    """
    Optimise settings of a shot for one or several objectives.

    Parameters
    ----------
    shot, changes
        As for :func:`plan_sweep`.
    search : mapping of str to range
        Search ranges by setting path: ``(low, high)``, ``{"from": 1, "to": 64, "spacing": "geometric"}`` or
        ``{"from": 0, "to": 64, "step": 8}``, in integers where the setting accepts only integers; or a list of choices.
    objectives : mapping of str to {"maximize", "minimize"}
        Directions by name of a metric result, such as ``"snr_mean"``. For several objectives, the study finds the Pareto front.
    n_trials : int
        Total number of trials, including those of earlier calls with the same storage.
    constraints : mapping of str to (low, high), optional
        Limits of results; either may be None. Trials that violate a constraint are not among the best.
    metrics : names or functions, or mapping of names to functions, optional
        By default the metrics of the objectives and constraints.
    seed : int
        Seed of the search and of the noise, which is equal in all captures: differences between trials are due to the settings.
    batch : int
        Number of trials that are sampled together, without each other's results, so that workers can compute them in parallel.
    storage : path or str, optional
        SQLite file, or storage URL of Optuna. By default the study is stored in memory.
    name : str
        Name of the study in its storage.
    scheduler : str, optional
        Address of a dask scheduler. Its workers need this package and the files that the settings reference.
    workers : int, optional
        Number of local processes instead. By default, and with 0, trials are computed in this process.
    progress : callable, optional
        Called with the number of finished trials and the total number.

    Returns
    -------
    optuna.Study
        ``best_trials`` is the Pareto front. ``user_attrs`` of a trial contains the results of all metrics, or the message of a
        failed trial under ``"error"``; its ``params`` are the settings, in which choices of lists or mappings are JSON.
        :func:`trials_table` returns settings and results as a table, and :func:`finished_trials` trials with lists as lists.

    Raises
    ------
    ParameterError, ConfigError
        When a path, a range or a name is invalid.
    FileError
        When the storage cannot be used, or contains another study of this name.

    Notes
    -----
    The sampler (tree-structured Parzen estimator) is seeded for every trial with the seed and the number of the trial: an
    interrupted study resumes with identical results, and results do not depend on the number of workers. Only one program at a
    time may write a study.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = {
    ...     "kind": "flat",
    ...     "shape": [60, 60],
    ...     "pitch_um": 300.0,
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.002,
    ... }
    >>> shot["sensor"] = {"preset": "machine_vision"}
    >>> found = fs.explore.study(
    ...     shot, {"optics.f_number": [2.0, 8.0]}, {"snr_mean": "maximize"}, n_trials=4
    ... )
    >>> found.best_params
    {'optics.f_number': 2.0}
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
    workers: Annotated[int | None, WORKERS] = None,
    progress: Callable[[int, int], None] | None = None,
) -> optuna.Study:
    """
    Run a planned study, or resume an interrupted one.

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
        When Optuna or dask is not installed, or no scheduler answers.
    FileError
        When the storage cannot be used, or contains another study of this name.
    SimulationError
        When the scheduler or all workers are lost. Finished trials are stored.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = {
    ...     "kind": "flat",
    ...     "shape": [60, 60],
    ...     "pitch_um": 300.0,
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.002,
    ... }
    >>> shot["sensor"] = {"preset": "machine_vision"}
    >>> plan = fs.explore.plan_study(
    ...     shot, {"optics.f_number": [2.0, 8.0]}, {"snr_mean": "maximize"}, n_trials=4
    ... )
    >>> fs.explore.run_study(plan).best_params
    {'optics.f_number': 2.0}
    """
    n_workers = min(workers or 0, plan.batch)
    optuna = import_optional("study", "optuna")
    url = _url(storage)
    with _file_lock(storage, url), _without_empty_file(url):
        token = secrets.token_hex(8)
        with _suppress_logs(optuna), _storage_errors(storage):
            optuna_study = _open_study(optuna, storage, url, plan)
            trials = _prepare(optuna, storage, optuna_study, plan, token)
        runner = ShotRunner(plan.source, plan.base.metrics)
        users = list(plan.base.metrics.values())
        with executor(runner, what="the metrics", users=users, scheduler=scheduler, workers=n_workers) as run:
            n_done = len(completed_trials(optuna_study))
            while n_done < plan.n_trials:
                if progress is not None:
                    progress(n_done, plan.n_trials)
                with _storage_errors(storage, n_done):
                    missing = range(len(trials), plan.batch - n_done % plan.batch)
                    trials += [_ask(optuna, optuna_study, plan, n_done + k) for k in missing]
                    _check_writer(optuna, storage, trials[-1], token)
                    points = [(trial.number, plan.settings_of(trial)) for trial in trials]
                records = {
                    number: Record(number, {}, WORKER_LOST) if record is KILLED else record
                    for (number, _), record in run(points, ())
                }
                with _storage_errors(storage, n_done):
                    for trial in trials:
                        _check_writer(optuna, storage, trial, token)
                        _store_result(
                            optuna, optuna_study, trial, records[trial.number], list(plan.objectives), plan.constraints
                        )
                n_done += len(trials)
                trials = []
    if progress is not None:
        progress(plan.n_trials, plan.n_trials)
    return optuna_study


def storage_name(storage: str | Path | None) -> str:
    """Return the URL of a storage for messages, without user name and password."""
    return re.sub(r"://[^/@]*@", "://", str(storage))


def best_table(plan: StudyPlan, optuna_study: optuna.Study) -> Table:
    """
    Return a table of the best trials, sorted by the first objective.

    Columns are the objectives, the results with constraints, and the settings.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = {
    ...     "kind": "flat",
    ...     "shape": [60, 60],
    ...     "pitch_um": 300.0,
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.002,
    ... }
    >>> shot["sensor"] = {"preset": "machine_vision"}
    >>> plan = fs.explore.plan_study(
    ...     shot, {"optics.f_number": [2.0, 8.0]}, {"snr_mean": "maximize"}, n_trials=1
    ... )
    >>> table = fs.explore.best_table(plan, fs.explore.run_study(plan))
    >>> table.row_count
    1
    """
    from rich.table import Table
    from rich.text import Text

    from foveasim._io.terminal import as_plain_text

    limited = [name for name in plan.constraints if name not in plan.objectives]
    table = Table(box=None)
    table.add_column("trial", justify="right")
    for name, direction in plan.objectives.items():
        table.add_column(Text(f"{printable(name)}\n{direction}d"), justify="right", overflow="fold")
    for heading in (*limited, *_shortest_suffixes(plan.search)):
        table.add_column(as_plain_text(heading), justify="right", overflow="fold")
    sign = -1.0 if next(iter(plan.objectives.values())) == "maximize" else 1.0
    best = sorted(
        (with_typed_params(optuna_study, trial) for trial in optuna_study.best_trials),
        key=lambda trial: sign * trial.values[0],
    )
    rows: dict[tuple[str, ...], int] = {}
    for trial in best:
        results = [*trial.values, *(trial.user_attrs[name] for name in limited)]
        chosen = [_format_value(trial.params[path]) for path in plan.search]
        # Trials with equal settings have equal results and share a row.
        rows.setdefault((*(f"{value:.6g}" for value in results), *chosen), trial.number)
    for cells, number in list(rows.items())[:MAX_ROWS]:
        table.add_row(f"{number}", *map(as_plain_text, cells))
    if len(rows) > MAX_ROWS:
        table.caption = f"and {len(rows) - MAX_ROWS:,} further best trials"
    return table


def _shortest_suffixes(paths: Iterable[str]) -> list[str]:
    """Return the shortest unique suffixes of setting paths."""
    split = [path.split(".") for path in paths]
    return [
        next(
            ".".join(parts[-n:])
            for n in range(1, len(parts) + 1)
            if n == len(parts) or sum(other[-n:] == parts[-n:] for other in split) == 1
        )
        for parts in split
    ]


def _format_value(value: Any) -> str:
    """Format the value of a setting for a table."""
    if isinstance(value, float):
        return f"{value:.6g}"
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= MAX_CHOICE_LENGTH else text[: MAX_CHOICE_LENGTH - 3] + "..."


def _store_result(
    optuna: Any,
    optuna_study: optuna.Study,
    trial: optuna.Trial,
    record: Record,
    objectives: Sequence[str],
    constraints: Limits,
) -> None:
    """Store the results or the error of a trial in the study."""
    numbers: dict[str, float] = {}
    error = record.error
    for name in (*objectives, *constraints):
        value = record.values.get(name)
        if not isinstance(value, int | float) or not math.isfinite(value):
            error = error or (
                f"'{name}' must be a finite number, got {'an array' if isinstance(value, Value) else repr(value):.40}"
                if name in record.values
                else f"'{name}' must be one of the results; {possible_names(name, list(record.values))}"
            )
            break
        numbers[name] = float(value)
    if error:
        trial.set_user_attr(ERROR, error)
        optuna_study.tell(trial, state=optuna.trial.TrialState.FAIL)
        return
    for name, value in record.values.items():
        if isinstance(value, bool | int | float | str):
            trial.set_user_attr(name, value)
    for name, (low, high) in constraints.items():
        if low is not None:
            trial.set_constraint(f"{name} >= {low:g}", low - numbers[name])
        if high is not None:
            trial.set_constraint(f"{name} <= {high:g}", numbers[name] - high)
    optuna_study.tell(trial, [numbers[name] for name in objectives])


def _open_study(optuna: Any, storage: str | Path | None, url: str | None, plan: StudyPlan) -> optuna.Study:
    """Load the study from its storage, or create it."""
    # An interrupt during a query makes SQLAlchemy log a cursor that it cannot close; the interrupt itself is raised.
    logging.getLogger("sqlalchemy.pool").addHandler(logging.NullHandler())
    directions = list(plan.objectives.values())
    database = _database(optuna, url)
    if url is None or plan.name not in optuna.get_all_study_names(storage=database):
        return optuna.create_study(storage=database, study_name=plan.name, directions=directions)
    optuna_study = optuna.load_study(storage=database, study_name=plan.name)
    if [direction.name.lower() for direction in optuna_study.directions] != directions:
        raise FileError(
            storage_name(storage), f"contains a study '{plan.name}' with other objectives; use another name"
        )
    return optuna_study


def _database(optuna: Any, url: str | None) -> Any:
    """
    Return the storage of a URL.

    A file is open during queries only: Windows does not remove open files.
    """
    from sqlalchemy.pool import NullPool

    if url is None or _sqlite_path(url) is None:
        return url
    return optuna.storages.RDBStorage(url, engine_kwargs={"poolclass": NullPool})


def _ask(optuna: Any, optuna_study: optuna.Study, plan: StudyPlan, n: int) -> optuna.Trial:
    """Sample the settings of trial n, with a sampler that is seeded for this trial."""
    optuna_study.sampler = optuna.samplers.TPESampler(seed=derive_seed(plan.base.seed, n) % 2**32)
    trial = optuna_study.ask()
    plan.settings_of(trial)
    return trial


def _prepare(
    optuna: Any, storage: str | Path | None, optuna_study: optuna.Study, plan: StudyPlan, token: str
) -> list[optuna.Trial]:
    """
    Check that the stored study has the same plan, and register this program as its writer.

    Returns ``trials``: the trials of a batch that an interruption left without results, with the settings and numbers that they
    have without one.
    """
    plan_dict = plan.to_dict()
    stored_plan = optuna_study.user_attrs.get(PLAN)
    if stored_plan is not None:
        check_same_plan(Path(storage_name(storage)), stored_plan, plan_dict)
    elif optuna_study.get_trials(deepcopy=False):
        raise FileError(
            storage_name(storage), f"contains a study '{optuna_study.study_name}' of another program; use another name"
        )
    else:
        optuna_study.set_user_attr(PLAN, json.loads(json.dumps(plan_dict)))
    optuna_study.set_user_attr(WRITER, token)
    running = optuna_study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,))
    trials = [optuna.trial.Trial(optuna_study, trial._trial_id) for trial in running]  # noqa: SLF001 -- Optuna has no public way
    n_done = len(completed_trials(optuna_study))
    n_left = plan.batch - n_done % plan.batch
    for trial in trials[n_left:]:
        _discard(optuna, trial)
    for k, trial in enumerate(trials[:n_left]):
        if len(trial.params) < len(plan.search):
            _sample_rest(optuna, optuna_study, trial, plan, n_done + k)
    return trials[:n_left]


def _sample_rest(optuna: Any, optuna_study: optuna.Study, trial: optuna.Trial, plan: StudyPlan, n: int) -> None:
    """
    Sample the settings of trial n that an interruption left without a value.

    A copy of the study samples all of them, with the seed of the trial.
    """
    copy = optuna.create_study(directions=optuna_study.directions)
    # Those of the batch without results, too: the sampler takes their settings into account.
    copy.add_trials([each for each in optuna_study.get_trials(deepcopy=False) if each.number < trial.number])
    params = _ask(optuna, copy, plan, n).params
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        optuna_study.sampler = optuna.samplers.PartialFixedSampler(params, optuna_study.sampler)
    plan.settings_of(trial)


def _discard(optuna: Any, trial: optuna.Trial) -> None:
    trial.set_user_attr(INTERRUPTED, True)
    trial.study.tell(trial.number, state=optuna.trial.TrialState.FAIL)


def _check_writer(optuna: Any, storage: str | Path | None, trial: optuna.Trial, token: str) -> None:
    """
    Check that no other program has started to write the study.

    Raises FileError when another program writes the study. The trial is then marked as failed, unless the other program has
    done so.
    """
    if trial.study.user_attrs.get(WRITER) == token:
        return
    with suppress(Exception):
        _discard(optuna, trial)
    raise FileError(storage_name(storage), "is being written by another program, which runs the same study")


@contextmanager
def _file_lock(storage: str | Path | None, url: str | None) -> Iterator[None]:
    """
    Lock the SQLite file of a study against other programs on this machine.

    Other storages have no lock.

    Raises FileError when another program has locked the file.
    """
    file = None if url is None else _sqlite_path(url)
    if file is None:
        yield
        return
    # A separate file: closing the database file here would release the locks of SQLite on it.
    lock_path = file.with_name(file.name + ".lock")
    with ExitStack() as stack:
        is_locked = False
        while not is_locked:
            with _storage_errors(storage):
                lock_file = stack.enter_context(lock_path.open("ab"))
                if not lock(lock_file):
                    raise FileError(storage_name(storage), "is being written by another program that runs a study")
                # Another program may remove the lock file at its end, after it was opened here.
                is_locked = lock_path.exists() and os.path.samestat(lock_path.stat(), os.fstat(lock_file.fileno()))
        stack.callback(rename_or_remove, lock_file, partial(lock_path.unlink, missing_ok=True))
        yield


@contextmanager
def _without_empty_file(url: str | None) -> Iterator[None]:
    """Remove a new SQLite file after an exception before the first result."""
    file = None if url is None else _sqlite_path(url)
    is_new = file is not None and not file.exists()
    try:
        yield
    except BaseException:
        if file is not None and is_new and not _has_results(file):
            file.unlink(missing_ok=True)
        raise


def _has_results(file: Path) -> bool:
    """Return whether an SQLite file of Optuna contains a finished trial."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(file)) as database:
        return bool(database.execute("SELECT 1 FROM trials WHERE state IN ('COMPLETE', 'FAIL')").fetchone())
    return False


def _sqlite_path(url: str) -> Path | None:
    """Return the file of an SQLite database; None for other databases."""
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        parts = make_url(url)
    except ArgumentError:
        return None  # reported by Optuna
    if not parts.drivername.startswith("sqlite") or parts.database in {None, "", ":memory:"}:
        return None
    return Path(str(parts.database))


def _url(storage: str | Path | None) -> str | None:
    """Return the URL of a storage; None for memory."""
    if storage is None or "://" in str(storage):
        return storage if storage is None else str(storage)
    path = Path(storage).absolute()
    if not path.parent.is_dir():
        raise FileError(storage_name(storage), "cannot be written: its directory does not exist")
    return f"sqlite:///{path}"


@contextmanager
def _storage_errors(storage: str | Path | None, n_done: int | None = None) -> Iterator[None]:
    """Raise errors of a storage as FileError, with the number of stored trials."""
    try:
        yield
    except FoveasimError:
        raise
    except Exception as error:  # noqa: BLE001 -- databases fail in many ways
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        reason = str(cause).partition("\n")[0]
        stored = "" if n_done is None else f"; {n_done:,} trials are stored, from which the same study resumes"
        raise FileError(storage_name(storage), f"cannot be used as a study's storage ({reason:.200}){stored}") from None


@contextmanager
def _suppress_logs(optuna: Any) -> Iterator[None]:
    """Suppress the messages that Optuna logs when it creates a study."""
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        yield
    finally:
        optuna.logging.set_verbosity(verbosity)
