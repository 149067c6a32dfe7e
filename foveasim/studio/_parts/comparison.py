"""Comparison of the frozen variant A, named variants and the current state."""

from __future__ import annotations

from typing import Any

from foveasim.errors import SimulationError
from foveasim.studio._comparison import compare
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, part

#: Names of the frozen variant and the current state.
FROZEN, CURRENT = "A", "B"


def _captures_of(result: Simulated) -> tuple[Any, ...]:
    """Return the captures of all variants, and their names."""
    return (result.capture, *(each.capture for _, each in result.compared), tuple(name for name, _ in result.compared))


@part("Comparison", _captures_of, order=130, group="Check", is_of_variants=True)
def comparison(result: Simulated) -> PartData:
    """Return budgets and picture quality of all variants, the current state last."""
    if not result.compared:
        raise SimulationError("there is no variant to compare with")
    return compare([*result.compared, (CURRENT, result)]), {}
