"""Requirements of tests, ``@pytest.mark.needs("renderer")``, ``"chromium"``, ``"torch"``; kernels; distribution to processes."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from foveasim import compile_kernels

# Bytecode is stored next to the sources, as is the machine code of kernels, even where the environment disables it: the tests start
# hundreds of processes, and each would compile the package.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Background jobs of shells ignore SIGINT, and so would the programs that the tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def renderer_is_missing():
    from foveasim.view import find_renderer

    return None if find_renderer() else "no OpenGL renderer: install libegl1 and libgl1"


def chromium_is_missing():
    return None if shutil.which("chromium") else "no chromium on the path"


def torch_is_missing():
    return None if find_spec("torch") else "no torch: make test-torch runs this test"


MISSING = {"renderer": renderer_is_missing, "chromium": chromium_is_missing, "torch": torch_is_missing}


#: Files with slow tests that share no fixture: each of their tests may run in any process, after all other files, so that the
#: processes finish at about the same time.
INDEPENDENT = {
    "test_gallery.py",
    "test_docs.py",
    "test_cli_explore.py",
    "test_principal_point.py",
    "test_invariants.py",
}


def pytest_configure(config):
    """Compile all kernels once, before several processes would each compile them."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        compile_kernels()


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_make_scheduler(config, log):
    """Run the tests of a file in one process, except for those of ``INDEPENDENT``."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.partition("::")[0]
            return nodeid if Path(file).name in INDEPENDENT else file

    return ByFile(config, log)


def pytest_runtest_setup(item):
    """Skip tests that this machine cannot run, or fail when FOVEASIM_TESTS_NEED contains the requirement."""
    for marker in item.iter_markers("needs"):
        for what in marker.args:
            missing = MISSING[what]()
            if missing and what in os.environ.get("FOVEASIM_TESTS_NEED", "").split(","):
                pytest.fail(missing)
            elif missing:
                pytest.skip(missing)
