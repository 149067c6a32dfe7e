"""Panorama in the studio: the field of the sensor at its gaze, and the tile."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from foveasim.studio._comparison import compare
from foveasim.studio._engine import Engine
from foveasim.studio._parts import PARTS

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from studio.page_tools import until


@pytest.fixture
def shot(tmp_path):
    random = np.random.default_rng(0)
    Image.fromarray(random.integers(200, 255, (32, 64, 3), np.uint8)).save(tmp_path / "sky.png")
    return {
        "scene": {"kind": "panorama", "picture": str(tmp_path / "sky.png"), "luminance_cd_m2": 500.0, "cells": 64},
        "optics": {"focal_length_mm": 1.0, "f_number": 2.8},
        "distortion": {"kind": "fisheye", "projection": "equidistant", "focal_um": 1000.0},
        "layout": {
            "generator": "log_polar",
            "parameters": {"n_sectors": 24, "r_min_um": 45.0, "n_rings": 12, "r_max_um": 1047.2},
        },
        "sensor": {},
        "exposure_s": 0.001,
    }


def compared(shot, **changes):
    """Return the rows of two variants with other layouts, by name."""
    grid = {"generator": "grid", "parameters": {"n_x": 24, "n_y": 24, "pitch_um": 80.0}}
    shots = [shot | changes, shot | changes | {"layout": grid}]
    results = [Engine(n_threads=1).simulate(json.loads(json.dumps(each))) for each in shots]
    return {row["name"]: row["values"] for row in compare([("a", results[0]), ("b", results[1])])["rows"]}


@pytest.mark.parametrize("gaze", [{"gaze_deg": [30.0, 0.0]}, {"gaze_um": [523.6, 0.0], "axis": "sensor"}])
def test_variants_are_compared_at_the_gaze(shot, gaze):
    """A camera that turns by 30 degrees sees what a camera ahead sees of the panorama that is turned by as much."""
    turned = shot | {"scene": shot["scene"] | {"yaw_deg": 30.0}}
    found, expected, ahead = compared(shot, **gaze), compared(turned), compared(shot)

    for name in ("field_psnr_db", "fovea_psnr_db", "field_ssim"):
        assert found[name] == pytest.approx(expected[name], rel=0.02), name
        assert None not in found[name]
    assert found["field_psnr_db"] != pytest.approx(ahead["field_psnr_db"], rel=0.02)


def brightness(shot, **changes):
    """Return the preview relative to that without a field, top row first."""
    about, arrays = PARTS["panorama"].make(Engine(n_threads=1).simulate(json.loads(json.dumps(shot | changes))))
    assert (about["width"], about["height"]) == (360, 180)
    return about, arrays["rgba"][..., :3].astype(float).mean(axis=-1)


@pytest.mark.parametrize(
    ("changes", "centre"),
    [
        ({}, (0.0, 0.0)),
        ({"gaze_deg": [90.0, 0.0]}, (90.0, 0.0)),
        ({"gaze_um": [500.0, 0.0], "axis": "sensor"}, (28.65, 0.0)),
        ({"gaze_deg": [-40.0, 50.0]}, (-40.0, 50.0)),
    ],
)
def test_field_is_the_cone_around_the_gaze(shot, changes, centre):
    """The layout covers a cone of 60° around its gaze, a quarter of all directions, without its centre."""
    about, found = brightness(shot, **changes)
    elevation, azimuth = np.radians(np.meshgrid(89.5 - np.arange(180.0), np.arange(360.0) - 179.5, indexing="ij"))
    a, e = np.radians(centre)
    cosine = np.sin(e) * np.sin(elevation) + np.cos(e) * np.cos(elevation) * np.cos(azimuth - a)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    inner, outer = found[(angle < 57.0) & (angle > 40.0)], found[angle > 62.0]
    assert inner.min() > outer.max()
    assert about["note"].startswith("360° by 180°; the sensor covers 2")


def test_planes_have_no_panorama(settings):
    about, _ = PARTS["panorama"].make(Engine(n_threads=1).simulate(settings))
    assert about["note"] == "The scene is not a panorama."


@pytest.mark.needs("chromium")
def test_tile_says_that_scene_is_a_plane(visit):
    page = visit()
    page.click("[data-tile='panorama']")
    until(page, "() => document.querySelector('#panorama-note')?.textContent.includes('not a panorama')")
