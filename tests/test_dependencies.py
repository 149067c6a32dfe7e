"""Declared dependencies: every import has one where it is needed, and each one is used."""

from __future__ import annotations

import ast
import inspect
import re
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import foveasim
from foveasim._core.extras import EXTRA_OF, import_optional
from foveasim.errors import FileError, ParameterError

PACKAGE = Path(foveasim.__file__).parent
ROOT = PACKAGE.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: Extras of each part of the package, beyond what is always installed.
EXTRAS = {
    "_io": {"maps", "pictures", "video"},
    "capture": {"maps"},
    "compare": {"maps"},
    "explore": {"explore", "learn"},
    "layout": {"dxf", "klayout", "layout", "maps", "parquet"},
    "learn": {"adapters", "learn"},
    "maps": {"maps"},
    "modes": {"events", "video"},
    "optics": {"maps"},
    "scene": {"maps"},
    "studio": {"studio"},
    "tiles": {"video"},
    "twin": {"maps", "pictures"},
    "video": {"video"},
    "view": {"notebook", "view"},
}
#: Extras of what is not part of the package.
FOLDERS = {
    "tests": {"dev"},
    "tests/interop": {"interop"},
    "benchmarks": {"dev", "learn", "peers"},
    "gallery": {"dev", "learn"},
    "validation": {"adapters", "learn", "validate"},
    "release": {"release"},
    "docs": {"docs", "learn"},
}
#: What may name PyTorch: the only tests that run where it is installed, and the check whether it is.
OPTIONAL_TESTS = {
    ROOT / "tests" / "explore" / "test_dataset_torch.py",
    ROOT / "tests" / "conftest.py",
    *(ROOT / "tests" / "learn").rglob("*.py"),
}
#: Distributions that no line imports.
INDIRECT = {
    "cryptography": "distributed makes the keys of a sweep's own scheduler with it",
    "lxml": "trimesh writes 3MF with it",
    "networkx": "trimesh writes 3MF with it",
    "websockets": "uvicorn serves sockets with it",
}
#: Functions that take the name of a module.
IMPORTING = {
    "__import__",
    "_imported",
    "find_spec",
    "import_module",
    "import_optional",
    "importorskip",
    "other_program",
}


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


@cache
def imports(path):
    """Imports and calls of a file, without those below ``if TYPE_CHECKING``."""
    found = [ast.parse(path.read_text())]
    for node in found:  # which grows
        is_for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in (
            vars(node.test).get("id"),
            vars(node.test).get("attr"),
        )
        found.extend(node.orelse if is_for_types else ast.iter_child_nodes(node))
    return [node for node in found if isinstance(node, ast.Import | ast.ImportFrom | ast.Call)]


