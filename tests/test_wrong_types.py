"""Random calls of all public functions, constructors and methods with values of wrong types: errors of the package."""

from __future__ import annotations

import inspect
import itertools
import warnings
from pathlib import Path

import numpy as np
import pytest
from reference.public_calls import annotations_of, example, make_objects, public_calls

import foveasim as fs
from foveasim.errors import FoveasimError, ParameterError

N_CALLS = 1550
MAX_RAW_FRACTION = 0.01
TOO_LONG = "must have names of at most 255 bytes, and 4095 in all, got"


def wrong_values():
    return [
        None, 0, -1, 1.5, "x", b"x", [], {}, (), object(), (1, 2), [1, "x"], np.zeros((2, 2)), np.array("x"), True,
        float("nan"), lambda: 0, {1}, [[]], {"a": []}, [None], int, 10**7, "file.npz", 1j, slice(3), "a\0b", np.zeros(0),
        ["a", {}],
    ]  # fmt: skip


def random_calls(n_calls, seed):
    """Yield calls with one or two wrong arguments: name, function, object of a method, and named arguments."""
    objects = make_objects()
    calls = public_calls()
    n = 0
    for again in itertools.count():
        for name, call, owner in calls:
            rng = np.random.default_rng([seed, again, *name.encode()])  # that of a call does not depend on the others
            bound = next((each for each in objects if owner is not None and isinstance(each, owner)), None)
            parameters = list(inspect.signature(call).parameters.values())[0 if owner is None else 1 :]
            parameters = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
            if (owner is not None and bound is None) or not parameters or n == n_calls:
                continue
            kinds = annotations_of(call)
            values = {p.name: example(kinds.get(p.name), objects) for p in parameters if p.default is p.empty}
            n_wrong = 1 if rng.random() < 0.7 else min(2, len(parameters))
            for k in rng.choice(len(parameters), n_wrong, replace=False):
                is_count = "int" in str(kinds.get(parameters[k].name))
                pool = [value for value in wrong_values() if not (is_count and isinstance(value, int) and value > 1)]
                values[parameters[k].name] = pool[rng.integers(len(pool))]
            n += 1
            yield name, call, () if owner is None else (bound,), values
        if n == n_calls:
            return


def test_wrong_types_give_errors_of_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    raw, n_rejected, names = [], 0, set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, call, bound, values in random_calls(N_CALLS, seed=0):
            names.add(name)
            try:
                call(*bound, **values)
            except FoveasimError as error:
                n_rejected += 1
                if "\n" in str(error):
                    raw.append(f"{name}({values}): more than one line")
            except Exception as error:  # noqa: BLE001 -- counted
                raw.append(f"{name}({values}): {error!r}")

    assert len(names) > 400
    assert n_rejected > 0.8 * N_CALLS
    assert len(raw) <= MAX_RAW_FRACTION * N_CALLS, "\n".join(raw)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fs.Capture.load(0), "'path' must be a path, got 0"),
        (lambda: fs.modes.write_events([], 1), "'path' must be a path, got 1"),
        (lambda: fs.read_layout("é" * 128), f"'path' {TOO_LONG} '{'é' * 60}...'"),
        (lambda: fs.read_layout("é" * 127), f"{'é' * 127}: no such file"),
        (lambda: fs.read_layout("\ud800" * 80), "\\ud800\\ud800\\ud800"),
        (lambda: fs.Capture.load(Path("a" * 256) / "b.npz"), f"'path' {TOO_LONG} '{'a' * 60}...'"),
        (lambda: fs.config.read_settings("a/" * 3000), f"'path' {TOO_LONG} '{'a/' * 30}...'"),
        (lambda: fs.Sensor(fs.layout.grid(2, 2, 2.0)).pattern([]), "'name' must be a string, got []"),
        (lambda: fs.Layout.from_rectangles(3, {}), "'size_um' must be an array of numbers, got {}"),
        (lambda: fs.Optics(focal_length_mm="8", f_number=4.0), "'focal_length_mm' must be one number, got '8'"),
        (lambda: fs.layout.clip(3, None), "'layout' must be a Layout, got an int"),
        (lambda: fs.layout.union([fs.layout.grid(2, 2, 2.0), 3]), "'layouts[1]' must be a Layout, got an int"),
        (lambda: fs.layout.grid(2, 2, 2.0).plot(ax="x"), "'ax' must be an Axes, got a str"),
        (lambda: fs.explore.plan_sweep(3, {}), "'shot' must be a path, or a mapping, got 3"),
    ],
)
def test_wrong_type_names_parameter(call, message):
    with pytest.raises(FoveasimError) as caught:
        call()

    assert str(caught.value).startswith(message)


def test_channels_of_mosaic_are_limited():
    layout = fs.layout.grid(8, 8, 2.0)
    values, channel = np.ones(64), np.zeros(64, np.int64)

    with pytest.raises(ParameterError, match=r"^'n_channels' must be <= 65536, got 10000000$"):
        fs.reconstruct.fill_channels(layout, values, channel, n_channels=10**7)
    for name, changed in (("values", {"values": values[:3]}), ("channel", {"channel": channel[:3]})):
        with pytest.raises(ParameterError, match=rf"^'{name}' must have one value for each of the 64 sites"):
            fs.reconstruct.fill_channels(layout, **({"values": values, "channel": channel, "n_channels": 2} | changed))
