"""Thread count, execution of independent tasks on threads, and locks in forked processes."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from threading import RLock
from typing import Any, TypeVar
from weakref import WeakSet

from foveasim._core.validation import check_count

#: Smallest size of the thread pool: users may request more threads than there are cores.
MIN_POOL_THREADS = 8
#: Largest number of threads that can be requested, above the number of cores of any machine.
MAX_THREADS = 4096
#: Option of mallopt that limits the number of heaps; the smallest limit; number of threads that share one heap.
M_ARENA_MAX, MIN_HEAPS, THREADS_PER_HEAP = -8, 2, 4

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class cached_property(functools.cached_property[_Result]):  # noqa: N801 -- replaces that of Python
    """
    Cached property without a lock.

    Threads that compute it at the same time receive the same object. ``functools.cached_property`` of Python 3.11 has one lock
    for all instances of a class: a process that is forked while a thread holds the lock could never compute the property.
    """

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        if instance is None:
            return self
        values = vars(instance)
        assert self.attrname is not None
        if self.attrname not in values:
            values.setdefault(self.attrname, self.func(instance))
        return values[self.attrname]


class ForkSafeLock:
    """Reentrant lock that is free in a forked process unless the forking thread holds it."""

    def __init__(self) -> None:
        self._lock = RLock()
        _LOCKS.add(self)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def renew(self) -> None:
        """Replace the lock unless this thread holds it: threads of the parent never release it."""
        if not self._lock._is_owned():  # type: ignore[attr-defined]  # noqa: SLF001 -- as Condition of the standard library
            self._lock = RLock()


_LOCKS: WeakSet[ForkSafeLock] = WeakSet()


def _renew_locks() -> None:
    for lock in list(_LOCKS):
        lock.renew()


#: Number of threads of calls that do not specify one, set by :func:`default_threads`; None: all available cores.
_default: ContextVar[int | None] = ContextVar("default_threads", default=None)


@contextmanager
def default_threads(n_threads: int) -> Iterator[None]:
    """Set the number of threads of all calls in the block that do not specify one."""
    token = _default.set(n_threads)
    try:
        yield
    finally:
        _default.reset(token)


def thread_count(n_threads: int | None = None) -> int:
    """
    Return the number of threads to use, by default all cores available to this process.

    Raises ParameterError when ``n_threads`` is not an integer from 1 to 4096.
    """
    if n_threads is not None:
        return check_count("n_threads", n_threads, at_most=MAX_THREADS)
    if (default := _default.get()) is not None:
        return default
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parallel_map(work: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int) -> list[_Result]:
    """
    Return ``[work(item) for item in items]``, computed on several threads.

    The first error is raised. Items must not depend on each other, and their sizes must not depend on ``n_threads``: results
    are then bit-identical for any number of threads.

    The calling thread also processes items, so that ``work`` may call this function without deadlock.
    """
    items = list(items)
    n_helpers = min(n_threads, len(items)) - 1
    if n_helpers <= 0:
        return [work(item) for item in items]
    waiting = deque(enumerate(items))
    results: dict[int, _Result] = {}
    errors: dict[int, BaseException] = {}

    def process_items() -> None:
        while waiting:
            try:
                number, item = waiting.popleft()
            except IndexError:  # another thread took the last item
                return
            try:
                results[number] = work(item)
            except BaseException as error:  # noqa: BLE001 -- raised by the calling thread
                errors[number] = error
                waiting.clear()

    helpers = [_pool().submit(process_items) for _ in range(n_helpers)]
    try:
        process_items()
    finally:
        waiting.clear()
        # Helpers that have not started have no items left and are cancelled.
        wait([helper for helper in helpers if not helper.cancel()])
    if errors:
        raise errors[min(errors)]
    return [results[number] for number in range(len(items))]


def _limit_heaps() -> None:
    """
    Limit the number of heaps (arenas) of glibc, unless environment variables set it.

    By default each thread has its own heap, which keeps freed memory between blocks in use. After 300 captures of different
    cameras and pictures on two cores, a process occupied 1031 MB with the default, and 806 MB with two heaps.
    """
    if sys.platform.startswith("linux") and not {"MALLOC_ARENA_MAX", "GLIBC_TUNABLES"} & os.environ.keys():
        with suppress(AttributeError, OSError):  # other C libraries
            ctypes.CDLL(None).mallopt(M_ARENA_MAX, max(MIN_HEAPS, thread_count() // THREADS_PER_HEAP))


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the thread pool of this process; starting threads takes as long as a small task."""
    _limit_heaps()
    return ThreadPoolExecutor(max(thread_count(), MIN_POOL_THREADS), thread_name_prefix="foveasim")


if hasattr(os, "register_at_fork"):
    # A forked process does not inherit the threads of its parent.
    os.register_at_fork(after_in_child=_pool.cache_clear)
    os.register_at_fork(after_in_child=_renew_locks)


def in_order(
    work: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int, n_ahead: int
) -> Iterator[_Result]:
    """
    Yield ``work(item) for item in items`` in order, computed in advance on threads.

    At most ``n_ahead`` results are computed in advance. The first item is processed alone: it may create data that the others
    share. With ``n_ahead=0`` no thread is started, and each item is processed when its result is requested.
    """
    remaining = iter(items)
    if n_ahead == 0:
        yield from map(work, remaining)
        return
    for item in remaining:
        yield work(item)
        break
    pool = ThreadPoolExecutor(min(n_threads, n_ahead))
    pending: deque[Future[_Result]] = deque()
    try:
        for item in remaining:
            pending.append(pool.submit(work, item))
            if len(pending) > n_ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
