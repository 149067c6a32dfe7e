"""Spectral curves (quantum efficiency, filter transmission) and sets of colour filters."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.sensor.spectral.curves import CURVES

__all__ = ["CURVES"]

import_all(__name__, __path__)

publish(__name__)
