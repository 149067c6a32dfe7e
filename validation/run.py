"""
Compare every stage with closed forms and with other programs, on the same input, in one run.

Each comparison has a tolerance for the deviation of foveasim from the truth. The program exits with 1 when one is missed.
Results and figures are written to docs/validation, from which the pages of the documentation are built, and the table of the
paper, docs/paper/paper.md, is written from them.

    python validation/run.py                      everything, at most 15 minutes on two cores
    python validation/run.py diffraction timing   some stages; the results of the others are kept
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import runpy
import sys
import time
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import matplotlib as mpl
from records import Result, Row, Section, write
from rich.console import Console

import foveasim as fs

mpl.use("agg")
mpl.rcParams["svg.hashsalt"] = "foveasim"  # equal figures have equal files
#: Modules with a function ``validate(section, directory)``, in the order of the data flow, with their titles.
STAGES = {
    "radiometry": "Radiometry, photometry and colour",
    "diffraction": "Diffraction, defocus and aberrations",
    "image": "Images on photosites",
    "distortion": "Distortion, and fields beyond 90°",
    "depth": "Depth and defocus",
    "integration": "Integration over photosites",
    "angular": "Oblique light",
    "electronics": "Electronics and noise",
    "resolution": "Resolution and picture quality",
    "timing": "Rolling shutters, events and spikes",
    "layouts": "Layouts, design rules and files",
    "published": "Published measurements and claims",
    "learning": "Gradients, adjoints and noise in PyTorch",
}
#: Stages that need a library which other stages do without; left out where it is not installed.
NEEDS = {"learning": "torch"}
DIRECTORY = Path(__file__).parents[1] / "docs" / "validation"
RESULTS = DIRECTORY / "results.json"
PAPER = DIRECTORY.parent / "paper" / "paper.md"
console = Console(width=140)


def read_sections() -> dict[str, Section]:
    """Return the sections of an earlier run, by name."""
    if not RESULTS.exists():
        return {}
    found = {}
    for stored in json.loads(RESULTS.read_text("utf-8"))["sections"]:
        rows = [Row(**{**row, "results": tuple(Result(**one) for one in row["results"])}) for row in stored["rows"]]
        found[stored["name"]] = Section(**{**stored, "rows": rows})
    return found


def machine() -> dict[str, Any]:
    """Return what times depend on."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.machine(),
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "foveasim": fs.__version__,
    }


def main() -> None:
    """Run the stages that the command line names, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="STAGE", help=f"one of {', '.join(STAGES)}; by default all")
    chosen = parser.parse_args().names or [name for name in STAGES if find_spec(NEEDS.get(name, "numpy"))]
    if unknown := [name for name in chosen if name not in STAGES]:
        parser.error(f"unknown stages: {', '.join(unknown)}; possible: {', '.join(STAGES)}")
    if absent := [f"{name} needs {NEEDS[name]}" for name in chosen if name in NEEDS and not find_spec(NEEDS[name])]:
        parser.error(", ".join(absent))
    DIRECTORY.mkdir(parents=True, exist_ok=True)
    sections = read_sections()
    missed = []
    for name in chosen:
        module = importlib.import_module(name)
        about = " ".join((module.__doc__ or "").split("\n\n", 1)[-1].split())
        section = Section(name, STAGES[name], about, machine=machine())
        start_s = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fs.errors.FoveasimWarning)
            module.validate(section, DIRECTORY)
        section.seconds = time.perf_counter() - start_s
        console.print(section.table)
        missed += [f"{name}: {row.what}" for row in section.rows if not row.is_kept]
        sections[name] = section
        write(RESULTS, [sections[each] for each in STAGES if each in sections])
    if STAGES.keys() <= sections.keys():
        paper_of = runpy.run_path(str(DIRECTORY.parent / "validation_pages.py"))["paper_of"]
        PAPER.write_text(paper_of(PAPER.read_text("utf-8"), json.loads(RESULTS.read_text("utf-8"))), "utf-8")
    n_rows = sum(len(sections[name].rows) for name in chosen)
    console.print(f"{n_rows} comparisons in {sum(sections[name].seconds for name in chosen):.0f} s")
    if missed:
        sys.exit("\n".join(["tolerances missed:", *missed]))


if __name__ == "__main__":
    main()
