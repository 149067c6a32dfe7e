"""Objects from settings files: layouts with their design rules, and shots."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from foveasim._core.names import possible_names
from foveasim._core.random_streams import Streams
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_choice
from foveasim._io.encodings import Encoding
from foveasim._io.images import read_picture
from foveasim._io.yaml_files import parse_yaml, read_yaml
from foveasim.camera import Camera
from foveasim.camera._exposure import exposure_time
from foveasim.capture import Capture
from foveasim.config._electronics import ELECTRONICS, read_twin_or_sites, sensor_maker
from foveasim.config._models import (
    FILE_OPTIONS,
    LayerSection,
    Models,
    PerArea,
    call_of,
    models,
    with_layout_of_twin,
)
from foveasim.config._problems import adapter_of, plain_settings, validate
from foveasim.config._requirements import Requirement
from foveasim.config._sources import Source
from foveasim.errors import ConfigError, FoveasimError, ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.layout import LAYOUTS, PRESETS, DesignRules, Layout, bundled_layouts, inset, mosaic, snap
from foveasim.layout.files import check_no_options, layout_path
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.scene._scene import FRAMINGS
from foveasim.sensor import Sensor
from foveasim.sensor.limits import ALTERNATIVES
from foveasim.video import DirectionPath, GazePath, read_gaze_path
from foveasim.video.frame_source import read_times

#: Prefix of the names of pictures that scikit-image contains.
BUNDLED_PICTURE = "skimage:"
#: Extensions of settings files; the format of other layout files follows from their content.
YAML_EXTENSIONS = (".yaml", ".yml")
#: Settings whose value may be a file.
FILE_SETTINGS = (
    "calibration",
    "datasheet",
    "density",
    "depth_m",
    "file",
    "gaze_path",
    "importance",
    "layers",
    "layout",
    "path",
    "picture",
    "times_s",
    "twin",
)
#: Settings of a section that replace each other.
REPLACED: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "scene": (FRAMINGS,),
    "sensor": (*ALTERNATIVES, ELECTRONICS),
}
#: Option of the command line that replaces settings.
CHANGE = "--set"
#: Keys of a layout that take effect at its edits or later: they do not change the generated photosites.
AFTER_EDITS = ("edits", "move_um", "inset_um", "snap_um", "rules", "source")
#: Tolerance of the aspect ratio of a picture and the rectangle that it covers.
SHAPE_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class LayoutFile:
    """
    A layout with the design rules and the source in its file.

    Attributes
    ----------
    layout : Layout
    rules : DesignRules or None
        Rules that the layout is designed for.
    source : str
        Source of its figures.
    """

    layout: Layout
    rules: DesignRules | None
    source: str

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Shot:
    """
    A camera, a scene and an exposure, as in a settings file.

    Attributes
    ----------
    name : str
        File name without extension.
    scene : Scene or PowerMap
        A scene with ``fit`` has no pitch; ``camera.fit_scene(scene)`` has one.
    camera : Camera
    rules : DesignRules or None
        Rules that the layout is designed for.
    requested_s : float or "auto", s
        Exposure time, as :meth:`foveasim.Camera.capture` accepts it.
    seed : int
    requirements : tuple of Requirement
        Conditions on results, which :func:`foveasim.explore.check_requirements` checks.
    gaze_source : GazePath, Path or None
        Gaze path of videos, or its CSV file.
    times_source_s : (n_frame,) float64 s, Path or None
        Times of the frames of a video, or their CSV file.
    frame_encoding : str or None
        Encoding of the scene's picture, if it is specified; frames of a video have it too.
    """

    name: str
    scene: Scene | PowerMap
    camera: Camera
    rules: DesignRules | None
    requested_s: float | Literal["auto"]
    seed: int
    requirements: tuple[Requirement, ...] = ()
    gaze_source: GazePath | Path | None = None
    times_source_s: Floats | Path | None = None
    frame_encoding: Encoding | None = None

    __repr__ = short_repr

    @cached_property
    def gaze_path(self) -> GazePath | DirectionPath | None:
        """Gaze path of videos; a CSV file is read when the path is first required."""
        return read_gaze_path(self.gaze_source) if isinstance(self.gaze_source, Path) else self.gaze_source

    @cached_property
    def times_s(self) -> Floats | None:
        """Times of the frames of a video; a CSV file is read when they are first required."""
        return read_times(self.times_source_s) if isinstance(self.times_source_s, Path) else self.times_source_s

    @cached_property
    def exposure_s(self) -> float:
        """Exposure time in seconds, also of an automatic exposure."""
        return self.camera.auto_exposure(self.scene) if self.requested_s == "auto" else self.requested_s

    def captured(self, capture: Capture) -> Shot:
        """Return the shot with the exposure time of its capture."""
        return replace(self, requested_s=capture.settings["exposure_s"]) if self.requested_s == "auto" else self


def read_shot(path: str | Path, changes: Sequence[str] = (), *, n_threads: int | None = None) -> Shot:
    """
    Read a settings file and return its shot.

    Parameters
    ----------
    path : path
        A YAML file. Paths in it are relative to its directory; ``skimage:NAME``, such as ``skimage:astronaut``, is a picture
        of scikit-image.
    changes : sequence of "key=value"
        Settings to replace, such as ``sensor.bits=10``, with values in YAML. Paths are relative to the working directory.
    n_threads : int, optional
        Number of threads of the camera.

    Raises
    ------
    ConfigError
        When a setting is invalid; with the file, the path of the key, and the expected and actual value.
    FileError
        When a picture of the file cannot be read.

    Examples
    --------
    >>> import foveasim as fs
    >>> path = fs.config.demo_settings()[0]
    >>> shot = fs.config.read_shot(path, ["optics.f_number=4", "exposure_s=0.002"])
    >>> shot.camera.optics.f_number, shot.camera.sensor.layout.n_sites, shot.requested_s
    (4.0, 9631, 0.002)
    """
    source = Source(file=Path(path), replaced={change.partition("=")[0].strip(): CHANGE for change in changes})
    return build_shot(source, read_settings(path, changes), n_threads=n_threads)


def read_settings(path: str | Path, changes: Sequence[str] = ()) -> dict[str, Any]:
    """
    Read a shot's settings file as plain data, with changes.

    Parameters
    ----------
    path, changes
        As for :func:`read_shot`.

    Raises
    ------
    ConfigError
        When the file is not valid YAML, or a change is not "key=value".

    Examples
    --------
    >>> import foveasim as fs
    >>> settings = fs.config.read_settings(fs.config.demo_settings()[0], ["sensor.bits=10"])
    >>> settings["optics"], settings["sensor"]["bits"]
    ({'focal_length_mm': 8.0, 'f_number': 2.8}, 10)
    """
    path = Path(path)
    data = read_yaml(path)
    for change in changes:
        _replace(path, data, change)
    return data


def check_settings(source: Source | str | Path | None, settings: Mapping[str, Any]) -> None:
    """
    Check names and types of a shot's settings.

    Parameters
    ----------
    source : Source, path or None
        Origin of the settings, for messages; None for settings from Python.
    settings : mapping
        As :func:`read_settings` returns them.

    Raises
    ------
    ConfigError
        When a setting is invalid.

    Examples
    --------
    >>> import foveasim as fs
    >>> settings = fs.config.read_settings(fs.config.demo_settings()[0])
    >>> fs.config.put_setting(None, settings, "exposure_s", "short")
    >>> try:
    ...     fs.config.check_settings(None, settings)
    ... except fs.errors.ConfigError as error:
    ...     print(error)
    exposure_s: must be a time in seconds, a fraction such as '1/50', 'auto', or a value such as 'EV 12', got "short"
    """
    validate(source, models().shot, with_layout_of_twin(settings))


def _make_uncached(_part: str, _settings: Any, make: Callable[[], Any]) -> Any:
    return make()


def build_shot(
    source: Source | str | Path | None,
    data: Mapping[str, Any],
    *,
    n_threads: int | None = None,
    cache: Callable[[str, Any, Callable[[], Any]], Any] = _make_uncached,
) -> Shot:
    """
    Return the shot of settings.

    Parameters
    ----------
    source : Source, path or None
        File of the settings; paths in them are relative to its directory. None for settings from Python, whose paths are
        relative to the working directory.
    data : mapping
        As :func:`read_settings` returns them.
    n_threads : int, optional
        Number of threads of the camera.
    cache : callable, optional
        A cache: ``cache(part, settings, make)`` returns ``make()``, or an earlier result for equal settings of the part.

    Raises
    ------
    ConfigError, FileError
        As for :func:`read_shot`.

    Examples
    --------
    >>> import foveasim as fs
    >>> settings = {
    ...     "scene": {
    ...         "kind": "flat",
    ...         "shape": [60, 60],
    ...         "pitch_um": 300.0,
    ...         "distance_m": 1.0,
    ...         "illuminance_lux": 500.0,
    ...     },
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {
    ...         "generator": "grid",
    ...         "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0},
    ...     },
    ...     "exposure_s": "auto",
    ... }
    >>> shot = fs.config.build_shot(None, settings)
    >>> shot.camera.capture(
    ...     shot.scene, exposure_s=shot.requested_s, seed=shot.seed
    ... ).code.shape
    (256,)
    """
    source = Source.of(source)
    data = with_layout_of_twin(plain_settings(source, data))
    settings = validate(source, models().shot, data)
    make = sensor_maker(source, settings.sensor, cache)  # before the layout, which may be that of a twin

    def layout_file() -> LayoutFile:
        if not isinstance(settings.layout, str):
            return _build_layout(source, "layout.", settings.layout, data["layout"], cache)
        read: LayoutFile = _call(
            source, "layout", read_any_layout, {"path": settings.layout, "directory": source.directory}
        )
        return read

    def sensor_of_layout() -> Sensor:
        section = settings.sensor
        arguments: dict[str, Any] = {
            name: value.per_um2 * layout.area_um2 if isinstance(value, PerArea) else value
            for name, value in _values(source, "sensor.", section).items()
            if name not in ELECTRONICS and (make is Sensor or name in section.model_fields_set)
        }
        sensor: Sensor = _call(source, "sensor", make, {"layout": layout, **arguments})
        return sensor

    file = cache("layout", data["layout"], layout_file)
    layout = file.layout
    sensor = cache("sensor", [data["layout"], data.get("sensor")], sensor_of_layout)
    optics = cache(
        "optics", data["optics"], lambda: _call(source, "optics", Optics, _values(source, "optics.", settings.optics))
    )
    distortion = cache("distortion", data.get("distortion"), lambda: _build(source, "distortion", settings.distortion))
    scene = cache("scene", data["scene"], lambda: _build(source, "scene", settings.scene))
    # Errors of a capture are raised here, before it starts, with the path of the key.
    _call(source, "scene", sensor.responsivity_e_per_j, {"wavelength_nm": scene.wavelength_nm})
    streams = _call(source, "", Streams, {"seed": settings.seed})
    exposure_s = _call(
        source, "", exposure_time, {"exposure_s": settings.exposure_s, "f_number": optics.f_number}
    )  # fmt: skip
    order = settings.integration_order
    camera = cache(
        "camera",
        [data["layout"], data.get("distortion"), order],
        lambda: Camera(optics=optics, sensor=sensor, distortion=distortion, order=order, n_threads=n_threads),
    )
    # Other optics and electronics share the compiled layout.
    camera = _call(
        source, "", camera.replace,
        {"optics": optics, "sensor": sensor, "gaze_um": settings.gaze_um, "gaze_deg": settings.gaze_deg,
         "axis": settings.axis},
    )  # fmt: skip
    if isinstance(scene, Scene):
        framed = _call(source, "scene", camera.light_at_gaze, {"light": scene})
        _call(source, "scene", optics.grid, {"scene": framed})
        _call(source, "optics", optics.check, {"scene": framed})
    return Shot(
        name=source.name,
        scene=scene,
        camera=camera,
        rules=file.rules,
        requested_s=exposure_s,
        seed=streams.seed,
        requirements=tuple(_build(source, "requirements", settings.requirements or [])),
        gaze_source=_gaze_source(source, settings.gaze_path),
        times_source_s=_times_source(source, settings.times_s),
        frame_encoding=getattr(settings.scene, "encoding", None)
        if "encoding" in settings.scene.model_fields_set
        else None,
    )


def _gaze_source(source: Source, rows: list[list[float]] | str | None) -> GazePath | Path | None:
    """Return the gaze path of checked settings, or its file."""
    if isinstance(rows, str):
        return source.directory / rows
    return None if rows is None else GazePath.from_rows(rows)


def _times_source(source: Source, times_s: list[float] | str | None) -> Floats | Path | None:
    """Return the times of checked settings, or their file."""
    if isinstance(times_s, str):
        return source.directory / times_s
    return None if times_s is None else np.array(times_s, np.float64)


def read_layout_file(path: str | Path) -> LayoutFile:
    """
    Read a YAML file with a layout: generator, parameters, colour filters, rules, source.

    Raises
    ------
    ConfigError
        When the file is invalid; with the file, the path of the key, and the expected and actual value.

    Examples
    --------
    >>> import foveasim as fs
    >>> path = fs.config.bundled_layouts()["prima_100"]
    >>> found = fs.config.read_layout_file(path)
    >>> found.layout.n_sites, found.layout.provenance["generator"]
    (378, 'hexagonal')
    """
    source = Source.of(path)
    return _build_layout(source, "", validate(source, models().layout, read_yaml(Path(path))))


def read_layout(path: str | Path, **options: Any) -> Layout:
    """
    Read a layout from a file of any format, or a bundled layout by its name.

    Parameters
    ----------
    path : path or str
        A GDSII, OASIS, GeoJSON, GeoParquet or npz file, recognised by its content; the twin of a camera, whose pixels are
        the photosites; a YAML file of a generator and its parameters; or a name, such as ``"giotto_2"``. A file of that name
        in the working directory comes first, as on the command line.
    **options
        Options of the format, as for :func:`foveasim.layout.read_layout`: for GDSII and OASIS ``layer=`` of the photosites,
        ``cell=``, and ``channels=`` or ``layers=`` for the colour filters.

    Returns
    -------
    Layout
        Without the design rules and the source of a YAML file: :func:`foveasim.config.read_any_layout` returns these too.

    Raises
    ------
    FileError
        When neither a file nor a bundled layout has this name, or the file is corrupt, too large, or not a layout.
    ParameterError
        When the format of the file does not have an option.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.read_layout("prima_100").n_sites
    378
    """
    return read_any_layout(path, **options).layout


def read_any_layout(
    path: str | Path, *, directory: str | Path = ".", centre: bool | None = None, **options: Any
) -> LayoutFile:
    """
    Read a layout with its design rules from a file, or a bundled one by its name.

    Parameters
    ----------
    path : path or str
        A file takes precedence over a bundled layout of the same name.
    directory : path
        Directory of relative paths; the working directory by default.
    centre : bool, optional
        Whether to move the centre of the layout's bounding box to the origin.
    **options
        Options of the format, as for :func:`foveasim.layout.read_layout`.

    Raises
    ------
    FileError
        When neither a file nor a bundled layout has this name, or it cannot be read.
    ParameterError
        When the format of the file does not have an option.

    Examples
    --------
    >>> import foveasim as fs
    >>> found = fs.config.read_any_layout("prima_100")
    >>> found.layout.n_sites, found.rules.min_width_um
    (378, 84.9)
    """
    path = layout_path(path, directory)
    if path.suffix.lower() in YAML_EXTENSIONS:
        check_no_options(**options)
        found = read_layout_file(path)
        return replace(found, layout=found.layout.centre()) if centre else found
    options |= {"centre": centre}
    return LayoutFile(layout=read_twin_or_sites(path, **options), rules=None, source=str(path))


def read_rules(path: str | Path) -> DesignRules:
    """
    Read design rules from a YAML file of limits and waivers, or a preset by its name.

    Raises
    ------
    ConfigError
        When the file is invalid; with the file, the path of the key, and the expected and actual value.

    Examples
    --------
    A bundled preset, and a file:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> fs.config.read_rules("sky130_diff").limits()
    {'min_width_um': 0.15, 'min_space_um': 0.27, 'edge_angle_step_deg': 90.0, 'grid_um': 0.005}
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "rules.yaml")
    ...     _ = path.write_text("min_size_um: 4.0")
    ...     print(fs.config.read_rules(path))
    DesignRules(min_size_um=4.0)
    """
    path = Path(path)
    if not path.exists() and not path.suffix and path.name == str(path):
        if str(path) in PRESETS:
            return DesignRules(preset=str(path))
        hint = possible_names(path, list(PRESETS))
        raise ConfigError(path, f"no such file, and not the name of a preset; {hint}")
    source = Source.of(path)
    rules: DesignRules = _build(source, "", validate(source, models().rules, read_yaml(path)))
    return rules


def schema(section: Any = "shot", title: str = "foveasim settings") -> dict[str, Any]:
    """
    Return the JSON schema of a ``"shot"``, a ``"layout"`` or ``"rules"``, or of a model.

    Examples
    --------
    >>> import foveasim as fs
    >>> list(fs.config.schema()["properties"])[:6]
    ['scene', 'optics', 'distortion', 'layout', 'sensor', 'exposure_s']
    """
    model = getattr(models(), check_choice("section", section, Models._fields)) if isinstance(section, str) else section
    model_schema = adapter_of("section", model).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **model_schema, "title": title}


def _generate(source: Source, prefix: str, section: Any) -> Layout:
    """Return the layout of a generator and its parameters."""
    parameters = prefix + "parameters"
    values = _values(source, parameters + ".", section.parameters)
    picture = getattr(LAYOUTS[section.generator], "picture", None)
    if picture is not None and values[picture] is not None:
        values |= _picture_values(source, f"{parameters}.{picture}", values)
    layout: Layout = _call(source, parameters, _callable(section.parameters), values)
    return layout


def _read_sites(source: Source, prefix: str, section: Any) -> Layout:
    """Return the layout of a file, with options of its format."""
    file = source.directory / section.file
    if file.suffix.lower() in YAML_EXTENSIONS:
        raise source.error(
            prefix + "file", f"must not be a YAML file, got '{section.file}'; specify it as layout: {section.file}"
        )
    options = {name: getattr(section, name) for name in FILE_OPTIONS}
    if isinstance(options["layers"], str):
        options["layers"] = source.directory / options["layers"]
    layout: Layout = _call(source, prefix.rstrip("."), read_twin_or_sites, {"path": file, **options})
    return layout


def _build_layout(
    source: Source,
    prefix: str,
    section: Any,
    data: Mapping[str, Any] | None = None,
    cache: Callable[[str, Any, Callable[[], Any]], Any] = _make_uncached,
) -> LayoutFile:
    """Return the layout of a section; with its plain data, layouts between edits are cached."""
    rules = None
    if getattr(section, "rules", None) is not None:
        rules = _build(source, prefix + "rules", section.rules)
    edits = getattr(section, "edits", [])
    if data is None:
        cache = _make_uncached
    unedited = {name: value for name, value in (data or {}).items() if name not in AFTER_EDITS}

    def generated() -> Layout:
        layout = (_generate if hasattr(section, "generator") else _read_sites)(source, prefix, section)
        if section.mosaic is not None:
            layout = _call(source, prefix + "mosaic", mosaic, {"layout": layout, "block": section.mosaic})
        return layout

    def edited(layout: Layout, start: int, stop: int) -> Layout:
        for i in range(start, stop):
            layout = _edit(source, f"{prefix}edits[{i}]", edits[i], layout, rules)
        return layout

    # Three layouts are cached: as generated, before the last edit, and after it. Users mostly change the last edit.
    n = len(edits)
    plain = data or {}

    def cached_generated() -> Layout:
        return cache("generated layout", unedited, generated)

    def cached_edited(n_edits: int, make: Callable[[], Layout]) -> Layout:
        return cache("edited layout", [unedited, plain.get("edits", [])[:n_edits], plain.get("rules")], make)

    def after_last_edit() -> Layout:
        before = cached_edited(n - 1, lambda: edited(cached_generated(), 0, n - 1)) if n > 1 else cached_generated()
        return edited(before, n - 1, n)

    layout = cached_edited(n, after_last_edit) if n else cached_generated()
    if any(section.move_um):
        layout = _call(
            source, prefix + "move_um", layout.translate, dict(zip(("dx_um", "dy_um"), section.move_um, strict=True))
        )
    if section.inset_um:
        layout = _call(source, prefix + "inset_um", inset, {"layout": layout, "margin_um": section.inset_um})
    if section.snap_um is not None:
        layout = _call(source, prefix + "snap_um", snap, {"layout": layout, "grid_um": section.snap_um})
    return LayoutFile(layout=layout, rules=rules, source=section.source)


def _edit(source: Source, key_path: str, section: Any, layout: Layout, rules: DesignRules | None) -> Layout:
    """Return a layout after an edit; an edit without rules uses those of the layout."""
    call = _callable(section)
    values = _values(source, key_path + ".", section)
    if "rules" in values and values["rules"] is None:
        values["rules"] = rules
    edited: Layout = _call(source, key_path, functools.partial(call, layout), values)
    if edited.n_sites == 0:
        raise source.error(key_path, "must leave at least one photosite")
    return edited


def _picture_values(source: Source, key_path: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a picture's grey values, 0 to 1, and for a density their grid."""
    name = key_path.rpartition(".")[2]
    picture = read_picture(picture_path(source, values[name], key_path))
    scale = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1.0
    n_colours = {2: 1, 4: 3}.get(picture.shape[2], picture.shape[2]) if picture.ndim == 3 else 1
    grey = picture.reshape(*picture.shape[:2], -1)[::-1, :, :n_colours].mean(axis=2, dtype=np.float64) / scale
    if name != "density":
        return {name: grey}
    if values["size_um"] is None:
        raise source.error(key_path, "requires 'size_um', the rectangle that the picture covers")
    (width_um, height_um), (n_y, n_x) = values["size_um"], grey.shape
    if abs(width_um * n_y - height_um * n_x) > SHAPE_ROUNDING * abs(width_um * n_y):
        raise source.error(
            key_path,
            f"must have the aspect ratio of 'size_um', {width_um:g} x {height_um:g} µm, got {n_x} x {n_y} pixels",
        )
    grid = _call(source, key_path, Grid.centred, {"shape": grey.shape, "pitch_um": width_um / n_x})
    return {name: grey, "density_grid": grid}


