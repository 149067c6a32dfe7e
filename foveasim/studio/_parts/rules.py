"""Design rules."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, part
from foveasim.view.web._content import rules_of


@part("Design rules", lambda result: (result.capture.layout, result.shot.rules), order=90, is_wide=True)
def rules(result: Simulated) -> PartData:
    """Return the results of the design-rule check."""
    if result.shot.rules is None:
        return {"rules": []}, {}
    arrays: dict[str, NDArray[Any]] = {}
    report = result.capture.layout.check(result.shot.rules)
    return {"rules": rules_of(report, arrays), "is_satisfied": bool(report.ok)}, arrays
