"""Sweeps: the same numbers on any workers and after any end, every point once, failures told and kept apart."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from foveasim import explore
from foveasim.config import build_shot
from foveasim.errors import ConfigError, FileError, ParameterError, SimulationError
from foveasim.explore._records import Journal, Record, journal_of, values_of
from foveasim.explore.executor import CHUNK_S
from foveasim.explore.sweeps.results import dataset_of, write_store
from foveasim.explore.worker_cache import ShotRunner

SHOT = {
    "scene": {
        "kind": "flat",
        "shape": [60, 60],
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.1,
        "band_width_nm": 100.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}},
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 4e-15},
    "exposure_s": 0.01,
}
#: 200 points of every sort: a layout, a lens, electronics, an exposure, repeats.
VARY_200 = {
    "layout.parameters.n_x": [8, 12],
    "optics.f_number": [2.0, 2.8],
    "sensor.bits": [6, 8, 10, 12, 14],
    "exposure_s": [0.0001, 0.0004],
}
REPEATS = 5
SLOW_S = 0.02
#: What does not end within this, on however slow a machine, never ends.
LIMIT_S = 150.0


def in_process(plan):
    """The results of a plan without any worker, with one cache."""
    runner = runner_of(plan)
    return dataset_of(plan, {k: runner.record(k, plan.settings_of(k)) for k in range(plan.n_points)})


def runner_of(plan, **options):
    return ShotRunner(plan.source, plan.metrics, is_geometry_varied=plan.is_geometry_varied, n_threads=1, **options)


def logged(folder, pause_s=0.0):
    """A metric with a side effect: every execution is a line of a file, with the process that did it."""

    def mean_dn(shot, _, capture):
        line = f"{shot.seed} {os.getpid()}\n".encode()
        log = os.open(folder / "log", os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        os.write(log, line)
        os.close(log)
        time.sleep(pause_s)
        return float(capture.code.mean())

    return {"mean_dn": mean_dn}


def executions(folder):
    """Seeds and processes of all executions."""
    path = folder / "log"
    return [tuple(map(int, line.split())) for line in path.read_text().splitlines()] if path.exists() else []


def wait_for(condition, limit_s=LIMIT_S):
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def ends(call):
    """What a call gives, which may hang: then this fails."""
    given = Future()

    def run():
        try:
            given.set_result(call())
        except BaseException as error:  # noqa: BLE001 -- it is raised where it is waited for
            given.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return given.result(LIMIT_S)


def plan_200(metrics=None):
    return explore.plan_sweep(SHOT, VARY_200, repeats=REPEATS, seed=3, metrics=metrics)


@pytest.fixture(scope="module")
def by_hand():
    """The 200 points without workers, caches or stores: each shot built again, and captured."""
    plan = plan_200()
    records = {}
    for point in range(plan.n_points):
        shot = build_shot("by hand", plan.settings_of(point))
        capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=plan.seed_of(point))
        values = {}
        for name, metric in plan.metrics.items():
            values |= values_of(name, metric(shot, shot.camera, capture))
        records[point] = Record(point, values)
    found = dataset_of(plan, records)
    assert found["snr_mean"].notnull().all()
    assert (found["mean_code_dn"].sel({"sensor.bits": 14}).std("repeat") > 0.0).all()
    return found


def with_objects(data):
    """Strings as Python objects: xarray before 2026.2 finds no two arrays of numpy's own strings equal."""
    strings = {name: variable.astype(object) for name, variable in data.variables.items() if variable.dtype.kind == "T"}
    labels = {name: variable for name, variable in strings.items() if name in data.coords}
    values = {name: variable for name, variable in strings.items() if name not in data.coords}
    return data.assign(values).assign_coords(labels)


def dtypes(data):
    """Strings that are read from a store are Python objects with some versions of xarray, and numpy's own with others."""
    return {name: "strings" if v.dtype.kind in "OT" else v.dtype for name, v in data.variables.items()}


def assert_identical(one, other):
    assert dtypes(one) == dtypes(other)
    xr.testing.assert_identical(with_objects(one), with_objects(other))


# -- the same numbers everywhere --------------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_results_are_the_same_with_any_number_of_workers(workers, by_hand, tmp_path):
    found = explore.run_sweep(plan_200(), out=tmp_path / "r.zarr", workers=workers)

    assert_identical(found, by_hand)
    assert_identical(explore.open_results(tmp_path / "r.zarr"), by_hand)
    assert [p.name for p in tmp_path.iterdir()] == ["r.zarr"]
    # A complete sweep is read: the scheduler, which is none, is not asked.
    again = explore.run_sweep(plan_200(), out=tmp_path / "r.zarr", scheduler="tcp://127.0.0.1:1")
    assert_identical(again, by_hand)


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_another_dask_on_this_machine_does_not_matter():
    # Warnings are errors here: dask's own, of its usual port being taken, would be one.
    with socket.socket() as usual:
        with suppress(OSError):  # where another dask has it
            usual.bind(("127.0.0.1", 8787))
            usual.listen()
        found = explore.sweep(SHOT, {"sensor.bits": [8, 10]}, workers=1)

    assert (found["error"] == "").all()


def answers(port):
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def programs(n_workers):
    """A scheduler with workers, in programs of their own: its address, and its program."""
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    programs = [
        ("distributed.cli.dask_scheduler", "--host", address, "--no-dashboard"),
        *[("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard", "--memory-limit", "2 GB")]
        * n_workers,
    ]
    running = []
    try:
        for module, *arguments in programs:
            command = [sys.executable, "-m", module, *arguments]
            running.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
            if len(running) == 1:
                wait_for(lambda: answers(port))
        yield address, running[0]
    finally:
        for program in reversed(running):
            program.terminate()
        for program in running:
            program.wait(timeout=LIMIT_S)


@pytest.fixture(scope="module")
def scheduler():
    with programs(2) as started:
        yield started


