"""Site: guides in Markdown, gallery from its scripts, reference from docstrings; warnings are errors."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import runpy
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import foveasim
from foveasim.layout import LAYOUTS
from foveasim.scene import SCENES

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.config import Config

project = "foveasim"
author = "the foveasim authors"
project_copyright = author
version = release = foveasim.__version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "foveasim"
html_static_path = ["_static"]
html_css_files = ["code.css"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Notebooks are executed, and again only after changes.
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_excludepatterns = [] if find_spec("torch") else ["notebooks/dataset_in_pytorch.ipynb"]
autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's parameter lists contain types, shapes and units
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
templates_path = ["_templates"]
nitpicky = False

REPOSITORY = Path(__file__).parent.parent
#: Pages of the gallery; pictures are generated again when a script is newer.
GALLERY = Path(__file__).parent / "gallery"
#: Text instead of pictures where a script could not run.
WITHOUT_TORCH = "This site was built without PyTorch, which the script requires; its pictures are therefore missing."

#: Description of the module that only a build with PyTorch documents.
LEARN = "Gradients with respect to photosites, optics and electronics, for PyTorch."
#: Modules of the reference, with descriptions; their ``__all__`` lists the public names.
MODULES = {
    "foveasim": "The main classes, from scenes to captures: `import foveasim as fs`. The other modules are its attributes.",
    "foveasim.layout": "Layouts of photosites as packed polygons: generators, edits, design rules, files.",
    "foveasim.scene": "Scenes: radiance from photographs, hyperspectral cubes, flat fields and point sources.",
    "foveasim.scene.charts": "Test charts with physical sizes.",
    "foveasim.optics": "Pupils, aberrations, PSF, OTF, and the power map of a scene.",
    "foveasim.distortion": "Lens distortion models and calibration files.",
    "foveasim.maps": "Files of power maps from other programs.",
    "foveasim.sensor": "Quantum efficiency, colour filters, the electronic chain, noise budget, calibration, HDR merge.",
    "foveasim.sensor.effects": "Noise sources, fixed patterns and crosstalk, and the interface of user effects.",
    "foveasim.reconstruct": "Raster pictures from captures.",
    "foveasim.tiles": "Captures of sensors that are larger than memory.",
    "foveasim.video": "Frames from files, gaze paths, recordings.",
    "foveasim.modes": "Rolling shutters, event pixels, integrate-and-fire pixels.",
    "foveasim.metrics": "Resolution, aliasing, photon transfer, signal-to-noise ratio, picture quality, optical flow.",
    "foveasim.compare": "Cameras and layouts at equal budget: pictures, quality by eccentricity, information, reports.",
    "foveasim.view": "Plots, 3D rendering, solids, and interactive pages.",
    "foveasim.explore": "Sweeps, optimisation studies and datasets.",
    "foveasim.config": "Settings files in YAML.",
    "foveasim.studio": "Interactive design in the browser.",
    **({"foveasim.learn": LEARN} if find_spec("torch") else {}),
    "foveasim.testing": "Checks of extensions.",
    "foveasim.errors": "Exceptions and warnings.",
    "foveasim.units": "Unit conversions.",
}
#: Functions that modules list by their registry.
REGISTERED = {
    "foveasim.layout": LAYOUTS.within("foveasim.layout.generators"),
    "foveasim.scene.charts": SCENES.within("foveasim.scene.charts"),
}
REFERENCE = Path(__file__).parent / "reference"


def public_names() -> dict[str, list[str]]:
    """List the public names of every module, which have a page each."""
    modules = {name: importlib.import_module(name) for name in MODULES}
    parts = {
        name: {m.name for m in pkgutil.iter_modules(getattr(module, "__path__", []))}
        for name, module in modules.items()
    }
    public = {}
    for name, module in modules.items():
        # Names that a package imports from its subpackages are listed there.
        hidden = {"__version__"}.union(*(other.__all__ for at, other in modules.items() if at.startswith(f"{name}.")))
        # Modules are not imported for this: foveasim.learn needs PyTorch.
        listed = dict.fromkeys([*module.__all__, *REGISTERED.get(name, {})])
        names = [n for n in listed if n not in hidden | parts[name]]
        public[name] = [n for n in names if not inspect.ismodule(getattr(module, n))]
    return public


def main_names(public: dict[str, list[str]]) -> list[str]:
    """List the names of ``foveasim`` that have their page in another module, in the order of the data flow."""
    top = importlib.import_module("foveasim")
    modules = {name: module for module, names in public.items() if module != "foveasim" for name in names}
    found = [f"{modules[name]}.{name}" for name in top.__all__ if name in modules]
    order = ["scene", "optics", "layout", "sensor", "reconstruct"]
    return sorted(
        found, key=lambda name: (*(k for k, part in enumerate(order) if f".{part}." in name), len(order), name)
    )


def gallery_scripts(repository: Path) -> list[Path]:
    """List the scripts of the gallery, which have a page each."""
    return sorted((repository / "gallery").glob("[0-9]*.py"))


def generated_pages(repository: Path) -> set[Path]:
    """List the pages and pictures that the build writes, relative to the directory of the documentation."""
    modules = {f"{name}.md" for name in MODULES}
    made = {f"made/{module}.{name}.rst" for module, names in public_names().items() for name in names}
    scripts = {f"{script.stem}.md" for script in gallery_scripts(repository)}
    scripts |= {
        f"{script.stem}/{picture}"
        for script in gallery_scripts(repository)
        for picture in re.findall(r'"(\w+\.(?:png|webp))"', script.read_text())
    }
    reference = {Path("reference", page) for page in {"index.md"} | modules | made}
    return reference | {Path("gallery", page) for page in {"index.md"} | scripts}


def write_reference(_app: Sphinx, _config: Config) -> None:
    """Write an index with descriptions, and a page with the public names of every module."""
    shutil.rmtree(REFERENCE, ignore_errors=True)  # pages of removed names
    REFERENCE.mkdir()
    public = public_names()
    for name, about in MODULES.items():
        names = "\n".join(f"   {n}" for n in public[name])
        table = f".. currentmodule:: {name}\n\n.. autosummary::\n   :toctree: made\n   :nosignatures:\n\n{names}\n"
        if name == "foveasim":
            main = "\n".join(f"   ~{full_name}" for full_name in main_names(public))
            table = f".. autosummary::\n   :nosignatures:\n\n{main}\n\n{table}"
        (REFERENCE / f"{name}.md").write_text(f"# {name}\n\n{about}\n\n```{{eval-rst}}\n{table}```\n")
    contents = "\n".join(MODULES)
    rows = "\n".join(f"| [{name}]({name}.md) | {about} | {len(public[name])} |" for name, about in MODULES.items())
    table = f"| module | contents | public names |\n|---|---|---|\n{rows}"
    page = f"# Reference\n\n{table}\n\n```{{toctree}}\n:hidden:\n:maxdepth: 1\n\n{contents}\n```\n"
    (REFERENCE / "index.md").write_text(page)


def write_gallery(_app: Sphinx, _config: Config) -> None:
    """Run every script of the gallery; write a page with its question, pictures and source, and an index of cards."""
    entries, stems = [], []
    for script in gallery_scripts(REPOSITORY):
        folder = GALLERY / script.stem
        done = folder / "done"
        is_skipped = "import torch" in script.read_text() and not find_spec("torch")
        if not is_skipped and (not done.exists() or done.stat().st_mtime < script.stat().st_mtime):
            folder.mkdir(parents=True, exist_ok=True)
            runpy.run_path(str(script))["main"](folder)
            done.touch()
        title = script.stem[3:].replace("_", " ").capitalize()
        description = (ast.get_docstring(ast.parse(script.read_text())) or "").replace("``", "`")
        pictures = [
            f"{script.stem}/{picture.name}"
            for picture in sorted(folder.glob("*.*"))
            if picture.suffix in (".png", ".webp")
        ]
        shown = "\n\n".join(f"![{picture}]({picture})" for picture in pictures) or WITHOUT_TORCH
        source = (
            f"```{{literalinclude}} ../../gallery/{script.name}\n:language: python\n:start-at: from __future__\n```"
        )
        page = f"# {title}\n\n{description}\n\n{shown}\n\n## gallery/{script.name}\n\n{source}\n"
        (GALLERY / f"{script.stem}.md").write_text(page)
        question = description.partition("\n")[0]
        thumbnail = "".join(f":img-top: {picture}\n:img-alt: {title}\n" for picture in pictures[:1])
        entries.append(
            f":::{{grid-item-card}} {title}\n:link: {script.stem}\n:link-type: doc\n{thumbnail}\n{question}\n:::"
        )
        stems.append(script.stem)
    about = "Each script generates its pictures when the site is built, and checks its figures."
    contents = "```{toctree}\n:hidden:\n\n" + "\n".join(stems) + "\n```"
    cards = "\n\n".join(("::::{grid} 1 2 3 3\n:gutter: 3", *entries, "::::"))
    (GALLERY / "index.md").write_text(f"# Gallery\n\n{about}\n\n{contents}\n\n{cards}\n")


def setup(app: Sphinx) -> None:
    """Register the generators of pages; called by Sphinx."""
    sys.path.insert(0, str(REPOSITORY / "gallery"))
    app.connect("config-inited", write_reference)  # before Sphinx lists the pages
    app.connect("config-inited", write_gallery)
