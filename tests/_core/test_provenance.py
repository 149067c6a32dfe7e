"""Identities of functions: equal in all processes, and different after any change of behaviour."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from foveasim._core.provenance import identify
from foveasim.metrics import METRICS

OWN = """
import functools
import threading
import numpy as np
from scipy.interpolate import PchipInterpolator

LEVEL = 10
TABLE = np.arange(5.0)


def helper(code):
    return {"a", "b", "c"} & {"b"} and code > LEVEL


def ping(n):
    return pong(n)


def pong(n):
    return ping(n) + 2


class Counter:
    scale = 2

    def __init__(self, level):
        self.level = level

    def __call__(self, shot, camera, capture):
        return self.scale * self.level * len(capture.code)


def make(level):
    def fraction(shot, camera, capture):
        return float((capture.code > level).mean()) if camera.name in {"one", "two", "three"} else TABLE[0]

    return fraction


def plain(shot, camera, capture, *, of=3):
    return max(helper(code) for code in capture.code)


METRICS = {
    "closure": make(10),
    "partial": functools.partial(plain, of=4),
    "object": Counter(3),
    "plain": plain,
    "lambda": lambda *_: [x + LEVEL for x in range(3)],
    "both": lambda *_: [ping(1), pong(1), *[name for name in ("a", "b")]],
    "interpolation": functools.partial(plain, of=PchipInterpolator([0.0, 1.0, 3.0], [0.0, 2.0, 3.0])),
    "lock": functools.partial(plain, of=threading.Lock()),
    "recursive": (lambda: (g := lambda n: g(n - 1)))(),
}
"""
COMMAND = """
import importlib, json, sys
from foveasim._core.provenance import identify
found = []
for directory in sys.argv[1:]:
    sys.path.insert(0, directory)
    sys.modules.pop("own", None)
    own = importlib.import_module("own")
    found.append({name: identify(metric) for name, metric in own.METRICS.items()})
print(json.dumps(found))
"""


def identities(directory, sources, hash_seed):
    """Return the identities in each version of a module, from a process of its own."""
    directories = [directory / f"{hash_seed}_{k}" for k in range(len(sources))]
    for one, source in zip(directories, sources, strict=True):
        one.mkdir()
        (one / "own.py").write_text(source)
    environment = os.environ | {"PYTHONHASHSEED": str(hash_seed), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", COMMAND, *map(str, directories)]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


#: Changes of the module, and the metrics whose behaviour they change.
CHANGES = (
    ("make(10)", "make(60)", {"closure"}),
    ("of=4", "of=5", {"partial"}),
    ("Counter(3)", "Counter(4)", {"object"}),
    ("scale = 2", "scale = 3", {"object"}),
    ("self.scale * self.level", "self.scale + self.level", {"object"}),
    ("LEVEL = 10", "LEVEL = 11", {"plain", "partial", "interpolation", "lock", "lambda"}),
    ("code > LEVEL", "code >= LEVEL", {"plain", "partial", "interpolation", "lock"}),
    ("np.arange(5.0)", "np.arange(6.0)", {"closure"}),
    ('"two", "three"}', '"two", "four"}', {"closure"}),
    ("ping(n) + 2", "ping(n) + 3", {"both"}),
    ("n - 1", "n - 2", {"recursive"}),
    ("[0.0, 2.0, 3.0]", "[0.0, 2.0, 4.0]", {"interpolation"}),
)


@pytest.mark.slow
def test_identity_depends_on_behaviour_only(tmp_path):
    (before,) = identities(tmp_path, [OWN], 1)
    unchanged, *changed = identities(
        tmp_path, ["# a comment\n\n" + OWN, *(OWN.replace(old, new) for old, new, _ in CHANGES)], 2
    )

    assert len(set(before.values())) == len(before)
    assert unchanged == before
    for (old, _, expected), after in zip(CHANGES, changed, strict=True):
        assert {name for name in before if before[name] != after[name]} == expected, old


def fraction_above(level, unit=1.0):
    return lambda _, __, capture: unit * float((capture.code > level).mean())


def test_identity_is_constant_during_use():
    table = np.arange(3)

    def often(n):
        return sum(n + k for k in range(10)) + table[0]

    before = identify(often)
    for k in range(200):
        often(k)
    assert identify(often) == before


def test_package_metrics_are_identified_by_name():
    assert identify(METRICS["snr"]) == "foveasim.metrics.shots.snr:snr"


@pytest.mark.parametrize(
    "pair",
    [
        (fraction_above(10), fraction_above(60)),
        (fraction_above(10), fraction_above(10, unit=2.0)),
        (functools.partial(METRICS["snr"], level=1), functools.partial(METRICS["snr"], level=2)),
        ("abc".count, "abd".count),
    ],
)
def test_identity_depends_on_captured_values(pair):
    assert identify(pair[0]) == identify(pair[0])
    assert identify(pair[0]) != identify(pair[1])
