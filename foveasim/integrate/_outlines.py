"""Outlines of photosites in the plane of the map, optionally undistorted."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from foveasim._core.rings import next_vertex, positions_in_runs
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.fields import Lattice, PackedRings, PointMap

__all__ = ["Outlines", "UndistortedOutlines", "outline_bounds_um", "outlines_of"]

#: Maximum deviation of an undistorted edge from its chords, as a fraction of a cell; exceeded a few times by edges that are
#: longer than a step of the grid below or need more than the maximum number of pieces.
CHORD_TOLERANCE = 0.002
#: Number of points along either axis of the layout at which the curvature of undistorted lines is sampled.
CURVATURE_POINTS = 65
#: Accuracy of the bounds of undistorted outlines, as a fraction of the larger side of the layout.
BOUNDS_TOLERANCE = 1e-6
#: Sites that are undistorted at once, a memory limit.
SITES_PER_BLOCK = 2**16
#: Maximum number of pieces per edge; edges that need more reach the boundary of the image circle.
MAX_PIECES = 256


class Outlines(NamedTuple):
    """Packed rings in the plane of the map, with a mask of sites outside the image circle."""

    xy_um: Floats
    ring_offsets: Ints
    site_offsets: Ints
    is_outside: Bools


def outlines_of(layout: PackedRings, first: int, last: int) -> Outlines:
    """Return the outlines of the sites ``first`` to ``last - 1`` in the sensor plane."""
    lattice: Lattice | None = getattr(layout, "lattice", None)
    if lattice is not None:
        return Outlines(*lattice.rings(first, last), np.zeros(last - first, bool))
    site_offsets = layout.site_offsets[first : last + 1]
    ring_offsets = layout.ring_offsets[site_offsets[0] : site_offsets[-1] + 1]
    return Outlines(
        np.ascontiguousarray(layout.xy_um[ring_offsets[0] : ring_offsets[-1]]),
        ring_offsets - ring_offsets[0],
        site_offsets - site_offsets[0],
        np.zeros(last - first, bool),
    )


class UndistortedOutlines:
    """
    Outlines of photosites undistorted into the plane of an ideal lens.

    Parameters
    ----------
    layout : packed rings
        Outlines in the sensor plane.
    lens : object with ``undistort(xy_um, outside="mask")``
        Lens that returns NaN for points outside its image circle.
    pitch_um : float, µm
        Shorter side of the cells of the map: edges are split until the chord error is at most 0.2 % of this length.

    Notes
    -----
    Sites with a vertex outside the image circle are marked as lost and remain in the sensor plane. Edges shared by two sites
    are split at identical points, so that tilings have no gaps or overlaps after the transformation.
    """

    def __init__(self, layout: PackedRings, lens: PointMap, pitch_um: float) -> None:
        self._layout, self._lens = layout, lens
        self._chord_density = (
            _ChordDensity(layout.xy_um, lens, CHORD_TOLERANCE * pitch_um) if layout.xy_um.size else None
        )

    def __call__(self, first: int, last: int) -> Outlines:
        """Return the outlines of the sites ``first`` to ``last - 1``."""
        outlines = outlines_of(self._layout, first, last)
        return outlines if self._chord_density is None else _undistort(outlines, self._lens, self._chord_density)

    def count_pieces(self) -> Ints:
        """Return the number of pieces into which the edge after each vertex is split, (n_vertex,)."""
        if self._chord_density is None:
            return np.ones(0, np.int64)
        return self._chord_density.n_pieces(self._layout.xy_um, self._layout.ring_offsets)


def _undistort(outlines: Outlines, lens: PointMap, chord_density: _ChordDensity) -> Outlines:
    """Return undistorted outlines."""
    xy_um, ring_offsets, site_offsets, _ = outlines
    n_pieces = chord_density.n_pieces(xy_um, ring_offsets)
    points = xy_um
    if n_pieces.max() > 1:
        end = xy_um[next_vertex(ring_offsets)]
        # Interpolate from the lexicographically smaller vertex, so that adjacent sites split a shared edge identically.
        is_reversed = (end[:, 0] < xy_um[:, 0]) | ((end[:, 0] == xy_um[:, 0]) & (end[:, 1] < xy_um[:, 1]))
        low, high = np.where(is_reversed[:, np.newaxis], end, xy_um), np.where(is_reversed[:, np.newaxis], xy_um, end)
        edge = np.repeat(np.arange(xy_um.shape[0]), n_pieces)
        step = positions_in_runs(n_pieces)
        fraction = np.where(is_reversed[edge], n_pieces[edge] - step, step) / n_pieces[edge]
        points = low[edge] + fraction[:, np.newaxis] * (high - low)[edge]
        points[step == 0] = xy_um
        ring_offsets = np.concatenate(([0], np.cumsum(n_pieces)))[ring_offsets]
    undistorted = lens.undistort(points, outside="mask")
    is_outside = np.logical_or.reduceat(np.isnan(undistorted[:, 0]), ring_offsets[site_offsets[:-1]])
    if is_outside.any():
        is_outside_vertex = np.repeat(is_outside, np.diff(ring_offsets[site_offsets]))
        undistorted = np.where(is_outside_vertex[:, np.newaxis], points, undistorted)
    return Outlines(undistorted, ring_offsets, site_offsets, is_outside)


def outline_bounds_um(layout: PackedRings, distortion: PointMap | None = None) -> tuple[float, float, float, float]:
    """
    Return the bounding box of all outlines, undistorted if a lens is given.

    Parameters
    ----------
    layout : packed rings
        Outlines in the sensor plane.
    distortion : object with ``undistort(xy_um, outside="mask")``, optional
        A lens of :mod:`foveasim.distortion`; sites outside its image circle do not count.

    Returns
    -------
    x_min, y_min, x_max, y_max : float, µm
        NaN if there are no sites. With a lens, curved edges are within 1e-6 of the larger side of the layout.
    """
    lattice: Lattice | None = getattr(layout, "lattice", None)
    if lattice is not None and distortion is None:
        return lattice.bounds_um
    xy_um, n_sites = layout.xy_um, layout.site_offsets.size - 1
    if not xy_um.size:
        return np.nan, np.nan, np.nan, np.nan
    # Column by column: many times faster than a reduction along axis 0.
    low_um, high_um = (np.array([find(xy_um[:, axis]) for axis in (0, 1)]) for find in (np.min, np.max))
    if distortion is not None:
        tolerance_um = BOUNDS_TOLERANCE * float((high_um - low_um).max())
        outlines_between = UndistortedOutlines(layout, distortion, tolerance_um / CHORD_TOLERANCE)
        low_um, high_um = np.full(2, np.inf), np.full(2, -np.inf)
        for first in range(0, n_sites, SITES_PER_BLOCK):
            outlines = outlines_between(first, min(first + SITES_PER_BLOCK, n_sites))
            n_vertices = np.diff(outlines.ring_offsets[outlines.site_offsets])
            points_um = outlines.xy_um[~np.repeat(outlines.is_outside, n_vertices)]
            low_um = np.minimum(low_um, points_um.min(axis=0, initial=np.inf))
            high_um = np.maximum(high_um, points_um.max(axis=0, initial=-np.inf))
        if not (low_um <= high_um).all():
            return np.nan, np.nan, np.nan, np.nan
    return float(low_um[0]), float(low_um[1]), float(high_um[0]), float(high_um[1])


class _ChordDensity:
    """Number of chords per length of edges, sampled on a coarse grid over a layout."""

    def __init__(self, xy_um: Floats, lens: PointMap, chord_um: float) -> None:
        self._first_um = np.array([xy_um[:, i].min() for i in (0, 1)])
        size_um = np.array([xy_um[:, i].max() for i in (0, 1)]) - self._first_um
        self._step_um = np.maximum(size_um, chord_um) / (CURVATURE_POINTS - 1)
        # A chord of length L deviates by L² / 8 times the second derivative.
        self._pieces_per_um = np.sqrt(_max_curvature(self._first_um, self._step_um, lens) / (8.0 * chord_um))

    def n_pieces(self, xy_um: Floats, ring_offsets: Ints) -> Ints:
        """Return the number of pieces of every edge, in the order of the first vertices."""
        from foveasim.integrate import _kernels

        count: Callable[..., Ints] = _kernels.count_pieces
        return count(xy_um, ring_offsets, self._first_um, self._step_um, self._pieces_per_um, MAX_PIECES)


def _max_curvature(first_um: Floats, step_um: Floats, lens: PointMap) -> Floats:
    """
    Return the largest second derivative of the undistorted position, 1/µm.

    The maximum over all directions and the neighbourhood of every point of a coarse grid.
    """
    from scipy.ndimage import maximum_filter

    # One additional point on every side for the finite differences.
    x, y = (first_um[i] + step_um[i] * np.arange(-1, CURVATURE_POINTS + 1) for i in (0, 1))
    undistorted = lens.undistort(np.stack(np.meshgrid(x, y), axis=-1), outside="mask")
    inner = undistorted[1:-1, 1:-1]
    xx = (undistorted[1:-1, 2:] - 2.0 * inner + undistorted[1:-1, :-2]) / step_um[0] ** 2
    yy = (undistorted[2:, 1:-1] - 2.0 * inner + undistorted[:-2, 1:-1]) / step_um[1] ** 2
    mixed = undistorted[2:, 2:] - undistorted[2:, :-2] - undistorted[:-2, 2:] + undistorted[:-2, :-2]
    xy = mixed / (4.0 * step_um[0] * step_um[1])
    # The second derivative along (c, s) is c² xx + 2 c s xy + s² yy.
    size = np.hypot(xx[..., 0], xx[..., 1]), np.hypot(yy[..., 0], yy[..., 1]), np.hypot(xy[..., 0], xy[..., 1])
    curvature = np.maximum(size[0], size[1]) + size[2]
    return np.asarray(maximum_filter(np.nan_to_num(curvature, nan=0.0), size=3, mode="nearest"))
