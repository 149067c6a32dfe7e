"""Requirements of the settings, with results and margins."""

from __future__ import annotations

from typing import Any

from foveasim.config import RESULTS
from foveasim.config._requirements import WITHOUT_REGION
from foveasim.errors import FoveasimError
from foveasim.explore import CheckedRequirement, measure
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, part

#: Results of which smaller values are better.
COSTS = ("n_sites", "saturated_fraction", "data_rate_gbit_per_s", "violations", "exposure_s")


@part("Requirements", lambda result: (result.capture, result.shot.requirements), order=95)
def requirements(result: Simulated) -> PartData:
    """Return the requirements with their results, and the results that can be limited."""
    rows: list[dict[str, Any]] = []
    for requirement in result.shot.requirements:
        row: dict[str, Any] = {"subject": requirement.subject, "text": str(requirement), "unit": requirement.unit}
        try:
            checked = CheckedRequirement(requirement, measure(requirement, result.shot, result.capture))
        except FoveasimError as error:
            row |= {"value": None, "margin": None, "is_met": False, "problem": str(error)}
        else:
            row |= {"value": checked.value, "margin": checked.margin, "is_met": checked.is_met, "problem": ""}
        rows.append(row)
    measures = [
        {
            "name": name,
            "label": f"{label} / {unit}" if unit else label,
            "unit": unit,
            "has_region": name not in WITHOUT_REGION,
            "is_cost": name in COSTS,
        }
        for name, (label, unit) in RESULTS.items()
    ]
    return {"rows": rows, "measures": measures}, {}
