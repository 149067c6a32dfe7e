"""Work ahead of views: results that were started are taken, and others computed."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from waiting import DEADLINE_S

import foveasim as fs
from foveasim.config import build_shot
from foveasim.studio import _views
from foveasim.studio._costs import Costs
from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS, picture, rules, sites
from foveasim.studio._parts.ahead import Ahead

ONE, OTHER = (fs.layout.grid(n_x=n, n_y=2, pitch_um=1.0) for n in (2, 3))


@pytest.fixture
def calls():
    return []


@pytest.fixture
def counted(calls):
    def compute(layout, *values):
        calls.append((layout, values, threading.current_thread() is threading.main_thread()))
        return layout.n_sites + sum(values)

    return Ahead(compute)


def test_started_result_is_taken_once(counted, calls):
    counted.start(ONE, 5)
    results = [counted(ONE, 5), counted(ONE, 5)]

    assert results == [9, 9]
    assert calls[-1] == (ONE, (5,), True)
    assert len(calls) == 2


def test_result_of_other_values_is_computed(counted, calls):
    counted.start(ONE, 5)

    assert counted(ONE, 6) == 10
    assert (ONE, (6,), True) in calls
    assert counted(OTHER, 5) == 11


def test_work_that_has_not_begun_is_cancelled(calls):
    begin = threading.Event()
    busy = Ahead(lambda layout: begin.wait(DEADLINE_S))
    late = Ahead(lambda layout: calls.append(threading.current_thread() is threading.main_thread()))
    busy.start(ONE)
    late.start(OTHER)  # waits for the thread
    late.start(ONE)
    late(ONE)

    assert calls == [True]
    begin.set()
    assert busy(ONE)


def test_exception_of_work_reaches_caller():
    def fail(layout):
        raise ValueError("no result")

    failing = Ahead(fail)
    failing.start(ONE)

    with pytest.raises(ValueError, match="no result"):
        failing(ONE)


@pytest.mark.parametrize("many_sites", [0, 50_000])
def test_views_are_equal_with_work_ahead(settings, many_sites, calls, monkeypatch):
    for module in (picture, rules, sites):
        monkeypatch.setattr(module, "MANY_SITES", many_sites)
    expected = Engine(n_threads=1).simulate(settings)
    views = _views.Views(lambda message: None, lambda: None, str, Costs())
    found = Engine(n_threads=1, on_shot=lambda shot: (calls.append(shot), views.work_ahead(shot))).simulate(settings)

    assert len(calls) == 1
    for name in ("sites", "rules", "picture"):
        (about, arrays), (expected_about, expected_arrays) = (PARTS[name].make(one) for one in (found, expected))
        assert about == expected_about
        assert arrays.keys() == expected_arrays.keys()
        assert all(np.array_equal(arrays[key], expected_arrays[key]) for key in arrays)


def test_work_starts_once_for_a_layout(settings, monkeypatch, calls):
    shot = build_shot(None, settings)
    views = _views.Views(lambda message: None, lambda: None, str, Costs())
    monkeypatch.setattr(_views, "PARTS", {"rules": PARTS["rules"]})
    monkeypatch.setattr(Ahead, "start", lambda self, layout, *values: calls.append(layout))
    views.select(["rules"])
    for _ in range(3):
        views.work_ahead(shot)

    assert calls == [shot.camera.layout]
