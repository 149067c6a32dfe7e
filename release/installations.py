"""New environments with the wheel and at most one extra: their size, their distributions, and the calls that work in them."""

from __future__ import annotations

import json
import platform
import re
import runpy
import shutil
import sys
import time
from collections.abc import Iterator
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

from licences import gpl_libraries, licence_of, name_of
from processes import CheckError, run

ROOT = Path(__file__).parents[1]
CALLS = ROOT / "tests" / "installation" / "calls.py"
#: Results by extra, from which the documentation takes its tables.
RESULTS = ROOT / "docs" / "installations.json"
#: Page with a table of their sizes.
PAGE = ROOT / "docs" / "quick_start.md"
#: Name of the environment without extras.
CORE = "core"


def new_environment(directory: Path, requirement: str) -> Path:
    """Return the interpreter of a new environment that contains a requirement, without pip."""
    python = directory / "bin" / "python"
    run(sys.executable, "-m", "venv", "--without-pip", str(directory))
    pip = (sys.executable, "-m", "pip", "--python", str(python))
    run(*pip, "install", "--quiet", "--no-compile", requirement)
    run(*pip, "check")
    return python


def files_of(directory: Path) -> Iterator[Path]:
    """Yield the files below a directory but for bytecode, each one once where it has several names."""
    seen = set()
    for path in sorted(directory.rglob("*")):
        if path.is_symlink() or not path.is_file() or path.suffix == ".pyc":
            continue
        status = path.stat()
        if (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            yield path


def size_mb(directory: Path) -> float:
    """Return the size of the files below a directory, in 10^6 bytes."""
    return sum(path.stat().st_size for path in files_of(directory)) / 1e6


def record_of(distribution: Distribution) -> dict[str, Any]:
    """Return version, licence, size, and libraries under the GPL of an installed distribution."""
    paths = [Path(str(file.locate())) for file in distribution.files or () if file.suffix != ".pyc"]
    record = {
        "version": distribution.version,
        "licence": licence_of(distribution),
        "mb": round(sum(path.stat().st_size for path in paths if path.is_file()) / 1e6, 1),
    }
    libraries = gpl_libraries(path.name for path in paths)
    return {**record, "gpl_libraries": libraries} if libraries else record


def calls_in(python: Path, directory: Path, names: list[str]) -> dict[str, str]:
    """Make calls, by default all, in an environment, and return the extra that each one requires, empty for none."""
    directory.mkdir()
    report, script = directory / "report.json", directory / "calls.py"
    shutil.copy(CALLS, script)
    program = ("--program", str(python.with_name("foveasim")))
    run(
        str(python), str(script), "--report", str(report), *program, *names,
        cwd=directory, MPLBACKEND="agg", PYTHONPATH="", TMPDIR=str(directory),
    )  # fmt: skip
    required_extra = runpy.run_path(str(CALLS))["required_extra"]
    return {name: required_extra(text) for name, text in json.loads(report.read_text("utf-8")).items()}


def measure(
    wheel: Path, extra: str, directory: Path, core: dict[str, Any] | None = None, names: list[str] | None = None
) -> tuple[dict[str, Any], dict[str, str]]:
    """
    Install the core or an extra in a new environment, which is removed afterwards; return its record, and its calls.

    ``core``: the record of the core, whose distributions those of extras do not repeat. ``names``: calls that require the
    extra, which must work in it; by default all calls.

    Raises
    ------
    CheckError
        If the installation fails, or a call neither works nor names the extra that it requires.
    """
    start_s = time.perf_counter()
    requirement = str(wheel) if extra == CORE else f"{wheel}[{extra}]"
    try:
        python = new_environment(directory / "env", requirement)
        [site] = (directory / "env").glob("lib/python*/site-packages")
        size = size_mb(site)  # before calls store machine code in it
        found = {name_of(each): record_of(each) for each in Distribution.discover(path=[str(site)])}
        calls = calls_in(python, directory / "calls", names or [])
    finally:
        shutil.rmtree(directory, ignore_errors=True)
    print(
        f"  {extra}: {size:.0f} MB in {len(found)} distributions, {len(calls)} calls, "
        f"{time.perf_counter() - start_s:.0f} s",
        flush=True,
    )
    if names and (missing := sorted(name for name, required in calls.items() if required)):
        raise CheckError(f"with the extra {extra}, calls require another one: {', '.join(missing[:5])}")
    known = core["distributions"] if core else {}
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "mb": round(size, 1),
        "distributions": {name: found[name] for name in sorted(found) if name not in known and name != "foveasim"},
    }
    return record, calls


def read_results() -> dict[str, dict[str, Any]]:
    """Return the stored records by extra."""
    return dict(json.loads(RESULTS.read_text("utf-8"))) if RESULTS.exists() else {}


def write_results(records: dict[str, dict[str, Any]], order: list[str]) -> None:
    """Store the records in an order, without those of extras that it lacks, and write their sizes in the quick start."""
    kept = {name: records[name] for name in order if name in records}
    RESULTS.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", "utf-8")
    PAGE.write_text(with_sizes(PAGE.read_text("utf-8"), kept), "utf-8")


def with_sizes(page: str, records: dict[str, dict[str, Any]]) -> str:
    """
    Return the text of the quick start with the sizes of the records.

    Raises
    ------
    CheckError
        If the page lacks the row of an extra, or the lines with other figures.
    """
    core = records[CORE]
    measured = f"Measured on {core['date']}, {core['system']}, Python {core['python']}."
    lines = {
        r"(?<=compiler takes )\d+": f"{core['distributions']['llvmlite']['mb']:.0f}",
        r"(?m)^Measured on .*$": measured,
    }
    for name, record in records.items():
        cell = "" if name == CORE else f"`{name}` "
        more = "" if name == CORE else f"{record['mb'] - core['mb']:,.0f}"
        lines[rf"(?m)(?<=^\| {cell}\| )(.*) \|.*\|.*\|$"] = rf"\1 | {record['mb']:,.0f} | {more} |"
    for pattern, text in lines.items():
        page, n_found = re.subn(pattern, text, page)
        if n_found != 1:
            raise CheckError(f"{PAGE.name} must contain one line with {pattern}, found {n_found}")
    return page
