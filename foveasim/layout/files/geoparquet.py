"""
Layouts as GeoParquet 1.1, through pyarrow.

Outlines are WKB, and columns are Parquet columns. The files are exact and small, and GIS programs read them. Coordinates
are in µm in the sensor plane, an engineering coordinate reference system with this unit. The metadata ``foveasim`` contain unit
and provenance. Files of other programs are read in the unit of length of their reference system; where it has none, as degrees
or an unknown system, the caller states the unit.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, FormatError, as_file_error
from foveasim.errors import FileError, ParameterError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_decompressed,
    check_readable,
    check_site_count,
    check_table_header,
    max_decompressed_bytes,
    plain_columns,
    restore_column,
    string_column,
    table_header,
)
from foveasim.layout.files._outlines import (
    MAX_EXACT,
    Invalid,
    LengthUnit,
    Parts,
    agreed_unit,
    grouped_polygons,
    layout_of_geometries,
    required_unit,
)
from foveasim.layout.model import Layout

__all__ = ["MAGIC", "read", "write"]

MAGIC = b"PAR1"
GEOMETRY = "geometry"
VERSION = "1.1.0"
#: Number of rows decompressed at a time.
BATCH = 4096
#: Name of the unit in the reference system of the sensor plane.
MICROMETRE: dict[str, str | float] = {"type": "LinearUnit", "name": "micrometre", "conversion_factor": 1e-6}
#: The sensor plane as a coordinate reference system (PROJJSON).
SENSOR_PLANE: dict[str, Any] = {
    "$schema": "https://proj.org/schemas/v0.7/projjson.schema.json",
    "type": "EngineeringCRS",
    "name": "sensor plane",
    "datum": {"type": "EngineeringDatum", "name": "sensor"},
    "coordinate_system": {
        "subtype": "Cartesian",
        "axis": [
            {"name": name, "abbreviation": name, "direction": "unspecified", "unit": MICROMETRE} for name in ("x", "y")
        ],
    },
}
#: Reference system of files that name none.
DEFAULT_CRS = "OGC:CRS84, degrees of longitude and latitude"
#: Metadata of the file and of the geometry column. Types, orientation and extent follow from the outlines; the epoch is that
#: of a transformation between reference systems; the covering is a column of bounding boxes. Others are errors.
UNDERSTOOD_OF_FILE = ("version", "primary_column", "columns")
IRRELEVANT_OF_FILE = ("creator", "schema_version")
UNDERSTOOD = ("encoding", "crs", "edges", "covering")
IRRELEVANT = ("geometry_types", "geometry_type", "orientation", "bbox", "epoch")
#: Depth of the lists of polygons and multipolygons in the native encodings.
NATIVE = {"polygon": 2, "multipolygon": 3}
#: WKB types of polygons and multipolygons, and the flag of a leading spatial reference identifier.
POLYGON, MULTIPOLYGON = 3, 6
WITH_SRID = 1 << 29
#: First five bytes of both, in either byte order, with or without z, m and flags.
WKB_HEADERS = {
    kind: {
        bytes([is_little]) + number.to_bytes(4, "little" if is_little else "big"): number
        for is_little in (0, 1)
        for number in (kind + extra | flags << 29 for extra in (0, 1000, 2000, 3000) for flags in range(8))
    }
    for kind in (POLYGON, MULTIPOLYGON)
}


def write(layout: Layout, path: Path) -> WrittenLayout:
    """
    Write a table with one row per site.

    Raises ParameterError when a column contains neither numbers nor strings, or has the name of the geometry column. Raises
    FileError when pyarrow is not installed, or the file cannot be written.
    """
    pa, parquet = _pyarrow(path)
    check_readable(layout)
    columns = plain_columns(layout, "GeoParquet")
    if GEOMETRY in columns:
        raise ParameterError(
            GEOMETRY, "must not be a column name in GeoParquet: it is the geometry column", hint="rename the column"
        )
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": ["Polygon"],
        "crs": SENSOR_PLANE,
        "edges": "planar",
        "orientation": "counterclockwise",
    }
    if layout.n_sites:
        column["bbox"] = list(layout.bounds_um)
    geo = {"version": VERSION, "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
    outlines = pa.array(shapely.to_wkb(layout.polygons(), byte_order=1), type=pa.binary())
    # Arrow supports only the native byte order; numpy's fixed-width strings have no null.
    native = {name: values.astype(values.dtype.newbyteorder("=")) for name, values in columns.items()}
    table = pa.table({GEOMETRY: outlines, **{name: pa.array(values) for name, values in native.items()}})
    table = table.replace_schema_metadata({"geo": json.dumps(geo), "foveasim": json.dumps(table_header(layout))})
    with atomic_write(path) as temporary:
        # Outlines are distinct, so that a dictionary would not reduce their size.
        parquet.write_table(table, temporary, compression="zstd", use_dictionary=[*columns], write_page_checksum=True)
    return WrittenLayout(path=path, n_sites=layout.n_sites)


def read(path: Path, *, unit: LengthUnit | None = None, invalid: Invalid = "error", parts: Parts = "error") -> Layout:
    """Read a table of polygons, in the order of its rows."""
    pa, parquet = _pyarrow(path)
    with as_file_error(path, "GeoParquet layout"), parquet.ParquetFile(path, page_checksum_verification=True) as file:
        check_site_count(path, file.metadata.num_rows)
        check_decompressed(path, sum(file.metadata.row_group(i).total_byte_size for i in range(file.num_row_groups)))
        metadata = file.metadata.metadata or {}
        if b"geo" not in metadata:
            raise FileError(path, "is a Parquet table without geometry: it has no metadata 'geo'")
        about = json.loads(metadata.get(b"foveasim", "null"))
        name, column = _geometry_column(path, json.loads(metadata[b"geo"]))
        unit_um = agreed_unit(path, unit, 1.0, "µm") if about is not None else _unit_um(path, column, unit)
        _check_type(path, pa, file.schema_arrow.field(name).type, column["encoding"])
        table = _table(path, pa, file)
        if table.num_rows != file.metadata.num_rows:
            raise FileError(
                path, f"is corrupt: it contains {table.num_rows} rows, but declares {file.metadata.num_rows}"
            )
        table.validate(full=True)
        geometries, problems = _geometries(pa, table.column(name), column["encoding"])
        provenance, types = check_table_header(path, about, "GeoParquet")
        boxes = {parts[0] for parts in column.get("covering", {}).get("bbox", {}).values()}
        columns, dropped = {}, []
        for other in (each for each in table.column_names if each != name and each not in boxes):
            values = _column(pa, table.column(other))
            if values is None:
                dropped.append(other)
            else:
                columns[other] = restore_column(values, types.get(other))
        if dropped:
            provenance = {**provenance, "left_out_columns": dropped}
        return layout_of_geometries(
            path,
            geometries,
            columns,
            provenance,
            noun="row",
            unit_um=unit_um,
            invalid=invalid,
            parts=parts,
            problems=problems,
        )


def _geometry_column(path: Path, geo: Any) -> tuple[str, dict[str, Any]]:
    """Return name and metadata of the geometry column; reject metadata that are not known."""
    version = str(geo.get("version", "1"))
    if version.partition(".")[0] not in ("0", "1"):
        raise FileError(path, f"is GeoParquet {version:.20}, expected 1.x")
    name = geo["primary_column"]
    column = geo["columns"][name]
    for metadata, known in (
        (geo, (*UNDERSTOOD_OF_FILE, *IRRELEVANT_OF_FILE)),
        (column, (*UNDERSTOOD, *IRRELEVANT)),
    ):
        unknown = [key for key in metadata if key not in known]
        if unknown:
            raise FileError(path, f"has the metadata {unknown[0]!r:.60}, which are not known in GeoParquet 1.1")
    if column.get("edges", "planar") != "planar":
        raise FileError(path, f"has edges {column['edges']!r:.40} on a globe; the outlines of photosites are planar")
    if column["encoding"] != "WKB" and column["encoding"] not in NATIVE:
        expected = ", ".join(("WKB", *NATIVE))
        raise FileError(path, f"has the geometry encoding {column['encoding']!r:.40}, expected one of {expected}")
    return name, column


def _unit_um(path: Path, column: dict[str, Any], unit: LengthUnit | None) -> float:
    """Return the unit of coordinates in µm: that of the reference system, or the stated one."""
    crs = column.get("crs", DEFAULT_CRS)
    if crs is None:
        return required_unit(path, unit, "has coordinates in an unknown reference system")
    stated = _axis_units_um(crs)
    if stated is not None:
        return agreed_unit(path, unit, *stated)
    name = crs.get("name", "without a name") if isinstance(crs, dict) else crs
    return required_unit(path, unit, f"has coordinates in the reference system {str(name)[:80]}")


def _axis_units_um(crs: Any) -> tuple[float, str] | None:
    """Return the unit of length of both axes of a PROJJSON system in µm, and its name."""
    if not isinstance(crs, dict) or crs.get("type") not in ("ProjectedCRS", "EngineeringCRS"):
        return None
    try:
        units = [axis["unit"] for axis in crs["coordinate_system"]["axis"][:2]]
    except (KeyError, TypeError):
        return None
    if len(units) != 2 or units[0] != units[1]:
        return None
    unit = {"type": "LinearUnit", "name": "metre", "conversion_factor": 1.0} if units[0] == "metre" else units[0]
    if not isinstance(unit, dict) or unit.get("type") != "LinearUnit":
        return None
    factor = unit.get("conversion_factor")
    if not isinstance(factor, int | float) or not 0.0 < factor < np.inf:
        return None
    return float(f"{1e6 * factor:.12g}"), str(unit.get("name"))[:40]


def _column(pa: Any, column: Any) -> NDArray[Any] | None:
    """Return a column of numbers, booleans or strings, or None for other types."""
    kind = column.type
    if pa.types.is_dictionary(kind):  # categories
        column = column.cast(kind.value_type)
        kind = column.type
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return string_column(["" if value is None else value for value in column.to_pylist()])
    if pa.types.is_boolean(kind) or pa.types.is_integer(kind) or pa.types.is_floating(kind):
        if column.null_count and not pa.types.is_floating(kind):
            values = column.to_pylist()
            if pa.types.is_boolean(kind) or any(value is not None and abs(value) > MAX_EXACT for value in values):
                return None
            return np.array([np.nan if value is None else value for value in values], np.float64)
        return np.asarray(column.to_numpy())
    return None


def _pyarrow(path: Path) -> tuple[Any, Any]:
    return import_optional(path, "pyarrow"), import_optional(path, "pyarrow.parquet")


def _table(path: Path, pa: Any, file: Any) -> Any:
    """
    Read all rows in batches, up to the maximum decompressed size.

    A small file may repeat one long value in very many rows.
    """
    batches, n_bytes, max_bytes = [], 0, max_decompressed_bytes(path)
    for batch in file.iter_batches(batch_size=_rows_per_batch(path, file.metadata), use_threads=False):
        n_bytes += batch.nbytes
        if n_bytes > max_bytes:
            break
        batches.append(batch)
    check_decompressed(path, n_bytes)
    return pa.Table.from_batches(batches, schema=file.schema_arrow).combine_chunks()


def _rows_per_batch(path: Path, metadata: Any) -> int:
    """
    Return the number of rows that stay within the maximum decompressed size.

    Each row may be the longest possible value of a dictionary.
    """
    # Metadata of single columns are not read: pyarrow aborts the process where they are invalid.
    longest = max((metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups)), default=1)
    return int(min(max(max_decompressed_bytes(path) // max(longest, 1), 1), BATCH))


def _check_type(path: Path, pa: Any, kind: Any, encoding: str) -> None:
    """Check the type of the geometry column before it is decompressed."""
    if encoding == "WKB":
        if not (pa.types.is_binary(kind) or pa.types.is_large_binary(kind)):
            raise FileError(path, f"has geometry of type {str(kind)[:40]}, expected binary WKB")
        return
    inner = kind
    for _ in range(NATIVE[encoding]):
        inner = inner.value_type if pa.types.is_list(inner) or pa.types.is_large_list(inner) else pa.null()
    names = [field.name for field in inner] if pa.types.is_struct(inner) else []
    if names[:2] != ["x", "y"] or names[2:] not in ([], ["z"], ["m"], ["z", "m"]):
        raise FileError(path, f"has geometry of type {str(kind)[:80]}, expected lists of coordinates x and y")


def _geometries(pa: Any, column: Any, encoding: str) -> tuple[NDArray[Any], dict[int, str]]:
    """Return polygons, multipolygons and None, and what is wrong with rows of None."""
    if encoding != "WKB":
        return _native(pa, column, NATIVE[encoding]), {}
    wkb = column.to_numpy(zero_copy_only=False)
    plain = WKB_HEADERS[POLYGON]
    others = [row for row, each in enumerate(wkb) if each is None or each[:5] not in plain]
    # Deeply nested collections would crash GEOS.
    problems = {
        row: f"must be one polygon, got {'none' if wkb[row] is None else 'another geometry'}"
        for row in others
        if not _is_multipolygon(wkb[row])
    }
    wkb = wkb.astype(object)
    wkb[list(problems)] = None
    return np.asarray(shapely.from_wkb(wkb, on_invalid="raise"), dtype=object), problems


def _is_multipolygon(wkb: bytes | None) -> bool:
    """Return whether WKB is a multipolygon whose parts are polygons."""
    number = None if wkb is None else WKB_HEADERS[MULTIPOLYGON].get(wkb[:5])
    if wkb is None or number is None:
        return False
    order: Literal["little", "big"] = "little" if wkb[0] else "big"
    at = 9 if number & WITH_SRID else 5
    n_parts, at = int.from_bytes(wkb[at : at + 4], order), at + 4
    for _ in range(n_parts):
        number = WKB_HEADERS[POLYGON].get(wkb[at : at + 5])
        if number is None:
            return False
        order = "little" if wkb[at] else "big"
        at += 9 if number & WITH_SRID else 5
        n_rings, at = int.from_bytes(wkb[at : at + 4], order), at + 4
        for _ in range(n_rings):
            if at >= len(wkb):
                return False
            at += 4 + 8 * _dimension(number) * int.from_bytes(wkb[at : at + 4], order)
    return n_parts > 0


def _dimension(number: int) -> int:
    """Return the number of coordinates of a position, from a WKB type."""
    iso = (number & 0xFFFF) // 1000
    has_z, has_m = iso in (1, 3) or bool(number & 1 << 31), iso in (2, 3) or bool(number & 1 << 30)
    return 2 + has_z + has_m


def _native(pa: Any, column: Any, depth: int) -> NDArray[Any]:
    """Return the geometries of nested lists of coordinates (GeoArrow)."""
    array = column.combine_chunks()
    array = array.chunk(0) if isinstance(array, pa.ChunkedArray) else array
    is_null = array.is_null().to_numpy(zero_copy_only=False)
    counts = []
    for _ in range(depth):
        lengths = array.value_lengths().fill_null(0).to_numpy(zero_copy_only=False).astype(np.int64)
        counts.append(lengths)
        array = array.flatten()
    used = [field.name for field in array.type if field.name != "m"]
    xy = np.stack([array.field(name).to_numpy(zero_copy_only=False).astype(np.float64) for name in used], axis=1)
    if depth == max(NATIVE.values()):
        polygons_of, rings_of, points_of = counts
    else:
        rings_of, points_of = counts
        polygons_of = np.where(is_null, 0, 1)
        rings_of = rings_of[~is_null]
    if (points_of < 4).any() or (rings_of < 1).any():
        raise FormatError("has a ring of fewer than 4 positions, or a polygon without rings")
    rings = shapely.linearrings(xy, indices=np.repeat(np.arange(points_of.size), points_of))
    polygons = shapely.polygons(rings, indices=np.repeat(np.arange(rings_of.size), rings_of))
    return grouped_polygons(polygons, polygons_of)


FORMATS.register(
    "geoparquet",
    FileFormat(
        title="GeoParquet",
        suffixes=(".parquet", ".geoparquet"),
        signatures=(MAGIC,),
        read=read,
        write=write,
        read_options=("unit", "invalid", "parts"),
    ),
)
