"""
Surface meshes of photosites: flat polygons for PyVista, triangulations, and prisms.

Coordinates are those of the sensor: x to the right, y up, z toward the lens. Triangles are counter-clockwise from outside.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import LENGTH
from foveasim._core.extras import import_optional
from foveasim._core.provenance import to_plain_data
from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    as_numbers,
    finite_array,
    unit_of,
    unmasked,
)
from foveasim.capture import Capture
from foveasim.columns import COLUMNS, MAIN, column_info
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import Layout
from foveasim.view.site_colours import SiteColours, colours_of
from foveasim.view.site_pictures import colours_in_picture

if TYPE_CHECKING:
    from pyvista import PolyData

__all__ = ["Caps", "Mesh", "extrude", "polydata", "prisms", "triangulate"]

#: Triangles below this fraction of the area of their site's bounding box are degenerate in float64.
DEGENERATE_FRACTION = 1e-12
#: Default height of the tallest prism as a fraction of the layout's longer side.
MAX_HEIGHT_FRACTION = 0.15
#: Sites per call of the triangulation.
SITES_PER_CALL = 20_000

Indices = NDArray[np.int32]
RgbArray = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Mesh:
    """
    Triangle mesh with the photosite, value and colour of every point.

    Attributes
    ----------
    name : str
        Name of the part, such as ``"wells"``.
    points_um : (n_point, 3) float64, µm
    triangles : (n_triangle, 3) int32
        Points of each triangle, counter-clockwise from outside. All three belong to one photosite.
    photosite : (n_point,) int32
        Photosite of each point; -1 for none.
    values : (n_point,) float64
        Value of the photosite, in its unit.
    colours : (n_point, 3) uint8
        Red, green, blue, sRGB-encoded.
    title : str
        Quantity and unit of the values, such as ``"code / DN"``.
    shown : SiteColours or None
        Colours of the photosites with their scale or legend.
    is_smooth : bool
        Whether the triangles that face up approximate a smooth surface, which is shaded without edges.

    Examples
    --------
    >>> import foveasim as fs
    >>> columns = fs.view.prisms(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), [1.0, 3.0], max_height_um=6.0
    ... )
    >>> columns.points_um.max(axis=0).tolist(), sorted(set(columns.photosite.tolist()))
    ([2.0, 1.0, 6.0], [0, 1])
    """

    name: str
    points_um: Floats
    triangles: Indices
    photosite: Indices
    values: Floats
    colours: RgbArray
    title: str = ""
    shown: SiteColours | None = None
    is_smooth: bool = False

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {self.triangles.shape[0]:,} triangles)"

    @property
    def bounds_um(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner of the bounding box, (3,) µm each."""
        if self.points_um.size == 0:
            raise GeometryError(f"the mesh {self.name!r} is empty and has no bounds")
        return self.points_um.min(axis=0), self.points_um.max(axis=0)

    def to_pyvista(self) -> PolyData:
        """
        Return the mesh as PolyData.

        Returns
        -------
        pyvista.PolyData
            Cell data: the values (the active scalars) by their title, such as ``code / DN``, or as ``value``; ``site``, the
            photosite of each triangle; ``rgb``, the colours.

        Raises
        ------
        ParameterError
            When PyVista is not installed.
        """
        first = self.triangles[:, 0]
        mesh = _polydata(
            self.points_um, np.arange(self.triangles.shape[0] + 1, dtype=np.int32) * 3, self.triangles.ravel()
        )
        name = self.title or "value"
        mesh.cell_data[name] = self.values[first]
        mesh.cell_data["site"] = self.photosite[first]
        mesh.cell_data["rgb"] = self.colours[first]
        mesh.set_active_scalars(name, preference="cell")
        return mesh


class Caps(NamedTuple):
    """Triangulation of photosites."""

    triangles: Ints
    """(n_triangle, 3) vertices of the layout, counter-clockwise."""
    site: Ints
    """(n_triangle,) site of each triangle."""
    weld: Ints
    """(n_vertex,) representative of each vertex: itself, except where a hole touches the outline in a vertex."""


