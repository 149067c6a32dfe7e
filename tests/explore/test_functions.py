"""Identities of functions: equal in all processes, and different after any change of behaviour."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from foveasim import explore
from foveasim.explore._functions import identify_function

OWN = """
import functools
import numpy as np

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
    "recursive": (lambda: (g := lambda n: g(n - 1)))(),
}
"""
COMMAND = """
import json, own
from foveasim.explore._functions import identify_function
print(json.dumps({name: identify_function(metric) for name, metric in own.METRICS.items()}))
"""


def identities(directory, source, hash_seed):
    (directory / "own.py").write_text(source)
    environment = os.environ | {"PYTHONHASHSEED": str(hash_seed), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", COMMAND]
    found = subprocess.run(command, cwd=directory, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


def test_identity_depends_on_behaviour_only(tmp_path):
    before = identities(tmp_path, OWN, 1)

    assert len(set(before.values())) == len(before)
    assert identities(tmp_path, "# a comment\n\n" + OWN, 2) == before
    for old, new, changed in (
        ("make(10)", "make(60)", {"closure"}),
        ("of=4", "of=5", {"partial"}),
        ("Counter(3)", "Counter(4)", {"object"}),
        ("scale = 2", "scale = 3", {"object"}),
        ("self.scale * self.level", "self.scale + self.level", {"object"}),
        ("LEVEL = 10", "LEVEL = 11", {"plain", "partial", "lambda"}),
        ("code > LEVEL", "code >= LEVEL", {"plain", "partial"}),
        ("np.arange(5.0)", "np.arange(6.0)", {"closure"}),
        ('"two", "three"}', '"two", "four"}', {"closure"}),
        ("ping(n) + 2", "ping(n) + 3", {"both"}),
        ("n - 1", "n - 2", {"recursive"}),
    ):
        after = identities(tmp_path, OWN.replace(old, new), 3)
        assert {name for name in before if before[name] != after[name]} == changed, old


def fraction_above(level, unit=1.0):
    return lambda _, __, capture: unit * float((capture.code > level).mean())


def test_identity_is_constant_during_use():
    table = np.arange(3)

    def often(n):
        return sum(n + k for k in range(10)) + table[0]

    before = identify_function(often)
    for k in range(200):
        often(k)
    assert identify_function(often) == before


def test_package_metrics_are_identified_by_name():
    assert identify_function(explore.METRICS["snr"]) == "foveasim.explore._metrics:snr"


@pytest.mark.parametrize(
    "pair",
    [
        (fraction_above(10), fraction_above(60)),
        (fraction_above(10), fraction_above(10, unit=2.0)),
        (functools.partial(explore.METRICS["snr"], level=1), functools.partial(explore.METRICS["snr"], level=2)),
        ("abc".count, "abd".count),
    ],
)
def test_identity_depends_on_captured_values(pair):
    assert identify_function(pair[0]) == identify_function(pair[0])
    assert identify_function(pair[0]) != identify_function(pair[1])
