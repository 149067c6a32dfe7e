"""Atomic writes of folders."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import pytest

from foveasim._io.atomic import atomic_directory, remove_folder
from foveasim.errors import FileError


def test_removal_outlasts_late_writers(tmp_path):
    folder = tmp_path / "store.zarr"
    has_begun = threading.Event()

    def write_on():
        for k in range(10):
            with suppress(OSError):  # the folder has just been removed
                (folder / "c").mkdir(parents=True, exist_ok=True)
                (folder / "c" / str(k)).write_bytes(b"chunk")
            has_begun.set()
            time.sleep(0.002)

    late_writer = threading.Thread(target=write_on)
    late_writer.start()
    has_begun.wait()
    remove_folder(folder)
    late_writer.join()

    assert list(tmp_path.iterdir()) == []


def test_removing_absent_folder_does_nothing(tmp_path):
    remove_folder(tmp_path / "absent")

    assert list(tmp_path.iterdir()) == []


def test_failed_folder_write_leaves_nothing(tmp_path):
    def write():
        with atomic_directory(tmp_path / "a", is_ours=bool) as new:
            (new / "b").write_bytes(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(FileError, match="cannot be written: "):
        write()

    assert list(tmp_path.iterdir()) == []
