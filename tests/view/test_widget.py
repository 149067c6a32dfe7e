"""Widget of notebooks in a browser: hover, pins, selections and colours in both directions."""

from __future__ import annotations

import base64
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from browsers import wait_for_promise, watch
from waiting import wait_until

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.view.web import web_page

pytestmark = pytest.mark.skipif(find_spec("anywidget") is None, reason="no anywidget")

LAYOUT = fs.layout.grid(n_x=12, n_y=8, pitch_um=5.0).with_columns(gain=np.arange(96) / 96)
#: Model of a notebook's front end, which sends the changes of the page to Python.
OPEN = """
async ([source, state]) => {
  const { default: widget } = await import("data:text/javascript;base64," + source);
  const listeners = {}, changed = new Set();
  window.model = {
    state,
    get: (name) => state[name],
    set: (name, value) => {
      if (state[name] === value) return;
      state[name] = value;
      changed.add(name);
      (listeners["change:" + name] || []).forEach((call) => call());
    },
    save_changes: () => {
      const bytes = (view) => [...new Uint8Array(view.buffer, view.byteOffset, view.byteLength)];
      const sent = [...changed].map((name) => [name, state[name] instanceof DataView ? bytes(state[name]) : state[name]]);
      changed.clear();
      toPython(Object.fromEntries(sent));
    },
    on: (event, call) => { (listeners[event] ||= []).push(call); },
    off: (event, call) => { listeners[event] = listeners[event].filter((each) => each !== call); },
    listeners,
  };
  state.selected = new DataView(Uint8Array.from(state.selected).buffer);
  window.model.close = widget.render({ model: window.model, el: document.body });
  await new Promise((done) => document.querySelector("iframe").addEventListener("load", done, { once: true }));
}
"""
#: Sets a trait of the model, as a message of the kernel does; bytes arrive as a view of a larger buffer.
SET = """
([name, value, isBytes]) => {
  if (!isBytes) return model.set(name, value);
  const buffer = new ArrayBuffer(value.length + 3);
  new Uint8Array(buffer, 3).set(value);
  model.set(name, new DataView(buffer, 3));
}
"""


@pytest.fixture
def show(browser):
    """Show a widget in a browser; at the end check that its page had no errors and no network requests."""
    problems, requested, contexts = [], [], []

    def open_widget(widget, *, style="color: black"):
        contexts.append(browser.new_context(viewport={"width": 900, "height": 600}, reduced_motion="reduce"))
        page = contexts[-1].new_page()
        watch(page, problems)
        page.on("request", lambda request: requested.append(request.url))
        page.set_content(f'<body style="{style}; margin: 0"></body>')

        received = set()

        def receive(changes):
            received.update(changes)
            widget.set_state(
                {name: memoryview(bytes(value)) if name == "selected" else value for name, value in changes.items()}
            )
            received.clear()

        def send(change):
            if change.name in received:  # ipywidgets does not send changes back
                return
            sent = widget.get_state(change.name)[change.name]
            is_bytes = isinstance(sent, memoryview)
            page.evaluate(SET, [change.name, list(sent) if is_bytes else sent, is_bytes])

        page.expose_function("toPython", receive)
        names = ("page", "height_px", "by", "pinned", "hovered", "selected")
        state = {name: widget.get_state(name)[name] for name in names}
        state["selected"] = list(state["selected"])
        page.evaluate(OPEN, [base64.b64encode(widget._esm.encode()).decode(), state])
        (frame,) = page.main_frame.child_frames
        wait_for_promise(frame, "foveasim.complete")
        widget.observe(send, ["by", "pinned", "selected", "height_px"])
        return page, frame

    yield open_widget
    for context in contexts:
        context.close()
    assert problems == []
    assert [url for url in requested if not url.startswith(("about:", "data:", "blob:"))] == []


def until(frame, condition):
    # Messages of the page arrive during evaluations.
    wait_until(lambda: (frame.evaluate("null"), condition())[1], step_s=0.02)


def position(page, frame, x_um, y_um):
    """Return the position in the window of a point on the sensor."""
    box = page.query_selector("iframe").bounding_box()
    x, y = frame.evaluate("(p) => foveasim.toWindow(...p)", [x_um, y_um])
    return box["x"] + x, box["y"] + y


def hover(page, frame, site):
    """
    Move the mouse to a site until the frame receives it.

    The frame has its own process: the browser sends it events only when it is on the screen, and drops earlier ones.
    """

    def is_hovered():
        page.mouse.move(*position(page, frame, *LAYOUT.centroid_um[site]))
        return frame.evaluate("foveasim.hovered") == site

    until(frame, is_hovered)


