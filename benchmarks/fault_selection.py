"""Selection of small errors in a module, from its syntax tree."""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

#: Central modules of the stages, from scene to reconstruction.
MODULES = (
    *("scene/_scene", "scene/charts/_edges", "optics/_optics", "optics/otf", "optics/aberrations"),
    *("distortion/_brown_conrady", "distortion/_fisheye", "integrate/_integrator", "integrate/_plan"),
    *("integrate/_kernels", "layout/model", "layout/generators/log_polar", "layout/drc/measurements"),
    *("sensor/sensor", "sensor/chain", "sensor/adc", "sensor/effects/crosstalk", "sensor/model/linearisation"),
    *("camera/_camera", "reconstruct/least_squares"),
)
KINDS = ("arithmetic", "comparison", "constant", "condition", "index", "arguments")
#: What each operator is replaced by.
OPERATORS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"), ast.Pow: ("**", "*"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"), ast.And: ("and", "or"),
    ast.Or: ("or", "and"), ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="),
}  # fmt: skip
#: Calls that write messages, or declare ranges that only the studio shows.
MESSAGES = {"warn", "debug", "info", "warning", "error", "Limits", "Usual", "TypeVar", "register", "cast", "require"}
#: Calls whose result does not depend on the order of the arguments, or that fail at once in the other order.
SYMMETRIC = {
    *("isinstance", "issubclass", "getattr", "setattr", "hasattr", "maximum", "minimum", "max", "min", "hypot"),
    *("zip", "print", "array_equal", "multiply", "add", "result_type"),
}
TYPES = {"Annotated", "Literal", "NDArray", "Callable", "Sequence", "Mapping", "tuple", "dict", "list", "type"}
#: Functions whose result people read.
SHOWN = {"__repr__", "__str__", "_repr_html_", "__dir__", "summary"}
#: Lines that change times and memory only.
PERFORMANCE = re.compile(
    r"(?i)block|strip|cache|chunk|thread|bytes|memory|maxsize|batch|progress|ahead|workers|_log\b|stacklevel|is_compiled"
    r"|MAX_SHOWN|TOGETHER|MAX_AUTO|rows_per_band|MIN_RUN|MAX_TABLE|BOX_CELLS|range\(64\)"
)
#: Smaller numbers are tolerances, twice which no test should see.
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Fault:
    """A line of a module, and its replacement."""

    number: int
    module: str
    line: int
    column: int
    kind: str
    before: str
    after: str

    def line_in(self, source: str) -> int:
        """Return the number of the line: the nearest with the same text, in another version of the module."""
        lines = [k for k, text in enumerate(source.split("\n"), 1) if text == self.before]
        if not lines:
            raise SystemExit(f"fault {self.number}: {self.module} does not contain the line '{self.before.strip()}'")
        return min(lines, key=lambda k: abs(k - self.line))

    def planted_in(self, source: str) -> str:
        """Return the source with the fault."""
        lines = source.split("\n")
        lines[self.line_in(source) - 1] = self.after
        return "\n".join(lines)


@dataclass(frozen=True)
class Change:
    """A replacement of the text between two positions, (line, column in bytes)."""

    kind: str
    start: tuple[int, int]
    end: tuple[int, int]
    replace: Callable[[bytes], bytes]


def visible(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that tests should see: no messages, annotations, decorators or branches for type checkers."""
    children = list(ast.iter_child_nodes(node))
    match node:
        case ast.Raise() | ast.Assert() | ast.JoinedStr():
            return
        case ast.Call() if name_of(node) in MESSAGES:
            return
        case ast.Subscript(value=ast.Name(id=name)) if name in TYPES:
            return
        case ast.If() if "TYPE_CHECKING" in ast.dump(node.test):
            return
        case ast.FunctionDef():
            if node.name in SHOWN or "overload" in "".join(map(ast.dump, node.decorator_list)):
                return
            children = [*node.args.defaults, *(value for value in node.args.kw_defaults if value), *node.body]
        case ast.AnnAssign():
            children = [node.value] if node.value else []
    yield node
    for child in children:
        yield from visible(child)


def name_of(call: ast.Call) -> str:
    """Return the last name of a called function."""
    return str(getattr(call.func, "id", getattr(call.func, "attr", "")))


def is_text(node: ast.AST) -> bool:
    """Return whether an expression is a string."""
    return isinstance(getattr(node, "value", None), str)


def span(node: Any) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the positions of the begin and end of an expression."""
    return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)


