"""Errors: messages and pickling."""

from __future__ import annotations

import multiprocessing
import pickle
from pathlib import Path

import numpy as np
import pytest

from foveasim.errors import (
    ConfigError,
    FileError,
    GeometryError,
    ParameterError,
    SimulationError,
    format_value,
    printable,
)

ERRORS = [
    ParameterError("pitch_um", "must be > 0", -1.0, "µm", "use a larger one"),
    ParameterError("white", "must be something", None),
    ParameterError("layout", "must be a Layout", lambda: None),
    GeometryError("site 3 is not a valid photosite", (3,)),
    FileError("a/file.npz", "is corrupt"),
    ConfigError(Path("shot.yaml"), "optics: must be given"),
    SimulationError("parts are incompatible"),
]


def test_message_contains_rule_value_unit_hint():
    assert str(ERRORS[0]) == "'pitch_um' must be > 0, got -1.0 µm; use a larger one"
    assert str(ParameterError("height", ERRORS[0].detail)) == "'height' must be > 0, got -1.0 µm; use a larger one"
    assert str(ParameterError("white", "must be given")) == "'white' must be given"
    assert len(str(ParameterError("data", "must be short", np.zeros((500, 500))))) < 120

    assert str(ParameterError("n", "must be less", 10**5000)) == "'n' must be less, got an object of type int"


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_errors_survive_pickling(error):
    found = pickle.loads(pickle.dumps(error))

    assert type(found) is type(error)
    assert str(found) == str(error)
    assert {**vars(found), "value": 0} == {**vars(error), "value": 0}
    if not callable(vars(error).get("value")):
        assert vars(found) == vars(error)


def _raise_parameter_error(_: int) -> None:
    raise ParameterError("pitch_um", "must be > 0", -1.0, "µm")


def test_errors_reach_waiting_parent_process():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        result = pool.apply_async(_raise_parameter_error, (1,))
        with pytest.raises(ParameterError, match=r"'pitch_um' must be > 0, got -1\.0 µm"):
            result.get(timeout=120.0)


def deep_list():
    inner = []
    for _ in range(100_000):
        inner = [inner]
    return inner


#: Functions that return long values, which take a while.
LONG_VALUES = {
    "deep": deep_list,
    "list": lambda: [1.0] * 10**6,
    "string": lambda: "x y " * 10**6,
    "bytes": lambda: b"z" * 10**6,
    "array": lambda: np.zeros((500, 500)),
    "integer": lambda: 10**5000,
    "value": lambda: {"k": "v" * 10**6},
    "dict": lambda: {k: k for k in range(10**5)},
}


@pytest.mark.parametrize("kind", LONG_VALUES)
def test_long_values_are_shortened_in_messages(kind):
    value = LONG_VALUES[kind]()

    assert len(format_value(value)) <= 80
    assert len(str(ParameterError("name", "must be short", value))) < 120
    for error in (FileError, ConfigError):
        try:
            text = f"{value}"
        except (RecursionError, ValueError):
            continue
        assert len(str(error("a.yaml", f"is wrong, got {text}"))) <= 2010


def test_paths_are_complete_in_messages():
    path = "/".join(["a long directory"] * 20)

    assert str(FileError(path, "no such file")) == f"{path}: no such file"
    assert len(str(FileError("x" * 5000, "no such file"))) < 1020


def test_unprintable_characters_become_escapes():
    assert printable("plain µ × é") == "plain µ × é"
    assert printable("a\nb\x1b[31m\u202e\udce9") == r"a\nb\x1b[31m\u202e\udce9"
    assert printable("a\nb\x1b", keep="\n") == "a\nb" + r"\x1b"
    assert str(FileError("a\nb", "is wrong")) == r"a\nb: is wrong"
    assert FileError("a\nb", "is wrong").path == Path("a\nb")
