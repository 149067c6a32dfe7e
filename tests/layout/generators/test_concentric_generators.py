"""Giotto, foveal Cartesian and octagonal layouts: published numbers, closed forms, exact tilings, errors."""

from __future__ import annotations

import math
from collections import Counter
from decimal import Decimal, localcontext
from itertools import pairwise

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference.overlaps import overlaps_um2

from foveasim.errors import ParameterError
from foveasim.layout.generators.foveal_cartesian import foveal_cartesian
from foveasim.layout.generators.giotto import giotto, giotto_ratio
from foveasim.layout.generators.grid import grid
from foveasim.layout.generators.octagonal import octagonal

relaxed = settings(max_examples=examples(40))

units_um = st.floats(0.05, 50.0)


def assert_tiles(layout):
    """Assert that sites share complete edges, do not overlap, and sum to the covered area."""
    polygons = layout.polygons()
    common_um2 = overlaps_um2(polygons)

    assert bool(np.all(shapely.is_valid(polygons)))
    assert bool(shapely.coverage_is_valid(polygons))
    assert common_um2.max(initial=0.0) <= 1e-9 * layout.area_um2.min()
    assert layout.area_um2.sum() == pytest.approx(covered(layout).area, rel=1e-9)


def covered(layout):
    """Union of all sites, in which only exactly shared edges dissolve."""
    return shapely.coverage_union_all(layout.polygons())


def edge_counts(layout):
    """Number of edges by the number of sites that they belong to, for bit-identical vertices."""
    edges = Counter()
    for polygon in layout.polygons():
        xy = (shapely.get_coordinates(polygon) + 0.0).tolist()  # without negative zeros
        edges.update(frozenset((tuple(p), tuple(q))) for p, q in pairwise(xy))
    return Counter(edges.values())


def regular_polygon_um2(n_corners, radius_um):
    return 0.5 * n_corners * math.sin(2 * math.pi / n_corners) * radius_um**2


def ring_radii_um(layout):
    """Inner and outer radius of each ring, from its vertices."""
    site = np.repeat(np.arange(layout.n_sites), np.diff(layout.ring_offsets))
    ring = layout.columns["ring"][site] - layout.columns["ring"].min()
    radius_um = np.hypot(*layout.xy_um.T)
    inner_um = np.full(ring.max() + 1, np.inf)
    outer_um = np.zeros(ring.max() + 1)
    np.minimum.at(inner_um, ring, radius_um)
    np.maximum.at(outer_um, ring, radius_um)
    return inner_um, outer_um


# -- Giotto ----------------------------------------------------------------------------------------------------------

GIOTTO_1 = {"n_rho": 76, "n_theta": 128, "n_fovea": 20, "n_across": 600}
GIOTTO_2 = {"n_rho": 152, "n_theta": 252, "n_fovea": 42, "n_across": 1090}


@st.composite
def giotto_parameters(draw):
    n_fovea = draw(st.integers(1, 6))
    n_rho = n_fovea + draw(st.integers(1, 6))
    return {
        "n_rho": n_rho,
        "n_theta": draw(st.integers(3 * n_fovea, 8 * n_fovea + 2)),
        "n_fovea": n_fovea,
        "n_across": draw(st.integers(2 * n_rho, 12 * n_rho)),
        "unit_um": draw(units_um),
        "fovea": draw(st.sampled_from(["rings", "linear", "none"])),
        "stagger": draw(st.booleans()),
        "chords_per_arc": draw(st.integers(1, 7)),
    }


def outer_corners(parameters):
    """Number of corners of a circle outside the fovea; odd numbers of chords are doubled for staggered rings."""
    chords = parameters["chords_per_arc"]
    return parameters["n_theta"] * (2 * chords if parameters["stagger"] and chords % 2 else chords)


