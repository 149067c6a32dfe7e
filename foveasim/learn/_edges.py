"""Integrals over sites as sums over edges, in operations of PyTorch for any device."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from foveasim.fields import Grid
from foveasim.learn._tensors import Constants
from foveasim.learn.outlines import Outlines

__all__ = ["integrate_edges"]

#: Number of pieces of edges, times maps, that are computed at once.
MAX_PIECES = 2**23


def integrate_edges(points: Tensor, maps: Tensor, outlines: Outlines, grid: Grid, order: Literal[1, 2]) -> Tensor:
    """
    Integrate maps (n_map, n_y, n_x) over sites, (n_map, n_site).

    In the unit of the maps times µm², with derivatives of any order. By Green's theorem the integral of P over a site is that
    of F dy along its outline, with the integral F of P along x. Within a cell F dy is a polynomial along an edge, so that
    midpoints (order 1) and Simpson's rule (order 2) are exact. An edge that two sites share is integrated once. Derivatives
    are those of these sums: the crossings of edges and cells move, but F is continuous there. Where an edge lies along a
    boundary of cells, the derivative is that of one side.

    Sums along rows are computed with the precision of the points.
    """
    get = partial(outlines.constants.get, like=points)
    origin, pitch = grid.origin_um, grid.pitch_xy_um
    begin, end = (
        (points[get(name)] - points.new_tensor(origin)) / points.new_tensor(pitch)
        for name in ("edge_begin", "edge_end")
    )
    at = _crossings(begin, end, grid)
    n_pieces = at.shape[0] * (at.shape[1] - 1)
    n = max(1, MAX_PIECES // max(1, n_pieces))
    cells = maps.to(points.dtype)
    along = torch.cat([_along(begin, end, at, part, order) for part in cells.split(n)])
    sums = along[:, get("edge")] * get("edge_sign")
    power = along.new_zeros(maps.shape[0], outlines.n_sites).index_add(1, get("site"), sums)
    return (power * grid.cell_area_um2).to(maps.dtype)


def _crossings(begin: Tensor, end: Tensor, grid: Grid) -> Tensor:
    """
    Return where edges begin, meet the boundaries of cells, and end.

    Fractions of the edges (n_edge, n), sorted; 1 for further elements.
    """
    parts = [torch.zeros_like(begin[:, :1]), torch.ones_like(begin[:, :1])]
    for axis, n_cells in ((0, grid.shape[1]), (1, grid.shape[0])):
        a, b = begin[:, axis], end[:, axis]
        low, high = torch.minimum(a, b).detach(), torch.maximum(a, b).detach()
        first = (torch.floor(low) + 1.0).clamp(0.0, n_cells)
        count = torch.ceil(high).clamp(0.0, n_cells + 1.0) - first
        n = max(0, int(count.max())) if count.numel() else 0
        k = torch.arange(n, device=a.device, dtype=a.dtype)
        length = torch.where(b == a, torch.ones_like(a), b - a)
        fraction = (first[:, None] + k - a[:, None]) / length[:, None]
        parts.append(torch.where(k < count[:, None], fraction.clamp(0.0, 1.0), torch.ones_like(fraction)))
    return torch.sort(torch.cat(parts, dim=1), dim=1).values


def _along(begin: Tensor, end: Tensor, at: Tensor, cells: Tensor, order: Literal[1, 2]) -> Tensor:
    """Return the integrals of F dy along edges, (n_map, n_edge), in units of cells."""
    n_y, n_x = cells.shape[-2:]
    step = (end - begin)[:, None, :]
    ends = begin[:, None, :] + at[:, :, None] * step
    low, high = ends[:, :-1], ends[:, 1:]
    centre = (0.5 * (low + high)).detach()
    column = torch.floor(centre[..., 0]).clamp(0, n_x - 1).long()
    row = torch.floor(centre[..., 1]).long()
    is_inside = (row >= 0) & (row < n_y)
    row = row.clamp(0, n_y - 1)
    index = row * n_x + column
    width = torch.where(is_inside, high[..., 1] - low[..., 1], torch.zeros_like(high[..., 1]))

    def gathered(values: Tensor) -> Tensor:
        return values.flatten(-2)[:, index]

    before = _before(cells)
    inner, left = gathered(cells), gathered(before)
    if order == 1:
        u = (0.5 * (low + high))[..., 0].clamp(0.0, n_x) - column
        return ((left + inner * u) * width).sum(dim=-1)
    slope_x, slope_y = (_gradient(cells, axis) for axis in (-1, -2))
    of_x, of_y, left_y = gathered(slope_x), gathered(slope_y), gathered(_before(slope_y))

    def antiderivative(position: Tensor) -> Tensor:
        u, v = position[..., 0].clamp(0.0, n_x) - column, position[..., 1] - row - 0.5
        return left + left_y * v + u * (inner + of_y * v) + 0.5 * of_x * (u * u - u)

    total = antiderivative(low) + 4.0 * antiderivative(0.5 * (low + high)) + antiderivative(high)
    return (total * (width / 6.0)).sum(dim=-1)


def _before(cells: Tensor) -> Tensor:
    """Return the sums of the cells to the left of each cell."""
    return torch.cumsum(cells, dim=-1) - cells


def _gradient(cells: Tensor, axis: int) -> Tensor:
    """Return the gradient of cells along an axis, as :class:`foveasim.Integrator`."""
    n = cells.shape[axis]
    index = np.arange(n)
    ahead, behind = np.minimum(index + 1, n - 1), np.maximum(index - 1, 0)
    constants = Constants(ahead=ahead, behind=behind)
    upper, lower = (cells.index_select(axis, constants.get(name, cells)) for name in ("ahead", "behind"))
    distance = torch.from_numpy(np.maximum(ahead - behind, 1.0)).to(cells)
    return (upper - lower) / (distance if axis == -1 else distance[:, None])
