"""
Design rules: what a layout must keep to be made, and the report of where it does not.

A rule has a limit; a limit of None leaves the rule out. A check never raises: each rule measures something, what is
beyond the limit is a violation, one a photosite (or pair, or gap, or ring), and :func:`check` puts them into a report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim.arrays import Floats, Ints, check_number, finite_array
from foveasim.compiled import kernels
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout._model import Layout
from foveasim.layout.adjacency import adjacency
from foveasim.rings import next_vertex, ring_moments

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["DesignRules", "Report", "RuleResult", "Violation", "check", "min_width_um"]

#: Lengths are compared with this tolerance, a thousandth of the finest manufacturing grid (1 nm).
LENGTH_ROUNDING_UM = 1e-6
#: Overlaps and gaps below this share of a site's area are the rounding of its vertices.
AREA_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignRules:
    """
    Limits that a layout is checked against; None leaves a rule out.

    Parameters
    ----------
    min_size_um, max_size_um : float, optional, µm
        Smallest and largest pixel size, the square root of a site's area.
    min_area_um2 : float, optional, µm²
        Smallest area of a site.
    min_hole_um2 : float, optional, µm²
        Smallest area of a hole in a site.
    min_width_um : float, optional, µm
        Smallest distance between edges of a site that face each other across it.
    min_space_um : float, optional, µm
        Smallest distance between two sites that do not touch. Sites that abut keep it: check what is sensitive to light,
        after an inset, where that is what must be apart.
    max_aspect_ratio : float, optional
        Longer over shorter side of the smallest rectangle, at any angle, around a site.
    min_angle_deg : float, optional, degrees
        Smallest inner angle of a corner.
    edge_angle_step_deg : float, optional, degrees
        Edges must run at multiples of this angle: 90 or 45.
    grid_um : float, optional, µm
        Coordinates must be multiples of this manufacturing grid.
    max_overlap_um2 : float, optional, µm²
        Largest area that two sites may both cover; 0 for none.
    max_gap_um2 : float, optional, µm²
        Largest area that may be left open: of the die where ``die_um`` is given, else of the holes between sites.
    die_um : (x_min, y_min, x_max, y_max), optional, µm
        The field that every site must lie in.
    min_growth, max_growth : float, optional
        Limits of the ratio of mean pixel sizes from one ring (column ``ring``) to the next one out.
    max_neighbour_ratio : float, optional
        Largest ratio of the pixel sizes of two sites that share an edge.
    max_sites : int, optional
        Largest number of sites.
    waivers : mapping of str to str, optional
        Rules that may be broken, each with the reason. They are checked and reported all the same.

    Raises
    ------
    ParameterError
        When a limit is out of range.
    """

    min_size_um: float | None = None
    max_size_um: float | None = None
    min_area_um2: float | None = None
    min_hole_um2: float | None = None
    min_width_um: float | None = None
    min_space_um: float | None = None
    max_aspect_ratio: float | None = None
    min_angle_deg: float | None = None
    edge_angle_step_deg: float | None = None
    grid_um: float | None = None
    max_overlap_um2: float | None = None
    max_gap_um2: float | None = None
    die_um: tuple[float, float, float, float] | None = None
    min_growth: float | None = None
    max_growth: float | None = None
    max_neighbour_ratio: float | None = None
    max_sites: int | None = None
    waivers: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        for rule in fields(self):
            value = getattr(self, rule.name)
            if value is not None and rule.name not in {"die_um", "waivers"}:
                object.__setattr__(self, rule.name, check_number(rule.name, value, at_least=0.0))
        for name, most_deg in (("min_angle_deg", 180.0), ("edge_angle_step_deg", 180.0)):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=0.0, at_most=most_deg)
        if self.grid_um is not None:
            check_number("grid_um", self.grid_um, above=0.0)
        if self.die_um is not None:
            die = finite_array("die_um", self.die_um, ndim=1)
            if die.size != 4 or not (die[0] < die[2] and die[1] < die[3]):
                raise ParameterError("die_um", "must be (x_min, y_min, x_max, y_max)", self.die_um, "µm")
            object.__setattr__(self, "die_um", tuple(float(x) for x in die))
        waivers = dict(self.waivers or {})
        for name, reason in waivers.items():
            if name not in RULES:
                raise ParameterError("waivers", f"must name rules ({', '.join(RULES)})", name)
            if not isinstance(reason, str) or not reason.strip():
                raise ParameterError("waivers", f"must give a reason for '{name}'", reason)
        object.__setattr__(self, "waivers", waivers)


@dataclass(frozen=True, slots=True)
class Violation:
    """
    One place where a layout breaks a rule.

    Attributes
    ----------
    rule : str
        Name of the rule.
    site_ids : tuple of int
        The site, or the sites around the place.
    value, limit : float
        What was measured, and the limit; in ``unit``.
    unit : str
    marker : shapely geometry
        The place, in µm.
    """

    rule: str
    site_ids: tuple[int, ...]
    value: float
    limit: float
    unit: str
    marker: Any


@dataclass(frozen=True, slots=True)
class RuleResult:
    """One rule's verdict: its name, sentence, limit and unit, the violations, the worst first, and why they are waived."""

    rule: str
    sentence: str
    limit: float
    unit: str
    violations: tuple[Violation, ...]
    waiver: str | None = None

    @property
    def ok(self) -> bool:
        """Whether the rule is kept, or waived."""
        return not self.violations or self.waiver is not None

    def __str__(self) -> str:
        if self.worst is None:
            return f"{self.rule}: kept"
        count = f"{len(self.violations)} violation{'s' * (len(self.violations) != 1)}"
        waived = "" if self.waiver is None else f" (waived: {self.waiver})"
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.rule}: {count}, worst {self.worst:.6g}{unit} for a limit of {self.limit:g}{unit}{waived}"

    @property
    def worst(self) -> float | None:
        """The value furthest beyond the limit, or None."""
        return self.violations[0].value if self.violations else None


