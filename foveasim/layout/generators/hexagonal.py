"""Hexagonal grid."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from foveasim._core.validation import check_choice, check_count, check_length_um, check_sites
from foveasim.layout.families import layout_family
from foveasim.layout.generators.grid import linear_fill_factor
from foveasim.layout.model import Layout

__all__ = ["hexagonal"]


@layout_family(example={"n_columns": 14, "n_rows": 16, "pitch_um": 2.0})
def hexagonal(
    n_columns: int,
    n_rows: int,
    pitch_um: float,
    *,
    width_um: float | None = None,
    trench_um: float | None = None,
    fill_factor: float | None = None,
    orientation: Literal["pointy", "flat"] = "pointy",
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
        Sites per row, and rows; for ``"flat"`` rows are vertical.
    pitch_um : float, µm
        Pitch: distance between the centres of neighbours.
    width_um : float, optional, µm
        Distance between opposite sides of the photosensitive hexagon; the pitch by default.
    trench_um : float, optional, µm
        Instead of the width: gap between two sites.
    fill_factor : float, optional
        Instead of the width: photosensitive fraction of a cell, ``(width / pitch)²``.
    orientation : {"pointy", "flat"}
        Orientation: a corner or a flat side at the top.

    Returns
    -------
    Layout
        Row by row, with the columns ``row``, ``column``, ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, the width exceeds the pitch, or the width is specified twice.
    """
    n_columns, n_rows = check_count("n_columns", n_columns), check_count("n_rows", n_rows)
    pitch_um = check_length_um("pitch_um", pitch_um)
    fraction = linear_fill_factor(pitch_um, width_um, trench_um, fill_factor)
    check_choice("orientation", orientation, ("pointy", "flat"))
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
    return Layout.from_equal_rings(
        rings_um,
        {"row": row, "column": column, "readout_line": column},
    )
