"""Foveal Cartesian layout: axis-parallel square rings around a uniform fovea."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from foveasim._core.calls import LENGTH, Limits
from foveasim._core.validation import MAX_LENGTH_UM, MAX_SITES, Floats, Ints, check_count, check_sites
from foveasim.errors import ParameterError
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.generators._annuli import points_of_outlines
from foveasim.layout.model import Layout, layout_of
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["foveal_cartesian"]

#: Minimum height of a ring relative to its half side, so that corners of two rings remain distinct in float64.
RATIO_ROUNDING = 1e-9
#: Distance relative to the half side below which corners of two rings are equal.
CORNER_ROUNDING = 1e-12


@layout_generator(
    example={"n_rings": 12, "pitch_um": 1.0, "n_fovea": 4, "ring_ratio": 1.2},
    solve_for=(
        SolveFor(
            name="n_rings",
            guess=lambda n_sites, _: 0.5 * (math.sqrt(n_sites) + 1.0),
            count=lambda parameters: float((2 * parameters["n_rings"] - 1) ** 2),
        ),
    ),
)
def foveal_cartesian(
    n_rings: Annotated[int | None, Limits(at_least=1, at_most=MAX_SITES)] = None,
    *,
    ring_ratio: Annotated[float, Limits(above=1.0 + RATIO_ROUNDING)],
    pitch_um: Annotated[float, LENGTH],
    n_fovea: int = 1,
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate square rings of rectangles that grow geometrically around the optical axis.

    Ring r has 8r rectangles and is ``ring_ratio`` times as large as ring r - 1.

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
    ring_ratio : float
        Ratio of the outer to the inner side of a ring outside the fovea, > 1.
    pitch_um : float, µm
        Side of the central square, and of all squares of the fovea.
    n_rings : int
        Number of rings, including the central square.
    n_fovea : int
        Number of rings of the fovea, a grid with ``2 n_fovea - 1`` squares per side; the central square alone by default.
    n_sites : int, optional
        Number of sites, instead of ``n_rings``, within 1 %; possible are the squares of odd numbers.

    Returns
    -------
    Layout
        The ``(2 n_rings - 1)²`` sites ring by ring from the inside, each ring counter-clockwise from its lower left
        corner, with the columns ``ring``, ``sector``, ``row``, ``column`` and ``readout_line`` (the column). Rows and
        columns are those of a uniform grid with the same number of sites: neighbours in a ring remain neighbours, and
        corners remain on the diagonals. Outlines include the corners of the neighbours in adjacent rings.

    Raises
    ------
    ParameterError
        When a number is out of range, or the rings exceed the maximum length on a sensor.

    Notes
    -----
    Ring r has the height ``h_(r-1) (ring_ratio - 1)``, and its rectangles the width ``2 h_(r-1) / (2r - 1)``. With a ratio
    of at least ``1 + 2 / (2 n_fovea - 1)``, therefore, no site is smaller than ``pitch_um`` in either direction.

    Examples
    --------
    >>> foveal_cartesian(n_rings=32, ring_ratio=1.2, pitch_um=2.2, n_fovea=8).n_sites
    3969
    """
    assert n_rings is not None
    check_sites((2 * n_rings - 1) ** 2)
    n_fovea = check_count("n_fovea", n_fovea, at_most=n_rings, hint="the upper limit is 'n_rings'")
    n_growing = n_rings - n_fovea
    if math.log((n_fovea - 0.5) * pitch_um) + n_growing * math.log(ring_ratio) > math.log(MAX_LENGTH_UM):
        raise ParameterError(
            "ring_ratio",
            f"must keep the radius of {n_growing} growing rings within {MAX_LENGTH_UM:g} µm",
            ring_ratio,
            hint="take a smaller ratio or fewer rings",
        )
    xy_um, n_vertices = _outlines(n_rings, ring_ratio, pitch_um, n_fovea)
    n_sectors = np.maximum(1, 8 * np.arange(n_rings))
    ring = np.repeat(np.arange(n_rings), n_sectors)
    sector = np.arange(ring.size) - (np.cumsum(n_sectors) - n_sectors)[ring]
    row, column = (n_rings - 1 + index for index in _row_and_column(ring, sector))
    columns = {"ring": ring, "sector": sector, "row": row, "column": column, "readout_line": column}
    return layout_of(xy_um, np.concatenate(([0], np.cumsum(n_vertices))), columns=columns)


