"""
Settings files: YAML to the package's objects, and the JSON schema of what may stand in them.

Every section of a settings file is a call of a function or class of the package, and its keys are that call's
parameters: the file and the Python call have the same names, defaults and limits. pydantic reads the types off the
signatures, here and nowhere else in the package.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_type_hints

import yaml
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, create_model

from foveasim import layout as layouts
from foveasim.arrays import check_number
from foveasim.camera import Camera
from foveasim.errors import ConfigError, FoveasimError, ParameterError
from foveasim.layout import DesignRules, Layout, mosaic, read_layout
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor import ConstantCurve, FilterSet, GaussianCurve, PolynomialCurve, Sensor, SiliconQE
from foveasim.streams import Streams

__all__ = ["LayoutFile", "Shot", "read_any_layout", "read_layout_file", "read_rules", "read_shot", "schema"]

#: A settings file is written by hand; a longer one is something else.
MAX_FILE_BYTES = 1 << 20
#: Pictures that come with scikit-image are named with this in front.
BUNDLED_PICTURE = "skimage:"
#: Endings of files that hold settings; a layout in any other file is told by its content.
YAML_ENDINGS = (".yaml", ".yml")
#: Settings whose value may be the name of a file.
FILE_SETTINGS = ("scene.picture", "layout")
#: Problems of a file that one message names.
SHOWN_PROBLEMS = 3


# -- models: what may stand in a file --------------------------------------------------------------------------------


class _Section(BaseModel):
    """A section of a settings file: unknown keys and other types than stated are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, protected_namespaces=())


def _model(name: str, call: Callable[..., Any], skip: Sequence[str] = (), **types: Any) -> type[_Section]:
    """Section with the names, types and defaults of a call's parameters: some skipped, some of other types in files."""
    hints = get_type_hints(call)
    summary, sentences = _documentation(call)
    keys: dict[str, Any] = {
        p.name: (
            types.get(p.name, hints.get(p.name)),
            Field(... if p.default is inspect.Parameter.empty else p.default, description=sentences.get(p.name)),
        )
        for p in inspect.signature(call).parameters.values()
        if p.name not in skip
    }
    return create_model(name, __base__=_Section, __doc__=summary, **keys)


