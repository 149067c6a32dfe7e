"""Laws of the irregular families: Voronoi cells, foveal rings, sunflower, density, quadtree, Penrose's rhombs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid
from foveasim.layout import Layout
from foveasim.layout._regions import disc
from foveasim.layout._voronoi import MovingCells, cells_of, edges_of_rings
from foveasim.layout.generators.fovi import fovi
from foveasim.layout.generators.penrose import penrose
from foveasim.layout.generators.quadtree import quadtree
from foveasim.layout.generators.sunflower import sunflower
from foveasim.layout.generators.voronoi import _capacities, _density, _first_centres, _follow_equal, _slopes, voronoi

relaxed = settings(deadline=None, derandomize=True, max_examples=30)
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
    """The sites are one edge-matched coverage of this area: no overlap, no gap, no corner on another's side."""
    polygons = layout.polygons()
    a, b = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    common_um2 = shapely.area(shapely.intersection(polygons[a[a < b]], polygons[b[a < b]]))

    assert bool(np.all(shapely.is_valid(polygons)))
    assert bool(shapely.coverage_is_valid(polygons))
    assert bool((layout.area_um2 > 0).all())
    assert common_um2.max(initial=0.0) <= 1e-9 * layout.area_um2.min()
    assert layout.area_um2.sum() == pytest.approx(region_um2, rel=1e-9)
    assert shapely.union_all(polygons).area == pytest.approx(region_um2, rel=1e-9)


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
def test_cells_tile_any_region_one_for_each_centre(region, n, seed):
    centres = points_in(region, n, seed)
    layout = as_layout(*cells_of(centres, region))

    assert layout.n_sites == centres.shape[0]
    assert_tiles(layout, region.area)
    assert bool(np.all(shapely.intersects(layout.polygons(), shapely.points(centres))))


@given(st.sampled_from([BOX, disc(7.0, 31)]), st.integers(2, 60), seeds)
@relaxed
def test_every_point_of_a_cell_is_nearest_to_its_centre(region, n, seed):
    centres = points_in(region, n, seed)
    layout = as_layout(*cells_of(centres, region))
    points = points_in(region, 500, seed + 1)
    _, nearest = cKDTree(centres).query(points)

    assert bool(np.all(shapely.covers(layout.polygons()[nearest].tolist(), shapely.points(points))))


@given(st.integers(1, 12), st.integers(1, 12), st.floats(0.05, 50.0), st.floats(-1e4, 1e4))
@relaxed
def test_cells_of_a_square_grid_are_its_squares(n_x, n_y, pitch_um, x0_um):
    """Four cells meet in every corner: the case where rounding splits corners in two."""
    x, y = np.meshgrid((np.arange(n_x) + 0.5) * pitch_um + x0_um, (np.arange(n_y) + 0.5) * pitch_um)
    region = shapely.box(x0_um, 0, x0_um + n_x * pitch_um, n_y * pitch_um)
    layout = as_layout(*cells_of(np.stack((x.ravel(), y.ravel()), axis=1), region))

    assert_tiles(layout, region.area)
    np.testing.assert_allclose(layout.area_um2, pitch_um**2, rtol=1e-6)


def test_cells_of_a_hexagonal_packing_are_hexagons_inside():
    row, column = np.divmod(np.arange(400), 20)
    centres = np.stack((column + 0.5 * (row % 2), row * math.sqrt(3) / 2), axis=1)
    layout = as_layout(*cells_of(centres, shapely.box(-1, -1, 21, 18)))
    is_inside = (row > 0) & (row < 19) & (column > 0) & (column < 19)

    assert set(np.diff(layout.ring_offsets)[is_inside].tolist()) == {6}
    np.testing.assert_allclose(layout.area_um2[is_inside], math.sqrt(3) / 2, rtol=1e-12)


def test_a_part_that_a_notch_cuts_off_goes_to_its_neighbour():
    """The arms of a U: the centre of the left arm is nearest to the end of the right arm, too."""
    u = shapely.Polygon([(0, 0), (10, 0), (10, 10), (6, 10), (6, 1), (4, 1), (4, 10), (0, 10)])
    layout = as_layout(*cells_of(np.array([(3.9, 9.0), (9.9, 0.5)]), u))

    assert layout.n_sites == 2
    assert_tiles(layout, u.area)
    assert bool(np.all(shapely.get_type_id(layout.polygons()) == shapely.GeometryType.POLYGON))


@given(st.sampled_from([NOTCH, STAR]), st.integers(8, 80), seeds)
@settings(relaxed, max_examples=60)
def test_a_part_that_is_cut_off_goes_where_it_has_the_longest_border(region, n, seed):
    """The oracle's cells are shapely's; layouts with one such part."""
    centres = points_in(region, n, seed)
    whole = shapely.voronoi_polygons(shapely.multipoints(centres), extend_to=region, ordered=True)
    cells = shapely.intersection(shapely.get_parts(whole), region)
    parts, owner = shapely.get_parts(cells, return_index=True)
    is_left = ~shapely.intersects(parts, shapely.points(centres[owner]))
    assume(is_left.sum() == 1)
    part, mains = parts[is_left][0], parts[~is_left]
    shared_um = shapely.length(shapely.intersection(shapely.buffer(part, 1e-6), shapely.boundary(mains)))
    layout = as_layout(*cells_of(centres, region))
    assume(np.diff(np.sort(shared_um)[-2:])[0] > 1e-3)

    assert bool(shapely.contains(layout.polygons()[shared_um.argmax()], part.point_on_surface()))


def test_one_centre_takes_the_whole_region():
    layout = as_layout(*cells_of(np.array([(0.3, -0.2)]), STAR))

    assert shapely.equals(layout.polygons()[0], STAR)