def decimal_ratio(n_rho, n_fovea, n_across):
    """Ratio by bisection of the sum of powers, with forty digits."""
    with localcontext() as context:
        context.prec = 40
        low, high = Decimal(1), Decimal(n_across)
        width = Decimal(n_across) / 2 - n_fovea + Decimal("0.5")
        for _ in range(110):
            ratio = (low + high) / 2
            is_large = sum(ratio**i for i in range(1, n_rho - n_fovea + 1)) > width
            low, high = (low, ratio) if is_large else (ratio, high)
        return float(low)


def test_giotto_2_ratio_matches_published_value():
    assert abs(giotto_ratio(n_rho=152, n_fovea=42, n_across=1090) - 1.02314422608633) < 1e-12


def test_giotto_1_ratio_matches_published_value():
    assert giotto_ratio(n_rho=76, n_fovea=20, n_across=600) == pytest.approx(1.0481, abs=5e-5)


@pytest.mark.parametrize(
    ("n_rho", "n_fovea", "n_across"),
    [(152, 42, 1090), (76, 20, 600), (2, 1, 4), (2, 1, 10**6), (50, 1, 100), (300, 299, 600), (40, 3, 10**9)],
)
def test_giotto_ratio_has_twelve_digits(n_rho, n_fovea, n_across):
    ratio = giotto_ratio(n_rho=n_rho, n_fovea=n_fovea, n_across=n_across)

    assert ratio == pytest.approx(decimal_ratio(n_rho, n_fovea, n_across), rel=1e-12)


def test_single_ring_fills_available_height():
    assert giotto_ratio(n_rho=5, n_fovea=4, n_across=31) == pytest.approx(15.5 - 3.5, rel=1e-14)


@pytest.mark.parametrize(
    ("parameters", "n_in_fovea", "n_around"), [(GIOTTO_2, 5167, 27_720), (GIOTTO_1, 1141, 7168)], ids=["2", "1"]
)
@pytest.mark.parametrize("chords_per_arc", [1, 2])
def test_giotto_has_published_site_counts(parameters, n_in_fovea, n_around, chords_per_arc):
    layout = giotto(**parameters, unit_um=6.45, chords_per_arc=chords_per_arc)
    is_fovea = layout.columns["ring"] < parameters["n_fovea"]

    assert (is_fovea.sum(), (~is_fovea).sum()) == (n_in_fovea, n_around)


def test_giotto_2_log_part_matches_published_radii():
    layout = giotto(**GIOTTO_2, unit_um=6.45, fovea="none")
    inner_um, outer_um = ring_radii_um(layout)

    assert layout.n_sites == 27_720
    assert inner_um[0] / 6.45 == pytest.approx(41.5, rel=1e-12)
    assert outer_um[-1] / 6.45 == pytest.approx(545.0, rel=1e-12)
    assert (outer_um[-1] - inner_um[-1]) / 6.45 == pytest.approx(12.39, abs=5e-3)


@pytest.mark.parametrize("parameters", [GIOTTO_1, GIOTTO_2], ids=["1", "2"])
def test_giotto_ring_radii_follow_rule(parameters):
    n_fovea, n_rho = parameters["n_fovea"], parameters["n_rho"]
    ratio = decimal_ratio(n_rho, n_fovea, parameters["n_across"])
    inner_um, outer_um = ring_radii_um(giotto(**parameters, unit_um=2.0))
    b = ratio / (ratio - 1)
    edges = n_fovea - b - 0.5 + b * ratio ** np.arange(n_rho - n_fovea + 1)

    np.testing.assert_allclose(outer_um[:n_fovea], 2.0 * (np.arange(n_fovea) + 0.5), rtol=1e-12)
    np.testing.assert_allclose(inner_um[1:n_fovea], outer_um[: n_fovea - 1], rtol=1e-12)
    np.testing.assert_allclose(inner_um[n_fovea:], 2.0 * edges[:-1], rtol=1e-11)
    np.testing.assert_allclose(outer_um[n_fovea:], 2.0 * edges[1:], rtol=1e-11)