def _documentation(call: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """The first paragraph of a numpydoc docstring, and what it says of each parameter."""
    text = inspect.getdoc(call) or ""
    sentences: dict[str, str] = {}
    names: list[str] = []
    for line in text.partition("Parameters\n----------\n")[2].split("\n\n")[0].splitlines():
        if line.startswith("    "):
            sentences.update({name: f"{sentences.get(name, '')} {line.strip()}".strip() for name in names})
        else:
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
    return text.split("\n\n")[0].replace("\n", " "), sentences


def _one_of(tag: str, models: Mapping[str, type[_Section]]) -> Any:
    """Union of sections that are told apart by a key."""
    tagged = [create_model(f"{name} {tag}", __base__=m, **{tag: (Literal[name], ...)}) for name, m in models.items()]  # type: ignore[call-overload]
    return Annotated[Union[tuple(tagged)], Field(discriminator=tag)]  # noqa: UP007 -- a union of a list


class PerArea(_Section):
    """A per-site value in proportion to the site's area."""

    per_um2: float


_GENERATORS: dict[str, Callable[..., Layout]] = {
    "foveal_cartesian": layouts.foveal_cartesian,
    "fovi": layouts.fovi,
    "giotto": layouts.giotto,
    "grid": layouts.grid,
    "hexagonal": layouts.hexagonal,
    "log_polar": layouts.log_polar,
    "octagonal": layouts.octagonal,
    "penrose": layouts.penrose,
    "sunflower": layouts.sunflower,
    "zones": layouts.zones,
}
_SCENES: dict[str, Callable[..., Scene]] = {
    "picture": Scene.from_picture,
    "flat": Scene.flat,
    "point_sources": Scene.point_sources,
}
_CURVES: dict[str, Callable[..., Any]] = {
    "constant": ConstantCurve,
    "gaussian": GaussianCurve,
    "polynomial": PolynomialCurve,
    "silicon": SiliconQE,
}

_CurveSection = _one_of("kind", {name: _model(name, curve) for name, curve in _CURVES.items()})
_FilterSection = _model("filter set", FilterSet, curves=list[_CurveSection])  # type: ignore[valid-type]
_PerSite = float | PerArea | list[float]
_SceneSection = _one_of(
    "kind", {k: _model(k, call, picture=str, spectrum=list[list[float]] | None) for k, call in _SCENES.items()}
)
_SensorSection = _model(
    "sensor",
    Sensor,
    skip=("layout",),
    qe=float | _CurveSection,
    filters=Literal["rgb"] | _FilterSection | None,
    dark_e_per_s=_PerSite,
    full_well_e=_PerSite | None,
    read_noise_e=_PerSite,
    capacitance_f=_PerSite,
)
_RulesSection = _model("design rules", DesignRules)


class _LayoutSection(_Section):
    """A layout: a generator and its parameters, colour filters, a move, design rules, and its source."""

    mosaic: str | list[str] | None = None
    move_um: tuple[float, float] = (0.0, 0.0)
    rules: _RulesSection | None = None  # type: ignore[valid-type]
    source: str = ""


_LayoutUnion = _one_of(
    "generator",
    {
        name: create_model(name, __base__=_LayoutSection, parameters=(_model(f"{name} parameters", call), ...))
        for name, call in _GENERATORS.items()
    },
)


class _ShotSection(_Section):
    """A whole shot: scene, optics, layout, sensor, exposure."""

    scene: _SceneSection  # type: ignore[valid-type]
    optics: _model("optics", Optics)  # type: ignore[valid-type]
    layout: str | _LayoutUnion  # type: ignore[valid-type]
    sensor: _SensorSection = Field(default_factory=_SensorSection)  # type: ignore[valid-type]
    exposure_s: float
    seed: int = 0


# -- objects: what a file gives --------------------------------------------------------------------------------------


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
    scene : Scene
    camera : Camera
    rules : DesignRules or None
        Rules that the sensor's layout is meant to keep.
    exposure_s : float, s
    seed : int
    """

    name: str
    scene: Scene
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
    path = Path(path)
    data = _read_yaml(path)
    for change in changes:
        _replace(path, data, change)
    settings = _validated(path, _ShotSection, data)
    if isinstance(settings.layout, str):
        file = _call(path, "layout", read_any_layout, {"path": path.parent / settings.layout})
    else:
        file = _built_layout(path, "layout.", settings.layout)
    layout = file.layout
    sensor_values = {
        name: value.per_um2 * layout.area_um2 if isinstance(value, PerArea) else value
        for name, value in _values(path, "sensor.", settings.sensor).items()
    }
    sensor = _call(path, "sensor", Sensor, {"layout": layout, **sensor_values})
    optics = _call(path, "optics", Optics, _values(path, "optics.", settings.optics))
    scene_values = _values(path, "scene.", settings.scene)
    if "picture" in scene_values:
        scene_values["picture"] = _picture_path(path, scene_values["picture"])
    # A picture's own faults are told with its name.
    scene = _call(path, "scene", _SCENES[scene_values.pop("kind")], scene_values)
    # What would end the capture is told before it begins, with its place in the file.
    _call(path, "scene", optics.grid, {"scene": scene})
    _call(path, "scene", sensor.responsivity_e_per_j, {"wavelength_nm": scene.wavelength_nm})
    streams = _call(path, "", Streams, {"seed": settings.seed})
    exposure_s = _call(path, "", check_number, {"name": "exposure_s", "value": settings.exposure_s, "at_least": 0.0})
    return Shot(
        name=path.stem,
        scene=scene,
        camera=Camera(optics=optics, sensor=sensor, n_threads=n_threads),
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
    return _built_layout(path, "", _validated(path, _LayoutUnion, _read_yaml(path)))


def read_any_layout(path: str | Path) -> LayoutFile:
    """
    Read a layout from a YAML file or from a file of any other format.

    Raises
    ------
    FileError
        When it cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() in YAML_ENDINGS:
        return read_layout_file(path)
    return LayoutFile(layout=read_layout(path), rules=None, source=str(path))


def read_rules(path: str | Path) -> DesignRules:
    """
    Read a YAML file of design rules: limits by their names, and waivers.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    """
    path = Path(path)
    section = _validated(path, _RulesSection, _read_yaml(path))
    rules: DesignRules = _call(path, "", DesignRules, _values(path, "", section))
    return rules


def schema() -> dict[str, Any]:
    """JSON schema of a settings file."""
    described = TypeAdapter(_ShotSection).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **described, "title": "foveasim settings"}


