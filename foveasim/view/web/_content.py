"""Data of a page: description, arrays and picture of a layout, a capture and a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.quantities import format_quantity
from foveasim._core.rings import same_rings
from foveasim._core.validation import words_and_unit
from foveasim.capture import Capture
from foveasim.columns import COLUMNS, MAIN, STORED, ColumnInfo, column_info, compute_column
from foveasim.errors import GeometryError, ParameterError, SimulationError, type_name
from foveasim.fields import PowerMap
from foveasim.layout import Layout, Report
from foveasim.sensor import Sensor
from foveasim.view.site_colours import (
    CATEGORY_COLOURS,
    DISPLAY_GAMMA,
    FILTER_COLOURS,
    NO_DATA,
    Rgb,
    colours_of,
    encode_light,
)
from foveasim.view.site_pictures import site_picture
from foveasim.view.web._pack import back_references, to_smallest_type
from foveasim.view.web._shapes import Shapes, shapes_of

#: Longer side of the picture.
PICTURE_PIXELS = 800
#: Fraction of the cells of an optical image that are not brighter than white.
WHITE_QUANTILE = 0.995
#: Largest number of listed violations per rule, the worst first.
MAX_LISTED = 2000
#: Larger integers are written as strings: numbers in JavaScript are float64.
MAX_EXACT = 2**53
#: Channel names of a layout without filters.
CHANNEL_NAMES = "RGBW"


def _hex(colour: Rgb) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


#: Colours of categories and of photosites without value, and the exponent of grey levels.
PALETTE = {"kinds": [_hex(colour) for colour in CATEGORY_COLOURS], "no_data": _hex(NO_DATA), "gamma": DISPLAY_GAMMA}


@dataclass(frozen=True, eq=False)
class Content:
    """
    Data of a page.

    Attributes
    ----------
    about : mapping
        Plain data for JSON: number of sites, columns, rules, position of the picture.
    arrays : mapping of str to array
        Arrays by their names in ``about``.
    picture_png : bytes
        Picture of the capture or of the sites of a layout, or the optical image.
    picture_alt : str
        Its description.
    """

    about: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    picture_png: bytes
    picture_alt: str


def content_of(
    data: Layout | Capture,
    report: Report | None = None,
    *,
    second: Capture | None = None,
    optical_image: PowerMap | None = None,
    name: str = "",
) -> Content:
    """
    Return the data of a page.

    ``report``: check of the same layout. ``second``: capture of the same layout, for comparison. ``optical_image``: shown
    instead of the picture of the capture or the layout. ``name``: heading; by default the generator of the layout. Raises
    ParameterError when the data is neither, or the report or the second capture is of another layout. Raises GeometryError
    when the layout has no sites.
    """
    from PIL import Image

    about, arrays, layout = describe_sites(data, name=name)
    if report is not None and not isinstance(report, Report):
        raise ParameterError("report", f"must be a Report of a check, got {type_name(report)}")
    if report is not None and report.n_sites != layout.n_sites:
        raise ParameterError(
            "report", f"must be a check of this layout of {layout.n_sites:,} sites, got one of {report.n_sites:,}"
        )
    if second is not None:
        about["columns"] += _second_columns(layout, second, arrays)
    arrays |= outlines_of(shapes_of(layout))
    alt = "Picture of the capture" if isinstance(data, Capture) else "Photosites of the layout"
    if optical_image is None:
        pixels, bounds_um = _picture(layout, data if isinstance(data, Capture) else None)
    else:
        pixels, bounds_um = _optical_picture(optical_image)
        about["picture_name"] = alt = "Optical image"
    file = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, "PNG")
    position = {"bounds_um": bounds_um, "width": pixels.shape[1], "height": pixels.shape[0]}
    rules = [] if report is None else rules_of(report, arrays)
    return Content({**about, "picture": position, "rules": rules}, arrays, file.getvalue(), alt)


def describe_sites(
    data: Layout | Capture, *, name: str = "", sensor: Sensor | None = None, has_signals: bool = True
) -> tuple[dict[str, Any], dict[str, NDArray[Any]], Layout]:
    """
    Return the data of photosites for all kinds of pages.

    ``name``: heading; by default the generator of the layout. ``sensor``: the sensor of the capture, as for
    :meth:`foveasim.Capture.signal_to_noise`. ``has_signals``: whether the arrays contain those of :func:`signals_of`. Returns
    ``about``: heading, notes, number of sites, bounds, columns, palette. ``arrays``: arrays of the columns. Raises
    ParameterError, GeometryError as for :func:`content_of`.
    """
    if not isinstance(data, Layout | Capture):
        raise ParameterError("data", f"must be a Layout or a Capture, got {type_name(data)}")
    capture = data if isinstance(data, Capture) else None
    layout = data.layout if isinstance(data, Capture) else data
    if layout.n_sites == 0:
        raise GeometryError("the layout has no sites; a page needs at least one")
    arrays: dict[str, NDArray[Any]] = {}
    columns = _columns(layout, capture, arrays, sensor, has_signals=has_signals)
    provenance = layout.provenance
    origin = str(provenance.get("generator", provenance.get("made_by", "polygons"))).replace("_", " ")
    about = {
        "name": name or origin,
        "kind": "layout" if capture is None else "capture",
        "notes": _notes(layout, capture, origin),
        "n_sites": layout.n_sites,
        "bounds_um": layout.bounds_um,
        "columns": columns,
        "filter": next((column["array"] for column in columns if column["key"] == "channel"), None),
        "palette": PALETTE,
    }
    return about, arrays, layout


# -- outlines -----------------------------------------------------------------------------------------------------------


def outlines_of(shapes: Shapes) -> dict[str, NDArray[Any]]:
    """Return the arrays of the outlines and triangles of photosites."""
    arrays = {
        "xy_um": shapes.xy_um,
        "position": to_smallest_type(back_references(shapes.position)),
        "ring_sizes": to_smallest_type(np.diff(shapes.ring_offsets)),
        "cut_sites": shapes.cut_sites.astype(np.uint32),
        "cut_counts": to_smallest_type(np.diff(shapes.cut_offsets)),
        "cuts": shapes.cuts.astype(np.uint32).reshape(-1),
    }
    n_rings = np.diff(shapes.site_offsets)
    if n_rings.max() > 1:
        arrays["site_rings"] = to_smallest_type(n_rings)
    return arrays


# -- columns ------------------------------------------------------------------------------------------------------------


def _signals() -> dict[str, ColumnInfo]:
    """Return the columns of captures that take time to compute and to send, by key."""
    infos = {key: column_info(key) for key in COLUMNS if key != MAIN}
    return {key: info for key, info in infos.items() if info.on_pages}


def signals_of(capture: Capture, sensor: Sensor | None) -> dict[str, NDArray[Any]]:
    """Return the values of :func:`_signals`, by key."""
    found = {key: _signal(capture, key, sensor) for key in _signals()}
    return {key: to_smallest_type(values) for key, values in found.items() if values is not None}


def _signal(capture: Capture, key: str, sensor: Sensor | None) -> NDArray[Any] | None:
    """Return a column of a capture; None if its settings lack what this requires."""
    try:
        values = compute_column(key, capture, sensor)
    except (ParameterError, SimulationError):
        return None
    return values.astype(np.float32) if key not in STORED and values.dtype.kind == "f" else values


def _columns(
    layout: Layout,
    capture: Capture | None,
    arrays: dict[str, NDArray[Any]],
    sensor: Sensor | None = None,
    *,
    has_signals: bool = True,
) -> list[dict[str, Any]]:
    """Return the columns of a page in list order: label, unit, and type of colour scale."""
    columns: list[dict[str, Any]] = []

    def add(key: str, label: str, unit: str, values: NDArray[Any], kind: str | None = None, **more: Any) -> str:
        name = f"column-{len(arrays)}"
        metadata, numbers = _as_numbers(values)
        arrays[name] = numbers
        # Numerical columns with few values have a scale too; only strings and columns passed with names are categories.
        kind = kind or ("kinds" if "names" in metadata else "linear")
        columns.append({"key": key, "label": label, "unit": unit, "array": name, "kind": kind, **metadata, **more})
        return name

    if capture is not None:
        colours = [_filter_colour(k, name) for k, name in enumerate(capture.filter_names)]
        main = column_info(MAIN)
        code = add(MAIN, main.title, main.unit, capture.code, "grey")
        if len(colours) > 1:
            lit = {**columns[0], "key": "picture", "label": "colour mosaic", "kind": "lit", "colours": colours}
            columns.insert(0, {**lit, "array": code, "is_repeat": True})
        for key, info in _signals().items():
            more = {"note": info.note} if info.note else {}
            if not has_signals:
                heading = {"key": key, "label": info.title, "unit": info.unit}
                columns.append({**heading, "kind": "linear", "is_signal": True, **more})
            elif (values := _signal(capture, key, sensor)) is not None:
                add(key, info.title, info.unit, values, **more)
        if len(colours) > 1:
            names = list(capture.filter_names)
            add("channel", "filter", "", capture.filter_of_site, "kinds", names=names, colours=colours)
    elif "channel" in layout.columns and _is_index(layout.columns["channel"]):
        n_channels = int(layout.channel.max()) + 1
        letters = list(CHANNEL_NAMES[:n_channels]) if n_channels in (3, 4) else [str(k) for k in range(n_channels)]
        colours = [_filter_colour(k, name) for k, name in enumerate(letters)]
        add("channel", "channel", "", layout.channel, "kinds", names=letters, colours=colours)
    columns.append({"key": "size_um", "label": "site size", "unit": "µm", "kind": "linear", "of": "size"})
    columns.append({"key": "area_um2", "label": "area", "unit": "µm²", "kind": "linear", "of": "area"})
    taken = {column["key"] for column in columns}
    for key in sorted(layout.columns, key=lambda name: name != "readout_line"):
        if key not in taken:
            label, unit = words_and_unit(key)
            values = layout.columns[key]
            add(key, label, unit, values.astype(str) if _is_categorical(values) and not unit else values)
    return columns


def _second_columns(layout: Layout, second: Capture, arrays: dict[str, NDArray[Any]]) -> list[dict[str, Any]]:
    """Return the measured columns of a second capture, and add their arrays."""
    if not isinstance(second, Capture):
        raise ParameterError("second", f"must be a Capture, got {type_name(second)}")
    if not same_rings(layout, second.layout):
        raise ParameterError(
            "second",
            f"must be a capture of this layout of {layout.n_sites:,} sites, got one of {second.layout.n_sites:,} sites",
        )
    own: dict[str, NDArray[Any]] = {}
    of_capture = {"picture", MAIN, *_signals()}
    measured = [column for column in _columns(layout, second, own) if column["key"] in of_capture]
    arrays |= {f"second-{column['array']}": own[column["array"]] for column in measured}
    return [
        {
            **column,
            "key": f"second-{column['key']}",
            "label": f"second {column['label']}",
            "array": f"second-{column['array']}",
        }
        for column in measured
    ]


def _is_index(values: NDArray[Any]) -> bool:
    return values.dtype.kind in "iu" and int(values.min(initial=0)) >= 0 and int(values.max(initial=0)) < 256


def _is_categorical(values: NDArray[Any]) -> bool:
    """Return whether integers have few distinct values and are categories, such as zones."""
    if values.dtype.kind not in "iu":
        return False
    # The range is checked first: np.unique is slow for a million different numbers.
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    return high - low < 2**16 and np.unique(values).size <= len(CATEGORY_COLOURS)


def _as_numbers(values: NDArray[Any]) -> tuple[dict[str, Any], NDArray[Any]]:
    """Return metadata of a column, and its values as numbers that are exact in JavaScript."""
    if values.dtype.kind == "b":
        return {"names": ["no", "yes"], "is_integer": True}, values.astype(np.uint8)
    if values.dtype.kind in "iu" and (values.max(initial=0) <= MAX_EXACT and values.min(initial=0) >= -MAX_EXACT):
        return {"is_integer": True}, to_smallest_type(values)
    if values.dtype.kind == "f":
        return {}, to_smallest_type(values)
    if values.dtype.kind == "c":
        values = values.astype(str)
    names, kinds = np.unique(values, return_inverse=True)
    strings = [name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name) for name in names]
    return {"names": strings, "is_integer": True}, to_smallest_type(kinds)


def _filter_colour(position: int, name: str) -> str:
    return _hex(FILTER_COLOURS.get(name, CATEGORY_COLOURS[position % len(CATEGORY_COLOURS)]))


# -- picture, rules, notes ----------------------------------------------------------------------------------------------


def _picture(layout: Layout, capture: Capture | None) -> tuple[NDArray[np.uint8], tuple[float, ...]]:
    """
    Return the picture, top row first, and its bounds.

    For a layout, the picture shows the sites in the colours of their channels or sizes.
    """
    if capture is not None:
        picture = capture.picture(max_pixels=PICTURE_PIXELS)
        pixels = picture.to_image(capture.white_dn)
        bounds_um = picture.grid.bounds_um
    else:
        x_min, y_min, x_max, y_max = layout.bounds_um
        bounds_um = layout.bounds_um
        pixel_um = max(x_max - x_min, y_max - y_min) / PICTURE_PIXELS
        shape = (max(1, round((y_max - y_min) / pixel_um)), max(1, round((x_max - x_min) / pixel_um)))
        by = "channel" if "channel" in layout.columns and _is_index(layout.columns["channel"]) else "size_um"
        pixels = site_picture(layout, colours_of(layout, by), shape)[::-1]
    return np.asarray(pixels, np.uint8), bounds_um


def _optical_picture(power_map: PowerMap) -> tuple[NDArray[np.uint8], tuple[float, ...]]:
    """
    Return the optical image as a picture, top row first, and its bounds.

    Three bands are shown as red, green and blue by their wavelengths, others by their sum.
    """
    if not isinstance(power_map, PowerMap):
        raise ParameterError("optical_image", f"must be a PowerMap, got {type_name(power_map)}")
    # Means of blocks of cells; incomplete blocks at the upper and right end are cropped.
    n_bands, n_y, n_x = power_map.data.shape
    block = max(1, -(-max(n_y, n_x) // PICTURE_PIXELS))
    rows, columns = n_y // block, n_x // block
    cells = power_map.data[:, : rows * block, : columns * block].reshape(n_bands, rows, block, columns, block)
    light = cells.mean(axis=(2, 4), dtype=np.float64)
    light = light[np.argsort(-power_map.wavelength_nm)] if n_bands == 3 else light.sum(axis=0, keepdims=True)
    white = np.quantile(light, WHITE_QUANTILE)
    x_min, y_min, _, _ = power_map.grid.bounds_um
    width_um, height_um = columns * block * power_map.grid.pitch_x_um, rows * block * power_map.grid.pitch_y_um
    pixels = encode_light(np.broadcast_to(np.moveaxis(light / (white or 1.0), 0, -1), (rows, columns, 3)))[::-1]
    return pixels, (x_min, y_min, x_min + width_um, y_min + height_um)


def rules_of(report: Report, arrays: dict[str, NDArray[Any]]) -> list[dict[str, Any]]:
    """Return rules and results; add the worst violations to arrays, rule by rule."""
    rules = []
    values: list[float] = []
    sites: list[tuple[int, ...]] = []
    markers: list[Any] = []
    for result in report.results:
        listed = result.violations[:MAX_LISTED]
        values += [violation.value for violation in listed]
        sites += [violation.site_ids for violation in listed]
        markers += [violation.marker for violation in listed]
        rules.append({
            "name": result.rule, "description": "; ".join(filter(None, (result.description, result.note))),
            "limit": _finite(result.limit), "unit": result.unit,
            "count": len(result), "listed": len(listed), "waiver": result.waiver,
        })  # fmt: skip
    parts, owner = shapely.get_parts(np.array(markers, dtype=object), return_index=True)
    rings, part_of_ring = _outlines_of_parts(parts)
    points_um, ring_of_point = shapely.get_coordinates(rings, return_index=True)
    n_parts = np.bincount(owner[part_of_ring], minlength=len(markers)) if len(markers) else np.zeros(0, np.int64)
    arrays["violation_value"] = np.array(values, dtype=np.float64)
    arrays["violation_sites"] = np.array([site for ids in sites for site in ids], dtype=np.uint32)
    arrays["violation_site_counts"] = to_smallest_type(np.array([len(ids) for ids in sites], dtype=np.int64))
    arrays["marker_part_counts"] = to_smallest_type(n_parts)
    arrays["marker_sizes"] = to_smallest_type(np.bincount(ring_of_point, minlength=len(rings)))
    arrays["marker_xy_um"] = points_um
    return rules


def _outlines_of_parts(parts: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """
    Return the lines of marker parts, and the part of each line.

    Rings of polygons are closed; lines and points are unchanged.
    """
    is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    rings, of_polygon = shapely.get_rings(parts[is_polygon], return_index=True)
    lines = np.concatenate((rings, parts[~is_polygon]))
    part = np.concatenate((np.flatnonzero(is_polygon)[of_polygon], np.flatnonzero(~is_polygon)))
    order = np.argsort(part, kind="stable")
    return lines[order], part[order].astype(np.int64)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _notes(layout: Layout, capture: Capture | None, origin: str) -> list[str]:
    x_min, y_min, x_max, y_max = layout.bounds_um
    notes = [
        f"{layout.n_sites:,} photosites",
        f"{x_max - x_min:.5g} × {y_max - y_min:.5g} µm",
        origin.replace("_", " "),
    ]
    if capture is not None:
        notes.append(f"{capture.bits} bits")
        exposure_s = capture.settings.get("exposure_s")
        if isinstance(exposure_s, int | float):
            notes.append(format_quantity(exposure_s, "s"))
        notes.append(f"{100 * capture.saturated_fraction:.3g} % saturated")
    return notes
