"""The foveal Cartesian layout: square rings around a uniform fovea, every edge parallel to an axis."""

from __future__ import annotations

import math

import numpy as np

from foveasim._core.validation import (
    MAX_LENGTH_UM,
    MAX_SITES,
    Floats,
    Ints,
    check_count,
    check_length_um,
    check_number,
    check_sites,
)
from foveasim.errors import ParameterError
from foveasim.layout.families import layout_family
from foveasim.layout.generators._annuli import ring_outlines
from foveasim.layout.model import Layout

__all__ = ["foveal_cartesian"]

#: Rings thinner than this fraction of their half side are rounding: corners of two rings must stay apart.
RATIO_ROUNDING = 1e-9
#: Corners of two rings that are nearer than this fraction of the half side are one corner.
CORNER_ROUNDING = 1e-12


@layout_family(example={"n_rings": 12, "pitch_um": 1.0, "n_fovea": 4, "ring_ratio": 1.2})
def foveal_cartesian(*, n_rings: int, ring_ratio: float, pitch_um: float, n_fovea: int = 1) -> Layout:
    """
    Square rings around the optical axis: ring r has 8r rectangles, and is ``ring_ratio`` times as large as the one inside.

    ::

        ┌─────┬────┬────┬────┬─────┐  ─┬─
        │     │    │    │    │     │   │
        ├─────┼────┴┬──┬┴────┼─────┤   │        ring 0: one square of side pitch_um
        │     │     │  │     │     │   │
        ├─────┤     │  │     ├─────┤   │        ring r: between the squares of half sides h_(r-1) and h_r,
        │     ├─────┼──┼─────┤     │   │                squares in the corners, and 2r - 1 equal rectangles
        │     │     │r0│     │     │   │ 2 h_2          along each side
        │     ├─────┼──┼─────┤     │   │
        ├─────┤     │  │     ├─────┤   │        in the fovea h_r = (r + 0.5) · pitch_um,
        │     │     │  │     │     │   │        around it h_r = ring_ratio · h_(r-1)
        ├─────┼────┬┴──┴┬────┼─────┤   │
        │     │    │    │    │     │   │
        └─────┴────┴────┴────┴─────┘  ─┴─

    Parameters
    ----------
    n_rings : int
        All rings, the one square in the middle included.
    ring_ratio : float
        Outer to inner side of a ring outside the fovea, above 1.
    pitch_um : float, µm
        Side of the square in the middle, and of all squares of the fovea.
    n_fovea : int
        Rings of the fovea, a grid of ``2 n_fovea - 1`` squares across; only the middle one by default.

    Returns
    -------
    Layout
        The ``(2 n_rings - 1)²`` sites ring by ring from the inside, each ring counter-clockwise from its lower left
        corner, with the columns ``ring``, ``sector``, ``row``, ``column`` and ``readout_line`` (the column). Rows and
        columns are those of a uniform grid of as many sites: a site keeps its neighbours in its ring, and corners stay
        on the diagonals. A site's outline has also the corners of its neighbours in the next rings.

    Raises
    ------
    ParameterError
        When a number is out of range, or the rings grow beyond any sensor.

    Notes
    -----
    Ring r is ``h_(r-1) (ring_ratio - 1)`` high, and its rectangles ``2 h_(r-1) / (2r - 1)`` wide. So no site is smaller
    than ``pitch_um`` in either direction when the ratio is at least ``1 + 2 / (2 n_fovea - 1)``.

    Examples
    --------
    >>> foveal_cartesian(n_rings=32, ring_ratio=1.2, pitch_um=2.2, n_fovea=8).n_sites
    3969
    """
    n_rings = check_count("n_rings", n_rings, at_most=MAX_SITES)
    check_sites((2 * n_rings - 1) ** 2)
    ring_ratio = check_number("ring_ratio", ring_ratio, above=1.0 + RATIO_ROUNDING)
    pitch_um = check_length_um("pitch_um", pitch_um)
    n_fovea = check_count("n_fovea", n_fovea, at_most=n_rings, hint="it is no larger than 'n_rings'")
    n_growing = n_rings - n_fovea
    if math.log((n_fovea - 0.5) * pitch_um) + n_growing * math.log(ring_ratio) > math.log(MAX_LENGTH_UM):
        raise ParameterError(
            "ring_ratio",
            f"makes {n_growing} rings reach further than {MAX_LENGTH_UM:g} µm",
            ring_ratio,
            hint="take a smaller ratio or fewer rings",
        )
    xy_um, n_vertices = _outlines(n_rings, ring_ratio, pitch_um, n_fovea)
    n_sectors = np.maximum(1, 8 * np.arange(n_rings))
    ring = np.repeat(np.arange(n_rings), n_sectors)
    sector = np.arange(ring.size) - (np.cumsum(n_sectors) - n_sectors)[ring]
    row, column = (n_rings - 1 + place for place in _places(ring, sector))
    return Layout(
        xy_um,
        np.concatenate(([0], np.cumsum(n_vertices))),
        np.arange(n_vertices.size + 1),
        {"ring": ring, "sector": sector, "row": row, "column": column, "readout_line": column},
    )


