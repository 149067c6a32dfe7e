"""Layout of polygonal photosites: packed rings, data columns per site, and provenance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FINITE, POSITIVE, OwnCheck
from foveasim._core.names import CHANNEL_LETTERS, possible_names
from foveasim._core.provenance import copy_plain_data
from foveasim._core.rings import (
    check_packed,
    convexity,
    from_frame,
    polygons_of,
    positions_in_runs,
    ring_area_um2,
    ring_unsigned_area_um2,
    select_sites,
    site_bounds_um,
    site_moments,
)
from foveasim._core.show import ViewMethod, load, view_method
from foveasim._core.threads import cached_property
from foveasim._core.validation import (
    MAX_LENGTH_UM,
    MAX_SITES,
    Bools,
    Floats,
    Ints,
    check_per_site,
    check_point,
    exact_integers,
    finite_array,
    freeze,
    frozen_array,
    read_only,
    unmasked,
)
from foveasim.errors import GeometryError, ParameterError, printable, type_name
from foveasim.layout.lattice import RectangleLattice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pyvista import PolyData  # noqa: TID251 -- a type alone
    from scipy.sparse import csr_array

    from foveasim.layout.drc.repair import Changes
    from foveasim.layout.drc.routing import Readout
    from foveasim.layout.drc.rules import DesignRules, Report
    from foveasim.layout.files import WrittenLayout
    from foveasim.layout.graph import SiteGraph
    from foveasim.layout.summary import Summary

__all__ = ["Layout"]

#: Arrays of the outlines.
RINGS = ("xy_um", "ring_offsets", "site_offsets")
#: A smaller extent of a layout indicates wrong units.
MIN_LAYOUT_UM = 1e-3
#: Area of a ring, relative to its bounding box, below which it is degenerate in float64.
ZERO_AREA_FRACTION = 1e-14
#: Columns of indices, of filters and of lines: values above MAX_SITES indicate an overflow.
INDEX_NAMES = ("channel", "readout_line")
#: Valid ranges of integer columns.
INTEGER_RANGES = "integers from -2**63 to 2**63 - 1, or from 0 to 2**64 - 1"
#: GEOS reasons for invalid holes, and the corresponding messages.
HOLE_REASONS = {
    "Hole lies outside shell": "has a hole outside its outline",
    "Holes are nested": "has a hole inside another hole",
}
#: Characters of the origin, and columns, in the representation of a layout.
MAX_SHOWN_ORIGIN, MAX_SHOWN_COLUMNS = 60, 8
#: Number of invalid sites that a message lists.
MAX_LISTED = 5


@dataclass(frozen=True, eq=False, repr=False)
class Layout:
    """
    Photosites of a sensor: polygons in the sensor plane.

    Generators such as :func:`foveasim.layout.log_polar`, :meth:`from_rectangles` and :meth:`from_polygons` create layouts.
    The constructor expects valid packed rings, and checks only their structure and the sites with holes.

    Parameters
    ----------
    xy_um : (n_vertex, 2) float64, µm
        Vertices as ``[x, y]``, ring after ring, without repetition of the first vertex of a ring.
    ring_offsets : (n_ring + 1,) int64
        Ring r has the vertices ``ring_offsets[r] : ring_offsets[r + 1]``.
    site_offsets : (n_site + 1,) int64
        Site s has the rings ``site_offsets[s] : site_offsets[s + 1]``: the outline, counter-clockwise, then the holes,
        clockwise.
    columns : mapping of str to (n_site,) array
        Data per site: ``channel`` (index of the colour filter), ``readout_line``, and user-defined columns.
    provenance : mapping
        Origin of the layout: generator, parameters and subsequent steps.

    Raises
    ------
    GeometryError
        When a coordinate is too large, or holes overlap, are wound counter-clockwise, or do not lie inside their outline;
        ``.site_ids`` and the message specify the sites.
    ParameterError
        When array sizes are inconsistent, numbers are not finite, a column has integers beyond 64 bits, or ``channel`` or
        ``readout_line`` has integers that are not valid indices.

    Notes
    -----
    All arrays are read-only, and methods return new layouts. Indexing with a mask, a slice or site indices selects sites:
    ``layout[layout.area_um2 > 4.0]``.

    Examples
    --------
    >>> import foveasim as fs
    >>> import shapely
    >>> layout = fs.Layout.from_polygons(
    ...     [shapely.box(0, 0, 2, 2), shapely.Point(5, 1).buffer(1.0)]
    ... )
    >>> layout.n_sites, layout.area_um2.round(2).tolist()
    (2, [4.0, 3.14])
    >>> layout[layout.area_um2 > 3.5].n_sites  # selections as of arrays
    1
    """

    xy_um: Floats
    ring_offsets: Ints
    site_offsets: Ints
    columns: OwnCheck[Mapping[str, NDArray[Any]]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    #: Rows and columns of rectangles whose vertices are computed when they are read, or None.
    lattice: RectangleLattice | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._store()
        _require_valid_holes(self)

    def __getattr__(self, name: str) -> Any:
        # Only called for attributes that are not set: the rings of a lattice.
        if name not in RINGS or self.lattice is None:
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        for ring_name, array in zip(RINGS, self.lattice.rings(), strict=True):
            object.__setattr__(self, ring_name, freeze(array))
        return getattr(self, name)

    def with_provenance(self, provenance: Mapping[str, Any]) -> Layout:
        """Return the layout with another provenance record of plain data."""
        layout = object.__new__(type(self))
        layout.__dict__.update(self.__dict__)
        object.__setattr__(layout, "provenance", MappingProxyType(copy_plain_data(dict(provenance))))
        return layout

    def _store(self) -> None:
        """Check the structure of the fields, and store read-only arrays."""
        rings = check_packed(self.xy_um, self.ring_offsets, self.site_offsets, min_vertices=3)
        xy_um = rings[0]
        if xy_um.size:
            # Minimum and maximum propagate NaN, and need no array as large as the vertices.
            largest_um = max(-float(xy_um.min()), float(xy_um.max()))
            if not np.isfinite(largest_um):
                finite_array("xy_um", xy_um)  # raises an error with the position
            _require_near_origin(largest_um)
        for name, array in zip(RINGS, rings, strict=True):
            object.__setattr__(self, name, frozen_array(array))
        self._store_columns()

    def _store_columns(self) -> None:
        """Check columns and provenance, and store them as read-only data."""
        columns = {}
        for name, values in self.columns.items():
            column = check_per_site(name, _column(name, values), self.n_sites)
            if name in INDEX_NAMES:
                _require_indices(name, column)
            columns[name] = column
        object.__setattr__(self, "columns", MappingProxyType(columns))
        object.__setattr__(self, "provenance", MappingProxyType(copy_plain_data(self.provenance)))

    # -- constructors -----------------------------------------------------------------------------------------------

    @classmethod
    def from_rectangles(cls, centre_um: ArrayLike, size_um: ArrayLike, **columns: OwnCheck[ArrayLike]) -> Layout:
        """
        Build a layout of rectangular photosites from their centres and sizes.

        Parameters
        ----------
        centre_um : (n_site, 2), µm
            Centres as ``[x, y]``.
        size_um : number, (n_site,) or (n_site, 2), µm
            Side of the squares, or width and height of the rectangles.
        **columns : (n_site,) arrays
            Data per site, such as ``channel`` and ``readout_line``.

        Raises
        ------
        ParameterError
            When a number is not finite, or a size is not positive.
        """
        centre_um = finite_array("centre_um", centre_um, ndim=2)
        if centre_um.shape[1] != 2:
            raise ParameterError("centre_um", f"must have the shape (n_site, 2), got {centre_um.shape}")
        size_um = finite_array("size_um", size_um, above=0.0)
        n_sites = centre_um.shape[0]
        if size_um.ndim > 2 or (size_um.ndim >= 1 and size_um.shape not in ((n_sites,), (n_sites, 2))):
            raise ParameterError(
                "size_um", f"must be one number, or have the shape ({n_sites},) or ({n_sites}, 2), got {size_um.shape}"
            )
        half_um = 0.5 * np.broadcast_to(size_um[:, np.newaxis] if size_um.ndim == 1 else size_um, (n_sites, 2))
        low, high = centre_um - half_um, centre_um + half_um
        corners = np.stack((low, np.stack((high[:, 0], low[:, 1]), 1), high, np.stack((low[:, 0], high[:, 1]), 1)), 1)
        return cls.from_equal_rings(corners, columns, {"made_by": "from_rectangles"})

    @classmethod
    def from_lattice(
        cls,
        lattice: RectangleLattice,
        columns: OwnCheck[Mapping[str, ArrayLike] | None] = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> Layout:
        """
        Build a layout of rectangles in rows and columns.

        Vertices are computed when they are read.

        Parameters
        ----------
        lattice : RectangleLattice
        columns, provenance : mappings
            As for the class.

        Raises
        ------
        GeometryError
            When a coordinate is too large.
        """
        if lattice.n_sites:
            _require_near_origin(float(np.abs(lattice.bounds_um).max()))
        layout = object.__new__(cls)
        for name, value in (("lattice", lattice), ("columns", columns or {}), ("provenance", provenance or {})):
            object.__setattr__(layout, name, value)
        layout._store_columns()
        return layout

    @classmethod
    def from_equal_rings(
        cls,
        rings_um: Floats,
        columns: OwnCheck[Mapping[str, ArrayLike] | None] = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> Layout:
        """
        Build a layout of sites with equal numbers of vertices.

        Parameters
        ----------
        rings_um : (n_site, n_vertex, 2), µm
            Simple outlines, counter-clockwise; neither property is checked.
        columns, provenance : mappings
            As for the class.
        """
        rings_um = finite_array("rings_um", rings_um, ndim=3)
        n_sites, n_vertices = rings_um.shape[:2]
        site_offsets = freeze(np.arange(n_sites + 1))
        xy_um, ring_offsets = rings_um.reshape(-1, 2), freeze(n_vertices * site_offsets)
        return cls(xy_um, ring_offsets, site_offsets, cast(Any, columns or {}), provenance or {})

    @classmethod
    def from_polygons(
        cls,
        polygons: OwnCheck[Sequence[Any] | NDArray[Any] | tuple[ArrayLike, ArrayLike, ArrayLike]],
        *,
        channel: ArrayLike | None = None,
        readout_line: ArrayLike | None = None,
        provenance: Mapping[str, Any] | None = None,
        **columns: OwnCheck[ArrayLike],
    ) -> Layout:
        """
        Build a layout from simple polygons, with or without holes, of any winding order.

        Parameters
        ----------
        polygons : sequence of shapely Polygon or (n, 2) vertices, or the tuple (xy_um, ring_offsets, site_offsets)
            Coordinates in µm. Packed rings are as for the class, but may have any winding order and may repeat the first
            vertex at the end, as vertices of a polygon may.
        channel, readout_line, **columns : (n_site,) arrays, optional
            Data per site.
        provenance : mapping, optional
            Origin of the polygons.

        Raises
        ------
        GeometryError
            When a polygon is empty, has a coordinate that is not finite, has no area, or crosses itself, or when a
            geometry is not a polygon; ``.site_ids`` and the message specify the sites.

        Examples
        --------
        >>> import shapely
        >>> layout = Layout.from_polygons(
        ...     [shapely.box(0, 0, 2, 2), shapely.Point(5, 0).buffer(1)], channel=[0, 1]
        ... )
        >>> layout.n_sites, float(layout.area_um2[0])
        (2, 4.0)
        >>> Layout.from_polygons([[(0, 0), (2, 0), (0, 2)], [(2, 2), (4, 0), (4, 2)]]).n_sites
        2
        """
        if _is_packed(polygons):
            xy_um, ring_offsets, site_offsets = check_packed(*polygons)
        else:
            xy_um, ring_offsets, site_offsets = _pack_polygons(polygons)
        _require(_per_site(~np.isfinite(xy_um), ring_offsets, site_offsets), "has a coordinate that is not finite")
        _require(
            _per_site(np.abs(xy_um) > MAX_LENGTH_UM, ring_offsets, site_offsets),
            f"lies further than {MAX_LENGTH_UM:g} µm from the origin; coordinates are in µm",
        )
        if xy_um.size and np.ptp(xy_um, axis=0).max() < MIN_LAYOUT_UM:
            raise GeometryError(
                f"the layout must be at least {MIN_LAYOUT_UM:g} µm wide, got {np.ptp(xy_um, axis=0).max():g} µm; "
                "coordinates are in µm"
            )
        xy_um, ring_offsets = without_repeats(xy_um, ring_offsets)
        _require(
            np.logical_or.reduceat(np.diff(ring_offsets) < 3, site_offsets[:-1]),
            "has a ring of fewer than 3 distinct vertices",
        )
        box = site_bounds_um(xy_um, ring_offsets, np.arange(ring_offsets.size))
        box_um2 = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])
        rounding_um2 = ZERO_AREA_FRACTION * np.maximum(box_um2, np.finfo(np.float64).tiny)
        is_line = ring_unsigned_area_um2(xy_um, ring_offsets) <= rounding_um2
        _require(np.logical_or.reduceat(is_line, site_offsets[:-1]), "has a ring with zero area")
        _require_valid(layout_of(xy_um, ring_offsets, site_offsets))
        xy_um = _reverse_rings(xy_um, ring_offsets, winding_um2(xy_um, ring_offsets, site_offsets) < 0.0)
        for name, values in (("channel", channel), ("readout_line", readout_line)):
            if values is not None:
                columns = {name: values, **columns}
        columns = {name: _column(name, values) for name, values in columns.items()}
        return layout_of(xy_um, ring_offsets, site_offsets, columns, provenance or {"made_by": "from_polygons"})

    # -- properties ----------------------------------------------------------------------------------------------

    @property
    def n_sites(self) -> int:
        """Number of photosites."""
        return self.site_offsets.size - 1 if self.lattice is None else self.lattice.n_sites

    @property
    def rings_um(self) -> tuple[Floats, Ints, Ints]:
        """Packed rings (xy_um, ring_offsets, site_offsets), as for :meth:`from_polygons`."""
        return self.xy_um, self.ring_offsets, self.site_offsets

    def __len__(self) -> int:
        return self.n_sites

    def __reduce__(self) -> tuple[Any, ...]:
        # Read-only mappings cannot be pickled.
        data = dict(self.columns), dict(self.provenance)
        if self.lattice is not None:
            return Layout.from_lattice, (self.lattice, *data)
        return layout_of, (*self.rings_um, *data)

    def __repr__(self) -> str:
        origin = self.provenance.get("generator", self.provenance.get("made_by", "packed rings"))
        columns = sorted(self.columns)
        shown = columns if len(columns) <= MAX_SHOWN_COLUMNS else [*columns[:MAX_SHOWN_COLUMNS], "..."]
        return f"Layout({self.n_sites} sites from {printable(str(origin))[:MAX_SHOWN_ORIGIN]}, columns {shown})"

    @property
    def channel(self) -> Ints:
        """Colour filter index of each site, (n_site,); 0 without a column ``channel``."""
        return self._index_column("channel")

    @property
    def readout_line(self) -> Ints:
        """Readout line of each site, (n_site,); 0 without a column ``readout_line``."""
        return self._index_column("readout_line")

    def _index_column(self, name: str) -> Ints:
        return self.index_column(name) if name in self.columns else np.zeros(self.n_sites, np.int64)

    def index_column(self, name: str) -> Ints:
        """
        Return a column of indices, (n_site,) int64.

        Raises
        ------
        ParameterError
            When the layout has no such column, or its values are not valid indices.
        """
        return self._checked_indices(name).astype(np.int64)

    def _checked_indices(self, name: str) -> NDArray[np.integer[Any]]:
        """Return a column of indices with its own type of integers."""
        if name not in self.columns:
            hint = possible_names(name, sorted(self.columns))
            raise ParameterError(name, "must be a column of the layout", hint=hint)
        column = self.columns[name]
        if column.dtype.kind not in "iu":
            raise ParameterError(name, f"must contain integers from 0 to {MAX_SITES}", column)
        _require_indices(name, column)
        return column

    @cached_property
    def _moments(self) -> tuple[Floats, Floats]:
        if self.lattice is not None:
            area_um2, centroid_um = self.lattice.moments()
        else:
            area_um2, centroid_um = site_moments(*self.rings_um)
        return read_only(area_um2), read_only(centroid_um)

    @property
    def area_um2(self) -> Floats:
        """Area of each site, holes excluded, (n_site,) µm²."""
        return self._moments[0]

    @property
    def size_um(self) -> Floats:
        """Size of each site: the square root of its area, (n_site,) µm."""
        return read_only(np.sqrt(self.area_um2))

    @property
    def centroid_um(self) -> Floats:
        """Centroid of each site, (n_site, 2) µm."""
        return self._moments[1]

    @cached_property
    def site_bounds_um(self) -> Floats:
        """Bounding box (x_min, y_min, x_max, y_max) of each site, (n_site, 4) µm."""
        if self.lattice is not None:
            return read_only(self.lattice.site_bounds_um())
        return read_only(site_bounds_um(*self.rings_um))

    @cached_property
    def bounds_um(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, y_min, x_max, y_max) of the layout, µm."""
        if self.n_sites == 0:
            raise GeometryError("the layout has no sites, so its bounds are undefined")
        if self.lattice is not None:
            return self.lattice.bounds_um
        x_um, y_um = self.xy_um[:, 0], self.xy_um[:, 1]  # separately: many times faster than a reduction along axis 0
        return float(x_um.min()), float(y_um.min()), float(x_um.max()), float(y_um.max())

    def polygons(self) -> NDArray[Any]:
        """Return the sites as shapely polygons, (n_site,) array of objects."""
        return polygons_of(*self.rings_um)

    # -- transformations: each returns a new layout ----------------------------------------------------------------

    def __getitem__(self, selection: Any) -> Layout:
        """Select sites by a mask, a slice, indices, or a function that returns one of these."""
        chosen = unmasked("selection", selection(self) if callable(selection) else selection)
        if isinstance(chosen, slice) and chosen.step in (None, 1):
            return self._range(*chosen.indices(self.n_sites)[:2])
        ids = np.atleast_1d(np.arange(self.n_sites)[chosen])
        if ids.ndim != 1:
            raise ParameterError("selection", f"must be a mask, a slice or a list of sites, got {ids.ndim} dimensions")
        columns = {name: column[ids] for name, column in self.columns.items()}
        step = f"selected {ids.size} of {self.n_sites} sites"
        return derived(self, step, select_sites(*self.rings_um, ids), columns)

    def _range(self, first: int, last: int) -> Layout:
        """Return the sites ``first`` to ``last - 1``."""
        last = max(first, last)
        if self.lattice is not None:
            rings = self.lattice.rows(first, last) or self.lattice.rings(first, last)
        else:
            site_offsets = self.site_offsets[first : last + 1]
            ring_offsets = self.ring_offsets[site_offsets[0] : site_offsets[-1] + 1]
            xy_um = self.xy_um[ring_offsets[0] : ring_offsets[-1]]
            rings = xy_um.copy(), ring_offsets - ring_offsets[0], site_offsets - site_offsets[0]
        columns = {name: column[first:last].copy() for name, column in self.columns.items()}
        return derived(self, f"selected {last - first} of {self.n_sites} sites", rings, columns)

    def sort_by(self, *keys: str | ArrayLike, descending: bool = False) -> Layout:
        """
        Sort the sites by one or more keys, the first key being the primary one.

        The sort is stable.

        Parameters
        ----------
        *keys : str or (n_site,) array
            Names of columns, or arrays of values.
        descending : bool
            Whether the largest values come first.

        Raises
        ------
        ParameterError
            When there is no key, or a key is neither a column nor one value per site.

        Examples
        --------
        >>> layout = Layout.from_rectangles([[0, 0], [5, 0]], [3.0, 1.0])
        >>> layout.sort_by(layout.area_um2).area_um2.tolist()
        [1.0, 9.0]
        """
        values = []
        for key in keys:
            if isinstance(key, str) and key not in self.columns:
                hint = possible_names(key, sorted(self.columns))
                raise ParameterError("keys", "must be values or columns of the layout", key, hint=hint)
            value = self.columns[key] if isinstance(key, str) else np.asarray(unmasked("keys", key))
            # Ranks, because strings cannot be negated for descending order.
            rank = np.unique(check_per_site("keys", value, self.n_sites), return_inverse=True)[1]
            values.append(-rank if descending else rank)
        if not values:
            raise ParameterError("keys", "must be one or more columns or arrays")
        names = ", ".join(key if isinstance(key, str) else "values" for key in keys)
        ordered = self[np.lexsort(values[::-1])]
        return derived(self, f"sorted by {names}", ordered.rings_um, ordered.columns)

    def with_columns(self, **columns: OwnCheck[ArrayLike]) -> Layout:
        """Return the layout with columns added or replaced."""
        found = derived(self, f"columns {', '.join(columns)} set", columns={**self.columns, **columns})
        if "channel" in columns and CHANNEL_LETTERS in found.provenance:
            return found.with_provenance({k: v for k, v in found.provenance.items() if k != CHANNEL_LETTERS})
        return found

    def translate(self, dx_um: Annotated[float, FINITE], dy_um: Annotated[float, FINITE]) -> Layout:
        """Translate the layout by (dx, dy) in µm."""
        shift_um = np.array([dx_um, dy_um])
        step = f"translated by ({dx_um:g}, {dy_um:g}) µm"
        if self.lattice is not None:
            return derived(self, step, self.lattice.scaled(1.0, shift_um))
        return derived(
            self, step, (freeze(from_frame(self.xy_um, shift_um, 1.0)), self.ring_offsets, self.site_offsets)
        )

    def centre(self) -> Layout:
        """Translate the layout so that the centre of its bounding box is at the origin."""
        if not self.n_sites:
            return self
        x0_um, y0_um, x1_um, y1_um = self.bounds_um
        return self.translate(-0.5 * (x0_um + x1_um), -0.5 * (y0_um + y1_um))

    def rotate(self, angle_deg: Annotated[float, FINITE], origin_um: tuple[float, float] = (0.0, 0.0)) -> Layout:
        """Rotate counter-clockwise about a point; multiples of 90° about the origin are exact."""
        quarters, rest = divmod(angle_deg, 90.0)
        exact = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
        c, s = exact if rest == 0.0 else (np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg)))
        centre = np.array(check_point("origin_um", origin_um))
        # (A @ xy) row by row: x' = c x - s y, y' = s x + c y
        rotated = (self.xy_um - centre) @ np.array([[c, s], [-s, c]]) + centre
        return derived(self, f"rotated by {angle_deg:g} degrees", (rotated, self.ring_offsets, self.site_offsets))

    def scale(self, factor: Annotated[float, POSITIVE], origin_um: tuple[float, float] = (0.0, 0.0)) -> Layout:
        """Scale the layout about a point."""
        centre = np.array(check_point("origin_um", origin_um))
        step = f"scaled by {factor:g}"
        if self.lattice is not None:
            return derived(self, step, self.lattice.scaled(1.0, -centre).scaled(factor, centre))
        return derived(self, step, ((self.xy_um - centre) * factor + centre, self.ring_offsets, self.site_offsets))

    def write(self, path: str | Path, **options: Any) -> WrittenLayout:
        """Write to a file, format by extension; see :func:`foveasim.layout.write_layout`."""
        write_layout = load("layout.files").write_layout
        return write_layout(self, path, **options)

    def describe(self, readout: Readout | None = None) -> Summary:
        """Return counts, sizes, areas, channels and lines; see :func:`foveasim.layout.describe`."""
        describe = load("layout.summary").describe
        return describe(self, readout)

    to_pyvista: ClassVar[ViewMethod[PolyData]] = view_method("polydata")
    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_layout")
    plot3d: ClassVar[ViewMethod[None]] = view_method("show_columns")
    _repr_html_ = view_method("to_html")

    # -- neighbours ----------------------------------------------------------------------------------------------

    def adjacency(self, *, max_gap_um: float | None = None) -> csr_array[Any]:
        """Compute shared edge lengths (n, n) in µm; see :func:`foveasim.layout.adjacency`."""
        from foveasim.layout.adjacency import adjacency

        return adjacency(self) if max_gap_um is None else adjacency(self, max_gap_um=max_gap_um)

    def to_graph(self, *, n_neighbours: int | None = None, **options: Any) -> SiteGraph:
        """Return the graph of the sites; see :func:`foveasim.layout.to_graph`."""
        from foveasim.layout.graph import to_graph

        return to_graph(self, n_neighbours=n_neighbours, **options)

    # -- design rules --------------------------------------------------------------------------------------------------

    def check(self, rules: DesignRules) -> Report:
        """Check design rules; violations are reported, not raised."""
        check = load("layout.drc.rules").check
        return check(self, rules)

    def enforce(
        self, rules: DesignRules, *, repair: Literal["best", "drop", "shrink", "merge", "refill"] = "best"
    ) -> tuple[Layout, Changes]:
        """Repair violations of design rules; see :func:`foveasim.layout.enforce`."""
        enforce = load("layout.drc.repair").enforce
        return enforce(self, rules, repair=repair)

    def clean(self, tolerance_um: float) -> tuple[Layout, Changes]:
        """Snap vertices, fill narrow gaps and resolve overlaps; see :func:`foveasim.layout.clean`."""
        clean = load("layout.drc.cleaning").clean
        return clean(self, tolerance_um)