@dataclass(frozen=True)
class Report:
    """
    What a check found.

    Attributes
    ----------
    n_sites : int
        Sites that were checked.
    results : tuple of RuleResult
        One a rule that has a limit.
    """

    n_sites: int
    results: tuple[RuleResult, ...]

    @property
    def ok(self) -> bool:
        """Whether no rule is broken but those that are waived."""
        return all(result.ok for result in self.results)

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """All violations, rule by rule, the worst first."""
        return tuple(violation for result in self.results for violation in result.violations)

    def raise_if_failed(self) -> None:
        """
        Raise when a rule is broken.

        Raises
        ------
        GeometryError
            Naming every broken rule, with the sites in ``.site_ids``.
        """
        if not self.ok:
            broken = [result for result in self.results if not result.ok]
            lines = [str(result) for result in broken]
            ids = sorted({site for result in broken for violation in result.violations for site in violation.site_ids})
            raise GeometryError("the layout breaks its design rules: " + "; ".join(lines), tuple(ids))

    def records(self) -> list[dict[str, Any]]:
        """One dict a violation, for a table: rule, site_ids, value, limit, unit, x_um and y_um of the marker's middle."""
        return [
            {
                "rule": violation.rule,
                "site_ids": violation.site_ids,
                "value": violation.value,
                "limit": violation.limit,
                "unit": violation.unit,
                "x_um": float(violation.marker.centroid.x),
                "y_um": float(violation.marker.centroid.y),
            }
            for violation in self.violations
        ]

    def write(self, path: str | Path) -> None:
        """Write a KLayout report database (``.lyrdb``); see :func:`foveasim.layout.lyrdb.write_lyrdb`."""
        from foveasim.layout.lyrdb import write_lyrdb

        write_lyrdb(self, path)

    def __str__(self) -> str:
        return "\n".join([f"design rules on {self.n_sites} photosites", *map(str, self.results)])

    def __rich__(self) -> Table:
        from rich.table import Table

        table = Table(title=f"Design rules on {self.n_sites} photosites")
        for heading in ("rule", "verdict", "count", "worst", "limit", "unit"):
            table.add_column(heading, justify="left" if heading in ("rule", "verdict", "unit") else "right")
        for r in self.results:
            worst = "" if r.worst is None else f"{r.worst:.6g}"
            verdict = (
                "[green]pass[/green]"
                if not r.violations
                else "[red]fail[/red]"
                if not r.ok
                else "[yellow]waived[/yellow]"
            )
            table.add_row(r.rule, verdict, str(len(r.violations)), worst, f"{r.limit:g}", r.unit)
        return table