def test_results_are_the_same_on_a_scheduler_started_separately(scheduler, by_hand):
    found = explore.run_sweep(plan_200(), scheduler=scheduler[0])

    assert_identical(found, by_hand)


@pytest.fixture(params=["1 process", "2 processes", "1 worker of a scheduler", "2 workers of a scheduler"])
def where(request):
    """Where a sweep runs."""
    n_workers = int(request.param[0])
    if "process" in request.param:
        yield {"workers": n_workers}
    elif n_workers == 1:
        with programs(1) as (address, _):
            yield {"scheduler": address}
    else:
        yield {"scheduler": request.getfixturevalue("scheduler")[0]}


def test_a_metric_that_ends_its_process_costs_its_point_alone_and_three_tries(where, tmp_path):
    (log,) = logged(tmp_path).values()

    def deadly(shot, camera, capture):
        log(shot, camera, capture)
        if camera.sensor.bits == 9:
            os.kill(os.getpid(), signal.SIGKILL)
        return 7.0

    plan = explore.plan_sweep(SHOT, {"sensor.bits": [6, 7, 8, 9, 10, 11]}, metrics=[deadly])
    found = ends(lambda: explore.run_sweep(plan, **where))

    is_fatal = found["sensor.bits"].values == 9
    assert found["error"].values[is_fatal].item().startswith("ended its worker each time")
    assert (found["error"].values[~is_fatal] == "").all()
    assert (found["deadly"].values[~is_fatal] == 7.0).all()
    seeds = [seed for seed, _ in executions(tmp_path)]
    assert set(seeds) == set(found["seed"].values.tolist())
    fatal = found["seed"].values[is_fatal].item()
    assert seeds.count(fatal) == 3
    assert all(seeds.count(seed) <= 2 for seed in seeds if seed != fatal)


def test_a_worker_that_is_killed_from_outside_costs_no_point(where, tmp_path):
    plan = explore.plan_sweep(SHOT, {"exposure_s": np.linspace(0.01, 0.02, 40)}, metrics=logged(tmp_path, SLOW_S))
    killed = []

    def kill():
        wait_for(lambda: len(executions(tmp_path)) > 15)
        killed.append(executions(tmp_path)[-1][1])
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    found = ends(lambda: explore.run_sweep(plan, **where))
    killer.join()

    assert (found["error"] == "").all()
    assert found["mean_dn"].notnull().all()
    seeds = [seed for seed, _ in executions(tmp_path)]
    assert max(seeds.count(seed) for seed in seeds) <= 2


def test_a_worker_keeps_parts_in_a_quarter_of_its_memory(scheduler):
    def kept_bytes(*_):
        from distributed import get_worker

        (shared,) = (value for value in get_worker().data.values() if hasattr(value, "function"))
        return shared.function()._runner.cache.max_bytes

    found = explore.sweep(SHOT, {"sensor.bits": [8]}, metrics=[kept_bytes], scheduler=scheduler[0])

    assert found["kept_bytes"].item() == 500_000_000


def test_a_metric_may_raise_anything():
    def rude(_, camera, __):
        raise {8: SystemExit, 9: KeyboardInterrupt, 10: GeneratorExit, 11: RuntimeError}[camera.sensor.bits]("why")

    found = ends(lambda: explore.sweep(SHOT, {"sensor.bits": [8, 9, 10, 11]}, metrics=[rude], workers=1))

    kinds = ("SystemExit", "KeyboardInterrupt", "GeneratorExit", "RuntimeError")
    assert found["error"].values.tolist() == [f"rude: {kind}: why" for kind in kinds]


def paused(when):
    """A metric that pauses its worker, as dask does when its memory is full, for good, from some point on."""

    def pausing(_, camera, __):
        from distributed import Status, get_worker

        if when(camera.sensor.bits):
            get_worker().memory_manager.memory_pause_fraction = False  # dask must not take it back
            get_worker().status = Status.paused
        time.sleep(SLOW_S)
        return os.getpid()

    return explore.plan_sweep(SHOT, {"sensor.bits": list(range(4, 16))}, metrics=[pausing])


def test_what_waits_at_a_paused_worker_is_done_by_another(monkeypatch):
    monkeypatch.setattr("foveasim.explore.cluster.PAUSED_S", 1.0)
    found = ends(lambda: explore.run_sweep(paused(lambda bits: bits == 4), workers=2))

    assert (found["error"] == "").all()
    one = found["pausing"].sel({"sensor.bits": 4})
    assert (found["pausing"] == one).sum() < 6


def test_workers_that_are_all_paused_are_told(monkeypatch):
    monkeypatch.setattr("foveasim.explore.cluster.PAUSED_S", 1.0)
    monkeypatch.setattr("foveasim.explore.executor.ABSENT_S", 1.0)
    with pytest.raises(
        SimulationError,
        match=r"have computed nothing for 1 s: they are closing, or paused.*; \d+ of 12 points are done",
    ):
        ends(lambda: explore.run_sweep(paused(lambda _: True), workers=2))


def test_a_scheduler_that_is_killed_is_told_and_what_was_done_is_kept(scheduler, tmp_path):
    """The last test of that scheduler."""
    address, program = scheduler
    store = tmp_path / "r.zarr"

    def kill():
        wait_for(lambda: len(journal_points(store)) >= 5)
        program.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(SimulationError, match=r"the scheduler does not answer any more; \d+ of 200 points are done"):
        explore.run_sweep(plan_200(logged(tmp_path, SLOW_S)), out=store, scheduler=address)
    killer.join()

    assert len(journal_points(store)) >= 5


def test_a_points_seed_is_of_the_sweeps_seed_and_its_number_alone():
    few = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}, seed=3)
    many = plan_200()

    assert [few.seed_of(k) for k in range(2)] == [many.seed_of(k) for k in range(2)]
    assert len({many.seed_of(k) for k in range(many.n_points)}) == many.n_points
    assert many.seed_of(0) != explore.plan_sweep(SHOT, VARY_200, seed=4).seed_of(0)


