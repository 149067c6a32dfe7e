"""
Rows and columns of photosites, and the order in which they are read.

The top is that of the upright picture, the highest y: the optical image is inverted, so that this edge of the sensor is the
lower one in a camera that is held upright.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Ints
from foveasim.layout.model import Layout

__all__ = ["POSITION_COLUMNS", "Scan", "lattice_index", "scan_axis", "scan_index", "site_rows"]

#: Order of the rows or columns of a sensor, in the upright picture.
Scan = Literal["rows_from_top", "rows_from_bottom", "columns_from_left", "columns_from_right"]
#: Column of the position along each axis, x and y.
POSITION_COLUMNS = ("column", "row")
#: Largest displacement of a site from its position on a lattice, as a fraction of the pitch.
LATTICE_TOLERANCE = 0.05


def scan_index(layout: Layout, scan: Scan) -> Ints:
    """
    Return the number of the row or column of each site in a scan, (n_site,), from 0.

    Without rows and columns, these are strips with the mean distance of sites as their width.
    """
    axis = scan_axis(scan)
    rows = site_rows(layout, axis)
    index = None if rows is None else rows.astype(np.int64)
    if index is None:
        bounds_um = layout.site_bounds_um
        low_um, high_um = bounds_um[:, :2].min(axis=0), bounds_um[:, 2:].max(axis=0)
        pitch_um = math.sqrt(float(np.prod(high_um - low_um)) / layout.n_sites)
        index = np.floor((layout.centroid_um[:, axis] - low_um[axis]) / pitch_um).astype(np.int64)
    if scan in ("rows_from_top", "columns_from_right"):
        index = -index
    return np.asarray(index - index.min(initial=np.iinfo(np.int64).max), np.int64)


def scan_axis(scan: Scan) -> int:
    """Return the axis of a scan: 0 for columns, 1 for rows."""
    return 1 if scan.startswith("rows") else 0


def site_rows(layout: Layout, axis: int = 1) -> NDArray[np.integer] | None:
    """
    Return the row (axis 1) or the column (axis 0) of each site, or None without rows.

    Shape (n_site,); rows have ascending y and columns ascending x, from 0. They are those of the column ``row`` or ``column``
    of the layout, if all sites of a row are above those of the previous one, or positions on a lattice.
    """
    if not layout.n_sites:
        return np.zeros(0, np.int64)
    numbers = layout.columns.get(POSITION_COLUMNS[axis])
    if numbers is not None and numbers.dtype.kind in "iu":
        if layout.lattice is not None and np.array_equal(numbers, _lattice_rows(layout.lattice.shape, axis)):
            return numbers  # without a sort of a dense sensor
        position_um, bounds_um = layout.centroid_um[:, axis], layout.site_bounds_um
        side_um = float((bounds_um[:, axis + 2] - bounds_um[:, axis]).max())
        integers = numbers.astype(np.int64)
        for sign in (1, -1):
            if _is_ordered(sign * integers, position_um, side_um):
                return np.asarray(sign * integers - (sign * integers).min())
    return lattice_index(layout, axis)


def _lattice_rows(shape: tuple[int, int], axis: int) -> NDArray[np.integer]:
    """Return the row or column of each site of a lattice in the order of its sites."""
    rows, columns = (np.arange(n, dtype=np.int32) for n in shape)
    return np.repeat(rows, shape[1]) if axis else np.tile(columns, shape[0])


def _is_ordered(index: Ints, position_um: Floats, side_um: float) -> bool:
    """Return whether sites of each index are above those before, within one side."""
    order = np.argsort(index, kind="stable")
    starts = np.flatnonzero(np.diff(index[order], prepend=index.min() - 1))
    sorted_um = position_um[order]
    lowest_um, highest_um = (f.reduceat(sorted_um, starts) for f in (np.minimum, np.maximum))
    return bool(np.all(lowest_um[1:] > highest_um[:-1]) and np.all(highest_um - lowest_um <= side_um))


def lattice_index(layout: Layout, axis: int) -> Ints | None:
    """Return the indices of sites along an axis, or None without a constant pitch."""
    position_um, bounds_um = layout.centroid_um[:, axis], layout.site_bounds_um
    side_um = float((bounds_um[:, axis + 2] - bounds_um[:, axis]).min(initial=np.inf))
    order = np.argsort(position_um)
    index = np.zeros(order.size, np.int64)
    index[order[1:]] = np.cumsum(np.diff(position_um[order]) > 0.5 * side_um)
    mean_um = np.bincount(index, position_um) / np.bincount(index)
    pitch_um = (mean_um[-1] - mean_um[0]) / (mean_um.size - 1) if mean_um.size > 1 else side_um
    is_regular = np.abs(position_um - mean_um[0] - index * pitch_um) <= LATTICE_TOLERANCE * pitch_um
    return index if is_regular.all() else None