@given(giotto_parameters())
@settings(relaxed, max_examples=examples(80))
def test_giotto_tiles_disc_or_annulus(parameters):
    layout = giotto(**parameters)
    n_corners = outer_corners(parameters)
    disc_um2 = regular_polygon_um2(n_corners, 0.5 * parameters["n_across"] * parameters["unit_um"])
    blind_um2 = regular_polygon_um2(n_corners, (parameters["n_fovea"] - 0.5) * parameters["unit_um"])
    has_blind_spot = parameters["fovea"] == "none"
    union = covered(layout)

    assert_tiles(layout)
    assert (union.geom_type, len(union.interiors)) == ("Polygon", int(has_blind_spot))
    assert layout.area_um2.sum() == pytest.approx(disc_um2 - has_blind_spot * blind_um2, rel=1e-9)


@given(giotto_parameters())
@relaxed
def test_giotto_neighbours_share_edges_exactly(parameters):
    counts = edge_counts(giotto(**parameters))
    n_boundaries = 2 if parameters["fovea"] == "none" else 1

    assert counts[1] == n_boundaries * outer_corners(parameters)
    assert set(counts) == {1, 2}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fovea", "stagger", "chords_per_arc"),
    [
        ("rings", True, 1),
        ("rings", True, 4),
        ("rings", False, 3),
        ("none", True, 2),
        ("none", True, 7),
        ("none", False, 4),
    ],
)
def test_giotto_1_tiles_with_any_chords(fovea, stagger, chords_per_arc):
    parameters = {**GIOTTO_1, "unit_um": 3.0, "fovea": fovea, "stagger": stagger, "chords_per_arc": chords_per_arc}
    layout = giotto(**parameters)
    n_corners = outer_corners(parameters)
    union = covered(layout)

    assert_tiles(layout)
    assert len(union.interiors) == (fovea == "none")
    assert union.exterior.length == pytest.approx(n_corners * 2 * 900.0 * math.sin(math.pi / n_corners), rel=1e-9)


@given(st.integers(1, 12), st.integers(3, 9), st.integers(0, 50))
@relaxed
def test_giotto_fovea_counts_grow_with_rho(n_fovea, n_per_rho, rest):
    n_theta = n_per_rho * n_fovea + rest % n_fovea
    layout = giotto(n_rho=n_fovea + 2, n_theta=n_theta, n_fovea=n_fovea, n_across=4 * n_fovea + 8, unit_um=1.0)
    counts = [1] + [n_per_rho * rho for rho in range(1, n_fovea)] + [n_theta, n_theta]

    assert np.bincount(layout.columns["ring"]).tolist() == counts
    assert layout.columns["sector"].tolist() == [s for n in counts for s in range(n)]


def test_giotto_fovea_sites_have_equal_area():
    layout = giotto(n_rho=14, n_theta=72, n_fovea=12, n_across=40, unit_um=2.0, chords_per_arc=60)
    unit_areas = layout.area_um2[layout.columns["ring"] < 12] / 4.0

    np.testing.assert_allclose(unit_areas[0], math.pi / 4, rtol=1e-4)
    np.testing.assert_allclose(unit_areas[1:], 2 * math.pi / 6, rtol=1e-4)


@pytest.mark.parametrize("chords_per_arc", [1, 2, 3])
@pytest.mark.parametrize("fovea", ["rings", "none"])
@pytest.mark.parametrize(("stagger", "shift"), [(False, 0.0), (True, 0.5)])
def test_giotto_stagger_rotates_every_second_ring(stagger, shift, fovea, chords_per_arc):
    layout = giotto(
        n_rho=9,
        n_theta=31,
        n_fovea=5,
        n_across=40,
        unit_um=1.0,
        fovea=fovea,
        stagger=stagger,
        chords_per_arc=chords_per_arc,
    )
    x, y = layout.centroid_um[layout.columns["ring"] > 5].T
    angle = (np.arctan2(y, x) / (2 * math.pi / 31)).reshape(3, 31) % 31

    np.testing.assert_allclose(angle[1], np.arange(31) + 0.5, atol=1e-9)
    np.testing.assert_allclose(angle[[0, 2]], np.tile((np.arange(31) + 0.5 + shift) % 31, (2, 1)), atol=1e-9)


