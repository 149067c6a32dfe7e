"""New sensors from a generator, requirements, filters and electronics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from foveasim._core.quantities import format_quantity
from foveasim._core.validation import check_choice, check_length_um
from foveasim.config import build_shot
from foveasim.errors import SimulationError
from foveasim.layout import MOSAICS, Layout
from foveasim.layout.sizes.sizing import rounded_down, sizable, sized
from foveasim.scene import Scene
from foveasim.sensor import PRESETS
from foveasim.studio._engine import MAX_SITES
from foveasim.studio._files import with_covering_scene, with_layout, without_gaze
from foveasim.studio._messages.models import NewSensor, handles
from foveasim.studio._settings.changes import choose_electronics, match_filters
from foveasim.studio._settings.templates import templates
from foveasim.studio._settings.unknowns import generated_layout

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Significant digits of the design rule for the smallest photosite.
RULE_DIGITS = 3
#: Frame rate where none is given.
FRAMES_PER_S = 30.0
#: Parameters of the range of the ADC.
RANGE = {"capacitance_f", "v_sat_v"}
#: Filters of mosaics that sensors have by name, their letters, and the mosaic with red at the top left.
FILTERS, LETTERS, BAYER = "rgb", set("RGB"), "RGGB"


def mosaics() -> list[str]:
    """Return the mosaics of red, green and blue: Bayer's by its letters, others by name."""
    larger = [
        name for name, block in MOSAICS.items() if len(block) ** 2 > len(BAYER) and set("".join(block)) <= LETTERS
    ]
    return [BAYER, *larger]


def electronics() -> list[str]:
    """Return the named electronics that specify the range of the ADC, by group and title."""
    found = [name for name, preset in PRESETS.items() if preset.quantities or {*preset.parameters} >= RANGE]
    groups = list(dict.fromkeys(PRESETS[name].group for name in found))
    return sorted(found, key=lambda name: (groups.index(PRESETS[name].group), PRESETS[name].title))


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
    generator = check_choice("generator", message.generator, sizable())
    mosaic = message.filters
    if mosaic is not None:
        check_choice("filters", mosaic, mosaics())
    size_um = None if message.size_um is None else [check_length_um("size_um", each_um) for each_um in message.size_um]
    min_size_um = _min_size_um(session, message)
    max_sites = _max_sites(message)
    n_sites = message.n_sites
    if message.pixels_per_s is not None and (size_um is None or min_size_um is None):
        n_sites = n_sites or max_sites
    parameters, layout = sized(
        generator,
        templates(f"{generator} parameters"),
        size_um=size_um,
        n_sites=n_sites,
        min_size_um=min_size_um,
        max_sites=max_sites,
        generate=lambda given: _built(settings, {"generator": generator, "parameters": dict(given)}),
    )
    least_um = rounded_down(float(layout.size_um.min()), RULE_DIGITS)
    rules = {"min_size_um": least_um, "max_overlap_um2": 0.0}
    section = {"generator": generator, "parameters": parameters, "rules": rules}
    found = with_layout(without_gaze(settings), section)
    found["sensor"] = {
        **(found.get("sensor") or {}),
        "preset": check_choice("electronics", message.electronics, electronics()),
    }
    choose_electronics(found)
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
        wanted, least = (format_quantity(each_um, "µm", digits=3) for each_um in (size_um, least_um))
        raise SimulationError(
            f"{message.sites_per_deg:g} sites per degree require sites of {wanted} with this lens, smaller than the smallest "
            f"site of {least}: possible are {per_deg_um / least_um:.4g} sites per degree"
        )
    return size_um if least_um is None else least_um


def _max_sites(message: NewSensor) -> int:
    """Return the largest number of photosites, also for the data rate."""
    if message.pixels_per_s is None:
        return MAX_SITES
    frames_per_s = message.frames_per_s or FRAMES_PER_S
    most = max(1, int(min(message.pixels_per_s / frames_per_s, MAX_SITES)))
    if message.n_sites is not None and message.n_sites > most:
        raise SimulationError(
            f"{message.n_sites:,} photosites exceed the data rate: possible are {most:,} at {frames_per_s:g} frames/s, or "
            f"{message.pixels_per_s / message.n_sites:.3g} frames/s"
        )
    return most


def _built(settings: Mapping[str, Any], section: Mapping[str, Any]) -> Layout:
    """
    Return the layout of a section.

    Generators that read pictures are called with a shot, without filters.
    """
    found = generated_layout({"layout": section}, None)
    if found is not None:
        return found
    shot = {name: value for name, value in settings.items() if name not in ("sensor", "requirements")}
    return build_shot(None, {**shot, "layout": section}).camera.layout
