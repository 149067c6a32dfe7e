"""
Models of settings files.

Every section is a call of a function or class of the package, and its keys are the parameters of this call: file and Python
have the same names, defaults and limits. The pydantic models follow from the signatures.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Union, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, create_model

from foveasim._core.calls import NOT_NEGATIVE, Declaration, Usual
from foveasim._core.calls.docstrings import Docstring
from foveasim._core.registry import Registry
from foveasim._core.validation import unit_of
from foveasim.camera import GazeAxis
from foveasim.camera._exposure import exposure_time
from foveasim.config._requirements import Requirement
from foveasim.distortion import LENSES
from foveasim.errors import ParameterError
from foveasim.layout import EDITS, LAYOUTS, PRESETS, RULES, DesignRules, Readout, Routing, read_layout
from foveasim.layout.files import Invalid, LengthUnit, Parts
from foveasim.maps import read_power_map
from foveasim.modes.frame_times import check_times
from foveasim.optics import PUPILS, ChiefRayTable, IlluminationTable, LateralColour, Optics, Seidel, Zernike, read_psfs
from foveasim.scene import DISPLAYS, SCENES
from foveasim.sensor import (
    PIXEL_OPTICS,
    Diffusion,
    FilterSet,
    InterPixelCapacitance,
    KernelCrosstalk,
    ProductCurve,
    Sensor,
    read_filters,
)
from foveasim.sensor import PRESETS as SENSOR_PRESETS
from foveasim.sensor.effects import EFFECTS
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.spectral import CURVES
from foveasim.video import GazePath

__all__ = ["FILE_OPTIONS", "LayerSection", "Models", "PerArea", "Section", "call_of", "models"]

#: The function or class of each section.
_CALLS: dict[type[BaseModel], Callable[..., Any]] = {}
#: Registries whose members are sections: the models are rebuilt when one of these changes.
_REGISTRIES: tuple[Registry[Any], ...] = (
    LAYOUTS, EDITS, RULES, SCENES, DISPLAYS, LENSES, PUPILS, CURVES, EFFECTS, PIXEL_OPTICS,
)  # fmt: skip

_log = logging.getLogger("foveasim")


class Section(BaseModel):
    """Base of all sections: unknown keys and other types are errors."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", strict=True, protected_namespaces=())


def _model(name: str, call: Callable[..., Any], skip: Sequence[str] = (), **types: Any) -> type[Section]:
    """Return a model with the parameters of a call, with file types for some."""
    hints = get_type_hints(call, include_extras=True)
    documented = Docstring.of(call)
    descriptions = documented.parameters
    keys: dict[str, Any] = {
        p.name: (
            types.get(p.name, hints.get(p.name)),
            _field(p.name, p.default, descriptions.get(p.name), Declaration.of(hints.get(p.name))),
        )
        for p in inspect.signature(call).parameters.values()
        if p.name not in skip
    }
    model = create_model(name, __base__=Section, __doc__=documented.summary, **keys)
    _CALLS[model] = call
    return model


def _field(name: str, default: Any, description: str | None, declared: Declaration) -> Any:
    """Return a key with its unit and range, which the call checks: its messages have hints."""
    default = ... if default is inspect.Parameter.empty else default
    limits = declared.limits
    if limits is None and declared.usual is None and declared.words is None:
        return Field(default, description=description)
    rule = {} if limits is None else limits.schema
    words = "" if limits is None else f"{limits.range} {unit_of(name)}".strip()
    note = f"{words[:1].upper()}{words[1:]}{', also per site' * declared.is_per_site}." if words else ""
    extra: dict[str, Any] = {} if Sequence in declared.kinds else dict(rule)
    if declared.is_per_site or Sequence in declared.kinds:
        extra["items"] = {"type": "number", **rule}
    if declared.usual is not None:
        extra["usual"] = list(declared.usual)
    if declared.words is not None:
        extra["words"] = asdict(declared.words)
    return Field(default, description=f"{description or ''} {note}".strip(), json_schema_extra=extra)


def call_of(section: BaseModel | type[BaseModel]) -> Callable[..., Any] | None:
    """Return the call of a section or of its model; None if it only contains values."""
    model = section if isinstance(section, type) else type(section)
    return next((_CALLS[kind] for kind in model.__mro__ if kind in _CALLS), None)