def test_giotto_without_fovea_is_outer_part():
    parameters = {**GIOTTO_1, "unit_um": 2.2, "chords_per_arc": 2}
    complete, part = giotto(**parameters), giotto(**parameters, fovea="none")
    outer = complete[complete.columns["ring"] >= 20]

    assert {name: values.tolist() for name, values in part.columns.items()} == {
        name: values.tolist() for name, values in outer.columns.items()
    }
    assert part.area_um2[128:].tolist() == outer.area_um2[128:].tolist()  # ring 20 includes corners of the fovea
    assert part.provenance["blind_radius_um"] == pytest.approx(19.5 * 2.2, rel=1e-14)
    assert "blind_radius_um" not in complete.provenance


def test_readout_line_is_sector_of_site_start():
    layout = giotto(**GIOTTO_1, unit_um=1.0, stagger=False)
    ring = layout.columns["ring"]
    n_in_ring = np.where(ring < 20, np.maximum(1, 6 * ring), 128)
    start = layout.columns["sector"] / n_in_ring * 128

    assert layout.readout_line[ring >= 20].tolist() == layout.columns["sector"][ring >= 20].tolist()
    assert bool(np.all((layout.readout_line <= start + 1e-9) & (start < layout.readout_line + 1)))


def test_giotto_scales_with_unit():
    small, large = (giotto(**GIOTTO_1, unit_um=unit_um) for unit_um in (1.0, 8.0))

    assert (8.0 * small.xy_um).tolist() == large.xy_um.tolist()
    assert small.provenance["ring_ratio"] == large.provenance["ring_ratio"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"n_rho": 1}, "'n_rho' must be >= 2, got 1"),
        ({"n_fovea": 0}, "'n_fovea' must be >= 1, got 0"),
        ({"n_fovea": 76}, "'n_fovea' must be <= 75, got 76; 'n_rho' includes the rings of the fovea and at least"),
        (
            {"n_across": 151},
            "'n_across' must be > 151, the diameter of 76 rings of unit height, got 151; take a larger",
        ),
        ({"n_across": 600.5}, "'n_across' must be an integer, got 600.5"),
        ({"n_across": "600"}, "'n_across' must be an integer, got '600'"),
        ({"n_theta": 2, "fovea": "none"}, "'n_theta' must be >= 3, got 2"),
        ({"n_theta": 59}, "'n_theta' must be >= 60, three times 'n_fovea', got 59; or take fovea='none'"),
        ({"n_theta": 10_000_000}, "'n_sites' must be <= 50000000"),
        ({"unit_um": 0.0}, "'unit_um' must be > 0, got 0.0 µm"),
        ({"unit_um": 1e5}, "'unit_um' must be <= 33333.3, got 100000.0 µm"),
        ({"fovea": "squares"}, "'fovea' must be one of 'none', 'rings', 'linear', 'hexagons', got 'squares'"),
        ({"chords_per_arc": 0}, "'chords_per_arc' must be >= 1, got 0"),
    ],
)
def test_giotto_rejects_invalid_parameters(changed, message):
    with pytest.raises(ParameterError, match=message):
        giotto(**{**GIOTTO_1, "unit_um": 1.0, **changed})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"n_rho": 20}, "'n_fovea' must be <= 19"),
        ({"n_across": 0}, "'n_across'"),
        ({"n_rho": 1e9}, "'n_rho' must be <="),
    ],
)
def test_giotto_ratio_rejects_invalid_parameters(changed, message):
    with pytest.raises(ParameterError, match=message):
        giotto_ratio(**{"n_rho": 76, "n_fovea": 20, "n_across": 600, **changed})


# -- foveal Cartesian ------------------------------------------------------------------------------------------------


