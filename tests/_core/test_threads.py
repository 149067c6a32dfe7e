"""Threads: pieces of work come back in order, may spread work in their turn, and end together when one of them fails."""

from __future__ import annotations

import multiprocessing
import threading
import time
import warnings

import pytest

from foveasim._core.threads import each, in_order


@pytest.mark.parametrize("n_threads", [1, 2, 3, 50])
def test_results_come_in_the_order_of_the_items_whatever_takes_longest(n_threads):
    def work(k: int) -> int:
        time.sleep(0.002 * (5 - k % 6))
        return k * k

    assert each(work, iter(range(24)), n_threads) == [k * k for k in range(24)]


def test_nothing_to_do_gives_nothing():
    assert each(lambda item: item, [], 4) == []


def test_threads_work_at_the_same_time():
    both = threading.Barrier(2, timeout=60.0)
    each(lambda _: both.wait(), range(2), 2)


def test_pieces_may_spread_work_in_their_turn_however_many_there_are():
    def row(k: int) -> int:
        return sum(each(lambda j: j * k, range(20), 4))

    assert each(row, range(200), 4) == [190 * k for k in range(200)]


@pytest.mark.parametrize("n_threads", [1, 2, 8])
def test_the_first_error_in_the_order_of_the_items_is_raised_and_nothing_runs_on(n_threads):
    running: list[int] = []

    def work(k: int) -> None:
        running.append(k)
        try:
            # The later one fails first.
            time.sleep(0.05 if k == 3 else 0.0)
            if k in (3, 4):
                raise ValueError(str(k))
        finally:
            running.remove(k)

    with pytest.raises(ValueError, match="3"):
        each(work, range(100), n_threads)
    assert not running


def _sum_of_squares(n: int) -> int:
    return sum(each(lambda k: k * k, range(n), 2))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system has no fork")
def test_a_forked_process_has_threads_of_its_own():
    both = threading.Barrier(2, timeout=60.0)
    each(lambda _: both.wait(), range(2), 2)  # the parent's threads are there
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads, which is what this is about
        with multiprocessing.get_context("fork").Pool(1) as pool:
            assert pool.apply_async(_sum_of_squares, (100,)).get(timeout=60.0) == sum(k * k for k in range(100))


def test_items_are_taken_no_further_than_so_many_ahead():
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
