"""Derivatives of integrals over sites with respect to the vertices of their outlines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import OwnCheck
from foveasim._core.rings import next_vertex, to_frame
from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Bools, Floats, Ints, as_numbers, finite_array, read_only
from foveasim.errors import ParameterError, type_name
from foveasim.fields import Grid, PackedRings

#: Edges per work item; results do not depend on it.
EDGES_PER_PIECE = 4096
#: Order of integration.
Order: TypeAlias = Literal[1, 2]


@dataclass(frozen=True, eq=False)
class SharedEdges:
    """
    Edges of outlines, in which an edge that two sites share occurs once.

    ``point`` (n_vertex,): number of the position of each vertex; vertices at the same position have the same number. The
    properties have one element per vertex, except ``begin`` and ``end``: they are the vertices of each edge, which leads from
    the lower to the higher point number.
    """

    ring_offsets: Ints
    site_offsets: Ints
    point: Ints

    @classmethod
    def from_layout(cls, layout: OwnCheck[PackedRings]) -> SharedEdges:
        """Return the edges of a layout; vertices with equal coordinates are the same point."""
        if not all(hasattr(layout, name) for name in ("xy_um", "ring_offsets", "site_offsets")):
            raise ParameterError("layout", f"must be a Layout or packed rings, got {type_name(layout)}")
        # -0.0 + 0.0 is 0.0: both are the same position.
        position = np.ascontiguousarray(layout.xy_um + 0.0).view(np.complex128)[:, 0]
        return cls(layout.ring_offsets, layout.site_offsets, np.unique(position, return_inverse=True)[1])

    @cached_property
    def after(self) -> Ints:
        """Index of the next vertex in the ring of each vertex."""
        return read_only(next_vertex(self.ring_offsets))

    @cached_property
    def before(self) -> Ints:
        """Index of the previous vertex in the ring of each vertex."""
        before = np.empty_like(self.after)
        before[self.after] = np.arange(before.size)
        return read_only(before)

    @cached_property
    def site(self) -> Ints:
        """Site of each vertex."""
        n_vertices = np.diff(self.ring_offsets[self.site_offsets])
        return read_only(np.repeat(np.arange(n_vertices.size), n_vertices))

    @cached_property
    def is_reversed(self) -> Bools:
        """Whether the edge after each vertex is stored in the opposite direction."""
        return read_only(self.point > self.point[self.after])

    @cached_property
    def _unique(self) -> tuple[Ints, Ints]:
        """First vertex that has each edge, and number of the edge after each vertex."""
        low, high = np.sort(np.stack((self.point, self.point[self.after])), axis=0)
        _, first, edge = np.unique(
            low * (int(self.point.max(initial=0)) + 1) + high, return_index=True, return_inverse=True
        )
        # In the order of the sites, so that neighbouring edges read neighbouring cells.
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(order.size)
        return first[order], rank[edge]

    @cached_property
    def edge(self) -> Ints:
        """Number of the edge from each vertex to the next."""
        return read_only(self._unique[1])

    @cached_property
    def begin(self) -> Ints:
        """Vertex at the beginning of each edge."""
        first = self._unique[0]
        return read_only(np.where(self.is_reversed[first], self.after[first], first))

    @cached_property
    def end(self) -> Ints:
        """Vertex at the end of each edge."""
        first = self._unique[0]
        return read_only(np.where(self.is_reversed[first], first, self.after[first]))

    @property
    def n_edges(self) -> int:
        """Number of edges."""
        return int(self.begin.size)


@dataclass(frozen=True, eq=False)
class EdgeMoments:
    """
    Moments of maps along edges ``begin_um`` to ``end_um`` (n_edge, 2), with derivatives.

    The moments of an edge from a to b are the integrals of ``(1 - τ) P`` and ``τ P`` over the points ``a + τ (b - a)``.
    """

    grid: Grid
    begin_um: Floats
    end_um: Floats
    order: Order
    n_threads: int

    @cached_property
    def _ends(self) -> tuple[Floats, Floats]:
        begin, end = (to_frame(xy, self.grid.origin_um, self.grid.pitch_xy_um) for xy in (self.begin_um, self.end_um))
        return begin, end

    def _pieces(self, n_maps: int) -> list[tuple[int, int, int]]:
        n = self.begin_um.shape[0]
        starts = range(0, n, EDGES_PER_PIECE)
        return [(k, first, min(first + EDGES_PER_PIECE, n)) for k in range(n_maps) for first in starts]

    def measure(self, cells: NDArray[np.floating[Any]]) -> Floats:
        """Return the moments (n_map, n_edge, 2) of maps (n_map, n_y, n_x)."""
        from foveasim.integrate import _shape_kernels

        out = np.empty((cells.shape[0], self.begin_um.shape[0], 2))

        def piece(work: tuple[int, int, int]) -> None:
            k, first, last = work
            _shape_kernels.measure_moments(cells, k, *self._ends, first, last, self.order, out[k])

        parallel_map(piece, self._pieces(cells.shape[0]), self.n_threads)
        return out

    def spread(self, weights: Floats) -> Floats:
        """Return maps (n_map, n_y, n_x) from weights of moments: the adjoint of :meth:`measure`."""
        from foveasim.integrate import _shape_kernels

        cells = np.zeros((weights.shape[0], *self.grid.shape))
        parallel_map(
            lambda k: _shape_kernels.spread_moments(weights, k, *self._ends, self.order, cells),
            range(weights.shape[0]),
            self.n_threads,
        )
        return cells

    def differentiate(self, cells: NDArray[np.floating[Any]], weights: Floats) -> tuple[Floats, Floats]:
        """
        Return the gradients of ``sum weights * moments`` by both ends of edges, (n_edge, 2).

        ``cells`` (n_map, n_y, n_x), ``weights`` (n_map, n_edge, 2). The unit is that of weights x maps over µm.
        """
        from foveasim.integrate import _shape_kernels

        out = np.zeros((self.begin_um.shape[0], 2, 2))
        n = out.shape[0]

        def piece(first: int) -> None:
            last = min(first + EDGES_PER_PIECE, n)
            for k in range(cells.shape[0]):
                _shape_kernels.differentiate_moments(cells, k, *self._ends, weights, first, last, self.order, out)

        parallel_map(piece, range(0, n, EDGES_PER_PIECE), self.n_threads)
        out /= self.grid.pitch_xy_um
        return out[:, 0], out[:, 1]


def vertex_gradient(
    layout: OwnCheck[PackedRings],
    grid: Grid,
    power_map: ArrayLike,
    site_weights: ArrayLike,
    *,
    order: Order = 1,
    edges: SharedEdges | None = None,
    n_threads: int | None = None,
) -> Floats:
    """
    Compute the gradient of a weighted sum of the integrals over all sites, by the vertices.

    Parameters
    ----------
    layout : Layout, or any object with ``xy_um``, ``ring_offsets``, ``site_offsets``
    grid : Grid
        Grid of the maps.
    power_map : (..., n_y, n_x) float32 or float64
        Cell means, bottom row first, as for :class:`foveasim.Integrator`.
    site_weights : (..., n_site)
        Weights of the sum: the gradient of a loss with respect to the power of each site, one row per map.
    order : {1, 2}
        Order of integration, as for :class:`foveasim.Integrator`.
    edges : SharedEdges, optional
        Edges of the layout, or of a layout with the same edges at other positions. By default every call finds them from the
        coordinates.
    n_threads : int, optional
        Number of threads, by default all cores of the process. Results are bit-identical for any number.

    Returns
    -------
    gradient : (n_vertex, 2) float64, unit of the weights times that of the map times µm
        Derivative with respect to ``layout.xy_um``, the sum over all maps. A vertex that several sites share has one
        row per site; their sum is the derivative for a displacement of all of them.

    Raises
    ------
    ParameterError
        If shapes do not match, or values are not finite.

    Notes
    -----
    A displacement of the boundary changes an integral by the map along the boundary. For the edge from a to b of a
    counter-clockwise outline, with ``N = (b_y - a_y, a_x - b_x)``::

        dE/da = N ∫ (1 - τ) P(a + τ (b - a)) dτ        dE/db = N ∫ τ P(a + τ (b - a)) dτ

    Both integrals are exact for the map that the integrator uses. Edges that two sites share are traced once. The cost is
    proportional to the number of cells that edges cross, the memory to the number of vertices.

    An integral has no derivative with respect to the displacement of an edge along a cell boundary, where the map jumps: the
    result there is the mean of both one-sided derivatives.

    Examples
    --------
    Under uniform irradiance the gradient is that of the area; moving the upper right corner of a square outwards adds
    half a side:

    >>> import foveasim as fs
    >>> square = fs.Layout.from_rectangles([[1.5, 1.5]], size_um=2.0)
    >>> vertex_gradient(
    ...     square, fs.Grid(shape=(3, 3), pitch_um=1.0), np.ones((3, 3)), [1.0]
    ... )[2]
    array([1., 1.])
    """
    if edges is None:
        edges = SharedEdges.from_layout(layout)
    cells = as_numbers("power_map", power_map, keep_type=True)
    if cells.ndim < 2 or cells.shape[-2:] != grid.shape:
        raise ParameterError(
            "power_map", f"must have the shape (..., n_y, n_x) with (n_y, n_x) = {grid.shape}, got {cells.shape}"
        )
    if cells.dtype not in (np.float32, np.float64):
        cells = cells.astype(np.float64)
    weights = finite_array("site_weights", site_weights)
    shape = *cells.shape[:-2], layout.site_offsets.size - 1
    if weights.shape != shape:
        raise ParameterError("site_weights", f"must have the shape {shape}, got {weights.shape}")
    cells = np.ascontiguousarray(cells).reshape(-1, *grid.shape)
    xy_um = layout.xy_um
    moments = EdgeMoments(grid, xy_um[edges.begin], xy_um[edges.end], order, thread_count(n_threads)).measure(cells)
    return _contract(xy_um, edges, moments, weights.reshape(-1, shape[-1]))


def _contract(xy_um: Floats, edges: SharedEdges, moments: Floats, site_weights: Floats) -> Floats:
    """Return the gradient (n_vertex, 2) from moments of edges and weights of sites."""
    if moments.shape[0] == 1:
        of_vertex = moments[0][edges.edge] * site_weights[0][edges.site, np.newaxis]
    else:
        of_vertex = np.zeros((xy_um.shape[0], 2))
        for moment, weight in zip(moments, site_weights, strict=True):
            of_vertex += moment[edges.edge] * weight[edges.site, np.newaxis]
    along = xy_um[edges.after] - xy_um
    from_low, from_high = of_vertex[:, 0], of_vertex[:, 1]  # ends of the stored edge
    from_begin = np.where(edges.is_reversed, from_high, from_low)
    from_end = np.where(edges.is_reversed, from_low, from_high)
    gradient = np.empty(xy_um.shape)
    for axis, normal in ((0, along[:, 1]), (1, -along[:, 0])):
        np.multiply(normal, from_begin, out=gradient[:, axis])
        gradient[:, axis] += (normal * from_end)[edges.before]
    return gradient
