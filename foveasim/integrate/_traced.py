"""Integration over outlines that are traced at every call, without stored overlaps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import to_frame
from foveasim._core.threads import cached_property, parallel_map
from foveasim._core.validation import Bools, Floats
from foveasim.fields import Grid
from foveasim.integrate._coverage import Coverage
from foveasim.integrate._outlines import Outlines

#: Sites per work item; results do not depend on it.
SITES_PER_PIECE = 1024


@dataclass(frozen=True, eq=False)
class TracedOutlines:
    """
    Outlines that are traced and summed in one pass.

    A call takes up to twice as long as with a plan, which must be compiled first. ``outlines(first, last)`` returns the
    outlines of the sites ``first`` to ``last - 1``.
    """

    outlines: Callable[[int, int], Outlines]
    n_sites: int
    grid: Grid
    order: int
    n_threads: int

    @cached_property
    def _pieces(self) -> list[tuple[int, Outlines]]:
        """Outlines in pieces, with their first sites."""
        starts = range(0, self.n_sites, SITES_PER_PIECE)
        found = parallel_map(
            lambda first: self.outlines(first, min(first + SITES_PER_PIECE, self.n_sites)), starts, self.n_threads
        )
        return list(zip(starts, found, strict=True))

    @cached_property
    def _measures(self) -> tuple[Floats, Floats]:
        """Signed areas (n_site,) µm² and bounds (n_site, 4) µm."""
        from foveasim.integrate import _kernels

        found = [
            _kernels.measure_sites(piece.xy_um, piece.ring_offsets, piece.site_offsets) for _, piece in self._pieces
        ]
        return (
            np.concatenate([np.zeros(0), *(area for area, _ in found)]),
            np.concatenate([np.zeros((0, 4)), *(bounds for _, bounds in found)]),
        )

    @property
    def area_um2(self) -> Floats:
        """Signed area of each outline, (n_site,) µm²."""
        return self._measures[0]

    @cached_property
    def coverage(self) -> Coverage:
        """Position of the sites relative to the grid and the image circle."""
        area_um2, bounds_um = self._measures
        is_outside = np.concatenate([np.zeros(0, bool), *(piece.is_outside for _, piece in self._pieces)])
        covered_um2: Floats | None = None
        if is_outside.any() or Coverage.extent_within(self.grid, bounds_um) is None:
            covered_um2 = np.empty(self.n_sites)
            ones = np.ones(self.grid.shape, np.float32)
            first_order = TracedOutlines(self.outlines, self.n_sites, self.grid, 1, self.n_threads)
            first_order.gather(ones, covered_um2, self.grid.cell_area_um2, np.zeros(0, bool), self.n_threads)
        return Coverage.of_sites(
            self.grid, bounds_um, area_um2, area_um2 if covered_um2 is None else covered_um2, is_outside
        )

    def gather(self, cells: NDArray[np.floating], out: Floats, scale: float, where: Bools, n_threads: int) -> None:
        """Write scale x integral in cells of every site; see :meth:`Plan.gather`."""
        from foveasim.integrate import _traced_kernels

        def integrate(piece: tuple[int, Outlines]) -> None:
            first, outlines = piece
            sites = slice(first, first + outlines.is_outside.size)
            uv = to_frame(outlines.xy_um, self.grid.origin_um, self.grid.pitch_xy_um)
            rings = outlines.ring_offsets, outlines.site_offsets
            _traced_kernels.integrate_sites(cells, uv, *rings, where[sites], self.order, scale, out[sites])

        parallel_map(integrate, self._pieces, n_threads)
