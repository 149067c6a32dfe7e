"""Bounded cache: values are computed once, and limited in number."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest
from waiting import wait_until

from foveasim._core.caches import BoundedCache


def test_value_is_computed_once():
    cache, calls = BoundedCache(4), []

    found = [cache.get("key", lambda: calls.append(0) or len(calls)) for _ in range(3)]

    assert found == [1, 1, 1]


def test_number_of_values_is_limited():
    cache = BoundedCache(8)

    for key in range(1000):
        assert cache.get(key, lambda key=key: -key) == -key
        assert len(cache) <= 8


def test_values_in_use_are_retained():
    cache, computed = BoundedCache(8), []

    for key in range(200):
        for common in ("a", "b", "c"):
            cache.get(common, lambda common=common: computed.append(common))
        cache.get(key, lambda: None)

    assert computed == ["a", "b", "c"]


def test_failed_computation_is_repeated():
    cache = BoundedCache(2)

    with pytest.raises(ZeroDivisionError):
        cache.get(0, lambda: 1 // 0)

    assert cache.get(0, lambda: 5) == 5


def test_values_may_use_other_values():
    cache = BoundedCache(1)

    assert cache.get("sum", lambda: cache.get("one", lambda: 1) + cache.get("two", lambda: 2)) == 3
    assert len(cache) == 1


def test_threads_share_computation():
    cache, asked, calls = BoundedCache(4), [], []

    def compute():
        wait_until(lambda: len(asked) == 8)
        calls.append(0)
        return object()

    def ask(number):
        asked.append(number)
        return id(cache.get("key", compute))

    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(ask, range(50)))

    assert len(found) == len(calls) == 1


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda cache: pickle.loads(pickle.dumps(cache))])
def test_copies_are_empty(duplicate):
    cache = BoundedCache(3)
    cache.get(0, lambda: 1)

    again = duplicate(cache)

    assert (len(again), again.max_values, len(cache)) == (0, 3, 1)
    assert again.get(0, lambda: 2) == 2
