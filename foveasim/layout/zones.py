"""Nested square zones, each of larger pixels than the one inside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from foveasim.arrays import MAX_LENGTH_UM, finite_array
from foveasim.errors import ParameterError
from foveasim.layout._model import Layout
from foveasim.layout.grid import square_corners_um

__all__ = ["zones"]

#: Pixels along the side of a zone, at most.
MAX_PIXELS = 2**14
#: Ratios of lengths may be this far from whole numbers.
WHOLE_NUMBER_ROUNDING = 1e-9


def zones(*, side_um: Sequence[float], pitch_um: Sequence[float]) -> Layout:
    """
    Square zones around the optical axis, each filled with its own grid where the zone inside leaves room.

    ::

        ┌───┬───┬───┬───┐  ─┬─
        │   │   │   │   │   │
        ├───┼─┬─┼─┬─┼───┤   │           zone 0: fovea of side side_um[0], pitch pitch_um[0]
        │   ├─┼─┼─┼─┤   │   │ side_um[1]
        ├───┼─┼─┼─┼─┼───┤   │           zone 1: around it, to side_um[1], pitch pitch_um[1]
        │   ├─┼─┼─┼─┤   │   │
        ├───┼─┴─┼─┴─┼───┤   │           ...
        │   │   │   │   │   │
        └───┴───┴───┴───┘  ─┴─

    Parameters
    ----------
    side_um : sequence of float, µm
        Sides of the zones, growing.
    pitch_um : sequence of float, µm
        Pixel pitch in each. A zone's side and the side of the zone inside it must fit whole pixels.

    Returns
    -------
    Layout
        Zone by zone, with the columns ``zone``, ``row``, ``column`` (in the zone's own grid) and ``readout_line``
        (the columns of all zones, numbered through).

    Raises
    ------
    ParameterError
        When the lists differ in length, the sides do not grow, or pixels do not fit.

    Examples
    --------
    The same field that takes 262,144 sites of the fovea's size:

    >>> zones(side_um=(64, 128, 256, 512), pitch_um=(1, 2, 4, 8)).n_sites
    13312
    """
    sides = finite_array("side_um", side_um, ndim=1, above=0.0)
    pitches = finite_array("pitch_um", pitch_um, ndim=1, above=0.0)
    if sides.size == 0 or sides.size != pitches.size:
        raise ParameterError(
            "side_um", f"and 'pitch_um' must have the same length of at least 1, got {sides.size} and {pitches.size}"
        )
    if sides.max() > MAX_LENGTH_UM:
        raise ParameterError("side_um", f"must be <= {MAX_LENGTH_UM:g}", float(sides.max()), "µm")
    if np.any(np.diff(sides) <= 0):
        raise ParameterError("side_um", "must grow from zone to zone", sides.tolist(), "µm")
    corners, columns = [], []
    n_lines = 0
    inner_um = 0.0
    for zone, (outer_um, p_um) in enumerate(zip(sides, pitches, strict=True)):
        n = _whole(f"side_um[{zone}]", outer_um, p_um, outer_um / p_um)
        border = 0
        if zone > 0:
            border = _whole(f"pitch_um[{zone}]", p_um, outer_um - inner_um, 0.5 * (outer_um - inner_um) / p_um)
        row, column = (index.ravel() for index in np.divmod(np.arange(n * n), n))
        is_inside = (np.minimum(row, column) >= border) & (np.maximum(row, column) < n - border)
        if inner_um > 0.0:
            row, column = row[~is_inside], column[~is_inside]
        corners.append(square_corners_um(column - 0.5 * n, row - 0.5 * n, float(p_um)))
        columns.append(np.stack((np.full(row.size, zone), row, column, n_lines + column)))
        n_lines += n
        inner_um = outer_um
    zone_ids, row, column, line = np.concatenate(columns, axis=1)
    return Layout.from_equal_rings(
        np.concatenate(corners),
        {"zone": zone_ids, "row": row, "column": column, "readout_line": line},
        {
            "generator": "zones",
            "parameters": {"side_um": sides.tolist(), "pitch_um": pitches.tolist()},
        },
    )


def _whole(name: str, value: float, of_um: float, ratio: float) -> int:
    if ratio > MAX_PIXELS:
        raise ParameterError(name, f"asks for {ratio:g} pixels in a row, more than {MAX_PIXELS}")
    if round(ratio) < 1 or abs(ratio - round(ratio)) > WHOLE_NUMBER_ROUNDING * max(ratio, 1.0):
        raise ParameterError(
            name,
            f"must fit whole pixels between the zones' borders ({of_um:g} µm gives {ratio:g} pixels)",
            float(value),
            "µm",
        )
    return round(ratio)
