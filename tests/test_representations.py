"""Representations of all public classes: one short line without arrays."""

from __future__ import annotations

import inspect
import runpy
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import shapely
from reference.public_objects import OPTICS, REPORT, public_objects

import foveasim as fs
from foveasim import video
from foveasim._core.short_repr import format_field, short_repr

MODULES = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "generated_pages.py"))["MODULES"]
MAX_CHARACTERS = 260


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    return public_objects(tmp_path_factory.mktemp("examples"))


def public_classes():
    """Yield the public classes that users construct or receive: not exceptions, protocols and abstract classes."""
    for name in MODULES:
        module = import_module(name)
        for item in (getattr(module, public) for public in module.__all__ if public != "learn"):  # needs PyTorch
            is_class = isinstance(item, type) and not issubclass(item, BaseException)
            if is_class and not inspect.isabstract(item) and not getattr(item, "_is_protocol", False):
                yield item


def test_all_public_classes_have_examples(examples):
    missing = {kind.__name__ for kind in public_classes()} - {type(example).__name__ for example in examples}

    assert missing == set()
    assert len(examples) > 100


def test_representations_are_short_lines(examples):
    shown = [repr(example) for example in examples]

    assert [text for text in shown if len(text) > MAX_CHARACTERS or "\n" in text] == []
    assert [text for text in shown if "array(" in text or " object at 0x" in text] == []
    for text, example in zip(shown, examples, strict=True):
        assert text.startswith(type(example).__name__)


def test_short_representation_omits_defaults_and_arrays():
    assert repr(fs.DesignRules(min_width_um=0.5)) == "DesignRules(min_width_um=0.5)"
    assert repr(OPTICS) == "Optics(focal_length_mm=8.0, f_number=2.8)"
    assert (
        short_repr(video.GazePath(np.arange(9.0), np.zeros((9, 2))))
        == "GazePath(t_s=float64 (9,), xy_um=float64 (9, 2))"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.zeros(3), "[0, 0, 0]"),
        (np.zeros((2, 2), np.uint8), "uint8 (2, 2)"),
        (np.float64(0.5), "0.5"),
        (list(range(9)), "list of 9"),
        (("a", np.zeros(9)), "('a', float64 (9,))"),
        ({"a": 1}, "{'a': 1}"),
        (np.hypot, "hypot"),
    ],
)
def test_fields_are_written_in_few_characters(value, text):
    assert format_field(value) == text


def test_picture_representation_ignores_missing_data():
    data = np.array([[[np.nan, 2.0], [1.0, 4.0]]], np.float32)
    picture = fs.Picture(data, np.ones((2, 2), np.float32), fs.Grid((2, 2), 0.5))

    assert repr(picture) == "Picture(2 x 2 pixels of 0.5 x 0.5 µm, 1 channel, values from 1 to 4)"
    assert repr(fs.Picture(data * np.nan, picture.coverage, picture.grid)).endswith("1 channel, no values)")


def test_report_representation_counts_rules():
    assert repr(REPORT) == "Report(0 of 2 rules satisfied, 1 waived, 1,201 violations, 1,200 photosites)"
    assert shapely.area(REPORT.violations[0].marker) == pytest.approx(4.0)