def test_a_region_with_a_hole_is_tiled_when_no_cell_goes_round_it():
    layout = as_layout(*cells_of(points_in(FRAME, 60, 1), FRAME))

    assert_tiles(layout, 400 - 64)


def test_a_hundred_thousand_cells_tile():
    layout = as_layout(*cells_of(points_in(BOX, 100_000, 2), BOX))

    assert layout.n_sites == 100_000
    assert layout.area_um2.sum() == pytest.approx(BOX.area, rel=1e-12)
    assert bool(shapely.coverage_is_valid(layout.polygons()))


@pytest.mark.parametrize(
    ("centres", "region", "error", "message"),
    [
        ([(0, 0), (30, 0)], BOX, GeometryError, "centre 1 at .30, 0. µm does not lie inside"),
        ([(0, 0), (20, 0)], BOX, GeometryError, "centre 1 .* does not lie inside"),
        ([(0, 0), (1, 1), (0, 0)], BOX, GeometryError, "centres 0 and 2 are the same point"),
        ([(0, 0), (1e-300, 0)], BOX, GeometryError, "too close"),
        ([(7, 0)], FRAME, GeometryError, "centre 0 would be no simple outline"),
        (np.zeros((0, 2)), BOX, ParameterError, "shape .n, 2. with n >= 1"),
        (np.zeros((3, 3)), BOX, ParameterError, "shape .n, 2. with n >= 1"),
    ],
)
def test_centres_without_a_cell_are_refused(centres, region, error, message):
    with pytest.raises(error, match=message):
        cells_of(np.array(centres, float), region)


# -- cells that follow their centres -----------------------------------------------------------------------------------


def areas_um2(edges, n):
    """Shoelace sums of edges in any order."""
    (x0, y0), (x1, y1) = edges.start_um.T, edges.stop_um.T
    return np.bincount(edges.cell, 0.5 * (x0 * y1 - x1 * y0), minlength=n)


@given(st.sampled_from([BOX, NOTCH, STAR, FRAME]), st.integers(5, 120), st.sampled_from([0.05, 0.3, 1.0]), seeds)
@relaxed
def test_cells_that_follow_their_centres_are_those_made_anew(region, n, share_of_way, seed):
    """Also where a notch cuts cells apart, and whether centres move a little or anywhere."""
    centres, targets = points_in(region, n, seed), points_in(region, n, seed + 1)
    cells = MovingCells(region)
    for _ in range(4):
        edges = cells.follow(centres)
        expected = as_layout(*cells_of(centres, region)) if region is not FRAME else None
        tolerance_um2 = 1e-9 * region.area / n

        assert areas_um2(edges, n).sum() == pytest.approx(region.area, rel=1e-9)
        np.testing.assert_allclose(
            areas_um2(edges, n), areas_um2(MovingCells(region).follow(centres), n), atol=tolerance_um2
        )
        if expected is not None:
            np.testing.assert_allclose(areas_um2(edges, n), expected.area_um2, atol=tolerance_um2)
            assert_tiles(as_layout(*cells.rings()), region.area)
        moved = centres + share_of_way * (targets - centres)
        centres = np.where(shapely.contains_xy(region, moved)[:, np.newaxis], moved, centres)


@given(st.sampled_from([BOX, disc(7.0, 31)]), st.integers(1, 60), st.floats(0.0, 3.0), seeds)
@relaxed
def test_every_point_of_a_power_cell_has_the_least_power_from_its_centre(region, n, spread, seed):
    """Twice: for weights met first, and after other weights."""
    centres, points = points_in(region, n, seed), points_in(region, 500, seed + 1)
    rng = np.random.default_rng(seed)
    cells = MovingCells(region)
    for _ in range(2):
        weights = rng.random(n) * spread * region.area / n
        if cells.follow(centres, weights) is None:
            continue
        layout = as_layout(*cells.rings())
        power = ((points[:, np.newaxis] - centres) ** 2).sum(axis=2) - weights

        assert_tiles(layout, region.area)
        assert bool(np.all(shapely.covers(layout.polygons()[power.argmin(axis=1)].tolist(), shapely.points(points))))


def test_a_power_cell_need_not_hold_its_centre():
    cells = MovingCells(BOX)
    cells.follow(np.array([(0.0, 0.0), (2.0, 0.0)]), np.array([0.0, 10.0]))
    layout = as_layout(*cells.rings())

    # |x|² = (x - 2)² - 10 at x = -1.5, left of the first centre
    assert layout.bounds_um == BOX.bounds
    assert layout.polygons()[0].bounds == (-10.0, -5.0, -1.5, 8.0)


def test_a_centre_of_too_little_weight_has_no_cell():
    centres = points_in(BOX, 30, 0)
    weights = np.zeros(30)
    weights[4] = -1e3
    cells = MovingCells(BOX)

    assert cells.follow(centres, weights) is None
    assert cells.follow(centres) is not None
    assert cells.follow(centres, weights) is None


@pytest.mark.parametrize("more", [-1e5, 1e5])
def test_only_differences_of_weights_count(more):
    centres, weights = points_in(BOX, 30, 0), np.random.default_rng(0).random(30)

    np.testing.assert_allclose(
        areas_um2(MovingCells(BOX).follow(centres, weights + more), 30),
        areas_um2(MovingCells(BOX).follow(centres, weights), 30),
        rtol=1e-6,
    )


