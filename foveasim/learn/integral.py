"""
Integrals over sites as differentiable functions of the vertices and the maps.

The operations form a closed set: the derivatives of integrals are moments along edges and the adjoint of the integrator, and
the derivatives of these are again moments and integrals. All but the third derivatives therefore exist as code.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from foveasim._core.threads import thread_count
from foveasim._core.validation import Floats, Ints
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid
from foveasim.integrate import EdgeMoments, Integrator
from foveasim.learn._edges import integrate_edges
from foveasim.learn._tensors import as_array, check_tensor
from foveasim.learn.mesh import Mesh
from foveasim.learn.outlines import Outlines

__all__ = ["site_power"]

#: Number of maps from which overlaps are stored as a matrix, which is faster than one call per map; and its largest
#: number of cells.
MATRIX_MAPS, MATRIX_CELLS = 4, 2**20


def site_power(
    points: Tensor,
    maps: Tensor,
    outlines: Outlines | Mesh,
    grid: Grid,
    *,
    order: Literal[1, 2] = 1,
    n_threads: int | None = None,
) -> Tensor:
    """
    Integrate maps over sites, with derivatives by the vertices and by the maps.

    Parameters
    ----------
    points : (n_point, 2) tensor, µm
        Positions of the points of the outlines, such as ``mesh()``.
    maps : (..., n_y, n_x) tensor
        Cell means, bottom row first.
    outlines : Outlines or Mesh
        Sites as polygons between the points.
    grid : Grid
        Grid of the maps.
    order : {1, 2}
        Order of integration, as for :class:`foveasim.Integrator`. A :class:`foveasim.Camera` selects 2 for fine cells, and
        :class:`Model` uses the order of its camera.
    n_threads : int, optional
        Number of threads, by default all cores. Results are bit-identical for any number.

    Returns
    -------
    power : (..., n_site) tensor, unit of the maps times µm²
        Exact integrals, with the dtype of the maps. First and second derivatives exist for points and maps; where an
        edge lies along a cell boundary, the first is the mean of both sides.

    Raises
    ------
    GeometryError
        If the outline of a site is clockwise; :meth:`Mesh.limit_step` prevents it.

    Notes
    -----
    The derivative by a vertex is an integral of the map along the two edges at it: :func:`foveasim.integrate.vertex_gradient`.

    With constant cells, minima of a smooth loss can lie on the boundaries of cells, where the first derivative jumps;
    the second order is smoother.

    Examples
    --------
    >>> import foveasim as fs
    >>> mesh = fs.learn.Mesh(fs.layout.grid(2, 2, 2.0))
    >>> grid = fs.Grid.centred((8, 8), 0.5)
    >>> site_power(mesh(), torch.ones(8, 8), mesh, grid).tolist()
    [4.0, 4.0, 4.0, 4.0]
    """
    if isinstance(outlines, Mesh):
        outlines = outlines.outlines
    points = outlines.check_points(points)
    if not isinstance(maps, Tensor) or maps.ndim < 2:
        check_tensor("maps", maps, grid.shape, " or (..., n_y, n_x)", any_device=True)
    flat = maps.reshape(-1, *maps.shape[-2:])
    check_tensor("maps", flat, (None, *grid.shape), ", as the grid", any_device=True)
    if points.device != maps.device:
        raise ParameterError("maps", f"must be on the device of the points, {points.device}, got {maps.device}")
    if points.device.type == "meta":  # without values: only the shape
        found = (flat.sum(dim=(-2, -1))[:, None] + points.sum()).expand(-1, outlines.n_sites)
        return found.reshape(*maps.shape[:-2], outlines.n_sites)
    if points.device.type != "cpu":
        found = integrate_edges(points, flat, outlines, grid, 2 if order == 2 else 1)
        return found.reshape(*maps.shape[:-2], outlines.n_sites)
    integral = Integral(outlines, grid, 2 if order == 2 else 1, thread_count(n_threads))
    return _Power.apply(points, flat, integral, False).reshape(*maps.shape[:-2], outlines.n_sites)  # type: ignore[no-any-return, no-untyped-call]


@dataclass(frozen=True, eq=False)
class _Rings:
    """Packed rings at the positions of the points."""

    xy_um: Floats
    ring_offsets: Ints
    site_offsets: Ints


@dataclass(eq=False)
class Integral:
    """Integrals over sites at one position of their points, with their derivatives."""

    outlines: Outlines
    grid: Grid
    order: Literal[1, 2]
    n_threads: int
    _compiled: dict[str, Any] = field(default_factory=dict)

    def integrator(self, points: Tensor, n_maps: int) -> Integrator:
        """Return the integrator of the outlines; compiled for several maps."""
        if "integrator" not in self._compiled:
            outlines, xy_um = self.outlines, as_array(points).astype(np.float64)
            finite = np.isfinite(xy_um).all(axis=1)
            if not finite.all():
                raise GeometryError(
                    f"point {int(np.argmin(finite))} must have finite coordinates, got {xy_um[~finite][0]}"
                )
            rings = _Rings(xy_um[outlines.vertex], outlines.ring_offsets, outlines.site_offsets)
            self._compiled["integrator"] = Integrator(
                rings, self.grid, order=self.order, compiled=n_maps > 1, n_threads=self.n_threads
            )
        return self._compiled["integrator"]  # type: ignore[no-any-return]

    def _matrix(self, points: Tensor, n_maps: int) -> Any:
        """Return the overlaps as a sparse matrix (n_site, n_cell), or None for few or large maps."""
        n_y, n_x = self.grid.shape
        if n_maps < MATRIX_MAPS or n_y * n_x > MATRIX_CELLS:
            return None
        if "matrix" not in self._compiled:
            self._compiled["matrix"] = self.integrator(points, n_maps).weights()
        return self._compiled["matrix"]

    def power(self, points: Tensor, maps: Tensor) -> Tensor:
        """Return the integrals (n_map, n_site) of maps (n_map, n_y, n_x)."""
        cells = as_array(maps)
        matrix = self._matrix(points, cells.shape[0])
        if matrix is None:
            found = self.integrator(points, cells.shape[0])(cells)
        else:
            found = np.ascontiguousarray((matrix @ cells.reshape(cells.shape[0], -1).T).T)
        return torch.from_numpy(found).to(maps.dtype)

    def spread(self, points: Tensor, weights: Tensor) -> Tensor:
        """Return the adjoint of :meth:`power`, (n_map, n_y, n_x)."""
        values = as_array(weights).astype(np.float64)
        matrix = self._matrix(points, values.shape[0])
        if matrix is None:
            found = self.integrator(points, values.shape[0]).spread(values)
        else:
            found = np.ascontiguousarray((matrix.T @ values.T).T).reshape(-1, *self.grid.shape)
        return torch.from_numpy(found).to(weights.dtype)

    def moments(self, points: Tensor) -> EdgeMoments:
        """Return the operator of the moments along edges."""
        xy_um, edges = as_array(points).astype(np.float64)[self.outlines.vertex], self.outlines.edges
        return EdgeMoments(self.grid, xy_um[edges.begin], xy_um[edges.end], self.order, self.n_threads)

    @property
    def edge_points(self) -> tuple[Tensor, Tensor]:
        """Points at the ends of the edges."""
        vertex, edges = self.outlines.vertex, self.outlines.edges
        return torch.from_numpy(vertex[edges.begin]), torch.from_numpy(vertex[edges.end])

    def edge_weights(self, weights: Tensor) -> Tensor:
        """Return the weight (n_map, n_edge) of each edge: left minus right site."""
        edges = self.outlines.edges
        sign = torch.from_numpy(np.where(edges.is_reversed, -1.0, 1.0)).to(weights.dtype)
        site, edge = torch.from_numpy(np.array(edges.site)), torch.from_numpy(np.array(edges.edge))
        zeros = torch.zeros(weights.shape[0], edges.n_edges, dtype=weights.dtype)
        return zeros.index_add(1, edge, weights[:, site] * sign)

    def contract(self, points: Tensor, moments: Tensor, weights: Tensor) -> Tensor:
        """Return the gradient of ``sum weights * power`` by the points, (n_point, 2)."""
        begin, end = self.edge_points
        along = points[end] - points[begin]
        normal = torch.stack((along[:, 1], -along[:, 0]), dim=1)
        sums = (moments * self.edge_weights(weights).to(moments.dtype)[:, :, None]).sum(dim=0)
        gradient = torch.zeros_like(points).index_add(0, begin, normal * sums[:, 0:1].to(points.dtype))
        return gradient.index_add(0, end, normal * sums[:, 1:2].to(points.dtype))


class _Power(torch.autograd.Function):
    """Integrals of maps over sites, or the adjoint: maps from weights of the sites."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, values: Tensor, integral: Integral, is_adjoint: bool) -> Tensor:
        ctx.save_for_backward(points, values)
        ctx.integral, ctx.is_adjoint = integral, is_adjoint
        return integral.spread(points, values) if is_adjoint else integral.power(points, values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        (gradient,) = gradients
        points, values = ctx.saved_tensors
        of_points = of_values = None
        if ctx.needs_input_grad[0]:
            maps, weights = (gradient, values) if ctx.is_adjoint else (values, gradient)
            of_points = ctx.integral.contract(points, _Moments.apply(points, maps, ctx.integral), weights)
        if ctx.needs_input_grad[1]:
            of_values = _Power.apply(points, gradient, ctx.integral, not ctx.is_adjoint).to(values.dtype)
        return of_points, of_values, None, None


class _Moments(torch.autograd.Function):
    """Moments (n_map, n_edge, 2) of maps along edges."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, maps: Tensor, integral: Integral) -> Tensor:
        ctx.save_for_backward(points, maps)
        ctx.integral = integral
        return torch.from_numpy(integral.moments(points).measure(as_array(maps))).to(maps.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        weights = as_array(gradients[0]).astype(np.float64)
        points, maps = ctx.saved_tensors
        operator = ctx.integral.moments(points)
        of_points = of_maps = None
        if ctx.needs_input_grad[0]:
            begin, end = ctx.integral.edge_points
            of_begin, of_end = operator.differentiate(as_array(maps), weights)
            of_points = torch.zeros_like(points)
            of_points.index_add_(0, begin, torch.from_numpy(np.ascontiguousarray(of_begin)).to(points.dtype))
            of_points.index_add_(0, end, torch.from_numpy(np.ascontiguousarray(of_end)).to(points.dtype))
        if ctx.needs_input_grad[1]:
            of_maps = torch.from_numpy(operator.spread(weights)).to(maps.dtype)
        return of_points, of_maps, None
