"""Rectangular grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from foveasim._core.calls import LENGTH, NOT_NEGATIVE, Limits
from foveasim._core.validation import MAX_SITES, Floats, check_length_um, check_sites, freeze
from foveasim.errors import ParameterError
from foveasim.layout.generator_registry import COUNT, layout_generator
from foveasim.layout.lattice import RectangleLattice
from foveasim.layout.model import Layout
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["grid"]

#: Maximum number of sites without stored vertices.
MAX_LATTICE_SITES = 1_000_000_000
#: Rows that exceed the height of a field by rounding fit in it.
FIT_ROUNDING = 1.0 + 1e-9
FILL_FACTOR = Limits(above=0.0, at_most=1.0)


def _count_cells(parameters: Mapping[str, Any]) -> float:
    """Return the number of cells for parameters of :func:`grid`."""
    n_x, n_y, _ = cells_in_field(parameters["n_x"], parameters["n_y"], parameters["pitch_um"], parameters["size_um"])
    return float(n_x * n_y)


def guess_columns(n_sites: int, parameters: Mapping[str, Any]) -> float:
    """Return the number of columns of a field of square cells."""
    if parameters.get("n_y") is not None:
        return float(n_sites / parameters["n_y"])
    width_um, height_um = (1.0, 1.0) if parameters["size_um"] is None else parameters["size_um"]
    return math.sqrt(n_sites * width_um / height_um)


@layout_generator(
    example={"n_x": 14, "n_y": 14, "pitch_um": 2.0, "trench_um": 0.3, "stagger": True},
    solve_for=(SolveFor(name="n_x", guess=guess_columns, count=_count_cells),),
)
def grid(
    n_x: Annotated[int | None, COUNT] = None,
    n_y: Annotated[int | None, COUNT] = None,
    pitch_um: Annotated[float | None, LENGTH] = None,
    *,
    size_um: tuple[float, float] | None = None,
    pitch_y_um: Annotated[float | None, LENGTH] = None,
    width_um: float | None = None,
    trench_um: Annotated[float | None, NOT_NEGATIVE] = None,
    fill_factor: Annotated[float | None, FILL_FACTOR] = None,
    stagger: bool = False,
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate square or rectangular photosites in rows and columns around the optical axis.

    ::

        ┌────┐ ┌────┐ ┌────┐  ─┬─             stagger: every second row shifted by half a pitch
        │    │ │    │ │    │   │ width_um          ┌────┐ ┌────┐ ┌────┐
        └────┘ └────┘ └────┘  ─┴─                  └────┘ └────┘ └────┘
        ├──────┤    ├─┤                       ┌────┐ ┌────┐ ┌────┐
         pitch_um   trench_um                 └────┘ └────┘ └────┘

    Parameters
    ----------
    n_x, n_y : int
        Number of columns and rows; by default as many rows as columns.
    pitch_um : float, µm
        Pitch of the columns.
    size_um : (width, height), optional, µm
        Size of the field, instead of the pitch: the columns fill the width, and by default as many rows as fit in the height.
    pitch_y_um : float, optional, µm
        Pitch of the rows; ``pitch_um`` by default.
    width_um : float, optional, µm
        Side of the photosensitive square; sites tile the plane by default. With two pitches use ``trench_um``.
    trench_um : float, optional, µm
        Instead of the width: gap between two sites.
    fill_factor : float, optional
        Instead of the width: photosensitive fraction of a cell, ``(1 - trench / pitch)²`` for squares; with two pitches,
        sites have the aspect ratio of the cells.
    stagger : bool
        Shift every second row, from the second, by half a pitch to the right.
    n_sites : int, optional
        Number of sites, instead of ``n_x``, within 1 %.

    Returns
    -------
    Layout
        Row by row from the lowest y, with the columns ``row``, ``column``, ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, the width exceeds the pitch, or a width or the pitch is specified twice.

    Examples
    --------
    >>> layout = grid(n_sites=14_000, size_um=(1380.0, 1380.0))
    >>> layout.n_sites, round(layout.provenance["parameters"]["size_um"][0] / 118, 3)
    (13924, 11.695)
    """
    n_x, n_y, pitch_um = cells_in_field(n_x, n_y, pitch_um, size_um)
    if pitch_y_um is not None and width_um is not None:
        raise ParameterError("width_um", "must be replaced by 'trench_um' if 'pitch_y_um' is given", width_um)
    pitches_um = pitch_um, pitch_um if pitch_y_um is None else pitch_y_um
    fractions = [linear_fill_factor(p_um, width_um, trench_um, fill_factor) for p_um in pitches_um]
    check_sites(n_x * n_y, at_most=MAX_SITES if stagger else MAX_LATTICE_SITES)
    # 32 bits: products of an index and the number of columns do not overflow.
    row = freeze(np.repeat(np.arange(n_y, dtype=np.int32), n_x))
    column = freeze(np.tile(np.arange(n_x, dtype=np.int32), n_y))
    columns = {"row": row, "column": column, "readout_line": column}
    if not stagger:
        x_um, y_um = (
            (np.arange(n)[:, np.newaxis] - 0.5 * n + cell_interval(fraction)) * p_um
            for n, fraction, p_um in zip((n_x, n_y), fractions, pitches_um, strict=True)
        )
        return Layout.from_lattice(RectangleLattice(x_um, y_um), columns)
    shift = 0.5 * (row % 2).astype(np.float64) - 0.25 * (n_y > 1)
    x, y = column - 0.5 * n_x + shift, row.astype(np.float64) - 0.5 * n_y
    corners = square_corners_um(x, y, pitch_um, pitch_y_um, fractions)
    return Layout.from_equal_rings(corners, columns)


