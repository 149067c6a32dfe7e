"""Density-driven layout: Voronoi cells of a given density, relaxed by Lloyd's algorithm."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeAlias

import numpy as np
import shapely
from numpy.typing import ArrayLike

from foveasim._core.calls import Limits
from foveasim._core.random_streams import Streams
from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Floats, Ints, as_numbers, finite_array
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid
from foveasim.layout._regions import parse_region
from foveasim.layout.diagrams.voronoi import CellEdges, IncrementalCells, ring_edges
from foveasim.layout.generator_registry import SITES, layout_generator
from foveasim.layout.model import Layout, layout_of

if TYPE_CHECKING:
    from scipy.sparse import csc_array

__all__ = ["voronoi"]

#: A picture (n_y, n_x), or a function of points (n, 2) µm that returns (n,) numbers.
Density: TypeAlias = ArrayLike | Callable[[Any], ArrayLike]

#: Cells along the longer side of the region, for the table of a function that initial centres are drawn from.
TABLE_CELLS = 1024
#: Initial centres are selected from at most 2**10 candidates per centre, and 2**27 in total.
TRIES_LOG2, MAX_TRIES_LOG2 = 10, 27
#: Quadrature points of a triangle as fractions of its second and third corner, their weights, and those of a coarser rule. The
#: 3-point rule is exact up to degree 2, the 7-point rule up to degree 5, and its coarser rule up to degree 2 (Radon 1948).
THREE_POINTS = ((1 / 6, 1 / 6, 1 / 3, 1 / 3), (4 / 6, 1 / 6, 1 / 3, 1 / 3), (1 / 6, 4 / 6, 1 / 3, 1 / 3))
SEVEN_POINTS = (
    (0.333333333333333333, 0.333333333333333333, 0.225, 0.484071797961957087),
    (0.101286507323456339, 0.101286507323456339, 0.125939180544827153, 0.171976067346014304),
    (0.797426985353087322, 0.101286507323456339, 0.125939180544827153, 0.171976067346014304),
    (0.101286507323456339, 0.797426985353087322, 0.125939180544827153, 0.171976067346014304),
    (0.470142064105115090, 0.470142064105115090, 0.132394152788506181, 0.0),
    (0.059715871789769820, 0.470142064105115090, 0.132394152788506181, 0.0),
    (0.470142064105115090, 0.059715871789769820, 0.132394152788506181, 0.0),
)
#: Tolerance of the integral over a triangle, relative to that of the mean cell, and the limit of recursive quartering.
TRIANGLE_ERROR, MAX_QUARTERINGS = 1e-8, 9
#: Gauss points of a line as fractions of its length, of equal weight: exact up to degree 3.
LINE_POINTS = (0.211324865405187118, 0.788675134594812882)
#: Small numbers of triangles and lines, which are large ones, are subdivided up to these numbers at negligible cost.
MIN_TRIANGLES, MIN_LINE_POINTS = 2048, 1024
#: Fraction of the mean mass below which a cell counts as empty.
EMPTY_FRACTION = 1e-9
#: Largest relative deviation of equal capacities from their mean; Newton iteration ends at a tenth of it.
CAPACITY_ERROR = 1e-6
#: Lloyd iterations with cells of equal capacity, and additional ones if no such cells are found.
EQUAL_STEPS, MORE_STEPS = 2, 20
#: Maximum number of Newton steps, and the smallest damping factor.
MAX_NEWTON_STEPS, MIN_DAMPING = 30, 0.01
#: If Newton iteration fails, a uniform density is added: the mean density, reduced by this factor in each of several steps.
REGULARISATION_FACTOR, N_REGULARISATIONS = 0.25, 16


@layout_generator(
    has_mosaic=False, example={"n_sites": 200, "size_um": (32.0, 32.0), "n_iterations": 20}, picture="density"
)
def voronoi(
    n_sites: Annotated[int, SITES],
    *,
    density: Density | None = None,
    density_grid: Grid | None = None,
    size_um: tuple[float, float] | None = None,
    region: Any = None,
    n_iterations: Annotated[int, Limits(at_least=0, at_most=10_000)] = 20,
    capacity: Literal["free", "equal"] = "free",
    seed: int = 0,
) -> Layout:
    """
    Generate Voronoi cells whose number per area follows a density.

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
        Relative number of sites per area, >= 0 and not 0 everywhere: a picture on ``density_grid``, or a function of points
        (n, 2) in µm that returns (n,) values. Uniform by default.
    density_grid : Grid, optional
        Grid of the picture; it must cover the region.
    size_um : (width, height), µm, optional
        Rectangular region around the optical axis.
    region : shapely Polygon or (n, 2) vertices, µm, optional
        Arbitrary region, convex or concave. Without ``region`` and ``size_um`` the sites tile ``density_grid``.
    n_iterations : int
        Number of Lloyd iterations, each of which moves all centres to the centres of mass of their cells.
    capacity : "free" or "equal"
        Constraint on the capacity, the integral of the density over a site: unconstrained and approximately equal, or equal
        to within 1e-6. Sites of equal capacity are the cells of a power diagram.
    seed : int
        Seed of the initial centres; equal seeds give equal layouts.

    Returns
    -------
    Layout
        In arbitrary order, with the column ``share`` (capacity of a site relative to the mean capacity: 1 where sites follow
        the density; exact for a picture, accurate to about 1e-7 for a function that is smooth within sites).

    Raises
    ------
    ParameterError
        When a number is out of range, a density is negative or 0 everywhere, or not exactly one region is specified.
    GeometryError
        When a cell within the region is not a single polygon without holes, centres are too close together for float64, or
        no cells of equal capacity are found.

    Notes
    -----
    Initial centres are a scrambled Sobol sequence, uniform without a regular pattern, mapped by the inverse distribution of
    the density; points outside the region are omitted. Centres of mass are weighted with the square of the density, because
    the density of converged cells is proportional to the square root of the weight (Gersho 1979).

    Equal capacity: a point x belongs to the centre c of the least power ``|x - c|² - w`` (Aurenhammer, Hoffmann and Aronov
    1998), and a damped Newton iteration determines the weights w (Kitagawa, Mérigot and Thibert 2019). The last 2 Lloyd
    iterations use the centres of mass of these cells, weighted with the density itself (de Goes, Breeden, Ostromoukhov and
    Desbrun 2012). The integrals of a function that is discontinuous within sites are not accurate to 1e-6: use a picture,
    whose integrals are exact.

    Examples
    --------
    >>> layout = voronoi(
    ...     n_sites=200,
    ...     size_um=(60.0, 40.0),
    ...     density=lambda xy_um: 1.0 / (1.0 + (xy_um**2).sum(axis=1)),
    ... )
    >>> layout.n_sites, round(float(layout.area_um2.sum()), 6)
    (200, 2400.0)
    """
    outline = _region(size_um, region, density_grid)
    is_equal = capacity == "equal"
    field, table, grid = _density(density, density_grid, outline)
    centres_um = _first_centres(n_sites, table, grid, outline, seed)
    cells = IncrementalCells(outline, (lambda edges, n: _moments(edges, n, field)[0]) if is_equal else None)
    n_equal = min(EQUAL_STEPS, n_iterations) if is_equal else 0
    squared = field.squared()
    for _ in range(n_iterations - n_equal):
        mass, moment = squared.moments(_edges(cells, centres_um), centres_um, is_rough=True)
        centres_um = _move_to_centroids(centres_um, mass, moment, outline)
    if is_equal:
        _equalise_capacities(cells, centres_um, field, n_equal)
    else:
        _edges(cells, centres_um)
    xy_um, offsets = cells.rings()
    mass, _ = _moments(ring_edges(xy_um, offsets), n_sites, field)
    relative_mass = mass * (n_sites / mass.sum())
    if is_equal:
        _require_equal(float(np.abs(relative_mass - 1.0).max()))
    parameters = {
        "density": _describe_density(density),
        "density_grid": None if density_grid is None else asdict(density_grid),
        "region": None if region is None else _rings_um(outline),
    }
    return layout_of(xy_um, offsets, None, {"share": relative_mass}, {"parameters": parameters})


def _describe_density(density: Density | None) -> str | None:
    if density is None:
        return None
    return getattr(density, "__name__", "function") if callable(density) else f"picture of {np.shape(density)} cells"


def _rings_um(outline: shapely.Polygon) -> list[Any]:
    """Return the vertices of the outline, or a list of vertex lists if it has holes."""
    rings = [shapely.get_coordinates(ring)[:-1].tolist() for ring in (outline.exterior, *outline.interiors)]
    return rings[0] if len(rings) == 1 else rings


def _region(size_um: tuple[float, float] | None, region: Any, density_grid: Grid | None) -> shapely.Polygon:
    if size_um is not None and region is not None:
        raise ParameterError("region", "and 'size_um' exclude each other; give one of them")
    if size_um is None and region is None:
        if density_grid is None:
            raise ParameterError("size_um", "or 'region' or 'density_grid' must be given, to define the region")
        return shapely.box(*density_grid.bounds_um)
    outline = parse_region(size_um=size_um, region=region)
    if not isinstance(outline, shapely.Polygon):
        raise ParameterError("region", "must be one polygon, got several")
    return outline


def _density(
    density: Density | None, density_grid: Grid | None, outline: shapely.Polygon
) -> tuple[_Field, Floats, Grid]:
    """Return the density, a table of it over the region, and the grid of the table."""
    if density is not None and not callable(density):
        if not isinstance(density_grid, Grid):
            raise ParameterError("density_grid", "must be the Grid of the density picture", density_grid)
        picture = finite_array("density", density, ndim=2, at_least=0.0)
        if picture.shape != density_grid.shape:
            raise ParameterError("density", f"must have the grid's shape {density_grid.shape}, got {picture.shape}")
        table = _positive(_crop_to_region(picture, density_grid, outline))
        return _PictureField(picture, density_grid), table, density_grid
    x0, y0, x1, y1 = outline.bounds
    pitch_um = max(x1 - x0, y1 - y0) / TABLE_CELLS
    shape = (max(1, math.ceil((y1 - y0) / pitch_um)), max(1, math.ceil((x1 - x0) / pitch_um)))
    grid = Grid(shape=shape, pitch_um=max(pitch_um, 1e-4), origin_um=(x0, y0))
    if density is None:
        return _UniformField(), np.ones(shape), grid
    field = _FunctionField(_with_value_check(density))
    x_um, y_um = np.meshgrid(grid.x_um, grid.y_um)
    return field, _positive(field.at(np.stack((x_um.ravel(), y_um.ravel()), axis=1)).reshape(shape)), grid


def _positive(values: Floats) -> Floats:
    if not values.any():
        raise ParameterError("density", "must be above 0 somewhere in the region")
    return values


def _crop_to_region(values: Floats, grid: Grid, outline: shapely.Polygon) -> Floats:
    """Set the picture to 0 outside the region; check that its grid covers the region."""
    x0, y0, x1, y1 = grid.bounds_um
    low_x, low_y, high_x, high_y = outline.bounds
    rounding_um = 1e-9 * max(x1 - x0, y1 - y0)
    if min(low_x - x0, low_y - y0, x1 - high_x, y1 - high_y) < -rounding_um:
        raise ParameterError("density_grid", "must cover the complete region", grid.bounds_um, "µm")
    half_x_um, half_y_um = 0.5 * grid.pitch_x_um, 0.5 * grid.pitch_y_um
    is_near_x = (grid.x_um + half_x_um > low_x) & (grid.x_um - half_x_um < high_x)
    is_near_y = (grid.y_um + half_y_um > low_y) & (grid.y_um - half_y_um < high_y)
    return np.where(is_near_y[:, np.newaxis] & is_near_x, values, 0.0)


def _with_value_check(density: Callable[[Any], ArrayLike]) -> Callable[[Any], Any]:
    """Wrap the function with a check of its values."""

    def at_points(xy_um: Any) -> Any:
        values = as_numbers("density", density(xy_um))
        if values.shape != xy_um.shape[:1]:
            raise ParameterError(
                "density", f"must return one value for each of {xy_um.shape[0]} points, got the shape {values.shape}"
            )
        return finite_array("density", values, at_least=0.0)

    return at_points


def _first_centres(n_sites: int, weight: Floats, grid: Grid, outline: shapely.Polygon, seed: int) -> Floats:
    """Return quasi-random points (n_sites, 2) µm in the region, with the weights as density."""
    from scipy.stats import qmc

    # Inverse cumulative distribution, column by column: the first coordinate selects the column, the second the row.
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
        points_um = np.stack((x, y), axis=1) * grid.pitch_xy_um + np.array(grid.origin_um)
        points_um = points_um[shapely.contains_xy(outline, points_um)]
        if points_um.shape[0] >= n_sites:
            return np.asarray(points_um[:n_sites])
    raise ParameterError("density", "must be > 0 in a larger part of the region, which contains too few points")


# -- Lloyd iteration ---------------------------------------------------------------------------------------------------


def _edges(cells: IncrementalCells, centres_um: Floats, weights_um2: Floats | None = None) -> CellEdges:
    edges = cells.update(centres_um, weights_um2)
    if edges is None:
        raise GeometryError("the centres are too close together for float64; take fewer sites")
    return edges


def _move_to_centroids(centres_um: Floats, mass: Any, moment: Any, outline: shapely.Polygon) -> Floats:
    """Move centres to the centres of mass, except of empty cells and to points outside."""
    has_mass = mass > EMPTY_FRACTION * mass.mean()
    moved_um = np.where(has_mass[:, np.newaxis], moment / np.where(has_mass, mass, 1.0)[:, np.newaxis], centres_um)
    is_inside = shapely.contains_xy(outline, moved_um)
    return np.where(is_inside[:, np.newaxis], moved_um, centres_um)


def _moments(edges: CellEdges, n_cells: int, field: _Integrals) -> tuple[Any, Any]:
    """Return the mass (n,) and first moments (n, 2) of each cell, from its triangles."""
    corners_um = np.zeros((n_cells, 2))
    corners_um[edges.cell] = edges.start_um
    area_um2, moment_um3 = _UniformField().moments(edges, corners_um)
    return field.moments(edges, moment_um3 / area_um2[:, np.newaxis])


# -- equal capacity --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Capacities:
    """Cells for given weights (n,), with their masses (n,) and first moments (n, 2)."""

    weights_um2: Floats
    edges: CellEdges
    mass: Any
    moment: Any

    @property
    def relative_mass(self) -> Any:
        """Masses (n,) relative to their mean."""
        return self.mass * (self.mass.size / self.mass.sum())

    @property
    def worst(self) -> float:
        """Largest deviation of the relative masses from 1."""
        return float(np.abs(self.relative_mass - 1.0).max())


def _equalise_capacities(cells: IncrementalCells, centres_um: Floats, field: _Integrals, n_moves: int) -> None:
    """
    Update cells to equal capacity, after moves of the centres to their centres of mass.

    Weights for equal capacities always exist if cells retain the parts that a notch of the region separates. If these parts
    are assigned to neighbours, capacities are discontinuous in the weights, and a solution may require further moves of the
    centres.
    """
    worst = np.inf
    for move in range(n_moves + MORE_STEPS + 1):
        own = _with_own_parts(cells, centres_um, field)
        found = initial = _capacities(own.edges, own.weights_um2, field, is_own=False)
        if initial.worst > CAPACITY_ERROR:
            found = _newton(cells, centres_um, field, initial, is_own=False)
        worst = min(worst, found.worst)
        if found.worst > CAPACITY_ERROR:
            found = initial
        elif move >= n_moves:
            cells.update(centres_um, found.weights_um2)
            return
        centres_um = _move_to_centroids(centres_um, found.mass, found.moment, cells.region)
    _require_equal(worst)


def _require_equal(worst: Any) -> None:
    if not worst <= CAPACITY_ERROR:
        raise GeometryError(
            f"found no cells of equal capacity: the smallest relative deviation from the mean is {worst:.1g}; take "
            "capacity='free', more sites, or a picture instead of a discontinuous function"
        )


def _with_own_parts(cells: IncrementalCells, centres_um: Floats, field: _Integrals) -> _Capacities:
    """Return cells of equal capacity that retain the parts separated by the region."""
    weights_um2 = np.zeros(centres_um.shape[0])
    start = _capacities(_edges(cells, centres_um, weights_um2), weights_um2, field, is_own=True)
    found = _newton(cells, centres_um, field, start, is_own=True)
    if found.worst <= CAPACITY_ERROR:
        return found
    # Masses have no gradient where the density is almost 0: start with a uniform density.
    mean = start.mass.sum() / cells.region.area
    for uniform in (*(mean * REGULARISATION_FACTOR**i for i in range(N_REGULARISATIONS)), 0.0):
        regularised = _RegularisedField(field, uniform)
        start = _capacities(_edges(cells, centres_um, weights_um2), weights_um2, regularised, is_own=True)
        found = _newton(cells, centres_um, regularised, start, is_own=True)
        _require_equal(found.worst)
        weights_um2 = found.weights_um2
    return found


def _capacities(edges: CellEdges, weights_um2: Floats, field: _Integrals, *, is_own: bool) -> _Capacities:
    """Return the masses of cells, with their own separated parts or with assigned ones."""
    owned = replace(edges, cell=edges.owner) if is_own else edges
    return _Capacities(weights_um2, edges, *_moments(owned, weights_um2.size, field))


def _newton(
    cells: IncrementalCells, centres_um: Floats, field: _Integrals, found: _Capacities, *, is_own: bool
) -> _Capacities:
    """Return the cells after a damped Newton iteration, converged or not."""
    for _ in range(MAX_NEWTON_STEPS):
        if found.worst <= 0.1 * CAPACITY_ERROR:
            break
        step_um2 = _newton_step_um2(centres_um, field, found, is_own=is_own)
        better = None if step_um2 is None else _damped_step(cells, centres_um, field, found, step_um2, is_own=is_own)
        if better is None:
            break
        found = better
    return found


def _damped_step(
    cells: IncrementalCells,
    centres_um: Floats,
    field: _Integrals,
    found: _Capacities,
    step_um2: Floats,
    *,
    is_own: bool,
) -> _Capacities | None:
    """Return the cells after the largest damped step that improves the masses, or None."""
    min_mass, before = 0.5 * min(found.relative_mass.min(), 1.0), np.linalg.norm(found.relative_mass - 1.0)
    damping = 1.0
    while damping >= MIN_DAMPING:
        weights_um2 = found.weights_um2 + damping * step_um2
        edges = cells.update(centres_um, weights_um2)
        if edges is not None:
            new = _capacities(edges, weights_um2, field, is_own=is_own)
            if (
                new.relative_mass.min() >= min_mass
                and np.linalg.norm(new.relative_mass - 1.0) <= (1.0 - 0.5 * damping) * before
            ):
                return new
        damping *= 0.5
    return None


def _newton_step_um2(centres_um: Floats, field: _Integrals, found: _Capacities, *, is_own: bool) -> Floats | None:
    """
    Return the Newton step of the weights (n,) towards equal masses; None if singular.

    Only differences of weights matter, so the last weight is fixed.
    """
    from scipy.sparse.linalg import splu

    if found.mass.size == 1:
        return np.zeros(1)
    slopes = _slopes(centres_um, field, found.edges, is_own=is_own)
    try:
        step_um2 = splu(slopes[:-1, :-1]).solve((found.mass.mean() - found.mass)[:-1])
    except RuntimeError:  # singular: some cells have no edge in areas of positive density
        return None
    return np.append(step_um2, 0.0) if np.isfinite(step_um2).all() else None


def _slopes(centres_um: Floats, field: _Integrals, edges: CellEdges, *, is_own: bool) -> csc_array[Any]:
    """
    Return the derivatives (n, n) of the masses with respect to the weights.

    An increase of a weight by dw displaces the edge between two centres at the distance d by ``dw / 2d``, which transfers
    the mass of the swept area from the cell on one side to the cell on the other.
    """
    from scipy.sparse import coo_array

    one, other = edges.twins()
    p, q = edges.owner[one], edges.owner[other]
    to, of = (p, q) if is_own else (edges.cell[one], edges.cell[other])
    distance_um = np.hypot(*(centres_um[p] - centres_um[q]).T)
    swept = field.line_integrals(edges.start_um[one], edges.stop_um[one]) / (2.0 * distance_um)
    rows, columns = np.concatenate((to, to, of, of)), np.concatenate((p, q, p, q))
    n = centres_um.shape[0]
    return coo_array((np.concatenate((swept, -swept, -swept, swept)), (rows, columns)), shape=(n, n)).tocsc()


# -- integrals of the density -----------------------------------------------------------------------------------------


class _Integrals(Protocol):
    """Integrals of a density."""

    def moments(self, edges: CellEdges, anchors_um: Floats, *, is_rough: bool = False) -> tuple[Any, Any]:
        """
        Return the mass (n,) and first moments (n, 2) of each cell.

        Cells are divided into signed triangles of their edges and arbitrary anchor points (n, 2). ``is_rough`` allows an
        error that is negligible for centres of mass.
        """

    def line_integrals(self, start_um: Floats, stop_um: Floats) -> Any:
        """Return the line integrals (n,) of the density."""


class _Field(_Integrals, Protocol):
    """A density over the region."""

    def squared(self) -> _Field:
        """Return the square of the density."""


class _UniformField:
    """Uniform density of 1, integrated exactly."""

    def squared(self) -> _Field:
        return self

    def moments(self, edges: CellEdges, anchors_um: Floats, *, is_rough: bool = False) -> tuple[Any, Any]:
        del is_rough
        n, anchor = anchors_um.shape[0], anchors_um.take(edges.cell, 0)
        a, b = edges.start_um - anchor, edges.stop_um - anchor
        area_um2 = _area_um2(a, b)
        mass = np.bincount(edges.cell, area_um2, minlength=n)
        third = [np.bincount(edges.cell, (a[:, i] + b[:, i]) * (area_um2 / 3.0), minlength=n) for i in (0, 1)]
        return mass, np.stack(third, axis=1) + mass[:, np.newaxis] * anchors_um

    def line_integrals(self, start_um: Floats, stop_um: Floats) -> Any:
        return np.hypot(*(stop_um - start_um).T)


class _FunctionField:
    """Density as a function of points, integrated by adaptive quartering of triangles."""

    def __init__(self, at: Callable[[Any], Any]) -> None:
        self.at = at

    def squared(self) -> _Field:
        return _FunctionField(lambda xy_um: self.at(xy_um) ** 2)

    def moments(self, edges: CellEdges, anchors_um: Floats, *, is_rough: bool = False) -> tuple[Any, Any]:
        n, cell, origin = anchors_um.shape[0], edges.cell, anchors_um.take(edges.cell, 0)
        # Corners relative to the anchor of their cell, which is the first corner.
        corners: Any = np.zeros_like(origin), edges.start_um - origin, edges.stop_um - origin
        total, limit = np.zeros((3, n)), 0.0
        for depth in range(MAX_QUARTERINGS + 1):
            sums, coarse = self._sums(origin, corners, THREE_POINTS if is_rough else SEVEN_POINTS)
            limit = limit or TRIANGLE_ERROR * abs(float(sums[0].sum())) / n
            # The relative error of a rule of twice the order is about the square of that of the coarse rule.
            is_inaccurate = (sums[0] - coarse) ** 2 > limit * np.abs(sums[0])
            is_inaccurate |= cell.size < MIN_TRIANGLES
            is_inaccurate &= depth < MAX_QUARTERINGS and not is_rough
            total += [np.bincount(cell[~is_inaccurate], x[~is_inaccurate], minlength=n) for x in sums]
            if not is_inaccurate.any():
                break
            a, b, c = (x[is_inaccurate] for x in corners)
            ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
            corners = [np.concatenate(x) for x in ((a, ab, ca, ab), (ab, b, bc, bc), (ca, bc, c, ca))]
            cell, origin = np.tile(cell[is_inaccurate], 4), np.tile(origin[is_inaccurate], (4, 1))
        return total[0], total[1:].T + total[0][:, np.newaxis] * anchors_um

    def _sums(self, origin: Any, corners: Any, rule: Any) -> tuple[Any, Any]:
        """Return mass and first moments (3, n) of triangles, and coarse masses (n,)."""
        a, ab, ac = corners[0], corners[1] - corners[0], corners[2] - corners[0]
        area_um2 = _area_um2(ab, ac)
        sums, coarse = np.zeros((3, area_um2.size)), np.zeros(area_um2.size)
        for of_ab, of_ac, weight, coarse_weight in rule:
            offset = a + of_ab * ab + of_ac * ac
            mass = self.at(origin + offset) * area_um2
            coarse += coarse_weight * mass
            mass *= weight
            for i, x in enumerate((mass, mass * offset[:, 0], mass * offset[:, 1])):
                sums[i] += x
        return sums, coarse

    def line_integrals(self, start_um: Floats, stop_um: Floats) -> Any:
        n_parts = 1 + MIN_LINE_POINTS // max(1, start_um.shape[0])
        fraction = ((np.arange(n_parts)[:, np.newaxis] + LINE_POINTS) / n_parts).reshape(-1, 1, 1)
        points_um = start_um + fraction * (stop_um - start_um)
        values = self.at(points_um.reshape(-1, 2)).reshape(fraction.size, -1)
        return values.mean(axis=0) * np.hypot(*(stop_um - start_um).T)


class _PictureField:
    """
    Density as a picture, constant in each cell, integrated exactly.

    By Green's theorem the integral over a site is the line integral of ``F dy`` along its outline, where F is the integral of
    the picture along its row from the left. F is linear in x on each piece of the outline within a cell of the picture.
    """

    def __init__(self, values: Floats, grid: Grid) -> None:
        self.values, self.grid = values, grid
        times_x = values * (np.arange(values.shape[1]) + 0.5)
        self._left, self._left_x = np.cumsum(values, axis=1) - values, np.cumsum(times_x, axis=1) - times_x

    def squared(self) -> _Field:
        return _PictureField(self.values**2, self.grid)

    def moments(self, edges: CellEdges, anchors_um: Floats, *, is_rough: bool = False) -> tuple[Any, Any]:
        del is_rough
        n, twins = anchors_um.shape[0], edges.n_twins
        once = np.r_[0:twins, 2 * twins : edges.cell.size]
        edge, (x0, y0), (x1, y1), at = self._pieces(edges.start_um[once], edges.stop_um[once])
        value, column, dy = self.values[at], at[1], y1 - y0
        left, x, y = self._left[at] - value * column, 0.5 * (x0 + x1), 0.5 * (y0 + y1)
        # Means of x² and of x y along a piece.
        xx, xy = (x0 * x0 + x0 * x1 + x1 * x1) / 3.0, x * y + (x1 - x0) * dy / 12.0
        lines = (left + value * x, self._left_x[at] + 0.5 * value * (xx - column**2), left * y + value * xy)
        total = np.zeros((3, n))
        for i, line in enumerate(lines):
            of_edge = np.bincount(edge, line * dy, minlength=once.size)
            around = np.concatenate((of_edge[:twins], -of_edge[:twins], of_edge[twins:]))
            total[i] = np.bincount(edges.cell, around, minlength=n)
        cell_um2 = self.grid.cell_area_um2
        mass = total[0] * cell_um2
        return mass, total[1:].T * (cell_um2 * self.grid.pitch_xy_um) + mass[:, np.newaxis] * np.array(
            self.grid.origin_um
        )

    def line_integrals(self, start_um: Floats, stop_um: Floats) -> Any:
        edge, start, stop, at = self._pieces(start_um, stop_um)
        length_um = np.hypot(*((stop - start) * self.grid.pitch_xy_um[:, np.newaxis]))
        return np.bincount(edge, self.values[at] * length_um, minlength=start_um.shape[0])

    def _pieces(self, start_um: Floats, stop_um: Floats) -> tuple[Ints, Any, Any, tuple[Ints, Ints]]:
        """Split lines at cell boundaries: line, ends (2, n) in cells, row and column."""
        start, stop = ((xy_um - np.array(self.grid.origin_um)) / self.grid.pitch_xy_um for xy_um in (start_um, stop_um))
        line, start, stop = _split_at_integers(start, stop, axis=1)
        piece, start, stop = _split_at_integers(start, stop, axis=0)
        centre = np.floor(0.5 * (start + stop)).astype(np.int64)
        column, row = (np.clip(centre[:, i], 0, self.values.shape[1 - i] - 1) for i in (0, 1))
        return line[piece], start.T, stop.T, (row, column)


class _RegularisedField:
    """Sum of a density and a uniform density."""

    def __init__(self, field: _Integrals, uniform: Any) -> None:
        self.field, self.uniform = field, uniform

    def moments(self, edges: CellEdges, anchors_um: Floats, *, is_rough: bool = False) -> tuple[Any, Any]:
        mass, moment = self.field.moments(edges, anchors_um, is_rough=is_rough)
        uniform_mass, uniform_moment = _UniformField().moments(edges, anchors_um)
        return mass + self.uniform * uniform_mass, moment + self.uniform * uniform_moment

    def line_integrals(self, start_um: Floats, stop_um: Floats) -> Any:
        return self.field.line_integrals(start_um, stop_um) + self.uniform * _UniformField().line_integrals(
            start_um, stop_um
        )


def _area_um2(a_um: Floats, b_um: Floats) -> Any:
    """Return the signed areas (n,) of triangles from two side vectors."""
    return 0.5 * (a_um[:, 0] * b_um[:, 1] - a_um[:, 1] * b_um[:, 0])


def _split_at_integers(start: Any, stop: Any, axis: int) -> tuple[Ints, Any, Any]:
    """Split lines (n, 2) at integer values of a coordinate: line index and ends of the pieces."""
    a, b = start[:, axis], stop[:, axis]
    first = np.floor(np.minimum(a, b)) + 1.0
    n_cuts = np.maximum(np.ceil(np.maximum(a, b)) - first, 0.0).astype(np.int64)
    line, position = np.repeat(np.arange(a.size), n_cuts + 1), positions_in_runs(n_cuts + 1)
    is_cut = position < n_cuts[line]
    of, k = line[is_cut], position[is_cut]
    integer = first[of] + np.where(a[of] < b[of], k, n_cuts[of] - 1 - k)
    fraction = (integer - a[of]) / (b[of] - a[of])
    stops = stop[line]
    stops[is_cut, axis] = integer
    stops[is_cut, 1 - axis] = start[of, 1 - axis] + fraction * (stop[of, 1 - axis] - start[of, 1 - axis])
    starts = np.roll(stops, 1, axis=0)
    starts[position == 0] = start
    return line, starts, stops