def modules_of(node):
    """Full names of the modules of an import statement."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module] if isinstance(node, ast.ImportFrom) and node.level == 0 else []


@cache
def imported_modules(path):
    """Full names of the modules that a file imports, also those given to a function by name."""
    found = [name for node in imports(path) for name in modules_of(node)]
    for call in (node for node in imports(path) if isinstance(node, ast.Call)):
        if (name := getattr(call.func, "attr", getattr(call.func, "id", ""))) in IMPORTING:
            args = call.args[1:2] if name == "import_optional" else call.args  # after its subject, before the extra
            found.extend(a.value for a in args if isinstance(a, ast.Constant) and isinstance(a.value, str))
    return found


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


@pytest.mark.slow
def test_imports_of_package_are_declared():
    parts = {path: path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in sorted(PACKAGE.rglob("*.py"))}
    found = {path: undeclared_imports(path, EXTRAS.get(part, set())) for path, part in parts.items()}

    assert found
    assert {str(path): names for path, names in found.items() if names} == {}


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS)
def test_imports_of_folders_are_declared(folder):
    inner = {path for name in FOLDERS if name.startswith(f"{folder}/") for path in (ROOT / name).rglob("*.py")}
    built = set((ROOT / "docs" / "_build").rglob("*.py"))  # by an earlier make docs
    paths = sorted(set((ROOT / folder).rglob("*.py")) - OPTIONAL_TESTS - inner - built)
    found = {path: undeclared_imports(path, FOLDERS[folder]) for path in paths}

    assert found
    assert {str(path.relative_to(ROOT)): names for path, names in found.items() if names} == {}


@pytest.mark.slow
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
    hints = {extra for text in texts for extra in re.findall(r"'(?:foveasim|\.)\[([\w,]+)\]'", text)}

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


#: Modules of the package that import optional modules directly, and the functions that have imported them before.
GUARDED = {
    "explore/_worker_imports.py": "check_installed of explore/cluster.py, before workers start",
    "explore/cluster.py": "check_installed",
    "explore/datasets/zarr_rows.py": "zarr is imported by explore/datasets/store.py",
    "explore/executor.py": "check_installed",
    "explore/studies/study.py": "optuna requires sqlalchemy",
    "explore/worker_cache.py": "only in a worker, where distributed is imported",
    "layout/files/_gdstk.py": "import_optional in layout/files/_reading.py",
    "layout/files/dxf.py": "import_optional in read, before arcs",
    "layout/files/nexus.py": "import_optional in read, before the sandbox process",
    "modes/_hdf5.py": "import_optional in modes/events.py",
    "modes/_event_files/_arrays.py": "import_optional in read_hdf5",
    "modes/_event_files/_inivation.py": "import_optional in read_aedat4",
    "studio/_server.py": "import_optional in run_studio",
    "view/meshes.py": "PyVista requires VTK",
    "view/web/_widget.py": "import_optional in view/notebook/_widget.py",
}


@pytest.mark.slow
def test_optional_modules_are_imported_with_install_hint():
    found = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if {name.partition(".")[0] for node in imports(path) for name in modules_of(node)} & set(EXTRA_OF)
    }

    assert {path for path in found if not path.startswith("learn/")} == set(GUARDED)


def without_pytorch(monkeypatch):
    for name in [name for name in sys.modules if name == "torch" or name.startswith("foveasim.learn")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(vars(foveasim), "learn", raising=False)


def test_missing_pytorch_gives_install_command(monkeypatch):
    without_pytorch(monkeypatch)

    with pytest.raises(
        ImportError, match=r"^foveasim.learn.Mesh needs torch; install it with: pip install 'foveasim\[learn\]'$"
    ):
        _ = foveasim.learn.Mesh
    with pytest.raises(ImportError, match=r"pip install 'foveasim\[learn\]'$"):
        from foveasim.learn import site_power  # noqa: F401
    assert not hasattr(foveasim.learn, "not_a_name")


def test_members_are_listed_without_pytorch(monkeypatch):
    without_pytorch(monkeypatch)

    members = dict(inspect.getmembers(foveasim))

    assert set(members) == set(foveasim.__all__)
    assert inspect.getmembers(members["learn"]) == []


@pytest.mark.parametrize(
    "error", [ModuleNotFoundError("No module named 'h5py'", name="h5py"), ImportError("libhdf5.so: no\n")]
)
def test_missing_and_unusable_modules_are_distinguished(monkeypatch, error):
    def fail(name):
        raise error

    monkeypatch.setattr("foveasim._core.extras.import_module", fail)

    with pytest.raises(FileError) as of_file:
        import_optional(Path("a.h5"), "h5py", "maps")
    with pytest.raises(ParameterError) as of_other:
        import_optional("to_table", "h5py", "maps")

    is_missing = isinstance(error, ModuleNotFoundError)
    reason = (
        "; install it with: pip install 'foveasim[maps]'"
        if is_missing
        else ", which cannot be imported (libhdf5.so: no)"
    )
    assert str(of_file.value) == f"a.h5: needs h5py{reason}"
    assert str(of_other.value) == f"'to_table' needs h5py{reason}"
