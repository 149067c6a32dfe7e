"""Numba kernels of GDSII and OASIS files: records, congruent sites, regular arrays."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLAGS, INTS, INTS_2D, array_of

_bytes = array_of(types.uint8)


@njit(types.UniTuple(types.int64, 2)(_bytes, FLAGS, types.int64))
def walk_records(data, is_known, last):
    """
    Follow the records up to type ``last``, an invalid record, or the end of the data.

    Returns ``at``: final position, behind the last record; beyond the data if that record is incomplete. ``record``: type of
    the last record, with its data type; -1 if no valid record begins at ``at``.
    """
    at, record = 0, 0
    while at + 4 <= data.size and record != last:
        length = np.int64(data[at]) << 8 | np.int64(data[at + 1])
        record = np.int64(data[at + 2]) << 8 | np.int64(data[at + 3])
        if length < 4 or length & 1 or not is_known[record]:
            return at, -1
        at += length
    return at, record


@njit(types.Array(types.boolean, 1, "C")(INTS_2D, INTS, types.int64))
def progressions(rows, group, at_most):
    """
    Divide rows into arithmetic progressions.

    Successive rows of a progression have a constant difference, and are in the same group.

    ``rows``: (n, k) int64. ``group`` (n,) int64: rows of different groups are in different progressions. ``at_most``: maximum
    length of a progression. Returns ``is_first`` (n,) bool: whether a row is the first of its progression.
    """
    n, k = rows.shape
    is_first = np.zeros(n, np.bool_)
    start = 0
    while start < n:
        is_first[start] = True
        stop = start + 1
        while stop < n and stop - start < at_most and group[stop] == group[start]:
            if stop > start + 1:
                is_regular = True
                for c in range(k):
                    if rows[stop, c] - rows[stop - 1, c] != rows[start + 1, c] - rows[start, c]:
                        is_regular = False
                        break
                if not is_regular:
                    break
            stop += 1
        start = stop
    return is_first


#: Odd multipliers of the hash of an outline: of the position of a vertex, x, y and the ring (splitmix64 and the golden ratio).
_MIX = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
    np.uint64(0xD6E8FEB86659FD93),
)
_29 = np.uint64(29)


@njit(types.Tuple((types.Array(types.uint64, 1, "C"), types.Array(types.int64, 2, "C")))(INTS_2D, INTS, INTS))
def outline_hashes(xy, ring_offsets, site_offsets):
    """
    Return a hash of each outline that does not depend on its position, and its origin.

    ``xy``: (n_vertex, 2) int64. Returns ``hashes`` (n_site,) uint64: sums modulo 2^64 over the vertices. ``origin`` (n_site, 2)
    int64: the lower left corner of the bounding box.
    """
    n_sites = site_offsets.size - 1
    hashes = np.zeros(n_sites, np.uint64)
    origin = np.empty((n_sites, 2), np.int64)
    for site in range(n_sites):
        first_ring, last_ring = site_offsets[site], site_offsets[site + 1]
        start, stop = ring_offsets[first_ring], ring_offsets[last_ring]
        x_min, y_min = xy[start, 0], xy[start, 1]
        for v in range(start + 1, stop):
            x_min, y_min = min(x_min, xy[v, 0]), min(y_min, xy[v, 1])
        origin[site] = x_min, y_min
        total = np.uint64(0)
        for ring in range(first_ring, last_ring):
            for v in range(ring_offsets[ring], ring_offsets[ring + 1]):
                mixed = np.uint64(v - start + 1) * _MIX[0]
                mixed = (mixed ^ np.uint64(xy[v, 0] - x_min)) * _MIX[1]
                mixed ^= mixed >> _29
                mixed = (mixed ^ np.uint64(xy[v, 1] - y_min)) * _MIX[2]
                mixed ^= mixed >> _29
                mixed = (mixed ^ np.uint64(ring - first_ring)) * _MIX[3]
                mixed ^= mixed >> _29
                total += mixed
        hashes[site] = total
    return hashes, origin


@njit(types.Array(types.boolean, 1, "C")(INTS_2D, INTS, INTS, INTS_2D, INTS))
def are_congruent(xy, ring_offsets, site_offsets, origin, model):
    """
    Return whether each site is a translated copy of its model, vertex by vertex.

    Returns (n_site,) bool. ``xy``: (n_vertex, 2) int64. ``origin``: (n_site, 2) int64. ``model``: (n_site,) int64, sites.
    """
    found = np.zeros(model.size, np.bool_)
    for site in range(model.size):
        other = model[site]
        ring, twin = site_offsets[site], site_offsets[other]
        n_rings = site_offsets[site + 1] - ring
        is_equal = n_rings == site_offsets[other + 1] - twin
        start, shift = ring_offsets[ring], ring_offsets[twin] - ring_offsets[ring]
        if is_equal:
            for k in range(1, n_rings + 1):
                is_equal = is_equal and ring_offsets[ring + k] + shift == ring_offsets[twin + k]
        if is_equal:
            dx, dy = origin[other, 0] - origin[site, 0], origin[other, 1] - origin[site, 1]
            for v in range(start, ring_offsets[ring + n_rings]):
                if xy[v, 0] + dx != xy[v + shift, 0] or xy[v, 1] + dy != xy[v + shift, 1]:
                    is_equal = False
                    break
        found[site] = is_equal
    return found