def _union_of(tag: str, models: Mapping[str, type[Section]]) -> Any:
    """Return a union of sections with a discriminating key."""
    tagged = []
    for name, model in models.items():
        title = f"{model.__name__} {tag}"
        tagged.append(create_model(title, __base__=model, **{tag: (Literal[name], ...)}))  # type: ignore[call-overload]
    return Annotated[Union[tuple(tagged)], Field(discriminator=tag)]  # noqa: UP007 -- a union of a list


class PerArea(Section):
    """A value per site that is proportional to its area."""

    per_um2: float


class LayerSection(Section):
    """Base of the sections of layouts, and of layouts that are layers of another one."""


def _layout_or_twin(schema: dict[str, Any]) -> None:
    """Let the JSON schema of a shot require a layout, or the twin of a camera."""
    schema["required"].remove("layout")
    twin = {"properties": {"sensor": {"type": "object", "required": ["twin"]}}, "required": ["sensor"]}
    schema["anyOf"] = [{"required": ["layout"]}, twin]


class _ShotBase(Section):
    """Base of shots: the layout may be that of the sensor's twin."""

    model_config = ConfigDict(json_schema_extra=_layout_or_twin)


_Outline = Annotated[list[list[float]] | str, Field(description="vertices [x, y] in µm, or WKT")]
#: Parameters with other types in files than in Python.
_FILE_TYPES: dict[str, Any] = {
    "density": Annotated[str | None, Field(description="a picture, proportional to the density of sites")],
    "importance": Annotated[str, Field(description="a picture, bright where squares are small")],
    "outlines_um": list[_Outline] | None,
    "path": str,
    "picture": str,
    "points_um": list[tuple[float, float]],
    "region": _Outline | None,
    "spectrum": list[list[float]] | None,
}
_Numbers: Any = float | list[float] | None
#: Bands of scenes: one wavelength or several.
_WAVELENGTHS: dict[str, Any] = {"wavelength_nm": _Numbers, "band_width_nm": _Numbers}
#: Parameters of displays.
_DISPLAY_TYPES: dict[str, Any] = {
    "path": str,
    "wavelength_nm": list[float],
    "primaries": list[list[float]],
    "transfer": float | Literal["srgb"] | list[float] | list[list[float]],
    "cells": list[list[int]] | None,
}
_Point = tuple[float, float]
#: Files of a scene with depth.
_DEPTH: dict[str, Any] = {
    "depth_m": Annotated[str, Field(description="a file with the distance of each pixel")],
    "calibration": str | None,
}
#: Parameters of layout edits with other types in files than in Python.
_EDIT_TYPES: dict[str, Any] = {
    "by_um": _Point,
    "fractions": list[float],
    "from_um": list[_Point],
    "line_um": list[_Point],
    "margin_um": float,
    "outlines_um": list[_Outline],
    "points_um": list[_Point] | None,
    "region": _Outline | None,
    "to_um": list[_Point],
}
#: Options of layout files in settings, with their types: a layer is ``77`` or ``77/3``.
_Layer: Any = int | str
FILE_OPTIONS: dict[str, Any] = {
    "layer": _Layer | list[_Layer] | None,
    "cell": str | None,
    "layers": str | dict[str, _Layer | dict[str, _Layer | float]] | None,
    "channels": dict[str, int | str] | None,
    "filter_names": list[str] | None,
    "invalid": Invalid | None,
    "unit": LengthUnit | None,
    "parts": Parts | None,
    "duplicates": Literal["error", "rename"] | None,
    "missing": Literal["error", "skip"] | None,
    "circle_tolerance": float | None,
    "centre": bool | None,
}
#: Parameters of scenes from arrays.
_OF_ARRAYS = ("axis", "channels")
#: Parameters that files do not contain: a density picture covers the rectangle ``size_um``.
_EXCLUDED = ("density_grid",)
_CROSSTALK: dict[str, Callable[..., Any]] = {"diffusion": Diffusion, "kernel": KernelCrosstalk}
_PerSite = float | PerArea | list[float]
#: Parameters of effects with one value for all sites, or one for each.
_EFFECT_TYPES: dict[str, Any] = dict.fromkeys(("response_fraction", "offset_e", "step_e"), float | list[float])


def _check_exposure(value: float | str) -> float | str:
    """Check the text of an exposure time; the camera checks its range."""
    if isinstance(value, str):
        try:
            exposure_time(value, f_number=1.0)
        except ParameterError as error:
            raise ValueError(error.detail.partition(", got ")[0]) from None
    return value


