"""Repair of layouts that violate design rules, with a record of the changes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
import shapely

from foveasim._core.quantities import format_quantity
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Ints
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout.adjacency import TOUCHING_UM
from foveasim.layout.drc.rules import RULES, DesignRules, Report, RuleResult, Violation
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.edits._parts import replace_sites
from foveasim.layout.edits.all_sites import joining_groups, merge, union
from foveasim.layout.generators.tiling import fill
from foveasim.layout.model import Layout, derived

__all__ = ["Change", "Changes", "Stock", "enforce", "repair"]

Repair: TypeAlias = Literal["best", "drop", "shrink", "merge", "refill"]

#: Maximum number of merging rounds; a merged site may still be too small.
MAX_ROUNDS = 100
#: Rounds in which both sites of a pair retreat, and further ones in which the larger site retreats alone.
BOTH_ROUNDS, LARGER_ROUNDS = 4, 12
#: Additional distance of a retreat; each further round adds a database unit, for the rounding of vertices.
RETREAT_ROUNDING_UM = 1e-7
#: Angle between the edges on both sides of an edge of a hexagon, less the rounding of its vertices.
HEXAGON_DEG = 59.0
#: Size of a site, in minimum widths, above which it is too narrow because of an arm, not because it is small.
NARROW_SIZE = 4.0
#: Rounding of a distance in steps of the manufacturing grid.
GRID_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class Change:
    """
    Repair of some sites, and the rule that required it.

    Attributes
    ----------
    rule : str
        Name of the violated rule; of :func:`foveasim.layout.clean`, ``"tolerance_um"``, ``"gaps"`` or ``"overlaps"``.
    action : {"dropped", "merged", "replaced", "shrunk", "snapped", "noded", "filled", "cut"}
    site_ids : tuple of int
        Indices of the sites in the input layout; for merged sites, all sites of the group.
    lost_um2 : tuple of float, µm²
        Area that each site lost, negative if it gained area; empty for sites that were dropped, merged or replaced.
    """

    rule: str
    action: Literal["dropped", "merged", "replaced", "shrunk", "snapped", "noded", "filled", "cut"]
    site_ids: tuple[int, ...]
    lost_um2: tuple[float, ...] = ()

    __repr__ = short_repr


@dataclass(frozen=True, slots=True)
class Stock:
    """
    Extent of a layout before or after a repair.

    Attributes
    ----------
    n_sites : int
    area_um2 : float, µm²
        Total area of the sites.
    min_size_um : float, µm
        Size of the smallest site, the square root of its area; NaN without sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> Stock.of(fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0))
    Stock(n_sites=4, area_um2=36.0, min_size_um=3.0)
    """

    n_sites: int
    area_um2: float
    min_size_um: float

    __repr__ = short_repr

    @classmethod
    def of(cls, layout: Layout) -> Stock:
        """Return the extent of a layout."""
        smallest = float(layout.size_um.min()) if layout.n_sites else math.nan
        return cls(layout.n_sites, float(layout.area_um2.sum()), smallest)


@dataclass(frozen=True, slots=True)
class Changes(Sequence[Change]):
    """
    Sequence of the changes of a repair, with the extent of the layout before and after.

    Attributes
    ----------
    changes : tuple of Change
    before, after : Stock

    Examples
    --------
    >>> import foveasim as fs
    >>> rings = fs.layout.log_polar(n_sectors=32, r_min_um=2.0, r_max_um=50.0)
    >>> print(rings.enforce(fs.DesignRules(min_size_um=1.0))[1])
    512 -> 389 sites, area 6,741.5 µm² -> 6,741.5 µm² (100 %), smallest site 0.434 -> 1.01 µm
    min_size_um: 192 sites merged
    """

    changes: tuple[Change, ...]
    before: Stock
    after: Stock

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.changes)

    def __getitem__(self, index: Any) -> Any:
        return self.changes[index]

    def __iter__(self) -> Iterator[Change]:
        return iter(self.changes)

    def __str__(self) -> str:
        before, after = self.before, self.after
        kept = f" ({100.0 * after.area_um2 / before.area_um2:.4g} %)" if before.area_um2 else ""
        area = " -> ".join(format_quantity(stock.area_um2, "µm²", digits=5) for stock in (before, after))
        lines = [
            (
                f"{before.n_sites:,} -> {after.n_sites:,} sites, area {area}{kept}, "
                f"smallest site {before.min_size_um:.3g} -> {after.min_size_um:.3g} µm"
            )
        ]
        for rule, action in dict.fromkeys((change.rule, change.action) for change in self):
            n_sites = len({i for c in self if (c.rule, c.action) == (rule, action) for i in c.site_ids})
            lines.append(f"{rule}: {n_sites:,} site{'s' * (n_sites != 1)} {action}")
        return "\n".join(lines)


def enforce(layout: Layout, rules: DesignRules, *, repair: Repair = "best") -> tuple[Layout, Changes]:
    """
    Return a layout repaired to satisfy the rules, and the changes.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules
        Violations of waived rules are not repaired.
    repair : {"best", "drop", "shrink", "merge", "refill"}
        ``"drop"`` removes the sites that violate a rule (of two sites that overlap or are too close, the smaller one); a
        minimum size then leaves the blind spot of a foveal layout. ``"shrink"`` first cuts the outlines of sites that are too
        close, at equal distances from both (in multiples of ``grid_um``), and the larger one of two that overlap, and drops
        the remaining ones. ``"merge"`` first merges sites that are too small with
        the neighbour that shares the longest boundary, repeatedly, and drops the remaining ones. ``"refill"`` drops sites,
        and fills the area of sites that were too small, including the area that they enclose, with hexagons of the minimum
        size. A new site has the column values of the nearest dropped site. ``"best"`` merges sites that are too small, cuts
        those that are too close, and drops only others. Sites that are too narrow are merged only if the result is wide
        enough, or still small.

    Returns
    -------
    layout : Layout
    changes : Changes
        Sequence of :class:`Change`, with the number of sites, the area and the smallest site before and after.

    Raises
    ------
    GeometryError
        When the layout violates a rule that removing sites cannot repair, such as gaps, growth, the size ratio of
        neighbours, or the number of sites; with ``"best"``, also when no site remains because all have corners sharper than
        ``angle_limit_deg``.

    Examples
    --------
    >>> from foveasim.layout import log_polar
    >>> rings = log_polar(n_sectors=32, r_min_um=2.0, r_max_um=50.0)
    >>> legal, changes = enforce(rings, DesignRules(min_size_um=1.0), repair="drop")
    >>> rings.n_sites, legal.n_sites, changes[0].action
    (512, 352, 'dropped')
    """
    waivers = rules.waivers or {}
    active = rules.only(lambda name: RULES[name].repair is not None and name not in waivers)
    current_index = np.arange(layout.n_sites)  # current index of each input site, -1 for dropped sites
    changes: list[Change] = []
    original = layout
    if repair in ("best", "merge"):
        layout, current_index = _merge_small(layout, active, current_index, changes)
    if repair in ("best", "shrink"):
        layout = _shrink(layout, active, current_index, changes)
    layout, current_index = _drop_violating_sites(layout, active, current_index, changes)
    if repair == "refill":
        layout = _refill(layout, original, active, changes)
    sharp = [] if layout.n_sites or repair != "best" else _sharp_sites(original.check(active))
    if sharp:
        raise GeometryError(
            f"the repair would drop all sites: {len(sharp):,} of {original.n_sites:,} have corners sharper than "
            f"angle_limit_deg = {rules.angle_limit_deg:g}, which neither merging nor cutting repairs; set an "
            "'angle_limit_deg' below their corners, such as 25, and 'min_angle_deg' for the corners",
            tuple(sharp),
        )
    rest = layout.check(rules.only(lambda name: RULES[name].repair is None))
    if not rest.ok:
        raise GeometryError(f"the layout violates rules that removing sites cannot repair: {_format_violations(rest)}")
    return layout, Changes(tuple(changes), Stock.of(original), Stock.of(layout))


@layout_edit(example={"rules": DesignRules(min_size_um=5.0)})
def repair(layout: Layout, *, rules: DesignRules | None = None, method: Repair = "best") -> Layout:
    """
    Return a layout that satisfies rules, with a record of the repair in its provenance.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules
        Required in Python. In settings files, those of the layout by default.
    method : {"best", "drop", "shrink", "merge", "refill"}
        As ``repair`` of :func:`enforce`.

    Returns
    -------
    Layout
        ``provenance["repairs"]`` has an entry for each repair: the method, the number of sites, the area and the smallest site
        before and after, and the text of its :class:`Changes`.

    Raises
    ------
    GeometryError
        As for :func:`enforce`.
    ParameterError
        When there are no rules.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles(
    ...     [[0.0, 0.0], [5.0, 0.0]], [[3.0, 3.0], [3.0, 0.5]]
    ... )
    >>> fs.layout.repair(layout, rules=fs.DesignRules(min_width_um=1.0)).n_sites
    1
    """
    if rules is None:
        raise ParameterError("rules", "must be given", hint="in settings files, the layout may have them")
    found, changes = enforce(layout, rules, repair=method)
    record = {
        "method": method,
        "before": asdict(changes.before),
        "after": asdict(changes.after),
        "text": str(changes),
    }
    return found.with_provenance({**found.provenance, "repairs": [*layout.provenance.get("repairs", []), record]})


def _drop_violating_sites(
    layout: Layout, rules: DesignRules, current_index: Ints, changes: list[Change]
) -> tuple[Layout, Ints]:
    """Remove sites that violate a rule until none remain."""
    report = layout.check(rules)
    while not report.ok:
        is_dropped = np.zeros(layout.n_sites, bool)
        for result in report.results:
            new = _sites_to_remove(layout, result, is_dropped)
            is_dropped[new] = True
            ids = np.flatnonzero(np.isin(current_index, new))
            if ids.size:
                changes.append(Change(result.rule, "dropped", tuple(int(i) for i in ids)))
        current_index = np.where(
            (current_index >= 0) & ~is_dropped[current_index], (np.cumsum(~is_dropped) - 1)[current_index], -1
        )
        layout = layout[~is_dropped]
        report = layout.check(rules)
    return layout, current_index


def _shrink(layout: Layout, rules: DesignRules, current_index: Ints, changes: list[Change]) -> Layout:
    """Cut outlines of sites that are too close or overlap, in rounds."""
    spacing = rules.only(lambda name: RULES[name].repair == "shrink")
    area_um2 = layout.area_um2
    shrunk: dict[str, set[int]] = {}
    for attempt in range(BOTH_ROUNDS + LARGER_ROUNDS):
        report = layout.check(spacing)
        if report.ok:
            break
        polygons, size_um2 = layout.polygons(), layout.area_um2
        new: dict[int, Any] = {}
        for violation in (
            found for result in report.results for found in result.violations if len(found.site_ids) == 2
        ):
            smaller, larger = sorted(violation.site_ids, key=lambda site: float(size_um2[site]))
            is_overlap = violation.unit == "µm²"
            retreating = (larger,) if is_overlap or attempt >= BOTH_ROUNDS else (smaller, larger)
            reach_um = 0.0 if is_overlap else _reach_um(violation, rules, len(retreating), attempt)
            for site in retreating:
                other = polygons[smaller if site == larger else larger]
                new[site] = _largest(_retreat(new.get(site, polygons[site]), other, reach_um))
            shrunk.setdefault(violation.rule, set()).update(retreating)
        new = {site: outline for site, outline in new.items() if outline is not None}  # others are dropped afterwards
        if not new:
            break
        sites = np.array(sorted(new))
        layout = replace_sites(layout, sites, [new[int(site)] for site in sites], sites, "shrunk by rules")
    lost_um2 = area_um2 - layout.area_um2
    for rule, found in shrunk.items():
        ids = np.flatnonzero(np.isin(current_index, [site for site in found if lost_um2[site] > 0.0]))
        if ids.size:
            lost = tuple(lost_um2[current_index[ids]].tolist())
            changes.append(Change(rule, "shrunk", tuple(ids.tolist()), lost))
    return layout


def _retreat(site: Any, other: Any, reach_um: float) -> Any:
    """
    Return the part of a site at a distance from another one.

    The cut is a line where a line along an edge of their hulls separates the two (separating axis theorem), so that no notch
    arises; otherwise it follows the other outline.
    """
    if site is None or site.is_empty:
        return None
    hulls = [shapely.get_coordinates(shapely.convex_hull(polygon)) for polygon in (site, other)]
    along = np.concatenate([np.diff(hull, axis=0) for hull in hulls])
    along = along[np.hypot(*along.T) > 0.0]
    normal = np.stack((-along[:, 1], along[:, 0]), axis=1) / np.hypot(*along.T)[:, np.newaxis]
    normal = np.concatenate((normal, -normal))
    top = (hulls[1] @ normal.T).max(axis=0)
    gap = (hulls[0] @ normal.T).min(axis=0) - top
    best = int(gap.argmax())
    if gap[best] < -reach_um - TOUCHING_UM:
        return shapely.difference(site, shapely.buffer(other, reach_um, join_style="mitre"))
    n, t = normal[best], np.array([-normal[best][1], normal[best][0]])
    far = 2.0 * float(np.ptp(np.concatenate(hulls), axis=0).sum()) + reach_um
    corner = n * (top[best] + reach_um) + t * float(hulls[0].mean(axis=0) @ t)
    beyond = shapely.Polygon([corner - far * t, corner + far * t, corner + far * (t + n), corner + far * (n - t)])
    return shapely.intersection(site, beyond)


def _reach_um(violation: Violation, rules: DesignRules, n_retreating: int, attempt: int) -> float:
    """Return the distance from the other site to which a site that is too close retreats."""
    retreat_um = (violation.limit - violation.value) / n_retreating
    if rules.grid_um:
        retreat_um = math.ceil(retreat_um / rules.grid_um - GRID_ROUNDING) * rules.grid_um
        return violation.value + retreat_um
    return violation.value + retreat_um + attempt * rules.dbu_um + RETREAT_ROUNDING_UM


def _largest(shape: Any) -> Any:
    """Return the largest polygon of a shape, or None."""
    if shape is None:
        return None
    parts = shapely.get_parts(shape)
    parts = parts[shapely.area(parts) > 0.0]
    return parts[int(shapely.area(parts).argmax())] if parts.size else None


def _refill(layout: Layout, original: Layout, rules: DesignRules, changes: list[Change]) -> Layout:
    """Fill the area of dropped sites that were too small with hexagons of the minimum size."""
    is_small = [change.action == "dropped" and _is_minimum_rule(change.rule) for change in changes]
    dropped_ids = np.array(
        [i for change, small in zip(changes, is_small, strict=True) if small for i in change.site_ids], int
    )
    if dropped_ids.size == 0:
        return layout
    dropped = original[np.sort(dropped_ids)]
    area = shapely.get_parts(shapely.union_all(dropped.polygons()))
    area = shapely.union_all(shapely.polygons(shapely.get_exterior_ring(area)))
    n_remaining = layout.n_sites
    filled = fill(layout, area, size_um=_smallest_size_um(rules), columns_of=dropped)
    # Sites at the boundary may be narrower than a hexagon, or violate other rules.
    new, _ = _merge_small(filled[n_remaining:], rules, np.arange(filled.n_sites - n_remaining), [])
    layout, _ = _drop_violating_sites(union([layout, new]), rules, np.zeros(0, np.int64), [])
    for k, (change, small) in enumerate(zip(changes, is_small, strict=True)):
        if small:
            changes[k] = replace(change, action="replaced")
    return derived(original, "refilled by rules", layout.rings_um, layout.columns)


def _smallest_size_um(rules: DesignRules) -> float:
    """Return the smallest hexagon size that satisfies all minimum limits."""
    width_um = rules.min_width_um + 2.0 * rules.dbu_um if rules.min_width_um else 0.0
    # Its narrowest part is a side where edges that enclose 60 degrees face each other, else the distance across flats.
    per_width_um = (
        math.sqrt(1.5 * math.sqrt(3.0)) if rules.angle_limit_deg >= HEXAGON_DEG else math.sqrt(0.5 * math.sqrt(3.0))
    )
    return max(rules.min_size_um or 0.0, math.sqrt(rules.min_area_um2 or 0.0), width_um * per_width_um)


def _sites_to_remove(layout: Layout, result: RuleResult, is_dropped: Bools) -> Ints:
    """
    Return further sites that must be removed to satisfy a rule.

    Of a pair, the smaller site is removed, unless one of the two is already in ``is_dropped``.
    """
    removed = set(np.flatnonzero(is_dropped).tolist())
    new = set()
    for violation in result.violations:
        site = min(violation.site_ids, key=lambda i: float(layout.area_um2[i]))
        if not removed & set(violation.site_ids):
            new.add(site)
            removed.add(site)
    return np.array(sorted(new), dtype=np.int64)


def _merge_small(layout: Layout, rules: DesignRules, current_index: Ints, changes: list[Change]) -> tuple[Layout, Ints]:
    """
    Merge sites that are too small with their neighbours, in rounds.

    Merging always makes sites larger, but not always wider: neighbours of a site with a narrow arm would follow one by one.
    A site that is too narrow is merged only if the result is wide enough, or still small.
    """
    minimum_rules, width_rules = rules.only(_is_minimum_rule), rules.only("min_width_um".__eq__)
    is_narrow = np.zeros(layout.n_sites, bool)  # sites that merging does not widen
    for _ in range(MAX_ROUNDS):
        report = layout.check(minimum_rules)
        if report.ok:
            break
        is_narrow[_sharp_sites(report)] = True
        rule_of = {
            v.site_ids[0]: result.rule
            for result in reversed(report.results)
            for v in result.violations
            if result.rule != "min_width_um" or not is_narrow[v.site_ids[0]]
        }
        group = joining_groups(layout, np.array(list(rule_of), dtype=np.int64))
        if np.array_equal(group, np.arange(layout.n_sites)):
            break
        _separate_narrow(layout, width_rules, rule_of, group, is_narrow)
        groups, label = np.unique(group, return_inverse=True)
        layout, current_index = merge(layout, label), label[current_index]
        is_narrow = np.bincount(label, is_narrow) > 0
        order = np.argsort(current_index, kind="stable")
        boundaries = np.searchsorted(current_index[order], np.arange(groups.size + 1))
        is_joined = np.bincount(label) > 1
        rule_of_group = {int(label[site]): rule for site, rule in rule_of.items()}
        for k in np.flatnonzero(is_joined).tolist():
            ids = order[boundaries[k] : boundaries[k + 1]]
            changes.append(Change(rule_of_group[k], "merged", tuple(sorted(int(i) for i in ids))))
    return layout, current_index


def _separate_narrow(
    layout: Layout, rules: DesignRules, rule_of: dict[int, str], group: Ints, is_narrow: Bools
) -> None:
    """Separate pairs that would be large and too narrow, and mark their sites."""
    sites = np.array(list(rule_of), dtype=np.int64)
    seeks_width = np.array([rule == "min_width_um" for rule in rule_of.values()])
    if not seeks_width.any():
        return
    label = np.unique(group, return_inverse=True)[1]
    merged = merge(layout, label)
    is_bad = np.zeros(merged.n_sites, bool)
    is_bad[[v.site_ids[0] for v in merged.check(rules).violations]] = True
    is_bad &= (merged.size_um > NARROW_SIZE * (rules.min_width_um or 0.0)) & (np.bincount(label) > 1)
    is_bad[label[sites[~seeks_width]]] = False  # too small: any neighbour helps
    members = np.flatnonzero(is_bad[label])
    group[members] = members
    is_narrow[sites[seeks_width & is_bad[label[sites]]]] = True


def _sharp_sites(report: Report) -> list[int]:
    """Return the sites that violate ``min_width_um`` with a width of 0, by their corners."""
    return [v.site_ids[0] for v in report.violations if v.rule == "min_width_um" and v.value == 0.0]


def _format_violations(report: Report) -> str:
    return "; ".join(str(result) for result in report.results if not result.ok)


def _is_minimum_rule(name: str) -> bool:
    """Return whether merging a site with a neighbour repairs violations of the rule."""
    return name in RULES and RULES[name].repair == "merge"
