"""Confidence intervals over scenes: coverage in resampled scenes, and bounds of order statistics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from effort import examples

import foveasim as fs
from foveasim.compare import median_interval
from foveasim.compare.intervals import format_interval
from foveasim.errors import ParameterError

N_SCENES, N_SAMPLES = examples(120), 20_000
MEASURES_OF_SCENES = ("ssim", "shift_sigma_um", "psnr_db", "snr_mean_db", "information_bit_per_site")


def synthetic_photograph(rng, n=64):
    """Return a picture of amplitude spectrum 1/f, with a contrast that varies as much as in photographs of fog and forest."""
    f = np.hypot(np.fft.fftfreq(n), np.fft.fftfreq(n)[:, np.newaxis])
    f[0, 0] = np.inf
    waves = np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) / f).real
    contrast = 0.1 * np.exp(1.2 * rng.standard_normal())
    return np.uint8(np.clip(np.rint(110.0 * (1.0 + contrast * waves / waves.std())), 0, 255))


@pytest.fixture(scope="module")
def compared():
    rng = np.random.default_rng(7)
    pictures = {f"{k}": synthetic_photograph(rng) for k in range(N_SCENES)}
    layouts = {
        "foveal": fs.layout.log_polar(n_sectors=16, n_rings=6, r_min_um=4.0, r_max_um=40.0),
        "square": fs.layout.grid(n_x=10, size_um=(80.0, 80.0)),
    }
    scenes = fs.compare.photograph_scenes(80.0, pictures=pictures)
    return fs.compare.layouts(layouts, scenes, n_annuli=2, max_pixels=24, tolerance=0.1)


def coverage(population, n):
    """Return the fraction of samples of n scenes whose interval contains the median of all scenes."""
    rng = np.random.default_rng(n)
    samples = population[np.argsort(rng.random((N_SAMPLES, population.size)), axis=1)[:, :n]]
    _, low, high = median_interval(samples)
    return np.mean((low <= np.median(population)) & (np.median(population) <= high))


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 12])
@pytest.mark.parametrize("name", MEASURES_OF_SCENES)
def test_intervals_cover_95_percent(compared, name, n):
    one, other = compared.values[name]

    for population in (one, other, other - one):
        assert 0.93 < coverage(population, n) < 0.97


@pytest.mark.parametrize("draw", ["exponential", "standard_cauchy", "standard_normal", "random"])
@pytest.mark.parametrize("n", [5, 6, 9, 12, 30])
def test_coverage_is_independent_of_distribution(draw, n):
    samples = getattr(np.random.default_rng(3), draw)(size=(N_SAMPLES, n))
    median = {"exponential": np.log(2.0), "random": 0.5}.get(draw, 0.0)

    _, low, high = median_interval(samples)

    assert 0.93 < np.mean((low <= median) & (median <= high)) < 0.965


@pytest.mark.slow
def test_summary_resamples_with_scenes(compared):
    values = {name: array[:, :5] for name, array in compared.values.items() if array.ndim > 1}
    few = dataclasses.replace(compared, values={**compared.values, **values}, scenes=compared.scenes[:5])

    median, low, high = few.summary("shift_sigma_um")

    np.testing.assert_array_equal(median, np.median(values["shift_sigma_um"], axis=1))
    np.testing.assert_array_equal(low, values["shift_sigma_um"].min(axis=1))
    np.testing.assert_array_equal(high, values["shift_sigma_um"].max(axis=1))
    assert few.summary("shift_sigma_um", by_eccentricity=True).low.shape == (2, 2)
    row = few.records()[1]
    assert row["ssim_low"] <= row["ssim"] <= row["ssim_high"]
    assert f"[{low[0]:.3f}, {high[0]:.3f}]" in str(few)


def test_bounds_are_equivariant_under_increasing_maps():
    samples = np.random.default_rng(1).random((4, 5))

    plain, mapped = median_interval(samples), median_interval(np.log(samples))

    np.testing.assert_allclose(np.exp(mapped), plain, rtol=1e-14)


def test_bounds_lie_between_tabulated_order_statistics():
    # Sign test at 95 %: depths 1 of 6, 3 of 12 and 6 of 20, with the next depth below 95 %.
    for n, depth in ((6, 1), (12, 3), (20, 6)):
        _, low, high = median_interval(np.arange(1.0, n + 1.0))

        assert depth < low < depth + 1
        assert low + high == pytest.approx(n + 1.0)


def test_missing_and_infinite_values_are_distinguished():
    median, low, high = median_interval(
        [[1.0, 2.0, 3.0, 4.0, 5.0, np.nan], [1.0, 2.0, 3.0, 4.0, np.inf, np.inf], [1.0, 2.0, 3.0, 4.0, np.nan, np.nan]]
    )

    np.testing.assert_array_equal(median, [3.0, 3.5, 2.5])
    np.testing.assert_array_equal(high[:2], [5.0, np.inf])
    np.testing.assert_array_equal(np.isnan(low), [False, False, True])
    with pytest.raises(ParameterError, match="'values' must have at least one axis"):
        median_interval(3.0)


def test_intervals_are_formatted_with_their_precision():
    assert format_interval(0.00452, 0.00431, 0.00497) == "0.00452 [0.00431, 0.00497]"
    assert format_interval(25.0, 24.0, np.inf) == "25.00 [24.00, ∞]"
    assert format_interval(np.inf, 24.0, np.inf) == "∞"
