"""
Layouts as GeoJSON (RFC 7946): one feature per site, columns as properties.

Coordinates are in µm in the sensor plane, not in degrees. Numbers have the digits required for an exact round trip. The
member ``foveasim``, which other programs ignore, contains the unit, the provenance and the types of the columns.
"""

from __future__ import annotations

import json
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Ints, exact_integers
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, as_file_error
from foveasim.errors import FileError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_site_count,
    check_table_header,
    layout_from_untrusted,
    plain_columns,
    restore_column,
    string_column,
    table_header,
)
from foveasim.layout.model import Layout

__all__ = ["read", "write"]

#: Number of features formatted at a time.
CHUNK = 10_000
#: JSON has no infinity, but numbers beyond the range of float64 are read as infinity.
INFINITY = "1e999"
NUMBER_TYPES: set[type] = {int, float}
#: Integers up to the first are exact in float64; integers above the second are not supported.
MAX_EXACT, MAX_FLOAT = 2**53, 2**1023
#: With more property names, only properties of all features are columns, as names could differ for every feature.
MAX_NAMES = 256


def write(layout: Layout, path: Path) -> WrittenLayout:
    """Write a GeoJSON FeatureCollection."""
    columns = plain_columns(layout, "GeoJSON")
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f'{{"type": "FeatureCollection", "foveasim": {json.dumps(table_header(layout))}, "features": [')
        for start in range(0, layout.n_sites, CHUNK):
            file.write(",\n" if start else "\n")
            file.write(",\n".join(_features(layout[start : start + CHUNK], columns, start)))
        file.write("\n]}\n")
    return WrittenLayout(path=path, n_sites=layout.n_sites)


def _features(layout: Layout, columns: Mapping[str, NDArray[Any]], start: int) -> Iterator[str]:
    geometries = shapely.to_geojson(layout.polygons())
    stop = start + layout.n_sites
    members = [
        [f"{json.dumps(name)}: {t}" for t in _json_strings(values[start:stop])] for name, values in columns.items()
    ]
    properties = map(", ".join, zip(*members, strict=True)) if members else iter([""] * layout.n_sites)
    for i, (geometry, line) in enumerate(zip(geometries, properties, strict=True), start):
        yield f'{{"type": "Feature", "id": {i}, "properties": {{{line}}}, "geometry": {geometry}}}'


def _json_strings(values: NDArray[Any]) -> list[str]:
    """Return the values of a column as JSON, NaN as null."""
    # The shortest digits of a float32 are not exact in float64.
    plain = values.astype(np.float64) if values.dtype.kind == "f" else values
    strings = [json.dumps(v) for v in plain.tolist()]
    return [{"NaN": "null", "Infinity": INFINITY, "-Infinity": "-" + INFINITY}.get(t, t) for t in strings]


def read(path: Path) -> Layout:
    """
    Read a GeoJSON FeatureCollection of polygons, in the order of the features.

    Properties of all features that are all numbers, all booleans or all strings become columns; null is NaN among
    numbers, and an empty string among strings. The provenance of the layout lists the names of other properties.
    """
    with as_file_error(path, "GeoJSON layout"):
        document = _Document(path)
        polygons = document.outlines()
        provenance, types = check_table_header(path, document.members.get("foveasim"), "GeoJSON")
        columns, dropped = document.columns(types)
        if dropped:
            provenance = {**provenance, "left_out_properties": dropped}
        return layout_from_untrusted(polygons, columns, provenance)


