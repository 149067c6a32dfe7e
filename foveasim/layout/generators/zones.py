"""Nested zones of arbitrary outlines, each with its own pixel pitch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import shapely

from foveasim._core.calls import Limits
from foveasim._core.validation import MAX_LENGTH_UM, Floats, Ints, finite_array
from foveasim.errors import ParameterError
from foveasim.layout._regions import as_region
from foveasim.layout.edits.all_sites import union
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.generators.grid import square_corners_um
from foveasim.layout.generators.tiling import Cells, tiling
from foveasim.layout.model import Layout
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["zones"]

#: Maximum number of pixels along the side of a zone.
MAX_PIXELS = 2**14
#: Tolerance of integer ratios of lengths.
INTEGER_ROUNDING = 1e-9


def _areas_um2(parameters: Mapping[str, Any]) -> tuple[float, Floats]:
    """Return the width of the innermost zone, µm, and the areas of all zones, µm²."""
    if parameters["side_um"] is not None:
        sides_um = np.asarray(parameters["side_um"], dtype=np.float64)
        return float(sides_um[0]), np.diff(sides_um**2, prepend=0.0)
    outlines = [as_region(f"outlines_um[{i}]", outline) for i, outline in enumerate(parameters["outlines_um"])]
    return _width_um(outlines[0]), np.diff([outline.area for outline in outlines], prepend=0.0)


def _sites_per_pixel2(parameters: Mapping[str, Any]) -> float:
    """Return the number of squares over the squared number across the innermost zone."""
    width_um, area_um2 = _areas_um2(parameters)
    return float((area_um2 / 4.0 ** np.arange(area_um2.size)).sum() / width_um**2)


def _count_cells(parameters: Mapping[str, Any]) -> float | None:
    """Return the number of squares in zones of squares; None where it requires a layout."""
    if parameters["side_um"] is None or parameters["cells"] != "squares":
        return None
    return _sites_per_pixel2(parameters) * float(parameters["n_fovea"]) ** 2


@layout_generator(
    example={"side_um": (8.0, 16.0, 32.0), "pitch_um": (1.0, 2.0, 4.0)},
    solve_for=(
        SolveFor(
            name="n_fovea",
            guess=lambda n_sites, parameters: (n_sites / _sites_per_pixel2(parameters)) ** 0.5,
            count=_count_cells,
            is_optional=True,
        ),
    ),
)
def zones(
    pitch_um: Sequence[float] | None = None,
    side_um: Sequence[float] | None = None,
    *,
    n_fovea: Annotated[int | None, Limits(at_least=1, at_most=MAX_PIXELS)] = None,
    outlines_um: Sequence[Any] | None = None,
    cells: Cells | Sequence[Cells] = "squares",
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate nested zones, each with its own grid around the inner zone.

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
    pitch_um : sequence of float, µm
        Pixel pitch of each zone, from the innermost.
    n_fovea : int, optional
        Instead of the pitches: number of pixels across the innermost zone. The pitch doubles from zone to zone.
    side_um : sequence of float, optional, µm
        Increasing sides of square zones around the optical axis. In zones of squares, the side of the zone and that of the
        inner zone must be multiples of the pitch, with an integer number of pixels on each side of the inner zone.
    outlines_um : sequence of shapely Polygons or (n, 2) vertices, optional, µm
        Arbitrary outlines instead of the sides, each enclosing the previous one. Pieces of pixels at a boundary with less
        than half the area of a pixel are merged into the adjacent pixel.
    cells : {"squares", "hexagons"} or a sequence of them
        Shape of the pixels, in all zones or in each. Hexagons are cut at zone boundaries as with arbitrary outlines.
    n_sites : int, optional
        Number of sites, instead of ``n_fovea``, within 1 %. Few numbers are possible in square zones of squares.

    Returns
    -------
    Layout
        Zone by zone, with the columns ``zone``, ``row``, ``column`` (in the grid of the zone) and ``readout_line`` (columns
        of all zones, numbered consecutively).

    Raises
    ------
    ParameterError
        When the sequences differ in length, zones are not nested, or the number of pixels is not an integer.
    GeometryError
        When a zone is smaller than one of its pixels.

    Examples
    --------
    A field that would require 262,144 sites with the pitch of the fovea:

    >>> zones(side_um=(64, 128, 256, 512), pitch_um=(1, 2, 4, 8)).n_sites
    13312
    """
    if (side_um is None) == (outlines_um is None):
        raise ParameterError("side_um", "or 'outlines_um' must be given, but only one of them")
    pitches_um = _pitches_um(pitch_um, n_fovea, side_um, outlines_um)
    shapes = [cells] * pitches_um.size if isinstance(cells, str) else list(cells)
    if len(shapes) != pitches_um.size:
        raise ParameterError(
            "cells", f"must be one shape, or one for each of the {pitches_um.size} zones, got {len(shapes)}"
        )
    outlines = None if outlines_um is None else _outlines(outlines_um, pitches_um.size)
    sides_um = None if side_um is None else _sides(side_um, pitches_um)
    if sides_um is not None and all(shape == "squares" for shape in shapes):
        return Layout.from_equal_rings(*_squares(sides_um, pitches_um))
    if outlines is None:
        outlines = [shapely.box(-0.5 * s, -0.5 * s, 0.5 * s, 0.5 * s) for s in (() if sides_um is None else sides_um)]
    layout = _tile_zones(outlines, pitches_um, shapes)
    return layout if outlines_um is None else layout.with_provenance({})


