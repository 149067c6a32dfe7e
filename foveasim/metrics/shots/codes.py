"""Metrics of the codes of a capture."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Ints
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.metrics.registry import METRICS, MetricInfo, MetricShot

__all__ = ["mean_code_dn", "saturated_fraction"]


@METRICS.register("mean_code_dn", info=MetricInfo(title="mean code", unit="DN", is_of_signals=True))
def mean_code_dn(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> float:  # noqa: ARG001
    """Return the mean code, DN."""
    return float(np.mean(capture.code if sites is None else capture.code[sites]))


@METRICS.register("saturated_fraction", info=MetricInfo(title="saturated photosites", unit="fraction", better="low"))
def saturated_fraction(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> float:  # noqa: ARG001
    """Return the fraction of sites with the highest code."""
    return capture.saturated_fraction if sites is None else float(np.mean(capture.code[sites] == 2**capture.bits - 1))
