"""
GDSII and OASIS files, through gdstk.

A photosite is a polygon on one layer. Its channel is the datatype, and its number is a property, which preserves the order
in programs that sort shapes: attribute 1 with the string ``photosite 17`` in GDSII, the property ``photosite`` in OASIS.
Coordinates are integer multiples of the database unit. Neither format has holes, and a GDSII polygon has at most 8,190
vertices including the closing one. Sites with holes or more vertices are written as several polygons (``photosite 17 part
1 of 3``) that share edges and add no vertex; reading merges them exactly.

The other columns are a second property: attribute 2 with the string ``ring=3 gain=0.25 is_dead=true name="a"`` in GDSII,
the property ``columns`` with alternating names and values in OASIS. Integers are read as int64 (uint64 where required),
other numbers as float64, bit for bit. A column with values that do not fit for some site is dropped for all sites, and
reported: the properties of a GDSII polygon contain at most 128 bytes, and gdstk is very slow for a large number of distinct
strings in OASIS. A column without a value for every photosite of a file is not read.

References: Calma, GDSII Stream Format Manual 6.0 (1987); SEMI P39, OASIS.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import replace
from datetime import datetime
from itertools import chain, pairwise, repeat
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.extras import needs
from foveasim._core.rings import positions_in_runs, ring_moments
from foveasim._core.validation import MAX_SITES, Floats, Ints, check_count, check_number
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, as_file_error
from foveasim._io.sandbox import WALL_TIME_FACTOR, run_in_sandbox
from foveasim.errors import FileError, GeometryError, ParameterError
from foveasim.layout.files._columns import MAX_COLUMN_BYTES, column_strings, parse_columns, storable_columns
from foveasim.layout.files._common import (
    WrittenLayout,
    check_site_count,
    check_sizes,
    layout_from_untrusted,
    rounding_report,
)
from foveasim.layout.files._formats import FORMATS
from foveasim.layout.model import Layout, valid_sites

__all__ = ["GDS_MAGIC", "OASIS_MAGIC", "read", "write"]

Point: TypeAlias = tuple[float, float]

GDS_MAGIC = b"\x00\x06\x00\x02"
OASIS_MAGIC = b"%SEMI-OASIS\r\n"

DEFAULT_DBU_UM = 1e-4
#: Maximum layer and datatype: some programs read them as signed 16-bit integers.
MAX_LAYER = 32767
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

#: Limits of the sandbox process: memory while gdstk reads, and in total; column strings; time; larger for large files.
MIN_READING_BYTES, READING_PER_BYTE = 2**30, 256
MIN_MEMORY_BYTES, MEMORY_PER_BYTE, MAX_MEMORY_BYTES = 2**31, 256, 2**35
MIN_STRING_BYTES, STRING_BYTES_PER_BYTE = 2**27, 32
MAX_CPU_S, BYTES_PER_S = 5, 2**20
#: GDSII record types by data type: none, bit array, 16-bit, 32-bit, 64-bit floating point, string.
RECORDS_OF_TYPE = {
    0: b"\x04\x07\x08\x09\x0a\x0b\x0c\x11\x15\x2d\x38",
    1: b"\x17\x1a\x26\x34",
    2: b"\x00\x01\x05\x0d\x0e\x13\x16\x21\x22\x25\x2a\x2b\x2e\x32\x33\x36\x39\x3b",
    3: b"\x0f\x10\x27\x2f\x30\x31",
    5: b"\x03\x1b\x1c",
    6: b"\x02\x06\x12\x19\x1f\x20\x23\x24\x2c\x37\x3a",
}
END_OF_LIBRARY = 0x0400
#: Maximum number of vertices after noding an outline with slits, as a multiple of its own.
MAX_NODING_RATIO = 16
#: OASIS: size and type of the END record, which ends the file, and number of the validation scheme CRC-32.
OASIS_END_BYTES = 256
OASIS_END = 2
CRC32_SCHEME = 1


# -- writing ----------------------------------------------------------------------------------------------------------


def write(layout: Layout, path: Path, *, layer: int = 1, dbu_um: float = DEFAULT_DBU_UM) -> WrittenLayout:
    """
    Write GDSII or OASIS, depending on the extension.

    Raises
    ------
    GeometryError
        When sites collapse or self-intersect on the database grid.
    ParameterError
        When the layer, a channel or a coordinate exceeds the range of the format.
    FileError
        When gdstk is not installed, or the file cannot be written.
    """
    gdstk = _gdstk(path)
    layer = check_count("layer", layer, at_least=0, at_most=MAX_LAYER)
    dbu_um = check_number("dbu_um", dbu_um, at_least=1e-9, at_most=1e3)
    channel = layout.channel
    if channel.size and channel.max() > MAX_LAYER:
        raise ParameterError("channel", f"must be <= {MAX_LAYER} in GDSII and OASIS", int(channel.max()))
    is_oasis = path.suffix.lower() in (".oas", ".oasis")
    snapped = _snap_to_grid(layout, dbu_um)
    report = rounding_report(layout, snapped.xy_um, path)
    site, part, n_parts, rings_um = _hole_free_rings(snapped, None if is_oasis else MAX_GDS_VERTICES)
    polygons = [gdstk.Polygon(r, layer, c) for r, c in zip(rings_um, channel[site].tolist(), strict=True)]
    set_properties = _set_oasis_properties if is_oasis else _set_gds_properties
    dropped = set_properties(polygons, layout, site.tolist(), part.tolist(), n_parts.tolist())
    library = gdstk.Library("FOVEASIM", unit=1e-6, precision=dbu_um * 1e-6)
    library.new_cell(CELL_NAME).add(*polygons)
    with atomic_write(path) as temporary:
        if is_oasis:
            library.write_oas(temporary, validation="crc32")
        else:
            library.write_gds(temporary, max_points=0, timestamp=TIMESTAMP)
        _check_complete(temporary, is_oasis)
    return replace(report, dropped_columns=dropped)


def _set_gds_properties(
    polygons: list[Any], layout: Layout, site: list[int], part: list[int], n_parts: list[int]
) -> tuple[str, ...]:
    """Set the number and columns of each polygon's site; return the dropped columns."""
    numbers = [
        f"photosite {s}" if n == 0 else f"photosite {s} part {k} of {n}"
        for s, k, n in zip(site, part, n_parts, strict=True)
    ]
    longest = max(map(len, numbers), default=0)
    columns, dropped = storable_columns(layout, min(MAX_GDS_STRING, MAX_GDS_PROPERTIES - longest - longest % 2))
    strings = column_strings(columns)
    if strings:
        # gdstk writes properties in reverse order of setting.
        for polygon, s in zip(polygons, site, strict=True):
            polygon.set_gds_property(2, strings[s])
    for polygon, number in zip(polygons, numbers, strict=True):
        polygon.set_gds_property(1, number)
    return dropped


