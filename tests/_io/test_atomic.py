"""Atomic writes of directories."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from foveasim._io import atomic
from foveasim._io.atomic import atomic_directory, remove_directory
from foveasim.errors import FileError


def test_removal_includes_late_writes(tmp_path, monkeypatch):
    directory, n_written = tmp_path / "store.zarr", []

    def write_meanwhile(_time_s):
        (directory / "c").mkdir(parents=True, exist_ok=True)
        (directory / "c" / "0").write_bytes(b"chunk")
        n_written.append(1)

    directory.mkdir()
    monkeypatch.setattr(atomic, "time", SimpleNamespace(sleep=write_meanwhile))
    remove_directory(directory)

    assert len(n_written) == len(atomic.RETRY_S) > 1
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