def _pitches_um(
    pitch_um: Sequence[float] | None,
    n_fovea: int | None,
    side_um: Sequence[float] | None,
    outlines_um: Sequence[Any] | None,
) -> Floats:
    if (pitch_um is None) == (n_fovea is None):
        raise ParameterError("pitch_um", "or 'n_fovea' must be given, but only one of them")
    if pitch_um is not None:
        return finite_array("pitch_um", pitch_um, ndim=1, above=0.0)
    assert n_fovea is not None
    widths_um = (side_um or ()) if outlines_um is None else [_width_um(as_region("outlines_um[0]", outlines_um[0]))]
    fovea_um = finite_array("side_um", widths_um, ndim=1, above=0.0)
    n_zones = len(fovea_um if outlines_um is None else outlines_um)
    return np.asarray(fovea_um[:1] / n_fovea * 2.0 ** np.arange(n_zones))


def _width_um(region: Any) -> float:
    return float(region.bounds[2] - region.bounds[0])


def _sides(side_um: Sequence[float], pitches_um: Floats) -> Floats:
    sides_um = finite_array("side_um", side_um, ndim=1, above=0.0)
    if sides_um.size == 0 or sides_um.size != pitches_um.size:
        raise ParameterError(
            "side_um",
            f"and 'pitch_um' must have the same length of at least 1, got {sides_um.size} and {pitches_um.size}",
        )
    if sides_um.max() > MAX_LENGTH_UM:
        raise ParameterError("side_um", f"must be <= {MAX_LENGTH_UM:g}", float(sides_um.max()), "µm")
    if np.any(np.diff(sides_um) <= 0):
        raise ParameterError("side_um", "must increase from zone to zone", sides_um.tolist(), "µm")
    return sides_um


def _outlines(outlines_um: Sequence[Any], n_zones: int) -> list[Any]:
    outlines = [as_region(f"outlines_um[{i}]", outline) for i, outline in enumerate(outlines_um)]
    if not outlines or len(outlines) != n_zones:
        raise ParameterError(
            "outlines_um", f"and 'pitch_um' must have the same length of at least 1, got {len(outlines)} and {n_zones}"
        )
    for i, (inner, outer) in enumerate(pairwise(outlines)):
        if not shapely.covers(outer, inner) or not outer.area > inner.area:
            raise ParameterError(f"outlines_um[{i + 1}]", f"must lie around 'outlines_um[{i}]' and be larger")
    return outlines


def _squares(sides_um: Floats, pitches_um: Floats) -> tuple[Floats, dict[str, Ints]]:
    """Return the corners and columns of complete squares in square zones."""
    corners, columns = [], []
    n_lines = 0
    inner_um = 0.0
    for zone, (outer_um, p_um) in enumerate(zip(sides_um, pitches_um, strict=True)):
        n = _integer_ratio(f"side_um[{zone}]", outer_um, p_um, outer_um / p_um)
        width = 0
        if zone > 0:
            width = _integer_ratio(f"pitch_um[{zone}]", p_um, outer_um - inner_um, 0.5 * (outer_um - inner_um) / p_um)
        row, column = (index.ravel() for index in np.divmod(np.arange(n * n), n))
        is_inside = (np.minimum(row, column) >= width) & (np.maximum(row, column) < n - width)
        if inner_um > 0.0:
            row, column = row[~is_inside], column[~is_inside]
        corners.append(square_corners_um(column - 0.5 * n, row - 0.5 * n, float(p_um)))
        columns.append(np.stack((np.full(row.size, zone), row, column, n_lines + column)))
        n_lines += n
        inner_um = outer_um
    names = ("zone", "row", "column", "readout_line")
    return np.concatenate(corners), dict(zip(names, np.concatenate(columns, axis=1), strict=True))


def _tile_zones(outlines: Sequence[Any], pitches_um: Floats, shapes: Sequence[Cells]) -> Layout:
    """Return zones of arbitrary outlines, clipped from their lattices."""
    parts = []
    n_lines = 0
    for zone, (outer, p_um, shape) in enumerate(zip(outlines, pitches_um, shapes, strict=True)):
        region = shapely.difference(outer, outlines[zone - 1]) if zone > 0 else outer
        # Aligned with the lower left corner, so that as many squares of a rectangle as possible are complete.
        x_um, y_um = (float(x + 0.5 * p_um) for x in outer.bounds[:2])
        part = tiling(region=region, pitch_um=float(p_um), cells=shape, origin_um=(x_um, y_um))
        line = n_lines + part.readout_line
        parts.append(part.with_columns(zone=np.full(part.n_sites, zone), readout_line=line))
        n_lines = int(line.max()) + 1
    return union(parts)


def _integer_ratio(name: str, value: float, of_um: float, ratio: float) -> int:
    if ratio > MAX_PIXELS:
        raise ParameterError(name, f"must give at most {MAX_PIXELS} pixels in a row, got {ratio:g}")
    if round(ratio) < 1 or abs(ratio - round(ratio)) > INTEGER_ROUNDING * max(ratio, 1.0):
        raise ParameterError(
            name,
            f"must give an integer number of pixels between zone boundaries ({of_um:g} µm gives {ratio:g} pixels)",
            float(value),
            "µm",
        )
    return round(ratio)
