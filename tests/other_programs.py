"""Programs that write or read the files of tests/interop."""

from __future__ import annotations

import os

import pytest


def other_program(module):
    """Return a module of a program; without it the test is skipped, or fails where FOVEASIM_TESTS_NEED contains ``interop``."""
    if "interop" in os.environ.get("FOVEASIM_TESTS_NEED", "").split(","):
        return __import__(module, fromlist=["_"])
    return pytest.importorskip(module, reason=f"no {module}: make test-interop runs this test", exc_type=ImportError)
