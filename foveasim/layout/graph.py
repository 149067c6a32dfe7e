"""Photosites as a graph, in the conventions of PyTorch Geometric."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, check_point, read_only
from foveasim.errors import ParameterError
from foveasim.layout.model import Layout

__all__ = ["Frame", "SiteGraph", "nearest_sites", "to_graph"]

#: Orientation of the local frames of photosites.
Frame = Literal["image", "radial"]
NEIGHBOURS = Limits(at_least=1)


@dataclass(frozen=True, eq=False)
class SiteGraph:
    """
    Graph of photosites.

    Attributes
    ----------
    edge_index : (2, n_edge) int64
        Photosites at the beginning and the end of each edge; edges are sorted by their ends. Neighbours are connected in both
        directions.
    edge_length_um : (n_edge,) float64, µm
        Length of the outline that both sites share; 0 for sites that do not touch.
    offset : (n_edge, 2) float64
        Position of the beginning from the end, in the local frame of the end: in units of its scale, (x, y), or (outwards,
        counter-clockwise) with radial frames.
    position_um : (n_site, 2) float64, µm
        Centroids.
    scale_um : (n_site,) float64, µm
        Square root of the area.

    Examples
    --------
    >>> import foveasim as fs
    >>> graph = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0).to_graph()
    >>> graph.edge_index.tolist(), graph.edge_length_um.tolist()
    ([[1, 0, 2, 1], [0, 1, 1, 2]], [4.0, 4.0, 4.0, 4.0])
    >>> graph.offset.tolist()
    [[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]]
    """

    edge_index: Ints
    edge_length_um: Floats
    offset: Floats
    position_um: Floats
    scale_um: Floats

    __repr__ = short_repr


def to_graph(
    layout: Layout,
    *,
    n_neighbours: Annotated[int | None, NEIGHBOURS] = None,
    frame: Frame = "image",
    centre_um: tuple[float, float] = (0.0, 0.0),
) -> SiteGraph:
    """
    Return the graph of the photosites of a layout.

    Parameters
    ----------
    layout : Layout
    n_neighbours : int, optional
        Number of nearest photosites, by centroids, that each one is connected to; by default those that share an edge with it.
    frame : {"image", "radial"}
        Axes of the local frames: those of the layout, or outwards from the centre and counter-clockwise.
    centre_um : (x, y), µm
        Centre of radial frames.

    Returns
    -------
    SiteGraph
        For PyTorch Geometric: ``Data(edge_index=torch.from_numpy(graph.edge_index), ...)``.

    Raises
    ------
    ParameterError
        When the layout has at most as many photosites as neighbours.
    """
    position_um, scale_um = layout.centroid_um, np.sqrt(layout.area_um2)
    shared = layout.adjacency().tocsr()
    if n_neighbours is None:
        edges = shared.tocoo()
        end, begin = edges.row.astype(np.int64), edges.col.astype(np.int64)
        order = np.lexsort((begin, end))
        begin, end, length_um = begin[order], end[order], edges.data[order]
    else:
        found = nearest_sites(layout, position_um, n_neighbours + 1)
        is_own = found == np.arange(layout.n_sites)[:, np.newaxis]
        # A site that is not among those nearest to itself, as one of several at the same position, loses the farthest.
        is_own[~is_own.any(axis=1), -1] = True
        begin = found[~is_own]
        end = np.repeat(np.arange(layout.n_sites), n_neighbours)
        length_um = np.asarray(shared[end, begin]).ravel()
    centre_um = check_point("centre_um", centre_um)
    offset = local_offsets(position_um[begin] - position_um[end], position_um[end], scale_um[end], frame, centre_um)
    return SiteGraph(
        read_only(np.stack((begin, end))),
        read_only(np.array(length_um)),
        read_only(offset),
        read_only(np.array(position_um)),
        read_only(scale_um),
    )


def nearest_sites(layout: Layout, position_um: Floats, n: int) -> Ints:
    """Return the indices of the sites that are nearest to positions, (n_position, n)."""
    from scipy.spatial import cKDTree

    if n > layout.n_sites:
        raise ParameterError("layout", f"must have at least {n} photosites, got {layout.n_sites}")
    found = cKDTree(layout.centroid_um).query(position_um, k=np.arange(1, n + 1))[1]
    return np.asarray(found, np.int64)


def local_offsets(
    offset_um: Floats, position_um: Floats, scale_um: Floats, frame: Frame, centre_um: tuple[float, float]
) -> Floats:
    """Return offsets (..., 2) from positions in their local frames."""
    scaled: Floats = offset_um / scale_um[..., np.newaxis]
    if frame == "image":
        return scaled
    outwards = position_um - np.array(centre_um)
    radius_um = np.hypot(outwards[..., 0], outwards[..., 1])[..., np.newaxis]
    # The frame of the centre has the axes of the layout.
    is_centre = radius_um <= 1e-9 * scale_um[..., np.newaxis]
    unit = np.where(is_centre, np.array((1.0, 0.0)), outwards / np.where(is_centre, 1.0, radius_um))
    x, y, u, v = scaled[..., 0], scaled[..., 1], unit[..., 0], unit[..., 1]
    return np.stack((x * u + y * v, y * u - x * v), axis=-1)
