"""All registered views: their data, their modules, and what they show; wrong views are found."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import has_picture, settle, until

from foveasim.studio._engine import Engine
from foveasim.studio._messages import encode_part
from foveasim.studio._parts import PARTS, Part

EXTENDING = Path(__file__).parents[2] / "docs" / "extending.md"
MODULES = files("foveasim.studio") / "static" / "views"
#: Canvases of the views that are always shown.
CANVASES = {"columns": "#map .cells", "picture": "#picture .image", "scene": "#scene .image"}
#: Names of the shown views whose tiles contain no text other than the heading.
EMPTY_TILES = """() => studio.views.list.filter(({ name, is_tile }) => is_tile && !([...document.getElementById("tile-" + name).children]
  .some((child) => child.tagName !== "H2" && child.innerText.trim()))).map(({ name }) => name)"""
OPEN_ALL = "() => { for (const { name, is_tile } of studio.views.list) if (is_tile) studio.views.show(name, true); }"


def problems_of(part, result):
    """Return what is wrong with the data of a view, and with its module."""
    found = [] if (MODULES / f"{part.name}.js").is_file() else ["no module"]
    if part.has_data:
        try:
            about, arrays = part.make(result)
            encode_part(part.name, 1, about, arrays)
            json.dumps(about, allow_nan=False, default=lambda value: value.item())
        except Exception as error:  # noqa: BLE001 -- of any view
            return [*found, f"{type(error).__name__}: {error}"]
        if not any(about.values()) and not any(array.size for array in arrays.values()):
            found.append("no data")
    return found


@pytest.fixture(scope="module")
def result():
    from studio.conftest import SETTINGS

    simulated = Engine(n_threads=1).simulate(json.loads(json.dumps(SETTINGS)))
    return replace(simulated, frozen=simulated)


def test_views_have_data_and_modules(result):
    problems = {name: problems_of(part, result) for name, part in PARTS.items()}

    assert {name: found for name, found in problems.items() if found} == {}
    assert {path.name.removesuffix(".js") for path in MODULES.iterdir()} == set(PARTS)


def fail(_):
    raise ValueError("wrong")


@pytest.mark.parametrize(
    ("name", "make", "problem"),
    [
        ("missing", lambda _: ({"n": 1}, {}), "no module"),
        ("noise", lambda _: ({"sources": []}, {}), "no data"),
        ("noise", lambda _: ({"n": float("nan")}, {}), "ValueError"),
        ("noise", lambda _: ({"n": object()}, {}), "TypeError"),
        ("noise", lambda _: ({}, {"x": np.zeros(3, complex)}), "ParameterError"),
        ("noise", fail, "ValueError: wrong"),
    ],
)
def test_wrong_data_of_views_are_found(result, name, make, problem):
    (found,) = problems_of(Part(name, "Wrong", make, lambda _: ()), result)

    assert found.startswith(problem)


@pytest.mark.slow(keep=1)
@pytest.mark.needs("chromium")
def test_all_views_show_something(visit):
    page = visit(width=1800, height=1000)
    page.evaluate(OPEN_ALL)
    settle(page)
    page.click("#freeze")
    until(page, "() => studio.isReady && studio.views.parts.comparison && !studio.solid.isAsked")

    assert page.evaluate(EMPTY_TILES) == []
    assert [name for name, selector in CANVASES.items() if not has_picture(page, selector)] == []
    assert set(page.evaluate("Object.keys(studio.views.made)")) == set(PARTS)


@pytest.mark.slow(keep=1)
@pytest.mark.needs("chromium")
@pytest.mark.parametrize(
    ("script", "make", "message"),
    [
        (None, lambda _: ({"n": 1}, {}), "Wrong cannot be shown"),  # without a module
        ("export const other = 1;", lambda _: ({"n": 1}, {}), "Wrong cannot be shown"),
        ("export const create = () => ({ use() { JSON.parse('no'); } });", lambda _: ({"n": 1}, {}), "Wrong cannot be shown: Unexpected token"),
        ("export const create = () => ({ use() {} });", lambda _: ({"n": 1}, {}), ""),
        ("export const create = () => ({ use() {} });", fail, "Wrong: ValueError: wrong"),
    ],
    ids=["missing", "no create", "exception", "nothing shown", "server"],
)  # fmt: skip
def test_wrong_view_leaves_others(visit, monkeypatch, script, make, message):
    monkeypatch.setitem(PARTS, "wrong", Part("wrong", "Wrong", make, lambda _: ()))
    page = visit(is_checked=False, script="localStorage.setItem('foveasim-studio-tiles', '[\"noise\"]')")
    if script:
        page.route("**/views/wrong.js", lambda route: route.fulfill(body=script, content_type="text/javascript"))
    page.evaluate("() => { studio.views.show('wrong', true); }")
    until(page, "text => document.getElementById('notice').textContent.startsWith(text)", message)
    settle(page)

    assert "wrong" in page.evaluate(EMPTY_TILES)
    assert "noise" not in page.evaluate(EMPTY_TILES)
    page.click("#tabs [data-tile=snr]")
    until(page, "() => studio.views.made.snr?.chart.curves.length > 0")


@pytest.mark.needs("chromium")
def test_documented_view_shows_brightest_sites(visit, monkeypatch):
    text = EXTENDING.read_text("utf-8")
    (python,), (script,) = (
        re.findall(rf"^```{kind}\n(.*?)^```", text, re.MULTILINE | re.DOTALL) for kind in ("py", "js")
    )
    before = dict(PARTS)
    exec(compile(python, "brightest.py", "exec"), {})
    added = PARTS["brightest"]
    assert list(PARTS).index("brightest") == list(PARTS).index("noise") + 1
    PARTS.clear()
    PARTS.update(before)
    monkeypatch.setitem(PARTS, "brightest", added)
    page = visit()
    page.route("**/views/brightest.js", lambda route: route.fulfill(body=script, content_type="text/javascript"))
    page.click("#tabs [data-tile=brightest]")
    until(page, "() => studio.isReady && studio.views.parts.brightest")
    codes = page.evaluate("() => [...studio.panes.b.columns.find((c) => c.key === 'code').values]")
    shown = page.locator("#tile-brightest li").all_inner_texts()

    assert len(shown) == 8
    assert shown[0].endswith(f": {max(codes)} DN")
