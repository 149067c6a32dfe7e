"""Outlines of photosites in the plane of the map, optionally undistorted."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.fields import Lattice, PackedRings, PointMap

#: Maximum deviation of an undistorted edge from its chords, as a fraction of a cell; exceeded a few times by edges along which
#: the curvature varies several times, or that need more than the maximum number of pieces.
CHORD_TOLERANCE = 0.001
#: Positions along an edge at which its deviation from a chord is measured, and the ratio of the largest deviation of a parabola
#: to that there. Long edges may have an inflection at the midpoint, and are measured at the others too.
MIDPOINT, THIRDS = (0.5, 1.0), ((1.0 / 3.0, 1.125), (2.0 / 3.0, 1.125))
#: Length of long edges, in units of the allowed deviation: 8 cells.
LONG_EDGE = 8.0 / CHORD_TOLERANCE
#: Accuracy of the bounds of undistorted outlines, as a fraction of the larger side of the layout.
BOUNDS_TOLERANCE = 1e-6
#: Sites that are undistorted at once, a memory limit.
SITES_PER_BLOCK = 2**16
#: Maximum number of pieces per edge; edges that need more reach the boundary of the image circle.
MAX_PIECES = 256
#: Undistorted points beyond this distance are at infinity, on the image circle: areas of their sites are rounding errors.
MAX_UM = 1e12


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

    ``lens``: object with ``undistort(xy_um, outside="mask")``, which returns NaN for points outside its image circle.
    ``pitch_um``: shorter side of the cells of the map: edges are split until the chord error is at most 0.1 % of this
    length, or the fraction ``lens.chord_tolerance``.

    Sites with a vertex outside the image circle are marked as lost and remain in the sensor plane. Edges shared by two
    sites are split at identical points, so that tilings have no gaps or overlaps after the transformation.
    """

    def __init__(self, layout: PackedRings, lens: PointMap, pitch_um: float) -> None:
        self._layout, self._lens = layout, lens
        self._chord_um = getattr(lens, "chord_tolerance", CHORD_TOLERANCE) * pitch_um

    def __call__(self, first: int, last: int) -> Outlines:
        """Return the outlines of the sites ``first`` to ``last - 1``."""
        outlines = outlines_of(self._layout, first, last)
        return _undistort(outlines, self._lens, self._chord_um) if outlines.xy_um.size else outlines

    def count_pieces(self) -> Ints:
        """Return the number of pieces into which the edge after each vertex is split, (n_vertex,)."""
        xy_um, ring_offsets = self._layout.xy_um, self._layout.ring_offsets
        return _Edges(xy_um, ring_offsets, self._lens).count_pieces(self._chord_um)


class _Edges:
    """
    Edges of rings, and their undistorted vertices.

    Edges begin at their lexicographically smaller vertex, so that adjacent sites split a shared edge identically.
    """

    def __init__(self, xy_um: Floats, ring_offsets: Ints, lens: PointMap) -> None:
        from foveasim.integrate import _kernels

        self._lens = lens
        self.undistorted = lens.undistort(xy_um, outside="mask")
        self.is_reversed = _kernels.find_reversed_edges(xy_um, ring_offsets)
        self.low, self.along = _kernels.edges(xy_um, ring_offsets, self.is_reversed)
        self._low_to, self._along_to = _kernels.edges(self.undistorted, ring_offsets, self.is_reversed)

    def at(self, edge: Ints | slice, fraction: Any) -> Floats:
        """Return points on edges, (n, 2)."""
        return np.asarray(self.low[edge] + fraction * self.along[edge])

    def count_pieces(self, chord_um: float) -> Ints:
        """
        Return the number of pieces of every edge for a maximum deviation of chords, (n,).

        At most ``MAX_PIECES``. The number depends on the edge alone, so that a site has the same outline in every selection of
        sites. The deviation of n chords is 1/n² of that of one, as for a parabola.
        """
        deviation_um = self._deviation_um(slice(None), *MIDPOINT)
        length2_um2 = self.along[:, 0] * self.along[:, 0] + self.along[:, 1] * self.along[:, 1]
        long = np.flatnonzero(length2_um2 > (LONG_EDGE * chord_um) ** 2)
        for fraction, ratio in THIRDS if long.size else ():
            deviation_um[long] = np.fmax(deviation_um[long], self._deviation_um(long, fraction, ratio))
        # Edges that leave the image circle have NaN: their sites are outside, as points of these edges or as vertices.
        n_pieces = np.ceil(np.sqrt(np.nan_to_num(deviation_um, nan=np.inf) / chord_um))
        is_vertex_outside = np.isnan(self._along_to[:, 0])
        return np.where(is_vertex_outside, 1.0, np.clip(n_pieces, 1.0, MAX_PIECES)).astype(np.int64)

    def _deviation_um(self, edge: Ints | slice, fraction: float, ratio: float) -> Floats:
        """Return the deviation of undistorted edges from chords, from that at a fraction."""
        chord = self._low_to[edge] + fraction * self._along_to[edge]
        off = self._lens.undistort(self.at(edge, fraction), outside="mask") - chord
        return ratio * np.hypot(off[:, 0], off[:, 1])


def _undistort(outlines: Outlines, lens: PointMap, chord_um: float) -> Outlines:
    """Return undistorted outlines."""
    xy_um, ring_offsets, site_offsets, _ = outlines
    edges = _Edges(xy_um, ring_offsets, lens)
    n_pieces = edges.count_pieces(chord_um)
    points, undistorted = xy_um, edges.undistorted
    if n_pieces.max() > 1:
        edge = np.repeat(np.arange(xy_um.shape[0]), n_pieces)
        step = positions_in_runs(n_pieces)
        fraction = np.where(edges.is_reversed[edge], n_pieces[edge] - step, step) / n_pieces[edge]
        points = edges.at(edge, fraction[:, np.newaxis])
        points[step == 0] = xy_um
        ring_offsets = np.concatenate(([0], np.cumsum(n_pieces)))[ring_offsets]
        undistorted = np.empty_like(points)
        undistorted[step == 0] = edges.undistorted
        undistorted[step > 0] = lens.undistort(points[step > 0], outside="mask")
    # Column by column, which is faster than a maximum along the last axis. A NaN is lost, too.
    is_lost = ~((np.abs(undistorted[:, 0]) < MAX_UM) & (np.abs(undistorted[:, 1]) < MAX_UM))
    is_outside = np.logical_or.reduceat(is_lost, ring_offsets[site_offsets[:-1]])
    if is_outside.any():
        is_outside_vertex = np.repeat(is_outside, np.diff(ring_offsets[site_offsets]))
        undistorted = np.where(is_outside_vertex[:, np.newaxis], points, undistorted)
    return Outlines(undistorted, ring_offsets, site_offsets, is_outside)


def outline_bounds_um(layout: PackedRings, distortion: PointMap | None = None) -> tuple[float, float, float, float]:
    """
    Return the bounding box (x_min, y_min, x_max, y_max) of all outlines, µm.

    It is NaN without sites. With a lens, the outlines are undistorted, sites outside its image circle do not count, and
    curved edges are within 1e-6 of the larger side of the layout.
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