@st.composite
def foveal_parameters(draw):
    n_rings = draw(st.integers(1, 9))
    return {
        "n_rings": n_rings,
        # With ratios of small integers, corners of two rings coincide within rounding.
        "ring_ratio": draw(st.floats(1.01, 4.0) | st.fractions(1, 5, max_denominator=9).filter(lambda q: q > 1)),
        "pitch_um": draw(units_um),
        "n_fovea": draw(st.integers(1, n_rings)),
    }


def half_sides_um(n_rings, ring_ratio, pitch_um, n_fovea=1):
    return [
        (r + 0.5) * pitch_um if r < n_fovea else (n_fovea - 0.5) * pitch_um * float(ring_ratio) ** (r - n_fovea + 1)
        for r in range(n_rings)
    ]


@given(foveal_parameters())
@relaxed
def test_foveal_cartesian_tiles_its_square(parameters):
    layout = foveal_cartesian(**parameters)
    half_um = half_sides_um(**parameters)[-1]
    union = covered(layout)

    assert layout.n_sites == (2 * parameters["n_rings"] - 1) ** 2
    assert_tiles(layout)
    assert (union.geom_type, len(union.interiors)) == ("Polygon", 0)
    assert layout.area_um2.sum() == pytest.approx(4 * half_um**2, rel=1e-9)
    assert layout.bounds_um == pytest.approx((-half_um, -half_um, half_um, half_um), rel=1e-12)


@given(foveal_parameters())
@relaxed
def test_foveal_cartesian_neighbours_share_edges_exactly(parameters):
    counts = edge_counts(foveal_cartesian(**parameters))

    assert counts[1] == 4 * (2 * parameters["n_rings"] - 1)
    assert set(counts) <= {1, 2}


@given(foveal_parameters())
@example({"n_rings": 7, "ring_ratio": 5 / 3, "pitch_um": 0.7, "n_fovea": 1})
@example({"n_rings": 8, "ring_ratio": 1.4, "pitch_um": 0.1, "n_fovea": 3})
@relaxed
def test_foveal_cartesian_edges_are_axis_parallel(parameters):
    layout = foveal_cartesian(**parameters)
    edges_um = np.concatenate([np.diff(shapely.get_coordinates(p), axis=0) for p in layout.polygons()])

    assert set(np.count_nonzero(edges_um, axis=1).tolist()) == {1}
    assert np.abs(edges_um).sum(axis=1).min() > 1e-12 * layout.bounds_um[2]


@given(foveal_parameters())
@relaxed
def test_foveal_cartesian_sizes_match_closed_form(parameters):
    layout = foveal_cartesian(**parameters)
    half_um = half_sides_um(**parameters)
    sizes_um = layout.site_bounds_um[:, 2:] - layout.site_bounds_um[:, :2]

    np.testing.assert_allclose(layout.area_um2, sizes_um.prod(axis=1), rtol=1e-9)
    np.testing.assert_allclose(sizes_um[0], 2 * half_um[0], rtol=1e-12)
    for r in range(1, parameters["n_rings"]):
        high, wide = half_um[r] - half_um[r - 1], 2 * half_um[r - 1] / (2 * r - 1)
        in_ring = np.sort(sizes_um[layout.columns["ring"] == r], axis=1)
        expected = [[high, high]] * 4 + [sorted((high, wide))] * (8 * r - 4)

        np.testing.assert_allclose(in_ring[np.lexsort(in_ring.T[::-1])], sorted(expected), rtol=1e-9)


