"""Integration over axis-aligned rectangles: in rows and columns, or in any order."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import to_frame
from foveasim._core.threads import parallel_map
from foveasim._core.validation import Bools, Floats
from foveasim.fields import Grid, Lattice, PackedRings
from foveasim.integrate._coverage import Coverage

#: Sites per work item; results do not depend on it.
SITES_PER_PIECE = 2**15
#: Number of sites that are checked first: if they are not rectangles, the others are not checked.
FIRST_SITES = 4
#: Up to this number of sites are integrated by the calling thread.
FEW_SITES = 2**12


def rectangle_plan(layout: PackedRings, grid: Grid, order: int) -> RectanglePlan | LatticePlan | None:
    """Return a plan for a layout of axis-aligned rectangles; None if a site has another shape."""
    lattice: Lattice | None = getattr(layout, "lattice", None)
    if lattice is not None:
        axes = zip((lattice.x_um, lattice.y_um), grid.origin_um, grid.pitch_xy_um, strict=True)
        u, v = (np.ascontiguousarray((ends_um - start_um) / pitch_um) for ends_um, start_um, pitch_um in axes)
        return LatticePlan(grid, order, lattice, u, v)
    from foveasim.integrate import _rectangle_kernels

    find = _rectangle_kernels.find_rectangles
    xy_um, ring_offsets, site_offsets = layout.xy_um, layout.ring_offsets, layout.site_offsets
    n = min(site_offsets.size - 1, FIRST_SITES)
    # Most other layouts are recognised by their first sites, without compilation.
    if not find.py_func(xy_um[: ring_offsets[site_offsets[n]]], ring_offsets, site_offsets[: n + 1]).size:
        return None
    bounds_um: Floats = find(xy_um, ring_offsets, site_offsets)
    if not bounds_um.size:
        return None
    bounds = to_frame(bounds_um.reshape(-1, 2), grid.origin_um, grid.pitch_xy_um).reshape(-1, 4)
    return RectanglePlan(grid, order, bounds, _coverage(bounds_um, grid))


@dataclass(frozen=True, eq=False)
class RectanglePlan:
    """Rectangles in any order; bounds u_min, v_min, u_max, v_max (n_site, 4) in cells."""

    grid: Grid
    order: int
    bounds: Floats
    coverage: Coverage

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.bounds.shape[0]

    def gather(self, cells: NDArray[np.floating], out: Floats, scale: float, where: Bools, n_threads: int) -> None:
        """Write scale x integral in cells of every site; see :meth:`Plan.gather`."""
        from foveasim.integrate import _rectangle_kernels

        def piece(first: int) -> None:
            last = min(first + SITES_PER_PIECE, self.n_sites)
            _rectangle_kernels.gather_rectangles(cells, self.bounds, first, last, where, scale, self.order, out)

        parallel_map(piece, range(0, self.n_sites, SITES_PER_PIECE), n_threads)


@dataclass(frozen=True, eq=False)
class LatticePlan:
    """
    Rectangles in rows and columns.

    ``u`` (n_column, 2), ``v`` (n_row, 2): lower and upper ends of the columns along x, and of the rows along y, in cells.
    """

    grid: Grid
    order: int
    lattice: Lattice
    u: Floats
    v: Floats
    coverage: Coverage = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "coverage", _lattice_coverage(self.lattice, self.grid))

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.u.shape[0] * self.v.shape[0]

    def gather(self, cells: NDArray[np.floating], out: Floats, scale: float, where: Bools, n_threads: int) -> None:
        """Write scale x integral in cells of every site; see :meth:`Plan.gather`."""
        from foveasim.integrate import _rectangle_kernels

        n_rows = self.v.shape[0]
        step = max(1, SITES_PER_PIECE // max(1, self.u.shape[0]))

        def rows(first: int) -> None:
            last = min(first + step, n_rows)
            _rectangle_kernels.gather_lattice(cells, self.u, self.v, first, last, where, scale, self.order, out)

        parallel_map(rows, range(0, n_rows, step), 1 if self.n_sites <= FEW_SITES else n_threads)


def _coverage(bounds_um: Floats, grid: Grid) -> Coverage:
    low_um, high_um = bounds_um[:, :2], bounds_um[:, 2:]
    area_um2 = np.prod(high_um - low_um, axis=1)
    x0, y0, x1, y1 = grid.bounds_um
    covered_um = np.clip(high_um, (x0, y0), (x1, y1)) - np.clip(low_um, (x0, y0), (x1, y1))
    return Coverage.of_sites(grid, bounds_um, area_um2, np.prod(covered_um, axis=1))


def _lattice_coverage(lattice: Lattice, grid: Grid) -> Coverage:
    coverage = Coverage.within(grid, lattice.bounds_um, lattice.n_sites)
    return _coverage(lattice.site_bounds_um(), grid) if coverage is None else coverage
