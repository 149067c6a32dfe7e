"""
Layouts as GeoJSON (RFC 7946): one feature per site, columns as properties.

Coordinates are in µm in the sensor plane, not in degrees. Numbers have the digits required for an exact round trip. The
member ``foveasim``, which other programs ignore, contains the unit, the provenance and the types of the columns.
"""

from __future__ import annotations

import json
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
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
    check_header,
    check_site_count,
    dtype_strings,
    header,
    layout_from_untrusted,
    lossless_report,
    plain_columns,
    restore_column,
    string_column,
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
_BLANK = re.compile(r"[ \t\r\n]*")


def write(layout: Layout, path: Path) -> WrittenLayout:
    """
    Write a GeoJSON FeatureCollection.

    Raises ParameterError when a column contains neither numbers nor strings. Raises FileError when the file cannot be written.
    """
    columns = plain_columns(layout, "GeoJSON")
    about = {**header(layout), "columns": dtype_strings(layout)}
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f'{{"type": "FeatureCollection", "foveasim": {json.dumps(about)}, "features": [')
        for start in range(0, layout.n_sites, CHUNK):
            file.write(",\n" if start else "\n")
            file.write(",\n".join(_features(layout[start : start + CHUNK], columns, start)))
        file.write("\n]}\n")
    return lossless_report(layout, path)


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

    Raises FileError when the file is corrupt, too large, or contains other geometries than polygons.
    """
    with as_file_error(path, "GeoJSON layout"):
        document = _Document(path)
        polygons = document.outlines()
        types: Any = {}
        provenance: dict[str, Any] = {"made_by": "read_layout", "file": path.name, "format": "GeoJSON"}
        about = document.members.get("foveasim")
        if about is not None:
            provenance = check_header(path, about)
            types = about.get("columns")
        columns, dropped = document.columns(types if isinstance(types, dict) else {})
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
        self.members: dict[str, Any] = {}
        self._rows: list[dict[str, Any]] = []
        self._rings_of_site = array("q")
        self._vertices_of_ring = array("q")
        self._xy = array("d")
        text = path.read_text(encoding="utf-8-sig")
        for key, value in _members(text, self._add):
            self.members[key] = value
        if self.members.get("type") != "FeatureCollection" or "features" not in self.members:
            raise FileError(path, "is not a GeoJSON FeatureCollection")

    def _add(self, feature: Any) -> None:
        """Add the outline and the properties of a feature."""
        i = len(self._rows)
        check_site_count(self.path, i + 1)
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
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
        properties = feature.get("properties")
        self._rows.append(properties if isinstance(properties, dict) else {})

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


def _members(text: str, add: Callable[[Any], None]) -> Iterator[tuple[str, Any]]:
    """Yield the members of a JSON object; pass elements of ``features`` to ``add`` instead."""
    decode = json.JSONDecoder().raw_decode

    def after(at: int, expected: str) -> int:
        at = _BLANK.match(text, at).end()  # type: ignore[union-attr]
        if at >= len(text) or text[at] not in expected:
            raise ValueError(f"expected one of {' '.join(expected)} at character {at}")
        return at + 1

    at, key = after(0, "{"), ""
    while True:
        at = after(at, '"') - 1
        key, at = decode(text, at)
        at = _BLANK.match(text, after(at, ":")).end()  # type: ignore[union-attr]
        if key == "features":
            yield key, None
            at = after(at, "[")
            end = _BLANK.match(text, at).end()  # type: ignore[union-attr]
            if text[end : end + 1] == "]":
                at = end + 1
            else:
                while True:
                    feature, at = decode(text, _BLANK.match(text, at).end())  # type: ignore[union-attr]
                    add(feature)
                    at = after(at, ",]")
                    if text[at - 1] == "]":
                        break
        else:
            value, at = decode(text, at)
            yield key, value
        at = after(at, ",}")
        if text[at - 1] == "}":
            break
    if text[at:].strip():
        raise ValueError(f"unexpected data after the end at character {at}")


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
