"""
Reference implementations of the design rules, and random layouts for tests.

The implementations are loops over vertices and pairs of polygons. Each returns the measurements of a layout as pairs of site
indices and value, independent of the limit of the rule; the value is NaN if it depends on rounding errors.
"""

from __future__ import annotations

import math
from itertools import combinations, pairwise

import numpy as np
import shapely
from hypothesis import strategies as st
from shapely.affinity import rotate, scale
from shapely.geometry.polygon import orient

import foveasim as fs

#: Tolerances for rounding errors of vertices: distance of touching sites, and overlaps and gaps as fractions of a site.
TOUCHING_UM = 1e-6
AREA_ROUNDING = 1e-9
#: Maximum width of slits between adjacent sites from rounding, and distance of a gap from its sites in slit widths.
SLIT_UM = 1e-7
N_SLITS = 100


def _edges(polygon):
    """Return the edges (a, b) of each ring, with the polygon on their left."""
    oriented = orient(polygon)
    return [list(pairwise(ring.coords)) for ring in (oriented.exterior, *oriented.interiors)]


def _heading_rad(edge):
    (ax, ay), (bx, by) = edge
    return math.atan2(by - ay, bx - ax)


def _is_left(edge, point):
    """Return whether a point lies to the left of the line through an edge."""
    (ax, ay), (bx, by) = edge
    return (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax) > 0.0


def _inner_angle_deg(before, corner, after):
    """Return the angle to the left of the path over a corner, 0 to 360."""
    u = np.subtract(before, corner)
    v = np.subtract(after, corner)
    angle_deg = math.degrees(math.acos(np.clip(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)), -1.0, 1.0)))
    return angle_deg if _is_left((before, corner), after) else 360.0 - angle_deg


# -- single sites -------------------------------------------------------------------------------------------------------


def sizes(layout, _rules):
    return [((i,), math.sqrt(polygon.area)) for i, polygon in enumerate(layout.polygons())]


def areas(layout, _rules):
    return [((i,), polygon.area) for i, polygon in enumerate(layout.polygons())]


def holes(layout, _rules):
    return [
        ((i,), shapely.Polygon(ring).area) for i, polygon in enumerate(layout.polygons()) for ring in polygon.interiors
    ]


def _left_part(edge, other):
    """Return the part of another edge to the left of the line through an edge, or None."""
    a, b = np.array(edge)
    along = (b - a) / np.linalg.norm(b - a)
    far = 1e4 * along
    left = np.array([-along[1], along[0]])
    a, b = a + 1e-7 * left, b + 1e-7 * left  # not edges on the same line
    half_plane = shapely.Polygon([a - far, b + far, b + far + 1e4 * left, a - far + 1e4 * left])
    part = shapely.LineString(other).intersection(half_plane)
    return part if part.length > 1e-9 else None


def _facing_um(polygon, side, angle_limit_deg):
    """
    Return the smallest distance of facing edges, in front of each other, across a site (side 1) or outside it (-1).

    It is NaN for rings with a common vertex, where the distance is 0 for some angles.
    """
    edges = [edge[::side] for ring in _edges(polygon) for edge in ring]
    if len({tuple(edge[0]) for edge in edges}) < len(edges):
        return math.nan
    smallest = math.inf
    for e, f in combinations(edges, 2):
        u, v = np.subtract(e[1], e[0]), np.subtract(f[1], f[0])
        if -u @ v / (np.linalg.norm(u) * np.linalg.norm(v)) <= math.cos(math.radians(angle_limit_deg)) + 1e-10:
            continue
        parts = _left_part(e, f), _left_part(f, e)
        if None not in parts:
            distances = shapely.LineString(e).distance(parts[0]), shapely.LineString(f).distance(parts[1])
            smallest = min(smallest, max(distances))
    return smallest


def widths(layout, rules):
    return [((i,), _facing_um(polygon, 1, rules.angle_limit_deg)) for i, polygon in enumerate(layout.polygons())]


