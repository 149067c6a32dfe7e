"""
Measurements of packed rings, and identity of sites, vectorised over sites.

Rings are stored consecutively in ``xy_um`` (n_vertex, 2); ring r has the vertices ``ring_offsets[r] :
ring_offsets[r + 1]`` and site s the rings ``site_offsets[s] : site_offsets[s + 1]``. The first vertex is not repeated.
Outer rings are counter-clockwise and holes clockwise, so that the area of a site is the sum of signed ring areas.

Fixed patterns depend on the identity of a site (:func:`site_ids`), an integer of 64 bits: the column ``site_id``, or the
position of its centroid in units of 0.1 nm. Of non-overlapping sites that share a centroid, at most one contains it, for
example the disc among concentric rings. The identity of a site that surrounds its centroid without containing it (a ring, a C
shape) is therefore a hash of its outline: of the positions of all its vertices, in any order. Concentric rings are thus
distinct sites, and each has the same identity with or without the others.

An arc of up to 180 degrees, as in log-polar layouts with few sectors, does not contain its centroid either, but the centroid
of another site rarely coincides with it. The identity of an arc is its centroid, unless the layout contains such a coinciding
site; only then the identity of the arc changes when it is cropped out of the layout. Two sites with equal outlines have the
same identity, unless a column ``site_id`` distinguishes them.

Positions are discrete, so that no tolerance survives the rounding of all sites of a file: some centroids are near the limit
between two positions. Formats that round outlines therefore store the identities as the column ``site_id``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import Floats, Ints, as_numbers, read_only, unmasked
from foveasim.errors import ParameterError

#: Distances of sites that differ by less than this fraction are equal: rounding of coordinates of a few millimetres.
TIE_FRACTION = 1e-6

#: Turning angles (rad) below this may be rounding errors.
MIN_TURN_RAD = 1e-12
#: Ratio of the length of a sharp corner to its offset.
MITRE_LIMIT = 100.0
#: Moments of this number of vertices are computed by a kernel: the import of numba takes longer than those of fewer.
KERNEL_VERTICES = 1 << 14


def _check_offsets(name: str, offsets: ArrayLike, at_least: int, total: int, item_name: str) -> Ints:
    """Return offsets as int64 after checks of their range and smallest step."""
    array = np.asarray(unmasked(name, offsets))
    if array.ndim != 1 or array.size < 1 or array.dtype.kind not in "iu":
        raise ParameterError(name, "must be a list of integers", offsets)
    array = np.ascontiguousarray(array, np.int64)
    if array[0] != 0 or array[-1] != total:
        raise ParameterError(name, f"must begin at 0 and end at {total}, the number of {item_name}", array)
    small = np.flatnonzero(np.diff(array) < at_least)
    if small.size:
        raise ParameterError(
            name, f"must assign at least {at_least} {item_name} to each item, but item {small[0]} has fewer", array
        )
    return array


def check_packed(
    xy_um: ArrayLike, ring_offsets: ArrayLike, site_offsets: ArrayLike, *, min_vertices: int = 1, min_rings: int = 1
) -> tuple[Floats, Ints, Ints]:
    """Return packed rings as contiguous arrays after checks of shapes and sizes."""
    xy = as_numbers("xy_um", xy_um)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ParameterError("xy_um", f"must have the shape (n_vertex, 2), got {xy.shape}")
    rings = _check_offsets("ring_offsets", ring_offsets, min_vertices, xy.shape[0], "vertices")
    sites = _check_offsets("site_offsets", site_offsets, min_rings, rings.size - 1, "rings")
    return np.ascontiguousarray(xy), rings, sites


def next_vertex(ring_offsets: Ints) -> Ints:
    """Return the index of the next vertex in the ring of each vertex, (n_vertex,)."""
    after = np.arange(1, ring_offsets[-1] + 1)
    after[ring_offsets[1:] - 1] = ring_offsets[:-1]
    return after


def collapse_short_edges(xy: Floats, ring_offsets: Ints, shortest_um: float) -> tuple[Floats, Ints]:
    """
    Return packed rings without edges up to a length; their ends become one vertex.

    Vertices that rings share are equal before and after.
    """
    while True:
        after = next_vertex(ring_offsets)
        is_short = np.hypot(*(xy[after] - xy).T) <= shortest_um
        if not is_short.any():
            return xy, ring_offsets
        # Of the two ends of an edge, all rings keep the smaller one in the order of x, then y.
        points = np.ascontiguousarray(xy).view(np.complex128)[:, 0]
        ends = np.sort(np.stack((points[is_short], points[after[is_short]])), axis=0)
        larger, index = np.unique(ends[1], return_index=True)
        at = np.minimum(np.searchsorted(larger, points), larger.size - 1)
        points = np.where(larger[at] == points, ends[0][index][at], points)
        is_kept = points != points[after]
        ring_offsets = np.concatenate(([0], np.cumsum(is_kept)))[ring_offsets]
        xy = points[is_kept].view(np.float64).reshape(-1, 2)


def to_frame(xy: Floats, origin: ArrayLike, unit: ArrayLike) -> Floats:
    """
    Return ``(xy - origin) / unit`` of points (n, 2), with an origin and a unit per axis.

    Computed column by column: five times as fast as broadcasting over the last axis of length 2.
    """
    out = np.empty(xy.shape)
    for axis, (shift, scale) in enumerate(zip(*_pairs(origin, unit), strict=True)):
        np.subtract(xy[:, axis], shift, out=out[:, axis])
        out[:, axis] /= scale
    return out


def from_frame(xy: Floats, origin: ArrayLike, unit: ArrayLike) -> Floats:
    """Return ``xy * unit + origin`` of points (n, 2): the inverse of :func:`to_frame`."""
    out = np.empty(xy.shape)
    for axis, (shift, scale) in enumerate(zip(*_pairs(origin, unit), strict=True)):
        np.multiply(xy[:, axis], scale, out=out[:, axis])
        out[:, axis] += shift
    return out


def _pairs(origin: ArrayLike, unit: ArrayLike) -> tuple[Floats, Floats]:
    """Return origin and unit as arrays of shape (2,)."""
    return np.broadcast_to(np.asarray(origin, float), (2,)), np.broadcast_to(np.asarray(unit, float), (2,))


def positions_in_runs(lengths: Ints) -> Ints:
    """Return the concatenation of ``arange(n)`` for each run length, (sum of lengths,)."""
    return np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def select_sites(xy: Floats, ring_offsets: Ints, site_offsets: Ints, sites: Ints) -> tuple[Floats, Ints, Ints]:
    """Return the packed rings of some sites, in their order."""
    rings = _ranges(site_offsets[sites], site_offsets[sites + 1])
    vertices = _ranges(ring_offsets[rings], ring_offsets[rings + 1])
    of_rings, of_sites = np.diff(ring_offsets)[rings], np.diff(site_offsets)[sites]
    return xy[vertices], np.concatenate(([0], np.cumsum(of_rings))), np.concatenate(([0], np.cumsum(of_sites)))


def _ranges(starts: Ints, stops: Ints) -> Ints:
    """Return the concatenated indices of half-open ranges."""
    return np.repeat(starts, stops - starts) + positions_in_runs(stops - starts)


def polygons_of(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> NDArray[Any]:
    """Return sites as shapely polygons, (n_site,) array of objects."""
    n_vertices = np.diff(ring_offsets)
    # shapely requires the first vertex again at the end of a ring.
    ring_of = np.repeat(np.arange(n_vertices.size), n_vertices + 1)
    closed = xy_um[ring_offsets[:-1][ring_of] + positions_in_runs(n_vertices + 1) % n_vertices[ring_of]]
    closed[np.abs(closed) < np.finfo(np.float64).tiny] = 0.0  # GEOS misplaces intersections of denormal coordinates
    rings = shapely.linearrings(closed, indices=ring_of)
    sites = np.repeat(np.arange(site_offsets.size - 1), np.diff(site_offsets))
    return np.asarray(shapely.polygons(rings, indices=sites))


def shrink_polygons(polygons: NDArray[Any], margin_um: Floats | float) -> tuple[NDArray[Any], Ints]:
    """
    Return polygons that are offset inwards, with sharp corners.

    The second result contains the indices of those that vanish or split into parts.
    """
    shrunk = shapely.buffer(polygons, -np.asarray(margin_um), join_style="mitre", mitre_limit=MITRE_LIMIT)
    is_polygon = shapely.get_type_id(shrunk) == shapely.GeometryType.POLYGON
    return shrunk, np.flatnonzero(shapely.is_empty(shrunk) | ~is_polygon)


def _local_edges(xy_um: Floats, ring_offsets: Ints) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Return the end points of every edge: x, y, x_after, y_after.

    Coordinates are relative to the first vertex of the ring. Computed column by column, as in :func:`to_frame`.
    """
    lengths = np.diff(ring_offsets)
    x, y = (xy_um[:, axis] - np.repeat(xy_um[ring_offsets[:-1], axis], lengths) for axis in (0, 1))
    x_after, y_after = (np.append(column[1:], 0.0) for column in (x, y))
    for column in (x_after, y_after):
        column[ring_offsets[1:] - 1] = 0.0
    return x, y, x_after, y_after


