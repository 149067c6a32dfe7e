"""Voronoi cells of given points: order, partition, membership, regions, invalid points."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import voronoi_of

BOX = shapely.box(-10.0, -8.0, 10.0, 8.0)
FRAME = BOX - shapely.box(-3.0, -3.0, 3.0, 3.0)
ISLANDS = shapely.MultiPolygon([shapely.box(0, 0, 4, 4), shapely.box(6, 0, 9, 4)])
U = shapely.box(0, 0, 10, 10) - shapely.box(2, 2, 8, 11)


def random_points(region, n, seed=0):
    rng = np.random.default_rng(seed)
    x0, y0, x1, y1 = region.bounds
    points = rng.uniform((x0, y0), (x1, y1), (40 * n, 2))
    return points[shapely.contains_xy(region, points)][:n]


def assert_cells(layout, points, region, n_samples=4000):
    """Check the partition, and that samples lie in the cell of their nearest point."""
    samples = random_points(region, n_samples, seed=1)
    distance = np.hypot(*(samples[:, np.newaxis] - points).transpose(2, 0, 1))
    order = np.sort(distance, axis=1)
    is_sure = order[:, 1] - order[:, 0] > 1e-6 if points.shape[0] > 1 else np.ones(len(samples), bool)
    nearest = distance.argmin(axis=1)

    assert layout.n_sites == points.shape[0]
    assert layout.area_um2.sum() == pytest.approx(region.area, rel=1e-9)
    assert shapely.contains_xy(layout.polygons()[nearest[is_sure]], samples[is_sure]).all()


@pytest.mark.parametrize("region", [BOX, FRAME, ISLANDS], ids=["box", "frame", "islands"])
@pytest.mark.parametrize("n", [40, 300])
def test_cells_contain_nearest_samples(region, n):
    points = random_points(region, n)
    try:
        layout = voronoi_of(points, region=region)
    except GeometryError as error:
        pytest.fail(f"{error}")
    assert_cells(layout, points, region)


@given(st.lists(st.tuples(st.integers(-39, 39), st.integers(-31, 31)), min_size=1, max_size=25, unique=True))
@settings(deadline=None, max_examples=60)
def test_points_on_lattice_partition_box(integers):
    points = np.array(integers) / 4.0
    assert_cells(voronoi_of(points, region=BOX), points, BOX, 300)


def test_cells_match_scipy_regions():
    from scipy.spatial import Voronoi

    points = random_points(BOX, 200)
    layout = voronoi_of(points, region=BOX)
    diagram = Voronoi(points)
    n_compared = 0
    for k, region in enumerate(diagram.point_region):
        corners = diagram.regions[region]
        if -1 not in corners and BOX.contains(cell := shapely.Polygon(diagram.vertices[corners])):
            assert layout.polygons()[k].symmetric_difference(cell).area < 1e-9
            n_compared += 1
    assert n_compared > 100


@pytest.mark.parametrize(
    ("points", "areas"),
    [
        ([(1.0, 2.0)], [320.0]),
        ([(-3.0, 0.0), (1.0, 0.0)], [144.0, 176.0]),
        ([(0.0, 0.0), (4.0, 0.0), (-4.0, 0.0)], [64.0, 128.0, 128.0]),
        ([(-10.0, -8.0), (10.0, 8.0)], [160.0, 160.0]),
    ],
    ids=["one", "two", "collinear", "corners"],
)
def test_few_points_have_exact_areas(points, areas):
    np.testing.assert_allclose(voronoi_of(points, region=BOX).area_um2, areas, rtol=1e-12)


def test_one_point_fills_region_with_hole():
    layout = voronoi_of([(-8.0, 0.0)], region=FRAME)

    assert layout.site_offsets.tolist() == [0, 2]
    assert layout.polygons()[0].equals(FRAME)


def test_regions_are_boxes_and_discs():
    assert voronoi_of([(0.0, 0.0)], size_um=fs.layout.OPTICAL_FORMATS["1/3"].size_um).area_um2 == [4800.0 * 3600.0]
    assert voronoi_of([(0.0, 0.0)], radius_um=2.0).area_um2[0] == pytest.approx(4.0 * np.pi, rel=1e-5)


def test_neighbours_share_corners_exactly():
    layout = voronoi_of(random_points(BOX, 500), region=BOX)
    perimeter = shapely.length(layout.polygons()).sum()

    assert layout.adjacency().sum() == pytest.approx(perimeter - BOX.length, rel=1e-9)
    assert layout.check(fs.DesignRules(max_overlap_um2=0.0)).ok


def test_separated_parts_are_an_error():
    points = [(1.0, 8.0), (5.0, 1.0), (9.0, 2.0)]
    with pytest.raises(
        GeometryError, match="the cell of point 0 has 2 parts in the region; take parts='neighbour'"
    ) as e:
        voronoi_of(points, region=U)
    layout = voronoi_of(points, region=U, parts="neighbour")

    assert e.value.site_ids == (0,)
    assert layout.area_um2.sum() == pytest.approx(U.area)
    assert layout.polygons()[2].contains(shapely.Point(9.0, 9.5))


@pytest.mark.parametrize(
    ("points", "match"),
    [
        ([(0.0, 0.0), (1.0, 1.0), (0.0, 0.0)], r"points_um\[2\].*must differ from point 0"),
        ([(0.0, 0.0), (30.0, 0.0)], r"points_um\[1\].*must lie in the region"),
        ([(0.0, np.nan)], "points_um"),
        ([(0.0, 0.0, 0.0)], r"shape \(n, 2\)"),
        (np.zeros((0, 2)), "n >= 1"),
    ],
)
def test_invalid_points_are_named(points, match):
    with pytest.raises(ParameterError, match=match):
        voronoi_of(points, region=BOX)


def test_nearly_equal_points_are_an_error():
    with pytest.raises(GeometryError, match="too close"):
        voronoi_of([(0.0, 0.0), (0.0, 5e-324), (1.0, 1.0)], region=BOX)


def test_points_follow_settings(tmp_path):
    text = "generator: voronoi_of\nparameters: {points_um: [[-3, 0], [1, 0]], size_um: [20, 16]}\n"
    (tmp_path / "a.yaml").write_text(text)

    np.testing.assert_allclose(fs.read_layout(tmp_path / "a.yaml").area_um2, [144.0, 176.0])
