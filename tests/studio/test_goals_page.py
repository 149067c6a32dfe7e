"""Requirements and goal seek on the page: the exposure for a ratio in the periphery, and a sensor with requirements."""

from __future__ import annotations

import pytest
import yaml
from typer.testing import CliRunner

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import Server, change, noticed, setting, settle, until
from studio.test_daily_page import field

from foveasim.cli import app
from foveasim.config import build_shot
from foveasim.explore import check_requirements

pytestmark = pytest.mark.needs("chromium")


def fill(page, tile, *, measure, value, limit="at least", region=None, annulus=None, frequency=None):
    form = page.locator(f"#tile-{tile} .condition")
    form.locator("select[aria-label=Result]").select_option(value=measure)
    if region:
        form.locator("select[aria-label=Photosites]").select_option(label=region)
    if annulus:
        form.locator("input[aria-label='Inner radius, µm']").fill(str(annulus[0]))
        form.locator("input[aria-label='Outer radius, µm']").fill(str(annulus[1]))
    if frequency:
        form.locator("input[aria-label='Spatial frequency, per mm']").fill(str(frequency))
    form.locator("select[aria-label=Condition]").select_option(label=limit)
    form.locator("input[aria-label=Value]").fill(str(value))
    form.locator("input[aria-label=Value]").press("Enter")
    settle(page)


def test_exposure_for_a_ratio_in_the_periphery(visit):
    page = visit()
    page.click("[data-tile=goal]")
    page.wait_for_selector("#tile-goal select[aria-label=Result] option[value=snr]", state="attached")
    page.locator("#tile-goal select[aria-label='Setting to change']").select_option(value="exposure_s")
    fill(page, "goal", measure="snr", value=10, limit="equals", region="annulus around the centre", annulus=(500, 690))
    until(page, "() => document.querySelector('#goal canvas')")

    assert "signal-to-noise ratio from 500 to 690 µm 10" in page.inner_text("#goal-text")
    *_, at_least, at_most = page.locator("#goal .chart-legend li").all_inner_texts()
    assert (at_least, at_most) == ("at least", "at most")  # the limits, which are not those of variant A
    shot = build_shot(None, page.evaluate("studio.state.settings"))
    capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)
    limits = [{"measure": "snr", "at_least": 9.98, "at_most": 10.02, "annulus_um": [500.0, 690.0]}]
    wanted = build_shot(None, {**page.evaluate("studio.state.settings"), "requirements": limits})
    assert check_requirements(wanted, capture)[0].is_met
    change(page, "() => document.getElementById('undo').click()")
    assert setting(page, "exposure_s") == 0.02
    assert page.is_disabled("#undo")


def test_sensor_with_requirements(browser, tmp_path, visit):
    """A foveal Bayer sensor of the height of 1/3 inch, 3.6 mm, with 20,000 photosites; saved, and checked by the command."""
    own = Server(tmp_path)
    try:
        page = visit(is_checked=False, address=own.address)
        settle(page)
        page.click("[data-tile=requirements]")
        page.wait_for_selector("#tile-requirements select[aria-label=Result] option[value=mtf]", state="attached")
        fill(page, "requirements", measure="n_sites", value="20,200", limit="at most")
        fill(page, "requirements", measure="n_sites", value="19,800")
        fill(
            page,
            "requirements",
            measure="mtf",
            value=0.3,
            frequency=50,
            region="annulus around the centre",
            annulus=(0, 400),
        )
        fill(page, "requirements", measure="violations", value=0, limit="at most")
        until(page, "() => document.querySelector('#tabs [data-tile=requirements] .count')?.textContent === '2'")
        assert "NOT" not in page.inner_text("#requirements")
        assert page.locator("#requirements li.wrong").count() == 2

        field(page, "layout.parameters.r_max_um", "1.8 mm")
        field(page, "layout.parameters.n_sites", "20000")
        until(page, "() => document.querySelectorAll('#requirements li').length === 4")
        until(page, "() => document.querySelectorAll('#requirements li.wrong').length === 0")
        assert setting(page, "layout.mosaic") == ["RG", "GB"]
        assert page.evaluate("studio.state.summary.height_um") == pytest.approx(3600.0, rel=0.1)
        change(page, "() => document.getElementById('fit-scene').click()")
        until(page, "() => document.getElementById('fit-scene').hidden")
        page.click("#file")
        page.click("#save")
        page.fill("#save-name", "third")
        page.click("#save-form button[value=save]")
        noticed(page, "Saved")
    finally:
        own.stop()
    saved = yaml.safe_load((tmp_path / "third.yaml").read_text())
    assert [each["measure"] for each in saved["requirements"]] == ["n_sites", "n_sites", "mtf", "violations"]
    command = ["run", str(tmp_path / "third.yaml"), "--require", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert CliRunner().invoke(app, [*command, "--set", "layout.parameters.n_sites=10000"]).exit_code == 1


def test_wrong_input_is_explained(visit):
    page = visit()
    page.click("[data-tile=requirements]")
    page.wait_for_selector("#tile-requirements select[aria-label=Result] option[value=snr]", state="attached")
    form = page.locator("#tile-requirements .condition")
    form.locator("button").click()
    assert "Enter the value as a number" in page.inner_text("#notice")
    form.locator("input[aria-label=Value]").fill("3")
    form.locator("select[aria-label=Photosites]").select_option(label="pinned photosite")
    form.locator("button").click()
    assert "pin it first" in page.inner_text("#notice")
    assert not page.evaluate("studio.state.settings.requirements")
