"""Cached OTF tables: threads that use them at the same time, and the memory limit."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import foveasim as fs
from foveasim.optics import Zernike, circular_otf
from foveasim.optics.otf import PlaneTables, RadialTables

WAVELENGTH_NM = np.array([450.0, 550.0, 650.0])
LENS = fs.Optics(focal_length_mm=8.0, f_number=8.0, zernike=Zernike(coefficients={4: 0.02}))
SCENE = fs.Scene.flat(
    shape=(8, 8), pitch_um=100.0, distance_m=1.0, radiance_w_m2_sr_nm=0.05, wavelength_nm=tuple(WAVELENGTH_NM)
)


@pytest.fixture
def tables(monkeypatch):
    """Return tables whose limit is two sums."""
    found = PlaneTables(LENS.aperture(SCENE), WAVELENGTH_NM, 8e-3 * WAVELENGTH_NM, [(0.0, 0.0)], np.float64)
    table, _ = found(np.ones(3))
    monkeypatch.setattr("foveasim.optics.otf.MAX_TABLE_SIZE", 2 * table.size)
    return found


@pytest.mark.slow
def test_threads_receive_their_own_sums(tables):
    weights = np.eye(3)[np.random.default_rng(0).integers(0, 3, 16)] + 0.5
    expected = [tables(weight)[0].copy() for weight in weights]
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda weight: tables(weight)[0], weights))
            sizes = list(pool.map(lambda weight: (tables(weight), tables.size)[1], weights))
    finally:
        sys.setswitchinterval(interval_s)

    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    assert max(sizes) <= 3 * expected[0].size


def test_sums_of_others_may_displace_those_requested(tables, monkeypatch):
    """As when another thread computes its sums just before this one reads its own."""
    compute = PlaneTables._compute

    def compute_and_wait(self, weights):
        found = compute(self, weights)
        for other in (2.0 * np.ones(3), 3.0 * np.ones(3)):
            compute(self, [other])
        return found

    expected, _ = tables(np.eye(3)[0])
    tables(np.eye(3)[1])
    tables(np.eye(3)[2])
    monkeypatch.setattr(PlaneTables, "_compute", compute_and_wait)

    np.testing.assert_array_equal(tables(np.eye(3)[0])[0], expected)


def test_prepared_sums_are_limited_with_cached_ones(tables):
    table, _ = tables(np.eye(3)[0])
    tables.prepare([*np.eye(3), np.ones(3)])

    assert tables.size <= 2 * table.size


def test_prepared_sums_are_limited(tables):
    tables.prepare([*np.eye(3), np.ones(3)])
    table, _ = tables(np.eye(3)[2])

    assert tables.size <= 2 * table.size
    np.testing.assert_allclose(
        sum(tables(weight)[0] for weight in np.eye(3)), tables(np.ones(3))[0], rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_lower_cutoff_is_sampled_as_finely(real):
    """Reference: the closed form; with eight times as coarse a table, linear interpolation is 30 times less accurate."""
    low, high = 0.1, 0.8
    errors = []
    for cutoffs in ([low], [low, high]):
        table, steps_per_f = RadialTables(np.array(cutoffs), real)(np.array([1.0, 0.0][: len(cutoffs)]))
        f = np.random.default_rng(0).uniform(0.0, low, 20_000)
        found = np.interp(f * steps_per_f, np.arange(len(table)), table)
        errors.append(np.abs(found - circular_otf(f / low)).max())

    assert errors[1] < 4.0 * errors[0]
