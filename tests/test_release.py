"""The stored public interface, which a release compares with the present one."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

RELEASE = Path(__file__).parents[1] / "release"


@pytest.fixture(scope="module")
def api():
    return runpy.run_path(str(RELEASE / "api.py"))


@pytest.mark.slow
def test_public_interface_is_the_stored_one(api):
    stored = (RELEASE / "api.txt").read_text("utf-8").splitlines()

    assert api["changes"](stored, api["interface"]()) == []  # else: python release/api.py --update, and CHANGELOG.md


def test_changed_parameters_are_reported(api):
    def before(light, *, seed):
        """Take two parameters."""

    def after(light, *, seed=0):
        """Take a default, too."""

    stored, found = (list(api["lines_of"]("module.call", call)) for call in (before, after))

    assert api["changes"](stored, found) == ["-module.call(light, *, seed)", "+module.call(light, *, seed=0)"]


def test_members_of_classes_are_listed(api):
    class Sample:
        def __init__(self, a, b=2):
            self._a = a, b

        @property
        def size(self):
            """One."""
            return 1

        @classmethod
        def read(cls, path):
            """Read one."""

        def _hidden(self):
            """Not listed."""

    Sample.__module__ = "foveasim.sample"

    assert list(api["lines_of"]("Sample", Sample)) == [
        "class Sample()", "Sample(a, b=2)", "Sample.read(cls, path)", "Sample.size",
    ]  # fmt: skip
