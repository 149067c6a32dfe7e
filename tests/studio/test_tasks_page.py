"""Tasks of the guide to the studio, done by clicks, keys and files: their results."""

from __future__ import annotations

import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from scripts import load_script

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import codes, setting

import foveasim as fs

pytestmark = pytest.mark.needs("chromium")


@pytest.fixture(scope="module")
def tasks():
    return load_script("docs/studio_pictures.py")


@pytest.fixture
def page(visit, tasks):
    found = visit(width=1440, height=900, bypass_csp=True, accept_downloads=True)
    tasks.wait_for_views(found)
    return found


def table(page):
    return page.evaluate(
        "() => Object.fromEntries(studio.views.parts.comparison.about.rows.map((row) => [row.name, row.values]))"
    )


def test_photograph_is_captured(page, tasks):
    gaze_um = np.array(setting(page, "gaze_um"))
    tasks.photograph(page, Path(str(files("skimage.data") / "coffee.png")))

    assert setting(page, "scene.picture").endswith("coffee.png")
    assert setting(page, "optics.f_number") == 4
    assert np.any(np.array(setting(page, "gaze_um")) != gaze_um)
    assert np.ptp(codes(page)) > 50


def test_square_sensor_has_same_budget(page, tasks):
    tasks.foveal_against_square(page)
    found = table(page)

    assert found["n_sites"][1] == pytest.approx(found["n_sites"][0], rel=0.02)
    # Photosites of the foveal sensor are smaller there.
    assert found["fovea_psnr_db"][0] > found["fovea_psnr_db"][1]


def test_drawn_layout_satisfies_rules(page, tasks, tmp_path):
    path = tasks.chip(page, tmp_path)
    layout = fs.read_layout(path)

    assert layout.n_sites == page.evaluate("studio.panes.b.sites.n")
    # Coordinates in a GDSII file are multiples of 1 nm.
    assert layout.check(fs.DesignRules(min_size_um=2.499)).ok
    assert [step["kind"] for step in setting(page, "layout.edits")] == ["overlay", "draw", "repair"]


def test_archive_of_lecture_is_complete(page, tasks, tmp_path):
    path = tasks.lecture(page, tmp_path)
    with zipfile.ZipFile(path) as archive:
        extensions = {Path(name).suffix for name in archive.namelist()}

    assert {".yaml", ".py", ".ipynb", ".gds"} <= extensions
    assert page.is_visible("#tile-solid canvas")
