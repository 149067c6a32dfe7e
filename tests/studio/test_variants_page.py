"""Named variants on the page: hexagons against squares, by mouse and by keyboard."""

from __future__ import annotations

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import Server, change, set_value, setting, settle, until

pytestmark = pytest.mark.needs("chromium")

SQUARES = {"generator": "grid", "parameters": {"n_x": 30, "n_y": 30, "pitch_um": 30.0}, "mosaic": ["RG", "GB"]}
HEXAGONS = {
    "generator": "hexagonal",
    "parameters": {"n_columns": 30, "n_rows": 34, "pitch_um": 30.0},
    "mosaic": ["RG", "GB"],
}
FINE = {
    "generator": "hexagonal",
    "parameters": {"n_columns": 60, "n_rows": 68, "pitch_um": 15.0},
    "mosaic": ["RG", "GB"],
}


def keep(page, name):
    page.fill("#keep-variant input", name)
    page.click("#keep-variant button")
    until(page, f"() => studio.state.variants.some((each) => each.name === '{name}')")


def cells(page):
    settle(page)
    found = page.locator("#comparison tr[data-name]").evaluate_all(
        "all => all.map((row) => [row.dataset.name, [...row.querySelectorAll('td')].map((cell) => cell.textContent)])"
    )
    return dict(found)


def decibels(text):
    return float(text.removesuffix(" dB"))


def test_hexagons_against_squares(tmp_path, visit):
    own = Server(tmp_path)
    try:
        page = visit(is_checked=False, address=own.address)
        settle(page)
        page.click("[data-tile=variants]")
        for name, layout in (("squares", SQUARES), ("hexagons", HEXAGONS), ("fine hexagons", FINE)):
            set_value(page, "layout", layout)
            keep(page, name)
        page.fill("#variants li:first-child input[aria-label^='Note']", "a quarter of the photosites")
        page.press("#variants li:first-child input[aria-label^='Note']", "Tab")
        for name in ("squares", "hexagons", "fine hexagons"):
            page.check(f"input[aria-label='Compare {name}']")
            until(page, f"() => studio.state.variants.find(({{ name }}) => name === '{name}').is_compared")
        until(page, "() => document.querySelectorAll('#comparison th[scope=col]').length === 5")
        found = cells(page)

        heads = page.locator("#comparison th[scope=col]").all_inner_texts()
        assert heads == ["fine hexagons", "hexagons", "squares", "B", "B − fine hexagons"]
        assert found["n_sites"] == ["4,080", "1,020", "900", "4,080", "0"]
        fine, coarse, squares, *_ = map(decibels, found["field_psnr_db"])
        assert fine > coarse > squares - 1.0

        # After a restart, the page has the variants and compares them again.
        own.stop()
        own.start()
        until(page, "() => studio.isIdle && studio.state.variants.filter((each) => each.is_compared).length === 3")
        assert page.input_value("#variants li:first-child input[aria-label^='Note']") == "a quarter of the photosites"
        until(page, "() => document.querySelectorAll('#comparison th[scope=col]').length === 5")
        change(page, "() => document.querySelector(\"button[aria-label='Apply squares']\").click()")
        assert setting(page, "layout")["generator"] == "grid"
        assert cells(page)["n_sites"][-2] == "900"
        change(page, "() => document.getElementById('undo').click()")
        assert setting(page, "layout")["generator"] != "grid"

        page.click("button[aria-label='Show squares as A']")
        until(page, "() => studio.isIdle && studio.page.frozen?.isKept && studio.panes.a.sites.n === 900")
        assert page.evaluate("studio.panes.b.sites.n") != 900
        page.click("button[aria-label='Delete hexagons']")
        page.click("#confirm-verb")
        until(page, "() => studio.state.variants.length === 2")
        assert sorted(path.name for path in (tmp_path / "variants").iterdir()) == ["fine_hexagons.yaml", "squares.yaml"]
    finally:
        own.stop()


def test_variants_by_keyboard(visit):
    page = visit()
    page.click("[data-tile=variants]")
    page.focus("#keep-variant input")
    page.keyboard.type("start")
    page.keyboard.press("Enter")
    until(page, "() => studio.state.variants.length === 1")
    set_value(page, "exposure_s", 0.001)
    page.focus("#keep-variant input")
    page.keyboard.press("Enter")
    until(page, "() => studio.state.variants.length === 2")
    assert [each["name"] for each in page.evaluate("studio.state.variants")] == ["start", "variant 2"]

    # Check box, name, note, Apply.
    page.focus("input[aria-label='Compare start']")
    page.keyboard.press("Space")
    until(page, "() => studio.state.variants[0].is_compared && studio.views.parts.comparison")
    assert page.evaluate("document.activeElement.ariaLabel") == "Compare start"
    for _ in range(3):
        page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.ariaLabel") == "Apply start"
    page.keyboard.press("Enter")
    until(page, "() => studio.isIdle && studio.state.settings.exposure_s === 0.02")
    page.focus("button[aria-label='Delete start']")
    page.keyboard.press("Enter")
    page.wait_for_selector("#confirm-dialog[open]")
    page.keyboard.press("Enter")  # the focus is on Cancel
    assert page.evaluate("studio.state.variants.length") == 2
    page.keyboard.press("Enter")
    page.wait_for_selector("#confirm-dialog[open]")
    page.keyboard.press("Shift+Tab")
    page.keyboard.press("Enter")
    until(page, "() => studio.state.variants.length === 1")