def _set_oasis_properties(
    polygons: list[Any], layout: Layout, site: list[int], part: list[int], n_parts: list[int]
) -> tuple[str, ...]:
    """Set the number and columns of each polygon's site; return the dropped columns."""
    columns, dropped = storable_columns(
        layout, MAX_OASIS_STRING, int(OASIS_STRING_COMPARISONS // max(len(polygons), 1))
    )
    rows = list(zip(*chain.from_iterable((repeat(key), values) for key, values in columns.items()), strict=False))
    if rows:
        for polygon, s in zip(polygons, site, strict=True):
            polygon.set_property("columns", rows[s])
    for polygon, s, k, n in zip(polygons, site, part, n_parts, strict=True):
        polygon.set_property("photosite", [s] if n == 0 else [s, k, n])
    return dropped


def _gdstk(path: Path) -> Any:
    try:
        import gdstk
    except ImportError:
        raise FileError(path, needs("gdstk")) from None
    return gdstk


def _to_um(xy_dbu: NDArray[Any], dbu_um: float) -> Floats:
    """Convert to µm; correctly rounded where 1 µm is an integer number of database units."""
    per_um = round(1.0 / dbu_um)
    is_integer = per_um >= 1 and abs(per_um * dbu_um - 1.0) < 1e-12
    return np.asarray(xy_dbu / per_um if is_integer else xy_dbu * dbu_um, dtype=np.float64)


def _snap_to_grid(layout: Layout, dbu_um: float) -> Layout:
    """Round the vertices of a layout to the database grid, and check the photosites."""
    xy_dbu = np.rint(layout.xy_um / dbu_um)
    if xy_dbu.size and np.abs(xy_dbu).max() > MAX_DBU:
        raise ParameterError(
            "dbu_um", f"must be >= {np.abs(layout.xy_um).max() / MAX_DBU:.3g} for this layout", dbu_um, "µm"
        )
    # The holes are checked below.
    snapped = Layout._from_checked(_to_um(xy_dbu, dbu_um), layout.ring_offsets, layout.site_offsets, {}, {})  # noqa: SLF001
    if layout.n_sites:
        area_um2 = ring_moments(snapped.xy_um, snapped.ring_offsets)[0]
        is_hole = np.ones(area_um2.size, bool)
        is_hole[layout.site_offsets[:-1]] = False
        is_flat = np.where(is_hole, area_um2 >= 0.0, area_um2 <= 0.0)
        is_bad = np.logical_or.reduceat(is_flat, layout.site_offsets[:-1]) | ~valid_sites(snapped)
        if is_bad.any():
            bad = np.flatnonzero(is_bad)
            raise GeometryError(
                f"site {bad[0]}{f' and {bad.size - 1} more' if bad.size > 1 else ''} would collapse or self-intersect on "
                f"the database grid of {dbu_um:g} µm; use a smaller dbu_um",
                tuple(int(i) for i in bad),
            )
    return snapped


def _check_complete(path: Path, is_oasis: bool) -> None:
    """Check that a file is complete, as gdstk does not report a full disk."""
    data = path.read_bytes()[-OASIS_END_BYTES:]
    is_complete = data[:1] == bytes([OASIS_END]) if is_oasis else data[-4:] == b"\x00\x04\x04\x00"
    if not is_complete:
        raise OSError("the written file is incomplete")


# -- sites as polygons without holes ----------------------------------------------------------------------------------


def _hole_free_rings(layout: Layout, max_vertices: int | None) -> tuple[Ints, Ints, Ints, list[Floats]]:
    """
    Return hole-free rings of all sites, in their order.

    Returns
    -------
    site, part, n_parts : (n_ring,) int64
        Index of the site, number of the part from 1, and number of parts; 0 and 0 for an undivided site.
    rings_um : list of (n, 2), µm
    """
    rings_of_site = np.diff(layout.site_offsets)
    outline = layout.site_offsets[:-1]
    starts, stops = layout.ring_offsets[outline], layout.ring_offsets[outline + 1]
    rings_um = [layout.xy_um[a:b] for a, b in zip(starts.tolist(), stops.tolist(), strict=True)]
    is_cut = rings_of_site > 1
    if max_vertices is not None:
        is_cut |= stops - starts > max_vertices
    n_parts = np.zeros(layout.n_sites, np.int64)
    if not is_cut.any():
        return np.arange(layout.n_sites), n_parts, n_parts, rings_um
    cut = np.flatnonzero(is_cut)
    parts_of = {
        int(s): _hole_free_parts(polygon, max_vertices) for s, polygon in zip(cut, layout[cut].polygons(), strict=True)
    }
    n_parts[cut] = [len(parts) for parts in parts_of.values()]
    n_rings = np.maximum(n_parts, 1)
    site = np.repeat(np.arange(layout.n_sites), n_rings)
    part = positions_in_runs(n_rings) + 1
    pieces = [ring for s, undivided in enumerate(rings_um) for ring in parts_of.get(s, [undivided])]
    return site, np.where(n_parts[site] > 0, part, 0), n_parts[site], pieces


def _hole_free_parts(polygon: Any, max_vertices: int | None) -> list[Floats]:
    """
    Divide a polygon into rings without holes and without additional vertices.

    Notes
    -----
    Triangles of a constrained Delaunay triangulation are merged as long as each adds a new vertex. Such a part has no
    repeated vertex, and is therefore simple and without holes.
    """
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corners = shapely.get_coordinates(shapely.normalize(triangles)).reshape(-1, 4, 2)[:, :3]
    points, ids = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    corner_ids = ids.reshape(-1, 3).tolist()
    neighbours: dict[tuple[int, int], list[int]] = {}
    for t, (a, b, c) in enumerate(corner_ids):
        for u, v in ((a, b), (b, c), (c, a)):
            neighbours.setdefault((min(u, v), max(u, v)), []).append(t)
    is_free = [True] * len(corner_ids)
    parts = []
    for first in range(len(corner_ids)):
        if is_free[first]:
            is_free[first] = False
            parts.append(points[_grow_part(first, corner_ids, neighbours, is_free, max_vertices)])
    return parts


def _grow_part(
    first: int,
    corner_ids: list[list[int]],
    neighbours: dict[tuple[int, int], list[int]],
    is_free: list[bool],
    max_vertices: int | None,
) -> list[int]:
    """Return the vertices, in order, of a part grown from one triangle; mark its triangles."""
    after = dict(zip(corner_ids[first], [*corner_ids[first][1:], corner_ids[first][0]], strict=True))
    edges = list(after.items())
    while edges and (max_vertices is None or len(after) < max_vertices):
        u, v = edges.pop()
        for t in neighbours[min(u, v), max(u, v)]:
            apex = next(w for w in corner_ids[t] if w not in (u, v))
            if is_free[t] and apex not in after:
                is_free[t] = False
                after[u], after[apex] = apex, v
                edges += [(u, apex), (apex, v)]
                break
    start = next(iter(after))
    ring = [start]
    while after[ring[-1]] != start:
        ring.append(after[ring[-1]])
    return ring


# -- reading ----------------------------------------------------------------------------------------------------------


def read(path: Path, *, layer: int | None = None, cell: str | None = None) -> Layout:
    """
    Read GDSII or OASIS, detected by content.

    The cell hierarchy is flattened, and the sites are ordered by their numbers.

    Raises
    ------
    FileError
        When gdstk is not installed, or the file is corrupt, truncated, malformed, or contains invalid photosites.
    """
    _gdstk(path)
    kind = "GDSII or OASIS"
    if layer is not None:
        layer = check_count("layer", layer, at_least=0, at_most=2**31 - 1)
    with as_file_error(path, f"{kind} layout"):
        data = path.read_bytes()
        is_oasis = data.startswith(OASIS_MAGIC)
        (_check_oasis if is_oasis else _check_records)(path, data)
        n_bytes = len(data)
        del data
        answer, xy_dbu, counts, tags, lines = _read_in_sandbox(path, is_oasis, layer, cell, n_bytes)
        check_site_count(path, counts.size)
        xy_um = _to_um(xy_dbu, answer["dbu_um"])
        pieces, piece, first = _group_by_site(path, xy_um, counts, tags)
        columns = {"channel": tags[piece[first], 1], **_columns(lines, tags[piece, 6], first)}
        about = {
            "made_by": "read_layout",
            "file": path.name,
            "format": "OASIS" if is_oasis else "GDSII",
            "cell": answer["cell"],
            "dbu_um": float(f"{answer['dbu_um']:.12g}"),
        }
        check_sizes(np.ones(counts.size), counts)
        is_undivided = first.size == piece.size
        packed = (pieces.xy_um, pieces.ring_offsets, pieces.site_offsets)
        try:
            return layout_from_untrusted(packed if is_undivided else _merge_parts(pieces, first), columns, about)
        except GeometryError:
            return layout_from_untrusted(_without_keyholes(_merge_parts(pieces, first)), columns, about)


def _check_records(path: Path, data: bytes) -> None:
    """Check that the GDSII records have known types and are complete up to ENDLIB."""
    from foveasim.layout.files import _kernels

    is_known = np.zeros(2**16, bool)
    for kind, records in RECORDS_OF_TYPE.items():
        is_known[[record << 8 | kind for record in records]] = True
    at, record = _kernels.walk_records(np.frombuffer(data, np.uint8), is_known, END_OF_LIBRARY)
    if record == -1:
        raise FileError(path, f"is corrupt: no valid GDSII record begins at byte {at}")
    if record != END_OF_LIBRARY or at > len(data):
        raise FileError(path, "is truncated: the GDSII record ENDLIB is missing or incomplete")
    if data[at:].strip(b"\0"):
        raise FileError(path, f"is corrupt: unexpected data after the end of the GDSII library at byte {at}")


def _check_oasis(path: Path, data: bytes) -> None:
    """Check that the END record exists, and that its CRC-32, if any, matches the file."""
    end = data[-OASIS_END_BYTES:]
    if len(data) < len(OASIS_MAGIC) + OASIS_END_BYTES or end[0] != OASIS_END:
        raise FileError(path, "is truncated or corrupt: it does not end with the END record of OASIS")
    if end[-5] == CRC32_SCHEME and int.from_bytes(end[-4:], "little") != zlib.crc32(memoryview(data)[:-4]):
        raise FileError(path, "is corrupt: its CRC-32 does not match its content")


def _read_in_sandbox(
    path: Path, is_oasis: bool, layer: int | None, cell: str | None, n_bytes: int
) -> tuple[dict[str, Any], Floats, Ints, Ints, bytes]:
    """Read the file with gdstk in the sandbox process, which a malformed file may crash."""
    from foveasim.layout.files import _gdstk

    max_cpu_s = MAX_CPU_S + n_bytes // BYTES_PER_S
    max_memory_bytes = min(MIN_MEMORY_BYTES + MEMORY_PER_BYTE * n_bytes, MAX_MEMORY_BYTES)
    args = {
        "is_oasis": is_oasis,
        "layer": layer,
        "cell": cell,
        "max_sites": MAX_SITES,
        "max_memory_bytes": max_memory_bytes,
        "max_text_bytes": max(MIN_STRING_BYTES, STRING_BYTES_PER_BYTE * n_bytes),
        "max_cpu_s": WALL_TIME_FACTOR * max_cpu_s,
    }
    answer, (xy_dbu, counts, tags, lines) = run_in_sandbox(
        _gdstk.read,
        path,
        args,
        kind="OASIS" if is_oasis else "GDSII",
        max_cpu_s=max_cpu_s,
        max_bytes=min(MIN_READING_BYTES + READING_PER_BYTE * n_bytes, max_memory_bytes),
        is_standalone=True,
    )
    return answer, xy_dbu, counts, tags, lines.tobytes()


def _group_by_site(path: Path, xy_um: Floats, counts: Ints, tags: Ints) -> tuple[Layout, Ints, Ints]:
    """
    Sort the polygons of the file by site number, and group the parts of divided sites.

    Returns
    -------
    pieces : Layout
        One unchecked site per polygon.
    piece : (n_piece,) int64
        Positions of the polygons in the file.
    first : (n_site,) int64
        Index of the first piece of each site.
    """
    if counts.size and counts.min() < 3:
        raise FileError(path, f"contains a polygon with {counts.min()} vertices, expected at least 3")
    site, part, n_parts, placement = tags[:, 2:6].T
    # Sites without a number follow the numbered ones, in the order of the file.
    number = np.where(site >= 0, site, site.max(initial=-1) + 1)
    order = np.lexsort((part, number, placement))
    pieces = Layout(xy_um, np.concatenate(([0], np.cumsum(counts))), np.arange(counts.size + 1))
    if (np.diff(order) != 1).any():
        pieces = pieces[order]
    if not n_parts.any():
        return pieces, order, np.arange(order.size)
    key = np.stack((placement, number, n_parts), 1)[order]
    is_first = np.concatenate(([True], (key[1:] != key[:-1]).any(axis=1))) | (n_parts[order] == 0)
    first = np.flatnonzero(is_first)
    size = np.diff(np.append(first, order.size))
    is_wrong = (n_parts[order] != np.repeat(size, size)) | (part[order] != positions_in_runs(size) + 1)
    is_wrong &= n_parts[order] > 0
    if is_wrong.any():
        bad = order[np.flatnonzero(is_wrong)[0]]
        raise FileError(path, f"has missing or duplicate parts of photosite {site[bad]}, expected {n_parts[bad]} parts")
    return pieces, order, first


def _merge_parts(pieces: Layout, first: Ints) -> NDArray[Any]:
    """Merge the pieces of each site into one polygon."""
    polygons = pieces.polygons()
    merged = polygons[first]
    size = np.diff(np.append(first, polygons.size))
    for i in np.flatnonzero(size > 1):
        merged[i] = shapely.coverage_union_all(polygons[first[i] : first[i] + size[i]])
    return merged


def _columns(lines: bytes, line: Ints, first: Ints) -> dict[str, NDArray[Any]]:
    """
    Return the columns with a value for all pieces, equal for all pieces of a site.

    ``line`` is the line of each piece in ``lines``.
    """
    columns = {}
    size = np.diff(np.append(first, line.size))
    for name, values in parse_columns(lines).items() if lines else ():
        if values.itemsize * line.size > MAX_COLUMN_BYTES:
            continue
        pieces = values[line]
        column = pieces[first]
        if np.array_equal(np.repeat(column, size), pieces, equal_nan=values.dtype.kind == "f"):
            columns[name] = column
    return columns


def _without_keyholes(polygons: NDArray[Any]) -> NDArray[Any]:
    """
    Convert outlines with keyholes to polygons with holes; other polygons are unchanged.

    Other programs write holes as keyholes: the outline reaches the hole through a slit of zero width.
    """
    invalid = np.flatnonzero(~shapely.is_valid(polygons) & (shapely.get_num_interior_rings(polygons) == 0))
    repaired = np.full(len(polygons), None)
    for i in invalid:
        repaired[i] = _polygon_from_rings(
            _split_into_rings(_node_path(list(map(tuple, shapely.get_coordinates(polygons[i]).tolist()))))
        )
    check_sizes(np.maximum(shapely.get_num_interior_rings(repaired), 0) + 1, shapely.get_num_coordinates(repaired))
    return np.where(shapely.is_valid(repaired), repaired, polygons)


def _node_path(path: list[Point]) -> list[Point]:
    """Node a closed path: insert its vertices that lie on its horizontal and vertical edges."""
    nodes: tuple[dict[float, list[float]], ...] = ({}, {})
    for axis, of_line in enumerate(nodes):
        for vertex in set(path):
            of_line.setdefault(vertex[axis], []).append(vertex[1 - axis])
        for values in of_line.values():
            values.sort()
    noded = path[:1]
    for a, b in pairwise(path):
        axis = 0 if a[0] == b[0] else 1
        # A path with too many nodes is not a valid outline.
        if a[axis] == b[axis] and len(noded) < MAX_NODING_RATIO * len(path):
            values, (low, high) = nodes[axis][a[axis]], sorted((a[1 - axis], b[1 - axis]))
            passed = values[bisect_right(values, low) : bisect_left(values, high)]
            on_line = [(a[0], v) if axis == 0 else (v, a[1]) for v in passed]
            noded += on_line if a < b else on_line[::-1]
        noded.append(b)
    return noded


def _split_into_rings(closed_path: list[Point]) -> list[list[Point]]:
    """Return the rings of a closed path without the edges traversed in both directions."""
    n_times = Counter(pairwise(closed_path))
    successors: dict[Point, list[Point]] = {}
    for (a, b), n in n_times.items():
        if a != b:
            successors.setdefault(a, []).extend([b] * (n - n_times[b, a]))
    rings = []
    for start in successors:
        path, index_of = [start], {start: 0}
        while successors[path[-1]]:
            vertex = successors[path[-1]].pop()
            at = index_of.setdefault(vertex, len(path))
            if at == len(path):
                path.append(vertex)
                continue
            rings.append(path[at:])
            for passed in path[at + 1 :]:
                del index_of[passed]
            del path[at + 1 :]
    return rings


def _polygon_from_rings(rings: list[list[Point]]) -> Any:
    """
    Return the polygon of the largest ring, with the others as holes.

    The result is None if another ring has the same winding order as the largest.
    """
    if not rings:
        return None
    offsets = np.cumsum([0, *map(len, rings)])
    area_um2 = ring_moments(np.array([vertex for ring in rings for vertex in ring]), offsets)[0]
    outline = int(np.argmax(np.abs(area_um2)))
    is_hole = area_um2 * area_um2[outline] < 0.0
    if np.count_nonzero(is_hole) != len(rings) - 1:
        return None
    return shapely.Polygon(rings[outline], [ring for ring, is_in in zip(rings, is_hole, strict=True) if is_in])


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
            read_options=("layer", "cell"),
            write_options=("layer", "dbu_um"),
        ),
    )
