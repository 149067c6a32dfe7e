"""Iteration over arrays in the sandbox process: order, limits, crashes, and the end of the process."""

from __future__ import annotations

import importlib
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from foveasim._io import sandbox
from foveasim._io.sandbox import iterate_in_sandbox
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
    time.sleep(60)

def grow(path):
    yield np.zeros(2)
    yield np.ones(2**40)

def number(path):
    while True:
        yield np.array([os.getpid()])
"""
MAX_BYTES = 2**32


@pytest.fixture
def iterate(tmp_path, monkeypatch):
    """Iterate over a reader of a module that only the test has."""
    source = tmp_path / "readers_of_test.py"
    source.write_text(READERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module(source.stem)
    path = tmp_path / "film"
    path.write_text("")

    def start(name, max_item_s=30.0, **args):
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


def test_slow_array_is_an_error(iterate):
    arrays = iterate("hang", max_item_s=3.0)
    next(arrays)
    with pytest.raises(FileError, match="more than 3 s"):
        next(arrays)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_process_ends_with_iterator(iterate):
    arrays = iterate("number")
    (process,) = next(arrays)
    assert process != os.getpid()
    assert Path(f"/proc/{process}").exists()
    arrays.close()

    for _ in range(100):
        if not Path(f"/proc/{process}").exists():
            return
        time.sleep(0.05)
    pytest.fail("the process continues")


def test_process_that_ends_early_is_reported(iterate, monkeypatch):
    monkeypatch.setattr(sandbox, "COMMAND", (sys.executable, "-c", ""))

    with pytest.raises(FileError, match="reading it as a film crashed"):
        next(iterate("count", n="x" * 2**20))  # more than a pipe contains