def check(layout: Layout, rules: DesignRules) -> Report:
    """
    Check a layout against rules.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules

    Returns
    -------
    Report
        One result for each rule that has a limit.
    """
    if not isinstance(rules, DesignRules):
        raise ParameterError("rules", f"must be DesignRules, got a {type(rules).__name__}")
    case = _Case(layout, rules)
    results = []
    for name, rule in RULES.items():
        limit = getattr(rules, name)
        if limit is not None:
            bound = 0.0 if rule.is_deviation else float(limit)
            violations = _violations(name, rule, rule.measure(case), bound, case)
            results.append(
                RuleResult(name, rule.sentence, bound, rule.unit, violations, (rules.waivers or {}).get(name))
            )
    return Report(layout.n_sites, tuple(results))


def min_width_um(layout: Layout) -> Floats:
    """
    Smallest width of every site, (n_site,) µm.

    The smallest of: the distance between two edges, not neighbours, that face each other across the site (opposite
    within 26 degrees); the distance from an inward corner straight across the site to an edge; the width of the
    narrowest strip along one of its edges that holds the site.
    """
    after = next_vertex(layout.ring_offsets)
    before = np.empty_like(after)
    before[after] = np.arange(after.size)
    widths: Floats = kernels("layout").min_widths(layout.xy_um, after, before, layout.ring_offsets, layout.site_offsets)
    return widths


# -- measures: what each rule looks at ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Case:
    """A layout and its rules, with what several measures need, computed once."""

    layout: Layout
    rules: DesignRules

    @cached_property
    def polygons(self) -> NDArray[Any]:
        """The sites as shapely polygons."""
        return self.layout.polygons()

    @cached_property
    def tree(self) -> shapely.STRtree:
        """The sites by place."""
        return shapely.STRtree(self.polygons)

    @cached_property
    def is_coverage(self) -> bool:
        """Whether neighbours meet edge to edge all over: then nothing overlaps, and the union is quickly had."""
        return bool(shapely.coverage_is_valid(self.polygons))


@dataclass(frozen=True, slots=True)
class _Measured:
    """Values, and for each the sites it is about ((n, k) ints; by default site i) and where it is (the site by default).

    Markers are made for the values that break the rule only: ``markers(positions)``.
    """

    values: Floats
    sites: Any = None
    markers: Callable[[Ints], Any] | None = None


@dataclass(frozen=True, slots=True)
class _Rule:
    """
    How a rule is checked.

    ``measure`` gives values; those above the limit (``is_upper``) or below it by more than ``rounding`` (in the unit of the
    value) are violations. A deviation is compared with 0, the limit being a step or a field.
    """

    sentence: str
    unit: str
    measure: Callable[[_Case], _Measured]
    is_upper: bool = False
    is_deviation: bool = False
    rounding: float = LENGTH_ROUNDING_UM


def _violations(name: str, rule: _Rule, found: _Measured, limit: float, case: _Case) -> tuple[Violation, ...]:
    """The values that break the limit, the worst first."""
    beyond = found.values - limit if rule.is_upper else limit - found.values
    bad = np.flatnonzero(beyond > rule.rounding)
    bad = bad[np.argsort(-beyond[bad], kind="stable")]
    markers = case.polygons[bad] if found.markers is None else found.markers(bad)
    return tuple(
        Violation(
            name,
            (int(i),) if found.sites is None else tuple(int(site) for site in found.sites[i]),
            float(found.values[i]),
            limit,
            rule.unit,
            marker,
        )
        for i, marker in zip(bad, markers, strict=True)
    )


def _sizes(case: _Case) -> _Measured:
    return _Measured(np.sqrt(case.layout.area_um2))


def _areas(case: _Case) -> _Measured:
    return _Measured(case.layout.area_um2)


def _widths(case: _Case) -> _Measured:
    return _Measured(min_width_um(case.layout))


def _holes(case: _Case) -> _Measured:
    area_um2, _moments = ring_moments(case.layout.xy_um, case.layout.ring_offsets)
    holes = np.flatnonzero(area_um2 < 0.0)
    site = np.searchsorted(case.layout.site_offsets, holes, side="right") - 1

    def markers(positions: Ints) -> list[Any]:
        starts, stops = case.layout.ring_offsets[holes[positions]], case.layout.ring_offsets[holes[positions] + 1]
        return [shapely.Polygon(case.layout.xy_um[a:b]) for a, b in zip(starts, stops, strict=True)]

    return _Measured(-area_um2[holes], site[:, np.newaxis], markers)


