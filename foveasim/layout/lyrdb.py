"""Reports of design rules as KLayout's report database, to be opened over the chip layout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import shapely

from foveasim.errors import FileError
from foveasim.files import written_whole

if TYPE_CHECKING:
    from foveasim.layout.rules import Report

__all__ = ["write_lyrdb"]

#: Cell that the photosites of a chip file lie in.
CELL_NAME = "SENSOR"


def write_lyrdb(report: Report, path: str | Path) -> None:
    """
    Write a report for KLayout's marker browser, whole or not at all.

    Parameters
    ----------
    report : Report
    path : path
        Ending in ``.lyrdb``. A category a rule, an item a violation, with the sites' numbers, the measured value, and the
        marker in µm.

    Raises
    ------
    FileError
        When the ending is another, the library ``klayout`` is missing, or nothing can be written there.
    """
    target = Path(path)
    if target.suffix != ".lyrdb":
        raise FileError(target, "must end in .lyrdb")
    try:
        from klayout import db, rdb
    except ImportError:
        raise FileError(target, "needs the library klayout: pip install 'foveasim[layout]'") from None
    database = rdb.ReportDatabase("foveasim design rules")
    database.generator = "foveasim"
    database.top_cell_name = CELL_NAME
    cell = database.create_cell(CELL_NAME).rdb_id()
    for result in report.results:
        category = database.create_category(result.rule)
        category.description = f"{result.sentence} (limit {result.limit:g} {result.unit})"
        for violation in result.violations:
            item = database.create_item(cell, category.rdb_id())
            sites = ", ".join(map(str, violation.site_ids))
            item.add_value(f"photosite {sites}: {violation.value:.9g} {violation.unit}".strip())
            for shape in _shapes(db, violation.marker):
                item.add_value(shape)
    with written_whole(target) as temporary:
        database.save(str(temporary))


def _shapes(db: Any, marker: Any) -> list[Any]:
    """A marker as KLayout's shapes in µm."""

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
