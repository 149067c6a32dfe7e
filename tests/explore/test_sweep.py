"""Sweeps: bit-identical results on any workers and after interruptions, and reports of failures."""

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
from functools import cache

import numpy as np
import pytest
from cli.conftest import run_here
from reference.shots import FLAT_SHOT
from waiting import DEADLINE_S, has_ended, wait_until

from foveasim import explore
from foveasim.config import build_shot
from foveasim.errors import ConfigError, FileError, ParameterError, SimulationError
from foveasim.explore._records import Journal, Record, journal_path, to_values
from foveasim.explore.executor import CHUNK_S
from foveasim.explore.sweeps.results import to_dataset, write_store
from foveasim.explore.worker_cache import ShotRunner
from foveasim.metrics import METRICS

SHOT = FLAT_SHOT
#: 120 points with repeats that vary settings of all kinds: layout, lens, electronics, exposure time.
VARY_120 = {
    "layout.parameters.n_x": [8, 12],
    "optics.f_number": [2.0, 2.8],
    "sensor.bits": [6, 8, 10, 12, 14],
    "exposure_s": [0.0001, 0.0004],
}
REPEATS = 3
SLOW_S = 0.02
#: Time limit of a sweep on a slow machine, seconds.
LIMIT_S = 2.0 * DEADLINE_S


def xr():
    """Return the library, which takes a second to import."""
    import xarray

    return xarray


def in_process(plan):
    """Compute the results of a plan in this process, with one cache."""
    runner = runner_of(plan)
    return to_dataset(plan, {k: runner.record(k, plan.settings_of(k)) for k in range(plan.n_points)})


def runner_of(plan, **options):
    return ShotRunner(plan.source, plan.metrics, is_geometry_varied=plan.is_geometry_varied, n_threads=1, **options)


def logging_metric(directory, pause_s=0.0, journal=None):
    """
    Return a metric that logs the seed and process of every execution to a file.

    While the file ``held`` exists, it waits when there are as many executions, or lines of a journal, as that file says. The
    first line of a journal is its head.
    """
    log_path, held = directory / "log", directory / "held"

    def is_held():
        try:
            return len((journal or log_path).read_text().splitlines()) >= int(held.read_text())
        except OSError:
            return False

    def mean_dn(shot, _, capture):
        line = f"{shot.seed} {os.getpid()}\n".encode()
        log = os.open(log_path, os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        os.write(log, line)
        os.close(log)
        time.sleep(pause_s)
        while is_held():
            time.sleep(0.01)
        return float(capture.code.mean())

    return {"mean_dn": mean_dn}


def executions(directory):
    """Return the seeds and processes of all executions."""
    path = directory / "log"
    return [tuple(map(int, line.split())) for line in path.read_text().splitlines()] if path.exists() else []


def with_timeout(call):
    """Return the result of a call, or fail after a time limit."""
    result = Future()

    def run():
        try:
            result.set_result(call())
        except BaseException as error:  # noqa: BLE001 -- raised again by the future
            result.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return result.result(LIMIT_S)


def plan_120(metrics=None):
    return explore.plan_sweep(SHOT, VARY_120, repeats=REPEATS, seed=3, metrics=metrics)


@pytest.fixture(scope="module")
def reference_results():
    """Compute the 120 points without workers, cache or store, with a new shot for each point."""
    plan = plan_120()
    records = {}
    for point in range(plan.n_points):
        shot = build_shot("reference", plan.settings_of(point))
        capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=plan.seed_of(point))
        values = {}
        for name, metric in plan.metrics.items():
            values |= to_values(name, metric(shot, shot.camera, capture))
        records[point] = Record(point, values)
    found = to_dataset(plan, records)
    assert found["snr_mean"].notnull().all()
    assert (found["mean_code_dn"].sel({"sensor.bits": 14}).std("repeat") > 0.0).all()
    return found


def with_objects(data):
    """Convert strings to Python objects: xarray before 2026.2 compares numpy string arrays as unequal."""
    strings = {name: variable.astype(object) for name, variable in data.variables.items() if variable.dtype.kind == "T"}
    labels = {name: variable for name, variable in strings.items() if name in data.coords}
    values = {name: variable for name, variable in strings.items() if name not in data.coords}
    return data.assign(values).assign_coords(labels)


def dtypes(data):
    """Return dtypes by name; depending on the version, xarray reads strings as objects or numpy strings."""
    return {name: "strings" if v.dtype.kind in "OT" else v.dtype for name, v in data.variables.items()}


def assert_identical(one, other):
    assert dtypes(one) == dtypes(other)
    xr().testing.assert_identical(with_objects(one), with_objects(other))


# -- results on different workers -------------------------------------------------------------------------------------


def test_integer_keys_equal_string_keys():
    """Settings from Python may have the keys that a YAML file converts to strings, as may their changes."""
    zernike = {"coefficients": {4: 0.1, np.int64(7): np.float64(0.2)}, "unit": "waves", "wavelength_nm": (550,)}
    shot = SHOT | {"optics": SHOT["optics"] | {"zernike": zernike}}
    vary = {"sensor.bits": [8, 10]}
    as_in_file = json.loads(json.dumps(shot | {"optics": SHOT["optics"] | {"zernike": None}}))
    as_in_file["optics"]["zernike"] = {"coefficients": {"4": 0.1, "7": 0.2}, "unit": "waves", "wavelength_nm": [550]}
    expected = explore.plan_sweep(as_in_file, vary)
    by_change = explore.plan_sweep(SHOT, vary, changes={"optics.zernike": zernike})
    study = explore.plan_study(shot, {"sensor.bits": [8, 10]}, {"snr_mean": "maximize"}, n_trials=1)

    assert explore.plan_sweep(shot, vary).to_dict() == by_change.to_dict() == expected.to_dict()
    assert study.base.settings == expected.settings
    # By name, since older versions of xarray find no string arrays of variable width equal.
    found, wanted = (in_process(plan).to_dict()["data_vars"] for plan in (explore.plan_sweep(shot, vary), expected))
    np.testing.assert_equal(found, wanted)
    coefficients = explore.plan_sweep(shot, {"optics.zernike.coefficients.4": [0.1, 0.3]}).settings_of(1)["optics"]
    assert coefficients["zernike"]["coefficients"] == {"4": 0.3, "7": 0.2}