def _check_gaze_path(rows: list[list[float]]) -> list[list[float]]:
    """Check the rows of a gaze path."""
    try:
        GazePath.from_rows(rows)
    except ParameterError as error:
        raise ValueError(error.detail) from None
    return rows


def _check_frame_times(times_s: list[float]) -> list[float]:
    """Check the times of the frames of a video."""
    try:
        check_times("times_s", times_s)
    except ParameterError as error:
        raise ValueError(error.detail) from None
    return times_s


_FrameTimes: Any = Annotated[list[float], AfterValidator(_check_frame_times)]
#: Rows of a gaze path, whose message names the row.
_GazeRow: Any = Annotated[list[float], Field(json_schema_extra={"minItems": 3, "maxItems": 3})]
_GazeRows: Any = Annotated[list[_GazeRow], AfterValidator(_check_gaze_path)]
#: Seconds, or a text that cameras accept.
_ExposureTime: Any = Annotated[float | str, AfterValidator(_check_exposure)]


class Models(NamedTuple):
    """Models of settings files: shot, layout and design rules."""

    shot: type[BaseModel]
    layout: Any
    rules: type[BaseModel]


def models() -> Models:
    """Return the models of settings files, with all registered extensions."""
    for registry in _REGISTRIES:
        len(registry)  # loads entry points
    return _models(tuple(registry.version for registry in _REGISTRIES))


def _registered_sections(
    registry: Registry[Any], skip: Sequence[str] = (), title: str = "{}", **types: Any
) -> dict[str, type[Section]]:
    """Return sections of registered calls; warn of types that files cannot contain."""
    sections = {}
    for name, call in registry.items():
        try:
            sections[name] = _model(title.format(name), call, skip=skip, **types)
        except Exception as error:  # noqa: BLE001 -- the signature is that of another package
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            _log.warning("the %s '%s' is not available in settings files (%s)", registry.kind, name, reason)
    return sections


@lru_cache(maxsize=1)
def _models(_versions: tuple[int, ...]) -> Models:
    lens = _union_of("kind", _registered_sections(LENSES))
    pupil = _union_of("kind", _registered_sections(PUPILS, skip=("wavefront_um",), **_FILE_TYPES))
    optics = _model(
        "optics",
        Optics,
        pupil=pupil | list[pupil] | None,  # type: ignore[valid-type]
        zernike=_model("zernike", Zernike) | None,
        seidel=_model("seidel", Seidel) | None,
        psfs=_model("PSFs", read_psfs, skip=("allow_outside",), **_FILE_TYPES) | None,
        relative_illumination=_model("relative illumination table", IlluminationTable) | None,
        lateral_colour=_model("lateral colour", LateralColour) | None,
        exit_pupil_mm=float | None,
        chief_ray=_model("chief ray table", ChiefRayTable) | None,
    )
    sensor = _sensor()
    rules = _rules()
    layout = _layout(rules)
    power_map = _model("power_map", read_power_map, **(_FILE_TYPES | _WAVELENGTHS))
    scenes = _registered_sections(
        SCENES, skip=_OF_ARRAYS, lens=lens | None, **(_FILE_TYPES | _WAVELENGTHS | _DEPTH), display=_display()
    )
    scene = _union_of("kind", {**scenes, "power_map": power_map})
    fields: dict[str, Any] = {
        "scene": (
            scene,
            Field(
                description=(
                    "a photograph, a panorama, a hyperspectral cube, a test chart, or a power map of another program"
                )
            ),
        ),
        "optics": (optics, Field(description="parameters of the lens")),
        "distortion": (lens | None, Field(None, description="distortion model of the lens")),
        "layout": (str | layout, Field(description="a layout file, the name of a bundled layout, or a generator")),
        "sensor": (sensor, Field(default_factory=sensor, description="parameters of the photosites and their readout")),
        "exposure_s": (
            _ExposureTime,
            _field("exposure_s", ..., "exposure time", Declaration({}, EXPOSURE, Usual(1e-5, 1.0))),
        ),
        "seed": (int, _field("seed", 0, "seed of the noise", Declaration({}, NOT_NEGATIVE, Usual(0, 100)))),
        "gaze_um": (
            tuple[float, float],
            Field((0.0, 0.0), description="point of the image, in µm, at which the centre of the sensor is"),
        ),
        "gaze_deg": (
            tuple[float, float],
            Field(
                (0.0, 0.0), description="direction in a panorama, [azimuth, elevation], towards which the camera turns"
            ),
        ),
        "gaze_path": (
            _GazeRows | str | None,
            Field(
                None,
                description=(
                    "gaze of the frames of a video (foveasim video): rows [t_s, x_um, y_um], with straight lines between "
                    "them, or a CSV file with these columns, or with t_s, azimuth_deg and elevation_deg in a panorama; a "
                    "single capture has the gaze gaze_um"
                ),
            ),
        ),
        "times_s": (
            _FrameTimes | str | None,
            Field(
                None,
                description=(
                    "times of the frames of a video in s, in ascending order (foveasim video --frames DIRECTORY), or a CSV "
                    "file with the column t_s; those of a video file are its time stamps"
                ),
            ),
        ),
        "axis": (
            GazeAxis,
            Field(
                "image",
                description="what the optical axis is fixed to: the image, or the sensor that turns towards the gaze",
            ),
        ),
        "integration_order": (
            Literal[1, 2] | None,
            Field(None, description="cells of constant irradiance, or with a gradient; chosen by default"),
        ),
    }
    requirement = _model("requirement", Requirement)
    fields["requirements"] = (
        list[requirement] | None,  # type: ignore[valid-type]
        Field(None, description="conditions on results, which foveasim run --require checks"),
    )
    summary = "A shot: scene or power map, optics, distortion, layout, sensor, exposure."
    shot = create_model("ShotSection", __base__=_ShotBase, __doc__=summary, **fields)
    return Models(shot, layout, rules)


