"""The panes of the page: labels at all window sizes, splitters, groups of tabs, and the search of settings."""

from __future__ import annotations

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import Keys, control, drop, settle, until
from studio.test_sources_page import video

pytestmark = pytest.mark.needs("chromium")

#: Width, height and scale of windows: two laptops, a large screen, a zoom of 150 %, and half a screen.
SIZES = {
    "1366": (1366, 768, 1),
    "1440": (1440, 900, 1),
    "2560": (2560, 1440, 1),
    "150 %": (960, 600, 1.5),
    "600": (600, 900, 1),
}
#: Shows all settings, also those that are not set.
OPEN_ALL = """() => { for (const each of document.querySelectorAll("details")) each.open = true;
  for (const each of document.querySelectorAll(".section > .more")) if (!each.hidden) each.click(); }"""
#: Texts that are cut: partly outside of an element that hides what does not fit, beyond the end of one that scrolls sideways, or
#: beyond the window. A text that is hidden completely has given way.
CUT_TEXTS = """() => {
  const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode());) {
    const holder = node.parentElement, text = node.data.trim();
    if (!text || holder.closest(".unseen, .skip, option, textarea, pre, [aria-hidden=true]")) continue;
    if (!holder.checkVisibility({ visibilityProperty: true, opacityProperty: true })) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const { left, right, top, bottom, width } = range.getBoundingClientRect();
    if (width > 0 && right > innerWidth + 1) found.push(text + ": beyond the window");
    for (let each = holder; width > 0 && each !== document.body; each = each.parentElement) {
      const style = getComputedStyle(each), box = each.getBoundingClientRect();
      if (style.display === "inline") continue;
      const isOutside = right <= box.left || left >= box.right || bottom <= box.top || top >= box.bottom - 1;
      const hides = (overflow) => overflow === "hidden" || overflow === "clip";
      const isCut = (hides(style.overflowX) && (right > box.right + 1 || left < box.left - 1))
        || (hides(style.overflowY) && (bottom > box.bottom + 2 || top < box.top - 2))
        || (/auto|scroll/.test(style.overflowX) && right > box.left + each.clientWidth + 2);
      if (isCut && !isOutside) { found.push(text + " in " + each.tagName + "#" + each.id + "." + each.className); break; }
      if (isOutside || /auto|scroll/.test(style.overflowY)) break;
    }
  }
  return found;
}"""


def open_size(visit, size):
    width, height, scale = SIZES[size]
    page = visit(width=width, height=height, device_scale_factor=scale)
    page.evaluate(OPEN_ALL)
    settle(page)
    return page


def box(page, selector):
    return page.locator(selector).bounding_box()


# -- labels ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_no_label_is_cut(visit, size):
    page = open_size(visit, size)
    n_labels = page.locator(".control label:visible").count()

    assert n_labels > 100
    assert page.evaluate(CUT_TEXTS) == []


def test_cut_labels_are_found(visit):
    page = visit()
    page.add_style_tag(content=".control label { white-space: nowrap; overflow: hidden; width: 20px; }")

    assert len(page.evaluate(CUT_TEXTS)) > 10


@pytest.mark.parametrize("size", SIZES)
def test_tabs_are_visible_in_groups(visit, size):
    page = open_size(visit, size)
    groups = page.locator("#tabs [role=group]").evaluate_all(
        "all => all.map((group) => [group.getAttribute('aria-label'), group.querySelectorAll('button').length])"
    )
    page.locator("#tabs").scroll_into_view_if_needed()
    dock, window = box(page, "#tabs"), page.viewport_size

    assert [name for name, _ in groups] == ["See", "Measure", "Check", "Explore"]
    assert min(n for _, n in groups) >= 3
    for button in page.locator("#tabs button").all():
        found = button.bounding_box()
        assert dock["x"] <= found["x"]
        assert found["x"] + found["width"] <= dock["x"] + dock["width"]
        assert found["y"] + found["height"] <= window["height"]


@pytest.mark.parametrize("size", ["1366", "2560"])
def test_dock_shows_whole_tiles(visit, size):
    page = open_size(visit, size)
    page.evaluate("() => { for (const each of document.querySelectorAll('#tabs [aria-pressed=false]')) each.click(); }")
    settle(page)
    page.evaluate("() => { document.getElementById('tiles').scrollTop = 150; }")
    settle(page)
    dock = box(page, "#tiles")
    tops = page.locator("#tiles .tile:visible").evaluate_all(
        "all => all.map((tile) => tile.getBoundingClientRect()).map(({ top, bottom }) => [top, bottom])"
    )
    inside = [(top, bottom) for top, bottom in tops if bottom > dock["y"] + 2 and top < dock["y"] + dock["height"] - 2]

    assert inside
    for top, bottom in inside:
        assert top >= dock["y"] - 1
        assert bottom <= dock["y"] + dock["height"] + 1


def test_settings_leave_views_reachable_when_narrow(visit):
    page = open_size(visit, "600")
    for selector in ("#map", "#scene", "#tile-summary"):
        page.locator(selector).scroll_into_view_if_needed()
        found, sheet = box(page, selector), box(page, "#controls")
        assert found["y"] + min(found["height"], 200) <= sheet["y"] + 1, selector


# -- splitters ------------------------------------------------------------------------------------------------------------


