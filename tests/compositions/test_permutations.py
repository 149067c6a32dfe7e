"""Permutations: of photosites, points of a sweep, samples of a dataset, and frames."""

from __future__ import annotations

import numpy as np
import pytest
from reference.shots import FLAT_SHOT

import foveasim as fs
from foveasim import explore

SHOT = FLAT_SHOT | {"sensor": FLAT_SHOT["sensor"] | {"bits": 10}, "exposure_s": 0.001}
RINGS = fs.layout.mosaic(fs.layout.log_polar(n_sectors=16, r_min_um=6.0, r_max_um=40.0, n_rings=5), "RGGB")
ORDER = np.random.default_rng(5).permutation(RINGS.n_sites)
LIGHT = fs.PowerMap(np.random.default_rng(6).random((1, 90, 90)) * 1e-3, fs.Grid.centred((90, 90), 1.0), [550.0])


def camera_of(layout):
    sensor = fs.Sensor(
        layout, filters="rgb", qe=0.6, capacitance_f=2e-16 * layout.area_um2, read_noise_e=3.0, bits=10, prnu_fraction=0.02,
        dark_e_per_s=100.0, dsnu_fraction=0.3, crosstalk=fs.sensor.Diffusion(spread_um=0.4),
    )  # fmt: skip
    return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)


def of_site(camera):
    """Return results with one value for each site."""
    rate = camera.photoelectrons_per_s(LIGHT)
    expected_e = camera.sensor.expected_electrons(rate, 0.01)
    dark_e = camera.sensor.expected_electrons(np.zeros_like(rate), 0.01)
    mean_dn, variance_dn2 = camera.sensor.predict(expected_e)
    signals = fs.sensor.signal_to_noise(camera.sensor, expected_e, dark_e)
    return {
        "rate": rate, "expected_e": expected_e, "mean_dn": mean_dn, "variance_dn2": variance_dn2,
        "signal_e": signals.signal_e, "noise_e": signals.noise_e,
    }  # fmt: skip


def test_results_follow_the_order_of_sites():
    one, other = of_site(camera_of(RINGS)), of_site(camera_of(RINGS[ORDER]))

    for name, values in one.items():
        assert other[name] == pytest.approx(values[ORDER], rel=1e-9), name
    assert camera_of(RINGS).sensor.exposure_for(one["rate"]) == pytest.approx(
        camera_of(RINGS[ORDER]).sensor.exposure_for(other["rate"]), rel=1e-9
    )


def test_verdicts_are_independent_of_site_order():
    rules = fs.DesignRules(
        min_size_um=2.5,
        min_width_um=1.8,
        angle_limit_deg=60.0,
        min_space_um=0.1,
        max_overlap_um2=0.0,
        max_neighbour_ratio=1.1,
    )
    found = [
        {
            (v.rule, tuple(sorted(site if k == 0 else int(ORDER[site]) for site in v.site_ids))): v.value
            for v in report.violations
        }
        for k, report in enumerate((RINGS.check(rules), RINGS[ORDER].check(rules)))
    ]

    assert found[0].keys() == found[1].keys()
    assert [found[1][key] for key in found[0]] == pytest.approx(list(found[0].values()), rel=1e-9)


def test_sweeps_are_independent_of_point_order():
    values, order = [1.4, 2.0, 2.8, 4.0], [2, 0, 3, 1]
    vary = [
        {"optics.f_number": each, "layout.parameters.n_x": [8, 12]} for each in (values, [values[k] for k in order])
    ]
    found = [explore.sweep(SHOT, each, seed="shot", workers=0).sortby("optics.f_number") for each in vary]

    numbers = [name for name, values in found[0].data_vars.items() if values.dtype.kind in "fiu"]
    assert len(numbers) > 3
    for name in numbers:
        np.testing.assert_allclose(found[0][name].values, found[1][name].values, rtol=1e-12, err_msg=name)


def test_samples_are_independent_of_reading_order():
    pictures = np.random.default_rng(0).integers(0, 256, (3, 40, 48, 3), np.uint8)
    shot = SHOT | {"scene": {"kind": "picture", "pitch_um": 200.0, "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.05}}
    options = {"draws": 2, "seed": 7}
    vary = {"optics.f_number": {"log_uniform": [1.4, 8.0]}}
    one, other = (explore.Dataset(pictures, shot, vary, **options) for _ in range(2))
    order = np.random.default_rng(1).permutation(len(one)).tolist()
    samples = {k: other[k] for k in order}

    for k in range(len(one)):
        assert np.array_equal(one[k]["code"], samples[k]["code"])


def test_frames_are_independent_of_their_order():
    camera = camera_of(RINGS)
    frames = [camera.capture(LIGHT, exposure_s=0.01, seed=1, frame=k).code for k in range(4)]
    again = {k: camera_of(RINGS).capture(LIGHT, exposure_s=0.01, seed=1, frame=k).code for k in (2, 0, 3, 1)}

    assert all(np.array_equal(frames[k], again[k]) for k in range(4))
    assert not np.array_equal(frames[0], frames[1])