def _spaces(case: _Case) -> _Measured:
    limit_um = float(case.rules.min_space_um or 0.0)
    a, b = case.tree.query(case.polygons, predicate="dwithin", distance=limit_um)
    a, b = a[a < b], b[a < b]
    distance_um = shapely.distance(case.polygons[a], case.polygons[b])
    # Sites that abut share their border; with a manufacturing grid, to within one step of it.
    is_apart = distance_um > max(LENGTH_ROUNDING_UM, case.rules.grid_um or 0.0)
    a, b = a[is_apart], b[is_apart]
    return _Measured(
        distance_um[is_apart],
        np.stack((a, b), axis=1),
        lambda k: shapely.shortest_line(case.polygons[a[k]], case.polygons[b[k]]),
    )


def _aspect_ratios(case: _Case) -> _Measured:
    if case.layout.n_sites == 0:
        return _Measured(np.zeros(0))
    corners = shapely.get_coordinates(shapely.oriented_envelope(case.polygons)).reshape(-1, 5, 2)
    sides_um = np.linalg.norm(np.diff(corners[:, :3], axis=1), axis=2)
    return _Measured(sides_um.max(axis=1) / sides_um.min(axis=1))


def _corner_angles(case: _Case) -> _Measured:
    after = next_vertex(case.layout.ring_offsets)
    out = case.layout.xy_um[after] - case.layout.xy_um
    into = np.empty_like(out)
    into[after] = out
    turn_rad = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.einsum("ij,ij->i", into, out))
    return _Measured(_per_site(np.minimum, 180.0 - np.degrees(turn_rad), case.layout))


def _edge_angles(case: _Case) -> _Measured:
    step_deg = float(case.rules.edge_angle_step_deg or 90.0)
    along = case.layout.xy_um[next_vertex(case.layout.ring_offsets)] - case.layout.xy_um
    angle_deg = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    return _Measured(_per_site(np.maximum, np.abs(angle_deg - step_deg * np.round(angle_deg / step_deg)), case.layout))


def _grid_deviations(case: _Case) -> _Measured:
    step_um = float(case.rules.grid_um or 1.0)
    off_um = np.abs(case.layout.xy_um - step_um * np.round(case.layout.xy_um / step_um)).max(axis=1)
    return _Measured(_per_site(np.maximum, off_um, case.layout))


def _per_site(reduction: np.ufunc, per_vertex: Floats, layout: Layout) -> Floats:
    """A value a site from one a vertex."""
    if layout.n_sites == 0:
        return np.zeros(0)
    return np.asarray(reduction.reduceat(per_vertex, layout.ring_offsets[layout.site_offsets[:-1]]))


def _overlaps(case: _Case) -> _Measured:
    if case.is_coverage:
        return _Measured(np.zeros(0))
    a, b = case.tree.query(case.polygons, predicate="intersects")
    a, b = a[a < b], b[a < b]
    common = shapely.intersection(case.polygons[a], case.polygons[b])
    area_um2 = shapely.area(common)
    is_real = area_um2 > AREA_ROUNDING * np.minimum(case.layout.area_um2[a], case.layout.area_um2[b])
    return _Measured(area_um2[is_real], np.stack((a, b), axis=1)[is_real], common[is_real].take)


def _gaps(case: _Case) -> _Measured:
    union = shapely.coverage_union_all if case.is_coverage else shapely.disjoint_subset_union_all
    covered = union(case.polygons)
    if case.rules.die_um is not None:
        opened = shapely.get_parts(shapely.difference(shapely.box(*case.rules.die_um), covered))
    else:
        parts = shapely.get_parts(covered)
        holes = shapely.union_all(shapely.polygons(shapely.get_rings(parts)[_is_hole(parts)]))
        opened = shapely.get_parts(shapely.difference(holes, covered))
    opened = opened[shapely.area(opened) > AREA_ROUNDING * (case.layout.area_um2.min() if case.layout.n_sites else 0.0)]
    gap, site = case.tree.query(opened, predicate="intersects")
    around = np.split(site[np.lexsort((site, gap))], np.cumsum(np.bincount(gap, minlength=opened.size)))[: opened.size]
    return _Measured(shapely.area(opened), around, opened.take)


