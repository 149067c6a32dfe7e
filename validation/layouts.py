"""
Design rules, files, shared edges and generators of layouts.

Truths are known by construction, or closed forms. KLayout checks the polygons without merging those that touch
(``merged_semantics`` off, no shielding); its markers are pairs of edges, counted here by the photosites that they lie on.
Vertices are rounded to the grid of 1 nm, which changes a width by at most 1.4 nm. gdstk and KLayout read files that foveasim
writes. Shapely intersects the boundaries of neighbours: where a vertex lies on the edge of a neighbour only up to rounding,
they cross in a point; ``snap`` is its remedy.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gdstk
import numpy as np
import shapely
from klayout import db
from matplotlib.figure import Figure
from records import OWN, Section, largest_absolute, largest_relative, version_of
from scipy.spatial import Voronoi

import foveasim as fs

KLAYOUT, GDSTK, SHAPELY = (f"{name} {version_of(name.lower())}" for name in ("KLayout", "gdstk", "shapely"))
DBU_UM = 1e-3
#: Rules of the random layout, µm and µm², and the distance of drawn values from them.
MIN_WIDTH_UM, MIN_SPACE_UM, MIN_AREA_UM2, CLEARANCE = 2.0, 1.5, 12.0, 0.02
#: Edges at larger angles do not face each other, in both programs: corners of nearly 90 degrees are no width.
ANGLE_LIMIT_DEG = 45.0
#: Photosites of the random layout along a side, and their pitch.
N_SIDE, PITCH_UM = 45, 9.0
#: Rotation of layouts, which makes their coordinates irrational.
ANGLE_DEG = 30.0
#: Distance within which shapely snaps vertices.
SNAP_UM = 1e-6


def random_sites() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """
    Return outlines in random positions and orientations, their widths and their areas.

    Rectangles, hexagons, and dumbbells whose neck is narrower than their ends. No width or area is near a limit, no two touch.
    """
    rng = np.random.default_rng(1)
    outlines, widths, areas, polygons = [], [], [], []
    for k in range(N_SIDE**2):
        while True:
            width, length = rng.uniform(1.0, 4.0), rng.uniform(4.2, 7.0)
            if k % 3 == 0:
                shape = 0.5 * np.array([(-length, -width), (length, -width), (length, width), (-length, width)])
                area = length * width
            elif k % 3 == 1:
                shape = (
                    width / math.sqrt(3.0) * np.array([(math.cos(a), math.sin(a)) for a in np.pi / 3 * np.arange(6)])
                )
                area = 0.5 * math.sqrt(3.0) * width**2
            else:
                x, y, neck, end = 0.5 * length, 2.1, 0.5 * width, 0.5 * length - 1.0
                right = [(end, -neck), (end, -y), (x + 1.1, -y), (x + 1.1, y), (end, y), (end, neck)]
                shape = np.array(right + [(-u, -v) for u, v in right])
                area = 2.0 * end * width + 4.0 * y * (x + 1.1 - end)
            if abs(width - MIN_WIDTH_UM) > CLEARANCE and abs(area - MIN_AREA_UM2) > CLEARANCE:
                break
        angle = rng.uniform(0.0, 2.0 * np.pi)
        turn = np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
        outline = shape @ turn + PITCH_UM * np.array(divmod(k, N_SIDE)) + rng.uniform(-0.6, 0.6, 2)
        polygon = shapely.Polygon(outline)
        if any(polygon.distance(other) < CLEARANCE for other in polygons[-N_SIDE - 2 :]):
            continue
        polygons.append(polygon)
        outlines.append(outline)
        widths.append(width)
        areas.append(area)
    return outlines, np.array(widths), np.array(areas)


def region_of(outlines: list[np.ndarray]) -> db.Region:
    """Return polygons on the database grid, which are not merged."""
    region = db.Region()
    region.merged_semantics = False
    for outline in outlines:
        region.insert(db.Polygon([db.Point(x, y) for x, y in np.rint(outline / DBU_UM).astype(int).tolist()]))
    return region


def sites_of(edges: list[db.Edge], tree: shapely.STRtree) -> np.ndarray:
    """Return the sites on whose boundaries edges lie."""
    middle = [(0.5 * (e.x1 + e.x2) * DBU_UM, 0.5 * (e.y1 + e.y2) * DBU_UM) for e in edges]
    return tree.query_nearest(shapely.points(middle), all_matches=False)[1]


def wrong(found: Any, truth: Any) -> float:
    """Return the number of items on which two sets, or arrays of flags, differ."""
    if isinstance(truth, set):
        return float(len(found ^ truth))
    return float(np.count_nonzero(np.asarray(found) != np.asarray(truth)))


def compare_rules(section: Section, directory: Path) -> None:
    """Compare widths, distances, areas and overlaps of random outlines."""
    outlines, width_um, area_um2 = random_sites()
    n = len(outlines)
    layout, region = fs.Layout.from_polygons(outlines), region_of(outlines)
    polygons = shapely.polygons([shapely.linearrings(np.rint(o / DBU_UM) * DBU_UM) for o in outlines])
    tree = shapely.STRtree(shapely.boundary(polygons))

    def own(**limits: float) -> fs.layout.RuleResult:
        return layout.check(fs.DesignRules(angle_limit_deg=ANGLE_LIMIT_DEG, **limits)).results[0]

    def flags(sites: Any) -> np.ndarray:
        flag = np.zeros(n, bool)
        flag[np.asarray(sites, int)] = True
        return flag

    def klayout_widths() -> list[db.EdgePair]:
        check = region.width_check(
            round(MIN_WIDTH_UM / DBU_UM), False, db.Region.Euclidian, ANGLE_LIMIT_DEG, None, None, False
        )
        return list(check.each())

    def klayout_width_sites() -> np.ndarray:
        return flags(sites_of([pair.first for pair in klayout_widths()], tree))

    is_narrow = width_um < MIN_WIDTH_UM
    found = section.compare(
        f"minimum width of {n:,} rectangles, hexagons and dumbbells at random angles: {is_narrow.sum()} violations",
        {
            OWN: lambda: flags([v.site_ids[0] for v in own(min_width_um=MIN_WIDTH_UM).violations]),
            KLAYOUT: klayout_width_sites,
        },
        is_narrow,
        by="widths by which they are drawn",
        source="construction",
        tolerance=0.0,
        deviation=wrong,
        of="sites judged wrongly",
        cannot={KLAYOUT: "reports pairs of edges; sites by the nearest outline, in shapely, are part of its time"},
    )

    def own_widths() -> np.ndarray:
        return np.array([v.value for v in sorted(own(min_width_um=MIN_WIDTH_UM).violations, key=lambda v: v.site_ids)])

    def klayout_width_values() -> np.ndarray:
        pairs = klayout_widths()
        sites, value = sites_of([pair.first for pair in pairs], tree), np.full(n, np.inf)
        np.minimum.at(value, sites, [pair.distance() * DBU_UM for pair in pairs])
        return value[is_narrow]

    section.compare(
        "their widths, where they violate the rule",
        {OWN: own_widths, KLAYOUT: klayout_width_values},
        width_um[is_narrow],
        by="widths by which they are drawn",
        source="construction",
        tolerance=1.42e-3,
        deviation=largest_absolute,
        of="µm",
        cannot={KLAYOUT: "rounds distances to the grid"},
        explanation="Rounding of the vertices to 1 nm: the tolerance is its diagonal.",
        repeats=0,
    )
    draw_violations(section, directory, outlines, found[OWN], found[KLAYOUT])
    compare_space(section, own, region, polygons, tree)
    is_small = area_um2 < MIN_AREA_UM2

    def klayout_areas() -> np.ndarray:
        small = region.with_area(None, round(MIN_AREA_UM2 / DBU_UM**2), False)
        edges = [next(polygon.each_edge()) for polygon in small.each()]
        return flags(sites_of(edges, tree))

    section.compare(
        f"minimum area of the same shapes: {is_small.sum()} violations",
        {
            OWN: lambda: flags([v.site_ids[0] for v in own(min_area_um2=MIN_AREA_UM2).violations]),
            KLAYOUT: klayout_areas,
        },
        is_small,
        by="closed forms of their areas",
        source="construction",
        tolerance=0.0,
        deviation=wrong,
        of="sites judged wrongly",
    )


def compare_space(
    section: Section,
    own: Callable[..., fs.layout.RuleResult],
    region: db.Region,
    polygons: np.ndarray,
    tree: shapely.STRtree,
) -> None:
    """Compare pairs of sites that are too close."""
    first, second = np.triu_indices(polygons.size, 1)
    box = shapely.bounds(polygons)
    gap = np.maximum(box[first, :2] - box[second, 2:], box[second, :2] - box[first, 2:]).max(axis=1)
    near = gap < MIN_SPACE_UM
    first, second = first[near], second[near]
    distance = shapely.distance(polygons[first], polygons[second])
    is_close = distance < MIN_SPACE_UM
    pairs = set(zip(first[is_close].tolist(), second[is_close].tolist(), strict=True))

    def klayout_pairs() -> set[tuple[int, int]]:
        check = region.isolated_check(round(MIN_SPACE_UM / DBU_UM), False, db.Region.Euclidian, 90.0, None, None, False)
        found = list(check.each())
        a, b = (sites_of([getattr(pair, name) for pair in found], tree).tolist() for name in ("first", "second"))
        return {(min(i, j), max(i, j)) for i, j in zip(a, b, strict=True)}

    section.compare(
        f"minimum distance between the same shapes: {len(pairs)} violations",
        {OWN: lambda: {tuple(v.site_ids) for v in own(min_space_um=MIN_SPACE_UM).violations}, KLAYOUT: klayout_pairs},
        pairs,
        by="distances of all pairs of outlines on the grid, in shapely",
        source="de Berg et al., Computational Geometry (2008)",
        tolerance=0.0,
        deviation=wrong,
        of="pairs judged wrongly",
        cannot={KLAYOUT: "reports pairs of edges; the sites are those of the nearest outlines"},
    )


def draw_violations(
    section: Section, directory: Path, outlines: list[np.ndarray], own: np.ndarray, other: np.ndarray
) -> None:
    """Draw a corner of the random layout with the sites that are too narrow."""
    figure = Figure(figsize=(6.0, 5.6), layout="constrained")
    axes = figure.subplots()
    end_um = 9.5 * PITCH_UM
    for outline, is_own, is_other in zip(outlines, own, other, strict=True):
        if outline.max() < end_um:
            axes.fill(
                *outline.T,
                fc="#d95f02" if is_own else "#d0d4d8",
                ec="#1b5e9e" if is_other else "0.45",
                lw=1.6 if is_other else 0.5,
            )
    axes.set(aspect="equal", xlabel="x / µm", ylabel="y / µm")
    section.draw(
        "widths",
        figure,
        f"Sites below a width of {MIN_WIDTH_UM:g} µm: filled in orange by foveasim, with a blue outline by KLayout.",
        directory,
    )


def compare_overlaps(section: Section) -> None:
    """Compare areas covered twice."""
    rng = np.random.default_rng(2)
    n = 400
    corner = 10.0 * np.stack(np.divmod(np.arange(n), 20), axis=1).astype(float)
    size, shift = np.round(rng.uniform(2.0, 4.0, (n, 2)), 3), np.round(rng.uniform(0.5, 1.9, (n, 2)), 3)
    first = np.concatenate((corner, corner + size), axis=1)
    second = np.concatenate((corner + shift, corner + shift + size[::-1]), axis=1)
    common = np.minimum(first[:, 2:], second[:, 2:]) - np.maximum(first[:, :2], second[:, :2])
    shapes = [np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) for x0, y0, x1, y1 in np.concatenate((first, second))]
    layout, region = fs.Layout.from_polygons(shapes), region_of(shapes)
    truth = np.sort(common.prod(axis=1))
    section.compare(
        f"areas that are covered twice, {n} pairs of rectangles",
        {
            OWN: lambda: np.sort(layout.check(fs.DesignRules(max_overlap_um2=0.0)).results[0].values),
            KLAYOUT: lambda: np.sort([p.area() * DBU_UM**2 for p in region.merged(False, 2).each()]),
        },
        truth,
        by="products of sides",
        source="construction",
        tolerance=1e-9,
        deviation=largest_relative,
    )


def giotto_width_um(n_rho: int, n_theta: int, n_fovea: int, n_across: int, unit_um: float) -> np.ndarray:
    """Return the widths of the sites of a ring outside the fovea: between chords, and between sides at the inner chord."""
    n_log = n_rho - n_fovea
    low, high = 1.0 + 1e-9, 2.0
    for _ in range(200):
        ratio = 0.5 * (low + high)
        is_low = ratio * (ratio**n_log - 1.0) / (ratio - 1.0) < 0.5 * n_across - n_fovea + 0.5
        low, high = (ratio, high) if is_low else (low, ratio)
    b = ratio / (ratio - 1.0)
    radius_um = unit_um * (n_fovea - b - 0.5 + b * ratio ** np.arange(n_log + 1))
    half = math.pi / n_theta
    return np.minimum(np.diff(radius_um) * math.cos(half), radius_um[:-1] * math.sin(2.0 * half))


def compare_giotto(section: Section) -> None:
    """Compare the sites of Giotto 2 that are narrower than 6.8 µm."""
    limit_um, n_theta, n_fovea = 6.8, 252, 42
    layout = fs.layout.giotto(n_rho=152, n_theta=n_theta, n_fovea=n_fovea, n_across=1090, unit_um=6.45, stagger=False)
    outside = layout[layout.columns["ring"] >= n_fovea]
    outlines = [np.asarray(p.exterior.coords)[:-1] for p in outside.polygons()]
    polygons = shapely.polygons([shapely.linearrings(np.rint(o / DBU_UM) * DBU_UM) for o in outlines])
    region, tree = region_of(outlines), shapely.STRtree(shapely.buffer(polygons, -0.01))
    truth = np.repeat(giotto_width_um(152, n_theta, n_fovea, 1090, 6.45) < limit_um, n_theta)

    def own() -> np.ndarray:
        rules = fs.DesignRules(min_width_um=limit_um, angle_limit_deg=45.0)
        flag = np.zeros(outside.n_sites, bool)
        flag[[v.site_ids[0] for v in outside.check(rules).results[0].violations]] = True
        return flag

    def other() -> np.ndarray:
        found = region.width_check(round(limit_um / DBU_UM), False, db.Region.Euclidian, 45.0, None, None, False)
        middle = [pair.polygon(0).bbox().center() for pair in found.each()]
        flag = np.zeros(outside.n_sites, bool)
        points = shapely.points([(p.x * DBU_UM, p.y * DBU_UM) for p in middle])
        flag[tree.query_nearest(points, all_matches=False)[1]] = True
        return flag

    section.compare(
        f"minimum width of {limit_um} µm in the {outside.n_sites:,} log-polar sites of Giotto 2: {truth.sum()} violations",
        {OWN: own, KLAYOUT: other},
        truth,
        by="distances between chords and between sides, by ring",
        source="construction of the rings, github.com/robotology/icub-main, src/libraries/logPolar",
        tolerance=0.0,
        deviation=wrong,
        of="sites judged wrongly",
        repeats=1,
    )


def compare_files(section: Section) -> None:
    """Compare areas of polygons after files in GDSII and OASIS."""
    n_sectors = 128
    layout = fs.layout.log_polar(n_sectors, n_rings=60, r_min_um=200.0, r_max_um=3000.0)
    radius_um = 200.0 * 15.0 ** (np.arange(61) / 60)
    angle = 2.0 * np.pi / n_sectors
    truth = np.repeat(0.5 * np.diff(radius_um**2) * math.sin(angle), n_sectors)
    # A vertex that moves by at most half a grid step along x and y changes the area by that times half the diagonal it spans.
    corner = np.stack((radius_um[:-1] * math.cos(angle), radius_um[:-1] * math.sin(angle)), axis=1)
    diagonal_um = np.hypot(radius_um[1:] - corner[:, 0], corner[:, 1])
    bound = np.repeat(4 * 0.5 * math.sqrt(0.5) * DBU_UM * diagonal_um, n_sectors)

    def of_bound(found: Any, exact: Any) -> float:
        return float(np.abs((np.asarray(found) - exact) / bound).max())

    with tempfile.TemporaryDirectory() as folder:
        for extension, name in (("gds", "GDSII"), ("oas", "OASIS")):
            path = Path(folder) / f"sites.{extension}"
            layout.write(path)
            read = gdstk.read_gds if extension == "gds" else gdstk.read_oas

            def by_klayout(path: Path = path) -> np.ndarray:
                stored = db.Layout()
                stored.read(str(path))
                shapes = stored.top_cell().begin_shapes_rec(stored.layer_indexes()[0])
                return (
                    np.array([shape.shape().polygon.transformed(shape.trans()).area() for shape in shapes.each()])
                    * stored.dbu**2
                )

            def by_gdstk(path: Path = path, read: Callable[..., Any] = read) -> np.ndarray:
                return np.array([polygon.area() for polygon in read(str(path)).top_level()[0].get_polygons()])

            section.compare(
                f"areas of {layout.n_sites:,} log-polar sites, written to {name} by foveasim and read",
                {
                    OWN: lambda path=path: np.sort(fs.layout.read_layout(path).area_um2),
                    KLAYOUT: lambda: np.sort(by_klayout()),
                    GDSTK: lambda: np.sort(by_gdstk()),
                },
                np.sort(truth),
                by="½ (r₂² − r₁²) sin Δθ",
                source="area of a trapezium",
                tolerance=1.0,
                deviation=of_bound,
                of="of the largest effect of rounding to 1 nm",
                explanation="All read the same vertices on the grid." if extension == "gds" else "",
            )


def lengths(pairs: tuple[np.ndarray, np.ndarray], polygons: np.ndarray, snap_um: float = 0.0) -> np.ndarray:
    """Return the lengths of common boundaries by shapely, optionally with the vertices of each in the edges of the other."""
    edge = shapely.boundary(polygons)
    first, second = edge[pairs[0]], edge[pairs[1]]
    if snap_um:
        first = shapely.snap(first, second, snap_um)
        second = shapely.snap(second, first, snap_um)
    return shapely.length(shapely.intersection(first, second))


def compare_adjacency(section: Section) -> None:
    """Compare lengths of shared edges with the ridges of a Voronoi diagram, and in a wall of bricks."""
    snapped = f"{SHAPELY}, with snap"
    points = "Collinear edges with different vertices, in floating point, intersect in points without length."
    rng = np.random.default_rng(3)
    centres = rng.uniform(-100.0, 100.0, (3000, 2))
    mirrored = np.concatenate(
        [centres]
        + [
            centres * s + t
            for s, t in (((-1, 1), (-200, 0)), ((-1, 1), (200, 0)), ((1, -1), (0, -200)), ((1, -1), (0, 200)))
        ]
    )
    diagram = Voronoi(mirrored)
    ridges = [
        (min(a, b), max(a, b), v)
        for (a, b), v in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True)
        if max(a, b) < len(centres)
    ]
    truth = np.zeros((len(centres), len(centres)))
    for a, b, (i, j) in ridges:
        truth[a, b] = np.hypot(*(diagram.vertices[i] - diagram.vertices[j]))
    cells = [diagram.vertices[diagram.regions[diagram.point_region[k]]] for k in range(len(centres))]
    bricks = fs.layout.grid(60, 60, 2.0, stagger=True).rotate(ANGLE_DEG)
    half = np.zeros((3600, 3600))
    for row in range(60):
        for column in range(60):
            site = 60 * row + column
            if column < 59:
                half[site, site + 1] = 2.0
            if row < 59:
                for other in (column - 1 + row % 2, column + row % 2):
                    if 0 <= other < 60:
                        half[site, 60 * (row + 1) + other] = 1.0
    for what, layout, expected, by, source in (
        (
            "random Voronoi cells",
            fs.Layout.from_polygons(cells),
            truth,
            "lengths of the ridges of Qhull",
            "Qhull, in SciPy",
        ),
        (
            f"bricks in running bond, turned by {ANGLE_DEG:g}°",
            bricks,
            half,
            "the pitch and half the pitch",
            "construction",
        ),
    ):
        polygons = layout.polygons()
        a, b = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=SNAP_UM)
        pairs = a[a < b], b[a < b]

        def own(layout: fs.Layout = layout) -> np.ndarray:
            return np.triu(layout.adjacency().toarray())

        def other(polygons: np.ndarray = polygons, pairs: Any = pairs, snap_um: float = 0.0) -> np.ndarray:
            found = np.zeros((len(polygons), len(polygons)))
            found[pairs] = lengths(pairs, polygons, snap_um)
            return found

        section.compare(
            f"lengths of the edges that {layout.n_sites:,} sites share: {what}",
            {OWN: own, SHAPELY: other, snapped: lambda other=other: other(snap_um=SNAP_UM)},
            expected,
            by=by,
            source=source,
            tolerance=1e-9,
            explanation=points if layout is bricks else "",
            cannot=dict.fromkeys(
                (SHAPELY, snapped), "neighbours are found before, by its tree, and not part of the time"
            ),
        )


def compare_generators(section: Section) -> None:
    """Compare what generators draw with closed forms."""
    n_sectors = 96
    log_polar = fs.layout.log_polar(n_sectors, r_min_um=100.0, r_max_um=2000.0)
    radius = np.hypot(*log_polar[log_polar.columns["sector"] == 0].xy_um.T).reshape(-1, 4)
    q = (1.0 + math.sin(math.pi / n_sectors)) / (1.0 - math.sin(math.pi / n_sectors))
    hexagons = fs.layout.hexagonal(30, 30, 2.5)
    diamonds = fs.layout.octagonal(10, 10, 5.0, diamond_um=2.0)
    is_diamond = diamonds.columns["kind"] == 1
    golden = 0.5 * (1.0 + math.sqrt(5.0))
    rhombs = fs.layout.penrose(1.0, size_um=60.0)
    rhomb_areas = np.array([rhombs.area_um2.max(), rhombs.area_um2.min()])
    arcs = fs.layout.log_polar(n_sectors, n_rings=8, r_min_um=100.0, r_max_um=200.0, chords_per_arc=3)
    step = 2.0 * math.pi / n_sectors / 3.0
    for what, call, truth, by, source in (
        (
            "ratio of the radii of log-polar rings with approximately square sites",
            lambda: radius.max(axis=1) / radius.min(axis=1),
            np.full(len(radius), q),
            "(1 + sin π/n)/(1 − sin π/n)",
            "circles that touch in a ring and between rings",
        ),
        (
            "total area of a log-polar layout with three chords per arc",
            lambda: np.array([arcs.area_um2.sum()]),
            np.array([math.pi * (200.0**2 - 100.0**2) * math.sin(step) / step]),
            "area of the annulus times sin δ/δ",
            "area of a regular polygon",
        ),
        (
            "areas of hexagons",
            lambda: hexagons.area_um2,
            np.full(900, 0.5 * math.sqrt(3.0) * 2.5**2),
            "√3/2 times the square of the pitch",
            "area of a hexagon",
        ),
        (
            "areas of octagons and diamonds",
            lambda: diamonds.area_um2,
            np.where(is_diamond, 4.0, 25.0 - 4.0),
            "d², p² − d²",
            "tiling of the plane",
        ),
        (
            "areas of the two rhombs of Penrose",
            lambda: rhomb_areas,
            np.sin(np.radians([72.0, 36.0])),
            "sin 72°, sin 36°; their ratio is the golden one, " + f"{golden:.6f}",
            "Penrose, Bull. Inst. Math. Appl. 10, 266 (1974)",
        ),
        (
            "growth of the rings of Giotto 2",
            lambda: np.array([fs.layout.giotto_ratio(n_rho=152, n_fovea=42, n_across=1090)]),
            np.array([1.02314422608633]),
            "the published constant, with 15 digits",
            "github.com/robotology/icub-main, src/libraries/logPolar",
        ),
    ):
        section.compare(
            what,
            {OWN: call},
            truth,
            by=by,
            source=source,
            tolerance=1e-11,
            deviation=largest_relative,
            repeats=0,
        )


def validate(section: Section, directory: Path) -> None:
    """Compare rules, files, edges and generators."""
    compare_rules(section, directory)
    compare_giotto(section)
    compare_overlaps(section)
    compare_files(section)
    compare_adjacency(section)
    compare_generators(section)
