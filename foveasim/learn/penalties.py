"""Penalties that keep optimised outlines within design rules."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import shapely
import torch
from torch import Tensor

from foveasim._core.calls import POSITIVE, Limits
from foveasim._core.rings import positions_in_runs
from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.errors import ParameterError
from foveasim.layout import DesignRules
from foveasim.layout.drc import RULES
from foveasim.learn._tensors import as_array
from foveasim.learn.mesh import Mesh
from foveasim.learn.outlines import Outlines

__all__ = ["barrier"]

#: Edges below this length are points.
MIN_EDGE_UM = 1e-6
#: Angle above the limit of facing edges, in degrees, at which their distance begins to count.
ANGLE_MARGIN_DEG = 6.0
#: Relative difference of area below which two rectangles count as equal.
AREA_ROUNDING = 1e-9
#: Rules that do not depend on the positions of points which outlines share.
CONSTANT_RULES = ("max_sites", "max_data_rate_gbit_per_s", "max_overlap_um2", "max_gap_um2")


def barrier(
    points: Tensor,
    outlines: Outlines | Mesh,
    rules: DesignRules,
    *,
    weight: Annotated[float, POSITIVE] = 1.0,
    margin_fraction: Annotated[float, POSITIVE] = 0.1,
    quadratic_fraction: Annotated[float, Limits(above=0.0, at_most=1.0)] = 0.05,
    convex: bool = False,
) -> Tensor:
    """
    Compute a penalty that is zero within design rules and grows towards their limits.

    Each measured value has a clearance g: zero at the limit, positive within the rule, and relative to the limit. The penalty
    is the sum of ``-weight (1 - u)² ln(u)`` over all clearances with u = g / margin below 1: it begins smoothly (C²) at u = 1,
    and equals ``weight ln(1/u)`` for small u. Below ``quadratic_fraction`` it continues as a parabola with the same slope and
    curvature, also for violations: layouts that violate rules have finite gradients, towards satisfying them.

    Parameters
    ----------
    points : (n_point, 2) tensor, µm
        Positions of the points of the outlines, such as ``mesh()``.
    outlines : Outlines or Mesh
        Sites as polygons between the points.
    rules : DesignRules
        Limits of ``min_size_um``, ``max_size_um``, ``min_area_um2``, ``min_width_um``, ``min_angle_deg``, ``max_aspect_ratio``
        and ``max_neighbour_ratio``. Ignored are waived rules, and those that do not depend on positions as long as outlines
        share their points: ``max_sites``, ``max_data_rate_gbit_per_s``, ``max_overlap_um2``, ``max_gap_um2``.
    weight : float
        Factor of the penalty; lengths and areas have no influence on its scale.
    margin_fraction : float
        Clearance below which the penalty begins.
    quadratic_fraction : float
        Fraction of the margin below which the penalty is a parabola. Small values are steep.
    convex : bool
        Whether outlines are also to be strictly convex: the clearance is the sine of the turning angle at each corner.

    Returns
    -------
    penalty : 0-dim tensor
        Differentiable in the points.

    Raises
    ------
    ParameterError
        When another rule has a limit, or a limit is one that no site satisfies.

    Notes
    -----
    Measurements are those of :meth:`foveasim.Layout.check`, with these differences. All widths of a site count, not only the
    smallest one, so that gradients have no kinks where two are equal. Distances between edges count gradually from 6 degrees
    above ``rules.angle_limit_deg``, and corners below this limit violate ``min_width_um``. Outlines are not rounded. Edges
    shorter than 1e-6 µm, as those of :class:`PowerCells`, are ignored. The rectangle of least area, for the aspect ratio, has a
    direction that may change abruptly between edges of the site.
    Clearances of ratios are relative to the distance of the limit from 1, and neighbours are sites that share an edge between
    two points.

    The penalty does not prevent steps across a limit: take small steps, and :meth:`Mesh.limit_step` for valid outlines. A
    penalty of zero implies that the supported rules are satisfied. In equilibrium with a loss, a rule may be violated
    slightly: increase the weight, or check the final layout.

    Examples
    --------
    >>> import foveasim as fs
    >>> mesh = fs.learn.Mesh(fs.layout.grid(2, 2, 1.0))
    >>> barrier(
    ...     mesh(),
    ...     mesh,
    ...     fs.DesignRules(min_width_um=0.5, angle_limit_deg=60.0),
    ...     convex=True,
    ... ).item()
    0.0
    >>> round(barrier(mesh(), mesh, fs.DesignRules(min_size_um=0.98)).item(), 4)
    1.2239
    """
    if isinstance(outlines, Mesh):
        outlines = outlines.outlines
    points = outlines.check_points(points)
    limits = _limits(rules)
    shape = _Shape(points, outlines, rules.angle_limit_deg)
    penalty = points.new_zeros(())
    for name, limit in limits.items():
        for clearance, factor in CLEARANCES[name](shape, limit, margin_fraction):
            penalty = penalty + (factor * _smooth_log(clearance / margin_fraction, quadratic_fraction)).sum()
    if convex:
        penalty = penalty + _smooth_log(shape.turning_sines() / margin_fraction, quadratic_fraction).sum()
    return weight * penalty


def _limits(rules: DesignRules) -> dict[str, float]:
    """Return the limits of the supported rules, if no others are set."""
    limits = {}
    for name, limit in rules.limits().items():
        if name in (rules.waivers or {}) or name in CONSTANT_RULES:
            continue
        if name not in CLEARANCES:
            supported = ", ".join(f"'{each}'" for each in CLEARANCES)
            raise ParameterError(
                "rules", f"must have limits of {supported} only, got '{name}'",
                hint="remove it with rules.only, waive it, or repair the final layout",
            )  # fmt: skip
        above = 1.0 if RULES[name].unit == "" else 0.0
        if limit > above:
            limits[name] = float(limit)
        elif RULES[name].is_upper:
            raise ParameterError("rules", f"must have a limit '{name}' above {above:g}", limit)
    return limits


def _smooth_log(u: Tensor, start: float) -> Tensor:
    """Return ``-(1 - u)² ln(u)`` from ``start`` to 1, 0 above, and its Taylor parabola below."""
    log = math.log(start)
    value = -((1.0 - start) ** 2) * log
    slope = 2.0 * (1.0 - start) * log - (1.0 - start) ** 2 / start
    curvature = -2.0 * log + 4.0 * (1.0 - start) / start + (1.0 - start) ** 2 / start**2
    safe = u.clamp(start, 1.0)
    below = (u - start).clamp(max=0.0)
    inside = -((1.0 - safe) ** 2) * torch.log(safe)
    parabola = value + slope * below + 0.5 * curvature * below**2
    return torch.where(u < start, parabola, inside)


#: Clearances (n,) and their factors, (n,) or 1.
Clearances = Iterator[tuple[Tensor, Tensor | float]]


class _Segment(NamedTuple):
    """Edges between points, (n, 2)."""

    begin: Tensor
    end: Tensor

    @property
    def unit(self) -> Tensor:
        """Unit vectors along the edges."""
        return _unit(self.end - self.begin)

    def left_of(self, other: _Segment) -> _Segment:
        """Return the parts to the left of the lines through other edges, which each have one."""
        along = other.end - other.begin
        left = [_cross(along, point - other.begin) for point in self]
        step = left[0] - left[1]
        t = left[0] / torch.where(step == 0.0, torch.ones_like(step), step)
        crossing = self.begin + t[:, None] * (self.end - self.begin)
        is_behind = [(side < 0.0)[:, None] for side in left]
        return _Segment(*(torch.where(behind, crossing, point) for behind, point in zip(is_behind, self, strict=True)))

    def end_distances(self, other: _Segment) -> Tensor:
        """Return the distances of the end points of each of two edges from the other one, (n, 4)."""
        return torch.stack([one.distance(point) for one, two in ((self, other), (other, self)) for point in two], dim=1)

    def distance(self, point: Tensor) -> Tensor:
        """Return the distances of points from the edges, (n,)."""
        along = self.end - self.begin
        length2 = (along * along).sum(dim=1).clamp(min=torch.finfo(along.dtype).tiny)
        t = (((point - self.begin) * along).sum(dim=1) / length2).clamp(0.0, 1.0)
        return _length(point - self.begin - t[:, None] * along)


@dataclass(eq=False)
class _Shape:
    """Measured quantities of outlines as tensors, and selections of vertices as arrays."""

    points: Tensor
    outlines: Outlines
    angle_limit_deg: float

    @cached_property
    def area_um2(self) -> Tensor:
        """Area of each site, (n_site,)."""
        return self.outlines.area_um2(self.points)

    @cached_property
    def xy(self) -> Tensor:
        """Position of each vertex, (n_vertex, 2)."""
        return self.points[torch.from_numpy(np.array(self.outlines.vertex))]

    @cached_property
    def xy_um(self) -> Floats:
        """Numbers of :attr:`xy`."""
        return as_array(self.xy).astype(np.float64)

    @cached_property
    def ends(self) -> tuple[Ints, Ints]:
        """
        Nearest vertices at other positions before and after each vertex, (n_vertex,) each.

        Equal to the adjacent vertices where no edge has zero length.
        """
        after, before = np.array(self.outlines.edges.after), np.array(self.outlines.edges.before)
        for neighbour, step in ((after, self.outlines.edges.after), (before, self.outlines.edges.before)):
            for _ in range(int(np.diff(self.outlines.ring_offsets).max())):
                is_same = np.abs(self.xy_um[neighbour] - self.xy_um).max(axis=1) < MIN_EDGE_UM
                if not is_same.any():
                    break
                neighbour[is_same] = step[neighbour[is_same]]
        return before, after

    @cached_property
    def is_distinct(self) -> Bools:
        """Whether the vertex after each one is at another position, (n_vertex,)."""
        return np.asarray(self.ends[1] == self.outlines.edges.after)

    def at(self, vertices: Ints) -> Tensor:
        """Return the positions of vertices."""
        return self.xy[torch.from_numpy(np.array(vertices))]

    def turns(self) -> tuple[Tensor, Tensor]:
        """Return cross and dot products of the unit edges at each distinct corner."""
        corner = np.flatnonzero(self.is_distinct)
        before, after = self.ends
        here = self.at(corner)
        into, out = _unit(here - self.at(before[corner])), _unit(self.at(after[corner]) - here)
        return _cross(into, out), (into * out).sum(dim=1)

    def turning_sines(self) -> Tensor:
        """Return the sine of the turning angle at each corner of outer rings, negative if reflex."""
        is_outer = np.zeros(self.outlines.ring_offsets.size - 1, bool)
        is_outer[self.outlines.site_offsets[:-1]] = True
        of_ring = np.repeat(is_outer, np.diff(self.outlines.ring_offsets))[self.is_distinct]
        return self.turns()[0][torch.from_numpy(of_ring)]

    @cached_property
    def pairs(self) -> tuple[Ints, Ints]:
        """Edges, by their first vertex, and vertices of the same site, all combinations."""
        first = self.outlines.ring_offsets[self.outlines.site_offsets]
        size = np.diff(first)
        edge = np.repeat(np.arange(first[-1]), np.repeat(size, size))
        vertex = np.repeat(first[:-1], size**2) + positions_in_runs(np.repeat(size, size))
        is_edge = self.is_distinct[edge]
        return edge[is_edge], vertex[is_edge]

    @cached_property
    def unit_um(self) -> Floats:
        """Unit vectors along the edges, (n_vertex, 2); arbitrary for edges of zero length."""
        along = self.xy_um[self.outlines.edges.after] - self.xy_um
        return along / np.maximum(np.hypot(along[:, 0], along[:, 1]), MIN_EDGE_UM)[:, np.newaxis]

    def across_um(self, edge: Ints, vertex: Ints) -> Floats:
        """Return the distance of vertices to the left of the lines through edges."""
        unit, to = self.unit_um[edge], self.xy_um[vertex] - self.xy_um[edge]
        return np.asarray(unit[:, 0] * to[:, 1] - unit[:, 1] * to[:, 0])

    def facing_edges(self, reach_um: float) -> tuple[Tensor, Tensor]:
        """
        Return distances of edges that face each other, four for each pair, and factors.

        They are those of the end points of one edge, as far as it is in front of the other one, from the other, and vice versa.
        Distances above ``reach_um`` may be missing.
        """
        begin, complete = (math.cos(math.radians(self.angle_limit_deg + extra)) for extra in (ANGLE_MARGIN_DEG, 0.0))
        edge, other = self.pairs
        after = self.outlines.edges.after
        is_pair = (edge < other) & self.is_distinct[other]
        edge, other = edge[is_pair], other[is_pair]
        is_pair = (self.ends[1][edge] != other) & (self.ends[1][other] != edge)
        is_pair &= -(self.unit_um[edge] * self.unit_um[other]).sum(axis=1) > begin
        is_pair &= np.maximum(self.across_um(edge, other), self.across_um(edge, after[other])) > 0.0
        is_pair &= np.maximum(self.across_um(other, edge), self.across_um(other, after[edge])) > 0.0
        one, two = (_Segment(self.at(each), self.at(after[each])) for each in (edge[is_pair], other[is_pair]))
        distances = [one.end_distances(two.left_of(one)), two.end_distances(one.left_of(two))]
        is_first = distances[0].amin(dim=1) >= distances[1].amin(dim=1)
        distance = torch.where(is_first[:, None], *distances).T.reshape(-1)
        cosine = -(one.unit * two.unit).sum(dim=1)
        t = ((cosine - begin) / (complete - begin)).clamp(0.0, 1.0)
        is_near = torch.from_numpy(as_array(distance) < reach_um)
        return distance[is_near], (t * t * (3.0 - 2.0 * t)).repeat(4)[is_near]

    def aspect_ratios(self) -> Tensor:
        """Return the aspect ratio of the minimum-area rectangle around each site."""
        begin, end, vertex, owner = self._hull_pairs()
        unit = self.xy_um[end] - self.xy_um[begin]
        unit /= np.hypot(unit[:, 0], unit[:, 1])[:, np.newaxis]
        to = self.xy_um[vertex] - self.xy_um[begin]
        along, across = (unit * to).sum(axis=1), unit[:, 0] * to[:, 1] - unit[:, 1] * to[:, 0]
        last, first = _extremes(along, owner)
        top, bottom = _extremes(across, owner)
        length, depth = along[last] - along[first], across[top] - across[bottom]
        area, ratio = length * depth, np.maximum(length, depth) / np.minimum(length, depth)
        site = self.outlines.edges.site[begin[last]]
        smallest = np.full(self.outlines.n_sites, np.inf)
        np.minimum.at(smallest, site, area)
        # Of rectangles of equal area, the least elongated counts.
        is_least = area <= (1.0 + AREA_ROUNDING) * smallest[site]
        order = np.lexsort((ratio, ~is_least, site))
        chosen = order[np.flatnonzero(np.diff(site[order], prepend=-1))]
        rows = last[chosen]
        direction = _unit(self.at(end[rows]) - self.at(begin[rows]))
        extent = self.at(vertex[rows]) - self.at(vertex[first[chosen]])
        height = self.at(vertex[top[chosen]]) - self.at(vertex[bottom[chosen]])
        found = (direction * extent).sum(dim=1) / _cross(direction, height)
        return torch.maximum(found, 1.0 / found)

    def _hull_pairs(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Return begin, end, vertex and number of hull edges, with all vertices of their sites."""
        first = self.outlines.ring_offsets[self.outlines.site_offsets]
        site = np.repeat(np.arange(self.outlines.n_sites), np.diff(first))
        hulls = shapely.convex_hull(shapely.multipoints(self.xy_um, indices=site))
        corners, of = shapely.get_coordinates(hulls, return_index=True)
        # Corners of hulls are vertices: find them by site and position.
        key = np.concatenate((np.column_stack((site, self.xy_um)), np.column_stack((of, corners)))) + 0.0
        _, found, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
        vertex = found[index.ravel()[site.size :]]
        is_edge = np.flatnonzero(of[:-1] == of[1:])
        begin, end = vertex[is_edge], vertex[is_edge + 1]
        size = np.diff(first)[of[is_edge]]
        owner = np.repeat(np.arange(begin.size), size)
        return begin[owner], end[owner], first[:-1][of[is_edge]][owner] + positions_in_runs(size), owner

    def neighbours(self) -> tuple[Ints, Ints]:
        """Return pairs of sites with a common edge."""
        edges = self.outlines.edges
        order = np.flatnonzero(self.is_distinct)
        order = order[np.argsort(edges.edge[order], kind="stable")]
        number = edges.edge[order]
        twin = np.flatnonzero(number[1:] == number[:-1])
        pairs = np.sort(np.stack((edges.site[order[twin]], edges.site[order[twin + 1]])), axis=0)
        first, second = np.unique(pairs[:, pairs[0] != pairs[1]], axis=1)
        return first, second


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _length(vectors: Tensor) -> Tensor:
    """Return lengths, with a finite gradient at zero."""
    return (vectors * vectors).sum(dim=1).clamp(min=1e-24).sqrt()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / _length(vectors)[:, None]


