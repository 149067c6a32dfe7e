"""Information of Gaussian readings: closed forms, invariance, and the chain rule over neighbours."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy.special import erf, gammaln, ndtri, rel_entr

import foveasim as fs
from foveasim.compare import SceneCovariance, gaussian_information_bits, scene_covariance, site_information_bits
from foveasim.errors import ParameterError


def random_covariance(n, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, n + 2))
    return root @ root.T, rng.uniform(0.5, 2.0, n)


def test_poisson_site_matches_exact_information():
    mean_e = 50.0 + 15.0 * ndtri((np.arange(4000) + 0.5) / 4000)
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
    signal = exact_covariance(small, covariance, 40)

    bits = site_information_bits(small, covariance, small.area_um2, [noise, 2.0 * noise], n_conditions=small.n_sites)

    assert bits.shape == (2, small.n_sites)
    assert bits[0].sum() == pytest.approx(gaussian_information_bits(signal, noise), rel=1e-2)
    assert bits[1].sum() == pytest.approx(gaussian_information_bits(signal, 2.0 * noise), rel=1e-2)


def test_neighbours_bound_information_from_above(covariance):
    layout = fs.layout.grid(18, 18, 1.0)
    noise = np.ones((1, layout.n_sites))
    totals = [
        site_information_bits(layout, covariance, layout.area_um2, noise, n_conditions=m).sum()
        for m in (0, 8, 32, 160, layout.n_sites)
    ]

    assert all(np.diff(totals) < 0.0)
    assert totals[3] == pytest.approx(totals[4], rel=5e-3)
    assert totals[0] > 1.2 * totals[4]


def covariance_of_squares(layout, side_um, covariance):
    """Return the covariances of means over axis-parallel squares in closed form."""
    total = 0.0
    for amplitude, sigma in zip(covariance.amplitude, covariance.sigma_um, strict=True):

        def integral(u, s=sigma):
            return s**2 * np.exp(-0.5 * (u / s) ** 2) + u * s * np.sqrt(np.pi / 2.0) * erf(u / s / np.sqrt(2.0))

        axes = []
        for x in layout.centroid_um.T:
            d = x[:, np.newaxis] - x
            axes.append((integral(d + side_um) - 2.0 * integral(d) + integral(d - side_um)) / side_um**2)
        total = total + amplitude * axes[0] * axes[1]
    return total


@pytest.mark.slow(keep=("-2.0-", "-8.0-", "-32.0-1000"))
@pytest.mark.parametrize(
    ("side_um", "snr"),
    [(1.0, 10.0), (2.0, 1000.0), (4.0, 10.0), (8.0, 1000.0), (16.0, 10.0), (32.0, 1000.0), (1.0, 1000.0), (32.0, 10.0)],
)
@pytest.mark.parametrize("sigma_um", [(3.0,), (1.5, 6.0, 24.0)])
def test_information_of_squares_matches_closed_form(sigma_um, side_um, snr):
    layout = fs.layout.grid(20, 20, side_um)
    scenes = SceneCovariance(np.ones(len(sigma_um)), np.array(sigma_um))
    signal = covariance_of_squares(layout, side_um, scenes)
    noise = np.full(layout.n_sites, signal[0, 0] / snr)

    bits = site_information_bits(layout, scenes, np.ones(layout.n_sites), [noise])

    assert bits.sum() == pytest.approx(gaussian_information_bits(signal, noise), rel=1e-2)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("sigma_um", [1.0, 2.0, 5.0])
@pytest.mark.parametrize(
    ("vertices_um", "tolerance"),
    [
        ([(-2.0, -2.0), (4.0, 0.0), (-1.0, 4.0)], 3e-2),
        ([(-5.0, -1.5), (4.0, -2.5), (5.0, 1.0), (-3.0, 2.0)], 1e-2),
        ([(0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (3.0, 3.0), (3.0, 6.0), (0.0, 6.0)], 3e-2),
    ],
)
def test_single_site_matches_integrated_covariance(vertices_um, tolerance, sigma_um):
    layout = fs.Layout.from_polygons([shapely.Polygon(vertices_um)])
    scenes = SceneCovariance(np.array([1.0]), np.array([sigma_um]))
    signal = exact_covariance(layout, scenes, 60)

    bits = site_information_bits(layout, scenes, layout.area_um2, signal / 10.0)

    assert bits.sum() == pytest.approx(0.5 * np.log2(11.0), rel=tolerance)


def gaussian_field(rng, sigma_um, n, pitch_um):
    """Return a periodic field of variance 1 with a Gaussian covariance, at points."""
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(n, pitch_um), np.fft.fftfreq(n, pitch_um)))
    root = np.sqrt(2.0 * np.pi) * sigma_um / pitch_um * np.exp(-np.square(np.pi * sigma_um * f))
    return np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) * root).real


@pytest.fixture(scope="module")
def fields():
    """Return four periodic fields with a standard deviation of the covariance of 2 µm, in cells of 0.25 µm."""
    rng = np.random.default_rng(11)
    return np.array([gaussian_field(rng, 2.0, 1200, 0.25)[:1120, :1120] for _ in range(4)])


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("side_um", "n_pixels"), [(1.0, (2, 4)), (2.0, (1, 2, 4, 8)), (4.0, (2, 4, 8)), (16.0, (8, 16))]
)
def test_information_is_independent_of_image_pixels(side_um, n_pixels, fields):
    # Means over fine cells are those of points: 1/6 of their width is 1 % of the field's.
    layout = fs.layout.grid(12, 12, side_um)
    signal = covariance_of_squares(layout, side_um, SceneCovariance(np.array([1.0]), np.array([2.0])))
    noise = np.full(layout.n_sites, 0.01 * signal[0, 0])
    expected = gaussian_information_bits(signal, noise)

    for n in n_pixels:
        cells = round(4.0 * side_um / n)
        means = fields.reshape(4, 1120 // cells, cells, 1120 // cells, cells).mean(axis=(2, 4))
        found = scene_covariance(means, 0.25 * cells)
        bits = site_information_bits(layout, found, np.ones(layout.n_sites), [noise])

        assert bits.sum() == pytest.approx(expected, rel=1e-2), n


def test_unknown_pixels_leave_covariance_unchanged():
    image = gaussian_field(np.random.default_rng(12), 3.0, 400, 1.0)[np.newaxis]
    masked = image.copy()
    masked[:, :60, :90] = np.nan

    complete, partial = scene_covariance(image, 1.0), scene_covariance(masked, 1.0)

    distance_um = np.array([0.0, 2.0, 5.0])
    np.testing.assert_allclose(partial.at(distance_um), complete.at(distance_um), rtol=0.05)


def test_uniform_images_have_no_covariance():
    found = scene_covariance(np.full((2, 40, 30), 7.0), 1.0)

    np.testing.assert_allclose(found.at([0.0, 3.0]), 0.0, atol=1e-20)


def test_unknown_images_do_not_change_covariance():
    images = np.random.default_rng(0).random((3, 64, 64))
    unknown = np.concatenate((np.full((1, 64, 64), np.nan), images))

    np.testing.assert_allclose(
        scene_covariance(unknown, 1.0).at([0.0, 2.0]), scene_covariance(images, 1.0).at([0.0, 2.0])
    )


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
