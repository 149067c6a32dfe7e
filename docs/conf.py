"""Site: guides in Markdown, gallery from its scripts, reference from docstrings; warnings are errors."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import foveasim

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "gallery")]

import dark_figures  # noqa: E402 -- of this directory
import generated_pages  # noqa: E402
from docutils import nodes  # noqa: E402
from sphinx.transforms import SphinxTransform  # noqa: E402

if TYPE_CHECKING:
    from sphinx.application import Sphinx

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
    "sphinx-mathjax-offline",  # MathJax and its fonts in the site, which needs no network
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "foveasim"
html_static_path = ["_static"]
html_css_files = ["code.css"]
html_search_scorer = str(HERE / "search_order.js")
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Notebooks are executed, and again only after changes.
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_excludepatterns = (
    [] if find_spec("torch") else ["notebooks/dataset_in_pytorch.ipynb"]
)
autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's parameter lists contain types, shapes and units
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
templates_path = ["_templates"]
nitpicky = False


class DarkVariants(SphinxTransform):
    """Show the variants of the figures of a page where the page is dark."""

    default_priority = (
        700  # after the parser, before Sphinx collects the files of images
    )

    def apply(self) -> None:
        """Add the variants that exist to a page."""
        folder = Path(self.document["source"]).parent
        for image in list(self.document.findall(nodes.image)):
            dark = dark_figures.dark_path(folder / image["uri"])
            if "://" not in image["uri"] and dark.exists():
                variant = image.deepcopy()
                variant["uri"] = str(dark_figures.dark_path(Path(image["uri"])))
                image["classes"].append("only-light")
                variant["classes"].append("only-dark")
                image.parent.insert(image.parent.index(image) + 1, variant)


def setup(app: Sphinx) -> None:
    """Register the generators of pages; called by Sphinx."""
    # Before Sphinx lists the pages.
    for write in (
        generated_pages.write_reference,
        generated_pages.write_layouts,
        generated_pages.write_gallery,
    ):
        app.connect("config-inited", write)
    app.add_transform(DarkVariants)
