"""Compiled kernels: corrupt machine code on disk is compiled again; what cannot be replaced is named."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import kernel_modules

import foveasim
from foveasim.compiled import kernels
from foveasim.errors import FileError

PACKAGE = Path(foveasim.__file__).parent
#: Load the smallest kernels, and walk the GDSII records HEADER and ENDLIB, 6 and 4 bytes.
PROGRAM = """
import sys
import numpy as np
from foveasim.compiled import kernels
from foveasim.compiled import kernels
from foveasim.errors import FoveasimError
try:
    walk = kernels("layout.files").walk_records
except FoveasimError as error:
    sys.exit(str(error))
records = bytes([0, 6, 0, 2, 2, 88, 0, 4, 4, 0])
print(walk(np.frombuffer(records, np.uint8), np.ones(2**16, bool), 0x0400))
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
    (path,) = cache.rglob(f"*.{extension}")
    path.write_bytes(corrupt(path.read_bytes()))

    result, notice = load_kernels(cache)

    assert result == "(10, 1024)"
    assert re.fullmatch(r"compiled kernels in /.* were corrupt: compiling them again .*", notice)
    assert load_kernels(cache) == ("(10, 1024)", "")


def test_irreplaceable_machine_code_is_named(filled_cache, tmp_path):
    cache = shutil.copytree(filled_cache, tmp_path / "numba")
    for path in cache.rglob("*.nbi"):
        path.unlink()
        path.mkdir()

    result, message = load_kernels(cache)

    assert result == ""
    assert re.fullmatch(r"/.*: contains compiled kernels that can be neither read nor replaced .*; delete .*", message)


def test_other_errors_of_kernels_pass(monkeypatch):
    def fail(name):
        raise ValueError(name)

    monkeypatch.setattr("foveasim.compiled.importlib.import_module", fail)
    with pytest.raises(ValueError, match=r"^foveasim\.optics\._absent$") as caught:
        kernels("optics", "_absent")
    assert not isinstance(caught.value, FileError)


def test_kernel_modules_are_found_by_content():
    found = set(kernel_modules())
    written = {path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if "@njit" in path.read_text()}

    assert {PACKAGE.joinpath(*room.split("."), f"{name}.py").relative_to(PACKAGE) for room, name in found} == written
    assert ("view", "_zbuffer_kernels") in found


def test_kernels_are_loaded_by_one_function():
    importing = re.compile(r"^\s*(from|import) .*_kernels\b", re.MULTILINE)
    others = [path for path in PACKAGE.rglob("*.py") if not path.stem.endswith("_kernels")]

    assert [str(path) for path in others if importing.search(path.read_text())] == []
