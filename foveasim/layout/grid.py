"""The rectangular grid."""

from __future__ import annotations

import numpy as np

from foveasim.arrays import Floats, check_count, check_length_um, check_sites
from foveasim.layout._model import Layout

__all__ = ["grid"]


def grid(*, n_x: int, n_y: int, pitch_um: float, width_um: float | None = None) -> Layout:
    """
    Square photosites on a square grid, its middle on the optical axis.

    ::

        ┌────┐ ┌────┐ ┌────┐  ─┬─
        │    │ │    │ │    │   │ width_um
        └────┘ └────┘ └────┘  ─┴─
        ├──────┤
         pitch_um

    Parameters
    ----------
    n_x, n_y : int
        Numbers of columns and rows.
    pitch_um : float, µm
        Distance of two centres.
    width_um : float, optional, µm
        Side of the light-sensitive square; the pitch by default, so that the sites tile the plane. The fill factor
        is ``(width / pitch)²``.

    Returns
    -------
    Layout
        Row by row from the lowest y, with the columns ``row``, ``column``, ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, or the width larger than the pitch.
    """
    n_x, n_y = check_count("n_x", n_x), check_count("n_y", n_y)
    pitch_um = check_length_um("pitch_um", pitch_um)
    if width_um is not None:
        width_um = check_length_um("width_um", width_um, at_most=pitch_um, cure="it is no larger than 'pitch_um'")
    check_sites(n_x * n_y)
    row, column = (index.ravel() for index in np.divmod(np.arange(n_y * n_x), n_x))
    corners = square_corners_um(column - 0.5 * n_x, row - 0.5 * n_y, pitch_um, width_um)
    return Layout.from_equal_rings(
        corners,
        {"row": row, "column": column, "readout_line": column},
        {
            "generator": "grid",
            "parameters": {"n_x": n_x, "n_y": n_y, "pitch_um": pitch_um, "width_um": width_um},
        },
    )


def square_corners_um(x: Floats, y: Floats, pitch_um: float, width_um: float | None = None) -> Floats:
    """
    Corners (n, 4, 2) µm of grid squares with their lower left corners at (x, y), in pitches.

    Neighbours' corners are the same numbers, bit for bit, when they tile.
    """
    margin = 0.0 if width_um is None else 0.5 * (1.0 - width_um / pitch_um)
    low, high = margin, 1.0 - margin
    return pitch_um * np.stack(
        [np.stack((x + dx, y + dy), axis=-1) for dx, dy in ((low, low), (high, low), (high, high), (low, high))], axis=1
    )