# -- layouts from other layouts ----------------------------------------------------------------------------------


def layout_of(
    xy_um: Floats,
    ring_offsets: Ints,
    site_offsets: Ints | None = None,
    columns: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Layout:
    """Return a layout of valid sites, by default of one ring each, without checks of holes."""
    site_offsets = freeze(np.arange(ring_offsets.size)) if site_offsets is None else site_offsets
    layout = object.__new__(Layout)
    fields = (xy_um, ring_offsets, site_offsets, columns or {}, provenance or {})
    for name, value in zip((*RINGS, "columns", "provenance"), fields, strict=True):
        object.__setattr__(layout, name, value)
    layout._store()
    return layout


def derived(
    layout: Layout,
    step: str,
    rings_um: tuple[Floats, Ints, Ints] | RectangleLattice | None = None,
    columns: Mapping[str, Any] | None = None,
) -> Layout:
    """Return a layout with other rings or columns, and with a further step in its provenance."""
    provenance = {**layout.provenance, "steps": [*layout.provenance.get("steps", []), step]}
    columns = layout.columns if columns is None else columns
    if isinstance(rings_um, RectangleLattice):
        return Layout.from_lattice(rings_um, columns, provenance)
    if rings_um is not None:
        return layout_of(*rings_um, columns, provenance)
    found = layout.with_provenance(provenance)
    object.__setattr__(found, "columns", columns)
    found._store_columns()  # noqa: SLF001 -- of the same module
    return found


def winding_um2(xy_um: Floats, ring_offsets: Ints, site_offsets: Ints) -> Floats:
    """Return the area of each ring, negative if its winding order is wrong."""
    area_um2 = ring_area_um2(xy_um, ring_offsets)
    area_um2 *= -1.0  # of holes
    area_um2[site_offsets[:-1]] *= -1.0
    return area_um2


# -- validation of input polygons --------------------------------------------------------------------------------


def _column(name: str, values: ArrayLike) -> NDArray[Any]:
    """Convert a data column to a read-only array of numbers or strings."""
    values = unmasked(name, values)
    try:
        column = frozen_array(np.asarray(values))
    except ValueError:
        raise ParameterError(name, "must have one value for each site", values) from None
    is_as_given = isinstance(values, np.ndarray) and values.dtype.kind == "f"
    if column.ndim == 1 and column.dtype.kind in "fO" and not is_as_given:
        items: list[Any] = list(cast(Any, values))
        if items and all(isinstance(item, int | np.integer) for item in items):
            integers = exact_integers([int(item) for item in items])
            if integers is None:
                raise ParameterError(name, f"must contain {INTEGER_RANGES}", values)
            return read_only(integers)
    if column.dtype.hasobject:
        raise ParameterError(name, "must be an array of numbers or strings", values)
    return column


def _require_near_origin(largest_um: float) -> None:
    if largest_um > MAX_LENGTH_UM:
        raise GeometryError(f"the layout must lie within {MAX_LENGTH_UM:g} µm of the origin; coordinates are in µm")


def _require_indices(name: str, column: NDArray[Any]) -> None:
    """Check that integers are valid indices of filters or lines."""
    if column.dtype.kind in "iu" and column.size:
        worst = int(column.min()) if column.min() < 0 else int(column.max())
        if not 0 <= worst <= MAX_SITES:
            raise ParameterError(name, f"must contain integers from 0 to {MAX_SITES}", worst)


def _is_packed(polygons: Any) -> bool:
    """Return whether polygons are packed rings: vertices, and two sequences of offsets."""
    if not (isinstance(polygons, tuple) and len(polygons) == 3):
        return False
    if any(isinstance(each, shapely.Geometry) for each in polygons):
        return False
    shapes = [_shape(each) for each in polygons]
    return any(len(shape) < 2 for shape in shapes[1:]) and any(shape != (2,) for shape in shapes)


def _shape(values: Any) -> tuple[int, ...]:
    """Return the shape of an array-like; (0, 0) for sequences of different lengths."""
    try:
        return np.shape(values)
    except ValueError:
        return 0, 0


def _is_vertices(outline: Any) -> bool:
    """Return whether an outline is an array (n, 2) of numbers."""
    if isinstance(outline, shapely.Geometry):
        return False
    try:
        found = np.asarray(outline)
    except ValueError:  # rows of different lengths
        return False
    return found.ndim == 2 and found.shape[1] == 2 and found.dtype.kind in "iuf"


def _pack_polygons(polygons: Any) -> tuple[Floats, Ints, Ints]:
    """Return packed rings of shapely polygons or vertices, closing vertices included."""
    items = polygons.geoms if hasattr(polygons, "geoms") else polygons
    if (
        isinstance(items, str | bytes | shapely.Geometry)
        or not isinstance(items, Iterable)
        or (isinstance(items, np.ndarray) and not items.ndim)
    ):
        raise ParameterError("polygons", "must be a sequence of shapely polygons or vertices, or packed rings", items)
    outlines = list(items)
    is_polygon = np.array([isinstance(each, shapely.Polygon) for each in outlines], bool)
    for number in np.flatnonzero(~is_polygon).tolist():
        outline = outlines[number]
        if not _is_vertices(outline):
            is_geometry = isinstance(outline, shapely.Geometry)
            is_point = not is_geometry and _shape(outline) == (2,)
            hint = "; pass each of its parts as a separate site" if is_geometry else ""
            hint = "; pass [vertices] for a single site" if is_point else hint
            raise GeometryError(
                f"site {number} must be a shapely Polygon, or vertices (n, 2), got {type_name(outline)}{hint}",
                (number,),
            )
        outlines[number] = np.asarray(outline, np.float64)
    if outlines and not is_polygon.any():
        n_vertices = np.array([len(each) for each in outlines])
        _require(n_vertices == 0, "is empty")
        return np.concatenate(outlines), np.r_[0, np.cumsum(n_vertices)], np.arange(len(outlines) + 1)
    is_short = np.array([isinstance(each, np.ndarray) and len(each) < 3 for each in outlines], bool)
    _require(is_short, "has a ring of fewer than 3 distinct vertices")
    geometries = np.fromiter(
        (shapely.Polygon(each) if isinstance(each, np.ndarray) else each for each in outlines), dtype=object
    )
    _require(shapely.is_empty(geometries), "is empty")
    if geometries.size == 0:
        return np.zeros((0, 2)), np.zeros(1, np.int64), np.zeros(1, np.int64)
    _, coordinates, (ring_offsets, site_offsets) = shapely.to_ragged_array(geometries, include_z=False)
    return coordinates, ring_offsets.astype(np.int64), site_offsets.astype(np.int64)


def _per_site(is_bad: Bools, ring_offsets: Ints, site_offsets: Ints) -> Bools:
    """Return whether any coordinate (n_vertex, 2) of each site is flagged, (n_site,)."""
    if site_offsets.size == 1:
        return np.zeros(0, bool)
    return np.asarray(np.logical_or.reduceat(np.any(is_bad, axis=1), ring_offsets[site_offsets[:-1]]))


def _require(is_bad_site: Bools, what: str) -> None:
    bad = np.flatnonzero(is_bad_site)
    if bad.size:
        others = (
            f" (and {bad.size - 1} more: {', '.join(map(str, bad[1:MAX_LISTED]))}{', ...' * (bad.size > MAX_LISTED)})"
        )
        raise GeometryError(f"site {bad[0]} {what}{others if bad.size > 1 else ''}", tuple(int(i) for i in bad))


def _require_valid_holes(layout: Layout) -> None:
    """Check that sites with holes are valid, and that their holes are wound clockwise."""
    if layout.ring_offsets.size == layout.site_offsets.size:
        return
    has_holes = np.diff(layout.site_offsets) > 1
    _require(
        has_holes & np.logical_or.reduceat(winding_um2(*layout.rings_um) <= 0.0, layout.site_offsets[:-1]),
        "has a hole that is wound the wrong way, or has no area",
    )
    sites = np.flatnonzero(has_holes)
    _require_valid(layout[sites], sites, layout.n_sites)


def _require_valid(layout: Layout, sites: Ints | None = None, n_sites: int = 0) -> None:
    """Check that all sites are valid OGC polygons; ``sites`` are indices in a larger layout."""
    is_bad = ~valid_sites(layout)
    if not is_bad.any():
        return
    reason = str(shapely.is_valid_reason(layout[is_bad].polygons()[0]))
    if sites is not None:
        is_bad = np.isin(np.arange(n_sites), sites[is_bad])
    what = HOLE_REASONS.get(reason.partition("[")[0], f"crosses or touches itself ({reason})")
    _require(is_bad, f"{what}; repair its outline")


def valid_sites(layout: Layout) -> Bools:
    """
    Return whether each site is a valid OGC polygon, (n_site,) bool.

    Rings of a valid polygon do not cross, and holes lie inside the outline. Only concave outlines are passed to shapely.
    """
    outlines, n_rings = layout.site_offsets[:-1], np.diff(layout.site_offsets)
    is_valid = (n_rings == 1) & (convexity(layout.xy_um, layout.ring_offsets)[outlines] != 0)
    others = np.flatnonzero(~is_valid)
    if others.size:
        is_valid[others] = shapely.is_valid(layout[others].polygons())
    return is_valid


def without_repeats(xy_um: Floats, ring_offsets: Ints) -> tuple[Floats, Ints]:
    """Remove vertices equal to the next one, closing vertices included."""
    if ring_offsets.size == 1:
        return xy_um, ring_offsets
    vertices = np.ascontiguousarray(xy_um).view(np.complex128)[:, 0]
    is_new = np.empty(vertices.size, bool)
    np.not_equal(vertices[:-1], vertices[1:], out=is_new[:-1])
    last = ring_offsets[1:] - 1
    is_new[last] = vertices[last] != vertices[ring_offsets[:-1]]
    if is_new.all():
        return xy_um, ring_offsets
    n_left = np.add.reduceat(is_new.astype(np.int64), ring_offsets[:-1])
    return xy_um[is_new], np.concatenate(([0], np.cumsum(n_left)))


def _reverse_rings(xy_um: Floats, ring_offsets: Ints, is_reversed: Bools) -> Floats:
    """Reverse some rings, without change of their first vertices."""
    n_vertices = np.diff(ring_offsets)
    ring_of = np.repeat(np.arange(n_vertices.size), n_vertices)
    position = positions_in_runs(n_vertices)
    index = np.where(is_reversed[ring_of], -position % n_vertices[ring_of], position)
    return xy_um[ring_offsets[:-1][ring_of] + index]
