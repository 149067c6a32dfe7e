"""Site: guides in Markdown, gallery from its scripts, reference from docstrings; warnings are errors."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

import foveasim

mpl.use("agg")

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "gallery")]

import code_results  # noqa: E402 -- of this directory
import dark_figures  # noqa: E402
import generated_pages  # noqa: E402
import installation_tables  # noqa: E402
import validation_pages  # noqa: E402
from docutils import nodes  # noqa: E402
from sphinx.ext import autosummary  # noqa: E402
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
exclude_patterns = ["_build", "paper"]
html_theme = "furo"
html_title = f"foveasim {release}"
html_logo = "_static/logo.svg"
html_favicon = "_static/favicon.svg"
html_static_path = ["_static", "results/static"]
html_css_files = ["site.css"]
html_theme_options = {"announcement": "sections"}  # _templates/page.html
SUMMARY = "Design and simulate image sensors with photosites of any shape."
#: Links to the repository, once it has a public address.
LINKS = generated_pages.external_links()
html_context = {"external_links": LINKS, "summary": SUMMARY}
html_search_scorer = str(HERE / "search_order.js")
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "substitution"]
myst_substitutions = {
    "version": release,
    "repository": "".join(f" · [{name}]({address})" for name, address in LINKS),
}
myst_heading_anchors = 3
# Notebooks are executed, and again only after changes.
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_excludepatterns = (
    [] if find_spec("torch") else ["notebooks/dataset_in_pytorch.ipynb"]
)
# Named, since a repeated build takes the pages that the build before found.
autosummary_generate = [f"reference/{name}.md" for name in generated_pages.MODULES]
autodoc_typehints = "none"  # numpydoc's parameter lists contain types, shapes and units
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
templates_path = ["_templates"]
nitpicky = False
python_maximum_signature_line_length = 72  # else one parameter per line
#: Languages of the code that is run, by page: its results are shown below each block.
RUN = {
    "index": ("python",),
    "quick_start": ("python", "sh"),
    "tutorial": ("python",),
    "guides/choosing": ("python",),
    "guides/chip_to_report": ("python",),
}
#: Pages of the gallery, by the name that they use.
EXAMPLES = generated_pages.examples_of_names()


class DarkVariants(SphinxTransform):
    """Show the variants of the figures of a page where the page is dark."""

    default_priority = (
        700  # after the parser, before Sphinx collects the files of images
    )

    def apply(self) -> None:
        """Add the variants that exist to a page."""
        folder = Path(self.document["source"]).parent
        for image in list(self.document.findall(nodes.image)):
            home = HERE if image["uri"].startswith("/") else folder
            dark = dark_figures.dark_path(home / image["uri"].lstrip("/"))
            if "://" not in image["uri"] and dark.exists():
                variant = image.deepcopy()
                variant["uri"] = str(dark_figures.dark_path(Path(image["uri"])))
                image["classes"].append("only-light")
                variant["classes"].append("only-dark")
                image.parent.insert(image.parent.index(image) + 1, variant)


class Results(SphinxTransform):
    """Show the results of the code of some pages."""

    default_priority = 690  # before the variants of figures

    def apply(self) -> None:
        """Run the code of a page, and add its results."""
        if self.env.docname in RUN:
            languages = RUN[self.env.docname]
            code_results.add_results(self.document, self.env.docname, languages)


def complete_summary(doc: Sequence[str], _settings: object) -> str:
    """Return the first paragraph of a docstring; Sphinx would end it at "Fig."."""
    started = dropwhile(lambda line: not line.strip(), doc)
    return " ".join(" ".join(takewhile(str.strip, started)).split())


def add_figure_and_examples(
    _app: Sphinx,
    _what: str,
    name: str,
    _obj: object,
    _options: object,
    lines: list[str],
) -> None:
    """Add the figure of a name below its summary, and pages of the gallery that use it."""
    figure = generated_pages.FIGURES / f"{name}.png"
    if figure.exists():
        uri = f"/{figure.relative_to(HERE).as_posix()}"
        first = next(k for k, line in enumerate(lines) if line.strip())
        position = next(
            (k for k in range(first, len(lines)) if not lines[k]), len(lines)
        )
        alt = f"Figure of {name.rpartition('.')[2]}"
        lines[position:position] = ["", f".. image:: {uri}", f"   :alt: {alt}", ""]
    stems = EXAMPLES.get(name, [])
    if stems:
        links = " · ".join(f":doc:`/gallery/{stem}`" for stem in stems)
        lines += ["", ".. rubric:: Examples using this", "", links, ""]


def setup(app: Sphinx) -> None:
    """Register the generators of pages; called by Sphinx."""
    # Before Sphinx lists the pages.
    for write in (
        generated_pages.write_home,
        generated_pages.write_reference,
        generated_pages.write_reference_figures,
        generated_pages.write_layouts,
        generated_pages.write_published_sensors,
        generated_pages.write_gallery,
        validation_pages.write_validation,
        installation_tables.write_licences,
    ):
        app.connect("config-inited", write)
    app.add_transform(Results)
    app.add_transform(DarkVariants)
    autosummary.extract_summary = complete_summary
    # After numpydoc.
    app.connect("autodoc-process-docstring", add_figure_and_examples, priority=900)
