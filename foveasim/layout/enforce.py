"""Repairing a layout until it keeps its rules, and telling what was changed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from foveasim.arrays import Bools, Ints, check_choice
from foveasim.errors import GeometryError
from foveasim.layout._model import Layout
from foveasim.layout.adjacency import adjacency
from foveasim.layout.edits import merge
from foveasim.layout.rules import RULES, DesignRules, Report, RuleResult

__all__ = ["Change", "enforce"]

#: Rules that a site breaks by itself, so that taking it away mends them.
SITE_RULES = (
    "min_size_um", "max_size_um", "min_area_um2", "min_hole_um2", "min_width_um", "max_aspect_ratio", "min_angle_deg",
    "edge_angle_step_deg", "grid_um", "die_um",
)  # fmt: skip
#: Rules that a pair of sites breaks: the smaller of the two is taken away.
PAIR_RULES = ("max_overlap_um2", "min_space_um")
#: Rules that a site breaks by being too small, so that joining it to a neighbour mends them.
SMALLNESS_RULES = ("min_size_um", "min_area_um2", "min_width_um")
#: Rounds of merging: a merged site may still be too small.
MAX_ROUNDS = 100


@dataclass(frozen=True, slots=True)
class Change:
    """
    What was done to some sites, and for which rule.

    Attributes
    ----------
    rule : str
    action : {"dropped", "merged"}
    site_ids : tuple of int
        Numbers of the sites in the layout that was given; merged sites with the ones they were joined to.
    """

    rule: str
    action: Literal["dropped", "merged"]
    site_ids: tuple[int, ...]


def enforce(
    layout: Layout, rules: DesignRules, *, repair: Literal["drop", "merge"] = "drop"
) -> tuple[Layout, tuple[Change, ...]]:
    """
    A layout that keeps the rules, made from one that may not.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules
        Waived rules are left broken.
    repair : {"drop", "merge"}
        ``"drop"`` takes away the sites that break a rule (of two that overlap or are too near, the smaller one): a minimum
        size leaves the blind spot of a foveal layout. ``"merge"`` first joins sites that are too small to the neighbour with
        which they share most edge, as often as it takes, and drops what is left.

    Returns
    -------
    layout : Layout
    changes : tuple of Change

    Raises
    ------
    GeometryError
        When a rule is broken that no taking away of sites mends: gaps, growth, neighbours' ratio, the number of sites.

    Examples
    --------
    >>> from foveasim.layout import log_polar
    >>> rings = log_polar(n_sectors=32, r_min_um=2.0, r_max_um=50.0)
    >>> legal, changes = enforce(rings, DesignRules(min_size_um=1.0))
    >>> rings.n_sites, legal.n_sites, changes[0].action
    (512, 352, 'dropped')
    """
    check_choice("repair", repair, ("drop", "merge"))
    waivers = rules.waivers or {}
    mendable = (*SITE_RULES, *PAIR_RULES)
    active = replace(rules, **{name: None for name in RULES if name in waivers or name not in mendable})
    now = np.arange(layout.n_sites)  # where each given site is now; -1 for one that was dropped
    changes: list[Change] = []
    if repair == "merge":
        layout, now = _merged(layout, active, now, changes)
    report = layout.check(active)
    while not report.ok:
        gone = np.zeros(layout.n_sites, bool)
        for result in report.results:
            new = _guilty(layout, result, gone)
            gone[new] = True
            ids = np.flatnonzero(np.isin(now, new))
            if ids.size:
                changes.append(Change(result.rule, "dropped", tuple(int(i) for i in ids)))
        now = np.where((now >= 0) & ~gone[now], (np.cumsum(~gone) - 1)[now], -1)
        layout = layout[~gone]
        report = layout.check(active)
    rest = layout.check(replace(rules, **dict.fromkeys(mendable)))
    if not rest.ok:
        raise GeometryError(f"taking away sites does not mend every rule: {_broken(rest)}")
    return layout, tuple(changes)


def _guilty(layout: Layout, result: RuleResult, gone: Bools) -> Ints:
    """Sites that a rule takes away beyond those that go already: of a pair the smaller one, unless one of them goes."""
    going = set(np.flatnonzero(gone).tolist())
    new = set()
    for violation in result.violations:
        site = min(violation.site_ids, key=lambda i: float(layout.area_um2[i]))
        if not going & set(violation.site_ids):
            new.add(site)
            going.add(site)
    return np.array(sorted(new), dtype=np.int64)


def _merged(layout: Layout, rules: DesignRules, now: Ints, changes: list[Change]) -> tuple[Layout, Ints]:
    """Sites that are too small joined to their neighbours, round after round."""
    smallness = replace(rules, **{name: None for name in RULES if name not in SMALLNESS_RULES})
    for _ in range(MAX_ROUNDS):
        report = layout.check(smallness)
        if report.ok:
            break
        shared_um = adjacency(layout)
        group = np.arange(layout.n_sites)
        rule_of: dict[int, str] = {}
        is_taken = np.zeros(layout.n_sites, bool)
        for result in report.results:
            for violation in result.violations:
                site = violation.site_ids[0]
                row = slice(shared_um.indptr[site], shared_um.indptr[site + 1])
                others, lengths = shared_um.indices[row], shared_um.data[row]
                free = ~is_taken[others]
                if is_taken[site] or not free.any():
                    continue
                partner = int(others[free][lengths[free].argmax()])
                is_taken[[site, partner]] = True
                group[max(site, partner)] = min(site, partner)
                rule_of[min(site, partner)] = result.rule
        if not rule_of:
            break
        kept, label = np.unique(group, return_inverse=True)
        layout, now = merge(layout, label), label[now]
        order = np.argsort(now, kind="stable")
        borders = np.searchsorted(now[order], np.arange(kept.size + 1))
        for k, name in enumerate(kept.tolist()):
            if name in rule_of:
                ids = order[borders[k] : borders[k + 1]]
                changes.append(Change(rule_of[name], "merged", tuple(sorted(int(i) for i in ids))))
    return layout, now


def _broken(report: Report) -> str:
    return "; ".join(str(result) for result in report.results if not result.ok)
