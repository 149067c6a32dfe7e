"""Metric of the signal-to-noise ratio."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Bools, Floats
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.explore._metrics import METRICS
from foveasim.sensor import signal_to_noise

__all__ = ["signal_to_noise_of", "snr"]


def signal_to_noise_of(shot: Shot, camera: Camera, capture: Capture) -> tuple[Floats, Bools]:
    """Return the ratio of signal to temporal noise of each site, and whether it is saturated."""
    sensor = camera.sensor
    dark_e = sensor.expected_electrons(np.zeros(sensor.layout.n_sites), shot.exposure_s)
    found = signal_to_noise(sensor, capture.expected_e, dark_e, exposure_s=shot.exposure_s)
    return found.ratio, found.is_saturated


@METRICS.register("snr")
def snr(shot: Shot, camera: Camera, capture: Capture) -> dict[str, float]:
    """
    Compute the mean and median signal-to-noise ratio of the sites analytically.

    The ratio is that of :func:`foveasim.sensor.signal_to_noise`: signal over temporal noise. Saturated sites are excluded; the
    result is NaN when all sites are saturated.
    """
    all_ratios, is_saturated = signal_to_noise_of(shot, camera, capture)
    ratio = all_ratios[~is_saturated]
    if not ratio.size:
        return {"mean": float("nan"), "median": float("nan")}
    return {"mean": float(ratio.mean()), "median": float(np.median(ratio))}
