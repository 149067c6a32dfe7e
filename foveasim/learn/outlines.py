"""Outlines of sites between shared points, whose positions are variables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from torch import Tensor

from foveasim._core.rings import positions_in_runs
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, Ints, read_only
from foveasim.errors import GeometryError, ParameterError
from foveasim.integrate import SharedEdges
from foveasim.layout import Layout, node
from foveasim.layout._noding import merge_coincident_points
from foveasim.learn._tensors import Constants, as_array, check_tensor

__all__ = ["Outlines"]


@dataclass(frozen=True, eq=False)
class Outlines:
    """
    Topology of outlines: which points are the vertices of which sites.

    Parameters
    ----------
    vertex : (n_vertex,) int64
        Point at each vertex of the packed rings.
    ring_offsets, site_offsets : (n_ring + 1,), (n_site + 1,) int64
        As those of a :class:`foveasim.Layout`.
    columns : mapping of str to (n_site,) array
        Data per site.
    provenance : mapping
        Origin of the layout.
    n_points : int
        Number of points; by default those that are vertices.
    """

    vertex: Ints
    ring_offsets: Ints
    site_offsets: Ints
    columns: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    n_points: int = -1

    def __post_init__(self) -> None:
        if self.n_points < 0:
            object.__setattr__(self, "n_points", int(self.vertex.max(initial=-1)) + 1)

    @classmethod
    def from_layout(cls, layout: Layout) -> tuple[Outlines, Floats]:
        """
        Return the topology of a layout, and the positions of its points.

        Vertices of neighbours at the same position, within 1e-6 µm, become one point. Vertices on an edge of a neighbour are
        inserted there first (:func:`foveasim.layout.node`), so that displacements open no gaps.

        Returns
        -------
        outlines : Outlines
        points_um : (n_point, 2) float64, µm

        Raises
        ------
        ParameterError
            When the layout has no sites.
        """
        if not layout.n_sites:
            raise ParameterError("layout", "must have at least one site", layout)
        noded = node(layout)
        points_um, vertex = merge_coincident_points(noded.xy_um)
        outlines = cls(
            read_only(vertex.astype(np.int64)),
            noded.ring_offsets,
            noded.site_offsets,
            layout.columns,
            layout.provenance,
        )
        return outlines, points_um

    def __repr__(self) -> str:
        return f"Outlines({self.n_sites} sites, {self.n_points} points)"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.site_offsets.size - 1

    @cached_property
    def edges(self) -> SharedEdges:
        """Edges between the points, each shared edge once."""
        return SharedEdges(self.ring_offsets, self.site_offsets, self.vertex)

    @cached_property
    def constants(self) -> Constants:
        """Indices of vertices and edges, as tensors of any device."""
        edges = self.edges
        begin, end = self.vertex[edges.begin], self.vertex[edges.end]
        return Constants(
            vertex=self.vertex, after=edges.after, site=edges.site, edge=edges.edge,
            edge_begin=begin, edge_end=end, edge_sign=np.where(edges.is_reversed, -1.0, 1.0),
        )  # fmt: skip

    def vertices(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the positions of all vertices, and of the next one in each ring."""
        begin = points[self.constants.get("vertex", points)]
        return begin, begin[self.constants.get("after", points)]

    def area_um2(self, points: Tensor) -> Tensor:
        """
        Compute the signed area of each site.

        Parameters
        ----------
        points : (n_point, 2) tensor, µm

        Returns
        -------
        area : (n_site,) tensor, µm²
            Shoelace formula; negative for clockwise outlines. Its gradient is exact.
        """
        points = self.check_points(points)
        begin, end = self.vertices(points)
        twice = begin[:, 0] * end[:, 1] - begin[:, 1] * end[:, 0]
        return points.new_zeros(self.n_sites).index_add(0, self.constants.get("site", points), 0.5 * twice)

    def check_points(self, points: object) -> Tensor:
        """Return positions, (n_point, 2), if they are a valid tensor."""
        return check_tensor("points", points, (self.n_points, 2), ", one row per point", any_device=True)

    def layout(self, points: Tensor, step: str = "moved vertices") -> Layout:
        """
        Return the layout with the points at given positions.

        Parameters
        ----------
        points : (n_point, 2) tensor, µm
        step : str
            Entry of the provenance.

        Returns
        -------
        Layout
            With the columns of the original layout.

        Raises
        ------
        GeometryError
            When an outline intersects itself or is clockwise; ``.site_ids`` and the message specify the sites.
        """
        invalid = self.invalid_sites(points)
        if invalid.size:
            raise GeometryError(
                f"the outline of site {invalid[0]} must be counter-clockwise without intersections; use Mesh.limit_step",
                tuple(invalid.tolist()),
            )
        rings = as_array(points).astype(np.float64)[self.vertex], self.ring_offsets, self.site_offsets
        steps = [*self.provenance.get("steps", ()), step]
        columns: dict[str, Any] = dict(self.columns)
        layout = Layout.from_polygons(rings, **columns)
        return layout.with_provenance({**self.provenance, "steps": steps})

    def invalid_sites(self, points: Tensor) -> Ints:
        """
        Return the indices of sites with self-intersecting or clockwise outlines.

        If the outlines of a tiling with a fixed boundary are all valid, no two sites overlap.
        """
        points = self.check_points(points)
        xy_um = as_array(points)[self.vertex]
        rings = shapely.linearrings(
            xy_um, indices=np.repeat(np.arange(self.ring_offsets.size - 1), np.diff(self.ring_offsets))
        )
        sites = np.repeat(np.arange(self.n_sites), np.diff(self.site_offsets))
        polygons = shapely.polygons(rings, indices=sites)
        return np.flatnonzero(~shapely.is_valid(polygons) | (as_array(self.area_um2(points)) <= 0.0))

    def select(self, sites: Ints) -> Outlines:
        """Return the outlines of some of the sites, with the same points."""
        n_rings, n_vertices = np.diff(self.site_offsets), np.diff(self.ring_offsets)
        ring = np.repeat(self.site_offsets[:-1][sites], n_rings[sites]) + positions_in_runs(n_rings[sites])
        vertex = np.repeat(self.ring_offsets[:-1][ring], n_vertices[ring]) + positions_in_runs(n_vertices[ring])
        columns = {name: values[sites] for name, values in self.columns.items()}
        return Outlines(
            self.vertex[vertex],
            np.concatenate(([0], np.cumsum(n_vertices[ring]))),
            np.concatenate(([0], np.cumsum(n_rings[sites]))),
            columns,
            self.provenance,
            self.n_points,
        )

    def subdivide(self, n_pieces: Ints) -> tuple[Outlines, Subdivision]:
        """
        Divide edges into equal pieces.

        Parameters
        ----------
        n_pieces : (n_edge,) int
            Number of pieces of each edge of :attr:`edges`.

        Returns
        -------
        outlines : Outlines
        subdivision : Subdivision
            Map from the points of these outlines to those of the result.
        """
        edges = self.edges
        begin, end = self.vertex[edges.begin], self.vertex[edges.end]
        n_inner = n_pieces - 1
        edge = np.repeat(np.arange(edges.n_edges), n_inner)
        k = positions_in_runs(n_inner) + 1
        identity = np.arange(self.n_points)
        subdivision = Subdivision(
            np.concatenate((identity, begin[edge])),
            np.concatenate((identity, end[edge])),
            np.concatenate((np.zeros(self.n_points), k / n_pieces[edge])),
        )
        # Every vertex is followed by the inner points of its edge, in the direction of its ring.
        first_inner = self.n_points + np.cumsum(n_inner) - n_inner
        length = n_pieces[edges.edge]
        position = positions_in_runs(length)
        of_edge, is_reversed = np.repeat(edges.edge, length), np.repeat(edges.is_reversed, length)
        inner = first_inner[of_edge] + np.where(is_reversed, n_pieces[of_edge] - 1 - position, position - 1)
        vertex = np.where(position == 0, np.repeat(self.vertex, length), inner)
        ring_offsets = np.concatenate(([0], np.cumsum(length)))[self.ring_offsets]
        return Outlines(vertex, ring_offsets, self.site_offsets, self.columns, self.provenance), subdivision


@dataclass(frozen=True, eq=False)
class Subdivision:
    """Positions of the points of subdivided edges, as linear functions of their end points."""

    begin: Ints
    end: Ints
    fraction: Floats

    @cached_property
    def _constants(self) -> Constants:
        return Constants(begin=self.begin, end=self.end, fraction=self.fraction)

    def __call__(self, points: Tensor) -> Tensor:
        """Return the positions (n, 2) for positions of the end points."""
        begin, end = (points[self._constants.get(name, points)] for name in ("begin", "end"))
        t = self._constants.get("fraction", points)[:, None]
        return (1.0 - t) * begin + t * end
