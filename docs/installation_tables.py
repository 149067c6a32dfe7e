"""Tables of licences of dependencies, from the results that ``make release-check`` stores."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.config import Config

HERE = Path(__file__).parent
INSTALLATIONS = HERE / "installations.json"
LICENCES = HERE.parent / "release" / "licences.py"
RESULTS = HERE / "results"


def table_of_core(records: dict[str, Any]) -> str:
    """Return the dependencies of the core with their licences."""
    core = records["core"]["distributions"]
    rows = [
        f"| {name} {each['version']} | {each['licence']} |"
        for name, each in core.items()
    ]
    return "\n".join(["| dependency of the core | licence |", "|---|---|", *rows])


def table_of_exceptions(records: dict[str, Any]) -> str:
    """Return the dependencies of extras that are neither permissive nor under the MPL or LGPL, with the reason."""
    licences = runpy.run_path(str(LICENCES))
    rows = ["| dependency | extra | states | reason |", "|---|---|---|---|"]
    found: dict[str, list[str]] = {}
    for extra, record in records.items():
        for name in licences["exceptions"](record["distributions"]):
            found.setdefault(name, []).append(extra)
    for name, extras in sorted(found.items()):
        question = licences["question_of"](records[extras[0]]["distributions"][name])
        named = ", ".join(f"`{extra}`" for extra in extras)
        reason = licences["reason_of"](name, question)
        rows.append(f"| {name} | {named} | {question} | {reason} |")
    return "\n".join(rows)


def write_licences(_app: Sphinx, _config: Config) -> None:
    """Write the tables, which the page of the licence includes."""
    RESULTS.mkdir(exist_ok=True)
    records = json.loads(INSTALLATIONS.read_text("utf-8"))
    for name, table in (
        ("core_licences", table_of_core),
        ("licence_exceptions", table_of_exceptions),
    ):
        (RESULTS / f"{name}.txt").write_text(table(records) + "\n", "utf-8")
