"""Metrics of sweeps and studies, registered in :data:`foveasim.explore.METRICS`."""

from __future__ import annotations

from foveasim._core.registry import import_all

import_all(__name__, __path__)
