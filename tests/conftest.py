"""What some tests need of the machine: ``@pytest.mark.needs("renderer")``, ``"chromium"``, ``"torch"``; and kernels for all processes."""

from __future__ import annotations

import os
import re
import shutil
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest


def renderer_is_missing():
    from foveasim.view import find_renderer

    return None if find_renderer() else "no OpenGL renderer: install libegl1 and libgl1"


def chromium_is_missing():
    return None if shutil.which("chromium") else "no chromium on the path"


def torch_is_missing():
    return None if find_spec("torch") else "no torch: make test-torch runs this test"


MISSING = {"renderer": renderer_is_missing, "chromium": chromium_is_missing, "torch": torch_is_missing}
PACKAGE = Path(__file__).parents[1] / "foveasim"
KERNELS = re.compile(r"^from foveasim\._core\.jit import njit$", re.MULTILINE)


def kernel_modules():
    """Name of each module whose import compiles kernels."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if KERNELS.search(path.read_text()):
            yield ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)


def pytest_configure(config):
    """Compile all kernels once, before there are several processes that would each compile them."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        for name in kernel_modules():
            import_module(name)


def pytest_runtest_setup(item):
    """Skip what this machine cannot run; fail where FOVEASIM_TESTS_NEED names it, so that nobody skips it unawares."""
    for marker in item.iter_markers("needs"):
        for what in marker.args:
            missing = MISSING[what]()
            if missing and what in os.environ.get("FOVEASIM_TESTS_NEED", "").split(","):
                pytest.fail(missing)
            elif missing:
                pytest.skip(missing)
