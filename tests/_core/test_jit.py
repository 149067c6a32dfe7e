"""Compiled kernels: types, threads, calls between kernels; corrupt machine code is compiled again, or reported."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import numba
import numpy as np
import pytest
from waiting import wait_until

import foveasim
from foveasim._core import jit
from foveasim._core.jit import kernel_modules, njit

PACKAGE = Path(foveasim.__file__).parent
#: Load a small kernel, and parse the GDSII records HEADER and ENDLIB, 6 and 4 bytes.
PROGRAM = """
import sys
import numpy as np
from foveasim.errors import FoveasimError
from foveasim.layout.files._kernels import walk_records
records = bytes([0, 6, 0, 2, 2, 88, 0, 4, 4, 0])
try:
    print(walk_records(np.frombuffer(records, np.uint8), np.ones(2**16, bool), 0x0400))
except FoveasimError as error:
    sys.exit(str(error))
"""


def run(program, cache):
    """
    Run a program with a directory of machine code: its output and error messages.

    The machine code is not optimised, which takes most of the time of compilation and changes neither types nor files.
    """
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache), "NUMBA_OPT": "0", "PYTHONPATH": str(PACKAGE.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip(), done.stderr.strip()


def load_kernels(cache):
    return run(PROGRAM, cache)


def with_irreplaceable_index(filled_cache, directory):
    cache = shutil.copytree(filled_cache, directory / "numba")
    for path in cache.rglob("*.nbi"):
        path.unlink()
        path.mkdir()
    return cache


@pytest.fixture(scope="module")
def filled_cache(tmp_path_factory):
    cache = tmp_path_factory.mktemp("numba")
    assert load_kernels(cache)[0] == "(10, 1024)"
    return cache


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extension", "corrupt"),
    [
        ("nbi", lambda content: content[: len(content) // 2]),
        ("nbi", lambda content: bytes(len(content))),
        ("nbc", lambda content: content[: len(content) // 2]),
        ("nbc", lambda content: content[:0]),
    ],
    ids=["truncated-index", "zeros-index", "truncated-code", "empty-code"],
)
def test_corrupt_machine_code_is_compiled_again(filled_cache, tmp_path, extension, corrupt):
    cache = shutil.copytree(filled_cache, tmp_path / "numba")
    path = min(cache.rglob(f"*.{extension}"))
    path.write_bytes(corrupt(path.read_bytes()))

    result, notice = load_kernels(cache)

    assert result == "(10, 1024)"
    assert re.fullmatch(r"compiled kernels in /.* were corrupt: compiling them again .*", notice)
    assert load_kernels(cache) == ("(10, 1024)", "")


@pytest.mark.slow
@pytest.mark.parametrize("exchanged", [("nbc",), ("nbi",), ("nbi", "nbc")])
def test_exchanged_machine_code_is_compiled_again(exchanged, tmp_path):
    """Two kernels of equal types: numba loads the code of the other one if their files are exchanged."""
    program = (
        "import numpy as np\n"
        "import exchanged\n"
        "print(exchanged.double(np.ones(2)).tolist(), exchanged.triple(np.ones(2)).tolist())"
    )
    (tmp_path / "exchanged.py").write_text(
        "from numba import types\n"
        "from foveasim._core.jit import njit\n"
        "floats = types.Array(types.float64, 1, 'C')\n"
        "@njit(types.float64[::1](floats))\n"
        "def double(x):\n    return 2.0 * x\n"
        "@njit(types.float64[::1](floats))\n"
        "def triple(x):\n    return 3.0 * x\n"
    )
    program = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n" + program
    cache = tmp_path / "numba"
    assert run(program, cache)[0] == "[2.0, 2.0] [3.0, 3.0]"
    for extension in exchanged:
        (one,), (other,) = (list(cache.rglob(f"*.{name}-*.{extension}")) for name in ("double", "triple"))
        content = one.read_bytes(), other.read_bytes()
        one.write_bytes(content[1])
        other.write_bytes(content[0])

    result, notice = run(program, cache)

    assert result == "[2.0, 2.0] [3.0, 3.0]"
    assert ("were corrupt: compiling them again" in notice) == (
        exchanged != ("nbi", "nbc")
    )  # a pair of pairs is complete
    assert run(program, cache)[0] == "[2.0, 2.0] [3.0, 3.0]"


@pytest.mark.slow
def test_irreplaceable_machine_code_is_reported(filled_cache, tmp_path):
    result, message = load_kernels(with_irreplaceable_index(filled_cache, tmp_path))

    assert result == ""
    assert re.fullmatch(r"/.*: contains compiled kernels that can be neither read nor replaced .*; delete .*", message)


def test_kernels_are_compiled_for_used_types(monkeypatch):
    signatures = [numba.void(real[::1], numba.int64) for real in (numba.float32, numba.float64)]
    monkeypatch.setattr(jit, "_announced", {__name__})

    @njit(signatures)
    def increase(values, by):
        for i in range(values.size):
            values[i] += by

    assert repr(increase) == f"<kernel {__name__}.{increase.__qualname__}, 0 of 2 compiled>"
    for dtype, n_compiled in ((np.float64, 1), (np.float64, 1), (np.float32, 2)):
        values = np.arange(3.0, dtype=dtype)
        increase(values, 2)

        assert values.tolist() == [2.0, 3.0, 4.0]
        assert f"{n_compiled} of 2" in repr(increase)
    with pytest.raises(TypeError, match="no signature for complex64"):
        increase(np.zeros(3, np.complex64), 2)


def test_kernels_are_distinguished_by_the_fewest_arrays():
    pairs = [(numba.float32, numba.int8), (numba.float64, numba.int8), (numba.float64, numba.int16)]

    @njit([numba.float64(numba.float64[::1], a[::1], a, b[::1]) for a, b in pairs])
    def add(x, y, z, w):
        return x[0] + y[0] + z + w[0]

    assert [
        add(np.ones(1), np.full(1, 2.0, y), z, np.full(1, 4, w))
        for y, z, w in ((np.float32, np.float32(3.0), np.int8), (np.float64, 3.0, np.int8), (np.float64, 3.0, np.int16))
    ] == [10.0] * 3
    assert "3 of 3" in repr(add)


def test_threads_compile_a_kernel_once(monkeypatch):
    asked, compiled = [], []

    def compile_late(function, *_):
        compiled.append(function.__name__)
        wait_until(lambda: len(asked) == 8)
        return function

    monkeypatch.setattr(jit, "_compile", compile_late)

    @njit(numba.int64(numba.int64))
    def double(x):
        return 2 * x

    def ask(x):
        asked.append(x)
        return double(x)

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(ask, range(8))) == list(range(0, 16, 2))
    assert compiled == ["double"]


def test_kernels_call_kernels_and_functions():
    @njit(numba.float64(numba.float64[::1]))
    def total(values):
        found = 0.0
        for value in values:
            found += value
        return found

    @njit()
    def half(value):
        return 0.5 * value

    @njit(numba.float64(numba.float64[::1]))
    def half_total(values):
        return half(total(values))

    assert half_total(np.arange(5.0)) == 5.0
    assert total(np.arange(5.0)) == 10.0


@pytest.mark.nightly
def test_functions_that_return_arrays_count_references(tmp_path):
    """
    Without reference counts, an array that is returned could be released while it is used.

    The types are inferred without machine code. The kernels are those without reference counts, and those
    that call functions which no other one has called.
    """
    program = """
