"""Layout generators and colour filter mosaics: closed forms, tilings by shapely, counts, errors."""

from __future__ import annotations

import math
import re
from collections import Counter
from inspect import signature
from itertools import pairwise

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.overlaps import overlaps_um2
from scipy.spatial import cKDTree

from foveasim.errors import LayoutWarning, ParameterError
from foveasim.layout import Layout, grid, hexagonal, log_polar, mosaic, square_ring_ratio, tiling, zones

relaxed = settings(max_examples=examples(30))

pitches_um = st.floats(0.05, 50.0)


def assert_tiles(layout):
    """Assert that sites do not overlap, and that their areas sum to the covered area."""
    polygons = layout.polygons()
    common_um2 = overlaps_um2(polygons)

    assert bool(np.all(shapely.is_valid(polygons)))
    assert common_um2.max(initial=0.0) <= 1e-9 * layout.area_um2.min()
    assert layout.area_um2.sum() == pytest.approx(shapely.union_all(polygons).area, rel=1e-9)


def edge_counts(layout):
    """Number of edges by the number of sites that they belong to, for bit-identical vertices."""
    edges = Counter()
    for polygon in layout.polygons():
        xy = shapely.get_coordinates(polygon).tolist()
        edges.update(frozenset((tuple(p), tuple(q))) for p, q in pairwise(xy))
    return Counter(edges.values())


def regular_polygon_um2(n_corners, radius_um):
    return 0.5 * n_corners * math.sin(2 * math.pi / n_corners) * radius_um**2


def radii_um(layout):
    """Inner and outer radius of each site, from its vertices."""
    radius = np.hypot(*layout.xy_um.T).reshape(layout.n_sites, -1)
    return radius.min(axis=1), radius.max(axis=1)


# -- grid ------------------------------------------------------------------------------------------------------------


@given(st.integers(1, 9), st.integers(1, 9), pitches_um)
@relaxed
def test_grid_tiles_its_rectangle(n_x, n_y, pitch_um):
    layout = grid(n_x=n_x, n_y=n_y, pitch_um=pitch_um)

    assert_tiles(layout)
    assert layout.area_um2.sum() == pytest.approx(n_x * n_y * pitch_um**2, rel=1e-12)
    assert layout.bounds_um == pytest.approx(
        (-n_x * pitch_um / 2, -n_y * pitch_um / 2, n_x * pitch_um / 2, n_y * pitch_um / 2), rel=1e-12
    )


@given(st.integers(1, 9), st.integers(1, 9), pitches_um)
@relaxed
def test_grid_neighbours_share_edges_exactly(n_x, n_y, pitch_um):
    n_shared = n_x * (n_y - 1) + n_y * (n_x - 1)
    counts = edge_counts(grid(n_x=n_x, n_y=n_y, pitch_um=pitch_um))

    assert (counts[1], counts[2]) == (2 * (n_x + n_y), n_shared)


@pytest.mark.parametrize(
    ("pitch_um", "width_um", "fill"),
    [(1.0, 0.9, 0.81), (0.7, 0.6, 0.735), (2.2, 2.2, 1.0), (4.0, 1.0, 0.0625), (0.56, 0.49, 0.766)],
)
def test_fill_factor_of_grid_with_trenches(pitch_um, width_um, fill):
    layout = grid(n_x=5, n_y=4, pitch_um=pitch_um, width_um=width_um)

    np.testing.assert_allclose(layout.area_um2 / pitch_um**2, fill, atol=5e-4)


@given(st.integers(1, 6), st.integers(1, 6), pitches_um, st.floats(0.01, 1.0))
@relaxed
def test_trenches_do_not_move_centres(n_x, n_y, pitch_um, fraction):
    layout = grid(n_x=n_x, n_y=n_y, pitch_um=pitch_um, width_um=fraction * pitch_um)
    centres = [[(i - (n_x - 1) / 2) * pitch_um, (j - (n_y - 1) / 2) * pitch_um] for j in range(n_y) for i in range(n_x)]
    box = layout.site_bounds_um

    np.testing.assert_allclose(layout.centroid_um, centres, atol=1e-9 * pitch_um)
    np.testing.assert_allclose(box[:, 2:] - box[:, :2], fraction * pitch_um, rtol=1e-9)


def test_grid_is_ordered_by_rows():
    layout = grid(n_x=3, n_y=2, pitch_um=2.0)

    assert layout.columns["row"].tolist() == [0, 0, 0, 1, 1, 1]
    assert layout.columns["column"].tolist() == [0, 1, 2, 0, 1, 2]
    assert layout.readout_line.tolist() == [0, 1, 2, 0, 1, 2]
    assert layout.centroid_um.tolist() == [[-2, -1], [0, -1], [2, -1], [-2, 1], [0, 1], [2, 1]]


# -- hexagonal -------------------------------------------------------------------------------------------------------

orientations = st.sampled_from(["pointy", "flat"])


@given(st.integers(1, 8), st.integers(1, 8), pitches_um, orientations)
@relaxed
def test_hexagons_tile_with_close_packing(n_columns, n_rows, pitch_um, orientation):
    layout = hexagonal(n_columns=n_columns, n_rows=n_rows, pitch_um=pitch_um, orientation=orientation)

    assert layout.n_sites == n_columns * n_rows
    assert_tiles(layout)
    np.testing.assert_allclose(layout.area_um2, 0.5 * math.sqrt(3) * pitch_um**2, rtol=1e-12)


