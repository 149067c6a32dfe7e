"""HTML of each kind of object."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import singledispatch
from typing import Any, cast

import numpy as np

from foveasim._core.quantities import format_quantity
from foveasim._core.short_repr import format_field
from foveasim._core.validation import unit_of
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap
from foveasim.layout import Layout, Report, Summary
from foveasim.optics import Optics
from foveasim.reconstruct import CorticalImage, Picture
from foveasim.scene import Scene
from foveasim.sensor import Sensor
from foveasim.view.notebook._blocks import Html, bar, escape, facts, panel, swatch, table
from foveasim.view.notebook._thumbnails import (
    THUMBNAIL_PIXELS,
    encode_png,
    report_thumbnail,
    site_thumbnail,
    thumbnail,
)
from foveasim.view.plots.rasters import cortical_pixels, picture_pixels, power_map_pixels, scene_pixels
from foveasim.view.plots.rules import RULE_COLOURS
from foveasim.view.site_colours import title_of

#: Longer side and largest size of the PNG of a picture.
PNG_PIXELS, MAX_PNG_BYTES = 640, 400_000


def to_html(item: Any) -> str:
    """
    Return an object as HTML for notebooks.

    Parameters
    ----------
    item : object
        A layout, capture, sensor, camera, scene, power map, picture, log-polar image, lens, summary, report of design rules,
        or a table: an object with the method ``records``.

    Returns
    -------
    html : str
        Self-contained, with a thumbnail of at most 60 kB; colours of text are those of the notebook.

    Raises
    ------
    ParameterError
        When the object is of another type.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.view.to_html(fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)).count("<table")
    1
    """
    return _to_html(item)


@singledispatch
def _to_html(item: Any) -> str:
    if not hasattr(item, "records"):
        raise ParameterError("item", "must be an object of foveasim with figures to show", item)
    records = item.records()
    headings = list(records[0]) if records else []
    return html_table(repr(item), [title_of(name) for name in headings], [list(row.values()) for row in records])


def html_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a titled table as HTML for notebooks."""
    return panel(title, table(headings, rows))


def to_png(picture: Picture) -> bytes:
    """
    Return a picture as a PNG file for notebooks.

    It has at most 640 x 640 pixels, and is transparent where no photosite lies.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    >>> picture = fs.reconstruct.cells(
    ...     layout, np.arange(16.0), fs.Grid.centred((8, 8), 1.0)
    ... )
    >>> fs.view.to_png(picture)[1:4]
    b'PNG'
    """
    return encode_png(picture_pixels(picture, PNG_PIXELS), MAX_PNG_BYTES)[0]


@_to_html.register
def _layout(layout: Layout) -> str:
    title = f"Layout of {layout.n_sites:,} photosites"
    return panel(title, site_thumbnail(layout, title), facts(_layout_facts(layout)))


def _layout_facts(layout: Layout) -> dict[str, object]:
    if not layout.n_sites:
        return {"columns": ", ".join(layout.columns)}
    x0, y0, x1, y1 = layout.bounds_um
    size_um = layout.size_um
    sizes = format_quantity([float(size_um.min()), float(size_um.max())], "µm")
    origin = layout.provenance.get("generator", layout.provenance.get("made_by", ""))
    parameters = layout.provenance.get("parameters", {})
    given = [f"{name}={format_field(value)}" for name, value in dict(parameters).items() if value is not None]
    rows: dict[str, object] = {
        "field": f"{x1 - x0:.6g} x {y1 - y0:.6g} µm",
        "site size": f"{sizes}, median {np.median(size_um):.4g} µm" if " to " in sizes else sizes,
        "area": format_quantity(float(layout.area_um2.sum()), "µm²"),
        "origin": f"{origin}({', '.join(given)})" if given else str(origin),
    }
    for name, heading in (("channel", "channels"), ("readout_line", "readout lines")):
        if name in layout.columns:
            rows[heading] = f"{np.unique(layout.columns[name]).size:,}"
    return rows | {"columns": ", ".join(layout.columns)}


@_to_html.register
def _capture(capture: Capture) -> str:
    title = f"Capture of {capture.layout.n_sites:,} photosites"
    rows: dict[str, object] = {}
    if capture.layout.n_sites:
        top = 2**capture.bits - 1
        rows = {
            "code": f"{capture.code.min():,} to {capture.code.max():,} of {top:,} DN, median {np.median(capture.code):,.0f} DN",
            "electrons": f"{capture.electrons.min():,} to {capture.electrons.max():,} e-, "
            f"median {np.median(capture.electrons):,.0f} e-",
            "saturated": f"{100.0 * capture.saturated_fraction:.3g} % of the photosites",
        }
    exposure_s, seed = capture.settings.get("exposure_s"), capture.settings.get("seed")
    rows |= {
        "filters": ", ".join(capture.filter_names),
        "exposure": format_quantity(exposure_s, "s") if isinstance(exposure_s, int | float) else "",
        "seed": "" if seed is None else seed,
    }
    return panel(title, site_thumbnail(capture, title), facts(rows))


