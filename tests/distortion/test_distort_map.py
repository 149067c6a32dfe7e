"""Distorted maps: conservation, orientation, agreement with OpenCV's remap and undistorted outlines."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import foveasim as fs
from foveasim.distortion import BrownConrady, Fisheye, PolynomialFisheye, Scaramuzza, distort_map
from foveasim.errors import ParameterError

PLAIN = BrownConrady(focal_um=200.0)
BARREL = BrownConrady(focal_um=200.0, k1=-0.12, k2=0.02, p1=0.03, p2=-0.02)
PINCUSHION = BrownConrady(focal_um=200.0, k1=0.15)
LENSES = {
    "barrel": BARREL,
    "pincushion": PINCUSHION,
    "off centre": BrownConrady(focal_um=(200.0, 210.0), k1=-0.2, centre_um=(9.0, -4.0)),
    "equidistant": Fisheye(projection="equidistant", focal_um=80.0),
    "polynomial": PolynomialFisheye(focal_um=90.0, k=(-0.05, 0.01, 0.0, 0.0)),
    "Scaramuzza": Scaramuzza(a=(157.0, -2.75e-3, 0.0, 0.0), pixel_um=1.0, focal_um=157.0),
}
#: Letter without symmetry, top row first.
F = np.array(
    [
        [0, 0, 0, 0, 0],
        [0, 1, 1, 1, 0],
        [0, 1, 0, 0, 0],
        [0, 1, 1, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, 0, 0, 0],
    ]
)


def blob(grid, x0=8.0, y0=-5.0, width=11.0):
    """Gaussian blob, negligible at the map boundary."""
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    return np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width**2))


def power_map(data, grid):
    data = np.asarray(data)
    return fs.PowerMap(
        data if data.ndim == 3 else data[np.newaxis], grid, np.full(1 if data.ndim == 2 else len(data), 550.0)
    )


def centroid_of(light, grid):
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    return (light * x).sum() / light.sum(), (light * y).sum() / light.sum()


@pytest.mark.parametrize("order", range(6))
@pytest.mark.parametrize("conserve", ["flux", "density"])
def test_ideal_lens_leaves_map_unchanged(conserve, order):
    grid = fs.Grid((37, 53), 0.7, (-11.0, 3.3))
    light = power_map(np.random.default_rng(1).random((2, 37, 53)), grid)

    same = distort_map(light, PLAIN, conserve=conserve, order=order)

    assert same.grid == grid
    # Errors: 1e-11 of the coefficients of order 5; 1e-13 of the Jacobian, from coordinates of 20 µm and steps of 0.7 µm.
    np.testing.assert_allclose(same.data, light.data, rtol=1e-9, atol=1e-10)
    assert np.array_equal(same.wavelength_nm, light.wavelength_nm)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_uniform_map_stays_uniform_for_density(lens):
    light = power_map(np.full((80, 120), 3.0, np.float32), fs.Grid.centred((80, 120), 1.0))

    warped = distort_map(light, lens, conserve="density")

    assert warped.data.dtype == np.float32
    assert np.all(np.isin(warped.data, (0.0, 3.0)))
    assert (warped.data == 3.0).mean() > 0.6


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_default_grid_encloses_distorted_map_tightly(lens):
    grid = fs.Grid.centred((80, 120), 1.0)

    warped = distort_map(power_map(np.ones((80, 120)), grid), lens)
    x0, y0, x1, y1 = warped.grid.bounds_um
    edges = np.linspace(-1.0, 1.0, 201)
    boundary = np.array([(60 * a, 40 * b) for e in edges for a, b in ((e, 1), (e, -1), (1, e), (-1, e))])
    real = lens.distort(boundary)

    assert np.all(real >= np.array([x0, y0]) - 1e-6)
    assert np.all(real <= np.array([x1, y1]) + 1e-6)
    assert np.all(real.min(axis=0) - (x0, y0) < 1.0)
    assert np.all((x1, y1) - real.max(axis=0) < 1.0)
    # Aligned with the cell edges of the map.
    np.testing.assert_allclose(np.array(warped.grid.origin_um) % 1.0, 0.0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("order", [1, 3])
def test_blob_power_converges_with_cell_size(lens, order):
    errors = []
    for n in (30, 60, 120):
        grid = fs.Grid.centred((2 * n, 3 * n), 40.0 / n)
        light = blob(grid)
        warped = distort_map(power_map(light, grid), lens, order=order)
        errors.append(abs(warped.data.sum() / light.sum() - 1.0))

    # The sum over a blob is exact except at the boundary; distortion and interpolation have second-order errors.
    assert errors[-1] < (2e-4 if order == 1 else 5e-5)
    assert errors[-1] < max(errors[0] / 3.5, 3e-5)


def test_conserving_density_changes_total_power():
    grid = fs.Grid.centred((120, 180), 0.7)
    light = blob(grid)

    warped = distort_map(power_map(light, grid), PINCUSHION, conserve="density")

    assert warped.data.sum() / light.sum() > 1.004


def max_relative_difference(n, conserve):
    """Return the largest relative difference between distorted map and undistorted outlines, for cells of 40 µm / n."""
    layout = fs.layout.tiling(pitch_um=6.0, radius_um=25.0)
    grid = fs.Grid.centred((2 * n, 3 * n), 40.0 / n)
    light = power_map(blob(grid, x0=0.0, y0=0.0, width=30.0), grid)
    undistorted = fs.Integrator(layout, grid, distortion=BARREL, conserve=conserve)(light.data)[0]
    warped = distort_map(light, BARREL, conserve=conserve)
    return np.abs(fs.Integrator(layout, warped.grid)(warped.data)[0] / undistorted - 1.0).max()


def test_distorted_map_converges_to_undistorted_outlines():
    errors = [max_relative_difference(n, "flux") for n in (20, 40, 80, 160, 320)]

    assert errors[-1] < 2e-5
    # Between first order (cells cut by outlines) and second order (interpolation).
    assert all(fine < coarse / 1.8 for coarse, fine in pairwise(errors))


def test_density_agrees_with_undistorted_outlines_approximately():
    # The integrator uses one area ratio per site; across a site the Jacobian changes by p / f, the density by p / width.
    assert max_relative_difference(80, "density") < 0.12 * 6.0 / 200.0 * 6.0 / 30.0


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_letter_stays_upright(lens):
    letter = np.kron(F, np.ones((12, 12)))
    light = fs.PowerMap.from_array(letter, pitch_um=1.0, wavelength_nm=550.0, top_row_first=True)

    warped = distort_map(light, lens, grid=light.grid, conserve="density", order=0)
    cells = warped.data[0].reshape(7, 12, 5, 12).mean(axis=(1, 3))[::-1]

    assert np.array_equal(cells > 0.5, F == 1)


def test_barrel_contracts_and_pincushion_expands_corners():
    grid = fs.Grid.centred((160, 240), 0.5)
    sizes = {
        name: distort_map(power_map(np.ones(grid.shape), grid), LENSES[name]).grid for name in ("barrel", "pincushion")
    }

    corner = BrownConrady(focal_um=200.0, k1=-0.12).distort([[60.0, 40.0]])[0]
    only_k1 = distort_map(power_map(np.ones(grid.shape), grid), BrownConrady(focal_um=200.0, k1=-0.12))
    lit = only_k1.data[0] > 0.0
    # Barrel distortion moves the corners of the boundary further inwards than the midpoints of the sides.
    assert corner[0] < only_k1.grid.bounds_um[2]
    assert not lit[-1, -1]
    assert lit[-1, lit.shape[1] // 2]
    assert sizes["pincushion"].shape[0] > grid.shape[0]


@pytest.mark.parametrize(("p1", "p2", "axis"), [(0.05, 0.0, 1), (0.0, 0.05, 0)], ids=["p1 up", "p2 right"])
def test_tangential_distortion_shifts_along_its_axis(p1, p2, axis):
    grid = fs.Grid.centred((161, 161), 1.0)
    dots = sum(blob(grid, x0=x, y0=y, width=4.0) for x, y in ((40, 0), (-40, 0), (0, 40), (0, -40)))
    lens = BrownConrady(focal_um=200.0, p1=p1, p2=p2)

    moved = centroid_of(distort_map(power_map(dots, grid), lens).data[0], distort_map(power_map(dots, grid), lens).grid)

    # x_d = x + p2 (r² + 2 x²), y_d = y + p1 (r² + 2 y²) in focal lengths: the mean shift of the four blobs is 2 p r² f.
    assert moved[axis] == pytest.approx(2.0 * 0.05 * (40.0 / 200.0) ** 2 * 200.0, rel=0.03)
    assert abs(moved[1 - axis]) < 1e-3


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_distorted_map_equals_opencv_remap(lens):
    cv2 = pytest.importorskip("cv2")
    grid = fs.Grid.centred((96, 128), 0.9)
    light = np.random.default_rng(2).random((1, 96, 128)).astype(np.float32)
    warped = distort_map(power_map(light, grid), lens, grid=grid, conserve="density")

    # OpenCV convention: rows from the top, source pixel positions for each pixel.
    x_um = (np.arange(128) - 63.5) * 0.9
    y_um = (47.5 - np.arange(96)) * 0.9
    source = lens.undistort(np.stack(np.meshgrid(x_um, y_um), axis=-1), outside="mask")
    columns, rows = source[..., 0] / 0.9 + 63.5, 47.5 - source[..., 1] / 0.9
    picture = np.ascontiguousarray(light[0, ::-1])
    remapped = cv2.remap(picture, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)[::-1]
    is_inside = ((columns > 0) & (columns < 127) & (rows > 0) & (rows < 95))[::-1]

    assert is_inside.mean() > 0.5
    # OpenCV may round positions to 1/32 of a pixel: an edge of height 1 then changes values by 1/64 along each axis.
    assert np.abs(remapped - warped.data[0])[is_inside].max() < 2.0 / 64.0 + 1e-4


def test_map_is_zero_outside_image_circle():
    lens = BrownConrady(focal_um=200.0, k1=-0.5)  # fold at 0.816 focal lengths: image circle radius 109 µm
    grid = fs.Grid.centred((500, 500), 1.0)

    warped = distort_map(power_map(np.ones(grid.shape), grid), lens, conserve="density")
    x, y = np.meshgrid(warped.grid.x_um, warped.grid.y_um)
    radius = np.hypot(x, y)
    limit = lens.max_radius_um[1]

    assert limit == pytest.approx(200.0 * (2.0 / 3.0) * np.sqrt(2.0 / 3.0))
    assert np.all(warped.data[0][radius > limit] == 0.0)
    np.testing.assert_allclose(warped.data[0][radius < limit - 1e-6], 1.0, rtol=1e-14)
    assert np.allclose(warped.grid.bounds_um, np.array([-1, -1, 1, 1]) * np.ceil(limit))


def test_power_within_image_circle_is_conserved():
    lens = BrownConrady(focal_um=200.0, k1=-0.5)
    grid = fs.Grid.centred((500, 500), 1.0)
    warped = distort_map(power_map(np.ones(grid.shape), grid), lens)
    ideal_um2 = np.pi * lens.max_radius_um[0] ** 2

    # Density increases as 1 / sqrt(distance to the circle), which sampling at cell centres underestimates.
    assert np.isfinite(warped.data).all()
    assert warped.data.sum() == pytest.approx(ideal_um2, rel=0.05)


def test_all_bands_are_distorted_identically():
    grid = fs.Grid.centred((40, 50), 1.0)
    band = np.random.default_rng(3).random((40, 50))
    both = fs.PowerMap(np.stack([band, 2.0 * band]), grid, np.array([450.0, 550.0]))

    warped = distort_map(both, BARREL)

    assert np.array_equal(warped.data[1], 2.0 * warped.data[0])
    assert warped.wavelength_nm.tolist() == [450.0, 550.0]


def test_result_is_independent_of_piece_size(monkeypatch):
    from foveasim.distortion import _map

    light = power_map(np.random.default_rng(4).random((60, 70)), fs.Grid.centred((60, 70), 1.0))
    in_one_piece = distort_map(light, BARREL)
    monkeypatch.setattr(_map, "CELLS_PER_PIECE", 300)

    assert np.array_equal(distort_map(light, BARREL).data, in_one_piece.data)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"power_map": np.ones((2, 2))}, r"'power_map' must be a PowerMap, got an ndarray"),
        ({"lens": None}, r"'lens' must be a lens of foveasim\.distortion"),
        ({"grid": (3, 3)}, r"'grid' must be a Grid, got a tuple"),
        ({"conserve": "energy"}, r"'conserve' must be one of 'flux', 'density', got 'energy'"),
        ({"order": 6}, r"'order' must be <= 5, got 6"),
        ({"grid": fs.Grid((2**15, 2**14), 1.0)}, r"'grid' must have at most 268435456 cells"),
    ],
)
def test_distort_map_rejects_invalid_arguments(arguments, message):
    light = power_map(np.ones((3, 4)), fs.Grid((3, 4), 1.0))

    with pytest.raises(ParameterError, match=message):
        distort_map(**{"power_map": light, "lens": BARREL, **arguments})


def test_extreme_distortion_requires_explicit_grid():
    far = BrownConrady(focal_um=1.0, k1=1.0)

    with pytest.raises(ParameterError, match=r"'grid' must be specified, because the distorted map has"):
        distort_map(power_map(np.ones((40, 40)), fs.Grid.centred((40, 40), 1.0)), far)


def test_distorted_letter_matches_opencv_image():
    """Complete chain from an OpenCV calibration (y down, top row first) with a decentred lens and tangential terms."""
    import cv2

    n_y, n_x = 150, 200
    letter = np.full((n_y, n_x), 0.1, np.float32)
    letter[40:110, 80:90] = letter[40:50, 80:130] = letter[68:78, 80:112] = 1.0  # top row first
    matrix = np.array([[180.0, 0.0, 107.0], [0.0, 176.0, 66.0], [0.0, 0.0, 1.0]])
    coefficients = np.array([-0.25, 0.06, 0.06, -0.04])
    u, v = np.meshgrid(np.arange(n_x, dtype=float), np.arange(n_y, dtype=float))
    source = cv2.undistortPoints(np.stack((u, v), axis=-1).reshape(-1, 1, 2), matrix, coefficients, P=matrix)
    # Accuracy of OpenCV: 5 iterations for the points, 1/32 pixel for the image.
    expected = cv2.remap(
        letter, source.reshape(n_y, n_x, 2).astype(np.float32), None, cv2.INTER_LINEAR, borderValue=0.1
    )

    pixel_um = 2.0
    lens = fs.distortion.from_opencv(matrix, coefficients, image_size=(n_x, n_y), pixel_um=pixel_um)
    light = fs.PowerMap.from_array(letter, pitch_um=pixel_um, wavelength_nm=550.0, top_row_first=True)
    pixels = fs.layout.grid(n_x=n_x, n_y=n_y, pitch_um=pixel_um)
    sites = fs.Integrator(pixels, light.grid, distortion=lens, conserve="density")(light.data)[0] / pixel_um**2
    site_means = np.zeros((n_y, n_x))
    column, row = ((pixels.centroid_um / pixel_um + np.array([n_x, n_y]) / 2).astype(int)).T
    site_means[n_y - 1 - row, column] = sites  # back to top row first
    warped = distort_map(light, lens, grid=light.grid, conserve="density").data[0, ::-1]

    interior = slice(15, -15), slice(15, -15)

    def mean_difference(picture):
        return np.abs(picture - expected)[interior].mean()

    # Means over curved pixels and linear interpolation differ at the edges of the letter.
    for picture in (site_means, warped):
        assert mean_difference(picture) < 0.01
        assert np.corrcoef(picture[interior].ravel(), expected[interior].ravel())[0, 1] > 0.98
        # Wrong signs of a tangential term or of the centre coordinates would increase the difference.
        for wrong in (picture[::-1], picture[:, ::-1], np.roll(picture, 2, 0), np.roll(picture, 2, 1)):
            assert mean_difference(wrong) > 2 * mean_difference(picture)
    flipped = fs.distortion.from_opencv(matrix, coefficients * [1, 1, -1, 1], image_size=(n_x, n_y), pixel_um=pixel_um)
    with_flipped_sign = distort_map(light, flipped, grid=light.grid, conserve="density").data[0, ::-1]
    assert mean_difference(with_flipped_sign) > 2 * mean_difference(warped)
