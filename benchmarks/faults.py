"""
Planted faults: how many of 150 small errors in the central modules do the tests find?

They compare a suite of tests with its successor. ``plan`` selects the faults; ``reach`` runs all tests once with a probe at
each fault, and records which tests execute it; ``run`` plants each fault and runs the tests that reach it, the most promising
first, until one fails; ``table`` compares the results of two suites. ``reach`` and ``run`` change the files of ``--tree``, a
clone, and restore them.

    git clone . ../clone
    python benchmarks/faults.py plan --tree ../clone
    python benchmarks/faults.py reach --tree ../clone --out ../reach.json.gz
    python benchmarks/faults.py run --tree ../clone --reach ../reach.json.gz --out ../before.jsonl --set default
    python benchmarks/faults.py run --tree ../clone --reach ../reach.json.gz --out ../before.jsonl --set complete
    python benchmarks/faults.py table ../before.jsonl ../after.jsonl

``run`` continues after an interruption. A test that fails without a fault finds none. The complete set is run for the faults
that the default set misses, without the tests that are the same in both.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import re
import resource
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from fault_probes import insert_probes, is_kernels, read_durations, read_reached
from fault_selection import KINDS, Fault, select_faults
from rich.console import Console
from rich.table import Table

PLAN = Path(__file__).with_name("faults.jsonl")
N_FAULTS, SEED = 150, 2024
#: Environments of the sets of tests; the tests of older commits read FOVEASIM_TESTS_ALL.
SETS = {
    "default": {"FOVEASIM_TESTS": "default", "FOVEASIM_TESTS_ALL": "0"},
    "complete": {"FOVEASIM_TESTS": "all", "FOVEASIM_TESTS_ALL": "1"},
}
#: Files whose tests do more in the complete set.
VARYING = re.compile(r"\b(effort|hypothesis|FOVEASIM_TESTS_ALL)\b")
#: Files of the probes.
ADDED = ("conftest.py", "foveasim/_probe.py")
#: Largest number and duration, with probes, of the tests of each batch; the last one contains all others.
BATCHES = ((30, 20.0), (300, 120.0), (1500, 600.0))
#: Processor time after which a run is an endless loop: in addition to, and in durations of its tests; for new kernels, more.
STARTUP_S, DURATIONS, KERNELS_S = 40.0, 3.0, 240.0
#: The elapsed time may be longer, on a busy machine.
ELAPSED = 5.0
MAX_MEMORY = 12 * 2**30
console = Console(width=150)


# -- trees -------------------------------------------------------------------------------------------------------------


def restore(tree: Path) -> None:
    """Undo all changes of a clone."""
    if tree == Path(__file__).resolve().parents[1]:
        raise SystemExit("--tree must be a clone, since its files are changed: git clone . ../clone")
    subprocess.run(["git", "-C", tree, "checkout", "--quiet", "--", "."], check=True)
    subprocess.run(["git", "-C", tree, "clean", "--quiet", "--force", "--", *ADDED], check=True)


@cache
def python_of(tree: Path) -> Path:
    """Return the Python of an environment with the package of a tree, and the other packages of this environment."""
    python = tree / ".venv/bin/python"
    if not python.exists():
        venv.create(tree / ".venv", symlinks=True)
        packages = next((tree / ".venv/lib").glob("python*/site-packages"))
        (packages / "tree.pth").write_text(f"{tree}\n{sysconfig.get_path('purelib')}\n")
        program = tree / ".venv/bin/foveasim"
        program.write_text(f"#!{python}\n" + Path(sys.executable).with_name("foveasim").read_text().split("\n", 1)[1])
        program.chmod(0o755)
    command = [python, "-c", "import foveasim; print(foveasim.__file__)"]
    found = subprocess.run(
        command, cwd="/", capture_output=True, text=True, check=True, env=environment(tree, "default")
    )
    if Path(found.stdout.strip()).parents[1] != tree:
        raise SystemExit(f"{python} imports {found.stdout.strip()}; delete {tree}/.venv")
    return python


def environment(tree: Path, of_set: str, kernels: Path | None = None) -> dict[str, str]:
    """Return the environment of tests, with the same random examples in each run, and a directory for compiled kernels."""
    kept = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "PYTHONDONTWRITEBYTECODE"}}
    return kept | {
        **SETS[of_set],
        "CI": "1",
        "NUMBA_CACHE_DIR": str(kernels or tree / ".venv/numba"),
        "PATH": os.pathsep.join([str(tree / ".venv/bin"), str(Path(sys.executable).parent), os.environ["PATH"]]),
    }


def keep_named_tests(tree: Path) -> None:
    """Change conftest.py so that all named tests run: which slow tests it omits depends on the others of a run."""
    with (tree / "tests/conftest.py").open("a") as file:
        file.write("\n\ndel pytest_collection_modifyitems\n")


def pytest_command(tree: Path, *arguments: object) -> list[str]:
    """Return the command of tests in a tree."""
    return [str(python_of(tree)), "-m", "pytest", "-q", "-p", "no:cacheprovider", *map(str, arguments)]


# -- which tests reach a fault -----------------------------------------------------------------------------------------


def collect(tree: Path, of_set: str) -> list[str]:
    """Return the names of the tests of a set."""
    command = pytest_command(tree, "--collect-only")
    found = subprocess.run(
        command, cwd=tree, env=environment(tree, of_set), stdout=subprocess.PIPE, text=True, check=True
    )
    return [line for line in found.stdout.splitlines() if "::" in line]


def reach(tree: Path, faults: list[Fault], paths: list[str], n_workers: int) -> dict[str, Any]:
    """Return all tests with their durations and sets, and which of them reach each fault."""
    restore(tree)
    sets = {
        of_set: {test for test in collect(tree, of_set) if test.startswith(tuple(paths or [""]))} for of_set in SETS
    }
    apart = sorted(sets["default"] - sets["complete"])  # rows of the compositions
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        insert_probes(tree, faults, directory)
        keep_named_tests(tree)
        (directory / "apart").write_text("\n".join(apart))
        try:
            for of_set, tests in (("complete", paths), ("default", [f"@{directory / 'apart'}"] if apart else None)):
                if tests is not None:
                    command = pytest_command(tree, "--numprocesses", n_workers, "--dist", "loadfile", *tests)
                    subprocess.run(command, cwd=tree, env=environment(tree, of_set), check=False)
        finally:
            restore(tree)
        durations_s = read_durations(directory)
        tests = sorted((sets["default"] | sets["complete"]) & set(durations_s))
        reached = read_reached(directory, tests)
    for fault in faults:
        if fault.number in reached and not reached[fault.number]:  # only while modules are imported
            stage = Path(fault.module).parts[1]
            reached[fault.number] = {k for k, test in enumerate(tests) if test.startswith(f"tests/{stage}/")}
    console.print(f"{len(tests)} tests reach {sum(map(bool, reached.values()))} of {len(faults)} faults")
    return {
        "faults": [asdict(fault) for fault in faults],
        "tests": [[test, round(durations_s[test], 3), *(test in sets[each] for each in SETS)] for test in tests],
        "reached": {number: sorted(reached[number]) for number in sorted(reached)},
    }


class Reach:
    """The tests of a tree that reach each fault."""

    def __init__(self, path: Path, tree: Path) -> None:
        found = json.loads(gzip.decompress(path.read_bytes()))
        self.faults = [Fault(**fault) for fault in found["faults"]]
        self.tests = [test for test, *_ in found["tests"]]
        self.durations_s = {test: duration_s for test, duration_s, *_ in found["tests"]}
        self.sets = {of_set: {row[0] for row in found["tests"] if row[k]} for k, of_set in enumerate(SETS, 2)}
        self._reached = {int(number): tests for number, tests in found["reached"].items()}
        files = {test.partition("::")[0] for test in self.tests}
        varying = {file for file in files if VARYING.search((tree / file).read_text("utf-8"))}
        same = {test for test in self.sets["default"] if test.partition("::")[0] not in varying}
        self.sets["complete"] -= same

    def batches(self, fault: Fault, of_set: str, at_most_s: float) -> Iterator[list[str]]:
        """Yield the tests that reach a fault: those near the module first, then short ones, up to a total duration."""
        words = {word.strip("_") for word in Path(fault.module).with_suffix("").parts[1:]}
        tests = [self.tests[k] for k in self._reached.get(fault.number, []) if self.tests[k] in self.sets[of_set]]
        tests.sort(key=lambda test: (-sum(word in test.partition("::")[0] for word in words), self.durations_s[test]))
        left_s, limits = at_most_s, [*BATCHES, (len(tests), at_most_s)]
        while tests and left_s > 0.0:
            n_most, most_s = limits.pop(0) if len(limits) > 1 else limits[0]
            batch, sum_s = [], 0.0
            while tests and len(batch) < n_most and sum_s < min(most_s, left_s):
                sum_s += self.durations_s[tests[0]]
                batch.append(tests.pop(0))
            left_s -= sum_s
            of_file: dict[str, list[str]] = defaultdict(list)  # fixtures of a file are created once
            for test in batch:
                of_file[test.partition("::")[0]].append(test)
            yield [test for chosen in of_file.values() for test in chosen]

    def limit_s(self, tests: list[str]) -> float:
        """Return the processor time after which tests are in an endless loop."""
        return STARTUP_S + DURATIONS * sum(self.durations_s[test] for test in tests)


# -- runs --------------------------------------------------------------------------------------------------------------


def run_tests(
    tree: Path, tests: list[str], of_set: str, limit_s: float, *options: str, kernels: Path | None = None
) -> tuple[int | None, list[str], str]:
    """Run tests; return the exit status, or None after an endless loop, the names of those that fail, and the output."""
    with tempfile.TemporaryDirectory() as name:
        listed, output = Path(name) / "tests", Path(name) / "output"
        listed.write_text("\n".join(tests))
        command = pytest_command(tree, *options, "--basetemp", Path(name) / "temporary", f"@{listed}")
        with output.open("w") as file:
            process = subprocess.Popen(
                command,
                cwd=tree,
                env=environment(tree, of_set, kernels),
                stdout=file,
                stderr=file,
                start_new_session=True,
            )
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5))
            resource.prlimit(process.pid, resource.RLIMIT_DATA, (MAX_MEMORY, MAX_MEMORY))
            try:
                status: int | None = process.wait(ELAPSED * limit_s)
            except subprocess.TimeoutExpired:
                status = None
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # also what the tests have started
                process.wait()
        text = output.read_text("utf-8", "replace")
    lines = [line.partition(" ")[2] for line in text.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    failed = [max((t for t in tests if f"{line} ".startswith(f"{t} ")), key=len, default=line) for line in lines]
    return (None if status in {-signal.SIGXCPU, -signal.SIGKILL} else status), failed, text


class Runs:
    """Results of planted faults in a file, one line each."""

    def __init__(self, path: Path, tree: Path, reached: Reach, of_set: str) -> None:
        self.path, self.tree, self.reach, self.of_set = path, tree, reached, of_set
        self.rows = read_rows(path)
        controls = [row for row in self.rows if row.get("control") == of_set]
        self.passing = {test for row in controls for test in row["passed"]}
        self.failing = {test for row in controls for test in row["failed"]}

    def add(self, row: dict[str, Any]) -> None:
        """Append a row."""
        self.rows.append(row)
        with self.path.open("a") as file:
            file.write(json.dumps(row) + "\n")

    def control(self, tests: list[str]) -> None:
        """Run tests without a fault, to know which pass."""
        tests = sorted(set(tests) - self.passing - self.failing)
        if not tests:
            return
        status, failed, text = run_tests(self.tree, tests, self.of_set, 10.0 * self.reach.limit_s(tests))
        if status not in {0, 1}:
            raise SystemExit(f"without a fault, pytest ends with status {status}:\n{text[-3000:]}")
        self.failing |= set(failed)
        self.passing |= set(tests) - self.failing
        self.add({"control": self.of_set, "failed": failed, "passed": sorted(set(tests) - set(failed))})

    def judge(self, fault: Fault, at_most_s: float) -> dict[str, Any]:
        """Plant a fault, run the tests that reach it, and return the result."""
        path = self.tree / fault.module
        source, stat = path.read_text("utf-8"), path.stat()
        found: dict[str, Any] = {"verdict": "not reached", "by": "", "n_tests": 0, "tests_s": 0.0}
        with tempfile.TemporaryDirectory() as name:
            kernels = Path(name) if is_kernels(fault.module) else None
            for batch in self.reach.batches(fault, self.of_set, at_most_s):
                tests = [test for test in batch if test not in self.failing]
                found["verdict"] = "survived"
                while tests:
                    limit_s = self.reach.limit_s(tests) + (KERNELS_S if kernels else 0.0)
                    path.write_text(fault.planted_in(source), "utf-8")
                    stamp = int(stat.st_mtime) + 1 + fault.number  # new bytecode
                    os.utime(path, (stamp, stamp))
                    try:
                        status, failed, _ = run_tests(self.tree, tests, self.of_set, limit_s, "-x", kernels=kernels)
                    finally:
                        path.write_text(source, "utf-8")
                        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
                    self.control([test for test in failed if test in self.reach.durations_s])
                    if not self.failing.intersection(failed):
                        break
                    tests = [test for test in tests if test not in self.failing]
                found["n_tests"] += len(tests)
                found["tests_s"] += sum(self.reach.durations_s[test] for test in tests)
                if tests and status != 0:
                    how = {None: "endless loop", 1: "failed test", 2: "error at import", 4: "error at import"}
                    found["verdict"], found["how"] = "caught", how.get(status, f"crash, exit status {status}")
                    return found | {"by": failed[0] if failed else found["how"]}
            if kernels and found["n_tests"] and not any(kernels.rglob(f"{path.stem}.*.nbi")):
                found["verdict"] = "not compiled"
        return found


def run(runs: Runs, faults: list[Fault], at_most_s: float) -> None:
    """Judge all faults without a result, which are those that the default set has missed when the complete set is run."""
    done = {row["number"]: row for row in runs.rows if row.get("set") == runs.of_set}
    caught = {row["number"] for row in runs.rows if row.get("verdict") == "caught"}
    left = [fault for fault in faults if fault.number not in done and fault.number not in caught]
    runs.control([test for fault in left for test in next(runs.reach.batches(fault, runs.of_set, at_most_s), [])])
    for k, fault in enumerate(left, 1):
        begin_s, cpu_s = time.perf_counter(), children_s()
        found = runs.judge(fault, at_most_s)
        found["cpu_s"] = round(children_s() - cpu_s, 1)
        found["tests_s"] = round(found["tests_s"], 1)
        runs.add({"set": runs.of_set, **asdict(fault), **found})
        took_s = time.perf_counter() - begin_s
        what = f"{fault.module.removeprefix('foveasim/')}:{fault.line} {fault.kind}"
        console.print(f"{k} of {len(left)}  {took_s:4.0f} s  {found['verdict']}  {what}  {found['by']}", markup=False)


def children_s() -> float:
    """Return the processor time of all finished programs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


