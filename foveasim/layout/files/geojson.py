"""
Layouts as GeoJSON (RFC 7946): one feature per site, columns as properties.

Coordinates are in µm in the sensor plane, not in degrees. Numbers have the digits required for an exact round trip. The
member ``foveasim``, which other programs ignore, contains the unit, the provenance and the types of the columns. Files without
this member are in degrees according to RFC 7946, or in the coordinate reference system that they name: the caller states the
unit of lengths.

Members that RFC 7946 does not define do not change the meaning of those that it defines (section 6.1), with the exceptions in
:data:`MEANINGFUL`.
"""

from __future__ import annotations

import json
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Floats, Ints, exact_integers
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, as_file_error
from foveasim.errors import FileError, GeometryError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_readable,
    check_site_count,
    check_table_header,
    layout_from_untrusted,
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
    check_plane,
    grouped_polygons,
    layout_of_geometries,
    required_unit,
    scaled,
    with_fix,
)
from foveasim.layout.model import Layout

__all__ = ["read", "write"]

#: Number of features formatted at a time.
CHUNK = 10_000
#: JSON has no infinity, but numbers beyond the range of float64 are read as infinity.
INFINITY = "1e999"
NUMBER_TYPES: set[type] = {int, float}
#: Larger integers are not supported.
MAX_FLOAT = 2**1023
#: With more property names, only properties of all features are columns, as names could differ for every feature.
MAX_NAMES = 256
#: Members of other standards that change the meaning of coordinates: coordinate reference systems of GeoJSON 2008 and JSON-FG,
#: quantised coordinates of TopoJSON, and the geometry of JSON-FG in its own system.
CRS = ("crs", "coordRefSys")
MEANINGFUL = (*CRS, "transform", "arcs", "place")


def write(layout: Layout, path: Path) -> WrittenLayout:
    """Write a GeoJSON FeatureCollection."""
    check_readable(layout)
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


def read(path: Path, *, unit: LengthUnit | None = None, invalid: Invalid = "error", parts: Parts = "error") -> Layout:
    """
    Read a GeoJSON FeatureCollection of polygons, in the order of the features.

    Properties of all features that are all numbers, all booleans or all strings become columns; null is NaN among
    numbers, and an empty string among strings. The provenance of the layout lists the names of other properties.
    """
    with as_file_error(path, "GeoJSON layout"):
        document = _Document(path, parts)
        if document.problems and invalid == "error":
            number, problem = next(iter(sorted(document.problems.items())))
            n_more = len(document.problems) - 1
            raise FileError(path, f"feature {number} {problem}" + f" (and {n_more} more)" * (n_more > 0))
        unit_um = _unit_um(path, document.members, unit)
        provenance, types = check_table_header(path, document.members.get("foveasim"), "GeoJSON")
        columns, dropped = document.columns(types)
        if dropped:
            provenance = {**provenance, "left_out_properties": dropped}
        xy_um, ring_offsets, polygon_offsets, polygons_of = document.outlines()
        check_plane(path, document.z, float(np.abs(xy_um).max(initial=0.0)))
        xy_um = xy_um if unit_um == 1.0 else scaled(xy_um, unit_um)
        if invalid == "error" and (polygons_of == 1).all():
            try:
                return layout_from_untrusted((xy_um, ring_offsets, polygon_offsets), columns, provenance)
            except GeometryError as error:
                raise with_fix(path, error) from None
        geometries = _geometries(xy_um, ring_offsets, polygon_offsets, polygons_of)
        return layout_of_geometries(
            path,
            geometries,
            columns,
            provenance,
            noun="feature",
            invalid=invalid,
            parts=parts,
            problems={number: problem.partition(";")[0] for number, problem in document.problems.items()},
        )


def _unit_um(path: Path, members: Mapping[str, Any], unit: LengthUnit | None) -> float:
    """Return the unit of the coordinates in µm, which only files of foveasim state."""
    for name in MEANINGFUL:
        if members.get(name) is not None and name not in CRS:
            raise FileError(
                path, f"has the member {name!r}, which changes its coordinates; convert it to plain GeoJSON"
            )
    if members.get("foveasim") is not None:
        return agreed_unit(path, unit, 1.0, "µm")
    systems = [json.dumps(members[name])[:80] for name in CRS if members.get(name) is not None]
    if systems:
        return required_unit(path, unit, f"has coordinates in the reference system {systems[0]}")
    return required_unit(
        path,
        unit,
        "has coordinates in degrees of longitude and latitude, as all GeoJSON files (RFC 7946) but those of foveasim",
    )


def _geometries(xy_um: Floats, ring_offsets: Ints, polygon_offsets: Ints, polygons_of: Ints) -> NDArray[Any]:
    """Return shapely geometries of the features: polygons, multipolygons, or None."""
    rings = shapely.linearrings(xy_um, indices=np.repeat(np.arange(ring_offsets.size - 1), np.diff(ring_offsets)))
    polygons = shapely.polygons(rings, indices=np.repeat(np.arange(polygon_offsets.size - 1), np.diff(polygon_offsets)))
    return grouped_polygons(polygons, polygons_of)


class _Number(int):
    """Number of a feature in the order in which features of a document end."""


