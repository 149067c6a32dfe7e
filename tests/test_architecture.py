"""Rules of the package: import layers, lazy imports, units in names, no global random state."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections import Counter
from dataclasses import fields
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import foveasim
from foveasim import Sensor
from foveasim._core.validation import UNIT_SUFFIXES

PACKAGE = Path(foveasim.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

#: Six floors, each of which imports from those below, and the layers of each, from the bottom: imports from lower layers only.
#: Modules of a package that are not on its floor have an entry of their own.
FLOORS = {
    "ground": [{"errors", "_version"}, {"_core"}, {"units", "_projections"}, {"_io"}, {"fields", "incidence"}, {"maps"}],
    "physics": [
        {
            "distortion", "integrate", "optics", "scene", "sensor", "layout._kernels", "layout.lattice", "layout.model",
            "layout.adjacency", "layout.gaps", "layout.graph", "layout.packed", "layout.rows",
        },
        {"modes", "reconstruct"},
        {"columns"},
        {"capture"},
        {"camera"},
    ],
    "design": [{"layout"}],
    "show": [{"view"}],
    "lab": [{"tiles", "video"}, {"metrics"}, {"compare", "twin"}, {"config"}, {"explore", "learn"}],
    "studio": [{"studio", "testing"}, {"cli"}, {"__main__"}],
}  # fmt: skip
LAYERS = [layer for layers in FLOORS.values() for layer in layers]
LAYER_OF = {name: k for k, names in enumerate(LAYERS) for name in names}
#: Packages that are imported on first use.
HEAVY = {
    "OpenEXR", "PIL", "astropy", "av", "cv2", "dask", "distributed", "exactextract", "gdstk", "h5netcdf", "h5py", "imagecodecs", "klayout", "manifold3d", "matplotlib", "pyarrow", "numba", "optuna", "pydantic", "pyvista", "rich", "skimage", "starlette", "tifffile",
    "torch", "trimesh", "typer", "uvicorn", "vtk", "websockets", "xarray", "yaml", "zarr",
}  # fmt: skip
#: Names of dimensionless numbers, or of numbers in the unit of other arguments.
DIMENSIONLESS = {
    "light", "photons", "default", "directions", "errors", "depth_scale", "waves",
    "combinations", "displaced", "relative_illumination", "field_tolerance", "goal", "singular_values", "a", "above", "alpha", "amplitude", "area_ratio", "at_least", "at_most", "beta", "blanking", "circle_tolerance", "coefficients", "colour_matrix", "companding_table", "contrast", "contrast_off", "contrast_on", "count", "custom", "data_range", "delta_e", "delta_e_raw", "deviation", "dilation", "dpi", "esf", "f_number", "factor", "figure_inches", "fill_factor", "gain", "gamma", "half_step", "high", "hot_sigmas", "illuminant", "k", "k1", "k2", "k3", "k4", "k5", "k6", "kernel",
    "confidence", "curves", "difference", "light_factor", "real", "regions", "simulated", "limit", "limits", "log_strength", "low", "magnification", "matrix", "median", "min_coverage", "misfit", "missing", "mtf", "mtf_sigma", "mu", "max_aspect_ratio", "obscuration", "offset",
    "contrast_noise", "log_contrast", "threshold", "thresholds_off", "thresholds_on", "intervals",
    "max_density", "max_growth", "max_neighbour_ratio", "max_track_utilisation", "min_density", "min_growth", "neighbour_fraction", "noisy_ratio", "out", "p1", "p2", "peak", "per_vertex", "percentile", "power", "dynamic_range_db", "prnu_percent", "psnr_db", "psnr_db_by_eccentricity", "qe_percent", "snr_max_db", "value_db", "qe", "ratio", "reflectance", "refractive_index", "response", "rounding", "s1", "s2", "s3", "s4", "xi",
    "linearity_error_max_percent", "linearity_error_min_percent", "noise_dynamic_range_db", "prnu_column_percent", "prnu_pixel_percent", "prnu_row_percent", "qe_curve",
    "result", "result_at", "results", "ring_ratio", "sensitivity", "site_weights", "snr", "spectrum", "ssim", "ssim_by_eccentricity", "stretch", "target", "tolerance", "transmission", "value", "values", "variance", "wavelength", "weight", "weights", "white", "worst_area_error", "zoom",
}  # fmt: skip
#: Names in private functions, in cells, pitches, steps or aperture radii as their docstrings specify.
INTERNAL = {
    "log_mean", "nodes", "slopes", "variance_slope", "along_y", "at_points", "fields", "profiles", "at", "axes", "before", "blur_cells", "blur_lambda_n", "bound", "bounds", "corners", "curve", "cycles", "diagonal", "edge", "extent", "fraction", "fractions", "homography", "from_step", "function", "gradient", "height", "inl", "mean", "measure",
    "n_across", "n_source_cells", "moments", "new_radius", "node", "norm", "off_diagonal", "one", "other", "per_step", "pixel", "plane", "points", "quantiles", "r2", "radius", "right", "row", "rows", "s_x", "s_y", "scale", "screen", "side", "sigma", "slope", "spread", "start", "tables_at",
    "tangent2_x", "tangent2_y", "threshold", "to_step", "u", "upper", "v", "x", "x2", "xy", "y", "y2", "sampling", "step", "t", "weigh", "window",
    "across", "direction", "pitch", "u0", "u1", "v0", "v1", "error", "freedom", "covariance", "edges", "lines", "log_odds_error", "log_step_error", "names", "noise", "of_blocks", "of_pixels", "own_covariance", "probability", "residuals", "share", "square", "vector",
    "neutral", "primaries", "transfer",
    "bounds_db", "difference_db", "illumination", "spectra", "srgb", "white_xyz", "xyz", "centre", "centres", "circles", "column_x", "compute", "discs", "maps", "opening", "photodiode", "position", "half", "lines_x", "lines_y", "ordered", "phase", "radians", "radians_x", "rho", "row_y", "segments", "shift", "tangents",
    "background", "changes", "cover", "response_noise", "rts_probability", "shifts_cells", "transmittance",
}  # fmt: skip
FLOATING = re.compile(r"\b(float|Floats|PerSite)\b")


def subpackage_of(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


@cache
def parsed(path):
    return ast.parse(path.read_text())


@cache
def nodes_of(path):
    """Return all nodes of the syntax tree of a file."""
    return list(ast.walk(parsed(path)))


def offenders(find, paths=MODULES):
    """Return what a function finds in each module, by the path of the module, where it finds anything."""
    found = {str(path.relative_to(PACKAGE)): find(path) for path in paths}
    assert len(found) == len(paths) > 0
    return {path: items for path, items in found.items() if items}


#: Decorators that register an object.
DECORATORS = {"chart", "layout_edit", "layout_generator", "part"}


def registers(path):
    """Return whether a module registers objects."""
    calls = [node.func for node in nodes_of(path) if isinstance(node, ast.Call)]
    names = {call.id for call in calls if isinstance(call, ast.Name)}
    return bool(names & DECORATORS) or "register" in {call.attr for call in calls if isinstance(call, ast.Attribute)}


def test_packages_have_at_most_15_modules():
    n_modules = Counter(path.parent for path in MODULES if not registers(path))

    assert {folder for folder, n in n_modules.items() if n > 15} == set()


def test_package_lists_public_names_only():
    assert set(dir(foveasim)) == set(foveasim.__all__)


def place_of(module):
    """Return the longest entry of a layer that contains a module, such as ``layout.model`` or ``optics``."""
    parts = module.split(".")
    return next(place for n in (2, 1) if (place := ".".join(parts[:n])) in LAYER_OF)


def imports_of(tree):
    """Yield the modules and names of the package that a module imports, those for annotations alone excepted."""
    if isinstance(tree, ast.If) and getattr(tree.test, "id", None) == "TYPE_CHECKING":
        return
    if isinstance(tree, ast.ImportFrom) and str(tree.module).startswith("foveasim"):
        names = [f"{tree.module}.{alias.name}" for alias in tree.names]
        # A name may be a module, or an object of the module it is imported from.
        yield from (name if find_module(name) else tree.module for name in names)
    elif isinstance(tree, ast.Import):
        yield from (alias.name for alias in tree.names if alias.name.startswith("foveasim."))
    for child in ast.iter_child_nodes(tree):
        yield from imports_of(child)


@cache
def find_module(name):
    path = PACKAGE.joinpath(*name.split(".")[1:])
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def upward_imports(module, tree):
    """Return what a module imports from the same or a higher layer, besides its own package."""
    place = place_of(module)
    found = {name.removeprefix("foveasim.") for name in imports_of(tree) if not name.startswith("foveasim.__")}
    others = {place_of(name) for name in found - {"foveasim"}}
    return {
        other
        for other in others
        if (LAYER_OF[other] >= LAYER_OF[place] and other.split(".")[0] != place.split(".")[0])
        or LAYER_OF[other] > LAYER_OF[place]
    }


def test_every_subpackage_has_a_layer():
    subpackages = {subpackage_of(path) for path in MODULES} - {"__init__"}

    assert subpackages == {name for name in LAYER_OF if "." not in name}
    assert all(find_module(f"foveasim.{name}") for name in LAYER_OF)


def test_imports_go_one_way():
    def upwards(path):
        return upward_imports(module_name(path).removeprefix("foveasim."), parsed(path))

    assert offenders(upwards, [path for path in MODULES if path != PACKAGE / "__init__.py"]) == {}


@pytest.mark.parametrize(
    ("module", "code", "found"),
    [
        ("sensor.adc", "from foveasim.camera import Camera", {"camera"}),
        ("layout.model", "def f():\n    from foveasim.layout.drc.rules import check", {"layout"}),
        ("camera._camera", "from foveasim.layout import Layout", {"layout"}),
        ("layout.drc.rules", "from foveasim.layout.model import Layout", set()),
        ("metrics.snr", "from foveasim import view, explore", {"explore"}),
        ("scene._scene", "if TYPE_CHECKING:\n    from foveasim.view import plot_scene", set()),
    ],
)
def test_planted_imports_are_found(module, code, found):
    assert upward_imports(module, ast.parse(code)) == found


def imported_modules(path, names):
    """Return the modules of the package that a module imports, those for annotations alone excepted."""
    modules = set()

    def visit(node):
        if isinstance(node, ast.If) and getattr(node.test, "id", None) == "TYPE_CHECKING":
            return
        if isinstance(node, ast.ImportFrom) and node.module:
            paths = [f"{node.module}.{alias.name}" for alias in node.names]
            modules.update(found if found in names else node.module for found in paths)
        elif isinstance(node, ast.Import):
            modules.update(alias.name for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(parsed(path))
    return modules & names


def module_name(path):
    return ".".join(("foveasim", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


def test_circles_of_imports_stay_in_one_package():
    names = {module_name(path): k for k, path in enumerate(MODULES)}
    arrows = [(k, names[other]) for k, path in enumerate(MODULES) for other in imported_modules(path, names.keys())]
    graph = coo_array((np.ones(len(arrows)), np.transpose(arrows)), shape=(len(MODULES), len(MODULES)))
    n_circles, circle_of = connected_components(graph, connection="strong")
    packages = [{subpackage_of(MODULES[k]) for k in np.flatnonzero(circle_of == c)} for c in range(n_circles)]

    assert [found for found in packages if len(found) > 1] == []
    assert n_circles > 100  # otherwise no circle could be found


def test_modules_are_not_imported_in_circles():
    """Imports within functions excepted: those of a package's parts happen when they are used."""

    def at_import(path):
        body = [node for node in parsed(path).body if not isinstance(node, ast.FunctionDef | ast.ClassDef)]
        return set(imports_of(ast.Module(body, [])))

    names = {module_name(path): path for path in MODULES}
    graph = {name: at_import(path) & names.keys() - {name} for name, path in names.items()}
    order = list(TopologicalSorter(graph).static_order())

    assert len(order) == len(MODULES)
    with pytest.raises(CycleError):
        list(TopologicalSorter(graph | {"foveasim.errors": {"foveasim.camera"}}).static_order())


