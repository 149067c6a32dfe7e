"""All public functions, constructors and methods, with plausible arguments for their annotations."""

from __future__ import annotations

import builtins
import collections.abc
import inspect
import runpy
import types
import typing
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import foveasim as fs
from foveasim._core.calls.kinds import without_alias

MODULES = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "generated_pages.py"))["MODULES"]
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
    kind = without_alias(kind)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    simple = {float: 1.0, int: 2, bool: True, str: "x", Path: Path("file.npz")}
    if origin is typing.Annotated:
        return example(arguments[0], objects)
    if kind in simple:
        return simple[kind]
    if origin in (typing.Union, types.UnionType):
        if any(each is ArrayLike or "array_like" in str(each) for each in arguments):
            return np.arange(1.0, 5.0)
        return "file.npz" if Path in arguments else example(arguments[0], objects)
    if origin is typing.Literal:
        return arguments[0]
    if origin is tuple:
        return tuple(example(each, objects) for each in arguments if each is not Ellipsis)
    if origin in (list, collections.abc.Sequence, collections.abc.Iterable, collections.abc.Collection):
        return [example(arguments[0], objects)] * 2
    if origin is np.ndarray or kind is ArrayLike:
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
