"""Areas of sites outside a grid or outside the image circle of a lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from foveasim._core.calls import copyable
from foveasim._core.validation import Bools, Floats, read_only
from foveasim.fields import Grid

#: Tolerance for rounding errors of vertices outside the grid, relative to the largest grid coordinate.
UNCOVERED_ROUNDING = 1e-12


@copyable
@dataclass(frozen=True, eq=False)
class Coverage:
    """
    Position of sites relative to a grid and to the image circle.

    ``bounds_um`` (x_min, y_min, x_max, y_max), µm: bounds of all outlines inside the image circle; NaN without any.
    ``uncovered_um2`` (n_site,) float64, µm²: area of each site outside the grid or the image circle; without memory if all are
    0. ``is_outside`` (n_site,) bool: sites with a vertex outside the image circle; without memory if there are none.
    """

    bounds_um: tuple[float, float, float, float]
    uncovered_um2: Floats
    is_outside: Bools

    @property
    def n_uncovered(self) -> int:
        """Number of sites that are partly or completely uncovered."""
        return 0 if self.uncovered_um2.strides == (0,) else int(np.count_nonzero(self.uncovered_um2))

    @classmethod
    def within(cls, grid: Grid, bounds_um: tuple[float, float, float, float], n_sites: int) -> Coverage | None:
        """Return the coverage of sites that all lie on a grid, or None if their bounds exceed it."""
        if n_sites and not bool(_beyond_um(grid, np.array([bounds_um]))[0] <= 0.0):
            return None
        return cls(bounds_um, np.broadcast_to(0.0, n_sites), np.broadcast_to(np.False_, n_sites))

    @classmethod
    def extent_within(cls, grid: Grid, bounds_um: Floats) -> Coverage | None:
        """Return the coverage of sites with bounds (n_site, 4) µm, or None if one is not inside."""
        return cls.within(grid, _extent_um(bounds_um), bounds_um.shape[0])

    @classmethod
    def of_sites(
        cls, grid: Grid, bounds_um: Floats, area_um2: Floats, covered_um2: Floats, is_outside: Bools | None = None
    ) -> Coverage:
        """
        Return the coverage of sites.

        ``bounds_um``: (n_site, 4) float64, µm. ``area_um2``, ``covered_um2`` (n_site,) float64, µm²: area of each outline, and
        its area on the grid. ``is_outside`` (n_site,) bool: sites outside the image circle.
        """
        n_sites = area_um2.size
        if is_outside is None or not is_outside.any():
            complete = cls.extent_within(grid, bounds_um)
            if complete is not None:
                return complete
            is_outside = np.broadcast_to(np.False_, n_sites)
        extent_um = _extent_um(bounds_um[~is_outside] if is_outside.any() else bounds_um)
        rest_um2 = np.clip(area_um2 - covered_um2, 0.0, area_um2)
        rest_um2 = np.where(_beyond_um(grid, bounds_um) > 0.0, rest_um2, 0.0)
        return cls(extent_um, read_only(np.where(is_outside, area_um2, rest_um2)), is_outside)


def _extent_um(bounds_um: Floats) -> tuple[float, float, float, float]:
    """Return the bounds of all sites; NaN without any."""
    if not bounds_um.size:
        return np.nan, np.nan, np.nan, np.nan
    (x0, y0), (x1, y1) = (
        (float(find(bounds_um[:, k])), float(find(bounds_um[:, k + 1]))) for find, k in ((np.min, 0), (np.max, 2))
    )
    return x0, y0, x1, y1


def _beyond_um(grid: Grid, bounds_um: Floats) -> Floats:
    """Return the distance of bounds beyond the grid, (n,) µm; at most 0 inside it."""
    x0, y0, x1, y1 = grid.bounds_um
    rounding_um = UNCOVERED_ROUNDING * max(map(abs, grid.bounds_um))
    beyond_um = np.maximum(np.array([x0, y0]) - bounds_um[:, :2], bounds_um[:, 2:] - np.array([x1, y1]))
    return np.asarray(beyond_um.max(axis=1, initial=-np.inf) - rounding_um)