@given(foveal_parameters())
@relaxed
def test_foveal_cartesian_preserves_grid_order(parameters):
    layout = foveal_cartesian(**parameters)
    n = 2 * parameters["n_rings"] - 1
    row, column = layout.columns["row"], layout.columns["column"]
    x, y = np.zeros((2, n, n))
    x[row, column], y[row, column] = layout.centroid_um.T

    assert len(set(zip(row.tolist(), column.tolist(), strict=True))) == n * n
    assert layout.readout_line.tolist() == column.tolist()
    assert np.maximum(abs(row - n // 2), abs(column - n // 2)).tolist() == layout.columns["ring"].tolist()
    # Within a ring, the next site along a row or column is to the right or above.
    ring = np.zeros((n, n), int)
    ring[row, column] = layout.columns["ring"]
    assert bool(np.all(np.diff(x, axis=1)[ring[:, 1:] == ring[:, :-1]] > 0))
    assert bool(np.all(np.diff(y, axis=0)[ring[1:] == ring[:-1]] > 0))


@given(st.integers(1, 8), units_um)
@relaxed
def test_foveal_cartesian_fovea_is_a_grid(n_rings, pitch_um):
    layout = foveal_cartesian(n_rings=n_rings, ring_ratio=1.5, pitch_um=pitch_um, n_fovea=n_rings)
    uniform = grid(n_x=2 * n_rings - 1, n_y=2 * n_rings - 1, pitch_um=pitch_um)
    order = np.lexsort((layout.columns["column"], layout.columns["row"]))

    assert bool(np.all(np.diff(layout.ring_offsets) == 4))
    np.testing.assert_allclose(
        layout.site_bounds_um[order], uniform.site_bounds_um, rtol=1e-12, atol=1e-12 * pitch_um * n_rings
    )


def test_foveal_cartesian_with_ratio_three():
    layout = foveal_cartesian(n_rings=3, ring_ratio=3.0, pitch_um=2.0)

    assert layout.area_um2[:9].tolist() == [4.0] * 9
    assert Counter(layout.area_um2[9:].tolist()) == {36.0: 4, 12.0: 12}
    assert layout.columns["sector"].tolist() == [0, *range(8), *range(16)]
    assert layout.centroid_um[[1, 2, 3, 9]].tolist() == [[-2, -2], [0, -2], [2, -2], [-6, -6]]


@given(st.integers(1, 6), st.integers(1, 8), st.floats(0.0, 1.0))
@relaxed
def test_foveal_cartesian_minimum_size_is_pitch(n_fovea, n_growing, excess):
    ratio = 1 + 2 / (2 * n_fovea - 1) + excess
    layout = foveal_cartesian(n_rings=n_fovea + n_growing, ring_ratio=ratio, pitch_um=2.2, n_fovea=n_fovea)
    sizes_um = layout.site_bounds_um[:, 2:] - layout.site_bounds_um[:, :2]

    assert sizes_um.min() == pytest.approx(2.2, rel=1e-9)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"n_rings": 0}, "'n_rings' must be >= 1, got 0"),
        ({"n_rings": 3600}, "'n_sites' must be <= 50000000, got 51825601"),
        ({"ring_ratio": 1.0}, "'ring_ratio' must be > 1, got 1.0"),
        ({"ring_ratio": math.inf}, "'ring_ratio' must be finite"),
        (
            {"ring_ratio": 10.0},
            "'ring_ratio' must keep the radius of 9 growing rings within 1e.07 µm, got 10.0; take a smaller ratio",
        ),
        ({"pitch_um": -1}, "'pitch_um' must be > 0, got -1 µm"),
        ({"n_fovea": 0}, "'n_fovea' must be >= 1, got 0"),
        ({"n_fovea": 11}, "'n_fovea' must be <= 10, got 11; the upper limit is 'n_rings'"),
    ],
)
def test_foveal_cartesian_rejects_invalid_parameters(changed, message):
    with pytest.raises(ParameterError, match=message):
        foveal_cartesian(**{"n_rings": 10, "ring_ratio": 1.2, "pitch_um": 1.0, **changed})


# -- octagonal -------------------------------------------------------------------------------------------------------


@st.composite
def octagonal_parameters(draw):
    pitch_um = draw(units_um)
    return {
        "n_x": draw(st.integers(1, 6)),
        "n_y": draw(st.integers(1, 6)),
        "pitch_um": pitch_um,
        "diamond_um": draw(st.none() | st.floats(0.01, 0.7).map(lambda fraction: fraction * pitch_um)),
        "border": draw(st.sampled_from(["whole", "cut"])),
    }


