"""The page in daily work: problems, unknowns of generators, duplicated tabs, a silent server, cancelling, saving."""

from __future__ import annotations

import csv
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image
from waiting import DEADLINE_S, wait_until

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import (
    TOKEN,
    Server,
    change,
    codes,
    control,
    forget_notice,
    noticed,
    set_value,
    setting,
    settle,
    until,
)

from foveasim.studio._session import Session

pytestmark = pytest.mark.needs("chromium")


def text_of(page, selector):
    return page.evaluate("selector => document.querySelector(selector).textContent", selector)


def field(page, key, value):
    box = control(page, key)
    box.fill(value)
    box.press("Enter")
    settle(page)


# -- problems -----------------------------------------------------------------------------------------------------------


def test_worst_problem_and_badges_are_visible(visit):
    page = visit()
    until(page, "() => studio.views.parts.rules")
    set_value(page, "layout.rules.min_size_um", 12.0)
    until(page, "() => document.querySelector('#tabs [data-tile=rules] .count')")
    violations = page.evaluate("studio.views.parts.rules.about.rules.reduce((sum, rule) => sum + rule.count, 0)")
    assert violations > 100
    assert text_of(page, "#tabs [data-tile=rules] .count") == f"{violations:,}"
    assert page.inner_text("#worst-text").startswith(f"{violations:,} violations of design rules")
    page.click("#worst-text")
    assert page.is_visible("#tile-rules")

    set_value(page, "layout.rules.min_size_um", 4.0)
    until(page, "() => !document.querySelector('#tabs [data-tile=rules] .count')")
    set_value(page, "exposure_s", 1.0)
    until(page, "() => document.querySelector('#tabs [data-tile=histogram] .count')")
    saturated = page.evaluate("studio.state.summary.saturated_fraction")
    assert text_of(page, "#tabs [data-tile=histogram] .count") == f"{float(f'{100 * saturated:.2g}'):g} %"
    assert "saturated" in page.get_attribute("#worst-text", "title")


def test_fit_scene_covers_all_photosites(visit):
    page = visit()
    check_fit_scene(page)
    change(page, "() => document.getElementById('undo').click()")
    chart = {"kind": "siemens_star", "n_spokes": 36, "radius_mm": 30.0, "shape": [256, 256], "pitch_um": 300.0}
    light = {"radiance_w_m2_sr_nm": 0.02, "wavelength_nm": 550.0, "band_width_nm": 100.0}
    set_value(page, "scene", {**chart, "distance_m": 1.0, **light})
    check_fit_scene(page)


def check_fit_scene(page):
    set_value(page, "gaze_um", [1500.0, 200.0])
    until(page, "() => !document.getElementById('fit-scene').hidden")
    assert "outside the image" in page.inner_text("#worst-text")
    change(page, "() => document.getElementById('fit-scene').click()")

    until(page, "() => document.getElementById('fit-scene').hidden")
    assert not [warning for warning in page.evaluate("studio.state.warnings") if "outside the image" in warning]
    assert setting(page, "gaze_um") == [1500.0, 200.0]
    change(page, "() => document.getElementById('undo').click()")
    until(page, "() => !document.getElementById('fit-scene').hidden")


def test_first_tiles_have_content(visit):
    page = visit(width=1920, height=1080)
    until(page, "() => ['noise', 'mtf', 'snr', 'rules'].every((name) => studio.views.parts[name])")
    tiles = page.locator("#tiles .tile:visible")
    names = tiles.evaluate_all("all => all.map((tile) => tile.id.slice(5))")

    assert names == ["histogram", "site", "noise", "snr", "mtf", "rules", "summary"]
    assert page.locator("#site dd").first.inner_text() != ""
    assert "nearest to the centre" in page.inner_text("#site-heading")
    centres = np.array(
        page.evaluate("Array.from({ length: studio.panes.b.sites.n }, (_, i) => studio.panes.b.sites.centre(i))")
    )
    nearest = np.argmin((centres**2).sum(axis=1))
    assert f"{nearest:,}" in page.inner_text("#site-heading")


# -- charts ---------------------------------------------------------------------------------------------------------------


