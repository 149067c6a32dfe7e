"""Image similarity: closed forms, scikit-image as reference, and uncovered pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import skimage

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.metrics import psnr_db, ssim
from foveasim.reconstruct import Picture

RNG = np.random.default_rng(1)
TRUTH = RNG.uniform(0.0, 1.0, (40, 50))
NOISY = TRUTH + RNG.normal(0.0, 0.05, TRUTH.shape)


def picture(data, coverage=1.0, pitch_um=1.0):
    data = np.atleast_3d(np.moveaxis(np.atleast_3d(data), -1, 0))
    return Picture(data, np.broadcast_to(np.float32(coverage), data.shape[1:]), fs.Grid(data.shape[1:], pitch_um))


def test_psnr_of_constant_difference():
    assert psnr_db(TRUTH + 0.01, TRUTH, 1.0) == pytest.approx(40.0)
    assert psnr_db(3.0 * TRUTH + 0.3, 3.0 * TRUTH, 3.0) == pytest.approx(20.0)


def test_psnr_matches_scikit_image():
    assert psnr_db(NOISY, TRUTH, 1.0) == pytest.approx(
        skimage.metrics.peak_signal_noise_ratio(TRUTH, NOISY, data_range=1.0)
    )
    assert psnr_db(NOISY, TRUTH) == pytest.approx(psnr_db(NOISY, TRUTH, float(np.ptp(TRUTH))))


def test_identical_pictures_have_infinite_psnr():
    assert psnr_db(TRUTH, TRUTH) == math.inf
    assert ssim(TRUTH, TRUTH) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [np.nan, 1e9])
def test_psnr_excludes_uncovered_pixels(wrong):
    is_hole = np.hypot(*np.meshgrid(np.arange(50) - 25, np.arange(40) - 20)) < 8
    measured = np.where(is_hole, wrong, NOISY)
    expected = 10 * np.log10(1.0 / np.mean((NOISY - TRUTH)[~is_hole] ** 2))

    assert psnr_db(picture(measured, ~is_hole), TRUTH[np.newaxis], 1.0) == pytest.approx(expected)


def test_ssim_uses_fully_covered_windows():
    is_hole = np.zeros(TRUTH.shape, bool)
    is_hole[10:15, 20:30] = True
    full = skimage.metrics.structural_similarity(NOISY, TRUTH, win_size=7, data_range=1.0, full=True)[1]
    counts = np.zeros_like(is_hole)
    counts[3:-3, 3:-3] = True
    counts[7:18, 17:33] = False

    assert ssim(np.where(is_hole, np.nan, NOISY), TRUTH, 1.0) == pytest.approx(full[counts].mean(), abs=1e-12)


def test_ssim_matches_scikit_image():
    for n, options in ((7, {}), (3, {"window": 3}), (11, {"window": 11})):
        expected = skimage.metrics.structural_similarity(NOISY, TRUTH, win_size=n, data_range=1.0)

        assert ssim(NOISY, TRUTH, 1.0, **options) == pytest.approx(expected, rel=1e-6)


def test_min_coverage_selects_partly_covered_pixels():
    coverage = np.full(TRUTH.shape, 0.7)
    measured = picture(NOISY, coverage)

    assert psnr_db(measured, TRUTH[np.newaxis]) == pytest.approx(psnr_db(NOISY, TRUTH))
    with pytest.raises(ParameterError, match="'picture' must have at least one pixel in common with the reference"):
        psnr_db(measured, TRUTH[np.newaxis], min_coverage=1.0)


def test_psnr_averages_channels_equally():
    colour = np.stack((TRUTH, TRUTH, TRUTH))
    measured = colour + np.array([0.1, 0.0, 0.0])[:, None, None]

    assert psnr_db(measured, colour, 1.0) == pytest.approx(20.0 + 10 * np.log10(3.0))


@pytest.mark.parametrize("wrong", [np.inf, -np.inf])
def test_infinite_pixel_raises(wrong):
    """Infinite pixels of a diverged reconstruction are not excluded like uncovered pixels."""
    diverged = TRUTH.copy()
    diverged[3, 4:7] = wrong
    is_seen = np.isfinite(diverged)

    for score in (psnr_db, ssim):
        with pytest.raises(
            ParameterError, match="'picture' must be finite, got infinity in 3 of 2,000 compared pixels"
        ):
            score(diverged, TRUTH, 1.0)
        with pytest.raises(
            ParameterError, match="'reference' must be finite, got infinity in 3 of 2,000 compared pixels"
        ):
            score(TRUTH, diverged, 1.0)
    assert psnr_db(picture(np.where(is_seen, TRUTH + 0.1, wrong), is_seen), TRUTH[np.newaxis], 1.0) == pytest.approx(
        20.0
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: psnr_db(TRUTH, TRUTH[1:]), "'reference' must have the same shape as the picture"),
        (lambda: psnr_db(TRUTH[0], TRUTH[0]), r"'picture' must have shape \(\.\.\., n_y, n_x\)"),
        (lambda: psnr_db(NOISY, np.ones_like(TRUTH)), "'data_range' must be given"),
        (lambda: psnr_db(NOISY, TRUTH, -1.0), "'data_range' must be > 0"),
        (
            lambda: psnr_db(picture(TRUTH), picture(TRUTH, pitch_um=2.0)),
            "'reference' must have the same grid as the picture",
        ),
        (lambda: ssim(NOISY, TRUTH, window=4), "'window' must be odd"),
        (lambda: ssim(NOISY, TRUTH, window=51), "'window' must fit within the compared pixels"),
    ],
)
def test_invalid_comparison_raises(call, message):
    with pytest.raises(ParameterError, match=message):
        call()