def triangulate(layout: Layout) -> Caps:
    """
    Triangulate every photosite exactly, with its own vertices only.

    ``layout``: with sites that do not intersect themselves.

    A fan from one vertex covers the site when none of its triangles is reversed: the winding numbers of its triangles then sum
    to 1 inside the outline and to 0 outside. Other sites, and those with holes, use the constrained Delaunay triangulation of
    GEOS.
    """
    n_vertices = np.diff(layout.ring_offsets)
    has_hole = np.diff(layout.site_offsets) > 1
    fans, smallest = triangle_fans(layout.xy_um, layout.ring_offsets)
    is_fan = (smallest[layout.site_offsets[:-1]] > DEGENERATE_FRACTION) & ~has_hole
    ring_of_fan = np.repeat(np.arange(n_vertices.size), n_vertices - 2)
    site_of_ring = np.repeat(np.arange(layout.n_sites), np.diff(layout.site_offsets))
    site = site_of_ring[ring_of_fan]
    weld = np.arange(layout.xy_um.shape[0])
    if is_fan.all():
        return Caps(fans, site, weld)
    keep = is_fan[site]
    others = np.flatnonzero(~is_fan)
    pieces = parallel_map(
        lambda part: delaunay(layout, part),
        np.split(others, range(SITES_PER_CALL, others.size, SITES_PER_CALL)),
        thread_count(),
    )
    for _, _, vertices, representatives in pieces:
        weld[vertices] = representatives
    return Caps(
        np.concatenate([fans[keep], *(piece[0] for piece in pieces)]),
        np.concatenate([site[keep], *(piece[1] for piece in pieces)]),
        weld,
    )


def extrude(
    layout: Layout, caps: Caps, low_um: ArrayLike, high_um: ArrayLike, *, has_floor: bool = True
) -> tuple[Floats, Indices, Indices]:
    """
    Extrude photosites to prisms.

    ``caps``: triangulation of the same layout. ``low_um``, ``high_um`` (number or (n_site,), µm): heights of the bottom and
    top faces. ``has_floor``: whether the prisms have bottom faces. Returns ``points_um`` (2 n_vertex, 3) float64, µm: vertices
    of the layout at the bottom, then at the top. ``triangles`` (n_triangle, 3) int32. ``photosite`` (2 n_vertex,) int32.
    """
    n = layout.xy_um.shape[0]
    vertices_of_site = np.diff(layout.ring_offsets[layout.site_offsets])
    points_um = np.empty((2 * n, 3))
    points_um[:n, :2] = points_um[n:, :2] = layout.xy_um
    points_um[:n, 2] = np.repeat(np.broadcast_to(as_numbers("low_um", low_um), layout.n_sites), vertices_of_site)
    points_um[n:, 2] = np.repeat(np.broadcast_to(as_numbers("high_um", high_um), layout.n_sites), vertices_of_site)
    here = caps.weld
    after = here[next_vertex(layout.ring_offsets)]
    n_caps = caps.triangles.shape[0]
    triangles = np.empty((2 * n + n_caps * (1 + has_floor), 3), np.int32)
    triangles[:n] = np.stack((here, after, after + n), axis=1)
    triangles[n : 2 * n] = np.stack((here, after + n, here + n), axis=1)
    triangles[2 * n : 2 * n + n_caps] = caps.triangles + n
    if has_floor:
        triangles[2 * n + n_caps :] = caps.triangles[:, ::-1]
    site = np.repeat(np.arange(layout.n_sites, dtype=np.int32), vertices_of_site)
    return points_um, triangles, np.concatenate((site, site))


