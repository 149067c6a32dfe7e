"""New sensors from a generator, requirements, filters and electronics."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.quantities import format_quantity
from foveasim._core.validation import check_choice, check_length_um
from foveasim.config import build_shot
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import LAYOUTS, MOSAICS, Layout
from foveasim.scene import Scene
from foveasim.sensor import PRESETS
from foveasim.studio._engine import MAX_SITES
from foveasim.studio._files import with_covering_scene, with_layout, without_gaze
from foveasim.studio._messages.models import NewSensor, handles
from foveasim.studio._settings.changes import choose_preset, match_filters
from foveasim.studio._settings.generator_fields import RECTANGULAR, rounded_down, with_field, with_scale
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
#: Number of photosites and frame rate where none is given, and shape of a sensor without a format.
N_SITES, FRAMES_PER_S, SHAPE = 12_000, 30.0, (math.sqrt(4 / 3), math.sqrt(3 / 4))
#: Relative difference of the smallest site from the required one, and number of layouts that are tried.
TOLERANCE, MAX_TRIES = 0.05, 8
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
    unknown, or the generator cannot have this number of photosites. Raises SimulationError when the requirements contradict
    each other, or the scene has a size that cannot change.
    """
    settings = session.history.settings
    session.check("solving for the number of photosites")
    generator = check_choice("generator", message.generator, generators())
    mosaic = message.filters
    if mosaic is not None:
        check_choice("filters", mosaic, mosaics())
    size_um = None if message.size_um is None else [check_length_um("size_um", each_um) for each_um in message.size_um]
    min_size_um = _min_size_um(session, message)
    is_most = message.n_sites is None
    section = _layout(generator, size_um, _n_sites(message), min_size_um, settings, is_most=is_most)
    found = with_layout(without_gaze(settings), section)
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


def _min_size_um(session: Session, message: NewSensor) -> float | None:
    """Return the required size of the smallest site, also from sites per degree."""
    if message.sites_per_deg is None:
        return message.min_size_um
    shot = session.required_result("new_sensor").shot
    distance_mm = shot.camera.optics.focal_length_mm
    if isinstance(shot.scene, Scene):
        distance_mm = 1e3 * shot.camera.optics.magnification(shot.scene.distance_m) * shot.scene.distance_m
    per_deg_um = 1e3 * distance_mm * math.tan(math.radians(1.0))
    size_um, least_um = per_deg_um / message.sites_per_deg, message.min_size_um
    if least_um is not None and size_um < least_um:
        raise SimulationError(
            f"{message.sites_per_deg:g} sites per degree require sites of {_um(size_um)} with this lens, smaller than the "
            f"smallest site of {_um(least_um)}: possible are {per_deg_um / least_um:.4g} sites per degree"
        )
    return size_um if least_um is None else least_um


def _n_sites(message: NewSensor) -> int | None:
    """Return the required number of photosites, or the largest one for the data rate."""
    if message.pixels_per_s is None:
        return message.n_sites
    frames_per_s = message.frames_per_s or FRAMES_PER_S
    most = max(1, int(min(message.pixels_per_s / frames_per_s, MAX_SITES)))
    if message.n_sites is not None and message.n_sites > most:
        raise SimulationError(
            f"{message.n_sites:,} photosites exceed the data rate: possible are {most:,} at {frames_per_s:g} frames/s, or "
            f"{message.pixels_per_s / message.n_sites:.3g} frames/s"
        )
    return message.n_sites or most


