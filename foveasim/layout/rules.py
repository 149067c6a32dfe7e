"""
Design rules: what a layout must keep to be made, and the report of where it does not.

A rule has a limit; a limit of None leaves the rule out. A check never raises: each rule answers one question and
returns its violations, one a photosite (or pair, or gap), and :func:`check` puts them into a report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim.arrays import Floats, check_number, finite_array
from foveasim.compiled import kernels
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout._model import Layout
from foveasim.rings import next_vertex

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
    min_size_um : float, optional, µm
        Smallest pixel size, the square root of a site's area.
    min_width_um : float, optional, µm
        Smallest distance between edges of a site that face each other across it.
    max_overlap_um2 : float, optional, µm²
        Largest area that two sites may both cover; 0 for none.
    max_gap_um2 : float, optional, µm²
        Largest area that may be left open: of the die where ``die_um`` is given, else of the holes between sites.
    die_um : (x_min, y_min, x_max, y_max), optional, µm
        The field that every site must lie in.

    Raises
    ------
    ParameterError
        When a limit is out of range.
    """

    min_size_um: float | None = None
    min_width_um: float | None = None
    max_overlap_um2: float | None = None
    max_gap_um2: float | None = None
    die_um: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        for rule in fields(self):
            value = getattr(self, rule.name)
            if value is not None and rule.name != "die_um":
                object.__setattr__(self, rule.name, check_number(rule.name, value, at_least=0.0))
        if self.die_um is not None:
            die = finite_array("die_um", self.die_um, ndim=1)
            if die.size != 4 or not (die[0] < die[2] and die[1] < die[3]):
                raise ParameterError("die_um", "must be (x_min, y_min, x_max, y_max)", self.die_um, "µm")
            object.__setattr__(self, "die_um", tuple(float(x) for x in die))


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
    """One rule's verdict: its name, sentence, limit and unit, and the violations, the worst first."""

    rule: str
    sentence: str
    limit: float
    unit: str
    violations: tuple[Violation, ...]

    def __str__(self) -> str:
        if self.worst is None:
            return f"{self.rule}: kept"
        count = f"{len(self.violations)} violation{'s' * (len(self.violations) != 1)}"
        return f"{self.rule}: {count}, worst {self.worst:.6g} {self.unit} for a limit of {self.limit:g} {self.unit}"

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
        """Whether no rule is broken."""
        return not self.violations

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
            lines = [str(result) for result in self.results if result.violations]
            ids = sorted({site for violation in self.violations for site in violation.site_ids})
            raise GeometryError("the layout breaks its design rules: " + "; ".join(lines), tuple(ids))

    def __str__(self) -> str:
        return "\n".join([f"design rules on {self.n_sites} photosites", *map(str, self.results)])

    def __rich__(self) -> Table:
        from rich.table import Table

        table = Table(title=f"Design rules on {self.n_sites} photosites")
        for heading in ("rule", "verdict", "count", "worst", "limit", "unit"):
            table.add_column(heading, justify="left" if heading in ("rule", "verdict", "unit") else "right")
        for r in self.results:
            worst = "" if r.worst is None else f"{r.worst:.6g}"
            verdict = "[red]fail[/red]" if r.violations else "[green]pass[/green]"
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
    polygons = layout.polygons()
    results = []
    for name, (sentence, unit, find) in RULES.items():
        limit = getattr(rules, name)
        if limit is not None:
            violations = tuple(find(layout, polygons, rules))
            results.append(RuleResult(name, sentence, 0.0 if name == "die_um" else limit, unit, violations))
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


def _too_small(name: str, values_um: Floats, limit_um: float, polygons: NDArray[Any]) -> list[Violation]:
    bad = np.flatnonzero(values_um < limit_um - LENGTH_ROUNDING_UM)
    bad = bad[np.argsort(values_um[bad], kind="stable")]
    return [Violation(name, (int(i),), float(values_um[i]), limit_um, "µm", polygons[i]) for i in bad]


def _small_sites(layout: Layout, polygons: NDArray[Any], rules: DesignRules) -> list[Violation]:
    assert rules.min_size_um is not None
    return _too_small("min_size_um", np.sqrt(layout.area_um2), rules.min_size_um, polygons)