@given(octagonal_parameters())
@relaxed
def test_octagons_and_diamonds_tile_without_holes(parameters):
    layout = octagonal(**parameters)
    union = covered(layout)

    assert_tiles(layout)
    assert (union.geom_type, len(union.interiors)) == ("Polygon", 0)


@given(octagonal_parameters())
@relaxed
def test_cut_diamonds_complete_rectangle(parameters):
    layout = octagonal(**{**parameters, "border": "cut"})
    wide_um, high_um = (parameters[n] * parameters["pitch_um"] for n in ("n_x", "n_y"))

    assert layout.area_um2.sum() == pytest.approx(wide_um * high_um, rel=1e-9)
    assert covered(layout).area == pytest.approx(shapely.box(*layout.bounds_um).area, rel=1e-9)
    assert layout.bounds_um == pytest.approx((-wide_um / 2, -high_um / 2, wide_um / 2, high_um / 2), rel=1e-12)


@given(octagonal_parameters())
@relaxed
def test_octagon_and_diamond_fill_cell(parameters):
    layout = octagonal(**parameters)
    pitch_um = parameters["pitch_um"]
    diamond_um = parameters["diamond_um"] or (math.sqrt(2) - 1) * pitch_um
    n_x, n_y = parameters["n_x"], parameters["n_y"]
    is_cut = parameters["border"] == "cut"
    octagons, diamonds = (layout.area_um2[layout.columns["kind"] == kind] for kind in (0, 1))
    parts = Counter({1.0: (n_x - 1) * (n_y - 1)})
    parts.update({0.5: is_cut * 2 * (n_x + n_y - 2), 0.25: is_cut * 4})

    np.testing.assert_allclose(octagons, [pitch_um**2 - diamond_um**2] * (n_x * n_y), rtol=1e-9)
    np.testing.assert_allclose(np.sort(diamonds), sorted(p * diamond_um**2 for p in parts.elements()), rtol=1e-9)


@given(octagonal_parameters())
@relaxed
def test_octagonal_neighbours_share_edges_exactly(parameters):
    n_x, n_y = parameters["n_x"], parameters["n_y"]
    is_cut = parameters["border"] == "cut"
    counts = edge_counts(octagonal(**parameters))
    flat, slanted = n_x * (n_y - 1) + n_y * (n_x - 1), 4 * (n_x * n_y if is_cut else (n_x - 1) * (n_y - 1))

    assert counts[2] == flat + slanted
    # The boundary consists of flat sides of octagons and, if cut, of one side per half and two per quarter.
    n_on_boundary = 2 * (n_x + n_y) + (2 * (n_x + n_y - 2) + 8 if is_cut else 4 * n_x * n_y - slanted)
    assert counts[1] == n_on_boundary
    assert set(counts) <= {1, 2}


@given(st.integers(1, 4), st.integers(1, 4), units_um)
@relaxed
def test_octagons_are_regular_by_default(n_x, n_y, pitch_um):
    layout = octagonal(n_x=n_x, n_y=n_y, pitch_um=pitch_um)
    octagons = layout.xy_um[: 8 * n_x * n_y].reshape(-1, 8, 2)
    sides_um = np.roll(octagons, -1, axis=1) - octagons
    ahead_um = np.roll(sides_um, -1, axis=1)
    turn_rad = np.arctan2(
        sides_um[..., 0] * ahead_um[..., 1] - sides_um[..., 1] * ahead_um[..., 0], (sides_um * ahead_um).sum(axis=2)
    )

    np.testing.assert_allclose(np.hypot(*np.moveaxis(sides_um, 2, 0)), (math.sqrt(2) - 1) * pitch_um, rtol=1e-9)
    np.testing.assert_allclose(turn_rad, math.pi / 4, rtol=1e-9)


def test_diamonds_are_between_four_octagons():
    layout = octagonal(n_x=3, n_y=2, pitch_um=4.0, diamond_um=math.sqrt(2))
    diamonds = layout[layout.columns["kind"] == 1]

    np.testing.assert_allclose(diamonds.centroid_um, [[-2, 0], [2, 0]], atol=1e-12)
    np.testing.assert_allclose(diamonds.xy_um[:4], [[-2, -1], [-1, 0], [-2, 1], [-3, 0]], atol=1e-12)


