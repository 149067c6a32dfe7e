"""New sensors from a generator, a format, a number of photosites, filters and electronics."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.validation import check_choice, check_length_um
from foveasim.config import build_shot
from foveasim.layout import LAYOUTS, MOSAICS, Layout
from foveasim.layout.generator_fields import RECTANGULAR, rounded_down, with_field, with_scale
from foveasim.sensor import PRESETS
from foveasim.studio._files import with_covering_scene, with_layout
from foveasim.studio._messages.models import NewSensor, handles
from foveasim.studio._settings.changes import choose_preset, match_filters
from foveasim.studio._settings.templates import templates
from foveasim.studio._settings.unknowns import INSTEAD_OF, generated_layout, with_n_sites

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Parameters that follow the size of a photosite relative to the field: numbers of photosites along a line, and lengths.
LINE_COUNTS = {"foveal_cartesian": ("n_fovea",), "giotto": ("n_rho", "n_fovea", "n_across")}
SITE_LENGTHS = {"giotto": ("unit_um",), "log_polar": ("min_size_um",)}
#: Ratios of neighbouring photosites, whose product over a line remains.
RATIOS = {"foveal_cartesian": ("ring_ratio",)}
#: Significant digits of the design rule for the smallest photosite.
RULE_DIGITS = 3
#: Parameters of the range of the ADC.
RANGE = {"capacitance_f", "v_sat_v"}
#: Filters of mosaics that sensors have by name, their letters, and the mosaic with red at the top left.
FILTERS, LETTERS, BAYER = "rgb", set("RGB"), "RGGB"


def generators() -> list[str]:
    """Return the generators with initial values that solve for a number of photosites."""
    initial = {name: templates(f"{name} parameters") for name in sorted(LAYOUTS)}
    return [name for name, given in initial.items() if given and ("n_sites" in given or _unknown(name) is not None)]


def mosaics() -> list[str]:
    """Return the mosaics of red, green and blue: Bayer's by its letters, others by name."""
    larger = [
        name for name, block in MOSAICS.items() if len(block) ** 2 > len(BAYER) and set("".join(block)) <= LETTERS
    ]
    return [BAYER, *larger]


def electronics() -> list[str]:
    """Return the named electronics that specify the range of the ADC."""
    return [name for name, preset in PRESETS.items() if set(preset.settings()) >= RANGE]


@handles(NewSensor)
def new_sensor(session: Session, message: NewSensor) -> dict[str, Any]:
    """
    Return settings with a new sensor, which the scene covers; its exposure is automatic.

    Optics, scene and seed remain. The centre of the sensor is at that of the image. Raises ParameterError when a name is
    unknown, or the generator cannot have this number of photosites. Raises SimulationError when the scene has a size that
    cannot change.
    """
    settings = session.history.settings
    session.check("solving for the number of photosites")
    generator = check_choice("generator", message.generator, generators())
    mosaic = message.filters
    if mosaic is not None:
        check_choice("filters", mosaic, mosaics())
    size_um = [check_length_um("size_um", length_um) for length_um in message.size_um]
    found = with_layout(settings, _layout(generator, size_um, message.n_sites, settings))
    found.pop("gaze_um", None)
    found["scene"].pop("gaze_range_um", None)
    found["sensor"] = {
        **(found.get("sensor") or {}),
        "preset": check_choice("electronics", message.electronics, electronics()),
    }
    choose_preset(found)
    found["sensor"].pop("filters", None)
    if mosaic is not None:
        found["sensor"]["filters"], found["layout"]["mosaic"] = FILTERS, mosaic
    match_filters(found, settings)
    found["exposure_s"] = "auto"
    if found["scene"].get("kind") != "picture":
        return with_covering_scene(found, build_shot(None, found))
    return found


def _layout(generator: str, size_um: Sequence[float], n_sites: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section of a layout in a format, with the design rules that it satisfies."""
    if generator in RECTANGULAR:
        parameters = with_field(generator, templates(f"{generator} parameters"), size_um, size_um)
        section = _solved(generator, parameters, n_sites, is_resized=False)
    else:
        section = _solved(generator, _refined(generator, n_sites), n_sites)
        factor = 0.5 * min(size_um) / float(np.abs(_built(section, settings).bounds_um).max())
        section["parameters"] = with_scale(section["parameters"], factor, 0.5 * min(size_um))
    min_size_um = float(_built(section, settings).size_um.min())
    return {**section, "rules": {"min_size_um": rounded_down(min_size_um, RULE_DIGITS), "max_overlap_um2": 0.0}}


def _initial(generator: str) -> Layout | None:
    """Return the layout of the initial values of a generator; None if it requires a picture."""
    return generated_layout(
        {"layout": {"generator": generator, "parameters": templates(f"{generator} parameters")}}, None
    )


def _refined(generator: str, n_sites: int) -> dict[str, Any]:
    """Return initial values for another number of photosites, before one is solved for."""
    found, initial = copy.deepcopy(templates(f"{generator} parameters")), _initial(generator)
    if initial is None:
        return found
    factor = math.sqrt(n_sites / initial.n_sites)
    for name in LINE_COUNTS.get(generator, ()):
        found[name] = max(1, round(found[name] * factor))
    for name in SITE_LENGTHS.get(generator, ()):
        found[name] = found[name] / factor
    for name in RATIOS.get(generator, ()):
        found[name] = found[name] ** (1.0 / factor)
    return found


def _solved(generator: str, parameters: Mapping[str, Any], n_sites: int, *, is_resized: bool = True) -> dict[str, Any]:
    """Return the section of a generator that solves for a number of photosites."""
    unknown, initial = _unknown(generator), _initial(generator)
    given = {name: value for name, value in parameters.items() if name != INSTEAD_OF.get(unknown or "")}
    if initial is None:
        return {"generator": generator, "parameters": {**given, "n_sites": n_sites}}
    section = {"generator": generator, "parameters": given}
    found: dict[str, Any] = with_n_sites({"layout": section}, n_sites, initial, unknown, is_resized=is_resized)[
        "layout"
    ]
    return found


def _built(section: Mapping[str, Any], settings: Mapping[str, Any]) -> Layout:
    """
    Return the layout of a section.

    Generators that can read pictures are called with a shot, without filters. Raises ParameterError or ConfigError when the
    generator rejects the parameters.
    """
    found = generated_layout({"layout": section}, None)
    if found is not None:
        return found
    shot = {name: value for name, value in settings.items() if name not in ("sensor", "requirements")}
    return build_shot(None, {**shot, "layout": section}).camera.layout


def _unknown(generator: str) -> str | None:
    """Return the parameter that is solved for; None if the number of photosites is itself one."""
    solvable = LAYOUTS[generator].solve_for  # type: ignore[attr-defined]
    return str(solvable[0].name) if solvable else None
