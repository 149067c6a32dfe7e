"""Unknowns of generators: the parameter that follows from the others."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from foveasim.errors import FoveasimError, ParameterError, printable
from foveasim.layout import LAYOUTS, Layout

#: Key of the parameters of a generator.
PARAMETERS = "layout.parameters"
#: Generators of rows and columns, with the names of the numbers of columns and rows.
RASTERS = {"grid": ("n_x", "n_y"), "hexagonal": ("n_columns", "n_rows"), "octagonal": ("n_x", "n_y")}
#: Unknown of rasters whose numbers of columns and rows follow from the pitch.
COLUMNS = "columns"
#: Parameters for which a generator solves only without another one.
INSTEAD_OF = {"n_fovea": "pitch_um"}
#: Largest difference of the number of sites, in percent, where generators have no nearer possible number.
MAX_PERCENT = 8


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
        solvable = [each.name for each in _solvable(name) if parameters.get(INSTEAD_OF.get(each.name, "")) is None]
        found = {each: _label(each) for each in solvable}
    return {"n_sites": "number of photosites", **found} if found else {}


def unknown_of(settings: Mapping[str, Any]) -> str | None:
    """Return the parameter of :func:`unknowns_of` that follows from the others in settings."""
    unknowns = unknowns_of(settings)
    if not unknowns:
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
    generated = _generated_parameters(settings, layout)
    found = {name: generated[name] for name in names if given.get(name) is None and generated.get(name) is not None}
    return {f"{PARAMETERS}.{name}": value for name, value in {**found, "n_sites": layout.n_sites}.items()}


def with_unknown(settings: Mapping[str, Any], unknown: str, layout: Layout) -> dict[str, Any]:
    """
    Return settings in which another parameter follows from the others.

    The number of photosites remains.

    ``layout``: present layout of the settings. Raises ParameterError when the generator cannot solve for the parameter.
    """
    unknowns = unknowns_of(settings)
    if unknown not in unknowns:
        names = ", ".join(unknowns) or "none: the layout has no generator that solves for its number of photosites"
        raise ParameterError("name", f"must be one of {names}", printable(unknown)[:40])
    found = copy.deepcopy(dict(settings))
    parameters = found["layout"].setdefault("parameters", {})
    n_sites = parameters.pop("n_sites", None)
    generated = _generated_parameters(settings, layout)
    for solvable in _solvable(found["layout"]["generator"]):
        if parameters.get(solvable.name) is None and generated.get(solvable.name) is not None:
            parameters[solvable.name] = generated[solvable.name]
    if unknown == "n_sites":
        return found
    return with_n_sites(found, n_sites or _count(found, layout), layout, unknown)


def balanced(settings: dict[str, Any], key: str, layout: Layout | None) -> dict[str, Any]:
    """
    Return settings whose generator has exactly one unknown after a change of a key.

    A number of photosites replaces a parameter that follows from it, and a parameter that is given replaces the number; a
    parameter that is removed follows from the present number. ``layout``: present layout, None without one.
    """
    name = key.removeprefix(f"{PARAMETERS}.")
    unknowns = unknowns_of(settings)
    if name == key or layout is None or not unknowns:
        return settings
    generator, parameters = settings["layout"]["generator"], settings["layout"].get("parameters") or {}
    n_sites = parameters.get("n_sites")
    other = {"pitch_um": "size_um", "size_um": "pitch_um"}.get(name) if generator in RASTERS else None
    if other is not None and parameters.get(name) is not None and parameters.get(other) is not None:
        found = copy.deepcopy(settings)
        del found["layout"]["parameters"][other]
        return found
    solvable = {each.name: each for each in _solvable(generator)}
    names = {*solvable, *RASTERS.get(generator, ())}
    if name == "n_sites":
        if n_sites is None:
            return with_unknown(settings, "n_sites", layout)
        if unknown_of(settings) is None or (
            generator in RASTERS and any(parameters.get(each) is not None for each in RASTERS[generator])
        ):
            return with_n_sites(settings, n_sites, layout)
    elif name in names and n_sites is not None and parameters.get(name) is not None:
        if unknown_of(settings) is None or name in RASTERS.get(generator, ()):
            found = copy.deepcopy(settings)
            del found["layout"]["parameters"]["n_sites"]
            return found
    elif name in solvable and n_sites is None and parameters.get(name) is None and not solvable[name].is_optional:
        return with_n_sites(settings, layout.n_sites, layout, name if generator not in RASTERS else None)
    return settings


def with_n_sites(
    settings: Mapping[str, Any], n_sites: int, layout: Layout, unknown: str | None = None
) -> dict[str, Any]:
    """
    Return settings whose generator solves for a number of photosites.

    By default, rasters have the field of the present layout, and other pitches; of other generators, one parameter is solved
    for.

    ``layout``: present layout of the settings. ``unknown``: parameter of :func:`unknowns_of` that is solved for. Raises
    ParameterError when the layout has no generator, or its generator has no such parameter.
    """
    if not is_generated(settings):
        raise ParameterError("layout", "must have a generator, whose number of photosites can be chosen")
    found = copy.deepcopy(dict(settings))
    name = found["layout"]["generator"]
    parameters = found["layout"].setdefault("parameters", {})
    solvable = _solvable(name)
    given = [each.name for each in solvable if parameters.get(each.name) is not None and unknown in (None, each.name)]
    if name in RASTERS:
        x0_um, y0_um, x1_um, y1_um = layout.bounds_um
        replaced = {*RASTERS[name], "pitch_um", "pitch_y_um"}
        if unknown == COLUMNS:
            replaced = {*RASTERS[name], "size_um"}
            if parameters.get("pitch_um") is None:
                n_columns = _generated_parameters(settings, layout).get(RASTERS[name][0]) or 1
                parameters["pitch_um"] = round((x1_um - x0_um) / n_columns, 6)
        elif parameters.get("size_um") is None:
            parameters["size_um"] = [round(x1_um - x0_um, 6), round(y1_um - y0_um, 6)]
        candidates = [{key: value for key, value in parameters.items() if key not in replaced}]
    elif solvable and (parameters.get("n_sites") is None or unknown is not None or len(given) == len(solvable)):
        if not given and unknown is None:
            raise ParameterError("layout", f"of {name} must contain {' or '.join(each.name for each in solvable)}")
        others = given or [unknown]
        candidates = [{key: value for key, value in parameters.items() if key != other} for other in others]
    else:
        candidates = [parameters]
    chosen = candidates[0] | {"n_sites": n_sites}
    if solvable and LAYOUTS[name].picture is None:  # type: ignore[attr-defined]
        chosen = _nearest(name, candidates, n_sites) or chosen  # without any, the generator reports the reason
    found["layout"]["parameters"] = chosen
    return found


def _nearest(generator: str, candidates: list[dict[str, Any]], n_sites: int) -> dict[str, Any] | None:
    """Return the first parameters with a possible number of sites near the given one."""
    for percent in sorted(range(-MAX_PERCENT, MAX_PERCENT + 1), key=abs):
        for parameters in candidates:
            with suppress(FoveasimError):
                layout = LAYOUTS[generator](**{**parameters, "n_sites": round(n_sites * (1.0 + 0.01 * percent))})
                return parameters | {"n_sites": layout.n_sites if percent else n_sites}
    return None


def _solvable(generator: str) -> tuple[Any, ...]:
    """Return the parameters for which a generator solves."""
    found: tuple[Any, ...] = LAYOUTS[generator].solve_for  # type: ignore[attr-defined]
    return found


def _generated_parameters(settings: Mapping[str, Any], layout: Layout) -> dict[str, Any]:
    """Return the parameters of the layout's generator with those that it solved for."""
    provenance = layout.provenance
    is_same = provenance.get("generator") == settings["layout"]["generator"]
    return dict(provenance.get("parameters") or {}) if is_same else {}


def _count(settings: Mapping[str, Any], layout: Layout) -> int:
    """Return the number of sites that the generator gives, without edits."""
    name, parameters = settings["layout"]["generator"], settings["layout"]["parameters"]
    if not settings["layout"].get("edits") or LAYOUTS[name].picture is not None:  # type: ignore[attr-defined]
        return layout.n_sites
    return int(LAYOUTS[name](**parameters).n_sites)


def _label(name: str) -> str:
    for suffix in ("_um", "_deg"):
        name = name.removesuffix(suffix)
    return name.replace("_", " ")