@_to_html.register
def _sensor(sensor: Sensor) -> str:
    return panel(
        f"Sensor with {sensor.layout.n_sites:,} photosites", facts(_sensor_facts(sensor)), _effects_table(sensor)
    )


def _sensor_facts(sensor: Sensor) -> dict[str, object]:
    top = "" if sensor.full_well_e is None else f"{_describe('full_well_e', sensor.full_well_e)}"
    adc = sensor.adc
    return {
        "filters": ", ".join(sensor.filter_names),
        "quantum efficiency": format_field(sensor.qe),
        "sensitivity": "" if np.all(np.asarray(sensor.sensitivity) == 1.0) else _describe("", sensor.sensitivity),
        "capacitance": _describe("capacitance_f", sensor.node_f),
        "full well": top,
        "saturation voltage": format_quantity(sensor.v_sat_v, "V"),
        "pedestal": format_quantity(sensor.pedestal_v, "V") if sensor.pedestal_v else "",
        "ADC": f"{adc.bits} bits, {adc.companding}",
        "dark current": f"{_describe('dark_e_per_s', sensor.dark_e_per_s)} at {sensor.dark_reference_k:g} K"
        if np.any(sensor.dark_e_per_s)
        else "",
        "temperature": f"{sensor.temperature_k:g} K",
        "disabled": ", ".join(sensor.disabled),
        **_origin(sensor.provenance or {}),
    }


def _origin(provenance: Mapping[str, Any]) -> dict[str, object]:
    """Return rows with the origin of values."""
    titles = {"title": "published sensor", "source": "source", "assumptions": "assumptions", "replaced": "replaced"}
    found = {titles[name]: value for name, value in provenance.items() if name in titles}
    derived = [f"{name}: {how}" for name, how in dict(provenance.get("derived", {})).items()]
    rows = {**found, "derived": derived}
    return {name: "; ".join(map(str, value)) if isinstance(value, list) else value for name, value in rows.items()}


def _effects_table(sensor: Sensor) -> Html:
    rows = [
        (
            effect.name,
            effect.stage.replace("_", " "),
            "temporal" if effect.is_temporal else "fixed",
            _parameters(effect),
        )
        for effect in sensor.chain
    ]
    return table(("effect", "stage", "kind", "parameters"), rows)


def _parameters(effect: Any) -> str:
    """Return the parameters of an effect with their units."""
    if not is_dataclass(effect):
        return ""
    shown = [(f.name, getattr(effect, f.name)) for f in fields(effect) if not f.name.startswith("_")]
    return ", ".join(f"{name} = {_describe(name, value)}" for name, value in shown if value is not None)


def _describe(name: str, value: Any) -> str:
    """Return a value, or the range of the values per site, with the unit of its name."""
    unit = unit_of(name)
    if isinstance(value, np.ndarray) and value.size > 1 and value.dtype.kind in "iuf":
        return format_quantity([float(value.min()), float(value.max())], unit)
    if isinstance(value, float | np.floating | np.ndarray) and np.size(value) == 1:
        return format_quantity(float(np.asarray(value).item()), unit, digits=6)
    text = format_field(value)
    return f"{text} {unit}" if unit else text


@_to_html.register
def _optics(optics: Optics) -> str:
    return panel(f"Optics of {optics.focal_length_mm:g} mm, f/{optics.f_number:g}", facts(_given_parameters(optics)))


def _given_parameters(item: Any) -> Iterable[tuple[str, str]]:
    """Yield names and values of the fields of a dataclass that are not defaults."""
    for f in fields(item):
        if f.name.startswith("_"):
            continue
        value = getattr(item, f.name)
        if f.default is MISSING or (value is not f.default and value != f.default):
            yield title_of(f.name).partition(" / ")[0], _describe(f.name, value)


@_to_html.register
def _camera(camera: Camera) -> str:
    sensor, optics = camera.sensor, camera.optics
    layout = cast("Layout", sensor.layout)  # checked by Camera
    title = f"Camera of {sensor.layout.n_sites:,} photosites, {optics.focal_length_mm:g} mm, f/{optics.f_number:g}"
    rows = {
        **dict(_given_parameters(optics)),
        "distortion": "none" if camera.distortion is None else format_field(camera.distortion),
        **{name: value for name, value in _layout_facts(layout).items() if name in ("field", "site size")},
        **_sensor_facts(sensor),
    }
    return panel(title, site_thumbnail(layout, title), facts(rows), _effects_table(sensor))


