"""Incrementally updated power diagrams: Voronoi diagrams with a weight for each centre."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats, Ints

__all__ = ["N_FAR", "PowerDiagram", "far_points_um"]

#: Points of the plane as x + i y, in µm: faster to gather than pairs.
Points: TypeAlias = NDArray[np.complex128]

#: Auxiliary points that bound the outer cells: further from each point of the region than any centre.
N_FAR, FAR_RADII = 8, 4.0
#: Reversal of an edge, relative to the circumradii at its ends, above which it is no longer rounding.
ROUNDING = 1e-11
#: Rounds of flips, and of partial displacements, after which the triangulation is computed from scratch.
MAX_FLIPS, MAX_MOVES = 60, 12
#: Smallest fraction of a displacement; points that cannot move by it do not move in this round.
SHORTEST_WAY = 0.01


def far_points_um(low_um: Floats, high_um: Floats) -> Floats:
    """Return auxiliary points (N_FAR, 2) on a circle around a box, relative to its centre."""
    turn = 2.0 * math.pi * (np.arange(N_FAR) + 0.5) / N_FAR
    return FAR_RADII * 0.5 * math.hypot(*(high_um - low_um)) * np.stack((np.cos(turn), np.sin(turn)), axis=1)


class PowerDiagram:
    """
    Edges of the power diagram of points in a box, updated incrementally.

    A point x belongs to the centre c of the least power ``|x - c|² - weight``. For equal weights this is the nearest
    centre, and the diagram is the Voronoi diagram. Three centres whose cells meet in a corner form a triangle of the regular
    triangulation (the Delaunay triangulation for equal weights), which is stored between updates.

    Parameters
    ----------
    low_um, high_um : (2,) float64, µm
        Corners of a box that contains all centres.

    Attributes
    ----------
    points_um : (n + N_FAR, 2) float64, µm
        The centres, then the auxiliary points around the box.
    corners_um : (n_corner, 2) float64, µm
        Points in which cells meet.
    sites : (n_edge, 2) int64
        The points on both sides of each edge, at least one of them a centre.
    ends : (n_edge, 2) int64
        First and last corner of each edge, counter-clockwise around the first of its two points.

    Notes
    -----
    The triangles are the lower hull of the points lifted to ``z = x² + y² - weight`` (Aurenhammer 1987). Updates flip
    the diagonals of pairs of triangles (Lawson 1977). If no triangle is inverted while its corners move, and all edges have
    the correct direction after the flips, the triangles are those of the hull. Otherwise the hull is computed again.
    """

    def __init__(self, low_um: Floats, high_um: Floats) -> None:
        self._middle_um = 0.5 * (low_um + high_um)
        self._far_um = far_points_um(low_um, high_um) + self._middle_um
        self._weights_um2 = np.zeros(0)
        self._triangles = self._beside = np.zeros((0, 3), np.int64)
        self.points_um = self.corners_um = np.zeros((0, 2))
        self.sites = self.ends = np.zeros((0, 2), np.int64)

    def follow(self, centres_um: Floats, weights_um2: Floats | None = None) -> bool:
        """
        Set the centres (n, 2) and weights (n,) of the diagram; weights are equal by default.

        Returns
        -------
        bool
            Whether every centre has a cell. If not, the diagram is unchanged.
        """
        points_um = np.concatenate((centres_um, self._far_um))
        weights = np.zeros(points_um.shape[0])
        if weights_um2 is not None:
            weights[:-N_FAR] = weights_um2 - weights_um2.min()
        found = None
        if self.points_um.shape == points_um.shape:
            found = _mended(_complex(self.points_um), _complex(points_um), weights, self._triangles, self._beside)
        if found is None:
            found = _lower_hull(points_um, weights, self._middle_um)
        if found is None:
            return False
        self._triangles, self._beside, corners = found
        self.points_um, self._weights_um2 = points_um, weights
        self.corners_um = _pairs(corners)
        self.sites, self.ends = _dual_edges(self._triangles, self._beside, centres_um.shape[0])
        return True

    def reach_um(self) -> Floats:
        """Return the distance (n,) of each centre from the furthest corner of its cell."""
        first = self._triangles[:, 0]
        to_corner = _complex(self.corners_um) - _complex(self.points_um)[first]
        power_um2 = to_corner.real**2 + to_corner.imag**2 - self._weights_um2[first]
        furthest_um2 = np.full(self.points_um.shape[0], -np.inf)
        np.maximum.at(furthest_um2, self._triangles.ravel(), np.repeat(power_um2, 3))
        return np.sqrt(np.maximum(furthest_um2 + self._weights_um2, 0.0))[:-N_FAR]


def _complex(xy_um: Floats) -> Points:
    return np.ascontiguousarray(xy_um).view(np.complex128)[:, 0]


def _pairs(points: Points) -> Floats:
    return points.view(np.float64).reshape(-1, 2)


def _cross(a: Points, b: Points) -> Floats:
    return a.real * b.imag - a.imag * b.real


def _lower_hull(points_um: Floats, weights_um2: Floats, middle_um: Floats) -> tuple[Ints, Ints, Points] | None:
    """
    Return the regular triangulation of points around a centre.

    The result contains the corners of the triangles, counter-clockwise, the triangle opposite each corner, and the power
    centres. It is None if a point has no cell, or float64 does not resolve the points.
    """
    from scipy.spatial import ConvexHull, QhullError

    offset_um = points_um - middle_um
    scale_um = np.abs(offset_um).max()
    height_um2 = (offset_um**2).sum(axis=1) - weights_um2
    try:
        hull = ConvexHull(np.column_stack((offset_um / scale_um, height_um2 / scale_um**2)))
    except QhullError:
        return None
    # The auxiliary points have equal heights: the upper faces between them are not part of the triangulation.
    is_lower = hull.equations[:, 2] < 0.0
    number = np.cumsum(is_lower) - 1
    triangles = hull.simplices[is_lower].astype(np.int64)
    beside = hull.neighbors[is_lower].astype(np.int64)
    beside = np.where(is_lower[beside], number[beside], -1)
    points = _complex(points_um)
    is_clockwise = _twice_area(points, triangles) < 0.0
    for sides in (triangles, beside):
        sides[is_clockwise, 1:] = sides[is_clockwise, :0:-1]
    if np.unique(triangles).size < points.size or not (_twice_area(points, triangles) > 0.0).all():
        return None
    return triangles, beside, _power_centres(points, weights_um2, triangles)


def _mended(
    old: Points, new: Points, weights_um2: Floats, triangles: Ints, beside: Ints
) -> tuple[Ints, Ints, Points] | None:
    """Update the triangles of moved points; None if they must be computed from scratch."""
    triangles, beside = triangles.copy(), beside.copy()
    centres = np.empty(triangles.shape[0], np.complex128)
    moved = np.arange(triangles.shape[0])
    for _ in range(MAX_MOVES):
        points = _unturned(old, new, triangles[moved])
        if not _made_regular(points, weights_um2, triangles, beside, centres, moved):
            return None
        is_late = points != new
        if not is_late.any():
            return triangles, beside, centres
        first, second, third = triangles.T
        old, moved = points, np.flatnonzero(is_late[first] | is_late[second] | is_late[third])
    return None


def _unturned(old: Points, new: Points, triangles: Ints) -> Points:
    """Return the new points, with displacements shortened such that no triangle is inverted."""
    points = new
    way = np.ones(new.size)
    while True:
        is_turned = ~(_twice_area(points, triangles) > 0.0)
        if not is_turned.any():
            return points
        late = np.unique(triangles[is_turned])
        way[late] = np.where(way[late] > SHORTEST_WAY, 0.5 * way[late], 0.0)
        points = points.copy()
        points[late] = old[late] + way[late] * (new[late] - old[late])


def _made_regular(
    points: Points, weights_um2: Floats, triangles: Ints, beside: Ints, centres: Points, changed: Ints
) -> bool:
    """Flip edges in place until all triangles are regular; return whether this succeeded."""
    for _ in range(MAX_FLIPS):
        centres[changed] = _power_centres(points, weights_um2, triangles[changed])
        t, k = _wrong_edges(points, triangles, beside, centres, changed)
        if t.size == 0:
            return True
        # The next round needs only the edges of triangles that change now, and the deferred ones.
        changed = np.unique(np.concatenate((t, beside[t, k])))
        if not _flip(points, triangles, beside, t, k):
            return False
    return False


def _flip(points: Points, triangles: Ints, beside: Ints, t: Ints, k: Ints) -> bool:
    """
    Flip the common edge of triangles t and their neighbours opposite corners k, in place.

    Only pairs with a convex outline are flipped, and of pairs that change the same triangle only one. The result is whether
    any pair was flipped.

    ::

             c                c
            ╱ ╲              ╱│╲
           ╱ t ╲            ╱ │ ╲
          a ─── b    ->    a t│u b
           ╲ u ╱            ╲ │ ╱
            ╲ ╱              ╲│╱
             d                d
    """
    u = beside[t, k]
    m = (beside[u] == t[:, np.newaxis]).argmax(axis=1)
    a, b, c, d = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3], triangles[t, k], triangles[u, m]
    beside_bc, beside_ca = beside[t, (k + 1) % 3], beside[t, (k + 2) % 3]
    beside_ad, beside_db = beside[u, (m + 1) % 3], beside[u, (m + 2) % 3]
    new_t, new_u = np.stack((c, a, d), axis=1), np.stack((d, b, c), axis=1)
    is_chosen = (_twice_area(points, new_t) > 0.0) & (_twice_area(points, new_u) > 0.0)
    changes = np.stack((t, u, beside_ad, beside_db, beside_bc, beside_ca), axis=1)
    is_chosen[is_chosen] = _are_apart(changes[is_chosen], triangles.shape[0])
    t, u, beside_ad, beside_db, beside_bc, beside_ca = changes[is_chosen].T
    triangles[t], triangles[u] = new_t[is_chosen], new_u[is_chosen]
    beside[t] = np.stack((beside_ad, u, beside_ca), axis=1)
    beside[u] = np.stack((beside_bc, t, beside_db), axis=1)
    for outer, before, after in ((beside_ad, u, t), (beside_bc, t, u)):
        i = np.flatnonzero(outer >= 0)
        side = (beside[outer[i]] == before[i, np.newaxis]).argmax(axis=1)
        beside[outer[i], side] = after[i]
    return bool(is_chosen.any())


def _are_apart(changes: Ints, n_triangles: int) -> Bools:
    """Select rows (n, 6) that share no triangle (-1: none), the last row included."""
    number = np.arange(changes.shape[0])[:, np.newaxis]
    # Each row writes its index to all its triangles; the last one written wins.
    claimed = np.full(n_triangles + 1, -1)
    claimed[changes.ravel()] = np.repeat(number, changes.shape[1])
    return np.asarray(((claimed[changes] == number) | (changes < 0)).all(axis=1))


def _wrong_edges(points: Points, triangles: Ints, beside: Ints, centres: Points, some: Ints) -> tuple[Ints, Ints]:
    """Find edges whose power centres are in the wrong order: triangle and opposite corner."""
    is_some = np.zeros(triangles.shape[0], bool)
    is_some[some] = True
    wrong_t, wrong_k = [], []
    for k in range(3):
        u = beside[some, k]
        is_first = (u > some) | ((u >= 0) & ~is_some[u])
        t, u = some[is_first], u[is_first]
        a = points[triangles[t, (k + 1) % 3]]
        along = points[triangles[t, (k + 2) % 3]] - a
        to_t, to_u = centres[t] - a, centres[u] - a
        # The power centre of t is to the left of the edge from a, that of u to the right.
        size = np.abs(along)
        is_wrong = _cross(along, to_t - to_u) < -ROUNDING * size * (size + np.abs(to_t) + np.abs(to_u))
        wrong_t.append(t[is_wrong])
        wrong_k.append(np.full(int(is_wrong.sum()), k))
    return np.concatenate(wrong_t), np.concatenate(wrong_k)


def _twice_area(points: Points, triangles: Ints) -> Floats:
    a = points[triangles[:, 0]]
    return _cross(points[triangles[:, 1]] - a, points[triangles[:, 2]] - a)


def _power_centres(points: Points, weights_um2: Floats, triangles: Ints) -> Points:
    """Return the points (n_triangle,) of equal power from the three corners of each triangle."""
    first, second, third = triangles.T
    a, weight = points[first], weights_um2[first]
    b, c = points[second] - a, points[third] - a
    of_b = b.real**2 + b.imag**2 + (weight - weights_um2[second])
    of_c = c.real**2 + c.imag**2 + (weight - weights_um2[third])
    return a + (of_c * b - of_b * c) * (0.5j / _cross(b, c))


def _dual_edges(triangles: Ints, beside: Ints, n_centres: int) -> tuple[Ints, Ints]:
    """Return the points on both sides of each edge, and its corners around the first point."""
    t, k = np.nonzero(beside > np.arange(triangles.shape[0])[:, np.newaxis])
    sites = np.stack((triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]), axis=1)
    ends = np.stack((beside[t, k], t), axis=1)
    is_ours = np.minimum(sites[:, 0], sites[:, 1]) < n_centres
    return (sites, ends) if is_ours.all() else (sites[is_ours], ends[is_ours])
