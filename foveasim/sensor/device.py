"""
What makes one device differ from the next of its kind: patterns that are fixed from its making on.

Every number hangs on the seed of the device, the name of the effect, and the place of the site (or the number of its line)
alone, by a counter-based generator: so a crop of a layout, its sites in another order, another frame or another number of
workers see the same device.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.arrays import Floats, Ints
from foveasim.compiled import kernels
from foveasim.fields import PackedRings
from foveasim.rings import site_moments
from foveasim.streams import device_key

__all__ = ["SITE_ID", "Device"]

#: A column of this name, of whole numbers, tells sites apart in place of where they are.
SITE_ID = "site_id"
#: Sites are told apart by where their centroids lie, in units of this.
PLACE_UM = 1e-4

Words = NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class Device:
    """
    The fixed patterns of a device.

    Parameters
    ----------
    seed : int
        Of the device.
    layout : packed rings with ``columns``
        Its sites.
    """

    seed: int
    layout: PackedRings

    @cached_property
    def _sites(self) -> tuple[Words, Words]:
        """Two words for every site, that no other site of the layout has."""
        columns: Any = getattr(self.layout, "columns", {})
        if SITE_ID in columns:
            ids = np.ascontiguousarray(columns[SITE_ID], np.int64)
            return ids.view(np.uint64), np.full(ids.size, 1 << 63, np.uint64)
        _, centroid_um = site_moments(self.layout.xy_um, self.layout.ring_offsets, self.layout.site_offsets)
        place = np.rint(centroid_um / PLACE_UM).astype(np.int64).T
        x, y = np.ascontiguousarray(place)
        return x.view(np.uint64), y.view(np.uint64)

    def key(self, effect: str) -> tuple[np.uint64, np.uint64]:
        """Key of an effect's numbers."""
        return device_key(self.seed, effect)

    def uniforms(self, effect: str) -> Floats:
        """A number between 0 and 1 for every site, (n_site,)."""
        out: Floats = kernels("sensor").device_uniforms(*self.key(effect), *self._sites)
        return out

    def normals(self, effect: str) -> Floats:
        """A number of the standard Gaussian law for every site, (n_site,)."""
        from scipy.special import ndtri

        return np.asarray(ndtri(self.uniforms(effect)))

    def line_normals(self, effect: str, lines: Ints) -> Floats:
        """A number of the standard Gaussian law for each of some lines."""
        from scipy.special import ndtri

        words = np.ascontiguousarray(lines, np.int64).view(np.uint64)
        return np.asarray(ndtri(kernels("sensor").device_uniforms(*self.key(effect), words, np.zeros_like(words))))