class _Document:
    """
    FeatureCollection, decoded feature by feature.

    As Python objects, all features together would require ten times the memory of their text.

    ``members``: members of the collection other than the features. ``rows``: properties of the features.
    """

    def __init__(self, path: Path, parts: Parts) -> None:
        self._properties: list[dict[str, Any]] = []
        self._problems: dict[int, str] = {}
        self._n_polygons, self._n_rings, self._n_vertices, self._xy = array("q"), array("q"), array("q"), array("d")
        self._z = [math.inf, -math.inf]
        self._parts = parts
        document = json.loads(path.read_text(encoding="utf-8-sig"), object_hook=self._take)
        features = document.pop("features", None) if isinstance(document, dict) else None
        if not isinstance(features, list) or document.get("type") != "FeatureCollection":
            raise FileError(path, "is not a GeoJSON FeatureCollection")
        check_site_count(path, len(features))
        numbers = [each if type(each) is _Number else self._add(each) for each in features]
        self.problems = {i: self._problems[number] for i, number in enumerate(numbers) if number in self._problems}
        self.members = document
        self.rows = [self._properties[number] for number in numbers]
        self._numbers = np.array(numbers, np.int64)

    @property
    def z(self) -> Floats:
        """Smallest and largest third coordinate, infinite if there are none."""
        return np.array(self._z, np.float64)

    def _take(self, item: dict[str, Any]) -> Any:
        """Add a feature and return its number; return other objects as they are."""
        return self._add(item) if item.get("type") == "Feature" and "geometry" in item else item

    def _add(self, feature: Any) -> _Number:
        """Add the outlines and the properties of a feature, or its problem."""
        number = _Number(len(self._properties))
        properties = feature.get("properties") if isinstance(feature, dict) else None
        self._properties.append(properties if isinstance(properties, dict) else {})
        before = len(self._n_rings), len(self._n_vertices), len(self._xy)
        problem = self._add_outlines(feature.get("geometry") if isinstance(feature, dict) else None)
        other = next((name for name in MEANINGFUL if isinstance(feature, dict) and feature.get(name) is not None), None)
        if other is not None:
            problem = f"has the member {other!r}, which changes its coordinates; convert it to plain GeoJSON"
        if problem:
            self._problems[number] = problem
            del self._n_rings[before[0] :], self._n_vertices[before[1] :], self._xy[before[2] :]
        self._n_polygons.append(len(self._n_rings) - before[0])
        return number

    def _add_outlines(self, geometry: Any) -> str:
        """Add the polygons of a geometry; return why it is invalid."""
        kind, polygons = (
            (geometry.get("type"), geometry.get("coordinates")) if isinstance(geometry, dict) else (None, None)
        )
        if kind == "Polygon":
            polygons = [polygons]
        elif kind != "MultiPolygon" or not isinstance(polygons, list) or not polygons:
            return f"must be one polygon, got {str(kind)[:40]}; write one feature per site, or pass invalid='skip'"
        if len(polygons) > 1 and self._parts == "error":
            return f"must be one polygon, got one of {len(polygons)} parts; pass parts='split' or parts='largest'"
        for rings in polygons:
            problem = self._add_rings(rings)
            if problem:
                return problem
            self._n_rings.append(len(rings))
        return ""

    def _add_rings(self, rings: Any) -> str:
        """Add the rings of a polygon; return why they are invalid."""
        if not isinstance(rings, list) or not rings:
            return "must be one polygon, got no rings; write one feature per site, or pass invalid='skip'"
        for ring in rings:
            if not isinstance(ring, list) or len(ring) < 4:
                return "has a ring of fewer than 4 positions"
            for position in ring:
                # type() instead of isinstance(), as booleans are integers in Python.
                if (
                    type(position) is not list
                    or not 2 <= len(position) <= 3
                    or not {*map(type, position)} <= NUMBER_TYPES
                ):
                    return "has a position that is not two or three numbers"
            for position in ring:
                self._xy.append(position[0])
                self._xy.append(position[1])
                if len(position) == 3:
                    self._z = [min(self._z[0], position[2]), max(self._z[1], position[2])]
            self._n_vertices.append(len(ring))
        return ""

    def outlines(self) -> tuple[Floats, Ints, Ints, Ints]:
        """
        Return the packed rings of the features, unchecked, without those of other members.

        The last array is the number of polygons of each feature.
        """
        polygons, _ = _runs(np.array(self._n_polygons, np.int64), self._numbers)
        rings, polygon_offsets = _runs(np.array(self._n_rings, np.int64), polygons)
        points, ring_offsets = _runs(np.array(self._n_vertices, np.int64), rings)
        xy = np.array(self._xy, np.float64).reshape(-1, 2)[points]
        return xy, ring_offsets, polygon_offsets, np.array(self._n_polygons, np.int64)[self._numbers]

    def columns(self, types: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
        """Return the columns of the properties, and the names of unsupported properties."""
        n_rows = Counter(chain.from_iterable(self.rows))
        names = dict.fromkeys(chain(types, n_rows))
        columns, dropped = {}, []
        for name in names:
            is_candidate = len(names) <= MAX_NAMES or n_rows[name] == len(self.rows)
            column = _column([row.get(name) for row in self.rows], types.get(name)) if is_candidate else None
            if column is None:
                dropped.append(name)
            else:
                columns[name] = column
        return columns, dropped


def _runs(counts: Ints, chosen: Ints) -> tuple[Ints, Ints]:
    """Return the positions of the elements of some runs, and the offsets of these runs."""
    starts, sizes = (np.cumsum(counts) - counts)[chosen], counts[chosen]
    return np.repeat(starts, sizes) + positions_in_runs(sizes), np.concatenate(([0], np.cumsum(sizes)))


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
    "geojson",
    FileFormat(
        title="GeoJSON",
        suffixes=(".geojson", ".json"),
        matches=_is_json,
        read=read,
        write=write,
        read_options=("unit", "invalid", "parts"),
    ),
)
