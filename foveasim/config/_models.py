"""
What may stand in a settings file.

Every section is a call of a function or class of the package, and its keys are that call's parameters: the file and the
Python call have the same names, defaults and limits. pydantic reads the types off the signatures, here and nowhere else.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Union, get_type_hints

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, create_model

from foveasim import layout as layouts
from foveasim.distortion import BrownConrady, Fisheye, Lens, PolynomialFisheye, Scaramuzza
from foveasim.layout import DesignRules, Layout
from foveasim.maps import read_power_map
from foveasim.optics import Annulus, Blades, LateralColour, Optics, PupilImage, Seidel, Slit, Spider, Zernike
from foveasim.scene import Scene, charts
from foveasim.sensor import (
    ConstantCurve,
    Coupling,
    Diffusion,
    FilterSet,
    GaussianCurve,
    KernelCrosstalk,
    PassBand,
    PolynomialCurve,
    ProductCurve,
    Sensor,
    SiliconQE,
    SplineCurve,
    StepCurve,
    TableCurve,
    ccd_qe,
    read_curve,
    read_filters,
)
from foveasim.sensor.effects import EFFECTS

__all__ = ["GENERATORS", "PICTURES", "LayoutUnion", "PerArea", "RulesSection", "ShotSection", "call_of"]

#: What a section is a call of.
_CALLS: dict[type[BaseModel], Callable[..., Any]] = {}
#: Parameters of generators that a file gives as the name of a picture.
PICTURES = {"quadtree": "importance", "voronoi": "density"}


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
    model = create_model(name, __base__=_Section, __doc__=summary, **keys)
    _CALLS[model] = call
    return model


def call_of(section: BaseModel) -> Callable[..., Any] | None:
    """What a section's values are the arguments of; None for a section that only holds values."""
    return next((_CALLS[kind] for kind in type(section).__mro__ if kind in _CALLS), None)


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


#: Every layout family by its name in settings files, which is that of its function.
GENERATORS: dict[str, Callable[..., Layout]] = {
    "foveal_cartesian": layouts.foveal_cartesian,
    "fovi": layouts.fovi,
    "giotto": layouts.giotto,
    "grid": layouts.grid,
    "hexagonal": layouts.hexagonal,
    "log_polar": layouts.log_polar,
    "octagonal": layouts.octagonal,
    "penrose": layouts.penrose,
    "quadtree": layouts.quadtree,
    "sunflower": layouts.sunflower,
    "tiling": layouts.tiling,
    "voronoi": layouts.voronoi,
    "zones": layouts.zones,
}
_Outline = Annotated[list[list[float]] | str, Field(description="vertices [x, y] in µm, or well-known text")]
#: Parameters that files write in another way than Python does.
_IN_FILES: dict[str, Any] = {
    "density": Annotated[str | None, Field(description="a picture: bright where sites are to be dense")],
    "importance": Annotated[str, Field(description="a picture: bright where squares are to be small")],
    "outlines_um": list[_Outline] | None,
    "path": str,
    "picture": str,
    "region": _Outline | None,
    "spectrum": list[list[float]] | None,
}
_Numbers: Any = float | list[float] | None
#: Parameters that files do not have: the picture of a density covers the rectangle ``size_um``.
_NOT_IN_FILES = ("density_grid",)
_SCENES: dict[str, Callable[..., Any]] = {
    "picture": Scene.from_picture,
    "flat": Scene.flat,
    "point_sources": Scene.point_sources,
    "power_map": read_power_map,
    "bars": charts.bars,
    "checkerboard": charts.checkerboard,
    "colour_chart": charts.colour_chart,
    "grey_scale": charts.grey_scale,
    "letter_f": charts.letter_f,
    "point_grid": charts.point_grid,
    "siemens_star": charts.siemens_star,
    "sine": charts.sine,
    "slanted_edge": charts.slanted_edge,
    "zone_plate": charts.zone_plate,
}
_LENSES: dict[str, Callable[..., Lens]] = {
    "brown_conrady": BrownConrady,
    "fisheye": Fisheye,
    "polynomial_fisheye": PolynomialFisheye,
    "scaramuzza": Scaramuzza,
}
_PUPILS: dict[str, Callable[..., Any]] = {
    "annulus": Annulus,
    "blades": Blades,
    "image": PupilImage,
    "slit": Slit,
    "spider": Spider,
}
_CROSSTALK: dict[str, Callable[..., Any]] = {"diffusion": Diffusion, "kernel": KernelCrosstalk}
_CURVES: dict[str, Callable[..., Any]] = {
    "ccd": ccd_qe,
    "constant": ConstantCurve,
    "file": read_curve,
    "gaussian": GaussianCurve,
    "pass_band": PassBand,
    "polynomial": PolynomialCurve,
    "silicon": SiliconQE,
    "spline": SplineCurve,
    "step": StepCurve,
    "table": TableCurve,
}