from importlib import import_module
from numba import types
from numba.core.compiler import CompilerBase, DefaultPassBuilder, compile_result
from numba.core.compiler_machinery import FunctionPass, PassManager, register_pass
from numba.core.dispatcher import Dispatcher
from numba.core.typing import signature
from foveasim._core import jit

@register_pass(mutates_CFG=False, analysis_only=True)
class Typed(FunctionPass):
    _name = "typed"

    def __init__(self):
        FunctionPass.__init__(self)

    def run_pass(self, state):
        found = signature(state.return_type, *state.args)
        state.cr = compile_result(signature=found, entry_point=len, objectmode=False)  # len: any function written in C
        return True

class Types(CompilerBase):
    def define_pipelines(self):
        passes = PassManager("types")
        for part in (DefaultPassBuilder.define_untyped_pipeline, DefaultPassBuilder.define_typed_pipeline):
            passes.passes.extend(part(self.state).passes)
        passes.add_pass(Typed, "types of the function")
        passes.finalize()
        return [passes]

def has_array(kind):
    return isinstance(kind, types.Array) or any(map(has_array, kind if isinstance(kind, types.BaseTuple) else ()))

def inner(value):
    return value._inner if isinstance(value, jit.Kernel) else value

def called(function):
    for name in function.py_func.__code__.co_names:
        value = function.py_func.__globals__.get(name)
        if isinstance(value, (jit.Kernel, Dispatcher)):
            yield inner(value)
            yield from called(inner(value))

