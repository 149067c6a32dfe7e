"""Digits of the gallery: files of MNIST, glyphs, positions in the pictures."""

from __future__ import annotations

import gzip
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

import foveasim
from foveasim.errors import FileError

SCRIPT = Path(foveasim.__file__).parents[1] / "gallery" / "27_fovea_emerges.py"


@pytest.fixture(scope="module")
def gallery():
    return runpy.run_path(str(SCRIPT))


def idx(values):
    """Return the contents of an IDX file of bytes."""
    return bytes((0, 0, 8, values.ndim)) + np.array(values.shape, ">u4").tobytes() + values.astype(np.uint8).tobytes()


def write_mnist(directory, n=20):
    bitmaps = np.random.default_rng(0).integers(0, 256, (n, 28, 28))
    labels = np.arange(n) % 10
    (directory / "train-images-idx3-ubyte").write_bytes(idx(bitmaps))
    (directory / "train-labels-idx1-ubyte.gz").write_bytes(gzip.compress(idx(labels)))
    return bitmaps, labels


def test_mnist_files_give_bitmaps_and_labels(gallery, tmp_path):
    bitmaps, labels = write_mnist(tmp_path)

    digits = gallery["Digits"].from_mnist(tmp_path, "train")

    np.testing.assert_array_equal((255.0 * digits.bitmaps.numpy()).round(), bitmaps)
    assert digits.labels.tolist() == labels.tolist()


INVALID = {
    "empty": lambda _: b"",
    "another type": lambda data: b"\x00\x00\x0d\x03" + data[4:],
    "no shape": lambda data: data[:9],
    "truncated": lambda data: data[:-1],
    "more bitmaps": lambda data: data[:7] + b"\x28" + data[8:],
    "another size": lambda _: idx(np.zeros((20, 27, 29))),
    "another number": lambda _: idx(np.zeros((3, 28, 28))),
}


@pytest.mark.parametrize("change", INVALID.values(), ids=INVALID)
def test_invalid_idx_files_are_reported(gallery, tmp_path, change):
    write_mnist(tmp_path)
    path = tmp_path / "train-images-idx3-ubyte"
    path.write_bytes(change(path.read_bytes()))

    with pytest.raises(FileError) as error:
        gallery["Digits"].from_mnist(tmp_path, "train")

    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "data",
    [b"", b"not compressed", gzip.compress(bytes(100))[:-9], gzip.compress(idx(np.arange(20)))],
    ids=["empty", "not compressed", "truncated", "too few"],  # compressed data contain the time
)
def test_invalid_labels_are_reported(gallery, tmp_path, data):
    write_mnist(tmp_path)
    (tmp_path / "train-labels-idx1-ubyte.gz").write_bytes(data)

    with pytest.raises(FileError, match="label"):
        gallery["Digits"].from_mnist(tmp_path, "train")


def test_missing_mnist_files_are_reported(gallery, tmp_path):
    with pytest.raises(FileError, match="train-images-idx3-ubyte"):
        gallery["Digits"].from_mnist(tmp_path, "train")


def test_glyphs_have_digit_height(gallery):
    digits = gallery["Digits"].from_fonts()
    n_rows = (digits.bitmaps.amax(dim=2) > 0.5).sum(dim=1)

    assert digits.labels.bincount().tolist() == [12] * 10
    assert bool(((n_rows >= 18) & (n_rows <= 22)).all())


def test_central_digits_are_near_axis(gallery):
    digit = torch.zeros(1, 22, 22)
    digit[0, 0, 0] = 1.0  # fragments are cut from the inner part
    digits = gallery["Digits"](digit, torch.zeros(1, dtype=torch.int64))

    pictures, _ = digits.pictures(2000, True, torch.Generator().manual_seed(0))

    # The upper left corner of the digit is 21 cells from the left and from the top, 64 - 1 - 21 from the bottom.
    _, row, column = torch.nonzero(pictures, as_tuple=True)
    assert len(row) == 2000
    assert abs(float(column.double().mean()) - 21.0) < 0.3
    assert abs(float(row.double().mean()) - 42.0) < 0.3
    assert abs(float(column.double().std()) - 3.0) < 0.3