# -- ends -------------------------------------------------------------------------------------------------------------


def journal_points(store):
    lines = journal_of(store).read_text().splitlines() if journal_of(store).exists() else []
    return [json.loads(line.partition(" ")[2])["point"] for line in lines[1:]]


def test_a_worker_that_is_killed_costs_nothing_but_what_it_was_doing(by_hand, tmp_path):
    plan = plan_200(logged(tmp_path, SLOW_S))
    store = tmp_path / "r.zarr"
    kept = []

    def kill():
        wait_for(lambda: len(executions(tmp_path)) > 40)
        kept.extend(journal_points(store))
        # Until their worker knows that it may forget them.
        wait_for(lambda: len(executions(tmp_path)) > 60)
        os.kill(executions(tmp_path)[-1][1], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    found = explore.run_sweep(plan, out=store, workers=2)
    killer.join()

    assert (found["error"] == "").all()
    np.testing.assert_array_equal(found["mean_dn"], by_hand["mean_code_dn"])
    seeds = [seed for seed, _ in executions(tmp_path)]
    assert set(seeds) == set(by_hand["seed"].values.ravel().tolist())
    assert kept
    assert all(seeds.count(plan.seed_of(point)) == 1 for point in kept)
    # Of the worker that ended, at most the points of one task are computed again.
    assert len(seeds) - len(set(seeds)) <= round(CHUNK_S / SLOW_S)


METRIC = """
import os, time
from pathlib import Path

def mean_dn(shot, camera, capture):
    log = os.open(Path(LOG), os.O_CREAT | os.O_APPEND | os.O_WRONLY)
    os.write(log, f"{shot.seed} {os.getpid()}\\n".encode())
    os.close(log)
    time.sleep(0.02)
    return float(capture.code.mean())
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with a sweep of 60 points, and a metric that logs its executions."""
    (tmp_path / "shot.yaml").write_text(json.dumps(SHOT))
    (tmp_path / "own.py").write_text(METRIC.replace("LOG", repr(str(tmp_path / "log"))))
    vary = {"sensor.bits": [8, 10], "exposure_s": {"from": 0.01, "to": 0.1, "n": 10, "spacing": "geometric"}}
    (tmp_path / "sweep.yaml").write_text(json.dumps({"shot": "shot.yaml", "vary": vary, "repeats": 3, "seed": 3}))
    return tmp_path


COMMAND = [sys.executable, "-m", "foveasim.cli", "sweep", "sweep.yaml", "--workers", "1", "--metric", "own:mean_dn"]


def is_gone(process):
    stat = Path(f"/proc/{process}/stat")
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] == "Z"


def ended(end, folder, n_points):
    """A sweep that is ended when so many points are done: its exit code, its last words, and the points in its journal."""
    store = folder / "results.zarr"
    running = subprocess.Popen(
        COMMAND, cwd=folder, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: len(journal_points(store)) >= n_points)
    if end == signal.SIGINT:  # as a terminal's Ctrl-C, which all its processes get
        os.killpg(running.pid, end)
    else:
        os.kill(running.pid, end)
    _, told = running.communicate(timeout=30)
    wait_for(lambda: all(is_gone(process) for _, process in executions(folder)))
    return running.returncode, told, journal_points(store)


def test_a_sweep_that_was_ended_twice_goes_on_and_no_point_that_was_done_is_done_again(folder):
    code, told, after_stop = ended(signal.SIGINT, folder, 10)
    n_stop = len(executions(folder))

    assert code == 130
    assert told == "stopped; what is done is kept beside results.zarr, and the same command goes on from there\n"
    assert 10 <= len(after_stop) < 30

    code, _, after_kill = ended(signal.SIGKILL, folder, 30)
    n_kill = len(executions(folder))

    assert code == -signal.SIGKILL
    assert after_kill[: len(after_stop)] == after_stop
    assert 30 <= len(after_kill) < 60

    result = subprocess.run(COMMAND, cwd=folder, capture_output=True, text=True, check=False)

    assert result.returncode == 0, result.stderr
    assert not journal_of(folder / "results.zarr").exists()
    found = explore.open_results(folder / "results.zarr")
    assert (found["error"] == "").all()
    np.testing.assert_array_equal(found["mean_dn"], found["mean_code_dn"])
    assert found["mean_dn"].min() > 0
    plan = explore.read_sweep(folder / "sweep.yaml")
    seeds = [seed for seed, _ in executions(folder)]
    assert {plan.seed_of(point) for point in after_stop}.isdisjoint(seeds[n_stop:])
    assert {plan.seed_of(point) for point in after_kill}.isdisjoint(seeds[n_kill:])
    assert len(seeds[n_kill:]) == 60 - len(after_kill)


def test_points_that_fail_are_in_the_results_with_their_message_and_can_be_tried_again(tmp_path):
    fatal = tmp_path / "fatal"
    fatal.touch()

    def moody(shot, *_):
        if shot.exposure_s == 0.5:
            raise RuntimeError("no mood")
        if shot.exposure_s == 1.0 and fatal.exists():
            os._exit(1)
        return 7.0

    vary = {"exposure_s": [0.1, -1.0, 0.5, 1.0, 2.0]}
    plan = explore.plan_sweep(SHOT, vary, metrics={"moody": moody, "n_sites": explore.METRICS["n_sites"]})

    found = explore.run_sweep(plan, out=tmp_path / "r.zarr", workers=1)

    assert found["error"].values.tolist() == [
        "",
        "settings: exposure_s: must be >= 0, got -1.0 s".replace("settings", str(plan.source)),
        "moody: RuntimeError: no mood",
        "ended its worker each time: too little memory, or a crash in a metric",
        "",
    ]
    np.testing.assert_array_equal(found["moody"], [7.0, np.nan, np.nan, np.nan, 7.0])
    np.testing.assert_array_equal(found["n_sites"], [64, np.nan, 64, np.nan, 64])

    fatal.unlink()
    found = explore.run_sweep(plan, out=tmp_path / "r.zarr", workers=1, retry=True)

    np.testing.assert_array_equal(found["moody"], [7.0, np.nan, np.nan, 7.0, 7.0])
    assert journal_of(tmp_path / "r.zarr").exists()


