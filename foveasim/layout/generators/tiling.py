"""Tiling of regions with equal squares or hexagons, and filling of gaps in layouts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import shapely

from foveasim._core.calls import LENGTH
from foveasim._core.validation import Floats, check_point, check_sites
from foveasim.errors import GeometryError, LayoutWarning, ParameterError, warn
from foveasim.layout._regions import as_region, parse_region
from foveasim.layout.drc.measurements import is_below_size
from foveasim.layout.edits.all_sites import clip, merge_small, union
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.model import Layout, derived
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["Cells", "fill", "tiling", "with_hexagons"]

Cells: TypeAlias = Literal["hexagons", "squares"]
Border: TypeAlias = Literal["merge", "cut", "drop"]

#: Corners of a cell around its centre, counter-clockwise, in lattice steps.
CORNERS = {
    "squares": np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]),
    "hexagons": np.array([(1, -1), (1, 1), (0, 2), (-1, 1), (-1, -1), (0, -2)]),
}
#: Default fraction of a cell below which a piece is merged into a neighbour.
SMALL_FRACTION = 0.5
#: Fraction of the region below which uncovered area is rounding.
AREA_ROUNDING = 1e-9


def _guess_pitch_um(n_sites: int, parameters: Mapping[str, Any]) -> float:
    """Return the pitch for which the area of the region is that of all cells."""
    region = parse_region(**{name: parameters[name] for name in ("size_um", "radius_um", "region")})
    cell_area = 1.0 if parameters["cells"] == "squares" else 0.5 * math.sqrt(3.0)
    return math.sqrt(region.area / (n_sites * cell_area))


@layout_generator(
    example={"pitch_um": 2.0, "radius_um": 14.0},
    solve_for=(SolveFor(name="pitch_um", is_integer=False, is_increasing=False, guess=_guess_pitch_um),),
)
def tiling(
    pitch_um: Annotated[float | None, LENGTH] = None,
    *,
    cells: Cells = "hexagons",
    size_um: tuple[float, float] | None = None,
    radius_um: float | None = None,
    region: Any = None,
    border: Border = "merge",
    min_size_um: Annotated[float | None, LENGTH] = None,
    origin_um: tuple[float, float] = (0.0, 0.0),
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate equal squares or hexagons that fill a region up to its boundary.

    ::

          ╭──┬───┬──╮
         ╱ ╲ │ ╱╲│╱ ╲          complete cells: pitch_um from centre to centre
        │   ╳   ╳   │
        │  │ │ · │ ││          · origin_um, the centre of a cell
         ╲ ╱ ╲ ╱ ╲ ╱
          ╰───┴───┴─╯          border: small pieces are merged into adjacent cells

    Parameters
    ----------
    pitch_um : float, µm
        Distance between the centres of adjacent cells.
    cells : {"hexagons", "squares"}
        Shape of the cells. Hexagons have a corner at the top.
    size_um : (width, height), optional, µm
        Rectangular region around the optical axis.
    radius_um : float, optional, µm
        Circular region around the optical axis, a polygon of 960 sides.
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, optional, µm
        Arbitrary region, with one or more parts, with or without holes.
    border : {"merge", "cut", "drop"}
        Treatment of cells that the boundary cuts. ``"merge"``: pieces below ``min_size_um`` are merged into the neighbour
        with the longest shared edge. ``"cut"``: all pieces remain separate sites. ``"drop"``: only complete cells remain.
    min_size_um : float, optional, µm
        Minimum size of a site, the square root of its area, as in the design rule ``min_size_um``; by default that of half
        a cell. Invalid with ``border="cut"``, and with ``"drop"`` if complete cells are smaller.
    origin_um : (x, y), µm
        Centre of one of the cells.
    n_sites : int, optional
        Number of sites, instead of ``pitch_um``, within 1 %.

    Returns
    -------
    Layout
        Row by row, with the columns ``row``, ``column`` (of the lattice, from 0; a merged site has those of one of its
        parts) and ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, not exactly one region is given, or ``border`` allows sites below ``min_size_um``.
    GeometryError
        When the region is too small for a single site.

    Warns
    -----
    LayoutWarning
        When parts of the region that are smaller than a site remain uncovered with ``border="merge"``.

    Examples
    --------
    >>> layout = tiling(pitch_um=4.0, radius_um=50.0)
    >>> (
    ...     layout.n_sites,
    ...     round(float(layout.area_um2.sum()), 1),
    ...     round(float(layout.area_um2.min()), 1),
    ... )
    (571, 7853.9, 7.0)
    """
    outline = parse_region(size_um=size_um, radius_um=radius_um, region=region)
    assert pitch_um is not None
    origin = np.array(check_point("origin_um", origin_um))
    if min_size_um is not None and border == "cut":
        rule = "must be omitted with border='cut', which retains all pieces"
        raise ParameterError("min_size_um", rule, min_size_um, "µm", "take border='merge'")
    lattice = _lattice(outline.bounds, pitch_um, cells, origin)
    if border == "drop" and min_size_um is not None and is_below_size(lattice.area_um2, min_size_um).any():
        raise ParameterError(
            "min_size_um",
            f"must be <= {math.sqrt(lattice.area_um2[0]):.6g}, the size of a complete cell",
            min_size_um,
            "µm",
            "take a larger pitch, or border='merge'",
        )
    layout = clip(lattice, outline, cut="drop" if border == "drop" else "pieces")
    if border == "merge":
        smallest_um = math.sqrt(SMALL_FRACTION * lattice.area_um2[0]) if min_size_um is None else min_size_um
        pieces_um2 = float(layout.area_um2.sum())
        layout = _merge_small_pieces(layout, smallest_um)
        open_um2 = pieces_um2 - float(layout.area_um2.sum())
        if layout.n_sites and open_um2 > AREA_ROUNDING * pieces_um2:
            warn(
                f"{open_um2:.6g} µm² of the region remain uncovered, in parts smaller than a site of {smallest_um:.6g} µm; "
                "exclude them from the region, or take a smaller 'min_size_um'",
                LayoutWarning,
            )
    if layout.n_sites == 0:
        raise GeometryError("the region is too small for a single site; enlarge it, or take a smaller pitch")
    row, column = (layout.columns[name] - layout.columns[name].min() for name in ("row", "column"))
    return Layout(*layout.rings_um, {"row": row, "column": column, "readout_line": column})