def aspect_ratios(layout, _rules):
    """Return the aspect ratio of the smallest bounding rectangle; of equal areas, the smallest ratio."""
    measured = []
    for i, polygon in enumerate(layout.polygons()):
        boxes = []
        for edge in pairwise(polygon.convex_hull.exterior.coords):
            x0, y0, x1, y1 = rotate(polygon, -_heading_rad(edge), origin=(0, 0), use_radians=True).bounds
            boxes.append(((x1 - x0) * (y1 - y0), max(x1 - x0, y1 - y0) / min(x1 - x0, y1 - y0)))
        min_area = min(boxes)[0]
        measured.append(((i,), min(ratio for area, ratio in boxes if math.isclose(area, min_area, rel_tol=1e-9))))
    return measured


def corner_angles(layout, _rules):
    return [
        (
            (i,),
            min(_inner_angle_deg(a, b, c) for ring in _edges(polygon) for (a, b), (_, c) in pairwise([*ring, ring[0]])),
        )
        for i, polygon in enumerate(layout.polygons())
    ]


def edge_angles(layout, rules):
    """Return deviations of directions, apart from those of rounding; multiples of 45 degrees have none."""
    step_deg = rules.edge_angle_step_deg

    def off_deg(edge):
        rounding_deg = (
            math.degrees(math.atan(math.sqrt(2.0) * rules.dbu_um / math.dist(*edge))) if step_deg % 45 else 0.0
        )
        return max(abs(math.remainder(math.degrees(_heading_rad(edge)), step_deg)) - rounding_deg, 0.0)

    return [
        ((i,), max(off_deg(edge) for ring in _edges(polygon) for edge in ring))
        for i, polygon in enumerate(layout.polygons())
    ]


def grid_deviations(layout, rules):
    return [
        ((i,), max(abs(math.remainder(x, rules.grid_um)) for x in shapely.get_coordinates(polygon).ravel().tolist()))
        for i, polygon in enumerate(layout.polygons())
    ]


def reaches(layout, rules):
    x_min, y_min, x_max, y_max = np.round(np.divide(rules.die_um, rules.dbu_um)) * rules.dbu_um
    return [
        (
            (i,),
            max(max(x_min - x, x - x_max, y_min - y, y - y_max) for x, y in shapely.get_coordinates(polygon).tolist()),
        )
        for i, polygon in enumerate(layout.polygons())
    ]


# -- pairs --------------------------------------------------------------------------------------------------------------


def spaces(layout, rules):
    """Return the distances of all pairs, and the widths of notches, slits and holes."""
    pairs = combinations(enumerate(layout.polygons()), 2)
    notches = [((i,), _facing_um(polygon, -1, rules.angle_limit_deg)) for i, polygon in enumerate(layout.polygons())]
    return [((i, j), a.distance(b)) for (i, a), (j, b) in pairs] + [n for n in notches if n[1] != math.inf]


def is_sliver(shape, rules):
    """Return whether the height of a triangle of the area and perimeter is at most half a diagonal of a grid pixel."""
    return 2.0 * shape.area / (0.5 * shape.length) <= 0.72 * rules.dbu_um


def overlaps(layout, rules):
    pairs = combinations(enumerate(layout.polygons()), 2)
    measured = [((i, j), a.intersection(b), min(a.area, b.area)) for (i, a), (j, b) in pairs]
    return [
        (sites, common.area)
        for sites, common, smaller in measured
        if common.area > AREA_ROUNDING * smaller and not is_sliver(common, rules)
    ]


def _has_common_edge(a, b):
    """Return whether a section of an edge of one polygon, not only a crossing, adjoins the other polygon."""
    for edge in (edge for ring in _edges(a) for edge in ring):
        if shapely.LineString(edge).distance(b) > TOUCHING_UM:
            continue
        start, end = np.array(edge)
        along = end - start
        right = np.array([along[1], -along[0]]) / np.hypot(*along)
        on = start + along * (np.arange(200)[:, np.newaxis] + 0.5) / 200.0
        is_shared = (
            (shapely.distance(shapely.points(on), b.boundary) < TOUCHING_UM)
            & shapely.contains_xy(a, on - 1e-5 * right)
            & shapely.contains_xy(b, on + 1e-5 * right)
        )
        if np.count_nonzero(is_shared) > 1:
            return True
    return False


