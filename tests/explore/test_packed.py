"""Packed sequences, with lists as the reference."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foveasim.explore.datasets import packed
from foveasim.explore.datasets.packed import PackedBoxes, PackedFiles, PackedStrings


@given(st.lists(st.text(max_size=9), max_size=9))
def test_packed_strings_equal_a_list(strings):
    found = pickle.loads(pickle.dumps(PackedStrings(strings)))

    assert list(found) == strings
    assert found[1:3] == strings[1:3]
    assert found[::-1] == strings[::-1]
    assert found.digest() == hashlib.sha256("\n".join(strings).encode()).hexdigest()
    if strings:
        assert found[-1] == strings[-1]
    with pytest.raises(IndexError):
        found[len(strings)]


def test_digest_of_strings_is_computed_in_blocks(monkeypatch):
    monkeypatch.setattr(packed, "BLOCK", 3)
    strings = [str(k) for k in range(10)]

    assert PackedStrings(strings).digest() == hashlib.sha256("\n".join(strings).encode()).hexdigest()


def test_packed_strings_keep_undecodable_names():
    assert list(PackedStrings(["a\udcff.png"])) == ["a\udcff.png"]
    assert len(PackedStrings(["a\udcff.png"]).digest()) == 64


def test_packed_names_are_small():
    """Few bytes per string besides its characters, also when they are sent to processes."""
    strings = [f"class/{k:09d}.png" for k in range(10_000)]

    assert len(pickle.dumps(PackedStrings(strings))) < sum(map(len, strings)) + 10 * len(strings)


def test_packed_files_equal_a_list():
    found = PackedFiles(Path("masks"), ["a/1.png", "a/2.png"])

    assert list(found) == [Path("masks/a/1.png"), Path("masks/a/2.png")]
    assert found[:1] == [Path("masks/a/1.png")]


def test_packed_boxes_equal_a_list():
    rng = np.random.default_rng(0)
    each = [(rng.normal(size=(n, 4)), rng.integers(0, 9, n)) for n in (2, 0, 3, 0)]
    boxes = PackedBoxes(each)

    assert boxes.most == 3
    for k, (boxes_px, classes) in enumerate(each):
        np.testing.assert_array_equal(boxes[k][0], boxes_px)
        np.testing.assert_array_equal(boxes[k][1], classes)
    assert PackedBoxes([]).most == 0
