"""Requirements of the settings, with results and margins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from foveasim.config import Requirement
from foveasim.errors import FoveasimError
from foveasim.explore import CheckedRequirement, result_of
from foveasim.metrics import METRICS, metric_info
from foveasim.metrics.registry import has_region
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, part


def saturated_fraction(requirement: Requirement, result: Simulated) -> float:
    """Return the saturated fraction of the photosites of a requirement on signals, or 0."""
    if not metric_info(requirement.measure).is_of_signals:
        return 0.0
    return result_of(replace(requirement, measure="saturated_fraction"), result.shot, result.capture)


@part("Requirements", lambda result: (result.capture, result.shot.requirements), order=95, group="Check")
def requirements(result: Simulated) -> PartData:
    """Return the requirements with their results, and the results that can be limited."""
    rows: list[dict[str, Any]] = []
    for requirement in result.shot.requirements:
        row: dict[str, Any] = {"subject": requirement.subject, "text": str(requirement), "unit": requirement.unit}
        try:
            checked = CheckedRequirement(requirement, result_of(requirement, result.shot, result.capture))
        except FoveasimError as error:
            row |= {"value": None, "margin": None, "is_met": False, "problem": str(error)}
        else:
            row |= {"value": checked.value, "margin": checked.margin, "is_met": checked.is_met, "problem": ""}
            row["saturated_fraction"] = saturated_fraction(requirement, result)
        rows.append(row)
    measures = [
        {
            "name": name,
            "label": f"{info.title} / {info.unit}" if info.unit else info.title,
            "unit": info.unit,
            "has_region": has_region(name),
            "is_cost": info.better == "low",
        }
        for name, info in ((name, metric_info(name)) for name in METRICS)
        if info.is_number
    ]
    return {"rows": rows, "measures": measures}, {}