def neighbour_ratios(layout, _rules):
    measured = []
    for (i, a), (j, b) in combinations(enumerate(layout.polygons()), 2):
        if a.distance(b) < TOUCHING_UM and (_has_common_edge(a, b) or _has_common_edge(b, a)):
            small, large = sorted([math.sqrt(a.area), math.sqrt(b.area)])
            measured.append(((i, j), large / small))
    return measured


# -- complete layouts ---------------------------------------------------------------------------------------------------


def gaps(layout, rules):
    """Return gaps between sites that are buffered to close slits, and buffered by the same distance."""
    polygons = layout.polygons()
    covered = shapely.unary_union([polygon.buffer(SLIT_UM, join_style="mitre") for polygon in polygons])
    if rules.die_um is None:
        field = shapely.box(*covered.bounds).buffer(10.0, join_style="mitre")
    else:
        field = shapely.box(*np.round(np.divide(rules.die_um, rules.dbu_um)) * rules.dbu_um)
    parts = [
        part.buffer(SLIT_UM, join_style="mitre", mitre_limit=1e4).intersection(field)
        for part in shapely.get_parts(field.difference(covered))
        if rules.die_um is not None or part.disjoint(field.exterior)
    ]
    return [
        (tuple(i for i, polygon in enumerate(polygons) if polygon.distance(part) < N_SLITS * SLIT_UM), part.area)
        for part in parts
        if part.area > part.length * SLIT_UM and not is_sliver(part, rules)
    ]


def growths(layout, _rules):
    rings = {}
    for i, (ring, polygon) in enumerate(zip(layout.columns["ring"].tolist(), layout.polygons(), strict=True)):
        rings.setdefault(ring, []).append((i, math.sqrt(polygon.area)))
    mean = {ring: sum(size for _, size in members) / len(members) for ring, members in rings.items()}
    return [(tuple(i for i, _ in rings[outer]), mean[outer] / mean[inner]) for inner, outer in pairwise(sorted(rings))]


def counts(layout, _rules):
    return [((), float(len(list(layout.polygons()))))]


#: Rules of the outlines on the database grid; others apply to the outlines as drawn.
MASK_RULES = {
    "min_hole_um2", "min_width_um", "min_space_um", "min_angle_deg", "edge_angle_step_deg", "grid_um", "max_overlap_um2",
    "max_gap_um2", "die_um",
}  # fmt: skip


def on_grid(layout, dbu_um=1e-3):
    """Return a layout with rounded vertices."""
    rounded = shapely.transform(layout.polygons(), lambda xy: np.round(np.round(xy / dbu_um) * dbu_um, 9))
    return fs.Layout.from_polygons(rounded, **layout.columns)


#: Reference implementation of every rule.
REFERENCES = {
    "min_size_um": sizes,
    "max_size_um": sizes,
    "min_area_um2": areas,
    "min_hole_um2": holes,
    "min_width_um": widths,
    "min_space_um": spaces,
    "max_aspect_ratio": aspect_ratios,
    "min_angle_deg": corner_angles,
    "edge_angle_step_deg": edge_angles,
    "grid_um": grid_deviations,
    "max_overlap_um2": overlaps,
    "max_gap_um2": gaps,
    "die_um": reaches,
    "min_growth": growths,
    "max_growth": growths,
    "max_neighbour_ratio": neighbour_ratios,
    "max_sites": counts,
}


# -- layouts ------------------------------------------------------------------------------------------------------------


def _star(rng):
    """Return a polygon around the origin, convex or concave, with or without a hole, of either winding."""
    n = int(rng.integers(3, 13))
    angle = (np.arange(n) + rng.uniform(0.0, 0.7, n)) * 2 * np.pi / n
    ring = rng.uniform(rng.choice([0.35, 1.0]), 1.0, (n, 1)) * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    ring = rng.uniform(0.4, 2.0) * ring[:: rng.choice([-1, 1])]
    polygon = shapely.Polygon(ring, [rng.uniform(0.2, 0.6) * ring] if n > 4 and rng.random() < 0.4 else [])
    return polygon if polygon.is_valid else polygon.convex_hull