def _built_layout(path: Path, place: str, section: Any) -> LayoutFile:
    values = _values(path, place + "parameters.", section.parameters)
    layout = _call(path, place + "parameters", _GENERATORS[section.generator], values)
    if section.mosaic is not None:
        layout = _call(path, place + "mosaic", mosaic, {"layout": layout, "block": section.mosaic})
    if any(section.move_um):
        layout = _call(
            path, place + "move_um", layout.translate, dict(zip(("dx_um", "dy_um"), section.move_um, strict=True))
        )
    rules = None
    if section.rules is not None:
        rules = _call(path, place + "rules", DesignRules, _values(path, place + "rules.", section.rules))
    return LayoutFile(layout=layout, rules=rules, source=section.source)


def _values(path: Path, place: str, section: BaseModel) -> dict[str, Any]:
    """A section's values as arguments of its call, sections inside it built."""
    return {name: _built(path, place + name, getattr(section, name)) for name in type(section).model_fields}


def _built(path: Path, place: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_built(path, f"{place}[{i}]", item) for i, item in enumerate(value)]
    if not isinstance(value, BaseModel) or isinstance(value, PerArea):
        return value
    arguments = _values(path, place + ".", value)
    return _call(path, place, _CURVES[arguments.pop("kind")] if "kind" in arguments else FilterSet, arguments)


