"""Views of the studio in a browser: charts over signal and exposure, columns and layers in three dimensions."""

from __future__ import annotations

import numpy as np
import pytest
from waiting import DEADLINE_S

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import has_picture, set_value, settle, until

pytestmark = pytest.mark.needs("chromium")

#: Browsers without WebGL.
WITHOUT_WEBGL = """{ const own = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...rest) { return /webgl/.test(kind) ? null : own.call(this, kind, ...rest); }; }"""


def show(page, *names):
    """Show only the tiles with these names."""
    page.evaluate(
        "names => { for (const b of document.querySelectorAll('#tabs button'))"
        " if ((b.getAttribute('aria-pressed') === 'true') !== names.includes(b.dataset.tile)) b.click(); }",
        list(names),
    )
    settle(page)


def show_solid(page, mode="columns"):
    show(page, "solid")
    if mode == "stack":
        page.click("[data-solid=stack]")
        until(page, "() => studio.views.parts.solid")
    until(
        page,
        "mode => studio.solid.shown.mode === mode && studio.solid.view.counts.screen > 0 && !studio.solid.isAsked",
        mode,
    )


def pixels(page):
    """Return the drawn pixels of the 3D view, (n_y, n_x, 3)."""
    values = page.evaluate("""() => { const { view } = studio.solid, { gl, canvas: { width, height } } = view, data = new Uint8Array(4 * width * height);
      view.draw(); gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
      let text = ""; for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.subarray(i, i + 8192)); return [width, height, btoa(text)]; }""")
    import base64

    width, height, text = values
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)[::-1, :, :3].astype(int)


# -- charts -----------------------------------------------------------------------------------------------------------------


def test_charts_have_curves_marks_and_notes(visit):
    page = visit()
    show(page, "photon_transfer", "snr", "mtf")
    until(page, "() => ['photon_transfer', 'snr', 'mtf'].every((name) => studio.views.parts[name])")

    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        settle(page)
        for name in ("photon_transfer", "snr", "mtf"):
            assert has_picture(page, f"#{name} canvas"), (name, scheme)
    assert page.locator("#photon_transfer li").all_inner_texts()[:2] == ["temporal noise", "photon shot"]
    assert page.locator("#snr li").all_inner_texts() == ["R", "G", "B"]
    assert "full range" in page.inner_text("#photon_transfer .chart-note")
    assert "Dynamic range / dB: R" in page.inner_text("#snr .chart-note")
    assert "Nyquist" in page.inner_text("#mtf")
    assert page.evaluate("studio.views.made.snr.chart.marks.length") == 6

    before = page.evaluate("studio.views.made.photon_transfer.chart.marks[0].x")
    set_value(page, "exposure_s", 0.01)

    assert page.evaluate("studio.views.made.photon_transfer.chart.marks[0].x") == pytest.approx(before / 2, rel=1e-3)


@pytest.mark.slow
def test_logarithmic_chart_reads_values_at_mouse(visit):
    page = visit()
    show(page, "snr")
    until(page, "() => studio.views.parts.snr")
    box = page.locator("#snr canvas").bounding_box()
    page.mouse.move(box["x"] + 46 + 0.5 * (box["width"] - 56), box["y"] + 40)
    first, *values = page.locator("#snr li").all_inner_texts()
    low, high = page.evaluate(
        "() => { const all = studio.views.made.snr.chart.curves.flatMap((c) => [...c.x]); return [Math.min(...all), Math.max(...all)]; }"
    )

    exposure, unit = first.split()[:2]
    assert float(exposure) * {"µs": 1e-6, "ms": 1e-3, "s": 1.0}[unit] == pytest.approx(np.sqrt(low * high), rel=0.03)
    assert len(values) == 3


# -- three dimensions -------------------------------------------------------------------------------------------------------


def test_columns_have_colours_of_the_map(visit):
    page = visit(color_scheme="light")
    show_solid(page)
    page.click("#solid-above")
    grounds = []
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        settle(page)
        until(page, "() => !studio.solid.isAsked")
        grounds.append(check_colours_of_columns(page))

    assert grounds[0] != grounds[1]


