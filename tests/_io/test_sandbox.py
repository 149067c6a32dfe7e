"""Sandbox process: order, limits, crashes, invalid answers, denied calls, and the end of the process."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from threading import Timer

import numpy as np
import pytest
from waiting import DEADLINE_S, has_ended, wait_until

from foveasim._io import _sandboxed, sandbox
from foveasim._io.sandbox import iterate_in_sandbox, read_in_sandbox, run_in_sandbox
from foveasim._io.zarr_stores import check_codecs, store_format
from foveasim.errors import FileError

READERS = """
import os, time
import numpy as np

def count(path, n, is_skipped=False):
    for k in range(n):
        yield None if is_skipped and k < n - 1 else np.full((2, 3), k, np.uint8)

def crash(path):
    yield np.zeros(2)
    os.abort()

def reject(path):
    yield np.zeros(2)
    raise ValueError("broken at byte 7")

def hang(path):
    yield np.zeros(2)
    time.sleep(600)

def grow(path):
    yield np.zeros(2)
    yield np.ones(2**40)

def number(path):
    while True:
        yield np.array([os.getpid()])
"""
MAX_BYTES = 2**32


def test_limits_that_the_system_lacks_are_ignored(monkeypatch):
    resource = pytest.importorskip("resource")

    def reject(number, values):
        raise ValueError("current limit exceeds maximum limit")

    monkeypatch.setattr(resource, "setrlimit", reject)  # as macOS for memory
    _sandboxed.limit("RLIMIT_AS", 2**31)
    monkeypatch.delattr(resource, "RLIMIT_AS")
    _sandboxed.limit("RLIMIT_AS", 2**31)
    monkeypatch.setitem(sys.modules, "resource", None)
    _sandboxed.limit("RLIMIT_AS", 2**31)


@pytest.fixture
def iterate(tmp_path, monkeypatch):
    """Iterate over a reader of a module that only the test has."""
    source = tmp_path / "readers_of_test.py"
    source.write_text(READERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module(source.stem)
    path = tmp_path / "film"
    path.write_text("")

    def start(name, max_item_s=DEADLINE_S, **args):
        return iterate_in_sandbox(
            getattr(module, name), path, args, kind="a film", max_bytes=MAX_BYTES, max_item_s=max_item_s
        )

    yield start
    monkeypatch.delitem(sys.modules, source.stem)


def test_arrays_arrive_in_order(iterate):
    found = list(iterate("count", n=5))

    assert [array.dtype for array in found] == [np.uint8] * 5
    assert np.array_equal(found, np.repeat(np.arange(5), 6).reshape(5, 2, 3))
    assert list(iterate("count", n=0)) == []


def test_skipped_arrays_are_left_out(iterate):
    (last,) = iterate("count", n=4, is_skipped=True)

    assert (last == 3).all()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("crash", "reading it as a film crashed"),
        ("reject", "is corrupt or truncated .broken at byte 7"),
        ("grow", "more memory than a valid file"),
    ],
)
def test_problems_give_one_line(iterate, name, text):
    arrays = iterate(name)
    assert (next(arrays) == 0.0).all()
    with pytest.raises(FileError, match=text):
        next(arrays)


@pytest.mark.slow
def test_slow_array_is_an_error(iterate, monkeypatch):
    arrays = iterate("hang")
    next(arrays)
    # The first array may take any time, as the process must start.
    monkeypatch.setattr(sandbox.threading, "Timer", lambda _, *call: Timer(0.1, *call))
    with pytest.raises(FileError, match=f"more than {DEADLINE_S:g} s"):
        next(arrays)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_process_ends_with_iterator(iterate):
    arrays = iterate("number")
    (process,) = next(arrays)
    assert process != os.getpid()
    assert Path(f"/proc/{process}").exists()
    arrays.close()

    wait_until(lambda: not Path(f"/proc/{process}").exists())


def test_process_that_ends_early_is_reported(iterate, monkeypatch):
    monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", ""))

    with pytest.raises(FileError, match="reading it as a film crashed"):
        next(iterate("count", n="x" * 2**20))  # more than a pipe contains


def test_invalid_items_give_one_line(iterate, monkeypatch):
    for answer in (
        '{"shape": [2], "type": "O", "n_bytes": 16}',
        '{"shape": "a"}',
        "[1]",
        '{"n_bytes": "x"}',
        "[" * 10**5,
    ):
        program = f"print({answer!r}, flush=True); import sys; sys.stdout.write('x' * 99)"
        monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", program))
        with pytest.raises(FileError, match=r"reading it as a film (crashed|gave an invalid answer)") as caught:
            next(iterate("count", n=2))
        assert "\n" not in str(caught.value)


# -- results of a reader, and its limits ------------------------------------------------------------------------------

PROBES = """
import os, resource, signal, socket, subprocess, time
import numpy as np

