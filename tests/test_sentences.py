"""Sentences of the documentation that a program can check: each is in its page, and true."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import foveasim as fs

DOCS = Path(__file__).parents[1] / "docs"
ZONES = fs.layout.zones(side_um=(64, 128), pitch_um=(4, 8))


def states(page, sentence):
    """Return whether a page contains a text, however its lines are broken."""
    text = re.sub(r"\s+", " ", (DOCS / page).read_text())
    return re.sub(r"\s+", " ", sentence) in text


def uniform_capture(**electronics):
    sensor = fs.Sensor(ZONES, shot_noise="off", bits=12, **electronics)
    light = fs.PowerMap(np.full((1, 200, 200), 1e-3), fs.Grid.centred((200, 200), 1.0), [550.0])
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    return camera.capture(light, exposure_s="auto", seed=0)


def spread(picture):
    """Return the ratio of the largest to the smallest value."""
    values = picture.data[np.isfinite(picture.data)]
    return values.max() / values.min()


def test_uniform_scene_gives_uniform_picture():
    assert states(
        "guides/pictures.md",
        'A uniform scene gives a uniform picture of `"light_e"` per `"um2"`; codes of sites of several sizes are equal only if '
        "their capacitances are in proportion to the areas, as by default",
    )
    fixed = uniform_capture(capacitance_f=1e-14)
    proportional = uniform_capture()

    assert spread(fixed.picture(of="light_e", per="um2")) == pytest.approx(1.0, rel=0.02)
    assert spread(fixed.picture(of="code")) > 3.0
    assert spread(proportional.picture(of="code")) == pytest.approx(1.0, rel=0.02)


def test_sites_saturate_at_the_same_irradiance():
    assert states(
        "questions.md",
        "The default, `1.5e-16 * layout.area_um2`, gives 2,809 e⁻ per µm² at 3 V: all sites saturate at the same irradiance",
    )
    sensor = fs.Sensor(ZONES, bits=10)
    # The irradiance in e-/µm² above which the largest site has the highest code.
    largest = ZONES.area_um2.argmax()
    levels = np.linspace(2000.0, 4000.0, 401)
    codes = np.stack([sensor.read(level * ZONES.area_um2) for level in levels])
    first = (codes == sensor.adc.n_codes - 1).argmax(axis=0)

    assert 0 < first[largest] < levels.size - 1
    assert np.ptp(first) <= 1
    assert levels[first[largest]] == pytest.approx(2809.0, rel=3e-3)


def test_volumes_are_those_of_a_part():
    assert states("guides/viewing.md", 'solids.volumes_um3("wells"), solids.fill_factor')
    solids = fs.view.solids(ZONES, fs.view.SensorStack(well_depth_um=3.0, trench_width_um=0.0))

    assert solids.volumes_um3("wells") == pytest.approx(3.0 * ZONES.area_um2)


def test_measures_are_metrics_of_one_number():
    assert states("guides/settings.md", "in `fs.metrics.METRICS`, also those of comparisons, such as `ssim`")
    for name in fs.metrics.METRICS:
        options = {"frequency_per_mm": 10.0} if name == "mtf" else {}
        if fs.metrics.metric_info(name).is_number:
            assert fs.config.RegionResult(measure=name, **options).measure == name


def test_comparison_covers_common_pixels():
    assert states(
        "guides/comparing.md", "Only pixels that all cameras cover are compared, and the report states the coverage"
    )
    cameras = {
        name: fs.Camera(
            optics=fs.Optics(focal_length_mm=8.0, f_number=2.8),
            sensor=fs.Sensor(layout, capacitance_f=1.6e-16 * layout.area_um2, bits=10),
        )
        for name, layout in {
            "all": fs.layout.grid(20, 20, 8.0),
            "hole": fs.layout.log_polar(n_sectors=24, r_min_um=20.0, r_max_um=80.0),
        }.items()
    }
    rng = np.random.default_rng(0)
    scene = fs.Scene.from_picture(rng.random((120, 120)), distance_m=1.0, fit="cover", illuminance_lux=500.0)
    found = fs.compare.cameras(cameras, {"one": scene, "other": scene}, exposure_s=0.01, n_annuli=2, budget=None)
    coverage = dict(zip(cameras, np.ravel(found.coverage_fraction)[: len(cameras)], strict=True))

    assert coverage["hole"] < coverage["all"]
    assert "coverage" in str(found)
