"""Repair of layouts that violate design rules, with a record of the changes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
import shapely

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Ints
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout.drc.rules import RULES, DesignRules, Report, RuleResult, Violation
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.edits._parts import replace_sites
from foveasim.layout.edits.all_sites import joining_groups, merge, union
from foveasim.layout.generators.tiling import fill
from foveasim.layout.model import Layout, derived

__all__ = ["Change", "enforce", "repair"]

Repair: TypeAlias = Literal["drop", "shrink", "merge", "refill"]

#: Maximum number of merging rounds; a merged site may still be too small.
MAX_ROUNDS = 100
#: Rounds in which both sites of a pair retreat, and further ones in which the larger site retreats alone.
BOTH_ROUNDS, LARGER_ROUNDS = 4, 12
#: Additional distance of a retreat, for rounding: far below any manufacturing grid.
RETREAT_ROUNDING_UM = 1e-7
#: Rounding of a distance in steps of the manufacturing grid.
GRID_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class Change:
    """
    Repair of some sites, and the rule that required it.

    Attributes
    ----------
    rule : str
        Name of the violated rule.
    action : {"dropped", "merged", "replaced", "shrunk"}
    site_ids : tuple of int
        Indices of the sites in the input layout; for merged sites, all sites of the group.
    lost_um2 : tuple of float, µm²
        Area that each site lost, if sites were shrunk.
    """

    rule: str
    action: Literal["dropped", "merged", "replaced", "shrunk"]
    site_ids: tuple[int, ...]
    lost_um2: tuple[float, ...] = ()

    __repr__ = short_repr


def enforce(layout: Layout, rules: DesignRules, *, repair: Repair = "drop") -> tuple[Layout, tuple[Change, ...]]:
    """
    Return a layout repaired to satisfy the rules, and the changes.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules
        Violations of waived rules are not repaired.
    repair : {"drop", "shrink", "merge", "refill"}
        ``"drop"`` removes the sites that violate a rule (of two sites that overlap or are too close, the smaller one); a
        minimum size then leaves the blind spot of a foveal layout. ``"shrink"`` first cuts the outlines of sites that are too
        close, at equal distances from both (in multiples of ``grid_um``), and the larger one of two that overlap, and drops
        the remaining ones. ``"merge"`` first merges sites that are too small with
        the neighbour that shares the longest boundary, repeatedly, and drops the remaining ones. ``"refill"`` drops sites,
        and fills the area of sites that were too small, including the area that they enclose, with hexagons of the minimum
        size. A new site has the column values of the nearest dropped site.

    Returns
    -------
    layout : Layout
    changes : tuple of Change

    Raises
    ------
    GeometryError
        When the layout violates a rule that removing sites cannot repair, such as gaps, growth, the size ratio of
        neighbours, or the number of sites.

    Examples
    --------
    >>> from foveasim.layout import log_polar
    >>> rings = log_polar(n_sectors=32, r_min_um=2.0, r_max_um=50.0)
    >>> legal, changes = enforce(rings, DesignRules(min_size_um=1.0))
    >>> rings.n_sites, legal.n_sites, changes[0].action
    (512, 352, 'dropped')
    """
    waivers = rules.waivers or {}
    active = rules.only(lambda name: RULES[name].repair is not None and name not in waivers)
    current_index = np.arange(layout.n_sites)  # current index of each input site, -1 for dropped sites
    changes: list[Change] = []
    original = layout
    if repair == "shrink":
        layout = _shrink(layout, active, changes)
    elif repair == "merge":
        layout, current_index = _merge_small(layout, active, current_index, changes)
    layout, current_index = _drop_violating_sites(layout, active, current_index, changes)
    if repair == "refill":
        layout = _refill(layout, original, active, changes)
    rest = layout.check(rules.only(lambda name: RULES[name].repair is None))
    if not rest.ok:
        raise GeometryError(f"the layout violates rules that removing sites cannot repair: {_format_violations(rest)}")
    return layout, tuple(changes)


@layout_edit(example={"rules": DesignRules(min_size_um=5.0)})
def repair(layout: Layout, *, rules: DesignRules | None = None, method: Repair = "drop") -> Layout:
    """
    Return a layout repaired to satisfy the rules.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules
        Required in Python. In settings files, those of the layout by default.
    method : {"drop", "shrink", "merge", "refill"}
        As ``repair`` of :func:`enforce`.

    Raises
    ------
    GeometryError
        As for :func:`enforce`.
    ParameterError
        When there are no rules.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles([[0.0, 0.0], [5.0, 0.0]], [[3.0, 3.0], [3.0, 0.5]])
    >>> fs.layout.repair(layout, rules=fs.DesignRules(min_width_um=1.0)).n_sites
    1
    """
    if rules is None:
        raise ParameterError("rules", "must be given", hint="in settings files, the layout may have them")
    return enforce(layout, rules, repair=method)[0]


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


def _shrink(layout: Layout, rules: DesignRules, changes: list[Change]) -> Layout:
    """Cut outlines of sites that are too close or overlap, in rounds."""
    spacing = rules.only(lambda name: RULES[name].repair == "shrink")
    area_um2 = layout.area_um2
    shrunk: dict[str, set[int]] = {}
    for attempt in range(BOTH_ROUNDS + LARGER_ROUNDS):
        report = layout.check(spacing)
        if report.ok:
            break
        polygons, size_um2 = layout.polygons(), layout.area_um2
        cuts: dict[int, list[Any]] = {}
        for violation in (found for result in report.results for found in result.violations):
            smaller, larger = sorted(violation.site_ids, key=lambda site: float(size_um2[site]))
            is_overlap = violation.unit == "µm²"
            retreating = (larger,) if is_overlap or attempt >= BOTH_ROUNDS else (smaller, larger)
            reach_um = 0.0 if is_overlap else _reach_um(violation, rules.grid_um, len(retreating))
            for site in retreating:
                other = polygons[smaller if site == larger else larger]
                cuts.setdefault(site, []).append(shapely.buffer(other, reach_um, join_style="mitre"))
            shrunk.setdefault(violation.rule, set()).update(retreating)
        sites = np.array(sorted(cuts), dtype=np.int64)
        outlines = [_largest(shapely.difference(polygons[site], shapely.union_all(cuts[int(site)]))) for site in sites]
        has_area = np.array([outline is not None for outline in outlines])
        sites = sites[has_area]  # others are dropped afterwards
        if not sites.size:
            break
        remaining = [outline for outline in outlines if outline is not None]
        layout = replace_sites(layout, sites, remaining, sites, "shrunk by rules")
    lost_um2 = area_um2 - layout.area_um2
    for rule, found in shrunk.items():
        ids = tuple(sorted(site for site in found if lost_um2[site] > 0.0))
        if ids:
            changes.append(Change(rule, "shrunk", ids, tuple(lost_um2[list(ids)].tolist())))
    return layout


def _reach_um(violation: Violation, grid_um: float | None, n_retreating: int) -> float:
    """Return the distance from the other site to which a site that is too close retreats."""
    retreat_um = (violation.limit - violation.value) / n_retreating
    if grid_um:
        retreat_um = math.ceil(retreat_um / grid_um - GRID_ROUNDING) * grid_um
        return violation.value + retreat_um
    return violation.value + retreat_um + RETREAT_ROUNDING_UM


def _largest(shape: Any) -> Any:
    """Return the largest polygon of a shape, or None."""
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
    across_um = (rules.min_width_um or 0.0) * math.sqrt(0.5 * math.sqrt(3.0))
    return max(rules.min_size_um or 0.0, math.sqrt(rules.min_area_um2 or 0.0), across_um)


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
    """Merge sites that are too small with their neighbours, in rounds."""
    minimum_rules = rules.only(_is_minimum_rule)
    for _ in range(MAX_ROUNDS):
        report = layout.check(minimum_rules)
        if report.ok:
            break
        rule_of = {v.site_ids[0]: result.rule for result in reversed(report.results) for v in result.violations}
        group = joining_groups(layout, np.array(list(rule_of), dtype=np.int64))
        if np.array_equal(group, np.arange(layout.n_sites)):
            break
        groups, label = np.unique(group, return_inverse=True)
        layout, current_index = merge(layout, label), label[current_index]
        order = np.argsort(current_index, kind="stable")
        boundaries = np.searchsorted(current_index[order], np.arange(groups.size + 1))
        is_joined = np.bincount(label) > 1
        rule_of_group = {int(label[site]): rule for site, rule in rule_of.items()}
        for k in np.flatnonzero(is_joined).tolist():
            ids = order[boundaries[k] : boundaries[k + 1]]
            changes.append(Change(rule_of_group[k], "merged", tuple(sorted(int(i) for i in ids))))
    return layout, current_index


def _format_violations(report: Report) -> str:
    return "; ".join(str(result) for result in report.results if not result.ok)


def _is_minimum_rule(name: str) -> bool:
    """Return whether merging a site with a neighbour repairs violations of the rule."""
    return RULES[name].repair == "merge"
