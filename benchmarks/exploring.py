"""
Overhead of the executor of sweeps per task with many workers, compared with dask's own queue.

    python benchmarks/exploring.py             3,000 tasks; 40 layouts of 4 bit depths on 2 workers
    python benchmarks/exploring.py --quick     10 layouts
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from report import Report, best_s
from rich.console import Console

from foveasim import explore
from foveasim._core.provenance import versions
from foveasim.explore import executor as executor_module
from foveasim.explore.cluster import open_client
from foveasim.explore.executor import _compute, _Dispatch, _pickle, _Results, _Shared, executor
from foveasim.explore.sweeps.sweep import _record
from foveasim.explore.worker_cache import ShotRunner

N_TASKS, N_REPEATS = 3000, 20
SHOT = {
    "scene": {
        "kind": "flat",
        "shape": [400, 400],
        "pitch_um": 50.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.1,
        "band_width_nm": 100.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "log_polar", "parameters": {"n_sectors": 64, "r_min_um": 5.0, "r_max_um": 300.0}},
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 4e-15},
    "exposure_s": 0.01,
}
console = Console(width=130)


class _InstantClient:
    """A dask client of n workers whose tasks take no time, to measure the executor alone."""

    cluster = None

    def __init__(self, n_workers: int) -> None:
        self._workers = {f"tcp://{k}": {"status": "running", "metrics": {}} for k in range(n_workers)}

    def scheduler_info(self, **_: Any) -> dict[str, Any]:
        return {"workers": self._workers}

    def submit(self, _function: Any, _shared: Any, items: Sequence[Any], _limit_s: float, **_: Any) -> _InstantFuture:
        return _InstantFuture(_Results(list(items), 1e-9))

    def gather(self, futures: Sequence[_InstantFuture], **_: Any) -> list[Any]:
        return [future.values for future in futures]

    def sync(self, call: Callable[[], Any], **_: Any) -> Any:
        return call()

    def cancel(self, _futures: Any) -> None:
        pass


class _InstantFuture:
    status = "finished"

    def __init__(self, values: _Results) -> None:
        self.values = values

    def add_done_callback(self, call: Callable[[Any], None]) -> None:
        call(self)


def _dispatch(n_workers: int) -> Callable[[], object]:
    """Return a call that dispatches all tasks to n workers."""

    def call() -> object:
        client: Any = _InstantClient(n_workers)
        return list(_Dispatch(client, client, range(N_TASKS), ()).run())

    return call


def bench_exploring(report: Report, n_layouts: int) -> None:
    """Compare the executor with fewer workers, and with dask's own queue."""
    largest, executor_module.MAX_ITEMS = executor_module.MAX_ITEMS, 1
    try:
        times = best_s({"10": _dispatch(10), "1000": _dispatch(1000)}, N_REPEATS)
    finally:
        executor_module.MAX_ITEMS = largest
    report.slower_than("executor, 3,000 tasks, 1,000 workers", times["1000"], "10 workers", times["10"], 1.5)

    plan = explore.plan_sweep(
        SHOT, {"layout.parameters.n_sectors": list(range(100, 100 + n_layouts)), "sensor.bits": [8, 10, 12, 14]}
    )
    points, changes = (each.tolist() for each in plan.order())
    ours, queue = (partial(_record, plan, ShotRunner(plan.source, plan.metrics, n_threads=1)) for _ in range(2))
    with open_client(None, 2) as client, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shared = client.submit(_Shared, _pickle(queue, "the metrics", ()), versions(), pure=False)
        begin_s = time.perf_counter()
        client.gather(client.map(lambda point, each: _compute(each, [point], 1e9), points, each=shared, pure=False))
        queue_s = time.perf_counter() - begin_s
    with executor(ours, what="the metrics", workers=2) as run:
        begin_s = time.perf_counter()
        list(run(points, changes))
        ours_s = time.perf_counter() - begin_s
    what = f"sweep of {n_layouts} layouts x 4 depths, 2 workers"
    report.faster_than(what, ours_s, "dask's own queue", queue_s, 1.2 if n_layouts >= 40 else None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    own = Report(is_judged=not is_quick)
    bench_exploring(own, 10 if is_quick else 40)
    console.print(own.table)
