"""Information of Gaussian readings: closed forms, invariance, and the chain rule over neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammaln, rel_entr
from scipy.stats import norm

import foveasim as fs
from foveasim.compare import SceneCovariance, gaussian_information_bits, scene_covariance, site_information_bits
from foveasim.errors import ParameterError


def random_covariance(n, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, n + 2))
    return root @ root.T, rng.uniform(0.5, 2.0, n)


def test_poisson_site_matches_exact_information():
    mean_e = norm.ppf((np.arange(4000) + 0.5) / 4000, 50.0, 15.0)
    mean_e = mean_e[mean_e > 0.5]
    counts = np.arange(0, 400)
    probability = np.exp(counts * np.log(mean_e[:, np.newaxis]) - mean_e[:, np.newaxis] - gammaln(counts + 1.0))
    marginal = probability.mean(axis=0)
    exact = rel_entr(probability, marginal).sum() / np.log(2.0) / mean_e.size

    estimate = gaussian_information_bits([[mean_e.var()]], mean_e[:, np.newaxis])

    assert exact == pytest.approx(1.263, abs=1e-3)
    # The estimate neglects that the readings are not Gaussian.
    assert 0.0 < estimate - exact < 5e-3


def test_information_is_log_determinant():
    signal, noise = random_covariance(7)
    eigenvalues = np.linalg.eigvalsh(signal / np.sqrt(noise) / np.sqrt(noise)[:, np.newaxis])

    assert gaussian_information_bits(signal, noise) == pytest.approx(0.5 * np.log2(1.0 + eigenvalues).sum(), rel=1e-12)


def test_information_is_invariant_under_maps():
    signal, noise = random_covariance(6, seed=1)
    mixing = np.random.default_rng(2).standard_normal((6, 6))

    mapped = gaussian_information_bits(mixing @ signal @ mixing.T, noise_covariance=mixing @ np.diag(noise) @ mixing.T)

    assert mapped == pytest.approx(gaussian_information_bits(signal, noise), rel=1e-10)


def test_merging_readings_never_adds_information():
    signal, noise = random_covariance(8, seed=3)
    merge = np.kron(np.eye(4), np.ones((1, 2)))

    merged = gaussian_information_bits(merge @ signal @ merge.T, merge @ noise)

    assert 0.0 < merged < gaussian_information_bits(signal, noise)


def test_independent_sites_add_their_information():
    signal = np.diag([3.0, 15.0, 0.0])

    assert gaussian_information_bits(signal, np.ones(3)) == pytest.approx(0.5 * np.log2(4.0) + 0.5 * np.log2(16.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[1.0]],), "'noise_variance' or 'noise_covariance' must be given"),
        (([[1.0, 0.0]], [1.0]), "'signal_covariance' must be square"),
        (([[1.0]], [1.0, 2.0]), r"'noise_variance' must have the shape \(1,\)"),
        (([[1.0]], [0.0]), "'noise_variance' must be > 0"),
        (([[1.0, 3.0], [3.0, 1.0]], [0.1, 0.1]), "'signal_covariance' must be positive definite"),
    ],
)
def test_invalid_covariances_are_explained(arguments, message):
    with pytest.raises(ParameterError, match=message):
        gaussian_information_bits(*arguments)


def exact_covariance(layout, covariance, n_fine):
    """Integrate the covariance over pairs of sites with the exact overlaps of a fine grid."""
    x0, y0, x1, _ = layout.bounds_um
    grid = fs.Grid((n_fine, n_fine), (x1 - x0) / n_fine, (x0, y0))
    weights = fs.Integrator(layout, grid).weights().toarray()
    x, y = (part.ravel() for part in np.meshgrid(grid.x_um, grid.y_um))
    points = covariance.at(np.hypot(x[:, np.newaxis] - x, y[:, np.newaxis] - y))
    return weights @ points @ weights.T


@pytest.fixture(scope="module")
def small():
    return fs.layout.log_polar(n_sectors=8, r_min_um=2.0, r_max_um=12.0, n_rings=4)


@pytest.fixture(scope="module")
def covariance():
    return SceneCovariance(np.array([40.0, 90.0]), np.array([3.0, 10.0]))


def test_site_information_matches_determinant(small, covariance):
    noise = small.area_um2 * np.linspace(1.0, 3.0, small.n_sites)
    signal = exact_covariance(small, covariance, 60)

    bits = site_information_bits(small, covariance, small.area_um2, [noise, 2.0 * noise], n_conditions=small.n_sites)

    assert bits.shape == (2, small.n_sites)
    assert bits[0].sum() == pytest.approx(gaussian_information_bits(signal, noise), rel=1e-2)
    assert bits[1].sum() == pytest.approx(gaussian_information_bits(signal, 2.0 * noise), rel=1e-2)


def test_neighbours_bound_information_from_above(small, covariance):
    noise = [small.area_um2]
    totals = [
        site_information_bits(small, covariance, small.area_um2, noise, n_conditions=m).sum()
        for m in (0, 2, 6, 14, small.n_sites)
    ]

    assert all(np.diff(totals) <= 1e-9)
    assert totals[3] == pytest.approx(totals[4], rel=5e-3)
    assert totals[0] > 1.3 * totals[4]


def test_covariance_of_means_matches_gaussians():
    covariance = SceneCovariance(np.array([2.0]), np.array([3.0]))
    spread_um2 = np.array([4.0, 1.0, 0.5])
    s = np.array([[4.0, 0.5], [0.5, 1.0]])
    d = np.array([1.0, -2.0])
    expected = (
        2.0
        * 9.0
        / np.sqrt(np.linalg.det(s + 9.0 * np.eye(2)))
        * np.exp(-0.5 * d @ np.linalg.solve(s + 9.0 * np.eye(2), d))
    )

    assert covariance.of_means(d, spread_um2) == pytest.approx(expected)


def test_scene_covariance_recovers_its_model():
    rng, n, sigma = np.random.default_rng(4), 128, 6.0
    f = np.hypot(np.fft.fftfreq(n), np.fft.fftfreq(n)[:, np.newaxis])
    shape = np.exp(-2.0 * (np.pi * f * sigma / np.sqrt(2.0)) ** 2)
    images = np.array([np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) * shape).real for _ in range(40)])
    images *= 3.0 / images.std()

    found = scene_covariance(10.0 + images, 2.0)

    distance_um = np.array([0.0, 6.0, 12.0, 24.0])
    expected = 9.0 * np.exp(-0.5 * (distance_um / (2.0 * sigma)) ** 2)
    np.testing.assert_allclose(found.at(distance_um), expected, atol=0.6)
