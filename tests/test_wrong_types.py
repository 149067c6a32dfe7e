"""Random calls of all public functions, constructors and methods with values of wrong types: errors of the package."""

from __future__ import annotations

import builtins
import collections.abc
import inspect
import itertools
import runpy
import types
import typing
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import FoveasimError, ParameterError

MODULES = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "generated_pages.py"))["MODULES"]
N_CALLS = 1550
MAX_RAW_FRACTION = 0.01
TOO_LONG = "must have names of at most 255 bytes, and 4095 in all, got"
#: Modules and calls that open windows, serve pages or need PyTorch.
EXCLUDED_MODULES = ("foveasim.learn", "foveasim.studio")
EXCLUDED = {"check_all", "compile_kernels", "serve", "show_columns", "show_solids", "show", "widget"}


class Undefined(type):
    """Names that only type checkers import."""

    def __getattr__(cls, name):
        if name.startswith("_"):
            raise AttributeError(name)
        return Unknown

    def __getitem__(cls, key):
        return Unknown


class Unknown(metaclass=Undefined):
    pass


class Names(dict):
    def __missing__(self, name):
        return getattr(builtins, name, Unknown)


def members_of(kind):
    """Yield the constructor of a public class and its public methods, with the class of unbound ones."""
    if not inspect.isabstract(kind):
        yield kind, None
    for name in dir(kind):
        member = inspect.getattr_static(kind, name)
        if name.startswith("_") and name != "__call__":
            continue
        if isinstance(member, classmethod | staticmethod):
            yield getattr(kind, name), None
        elif inspect.isfunction(member):
            yield member, kind


def public_calls():
    """Return every public callable once, with the class of methods, ordered by name."""
    found = {}
    for name in MODULES:
        if name.startswith(EXCLUDED_MODULES):
            continue
        module = import_module(name)
        for public in module.__all__:
            if public in ("learn", *EXCLUDED):
                continue
            item = getattr(module, public)
            if inspect.isfunction(item):
                members = [(item, None)]
            elif (
                isinstance(item, type) and not issubclass(item, BaseException) and not getattr(item, "_is_protocol", 0)
            ):
                members = list(members_of(item))
            else:
                continue
            for call, owner in members:
                own = call if isinstance(call, type) else inspect.unwrap(getattr(call, "__func__", call))
                if own.__name__ not in EXCLUDED and str(own.__module__).startswith("foveasim"):
                    found.setdefault(own, (f"{own.__module__}.{own.__qualname__}", call, owner))
    return sorted(found.values(), key=lambda each: each[0])


def annotations_of(call):
    function = inspect.unwrap(call.__init__ if isinstance(call, type) else getattr(call, "__func__", call))
    found = {}
    for name, annotation in getattr(function, "__annotations__", {}).items():
        try:
            text = isinstance(annotation, str)
            found[name] = eval(annotation, {}, Names(function.__globals__)) if text else annotation
        except TypeError:
            found[name] = typing.Any
    return found


def make_objects():
    """Return an object of each main class."""
    layout = fs.layout.grid(4, 4, 3.0)
    sensor = fs.Sensor(layout, read_noise_e=2.0)
    grid = fs.Grid.centred((20, 24), 1.0)
    light = fs.PowerMap(np.full((1, 20, 24), 1e-3), grid, [550.0])
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0)
    camera = fs.Camera(optics=optics, sensor=sensor)
    capture = camera.capture(light, exposure_s=0.01, seed=1)
    rules = fs.DesignRules(min_size_um=1.0)
    scene = fs.Scene.flat(shape=(40, 40), pitch_um=100.0, distance_m=1.0, radiance_w_m2_sr_nm=0.1, band_width_nm=10.0)
    curves = [fs.SiliconQE(depth_um=3.0), fs.GaussianCurve(centre_nm=550.0, fwhm_nm=90.0), fs.rgb_filters()]
    effects = [
        kind(
            *[1.0 for parameter in inspect.signature(kind).parameters.values() if parameter.default is parameter.empty]
        )
        for kind in (fs.sensor.effects.ReadNoise, fs.sensor.effects.PixelOffset, fs.sensor.effects.PixelGain)
    ]
    return [
        layout, sensor, grid, light, optics, camera, capture, rules, scene, *curves, *effects,
        capture.picture(max_pixels=32), layout.check(rules), fs.Integrator(layout, grid), sensor.sites, sensor.adc,
        fs.distortion.BrownConrady(focal_um=8000.0, k1=-0.1), np.random.default_rng(0),
        fs.layout.Readout(frames_per_s=30.0, bits=10), fs.optics.Seidel(coma_um=0.1), fs.optics.Annulus(0.3),
        fs.optics.Zernike(coefficients={4: 0.1}), fs.sensor.Diffusion(spread_um=0.4), fs.config.Source(),
        fs.sensor.InterPixelCapacitance(neighbour_fraction=0.01), fs.sensor.effects.ShotNoise(),
        fs.layout.Routing(width_um=0.1, space_um=0.1), fs.modes.EventPixels(sensor), fs.modes.SpikingPixels(sensor),
    ]  # fmt: skip


def example(kind, objects):
    """Return a plausible value of a type."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    simple = {float: 1.0, int: 2, bool: True, str: "x", Path: Path("file.npz")}
    if origin is typing.Annotated:
        return example(arguments[0], objects)
    if kind in simple:
        return simple[kind]
    if origin in (typing.Union, types.UnionType):
        if any("array_like" in str(each) for each in arguments):
            return np.arange(1.0, 5.0)
        return "file.npz" if Path in arguments else example(arguments[0], objects)
    if origin is typing.Literal:
        return arguments[0]
    if origin is tuple:
        return tuple(example(each, objects) for each in arguments if each is not Ellipsis)
    if origin in (list, collections.abc.Sequence, collections.abc.Iterable, collections.abc.Collection):
        return [example(arguments[0], objects)] * 2
    if origin is np.ndarray:
        return np.arange(1.0, 5.0)
    if origin in (dict, collections.abc.Mapping):
        return {}
    if origin is collections.abc.Callable:
        return lambda *_, **__: 1.0
    if isinstance(kind, type) and getattr(kind, "_is_protocol", False):
        return objects[0]
    if not isinstance(kind, type) or kind is typing.Any:
        return None
    return next((each for each in objects if isinstance(each, kind)), None)


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
