"""
Outlines of paths and circles of GDSII and OASIS files.

The module imports no other module of the package: the sandbox process loads it.

An arc is a polygon of the area of the disc or half disc: its vertices lie slightly outside the circle, and the middles of its
edges inside. Edges of a disc, not vertices, lie in the directions of multiples of 30°, so that discs that touch in a square or
hexagonal lattice do not overlap.

Corners of paths are those of KLayout: both sides are extended to their intersection, but at most by half of the width beyond
the vertex. Corners of more than 90° are therefore cut off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

#: Coordinates of a point or a vector.
Point: TypeAlias = tuple[float, float]
#: Largest distance between a circle and its outline, in radii, by default.
CIRCLE_TOLERANCE = 1e-3
#: Vertices of a disc are a multiple of this number.
STEPS = 12
#: Lengths that differ by less than this fraction of the width are equal.
SAME = 1e-9


def n_vertices_of_disc(tolerance: float) -> int:
    """Return the number of vertices of a disc for a largest distance from the circle, radii."""
    # That of the vertices, larger than that of the edges, is the square of the angle between two of them over 12.
    return STEPS * max(1, math.ceil(2.0 * math.pi / math.sqrt(12.0 * tolerance) / STEPS))


def disc(centre: NDArray[np.float64], radius: float, n: int) -> NDArray[np.float64]:
    """Return the outline of a disc, (n, 2)."""
    step = 2.0 * math.pi / n
    angle = step * (np.arange(n) + 0.5)
    distance = radius * math.sqrt(step / math.sin(step))
    return centre + distance * np.stack((np.cos(angle), np.sin(angle)), axis=1)


def path_outline(spine: NDArray[np.float64], half: float, ends: Point | None, n: int) -> NDArray[np.float64]:
    """
    Return the outline of a path, (m, 2).

    ``spine``: (k, 2) with at least one vertex. ``half``: half of the width; 0 gives an outline without area. ``ends``: lengths
    by which a path is longer than its spine at its start and its end; None for round ends. ``n``: vertices of a disc. A path of
    a single point is a disc, or a rectangle along x.
    """
    points = _distinct([(x, y) for x, y in spine.tolist()])
    if ends is None and len(points) == 1:
        return disc(np.array(points[0]), half, n)
    start, end = ends or (0.0, 0.0)
    cap = _cap(half, n // 2) if ends is None else ()
    outline = [
        *_side(points, half, (start, end), (1.0, 0.0)),
        *_placed(cap, points[-1], _direction(points[-2], points[-1]) if cap else (1.0, 0.0)),
        *_side(points[::-1], half, (end, start), (-1.0, 0.0)),
        *_placed(cap, points[0], _direction(points[1], points[0]) if cap else (1.0, 0.0)),
    ]
    return np.array(outline)


def _distinct(points: list[Point]) -> list[Point]:
    """Return the vertices without repeated ones, and without those on a straight line."""
    found = points[:1]
    for point in points[1:]:
        if point == found[-1]:
            continue
        if len(found) > 1:
            (ax, ay), (bx, by) = _direction(found[-2], found[-1]), _direction(found[-1], point)
            if ax * bx + ay * by > 0.0 and abs(ax * by - ay * bx) < SAME:
                found.pop()
        found.append(point)
    return found


def _direction(a: Point, b: Point) -> Point:
    length = math.hypot(b[0] - a[0], b[1] - a[1])
    return (b[0] - a[0]) / length, (b[1] - a[1]) / length


def _side(points: list[Point], half: float, ends: Point, single: Point) -> list[Point]:
    """Return the left side of a path; one of a single point goes in the direction ``single``."""
    directions = [_direction(a, b) for a, b in pairwise(points)] or [single]
    start, end = ends
    (dx, dy), (x, y) = directions[0], points[0]
    side = [(x - half * dy - start * dx, y + half * dx - start * dy)]
    for k, (bx, by) in enumerate(directions[1:], 1):
        (ax, ay), (x, y) = directions[k - 1], points[k]
        cosine, sine = ax * bx + ay * by, ax * by - ay * bx
        # How far beyond the vertex both sides intersect, negative at an inner corner.
        beyond = -half * sine / (1.0 + cosine) if cosine > SAME - 1.0 else math.inf
        if beyond > half * (1.0 + SAME):
            side += [
                (x - half * ay + half * ax, y + half * ax + half * ay),
                (x - half * by - half * bx, y + half * bx - half * by),
            ]
        elif -beyond <= half + min(math.dist(points[k - 1], points[k]), math.dist(points[k], points[k + 1])):
            side.append((x - half * ay + beyond * ax, y + half * ax + beyond * ay))
        else:
            side += [(x - half * ay, y + half * ax), (x, y), (x - half * by, y + half * bx)]
    (dx, dy), (x, y) = directions[-1], points[-1]
    return [*side, (x - half * dy + end * dx, y + half * dx + end * dy)]


def _cap(half: float, n: int) -> list[Point]:
    """
    Return the vertices of a half disc between its ends, in the direction (1, 0).

    They begin at the left. The ends are on the circle; the distance of the others gives the area of the half disc.
    """
    step = math.pi / n
    # sin(step) * (2 * half * distance + (n - 2) * distance**2) = pi * half**2
    distance = half * (math.sqrt(1.0 + (n - 2) * math.pi / math.sin(step)) - 1.0) / (n - 2)
    return [(distance * math.sin(k * step), distance * math.cos(k * step)) for k in range(1, n)]


def _placed(cap: Sequence[Point], at: Point, direction: Point) -> list[Point]:
    (x, y), (dx, dy) = at, direction
    return [(x + u * dx - v * dy, y + u * dy + v * dx) for u, v in cap]
