"""Sweeps: simulation of a shot with varied settings, and a store of the results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from foveasim._core.calls import OwnCheck
from foveasim._core.threads import thread_count
from foveasim.errors import SimulationError
from foveasim.explore._records import WORKER_LOST, Journal, Record, check_same_plan, journal_path
from foveasim.explore.executor import KILLED, WORKERS, executor
from foveasim.explore.sweeps.plan import Plan, Seed, plan_sweep
from foveasim.explore.sweeps.results import (
    check_store,
    import_xarray,
    open_results,
    stored_plan,
    to_dataset,
    write_store,
)
from foveasim.explore.worker_cache import ShotRunner
from foveasim.metrics import Metric

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["run_sweep", "sweep"]

#: Function of the number of finished points and the total number.
Progress = Callable[[int, int], None]


def sweep(
    shot: str | Path | Mapping[str, Any],
    vary: OwnCheck[Mapping[str, Iterable[Any]] | Sequence[Mapping[str, Any]]],
    *,
    mode: Literal["product", "zip"] = "product",
    repeats: int = 1,
    seed: Seed = 0,
    metrics: Iterable[str | Metric] | Mapping[str, Metric] | None = None,
    changes: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    retry: bool = False,
    progress: Progress | None = None,
) -> xr.Dataset:
    """
    Simulate a shot with varied settings, and tabulate metrics.

    Parameters
    ----------
    shot, vary, mode, repeats, seed, metrics, changes
        As for :func:`plan_sweep`.
    out, scheduler, workers, retry, progress
        As for :func:`run_sweep`.

    Returns
    -------
    xarray.Dataset
        See :func:`run_sweep`.

    Raises
    ------
    ParameterError, ConfigError, FileError, SimulationError
        As for both functions.

    Notes
    -----
    Worker processes import the main file of the calling program: call this function under ``if __name__ == "__main__":``.

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
    >>> results = fs.explore.sweep(
    ...     shot, {"optics.f_number": [2.8, 4.0], "sensor.bits": [8, 10]}, workers=0
    ... )
    >>> results["snr_mean"].sel({"sensor.bits": 10}).values.round().tolist()
    [33.0, 23.0]

    ::

        results = sweep(
            "shot.yaml",
            {"sensor.bits": [8, 10, 12], "exposure_s": [0.01, 0.02]},
            repeats=10,
            out="results.zarr",
        )
        results["snr_mean"].mean("repeat")
    """
    plan = plan_sweep(shot, vary, mode=mode, repeats=repeats, seed=seed, metrics=metrics, changes=changes)
    return run_sweep(plan, out=out, scheduler=scheduler, workers=workers, retry=retry, progress=progress)


def run_sweep(
    plan: Plan,
    *,
    out: str | Path | None = None,
    scheduler: str | None = None,
    workers: Annotated[int | None, WORKERS] = None,
    retry: bool = False,
    progress: Progress | None = None,
) -> xr.Dataset:
    """
    Run a planned sweep, or resume an interrupted one.

    Parameters
    ----------
    plan : Plan
    out : path, optional
        Zarr store of the results, which is written at the end. During the sweep, every finished point is appended to a journal
        next to the store, from which the same sweep resumes after an interruption. The journal remains if points failed.
    scheduler : str, optional
        Address of a dask scheduler, such as ``"tcp://10.0.0.1:8786"``. Its workers need this package, and access to the files
        that the settings reference under the same names. By default local processes.
    workers : int, optional
        Number of local processes; by default one per core. 0 computes all points in this process, as debuggers and profilers
        need it.
    retry : bool
        Whether failed points are computed again; if the store has no journal and contains errors, all points are.
    progress : callable, optional
        Called with the number of finished points and the total number.

    Returns
    -------
    xarray.Dataset
        Metrics over the varied settings; ``seed``, ``error`` and ``warning`` of every point; the plan, all settings and the
        versions as attributes. Bit-identical for any number of workers and after any interruption.

    Raises
    ------
    ParameterError
        When no scheduler answers, or a package is not installed.
    FileError
        When the store contains another sweep, or cannot be written.
    SimulationError
        When the scheduler or all workers are lost. With ``out``, finished points remain in the journal.

    Notes
    -----
    An exception in a point gives NaN and an error message in the results, and does not affect other points. The same worker
    computes points with the same layout and optical image, and caches layouts, scenes, images, compiled layouts and the power
    on the sites.

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
    >>> plan = fs.explore.plan_sweep(
    ...     shot, {"optics.f_number": [2.0, 2.8, 4.0]}, metrics=["snr"]
    ... )
    >>> results = fs.explore.run_sweep(plan, workers=0)  # in this process
    >>> results["snr_mean"].round().values.tolist()
    [46.0, 33.0, 23.0]
    """
    import_xarray("sweep")  # before hours of work
    if out is None:
        records: dict[int, Record] = {}
        _run(plan, records, lambda record: records.update({record.point: record}), scheduler, workers, progress)
        return to_dataset(plan, records)
    store = Path(out)
    check_store(store)
    existing_plan = stored_plan(store)
    if existing_plan is not None:
        check_same_plan(store, existing_plan, plan.to_dict())
        if not journal_path(store).exists():
            complete = open_results(store)
            # Records cannot be restored exactly from a store: without the journal, all points are computed.
            if not (retry and (complete["error"] != "").any()):
                return complete
    with Journal(store, plan.to_dict()) as journal:
        if retry:
            for point in [point for point, record in journal.records.items() if record.error]:
                del journal.records[point]
        _run(plan, journal.records, journal.add, scheduler, workers, progress)
        dataset = to_dataset(plan, journal.records)
        write_store(dataset, store)
        if not (dataset["error"] != "").any():
            journal.remove()
    return dataset


def _run(
    plan: Plan,
    known: Mapping[int, Record],
    add: Callable[[Record], None],
    scheduler: str | None,
    workers: int | None,
    progress: Progress | None,
) -> None:
    """Compute all points without a record."""
    n_pending = plan.n_points - len(known)
    n_done = len(known)
    if n_pending == 0:
        return
    n_workers = min(thread_count() if workers is None else workers, n_pending)
    # The workers of a scheduler determine their own number of threads.
    n_threads = max(1, thread_count() // max(1, n_workers)) if scheduler is None else None
    runner = ShotRunner(
        plan.source_with(), plan.metrics, is_geometry_varied=plan.is_geometry_varied, n_threads=n_threads
    )
    users = list(plan.metrics.values())
    points, changes = plan.order()
    is_pending = np.array([int(point) not in known for point in points])
    # Positions among the pending points at which the layout or the optical image changes.
    cuts = (np.cumsum(is_pending) - is_pending)[changes]
    try:
        with executor(
            partial(_record, replace(plan), runner),
            what="the metrics",
            users=users,
            scheduler=scheduler,
            workers=n_workers,
        ) as run:
            if progress is not None:
                progress(n_done, plan.n_points)
            for point, record in run(points[is_pending].tolist(), np.unique(cuts).tolist()):
                add(Record(point, {}, WORKER_LOST) if record is KILLED else record)
                n_done += 1
                if progress is not None:
                    progress(n_done, plan.n_points)
    except SimulationError as error:
        raise SimulationError(
            f"{error}; {n_done:,} of {plan.n_points:,} points are done, from which a sweep with a store resumes"
        ) from None


def _record(plan: Plan, runner: ShotRunner, point: int) -> Record:
    """Compute the record of a point from its number."""
    return runner.record(point, plan.settings_of(point))
