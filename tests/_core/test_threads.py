"""Threads: order of results, nested calls, errors and forked processes."""

from __future__ import annotations

import multiprocessing
import threading
import time
import warnings

import pytest
from waiting import DEADLINE_S

from foveasim._core.threads import in_order, parallel_map


@pytest.mark.parametrize("n_threads", [1, 2, 3, 50])
def test_results_are_in_item_order(n_threads):
    def work(k: int) -> int:
        time.sleep(0.002 * (5 - k % 6))
        return k * k

    assert parallel_map(work, iter(range(24)), n_threads) == [k * k for k in range(24)]


def test_no_items_give_no_results():
    assert parallel_map(lambda item: item, [], 4) == []


def test_threads_run_concurrently():
    barrier = threading.Barrier(2, timeout=DEADLINE_S)
    parallel_map(lambda _: barrier.wait(), range(2), 2)


def test_nested_calls_do_not_deadlock():
    def row(k: int) -> int:
        return sum(parallel_map(lambda j: j * k, range(20), 4))

    assert parallel_map(row, range(200), 4) == [190 * k for k in range(200)]


@pytest.mark.parametrize("n_threads", [1, 2, 8])
def test_first_error_is_raised_after_joining(n_threads):
    running: list[int] = []

    def work(k: int) -> None:
        running.append(k)
        try:
            # The later item fails first.
            time.sleep(0.05 if k == 3 else 0.0)
            if k in (3, 4):
                raise ValueError(str(k))
        finally:
            running.remove(k)

    with pytest.raises(ValueError, match="3"):
        parallel_map(work, range(100), n_threads)
    assert not running


def _sum_of_squares(n: int) -> int:
    return sum(parallel_map(lambda k: k * k, range(n), 2))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="requires fork")
def test_forked_process_starts_new_threads():
    barrier = threading.Barrier(2, timeout=DEADLINE_S)
    parallel_map(lambda _: barrier.wait(), range(2), 2)  # starts the threads of the parent
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads is tested here
        with multiprocessing.get_context("fork").Pool(1) as pool:
            assert pool.apply_async(_sum_of_squares, (100,)).get(timeout=DEADLINE_S) == sum(k * k for k in range(100))


def test_items_are_taken_limited_number_ahead():
    taken: list[int] = []

    def items():
        for k in range(10):
            taken.append(k)
            yield k

    results = in_order(lambda k: -k, items(), 2, 3)
    assert next(results) == 0
    assert taken == [0]
    assert next(results) == -1
    assert taken == [0, 1, 2, 3, 4]
    assert list(results) == [-k for k in range(2, 10)]
