"""Which line each photosite is read through, and in which order."""

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
    The layout read through lines that a column numbers: ``column``, ``row``, ``sector`` (spokes), ``ring``.

    Parameters
    ----------
    layout : Layout
    column : str
        Name of a column of integers from 0.

    Returns
    -------
    Layout
        With the column ``readout_line``, and the lines' order of sites in ``readout_order`` (see :func:`readout_order`).

    Raises
    ------
    ParameterError
        When the layout has no such column.
    """
    return readout_order(layout.with_columns(readout_line=layout.index_column(column)))


def nearest_bus(layout: Layout, buses: Sequence[Any]) -> Layout:
    """
    The layout with every site read through the bus that its centre is nearest to.

    Parameters
    ----------
    layout : Layout
    buses : sequence of shapely geometries, µm
        Usually LineStrings; bus k is readout line k. Of two equally near ones the first is taken.

    Returns
    -------
    Layout
        With the columns ``readout_line`` and ``readout_order``.

    Raises
    ------
    ParameterError
        When there is no bus, or one is no geometry.
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
    The layout with the order in which each line reads its sites: from the bottom, and from the left where level.

    Parameters
    ----------
    layout : Layout

    Returns
    -------
    Layout
        With the column ``readout_order``, numbered from 0 in each ``readout_line``: lines are read side by side.
    """
    line = layout.readout_line
    order = np.lexsort((layout.centroid_um[:, 0], layout.centroid_um[:, 1], line))
    counts = np.bincount(line) if line.size else np.zeros(0, np.int64)
    position = np.empty(layout.n_sites, np.int64)
    position[order] = positions_in_runs(counts)
    return layout.with_columns(readout_order=position)
