"""Cell reconstruction: uniform fields, conservation of the signal, and missing data."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim._io.images import read_picture
from foveasim.errors import ParameterError
from foveasim.reconstruct import cells, fill_channels, raster_grid

FOVEAL = fs.layout.log_polar(n_sectors=40, min_size_um=2.0, r_max_um=80.0, stagger=True)


def test_flat_field_stays_flat():
    picture = cells(FOVEAL, np.full(FOVEAL.n_sites, 7.5), raster_grid(FOVEAL, 300))

    assert np.nanmax(np.abs(picture.data - 7.5)) <= 1e-6


def test_blind_spot_and_outside_are_nan():
    grid = raster_grid(FOVEAL, 301)
    picture = cells(FOVEAL, np.full(FOVEAL.n_sites, 1.0), grid)
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    radius_um, half_diagonal_um = np.hypot(x, y), grid.pitch_um * np.sqrt(0.5)
    blind_um = FOVEAL.provenance["blind_radius_um"]
    chord = np.cos(np.pi / 40)  # chords lie inside the circle

    assert np.isnan(picture.data[0][radius_um < blind_um * chord - half_diagonal_um]).all()
    assert np.isnan(picture.data[0][radius_um > np.hypot(*np.abs(FOVEAL.xy_um).max(0)) + half_diagonal_um]).all()
    inside = (radius_um > blind_um + half_diagonal_um) & (radius_um < 60.0)
    assert np.isfinite(picture.data[0][inside]).all()
    assert picture.coverage[inside] == pytest.approx(np.ones(inside.sum()), abs=1e-6)


def test_cells_conserve_total_signal():
    values = np.random.default_rng(0).uniform(1, 9, FOVEAL.n_sites)
    grid = raster_grid(FOVEAL, 257)
    picture = cells(FOVEAL, values, grid)
    spread = np.nansum(picture.data[0] * picture.coverage, dtype=np.float64) * grid.cell_area_um2

    assert spread == pytest.approx((values * FOVEAL.area_um2).sum(), rel=1e-6)


def test_boundary_pixel_is_area_weighted_mean():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 1.25, 1), shapely.box(1.25, 0, 3, 1)])
    picture = cells(layout, np.array([10.0, 30.0]), fs.Grid((1, 3), 1.0))

    assert picture.data[0, 0].tolist() == [10.0, 0.25 * 10 + 0.75 * 30, 30.0]


def test_asymmetric_target_saved_upright(tmp_path):
    layout = fs.layout.grid(n_x=3, n_y=5, pitch_um=2.0)
    target = np.array([[1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]])  # an upright F
    values = target[::-1].ravel() * 200.0  # sites start in the lowest row
    cells(layout, values, raster_grid(layout, 50)).save(tmp_path / "f.png", white=200.0)
    saved = read_picture(tmp_path / "f.png")[5::10, 5::10]

    assert (saved[..., 0] / 255).tolist() == target.tolist()
    assert (saved[..., 1] == 255).all()


def test_demosaicing_fills_channels_from_neighbours():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=8, n_y=8, pitch_um=1.0), ("RG", "GB"))
    values = np.array([100.0, 50.0, 20.0])[layout.channel]
    filled = fill_channels(layout, values, layout.channel, 3)

    assert filled == pytest.approx(np.repeat([[100.0], [50.0], [20.0]], 64, axis=1))


def test_nearer_neighbours_have_more_weight():
    layout = fs.Layout.from_rectangles([[0, 0], [1, 0], [-3, 0]], 1.0, channel=[0, 1, 1])
    filled = fill_channels(layout, np.array([5.0, 10.0, 20.0]), layout.channel, 2)

    assert filled[1, 0] == pytest.approx((10.0 / 1 + 20.0 / 3) / (1 / 1 + 1 / 3))
    assert filled[1, 1:].tolist() == [10.0, 20.0]


def test_raster_covers_layout_with_square_pixels():
    layout = fs.layout.grid(n_x=30, n_y=10, pitch_um=2.0).translate(100.0, -50.0)
    grid = raster_grid(layout, 90)

    assert grid.shape == (30, 90)
    assert grid.bounds_um == pytest.approx(layout.bounds_um)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: p.to_image(white=0.0), "'white' must be > 0"),
        (lambda p: p.to_image(white=[1.0, 2.0]), "'white' must be one number, or one for each of the 1 channels"),
        (lambda _: raster_grid(FOVEAL, 0), "'max_pixels' must be >= 1"),
        (lambda p: cells(FOVEAL, np.ones(3), p.grid), "'values' must have the shape"),
        (lambda p: cells(FOVEAL, np.full(FOVEAL.n_sites, np.nan), p.grid), "'values' must be finite everywhere"),
    ],
)
def test_invalid_values_raise_by_name(call, message):
    picture = cells(FOVEAL, np.ones(FOVEAL.n_sites), raster_grid(FOVEAL, 20))

    with pytest.raises(ParameterError, match=message):
        call(picture)


@pytest.mark.parametrize("kind", ["bayer", "ring"])
def test_picture_is_independent_of_site_order(kind):
    rng = np.random.default_rng(1)
    layout = fs.layout.mosaic(fs.layout.grid(n_x=12, n_y=12, pitch_um=2.0), ("RG", "GB"))
    if kind == "ring":  # 40 red sites at the same distance from a blue one
        angle = 2.0 * np.pi * np.arange(40) / 40
        centres_um = np.concatenate(([[0.0, 0.0]], 20.0 * np.stack((np.cos(angle), np.sin(angle)), axis=1)))
        layout = fs.Layout.from_rectangles(centres_um, size_um=1.0).with_columns(
            channel=(np.arange(41) == 0).astype(int)
        )
    values, order = rng.random(layout.n_sites), rng.permutation(layout.n_sites)
    n_channels = int(layout.channel.max()) + 1
    grid = fs.Grid.centred((40, 40), 1.1)

    def picture(sites):
        one = layout[sites]
        return cells(one, fill_channels(one, values[sites], one.channel, n_channels), grid).data

    np.testing.assert_allclose(picture(order), picture(np.arange(layout.n_sites)), rtol=1e-6)
    if kind == "ring":  # the mean of all
        filled = fill_channels(layout, values, layout.channel, n_channels)
        assert filled[0, 0] == pytest.approx(values[1:].mean(), rel=1e-12)


def test_missing_colours_have_mosaic_symmetry():
    """Means of four sites, or at green sites of two sites and the four next ones."""
    layout = fs.layout.mosaic(fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0), ("RG", "GB"))
    values = np.random.default_rng(2).random(64).reshape(8, 8)
    channel = layout.channel.reshape(8, 8)
    filled = fill_channels(layout, values.ravel(), layout.channel, 3).reshape(3, 8, 8)

    def mean(y, x, offsets, weights):
        return np.average([values[y + dy, x + dx] for dy, dx in offsets], weights=weights)

    cross, diagonal = [(0, 1), (0, -1), (1, 0), (-1, 0)], [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    for y, x in np.ndindex(8, 8):
        if not (3 <= y <= 4 and 3 <= x <= 4):
            continue
        own = channel[y, x]
        if own != 1:
            assert filled[1, y, x] == pytest.approx(mean(y, x, cross, None), rel=1e-12)
            assert filled[2 - own, y, x] == pytest.approx(mean(y, x, diagonal, None), rel=1e-12)
            continue
        for c in (0, 2):
            along = [(dy, dx) for dy, dx in cross if channel[y + dy, x + dx] == c]
            across = [(2 * dx + dy, 2 * dy + dx) for dy, dx in along] + [(dy - 2 * dx, dx - 2 * dy) for dy, dx in along]
            weights = [1.0] * 2 + [5.0**-0.5] * 4
            assert filled[c, y, x] == pytest.approx(mean(y, x, along + across, weights), rel=1e-12)
