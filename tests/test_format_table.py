"""The table of formats of other programs: every row has its test, and every format a row."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from foveasim.layout.files import FORMATS
from foveasim.maps import MAP_FORMATS
from foveasim.modes._event_files import EVENT_FORMATS
from foveasim.optics import PSF_FORMATS
from foveasim.scene.cubes import CUBE_FORMATS

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "coming_from.md"
HEADING = ["program", "file", "read", "written", "convention", "limits", "test"]


def rows():
    """Return the rows of the tables of formats."""
    text = PAGE.read_text(encoding="utf-8").partition("## Files of other programs")[2]
    lines = [
        [cell.strip() for cell in line.strip("| ").split(" | ")] for line in text.splitlines() if line.startswith("| ")
    ]
    return [cells for cells in lines if cells != HEADING]


@cache
def functions(path):
    return {node.name for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)}


def test_every_row_has_its_test():
    assert len(rows()) > 50
    for cells in rows():
        assert len(cells) == len(HEADING), cells
        name, _, function = cells[-1].strip("`").partition("::")
        assert function in functions(TESTS / name), cells


@pytest.mark.parametrize("formats", [FORMATS, MAP_FORMATS, CUBE_FORMATS, PSF_FORMATS, EVENT_FORMATS])
def test_every_format_has_a_row(formats):
    named = " ".join(cells[1] for cells in rows()).lower()
    words = {"oas": "oasis", "gds": "gdsii", "tif": "tiff", "nc": "netcdf", "nxs": "nxoff", "txt": "text", "h5": "hdf5"}
    bundled = formats.within("foveasim") if hasattr(formats, "within") else formats
    for found in (formats[name] for name in bundled):
        suffix = found.suffixes[0].removeprefix(".")
        assert words.get(suffix, suffix or "folder") in named.replace(" ", "").replace("`", "") or suffix in named, (
            found.title
        )