def test_trying_again_what_failed_never_makes_failures_permanent(tmp_path):
    bad = tmp_path / "bad"
    bad.touch()

    def moody(*_):
        if bad.exists():
            raise RuntimeError("no mood")
        return 7.0

    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}, metrics=[moody])
    store = tmp_path / "r.zarr"
    explore.run_sweep(plan, out=store, workers=1)
    before = journal_of(store).read_bytes()
    with pytest.raises(ParameterError, match="scheduler"):
        explore.run_sweep(plan, out=store, scheduler="tcp://127.0.0.1:1", retry=True)

    assert journal_of(store).read_bytes() == before

    bad.unlink()
    journal_of(store).unlink()
    assert (
        explore.run_sweep(plan, out=store, workers=1)["error"].values.tolist() == ["moody: RuntimeError: no mood"] * 2
    )

    found = explore.run_sweep(plan, out=store, workers=1, retry=True)

    assert found["error"].values.tolist() == ["", ""]
    assert found["moody"].values.tolist() == [7.0, 7.0]
    assert not journal_of(store).exists()


# -- the journal and the store ----------------------------------------------------------------------------------------

PLAN = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9, 10]})


def test_a_journal_forgets_the_line_that_was_cut_off_and_nothing_else(tmp_path):
    store = tmp_path / "r.zarr"
    with Journal(store, PLAN.to_dict()) as journal:
        for point in range(3):
            journal.add(Record(point, {"a": 0.1 + point, "curve": values_of("c", np.arange(3.0))["c"]}, "", "µ"))
    whole = journal_of(store).read_bytes()
    for n_cut in (1, 20, 60):
        journal_of(store).write_bytes(whole[:-n_cut])
        with Journal(store, PLAN.to_dict()) as journal:
            assert sorted(journal.records) == [0, 1]
            assert journal.records[1].values["a"] == 1.1
            np.testing.assert_array_equal(journal.records[1].values["curve"].data, np.arange(3.0))
    damaged = bytearray(whole)
    damaged[whole.index(b'"a": 1.1') + 5] ^= 1
    journal_of(store).write_bytes(damaged)
    with Journal(store, PLAN.to_dict()) as journal:
        assert sorted(journal.records) == [0, 2]


def test_a_journal_that_was_cut_off_in_its_first_line_is_begun_anew(tmp_path):
    store = tmp_path / "r.zarr"
    with Journal(store, PLAN.to_dict()) as journal:
        head = journal_of(store).read_bytes()
    for torn in (head[:40], head[:-1], b"\0" * 100, b""):
        journal_of(store).write_bytes(torn)
        with Journal(store, PLAN.to_dict()) as journal:
            assert journal.records == {}
            journal.add(Record(0, {"a": 1.0}))
        with Journal(store, PLAN.to_dict()) as journal:
            assert sorted(journal.records) == [0]
        journal_of(store).unlink()


def test_a_full_disk_is_told_and_leaves_what_was_written_whole(tmp_path, monkeypatch):
    store = tmp_path / "r.zarr"
    write = os.write

    def full(file, data):
        write(file, bytes(data)[:10])
        raise OSError(28, "No space left on device")

    with Journal(store, PLAN.to_dict()) as journal:
        journal.add(Record(0, {"a": 1.0}))
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(FileError, match=r"No space left on device; 1 points are kept in it"):
            journal.add(Record(1, {"a": 2.0}))
    monkeypatch.undo()
    with Journal(store, PLAN.to_dict()) as journal:
        assert sorted(journal.records) == [0]


def test_two_programs_do_not_write_the_same_store(tmp_path):
    store = tmp_path / "r.zarr"
    with Journal(store, PLAN.to_dict()), pytest.raises(FileError, match="being written by another program"):
        Journal(store, PLAN.to_dict())


def test_a_store_of_another_sweep_is_left_alone(tmp_path):
    store = tmp_path / "r.zarr"
    write_store(dataset_of(PLAN, {}), store)
    other = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9, 12]})

    with pytest.raises(FileError, match=r"is of another sweep or study: 'vary\.sensor\.bits' differs"):
        explore.run_sweep(other, out=store)
    assert explore.open_results(store)["sensor.bits"].values.tolist() == [8, 9, 10]


def test_results_of_another_function_of_the_same_name_are_not_taken_for_this_ones(tmp_path):
    def brighter(than):
        return lambda _, __, capture: float((capture.code > than).mean())

    plans = [explore.plan_sweep(SHOT, {"sensor.bits": [8]}, metrics={"share": brighter(than)}) for than in (0, 255)]
    found = explore.run_sweep(plans[0], out=tmp_path / "r.zarr", workers=1)

    assert found["share"].item() == 1.0
    with pytest.raises(FileError, match=r"'metrics\.share' differs"):
        explore.run_sweep(plans[1], out=tmp_path / "r.zarr", workers=1)


@pytest.mark.parametrize("text", ["my notes", "my notes\n", "{}\n{}\n", "cafe", '{"format": "foveasim'])
def test_a_file_that_is_no_journal_is_left_alone(tmp_path, text):
    journal_of(tmp_path / "r.zarr").write_text(text)

    with pytest.raises(FileError, match="is no sweep's journal"):
        explore.run_sweep(PLAN, out=tmp_path / "r.zarr")
    assert journal_of(tmp_path / "r.zarr").read_text() == text


# -- what a dataset holds --------------------------------------------------------------------------------------------


