"""Layouts whose neighbours share vertices, as PyTorch modules."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from foveasim._core.validation import Bools, Floats, Ints
from foveasim.layout import Layout
from foveasim.learn._tensors import constant, shorten_steps
from foveasim.learn.outlines import Outlines

__all__ = ["Mesh"]

#: Turning angle (rad) up to which a vertex of the boundary is not a corner.
STRAIGHT_RAD = 1e-6
#: Edges below this length count as points without a direction.
MIN_EDGE_UM = 1e-9


class Mesh(nn.Module):
    """
    Layout with movable vertices, which neighbours share: no gaps and no overlaps arise.

    Parameters
    ----------
    layout : Layout
        Initial positions. Vertices on an edge of a neighbour are inserted there.
    boundary : {"fixed", "sliding", "free"}
        Vertices on the boundary of the layout (on edges of a single site) do not move, move along straight parts of the
        boundary, or move as all others. Fixed and sliding boundaries conserve the area of the layout.

    Attributes
    ----------
    displacement_um : torch.nn.Parameter (n_free,) float64, µm
        One coordinate per vertex and direction in which it moves; initially 0.
    outlines : Outlines
        Topology.

    Examples
    --------
    >>> import foveasim as fs
    >>> mesh = Mesh(fs.layout.grid(2, 2, 1.0), boundary="sliding")
    >>> mesh.n_points, mesh.displacement_um.shape
    (9, torch.Size([6]))
    >>> mesh.layout().n_sites
    4
    """

    initial_um: Tensor
    _point: Tensor
    _direction: Tensor
    _previous_um: Tensor

    def __init__(self, layout: Layout, boundary: Literal["fixed", "sliding", "free"] = "fixed") -> None:
        super().__init__()
        self.outlines: Outlines
        self.outlines, points_um = Outlines.from_layout(layout)
        point, direction = _degrees_of_freedom(self.outlines, points_um, boundary)
        self.register_buffer("initial_um", constant(points_um))
        self.register_buffer("_point", torch.from_numpy(point))
        self.register_buffer("_direction", constant(direction))
        self.displacement_um = nn.Parameter(torch.zeros(point.size, dtype=torch.float64))
        self.register_buffer("_previous_um", torch.zeros(point.size, dtype=torch.float64), persistent=False)

    def __repr__(self) -> str:
        return (
            f"Mesh({self.outlines.n_sites} sites, {self.n_points} points, {self.displacement_um.numel()} coordinates)"
        )

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.outlines.n_points

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.outlines.n_sites

    def forward(self) -> Tensor:
        """Return the positions of all points, (n_point, 2) float64 tensor, µm."""
        return self.initial_um.index_add(0, self._point, self.displacement_um[:, None] * self._direction)

    def area_um2(self) -> Tensor:
        """Return the area of each site, (n_site,) tensor, µm²."""
        return self.outlines.area_um2(self())

    def layout(self) -> Layout:
        """
        Return the layout at the current positions, with the columns of the initial one.

        Raises
        ------
        GeometryError
            When an outline intersects itself; the message specifies the site.
        """
        with torch.no_grad():
            return self.outlines.layout(self(), "moved vertices of a mesh")

    def invalid_sites(self) -> Ints:
        """Return the indices of sites with self-intersecting or clockwise outlines."""
        with torch.no_grad():
            return self.outlines.invalid_sites(self())

    @torch.no_grad()
    def limit_step(self) -> float:
        """
        Shorten the last step of an optimiser such that all outlines stay valid.

        The step is the displacement since the previous call, or since the mesh was created. Only vertices of invalid sites
        and their coordinates are affected: their steps are halved until the sites are valid, and cancelled after 8 times.

        Returns
        -------
        fraction : float
            Smallest fraction of its step that a coordinate was moved; 1 if the complete step was valid.

        Examples
        --------
        ::

            loss.backward()
            optimiser.step()
            mesh.limit_step()
        """

        def find_invalid(displacement_um: Tensor) -> Tensor | None:
            self.displacement_um.copy_(displacement_um)
            invalid = self.invalid_sites()
            return torch.from_numpy(self._touches(invalid))[self._point] if invalid.size else None

        fraction = shorten_steps(self._previous_um, self.displacement_um.detach().clone(), find_invalid)
        self._previous_um.copy_(self.displacement_um)
        return float(fraction.min()) if fraction.numel() else 1.0

    def _touches(self, sites: Ints) -> Bools:
        """Return whether each point is a vertex of one of the sites, (n_point,)."""
        is_vertex = np.zeros(self.n_points, bool)
        is_vertex[self.outlines.vertex[np.isin(self.outlines.edges.site, sites)]] = True
        return is_vertex


def _degrees_of_freedom(outlines: Outlines, points_um: Floats, boundary: str) -> tuple[Ints, Floats]:
    """Return the point and direction of each coordinate, (n_free,) and (n_free, 2)."""
    edges = outlines.edges
    is_outer = np.bincount(edges.edge, minlength=edges.n_edges) == 1
    outer_vertex = np.flatnonzero(is_outer[edges.edge])
    begin, end = outlines.vertex[outer_vertex], outlines.vertex[edges.after[outer_vertex]]
    is_boundary = np.zeros(points_um.shape[0], bool)
    is_boundary[begin] = is_boundary[end] = True
    free = np.arange(points_um.shape[0]) if boundary == "free" else np.flatnonzero(~is_boundary)
    point = np.repeat(free, 2)
    direction = np.tile(np.eye(2), (free.size, 1))
    if boundary == "sliding":
        sliding, along = _straight_points(points_um, begin, end)
        point, direction = np.concatenate((point, sliding)), np.concatenate((direction, along))
    return point, direction


def _straight_points(points_um: Floats, begin: Ints, end: Ints) -> tuple[Ints, Floats]:
    """Return the boundary points between collinear edges, and their directions."""
    n = points_um.shape[0]
    is_simple = (np.bincount(begin, minlength=n) == 1) & (np.bincount(end, minlength=n) == 1)
    step = points_um[end] - points_um[begin]
    unit = step / np.maximum(np.hypot(*step.T), MIN_EDGE_UM)[:, np.newaxis]
    leaving, arriving = np.zeros((n, 2)), np.zeros((n, 2))
    leaving[begin], arriving[end] = unit, unit
    turn = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
    is_ahead = (arriving * leaving).sum(axis=1) > 0.0
    sliding = np.flatnonzero(is_simple & is_ahead & (np.abs(turn) <= STRAIGHT_RAD))
    return sliding, leaving[sliding]
