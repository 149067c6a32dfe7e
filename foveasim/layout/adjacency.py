"""Adjacency of photosites: lengths of shared edges."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from foveasim._core.calls import NOT_NEGATIVE
from foveasim._core.rings import next_vertex
from foveasim._core.validation import Floats, Ints
from foveasim.layout.model import Layout

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["TOUCHING_UM", "adjacency", "colours_of_boxes", "near_boxes"]

#: Distance within which edges touch: far below any manufacturing grid, far above the rounding of coordinates.
TOUCHING_UM = 1e-6


def adjacency(layout: Layout, *, max_gap_um: Annotated[float, NOT_NEGATIVE] = TOUCHING_UM) -> csr_array[Any]:
    """
    Compute the lengths of the edges that photosites share.

    Parameters
    ----------
    layout : Layout
    max_gap_um : float, µm
        Largest distance between facing edges that count as shared: set it to the trench width if trenches separate the
        sites.

    Returns
    -------
    shared_um : csr_array (n_site, n_site) float64, µm
        Length of the common boundary of two sites; symmetric, with an empty diagonal. Sites that touch only in a corner
        share no edge. A long edge facing several short ones (a T-junction) is shared with each of them.

    Raises
    ------
    ParameterError
        When the gap is negative.

    Notes
    -----
    Without gaps, the lengths of a site surrounded by others add up to its perimeter. Cost: the number of pairs of sites
    with intersecting bounding boxes, times the product of their numbers of edges.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> adjacency(grid(n_x=2, n_y=1, pitch_um=3.0)).toarray()
    array([[0., 3.],
           [3., 0.]])
    """
    from scipy.sparse import coo_array

    from foveasim.layout import _kernels

    a, b = near_boxes(layout.site_bounds_um, max(max_gap_um, TOUCHING_UM))
    length_um = _kernels.shared_lengths(
        layout.xy_um,
        next_vertex(layout.ring_offsets),
        layout.ring_offsets[layout.site_offsets],
        a,
        b,
        max(max_gap_um, TOUCHING_UM),
    )
    touches = length_um > 0.0
    a, b, length_um = a[touches], b[touches], length_um[touches]
    n = layout.n_sites
    both = (np.concatenate((length_um, length_um)), (np.concatenate((a, b)), np.concatenate((b, a))))
    return coo_array(both, shape=(n, n)).tocsr()


def near_boxes(box_um: Floats, reach_um: float | Floats) -> tuple[Ints, Ints]:
    """
    Return the pairs of boxes (n, 4) that are at most ``reach_um`` apart.

    ``reach_um``: of all, or (n,) of each; then pairs are at most the mean of both apart. The first of a pair is the lower one;
    pairs are ordered by the first, then the second.
    """
    from foveasim.layout import _kernels

    half_um = np.broadcast_to(0.5 * np.asarray(reach_um), box_um.shape[:1])[:, np.newaxis]
    grown_um = np.concatenate((box_um[:, :2] - half_um, box_um[:, 2:] + half_um), axis=1)
    pairs = _kernels.intersecting_boxes(grown_um, np.argsort(grown_um[:, 0]))
    first, second = np.divmod(np.sort(pairs), max(box_um.shape[0], 1))
    return first, second


def colours_of_boxes(box_um: Floats) -> Ints:
    """
    Return small integers (n,) for boxes (n, 4): different ones where boxes touch.

    At most 64, the number of the kernel; more boxes at one place share some.
    """
    from foveasim.layout import _kernels

    n_boxes = box_um.shape[0]
    one, other = near_boxes(box_um, TOUCHING_UM)
    first, second = np.concatenate((one, other)), np.concatenate((other, one))
    order = np.argsort(first, kind="stable")
    starts = np.concatenate(([0], np.cumsum(np.bincount(first, minlength=n_boxes)))).astype(np.int64)
    for n_colours in (4, 8, 16, 32, 64):
        colour: Ints = _kernels.colour_greedily(starts, second[order], np.ones(order.size), n_colours)
        if (colour[one] != colour[other]).all():
            break
    return colour
