"""Constants and conversions against the published numbers of the SI and of image sensors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants

from foveasim import units


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("PLANCK_J_S", scipy.constants.h),
        ("LIGHT_SPEED_M_PER_S", scipy.constants.c),
        ("ELEMENTARY_CHARGE_C", scipy.constants.e),
        ("BOLTZMANN_J_PER_K", scipy.constants.k),
    ],
)
def test_constants_are_those_of_the_si(name, published):
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
def test_lengths_keep_their_size_in_another_unit(convert, length, converted):
    assert math.isclose(convert(length), converted, rel_tol=1e-15)


def test_a_kilowatt_per_square_metre_on_a_square_metre_is_a_kilowatt():
    square_metre_um2 = 1e12
    assert math.isclose(units.w_from_w_m2_um2(1000.0 * square_metre_um2), 1000.0, rel_tol=1e-15)


@pytest.mark.parametrize(
    ("wavelength_nm", "energy_ev"),
    [
        (1239.841984, 1.0),  # CODATA 2018: h c = 1.239841984e-6 eV m
        (619.920992, 2.0),
        (632.8, 1.959295),  # the helium-neon laser
    ],
)
def test_photon_energy_in_electronvolts_is_the_published_one(wavelength_nm, energy_ev):
    assert math.isclose(units.photon_energy_j(wavelength_nm) / scipy.constants.e, energy_ev, rel_tol=5e-7)


def test_a_watt_of_green_light_is_2_77e18_photons_a_second():
    assert math.isclose(1.0 / units.photon_energy_j(550.0), 2.76876e18, rel_tol=2e-6)


def test_an_electron_on_a_femtofarad_makes_160_microvolts():
    assert math.isclose(units.electrons_to_volts(1.0, 1e-15), 160.2e-6, rel_tol=5e-4)


def test_three_volts_on_a_tenth_of_a_picofarad_hold_1_87_million_electrons():
    assert math.isclose(units.volts_to_electrons(3.0, 1e-13), 1.87e6, rel_tol=5e-3)


@pytest.mark.parametrize(("capacitance_f", "noise_e"), [(1e-15, 12.70), (1e-13, 127.0), (4.8e-13, 278.3)])
def test_reset_noise_at_room_temperature_is_the_published_one(capacitance_f, noise_e):
    noise_v = math.sqrt(units.BOLTZMANN_J_PER_K * 300.0 / capacitance_f)
    assert abs(units.volts_to_electrons(noise_v, capacitance_f) - noise_e) < 0.05


def test_charge_becomes_voltage_and_voltage_the_same_charge():
    charge_e = np.array([0.0, 1.0, 7314.0, 1.87e6])
    capacitance_f = np.array([1e-15, 4.8e-13, 1e-13, 1e-13])
    again_e = units.volts_to_electrons(units.electrons_to_volts(charge_e, capacitance_f), capacitance_f)
    np.testing.assert_allclose(again_e, charge_e, rtol=4 * np.finfo(float).eps)


def test_equal_charges_on_double_the_capacitance_make_half_the_voltage():
    voltage_v = units.electrons_to_volts(1000.0, np.array([1e-14, 2e-14]))
    assert voltage_v[0] == 2.0 * voltage_v[1]