def test_root_axes_have_round_ticks(visit):
    page = visit()
    for most in (1, 7, 912, 3890, 14_208, 1_000_000):
        ticks = page.evaluate("async most => (await import('/static/charts.js')).rootTicks(most)", most)

        assert ticks, most
        assert ticks == sorted(ticks, reverse=True)
        assert ticks[0] <= most < 2 * ticks[0]
        assert all(tick == int(tick) and len(str(int(tick)).rstrip("0")) <= 2 for tick in ticks), most
        positions = np.sqrt(np.array(ticks) / most)
        assert (np.diff(positions) <= -0.2).all(), most


def test_curves_differ_by_more_than_hue(visit):
    page = visit(width=1920, height=1080)
    page.click("[data-tile=spectrum]")
    until(
        page,
        "() => studio.views.parts.spectrum && document.querySelectorAll('#spectrum .chart-legend line').length === 3",
    )
    lines = "#spectrum .chart-legend line"
    dashes = page.locator(lines).evaluate_all("all => all.map((line) => line.getAttribute('stroke-dasharray'))")
    assert len(set(dashes)) == 3

    page.click("#freeze")
    set_value(page, "sensor.qe", 0.4)
    until(page, "() => document.querySelectorAll('#spectrum .chart-legend line').length === 6")
    found = page.locator(lines).evaluate_all("all => all.map((line) => line.getAttribute('stroke-width'))")
    assert (found[:3], found[3:]) == (["2.5"] * 3, ["1"] * 3)


# -- unknowns -----------------------------------------------------------------------------------------------------------------


def test_numbers_are_entered_in_fields(visit):
    page = visit()
    before = page.evaluate("studio.state.summary.n_sites")
    field(page, "layout.parameters.n_sites", "5000")
    assert page.evaluate("studio.state.summary.n_sites") == pytest.approx(5000, rel=0.01)
    solve = page.locator(".control[data-id='layout.parameters:solve'] select")
    assert solve.evaluate("select => select.selectedOptions[0].textContent") == "n sectors"
    sectors = control(page, "layout.parameters.n_sectors")
    assert sectors.input_value() == ""
    assert sectors.get_attribute("placeholder") == str(
        page.evaluate("studio.state.solved['layout.parameters.n_sectors']")
    )

    solve.select_option(label="min size")
    until(page, "() => studio.isIdle && !('min_size_um' in studio.state.settings.layout.parameters)")
    assert page.evaluate("studio.state.summary.n_sites") == pytest.approx(5000, rel=0.02)
    for _ in range(2):
        change(page, "() => document.getElementById('undo').click()")
    assert page.evaluate("studio.state.summary.n_sites") == before
    assert solve.evaluate("select => select.selectedOptions[0].textContent") == "number of photosites"

    for text, value in (("1/50", 0.02), ("20 ms", 0.02), ("0,03", 0.03), ("8*2 ms", 0.016)):
        field(page, "exposure_s", text)
        assert setting(page, "exposure_s") == pytest.approx(value)
        assert float(control(page, "exposure_s").input_value()) == pytest.approx(value)
    field(page, "layout.parameters.n_sectors", "8*8")
    assert setting(page, "layout.parameters.n_sectors") == 64
    field(page, "optics.f_number", "wide")
    assert "f_number" in page.inner_text(".control[data-key='optics.f_number'] .error")


# -- connections ---------------------------------------------------------------------------------------------------------------


def test_reloaded_page_keeps_its_session(visit, server):
    """Also while the server has not noticed that the earlier connection is closed."""
    page = visit()
    set_value(page, "exposure_s", 0.004)
    name = "() => sessionStorage.getItem('foveasim-studio-session')"
    before = page.evaluate(name)
    session = server.studio.sessions[before]
    session.attach(print)
    try:
        page.reload()
        settle(page)
        assert page.evaluate(name) == before
        assert setting(page, "exposure_s") == 0.004
    finally:
        session.detach(print)


