"""Files and folders written whole or not at all."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import pytest

from foveasim.errors import FileError
from foveasim.files import folder_written_whole, remove_folder


def test_removal_waits_for_stragglers(tmp_path):
    folder = tmp_path / "store.zarr"
    has_begun = threading.Event()

    def write_on():
        for k in range(10):
            with suppress(OSError):  # the folder has just been removed
                (folder / "c").mkdir(parents=True, exist_ok=True)
                (folder / "c" / str(k)).write_bytes(b"chunk")
            has_begun.set()
            time.sleep(0.002)

    straggler = threading.Thread(target=write_on)
    straggler.start()
    has_begun.wait()
    remove_folder(folder)
    straggler.join()

    assert list(tmp_path.iterdir()) == []


def test_removing_nothing_is_no_error(tmp_path):
    remove_folder(tmp_path / "absent")

    assert list(tmp_path.iterdir()) == []


def test_failed_folders_leave_nothing_behind(tmp_path):
    def write():
        with folder_written_whole(tmp_path / "a", is_ours=bool) as new:
            (new / "b").write_bytes(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(FileError, match="cannot be written: "):
        write()

    assert list(tmp_path.iterdir()) == []
