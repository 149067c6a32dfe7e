"""Design rule reports as KLayout report databases (``.lyrdb``)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import shapely

from foveasim._core.extras import import_optional
from foveasim._core.names import missing_path
from foveasim._io.atomic import atomic_write
from foveasim._io.text_files import parse_xml
from foveasim.errors import FileError

if TYPE_CHECKING:
    from foveasim.layout.drc.rules import Report

__all__ = ["is_lyrdb", "read_lyrdb", "write_lyrdb"]

#: Cell of the photosites in GDSII and OASIS files.
CELL_NAME = "SENSOR"
#: Larger files are rejected.
MAX_BYTES = 2**29
#: Number of first bytes that are searched for the root element.
HEAD_BYTES = 512
#: Patterns of the category descriptions and item texts of write_lyrdb.
DESCRIPTION = re.compile(
    r"^(?P<description>.*) \(limit (?P<limit>\S+) ?(?P<unit>[^)]*)\)(?:; (?P<note>.*))?$", re.DOTALL
)
VIOLATION = re.compile(r"photosite (?P<sites>\d+(?:, \d+)*): (?P<value>\S+) ?(?P<unit>[^']*)")
#: Points of one ring, edge or box of a marker.
POINTS = re.compile(r"\(([^()]*)\)")

#: Description, limit, unit and note of a rule; sites, value and marker of a violation.
_RuleInfo: TypeAlias = tuple[str, float, str, str]
_Item: TypeAlias = tuple[tuple[int, ...], float, Any]


def write_lyrdb(report: Report, path: str | Path) -> None:
    """
    Write a report for KLayout's marker browser, atomically.

    ``path``: file with the extension ``.lyrdb``. It contains one category per rule and one item per violation, with the site
    indices, the measured value, and the marker in µm.
    """
    target = Path(path)
    if target.suffix != ".lyrdb":
        raise FileError(target, "must end in .lyrdb")
    db, rdb = import_optional(target, "klayout.db"), import_optional(target, "klayout.rdb")
    database = rdb.ReportDatabase("foveasim design rules")
    database.generator = "foveasim"
    database.top_cell_name = CELL_NAME
    cell = database.create_cell(CELL_NAME).rdb_id()
    for result in report.results:
        category = database.create_category(result.rule)
        note = f"; {result.note}" if result.note else ""
        category.description = f"{result.description} (limit {result.limit:g} {result.unit}){note}"
        for violation in result.violations:
            item = database.create_item(cell, category.rdb_id())
            sites = ", ".join(map(str, violation.site_ids))
            item.add_value(f"photosite {sites}: {violation.value:.9g} {violation.unit}".strip())
            for shape in _shapes(db, violation.marker):
                item.add_value(shape)
    with atomic_write(target) as temporary:
        database.save(str(temporary))


def _shapes(db: Any, marker: Any) -> list[Any]:
    """Convert a marker to KLayout shapes in µm."""

    def points(ring: Any) -> list[Any]:
        return [db.DPoint(float(x), float(y)) for x, y in shapely.get_coordinates(ring)]

    shapes: list[Any] = []
    for part in shapely.get_parts(marker):
        if part.is_empty:
            continue
        if isinstance(part, shapely.Polygon):
            polygon = db.DPolygon(points(part.exterior)[:-1])
            for hole in part.interiors:
                polygon.insert_hole(points(hole)[:-1])
            shapes.append(polygon)
        else:
            corners = points(part)
            shapes += [db.DEdge(a, b) for a, b in zip(corners, corners[1:] or corners, strict=False)]
    return shapes


def is_lyrdb(path: str | Path) -> bool:
    """Return whether a file is a KLayout report database, from its first bytes."""
    path = Path(path)
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return b"<report-database>" in file.read(HEAD_BYTES)


def read_lyrdb(path: str | Path, n_sites: int) -> Report:
    """
    Read a KLayout report database of :func:`write_lyrdb` or of another program.

    ``n_sites``: number of sites of the checked layout, which the file does not contain. Violations from another
    program have no sites, and NaN as value and limit. The file does not contain waivers.
    """
    from foveasim.layout.drc.rules import Report

    source = Path(path)
    if not source.is_file():
        raise FileError(source, missing_path(source))
    if source.stat().st_size > MAX_BYTES:
        raise FileError(source, f"is larger than {MAX_BYTES} bytes")
    root = parse_xml(source, source.read_bytes(), "report-database", "KLayout report database")
    found: dict[str, list[_Item]] = {}
    about: dict[str, _RuleInfo] = {}
    for name, category in _categories(root):
        match = DESCRIPTION.match(category.findtext("description") or "")
        about[name] = (
            (match["description"], _number(match["limit"]), match["unit"], match["note"] or "")
            if match
            else (name, np.nan, "", "")
        )
        found[name] = []
    for item in root.iterfind("items/item"):
        name = (item.findtext("category") or "").strip().strip("'")
        sites, value, marker = _item(source, item)
        if any(site >= n_sites for site in sites):
            raise FileError(
                source, f"contains site {max(sites)}, but the layout has {n_sites} sites; use the report of this layout"
            )
        found.setdefault(name, []).append((sites, value, marker))
    return Report(
        n_sites, tuple(_result(name, about.get(name, (name, np.nan, "", "")), items) for name, items in found.items())
    )


def _result(name: str, about: _RuleInfo, items: list[_Item]) -> Any:
    from foveasim.layout.drc.rules import RuleResult

    description, limit, unit, note = about
    values = np.array([value for _, value, _ in items], dtype=np.float64)
    sites, markers = [sites for sites, _, _ in items], [marker for _, _, marker in items]
    return RuleResult(name, description, limit, unit, values, None, lambda part: (sites[part], markers[part]), note)


def _categories(root: Any, parent: str = "") -> list[tuple[str, Any]]:
    """Return categories and subcategories by the full names that items refer to."""
    found = []
    for category in root.iterfind("categories/category"):
        name = parent + (category.findtext("name") or "").strip()
        found += [(name, category), *_categories(category, name + ".")]
    return found


def _item(source: Path, item: Any) -> _Item:
    """Return the sites, value and marker of an item."""
    sites: tuple[int, ...] = ()
    value = np.nan
    shapes = []
    for element in item.iterfind("values/value"):
        # A tag in brackets may precede the type: "[#name] polygon: (...)".
        kind, colon, text = (element.text or "").strip().removeprefix("[").partition(":")
        match = VIOLATION.search(text)
        if kind.endswith("text") and match:
            sites, value = tuple(map(int, match["sites"].split(", "))), _number(match["value"])
        elif colon and kind.split(" ")[-1] in {"polygon", "edge", "edge-pair", "box", "path"}:
            try:
                shapes += _geometries(kind.split(" ")[-1], text)
            except ValueError:
                raise FileError(source, f"contains an invalid marker: {text.strip()[:60]}") from None
    return sites, value, shapely.GeometryCollection(shapes) if len(shapes) != 1 else shapes[0]


def _geometries(kind: str, text: str) -> list[Any]:
    """Convert KLayout's string of a shape to shapely geometries."""
    rings = []
    for points in POINTS.findall(text):
        for part in points.split("/"):
            corners = [tuple(map(float, point.split(","))) for point in part.split(";")]
            if any(len(corner) != 2 or not np.isfinite(corner).all() for corner in corners):
                raise ValueError(text)
            rings.append(corners)
    if not rings:
        raise ValueError(text)
    if kind == "box":
        return [shapely.box(*rings[0][0], *rings[0][-1])]
    if kind == "polygon":
        return [shapely.Polygon(rings[0], rings[1:])] if len(rings[0]) > 2 else [shapely.MultiPoint(rings[0])]
    return [shapely.LineString(ring) if len(ring) > 1 else shapely.Point(ring[0]) for ring in rings]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan
