"""Point spread in the studio: sections at photosites, pinned sites, and the tile."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import set_value, until

COMA = {"coma_um": 0.2, "field_radius_um": 200.0}


@pytest.fixture
def simulate(settings):
    def simulate(pinned=(), **optics):
        changed = json.loads(json.dumps(settings))
        changed["scene"] |= {"shape": [16, 16], "pitch_um": 2000.0, "wavelength_nm": 550.0}
        changed["optics"] |= optics
        return replace(Engine(n_threads=1).simulate(changed), pinned=tuple(pinned))

    return simulate


def sections_of(result):
    about, arrays = PARTS["psf"].make(result)
    return about, {curve["label"]: (arrays[f"x-{k}"], arrays[f"y-{k}"]) for k, curve in enumerate(about["curves"])}


def test_sections_of_a_clear_circle_are_equal(simulate):
    result = simulate()
    about, sections = sections_of(result)
    optics, wave_nm = result.shot.camera.optics, float(np.median(result.shot.scene.wavelength_nm))
    peak = 0.25 * np.pi / (1e-3 * wave_nm * optics.working_f_number(result.shot.scene.distance_m)) ** 2

    assert len(sections) == 4
    assert len({label.split(",")[0] for label in sections}) == 2
    for x_um, values in sections.values():
        assert values.max() == pytest.approx(peak, rel=1e-4)
        np.testing.assert_allclose(values, next(iter(sections.values()))[1], rtol=1e-5)
        assert x_um[0] == pytest.approx(-x_um[-1])
    assert about["note"].startswith(f"{wave_nm:g} nm")


@pytest.mark.slow
def test_sections_are_those_at_pinned_photosites(simulate):
    layout = simulate().shot.camera.layout
    x_um, y_um = layout.centroid_um.T
    right, top = int(x_um.argmax()), int(y_um.argmax())
    _, sections = sections_of(simulate((right, top), seidel=COMA))
    along = {
        (site, axis): np.sum(x * values) / np.sum(values)
        for site in (right, top)
        for axis in "xy"
        for x, values in [sections[f"photosite {site:,}, {axis}"]]
    }

    # Coma points away from the axis.
    assert along[right, "x"] > max(0.0, along[top, "x"])
    assert along[top, "y"] > max(0.0, along[right, "y"])


@pytest.mark.needs("chromium")
def test_tile_shows_the_point_spread(visit):
    page = visit()
    page.click("[data-tile='psf']")
    until(page, "() => studio.views.made.psf?.chart.curves.length === 4")
    assert "light within a square of the site's area: nearest" in page.inner_text("#tile-psf .chart-note")
    set_value(page, "optics.f_number", 8.0)
    until(page, "() => studio.isIdle && studio.views.made.psf.chart.curves[0].y.every((value) => value < 0.1)")