def test_duplicated_tab_is_a_copy(visit):
    page = visit()
    set_value(page, "exposure_s", 0.004)
    with page.expect_popup() as popup:
        page.evaluate("window.open(location.href)")  # a new tab with the storage of this one
    other = popup.value
    settle(other)
    assert setting(other, "exposure_s") == 0.004
    set_value(page, "exposure_s", 0.01)
    set_value(other, "optics.f_number", 4.0)

    assert (setting(page, "exposure_s"), setting(page, "optics.f_number")) == (0.01, 2.8)
    assert (setting(other, "exposure_s"), setting(other, "optics.f_number")) == (0.004, 4.0)
    assert control(page, "exposure_s").input_value() == "0.01"
    assert not np.array_equal(codes(page), codes(other))
    assert page.evaluate("sessionStorage.getItem('foveasim-studio-session')") != other.evaluate(
        "sessionStorage.getItem('foveasim-studio-session')"
    )


def test_silent_server_is_not_shown_as_ready(visit, server):
    page = visit()
    name = page.evaluate("sessionStorage.getItem('foveasim-studio-session')")
    with server.studio.sessions[name].queue.wake:  # no message is accepted
        control(page, "optics.f_number").fill("4")
        control(page, "optics.f_number").press("Enter")
        until(page, "() => document.body.classList.contains('silent')")
        assert page.inner_text("#status") == "waiting for the server…"
        assert setting(page, "optics.f_number") == 2.8
    until(page, "() => studio.isIdle && studio.state.settings.optics.f_number === 4")
    assert not page.evaluate("document.body.classList.contains('silent')")


@pytest.mark.slow
def test_change_of_a_broken_connection_is_repeated(browser, tmp_path, visit):
    own = Server(tmp_path)
    try:
        page = visit(is_checked=False, address=own.address)
        settle(page)
        session = next(iter(own.studio.sessions.values()))
        session.queue.is_closed = True  # messages are accepted, and not answered
        with session.queue.wake:
            session.queue.wake.notify_all()
        session._thread.join(DEADLINE_S)
        control(page, "optics.f_number").fill("4")
        control(page, "optics.f_number").press("Enter")
        until(page, "() => studio.connection.unanswered.size === 1")
        own.stop()
        until(page, "() => document.body.classList.contains('offline')")
        own.start()
        until(page, "() => studio.isIdle && studio.state.settings.optics.f_number === 4")
        assert control(page, "optics.f_number").input_value() == "4"
    finally:
        own.stop()


def test_long_work_is_cancelled(visit, server, monkeypatch):
    page = visit()
    before = codes(page)
    check = Session.check

    def slow(session, stage):
        wait_until(lambda: session.queue.is_cancelled)
        check(session, stage)

    monkeypatch.setattr(Session, "check", slow)
    session = server.studio.sessions[page.evaluate("sessionStorage.getItem('foveasim-studio-session')")]
    monkeypatch.setattr(session.engine._runner, "check", session.check)
    field_of = control(page, "layout.parameters.n_sectors")
    field_of.fill("64")
    field_of.press("Enter")
    page.wait_for_selector("#cancel:not([hidden])")
    assert "…" in page.inner_text("#status")
    page.click("#cancel")
    until(page, "() => studio.isIdle && document.getElementById('notice').textContent.includes('cancelled')")
    monkeypatch.undo()

    assert setting(page, "layout.parameters.n_sectors") == 48
    assert field_of.input_value() == "48"
    assert not page.is_visible("#cancel")
    assert np.array_equal(codes(page), before)


# -- files -----------------------------------------------------------------------------------------------------------------------


def test_save_asks_before_it_replaces(browser, tmp_path, visit):
    own = Server(tmp_path)
    try:
        page = visit(is_checked=False, address=own.address)
        settle(page)

        def save(name):
            page.click("#file")
            page.click("#save")
            page.fill("#save-name", name)
            page.click("#save-form button[value=save]")

        save("Fovéa 網膜")
        path = tmp_path / "Fovéa_網膜.yaml"
        noticed(page, "Saved")
        first = path.read_text()
        set_value(page, "exposure_s", 0.005)
        save("Fovéa 網膜")
        page.wait_for_selector("#confirm-dialog[open]")
        assert page.inner_text("#confirm-title") == "Fovéa_網膜.yaml exists. Replace it?"
        page.click("#confirm-dialog button[value='']")
        save("Fovéa 網膜")
        page.wait_for_selector("#confirm-dialog[open]")  # a message that replaces the file would have come before
        assert path.read_text() == first
        forget_notice(page)
        page.click("#confirm-verb")
        noticed(page, "Saved")
        assert "exposure_s: 0.005" in path.read_text()
        assert TOKEN not in path.read_text()
    finally:
        own.stop()


