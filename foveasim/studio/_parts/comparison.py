"""Comparison of the frozen variant A and the current variant B."""

from __future__ import annotations

from foveasim.errors import SimulationError
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, part
from foveasim.studio._variants import compare

__all__ = ["comparison"]


@part("A and B", lambda result: (result.capture, result.frozen and result.frozen.capture))
def comparison(result: Simulated) -> PartData:
    """Return budgets and picture quality of the frozen variant and the current one."""
    if result.frozen is None:
        raise SimulationError("there is no variant A to compare with")
    return compare(result.frozen, result), {}