def cells_in_field(
    n_x: int | None, n_y: int | None, pitch_um: float | None, size_um: tuple[float, float] | None
) -> tuple[int, int, float]:
    """Return columns, rows and pitch of square cells, from their pitch or field."""
    assert n_x is not None
    field_um = check_field_um(pitch_um, size_um)
    if field_um is None:
        assert pitch_um is not None
        return n_x, n_y or n_x, pitch_um
    pitch_um = field_um[0] / n_x
    return n_x, n_y or max(1, math.floor(field_um[1] / pitch_um * FIT_ROUNDING)), pitch_um


def check_field_um(pitch_um: float | None, size_um: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the size of a field, or None when the pitch is given instead."""
    if (pitch_um is None) == (size_um is None):
        raise ParameterError("pitch_um", "or 'size_um' must be given, but only one of them")
    if size_um is None:
        return None
    width_um, height_um = (check_length_um("size_um", length_um) for length_um in size_um)
    return width_um, height_um


def linear_fill_factor(
    pitch_um: float, width_um: float | None, trench_um: float | None, fill_factor: float | None
) -> float | None:
    """Return the photosensitive fraction of the width of a cell; None if sites tile the plane."""
    if sum(x is not None for x in (width_um, trench_um, fill_factor)) > 1:
        raise ParameterError("width_um", "and 'trench_um' and 'fill_factor' exclude each other; give one of them")
    if width_um is not None:
        return check_length_um("width_um", width_um, at_most=pitch_um, hint="the upper limit is 'pitch_um'") / pitch_um
    if trench_um is not None:
        if not trench_um < pitch_um:
            raise ParameterError("trench_um", f"must be < {pitch_um:g}, the pitch", trench_um, "µm")
        return 1.0 - trench_um / pitch_um if trench_um > 0.0 else None
    return math.sqrt(fill_factor) if fill_factor is not None and fill_factor < 1.0 else None


def cell_interval(fraction: float | None) -> Floats:
    """Return both ends of a centred fraction of the interval from 0 to 1, (2,); None for all."""
    margin = 0.0 if fraction is None else 0.5 * (1.0 - fraction)
    return np.array([margin, 1.0 - margin])


def square_corners_um(
    x: Floats,
    y: Floats,
    pitch_um: float,
    pitch_y_um: float | None = None,
    fractions: Sequence[float | None] = (None, None),
) -> Floats:
    """
    Return the corners (n, 4, 2) µm of grid cells, or of a centred fraction of each cell.

    ``x`` and ``y`` are the lower left corners of the cells in pitches. Corners that neighbours share are bit-identical when
    cells tile.
    """
    (x0, x1), (y0, y1) = (cell_interval(fraction) for fraction in fractions)
    steps = np.stack([np.stack((x + dx, y + dy), axis=-1) for dx, dy in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], 1)
    return np.asarray(steps * np.array([pitch_um, pitch_um if pitch_y_um is None else pitch_y_um]))
