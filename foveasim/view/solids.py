"""
Solid models of a sensor: wells, trenches, colour filters and microlenses.

Parts are closed surfaces with physical thicknesses.

::

        ╭──────╮╭──────╮   lenses: caps over the sites
        ├──────┤├──────┤   filters: prisms over the sites         z = filter_thickness_um
        ├┬────┬┤├┬────┬┤                                           z = 0
        ││    │││││    ││   trenches: each site minus its well
        ││    ││││    ││   wells: sites with their boundaries offset inwards
        └┴────┴┘└┴────┴┘                                           z = -well_depth_um

All parts are created with numpy, site by site, so that every point has the number of its photosite. manifold3d checks and cuts
them, trimesh writes them.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import LENGTH, Declared, Limits
from foveasim._core.extras import import_optional
from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, Ints
from foveasim._io.atomic import atomic_write
from foveasim.capture import Capture
from foveasim.errors import FileError, GeometryError, LayoutWarning, ParameterError, warn
from foveasim.layout import Layout, inset, node
from foveasim.layout._regions import as_region
from foveasim.layout.adjacency import colours_of_boxes
from foveasim.layout.summary import hull_area_um2
from foveasim.view.meshes import DEGENERATE_FRACTION, Mesh, extrude, import_pyvista, triangulate
from foveasim.view.site_colours import colours_of

if TYPE_CHECKING:
    from pyvista import MultiBlock

__all__ = ["PartReport", "SensorStack", "Solids", "SolidsReport", "solids", "stack", "write_meshes"]

#: Supported file extensions.
FORMATS = (".glb", ".stl", ".3mf", ".ply", ".obj")
#: Colours of parts without a filter: silicon, oxide in the trenches, glass of the lenses.
SILICON, OXIDE, GLASS = (116, 132, 160), (58, 64, 78), (208, 228, 240)
#: Fraction of the filter colour in the colour of a lens, through which the filter is visible.
LENS_FILTER_FRACTION = 0.35
#: Regions that are removed in the cut-away view: from this fraction of the width, up to this fraction of the height.
QUARTER = (0.5, 0.5)
TERRACES = (((0.39, 0.61), ("filters", "lenses")), ((0.27, 0.73), ("lenses",)))
#: Overlaps below this fraction of the smaller part are rounding errors.
OVERLAP_TOLERANCE = 1e-9
#: Vertices of a union that are closer are one.
UNION_ROUNDING_UM = 1e-5
#: Upper limit of the thickness of a layer.
MAX_THICKNESS_UM = 1000.0
THICKNESS = replace(LENGTH, above=None, at_least=0.0, low=LENGTH.lowest, at_most=MAX_THICKNESS_UM)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorStack(Declared):
    """
    Layer thicknesses of a sensor.

    Parameters
    ----------
    well_depth_um : float, µm
        Depth of the silicon that collects charge, and of the trenches.
    trench_width_um : float, µm
        Distance between the wells of neighbours; each site contributes half of it. 0 for none.
    filter_thickness_um : float, µm
        0 for no filters.
    lens_height_um : float, µm
        Height of the apex of a lens above its rim, at most that of a hemisphere with the area of the site. 0 for none.
    n_lens_steps : int
        Number of height steps of a lens.
    n_lens_corners : int
        Minimum number of vertices of a lens outline, which becomes rounder toward the apex. 0 uses the vertices of the site,
        and its shape from rim to apex.

    Examples
    --------
    >>> import foveasim as fs
    >>> solids = fs.view.solids(
    ...     fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0),
    ...     fs.view.SensorStack(well_depth_um=2.0),
    ... )
    >>> [mesh.name for mesh in solids.meshes]
    ['wells', 'trenches', 'filters', 'lenses']
    """

    well_depth_um: Annotated[float, replace(LENGTH, at_most=MAX_THICKNESS_UM)] = 3.0
    trench_width_um: Annotated[float, THICKNESS] = 0.2
    filter_thickness_um: Annotated[float, THICKNESS] = 0.6
    lens_height_um: Annotated[float, THICKNESS] = 0.7
    n_lens_steps: Annotated[int, Limits(at_least=1, at_most=64)] = 6
    n_lens_corners: Annotated[int, Limits(at_least=0, at_most=256)] = 0


@dataclass(frozen=True, kw_only=True)
class PartReport:
    """
    Result of the manifold3d check of one part.

    Attributes
    ----------
    name : str
    status : str
        ``"NoError"`` when the surface is closed and oriented everywhere.
    n_triangles : int
    volume_um3 : float, µm³
    euler_characteristic : int
        2 for each sphere-like piece, 0 for each ring-like piece.
    """

    name: str
    status: str
    n_triangles: int
    volume_um3: float
    euler_characteristic: int


@dataclass(frozen=True, kw_only=True)
class SolidsReport:
    """
    Result of the manifold3d check of all parts.

    Attributes
    ----------
    parts : tuple of PartReport
    overlap_um3 : mapping of (name, name) to float, µm³
        Overlap volume of two parts.

    Examples
    --------
    >>> import foveasim as fs
    >>> report = fs.view.solids(fs.layout.grid(n_x=2, n_y=2, pitch_um=4.0)).check()
    >>> {part.name: part.status for part in report.parts}
    {'wells': 'NoError', 'trenches': 'NoError', 'filters': 'NoError', 'lenses': 'NoError'}
    """

    parts: tuple[PartReport, ...]
    overlap_um3: Mapping[tuple[str, str], float]

    __repr__ = short_repr

    @property
    def ok(self) -> bool:
        """Whether every part is closed and no two parts overlap."""
        volumes_um3 = {part.name: part.volume_um3 for part in self.parts}
        return all(part.status == "NoError" for part in self.parts) and all(
            shared_um3 <= OVERLAP_TOLERANCE * min(volumes_um3[a], volumes_um3[b])
            for (a, b), shared_um3 in self.overlap_um3.items()
        )


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Solids:
    """
    Parts of a sensor as closed surfaces; created by :func:`solids`.

    Attributes
    ----------
    layout : Layout
    sensor_stack : SensorStack
    parts : mapping of str to Mesh
        ``"wells"``, ``"trenches"``, ``"filters"``, ``"lenses"``: those in the stack. The surface of every photosite is closed
        separately; those of neighbours touch.
    sites_without_lens : tuple of int
        Sites that cannot have a lens: with a hole, or not star-shaped about their centroid or the centre of their largest
        inscribed circle.

    Examples
    --------
    >>> import foveasim as fs
    >>> model = fs.view.solids(
    ...     fs.layout.grid(n_x=2, n_y=2, pitch_um=4.0),
    ...     fs.view.SensorStack(trench_width_um=0.4),
    ... )
    >>> list(model.parts), round(model.fill_factor, 2)
    (['wells', 'trenches', 'filters', 'lenses'], 0.81)
    """

    layout: Layout
    sensor_stack: SensorStack
    parts: Mapping[str, Mesh]
    sites_without_lens: tuple[int, ...] = ()

    def __repr__(self) -> str:
        return f"Solids({', '.join(f'{mesh.triangles.shape[0]:,} triangles of {name}' for name, mesh in self.parts.items())})"

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """Parts from bottom to top."""
        return tuple(self.parts.values())

    def volumes_um3(self, part: str) -> Floats:
        """
        Return the volume of a part at every photosite, (n_site,) µm³.

        Raises
        ------
        ParameterError
            When the part does not exist.
        """
        mesh = self._part(part)
        site = mesh.photosite[mesh.triangles[:, 0]]
        # Relative to the centroid of each site, which preserves digits for small sites far from the origin.
        anchor = np.column_stack((self.layout.centroid_um, np.zeros(self.layout.n_sites)))[site]
        a, b, c = (mesh.points_um[mesh.triangles[:, k]] - anchor for k in range(3))
        six_um3 = np.einsum("ij,ij->i", a, np.cross(b, c))
        return np.bincount(site, weights=six_um3 / 6.0, minlength=self.layout.n_sites).astype(np.float64)

    @property
    def fill_factor(self) -> float:
        """
        Volume of the wells as a fraction of the silicon under the layout's convex hull.

        Without trenches this is the fill factor of the layout, as in :func:`foveasim.layout.describe`; with trenches, that of
        ``inset(layout, trench_width_um / 2)`` on the same hull.
        """
        return float(self.volumes_um3("wells").sum()) / (hull_area_um2(self.layout) * self.sensor_stack.well_depth_um)

    def check(self) -> SolidsReport:
        """
        Check that every part is closed, and compute the overlap volume of any two parts.

        Raises
        ------
        ParameterError

        Notes
        -----
        Overlaps between the sites of one part are not checked; the design rule ``max_overlap_um2`` checks them on the layout.
        """
        manifolds = {name: _manifold(mesh.points_um, mesh.triangles) for name, mesh in self.parts.items()}
        return SolidsReport(
            parts=tuple(
                PartReport(
                    name=name,
                    status=one.status().name,
                    n_triangles=one.num_tri(),
                    volume_um3=one.volume(),
                    euler_characteristic=2 - 2 * one.genus(),
                )
                for name, one in manifolds.items()
            ),
            overlap_um3={
                (a, b): (manifolds[a] ^ manifolds[b]).volume()
                if _overlap_in_height(self.parts[a], self.parts[b])
                else 0.0
                for a, b in combinations(manifolds, 2)
            },
        )

    def cut(self, region: Any = None, *, of: Sequence[str] | None = None, complete_sites: bool = False) -> Solids:
        """
        Return the solids without their volume over a region.

        Parameters
        ----------
        region : shapely polygon or (n, 2) vertices, µm
            By default the quarter of the layout with the largest x and the smallest y, which faces the viewer of the default
            :class:`foveasim.view.Viewpoint`.
        of : sequence of str, optional
            Parts to cut; all by default.
        complete_sites : bool
            Whether to remove complete sites, selected by their centroids, instead of cutting them.

        Returns
        -------
        Solids
            Closed: sites on the boundary of the region are cut by manifold3d, others are unchanged or removed.

        Raises
        ------
        ParameterError
            When the region is invalid, or a part does not exist.
        """
        region = _near_quarter(self.layout, QUARTER) if region is None else as_region("region", region)
        names = tuple(self.parts) if of is None else tuple(of)
        for name in names:
            self._part(name)
        shapely.prepare(region)
        if complete_sites:
            is_removed = shapely.contains_xy(region, self.layout.centroid_um)
            is_cut = np.zeros_like(is_removed)
        else:
            polygons = self.layout.polygons()
            is_removed = shapely.covers(region, polygons)
            is_cut = ~is_removed & shapely.intersects(region, polygons)
        parts = dict(self.parts)
        for name in names:
            if parts[name].triangles.size:
                parts[name] = _remove_region(parts[name], is_removed, is_cut, region)
        return replace(self, parts=MappingProxyType(parts))

    def to_pyvista(self) -> MultiBlock:
        """
        Return the parts as a PyVista MultiBlock with one named block per part.

        Returns
        -------
        pyvista.MultiBlock
            Blocks as in :meth:`Mesh.to_pyvista`; parts that a cut has removed completely are missing.

        Raises
        ------
        ParameterError
            When PyVista is not installed.
        """
        return import_pyvista().MultiBlock(
            {name: mesh.to_pyvista() for name, mesh in self.parts.items() if mesh.triangles.size}
        )

    def write(self, path: str | Path) -> None:
        """
        Write the solids to a file; see :func:`foveasim.view.write_meshes`.

        Raises
        ------
        GeometryError
            When a part is not closed, or parts overlap, as :meth:`check` reports.
        """
        report = self.check()
        if not report.ok:
            open_parts = [part.name for part in report.parts if part.status != "NoError"]
            problem = f"not closed: {', '.join(open_parts)}" if open_parts else "parts overlap"
            raise GeometryError(
                f"the solids cannot be written, {problem}; see Solids.check, and Layout.check with the rule 'max_overlap_um2'"
            )
        write_meshes(self.meshes, path)

    def _part(self, name: str) -> Mesh:
        if name not in self.parts:
            raise ParameterError("part", f"must be one of {', '.join(map(repr, self.parts))}", name)
        return self.parts[name]


def solids(
    data: Layout | Capture, sensor_stack: SensorStack | None = None, *, by: str | ArrayLike | None = None
) -> Solids:
    """
    Return the parts of a sensor as closed surfaces with physical thicknesses.

    Parameters
    ----------
    data : Layout or Capture
    sensor_stack : SensorStack, optional
    by : str or array, optional
        Quantity shown by the colours of the wells and the values of the points, as in :func:`foveasim.view.colours_of`; by
        default the code of a capture, or plain silicon for a layout. Filters have the colours of their channels.

    Returns
    -------
    Solids

    Raises
    ------
    GeometryError
        When a site is too narrow for its trench; ``.site_ids`` lists the sites.
    ParameterError
        When the column ``by`` does not exist.

    Warns
    -----
    LayoutWarning
        When sites cannot have a lens; ``sites_without_lens`` lists them.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> model = solids(
    ...     grid(n_x=2, n_y=2, pitch_um=4.0),
    ...     SensorStack(well_depth_um=3.0, trench_width_um=0.4),
    ... )
    >>> round(model.fill_factor, 9)  # (3.6 / 4)²
    0.81
    """
    sensor_stack = sensor_stack or SensorStack()
    layout = data.layout if isinstance(data, Capture) else data
    if layout.n_sites == 0:
        raise GeometryError("the layout has no sites; solids need at least one")
    if np.diff(layout.site_offsets).max() > 1:
        layout = node(layout)  # holes may touch their outlines between vertices
    bare = np.zeros(layout.n_sites)
    in_silicon = _Colouring(_uniform_colour(layout, SILICON), bare)
    shown = None
    if by is not None or isinstance(data, Capture):
        shown = colours_of(data, by)
        is_number = shown.values is not None and shown.values.dtype.kind in "biuf"
        in_silicon = _Colouring(shown.rgb, np.asarray(shown.values, np.float64) if is_number else bare)
    in_oxide = _Colouring(_uniform_colour(layout, OXIDE), in_silicon.values)
    in_filters = _Colouring(colours_of(data, "channel").rgb, in_silicon.values)
    in_glass = _Colouring(_mix_colours(in_filters.rgb, GLASS), in_silicon.values)
    depth_um, up_um = sensor_stack.well_depth_um, sensor_stack.filter_thickness_um
    has_trench = sensor_stack.trench_width_um > 0.0
    try:
        footprint = inset(layout, 0.5 * sensor_stack.trench_width_um) if has_trench else layout
    except GeometryError as error:
        at = f"site {error.site_ids[0]}" + (f" (and {len(error.site_ids) - 1} more)" if len(error.site_ids) > 1 else "")
        raise GeometryError(
            f"{at} is too narrow for a trench of {sensor_stack.trench_width_um:g} µm; use a smaller trench_width_um",
            error.site_ids,
        ) from None
    wells = _prisms("wells", footprint, (-depth_um, 0.0), in_silicon)
    parts = {"wells": wells if shown is None else replace(wells, title=shown.title, shown=shown)}
    if has_trench:
        walls, owner = _walls(layout, footprint)
        parts["trenches"] = _prisms("trenches", walls, (-depth_um, 0.0), in_oxide, owner)
    if up_um > 0.0:
        parts["filters"] = _prisms("filters", layout, (0.0, up_um), in_filters)
    without_lens = np.zeros(0, np.int64)
    if sensor_stack.lens_height_um > 0.0:
        lenses, without_lens = _lenses(layout, up_um, sensor_stack, in_glass)
        if lenses is not None:
            parts["lenses"] = lenses
    return Solids(
        layout=layout,
        sensor_stack=sensor_stack,
        parts=MappingProxyType(parts),
        sites_without_lens=tuple(without_lens.tolist()),
    )


def stack(
    data: Layout | Capture, sensor_stack: SensorStack | None = None, *, by: str | ArrayLike | None = None
) -> Solids:
    """
    Return the sensor as a cut-away view.

    The near quarter is removed at full depth; around it filters and lenses are removed in terraces.

    Parameters
    ----------
    data, sensor_stack, by
        As for :func:`solids`.

    Returns
    -------
    Solids
        For :func:`foveasim.view.render`.

    Raises
    ------
    GeometryError, ParameterError
        As for :func:`solids`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.mosaic(fs.layout.grid(n_x=6, n_y=6, pitch_um=3.0), ["RG", "GB"])
    >>> model = fs.view.stack(
    ...     layout, fs.view.SensorStack(well_depth_um=3.0, trench_width_um=0.3)
    ... )
    >>> {
    ...     mesh.name: len(set(mesh.photosite.tolist())) for mesh in model.meshes
    ... }  # photosites that remain in each part
    {'wells': 30, 'trenches': 30, 'filters': 27, 'lenses': 20}
    """
    model = solids(data, sensor_stack, by=by)
    for fractions, names in TERRACES:
        model = model.cut(
            _near_quarter(model.layout, fractions),
            of=[name for name in names if name in model.parts],
            complete_sites=True,
        )
    return model.cut(_near_quarter(model.layout, QUARTER))


# -- parts ---------------------------------------------------------------------------------------------------------------


def write_meshes(meshes: Sequence[Mesh], path: str | Path) -> None:
    """
    Write meshes to a file atomically.

    Parameters
    ----------
    meshes : sequence of Mesh
    path : path
        ``.glb`` stores separate parts, with colours and the attributes ``_photosite`` and ``_value`` of every point; ``.3mf``
        stores separate parts, and states micrometres; ``.ply`` and ``.obj`` store colours; ``.stl`` stores triangles only,
        without walls between bodies that touch, where all are closed. The unit is 1 µm; z points toward the lens.

    Raises
    ------
    FileError
        When the extension is another, the file cannot be written, or a library for ``.3mf`` is not installed.
    GeometryError
        When there are no triangles.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> columns = fs.view.prisms(fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), [1.0, 3.0])
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     fs.view.write_meshes([columns], Path(directory, "columns.stl"))
    ...     print(
    ...         Path(directory, "columns.stl").stat().st_size
    ...     )  # 84 bytes, and 50 per triangle
    1084
    """
    import trimesh

    target = Path(path)
    kind = target.suffix.lower()
    if kind not in FORMATS:
        raise FileError(target, f"must end in {', '.join(FORMATS)}")
    if kind == ".3mf":
        for module in ("lxml", "networkx"):
            import_optional(target, module)
    bodies = {mesh.name: _body(trimesh, mesh) for mesh in meshes if mesh.triangles.size}
    if not bodies:
        raise GeometryError("the solids have no triangles to write")
    if kind == ".stl":
        united = _united([mesh for mesh in meshes if mesh.triangles.size])
        bodies = bodies if united is None else {"united": trimesh.Trimesh(*united, process=False)}
    scene = trimesh.Scene(bodies) if kind in (".glb", ".3mf") else trimesh.util.concatenate(list(bodies.values()))
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        content = scene.export(file_type=kind[1:])
        content = content.encode() if isinstance(content, str) else content
        file.write(_in_micrometres(content) if kind == ".3mf" else content)


def _in_micrometres(content: bytes) -> bytes:
    """Return a 3MF file that states its unit; trimesh states millimetres."""
    changed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            part = source.read(name)
            if name.endswith(".model"):
                part = part.replace(b'unit="millimeter"', b'unit="micron"', 1)
            target.writestr(name, part)
    return changed.getvalue()


def _near_quarter(layout: Layout, fractions: tuple[float, float]) -> Any:
    """
    Return a rectangle over the corner of largest x and smallest y.

    Its inner sides pass through centroids of sites.
    """
    x_min, y_min, x_max, y_max = layout.bounds_um
    width, height = x_max - x_min, y_max - y_min
    x, y = layout.centroid_um.T
    low_x = x[np.abs(x - (x_min + fractions[0] * width)).argmin()]
    high_y = y[np.abs(y - (y_min + fractions[1] * height)).argmin()]
    return shapely.box(low_x, y_min - 0.1 * height, x_max + 0.1 * width, high_y)


class _Colouring(NamedTuple):
    """Colour (n_site, 3) and value (n_site,) of every photosite."""

    rgb: NDArray[np.uint8]
    values: Floats


def _uniform_colour(layout: Layout, colour: tuple[int, int, int]) -> NDArray[np.uint8]:
    return np.tile(np.array(colour, np.uint8), (layout.n_sites, 1))


def _mix_colours(rgb: NDArray[np.uint8], glass: tuple[int, int, int]) -> NDArray[np.uint8]:
    return np.rint((1.0 - LENS_FILTER_FRACTION) * np.array(glass) + LENS_FILTER_FRACTION * rgb).astype(np.uint8)


def _walls(layout: Layout, wells: Layout) -> tuple[Layout, Ints]:
    """Return each site minus its well, in pieces, and the site of each piece."""
    pieces, owner = shapely.get_parts(shapely.difference(layout.polygons(), wells.polygons()), return_index=True)
    return Layout.from_polygons(pieces), owner


def _prisms(
    name: str, footprint: Layout, z_um: tuple[float, float], colouring: _Colouring, owner: Ints | None = None
) -> Mesh:
    """
    Return prisms between two heights, one per polygon of a layout.

    ``owner`` is the photosite of each polygon.
    """
    points_um, triangles, position = extrude(footprint, triangulate(footprint), *z_um)
    return _coloured_mesh(
        name, points_um, triangles, position if owner is None else owner.astype(np.int32)[position], colouring
    )


def _coloured_mesh(
    name: str, points_um: Floats, triangles: NDArray[np.int32], photosite: NDArray[np.int32], colouring: _Colouring
) -> Mesh:
    return Mesh(
        name=name,
        points_um=points_um,
        triangles=triangles,
        photosite=photosite,
        values=colouring.values[photosite],
        colours=colouring.rgb[photosite],
    )


def _lenses(
    layout: Layout, floor_um: float, sensor_stack: SensorStack, colouring: _Colouring
) -> tuple[Mesh | None, Ints]:
    """
    Return lenses, if any, and the sites that cannot have one.

    Lenses are spherical caps, stretched to the outlines of the sites. The outline shrinks toward the apex with increasing
    height.
    """
    centre_um, can_have = _centres(layout)
    without = np.flatnonzero(~can_have)
    if without.size:
        more = f" and {without.size - 1} more" if without.size > 1 else ""
        warn(
            f"site {without[0]}{more} cannot have a lens: it has a hole, or is not star-shaped; Solids.sites_without_lens "
            "lists all",
            LayoutWarning,
        )
    carrying = np.flatnonzero(can_have)
    if carrying.size == 0:
        return None, without
    layout, centre_um = layout[carrying], centre_um[carrying]
    if sensor_stack.n_lens_corners:
        layout = _subdivide_edges(layout, sensor_stack.n_lens_corners)
    caps = triangulate(layout)
    n, n_sites, n_steps = layout.xy_um.shape[0], layout.n_sites, sensor_stack.n_lens_steps
    site = _site_of_vertex(layout)
    arm_um = layout.xy_um - centre_um[site]
    # Steps of equal angle from the rim (1) to the apex (0), where a fan closes the cap.
    fraction = np.cos(0.5 * np.pi * np.arange(n_steps) / n_steps)[:, np.newaxis]
    scale = np.broadcast_to(fraction, (n_steps, n))
    if sensor_stack.n_lens_corners:
        # Toward the largest inscribed circle about the apex, so that no step is wider than the one below.
        round_fraction = _inscribed_radius_um(layout, arm_um)[site] / np.hypot(*arm_um.T)
        scale = fraction * (fraction**4 + (1.0 - fraction**4) * round_fraction)
    radius_um = np.sqrt(layout.area_um2 / np.pi)
    points_um = np.empty((n_steps * n + n_sites, 3))
    steps = points_um[: n_steps * n].reshape(n_steps, n, 3)
    steps[..., :2] = centre_um[site] + scale[..., np.newaxis] * arm_um
    steps[..., 2] = floor_um + _cap_height_um(radius_um, sensor_stack.lens_height_um, fraction)[:, site]
    points_um[:n, :2] = layout.xy_um  # bit-identical to the filter below
    points_um[n_steps * n :, :2] = centre_um
    points_um[n_steps * n :, 2] = floor_um + np.minimum(radius_um, sensor_stack.lens_height_um)
    here, after = caps.weld, caps.weld[next_vertex(layout.ring_offsets)]
    low = n * np.arange(n_steps - 1)[:, np.newaxis]
    sides = (
        np.stack((here + low, after + low, after + low + n), axis=-1),
        np.stack((here + low, after + low + n, here + low + n), axis=-1),
    )
    top = n * (n_steps - 1)
    fan = np.stack((here + top, after + top, n_steps * n + site), axis=1)
    triangles = np.concatenate((caps.triangles[:, ::-1], *(part.reshape(-1, 3) for part in sides), fan))
    photosite = carrying[np.concatenate((np.tile(site, n_steps), np.arange(n_sites)))]
    mesh = _coloured_mesh("lenses", points_um, triangles.astype(np.int32), photosite.astype(np.int32), colouring)
    return replace(mesh, is_smooth=True), without


def _site_of_vertex(layout: Layout) -> Ints:
    return np.repeat(np.arange(layout.n_sites), np.diff(layout.ring_offsets[layout.site_offsets]))


def _subdivide_edges(layout: Layout, n_corners: int) -> Layout:
    """Divide long edges so that every ring has at least ``n_corners`` vertices."""
    edge_um = layout.xy_um[next_vertex(layout.ring_offsets)] - layout.xy_um
    length_um = np.hypot(*edge_um.T)
    starts = layout.ring_offsets[:-1]
    around_um = np.repeat(np.add.reduceat(length_um, starts), np.diff(layout.ring_offsets))
    pieces = np.ceil(n_corners * length_um / around_um).astype(np.int64)
    step = positions_in_runs(pieces) / np.repeat(pieces, pieces)
    xy_um = np.repeat(layout.xy_um, pieces, axis=0) + step[:, np.newaxis] * np.repeat(edge_um, pieces, axis=0)
    offsets = np.concatenate(([0], np.cumsum(pieces)))[layout.ring_offsets]
    return Layout(xy_um, offsets, layout.site_offsets, layout.columns)


def _inscribed_radius_um(layout: Layout, arm_um: Floats) -> Floats:
    """
    Return the radius of the largest circle in every site about its apex, (n_site,).

    ``arm_um`` are the vectors from the apex to the vertices.
    """
    after = next_vertex(layout.ring_offsets)
    edge_um = arm_um[after] - arm_um
    height_um = (arm_um[:, 0] * edge_um[:, 1] - arm_um[:, 1] * edge_um[:, 0]) / np.hypot(*edge_um.T)
    return np.minimum.reduceat(height_um, layout.ring_offsets[layout.site_offsets[:-1]])


def _cap_height_um(radius_um: Floats, height_um: float, fraction: Floats) -> Floats:
    """
    Return the height of a spherical cap above its rim, at a fraction of its radius.

    The cap is at most a hemisphere.
    """
    sag_um = np.minimum(height_um, radius_um)
    ball_um = (radius_um**2 + sag_um**2) / (2.0 * sag_um)
    rise_um = np.sqrt(np.maximum(ball_um**2 - (radius_um * fraction) ** 2, 0.0)) - (ball_um - sag_um)
    return np.where(fraction < 1.0, rise_um, 0.0)


def _centres(layout: Layout) -> tuple[Floats, Bools]:
    """
    Return a point in every site, and whether its outline is star-shaped about it.

    (n_site, 2) µm and (n_site,). The point is the centroid, or the centre of the largest inscribed circle.
    """
    has_hole = np.diff(layout.site_offsets) > 1
    site, centre_um = _site_of_vertex(layout), layout.centroid_um.copy()
    off_centre = np.flatnonzero(~_is_star_shaped(layout, centre_um, site) & ~has_hole)
    if off_centre.size:
        circles = shapely.maximum_inscribed_circle(layout[off_centre].polygons())
        centre_um[off_centre] = shapely.get_coordinates(circles).reshape(-1, 2, 2)[:, 0]
    return centre_um, _is_star_shaped(layout, centre_um, site) & ~has_hole


def _is_star_shaped(layout: Layout, centre_um: Floats, site: Ints) -> NDArray[np.bool_]:
    """Return whether all edges of each site run counter-clockwise about its apex, (n_site,)."""
    arm_um = layout.xy_um - centre_um[site]
    after_um = arm_um[next_vertex(layout.ring_offsets)]
    double_um2 = arm_um[:, 0] * after_um[:, 1] - arm_um[:, 1] * after_um[:, 0]
    min_um2 = np.minimum.reduceat(double_um2, layout.ring_offsets[layout.site_offsets[:-1]])
    return np.asarray(min_um2 > DEGENERATE_FRACTION * layout.area_um2)


# -- manifold3d and trimesh -----------------------------------------------------------------------------------------------


def _manifold(points_um: Floats, triangles: NDArray[np.integer[Any]]) -> Any:
    """Return a surface as a Manifold; columns of ``points_um`` after the third are properties."""
    import manifold3d

    return manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(points_um), triangles.astype(np.uint64)))


def _united(meshes: Sequence[Mesh]) -> tuple[Floats, Ints] | None:
    """
    Return the points and triangles of the union of bodies, or None if one is open.

    Files without connectivity merge equal points: walls between touching bodies would then have four triangles at an edge, and
    no body would be closed.
    """
    import manifold3d

    # Bodies of one colour do not touch: a union of few groups is much faster than one of all bodies.
    colour = _body_colours(meshes)
    groups = []
    for mesh in meshes:
        of_triangle = colour(mesh.photosite[mesh.triangles[:, 0]])
        for each in np.unique(of_triangle):
            points_um, _, triangles = _compact(mesh.points_um, mesh.photosite, mesh.triangles[of_triangle == each])
            groups.append(_manifold(points_um, triangles))
    if any(one.status() != manifold3d.Error.NoError for one in groups):
        return None
    union = manifold3d.Manifold.batch_boolean(groups, manifold3d.OpType.Add)
    # Files of single precision would merge vertices that are closer.
    found = union.set_tolerance(UNION_ROUNDING_UM).to_mesh64()
    return np.asarray(found.vert_properties)[:, :3], np.asarray(found.tri_verts, dtype=np.int64)


def _body_colours(meshes: Sequence[Mesh]) -> Callable[[NDArray[np.integer[Any]]], Ints]:
    """Return a function of photosites, whose values differ for bodies that touch."""
    sites = np.unique(np.concatenate([mesh.photosite for mesh in meshes]))
    low_um, high_um = np.full((sites.size, 2), np.inf), np.full((sites.size, 2), -np.inf)
    for mesh in meshes:
        body = np.searchsorted(sites, mesh.photosite)
        np.minimum.at(low_um, body, mesh.points_um[:, :2])
        np.maximum.at(high_um, body, mesh.points_um[:, :2])
    colours = colours_of_boxes(np.concatenate((low_um, high_um), axis=1))
    return lambda photosite: colours[np.searchsorted(sites, photosite)]


def _overlap_in_height(one: Mesh, other: Mesh) -> bool:
    """Return whether two parts overlap in height; otherwise no boolean operation is needed."""
    if not (one.triangles.size and other.triangles.size):
        return False
    (low, high), (other_low, other_high) = one.bounds_um, other.bounds_um
    return bool(low[2] < other_high[2] and other_low[2] < high[2])


def _remove_region(mesh: Mesh, is_removed: NDArray[np.bool_], is_cut: NDArray[np.bool_], region: Any) -> Mesh:
    """Return a part without some sites, and with others cut by a region."""
    site_of = mesh.photosite[mesh.triangles[:, 0]]
    is_unchanged = ~is_removed[site_of] & ~is_cut[site_of]
    points_um, photosite, triangles = _compact(mesh.points_um, mesh.photosite, mesh.triangles[is_unchanged])
    crossed = _compact(mesh.points_um, mesh.photosite, mesh.triangles[is_cut[site_of]])
    if crossed[2].size:
        # Points have the property site + 1. Points created by the cut have 0, and take the site of their connected piece.
        numbered = np.column_stack((crossed[0], crossed[1] + 1.0))
        left = (_manifold(numbered, crossed[2]) - _region_prism(region, mesh)).to_mesh64()
        weld = np.arange(left.vert_properties.shape[0])
        weld[left.merge_from_vert] = left.merge_to_vert
        cut = weld[left.tri_verts.astype(np.int64)]
        if cut.size:
            number = np.rint(left.vert_properties[:, 3]).astype(np.int64)
            np.maximum.at(number, weld, number.copy())
            number = _component_maximum(cut, number) - 1
            cut_um, cut_site, cut = _compact(left.vert_properties[:, :3], number.astype(np.int32), cut)
            triangles = np.concatenate((triangles, cut + points_um.shape[0])).astype(np.int32)
            points_um, photosite = np.concatenate((points_um, cut_um)), np.concatenate((photosite, cut_site))
    colouring = _Colouring(np.zeros((is_removed.size, 3), np.uint8), np.zeros(is_removed.size))
    colouring.rgb[mesh.photosite], colouring.values[mesh.photosite] = mesh.colours, mesh.values
    left_over = _coloured_mesh(mesh.name, points_um, triangles, photosite, colouring)
    return replace(left_over, title=mesh.title, shown=mesh.shown, is_smooth=mesh.is_smooth)


def _region_prism(region: Any, mesh: Mesh) -> Any:
    """Return a prism over a region, from below a mesh to above it."""
    outline = Layout.from_polygons(shapely.get_parts([region]))
    low, high = mesh.bounds_um
    margin_um = high[2] - low[2]
    points_um, triangles, _ = extrude(outline, triangulate(outline), low[2] - margin_um, high[2] + margin_um)
    return _manifold(points_um, triangles)


def _component_maximum(triangles: Ints, number: Ints) -> Ints:
    """Return for every point the largest number in its connected piece."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = number.size
    a, b, c = triangles.T
    ones = np.ones(2 * a.size, np.int8)
    n_pieces, piece = connected_components(coo_array((ones, (np.concatenate((a, b)), np.concatenate((b, c)))), (n, n)))
    largest = np.zeros(n_pieces, np.int64)
    np.maximum.at(largest, piece, number)
    return np.asarray(largest[piece])


def _compact(points_um: Floats, photosite: NDArray[np.int32], triangles: Any) -> tuple[Floats, Any, NDArray[np.int32]]:
    """Return the points that triangles use, their sites, and the renumbered triangles."""
    is_used = np.zeros(points_um.shape[0], bool)
    is_used[triangles] = True
    renumbered = np.cumsum(is_used) - 1
    return points_um[is_used], photosite[is_used], renumbered[triangles].astype(np.int32)


def _body(trimesh: Any, mesh: Mesh) -> Any:
    """
    Return a part as a trimesh object.

    In glTF, custom attributes of points begin with an underscore.
    """
    body = trimesh.Trimesh(
        mesh.points_um,
        mesh.triangles,
        vertex_colors=np.column_stack((mesh.colours, np.full(mesh.colours.shape[0], 255, np.uint8))),
        process=False,
    )
    body.vertex_attributes = {
        "_photosite": mesh.photosite.astype(np.float32),
        "_value": mesh.values.astype(np.float32),
    }
    return body
