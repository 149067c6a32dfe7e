"""Points to the workers of dask, and their records back: neighbours to the same worker, and none lost with a worker."""

from __future__ import annotations

import asyncio
import logging
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from foveasim.errors import ParameterError, SimulationError
from foveasim.explore._bench import Task, run_tasks
from foveasim.explore._records import Record
from foveasim.records import versions

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["client_of", "records_of"]

#: Time that a scheduler has to answer, and that all its workers may be away.
SCHEDULER_S, WORKERS_S = 10.0, 60.0
#: Points that take less are sent together, so many seconds' worth, and no more than this many.
BUNDLE_S, LARGEST_BUNDLE = 0.05, 64
#: Bundles at a worker: one that it works on, and one that waits.
AT_A_WORKER = 2
#: A point that ended its worker so often is not tried again.
MOST_DEATHS = 2
#: How often the workers are counted.
COUNT_S = 1.0


@contextmanager
def client_of(scheduler: str | None, n_workers: int) -> Iterator[Client]:
    """
    A client of a scheduler, or of workers on this machine that end with the block.

    Raises
    ------
    ParameterError
        When dask is missing, or no scheduler answers.
    SimulationError
        When workers do not start on this machine.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.system import MEMORY_LIMIT
    except ImportError:
        raise ParameterError(
            "sweep", "needs dask.distributed; install it with: pip install 'foveasim[explore]'"
        ) from None
    if scheduler is not None:
        _check_answer(scheduler)
        with _silent():
            client = Client(scheduler, timeout=SCHEDULER_S, set_as_default=False)
            try:
                yield client
            finally:
                with suppress(Exception):
                    client.close(timeout=2)
        return
    # A worker's end is ours to judge: each point is tried again, alone, and counted.
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0, "distributed.scheduler.work-stealing": False}),
        ExitStack() as opened,
    ):
        try:
            cluster = opened.enter_context(
                LocalCluster(
                    n_workers=n_workers,
                    threads_per_worker=1,
                    memory_limit=MEMORY_LIMIT // n_workers,
                    # No dashboard: only so does dask not ask for the one port of another's, and warn where that has it.
                    dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    preload=[run_tasks.__module__],
                    silence_logs=logging.CRITICAL,
                )
            )
            client = opened.enter_context(Client(cluster, set_as_default=False))
        except Exception as error:  # noqa: BLE001 -- a machine without memory or time for them makes them fail in many ways
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SimulationError(
                f"the workers did not start ({reason:.160}); try it again, or with fewer of them"
            ) from None
        yield client


@contextmanager
def _silent() -> Iterator[None]:
    """Without what dask logs of a lost connection, which is told in a sentence."""
    logs = [logging.getLogger(name) for name in ("distributed.client", "distributed.core")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


def _check_answer(scheduler: str) -> None:
    """Ask a scheduler who it is: a client that found none would not let go of the program for a while."""
    from distributed import rpc

    async def answer() -> Any:
        async with rpc(scheduler) as asked:
            return await asyncio.wait_for(asked.identity(), SCHEDULER_S)

    try:
        # In a thread of its own: a notebook has an event loop in this one.
        with ThreadPoolExecutor(1) as pool:
            is_scheduler = pool.submit(lambda: asyncio.run(answer())).result().get("type") == "Scheduler"
        reason = "it is something else"
    except Exception as error:  # noqa: BLE001 -- what is no scheduler may answer anything
        is_scheduler, reason = False, " ".join(str(error).split()) or type(error).__name__
    if not is_scheduler:
        raise ParameterError(
            "scheduler",
            f"must be the address of a dask scheduler that answers within {SCHEDULER_S:g} s ({reason:.160})",
            scheduler,
        )


@dataclass(eq=False)
class _Run:
    """Consecutive points, which the worker that works on them likely has the parts for."""

    points: deque[int]
    worker: str | None = None


@dataclass(eq=False)
class _Bundle:
    """Points that were sent to a worker together."""

    points: list[int]
    worker: str
    is_alone: bool


@dataclass(eq=False)
class _Work:
    """What is still to be sent, and what is at the workers."""

    runs: list[_Run]
    alone: deque[int] = field(default_factory=deque)
    deaths: dict[int, int] = field(default_factory=dict)
    sent: dict[Any, _Bundle] = field(default_factory=dict)
    #: Seconds that a point took, lately.
    point_s: float | None = None

    def bundles_at(self, worker: str) -> list[_Bundle]:
        return [bundle for bundle in self.sent.values() if bundle.worker == worker]

    def next_for(self, worker: str, n_workers: int) -> tuple[list[int], bool] | None:
        """The next points for a worker; alone with it, when they ended one before."""
        here = self.bundles_at(worker)
        if any(bundle.is_alone for bundle in here) or len(here) >= AT_A_WORKER:
            return None
        if self.alone:
            return None if here else ([self.alone.popleft()], True)
        run = self._run_of(worker)
        if run is None:
            return None
        n = 1 if self.point_s is None else int(BUNDLE_S / max(self.point_s, 1e-6))
        n = max(1, min(n, LARGEST_BUNDLE, -(-len(run.points) // (2 * max(n_workers, 1)))))
        points = [run.points.popleft() for _ in range(min(n, len(run.points)))]
        if not run.points:
            self.runs.remove(run)
        return points, False

    def _run_of(self, worker: str) -> _Run | None:
        """The worker's own run, one that nobody has, or the second half of the longest."""
        if not self.runs:
            return None
        own = next((run for run in self.runs if run.worker == worker), None)
        if own is None:
            own = next((run for run in self.runs if run.worker is None), None)
        if own is None:
            longest = max(self.runs, key=lambda run: len(run.points))
            half = len(longest.points) // 2
            if half == 0:
                own = longest
            else:
                own = _Run(deque(longest.points.pop() for _ in range(half)))
                own.points.reverse()
                self.runs.append(own)
        own.worker = worker
        return own

    def lost(self, workers: set[str]) -> None:
        """Runs of workers that are gone are anyone's."""
        for run in self.runs:
            if run.worker not in workers:
                run.worker = None


