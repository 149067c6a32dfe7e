"""Interleaved timing, and the table of ratios."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from machine import OtherProcesses, describe_machine
from rich.table import Table

#: Modules of Python whose compilation to bytecode measures the speed of the machine.
MODULES = ("_pydecimal", "argparse", "doctest", "inspect", "tarfile", "typing")
#: Their processor time on the machine for which bounds in seconds hold: 1/1.6 of that measured on a second machine, with the
#: median ratio of five start-up times of the package on both.
REFERENCE_S = 0.058


def best_s(
    calls: dict[str, Callable[[], object]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """
    Return the minimum time of each call; calls are interleaved, so that slow phases of the machine affect all.

    With ``time.process_time`` as clock, it is the processor time of all threads.
    """
    seconds = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            start = clock()
            call()
            seconds[name] = min(seconds[name], clock() - start)
    return seconds


def compile_modules_s() -> float:
    """Return the processor time in which Python compiles :data:`MODULES`, without reading them."""
    paths = [spec.origin for spec in map(importlib.util.find_spec, MODULES) if spec is not None and spec.origin]
    sources = [Path(path).read_text("utf-8") for path in paths]

    def call() -> None:
        for source in sources:
            compile(source, "", "exec")

    return best_s({"compile": call}, 5, time.process_time)["compile"]


@dataclass(frozen=True)
class Row:
    """A figure, its times, and its bound, if any."""

    what: str
    took: str
    against: str
    other_took: str
    figure: float
    bound: float | None = None
    is_lower_bound: bool = False
    is_repeated: bool = False

    @property
    def is_missed(self) -> bool:
        """Whether the figure does not satisfy its bound."""
        if self.bound is None:
            return False
        return not (self.figure >= self.bound if self.is_lower_bound else self.figure <= self.bound)

    def better(self, other: Row) -> Row:
        """Return the better of this row and of the same row measured again."""
        is_better = other.figure > self.figure if self.is_lower_bound else other.figure < self.figure
        return replace(other if is_better else self, is_repeated=True)

    def cells(self, *, is_judged: bool) -> tuple[str, ...]:
        """Return the cells of the table."""
        sign = "≥" if self.is_lower_bound else "≤"
        shown = "" if self.bound is None else f"{sign} {self.bound:g}"
        verdict = ""
        if self.bound is not None and is_judged:
            verdict = "[red]missed[/red]" if self.is_missed else "[green]kept[/green]"
            verdict += ", measured twice" if self.is_repeated else ""
        return self.what, self.took, self.against, self.other_took, f"{self.figure:.3g}", shown, verdict


class Report:
    """Table of ratios, and the number of missed bounds."""

    def __init__(self, *, is_judged: bool) -> None:
        self.is_judged = is_judged
        self.rows: list[Row] = []
        self._others = OtherProcesses()

    @property
    def table(self) -> Table:
        """All rows."""
        table = Table(title="Ratios, each within one run")
        for heading in ("what", "time", "against", "its time", "ratio", "bound", ""):
            table.add_column(heading, justify="left" if heading in {"what", "against", ""} else "right")
        for row in self.rows:
            table.add_row(*row.cells(is_judged=self.is_judged))
        return table

    @property
    def missed(self) -> int:
        """Number of rows that do not satisfy their bounds."""
        return sum(row.is_missed for row in self.rows) if self.is_judged else 0

    def summary(self) -> str:
        """Return the machine, its load since the report was created, and the rows that were measured again."""
        again = [f"{row.what} ({row.against})" if row.against else row.what for row in self.rows if row.is_repeated]
        lines = [describe_machine(), f"during the run, {self._others.describe()}; bounds hold on an idle machine"]
        return "\n".join([*lines, f"measured again: {'; '.join(again) or 'no row'}"])

    def measure(self, bench: Callable[..., object], *args: object) -> None:
        """Call a benchmark, and again when rows miss their bounds: the better figures of these rows count."""
        start = len(self.rows)
        bench(self, *args)
        if not self.is_judged or not any(row.is_missed for row in self.rows[start:]):
            return
        first = self.rows[start:]
        del self.rows[start:]
        bench(self, *args)
        second = self.rows[start:]
        self.rows[start:] = [a.better(b) if a.is_missed else a for a, b in zip(first, second, strict=True)]

    def slower_than(self, what: str, s: float, against: str, s_against: float, at_most: float | None = None) -> None:
        """Add a ratio to the time of a limit, with an upper bound."""
        self.add(what, f"{s:.4g} s", against, f"{s_against:.4g} s", s / s_against, at_most)

    def faster_than(self, what: str, s: float, against: str, s_against: float, at_least: float | None = None) -> None:
        """Add a speed-up over another library, with a lower bound."""
        self.add(what, f"{s:.4g} s", against, f"{s_against:.4g} s", s_against / s, at_least, is_lower_bound=True)

    def seconds(self, what: str, s: float, at_most: float, of: str = "seconds", *, unit_s: float = 1.0) -> None:
        """Add a time with an upper bound in a unit of time; the figure is scaled by the speed of the machine."""
        self.add(what, f"{s:.3g} s", of + ", scaled", "", s / unit_s * REFERENCE_S / compile_modules_s(), at_most)

    def add(
        self,
        what: str,
        took: str,
        against: str,
        other_took: str,
        figure: float,
        bound: float | None,
        *,
        is_lower_bound: bool = False,
    ) -> None:
        """Add a figure, and whether it satisfies its bound."""
        self.rows.append(Row(what, took, against, other_took, figure, bound, is_lower_bound))