def _call(path: Path, place: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Call, with the place in the file put in front of what it raises."""
    try:
        return function(**arguments)
    except ParameterError as error:
        where = f"{place}.{error.name}" if place else error.name
        rule = str(error).removeprefix(f"'{error.name}' ")
        raise ConfigError(path, f"{where}: {rule}") from None
    except FoveasimError as error:
        raise ConfigError(path, f"{place}: {error}") from None


def _picture_path(path: Path, picture: str) -> Path:
    if not picture.startswith(BUNDLED_PICTURE):
        return path.parent / picture
    name = picture.removeprefix(BUNDLED_PICTURE)
    bundled = {
        Path(str(f)).stem: Path(str(f)) for f in files("skimage.data").iterdir() if f.name.endswith((".png", ".jpg"))
    }
    if name not in bundled:
        raise ConfigError(
            path, f"scene.picture: scikit-image brings no picture '{name}', only {', '.join(sorted(bundled))}"
        )
    return bundled[name]


# -- YAML: with limits, and nothing evaluated ------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """YAML without tags, anchors and repeated keys, and with 1e-13 as a number."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise yaml.YAMLError(f"anchors and aliases are not allowed (line {event.start_mark.line + 1})")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, str):
                raise yaml.YAMLError(f"the key {key!r} must be a text (line {line})")
            if key in seen:
                raise yaml.YAMLError(f"the key '{key}' stands there twice (line {line})")
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(("timestamp", "float"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.\d*|\.\d+|\d+(?=[eE]))([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


def _parsed(path: Path, text: str) -> Any:
    try:
        return yaml.load(text, _Loader)  # noqa: S506 -- a SafeLoader
    except RecursionError:
        raise ConfigError(path, "is nested too deeply") from None
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        raise ConfigError(path, f"is not YAML{line}: {error.problem}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(path, f"is not YAML as settings need it: {error}") from None


def _read_yaml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ConfigError(path, "no such file" if not path.exists() else "is not a file")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ConfigError(path, f"is larger than {MAX_FILE_BYTES} bytes, and so no settings file")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise ConfigError(path, "is no text file in UTF-8") from None
    data = _parsed(path, text)
    if not isinstance(data, dict):
        raise ConfigError(
            path, f"must hold settings as 'key: value', got {'nothing' if data is None else repr(data)[:60]}"
        )
    return data


def _replace(path: Path, data: dict[str, Any], change: str) -> None:
    """Replace one setting by a "key=value" of the command line."""
    key, equals, value = change.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise ConfigError(path, f"a change must be 'key=value', such as sensor.bits=10, got '{change}'")
    place: Any = data
    for i, name in enumerate(names[:-1]):
        place = place.setdefault(name, {})
        if not isinstance(place, dict):
            raise ConfigError(path, f"'{change}' cannot be set: {'.'.join(names[: i + 1])} is no section but {place!r}")
    new = _parsed(path, value)
    if key.strip() in FILE_SETTINGS and isinstance(new, str) and not new.startswith(BUNDLED_PICTURE):
        new = str(Path(new).absolute())
    place[names[-1]] = new


def _validated(path: Path, kind: Any, data: dict[str, Any]) -> Any:
    try:
        return TypeAdapter(kind).validate_json(json.dumps(data, default=_refuse), strict=True)
    except ValidationError as error:
        problems = _problems(data, error)
        shown = "; ".join(problems[:SHOWN_PROBLEMS])
        more = len(problems) - SHOWN_PROBLEMS
        raise ConfigError(path, shown + (f"; and {more} more" if more > 0 else "")) from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(path, f"holds a value that cannot be read ({error})") from None


def _refuse(value: object) -> None:
    raise ValueError(f"a {type(value).__name__} is neither number, text, list nor section")


def _problems(data: dict[str, Any], error: ValidationError) -> list[str]:
    """Every problem once, as "place: what is wrong"."""
    found = [(_place(data, item), item) for item in error.errors(include_url=False)]
    # Where several types are allowed, pydantic tells what is wrong with each: the nearest one says what was meant.
    told = [
        f"{'.'.join(place) or 'the file'}{_sentence(item)}"
        for place, item in found
        if not (
            item["type"].endswith("_type")
            and any(
                other[: len(place)] == place and (len(other) > len(place) or not o["type"].endswith("_type"))
                for other, o in found
            )
        )
    ]
    return list(dict.fromkeys(told))


def _place(data: Any, error: Any) -> tuple[str, ...]:
    """Keys and positions that lead to a problem, without the names of alternatives that pydantic puts among them."""
    place = []
    tags = _tags(data)
    for i, part in enumerate(error["loc"]):
        if part in tags:  # the alternative that a section's key chose, which may be the name of another key
            tags = ()
        elif (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
            tags = _tags(data)
            place.append(str(part))
        elif i == len(error["loc"]) - 1 and error["type"] == "missing":
            place.append(str(part))
    return tuple(place)


def _tags(data: Any) -> tuple[Any, ...]:
    """What a section's key may have chosen among alternatives."""
    return (data.get("kind"), data.get("generator")) if isinstance(data, dict) else ()


def _sentence(error: Any) -> str:
    match error["type"]:
        case "extra_forbidden":
            return ": no such setting"
        case "missing":
            return ": is missing"
        case "union_tag_not_found":
            return f": needs the key {error['ctx']['discriminator']}"
        case "union_tag_invalid":
            key = error["ctx"]["discriminator"].strip("'")
            return f".{key}: must be one of {error['ctx']['expected_tags']}, got '{error['ctx']['tag']}'"
        case _:
            got = "" if isinstance(error["input"], dict | list) else f", got {json.dumps(error['input'])}"
            rule = re.sub(r"^\w+ should", "must", error["msg"]).replace(" after validation", "")
            return f": {rule}{got}"