def _extremes(values: Floats, group: Ints) -> tuple[Ints, Ints]:
    """Return the rows of the largest and of the smallest value of each contiguous group."""
    order = np.lexsort((values, group))
    ends = np.flatnonzero(np.diff(group, append=-1))
    starts = np.concatenate(([0], ends[:-1] + 1)) if ends.size else ends
    return order[ends], order[starts]


def _min_size(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:  # noqa: ARG001
    yield shape.area_um2 / limit**2 - 1.0, 1.0


def _max_size(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:  # noqa: ARG001
    yield 1.0 - shape.area_um2 / limit**2, 1.0


def _min_area(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:  # noqa: ARG001
    yield shape.area_um2 / limit - 1.0, 1.0


def _min_width(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:
    distance, factor = shape.facing_edges((1.0 + margin_fraction) * limit)
    yield distance / limit - 1.0, factor
    yield from _min_angle(shape, shape.angle_limit_deg, margin_fraction)


def _min_angle(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:  # noqa: ARG001
    sine, cosine = shape.turns()
    yield (math.pi - torch.atan2(sine, cosine)) / math.radians(limit) - 1.0, 1.0


def _max_aspect_ratio(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:  # noqa: ARG001
    yield (limit - shape.aspect_ratios()) / (limit - 1.0), 1.0


def _max_neighbour_ratio(shape: _Shape, limit: float, margin_fraction: float) -> Clearances:  # noqa: ARG001
    first, second = (shape.area_um2[torch.from_numpy(each.copy())] for each in shape.neighbours())
    # The ratio of areas is finite as long as one of them is positive.
    ratio = torch.minimum(first, second) / torch.maximum(first, second)
    yield (ratio - limit**-2) / (1.0 - limit**-2), 1.0


#: Clearances of the supported rules.
CLEARANCES: dict[str, Callable[[_Shape, float, float], Clearances]] = {
    "min_size_um": _min_size,
    "max_size_um": _max_size,
    "min_area_um2": _min_area,
    "min_width_um": _min_width,
    "min_angle_deg": _min_angle,
    "max_aspect_ratio": _max_aspect_ratio,
    "max_neighbour_ratio": _max_neighbour_ratio,
}