def _layout(
    generator: str,
    size_um: Sequence[float] | None,
    n_sites: int | None,
    min_size_um: float | None,
    settings: Mapping[str, Any],
    *,
    is_most: bool = False,
) -> dict[str, Any]:
    """
    Return the section of a layout for what is given, with rules that it satisfies.

    ``is_most``: whether fewer photosites are possible, too.
    """
    if min_size_um is None:
        if size_um is None:
            raise SimulationError("the size of the sensor is not determined; give a format, or the smallest site")
        return _filled(generator, size_um, n_sites or N_SITES, settings)
    if size_um is None:
        n_sites = n_sites or N_SITES
        size_um = [min_size_um * math.sqrt(n_sites) * side for side in SHAPE]
        factor = min_size_um / _filled(generator, size_um, n_sites, settings)["rules"]["min_size_um"]
        return _filled(generator, [factor * each_um for each_um in size_um], n_sites, settings)

    (width_um, height_um), least_um = size_um, min_size_um

    def contradiction(n_wanted: int, *possible: tuple[int, float]) -> SimulationError:
        names = ", or ".join(f"{n:,} of {_um(each_um)}" for n, each_um in possible)
        return SimulationError(
            f"{generator.replace('_', ' ')} in {1e-3 * width_um:.4g} × {1e-3 * height_um:.4g} mm cannot have {n_wanted:,} "
            f"photosites of {_um(least_um)}: possible are {names}"
        )

    area_um2 = math.prod(size_um) if generator in RECTANGULAR else 0.25 * math.pi * min(size_um) ** 2
    n_most = round(area_um2 / min_size_um**2)
    n_sites = None if is_most and (n_sites or 0) > n_most else n_sites
    n_wanted = n_sites or (n_most if generator in RECTANGULAR else 0)
    if n_wanted > min((1.0 + 2.0 * TOLERANCE) * n_most, MAX_SITES):
        n_possible = min(n_wanted, MAX_SITES)
        other = [(n_most, min_size_um)] if n_most < n_wanted else []
        raise contradiction(n_wanted, *other, (n_possible, math.sqrt(area_um2 / n_possible)))
    if generator == "log_polar":
        given = templates("log_polar parameters") | {"min_size_um": min_size_um, "r_max_um": 0.5 * min(size_um)}
        parameters = _with_sectors(given, n_sites) if n_sites else given
        section: dict[str, Any] = {"generator": generator, "parameters": parameters}
        n_built = _built(section, settings).n_sites
        if n_sites and abs(n_built / n_sites - 1.0) > TOLERANCE:
            raise contradiction(n_sites, (n_built, min_size_um))
        return _with_rules(section, settings)
    n_tried = n_wanted or min(n_most, N_SITES)
    for _ in range(1 if n_sites else MAX_TRIES):
        section = _filled(generator, size_um, max(1, n_tried), settings)
        ratio = section["rules"]["min_size_um"] / min_size_um
        if abs(ratio - 1.0) <= TOLERANCE:
            return section
        n_tried = round(n_tried * ratio**2)
    n_built = _built(section, settings).n_sites
    other = []
    if n_sites:
        n_possible = _built(_layout(generator, size_um, None, min_size_um, settings), settings).n_sites
        other = [(n_possible, min_size_um)]
    raise contradiction(n_sites or n_most, *other, (n_built, ratio * min_size_um))


def _um(length_um: float) -> str:
    return format_quantity(length_um, "µm", digits=3)


def _filled(generator: str, size_um: Sequence[float], n_sites: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section of a layout in a format, with the design rules that it satisfies."""
    if generator in RECTANGULAR:
        parameters = with_field(generator, templates(f"{generator} parameters"), size_um, size_um)
        section = _solved(generator, parameters, n_sites, is_resized=False)
    else:
        section = _solved(generator, _refined(generator, n_sites), n_sites)
        factor = 0.5 * min(size_um) / float(np.abs(_built(section, settings).bounds_um).max())
        section["parameters"] = with_scale(section["parameters"], factor, 0.5 * min(size_um))
    return _with_rules(section, settings)


def _with_rules(section: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
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
    if generator == "log_polar":  # an integer, which later builds need not solve for again
        return {"generator": generator, "parameters": _with_sectors(parameters, n_sites)}
    unknown, initial = _unknown(generator), _initial(generator)
    given = {name: value for name, value in parameters.items() if name != INSTEAD_OF.get(unknown or "")}
    if initial is None:
        return {"generator": generator, "parameters": {**given, "n_sites": n_sites}}
    section = {"generator": generator, "parameters": given}
    found: dict[str, Any] = with_n_sites({"layout": section}, n_sites, initial, unknown, is_resized=is_resized)[
        "layout"
    ]
    return found


def _with_sectors(parameters: Mapping[str, Any], n_sites: int) -> dict[str, Any]:
    """Return parameters of log-polar rings with about a number of photosites."""
    found, n_sectors = dict(parameters), parameters["n_sectors"]
    for _ in range(MAX_TRIES):
        try:
            n_built = LAYOUTS["log_polar"](**{**found, "n_sectors": n_sectors}).n_sites
        except ParameterError:  # more sectors than the field has room for
            n_sectors = (found["n_sectors"] + n_sectors) // 2
            continue
        found["n_sectors"] = n_sectors
        n_sectors = max(3, round(n_sectors * math.sqrt(n_sites / n_built)))
        if n_sectors == found["n_sectors"]:
            break
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
