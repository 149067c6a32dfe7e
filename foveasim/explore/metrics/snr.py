"""Metric of the signal-to-noise ratio."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Floats
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.explore._metrics import METRICS
from foveasim.sensor import signal_to_noise

__all__ = ["signal_to_noise_of", "snr"]


def signal_to_noise_of(shot: Shot, camera: Camera, capture: Capture) -> Floats:
    """Return the ratio of signal to temporal noise of each site; 0 for saturated ones."""
    sensor = camera.sensor
    dark_e = sensor.expected_electrons(np.zeros(sensor.layout.n_sites), shot.exposure_s)
    return signal_to_noise(sensor, capture.expected_e, dark_e, exposure_s=shot.exposure_s).unsaturated_ratio


@METRICS.register("snr")
def snr(shot: Shot, camera: Camera, capture: Capture) -> dict[str, float]:
    """
    Compute the mean and median signal-to-noise ratio of the sites analytically.

    The ratio is that of :func:`foveasim.sensor.signal_to_noise`: signal over temporal noise. That of a saturated site is 0.
    """
    ratio = signal_to_noise_of(shot, camera, capture)
    return {"mean": float(ratio.mean()), "median": float(np.median(ratio))}