def records_of(
    client: Client,
    job: bytes,
    task_of: Callable[[int], Task],
    runs: Sequence[Sequence[int]],
) -> Iterator[Record]:
    """
    The records of points, as they are done.

    Parameters
    ----------
    client : distributed.Client
    job : bytes
        What all points have in common, pickled.
    task_of : callable
        The task of a point's number.
    runs : sequence of sequences of int
        Points that have costly parts in common, one run for a worker to begin with.

    Raises
    ------
    SimulationError
        When the scheduler or all workers are gone, or workers cannot run points at all.
    """
    work = _Work([_Run(deque(run)) for run in runs if len(run)])
    done: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
    workers: set[str] = set()
    counted_s = seen_s = float("-inf")
    try:
        while work.runs or work.alone or work.sent:
            now_s = time.monotonic()
            if now_s - counted_s > COUNT_S:
                counted_s = now_s
                workers = _workers(client)
                seen_s = now_s if workers or seen_s < 0.0 else seen_s
                work.lost(workers)
                if not workers and now_s - seen_s > WORKERS_S:
                    raise SimulationError(f"the scheduler has had no worker for {WORKERS_S:g} s")
            for worker in sorted(workers):
                while (chosen := work.next_for(worker, len(workers))) is not None:
                    points, is_alone = chosen
                    future = client.submit(
                        run_tasks,
                        job,
                        versions(),
                        [task_of(point) for point in points],
                        pure=False,
                        workers=[worker],
                        allow_other_workers=True,
                    )
                    work.sent[future] = _Bundle(points, worker, is_alone)
                    future.add_done_callback(done.put)
            try:
                future = done.get(timeout=COUNT_S)
            except queue.Empty:
                continue
            yield from _arrived(work, future, work.sent.pop(future))
            # Count anew when a worker may have gone.
            if future.status != "finished":
                counted_s = float("-inf")
    finally:
        with suppress(Exception):
            client.cancel(list(work.sent))


def _arrived(work: _Work, future: Future[Any], bundle: _Bundle) -> list[Record]:
    """The records of a bundle; points of a worker that ended are put back."""
    from distributed import KilledWorker

    try:
        records, spent_s = future.result()
    except KilledWorker:
        return list(_again(work, bundle))
    except (CancelledError, TimeoutError, OSError):
        raise SimulationError("the scheduler does not answer any more") from None
    except Exception as error:  # noqa: BLE001 -- whatever a worker without the package, or without a metric's module, raises
        raise SimulationError(f"the workers cannot run the points: {' '.join(str(error).split()):.300}") from None
    took_s = spent_s / len(records)
    work.point_s = took_s if work.point_s is None else 0.5 * (work.point_s + took_s)
    return list(records)


def _again(work: _Work, bundle: _Bundle) -> Iterator[Record]:
    for point in bundle.points:
        work.deaths[point] = work.deaths.get(point, 0) + 1
        if work.deaths[point] < MOST_DEATHS:
            work.alone.append(point)
        else:
            yield Record(point, {}, f"ended its worker {MOST_DEATHS} times: too little memory, or a crash in a metric")


def _workers(client: Client) -> set[str]:
    try:
        return set(client.nthreads())
    except Exception:  # noqa: BLE001 -- a connection can break in many ways
        raise SimulationError("the scheduler does not answer any more") from None
