"""Readout lines of photosites, and the order in which their exposures begin and end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from foveasim._core.rings import positions_in_runs
from foveasim.errors import ParameterError
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.model import Layout
from foveasim.layout.rows import POSITION_COLUMNS, Scan, scan_axis, scan_index, site_rows

__all__ = ["Scan", "nearest_bus", "readout_by", "readout_order"]


@layout_edit(example={"scan": "rows_from_top"})
def readout_by(layout: Layout, column: str | None = None, *, scan: Scan = "rows_from_top") -> Layout:
    """
    Assign readout lines by a column, and the order of a rolling shutter.

    Parameters
    ----------
    layout : Layout
    column : str, optional
        Name of a column of integers >= 0, the indices of the lines that share a readout circuit: ``column``, ``row``,
        ``sector`` or ``ring``. By default ``column`` for a scan of rows and ``row`` for a scan of columns; without it, the
        lines do not change.
    scan : {"rows_from_top", "rows_from_bottom", "columns_from_left", "columns_from_right"}
        What is read first, in the upright picture: y points up. Cameras read the top row first.

    Returns
    -------
    Layout
        With the columns ``readout_line`` and ``readout_order``. If the layout has rows (or columns), the order is their
        number in the scan: all sites of a row are read at once. Otherwise the order is that of the sites on each line of
        the given ``column`` (:func:`readout_order`), or that of strips with the mean distance of sites as their width.

    Raises
    ------
    ParameterError
        When the layout has no such column.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.readout_by(
    ...     fs.layout.grid(n_x=3, n_y=2, pitch_um=2.0)
    ... )  # row 0 is the lowest
    >>> layout.readout_line.tolist(), layout.columns["readout_order"].tolist()
    ([0, 1, 2, 0, 1, 2], [1, 1, 1, 0, 0, 0])
    """
    axis = scan_axis(scan)
    across = POSITION_COLUMNS[1 - axis]
    lines = column if column is not None else across if across in layout.columns else None
    if lines is not None:
        layout = layout.with_columns(readout_line=layout.index_column(lines))
    if column not in (None, *POSITION_COLUMNS) or (column is not None and site_rows(layout, axis) is None):
        return readout_order(layout, scan=scan)
    return layout.with_columns(readout_order=scan_index(layout, scan))


def nearest_bus(layout: Layout, buses: Sequence[Any], *, scan: Scan = "rows_from_top") -> Layout:
    """
    Assign each site to the readout bus nearest to its centroid.

    Parameters
    ----------
    layout : Layout
    buses : sequence of shapely geometries, µm
        Usually LineStrings; bus k is readout line k. At equal distances the first bus is taken.
    scan : str
        Order of the sites of each bus: :func:`readout_order`.

    Returns
    -------
    Layout
        With the columns ``readout_line`` and ``readout_order``: a bus reads its sites one after the other.

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
    return readout_order(layout.with_columns(readout_line=nearest), scan=scan)


def readout_order(layout: Layout, *, scan: Scan = "rows_from_top") -> Layout:
    """
    Order the sites of each readout line, the highest first by default.

    Parameters
    ----------
    layout : Layout
    scan : {"rows_from_top", "rows_from_bottom", "columns_from_left", "columns_from_right"}
        Which site of a line is read first, in the upright picture. At equal heights it is the leftmost one, in equal columns
        the highest.

    Returns
    -------
    Layout
        With the column ``readout_order``, counted from 0 in each ``readout_line``: lines are read in parallel, and each line
        reads one site at a time.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=3, n_y=2, pitch_um=2.0)  # a line is a column
    >>> fs.layout.readout_order(layout).columns["readout_order"].tolist()
    [1, 1, 1, 0, 0, 0]
    """
    line, (x_um, y_um) = layout.readout_line, layout.centroid_um.T
    keys = (x_um, y_um if scan == "rows_from_bottom" else -y_um)
    if scan_axis(scan) == 0:
        keys = (-y_um, x_um if scan == "columns_from_left" else -x_um)
    order = np.lexsort((*keys, line))
    counts = np.bincount(line) if line.size else np.zeros(0, np.int64)
    position = np.empty(layout.n_sites, np.int64)
    position[order] = positions_in_runs(counts)
    return layout.with_columns(readout_order=position)
