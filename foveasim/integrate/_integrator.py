"""Public interface to a compiled integration plan."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import OwnCheck
from foveasim._core.rings import site_area_um2
from foveasim._core.threads import cached_property, thread_count
from foveasim._core.validation import Floats, Ints, as_any_array, finite_array
from foveasim.errors import GeometryError, ParameterError, type_name
from foveasim.fields import Grid, PackedRings, PointMap
from foveasim.integrate._outlines import Outlines, UndistortedOutlines, outlines_of
from foveasim.integrate._plan import Plan, compile_plan
from foveasim.integrate._rectangles import LatticePlan, RectanglePlan, rectangle_plan
from foveasim.integrate._traced import TracedOutlines

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class Integrator:
    """
    Exact integration of maps over the sites of a layout, in one pass over the map.

    Parameters
    ----------
    layout : Layout, or any object with ``xy_um``, ``ring_offsets``, ``site_offsets``
        Outlines in the sensor plane, outer rings counter-clockwise and holes clockwise.
    grid : Grid
        Grid of the maps.
    distortion : object with ``undistort(xy_um, outside="mask")``, optional
        A lens of :mod:`foveasim.distortion`. The outlines are undistorted once into the plane of the map, which is the image
        of the ideal lens.
    conserve : {"flux", "density"}
        Quantity that the distortion conserves: the power on an area of the image (physical), or the power per area (as in
        image warping).
    order : {1, 2}
        Order of the reconstruction within cells: 1 treats cells as constant, 2 as a mean with a gradient, so that linear maps
        are also exact.
    compiled : bool
        Whether to store the overlaps of sites and cells. If not, the outlines are traced at every call, which is faster for
        layouts and positions that are used for one or two maps. Axis-aligned rectangles need no overlaps in either case.
    n_threads : int, optional
        Number of threads, by default all cores of the process. Results are bit-identical for any number.

    Raises
    ------
    ParameterError
        If an argument differs from the above; on a call, if a map does not match the grid.
    GeometryError
        If an outline is clockwise.

    Notes
    -----
    Results are exact up to float64 rounding for every polygon (concave, with holes, smaller than a cell, larger than the
    map, with edges on cell boundaries). Areas of sites outside the grid contribute 0; ``uncovered_um2`` reports them. The
    cost of compiling is proportional to the number of crossings of outlines and cell boundaries. A frame reads the map once
    and needs two operations per cut cell. Method: Green's theorem for a map that is constant within cells.

    At second order the gradient is half the difference of the two adjacent cells, or the difference of the two outermost
    cells at the boundary of the map (0 along a single cell). Cell means are preserved, and so is the total power: a cell that
    a site covers completely contributes exactly its mean. A cell that an outline cuts also reads its four neighbours, whether
    or not they overlap the site. A NaN therefore reaches one cell further than at first order, and near an edge that is
    sharper than the cells a site can receive a slightly negative value from a map without negative values. For the square of
    side λN centred on a diffraction pattern (ensquared energy 0.5289) the largest errors over all offsets of the cells are
    5e-2 at first and 1e-2 at second order for 3 cells per λN, 7e-3 and 2e-4 for 8, 2e-3 and 1e-5 for 16. A frame takes
    about 1.4 times as long, compiling 1.5 times.

    Use the second order for maps that are smooth over a few cells, such as a diffraction-limited image on cells of λN/2 or
    less: its errors are 2 to 70 times smaller. Use the first order for images of uniform square pixels of one cell each, wider
    than λN: the first order represents them exactly.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles([[1.5, 1.5]], size_um=2.0)
    >>> integrator = fs.Integrator(layout, fs.Grid(shape=(3, 3), pitch_um=1.0))
    >>> integrator(np.ones((3, 3)))
    array([4.])
    >>> integrator.weights().toarray().reshape(3, 3)
    array([[0.25, 0.5 , 0.25],
           [0.5 , 1.  , 0.5 ],
           [0.25, 0.5 , 0.25]])

    A ramp is not constant within cells, so a site that cuts cells needs the second order:

    >>> ramp = np.broadcast_to([0.5, 1.5, 2.5], (3, 3))
    >>> left = fs.Layout.from_rectangles([[0.75, 1.5]], 0.5)
    >>> [
    ...     float(fs.Integrator(left, integrator.grid, order=order)(ramp)[0])
    ...     for order in (1, 2)
    ... ]
    [0.125, 0.1875]
    """

    def __init__(
        self,
        layout: OwnCheck[PackedRings],
        grid: OwnCheck[Grid],
        *,
        distortion: OwnCheck[PointMap | None] = None,
        conserve: Literal["flux", "density"] = "flux",
        order: Literal[1, 2] = 1,
        compiled: bool = True,
        n_threads: int | None = None,
    ) -> None:
        has_lattice = getattr(layout, "lattice", None) is not None
        if not has_lattice and not all(hasattr(layout, name) for name in ("xy_um", "ring_offsets", "site_offsets")):
            raise ParameterError("layout", f"must be a Layout or packed rings, got {type_name(layout)}")
        if not isinstance(grid, Grid):
            raise ParameterError("grid", f"must be a Grid, got {type_name(grid)}")
        self.grid = grid
        self.order: int = int(order)
        self.n_threads: int = thread_count(n_threads)
        outlines: Callable[[int, int], Outlines] = partial(outlines_of, layout)
        if distortion is not None:
            if not hasattr(distortion, "undistort"):
                raise ParameterError("distortion", "must be a lens of foveasim.distortion", distortion)
            outlines = UndistortedOutlines(layout, distortion, min(grid.pitch_x_um, grid.pitch_y_um))
        self._outlines = outlines
        self._n_sites: int = layout.n_sites if hasattr(layout, "n_sites") else layout.site_offsets.size - 1
        self._gain: Floats | None = None
        self._overlaps: Plan | TracedOutlines | RectanglePlan | LatticePlan
        rectangles = rectangle_plan(layout, grid, self.order) if distortion is None else None
        if rectangles is not None:
            self._overlaps = rectangles
            return
        if compiled:
            self._overlaps, area_um2 = self._compile()
        else:
            self._overlaps = TracedOutlines(outlines, self._n_sites, grid, self.order, self.n_threads)
            area_um2 = self._overlaps.area_um2
            _require_counter_clockwise(area_um2)
        is_outside = self._overlaps.coverage.is_outside
        if distortion is not None and (conserve == "density" or is_outside.any()):
            self._gain = np.where(is_outside, 0.0, 1.0)
            if conserve == "density":
                self._gain *= site_area_um2(layout.xy_um, layout.ring_offsets, layout.site_offsets) / area_um2

    def _compile(self) -> tuple[Plan, Floats]:
        """Return the spans of all outlines, and their areas."""
        plan, area_um2 = compile_plan(self._outlines, self._n_sites, self.grid, self.n_threads, self.order)
        _require_counter_clockwise(area_um2)
        return plan, area_um2

    @cached_property
    def _compiled(self) -> Plan:
        """Spans of all outlines; for layouts of rectangles only matrices and adjoints need them."""
        return self._overlaps if isinstance(self._overlaps, Plan) else self._compile()[0]

    @property
    def sites_outside_image_circle(self) -> Ints:
        """Indices of sites outside the image circle of the lens, which receive no power."""
        return np.flatnonzero(self._overlaps.coverage.is_outside)

    def __repr__(self) -> str:
        return f"Integrator({self.n_sites} sites on {self.grid})"

    @property
    def is_compiled(self) -> bool:
        """Whether calls use stored overlaps, or are as fast without."""
        return not isinstance(self._overlaps, TracedOutlines)

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self._n_sites

    @property
    def bounds_um(self) -> tuple[float, float, float, float]:
        """
        Bounding box (x_min, y_min, x_max, y_max) of the outlines in the plane of the map, µm.

        Sites outside the image circle do not count; NaN if there are no other sites.
        """
        return self._overlaps.coverage.bounds_um

    @property
    def uncovered_um2(self) -> Floats:
        """
        Area of each site outside the grid or the image circle, (n_site,) µm².

        Areas are measured in the plane of the map.
        """
        return self._overlaps.coverage.uncovered_um2

    @cached_property
    def n_uncovered(self) -> int:
        """Number of sites that extend beyond the grid or the image circle."""
        return self._overlaps.coverage.n_uncovered

    def __call__(self, power_map: ArrayLike, *, where: ArrayLike | None = None, out: Floats | None = None) -> Floats:
        """
        Integrate a map over every site, or over some of them.

        Parameters
        ----------
        power_map : (..., n_y, n_x) float32 or float64
            Cell means, bottom row first. Other dtypes are converted to float64. A site that reads a NaN returns NaN. Masked
            arrays are rejected, because the value of a masked cell is undefined.
        where : (n_site,) bool, optional
            Sites to integrate; by default all. The cells of other sites are not read: with a mosaic of filters, the maps of all
            filters together cost little more than one map.
        out : (..., n_site) float64, optional
            Array for the result; its elements where ``where`` is False remain unchanged.

        Returns
        -------
        power : (..., n_site) float64, unit of the map times µm²
            ``out``, or a new array with 0 where ``where`` is False.

        Raises
        ------
        ParameterError
            When an array has another shape or type.
        """
        cells = as_any_array("power_map", power_map)
        if cells.dtype.hasobject:
            raise ParameterError(
                "power_map",
                f"must be an array, got {type_name(power_map)}",
                hint="pass the attribute .data of a PowerMap",
            )
        if cells.ndim < 2 or cells.shape[-2:] != self.grid.shape:
            raise ParameterError(
                "power_map",
                f"must have the shape (..., n_y, n_x) with (n_y, n_x) = {self.grid.shape}, got {cells.shape}",
            )
        if cells.dtype not in (np.float32, np.float64):
            if not np.can_cast(cells.dtype, np.float64):
                raise ParameterError("power_map", f"must contain real numbers, got the dtype {cells.dtype}")
            cells = cells.astype(np.float64)
        shape = *cells.shape[:-2], self.n_sites
        mask = np.zeros(0, bool)
        if where is not None:
            mask = np.ascontiguousarray(where)
            if mask.dtype != np.bool_ or mask.shape != (self.n_sites,):
                raise ParameterError(
                    "where", f"must be {self.n_sites} booleans, one per site, got {mask.dtype} of shape {mask.shape}"
                )
        power = out
        if power is None:
            power = np.zeros(shape) if where is not None else np.empty(shape)
        elif not (
            isinstance(power, np.ndarray)
            and power.dtype == np.float64
            and power.shape == shape
            and power.flags.c_contiguous
        ):
            raise ParameterError("out", f"must be a C-contiguous float64 array of shape {shape}", out)
        for band in np.ndindex(*cells.shape[:-2]):
            cell_means = np.ascontiguousarray(cells[band])
            self._overlaps.gather(cell_means, power[band], self.grid.cell_area_um2, mask, self.n_threads)
        if self._gain is not None:
            np.multiply(power, self._gain, out=power, where=mask if mask.size else True)
        return power

    def spread(self, values: ArrayLike) -> Floats:
        """
        Apply the adjoint operator: spread the value of each site over its area.

        Parameters
        ----------
        values : (..., n_site)

        Returns
        -------
        cells : (..., n_y, n_x) float64, unit of the values times µm²
            ``sum over sites of values[site] * area(site ∩ cell)``.
        """
        values = finite_array("values", values)
        if values.shape[-1:] != (self.n_sites,):
            raise ParameterError("values", f"must have the shape (..., {self.n_sites}), got {values.shape}")
        if self._gain is not None:
            values = values * self._gain
        cells = np.empty((*values.shape[:-1], *self.grid.shape))
        for band in np.ndindex(*values.shape[:-1]):
            cells[band] = self._compiled.scatter(values[band], self.n_threads)
        cells *= self.grid.cell_area_um2
        return cells

    def weights(self) -> csr_array[Any]:
        """
        Return the operator as a sparse matrix.

        Returns
        -------
        weights : csr_array (n_site, n_y * n_x) float64, µm²
            ``weights @ power_map.ravel()`` is ``integrator(power_map)``: at first order ``area(site ∩ cell)``, scaled for
            ``conserve="density"`` and 0 for sites outside the image circle; at second order also weights of the neighbours of
            boundary cells.
        """
        matrix = self._compiled.matrix() * self.grid.cell_area_um2
        if self._gain is not None:
            matrix = matrix.multiply(self._gain[:, np.newaxis]).tocsr()
        return matrix


def _require_counter_clockwise(area_um2: Floats) -> None:
    # A lens preserves the winding: the undistorted image of a clockwise outline is also clockwise.
    clockwise = np.flatnonzero(area_um2 <= 0.0)
    if clockwise.size:
        raise GeometryError(
            f"the outline of site {clockwise[0]} must be counter-clockwise with a positive area; use Layout.from_polygons",
            tuple(int(i) for i in clockwise),
        )
