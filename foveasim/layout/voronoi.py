"""The density-driven layout: sites as dense as any picture or function asks, evened out by Lloyd's steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np
import shapely
from numpy.typing import ArrayLike

from foveasim.arrays import (
    MAX_LENGTH_UM,
    Floats,
    Ints,
    as_numbers,
    check_count,
    check_length_um,
    check_sites,
    finite_array,
)
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.layout._model import Layout
from foveasim.layout._voronoi import cells_of
from foveasim.rings import next_vertex, ring_moments
from foveasim.streams import Streams

__all__ = ["voronoi"]

#: A picture (n_y, n_x), or a function of points (n, 2) µm that gives (n,) numbers.
Density: TypeAlias = ArrayLike | Callable[[Any], ArrayLike]

#: Cells along the longer side of the region in which a function is tabulated for the first centres.
TABLE_CELLS = 1024
#: The first centres are looked for among at most 2**10 times as many points, or 2**27 in all.
TRIES_LOG2, MAX_TRIES_LOG2 = 10, 27
#: Points of a triangle in the shares of its corners: exact for weights that are squares of x and y.
TRIANGLE_POINTS = np.array([(4.0, 1.0, 1.0), (1.0, 4.0, 1.0), (1.0, 1.0, 4.0)]) / 6.0


def voronoi(
    *,
    n_sites: int,
    density: Density | None = None,
    density_grid: Grid | None = None,
    size_um: tuple[float, float] | None = None,
    region: Any = None,
    n_iterations: int = 20,
    seed: int = 0,
) -> Layout:
    """
    Voronoi cells of seeded centres, as many per area as a density asks.

    ::

        ┌──────┬───────┬──────┐  ─┬─
        │      ╱╲__╱╲__╱╲     │   │
        ├─────┤ │·│·│·│· ├────┤   │           · centre: the centre of mass of its cell
        │  ·   ╲╱·╲╱·╲╱·╱  ·  │   │ size_um[1]
        ├───────┬┴──┴┬──┴─────┤   │           sites per area in proportion to density
        │   ·   │ ·  │   ·    │   │
        └───────┴────┴────────┘  ─┴─
        ├─────────────────────┤
               size_um[0]

    Parameters
    ----------
    n_sites : int
        Number of sites.
    density : (n_y, n_x) array or callable, optional
        Sites per area, on any scale, at least 0 and somewhere above: a picture on ``density_grid``, or a function of
        points (n, 2) in µm that gives (n,) values. The same everywhere by default.
    density_grid : Grid, optional
        Where the picture's cells are; it must cover the region.
    size_um : (width, height), µm, optional
        Rectangle around the optical axis that the sites tile.
    region : shapely Polygon or (n, 2) vertices, µm, optional
        Any other outline, convex or not. Without it and ``size_um`` the sites tile ``density_grid``.
    n_iterations : int
        Lloyd's steps: each moves all centres to the centres of mass of their cells.
    seed : int
        Of the first centres; the same seed gives the same layout.

    Returns
    -------
    Layout
        In no order that means anything, with the column ``share`` (the site's part of the whole density, in mean sites:
        1 where sites follow the density).

    Raises
    ------
    ParameterError
        When a number is out of range, a density negative or nowhere above 0, or the region is not told once.
    GeometryError
        When a cell would be no simple outline within the region, or centres too close together for float64.

    Notes
    -----
    First centres: a scrambled Sobol sequence through the density's inverse distribution, points outside the region left
    out; evenly spread without a pattern. Centres of mass are weighted with the square of the density, because cells at
    rest are as dense as the square root of their weight (Gersho 1979).

    Examples
    --------
    >>> layout = voronoi(n_sites=200, size_um=(60.0, 40.0), density=lambda xy_um: 1.0 / (1.0 + (xy_um**2).sum(axis=1)))
    >>> layout.n_sites, round(float(layout.area_um2.sum()), 6)
    (200, 2400.0)
    """
    n_sites = check_sites(check_count("n_sites", n_sites))
    n_iterations = check_count("n_iterations", n_iterations, at_least=0, at_most=10_000)
    outline = _region(size_um, region, density_grid)
    density_at, table, grid = _density(density, density_grid, outline)
    centres_um = _first_centres(n_sites, table, grid, outline, seed)
    xy_um, offsets = cells_of(centres_um, outline)
    for _ in range(n_iterations):
        centres_um = _moved(centres_um, xy_um, offsets, density_at, outline)
        xy_um, offsets = cells_of(centres_um, outline)
    mass, _ = _masses(centres_um, xy_um, offsets, density_at, power=1)
    return Layout(
        xy_um,
        offsets,
        np.arange(offsets.size),
        {"share": mass * (n_sites / mass.sum())},
        {
            "generator": "voronoi",
            "parameters": {
                "n_sites": n_sites,
                "density": _described(density),
                "size_um": None if size_um is None else [float(x) for x in size_um],
                "density_grid": None if density_grid is None else asdict(density_grid),
                "region": None if region is None else _rings_um(outline),
                "n_iterations": n_iterations,
                "seed": int(seed),
            },
        },
    )


def _described(density: Density | None) -> str | None:
    if density is None:
        return None
    return getattr(density, "__name__", "function") if callable(density) else f"picture of {np.shape(density)} cells"


def _rings_um(outline: shapely.Polygon) -> list[Any]:
    """Vertices of the outline, and a list of such lists when it has holes."""
    rings = [shapely.get_coordinates(ring)[:-1].tolist() for ring in (outline.exterior, *outline.interiors)]
    return rings[0] if len(rings) == 1 else rings


def _region(size_um: tuple[float, float] | None, region: Any, density_grid: Grid | None) -> shapely.Polygon:
    if size_um is not None and region is not None:
        raise ParameterError("region", "and 'size_um' exclude each other; give one of them")
    if size_um is not None:
        if as_numbers("size_um", size_um).shape != (2,):
            raise ParameterError("size_um", "must be two numbers (width, height)", size_um, "µm")
        width_um, height_um = (check_length_um(f"size_um[{i}]", x) for i, x in enumerate(size_um))
        return shapely.box(-0.5 * width_um, -0.5 * height_um, 0.5 * width_um, 0.5 * height_um)
    if region is None:
        if density_grid is None:
            raise ParameterError("size_um", "or 'region' or 'density_grid' must tell what the sites tile")
        return shapely.box(*density_grid.bounds_um)
    outline = region
    if not isinstance(region, shapely.Geometry):
        vertices = finite_array("region", region, ndim=2)
        if vertices.shape[1] != 2 or vertices.shape[0] < 3:
            raise ParameterError("region", f"must have the shape (n, 2) with n >= 3, got {vertices.shape}")
        outline = shapely.Polygon(vertices)
    if not isinstance(outline, shapely.Polygon) or outline.is_empty or not outline.is_valid or not outline.area > 0.0:
        raise ParameterError("region", "must be one polygon that does not cross itself and has an area")
    if np.abs(outline.bounds).max() > MAX_LENGTH_UM:
        raise ParameterError("region", f"must lie within {MAX_LENGTH_UM:g} µm of the origin", cure="it is in µm")
    return outline


def _density(
    density: Density | None, density_grid: Grid | None, outline: shapely.Polygon
) -> tuple[Callable[[Any], Any] | None, Floats, Grid]:
    """The density at points (None when even), and as a table on a grid over the region."""
    if density is not None and not callable(density):
        if not isinstance(density_grid, Grid):
            raise ParameterError("density_grid", "must be the Grid of the density's picture", density_grid)
        picture = finite_array("density", density, ndim=2, at_least=0.0)
        if picture.shape != density_grid.shape:
            raise ParameterError("density", f"must have the grid's shape {density_grid.shape}, got {picture.shape}")
        return (
            _PictureDensity(picture, density_grid),
            _positive(_covering(picture, density_grid, outline)),
            density_grid,
        )
    x0, y0, x1, y1 = outline.bounds
    pitch_um = max(x1 - x0, y1 - y0) / TABLE_CELLS
    shape = (max(1, math.ceil((y1 - y0) / pitch_um)), max(1, math.ceil((x1 - x0) / pitch_um)))
    grid = Grid(shape=shape, pitch_um=max(pitch_um, 1e-4), origin_um=(x0, y0))
    if density is None:
        return None, np.ones(shape), grid
    at_points = _checked(density)
    x_um, y_um = np.meshgrid(grid.x_um, grid.y_um)
    return at_points, _positive(at_points(np.stack((x_um.ravel(), y_um.ravel()), axis=1)).reshape(shape)), grid


def _positive(values: Floats) -> Floats:
    if not values.any():
        raise ParameterError("density", "must be above 0 somewhere in the region")
    return values


def _covering(values: Floats, grid: Grid, outline: shapely.Polygon) -> Floats:
    """The picture, 0 in cells off the region, when its grid covers the region up to rounding."""
    x0, y0, x1, y1 = grid.bounds_um
    low_x, low_y, high_x, high_y = outline.bounds
    rounding_um = 1e-9 * max(x1 - x0, y1 - y0)
    if min(low_x - x0, low_y - y0, x1 - high_x, y1 - high_y) < -rounding_um:
        raise ParameterError("density_grid", "must cover the whole region", grid.bounds_um, "µm")
    half_um = 0.5 * grid.pitch_um
    is_near_x = (grid.x_um + half_um > low_x) & (grid.x_um - half_um < high_x)
    is_near_y = (grid.y_um + half_um > low_y) & (grid.y_um - half_um < high_y)
    return np.where(is_near_y[:, np.newaxis] & is_near_x, values, 0.0)


class _PictureDensity:
    """A picture as a function of points: the value of the cell they lie in, or of the nearest."""

    def __init__(self, values: Floats, grid: Grid) -> None:
        self.values, self.grid = values, grid

    def __call__(self, xy_um: Any) -> Any:
        index = np.floor((xy_um - np.array(self.grid.origin_um)) / self.grid.pitch_um).astype(np.int64)
        n_y, n_x = self.grid.shape
        return self.values[np.clip(index[:, 1], 0, n_y - 1), np.clip(index[:, 0], 0, n_x - 1)]


def _checked(density: Callable[[Any], ArrayLike]) -> Callable[[Any], Any]:
    """The function, its values checked each time."""

    def at_points(xy_um: Any) -> Any:
        values = as_numbers("density", density(xy_um))
        if values.shape != xy_um.shape[:1]:
            raise ParameterError(
                "density", f"must give one value for each of {xy_um.shape[0]} points, got the shape {values.shape}"
            )
        return finite_array("density", values, at_least=0.0)

    return at_points


def _first_centres(n_sites: int, weight: Floats, grid: Grid, outline: shapely.Polygon, seed: int) -> Floats:
    """Points (n_sites, 2) µm in the region, in proportion to the weight of the grid's cells and evenly spread."""
    from scipy.stats import qmc

    # One run through all cells, column by column: a point's first number finds the column, its second the row.
    n_y, n_x = weight.shape
    total = np.concatenate(([0.0], np.cumsum(weight.ravel(order="F"))))
    columns = total[::n_y]
    shapely.prepare(outline)
    engine = qmc.Sobol(2, scramble=True, seed=Streams(seed).of("layout voronoi centres"))
    first = max(4, math.ceil(math.log2(n_sites)))
    for m in range(first, min(first + TRIES_LOG2, MAX_TRIES_LOG2) + 1):
        u, v = np.moveaxis(engine.reset().random_base2(m), -1, 0)
        target = u * total[-1]
        column = np.clip(np.searchsorted(columns, target, side="right") - 1, 0, n_x - 1)
        column_mass = columns[column + 1] - columns[column]
        x = column + (target - columns[column]) / np.where(column_mass > 0.0, column_mass, 1.0)
        target = columns[column] + v * column_mass
        cell = np.clip(np.searchsorted(total, target, side="right") - 1, column * n_y, column * n_y + n_y - 1)
        cell_mass = total[cell + 1] - total[cell]
        y = cell - column * n_y + (target - total[cell]) / np.where(cell_mass > 0.0, cell_mass, 1.0)
        points_um = np.stack((x, y), axis=1) * grid.pitch_um + np.array(grid.origin_um)
        points_um = points_um[shapely.contains_xy(outline, points_um)]
        if points_um.shape[0] >= n_sites:
            return np.asarray(points_um[:n_sites])
    raise ParameterError("density", "must be above 0 in more of the region: too few points of it lie inside")