def test_splitters_are_dragged_and_kept(visit):
    page = visit(width=1440, height=900)
    before = {name: box(page, name) for name in ("#controls", "#pane-sites", "#tiles")}
    for name, dx, dy in (("#controls", 60, 0), ("#pane-sites", -90, 0), ("#dock", 0, -70)):
        at = box(page, f"{name} > .splitter")
        # Away from the middle, where another splitter ends.
        x, y = at["x"] + 0.4 * at["width"], at["y"] + 0.3 * at["height"]
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + dx, y + dy, steps=3)
        page.mouse.up()
        settle(page)
    after = {name: box(page, name) for name in before}

    assert after["#controls"]["width"] == pytest.approx(before["#controls"]["width"] + 60, abs=2)
    assert after["#tiles"]["height"] == pytest.approx(before["#tiles"]["height"] + 70, abs=2)
    assert after["#pane-sites"]["width"] < before["#pane-sites"]["width"] - 90
    page.reload()
    settle(page)
    for name, found in after.items():
        assert box(page, name) == pytest.approx(found, abs=1), name
    page.dblclick("#controls > .splitter")
    assert box(page, "#controls")["width"] == before["#controls"]["width"]


def test_splitters_are_moved_by_keyboard(visit):
    page = visit(width=1440, height=900)
    keys, before = Keys(page), box(page, "#controls")["width"]
    keys.to("#controls > .splitter")
    value = int(page.get_attribute("#controls > .splitter", "aria-valuenow"))
    keys.press("ArrowRight", "ArrowRight", "ArrowRight")

    assert box(page, "#controls")["width"] == pytest.approx(before + 48, abs=1)
    assert int(page.get_attribute("#controls > .splitter", "aria-valuenow")) > value
    keys.press("Home")
    assert box(page, "#controls")["width"] == pytest.approx(120, abs=1)
    keys.to("#pane-picture > .splitter")
    assert page.get_attribute("#pane-picture > .splitter", "aria-orientation") == "horizontal"
    height = box(page, "#pane-picture")["height"]
    keys.press("ArrowDown")
    assert box(page, "#pane-picture")["height"] == pytest.approx(height + 16, abs=1)
    assert keys.n_pointed == 0


# -- search and values ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "first"),
    [
        ("fovea", "layout.parameters.fovea"),
        ("minimum size", "layout.parameters.min_size_um"),
        ("minimum site size", "layout.rules.min_size_um"),
        ("gain", "sensor.capacitance_f"),
        ("exposure", "exposure_s"),
        ("noise", "sensor.read_noise_e"),
        ("photosites", "layout.parameters.n_sites"),
    ],
)
def test_search_lists_meant_setting_first(visit, text, first):
    page = visit()
    page.fill("#search", text)
    rows = page.locator(".control:visible").evaluate_all(
        "all => all.sort((a, b) => a.getBoundingClientRect().top - b.getBoundingClientRect().top).map((row) => row.dataset.key)"
    )

    assert rows[0] == first
    page.fill("#search", "")
    assert page.locator(".section:visible").first.get_attribute("data-section") == "exposure"


def test_unset_settings_look_unset(visit):
    page = visit()
    page.evaluate(OPEN_ALL)
    field = control(page, "scene.field_of_view_deg")

    assert field.input_value() == ""
    assert field.get_attribute("placeholder") == "not set"
    assert control(page, "scene.field_of_view_deg", "input[type=range]").get_attribute("aria-valuetext") == "not set"
    assert control(page, "sensor.dead_fraction").get_attribute("placeholder") == "0"
    exposure = control(page, "exposure_s")
    exposure.fill("-1")
    exposure.press("Enter")
    until(page, "() => studio.isIdle && Object.keys(studio.state.errors).length > 0")
    # The words of the control stand before the name in settings.
    assert "Exposure (exposure_s)" in page.inner_text(".control[data-key='exposure_s'] .error")


def test_numbers_have_one_form(visit):
    page = visit(width=1920, height=1080)
    text = page.inner_text("#views")

    assert "20 ms" in page.inner_text("#summary")
    assert "e⁻" in page.inner_text("#noise")
    assert " e-" not in text
    assert "/mm" in page.inner_text("#tile-mtf .chart-legend")


# -- transport ------------------------------------------------------------------------------------------------------------


def test_video_and_gaze_path_share_transport(visit, tmp_path):
    page = visit()
    drop(page, "clip.mp4", video(tmp_path))
    until(page, "() => studio.isIdle && studio.state.film?.kind === 'video'")
    page.click("#gaze-path")
    page.evaluate("() => studio.connection.set('gaze_path', [[0, -140, 320], [0.5, -100, 300]], true)")
    settle(page)

    assert page.locator("#pane-scene input[type=range]:visible").count() == 1
    assert page.locator("#transport").is_visible()
    page.click("#transport [aria-label='One step forward on the gaze path']")
    until(page, "() => studio.isIdle && studio.state.film.n === 1")
    assert page.inner_text("#transport .quiet").startswith("\u20072 / 12 · 0.10 s")


def test_outline_of_view_stays_in_pane(visit):
    """The rectangle of a view above a picture is drawn at the upper edge of the picture."""
    page = visit()
    rows = page.evaluate(
        """async () => {
        const { drawView } = await import("/web/marks.js"), canvas = new OffscreenCanvas(200, 200), same = (x) => x;
        const context = canvas.getContext("2d"), map = { fromX: (x) => x + 50, fromY: (y) => y - 400, width: 100, height: 100 };
        drawView(context, { toX: same, toY: same }, map, 200, 200);
        const { data } = context.getImageData(0, 0, 200, 200);
        return [...Array(200).keys()].filter((y) => data.slice(800 * y, 800 * (y + 1)).some((value, i) => i % 4 === 3 && value > 0));
        }"""
    )

    assert rows[:3] == [0, 1, 2]
    assert rows[-1] < 10