def _row_and_column(ring: Ints, sector: Ints) -> tuple[Ints, Ints]:
    """Return the row and column of each site, relative to the centre."""
    side, along = np.divmod(sector, np.maximum(1, 2 * ring))
    along = along - ring
    row = np.choose(side, (-ring, along, ring, -along))
    column = np.choose(side, (along, ring, -along, -ring))
    return row, column


def _outlines(n_rings: int, ring_ratio: float, pitch_um: float, n_fovea: int) -> tuple[Floats, Ints]:
    """Return the vertices of all sites, (n_vertex, 2) µm, and their number per site."""
    half_um = (n_fovea - 0.5) * pitch_um * np.power(ring_ratio, np.arange(1 - n_fovea, n_rings - n_fovea + 1))
    half_um[:n_fovea] = (np.arange(n_fovea) + 0.5) * pitch_um
    # Corners of a ring along one side: the ends of the inner square, and between them the corners of the rectangles.
    inner_cuts_um = np.zeros(0)
    outlines, n_vertices = [], []
    inner_um = np.zeros((0, 2))
    inner_side_um = np.zeros(0)
    for r in range(n_rings):
        # Side of the outer square: corners of this ring and of the next ring, equal where they coincide.
        cuts_um = np.concatenate((-half_um[r : r + 1], inner_cuts_um, half_um[r : r + 1]))
        next_cuts_um = _snap(half_um[r] * (2 * np.arange(2 * r + 2) - (2 * r + 1)) / (2 * r + 1), cuts_um)
        side_um = np.unique(np.concatenate((cuts_um, next_cuts_um) if r + 1 < n_rings else (cuts_um,)))
        outer_um = _square_loop(side_um)
        if r == 0:
            outlines.append(outer_um)
            n_vertices.append(np.array([len(outer_um)]))
        else:
            outer_first, outer_last = _corners(np.searchsorted(side_um, cuts_um), side_um.size - 1)
            # A corner site has a single point on the inner square.
            at = np.searchsorted(inner_side_um, inner_cuts_um)
            inner_first, inner_last = _corners(np.concatenate((at[:1], at, at[-1:])), inner_side_um.size - 1)
            points, counts = points_of_outlines(
                len(outer_um), outer_first, outer_last, len(inner_um), inner_first, inner_last
            )
            outlines.append(np.concatenate((outer_um, inner_um))[points])
            n_vertices.append(counts)
        inner_um, inner_side_um, inner_cuts_um = outer_um, side_um, next_cuts_um
    return np.concatenate(outlines), np.concatenate(n_vertices)


def _snap(values_um: Floats, to_um: Floats) -> Floats:
    """Snap values to the elements of a sorted array from which they differ only by rounding."""
    after = np.clip(np.searchsorted(to_um, values_um), 1, to_um.size - 1)
    nearest_um = np.where(values_um - to_um[after - 1] < to_um[after] - values_um, to_um[after - 1], to_um[after])
    return np.where(np.abs(values_um - nearest_um) <= CORNER_ROUNDING * to_um[-1], nearest_um, values_um)


def _square_loop(side_um: Floats) -> Floats:
    """Return the points around a square, counter-clockwise, from those along one side."""
    along_um, half_um = side_um[:-1], np.full(side_um.size - 1, side_um[-1])
    bottom = np.stack((along_um, -half_um), axis=1)
    right = np.stack((half_um, along_um), axis=1)
    return np.concatenate((bottom, right, -bottom, -right))


def _corners(at: Ints, n_side: int) -> tuple[Ints, Ints]:
    """Return the first and last position of the sites of a ring on a loop of four sides."""
    # Site 0 of a side is the corner of the square: it begins on the previous side.
    first = np.concatenate((at[-2:-1] - n_side, at[1:-2]))
    sides = n_side * np.arange(4)[:, np.newaxis]
    return (sides + first).ravel(), (sides + at[1:-1]).ravel()