def test_nothing_heavy_is_loaded_by_import():
    code = "import sys, json, foveasim; print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    loaded = json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)

    assert "foveasim" in loaded
    assert set(loaded) & HEAVY == set()


def unnamed_random_numbers(path):
    """Return the names of ``numpy.random`` that a module uses against the rules, and the standard library's ``random``."""
    used = {
        node.attr
        for node in nodes_of(path)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Attribute)
        and node.value.attr == "random"
        and isinstance(node.value.value, ast.Name)
        and node.value.value.id in {"np", "numpy"}
    }
    modules = {alias.name for node in nodes_of(path) if isinstance(node, ast.Import) for alias in node.names}
    allowed = {"Generator", "PCG64DXSM", "Philox", "SeedSequence"} if path.name == "random_streams.py" else set()
    if path.parent.name == "effects" or path.name == "kinds.py":
        allowed = {"Generator"}  # the type of what effects draw from
    if path.name == "cluster.py":
        allowed = {"seed"}  # of the workers of metrics, which may use the global generator

    return (used - allowed) | (modules & {"random"})


def test_random_numbers_come_from_named_streams_only():
    assert offenders(unnamed_random_numbers) == {}


def test_random_rule_finds_global_state(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text("import random\nimport numpy as np\nnp.random.seed(0)\n")

    assert unnamed_random_numbers(bad) == {"random", "seed"}


def floating_names(path):
    """Return the names of parameters and dataclass fields with float annotations."""
    for node in nodes_of(path):
        if isinstance(node, ast.FunctionDef):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            pairs = [(a.arg, a.annotation) for a in arguments if a.annotation is not None]
        elif isinstance(node, ast.ClassDef):
            pairs = [
                (s.target.id, s.annotation)
                for s in node.body
                if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)
            ]
        else:
            continue
        yield from (name for name, kind in pairs if FLOATING.search(ast.unparse(kind)))


