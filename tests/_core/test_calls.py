"""Calls with wrong arguments: messages with the signature and the closest name; unchanged signatures."""

from __future__ import annotations

import inspect
import pickle
import pkgutil
import runpy
from doctest import DocTestFinder
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import get_type_hints

import numpy as np
import pytest

import foveasim as fs
from foveasim._core.calls import CHECKED, check_arguments
from foveasim.errors import ArgumentError, ParameterError
from foveasim.layout import LAYOUTS, layout_generator
from foveasim.layout.generators.grid import grid as grid_of_module

SITES = fs.layout.grid(3, 3, 2.0)
GRID = r"grid\(n_x=None, n_y=None, pitch_um=None, \*, size_um=None, .*\)"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fs.layout.grid(3, 3, pich_um=2.0), rf"^'pich_um' must be an argument of {GRID}; did you mean 'pitch_um'\?$"),
        (lambda: fs.layout.grid(nx=3, n_y=3, pitch_um=2.0), r"'nx' must be an argument of .*; did you mean 'n_x'\?$"),
        (lambda: fs.layout.log_polar(24), r"^'r_max_um' must be given: log_polar\(n_sectors=None, \*, r_max_um, .*\)$"),
        (fs.layout.clip, r"^'layout' and 'region' must be given: clip\(layout, region, \*, cut='pieces'\)$"),
        (lambda: fs.layout.grid(3, 3, 2.0, 4.0), rf"^'grid' must have at most 3 positional arguments, got 4 by position: {GRID}$"),
        (lambda: fs.layout.grid(3, 3, 2.0, n_x=4), rf"^'n_x' must be given once, by position or by name: {GRID}$"),
        (lambda: fs.Camera(1, 2), r"^'Camera' must have named arguments only, got 2 by position: Camera\(\*, optics, sensor, "),
        (lambda: fs.Sensor(SITES, read_noise=2.0), r"^'read_noise' must be an argument of Sensor\(layout, .*, \.\.\.\); did you mean 'read_noise_e'\?$"),
        (lambda: fs.Scene.from_picture("a.png", pitch=3.0), r"of Scene\.from_picture\(picture, .*; did you mean 'pitch_um'\?$"),
        (lambda: SITES.translate(1.0), r"^'dy_um' must be given: Layout\.translate\(dx_um, dy_um\)$"),
        (lambda: fs.modes.SpikingPixels(fs.Sensor(SITES)).stream([], frame_s=1.0), r"^'seed' must be given: SpikingPixels\.stream\(rates, "),
        (lambda: fs.layout.clip(SITES), r"^'region' must be given: clip\(layout, region, \*, cut='pieces'\)$"),
        (lambda: SITES.plot(xyz=1), r"^'xyz' must be an argument of plot_layout\(layout, by=None, [^;]*\)$"),
    ],
)  # fmt: skip
def test_wrong_arguments_name_signature(call, message):
    with pytest.raises(ArgumentError, match=message) as caught:
        call()

    assert isinstance(caught.value, TypeError)
    assert isinstance(caught.value, ParameterError)
    assert "\n" not in str(caught.value)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_type_errors_of_code_are_unchanged():
    @check_arguments
    def add(a, b=1):
        return a + b

    assert add(1) == 2
    with pytest.raises(TypeError, match="unsupported operand") as caught:
        add(None)
    assert not isinstance(caught.value, ArgumentError)
    with pytest.raises(ArgumentError, match=r"^'a' must be given: add\(a, b=1\)$"):
        add()


def test_variadic_arguments_accept_any_name():
    @check_arguments
    def collect(first, *others, **named):
        return first, others, named

    assert collect(1, 2, x=3) == (1, (2,), {"x": 3})
    with pytest.raises(ArgumentError, match=r"^'first' must be given: collect\(first, \*others, \*\*named\)$"):
        collect(x=1)


def public_packages():
    """Return the documented modules, and the packages inside them, from which their names can be imported, too."""
    modules = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "generated_pages.py"))["MODULES"]
    packages = [
        item.name
        for module in modules
        if hasattr(import_module(module), "__path__") and module not in ("foveasim", "foveasim.learn")
        for item in pkgutil.iter_modules(import_module(module).__path__, f"{module}.")
        if item.ispkg and "._" not in item.name and hasattr(import_module(item.name), "__all__")
    ]
    return [*modules, *packages]