def _values(source: Source, prefix: str, section: BaseModel) -> dict[str, Any]:
    """Return a section's values as arguments of its call, with nested sections built."""
    return {
        name: _build(source, prefix + name, getattr(section, name))
        for name in type(section).model_fields
        if name not in {"kind", "generator"}
    }


def _build(source: Source, key_path: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_build(source, f"{key_path}[{i}]", item) for i, item in enumerate(value)]
    if isinstance(value, str) and key_path.rpartition(".")[2] in {"path", "picture", "depth_m", "calibration"}:
        return picture_path(source, value, key_path)
    if not isinstance(value, BaseModel) or isinstance(value, PerArea):
        return value
    if isinstance(value, LayerSection):
        return _build_layout(source, key_path + ".", value).layout
    return _call(source, key_path, _callable(value), _values(source, key_path + ".", value))


def _callable(section: BaseModel) -> Callable[..., Any]:
    call = call_of(section)
    assert call is not None
    return call


def _call(source: Source, key_path: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Call a function; errors begin with the path of the key."""
    try:
        return function(**arguments)
    except ParameterError as error:
        full_path = f"{key_path}.{error.name}" if key_path else error.name
        raise source.error(full_path, error.detail) from None
    except FoveasimError as error:
        raise source.error(key_path, str(error)) from None


def picture_path(source: Source, picture: str, key_path: str) -> Path:
    """
    Return the file of a picture in a settings file.

    Parameters
    ----------
    source : Source
        Origin of the setting.
    picture : str
        A file, or a picture of scikit-image such as ``skimage:astronaut``.
    key_path : str
        Path of the key in the settings file, for messages.

    Raises
    ------
    ConfigError
        When scikit-image does not contain the picture.
    """
    if not picture.startswith(BUNDLED_PICTURE):
        return source.directory / picture
    name = picture.removeprefix(BUNDLED_PICTURE)
    bundled = {
        Path(str(f)).stem: Path(str(f)) for f in files("skimage.data").iterdir() if f.name.endswith((".png", ".jpg"))
    }
    if name not in bundled:
        raise source.error(key_path, f"scikit-image does not contain '{name}'; {possible_names(name, sorted(bundled))}")
    return bundled[name]


def _replace(path: Path, data: dict[str, Any], change: str) -> None:
    """Replace one setting by a "key=value"."""
    key, equals, value = change.partition("=")
    if not equals or not all(key.strip().split(".")):
        raise ConfigError(path, f"a change must be 'key=value', such as sensor.bits=10, got '{change}'")
    try:
        parsed = parse_yaml(path, value)
    except ConfigError as error:
        raise ConfigError(path, f"{CHANGE} {key.strip()}: {error.detail}") from None
    put_setting(path, data, key.strip(), resolve_files(Path(), parsed, key.strip()))


def get_setting(settings: Mapping[str, Any], key: str) -> Any:
    """
    Return a value by its path, such as ``"sensor.bits"``; None if it is missing.

    Examples
    --------
    >>> import foveasim as fs
    >>> settings = fs.config.read_settings(fs.config.demo_settings()[0])
    >>> fs.config.get_setting(settings, "optics.focal_length_mm")
    8.0
    """
    found: Any = settings
    for name in key.split("."):
        if isinstance(found, list) and name.isdecimal() and int(name) < len(found):
            found = found[int(name)]
        elif isinstance(found, Mapping) and name in found:
            found = found[name]
        else:
            return None
    return found


def put_setting(source: Source | str | Path | None, data: dict[str, Any], key: str, value: Any) -> None:
    """
    Set a value by its path, such as ``"sensor.bits"``, in place.

    It replaces alternatives: a pixel pitch of the scene replaces its ``fit`` and field of view, a system gain of the sensor
    its capacitance.

    Raises
    ------
    ConfigError
        When a part of the path is empty, or not a section.

    Examples
    --------
    >>> import foveasim as fs
    >>> settings = fs.config.read_settings(fs.config.demo_settings()[0])
    >>> fs.config.put_setting(None, settings, "optics.f_number", 4.0)
    >>> settings["optics"]
    {'focal_length_mm': 8.0, 'f_number': 4.0}
    """
    names = key.split(".")
    if not all(names):
        raise ConfigError(Source.of(source).file, f"'{key}' must be the path of a setting, such as sensor.bits")
    section: Any = data
    step: Any = names[0]
    for i, name in enumerate(names):
        step = name
        if isinstance(section, list):
            if not name.isdecimal() or int(name) >= len(section):
                raise ConfigError(
                    Source.of(source).file,
                    f"'{key}={value}' cannot be set: {'.'.join(names[:i])} is a list of {len(section)} items, and the next "
                    f"part of the path must be the index of one of them, from 0",
                )
            step = int(name)
        elif not isinstance(section, dict):
            example = f", such as {{file: {section}}}" if names[:i] == ["layout"] and isinstance(section, str) else ""
            raise ConfigError(
                Source.of(source).file,
                f"'{key}={value}' cannot be set: {'.'.join(names[:i])} must be a section{example}, got {section!r}",
            )
        elif i < len(names) - 1:
            section.setdefault(name, {})
        if i < len(names) - 1:
            section = section[step]
    section[step] = value
    for group in REPLACED.get(".".join(names[:-1]), ()):
        if step in group and value is not None:
            for name in group:
                if name != step:
                    section.pop(name, None)


def resolve_files(directory: Path, value: Any, key: str = "", found: list[Path] | None = None) -> Any:
    """
    Return settings with absolute paths of files.

    Parameters
    ----------
    directory : Path
        Directory of relative paths.
    value : plain data
    key : str
        Path of the value in the settings.
    found : list of Path, optional
        Output: the files are appended.
    """
    if isinstance(value, dict):
        return {name: resolve_files(directory, item, name, found) for name, item in value.items()}
    if isinstance(value, list):
        return [resolve_files(directory, item, key, found) for item in value]
    name = key.rpartition(".")[2]
    if name not in FILE_SETTINGS or not isinstance(value, str) or value.startswith(BUNDLED_PICTURE):
        return value
    if name == "layout" and value in bundled_layouts():
        return value
    file = (directory / value).absolute()
    if found is not None:
        found.append(file)
    return str(file)
