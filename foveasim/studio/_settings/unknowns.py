"""Unknowns of generators: the parameter that follows from the others."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from foveasim.errors import FoveasimError, ParameterError, SimulationError, printable
from foveasim.layout import LAYOUTS, Layout
from foveasim.layout.sizes.sizing import (
    COLUMNS,
    SIZES,
    Sizes,
    generated,
    is_rectangular,
    renumbered,
    with_field,
)
from foveasim.studio._messages.models import MatchBudget, SolveFor, handles

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Key of the parameters of a generator.
PARAMETERS = "layout.parameters"
#: Generators of rows and columns, with the names of the numbers of columns and rows.
RASTERS = {name: sizes.columns for name, sizes in SIZES.items() if sizes.columns is not None}
#: Parameters of rasters that exclude each other.
EXCLUDED = {"pitch_um": "size_um", "size_um": "pitch_um"}
#: Settings of a layout that change what its generator returns.
AFTER_GENERATOR = ("edits", "inset_um", "move_um", "snap_um")


def is_generated(settings: Mapping[str, Any]) -> bool:
    """Return whether the layout of settings has a known generator."""
    layout = settings.get("layout")
    return isinstance(layout, dict) and layout.get("generator") in LAYOUTS


def unknowns_of(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the parameters of the generator that can follow from the others, with labels."""
    if not is_generated(settings):
        return {}
    name = settings["layout"]["generator"]
    if name in RASTERS:
        found = {"pitch_um": "pitch", COLUMNS: "columns and rows"}
    else:
        parameters = settings["layout"].get("parameters") or {}
        excludes = SIZES.get(name, Sizes()).excludes
        solvable = [each.name for each in _solvable(name) if parameters.get(excludes.get(each.name, "")) is None]
        found = {each: _label(each) for each in solvable}
    return {"n_sites": "number of photosites", **found} if found else {}


def unknown_of(settings: Mapping[str, Any]) -> str | None:
    """Return the parameter of :func:`unknowns_of` that follows from the others in settings."""
    if not unknowns_of(settings):
        return None
    name, parameters = settings["layout"]["generator"], settings["layout"].get("parameters") or {}
    if parameters.get("n_sites") is None:
        return "n_sites"
    if name in RASTERS:
        return "pitch_um" if parameters.get("size_um") is not None else COLUMNS
    return next((each.name for each in _solvable(name) if parameters.get(each.name) is None), None)


def solved_of(settings: Mapping[str, Any], layout: Layout) -> dict[str, Any]:
    """Return the parameters that the generator solved for, and the number of sites, by key."""
    if not unknowns_of(settings):
        return {}
    generator, given = settings["layout"]["generator"], settings["layout"].get("parameters") or {}
    names = [*(each.name for each in _solvable(generator)), *RASTERS.get(generator, ())]
    built = _parameters_of(layout)
    found = {name: built[name] for name in names if given.get(name) is None and built.get(name) is not None}
    return {f"{PARAMETERS}.{name}": value for name, value in {**found, "n_sites": layout.n_sites}.items()}


def generated_layout(settings: Mapping[str, Any], shown: Layout | None, section: Any = None) -> Layout | None:
    """
    Return the layout of a generator without edits.

    ``shown``: layout with edits, which replaces it for generators that read a picture. ``section``: settings of this layout,
    which is returned if it has no edits. Returns None if there is none.
    """
    if not is_generated(settings):
        return shown
    layout = settings["layout"]
    if layout == section and not any(layout.get(name) for name in AFTER_GENERATOR):
        return shown
    if LAYOUTS[layout["generator"]].picture is not None:  # type: ignore[attr-defined]
        return shown
    with suppress(FoveasimError, TypeError, ValueError):
        return generated(layout["generator"], layout.get("parameters") or {})
    return shown


def with_unknown(settings: Mapping[str, Any], unknown: str, layout: Layout) -> dict[str, Any]:
    """
    Return settings in which another parameter follows from the others.

    The number of photosites remains, or is the nearest possible one.

    ``layout``: that of the generator, see :func:`generated_layout`. Raises ParameterError when the generator cannot solve for
    the parameter.
    """
    unknowns = unknowns_of(settings)
    if unknown not in unknowns:
        names = ", ".join(unknowns) or "none: the layout has no generator that solves for its number of photosites"
        raise ParameterError("name", f"must be one of {names}", printable(unknown)[:40])
    found = _with_solved(settings, layout)
    if unknown == "n_sites":
        return found
    return with_n_sites(found, layout.n_sites, layout, unknown)