def _places(ring: Ints, sector: Ints) -> tuple[Ints, Ints]:
    """Row and column of each site, from the middle."""
    side, along = np.divmod(sector, np.maximum(1, 2 * ring))
    along = along - ring
    row = np.choose(side, (-ring, along, ring, -along))
    column = np.choose(side, (along, ring, -along, -ring))
    return row, column


def _outlines(n_rings: int, ring_ratio: float, pitch_um: float, n_fovea: int) -> tuple[Floats, Ints]:
    """Vertices of all sites, (n_vertex, 2) µm, and the number of each site's."""
    half_um = (n_fovea - 0.5) * pitch_um * np.power(ring_ratio, np.arange(1 - n_fovea, n_rings - n_fovea + 1))
    half_um[:n_fovea] = (np.arange(n_fovea) + 0.5) * pitch_um
    # A ring's corners along one side: the ends of its inner square, and between them its rectangles' corners.
    inner_cuts_um = np.zeros(0)
    outlines, n_vertices = [], []
    inner_um = np.zeros((0, 2))
    inner_side_um = np.zeros(0)
    for r in range(n_rings):
        # The outer square's side: this ring's corners, and those of the next ring, which are the same where they meet.
        cuts_um = np.concatenate((-half_um[r : r + 1], inner_cuts_um, half_um[r : r + 1]))
        next_cuts_um = _snapped(half_um[r] * (2 * np.arange(2 * r + 2) - (2 * r + 1)) / (2 * r + 1), cuts_um)
        side_um = np.unique(np.concatenate((cuts_um, next_cuts_um) if r + 1 < n_rings else (cuts_um,)))
        outer_um = _square_loop(side_um)
        if r == 0:
            outlines.append(outer_um)
            n_vertices.append(np.array([len(outer_um)]))
        else:
            outer_first, outer_last = _corners(np.searchsorted(side_um, cuts_um), side_um.size - 1)
            # On the inner square a corner site has one point only.
            at = np.searchsorted(inner_side_um, inner_cuts_um)
            inner_first, inner_last = _corners(np.concatenate((at[:1], at, at[-1:])), inner_side_um.size - 1)
            xy_um, counts = ring_outlines(outer_um, outer_first, outer_last, inner_um, inner_first, inner_last)
            outlines.append(xy_um)
            n_vertices.append(counts)
        inner_um, inner_side_um, inner_cuts_um = outer_um, side_um, next_cuts_um
    return np.concatenate(outlines), np.concatenate(n_vertices)


def _snapped(values_um: Floats, to_um: Floats) -> Floats:
    """The values; a number of the other, sorted list instead of each that differs from it by rounding only."""
    after = np.clip(np.searchsorted(to_um, values_um), 1, to_um.size - 1)
    nearest_um = np.where(values_um - to_um[after - 1] < to_um[after] - values_um, to_um[after - 1], to_um[after])
    return np.where(np.abs(values_um - nearest_um) <= CORNER_ROUNDING * to_um[-1], nearest_um, values_um)


def _square_loop(side_um: Floats) -> Floats:
    """Points around a square, counter-clockwise from its lower left corner, from those along one side."""
    along_um, half_um = side_um[:-1], np.full(side_um.size - 1, side_um[-1])
    bottom = np.stack((along_um, -half_um), axis=1)
    right = np.stack((half_um, along_um), axis=1)
    return np.concatenate((bottom, right, -bottom, -right))


def _corners(at: Ints, n_side: int) -> tuple[Ints, Ints]:
    """First and last position of a ring's sites on a loop of four sides, from the corners' positions along one side."""
    # Site 0 of a side stands in the square's corner: it begins on the side before.
    first = np.concatenate((at[-2:-1] - n_side, at[1:-2]))
    sides = n_side * np.arange(4)[:, np.newaxis]
    return (sides + first).ravel(), (sides + at[1:-1]).ravel()
