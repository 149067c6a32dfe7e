"""Changes of the settings that a page requests."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foveasim.config import get_setting, put_setting
from foveasim.config._electronics import ELECTRONICS, with_electronics
from foveasim.errors import FileError
from foveasim.layout import LAYOUTS
from foveasim.sensor import PRESETS
from foveasim.sensor.limits import ALTERNATIVES
from foveasim.sensor.published.datasheet import PARAMETERS
from foveasim.studio._files import with_layout
from foveasim.studio._messages.models import DeleteValue, OpenFile, ResetValue, handles
from foveasim.studio._settings.controls import controls_of
from foveasim.studio._settings.gaze import rows_of_file
from foveasim.studio._settings.templates import has_mosaic
from foveasim.studio._settings.unknowns import balanced
from foveasim.studio._settings.uses import PLACES, use_of
from foveasim.twin.frame_sensors import PATTERNS
from foveasim.twin.frames.result import ADC_PARAMETERS

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Parameters of the electronics, which a preset, data sheet or twin replaces.
ELECTRONIC = PARAMETERS.union(*ALTERNATIVES, *(preset.parameters for preset in PRESETS.values()))
OF_TWIN = ELECTRONIC.union(PATTERNS, ADC_PARAMETERS)
#: Filters that a layout receives: a mosaic, or a colouring of the sites.
MOSAIC = ["RG", "GB"]
COLOURING = {"kind": "graph_colouring", "n_channels": 3}
#: Edits that assign filters to sites.
COLOURING_KINDS = ("graph_colouring", "mosaic", "random_channels")


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


def choose_electronics(settings: dict[str, Any]) -> None:
    """
    Replace the electronics by those of their origin, without earlier values.

    Origins are a preset, a data sheet or a twin. Files are read with the others of the settings, which are checked before. A
    quantum efficiency remains with a preset that has none.
    """
    sensor = settings.get("sensor")
    if isinstance(sensor, dict) and any(sensor.get(name) is not None for name in ELECTRONICS):
        replaced = ELECTRONIC if sensor.get("twin") is None else OF_TWIN
        others = {key: value for key, value in sensor.items() if key not in replaced}
        if others.get("preset") is not None:
            earlier = {name: value for name, value in sensor.items() if name == "qe"}
            others = {**earlier, **with_electronics(None, others)}
        settings["sensor"] = others


def with_picture(settings: Mapping[str, Any], start: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return settings whose scene is a picture; ``start``: initial settings."""
    found = copy.deepcopy(dict(settings))
    if found["scene"].get("kind") != "picture":
        control = next(control for control in controls_of(found, start) if control["key"] == "scene")
        found["scene"] = next(each["value"] for each in control["choices"] if each["label"] == "picture")
    found["scene"]["picture"] = path
    if found["scene"].get("fit") is None:
        put_setting(None, found, "scene.fit", "cover")  # pictures differ in their number of pixels
    return found


def with_file(settings: Mapping[str, Any], start: Mapping[str, Any], key: str, label: str, path: str) -> dict[str, Any]:
    """
    Return settings with a file: the alternative of a setting that has this label.

    Raises FileError when the alternative requires further parameters.
    """
    found = copy.deepcopy(dict(settings))
    choices = [one for control in controls_of(found, start) if control["key"] == key for one in control["choices"]]
    choice = next(one for one in choices if one["label"] == label)
    if choice.get("required"):
        names = " and ".join(choice["required"])
        raise FileError(Path(path), f"requires {names}; choose it in the list of the setting {key} ({label})")
    put_setting(None, found, key, {**choice["value"], choice.get("file", "path"): path})
    return found


def with_twin(settings: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return settings with the sensor of a twin, and the pixels of its camera."""
    found = with_layout(settings, {"file": path})
    found.get("sensor", {}).pop("filters", None)
    put_setting(None, found, "sensor.twin", path)
    choose_electronics(found)
    return found


@handles(OpenFile)
def _open_file(session: Session, message: OpenFile) -> dict[str, Any]:
    settings, path = session.history.settings, message.path
    use = message.use or use_of(Path(session.files.available(path)))
    match use:
        case "scene":
            return with_picture(settings, session.start.settings, session.reduced(path))
        case "layout":
            message.use = "layout"
            return with_layout(settings, session.files.layout_of(path))
        case "settings":
            return session.files.settings_of(path)
        case "twin":
            return with_twin(settings, path)
        case "gaze":
            return {**settings, "gaze_path": rows_of_file(path)}
    return with_file(settings, session.start.settings, *PLACES[use], path)


@handles(ResetValue)
@handles(DeleteValue)
def _reset(session: Session, message: ResetValue | DeleteValue) -> dict[str, Any]:
    settings, start = session.history.settings, session.start.settings if isinstance(message, ResetValue) else {}
    return balanced(reset(settings, start, message.key), message.key, settings, session.layout_source())