def test_xarray_opens_a_store_without_a_word(tmp_path):
    records = {k: Record(k, {"a": 1.0, "path": "ab"[k]}) for k in range(2)}
    found = dataset_of(explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}), records)
    write_store(found, tmp_path / "r.zarr")  # here, too, any warning is an error

    with xr.open_zarr(tmp_path / "r.zarr") as opened:
        assert_identical(opened.load(), found)


def test_labelled_arrays_are_joined_by_their_labels_and_others_padded():
    one = xr.DataArray([1.0, 2.0], dims="colour", coords={"colour": ["red", "green"]})
    two = xr.DataArray([3.0, 4.0], dims="colour", coords={"colour": ["green", "blue"]})
    records = {
        k: Record(
            k, values_of("c", light) | values_of("m", {"n": k, "path": "ab"[k]}) | values_of("v", np.arange(k + 1))
        )
        for k, light in enumerate((one, two))
    }

    found = dataset_of(explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}), records)

    assert found["colour"].values.tolist() == ["red", "green", "blue"]
    np.testing.assert_array_equal(found["c"], [[1.0, 2.0, np.nan], [np.nan, 3.0, 4.0]])
    np.testing.assert_array_equal(found["v"], [[0.0, np.nan], [0.0, 1.0]])
    assert found["m_n"].values.tolist() == [0, 1]
    assert found["m_path"].values.tolist() == ["a", "b"]


ODD = {
    "a 0-d array": lambda _: np.array(3.0),
    "a 0-d DataArray": lambda k: xr.DataArray(np.arange(k + 2.0)).mean(),
    "a Dataset": lambda k: xr.Dataset({"a": 3.0, "b": ("x", np.arange(k + 2.0))}),
    "long doubles": lambda _: np.arange(3, dtype=np.longdouble),
    "a long double": lambda _: np.longdouble(3.0),
    "another byte order": lambda _: np.arange(3, dtype=">i4"),
    "a large number": lambda _: 2**70,
    "large numbers": lambda _: np.array([2**63 + 5], np.uint64),
    "nothing": lambda _: np.array([]),
    "objects that are texts": lambda _: np.array(["a", "bc"], object),
    "numbers and texts": lambda k: "seven" if k else 7,
    "labels of two sorts": lambda k: xr.DataArray([1.0, 2.0], dims="x", coords={"x": ["1", "b"] if k else [1, 2]}),
    "labels of large numbers": lambda k: xr.DataArray(
        [1.0], dims="x", coords={"x": np.array([2**63], np.uint64) if k else [-1]}
    ),
    "a dimension of the sweep's": lambda _: xr.DataArray([1.0, 2.0], dims="repeat", coords={"repeat": [5, 6]}),
    "a dimension of its own name": lambda _: xr.DataArray([1.0, 2.0], dims="odd", coords={"odd": [5, 6]}),
    "a dimension that is a setting": lambda _: xr.DataArray(
        [1.0, 2.0], dims="exposure_s", coords={"exposure_s": [5, 6]}
    ),
    "a dimension named as a result": lambda _: {"0": 1.0, "a": xr.DataArray([1.0, 2.0], dims="odd_0")},
    "labels here and none there": lambda _: {
        "a": xr.DataArray([1.0], dims="x", coords={"x": [5]}),
        "b": xr.DataArray([1.0, 2.0], dims="x"),
    },
}


@pytest.mark.parametrize("odd", ODD)
def test_whatever_a_metric_gives_is_kept_and_can_be_read(odd, tmp_path):
    plan = explore.plan_sweep(SHOT, {"exposure_s": [0.01, 0.02]}, repeats=2)
    records = {k: Record(k, values_of("odd", ODD[odd](k % 2))) for k in range(plan.n_points)}
    with Journal(tmp_path / "r.zarr", plan.to_dict()) as journal:
        for record in records.values():
            journal.add(record)
    with Journal(tmp_path / "r.zarr", plan.to_dict()) as journal:
        found = dataset_of(plan, journal.records)
    write_store(found, tmp_path / "r.zarr")

    assert_identical(explore.open_results(tmp_path / "r.zarr"), found)
    assert_identical(dataset_of(plan, records), found)
    assert (found["error"] == "").all()
    mine = [name for name in found.data_vars if name.startswith("odd")]
    assert mine
    for name in mine:
        given = values_of("odd", ODD[odd](1))[name]
        data = np.asarray(getattr(given, "data", given))
        kept = found[name].values[0, 1]
        if data.dtype.kind == "U":
            assert {str(one) for one in np.ravel(kept)} >= {str(one) for one in np.ravel(data)}
        else:
            assert set(kept.ravel().tolist()) >= set(data.astype(kept.dtype).ravel().tolist())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.array([1j]), "must give numbers or texts, got an array of complex128"),
        (np.array([None, "a"]), "must give numbers or texts, got an array of object"),
        (np.array(["2020-01-01"], "datetime64[D]"), "must give numbers or texts"),
        ("\ud800", "must give texts of Unicode characters"),
        (np.array(["a", "\ud800"]), "must give texts of Unicode characters"),
        (xr.DataArray([1.0, 2.0], dims="x", coords={"x": [1.0, np.nan]}), "a different label for each value along 'x'"),
        (
            xr.DataArray([1.0, 2.0, 3.0], dims="x", coords={"x": [0.5, 0.5, 1]}),
            "a different label for each value along 'x'",
        ),
        ({"a/b": 1}, "'m_a/b' cannot be the name of a result: it must be a short text without '/'"),
        ({"a" * 300: 1}, "cannot be the name of a result"),
        ({"\ud800": 1}, "cannot be the name of a result"),
        (xr.DataArray([1.0], dims="a/b", coords={"a/b": [1]}), "cannot be the name of a result"),
        ({"a": {"b": 1}, "a_b": 99}, "'m_a_b' must be the name of one result; there are two of it"),
        (None, "must give a number, a text, a mapping, an array or an array with labels, got a NoneType"),
    ],
)
def test_what_no_store_can_keep_is_told_by_its_point(given, message):
    with pytest.raises(ParameterError, match=message):
        values_of("m", given)


