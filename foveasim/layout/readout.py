"""Readout lines of photosites, and the readout order along each line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from foveasim._core.rings import positions_in_runs
from foveasim.errors import ParameterError
from foveasim.layout.model import Layout

__all__ = ["nearest_bus", "readout_by", "readout_order"]


def readout_by(layout: Layout, column: str) -> Layout:
    """
    Assign readout lines by a column: ``column``, ``row``, ``sector`` or ``ring``.

    Parameters
    ----------
    layout : Layout
    column : str
        Name of a column of integers >= 0, the indices of the lines.

    Returns
    -------
    Layout
        With the columns ``readout_line`` and ``readout_order`` (see :func:`readout_order`).

    Raises
    ------
    ParameterError
        When the layout has no such column.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.readout_by(fs.layout.grid(n_x=3, n_y=2, pitch_um=2.0), "row").readout_line.tolist()
    [0, 0, 0, 1, 1, 1]
    """
    return readout_order(layout.with_columns(readout_line=layout.index_column(column)))


def nearest_bus(layout: Layout, buses: Sequence[Any]) -> Layout:
    """
    Assign each site to the readout bus nearest to its centroid.

    Parameters
    ----------
    layout : Layout
    buses : sequence of shapely geometries, µm
        Usually LineStrings; bus k is readout line k. At equal distances the first bus is taken.

    Returns
    -------
    Layout
        With the columns ``readout_line`` and ``readout_order``.

    Raises
    ------
    ParameterError
        When there is no bus, or one is not a geometry.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=4, n_y=1, pitch_um=2.0)
    >>> import shapely
    >>> buses = [shapely.LineString([(x_um, -5.0), (x_um, 5.0)]) for x_um in (-3.0, 3.0)]
    >>> fs.layout.nearest_bus(layout, buses).readout_line.tolist()
    [0, 0, 1, 1]
    """
    lines = list(buses) if isinstance(buses, Sequence | np.ndarray) else []
    if not lines or not all(isinstance(line, shapely.Geometry) and not line.is_empty for line in lines):
        raise ParameterError("buses", "must be one or more shapely geometries", buses)
    site, bus = shapely.STRtree(lines).query_nearest(shapely.points(layout.centroid_um))
    nearest = np.full(layout.n_sites, len(lines), np.int64)
    np.minimum.at(nearest, site, bus)
    return readout_order(layout.with_columns(readout_line=nearest))


def readout_order(layout: Layout) -> Layout:
    """
    Order the sites of each readout line by y, and by x where y is equal.

    Parameters
    ----------
    layout : Layout

    Returns
    -------
    Layout
        With the column ``readout_order``, counted from 0 in each ``readout_line``: lines are read in parallel.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.readout_by(fs.layout.grid(n_x=3, n_y=2, pitch_um=2.0), "column")
    >>> fs.layout.readout_order(layout).columns["readout_order"].tolist()
    [0, 0, 0, 1, 1, 1]
    """
    line = layout.readout_line
    order = np.lexsort((layout.centroid_um[:, 0], layout.centroid_um[:, 1], line))
    counts = np.bincount(line) if line.size else np.zeros(0, np.int64)
    position = np.empty(layout.n_sites, np.int64)
    position[order] = positions_in_runs(counts)
    return layout.with_columns(readout_order=position)
