"""Kinds of values that annotations specify: valid values of other libraries are accepted, others are named."""

from __future__ import annotations

import os
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typing_extensions import TypeAliasType

import foveasim as fs
from foveasim._core.calls import kinds
from foveasim._core.calls.limits import Declaration
from foveasim.errors import ParameterError

LAYOUT = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
GRID = fs.Grid((8, 8), 1.0)
PICTURE = {"pitch_um": 100.0, "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.1}


class Lazy:
    """Array-like that counts how often it is computed."""

    def __init__(self):
        self.n_computed = 0

    def __array__(self, dtype=None, copy=None):
        self.n_computed += 1
        return np.ones((4, 4))


@pytest.mark.parametrize(
    "call",
    [
        lambda: fs.Integrator(LAYOUT, GRID, order=np.uint8(2)),
        lambda: fs.Integrator(LAYOUT, GRID, order=np.array(2)),
        lambda: fs.Sensor(LAYOUT, sensitivity=np.full(16, 0.5, object)),
        lambda: fs.Sensor(LAYOUT, sensitivity=[Fraction(1, 2)] * 16),
        lambda: fs.Sensor(LAYOUT, disabled={"read"}),
        lambda: fs.Sensor(LAYOUT, disabled=(name for name in ("read", "prnu"))),
        lambda: fs.distortion.BrownConrady(focal_um=[8000.0]),
        lambda: fs.layout.union(layout for layout in (LAYOUT, LAYOUT.translate(20.0, 0.0))),
        lambda: fs.Scene.from_picture(Image.new("RGB", (8, 8)), **PICTURE, wavelength_nm=[620.0, 550.0, 450.0]),
        lambda: fs.Layout.from_polygons(polygon for polygon in LAYOUT.polygons()),
    ],
    ids=[
        "numpy integer",
        "0-d array",
        "objects",
        "fractions",
        "set",
        "generator",
        "list of one",
        "layouts",
        "Pillow",
        "polygons",
    ],
)
def test_values_of_other_types_are_accepted(call):
    call()


def test_directory_entries_are_paths(tmp_path):
    fs._io.images.write_picture(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    with os.scandir(tmp_path) as entries:
        source = fs.video.FrameSource(list(entries), frame_s=0.1, **PICTURE, wavelength_nm=[620.0, 550.0, 450.0])

    assert next(iter(source)).basis.shape == (3, 4, 4)


def test_lazy_arrays_are_computed_once():
    lazy = Lazy()
    fs.PowerMap.from_array(lazy, pitch_um=1.0, wavelength_nm=550.0)

    assert lazy.n_computed == 1


def test_attributes_of_protocols_are_not_computed():
    class Proxy:
        def __getattr__(self, name):
            raise AssertionError(name)

    with pytest.raises((ParameterError, AssertionError)):
        fs.reconstruct.cells(SimpleNamespace(), np.ones(3), GRID)
    assert fs._core.calls.kinds.kind_of(fs.fields.PackedRings).accepts(Proxy())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fs.Sensor(LAYOUT).without(["read"]), r"'names\[0\]' must be a string"),
        (lambda: fs.Sensor(LAYOUT, disabled="read"), "'disabled' must be"),
        (lambda: fs.Sensor(LAYOUT, sensitivity=[None] * 16), "'sensitivity' must be"),
        (lambda: fs.Sensor(LAYOUT, bits=Fraction(10**400)), "'bits' must be an integer"),
        (lambda: fs.Integrator(LAYOUT, GRID, order=3), "'order' must be one of 1, 2"),
    ],
)
def test_invalid_values_are_named(call, message):
    with pytest.raises(ParameterError, match=message):
        call()


def test_list_that_contains_itself_is_rejected():
    endless = []
    endless.append(endless)
    with pytest.raises(ParameterError, match="'sensitivity' must be"):
        fs.Sensor(LAYOUT, sensitivity=endless)


def test_aliases_have_the_kind_of_their_type(monkeypatch):
    numbers = TypeVar("numbers", bound=np.generic)
    array = TypeAliasType(
        "array", np.ndarray[Any, np.dtype[numbers]], type_params=(numbers,)
    )  # as numpy 2.5 defines NDArray
    other = TypeAliasType("other", array[np.float64])
    monkeypatch.setattr(kinds, "ALIASES", (*kinds.ALIASES, TypeAliasType))

    assert kinds.without_alias(array[np.float64]) == np.ndarray[Any, np.dtype[np.float64]]
    assert kinds.kind_of(other) == kinds.kind_of(NDArray[np.float64])
    assert Declaration.of(float | array[np.float64]).is_per_site
    assert kinds.kind_of(int | None).one == "an integer"
