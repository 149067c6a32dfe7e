"""KLayout report databases: violations and markers as KLayout reads them."""

from __future__ import annotations

import math
import sys

import pytest
import shapely
from klayout import db, rdb

import foveasim as fs
from foveasim.errors import FileError
from foveasim.layout.drc.report import is_lyrdb, read_lyrdb

LAYOUT = fs.Layout.from_polygons([shapely.box(0, 0, 4, 4), shapely.box(3, 0, 8, 4), shapely.box(8.2, 0, 8.5, 4)])
RULES = fs.DesignRules(min_width_um=1.0, max_overlap_um2=0.0, min_space_um=0.5, max_sites=10)


def test_klayout_reads_values_and_markers(tmp_path):
    report = LAYOUT.check(RULES)
    report.write(tmp_path / "report.lyrdb")
    database = rdb.ReportDatabase("")
    database.load(str(tmp_path / "report.lyrdb"))
    found = {
        database.category_by_id(item.category_id()).name(): list(item.each_value()) for item in database.each_item()
    }

    assert sorted(found) == ["max_overlap_um2", "min_space_um", "min_width_um"]
    assert found["min_width_um"][0].string() == "photosite 2: 0.3 µm"
    assert found["min_width_um"][1].polygon().area() == pytest.approx(0.3 * 4)
    assert found["max_overlap_um2"][1].polygon().bbox().to_s() == "(3,0;4,4)"
    assert found["min_space_um"][1].edge().length() == pytest.approx(0.2)


def test_gap_marker_has_hole_at_island(tmp_path):
    frame = shapely.box(0, 0, 10, 10).difference(shapely.box(2, 2, 8, 8))
    layout = fs.Layout.from_polygons([frame, shapely.box(4, 4, 6, 6)])
    layout.check(fs.DesignRules(max_gap_um2=0.0)).write(tmp_path / "gap.lyrdb")
    database = rdb.ReportDatabase("")
    database.load(str(tmp_path / "gap.lyrdb"))
    (item,) = database.each_item()

    assert list(item.each_value())[1].polygon().area() == pytest.approx(32.0)


def test_other_extension_is_rejected(tmp_path):
    with pytest.raises(FileError, match=r"must end in \.lyrdb"):
        LAYOUT.check(RULES).write(tmp_path / "report.xml")


def test_missing_klayout_gives_install_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "klayout", None)
    with pytest.raises(FileError, match=r"needs klayout; install it with: pip install 'foveasim\[klayout\]'"):
        LAYOUT.check(RULES).write(tmp_path / "report.lyrdb")
    assert not list(tmp_path.iterdir())


def test_report_round_trip_preserves_violations(tmp_path):
    report = LAYOUT.check(RULES)
    report.write(tmp_path / "report.lyrdb")
    back = read_lyrdb(tmp_path / "report.lyrdb", LAYOUT.n_sites)

    assert is_lyrdb(tmp_path / "report.lyrdb")
    assert [r.rule for r in back.results] == [r.rule for r in report.results]
    for was, now in zip(report.results, back.results, strict=True):
        assert (now.description, now.limit, now.unit) == (was.description, was.limit, was.unit)
        assert len(now) == len(was)
    for was, now in zip(report.violations, back.violations, strict=True):
        assert (now.rule, now.site_ids) == (was.rule, was.site_ids)
        assert now.value == pytest.approx(was.value)
        assert now.marker.equals_exact(was.marker.normalize(), 1e-6) or now.marker.equals(was.marker)


def test_reports_of_other_programs_are_read(tmp_path):
    database = rdb.ReportDatabase("other")
    cell = database.create_cell("TOP").rdb_id()
    category = database.create_category("width").rdb_id()
    below = database.create_category(database.category_by_id(category), "narrow").rdb_id()
    polygon = db.DPolygon([db.DPoint(0, 0), db.DPoint(0, 9), db.DPoint(9, 9), db.DPoint(9, 0)])
    polygon.insert_hole([db.DPoint(2, 2), db.DPoint(2, 5), db.DPoint(5, 5), db.DPoint(5, 2)])
    pair = db.DEdgePair(db.DEdge(0, 0, 1, 0), db.DEdge(0, 2, 1, 2))
    for kind, shape in ((category, polygon), (below, pair), (category, db.DBox(1, 2, 3, 5))):
        database.create_item(cell, kind).add_value(shape)
    database.save(str(tmp_path / "other.lyrdb"))
    report = read_lyrdb(tmp_path / "other.lyrdb", 3)
    found = {(v.rule, v.marker.geom_type, v.marker.area, v.marker.bounds) for v in report.violations}

    assert found == {
        ("width", "Polygon", 81.0 - 9.0, (0.0, 0.0, 9.0, 9.0)),
        ("width", "Polygon", 6.0, (1.0, 2.0, 3.0, 5.0)),
        ("width.narrow", "GeometryCollection", 0.0, (0.0, 0.0, 1.0, 2.0)),
    }
    assert all(v.site_ids == () and math.isnan(v.value) for v in report.violations)
    assert not report.ok


@pytest.mark.parametrize(
    ("content", "n_sites", "message"),
    [
        (None, 3, "no such file"),
        ("not xml", 3, "is corrupt, or not a KLayout report"),
        ("<html/>", 3, "is not a KLayout report database"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><report-database>&b;</report-database>', 3, "declares XML entities"),
        ("truncated", 3, "is corrupt, or not a KLayout report"),
        ("complete", 1, "contains site 2, but the layout has 1 sites"),
        ("marker", 3, "contains an invalid marker"),
    ],
)
def test_invalid_report_is_rejected(tmp_path, content, n_sites, message):
    path = tmp_path / "report.lyrdb"
    LAYOUT.check(RULES).write(path)
    complete = path.read_text()
    strings = {
        "truncated": complete[: len(complete) // 2],
        "complete": complete,
        "marker": complete.replace("polygon: (", "polygon: (x"),
    }
    path.unlink()
    if content is not None:
        path.write_text(strings.get(content, content))
    with pytest.raises(FileError, match=message):
        read_lyrdb(path, n_sites)


NOTE = "6 pairs of sites touch or overlap; apply inset first"


def test_note_of_touching_sites_round_trips(tmp_path):
    report = fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0).check(fs.DesignRules(min_space_um=0.2, min_size_um=3.0))
    report.write(tmp_path / "a.lyrdb")
    database = rdb.ReportDatabase("a")
    database.load(str(tmp_path / "a.lyrdb"))
    (category,) = [c for c in database.each_category() if c.name() == "min_space_um"]
    again = read_lyrdb(tmp_path / "a.lyrdb", 4)

    assert category.description.endswith(f"(limit 0.2 µm); {NOTE}")
    assert [(r.rule, r.note, r.limit, r.unit) for r in again.results] == [
        ("min_size_um", "", 3.0, "µm"),
        ("min_space_um", NOTE, 0.2, "µm"),
    ]
