"""Octagonal layout: large octagons with small diamonds between them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from foveasim._core.calls import LENGTH
from foveasim._core.validation import Bools, Ints, check_length_um, check_sites
from foveasim.layout.generator_registry import COUNT, layout_generator
from foveasim.layout.generators.grid import cells_in_field, guess_columns
from foveasim.layout.model import Layout, layout_of
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["octagonal"]

#: Side of the diamonds between regular octagons, in pitches.
REGULAR_SIDE = math.sqrt(2.0) - 1.0
#: Corners as (x, y) in lattice lines: three lines per cell boundary, half a diamond apart.
OCTAGON = np.array([(2, 1), (3, 1), (4, 2), (4, 3), (3, 4), (2, 4), (1, 3), (1, 2)])
DIAMOND = np.array([(1, 0), (2, 1), (1, 2), (0, 1)])
#: Relative margin of the diamonds below the size at which they touch.
TOUCHING_ROUNDING = 1e-9


def _count_cells(parameters: Mapping[str, Any]) -> float:
    """Return the number of octagons and diamonds for parameters of :func:`octagonal`."""
    n_x, n_y, _ = cells_in_field(parameters["n_x"], parameters["n_y"], parameters["pitch_um"], parameters["size_um"])
    more = 1 if parameters["border"] == "cut" else -1
    return float(n_x * n_y + (n_x + more) * (n_y + more))


@layout_generator(
    example={"n_x": 12, "n_y": 12, "pitch_um": 2.0},
    solve_for=(
        SolveFor(
            name="n_x",
            guess=lambda n_sites, parameters: guess_columns(n_sites // 2, parameters),
            count=_count_cells,
        ),
    ),
)
def octagonal(
    n_x: Annotated[int | None, COUNT] = None,
    n_y: Annotated[int | None, COUNT] = None,
    pitch_um: Annotated[float | None, LENGTH] = None,
    *,
    size_um: tuple[float, float] | None = None,
    diamond_um: float | None = None,
    border: Literal["whole", "cut"] = "whole",
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate octagons on a square grid, with a diamond where four of them meet.

    The grid is centred on the optical axis.

    ::

          ╱────╲    ╱────╲
         ╱      ╲  ╱      ╲
        │        ││        │       pitch_um = centre to centre of two octagons
         ╲      ╱  ╲      ╱                 = centre to centre of two diamonds
          ╲────╱ ╱╲ ╲────╱
          ╱────╲ ╲╱ ╱────╲         diamond_um = side of a diamond
         ╱      ╲  ╱      ╲                   = slanted side of an octagon
        │        ││        │
         ╲      ╱  ╲      ╱
          ╲────╱    ╲────╱

    Parameters
    ----------
    n_x, n_y : int
        Number of columns and rows of octagons; by default as many rows as columns.
    pitch_um : float, µm
        Pitch of the octagons.
    size_um : (width, height), optional, µm
        Size of the field, instead of the pitch: the octagons fill the width, and by default as many rows as fit in the height.
    diamond_um : float, optional, µm
        Side of the diamonds, less than ``pitch_um / √2``; by default ``(√2 - 1) pitch_um``, for regular octagons.
    border : {"whole", "cut"}
        ``"whole"``: diamonds only where four octagons meet. ``"cut"``: also halves and quarters of diamonds along the
        boundary, so that the sites tile the rectangle of ``n_x`` by ``n_y`` pitches.
    n_sites : int, optional
        Number of sites, instead of ``n_x``, within 1 %.

    Returns
    -------
    Layout
        The octagons, then the diamonds, row by row from the lowest y, with the columns ``kind`` (0 octagon, 1 diamond),
        ``row``, ``column`` (in the grid of its kind) and ``readout_line`` (columns of both kinds, numbered consecutively).

    Raises
    ------
    ParameterError
        When a number is out of range, or the diamonds are so large that they would touch.

    Notes
    -----
    The area of a diamond is ``diamond_um²``, that of an octagon ``pitch_um² - diamond_um²``; their sum is a cell of the grid.

    Examples
    --------
    >>> octagonal(n_x=4, n_y=3, pitch_um=5.0, diamond_um=3.0).area_um2[[0, -1]].round(
    ...     9
    ... ).tolist()
    [16.0, 9.0]
    """
    n_x, n_y, pitch_um = cells_in_field(n_x, n_y, pitch_um, size_um)
    if diamond_um is not None:
        diamond_um = check_length_um(
            "diamond_um",
            diamond_um,
            at_most=(1.0 - TOUCHING_ROUNDING) * pitch_um / math.sqrt(2.0),
            hint="diamonds with a side of pitch_um / √2 would touch",
        )
    check_sites(n_x * n_y + (n_x + 1) * (n_y + 1))
    half_um = (REGULAR_SIDE * pitch_um if diamond_um is None else diamond_um) / math.sqrt(2.0)
    # Corners lie on cell boundaries, or half a diamond away from them, so shared corners are bit-identical.
    x_um, y_um = (
        (pitch_um * (np.arange(n + 1) - 0.5 * n)[:, np.newaxis] + (-half_um, 0.0, half_um)).ravel() for n in (n_x, n_y)
    )
    row, column = _row_and_column(n_y, n_x)
    octagon = 3 * np.stack((column, row), axis=1)[:, np.newaxis] + OCTAGON
    first = 0 if border == "cut" else 1
    diamond_row, diamond_column = _row_and_column(n_y + 1 - 2 * first, n_x + 1 - 2 * first)
    diamond = 3 * (np.stack((diamond_column, diamond_row), axis=1)[:, np.newaxis] + first) + DIAMOND
    diamond, is_corner = _clip_diamonds(diamond, n_x, n_y)
    corner = np.concatenate((octagon.reshape(-1, 2), diamond[is_corner]))
    n_vertices = np.concatenate((np.full(row.size, len(OCTAGON)), np.count_nonzero(is_corner, axis=1)))
    columns = {
        "kind": np.repeat([0, 1], [row.size, diamond_row.size]),
        "row": np.concatenate((row, diamond_row)),
        "column": np.concatenate((column, diamond_column)),
        "readout_line": np.concatenate((column, n_x + diamond_column)),
    }
    xy_um = np.stack((x_um[corner[:, 0]], y_um[corner[:, 1]]), axis=1)
    return layout_of(xy_um, np.concatenate(([0], np.cumsum(n_vertices))), columns=columns)


def _row_and_column(n_rows: int, n_columns: int) -> tuple[Ints, Ints]:
    """Return the row and column of each site of a grid, row by row."""
    row, column = np.divmod(np.arange(n_rows * n_columns), max(1, n_columns))
    return row, column


def _clip_diamonds(diamond: Ints, n_x: int, n_y: int) -> tuple[Ints, Bools]:
    """
    Clip diamonds (n, 4, 2) to the octagon cells; return them with a corner mask (n, 4).

    Corners outside move to the centre of the diamond, which is a corner of a quarter, but not of a half.
    """
    inside = np.clip(diamond, 1, (3 * n_x + 1, 3 * n_y + 1))
    is_moved = (inside != diamond).any(axis=2)
    n_moved = np.cumsum(is_moved, axis=1)
    return inside, ~is_moved | ((n_moved == 1) & (n_moved[:, -1:] == 2))
