"""Design rules: limits, measurements, repair, routing and reports."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.layout.drc.measurements import RULES, Case, Measurement, Rule
from foveasim.layout.drc.presets import PRESETS, Preset
from foveasim.layout.drc.repair import Change, enforce
from foveasim.layout.drc.routing import Readout, Routing, track_demand
from foveasim.layout.drc.rules import DesignRules, Report, RuleResult, Violation, check, min_width_um

__all__ = [
    "PRESETS",
    "RULES",
    "Case",
    "Change",
    "DesignRules",
    "Measurement",
    "Preset",
    "Readout",
    "Report",
    "Routing",
    "Rule",
    "RuleResult",
    "Violation",
    "check",
    "enforce",
    "min_width_um",
    "track_demand",
]

import_all(__name__, __path__)

publish(__name__)
