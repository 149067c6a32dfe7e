"""Reconstruction by area-weighted means of the photosites under each pixel."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.rings import TIE_FRACTION, site_moments
from foveasim._core.threads import thread_count
from foveasim._core.validation import Floats, Ints, check_memory, check_per_site, finite_array
from foveasim.fields import Grid, PackedRings
from foveasim.reconstruct.picture import Gaps, Picture, cached_by_layout, raster_of

__all__ = ["cells", "fill_channels"]

#: Nearest sites of a channel that are averaged in demosaicing, with all further ones at the distance of the last.
NEIGHBOURS = 4
#: Smallest distance that determines a weight: coincident sites have a finite one.
MIN_DISTANCE_UM = 1e-12
#: Number of sites that are examined for ties, and the fraction with ties that is few.
SAMPLES, FEW_TIES = 256, 0.05


def cells(
    layout: PackedRings, values: Floats, grid: Grid, *, gaps: Gaps = "fill", n_threads: int | None = None
) -> Picture:
    """
    Compute a raster picture of area-weighted means of photosite values.

    Parameters
    ----------
    layout : Layout
    values : (n_site,) or (n_channel, n_site)
    grid : Grid
        Pixels of the picture.
    gaps : {"fill", "empty"}
        Whether sites extend to the centre of the gap to a neighbour, such as a trench; gaps wider than half the size (root
        of the area) of the smaller site, and blind spots, are empty.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    Picture
        ``Wᵀ values / Wᵀ 1`` with the exact overlap areas W of sites and pixels: boundaries are anti-aliased, and a uniform
        field stays uniform.

    Examples
    --------
    >>> import foveasim as fs
    >>> pair = fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)
    >>> picture = fs.reconstruct.cells(pair, [10.0, 30.0], fs.Grid.centred((1, 3), 1.0))
    >>> picture.data[0].tolist()  # equal parts of the central pixel lie on both sites
    [[10.0, 20.0, 30.0]]
    """
    channels = np.atleast_2d(finite_array("values", values))
    return raster_of(layout, grid, gaps, n_threads).means(channels)


def fill_channels(
    layout: PackedRings, values: Floats, channel: Ints, n_channels: Annotated[int, Limits(at_least=1, at_most=65_536)]
) -> Floats:
    """
    Interpolate every channel at every site of a colour mosaic.

    Parameters
    ----------
    layout : Layout
    values : (n_site,)
        Finite numbers.
    channel : (n_site,) int
        From 0 to ``n_channels - 1``.
    n_channels : int

    Returns
    -------
    filled : (n_channel, n_site) float64
        The site's value in its own channel; in other channels the mean of the four nearest sites of that channel, weighted by
        inverse distance. Further sites at the distance of the fourth are included, so that the result does not depend on the
        order of the sites. NaN for a channel without sites.

    Raises
    ------
    ParameterError
        When values or channels are not such numbers, or there is not one of each for each site.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.mosaic(fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0), ["RG", "GB"])
    >>> fs.reconstruct.fill_channels(
    ...     layout, np.array([1.0, 2.0, 3.0, 4.0]), layout.channel, 3
    ... ).tolist()
    [[1.0, 1.0, 1.0, 1.0], [2.5, 2.0, 3.0, 2.5], [4.0, 4.0, 4.0, 4.0]]
    """
    values = finite_array("values", values)
    n_sites = layout.site_offsets.size - 1
    check_per_site("values", values, n_sites)
    check_per_site("channel", np.asarray(channel), n_sites)
    channel = finite_array("channel", channel, at_least=0, at_most=n_channels - 1).astype(np.int32)
    check_memory("n_channels", 8 * n_channels * n_sites, n_channels, "take fewer channels")
    neighbours = _neighbours(layout, channel.tobytes(), n_channels)
    filled = np.full((n_channels, values.size), np.nan)
    for c, (own, others, mean_of) in neighbours.items():
        filled[c, own] = values[own]
        filled[c, others] = mean_of @ values[own]
    return filled


def _first_number(tree: Any, at_um: Floats) -> int:
    """Return how many nearest points to find first: with few ties, one more than are averaged."""
    sample_um = at_um[:: max(1, len(at_um) // SAMPLES)]
    distance_um = np.asarray(tree.query(sample_um, k=[NEIGHBOURS, NEIGHBOURS + 1])[0])
    has_ties = distance_um[:, 1] <= distance_um[:, 0] * (1.0 + TIE_FRACTION)
    return 2 * NEIGHBOURS if np.count_nonzero(has_ties) > FEW_TIES * has_ties.size else NEIGHBOURS + 1


# Captures of one layout share its neighbours.
@cached_by_layout
def _neighbours(layout: PackedRings, channels: bytes, n_channels: int) -> dict[int, tuple[Ints, Ints, Any]]:
    """
    Find the nearest sites of each channel for the sites of the others.

    Returns by channel: its sites, the other sites, and the weights of the former in the means of the latter, a sparse matrix
    (n_other, n_own). ``channels`` are the bytes of the channels of the sites, int32.
    """
    _, centroid_um = site_moments(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    channel = np.frombuffer(channels, np.int32)
    found = {}
    for c in range(n_channels):
        own, others = np.flatnonzero(channel == c), np.flatnonzero(channel != c)
        if own.size:
            found[c] = own, others, _mean_of_nearest(centroid_um[own], centroid_um[others])
    return found


def _mean_of_nearest(points_um: Floats, at_um: Floats) -> Any:
    """Return the weights of points in the means of the nearest ones, sparse (n_at, n)."""
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    tree = cKDTree(points_um)
    rows, columns, weights = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)], [np.zeros(0)]
    remaining, k = np.arange(len(at_um), dtype=np.int32), _first_number(tree, at_um)
    while remaining.size:
        k = min(k, len(points_um))
        found = tree.query(at_um[remaining], k=np.arange(1, k + 1), workers=thread_count())
        distance_um, nearest = np.asarray(found[0]), np.asarray(found[1], np.int32)
        distance_um = np.maximum(distance_um, MIN_DISTANCE_UM)
        limit_um = distance_um[:, min(NEIGHBOURS, k) - 1 : min(NEIGHBOURS, k)] * (1.0 + TIE_FRACTION)
        # Rows whose last point is within the limit may have further ties.
        is_complete = (distance_um[:, -1] > limit_um[:, 0]) | (k == len(points_um))
        is_used = (distance_um <= limit_um) & is_complete[:, np.newaxis]
        weight = np.where(is_used, 1.0 / distance_um, 0.0)
        weight[is_complete] /= weight[is_complete].sum(axis=1, keepdims=True)
        rows.append(np.broadcast_to(remaining[:, np.newaxis], nearest.shape)[is_used])
        columns.append(nearest[is_used])
        weights.append(weight[is_used])
        remaining, k = remaining[~is_complete], 4 * k
    entries = np.concatenate(rows), np.concatenate(columns)  # below 2³¹: a matrix of half the size
    return csr_array((np.concatenate(weights), entries), shape=(len(at_um), len(points_um)))