# -- controls ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("1/60", "s", 1 / 60),
        ("20 ms", "s", 0.02),
        ("20ms", "s", 0.02),
        ("500 µs", "s", 5e-4),
        ("3*2.2", "", 6.6),
        ("0,02", "s", 0.02),
        ("1,5e-3", "s", 1.5e-3),
        ("14,208", "", 14208.0),
        ("1,000.5", "", 1000.5),
        ("9 fF", "F", 9e-15),
        ("1e-15", "F", 1e-15),
        ("2.2 mm", "µm", 2200.0),
        ("550", "nm", 550.0),
        ("0.55 µm", "nm", 550.0),
        ("1.2 kV", "V", 1200.0),
        ("5 %", "fraction", 0.05),
        ("-(2 + 3) * 4 / 8", "", -2.5),
        ("2×3", "", 6.0),
        ("30°", "degrees", 30.0),
        ("100 e-", "e-", 100.0),
        ("2 s", "µm", None),
        ("1/0", "s", None),
        ("auto", "s", None),
        ("", "s", None),
        ("1 + ", "", None),
        ("alert(1)", "", None),
        ("1 2", "", None),
        ("EV 12", "s", None),
    ],
)
def test_numbers_are_read_as_written(numbers, text, unit, expected):
    found = numbers.evaluate(
        "([text, unit]) => { const v = numberOf(text, unit); return Number.isFinite(v) ? v : null; }", [text, unit]
    )
    assert found == (expected if expected is None else pytest.approx(expected, rel=1e-11))


@pytest.fixture(scope="module")
def numbers(server, browser):
    page = browser.new_page(bypass_csp=True)
    page.goto(server.address)
    page.evaluate("import('/static/numbers.js').then((found) => { window.numberOf = found.numberOf; })")
    until(page, "() => window.numberOf")
    yield page
    page.close()


def test_search_knows_other_words(visit):
    page = visit()
    for words, key in {
        "saccade": "gaze_um",
        "snr": "sensor.read_noise_e",
        "bayer": "layout.mosaic",
        "format": "layout.parameters.r_max_um",
        "aperture": "optics.f_number",
        "shutter": "exposure_s",
        "drc": "layout.rules",
        "quantum": "sensor.qe",
    }.items():
        page.fill("#search", words)
        keys = page.locator(".control:visible").evaluate_all("all => all.map((row) => row.dataset.key)")
        assert key in keys
        assert len(keys) < 30


def test_every_control_has_name_and_help(visit):
    """Names are unique; the help is that of screen readers, and is shown for the focus of the keyboard and for a touch."""
    page = visit(has_touch=True)
    found = page.evaluate(
        """() => [...document.querySelectorAll(".control")].filter((row) => row.querySelector("input, select")).map((row) => {
          const field = row.querySelector(".line > input, .line > select");
          const help = document.getElementById(field.getAttribute("aria-describedby").split(" ")[0]);
          return [row.dataset.id, field.getAttribute("aria-label"), help.textContent];
        })"""
    )
    assert len(found) > 100
    names = [name for _, name, _ in found if name]
    assert sorted({name for name in names if names.count(name) > 1}) == []
    assert [key for key, _, text in found if len(text) < 10 or (not text[0].isupper() and text[0].isalpha())] == []

    page.focus("#search")
    for _ in range(3):
        page.keyboard.press("Tab")
    key = page.evaluate("document.activeElement.closest('.control').dataset.key")
    assert page.inner_text("#hint").endswith(key)
    control(page, "optics.f_number")
    page.locator(".control[data-key='optics.f_number'] label").tap()
    assert "focal length over the diameter" in page.inner_text("#hint")


# -- photosites in charts -----------------------------------------------------------------------------------------------------------


def labels(page, name):
    return page.evaluate("name => studio.views.made[name].chart.curves.map((curve) => curve.label)", name)


