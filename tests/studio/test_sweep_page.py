"""Sweeps on the page: with the mouse, with the keyboard alone, files, and the Pareto front."""

from __future__ import annotations

import csv
import io
import itertools
import threading

import numpy as np
import pytest
import yaml
from reference.accessibility import violations

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import Server, change, choose, has_picture, set_value, setting, settle, until

from foveasim.config import build_shot, put_setting
from foveasim.studio._sweeps.running import Sweeps

pytestmark = pytest.mark.needs("chromium")

IS_DONE = (
    "() => studio.views.made.sweep?.points && document.getElementById('sweep-text').textContent.endsWith(' points.')"
)


def open_sweep(visit, **options):
    page = visit(accept_downloads=True, **options)
    settle(page)
    page.click("[data-tile=sweep]")
    page.wait_for_selector("#tile-sweep select[aria-label=Result] option[value=snr]", state="attached")
    until(page, "() => studio.isIdle")
    return page


def group(page, legend):
    return page.locator("#tile-sweep fieldset").filter(has=page.locator(f"legend:text-is('{legend}')"))


def choose_axis(page, legend, key, *, low=None, high=None, n=None):
    form = group(page, legend)
    form.locator("select[aria-label=Setting]").select_option(value=key)
    for label, value in (("From", low), ("To", high)):
        if value is not None:
            form.locator(f"input[aria-label^={label}]").fill(str(value))
            form.locator(f"input[aria-label^={label}]").press("Tab")
    if n is not None:
        form.locator("input[aria-label='Number of values']").fill(str(n))


def run(page):
    change(
        page, "() => [...document.querySelectorAll('#tile-sweep button')].find((b) => b.textContent === 'Run').click()"
    )
    until(page, IS_DONE)


def values(page):
    return np.array(page.evaluate("studio.views.made.sweep.points.values"), dtype=float)


def test_map_point_is_applied_by_a_click(visit):
    page = open_sweep(visit)
    choose_axis(page, "Setting", "exposure_s", low="1 ms", high="1/10", n=3)
    choose_axis(page, "Second setting", "optics.f_number", low=2, high=4, n=2)
    group(page, "Result").locator("select[aria-label=Result]").select_option(value="mean_code_dn")
    run(page)
    settings = page.evaluate("studio.state.settings")
    expected = []
    for exposure_s in (0.001, 0.01, 0.1):
        for f_number in (2, 4):
            put_setting(None, settings, "exposure_s", exposure_s)
            put_setting(None, settings, "optics.f_number", f_number)
            shot = build_shot(None, settings)
            expected.append(shot.camera.capture(shot.scene, exposure_s=exposure_s, seed=shot.seed).code.mean())
    np.testing.assert_array_equal(values(page)[:, 0], expected)
    assert setting(page, "exposure_s") == 0.02
    assert has_picture(page, "#sweep canvas")

    # The upper right cell: the longest exposure, and the largest f-number.
    box = page.locator("#sweep canvas").bounding_box()
    page.mouse.move(box["x"] + box["width"] - 80, box["y"] + 40)
    assert page.inner_text("#sweep .chart-note").startswith("exposure 100 ms, f-number 4: mean code ")
    page.mouse.click(box["x"] + box["width"] - 80, box["y"] + 40)
    until(page, "() => studio.isIdle && studio.state.settings.exposure_s === 0.1")
    assert setting(page, "optics.f_number") == 4
    change(page, "() => document.getElementById('undo').click()")
    assert (setting(page, "exposure_s"), setting(page, "optics.f_number")) == (0.02, 2.8)
    assert page.is_disabled("#undo")


