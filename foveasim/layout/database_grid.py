"""Outlines on the database grid of chip files, on which design rules hold."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import convexity
from foveasim._core.validation import Bools, Floats
from foveasim.layout.model import Layout, layout_of, valid_sites, winding_um2

__all__ = ["DEFAULT_DBU_UM", "has_valid_outlines", "on_grid", "to_um"]

#: Database unit of most processes, and default of layout programs.
DEFAULT_DBU_UM = 1e-3


def to_um(xy_dbu: NDArray[Any], dbu_um: float) -> Floats:
    """Convert to µm; correctly rounded where 1 µm is an integer number of database units."""
    per_um = round(1.0 / dbu_um)
    is_integer = per_um >= 1 and abs(per_um * dbu_um - 1.0) < 1e-12
    return np.asarray(xy_dbu / per_um if is_integer else xy_dbu * dbu_um, dtype=np.float64)


def on_grid(layout: Layout, dbu_um: float) -> Layout:
    """Return a layout with vertices on the database grid, or the layout itself."""
    xy_dbu = layout.xy_um / dbu_um
    xy_um = to_um(np.rint(xy_dbu, out=xy_dbu), dbu_um)
    return layout if np.array_equal(xy_um, layout.xy_um) else layout_of(xy_um, layout.ring_offsets, layout.site_offsets)


def has_valid_outlines(snapped: Layout) -> Bools:
    """Return whether each rounded site has an area and rings that do not cross."""
    if snapped.n_sites == 0:
        return np.zeros(0, bool)
    outlines = snapped.site_offsets[:-1]
    # Rounding may turn a small ring over.
    is_valid = (np.diff(snapped.site_offsets) == 1) & (convexity(snapped.xy_um, snapped.ring_offsets)[outlines] == 1)
    others = np.flatnonzero(~is_valid)
    if others.size:
        rest = snapped[others]
        is_flat = winding_um2(*rest.rings_um) <= 0.0
        is_valid[others] = ~np.logical_or.reduceat(is_flat, rest.site_offsets[:-1]) & valid_sites(rest)
    return is_valid