def test_edges_that_two_cells_share_are_found_from_both_sides():
    centres = points_in(STAR, 80, 3)
    edges = MovingCells(STAR).follow(centres)
    one, other = edges.twins()
    is_shared = np.zeros(edges.cell.size, bool)
    is_shared[one] = is_shared[other] = True
    rest = shapely.linestrings(np.stack((edges.start_um, edges.stop_um), axis=1)[~is_shared])

    assert np.array_equal(edges.start_um[one], edges.stop_um[other])
    assert np.array_equal(edges.stop_um[one], edges.start_um[other])
    assert shapely.length(rest).sum() == pytest.approx(STAR.length, rel=1e-9)
    assert shapely.distance(STAR.boundary, shapely.centroid(rest)).max() < 1e-9


# -- isotropic foveal rings ------------------------------------------------------------------------------------------


@given(st.floats(10.0, 5000.0), st.floats(1e-3, 1e3), st.integers(1, 25))
@relaxed
def test_foveal_rings_tile_their_disc_without_a_blind_spot(fov_um, a_share, n_rings):
    assume(n_rings > 1 or a_share > 0.1)
    layout = fovi(fov_um=fov_um, a_um=a_share * fov_um, n_rings=n_rings, n_chords=1000)

    assert_tiles(layout, regular_polygon_um2(1000, layout.provenance["radius_um"]))
    assert bool(shapely.contains_xy(layout.polygons()[0], 0.0, 0.0))


@given(st.floats(10.0, 5000.0), st.floats(1.0, 100.0), st.integers(2, 20))
@relaxed
def test_radii_and_numbers_of_foveal_sites_follow_the_rule(fov_um, a_um, n_rings):
    layout = fovi(fov_um=fov_um, a_um=a_um, n_rings=n_rings)
    w = np.linspace(math.log(a_um), math.log(fov_um / 2 + a_um), n_rings + 1)
    w = np.append(w, 2 * w[-1] - w[-2])
    r = np.exp(w) - a_um
    n_on_ring = np.bincount(layout.columns["ring"])

    assert n_on_ring[0] == 1
    for i in range(1, n_rings + 1):
        share = 2 * math.pi * r[i] / (0.5 * (r[i + 1] - r[i - 1]))
        assert n_on_ring[i] in {math.ceil(share - 1e-6), math.ceil(share + 1e-6)}


def test_foveal_sites_are_as_high_as_wide_from_the_fovea_to_the_border():
    """A site's area is the square of its ring's spacing, but for the rounding up of numbers."""
    layout = fovi(fov_um=1000.0, a_um=20.0, n_rings=60)
    ring = layout.columns["ring"]
    step = math.log1p(500.0 / 20.0) / 60
    r = 20.0 * np.expm1(step * np.arange(62))
    spacing_um2 = np.concatenate(([np.nan], (0.5 * (r[2:] - r[:-2])) ** 2))
    mean_um2 = np.bincount(ring, layout.area_um2) / np.bincount(ring)

    np.testing.assert_allclose(mean_um2[10:-1], spacing_um2[10:-1], rtol=0.02)
    assert bool((np.diff(mean_um2[5:-1]) > 0).all())


def test_a_fovea_larger_than_the_field_is_even():
    layout = fovi(fov_um=100.0, a_um=1e7, n_rings=5)

    assert np.bincount(layout.columns["ring"]).tolist() == [1, 7, 13, 19, 26, 32]


def test_foveal_sites_are_numbered_ring_by_ring_from_the_axis_to_the_right():
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
def test_impossible_foveal_rings_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        fovi(**{"fov_um": 1000.0, "a_um": 20.0, "n_rings": 5, **changes})


# -- sunflower -------------------------------------------------------------------------------------------------------


def sunflower_centres(n):
    k = np.arange(1, n + 1)
    angle = k * math.radians(360 * (1 - 1 / GOLDEN_RATIO))
    return 0.6242 * np.sqrt(k)[:, np.newaxis] * np.stack((np.cos(angle), np.sin(angle)), axis=1)


@given(st.integers(1, 400), st.floats(0.1, 50.0))
@relaxed
def test_a_sunflower_tiles_its_disc(n_sites, spacing_um):
    layout = sunflower(n_sites=n_sites, spacing_um=spacing_um, n_chords=720)

    assert layout.n_sites == n_sites
    assert layout.provenance["radius_um"] == pytest.approx(0.6242 * math.sqrt(n_sites + 0.5) * spacing_um, rel=1e-4)
    assert_tiles(layout, regular_polygon_um2(720, layout.provenance["radius_um"]))


@pytest.mark.parametrize("n_sites", [4, 50, 3000])
def test_the_closest_pair_of_a_sunflower_is_one_spacing_apart(n_sites):
    """Measured on the cells: neighbours' centres are mirrored in the side that they share."""
    layout = sunflower(n_sites=n_sites, spacing_um=2.0)
    centres = 2.0 * sunflower_centres(n_sites)

    assert nearest_um(centres).min() == pytest.approx(2.0, rel=1e-4)
    assert bool(np.all(shapely.contains_xy(layout.polygons(), centres[:, 0], centres[:, 1])))


def test_the_published_constant_puts_the_closest_pair_of_many_at_distance_one():
    distance = nearest_um(sunflower_centres(100_000))

    assert distance.min() == pytest.approx(1.0, rel=1e-4)
    assert sorted(np.argsort(distance)[:2].tolist()) == [0, 3]


def test_sunflower_sites_have_the_same_share_of_the_disc_inside():
    layout = sunflower(n_sites=5000, spacing_um=1.0)

    np.testing.assert_allclose(layout.area_um2[50:4500], math.pi * 0.6242**2, rtol=0.05)
    assert layout.area_um2[50:4500].mean() == pytest.approx(math.pi * 0.6242**2, rel=1e-3)


