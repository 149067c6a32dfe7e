"""Reports for KLayout: its own reader finds every violation with its marker."""

from __future__ import annotations

import sys

import pytest
import shapely
from klayout import rdb

import foveasim as fs
from foveasim.errors import FileError

LAYOUT = fs.Layout.from_polygons([shapely.box(0, 0, 4, 4), shapely.box(3, 0, 8, 4), shapely.box(8.2, 0, 8.5, 4)])
RULES = fs.DesignRules(min_width_um=1.0, max_overlap_um2=0.0, min_space_um=0.5, max_sites=10)


def test_klayout_reads_every_violation_with_its_value_and_marker(tmp_path):
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


def test_a_gap_with_an_island_keeps_its_hole(tmp_path):
    frame = shapely.box(0, 0, 10, 10).difference(shapely.box(2, 2, 8, 8))
    layout = fs.Layout.from_polygons([frame, shapely.box(4, 4, 6, 6)])
    layout.check(fs.DesignRules(max_gap_um2=0.0)).write(tmp_path / "gap.lyrdb")
    database = rdb.ReportDatabase("")
    database.load(str(tmp_path / "gap.lyrdb"))
    (item,) = database.each_item()

    assert list(item.each_value())[1].polygon().area() == pytest.approx(32.0)


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(FileError, match=r"must end in \.lyrdb"):
        LAYOUT.check(RULES).write(tmp_path / "report.xml")


def test_a_missing_library_is_named_with_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "klayout", None)
    with pytest.raises(FileError, match=r"needs the library klayout: pip install 'foveasim\[layout\]'"):
        LAYOUT.check(RULES).write(tmp_path / "report.lyrdb")
    assert not list(tmp_path.iterdir())
