"""Addresses of photosites on a raster: columns, and rows from the top."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Ints
from foveasim.errors import ParameterError
from foveasim.layout.lattice import RectangleLattice
from foveasim.layout.model import Layout

#: Addresses in files of event tools are unsigned 16-bit integers.
MAX_ADDRESS = 2**16 - 1
#: Largest table of the addresses of sites.
MAX_PLACES = 1 << 26
#: Relative rounding error of distances between neighbours.
ROUNDING = 1e-9


def count_distinct(x: Ints, y: Ints) -> int:
    """Return the number of different addresses."""
    n_x, n_y = (int(values.max(initial=0)) + 1 for values in (x, y))
    code = y.astype(np.int64) * n_x + x
    if n_x * n_y > MAX_PLACES:
        return int(np.count_nonzero(np.diff(np.sort(code)))) + bool(code.size)
    is_used = np.zeros(n_x * n_y, bool)
    is_used[code] = True
    return int(np.count_nonzero(is_used))


def sites_at(sites: tuple[NDArray[np.uint16], NDArray[np.uint16]], target: tuple[Ints, Ints]) -> NDArray[np.int32]:
    """Return the site at each address, or raise ParameterError if there is not exactly one."""
    n_x, n_y = (int(values.max(initial=0)) + 1 for values in sites)
    code = sites[1].astype(np.int64) * n_x + sites[0]
    # Beyond the addresses of sites, at the last place, there is none.
    n_places = n_x * n_y
    is_inside = (target[0] < n_x) & (target[1] < n_y)
    target_code = np.where(is_inside, target[1] * n_x + target[0], n_places)
    if n_places <= MAX_PLACES:
        n_at = np.bincount(code, minlength=n_places + 1)
        site_at = np.full(n_places + 1, -1, np.int32)
        site_at[code] = np.arange(code.size, dtype=np.int32)
        found, n_found = site_at[target_code], n_at[target_code]
    else:
        order = np.argsort(code, kind="stable")
        first, last = (np.searchsorted(code[order], target_code, side) for side in ("left", "right"))
        n_found = last - first
        found = (
            order[np.minimum(first, max(code.size - 1, 0))].astype(np.int32) if code.size else first.astype(np.int32)
        )
    if np.any(n_found != 1):
        bad = int(np.flatnonzero(n_found != 1)[0])
        address = int(target[0][bad]), int(target[1][bad])
        raise ParameterError(
            "layout", f"must have one site at each address (x, y), got {int(n_found[bad])} at {address}"
        )
    return found


def pixel_grid(shape: tuple[int, int], pitch_um: float) -> Layout:
    """Return square pixels without gaps, as :func:`foveasim.layout.grid`."""
    n_y, n_x = shape
    x_um, y_um = ((np.arange(n)[:, np.newaxis] + np.array([0.0, 1.0]) - 0.5 * n) * pitch_um for n in (n_x, n_y))
    row, column = np.repeat(np.arange(n_y, dtype=np.int32), n_x), np.tile(np.arange(n_x, dtype=np.int32), n_y)
    columns = {"row": row, "column": column, "readout_line": column}
    return Layout.from_lattice(RectangleLattice(x_um, y_um), columns, {"made_by": "pixels of a recording"})


def addresses_from_columns(layout: Layout) -> tuple[Ints, Ints] | None:
    """
    Return column and row of each site from the columns of the layout.

    Returns None if the columns are missing, not aligned with the axes, or not unique.
    """
    centred_um = layout.centroid_um - layout.centroid_um.mean(axis=0) if layout.n_sites else layout.centroid_um
    addresses = []
    for axis, name in enumerate(("column", "row")):
        numbers = layout.columns.get(name)
        if numbers is None or numbers.dtype.kind not in "iu":
            return None
        integers = numbers.astype(np.int64)
        integers -= integers.min(initial=0)
        along, across = (
            float((integers - integers.mean()) @ centred_um[:, a]) if integers.size else 0.0 for a in (axis, 1 - axis)
        )
        if abs(along) < abs(across) or integers.max(initial=0) > MAX_ADDRESS:
            return None
        # Columns count to the right, rows downwards.
        is_reversed = along < 0.0 if axis == 0 else along >= 0.0
        addresses.append(integers.max(initial=0) - integers if is_reversed else integers)
    is_unique = count_distinct(addresses[0], addresses[1]) == layout.n_sites
    return (addresses[0], addresses[1]) if is_unique else None


def addresses_on_raster(layout: Layout, pitch_um: float | None) -> tuple[Ints, Ints]:
    """Return column and row of each centroid on a raster, counted from the top left."""
    from scipy.spatial import cKDTree

    centroid_um = layout.centroid_um
    if layout.n_sites == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    low_um, high_um = centroid_um.min(axis=0), centroid_um.max(axis=0)
    if pitch_um is None:
        # Centroids with a larger distance along either axis are in different columns or rows.
        distance_um = np.asarray(cKDTree(centroid_um).query(centroid_um, k=2, p=np.inf)[0])[:, 1]
        nearest_um = float(distance_um[distance_um > 0.0].min(initial=np.inf))
        finest_um = float((high_um - low_um).max()) / MAX_ADDRESS
        pitch_um = max((1.0 - ROUNDING) * nearest_um, finest_um) if np.isfinite(nearest_um) else 1.0
    column = np.floor((centroid_um[:, 0] - low_um[0]) / pitch_um + 0.5)
    row = np.floor((high_um[1] - centroid_um[:, 1]) / pitch_um + 0.5)
    if max(column.max(), row.max()) > MAX_ADDRESS:
        raise too_many_addresses(pitch_um, MAX_ADDRESS, "uint16")
    return column.astype(np.int64), row.astype(np.int64)


def too_many_addresses(pitch_um: float | None, limit: int, kind: str) -> ParameterError:
    rule = f"must give at most {limit + 1} columns and rows, the range of {kind} addresses"
    return ParameterError("pitch_um", rule, pitch_um, "µm")
