"""Declared dependencies: every import has one where it is needed, and each one is used."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import foveasim
from foveasim._core.extras import EXTRA_OF

PACKAGE = Path(foveasim.__file__).parent
ROOT = PACKAGE.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: Extras of each part of the package, beyond what is always installed.
EXTRAS = {
    "_io": {"maps", "pictures", "video"},
    "capture": {"maps"},
    "compare": {"maps"},
    "explore": {"explore", "learn"},
    "layout": {"klayout", "layout", "parquet"},
    "learn": {"learn"},
    "maps": {"maps"},
    "modes": {"video"},
    "scene": {"maps"},
    "studio": {"studio"},
    "tiles": {"video"},
    "video": {"video"},
    "view": {"notebook", "view"},
}
#: Extras of what is not part of the package.
FOLDERS = {
    "tests": {"dev"},
    "benchmarks": {"dev", "learn", "peers"},
    "gallery": {"dev", "learn"},
    "docs": {"docs", "learn"},
}
#: What may name PyTorch or gdsfactory: the only tests that run where they are installed, and the check whether they are.
OPTIONAL_TESTS = {
    ROOT / "tests" / "explore" / "test_dataset_torch.py",
    ROOT / "tests" / "layout" / "files" / "test_chip_files_gdsfactory.py",
    ROOT / "tests" / "conftest.py",
    *(ROOT / "tests" / "learn").rglob("*.py"),
}
#: Distributions that no line imports.
INDIRECT = {
    "cryptography": "distributed makes the keys of a sweep's own scheduler with it",
    "h5netcdf": "xarray's engine for NetCDF files",
    "lxml": "trimesh writes 3MF with it",
    "networkx": "trimesh writes 3MF with it",
    "websockets": "uvicorn serves sockets with it",
}
#: Functions that take the name of a module.
IMPORTING = {"__import__", "_imported", "find_spec", "import_module", "import_optional", "importorskip"}


def normalised(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def declared(requirements):
    """Distributions that requirements name, the extras of this package and of others among them."""
    for requirement in requirements:
        name, extras = re.match(r"([\w.-]+)(?:\[([\w,\s-]+)\])?", requirement).groups()
        parts = [part.strip() for part in extras.split(",")] if extras else []
        if name == PROJECT["name"]:
            for extra in parts:
                yield from declared(PROJECT["optional-dependencies"][extra])
        else:
            yield from map(normalised, (name, *parts))  # dask[distributed] is the distributions dask and distributed


CORE = set(declared(PROJECT["dependencies"]))


def allowed(extras):
    return CORE.union(*(declared(PROJECT["optional-dependencies"][extra]) for extra in extras))


@cache
def distributions():
    return packages_distributions()


def only_for_types(tree):
    """Nodes below ``if TYPE_CHECKING``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            yield from (inner for statement in node.body for inner in ast.walk(statement))


def imported_modules(path):
    """Full names of the modules that a file imports, also those given to a function by name."""
    tree = ast.parse(path.read_text())
    skipped = set(only_for_types(tree))
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in IMPORTING:
            yield from (a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str))


def imported_distributions(path):
    for name in {module.partition(".")[0] for module in imported_modules(path)}:
        is_local = any(
            (folder / name).exists() or (folder / f"{name}.py").exists()
            for folder in (path.parent, ROOT, ROOT / "tests")
        )
        if name not in sys.stdlib_module_names and not is_local:
            # What is not installed has the name of its module: torch.
            yield name, {normalised(d) for d in distributions().get(name, [name])}


def undeclared_imports(path, extras):
    return {name for name, found in imported_distributions(path) if not found & allowed(extras)}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_of_package_are_declared(path):
    part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")

    assert undeclared_imports(path, EXTRAS.get(part, set())) == set()


@pytest.mark.parametrize("folder", FOLDERS)
def test_imports_of_folders_are_declared(folder):
    paths = sorted(set((ROOT / folder).rglob("*.py")) - OPTIONAL_TESTS)
    found = {path: undeclared_imports(path, FOLDERS[folder]) for path in paths}

    assert found
    assert {str(path.relative_to(ROOT)): names for path, names in found.items() if names} == {}


def test_declared_distributions_are_used():
    used = {d for path in PACKAGE.rglob("*.py") for _, found in imported_distributions(path) for d in found}
    extras = set().union(*EXTRAS.values())

    assert allowed(extras) - used == set(INDIRECT)


def test_extras_of_messages_bring_their_modules():
    for module, extra in EXTRA_OF.items():
        found = distributions().get(module, ["vtk" if module == "vtkmodules" else module])
        brought = set(declared(PROJECT["optional-dependencies"][extra]))
        assert {normalised(name) for name in found} & brought, (module, extra)


def test_undeclared_imports_are_reported(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text(
        "import typing, numpy, xarray\nfrom sqlalchemy.exc import A\nif typing.TYPE_CHECKING:\n    import zarr\n"
        "import importlib\nimportlib.import_module('h5py')\n"
    )

    assert undeclared_imports(bad, set()) == {"xarray", "sqlalchemy", "h5py"}
    assert undeclared_imports(bad, {"explore"}) == {"h5py"}


def test_install_hints_name_an_extra():
    texts = [
        path.read_text()
        for folder in (PACKAGE, ROOT / "docs")
        for path in folder.rglob("*.*")
        if path.suffix in {".py", ".md"}
    ]
    hints = {extra for text in texts for extra in re.findall(r"foveasim\[([\w,]+)\]", text)}

    assert hints
    assert {part for hint in hints for part in hint.split(",")} <= set(PROJECT["optional-dependencies"])


def test_bounds_of_a_distribution_agree():
    bounds = {}
    for requirements in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        for requirement in requirements:
            name, bound = re.match(r"([\w.-]+(?:\[[^\]]*\])?)(.*)", requirement).groups()
            bounds.setdefault(name, set()).add(bound)

    assert {
        name: found for name, found in bounds.items() if len(found) > 1 or ("" in found and PROJECT["name"] not in name)
    } == {}


def test_missing_pytorch_gives_install_command(monkeypatch):
    for name in [name for name in sys.modules if name == "torch" or name.startswith("foveasim.learn")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(vars(foveasim), "learn", raising=False)

    with pytest.raises(
        ImportError, match=r"^foveasim.learn needs torch; install it with: pip install 'foveasim\[learn\]'$"
    ):
        _ = foveasim.learn
