"""Luminance and illuminance: closed forms, and the tables of colour-science."""

from __future__ import annotations

import math

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.scene.charts import photopic

FLAT = {"shape": (2, 3), "pitch_um": 100.0, "distance_m": 1.0}
VISIBLE_NM = np.arange(380.0, 781.0)
PICTURE = np.array([[255, 0], [128, 255]], np.uint8)


@pytest.fixture(scope="module")
def colour():
    with np.printoptions():  # its import changes them
        return pytest.importorskip("colour")


def test_efficiency_is_that_of_the_cie(colour):
    published = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]

    assert photopic(published.wavelengths[20:421:5]) == pytest.approx(published.values[20:421:5], abs=6e-7)
    assert photopic(VISIBLE_NM).sum() == pytest.approx(106.857, abs=1e-3)
    assert photopic([100.0, 379.0, 781.0, 2000.0]).tolist() == [0.0, 0.0, 0.0, 0.0]


def test_one_watt_is_683_lumen():
    scene = fs.Scene.flat(**FLAT, radiance_w_m2_sr_nm=1.0, wavelength_nm=[555.0], band_width_nm=1.0)

    assert scene.luminance_cd_m2 == pytest.approx(np.full((2, 3), 683.0), rel=1e-12)


def test_luminance_of_daylight_equals_colour_science(colour):
    daylight = colour.SDS_ILLUMINANTS["D65"].copy().align(colour.SpectralShape(380, 780, 5))
    lux = 683.0 * np.sum(daylight.values * photopic(daylight.wavelengths)) * 5.0
    expected = colour.luminous_flux(daylight)
    scene = fs.scene.charts.colour_chart(
        shape=(60, 80), pitch_um=200.0, distance_m=1.0, patch_mm=2.0, wavelength_nm=daylight.wavelengths,
        illuminance_lux=math.pi * lux, n_basis=24,
    )  # fmt: skip
    illumination = scene.spectrum_w_m2_sr_nm / fs.scene.charts.patch_reflectance(daylight.wavelengths)

    assert lux == pytest.approx(expected, rel=2e-4)
    assert illumination == pytest.approx(np.broadcast_to(daylight.values, (24, 81)), rel=5e-4)


@pytest.mark.parametrize("make", ["flat", "sine", "picture"])
@pytest.mark.parametrize("waves_nm", [[550.0], [450.0, 550.0, 620.0]])
def test_white_has_the_luminance_of_its_illuminance(make, waves_nm):
    light = {"wavelength_nm": waves_nm, "band_width_nm": 60.0}

    def luminance(**level):
        if make == "flat":
            return fs.Scene.flat(**FLAT, **light, **level).luminance_cd_m2
        if make == "sine":
            return fs.scene.charts.checkerboard(
                square_mm=2.0, shape=(80, 80), pitch_um=100.0, distance_m=1.0, **light, **level
            ).luminance_cd_m2
        return fs.Scene.from_picture(PICTURE, distance_m=1.0, **light, **level).luminance_cd_m2

    assert luminance(luminance_cd_m2=250.0).max() == pytest.approx(250.0, rel=1e-6)
    assert luminance(illuminance_lux=500.0).max() == pytest.approx(500.0 / math.pi, rel=1e-6)
    assert luminance(illuminance_lux=500.0, reflectance=0.18).max() == pytest.approx(90.0 / math.pi, rel=1e-6)


def test_colour_photograph_has_the_luminance_of_white():
    picture = np.full((2, 2, 3), 255, np.uint8)
    scene = fs.Scene.from_picture(picture, distance_m=1.0, luminance_cd_m2=100.0)
    grey = fs.Scene.from_picture(picture, distance_m=1.0, luminance_cd_m2=100.0, wavelength_nm=[550], band_width_nm=50)

    assert scene.luminance_cd_m2 == pytest.approx(np.full((2, 2), 100.0), rel=1e-6)
    assert grey.luminance_cd_m2 == pytest.approx(np.full((2, 2), 100.0), rel=1e-6)


@pytest.mark.parametrize(
    ("light", "message"),
    [
        ({}, "'peak_radiance_w_m2_sr_nm' must be given, or 'luminance_cd_m2' or 'illuminance_lux' instead"),
        (
            {"peak_radiance_w_m2_sr_nm": 1.0, "illuminance_lux": 1.0},
            "'illuminance_lux' must not be given together with 'peak_radiance_w_m2_sr_nm'",
        ),
        ({"luminance_cd_m2": -1.0}, "'luminance_cd_m2' must be >= 0"),
        ({"luminance_cd_m2": 5.0, "reflectance": 0.5}, "'reflectance' requires 'illuminance_lux', got 0.5"),
        ({"illuminance_lux": 5.0, "reflectance": 1.5}, "'reflectance' must be"),
        (
            {"illuminance_lux": 5.0, "wavelength_nm": [850.0], "band_width_nm": 10.0},
            "'illuminance_lux' must be used with a band between 380 and 780 nm, got .*850.* nm; specify 'peak_rad",
        ),
    ],
)
def test_invalid_light_levels_are_rejected(light, message):
    with pytest.raises(ParameterError, match=message):
        fs.Scene.from_picture(PICTURE, distance_m=1.0, **light)
