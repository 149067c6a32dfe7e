"""Voronoi cells of given points: the photosites nearest to each."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, check_sites, finite_array
from foveasim.errors import ParameterError
from foveasim.layout._regions import parse_region
from foveasim.layout.diagrams.voronoi import SeparatedParts, clipped_cells
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.model import Layout, layout_of

__all__ = ["voronoi_of"]

#: Number of points that the provenance contains.
MAX_RECORDED = 1000


@layout_generator(
    has_mosaic=False,
    example={
        "points_um": [[-8.0, -6.0], [5.0, -7.0], [-2.0, 1.0], [7.0, 4.0], [-7.0, 8.0]],
        "size_um": (24.0, 20.0),
    },
)
def voronoi_of(
    points_um: ArrayLike,
    *,
    size_um: tuple[float, float] | None = None,
    radius_um: float | None = None,
    region: Any = None,
    parts: SeparatedParts = "error",
) -> Layout:
    """
    Generate the Voronoi cells of given points: cell k is the area nearest to point k.

    ::

        ┌───────╮──────────┐  ─┬─
        │   · 0  ╲   · 2   │   │
        ├──╮      ╲_____╱──┤   │            · 1: point 1, and its cell 1
        │   ╲_____╱        │   │ size_um[1]
        │ · 1  │     · 3   │   │
        └──────┴───────────┘  ─┴─
        ├──────────────────┤
               size_um[0]

    Parameters
    ----------
    points_um : (n, 2), µm
        Distinct points in the region or on its boundary, such as positions of cones.
    size_um : (width, height), µm, optional
        Rectangular region around the optical axis, such as the ``size_um`` of an optical format.
    radius_um : float, µm, optional
        Radius of a disc around the optical axis.
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm, optional
        Any other region, convex or concave, with holes or several parts.
    parts : {"error", "neighbour"}
        Concave regions can separate a part of a cell from its point, and a site is one polygon: this is an error, or the part
        is added to the cell with which it shares the longest boundary.

    Returns
    -------
    Layout
        One site per point, in the order of the points. Sites share all edges and corners exactly, and their areas add up to
        that of the region.

    Raises
    ------
    ParameterError
        When a point lies outside the region or equals another one, or not exactly one region is specified.
    GeometryError
        When a cell has several parts in the region, or points are too close together for float64.

    Examples
    --------
    >>> layout = voronoi_of([(-3.0, 0.0), (1.0, 0.0)], size_um=(10.0, 4.0))
    >>> layout.area_um2.tolist()
    [16.0, 24.0]
    """
    outline = parse_region(size_um=size_um, radius_um=radius_um, region=region)
    points = _points(points_um, outline)
    rings = clipped_cells(points, outline, separated=parts)
    recorded = points.tolist() if points.shape[0] <= MAX_RECORDED else f"{points.shape[0]} points"
    outlines = None if region is None else outline.wkt
    return layout_of(*rings, provenance={"parameters": {"points_um": recorded, "region": outlines}})


def _points(points_um: ArrayLike, region: Any) -> Floats:
    """Return distinct points of a region."""
    points = finite_array("points_um", points_um, ndim=2)
    if points.shape[1] != 2 or points.shape[0] == 0:
        raise ParameterError("points_um", f"must have the shape (n, 2) with n >= 1, got {points.shape}")
    check_sites(points.shape[0])
    shapely.prepare(region)
    outside = np.flatnonzero(~shapely.intersects_xy(region, points))
    if outside.size:
        raise ParameterError(
            f"points_um[{outside[0]}]",
            "must lie in the region" + f" (also {outside.size - 1} others)" * (outside.size > 1),
            points[outside[0]].tolist(),
            "µm",
            hint="omit points outside, or enlarge the region",
        )
    _, index, count = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    if (count > 1).any():
        repeated = np.flatnonzero(count[index.ravel()] > 1)
        one = int(repeated[0])
        other = int(np.flatnonzero(index.ravel() == index.ravel()[one])[1])
        raise ParameterError(
            f"points_um[{other}]",
            f"must differ from point {one}, as each point has a cell of its own",
            points[other].tolist(),
            "µm",
            hint="omit repeated points: numpy.unique(points, axis=0)",
        )
    return np.ascontiguousarray(points)
