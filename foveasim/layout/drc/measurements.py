"""Measurements of the design rules, and the table of all rules."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.registry import Registry
from foveasim._core.rings import next_vertex, positions_in_runs, ring_area_um2
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.layout._noding import intersections, node_edges
from foveasim.layout.adjacency import TOUCHING_UM, adjacency, near_boxes
from foveasim.layout.database_grid import DEFAULT_DBU_UM, has_valid_outlines, on_grid, to_um
from foveasim.layout.drc.routing import Readout, Routing, track_demand
from foveasim.layout.model import Layout, layout_of, without_repeats

if TYPE_CHECKING:
    from foveasim.layout.drc.rules import DesignRules

__all__ = ["RULES", "Case", "Measurement", "Rule", "is_below_size", "min_width_um"]

#: Tolerance of length comparisons: a thousandth of the finest manufacturing grid (1 nm).
LENGTH_ROUNDING_UM = 1e-6
#: Overlaps and gaps below this fraction of a site's area are due to the rounding of its vertices.
AREA_ROUNDING = 1e-9
#: A selection of fewer than one site in SMALL_SELECTION_RATIO is converted to polygons separately, without all other sites.
SMALL_SELECTION_RATIO = 10
#: Overlaps and gaps with a mean width of fewer database units are due to the rounding of vertices.
SLIVER_WIDTH = 0.36
#: Angles within this difference of their cosines are not below a limit.
ANGLE_ROUNDING = 1e-10
#: Pairs, and sites, per task of a thread.
PAIRS_PER_TASK, SITES_PER_TASK = 100_000, 10_000


@dataclass(frozen=True, slots=True)
class Contacts:
    """
    Pairs of nearby sites and their distances, ordered by the first site, then the second.

    ``first`` < ``second`` (n_pair,). ``distance_um`` (n_pair,): 0 for overlapping sites, infinite beyond the requested
    distance. ``is_non_overlapping`` (n_pair,): whether the two certainly do not overlap, apart from rounding. ``is_shared``
    (n_vertex,): whether the edge that begins at a vertex is also, bit for bit, an edge of another site.
    """

    first: Ints
    second: Ints
    distance_um: Floats
    is_non_overlapping: Bools
    is_shared: Bools

    __repr__ = short_repr

    def sites_of(self, pairs: Any) -> Ints:
        """Return the sites of the given pairs, (n, 2)."""
        return np.stack((self.first[pairs], self.second[pairs]), axis=1)


@dataclass(frozen=True)
class Case:
    """
    A layout and its rules, with cached quantities that several measurements share.

    ``layout`` is as drawn: sizes, ratios and counts. ``mask`` is as manufactured: distances, angles, overlaps and gaps.
    """

    layout: Layout
    rules: DesignRules

    __repr__ = short_repr

    @cached_property
    def _on_grid(self) -> tuple[Layout, Ints]:
        """The mask, and the sites without a valid outline on the grid, which it has as drawn."""
        snapped = on_grid(self.layout, self.rules.dbu_um)
        if snapped is self.layout:
            return snapped, np.zeros(0, np.int64)
        lost = np.flatnonzero(~has_valid_outlines(snapped))
        xy_um = snapped.xy_um
        if lost.size:
            first = self.layout.ring_offsets[self.layout.site_offsets]
            is_lost = np.repeat(np.isin(np.arange(self.layout.n_sites), lost), np.diff(first))
            xy_um = np.where(is_lost[:, np.newaxis], self.layout.xy_um, xy_um)
        return layout_of(*without_repeats(xy_um, self.layout.ring_offsets), self.layout.site_offsets), lost

    @property
    def mask(self) -> Layout:
        """The sites with vertices on the database grid, as files contain them."""
        return self._on_grid[0]

    @property
    def lost_sites(self) -> Ints:
        """Sites that collapse or cross themselves on the database grid."""
        return self._on_grid[1]

    @cached_property
    def die_um(self) -> Floats:
        """The die on the database grid, (4,)."""
        return to_um(np.rint(np.asarray(self.rules.die_um) / self.rules.dbu_um), self.rules.dbu_um)

    @cached_property
    def polygons(self) -> NDArray[Any]:
        """The sites of the mask as shapely polygons."""
        return self.mask.polygons()

    def shapes(self, sites: Ints) -> NDArray[Any]:
        """Return the given sites of the mask as shapely polygons."""
        return (
            self.mask[sites].polygons()
            if SMALL_SELECTION_RATIO * sites.size < self.layout.n_sites
            else self.polygons[sites]
        )

    def sites_near(self, box_um: Floats, reach_um: float = 0.0) -> tuple[Ints, Ints]:
        """
        Return pairs (box, site) whose bounding boxes are at most ``reach_um`` apart.

        The boxes have the shape (n, 4). The pairs are ordered by site.
        """
        n = self.layout.n_sites
        site, box = near_boxes(np.concatenate((self.mask.site_bounds_um, box_um)), reach_um)
        is_mixed = (site < n) & (box >= n)
        return box[is_mixed] - n, site[is_mixed]

    def sites_at(self, geometries: NDArray[np.object_], among: Bools, reach_um: float = 0.0) -> tuple[Ints, Ints]:
        """
        Return pairs (geometry, site) that are at most ``reach_um`` apart.

        Only sites flagged in ``among`` are considered. The pairs are ordered by site.
        """
        geometry, site = self.sites_near(shapely.bounds(geometries), reach_um)
        geometry, site = geometry[among[site]], site[among[site]]
        shapely.prepare(geometries)
        is_near = shapely.dwithin(geometries[geometry], self.shapes(site), reach_um)
        return geometry[is_near], site[is_near]

    @cached_property
    def after(self) -> Ints:
        """Next vertex of every vertex of the mask in its ring."""
        return next_vertex(self.mask.ring_offsets)

    @cached_property
    def first_vertex(self) -> Ints:
        """Index of the first vertex of every site of the mask, (n_site + 1,)."""
        return self.mask.ring_offsets[self.mask.site_offsets]

    @cached_property
    def contacts(self) -> Contacts:
        """All pairs of sites that may touch or violate ``min_space_um``."""
        from foveasim.layout import _kernels

        layout = self.mask
        reach_um = max(float(self.rules.min_space_um or 0.0), 2.0 * TOUCHING_UM)
        first, second = near_boxes(layout.site_bounds_um, reach_um)
        box = layout.site_bounds_um
        depth_um = AREA_ROUNDING * layout.area_um2 / np.hypot(box[:, 2] - box[:, 0], box[:, 3] - box[:, 1])
        overhang_um = _kernels.overhangs(layout.xy_um, self.after, self.first_vertex)
        is_shared = np.zeros(layout.xy_um.shape[0], bool)

        def find_contacts(piece: slice) -> tuple[Floats, Bools]:
            return _kernels.contacts(
                layout.xy_um, self.after, self.first_vertex, box, overhang_um, depth_um, first[piece], second[piece],
                reach_um, LENGTH_ROUNDING_UM, is_shared,
            )  # fmt: skip

        found = parallel_map(find_contacts, _task_slices(first.size, PAIRS_PER_TASK), thread_count())
        distance_um, is_non_overlapping = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return Contacts(first, second, distance_um, is_non_overlapping, is_shared)

    @cached_property
    def windows(self) -> tuple[Floats, Floats, Floats]:
        """
        Windows of the density rules.

        Lower left corners and upper right corners, (n, 2) µm, and the area covered by sites in each window, (n,) µm².
        """
        layout, window_um = self.layout, float(self.rules.density_window_um or 0.0)
        field = np.asarray(self.rules.die_um or (layout.bounds_um if layout.n_sites else (0.0, 0.0, 0.0, 0.0)))
        sides_um = np.minimum(window_um, field[2:] - field[:2])
        if sides_um.min() <= 0.0:
            return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
        starts, lines = [], []
        for i in (0, 1):
            # The last window of a row ends at the boundary of the die.
            free_um = field[i + 2] - field[i] - sides_um[i]
            n = math.ceil(free_um / (0.5 * sides_um[i]) - LENGTH_ROUNDING_UM) + 1
            starts.append(np.minimum(field[i] + 0.5 * sides_um[i] * np.arange(n), field[i + 2] - sides_um[i]))
            lines.append(np.unique(np.concatenate((starts[i], starts[i] + sides_um[i]))))
        total_um2 = np.zeros((lines[1].size, lines[0].size))
        total_um2[1:, 1:] = _filled_um2(layout, *lines).cumsum(axis=0).cumsum(axis=1)
        x, y = (index.ravel() for index in np.meshgrid(*starts))
        x0, x1 = np.searchsorted(lines[0], x), np.searchsorted(lines[0], x + sides_um[0])
        y0, y1 = np.searchsorted(lines[1], y), np.searchsorted(lines[1], y + sides_um[1])
        filled_um2 = total_um2[y1, x1] - total_um2[y0, x1] - total_um2[y1, x0] + total_um2[y0, x0]
        low = np.stack((x, y), axis=1)
        return low, low + sides_um, np.maximum(filled_um2, 0.0)


def _task_slices(n: int, per_task: int) -> list[slice]:
    """Return slices of pairs or sites for several threads."""
    return [slice(start, start + per_task) for start in range(0, max(n, 1), per_task)]


@dataclass(frozen=True, slots=True)
class Measurement:
    """
    Measured values, with functions that return their sites and markers, and a note.

    ``sites(positions)`` returns the sites of the values at some positions (site i by default), ``markers(positions)`` the
    marker geometries (those sites by default). Both are called for values that violate the rule only.
    """

    values: Floats
    sites: Callable[[Ints], Any] | None = None
    markers: Callable[[Ints], Any] | None = None
    note: str = ""

    __repr__ = short_repr


@dataclass(frozen=True, slots=True)
class Rule:
    """
    Design rule: measurement and comparison with the limit.

    Parameters
    ----------
    description : str
        Condition that a layout satisfies, for reports.
    unit : str
        Unit of values and limit.
    measure : callable
        Function from a :class:`Case` to one value per site, (n_site,), or to :class:`Measurement`.
    is_upper : bool
        Whether values above the limit are violations; otherwise values below it.
    is_deviation : bool
        Whether values are deviations, compared with 0; the limit is then a step or a field.
    rounding : float
        Values beyond the limit by no more than this satisfy the rule.
    repair : {"drop", "shrink", "merge", None}
        Repair of a violation: ``"drop"`` drops its site, or the smaller site of a pair; ``"shrink"`` cuts the outlines
        of a pair, or drops the smaller one; ``"merge"`` merges the site with a
        neighbour, or drops it; None where neither helps.
    """

    description: str
    unit: str
    measure: Callable[[Case], Measurement | Floats]
    is_upper: bool = False
    is_deviation: bool = False
    rounding: float = LENGTH_ROUNDING_UM
    repair: Literal["drop", "shrink", "merge"] | None = "drop"

    __repr__ = short_repr

    def excess(self, values: Floats, limit: float) -> Floats:
        """
        Return the distance of values beyond a limit, negative within it.

        A distance above ``rounding`` is a violation.
        """
        return values - limit if self.is_upper else limit - values


def _sizes(case: Case) -> Floats:
    return case.layout.size_um


def _areas(case: Case) -> Floats:
    return case.layout.area_um2


def _facing_um(case: Case, side: float, reach_um: float) -> Floats:
    """
    Return the smallest distance of facing edges of every site.

    ``side``: 1 across the site, -1 across the space outside.
    Coordinates are integers, in database units: right angles are exact.
    """
    from foveasim.layout import _kernels

    limit_deg, dbu_um = case.rules.angle_limit_deg, case.rules.dbu_um
    min_cosine = 0.0 if limit_deg == 90.0 else math.cos(math.radians(limit_deg)) + ANGLE_ROUNDING
    xy, first = np.rint(case.mask.xy_um / dbu_um), case.first_vertex

    def distances(piece: slice) -> Floats:
        ends = first[piece.start : piece.stop + 1]
        return _kernels.facing_distances(xy, case.after, ends, side, min_cosine, reach_um / dbu_um)

    found = parallel_map(distances, _task_slices(case.mask.n_sites, SITES_PER_TASK), thread_count())
    return np.concatenate(found) * dbu_um


def _widths(case: Case) -> Measurement:
    limit_um = float(case.rules.min_width_um or 0.0)
    width_um = _facing_um(case, 1.0, limit_um + case.rules.dbu_um)
    n_sharp = int(np.count_nonzero(width_um == 0.0))
    note = (
        f"{n_sharp} site{'s have' if n_sharp != 1 else ' has'} corners sharper than 'angle_limit_deg' "
        f"({case.rules.angle_limit_deg:g}), which have the width 0"
    )
    return Measurement(width_um, note=note if n_sharp and limit_um > 0.0 else "")


def _holes(case: Case) -> Measurement:
    mask = case.mask
    if mask.ring_offsets.size == mask.site_offsets.size:
        return Measurement(np.zeros(0))
    area_um2 = ring_area_um2(mask.xy_um, mask.ring_offsets)
    holes = np.flatnonzero(area_um2 < 0.0)
    site = np.searchsorted(mask.site_offsets, holes, side="right") - 1

    def markers(positions: Ints) -> list[Any]:
        starts, stops = mask.ring_offsets[holes[positions]], mask.ring_offsets[holes[positions] + 1]
        return [shapely.Polygon(mask.xy_um[a:b]) for a, b in zip(starts, stops, strict=True)]

    return Measurement(-area_um2[holes], site[:, np.newaxis].__getitem__, markers)


def _spaces(case: Case) -> Measurement:
    """Measure distances of sites, 0 where they touch, and widths of notches and holes."""
    found, limit_um = case.contacts, float(case.rules.min_space_um or 0.0)
    near = np.flatnonzero(found.distance_um <= limit_um)
    notch_um = _facing_um(case, -1.0, limit_um + case.rules.dbu_um)
    notched = np.flatnonzero(notch_um <= limit_um)
    n_touching = int(np.count_nonzero(found.distance_um[near] <= LENGTH_ROUNDING_UM))

    def sites(positions: Ints) -> list[tuple[int, ...]]:
        pairs = found.sites_of(near).tolist()
        return [tuple(pairs[k]) if k < near.size else (int(notched[k - near.size]),) for k in positions.tolist()]

    def markers(positions: Ints) -> NDArray[np.object_]:
        is_pair = positions < near.size
        pair, site = near[positions[is_pair]], notched[positions[~is_pair] - near.size]
        lines = np.empty(positions.size, dtype=object)
        lines[is_pair] = shapely.shortest_line(case.shapes(found.first[pair]), case.shapes(found.second[pair]))
        lines[~is_pair] = case.shapes(site)
        return lines

    note = f"{n_touching} pair{'s' * (n_touching != 1)} of sites touch or overlap; apply inset first"
    values = np.concatenate((found.distance_um[near], notch_um[notched]))
    return Measurement(values, sites, markers, note if n_touching and limit_um > 0.0 else "")


def _aspect_ratios(case: Case) -> Measurement:
    from foveasim.layout import _kernels

    layout = case.layout
    return Measurement(_kernels.aspect_ratios(layout.xy_um, layout.ring_offsets, layout.site_offsets))


def _corner_angles(case: Case) -> Measurement:
    out = case.mask.xy_um[case.after] - case.mask.xy_um
    into = np.empty_like(out)
    into[case.after] = out
    turn_rad = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.einsum("ij,ij->i", into, out))
    return Measurement(_per_site(np.minimum, 180.0 - np.degrees(turn_rad), case.mask))


def _edge_angles(case: Case) -> Measurement:
    """
    Measure deviations from multiples of the step, apart from those of rounding.

    Multiples of 45 degrees are exact on the grid, and must be.
    """
    step_deg = float(case.rules.edge_angle_step_deg or 90.0)
    along = np.rint((case.mask.xy_um[case.after] - case.mask.xy_um) / case.rules.dbu_um)
    # Edges are undirected: 180 degrees are equivalent to 0.
    angle_deg = np.degrees(np.arctan2(along[:, 1], along[:, 0])) % 180.0
    off_deg = np.minimum(np.abs(angle_deg - step_deg * np.round(angle_deg / step_deg)), 180.0 - angle_deg)
    if step_deg % 45.0 != 0.0:
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1.0)
        off_deg = np.maximum(off_deg - np.degrees(np.arctan2(math.sqrt(2.0), length)), 0.0)
    return Measurement(_per_site(np.maximum, off_deg, case.mask))


def _grid_deviations(case: Case) -> Measurement:
    step_um = float(case.rules.grid_um or 1.0)
    xy_um = case.mask.xy_um
    return Measurement(
        _per_site(np.maximum, np.abs(xy_um - step_um * np.round(xy_um / step_um)).max(axis=1), case.mask)
    )


def _per_site(reduction: np.ufunc, per_vertex: Floats, layout: Layout) -> Floats:
    """Reduce values per vertex to one value per site."""
    if layout.n_sites == 0:
        return np.zeros(0)
    return np.asarray(reduction.reduceat(per_vertex, layout.ring_offsets[layout.site_offsets[:-1]]))


def _overlaps(case: Case) -> Measurement:
    found, area_um2 = case.contacts, case.mask.area_um2
    pairs = found.sites_of(~found.is_non_overlapping)
    min_um2 = AREA_ROUNDING * area_um2[pairs].min(axis=1, initial=np.inf)
    common = intersections(case.shapes(pairs[:, 0]), case.shapes(pairs[:, 1]), min_um2)
    common_um2 = shapely.area(common)
    is_real = (common_um2 > min_um2) & _is_wider_than_rounding(common, case)
    return Measurement(common_um2[is_real], pairs[is_real].__getitem__, common[is_real].take)


def _is_wider_than_rounding(shapes: NDArray[Any], case: Case) -> Bools:
    """
    Return whether the mean width of shapes is above that of slivers from rounding.

    A vertex that rounding moves off the oblique edge of a neighbour by at most half the diagonal of a pixel of the database
    grid is on the edge for programs that snap edges to vertices, as KLayout: the triangle between them has half of this mean
    width. Rounding of the ends of the edge, too, can cause more: such overlaps are real; :func:`foveasim.layout.snap`
    avoids them.
    """
    return np.asarray(shapely.area(shapes) > SLIVER_WIDTH * case.rules.dbu_um * 0.5 * shapely.length(shapes))


def _gaps(case: Case) -> Measurement:
    """
    Measure the areas that no site covers, within the die or enclosed by sites.

    Isolated sites are subtracted last. The unshared edges of the other sites bound faces, each of which is either
    completely covered or completely open.
    """
    layout = case.mask
    area_um2 = layout.area_um2
    min_um2 = AREA_ROUNDING * float(area_um2.min()) if layout.n_sites else 0.0
    if _gap_area_bound_um2(case) <= max(min_um2, float(case.rules.max_gap_um2 or 0.0)):
        return Measurement(np.zeros(0))
    is_isolated = _is_isolated(case)
    boundary = np.flatnonzero(~case.contacts.is_shared & ~np.repeat(is_isolated, np.diff(case.first_vertex)))
    boundary_um = np.stack((layout.xy_um[boundary], layout.xy_um[case.after[boundary]]), axis=1)
    # A corner on a rotated edge misses it by rounding; without noding, the faces on both sides would merge.
    lines = shapely.linestrings(np.stack(node_edges(boundary_um[:, 0], boundary_um[:, 1]), axis=1))
    if case.rules.die_um is not None:
        lines = np.append(lines, shapely.box(*case.die_um).exterior)
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all(lines)]))
    faces = faces[(shapely.area(faces) > min_um2) & _is_wider_than_rounding(faces, case)]
    faces = _uncovered_faces(faces, is_isolated, case)

    face, site = _isolated_sites_within(faces, is_isolated, case)
    open_um2 = shapely.area(faces) - np.bincount(face, area_um2[site], faces.size)
    gaps = np.flatnonzero(open_um2 > min_um2)

    def sites(positions: Ints) -> list[Ints]:
        is_rim = is_isolated.copy()
        rim_um = np.concatenate((boundary_um.min(axis=1), boundary_um.max(axis=1)), axis=1)
        is_rim[case.sites_near(rim_um, LENGTH_ROUNDING_UM)[1]] = True
        gap, around = case.sites_at(faces[gaps[positions]], is_rim, LENGTH_ROUNDING_UM)
        return _group_by_key(gap, around, positions.size)

    def markers(positions: Ints) -> list[Any]:
        contents = _group_by_key(face, site, faces.size)
        return [_cut_out(faces[k], contents[k], case) for k in gaps[positions]]

    return Measurement(open_um2[gaps], sites, markers)


def _gap_area_bound_um2(case: Case) -> float:
    """
    Return an upper bound of the total gap area, in µm².

    The bound is the area of the die, or of the bounding box of the sites, minus the area of the sites. It is infinite
    where sites may overlap or leave the die.
    """
    layout = case.mask
    if not case.contacts.is_non_overlapping.all():
        return np.inf
    if case.rules.die_um is None:
        field = np.asarray(layout.bounds_um if layout.n_sites else np.zeros(4))
    else:
        field = case.die_um
        if _reach_beyond_die(case).values.max(initial=0.0) > 0.0:
            return np.inf
    return float((field[2:] - field[:2]).prod() - layout.area_um2.sum())


def _is_isolated(case: Case) -> Bools:
    """Return the sites without holes that touch neither another site nor the die boundary."""
    found, box = case.contacts, case.mask.site_bounds_um
    touching = found.sites_of(found.distance_um <= LENGTH_ROUNDING_UM)
    is_isolated = np.diff(case.mask.site_offsets) == 1
    is_isolated[touching.ravel()] = False
    if case.rules.die_um is not None:
        die = case.die_um
        is_within = _reach_beyond_die(case).values < -LENGTH_ROUNDING_UM
        is_outside = np.maximum(die[:2] - box[:, 2:], box[:, :2] - die[2:]).max(axis=1) > LENGTH_ROUNDING_UM
        is_isolated &= is_within | is_outside
    return is_isolated


def _uncovered_faces(faces: NDArray[Any], is_isolated: Bools, case: Case) -> NDArray[Any]:
    """Return the faces within the die that no site covers, ignoring isolated sites."""
    inner = _inner_points(faces)
    is_open = np.ones(faces.size, bool)
    if case.rules.die_um is not None:
        is_open = np.asarray(shapely.contains(shapely.box(*case.die_um), inner))
    is_open[case.sites_at(inner, ~is_isolated)[0]] = False
    return faces[is_open]


def _inner_points(faces: NDArray[Any]) -> NDArray[Any]:
    """Return a point in every polygon, away from slits that rounding opens at its boundary."""
    inner = np.asarray(shapely.point_on_surface(faces))
    thin = np.flatnonzero(shapely.distance(inner, shapely.boundary(faces)) < LENGTH_ROUNDING_UM)
    inner[thin] = shapely.get_point(shapely.maximum_inscribed_circle(faces[thin]), 0)
    return inner


def _isolated_sites_within(faces: NDArray[Any], is_isolated: Bools, case: Case) -> tuple[Ints, Ints]:
    """Return pairs of faces and the isolated sites within them."""
    face, site = case.sites_near(shapely.bounds(faces))
    face, site = face[is_isolated[site]], site[is_isolated[site]]
    shapely.prepare(faces)
    is_inside = shapely.contains_xy(faces[face], case.mask.xy_um[case.first_vertex[site]])
    return face[is_inside], site[is_inside]


def _group_by_key(key: Ints, values: Ints, n_keys: int) -> list[Ints]:
    """Return the values of each key, in their order."""
    stops = np.cumsum(np.bincount(key, minlength=n_keys))[:-1]
    return np.split(values[np.argsort(key, kind="stable")], stops) if n_keys else []


def _cut_out(face: Any, sites: Ints, case: Case) -> Any:
    """Return a polygon with the isolated sites within it cut out."""
    if sites.size == 0:
        return face
    return shapely.Polygon(face.exterior, [*face.interiors, *shapely.get_exterior_ring(case.shapes(sites))])


def _reach_beyond_die(case: Case) -> Measurement:
    die, box = case.die_um, case.mask.site_bounds_um
    return Measurement(np.maximum(die[:2] - box[:, :2], box[:, 2:] - die[2:]).max(axis=1, initial=-np.inf))


def _growths(case: Case) -> Measurement:
    """
    Measure the ratio of mean site sizes of each ring and the next inner one.

    The marker is the first site of the outer ring.
    """
    rings, first, ring = np.unique(case.layout.index_column("ring"), return_index=True, return_inverse=True)
    size_um = np.bincount(ring, case.layout.size_um) / np.bincount(ring) if rings.size else np.zeros(0)
    order = np.argsort(ring, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(ring))[:-1])[1:] if rings.size else []
    return Measurement(
        size_um[1:] / size_um[:-1], lambda k: [members[i] for i in k], lambda k: case.shapes(first[1:][k])
    )


def _neighbour_ratios(case: Case) -> Measurement:
    shared = adjacency(case.layout).tocoo()
    is_upper = shared.row < shared.col
    pairs = np.stack((shared.row[is_upper], shared.col[is_upper]), axis=1).astype(np.int64)
    ratio = case.layout.size_um[pairs[:, 0]] / case.layout.size_um[pairs[:, 1]]
    return Measurement(
        np.maximum(ratio, 1.0 / ratio),
        pairs.__getitem__,
        lambda k: shapely.linestrings(case.layout.centroid_um[pairs[k]]),
    )


def _counts(case: Case) -> Measurement:
    return _of_layout(case, case.layout.n_sites)


def _of_layout(case: Case, value: float) -> Measurement:
    """Return the value of a complete layout, whose marker is the bounding box of all sites."""
    box = shapely.box(*(case.layout.bounds_um if case.layout.n_sites else (0.0, 0.0, 0.0, 0.0)))
    return Measurement(np.array([float(value)]), lambda _k: [()], lambda _k: [box])


def _densities(case: Case) -> Measurement:
    """Measure the fill factor of windows that advance over the die by half their side."""
    low, high, filled_um2 = case.windows
    density = filled_um2 / np.maximum((high - low).prod(axis=1), np.finfo(np.float64).tiny)
    return Measurement(
        density, lambda k: [()] * k.size, lambda k: shapely.box(low[k, 0], low[k, 1], high[k, 0], high[k, 1])
    )


def _filled_um2(layout: Layout, x_um: Floats, y_um: Floats) -> Floats:
    """Compute the area covered by sites in every grid cell, (n_y - 1, n_x - 1) µm²."""
    from foveasim.layout import _kernels

    box = layout.site_bounds_um
    columns, rows = x_um.size - 1, y_um.size - 1
    first_x, last_x = (np.clip(np.searchsorted(x_um, box[:, i], "right") - 1, 0, columns - 1) for i in (0, 2))
    first_y, last_y = (np.clip(np.searchsorted(y_um, box[:, i], "right") - 1, 0, rows - 1) for i in (1, 3))
    inside = (box[:, 0] >= x_um[0]) & (box[:, 2] <= x_um[-1]) & (box[:, 1] >= y_um[0]) & (box[:, 3] <= y_um[-1])
    is_in_one_cell = inside & (first_x == last_x) & (first_y == last_y)
    cell, area_um2 = (first_y * columns + first_x)[is_in_one_cell], layout.area_um2[is_in_one_cell]
    # The other sites are clipped to every cell that their bounding boxes reach.
    cut = np.flatnonzero(~is_in_one_cell)
    wide, high = (last_x - first_x + 1)[cut], (last_y - first_y + 1)[cut]
    position = positions_in_runs(wide * high)
    owner = np.repeat(np.arange(cut.size), wide * high)
    ix, iy = first_x[cut][owner] + position % wide[owner], first_y[cut][owner] + position // wide[owner]
    boxes = np.stack((x_um[ix], y_um[iy], x_um[ix + 1], y_um[iy + 1]), axis=1)
    pieces_um2 = _kernels.areas_in_boxes(layout.xy_um, layout.ring_offsets, layout.site_offsets, cut[owner], boxes)
    cells = np.concatenate((cell, iy * columns + ix))
    filled = np.bincount(cells, np.concatenate((area_um2, pieces_um2)), rows * columns)
    return np.asarray(filled.reshape(rows, columns), dtype=np.float64)


def _data_rates(case: Case) -> Measurement:
    assert case.rules.readout is not None
    return _of_layout(case, case.rules.readout.gbit_per_s(case.layout.n_sites))


def _track_utilisations(case: Case) -> Measurement:
    """Measure the readout lines per available track of every strip where lines begin."""
    assert case.rules.routing is not None
    found = track_demand(case.layout, case.rules.routing)
    use = np.divide(found.n_nets, found.n_tracks, out=np.full(found.n_nets.size, np.inf), where=found.n_tracks > 0)

    def markers(positions: Ints) -> list[Any]:
        if case.rules.routing is not None and case.rules.routing.direction == "upwards":
            x0, _, x1, _ = case.layout.bounds_um
            return [shapely.LineString([(x0, y), (x1, y)]) for y in found.position_um[positions]]
        return [shapely.Point(0.0, 0.0).buffer(r).exterior for r in found.position_um[positions]]

    return Measurement(use, lambda k: [found.first_sites[found.strip == i] for i in k], markers)


#: Rules by name. The built-in rules are fields of :class:`foveasim.layout.DesignRules`. Limits of other rules, registered by
#: programs or by installed packages (entry points of the group ``foveasim.rules``), are set with its parameter ``custom``.
RULES: Registry[Rule] = Registry("design rule", "foveasim.rules")


def _rectangles(*bounds_um: tuple[float, float, float, float], **columns: Any) -> Callable[[], Layout]:
    """Return a function that returns a layout of rectangles (x_min, y_min, x_max, y_max)."""
    return lambda: Layout.from_polygons(list(shapely.box(*np.transpose(bounds_um))), **columns)


def _frame() -> Layout:
    """Return a square with a hole of 4 µm²."""
    return Layout.from_polygons([shapely.box(0.0, 0.0, 9.0, 9.0).difference(shapely.box(3.0, 3.0, 5.0, 5.0))])


#: Layouts of examples: sizes 10 and 20 µm in two rings; 16 squares of 8 µm at a pitch of 10 µm; eight squares around a gap.
_GROWING = _rectangles((0.0, 0.0, 10.0, 10.0), (10.0, 0.0, 30.0, 20.0), ring=[0, 1])
_SPACED = _rectangles(*((x, y, x + 8.0, y + 8.0) for x in range(0, 40, 10) for y in range(0, 40, 10)))
_HOLLOW = _rectangles(
    *((x, y, x + 10.0, y + 10.0) for x in range(0, 30, 10) for y in range(0, 30, 10) if x != 10 or y != 10)
)
_WINDOWS = {"layout": _SPACED, "density_window_um": 10.0, "die_um": (-1.0, -1.0, 39.0, 39.0)}


def _register(
    name: str,
    description: str,
    unit: str,
    measure: Any,
    satisfied: Any,
    violated: Any,
    example: Any = None,
    **options: Any,
) -> None:
    """Register a rule with limits that its example satisfies and violates."""
    rule = Rule(description, unit, measure, is_upper=not name.startswith("min_"), **options)
    RULES.register(name, rule, example={"satisfied": satisfied, "violated": violated, **(example or {})})


_SIZE = "the size of a site, the square root of its area, is at"
_register("min_size_um", f"{_SIZE} least the limit", "µm", _sizes, 10.0, 10.1, repair="merge")
_register("max_size_um", f"{_SIZE} most the limit", "µm", _sizes, 10.0, 9.9)
_register(
    "min_area_um2", "the area of a site is at least the limit", "µm²", _areas, 100.0, 101.0, repair="merge"
)  # fmt: skip
_register(
    "min_hole_um2", "the area of a hole in a site is at least the limit", "µm²", _holes, 4.0, 4.1, {"layout": _frame}
)
_register(
    "min_width_um", "the width of a site is at least the limit", "µm", _widths, 10.0, 10.1, repair="merge"
)  # fmt: skip
_register(
    "min_space_um", "the space between sites, and in their notches and holes, is at least the limit", "µm", _spaces, 2.0, 2.1,
    {"layout": _SPACED}, repair="shrink",
)  # fmt: skip
_register(
    "max_aspect_ratio", "the aspect ratio of a site is at most the limit", "", _aspect_ratios, 2.0, 1.9,
    {"layout": _rectangles((0.0, 0.0, 10.0, 20.0))},
)  # fmt: skip
_register(
    "min_angle_deg", "the interior angle of a corner is at least the limit", "degrees", _corner_angles, 90.0, 91.0
)
_register(
    "edge_angle_step_deg", "edge angles are multiples of the limit", "degrees", _edge_angles, 90.0, 50.0,
    is_deviation=True, rounding=1e-9,
)  # fmt: skip
_register("grid_um", "vertices lie on the manufacturing grid", "µm", _grid_deviations, 10.0, 3.0, is_deviation=True)
_register(
    "max_overlap_um2", "the overlap of two sites is at most the limit", "µm²", _overlaps, 4.0, 3.9,
    {"layout": _rectangles((0.0, 0.0, 10.0, 10.0), (8.0, 8.0, 20.0, 20.0))}, rounding=0.0, repair="shrink",
)  # fmt: skip
_register(
    "max_gap_um2", "the area of a gap is at most the limit", "µm²", _gaps, 101.0, 99.0, {"layout": _HOLLOW},
    rounding=0.0, repair=None,
)  # fmt: skip
_register(
    "die_um", "sites lie within the die", "µm", _reach_beyond_die, (-20.0, -20.0, 20.0, 20.0), (-20.0, -20.0, 20.0, 19.0),
    is_deviation=True,
)  # fmt: skip
_register(
    "min_growth", "the size ratio of successive rings is at least the limit", "", _growths, 2.0, 2.1, {"layout": _GROWING},
    repair=None,
)  # fmt: skip
_register(
    "max_growth", "the size ratio of successive rings is at most the limit", "", _growths, 2.0, 1.9, {"layout": _GROWING},
    repair=None,
)  # fmt: skip
_register(
    "max_neighbour_ratio", "the size ratio of neighbouring sites is at most the limit", "", _neighbour_ratios, 2.0, 1.9,
    {"layout": _GROWING}, rounding=1e-9, repair=None,
)  # fmt: skip
_register("max_sites", "the number of sites is at most the limit", "", _counts, 16, 15, rounding=0.0, repair=None)
_register(
    "min_density", "the fill factor of every window is at least the limit", "", _densities, 0.63, 0.65, _WINDOWS,
    rounding=AREA_ROUNDING, repair=None,
)  # fmt: skip
_register(
    "max_density", "the fill factor of every window is at most the limit", "", _densities, 0.65, 0.63, _WINDOWS,
    rounding=AREA_ROUNDING, repair=None,
)  # fmt: skip
_register(
    "max_data_rate_gbit_per_s", "the data rate of a lane is at most the limit", "Gbit/s", _data_rates, 0.161, 0.159,
    {"readout": Readout(frames_per_s=1e6, bits=10)}, rounding=0.0, repair=None,
)  # fmt: skip
_register(
    "max_track_utilisation", "the number of readout lines per track is at most the limit", "", _track_utilisations,
    0.5, 0.4, {"routing": Routing(width_um=3.0, space_um=2.0, direction="upwards")}, rounding=0.0, repair=None,
)  # fmt: skip


def is_below_size(area_um2: Floats, min_size_um: float) -> Bools:
    """
    Return whether sites of the given areas violate the rule ``min_size_um``.

    Functions that generate or merge sites use the same comparison as the rule.
    """
    rule = RULES["min_size_um"]
    return np.asarray(rule.excess(np.sqrt(area_um2), min_size_um) > rule.rounding)


def min_width_um(layout: Layout, *, angle_limit_deg: float = 90.0, dbu_um: float = DEFAULT_DBU_UM) -> Floats:
    """
    Compute the minimum width of every site on the database grid, (n_site,) µm.

    Parameters
    ----------
    layout : Layout
    angle_limit_deg, dbu_um : float
        As in :class:`foveasim.layout.DesignRules`.

    Returns
    -------
    (n_site,) float64, µm
        Smallest distance between two edges that face each other across the site, at an angle below the limit: 0 for sites
        with sharper corners. Infinite without such edges.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.min_width_um(
    ...     fs.Layout.from_rectangles([[0.0, 0.0]], [[3.0, 1.5]])
    ... ).tolist()
    [1.5]
    """
    from foveasim.layout.drc.rules import DesignRules

    rules = DesignRules(angle_limit_deg=angle_limit_deg, dbu_um=dbu_um)
    return _facing_um(Case(layout, rules), 1.0, math.inf)