def test_points_that_differ_from_most_are_told_and_the_others_kept():
    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9, 10, 11]})
    given = [3.0, np.arange(2.0), 4.0, xr.DataArray([1.0], dims="x", coords={"x": [1]})]
    records = {k: Record(k, values_of("m", one), "woe" if k == 3 else "") for k, one in enumerate(given)}

    found = dataset_of(plan, records)

    np.testing.assert_array_equal(found["m"], [3.0, np.nan, 4.0, np.nan])
    told = "m: has other dimensions or labels than in most points, with none"
    assert found["error"].values.tolist() == ["", told, "", f"woe; {told}"]
    many = dataset_of(plan, {k: Record(k, values_of("m", given[1] if k else 3.0)) for k in range(4)})
    assert many["m"].shape == (4, 2)
    assert np.isnan(many["m"][0]).all()


def test_results_of_two_metrics_with_one_name_are_told():
    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8]}, metrics={"a": lambda *_: {"b": 1}, "a_b": lambda *_: 2})

    found = in_process(plan)

    assert found["a_b"].item() == 1
    assert found["error"].item() == "'a_b' must be the name of one result; there are two of it"


def test_points_side_by_side_are_labelled_with_all_their_settings():
    points = [
        {"optics.emission": "isotropic", "layout.parameters.n_x": 8, "sensor.qe": 0.5},
        {
            "optics.emission": "lambertian",
            "layout.parameters.n_x": 9,
            "sensor.qe": {"kind": "silicon", "depth_um": 3.0},
        },
    ]
    plan = explore.plan_sweep(SHOT, points, repeats=2)

    found = in_process(plan)

    assert found["n_sites"].dims == ("point", "repeat")
    assert found["n_sites"].values.tolist() == [[64, 64], [72, 72]]
    assert found["optics.emission"].values.tolist() == ["isotropic", "lambertian"]
    assert found["sensor.qe"].values.tolist() == ["0.5", '{"kind": "silicon", "depth_um": 3.0}']
    assert json.loads(found.attrs["settings"])["exposure_s"] == 0.01
    assert json.loads(found.attrs["versions"])["numpy"] == np.__version__


# -- what is shared ---------------------------------------------------------------------------------------------------


def test_what_points_have_in_common_is_made_once_and_changes_no_result():
    plan = plan_200()
    runner = runner_of(plan)
    order, _ = plan.order()
    shared = {int(point): runner.record(point, plan.settings_of(point)) for point in order}

    assert {part: runner.cache.n_made[part] for part in ("scene", "layout", "optics", "images", "light on sites")} == {
        "scene": 1,
        "layout": 2,
        "optics": 2,
        "images": 2,
        "light on sites": 4,
    }
    small = runner_of(plan, max_bytes=0)
    for point in (0, 199, 57):
        assert small.record(point, plan.settings_of(point)) == shared[point]


@pytest.mark.parametrize("max_bytes", [0, 200_000, 2_000_000])
def test_cache_is_limited_in_memory(max_bytes):
    plan = explore.plan_sweep(SHOT, {"layout.parameters.n_x": list(range(8, 40))})
    runner = runner_of(plan, max_bytes=max_bytes)
    sizes = []
    for point in range(plan.n_points):
        before = set(runner.cache._parts)
        runner.record(point, plan.settings_of(point))
        parts = runner.cache._parts
        new = set(parts) - before
        assert {part for part, _ in new} >= {"layout", "sensor", "camera", "light on sites"}
        sizes.append(sum(part.n_bytes for part in parts.values()))
        least = sum(
            part.n_bytes for key, part in parts.items() if key in new or key[0] in {"scene", "optics", "images"}
        )
        assert sizes[-1] <= max(max_bytes, least)
    assert max(sizes) > 0.5 * max_bytes


def test_points_with_the_same_layout_and_light_are_neighbours_in_any_mode():
    for plan in (
        plan_200(),
        explore.plan_sweep(SHOT, [{"sensor.bits": 6 + k % 3, "optics.f_number": 2.0 + k % 2} for k in range(12)]),
    ):
        order, begins = plan.order()
        assert sorted(order) == list(range(plan.n_points))
        kinds = [json.dumps([plan.settings_of(k)[part] for part in ("layout", "optics")]) for k in order]
        assert len(begins) == len(set(kinds))
        assert all(len(set(kinds[a:b])) == 1 for a, b in zip(begins, [*begins[1:], None], strict=True))


def test_a_camera_takes_light_that_is_known_and_shares_its_compiled_layout():
    shot = build_shot("by hand", SHOT)
    camera, images = shot.camera, {}
    known = camera.photoelectrons_per_s(shot.scene, images=images)
    kept = {place: image.copy() for place, image in images.items()}
    again = camera.replace(sensor=shot.camera.sensor).photoelectrons_per_s(shot.scene, images=images)

    np.testing.assert_array_equal(known, again)
    assert kept
    assert all(np.array_equal(images[place], image) for place, image in kept.items())
    for again, taken in zip(
        *(
            (c.code, c.electrons, c.expected_e)
            for c in (
                camera.capture(shot.scene, exposure_s=0.01, seed=1),
                camera.capture(shot.scene, exposure_s=0.01, seed=1, photo_e_per_s=known),
            )
        ),
        strict=True,
    ):
        np.testing.assert_array_equal(again, taken)
    grid = shot.camera.optics.grid(shot.scene)
    assert camera.replace(optics=shot.camera.optics).integrator(grid) is camera.integrator(grid)
    with pytest.raises(ParameterError, match="'photo_e_per_s' must be 64 numbers, one per site, got 3"):
        camera.capture(shot.scene, exposure_s=0.01, seed=1, photo_e_per_s=known[:3])