def _display() -> Any:
    """Return the type of a display: the name of one without required parameters, or a section."""
    sections = _registered_sections(DISPLAYS, **_DISPLAY_TYPES)
    names = [
        name
        for name, section in sections.items()
        if not any(field.is_required() for field in section.model_fields.values())
    ]
    named = Annotated[str, Field(json_schema_extra={"enum": names})]
    return named | _union_of("kind", sections) if sections else named


def _rules() -> type[Section]:
    """Return the model of design rules; its schema lists presets and registered rules."""
    own = set(inspect.signature(DesignRules).parameters)

    def names(rules: Sequence[str]) -> Any:
        return Field(json_schema_extra={"propertyNames": {"enum": list(rules)} if rules else False})

    return _model(
        "design rules",
        DesignRules,
        preset=Annotated[str | None, Field(json_schema_extra={"enum": [*PRESETS, None]})],
        readout=_model("readout", Readout) | None,
        routing=_model("routing", Routing) | None,
        waivers=Annotated[Mapping[str, str] | None, names([*RULES])],
        custom=Annotated[Mapping[str, float] | None, names([name for name in RULES if name not in own])],
    )


def _sensor() -> type[Section]:
    curves = _registered_sections(CURVES, path=str)
    factor = float | _union_of("kind", curves)
    product = _model("product", ProductCurve, curves=list[factor])  # type: ignore[valid-type]
    curve = _union_of("kind", curves | {"product": product})
    filter_set = _model("filter set", FilterSet, curves=list[curve])  # type: ignore[valid-type]
    filter_file = _model("filter file", read_filters, path=str)
    filters: Any = Annotated[
        Annotated[filter_set, Tag("filter set")] | Annotated[filter_file, Tag("filter file")],
        Discriminator(
            lambda section: "filter file" if isinstance(section, dict) and "path" in section else "filter set"
        ),
    ]
    effects = _registered_sections(EFFECTS, **_EFFECT_TYPES)
    pixel_optics = _registered_sections(
        PIXEL_OPTICS, skip=("opening", "photodiode"), design_chief_ray=_model("design chief ray", ChiefRayTable) | None
    )
    sensor = _model(
        "sensor",
        Sensor,
        skip=("layout",) if effects else ("layout", "effects"),
        qe=float | curve | list[float | curve],  # type: ignore[valid-type]
        filters=Literal["rgb"] | filters | None,
        pixel_optics=_union_of("kind", pixel_optics) | None,
        crosstalk=_union_of("kind", {name: _model(name, model) for name, model in _CROSSTALK.items()}) | None,
        coupling=_model("coupling", InterPixelCapacitance) | None,
        sensitivity=_PerSite,
        dark_e_per_s=_PerSite,
        full_well_e=_PerSite | None,
        read_noise_e=_PerSite,
        capacitance_f=_PerSite | None,
        gain_dn_per_e=float | list[float] | None,
        effects=list[_union_of("kind", effects)] if effects else list[Any],  # type: ignore[misc]
        disabled=list[str],
        provenance=Annotated[dict[str, Any] | None, Field(json_schema_extra={"readOnly": True})],
    )
    preset: Any = (
        Literal[tuple(SENSOR_PRESETS)] | None,
        Field(None, description="published electronics, whose values other keys replace: foveasim.sensor.PRESETS"),
    )
    datasheet: Any = (
        str | None,
        Field(None, description="file of a data sheet, whose values other keys replace: foveasim.sensor.DataSheet"),
    )
    twin: Any = (
        str | None,
        Field(
            None,
            description=(
                "file of the twin of a camera (foveasim twin), whose values other keys replace; without a layout, the "
                "photosites are the pixels of the camera"
            ),
        ),
    )
    origins = {"preset": preset, "datasheet": datasheet, "twin": twin}
    return create_model("sensor", __base__=sensor, __doc__=sensor.__doc__, **origins)


