"""
GDSII and OASIS files, through gdstk.

A photosite is a polygon on one layer. By default its channel is the datatype; a layer map specifies the layers of outlines,
colour filters and derived shapes, and the channel is then a column. The number of a photosite is a property, which preserves
the order in programs that sort shapes: attribute 1 with the string ``photosite 17`` in GDSII, the property ``photosite`` in
OASIS. Coordinates are integer multiples of the database unit. Neither format has holes, and a GDSII polygon has at most 8,190
vertices including the closing one. Sites with holes or more vertices are written as several polygons (``photosite 17 part
1 of 3``) that share edges and add no vertex; reading merges them exactly.

The other columns are a second property: attribute 2 with the string ``ring=3 gain=0.25 is_dead=true name="a"`` in GDSII,
the property ``columns`` with alternating names and values in OASIS. Integers are read as int64 (uint64 where required),
other numbers as float64, bit for bit. A column with values that do not fit for some site is dropped for all sites, and
reported: the properties of a GDSII polygon contain at most 128 bytes, and gdstk is very slow for a large number of distinct
strings in OASIS. A column without a value for every photosite of a file is not read.

Sites that their rounded outlines do not identify (:func:`foveasim._core.rings.site_ids`) have the column ``site_id``, so that
sensors of the layout that is read have the same fixed patterns.

Regular arrays of congruent sites are references to a cell, with the numbers of their sites as a property: ``photosites
0+1i+640j of 640x480`` in GDSII, the list (0, 1, 640, 640, 480) in OASIS. Their columns are functions of the column i and the
row j of a site in the array, such as ``row=0+1j``. An array that another program has changed to another number of columns or
rows is read without numbers and columns.

References: Calma, GDSII Stream Format Manual 6.0 (1987); SEMI P39, OASIS.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import chain, compress, repeat
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.rings import SITE_ID, positions_in_runs, site_ids
from foveasim._core.validation import MAX_SITES, Floats, Ints
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat
from foveasim.errors import GeometryError, LayoutWarning, ParameterError, warn
from foveasim.layout.database_grid import DEFAULT_DBU_UM, has_valid_outlines, on_grid, to_um
from foveasim.layout.files._columns import (
    CHANNEL,
    column_strings,
    linear_text,
    storable_columns,
)
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_readable,
    rounding_report,
)
from foveasim.layout.files._derived import shapes_of_layout, shapes_of_sites
from foveasim.layout.files._hierarchy import Arrays, concatenate, congruence_classes, find_arrays, single_sites
from foveasim.layout.files._holes import hole_free_rings
from foveasim.layout.files._layers import (
    MAX_LAYER,
    PHOTOSITE,
    DrawnLayer,
    parse_layer,
    parse_layer_map,
)
from foveasim.layout.files._oasis_records import END, OASIS_END_BYTES, OASIS_MAGIC
from foveasim.layout.files._reading import read
from foveasim.layout.model import Layout, layout_of

__all__ = ["GDS_MAGIC", "OASIS_MAGIC", "read", "write"]

GDS_MAGIC = b"\x00\x06\x00\x02"

#: A larger displacement of a vertex by rounding causes a warning; the default database unit displaces by at most 0.71 nm.
ROUNDING_TOLERANCE_NM = 1.0
#: Maximum vertices of a GDSII polygon, without the closing one: gdstk warns of incompatibility above 8,190 in total.
MAX_GDS_VERTICES = 8189
#: Maximum bytes of a GDSII property, and of all properties of a polygon, that all programs read.
MAX_GDS_STRING, MAX_GDS_PROPERTIES = 126, 128
#: Maximum bytes of the columns of a site in OASIS.
MAX_OASIS_STRING = 1024
#: Comparisons in about a second: gdstk compares each string of an OASIS file with all previous distinct ones.
OASIS_STRING_COMPARISONS = 4e8
#: Coordinates are signed 32-bit integers.
MAX_DBU = 2**31 - 1
#: Constant timestamp, for reproducible files.
TIMESTAMP = datetime(2000, 1, 1)  # noqa: DTZ001 -- GDSII has no time zones
CELL_NAME = "SENSOR"
#: Cells of congruent sites are named PIXEL_0, PIXEL_1, ..., others by their layer.
SITE_CELL = "PIXEL"
#: An array with more vertices, in all of its sites and layers, is written as a reference: it needs fewer bytes.
MAX_FLAT_VERTICES = 16


def write(
    layout: Layout,
    path: Path,
    *,
    layer: Any = None,
    layers: Mapping[str, Any] | str | Path | None = None,
    filter_names: Sequence[str] | None = None,
    dbu_um: float = DEFAULT_DBU_UM,
    hierarchy: bool = True,
    max_vertices: int | None = None,
) -> WrittenLayout:
    """
    Write GDSII or OASIS, depending on the extension.

    Raises GeometryError when sites or derived shapes vanish, collapse or self-intersect on the database grid. Raises
    ParameterError when the layer map is invalid, or a layer, a channel or a coordinate exceeds the range of the format. Raises
    FileError when gdstk is not installed, or the file cannot be written.
    """
    gdstk = import_optional(path, "gdstk")
    all_drawn = _drawn_layers(layout, layer, layers, filter_names)
    drawn = [d for d in all_drawn if not d.is_of_layout]
    is_oasis = path.suffix.lower() in (".oas", ".oasis")
    check_readable(layout)
    xy_dbu, snapped = _snap_to_grid(layout, dbu_um)
    report = rounding_report(layout, snapped.xy_um, path)
    if 1e3 * report.max_displacement_um > ROUNDING_TOLERANCE_NM:
        _warn_of_rounding(layout, snapped, dbu_um)
    stack_of, origin = congruence_classes(xy_dbu, snapped.ring_offsets, snapped.site_offsets)
    if any(d.datatype is None or d.channel is not None for d in drawn):
        stack_of = stack_of * (MAX_LAYER + 1) + layout.channel
    _, first, stack_of = np.unique(stack_of, return_index=True, return_inverse=True)
    if not is_oasis:
        max_vertices = MAX_GDS_VERTICES if max_vertices is None else max_vertices
        if max_vertices > MAX_GDS_VERTICES:
            raise ParameterError("max_vertices", f"must be <= {MAX_GDS_VERTICES} in GDSII", max_vertices)
    drawing = _draw(layout, snapped, first, origin, drawn, dbu_um, max_vertices)
    columns = _stored_columns(layout, drawn, _site_identity(layout, snapped))
    references, flat = _divide(drawing, stack_of, origin, columns, hierarchy=hierarchy)

    cells = _cells(gdstk, drawing, stack_of[references.first], dbu_um, [], SITE_CELL, is_oasis=is_oasis)
    elements, numbers = _references(gdstk, cells, references, stack_of, origin, dbu_um)
    ring, owner = drawing.rings_of(stack_of[flat.first])
    polygons = drawing.polygons(gdstk, ring, origin[flat.first[owner]], dbu_um)
    is_site = drawing.is_site[ring]
    elements += compress(polygons, is_site.tolist())
    numbers += drawing.numbers(ring[is_site], flat.first[owner[is_site]])
    array = np.concatenate((np.arange(references.first.size), references.first.size + owner[is_site]))
    dropped = _set_properties(elements, numbers, array, concatenate(references, flat), columns, is_oasis=is_oasis)

    library = gdstk.Library("FOVEASIM", unit=1e-6, precision=dbu_um * 1e-6)
    shapes = list(compress(polygons, (~is_site).tolist()))
    all_cells = list(cells.values())
    for d in all_drawn:
        if d.is_of_layout:
            complete = layout_of(*snapped.rings_um, layout.columns, layout.provenance)
            drawing, stack_of, origin = _draw_layout(complete, d, dbu_um, max_vertices)
            references, flat = _divide(drawing, stack_of, origin, {}, hierarchy=hierarchy)
            cells = _cells(gdstk, drawing, stack_of[references.first], dbu_um, all_cells, d.name, is_oasis=is_oasis)
            shapes += _references(gdstk, cells, references, stack_of, origin, dbu_um)[0]
            ring, owner = drawing.rings_of(stack_of[flat.first])
            shapes += drawing.polygons(gdstk, ring, origin[flat.first[owner]], dbu_um)
            all_cells += cells.values()
    library.new_cell(CELL_NAME).add(*elements, *shapes)
    library.add(*all_cells)
    with atomic_write(path) as temporary:
        if is_oasis:
            # Rectangles of OASIS do not preserve the first vertex.
            library.write_oas(temporary, detect_rectangles=False, detect_trapezoids=False, validation="crc32")
        else:
            library.write_gds(temporary, max_points=0, timestamp=TIMESTAMP)
        _check_complete(temporary, is_oasis)
    if SITE_ID in dropped:
        warn(
            f"the file does not contain the identity of the sites, column '{SITE_ID}', for which the columns "
            f"{', '.join(map(repr, layout.columns))} leave no room: sensors of the layout that is read have other fixed "
            "patterns; write fewer columns, or a .npz file",
            LayoutWarning,
        )
    return replace(report, dropped_columns=dropped)


def _drawn_layers(layout: Layout, layer: Any, layers: Any, filter_names: Sequence[str] | None) -> list[DrawnLayer]:
    """Return the layers of the file, by default photosites with the channel as datatype."""
    if layers is not None and layer is not None:
        raise ParameterError("layer", "must not be given with 'layers'", layer, hint="set layers={'photosite': ...}")
    if layers is None:
        number, datatype = parse_layer("layer", 1 if layer is None else layer, at_most=MAX_LAYER)
        if datatype is None and layout.channel.max(initial=0) > MAX_LAYER:
            raise ParameterError("channel", f"must be <= {MAX_LAYER} in GDSII and OASIS", int(layout.channel.max()))
        return [DrawnLayer(name=PHOTOSITE, layer=number, datatype=datatype)]
    drawn = parse_layer_map(layers, filter_names)
    filters = [d.channel for d in drawn if d.channel is not None]
    if filters and CHANNEL not in layout.columns:
        raise ParameterError(
            "layers",
            "must not contain filter layers for a layout without the column 'channel'",
            hint="add it, for example with foveasim.layout.mosaic(layout, ('RG', 'GB'))",
        )
    missing = np.setdiff1d(layout.channel, filters) if filters else np.zeros(0)
    if missing.size:
        site = int(np.flatnonzero(layout.channel == missing[0])[0])
        raise ParameterError(
            "layers",
            f"must have a filter layer for channel {missing[0]} of site {site}",
            hint=f"add 'filter_{missing[0]}', or omit all filter layers",
        )
    return drawn


def _stored_columns(
    layout: Layout, drawn: list[DrawnLayer], identity: dict[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """Return the columns to store: channel, unless datatypes represent it, others, identity."""
    others = {name: column for name, column in layout.columns.items() if name != CHANNEL}
    is_datatype = any(d.datatype is None for d in drawn) and bool((layout.channel != layout.channel[:1]).any())
    first = {} if is_datatype or CHANNEL not in layout.columns else {CHANNEL: layout.columns[CHANNEL]}
    return first | others | identity


def _site_identity(layout: Layout, snapped: Layout) -> dict[str, NDArray[Any]]:
    """Return the column that identifies the sites, if their rounded outlines do not."""
    if SITE_ID in layout.columns or snapped is layout:
        return {}
    ids = site_ids(layout)
    return {} if np.array_equal(ids, site_ids(snapped)) else {SITE_ID: ids}


def _divide(
    drawing: _Drawing, stack_of: Ints, origin: Ints, columns: Mapping[str, NDArray[Any]], *, hierarchy: bool
) -> tuple[Arrays, Arrays]:
    """Return the arrays that become references, and the other sites as arrays of 1 x 1."""
    if not hierarchy or stack_of.size == 0:
        nowhere = np.zeros(0, np.int64)
        return single_sites(nowhere, columns), single_sites(np.arange(stack_of.size), columns)
    arrays = find_arrays(stack_of, origin, columns, MAX_DBU)
    stack = stack_of[arrays.first]
    is_shorter = arrays.n_x * arrays.n_y * drawing.n_vertices[stack] > MAX_FLAT_VERTICES
    is_shorter &= np.bincount(stack_of)[stack] > 1
    return arrays.select(is_shorter), single_sites(np.sort(arrays.select(~is_shorter).sites()), columns)


# -- shapes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Drawing:
    """
    Shapes of congruent sites on all layers, relative to the origins of the sites.

    The rings are packed and have no holes. A stack consists of the shapes of a site. ``number`` and ``part`` have the shape
    (n_ring, 2): layer and datatype; number of the part and number of parts of a divided photosite, or 0 and 0.
    """

    xy_dbu: Ints
    ring_offsets: Ints
    stack_offsets: Ints
    number: Ints
    part: Ints
    is_site: NDArray[np.bool_]

    @classmethod
    def of(cls, rings_um: list[Floats], dbu_um: float, *table: NDArray[Any]) -> _Drawing:
        """Return the drawing of rings, with the other fields."""
        xy_um = np.concatenate(rings_um) if rings_um else np.zeros((0, 2))
        ring_offsets = np.concatenate(([0], np.cumsum(list(map(len, rings_um)), dtype=np.int64)))
        return cls(np.rint(xy_um / dbu_um).astype(np.int64), ring_offsets, *table)

    @property
    def n_vertices(self) -> Ints:
        """Vertices of each stack."""
        return np.diff(self.ring_offsets[self.stack_offsets])

    def rings_of(self, stack: Ints) -> tuple[Ints, Ints]:
        """Return the rings of several stacks, and the positions of their stacks in ``stack``."""
        n_rings = np.diff(self.stack_offsets)[stack]
        owner = np.repeat(np.arange(stack.size), n_rings)
        return self.stack_offsets[stack][owner] + positions_in_runs(n_rings), owner

    def polygons(self, gdstk: Any, ring: Ints, origin: Ints, dbu_um: float) -> list[Any]:
        """Return polygons of gdstk for rings at the given origins, (n, 2)."""
        n_vertices = np.diff(self.ring_offsets)[ring]
        vertex = np.repeat(self.ring_offsets[:-1][ring], n_vertices) + positions_in_runs(n_vertices)
        xy_um = to_um(self.xy_dbu[vertex] + np.repeat(origin, n_vertices, axis=0), dbu_um)
        stops = np.cumsum(n_vertices)
        numbers = self.number[ring].T.tolist()
        return list(
            map(
                gdstk.Polygon,
                map(xy_um.__getitem__, map(slice, (stops - n_vertices).tolist(), stops.tolist())),
                *numbers,
            )
        )

    def numbers(self, ring: Ints, site: Ints) -> list[tuple[int, ...]]:
        """Return the numbers of the given sites, with the parts of divided ones."""
        if not self.part.any():
            return list(zip(site.tolist()))
        part, n_parts = self.part[ring].T.tolist()
        return [(s, k, n) if n else (s,) for s, k, n in zip(site.tolist(), part, n_parts, strict=True)]


def _draw(
    layout: Layout,
    snapped: Layout,
    first: Ints,
    origin: Ints,
    drawn: list[DrawnLayer],
    dbu_um: float,
    max_vertices: int | None,
) -> _Drawing:
    """Draw one site of each stack; ``first`` are their indices."""
    models = snapped[first]
    owner = np.repeat(np.arange(first.size), np.diff(models.ring_offsets[models.site_offsets]))
    xy_um = models.xy_um - to_um(origin[first], dbu_um)[owner]
    models = layout_of(to_um(np.rint(xy_um / dbu_um), dbu_um), models.ring_offsets, models.site_offsets)
    channel = layout.channel[first] if any(d.datatype is None or d.channel is not None for d in drawn) else None
    outlines = hole_free_rings(models, max_vertices)
    tables, rings_um = [], []
    for level, d in enumerate(drawn):
        stack, part, n_parts, rings = (
            _derived_rings(d, models, first, dbu_um, max_vertices) if d.is_derived else outlines
        )
        chosen = np.arange(stack.size)
        if d.channel is not None:
            assert channel is not None
            chosen = np.flatnonzero(channel[stack] == d.channel)
        datatype = np.full(stack.size, d.datatype) if d.datatype is not None else channel[stack]  # type: ignore[index]
        is_site = np.full(stack.size, d.name == PHOTOSITE)
        parts = (part * is_site, n_parts * is_site)
        table = np.stack(
            (stack, np.full(stack.size, level), np.full(stack.size, d.layer), datatype, *parts, is_site), 1
        )
        tables.append(table[chosen])
        rings_um += [rings[k] for k in chosen.tolist()] if chosen.size < len(rings) else rings
    table = np.concatenate(tables)
    order = np.lexsort((table[:, 1], table[:, 0]))
    table = table[order]
    rings_um = [rings_um[k] for k in order.tolist()]
    stacks = np.searchsorted(table[:, 0], np.arange(first.size + 1))
    return _Drawing.of(rings_um, dbu_um, stacks, table[:, 2:4], table[:, 4:6], table[:, 6].astype(bool))


def _derived_rings(
    drawn: DrawnLayer, models: Layout, first: Ints, dbu_um: float, max_vertices: int | None
) -> tuple[Ints, Ints, Ints, list[Floats]]:
    """Return stack, part, number of parts and rings of a derived layer, without holes."""
    polygons = shapes_of_sites(drawn.name, models, drawn.parameters)
    parts, stack = shapely.get_parts(polygons, return_index=True)
    is_area = shapely.area(parts) > 0.0
    parts, stack = parts[is_area], stack[is_area]
    vanished = np.setdiff1d(np.arange(first.size), stack)
    site = int(first[vanished].min(initial=MAX_SITES))
    try:
        if vanished.size == 0:
            derived = Layout.from_polygons(parts)
            piece, part, n_parts, rings = hole_free_rings(_snap_to_grid(derived, dbu_um)[1], max_vertices)
            return stack[piece], part, n_parts, rings
    except GeometryError as error:
        site = int(first[stack[error.site_ids[0]]]) if error.site_ids else int(first[0])
    raise GeometryError(
        f"layer '{drawn.name}': the shape of site {site} would vanish or collapse on the database grid of {dbu_um:g} µm; "
        "change the parameters of the layer",
        (site,),
    )


def _draw_layout(
    layout: Layout, drawn: DrawnLayer, dbu_um: float, max_vertices: int | None
) -> tuple[_Drawing, Ints, Ints]:
    """
    Draw a layer of the complete layout.

    Returns ``drawing``: congruent shapes, a stack each. ``stack_of`` (n,) int64: stack at each position, sorted. ``origin``
    (n, 2) int64: positions, in database units; those of a stack in the order of rows and columns.
    """
    placed = shapes_of_layout(drawn.name, layout, drawn.parameters)
    rounded = shapely.transform(placed.polygons, lambda xy_um: to_um(np.rint(xy_um / dbu_um), dbu_um))
    invalid = np.flatnonzero(~shapely.is_valid(rounded))
    rounded[invalid] = shapely.set_precision(placed.polygons[invalid], dbu_um)
    parts, shape = shapely.get_parts(rounded, return_index=True)
    is_area = shapely.area(parts) > 0.0
    parts, shape = parts[is_area], shape[is_area]
    try:
        xy_dbu, snapped = _snap_to_grid(Layout.from_polygons(parts), dbu_um)
    except GeometryError as error:
        raise GeometryError(f"layer '{drawn.name}': {error}") from None
    stack, part_origin = congruence_classes(xy_dbu, snapped.ring_offsets, snapped.site_offsets)
    _, first, stack = np.unique(stack, return_index=True, return_inverse=True)
    models = snapped[first]
    vertex_owner = np.repeat(first, np.diff(models.ring_offsets[models.site_offsets]))
    relative_um = models.xy_um - to_um(part_origin[vertex_owner], dbu_um)
    at_origin = layout_of(relative_um, models.ring_offsets, models.site_offsets)
    owner, _, _, rings_um = hole_free_rings(at_origin, max_vertices)
    stacks = np.searchsorted(owner, np.arange(first.size + 1))
    number, part = (
        np.tile(np.array([drawn.layer, drawn.datatype]), (owner.size, 1)),
        np.zeros((owner.size, 2), np.int64),
    )
    drawing = _Drawing.of(rings_um, dbu_um, stacks, number, part, np.zeros(owner.size, bool))
    # Each position of a shape is one of all of its parts.
    n_parts = np.bincount(shape, minlength=len(placed.polygons))
    offset = np.cumsum(n_parts) - n_parts
    size = n_parts[placed.shape]
    part = np.repeat(offset[placed.shape], size) + positions_in_runs(size)
    position = np.rint(placed.position_um / dbu_um).astype(np.int64)
    origin = part_origin[part] + np.repeat(position, size, axis=0)
    order = np.lexsort((origin[:, 0], origin[:, 1], stack[part]))
    return drawing, stack[part][order], origin[order]


def _cells(
    gdstk: Any, drawing: _Drawing, stack: Ints, dbu_um: float, others: list[Any], name: str, *, is_oasis: bool
) -> dict[int, Any]:
    """Return the cells of stacks in the order of use, numbered after other cells."""
    cells: dict[int, Any] = {}
    prefix = re.sub(r"[^A-Z0-9]", "_", name.upper())
    for s in dict.fromkeys(stack.tolist()):
        ring, _ = drawing.rings_of(np.array([s]))
        polygons = drawing.polygons(gdstk, ring, np.zeros((ring.size, 2), np.int64), dbu_um)
        sites = ring[drawing.is_site[ring]]
        for polygon, number in zip(polygons, drawing.numbers(sites, np.zeros_like(sites)), strict=False):
            _set_number(polygon, number, is_oasis=is_oasis)
        cells[s] = gdstk.Cell(f"{prefix}_{len(others) + len(cells)}").add(*polygons)
    return cells


def _references(
    gdstk: Any, cells: Mapping[int, Any], arrays: Arrays, stack_of: Ints, origin: Ints, dbu_um: float
) -> tuple[list[Any], list[tuple[int, ...]]]:
    """Return references to the cells of all arrays, and their numbers."""
    stack = stack_of[arrays.first]
    references: list[Any] = []
    numbers: list[tuple[int, ...]] = []
    rows = zip(
        stack.tolist(),
        arrays.first.tolist(),
        arrays.n_x.tolist(),
        arrays.n_y.tolist(),
        to_um(origin[arrays.first], dbu_um).tolist(),
        to_um(arrays.pitch, dbu_um).tolist(),
        arrays.number_steps.tolist(),
        strict=True,
    )
    for s, site, n_x, n_y, at_um, (dx_um, dy_um), steps in rows:
        if n_x * n_y == 1:
            references.append(gdstk.Reference(cells[s], at_um))
            numbers.append((site,))
            continue
        # An array of one column or row has the pitch of the other direction, as some programs reject a pitch of 0.
        spacing = (dx_um or dy_um, dy_um or dx_um)
        references.append(gdstk.Reference(cells[s], at_um, columns=n_x, rows=n_y, spacing=spacing))
        numbers.append((site, *steps, n_x, n_y))
    return references, numbers


# -- properties -------------------------------------------------------------------------------------------------------


def _set_properties(
    elements: list[Any],
    numbers: list[tuple[int, ...]],
    array: Ints,
    arrays: Arrays,
    columns: Mapping[str, NDArray[Any]],
    *,
    is_oasis: bool,
) -> tuple[str, ...]:
    """Set the numbers and columns of sites and arrays; return the dropped columns."""
    rows: Sequence[Any]
    if is_oasis:
        max_strings = int(OASIS_STRING_COMPARISONS // max(len(elements), 1))
        stored, dropped = storable_columns(columns, arrays.first, arrays.column_steps, MAX_OASIS_STRING, max_strings)
        rows = list(zip(*chain.from_iterable((repeat(key), values) for key, values in stored.items()), strict=False))
    else:
        n_chars = np.fromiter(map(len, map(_number_text, numbers)), np.int64, len(numbers))
        longest = np.zeros(arrays.first.size, np.int64)
        np.maximum.at(longest, array, n_chars + n_chars % 2)
        room = np.minimum(MAX_GDS_STRING, MAX_GDS_PROPERTIES - longest)
        stored, dropped = storable_columns(columns, arrays.first, arrays.column_steps, room)
        rows = column_strings(stored)
    # gdstk writes properties in reverse order of setting.
    for element, k in zip(elements, array.tolist(), strict=True) if rows else ():
        if is_oasis:
            element.set_property("columns", rows[k])
        else:
            element.set_gds_property(2, rows[k])
    for element, number in zip(elements, numbers, strict=True):
        _set_number(element, number, is_oasis=is_oasis)
    return dropped


def _set_number(element: Any, number: tuple[int, ...], *, is_oasis: bool) -> None:
    """Set the number of a site, of a part of it, or of an array with steps and size."""
    if is_oasis:
        element.set_property("photosites" if len(number) == 5 else "photosite", list(number))
    else:
        element.set_gds_property(1, _number_text(number))


def _number_text(number: tuple[int, ...]) -> str:
    if len(number) == 1:
        return f"photosite {number[0]}"
    if len(number) == 5:
        first, step_i, step_j, n_x, n_y = number
        return f"photosites {linear_text(first, step_i, step_j)} of {n_x}x{n_y}"
    return f"photosite {number[0]} part {number[1]} of {number[2]}"


def _warn_of_rounding(layout: Layout, snapped: Layout, dbu_um: float) -> None:
    """Warn that rounding displaces a vertex by more than the tolerance."""
    displacement_nm = 1e3 * np.hypot(*(snapped.xy_um - layout.xy_um).T)
    vertex = int(np.argmax(displacement_nm))
    site = int(np.searchsorted(layout.ring_offsets[layout.site_offsets], vertex, side="right")) - 1
    warn(
        f"rounding to the database unit of {1e3 * dbu_um:g} nm moves a vertex of site {site} by "
        f"{displacement_nm[vertex]:.3g} nm, more than {ROUNDING_TOLERANCE_NM:g} nm; use dbu_um={DEFAULT_DBU_UM:g}",
        LayoutWarning,
    )


def _snap_to_grid(layout: Layout, dbu_um: float) -> tuple[Ints, Layout]:
    """Round the vertices to the database grid; the layout itself where nothing moves."""
    xy_dbu = np.rint(layout.xy_um / dbu_um)
    if xy_dbu.size and np.abs(xy_dbu).max() > MAX_DBU:
        raise ParameterError(
            "dbu_um", f"must be >= {np.abs(layout.xy_um).max() / MAX_DBU:.3g} for this layout", dbu_um, "µm"
        )
    snapped = on_grid(layout, dbu_um)
    if layout.n_sites:
        is_bad = ~has_valid_outlines(snapped)
        if is_bad.any():
            bad = np.flatnonzero(is_bad)
            raise GeometryError(
                f"site {bad[0]}{f' and {bad.size - 1} more' if bad.size > 1 else ''} would collapse or self-intersect on "
                f"the database grid of {dbu_um:g} µm; use a smaller dbu_um",
                tuple(int(i) for i in bad),
            )
    return xy_dbu.astype(np.int64), snapped


def _check_complete(path: Path, is_oasis: bool) -> None:
    """Check that a file is complete, as gdstk does not report a full disk."""
    data = path.read_bytes()[-OASIS_END_BYTES:]
    is_complete = data[:1] == bytes([END]) if is_oasis else data[-4:] == b"\x00\x04\x04\x00"
    if not is_complete:
        raise OSError("the written file is incomplete")


for _name, _title, _suffixes, _magic in (
    ("gds", "GDSII", (".gds", ".gdsii"), GDS_MAGIC),
    ("oasis", "OASIS", (".oas", ".oasis"), OASIS_MAGIC),
):
    FORMATS.register(
        _name,
        FileFormat(
            title=_title,
            suffixes=_suffixes,
            signatures=(_magic,),
            read=read,
            write=write,
            read_options=(
                "layer",
                "cell",
                "layers",
                "channels",
                "filter_names",
                "invalid",
                "duplicates",
                "missing",
                "circle_tolerance",
            ),
            write_options=("layer", "layers", "filter_names", "dbu_um", "hierarchy", "max_vertices"),
        ),
    )