def check_colours_of_columns(page):
    seen = {tuple(v) for v in pixels(page).reshape(-1, 3)}
    ground = page.evaluate("studio.solid.view.ground")
    expected = page.evaluate("""() => { const { sites, scale } = studio.panes.b, areas = [...sites.area.keys()].sort((a, b) => sites.area[b] - sites.area[a]);
      return areas.slice(0, 40).map((site) => scale.colour(site)); }""")

    assert tuple(ground) in seen
    # Tops face the lens; the light is inclined by 31 degrees.
    lit = 0.42 + 0.60 * 0.856
    linear = [
        np.where(np.array(c) / 255 <= 0.04045, np.array(c) / 255 / 12.92, ((np.array(c) / 255 + 0.055) / 1.055) ** 2.4)
        for c in expected
    ]
    near = []
    for colour in linear:
        value = colour * lit
        wanted = np.rint(255 * np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055))
        near.append(any(np.abs(wanted - v).max() <= 3 for v in seen))
    assert np.mean(near) > 0.9
    return ground


def test_columns_follow_values_without_outlines(visit):
    page = visit()
    show_solid(page)
    before = page.evaluate(
        "() => { window.bodies = studio.solid.view.bodies; return [...studio.solid.view.heights.subarray(1, studio.panes.b.sites.n + 1)]; }"
    )
    set_value(page, "exposure_s", 0.004)
    until(page, "() => !studio.solid.isAsked")
    after, codes, top = page.evaluate(
        "() => [[...studio.solid.view.heights.subarray(1, studio.panes.b.sites.n + 1)], [...studio.panes.b.column.values], studio.panes.b.scale.to]"
    )

    assert page.evaluate("window.bodies === studio.solid.view.bodies")
    assert after == pytest.approx(np.array(codes) / top, abs=1e-6)
    assert before != after
    page.select_option("#colouring", "size_um")
    until(page, "() => !studio.solid.isAsked && studio.solid.shown.scale === studio.panes.b.scale")
    assert "size" in page.inner_text("#solid-text")
    set_value(page, "layout.parameters.n_sectors", 36)
    until(page, "() => !studio.solid.isAsked && studio.solid.view.bodies.sites === studio.panes.b.sites")


def test_cursor_is_common_with_columns(visit):
    page = visit()
    show_solid(page)
    page.click("#solid-above")
    until(page, "() => !studio.solid.isAsked")
    site = 200
    x, y = page.evaluate("site => studio.panes.b.sites.centre(site)", site)
    at = page.evaluate(
        """([x, y, site]) => { const { view, half } = studio.solid, box = half.getBoundingClientRect(), [px, py] = view.orbit.project(x, y, view.heights[site + 1] * view.bodies.high[2], [0, 0]);
      return [box.left + px, box.top + py]; }""",
        [x, y, site],
    )
    page.mouse.move(*at)
    until(page, "site => studio.page.hovered === site", site)
    assert page.evaluate("[studio.page.cursor.x, studio.page.cursor.y]") == pytest.approx([x, y], abs=4.0)
    page.mouse.click(*at)
    until(page, "site => studio.page.pinned === site", site)
    page.mouse.move(*page.evaluate("([x, y]) => studio.toWindow(x, y)", [x, y]))
    until(
        page, "site => studio.solid.hovered === site && !studio.solid.isAsked && !studio.solid.view.areIdsStale", site
    )
    lit = pixels(page)
    page.mouse.move(2, 2)
    until(page, "() => studio.solid.hovered === -1 && !studio.solid.isAsked")
    assert (lit != pixels(page)).any()


def test_view_rotates_and_scales_columns(visit):
    page = visit()
    show_solid(page)
    orbit = "[studio.solid.view.orbit.azimuth, studio.solid.view.orbit.elevation, studio.solid.view.orbit.distance]"
    start = page.evaluate(orbit)
    box = page.locator("#solid").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 120, steps=4)
    page.mouse.up()
    turned = page.evaluate(orbit)
    assert turned[0] < start[0]
    assert turned[1] > start[1]
    map_scale = page.evaluate("studio.panes.b.map.scale")
    page.focus("#solid .marks")
    for key in ("ArrowRight", "ArrowUp", "+", "Enter"):
        page.keyboard.press(key)
    moved = page.evaluate(orbit)
    assert moved[0] > turned[0]
    assert moved[2] < turned[2]
    assert page.evaluate("studio.panes.b.map.scale") == map_scale
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    page.keyboard.press("t")
    assert page.evaluate("studio.solid.view.orbit.elevation") == pytest.approx(np.pi / 2)
    page.keyboard.press("0")
    assert page.evaluate(orbit)[:2] == pytest.approx(start[:2])

    page.evaluate(
        "() => { const s = document.getElementById('solid-height'); s.value = 1; s.dispatchEvent(new Event('input')); }"
    )

    assert page.evaluate("studio.solid.view.orbit.height") == 2
    assert page.inner_text("#solid-factor") == "× 2"
    page.click("[data-solid=stack]")
    until(page, "() => studio.solid.shown.mode === 'stack'")
    page.click("[data-solid=columns]")
    until(page, "() => studio.solid.shown.mode === 'columns'")
    assert page.inner_text("#solid-factor") == "× 2"