def _hull(rng):
    return shapely.MultiPoint(rng.normal(0.0, 0.8, (int(rng.integers(5, 12)), 2))).convex_hull


def _tilted_rectangle(rng):
    return rotate(shapely.box(0.0, 0.0, *rng.uniform(0.3, 3.0, 2)), rng.uniform(0.0, 360.0))


def _rugged(rng):
    """Return a union of crossed bars, cut by a wedge: notches, courtyards and corners of many kinds."""
    bars = [
        shapely.box(*low, *(low + size))
        for low, size in zip(rng.integers(0, 6, (5, 2)), rng.integers(1, 6, (5, 2)), strict=True)
    ]
    wedge = shapely.Polygon(rng.uniform(0.0, 8.0, (3, 2)))
    parts = shapely.get_parts(shapely.union_all(bars).difference(wedge))
    return scale(rotate(max(parts, key=shapely.area), rng.choice([0.0, rng.uniform(0.0, 360.0)])), 0.5, 0.5)


def _slotted(rng):
    """Return a rectilinear site with slots and a hole, which may be narrow."""
    size = rng.integers(2000, 6000, 2)
    site = shapely.box(0, 0, *size)
    for _ in range(int(rng.integers(1, 4))):
        low, extent = rng.integers(-500, size), rng.choice([30, 100, 300, 900], 2)
        site = site.difference(shapely.box(*low, *(low + extent + rng.integers(0, 50, 2))))
    return scale(max(shapely.get_parts(site), key=shapely.area), 0.001, 0.001, origin=(0, 0))


def _tipped(rng):
    """Return a site with tips, pointed or cut off."""
    n = int(rng.integers(3, 7))
    angle = np.sort(rng.uniform(0.0, 2 * np.pi, n))
    core = shapely.Point(0.0, 0.0).buffer(0.5, quad_segs=2)
    for direction in angle:
        length, half = rng.uniform(0.8, 3.0), rng.uniform(0.1, 0.4)
        end = rng.choice([0.0, rng.uniform(0.02, 0.4)])
        tip = shapely.Polygon([(0.0, -half), (length, -end / 2), (length, end / 2), (0.0, half)]).buffer(0.0)
        core = core.union(rotate(tip, direction, origin=(0, 0), use_radians=True))
    return core


#: Random sites by kind: rectilinear and oblique, with holes, slots, notches and tips.
SITES = {
    "stars": _star, "hulls": _hull, "tilted rectangles": _tilted_rectangle, "rugged": _rugged, "slotted": _slotted,
    "tipped": _tipped,
}  # fmt: skip


def _scatter(shape):
    """Return a generator of random shapes of one kind, from overlapping to widely spaced."""

    def make(rng, n_sites):
        side_um = rng.choice([0.8, 1.5, 4.0, 10.0]) * math.sqrt(n_sites)
        positions = rng.uniform(-side_um, side_um, (n_sites, 2))
        return [shapely.transform(shape(rng), lambda xy, position=position: xy + position) for position in positions]

    return make


def _lattice(rng, n_sites):
    """Return random rectangles with integer corners, which abut, overlap, coincide or leave gaps."""
    low = rng.integers(0, 14, (n_sites, 2))
    return [shapely.box(*a, *(a + size)) for a, size in zip(low, rng.integers(1, 6, (n_sites, 2)), strict=True)]


def _cut(rng, n_sites):
    """Return a square divided recursively along lattice lines, with some pieces omitted."""
    boxes = [(0, 0, 24, 24)]
    while len(boxes) < n_sites + 3:
        x0, y0, x1, y1 = box = boxes[int(rng.integers(len(boxes)))]
        is_across = bool(rng.integers(2)) if min(x1 - x0, y1 - y0) > 1 else x1 - x0 > 1
        if (x1 - x0 if is_across else y1 - y0) < 2:
            continue
        boxes.remove(box)
        cut = int(rng.integers(x0 + 1, x1) if is_across else rng.integers(y0 + 1, y1))
        boxes += [(x0, y0, cut, y1), (cut, y0, x1, y1)] if is_across else [(x0, y0, x1, cut), (x0, cut, x1, y1)]
    return [shapely.box(*boxes[k]) for k in rng.permutation(len(boxes))[:n_sites]]