def prisms(
    data: Layout | Capture,
    height: str | ArrayLike | None = None,
    *,
    by: str | ArrayLike | None = None,
    max_height_um: Annotated[float, LENGTH] | None = None,
    has_floor: bool = False,
) -> Mesh:
    """
    Return photosites as prisms whose heights show their values.

    Parameters
    ----------
    data : Layout or Capture
    height : str or (n_site,) array
        Quantity shown by the height: ``"code"``, ``"electrons"``, ``"expected_e"``, ``"area_um2"``, ``"size_um"``, any other
        numerical column, or one value per site, at least 0. By default the code of a capture, or the site sizes of a layout.
    by : str or array, optional
        Quantity shown by the colour, as in :func:`foveasim.view.colours_of`; by default that of the height. A colour capture
        without ``height`` and ``by`` has the colours of its picture.
    max_height_um : float, µm
        Height of the tallest prism; 0.15 of the layout's longer side by default.
    has_floor : bool
        Whether the prisms have bottom faces, which are visible from below and through cuts only.

    Returns
    -------
    Mesh
        ``values`` are those that the height shows.

    Raises
    ------
    GeometryError
        When the layout has no sites.
    ParameterError
        When a column does not exist, or there is not one finite value of at least 0 per site.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> columns = prisms(grid(n_x=2, n_y=1, pitch_um=2.0), [1.0, 3.0], max_height_um=6.0)
    >>> columns.points_um[:, 2].max(), columns.triangles.shape[0]
    (np.float64(6.0), 20)
    """
    is_capture = isinstance(data, Capture)
    layout = data.layout if isinstance(data, Capture) else data
    if isinstance(data, Capture) and height is None and by is None:
        by = colours_in_picture(data)
    height = (MAIN if is_capture else "size_um") if height is None else unmasked("height", height)
    try:
        shown = colours_of(data, height)
    except ParameterError as error:
        raise ParameterError("height", error.detail) from None
    values = finite_array("height", shown.values if shown.values is not None else height, ndim=1, at_least=0.0)
    coloured = shown if by is None else colours_of(data, by)
    x_min, y_min, x_max, y_max = layout.bounds_um
    if max_height_um is None:
        max_height_um = MAX_HEIGHT_FRACTION * max(x_max - x_min, y_max - y_min)
    max_value = float(values.max())
    heights_um = values * (max_height_um / max_value if max_value > 0.0 else 0.0)
    points_um, triangles, photosite = extrude(layout, triangulate(layout), 0.0, heights_um, has_floor=has_floor)
    return Mesh(
        name="columns",
        points_um=points_um,
        triangles=triangles,
        photosite=photosite,
        values=values[photosite],
        colours=coloured.rgb[photosite],
        title=shown.title,
        shown=coloured,
    )


def polydata(data: Layout | Capture) -> PolyData:
    """
    Return photosites as PyVista polygons in the plane z = 0.

    Parameters
    ----------
    data : Layout or Capture

    Returns
    -------
    pyvista.PolyData
        One polygon per site in site order, so that arrays over sites are cell data; only a site with a hole is several
        triangles. Cell data: for a capture ``code`` (the active scalars), ``electrons``, ``expected_e``, ``filter_of_site``
        and registered columns; ``site``, the index of the photosite of each cell; ``area_um2`` (the active scalars of a
        layout), ``channel``, ``readout_line``, and every column. Field data, as JSON: ``units`` by array name, ``provenance``,
        and for a capture ``settings``.

    Raises
    ------
    ParameterError
        When PyVista is not installed.

    Notes
    -----
    VTK measures cells with reflex vertices incorrectly; use ``area_um2``, or ``triangulate()`` the mesh first.

    Examples
    --------
    >>> import foveasim as fs
    >>> mesh = fs.view.polydata(fs.layout.hexagonal(n_columns=4, n_rows=4, pitch_um=3.0))
    >>> mesh.n_cells, sorted(mesh.cell_data)[:3]
    (16, ['area_um2', 'channel', 'column'])
    """
    layout = data.layout if isinstance(data, Capture) else data
    columns: dict[str, NDArray[Any]] = {}
    notes: dict[str, Any] = {"provenance": to_plain_data(dict(layout.provenance))}
    if isinstance(data, Capture):
        columns = {name: data.column(name) for name in COLUMNS if column_info(name).in_tables}
        notes["settings"] = data.settings
    active = MAIN if columns else "area_um2"
    columns |= {
        "site": np.arange(layout.n_sites, dtype=np.int32),
        "area_um2": layout.area_um2,
        "channel": layout.channel,
        "readout_line": layout.readout_line,
        **layout.columns,
    }
    units = {name: column_info(name).unit if name in COLUMNS else unit_of(name) for name in columns}
    notes["units"] = {name: unit for name, unit in units.items() if unit}
    xy_um, offsets, corners, site = _cells(layout)
    mesh = _polydata(
        np.column_stack((xy_um, np.zeros(xy_um.shape[0]))), offsets.astype(np.int32), corners.astype(np.int32)
    )
    for name, column in columns.items():
        mesh.cell_data[name] = (column.astype(np.float32) if column.dtype == np.float16 else column)[site]
    for name, note in notes.items():
        mesh.field_data[name] = [json.dumps(note)]
    if mesh.n_cells:
        mesh.set_active_scalars(active, preference="cell")
    return mesh


