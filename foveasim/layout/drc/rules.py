"""
Design rules: what a layout must keep to be made, and the report of where it does not.

A rule has a limit; a limit of None leaves the rule out. A check never raises: each rule measures something, what is
beyond the limit is a violation, one a photosite (or pair, or gap, or ring), and :func:`check` puts them into a report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import InitVar, dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.validation import Floats, check_choice, check_number, finite_array
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout.drc.measurements import RULES, Case, Measured, Rule, min_width_um
from foveasim.layout.drc.presets import PRESETS
from foveasim.layout.drc.routing import Readout, Routing
from foveasim.layout.model import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table

__all__ = ["RULES", "DesignRules", "Report", "RuleResult", "Violation", "check", "min_width_um"]


#: Parameters that hold something else than a number.
NOT_NUMBERS = {"custom", "die_um", "readout", "routing", "waivers"}
#: Limits that have an end, and those that cannot be 0.
MOST = {"min_angle_deg": 180.0, "edge_angle_step_deg": 180.0, "min_density": 1.0, "max_density": 1.0}
ABOVE_ZERO = ("min_angle_deg", "edge_angle_step_deg", "grid_um", "density_window_um")
#: What a rule needs beside its limit, and of which kind.
NEEDS: dict[str, tuple[str, type | None]] = {
    "min_density": ("density_window_um", None),
    "max_density": ("density_window_um", None),
    "max_data_rate_gbit_per_s": ("readout", Readout),
    "max_track_utilisation": ("routing", Routing),
}


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
        Longer over shorter side of the smallest rectangle, at any angle, around a site; of equally small ones the least
        elongated.
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
    min_density, max_density : float, optional
        Limits of the fraction of any window of ``density_window_um`` that sites fill. Windows move by half their side over the
        die, or the layout where none is given.
    density_window_um : float, optional, µm
        Side of that window.
    max_data_rate_gbit_per_s : float, optional, Gbit/s
        Largest data rate of one lane; needs ``readout``.
    readout : Readout, optional
        Frames, bits, blanking and lanes.
    max_track_utilisation : float, optional
        Largest number of readout lines for each track that they have, wherever lines begin; 1 where all must get out
        (see :func:`foveasim.layout.track_demand`); needs ``routing``.
    routing : Routing, optional
        Tracks, layers and direction of the lines.
    waivers : mapping of str to str, optional
        Rules that may be broken, each with the reason. They are checked and reported all the same.
    custom : mapping of str to float, optional
        Limits of further rules, by the names under which they are registered in :data:`foveasim.layout.drc.RULES`.
    preset : str, optional
        Name of one of :data:`foveasim.layout.PRESETS`, whose limits stand where none is given here.

    Raises
    ------
    ParameterError
        When a limit is out of range, or what a rule needs beside its limit is not given.

    Examples
    --------
    >>> DesignRules(preset="sky130_met1", min_space_um=0.2).min_width_um
    0.14
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
    min_density: float | None = None
    max_density: float | None = None
    density_window_um: float | None = None
    max_data_rate_gbit_per_s: float | None = None
    readout: Readout | None = None
    max_track_utilisation: float | None = None
    routing: Routing | None = None
    waivers: Mapping[str, str] | None = None
    custom: Mapping[str, float] | None = None
    preset: InitVar[str | None] = None

    def __post_init__(self, preset: str | None) -> None:
        if preset is not None:
            for name, limit in PRESETS[check_choice("preset", preset, tuple(PRESETS))].limits.items():
                if getattr(self, name) is None:
                    object.__setattr__(self, name, limit)
        for rule in fields(self):
            value = getattr(self, rule.name)
            if value is not None and rule.name not in NOT_NUMBERS:
                object.__setattr__(self, rule.name, check_number(rule.name, value, at_least=0.0))
        for name, most in MOST.items():
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), at_most=most)
        for name in ABOVE_ZERO:
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=0.0)
        for name, (needed, kind) in NEEDS.items():
            value = getattr(self, needed)
            if value is None and getattr(self, name) is not None:
                raise ParameterError(needed, f"must be given for '{name}'")
            if kind is not None and value is not None and not isinstance(value, kind):
                raise ParameterError(needed, f"must be a {kind.__name__}", value)
        if self.die_um is not None:
            die = finite_array("die_um", self.die_um, ndim=1)
            if die.size != 4 or not (die[0] < die[2] and die[1] < die[3]):
                raise ParameterError("die_um", "must be (x_min, y_min, x_max, y_max)", self.die_um, "µm")
            object.__setattr__(self, "die_um", tuple(float(x) for x in die))
        if self.custom is not None and not isinstance(self.custom, Mapping):
            raise ParameterError("custom", "must be limits by the names of rules", self.custom)
        custom = {}
        for name, limit in dict(self.custom or {}).items():
            RULES.find("custom", name)
            if name in {rule.name for rule in fields(self)}:
                raise ParameterError("custom", f"must name further rules; '{name}' is a parameter of its own")
            custom[name] = check_number(f"custom[{name}]", limit)
        object.__setattr__(self, "custom", custom)
        waivers = dict(self.waivers or {})
        for name, reason in waivers.items():
            if name not in RULES:
                raise ParameterError("waivers", f"must name rules ({', '.join(RULES)})", name)
            if not isinstance(reason, str) or not reason.strip():
                raise ParameterError("waivers", f"must give a reason for '{name}'", reason)
        object.__setattr__(self, "waivers", waivers)

    def only(self, keep: Callable[[str], bool]) -> DesignRules:
        """Return the same limits for the rules whose names are kept, and none for others."""
        own = {rule.name for rule in fields(self)}
        return replace(
            self,
            custom={name: limit for name, limit in (self.custom or {}).items() if keep(name)},
            **{name: None for name in RULES if name in own and not keep(name)},
        )

    def limits(self) -> dict[str, Any]:
        """Return the limits that are set, by the names of their rules, in the order of the rules."""
        custom = self.custom or {}
        found = {name: custom.get(name, getattr(self, name, None)) for name in RULES}
        return {name: limit for name, limit in found.items() if limit is not None}


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


@dataclass(frozen=True, eq=False)
class RuleResult:
    """
    One rule's verdict.

    Attributes
    ----------
    rule, description : str
        Name, and what it asks.
    limit : float
        In ``unit``.
    unit : str
    values : (n_violation,) float64
        What was measured where the rule is broken, the worst first.
    waiver : str or None
        Why the rule may be broken.
    """

    rule: str
    description: str
    limit: float
    unit: str
    values: Floats
    waiver: str | None
    _places: Callable[[], tuple[Any, Any]]

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """The places where the rule is broken, the worst first; made when they are asked for."""
        if self.values.size == 0:
            return ()
        sites, markers = self._places()
        return tuple(
            Violation(self.rule, tuple(int(site) for site in ids), value, self.limit, self.unit, marker)
            for ids, value, marker in zip(sites, self.values.tolist(), markers, strict=True)
        )

    def __len__(self) -> int:
        return self.values.size

    def __reduce__(self) -> tuple[Any, ...]:
        # The places are functions of the layout: only what they give can be sent.
        found = self.violations
        places = ([v.site_ids for v in found], [v.marker for v in found])
        return RuleResult, (
            self.rule, self.description, self.limit, self.unit, self.values, self.waiver, partial(tuple, places)
        )  # fmt: skip

    @property
    def ok(self) -> bool:
        """Whether the rule is kept, or waived."""
        return self.values.size == 0 or self.waiver is not None

    def __str__(self) -> str:
        if self.worst is None:
            return f"{self.rule}: kept"
        count = f"{self.values.size} violation{'s' * (self.values.size != 1)}"
        waived = "" if self.waiver is None else f" (waived: {self.waiver})"
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.rule}: {count}, worst {self.worst:.6g}{unit} for a limit of {self.limit:g}{unit}{waived}"

    @property
    def worst(self) -> float | None:
        """The value furthest beyond the limit, or None."""
        return float(self.values[0]) if self.values.size else None


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

    def plot(self, layout: Layout | None = None, **options: Any) -> Axes:
        """Draw the places where rules are broken, on the layout that was checked; see :func:`foveasim.view.plot_report`."""
        from foveasim.view import plot_report

        return plot_report(self, layout, **options)

    def write(self, path: str | Path) -> None:
        """Write a KLayout report database (``.lyrdb``); see :func:`foveasim.layout.drc.report.write_lyrdb`."""
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
    case = Case(layout, rules)
    results = []
    for name, limit in rules.limits().items():
        rule = RULES[name]
        bound = 0.0 if rule.is_deviation else float(limit)
        values, places = _broken(rule, _measured(name, rule, case), bound, case)
        waiver = (rules.waivers or {}).get(name)
        results.append(RuleResult(name, rule.description, bound, rule.unit, values, waiver, places))
    return Report(layout.n_sites, tuple(results))


def _measured(name: str, rule: Rule, case: Case) -> Measured:
    """What a rule measures; an array has one value per site."""
    found = rule.measure(case)
    if isinstance(found, Measured):
        return found
    values = finite_array(name, found)
    if values.shape != (case.layout.n_sites,):
        n_sites = case.layout.n_sites
        raise ParameterError(
            "custom", f"rule '{name}' must measure one value for each of the {n_sites} sites", values.shape
        )
    return Measured(values)


def _broken(rule: Rule, found: Measured, limit: float, case: Case) -> tuple[Floats, Callable[[], tuple[Any, Any]]]:
    """The values that break the limit, the worst first, and what gives their sites and markers."""
    beyond = rule.excess(found.values, limit)
    bad = np.flatnonzero(beyond > rule.rounding)
    bad = bad[np.argsort(-beyond[bad], kind="stable")]

    def places() -> tuple[Any, Any]:
        return (
            bad[:, np.newaxis] if found.sites is None else found.sites(bad),
            case.shapes(bad) if found.markers is None else found.markers(bad),
        )

    return found.values[bad], places
