"""The tasks of a designer by keys alone: from Tab to Tab, without a mouse."""

from __future__ import annotations

import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import Keys, Server, codes, noticed, setting, until
from studio.test_sources_page import video

import foveasim as fs

pytestmark = pytest.mark.needs("chromium")


@pytest.fixture
def keys(visit):
    found = Keys(visit(accept_downloads=True))
    yield found
    assert found.n_pointed == 0


def requirement(keys, tile, *, measure, value, limit, annulus=None, frequency=None):
    form = f"#tile-{tile} .condition"
    keys.choose(f"{form} select[aria-label=Result]", measure)
    if annulus:
        keys.choose(f"{form} select[aria-label=Photosites]", "annulus")
        keys.type_in(f"{form} input[aria-label='Inner radius, µm']", str(annulus[0]))
        keys.type_in(f"{form} input[aria-label='Outer radius, µm']", str(annulus[1]))
    if frequency:
        keys.type_in(f"{form} input[aria-label='Spatial frequency, per mm']", str(frequency))
    keys.choose(f"{form} select[aria-label=Condition]", limit)
    keys.enter(f"{form} input[aria-label=Value]", str(value))


def test_photograph_is_captured(keys):
    page = keys.page
    keys.show("histogram")
    keys.open_file(Path(str(files("skimage.data") / "coffee.png")))
    until(page, "() => studio.state.settings.scene.picture.endsWith('coffee.png')")
    keys.wait()
    keys.press("Escape", "/")
    page.keyboard.type("aperture")
    keys.set("optics.f_number", "4")
    keys.to("#search")
    keys.press("Control+a", "Delete")
    keys.set("exposure_s", "20 ms")
    gaze_um = setting(page, "gaze_um")
    keys.to("#scene .marks")
    keys.press("ArrowRight", "ArrowRight", "ArrowUp")
    keys.wait()

    assert setting(page, "optics.f_number") == 4
    # Each key counts, also before the answer to the one before.
    moved = np.subtract(setting(page, "gaze_um"), gaze_um)
    assert moved[0] == pytest.approx(2 * moved[1], rel=0.01)
    assert np.ptp(codes(page)) > 50


@pytest.mark.nightly
def test_square_sensor_has_same_budget(keys):
    page = keys.page
    keys.use("#freeze")
    keys.show("comparison")
    keys.choose(".control[data-key='layout'] select", "grid")
    keys.set("layout.parameters.n_x", "40")
    keys.set("layout.parameters.n_y", "40")
    keys.choose("#match-what", "same number")
    keys.use("#match")
    until(page, "() => studio.panes.b.sites.n < 1300")
    keys.wait()
    rows = page.evaluate(
        "() => Object.fromEntries(studio.views.parts.comparison.about.rows.map((row) => [row.name, row.values]))"
    )

    assert rows["n_sites"][1] == pytest.approx(rows["n_sites"][0], rel=0.03)


@pytest.mark.nightly
def test_chip_is_drawn_and_repaired(keys, tmp_path):
    page = keys.page
    keys.choose(".control[data-key='layout'] select", "grid")
    for name, value in (("n_x", "40"), ("n_y", "40"), ("pitch_um", "10")):
        keys.set(f"layout.parameters.{name}", value)
    keys.set("layout.rules.min_size_um", "2.5")
    keys.set("layout.rules.min_width_um", "2")
    keys.show("rules", "steps")
    keys.use("#fit")
    keys.use("#edit")
    keys.use("[data-tool=layer]")
    keys.choose(".tool-options select[aria-label=Generator]", "log polar")
    keys.enter(".tool-options input[aria-label='Margin in µm']", "0.5")
    keys.to("#map .marks")
    keys.press("Enter")  # the centre of the view
    until(page, "() => studio.state.settings.layout.edits?.length === 1")
    keys.wait()
    for name, value in (("r max", "90"), ("n sectors", "64"), ("min size", "1.5")):
        keys.enter(f"label={name}", value)
    keys.use("[data-tool=polygon]")
    for text in ("-150, 150", "-100, 160", "-100, 100", "-145, 95"):
        keys.enter("input[aria-label^='Position in µm']", text)
    keys.press("Enter")
    until(page, "() => studio.state.settings.layout.edits.length === 2")
    keys.use("[data-tool=repair]")
    until(page, "() => document.querySelector('.repairs li[data-method=best]:not(.pending)')")
    keys.use(".repairs li[data-method=best] button")
    until(page, "() => studio.state.settings.layout.edits.length === 3")
    keys.wait()
    path = keys.download("[data-file=gds]", tmp_path / "sensor.gds")

    assert [step["kind"] for step in setting(page, "layout.edits")] == ["overlay", "draw", "repair"]
    layout = fs.read_layout(path)
    assert layout.n_sites == page.evaluate("studio.panes.b.sites.n")
    assert layout.check(fs.DesignRules(min_size_um=2.499)).ok


