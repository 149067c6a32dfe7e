"""
Fixed patterns of a device: random numbers per site that do not change between frames.

A counter-based generator computes each number from the seed of the device, the name of the effect and the identity of the site
(or the number of its readout line). Crops of a layout, permutations of its sites, other frames and other numbers of workers
therefore give the same device.

The identity of a site is its centroid. Of non-overlapping sites that share a centroid, at most one contains it, for example the
disc among concentric rings. The identity of a site that surrounds its centroid without containing it (a ring, a C shape) is
therefore its outline: the positions of all its vertices, in any order. Concentric rings are thus distinct sites, and each has
the same numbers with or without the others.

An arc of up to 180 degrees, as in log-polar layouts with few sectors, does not contain its centroid either, but the centroid of
another site rarely coincides with it. The identity of an arc is its centroid, unless the layout contains such a coinciding
site; only then the numbers of the arc change when it is cropped out of the layout. Two sites with equal outlines have the same
numbers, unless a column ``site_id`` distinguishes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from foveasim._core.random_streams import fixed_pattern_key
from foveasim._core.rings import positions_in_runs, site_moments
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, read_only
from foveasim.errors import ParameterError
from foveasim.fields import PackedRings

__all__ = ["SITE_ID", "Device"]

#: Name of an integer column that identifies sites instead of their positions.
SITE_ID = "site_id"
#: Resolution of the centroids and vertices that identify sites.
POSITION_UM = 1e-4
#: Unit vectors of eight rays, off the axes because the openings of C shapes are often on an axis.
_ANGLES_RAD = 2.0 * np.pi * np.arange(8) / 8.0 + 0.3
RAYS = read_only(np.stack((np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)), axis=1))
#: Minimum number of rays from the centroid that intersect a surrounding site; a thin arc of 180 degrees covers 245 of 360.
MIN_RAYS_AROUND = 6

Words = NDArray[np.uint64]
#: Words of the sites of each layout.
_words: WeakKeyDictionary[Any, tuple[Words, Words]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Device:
    """
    Source of the fixed patterns of a device.

    Parameters
    ----------
    seed : int
        Seed of the device.
    layout : packed rings with ``columns``
        Sites of the device.
    """

    seed: int
    layout: PackedRings
    _complete: tuple[Device, slice | Ints] | None = None

    __repr__ = short_repr

    def part(self, selection: slice | Ints, layout: PackedRings) -> Device:
        """
        Return the device of some of its sites, with their numbers.

        Parameters
        ----------
        selection : slice or (n,) int64
        layout : packed rings with ``columns``
            The layout of these sites.
        """
        # Outlines of a lattice are rectangles, each identified by its own centroid, and are not all in memory.
        is_lattice = getattr(self.layout, "lattice", None) is not None
        return Device(self.seed, layout, None if is_lattice else (self, selection))

    @cached_property
    def words(self) -> tuple[Words, Words]:
        """Two words per site that identify it, which all devices of a layout share."""
        if self._complete is not None:
            device, selection = self._complete
            one, other = device.words
            return one[selection], other[selection]
        if type(self.layout).__hash__ is not object.__hash__:  # not immutable
            return _site_words(self.layout)
        words = _words.get(self.layout)
        if words is None:
            words = _words[self.layout] = _site_words(self.layout)
        return words

    def key(self, effect: str) -> tuple[np.uint64, np.uint64]:
        """Return the generator key of an effect."""
        return fixed_pattern_key(self.seed, effect)

    def uniforms(self, effect: str) -> Floats:
        """Return a uniform number in (0, 1) for each site, (n_site,)."""
        from foveasim.sensor import _kernels

        out: Floats = _kernels.device_uniforms(*self.key(effect), *self.words)
        return out

    def normals(self, effect: str) -> Floats:
        """Return a standard Gaussian number for each site, (n_site,)."""
        from scipy.special import ndtri

        return np.asarray(ndtri(self.uniforms(effect)))

    def log_normals(self, effect: str, spread_fraction: float) -> Floats:
        """
        Return a log-normal number for each site, (n_site,).

        The mean is 1 and the standard deviation ``spread_fraction``: the logarithm is Gaussian with variance
        ``s² = ln(1 + spread_fraction²)`` and mean ``-s² / 2``.
        """
        sigma = np.sqrt(np.log1p(spread_fraction**2))
        return np.asarray(np.exp(sigma * self.normals(effect) - 0.5 * sigma**2))

    def line_normals(self, effect: str, lines: Ints) -> Floats:
        """Return a standard Gaussian number for each given readout line."""
        from scipy.special import ndtri

        from foveasim.sensor import _kernels

        words = np.ascontiguousarray(lines, np.int64).view(np.uint64)
        return np.asarray(ndtri(_kernels.device_uniforms(*self.key(effect), words, np.zeros_like(words))))


#: Odd multipliers for the two words of an outline and for its coordinates (the first is 2**64 over the golden ratio).
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def _outline_words(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints, sites: Ints) -> tuple[Words, Words]:
    """Hash the outlines of sites to two words each, independent of the vertex order."""
    begins, ends = ring_offsets[site_offsets[sites]], ring_offsets[site_offsets[sites + 1]]
    lengths = ends - begins
    if not sites.size:
        return np.zeros(0, np.uint64), np.zeros(0, np.uint64)
    vertices = np.repeat(begins, lengths) + positions_in_runs(lengths)
    position = np.rint(xy_um[vertices] / POSITION_UM).astype(np.int64).view(np.uint64)
    firsts = np.concatenate(([0], np.cumsum(lengths)[:-1]))
    one, other = (
        np.add.reduceat(_mix(_mix(position[:, 0] * factor) + position[:, 1] * _FACTORS[2]), firsts)
        for factor in _FACTORS[:2]
    )
    return one, other


def _mix(words: Words) -> Words:
    """Mix the bits of words: finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))


def _site_words(layout: PackedRings) -> tuple[Words, Words]:
    """Return two words per site that identify it."""
    from foveasim.sensor import _kernels

    columns: Any = getattr(layout, "columns", {})
    if SITE_ID in columns:
        site_ids = columns[SITE_ID]
        if site_ids.dtype.kind not in "iu":
            raise ParameterError(SITE_ID, f"must be a layout column of integers, got {site_ids.dtype}")
        ids = np.ascontiguousarray(site_ids).astype(np.int64)
        return ids.view(np.uint64), np.full(ids.size, 1 << 63, np.uint64)
    rings = layout.xy_um, layout.ring_offsets, layout.site_offsets
    _, centroid_um = site_moments(*rings)
    position = np.rint(centroid_um / POSITION_UM).astype(np.int64).T
    x, y = (words.view(np.uint64) for words in np.ascontiguousarray(position))
    n_intersecting = _kernels.count_ray_intersections(*rings, np.ascontiguousarray(centroid_um), RAYS)
    is_around = n_intersecting >= MIN_RAYS_AROUND
    if np.any((n_intersecting > 0) & ~is_around):
        _, which, n_here = np.unique(position, axis=1, return_inverse=True, return_counts=True)
        is_around |= (n_intersecting > 0) & (n_here[which.ravel()] > 1)
    around = np.flatnonzero(is_around)
    x[around], y[around] = _outline_words(*rings, around)
    return x, y
