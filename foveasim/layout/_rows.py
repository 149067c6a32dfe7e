"""Rows and columns of photosites, from the columns of a layout or from a lattice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Ints
from foveasim.layout.model import Layout

#: Column of the position along each axis, x and y.
POSITION_COLUMNS = ("column", "row")
#: Largest displacement of a site from its position on a lattice, as a fraction of the pitch.
LATTICE_TOLERANCE = 0.05


def site_rows(layout: Layout, axis: int = 1) -> NDArray[np.integer] | None:
    """
    Return the row (axis 1) or the column (axis 0) of each site, (n_site,), None without rows.

    Rows have ascending y and columns ascending x, from 0. They are those of the column ``row`` or ``column`` of the layout, if
    all sites of a row are above those of the previous one, or positions on a lattice.
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
    """Return whether the positions of each index are above those of the previous one, and within a site's side."""
    order = np.argsort(index, kind="stable")
    starts = np.flatnonzero(np.diff(index[order], prepend=index.min() - 1))
    sorted_um = position_um[order]
    lowest_um, highest_um = (f.reduceat(sorted_um, starts) for f in (np.minimum, np.maximum))
    return bool(np.all(lowest_um[1:] > highest_um[:-1]) and np.all(highest_um - lowest_um <= side_um))


def lattice_index(layout: Layout, axis: int) -> Ints | None:
    """Return the indices of sites along an axis, (n_site,), or None where the pitch is not constant."""
    position_um, bounds_um = layout.centroid_um[:, axis], layout.site_bounds_um
    side_um = float((bounds_um[:, axis + 2] - bounds_um[:, axis]).min(initial=np.inf))
    order = np.argsort(position_um)
    index = np.zeros(order.size, np.int64)
    index[order[1:]] = np.cumsum(np.diff(position_um[order]) > 0.5 * side_um)
    mean_um = np.bincount(index, position_um) / np.bincount(index)
    pitch_um = (mean_um[-1] - mean_um[0]) / (mean_um.size - 1) if mean_um.size > 1 else side_um
    is_regular = np.abs(position_um - mean_um[0] - index * pitch_um) <= LATTICE_TOLERANCE * pitch_um
    return index if is_regular.all() else None
