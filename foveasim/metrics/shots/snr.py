"""Metrics of the signal-to-noise ratio."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Floats, Ints
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.metrics.registry import METRICS, MetricInfo, MetricShot
from foveasim.sensor import signal_to_noise

__all__ = ["signal_to_noise_of", "snr", "snr_db", "snr_mean_db"]


def signal_to_noise_of(shot: MetricShot, camera: Camera, capture: Capture) -> Floats:
    """Return the ratio of signal to temporal noise of each site; 0 for saturated ones."""
    sensor = camera.sensor
    dark_e = sensor.expected_electrons(np.zeros(sensor.layout.n_sites), shot.exposure_s)
    return signal_to_noise(sensor, capture.expected_e, dark_e, exposure_s=shot.exposure_s).unsaturated_ratio


@METRICS.register(
    "snr",
    info=MetricInfo(
        better="high", title="signal-to-noise ratio", headline="median", jumps_to_zero=True, is_of_signals=True
    ),
)
def snr(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> dict[str, float]:
    """
    Compute the mean and median signal-to-noise ratio of the sites analytically.

    The ratio is that of :func:`foveasim.sensor.signal_to_noise`: signal over temporal noise. That of a saturated site is 0.
    """
    ratio = signal_to_noise_of(shot, camera, capture)
    ratio = ratio if sites is None else ratio[sites]
    return {"mean": float(ratio.mean()), "median": float(np.median(ratio))}


@METRICS.register(
    "snr_db", info=MetricInfo(better="high", title="signal-to-noise ratio", unit="dB", is_of_signals=True)
)
def snr_db(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> float:
    """Return the median signal-to-noise ratio, dB."""
    return _db(snr(shot, camera, capture, sites)["median"])


@METRICS.register(
    "snr_mean_db",
    info=MetricInfo(
        better="high",
        title="SNR per site",
        unit="dB",
        definition="signal-to-noise ratio of a site, 0 if it is saturated, mean over the sites, 20 log₁₀",
        is_of_signals=True,
    ),
)
def snr_mean_db(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> float:
    """Return the mean signal-to-noise ratio, dB."""
    return _db(snr(shot, camera, capture, sites)["mean"])


def _db(ratio: float) -> float:
    return 20.0 * float(np.log10(ratio)) if ratio > 0.0 else float("-inf" if ratio == 0.0 else "nan")