def test_layers_are_stacked_and_cut(visit):
    page = visit()
    show_solid(page, "stack")
    assert page.evaluate("studio.solid.view.parts.map((part) => part.name)") == [
        "wells",
        "trenches",
        "filters",
        "lenses",
    ]
    assert "Silicon 3 µm" in page.inner_text("#solid-text")
    found = page.evaluate("""() => { const { view } = studio.solid, seen = new Set(); view.updateIds();
      for (let x = 0; x < view.orbit.width; x += 7) for (let y = 0; y < view.orbit.tall; y += 7) { const { part } = view.pick(x, y); if (part >= 0) seen.add(view.parts[part].name); } return [...seen]; }""")
    assert {"wells", "filters", "lenses"} <= set(found)
    page.evaluate(
        "() => { const s = document.getElementById('solid-cut'); s.value = 0; s.dispatchEvent(new Event('input')); }"
    )
    assert page.evaluate("studio.solid.view.cut") is None


def test_hidden_view_computes_nothing(visit):
    page = visit()
    show(page, "histogram")
    set_value(page, "exposure_s", 0.01)

    assert page.evaluate("studio.solid === undefined")
    show_solid(page, "stack")
    show(page, "histogram")
    page.evaluate("() => { delete studio.views.parts.solid; window.drawn = studio.solid.view.counts.image; }")
    set_value(page, "layout.parameters.n_sectors", 40)
    assert page.evaluate("[studio.views.parts.solid === undefined, studio.solid.view.counts.image - window.drawn]") == [
        True,
        0,
    ]


def test_line_explains_missing_webgl(visit):
    page = visit(script=WITHOUT_WEBGL)
    show(page, "solid")
    until(page, "() => !document.getElementById('solid-note').hidden")

    assert "WebGL2" in page.inner_text("#solid-note")
    set_value(page, "exposure_s", 0.01)


def test_new_views_fit_width(visit):
    page = visit(width=2560, height=1440)
    show(page, "solid", "photon_transfer", "snr", "mtf")
    for width, exposure_s in ((2560, 0.015), (1280, 0.016), (390, 0.017)):
        page.set_viewport_size({"width": width, "height": 844 if width < 500 else width * 9 // 16})
        set_value(page, "exposure_s", exposure_s)

        assert page.evaluate("document.documentElement.scrollWidth") <= width
        for name in ("#solid", "#map", "#photon_transfer canvas", "#snr canvas"):
            box = page.locator(name).bounding_box()
            assert box["width"] > 100, (name, width)
            assert box["height"] > 60, (name, width)


# -- previews ---------------------------------------------------------------------------------------------------------------


def test_drag_shows_previews_and_then_everything(visit, server, monkeypatch):
    from foveasim.config import build_shot
    from foveasim.studio import _engine, _session

    monkeypatch.setattr(_engine, "PREVIEW_CELLS", 1 << 14)
    page = visit()
    (session,) = server.studio.sessions.values()
    monkeypatch.setattr(_session, "PREVIEW_IDLE_S", DEADLINE_S)
    page.evaluate("() => { studio.connection.set('optics.f_number', 4, false); }")
    status = "/^preview, /.test(document.getElementById('status').textContent.trim())"
    until(page, f"() => {status} && studio.views.parts.columns?.is_preview && studio.state.is_preview")
    # Without further changes the complete result follows.
    monkeypatch.setattr(_session, "PREVIEW_IDLE_S", 0.0)
    with session.queue.wake:
        session.queue.wake.notify()
    until(page, "() => studio.isIdle && !studio.connection.requests.isPreview && !studio.state.is_preview")
    assert "preview" not in page.inner_text("#status")
    set_value(page, "optics.f_number", 5.6)
    shot = build_shot(None, page.evaluate("studio.state.settings"))
    expected = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code
    found = page.evaluate("() => [...studio.panes.b.columns.find((c) => c.key === 'code').values]")

    assert found == expected.tolist()
    assert page.is_enabled("#undo")
