"""Metrics of the codes of a capture."""

from __future__ import annotations

import numpy as np

from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.explore._metrics import METRICS

__all__ = ["mean_code_dn", "saturated_fraction"]


@METRICS.register("mean_code_dn")
def mean_code_dn(shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001 -- the signature of metrics
    """Return the mean code, DN."""
    return float(np.mean(capture.code))


@METRICS.register("saturated_fraction")
def saturated_fraction(shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001
    """Return the fraction of sites with the highest code."""
    return capture.saturated_fraction