def _narrow_sites(layout: Layout, polygons: NDArray[Any], rules: DesignRules) -> list[Violation]:
    assert rules.min_width_um is not None
    return _too_small("min_width_um", min_width_um(layout), rules.min_width_um, polygons)


def _overlaps(layout: Layout, polygons: NDArray[Any], rules: DesignRules) -> list[Violation]:
    limit_um2 = rules.max_overlap_um2
    assert limit_um2 is not None
    a, b = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    a, b = a[a < b], b[a < b]
    common = shapely.intersection(polygons[a], polygons[b])
    area_um2 = shapely.area(common)
    rounding_um2 = AREA_ROUNDING * np.minimum(layout.area_um2[a], layout.area_um2[b])
    bad = np.flatnonzero(area_um2 > limit_um2 + rounding_um2)
    bad = bad[np.argsort(-area_um2[bad], kind="stable")]
    return [
        Violation("max_overlap_um2", (int(a[i]), int(b[i])), float(area_um2[i]), limit_um2, "µm²", common[i])
        for i in bad
    ]


def _gaps(layout: Layout, polygons: NDArray[Any], rules: DesignRules) -> list[Violation]:
    limit_um2 = rules.max_gap_um2
    assert limit_um2 is not None
    covered = shapely.disjoint_subset_union_all(polygons)
    if rules.die_um is not None:
        opened = shapely.get_parts(shapely.difference(shapely.box(*rules.die_um), covered))
    else:
        parts = shapely.get_parts(covered)
        holes = shapely.union_all(shapely.polygons(shapely.get_rings(parts)[_is_hole(parts)]))
        opened = shapely.get_parts(shapely.difference(holes, covered))
    area_um2 = shapely.area(opened)
    rounding_um2 = AREA_ROUNDING * (layout.area_um2.min() if layout.n_sites else 0.0)
    bad = np.flatnonzero(area_um2 > limit_um2 + rounding_um2)
    bad = bad[np.argsort(-area_um2[bad], kind="stable")]
    gap, site = shapely.STRtree(polygons).query(opened[bad], predicate="intersects")
    around = np.split(site[np.argsort(gap, kind="stable")], np.cumsum(np.bincount(gap, minlength=bad.size)))[: bad.size]
    return [
        Violation("max_gap_um2", tuple(sorted(map(int, sites))), float(area_um2[i]), limit_um2, "µm²", opened[i])
        for i, sites in zip(bad, around, strict=True)
    ]


def _is_hole(polygons: NDArray[Any]) -> NDArray[np.bool_]:
    """Of the rings of some polygons, which are not the outlines."""
    n_rings = 1 + shapely.get_num_interior_rings(polygons)
    is_hole = np.ones(int(n_rings.sum()), bool)
    is_hole[np.cumsum(n_rings) - n_rings] = False
    return is_hole


def _outside_die(layout: Layout, polygons: NDArray[Any], rules: DesignRules) -> list[Violation]:
    assert rules.die_um is not None
    die = np.asarray(rules.die_um)
    box = layout.site_bounds_um
    beyond_um = np.maximum(die[:2] - box[:, :2], box[:, 2:] - die[2:]).max(axis=1, initial=-np.inf)
    bad = np.flatnonzero(beyond_um > LENGTH_ROUNDING_UM)
    bad = bad[np.argsort(-beyond_um[bad], kind="stable")]
    return [Violation("die_um", (int(i),), float(beyond_um[i]), 0.0, "µm", polygons[i]) for i in bad]


_Find = Callable[[Layout, NDArray[Any], DesignRules], list[Violation]]

#: Every rule: its sentence, the unit of its values, and the function that finds its violations.
RULES: Mapping[str, tuple[str, str, _Find]] = {
    "min_size_um": ("a site's size, the square root of its area, is at least the limit", "µm", _small_sites),
    "min_width_um": ("a site is nowhere narrower than the limit", "µm", _narrow_sites),
    "max_overlap_um2": ("no two sites cover more than the limit twice", "µm²", _overlaps),
    "max_gap_um2": ("no gap is larger than the limit", "µm²", _gaps),
    "die_um": ("no site reaches out of the die", "µm", _outside_die),
}