# -- bad sweeps -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vary", "options", "error", "message"),
    [
        ({"sensor.bitz": [8]}, {}, ConfigError, r"sensor\.bitz: no such setting"),
        ({"sensor.bits": ["ten"]}, {}, ConfigError, r"sensor\.bits: must be a valid integer, got \"ten\""),
        ({"sensor.bits": [8, "ten"]}, {"mode": "zip"}, ConfigError, r"sensor\.bits: must be a valid integer"),
        (
            {"exposure_s.x": [8]},
            {},
            ConfigError,
            r"'exposure_s\.x=8' cannot be set: exposure_s is no section but 0\.01",
        ),
        ({"sensor.": [8]}, {}, ConfigError, r"'sensor\.' is no setting's place"),
        ({}, {}, ParameterError, "'vary' must have values: nothing varies"),
        ([], {}, ParameterError, "'vary' must be values by settings' paths, or a list of points"),
        ({"sensor.bits": []}, {}, ParameterError, r"'sensor\.bits' must have values"),
        ({"sensor.bits": 8}, {}, ParameterError, r"'sensor\.bits' must vary over a list of values, got 8"),
        ({"sensor.bits": range(10**9)}, {}, ParameterError, r"'sensor\.bits' has 1,000,000,000 values"),
        (
            {f"sensor.{n}": range(1000) for n in ("bits", "v_sat_v", "prnu_fraction")},
            {},
            ParameterError,
            "asks for 1,000,000,000 points",
        ),
        ({"sensor.bits": [8]}, {"repeats": 10**9}, ParameterError, "'repeats' must be .* 1000000"),
        ({"sensor.bits": [8, 8]}, {}, ParameterError, "has the value 8 twice"),
        ({"exposure_s": [2, 2.0]}, {}, ParameterError, r"has the value 2\.0 twice"),
        ({"sensor.device_seed": [2**64, 2**64 + 1]}, {}, ParameterError, r"has the value .* twice"),
        ({"exposure_s": [0.1, float("nan")]}, {}, ParameterError, r"'exposure_s' must vary over numbers.*, got nan"),
        ({"sensor.bits": {8, 10}}, {}, ParameterError, "'sensor.bits' must vary over a list of values"),
        (
            {"sensor.bits": [8], "exposure_s": [1, 2]},
            {"mode": "zip"},
            ParameterError,
            r"\(sensor\.bits: 1, exposure_s: 2\)",
        ),
        ({"sensor.bits": [8]}, {"mode": "grid"}, ParameterError, "'mode' must be"),
        ({"sensor.bits": [8]}, {"metrics": ["beauty"]}, ParameterError, "'metrics' must be of .*, got 'beauty'"),
        ({"sensor.bits": [8]}, {"metrics": []}, ParameterError, "'metrics' must be at least one"),
        ({"sensor.bits": [8]}, {"metrics": [lambda *_: 1]}, ParameterError, "name functions by a mapping"),
        ({"sensor.bits": [8]}, {"metrics": {"seed": len}}, ParameterError, "'metrics' must have names .* not 'seed'"),
        (
            {"exposure_s": [8]},
            {"metrics": {"exposure_s": len}},
            ParameterError,
            "'metrics' must have other names than .*",
        ),
        ({"sensor.bits": [object()]}, {}, ParameterError, r"'sensor\.bits' must vary over numbers, texts"),
        ({"seed": [1, 2]}, {}, ParameterError, "'seed' cannot vary"),
        ({"layout": ["four_zones"], "layout.parameters.n_x": [8]}, {}, ConfigError, "cannot both vary"),
        (
            [{"sensor.bits": 8}, {"exposure_s": 1}],
            {},
            ParameterError,
            r"'points' must all have the settings sensor\.bits",
        ),
    ],
)
def test_a_bad_sweep_ends_before_it_begins_in_one_sentence(vary, options, error, message):
    with pytest.raises(error, match=message) as caught:
        explore.plan_sweep(SHOT, vary, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("store", ["nowhere/r.zarr", "file", "folder"])
def test_a_store_that_cannot_be_written_is_told_before_the_first_point(tmp_path, store):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()

    with pytest.raises(FileError, match="cannot be written"):
        explore.run_sweep(PLAN, out=tmp_path / store)


@pytest.mark.parametrize("address", ["127.0.0.1", "tcp://", "foo://host:1", "silent"])
def test_a_scheduler_that_does_not_answer_is_told_and_leaves_nothing(tmp_path, monkeypatch, address):
    monkeypatch.setattr("foveasim.explore.cluster.SCHEDULER_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        if address == "silent":  # a port that is open, and says nothing
            address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(
            ParameterError, match="'scheduler' must be the address of a dask scheduler that answers within"
        ):
            explore.run_sweep(PLAN, out=tmp_path / "r.zarr", scheduler=address)
    assert list(tmp_path.iterdir()) == []


def test_what_answers_and_is_no_scheduler_is_told_without_what_dask_makes_of_it():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            with server.accept()[0] as one:
                one.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(ParameterError, match=r"within 10 s \(it is something else\)"):
            explore.run_sweep(PLAN, scheduler=f"tcp://127.0.0.1:{server.getsockname()[1]}")


def test_a_program_without_the_guard_is_told_of_it_and_its_workers_are_silent(tmp_path):
    (tmp_path / "own.py").write_text(
        f"from foveasim import explore\nexplore.sweep({SHOT!r}, {{'sensor.bits': [8]}}, workers=1)\n"
    )
    command = [sys.executable, "own.py"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=LIMIT_S)

    assert result.returncode == 1
    assert result.stderr.count("Traceback") == 1
    assert 'under if __name__ == "__main__": alone' in result.stderr.splitlines()[-1]


def test_a_metric_that_cannot_be_sent_to_workers_is_told():
    lock = threading.Lock()
    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8]}, metrics={"locked": lambda *_: lock.locked()})

    with pytest.raises(SimulationError, match="metrics cannot be sent to other processes"):
        explore.run_sweep(plan, workers=1)