def names_without_unit(path):
    return {
        name
        for name in floating_names(path)
        if not name.endswith(tuple(UNIT_SUFFIXES)) and name not in DIMENSIONLESS | INTERNAL
    }


def test_floating_point_names_carry_their_unit():
    assert offenders(names_without_unit) == {}


def test_unit_rule_exceptions_are_needed():
    used = {name for path in MODULES for name in floating_names(path)}

    assert used >= DIMENSIONLESS | INTERNAL


def test_unit_rule_finds_missing_unit(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text("def f(radius: float, r_um: float | None = None) -> None: ...\n")

    assert [n for n in floating_names(bad) if not n.endswith(tuple(UNIT_SUFFIXES))] == ["radius"]


def test_cached_properties_have_no_lock():
    """That of functools has one lock per class in Python 3.11, which a forked process may inherit locked."""
    using = {
        str(path.relative_to(PACKAGE))
        for path in MODULES
        for node in nodes_of(path)
        if isinstance(node, ast.ImportFrom)
        and node.module == "functools"
        and "cached_property" in {alias.name for alias in node.names}
    }

    assert using == {"_core/calls/pickling.py"}  # recognises both


@pytest.mark.parametrize("folder", ["benchmarks", "validation"])
def test_names_imported_by_programs_exist(folder):
    missing = [
        f"{path.name}: {node.module}.{item.name}"
        for path in sorted((PACKAGE.parent / folder).glob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == PACKAGE.name
        if not node.module.startswith("foveasim.learn")  # requires PyTorch
        for item in node.names
        if not hasattr(import_module(node.module), item.name) and find_spec(f"{node.module}.{item.name}") is None
    ]

    assert missing == []


#: Parameters of the electronics of a sensor, and properties that follow from one of them: results ask the sensor instead.
ELECTRONIC = {
    *(field.name for field in fields(Sensor)),
    "dark_rate_e_per_s", "nominal_dark_e_per_s", "v_per_e", "well_e", "dark_current_ratio",
} - {"layout", "filters", "qe", "bits", "effects", "disabled", "device_seed", "temperature_k", "pixel_optics", "crosstalk", "coupling"}  # fmt: skip
#: Modules that show or transfer parameters, or limit charges at the full well, with those that they read.
READS_PARAMETERS = {
    "view/notebook/_objects.py": None,  # table of parameters
    "reconstruct/estimates.py": {"well_e"},  # charges at the full well
    "testing/_effects.py": {"nominal_dark_e_per_s"},  # an independent mean of the dark charge
}


def electronic_parameters(path):
    """Return the electronic parameters that a module reads from an object called sensor, or a sensor of an object."""
    relative = path.relative_to(PACKAGE)
    if relative.parts[0] == "sensor" or READS_PARAMETERS.get(str(relative), set()) is None:
        return set()
    nodes = (node for node in nodes_of(path) if isinstance(node, ast.Attribute) and node.attr in ELECTRONIC)
    found = {
        node.attr
        for node in nodes
        if ast.unparse(node.value).split(".")[-1] in {"sensor", "copies", "_sensor", "electronics"}
    }
    return found - READS_PARAMETERS.get(str(relative), set())


def test_results_do_not_read_electronic_parameters():
    assert offenders(electronic_parameters) == {}


def test_parameter_rule_finds_reads(tmp_path, monkeypatch):
    bad = tmp_path / "bad.py"
    bad.write_text("noise = camera.sensor.read_noise_e**2 + sensor.well_e\nbits = sensor.bits\n")
    monkeypatch.setitem(globals(), "PACKAGE", tmp_path)

    assert electronic_parameters(bad) == {"read_noise_e", "well_e"}
