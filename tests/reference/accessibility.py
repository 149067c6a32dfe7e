"""Rules of axe-core for accessible pages, run in a browser."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

FIND = """async (part) => (await axe.run(part, { resultTypes: ["violations"] })).violations
  .filter(({ impact }) => ["serious", "critical"].includes(impact))
  .flatMap(({ id, nodes }) => nodes.map((node) => [id, String(node.target.at(-1)), node.failureSummary]))"""


@cache
def _script():
    return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")


def violations_in_themes(page, part="html"):
    """Return the violations in the light and in the dark theme; the light one is left."""
    found = []
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        found += [f"{scheme}: {text}" for text in violations(page, part)]
    return found


def violations(page, part="html"):
    """Return the serious and critical violations of a part of a page, by its selector: rule, element, and what is wrong."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(_script())
    found = page.evaluate(FIND, part)
    return [f"{rule}: {element}: {' '.join(summary.split())}" for rule, element, summary in found]