def test_saturated_points_are_marked(visit):
    page = open_sweep(visit)
    choose_axis(page, "Setting", "exposure_s", low="1 ms", high="0.5 s", n=3)
    group(page, "Result").locator("select[aria-label=Result]").select_option(value="snr")
    run(page)
    saturated = page.evaluate("studio.views.made.sweep.points.saturated")

    assert saturated[0] == 0.0 < saturated[-1]
    assert page.inner_text("#sweep .chart-note").startswith("Rings: some photosites are saturated.")
    assert f", {100 * saturated[-1]:.2g} % saturated" in page.evaluate("studio.views.made.sweep.points.text(2)")
    page.select_option("#tile-sweep select[aria-label=Chart]", "table")
    assert page.locator("#tile-sweep th").last.inner_text() == "saturated / %"
    assert float(page.locator("#tile-sweep tbody tr").last.locator("td").last.inner_text()) == pytest.approx(
        100 * saturated[-1], rel=1e-3
    )


def test_curves_and_their_files(visit):
    page = open_sweep(visit)
    choose_axis(page, "Setting", "layout.parameters.n_sectors", low=24, high=48, n=3)
    group(page, "Result").locator("select[aria-label=Result]").select_option(value="n_sites")
    run(page)
    counts = values(page)[:, 0]
    assert (np.diff(counts) > 0).all()
    for kind in ("csv", "svg", "png"):
        with page.expect_download() as caught:
            page.locator("#tile-sweep .chart-file").select_option(value=kind)
        content = caught.value.path().read_bytes()
        assert content.startswith({"csv": b"sectors", "svg": b"<svg", "png": b"\x89PNG"}[kind]), content[:40]
        if kind == "csv":
            rows = list(csv.reader(io.StringIO(content.decode())))
            assert [row[1] for row in rows[1:]] == [str(int(count)) for count in counts]
    box = page.locator("#sweep canvas").bounding_box()
    page.mouse.click(box["x"] + 50, box["y"] + box["height"] - 60)
    until(page, "() => studio.isIdle && studio.state.settings.layout.parameters.n_sectors === 24")
    assert page.evaluate("studio.state.summary.n_sites") == counts[0]


def test_pareto_chart_and_the_file(visit):
    page = open_sweep(visit)
    choose_axis(page, "Setting", "exposure_s", low=0.001, high=1, n=7)
    group(page, "Result").locator("select[aria-label=Result]").select_option(value="snr")
    group(page, "Second result").locator("select[aria-label=Result]").select_option(value="saturated_fraction")
    assert group(page, "Second result").locator("select[aria-label=Direction]").input_value() == "smaller"
    run(page)
    page.locator("#tile-sweep select[aria-label=Chart]").select_option(label="Pareto chart")
    found = values(page)
    dominated = [
        any(a[0] >= b[0] and a[1] <= b[1] and (a != b).any() for a in found) for b in found
    ]  # by its definition  # fmt: skip
    with page.expect_download() as caught:
        page.locator("#tile-sweep .chart-file").select_option(value="csv")
    rows = list(csv.reader(io.StringIO(caught.value.path().read_text())))
    assert [row[-1] for row in rows[1:]] == ["no" if each else "yes" for each in dominated]
    with page.expect_download() as caught:
        page.click("#tile-sweep button:text-is('Sweep file')")
    assert caught.value.suggested_filename.endswith("_sweep.yaml")
    file = yaml.safe_load(caught.value.path().read_text())
    assert list(file["results"]) == ["result_snr", "result_saturated_fraction"]
    assert file["vary"]["exposure_s"][0::6] == [0.001, 1.0]
    assert file["seed"] == "shot"


FRONTS = [
    ([[1, 1], [2, 2], [3, 0]], [False, False], [2, 1]),
    ([[1, 1], [2, 2], [3, 0]], [True, True], [0, 2]),
    ([[1, 5], [1, 5], [1, 4]], [False, False], [0, 1]),
    ([[5, 1], [4, 1], [None, 9]], [False, False], [0]),
    ([[1, 3], [2, 1]], [False, True], [1]),
]


def test_pareto_front_follows_its_definition(visit):
    page = visit()
    for points, is_smaller, expected in FRONTS:
        found = page.evaluate(
            "async ([points, isSmaller]) => (await import('/static/sweep_points.js')).paretoFront(points.map((p) => p.map((v) => v ?? NaN)), isSmaller)",
            [points, is_smaller],
        )  # fmt: skip
        assert found == expected