def with_layout_of_twin(settings: Any) -> Any:
    """Return settings of a shot with the layout of the sensor's twin, if they have no layout."""
    sensor = settings.get("sensor") if isinstance(settings, Mapping) else None
    if not isinstance(sensor, Mapping) or settings.get("layout") is not None or not isinstance(sensor.get("twin"), str):
        return settings
    return {**settings, "layout": sensor["twin"]}


def _layout_kind(section: Any) -> str | None:
    """Return the kind of a layout section."""
    if not isinstance(section, dict):
        return "layout generator"
    return "layout file" if "file" in section else "layout generator" if "generator" in section else None


def _layout(rules: type[Section]) -> Any:
    """Return the union of the sections of all layout generators."""
    fields: dict[str, Any] = {
        "mosaic": (
            str | list[str] | None,
            Field(None, description="repeating block of colour filters: a name, or rows of letters, the lowest first"),
        ),
        "move_um": (tuple[float, float], Field((0.0, 0.0), description="displacement along x and y, µm")),
        "inset_um": (float, Field(0.0, description="margin that is removed from each photosite, µm")),
        "snap_um": (float | None, Field(None, description="manufacturing grid of the vertices, µm")),
        "source": (str, Field("", description="source of the parameters")),
    }
    parameters = _registered_sections(LAYOUTS, _EXCLUDED, "{} parameters", **_FILE_TYPES)
    layer = _layout_union("layer", create_model("_Layer", __base__=LayerSection, **fields), parameters)
    edits = _registered_sections(EDITS, ("layout", "self"), **_EDIT_TYPES, layer=layer, rules=rules | None)
    fields["edits"] = (
        list[_union_of("kind", edits)],  # type: ignore[misc]
        Field([], description="edits of the layout in their order, before its displacement"),
    )
    fields["rules"] = (rules | None, Field(None, description="design rules of the layout"))
    return _layout_union("layout", create_model("_LayoutSection", __base__=LayerSection, **fields), parameters)


def _layout_union(title: str, base: type[LayerSection], parameters: Mapping[str, type[Section]]) -> Any:
    """Return the union of the sections of a layout, a generator or a file, over a base."""
    base.__doc__ = (
        "A layout: a generator and its parameters, colour filters, edits in the order of the keys, design rules."
    )
    descriptions = Docstring.of(read_layout).parameters
    options: dict[str, Any] = {
        name: (kind, Field(None, description=descriptions.get(name))) for name, kind in FILE_OPTIONS.items()
    }
    file = create_model(f"{title} file", __base__=base, file=(str, ...), **options)
    file.__doc__ = (
        "A layout: a file and options of its format, colour filters, edits in the order of the keys, design rules."
    )
    suffix = "" if title == "layout" else f" {title}"
    generated = _union_of(
        "generator",
        {
            name: create_model(f"{name}{suffix}", __base__=base, parameters=(part, ...))
            for name, part in parameters.items()
        },
    )
    return Annotated[
        Annotated[file, Tag("layout file")] | Annotated[generated, Tag("layout generator")],
        Discriminator(
            _layout_kind,
            custom_error_type="missing_alternative",
            custom_error_message=(
                "requires the key 'generator' or 'file'; a layout can also be the name of a bundled one, or the path of a file"
            ),
        ),
    ]
