"""Constants and unit conversions against published values of the SI and of image sensors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants

from foveasim import units
from foveasim.errors import ParameterError


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("PLANCK_J_S", scipy.constants.h),
        ("LIGHT_SPEED_M_PER_S", scipy.constants.c),
        ("ELEMENTARY_CHARGE_C", scipy.constants.e),
        ("BOLTZMANN_J_PER_K", scipy.constants.k),
    ],
)
def test_constants_equal_si_values(name, published):
    assert getattr(units, name) == published


@pytest.mark.parametrize(
    ("convert", "length", "converted"),
    [
        (units.m_from_nm, 550.0, 5.5e-7),
        (units.per_um_from_per_mm, 125.0, 0.125),
        (units.per_mm_from_per_um, 0.125, 125.0),
        (units.m_from_um, 2.2, 2.2e-6),
        (units.m_from_mm, 22.0, 0.022),
        (units.um_from_m, 0.56, 560_000.0),
        (units.um_from_nm, 550.0, 0.55),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_lengths_are_converted_between_units(convert, length, converted):
    assert math.isclose(convert(length), converted, rel_tol=1e-15)


def test_integrated_irradiance_is_converted_to_watts():
    square_metre_um2 = 1e12
    assert math.isclose(units.w_from_w_m2_um2(1000.0 * square_metre_um2), 1000.0, rel_tol=1e-15)


@pytest.mark.parametrize(
    ("wavelength_nm", "energy_ev"),
    [
        (1239.841984, 1.0),  # CODATA 2018: h c = 1.239841984e-6 eV m
        (619.920992, 2.0),
        (632.8, 1.959295),  # helium-neon laser
    ],
)
def test_photon_energy_matches_published_values(wavelength_nm, energy_ev):
    assert math.isclose(units.photon_energy_j(wavelength_nm) / scipy.constants.e, energy_ev, rel_tol=5e-7)


def test_watt_at_550_nm_is_277e16_photons():
    assert math.isclose(1.0 / units.photon_energy_j(550.0), 2.76876e18, rel_tol=2e-6)


def test_electron_on_femtofarad_gives_160_microvolts():
    assert math.isclose(units.electrons_to_volts(1.0, 1e-15), 160.2e-6, rel_tol=5e-4)


def test_voltage_on_capacitance_gives_published_charge():
    assert math.isclose(units.volts_to_electrons(3.0, 1e-13), 1.87e6, rel_tol=5e-3)


@pytest.mark.parametrize(("capacitance_f", "noise_e"), [(1e-15, 12.70), (1e-13, 127.0), (4.8e-13, 278.3)])
def test_reset_noise_matches_published_values(capacitance_f, noise_e):
    noise_v = math.sqrt(units.BOLTZMANN_J_PER_K * 300.0 / capacitance_f)
    assert abs(units.volts_to_electrons(noise_v, capacitance_f) - noise_e) < 0.05


def test_charge_voltage_conversion_is_invertible():
    charge_e = np.array([0.0, 1.0, 7314.0, 1.87e6])
    capacitance_f = np.array([1e-15, 4.8e-13, 1e-13, 1e-13])
    again_e = units.volts_to_electrons(units.electrons_to_volts(charge_e, capacitance_f), capacitance_f)
    np.testing.assert_allclose(again_e, charge_e, rtol=4 * np.finfo(float).eps)


def test_voltage_is_inversely_proportional_to_capacitance():
    voltage_v = units.electrons_to_volts(1000.0, np.array([1e-14, 2e-14]))
    assert voltage_v[0] == 2.0 * voltage_v[1]


def test_srgb_encoding_equals_that_of_scikit_image():
    from skimage.color import rgb2xyz

    encoded = np.linspace(0.0, 1.0, 256)
    grey = np.repeat(encoded[:, np.newaxis], 3, axis=1)
    luminance = rgb2xyz(grey)[:, 1]

    assert units.decode_srgb(encoded) == pytest.approx(luminance, abs=1e-6)
    assert units.encode_srgb(units.decode_srgb(encoded)) == pytest.approx(encoded, abs=1e-6)
    assert units.encode_srgb(np.float32([0.5])).dtype == np.float32


@pytest.mark.parametrize("convert", [units.encode_srgb, units.decode_srgb])
def test_negative_radiance_is_rejected(convert):
    with pytest.raises(ParameterError, match=r"'value' must be >= 0, got -0\.1"):
        convert([0.5, -0.1])