def test_charts_compare_pinned_photosites(visit):
    page = visit(width=1920, height=1080)
    page.click("[data-tile='photon_transfer']")
    until(page, "() => ['snr', 'mtf', 'photon_transfer'].every((name) => studio.views.made[name]?.chart.curves.length)")
    typical = {name: labels(page, name) for name in ("snr", "mtf", "photon_transfer")}
    last = page.evaluate("studio.panes.b.sites.n") - 1
    page.evaluate("studio.keep(0)")  # fovea ...
    x, y = page.evaluate("site => studio.toWindow(...studio.panes.b.sites.centre(site))", last)
    page.keyboard.down("Shift")
    page.mouse.click(x, y)  # ... against periphery
    page.keyboard.up("Shift")
    until(page, "() => studio.isIdle && studio.page.kept.length === 2")
    names = ["photosite 0", f"photosite {last:,}"]
    until(page, "() => ['photon_transfer', 'snr'].every((name) => studio.views.made[name].chart.curves.length === 2)")
    until(page, "() => studio.views.made.mtf.chart.curves.length === 3")
    assert labels(page, "snr") == labels(page, "photon_transfer") == names
    assert labels(page, "mtf")[1:] == names
    peaks = page.evaluate("studio.views.made.snr.chart.curves.map((curve) => Math.max(...curve.y))")
    assert peaks[1] > peaks[0] + 3.0  # larger photosites have larger full wells

    set_value(page, "optics.f_number", 4.0)
    assert labels(page, "snr") == names
    page.keyboard.press("Escape")
    until(page, "() => studio.isIdle && studio.views.made.photon_transfer.chart.curves.length > 2")
    until(page, "() => studio.views.made.snr.chart.curves.length > 2 && studio.views.made.mtf.chart.curves.length > 3")
    assert {name: labels(page, name) for name in typical} == typical


@pytest.mark.slow
def test_photosites_are_kept_by_keyboard(visit):
    page = visit(width=1920, height=1080)
    button = page.locator("#compare-site")
    button.focus()
    page.keyboard.press("Enter")
    until(page, "() => studio.isIdle && studio.page.kept.length === 1")
    assert button.get_attribute("aria-pressed") == "true"
    page.keyboard.press("Enter")
    until(page, "() => studio.isIdle && studio.page.kept.length === 0")


@pytest.mark.slow
def test_charts_are_saved_as_files(visit, tmp_path):
    page = visit(width=1920, height=1080)
    for tile in ("snr", "histogram", "mtf"):
        until(page, "tile => studio.views.made[tile] && studio.views.parts.snr", tile)
        settle(page)
        check_files_of_chart(page, tmp_path, tile)


def check_files_of_chart(page, directory, tile):
    found = {}
    for kind in ("csv", "svg", "png"):
        with page.expect_download() as download:
            page.locator(f"#tile-{tile} .chart-file").select_option(value=kind)
        path = directory / download.value.suggested_filename
        download.value.save_as(path)
        found[kind] = path
    assert [path.name for path in found.values()] == [f"{tile}.{kind}" for kind in found]

    head, *rows = csv.reader(found["csv"].read_text().splitlines())
    assert {len(row) for row in (head, *rows)} == {3}
    if tile == "histogram":
        assert sum(float(row[2]) for row in rows) == page.evaluate("studio.panes.b.sites.n")
    else:
        curves = page.evaluate(
            "tile => studio.views.made[tile].chart.curves.map((c) => [c.label, [...c.x], [...c.y]])", tile
        )
        expected = [[label, x, y] for label, xs, ys in curves for x, y in zip(xs, ys, strict=True)]
        assert [[label, float(x), float(y)] for label, x, y in rows] == expected
    root = ET.parse(found["svg"]).getroot()
    texts = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert (
        len(list(root.iter("{http://www.w3.org/2000/svg}path")) or list(root.iter("{http://www.w3.org/2000/svg}rect")))
        > 3
    )
    assert any(head[0 if tile == "histogram" else 1].split(" from")[0].split(" /")[0] in text for text in texts)
    with Image.open(found["png"]) as picture:
        assert picture.size == (1280, 800)
        assert len(picture.convert("RGB").getcolors(10**6)) > 10