jit.OPTIONS["pipeline_class"] = Types
objects = [value for name in jit.kernel_modules() for value in vars(import_module(name)).values()]
kernels = [value for value in objects if isinstance(value, jit.Kernel)]
for kernel in sorted(kernels, key=lambda kernel: -len(set(called(inner(kernel))))):
    if not (inner(kernel).targetoptions["_nrt"] and all(function.overloads for function in called(inner(kernel)))):
        inner(kernel).compile(next(iter(kernel.signatures)))
functions = [inner(value) for value in objects if isinstance(value, (jit.Kernel, Dispatcher))]
assert all(value.overloads for value in objects if isinstance(value, Dispatcher))
types_of = [(f, o.signature.return_type) for f in functions for o in f.overloads.values()]
assert len(types_of) > 100
assert any(has_array(kind) for _, kind in types_of)
print([f.__name__ for f, kind in types_of if has_array(kind) and not f.targetoptions["_nrt"]])
"""
    assert run(program, tmp_path) == ("[]", "")
    assert list(tmp_path.iterdir()) == []


def test_division_by_zero_is_that_of_numpy():
    @njit(numba.float64(numba.float64, numba.float64))
    def ratio(a, b):
        return a / b

    assert [ratio(1.0, 0.0), ratio(-1.0, 0.0)] == [np.inf, -np.inf]
    assert np.isnan(ratio(0.0, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("n_workers", [1, 2])
def test_kernels_are_compiled_ahead(tmp_path, n_workers):
    program = f"""
from foveasim._core import jit
jit.kernel_modules = lambda: ["foveasim.layout.files._kernels", "foveasim.scene._kernels"]
print(jit.compile_kernels(n_workers={n_workers}))
"""
    assert run(program, tmp_path)[0] == "8"
    stored = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb[ic]")}

    assert (
        len(list(tmp_path.rglob("*.nbc"))) == 6
    )  # four kernels of files without inner functions, and one for two types
    assert load_kernels(tmp_path) == ("(10, 1024)", "")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb[ic]")} == stored


@pytest.mark.slow
def test_errors_of_workers_are_raised(filled_cache, tmp_path):
    program = """
import sys
from foveasim._core import jit
from foveasim.errors import FileError
jit.kernel_modules = lambda: ["foveasim.layout.files._kernels"]
try:
    jit.compile_kernels(n_workers=2)
except FileError as error:
    sys.exit(str(error))
"""
    result, message = run(program, with_irreplaceable_index(filled_cache, tmp_path))

    assert result == ""
    assert re.fullmatch(r"/.*: contains compiled kernels that can be neither .*; delete .*", message)


def test_other_compilation_errors_pass_through():
    def kernel(x):
        return x + 1

    with pytest.raises(numba.TypingError):
        njit(numba.int64(numba.types.unicode_type))(kernel).compile()


def test_kernel_modules_are_found_by_content():
    compiling = {
        path
        for path in PACKAGE.rglob("*.py")
        if re.search(r"^\s*@(numba\.)?(n?jit|vectorize)\b", path.read_text(), re.MULTILINE)
    }

    assert {Path(find_spec(name).origin) for name in kernel_modules()} == compiling
    assert "foveasim.view._zbuffer_kernels" in set(kernel_modules())


@pytest.mark.slow
def test_kernels_are_imported_inside_functions():
    imported = [
        (str(path.relative_to(PACKAGE)), name)
        for path in sorted(PACKAGE.rglob("*.py"))
        if not path.stem.endswith("_kernels")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (getattr(node, "module", None) or "", *(alias.name for alias in node.names))
    ]

    assert len(imported) > 1000
    assert [(path, name) for path, name in imported if re.search(r"(^|\.)_\w*kernels$", name)] == []