@given(st.integers(1, 8), st.integers(1, 8), pitches_um, orientations)
@relaxed
def test_hexagonal_neighbours_share_edges_exactly(n_columns, n_rows, pitch_um, orientation):
    layout = hexagonal(n_columns=n_columns, n_rows=n_rows, pitch_um=pitch_um, orientation=orientation)
    n_neighbours = len(cKDTree(layout.centroid_um).query_pairs(1.1 * pitch_um))
    counts = edge_counts(layout)

    assert (counts[1], counts[2]) == (6 * layout.n_sites - 2 * n_neighbours, n_neighbours)


@given(st.integers(2, 8), st.integers(2, 8), pitches_um, orientations)
@relaxed
def test_nearest_hexagons_are_one_pitch_apart(n_columns, n_rows, pitch_um, orientation):
    layout = hexagonal(n_columns=n_columns, n_rows=n_rows, pitch_um=pitch_um, orientation=orientation)
    nearest_um, _ = cKDTree(layout.centroid_um).query(layout.centroid_um, k=2)

    np.testing.assert_allclose(nearest_um[:, 1], pitch_um, rtol=1e-9)


@pytest.mark.parametrize(
    ("pitch_um", "width_um", "fill"), [(100, 85, 0.7225), (75, 70, 0.8711), (55, 50, 0.8264), (40, 35, 0.7656)]
)
@pytest.mark.parametrize("orientation", ["pointy", "flat"])
def test_fill_factors_of_photovoltaic_arrays(pitch_um, width_um, fill, orientation):
    layout = hexagonal(n_columns=4, n_rows=3, pitch_um=pitch_um, width_um=width_um, orientation=orientation)
    cell_um2 = 0.5 * math.sqrt(3) * pitch_um**2

    np.testing.assert_allclose(layout.area_um2 / cell_um2, fill, atol=5e-5)


@pytest.mark.parametrize(("orientation", "flat_axis"), [("pointy", 0), ("flat", 1)])
def test_orientation_determines_flat_axis(orientation, flat_axis):
    layout = hexagonal(n_columns=3, n_rows=3, pitch_um=60.0, width_um=50.0, orientation=orientation)
    extent = layout.site_bounds_um[:, 2:] - layout.site_bounds_um[:, :2]

    np.testing.assert_allclose(extent[:, flat_axis], 50.0, rtol=1e-12)
    np.testing.assert_allclose(extent[:, 1 - flat_axis], 50.0 * 2 / math.sqrt(3), rtol=1e-12)


@given(st.integers(1, 6), st.integers(1, 6), pitches_um, st.floats(0.05, 1.0), orientations)
@relaxed
def test_hexagon_sides_are_one_width_apart(n_columns, n_rows, pitch_um, fraction, orientation):
    width_um = fraction * pitch_um
    layout = hexagonal(
        n_columns=n_columns, n_rows=n_rows, pitch_um=pitch_um, width_um=width_um, orientation=orientation
    )

    np.testing.assert_allclose(layout.area_um2, 0.5 * math.sqrt(3) * width_um**2, rtol=1e-9)
    assert_tiles(layout)


@pytest.mark.parametrize("orientation", ["pointy", "flat"])
@pytest.mark.parametrize(("n_columns", "n_rows"), [(1, 1), (5, 1), (1, 4), (4, 4), (3, 5)])
def test_hexagonal_layout_is_centred_on_axis(n_columns, n_rows, orientation):
    centre = hexagonal(n_columns=n_columns, n_rows=n_rows, pitch_um=10.0, orientation=orientation).centroid_um

    np.testing.assert_allclose(centre.min(axis=0) + centre.max(axis=0), 0.0, atol=1e-11)


