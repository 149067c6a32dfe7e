"""Changes of the settings that a page requests: fields of its messages, and new settings."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from foveasim.config import get_setting, put_setting
from foveasim.config._models import expand_preset
from foveasim.errors import ParameterError, printable
from foveasim.layout import LAYOUTS
from foveasim.sensor import PRESETS
from foveasim.studio._files import Files, with_layout
from foveasim.studio._settings.controls import controls_of
from foveasim.studio._settings.templates import has_mosaic

#: Messages that change the settings.
CHANGES = (
    "set",
    "assign",
    "reset",
    "delete",
    "undo",
    "redo",
    "apply",
    "preset",
    "new_sensor",
    "restore",
    "file",
    "video",
    "frame",
    "match",
    "solve",
    "fit",
    "seek",
    "follow",
    "gaze_file",
    "saccades",
)
#: Changes that are drafts while they are not final.
DRAFTS = ("set", "follow")
#: Changes that advance a source of frames: newer ones do not stop their simulations.
ONCE = ("video", "frame", "seek")
#: Longest path of a setting.
MAX_KEY_LENGTH = 500
#: Largest depth of settings from the page.
MAX_DEPTH = 20
#: Filters that a layout receives: a mosaic, or a colouring of the sites.
MOSAIC = ["RG", "GB"]
COLOURING = {"kind": "graph_colouring", "n_channels": 3}
#: Edits that assign filters to sites.
COLOURING_KINDS = ("graph_colouring", "mosaic", "random_channels")


def is_change(message: Any) -> bool:
    """Return whether a message changes the settings."""
    return isinstance(message, dict) and message.get("do") in CHANGES


def setting_of(message: dict[str, Any]) -> Any:
    """Return the path of the setting that a message changes, if there is one."""
    return "gaze_um" if message.get("do") == "follow" else message.get("key")


def is_draft(message: dict[str, Any], key: Any = None) -> bool:
    """Return whether a message sets a value during a drag or a replay, of a given key."""
    return message.get("do") in DRAFTS and message.get("final") is False and (key is None or setting_of(message) == key)


def is_temporary(message: dict[str, Any]) -> bool:
    """Return whether a message changes the settings without an undo step."""
    return is_draft(message) or (is_frame(message) and message.get("final") is False)


def is_frame(message: Any) -> bool:
    """Return whether a message changes the frame of a video or camera."""
    return isinstance(message, dict) and message.get("do") == "frame"


def string_of(message: dict[str, Any], name: str) -> str:
    """Return a text of a message."""
    value = message.get(name)
    if not isinstance(value, str):
        raise ParameterError(name, "must be a string")
    return value


def key_of(message: dict[str, Any]) -> str:
    """Return the path of the setting of a message."""
    key = string_of(message, "key")
    if not key or len(key) > MAX_KEY_LENGTH or not all(key.split(".")):
        raise ParameterError("key", "must be the path of a setting, such as sensor.bits", printable(key)[:40])
    return key


def check_depth(value: Any, depth: int = 0) -> Any:
    """Return a value from the page, after a check of its depth."""
    if depth > MAX_DEPTH:
        raise ParameterError("value", f"must have at most {MAX_DEPTH} levels")
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        check_depth(item, depth + 1)
    return value


def reset(settings: dict[str, Any], start: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return settings with the initial value of a key, or without it."""
    found = copy.deepcopy(settings)
    value = get_setting(start, key)
    if value is not None:
        put_setting(None, found, key, copy.deepcopy(value))
        return found
    above, _, last = key.rpartition(".")
    section: Any = get_setting(found, above) if above else found
    if isinstance(section, dict):
        section.pop(last, None)
    elif isinstance(section, list) and last.isdecimal() and int(last) < len(section):
        section.pop(int(last))
    return found


def changed_keys(settings: Any, start: Any, key: str = "") -> list[str]:
    """Return the keys of values that differ from the initial ones."""
    if isinstance(settings, dict) and isinstance(start, dict):
        return [
            found
            for name in dict.fromkeys((*start, *settings))
            for found in changed_keys(settings.get(name), start.get(name), f"{key}.{name}" if key else name)
        ]
    return [] if settings == start else [key]


def chooses_filters(message: dict[str, Any]) -> bool:
    """Return whether a message chooses a layout, or the filters of the sensor."""
    match message["do"]:
        case "preset":
            return str(message.get("name")).startswith("layout:")
        case "file":
            return message.get("as") == "layout"
        case "set" | "reset" | "delete":
            return message.get("key") in ("layout", "sensor", "sensor.filters")
        case _:
            return False


def match_filters(settings: dict[str, Any], before: Mapping[str, Any]) -> None:
    """
    Let sites have filters.

    Sites in rows and columns, or rings and sectors, have a mosaic, others a colouring. What this added for the
    layout ``before`` is removed.
    """
    layout, old, sensor = settings.get("layout"), before.get("layout"), settings.get("sensor")
    if not isinstance(layout, dict) or "generator" not in layout:
        return
    old = old if isinstance(old, dict) else {}
    edits = list(layout.get("edits") or [])
    if (
        COLOURING in edits
        and old.get("generator") in LAYOUTS
        and not has_mosaic(old["generator"])
        and has_mosaic(layout["generator"])
    ):
        edits.remove(COLOURING)
    is_coloured = isinstance(sensor, dict) and sensor.get("filters") is not None
    was_coloured = isinstance(before.get("sensor"), dict) and before["sensor"].get("filters") is not None
    if was_coloured and not is_coloured and COLOURING in edits and not has_mosaic(layout["generator"]):
        edits.remove(COLOURING)
    if is_coloured:
        has_filters = any(edit.get("kind") in COLOURING_KINDS for edit in edits if isinstance(edit, dict))
        if not has_mosaic(layout["generator"]):
            layout.pop("mosaic", None)
            if not has_filters:
                edits.append(dict(COLOURING))
        elif layout.get("mosaic") is None and not has_filters:
            layout["mosaic"] = copy.deepcopy(old.get("mosaic") or MOSAIC)
    if edits != (layout.get("edits") or []):
        layout["edits"] = edits
        if not edits:
            del layout["edits"]


def choose_preset(settings: dict[str, Any]) -> None:
    """Replace the electronics of the sensor by those of its preset, without earlier values."""
    sensor = settings.get("sensor")
    if isinstance(sensor, dict) and sensor.get("preset") is not None:
        names = {name for preset in PRESETS.values() for name in preset.settings()}
        settings["sensor"] = expand_preset({key: value for key, value in sensor.items() if key not in names})


def with_file(
    settings: Mapping[str, Any], start: Mapping[str, Any], files: Files, path: str, use: Any
) -> dict[str, Any]:
    """
    Return settings with an uploaded file.

    ``settings``, ``start``: current and initial settings. ``use``: {"scene", "layout", "settings"}. Raises FileError when the
    file is not available, or invalid. Raises ParameterError when the use is unknown.
    """
    match use:
        case "scene":
            found = copy.deepcopy(dict(settings))
            if found["scene"].get("kind") != "picture":
                control = next(control for control in controls_of(found, start) if control["key"] == "scene")
                found["scene"] = next(each["value"] for each in control["choices"] if each["label"] == "picture")
            found["scene"]["picture"] = path
            if found["scene"].get("fit") is None:
                put_setting(None, found, "scene.fit", "cover")  # pictures differ in their number of pixels
            return found
        case "layout":
            return with_layout(settings, files.layout_of(path))
        case "settings":
            return files.settings_of(path)
        case _:
            raise ParameterError("as", "must be scene, layout or settings", printable(str(use))[:40])
