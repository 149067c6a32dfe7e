"""Processes that are forked while another thread of their parent captures."""

from __future__ import annotations

import os
import signal
import threading
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from waiting import DEADLINE_S

import foveasim as fs
from foveasim._core.threads import ForkSafeLock, cached_property
from foveasim._core.work_arrays import _POOL, work_array
from foveasim.sensor import effects

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="requires fork")
#: Time limit of a forked process, seconds: it would wait forever.
LIMIT_S = 60
PARENT = os.getpid()
IN_PATTERN, MAY_END = threading.Event(), threading.Event()
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8)
SCENE = fs.Scene.flat(
    shape=(60, 80), pitch_um=100.0, distance_m=0.5, radiance_w_m2_sr_nm=0.01, wavelength_nm=(450.0, 550.0)
)


@dataclass(frozen=True)
class Waiting(effects.FixedFactor):
    """A pattern whose computation waits in one thread of the parent."""

    name = "waiting"
    stage = "expected"

    def pattern(self, sites):
        if os.getpid() == PARENT and threading.current_thread() is not threading.main_thread():
            IN_PATTERN.set()
            MAY_END.wait(LIMIT_S)
        return np.full(sites.n_sites, 0.5)


def status_of_fork(work):
    """Return the exit status of a forked process that does work; a process that waits is terminated by a signal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads is tested here
        child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LIMIT_S // 2)
        try:
            work()
        except BaseException:  # noqa: BLE001 -- any error is reported by the status
            os._exit(1)
        os._exit(0)
    return os.waitpid(child, 0)[1]


def make_camera():
    return fs.Camera(optics=OPTICS, sensor=fs.Sensor(fs.layout.grid(20, 10, 3.0), effects=(Waiting(),)))


def test_forked_process_captures_during_capture():
    fs.Camera(optics=OPTICS, sensor=fs.Sensor(fs.layout.grid(20, 10, 3.0))).capture(SCENE, exposure_s=0.01, seed=0)
    camera, codes = make_camera(), []
    thread = threading.Thread(target=lambda: codes.append(camera.capture(SCENE, exposure_s=0.01, seed=0).code))
    thread.start()
    assert IN_PATTERN.wait(LIMIT_S)

    def capture():
        same = camera.capture(SCENE, exposure_s=0.01, seed=0)
        other = make_camera().capture(SCENE, exposure_s=0.01, seed=0)
        assert (same.code == other.code).all()

    status = status_of_fork(capture)
    MAY_END.set()
    thread.join()

    assert status == 0
    assert (codes[0] == camera.capture(SCENE, exposure_s=0.01, seed=0).code).all()


@pytest.mark.parametrize("lock", [_POOL._lock, ForkSafeLock()])
def test_lock_of_other_thread_is_renewed(lock):
    is_held, may_end = threading.Event(), threading.Event()

    def hold():
        with lock:
            is_held.set()
            may_end.wait(LIMIT_S)

    thread = threading.Thread(target=hold)
    thread.start()
    is_held.wait(LIMIT_S)

    def work():
        with lock:
            assert work_array((1 << 20,), np.float64).size == 1 << 20

    status = status_of_fork(work)
    may_end.set()
    thread.join()

    assert status == 0


def test_lock_of_forking_thread_stays_held():
    lock = ForkSafeLock()

    def work():
        taken = []
        other = threading.Thread(target=lambda: taken.append(lock._lock.acquire(timeout=0.1)))
        other.start()
        other.join()
        assert taken == [False]
        lock.__exit__()

    with lock:
        status = status_of_fork(work)

    assert status == 0


def test_cached_property_is_computed_without_lock():
    barrier = threading.Barrier(2, timeout=DEADLINE_S)

    class Item:
        @cached_property
        def value(self):
            barrier.wait()  # both threads compute it at the same time
            return object()

    item, found = Item(), []
    threads = [threading.Thread(target=lambda: found.append(item.value)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert found[0] is found[1] is item.value