class _Document:
    """
    FeatureCollection, decoded feature by feature.

    As Python objects, all features together would require ten times the memory of their text.

    ``members``: members of the collection other than the features.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows: list[dict[str, Any]] = []
        self._rings_of_site = array("q")
        self._vertices_of_ring = array("q")
        self._xy = array("d")
        document = json.loads(path.read_text(encoding="utf-8-sig"), object_hook=self._take)
        features = document.get("features") if isinstance(document, dict) else None
        if not isinstance(features, list) or document.get("type") != "FeatureCollection":
            raise FileError(path, "is not a GeoJSON FeatureCollection")
        for i, number in enumerate(features):
            if number != i:
                raise FileError(path, f"feature {i} must be one polygon in a Feature; write one feature per site")
        self.members = document

    def _take(self, item: dict[str, Any]) -> Any:
        """Add a feature and return its number; return other objects as they are."""
        if item.get("type") != "Feature" or "geometry" not in item:
            return item
        i = len(self._rows)
        check_site_count(self.path, i + 1)
        geometry = item["geometry"]
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        rings = geometry.get("coordinates") if isinstance(geometry, dict) else None
        if kind == "MultiPolygon" and isinstance(rings, list) and len(rings) == 1:
            kind, rings = "Polygon", rings[0]
        if kind != "Polygon" or not isinstance(rings, list) or not rings:
            raise FileError(
                self.path, f"feature {i} must be one polygon, got {str(kind)[:40]}; write one feature per site"
            )
        self._rings_of_site.append(len(rings))
        for ring in rings:
            if not isinstance(ring, list) or len(ring) < 4:
                raise FileError(self.path, f"feature {i} has a ring of fewer than 4 positions")
            self._vertices_of_ring.append(len(ring))
            for position in ring:
                # type() instead of isinstance(), as booleans are integers in Python.
                if (
                    type(position) is not list
                    or not 2 <= len(position) <= 3
                    or not {*map(type, position)} <= NUMBER_TYPES
                ):
                    raise FileError(self.path, f"feature {i} has a position that is not two or three numbers")
                self._xy.append(position[0])
                self._xy.append(position[1])
        properties = item.get("properties")
        self._rows.append(properties if isinstance(properties, dict) else {})
        return i

    def outlines(self) -> tuple[Floats, Ints, Ints]:
        """Return the packed rings of all features, unchecked."""
        ring_offsets = np.concatenate(([0], np.cumsum(np.array(self._vertices_of_ring, np.int64))))
        site_offsets = np.concatenate(([0], np.cumsum(np.array(self._rings_of_site, np.int64))))
        return np.array(self._xy, np.float64).reshape(-1, 2), ring_offsets, site_offsets

    def columns(self, types: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
        """Return the columns of the properties, and the names of unsupported properties."""
        n_rows = Counter(chain.from_iterable(self._rows))
        names = dict.fromkeys(chain(types, n_rows))
        columns, dropped = {}, []
        for name in names:
            is_candidate = len(names) <= MAX_NAMES or n_rows[name] == len(self._rows)
            column = _column([row.get(name) for row in self._rows], types.get(name)) if is_candidate else None
            if column is None:
                dropped.append(name)
            else:
                columns[name] = column
        return columns, dropped


def _is_exact(value: Any) -> bool:
    """Return whether a value is exact in float64, if it is an integer."""
    return type(value) is not int or abs(value) <= MAX_EXACT or (abs(value) < MAX_FLOAT and int(float(value)) == value)


def _column(values: list[Any], dtype: Any) -> NDArray[Any] | None:
    kinds = {type(v) for v in values}
    plain = kinds - {type(None)}
    if not values:
        return restore_column(np.zeros(0), dtype)
    if plain == {str}:
        text = string_column(["" if v is None else v for v in values])
        return None if text is None else restore_column(text, dtype)
    if kinds == {bool}:
        return restore_column(np.array(values), dtype)
    if kinds == {int}:
        column = exact_integers(values)
        return None if column is None else restore_column(column, dtype)
    if not all(_is_exact(v) for v in values):
        return None
    if (plain and plain <= {int, float}) or (not plain and str(dtype)[1:2] == "f"):
        return restore_column(np.array([np.nan if v is None else v for v in values], dtype=np.float64), dtype)
    return None


def _is_json(_path: Path, head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


FORMATS.register(
    "geojson", FileFormat(title="GeoJSON", suffixes=(".geojson", ".json"), matches=_is_json, read=read, write=write)
)
