"""Parallel evaluation of a function over many items, on dask workers or in process."""

from __future__ import annotations

import heapq
import itertools
import queue
import sys
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

from foveasim._core.calls import Limits
from foveasim._core.provenance import find_user_module, versions
from foveasim.errors import FoveasimError, SimulationError
from foveasim.explore.cluster import WorkerStates, check_installed, open_client

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["KILLED", "MAX_DEATHS", "WORKERS", "Run", "executor"]

#: Result of an item whose worker ended in every attempt.
KILLED: Any = object()
#: Duration of a chunk on a worker, seconds. An interruption loses at most the results of one chunk per worker.
CHUNK_S = 0.5
#: Chunks per second that one scheduler can process: chunks are longer with more workers.
CHUNKS_PER_S = 1000.0
#: Largest number of items per chunk.
MAX_ITEMS = 1024
#: Number of ended workers after which an item is not retried.
MAX_DEATHS = 3
#: Longest time without any worker, seconds.
NO_WORKER_TIMEOUT_S = 60.0
#: Interval between updates of the worker list, seconds.
POLL_S = 1.0
#: Limits of the number of local processes; 0 is this process.
WORKERS = Limits(at_least=0, at_most=1024)

#: Computes items and yields each with its result, or with KILLED, in order of completion. The second argument contains the
#: positions, in ascending order, at which costly shared components of the items change.
Run = Callable[[Sequence[Any], Sequence[int]], Iterator[tuple[Any, Any]]]


@contextmanager
def executor(
    function: Callable[[Any], Any],
    *,
    what: str,
    users: Iterable[Callable[..., Any]] = (),
    scheduler: str | None = None,
    workers: int = 0,
) -> Iterator[Run]:
    """
    Start workers that evaluate one function.

    ``function``: function of an item that returns its result. Each worker process has one copy, which may cache shared
    components. ``what``: name of the user objects in the function, for the message when it cannot be pickled. ``users``: user
    functions inside ``function``. Their modules are pickled by value, so workers need not import them. ``scheduler``: address
    of a dask scheduler; by default local worker processes. ``workers``: number of local processes; 0 evaluates in this
    process, without dask. Yields ``run``: see :data:`Run`. A ``FoveasimError`` of the function ends the run. Raises
    ParameterError when dask is not installed, or no scheduler answers. Raises SimulationError when workers do not start, or
    the function cannot be pickled; from ``run`` when the scheduler or all workers are lost, or workers cannot evaluate the
    function at all.

    Dask restarts local workers, detects live workers and lost tasks, and copies the function to each worker. Its queue would
    distribute neighbouring items, which share compiled layouts and optical images, to all workers in turn, and each worker
    would build the same components. Each worker therefore gets a range of neighbouring items, in tasks of about 0.5 s, and a
    worker without a range gets half of the longest range, at a cost of O(log n_worker) per task. After the loss of a worker,
    the items of its task are retried one by one, so that an item that crashes affects no other item.
    """
    if scheduler is None and workers == 0:
        yield lambda items, _cuts: ((item, function(item)) for item in items)
        return
    check_installed()
    payload = _pickle(function, what, users)
    with open_client(scheduler, workers) as client:
        shared = client.submit(_Shared, payload, versions(), pure=False)
        yield lambda items, cuts: _Dispatch(client, shared, items, cuts).run()


def _pickle(function: Callable[[Any], Any], what: str, users: Iterable[Callable[..., Any]]) -> bytes:
    import cloudpickle

    names = {find_user_module(user) for user in users} - {None, "__main__"}
    modules = [sys.modules[name] for name in names if name is not None]
    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        return bytes(cloudpickle.dumps(function))
    except Exception as error:  # noqa: BLE001 -- objects may raise anything when they are pickled
        raise SimulationError(f"{what} cannot be sent to other processes ({_one_line(error)})") from None
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)


def _one_line(error: BaseException) -> str:
    return f"{' '.join(str(error).split()) or type(error).__name__:.300}"


