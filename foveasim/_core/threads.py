"""Threads: how many there are, and one way to spread independent pieces of work over them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

from foveasim._core.validation import check_count

__all__ = ["each", "in_order", "thread_count"]

#: Threads that there may be at least, for who asks for more than there are cores.
LEAST_THREADS = 8
#: More than machines have cores.
MAX_THREADS = 4096

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def thread_count(n_threads: int | None = None) -> int:
    """
    The number of threads to use: the one asked for, or all the cores that this process may use.

    Raises
    ------
    ParameterError
        When it is not an integer from 1 to 4096.
    """
    if n_threads is not None:
        return check_count("n_threads", n_threads, at_most=MAX_THREADS)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def each(work: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int) -> list[_Result]:
    """
    ``[work(item) for item in items]`` on several threads; the first error is raised.

    The pieces must not depend on each other, nor their sizes on ``n_threads``: that is what makes results the
    same, bit for bit, for any number of threads.

    The calling thread works too, so that pieces may spread work in their turn: no thread waits for one that is not there.
    """
    items = list(items)
    n_helpers = min(n_threads, len(items)) - 1
    if n_helpers <= 0:
        return [work(item) for item in items]
    waiting = deque(enumerate(items))
    results: dict[int, _Result] = {}
    errors: dict[int, BaseException] = {}

    def some() -> None:
        while waiting:
            try:
                number, item = waiting.popleft()
            except IndexError:  # another thread took the last one
                return
            try:
                results[number] = work(item)
            except BaseException as error:  # noqa: BLE001 -- raised by the calling thread
                errors[number] = error
                waiting.clear()

    helpers = [_pool().submit(some) for _ in range(n_helpers)]
    try:
        some()
    finally:
        waiting.clear()
        # One that no thread has begun has nothing left to do.
        wait([helper for helper in helpers if not helper.cancel()])
    if errors:
        raise errors[min(errors)]
    return [results[number] for number in range(len(items))]


@cache
def _pool() -> ThreadPoolExecutor:
    """The threads of this process: they stay, as starting them takes as long as a small piece of work."""
    return ThreadPoolExecutor(max(thread_count(), LEAST_THREADS), thread_name_prefix="foveasim")


if hasattr(os, "register_at_fork"):
    # A child process has none of its parent's threads.
    os.register_at_fork(after_in_child=_pool.cache_clear)


def in_order(
    work: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int, n_ahead: int
) -> Iterator[_Result]:
    """
    ``work(item) for item in items``, lazily, with so many items worked on before they are asked for.

    The first one is worked on alone: it may make what the others share. With none ahead no thread is started, and each item is
    taken when its result is asked for.
    """
    remaining = iter(items)
    if n_ahead == 0:
        yield from map(work, remaining)
        return
    for item in remaining:
        yield work(item)
        break
    pool = ThreadPoolExecutor(min(n_threads, n_ahead))
    going_on: deque[Future[_Result]] = deque()
    try:
        for item in remaining:
            going_on.append(pool.submit(work, item))
            if len(going_on) > n_ahead:
                yield going_on.popleft().result()
        while going_on:
            yield going_on.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