def press_until(page, condition, key="Tab", most=60):
    for _ in range(most):
        if page.evaluate(condition):
            return
        page.keyboard.press(key)
    raise AssertionError(condition)


def focus(what):
    return f"() => document.activeElement.closest('#tile-sweep') && ({what})(document.activeElement)"


def test_sweep_with_the_keyboard_alone(visit):
    page = visit()
    page.evaluate("() => { localStorage.clear(); document.querySelector('[data-tile=goal]').focus(); }")
    press_until(page, "() => document.activeElement.dataset.tile === 'sweep'")
    page.keyboard.press("Enter")
    page.wait_for_selector("#tile-sweep select[aria-label=Result] option[value=snr]", state="attached")
    until(page, "() => studio.isIdle")
    press_until(page, focus("(e) => e.ariaLabel === 'Number of values'"))
    page.keyboard.press("Control+A")
    page.keyboard.type("3")
    press_until(page, focus("(e) => e.ariaLabel === 'Result'"))
    choose(page, "mean")
    page.keyboard.press("Enter")
    press_until(page, focus("(e) => e.textContent === 'Run'"))
    page.keyboard.press("Enter")
    until(page, IS_DONE)
    press_until(page, focus("(e) => e.ariaLabel === 'Chart'"))
    choose(page, "Table")
    page.keyboard.press("Enter")
    press_until(page, focus("(e) => e.textContent === 'Apply'"))
    assert page.evaluate("document.activeElement.ariaLabel") == "Apply exposure 10 µs"
    page.keyboard.press("Enter")
    until(page, "() => studio.isIdle && studio.state.settings.exposure_s === 1e-5")
    assert page.evaluate("document.activeElement.textContent") == "Apply"
    page.keyboard.press("Control+z")
    until(page, "() => studio.isIdle && studio.state.settings.exposure_s === 0.02")


@pytest.fixture
def permit_points(monkeypatch):
    """Sweeps compute only as many points as the test permits."""
    compute_next, permitted = Sweeps.compute_next, threading.Semaphore(0)

    def compute(sweeps, simulate):
        if permitted.acquire(timeout=0.01):
            compute_next(sweeps, simulate)
            sweeps.send()

    monkeypatch.setattr(Sweeps, "compute_next", compute)
    return permitted.release


def test_page_is_usable_during_a_sweep(visit, permit_points):
    """A change is applied between two points, cancelling leaves those that are computed, and a new sweep replaces it."""
    page = open_sweep(visit)
    choose_axis(page, "Setting", "layout.parameters.n_sectors", low=24, high=200, n=60)
    choose_axis(page, "Second setting", "optics.f_number", low=2, high=8, n=16)
    page.click("#tile-sweep button:text-is('Run')")
    permit_points(4)
    until(page, "() => studio.views.made.sweep.points?.values.length > 1")
    assert "do not affect this sweep" in page.inner_text("#sweep-text")
    set_value(page, "exposure_s", 0.03)
    page.click("[data-tile=sweep]")
    n_done = page.evaluate("studio.page.sweep.points.length")
    permit_points(4)
    until(page, "n => studio.page.sweep.points.length > n", n_done)
    assert page.is_hidden("#tile-sweep")  # further points do not open it again
    page.click("[data-tile=sweep]")
    page.click("#tile-sweep button[aria-label='Cancel the sweep']")
    until(page, "() => document.getElementById('sweep-text').textContent.startsWith('Cancelled after ')")
    n_done = page.evaluate("studio.views.made.sweep.points.values.length")
    assert 1 < n_done < 960
    assert setting(page, "exposure_s") == 0.03
    choose_axis(page, "Second setting", "")
    choose_axis(page, "Setting", "optics.f_number", n=2)
    permit_points(1000)
    run(page)
    assert len(values(page)) == 2


