"""Trials of a study: settings as numbers and lists, and tables of trials."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import TYPE_CHECKING, Any

from foveasim._core.extras import import_optional
from foveasim.explore.studies.plan import typed_choice

if TYPE_CHECKING:
    import optuna
    import pandas as pd

__all__ = ["ERROR", "INTERRUPTED", "PLAN", "completed_trials", "finished_trials", "trials_table", "with_typed_params"]

#: Attributes of a study and of its trials.
PLAN, ERROR, INTERRUPTED = "plan", "error", "ended with the program"


def finished_trials(optuna_study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """
    Return the finished trials of a study, without trials lost in interruptions.

    Returns
    -------
    trials : list of optuna.trial.FrozenTrial
        ``params`` contains numbers, strings, lists, mappings and None as in the search. Failed trials contain their message in
        ``user_attrs["error"]``.

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
    ...     shot, {"optics.f_number": [2.0, 8.0]}, {"snr_mean": "maximize"}, n_trials=3
    ... )
    >>> [trial.number for trial in fs.explore.finished_trials(found)]
    [0, 1, 2]
    """
    return [with_typed_params(optuna_study, trial) for trial in completed_trials(optuna_study)]


def completed_trials(optuna_study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """Return the finished trials of a study as Optuna stores them."""
    trials = optuna_study.get_trials(deepcopy=False)
    return [trial for trial in trials if trial.state.is_finished() and not trial.user_attrs.get(INTERRUPTED)]


def with_typed_params(optuna_study: optuna.Study, trial: optuna.trial.FrozenTrial) -> optuna.trial.FrozenTrial:
    """Return a copy of a trial with choices as in the search."""
    search = optuna_study.user_attrs.get(PLAN, {}).get("search", {})
    typed = copy(trial)
    typed.params = {
        path: typed_choice(value, search[path]) if _is_choice(trial, path, search) else value
        for path, value in trial.params.items()
    }
    return typed


def _is_choice(trial: optuna.trial.FrozenTrial, path: str, search: Mapping[str, Any]) -> bool:
    return path in search and hasattr(trial.distributions[path], "choices")


def trials_table(optuna_study: optuna.Study) -> pd.DataFrame:
    """
    Return the finished trials of a study as a table.

    Parameters
    ----------
    optuna_study : optuna.Study
        Study of :func:`study`, or of :func:`optuna.load_study` with its storage.

    Returns
    -------
    table : pandas.DataFrame
        One row per trial, with its number as index. Columns are the settings by path, with numbers as numbers and lists as
        lists; the results of the metrics by name, NaN for failed trials; ``is_best``, whether the trial is on the Pareto front;
        and ``error``, the message of a failed trial or an empty string.

    Raises
    ------
    ParameterError
        When pandas is not installed.

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
    >>> table = fs.explore.trials_table(found)
    >>> set(table[table.is_best]["optics.f_number"])
    {2.0}

    ::

        table = explore.trials_table(found)
        table[table.is_best].sort_values("snr_mean")
    """
    pd = import_optional("trials_table", "pandas", "explore")
    best = {trial.number for trial in optuna_study.best_trials}
    rows = []
    for trial in finished_trials(optuna_study):
        results = {name: value for name, value in trial.user_attrs.items() if name != ERROR}
        marks = {"is_best": trial.number in best, ERROR: trial.user_attrs.get(ERROR, "")}
        rows.append({**trial.params, **results, **marks})
    names = list(dict.fromkeys(name for row in rows for name in row if name not in ("is_best", ERROR)))
    index = pd.Index([trial.number for trial in completed_trials(optuna_study)], name="trial")
    return pd.DataFrame(rows, index=index, columns=[*names, "is_best", ERROR])
