"""
Design rules: limits, measurements, repair, routing and reports.

:mod:`foveasim.layout` has the other public names.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.layout.drc.measurements import RULES, Case, Measurement

__all__ = ["RULES", "Case", "Measurement"]

import_all(__name__, __path__)

publish(__name__)
