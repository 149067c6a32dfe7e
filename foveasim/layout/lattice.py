"""Rectangular photosites in rows and columns, without stored vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from foveasim._core.calls import copyable
from foveasim._core.rings import site_bounds_um, site_moments
from foveasim._core.validation import Floats, Ints, freeze

__all__ = ["RectangleLattice"]

#: Differences of sizes that are due to rounding, relative.
ROUNDING = 1e-9
#: Sites whose vertices are in memory at once, when a number per site is computed.
SITES_PER_BLOCK = 2**16


@copyable
@dataclass(frozen=True, eq=False)
class RectangleLattice:
    """
    Outlines of rectangular sites in rows and columns.

    Site ``row * n_columns + column`` is the rectangle ``x_um[column]`` by ``y_um[row]``. Vertices are computed on demand, so
    that the memory of a dense sensor does not depend on the number of its sites.

    ``x_um`` (n_column, 2) float64, µm: lower and upper x of the sites of each column. ``y_um`` (n_row, 2) float64, µm: lower
    and upper y of the sites of each row.
    """

    x_um: Floats
    y_um: Floats

    def __post_init__(self) -> None:
        for name in ("x_um", "y_um"):
            object.__setattr__(self, name, freeze(np.array(getattr(self, name), np.float64, order="C")))

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return self.y_um.shape[0], self.x_um.shape[0]

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.y_um.shape[0] * self.x_um.shape[0]

    @property
    def site_size_um(self) -> tuple[float, float] | None:
        """Width and height of the sites, µm; None if they are not equal, or without sites."""
        if not self.n_sites:
            return None
        width_um, height_um = (axis[:, 1] - axis[:, 0] for axis in (self.x_um, self.y_um))
        if any(np.ptp(sizes_um) > ROUNDING * sizes_um[0] for sizes_um in (width_um, height_um)):
            return None
        return float(width_um.mean()), float(height_um.mean())

    @property
    def bounds_um(self) -> tuple[float, float, float, float]:
        """Bounding box x_min, y_min, x_max, y_max, µm; NaN without sites."""
        if not self.n_sites:
            return np.nan, np.nan, np.nan, np.nan
        (x0, x1), (y0, y1) = ((float(axis.min()), float(axis.max())) for axis in (self.x_um, self.y_um))
        return x0, y0, x1, y1

    def scaled(self, factor: float, shift_um: Floats) -> RectangleLattice:
        """Return the lattice with vertices ``factor * xy_um + shift_um``, for a positive factor."""
        return RectangleLattice(self.x_um * factor + shift_um[0], self.y_um * factor + shift_um[1])

    def rows(self, first: int, last: int) -> RectangleLattice | None:
        """Return the sites ``first`` to ``last - 1`` if they are complete rows, otherwise None."""
        if not first < last or first % self.shape[1] or last % self.shape[1]:
            return None
        return RectangleLattice(self.x_um, self.y_um[first // self.shape[1] : last // self.shape[1]])

    def rings(self, first: int = 0, last: int | None = None) -> tuple[Floats, Ints, Ints]:
        """
        Return the packed rings of the sites ``first`` to ``last - 1``, by default of all.

        Returns ``xy_um`` (4 n, 2) float64, µm: counter-clockwise from the lower left corner. ``ring_offsets``,
        ``site_offsets`` (n + 1,) int64.
        """
        from foveasim.layout import _kernels

        last = self.n_sites if last is None else last
        xy_um: Floats = np.empty((4 * (last - first), 2))
        _kernels.fill_rectangles(self.x_um, self.y_um, first, xy_um)
        site_offsets = np.arange(last - first + 1)
        return xy_um, 4 * site_offsets, site_offsets

    def moments(self) -> tuple[Floats, Floats]:
        """Return the area (n_site,) µm² and the centroid (n_site, 2) µm of each site."""
        area_um2, centroid_um = np.empty(self.n_sites), np.empty((self.n_sites, 2))
        for first in range(0, self.n_sites, SITES_PER_BLOCK):
            block = slice(first, min(first + SITES_PER_BLOCK, self.n_sites))
            area_um2[block], centroid_um[block] = site_moments(*self.rings(block.start, block.stop))
        return area_um2, centroid_um

    def site_bounds_um(self) -> Floats:
        """Return the bounding box x_min, y_min, x_max, y_max of each site, (n_site, 4) µm."""
        bounds_um = np.empty((self.n_sites, 4))
        for first in range(0, self.n_sites, SITES_PER_BLOCK):
            block = slice(first, min(first + SITES_PER_BLOCK, self.n_sites))
            bounds_um[block] = site_bounds_um(*self.rings(block.start, block.stop))
        return bounds_um