# -- parts ---------------------------------------------------------------------------------------------------------------


def _cells(layout: Layout) -> tuple[Floats, Ints, Ints, Ints]:
    """
    Return polygons of all sites: points (n_point, 2), offsets, corners and sites.

    Sites with holes, which VTK polygons cannot have, are split into triangles. VTK draws quadrilaterals with a reflex vertex
    incorrectly: these begin at this vertex, so that a triangle fan is correct, and have the centre of an edge as an additional
    point.
    """
    counts, has_hole = np.diff(layout.ring_offsets), np.diff(layout.site_offsets) > 1
    first_ring = layout.site_offsets[:-1]
    is_quad = ~has_hole & ~_is_convex(layout) & (counts[first_ring] == 4)
    if not (has_hole.any() or is_quad.any()):
        return layout.xy_um, layout.ring_offsets, np.arange(layout.xy_um.shape[0]), np.arange(layout.n_sites)
    caps = triangulate(layout)
    is_part = has_hole[caps.site]
    simple = np.flatnonzero(~has_hole)
    sizes = np.concatenate((counts[first_ring[simple]], np.full(np.count_nonzero(is_part), 3)))
    site = np.concatenate((simple, caps.site[is_part]))
    starts = layout.ring_offsets[first_ring[simple]]
    vertices = np.repeat(starts, counts[first_ring[simple]]) + positions_in_runs(counts[first_ring[simple]])
    quads = np.flatnonzero(is_quad)
    start = layout.ring_offsets[first_ring[quads]]
    places = start[:, np.newaxis] + np.arange(4)
    reflex = np.argmin(_turn_sines(layout.xy_um, layout.ring_offsets)[places], axis=1)
    places = start[:, np.newaxis] + (reflex[:, np.newaxis] + np.arange(4)) % 4
    vertices[np.searchsorted(vertices, start)[:, np.newaxis] + np.arange(4)] = places
    flat = np.concatenate((vertices, caps.triangles[is_part].ravel()))
    # Additional points after the last corner of their site.
    middle_um = 0.5 * (layout.xy_um[places[:, 0]] + layout.xy_um[places[:, 3]])
    last = np.cumsum(sizes)[np.searchsorted(simple, quads)]
    flat = np.insert(flat, last, layout.xy_um.shape[0] + np.arange(quads.size))
    sizes[np.searchsorted(simple, quads)] += 1
    # In site order, so that the cells of a site are contiguous.
    order = np.argsort(site, kind="stable")
    begin = np.concatenate(([0], np.cumsum(sizes)))[:-1]
    corners = flat[np.repeat(begin[order], sizes[order]) + positions_in_runs(sizes[order])]
    offsets = np.concatenate(([0], np.cumsum(sizes[order])))
    return np.concatenate((layout.xy_um, middle_um)), offsets, corners, site[order]


def _is_convex(layout: Layout) -> Bools:
    """Return whether each site has neither a hole nor a reflex vertex, (n_site,)."""
    if layout.n_sites == 0:
        return np.zeros(0, bool)
    turn = _turn_sines(layout.xy_um, layout.ring_offsets)
    min_turn = np.minimum.reduceat(turn, layout.ring_offsets[:-1])[layout.site_offsets[:-1]]
    return (np.diff(layout.site_offsets) == 1) & (min_turn > -DEGENERATE_FRACTION)


def _turn_sines(xy_um: Floats, ring_offsets: Ints) -> Floats:
    """Return the sine of the left turn of the outline at each vertex, (n_vertex,)."""
    after = next_vertex(ring_offsets)
    out = xy_um[after] - xy_um
    into = np.empty_like(out)
    into[after] = out
    cross = into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]
    return np.asarray(cross / np.maximum(np.hypot(*into.T) * np.hypot(*out.T), np.finfo(np.float64).tiny))


