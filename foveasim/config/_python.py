"""Python source of settings: the calls that a settings file stands for."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from foveasim.config._electronics import ELECTRONICS
from foveasim.config._models import FILE_OPTIONS, PerArea, call_of, models, with_layout_of_twin
from foveasim.config._objects import FILE_SETTINGS, resolve_files
from foveasim.config._problems import plain_settings, validate
from foveasim.config._sources import Source
from foveasim.layout import LAYOUTS, Layout
from foveasim.video import DirectionPath
from foveasim.video.gaze import path_class

#: Modules with public names, in the order of preference, and their names in the source.
MODULES = {
    "foveasim": "fs",
    "foveasim.layout": "fs.layout",
    "foveasim.scene": "fs.scene",
    "foveasim.scene.charts": "fs.scene.charts",
    "foveasim.scene.displays": "fs.scene.displays",
    "foveasim.optics": "fs.optics",
    "foveasim.distortion": "fs.distortion",
    "foveasim.sensor": "fs.sensor",
    "foveasim.sensor.effects": "fs.sensor.effects",
    "foveasim.maps": "fs.maps",
}
#: Longest call on one line.
LINE_LENGTH = 100
#: Names of pictures of scikit-image.
BUNDLED = re.compile(r"skimage:[\w-]+")
INDENT = "    "
CHECK = "report = camera.layout.check(rules)"
HEADER = '"""Simulation of a shot; written by foveasim."""\n'


def to_python(settings: Mapping[str, Any], *, source: Source | str | Path | None = None) -> str:
    """
    Return Python source that simulates the shot of settings, with bit-identical codes.

    Parameters
    ----------
    settings : mapping
        As :func:`read_settings` returns them.
    source : Source, path or None
        Origin of the settings; paths in them are relative to its directory. None for settings from Python, whose paths are
        relative to the working directory.

    Returns
    -------
    text : str
        Source that defines ``camera``, ``scene`` and ``capture``; with design rules also ``rules`` and their ``report``; with a
        gaze path also ``gaze_path``, and ``video``, which yields a capture for each of its rows.

    Raises
    ------
    ConfigError
        When a setting is invalid.

    Examples
    --------
    >>> from foveasim.config import demo_settings, read_settings, to_python
    >>> path = demo_settings()[0]
    >>> "optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)" in to_python(
    ...     read_settings(path), source=path
    ... )
    True
    """
    source = Source.of(source)
    data = with_layout_of_twin(plain_settings(source, settings))
    if source.file is not None:
        data = resolve_files(source.directory.absolute(), data)
    shot = validate(source, models().shot, data)
    writer = _Writer()
    try:
        lines = _shot_lines(writer, shot)
    except _NotPublicError:
        writer = _Writer()
        lines = [
            f"settings = {writer.expression(data)}",
            "",
            "shot = fs.config.build_shot(None, settings)",
            "camera, scene = shot.camera, shot.scene",
            "capture = camera.capture(scene, exposure_s=shot.requested_s, seed=shot.seed)",
        ]
        if getattr(shot.layout, "rules", None) is not None:
            lines += ["rules = shot.rules", CHECK]
        if shot.gaze_path is not None:
            lines += [
                "gaze_path = shot.gaze_path",
                _video_line(writer, shot.gaze_path, _Name("shot.requested_s"), _Name("shot.seed")),
            ]
    imports = ["import foveasim as fs", *sorted(writer.imports)]
    return "\n".join([HEADER, *imports, "", *lines, ""])


class _NotPublicError(Exception):
    """A section without a public call of the same meaning."""


def _shot_lines(writer: _Writer, shot: Any) -> list[str]:
    camera = {"optics": _Name("optics"), "sensor": _Name("sensor")}
    lines = [*_layout_lines(writer, shot.layout), writer.assignment("optics", shot.optics)]
    if shot.distortion is not None:
        lines.append(writer.assignment("distortion", shot.distortion))
        camera["distortion"] = _Name("distortion")
    if shot.integration_order is not None:
        camera["order"] = shot.integration_order
    sensor, make = writer.arguments(shot.sensor), "fs.Sensor"
    first: dict[str, Any] = {"layout": _Name("layout")}
    for name in ELECTRONICS:
        if (origin := sensor.pop(name, None)) is None:
            continue
        if name == "twin":
            make = f"{writer.call('fs.twin.read_twin', {'path': origin}, positional=('path',))}.sensor"
        else:
            make, first["origin"] = f"fs.Sensor.from_{name}", origin
    capture = {"scene": _Name("scene"), "exposure_s": shot.exposure_s, "seed": shot.seed}
    for name in ("gaze_um", "gaze_deg", "axis"):
        if getattr(shot, name) != type(shot).model_fields[name].default:
            camera[name] = getattr(shot, name)
    return [
        *lines,
        f"sensor = {writer.call(make, first | sensor, positional=() if make == 'fs.Sensor' else tuple(first))}",
        f"camera = {writer.call('fs.Camera', camera)}",
        writer.assignment("scene", shot.scene),
        f"capture = {writer.call('camera.capture', capture, positional=('scene',))}",
        *([] if getattr(shot.layout, "rules", None) is None else [CHECK]),
        *_gaze_lines(writer, shot),
    ]


def _gaze_lines(writer: _Writer, shot: Any) -> list[str]:
    """Return the lines that define the gaze path of a shot, and its captures."""
    if shot.gaze_path is None:
        return []
    call = "fs.video." + ("read_gaze_path" if isinstance(shot.gaze_path, str) else "GazePath.from_rows")
    return [
        f"gaze_path = {writer.call(call, {'value': shot.gaze_path}, positional=('value',))}",
        _video_line(writer, shot.gaze_path, shot.exposure_s, shot.seed),
    ]


def _video_line(writer: _Writer, path: Any, exposure_s: Any, seed: Any) -> str:
    """Return the line that defines the captures along a gaze path, in rows or a file."""
    is_turn = isinstance(path, str) and path_class(Path(path)) is DirectionPath
    name = "turn_camera" if is_turn else "shift_sensor"
    frames = {"frames": _Name(f"fs.video.{name}(scene, gaze_path)"), "exposure_s": exposure_s, "seed": seed}
    return f"video = {writer.call('camera.video', frames, positional=('frames',))}"


def _layout_lines(writer: _Writer, section: Any, variable: str = "layout") -> list[str]:
    """Return the lines that define a layout, with its edits in their order."""
    layout = _Name(variable)
    if isinstance(section, str):
        return [f"{layout} = {writer.call('fs.read_layout', {'path': section}, positional=('path',))}"]
    if hasattr(section, "generator"):
        picture = getattr(LAYOUTS[section.generator], "picture", None)
        if picture is not None and getattr(section.parameters, picture) is not None:
            raise _NotPublicError  # a picture is read and placed on a grid
        lines = [writer.assignment(variable, section.parameters)]
    else:
        options = {name: getattr(section, name) for name in ("file", *FILE_OPTIONS) if name in section.model_fields_set}
        lines = [f"{layout} = {writer.call('fs.layout.read_layout', options, positional=('file',))}"]

    def step(call: str, values: dict[str, Any]) -> str:
        first = {} if call.startswith(f"{variable}.") else {"layout": layout}
        return f"{layout} = {writer.call(call, {**first, **values}, positional=('layout',))}"

    rules = getattr(section, "rules", None)  # layouts within edits have none
    if rules is not None and variable == "layout":
        lines.append(writer.assignment("rules", rules))
        rules = _Name("rules")
    if section.mosaic is not None:
        lines.append(step("fs.layout.mosaic", {"block": section.mosaic}))
    for edit in getattr(section, "edits", []):
        values = writer.arguments(edit)
        if "layer" in values:
            lines += _layout_lines(writer, values["layer"], "layer")
            values["layer"] = _Name("layer")
        call = call_of(edit)
        if values.get("rules") is None and "rules" in type(edit).model_fields and rules is not None:
            values["rules"] = rules
        assert call is not None
        is_method = inspect.unwrap(getattr(Layout, call.__name__, len)) is inspect.unwrap(call)
        lines.append(step(f"{variable}.{call.__name__}" if is_method else writer.name_of(call), values))
    if any(section.move_um):
        lines.append(step(f"{variable}.translate", {"dx_um": section.move_um[0], "dy_um": section.move_um[1]}))
    if section.inset_um:
        lines.append(step("fs.layout.inset", {"margin_um": section.inset_um}))
    if section.snap_um is not None:
        lines.append(step("fs.layout.snap", {"grid_um": section.snap_um}))
    return lines


class _Name(str):
    """A name or expression of the source, not a string."""

    __slots__ = ()


class _Writer:
    """Writer of expressions, which collects the imports that they need."""

    def __init__(self) -> None:
        self.imports: set[str] = set()

    def assignment(self, name: str, section: BaseModel) -> str:
        """Return the line that assigns the object of a section."""
        return f"{name} = {self.expression(section)}"

    def arguments(self, section: BaseModel) -> dict[str, Any]:
        """Return the values of a section that the settings contain."""
        return {
            name: self._file(name, getattr(section, name))
            for name in type(section).model_fields
            if name in section.model_fields_set and name not in {"kind", "generator"}
        }

    def _file(self, name: str, value: Any) -> Any:
        """Return the expression of a picture of scikit-image, or the value."""
        if name in FILE_SETTINGS and isinstance(value, str) and BUNDLED.fullmatch(value):
            return _Name(f'fs.config.picture_path(fs.config.Source(), "{value}", "{name}")')
        return value

    def expression(self, value: Any, depth: int = 0) -> str:
        """Return the source of a value."""
        if isinstance(value, _Name):
            return str(value)
        if isinstance(value, PerArea):
            return f"{self.expression(value.per_um2)} * layout.area_um2"
        if isinstance(value, BaseModel):
            call = call_of(value)
            if call is None:
                raise _NotPublicError
            return self.call(self.name_of(call), self.arguments(value), depth=depth)
        if isinstance(value, float) and not math.isfinite(value):
            return f'float("{value}")'
        if isinstance(value, Mapping):
            items = [f"{self.expression(k)}: {self.expression(v, depth + 1)}" for k, v in value.items()]
            return _joined("{", items, "}", depth)
        if isinstance(value, list | tuple):
            return _joined("[", [self.expression(item, depth + 1) for item in value], "]", depth)
        if isinstance(value, str) and '"' not in value and value.isprintable() and "\\" not in value:
            return f'"{value}"'
        return repr(value)

    def call(self, name: str, arguments: Mapping[str, Any], *, positional: tuple[str, ...] = (), depth: int = 0) -> str:
        """Return the source of a call."""
        items = [
            self.expression(value, depth + 1) if key in positional else f"{key}={self.expression(value, depth + 1)}"
            for key, value in arguments.items()
        ]
        return _joined(f"{name}(", items, ")", depth)

    def name_of(self, call: Callable[..., Any]) -> str:
        """Return the public name of a function, class or class method."""
        owner = getattr(call, "__self__", None)
        if isinstance(owner, type):
            return f"{self.name_of(owner)}.{call.__name__}"
        wanted = inspect.unwrap(call)
        for module, shown in MODULES.items():
            found = import_module(module)
            for name in found.__all__:
                if name == getattr(wanted, "__name__", "") and inspect.unwrap(getattr(found, name)) is wanted:
                    return f"{shown}.{name}"
        if "<" in wanted.__qualname__ or "." in wanted.__qualname__:
            raise _NotPublicError
        self.imports.add(f"import {wanted.__module__}")
        return f"{wanted.__module__}.{wanted.__qualname__}"


def _joined(opening: str, items: list[str], closing: str, depth: int) -> str:
    """Return items on one line, or one per line if they are too long."""
    line = opening + ", ".join(items) + closing
    if len(line) + len(INDENT) * depth <= LINE_LENGTH and "\n" not in line:
        return line
    inner = INDENT * (depth + 1)
    return "\n".join([opening, *(f"{inner}{item}," for item in items), INDENT * depth + closing])
