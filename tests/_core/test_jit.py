"""Compiled kernels: corrupt machine code on disk is compiled again, or its directory is reported."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numba
import pytest
from reference.kernels import kernel_modules

import foveasim
from foveasim._core.jit import njit

PACKAGE = Path(foveasim.__file__).parent
#: Load a small kernel module, and parse the GDSII records HEADER and ENDLIB, 6 and 4 bytes.
PROGRAM = """
import sys
import numpy as np
from foveasim.errors import FoveasimError
try:
    from foveasim.layout.files._kernels import walk_records
except FoveasimError as error:
    sys.exit(str(error))
records = bytes([0, 6, 0, 2, 2, 88, 0, 4, 4, 0])
print(walk_records(np.frombuffer(records, np.uint8), np.ones(2**16, bool), 0x0400))
"""


def load_kernels(cache):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(PACKAGE.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip(), done.stderr.strip()


@pytest.fixture(scope="module")
def filled_cache(tmp_path_factory):
    cache = tmp_path_factory.mktemp("numba")
    assert load_kernels(cache)[0] == "(10, 1024)"
    return cache


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


def test_irreplaceable_machine_code_is_reported(filled_cache, tmp_path):
    cache = shutil.copytree(filled_cache, tmp_path / "numba")
    for path in cache.rglob("*.nbi"):
        path.unlink()
        path.mkdir()

    result, message = load_kernels(cache)

    assert result == ""
    assert re.fullmatch(r"/.*: contains compiled kernels that can be neither read nor replaced .*; delete .*", message)


def test_other_compilation_errors_pass_through():
    def kernel(x):
        return x + 1

    with pytest.raises(numba.TypingError):
        njit(numba.int64(numba.types.unicode_type))(kernel)


def test_kernel_modules_are_found_by_content():
    compiling = {
        path
        for path in PACKAGE.rglob("*.py")
        if re.search(r"^\s*@(numba\.)?(n?jit|vectorize)\b", path.read_text(), re.MULTILINE)
    }

    assert {Path(find_spec(name).origin) for name in kernel_modules()} == compiling
    assert "foveasim.view._zbuffer_kernels" in set(kernel_modules())


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_kernels_are_imported_inside_functions(path):
    if path.stem.endswith("_kernels"):
        return
    imported = [
        name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (getattr(node, "module", None) or "", *(alias.name for alias in node.names))
    ]

    assert [name for name in imported if name.endswith("_kernels")] == []
