"""Pictures of what a sensor saw: every raster pixel takes the value of the photosites under it."""

from __future__ import annotations

import numpy as np

from foveasim._core.rings import site_moments
from foveasim._core.validation import Floats, Ints, finite_array, read_only
from foveasim.fields import Grid, PackedRings
from foveasim.integrate import Integrator
from foveasim.reconstruct.picture import Picture, covered_share

__all__ = ["cells", "fill_channels"]

#: Sites whose values stand in for a colour that a site does not see.
NEIGHBOURS = 4


def cells(layout: PackedRings, values: Floats, grid: Grid, *, n_threads: int | None = None) -> Picture:
    """
    Raster picture in which every pixel has the mean of the sites that it shows, weighted by area.

    Parameters
    ----------
    layout : Layout
    values : (n_site,) or (n_channel, n_site)
    grid : Grid
        The picture's pixels.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    Picture
        ``Wᵀ values / Wᵀ 1`` with the exact overlaps W of sites and pixels: borders are smooth, a flat field stays flat.
    """
    integrator = Integrator(layout, grid, n_threads=n_threads)
    channels = np.atleast_2d(finite_array("values", values))
    share = covered_share(integrator)
    covered_um2 = np.where(share > 0.0, share, np.nan) * grid.cell_area_um2
    data = integrator.spread(channels) / covered_um2
    return Picture(read_only(data.astype(np.float32)), read_only(share.astype(np.float32)), grid)


def fill_channels(layout: PackedRings, values: Floats, channel: Ints, n_channels: int) -> Floats:
    """
    Every channel's value at every site of a colour mosaic.

    Parameters
    ----------
    layout : Layout
    values : (n_site,)
    channel : (n_site,) int
    n_channels : int

    Returns
    -------
    filled : (n_channel, n_site) float64
        A site's own value in its own channel; in the others the mean of the nearest sites of that channel, weighted by
        the inverse of their distance. NaN for a channel without sites.
    """
    from scipy.spatial import cKDTree

    _, centroid_um = site_moments(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    filled = np.full((n_channels, values.size), np.nan)
    for c in range(n_channels):
        own = np.flatnonzero(channel == c)
        if own.size == 0:
            continue
        distance_um, nearest = cKDTree(centroid_um[own]).query(
            centroid_um, k=np.arange(1, min(NEIGHBOURS, own.size) + 1)
        )
        weight = 1.0 / np.maximum(distance_um, 1e-12)
        filled[c] = (values[own][nearest] * weight).sum(axis=1) / weight.sum(axis=1)
        filled[c, own] = values[own]
    return filled
