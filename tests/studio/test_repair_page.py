"""Repair, compared maps and errors on the page of the studio, in a browser."""

from __future__ import annotations

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import noticed, set_value, setting, settle, until

pytestmark = pytest.mark.needs("chromium")

#: Whether all sites of both maps are in view.
ARE_IN_VIEW = """() => ["a", "b"].every((name) => {
  const { map } = studio.panes[name], [x0, y0, x1, y1] = map.sites.bounds;
  return map.toX(x0) >= 0 && map.toX(x1) <= map.width && map.toY(y1) >= 0 && map.toY(y0) <= map.height;
})"""


def test_repair_shows_methods_and_reports(visit):
    page = visit()
    set_value(page, "layout.rules.min_size_um", 12.0)
    page.evaluate("() => studio.views.show('rules', true)")
    settle(page)
    page.click("#repair")
    until(page, "() => document.querySelectorAll('.repairs li:not(.pending)').length === 5")
    texts = page.locator(".repairs li").evaluate_all(
        "all => Object.fromEntries(all.map((li) => [li.dataset.method, li.querySelector('p').textContent]))"
    )
    assert texts["drop"].startswith("912 -> 720 sites, area 1.4785 mm² -> 1.4595 mm²")
    assert "192 sites dropped" in texts["drop"]
    assert "loses more than a tenth" in texts["drop"]
    page.keyboard.press("Escape")
    assert page.is_hidden("#repair-dialog")
    assert setting(page, "layout.edits") is None
    page.click("#repair")
    page.click(".repairs li[data-method=drop]:not(.pending) button")
    noticed(page, "Repaired: 912 -> 720 sites")
    settle(page)

    assert page.inner_text("#repaired").startswith("Repaired: 912 -> 720 sites")
    assert setting(page, "layout.edits") == [{"kind": "repair", "method": "drop"}]
    assert page.evaluate("studio.panes.b.sites.n") == 720


def test_compared_maps_show_both_sensors(visit):
    page = visit()
    page.click("#freeze")
    settle(page)
    for pitch_um in (60.0, 2.0):  # larger and much smaller than A
        parameters = {"n_x": 40, "n_y": 40, "pitch_um": pitch_um}
        set_value(page, "layout", {"generator": "grid", "parameters": parameters, "mosaic": ["RG", "GB"]})
        assert page.evaluate(ARE_IN_VIEW)


def test_error_keeps_its_field_in_view(visit):
    page = visit()
    page.locator(".control[data-key='optics.f_number']").evaluate("row => { row.closest('details').open = false; }")
    page.evaluate("() => { studio.connection.set('optics.f_number', -1, true); }")
    until(page, "() => Object.keys(studio.state.errors).length === 1")
    row = page.locator(".control[data-key='optics.f_number']")

    assert row.is_visible()
    assert "must" in row.locator(".error").inner_text()
    set_value(page, "optics.f_number", 4)
    assert row.locator(".error").is_hidden()
    assert page.is_hidden("#notice")
