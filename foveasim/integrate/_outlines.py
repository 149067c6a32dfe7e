"""Outlines of photosites carried back through a lens into the plane of the undistorted map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from foveasim.arrays import Bools, Floats, Ints
from foveasim.fields import PackedRings, PointMap
from foveasim.rings import next_vertex, positions_in_runs

__all__ = ["CarriedRings", "carried_back"]

#: A carried edge deviates from its chords by at most this share of a cell.
CHORD_SHARE = 0.002
#: How much the lens bends lines is found at so many points along either side of the layout.
BEND_POINTS = 65
#: An edge is cut into so many pieces at most: those that need more reach the lens's border.
MAX_PIECES = 256


class CarriedRings(NamedTuple):
    """Packed rings in the undistorted plane, and which sites have no place there."""

    xy_um: Floats
    ring_offsets: Ints
    site_offsets: Ints
    is_lost: Bools


def carried_back(layout: PackedRings, lens: PointMap, pitch_um: float) -> CarriedRings:
    """
    The outlines that an ideal lens would have to fill.

    Parameters
    ----------
    layout : packed rings
        Outlines in the sensor plane.
    lens : object with ``undistort(xy_um, outside="mask")``
        NaN for points that the lens sends no light to.
    pitch_um : float, µm
        Of the map's cells: edges are cut until their chords are within 0.2 % of it.

    Returns
    -------
    CarriedRings
        Sites with a vertex that gets no light are lost, and have their outlines in the sensor plane.

    Notes
    -----
    An edge is cut at the same points from both of its sides, so that what tiles the sensor tiles the carried plane.
    """
    xy_um = layout.xy_um
    begin, end = xy_um, xy_um[next_vertex(layout.ring_offsets)]
    # From the smaller end to the larger one: neighbours cut the edge that they share alike.
    is_turned = (end[:, 0] < begin[:, 0]) | ((end[:, 0] == begin[:, 0]) & (end[:, 1] < begin[:, 1]))
    low, high = np.where(is_turned[:, np.newaxis], end, begin), np.where(is_turned[:, np.newaxis], begin, end)
    n_pieces = _pieces(low, high, lens, CHORD_SHARE * pitch_um)
    edge = np.repeat(np.arange(begin.shape[0]), n_pieces)
    step = positions_in_runs(n_pieces)
    share = np.where(is_turned[edge], n_pieces[edge] - step, step) / n_pieces[edge]
    points = low[edge] + share[:, np.newaxis] * (high - low)[edge]
    points[step == 0] = begin
    carried = lens.undistort(points, outside="mask")
    ring_offsets = np.concatenate(([0], np.cumsum(n_pieces)))[layout.ring_offsets]
    is_lost = np.zeros(layout.site_offsets.size - 1, bool)
    if is_lost.size:
        is_lost = np.logical_or.reduceat(np.isnan(carried).any(axis=1), ring_offsets[layout.site_offsets[:-1]])
    n_points = np.diff(ring_offsets[layout.site_offsets])
    carried = np.where(np.repeat(is_lost, n_points)[:, np.newaxis], points, carried)
    return CarriedRings(carried, ring_offsets, layout.site_offsets, is_lost)


def _pieces(low_um: Floats, high_um: Floats, lens: PointMap, chord_um: float) -> Ints:
    """How many pieces every edge is cut into: a chord of length L deviates by L² / 8 times the second derivative."""
    if low_um.shape[0] == 0:
        return np.ones(0, np.int64)
    first_um, last_um = low_um.min(axis=0), np.maximum(high_um.max(axis=0), low_um.max(axis=0))
    first_um = np.minimum(first_um, high_um.min(axis=0))
    step_um = np.maximum(last_um - first_um, chord_um) / (BEND_POINTS - 1)
    bend = _bends(first_um, step_um, lens)
    place = np.rint((0.5 * (low_um + high_um) - first_um) / step_um).astype(np.int64)
    bend_per_um = bend[np.clip(place[:, 1], 0, BEND_POINTS - 1), np.clip(place[:, 0], 0, BEND_POINTS - 1)]
    length2_um2 = ((high_um - low_um) ** 2).sum(axis=1)
    n = np.ceil(np.sqrt(length2_um2 * bend_per_um / (8.0 * chord_um)))
    return np.clip(n, 1, MAX_PIECES).astype(np.int64)


def _bends(first_um: Floats, step_um: Floats, lens: PointMap) -> Floats:
    """The largest second derivative of the carried position along any direction, near every point of a coarse grid, 1/µm."""
    from scipy.ndimage import maximum_filter

    # One point more on every side, for the differences.
    x, y = (first_um[i] + step_um[i] * np.arange(-1, BEND_POINTS + 1) for i in (0, 1))
    carried = lens.undistort(np.stack(np.meshgrid(x, y), axis=-1), outside="mask")
    inner = carried[1:-1, 1:-1]
    xx = (carried[1:-1, 2:] - 2.0 * inner + carried[1:-1, :-2]) / step_um[0] ** 2
    yy = (carried[2:, 1:-1] - 2.0 * inner + carried[:-2, 1:-1]) / step_um[1] ** 2
    mixed = carried[2:, 2:] - carried[2:, :-2] - carried[:-2, 2:] + carried[:-2, :-2]
    xy = mixed / (4.0 * step_um[0] * step_um[1])
    # Along (c, s) it is c² xx + 2 c s xy + s² yy.
    size = np.hypot(xx[..., 0], xx[..., 1]), np.hypot(yy[..., 0], yy[..., 1]), np.hypot(xy[..., 0], xy[..., 1])
    bend = np.maximum(size[0], size[1]) + size[2]
    return np.asarray(maximum_filter(np.nan_to_num(bend, nan=0.0), size=3, mode="nearest"))
