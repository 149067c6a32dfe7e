"""Noise budget: individual entries, and their sum against the prediction of the chain."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.layout import grid
from foveasim.sensor import FIXED, PRESETS, TEMPORAL, Diffusion, Sensor, noise_budget
from foveasim.units import ELEMENTARY_CHARGE_C

N = 400
LINE = grid(n_x=N, n_y=1, pitch_um=2.0).with_columns(readout_line=np.arange(N))


def test_budget_entries_match_textbook_values():
    """kTC noise of 0.1 pF at 300 K: 127.0 e-; 8 bits over 3 V: 7314 e- per step, 2111 e- rms (parameters of the paper)."""
    sensor = Sensor(
        LINE,
        ktc_noise=True,
        read_noise_e=4.0,
        dark_e_per_s=900.0,
        prnu_fraction=0.01,
        pixel_fpn_fraction=0.02,
        capacitance_f=1e-13,
    )

    noise_e = noise_budget(sensor, np.full(N, 40_000.0), 1.0)

    assert tuple(noise_e) == (*TEMPORAL, *FIXED)
    expected = {
        "photon_shot": 200.0 * np.sqrt(sensor.response),  # of this device
        "dark_shot": 30.0,
        "reset": 127.0,
        "read": 4.0,
        "quantisation": 2111.4,
        "prnu": 400.0,
        "pixel_fpn": 0.02 * 1.8724e6,
        "gain_fpn": 0.0,
        "rts": 0.0,
    }
    for name, size_e in expected.items():
        assert noise_e[name] == pytest.approx(np.broadcast_to(size_e, N), rel=5e-4, abs=1e-9)


def test_offsets_are_referred_by_local_slope():
    """At half the range, a nonlinearity of 10 % lowers the slope to 0.9."""
    sensor = Sensor(
        LINE, nonlinearity_fraction=0.1, pixel_fpn_fraction=0.01, capacitance_f=2e4 * scipy.constants.e / 3.0
    )

    assert noise_budget(sensor, np.full(N, 1e4), 1.0)["pixel_fpn"] == pytest.approx(np.full(N, 200.0 / 0.9))


@pytest.mark.parametrize("companding", [{}, {"companding": "root"}, {"companding": "log", "log_strength": 5.0}])
@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_temporal_entries_sum_to_code_variance(companding, bend):
    full_e = 20_000.0
    sensor = Sensor(
        LINE,
        bits=10,
        capacitance_f=full_e * scipy.constants.e / 3.0,
        dark_e_per_s=200.0,
        read_noise_e=60.0,
        ktc_noise=True,
        nonlinearity_fraction=bend,
        pedestal_v=0.4 if bend else 0.0,
        **companding,
    )
    photo_e = np.linspace(4000.0, 15_000.0, N)
    budget = noise_budget(sensor, photo_e, 1.0)
    mean_dn, variance_dn2 = sensor.predict(sensor.expected_electrons(photo_e, 1.0))

    slope_dn_per_e = np.gradient(mean_dn, photo_e)
    total_e2 = sum(budget[name] ** 2 for name in TEMPORAL)
    interior = slice(5, -5)
    # The step in electrons follows from the slope of the complete chain at the level raised by the pedestal.
    steps_e = 1.0 / np.sqrt(12.0) / slope_dn_per_e
    assert np.mean(budget["quantisation"][interior] / steps_e[interior]) == pytest.approx(1.0, abs=0.01)
    assert np.mean(variance_dn2[interior] / slope_dn_per_e[interior] ** 2 / total_e2[interior]) == pytest.approx(
        1.0, abs=0.01
    )


def test_light_has_no_dark_shot_noise():
    """Rounding of crosstalk is not a dark signal."""
    sensor = Sensor(LINE, crosstalk=Diffusion(spread_um=0.7), prnu_fraction=0.05, sensitivity=np.linspace(0.1, 1.0, N))

    assert noise_budget(sensor, np.linspace(1.0, 1e5, N), 0.01)["dark_shot"].max() == 0.0


def test_invalid_rates_and_exposures_are_rejected():
    with pytest.raises(ParameterError, match="'photo_e_per_s' must have one value for each of the 400 sites, got"):
        noise_budget(Sensor(LINE), np.ones(3), 1.0)
    with pytest.raises(ParameterError, match="'exposure_s' must be >= 0"):
        noise_budget(Sensor(LINE), np.ones(N), -1.0)


def test_camera_and_sensor_methods_match_functions():
    layout = grid(n_x=20, n_y=20, pitch_um=4.0)
    sensor = Sensor.from_preset(layout, "paper_foveal", prnu_fraction=0.02)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    scene = fs.Scene.flat(shape=(200, 200), pitch_um=60.0, distance_m=1.0, radiance_w_m2_sr_nm=0.5, band_width_nm=10.0)

    budget = camera.noise_budget(scene, exposure_s=0.03)
    by_hand = noise_budget(sensor, camera.photoelectrons_per_s(scene), 0.03)
    calibration = sensor.calibrate(exposure_s=0.03, flat_e=5e5, n_frames=4, seed=1)

    assert all(np.array_equal(budget[name], by_hand[name]) for name in by_hand)
    # 8 bits over 3 V on 0.1 pF: 7314 e- per step, 2111 e- rms.
    assert budget["quantisation"] == pytest.approx(np.full(400, 2111.4), rel=1e-4)
    assert np.corrcoef(calibration.gain, sensor.response)[0, 1] > 0.5


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("paper_foveal", {"read_noise_e": 1.0, "capacitance_f": 1e-13, "v_sat_v": 3.0, "bits": 8}),
        ("paper_distortion", {"read_noise_e": 1.0, "capacitance_f": 4.8e-13, "v_sat_v": 3.0, "bits": 8}),
        ("paper_read_noise", {"read_noise_e": 50.0, "full_well_e": 7000.0}),
    ],
)
def test_presets_match_published_parameters(name, published):
    sensor = Sensor.from_preset(LINE, name)

    assert {key: getattr(sensor, key) for key in published} == published
    settings = PRESETS[name].settings()
    assert settings.pop("provenance")["title"] == PRESETS[name].title
    assert settings == published


@pytest.mark.parametrize(
    ("name", "pixel_um", "full_well_e", "dynamic_range_db", "bits"),
    [
        ("mobile", 1.4, 4300, 68.0, 10),
        ("machine_vision", 3.45, 10_700, 75.46, 12),
        ("scientific", 6.5, 30_000, 86.74, 16),
    ],
)
def test_presets_have_published_dynamic_range(name, pixel_um, full_well_e, dynamic_range_db, bits):
    """By the variance of dark codes without quantisation, and the code of light beyond the range."""
    sensor = Sensor.from_preset(grid(n_x=500, n_y=400, pitch_um=pixel_um), name)
    dark, full = sensor.read(np.zeros(200_000), seed=0), sensor.read(np.full(200_000, 1.1 * full_well_e), seed=1)
    gain_dn_per_e = 2**bits * ELEMENTARY_CHARGE_C / (sensor.capacitance_f[0] * sensor.v_sat_v)
    noise_e = np.sqrt(dark.astype(float).var() - 1.0 / 12.0) / gain_dn_per_e
    largest_e = (full.astype(float).mean() - dark.astype(float).mean()) / gain_dn_per_e

    assert sensor.bits == bits
    assert largest_e == pytest.approx(full_well_e, rel=0.01)
    assert 20.0 * np.log10(full_well_e / noise_e) == pytest.approx(dynamic_range_db, abs=0.1)


def test_noise_of_presets_is_not_clipped():
    for name in ("mobile", "machine_vision", "scientific"):
        side_um = PRESETS[name].sheet.value("pixel_um")
        sensor = Sensor.from_preset(grid(n_x=40, n_y=25, pitch_um=side_um), name)
        codes = sensor.read(np.zeros(1000), seed=0).astype(float)

        assert codes.min() > 0
        assert codes.mean() == pytest.approx(PRESETS[name].sheet.black_dn, abs=1.0)


def test_presets_scale_with_area():
    layout = fs.layout.log_polar(n_sectors=32, min_size_um=3.0, r_max_um=100.0)
    sensor = Sensor.from_preset(layout, "machine_vision", bits=8, dark_e_per_s=5.0)
    density = np.asarray(sensor.capacitance_f) * sensor.v_sat_v / ELEMENTARY_CHARGE_C / layout.area_um2

    # 12 bits, of which 4 codes are below the black level.
    assert density == pytest.approx(np.full(layout.n_sites, 10_700 / 3.45**2 * 4096 / 4091))
    assert (sensor.bits, sensor.dark_e_per_s) == (8, 5.0)
    assert sensor.read_noise_e == pytest.approx(10_700 / 10 ** (75.46 / 20))
    with pytest.raises(
        ParameterError, match="'preset' must be the name of a preset, got 'machine_visoin'; did you mean"
    ):
        Sensor.from_preset(layout, "machine_visoin")
    with pytest.raises(ParameterError, match="'layout' must be a Layout, got a str"):
        Sensor.from_preset("layout", "mobile")


def test_budget_lists_sums_and_draws_bars():
    layout = grid(4, 1, 3.0)
    sensor = Sensor(layout, read_noise_e=3.0, dark_e_per_s=100.0, prnu_fraction=0.02, capacitance_f=1e-15, bits=14)
    budget = noise_budget(sensor, np.array([1600.0, 1600.0, 0.0, 0.0]), 1.0)
    rows = {row["effect"]: row for row in budget.records()}
    bars = budget.plot()

    # Shot noise of 1600 e- times the response of the device, on two of four sites.
    charge_e = 1600.0 * sensor.response[:2]
    assert rows["photon_shot"] == {
        "effect": "photon_shot", "kind": "temporal", "rms_e": pytest.approx(np.sqrt(charge_e.sum() / 4.0)), "min_e": 0.0,
        "max_e": pytest.approx(np.sqrt(charge_e.max())),
    }  # fmt: skip
    step_e = 3.0 * 1e-15 / scipy.constants.e / 2**14
    assert rows["all temporal"]["max_e"] == pytest.approx(np.sqrt(charge_e.max() + 100.0 + 9.0 + step_e**2 / 12.0))
    assert rows["all fixed"]["max_e"] == pytest.approx(0.02 * 1600.0)
    assert "reset" not in rows
    assert set(budget) == {*TEMPORAL, *FIXED}
    assert [label.get_text() for label in bars.get_yticklabels()] == [
        name for name in rows if not name.startswith("all")
    ]
    copy = pickle.loads(pickle.dumps(budget))
    assert str(copy) == str(budget)
    assert repr(copy).startswith("NoiseBudget(4 sites, temporal noise ")
