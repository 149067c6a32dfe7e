"""
Layouts as GeoJSON (RFC 7946), for programs that know maps: one feature a site, its columns as properties.

Coordinates are µm in the sensor's plane and not degrees; numbers have as many digits as it takes to be the same again.
What GeoJSON does not know (unit, origin, types of the columns) stands in the member ``foveasim``, which others ignore.
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
    WrittenLayout,
    check_header,
    check_sites_of,
    checked_layout,
    dtype_text,
    header,
    lossless,
    plain_columns,
    restored_column,
    texts,
)
from foveasim.layout.files._formats import FORMATS
from foveasim.layout.model import Layout

__all__ = ["read", "write"]

#: Features that are made into text at a time.
CHUNK = 10_000
#: JSON has no infinity, but numbers beyond float64, which are read as such.
INFINITY = "1e999"
NUMBERS = {int, float}
#: All integers up to this are floating-point numbers, and none beyond the other is.
MAX_EXACT, MAX_FLOAT = 2**53, 2**1023
#: Among more names of properties, only those of all features are columns: other names could be new for every feature.
MAX_NAMES = 256
_BLANK = re.compile(r"[ \t\r\n]*")


def write(layout: Layout, path: Path) -> WrittenLayout:
    """
    Write a collection of features.

    Raises
    ------
    ParameterError
        When a column holds neither numbers nor text.
    FileError
        When nothing can be written there.
    """
    columns = plain_columns(layout, "GeoJSON")
    about = {**header(layout), "columns": dtype_text(layout)}
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f'{{"type": "FeatureCollection", "foveasim": {json.dumps(about)}, "features": [')
        for start in range(0, layout.n_sites, CHUNK):
            file.write(",\n" if start else "\n")
            file.write(",\n".join(_features(layout[start : start + CHUNK], columns, start)))
        file.write("\n]}\n")
    return lossless(layout, path)


def _features(layout: Layout, columns: Mapping[str, NDArray[Any]], start: int) -> Iterator[str]:
    geometries = shapely.to_geojson(layout.polygons())
    stop = start + layout.n_sites
    texts = [[f"{json.dumps(name)}: {t}" for t in _texts(values[start:stop])] for name, values in columns.items()]
    properties = map(", ".join, zip(*texts, strict=True)) if texts else iter([""] * layout.n_sites)
    for i, (geometry, line) in enumerate(zip(geometries, properties, strict=True), start):
        yield f'{{"type": "Feature", "id": {i}, "properties": {{{line}}}, "geometry": {geometry}}}'


def _texts(values: NDArray[Any]) -> list[str]:
    """Values of a column as JSON; a float that is no number as null."""
    # The shortest digits of a float32 are those of another number than its own.
    plain = values.astype(np.float64) if values.dtype.kind == "f" else values
    texts = [json.dumps(v) for v in plain.tolist()]
    return [{"NaN": "null", "Infinity": INFINITY, "-Infinity": "-" + INFINITY}.get(t, t) for t in texts]


def read(path: Path) -> Layout:
    """
    Read a collection of polygons, in the order of the features.

    Properties that every feature has, and that are all numbers, all truth values or all text, become columns; null
    among numbers is NaN, among text the empty text. The names of others stand in the layout's provenance.

    Raises
    ------
    FileError
        When it is broken, too large, or holds something else than polygons.
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
        columns, left_out = document.columns(types if isinstance(types, dict) else {})
        if left_out:
            provenance = {**provenance, "left_out_properties": left_out}
        return checked_layout(polygons, columns, provenance)


class _Document:
    """
    A collection of features, read one by one: as objects of Python all together would take ten times their text.

    Attributes
    ----------
    members : dict
        Members of the collection beside the features.
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
            raise FileError(path, "is no GeoJSON FeatureCollection")

    def _add(self, feature: Any) -> None:
        """Keep the outline and the properties of one more feature."""
        i = len(self._rows)
        check_sites_of(self.path, i + 1)
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        rings = geometry.get("coordinates") if isinstance(geometry, dict) else None
        if kind == "MultiPolygon" and isinstance(rings, list) and len(rings) == 1:
            kind, rings = "Polygon", rings[0]
        if kind != "Polygon" or not isinstance(rings, list) or not rings:
            raise FileError(self.path, f"feature {i} must be one polygon, got {str(kind)[:40]}; a site is one piece")
        self._rings_of_site.append(len(rings))
        for ring in rings:
            if not isinstance(ring, list) or len(ring) < 4:
                raise FileError(self.path, f"feature {i} has a ring of fewer than 4 positions")
            self._vertices_of_ring.append(len(ring))
            for position in ring:
                # type() and not isinstance(): true and false are integers to Python.
                if type(position) is not list or not 2 <= len(position) <= 3 or not {*map(type, position)} <= NUMBERS:
                    raise FileError(self.path, f"feature {i} has a position that is not two numbers")
                self._xy.append(position[0])
                self._xy.append(position[1])
        properties = feature.get("properties")
        self._rows.append(properties if isinstance(properties, dict) else {})

    def outlines(self) -> tuple[Floats, Ints, Ints]:
        """Packed rings of all features, as they stand there."""
        ring_offsets = np.concatenate(([0], np.cumsum(np.array(self._vertices_of_ring, np.int64))))
        site_offsets = np.concatenate(([0], np.cumsum(np.array(self._rings_of_site, np.int64))))
        return np.array(self._xy, np.float64).reshape(-1, 2), ring_offsets, site_offsets

    def columns(self, types: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
        """Columns of the features' properties, and the names of those that are none."""
        n_rows = Counter(chain.from_iterable(self._rows))
        names = dict.fromkeys(chain(types, n_rows))
        columns, left_out = {}, []
        for name in names:
            is_looked_at = len(names) <= MAX_NAMES or n_rows[name] == len(self._rows)
            column = _column([row.get(name) for row in self._rows], types.get(name)) if is_looked_at else None
            if column is None:
                left_out.append(name)
            else:
                columns[name] = column
        return columns, left_out


def _members(text: str, add: Callable[[Any], None]) -> Iterator[tuple[str, Any]]:
    """Members of the object that a text is; elements of the list ``features`` are handed over and not kept."""
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
        raise ValueError(f"something follows the end at character {at}")


def _is_exact(value: Any) -> bool:
    """Whether a float64 contains a value, where it is an integer."""
    return type(value) is not int or abs(value) <= MAX_EXACT or (abs(value) < MAX_FLOAT and int(float(value)) == value)


def _column(values: list[Any], dtype: Any) -> NDArray[Any] | None:
    kinds = {type(v) for v in values}
    plain = kinds - {type(None)}
    if not values:
        return restored_column(np.zeros(0), dtype)
    if plain == {str}:
        text = texts(["" if v is None else v for v in values])
        return None if text is None else restored_column(text, dtype)
    if kinds == {bool}:
        return restored_column(np.array(values), dtype)
    if kinds == {int}:
        column = exact_integers(values)
        return None if column is None else restored_column(column, dtype)
    if not all(_is_exact(v) for v in values):
        return None
    if (plain and plain <= {int, float}) or (not plain and str(dtype)[1:2] == "f"):
        return restored_column(np.array([np.nan if v is None else v for v in values], dtype=np.float64), dtype)
    return None


def _is_json(_path: Path, head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


FORMATS.register(
    "geojson", FileFormat(title="GeoJSON", suffixes=(".geojson", ".json"), matches=_is_json, read=read, write=write)
)
