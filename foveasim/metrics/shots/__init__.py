"""Metrics of shots, registered in :data:`foveasim.metrics.METRICS`."""

from __future__ import annotations

from foveasim._core.registry import import_all

import_all(__name__, __path__)
