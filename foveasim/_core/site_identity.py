"""
Identity of the photosites of a layout, on which fixed patterns depend.

The identity of a site is an integer of 64 bits: the column ``site_id``, or the position of its centroid in units of 0.1 nm. Of
non-overlapping sites that share a centroid, at most one contains it, for example the disc among concentric rings. The identity
of a site that surrounds its centroid without containing it (a ring, a C shape) is therefore a hash of its outline: of the
positions of all its vertices, in any order. Concentric rings are thus distinct sites, and each has the same identity with or
without the others.

An arc of up to 180 degrees, as in log-polar layouts with few sectors, does not contain its centroid either, but the centroid of
another site rarely coincides with it. The identity of an arc is its centroid, unless the layout contains such a coinciding
site; only then the identity of the arc changes when it is cropped out of the layout. Two sites with equal outlines have the
same identity, unless a column ``site_id`` distinguishes them.

Positions are discrete, so that no tolerance survives the rounding of all sites of a file: some centroids are near the limit
between two positions. Formats that round outlines therefore store the identities as the column ``site_id``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import positions_in_runs, site_moments
from foveasim._core.validation import Floats, Ints, read_only
from foveasim.errors import ParameterError

__all__ = ["SITE_ID", "site_ids"]

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

    Parameters
    ----------
    layout : packed rings, optionally with ``columns``

    Returns
    -------
    ids : (n_site,) int64
        The column ``site_id``, or positions: equal numbers for equal sites of any layouts.

    Raises
    ------
    ParameterError
        When the column ``site_id`` does not contain integers.
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