@pytest.mark.slow(keep=("[0]",))
@pytest.mark.parametrize("workers", [0, 1, 3])
def test_results_do_not_depend_on_workers(workers, reference_results, tmp_path):
    found = explore.run_sweep(plan_120(), out=tmp_path / "r.zarr", workers=workers)

    assert_identical(found, reference_results)
    assert_identical(explore.open_results(tmp_path / "r.zarr"), reference_results)
    assert [p.name for p in tmp_path.iterdir()] == ["r.zarr"]
    # A complete sweep is read from the store, without contact to the (invalid) scheduler.
    again = explore.run_sweep(plan_120(), out=tmp_path / "r.zarr", scheduler="tcp://127.0.0.1:1")
    assert_identical(again, reference_results)


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_sweep_in_process_needs_no_dask(monkeypatch):
    """A metric is called in this process, where a debugger stops in it."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    found = explore.sweep(SHOT, {"sensor.bits": [8, 10]}, metrics={"pid": lambda *_: float(os.getpid())}, workers=0)
    assert found["error"].values.tolist() == ["", ""]
    assert found["pid"].values.tolist() == [os.getpid()] * 2


@pytest.mark.slow
def test_occupied_dask_port_causes_no_warning():
    # Warnings are errors in tests; dask would warn about its occupied default port.
    with socket.socket() as default:
        with suppress(OSError):  # occupied by another dask cluster
            default.bind(("127.0.0.1", 8787))
            default.listen()
        found = explore.sweep(SHOT, {"sensor.bits": [8, 10]}, workers=1)

    assert (found["error"] == "").all()


def answers(port):
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


#: The program ``dask worker``, which forks workers from a process with their modules: several tests end workers.
WORKER_PROGRAM = """
from distributed.cli.dask_worker import main
from distributed.utils import get_mp_context

