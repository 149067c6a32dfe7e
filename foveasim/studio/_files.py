"""Files that settings from the page may contain, and the presets."""

from __future__ import annotations

import copy
import filecmp
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.names import DEVICES
from foveasim._io.yaml_files import read_yaml
from foveasim.config import (
    YAML_EXTENSIONS,
    Shot,
    bundled_layouts,
    demo_settings,
    put_setting,
    read_settings,
    resolve_files,
)
from foveasim.config._electronics import with_electronics
from foveasim.config._models import with_layout_of_twin
from foveasim.config._objects import BUNDLED_PICTURE, FILE_SETTINGS
from foveasim.errors import FileError, ParameterError, SimulationError, printable
from foveasim.scene import Scene
from foveasim.studio._messages.models import ApplyPreset, FitScene, RestoreSettings, handles

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Size of the image of a fitted scene, relative to the photosites: second-order integration needs a further cell.
MARGIN = 1.01
#: Longest name, in bytes of UTF-8, and extension of a stored file.
MAX_NAME_BYTES, MAX_EXTENSION_LENGTH = 120, 8
#: Characters that names of stored files do not contain: all but letters and digits of any script, "_" and "-".
UNSAFE = re.compile(r"[^\w-]+")


def start_settings(shot: str | Path | None, changes: Sequence[str] = ()) -> tuple[dict[str, Any], str]:
    """
    Return the settings of a file or the demo with absolute paths, and the name.

    ``changes``: "key=value". Raises ConfigError when the file cannot be read, or is not YAML.
    """
    path = demo_settings()[0] if shot is None else Path(shot)
    settings = with_values(with_layout_of_twin(read_settings(path, changes)), path)
    if isinstance(settings.get("layout"), str):
        settings["layout"] = _inlined(settings["layout"], path.parent)
    return resolve_files(path.parent.absolute(), settings), path.stem


def with_values(settings: dict[str, Any], path: str | Path) -> dict[str, Any]:
    """
    Return settings of a file with the values of the sensor's preset or data sheet.

    The controls show these. Raises ConfigError when the data sheet is invalid.
    """
    return {**settings, "sensor": with_electronics(path, settings["sensor"])} if "sensor" in settings else settings