# -- on the client ----------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Range:
    """Range of consecutive item positions that are not sent yet."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(eq=False)
class _Chunk:
    """Item positions that were sent to a worker in one task."""

    positions: range
    worker: str
    is_single: bool
    #: Timeout of the transfer of its results, seconds; then the worker list is updated.
    timeout_s: float = POLL_S


class _Dispatch:
    """
    Dispatch of the items of one run.

    Attributes
    ----------
    ranges : dict of str to _Range
        Unsent items of each worker, by address.
    free : list of _Range
        Ranges without a worker.
    heap : list of (int, int, _Range)
        All ranges of workers, longest first: negative length at insertion, serial number, range.
    retries : deque of range
        Items of lost workers, to be sent one by one.
    """

    def __init__(self, client: Client, shared: Future[Any], items: Sequence[Any], cuts: Sequence[int]) -> None:
        self.client, self.shared, self.items, self.cuts = client, shared, items, cuts
        self.free = [_Range(0, len(items))]
        self.ranges: dict[str, _Range] = {}
        self.heap: list[tuple[int, int, _Range]] = []
        self.numbers = itertools.count()
        self.retries: deque[range] = deque()
        self.deaths: dict[int, int] = {}
        self.sent: dict[Any, _Chunk] = {}
        self.idle: set[str] = set()
        self.states = WorkerStates(client)
        self.done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.item_s: float | None = None
        self.polled_s = float("-inf")
        self.alive_s = time.monotonic()
        self.n_left = len(items)

    def run(self) -> Iterator[tuple[Any, Any]]:
        """Yield each item with its result, in order of completion."""
        try:
            while self.n_left:
                if time.monotonic() - self.polled_s > POLL_S:
                    self._poll()
                    yield from self._yield_results(self._cancel_lost())
                self._send()
                try:
                    future = self.done.get(timeout=POLL_S)
                except queue.Empty:
                    continue
                yield from self._yield_results(self._receive(future))
        finally:
            with suppress(Exception):
                self.client.cancel(list(self.sent))

    def _yield_results(self, results: Iterable[tuple[int, Any]]) -> Iterator[tuple[Any, Any]]:
        for position, result in results:
            self.n_left -= 1
            yield self.items[position], result

    # -- workers --------------------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        """Update the sets of live and idle workers."""
        self.states.update()
        self.polled_s = time.monotonic()
        self.idle = self.states.running - {chunk.worker for chunk in self.sent.values()}
        for worker in self.ranges.keys() - self.states.running:
            remaining = self.ranges.pop(worker)
            if remaining:
                self.free.append(remaining)
        if self.states.running or self.states.n_executing:
            self.alive_s = self.polled_s
        elif self.polled_s - self.alive_s > NO_WORKER_TIMEOUT_S:
            raise SimulationError(
                f"no worker has computed anything for {NO_WORKER_TIMEOUT_S:g} s: all are closing, or paused because of full "
                "memory"
                if self.states.alive
                else f"the scheduler has had no worker for {NO_WORKER_TIMEOUT_S:g} s"
            )

    def _cancel_lost(self) -> Iterator[tuple[int, Any]]:
        """Cancel the chunks of lost workers, and those that wait at paused workers."""
        for future, chunk in list(self.sent.items()):
            is_dead = chunk.worker not in self.states.alive and future.status != "error"
            if is_dead or (chunk.worker in self.states.stuck and future.status == "pending"):
                del self.sent[future]
                self.client.cancel([future])
                if is_dead:
                    yield from self._retry(chunk)
                else:
                    self._requeue(chunk)

    def _send(self) -> None:
        """Send a chunk to each idle worker."""
        while self.idle:
            worker = self.idle.pop()
            chunk = self._next(worker)
            if chunk is None:
                self.idle.add(worker)
                return
            future = self.client.submit(
                _compute,
                self.shared,
                [self.items[position] for position in chunk.positions],
                self._chunk_s(),
                pure=False,
                # On the worker of the neighbouring items. Dask must not retry the chunk on another worker after a loss.
                workers=[worker],
            )
            self.sent[future] = chunk
            future.add_done_callback(self.done.put)

    def _chunk_s(self) -> float:
        return max(CHUNK_S, len(self.states.running) / CHUNKS_PER_S)

    # -- items ----------------------------------------------------------------------------------------------------------

    def _next(self, worker: str) -> _Chunk | None:
        """Return the next chunk of a worker: of its range, a free range, or half of the longest."""
        if self.retries:
            return _Chunk(self.retries.popleft(), worker, is_single=True)
        own = self.ranges.get(worker)
        if not own:
            own = self.free.pop() if self.free else self._split_longest()
            if own is None:
                return None
            self._assign(worker, own)
        n = 1 if self.item_s is None else int(self._chunk_s() / max(self.item_s, 1e-9))
        n = max(1, min(n, MAX_ITEMS, (len(own) + 1) // 2))
        own.start += n
        return _Chunk(range(own.start - n, own.start), worker, is_single=False)

    def _assign(self, worker: str, own: _Range) -> None:
        self.ranges[worker] = own
        self._push(own)

    def _push(self, own: _Range) -> None:
        heapq.heappush(self.heap, (-len(own), next(self.numbers), own))

    def _split_longest(self) -> _Range | None:
        """Cut off the second half of the longest range, near a change of shared components."""
        while self.heap:
            length, _, longest = heapq.heappop(self.heap)
            if len(longest) < -length:  # items were taken since
                if longest:
                    self._push(longest)
                continue
            midpoint = (longest.start + longest.stop) // 2
            near = bisect_left(self.cuts, midpoint)
            cut = min(self.cuts[max(near - 1, 0) : near + 1], key=lambda cut: abs(cut - midpoint), default=midpoint)
            if abs(cut - midpoint) > len(longest) // 4:
                cut = midpoint
            half = _Range(cut, longest.stop)
            longest.stop = cut
            if longest:
                self._push(longest)
            return half
        return None

    def _requeue(self, chunk: _Chunk, n_done: int = 0) -> None:
        """Move the uncomputed items of a chunk back to the unsent ranges."""
        remaining = chunk.positions[n_done:]
        if not remaining:
            return
        own = self.ranges.get(chunk.worker)
        if chunk.is_single:
            self.retries.append(remaining)
        elif own is not None and own.start == remaining.stop:
            own.start = remaining.start
            self._push(own)
        else:
            self.free.append(_Range(remaining.start, remaining.stop))

    def _receive(self, future: Future[Any]) -> Iterator[tuple[int, Any]]:
        """Yield the positions and results of a chunk, or retry the items of a lost worker."""
        chunk = self.sent.pop(future, None)
        if chunk is None:  # cancelled before
            return
        try:
            results = self._result(future, chunk.timeout_s)
        except TimeoutError:
            # The results may be lost with their worker; dask then computes them again.
            self.polled_s = float("-inf")
            chunk.timeout_s *= 2.0
            self.sent[future] = chunk
            self.done.put(future)
            return
        if chunk.worker in self.states.running:
            self.idle.add(chunk.worker)
        if results is None:
            self.polled_s = float("-inf")
            yield from self._retry(chunk)
            return
        took_s = results.took_s / max(len(results.values), 1)
        self.item_s = took_s if self.item_s is None else 0.5 * (self.item_s + took_s)
        self._requeue(chunk, len(results.values))
        yield from zip(chunk.positions, results.values, strict=False)

    def _result(self, future: Future[Any], timeout_s: float) -> _Results | None:
        """Return the results of a chunk, or None when its worker ended."""
        from distributed import KilledWorker

        try:
            if future.status in ("error", "cancelled"):
                future.result()
            # Unlike gather, Future.result() logs an error on a timeout.
            gather = partial(self.client.gather, [future], errors="skip", asynchronous=True)
            found: list[_Results] = self.client.sync(gather, callback_timeout=timeout_s)
        except KilledWorker:
            return None
        except TimeoutError:
            raise
        except (CancelledError, OSError):
            raise SimulationError("the scheduler no longer answers") from None
        except FoveasimError as error:
            raise error from None  # without the traceback of the worker
        except Exception as error:  # noqa: BLE001 -- workers without the package or a module may raise anything
            raise SimulationError(f"the workers cannot compute: {_one_line(error)}") from None
        if not found:
            raise TimeoutError
        return found[0]

    def _retry(self, chunk: _Chunk) -> Iterator[tuple[int, Any]]:
        """Retry the items of a lost worker one by one; yield KILLED for the last attempt."""
        for position in chunk.positions:
            self.deaths[position] = self.deaths.get(position, 0) + 1
            if chunk.is_single and self.deaths[position] >= MAX_DEATHS:
                yield position, KILLED
            else:
                self.retries.append(range(position, position + 1))


# -- on a worker ------------------------------------------------------------------------------------------------------

#: Serialises items within a process: a camera uses all its threads.
_lock = Lock()


class _Results(NamedTuple):
    """Results of the first items of a chunk, and their computing time in seconds."""

    values: list[Any]
    took_s: float


class _Shared:
    """
    Function of a run, unpickled once in each process.

    Dask stores it in the memory of its workers for the duration of the run, and copies it to workers that join later.
    """

    def __init__(self, payload: bytes, of_client: Mapping[str, str]) -> None:
        self._payload, self._versions = payload, dict(of_client)
        self._function: Callable[[Any], Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_function": None}

    def __sizeof__(self) -> int:
        return len(self._payload)

    def function(self) -> Callable[[Any], Any]:
        """
        Return the function, as the same object in every call.

        Raises RuntimeError when this process has other versions of the libraries: its results might differ.
        """
        import cloudpickle

        if self._function is None:
            local_versions = versions()
            differing = [name for name in self._versions if local_versions.get(name) != self._versions[name]]
            if differing:
                theirs = ", ".join(f"{name} {local_versions.get(name)}" for name in differing)
                ours = ", ".join(f"{name} {self._versions[name]}" for name in differing)
                raise RuntimeError(f"a worker has {theirs}, but the client has {ours}")
            self._function = cloudpickle.loads(self._payload)
        return self._function


def _compute(shared: _Shared, items: Sequence[Any], limit_s: float) -> _Results:
    """Compute at least one item, and more until the time limit."""
    with _lock:
        function = shared.function()
        begin_s = time.perf_counter()
        values: list[Any] = []
        for item in items:
            values.append(function(item))
            if time.perf_counter() - begin_s > limit_s:
                break
        return _Results(values, time.perf_counter() - begin_s)