get_mp_context().set_forkserver_preload(["foveasim.explore._worker_imports"])
main()
"""


@contextmanager
def programs(n_workers):
    """Start a scheduler and workers as separate programs; yield the address and the scheduler program."""
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    limits = ["--nworkers", str(n_workers), "--nthreads", "1", "--memory-limit", "2 GB"]
    programs = [
        ("-m", "distributed.cli.dask_scheduler", "--host", address, "--no-dashboard"),
        ("-c", WORKER_PROGRAM, address, "--no-dashboard", *limits),
    ]
    environment = os.environ | {"DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver"}
    running = []
    try:
        for arguments in programs:
            command = [sys.executable, *arguments]
            running.append(
                subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            )
            if len(running) == 1:
                wait_until(lambda: answers(port))
        yield address, running[0]
    finally:
        for program in reversed(running):  # workers first: they sign off at the scheduler
            program.terminate()
            program.wait(timeout=LIMIT_S)


@pytest.fixture(scope="module")
def scheduler():
    with programs(2) as (address, _):
        yield address


@pytest.fixture(scope="module")
def scheduler_of_one_worker():
    with programs(1) as (address, _):
        yield address


@pytest.mark.slow
def test_results_are_equal_on_external_scheduler(scheduler, reference_results):
    found = explore.run_sweep(plan_120(), scheduler=scheduler)

    assert_identical(found, reference_results)


@pytest.fixture
def where(request):
    """Options of a sweep that select its workers, from words such as "2 workers of a scheduler"."""
    n_workers = int(request.param[0])
    if "process" in request.param:
        yield {"workers": n_workers}
    else:
        fixture = {1: "scheduler_of_one_worker", 2: "scheduler"}[n_workers]
        yield {"scheduler": request.getfixturevalue(fixture)}


@pytest.mark.slow
@pytest.mark.parametrize("where", ["1 process", "1 worker of a scheduler"], indirect=True)
def test_crashing_metric_fails_only_its_point(where, tmp_path):
    (log,) = logging_metric(tmp_path).values()

    def deadly(shot, camera, capture):
        log(shot, camera, capture)
        if camera.sensor.bits == 9:
            os.kill(os.getpid(), signal.SIGKILL)
        return 7.0

    plan = explore.plan_sweep(SHOT, {"sensor.bits": [6, 7, 8, 9, 10, 11]}, metrics=[deadly])
    found = with_timeout(lambda: explore.run_sweep(plan, **where))

    is_fatal = found["sensor.bits"].values == 9
    assert found["error"].values[is_fatal].item().startswith("worker process ended in every attempt")
    assert (found["error"].values[~is_fatal] == "").all()
    assert (found["deadly"].values[~is_fatal] == 7.0).all()
    seeds = [seed for seed, _ in executions(tmp_path)]
    assert set(seeds) == set(found["seed"].values.tolist())
    fatal = found["seed"].values[is_fatal].item()
    assert seeds.count(fatal) == 3
    assert all(seeds.count(seed) <= 2 for seed in seeds if seed != fatal)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["2 processes", "2 workers of a scheduler"], indirect=True)
def test_points_of_killed_worker_are_retried(where, tmp_path):
    metrics = logging_metric(tmp_path, SLOW_S)
    (tmp_path / "held").write_text("16")
    plan = explore.plan_sweep(SHOT, {"exposure_s": np.linspace(0.01, 0.02, 40)}, metrics=metrics)
    killed = []

    def kill():
        wait_until(lambda: len(executions(tmp_path)) > 15)
        killed.append(executions(tmp_path)[-1][1])
        os.kill(killed[0], signal.SIGKILL)
        (tmp_path / "held").unlink()

    killer = threading.Thread(target=kill)
    killer.start()
    found = with_timeout(lambda: explore.run_sweep(plan, **where))
    killer.join()

    assert (found["error"] == "").all()
    assert found["mean_dn"].notnull().all()
    seeds = [seed for seed, _ in executions(tmp_path)]
    assert max(seeds.count(seed) for seed in seeds) <= 2


@pytest.mark.slow
def test_worker_cache_uses_quarter_of_memory(scheduler):
    def cache_bytes(*_):
        from distributed import get_worker

        (shared,) = (value for value in get_worker().data.values() if hasattr(value, "function"))
        _, runner = shared.function().args
        return runner.cache.max_bytes

    found = explore.sweep(SHOT, {"sensor.bits": [8]}, metrics=[cache_bytes], scheduler=scheduler)

    assert found["cache_bytes"].item() == 500_000_000


def test_any_exception_of_metric_is_reported():
    def raising(_, camera, __):
        raise {8: SystemExit, 9: KeyboardInterrupt, 10: GeneratorExit, 11: RuntimeError}[camera.sensor.bits]("why")

    found = with_timeout(lambda: explore.sweep(SHOT, {"sensor.bits": [8, 9, 10, 11]}, metrics=[raising], workers=1))

    kinds = ("SystemExit", "KeyboardInterrupt", "GeneratorExit", "RuntimeError")
    assert found["error"].values.tolist() == [f"raising: {kind}: why" for kind in kinds]


def pausing_plan(when, directory=None):
    """
    Plan a sweep with a metric that pauses its worker permanently, as dask does when its memory is full.

    Paused workers create a file in the directory.
    """

    def pausing(_, camera, __):
        from distributed import Status, get_worker

        if when(camera.sensor.bits):
            get_worker().memory_manager.memory_pause_fraction = False  # prevents dask from resuming the worker
            get_worker().status = Status.paused
            if directory is not None:
                (directory / f"{os.getpid()}").touch()
        time.sleep(SLOW_S)
        return os.getpid()

    return explore.plan_sweep(SHOT, {"sensor.bits": list(range(4, 16))}, metrics=[pausing])


@pytest.mark.slow
def test_tasks_of_paused_worker_are_moved(monkeypatch):
    monkeypatch.setattr("foveasim.explore.cluster.PAUSED_S", 1.0)
    found = with_timeout(lambda: explore.run_sweep(pausing_plan(lambda bits: bits == 4), workers=2))

    assert (found["error"] == "").all()
    one = found["pausing"].sel({"sensor.bits": 4})
    assert (found["pausing"] == one).sum() < 6


@pytest.mark.slow
def test_pause_of_all_workers_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr("foveasim.explore.cluster.PAUSED_S", 1.0)

    def shorten():  # the workers may start slowly
        wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
        monkeypatch.setattr("foveasim.explore.executor.NO_WORKER_TIMEOUT_S", 1.0)

    shortening = threading.Thread(target=shorten)
    shortening.start()
    with pytest.raises(
        SimulationError,
        match=r"no worker has computed anything for 1 s: all are closing, or paused.*; \d+ of 12 points are done",
    ):
        with_timeout(lambda: explore.run_sweep(pausing_plan(lambda _: True, tmp_path), workers=2))
    shortening.join()


@pytest.mark.slow
def test_killed_scheduler_is_reported_with_journal(tmp_path):
    store = tmp_path / "r.zarr"
    plan = plan_120(logging_metric(tmp_path, SLOW_S, journal_path(store)))
    (tmp_path / "held").write_text("6")

    def kill(program):
        wait_until(lambda: len(journal_points(store)) >= 5)
        program.kill()
        (tmp_path / "held").unlink()

    with programs(1) as (address, program):
        killer = threading.Thread(target=kill, args=(program,))
        killer.start()
        with pytest.raises(SimulationError, match=r"the scheduler no longer answers; \d+ of 120 points are done"):
            explore.run_sweep(plan, out=store, scheduler=address)
        killer.join()

    assert len(journal_points(store)) >= 5


def test_point_seed_depends_on_seed_and_number():
    few = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}, seed=3)
    many = plan_120()

    assert [few.seed_of(k) for k in range(2)] == [many.seed_of(k) for k in range(2)]
    assert len({many.seed_of(k) for k in range(many.n_points)}) == many.n_points
    assert many.seed_of(0) != explore.plan_sweep(SHOT, VARY_120, seed=4).seed_of(0)


# -- interruptions ----------------------------------------------------------------------------------------------------


def journal_points(store):
    lines = journal_path(store).read_text().splitlines() if journal_path(store).exists() else []
    return [json.loads(line.partition(" ")[2])["point"] for line in lines[1:]]


def test_plan_is_unchanged_by_list_items():
    shot = SHOT | {"layout": SHOT["layout"] | {"move_um": [0.0, 0.0]}}
    plan = explore.plan_sweep(shot, {"layout.move_um.0": [1.0, 2.0]})
    before = json.dumps(plan.to_dict())

    assert plan.settings_of(0)["layout"]["move_um"] == [1.0, 0.0]
    assert json.dumps(plan.to_dict()) == before
    assert plan.settings["layout"]["move_um"] == [0.0, 0.0]


@pytest.mark.slow
def test_killed_worker_loses_at_most_one_task(reference_results, tmp_path):
    plan = plan_120(logging_metric(tmp_path, SLOW_S))
    (tmp_path / "held").write_text("61")
    store = tmp_path / "r.zarr"
    stored = []

    def kill():
        wait_until(lambda: len(executions(tmp_path)) > 40 and journal_points(store))
        stored.extend(journal_points(store))
        # Until the worker has released the stored results.
        wait_until(lambda: len(executions(tmp_path)) > 60)
        os.kill(executions(tmp_path)[-1][1], signal.SIGKILL)
        (tmp_path / "held").unlink()

    killer = threading.Thread(target=kill)
    killer.start()
    found = explore.run_sweep(plan, out=store, workers=2)
    killer.join()

    assert (found["error"] == "").all()
    np.testing.assert_array_equal(found["mean_dn"], reference_results["mean_code_dn"])
    seeds = [seed for seed, _ in executions(tmp_path)]
    assert set(seeds) == set(reference_results["seed"].values.ravel().tolist())
    assert stored
    assert all(seeds.count(plan.seed_of(point)) == 1 for point in stored)
    # At most the points of one task of the killed worker are computed again.
    assert len(seeds) - len(set(seeds)) <= round(CHUNK_S / SLOW_S)


METRIC = """
import os, time
from pathlib import Path

def mean_dn(shot, camera, capture):
    log = os.open(Path(LOG), os.O_CREAT | os.O_APPEND | os.O_WRONLY)
    os.write(log, f"{shot.seed} {os.getpid()}\\n".encode())
    os.close(log)
    while is_held():
        time.sleep(0.01)
    return float(capture.code.mean())

# While the file "held" exists, points wait when the journal has as many lines as that file says.
def is_held():
    try:
        return len(Path(JOURNAL).read_text().splitlines()) >= int(Path(LOG).with_name("held").read_text())
    except OSError:
        return False
