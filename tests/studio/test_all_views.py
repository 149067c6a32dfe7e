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

from studio.page_tools import change, has_picture, set_value, settle, until

from foveasim.studio._engine import Engine
from foveasim.studio._messages.encoding import encode_part
from foveasim.studio._parts import PARTS, Part
from foveasim.studio._parts.registry import capture_of

EXTENDING = Path(__file__).parents[2] / "docs" / "extending" / "own_views.md"
MODULES = files("foveasim.studio") / "static" / "views"
#: Canvases of the views that are always shown.
CANVASES = {"columns": "#map .cells", "picture": "#picture .image", "scene": "#scene .image"}
#: Content of the shown tiles by view: texts without the heading, canvases (hash; null if uniform), and the data, or null
#: if the tile does not use them.
TILES = """async () => {
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  const hash = (canvas) => {
    if (!canvas.getContext("2d")) return "WebGL";
    const { width, height } = canvas, copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(canvas, 0, 0);
    const words = new Uint32Array(copy.getImageData(0, 0, width, height).data.buffer);
    return words.every((word) => word === words[0]) ? null : words.reduce((sum, word) => (31 * sum + word) | 0, 0);
  };
  const about = ({ name }) => {
    const tile = document.getElementById("tile-" + name), { made, parts } = studio.views;
    const part = made[name]?.wantsData === false ? null : parts[name];
    const texts = [...tile.childNodes].filter(({ tagName }) => tagName !== "H2").map((node) => node.innerText ?? node.textContent);
    const data = part ? JSON.stringify([part.about, Object.entries(part.arrays).map(([key, each]) => [key, [...each]])]) : null;
    return [name, { text: texts.join("\\n").trim(), canvases: [...tile.querySelectorAll("canvas")].map(hash), data }];
  };
  return Object.fromEntries(studio.views.list.filter(({ name }) => studio.views.shown.has(name)).map(about));
}"""
#: Texts of values that are not there.
NO_VALUE = re.compile(r"\b(NaN|undefined|null)\b|\[object")
#: Settings that change the data of most views.
OTHER = {
    "exposure_s": 0.05,
    "layout.parameters.min_size_um": 11.0,
    "layout.rules.min_size_um": 20.0,
    "optics.f_number": 4.0,
    "sensor.qe.depth_um": 1.0,
    "sensor.bits": 12,
}
SET_ALL = "values => { for (const [key, value] of Object.entries(values)) studio.connection.set(key, value, true); }"
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


def problem_of_tile(content, later=None):
    """Return what is wrong with the content of a tile, and with that after a change of settings."""
    if not content["text"]:
        return "no text"
    if content["canvases"] and not any(content["canvases"]):
        return "empty canvases"
    if found := NO_VALUE.search(content["text"]):
        return f"shows {found[0]}"
    if later is None:
        return None
    shown, shown_later = ([each["text"], each["canvases"]] for each in (content, later))
    if content["data"] == later["data"] is not None:
        return "same data"
    if content["data"] != later["data"] and shown == shown_later:
        return "other data, same content"
    return problem_of_tile(later)


def simulate(settings):
    simulated = Engine(n_threads=1).simulate(json.loads(json.dumps(settings)))
    return replace(simulated, compared=(("A", simulated),))


@pytest.fixture(scope="module")
def result():
    from studio.conftest import SETTINGS

    return simulate(SETTINGS)


def test_views_have_data_and_modules(result):
    problems = {name: problems_of(part, result) for name, part in PARTS.items()}

    assert {name: found for name, found in problems.items() if found} == {}
    assert {path.name.removesuffix(".js") for path in MODULES.iterdir()} == set(PARTS)


def test_views_have_data_without_optional_settings():
    from studio.conftest import SETTINGS

    least = {**SETTINGS, "sensor": {"qe": 0.6}, "exposure_s": 0.0}
    least["layout"] = {"generator": "grid", "parameters": {"n_x": 1, "n_y": 1, "pitch_um": 12.0}}
    result = simulate(least)
    problems = {name: problems_of(part, result) for name, part in PARTS.items()}

    assert {name: found for name, found in problems.items() if found not in ([], ["no data"])} == {}


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


@pytest.mark.slow
@pytest.mark.needs("chromium")
def test_all_views_show_their_data(visit):
    page = visit(width=1800, height=1000)
    set_value(page, "requirements", [{"measure": "snr", "at_least": 5.0}])
    set_value(page, "sensor.pixel_optics", {"kind": "aperture_stack", "height_um": 4.0, "refractive_index": 1.5})
    page.evaluate(OPEN_ALL)
    settle(page)
    page.click("#freeze")
    until(page, "() => studio.isIdle && studio.views.parts.comparison && !studio.solid.isAsked")
    before = page.evaluate(TILES)
    change(page, SET_ALL, OTHER)
    until(page, "() => studio.isIdle && !studio.solid.isAsked")
    later = page.evaluate(TILES)
    problems = {name: problem_of_tile(content, later[name]) for name, content in before.items()}

    # The scene is a plane.
    assert {name: problem for name, problem in problems.items() if problem} == {"panorama": "same data"}
    assert [name for name, selector in CANVASES.items() if not has_picture(page, selector)] == []
    assert set(page.evaluate("Object.keys(studio.views.made)")) == set(PARTS)
    assert page.evaluate("studio.state.errors") == {}
    assert "noise" in [name for name, content in before.items() if content["data"] != later[name]["data"]]