def environment(path):
    return {"names": sorted(os.environ), "session": os.getsid(0), "group": os.getpgid(0)}, []

def denied(path):
    found = {}
    for name, call in (
        ("socket", lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM)),
        ("unix", lambda: socket.socket(socket.AF_UNIX)),
        ("fork", os.fork),
        ("program", lambda: subprocess.run(["/bin/true"])),
        ("exec", lambda: os.execv("/bin/true", ["true"])),
        ("kill", lambda: os.kill(os.getppid(), 0)),
        ("session", os.setsid),
        ("pidfd", lambda: signal.pidfd_send_signal(os.pidfd_open(os.getppid()), 0)),
        ("limit", lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CPU)),
    ):
        try:
            call()
            found[name] = "permitted"
        except OSError as error:
            found[name] = type(error).__name__
    return found, []

def threads(path):
    import threading
    found = []
    thread = threading.Thread(target=found.append, args=(1,))
    thread.start(); thread.join()
    a, b = socket.socketpair()
    return {"found": found}, [np.arange(3)]

def large(path):
    with open(os.path.join(os.environ["TMPDIR"], "large"), "wb") as file:
        file.seek(2**33); file.write(b"x")
    return {}, []

def lines(path):
    raise ValueError("one\\ntwo")
"""


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Run a reader of a module that only the test has."""
    source = tmp_path / "probes_of_test.py"
    source.write_text(PROBES)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module(source.stem)
    path = tmp_path / "data"
    path.write_text("")

    def start(name, max_cpu_s=10):
        reader = getattr(module, name)
        return run_in_sandbox(reader, path, {}, kind="data", max_cpu_s=max_cpu_s, max_bytes=MAX_BYTES)

    yield start
    monkeypatch.delitem(sys.modules, source.stem)


def test_environment_has_no_secrets(read, monkeypatch):
    monkeypatch.setenv("SECRET_OF_TEST", "1")

    about, _ = read("environment")

    assert "SECRET_OF_TEST" not in about["names"]
    assert {*about["names"]} <= {*sandbox.ENVIRONMENT, *sandbox.INHERITED, *sandbox.TEMPORARY, "LC_CTYPE"}
    if hasattr(os, "getsid"):
        assert about["session"] == about["group"] != os.getsid(0)


def can_filter():
    """Return whether the kernel permits filters of system calls, from a process that then installs one."""
    program = "import foveasim._io._sandboxed as s; print(s.deny_system_calls())"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    return found.stdout.strip() == "True"


@pytest.mark.skipif(sys.platform != "linux", reason="needs seccomp")
def test_network_and_processes_are_denied(read):
    if not can_filter():
        pytest.skip("the kernel does not permit filters of system calls")

    about, _ = read("denied")

    assert about == dict.fromkeys(
        ("socket", "unix", "fork", "program", "exec", "kill", "session", "pidfd", "limit"), "PermissionError"
    )


def test_threads_are_permitted(read):
    about, arrays = read("threads")

    assert about == {"found": [1]}
    assert [array.tolist() for array in arrays] == [[0, 1, 2]]


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of file size")
def test_large_file_of_reader_is_an_error(read):
    with pytest.raises(FileError, match=r"is corrupt or truncated .*[Ff]ile too large"):
        read("large")


