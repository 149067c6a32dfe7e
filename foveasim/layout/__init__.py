"""Photosites: the layout model, generators (one file a family), colour filters, design rules."""

from __future__ import annotations

from foveasim.layout._model import Layout
from foveasim.layout.channels import mosaic
from foveasim.layout.grid import grid
from foveasim.layout.hexagonal import hexagonal
from foveasim.layout.log_polar import log_polar, square_ring_ratio
from foveasim.layout.rules import DesignRules, Report, RuleResult, Violation, min_width_um
from foveasim.layout.zones import zones

__all__ = [
    "DesignRules",
    "Layout",
    "Report",
    "RuleResult",
    "Violation",
    "grid",
    "hexagonal",
    "log_polar",
    "min_width_um",
    "mosaic",
    "square_ring_ratio",
    "zones",
]
