"""The integrator: what users hold of a compiled plan."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim.arrays import Floats, finite_array, read_only
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid, PackedRings
from foveasim.integrate._plan import Plan, compile_plan
from foveasim.parallel import thread_count
from foveasim.rings import site_area_um2, site_bounds_um

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["Integrator"]

#: A site lies on the grid when no corner is further off than this share of the grid's coordinates: their rounding.
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
    """

    def __init__(self, layout: PackedRings, grid: Grid, *, n_threads: int | None = None) -> None:
        if not all(hasattr(layout, name) for name in ("xy_um", "ring_offsets", "site_offsets")):
            raise ParameterError("layout", f"must be a Layout, or packed rings, got a {type(layout).__name__}")
        if not isinstance(grid, Grid):
            raise ParameterError("grid", f"must be a Grid, got a {type(grid).__name__}")
        self.grid = grid
        self.n_threads = thread_count(n_threads)
        self._area_um2 = site_area_um2(layout.xy_um, layout.ring_offsets, layout.site_offsets)
        inside_out = np.flatnonzero(self._area_um2 <= 0.0)
        if inside_out.size:
            raise GeometryError(
                f"site {inside_out[0]} has no positive area: its outline must be counter-clockwise, as from_polygons makes it",
                tuple(int(i) for i in inside_out),
            )
        self._plan: Plan = compile_plan(layout, grid, self.n_threads)
        self._bounds_um = site_bounds_um(layout.xy_um, layout.ring_offsets, layout.site_offsets)

    def __repr__(self) -> str:
        return f"Integrator({self.n_sites} sites on {self.grid})"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self._plan.n_sites

    @cached_property
    def uncovered_um2(self) -> Floats:
        """Area of each site that lies off the grid and receives nothing, (n_site,) µm²."""
        x_min, y_min, x_max, y_max = self.grid.bounds_um
        rounding_um = UNCOVERED_ROUNDING * max(map(abs, self.grid.bounds_um))
        low_um, high_um = self._bounds_um[:, :2], self._bounds_um[:, 2:]
        beyond_um = np.maximum(np.array([x_min, y_min]) - low_um, high_um - np.array([x_max, y_max])).max(
            axis=1, initial=-np.inf
        )
        rest_um2 = np.clip(self._area_um2 - self._plan.covered_um2, 0.0, self._area_um2)
        return read_only(np.where(beyond_um > rounding_um, rest_um2, 0.0))

    def __call__(self, power_map: ArrayLike) -> Floats:
        """
        Integral of the map over every site.

        Parameters
        ----------
        power_map : (..., n_y, n_x) float32 or float64
            Cell means, row 0 lowest. Other types are converted to float64.

        Returns
        -------
        power : (..., n_site) float64, the map's unit times µm²
        """
        try:
            cells = np.asarray(power_map)
        except ValueError:
            raise ParameterError("power_map", "must be an array of numbers", power_map) from None
        if cells.dtype.hasobject:
            raise ParameterError(
                "power_map", f"must be an array, got a {type(power_map).__name__}", cure="of a PowerMap give its .data"
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
        return self._plan.matrix() * self.grid.cell_area_um2
