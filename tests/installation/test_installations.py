"""Installations without extras, and with each extra alone: every call works, or names the extra that it requires."""

from __future__ import annotations

from types import FunctionType

import pytest
from typer.main import get_command

import foveasim as fs
from foveasim._core.extras import EXTRA_OF
from foveasim.cli import app
from installation.calls import CALLS, COMMANDS, failures, required_extra
from installation.environments import make_environment, run_calls

# Without extras, the target test-core does the same.
pytestmark = pytest.mark.nightly(group="installations")

#: Extras with modules that the package imports.
EXTRAS = sorted(set(EXTRA_OF.values()))
#: Libraries of extras that the environment of the tests may lack.
BEYOND_DEV = {"adapters": ("deepinv", "torchvision"), "events": ("aedat",), "learn": ("torch",)}
MODULES = (
    "", "compare", "config", "distortion", "explore", "layout", "learn", "maps", "metrics", "modes", "optics", "reconstruct",
    "scene", "scene.charts", "sensor", "sensor.effects", "studio", "testing", "tiles", "units", "video", "view",
)  # fmt: skip


def required_extras(outcomes):
    """Return the extra that each call requires, empty for calls that work."""
    assert failures(outcomes) == {}
    return {name: required_extra(text) for name, text in outcomes.items()}


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    """Return the extras that calls require in an environment without extras."""
    directory = tmp_path_factory.mktemp("core")
    return required_extras(run_calls(make_environment(directory / "env"), directory))


def public_functions():
    """Yield the names of the public functions, as in the table of calls."""
    defined = set()
    for name in MODULES:
        module = fs
        for part in filter(None, name.split(".")):
            module = getattr(module, part)
        for public in module.__all__:
            item = None if name == "learn" else getattr(module, public)
            home = (getattr(item, "__module__", ""), public)  # of names in several modules
            if name == "learn" or (isinstance(item, FunctionType) and home not in defined):
                defined.add(home)
                yield f"{name}.{public}".removeprefix(".")


@pytest.mark.slow(keep=1)
def test_table_contains_every_function_and_command():
    commands = {name.split()[0] for name in COMMANDS}

    assert set(public_functions()) - set(CALLS) == set()
    assert set(get_command(app).commands) == commands


def test_core_installation_works_or_names_extra(core):
    required = {name: extra for name, extra in core.items() if extra}

    assert set(required.values()) == set(EXTRAS)
    assert len(required) < len(core) / 3


@pytest.mark.parametrize(
    "extra",
    [pytest.param(extra, marks=[pytest.mark.needs(what) for what in BEYOND_DEV.get(extra, ())]) for extra in EXTRAS],
)
def test_single_extra_suffices_for_its_calls(core, extra, tmp_path):
    names = [name for name, required in core.items() if required == extra]

    found = required_extras(run_calls(make_environment(tmp_path / "env", extra), tmp_path, names))

    assert found == dict.fromkeys(names, "")


def test_commands_work_without_docstrings_and_assertions(tmp_path):
    # Without docstrings, kernels have other bytecode, and would all be compiled again: those of these commands are interpreted.
    interpreted = [f"foveasim {name}" for name in ("run", "view", "video", "dataset")]
    compiled = [f"foveasim {name}" for name in ("schema", "new", "convert", "describe")]
    python = make_environment(tmp_path / "env")

    found = run_calls(python, tmp_path, interpreted, PYTHONOPTIMIZE="2", NUMBA_DISABLE_JIT="1")
    found |= run_calls(python, tmp_path, compiled, PYTHONOPTIMIZE="2")

    assert found == dict.fromkeys([*interpreted, *compiled], "ok")