_LensSection = _one_of("kind", {name: _model(name, lens) for name, lens in _LENSES.items()})
_PupilSection = _one_of(
    "kind", {name: _model(name, pupil, skip=("wavefront_um",), **_IN_FILES) for name, pupil in _PUPILS.items()}
)
_OpticsSection = _model(
    "optics",
    Optics,
    pupil=_PupilSection | list[_PupilSection] | None,  # type: ignore[valid-type]
    zernike=_model("zernike", Zernike) | None,
    seidel=_model("seidel", Seidel) | None,
    lateral_colour=_model("lateral colour", LateralColour) | None,
)
_curves = {name: _model(name, curve, path=str) for name, curve in _CURVES.items()}
_Factor = float | _one_of("kind", _curves)
_product = _model("product", ProductCurve, curves=list[_Factor])  # type: ignore[valid-type]
_CurveSection = _one_of("kind", _curves | {"product": _product})
_filter_set = _model("filter set", FilterSet, curves=list[_CurveSection])  # type: ignore[valid-type]
_filter_file = _model("filter file", read_filters, path=str)
_FilterSection: Any = Annotated[
    Annotated[_filter_set, Tag("filter set")] | Annotated[_filter_file, Tag("filter file")],
    Discriminator(lambda section: "filter file" if isinstance(section, dict) and "path" in section else "filter set"),
]
_PerSite = float | PerArea | list[float]
_SceneSection = _one_of(
    "kind",
    {
        k: _model(k, call, **(_IN_FILES | {"wavelength_nm": _Numbers, "band_width_nm": _Numbers}))
        for k, call in _SCENES.items()
    },
)
_EffectSection: Any = Any
if EFFECTS:
    _EffectSection = _one_of("kind", {name: _model(name, effect) for name, effect in EFFECTS.items()})
_SensorSection = _model(
    "sensor",
    Sensor,
    skip=("layout",),
    qe=float | _CurveSection | list[float | _CurveSection],  # type: ignore[valid-type]
    filters=Literal["rgb"] | _FilterSection | None,
    crosstalk=_one_of("kind", {name: _model(name, way) for name, way in _CROSSTALK.items()}) | None,
    coupling=_model("coupling", Coupling) | None,
    sensitivity=_PerSite,
    dark_e_per_s=_PerSite,
    full_well_e=_PerSite | None,
    read_noise_e=_PerSite,
    capacitance_f=_PerSite,
    effects=list[_EffectSection],
)
RulesSection = _model(
    "design rules",
    DesignRules,
    preset=str | None,
    readout=_model("readout", layouts.Readout) | None,
    routing=_model("routing", layouts.Routing) | None,
)


class _LayoutSection(_Section):
    """A layout: a generator and its parameters, colour filters, edits in the order of the keys, design rules, its source."""

    mosaic: str | list[str] | None = None
    move_um: tuple[float, float] = (0.0, 0.0)
    inset_um: float = 0.0
    snap_um: float | None = None
    rules: RulesSection | None = None  # type: ignore[valid-type]
    source: str = ""


LayoutUnion = _one_of(
    "generator",
    {
        name: create_model(
            name,
            __base__=_LayoutSection,
            parameters=(_model(f"{name} parameters", call, _NOT_IN_FILES, **_IN_FILES), ...),
        )
        for name, call in GENERATORS.items()
    },
)


class ShotSection(_Section):
    """A whole shot: scene or power map, optics, distortion, layout, sensor, exposure."""

    scene: _SceneSection  # type: ignore[valid-type]
    optics: _OpticsSection  # type: ignore[valid-type]
    distortion: _LensSection | None = None  # type: ignore[valid-type]
    layout: str | LayoutUnion  # type: ignore[valid-type]
    sensor: _SensorSection = Field(default_factory=_SensorSection)  # type: ignore[valid-type]
    exposure_s: float
    seed: int = 0
    integration_order: Literal[1, 2] | None = None
