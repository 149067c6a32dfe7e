"""System gain K and DSNU in the units of data sheets: measured back, and equal to the parameters that they replace."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim.config import build_shot, demo_settings, put_setting, read_settings
from foveasim.errors import ConfigError, ParameterError
from foveasim.layout import grid

LAYOUT = grid(n_x=200, n_y=200, pitch_um=3.0)
N = LAYOUT.n_sites
#: A linear ADC with a black level of 200 codes.
SHEET = {"gain_dn_per_e": 0.4, "dsnu_e": 6.0, "bits": 12, "v_sat_v": 1.0, "pedestal_v": 200 / 4096, "read_noise_e": 3.0}


def dark_frames(sensor, exposure_s, n_frames=16):
    expected_e = sensor.expected_electrons(np.zeros(N), exposure_s)
    return fs.metrics.draw_frames(sensor, expected_e, n_frames=n_frames, seed=5, exposure_s=exposure_s)


def test_measurement_returns_gain_and_dsnu():
    """By photon transfer and the spatial variance of dark frames of EMVA 1288, which do not know the parameters."""
    sensor = fs.Sensor(LAYOUT, **SHEET)
    light_e = np.linspace(200.0, 10_500.0, 22)
    light = [
        fs.metrics.draw_frames(sensor, np.full(N, each), n_frames=8, seed=k, exposure_s=0.01)
        for k, each in enumerate(light_e)
    ]
    found = fs.metrics.emva1288(light, [dark_frames(sensor, 0.01)], light_e)

    assert found.gain_dn_per_e[0] == pytest.approx(0.4, rel=0.01)
    assert found.dsnu_e[0] == pytest.approx(6.0, rel=0.02)
    assert found.dark_noise_e[0] == pytest.approx(3.0, rel=0.02)


def test_gain_per_site_sets_codes():
    gain = np.where(np.arange(N) < N // 2, 0.25, 1.0)
    sensor = fs.Sensor(LAYOUT, gain_dn_per_e=gain, v_sat_v=2.5, bits=12, shot_noise="off")
    codes = sensor.read(np.full(N, 1000.0), seed=0)

    assert set(codes[: N // 2]) == {250}
    assert set(codes[N // 2 :]) == {1000}


def test_gain_equals_its_capacitance():
    """C = 2^n q / (K V_sat); also with companding, where K is the mean over the range."""
    capacitance_f = 4096 * scipy.constants.e / (0.4 * 1.0)
    common = {"bits": 12, "v_sat_v": 1.0, "read_noise_e": 2.0, "ktc_noise": True, "companding": "root"}
    of_gain = fs.Sensor(LAYOUT, gain_dn_per_e=0.4, **common)
    of_capacitance = fs.Sensor(LAYOUT, capacitance_f=capacitance_f, **common)
    charges_e = np.linspace(0.0, 12_000.0, N)

    np.testing.assert_allclose(of_gain.node_f, of_capacitance.node_f, rtol=1e-12)
    codes = [each.read(charges_e, seed=1).astype(int) for each in (of_gain, of_capacitance)]
    assert np.abs(codes[0] - codes[1]).max() <= 1
    assert np.count_nonzero(codes[0] - codes[1]) < 10  # charges at a transition between codes


@pytest.mark.parametrize("exposure_s", [1e-3, 10.0])
@pytest.mark.parametrize("cds", [False, True])
def test_dsnu_remains_for_any_exposure(exposure_s, cds):
    """With dark current only the relative non-uniformity of the current grows with the exposure."""
    offsets = fs.Sensor(LAYOUT, **SHEET, cds=cds)
    relative = fs.Sensor(LAYOUT, **SHEET | {"dsnu_e": 0.0}, dark_e_per_s=5.0, dsnu_fraction=0.1, cds=cds)
    spread_e = [dark_frames(each, exposure_s, 64).mean(axis=0).std() / 0.4 for each in (offsets, relative)]
    # Standard deviation of means of 64 frames: read noise, quantisation and dark-current shot noise.
    noise_e2 = (9.0 + 1.0 / (12 * 0.16)) / 64

    assert spread_e[0] == pytest.approx(np.hypot(6.0, np.sqrt(noise_e2)), rel=0.02)
    assert spread_e[1] == pytest.approx(np.sqrt((0.5 * exposure_s) ** 2 + noise_e2 + 5.0 * exposure_s / 64), rel=0.03)


def test_prediction_and_budget_contain_dsnu():
    sensor = fs.Sensor(LAYOUT, **SHEET)
    budget = fs.sensor.noise_budget(sensor, np.full(N, 1e5), 0.01)
    mean_dn, _ = sensor.predict(np.full(N, 1000.0))
    model = sensor.linearise(np.full(N, 1000.0), is_device_known=False)

    assert budget["dark_offset"] == pytest.approx(np.full(N, 6.0))
    assert "dark_offset" in fs.sensor.FIXED
    assert (mean_dn - 599.5) / 0.4 == pytest.approx(sensor.pattern("dark_offset"), abs=1e-6)
    np.testing.assert_allclose(model.variance_dn2(["dark_offset"]), (0.4 * 6.0) ** 2, rtol=1e-6)


def test_copies_have_gain_and_dsnu():
    sensor = fs.Sensor(LAYOUT, **SHEET)
    charges_e = np.full(N, 500.0)
    expected = sensor.read(charges_e, seed=2)

    assert np.array_equal(pickle.loads(pickle.dumps(sensor)).read(charges_e, seed=2), expected)
    assert replace(sensor, bits=12).dsnu_e == 6.0
    part = sensor.part(slice(100, 200))
    assert np.array_equal(part.pattern("dark_offset"), sensor.pattern("dark_offset")[100:200])
    assert np.array_equal(part.node_f, sensor.node_f)


def test_capture_settings_restore_gain_and_dsnu():
    sensor = fs.Sensor(LAYOUT, **SHEET | {"gain_dn_per_e": np.linspace(0.3, 0.5, N)})
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    scene = fs.Scene.flat(shape=(90, 90), pitch_um=900.0, distance_m=1.0, radiance_w_m2_sr_nm=0.01, band_width_nm=10.0)
    capture = camera.capture(scene, exposure_s=0.01, seed=1)
    again = fs.Sensor.from_settings(LAYOUT, capture.settings["sensor"], sensor.arrays)

    assert np.array_equal(again.gain_dn_per_e, sensor.gain_dn_per_e)
    assert again.dsnu_e == 6.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"gain_dn_per_e": 0.4, "capacitance_f": 1e-15},
            "'gain_dn_per_e' must not be given together with 'capacitance_f'",
        ),
        ({"dsnu_e": 4.0, "pixel_fpn_fraction": 0.01}, "'dsnu_e' must not be given together with 'pixel_fpn_fraction'"),
        ({"gain_dn_per_e": [0.4, 0.3]}, "'gain_dn_per_e' must"),
    ],
)
def test_one_of_two_units_is_required(values, message):
    with pytest.raises(ParameterError) as caught:
        fs.Sensor(LAYOUT, **values)
    assert str(caught.value).startswith(message)


def test_settings_contain_gain_and_dsnu():
    settings = read_settings(demo_settings()[0], ["sensor.gain_dn_per_e=0.4", "sensor.dsnu_e=6"])
    sensor = build_shot(None, settings).camera.sensor

    assert (sensor.gain_dn_per_e, sensor.dsnu_e, sensor.capacitance_f, sensor.pixel_fpn_fraction) == (
        0.4,
        6.0,
        None,
        0.0,
    )
    put_setting(None, settings, "sensor.capacitance_f", 1e-15)
    assert "gain_dn_per_e" not in settings["sensor"]
    settings["sensor"]["gain_dn_per_e"] = 0.4
    with pytest.raises(ConfigError, match=r"^sensor\.gain_dn_per_e: must not be given together with 'capacitance_f'"):
        build_shot(None, settings)
    properties = fs.config.schema()["$defs"]["sensor"]["properties"]
    assert "DN/e-" in properties["gain_dn_per_e"]["description"]