@pytest.mark.nightly
def test_lecture_is_downloaded(keys, tmp_path):
    page = keys.page
    keys.show("solid", "mtf", "photon_transfer", "snr")
    keys.use("#freeze")
    keys.set("optics.f_number", "11")
    path = keys.download("[data-file=zip]", tmp_path / "lecture.zip")
    with zipfile.ZipFile(path) as archive:
        extensions = {Path(name).suffix for name in archive.namelist()}

    assert {".yaml", ".py", ".ipynb", ".gds"} <= extensions
    assert page.is_visible("#tile-solid canvas")


@pytest.mark.nightly
def test_sensor_with_requirements(visit, tmp_path):
    own = Server(tmp_path)
    try:
        keys = Keys(visit(is_checked=False, address=own.address))
        page = keys.page
        until(page, "() => window.studio && studio.isIdle && studio.views.parts.picture")
        keys.show("requirements")
        page.wait_for_selector("#tile-requirements select[aria-label=Result] option[value=mtf]", state="attached")
        requirement(keys, "requirements", measure="photosites", value="19,800", limit="at least")
        requirement(keys, "requirements", measure="MTF", value=0.3, limit="at least", annulus=(0, 400), frequency=50)
        requirement(keys, "requirements", measure="violations", value=0, limit="at most")
        keys.set("layout.parameters.r_max_um", "1.8 mm")
        keys.set("layout.parameters.n_sites", "20000")
        until(page, "() => document.querySelectorAll('#requirements li').length === 3")
        until(page, "() => document.querySelectorAll('#requirements li.wrong').length === 0")
        keys.use("#fit-scene")
        until(page, "() => document.getElementById('fit-scene').hidden")
        keys.menu("[data-do=save]")
        keys.press("Enter")
        page.keyboard.type("third")
        keys.press("Enter")
        noticed(page, "Saved")
        assert keys.n_pointed == 0
    finally:
        own.stop()
    assert (tmp_path / "third.yaml").exists()


def test_exposure_for_a_ratio_is_found(keys):
    page = keys.page
    keys.show("goal")
    page.wait_for_selector("#tile-goal select[aria-label=Result] option[value=snr]", state="attached")
    keys.choose("#tile-goal select[aria-label='Setting to change']", "exposure")
    requirement(keys, "goal", measure="signal-to-noise", value=10, limit="equals", annulus=(500, 690))
    until(page, "() => document.querySelector('#goal canvas')")

    assert "signal-to-noise ratio from 500 to 690 µm 10" in page.inner_text("#goal-text")
    keys.use("#undo")
    assert setting(page, "exposure_s") == 0.02


@pytest.mark.nightly
def test_hexagons_against_squares(keys):
    page = keys.page
    keys.show("variants")
    page.wait_for_selector("#keep-variant input")
    for n, (generator, counts) in enumerate(
        {"grid": ("n_x", "n_y"), "hexagonal": ("n_columns", "n_rows")}.items(), start=1
    ):
        keys.choose(".control[data-key='layout'] select", generator)
        for name in counts:
            keys.set(f"layout.parameters.{name}", "30")
        keys.enter("#keep-variant input", generator)
        until(page, "n => studio.state.variants.length === n", n)
    for name in ("grid", "hexagonal"):
        keys.to(f"input[aria-label='Compare {name}']")
        keys.press("Space")
        until(page, "name => studio.state.variants.find((each) => each.name === name).is_compared", name)
        keys.wait()
    until(page, "() => document.querySelectorAll('#comparison th[scope=col]').length === 4")
    keys.use("button[aria-label='Apply grid']")
    until(page, "() => studio.panes.b.sites.n === 900")

    assert page.locator("#comparison th[scope=col]").all_inner_texts() == ["grid", "hexagonal", "B", "B − grid"]


def test_gaze_is_recorded_over_video(keys, tmp_path):
    page = keys.page
    (tmp_path / "clip.mp4").write_bytes(video(tmp_path))
    keys.open_file(tmp_path / "clip.mp4")
    until(page, "() => studio.state.film && !document.getElementById('film').hidden")
    keys.wait()
    keys.use("#gaze-path")
    keys.use("#gaze .record")
    for n in (2, 5):
        keys.to("#transport input[type=range]")
        keys.press(*["ArrowRight"] * (n - page.evaluate("studio.state.film.n")))
        until(page, "n => studio.state.film.n === n && !studio.sources.film.isBusy", n)
        keys.to("#scene .marks")
        keys.press("ArrowRight", "ArrowUp")
        until(page, "n => studio.gazePanel.recording?.found.has(n)", n)
        keys.wait()
    keys.use("#gaze .record")
    until(page, "() => studio.state.settings.gaze_path")
    rows = setting(page, "gaze_path")
    keys.use("#transport [aria-label='Play the gaze path']")
    until(page, "() => !studio.gazePanel.film.isPlaying && studio.state.film.n === 11")
    keys.wait()

    assert [row[0] for row in rows if row[0] > 0] == pytest.approx([0.2, 0.5])
    assert setting(page, "gaze_um") == pytest.approx(rows[-1][1:])