def test_octagons_precede_diamonds_row_by_row():
    layout = octagonal(n_x=3, n_y=3, pitch_um=2.0)

    assert layout.columns["kind"].tolist() == [0] * 9 + [1] * 4
    assert layout.columns["row"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 0, 0, 1, 1]
    assert layout.columns["column"].tolist() == [0, 1, 2] * 3 + [0, 1] * 2
    assert layout.readout_line.tolist() == [0, 1, 2] * 3 + [3, 4] * 2
    np.testing.assert_allclose(layout.centroid_um[[0, 1, 3, 9]], [[-2, -2], [0, -2], [-2, 0], [-1, -1]], atol=1e-12)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"n_x": 0}, "'n_x' must be >= 1, got 0"),
        ({"n_y": 1.5}, "'n_y' must be an integer, got 1.5"),
        ({"n_x": 10_000, "n_y": 10_000}, "'n_sites' must be <= 50000000"),
        ({"pitch_um": math.nan}, "'pitch_um' must be finite, got nan µm"),
        ({"diamond_um": 0.0}, "'diamond_um' must be > 0, got 0.0 µm"),
        ({"diamond_um": math.sqrt(2.0)}, "'diamond_um' must be <= 1.41421, got 1.41.* µm; .* would touch"),
        ({"border": "open"}, "'border' must be one of 'whole', 'cut', got 'open'"),
    ],
)
def test_octagonal_rejects_invalid_parameters(changed, message):
    with pytest.raises(ParameterError, match=message):
        octagonal(**{"n_x": 3, "n_y": 3, "pitch_um": 2.0, **changed})


# -- all families ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "parameters", "n_sites", "area_um2"),
    [
        pytest.param(
            giotto,
            {"n_rho": 220, "n_theta": 640, "n_fovea": 100, "n_across": 1600, "unit_um": 1.0},
            1 + 6 * 100 * 99 // 2 + 120 * 640,
            regular_polygon_um2(1280, 800.0),
            id="giotto",
        ),
        pytest.param(
            foveal_cartesian,
            {"n_rings": 160, "ring_ratio": 1.03, "pitch_um": 2.0, "n_fovea": 30},
            319**2,
            (2 * 29.5 * 2.0 * 1.03**130) ** 2,
            id="foveal Cartesian",
        ),
        pytest.param(
            octagonal,
            {"n_x": 230, "n_y": 220, "pitch_um": 2.0, "border": "cut"},
            230 * 220 + 231 * 221,
            230 * 220 * 4.0,
            id="octagonal",
        ),
    ],
)
def test_100000_sites_have_expected_area(make, parameters, n_sites, area_um2):
    layout = make(**parameters)

    assert layout.n_sites == n_sites
    assert layout.area_um2.min() > 0.0
    assert layout.area_um2.sum() == pytest.approx(area_um2, rel=1e-9)


@pytest.mark.parametrize(
    ("make", "parameters"),
    [
        (giotto, {**GIOTTO_1, "unit_um": 6.45, "fovea": "none", "stagger": False, "chords_per_arc": 3}),
        (foveal_cartesian, {"n_rings": 6, "ring_ratio": 1.3, "pitch_um": 2.2, "n_fovea": 2}),
        (octagonal, {"n_x": 4, "n_y": 3, "pitch_um": 5.0, "diamond_um": None, "border": "cut"}),
        (octagonal, {"n_x": 4, "n_y": 3, "pitch_um": 5.0, "diamond_um": 1.5, "border": "whole"}),
    ],
)
def test_provenance_reproduces_layout(make, parameters):
    layout = make(**parameters)

    assert layout.provenance["generator"] == make.__name__
    given = dict.fromkeys(layout.provenance["parameters"]) | parameters
    assert layout.provenance["parameters"] == given
    assert make(**layout.provenance["parameters"]).xy_um.tolist() == layout.xy_um.tolist()