@pytest.mark.slow
@pytest.mark.needs("chromium")
@pytest.mark.parametrize(
    ("script", "make", "message"),
    [
        (None, lambda _: ({"n": 1}, {}), "Wrong cannot be shown"),  # without a module
        ("export const other = 1;", lambda _: ({"n": 1}, {}), "Wrong cannot be shown"),
        ("export const create = () => ({ use() { JSON.parse('no'); } });", lambda _: ({"n": 1}, {}), "Wrong cannot be shown: Unexpected token"),
        ("export const create = () => ({ use() {} });", lambda _: ({"n": 1}, {}), ""),
        ("export const create = () => ({ use() {} });", fail, "Wrong: ValueError: wrong"),
        ("export const create = () => ({ use() {} });", lambda _: ({"n": object()}, {}), "Wrong: TypeError: Object of type object"),
    ],
    ids=["missing", "no create", "exception", "nothing shown", "server", "data"],
)  # fmt: skip
def test_wrong_view_leaves_others(visit, monkeypatch, script, make, message):
    monkeypatch.setitem(PARTS, "wrong", Part("wrong", "Wrong", make, lambda _: ()))
    page = visit(is_checked=False, script="localStorage.setItem('foveasim-studio-tiles', '[\"noise\"]')")
    if script:
        page.route("**/views/wrong.js", lambda route: route.fulfill(body=script, content_type="text/javascript"))
    page.evaluate("() => { studio.views.show('wrong', true); }")
    until(page, "text => document.getElementById('notice').textContent.startsWith(text)", message)
    settle(page)
    shown = page.evaluate(TILES)

    assert problem_of_tile(shown["wrong"]) == "no text"
    assert problem_of_tile(shown["noise"]) is None
    page.click("#tabs [data-tile=snr]")
    until(page, "() => studio.views.made.snr?.chart.curves.length > 0")


#: Wrong modules of views, the problem of each, and a correct one.
WRONG = {
    "canvas": ("root.append('a note', document.createElement('canvas')); return {};", "empty canvases"),
    "undefined": ("return { use: ({ about }) => root.append(make('p', about.m + ' s')) };", "shows undefined"),
    "nan": ("return { use: () => root.append(make('p', 0 / 0)) };", "shows NaN"),
    "same": ("const p = make('p'); root.append(p); return { use: ({ about }) => { p.textContent ||= about.n; } };", "other data, same content"),
    "correct": ("const p = make('p'); root.append(p); return { use: ({ about }) => { p.textContent = about.n; } };", None),
    "constant": ("return { use: ({ about }) => root.append(make('p', about.constant)) };", "same data"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.needs("chromium")
def test_wrong_content_of_tiles_is_found(visit, monkeypatch):
    def with_exposure(result):
        return {"n": result.shot.exposure_s}, {}

    for name in WRONG:
        make = (lambda _: ({"constant": 1}, {})) if name == "constant" else with_exposure
        monkeypatch.setitem(PARTS, name, Part(name, "Wrong", make, capture_of))
    page = visit()

    def answer(route):
        script, _ = WRONG[re.search(r"(\w+)\.js", route.request.url)[1]]
        module = f"import {{ make }} from '/web/page_parts.js'; export function create(root) {{ {script} }}"
        route.fulfill(body=module, content_type="text/javascript")

    for name in WRONG:
        page.route(f"**/views/{name}.js", answer)
        page.evaluate("name => studio.views.show(name, true)", name)
    until(page, "names => names.every((name) => studio.views.parts[name] && studio.views.made[name])", list(WRONG))
    settle(page)
    before = page.evaluate(TILES)
    set_value(page, "exposure_s", 0.03)
    after = page.evaluate(TILES)

    assert {name: problem_of_tile(before[name], after[name]) for name in WRONG} == {
        name: problem for name, (_, problem) in WRONG.items()
    }


@pytest.mark.needs("chromium")
def test_documented_view_shows_brightest_sites(visit, monkeypatch):
    text = EXTENDING.read_text("utf-8")
    (python,), (script,) = (
        re.findall(rf"^```{kind}\n(.*?)^```", text, re.MULTILINE | re.DOTALL) for kind in ("py", "js")
    )
    before = dict(PARTS)
    try:
        exec(compile(python, "brightest.py", "exec"), {})
        added, names = PARTS["brightest"], list(PARTS)
    finally:
        PARTS.clear()
        PARTS.update(before)
    assert names.index("noise") < names.index("brightest") < names.index("spectrum")
    monkeypatch.setitem(PARTS, "brightest", added)
    page = visit()
    page.route("**/views/brightest.js", lambda route: route.fulfill(body=script, content_type="text/javascript"))
    page.click("#tabs [data-tile=brightest]")
    until(page, "() => studio.isIdle && studio.views.parts.brightest")
    codes = page.evaluate("() => [...studio.panes.b.columns.find((c) => c.key === 'code').values]")
    shown = page.locator("#tile-brightest li").all_inner_texts()

    assert len(shown) == 8
    assert shown[0].endswith(f": {max(codes)} DN")
