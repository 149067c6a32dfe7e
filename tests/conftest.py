"""
Selection of tests, their requirements, kernels, and distribution to processes.

The default run leaves out tests marked ``slow`` and tests in a browser, except for those that ``slow(keep=...)`` selects: a
number of parameter sets of each function, spread evenly, or parts of their names; its random tests have a third of the
examples. Of the slow tests marked ``nightly``, the complete run contains a third, selected by the commit. Runs of named files
and directories contain all tests, as do those with FOVEASIM_TESTS=nightly. ``needs("renderer")``,
``"chromium"``, ``"torch"`` and other modules mark requirements.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections import defaultdict
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path

import hypothesis
import pytest
from browsers import CHROMIUM, open_chromium
from effort import commit, effort, examples, is_in_part

# Bytecode is stored next to the sources, as is the machine code of kernels, even where the environment disables it: the tests start
# hundreds of processes, and each would compile the package.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# At least as many processes as cores run tests: threads of the linear algebra would only wait for each other, at full load.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Background jobs of shells ignore SIGINT, and so would the programs that the tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@cache
def renderer_is_missing():
    from foveasim.view import find_renderer

    return None if find_renderer() else "no OpenGL renderer: install libegl1 and libgl1"


def chromium_is_missing():
    return None if CHROMIUM else "no chromium on the path"


def is_missing(module):
    """Return why the tests of a module of the environment of PyTorch cannot run, or None."""
    return None if find_spec(module) else f"no {module}: make test-torch runs this test"


MISSING = {
    "renderer": renderer_is_missing,
    "chromium": chromium_is_missing,
    **{module: partial(is_missing, module) for module in ("deepinv", "torch", "torchvision")},
    "aedat": lambda: None if find_spec("aedat") else "no aedat",
}


collect_ignore_glob = [] if find_spec("torch") else ["learn/*"]

#: Files with slow tests that share no fixture: each of their tests may run in any process, after all other files, so that the
#: processes finish at about the same time.
INDEPENDENT = {
    "test_gallery.py",
    "test_docs.py",
    "test_cli_explore.py",
    "test_principal_point.py",
    "test_invariants.py",
    "test_stack_statistics.py",
}


def pytest_configure(config):
    """Select all tests of named files; compile all kernels once, before several processes would each compile them."""
    is_worker = hasattr(config, "workerinput")
    if not is_worker and config.args_source is config.ArgsSource.ARGS:
        os.environ.setdefault("FOVEASIM_TESTS", "all")
        os.environ["FOVEASIM_TESTS_NAMED"] = "1"
    # New examples in each run on a developer's machine, the same ones in continuous integration.
    hypothesis.settings.register_profile(
        "foveasim", deadline=None, max_examples=examples(100), derandomize="CI" in os.environ
    )
    hypothesis.settings.load_profile("foveasim")
    if not is_worker and getattr(config.option, "numprocesses", None):
        from foveasim import compile_kernels

        compile_kernels()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Collect without garbage collections: nothing of modules and tests is released."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Collect garbage once: pytest does so five times afterwards, among all modules and tests, and would find the same."""
    gc.collect()
    gc.freeze()


def needs(item):
    """Return the requirements of a test."""
    return [what for marker in item.iter_markers("needs") for what in marker.args]


def slow_marker(item):
    """Return the marker of a slow test, else None."""
    is_slow = item.get_closest_marker("pages") or item.get_closest_marker("nightly")
    return item.get_closest_marker("slow") or (pytest.mark.slow if is_slow else None)


@pytest.hookimpl(tryfirst=True)  # before the selection by markers of the command line
def pytest_collection_modifyitems(config, items):
    """Mark tests in a browser; leave out slow tests, except for those that their markers keep."""
    for item in items:
        if "chromium" in needs(item):
            item.add_marker("pages")
    if effort() == "nightly" or (effort() == "all" and "FOVEASIM_TESTS_NAMED" in os.environ):
        return
    of_function = defaultdict(list)
    for item in items:
        if slow_marker(item):
            of_function[item.parent, item.originalname].append(item)
    dropped = set()
    for k, sets in enumerate(of_function.values()):
        keep, n = slow_marker(sets[0]).kwargs.get("keep", 0), len(sets)
        if isinstance(keep, int):  # other sets for the next function, so that all occur in a file
            kept = {sets[(k + j * n // keep) % n] for j in range(min(keep, n))}
        else:
            kept = {item for item in sets if any(part in item.name for part in keep)}
        dropped.update(set(sets) - kept)
    if effort() == "all":
        of_night = {item: item.get_closest_marker("nightly") for item in items if item in dropped}
        groups: dict[object, int] = {}
        number = {
            item: groups.setdefault(marker.kwargs.get("group", item), len(groups))
            for item, marker in of_night.items()
            if marker is not None
        }
        dropped = {item for item, k in number.items() if not is_in_part(k, commit())}
    config.hook.pytest_deselected(items=list(dropped))
    items[:] = [item for item in items if item not in dropped]


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
    for what in needs(item):
        missing = MISSING[what]()
        if missing and what in os.environ.get("FOVEASIM_TESTS_NEED", "").split(","):
            pytest.fail(missing)
        elif missing:
            pytest.skip(missing)


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = open_chromium(playwright.chromium)
        yield chromium
        chromium.close()