"""


@pytest.fixture
def directory(tmp_path):
    """Directory with a sweep of 60 points, and a metric that logs its executions."""
    (tmp_path / "shot.yaml").write_text(json.dumps(SHOT))
    paths = {"LOG": tmp_path / "log", "JOURNAL": journal_path(tmp_path / "results.zarr")}
    (tmp_path / "own.py").write_text("".join(f"{name} = {str(path)!r}\n" for name, path in paths.items()) + METRIC)
    vary = {"sensor.bits": [8, 10], "exposure_s": {"from": 0.01, "to": 0.1, "n": 10, "spacing": "geometric"}}
    (tmp_path / "sweep.yaml").write_text(json.dumps({"shot": "shot.yaml", "vary": vary, "repeats": 3, "seed": 3}))
    return tmp_path


def test_geometric_range_has_round_numbers(tmp_path):
    (tmp_path / "shot.yaml").write_text(json.dumps(SHOT))
    vary = {"sensor.bits": {"from": 2, "to": 8, "n": 3, "spacing": "geometric"}}
    (tmp_path / "sweep.yaml").write_text(json.dumps({"shot": "shot.yaml", "vary": vary}))

    assert explore.read_sweep(tmp_path / "sweep.yaml").values["sensor.bits"] == [2, 4, 8]


COMMAND = ["sweep", "sweep.yaml", "--metric", "own:mean_dn", "--workers"]


def interrupt(number, directory, n_points):
    """Start a sweep and send a signal when n points are stored; return exit code, messages, and points in the journal."""
    store = directory / "results.zarr"
    (directory / "held").write_text(str(1 + n_points))
    command = [sys.executable, "-m", "foveasim.cli", *COMMAND, "1"]
    running = subprocess.Popen(
        command, cwd=directory, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: len(journal_points(store)) >= n_points, program=running)
    if number == signal.SIGINT:  # as Ctrl-C in a terminal, which all processes of the group receive
        os.killpg(running.pid, number)
    else:
        os.kill(running.pid, number)
    _, messages = running.communicate(timeout=DEADLINE_S)
    wait_until(lambda: all(has_ended(process) for _, process in executions(directory)))
    (directory / "held").unlink()
    return running.returncode, messages, journal_points(store)


@pytest.mark.slow
def test_interrupted_sweep_resumes_without_repetition(directory, monkeypatch, capsys):
    code, printed, after_stop = interrupt(signal.SIGINT, directory, 10)
    n_stop = len(executions(directory))

    assert code == 130
    assert (
        printed
        == "interrupted; finished points are stored next to results.zarr, run the same command again to resume\n"
    )
    assert 10 <= len(after_stop) < 60

    code, _, after_kill = interrupt(signal.SIGKILL, directory, len(after_stop) + 1)
    n_kill = len(executions(directory))

    assert code == -signal.SIGKILL
    assert after_kill[: len(after_stop)] == after_stop
    assert len(after_stop) < len(after_kill) < 60

    ended = run_here(monkeypatch, capsys.readouterr, *COMMAND, "0", cwd=directory)

    assert ended.returncode == 0, ended.stderr
    assert not journal_path(directory / "results.zarr").exists()
    found = explore.open_results(directory / "results.zarr")
    assert (found["error"] == "").all()
    np.testing.assert_array_equal(found["mean_dn"], found["mean_code_dn"])
    assert found["mean_dn"].min() > 0
    plan = explore.read_sweep(directory / "sweep.yaml")
    seeds = [seed for seed, _ in executions(directory)]
    assert {plan.seed_of(point) for point in after_stop}.isdisjoint(seeds[n_stop:])
    assert {plan.seed_of(point) for point in after_kill}.isdisjoint(seeds[n_kill:])
    assert len(seeds[n_kill:]) == 60 - len(after_kill)


@pytest.mark.slow
def test_failed_points_are_reported_and_retried(tmp_path):
    fatal = tmp_path / "fatal"
    fatal.touch()

    def unreliable(shot, *_):
        if shot.exposure_s == 0.5:
            raise RuntimeError("failed")
        if shot.exposure_s == 1.0 and fatal.exists():
            os._exit(1)
        return 7.0

    vary = {"exposure_s": [0.1, -1.0, 0.5, 1.0, 2.0]}
    plan = explore.plan_sweep(SHOT, vary, metrics={"unreliable": unreliable, "n_sites": METRICS["n_sites"]})

    found = explore.run_sweep(plan, out=tmp_path / "r.zarr", workers=1)

    assert found["error"].values.tolist() == [
        "",
        "vary.exposure_s: must be >= 0, got -1.0 s; times are in seconds: 1 ms is 1e-3",
        "unreliable: RuntimeError: failed",
        "worker process ended in every attempt: out of memory, or a crash in a metric",
        "",
    ]
    np.testing.assert_array_equal(found["unreliable"], [7.0, np.nan, np.nan, np.nan, 7.0])
    np.testing.assert_array_equal(found["n_sites"], [64, np.nan, 64, np.nan, 64])

    fatal.unlink()
    found = explore.run_sweep(plan, out=tmp_path / "r.zarr", workers=1, retry=True)

    np.testing.assert_array_equal(found["unreliable"], [7.0, np.nan, np.nan, 7.0, 7.0])
    assert journal_path(tmp_path / "r.zarr").exists()


@pytest.mark.slow
def test_failed_points_can_be_retried_repeatedly(tmp_path, monkeypatch):
    monkeypatch.setattr("foveasim.explore.cluster.SCHEDULER_S", 0.5)
    bad = tmp_path / "bad"
    bad.touch()

    def unreliable(*_):
        if bad.exists():
            raise RuntimeError("failed")
        return 7.0

    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}, metrics=[unreliable])
    store = tmp_path / "r.zarr"
    explore.run_sweep(plan, out=store, workers=1)
    before = journal_path(store).read_bytes()
    with pytest.raises(ParameterError, match="scheduler"):
        explore.run_sweep(plan, out=store, scheduler="tcp://127.0.0.1:1", retry=True)

    assert journal_path(store).read_bytes() == before

    bad.unlink()
    journal_path(store).unlink()
    found = explore.run_sweep(plan, out=store, workers=1)

    assert found["error"].values.tolist() == ["unreliable: RuntimeError: failed"] * 2

    found = explore.run_sweep(plan, out=store, workers=1, retry=True)

    assert found["error"].values.tolist() == ["", ""]
    assert found["unreliable"].values.tolist() == [7.0, 7.0]
    assert not journal_path(store).exists()


# -- the journal and the store ----------------------------------------------------------------------------------------


@cache
def plan_3():
    return explore.plan_sweep(SHOT, {"sensor.bits": [8, 9, 10]})


def test_journal_ignores_truncated_lines_only(tmp_path):
    store = tmp_path / "r.zarr"
    with Journal(store, plan_3().to_dict()) as journal:
        for point in range(3):
            journal.add(Record(point, {"a": 0.1 + point, "curve": to_values("c", np.arange(3.0))["c"]}, "", "µ"))
    complete = journal_path(store).read_bytes()
    for n_cut in (1, 20, 60):
        journal_path(store).write_bytes(complete[:-n_cut])
        with Journal(store, plan_3().to_dict()) as journal:
            assert sorted(journal.records) == [0, 1]
            assert journal.records[1].values["a"] == 1.1
            np.testing.assert_array_equal(journal.records[1].values["curve"].data, np.arange(3.0))
    damaged = bytearray(complete)
    damaged[complete.index(b'"a": 1.1') + 5] ^= 1
    journal_path(store).write_bytes(damaged)
    with Journal(store, plan_3().to_dict()) as journal:
        assert sorted(journal.records) == [0, 2]


def test_journal_with_truncated_header_is_restarted(tmp_path):
    store = tmp_path / "r.zarr"
    with Journal(store, plan_3().to_dict()) as journal:
        head = journal_path(store).read_bytes()
    for torn in (head[:40], head[:-1], b"\0" * 100, b""):
        journal_path(store).write_bytes(torn)
        with Journal(store, plan_3().to_dict()) as journal:
            assert journal.records == {}
            journal.add(Record(0, {"a": 1.0}))
        with Journal(store, plan_3().to_dict()) as journal:
            assert sorted(journal.records) == [0]
        journal_path(store).unlink()


def test_full_disk_leaves_valid_journal(tmp_path, monkeypatch):
    store = tmp_path / "r.zarr"
    write = os.write

    def full(file, data):
        write(file, bytes(data)[:10])
        raise OSError(28, "No space left on device")

    with Journal(store, plan_3().to_dict()) as journal:
        journal.add(Record(0, {"a": 1.0}))
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(FileError, match=r"No space left on device; it contains 1 points"):
            journal.add(Record(1, {"a": 2.0}))
    monkeypatch.undo()
    with Journal(store, plan_3().to_dict()) as journal:
        assert sorted(journal.records) == [0]


def test_sweep_store_is_locked(tmp_path):
    store = tmp_path / "r.zarr"
    with Journal(store, plan_3().to_dict()), pytest.raises(FileError, match="being written by another program"):
        Journal(store, plan_3().to_dict())


def test_store_of_other_sweep_is_unchanged(tmp_path):
    store = tmp_path / "r.zarr"
    write_store(to_dataset(plan_3(), {}), store)
    other = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9, 12]})

    with pytest.raises(FileError, match=r"belongs to another sweep or study: 'vary\.sensor\.bits' differs"):
        explore.run_sweep(other, out=store)
    assert explore.open_results(store)["sensor.bits"].values.tolist() == [8, 9, 10]


@pytest.mark.slow
def test_equally_named_metrics_are_distinguished(tmp_path):
    def fraction_above(level):
        return lambda _, __, capture: float((capture.code > level).mean())

    plans = [
        explore.plan_sweep(SHOT, {"sensor.bits": [8]}, metrics={"fraction": fraction_above(level)})
        for level in (0, 255)
    ]
    found = explore.run_sweep(plans[0], out=tmp_path / "r.zarr", workers=1)

    assert found["fraction"].item() == 1.0
    with pytest.raises(FileError, match=r"'metrics\.fraction' differs"):
        explore.run_sweep(plans[1], out=tmp_path / "r.zarr", workers=1)


@pytest.mark.parametrize("text", ["my notes", "my notes\n", "{}\n{}\n", "cafe", '{"format": "foveasim'])
def test_invalid_journal_file_is_unchanged(tmp_path, text):
    journal_path(tmp_path / "r.zarr").write_text(text)

    with pytest.raises(FileError, match="is not a sweep journal"):
        explore.run_sweep(plan_3(), out=tmp_path / "r.zarr")
    assert journal_path(tmp_path / "r.zarr").read_text() == text


# -- contents of results ----------------------------------------------------------------------------------------------


def test_xarray_opens_store_without_warning(tmp_path):
    records = {k: Record(k, {"a": 1.0, "path": "ab"[k]}) for k in range(2)}
    found = to_dataset(explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}), records)
    write_store(found, tmp_path / "r.zarr")  # warnings are errors here, too

    with xr().open_zarr(tmp_path / "r.zarr") as opened:
        assert_identical(opened.load(), found)


def test_arrays_are_aligned_or_padded():
    one = xr().DataArray([1.0, 2.0], dims="colour", coords={"colour": ["red", "green"]})
    two = xr().DataArray([3.0, 4.0], dims="colour", coords={"colour": ["green", "blue"]})
    records = {
        k: Record(
            k, to_values("c", array) | to_values("m", {"n": k, "path": "ab"[k]}) | to_values("v", np.arange(k + 1))
        )
        for k, array in enumerate((one, two))
    }

    found = to_dataset(explore.plan_sweep(SHOT, {"sensor.bits": [8, 9]}), records)

    assert found["colour"].values.tolist() == ["red", "green", "blue"]
    np.testing.assert_array_equal(found["c"], [[1.0, 2.0, np.nan], [np.nan, 3.0, 4.0]])
    np.testing.assert_array_equal(found["v"], [[0.0, np.nan], [0.0, 1.0]])
    assert found["m_n"].values.tolist() == [0, 1]
    assert found["m_path"].values.tolist() == ["a", "b"]


UNUSUAL = {
    "0-d array": lambda _: np.array(3.0),
    "0-d DataArray": lambda k: xr().DataArray(np.arange(k + 2.0)).mean(),
    "Dataset": lambda k: xr().Dataset({"a": 3.0, "b": ("x", np.arange(k + 2.0))}),
    "longdouble array": lambda _: np.arange(3, dtype=np.longdouble),
    "longdouble scalar": lambda _: np.longdouble(3.0),
    "big-endian": lambda _: np.arange(3, dtype=">i4"),
    "large integer": lambda _: 2**70,
    "uint64": lambda _: np.array([2**63 + 5], np.uint64),
    "empty array": lambda _: np.array([]),
    "object array of strings": lambda _: np.array(["a", "bc"], object),
    "number and string": lambda k: "seven" if k else 7,
    "labels of mixed types": lambda k: xr().DataArray([1.0, 2.0], dims="x", coords={"x": ["1", "b"] if k else [1, 2]}),
    "large labels": lambda k: xr().DataArray(
        [1.0], dims="x", coords={"x": np.array([2**63], np.uint64) if k else [-1]}
    ),
    "dimension repeat": lambda _: xr().DataArray([1.0, 2.0], dims="repeat", coords={"repeat": [5, 6]}),
    "dimension with metric name": lambda _: xr().DataArray([1.0, 2.0], dims="odd", coords={"odd": [5, 6]}),
    "dimension with setting name": lambda _: xr().DataArray(
        [1.0, 2.0], dims="exposure_s", coords={"exposure_s": [5, 6]}
    ),
    "dimension with result name": lambda _: {"0": 1.0, "a": xr().DataArray([1.0, 2.0], dims="odd_0")},
    "partly labelled dimension": lambda _: {
        "a": xr().DataArray([1.0], dims="x", coords={"x": [5]}),
        "b": xr().DataArray([1.0, 2.0], dims="x"),
    },
}


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("kind", UNUSUAL)
def test_unusual_results_are_stored_and_read(kind, tmp_path):
    plan = explore.plan_sweep(SHOT, {"exposure_s": [0.01, 0.02]}, repeats=2)
    records = {k: Record(k, to_values("odd", UNUSUAL[kind](k % 2))) for k in range(plan.n_points)}
    with Journal(tmp_path / "r.zarr", plan.to_dict()) as journal:
        for record in records.values():
            journal.add(record)
    with Journal(tmp_path / "r.zarr", plan.to_dict()) as journal:
        found = to_dataset(plan, journal.records)
    write_store(found, tmp_path / "r.zarr")

    assert_identical(explore.open_results(tmp_path / "r.zarr"), found)
    assert_identical(to_dataset(plan, records), found)
    assert (found["error"] == "").all()
    names = [name for name in found.data_vars if name.startswith("odd")]
    assert names
    for name in names:
        given = to_values("odd", UNUSUAL[kind](1))[name]
        data = np.asarray(getattr(given, "data", given))
        stored = found[name].values[0, 1]
        if data.dtype.kind == "U":
            assert {str(one) for one in np.ravel(stored)} >= {str(one) for one in np.ravel(data)}
        else:
            assert set(stored.ravel().tolist()) >= set(data.astype(stored.dtype).ravel().tolist())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.array([1j]), "must return numbers or strings, got an array of complex128"),
        (np.array([None, "a"]), "must return numbers or strings, got an array of object"),
        (np.array(["2020-01-01"], "datetime64[D]"), "must return numbers or strings"),
        ("\ud800", "must return valid Unicode strings"),
        (np.array(["a", "\ud800"]), "must return valid Unicode strings"),
        (
            lambda: xr().DataArray([1.0, 2.0], dims="x", coords={"x": [1.0, np.nan]}),
            "unique labels along 'x', without NaN",
        ),
        (lambda: xr().DataArray([1.0, 2.0, 3.0], dims="x", coords={"x": [0.5, 0.5, 1]}), "unique labels along 'x'"),
        ({"a/b": 1}, "'m_a/b' must be a short printable string without '/', as the name of a result"),
        ({"a" * 300: 1}, "as the name of a result"),
        ({"\ud800": 1}, "as the name of a result"),
        (lambda: xr().DataArray([1.0], dims="a/b", coords={"a/b": [1]}), "as the name of a result"),
        ({"a": {"b": 1}, "a_b": 99}, "'m_a_b' must be a unique result name, got two results"),
        (None, "must return a number, a string, a mapping, an array or a labelled array, got a NoneType"),
    ],
)
def test_unsupported_results_are_rejected(given, message):
    with pytest.raises(ParameterError, match=message):
        to_values("m", given() if callable(given) else given)


def test_results_with_differing_dimensions_are_reported():
    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8, 9, 10, 11]})
    given = [3.0, np.arange(2.0), 4.0, xr().DataArray([1.0], dims="x", coords={"x": [1]})]
    records = {k: Record(k, to_values("m", one), "failed" if k == 3 else "") for k, one in enumerate(given)}

    found = to_dataset(plan, records)

    np.testing.assert_array_equal(found["m"], [3.0, np.nan, 4.0, np.nan])
    message = "m: has other dimensions or labels than in most points, which have none"
    assert found["error"].values.tolist() == ["", message, "", f"failed; {message}"]
    many = to_dataset(plan, {k: Record(k, to_values("m", given[1] if k else 3.0)) for k in range(4)})
    assert many["m"].shape == (4, 2)
    assert np.isnan(many["m"][0]).all()


def test_duplicate_result_names_are_reported():
    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8]}, metrics={"a": lambda *_: {"b": 1}, "a_b": lambda *_: 2})

    found = in_process(plan)

    assert found["a_b"].item() == 1
    assert found["error"].item() == "'a_b' must be a unique result name, got two results"


def test_listed_points_are_labelled_with_settings():
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


# -- shared components ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_shared_components_are_built_once():
    plan = plan_120()
    runner = runner_of(plan)
    order, _ = plan.order()
    shared = {int(point): runner.record(point, plan.settings_of(point)) for point in order}

    assert {part: runner.cache.n_built[part] for part in ("scene", "layout", "optics", "images", "power on sites")} == {
        "scene": 1,
        "layout": 2,
        "optics": 2,
        "images": 2,
        "power on sites": 4,
    }
    small = runner_of(plan, max_bytes=0)
    for point in (0, 119, 57):
        assert small.record(point, plan.settings_of(point)) == shared[point]


@pytest.mark.slow(keep=("[200000]",))
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
        assert {part for part, _ in new} >= {"layout", "sensor", "camera", "power on sites"}
        sizes.append(sum(part.n_bytes for part in parts.values()))
        least = sum(
            part.n_bytes for key, part in parts.items() if key in new or key[0] in {"scene", "optics", "images"}
        )
        assert sizes[-1] <= max(max_bytes, least)
    assert max(sizes) > 0.5 * max_bytes


def test_points_are_grouped_by_shared_components():
    for plan in (
        plan_120(),
        explore.plan_sweep(SHOT, [{"sensor.bits": 6 + k % 3, "optics.f_number": 2.0 + k % 2} for k in range(12)]),
    ):
        order, begins = plan.order()
        assert sorted(order) == list(range(plan.n_points))
        kinds = [json.dumps([plan.settings_of(k)[part] for part in ("layout", "optics")]) for k in order]
        assert len(begins) == len(set(kinds))
        assert all(len(set(kinds[a:b])) == 1 for a, b in zip(begins, [*begins[1:], None], strict=True))


@pytest.mark.parametrize("pupil", [None, {"kind": "slit", "width_fraction": 0.3}])
def test_known_images_need_no_transform(pupil):
    optics = SHOT["optics"] if pupil is None else {**SHOT["optics"], "pupil": pupil}
    shot = build_shot("reference", {**SHOT, "optics": optics})
    images = {}
    shot.camera.photoelectrons_per_s(shot.scene, images=images)
    moved = build_shot("reference", {**SHOT, "optics": optics, "layout": {**SHOT["layout"], "move_um": [3.0, -2.0]}})
    found = moved.camera.photoelectrons_per_s(shot.scene, images=images)

    np.testing.assert_array_equal(found, moved.camera.photoelectrons_per_s(shot.scene))


def test_camera_reuses_images_and_compiled_layout():
    shot = build_shot("reference", SHOT)
    camera, images = shot.camera, {}
    known = camera.photoelectrons_per_s(shot.scene, images=images)
    copies = {key: image.copy() for key, image in images.items()}
    again = camera.replace(sensor=shot.camera.sensor).photoelectrons_per_s(shot.scene, images=images)

    np.testing.assert_array_equal(known, again)
    assert copies
    assert all(np.array_equal(images[key], image) for key, image in copies.items())
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
    with pytest.raises(ParameterError, match="'photo_e_per_s' must have one value for each of the 64 sites"):
        camera.capture(shot.scene, exposure_s=0.01, seed=1, photo_e_per_s=known[:3])


@pytest.mark.slow
def test_framing_follows_lens_and_layout():
    scene = {"kind": "picture", "picture": "skimage:camera", "fit": "width", "distance_m": 1.0, "wavelength_nm": 550}
    scene |= {"band_width_nm": 100.0, "peak_radiance_w_m2_sr_nm": 0.1}
    vary = {"optics.focal_length_mm": [4.0, 8.0], "layout.parameters.n_x": [16, 24], "scene.fit": ["width", "cover"]}

    def image_um(shot, camera, _):
        x0, _, x1, _ = camera.image_grid(shot.scene).bounds_um
        return x1 - x0

    layout = {"generator": "grid", "parameters": {"n_x": 16, "n_y": 20, "pitch_um": 3.0}}
    plan = explore.plan_sweep(
        SHOT | {"scene": scene, "layout": layout},
        vary,
        metrics={"image_um": image_um, "psnr": METRICS["psnr_db"]},
    )
    runner = runner_of(plan)
    for k in range(plan.n_points):
        settings = plan.settings_of(k)
        shared, alone = runner.record(k, settings), runner_of(plan).record(k, settings)
        width_um = 3.0 * settings["layout"]["parameters"]["n_x"]
        expected_um = width_um if settings["scene"]["fit"] == "width" else max(width_um, 60.0)  # a square picture
        assert (shared.error, shared.warning) == ("", "")
        assert shared.values["image_um"] == pytest.approx(expected_um, rel=1e-12)
        assert shared.values == alone.values


def test_framed_reference_depends_on_distortion():
    scene = {"kind": "picture", "picture": "skimage:camera", "fit": "width", "distance_m": 1.0, "wavelength_nm": 550}
    shot = SHOT | {
        "scene": scene | {"band_width_nm": 100.0, "peak_radiance_w_m2_sr_nm": 0.1},
        "layout": {"generator": "grid", "parameters": {"n_x": 16, "n_y": 12, "pitch_um": 3.0}},
        "distortion": {"kind": "brown_conrady", "focal_um": 100.0},
    }
    plan = explore.plan_sweep(shot, {"distortion.k1": [-0.3, 0.3]}, metrics=["psnr_db"])
    runner = runner_of(plan)
    shared = [runner.record(k, plan.settings_of(k)).values for k in range(2)]

    assert shared == [runner_of(plan).record(k, plan.settings_of(k)).values for k in range(2)]
    assert runner.cache.n_built["reference"] == 2


# -- invalid sweeps ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vary", "options", "error", "message"),
    [
        ({"sensor.bitz": [8]}, {}, ConfigError, r"sensor\.bitz: unknown (key|parameter)"),
        ({"sensor.bits": ["ten"]}, {}, ConfigError, r"sensor\.bits: must be a valid integer, got \"ten\""),
        ({"sensor.bits": [8, "ten"]}, {"mode": "zip"}, ConfigError, r"sensor\.bits: must be a valid integer"),
        (
            {"exposure_s.x": [8]},
            {},
            ConfigError,
            r"'exposure_s\.x=8' cannot be set: exposure_s must be a section, got 0\.01",
        ),
        ({"sensor.": [8]}, {}, ConfigError, r"'sensor\.' must be the path of a setting"),
        ({}, {}, ParameterError, "'vary' must have at least one value"),
        ([], {}, ParameterError, "'vary' must be a mapping of setting paths to values, or a list of points"),
        ({"sensor.bits": []}, {}, ParameterError, r"'sensor\.bits' must have at least one value"),
        ({"sensor.bits": 8}, {}, ParameterError, r"'sensor\.bits' must vary over a list of values, got 8"),
        (
            {"sensor.bits": range(10**9)},
            {},
            ParameterError,
            r"'sensor\.bits' must have at most 1,000,000 values, got 1,000,000,000",
        ),
        (
            {f"sensor.{n}": range(1000) for n in ("bits", "v_sat_v", "prnu_fraction")},
            {},
            ParameterError,
            "must specify at most 1,000,000 points, got 1,000,000,000",
        ),
        ({"sensor.bits": [8]}, {"repeats": 10**9}, ParameterError, "'repeats' must be .* 1000000"),
        ({"sensor.bits": [8, 8]}, {}, ParameterError, "must have unique values, got 8 twice"),
        ({"exposure_s": [2, 2.0]}, {}, ParameterError, r"must have unique values, got 2\.0 twice"),
        ({"sensor.device_seed": [2**64, 2**64 + 1]}, {}, ParameterError, r"must have unique values, got .* twice"),
        ({"exposure_s": [0.1, float("nan")]}, {}, ParameterError, r"'exposure_s' must vary over numbers.*, got nan"),
        ({"sensor.bits": {8, 10}}, {}, ParameterError, "'sensor.bits' must vary over a list of values"),
        (
            {"sensor.bits": [8], "exposure_s": [1, 2]},
            {"mode": "zip"},
            ParameterError,
            r"\(sensor\.bits: 1, exposure_s: 2\)",
        ),
        ({"sensor.bits": [8]}, {"mode": "grid"}, ParameterError, "'mode' must be"),
        (
            {"sensor.bits": [8]},
            {"metrics": ["beauty"]},
            ParameterError,
            "'metrics' must be names of metrics, got 'beauty'",
        ),
        ({"sensor.bits": [8]}, {"metrics": []}, ParameterError, "'metrics' must contain at least one metric"),
        ({"sensor.bits": [8]}, {"metrics": [lambda *_: 1]}, ParameterError, "must have names that are identifiers"),
        ({"sensor.bits": [8]}, {"metrics": {"seed": len}}, ParameterError, "must not have the reserved name 'seed'"),
        (
            {"sensor.bits": [8]},
            {"metrics": {"a": len, "A": len}},
            ParameterError,
            "more than the case of letters, got 'A'",
        ),
        ({"sensor.bits": [8]}, {"metrics": {"con": len}}, ParameterError, "must have names of files, .* got 'con'"),
        (
            {"exposure_s": [8]},
            {"metrics": {"exposure_s": len}},
            ParameterError,
            "'metrics' must not have the name of a varied setting, got 'exposure_s'",
        ),
        ({"sensor.bits": [object()]}, {}, ParameterError, r"'sensor\.bits' must vary over numbers, strings"),
        ({"seed": [1, 2]}, {}, ParameterError, "'seed' must not vary"),
        ({"layout": ["four_zones"], "layout.parameters.n_x": [8]}, {}, ConfigError, "cannot both vary"),
        (
            [{"sensor.bits": 8}, {"exposure_s": 1}],
            {},
            ParameterError,
            r"'points' must all have the settings sensor\.bits",
        ),
    ],
)
def test_invalid_sweep_is_rejected_before_start(vary, options, error, message):
    with pytest.raises(error, match=message) as caught:
        explore.plan_sweep(SHOT, vary, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("store", ["nowhere/r.zarr", "file", "directory"])
def test_unwritable_store_is_rejected_before_start(tmp_path, store):
    (tmp_path / "file").touch()
    (tmp_path / "directory").mkdir()

    with pytest.raises(FileError, match="cannot be written"):
        explore.run_sweep(plan_3(), out=tmp_path / store)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("address", ["127.0.0.1", "tcp://", "foo://host:1", "silent"])
def test_unreachable_scheduler_is_rejected_before_start(tmp_path, monkeypatch, address):
    monkeypatch.setattr("foveasim.explore.cluster.SCHEDULER_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        if address == "silent":  # an open port without answers
            address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(
            ParameterError, match="'scheduler' must be the address of a dask scheduler that answers within"
        ):
            explore.run_sweep(plan_3(), out=tmp_path / "r.zarr", scheduler=address)
    assert list(tmp_path.iterdir()) == []


def test_other_servers_are_rejected_as_scheduler():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            with server.accept()[0] as one:
                one.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(ParameterError, match=r"within 10 s \(it is not a dask scheduler\)"):
            explore.run_sweep(plan_3(), scheduler=f"tcp://127.0.0.1:{server.getsockname()[1]}")


@pytest.mark.slow
def test_missing_main_guard_is_reported_once(tmp_path):
    (tmp_path / "own.py").write_text(
        f"from foveasim import explore\nexplore.sweep({SHOT!r}, {{'sensor.bits': [8]}}, workers=1)\n"
    )
    command = [sys.executable, "own.py"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=LIMIT_S)

    assert result.returncode == 1
    assert result.stderr.count("Traceback") == 1
    assert "SimulationError: the workers did not start" in result.stderr
    assert 'make the call under if __name__ == "__main__":' in result.stderr.splitlines()[-1]


def test_unpicklable_metric_is_rejected():
    lock = threading.Lock()
    plan = explore.plan_sweep(SHOT, {"sensor.bits": [8]}, metrics={"locked": lambda *_: lock.locked()})

    with pytest.raises(SimulationError, match="metrics cannot be sent to other processes"):
        explore.run_sweep(plan, workers=1)


# -- files ------------------------------------------------------------------------------------------------------------


def test_file_and_call_give_equal_plans(directory):
    read = explore.read_sweep(directory / "sweep.yaml")
    called = explore.plan_sweep(
        directory / "shot.yaml",
        {"sensor.bits": [8, 10], "exposure_s": np.geomspace(0.01, 0.1, 10)},
        repeats=3,
        seed=3,
    )

    assert read.to_dict() == called.to_dict()
    assert read.shape == (2, 10, 3)
    assert read.dims == ("sensor.bits", "exposure_s", "repeat")


def test_sweep_file_imports_no_code(directory, monkeypatch, capsys):
    (directory / "untrusted.py").write_text(f"open({str(directory / 'imported')!r}, 'w')")
    sweep = {"shot": "shot.yaml", "vary": {"sensor.bits": [8]}, "metrics": ["untrusted:metric"]}
    (directory / "bad.yaml").write_text(json.dumps(sweep))
    monkeypatch.syspath_prepend(directory)
    ended = run_here(monkeypatch, capsys.readouterr, "sweep", "bad.yaml", cwd=directory)

    assert ended.returncode == 2
    assert "'metrics' must be names of metrics" in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert not (directory / "imported").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vary": None}, "must have either 'vary' or 'points'"),
        ({"points": [{"sensor.bits": 8}]}, "must have either 'vary' or 'points'"),
        ({"vary": {"sensor.bits": {"from": 1}}}, "vary.sensor.bits"),
        (
            {"vary": {"sensor.v_sat_v": {"from": 0, "to": 1, "n": 3, "spacing": "geometric"}}},
            "must have non-zero bounds of equal sign for geometric spacing",
        ),
        ({"shot": "none.yaml"}, "none.yaml: no such file"),
        ({"repeat": 3}, "repeat: unknown (key|parameter)"),
        ({"repeats": "three"}, "repeats: must be a valid integer"),
        ({"set": {"sensor.bitz": 3}}, r"sensor\.bitz: unknown (key|parameter)"),
    ],
)
def test_invalid_sweep_file_is_rejected(directory, change, message):
    sweep = json.loads((directory / "sweep.yaml").read_text()) | change
    (directory / "bad.yaml").write_text(json.dumps({key: value for key, value in sweep.items() if value is not None}))

    with pytest.raises(ConfigError, match=message):
        explore.read_sweep(directory / "bad.yaml")


def test_plans_depend_on_file_contents(directory):
    (directory / "photo.png").write_bytes(b"one")
    scene = {
        "kind": "picture",
        "picture": "photo.png",
        "pitch_um": 1.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 1.0,
    }
    (directory / "shot.yaml").write_text(json.dumps(SHOT | {"scene": scene}))
    plans = [explore.plan_sweep(directory / "shot.yaml", {"sensor.bits": [8]})]
    (directory / "photo.png").write_bytes(b"two")
    plans.append(explore.plan_sweep(directory / "shot.yaml", {"sensor.bits": [8]}))

    assert plans[0].settings == plans[1].settings
    assert plans[0].settings["scene"]["picture"] == str(directory / "photo.png")
    assert plans[0].to_dict() != plans[1].to_dict()


# -- access to local clusters -----------------------------------------------------------------------------------------


def attempt(address, arguments, function):
    """Try to run a function at a dask address, as a client of a scheduler and as a peer of a worker."""
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


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("certificate", ["none", "another"])
def test_only_owner_runs_code_on_local_workers(certificate, tmp_path):
    from distributed import Security

    from foveasim.explore.cluster import open_client

    mark = tmp_path / "mark"
    with open_client(None, 1) as client:
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
    from foveasim.explore.cluster import open_client

    with open_client(None, 1) as client:
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
