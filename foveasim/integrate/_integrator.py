"""The integrator: what users hold of a compiled plan."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.rings import site_area_um2
from foveasim._core.threads import thread_count
from foveasim._core.validation import Floats, Ints, check_choice, check_count, finite_array, read_only, unmasked
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid, PackedRings, PointMap
from foveasim.integrate._outlines import Outlines, UndistortedOutlines, outlines_of
from foveasim.integrate._plan import Plan, compile_plan

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["Integrator"]

#: A site lies on the grid when no corner is further off than this fraction of the grid's coordinates: their rounding.
UNCOVERED_ROUNDING = 1e-12


class Integrator:
    """
    Integrates maps over the sites of a layout, exactly, in one pass over the map.

    Parameters
    ----------
    layout : Layout, or any object with ``xy_um``, ``ring_offsets``, ``site_offsets``
        Outlines in the sensor plane, outer rings counter-clockwise and holes clockwise.
    grid : Grid
        The cells of the maps to come.
    distortion : object with ``undistort(xy_um, outside="mask")``, optional
        A lens of :mod:`foveasim.distortion`: the outlines are carried back into the map's plane, once. Maps are those of the
        ideal lens.
    conserve : {"flux", "density"}
        What the lens keeps: the power that falls on a piece of the image, which is physics; or its power per area, as when a
        picture is warped.
    order : {1, 2}
        How the map is read between its means: 1 takes every cell as even, 2 as its mean with a gradient, so that linear fields
        are exact too.
    n_threads : int, optional
        All cores of the process by default. Results do not depend on it, bit for bit.

    Raises
    ------
    ParameterError
        When an argument is none of the above; on a call, when a map does not fit the grid.
    GeometryError
        When an outline is clockwise.

    Notes
    -----
    Exact means: up to float64 rounding, for every polygon (concave, with holes, smaller than a cell, larger than
    the map, with edges on cell borders). A part of a site that is off the grid receives nothing and is told by
    ``uncovered_um2``. Compiling costs the number of crossings of outlines and cell borders; a frame one reading of
    the map and two operations a cut cell. Method: Green's theorem on a map that is constant on its cells.

    At second order the gradient is half the difference of the cells on either side, or the whole difference of the two last
    cells at the map's borders (0 along a single cell). Means are kept, and so is the light: a cell that a site covers wholly
    gives it just its mean. Of a cell that an outline cuts all four neighbours are read, on the site or not, so a NaN
    reaches one cell further than at first order; and beside an edge that is sharper than the cells a site may get a little less
    than nothing of a map that is nowhere negative. The square of side λN about a diffraction pattern's centre, at any
    offset of the cells, gets its fraction of 0.5289 with errors of up to 5e-2 at first and 1e-2 at second order for 3 cells
    per λN, 7e-3 and 2e-4 for 8, 2e-3 and 1e-5 for 16. A frame takes about 1.4 times as long, compiling 1.5 times.

    The second order is for maps that are smooth over a few cells, as a diffraction-limited image is on cells of λN/2 or less:
    there its errors are 2 to 70 times less. A picture whose pixels are even squares, each one cell and wider than λN, is
    what the first order takes it for, and the better for it.

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

    A ramp is even in no cell, so a site that cuts cells needs the second order:

    >>> ramp = np.broadcast_to([0.5, 1.5, 2.5], (3, 3))
    >>> left = fs.Layout.from_rectangles([[0.75, 1.5]], 0.5)
    >>> [float(fs.Integrator(left, integrator.grid, order=order)(ramp)[0]) for order in (1, 2)]
    [0.125, 0.1875]
    """

    def __init__(
        self,
        layout: PackedRings,
        grid: Grid,
        *,
        distortion: PointMap | None = None,
        conserve: Literal["flux", "density"] = "flux",
        order: Literal[1, 2] = 1,
        n_threads: int | None = None,
    ) -> None:
        if not all(hasattr(layout, name) for name in ("xy_um", "ring_offsets", "site_offsets")):
            raise ParameterError("layout", f"must be a Layout, or packed rings, got a {type(layout).__name__}")
        if not isinstance(grid, Grid):
            raise ParameterError("grid", f"must be a Grid, got a {type(grid).__name__}")
        self.grid = grid
        self.order = check_count("order", order, at_most=2, hint="1 takes cells as even, 2 as means with a gradient")
        self.n_threads = thread_count(n_threads)
        check_choice("conserve", conserve, ("flux", "density"))
        outlines: Callable[[int, int], Outlines] = partial(outlines_of, layout)
        if distortion is not None:
            if not hasattr(distortion, "undistort"):
                raise ParameterError("distortion", "must be a lens of foveasim.distortion", distortion)
            outlines = UndistortedOutlines(layout, distortion, min(grid.pitch_x_um, grid.pitch_y_um))
        self._plan: Plan = compile_plan(outlines, layout.site_offsets.size - 1, grid, self.n_threads, self.order)
        # A lens does not turn outlines over: its image of one that is clockwise is so too.
        inside_out = np.flatnonzero(self._plan.area_um2 <= 0.0)
        if inside_out.size:
            raise GeometryError(
                f"site {inside_out[0]} has no positive area: its outline must be counter-clockwise, as from_polygons makes it",
                tuple(int(i) for i in inside_out),
            )
        self._gain: Floats | None = None
        if distortion is not None and (conserve == "density" or self._plan.is_lost.any()):
            self._gain = np.where(self._plan.is_lost, 0.0, 1.0)
            if conserve == "density":
                self._gain *= (
                    site_area_um2(layout.xy_um, layout.ring_offsets, layout.site_offsets) / self._plan.area_um2
                )

    @property
    def sites_outside_image_circle(self) -> Ints:
        """Sites outside the lens's image circle, which receive nothing."""
        return np.flatnonzero(self._plan.is_lost)

    def __repr__(self) -> str:
        return f"Integrator({self.n_sites} sites on {self.grid})"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self._plan.n_sites

    @cached_property
    def uncovered_um2(self) -> Floats:
        """Area of each site, in the map's plane, that lies off the grid or gets no light through the lens, (n_site,) µm²."""
        plan, (x_min, y_min, x_max, y_max) = self._plan, self.grid.bounds_um
        rounding_um = UNCOVERED_ROUNDING * max(map(abs, self.grid.bounds_um))
        low_um, high_um = plan.bounds_um[:, :2], plan.bounds_um[:, 2:]
        beyond_um = np.maximum(np.array([x_min, y_min]) - low_um, high_um - np.array([x_max, y_max])).max(
            axis=1, initial=-np.inf
        )
        rest_um2 = np.clip(plan.area_um2 - plan.covered_um2, 0.0, plan.area_um2)
        rest_um2 = np.where(beyond_um > rounding_um, rest_um2, 0.0)
        return read_only(np.where(plan.is_lost, plan.area_um2, rest_um2))

    def __call__(self, power_map: ArrayLike) -> Floats:
        """
        Integral of the map over every site.

        Parameters
        ----------
        power_map : (..., n_y, n_x) float32 or float64
            Cell means, row 0 lowest. Other types are converted to float64. A site that reads a NaN gets NaN; masked cells are
            rejected, since a mask does not say what they contain.

        Returns
        -------
        power : (..., n_site) float64, the map's unit times µm²
        """
        power_map = unmasked("power_map", power_map)
        try:
            cells = np.asarray(power_map)
        except ValueError:
            raise ParameterError("power_map", "must be an array of numbers", power_map) from None
        if cells.dtype.hasobject:
            raise ParameterError(
                "power_map", f"must be an array, got a {type(power_map).__name__}", hint="of a PowerMap give its .data"
            )
        if cells.ndim < 2 or cells.shape[-2:] != self.grid.shape:
            raise ParameterError(
                "power_map",
                f"must have the shape (..., n_y, n_x) with (n_y, n_x) = {self.grid.shape}, got {cells.shape}",
            )
        if cells.dtype not in (np.float32, np.float64):
            if not np.can_cast(cells.dtype, np.float64):
                raise ParameterError("power_map", f"must have real numbers, got the type {cells.dtype}")
            cells = cells.astype(np.float64)
        power = np.empty((*cells.shape[:-2], self.n_sites))
        for band in np.ndindex(*cells.shape[:-2]):
            power[band] = self._plan.gather(np.ascontiguousarray(cells[band]), self.n_threads)
        power *= self.grid.cell_area_um2
        if self._gain is not None:
            power *= self._gain
        return power

    def spread(self, values: ArrayLike) -> Floats:
        """
        The transpose: what every cell gets when each site spreads its value over its area.

        Parameters
        ----------
        values : (..., n_site)

        Returns
        -------
        cells : (..., n_y, n_x) float64, the values' unit times µm²
            ``sum over sites of values[site] * area(site ∩ cell)``.
        """
        values = finite_array("values", values)
        if values.shape[-1:] != (self.n_sites,):
            raise ParameterError("values", f"must have the shape (..., {self.n_sites}), got {values.shape}")
        if self._gain is not None:
            values = values * self._gain
        cells = np.empty((*values.shape[:-1], *self.grid.shape))
        for band in np.ndindex(*values.shape[:-1]):
            cells[band] = self._plan.scatter(values[band], self.n_threads)
        cells *= self.grid.cell_area_um2
        return cells

    def weights(self) -> csr_array[Any]:
        """
        The operator as a sparse matrix.

        Returns
        -------
        weights : csr_array (n_site, n_y * n_x) float64, µm²
            ``area(site ∩ cell)``; ``weights @ power_map.ravel()`` is ``integrator(power_map)``.
        """
        matrix = self._plan.matrix() * self.grid.cell_area_um2
        if self._gain is not None:
            matrix = matrix.multiply(self._gain[:, np.newaxis]).tocsr()
        return matrix
