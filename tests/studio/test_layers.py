"""Layers of the sensor in three dimensions."""

from __future__ import annotations

import numpy as np
import pytest

from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS, solid


@pytest.fixture
def result(settings):
    return Engine(n_threads=1).simulate(settings)


def test_layers_have_thicknesses_of_the_stack(result):
    about, arrays = PARTS["solid"].make(result)
    bodies = about["bodies"]
    x0, y0, x1, y1 = result.capture.layout.bounds_um

    assert [body["name"] for body in bodies["list"]] == ["wells", "trenches", "filters", "lenses"]
    assert bodies["low_um"] == pytest.approx([x0, y0, -3.0])
    assert bodies["high_um"] == pytest.approx([x1, y1, 0.6 + 0.7])
    assert set(np.unique(arrays["run_sites"])) == set(range(1, 225))
    assert about["note"] == "Silicon 3 µm, filters 0.6 µm, lenses 0.7 µm"


def test_large_layouts_show_their_centre(result, monkeypatch):
    monkeypatch.setattr(solid, "MAX_STACK_SITES", 16)
    about, arrays = PARTS["solid"].make(result)
    sites = np.unique(arrays["run_sites"]).astype(int) - 1

    assert sites.size == 16
    assert np.abs(result.capture.layout.centroid_um[sites]).max() == pytest.approx(1.5 * 12.0)
    assert (about["n_sites"], "16 central photosites" in about["note"]) == (224, True)


def test_narrow_photosites_have_no_trenches(settings):
    settings["layout"] = {
        "generator": "grid",
        "parameters": {"n_x": 4, "n_y": 4, "pitch_um": 0.15},
        "mosaic": ["RG", "GB"],
    }
    about, _ = PARTS["solid"].make(Engine(n_threads=1).simulate(settings))

    assert [body["name"] for body in about["bodies"]["list"]] == ["wells", "filters", "lenses"]
    assert "no trenches" in about["note"]
