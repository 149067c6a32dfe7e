"""Archives of arrays, also with the stray member of old numpy versions."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from foveasim._io.npz import read_archive, write_archive
from foveasim.errors import FileError
from foveasim.layout import hexagonal, read_layout, write_layout


def add_stray_member(path):
    """Store ``allow_pickle`` as an array, as numpy before 2.2 does."""
    with zipfile.ZipFile(path, "a") as archive, archive.open("allow_pickle.npy", "w") as file:
        np.lib.format.write_array(file, np.array(False))


@pytest.mark.parametrize("is_compressed", [False, True])
def test_archive_contains_only_given_arrays(tmp_path, is_compressed):
    write_archive(tmp_path / "a.npz", {"format": "x"}, {"n": np.arange(3)}, is_compressed=is_compressed)

    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert sorted(arrays) == ["about", "n"]


def test_layout_with_stray_member_is_read(tmp_path):
    layout = hexagonal(pitch_um=3.3, n_columns=2, n_rows=2)
    write_layout(layout, tmp_path / "a.npz")
    add_stray_member(tmp_path / "a.npz")

    np.testing.assert_array_equal(read_layout(tmp_path / "a.npz").xy_um, layout.xy_um)


def test_stray_member_is_ignored(tmp_path):
    write_archive(tmp_path / "a.npz", {}, {"n": np.arange(3)})
    add_stray_member(tmp_path / "a.npz")

    assert list(read_archive(tmp_path / "a.npz")[1]) == ["n"]


def test_objects_are_never_pickled(tmp_path):
    with pytest.raises(FileError, match=r"'n' must contain numbers or strings, got Python objects"):
        write_archive(tmp_path / "a.npz", {}, {"n": np.array([{}])})

    assert not list(tmp_path.iterdir())