def test_the_spiral_turns_at_the_golden_angle():
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
def test_impossible_sunflowers_are_refused(changes, message):
    with pytest.raises(ParameterError, match=message):
        sunflower(**{"n_sites": 100, "spacing_um": 2.0, **changes})


# -- density ---------------------------------------------------------------------------------------------------------


def fovea(xy_um):
    return 1.0 / (1.0 + (xy_um**2).sum(axis=1) / 25.0)


def watson_per_um2(xy_um):
    """Ganglion cells of the human retina on the temporal side (Watson 2014), 1° as 1 µm for a small layout."""
    r = np.hypot(*xy_um.T)
    return 2 * 14804.6 / (1 + r / 41.03) * (0.9851 * (1 + r / 1.058) ** -2 + (1 - 0.9851) * np.exp(-r / 22.14))


@given(st.integers(1, 150), regions, st.sampled_from([None, fovea]), st.integers(0, 3), seeds)
@relaxed
def test_density_driven_sites_tile_any_region(n_sites, region, density, n_iterations, seed):
    layout = voronoi(n_sites=n_sites, region=region, density=density, n_iterations=n_iterations, seed=seed)

    assert layout.n_sites == n_sites
    assert_tiles(layout, region.area)
    assert layout.columns["share"].mean() == pytest.approx(1.0, rel=1e-12)


@given(seeds)
@settings(relaxed, max_examples=5)
def test_one_seed_gives_one_layout_and_another_another(seed):
    one, again, other = (voronoi(n_sites=50, size_um=(9.0, 6.0), density=fovea, seed=s) for s in (seed, seed, seed + 1))

    assert_same(one, again)
    assert not np.array_equal(one.xy_um[:20], other.xy_um[:20])


def test_lloyds_steps_end_with_centres_in_the_middle_of_equal_cells():
    rough, even = (voronoi(n_sites=800, size_um=(40.0, 30.0), n_iterations=n) for n in (0, 60))

    assert rough.area_um2.std() / rough.area_um2.mean() > 0.15
    assert even.area_um2.std() / even.area_um2.mean() < 0.08


def test_evened_centres_keep_the_distance_of_blue_noise():
    """The closest pair is no closer than 0.7 of the hexagonal packing's spacing; of random points it is about 0."""
    layout = voronoi(n_sites=2000, size_um=(50.0, 40.0), n_iterations=40)

    assert nearest_um(layout.centroid_um).min() > 0.7 * math.sqrt(2 / math.sqrt(3))


def test_the_cone_mosaic_has_the_published_density_and_spacing():
    """249,800 cones/mm² are a spacing of 2.15 µm in hexagonal packing."""
    n_sites = round(249_800e-6 * 100.0 * 80.0)
    layout = voronoi(n_sites=n_sites, size_um=(100.0, 80.0), n_iterations=40)
    spacing_um = np.sqrt(2 / math.sqrt(3) * layout.area_um2)

    assert n_sites == 1998
    assert np.sqrt(np.mean(spacing_um**2)) == pytest.approx(2.15, rel=1e-3)
    assert 0.85 * 2.15 < nearest_um(layout.centroid_um).mean() < 2.15


@pytest.mark.parametrize("n_iterations", [0, 20])
def test_sites_in_a_circle_are_as_many_as_the_density_asks(n_iterations):
    """The integral of 1/(1 + r²/s²) over a disc is π s² ln(1 + r²/s²); off by less than the cells on the circle."""
    n_sites, scale_um = 4000, 5.0
    outline = disc(100.0, 720)
    layout = voronoi(n_sites=n_sites, region=outline, density=fovea, n_iterations=n_iterations)
    r = np.hypot(*layout.centroid_um.T)
    for radius_um in (5.0, 10.0, 30.0, 60.0):
        expected = n_sites * math.log1p((radius_um / scale_um) ** 2) / math.log1p((100.0 / scale_um) ** 2)
        assert (r < radius_um).sum() == pytest.approx(expected, abs=2.0 * math.sqrt(expected))
    assert layout.columns["share"].std() < (0.35, 0.08)[n_iterations > 0]


def test_the_retinas_density_gives_the_retinas_spacing():
    """Watson's formula over 30°: a site's spacing is sqrt(2 / (√3 d)), with d in sites per area."""
    outline = disc(30.0, 360)
    layout = voronoi(n_sites=3000, region=outline, density=watson_per_um2)
    r = np.hypot(*layout.centroid_um.T)
    edges = np.linspace(0.0, 30.0, 300_001)
    middle = 0.5 * (edges[1:] + edges[:-1])
    total = (2 * math.pi * middle * watson_per_um2(np.stack((middle, 0 * middle), axis=1))).sum() * 1e-4
    d = 3000 / total * watson_per_um2(layout.centroid_um)
    is_inside = (r > 1.0) & (r < 28.0)
    spacing_um = np.sqrt(2 / math.sqrt(3) * layout.area_um2)

    assert np.median((spacing_um / np.sqrt(2 / (math.sqrt(3) * d)))[is_inside]) == pytest.approx(1.0, abs=0.02)


def test_a_picture_says_where_sites_are():
    picture = np.ones((20, 30))
    picture[:, 15:] = 9.0
    layout = voronoi(n_sites=1000, density=picture, density_grid=Grid.centred((20, 30), 2.0))

    assert_tiles(layout, 20 * 30 * 4.0)
    assert (layout.centroid_um[:, 0] > 0).sum() == pytest.approx(900, abs=30)


