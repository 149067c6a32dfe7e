"""What settings files give: layouts with their rules, and whole shots."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, TypeAdapter

from foveasim._core.random_streams import Streams
from foveasim._core.validation import check_number
from foveasim._io.images import read_picture
from foveasim._io.yaml_files import parsed, read_yaml
from foveasim.camera import Camera
from foveasim.config._models import PerArea, call_of, models
from foveasim.config._problems import validated
from foveasim.errors import ConfigError, FoveasimError, ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.layout import LAYOUTS, PRESETS, DesignRules, Layout, inset, mosaic, shipped_layouts, snap
from foveasim.layout.files import check_no_options, layout_path
from foveasim.layout.files import read_layout as read_sites
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor import Sensor

__all__ = [
    "YAML_ENDINGS",
    "LayoutFile",
    "Shot",
    "build_shot",
    "check_settings",
    "files_from",
    "picture_path",
    "put_setting",
    "read_any_layout",
    "read_layout",
    "read_layout_file",
    "read_rules",
    "read_settings",
    "read_shot",
    "schema",
]

#: Pictures that come with scikit-image are named with this in front.
BUNDLED_PICTURE = "skimage:"
#: Endings of files that hold settings; a layout in any other file is told by its content.
YAML_ENDINGS = (".yaml", ".yml")
#: Settings whose value may be the name of a file.
FILE_SETTINGS = ("density", "importance", "layout", "path", "picture")
#: A picture's sides may have this relative difference from those of the rectangle that it covers.
SHAPE_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class LayoutFile:
    """
    A layout with what its file says about it.

    Attributes
    ----------
    layout : Layout
    rules : DesignRules or None
        Rules that the layout is meant to keep.
    source : str
        Where its figures come from.
    """

    layout: Layout
    rules: DesignRules | None
    source: str


@dataclass(frozen=True, kw_only=True)
class Shot:
    """
    A camera, a scene and an exposure: what a settings file describes.

    Attributes
    ----------
    name : str
        The file's name without its ending.
    scene : Scene or PowerMap
        What is captured.
    camera : Camera
    rules : DesignRules or None
        Rules that the sensor's layout is meant to keep.
    exposure_s : float, s
    seed : int
    """

    name: str
    scene: Scene | PowerMap
    camera: Camera
    rules: DesignRules | None
    exposure_s: float
    seed: int


def read_shot(path: str | Path, changes: Sequence[str] = (), *, n_threads: int | None = None) -> Shot:
    """
    Read a settings file and build what it describes.

    Parameters
    ----------
    path : path
        YAML. Pictures and layouts that it names are looked for beside it; ``skimage:astronaut`` and its like are the
        pictures that come with scikit-image.
    changes : sequence of "key=value"
        Settings to be replaced: ``sensor.bits=10``; the value is read as YAML. Files named here are looked for in the
        current folder.
    n_threads : int, optional
        For the camera.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    FileError
        When a picture that the file names cannot be read.
    """
    return build_shot(path, read_settings(path, changes), n_threads=n_threads)


def read_settings(path: str | Path, changes: Sequence[str] = ()) -> dict[str, Any]:
    """
    What a shot's settings file says, as plain data, with changes.

    Parameters
    ----------
    path, changes
        As for :func:`read_shot`.

    Raises
    ------
    ConfigError
        When it is no YAML, or a change is none.
    """
    path = Path(path)
    data = read_yaml(path)
    for change in changes:
        _replace(path, data, change)
    return data


def check_settings(path: str | Path, settings: Mapping[str, Any]) -> None:
    """
    Names and types of a shot's settings, before anything is built.

    Parameters
    ----------
    path : path
        Of the file that the settings are from, for messages.
    settings : mapping
        As :func:`read_settings` gives them.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    """
    validated(Path(path), models().shot, dict(settings))


def _made_anew(_part: str, _settings: Any, make: Callable[[], Any]) -> Any:
    return make()


def build_shot(
    path: str | Path,
    data: Mapping[str, Any],
    *,
    n_threads: int | None = None,
    kept: Callable[[str, Any, Callable[[], Any]], Any] = _made_anew,
) -> Shot:
    """
    Build the shot that settings describe.

    Parameters
    ----------
    path : path
        Of the file that they are from: pictures and layouts that they name are looked for beside it.
    data : mapping
        As :func:`read_settings` gives them.
    n_threads : int, optional
        For the camera.
    kept : callable, optional
        ``kept(part, settings, make)`` gives what ``make()`` makes of a part's settings, or what it made of the same before.

    Raises
    ------
    ConfigError, FileError
        As for :func:`read_shot`.
    """
    path = Path(path)
    settings = validated(path, models().shot, dict(data))

    def layout_file() -> LayoutFile:
        if not isinstance(settings.layout, str):
            return _built_layout(path, "layout.", settings.layout)
        read: LayoutFile = _call(path, "layout", read_any_layout, {"path": settings.layout, "folder": path.parent})
        return read

    def sensor_of_layout() -> Sensor:
        values = {
            name: value.per_um2 * layout.area_um2 if isinstance(value, PerArea) else value
            for name, value in _values(path, "sensor.", settings.sensor).items()
        }
        made: Sensor = _call(path, "sensor", Sensor, {"layout": layout, **values})
        return made

    file = kept("layout", data["layout"], layout_file)
    layout = file.layout
    sensor = kept("sensor", [data["layout"], data.get("sensor")], sensor_of_layout)
    optics = kept(
        "optics", data["optics"], lambda: _call(path, "optics", Optics, _values(path, "optics.", settings.optics))
    )
    distortion = kept("distortion", data.get("distortion"), lambda: _built(path, "distortion", settings.distortion))
    scene = kept("scene", data["scene"], lambda: _built(path, "scene", settings.scene))
    # What would end the capture is told before it begins, with its place in the file.
    if isinstance(scene, Scene):
        _call(path, "scene", optics.grid, {"scene": scene})
        _call(path, "optics", optics.check, {"scene": scene})
    _call(path, "scene", sensor.responsivity_e_per_j, {"wavelength_nm": scene.wavelength_nm})
    streams = _call(path, "", Streams, {"seed": settings.seed})
    exposure_s = _call(path, "", check_number, {"name": "exposure_s", "value": settings.exposure_s, "at_least": 0.0})
    order = settings.integration_order
    camera = kept(
        "camera",
        [data["layout"], data.get("distortion"), order],
        lambda: Camera(optics=optics, sensor=sensor, distortion=distortion, order=order, n_threads=n_threads),
    )
    return Shot(
        name=path.stem,
        scene=scene,
        # Another lens, or other electronics, look through the layout that was compiled for the first.
        camera=camera.replace(optics=optics, sensor=sensor),
        rules=file.rules,
        exposure_s=exposure_s,
        seed=streams.seed,
    )


def read_layout_file(path: str | Path) -> LayoutFile:
    """
    Read a YAML file with a layout: generator, parameters, colour filters, rules, source.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    """
    path = Path(path)
    return _built_layout(path, "", validated(path, models().layout, read_yaml(path)))


def read_layout(path: str | Path, *, layer: int | None = None, cell: str | None = None, **options: Any) -> Layout:
    """
    Read a layout from a file of any format, or by the name of a layout that comes with the package.

    Parameters
    ----------
    path : path or str
        A GDSII, OASIS, GeoJSON, GeoParquet or npz file, recognised by its content; a YAML file of a generator and its
        parameters; or a name, such as ``"giotto_2"``. A file of that name in the working directory comes first, as on
        the command line.
    layer : int, optional
        Of GDSII and OASIS: the layer that contains the photosites; needed where shapes lie on several.
    cell : str, optional
        Of GDSII and OASIS: the cell to read, with all cells below it; needed where there are several top cells.
    **options
        Of other formats in :data:`foveasim.layout.FORMATS`.

    Returns
    -------
    Layout
        Without the design rules and the source that a YAML file may state: :func:`foveasim.config.read_any_layout`
        returns these too.

    Raises
    ------
    FileError
        When there is neither such a file nor such a name, or the file is corrupt, truncated, too large, or not a layout.
    ParameterError
        When an option does not belong to the file's format.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.read_layout("prima_100").n_sites
    378
    """
    return read_any_layout(path, layer=layer, cell=cell, **options).layout


def read_any_layout(
    path: str | Path, *, folder: str | Path = ".", layer: int | None = None, cell: str | None = None, **options: Any
) -> LayoutFile:
    """
    Read a layout from a YAML file, from a file of any other format, or by the name of a layout that comes with the package.

    Parameters
    ----------
    path : path or str
        A file in the folder comes before a bundled layout of the same name.
    folder : path
        Where the path begins; the working directory by default.
    layer, cell : optional
        Of GDSII and OASIS, as for :func:`foveasim.layout.read_layout`.

    Raises
    ------
    FileError
        When there is neither such a file nor such a name, or it cannot be read.
    ParameterError
        When an option does not belong to the file's format.
    """
    path = layout_path(path, folder)
    if path.suffix.lower() in YAML_ENDINGS:
        check_no_options(layer=layer, cell=cell, **options)
        return read_layout_file(path)
    return LayoutFile(layout=read_sites(path, layer=layer, cell=cell, **options), rules=None, source=str(path))


def read_rules(path: str | Path) -> DesignRules:
    """
    Read a YAML file of design rules (limits by their names, and waivers), or take a preset by its name.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    """
    path = Path(path)
    if str(path) in PRESETS and not path.exists():
        return DesignRules(preset=str(path))
    rules: DesignRules = _built(path, "", validated(path, models().rules, read_yaml(path)))
    return rules


def schema(section: Any = None, title: str = "foveasim settings") -> dict[str, Any]:
    """JSON schema of a settings file, or of a file whose model is given."""
    model_schema = TypeAdapter(models().shot if section is None else section).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **model_schema, "title": title}


def _built_layout(path: Path, place: str, section: Any) -> LayoutFile:
    parameters = place + "parameters"
    values = _values(path, parameters + ".", section.parameters)
    picture = getattr(LAYOUTS[section.generator], "picture", None)
    if picture is not None and values[picture] is not None:
        values |= _picture_values(path, f"{parameters}.{picture}", values)
    layout = _call(path, parameters, _callable(section.parameters), values)
    if section.mosaic is not None:
        layout = _call(path, place + "mosaic", mosaic, {"layout": layout, "block": section.mosaic})
    if any(section.move_um):
        layout = _call(
            path, place + "move_um", layout.translate, dict(zip(("dx_um", "dy_um"), section.move_um, strict=True))
        )
    if section.inset_um:
        layout = _call(path, place + "inset_um", inset, {"layout": layout, "margin_um": section.inset_um})
    if section.snap_um is not None:
        layout = _call(path, place + "snap_um", snap, {"layout": layout, "grid_um": section.snap_um})
    rules = None if section.rules is None else _built(path, place + "rules", section.rules)
    return LayoutFile(layout=layout, rules=rules, source=section.source)


def _picture_values(path: Path, place: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """A picture's values from 0 to 1, colours averaged, instead of its name; for a density also where its pixels are."""
    name = place.rpartition(".")[2]
    picture = read_picture(picture_path(path, values[name], place))
    scale = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1.0
    n_colours = {2: 1, 4: 3}.get(picture.shape[2], picture.shape[2]) if picture.ndim == 3 else 1
    grey = picture.reshape(*picture.shape[:2], -1)[::-1, :, :n_colours].mean(axis=2, dtype=np.float64) / scale
    if name != "density":
        return {name: grey}
    if values["size_um"] is None:
        raise ConfigError(path, f"{place}: needs 'size_um', the rectangle that the picture covers")
    (width_um, height_um), (n_y, n_x) = values["size_um"], grey.shape
    if abs(width_um * n_y - height_um * n_x) > SHAPE_ROUNDING * abs(width_um * n_y):
        raise ConfigError(
            path, f"{place}: has {n_x} x {n_y} pixels, which do not fit 'size_um' of {width_um:g} x {height_um:g} µm"
        )
    grid = _call(path, place, Grid.centred, {"shape": grey.shape, "pitch_um": width_um / n_x})
    return {name: grey, "density_grid": grid}