# -- files ------------------------------------------------------------------------------------------------------------


def test_a_file_says_what_a_call_says(folder):
    read = explore.read_sweep(folder / "sweep.yaml")
    called = explore.plan_sweep(
        folder / "shot.yaml",
        {"sensor.bits": [8, 10], "exposure_s": np.geomspace(0.01, 0.1, 10)},
        repeats=3,
        seed=3,
    )

    assert read.to_dict() == called.to_dict()
    assert read.shape == (2, 10, 3)
    assert read.dims == ("sensor.bits", "exposure_s", "repeat")


def test_a_file_never_makes_the_program_import_code(folder):
    (folder / "trap.py").write_text(f"open({str(folder / 'sprung')!r}, 'w')")
    sweep = {"shot": "shot.yaml", "vary": {"sensor.bits": [8]}, "metrics": ["trap:metric"]}
    (folder / "bad.yaml").write_text(json.dumps(sweep))
    result = subprocess.run([*COMMAND[:4], "bad.yaml"], cwd=folder, capture_output=True, text=True, check=False)

    assert result.returncode == 2
    assert "'metrics' must be of" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (folder / "sprung").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vary": None}, "must have either 'vary' or 'points'"),
        ({"points": [{"sensor.bits": 8}]}, "must have either 'vary' or 'points'"),
        ({"vary": {"sensor.bits": {"from": 1}}}, "vary.sensor.bits"),
        (
            {"vary": {"sensor.v_sat_v": {"from": 0, "to": 1, "n": 3, "spacing": "geometric"}}},
            "geometric steps need ends of one sign",
        ),
        ({"shot": "none.yaml"}, "none.yaml: no such file"),
        ({"repeat": 3}, "repeat: no such setting"),
        ({"repeats": "three"}, "repeats: must be a valid integer"),
        ({"set": {"sensor.bitz": 3}}, r"sensor\.bitz: no such setting"),
    ],
)
def test_a_bad_file_is_told_with_its_place(folder, change, message):
    sweep = json.loads((folder / "sweep.yaml").read_text()) | change
    (folder / "bad.yaml").write_text(json.dumps({key: value for key, value in sweep.items() if value is not None}))

    with pytest.raises(ConfigError, match=message):
        explore.read_sweep(folder / "bad.yaml")


def test_results_are_of_the_files_as_they_were(folder):
    (folder / "photo.png").write_bytes(b"one")
    scene = {
        "kind": "picture",
        "picture": "photo.png",
        "pitch_um": 1.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 1.0,
    }
    (folder / "shot.yaml").write_text(json.dumps(SHOT | {"scene": scene}))
    plans = [explore.plan_sweep(folder / "shot.yaml", {"sensor.bits": [8]})]
    (folder / "photo.png").write_bytes(b"two")
    plans.append(explore.plan_sweep(folder / "shot.yaml", {"sensor.bits": [8]}))

    assert plans[0].settings == plans[1].settings
    assert plans[0].settings["scene"]["picture"] == str(folder / "photo.png")
    assert plans[0].to_dict() != plans[1].to_dict()


# -- who may talk to a sweep's own scheduler ------------------------------------------------------------------------


def attempt(address, arguments, function):
    """Try to run a function at an address of dask: as a client of a scheduler, and as a peer of a worker."""
    from distributed import Client, rpc
    from distributed.protocol.pickle import dumps

    async def ask():
        async with rpc(address, **arguments) as peer:
            await asyncio.wait_for(peer.run(function=dumps(function)), 2.0)

    with (
        suppress(Exception),
        Client(address, timeout=2.0, set_as_default=False, **arguments.get("client", {})) as client,
    ):
        client.submit(function).result(timeout=5.0)
        client.run_on_scheduler(function)
    arguments.pop("client", None)
    with suppress(Exception):
        asyncio.run(ask())


@pytest.mark.parametrize("certificate", ["none", "another"])
def test_only_owner_runs_code_on_local_workers(certificate, tmp_path):
    from distributed import Security

    from foveasim.explore.cluster import client_of

    mark = tmp_path / "mark"
    with client_of(None, 1) as client:
        info = client.scheduler_info(n_workers=-1)["workers"]
        addresses = {client.scheduler.address, *info, *(one["nanny"] for one in info.values())}
        assert len(addresses) == 3
        for address in addresses:
            plain = address.rpartition("://")[2]
            if certificate == "none":
                attempt(f"tcp://{plain}", {}, mark.touch)
            else:
                other = Security.temporary()
                arguments = {"connection_args": other.get_connection_args("client"), "client": {"security": other}}
                attempt(f"tls://{plain}", arguments, mark.touch)
        is_run_by_others = mark.exists()
        client.submit(mark.touch).result(timeout=LIMIT_S)

    assert not is_run_by_others
    assert mark.exists()


def test_local_cluster_answers_nothing_over_http():
    from foveasim.explore.cluster import client_of

    with client_of(None, 1) as client:
        cluster = client.cluster
        ports = [cluster.scheduler.http_server.port] if getattr(cluster.scheduler, "http_server", None) else []
        for worker in client.scheduler_info(n_workers=-1)["workers"].values():
            ports += [port for port in worker["services"].values() if isinstance(port, int)]
        answers = []
        for port in ports:
            for page in ("info/main/workers.html", "json/counts.json", "metrics", "health", "proxy/22/127.0.0.1/"):
                with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5.0) as peer:
                    peer.sendall(f"GET /{page} HTTP/1.0\r\n\r\n".encode())
                    answers.append(peer.recv(100).split(b"\r\n")[0])

    assert not [answer for answer in answers if b"404" not in answer]
