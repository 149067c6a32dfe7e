"""Reconstruction by area-weighted means of the photosites under each pixel."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeGuard

import numpy as np

from foveasim._core.rings import site_moments
from foveasim._core.validation import Floats, Ints, finite_array, read_only
from foveasim.fields import Grid, PackedRings
from foveasim.integrate import Integrator
from foveasim.layout import Layout
from foveasim.reconstruct.picture import Picture, coverage_fraction

__all__ = ["cells", "fill_channels"]

#: Number of cached layouts, and the largest number of their sites, about 200 bytes each.
MAX_CACHED, MAX_CACHED_SITES = 2, 1 << 18
#: Nearest sites of a channel that are averaged in demosaicing.
NEIGHBOURS = 4


def cells(layout: PackedRings, values: Floats, grid: Grid, *, n_threads: int | None = None) -> Picture:
    """
    Compute a raster picture of area-weighted means of photosite values.

    Parameters
    ----------
    layout : Layout
    values : (n_site,) or (n_channel, n_site)
    grid : Grid
        Pixels of the picture.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    Picture
        ``Wᵀ values / Wᵀ 1`` with the exact overlap areas W of sites and pixels: boundaries are anti-aliased, and a uniform
        field stays uniform.
    """
    arguments = grid, n_threads
    integrator, coverage = _compiled_once(layout, *arguments) if _is_cached(layout) else _compiled(layout, *arguments)
    channels = np.atleast_2d(finite_array("values", values))
    covered_um2 = np.where(coverage > 0.0, coverage, np.nan) * grid.cell_area_um2
    data = integrator.spread(channels) / covered_um2
    return Picture(read_only(data.astype(np.float32)), read_only(coverage.astype(np.float32)), grid)


def fill_channels(layout: PackedRings, values: Floats, channel: Ints, n_channels: int) -> Floats:
    """
    Interpolate every channel at every site of a colour mosaic.

    Parameters
    ----------
    layout : Layout
    values : (n_site,)
    channel : (n_site,) int
    n_channels : int

    Returns
    -------
    filled : (n_channel, n_site) float64
        The site's value in its own channel; in other channels the mean of the nearest sites of that channel, weighted by
        inverse distance. NaN for a channel without sites.
    """
    arguments = np.asarray(channel, np.int64).tobytes(), n_channels
    neighbours = _neighbours_once(layout, *arguments) if _is_cached(layout) else _neighbours(layout, *arguments)
    filled = np.full((n_channels, values.size), np.nan)
    for c, (own, others, nearest, weight) in neighbours.items():
        filled[c, own] = values[own]
        filled[c, others] = (values[nearest] * weight).sum(axis=1) / weight.sum(axis=1)
    return filled


def _is_cached(layout: PackedRings) -> TypeGuard[Layout]:
    """Return whether parts of a layout are cached: only of layouts, which are immutable."""
    return isinstance(layout, Layout) and layout.n_sites <= MAX_CACHED_SITES


def _compiled(layout: PackedRings, grid: Grid, n_threads: int | None) -> tuple[Integrator, Floats]:
    """Return the integrator of a layout on the pixels of a picture, and their coverage."""
    integrator = Integrator(layout, grid, n_threads=n_threads)
    return integrator, coverage_fraction(integrator)


def _neighbours(layout: PackedRings, channels: bytes, n_channels: int) -> dict[int, tuple[Ints, Ints, Ints, Floats]]:
    """
    Find the nearest sites of each channel for the sites of the others.

    Returns by channel: its sites, the other sites, their nearest sites of the channel, and the inverse distances to these.
    ``channels`` are the bytes of the channels of the sites, int64.
    """
    from scipy.spatial import cKDTree

    _, centroid_um = site_moments(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    channel = np.frombuffer(channels, np.int64)
    found = {}
    for c in range(n_channels):
        own, others = np.flatnonzero(channel == c), np.flatnonzero(channel != c)
        if own.size == 0:
            continue
        distance_um, nearest = cKDTree(centroid_um[own]).query(
            centroid_um[others], k=np.arange(1, min(NEIGHBOURS, own.size) + 1)
        )
        found[c] = own, others, own[nearest], 1.0 / np.maximum(distance_um, 1e-12)
    return found


# Pictures of one layout share its compiled sites and neighbours, such as the samples of a dataset or the frames of a video.
_compiled_once = lru_cache(maxsize=MAX_CACHED)(_compiled)
_neighbours_once = lru_cache(maxsize=MAX_CACHED)(_neighbours)