def with_preset(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings with the values of the sensor's preset; files are not read."""
    sensor = settings.get("sensor")
    is_preset = isinstance(sensor, Mapping) and sensor.get("datasheet") is None
    return {**settings, "sensor": with_electronics(None, sensor)} if is_preset else settings


def preset_paths() -> dict[str, Path]:
    """Return the files of the bundled shots and layouts, by name."""
    shots = {f"shot:{path.stem}": path for path in demo_settings()}
    return {**shots, **{f"layout:{name}": path for name, path in bundled_layouts().items()}}


def presets() -> list[dict[str, str]]:
    """Return the names, labels and kinds of the bundled shots and layouts."""
    split = [(name, *name.split(":")) for name in preset_paths()]
    return [{"name": name, "label": stem.replace("_", " "), "kind": kind} for name, kind, stem in split]


def thumbnail_name(name: str) -> str:
    """Return the name of the picture of a preset."""
    return f"{name.replace(':', '_')}.webp"


def apply_preset(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the settings of a preset; a layout replaces that of the given settings.

    Raises ParameterError when the preset does not exist.
    """
    path = preset_paths().get(name)
    if path is None:
        raise ParameterError("name", "must be the name of a preset", printable(name))
    if name.startswith("shot:"):
        return start_settings(path)[0]
    return with_layout(without_gaze(settings), resolve_files(path.parent, read_yaml(path)))


def without_gaze(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with the sensor at the centre of the image."""
    found = copy.deepcopy(dict(settings))
    found.pop("gaze_um", None)
    found.get("scene", {}).pop("gaze_range_um", None)
    return found


def with_layout(settings: Mapping[str, Any], layout: Any) -> dict[str, Any]:
    """Return settings with another layout, which the picture covers."""
    found = copy.deepcopy(dict(settings))
    found["layout"] = copy.deepcopy(layout)
    if found.get("scene", {}).get("kind") == "picture":
        _cover(found)
    return found


def _cover(settings: dict[str, Any]) -> None:
    """Let the picture cover the layout at the present gaze."""
    put_setting(None, settings, "scene.fit", "cover")
    gaze_um = settings.get("gaze_um") or (0.0, 0.0)
    range_um = settings["scene"].get("gaze_range_um") or (0.0, 0.0)
    if settings.get("axis") != "sensor" and any(abs(g) > r for g, r in zip(gaze_um, range_um, strict=True)):
        settings["scene"]["gaze_range_um"] = [max(abs(g), r) for g, r in zip(gaze_um, range_um, strict=True)]


def with_covering_scene(settings: Mapping[str, Any], shot: Shot) -> dict[str, Any]:
    """
    Return settings in which the image covers all photosites at the present gaze.

    Pictures are framed; charts and other scenes have larger pixels. ``shot``: present shot of the settings. Raises
    SimulationError for power maps, which have a size of their own.
    """
    found = copy.deepcopy(dict(settings))
    if not isinstance(shot.scene, Scene):
        raise SimulationError("a power map has the size of its file; shrink or move the layout instead")
    if found["scene"].get("kind") == "picture":
        _cover(found)
        return found
    gaze_um = np.array(found.get("gaze_um") or (0.0, 0.0)) if found.get("axis") != "sensor" else np.zeros(2)
    bounds_um = np.array(shot.camera.layout.bounds_um).reshape(2, 2) + gaze_um
    image_um = np.array(shot.camera.image_grid(shot.scene).bounds_um).reshape(2, 2)
    factor = float((np.abs(bounds_um).max(axis=0) / np.abs(image_um).min(axis=0)).max())
    pitch_um = found["scene"].get("pitch_um")
    if pitch_um is None:
        raise SimulationError("the scene has no pitch_um that could be changed")
    found["scene"]["pitch_um"] = float(f"{pitch_um * max(1.0, MARGIN * factor):.6g}")
    return found


def _inlined(layout: str, directory: Path) -> Any:
    """Return the section of a layout that is given by its name or file."""
    path = directory / layout
    if not path.is_file() and layout in bundled_layouts():
        path = bundled_layouts()[layout]
    if path.suffix.lower() not in YAML_EXTENSIONS:
        return {"file": str(path)}
    return resolve_files(path.parent.absolute(), read_yaml(path))


class Files:
    """
    Files that the settings of a session may contain.

    These are pictures of scikit-image, uploaded files, files of the initial settings, and files in some directories.

    ``start``: the initial settings, with absolute paths. ``kept``: directories of the settings file and of saved files, or
    None. ``uploads``, ``variants``: directories of the uploaded files and of variants.
    """

    def __init__(self, start: Mapping[str, Any], kept: Sequence[Path | None], uploads: Path, variants: Path) -> None:
        named: list[Path] = []
        resolve_files(Path(), dict(start), found=named)
        self._named = {path.resolve() for path in named}
        #: Directories whose files remain after the session.
        self.kept_directories = list(dict.fromkeys(path.resolve() for path in kept if path is not None))
        self._directories = [uploads.resolve(), variants.resolve(), *self.kept_directories]
        self._uploads = uploads

    def allows(self, path: str | Path) -> bool:
        """Return whether settings may contain a file."""
        try:
            found = Path(path).resolve()
        except (OSError, ValueError, RuntimeError):
            return False
        if found in self._named:
            return True
        return found.parent in self._directories and not found.name.startswith(".")

    def check(self, settings: Any, key: str = "") -> None:
        """
        Check the files of settings.

        Raises FileError for a file that the settings may not contain.
        """
        if isinstance(settings, Mapping):
            for name, value in settings.items():
                self.check(value, f"{key}.{name}" if key else str(name))
        elif isinstance(settings, list):
            for value in settings:
                self.check(value, key)
        elif isinstance(settings, str) and key.rpartition(".")[2] in FILE_SETTINGS:
            if settings.startswith(BUNDLED_PICTURE) or (key == "layout" and settings in bundled_layouts()):
                return
            if not self.allows(settings):
                raise FileError(
                    None,
                    f"{key}: {printable(settings)[:100]!r} is not available here; upload the file, or use a picture of "
                    "scikit-image such as skimage:astronaut",
                )

    def with_uploads(self, settings: Any, key: str = "") -> Any:
        """Return settings with the paths of uploaded files for their names."""
        if isinstance(settings, dict):
            return {name: self.with_uploads(value, str(name)) for name, value in settings.items()}
        if isinstance(settings, list):
            return [self.with_uploads(value, key) for value in settings]
        if isinstance(settings, str) and key in FILE_SETTINGS and settings == file_name(settings):
            path = self._uploads / settings
            return str(path) if path.is_file() else settings
        return settings

    def resolve(self, settings: Any) -> Any:
        """Return settings with YAML layouts replaced by their content, after a check of all files."""
        self.check(settings)
        if isinstance(settings, dict) and isinstance(settings.get("layout"), str):
            settings = {**settings, "layout": _inlined(settings["layout"], Path())}
            self.check(settings)
        return settings

    def settings_of(self, path: str) -> dict[str, Any]:
        """
        Return the settings of a YAML file.

        Raises FileError when the file is not available, or not valid YAML.
        """
        self.available(path)
        settings: dict[str, Any] = resolve_files(Path(path).parent, with_layout_of_twin(read_settings(path)))
        self.check(settings.get("sensor"), "sensor")  # before its data sheet is read
        return with_values(settings, path)

    def layout_of(self, path: str) -> Any:
        """
        Return the section of a layout file.

        Raises FileError when the file is not available, or not valid YAML.
        """
        return _inlined(self.available(path), Path())

    def available(self, path: str) -> str:
        """
        Return the path of a file after a check that settings may contain it.

        Raises FileError when the file is not available.
        """
        if not self.allows(path):
            raise FileError(None, f"{printable(path)[:100]!r} is not available here; upload the file")
        return path


def file_name(name: str) -> str:
    """Return a safe name for an uploaded file, with its extension."""
    name = unicodedata.normalize("NFC", name)
    stem, dot, extension = Path(name.replace("\\", "/")).name.rpartition(".")
    stem, extension = (UNSAFE.sub("_", part).strip("_") for part in ((stem, extension) if dot else (extension, "")))
    extension = extension[:MAX_EXTENSION_LENGTH].lower()
    short = (stem or "file").encode()[:MAX_NAME_BYTES].decode(errors="ignore")
    short = f"{short}_" if DEVICES.fullmatch(short) else short
    return f"{short}.{extension}" if extension else short


def unused_path(path: Path, is_usable: Callable[[Path], bool]) -> Path:
    """Return a path, or with a number after its name the first one that is usable."""
    k, found = 1, path
    while not is_usable(found):
        k += 1
        found = path.with_name(f"{path.stem}_{k}{path.suffix}")
    return found


def is_unused_or_copy(path: Path, original: Path) -> bool:
    """Return whether a path is unused, or that of a file with the content of the original."""
    return not path.exists() or (path.is_file() and filecmp.cmp(original, path, shallow=False))


@handles(ApplyPreset)
def _apply_preset(session: Session, message: ApplyPreset) -> dict[str, Any]:
    return apply_preset(message.name, session.history.settings)


@handles(FitScene)
def _fit_scene(session: Session, _message: FitScene) -> dict[str, Any]:
    return with_covering_scene(session.history.settings, session.required_result("fit").shot)


@handles(RestoreSettings)
def _restore(session: Session, message: RestoreSettings) -> Any:
    return session.files.with_uploads(message.settings)