def _masses(
    centres_um: Floats, xy_um: Floats, offsets: Ints, density_at: Callable[[Any], Any] | None, power: int
) -> tuple[Floats, Floats]:
    """Integrals over each cell of the density to a power, (n,), and of that times x and y, (n, 2)."""
    if density_at is None:
        return ring_moments(xy_um, offsets)
    centre = np.repeat(centres_um, np.diff(offsets), axis=0)
    triangle = np.stack((centre, xy_um, xy_um[next_vertex(offsets)]), axis=1)
    a, b = triangle[:, 1] - centre, triangle[:, 2] - centre
    area_um2 = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    points = np.einsum("pc,ncd->npd", TRIANGLE_POINTS, triangle)
    weight = density_at(points.reshape(-1, 2)).reshape(-1, 3) ** power * (area_um2 / 3.0)[:, np.newaxis]
    mass = np.add.reduceat(weight.sum(axis=1), offsets[:-1])
    return mass, np.add.reduceat(np.einsum("np,npd->nd", weight, points), offsets[:-1], axis=0)


def _moved(
    centres_um: Floats,
    xy_um: Floats,
    offsets: Ints,
    density_at: Callable[[Any], Any] | None,
    outline: shapely.Polygon,
) -> Floats:
    """Centres of mass of the cells; a centre stays where its cell has no density, or its centre of mass lies outside."""
    mass, moment = _masses(centres_um, xy_um, offsets, density_at, power=2)
    has_mass = mass > 0.0
    moved_um = np.where(has_mass[:, np.newaxis], moment / np.where(has_mass, mass, 1.0)[:, np.newaxis], centres_um)
    is_inside = shapely.contains_xy(outline, moved_um)
    return np.where(is_inside[:, np.newaxis], moved_um, centres_um)
