"""Gaps between neighbours: closed in pictures by the inverse of the inset that made them; blind spots stay empty."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.fields import Grid
from foveasim.layout import grid, hexagonal, inset, log_polar, voronoi
from foveasim.layout.gaps import close_gaps, edge_gaps_um
from foveasim.layout.lattice import RectangleLattice
from foveasim.reconstruct import cells, least_squares, linear, natural, raster_grid

#: Layouts that tile, with a margin in µm.
TILINGS = {
    "grid": (grid(n_x=9, n_y=7, pitch_um=5.0), 0.5),
    "rectangles": (fs.layout.grid(n_x=9, n_y=7, size_um=(45.0, 28.0)), 0.3),
    "hexagons": (hexagonal(n_columns=8, n_rows=7, pitch_um=5.0), 0.4),
    "rings": (log_polar(n_sectors=24, n_rings=8, r_min_um=20.0, r_max_um=80.0), 0.3),
    "staggered": (log_polar(n_sectors=24, n_rings=8, r_min_um=20.0, r_max_um=80.0, stagger=True, chords_per_arc=2), 0.3),
    "cells": (voronoi(n_sites=80, size_um=(60.0, 40.0), seed=2), 0.03),
    "two sizes": (fs.layout.foveal_cartesian(n_rings=6, n_fovea=2, ring_ratio=1.5, pitch_um=4.0), 0.3),
}  # fmt: skip
tilings = pytest.mark.parametrize(("tiling", "margin_um"), TILINGS.values(), ids=TILINGS)


def polygons(outlines):
    rings = np.split(outlines.xy_um, outlines.ring_offsets[1:-1])
    return np.array([shapely.Polygon(ring) for ring in rings])


def has_all_neighbours(layout):
    """Whether each edge of a site, and each edge at one of its vertices, is at another site."""
    union = shapely.union_all(layout.polygons(), grid_size=1e-9)
    return shapely.distance(union.boundary, layout.polygons()) > 1e-6


@tilings
def test_closing_is_inverse_of_inset(tiling, margin_um):
    closed = polygons(close_gaps(inset(tiling, margin_um)))

    inner = has_all_neighbours(tiling)
    assert np.count_nonzero(inner) > 10
    difference_um2 = shapely.area(shapely.symmetric_difference(closed[inner], tiling.polygons()[inner]))
    assert difference_um2.max() < 1e-6 * tiling.area_um2.min()


@tilings
def test_gap_is_twice_the_margin(tiling, margin_um):
    gap_um = edge_gaps_um(inset(tiling, margin_um))

    np.testing.assert_allclose(gap_um[np.isfinite(gap_um)], 2.0 * margin_um, rtol=1e-6)


@tilings
def test_tilings_have_no_gaps(tiling, margin_um):
    pixels = raster_grid(tiling, 150)
    values = np.arange(1.0, tiling.n_sites + 1.0)

    assert close_gaps(tiling) is None
    filled, empty = (cells(tiling, values, pixels, gaps=gaps) for gaps in ("fill", "empty"))
    np.testing.assert_array_equal(filled.data, empty.data)
    np.testing.assert_array_equal(filled.coverage, empty.coverage)


@tilings
def test_picture_of_inset_is_that_of_tiling(tiling, margin_um):
    values = np.random.default_rng(1).uniform(1.0, 2.0, tiling.n_sites)
    pixels = raster_grid(tiling, 150)

    found, expected = cells(inset(tiling, margin_um), values, pixels), cells(tiling, values, pixels)
    centre_um = np.stack(np.meshgrid(pixels.x_um, pixels.y_um), axis=-1)
    union = shapely.union_all(tiling.polygons(), grid_size=1e-9)
    is_inside = shapely.contains(union.buffer(-3.0 * margin_um - pixels.pitch_x_um), shapely.points(centre_um))
    assert is_inside.mean() > 0.3
    np.testing.assert_allclose(found.coverage[is_inside], 1.0, rtol=1e-6)
    np.testing.assert_allclose(found.data[0, is_inside], expected.data[0, is_inside], rtol=1e-5)


@pytest.mark.parametrize("method", [cells, linear, natural, least_squares])
def test_all_methods_fill_gaps(method):
    layout = inset(TILINGS["grid"][0], 0.5)
    options = {"mu": 1.0, "response": np.ones(layout.n_sites)} if method is least_squares else {}
    filled, empty = (
        method(layout, np.full(layout.n_sites, 3.0), raster_grid(layout, 440), gaps=gaps, **options)
        for gaps in ("fill", "empty")
    )

    assert np.isfinite(filled.data).all()
    np.testing.assert_allclose(filled.data, 3.0, rtol=1e-4)
    np.testing.assert_allclose(filled.coverage, 1.0, rtol=1e-6)
    assert np.isnan(empty.data).mean() > 0.2
    # The bounds are those of the sites: 9 of 4 µm and 8 gaps of 1 µm along x.
    assert empty.coverage.mean() == pytest.approx(36.0 / 44.0 * 28.0 / 34.0, rel=1e-2)


def test_captures_fill_gaps():
    layout = inset(TILINGS["grid"][0], 0.5)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(layout))
    scene = fs.Scene.flat(shape=(32, 32), pitch_um=1000.0, distance_m=1.0, radiance_w_m2_sr_nm=0.02, band_width_nm=50.0)
    capture = camera.capture(scene, exposure_s=0.01, seed=1)

    assert np.isfinite(capture.picture(max_pixels=300).data).all()
    assert np.isnan(capture.picture(max_pixels=300, gaps="empty").data).any()
    with pytest.raises(fs.errors.ParameterError, match="'gaps' must be one of 'fill', 'empty'"):
        capture.picture(gaps="close")


def test_blind_spots_stay_empty():
    layout = inset(TILINGS["rings"][0], 0.3)
    pixels = Grid((201, 201), 0.8, (-80.4, -80.4))
    picture = cells(layout, np.ones(layout.n_sites), pixels)

    radius_um = np.hypot(*np.meshgrid(pixels.x_um, pixels.y_um))
    assert np.isnan(picture.data[0, radius_um < 19.0]).all()
    assert np.isfinite(picture.data[0, (radius_um > 22.0) & (radius_um < 77.0)]).all()


@pytest.mark.parametrize("margin_um", [0.0, 0.2, 1.0])
def test_missing_site_stays_empty(margin_um):
    full = TILINGS["hexagons"][0]
    missing = int(np.hypot(*(full.centroid_um - full.centroid_um.mean(axis=0)).T).argmin())
    layout = inset(full[np.arange(full.n_sites) != missing], margin_um)
    x_um, y_um = full.centroid_um[missing]
    pixels = Grid((1, 1), 0.4, (x_um - 0.2, y_um - 0.2))

    assert np.isnan(cells(layout, np.ones(layout.n_sites), pixels).data).all()


def test_gaps_are_at_most_half_the_size():
    """Squares of side 2: a gap of 0.9 is closed, one of 1.1 is not."""
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [2.9, 0.0], [6.0, 0.0]], 2.0)
    closed = close_gaps(layout)

    np.testing.assert_allclose(np.sort(np.unique(closed.xy_um[:, 0].round(9))), [-1.0, 1.45, 3.9, 5.0, 7.0])


def test_rows_and_columns_close_like_polygons():
    """Columns of different widths with different gaps, one of them too wide; rows from the top."""
    x_um = np.array([[0.0, 4.0], [5.0, 9.0], [9.0, 12.0], [13.0, 15.0], [16.2, 18.2]])
    y_um = np.array([[10.0, 14.0], [5.0, 9.5], [0.0, 4.0]])
    layout = fs.Layout.from_lattice(RectangleLattice(x_um, y_um))
    closed = close_gaps(layout)

    np.testing.assert_allclose(closed.lattice.x_um, [[0, 4.5], [4.5, 9], [9, 12.5], [12.5, 15], [16.2, 18.2]])
    np.testing.assert_allclose(closed.lattice.y_um, [[9.75, 14], [4.5, 9.75], [0, 4.5]])
    assert close_gaps(closed) is None


@settings(max_examples=examples(40))
@example(seed=816, n_sites=46, fraction=0.15625)  # an outline would cross itself
@example(seed=9481, n_sites=3, fraction=0.030324362386746025)  # vertices that almost touch
@given(seed=st.integers(0, 10_000), n_sites=st.integers(3, 40), fraction=st.floats(0.01, 0.2))
def test_closed_sites_do_not_overlap(seed, n_sites, fraction):
    """Random cells with margins of their own: sites grow, and stay within the cells that they had."""
    cells_of_all = voronoi(n_sites=n_sites, size_um=(60.0, 40.0), seed=seed)
    inner_um = cells_of_all.area_um2 / shapely.length(cells_of_all.polygons())
    layout = inset(cells_of_all, fraction * inner_um)
    closed = close_gaps(layout)
    if closed is None:
        return

    sites, found = layout.polygons(), polygons(closed)
    assert (shapely.area(found) >= layout.area_um2 - 1e-9).all()
    # Without the grid, GEOS 3.14 can omit a polygon whose vertices almost touch others.
    assert shapely.area(found).sum() <= shapely.area(shapely.union_all(found, grid_size=1e-9)) * (1.0 + 0.02)
    assert shapely.covers(found.take(range(n_sites)), shapely.buffer(sites, -1e-6)).all()