def ring_moments(xy_um: Floats, ring_offsets: Ints) -> tuple[Floats, Floats]:
    """
    Return the signed area and the first moments of every ring.

    Returns ``area_um2`` (n_ring,) float64, µm²: shoelace formula; positive for counter-clockwise rings. ``moment_um3``
    (n_ring, 2) float64, µm³: integral of x and y over the ring: centroid times area.

    Computed relative to the first vertex of each ring, which avoids cancellation for small rings far from the origin.
    """
    if ring_offsets.size == 1:
        return np.zeros(0), np.zeros((0, 2))
    starts = ring_offsets[:-1]
    if xy_um.shape[0] >= KERNEL_VERTICES:
        from foveasim._core import _kernels

        area_um2, moment_um3 = np.empty(starts.size), np.empty((starts.size, 2))
        _kernels.ring_moments(np.ascontiguousarray(xy_um), np.ascontiguousarray(ring_offsets), area_um2, moment_um3)
        return area_um2, moment_um3
    x, y, x_after, y_after = _local_edges(xy_um, ring_offsets)
    cross = x * y_after - y * x_after
    area_um2 = 0.5 * np.add.reduceat(cross, starts)
    moments = np.empty(xy_um.shape)
    np.multiply(x + x_after, cross, out=moments[:, 0])
    np.multiply(y + y_after, cross, out=moments[:, 1])
    local_moment = np.add.reduceat(moments, starts, axis=0) / 6.0
    return area_um2, local_moment + xy_um[starts] * area_um2[:, np.newaxis]


