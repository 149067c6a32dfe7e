"""Executor of sweeps, studies and datasets: complete results despite failing workers."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from concurrent.futures import Future

import numpy as np
import pytest

from foveasim import explore
from foveasim.explore import executor as module
from foveasim.explore.executor import KILLED, executor

#: Rounds of the soak test; ``make soak`` runs 20.
N_ROUNDS = int(os.environ.get("FOVEASIM_SOAK_ROUNDS", "1"))
N_ITEMS, N_WORKERS = 400, 3
#: Seconds between two kills, at random; a worker takes about two to start.
KILL_S = 0.5, 3.0
#: Time limit of a round, seconds.
LIMIT_S = 300.0

SHOT = {
    "scene": {
        "kind": "picture",
        "picture": "",
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.1,
        "wavelength_nm": 550,
        "band_width_nm": 100,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 2.0}},
    "exposure_s": 0.01,
}


def logging_function(path):
    """
    Return a function of an item that takes 1 to 40 ms and logs its begin and end.

    The second half of the items waits until a worker was killed.
    """
    killed, n_first = path.with_name("killed"), N_ITEMS // 2

    def compute(item):
        log = os.open(path, os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        os.write(log, f"begin {item} {os.getpid()}\n".encode())
        time.sleep(0.001 + 0.039 * random.Random(item).random())
        while item >= n_first and not killed.exists():
            time.sleep(0.01)
        os.write(log, f"done {item} {os.getpid()}\n".encode())
        os.close(log)
        return item**2

    return compute


def lines(path):
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(N_ROUNDS))
def test_no_item_is_lost_with_workers(seed, tmp_path):
    rng, log = random.Random(seed), tmp_path / "log"
    is_complete, n_kills, found = threading.Event(), [0], Future()

    def kill():
        while not is_complete.wait(rng.uniform(*KILL_S)):
            workers = {int(pid) for _, _, pid in lines(log)[-20:]}
            try:
                os.kill(rng.choice(sorted(workers)), signal.SIGKILL)
                n_kills[0] += 1
                (tmp_path / "killed").touch()
            except (IndexError, ProcessLookupError):
                pass

    def compute():
        try:
            with executor(logging_function(log), what="the function", workers=N_WORKERS) as run:
                results = list(run(range(N_ITEMS), range(0, N_ITEMS, 50)))
            found.set_result(results)
        except BaseException as error:  # noqa: BLE001 -- raised again by the future
            found.set_exception(error)

    for target in (kill, compute):
        threading.Thread(target=target, daemon=True).start()
    try:
        results = found.result(LIMIT_S)
    finally:
        is_complete.set()

    assert sorted(item for item, _ in results) == list(range(N_ITEMS))
    # An item is given up after three ends of its worker, the last of which concerns it alone.
    given_up = [item for item, result in results if result is KILLED]
    assert all(result == item**2 for item, result in results if item not in given_up)
    assert len(given_up) <= max(n_kills[0] - (module.MAX_DEATHS - 1), 0)
    assert n_kills[0] > 0
    done = [int(item) for kind, item, _ in lines(log) if kind == "done"]
    assert max(map(done.count, range(N_ITEMS))) <= module.MAX_DEATHS


class SimulatedClient:
    """
    Client of n workers with zero computing time, to measure the overhead of the executor.

    Results arrive on request, in the order in which tasks were sent.
    """

    cluster = None

    def __init__(self, n_workers):
        self.workers = {f"tcp://{k}": {"status": "running", "metrics": {}} for k in range(n_workers)}
        self.n_tasks = 0

    def scheduler_info(self, n_workers):
        assert n_workers == -1
        return {"workers": self.workers}

    def submit(self, function, shared, items, limit_s, *, pure, workers):
        assert not pure
        assert len(workers) == 1
        assert workers[0] in self.workers
        self.n_tasks += 1
        return SimulatedFuture(module._Results([shared(item) for item in items], limit_s))

    def gather(self, futures, **_):
        return [future.values for future in futures]

    def sync(self, call, callback_timeout):
        assert callback_timeout > 0.0
        return call()

    def cancel(self, futures):
        pass


class SimulatedFuture:
    status = "finished"

    def __init__(self, values):
        self.values = values

    def add_done_callback(self, call):
        call(self)


def dispatch_s(n_workers, n_items, monkeypatch):
    """Measure the overhead of the executor in seconds per task, with tasks of one item."""
    monkeypatch.setattr(module, "MAX_ITEMS", 1)
    client = SimulatedClient(n_workers)
    begin_s = time.process_time()
    found = list(module._Dispatch(client, lambda item: -item, range(n_items), ()).run())
    assert sorted(found) == [(k, -k) for k in range(n_items)]
    assert client.n_tasks == n_items
    return (time.process_time() - begin_s) / n_items


@pytest.mark.parametrize("n_workers", [1, 7, 1000])
def test_every_item_is_computed_once(n_workers, monkeypatch):
    dispatch_s(n_workers, 5000, monkeypatch)


@pytest.mark.parametrize("n_workers", [2, 5])
def test_ranges_are_cut_at_shared_parts(n_workers):
    sent = []

    class Recorded(SimulatedClient):
        def submit(self, function, shared, items, limit_s, *, pure, workers):
            sent.append((workers[0], list(items)))
            return super().submit(function, shared, items, limit_s, pure=pure, workers=workers)

    cuts = [0, 90, 210, 300, 420, 500]
    list(module._Dispatch(Recorded(n_workers), lambda item: item, range(600), cuts).run())

    first = {}
    for worker, items in sent:
        first.setdefault(worker, items[0])
    assert len(first) == n_workers
    assert set(first.values()) <= set(cuts)


@pytest.mark.slow
def test_item_that_kills_workers_is_reported():
    def deadly(item):
        if item == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return item

    with executor(deadly, what="the function", workers=2) as run:
        found = dict(run(range(12), ()))
        again = dict(run(range(3), ()))

    assert found == {item: item for item in range(12)} | {7: KILLED}
    assert again == {0: 0, 1: 1, 2: 2}


@pytest.mark.slow
def test_local_workers_have_present_environment(monkeypatch):
    with executor(os.getenv, what="the function", workers=1) as run:  # starts the process that forks workers
        list(run(["HOME"], ()))
    before = dict(os.environ)
    monkeypatch.setenv("FOVEASIM_TEST", "present")
    names = ["FOVEASIM_TEST", "HOME", "PYTHONPATH", "PYTHONSAFEPATH"]
    with executor(os.getenv, what="the function", workers=1) as run:
        found = dict(run(names, ()))

    monkeypatch.undo()
    assert found == {"FOVEASIM_TEST": "present"} | {name: before.get(name, "") for name in names[1:]}
    assert dict(os.environ) == before


@pytest.mark.slow
def test_local_workers_have_different_random_states(tmp_path):
    def draw(_):
        (tmp_path / str(os.getpid())).touch()
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        return os.getpid(), np.random.get_state()[1].tobytes()  # noqa: NPY002

    with executor(draw, what="the function", workers=2) as run:
        found = {result for _, result in run(range(8), ())}

    assert len(found) == 2


@pytest.fixture(scope="module")
def scheduler():
    """Start an external scheduler with two workers."""
    from distributed import LocalCluster

    options = {"threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    with LocalCluster(n_workers=2, **options) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow
@pytest.mark.parametrize("name", ["data", "data.zarr"])
def test_datasets_are_equal_on_a_scheduler(scheduler, name, tmp_path):
    data = explore.Dataset(np.arange(20 * 24 * 24, dtype=np.uint32).astype(np.uint8).reshape(20, 24, 24), SHOT)
    (tmp_path / "here").mkdir()
    here = explore.write_dataset(data, tmp_path / "here" / name)

    there = explore.write_dataset(data, tmp_path / name, scheduler=scheduler)

    assert here.about == there.about
    for k in range(len(data)):
        np.testing.assert_array_equal(here[k]["code"], there[k]["code"])
        np.testing.assert_array_equal(here[k]["electrons"], there[k]["electrons"])


@pytest.mark.slow
def test_studies_are_equal_on_a_scheduler(scheduler):
    shot = SHOT | {"scene": SHOT["scene"] | {"picture": "skimage:camera"}}
    given = {"n_trials": 8, "batch": 4, "seed": 2}
    here, there = (
        explore.study(shot, {"optics.f_number": (1.4, 16.0)}, {"mean_code_dn": "maximize"}, **given, scheduler=address)
        for address in (None, scheduler)
    )

    assert [(t.params, t.values) for t in here.trials] == [(t.params, t.values) for t in there.trials]


@pytest.mark.slow
def test_in_process_executor_needs_no_dask():
    with executor(lambda item: -item, what="the function") as run:
        assert list(run([3, 1], ())) == [(3, -3), (1, -1)]