def fill(layout: Layout, region: Any, *, size_um: Annotated[float, LENGTH], columns_of: Layout | None = None) -> Layout:
    """
    Fill the uncovered part of a region of a layout, such as a blind spot, with hexagons.

    Parameters
    ----------
    layout : Layout
    region : shapely Polygon or MultiPolygon, or (n, 2) vertices, µm
        Region to fill; areas that existing sites cover are excluded.
    size_um : float, µm
        Size of the hexagons, the square root of their area. Smaller pieces at the boundary are merged into a neighbour, so
        that no new site is smaller.
    columns_of : Layout, optional
        Layout whose nearest sites provide the column values of new sites, with all columns of ``layout``; by default
        ``layout`` itself.

    Returns
    -------
    Layout
        The sites of the layout, then the new ones. Parts of the region that are too small for a site remain uncovered.

    Raises
    ------
    ParameterError
        When the region is not a valid polygon, or the size is out of range.

    Examples
    --------
    >>> import foveasim as fs
    >>> import shapely
    >>> rings = fs.layout.log_polar(n_sectors=24, min_size_um=2.0, r_max_um=32.4)
    >>> filled = fs.layout.fill(rings, shapely.Point(0, 0).buffer(10.0), size_um=2.0)
    >>> filled.n_sites - rings.n_sites  # hexagons in the blind spot
    25
    """
    open_region = _uncovered_part(layout, as_region("region", region))
    if open_region.is_empty:
        return layout
    return _append_sites(layout, _hexagons(open_region, size_um), layout if columns_of is None else columns_of, size_um)


