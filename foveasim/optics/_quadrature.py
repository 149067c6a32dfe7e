"""
Quadrature over pupils with known edges.

The integrand, amplitude times phase factor, is smooth between the edges. The pupil is integrated along rows: by Gauss-Legendre
rules between the edges that a row crosses, then across the rows. As a function of the row, the integral along a row is smooth
between the ends and intersections of edges. It has a square root where a row touches a circle, which the substitution
``y = sin t`` removes. The number of nodes follows from the highest frequency of the integrand, so that the error is the same
for weak and strong aberrations, and for near and far points of an image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, Ints, finite_array
from foveasim.errors import ParameterError

#: Complex amplitude at points (x, y) of the aperture.
Amplitude = Callable[[Floats, Floats], NDArray[np.complex128]]

#: Approximate number of nodes of an interval between two curves.
NODES_PER_INTERVAL = 8
#: Relative error of an integral over an interval.
ACCURACY = 1e-9
#: Largest number of nodes from the remainder of a Gauss rule; beyond it, the number is :data:`NODES_PER_RADIAN` times the phase
#: over half an interval, :data:`NODES_PER_ROOT` times its cube root, and a constant.
MAX_SMALL_RULE, NODES_PER_RADIAN, NODES_PER_ROOT, NODES_AT_LEAST = 24, 0.55, 2.0, 5.0
#: Rate of convergence in bands that touch a circle.
TANGENT_RHO = 2.5
#: Ratio of the lengths of consecutive bands towards a circle that they do not touch.
GRADING = 3.0
#: Largest number of bands towards a tangent.
MAX_GRADES = 40
#: Distances below which points coincide, in aperture radii.
COINCIDENT = 1e-13
#: Distance from an edge at which the amplitudes on both sides are compared, and the smallest difference of an edge.
SIDE, MIN_STEP = 1e-10, 1e-6
#: Nodes and crossings per block, which limits memory.
BLOCK_SIZE = 1 << 20


@dataclass(frozen=True, eq=False, kw_only=True)
class PupilEdges:
    """
    Curves at which a pupil, or its derivative, may be discontinuous.

    Curves without a discontinuity are permitted. The unit circle is always an edge. All lengths are in aperture radii.

    Parameters
    ----------
    segments : (n, 2, 2) array
        Ends (x, y) of straight edges.
    radii : sequence
        Radii of circles around the axis.
    lines_x, lines_y : sequence
        Positions x of lines parallel to the y axis, and positions y of lines parallel to the x axis, such as pixel edges.

    Raises
    ------
    ParameterError
        When an array has another shape or is not finite, or a radius is negative.
    """

    __repr__ = short_repr

    segments: ArrayLike = field(default_factory=lambda: np.zeros((0, 2, 2)))
    radii: ArrayLike = ()
    lines_x: ArrayLike = ()
    lines_y: ArrayLike = ()

    def __post_init__(self) -> None:
        segments = finite_array("segments", self.segments)
        if segments.ndim != 3 or segments.shape[1:] != (2, 2):
            raise ParameterError("segments", f"must have shape (n, 2, 2), got {segments.shape}")
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "radii", finite_array("radii", self.radii, ndim=1, at_least=0.0))
        for name in ("lines_x", "lines_y"):
            object.__setattr__(self, name, finite_array(name, getattr(self, name), ndim=1))


def joined(parts: Sequence[PupilEdges]) -> PupilEdges:
    """Return the edges of a product of pupils."""

    def of_all(name: str, start: Floats) -> Floats:
        return np.concatenate([start, *(np.asarray(getattr(part, name)) for part in parts)])

    segments = of_all("segments", np.zeros((0, 2, 2)))
    return PupilEdges(
        segments=segments[np.abs(segments[:, 1] - segments[:, 0]).max(axis=1) > COINCIDENT],
        radii=np.unique(of_all("radii", np.zeros(0))),
        lines_x=np.unique(of_all("lines_x", np.zeros(0))),
        lines_y=np.unique(of_all("lines_y", np.zeros(0))),
    )


@dataclass(frozen=True, eq=False)
class Nodes:
    """
    Nodes of a block of rows, with the index of the first node of each row.

    ``column_x``: positions of the nodes, if they are the same in all rows.
    """

    row_y: Floats
    first: Ints
    x: Floats
    y: Floats
    weight: Floats
    column_x: Floats | None = None


@dataclass(frozen=True, eq=False)
class Curves:
    """Edges of an integrand over the intersection of unit discs."""

    # x and y of the first and of the second end, (n_segment, 4).
    segments: Floats
    # x and y of the centre, and the radius, (n_circle, 3); of discs whose intersection is the domain, (n_disc, 3).
    circles: Floats
    lines_x: Floats
    lines_y: Floats
    discs: Floats

    @property
    def all_circles(self) -> Floats:
        """Circles and boundaries of discs."""
        return np.concatenate((self.circles, self.discs))

    def corners(self) -> tuple[Floats, Floats]:
        """Return rows of intersections of lines and circles, and rows that touch a circle."""
        circles = self.all_circles
        tangents = np.concatenate((circles[:, 1] - circles[:, 2], circles[:, 1] + circles[:, 2]))
        (x, y, r), at = circles.T[:, :, np.newaxis], self.lines_x
        rise = np.sqrt(np.maximum(r * r - (at - x) ** 2, 0.0))
        is_cut = np.abs(at - x) < r
        rows = [self.lines_y, (y + rise)[is_cut], (y - rise)[is_cut]]
        i, j = np.triu_indices(len(circles), 1)
        (x0, y0, r0), (x1, y1, r1) = circles[i].T, circles[j].T
        distance = np.hypot(x1 - x0, y1 - y0)
        is_cut = (distance < r0 + r1) & (distance > np.abs(r0 - r1)) & (distance > 0.0)
        x0, y0, r0, x1, y1, r1, distance = (part[is_cut] for part in (x0, y0, r0, x1, y1, r1, distance))
        along = (distance**2 + r0**2 - r1**2) / (2.0 * distance)
        rise = np.sqrt(np.maximum(r0**2 - along**2, 0.0))
        rows += [y0 + (along * (y1 - y0) + side * rise * (x1 - x0)) / distance for side in (-1.0, 1.0)]
        return np.concatenate(rows), tangents

    def inner_columns(self) -> tuple[Ints, Ints]:
        """
        Return first and last of ``lines_x`` without edges between, per ``lines_y`` interval.

        Intervals are numbered from that before the first line. Without such columns, both are 0.
        """
        first, last = np.zeros((2, self.lines_y.size + 1), np.int64)
        if self.lines_x.size > 1 and self.lines_y.size > 1 and not len(self.segments) and not len(self.circles):
            (x, y, r), at = self.discs.T[:, np.newaxis], self.lines_y[:, np.newaxis]
            chord = np.sqrt(np.maximum(r * r - (at - y) ** 2, 0.0))
            chord = np.minimum(chord[1:], chord[:-1])
            first[1:-1] = np.searchsorted(self.lines_x, (x - chord).max(axis=1))
            last[1:-1] = np.searchsorted(self.lines_x, (x + chord).min(axis=1), side="right") - 1
            first[last <= first] = last[last <= first] = 0
        return first, last

    def effective_segments(self, transmission: Amplitude) -> Floats:
        """Return the pieces of segments at which the amplitude is discontinuous."""
        if not len(self.segments):
            return self.segments
        start, along = self.segments[:, :2], self.segments[:, 2:] - self.segments[:, :2]
        n = len(start)
        fractions = [np.zeros((n, 1)), np.ones((n, 1))]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = along[:, np.newaxis, 0] * along[:, 1] - along[:, np.newaxis, 1] * along[:, 0]
            offset = start - start[:, np.newaxis]
            fractions.append((offset[..., 0] * along[:, 1] - offset[..., 1] * along[:, 0]) / cross)
            for axis, lines in enumerate((self.lines_x, self.lines_y)):
                fractions.append((lines - start[:, [axis]]) / along[:, [axis]])
            # |start + t along - centre| = r
            from_centre = start[:, np.newaxis] - self.all_circles[:, :2]
            a = (along * along).sum(axis=1)[:, np.newaxis]
            b = (from_centre * along[:, np.newaxis]).sum(axis=2)
            c = (from_centre**2).sum(axis=2) - self.all_circles[:, 2] ** 2
            root = np.sqrt(b * b - a * c)
            fractions += [(-b - root) / a, (-b + root) / a]
        at = np.concatenate(fractions, axis=1)
        at = np.sort(np.where((at >= 0.0) & (at <= 1.0), at, 1.0), axis=1)
        low, high = at[:, :-1], at[:, 1:]
        which, k = np.nonzero(high - low > COINCIDENT)
        low, high = low[which, k], high[which, k]
        middle = start[which] + (0.5 * (low + high))[:, np.newaxis] * along[which]
        normal = SIDE * along[which][:, ::-1] * [-1.0, 1.0] / np.sqrt((along[which] ** 2).sum(axis=1))[:, np.newaxis]
        is_inside = ((middle[:, np.newaxis] - self.discs[:, :2]) ** 2).sum(axis=2) <= self.discs[:, 2] ** 2
        is_kept = is_inside.all(axis=1)
        if is_kept.any():
            beyond, before = middle[is_kept] + normal[is_kept], middle[is_kept] - normal[is_kept]
            step = np.abs(transmission(*beyond.T) - transmission(*before.T))
            is_kept[is_kept] = step > MIN_STEP
        which, low, high = which[is_kept], low[is_kept, np.newaxis], high[is_kept, np.newaxis]
        return np.concatenate((start[which] + low * along[which], start[which] + high * along[which]), axis=1)


@lru_cache(maxsize=256)
def gauss_nodes(n: int) -> tuple[Floats, Floats]:
    """Return the nodes and weights of Gauss-Legendre quadrature between -1 and 1."""
    from scipy.special import roots_legendre

    node, weight = roots_legendre(n)
    return np.asarray(node), np.asarray(weight)


@lru_cache(maxsize=1)
def _largest_phases() -> Floats:
    """Return the half phase that 0, 1, ... Gauss nodes integrate to :data:`ACCURACY`."""
    n = np.arange(1, MAX_SMALL_RULE + 1)
    # The remainder of n nodes for exp(i k t) is k^(2n) 2^(2n+1) (n!)^4 / ((2n+1) ((2n)!)^3) at most, and the integral is 2.
    factorials = np.cumsum(np.log(np.arange(1, 2 * MAX_SMALL_RULE + 1)))
    log_rest = 2 * n * np.log(2.0) + 4.0 * factorials[n - 1] - np.log(2 * n + 1) - 3.0 * factorials[2 * n - 1]
    return np.asarray(np.concatenate(([0.0], np.exp((np.log(ACCURACY) - log_rest) / (2 * n)))))


def _n_nodes(phase: Floats, rho: Floats | float = np.inf) -> Ints:
    """
    Return the number of Gauss nodes of intervals.

    ``phase``: change of the phase over half of each interval, in radians. ``rho``: sum of the semi-axes of the ellipse, with
    foci at the ends of an interval of half length 1, in which the integrand is analytic. The error decreases as ``rho ** (-2
    n)``: Trefethen, Approximation Theory and Approximation Practice, chapter 19.
    """
    small = np.searchsorted(_largest_phases(), phase)
    large = np.ceil(NODES_PER_RADIAN * phase + NODES_PER_ROOT * np.cbrt(phase) + NODES_AT_LEAST)
    n = np.where(small <= MAX_SMALL_RULE, small, large)
    n = np.maximum(n + np.ceil(-0.5 * np.log(ACCURACY) / np.log(rho)), 1.0).astype(np.int64)
    # Few different rules: in steps of a sixteenth of the next power of two.
    step = np.maximum(2 ** np.maximum(np.ceil(np.log2(n)) - 4.0, 0.0), 1.0).astype(np.int64)
    return np.asarray(-(-n // step) * step)


def _expand(centre: Floats, half: Floats, n: Ints) -> tuple[Ints, Floats, Floats]:
    """Return the interval, position and weight of the Gauss nodes of intervals."""
    sizes, of_interval = np.unique(n, return_inverse=True)
    rules = [gauss_nodes(int(size)) for size in sizes]
    begin = np.concatenate(([0], np.cumsum(sizes)[:-1])).astype(np.int64)
    interval = np.repeat(np.arange(n.size), n)
    local = np.arange(interval.size) - np.repeat(np.cumsum(n) - n, n)
    at = begin[of_interval][interval] + local
    node, weight = (np.concatenate([rule[k] for rule in rules]) if rules else np.zeros(0) for k in (0, 1))
    return interval, centre[interval] + half[interval] * node[at], half[interval] * weight[at]


def _graded(corners: Floats, tangents: Floats) -> Floats:
    """Return bounds of bands between corners, shorter towards tangents outside a band."""
    cuts, ordered = [corners], np.sort(tangents)
    is_tangent = _coincides(corners, ordered)
    width = np.diff(corners)
    for end, sign, is_touching in ((corners[:-1], -1.0, is_tangent[:-1]), (corners[1:], 1.0, is_tangent[1:])):
        at = np.searchsorted(ordered, end) - (sign < 0.0)
        is_near = (at >= 0) & (at < ordered.size) & ~is_touching
        gap = np.abs(ordered[np.clip(at, 0, ordered.size - 1)] - end)
        for k in range(1, MAX_GRADES):
            distance = gap * GRADING**k - gap
            is_near &= distance < width
            if not is_near.any():
                break
            cuts.append((end - sign * distance)[is_near])
    return _distinct(np.concatenate(cuts))


def _coincides(values: Floats, ordered: Floats) -> Bools:
    """Return whether each value coincides with one of ascending values."""
    at = np.searchsorted(ordered, values - COINCIDENT)
    return np.asarray((at < ordered.size) & (ordered[np.minimum(at, ordered.size - 1)] - values < COINCIDENT))


def _gap(low: Floats, high: Floats, ordered: Floats) -> Floats:
    """Return the distance of each band from the nearest of ascending values outside it."""
    below, above = np.searchsorted(ordered, low, side="right") - 1, np.searchsorted(ordered, high)
    gap_below = np.where(below >= 0, low - ordered[np.maximum(below, 0)], np.inf)
    gap_above = np.where(above < ordered.size, ordered[np.minimum(above, ordered.size - 1)] - high, np.inf)
    return np.maximum(np.minimum(gap_below, gap_above), COINCIDENT)


def _rows(curves: Curves, segments: Floats, corners: Floats, tangents: Floats, radians: float) -> list[Floats]:
    """Return position and weight of rows, and the ends of the band of each."""
    bounds = _graded(corners, tangents)
    low, high = bounds[:-1], bounds[1:]
    half = 0.5 * (high - low)
    is_tangent = _coincides(bounds, np.sort(tangents))
    is_round = is_tangent[:-1] | is_tangent[1:]
    # The phase at an edge changes along its arc: the ends of an edge in the band differ in x by ``run``.
    _, y, r = curves.all_circles.T

    def chord(at: Floats) -> Floats:
        return np.sqrt(np.maximum(r * r - (at[:, np.newaxis] - y) ** 2, 0.0))

    run = 0.5 * np.pi * np.abs(chord(high) - chord(low)).max(axis=1)
    if len(segments):
        (x0, y0, x1, y1), middle = segments.T, 0.5 * (low + high)[:, np.newaxis]
        is_crossed = (np.minimum(y0, y1) < middle) & (np.maximum(y0, y1) > middle)
        slope = np.where(is_crossed, np.abs(x1 - x0) / np.maximum(np.abs(y1 - y0), COINCIDENT), 0.0).max(axis=1)
        run = np.maximum(run, slope * (high - low))
    arc = np.hypot(np.where(is_round, 0.5 * np.pi, 1.0) * half, 0.5 * run)
    # Square roots at tangents outside a band.
    z = 1.0 + _gap(low, high, np.sort(tangents)) / half
    rho = np.where(is_round, TANGENT_RHO, z + np.sqrt(z * z - 1.0))
    n = _n_nodes(radians * arc, rho)
    band, at, weight = _expand(np.zeros(half.size), np.ones(half.size), n)
    # y = centre + half sin t
    angle = 0.5 * np.pi * at
    is_round = is_round[band]
    weight = half[band] * weight * np.where(is_round, 0.5 * np.pi * np.cos(angle), 1.0)
    row_y = 0.5 * (low + high)[band] + half[band] * np.where(is_round, np.sin(angle), at)
    return [row_y, weight, low[band], high[band]]


def _distinct(values: Floats) -> Floats:
    """Return ascending values that do not coincide."""
    values = np.sort(values)
    return values[np.concatenate(([True], np.diff(values) > COINCIDENT))]


def nodes_of(curves: Curves, transmission: Amplitude, radians: float) -> Iterator[Nodes]:
    """
    Yield the nodes of a quadrature over the intersection of discs, in blocks of rows.

    ``transmission``: amplitude whose discontinuities the segments are. ``radians``: highest frequency of the integrand, in
    radians per radius.
    """
    segments = curves.effective_segments(transmission)
    corners, tangents = curves.corners()
    corners = np.concatenate((corners, tangents, segments[:, 1], segments[:, 3]))
    low, high = (curves.discs[:, 1] - curves.discs[:, 2]).max(), (curves.discs[:, 1] + curves.discs[:, 2]).min()
    if high - low < COINCIDENT:
        return
    inner = corners[(corners > low + COINCIDENT) & (corners < high - COINCIDENT)]
    rows = _rows(curves, segments, _distinct(np.concatenate(([low], inner, [high]))), tangents, radians)
    yield from _columns(curves, radians)
    n_curves = len(segments) + 2 * len(curves.circles) + curves.lines_x.size + 2
    n_together = max(1, int(BLOCK_SIZE / (NODES_PER_INTERVAL * n_curves + radians)))
    for begin in range(0, rows[0].size, n_together):
        yield _block(curves, segments, [part[begin : begin + n_together, np.newaxis] for part in rows], radians)


def _columns(curves: Curves, radians: float) -> Iterator[Nodes]:
    """Yield the nodes of rectangles that no edge crosses: products of two rules, faster."""
    first, last = curves.inner_columns()
    if not last.any():
        return
    (column, x, x_weight), (band, y, y_weight) = (
        _expand(0.5 * (lines[1:] + lines[:-1]), 0.5 * np.diff(lines), _n_nodes(0.5 * radians * np.diff(lines)))
        for lines in (curves.lines_x, curves.lines_y)
    )
    n_together = max(1, BLOCK_SIZE // x.size)
    for begin in range(0, y.size, n_together):
        rows = slice(begin, begin + n_together)
        at = band[rows, np.newaxis] + 1
        is_inside = (column >= first[at]) & (column < last[at])
        row_y = y[rows]
        yield Nodes(
            row_y,
            np.arange(row_y.size + 1) * x.size,
            np.tile(x, row_y.size),
            np.repeat(row_y, x.size),
            (np.outer(y_weight[rows], x_weight) * is_inside).ravel(),
            x,
        )


def _block(curves: Curves, segments: Floats, rows: list[Floats], radians: float) -> Nodes:
    """Return the nodes of rows, given by position, weight, and the ends of their bands."""
    y, row_weight, low, high = rows

    def half_chord(circles: Floats) -> Floats:
        return np.sqrt(np.maximum(circles[:, 2] ** 2 - (y - circles[:, 1]) ** 2, 0.0))

    left = (curves.discs[:, 0] - half_chord(curves.discs)).max(axis=1, keepdims=True)
    right = (curves.discs[:, 0] + half_chord(curves.discs)).min(axis=1, keepdims=True)
    reach = half_chord(curves.circles)
    (x0, y0, x1, y1), middle = segments.T, 0.5 * (low + high)
    is_crossed: Bools = (np.minimum(y0, y1) < middle) & (np.maximum(y0, y1) > middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.where(is_crossed, x0 + (y - y0) * ((x1 - x0) / (y1 - y0)), left)
    cuts = np.concatenate(
        (
            left,
            right,
            np.where(reach > 0.0, curves.circles[:, 0] - reach, left),
            np.where(reach > 0.0, curves.circles[:, 0] + reach, left),
            crossing,
            np.broadcast_to(curves.lines_x, (y.size, curves.lines_x.size)),
        ),
        axis=1,
    )
    cuts = np.sort(np.clip(cuts, left, np.maximum(left, right)), axis=1)
    is_used = np.diff(cuts, axis=1) > COINCIDENT
    first, last = (part[np.searchsorted(curves.lines_y, y)] for part in curves.inner_columns())
    if last.any():  # without the nodes of _columns
        lines = curves.lines_x
        is_used &= ~((last > 0) & (cuts[:, :-1] > lines[first] - COINCIDENT) & (cuts[:, 1:] < lines[last] + COINCIDENT))
    row, k = np.nonzero(is_used)
    begin, end = cuts[row, k], cuts[row, k + 1]
    half = 0.5 * (end - begin)
    interval, x, weight = _expand(0.5 * (begin + end), half, _n_nodes(radians * half))
    row = row[interval]
    return Nodes(y[:, 0], np.searchsorted(row, np.arange(y.size + 1)), x, y[row, 0], weight * row_weight[row, 0])


def pupil_nodes(
    edges: PupilEdges,
    transmission: Amplitude,
    radians: float,
    centres: Sequence[tuple[float, float]] = ((0.0, 0.0),),
) -> Iterator[Nodes]:
    """
    Yield the nodes of a quadrature over a pupil, or over the overlap of several copies.

    ``centres``: centres of the copies. ``transmission``: that of their product. Others are as for :func:`nodes_of`.
    """
    yield from nodes_of(_curves(edges, centres), transmission, radians)


def _curves(edges: PupilEdges, centres: Sequence[tuple[float, float]]) -> Curves:
    """Return the edges of copies of a pupil around given centres."""
    segments, radii, lines_x, lines_y = (
        np.asarray(part) for part in (edges.segments, edges.radii, edges.lines_x, edges.lines_y)
    )
    return Curves(
        np.concatenate([(segments + centre).reshape(-1, 4) for centre in np.array(centres)]),
        np.array([[x, y, r] for x, y in centres for r in radii if 0.0 < r < 1.0]).reshape(-1, 3),
        np.unique(np.concatenate([lines_x + x for x, _ in centres])),
        np.unique(np.concatenate([lines_y + y for _, y in centres])),
        np.array([[x, y, 1.0] for x, y in centres]),
    )


def plane_waves(nodes: Nodes, values: NDArray[np.complex128], radians_x: Floats) -> NDArray[np.complex128]:
    """
    Return the sums ``sum_k values[k] exp(-i radians_x x[k])`` along each row of nodes.

    ``values``: (n_node,) complex128. ``radians_x`` (n_x,) float64, radians per radius: equidistant. Returns ``sums`` (n_row,
    n_x) complex128.
    """
    if nodes.column_x is not None:
        return np.asarray(values.reshape(nodes.row_y.size, -1) @ np.exp(-1j * np.outer(nodes.column_x, radians_x)))
    # Products of coarse and fine steps: far fewer exponentials than points.
    n_fine = math.isqrt(radians_x.size - 1) + 1
    coarse, fine = radians_x[::n_fine], radians_x[:n_fine] - radians_x[0]
    of_coarse = values[:, np.newaxis] * np.exp(-1j * np.outer(nodes.x, coarse))
    of_fine = np.exp(-1j * np.outer(nodes.x, fine))
    sums = np.empty((nodes.row_y.size, radians_x.size), np.complex128)
    for row, (begin, end) in enumerate(zip(nodes.first[:-1], nodes.first[1:], strict=True)):
        sums[row] = (of_coarse[begin:end].T @ of_fine[begin:end]).ravel()[: radians_x.size]
    return sums
