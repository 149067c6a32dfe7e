"""Checks of the built site: each finds its problem in a small site, and none in a sound one."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

CHECKS = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "check_pages.py"))
CODE = "<div class='highlight-python notranslate'><div class='highlight'><pre>a = 1</pre></div></div>"
RESULT = "<div class='code-result docutils container'><img src='a.png'></div>"
HOME = f"""<article><div class='highlight'><pre>pip install .</pre></div>{CODE}{RESULT}
<a href='citing.html'>cite</a><a href='chip.html'>chip</a><a href='comparing.html#a-known-sensor'>known</a></article>"""


def write(site, name, body):
    path = site / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"<html><body>{body}</body></html>")


@pytest.fixture
def site(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    write(tmp_path, "index.html", HOME)
    write(tmp_path, "citing.html", "@misc{paper,")
    write(tmp_path, "chip.html", '<pre>read_layout("chip.gds", layer=(77, 3))</pre>')
    write(tmp_path, "comparing.html", "<section id='a-known-sensor'></section>")
    for name in ("quick_start.html", "tutorial.html"):
        write(tmp_path, name, CODE + RESULT)
    figures = "<dl><dd><img class='only-light' src='../../a.png'><img class='only-dark' src='../../a.png'></dd></dl>"
    for name in CHECKS["names_with_figures"]():
        write(tmp_path, f"reference/made/{name}.html", figures)
    return tmp_path


def problems(check, site):
    return list(CHECKS[check](site))


@pytest.mark.parametrize("check", [check.__name__ for check in CHECKS["CHECKS"]])
def test_sound_site_has_no_problems(site, check):
    assert problems(check, site) == []


@pytest.mark.parametrize("after", ["", "<p>text</p>", "<div class='code-result'></div>"])
def test_step_without_result_is_found(site, after):
    write(site, "tutorial.html", CODE + RESULT + CODE + after)

    assert len(problems("steps_without_result", site)) == 1


@pytest.mark.parametrize("body", ["<p>no figure</p>", "<dl><dd><img class='only-light' src='../../a.png'></dd></dl>"])
def test_generator_without_figure_is_found(site, body):
    write(site, "reference/made/foveasim.layout.log_polar.html", body)
    (site / "reference" / "made" / "foveasim.layout.grid.html").unlink()

    found = problems("names_without_figure", site)

    assert found[0] == "foveasim.layout.grid: no page"
    assert all(problem.startswith("foveasim.layout.log_polar: no figure") for problem in found[1:])
    assert len(found) > 1


@pytest.mark.parametrize("summary", ["", "Read a table (cf."])
def test_cut_summary_is_found(site, summary):
    rows = f"<tr><td>a</td><td>Read (all of) it.</td></tr><tr><td>b</td><td>{summary}</td></tr>"
    write(site, "reference/foveasim.layout.html", f"<table>{rows}</table>")

    assert problems("cut_summaries", site) == [f"reference/foveasim.layout.html: b: {summary!r}"]


def test_wide_line_of_code_is_found(site):
    write(site, "guide.html", f"<div class='highlight'><pre>{'x' * 88}\n{'y' * 89}</pre></div>")

    assert problems("wide_code", site) == [f"guide.html: 89 columns: {'y' * 60}"]


@pytest.mark.parametrize("link", ["nothing.html", "index.html#nothing", "#nothing", "guides/"])
def test_broken_link_of_page_is_found(site, link):
    write(site, "guide.html", f"<a href='{link}'>a</a><a href='https://example.org/nothing'>b</a>")

    assert len(problems("broken_links", site)) == 1


@pytest.mark.parametrize(
    ("removed", "missing"),
    [
        ("pip install .", "install line"),
        (RESULT, "first picture"),
        ("<a href='citing.html'>cite</a>", "citation"),
        ("<a href='chip.html'>chip</a>", "chip-file path"),
        ("#a-known-sensor", "comparison with a known sensor"),
    ],
)
def test_missing_way_from_home_is_found(site, removed, missing):
    write(site, "index.html", HOME.replace(removed, ""))

    assert problems("missing_from_home", site) == [f"index.html: no way to {missing}"]