def with_hexagons(layout: Layout, size_um: float, n_lines: int) -> Layout:
    """Fill the centre of a layout of rings with hexagons, read through the nearest sector."""
    ring = layout.columns["ring"]
    first = int(ring.min())
    around = shapely.coverage_union_all(layout[ring == first].polygons())
    hexagons = _hexagons(shapely.Polygon(around.interiors[0]), size_um)
    if hexagons.n_sites == 0:
        raise ParameterError("fovea", f"must fit a hexagon of {size_um:g} µm inside the first ring", "hexagons")
    angle_rad = np.arctan2(hexagons.centroid_um[:, 1], hexagons.centroid_um[:, 0]) % (2.0 * math.pi)
    line = np.floor(angle_rad * n_lines / (2.0 * math.pi)).astype(np.int64) % n_lines
    shift = 1 if first == 0 else 0
    inside = hexagons.with_columns(
        ring=np.full(hexagons.n_sites, first - 1 + shift), sector=np.arange(hexagons.n_sites), readout_line=line
    )
    return union([inside, layout.with_columns(ring=ring + shift)]).with_provenance(layout.provenance)


def _hexagons(region: Any, size_um: float) -> Layout:
    """Tile a region with hexagons of an area of size², and larger sites at the boundary."""
    # The factor above 1 compensates for the rounding of areas.
    pitch_um = size_um * math.sqrt(2.0 / math.sqrt(3.0)) * (1.0 + 1e-9)
    return _merge_small_pieces(clip(_lattice(region.bounds, pitch_um, "hexagons", np.zeros(2)), region), size_um)


def _merge_small_pieces(pieces: Layout, min_size_um: float) -> Layout:
    """Merge small pieces into their neighbours; omit those without neighbours."""
    layout = merge_small(pieces, min_size_um=min_size_um)
    return layout[~is_below_size(layout.area_um2, min_size_um)]


def _lattice(bounds_um: tuple[float, float, float, float], pitch_um: float, cells: str, origin_um: Floats) -> Layout:
    """Return all cells of the lattice that overlap a bounding box."""
    # Corners lie on a lattice of half pitches (and half sides), so shared corners are bit-identical.
    step_um = 0.5 * pitch_um * np.array([1.0, 1.0 if cells == "squares" else 1.0 / math.sqrt(3.0)])
    row_steps = 2 if cells == "squares" else 3
    low, high = ((np.asarray(bounds_um[i : i + 2]) - origin_um) / step_um for i in (0, 2))
    first, last = np.floor((low - 2.0) / (2, row_steps)) - 1, np.ceil((high + 2.0) / (2, row_steps)) + 1
    n_columns, n_rows = (last - first + 1).tolist()
    check_sites(max(1, int(min(n_columns * n_rows, 1e18))))
    row, column = (index.ravel() for index in np.indices((int(n_rows), int(n_columns))))
    row, column = row + int(first[1]), column + int(first[0])
    centre = np.stack((2 * column + (row % 2 if cells == "hexagons" else 0), row_steps * row), axis=1)
    rings_um = (centre[:, np.newaxis] + CORNERS[cells]) * step_um + origin_um
    box_um = np.concatenate((rings_um.min(axis=1), rings_um.max(axis=1)), axis=1)
    x0, y0, x1, y1 = bounds_um
    reaches = (box_um[:, 2] > x0) & (box_um[:, 0] < x1) & (box_um[:, 3] > y0) & (box_um[:, 1] < y1)
    return Layout.from_equal_rings(
        rings_um[reaches], {"row": row[reaches] - int(first[1]), "column": column[reaches] - int(first[0])}
    )


def _uncovered_part(layout: Layout, region: Any) -> Any:
    """Return the part of a region that no site covers."""
    polygons = layout.polygons()
    near = polygons[shapely.STRtree(polygons).query(region)]
    return shapely.difference(region, shapely.union_all(near)) if near.size else region


def _append_sites(layout: Layout, new: Layout, source: Layout, size_um: float) -> Layout:
    from scipy.spatial import cKDTree

    if new.n_sites and source.n_sites:
        nearest = np.asarray(cKDTree(source.centroid_um).query(new.centroid_um)[1], dtype=np.int64)
        columns = {name: source.columns[name][nearest] for name in layout.columns}
        new = Layout(*new.rings_um, columns)
    both = union([layout, new])
    step = f"filled with {new.n_sites} sites of at least {size_um:g} µm"
    return derived(layout, step, both.rings_um, both.columns)
