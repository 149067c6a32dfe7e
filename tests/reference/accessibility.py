"""Rules of axe-core for accessible pages, run in a browser."""

from __future__ import annotations

from functools import cache
from importlib.resources import files


@cache
def _script():
    return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")


def violations(page):
    """Return the serious and critical violations on a page: rule, element, and what is wrong."""
    page.evaluate(_script())
    rules = page.evaluate("() => axe.run()")["violations"]
    return [
        f"{rule['id']}: {node['target'][-1]}: {' '.join(node['failureSummary'].split())}"
        for rule in rules
        if rule["impact"] in ("serious", "critical")
        for node in rule["nodes"]
    ]
