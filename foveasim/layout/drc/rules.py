"""
Design rules that a layout must satisfy to be manufactured, and reports of violations.

A rule has a limit; a limit of None disables the rule. Each rule measures a quantity per photosite (or pair, gap or ring),
and values beyond the limit are violations. :func:`check` does not raise on violations, it collects them in a report.

Rules hold for what will be manufactured: distances, angles, overlaps and gaps are those of the outlines on the database grid,
as files contain them. Sizes, areas and ratios are those of the drawn outlines, which rounding changes by about one unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import InitVar, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from foveasim._core.calls import FRACTION, NOT_NEGATIVE, POSITIVE, Limits, OwnCheck, check_declared
from foveasim._core.names import possible_names
from foveasim._core.short_repr import short_repr
from foveasim._core.show import ViewMethod, view_method
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_choice, check_count, check_number, finite_array
from foveasim.errors import GeometryError, ParameterError, type_name
from foveasim.layout.database_grid import DEFAULT_DBU_UM
from foveasim.layout.drc.measurements import RULES, Case, Measurement, Rule, min_width_um
from foveasim.layout.drc.presets import PRESETS
from foveasim.layout.drc.routing import Readout, Routing
from foveasim.layout.model import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table

__all__ = ["RULES", "DesignRules", "Report", "RuleResult", "Violation", "check", "min_width_um"]


ANGLE = Limits(at_least=0.0, above=0.0, at_most=180.0)
FACING_ANGLE = Limits(above=0.0, at_most=90.0)
#: Further parameter that a rule requires.
REQUIRED = {
    "min_density": "density_window_um",
    "max_density": "density_window_um",
    "max_data_rate_gbit_per_s": "readout",
    "max_track_utilisation": "routing",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignRules:
    """
    Limits of the design rules of a layout; None disables a rule.

    Parameters
    ----------
    min_size_um, max_size_um : float, optional, µm
        Minimum and maximum size of a site, the square root of its area.
    min_area_um2 : float, optional, µm²
        Minimum area of a site.
    min_hole_um2 : float, optional, µm²
        Minimum area of a hole in a site.
    min_width_um : float, optional, µm
        Minimum Euclidean distance between edges of a site that face each other across it, at an angle below
        ``angle_limit_deg``, as in KLayout's ``width`` with its option ``transparent``: pairs of edges behind other edges
        count, too.
    min_space_um : float, optional, µm
        Minimum Euclidean distance between two sites, and between edges that face each other across a notch, slit or hole of a
        site, as in KLayout's ``space``. Sites that touch or overlap have the distance 0. To check the spacing of the
        photosensitive areas of abutting sites, apply an inset first.
    max_aspect_ratio : float, optional
        Maximum ratio of the longer to the shorter side of the minimum-area rectangle, at any angle, around a site. Of
        several such rectangles, the least elongated one counts.
    min_angle_deg : float, optional, degrees
        Minimum interior angle of a corner.
    edge_angle_step_deg : float, optional, degrees
        Angle of which all edge angles must be multiples, for example 90 or 45.
    grid_um : float, optional, µm
        Manufacturing grid; coordinates on the database grid must be multiples of it.
    max_overlap_um2 : float, optional, µm²
        Maximum overlap of two sites; 0 allows none wider than the rounding of vertices.
    max_gap_um2 : float, optional, µm²
        Maximum area of a gap (a connected area without sites), within ``die_um`` where it is given, else enclosed by sites.
    die_um : (x_min, y_min, x_max, y_max), optional, µm
        Rectangle that must contain every site.
    min_growth, max_growth : float, optional
        Limits of the ratio of the mean site size of a ring (column ``ring``) to that of the next inner ring.
    max_neighbour_ratio : float, optional
        Maximum ratio of the sizes of two sites that share an edge.
    max_sites : int, optional
        Maximum number of sites.
    min_density, max_density : float, optional
        Limits of the fill factor of every window of ``density_window_um``. Windows advance by half their side over the die,
        or over the bounding box of the layout where no die is given.
    density_window_um : float, optional, µm
        Side of the windows.
    max_data_rate_gbit_per_s : float, optional, Gbit/s
        Maximum data rate of one lane; requires ``readout``.
    readout : Readout, optional
        Frame rate, bits, blanking and lanes.
    max_track_utilisation : float, optional
        Maximum number of readout lines per available track at every strip where lines begin; 1 for a routable layout
        (see :func:`foveasim.layout.track_demand`); requires ``routing``.
    routing : Routing, optional
        Tracks, metal layers and direction of the lines.
    waivers : mapping of str to str, optional
        Rules that may be violated, each with the reason. They are still checked and reported.
    dbu_um : float, µm
        Database unit: rules apply to outlines whose vertices are rounded to multiples of it.
    angle_limit_deg : float, degrees
        Edges that enclose a smaller angle face each other. The default is that of KLayout: corners below 90 degrees have the
        width 0, also those between the sides and the chord of an annular site. A smaller limit, at most ``min_angle_deg``,
        leaves corners to that rule.
    custom : mapping of str to float, optional
        Limits of further rules, by their names in :data:`foveasim.layout.drc.RULES`.
    preset : str, optional
        Name of one of :data:`foveasim.layout.PRESETS`, whose limits are the defaults of limits not given here.

    Raises
    ------
    ParameterError
        When a limit is out of range, or a further parameter that a rule requires is missing.

    Examples
    --------
    >>> DesignRules(preset="sky130_met1", min_space_um=0.2).min_width_um
    0.14
    """

    min_size_um: Annotated[float | None, NOT_NEGATIVE] = None
    max_size_um: Annotated[float | None, NOT_NEGATIVE] = None
    min_area_um2: Annotated[float | None, NOT_NEGATIVE] = None
    min_hole_um2: Annotated[float | None, NOT_NEGATIVE] = None
    min_width_um: Annotated[float | None, NOT_NEGATIVE] = None
    min_space_um: Annotated[float | None, NOT_NEGATIVE] = None
    max_aspect_ratio: Annotated[float | None, NOT_NEGATIVE] = None
    min_angle_deg: Annotated[float | None, ANGLE] = None
    edge_angle_step_deg: Annotated[float | None, ANGLE] = None
    grid_um: Annotated[float | None, POSITIVE] = None
    max_overlap_um2: Annotated[float | None, NOT_NEGATIVE] = None
    max_gap_um2: Annotated[float | None, NOT_NEGATIVE] = None
    die_um: OwnCheck[tuple[float, float, float, float] | None] = None
    min_growth: Annotated[float | None, NOT_NEGATIVE] = None
    max_growth: Annotated[float | None, NOT_NEGATIVE] = None
    max_neighbour_ratio: Annotated[float | None, NOT_NEGATIVE] = None
    max_sites: Annotated[int | None, NOT_NEGATIVE] = None
    min_density: Annotated[float | None, FRACTION] = None
    max_density: Annotated[float | None, FRACTION] = None
    density_window_um: Annotated[float | None, POSITIVE] = None
    max_data_rate_gbit_per_s: Annotated[float | None, NOT_NEGATIVE] = None
    readout: Readout | None = None
    max_track_utilisation: Annotated[float | None, NOT_NEGATIVE] = None
    routing: Routing | None = None
    waivers: Mapping[str, str] | None = None
    dbu_um: Annotated[float, POSITIVE] = DEFAULT_DBU_UM
    angle_limit_deg: Annotated[float, FACING_ANGLE] = 90.0
    custom: Mapping[str, float] | None = None
    preset: InitVar[str | None] = None

    __repr__ = short_repr

    def __post_init__(self, preset: str | None) -> None:
        if preset is not None:
            for name, limit in PRESETS[check_choice("preset", preset, tuple(PRESETS))].limits.items():
                if getattr(self, name) is None:
                    object.__setattr__(self, name, limit)
        check_declared(self)
        for name, required in REQUIRED.items():
            if getattr(self, required) is None and getattr(self, name) is not None:
                raise ParameterError(required, f"must be given for '{name}'")
        if self.die_um is not None:
            die = finite_array("die_um", self.die_um, ndim=1)
            if die.size != 4 or not (die[0] < die[2] and die[1] < die[3]):
                raise ParameterError("die_um", "must be (x_min, y_min, x_max, y_max)", self.die_um, "µm")
            object.__setattr__(self, "die_um", tuple(float(x) for x in die))
        custom = {}
        for name, limit in dict(self.custom or {}).items():
            RULES.find("custom", name)
            if name in {rule.name for rule in fields(self)}:
                raise ParameterError("custom", f"must contain registered rules only; set '{name}' as a parameter")
            custom[name] = check_number(f"custom[{name}]", limit)
        object.__setattr__(self, "custom", custom)
        waivers = dict(self.waivers or {})
        for name, reason in waivers.items():
            if name not in RULES:
                hint = possible_names(name, list(RULES))
                raise ParameterError("waivers", "must have names of rules as keys", name, hint=hint)
            if not isinstance(reason, str) or not reason.strip():
                raise ParameterError("waivers", f"must give a reason for '{name}'", reason)
        object.__setattr__(self, "waivers", waivers)

    def only(self, keep: Callable[[str], bool]) -> DesignRules:
        """Return the same limits for the rules that ``keep`` selects, and None for others."""
        own = {rule.name for rule in fields(self)}
        changes: dict[str, Any] = {name: None for name in RULES if name in own and not keep(name)}
        custom = {name: limit for name, limit in (self.custom or {}).items() if keep(name)}
        return replace(self, custom=custom, **changes)

    def limits(self) -> dict[str, Any]:
        """Return the limits that are set by rule name, in the order of the rules."""
        custom = self.custom or {}
        found = {name: custom.get(name, getattr(self, name, None)) for name in RULES}
        return {name: limit for name, limit in found.items() if limit is not None}


@dataclass(frozen=True, slots=True)
class Violation:
    """
    Violation of a rule at one location.

    Attributes
    ----------
    rule : str
        Name of the rule.
    site_ids : tuple of int
        Indices of the site, or of the sites at the location.
    value, limit : float
        Measured value and limit, in ``unit``.
    unit : str
    marker : shapely geometry
        Location, in µm.

    Examples
    --------
    >>> import foveasim as fs
    >>> report = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0).check(
    ...     fs.DesignRules(min_size_um=2.5)
    ... )
    >>> violation = report.violations[0]
    >>> violation.rule, violation.value, violation.limit, violation.unit
    ('min_size_um', 2.0, 2.5, 'µm')
    """

    rule: str
    site_ids: tuple[int, ...]
    value: float
    limit: float
    unit: str
    marker: Any

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class RuleResult:
    """
    Result of one rule.

    Attributes
    ----------
    rule, description : str
        Name, and the condition that the rule requires.
    limit : float
        Limit, in ``unit``.
    unit : str
    values : (n_violation,) float64
        Measured values of the violations, the worst first.
    waiver : str or None
        Reason why the rule may be violated.
    note : str
        Cause of violations, such as sites that touch.
    """

    rule: str
    description: str
    limit: float
    unit: str
    values: Floats
    waiver: str | None
    _locate: Callable[[slice], tuple[Any, Any]]
    note: str = ""

    __repr__ = short_repr

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """Violations of the rule, the worst first; computed on first access."""
        return self._violations(slice(None))

    def worst_violations(self, n: int) -> tuple[Violation, ...]:
        """Return at most n violations, the worst first, without computing the others."""
        n = check_count("n", n)
        return self._violations(slice(n)) if n < self.values.size else self.violations

    def _violations(self, part: slice) -> tuple[Violation, ...]:
        values = self.values[part].tolist()
        if not values:
            return ()
        sites, markers = self._locate(part)
        return tuple(
            Violation(self.rule, tuple(int(site) for site in ids), value, self.limit, self.unit, marker)
            for ids, value, marker in zip(sites, values, markers, strict=True)
        )

    def __len__(self) -> int:
        return self.values.size

    def __reduce__(self) -> tuple[Any, ...]:
        # Sites and markers are functions of the layout; only their results can be pickled.
        found = self.violations
        locations = ([v.site_ids for v in found], [v.marker for v in found])
        return RuleResult, (
            self.rule, self.description, self.limit, self.unit, self.values, self.waiver, partial(_select, *locations),
            self.note,
        )  # fmt: skip

    @property
    def ok(self) -> bool:
        """Whether the rule is satisfied or waived."""
        return self.values.size == 0 or self.waiver is not None

    def __str__(self) -> str:
        note = f" ({self.note})" if self.note else ""
        if self.worst is None:
            return f"{self.rule}: satisfied{note}"
        count = f"{self.values.size} violation{'s' * (self.values.size != 1)}"
        waived = "" if self.waiver is None else f" (waived: {self.waiver})"
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.rule}: {count}, worst {self.worst:.6g}{unit}, limit {self.limit:g}{unit}{waived}{note}"

    @property
    def worst(self) -> float | None:
        """Value furthest beyond the limit, or None."""
        return float(self.values[0]) if self.values.size else None


@dataclass(frozen=True)
class Report:
    """
    Report of a design rule check.

    Attributes
    ----------
    n_sites : int
        Number of sites of the layout.
    results : tuple of RuleResult
        One result per rule with a limit.
    layout : Layout, optional
        The checked layout, for drawings; None for reports of files.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    >>> report = layout.check(fs.DesignRules(min_size_um=2.5, max_overlap_um2=0.0))
    >>> report.ok, {result.rule: len(result.values) for result in report.results}
    (False, {'min_size_um': 16, 'max_overlap_um2': 0})
    """

    n_sites: int
    results: tuple[RuleResult, ...]
    layout: Layout | None = field(default=None, compare=False, repr=False)

    def __repr__(self) -> str:
        n_satisfied, n_violations = sum(len(r) == 0 for r in self.results), sum(map(len, self.results))
        n_waived = sum(len(r) > 0 and r.waiver is not None for r in self.results)
        waived = f", {n_waived} waived" if n_waived else ""
        return (
            f"Report({n_satisfied} of {len(self.results)} rules satisfied{waived}, {n_violations:,} violations, "
            f"{self.n_sites:,} photosites)"
        )

    @property
    def ok(self) -> bool:
        """Whether all rules are satisfied or waived."""
        return all(result.ok for result in self.results)

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """All violations, grouped by rule, the worst first."""
        return tuple(violation for result in self.results for violation in result.violations)

    def raise_if_failed(self) -> None:
        """
        Raise an error when a rule is violated and not waived.

        Raises
        ------
        GeometryError
            With the results of all violated rules, and the sites in ``.site_ids``.
        """
        if not self.ok:
            failed = [result for result in self.results if not result.ok]
            lines = [str(result) for result in failed]
            ids = sorted({site for result in failed for violation in result.violations for site in violation.site_ids})
            raise GeometryError("the layout violates its design rules: " + "; ".join(lines), tuple(ids))

    def records(self) -> list[dict[str, Any]]:
        """
        Return one dict per violation, for tables.

        The keys are rule, site_ids, value, limit, unit, and x_um and y_um of the marker centroid.
        """
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

    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_report")
    _repr_html_ = view_method("to_html")

    def write(self, path: str | Path) -> None:
        """
        Write a KLayout report database (``.lyrdb``).

        See :func:`foveasim.layout.drc.report.write_lyrdb`.
        """
        from foveasim.layout.drc.report import write_lyrdb

        write_lyrdb(self, path)

    def __str__(self) -> str:
        return "\n".join([f"design rules on {self.n_sites} photosites", *map(str, self.results)])

    def __rich__(self) -> Table:
        from rich.table import Table
        from rich.text import Text

        table = Table(title=f"Design rules on {self.n_sites} photosites")
        for heading in ("rule", "verdict", "count", "worst", "limit", "unit"):
            table.add_column(heading, justify="left" if heading in ("rule", "verdict", "unit") else "right")
        for r in self.results:
            worst = "" if r.worst is None else f"{r.worst:.6g}"
            verdict = (
                Text("pass", "green")
                if r.values.size == 0
                else Text("fail", "red")
                if not r.ok
                else Text("waived", "yellow")
            )
            table.add_row(r.rule, verdict, f"{r.values.size}", worst, f"{r.limit:g}", r.unit)
        notes = [f"{r.rule}: {r.note}" for r in self.results if r.note]
        table.caption, table.caption_justify = "\n".join(notes) or None, "left"
        return table


def _select(sites: Sequence[Any], markers: Sequence[Any], part: slice) -> tuple[Any, Any]:
    """Return sites and markers of a part of the violations."""
    return sites[part], markers[part]


def check(layout: Layout, rules: DesignRules) -> Report:
    """
    Check a layout against design rules.

    Parameters
    ----------
    layout : Layout
    rules : DesignRules

    Returns
    -------
    Report
        One result per rule with a limit.
    """
    if not isinstance(rules, DesignRules):
        raise ParameterError("rules", f"must be DesignRules, got {type_name(rules)}")
    case = Case(layout, rules)
    results = []
    for name, limit in rules.limits().items():
        rule = RULES[name]
        bound = 0.0 if rule.is_deviation else float(limit)
        found = _measure(name, rule, case)
        values, locate = _violations(rule, found, bound, case)
        waiver = (rules.waivers or {}).get(name)
        results.append(RuleResult(name, rule.description, bound, rule.unit, values, waiver, locate, found.note))
    if case.lost_sites.size:
        results.append(_lost_on_grid(case))
    return Report(layout.n_sites, tuple(results), layout)


def _lost_on_grid(case: Case) -> RuleResult:
    """Return the violations of sites that no file can contain."""
    lost, dbu_um = case.lost_sites, case.rules.dbu_um

    def locate(part: slice) -> tuple[Any, Any]:
        return lost[part][:, np.newaxis], case.shapes(lost[part])

    return RuleResult(
        "dbu_um", "outlines keep an area and do not cross themselves on the database grid", dbu_um, "µm",
        np.full(lost.size, dbu_um), None, locate,
    )  # fmt: skip


def _measure(name: str, rule: Rule, case: Case) -> Measurement:
    """Return the measurements of a rule; arrays must have one value per site."""
    found = rule.measure(case)
    if isinstance(found, Measurement):
        return found
    values = finite_array(name, found)
    if values.shape != (case.layout.n_sites,):
        n_sites = case.layout.n_sites
        raise ParameterError(
            "custom", f"rule '{name}' must return one value for each of the {n_sites} sites", values.shape
        )
    return Measurement(values)


def _violations(
    rule: Rule, found: Measurement, limit: float, case: Case
) -> tuple[Floats, Callable[[slice], tuple[Any, Any]]]:
    """Return the values beyond the limit, worst first, and a getter of sites and markers."""
    beyond = rule.excess(found.values, limit)
    bad = np.flatnonzero(beyond > rule.rounding)
    bad = bad[np.argsort(-beyond[bad], kind="stable")]

    def locate(part: slice) -> tuple[Any, Any]:
        chosen = bad[part]
        return (
            chosen[:, np.newaxis] if found.sites is None else found.sites(chosen),
            case.shapes(chosen) if found.markers is None else found.markers(chosen),
        )

    return found.values[bad], locate
