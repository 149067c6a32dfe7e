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