def test_reason_of_rejection_is_one_line(read):
    with pytest.raises(FileError, match="one two") as caught:
        read("lines")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "answer",
    [
        "no JSON",
        "[" * 10**5,
        "[]",
        "7",
        "null",
        "{}",
        '{"metadata": {}}',
        '{"metadata": [], "n_arrays": 0}',
        '{"metadata": {}, "n_arrays": 1}',
        '{"metadata": {}, "n_arrays": -1}',
        '{"metadata": {}, "n_arrays": "1"}',
        '{"metadata": {}, "n_arrays": 1e9}',
    ],
)
def test_invalid_answers_give_one_line(read, monkeypatch, answer):
    monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", f"print({answer!r})"))

    with pytest.raises(FileError, match="reading it as data gave an invalid answer") as caught:
        read("environment")
    assert "\n" not in str(caught.value)


#: Array file that a process has replaced by a FIFO or a link, or that claims more than it contains.
REPLACED = {
    "FIFO": "os.mkfifo(arrays)",
    "link": "os.symlink('/dev/zero', arrays)",
    "size": "open(arrays, 'wb').write(b'\\x93NUMPY\\x01\\x00v\\x00' + b\"{'descr': '<f8', 'fortran_order': False, "
    "'shape': (10000000000000,), }\".ljust(117) + b'\\n')",
    "objects": "import numpy; numpy.save(arrays, numpy.array([{}], object), allow_pickle=True)",
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs")
@pytest.mark.parametrize("how", REPLACED)
def test_replaced_arrays_give_one_line(read, monkeypatch, how):
    program = (
        f"import os, sys, json; arrays = json.load(sys.stdin)['arrays']; {REPLACED[how]}\n"
        "print(json.dumps({'metadata': {}, 'n_arrays': 1}))"
    )
    monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", program))

    with pytest.raises(FileError, match="gave an invalid answer"):
        read("environment")


#: A process that starts another one, which inherits its output, and ends or waits.
PARENT = """
import json, os, sys, time
path = json.load(sys.stdin)["path"]
if os.fork() == 0:
    with open(path, "w") as file:
        file.write(str(os.getpid()))
    time.sleep(600)
while not os.path.getsize(path):
    time.sleep(0.01)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
@pytest.mark.parametrize("then", ["", "time.sleep(600)"])
def test_grandchild_ends_with_process(read, iterate, monkeypatch, tmp_path, then):
    monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", PARENT + then))
    monkeypatch.setattr(sandbox, "WALL_TIME_FACTOR", 1)
    start, path = sandbox._start, tmp_path / "data"

    def start_both(*arguments):
        """Start both processes, before limits of time begin to count."""
        process = start(*arguments)
        wait_until(lambda: path.stat().st_size)
        return process

    monkeypatch.setattr(sandbox, "_start", start_both)
    with pytest.raises(FileError, match=r"crashed|more than 1 s"):
        read("environment", max_cpu_s=1)
    wait_until(lambda: has_ended(int(path.read_text())))
    path = tmp_path / "film"
    with pytest.raises(FileError, match=r"crashed|more than 1 s"):
        next(iterate("count", n=1, max_item_s=1.0))
    wait_until(lambda: has_ended(int(path.read_text())))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs")
@pytest.mark.parametrize("place", ["zarr.json", "values/zarr.json", "values/c/0"])
@pytest.mark.parametrize("kind", ["FIFO", "device", "link"])
def test_special_files_in_store_are_never_opened(tmp_path, monkeypatch, place, kind):
    monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", "raise SystemExit(1)"))  # no process reads the store
    store = tmp_path / "store.zarr"
    special = store / place
    special.parent.mkdir(parents=True)
    if kind == "FIFO":
        os.mkfifo(special)
    else:
        special.symlink_to("/dev/zero" if kind == "device" else tmp_path)

    def reader(path):
        raise AssertionError(path)

    with pytest.raises(FileError, match="which is neither a regular file nor a directory"):
        read_in_sandbox(reader, store, kind="zarr", max_decompressed_bytes=lambda n: n)
    with pytest.raises(FileError, match="which is neither a regular file nor a directory"):
        check_codecs(store, (), "foveasim capture")
    if place == "zarr.json":
        assert store_format(store) is None
