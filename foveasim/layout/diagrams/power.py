"""Incrementally updated power diagrams: Voronoi diagrams with a weight for each centre."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats, Ints

__all__ = ["N_AUXILIARY", "PowerDiagram", "auxiliary_points_um"]

#: Points of the plane as x + i y, in µm: faster to gather than pairs.
Points: TypeAlias = NDArray[np.complex128]

#: Auxiliary points that bound the outer cells: further from each point of the region than any centre.
N_AUXILIARY, AUXILIARY_RADII = 8, 4.0
#: Reversal of an edge, relative to the circumradii at its ends, above which it is no longer rounding.
ROUNDING = 1e-11
#: Rounds of flips, and of partial displacements, after which the triangulation is computed from scratch.
MAX_FLIPS, MAX_MOVES = 60, 12
#: Smallest fraction of a displacement; points that cannot move by it do not move in this round.
MIN_MOVE_FRACTION = 0.01


def auxiliary_points_um(low_um: Floats, high_um: Floats) -> Floats:
    """Return auxiliary points (N_AUXILIARY, 2) on a circle around a box."""
    angle_rad = 2.0 * math.pi * (np.arange(N_AUXILIARY) + 0.5) / N_AUXILIARY
    return (
        AUXILIARY_RADII
        * 0.5
        * math.hypot(*(high_um - low_um))
        * np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1)
    )


class PowerDiagram:
    """
    Edges of the power diagram of points in a box, updated incrementally.

    A point x belongs to the centre c of the least power ``|x - c|² - weight``. For equal weights this is the nearest
    centre, and the diagram is the Voronoi diagram. Three centres whose cells meet in a corner form a triangle of the regular
    triangulation (the Delaunay triangulation for equal weights), which is stored between updates.

    ``low_um``, ``high_um`` (2,): corners of a box that contains all centres. ``points_um`` (n + N_AUXILIARY, 2): the centres,
    then the auxiliary points around the box. ``corners_um`` (n_corner, 2): points in which cells meet. ``sites`` (n_edge, 2):
    the points on both sides of each edge, at least one of them a centre. ``ends`` (n_edge, 2): first and last corner of each
    edge, counter-clockwise around the first of its two points.

    The triangles are the lower hull of the points lifted to ``z = x² + y² - weight`` (Aurenhammer 1987). Updates flip
    the diagonals of pairs of triangles (Lawson 1977). If no triangle is inverted while its corners move, and all edges have
    the correct direction after the flips, the triangles are those of the hull. Otherwise the hull is computed again.
    """

    def __init__(self, low_um: Floats, high_um: Floats) -> None:
        self._centre_um = 0.5 * (low_um + high_um)
        self._auxiliary_um = auxiliary_points_um(low_um, high_um) + self._centre_um
        self._weights_um2 = np.zeros(0)
        self._triangles = self._neighbours = np.zeros((0, 3), np.int64)
        self.points_um: Floats = np.zeros((0, 2))
        self.corners_um: Floats = np.zeros((0, 2))
        self.sites: Ints = np.zeros((0, 2), np.int64)
        self.ends: Ints = np.zeros((0, 2), np.int64)

    def update(self, centres_um: Floats, weights_um2: Floats | None = None) -> bool:
        """
        Set the centres (n, 2) and weights (n,) of the diagram; weights are equal by default.

        Returns whether every centre has a cell. If not, the diagram is unchanged.
        """
        points_um = np.concatenate((centres_um, self._auxiliary_um))
        weights = np.zeros(points_um.shape[0])
        if weights_um2 is not None:
            weights[:-N_AUXILIARY] = weights_um2 - weights_um2.min()
        found = None
        if self.points_um.shape == points_um.shape:
            found = _update_triangles(
                _as_complex(self.points_um), _as_complex(points_um), weights, self._triangles, self._neighbours
            )
        if found is None:
            found = _lower_hull(points_um, weights, self._centre_um)
        if found is None:
            return False
        self._triangles, self._neighbours, corners = found
        self.points_um, self._weights_um2 = points_um, weights
        self.corners_um = _as_xy(corners)
        self.sites, self.ends = _dual_edges(self._triangles, self._neighbours, centres_um.shape[0])
        return True

    def reach_um(self) -> Floats:
        """Return the distance (n,) of each centre from the furthest corner of its cell."""
        first = self._triangles[:, 0]
        to_corner = _as_complex(self.corners_um) - _as_complex(self.points_um)[first]
        power_um2 = to_corner.real**2 + to_corner.imag**2 - self._weights_um2[first]
        furthest_um2 = np.full(self.points_um.shape[0], -np.inf)
        np.maximum.at(furthest_um2, self._triangles.ravel(), np.repeat(power_um2, 3))
        return np.sqrt(np.maximum(furthest_um2 + self._weights_um2, 0.0))[:-N_AUXILIARY]


def _as_complex(xy_um: Floats) -> Points:
    return np.ascontiguousarray(xy_um).view(np.complex128)[:, 0]


def _as_xy(points: Points) -> Floats:
    return points.view(np.float64).reshape(-1, 2)


def _cross(a: Points, b: Points) -> Floats:
    return a.real * b.imag - a.imag * b.real


def _lower_hull(points_um: Floats, weights_um2: Floats, centre_um: Floats) -> tuple[Ints, Ints, Points] | None:
    """
    Return the regular triangulation of points around a centre.

    The result contains the corners of the triangles, counter-clockwise, the triangle opposite each corner, and the power
    centres. It is None if a point has no cell, or float64 does not resolve the points.
    """
    from scipy.spatial import ConvexHull, QhullError

    offset_um = points_um - centre_um
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
    neighbours = hull.neighbors[is_lower].astype(np.int64)
    neighbours = np.where(is_lower[neighbours], number[neighbours], -1)
    points = _as_complex(points_um)
    is_clockwise = _twice_area(points, triangles) < 0.0
    for sides in (triangles, neighbours):
        sides[is_clockwise, 1:] = sides[is_clockwise, :0:-1]
    if np.unique(triangles).size < points.size or not (_twice_area(points, triangles) > 0.0).all():
        return None
    return triangles, neighbours, _power_centres(points, weights_um2, triangles)


def _update_triangles(
    old: Points, new: Points, weights_um2: Floats, triangles: Ints, neighbours: Ints
) -> tuple[Ints, Ints, Points] | None:
    """Update the triangles of moved points; None if they must be computed from scratch."""
    triangles, neighbours = triangles.copy(), neighbours.copy()
    centres = np.empty(triangles.shape[0], np.complex128)
    moved = np.arange(triangles.shape[0])
    for _ in range(MAX_MOVES):
        points = _limit_displacements(old, new, triangles[moved])
        if not _flip_until_regular(points, weights_um2, triangles, neighbours, centres, moved):
            return None
        is_pending = points != new
        if not is_pending.any():
            return triangles, neighbours, centres
        first, second, third = triangles.T
        old, moved = points, np.flatnonzero(is_pending[first] | is_pending[second] | is_pending[third])
    return None


def _limit_displacements(old: Points, new: Points, triangles: Ints) -> Points:
    """Return the new points, with displacements shortened such that no triangle is inverted."""
    points = new
    fraction = np.ones(new.size)
    while True:
        is_inverted = ~(_twice_area(points, triangles) > 0.0)
        if not is_inverted.any():
            return points
        blocked = np.unique(triangles[is_inverted])
        fraction[blocked] = np.where(fraction[blocked] > MIN_MOVE_FRACTION, 0.5 * fraction[blocked], 0.0)
        points = points.copy()
        points[blocked] = old[blocked] + fraction[blocked] * (new[blocked] - old[blocked])


def _flip_until_regular(
    points: Points, weights_um2: Floats, triangles: Ints, neighbours: Ints, centres: Points, changed: Ints
) -> bool:
    """Flip edges in place until all triangles are regular; return whether this succeeded."""
    for _ in range(MAX_FLIPS):
        centres[changed] = _power_centres(points, weights_um2, triangles[changed])
        t, k = _wrong_edges(points, triangles, neighbours, centres, changed)
        if t.size == 0:
            return True
        # The next round needs only the edges of triangles that change now, and the deferred ones.
        changed = np.unique(np.concatenate((t, neighbours[t, k])))
        if not _flip(points, triangles, neighbours, t, k):
            return False
    return False


def _flip(points: Points, triangles: Ints, neighbours: Ints, t: Ints, k: Ints) -> bool:
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
    u = neighbours[t, k]
    m = (neighbours[u] == t[:, np.newaxis]).argmax(axis=1)
    a, b, c, d = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3], triangles[t, k], triangles[u, m]
    neighbour_bc, neighbour_ca = neighbours[t, (k + 1) % 3], neighbours[t, (k + 2) % 3]
    neighbour_ad, neighbour_db = neighbours[u, (m + 1) % 3], neighbours[u, (m + 2) % 3]
    new_t, new_u = np.stack((c, a, d), axis=1), np.stack((d, b, c), axis=1)
    is_chosen = (_twice_area(points, new_t) > 0.0) & (_twice_area(points, new_u) > 0.0)
    changes = np.stack((t, u, neighbour_ad, neighbour_db, neighbour_bc, neighbour_ca), axis=1)
    is_chosen[is_chosen] = _select_independent(changes[is_chosen], triangles.shape[0])
    t, u, neighbour_ad, neighbour_db, neighbour_bc, neighbour_ca = changes[is_chosen].T
    triangles[t], triangles[u] = new_t[is_chosen], new_u[is_chosen]
    neighbours[t] = np.stack((neighbour_ad, u, neighbour_ca), axis=1)
    neighbours[u] = np.stack((neighbour_bc, t, neighbour_db), axis=1)
    for outer, before, after in ((neighbour_ad, u, t), (neighbour_bc, t, u)):
        i = np.flatnonzero(outer >= 0)
        side = (neighbours[outer[i]] == before[i, np.newaxis]).argmax(axis=1)
        neighbours[outer[i], side] = after[i]
    return bool(is_chosen.any())


def _select_independent(changes: Ints, n_triangles: int) -> Bools:
    """Select rows (n, 6) that share no triangle (-1: none), the last row included."""
    number = np.arange(changes.shape[0])[:, np.newaxis]
    # Each row writes its index to all its triangles; the last one written wins.
    claimed = np.full(n_triangles + 1, -1)
    claimed[changes.ravel()] = np.repeat(number, changes.shape[1])
    return np.asarray(((claimed[changes] == number) | (changes < 0)).all(axis=1))


def _wrong_edges(points: Points, triangles: Ints, neighbours: Ints, centres: Points, subset: Ints) -> tuple[Ints, Ints]:
    """Find edges whose power centres are in the wrong order: triangle and opposite corner."""
    is_in_subset = np.zeros(triangles.shape[0], bool)
    is_in_subset[subset] = True
    wrong_t, wrong_k = [], []
    for k in range(3):
        u = neighbours[subset, k]
        is_first = (u > subset) | ((u >= 0) & ~is_in_subset[u])
        t, u = subset[is_first], u[is_first]
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


def _dual_edges(triangles: Ints, neighbours: Ints, n_centres: int) -> tuple[Ints, Ints]:
    """Return the points on both sides of each edge, and its corners around the first point."""
    t, k = np.nonzero(neighbours > np.arange(triangles.shape[0])[:, np.newaxis])
    sites = np.stack((triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]), axis=1)
    ends = np.stack((neighbours[t, k], t), axis=1)
    has_centre = np.minimum(sites[:, 0], sites[:, 1]) < n_centres
    return (sites, ends) if has_centre.all() else (sites[has_centre], ends[has_centre])