@pytest.mark.needs("chromium")
def test_hover_and_pin_reach_python(show):
    widget = fs.view.widget(LAYOUT)
    page, frame = show(widget)

    hover(page, frame, 41)
    until(frame, lambda: widget.hovered == 41)
    page.mouse.click(*position(page, frame, *LAYOUT.centroid_um[41]))
    until(frame, lambda: widget.pinned == 41)


@pytest.mark.slow(keep=1)
@pytest.mark.needs("chromium")
def test_selection_reaches_python_and_back(show):
    widget = fs.view.widget(LAYOUT)
    page, frame = show(widget)

    hover(page, frame, 0)
    page.mouse.click(*position(page, frame, *LAYOUT.centroid_um[0]))
    until(frame, lambda: widget.pinned == 0 and page.evaluate("document.activeElement.tagName") == "IFRAME")
    page.keyboard.press("s")  # keys are for the frame with the focus
    until(frame, lambda: frame.evaluate("foveasim.tool") == "select")
    page.mouse.move(*position(page, frame, *(LAYOUT.centroid_um[13] - 1.0)))
    page.mouse.down()
    page.mouse.move(*position(page, frame, *(LAYOUT.centroid_um[26] + 1.0)), steps=3)
    page.mouse.up()
    until(frame, lambda: widget.selected.tolist() == [13, 14, 25, 26])

    widget.selected = LAYOUT.columns["gain"] > 0.9
    until(frame, lambda: frame.evaluate("foveasim.selected") == list(range(87, 96)))
    assert frame.inner_text("#selection-heading") == "Selection: 9 photosites"
    widget.selected = []
    until(frame, lambda: not frame.is_visible("#selection"))


@pytest.mark.needs("chromium")
def test_colours_are_set_in_both_directions(show):
    widget = fs.view.widget(LAYOUT)
    widget.by = "gain"
    widget.pinned = 5
    page, frame = show(widget)
    until(frame, lambda: frame.evaluate("[foveasim.column, foveasim.pinned]") == ["gain", 5])

    frame.select_option("#colouring", "area_um2")
    until(frame, lambda: widget.by == "area_um2")
    widget.by = "size_um"
    until(frame, lambda: frame.evaluate("foveasim.column") == "size_um")
    widget.height_px = 400
    until(frame, lambda: page.query_selector("iframe").bounding_box()["height"] == 400)


@pytest.mark.slow
@pytest.mark.needs("chromium")
@pytest.mark.parametrize(("style", "theme"), [("color: #eee", "dark"), ("color: #111", "light")])
def test_theme_follows_the_notebook(show, style, theme):
    _, frame = show(fs.view.widget(LAYOUT), style=style)

    until(frame, lambda: frame.evaluate("document.documentElement.dataset.theme") == theme)
    assert not frame.is_visible("#link")


@pytest.mark.needs("chromium")
def test_closed_widget_leaves_no_listeners(show):
    page, _ = show(fs.view.widget(LAYOUT))

    page.evaluate("model.close()")

    assert page.evaluate("Object.values(model.listeners).flat().length") == 0


def test_widget_contains_the_page():
    report = LAYOUT.check(fs.DesignRules(min_size_um=6.0))

    assert fs.view.widget(LAYOUT, report=report, name="grid").page == web_page(LAYOUT, report=report, name="grid")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("by", "area", "'by' must be one of .*, got 'area'; did you mean 'area_um2'"),
        ("pinned", 96, "'pinned' must be < 96, the number of sites, got 96"),
        ("selected", [96], "'selected' must be indices of sites, integers from 0 to 95, or one boolean per site"),
        ("selected", [-1], "'selected' must be indices of sites"),
        ("selected", [0.5], "'selected' must be indices of sites"),
        ("selected", [[1, 2]], "'selected' must be indices of sites"),
        ("height_px", 3, "'height_px' must be >= 100, got 3"),
    ],
)
def test_invalid_traits_raise(name, value, message):
    widget = fs.view.widget(LAYOUT)

    with pytest.raises(ParameterError, match=message):
        setattr(widget, name, value)
    assert (widget.by, widget.pinned, widget.selected.tolist()) == ("", -1, [])


def test_selected_sites_are_sorted():
    widget = fs.view.widget(LAYOUT)
    widget.selected = [7, 3, 7]

    assert widget.selected.tolist() == [3, 7]
    assert repr(widget) == "SitesWidget('grid', 96 sites, by='', pinned=-1, 2 selected)"


def test_missing_anywidget_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "foveasim.view.web._widget", raising=False)

    with pytest.raises(ParameterError, match=r"needs anywidget; install it with: pip install 'foveasim\[notebook\]'"):
        fs.view.widget(LAYOUT)