def _is_hole(polygons: NDArray[Any]) -> NDArray[np.bool_]:
    """Of the rings of some polygons, which are not the outlines."""
    n_rings = 1 + shapely.get_num_interior_rings(polygons)
    is_hole = np.ones(int(n_rings.sum()), bool)
    is_hole[np.cumsum(n_rings) - n_rings] = False
    return is_hole


def _reach_beyond_die(case: _Case) -> _Measured:
    die = np.asarray(case.rules.die_um)
    box = case.layout.site_bounds_um
    return _Measured(np.maximum(die[:2] - box[:, :2], box[:, 2:] - die[2:]).max(axis=1, initial=-np.inf))


def _growths(case: _Case) -> _Measured:
    """Of the rings in their order, the mean pixel size over that of the ring before; marked at the outer one's first site."""
    rings, first, ring = np.unique(case.layout.index_column("ring"), return_index=True, return_inverse=True)
    size_um = np.bincount(ring, np.sqrt(case.layout.area_um2)) / np.bincount(ring) if rings.size else np.zeros(0)
    order = np.argsort(ring, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(ring))[:-1])[1:] if rings.size else []
    return _Measured(size_um[1:] / size_um[:-1], members, lambda k: case.polygons[first[1:][k]])


def _neighbour_ratios(case: _Case) -> _Measured:
    pairs = adjacency(case.layout).tocoo()
    a, b = (index[pairs.coords[0] < pairs.coords[1]] for index in pairs.coords)
    size_um = np.sqrt(case.layout.area_um2)
    ratio = np.maximum(size_um[a] / size_um[b], size_um[b] / size_um[a])
    centre_um = case.layout.centroid_um
    return _Measured(
        ratio,
        np.stack((a, b), axis=1),
        lambda k: shapely.linestrings(np.stack((centre_um[a[k]], centre_um[b[k]]), axis=1)),
    )


def _counts(case: _Case) -> _Measured:
    bounds_um = case.layout.bounds_um if case.layout.n_sites else (0.0, 0.0, 0.0, 0.0)
    everything = np.array([shapely.box(*bounds_um)], dtype=object)
    return _Measured(np.array([float(case.layout.n_sites)]), [()], everything.take)


#: Every rule in the order of reports.
RULES: Mapping[str, _Rule] = {
    "min_size_um": _Rule("a site's size, the square root of its area, is at least the limit", "µm", _sizes),
    "max_size_um": _Rule(
        "a site's size, the square root of its area, is at most the limit", "µm", _sizes, is_upper=True
    ),
    "min_area_um2": _Rule("a site's area is at least the limit", "µm²", _areas),
    "min_hole_um2": _Rule("a hole in a site has at least the limit's area", "µm²", _holes),
    "min_width_um": _Rule("a site is nowhere narrower than the limit", "µm", _widths),
    "min_space_um": _Rule("sites that do not touch are at least the limit apart", "µm", _spaces),
    "max_aspect_ratio": _Rule("a site is at most so many times as long as wide", "", _aspect_ratios, is_upper=True),
    "min_angle_deg": _Rule("no corner is sharper than the limit", "degrees", _corner_angles),
    "edge_angle_step_deg": _Rule(
        "edges run at multiples of the angle", "degrees", _edge_angles, is_upper=True, is_deviation=True, rounding=1e-4
    ),
    "grid_um": _Rule(
        "vertices lie on the manufacturing grid", "µm", _grid_deviations, is_upper=True, is_deviation=True
    ),
    "max_overlap_um2": _Rule(
        "no two sites cover more than the limit twice", "µm²", _overlaps, is_upper=True, rounding=0.0
    ),
    "max_gap_um2": _Rule("no gap is larger than the limit", "µm²", _gaps, is_upper=True, rounding=0.0),
    "die_um": _Rule("no site reaches out of the die", "µm", _reach_beyond_die, is_upper=True, is_deviation=True),
    "min_growth": _Rule("pixels grow at least by the limit from ring to ring", "", _growths),
    "max_growth": _Rule("pixels grow at most by the limit from ring to ring", "", _growths, is_upper=True),
    "max_neighbour_ratio": _Rule(
        "neighbours' sizes differ at most by the limit", "", _neighbour_ratios, is_upper=True, rounding=1e-9
    ),
    "max_sites": _Rule("there are at most so many sites", "", _counts, is_upper=True, rounding=0.0),
}
