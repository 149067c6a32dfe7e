"""Rules of axe-core for accessible pages, run in a browser."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

#: Rules whose results depend on the theme.
OF_COLOURS = ["color-contrast", "link-in-text-block"]
FIND = """async ([part, rules]) => (await axe.run(part, { resultTypes: ["violations"], ...(rules && { runOnly: rules }) })).violations
  .filter(({ impact }) => ["serious", "critical"].includes(impact))
  .flatMap(({ id, nodes }) => nodes.map((node) => [id, String(node.target.at(-1)), node.failureSummary]))"""


@cache
def _script():
    return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")


def violations_in_themes(page, part="html"):
    """Return the violations in the light theme, and those of colours in the dark one; the light one is left."""
    found = []
    for scheme, rules in (("dark", OF_COLOURS), ("light", None)):
        page.emulate_media(color_scheme=scheme)
        found += [f"{scheme}: {text}" for text in violations(page, part, rules)]
    return found


def violations(page, part="html", rules=None):
    """
    Return the serious and critical violations of a part of a page, by its selector: rule, element, and what is wrong.

    ``rules``: names of those that are applied; None for all.
    """
    if not page.evaluate("'axe' in window"):
        page.evaluate(_script())
    found = page.evaluate(FIND, [part, rules])
    return [f"{rule}: {element}: {' '.join(summary.split())}" for rule, element, summary in found]