def test_few_sites_lie_where_a_picture_is_black():
    picture = np.zeros((30, 50))
    picture[5:25, 10:40] = 1.0
    layout = voronoi(n_sites=600, density=picture, density_grid=Grid.centred((30, 50), 1.0))
    x, y = np.abs(layout.centroid_um).T

    assert_tiles(layout, 1500.0)
    assert ((x < 15) & (y < 10)).sum() > 0.8 * 600


def slope(xy_um):
    return 20.0 + xy_um[:, 0] - 0.5 * xy_um[:, 1]


def rough(region):
    """A picture that jumps from cell to cell, over a region."""
    low, high = np.reshape(region.bounds, (2, 2))
    pitch_um = (high - low).max() / 16
    return np.random.default_rng(8).random((16, 16)) + 0.05, Grid((16, 16), pitch_um, tuple(low))


def of_picture(region, picture=None):
    values, grid = rough(region)
    return {"density": values if picture is None else picture, "density_grid": grid}


def picture_in(polygon, values, grid, power=1):
    """Integrals over a polygon of a picture's power, and of that times x and y: cell by cell of the picture."""
    rows, columns = np.divmod(np.arange(values.size), values.shape[1])
    x0, y0 = grid.origin_um[0] + columns * grid.pitch_um, grid.origin_um[1] + rows * grid.pitch_um
    common = shapely.intersection(shapely.box(x0, y0, x0 + grid.pitch_um, y0 + grid.pitch_um), polygon)
    weight = values.ravel() ** power * shapely.area(common)
    middle = np.where(weight[:, np.newaxis] > 0, shapely.get_coordinates(shapely.centroid(polygon)), 0.0)
    middle[weight > 0] = shapely.get_coordinates(shapely.centroid(common[weight > 0]))
    return weight.sum(), weight @ middle


def function_in(ring, centre, function):
    """The same of a function's square, by three points of each triangle of an edge and the centre."""
    mass, moment = 0.0, np.zeros(2)
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        area_um2 = 0.5 * ((a - centre)[0] * (b - centre)[1] - (a - centre)[1] * (b - centre)[0])
        for corners in ((centre, centre, a, b), (a, centre, a, b), (b, centre, a, b)):
            point = (3 * np.array(corners[0]) + np.sum(corners[1:], axis=0)) / 6
            mass += area_um2 / 3 * function(point[np.newaxis])[0] ** 2
            moment += area_um2 / 3 * function(point[np.newaxis])[0] ** 2 * point
    return mass, moment


@given(regions, st.integers(1, 25), st.sampled_from(["even", "function", "picture"]), st.integers(1, 3), seeds)
@settings(relaxed, max_examples=15)
def test_lloyds_quick_steps_are_those_of_whole_cells(region, n_sites, kind, n_iterations, seed):
    """The twin makes all cells each time, and takes them one by one."""
    density, grid = {"even": (None, None), "function": (fovea, None), "picture": rough(region)}[kind]
    centres = _first_centres(n_sites, *_density(density, grid, region)[1:], region, seed)
    for _ in range(n_iterations):
        cells = as_layout(*cells_of(centres, region))
        for i, polygon in enumerate(cells.polygons()):
            if kind == "even":
                mass, moment = polygon.area, polygon.area * shapely.get_coordinates(polygon.centroid)[0]
            elif kind == "function":
                mass, moment = function_in(shapely.get_coordinates(polygon)[:-1], centres[i], fovea)
            else:
                mass, moment = picture_in(polygon, density, grid, power=2)
            if shapely.contains_xy(region, *(moment / mass)):
                centres[i] = moment / mass
    twin = as_layout(*cells_of(centres, region))
    layout = voronoi(
        n_sites=n_sites, region=region, density=density, density_grid=grid, n_iterations=n_iterations, seed=seed
    )

    np.testing.assert_allclose(layout.area_um2, twin.area_um2, rtol=1e-9)
    np.testing.assert_allclose(layout.centroid_um, twin.centroid_um, atol=1e-8)
    np.testing.assert_allclose(shapely.length(layout.polygons()), shapely.length(twin.polygons()), rtol=1e-9)


@pytest.mark.parametrize("capacity", ["free", "equal"])
def test_shares_are_the_integrals_of_a_picture(capacity):
    values, grid = rough(STAR)
    layout = voronoi(n_sites=40, region=STAR, density=values, density_grid=grid, n_iterations=3, capacity=capacity)
    mass = np.array([picture_in(polygon, values, grid)[0] for polygon in layout.polygons()])

    np.testing.assert_allclose(layout.columns["share"], mass / mass.mean(), rtol=1e-9)


@pytest.mark.parametrize("capacity", ["free", "equal"])
def test_shares_are_the_integrals_of_a_function(capacity):
    """Of one that is linear in x and y: the area times the value in the middle."""
    layout = voronoi(n_sites=40, region=NOTCH, density=slope, n_iterations=3, capacity=capacity)
    mass = layout.area_um2 * slope(layout.centroid_um)

    np.testing.assert_allclose(layout.columns["share"], mass / mass.mean(), rtol=1e-9)


@pytest.mark.parametrize("width_um", [0.5, 2.0, 20.0])
@pytest.mark.parametrize("n_sites", [1, 40])
def test_a_functions_integrals_are_right_to_seven_digits(width_um, n_sites):
    """A bell over a box, of closed form, narrower and wider than sites."""

    def bell(xy_um):
        return np.exp(-(xy_um**2).sum(axis=1) / (2 * width_um**2))

    layout = voronoi(n_sites=n_sites, region=BOX, n_iterations=2)
    field = _density(bell, None, BOX)[0]
    mass, _ = field.moments(edges_of_rings(layout.xy_um, layout.ring_offsets), layout.centroid_um)
    x, y = (
        math.erf(high / width_um / math.sqrt(2)) - math.erf(low / width_um / math.sqrt(2))
        for low, high in ((-10, 20), (-5, 8))
    )

    assert mass.sum() == pytest.approx(0.5 * math.pi * width_um**2 * x * y, rel=1e-7)


