"""Rules of axe-core for accessible pages, run in a browser."""

from __future__ import annotations

from functools import cache
from importlib.resources import files


@cache
def _script():
    return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")


def violations(page, part="html"):
    """Return the serious and critical violations of a part of a page, by its selector: rule, element, and what is wrong."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(_script())
    rules = page.evaluate("part => axe.run(part)", part)["violations"]
    return [
        f"{rule['id']}: {node['target'][-1]}: {' '.join(node['failureSummary'].split())}"
        for rule in rules
        if rule["impact"] in ("serious", "critical")
        for node in rule["nodes"]
    ]
