"""Accessibility of all pages by the rules of axe-core: light and dark, with all their parts."""

from __future__ import annotations

import pytest
from browsers import wait_for_promise

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from reference.accessibility import violations, violations_in_themes
from studio.page_tools import settle, until

import foveasim as fs
from foveasim.view import solid_page, web_page
from foveasim.view.web._report_page import ReportFigure, ReportSection, ReportTable, report_html

pytestmark = pytest.mark.needs("chromium")

LAYOUT = fs.layout.mosaic(fs.layout.grid(n_x=6, n_y=5, pitch_um=4.0), ("RG", "GB"))
OPEN_ALL = "() => { for (const { name, is_tile } of studio.views.list) if (is_tile) studio.views.show(name, true); }"


def capture_page():
    capture = fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=4.0),
        sensor=fs.Sensor(LAYOUT, qe=0.5, filters="rgb", capacitance_f=1e-15, v_sat_v=1.0, bits=8),
    ).capture(
        fs.Scene.flat(
            shape=(32, 32), pitch_um=500.0, distance_m=1.0, radiance_w_m2_sr_nm=0.02, wavelength_nm=550.0, band_width_nm=100.0
        ),
        exposure_s=0.01,
        seed=0,
    )  # fmt: skip
    return web_page(capture, second=capture, name="capture")


def rules_page():
    return web_page(LAYOUT, report=LAYOUT.check(fs.DesignRules(min_width_um=5.0)), name="rules")


def report():
    pixel = "data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
    section = ReportSection(
        "Numbers",
        ["A paragraph."],
        [ReportTable(["quantity", "A", "B"], [["sites", "10", "12"]], "Sites of both")],
        [[ReportFigure(pixel, "A figure", "Its caption", pixel)]],
        ("Settings", "exposure_s: 0.01"),
    )
    return report_html("Report", [section, section])


def check(page, part="html"):
    assert violations_in_themes(page, part) == [], page.viewport_size


@pytest.mark.slow(keep=("solid",))
@pytest.mark.parametrize(
    "make", [capture_page, rules_page, lambda: solid_page(LAYOUT), report], ids=["capture", "rules", "solid", "report"]
)
def test_pages_have_no_serious_violations(browser, tmp_path, make):
    path = tmp_path / "page.html"
    path.write_text(make(), encoding="utf-8")
    context = browser.new_context(reduced_motion="reduce")
    page = context.new_page()
    page.goto(path.as_uri())
    wait_for_promise(page, "globalThis.foveasim?.complete")
    if page.locator("#select").count():
        page.keyboard.press("s")
        page.evaluate("() => { document.getElementById('notice').hidden = true; }")
    found = violations_in_themes(page)
    if page.locator("#keys").count():
        page.click("#help")
        found += violations_in_themes(page, "#keys")
    context.close()

    assert found == []


@pytest.mark.nightly
def test_studio_has_no_serious_violations(visit):
    widths = (1920, 1280, 390)
    page = visit(width=widths[0], height=1000)

    def show(width):
        page.set_viewport_size({"width": width, "height": 1000})
        settle(page)

    for width in widths:
        show(width)
        check(page)
    page.evaluate(
        "() => studio.connection.send({ do: 'variant', action: 'keep', name: 'first', note: 'as at the start' })"
    )
    page.evaluate(OPEN_ALL)
    page.evaluate("() => { for (const each of document.querySelectorAll('details')) each.open = true; }")
    settle(page)
    page.click("#freeze")
    until(page, "() => studio.isIdle && studio.views.parts.comparison")
    page.evaluate("() => studio.compare([studio.state.variants[0].id])")
    until(page, "() => studio.isIdle && studio.state.variants[0].is_compared")
    page.click("#edit")
    settle(page)
    for width in widths:
        show(width)
        check(page)
        page.click("#file")
        check(page, "header")
        page.keyboard.press("Escape")
        page.click("#help")
        check(page, "#keys")
        page.keyboard.press("Escape")
        page.wait_for_selector("#keys", state="hidden")


@pytest.mark.slow
def test_violations_are_found(browser):
    page = browser.new_page()
    page.set_content("<p style='color: #ccc; background: #fff'>pale</p><input><img src='data:,'>")
    found = {text.split(":")[0] for text in violations(page)}
    page.close()

    assert {"color-contrast", "label", "image-alt"} <= found
