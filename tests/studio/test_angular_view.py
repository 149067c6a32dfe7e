"""Angular response in the studio: curves of annuli, the column of the map, and the tile."""

from __future__ import annotations

import json

import numpy as np
import pytest

from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import set_value, until

STACK = {"kind": "aperture_stack", "height_um": 4.0, "refractive_index": 1.5}


@pytest.fixture
def simulate(settings):
    def simulate(pixel_optics, **optics):
        changed = json.loads(json.dumps(settings))
        changed["sensor"]["pixel_optics"] = pixel_optics
        changed["optics"] |= optics
        return Engine(n_threads=1).simulate(changed)

    return simulate


def curves_of(result):
    about, arrays = PARTS["angular"].make(result)
    return about, {curve["name"]: (arrays[f"x-{k}"], arrays[f"y-{k}"]) for k, curve in enumerate(about["curves"])}


def test_sensor_without_pixel_optics_collects_all_light(simulate):
    result = simulate(None)
    about, curves = curves_of(result)

    assert curves == {}
    assert "all light" in about["note"].lower()
    assert "angular_response" not in {column["key"] for column in PARTS["columns"].make(result)[0]["columns"]}
    assert "angular_response" not in PARTS["signals"].make(result)[1]


def test_telecentric_response_is_one_curve(simulate):
    result = simulate(STACK, exit_pupil_mm=np.inf)
    about, curves = curves_of(result)
    ratio, radius = 4.0 / (1.5 * 12.0), 0.5 / result.shot.camera.optics.f_number
    expected = 1.0 - 8.0 * ratio * radius / (3.0 * np.pi) + (ratio * radius) ** 2 / (2.0 * np.pi)

    assert list(curves) == ["mean"]
    assert curves["mean"][1] == pytest.approx(expected, abs=1e-3)
    assert [float(text.split()[-1]) for text in about["note"].split(";")] == pytest.approx([expected] * 2, abs=1.6e-3)


def test_curves_are_means_and_extremes_of_annuli(simulate):
    result = simulate(STACK, exit_pupil_mm=0.3)
    camera, scene = result.shot.camera, result.shot.scene
    response = camera.angular_response(scene)
    height_um = np.hypot(*(camera.layout.centroid_um + camera.position_um).T)
    _, curves = curves_of(result)
    (x, mean), (_, lowest), (_, highest) = (curves[name] for name in ("mean", "lowest", "highest"))

    assert (lowest <= mean + 1e-6).all()
    assert (mean <= highest + 1e-6).all()
    assert lowest.min() == pytest.approx(response.min(), rel=1e-6)
    assert highest.max() == pytest.approx(response.max(), rel=1e-6)
    assert height_um.min() - 1e-6 <= x[0] < x[-1] <= height_um.max() + 1e-6
    assert (np.diff(x) > 0.0).all()


def test_response_is_a_column_of_signals(simulate):
    result = simulate(STACK)
    (column,) = [each for each in PARTS["columns"].make(result)[0]["columns"] if each["key"] == "angular_response"]
    found = PARTS["signals"].make(result)[1]["angular_response"]

    assert column["is_signal"]
    np.testing.assert_allclose(found, result.shot.camera.angular_response(result.shot.scene), rtol=1e-6)


@pytest.mark.needs("chromium")
def test_tile_and_map_show_angular_response(visit):
    page = visit()
    set_value(page, "sensor.pixel_optics", STACK)
    page.click("[data-tile='angular']")
    until(page, "() => studio.views.made.angular?.chart.curves.length > 0")
    page.select_option("#colouring", "angular_response")
    until(page, "() => studio.isIdle && studio.panes.b.column?.key === 'angular_response'")
    low, high = page.evaluate(
        "() => { const { values } = studio.panes.b.column; return [Math.min(...values), Math.max(...values)]; }"
    )
    note = page.inner_text("#tile-angular .chart-note")

    assert 0.0 < low < high < 1.0
    assert f"smallest site {low:.3f}" in note or f"largest site {high:.3f}" in note

    set_value(page, "sensor.pixel_optics", None)
    until(page, "() => studio.views.made.angular.chart.curves.length === 0")
    until(page, "() => studio.panes.b.column.key !== 'angular_response'")