@_to_html.register
def _scene(scene: Scene) -> str:
    n_basis, n_y, n_x = scene.basis.shape
    title = f"Scene of {n_x:,} x {n_y:,} pixels"
    waves_nm = scene.wavelength_nm
    if scene.pitch_um is None:
        size = {"framing": f"fit='{scene.fit}', on the layout of a camera", "distance": f"{scene.distance_m:g} m"}
    else:
        width_mm, height_mm = 1e-3 * n_x * scene.pitch_um, 1e-3 * n_y * scene.pitch_um
        size = {
            "size": f"{width_mm:.6g} x {height_mm:.6g} mm at {scene.distance_m:g} m",
            "pixel pitch": f"{scene.pitch_um:g} µm",
        }
    rows = size | {
        "wavelengths": ", ".join(f"{nm:g}" for nm in waves_nm) + " nm"
        if waves_nm.size <= 4
        else f"{waves_nm.size} from {waves_nm.min():g} to {waves_nm.max():g} nm",
        "basis images": n_basis,
        "source": scene.source,
    }
    return panel(title, thumbnail(scene_pixels(scene, THUMBNAIL_PIXELS), title), facts(rows))


@_to_html.register
def _power_map(power_map: PowerMap) -> str:
    n_bands, n_y, n_x = power_map.data.shape
    title = f"Power map of {n_x:,} x {n_y:,} cells"
    grid, waves_nm = power_map.grid, power_map.wavelength_nm
    x0, y0, x1, y1 = grid.bounds_um
    rows = {
        "irradiance": f"{power_map.data.min():.4g} to {power_map.data.max():.4g} W/m² per band",
        "wavelengths": f"{waves_nm[0]:g} nm"
        if n_bands == 1
        else f"{n_bands} from {waves_nm.min():g} to {waves_nm.max():g} nm",
        "field": f"{x1 - x0:.6g} x {y1 - y0:.6g} µm, from ({x0:.6g}, {y0:.6g}) to ({x1:.6g}, {y1:.6g})",
        "cells": f"{grid.pitch_x_um:.4g} x {grid.pitch_y_um:.4g} µm",
    }
    return panel(title, thumbnail(power_map_pixels(power_map, THUMBNAIL_PIXELS), title), facts(rows))


@_to_html.register
def _picture(picture: Picture) -> str:
    n_y, n_x = picture.coverage.shape
    return panel(
        repr(picture), thumbnail(picture_pixels(picture, THUMBNAIL_PIXELS), f"Picture of {n_x} x {n_y} pixels")
    )


@_to_html.register
def _cortical_image(image: CorticalImage) -> str:
    n_channels, n_rings, n_sectors = image.data.shape
    title = f"Log-polar image of {n_rings:,} rings and {n_sectors:,} sectors"
    values = image.data[np.isfinite(image.data)]
    x_um, y_um = image.centre_um
    rows = {
        "values": f"{values.min():.4g} to {values.max():.4g}" if values.size else "none",
        "channels": f"{n_channels}",
        "radii": f"{image.radius_um[0]:.4g} to {image.radius_um[-1]:.4g} µm",
        "centre": f"({round(x_um, 6) + 0.0:g}, {round(y_um, 6) + 0.0:g}) µm",
        "pixels": "resampled" if image.sites is None else "one per photosite",
    }
    pixels = thumbnail(
        cortical_pixels(image, THUMBNAIL_PIXELS), title, "angles from 0 to 360° along x, outermost ring at the top"
    )
    return panel(title, pixels, facts(rows))


@_to_html.register
def _report(report: Report) -> str:
    title = f"Design rules on {report.n_sites:,} photosites: {'satisfied' if report.ok else 'violated'}"
    colours = iter(RULE_COLOURS * (1 + len(report.results) // len(RULE_COLOURS)))
    rows = []
    for result in report.results:
        mark = swatch(next(colours)) if len(result) else Html()
        verdict = (
            "satisfied" if not len(result) else "violated" if result.waiver is None else f"waived: {result.waiver}"
        )
        worst = "" if result.worst is None else f"{result.worst:.6g} {result.unit}"
        limit = f"{result.limit:g} {result.unit}"
        rows.append((Html(mark + escape(result.rule)), verdict, len(result), worst, limit))
    return panel(
        title,
        report_thumbnail(report, title),
        table(("rule", "verdict", "violations", "worst", "limit"), rows),
    )


@_to_html.register
def _summary(summary: Summary) -> str:
    largest = max((int(n) for n in summary.size_counts), default=0) or 1
    sizes = [(r["from_um"], r["to_um"], r["n_sites"], bar(r["n_sites"] / largest)) for r in summary.records()]
    return panel(
        f"Layout of {summary.n_sites:,} photosites",
        facts([row for row in summary.rows() if row[0] != "photosites"]),
        table(("from / µm", "to / µm", "photosites", ""), sizes),
    )
