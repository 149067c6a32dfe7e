"""Twins of frames that another program simulates, of its models of CCD, CMOS and scientific CMOS."""

from __future__ import annotations

import math

import numpy as np
import pytest
from other_programs import other_program

import foveasim as fs

getframes = other_program("getframes")

SHAPE, TEMPERATURE_C = (96, 128), 20.0
#: Exposure times of dark and flat stacks, and numbers of frames.
DARK_S, FLAT_S, N_DARK, N_FRAMES = (1e-4, 0.3, 2.0), 0.01 * np.arange(1, 11), 64, 16


def camera_of(preset, **changes):
    return getframes.Camera(getframes.load_preset(preset).replace(resolution=SHAPE, **changes))


def stacks_of(camera, top=1.3):
    """Dark stacks, and flat stacks up to ``top`` times the full well or the highest code."""
    config = camera.config
    well_e = min(config.full_well_e, 2**config.bit_depth * config.gain_e_per_adu)
    rate = top * well_e / config.quantum_efficiency / FLAT_S[-1]

    def frames(rate, time_s, n, seed):
        drawn = [
            camera.flat_frame(rate, time_s, TEMPERATURE_C, seed=1000 * seed + k, include_truth=False) for k in range(n)
        ]
        return np.stack([each.data for each in drawn]).astype(np.uint16)

    numbers = (N_DARK, N_FRAMES, N_FRAMES)
    dark = [
        fs.twin.Stack(frames(0.0, time_s, n, k), time_s, light=0)
        for k, (time_s, n) in enumerate(zip(DARK_S, numbers, strict=True))
    ]
    flat = [
        fs.twin.Stack(frames(rate, time_s, N_FRAMES, 10 + k), time_s, photons=rate * time_s)
        for k, time_s in enumerate(FLAT_S)
    ]
    return [*dark, *flat]


def truth_of(config):
    """Parameters in the terms of a twin; widths of log-normal distributions as relative standard deviations."""
    gain = 1.0 / config.gain_e_per_adu
    return {
        "gain_dn_per_e": gain,
        "black_level_dn": config.bias_offset_adu,
        "read_noise_e": config.read_noise_e,
        "full_well_e": config.full_well_e,
        "qe": config.quantum_efficiency,
        "nonlinearity_fraction": 0.0,
        "dark_e_per_s": config.dark_current_at(TEMPERATURE_C),
        "dsnu_e": config.bias_pixel_spread_adu / gain,
        "dsnu_fraction": math.sqrt(math.expm1(config.dark_current_nonuniformity**2)),
        "prnu_fraction": math.sqrt(math.expm1(config.prnu**2)),
        "hot_fraction": config.hot_pixel_fraction,
        "dead_fraction": config.dead_pixel_fraction,
    }


@pytest.mark.parametrize(
    ("preset", "changes", "missing"),
    [
        (
            "generic_ccd",
            {"full_well_e": 8e4, "dark_current_e_per_s": 50.0, "dark_current_nonuniformity": 0.2, "prnu": 0.008},
            (),
        ),
        ("generic_cmos", {"prnu": 0.005}, ("full_well_e",)),  # its ADC ends below the full well
        (
            "generic_cmos",
            {"full_well_e": 3500.0, "dark_current_e_per_s": 100.0, "dark_current_nonuniformity": 0.3, "prnu": 0.01,
             "bias_pixel_spread_adu": 1.5, "hot_pixel_factor": 15.0},
            (),
        ),
    ],
    ids=["CCD", "CMOS, limited by the ADC", "CMOS, limited by the full well"],
)  # fmt: skip
def test_cameras_are_recovered(preset, changes, missing):
    """Intervals of 95 % contain nine of ten parameters, and those of 99.99 % all."""
    camera = camera_of(preset, **changes)
    found = fs.twin.fit(stacks_of(camera), bits=camera.config.bit_depth, pixel_um=camera.config.pixel_size_um)
    truth = {name: value for name, value in truth_of(camera.config).items() if name not in missing}

    assert found.chi_square_ratio < 2.0
    assert set(truth) <= set(found.estimates)
    assert set(missing) <= set(found.not_identifiable)
    estimates = {name: found.estimates[name] for name in truth}
    inside = [each.low <= truth[name] <= each.high for name, each in estimates.items()]
    assert np.mean(inside) >= 0.9, estimates
    for name, each in estimates.items():
        assert (
            each.value - 2.0 * (each.value - each.low) <= truth[name] <= each.value + 2.0 * (each.high - each.value)
        ), name


def test_nonlinearity_before_noise_is_noticed():
    """
    Charges of getframes are bent before the full well and the noise; those of foveasim, and its noise, afterwards.

    The full well is then the charge whose bent value is that of getframes, and the report says that noise is not explained.
    """
    camera = camera_of("generic_scmos", read_noise_nonuniformity=0.0, read_noise_rts_fraction=0.0)
    config = camera.config
    found = fs.twin.fit(stacks_of(camera), bits=config.bit_depth, pixel_um=config.pixel_size_um)
    n_codes, top_dn = 2**config.bit_depth, config.full_well_e / config.gain_e_per_adu
    bend = config.nonlinearity
    expected = {
        "gain_dn_per_e": 1.0 / config.gain_e_per_adu,
        "qe": config.quantum_efficiency,
        "nonlinearity_fraction": bend * n_codes / top_dn,
        "full_well_e": config.full_well_e * (1.0 - math.sqrt(1.0 - 4.0 * bend)) / (2.0 * bend),
        "dark_e_per_s": config.dark_current_at(TEMPERATURE_C),
    }

    for name, value in expected.items():
        assert found.estimates[name].low <= value <= found.estimates[name].high, name
    assert found.value("read_noise_e") == pytest.approx(config.read_noise_e, rel=2.0 * bend)
    assert found.chi_square_ratio > 2.0


def test_files_of_frames_are_read(tmp_path):
    camera = camera_of("generic_cmos")
    frame = camera.dark_frame(0.1, TEMPERATURE_C, seed=0)
    frame.to_fits(str(tmp_path / "a.fits"))
    (stored,) = fs.twin.Stack([tmp_path / "a.fits"], 0.1, light=0)

    np.testing.assert_array_equal(stored, frame.data[::-1])  # the first row of FITS is the bottom