def ring_area_um2(xy_um: Floats, ring_offsets: Ints) -> Floats:
    """Return the signed area of every ring, (n_ring,) µm², as :func:`ring_moments` does."""
    return 0.5 * _sum_of_cross_products(xy_um, ring_offsets, ring_offsets[:-1])


def ring_unsigned_area_um2(xy_um: Floats, ring_offsets: Ints) -> Floats:
    """
    Return the sum of the unsigned areas of the triangles with each ring's first vertex.

    The sum, (n_ring,), is 0 for collinear vertices.
    """
    return 0.5 * _sum_of_cross_products(xy_um, ring_offsets, ring_offsets[:-1], np.abs)


def _sum_of_cross_products(xy_um: Floats, ring_offsets: Ints, starts: Ints, of: Any = np.positive) -> Floats:
    """Return sums of a function of twice the signed areas of the triangles of each fan."""
    if starts.size == 0:
        return np.zeros(0)
    x, y, x_after, y_after = _local_edges(xy_um, ring_offsets)
    return np.asarray(np.add.reduceat(of(x * y_after - y * x_after), starts))


def convexity(xy_um: Floats, ring_offsets: Ints) -> NDArray[np.int8]:
    """
    Return the orientation of every strictly convex ring, (n_ring,) int8: 1 or -1.

    It is 1 for counter-clockwise rings, -1 for clockwise ones, and 0 for rings that are not strictly convex.
    A closed polyline whose turning angles have one sign and add up to a single revolution is convex, and so does not intersect
    itself. Turning angles below 1e-12 rad may be rounding errors: rings with such a vertex are not counted as convex.
    """
    if ring_offsets.size == 1:
        return np.zeros(0, np.int8)
    if xy_um.shape[0] >= KERNEL_VERTICES:
        from foveasim._core import _kernels

        sign = np.empty(ring_offsets.size - 1, np.int8)
        _kernels.convexity(np.ascontiguousarray(xy_um), np.ascontiguousarray(ring_offsets), MIN_TURN_RAD, sign)
        return sign
    starts, after = ring_offsets[:-1], next_vertex(ring_offsets)
    dx, dy = ((column[after] - column) for column in (xy_um[:, 0], xy_um[:, 1]))
    turn = dx * dy[after]
    turn -= dy * dx[after]
    square = dx * dx + dy * dy
    is_turn = turn * turn > MIN_TURN_RAD**2 * square * square[after]
    is_left, is_right = (np.logical_and.reduceat(is_turn & side, starts) for side in (turn > 0.0, turn < 0.0))
    is_upwards = (dy > 0.0) | ((dy == 0.0) & (dx > 0.0))
    n_rounds = np.add.reduceat((~is_upwards & is_upwards[after]).astype(np.int64), starts)
    return np.asarray((n_rounds == 1) * (is_left.astype(np.int8) - is_right), dtype=np.int8)


