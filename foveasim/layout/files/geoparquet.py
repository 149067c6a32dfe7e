"""
Layouts as GeoParquet 1.1, through pyarrow.

Outlines are WKB, and columns are Parquet columns. The files are exact and small, and GIS programs read them. Coordinates
are in µm in the sensor plane, without a coordinate reference system. The metadata ``foveasim`` contain unit and provenance.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, as_file_error
from foveasim.errors import FileError, ParameterError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_decompressed,
    check_readable,
    check_site_count,
    check_table_header,
    layout_from_untrusted,
    max_decompressed_bytes,
    plain_columns,
    restore_column,
    string_column,
    table_header,
)
from foveasim.layout.model import Layout

__all__ = ["MAGIC", "read", "write"]

MAGIC = b"PAR1"
GEOMETRY = "geometry"
VERSION = "1.1.0"
#: Number of rows decompressed at a time.
BATCH = 4096
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
        "crs": None,
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


def read(path: Path) -> Layout:
    """Read a table of polygons, in the order of its rows."""
    pa, parquet = _pyarrow(path)
    with as_file_error(path, "GeoParquet layout"), parquet.ParquetFile(path, page_checksum_verification=True) as file:
        check_site_count(path, file.metadata.num_rows)
        check_decompressed(path, sum(file.metadata.row_group(i).total_byte_size for i in range(file.num_row_groups)))
        metadata = file.metadata.metadata or {}
        if b"geo" not in metadata:
            raise FileError(path, "is a Parquet table without geometry: it has no metadata 'geo'")
        geo = json.loads(metadata[b"geo"])
        name = geo["primary_column"]
        if geo["columns"][name]["encoding"] != "WKB":
            raise FileError(path, f"has the geometry encoding {geo['columns'][name]['encoding']!r:.40}, expected WKB")
        kind = file.schema_arrow.field(name).type
        if not (pa.types.is_binary(kind) or pa.types.is_large_binary(kind)):
            raise FileError(path, f"has geometry of type {str(kind)[:40]}, expected binary WKB")
        table = _table(path, pa, file)
        if table.num_rows != file.metadata.num_rows:
            raise FileError(
                path, f"is corrupt: it contains {table.num_rows} rows, but declares {file.metadata.num_rows}"
            )
        table.validate(full=True)
        polygons = _polygons(path, table.column(name).to_numpy(zero_copy_only=False))
        provenance, types = check_table_header(path, json.loads(metadata.get(b"foveasim", "null")), "GeoParquet")
        columns, dropped = {}, []
        for other in table.column_names:
            kind = table.schema.field(other).type
            if other == name:
                continue
            is_number = pa.types.is_boolean(kind) or pa.types.is_integer(kind) or pa.types.is_floating(kind)
            is_string = pa.types.is_string(kind) or pa.types.is_large_string(kind)
            has_null = table.column(other).null_count > 0
            values = None
            if (is_number or is_string) and not (has_null and not pa.types.is_floating(kind)):
                values = string_column(table.column(other).to_pylist()) if is_string else table.column(other).to_numpy()
            if values is None:
                dropped.append(other)
            else:
                columns[other] = restore_column(values, types.get(other))
        if dropped:
            provenance = {**provenance, "left_out_columns": dropped}
        return layout_from_untrusted(polygons, columns, provenance)


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


def _polygons(path: Path, outlines: NDArray[Any]) -> NDArray[Any]:
    """Convert WKB to polygons; multipolygons of one polygon are supported."""
    plain = WKB_HEADERS[POLYGON]
    others = [row for row, wkb in enumerate(outlines) if wkb is None or wkb[:5] not in plain]
    for row in others:
        # Deeply nested collections would crash GEOS.
        if not _is_multipolygon_of_one(outlines[row]):
            raise FileError(path, f"row {row} must be one polygon; write one row per site")
    geometries = np.asarray(shapely.from_wkb(outlines, on_invalid="raise"), dtype=object)
    geometries[others] = shapely.get_geometry(geometries[others], 0)
    return geometries


def _is_multipolygon_of_one(wkb: bytes | None) -> bool:
    number = None if wkb is None else WKB_HEADERS[MULTIPOLYGON].get(wkb[:5])
    if wkb is None or number is None:
        return False
    at = 9 if number & WITH_SRID else 5
    n_parts = int.from_bytes(wkb[at : at + 4], "little" if wkb[0] else "big")
    return n_parts == 1 and wkb[at + 4 : at + 9] in WKB_HEADERS[POLYGON]


FORMATS.register(
    "geoparquet",
    FileFormat(title="GeoParquet", suffixes=(".parquet", ".geoparquet"), signatures=(MAGIC,), read=read, write=write),
)
