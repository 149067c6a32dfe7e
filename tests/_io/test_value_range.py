"""Ranges of the values of images: known for constant copies of files, and never of other values."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from foveasim._core.validation import freeze
from foveasim._io import mapped_files
from foveasim._io.mapped_files import map_file, range_and_values, remember_range, value_range

IMAGES = np.random.default_rng(0).normal(size=(3, 700, 500)).astype(np.float32)


@pytest.fixture
def mapped(tmp_path):
    IMAGES.tofile(tmp_path / "images.raw")
    return map_file(tmp_path / "images.raw", IMAGES.dtype, IMAGES.shape, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "view",
    [
        np.s_[:],
        np.s_[:, ::-1],
        np.s_[1:, 100:200, 7:300],
        np.s_[:, ::-1, ::-1],
        np.s_[:1, :, :0:-3],
    ],
)
def test_copies_have_range_and_values(mapped, view):
    limits, copy = range_and_values(mapped[view])

    assert np.array_equal(copy, IMAGES[view])
    assert limits == value_range(copy) == value_range(IMAGES[view]) == (IMAGES[view].min(), IMAGES[view].max())


def test_nan_is_reported(tmp_path):
    images = IMAGES.copy()
    images[1, 3, 4] = np.nan
    images.tofile(tmp_path / "images.raw")

    limits, _ = range_and_values(map_file(tmp_path / "images.raw", images.dtype, images.shape, 0))
    assert np.isnan(limits).all()
    assert np.isnan(value_range(images)).all()


def test_range_follows_changes_and_parts():
    images = IMAGES.copy()
    for value in (10.0, 20.0):
        images[0, 0, 0] = value
        assert value_range(images)[1] == value
        assert value_range(images[::-1])[1] == value
    for value in (30.0, np.nan):  # also those of an array that was read-only in between
        images.flags.writeable = False
        value_range(images)
        images.flags.writeable = True
        images[0, 0, 0] = value
        images.flags.writeable = False
        np.testing.assert_equal(value_range(images)[1], value)
    assert value_range(images[1:])[1] == IMAGES[1:].max()


def test_known_range_is_that_of_complete_views():
    images = freeze(IMAGES.copy())
    remember_range(images, (-100.0, 100.0))  # not computed again

    for view in (images, images[:, ::-1], images[:, ::-1, ::-1], images.transpose(0, 2, 1)):
        assert value_range(view) == (-100.0, 100.0)
    for view in (images[1:], np.broadcast_to(images[:, :, :1], images.shape)):
        assert value_range(view) == (view.min(), view.max())


def test_ranges_are_forgotten_with_their_arrays():
    gc.collect()
    before = set(mapped_files._ranges)
    images = freeze(IMAGES.copy())
    remember_range(images, (0.0, 1.0))
    assert set(mapped_files._ranges) - before == {id(images)}

    del images
    assert set(mapped_files._ranges) <= before