def _values(path: Path, place: str, section: BaseModel) -> dict[str, Any]:
    """A section's values as arguments of its call: sections inside it built, names of pictures as paths."""
    return {
        name: _built(path, place + name, getattr(section, name))
        for name in type(section).model_fields
        if name not in {"kind", "generator"}
    }


def _built(path: Path, place: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_built(path, f"{place}[{i}]", item) for i, item in enumerate(value)]
    if isinstance(value, str) and place.rpartition(".")[2] in {"path", "picture"}:
        return picture_path(path, value, place)
    if not isinstance(value, BaseModel) or isinstance(value, PerArea):
        return value
    return _call(path, place, _callable(value), _values(path, place + ".", value))


def _callable(section: BaseModel) -> Callable[..., Any]:
    call = call_of(section)
    assert call is not None
    return call


def _call(path: Path, place: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Call, with the place in the file put in front of what it raises."""
    try:
        return function(**arguments)
    except ParameterError as error:
        where = f"{place}.{error.name}" if place else error.name
        raise ConfigError(path, f"{where}: {error.detail}") from None
    except FoveasimError as error:
        raise ConfigError(path, f"{place}: {error}") from None


def picture_path(path: Path, picture: str, place: str) -> Path:
    """
    The file of a picture that a settings file names: one beside it, or one that comes with scikit-image.

    Parameters
    ----------
    path : Path
        Of the settings file.
    picture : str
        A file, or ``skimage:astronaut`` and its like.
    place : str
        Of the name in the settings file, for messages.

    Raises
    ------
    ConfigError
        When scikit-image brings no such picture.
    """
    if not picture.startswith(BUNDLED_PICTURE):
        return path.parent / picture
    name = picture.removeprefix(BUNDLED_PICTURE)
    bundled = {
        Path(str(f)).stem: Path(str(f)) for f in files("skimage.data").iterdir() if f.name.endswith((".png", ".jpg"))
    }
    if name not in bundled:
        raise ConfigError(path, f"{place}: scikit-image brings no picture '{name}', only {', '.join(sorted(bundled))}")
    return bundled[name]


def _replace(path: Path, data: dict[str, Any], change: str) -> None:
    """Replace one setting by a "key=value" of the command line."""
    key, equals, value = change.partition("=")
    if not equals or not all(key.strip().split(".")):
        raise ConfigError(path, f"a change must be 'key=value', such as sensor.bits=10, got '{change}'")
    put_setting(path, data, key.strip(), files_from(Path(), parsed(path, value), key.strip()))


def put_setting(path: str | Path, data: dict[str, Any], key: str, value: Any) -> None:
    """
    Put a value at a setting's place, such as ``"sensor.bits"``, in settings that are changed.

    Raises
    ------
    ConfigError
        When the key is empty in parts, or leads through a value that is no section.
    """
    names = key.split(".")
    if not all(names):
        raise ConfigError(path, f"'{key}' is no setting's place, such as sensor.bits")
    place: Any = data
    for i, name in enumerate(names[:-1]):
        place = place.setdefault(name, {})
        if not isinstance(place, dict):
            raise ConfigError(
                path, f"'{key}={value}' cannot be set: {'.'.join(names[: i + 1])} is no section but {place!r}"
            )
    place[names[-1]] = value


def files_from(folder: Path, value: Any, key: str = "", found: list[Path] | None = None) -> Any:
    """
    Settings with the files that they name made absolute.

    Parameters
    ----------
    folder : Path
        Where they are looked for.
    value : plain data
    key : str
        Place of the value in the settings.
    found : list of Path, optional
        The files are added to it.
    """
    if isinstance(value, dict):
        return {name: files_from(folder, item, name, found) for name, item in value.items()}
    if isinstance(value, list):
        return [files_from(folder, item, key, found) for item in value]
    name = key.rpartition(".")[2]
    if name not in FILE_SETTINGS or not isinstance(value, str) or value.startswith(BUNDLED_PICTURE):
        return value
    if name == "layout" and value in shipped_layouts():
        return value
    file = (folder / value).absolute()
    if found is not None:
        found.append(file)
    return str(file)
