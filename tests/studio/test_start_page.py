"""The start page in Chromium: by mouse and by keyboard, at all widths, in both themes."""

from __future__ import annotations

import pytest
import yaml

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from reference.accessibility import violations_in_themes
from studio.page_tools import SHOT, Server, choose, setting, settle, until

import foveasim as fs
from foveasim.config import bundled_layouts, demo_settings
from foveasim.layout import OPTICAL_FORMATS

pytestmark = pytest.mark.needs("chromium")

OPEN = "document.getElementById('start').open"
HAS_CARDS = f"() => {OPEN} && document.querySelectorAll('#start .card').length > 0"
N_SITES = "studio.panes.b.sites.n"
STEPS = "() => studio.isIdle && studio.state.can_undo"


@pytest.fixture(scope="module")
def start_server(tmp_path_factory):
    """A server whose new pages begin with the start page, and with a saved file."""
    out = tmp_path_factory.mktemp("start") / "kept"
    out.mkdir()
    (out / "saved.yaml").write_text(yaml.safe_dump({**SHOT, "exposure_s": 0.004}))
    running = Server(out)
    running.start_of.shows_start_page = True
    yield running
    running.stop()


@pytest.fixture
def open_start(visit, start_server):
    def open_page(**options):
        page = visit(address=start_server.address, **options)
        until(page, HAS_CARDS)
        return page

    return open_page


def test_start_page_is_shown_first(open_start):
    page = open_start()
    names = page.evaluate("[...document.querySelectorAll('#start .card')].map((card) => card.dataset.preset)")

    assert names == [f"shot:{path.stem}" for path in demo_settings()] + [f"layout:{name}" for name in bundled_layouts()]
    assert page.evaluate("document.activeElement.id") == "start-title"
    # The table below shows the initial shot.
    settle(page)
    assert page.evaluate("studio.state.can_undo") is False
    page.reload()
    settle(page)
    assert page.evaluate(OPEN) is False


def test_skipping_can_be_remembered(open_start, start_server):
    page = open_start()
    page.check("#start-never")
    page.keyboard.press("Escape")
    settle(page)
    second = page.context.new_page()
    second.goto(start_server.address)
    settle(second)

    assert second.evaluate(OPEN) is False
    second.click("#start-open")
    until(second, HAS_CARDS)
    assert second.is_checked("#start-never")
    second.uncheck("#start-never")
    second.close()
    third = page.context.new_page()
    third.goto(start_server.address)
    until(third, HAS_CARDS)


def test_files_and_links_skip_start_page(visit, open_start, start_server):
    assert visit().evaluate(OPEN) is False

    page = open_start()
    page.click("#start-skip")
    settle(page)
    link = page.evaluate(
        "async () => { const { fragmentOf } = await import('/static/links.js');"
        " return fragmentOf(JSON.stringify({ ...studio.state.settings, seed: 7 }), studio.connection.token); }"
    )
    linked = visit(address=f"{start_server.address.partition('#')[0]}#{link}")
    settle(linked)
    until(linked, "() => studio.state.settings.seed === 7")
    assert linked.evaluate(OPEN) is False


def test_presets_are_chosen_by_mouse(open_start):
    page = open_start()
    settle(page)
    before = page.evaluate(N_SITES)
    page.click("[data-preset='layout:prima_100']")
    until(page, STEPS)

    assert page.evaluate(OPEN) is False
    assert page.evaluate(N_SITES) == fs.read_layout("prima_100").n_sites
    page.click("#undo")
    until(page, f"before => studio.isIdle && {N_SITES} === before", before)


def test_new_sensor_is_created_by_mouse(open_start):
    page = open_start()
    settle(page)
    before = page.evaluate(N_SITES)
    page.select_option("#start-generator", "grid")
    page.select_option("#start-format", "2/3")
    page.select_option("#start-filters", "")
    page.select_option("#start-electronics", "scientific")
    page.fill("#start-sites", "3,000")
    assert "Fills the format" in page.inner_text("#start-generator-hint")
    assert "Andor" in page.inner_text("#start-electronics-hint")
    page.click("#start-form button")
    until(page, STEPS)

    n_sites = page.evaluate(N_SITES)
    assert n_sites == pytest.approx(3000, rel=0.03)
    assert setting(page, "layout.parameters.size_um") == list(OPTICAL_FORMATS["2/3"].size_um)
    assert setting(page, "sensor.bits") == 16
    assert setting(page, "sensor.filters") is None
    if n_sites != 3000:
        assert page.inner_text("#notice") == f"{n_sites:,} photosites, the nearest possible number to 3,000"
    page.click("#undo")
    until(page, f"before => studio.isIdle && {N_SITES} === before && !studio.state.can_undo", before)