@given(
    st.integers(1, 60),
    st.sampled_from([BOX, NOTCH, disc(7.0, 31)]),
    st.sampled_from(["even", "fovea", "picture"]),
    st.integers(0, 4),
    seeds,
)
@relaxed
def test_sites_of_equal_capacity_tile_and_hold_the_same(n_sites, region, kind, n_iterations, seed):
    density = {"even": {}, "fovea": {"density": fovea}, "picture": of_picture(region)}[kind]
    layout = voronoi(n_sites=n_sites, region=region, n_iterations=n_iterations, capacity="equal", seed=seed, **density)

    assert layout.n_sites == n_sites
    assert_tiles(layout, region.area)
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


@pytest.mark.parametrize("region", [BOX, NOTCH, STAR, FRAME], ids=["box", "notch", "star", "frame"])
@pytest.mark.parametrize("n_sites", [30, 300])
def test_equal_capacity_of_an_even_density_is_equal_area(n_sites, region):
    """With a star's notches, too, that cut cells apart: capacities jump there, and centres have to move on."""
    layout = voronoi(n_sites=n_sites, region=region, capacity="equal", n_iterations=5)

    assert_tiles(layout, region.area)
    np.testing.assert_allclose(layout.area_um2, region.area / n_sites, rtol=1e-6)


def test_sites_of_equal_capacity_are_as_even_as_free_ones():
    """Closest pairs, and the perimeter of a site of unit area: of a hexagon 3.72, of a square 4."""
    free, equal = (voronoi(n_sites=1000, size_um=(40.0, 25.0), capacity=capacity) for capacity in ("free", "equal"))
    around_free, around_equal = (
        np.median(shapely.length(layout.polygons()) / np.sqrt(layout.area_um2)) for layout in (free, equal)
    )

    assert nearest_um(equal.centroid_um).min() > 0.7 * math.sqrt(2 / math.sqrt(3))
    assert around_equal == pytest.approx(around_free, abs=0.05)
    assert free.columns["share"].std() > 0.05


def test_equal_capacity_holds_where_a_density_falls_to_a_ten_thousandth():
    layout = voronoi(
        n_sites=2000, region=disc(100.0, 360), density=lambda xy_um: fovea(5 * xy_um) ** 1.5, capacity="equal"
    )

    assert layout.area_um2.max() > 1000 * layout.area_um2.min()
    assert_tiles(layout, regular_polygon_um2(360, 100.0))
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


@pytest.mark.parametrize("n_sites", [5, 40])
def test_equal_capacity_reaches_over_black_parts_of_a_picture(n_sites):
    """White squares on black, whose numbers of sites would not be whole."""
    picture = np.zeros((16, 16))
    picture[1:4, 1:4] = picture[1:4, 11:15] = picture[10:15, 6:9] = 1.0
    layout = voronoi(n_sites=n_sites, region=BOX, capacity="equal", n_iterations=4, **of_picture(BOX, picture))

    assert_tiles(layout, BOX.area)
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


def test_of_a_cell_that_a_notch_cuts_apart_the_heaviest_part_stays():
    """White in the two arms of an angle: a cell's larger part may be black, and its smaller one hold all."""
    picture = np.zeros((60, 60))
    picture[15:50, 20:55] = 1.0
    grid = Grid((60, 60), 1 / 6)
    layout = voronoi(n_sites=30, region=NOTCH, density=picture, density_grid=grid, n_iterations=0, capacity="equal")

    assert_tiles(layout, NOTCH.area)
    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


def test_centres_move_on_where_they_have_no_cells_of_equal_capacity():
    """No weights do with these first centres in a star: parts that its notches cut off are too large."""
    layout = voronoi(n_sites=150, region=STAR, n_iterations=0, capacity="equal", seed=1)

    np.testing.assert_allclose(layout.columns["share"], 1.0, atol=1e-6)


def test_centres_come_to_lie_in_the_middle_of_cells_of_equal_capacity():
    field = _density(fovea, None, BOX)[0]
    centres = points_in(BOX, 200, 0)
    for n_moves, furthest in ((2, 0.2), (8, 0.08)):
        cells = MovingCells(BOX)
        _follow_equal(cells, centres, field, n_moves)
        layout = as_layout(*cells.rings())
        mass, moment = field.moments(edges_of_rings(layout.xy_um, layout.ring_offsets), layout.centroid_um)
        off_um = np.hypot(*(moment / mass[:, np.newaxis] - cells.centres_um).T)

        np.testing.assert_allclose(mass, mass.mean(), rtol=1e-6)
        assert (off_um / np.sqrt(layout.area_um2)).max() < furthest


@pytest.mark.parametrize("is_own", [True, False], ids=["own", "given"])
@pytest.mark.parametrize("kind", ["even", "fovea", "picture"])
def test_masses_change_with_weights_as_the_edges_sweep(kind, is_own):
    """In a star, whose notches cut cells apart; measured by small steps of each weight."""
    density, grid = {"even": (None, None), "fovea": (fovea, None), "picture": rough(STAR)}[kind]
    field = _density(density, grid, STAR)[0]
    centres, n, step_um2 = points_in(STAR, 25, 10), 25, 1e-5
    cells = MovingCells(STAR)

    def mass(weights):
        edges = cells.follow(centres, weights)
        assert (edges.cell != edges.owner).any()
        return _capacities(edges, weights, field, is_own=is_own).mass

    measured = np.stack([mass(w) - mass(-w) for w in step_um2 * np.eye(n)], axis=1) / (2 * step_um2)
    slopes = _slopes(centres, field, cells.follow(centres, np.zeros(n)), is_own=is_own).toarray()

    np.testing.assert_allclose(slopes, measured, atol=1e-3 * np.abs(slopes).max())
    np.testing.assert_allclose(slopes.sum(axis=0), 0.0, atol=1e-12)