def changes(node: ast.AST, rng: random.Random) -> Iterator[Change]:
    """Yield the faults of one node."""
    match node:
        case ast.BinOp():
            yield from operator("arithmetic", node.left, node.op, node.right)
        case ast.Compare():
            for sides, each in zip(pairwise([node.left, *node.comparators]), node.ops, strict=True):
                yield from operator("comparison", sides[0], each, sides[1])
        case ast.BoolOp():
            for left, right in pairwise(node.values):
                yield from operator("comparison", left, node.op, right)
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            numbers = [value + 1, 2 * value, -value] if abs(value) > TOLERANCE else [value + 1]
            text = f"({number})" if (number := rng.choice(numbers)) < 0 else str(number)
            yield Change("constant", *span(node), lambda _: text.encode())
        case ast.If() | ast.IfExp():
            yield condition(node.test, rng.choice(["not", "True", "False"]))
        case ast.While():
            yield condition(node.test, "not")
        case ast.comprehension():
            yield from (condition(test, rng.choice(["not", "True"])) for test in node.ifs)
        case ast.Subscript():
            yield from indices(node.slice, rng)
        case ast.Call():
            if name_of(node) == "range":
                yield shifted(node.args[-1], rng)
            yield from swapped(node)


def operator(kind: str, left: Any, each: Any, right: Any) -> Iterator[Change]:
    """Yield the replacement of an operator between two operands; floating-point numbers are rarely equal to a limit."""
    if type(each) in OPERATORS and not is_text(left) and not is_text(right):
        old, new = (word.encode() for word in OPERATORS[type(each)])
        if any(isinstance(getattr(e, "value", None), float) for e in (left, right)):
            new = {b"<": b">", b">": b"<", b"<=": b">=", b">=": b"<="}.get(old, new)
        yield Change(kind, span(left)[1], span(right)[0], lambda text: text.replace(old, new, 1))


def condition(test: Any, word: str) -> Change:
    """Return the negation of a condition, or a constant for it."""
    return Change("condition", *span(test), lambda text: b"(not (%s))" % text if word == "not" else word.encode())


def shifted(node: Any, rng: random.Random) -> Change:
    """Return an integer that is off by one."""
    shift = rng.choice([1, -1])
    if isinstance(node, ast.Constant):
        return Change("index", *span(node), lambda _: b"%d" % (node.value + shift))
    return Change("index", *span(node), lambda text: b"(%s)%s" % (text, b" + 1" if shift > 0 else b" - 1"))


def indices(index: ast.expr, rng: random.Random) -> Iterator[Change]:
    """Yield constant indices and bounds of slices that are off by one."""
    for part in index.elts if isinstance(index, ast.Tuple) else [index]:
        bounds = [part.lower, part.upper] if isinstance(part, ast.Slice) else [part]
        for bound in bounds:
            is_number = isinstance(bound, ast.Constant) and isinstance(bound.value, int)
            if bound and (isinstance(part, ast.Slice) or is_number):
                yield shifted(bound, rng)


def swapped(call: ast.Call) -> Iterator[Change]:
    """Yield exchanges of adjacent arguments of a call."""
    alike = (ast.Name, ast.Attribute, ast.Subscript)  # others differ in type, and fail at once
    for one, two in pairwise([] if name_of(call) in SYMMETRIC else call.args):
        is_alike = type(one) is type(two) or (isinstance(one, alike) and isinstance(two, alike))
        if is_alike and not isinstance(one, ast.Starred) and not is_text(one) and ast.dump(one) != ast.dump(two):
            first, last = ((e.end_col_offset or 0) - e.col_offset for e in (one, two))
            yield Change(
                "arguments",
                span(one)[0],
                span(two)[1],
                lambda text, first=first, last=last: text[-last:] + text[first:-last] + text[:first],
            )


def candidates(source: str, rng: random.Random) -> dict[str, list[tuple[int, int, str, str]]]:
    """Return all faults within one line of a module, by kind, in random order: (line, column, line before, line after)."""
    found: dict[str, list[tuple[int, int, str, str]]] = {kind: [] for kind in KINDS}
    lines = source.split("\n")
    for node in visible(ast.parse(source)):
        for change in changes(node, rng):
            (line, begin), (last_line, end) = change.start, change.end
            text = lines[line - 1]
            if line != last_line or PERFORMANCE.search(text):
                continue
            code = text.encode()  # columns are in bytes
            after = (code[:begin] + change.replace(code[begin:end]) + code[end:]).decode()
            if after != text:
                found[change.kind].append((line, begin, text, after))
    for each in found.values():
        rng.shuffle(each)
    return found


def is_valid(source: str) -> bool:
    """Return whether a source can be compiled."""
    try:
        compile(source, "", "exec")
    except SyntaxError:
        return False
    return True


def select_faults(tree: Path, n_faults: int, seed: int) -> list[Fault]:
    """Select the same number of faults in each module and, where it has enough, of each kind; at most one in a line."""
    faults: list[Fault] = []
    for k, module in enumerate(MODULES):
        path = f"foveasim/{module}.py"
        source = (tree / path).read_text("utf-8")
        found = candidates(source, random.Random(f"{seed} {module}"))
        used: set[int] = set()
        n_until, step = n_faults * (k + 1) // len(MODULES), len(faults)  # so that each kind is the first as often
        while len(faults) < n_until and any(found.values()):
            kind = KINDS[step % len(KINDS)]
            step += 1
            while found[kind]:
                line, column, before, after = found[kind].pop()
                fault = Fault(len(faults), path, line, column, kind, before, after)
                if line not in used and is_valid(fault.planted_in(source)):
                    faults.append(fault)
                    used.add(line)
                    break
    return faults
