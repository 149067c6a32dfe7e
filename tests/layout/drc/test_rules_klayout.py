"""Design rules against KLayout's checks, on written files and on polygons in memory."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.rules import SITES, layouts
from shapely.affinity import rotate

import foveasim as fs

kdb = pytest.importorskip("klayout.db")
rdb = pytest.importorskip("klayout.rdb")

relaxed = settings(max_examples=examples(40))
seeds = st.integers(0, 2**32 - 1)

#: Database unit of polygons compared in memory.
DBU_UM = 0.001


def on_grid(polygons):
    """Round the polygons to the database grid, and drop those that become invalid."""
    rounded = [shapely.transform(polygon, lambda xy: np.round(xy / DBU_UM) * DBU_UM) for polygon in polygons]
    return fs.Layout.from_polygons([polygon for polygon in rounded if polygon.is_valid])


def points(ring):
    return [kdb.Point(*xy) for xy in np.round(shapely.get_coordinates(ring)[:-1] / DBU_UM).astype(int).tolist()]


def klayout_polygon(polygon):
    same = kdb.Polygon(points(polygon.exterior))
    for ring in polygon.interiors:
        same.insert_hole(points(ring))
    return same


def region_of(layout):
    """Return the sites as a region without merging of abutting or overlapping polygons."""
    region = kdb.Region([klayout_polygon(polygon) for polygon in layout.polygons()])
    region.merged_semantics = False
    return region


def read(path):
    """Read the polygons and the database unit of a GDSII or OASIS file."""
    chip = kdb.Layout()
    chip.read(str(path))
    region = kdb.Region()
    for info in chip.layer_infos():
        region.insert(chip.top_cell().begin_shapes_rec(chip.layer(info)))
    region.merged_semantics = False
    return region, chip.dbu


def edge_centre(edge):
    return shapely.Point(0.5 * (edge.x1 + edge.x2), 0.5 * (edge.y1 + edge.y2))


def trenched(seed):
    """Return rectangles and hexagons of several sizes, rotated or upright, with trenches between them."""
    rng = np.random.default_rng(seed)
    angle = np.arange(6) * math.pi / 3
    hexagon = shapely.Polygon(np.stack((np.cos(angle), np.sin(angle)), axis=1))
    is_rotated = rng.random() < 0.7
    polygons = []
    for position in np.stack(np.meshgrid(np.arange(6), np.arange(5)), axis=2).reshape(-1, 2) * 3.0:
        half = rng.uniform(0.3, 0.95, 2)
        shape = (
            shapely.box(*-half, *half)
            if rng.random() < 0.6
            else shapely.transform(hexagon, lambda xy, r=half[0] * 1.4: xy * r)
        )
        shape = rotate(shape, rng.uniform(0, 360), origin=(0, 0)) if is_rotated else shape
        move = position + rng.uniform(-0.1, 0.1, 2)
        polygons.append(shapely.transform(shape, lambda xy, move=move: xy + move))
    return on_grid(polygons)


# -- widths -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def giotto():
    """Giotto 2 with rings up to its centre, at a unit pixel of 6.45 µm."""
    return fs.layout.giotto(n_rho=152, n_theta=252, n_fovea=42, n_across=1090, unit_um=6.45, fovea="none")


@pytest.mark.slow
def test_klayout_finds_same_narrow_giotto_sites(giotto, tmp_path):
    giotto.write(tmp_path / "giotto.gds")
    region, dbu_um = read(tmp_path / "giotto.gds")
    pairs = region.width_check(round(6.8 / dbu_um), False, kdb.Region.Projection, 80.0, None, None)
    # A pair of edges belongs to the site that contains its centre.
    centre_lines = [kdb.Edge(pair.first.bbox().center(), pair.second.bbox().center()) for pair in pairs.each()]
    midpoints = shapely.transform([edge_centre(edge) for edge in centre_lines], lambda xy: xy * dbu_um)
    pair, site = shapely.STRtree(giotto.polygons()).query(midpoints, predicate="intersects")
    narrow = {
        violation.site_ids[0]
        for violation in giotto.check(fs.DesignRules(min_width_um=6.8, angle_limit_deg=80.0)).violations
    }

    assert region.count() == giotto.n_sites == 27_720
    assert np.bincount(pair).tolist() == [1] * pairs.count()
    assert len(set(site.tolist())) == 504
    assert set(site.tolist()) == narrow


def sites_of_kind(kind, seed, n):
    """Return random sites of a kind on the database grid, and a limit in database units for each."""
    rng = np.random.default_rng(seed)
    sites = list(on_grid([SITES[kind](rng) for _ in range(n)]).polygons())
    return sites, rng.integers(20, 1500, len(sites)).tolist()


def disagreements(kind, seed, n, rule, check, angle_deg=90.0):
    """
    Return the sites for which KLayout's verdict is another one, and the number that KLayout flags.

    Its option ``transparent`` is set: by default it ignores pairs of edges behind other edges.
    KLayout rounds the points where one edge passes the line of another to the grid: values within two database units of the
    limit may differ.
    """
    wrong, n_flagged = [], 0
    for site, limit_dbu in zip(*sites_of_kind(kind, seed, n), strict=True):
        limit_um = limit_dbu * DBU_UM
        region = kdb.Region([klayout_polygon(site)])
        region.merged_semantics = False
        options = (limit_dbu, False, kdb.Region.Euclidian, angle_deg, None, None)
        is_flagged = not getattr(region, check)(*options, False).is_empty()
        assert is_flagged or getattr(region, check)(*options).is_empty()
        layout = fs.Layout.from_polygons([site])
        by_limit = [
            not layout.check(fs.DesignRules(**{rule: limit_um + shift_um}, angle_limit_deg=angle_deg)).ok
            for shift_um in (-2.0 * DBU_UM, 0.0, 2.0 * DBU_UM)
        ]
        n_flagged += is_flagged
        if by_limit[1] != is_flagged and by_limit[0] == by_limit[2]:
            wrong.append((site.wkt, limit_um, is_flagged))
    return wrong, n_flagged


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("angle_deg", [90.0, 50.0])
@pytest.mark.parametrize(("rule", "check"), [("min_width_um", "width_check"), ("min_space_um", "notch_check")])
@pytest.mark.parametrize("kind", SITES)
def test_random_sites_match_klayout(kind, rule, check, angle_deg, seed):
    wrong, n_flagged = disagreements(kind, seed, 84, rule, check, angle_deg)

    assert wrong == []
    is_convex = kind in ("hulls", "tilted rectangles")
    assert n_flagged > 0 or is_convex


# Each of these passed 0.14 µm of the first metal layer: a notch, a slit and a hole of 50 nm, and corners that touch.
SPACES = {
    "notch": [shapely.box(0, 0, 2, 2).difference(shapely.box(0.9, 1.5, 0.95, 2.5))],
    "slit": [shapely.box(0, 0, 2, 2).difference(shapely.box(0.9, -1.0, 0.95, 1.5))],
    "hole": [shapely.box(0, 0, 2, 2).difference(shapely.box(0.9, 0.5, 0.95, 1.5))],
    "corners": [shapely.box(0, 0, 2, 2), shapely.box(2, 2, 4, 4)],
}


@pytest.mark.parametrize("name", SPACES)
def test_spaces_that_klayout_flags_are_violations(name):
    layout = fs.Layout.from_polygons(SPACES[name])
    report = layout.check(fs.DesignRules(min_space_um=0.14))

    assert not region_of(layout).space_check(140, False, kdb.Region.Euclidian, 90.0, None, None).is_empty()
    assert [v.value for v in report.violations] == pytest.approx([0.0 if name == "corners" else 0.05])
    assert layout.check(fs.DesignRules(min_space_um=0.04)).ok == (name != "corners")


def test_truncated_tips_are_measured_between_their_sides():
    # Sides that converge by 27.7 degrees, as those of a log-polar site of 13 sectors.
    half = 1.0 * math.tan(math.pi / 13)
    tip = shapely.Polygon([(1.0, -half), (4.0, -4.0 * half), (4.0, 4.0 * half), (1.0, half)])
    layout = fs.Layout.from_polygons([tip])
    rules = fs.DesignRules(min_width_um=1.0, angle_limit_deg=60.0)

    assert [v.value for v in layout.check(rules).violations] == pytest.approx([2.0 * half], abs=2e-3)
    assert [v.value for v in layout.check(fs.DesignRules(min_width_um=0.1)).violations] == [
        0.0
    ]  # corners of 76 degrees


# -- spaces -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("seed", range(10))
def test_random_pairs_match_klayout(seed):
    rng = np.random.default_rng(seed)
    n_near = 0
    for _ in range(50):
        pair = [SITES[str(rng.choice(list(SITES)))](rng) for _ in range(2)]
        move = rng.uniform(-4.0, 4.0, 2)
        layout = on_grid([pair[0], shapely.transform(pair[1], lambda xy, move=move: xy + move)])
        if layout.n_sites < 2:
            continue
        distance_um = float(shapely.distance(*layout.polygons()))
        limit_dbu = int(rng.integers(20, 2000))
        is_flagged = (
            not region_of(layout).isolated_check(limit_dbu, False, kdb.Region.Euclidian, 90.0, None, None).is_empty()
        )
        found = layout.check(fs.DesignRules(min_space_um=limit_dbu * DBU_UM)).violations
        is_near = any(len(v.site_ids) == 2 for v in found)
        n_near += is_near
        if distance_um == 0.0 or abs(distance_um - limit_dbu * DBU_UM) > 2.0 * DBU_UM:
            # Sites that overlap have no space, whether or not edges face each other.
            assert is_near == is_flagged or (distance_um == 0.0 and is_near), layout.polygons()
    assert n_near > 5


@given(seeds, st.integers(150, 1500))
@relaxed
def test_near_sites_match_klayout_space_check(seed, limit_dbu):
    layout = trenched(seed)
    tree = shapely.STRtree(layout.polygons())
    found = set()
    for pair in region_of(layout).isolated_check(limit_dbu, False, kdb.Region.Euclidian).each():
        sites = {
            int(tree.nearest(shapely.transform(edge_centre(edge), lambda xy: xy * DBU_UM)))
            for edge in (pair.first, pair.second)
        }
        found.add(tuple(sorted(sites)))
    violations = layout.check(fs.DesignRules(min_space_um=limit_dbu * DBU_UM)).violations

    assert {violation.site_ids for violation in violations} == found


# -- areas --------------------------------------------------------------------------------------------------------------


@given(layouts(), st.floats(0.1, 6.0))
@relaxed
def test_small_sites_match_klayout_areas(layout, limit_um2):
    layout = on_grid(layout.polygons())
    areas_um2 = [klayout_polygon(polygon).area2() / 2 * DBU_UM**2 for polygon in layout.polygons()]
    violations = layout.check(fs.DesignRules(min_area_um2=limit_um2)).violations

    assert layout.area_um2 == pytest.approx(areas_um2, rel=1e-9)
    assert sorted(violation.site_ids[0] for violation in violations) == [
        i for i, area_um2 in enumerate(areas_um2) if area_um2 < limit_um2 - 1e-6
    ]


FAMILIES = {
    "grid": fs.layout.grid(n_x=9, n_y=8, pitch_um=1.23456),
    "hexagonal": fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=1.7, width_um=1.5),
    "log_polar": fs.layout.log_polar(n_sectors=31, r_min_um=3.0, r_max_um=52.0),
    "voronoi": fs.layout.voronoi(n_sites=200, size_um=(50.0, 40.0), n_iterations=3),
    "zones": fs.layout.zones(side_um=(4, 12, 28), pitch_um=(1, 2, 4)).rotate(10.0),
}


@pytest.mark.parametrize("dbu_um", [1e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")  # 5 nm
def test_gds_areas_match_within_vertex_rounding(family, dbu_um, tmp_path):
    layout = FAMILIES[family]
    layout.write(tmp_path / "a.gds", dbu_um=dbu_um, hierarchy=False)
    region, read_dbu_um = read(tmp_path / "a.gds")
    area_um2 = np.full(layout.n_sites, np.nan)
    for polygon in region.each():
        area_um2[int(polygon.property(1).split()[1])] = polygon.area2() / 2 * dbu_um**2
    # A vertex moves by at most half a unit along x and y.
    max_um2 = shapely.length(layout.polygons()) * dbu_um / math.sqrt(2.0)

    assert read_dbu_um == pytest.approx(dbu_um)
    assert np.all(np.abs(area_um2 - layout.area_um2) <= max_um2)


# -- overlaps -----------------------------------------------------------------------------------------------------------


def overlap_um2(layout):
    """Sum the overlap of all pairs of sites: area covered by k sites counts k (k - 1) / 2 times."""
    region = region_of(layout)
    total = 0
    for n_sites in range(2, layout.n_sites + 1):
        covered = region.merged(False, n_sites)
        if covered.is_empty():
            break
        total += (n_sites - 1) * covered.area()
    return total * DBU_UM**2


@given(seeds)
@relaxed
def test_rectangle_overlaps_match_klayout(seed):
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 9000, (25, 2))
    boxes = [shapely.box(*a, *(a + size)) for a, size in zip(low, rng.integers(200, 4000, (25, 2)), strict=True)]
    layout = on_grid([shapely.transform(box, lambda xy: xy * DBU_UM) for box in boxes])
    violations = layout.check(fs.DesignRules(max_overlap_um2=0.0)).violations

    assert sum(violation.value for violation in violations) == pytest.approx(overlap_um2(layout), rel=1e-9)


@given(layouts())
@relaxed
def test_polygon_overlaps_match_klayout_within_rounding(layout):
    layout = on_grid(layout.polygons())
    violations = layout.check(fs.DesignRules(max_overlap_um2=0.0)).violations
    polygons = layout.polygons()
    first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    perimeter_um = shapely.length(shapely.intersection(polygons[first], polygons[second])[first < second]).sum()

    assert sum(violation.value for violation in violations) == pytest.approx(
        overlap_um2(layout), rel=1e-9, abs=DBU_UM * perimeter_um + DBU_UM**2
    )


# -- reports ------------------------------------------------------------------------------------------------------------


def test_klayout_report_has_same_item_counts(giotto, tmp_path):
    rules = fs.DesignRules(
        min_width_um=6.8,
        angle_limit_deg=80.0,
        min_angle_deg=89.9,
        edge_angle_step_deg=45.0,
        max_gap_um2=0.0,
        max_neighbour_ratio=1.02,
        max_sites=9,
    )
    ring = giotto.columns["ring"]
    report = giotto[(ring > 35) & (ring < 50)].check(rules)
    report.write(tmp_path / "report.lyrdb")
    database = rdb.ReportDatabase("")
    database.load(str(tmp_path / "report.lyrdb"))
    counts = {category.name(): category.num_items() for category in database.each_category()}

    assert counts == {result.rule: len(result.violations) for result in report.results}
    assert counts["max_sites"] == 1
    assert min(counts.values()) > 0
