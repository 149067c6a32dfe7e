"""Irregular families: Voronoi cells, foveal rings, sunflower, density, quadtree, Penrose tiling."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from reference.overlaps import overlaps_um2
from scipy.spatial import cKDTree

from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid
from foveasim.layout import Layout
from foveasim.layout._regions import disc
from foveasim.layout.diagrams.voronoi import IncrementalCells, ring_edges, voronoi_cells
from foveasim.layout.generators.fovi import fovi
from foveasim.layout.generators.penrose import penrose
from foveasim.layout.generators.quadtree import quadtree
from foveasim.layout.generators.sunflower import sunflower
from foveasim.layout.generators.voronoi import (
    _capacities,
    _density,
    _equalise_capacities,
    _first_centres,
    _slopes,
    voronoi,
)

relaxed = settings(max_examples=examples(30))
GOLDEN_RATIO = (1 + math.sqrt(5)) / 2

BOX = shapely.box(-10, -5, 20, 8)
NOTCH = shapely.Polygon([(0, 0), (10, 0), (10, 3), (3, 3), (3, 10), (0, 10)])
STAR = shapely.Polygon(
    [((10, 3)[i % 2] * math.cos(i * math.pi / 7), (10, 3)[i % 2] * math.sin(i * math.pi / 7)) for i in range(14)]
)
FRAME = shapely.box(-10, -10, 10, 10) - shapely.box(-4, -4, 4, 4)
regions = st.sampled_from([BOX, NOTCH, STAR, disc(7.0, 31)])
seeds = st.integers(0, 2**32)


def assert_tiles(layout, region_um2):
    """Assert an edge-matched coverage of this area: no overlaps, gaps or T-junctions."""
    polygons = layout.polygons()
    common_um2 = overlaps_um2(polygons)

    assert bool(np.all(shapely.is_valid(polygons)))
    assert bool(shapely.coverage_is_valid(polygons))
    assert bool((layout.area_um2 > 0).all())
    assert common_um2.max(initial=0.0) <= 1e-9 * layout.area_um2.min()
    assert layout.area_um2.sum() == pytest.approx(region_um2, rel=1e-9)
    assert shapely.coverage_union_all(polygons).area == pytest.approx(region_um2, rel=1e-9)


def assert_same(one, other):
    assert np.array_equal(one.xy_um, other.xy_um)
    assert np.array_equal(one.ring_offsets, other.ring_offsets)


def regular_polygon_um2(n_corners, radius_um):
    return 0.5 * n_corners * math.sin(2 * math.pi / n_corners) * radius_um**2


def points_in(region, n, seed):
    rng = np.random.default_rng(seed)
    low, high = np.reshape(region.bounds, (2, 2))
    points = rng.uniform(low, high, (12 * n + 200, 2))
    return points[shapely.contains_xy(region, points)][:n]


def as_layout(xy_um, ring_offsets):
    return Layout(xy_um, ring_offsets, np.arange(ring_offsets.size))


def nearest_um(points):
    return cKDTree(points).query(points, k=2)[0][:, 1]


# -- Voronoi cells ---------------------------------------------------------------------------------------------------


@given(regions, st.integers(1, 120), seeds)
@relaxed
def test_cells_tile_region_one_per_centre(region, n, seed):
    centres = points_in(region, n, seed)
    layout = as_layout(*voronoi_cells(centres, region))

    assert layout.n_sites == centres.shape[0]
    assert_tiles(layout, region.area)
    assert bool(np.all(shapely.intersects(layout.polygons(), shapely.points(centres))))


@given(st.sampled_from([BOX, disc(7.0, 31)]), st.integers(2, 60), seeds)
@relaxed
def test_cell_points_are_nearest_to_centre(region, n, seed):
    centres = points_in(region, n, seed)
    layout = as_layout(*voronoi_cells(centres, region))
    points = points_in(region, 500, seed + 1)
    _, nearest = cKDTree(centres).query(points)

    assert bool(np.all(shapely.covers(layout.polygons()[nearest].tolist(), shapely.points(points))))


# Rounded to 1e-6 µm: with offsets near the smallest float64 (1e-308 µm), the union of edges loses corners.
@given(
    st.integers(1, 12), st.integers(1, 12), st.floats(0.05, 50.0), st.floats(-1e4, 1e4).map(lambda x_um: round(x_um, 6))
)
@relaxed
def test_cells_of_square_grid_are_squares(n_x, n_y, pitch_um, x0_um):
    """Four cells meet in every corner, which rounding may split in two."""
    x, y = np.meshgrid((np.arange(n_x) + 0.5) * pitch_um + x0_um, (np.arange(n_y) + 0.5) * pitch_um)
    region = shapely.box(x0_um, 0, x0_um + n_x * pitch_um, n_y * pitch_um)
    layout = as_layout(*voronoi_cells(np.stack((x.ravel(), y.ravel()), axis=1), region))

    assert_tiles(layout, region.area)
    np.testing.assert_allclose(layout.area_um2, pitch_um**2, rtol=1e-6)


def test_inner_cells_of_hexagonal_packing_are_hexagons():
    row, column = np.divmod(np.arange(400), 20)
    centres = np.stack((column + 0.5 * (row % 2), row * math.sqrt(3) / 2), axis=1)
    layout = as_layout(*voronoi_cells(centres, shapely.box(-1, -1, 21, 18)))
    is_inside = (row > 0) & (row < 19) & (column > 0) & (column < 19)

    assert set(np.diff(layout.ring_offsets)[is_inside].tolist()) == {6}
    np.testing.assert_allclose(layout.area_um2[is_inside], math.sqrt(3) / 2, rtol=1e-12)


def test_separated_part_is_assigned_to_neighbour():
    """Arms of a U: the centre in the left arm is also nearest to the end of the right arm."""
    u = shapely.Polygon([(0, 0), (10, 0), (10, 10), (6, 10), (6, 1), (4, 1), (4, 10), (0, 10)])
    layout = as_layout(*voronoi_cells(np.array([(3.9, 9.0), (9.9, 0.5)]), u))

    assert layout.n_sites == 2
    assert_tiles(layout, u.area)
    assert bool(np.all(shapely.get_type_id(layout.polygons()) == shapely.GeometryType.POLYGON))


@given(st.sampled_from([NOTCH, STAR]), st.integers(8, 80), seeds)
# About one in six of these layouts has exactly one separated part.
@settings(relaxed, max_examples=examples(36), suppress_health_check=[HealthCheck.filter_too_much])
def test_separated_part_joins_longest_shared_boundary(region, n, seed):
    """The reference cells are those of shapely, for layouts with one separated part."""
    centres = points_in(region, n, seed)
    unclipped = shapely.voronoi_polygons(shapely.multipoints(centres), extend_to=region, ordered=True)
    cells = shapely.intersection(shapely.get_parts(unclipped), region)
    parts, owner = shapely.get_parts(cells, return_index=True)
    is_separated = ~shapely.intersects(parts, shapely.points(centres[owner]))
    assume(is_separated.sum() == 1)
    part, mains = parts[is_separated][0], parts[~is_separated]
    shared_um = shapely.length(shapely.intersection(shapely.buffer(part, 1e-6), shapely.boundary(mains)))
    layout = as_layout(*voronoi_cells(centres, region))
    assume(np.diff(np.sort(shared_um)[-2:])[0] > 1e-3)

    assert bool(shapely.contains(layout.polygons()[shared_um.argmax()], part.point_on_surface()))


def test_single_cell_is_the_region():
    layout = as_layout(*voronoi_cells(np.array([(0.3, -0.2)]), STAR))

    assert shapely.equals(layout.polygons()[0], STAR)


def test_cells_tile_region_with_hole():
    layout = as_layout(*voronoi_cells(points_in(FRAME, 60, 1), FRAME))

    assert_tiles(layout, 400 - 64)


@pytest.mark.slow
def test_10000_cells_tile():
    layout = as_layout(*voronoi_cells(points_in(BOX, 10_000, 2), BOX))

    assert layout.n_sites == 10_000
    assert layout.area_um2.sum() == pytest.approx(BOX.area, rel=1e-12)
    assert bool(shapely.coverage_is_valid(layout.polygons()))


@pytest.mark.parametrize(
    ("centres", "region", "error", "message"),
    [
        ([(0, 0), (30, 0)], BOX, GeometryError, "centre 1 at .30, 0. µm must lie inside"),
        ([(0, 0), (20, 0)], BOX, GeometryError, "centre 1 .* must lie inside"),
        ([(0, 0), (1, 1), (0, 0)], BOX, GeometryError, "centres 0 and 2 must be distinct points"),
        ([(0, 0), (1e-300, 0)], BOX, GeometryError, "too close"),
        ([(7, 0)], FRAME, GeometryError, "centre 0 within the region must be one polygon"),
        (np.zeros((0, 2)), BOX, ParameterError, "shape .n, 2. with n >= 1"),
        (np.zeros((3, 3)), BOX, ParameterError, "shape .n, 2. with n >= 1"),
    ],
)
def test_centres_without_cell_raise(centres, region, error, message):
    with pytest.raises(error, match=message):
        voronoi_cells(np.array(centres, float), region)


# -- incrementally updated cells -----------------------------------------------------------------------------------------


def areas_um2(edges, n):
    """Areas of cells by shoelace sums of unordered edges."""
    (x0, y0), (x1, y1) = edges.start_um.T, edges.stop_um.T
    return np.bincount(edges.cell, 0.5 * (x0 * y1 - x1 * y0), minlength=n)


@pytest.mark.slow
@given(st.sampled_from([BOX, NOTCH, STAR, FRAME]), st.integers(5, 80), st.sampled_from([0.05, 0.3, 1.0]), seeds)
@settings(relaxed, max_examples=examples(20))
def test_updated_cells_equal_new_cells(region, n, step_fraction, seed):
    """Including cells divided by notches, and both small and large displacements of centres."""
    centres, targets = points_in(region, n, seed), points_in(region, n, seed + 1)
    cells = IncrementalCells(region)
    for _ in range(3):
        edges = cells.update(centres)
        expected = as_layout(*voronoi_cells(centres, region)) if region is not FRAME else None
        tolerance_um2 = 1e-9 * region.area / n

        assert areas_um2(edges, n).sum() == pytest.approx(region.area, rel=1e-9)
        np.testing.assert_allclose(
            areas_um2(edges, n), areas_um2(IncrementalCells(region).update(centres), n), atol=tolerance_um2
        )
        if expected is not None:
            np.testing.assert_allclose(areas_um2(edges, n), expected.area_um2, atol=tolerance_um2)
            assert_tiles(as_layout(*cells.rings()), region.area)
        moved = centres + step_fraction * (targets - centres)
        centres = np.where(shapely.contains_xy(region, moved)[:, np.newaxis], moved, centres)


@given(st.sampled_from([BOX, disc(7.0, 31)]), st.integers(1, 60), st.floats(0.0, 3.0), seeds)
@relaxed
def test_power_cell_points_have_least_power(region, n, spread, seed):
    """For the first weights and for an update from other weights."""
    centres, points = points_in(region, n, seed), points_in(region, 500, seed + 1)
    rng = np.random.default_rng(seed)
    cells = IncrementalCells(region)
    for _ in range(2):
        weights = rng.random(n) * spread * region.area / n
        if cells.update(centres, weights) is None:
            continue
        layout = as_layout(*cells.rings())
        power = ((points[:, np.newaxis] - centres) ** 2).sum(axis=2) - weights

        assert_tiles(layout, region.area)
        assert bool(np.all(shapely.covers(layout.polygons()[power.argmin(axis=1)].tolist(), shapely.points(points))))


def test_power_cell_may_exclude_its_centre():
    cells = IncrementalCells(BOX)
    cells.update(np.array([(0.0, 0.0), (2.0, 0.0)]), np.array([0.0, 10.0]))
    layout = as_layout(*cells.rings())

    # |x|² = (x - 2)² - 10 at x = -1.5, left of the first centre
    assert layout.bounds_um == BOX.bounds
    assert layout.polygons()[0].bounds == (-10.0, -5.0, -1.5, 8.0)


def test_centre_of_small_weight_has_no_cell():
    centres = points_in(BOX, 30, 0)
    weights = np.zeros(30)
    weights[4] = -1e3
    cells = IncrementalCells(BOX)

    assert cells.update(centres, weights) is None
    assert cells.update(centres) is not None
    assert cells.update(centres, weights) is None


@pytest.mark.parametrize("offset", [-1e5, 1e5])
def test_weight_offset_does_not_change_cells(offset):
    centres, weights = points_in(BOX, 30, 0), np.random.default_rng(0).random(30)

    np.testing.assert_allclose(
        areas_um2(IncrementalCells(BOX).update(centres, weights + offset), 30),
        areas_um2(IncrementalCells(BOX).update(centres, weights), 30),
        rtol=1e-6,
    )


def test_shared_edges_are_paired():
    centres = points_in(STAR, 80, 3)
    edges = IncrementalCells(STAR).update(centres)
    one, other = edges.twins()
    is_shared = np.zeros(edges.cell.size, bool)
    is_shared[one] = is_shared[other] = True
    rest = shapely.linestrings(np.stack((edges.start_um, edges.stop_um), axis=1)[~is_shared])

    assert np.array_equal(edges.start_um[one], edges.stop_um[other])
    assert np.array_equal(edges.stop_um[one], edges.start_um[other])
    assert shapely.length(rest).sum() == pytest.approx(STAR.length, rel=1e-9)
    assert shapely.distance(STAR.boundary, shapely.centroid(rest)).max() < 1e-9


# -- isotropic foveal rings ------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(st.floats(10.0, 5000.0), st.floats(1e-3, 1e3), st.integers(1, 20))
@settings(relaxed, max_examples=examples(15))
def test_foveal_rings_tile_disc_without_blind_spot(fov_um, a_fraction, n_rings):
    assume(n_rings > 1 or a_fraction > 0.1)
    layout = fovi(fov_um=fov_um, a_um=a_fraction * fov_um, n_rings=n_rings, n_chords=1000)

    assert_tiles(layout, regular_polygon_um2(1000, layout.provenance["radius_um"]))
    assert bool(shapely.contains_xy(layout.polygons()[0], 0.0, 0.0))


@given(st.floats(10.0, 5000.0), st.floats(1.0, 100.0), st.integers(2, 20))
@relaxed
def test_foveal_radii_and_counts_follow_rule(fov_um, a_um, n_rings):
    layout = fovi(fov_um=fov_um, a_um=a_um, n_rings=n_rings)
    w = np.linspace(math.log(a_um), math.log(fov_um / 2 + a_um), n_rings + 1)
    w = np.append(w, 2 * w[-1] - w[-2])
    r = np.exp(w) - a_um
    n_on_ring = np.bincount(layout.columns["ring"])

    assert n_on_ring[0] == 1
    for i in range(1, n_rings + 1):
        ideal = 2 * math.pi * r[i] / (0.5 * (r[i + 1] - r[i - 1]))
        assert n_on_ring[i] in {math.ceil(ideal - 1e-6), math.ceil(ideal + 1e-6)}


def test_foveal_sites_are_isotropic():
    """The area of a site is the squared spacing of its ring, except for the rounding of counts."""
    layout = fovi(fov_um=1000.0, a_um=20.0, n_rings=60)
    ring = layout.columns["ring"]
    step = math.log1p(500.0 / 20.0) / 60
    r = 20.0 * np.expm1(step * np.arange(62))
    spacing_um2 = np.concatenate(([np.nan], (0.5 * (r[2:] - r[:-2])) ** 2))
    mean_um2 = np.bincount(ring, layout.area_um2) / np.bincount(ring)

    np.testing.assert_allclose(mean_um2[10:-1], spacing_um2[10:-1], rtol=0.02)
    assert bool((np.diff(mean_um2[5:-1]) > 0).all())


def test_fovea_larger_than_field_is_uniform():
    layout = fovi(fov_um=100.0, a_um=1e7, n_rings=5)

    assert np.bincount(layout.columns["ring"]).tolist() == [1, 7, 13, 19, 26, 32]


def test_foveal_sites_are_ordered_by_ring():
    layout = fovi(fov_um=100.0, a_um=10.0, n_rings=3)
    first = layout.columns["sector"] == 0

    assert layout.columns["ring"][first].tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(layout.centroid_um[first][:, 1], 0.0, atol=1.0)
    assert np.array_equal(layout.readout_line, layout.columns["ring"])


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"fov_um": 0.0}, ParameterError, "'fov_um' must be > 0"),
        ({"a_um": 0.0}, ParameterError, "'a_um' must be > 0"),
        ({"a_um": -1.0}, ParameterError, "'a_um' must be > 0"),
        ({"n_rings": 0}, ParameterError, "'n_rings' must be >= 1"),
        ({"n_rings": 2.5}, ParameterError, "'n_rings' must be an integer"),
        ({"n_rings": 20, "n_chords": 4}, ParameterError, "'n_chords' must be >= "),
        ({"fov_um": 1e4, "a_um": 1e7, "n_rings": 9000}, ParameterError, "'n_sites' must be <= "),
        ({"fov_um": 1e4, "a_um": 1e-4, "n_rings": 100}, GeometryError, "too close"),
    ],
)
def test_invalid_foveal_rings_raise(changes, error, message):
    with pytest.raises(error, match=message):
        fovi(**{"fov_um": 1000.0, "a_um": 20.0, "n_rings": 5, **changes})


# -- sunflower -------------------------------------------------------------------------------------------------------


def sunflower_centres(n):
    k = np.arange(1, n + 1)
    angle = k * math.radians(360 * (1 - 1 / GOLDEN_RATIO))
    return 0.6242 * np.sqrt(k)[:, np.newaxis] * np.stack((np.cos(angle), np.sin(angle)), axis=1)


@given(st.integers(1, 400), st.floats(0.1, 50.0))
@relaxed
def test_sunflower_tiles_its_disc(n_sites, spacing_um):
    layout = sunflower(n_sites=n_sites, spacing_um=spacing_um, n_chords=720)

    assert layout.n_sites == n_sites
    assert layout.provenance["radius_um"] == pytest.approx(0.6242 * math.sqrt(n_sites + 0.5) * spacing_um, rel=1e-4)
    assert_tiles(layout, regular_polygon_um2(720, layout.provenance["radius_um"]))


@pytest.mark.parametrize("n_sites", [4, 50, 3000])
def test_closest_sunflower_sites_have_given_spacing(n_sites):
    """The centres by the formula have this spacing, and each lies in its cell."""
    layout = sunflower(n_sites=n_sites, spacing_um=2.0)
    centres = 2.0 * sunflower_centres(n_sites)

    assert nearest_um(centres).min() == pytest.approx(2.0, rel=1e-4)
    assert bool(np.all(shapely.contains_xy(layout.polygons(), centres[:, 0], centres[:, 1])))
    # No centre is nearer to a corner of a Voronoi cell than its own.
    own = centres[np.repeat(np.arange(n_sites), np.diff(layout.ring_offsets))]
    own_um = np.hypot(*(layout.xy_um - own).T)
    np.testing.assert_allclose(own_um, cKDTree(centres).query(layout.xy_um)[0], rtol=0.0, atol=0.02)


def test_published_sunflower_constant_gives_unit_spacing():
    distance = nearest_um(sunflower_centres(100_000))

    assert distance.min() == pytest.approx(1.0, rel=1e-4)
    assert sorted(np.argsort(distance)[:2].tolist()) == [0, 3]


@pytest.mark.slow
def test_inner_sunflower_sites_have_equal_area():
    layout = sunflower(n_sites=5000, spacing_um=1.0)

    np.testing.assert_allclose(layout.area_um2[50:4500], math.pi * 0.6242**2, rtol=0.05)
    assert layout.area_um2[50:4500].mean() == pytest.approx(math.pi * 0.6242**2, rel=1e-3)


def test_spiral_uses_golden_angle():
    turn = sunflower(n_sites=8, spacing_um=1.0).columns["turn"]

    assert turn.tolist() == [int(k * 137.50776 // 360) for k in range(1, 9)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_sites": 0}, "'n_sites' must be >= 1"),
        ({"n_sites": 10**9}, "'n_sites' must be <= "),
        ({"spacing_um": 0.0}, "'spacing_um' must be > 0"),
        ({"spacing_um": 1e7}, "'radius_um' must be <= "),
        ({"n_chords": 5}, "'n_chords' must be >= "),
    ],
)
def test_invalid_sunflower_raises(changes, message):
    with pytest.raises(ParameterError, match=message):
        sunflower(**{"n_sites": 100, "spacing_um": 2.0, **changes})


# -- density ---------------------------------------------------------------------------------------------------------


def fovea(xy_um):
    return 1.0 / (1.0 + (xy_um**2).sum(axis=1) / 25.0)


def watson_per_um2(xy_um):
    """Density of temporal human retinal ganglion cells (Watson 2014), with 1 µm per degree."""
    r = np.hypot(*xy_um.T)
    return 2 * 14804.6 / (1 + r / 41.03) * (0.9851 * (1 + r / 1.058) ** -2 + (1 - 0.9851) * np.exp(-r / 22.14))


@given(st.integers(1, 150), regions, st.sampled_from([None, fovea]), st.integers(0, 3), seeds)
@relaxed
def test_density_driven_sites_tile_region(n_sites, region, density, n_iterations, seed):
    layout = voronoi(n_sites=n_sites, region=region, density=density, n_iterations=n_iterations, seed=seed)

    assert layout.n_sites == n_sites
    assert_tiles(layout, region.area)
    assert layout.columns["share"].mean() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.slow
@given(seeds)
@settings(relaxed, max_examples=examples(5))
def test_layout_depends_only_on_seed(seed):
    first, repeated, other = (
        voronoi(n_sites=50, size_um=(9.0, 6.0), density=fovea, n_iterations=3, seed=s) for s in (seed, seed, seed + 1)
    )

    assert_same(first, repeated)
    assert not np.array_equal(first.xy_um[:20], other.xy_um[:20])


def test_lloyd_iterations_equalise_areas():
    initial, converged = (voronoi(n_sites=400, size_um=(30.0, 20.0), n_iterations=n) for n in (0, 60))

    assert initial.area_um2.std() / initial.area_um2.mean() > 0.15
    assert converged.area_um2.std() / converged.area_um2.mean() < 0.08


@pytest.mark.slow
def test_relaxed_centres_have_blue_noise_spacing():
    """Minimum spacing of 0.7 of hexagonal packing; that of random points is about 0."""
    layout = voronoi(n_sites=1000, size_um=(40.0, 25.0), n_iterations=40)

    assert nearest_um(layout.centroid_um).min() > 0.7 * math.sqrt(2 / math.sqrt(3))


@pytest.mark.slow
def test_cone_mosaic_has_published_spacing():
    """249,800 cones/mm² correspond to a spacing of 2.15 µm in hexagonal packing."""
    n_sites = round(249_800e-6 * 100.0 * 80.0)
    layout = voronoi(n_sites=n_sites, size_um=(100.0, 80.0), n_iterations=40)
    spacing_um = np.sqrt(2 / math.sqrt(3) * layout.area_um2)

    assert n_sites == 1998
    assert np.sqrt(np.mean(spacing_um**2)) == pytest.approx(2.15, rel=1e-3)
    assert 0.85 * 2.15 < nearest_um(layout.centroid_um).mean() < 2.15


@pytest.mark.parametrize("n_iterations", [0, 20])
def test_site_counts_follow_density(n_iterations):
    """The integral of 1/(1 + r²/s²) over a disc is π s² ln(1 + r²/s²); the tolerance is that of cells on the circle."""
    n_sites, scale_um = 2000, 5.0
    outline = disc(100.0, 720)
    layout = voronoi(n_sites=n_sites, region=outline, density=fovea, n_iterations=n_iterations)
    r = np.hypot(*layout.centroid_um.T)
    for radius_um in (5.0, 10.0, 30.0, 60.0):
        expected = n_sites * math.log1p((radius_um / scale_um) ** 2) / math.log1p((100.0 / scale_um) ** 2)
        assert (r < radius_um).sum() == pytest.approx(expected, abs=2.0 * math.sqrt(expected))
    assert layout.columns["share"].std() < (0.35, 0.08)[n_iterations > 0]


def test_retinal_density_gives_retinal_spacing():
    """Watson formula over 30°: the spacing is sqrt(2 / (√3 d)), with the density d in sites per area."""
    outline = disc(30.0, 360)
    layout = voronoi(n_sites=1500, region=outline, density=watson_per_um2)
    r = np.hypot(*layout.centroid_um.T)
    edges = np.linspace(0.0, 30.0, 300_001)
    centre = 0.5 * (edges[1:] + edges[:-1])
    total = (2 * math.pi * centre * watson_per_um2(np.stack((centre, 0 * centre), axis=1))).sum() * 1e-4
    d = 1500 / total * watson_per_um2(layout.centroid_um)
    is_inside = (r > 1.0) & (r < 28.0)
    spacing_um = np.sqrt(2 / math.sqrt(3) * layout.area_um2)

    assert np.median((spacing_um / np.sqrt(2 / (math.sqrt(3) * d)))[is_inside]) == pytest.approx(1.0, abs=0.02)


def test_sites_follow_density_picture():
    picture = np.ones((20, 30))
    picture[:, 15:] = 9.0
    layout = voronoi(n_sites=1000, density=picture, density_grid=Grid.centred((20, 30), 2.0))

    assert_tiles(layout, 20 * 30 * 4.0)
    assert (layout.centroid_um[:, 0] > 0).sum() == pytest.approx(900, abs=30)


def test_black_areas_contain_few_sites():
    picture = np.zeros((30, 50))
    picture[5:25, 10:40] = 1.0
    layout = voronoi(n_sites=600, density=picture, density_grid=Grid.centred((30, 50), 1.0))
    x, y = np.abs(layout.centroid_um).T

    assert_tiles(layout, 1500.0)
    assert ((x < 15) & (y < 10)).sum() > 0.8 * 600


def linear(xy_um):
    return 20.0 + xy_um[:, 0] - 0.5 * xy_um[:, 1]


def random_picture(region):
    """White-noise picture over a region."""
    low, high = np.reshape(region.bounds, (2, 2))
    pitch_um = (high - low).max() / 16
    return np.random.default_rng(8).random((16, 16)) + 0.05, Grid((16, 16), pitch_um, tuple(low))


def picture_options(region, picture=None):
    values, grid = random_picture(region)
    return {"density": values if picture is None else picture, "density_grid": grid}


def integrate_picture(polygon, values, grid, power=1):
    """Mass and first moments of a power of a picture over a polygon, cell by cell."""
    rows, columns = np.divmod(np.arange(values.size), values.shape[1])
    x0, y0 = grid.origin_um[0] + columns * grid.pitch_um, grid.origin_um[1] + rows * grid.pitch_um
    common = shapely.intersection(shapely.box(x0, y0, x0 + grid.pitch_um, y0 + grid.pitch_um), polygon)
    weight = values.ravel() ** power * shapely.area(common)
    centre = np.where(weight[:, np.newaxis] > 0, shapely.get_coordinates(shapely.centroid(polygon)), 0.0)
    centre[weight > 0] = shapely.get_coordinates(shapely.centroid(common[weight > 0]))
    return weight.sum(), weight @ centre


def integrate_function(ring, centre, function):
    """Mass and first moments of a squared function, by a 3-point rule on triangles."""
    mass, moment = 0.0, np.zeros(2)
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        area_um2 = 0.5 * ((a - centre)[0] * (b - centre)[1] - (a - centre)[1] * (b - centre)[0])
        for corners in ((centre, centre, a, b), (a, centre, a, b), (b, centre, a, b)):
            point = (3 * np.array(corners[0]) + np.sum(corners[1:], axis=0)) / 6
            mass += area_um2 / 3 * function(point[np.newaxis])[0] ** 2
            moment += area_um2 / 3 * function(point[np.newaxis])[0] ** 2 * point
    return mass, moment


@given(regions, st.integers(1, 25), st.sampled_from(["uniform", "function", "picture"]), st.integers(1, 3), seeds)
@settings(relaxed, max_examples=examples(15))
def test_lloyd_iterations_agree_with_reference(region, n_sites, kind, n_iterations, seed):
    """The reference computes all cells in each iteration, and integrates them one by one."""
    density, grid = {"uniform": (None, None), "function": (fovea, None), "picture": random_picture(region)}[kind]
    centres = _first_centres(n_sites, *_density(density, grid, region)[1:], region, seed)
    for _ in range(n_iterations):
        cells = as_layout(*voronoi_cells(centres, region))
        for i, polygon in enumerate(cells.polygons()):
            if kind == "uniform":
                mass, moment = polygon.area, polygon.area * shapely.get_coordinates(polygon.centroid)[0]
            elif kind == "function":
                mass, moment = integrate_function(shapely.get_coordinates(polygon)[:-1], centres[i], fovea)
            else:
                mass, moment = integrate_picture(polygon, density, grid, power=2)
            if shapely.contains_xy(region, *(moment / mass)):
                centres[i] = moment / mass
    reference = as_layout(*voronoi_cells(centres, region))
    layout = voronoi(
        n_sites=n_sites, region=region, density=density, density_grid=grid, n_iterations=n_iterations, seed=seed
    )

    np.testing.assert_allclose(layout.area_um2, reference.area_um2, rtol=1e-9)
    np.testing.assert_allclose(layout.centroid_um, reference.centroid_um, atol=1e-8)
    np.testing.assert_allclose(shapely.length(layout.polygons()), shapely.length(reference.polygons()), rtol=1e-9)


@pytest.mark.parametrize("capacity", ["free", "equal"])
def test_shares_equal_picture_integrals(capacity):
    values, grid = random_picture(STAR)
    layout = voronoi(n_sites=40, region=STAR, density=values, density_grid=grid, n_iterations=3, capacity=capacity)
    mass = np.array([integrate_picture(polygon, values, grid)[0] for polygon in layout.polygons()])

    np.testing.assert_allclose(layout.columns["share"], mass / mass.mean(), rtol=1e-9)


@pytest.mark.parametrize("capacity", ["free", "equal"])
def test_shares_equal_function_integrals(capacity):
    """The integral of a linear function is the area times the value at the centroid."""
    layout = voronoi(n_sites=40, region=NOTCH, density=linear, n_iterations=3, capacity=capacity)
    mass = layout.area_um2 * linear(layout.centroid_um)

    np.testing.assert_allclose(layout.columns["share"], mass / mass.mean(), rtol=1e-9)


@pytest.mark.parametrize("width_um", [0.5, 2.0, 20.0])
@pytest.mark.parametrize("n_sites", [1, 40])
def test_function_integrals_are_accurate_to_1e_7(width_um, n_sites):
    """Gaussians over a box, narrower and wider than sites, against the closed form."""

    def gaussian(xy_um):
        return np.exp(-(xy_um**2).sum(axis=1) / (2 * width_um**2))

    layout = voronoi(n_sites=n_sites, region=BOX, n_iterations=2)
    field = _density(gaussian, None, BOX)[0]
    mass, _ = field.moments(ring_edges(layout.xy_um, layout.ring_offsets), layout.centroid_um)
    x, y = (
        math.erf(high / width_um / math.sqrt(2)) - math.erf(low / width_um / math.sqrt(2))
        for low, high in ((-10, 20), (-5, 8))
    )

    assert mass.sum() == pytest.approx(0.5 * math.pi * width_um**2 * x * y, rel=1e-7)


@given(
    st.integers(1, 60),
    st.sampled_from([BOX, NOTCH, disc(7.0, 31)]),
    st.sampled_from(["uniform", "fovea", "picture"]),
    st.integers(0, 4),
    seeds,
)
@settings(relaxed, max_examples=examples(20))
def test_equal_capacity_sites_tile_region(n_sites, region, kind, n_iterations, seed):
    density = {"uniform": {}, "fovea": {"density": fovea}, "picture": picture_options(region)}[kind]
    layout = voronoi(n_sites=n_sites, region=region, n_iterations=n_iterations, capacity="equal", seed=seed, **density)

    assert layout.n_sites == n_sites
    assert_tiles(layout, region.area)
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("region", [BOX, NOTCH, STAR, FRAME], ids=["box", "notch", "star", "frame"])
@pytest.mark.parametrize("n_sites", [30, 300])
def test_equal_capacity_without_density_is_equal_area(n_sites, region):
    """Including a star, whose notches divide cells: capacities are discontinuous, and centres require further moves."""
    layout = voronoi(n_sites=n_sites, region=region, capacity="equal", n_iterations=5)

    assert_tiles(layout, region.area)
    np.testing.assert_allclose(layout.area_um2, region.area / n_sites, rtol=1e-6)


@pytest.mark.slow
def test_equal_capacity_sites_are_as_compact():
    """Minimum spacing, and perimeter of a site of unit area: 3.72 for a hexagon, 4 for a square."""
    free, equal = (voronoi(n_sites=600, size_um=(30.0, 20.0), capacity=capacity) for capacity in ("free", "equal"))
    perimeter_free, perimeter_equal = (
        np.median(shapely.length(layout.polygons()) / np.sqrt(layout.area_um2)) for layout in (free, equal)
    )

    assert nearest_um(equal.centroid_um).min() > 0.7 * math.sqrt(2 / math.sqrt(3))
    assert perimeter_equal == pytest.approx(perimeter_free, abs=0.05)
    assert free.columns["share"].std() > 0.05


@pytest.mark.slow
def test_equal_capacity_with_large_density_range():
    layout = voronoi(
        n_sites=1000, region=disc(100.0, 360), density=lambda xy_um: fovea(5 * xy_um) ** 1.5, capacity="equal"
    )

    assert layout.area_um2.max() > 1000 * layout.area_um2.min()
    assert_tiles(layout, regular_polygon_um2(360, 100.0))
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("n_sites", [5, 40])
def test_equal_capacity_with_black_areas(n_sites):
    """White squares on black, none of which has the mass of an integer number of sites."""
    picture = np.zeros((16, 16))
    picture[1:4, 1:4] = picture[1:4, 11:15] = picture[10:15, 6:9] = 1.0
    layout = voronoi(n_sites=n_sites, region=BOX, capacity="equal", n_iterations=2, **picture_options(BOX, picture))

    assert_tiles(layout, BOX.area)
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


def test_divided_cell_retains_heaviest_part():
    """White in the two arms of an angle: the larger part of a cell may be black, without any mass."""
    picture = np.zeros((60, 60))
    picture[15:50, 20:55] = 1.0
    grid = Grid((60, 60), 1 / 6)
    layout = voronoi(n_sites=30, region=NOTCH, density=picture, density_grid=grid, n_iterations=0, capacity="equal")

    assert_tiles(layout, NOTCH.area)
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


@pytest.mark.slow
def test_centres_move_until_capacities_are_equal():
    """No weights solve for the initial centres in a star: the parts that its notches separate are too large."""
    layout = voronoi(n_sites=150, region=STAR, n_iterations=0, capacity="equal", seed=1)

    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


@pytest.mark.slow
def test_centres_converge_to_centres_of_mass():
    field = _density(fovea, None, BOX)[0]
    centres = points_in(BOX, 200, 0)
    for n_moves, furthest in ((2, 0.2), (8, 0.08)):
        cells = IncrementalCells(BOX)
        _equalise_capacities(cells, centres, field, n_moves)
        layout = as_layout(*cells.rings())
        mass, moment = field.moments(ring_edges(layout.xy_um, layout.ring_offsets), layout.centroid_um)
        off_um = np.hypot(*(moment / mass[:, np.newaxis] - cells.centres_um).T)

        np.testing.assert_allclose(mass, mass.mean(), rtol=1e-6)
        assert (off_um / np.sqrt(layout.area_um2)).max() < furthest


@pytest.mark.parametrize("is_own", [True, False], ids=["own", "assigned"])
@pytest.mark.parametrize("kind", ["uniform", "fovea", "picture"])
def test_mass_derivatives_agree_with_differences(kind, is_own):
    """Finite differences in a star, whose notches divide cells."""
    density, grid = {"uniform": (None, None), "fovea": (fovea, None), "picture": random_picture(STAR)}[kind]
    field = _density(density, grid, STAR)[0]
    centres, n, step_um2 = points_in(STAR, 15, 10), 15, 1e-5
    cells = IncrementalCells(STAR)

    def mass(weights):
        edges = cells.update(centres, weights)
        assert (edges.cell != edges.owner).any()
        return _capacities(edges, weights, field, is_own=is_own).mass

    measured = np.stack([mass(w) - mass(-w) for w in step_um2 * np.eye(n)], axis=1) / (2 * step_um2)
    slopes = _slopes(centres, field, cells.update(centres, np.zeros(n)), is_own=is_own).toarray()

    np.testing.assert_allclose(slopes, measured, atol=1e-3 * np.abs(slopes).max())
    np.testing.assert_allclose(slopes.sum(axis=0), 0.0, atol=1e-12)


@pytest.mark.slow
def test_equal_capacity_layout_is_reproducible():
    first, repeated = (voronoi(n_sites=40, region=STAR, density=fovea, capacity="equal", seed=3) for _ in range(2))

    assert_same(first, repeated)


@pytest.mark.slow
def test_equal_capacity_of_discontinuous_function_raises():
    with pytest.raises(GeometryError, match=r"found no cells of equal capacity: the smallest .* a picture instead"):
        voronoi(
            n_sites=10,
            size_um=(10.0, 10.0),
            density=lambda xy_um: 1.0 + 99.0 * (np.hypot(*xy_um.T) < 3.3),
            capacity="equal",
            n_iterations=0,
            seed=1,
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_sites": 0}, "'n_sites' must be >= 1"),
        ({"n_iterations": -1}, "'n_iterations' must be >= 0"),
        ({"capacity": "same"}, "'capacity' must be one of 'free', 'equal'"),
        ({"seed": -1}, "'seed' must be >= 0"),
        ({"size_um": None}, "'size_um' or 'region' or 'density_grid' must be given"),
        ({"size_um": (1.0, 2.0, 3.0)}, "'size_um' must be two numbers"),
        ({"size_um": (1.0, 0.0)}, r"'size_um\[1\]' must be > 0"),
        ({"region": BOX}, "'region' and 'size_um' exclude each other"),
        ({"size_um": None, "region": [(0, 0), (1, 1)]}, "'region' must have the shape"),
        (
            {"size_um": None, "region": [(0, 0), (1, 1), (1, 0), (0, 1)]},
            "'region' must be (one|a valid|a shapely) [pP]olygon",
        ),
        ({"size_um": None, "region": shapely.Point(0, 0)}, "'region' must be (one|a valid|a shapely) [pP]olygon"),
        ({"size_um": None, "region": shapely.box(0, 0, 1e8, 1)}, "'region' must lie within"),
        ({"density": np.ones((2, 2))}, "'density_grid' must be the Grid"),
        (
            {"density": np.ones((2, 2)), "density_grid": Grid.centred((2, 3), 10.0)},
            "'density' must have the grid's shape",
        ),
        ({"density": np.ones((2, 2)), "density_grid": Grid.centred((2, 2), 1.0)}, "'density_grid' must cover"),
        ({"density": -np.ones((2, 2)), "density_grid": Grid.centred((2, 2), 10.0)}, "'density' must be >= 0"),
        (
            {"density": np.zeros((2, 2)), "density_grid": Grid.centred((2, 2), 10.0)},
            "'density' must be above 0 somewhere",
        ),
        ({"density": lambda xy: xy}, "'density' must return one value for each"),
        ({"density": lambda xy: xy[:, 0] - 100}, "'density' must be >= 0"),
        ({"density": lambda xy: 0 * xy[:, 0]}, "'density' must be above 0 somewhere"),
    ],
)
def test_invalid_density_or_region_raises(changes, message):
    with pytest.raises(ParameterError, match=message):
        voronoi(**{"n_sites": 10, "size_um": (10.0, 10.0), **changes})


# -- quadtree --------------------------------------------------------------------------------------------------------


@st.composite
def pictures(draw):
    n_levels = draw(st.integers(0, 4))
    shape = tuple(2**n_levels * draw(st.integers(1, 3)) for _ in range(2))
    rng = np.random.default_rng(draw(seeds))
    return n_levels, (rng.random(shape) < draw(st.sampled_from([0.0, 0.01, 0.1, 0.5]))) * rng.random(shape)


measures = st.sampled_from(["sum", "peak"])


@given(pictures(), measures, st.floats(0.0, 1.0), st.floats(0.05, 50.0))
@relaxed
def test_quadtree_squares_tile_picture(drawn, measure, limit, pitch_um):
    n_levels, picture = drawn
    layout = quadtree(picture, pitch_um=pitch_um, limit=limit, n_levels=n_levels, measure=measure)
    sides = 2.0 ** (n_levels - layout.columns["level"])

    assert_tiles(layout, picture.size * pitch_um**2)
    assert (sides**2).sum() == picture.size
    np.testing.assert_allclose(layout.area_um2, (sides * pitch_um) ** 2, rtol=1e-9)


@given(pictures(), measures, st.floats(0.0, 1.0))
@relaxed
def test_quadtree_neighbours_differ_by_one_level(drawn, measure, limit):
    """Levels of adjacent pixels in a picture of the levels."""
    n_levels, picture = drawn
    layout = quadtree(picture, pitch_um=1.0, limit=limit, n_levels=n_levels, measure=measure)
    level_of_pixel = np.full(picture.shape, -9)
    for level, row, column in zip(*(layout.columns[name] for name in ("level", "row", "column")), strict=True):
        side = 2 ** (n_levels - level)
        assert row % side == 0
        assert column % side == 0
        level_of_pixel[row : row + side, column : column + side] = level

    assert np.abs(np.diff(level_of_pixel, axis=0)).max(initial=0) <= 1
    assert np.abs(np.diff(level_of_pixel, axis=1)).max(initial=0) <= 1


@given(pictures(), measures, st.floats(0.0, 1.0))
@relaxed
def test_quadtree_squares_are_below_limit(drawn, measure, limit):
    n_levels, picture = drawn
    layout = quadtree(picture, pitch_um=1.0, limit=limit, n_levels=n_levels, measure=measure)
    for level, row, column in zip(*(layout.columns[name] for name in ("level", "row", "column")), strict=True):
        side = 2 ** (n_levels - level)
        block = picture[row : row + side, column : column + side]
        assert side == 1 or getattr(block, {"sum": "sum", "peak": "max"}[measure])() <= limit + 1e-12


def test_corner_pixel_gives_three_squares_per_level():
    picture = np.zeros((16, 16))
    picture[0, 0] = 1.0
    layout = quadtree(picture, pitch_um=1.0, limit=0.5, n_levels=4)

    assert np.bincount(layout.columns["level"]).tolist() == [0, 3, 3, 3, 4]


def test_balance_splits_unimportant_squares():
    """Without balance, a pixel at the centre line would result in adjacent squares with sides 1 and 4."""
    picture = np.zeros((8, 8))
    picture[0, 3] = 1.0
    layout = quadtree(picture, pitch_um=1.0, limit=0.5, n_levels=3)

    # Without balance: 3 of side 4, 3 of side 2, 4 of side 1; the square to the right is split once.
    assert np.bincount(layout.columns["level"]).tolist() == [0, 2, 7, 4]


def test_uniform_importance_gives_grid():
    layout = quadtree(np.ones((8, 16)), pitch_um=2.0, limit=4.0, n_levels=3)

    assert layout.n_sites == 32
    assert layout.columns["level"].tolist() == [2] * 32
    assert layout.bounds_um == (-16.0, -8.0, 16.0, 8.0)
    assert layout.centroid_um[0].tolist() == [-14.0, -6.0]


def test_larger_square_includes_corner_on_side():
    picture = np.zeros((2, 4))
    picture[0, 0] = 1.0
    layout = quadtree(picture, pitch_um=1.0, limit=0.5, n_levels=1)

    assert np.diff(layout.ring_offsets).tolist() == [4, 4, 5, 4, 4]
    assert [0.0, 0.0] in layout.xy_um[layout.ring_offsets[2] : layout.ring_offsets[3]].tolist()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"importance": np.ones((4, 6))}, "'importance' must have sides that are multiples of 4"),
        ({"importance": np.zeros((0, 4))}, "'importance' must have sides"),
        ({"importance": np.ones(4)}, "'importance' must have 2 dimensions"),
        ({"importance": -np.ones((4, 4))}, "'importance' must be >= 0"),
        ({"pitch_um": 0.0}, "'pitch_um' must be > 0"),
        ({"limit": -1.0}, "'limit' must be >= 0"),
        ({"n_levels": -1}, "'n_levels' must be >= 0"),
        ({"n_levels": 40}, "'n_levels' must be <= "),
        ({"measure": "mean"}, "'measure' must be one of 'sum', 'peak'"),
    ],
)
def test_invalid_quadtree_raises(changes, message):
    arguments = {"importance": np.ones((4, 4)), "pitch_um": 1.0, "limit": 1.0, "n_levels": 2, **changes}
    with pytest.raises(ParameterError, match=message):
        quadtree(arguments.pop("importance"), **arguments)


# -- Penrose rhombs --------------------------------------------------------------------------------------------------

shapes = st.sampled_from(["disc", "square"])


@pytest.mark.slow
@given(st.floats(0.1, 50.0), st.floats(3.0, 30.0), shapes)
@settings(relaxed, max_examples=examples(15))
def test_penrose_rhombs_tile_without_gaps(side_um, size, shape):
    layout = penrose(side_um=side_um, size_um=size * side_um, shape=shape)
    covered = shapely.union_all(layout.polygons())

    assert_tiles(layout, covered.area)
    assert shape == "square" or isinstance(covered, shapely.Polygon)
    assert shapely.get_num_interior_rings(shapely.get_parts(covered)).sum() == 0


@given(st.floats(0.1, 50.0), shapes)
@settings(relaxed, max_examples=examples(8))
def test_penrose_areas_have_golden_ratio(side_um, shape):
    layout = penrose(side_um=side_um, size_um=25 * side_um, shape=shape)
    corners = layout.xy_um.reshape(-1, 4, 2)
    is_thick = layout.columns["is_thick"] == 1

    np.testing.assert_allclose(np.hypot(*np.moveaxis(np.roll(corners, -1, 1) - corners, -1, 0)), side_um, rtol=1e-9)
    np.testing.assert_allclose(layout.area_um2[is_thick], math.sin(math.radians(72)) * side_um**2, rtol=1e-9)
    np.testing.assert_allclose(layout.area_um2[~is_thick], math.sin(math.radians(36)) * side_um**2, rtol=1e-9)
    assert layout.area_um2[is_thick].mean() / layout.area_um2[~is_thick].mean() == pytest.approx(1.618034, abs=1e-6)


@pytest.mark.parametrize(("size", "tolerance"), [(30, 0.06), (100, 0.02), (400, 0.005)])
def test_thick_to_thin_tends_to_golden_ratio(size, tolerance):
    is_thick = penrose(side_um=1.0, size_um=size, shape="square").columns["is_thick"]

    assert is_thick.sum() / (1 - is_thick).sum() == pytest.approx(1.618034, abs=tolerance)


@pytest.mark.parametrize(("shape", "fraction"), [("disc", math.pi / 4), ("square", 1.0)])
def test_penrose_rhombs_fill_given_size(shape, fraction):
    layout = penrose(side_um=1.0, size_um=200.0, shape=shape)

    assert layout.area_um2.sum() == pytest.approx(fraction * 200.0**2, rel=5e-3)


def test_penrose_layout_has_fivefold_symmetry():
    layout = penrose(side_um=1.0, size_um=30.0)
    tree = cKDTree(layout.centroid_um)

    def furthest(angle_deg):
        return tree.query(layout.rotate(angle_deg).centroid_um)[0].max()

    assert furthest(72.0) < 1e-9
    assert furthest(36.0) > 0.1


def test_penrose_vertices_have_known_angles():
    """Angles around an inner vertex add up to 360°, in one of the seven known configurations."""
    layout = penrose(side_um=1.0, size_um=40.0)
    corners = layout.xy_um.reshape(-1, 4, 2)
    before, after = np.roll(corners, 1, 1) - corners, np.roll(corners, -1, 1) - corners
    tenths = np.rint(np.degrees(np.arccos((before * after).sum(-1))) / 36).astype(int)
    points, index = np.unique(layout.xy_um, axis=0, return_inverse=True)
    is_inner = np.hypot(*points.T) < 17
    turns = np.bincount(index.ravel(), tenths.ravel())
    around = {}
    for point, angle in zip(index.ravel().tolist(), tenths.ravel().tolist(), strict=True):
        around.setdefault(point, []).append(angle)

    assert set(turns[is_inner].tolist()) == {10}
    assert len({tuple(sorted(around[p])) for p in np.flatnonzero(is_inner)}) <= 7


def test_larger_penrose_layout_contains_smaller_one():
    small, large = ({r.tobytes() for r in penrose(side_um=1.0, size_um=s).xy_um.reshape(-1, 8)} for s in (12.0, 150.0))

    assert small < large


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"side_um": 0.0}, "'side_um' must be > 0"),
        ({"size_um": -2.0}, "'size_um' must be > 0"),
        ({"size_um": 0.5}, "'size_um' must enclose the centre of at least one rhomb"),
        ({"side_um": 1e-3, "size_um": 1e4}, "'side_um' must give at most 50000000 sites"),
        ({"shape": "ring"}, "'shape' must be one of 'disc', 'square'"),
    ],
)
def test_invalid_penrose_layout_raises(changes, message):
    with pytest.raises(ParameterError, match=message):
        penrose(**{"side_um": 1.0, "size_um": 20.0, **changes})


# -- all -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "parameters"),
    [
        (fovi, {"fov_um": 100.0, "a_um": 10.0, "n_rings": 3}),
        (sunflower, {"n_sites": 20, "spacing_um": 1.0}),
        (voronoi, {"n_sites": 20, "size_um": (4.0, 3.0), "n_iterations": 1}),
        (quadtree, {"importance": np.eye(4), "pitch_um": 1.0, "limit": 0.5, "n_levels": 2}),
        (penrose, {"side_um": 1.0, "size_um": 8.0}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_provenance_contains_generator_and_parameters(make, parameters):
    layout = make(**parameters)

    assert layout.provenance["generator"] == make.__name__
    assert {"n_sites", "side_um", "fov_um", "pitch_um"} & set(layout.provenance["parameters"])


def test_provenance_reproduces_density_driven_sites():
    layout = voronoi(n_sites=30, region=STAR, n_iterations=2, seed=7)

    assert_same(voronoi(**layout.provenance["parameters"]), layout)


@pytest.mark.slow
def test_provenance_reproduces_equal_capacity_sites():
    layout = voronoi(n_sites=30, region=STAR, n_iterations=2, capacity="equal", seed=7)

    assert layout.provenance["parameters"]["capacity"] == "equal"
    assert_same(voronoi(**layout.provenance["parameters"]), layout)


def test_provenance_contains_rings_of_region():
    layout = voronoi(n_sites=60, region=FRAME, n_iterations=1)

    assert_tiles(layout, 400 - 64)
    assert [len(ring) for ring in layout.provenance["parameters"]["region"]] == [4, 4]


def test_provenance_contains_grid_of_picture():
    layout = voronoi(n_sites=9, density=np.ones((2, 3)), density_grid=Grid.centred((2, 3), 2.0), n_iterations=0)
    parameters = layout.provenance["parameters"]

    assert parameters["density"] == "picture of (2, 3) cells"
    assert Grid(**parameters["density_grid"]) == Grid.centred((2, 3), 2.0)


def test_provenance_contains_name_of_function():
    assert voronoi(n_sites=9, size_um=(9.0, 9.0), density=fovea).provenance["parameters"]["density"] == "fovea"
