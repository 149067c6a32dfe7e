"""Power cells of movable centres with weights, as a PyTorch module."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from foveasim._core.rings import next_vertex
from foveasim._core.validation import Bools, Floats, Ints, finite_array
from foveasim.errors import GeometryError, ParameterError, type_name
from foveasim.fields import Grid
from foveasim.layout import Layout
from foveasim.layout._noding import merge_coincident_points
from foveasim.learn._tensors import as_array, check_tensor, constant, shorten_steps
from foveasim.learn.integral import site_power
from foveasim.learn.outlines import Outlines

__all__ = ["PowerCells"]

#: Number of sides of the region: 1 is left, 2 right, 3 bottom, 4 top; 0 stands for no side.
N_SIDES = 4
#: Largest relative difference between the total area of all cells and the area of the region that is a rounding error.
AREA_ROUNDING = 1e-9


class PowerCells(nn.Module):
    """
    Power diagram of movable centres in a rectangle: convex cells without gaps.

    A point x belongs to the centre c of the least power ``|x - c|² - weight``. For equal weights this is the nearest centre,
    and the cells are Voronoi cells. A larger weight enlarges a cell; only differences of weights matter.

    Parameters
    ----------
    centres_um : (n, 2) tensor or array, µm
        Distinct points inside the region.
    weights_um2 : (n,) tensor or array, optional, µm²
        Zero by default.
    region_um : (x_min, y_min, x_max, y_max), µm
        Rectangle that the cells fill.

    Attributes
    ----------
    centres_um : torch.nn.Parameter (n, 2) float64, µm
    weights_um2 : torch.nn.Parameter (n,) float64, µm²
    region_um : tuple of 4 floats, µm

    Raises
    ------
    GeometryError
        When a centre lies outside the region, or its cell is empty; the message specifies its index.

    Notes
    -----
    The topology is computed from scratch in each call. Each corner is a differentiable function of three centres and their
    weights (Aurenhammer 1987). Where four or more cells meet in one point, as on a regular grid, the corners
    are separate points at equal positions, with edges of length zero between them. First derivatives of integrals over cells
    are then exact, which they would not be with one common point. :meth:`layout` merges these points.

    A step of an optimiser may remove the cell of a centre; the next call then raises. :meth:`limit_step` prevents it.

    Examples
    --------
    >>> cells = PowerCells([[1.0, 1.0], [3.0, 1.0]], region_um=(0.0, 0.0, 4.0, 2.0))
    >>> cells.area_um2().tolist()
    [4.0, 4.0]
    >>> cells.layout().n_sites
    2
    """

    _previous: Tensor

    def __init__(
        self,
        centres_um: Tensor | ArrayLike,
        weights_um2: Tensor | ArrayLike | None = None,
        *,
        region_um: tuple[float, float, float, float],
    ) -> None:
        super().__init__()
        centres = _as_numbers("centres_um", centres_um)
        if centres.ndim != 2 or centres.shape[1] != 2 or not centres.size:
            raise ParameterError("centres_um", f"must have the shape (n, 2), n >= 1, got {centres.shape}")
        weights = np.zeros(centres.shape[0]) if weights_um2 is None else _as_numbers("weights_um2", weights_um2)
        if weights.shape != centres.shape[:1]:
            raise ParameterError("weights_um2", f"must have the shape ({centres.shape[0]},), got {weights.shape}")
        region = finite_array("region_um", region_um, ndim=1)
        if region.size != 4 or not (region[0] < region[2] and region[1] < region[3]):
            raise ParameterError("region_um", "must be (x_min, y_min, x_max, y_max)", region.tolist(), "µm")
        x0, y0, x1, y1 = map(float, region)
        self.region_um: tuple[float, float, float, float] = x0, y0, x1, y1
        self.centres_um = nn.Parameter(constant(centres))
        self.weights_um2 = nn.Parameter(constant(weights))
        self.register_buffer("_previous", constant(np.column_stack((centres, weights))), persistent=False)
        with torch.no_grad():
            self.cells()  # raises for empty cells

    def __repr__(self) -> str:
        x0, y0, x1, y1 = self.region_um
        return f"PowerCells({self.n_sites} sites in {x1 - x0:g} x {y1 - y0:g} µm)"

    @property
    def n_sites(self) -> int:
        """Number of cells."""
        return int(self.centres_um.shape[0])

    def forward(self) -> tuple[Tensor, Outlines]:
        """Return the result of :meth:`cells`."""
        return self.cells()

    def cells(self) -> tuple[Tensor, Outlines]:
        """
        Compute the cells at the current positions of the centres.

        Returns
        -------
        points : (n_point, 2) tensor, µm
            Corners as differentiable functions of the centres and the weights.
        outlines : Outlines
            Topology: site i is the cell of centre i. It may differ between calls.
        """
        centres = check_tensor("centres_um", self.centres_um, (None, 2))
        weights = check_tensor("weights_um2", self.weights_um2, (centres.shape[0],))
        region_um = np.array(self.region_um)
        corners = _Corners.of(as_array(centres).astype(np.float64), as_array(weights).astype(np.float64), region_um)
        points = corners.positions(centres, weights, constant(region_um).to(centres.dtype))
        outlines = Outlines(
            corners.vertex,
            corners.ring_offsets,
            np.arange(corners.ring_offsets.size),
            {},
            {"steps": ["power cells of movable centres"]},
        )
        _check_partition(as_array(outlines.area_um2(points)), region_um)
        return points, outlines

    def power(self, maps: Tensor, grid: Grid, *, order: Literal[1, 2] = 1, n_threads: int | None = None) -> Tensor:
        """
        Integrate maps over the cells: :func:`foveasim.learn.site_power`.

        Parameters
        ----------
        maps : (..., n_y, n_x) tensor
            Cell means, bottom row first.
        grid : Grid
            Grid of the maps.
        order : {1, 2}
            Order of integration.
        n_threads : int, optional
            Number of threads, by default all cores.

        Returns
        -------
        power : (..., n_site) tensor, unit of the maps times µm²
        """
        points, outlines = self.cells()
        return site_power(points, maps, outlines, grid, order=order, n_threads=n_threads)

    def area_um2(self) -> Tensor:
        """Return the area of each cell, (n_site,) tensor, µm²."""
        points, outlines = self.cells()
        return outlines.area_um2(points)

    @torch.no_grad()
    def limit_step(self) -> float:
        """
        Shorten the last step of an optimiser such that all cells are valid: a line search.

        Afterwards no cell is empty, and no centre is outside the region. The step is the change since the previous call, or
        since the object was created. The steps of invalid centres and of their weights are halved until all cells are valid,
        and cancelled after 8 halvings; if this is not enough, the steps of all other centres are halved in the same way.

        Returns
        -------
        fraction : float
            Smallest fraction of its step that a centre was moved; 1 if the complete step was valid.
        """

        def find_invalid(state: Tensor) -> Tensor | None:
            self.centres_um.copy_(state[:, :2])
            self.weights_um2.copy_(state[:, 2])
            try:
                self.cells()
            except GeometryError as error:
                if torch.equal(state, self._previous):
                    raise
                is_blocked = torch.zeros(self.n_sites, 1, dtype=torch.bool)
                is_blocked[list(error.site_ids)] = True
                return is_blocked
            return None

        fraction = shorten_steps(self._previous, torch.column_stack((self.centres_um, self.weights_um2)), find_invalid)
        self._previous.copy_(torch.column_stack((self.centres_um, self.weights_um2)))
        return float(fraction.min())

    @torch.no_grad()
    def layout(self) -> Layout:
        """Return the layout of the current cells, with corners at equal positions merged."""
        points, outlines = self.cells()
        merged, group = merge_coincident_points(as_array(points).astype(np.float64))
        vertex = group[outlines.vertex]
        is_distinct = vertex != vertex[next_vertex(outlines.ring_offsets)]
        n_distinct = np.add.reduceat(is_distinct.astype(np.int64), outlines.ring_offsets[:-1])
        offsets = np.concatenate(([0], np.cumsum(n_distinct)))
        layout = Layout.from_polygons((merged[vertex[is_distinct]], offsets, outlines.site_offsets))
        return layout.with_provenance(dict(outlines.provenance))


class _Corners:
    """
    Corners of power cells: three centres of each, and the corners of each cell.

    Mirror images of the centres across the four sides make the sides edges of the diagram, so that each corner is a point of
    equal power from three centres or images.

    ``centre``, ``side`` (n_point, 3): centres, and the sides across which their images lie; side 0 for the centre itself.
    ``on_side`` (n_point,): side on which a corner between two cells lies, otherwise 0; it depends on the first two centres
    only. ``at`` (n_point, 2): vertical and horizontal side of the corners of the region, otherwise 0. ``vertex`` (n_vertex,),
    ``ring_offsets`` (n_site + 1,): corners of each cell, counter-clockwise.
    """

    def __init__(self, centre: Ints, side: Ints, cell: Ints, corner: Ints) -> None:
        centre, side, self.on_side, self.at = _canonical(centre, side)
        key = np.concatenate((centre, side, self.on_side[:, np.newaxis], self.at), axis=1)
        _, first, point = np.unique(key, axis=0, return_index=True, return_inverse=True)
        self.centre, self.side, self.on_side, self.at = (each[first] for each in (centre, side, self.on_side, self.at))
        # Both corners of an edge between a cell and the image of its neighbour are the same point.
        point = point.ravel()[corner]
        before = np.flatnonzero(np.diff(cell, prepend=-1) > 0)
        last = np.concatenate((before[1:], [cell.size])) - 1
        previous = np.concatenate((point[:1], point[:-1]))
        previous[before] = point[last]
        is_new = point != previous
        self.vertex = point[is_new]
        self.ring_offsets = np.concatenate(([0], np.cumsum(np.bincount(cell[is_new]))))

    @classmethod
    def of(cls, centres_um: Floats, weights_um2: Floats, region_um: Floats) -> _Corners:
        """Return the corners of the cells of centres (n, 2) with weights (n,) in a region."""
        n = centres_um.shape[0]
        finite = np.isfinite(centres_um).all(axis=1) & np.isfinite(weights_um2)
        if not finite.all():
            raise GeometryError(f"centre {int(np.argmin(finite))} must have finite coordinates and a finite weight")
        is_outside = ~((centres_um > region_um[:2]) & (centres_um < region_um[2:])).all(axis=1)
        if is_outside.any():
            k = int(np.argmax(is_outside))
            x, y = centres_um[k]
            outside = tuple(np.flatnonzero(is_outside).tolist())
            raise GeometryError(f"centre {k} must lie inside the region, got ({x:.6g}, {y:.6g}) µm", outside)
        images_um = _images(centres_um, region_um)
        triangles = _regular_triangles(images_um, np.tile(weights_um2, N_SIDES + 1), n, region_um)
        is_hidden = np.bincount(triangles[triangles < n], minlength=n) == 0
        if is_hidden.any():
            k = int(np.argmax(is_hidden))
            raise GeometryError(
                f"centre {k} must have a cell, but those of other centres cover it; increase its weight or its distance "
                f"from its neighbours ({int(is_hidden.sum())} empty of {n} cells)",
                tuple(np.flatnonzero(is_hidden).tolist()),
            )
        cell, corner = _order_around_centres(triangles, images_um, n)
        return cls(triangles % n, triangles // n, cell, corner)

    def positions(self, centres: Tensor, weights: Tensor, region_um: Tensor) -> Tensor:
        """Return the positions (n_point, 2) of the corners, differentiable in centres and weights."""
        general, of_side, of_region = (
            np.flatnonzero(flag)
            for flag in ((self.on_side == 0) & (self.at[:, 0] == 0), self.on_side > 0, self.at[:, 0] > 0)
        )
        points = torch.zeros(self.on_side.size, 2, dtype=centres.dtype)
        for index, found in (
            (general, self._between_three(general, centres, weights, region_um)),
            (of_side, self._on_sides(of_side, centres, weights, region_um)),
            (of_region, region_um[torch.from_numpy(2 * self.at[of_region] - np.array([2, 5]))]),
        ):
            points = points.index_copy(0, torch.from_numpy(index), found)
        return points

    def _between_three(self, index: Ints, centres: Tensor, weights: Tensor, region_um: Tensor) -> Tensor:
        """Return the points of equal power from three centres or images."""
        positions, weight = [], []
        for k in range(3):
            centre, side = (torch.from_numpy(each[index, k].copy()) for each in (self.centre, self.side))
            scale, shift = _reflections(region_um)
            positions.append(scale[side] * centres[centre] + shift[side])
            weight.append(weights[centre])
        a, b, c = positions[0], positions[1] - positions[0], positions[2] - positions[0]
        of_b = (b * b).sum(dim=1) + (weight[0] - weight[1])
        of_c = (c * c).sum(dim=1) + (weight[0] - weight[2])
        along = of_c[:, None] * b - of_b[:, None] * c
        twice = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        return a + torch.stack((-along[:, 1], along[:, 0]), dim=1) / twice[:, None]

    def _on_sides(self, index: Ints, centres: Tensor, weights: Tensor, region_um: Tensor) -> Tensor:
        """Return the points of equal power from two centres on sides of the region."""
        side = self.on_side[index] - 1
        across, along = torch.from_numpy(side // 2), torch.from_numpy(1 - side // 2)
        rows = torch.arange(index.size)
        # Sides are numbered by axis, then low and high; the region is (x_min, y_min, x_max, y_max).
        level = region_um[torch.from_numpy(side // 2 + 2 * (side % 2))]
        first, second = (torch.from_numpy(self.centre[index, k].copy()) for k in (0, 1))
        a, b = centres[first], centres[second]
        a_t, b_t = a[rows, along], b[rows, along]
        a_n, b_n = level - a[rows, across], level - b[rows, across]
        excess = (b_n - a_n) * (b_n + a_n) + weights[first] - weights[second]
        position = 0.5 * (a_t + b_t) + 0.5 * excess / (b_t - a_t)
        is_vertical = (across == 0)[:, None]
        return torch.where(is_vertical, torch.stack((level, position), dim=1), torch.stack((position, level), dim=1))


def _as_numbers(name: str, value: Any) -> Floats:
    """Return a tensor or array as finite float64 numbers."""
    if isinstance(value, Tensor):
        value = as_array(check_tensor(name, value, (None,) * value.ndim))
    elif isinstance(value, str) or value is None:
        raise ParameterError(name, f"must be a tensor or an array, got {type_name(value)}")
    return finite_array(name, value)


def _reflections(region_um: Tensor) -> tuple[Tensor, Tensor]:
    """Return factors and offsets (N_SIDES + 1, 2) of the identity and of all reflections."""
    one, zero = torch.ones_like(region_um[0]), torch.zeros_like(region_um[0])
    scale = torch.stack((one, one, -one, one, -one, one, one, -one, one, -one)).reshape(-1, 2)
    x0, y0, x1, y1 = 2.0 * region_um
    shift = torch.stack((zero, zero, x0, zero, x1, zero, zero, y0, zero, y1)).reshape(-1, 2)
    return scale, shift


def _images(centres_um: Floats, region_um: Floats) -> Floats:
    """Return the centres and their images across the sides, ((N_SIDES + 1) n, 2)."""
    scale, shift = _reflections(constant(region_um))
    images = as_array(scale)[:, np.newaxis] * centres_um + as_array(shift)[:, np.newaxis]
    return np.asarray(images.reshape(-1, 2))


def _regular_triangles(points_um: Floats, weights_um2: Floats, n_centres: int, region_um: Floats) -> Ints:
    """Return the triangles (n_triangle, 3) of the regular triangulation that have a centre."""
    from scipy.spatial import ConvexHull, QhullError

    offset = points_um - 0.5 * (region_um[:2] + region_um[2:])
    scale_um = float((region_um[2:] - region_um[:2]).max())
    height_um2 = (offset**2).sum(axis=1) - (weights_um2 - weights_um2.mean())
    try:
        hull = ConvexHull(np.column_stack((offset / scale_um, height_um2 / scale_um**2)))
    except QhullError:
        raise GeometryError("centres must lie at distinct positions that float64 resolves") from None
    triangles = hull.simplices[hull.equations[:, 2] < 0.0].astype(np.int64)
    triangles = triangles[(triangles < n_centres).any(axis=1)]
    a, b, c = (points_um[triangles[:, k]] for k in range(3))
    twice = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles[twice < 0.0, 1:] = triangles[twice < 0.0, :0:-1]
    return triangles[twice != 0.0]


def _order_around_centres(triangles: Ints, points_um: Floats, n_centres: int) -> tuple[Ints, Ints]:
    """Return the cell and the triangle of each corner, counter-clockwise around each centre."""
    corner = np.tile(np.arange(triangles.shape[0]), 3)
    cell, right, left = (np.roll(triangles, -k, axis=1).T.ravel() for k in range(3))
    is_centre = cell < n_centres
    corner, cell, right, left = (each[is_centre] for each in (corner, cell, right, left))
    # The neighbours of a centre in a triangulation lie at distinct angles.
    step = points_um[right] - points_um[cell]
    order = np.lexsort((np.arctan2(step[:, 1], step[:, 0]), cell))
    corner, cell, right, left = (each[order] for each in (corner, cell, right, left))
    offsets = np.concatenate(([0], np.cumsum(np.bincount(cell, minlength=n_centres))))
    is_wrong: Bools = left != right[next_vertex(offsets)]
    if is_wrong.any():
        k = int(cell[is_wrong][0])
        raise GeometryError(f"the cell of centre {k} must be one that float64 resolves; move the centre", (k,))
    return cell, corner


def _canonical(centre: Ints, side: Ints) -> tuple[Ints, Ints, Ints, Ints]:
    """
    Return equal keys for triangles whose corners are the same point by symmetry.

    Two centres and their images across one side have one common corner on this side, whichever three of them form the triangle.
    """
    order = np.lexsort((side, centre), axis=1)
    centre, side = np.take_along_axis(centre, order, axis=1), np.take_along_axis(side, order, axis=1)
    n_different = 1 + (np.diff(centre, axis=1) != 0).sum(axis=1)
    sides = np.sort(side, axis=1)
    highest = sides[:, 2]
    on_side = np.where((n_different == 2) & ((side == 0) | (side == highest[:, np.newaxis])).all(axis=1), highest, 0)
    at = np.where(((n_different == 1) & (sides[:, 1] <= 2) & (highest > 2))[:, np.newaxis], sides[:, 1:], 0)
    pair = np.stack((centre[:, 0], centre[:, 2], centre[:, 2]), axis=1)
    centre = np.where((on_side > 0)[:, np.newaxis], pair, centre)
    is_special = ((on_side > 0) | (at[:, 0] > 0))[:, np.newaxis]
    return np.where(at[:, :1] > 0, 0, centre), np.where(is_special, 0, side), on_side, at


def _check_partition(area_um2: Floats, region_um: Floats) -> None:
    """Raise an error if the cells do not fill the region."""
    total_um2 = float((region_um[2:] - region_um[:2]).prod())
    if (
        not abs(float(area_um2.sum()) - total_um2) <= AREA_ROUNDING * total_um2
        or area_um2.min() < -AREA_ROUNDING * total_um2
    ):
        raise GeometryError("some cells are too small for float64; move the closest centres apart")
