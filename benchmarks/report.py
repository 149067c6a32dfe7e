"""Interleaved timing, and the table of ratios."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path

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


class Report:
    """Table of ratios, and the number of missed bounds."""

    def __init__(self, *, is_judged: bool) -> None:
        self.table = Table(title="Ratios, each within one run")
        for heading in ("what", "time", "against", "its time", "ratio", "bound", ""):
            self.table.add_column(heading, justify="left" if heading in {"what", "against", ""} else "right")
        self.is_judged = is_judged
        self.missed = 0

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
        sign = "≥" if is_lower_bound else "≤"
        verdict = ""
        if bound is not None and self.is_judged:
            is_kept = figure >= bound if is_lower_bound else figure <= bound
            self.missed += not is_kept
            verdict = "[green]kept[/green]" if is_kept else "[red]missed[/red]"
        shown = "" if bound is None else f"{sign} {bound:g}"
        self.table.add_row(what, took, against, other_took, f"{figure:.3g}", shown, verdict)
