"""Atomic writes of directories."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import pytest

from foveasim._io.atomic import atomic_directory, remove_directory
from foveasim.errors import FileError


def test_removal_waits_for_late_writers(tmp_path):
    directory = tmp_path / "store.zarr"
    has_started = threading.Event()

    def write_chunks():
        for k in range(10):
            with suppress(OSError):  # the directory has just been removed
                (directory / "c").mkdir(parents=True, exist_ok=True)
                (directory / "c" / str(k)).write_bytes(b"chunk")
            has_started.set()
            time.sleep(0.002)

    late_writer = threading.Thread(target=write_chunks)
    late_writer.start()
    has_started.wait()
    remove_directory(directory)
    late_writer.join()

    assert list(tmp_path.iterdir()) == []


def test_removing_missing_directory_does_nothing(tmp_path):
    remove_directory(tmp_path / "absent")

    assert list(tmp_path.iterdir()) == []


def test_failed_directory_write_leaves_nothing(tmp_path):
    def write():
        with atomic_directory(tmp_path / "a", is_ours=bool) as new:
            (new / "b").write_bytes(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(FileError, match="cannot be written: "):
        write()

    assert list(tmp_path.iterdir()) == []
