"""
Checks of the built site: results, figures, summaries, width of code, links, home page.

    python docs/check_pages.py docs/_build/html        exit code 1, and a line per problem
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

from lxml import html
from lxml.html import HtmlElement

import foveasim.optics
import foveasim.scene.charts
import foveasim.view
from foveasim.layout import EDITS, LAYOUTS
from foveasim.scene import SCENES

#: Pages whose blocks of code are steps with a result.
STEPS = ("quick_start.html", "tutorial.html")
#: Languages of code that is run for a page.
RUN = ("highlight-python", "highlight-sh")
#: Columns of code for which pages have room.
MAX_COLUMNS = 88
#: Pages with the source of the package, which scroll.
SOURCES = "_modules"
HOME = "index.html"


@cache
def parsed(page: Path) -> HtmlElement:
    """Return the elements of a page."""
    return html.fromstring(page.read_text("utf-8"))


def pages_of(site: Path) -> list[Path]:
    """Return the pages of a site, without the source of the package."""
    found = sorted(site.rglob("*.html"))
    skipped = {SOURCES, "_static", "_sources"}
    return [page for page in found if page.relative_to(site).parts[0] not in skipped]


def has_class(element: HtmlElement, *names: str) -> bool:
    """Return whether an element has one of some classes."""
    return bool(set(element.get("class", "").split()) & set(names))


def steps_without_result(site: Path) -> Iterator[str]:
    """Yield blocks of code that neither a picture nor an output follows."""
    for name in STEPS:
        blocks = [
            one for one in parsed(site / name).iter("div") if has_class(one, *RUN)
        ]
        if not blocks:
            yield f"{name}: no code"
        for block in blocks:
            result = block.getnext()
            is_shown = result is not None and has_class(result, "code-result")
            if not is_shown or not result.xpath(".//img | .//pre"):
                yield f"{name}: no result of {block.text_content().split()[:6]}"


def names_with_figures() -> set[str]:
    """Return the complete names of generators, edits, charts, pupils and plots."""
    layout, pupils, view = foveasim.layout, foveasim.optics, foveasim.view
    found = {f"foveasim.layout.{n}" for n in LAYOUTS if hasattr(layout, n)}
    found |= {f"foveasim.layout.{n}" for n in EDITS if n in layout.__all__}
    charts = foveasim.scene.charts
    found |= {f"foveasim.scene.charts.{n}" for n in SCENES if n in charts.__all__}
    plots = [n for n in view.__all__ if n.startswith("plot_")]
    found |= {f"foveasim.view.{n}" for n in plots}
    shapes = ("Annulus", "Blades", "PupilImage", "Slit", "Spider")
    return found | {f"foveasim.optics.{n}" for n in shapes if hasattr(pupils, n)}


def names_without_figure(site: Path) -> Iterator[str]:
    """Yield pages of the reference that lack a figure in light or dark."""
    for name in sorted(names_with_figures()):
        page = site / "reference" / "made" / f"{name}.html"
        if not page.exists():
            yield f"{name}: no page"
            continue
        for class_name in ("only-light", "only-dark"):
            images = parsed(page).xpath(f"//dl//img[contains(@class, '{class_name}')]")
            if not images:
                yield f"{name}: no figure of class {class_name}"


def cut_summaries(site: Path) -> Iterator[str]:
    """Yield summaries of the reference that are empty, or end within parentheses."""
    for page in sorted((site / "reference").glob("foveasim*.html")):
        for cells in parsed(page).xpath("//table//tr[count(td) > 1]"):
            texts = [cell.text_content().strip() for cell in cells]
            is_cut = texts[-1].count("(") != texts[-1].count(")")
            if is_cut or not texts[-1]:
                yield f"{page.relative_to(site)}: {texts[0]}: {texts[-1]!r}"


def wide_code(site: Path) -> Iterator[str]:
    """Yield lines of code that do not fit in a page, but for what examples of docstrings print."""
    blocks = "//div[@class='highlight'][not(ancestor::*[contains(@class, 'output')])]"
    for page in pages_of(site):
        is_docstring = page.parent.name == "made"
        for block in parsed(page).xpath(f"{blocks}//pre"):
            for line in block.text_content().split("\n"):
                if len(line) > MAX_COLUMNS and not (
                    is_docstring and not line.startswith((">>> ", "... "))
                ):
                    where = page.relative_to(site)
                    yield f"{where}: {len(line)} columns: {line.strip()[:60]}"


@cache
def anchors(page: Path) -> frozenset[str]:
    """Return the targets within a page."""
    return frozenset(parsed(page).xpath("//@id | //a/@name"))


def broken_links(site: Path) -> Iterator[str]:
    """Yield links within a site that lead to no file, or to no place in a page."""
    for page in pages_of(site):
        for link in sorted(set(parsed(page).xpath("//a/@href | //img/@src"))):
            if urlsplit(link).scheme or link.startswith("//"):
                continue
            address, fragment = urldefrag(link)
            path = address.partition("?")[0]
            target = (page.parent / unquote(path)).resolve() if path else page
            if not target.is_file():
                yield f"{page.relative_to(site)}: {link}"
            elif (
                fragment
                and target.suffix == ".html"
                and unquote(fragment) not in anchors(target)
            ):
                yield f"{page.relative_to(site)}: no place {link}"


def missing_from_home(site: Path) -> Iterator[str]:
    """Yield what is further from the home page than one click."""
    home = parsed(site / HOME)
    article = home.xpath("//article")[0]
    links = [link for link in article.xpath(".//a/@href") if not urlsplit(link).scheme]
    linked = {urldefrag(link).url for link in links} - {"", "#"}
    texts = {
        name: parsed(site / name).text_content()
        for name in linked
        if name.endswith(".html")
    }
    ways = {
        "install line": "pip install" in article.text_content(),
        "first picture": bool(
            article.xpath(".//div[contains(@class, 'code-result')]//img")
        ),
        "citation": any("@misc{" in text for text in texts.values()),
        "chip-file path": any(
            'read_layout("chip.gds"' in text for text in texts.values()
        ),
        "comparison with a known sensor": any("known-sensor" in link for link in links),
    }
    yield from (
        f"{HOME}: no way to {name}" for name, found in ways.items() if not found
    )


CHECKS: tuple[Callable[[Path], Iterator[str]], ...] = (
    steps_without_result,
    names_without_figure,
    cut_summaries,
    wide_code,
    broken_links,
    missing_from_home,
)


def main() -> None:
    """Print all problems of a site."""
    site = Path(sys.argv[1]).resolve()
    problems = [problem for check in CHECKS for problem in check(site)]
    print(*problems, sep="\n")  # noqa: T201 -- output of a script
    if problems:
        sys.exit(1)


if __name__ == "__main__":
    main()
