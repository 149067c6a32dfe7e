"""Goal seek: the value of one setting for which a requirement is met."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

from foveasim.config import Requirement, put_setting, validate
from foveasim.explore import result_of
from foveasim.explore.solving import search_value
from foveasim.metrics import metric_info
from foveasim.studio._messages.models import SeekValue, handles
from foveasim.studio._parts.requirements import saturated_fraction
from foveasim.studio._settings.unknowns import PARAMETERS, balanced
from foveasim.studio._settings.values import number_control, present_number

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Range of goal seek for automatic exposures.
EXPOSURES_S = (1e-5, 1.0)
#: Relative difference of a value and the present one that are equal: values are rounded to six digits.
SAME_VALUE = 1e-5


@handles(SeekValue)
def _seek(session: Session, message: SeekValue) -> dict[str, Any] | None:
    """Return settings that meet a requirement, or None if these do; send its curve."""
    settings, key = session.history.settings, message.key
    control = number_control(session.controls, key)
    start = session.required_result("start from")
    requirement: Requirement = validate(None, Requirement, message.requirement)
    present = present_number(settings, control, start)
    low, high = control.get("suggested") or EXPOSURES_S
    if isinstance(present, int | float):
        low, high = min(low, present), max(high, present if key != f"{PARAMETERS}.n_sites" else 4 * present)
    else:
        present = low
    n_done = 0
    saturated: dict[float, float] = {}

    def changed(value: float) -> dict[str, Any]:
        found = copy.deepcopy(settings)
        put_setting(None, found, key, value)
        return balanced(found, key, settings, session.layout_source())

    def result_at(value: float) -> float:
        nonlocal n_done
        n_done += 1
        session.check(f"goal seek, step {n_done}")
        result = session.engine.simulate(changed(value))
        saturated[value] = saturated_fraction(requirement, result)
        return result_of(requirement, result.shot, result.capture)

    low, high = message.bounds or (low, high)
    solution = search_value(
        key, present, requirement, result_at, bounds=(low, high), is_integer=control["kind"] == "integer"
    )
    is_present = math.isclose(solution.value, present, rel_tol=SAME_VALUE)
    session.send({
        "kind": "sought",
        "id": message.id,
        "key": key,
        "label": control["label"],
        "unit": control["unit"],
        "value": solution.value,
        "result": solution.result,
        "subject": requirement.subject,
        "measure": metric_info(requirement.measure).title,
        "result_unit": requirement.unit,
        "limits": [requirement.at_least, requirement.at_most],
        "is_present": is_present,
        "saturated_fraction": saturated.get(solution.value, 0.0),
        "curve": [list(point) for point in solution.curve],
    })  # fmt: skip
    return None if is_present else changed(solution.value)