def test_one_seed_gives_one_layout_of_equal_capacity():
    one, again = (voronoi(n_sites=40, region=STAR, density=fovea, capacity="equal", seed=3) for _ in range(2))

    assert_same(one, again)


def test_equal_capacity_of_a_function_that_jumps_is_refused():
    with pytest.raises(
        GeometryError, match=r"found no cells of equal capacity: the best ones differ .*a picture of it"
    ):
        voronoi(
            n_sites=20,
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
        ({"size_um": None}, "'size_um' or 'region' or 'density_grid' must tell"),
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
        ({"density": lambda xy: xy}, "'density' must give one value for each"),
        ({"density": lambda xy: xy[:, 0] - 100}, "'density' must be >= 0"),
        ({"density": lambda xy: 0 * xy[:, 0]}, "'density' must be above 0 somewhere"),
    ],
)
def test_impossible_densities_and_regions_are_refused(changes, message):
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
def test_the_squares_of_a_quadtree_tile_the_die(drawn, measure, limit, pitch_um):
    n_levels, picture = drawn
    layout = quadtree(picture, pitch_um=pitch_um, limit=limit, n_levels=n_levels, measure=measure)
    sides = 2.0 ** (n_levels - layout.columns["level"])

    assert_tiles(layout, picture.size * pitch_um**2)
    assert (sides**2).sum() == picture.size
    np.testing.assert_allclose(layout.area_um2, (sides * pitch_um) ** 2, rtol=1e-9)


@given(pictures(), measures, st.floats(0.0, 1.0))
@relaxed
def test_neighbours_in_a_quadtree_differ_by_one_level_at_most(drawn, measure, limit):
    """Measured on the painted picture: the level of each pixel against those beside and above it."""
    n_levels, picture = drawn
    layout = quadtree(picture, pitch_um=1.0, limit=limit, n_levels=n_levels, measure=measure)
    painted = np.full(picture.shape, -9)
    for level, row, column in zip(*(layout.columns[name] for name in ("level", "row", "column")), strict=True):
        side = 2 ** (n_levels - level)
        assert row % side == 0
        assert column % side == 0
        painted[row : row + side, column : column + side] = level

    assert np.abs(np.diff(painted, axis=0)).max(initial=0) <= 1
    assert np.abs(np.diff(painted, axis=1)).max(initial=0) <= 1


@given(pictures(), measures, st.floats(0.0, 1.0))
@relaxed
def test_no_square_of_a_quadtree_is_more_important_than_the_limit_unless_it_is_smallest(drawn, measure, limit):
    n_levels, picture = drawn
    layout = quadtree(picture, pitch_um=1.0, limit=limit, n_levels=n_levels, measure=measure)
    for level, row, column in zip(*(layout.columns[name] for name in ("level", "row", "column")), strict=True):
        side = 2 ** (n_levels - level)
        block = picture[row : row + side, column : column + side]
        assert side == 1 or getattr(block, {"sum": "sum", "peak": "max"}[measure])() <= limit + 1e-12


def test_one_important_pixel_in_a_corner_takes_three_squares_of_each_side():
    picture = np.zeros((16, 16))
    picture[0, 0] = 1.0
    layout = quadtree(picture, pitch_um=1.0, limit=0.5, n_levels=4)

    assert np.bincount(layout.columns["level"]).tolist() == [0, 3, 3, 3, 4]


def test_balance_splits_where_nothing_is_asked():
    """A pixel beside the middle line would leave squares of side 1 and 4 beside each other."""
    picture = np.zeros((8, 8))
    picture[0, 3] = 1.0
    layout = quadtree(picture, pitch_um=1.0, limit=0.5, n_levels=3)

    # Without balance: 3 of side 4, 3 of side 2, 4 of side 1; the square to the right is split once.
    assert np.bincount(layout.columns["level"]).tolist() == [0, 2, 7, 4]


def test_an_even_limit_makes_a_plain_grid():
    layout = quadtree(np.ones((8, 16)), pitch_um=2.0, limit=4.0, n_levels=3)

    assert layout.n_sites == 32
    assert layout.columns["level"].tolist() == [2] * 32
    assert layout.bounds_um == (-16.0, -8.0, 16.0, 8.0)
    assert layout.centroid_um[0].tolist() == [-14.0, -6.0]


def test_a_corner_on_a_side_belongs_to_the_larger_square_too():
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
def test_impossible_quadtrees_are_refused(changes, message):
    arguments = {"importance": np.ones((4, 4)), "pitch_um": 1.0, "limit": 1.0, "n_levels": 2, **changes}
    with pytest.raises(ParameterError, match=message):
        quadtree(arguments.pop("importance"), **arguments)


# -- Penrose's rhombs ------------------------------------------------------------------------------------------------

shapes = st.sampled_from(["disc", "square"])


@given(st.floats(0.1, 50.0), st.floats(3.0, 40.0), shapes)
@relaxed
def test_penrose_rhombs_leave_no_gap_and_no_overlap(side_um, size, shape):
    layout = penrose(side_um=side_um, size_um=size * side_um, shape=shape)
    whole = shapely.union_all(layout.polygons())

    assert_tiles(layout, whole.area)
    assert shape == "square" or isinstance(whole, shapely.Polygon)
    assert shapely.get_num_interior_rings(shapely.get_parts(whole)).sum() == 0


