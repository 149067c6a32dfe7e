"""Compiled plan of outlines on a grid: gather, scatter and sparse matrix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import positions_in_runs, to_frame
from foveasim._core.threads import parallel_map
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.fields import Grid
from foveasim.integrate._coverage import Coverage
from foveasim.integrate._outlines import Outlines

if TYPE_CHECKING:
    from scipy.sparse import csr_array

#: Sites per work item of tracing; fixed, so that a plan does not depend on the number of threads.
SITES_PER_PIECE = 2048
#: Maximum number of bands of rows; one thread sums each band into separate slots.
MAX_BANDS = 64
#: Minimum height of a band; the overhead of distributing thinner bands exceeds their computing time.
MIN_ROWS_PER_BAND = 32
#: Maps up to this number of cells are processed by the calling thread.
SMALL_MAP = 1 << 16


@dataclass(frozen=True, eq=False)
class Plan:
    """Spans of cells in the order of the rows of a map (see ``_kernels``)."""

    grid: Grid
    n_sites: int
    # Index of the first span, and of the first weight, of each row, (n_y + 1,).
    row_spans: Ints
    row_weights: Ints
    spans: NDArray[np.int32]
    weights: Floats
    # Cells that an outline cuts, empty at first order; index of the first one of each row, (n_y + 1,).
    row_cuts: Ints
    cuts: NDArray[np.int32]
    # Weights of the differences of the neighbours along x and along y, (n_cut, 2).
    moments: Floats
    # Height of the bands of rows that are summed separately.
    rows_per_band: int
    # Site s has the slots ``first_slot[s] : first_slot[s + 1]``, one per band.
    first_slot: Ints
    coverage: Coverage

    def _pass(self, kernel: Callable[..., None], read: NDArray[Any], written: NDArray[Any], n_threads: int) -> None:
        """Run a kernel over all bands of rows, which write to disjoint elements."""
        n_y, n_x = self.grid.shape
        plan = (self.row_spans, self.row_weights, self.spans, self.weights, self.row_cuts, self.cuts, self.moments)

        def band(first_row: int) -> None:
            last_row = min(first_row + self.rows_per_band, n_y)
            kernel(read, first_row, last_row, *plan, written)

        parallel_map(band, range(0, n_y, self.rows_per_band), 1 if n_y * n_x <= SMALL_MAP else n_threads)

    def gather(self, cells: NDArray[np.floating], out: Floats, scale: float, where: Bools, n_threads: int) -> None:
        """
        Write scale x sum of weight x cell for every site into ``out`` (n_site,).

        ``cells`` (n_y, n_x): C-contiguous map, float32 or float64. ``where`` (n_site,): sites that are computed; other
        elements of ``out`` are unchanged. Empty for all sites.
        """
        from foveasim.integrate import _kernels

        n_slots = np.diff(self.first_slot)
        slots = np.zeros(int(self.first_slot[-1]))
        is_needed = np.repeat(where, n_slots) if where.size else where

        def kernel(read: NDArray[Any], first_row: int, last_row: int, *arrays: NDArray[Any]) -> None:
            _kernels.gather(read, first_row, last_row, *arrays[:-1], is_needed, arrays[-1])

        self._pass(kernel, cells, slots, n_threads)
        sums = np.zeros(self.n_sites)
        is_on_grid = n_slots > 0
        if is_on_grid.any():
            sums[is_on_grid] = np.add.reduceat(slots, self.first_slot[:-1][is_on_grid])
        np.multiply(sums, scale, out=out, where=where if where.size else True)

    def scatter(self, values: Floats, n_threads: int) -> Floats:
        """Return the sum of weight x site value for every cell, (n_y, n_x): the adjoint of gather."""
        from foveasim.integrate import _kernels

        cells = np.zeros(self.grid.shape)
        slots = np.repeat(values, np.diff(self.first_slot))
        self._pass(_kernels.scatter, slots, cells, n_threads)
        return cells

    def matrix(self) -> csr_array[Any]:
        """
        Return the plan as a sparse matrix (n_site, n_y * n_x) with expanded runs.

        At first order the elements are the overlaps in cells.
        """
        from scipy.sparse import coo_array

        from foveasim.integrate import _kernels

        n_partial, n_run = (self.spans[:, column].astype(np.int64) for column in (_kernels.N_PARTIAL, _kernels.N_RUN))
        n_cells = n_partial + n_run
        # The k-th cell of a span has the k-th weight; all cells of the run have the weight after the partial weights.
        n_weights = n_partial + (n_run > 0)
        first_weight = np.cumsum(n_weights) - n_weights
        k = positions_in_runs(n_cells)
        at = np.repeat(first_weight, n_cells) + np.minimum(k, np.repeat(n_partial, n_cells))
        n_y, n_x = self.grid.shape
        start = np.repeat(np.arange(n_y) * n_x, np.diff(self.row_spans)) + self.spans[:, _kernels.COLUMN]
        cell = np.repeat(start, n_cells) + k
        slot_site = np.repeat(np.arange(self.n_sites), np.diff(self.first_slot))
        site = np.repeat(slot_site[self.spans[:, _kernels.SITE]], n_cells)
        parts = zip((self.weights[at], site, cell), self._gradients(slot_site), strict=True)
        weight, site, cell = (np.concatenate(part) for part in parts)
        matrix = coo_array((weight, (site, cell)), shape=(self.n_sites, n_y * n_x)).tocsr()
        matrix.sort_indices()
        return matrix

    def _gradients(self, slot_site: Ints) -> tuple[Floats, Ints, Ints]:
        """Return the matrix entries of the cuts: weights, sites and cells."""
        slot, column = self.cuts.T.astype(np.int64)
        row = np.repeat(np.arange(self.grid.shape[0]), np.diff(self.row_cuts))
        weights, sites, cells = [], [], []
        # Offsets of the neighbours (rows up, columns to the right), and the axis and sign of the difference.
        for up, right, axis, sign in ((0, 1, 0, 1), (0, -1, 0, -1), (1, 0, 1, 1), (-1, 0, 1, -1)):
            is_cut = self.moments[:, axis] != 0.0
            weights.append(sign * self.moments[is_cut, axis])
            sites.append(slot_site[slot[is_cut]])
            neighbour = (row[is_cut] + up, column[is_cut] + right)
            cells.append(np.ravel_multi_index(neighbour, self.grid.shape, mode="clip"))
        return np.concatenate(weights), np.concatenate(sites), np.concatenate(cells)


class _TracedSites(NamedTuple):
    """Traced spans and cuts of sites (see ``_kernels``), and their numbers per row."""

    spans: NDArray[np.int32]
    weights: Floats
    cuts: NDArray[np.int32]
    moments: Floats
    row_spans: Ints
    row_weights: Ints
    row_cuts: Ints
    area_um2: Floats
    covered_um2: Floats
    bounds_um: Floats
    is_outside: Bools


def compile_plan(
    outlines: Callable[[int, int], Outlines], n_sites: int, grid: Grid, n_threads: int, order: int = 1
) -> tuple[Plan, Floats]:
    """
    Trace every outline on the grid and sort the spans by the rows of the grid.

    The signed areas, (n_site,) µm², are also returned.

    ``outlines(first, last)`` returns the outlines of the sites ``first`` to ``last - 1``. It is called for one piece of the
    layout at a time, so that undistorted outlines are traced while they are in the cache, and memory use is limited.
    """
    from foveasim.integrate import _kernels

    n_y = grid.shape[0]
    traced = parallel_map(
        lambda first: _trace(outlines(first, min(first + SITES_PER_PIECE, n_sites)), first, grid, order),
        range(0, n_sites, SITES_PER_PIECE),
        n_threads,
    )

    # Position of the next span of (piece, row): after all lower rows, and after the same row of the previous pieces.
    row_spans, next_span = _starts([t.row_spans for t in traced], n_y)
    row_weights, next_weight = _starts([t.row_weights for t in traced], n_y)
    row_cuts, next_cut = _starts([t.row_cuts for t in traced], n_y)

    bounds_um = np.concatenate([np.zeros((0, 4)), *(t.bounds_um for t in traced)])
    rows_per_band = max(MIN_ROWS_PER_BAND, -(-n_y // MAX_BANDS))
    low, high = ((bounds_um[:, k] - grid.origin_um[1]) / grid.pitch_y_um for k in (1, 3))
    first_row = np.floor(np.clip(low, 0, n_y)).astype(np.int64)
    last_row = np.ceil(np.clip(high, 0, n_y)).astype(np.int64)
    n_bands = np.where(last_row > first_row, (last_row - 1) // rows_per_band - first_row // rows_per_band + 1, 0)
    first_slot = np.concatenate(([0], np.cumsum(n_bands)))

    out_spans = np.empty((int(row_spans[-1]), 4), np.int32)
    out_weights = np.empty(int(row_weights[-1]))
    out_cuts = np.empty((int(row_cuts[-1]), 2), np.int32)
    out_moments = np.empty((int(row_cuts[-1]), 2))
    slot_of_band_0 = first_slot[:-1] - first_row // rows_per_band

    def sort(i: int) -> None:
        t, slots = traced[i], (slot_of_band_0, rows_per_band)
        _kernels.sort_spans(t.spans, t.weights, next_span[i], next_weight[i], *slots, out_spans, out_weights)
        if t.cuts.size:
            _kernels.sort_cuts(t.cuts, t.moments, next_cut[i], *slots, out_cuts, out_moments)

    parallel_map(sort, range(len(traced)), n_threads)
    area_um2 = np.concatenate([np.zeros(0), *(t.area_um2 for t in traced)])
    plan = Plan(
        grid=grid,
        n_sites=n_sites,
        row_spans=row_spans,
        row_weights=row_weights,
        spans=out_spans,
        weights=out_weights,
        row_cuts=row_cuts,
        cuts=out_cuts,
        moments=out_moments,
        rows_per_band=rows_per_band,
        first_slot=first_slot,
        coverage=Coverage.of_sites(
            grid,
            bounds_um,
            area_um2,
            np.concatenate([np.zeros(0), *(t.covered_um2 for t in traced)]),
            np.concatenate([np.zeros(0, bool), *(t.is_outside for t in traced)]),
        ),
    )
    return plan, area_um2


def _trace(outlines: Outlines, first_site: int, grid: Grid, order: int) -> _TracedSites:
    """Trace the sites from the index ``first_site`` on."""
    from foveasim.integrate import _kernels

    n_y, n_x = grid.shape
    rings = outlines.ring_offsets, outlines.site_offsets
    area_um2, bounds_um = _kernels.measure_sites(outlines.xy_um, *rings)
    uv = to_frame(outlines.xy_um, grid.origin_um, grid.pitch_xy_um)
    spans, weights, cuts, moments, covered = _kernels.trace_sites(uv, *rings, first_site, n_y, n_x, order)
    n_weights = spans[:, _kernels.N_PARTIAL] + (spans[:, _kernels.N_RUN] > 0)
    return _TracedSites(
        spans,
        weights,
        cuts,
        moments,
        row_spans=np.bincount(spans[:, _kernels.ROW], minlength=n_y),
        row_weights=np.bincount(spans[:, _kernels.ROW], n_weights, minlength=n_y).astype(np.int64),
        row_cuts=np.bincount(cuts[:, _kernels.CUT_ROW], minlength=n_y),
        area_um2=area_um2,
        covered_um2=covered * grid.cell_area_um2,
        bounds_um=bounds_um,
        is_outside=outlines.is_outside,
    )


def _starts(counts: list[NDArray[np.int64]], n_y: int) -> tuple[Ints, Ints]:
    """Return offsets of the rows (n_y + 1,) and of the pieces in each row (n_piece, n_y)."""
    by_piece = np.array(counts, dtype=np.int64).reshape(len(counts), n_y)
    offsets = np.concatenate(([0], np.cumsum(by_piece.sum(axis=0))))
    within = np.cumsum(by_piece, axis=0) - by_piece
    return offsets, np.ascontiguousarray(offsets[:-1] + within)