def test_new_sensor_is_created_by_keyboard(open_start):
    page = open_start()
    page.keyboard.press("Escape")
    settle(page)
    page.keyboard.press("h")
    until(page, HAS_CARDS)
    # Skip, 16 presets, generator, format.
    for _ in range(1 + len(demo_settings()) + len(bundled_layouts()) + 1):
        page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "start-generator"
    choose(page, "hexagonal")
    page.keyboard.press("Tab")
    choose(page, "own")
    page.keyboard.press("Tab")
    page.keyboard.type("0,9")
    page.keyboard.press("Tab")
    page.keyboard.type("0.6")
    page.keyboard.press("Tab")
    page.keyboard.type("1200")
    page.keyboard.press("Enter")
    until(page, STEPS)

    assert setting(page, "layout.generator") == "hexagonal"
    assert setting(page, "layout.parameters.size_um") == [900, 600]
    assert page.evaluate(N_SITES) == pytest.approx(1200, rel=0.05)


def test_new_sensor_follows_from_requirements(open_start):
    page = open_start()
    settle(page)
    page.select_option("#start-generator", "grid")
    page.select_option("#start-format", "own")
    page.fill("#start-width", "2")
    page.fill("#start-height", "1")
    page.fill("#start-smallest", "50 µm")
    page.fill("#start-sites", "5,000")
    page.click("#start-form button")
    until(
        page,
        f"() => {OPEN} && document.getElementById('start-problem').textContent.includes('possible are 800 of 50 µm')",
    )
    page.fill("#start-sites", "")
    page.click("#start-form button")
    until(page, STEPS)

    assert page.evaluate(N_SITES) == 800
    assert page.inner_text("#notice") == "800 photosites, the smallest of 50 µm"


def test_invalid_sensors_are_explained(open_start):
    page = open_start()
    page.fill("#start-sites", "many")
    page.click("#start-form button")
    assert page.inner_text("#start-problem") == "Photosites must be an integer from 1 to 2,000,000."

    page.fill("#start-sites", "2000")
    page.fill("#start-smallest", "tiny")
    page.click("#start-form button")
    assert page.inner_text("#start-problem") == "Smallest site must be a positive number."
    page.fill("#start-smallest", "")

    page.select_option("#start-format", "own")
    page.fill("#start-width", "0")
    page.click("#start-form button")
    assert page.inner_text("#start-problem") == "Width and height must be positive numbers."

    # The server rejects it: the page returns with the reason.
    page.select_option("#start-format", "1/3")
    page.select_option("#start-generator", "zones")
    page.fill("#start-sites", "2")
    page.click("#start-form button")
    until(page, f"() => {OPEN} && document.getElementById('start-problem').textContent.includes('the nearest is')")
    assert page.evaluate("studio.state.can_undo") is False


def test_recent_files_are_opened(open_start):
    page = open_start()
    assert page.locator("#start-recent button").count() == 1
    page.click("#start-recent button")
    until(page, STEPS)

    assert setting(page, "exposure_s") == 0.004
    page.click("#undo")
    until(page, "() => studio.isIdle && studio.state.settings.exposure_s === 0.02")


def test_thumbnails_load_when_they_are_visible(visit, start_server):
    requested = []
    page = visit(width=390, height=700, address="about:blank")
    page.on("request", lambda request: requested.append(request.url) if "/presets/" in request.url else None)
    page.add_init_script("localStorage.setItem('foveasim-studio-start', 'never')")
    page.goto(start_server.address)
    settle(page)
    assert requested == []
    page.keyboard.press("h")
    until(page, "() => document.querySelector('#start .card img')?.naturalWidth > 0")

    assert 0 < len(requested) < len(demo_settings()) + len(bundled_layouts())


def test_start_page_has_no_serious_violations(open_start):
    page = open_start(width=1920)
    page.select_option("#start-format", "own")
    page.fill("#start-width", "wide")
    page.click("#start-form button")
    for width in (1920, 1280, 390):
        page.set_viewport_size({"width": width, "height": 800})
        settle(page)

        assert violations_in_themes(page, "html" if width == 1920 else "#start") == [], width
        assert page.evaluate("document.getElementById('start').scrollWidth") <= width