@given(st.floats(0.1, 50.0), shapes)
@settings(relaxed, max_examples=8)
def test_penrose_rhombs_have_two_shapes_with_areas_in_the_golden_ratio(side_um, shape):
    layout = penrose(side_um=side_um, size_um=25 * side_um, shape=shape)
    corners = layout.xy_um.reshape(-1, 4, 2)
    is_thick = layout.columns["is_thick"] == 1

    np.testing.assert_allclose(np.hypot(*np.moveaxis(np.roll(corners, -1, 1) - corners, -1, 0)), side_um, rtol=1e-9)
    np.testing.assert_allclose(layout.area_um2[is_thick], math.sin(math.radians(72)) * side_um**2, rtol=1e-9)
    np.testing.assert_allclose(layout.area_um2[~is_thick], math.sin(math.radians(36)) * side_um**2, rtol=1e-9)
    assert layout.area_um2[is_thick].mean() / layout.area_um2[~is_thick].mean() == pytest.approx(1.618034, abs=1e-6)


@pytest.mark.parametrize(("size", "tolerance"), [(30, 0.06), (100, 0.02), (400, 0.005)])
def test_thick_to_thin_tends_to_the_golden_ratio(size, tolerance):
    is_thick = penrose(side_um=1.0, size_um=size, shape="square").columns["is_thick"]

    assert is_thick.sum() / (1 - is_thick).sum() == pytest.approx(1.618034, abs=tolerance)


@pytest.mark.parametrize(("shape", "share"), [("disc", math.pi / 4), ("square", 1.0)])
def test_penrose_rhombs_fill_the_size_that_was_asked_for(shape, share):
    layout = penrose(side_um=1.0, size_um=200.0, shape=shape)

    assert layout.area_um2.sum() == pytest.approx(share * 200.0**2, rel=5e-3)


def test_penrose_rhombs_are_the_same_after_a_fifth_of_a_turn_and_no_less():
    layout = penrose(side_um=1.0, size_um=30.0)
    tree = cKDTree(layout.centroid_um)

    def furthest(angle_deg):
        return tree.query(layout.rotate(angle_deg).centroid_um)[0].max()

    assert furthest(72.0) < 1e-9
    assert furthest(36.0) > 0.1


def test_penrose_rhombs_meet_edge_to_edge_around_every_corner():
    """Whole turns: the angles around an inner corner, in tenths of a turn, make ten, in one of the seven known ways."""
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


def test_a_larger_penrose_layout_holds_every_rhomb_of_a_smaller_one_bit_for_bit():
    small, large = ({r.tobytes() for r in penrose(side_um=1.0, size_um=s).xy_um.reshape(-1, 8)} for s in (12.0, 150.0))

    assert small < large


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"side_um": 0.0}, "'side_um' must be > 0"),
        ({"size_um": -2.0}, "'size_um' must be > 0"),
        ({"size_um": 0.5}, "'size_um' leaves no rhomb"),
        ({"side_um": 1e-3, "size_um": 1e4}, "'side_um' gives more than"),
        ({"shape": "ring"}, "'shape' must be one of 'disc', 'square'"),
    ],
)
def test_impossible_penrose_layouts_are_refused(changes, message):
    with pytest.raises(ParameterError, match=message):
        penrose(**{"side_um": 1.0, "size_um": 20.0, **changes})


# -- all -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layout", "generator"),
    [
        (fovi(fov_um=100.0, a_um=10.0, n_rings=3), "fovi"),
        (sunflower(n_sites=20, spacing_um=1.0), "sunflower"),
        (voronoi(n_sites=20, size_um=(4.0, 3.0), n_iterations=1), "voronoi"),
        (quadtree(np.eye(4), pitch_um=1.0, limit=0.5, n_levels=2), "quadtree"),
        (penrose(side_um=1.0, size_um=8.0), "penrose"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_irregular_layouts_tell_their_origin(layout, generator):
    assert layout.provenance["generator"] == generator
    assert {"n_sites", "side_um", "fov_um", "pitch_um"} & set(layout.provenance["parameters"])


def test_the_told_origin_of_density_driven_sites_makes_the_same_sites():
    layout = voronoi(n_sites=30, region=STAR, n_iterations=2, seed=7)

    assert_same(voronoi(**layout.provenance["parameters"]), layout)


def test_the_told_origin_of_sites_of_equal_capacity_makes_the_same_sites():
    layout = voronoi(n_sites=30, region=STAR, n_iterations=2, capacity="equal", seed=7)

    assert layout.provenance["parameters"]["capacity"] == "equal"
    assert_same(voronoi(**layout.provenance["parameters"]), layout)


def test_a_region_with_a_hole_is_told_ring_by_ring():
    layout = voronoi(n_sites=60, region=FRAME, n_iterations=1)

    assert_tiles(layout, 400 - 64)
    assert [len(ring) for ring in layout.provenance["parameters"]["region"]] == [4, 4]


def test_density_driven_sites_tell_the_grid_of_their_picture():
    layout = voronoi(n_sites=9, density=np.ones((2, 3)), density_grid=Grid.centred((2, 3), 2.0), n_iterations=0)
    parameters = layout.provenance["parameters"]

    assert parameters["density"] == "picture of (2, 3) cells"
    assert Grid(**parameters["density_grid"]) == Grid.centred((2, 3), 2.0)


def test_a_function_of_density_is_told_by_its_name():
    assert voronoi(n_sites=9, size_um=(9.0, 9.0), density=fovea).provenance["parameters"]["density"] == "fovea"
