"""Environments with the core of the package and one extra, made of links to the installed distributions."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from importlib.metadata import distribution
from pathlib import Path

from matplotlib import get_configdir
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CALLS = Path(__file__).with_name("calls.py")
#: Time limit of the calls in one environment on a busy machine, seconds.
LIMIT_S = 600


def required_distributions(extra=None):
    """Return the names of all distributions that pip installs for the core, or for the core and an extra."""
    requirements = [*PROJECT["dependencies"], *(PROJECT["optional-dependencies"][extra] if extra else ())]
    pending = [Requirement(text) for text in requirements]
    visited, found = set(), set()
    while pending:
        requirement = pending.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        extras = frozenset(requirement.extras)
        if (name, extras) in visited:
            continue
        visited.add((name, extras))
        found.add(name)
        for text in distribution(name).requires or []:
            inner = Requirement(text)
            if inner.marker is None or any(inner.marker.evaluate({"extra": e}) for e in (extras or {""})):
                pending.append(inner)
    return found


def make_empty(directory):
    """Create a virtual environment, and return its interpreter and its directory of packages."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(directory)], check=True)
    site = sysconfig.get_path("purelib", "venv", {"base": str(directory), "platbase": str(directory)})
    return directory / "bin" / "python", Path(site)


def make_imitation(directory, module):
    """Create an environment with all installed distributions, whose processes first import a module of this directory."""
    python, site = make_empty(directory)
    shutil.copy(Path(__file__).with_name(f"{module}.py"), site)
    (site / "foveasim.pth").write_text(f"import {module}\n{sysconfig.get_path('purelib')}\n{ROOT}\n")
    return python


def make_environment(directory, extra=None):
    """Create a virtual environment of links, and return its interpreter."""
    python, site = make_empty(directory)
    for name in required_distributions(extra):
        files = distribution(name).files or []
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            target = Path(str(distribution(name).locate_file(top)))
            if target.exists() and not (site / top).exists():
                (site / top).symlink_to(target)
    (site / "foveasim.pth").write_text(f"{ROOT}\n")
    return python


def run_calls(python, directory, names=(), **variables):
    """Make calls in an environment, with environment variables, and return their outcomes."""
    report = directory / "report.json"
    env = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(directory),
        "MPLBACKEND": "agg",
        "MPLCONFIGDIR": get_configdir(),
        **variables,
    }
    ran = subprocess.run(
        [str(python), "-P", str(CALLS), "--report", str(report), *names],
        env=env, cwd=directory, capture_output=True, text=True, timeout=LIMIT_S, check=False,
    )  # fmt: skip
    assert report.is_file(), ran.stderr[-2000:]
    return json.loads(report.read_text())