# -- results -----------------------------------------------------------------------------------------------------------


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file with a JSON object per line, or none."""
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []


def read_plan(path: Path) -> list[Fault]:
    """Return the faults of a plan."""
    return [Fault(**row) for row in read_rows(path)]


def verdicts(rows: list[dict[str, Any]], faults: list[Fault]) -> dict[int, tuple[bool, bool]]:
    """Return whether the default and the complete set find each fault."""
    found = {
        of_set: {r["number"] for r in rows if r.get("set") == of_set and r["verdict"] == "caught"} for of_set in SETS
    }
    return {f.number: (f.number in found["default"], f.number in found["default"] | found["complete"]) for f in faults}


def show_table(paths: list[Path], faults: list[Fault]) -> None:
    """Print the numbers of faults found, by module and kind, and the faults not found."""
    results = {path.stem: verdicts(read_rows(path), faults) for path in paths}
    by_module: Callable[[Fault], str] = lambda fault: fault.module.removeprefix("foveasim/")  # noqa: E731
    for title, key in (("module", by_module), ("kind", lambda fault: fault.kind)):
        table = Table(title=f"Faults found, by {title}")
        table.add_column(title)
        for heading in ("planted", *(f"{name}, {of_set}" for name in results for of_set in SETS)):
            table.add_column(heading, justify="right")
        groups = sorted({key(fault) for fault in faults}, key=KINDS.index if title == "kind" else None)
        for group in [*groups, "all"]:
            numbers = [fault.number for fault in faults if group in {key(fault), "all"}]
            sums = [sum(found[n][k] for n in numbers) for found in results.values() for k in range(len(SETS))]
            table.add_row(group, str(len(numbers)), *map(str, sums))
        console.print(table)
    for path in paths:
        last = {row["number"]: row["verdict"] for row in read_rows(path) if "number" in row}
        console.print(f"[bold]not found by {path.stem}[/bold]")
        for fault in (fault for fault in faults if not results[path.stem][fault.number][1]):
            console.print(
                f"{fault.number} {by_module(fault)}:{fault.line} {last.get(fault.number, 'not run')}", highlight=False
            )
            console.print(f"    - {fault.before.strip()}\n    + {fault.after.strip()}", markup=False, highlight=False)


def main() -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("plan", "reach", "run", "table"))
    parser.add_argument("paths", nargs="*", help="reach: tests, all by default; table: results")
    parser.add_argument("--plan", type=Path, default=PLAN, help="the faults")
    parser.add_argument("--tree", type=lambda path: Path(path).resolve(), help="a clone of the repository")
    parser.add_argument("--out", type=Path, help="reach: a file .json.gz; run: a file .jsonl")
    parser.add_argument("--reach", type=Path, help="run: the output of reach")
    parser.add_argument("--set", choices=tuple(SETS), default="default", help="run: the tests")
    parser.add_argument("--numbers", type=int, nargs="*", help="run: only these faults")
    parser.add_argument("--at-most-s", type=float, default=600.0, help="run: duration of all tests for one fault")
    parser.add_argument("--workers", type=int, default=2, help="reach: processes")
    given = parser.parse_intermixed_args()
    if given.command == "plan":
        rows = [json.dumps(asdict(fault)) for fault in select_faults(given.tree, N_FAULTS, SEED)]
        given.plan.write_text("\n".join(rows) + "\n")
        return
    faults = read_plan(given.plan)
    if given.command == "reach":
        found = reach(given.tree, faults, given.paths, given.workers)
        given.out.write_bytes(gzip.compress(json.dumps(found).encode()))
    elif given.command == "run":
        reached = Reach(given.reach, given.tree)
        if reached.faults != faults:
            raise SystemExit(f"{given.reach} contains other faults than {given.plan}; run reach again")
        restore(given.tree)
        keep_named_tests(given.tree)
        chosen = [fault for fault in faults if given.numbers is None or fault.number in given.numbers]
        try:
            run(Runs(given.out, given.tree, reached, given.set), chosen, given.at_most_s)
        finally:
            restore(given.tree)
    else:
        show_table([Path(path) for path in given.paths], faults)


if __name__ == "__main__":
    main()