def same_rings(one: Any, other: Any) -> bool:
    """Return whether two objects have bit-identical packed rings in the same order."""
    if one is other:
        return True
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("site_offsets", "ring_offsets", "xy_um")]
    return all(a is b or np.array_equal(a, b) for a, b in pairs)


def site_moments(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> tuple[Floats, Floats]:
    """Return the area (n_site,) µm² and centroid (n_site, 2) µm of every site, without holes."""
    if site_offsets.size == 1:
        return np.zeros(0), np.zeros((0, 2))
    area_um2, moment_um3 = ring_moments(xy_um, ring_offsets)
    if ring_offsets.size > site_offsets.size:  # sites with several rings
        area_um2 = np.add.reduceat(area_um2, site_offsets[:-1])
        moment_um3 = np.add.reduceat(moment_um3, site_offsets[:-1], axis=0)
    return area_um2, moment_um3 / area_um2[:, np.newaxis]


def site_moments_about(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints, centre_um: Floats) -> Floats:
    """
    Return the moments of every site up to the second order, (n_site, 6).

    Area in µm², moments of x and y in µm³, of x², xy and y² in µm⁴, relative to a centre (n_site, 2) of each.
    """
    from foveasim._core import _kernels

    moments = np.empty((site_offsets.size - 1, _kernels.N_MOMENTS))
    rings = np.ascontiguousarray(xy_um), np.ascontiguousarray(ring_offsets), np.ascontiguousarray(site_offsets)
    _kernels.outline_moments(*rings, np.ascontiguousarray(centre_um), moments)
    return moments


def site_area_um2(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> Floats:
    """Return the area of every site without holes, (n_site,) µm², negative if clockwise."""
    return 0.5 * _sum_of_cross_products(xy_um, ring_offsets, ring_offsets[site_offsets[:-1]])


def site_bounds_um(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> Floats:
    """Return the bounds (x_min, y_min, x_max, y_max) of every site, (n_site, 4) µm."""
    if site_offsets.size == 1:
        return np.zeros((0, 4))
    starts = ring_offsets[site_offsets[:-1]]
    return np.concatenate((np.minimum.reduceat(xy_um, starts), np.maximum.reduceat(xy_um, starts)), axis=1)


# -- identity of sites ------------------------------------------------------------------------------------------------

#: Name of an integer column that identifies sites instead of their positions.
SITE_ID = "site_id"
#: Resolution of the centroids and vertices that identify sites.
POSITION_UM = 1e-4
#: Positions up to this number, 0.2 m, are packed into one integer, which is linear in both; others are hashed.
MAX_POSITION = 2**31
#: Unit vectors of eight rays, off the axes because the openings of C shapes are often on an axis.
_ANGLES_RAD = 2.0 * np.pi * np.arange(8) / 8.0 + 0.3
RAYS = read_only(np.stack((np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)), axis=1))
#: Minimum number of rays from the centroid that intersect a surrounding site; a thin arc of 180 degrees covers 245 of 360.
MIN_RAYS_AROUND = 6
#: Odd multipliers for an outline and for its coordinates (the first is 2**64 over the golden ratio).
_FACTORS = np.array([0x9E3779B97F4A7C15, 0x165667B19E3779F9], np.uint64)

_Words = NDArray[np.uint64]


def site_ids(layout: Any) -> Ints:
    """
    Return the identity of each site.

    ``layout``: packed rings, optionally with ``columns``. Returns ``ids`` (n_site,) int64: the column ``site_id``, or
    positions: equal numbers for equal sites of any layouts. Raises ParameterError when the column ``site_id`` does not contain
    integers.
    """
    from foveasim._core import _kernels

    columns: Any = getattr(layout, "columns", {})
    if SITE_ID in columns:
        ids = columns[SITE_ID]
        if ids.dtype.kind not in "iu":
            raise ParameterError(SITE_ID, f"must be a layout column of integers, got {ids.dtype}")
        return np.ascontiguousarray(ids).astype(np.int64)
    rings = layout.xy_um, layout.ring_offsets, layout.site_offsets
    _, centroid_um = site_moments(*rings)
    position = np.rint(centroid_um / POSITION_UM).astype(np.int64)
    found = _pack(position)
    n_intersecting = _kernels.count_ray_intersections(*rings, np.ascontiguousarray(centroid_um), RAYS)
    is_around = n_intersecting >= MIN_RAYS_AROUND
    if np.any((n_intersecting > 0) & ~is_around):
        _, which, n_here = np.unique(position, axis=0, return_inverse=True, return_counts=True)
        is_around |= (n_intersecting > 0) & (n_here[which.ravel()] > 1)
    around = np.flatnonzero(is_around)
    found[around] = _hash_outlines(*rings, around)
    return found


def _pack(position: Ints) -> Ints:
    """Return one integer per position, (n, 2), linear in x and y where possible."""
    x, y = position.T
    is_far = (np.abs(position) >= MAX_POSITION).any(axis=1)
    hashed = _hash(position).view(np.int64)
    return np.where(is_far, hashed, x + (y << 32))


def _hash_outlines(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints, sites: Ints) -> Ints:
    """Hash the outlines of sites, independent of the vertex order."""
    if not sites.size:
        return np.zeros(0, np.int64)
    begins, ends = ring_offsets[site_offsets[sites]], ring_offsets[site_offsets[sites + 1]]
    lengths = ends - begins
    vertices = np.repeat(begins, lengths) + positions_in_runs(lengths)
    position = np.rint(xy_um[vertices] / POSITION_UM).astype(np.int64)
    firsts = np.concatenate(([0], np.cumsum(lengths)[:-1]))
    return np.add.reduceat(_hash(position), firsts).view(np.int64)


def _hash(position: Ints) -> _Words:
    x, y = np.ascontiguousarray(position.T).view(np.uint64)
    return _mix(_mix(x * _FACTORS[0]) + y * _FACTORS[1])


def _mix(words: _Words) -> _Words:
    """Mix the bits of words: finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))