def test_restarted_server_ends_the_sweep(visit, tmp_path, permit_points):
    """Results so far remain; the new session has no sweep to cancel, and no file of it."""
    own = Server(tmp_path)
    try:
        page = open_sweep(visit, is_checked=False, address=own.address)
        choose_axis(page, "Setting", "layout.parameters.n_sectors", low=24, high=200, n=60)
        page.click("#tile-sweep button:text-is('Run')")
        permit_points(4)
        until(page, "() => studio.views.made.sweep.points?.values.length > 1")
        own.stop()
        until(page, "() => document.body.classList.contains('offline')")
        n_done = page.evaluate("studio.page.sweep.points.length")
        own.start()
        until(page, "() => studio.isIdle && !document.body.classList.contains('offline')")

        assert page.inner_text("#sweep-text") == f"The session ended after {n_done} of 60 points."
        assert page.is_hidden("#tile-sweep button[aria-label='Cancel the sweep']")
        assert page.is_hidden("#tile-sweep button:text-is('Sweep file')")
        assert page.evaluate("studio.views.made.sweep.points.values.length") == n_done
        choose_axis(page, "Setting", "optics.f_number", n=2)
        permit_points(1000)
        run(page)
        assert page.is_visible("#tile-sweep button:text-is('Sweep file')")
        own.stop()
        until(page, "() => document.body.classList.contains('offline')")
        own.start()
        until(page, "() => studio.isIdle && !document.body.classList.contains('offline')")
        assert page.inner_text("#sweep-text") == "2 points."
        assert page.is_hidden("#tile-sweep button:text-is('Sweep file')")
    finally:
        own.stop()


def test_wrong_input_is_explained(visit):
    page = open_sweep(visit)
    choose_axis(page, "Setting", "exposure_s", n=2000)
    page.click("#tile-sweep button:text-is('Run')")
    until(page, "() => document.getElementById('sweep-text').textContent.includes('at most 1,000 points, got 2,000')")
    choose_axis(page, "Setting", "exposure_s", low="short", n=3)
    page.click("#tile-sweep button:text-is('Run')")
    assert "Enter the first value as a number" in page.inner_text("#notice")


def test_missing_points_have_a_reason(visit):
    page = open_sweep(visit)
    choose_axis(page, "Setting", "layout.parameters.min_size_um", low=8, high=2000, n=3)
    group(page, "Result").locator("select[aria-label=Result]").select_option(value="n_sites")
    page.click("#tile-sweep button:text-is('Run')")
    until(page, "() => document.getElementById('sweep-text').textContent.includes(' without a result: ')")
    page.locator("#tile-sweep select[aria-label=Chart]").select_option(label="Table")
    assert "–" in page.inner_text("#tile-sweep tbody")


@pytest.mark.nightly
def test_sweep_fits_and_is_accessible(visit):
    page = open_sweep(visit, width=1920, height=1080)
    choose_axis(page, "Setting", "exposure_s", n=3)
    choose_axis(page, "Second setting", "optics.f_number", n=3)
    group(page, "Second result").locator("select[aria-label=Result]").select_option(value="mtf")
    group(page, "Second result").locator("input[aria-label^=Spatial]").fill("20")
    run(page)
    charts = page.locator("#tile-sweep select[aria-label=Chart]")
    for (width, height, scheme), what in itertools.product(
        ((390, 844, "light"), (1280, 800, "dark"), (1920, 1080, "light")),
        charts.locator("option").evaluate_all("all => all.map((o) => o.value)"),
    ):
        charts.select_option(value=what)
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=scheme)
        settle(page)
        boxes = page.evaluate(
            "() => [document.documentElement, ...document.querySelectorAll('#tile-sweep, .sweep-form, .sweep-results')]"
            ".map((e) => e.scrollWidth - e.clientWidth)"
        )
        assert max(boxes) <= 0, (what, width, boxes)
        assert violations(page, "#tile-sweep") == [], (what, width, scheme)
