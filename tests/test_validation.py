"""The validation: verdicts of its rows, its stored results, and their pages."""

from __future__ import annotations

import ast
import json
import re
import runpy
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PAGES = runpy.run_path(str(ROOT / "docs" / "validation_pages.py"))
STORED = json.loads((ROOT / "docs" / "validation" / "results.json").read_text("utf-8"))
ROWS = [(section["name"], row) for section in STORED["sections"] for row in section["rows"]]
BY = {"by": "closed form", "source": "a book"}


@pytest.fixture
def records(monkeypatch):
    module = ROOT / "validation" / "records.py"
    monkeypatch.setattr(sys, "path", [str(module.parent), *sys.path])
    yield import_module(module.stem)
    sys.modules.pop(module.stem, None)


@pytest.fixture
def section(records):
    return records.Section("stage", "Stage", "About it.")


def test_own_deviation_alone_decides(section):
    calls = {"foveasim": lambda: [1.0, 2.002], "other": lambda: [3.0, 2.0]}
    found = section.compare("pair", calls, [1.0, 2.0], tolerance=2e-3, **BY)
    row = section.rows[0]

    assert found["other"] == [3.0, 2.0]
    assert [one.deviation for one in row.results] == pytest.approx([1e-3, 1.0])
    assert all(one.seconds is not None and one.seconds >= 0.0 for one in row.results)
    assert row.is_kept
    section.compare("pair", calls, [1.0, 2.0], tolerance=5e-4, repeats=0, **BY)
    assert not section.rows[1].is_kept
    assert section.rows[1].results[0].seconds is None


def test_missing_numbers_are_not_kept(section):
    section.compare("pair", {"foveasim": lambda: [np.nan, 2.0]}, [1.0, 2.0], tolerance=1e9, **BY)

    assert not section.rows[0].is_kept


@pytest.mark.parametrize("name", ["largest", "largest_relative", "largest_absolute"])
def test_deviations_require_equal_shapes(records, name):
    with pytest.raises(ValueError, match=r"shapes \(1,\) and \(2,\) differ"):
        getattr(records, name)([1.0], [1.0, 1.0])


@pytest.mark.parametrize(
    ("name", "expected"), [("largest", 0.25), ("largest_relative", 0.5), ("largest_absolute", 1.0)]
)
def test_deviations_by_hand(records, name, expected):
    assert getattr(records, name)([3.0, 3.0], [2.0, 4.0]) == expected


def test_stored_rows_are_within_tolerances():
    missed = [f"{name}: {row['what']}" for name, row in ROWS if not PAGES["is_kept"](row)]

    assert len(ROWS) > 100
    assert missed == []


def test_stored_stages_are_those_of_the_program():
    tree = ast.parse((ROOT / "validation" / "run.py").read_text("utf-8"))
    tables = {ast.unparse(node.targets[0]): node.value for node in tree.body if isinstance(node, ast.Assign)}

    assert [section["name"] for section in STORED["sections"]] == list(ast.literal_eval(tables["STAGES"]))


def test_rows_state_truth_source_and_unit():
    bare = [
        f"{name}: {row['what']}"
        for name, row in ROWS
        if not (row["truth"] and row["source"] and row["what"]) or row["tolerance"] < 0.0
    ]

    assert bare == []


def test_pages_contain_every_row_and_figure():
    pages = PAGES["pages_of"](STORED)

    assert set(pages) == {"index.md", *(f"{section['name']}.md" for section in STORED["sections"])}
    assert f"{len(ROWS)} of {len(ROWS)} comparisons" in pages["index.md"]
    for section in STORED["sections"]:
        text = pages[f"{section['name']}.md"]
        assert section["name"] in pages["index.md"]
        assert section["machine"]["processor"] in text
        assert all(row["what"].replace("|", "\\|") in text for row in section["rows"])
        assert all((ROOT / "docs" / "validation" / name).exists() and name in text for name in section["figures"])


def test_paper_has_the_stored_results():
    paper = ROOT / "docs" / "paper" / "paper.md"
    text, keys = paper.read_text("utf-8"), paper.with_name("paper.bib").read_text("utf-8")

    assert PAGES["paper_of"](text, STORED) == text
    assert f"{len(ROWS)}\ncomparisons in" in text
    cited = set(re.findall(r"@(\w+)", text.partition("# Summary")[2]))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", keys, re.MULTILINE))
    figures = re.findall(r"\]\((\S+)\)", text)
    assert len(figures) == 3
    assert all((paper.parent / name).exists() for name in figures)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.0, "0"), (1e-6, "1e-6"), (4.44e-16, "4.4e-16"), (0.0213, "0.021"), (99.7, "100"), (280.4, "280"), (2e6, "2e6")],
)
def test_numbers_have_two_digits(value, shown):
    assert PAGES["number"](value) == shown


@pytest.mark.parametrize(("seconds", "shown"), [(0.28, "280 ms"), (5.2e-4, "520 µs"), (2.34, "2.3 s")])
def test_times_have_their_unit(seconds, shown):
    assert PAGES["time_of"](seconds) == shown