def triangle_fans(xy_um: Floats, ring_offsets: Ints) -> tuple[Ints, Floats]:
    """
    Return a triangle fan of every ring (sum of n - 2, 3), and its smallest triangle.

    Twice the area of this triangle as a fraction of the bounding box of the ring; negative when it is reversed.
    """
    counts = np.diff(ring_offsets)
    if counts.size == 0:
        return np.zeros((0, 3), np.int64), np.zeros(0)
    starts = ring_offsets[:-1]
    turn = _turn_sines(xy_um, ring_offsets)
    ring = np.repeat(np.arange(counts.size), counts)
    has_reflex = np.minimum.reduceat(turn, starts) < -DEGENERATE_FRACTION
    after = next_vertex(ring_offsets)
    before = np.empty_like(after)
    before[after] = np.arange(after.size)
    # From the sharpest reflex vertex; otherwise from a vertex between two true corners, so that no triangle is degenerate.
    merit = np.where(has_reflex[ring], -turn, np.minimum(turn[before], turn[after]))
    best = np.flatnonzero(merit == np.maximum.reduceat(merit, starts)[ring])
    apex = np.empty(counts.size, np.int64)
    apex[ring[best][::-1]] = best[::-1]  # the first of equal candidates
    n_triangles = counts - 2
    of = np.repeat(np.arange(counts.size), n_triangles)
    step = positions_in_runs(n_triangles) + 1
    begin, size, first = starts[of], counts[of], apex[of]
    second = begin + (first - begin + step) % size
    third = begin + (first - begin + step + 1) % size
    a, b, c = xy_um[first], xy_um[second], xy_um[third]
    double_um2 = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    ends = np.cumsum(n_triangles) - n_triangles
    box = np.maximum.reduceat(xy_um, starts) - np.minimum.reduceat(xy_um, starts)
    smallest = np.minimum.reduceat(double_um2, ends) / np.maximum(box[:, 0] * box[:, 1], np.finfo(np.float64).tiny)
    return np.stack((first, second, third), axis=1), smallest


def delaunay(layout: Layout, sites: Ints, *, is_repaired: bool = False) -> tuple[Ints, Ints, Ints, Ints]:
    """
    Triangulate some photosites with GEOS.

    Returns triangles and their sites, the vertices of the photosites, and the representative of each vertex. An outline that
    intersects itself raises an error, or is repaired; triangles with other vertices than those of the outline are then missing.
    """
    part = layout[sites]
    polygons = part.polygons()
    if is_repaired:
        polygons = np.where(shapely.is_valid(polygons), polygons, shapely.buffer(polygons, 0.0))
    triangles, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    is_clockwise = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0.0
    corners[is_clockwise] = corners[is_clockwise, ::-1]
    # Corners are matched to the vertices of their site by their coordinates, which are bit-identical.
    first = layout.ring_offsets[layout.site_offsets[sites]]
    counts = layout.ring_offsets[layout.site_offsets[sites + 1]] - first
    vertices = np.repeat(first, counts) + positions_in_runs(counts)
    points = np.concatenate((part.xy_um, corners.reshape(-1, 2)))
    site = np.concatenate((np.repeat(np.arange(sites.size), counts), np.repeat(owner, 3)))
    order = np.lexsort((points[:, 1], points[:, 0], site))
    is_new = np.ones(order.size, bool)
    is_new[1:] = (np.diff(site[order]) != 0) | np.any(np.diff(points[order], axis=0) != 0.0, axis=1)
    group = np.empty(order.size, np.int64)
    group[order] = np.cumsum(is_new) - 1
    representative = np.full(int(is_new.sum()), -1)
    representative[group[: vertices.size][::-1]] = vertices[::-1]
    matched = representative[group]
    if matched.min(initial=0) < 0 and not is_repaired:
        bad = sites[site[np.flatnonzero(matched < 0)[0]]]
        raise GeometryError(f"site {bad} cannot be triangulated; repair its outline", (int(bad),))
    found = matched[vertices.size :].reshape(-1, 3)
    is_known = (found >= 0).all(axis=1)
    return found[is_known], sites[owner[is_known]], vertices, matched[: vertices.size]


def _polydata(points_um: Floats, offsets: Indices, corners: Indices) -> PolyData:
    """Return PolyData of polygons."""
    pyvista = import_pyvista()
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    cells = vtkCellArray()
    cells.SetData(numpy_to_vtk(offsets, deep=True), numpy_to_vtk(np.ascontiguousarray(corners), deep=True))
    mesh = pyvista.PolyData()
    mesh.points = points_um
    mesh.SetPolys(cells)
    return mesh


def import_pyvista() -> Any:
    """
    Import and return PyVista.

    Raises ParameterError when PyVista is not installed.
    """
    return import_optional("view in 3D", "pyvista")
