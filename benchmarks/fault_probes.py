"""Probes in the sources of a tree that record which test executes which fault, and how long each test takes."""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from fault_selection import Fault, is_valid

#: Recorded in files per process: tests run programs, and those start workers.
PROBE = """
import os

_seen = set()

def reached(*numbers):
    test = os.environ.get("PYTEST_CURRENT_TEST", "")
    for number in numbers:
        if (number, test) not in _seen:
            _seen.add((number, test))
            try:
                file = os.open(f"{DIRECTORY}/{os.getpid()}.reached", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
                os.write(file, f"{number}\\t{test}\\n".encode())
                os.close(file)
            except OSError:  # in the sandbox
                pass
"""
#: The file is open from the start, since tests replace the functions that open files.
DURATIONS = """
import os

_seconds = open(f"{DIRECTORY}/{os.getpid()}.seconds", "a")

def pytest_runtest_logreport(report):
    _seconds.write(f"{report.duration:.4f}\\t{report.when}\\t{report.nodeid}\\n")
    _seconds.flush()
"""
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def insert_probes(tree: Path, faults: list[Fault], directory: Path) -> None:
    """Change the modules of a tree and its conftest.py so that tests write what they reach to a directory."""
    sources = {str(path.relative_to(tree)): path.read_text("utf-8") for path in (tree / "foveasim").rglob("*.py")}
    numbers: dict[str, dict[tuple[int, int], set[int]]] = defaultdict(lambda: defaultdict(set))
    for fault in faults:
        for path, statement in probed(sources, fault):
            first = min([statement.lineno, *(each.lineno for each in getattr(statement, "decorator_list", []))])
            numbers[path][first, statement.col_offset].add(fault.number)
    for path, of_line in numbers.items():
        lines = sources[path].split("\n")
        for (line, column), found in sorted(of_line.items(), reverse=True):
            lines.insert(line - 1, f"{' ' * column}_reached({', '.join(map(str, sorted(found)))})")
        future = next(k for k, text in enumerate(lines) if text.startswith("from __future__"))
        lines.insert(future + 1, "from foveasim._probe import reached as _reached")
        source = "\n".join(lines)
        if not is_valid(source):
            raise SystemExit(f"{path}: a probe is in the wrong place")
        (tree / path).write_text(source, "utf-8")
    where = f"DIRECTORY = {str(directory)!r}\n"
    (tree / "foveasim/_probe.py").write_text(where + PROBE)
    with (tree / "conftest.py").open("a") as file:
        file.write("\n" + where + DURATIONS)


def probed(sources: dict[str, str], fault: Fault) -> Iterator[tuple[str, Any]]:
    """
    Yield (module, statement) before which a probe is inserted.

    That of the fault; for kernels, the functions that call them; for constants and defaults, the functions that may use them.
    """
    root = ast.parse(sources[fault.module])
    line = fault.line_in(sources[fault.module])
    functions = containing(root, line, FUNCTIONS)
    if is_kernels(fault.module):
        names = (
            {functions[0].name} if functions else {each.name for each in ast.walk(root) if isinstance(each, FUNCTIONS)}
        )
        for path, function in callers(sources, names):
            yield path, first_statement(function)
    elif not functions:
        for function in (each for each in ast.walk(root) if isinstance(each, FUNCTIONS)):
            yield fault.module, first_statement(function)
    else:
        statements = containing(root, line, ast.stmt)
        chosen = statements[-1]
        if isinstance(chosen, FUNCTIONS):  # a default value
            chosen = first_statement(chosen)
        while is_elif(chosen, sources[fault.module]):
            chosen = statements[statements.index(chosen) - 1]
        yield fault.module, chosen


def containing(root: ast.AST, line: int, kinds: Any) -> list[Any]:
    """Return the nodes that contain a line, from the outermost one."""
    return sorted(
        (node for node in ast.walk(root) if isinstance(node, kinds) and node.lineno <= line <= (node.end_lineno or 0)),
        key=lambda node: (node.lineno, -(node.end_lineno or 0)),
    )


def first_statement(function: Any) -> Any:
    """Return the first statement of a function after its docstring."""
    return function.body[1 if ast.get_docstring(function) and len(function.body) > 1 else 0]


def is_elif(statement: ast.stmt, source: str) -> bool:
    """Return whether a statement is a branch of another one."""
    return source.split("\n")[statement.lineno - 1].lstrip().startswith("elif")


def is_kernels(path: str) -> bool:
    """Return whether a module contains kernels, in which no probe can be compiled."""
    return path.endswith("kernels.py")


def callers(sources: dict[str, str], names: set[str]) -> Iterator[tuple[str, Any]]:
    """Yield (module, function) of all Python functions that refer to kernels, or to kernels that call those."""
    functions = [
        (path, node, {getattr(child, "attr", getattr(child, "id", None)) for child in ast.walk(node)})
        for path, source in sources.items()
        if "kernels" in source or is_kernels(path)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, FUNCTIONS)
    ]
    names, n_names = set(names), 0
    while n_names < len(names):
        n_names = len(names)
        names |= {node.name for path, node, used in functions if is_kernels(path) and names & used}
    yield from ((path, node) for path, node, used in functions if not is_kernels(path) and names & used)


def read_durations(directory: Path) -> Counter[str]:
    """Return the seconds of each test, with its fixtures."""
    phases = {}
    for line in lines_of(directory.glob("*.seconds")):  # those of workers are also in the file of their controller
        seconds, phase, test = line.split("\t", 2)
        phases[test, phase] = float(seconds)
    durations_s: Counter[str] = Counter()
    for (test, _), seconds in phases.items():
        durations_s[test] += seconds  # type: ignore[assignment]
    return durations_s


def read_reached(directory: Path, tests: list[str]) -> dict[int, set[int]]:
    """
    Return the indices of the tests that reach each fault, none for a fault that only imports of modules reach.

    What is executed in the setup of a test, perhaps in a fixture of the file, is reached by all tests of the file.
    """
    place = {test: k for k, test in enumerate(tests)}
    of_file, reached = defaultdict(set), defaultdict(set)
    for test, k in place.items():
        of_file[test.partition("::")[0]].add(k)
    for line in set(lines_of(directory.glob("*.reached"))):
        number, current = line.split("\t", 1)
        test, _, phase = current.rpartition(" ")
        reached[int(number)] |= of_file[test.partition("::")[0]] if phase == "(setup)" else {place.get(test, -1)} - {-1}
    return reached


def lines_of(paths: Iterable[Path]) -> Iterator[str]:
    """Yield all lines of files."""
    for path in paths:
        yield from path.read_text("utf-8").splitlines()
