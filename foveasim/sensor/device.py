"""
Fixed patterns of a device: random numbers per site that do not change between frames.

A counter-based generator computes each number from the seed of the device, the name of the effect and the identity of the site
(or the number of its readout line). Crops of a layout, permutations of its sites, other frames and other numbers of workers
therefore give the same device.

The identity of a site is that of :func:`foveasim._core.rings.site_ids`: its position, or the column ``site_id``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from foveasim._core.random_streams import fixed_pattern_key
from foveasim._core.rings import site_ids
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, Ints
from foveasim.fields import PackedRings

Words = NDArray[np.uint64]
#: Words of the sites of each layout.
_words: WeakKeyDictionary[Any, Words] = WeakKeyDictionary()
#: Second words of the counters of sites and of readout lines.
SITES, LINES = np.uint64(1 << 63), np.uint64(0)


@dataclass(frozen=True, eq=False)
class Device:
    """
    Source of the fixed patterns of a device.

    ``seed``: seed of the device. ``layout`` (packed rings with ``columns``): sites of the device.
    """

    seed: int
    layout: PackedRings
    _complete: tuple[Device, slice | Ints] | None = None

    __repr__ = short_repr

    def part(self, selection: slice | Ints, layout: PackedRings) -> Device:
        """
        Return the device of some of its sites, with their numbers.

        ``selection``: slice or (n,) int64. ``layout`` (packed rings with ``columns``): the layout of these sites.
        """
        # Outlines of a lattice are rectangles, each identified by its own centroid, and are not all in memory.
        is_lattice = getattr(self.layout, "lattice", None) is not None
        return Device(self.seed, layout, None if is_lattice else (self, selection))

    @cached_property
    def words(self) -> Words:
        """Word per site that identifies it, (n_site,) uint64, which all devices of a layout share."""
        if self._complete is not None:
            device, selection = self._complete
            return np.ascontiguousarray(device.words[selection])
        if type(self.layout).__hash__ is not object.__hash__:  # not immutable
            return site_ids(self.layout).view(np.uint64)
        words = _words.get(self.layout)
        if words is None:
            words = _words[self.layout] = site_ids(self.layout).view(np.uint64)
        return words

    def key(self, effect: str) -> tuple[np.uint64, np.uint64]:
        """Return the generator key of an effect."""
        return fixed_pattern_key(self.seed, effect)

    def uniforms(self, effect: str) -> Floats:
        """Return a uniform number in (0, 1) for each site, (n_site,)."""
        from foveasim.sensor import _kernels

        out: Floats = _kernels.device_uniforms(*self.key(effect), self.words, SITES)
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
        return np.asarray(ndtri(_kernels.device_uniforms(*self.key(effect), words, LINES)))