def test_hexagonal_rows_alternate_by_half_pitch():
    layout = hexagonal(n_columns=2, n_rows=3, pitch_um=4.0)
    high = 2.0 * math.sqrt(3)

    assert layout.columns["row"].tolist() == [0, 0, 1, 1, 2, 2]
    assert layout.readout_line.tolist() == layout.columns["column"].tolist() == [0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(
        layout.centroid_um, [[-3, -high], [1, -high], [-1, 0], [3, 0], [-3, high], [1, high]], atol=1e-12
    )


@pytest.mark.slow
def test_million_hexagons_have_expected_area():
    layout = hexagonal(n_columns=1000, n_rows=1000, pitch_um=2.2)

    assert layout.n_sites == 1_000_000
    assert layout.area_um2.sum() == pytest.approx(1e6 * 0.5 * math.sqrt(3) * 2.2**2, rel=1e-9)


# -- log-polar -------------------------------------------------------------------------------------------------------


@st.composite
def log_polar_parameters(draw):
    r_min_um = draw(st.floats(0.5, 100.0))
    return {
        "n_sectors": draw(st.integers(3, 14)),
        "r_min_um": r_min_um,
        "r_max_um": r_min_um * draw(st.floats(1.2, 8.0)),
        "n_rings": draw(st.integers(1, 6)),
        "stagger": draw(st.booleans()),
        "chords_per_arc": draw(st.integers(1, 7)),
    }


def chords_of(layout):
    """Actual number of chords per arc of a log-polar layout."""
    return (len(layout.xy_um) // layout.n_sites) // 2 - 1


@given(log_polar_parameters())
@settings(relaxed, max_examples=examples(60))
def test_log_polar_tiles_its_annulus(parameters):
    layout = log_polar(**parameters)
    n_corners = parameters["n_sectors"] * chords_of(layout)
    covered = shapely.union_all(layout.polygons())
    annulus_um2 = regular_polygon_um2(n_corners, parameters["r_max_um"]) - regular_polygon_um2(
        n_corners, parameters["r_min_um"]
    )

    assert_tiles(layout)
    assert (covered.geom_type, len(covered.interiors)) == ("Polygon", 1)
    assert layout.area_um2.sum() == pytest.approx(annulus_um2, rel=1e-9)


@pytest.mark.parametrize("chords_per_arc", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("stagger", [False, True])
def test_log_polar_tiles_with_any_chords(stagger, chords_per_arc):
    layout = log_polar(
        n_sectors=12, r_min_um=10.0, r_max_um=90.0, n_rings=7, stagger=stagger, chords_per_arc=chords_per_arc
    )
    covered = shapely.union_all(layout.polygons())
    n_corners = 12 * chords_of(layout)

    assert_tiles(layout)
    assert covered.interiors[0].length == pytest.approx(n_corners * 20.0 * math.sin(math.pi / n_corners), rel=1e-9)
    assert covered.area == pytest.approx(
        regular_polygon_um2(n_corners, 90.0) - regular_polygon_um2(n_corners, 10.0), rel=1e-9
    )


@given(log_polar_parameters())
@relaxed
def test_log_polar_neighbours_share_edges_exactly(parameters):
    layout = log_polar(**parameters)
    arcs = parameters["n_sectors"] * chords_of(layout)
    counts = edge_counts(layout)
    shared = (parameters["n_rings"] - 1) * arcs + parameters["n_rings"] * parameters["n_sectors"]

    assert (counts[1], counts[2]) == (2 * arcs, shared)


@given(log_polar_parameters())
@relaxed
def test_log_polar_area_matches_closed_form(parameters):
    layout = log_polar(**parameters)
    inner, outer = radii_um(layout)
    sector_rad = 2 * math.pi / parameters["n_sectors"]
    chord_rad = sector_rad / chords_of(layout)
    exact_um2 = 0.5 * sector_rad * (outer**2 - inner**2)

    np.testing.assert_allclose(layout.area_um2, exact_um2 * math.sin(chord_rad) / chord_rad, rtol=1e-9)


@pytest.mark.parametrize(
    ("stagger", "chords_per_arc", "chords"),
    [(False, 1, 1), (False, 3, 3), (False, 4, 4), (True, 1, 2), (True, 2, 2), (True, 3, 6), (True, 4, 4)],
)
def test_stagger_doubles_odd_numbers_of_chords(stagger, chords_per_arc, chords):
    layout = log_polar(
        n_sectors=8, r_min_um=5.0, r_max_um=20.0, n_rings=3, stagger=stagger, chords_per_arc=chords_per_arc
    )

    assert chords_of(layout) == chords


@pytest.mark.parametrize(("stagger", "shift"), [(False, 0.0), (True, 0.5)])
def test_stagger_rotates_every_second_ring(stagger, shift):
    layout = log_polar(n_sectors=10, r_min_um=5.0, r_max_um=40.0, n_rings=4, stagger=stagger, chords_per_arc=3)
    x, y = layout.centroid_um.T
    sectors = (np.arctan2(y, x) / (2 * math.pi / 10)).reshape(4, 10) % 10

    np.testing.assert_allclose(sectors[[0, 2]], np.tile(np.arange(10) + 0.5, (2, 1)), atol=1e-9)
    np.testing.assert_allclose(sectors[[1, 3]] % 10, np.tile((np.arange(10) + 0.5 + shift) % 10, (2, 1)), atol=1e-9)


def test_log_polar_sites_are_ordered_by_ring():
    layout = log_polar(n_sectors=5, r_min_um=5.0, r_max_um=40.0, n_rings=3)
    inner, _ = radii_um(layout)

    assert layout.columns["ring"].tolist() == [0] * 5 + [1] * 5 + [2] * 5
    assert layout.columns["sector"].tolist() == layout.readout_line.tolist() == [0, 1, 2, 3, 4] * 3
    assert inner.tolist() == sorted(inner.tolist())


@pytest.mark.parametrize(("n_sectors", "ratio"), [(3, 7 + 4 * math.sqrt(3)), (4, 3 + 2 * math.sqrt(2)), (6, 3.0)])
def test_square_ring_ratio_matches_closed_form(n_sectors, ratio):
    assert square_ring_ratio(n_sectors) == pytest.approx(ratio, rel=1e-13)


@pytest.mark.parametrize("n_sectors", [-1, 0, 1, 2, 3.5])
def test_square_ring_ratio_rejects_invalid_sectors(n_sectors):
    with pytest.raises(ParameterError, match="n_sectors"):
        square_ring_ratio(n_sectors)


@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")  # large ratios end below r_max_um
@pytest.mark.parametrize("n_sectors", [8, 64, 128, 252])
def test_default_ring_ratio_gives_square_sites(n_sectors):
    layout = log_polar(n_sectors=n_sectors, r_max_um=1000.0, min_size_um=2.2)
    inner, outer = radii_um(layout)
    sides = np.stack((layout.polygons()[0].exterior.coords[0], layout.polygons()[0].exterior.coords[1]))
    turn_rad = math.acos(np.dot(*sides) / np.prod(np.hypot(*sides.T)))
    centre_line_um = 0.5 * (inner + outer)
    width_um = np.hypot(1 - math.cos(turn_rad), math.sin(turn_rad)) * centre_line_um

    np.testing.assert_allclose(outer - inner, width_um, rtol=1e-9)


@pytest.mark.parametrize(("n_sectors", "min_size_um"), [(64, 2.2), (128, 2.2), (64, 5.0), (252, 0.56), (40, 30.0)])
@pytest.mark.parametrize("chords_per_arc", [2, 3, 16])
def test_square_site_blind_spot_matches_formula(n_sectors, min_size_um, chords_per_arc):
    layout = log_polar(n_sectors=n_sectors, r_max_um=1000.0, min_size_um=min_size_um, chords_per_arc=chords_per_arc)
    inner, outer = radii_um(layout)
    s = math.sin(math.pi / n_sectors)

    # The ring height is 2 s times the radius of the centre line, and equals the minimum size.
    assert 0.5 * (inner[0] + outer[0]) == pytest.approx(min_size_um / (2.0 * s), rel=1e-11)
    assert inner[0] == pytest.approx(min_size_um * (1.0 - s) / (2.0 * s), rel=1e-11)
    assert layout.provenance["blind_radius_um"] == pytest.approx(inner[0], rel=1e-12)


@pytest.mark.parametrize("n_sectors", [64, 128, 252])
def test_single_chord_blind_spot_matches_formula(n_sectors):
    layout = log_polar(n_sectors=n_sectors, r_max_um=1000.0, min_size_um=2.2)
    inner, outer = radii_um(layout)
    # Trapezium with the area sin(2π/n) (R² - r²) / 2 = 2 s sin(2π/n) c² and the centre line radius c.
    area_per_square = 2.0 * math.sin(math.pi / n_sectors) * math.sin(2.0 * math.pi / n_sectors)

    assert 0.5 * (inner[0] + outer[0]) == pytest.approx(2.2 / math.sqrt(area_per_square), rel=1e-11)


def test_blind_spot_limit_for_many_sectors():
    n_sectors = np.array([64, 256, 1024])
    rings = [log_polar(n_sectors=int(n), r_max_um=1000.0, min_size_um=2.0, chords_per_arc=8) for n in n_sectors]
    centre_um = np.array([0.5 * (layout.provenance["blind_radius_um"] + radii_um(layout)[1][0]) for layout in rings])
    limit_um = 2.0 * n_sectors / (2.0 * math.pi)

    # x / sin(x) = 1 + x²/6 + ...
    np.testing.assert_allclose(centre_um / limit_um - 1.0, (math.pi / n_sectors) ** 2 / 6.0, rtol=1e-3)


@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")  # large ratios end below r_max_um
@given(st.integers(3, 100), st.floats(0.1, 10.0), st.floats(1.01, 3.0), st.floats(0.1, 10.0))
@relaxed
def test_rings_below_minimum_size_are_omitted(n_sectors, min_size_um, ring_ratio, r_min_um):
    all_rings = log_polar(n_sectors=n_sectors, r_min_um=r_min_um, r_max_um=2000.0, ring_ratio=ring_ratio)
    remaining = log_polar(
        n_sectors=n_sectors, r_min_um=r_min_um, r_max_um=2000.0, ring_ratio=ring_ratio, min_size_um=min_size_um
    )
    inner, outer = radii_um(all_rings)
    arc_um = math.pi / n_sectors * (inner + outer)
    chord_um2 = 0.5 * math.sin(2.0 * math.pi / n_sectors) * (outer**2 - inner**2)
    is_large = np.min((arc_um, outer - inner, np.sqrt(chord_um2)), axis=0) >= min_size_um * (1 + 1e-9)

    np.testing.assert_allclose(radii_um(remaining)[0], inner[is_large], rtol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "end_um"),
    [
        ({"n_sectors": 8, "min_size_um": 1.0, "r_max_um": 9.0}, 4.2098),
        ({"n_sectors": 64, "r_min_um": 10.0, "r_max_um": 100.0, "ring_ratio": 2.0}, 80.0),
    ],
)
def test_log_polar_warns_when_rings_end_early(parameters, end_um):
    with pytest.warns(
        LayoutWarning, match=f"'r_max_um' is {parameters['r_max_um']:g} µm, but the outermost ring ends at"
    ) as caught:
        layout = log_polar(**parameters)
    (r_min_um, _), (_, last_um) = (radii_um(layout)[0][[0, -1]], radii_um(layout)[1][[0, -1]])
    (next_um,) = re.findall(r"take 'r_max_um' = ([\d.]+) µm, or", str(caught[0].message))

    assert last_um == pytest.approx(end_um, rel=1e-4)
    # The proposed radius gives rings that end there, without a warning.
    assert radii_um(log_polar(**{**parameters, "r_max_um": float(next_um)}))[1].max() == pytest.approx(
        float(next_um), rel=1e-4
    )
    exact = log_polar(n_sectors=parameters["n_sectors"], r_min_um=r_min_um, r_max_um=parameters["r_max_um"], n_rings=3)
    assert radii_um(exact)[1].max() == pytest.approx(parameters["r_max_um"], rel=1e-12)


def test_rings_fill_field_up_to_r_max():
    layout = log_polar(n_sectors=32, r_max_um=500.0, r_min_um=20.0, ring_ratio=1.3)
    _, outer = radii_um(layout)

    assert outer.max() <= 500.0 < outer.max() * 1.3
    assert layout.columns["ring"].max() + 1 == 12


def test_log_polar_ccd_has_thirty_rings():
    layout = log_polar(n_sectors=64, r_min_um=30.0, r_max_um=412.0, n_rings=30)
    inner, outer = radii_um(layout)

    assert layout.n_sites == 1920
    assert (inner.min(), outer.max()) == pytest.approx((30.0, 412.0), rel=1e-12)
    np.testing.assert_allclose(outer / inner, (412 / 30) ** (1 / 30), rtol=1e-12)
    assert layout.provenance["blind_radius_um"] == 30.0


@pytest.mark.parametrize("n_rings", [1, 2, 3, 7, 30, 152])
@pytest.mark.parametrize(("r_min_um", "r_max_um"), [(30.0, 412.0), (0.1, 0.7), (41.5, 545.0)])
def test_n_rings_sets_number_of_rings(r_min_um, r_max_um, n_rings):
    layout = log_polar(n_sectors=8, r_min_um=r_min_um, r_max_um=r_max_um, n_rings=n_rings)

    assert layout.n_sites == 8 * n_rings


LOG_POLAR = {"n_sectors": 64, "r_max_um": 412.0, "r_min_um": 30.0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_sectors": 2}, "'n_sectors' must be >= 3, got 2"),
        ({"n_sectors": 6.5}, "'n_sectors' must be an integer, got 6.5"),
        ({"n_sectors": True}, "'n_sectors' must be one number, got True"),
        ({"r_max_um": 0.0}, "'r_max_um' must be > 0, got 0.0 µm"),
        ({"r_max_um": np.inf}, "'r_max_um' must be finite, got inf µm"),
        ({"r_min_um": -3.0}, "'r_min_um' must be > 0, got -3.0 µm"),
        ({"r_min_um": 500.0}, "'r_min_um' must be <= 412, got 500.0 µm"),
        ({"r_min_um": None}, "'r_min_um' or 'min_size_um' must be given"),
        ({"min_size_um": 0.0}, "'min_size_um' must be > 0, got 0.0 µm"),
        ({"min_size_um": np.nan}, "'min_size_um' must be finite, got nan µm"),
        ({"min_size_um": 100.0}, "'r_max_um' must leave room for a ring.*got 412.0 µm"),
        ({"r_min_um": 400.0}, "'r_max_um' must leave room for a ring: the first would extend from 400 to 441.*µm"),
        ({"ring_ratio": 1.0}, "'ring_ratio' must be > 1, got 1.0"),
        ({"ring_ratio": 1 + 1e-9}, "'ring_ratio' must give at most 50000000 sites"),
        ({"n_rings": 0}, "'n_rings' must be >= 1, got 0"),
        (
            {"n_rings": 5, "ring_ratio": 1.1},
            "'n_rings' must be used with 'r_min_um' below 'r_max_um' and without 'ring_ratio'",
        ),
        (
            {"n_rings": 5, "r_min_um": 412.0},
            "'n_rings' must be used with 'r_min_um' below 'r_max_um' and without 'ring_ratio'",
        ),
        (
            {"n_rings": 5, "r_min_um": None, "min_size_um": 2.2},
            "'n_rings' must be used with 'r_min_um' below 'r_max_um'",
        ),
        ({"n_rings": 10**7}, "'n_rings' must be <= 781250"),
        ({"n_rings": 5, "n_sectors": 10**9}, "'n_sectors'"),
        ({"n_rings": 3, "r_min_um": 412.0 * (1 - 2.0**-53)}, "r_min_um"),
        ({"chords_per_arc": 0}, "'chords_per_arc' must be >= 1, got 0"),
        ({"chords_per_arc": 1001}, "'chords_per_arc' must be <= 1000"),
    ],
)
def test_log_polar_rejects_invalid_parameters(changes, message):
    with pytest.raises(ParameterError, match=message):
        log_polar(**{**LOG_POLAR, **changes})


# -- zones -----------------------------------------------------------------------------------------------------------


@st.composite
def zone_parameters(draw):
    """Zones with an integer number of pixels on each side of the inner zone."""
    pitch_um = draw(st.sampled_from([0.1, 0.5, 0.7, 1.0, 2.2, 3.3]))
    n = draw(st.integers(1, 8))
    sides, pitches = [n * pitch_um], [pitch_um]
    for _ in range(draw(st.integers(0, 3))):
        growth = draw(st.sampled_from([k for k in (1, 2, 3, 4) if n % k == 0]))
        n = n // growth + 2 * draw(st.integers(1, 3))
        pitches.append(pitches[-1] * growth)
        sides.append(n * pitches[-1])
    return {"side_um": sides, "pitch_um": pitches}


@given(zone_parameters())
@settings(relaxed, max_examples=examples(60))
def test_zones_tile_their_square(parameters):
    layout = zones(**parameters)

    assert_tiles(layout)
    assert layout.area_um2.sum() == pytest.approx(parameters["side_um"][-1] ** 2, rel=1e-12)
    np.testing.assert_allclose(
        layout.area_um2, np.array(parameters["pitch_um"])[layout.columns["zone"]] ** 2, rtol=1e-12
    )


def test_four_nested_zones_have_expected_counts():
    layout = zones(side_um=(64, 128, 256, 512), pitch_um=(1, 2, 4, 8))

    assert layout.n_sites == 13_312
    assert np.bincount(layout.columns["zone"]).tolist() == [4096, 3072, 3072, 3072]
    assert layout.bounds_um == (-256.0, -256.0, 256.0, 256.0)
    assert layout.area_um2.sum() == 512.0**2


def test_zone_columns_and_lines_are_indexed():
    layout = zones(side_um=(2, 6), pitch_um=(1, 2))

    assert layout.columns["zone"].tolist() == [0] * 4 + [1] * 8
    assert layout.columns["row"].tolist() == [0, 0, 1, 1, 0, 0, 0, 1, 1, 2, 2, 2]
    assert layout.columns["column"].tolist() == [0, 1, 0, 1, 0, 1, 2, 0, 2, 0, 1, 2]
    assert layout.readout_line.tolist() == [0, 1, 0, 1, 2, 3, 4, 2, 4, 2, 3, 4]
    assert layout.centroid_um[:5].tolist() == [[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [-2, -2]]


@pytest.mark.parametrize(
    ("side_um", "pitch_um", "n_sites"),
    [
        pytest.param([5], [1], 25, id="one zone"),
        pytest.param([3, 9], [1, 3], 9 + 8, id="two zones"),
        pytest.param([1, 3, 9], [1, 1, 3], 1 + 8 + 8, id="one pixel in the centre"),
    ],
)
def test_zones_accept_odd_numbers_of_pixels(side_um, pitch_um, n_sites):
    layout = zones(side_um=side_um, pitch_um=pitch_um)

    assert layout.n_sites == n_sites
    assert layout.area_um2.sum() == pytest.approx(side_um[-1] ** 2, rel=1e-12)


@pytest.mark.parametrize(
    ("side_um", "pitch_um", "message"),
    [
        pytest.param([], [], "'side_um' and 'pitch_um' must have the same length of at least 1, got 0 and 0", id="no"),
        pytest.param([4, 8], [1], "'side_um' and 'pitch_um' must have the same length .* got 2 and 1", id="lengths"),
        pytest.param([8, 4], [1, 2], r"'side_um' must increase from zone to zone, got \[8.0, 4.0\] µm", id="shrinking"),
        pytest.param([8, 8], [1, 2], r"'side_um' must increase from zone to zone", id="equal"),
        pytest.param([8, -8], [1, 2], r"'side_um' must be > 0.* at \[1\]", id="negative"),
        pytest.param([8, 16], [1, 0], r"'pitch_um' must be > 0.* at \[1\]", id="zero pitch"),
        pytest.param([8, np.nan], [1, 2], r"'side_um' must be finite.* at \[1\]", id="nan"),
        pytest.param([8.5, 16], [1, 2], r"'side_um\[0\]' must give an integer number of pixels", id="half a pixel"),
        pytest.param(
            [8, 17], [1, 2], r"'side_um\[1\]' must give an integer number of pixels", id="half a pixel outside"
        ),
        pytest.param(
            [8, 18], [1, 3], r"'pitch_um\[1\]' must give an integer number of pixels", id="fraction of a pixel around"
        ),
        pytest.param(
            [4, 6], [1, 2], r"'pitch_um\[1\]' must give an integer number of pixels", id="half a pixel around"
        ),
        pytest.param([1e-10], [1.0], r"must give an integer number of pixels", id="no pixel"),
        pytest.param([8, 8 + 1e-9], [1, 1], r"must give an integer number of pixels", id="no pixel around"),
        pytest.param([1e6], [1.0], "must give at most 16384 pixels", id="too many pixels"),
        pytest.param(8, 1, "'pitch_um' must have 1 dimension", id="numbers"),
        pytest.param(["a"], [1], "'side_um' must be an array of numbers", id="string"),
    ],
)
def test_zones_reject_invalid_parameters(side_um, pitch_um, message):
    with pytest.raises(ParameterError, match=message):
        zones(side_um=side_um, pitch_um=pitch_um)


# -- errors and provenance of all generators ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "parameters", "message"),
    [
        (grid, {"n_x": 0, "n_y": 1, "pitch_um": 1.0}, "'n_x' must be >= 1, got 0"),
        (grid, {"n_x": 1, "n_y": 2.5, "pitch_um": 1.0}, "'n_y' must be an integer, got 2.5"),
        (grid, {"n_x": "3", "n_y": 1, "pitch_um": 1.0}, "'n_x' must be an integer, got '3'"),
        (grid, {"n_x": 1, "n_y": 1, "pitch_um": 0.0}, "'pitch_um' must be > 0, got 0.0 µm"),
        (grid, {"n_x": 1, "n_y": 1, "pitch_um": np.nan}, "'pitch_um' must be finite, got nan µm"),
        (grid, {"n_x": 1, "n_y": 1, "pitch_um": 1.0, "width_um": 1.5}, "'width_um' must be <= 1, got 1.5 µm"),
        (grid, {"n_x": 1, "n_y": 1, "pitch_um": 1.0, "width_um": 0.0}, "'width_um' must be > 0, got 0.0 µm"),
        (grid, {"n_x": 2, "n_y": 2, "pitch_um": 1e308}, "pitch_um"),
        (grid, {"n_x": 2, "n_y": 2, "pitch_um": 1.0, "width_um": 1e-300}, "width_um"),
        (hexagonal, {"n_columns": 0, "n_rows": 1, "pitch_um": 1.0}, "'n_columns' must be >= 1, got 0"),
        (hexagonal, {"n_columns": 1, "n_rows": -1, "pitch_um": 1.0}, "'n_rows' must be >= 1, got -1"),
        (hexagonal, {"n_columns": 1, "n_rows": 1, "pitch_um": -1.2}, "'pitch_um' must be > 0, got -1.2 µm"),
        (hexagonal, {"n_columns": 1, "n_rows": 1, "pitch_um": 1.0, "width_um": 2}, "'width_um' must be <= 1, got 2"),
        (
            hexagonal,
            {"n_columns": 1, "n_rows": 1, "pitch_um": 1.0, "orientation": "up"},
            "'orientation' must be one of 'pointy', 'flat', got 'up'",
        ),
    ],
)
def test_grids_reject_invalid_parameters(make, parameters, message):
    with pytest.raises(ParameterError, match=message):
        make(**parameters)


@pytest.mark.parametrize(
    ("make", "parameters"),
    [
        (grid, {"n_x": 3, "n_y": 2, "pitch_um": 2.2, "width_um": 2.0}),
        (hexagonal, {"n_columns": 3, "n_rows": 2, "pitch_um": 2.2, "width_um": None, "orientation": "flat"}),
        (
            log_polar,
            {
                "n_sectors": 12,
                "r_max_um": 75.0,
                "min_size_um": 2.2,
                "r_min_um": 7.0,
                "n_rings": None,
                "ring_ratio": 1.4,
                "stagger": True,
                "chords_per_arc": 3,
            },
        ),
        (log_polar, {"n_sectors": 24, "r_max_um": 61.0, "min_size_um": 2.2, "fovea": "linear"}),
        (log_polar, {"n_sectors": 24, "r_max_um": 61.0, "min_size_um": 2.2, "fovea": "hexagons"}),
        (grid, {"n_x": 3, "n_y": 2, "pitch_um": 2.0, "pitch_y_um": 3.0, "trench_um": 0.25, "stagger": True}),
        (zones, {"side_um": [4.0, 8.0], "pitch_um": [1.0, 2.0]}),
        (zones, {"side_um": [4.0, 9.5], "pitch_um": [1.0, 2.0], "cells": "hexagons"}),
        (zones, {"outlines_um": [[[0.0, 0.0], [8.0, 0.0], [0.0, 8.0]]], "pitch_um": [1.0], "cells": ["squares"]}),
        (tiling, {"pitch_um": 2.0, "radius_um": 9.0, "border": "cut", "origin_um": [0.5, 0.25]}),
        (tiling, {"pitch_um": 2.0, "region": "POLYGON ((0 0, 9 0, 0 7, 0 0))", "cells": "squares"}),
    ],
)
def test_provenance_reproduces_layout(make, parameters):
    layout = make(**parameters)
    moved = layout.rotate(10.0)[1:]

    assert layout.provenance["generator"] == moved.provenance["generator"] == make.__name__
    assert layout.provenance["parameters"] == moved.provenance["parameters"]
    assert layout.provenance["parameters"].keys() == signature(make).parameters.keys()
    assert layout.provenance["parameters"].items() >= parameters.items()
    assert make(**layout.provenance["parameters"]).xy_um.tolist() == layout.xy_um.tolist()


# -- mosaic ----------------------------------------------------------------------------------------------------------

X_TRANS = ("RBGBRG", "GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB")


@pytest.mark.parametrize(
    ("block", "names", "counts"),
    [
        pytest.param(("RG", "GB"), "RGB", [36, 72, 36], id="Bayer"),
        pytest.param(("RRGG", "RRGG", "GGBB", "GGBB"), "RGB", [36, 72, 36], id="quad-Bayer"),
        pytest.param(X_TRANS, "RGB", [32, 80, 32], id="X-Trans"),
        pytest.param(("RG", "BW"), "RGBW", [36, 36, 36, 36], id="RGBW"),
        pytest.param(("G",), "RGB", [0, 144, 0], id="one filter"),
        pytest.param(("RGB",), "RGB", [48, 48, 48], id="stripes"),
    ],
)
def test_mosaic_filter_counts(block, names, counts):
    layout = mosaic(grid(n_x=12, n_y=12, pitch_um=1.0), block, names)

    assert np.bincount(layout.channel, minlength=len(names)).tolist() == counts


@pytest.mark.parametrize("block", [("RG", "GB"), ("GR", "BG"), ("RGB", "BRG"), X_TRANS])
def test_mosaic_block_repeats_from_lowest_row(block):
    layout = mosaic(grid(n_x=7, n_y=5, pitch_um=1.0), block)
    letters = ["RGB"[c] for c in layout.channel]
    x, y = np.round(layout.centroid_um - layout.centroid_um.min(axis=0)).astype(int).T

    assert letters == [block[j % len(block)][i % len(block[0])] for i, j in zip(x, y, strict=True)]


def test_mosaic_accepts_rings_and_sectors():
    layout = mosaic(log_polar(n_sectors=4, r_min_um=1.0, r_max_um=8.0, n_rings=3), ("RG", "GB"))

    assert layout.channel.tolist() == [0, 1, 0, 1, 1, 2, 1, 2, 0, 1, 0, 1]


def test_mosaic_preserves_sites_and_columns():
    bare = grid(n_x=4, n_y=4, pitch_um=1.0)
    layout = mosaic(bare, ("RG", "GB"))

    assert layout.xy_um.tolist() == bare.xy_um.tolist()
    assert set(layout.columns) == {*bare.columns, "channel"}
    assert layout.readout_line.tolist() == bare.readout_line.tolist()
    assert "channel" not in bare.columns


def test_mosaic_of_selected_sites():
    layout = grid(n_x=6, n_y=6, pitch_um=1.0)
    selected = layout[layout.columns["column"] % 3 > 0]

    assert (
        mosaic(selected, X_TRANS).channel.tolist()
        == mosaic(layout, X_TRANS)[layout.columns["column"] % 3 > 0].channel.tolist()
    )


@pytest.mark.parametrize(
    ("block", "names", "message"),
    [
        pytest.param((), "RGB", "'block' must be rows of letters of equal length", id="empty"),
        pytest.param(("", ""), "RGB", "'block' must be rows of letters of equal length", id="empty rows"),
        pytest.param(("RG", "G"), "RGB", "'block' must be rows of letters of equal length", id="ragged"),
        pytest.param(("RX", "GB"), "RGB", "'block' must use the letters 'RGB', .*'X'", id="unknown letter"),
        pytest.param(("rg", "gb"), "RGB", "'block' must use the letters 'RGB', .*'b', 'g', 'r'", id="lower case"),
        pytest.param(None, "RGB", "'block' must be", id="nothing"),
        pytest.param("RGB", None, "'block' must be one of 'bayer', .*, or rows such as", id="no square"),
        pytest.param("rggb", None, "'block' must be one of 'bayer', .*, or rows such as", id="small letters"),
        pytest.param("bayr", None, "did you mean 'bayer'", id="misspelt"),
    ],
)
def test_mosaic_rejects_invalid_block(block, names, message):
    with pytest.raises(ParameterError, match=message):
        mosaic(grid(n_x=4, n_y=4, pitch_um=1.0), block, names)


def test_unknown_letter_message_contains_one_value():
    with pytest.raises(ParameterError, match="'X'") as caught:
        mosaic(grid(n_x=4, n_y=4, pitch_um=1.0), ("RX", "GB"), "RGB")

    assert str(caught.value).count("got ") == 1


@pytest.mark.parametrize(
    "layout",
    [
        Layout.from_rectangles([[0, 0], [1, 0], [3.2, 0]], 1.0, row=[0, 0, 0]),
        Layout.from_rectangles([[0, 0], [2, 0], [1, 2], [3, 2], [0, 4], [2, 4]], 1.5),
        Layout.from_rectangles([[0, 0], [0, 0]], 1.5),
        Layout.from_polygons(hexagonal(n_columns=9, n_rows=9, pitch_um=2.0).polygons()),
        Layout.from_polygons(grid(n_x=5, n_y=4, pitch_um=2.0).rotate(10.0).polygons()),
        Layout.from_polygons([]),
    ],
    ids=["uneven", "staggered", "equal positions", "hexagons", "rotated", "empty"],
)
def test_mosaic_requires_index_columns_or_lattice(layout):
    with pytest.raises(
        ParameterError,
        match=r"'layout' must have the columns row and column or ring and sector, or sites on a rectangular lattice, got "
        r"\[.*\]; add them with with_columns\(row=",
    ):
        mosaic(layout, ("RG", "GB"))


@pytest.mark.parametrize("name", ["bayer", "x_trans"])
def test_lattice_without_columns_gets_mosaic(name):
    rng = np.random.default_rng(5)
    layout = grid(n_x=14, n_y=9, pitch_um=2.2, fill_factor=0.8)[rng.permutation(14 * 9)[:100]]
    other = Layout(layout.xy_um.round(3) + np.array([300.0, -70.0]), layout.ring_offsets, layout.site_offsets)

    assert (mosaic(other, name).channel == mosaic(layout, name).channel).all()


@pytest.mark.parametrize("row", [[0.0, 1.5], ["a", "b"]])
def test_mosaic_rejects_non_integer_rows(row):
    layout = Layout.from_rectangles([[0, 0], [1, 0]], 1.0, row=row, column=[0, 1])

    with pytest.raises(ParameterError, match="'row' must contain integers from 0 to"):
        mosaic(layout, ("RG", "GB"))


def test_hexagons_need_13_4_percent_fewer_samples():
    """Replicas of a circular band of radius W at the points of the reciprocal lattice must not overlap."""
    band_per_um = 0.25

    def nearest_replica_per_um(layout):
        """Length of the shortest reciprocal lattice vector of the site centres."""
        centre_um = layout.centroid_um
        offsets = centre_um[1:] - centre_um[0]
        order = np.argsort(np.hypot(*offsets.T), kind="stable")
        first = offsets[order[0]]
        second = next(v for v in offsets[order] if abs(first[0] * v[1] - first[1] * v[0]) > 1e-6)
        reciprocal = np.linalg.inv(np.stack((first, second))).T
        k = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2)
        return np.hypot(*(k[(k != 0).any(axis=1)] @ reciprocal).T).min()

    squares = grid(n_x=6, n_y=6, pitch_um=1 / (2 * band_per_um))
    hexagons = hexagonal(n_columns=6, n_rows=6, pitch_um=1 / (2 * band_per_um) * 2 / math.sqrt(3))

    assert nearest_replica_per_um(squares) == pytest.approx(2 * band_per_um)
    assert nearest_replica_per_um(hexagons) == pytest.approx(2 * band_per_um)
    assert 1 - squares.area_um2[0] / hexagons.area_um2[0] == pytest.approx(0.134, abs=5e-4)
