"""Points to the workers of dask, and their records back: neighbours to the same worker, and none lost with a worker."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from foveasim._core.provenance import versions
from foveasim.errors import SimulationError
from foveasim.explore._records import Record
from foveasim.explore.cluster import Worker, Workers
from foveasim.explore.worker_cache import Task, run_tasks

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["records_of"]

#: Time that all workers may be away.
WORKERS_S = 60.0
#: Points that take less are sent together, so many seconds' worth, and no more than this many.
BUNDLE_S, LARGEST_BUNDLE = 0.05, 64
#: Bundles at a worker: one that it works on, and one that waits.
AT_A_WORKER = 2
#: A point that ended its worker so often is not tried again.
MOST_DEATHS = 2
#: How often the workers are counted.
COUNT_S = 1.0


@dataclass(eq=False)
class _Run:
    """Consecutive points, which the worker that works on them likely has the parts for."""

    points: deque[int]
    worker: Worker | None = None


@dataclass(eq=False)
class _Bundle:
    """Points that were sent to a worker together."""

    points: list[int]
    worker: Worker
    is_alone: bool
    #: So long its records may take to come from the worker, before we look whether that is still there.
    patience_s: float = COUNT_S


@dataclass(eq=False)
class _Work:
    """What is still to be sent, and what is at the workers."""

    runs: list[_Run]
    alone: deque[int] = field(default_factory=deque)
    deaths: dict[int, int] = field(default_factory=dict)
    sent: dict[Any, _Bundle] = field(default_factory=dict)
    #: Seconds that a point took, lately.
    point_s: float | None = None

    def bundles_at(self, worker: Worker) -> list[_Bundle]:
        return [bundle for bundle in self.sent.values() if bundle.worker == worker]

    def next_for(self, worker: Worker, n_workers: int) -> tuple[list[int], bool] | None:
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

    def _run_of(self, worker: Worker) -> _Run | None:
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

    def lost(self, workers: set[Worker]) -> None:
        """Runs of all but these workers are anyone's."""
        for run in self.runs:
            if run.worker not in workers:
                run.worker = None

    def put_back(self, bundle: _Bundle) -> None:
        """Points that were not begun."""
        if bundle.is_alone:
            self.alone.extend(bundle.points)
        else:
            self.runs.append(_Run(deque(bundle.points)))


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
    workers = Workers(client)
    counted_s, seen_s = float("-inf"), time.monotonic()
    try:
        while work.runs or work.alone or work.sent:
            now_s = time.monotonic()
            if now_s - counted_s > COUNT_S:
                counted_s = now_s
                workers.count()
                work.lost(workers.able)
                yield from _taken_back(client, work, workers)
                if workers.able or work.sent:
                    seen_s = now_s
                elif now_s - seen_s > WORKERS_S:
                    raise SimulationError(_absence(workers))
            for worker in sorted(workers.able):
                while (chosen := work.next_for(worker, len(workers.able))) is not None:
                    points, is_alone = chosen
                    future = client.submit(
                        run_tasks,
                        job,
                        versions(),
                        worker.folder,
                        [task_of(point) for point in points],
                        pure=False,
                        # Nowhere else, whatever dask thinks: only so do we know what ended with a worker.
                        workers=[worker.address],
                    )
                    work.sent[future] = _Bundle(points, worker, is_alone)
                    future.add_done_callback(done.put)
            try:
                future = done.get(timeout=COUNT_S)
            except queue.Empty:
                continue
            if future not in work.sent:
                continue  # it was taken back
            bundle = work.sent.pop(future)
            records = _arrived(work, future, bundle)
            # Count the workers again when one may have ended.
            if records is None or future.status != "finished":
                counted_s = float("-inf")
            if records is None:
                # They may have gone with their worker; if not, they take long to come.
                bundle.patience_s *= 2.0
                work.sent[future] = bundle
                done.put(future)
                continue
            # Release the future: dask would compute it again if its worker ended now.
            del future
            yield from records
    finally:
        with suppress(Exception):
            client.cancel(list(work.sent))


def _taken_back(client: Client, work: _Work, workers: Workers) -> Iterator[Record]:
    """Take back what never comes: all that is at workers that ended, and what waits at those that are stuck."""
    for future, bundle in list(work.sent.items()):
        is_ended = bundle.worker not in workers.here and future.status != "error"
        if is_ended or (bundle.worker in workers.stuck and future.status == "pending"):
            client.cancel([future])
            del work.sent[future]
            if is_ended:
                yield from _again(work, bundle)
            else:
                work.put_back(bundle)


def _arrived(work: _Work, future: Future[Any], bundle: _Bundle) -> list[Record] | None:
    """The records of a bundle, None while they do not come; points of a worker that ended are put back."""
    from distributed import KilledWorker

    try:
        if future.status in ("error", "cancelled"):
            future.result()
        # The future's own result() could not be given up without dask's words on the screen.
        gather = partial(future.client.gather, [future], errors="skip", asynchronous=True)
        found = future.client.sync(gather, callback_timeout=bundle.patience_s)
    except TimeoutError:
        return None
    except KilledWorker:
        return list(_again(work, bundle))
    except (CancelledError, OSError):
        raise SimulationError("the scheduler does not answer any more") from None
    except Exception as error:  # noqa: BLE001 -- whatever a worker without the package, or without a metric's module, raises
        raise SimulationError(f"the workers cannot run the points: {' '.join(str(error).split()):.300}") from None
    if not found:
        return None
    if found[0] is None:  # dask tried them again by itself, in a worker that was begun anew
        return list(_again(work, bundle))
    records, spent_s = found[0]
    took_s = spent_s / len(records)
    work.point_s = took_s if work.point_s is None else 0.5 * (work.point_s + took_s)
    return list(records)


def _again(work: _Work, bundle: _Bundle) -> Iterator[Record]:
    """Try the points of a worker that ended again, each alone; the records of those that had their chance."""
    for point in bundle.points:
        work.deaths[point] = work.deaths.get(point, 0) + 1
        if work.deaths[point] < MOST_DEATHS:
            work.alone.append(point)
        else:
            yield Record(point, {}, f"ended its worker {MOST_DEATHS} times: too little memory, or a crash in a metric")


def _absence(workers: Workers) -> str:
    """Why points are not taken."""
    if workers.here:
        return f"the workers have taken no points for {WORKERS_S:g} s: they are paused, for their memory is full, or closing"
    return f"the scheduler has had no worker for {WORKERS_S:g} s"
