"""Sensors of a twin: the camera itself, or one of its kind with other photosites."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.validation import Floats, Ints
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.sensor import ConstantCurve, FilterSet, Sensor
from foveasim.sensor.effects.measured import ColumnNoise, OffsetMap, ResponseMap, RowNoise, TelegraphMap
from foveasim.sensor.published.datasheet import SWING_V
from foveasim.sensor.published.presets import with_changes
from foveasim.units import ELEMENTARY_CHARGE_C

if TYPE_CHECKING:
    from foveasim.twin.frames.result import Twin

__all__ = ["PATTERNS", "sensor_of"]

#: Probability of RTS noise above which a pixel has it.
MIN_PROBABILITY = 0.5
#: Distance from a pixel, and difference of area, relative to it, up to which a site is the pixel: files round to a grid.
SAME_PIXEL = 0.01
#: Names of the filters of a mosaic, in the order of its channels.
COLOURS = "RGB"
#: Statistics of the pixels that each map contains: a value that is given instead replaces the map.
STATISTICS: Mapping[str, tuple[str, ...]] = {
    "response_fraction": ("prnu_fraction", "dead_fraction"),
    "offset_e": ("dsnu_e", "pixel_fpn_fraction", "line_fpn_fraction"),
    "dark_e_per_s": ("dark_e_per_s", "dsnu_fraction", "hot_fraction", "hot_e_per_s"),
    "rts_probability": ("rts_fraction", "rts_e"),
}
#: Parameters of random patterns.
PATTERNS = frozenset((*(name for names in STATISTICS.values() for name in names), "dnl_dn"))


def sensor_of(twin: Twin, layout: Layout | None, maps: bool | None, parameters: Mapping[str, Any]) -> Sensor:
    """Return a sensor; see :meth:`foveasim.twin.Twin.sensor`."""
    sites = twin.layout() if layout is None else layout
    Sensor(sites)  # checks the layout
    pixels = _pixels_of(twin, sites, is_own=layout is None) if maps is not False else None
    if maps and pixels is None:
        raise ParameterError("maps", "must be False for other photosites than the pixels of the camera", maps)
    scale: Floats | float = 1.0 if pixels is not None else np.asarray(sites.area_um2) / twin.pixel_um**2
    n_codes = 2 ** int(twin.known["bits"])
    found: dict[str, Any] = {name: value for name, value in twin.known.items() if name != "mosaic"}
    found |= {
        "v_sat_v": SWING_V,
        "capacitance_f": n_codes * ELEMENTARY_CHARGE_C / (twin.value("gain_dn_per_e") * SWING_V) * scale,
        "pedestal_v": SWING_V * max(twin.value("black_level_dn") + 0.5, 0.0) / n_codes,
        "read_noise_e": twin.value("read_noise_e"),
        "nonlinearity_fraction": twin.value("nonlinearity_fraction"),
    }
    if "dnl_dn" in twin.estimates and twin.estimates["dnl_dn"].low > 0.0:
        found["dnl_dn"] = twin.value("dnl_dn")
    if "full_well_e" in twin.estimates:
        found["full_well_e"] = twin.value("full_well_e") * scale
    if twin.temperature_k is not None:
        found["temperature_k"] = found["dark_reference_k"] = twin.temperature_k
    if "dark_doubling_k" in twin.estimates:
        found["dark_doubling_k"] = twin.value("dark_doubling_k")
    if efficiencies := [each.value for name, each in twin.estimates.items() if name.startswith("qe")]:
        found["qe"] = min(max(efficiencies), 1.0)
    if twin.known.get("mosaic") and "channel" in sites.columns:
        found["filters"] = _neutral_filters(twin)
    found |= _statistics(twin, sites, scale)
    effects: list[Any] = []
    if pixels is not None:
        effects = _put_maps(twin, pixels, found, parameters)
    effects += _noise_of_lines(twin, sites)
    given = parameters.get("effects", ())
    if isinstance(given, list | tuple):
        names = {getattr(each, "name", None) for each in given}
        given = [*(each for each in effects if each.name not in names), *given]
    found["provenance"] = {
        "source": f"frames of {twin.shape[1]} x {twin.shape[0]} pixels of {twin.pixel_um:g} µm",
        "assumptions": [*twin.assumptions, *_assumptions(twin, sites, found, parameters, has_maps=pixels is not None)],
    }
    return Sensor(
        sites,
        **with_changes(found, {**parameters, "effects": given}),
    )


def _pixels_of(twin: Twin, sites: Layout, *, is_own: bool) -> Ints | None:
    """Return the pixel of each site, (n_site,); None unless the sites are the pixels."""
    n_y, n_x = twin.shape
    if is_own:  # the last row of frames first
        return np.arange(n_y * n_x).reshape(n_y, n_x)[::-1].ravel()
    if sites.n_sites != n_y * n_x or np.ptp(sites.area_um2 / twin.pixel_um**2 - 1.0) > SAME_PIXEL:
        return None
    xy = np.asarray(sites.centroid_um) / twin.pixel_um
    column, row = (xy - xy.mean(axis=0) + (0.5 * (n_x - 1), 0.5 * (n_y - 1))).T
    index = np.rint(column), n_y - 1 - np.rint(row)
    is_near = np.abs(column - index[0]).max() < SAME_PIXEL and np.abs(row - np.rint(row)).max() < SAME_PIXEL
    if not is_near or abs(float(np.mean(sites.area_um2)) / twin.pixel_um**2 - 1.0) > SAME_PIXEL:
        return None
    pixels = (index[1] * n_x + index[0]).astype(np.int64)
    return pixels if np.array_equal(np.sort(pixels), np.arange(n_y * n_x)) else None


def _statistics(twin: Twin, sites: Layout, scale: Floats | float) -> dict[str, Any]:
    """Return the parameters of random patterns."""
    names = (
        "prnu_fraction", "dsnu_e", "dsnu_fraction", "hot_fraction", "hot_e_per_s", "dead_fraction", "rts_fraction", "rts_e",
    )  # fmt: skip
    found: dict[str, Any] = {name: twin.value(name) for name in names if name in twin.estimates}
    if "dark_e_per_s" in twin.estimates:
        found["dark_e_per_s"] = max(twin.value("dark_e_per_s"), 0.0) * scale
    if "readout_line" in sites.columns:
        n_codes = 2 ** int(twin.known["bits"])
        found["line_fpn_fraction"] = twin.value("dsnu_column_e") * twin.value("gain_dn_per_e") / n_codes
    return found


def _put_maps(twin: Twin, pixels: Ints, found: dict[str, Any], parameters: Mapping[str, Any]) -> list[Any]:
    """Return the effects of maps, which replace statistics unless these are given."""

    def of_sites(name: str) -> Floats:
        return np.ascontiguousarray(twin.maps[name].ravel()[pixels])

    effects: list[Any] = []
    for name, statistics in STATISTICS.items():
        if name not in twin.maps or any(parameters.get(each) is not None for each in statistics):
            continue
        for each in statistics:
            found.pop(each, None)
        match name:
            case "response_fraction":
                effects.append(ResponseMap(of_sites(name)))
            case "offset_e":
                effects.append(OffsetMap(of_sites(name)))
            case "rts_probability":
                effects.append(TelegraphMap(np.where(of_sites(name) > MIN_PROBABILITY, twin.value("rts_e"), 0.0)))
            case _:
                found[name] = np.maximum(of_sites(name), 0.0)
    return effects


def _noise_of_lines(twin: Twin, sites: Layout) -> list[Any]:
    """Return the temporal noise of rows and columns, for layouts that have them."""
    kinds = {"row": RowNoise, "column": ColumnNoise}
    return [kinds[name](twin.value(f"{name}_noise_e")) for name in _noisy_lines(twin) if name in sites.columns]


def _noisy_lines(twin: Twin) -> list[str]:
    noise = {name: twin.estimates.get(f"{name}_noise_e") for name in ("row", "column")}
    return [name for name, each in noise.items() if each is not None and each.low > 0.0]


def _neutral_filters(twin: Twin) -> FilterSet:
    """Return filters without spectral curves, with the responses of the colours to the lamp."""
    light_e = np.zeros(len(twin.known["mosaic"]))
    stacks: dict[str, dict[int, float]] = {}
    for row in twin.levels:
        stacks.setdefault(str(row["stack"]), {})[int(row["class"])] = float(row["light_e"])
    for stack in stacks.values():
        if len(stack) == light_e.size:  # the brightest colours of others are saturated
            light_e += [stack[k] for k in range(light_e.size)]
    letters = np.array(list(twin.known["mosaic"]))
    means = np.array([light_e[letters == letter].mean() for letter in COLOURS])
    ratios = means / means.max() if means.max() > 0.0 else np.ones(len(COLOURS))
    return FilterSet(tuple(ConstantCurve(float(ratio)) for ratio in np.clip(ratios, 0.0, 1.0)), tuple(COLOURS))


def _assumptions(
    twin: Twin, sites: Layout, found: Mapping[str, Any], parameters: Mapping[str, Any], *, has_maps: bool
) -> list[str]:
    """Return what a sensor takes as known."""
    lines = [
        "Fixed patterns are maps of the pixels."
        if has_maps
        else "Fixed patterns are random, with the statistics of the pixels."
    ]
    if "qe" not in found and "qe" not in parameters:
        lines.append("The quantum efficiency is 1: stacks have no photons.")
    if "filters" in found and "filters" not in parameters:
        lines.append(
            "The filters are neutral, with the responses of the colours to the lamp; give filters for colours."
        )
    lines += [
        f"The {name} noise is omitted: the layout has no column '{name}'."
        for name in _noisy_lines(twin)
        if name not in sites.columns
    ]
    return lines
