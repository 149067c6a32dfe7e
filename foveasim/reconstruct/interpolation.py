"""
Interpolation of photosite values between site centroids.

Both methods are exact at the centroids. The coverage of the picture is that of the site outlines, not of the triangles between
centroids, so that a blind spot remains without data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from foveasim._core.rings import site_moments
from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import Floats, Ints, as_numbers
from foveasim.errors import ParameterError
from foveasim.fields import Grid, PackedRings
from foveasim.reconstruct.picture import Gaps, Picture, raster_of

__all__ = ["linear", "natural", "site_values"]

#: Centroids closer than this fraction of the layout's extent are merged, with the mean of their values.
MERGE_FRACTION = 1e-9
#: Pixels per work item; fixed, so that the result does not depend on the number of threads.
PIXELS_PER_PIECE = 1 << 14
#: Distances from points to hull edges that are computed at a time, which limits memory.
MAX_DISTANCES = 1 << 22


def linear(
    layout: PackedRings, values: Floats, grid: Grid, *, gaps: Gaps = "fill", n_threads: int | None = None
) -> Picture:
    """
    Interpolate values linearly on the Delaunay triangulation of the site centroids.

    Parameters
    ----------
    layout : Layout
    values : (n_site,) or (n_channel, n_site)
        NaN where a site does not measure a channel, which is then interpolated from the other sites.
    grid : Grid
        Pixels of the picture; values are those at the pixel centres.
    gaps : {"fill", "empty"}
        As for :func:`cells`.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    Picture
        Exact at the centroids; linear fields are reproduced inside their convex hull. Covered pixels outside the hull have
        the value of the nearest point of the hull, without extrapolation. NaN where no photosite lies.

    Raises
    ------
    ParameterError
        When there is not one value per site, a value is infinite, or a channel has no values.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)
    >>> grid = fs.Grid.centred((4, 4), 1.0)
    >>> picture = fs.reconstruct.linear(
    ...     layout, layout.centroid_um[:, 0], grid
    ... )  # a ramp remains one
    >>> picture.data[0, 1].round(3).tolist()
    [-1.5, -0.5, 0.5, 1.5]
    """
    return _interpolate(layout, values, grid, gaps, n_threads, is_smooth=False)


def natural(
    layout: PackedRings, values: Floats, grid: Grid, *, gaps: Gaps = "fill", n_threads: int | None = None
) -> Picture:
    """
    Interpolate values by Sibson's natural neighbours of the site centroids.

    A pixel's value is the weighted mean of its natural neighbours. The weight of a site is the area that its Voronoi cell
    would lose if the pixel centre were inserted (Sibson 1981, A brief description of natural neighbour interpolation).

    Parameters
    ----------
    layout, values, grid, gaps, n_threads
        As for :func:`linear`.

    Returns
    -------
    Picture
        As for :func:`linear`, but with a continuous gradient except at the centroids.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)
    >>> grid = fs.Grid.centred((4, 4), 1.0)
    >>> picture = fs.reconstruct.natural(layout, layout.centroid_um[:, 0], grid)
    >>> picture.data[0, 1].round(3).tolist()
    [-1.5, -0.5, 0.5, 1.5]
    """
    return _interpolate(layout, values, grid, gaps, n_threads, is_smooth=True)


def site_values(values: Floats, n_sites: int) -> Floats:
    """
    Return values, NaN where missing, with the shape (n_channel, n_site).

    Raises ParameterError when there is not one value per site, a value is infinite, or a channel has no values.
    """
    channels = np.atleast_2d(as_numbers("values", values, missing_is_nan=True))
    if channels.ndim != 2 or channels.shape[1] != n_sites:
        raise ParameterError("values", f"must have the shape (..., {n_sites}), got {np.shape(values)}")
    if np.isinf(channels).any():
        raise ParameterError("values", "must be finite, or NaN where a site has no value")
    empty = np.flatnonzero(np.isnan(channels).all(axis=1))
    if empty.size:
        raise ParameterError("values", f"must have a number for at least one site, got none in channel {empty[0]}")
    return channels


def _interpolate(
    layout: PackedRings, values: Floats, grid: Grid, gaps: Gaps, n_threads: int | None, *, is_smooth: bool
) -> Picture:
    raster = raster_of(layout, grid, gaps, n_threads)
    channels = site_values(values, raster.sites.n_sites)
    _, centroid_um = site_moments(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    row, column = np.nonzero(raster.covered_fraction)
    points_um = np.stack((grid.x_um[column], grid.y_um[row]), axis=1)
    data = np.full((channels.shape[0], *grid.shape), np.nan)
    patterns, pattern = np.unique(~np.isnan(channels), axis=0, return_inverse=True)
    for k, is_known in enumerate(patterns):
        in_pattern = np.flatnonzero(pattern.ravel() == k)
        mesh = _Mesh.from_centroids(centroid_um[is_known], channels[np.ix_(in_pattern, np.flatnonzero(is_known))])
        found = mesh.evaluate(points_um, thread_count(n_threads), is_smooth=is_smooth)
        data[in_pattern[:, np.newaxis], row, column] = found
    return raster.picture(data)


@dataclass(frozen=True, eq=False)
class _Mesh:
    """
    Distinct points with values, and their Delaunay triangulation.

    Coordinates are relative to ``centre_um``, in units of ``extent_um``.
    """

    xy: Floats
    values: Floats
    centre_um: Floats
    extent_um: float

    @classmethod
    def from_centroids(cls, centroid_um: Floats, values: Floats) -> _Mesh:
        """Create from centroids (n, 2) with values (n_channel, n); equal centroids are merged."""
        centre_um = 0.5 * (centroid_um.min(axis=0) + centroid_um.max(axis=0))
        extent_um = float(np.ptp(centroid_um, axis=0).max()) or 1.0
        xy = (centroid_um - centre_um) / extent_um
        # Coordinates of 31 bits in one integer, which sorts faster than rows of an array.
        x, y = np.rint(xy / MERGE_FRACTION).astype(np.int64).T
        _, first, position = np.unique((x << 32) + y, return_index=True, return_inverse=True)
        count = np.bincount(position)
        sums = np.array([np.bincount(position, weights=channel) for channel in values])
        return cls(np.ascontiguousarray(xy[first]), np.ascontiguousarray((sums / count).T), centre_um, extent_um)

    def evaluate(self, points_um: Floats, n_threads: int, *, is_smooth: bool) -> Floats:
        """Interpolate values at points (n, 2), as (n_channel, n)."""
        from scipy.spatial import Delaunay, QhullError

        from foveasim.reconstruct import _kernels

        points = (points_um - self.centre_um) / self.extent_um
        try:
            mesh = Delaunay(self.xy)
        except (QhullError, ValueError):  # fewer than three points, or all collinear
            return self._along_line(points)
        found = np.empty((points.shape[0], self.values.shape[1]))
        pieces = [slice(i, i + PIXELS_PER_PIECE) for i in range(0, points.shape[0], PIXELS_PER_PIECE)]
        corners, neighbours = (np.ascontiguousarray(part, np.int64) for part in (mesh.simplices, mesh.neighbors))
        hull_edges = np.argwhere(neighbours < 0)
        edges = np.stack([corners[hull_edges[:, 0], (hull_edges[:, 1] + k) % 3] for k in (1, 2)], axis=1)
        circles = _circumcircles(self.xy[corners]) if is_smooth else np.empty((0, 3))

        def fill(piece: slice) -> None:
            triangle = np.empty(points[piece].shape[0], np.int64)
            _kernels.find_triangles(points[piece], self.xy, corners, neighbours, triangle)
            inside, outside = np.flatnonzero(triangle >= 0), np.flatnonzero(triangle < 0) + piece.start
            out = np.empty((inside.size, self.values.shape[1]))
            _kernels.interpolate(
                points[piece][inside],
                triangle[inside],
                self.xy,
                self.values,
                corners,
                neighbours,
                circles,
                is_smooth,
                out,
            )
            found[inside + piece.start] = out
            if outside.size:
                found[outside] = self._at_hull(points[outside], edges)

        parallel_map(fill, pieces, n_threads)
        return found.T

    def _at_hull(self, points: Floats, edges: Ints) -> Floats:
        """Return values at the nearest points of the convex hull."""
        start = self.xy[edges[:, 0]]
        along = self.xy[edges[:, 1]] - start
        length2 = np.einsum("ij,ij->i", along, along)
        found = np.empty((points.shape[0], self.values.shape[1]))
        step = max(1, MAX_DISTANCES // edges.shape[0])
        for i in range(0, points.shape[0], step):
            offset = points[i : i + step, np.newaxis] - start
            at = np.clip(np.einsum("pej,ej->pe", offset, along) / length2, 0.0, 1.0)
            distance2 = ((offset - at[..., np.newaxis] * along) ** 2).sum(axis=-1)
            nearest = distance2.argmin(axis=1)
            fraction = np.take_along_axis(at, nearest[:, np.newaxis], axis=1)
            ends = self.values[edges[nearest]]
            found[i : i + step] = (1.0 - fraction) * ends[:, 0] + fraction * ends[:, 1]
        return found

    def _along_line(self, points: Floats) -> Floats:
        """Interpolate along the line of collinear points, clamped at its ends."""
        order = np.lexsort(self.xy.T)
        first, last = self.xy[order[0]], self.xy[order[-1]]
        position, at = ((xy - first) @ (last - first) for xy in (self.xy, points))
        order = np.argsort(position)
        return np.array([np.interp(at, position[order], channel[order]) for channel in self.values.T])


def _circumcircles(corners: Floats) -> Floats:
    """Return centres and squared radii of triangle circumcircles, (n, 3) from (n, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    double_area = 2.0 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    double_area = np.where(double_area == 0.0, np.finfo(np.float64).tiny, double_area)
    a2, b2 = (a**2).sum(axis=1), (b**2).sum(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        centre = (
            np.stack((a2 * b[:, 1] - b2 * a[:, 1], b2 * a[:, 0] - a2 * b[:, 0]), axis=1) / double_area[:, np.newaxis]
        )
        circles = np.concatenate((corners[:, 0] + centre, (centre**2).sum(axis=1, keepdims=True)), axis=1)
    # Collinear corners have no circumcircle: a squared radius of -1 contains no point.
    return np.ascontiguousarray(np.where(np.isfinite(circles).all(axis=1, keepdims=True), circles, (0.0, 0.0, -1.0)))
