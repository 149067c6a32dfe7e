"""What some tests need of the machine: ``@pytest.mark.needs("renderer")``, ``"chromium"``; and kernels for all processes."""

from __future__ import annotations

import importlib
import os
import shutil
from pathlib import Path

import pytest


def renderer_is_missing():
    from foveasim.view import find_renderer

    return None if find_renderer() else "no OpenGL renderer: install libegl1 and libgl1"


def chromium_is_missing():
    return None if shutil.which("chromium") else "no chromium on the path"


MISSING = {"renderer": renderer_is_missing, "chromium": chromium_is_missing}


def pytest_configure(config):
    """Compile all kernels once, before there are several processes that would each compile them."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        root = Path(__file__).parents[1]
        for path in (root / "foveasim").rglob("_kernels.py"):
            importlib.import_module(".".join(path.relative_to(root).with_suffix("").parts))


def pytest_runtest_setup(item):
    """Skip what this machine cannot run; fail where FOVEASIM_TESTS_NEED names it, so that nobody skips it unawares."""
    for marker in item.iter_markers("needs"):
        for what in marker.args:
            missing = MISSING[what]()
            if missing and what in os.environ.get("FOVEASIM_TESTS_NEED", "").split(","):
                pytest.fail(missing)
            elif missing:
                pytest.skip(missing)