def balanced(
    settings: dict[str, Any],
    key: str,
    before: Mapping[str, Any],
    layout_of: Callable[[Mapping[str, Any]], Layout | None],
) -> dict[str, Any]:
    """
    Return settings whose generator has exactly one unknown after a change of a key.

    A number of photosites replaces a parameter that follows from it, and a parameter that is given replaces the number; a
    parameter that is removed follows from the number.

    ``before``: settings before the change. ``layout_of``: returns the generator's layout of settings, None without one.
    """
    name = key.removeprefix(f"{PARAMETERS}.")
    unknowns = unknowns_of(settings)
    if not unknowns or name == key or not is_generated(before):
        return settings
    layout = layout_of(before) if before["layout"]["generator"] == settings["layout"]["generator"] else None
    if layout is None:
        return settings
    generator, parameters = settings["layout"]["generator"], settings["layout"].get("parameters") or {}
    n_sites, value = parameters.get("n_sites"), parameters.get(name)
    columns, rows = RASTERS.get(generator, ("", ""))
    if name == "n_sites":
        if n_sites is None:
            return with_unknown(before, "n_sites", layout)
        if not _is_count(n_sites):
            return settings  # its validation reports it
        unknown = unknown_of(before)
        return with_n_sites(
            _without_n_sites(settings, layout), n_sites, layout, None if unknown == "n_sites" else unknown
        )
    if value is None:
        follows = {"pitch_um": "pitch_um", "size_um": COLUMNS}.get(name, name) if generator in RASTERS else name
        return with_unknown(before, follows, layout) if follows in unknowns else settings
    if generator in RASTERS and parameters.get(EXCLUDED.get(name, "")) is not None:
        settings = _without(settings, EXCLUDED[name])
    if n_sites is None or not _is_count(n_sites):
        return settings
    if name == rows and unknown_of(settings) == "pitch_um":
        return _without(_with_solved(settings, layout), "n_sites")
    if name == columns or (name in {each.name for each in _solvable(generator)} and unknown_of(settings) is None):
        return _without(settings, "n_sites")
    # The number may have no nearer possible one with the new value.
    return with_n_sites(settings, n_sites, layout, unknown_of(settings), is_resized=False)


def with_n_sites(
    settings: Mapping[str, Any],
    n_sites: int,
    layout: Layout,
    unknown: str | None = None,
    *,
    is_resized: bool = True,
) -> dict[str, Any]:
    """
    Return settings whose generator solves for a number of photosites.

    By default, rasters have the field of the present layout, and other pitches; of other generators, one parameter is solved
    for.

    ``layout``: that of the generator, see :func:`generated_layout`. ``unknown``: parameter of :func:`unknowns_of` that is
    solved for. ``is_resized``: whether the other parameters of a raster are derived from the layout. Raises ParameterError
    when the layout has no generator, or its generator has no such parameter.
    """
    if not is_generated(settings):
        raise ParameterError("layout", "must have a generator, whose number of photosites can be chosen")
    found = copy.deepcopy(dict(settings))
    section = found["layout"]
    given = section.get("parameters") or {}
    section["parameters"] = renumbered(section["generator"], given, n_sites, layout, unknown, is_resized=is_resized)
    return found


def _with_solved(settings: Mapping[str, Any], layout: Layout) -> dict[str, Any]:
    """Return settings with the solved parameters instead of the number of sites."""
    found = copy.deepcopy(dict(settings))
    parameters, built = found["layout"].setdefault("parameters", {}), _parameters_of(layout)
    parameters.pop("n_sites", None)
    for solvable in _solvable(found["layout"]["generator"]):
        if parameters.get(solvable.name) is None and built.get(solvable.name) is not None:
            parameters[solvable.name] = built[solvable.name]
    return found


def _without_n_sites(settings: Mapping[str, Any], layout: Layout) -> dict[str, Any]:
    """Return settings without the number of sites; rasters lack a parameter."""
    if settings["layout"]["generator"] in RASTERS:
        return _without(settings, "n_sites")
    return _with_solved(settings, layout)


def _without(settings: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return settings without a parameter of the generator."""
    found = copy.deepcopy(dict(settings))
    found["layout"]["parameters"].pop(name, None)
    return found


def _but(parameters: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {key: value for key, value in parameters.items() if key not in names}


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0


def _solvable(generator: str) -> tuple[Any, ...]:
    """Return the parameters for which a generator solves."""
    found: tuple[Any, ...] = LAYOUTS[generator].solve_for  # type: ignore[attr-defined]
    return found


def _parameters_of(layout: Layout) -> dict[str, Any]:
    """Return the parameters of a layout's generator with those that it solved for."""
    return dict(layout.provenance.get("parameters") or {})


def _label(name: str) -> str:
    for suffix in ("_um", "_deg"):
        name = name.removesuffix(suffix)
    return name.replace("_", " ")


@handles(SolveFor)
def _solve_for(session: Session, message: SolveFor) -> dict[str, Any]:
    built = session.layout_source()(session.history.settings)
    if built is None:
        raise SimulationError("there is no layout whose parameters are known")
    return with_unknown(session.history.settings, message.name, built)


def size_of(layout: Layout) -> tuple[float, float]:
    """Return width and height of the bounding box, µm."""
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um
    return x1_um - x0_um, y1_um - y0_um


@handles(MatchBudget)
def _match_budget(session: Session, message: MatchBudget) -> dict[str, Any]:
    settings, frozen, current = session.history.settings, session.compared.frozen_result, session.result
    if frozen is None or current is None:
        raise SimulationError("there is no variant A to compare with")
    target, edited, layout_of = frozen.capture, current.capture.layout, session.layout_source()
    own = layout_of(settings) or edited
    # Edits may change the number and the size of the generator.
    n_sites, size_um = (
        own.n_sites,
        [a * g / b for a, g, b in zip(*map(size_of, (target.layout, own, edited)), strict=True)],
    )
    if message.what != "field":
        factor = target.bits / current.capture.bits if message.what == "data_rate" else 1.0
        n_sites = max(1, round(factor * target.layout.n_sites * own.n_sites / edited.n_sites))
        settings = with_n_sites(settings, n_sites, own)
    if message.what in ("field", "both") and is_generated(settings):
        found, own = copy.deepcopy(settings), layout_of(settings) or own
        generator, parameters = found["layout"]["generator"], found["layout"].get("parameters") or {}
        found["layout"]["parameters"] = with_field(generator, parameters, size_um, size_of(own))
        return with_n_sites(found, n_sites, own, "pitch_um", is_resized=False) if is_rectangular(generator) else found
    return settings
