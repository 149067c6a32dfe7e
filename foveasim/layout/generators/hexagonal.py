"""Hexagonal grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from foveasim._core.calls import LENGTH, NOT_NEGATIVE
from foveasim._core.validation import check_sites
from foveasim.layout.generator_registry import COUNT, layout_generator
from foveasim.layout.generators.grid import FILL_FACTOR, FIT_ROUNDING, check_field_um, linear_fill_factor
from foveasim.layout.model import Layout
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["hexagonal"]

#: Distance between rows, and height of a hexagon from corner to corner, in pitches.
ROW_PITCH, HEIGHT = 0.5 * math.sqrt(3.0), 2.0 / math.sqrt(3.0)


def _count_cells(parameters: Mapping[str, Any]) -> float:
    """Return the number of hexagons for parameters of :func:`hexagonal`."""
    names = ("n_columns", "n_rows", "pitch_um", "size_um", "orientation")
    n_columns, n_rows, _ = _cells_in_field(*(parameters[name] for name in names))
    return float(n_columns * n_rows)


def _guess_columns(n_sites: int, parameters: Mapping[str, Any]) -> float:
    """Return the number of hexagons per row of a field."""
    if parameters["n_rows"] is not None:
        return float(n_sites / parameters["n_rows"])
    width_um, height_um = (1.0, 1.0) if parameters["size_um"] is None else parameters["size_um"]
    return math.sqrt(n_sites * ROW_PITCH * width_um / height_um)


@layout_generator(
    example={"n_columns": 14, "n_rows": 16, "pitch_um": 2.0},
    solve_for=(SolveFor(name="n_columns", guess=_guess_columns, count=_count_cells),),
)
def hexagonal(
    n_columns: Annotated[int | None, COUNT] = None,
    n_rows: Annotated[int | None, COUNT] = None,
    pitch_um: Annotated[float | None, LENGTH] = None,
    *,
    size_um: tuple[float, float] | None = None,
    width_um: float | None = None,
    trench_um: Annotated[float | None, NOT_NEGATIVE] = None,
    fill_factor: Annotated[float | None, FILL_FACTOR] = None,
    orientation: Literal["pointy", "flat"] = "pointy",
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate closely packed regular hexagons around the optical axis.

    ::

        pointy:   ╱╲  ╱╲  ╱╲        pitch_um = centre to centre
                 │  ││  ││  │                = flat side to flat side of a full cell
                  ╲╱╲╱╲╱╲╱╲
                   │  ││  │  ...    every second row is shifted by half a pitch

        flat: the same, rotated by 90 degrees (columns instead of rows)

    Parameters
    ----------
    n_columns, n_rows : int
        Sites per row, and rows; for ``"flat"`` rows are vertical. By default as many rows as fill a square.
    pitch_um : float, µm
        Pitch: distance between the centres of neighbours.
    size_um : (width, height), optional, µm
        Size of the field, instead of the pitch: rows fill its width (for ``"flat"`` its height), and by default as many rows
        as fit across.
    width_um : float, optional, µm
        Distance between opposite sides of the photosensitive hexagon; the pitch by default.
    trench_um : float, optional, µm
        Instead of the width: gap between two sites.
    fill_factor : float, optional
        Instead of the width: photosensitive fraction of a cell, ``(width / pitch)²``.
    orientation : {"pointy", "flat"}
        Orientation: a corner or a flat side at the top.
    n_sites : int, optional
        Number of sites, instead of ``n_columns``, within 1 %.

    Returns
    -------
    Layout
        Row by row, with the columns ``row``, ``column``, ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, the width exceeds the pitch, or the width is specified twice.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.hexagonal(n_columns=30, n_rows=20, pitch_um=3.0)
    >>> layout.n_sites, round(float(layout.area_um2[0]), 4)
    (600, 7.7942)
    """
    n_columns, n_rows, pitch_um = _cells_in_field(n_columns, n_rows, pitch_um, size_um, orientation)
    fraction = linear_fill_factor(pitch_um, width_um, trench_um, fill_factor)
    check_sites(n_columns * n_rows)
    row, column = (index.ravel() for index in np.divmod(np.arange(n_rows * n_columns), n_columns))
    # All corners lie on a lattice of half pitches and half sides, so shared corners are bit-identical.
    half_um = np.array([0.5 * pitch_um, 0.5 * pitch_um / math.sqrt(3.0)])
    centre = np.stack((2 * column + row % 2, 3 * row), axis=1)
    layout_centre = np.array([n_columns - 1 + 0.5 * (n_rows > 1), 1.5 * (n_rows - 1)])
    corners = np.array([(1, -1), (1, 1), (0, 2), (-1, 1), (-1, -1), (0, -2)])
    rings_um = ((centre - layout_centre)[:, np.newaxis] + (1.0 if fraction is None else fraction) * corners) * half_um
    if orientation == "flat":
        rings_um = np.stack((-rings_um[..., 1], rings_um[..., 0]), axis=-1)
    return Layout.from_equal_rings(rings_um, {"row": row, "column": column, "readout_line": column})


def _cells_in_field(
    n_columns: int | None,
    n_rows: int | None,
    pitch_um: float | None,
    size_um: tuple[float, float] | None,
    orientation: str,
) -> tuple[int, int, float]:
    """Return hexagons per row, rows and pitch, from the pitch or the field."""
    assert n_columns is not None
    field_um = check_field_um(pitch_um, size_um)
    if field_um is None:
        assert pitch_um is not None
        across = n_columns + 0.5
    else:
        width_um, height_um = field_um if orientation == "pointy" else field_um[::-1]
        # Every second row is shifted by half a pitch; a single row ends half a pitch before the end of the field.
        pitch_um = width_um / (n_columns + 0.5)
        across = height_um / pitch_um
    return n_columns, n_rows or max(1, math.floor((across - HEIGHT) / ROW_PITCH * FIT_ROUNDING) + 1), pitch_um
