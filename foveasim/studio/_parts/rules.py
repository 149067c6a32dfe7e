"""Design rules."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from foveasim.config import Shot
from foveasim.layout import Layout
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.ahead import MANY_SITES, Ahead
from foveasim.studio._parts.registry import PartData, part
from foveasim.studio._settings.labels import words_of
from foveasim.view.web._content import rules_of


def _start(shot: Shot) -> None:
    if shot.rules is not None and shot.camera.layout.n_sites < MANY_SITES:
        _check.start(shot.camera.layout, shot.rules)


@part(
    "Design rules",
    lambda result: (result.capture.layout, result.shot.rules),
    order=90,
    group="Check",
    is_wide=True,
    work_ahead=_start,
)
def rules(result: Simulated) -> PartData:
    """Return the results of the design-rule check, and the records of repairs."""
    if result.shot.rules is None:
        return {"rules": [], "repairs": []}, {}
    arrays: dict[str, NDArray[Any]] = {}
    report = _check(result.capture.layout, result.shot.rules)
    repairs = list(result.capture.layout.provenance.get("repairs", []))
    found = [
        {**rule, "name": words_of(f"rules.{rule['name']}", {}).label or rule["name"]}
        for rule in rules_of(report, arrays)
    ]
    return {"rules": found, "is_satisfied": bool(report.ok), "repairs": repairs}, arrays


_check = Ahead(Layout.check)