def public_functions():
    """Yield public functions, constructors and methods with their names."""
    for name in public_packages():
        module = import_module(name)
        for public in module.__all__:
            item = getattr(module, public)
            if isinstance(item, FunctionType):
                yield f"{name}.{public}", item
            elif (
                isinstance(item, type)
                and not issubclass(item, BaseException)
                and not getattr(item, "_is_protocol", False)
            ):
                for method, member in vars(item).items():
                    if isinstance(member, FunctionType) and (method == "__init__" or not method.startswith("_")):
                        yield f"{name}.{public}.{method}", member


def test_all_public_calls_are_checked():
    names = dict(public_functions())

    assert len(names) > 300
    assert {name for name, function in names.items() if not hasattr(function, CHECKED)} == set()


def test_signatures_and_examples_remain_visible():
    assert list(inspect.signature(fs.layout.grid).parameters)[:3] == ["n_x", "n_y", "pitch_um"]
    assert get_type_hints(fs.layout.grid)["stagger"] is bool
    assert inspect.signature(fs.Sensor).parameters["bits"].default == 8
    assert fs.view.id_map.__doc__.strip().startswith("Return the photosite under")
    assert "@layout_generator" in inspect.getsource(fs.layout.grid)
    finder = DocTestFinder(exclude_empty=True)
    found = {test.name for test in finder.find(import_module("foveasim.view.id_map")) if test.examples}
    assert {"foveasim.view.id_map.id_map", "foveasim.view.id_map.site_at"} <= found


def test_checked_functions_are_pickled_by_name():
    for function in (fs.layout.clip, fs.layout.grid, fs.view.to_html, fs.read_layout):
        assert pickle.loads(pickle.dumps(function)) is function
    assert grid_of_module is fs.layout.grid


def test_registered_generators_are_checked():
    @layout_generator(example={"side_um": 2.0})
    def single_site_of_test(side_um):
        return fs.Layout.from_rectangles([[0.0, 0.0]], side_um)

    try:
        assert single_site_of_test(3.0).provenance["parameters"] == {"side_um": 3.0}
        with pytest.raises(
            ArgumentError,
            match=r"'side' must be an argument of .*single_site_of_test\(side_um\); did you mean 'side_um'",
        ):
            LAYOUTS["single_site_of_test"](side=3.0)
    finally:
        del LAYOUTS._objects["single_site_of_test"]


@pytest.mark.parametrize(
    ("by_position", "by_name"),
    [
        (lambda: fs.layout.grid(4, 3, 2.0), lambda: fs.layout.grid(n_x=4, n_y=3, pitch_um=2.0)),
        (lambda: fs.layout.hexagonal(4, 3, 2.0), lambda: fs.layout.hexagonal(n_columns=4, n_rows=3, pitch_um=2.0)),
        (lambda: fs.layout.octagonal(4, 3, 2.0), lambda: fs.layout.octagonal(n_x=4, n_y=3, pitch_um=2.0)),
        (lambda: fs.layout.log_polar(24, r_max_um=54.7, min_size_um=2.0), lambda: fs.layout.log_polar(n_sectors=24, r_max_um=54.7, min_size_um=2.0)),
        (lambda: fs.layout.penrose(2.0, size_um=20.0), lambda: fs.layout.penrose(side_um=2.0, size_um=20.0)),
        (lambda: fs.layout.sunflower(50, 2.0), lambda: fs.layout.sunflower(n_sites=50, spacing_um=2.0)),
        (lambda: fs.layout.tiling(2.0, radius_um=9.0), lambda: fs.layout.tiling(pitch_um=2.0, radius_um=9.0)),
        (lambda: fs.layout.zones((1.0, 2.0), (8.0, 16.0)), lambda: fs.layout.zones(pitch_um=(1.0, 2.0), side_um=(8.0, 16.0))),
    ],
)  # fmt: skip
def test_generators_accept_sizes_by_position(by_position, by_name):
    one, other = by_position(), by_name()

    assert np.array_equal(one.xy_um, other.xy_um)
    assert one.provenance == other.provenance


def test_warnings_point_to_user_code():
    with pytest.warns(fs.errors.LayoutWarning) as caught:
        fs.layout.log_polar(24, r_max_um=50.0, min_size_um=2.0)

    assert caught[0].filename == __file__