def _bricks(rng, n_sites):
    """Return rows of bricks with random shifts, so that few corners coincide; some bricks are omitted."""
    n_rows = int(rng.integers(2, 6))
    height_um, shift_um = rng.integers(8, 17, n_rows) / 8, rng.integers(0, 24, n_rows) / 8
    floor_um = np.cumsum(height_um) - height_um
    bricks = [
        shapely.box(3.0 * k + shift, floor, 3.0 * k + 3.0 + shift, floor + height)
        for height, shift, floor in zip(height_um, shift_um, floor_um, strict=True)
        for k in range(max(2, n_sites // n_rows))
    ]
    return [brick for brick in bricks if rng.random() < 0.9] or bricks


def _rings(rng, n_sites):
    n_sectors = int(rng.integers(3, 9))
    rings = fs.layout.log_polar(
        n_sectors=n_sectors,
        r_min_um=3.0,
        r_max_um=14.0,
        n_rings=max(2, n_sites // n_sectors),
        stagger=bool(rng.integers(2)),
        chords_per_arc=int(rng.integers(1, 4)),
    )
    return list(rings.polygons())


def _hexagons(rng, n_sites):
    n_rows = int(rng.integers(2, 6))
    width_um = rng.choice([2.0, 1.8])
    return list(
        fs.layout.hexagonal(
            n_columns=max(2, n_sites // n_rows), n_rows=n_rows, pitch_um=2.0, width_um=width_um
        ).polygons()
    )


def _cells(rng, n_sites):
    cells = fs.layout.voronoi(n_sites=n_sites, size_um=(15.0, 12.0), n_iterations=2, seed=int(rng.integers(1000)))
    return list(cells.polygons())


def _move(rng, polygons):
    """Return polygons with up to three displaced vertices, in one or all sites at a vertex, if all remain valid."""
    for _ in range(int(rng.integers(0, 4))):
        k = int(rng.integers(len(polygons)))
        vertex = rng.choice(shapely.get_coordinates(polygons[k]))
        move = rng.uniform(-0.3, 0.3, 2) * math.sqrt(polygons[k].area)
        is_single = bool(rng.integers(2))

        def change(xy, vertex=vertex, move=move):
            return np.where((xy == vertex).all(axis=1, keepdims=True), xy + move, xy)

        moved = [
            shapely.transform(polygon, change) if i == k or not is_single else polygon
            for i, polygon in enumerate(polygons)
        ]
        if all(polygon.is_valid for polygon in moved):
            polygons = moved
    return polygons


#: Families of layouts by name; outlines can cross in those of ``CROSSING``.
CROSSING = {
    "stars": _scatter(_star),
    "hulls": _scatter(_hull),
    "tilted rectangles": _scatter(_tilted_rectangle),
    "rugged": _scatter(_rugged),
}
FAMILIES = {
    **CROSSING,
    "lattice": _lattice,
    "cut square": _cut,
    "bricks": _bricks,
    "rings": _rings,
    "hexagons": _hexagons,
    "cells": _cells,
}


@st.composite
def layouts(draw, *, turns=True):
    """Draw layouts of 5 to 30 sites with a column ``ring``; with ``turns``, half are rotated and far from the origin."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    family = draw(st.sampled_from(sorted(FAMILIES)))
    polygons = FAMILIES[family](rng, int(rng.integers(5, 31)))
    if family not in CROSSING:
        polygons = _move(rng, polygons)
    layout = fs.Layout.from_polygons(polygons, ring=rng.choice([0, 1, 2, 3, 5, 8], len(polygons)))
    is_rotated = rng.random() < 0.5
    return layout.rotate(rng.uniform(0, 360)).translate(*rng.uniform(-1e4, 1e4, 2)) if turns and is_rotated else layout
