"""Rows of the validation: what was compared, how far each program is from the truth, and how long it took."""

from __future__ import annotations

import importlib.metadata
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

OWN = "foveasim"
#: Repetitions of each call, interleaved; the shortest time counts.
N_REPEATS = 3


def largest(found: Any, truth: Any) -> float:
    """Return the largest absolute deviation over the largest absolute value of the truth."""
    return largest_absolute(found, truth) / float(np.abs(truth).max())


def largest_relative(found: Any, truth: Any) -> float:
    """Return the largest deviation relative to each value of the truth."""
    return in_errors(np.abs(truth))(found, truth)


def largest_absolute(found: Any, truth: Any) -> float:
    """Return the largest absolute deviation."""
    return in_errors(1.0)(found, truth)


def in_errors(standard_error: Any) -> Callable[[Any, Any], float]:
    """Return a deviation in standard errors: the largest one."""

    def deviation(found: Any, truth: Any) -> float:
        found, truth = np.asarray(found, np.float64), np.asarray(truth, np.float64)
        if found.shape != truth.shape:
            raise ValueError(f"shapes {found.shape} and {truth.shape} differ")
        return float(np.max(np.abs(found - truth) / standard_error))

    return deviation


#: Unit of deviations by :func:`in_errors`.
ERRORS = "standard errors"
#: What deviations are relative to, by their functions.
OF = {largest: "of the maximum", largest_relative: "relative", largest_absolute: ""}


def version_of(distribution: str) -> str:
    """Return the version of an installed distribution, such as ``"GalSim"``."""
    return importlib.metadata.version(distribution)


@dataclass(frozen=True)
class Result:
    """
    What one program found.

    ``deviation`` from the truth; ``seconds`` of processor and waiting time, None where it means nothing; ``cannot``: what the
    program does not offer for this comparison, or does differently.
    """

    program: str
    deviation: float
    seconds: float | None
    cannot: str = ""


@dataclass(frozen=True)
class Row:
    """
    One comparison.

    ``truth``: formula or reference method; ``source``: where it is from; ``of``: unit of deviation and tolerance;
    ``explanation`` of deviations of other programs, or what is open.
    """

    what: str
    truth: str
    source: str
    of: str
    tolerance: float
    results: tuple[Result, ...]
    explanation: str = ""

    @property
    def is_kept(self) -> bool:
        """Whether foveasim is within the tolerance."""
        return next(one.deviation for one in self.results if one.program == OWN) <= self.tolerance


@dataclass
class Section:
    """Rows of a stage; ``figures``: captions by the name of the file; ``machine``: what its times depend on."""

    name: str
    title: str
    about: str
    rows: list[Row] = field(default_factory=list)
    figures: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    machine: dict[str, Any] = field(default_factory=dict)

    def compare(
        self,
        what: str,
        calls: Mapping[str, Callable[[], Any]],
        truth: Any,
        *,
        by: str,
        source: str,
        tolerance: float,
        deviation: Callable[[Any, Any], float] = largest,
        of: str | None = None,
        cannot: Mapping[str, str] | None = None,
        explanation: str = "",
        repeats: int = N_REPEATS,
    ) -> dict[str, Any]:
        """
        Add a row: call every program, time it, and measure its deviation from the truth.

        Parameters
        ----------
        what : str
            Quantity and conditions.
        calls : mapping of str to callable
            By the name of the program with its version, ``"foveasim"`` among them.
        truth : array_like
        by, source : str
            How the truth is found, and the publication or the closed form's name.
        tolerance : float
            Largest deviation of foveasim; other programs are not judged.
        deviation : callable of (found, truth)
        of : str, optional
            Unit of the deviation; by default that of the function.
        cannot : mapping of str to str, optional
            What programs do not offer, or do differently, by their names; of programs without a call, it joins the explanation.
        explanation : str
            Why programs differ, or that the reason is open.
        repeats : int
            Calls of each program; 0 leaves out times, as for results of a simulation.

        Returns
        -------
        found : dict
            Results by program, for figures.
        """
        found = {program: call() for program, call in calls.items()}
        seconds = dict.fromkeys(calls, float("inf"))
        for _ in range(repeats):
            for program, call in calls.items():
                start_s = time.perf_counter()
                call()
                seconds[program] = min(seconds[program], time.perf_counter() - start_s)
        results = tuple(
            Result(
                program, deviation(each, truth), seconds[program] if repeats else None, (cannot or {}).get(program, "")
            )
            for program, each in found.items()
        )
        shown = OF[deviation] if of is None else of
        absent = [f"{program}: {text}." for program, text in (cannot or {}).items() if program not in calls]
        explanation = " ".join([explanation, *absent]).strip()
        self.rows.append(Row(what, by, source, shown, tolerance, results, explanation))
        return found

    def draw(self, name: str, figure: Figure, caption: str, directory: Path) -> None:
        """Store a figure below the rows."""
        path = directory / f"{self.name}_{name}.svg"
        figure.savefig(path, metadata={"Date": None}, bbox_inches="tight")
        self.figures[path.name] = caption

    @property
    def table(self) -> Table:
        """All rows, for the terminal."""
        table = Table(title=self.title)
        for heading in ("what", "program", "deviation", "tolerance", "time", ""):
            table.add_column(heading, justify="right" if heading in {"deviation", "tolerance", "time"} else "left")
        for row in self.rows:
            for k, one in enumerate(row.results):
                verdict = "[green]kept[/green]" if row.is_kept else "[red]missed[/red]"
                table.add_row(
                    row.what if k == 0 else "",
                    one.program,
                    f"{one.deviation:.2g} {row.of}",
                    f"{row.tolerance:.2g}" if one.program == OWN else "",
                    "" if one.seconds is None else f"{one.seconds:.3g} s",
                    verdict if one.program == OWN else "",
                )
        return table


def write(path: Path, sections: list[Section]) -> None:
    """Write all sections as JSON."""
    content = {"sections": [asdict(section) for section in sections]}
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")
