"""The site: guides in Markdown, the gallery run afresh, the reference from docstrings. Warnings are errors (``make docs``)."""

from __future__ import annotations

import ast
import importlib
import inspect
import runpy
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import foveasim

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.config import Config

project = "foveasim"
author = "the foveasim authors"
project_copyright = author
version = release = foveasim.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "foveasim"
html_static_path: list[str] = []
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's lists have shapes and units too
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
templates_path = ["_templates"]
nitpicky = False

REPOSITORY = Path(__file__).parent.parent
#: Pages of the gallery, made by running it; pictures are made again when a script is newer.
GALLERY = Path(__file__).parent / "gallery"


#: Rooms of the reference: module, what it is for. What a room lists is its ``__all__``.
ROOMS = {
    "foveasim": "The whole chain: `import foveasim as fs`. The other rooms are its attributes.",
    "foveasim.layout": "Photosites as packed polygons: generators, edits, design rules, files.",
    "foveasim.scene": "What the lens looks at.",
    "foveasim.scene.charts": "Scenes with physical sizes, to measure with.",
    "foveasim.optics": "From a scene to the light in the focal plane.",
    "foveasim.distortion": "Lens models, which move the outlines of photosites.",
    "foveasim.maps": "Light from other programs, and for them.",
    "foveasim.sensor": "From light to codes: efficiencies, noise, converters.",
    "foveasim.sensor.effects": "Noise sources, fixed patterns and crosstalk, and the contract for one's own.",
    "foveasim.reconstruct": "From codes back to pictures.",
    "foveasim.video": "Frames in, gazes that move, recordings out.",
    "foveasim.modes": "Other ways to expose: rolling shutters, events, spikes.",
    "foveasim.metrics": "What a sensor is worth.",
    "foveasim.view": "Plots, solids, and pages for a browser.",
    "foveasim.explore": "Many cameras: sweeps, studies, datasets.",
    "foveasim.config": "Settings files: YAML in, objects out.",
    "foveasim.errors": "What is raised.",
    "foveasim.units": "Conversions by name.",
}
REFERENCE = Path(__file__).parent / "reference"


def public_names() -> dict[str, list[str]]:
    """List the public names of every room, which have a page each."""
    rooms = {name: importlib.import_module(name) for name in ROOMS}
    public = {}
    for name, room in rooms.items():
        # What a package re-exports from its subpackages is listed with these.
        hidden = {"__version__"}.union(*(other.__all__ for at, other in rooms.items() if at.startswith(f"{name}.")))
        public[name] = [n for n in room.__all__ if n not in hidden and not inspect.ismodule(getattr(room, n))]
    return public


def gallery_scripts(repository: Path) -> list[Path]:
    """List the scripts of the gallery, which have a page each."""
    return sorted((repository / "gallery").glob("[0-9]*.py"))


def generated_pages(repository: Path) -> set[Path]:
    """List the pages that the build writes, relative to the directory of the documentation."""
    rooms = {f"{name}.md" for name in ROOMS}
    made = {f"made/{room}.{name}.rst" for room, names in public_names().items() for name in names}
    scripts = {f"{script.stem}.md" for script in gallery_scripts(repository)}
    reference = {Path("reference", page) for page in {"index.md"} | rooms | made}
    return reference | {Path("gallery", page) for page in {"index.md"} | scripts}


def write_reference(_app: Sphinx, _config: Config) -> None:
    """Write a page for every room, which lists what the room says is public."""
    shutil.rmtree(REFERENCE, ignore_errors=True)  # pages of names that are no more
    REFERENCE.mkdir()
    public = public_names()
    for name, about in ROOMS.items():
        names = "\n".join(f"   {n}" for n in public[name])
        table = f".. currentmodule:: {name}\n\n.. autosummary::\n   :toctree: made\n   :nosignatures:\n\n{names}\n"
        (REFERENCE / f"{name}.md").write_text(f"# {name}\n\n{about}\n\n```{{eval-rst}}\n{table}```\n")
    contents = "\n".join(ROOMS)
    page = f"# Reference\n\n```{{toctree}}\n:maxdepth: 1\n\n{contents}\n```\n"
    (REFERENCE / "index.md").write_text(page)


def write_gallery(_app: Sphinx, _config: Config) -> None:
    """Run every script of the gallery, and write a page for each: what it asks and expects, its pictures, its source."""
    entries, stems = [], []
    for script in gallery_scripts(REPOSITORY):
        folder = GALLERY / script.stem
        done = folder / "done"
        if not done.exists() or done.stat().st_mtime < script.stat().st_mtime:
            folder.mkdir(parents=True, exist_ok=True)
            runpy.run_path(str(script))["main"](folder)
            done.touch()
        title = script.stem[3:].replace("_", " ").capitalize()
        told = (ast.get_docstring(ast.parse(script.read_text())) or "").replace("``", "`")
        pictures = [f"{script.stem}/{picture.name}" for picture in sorted(folder.glob("*.png"))]
        shown = "\n\n".join(f"![{picture}]({picture})" for picture in pictures)
        source = (
            f"```{{literalinclude}} ../../gallery/{script.name}\n:language: python\n:start-at: from __future__\n```"
        )
        page = f"# {title}\n\n{told}\n\n{shown}\n\n## gallery/{script.name}\n\n{source}\n"
        (GALLERY / f"{script.stem}.md").write_text(page)
        thumbnail = "".join(
            f"\n\n```{{image}} {p}\n:width: 360px\n:target: {script.stem}.html\n```" for p in pictures[:1]
        )
        entries.append(f"## [{title}]({script.stem}.md)\n\n{told.partition(chr(10))[0]}{thumbnail}")
        stems.append(script.stem)
    about = "Every picture on these pages was made by its script when the site was built, and every figure is asserted by it."
    contents = "```{toctree}\n:hidden:\n\n" + "\n".join(stems) + "\n```"
    (GALLERY / "index.md").write_text("\n\n".join(("# Gallery", about, contents, *entries)) + "\n")


def setup(app: Sphinx) -> None:
    """Sphinx calls this."""
    sys.path.insert(0, str(REPOSITORY / "gallery"))
    app.connect("config-inited", write_reference)  # before Sphinx looks which pages there are
    app.connect("config-inited", write_gallery)
