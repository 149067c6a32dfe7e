"""Metrics of the readout: number of photosites and data rate."""

from __future__ import annotations

from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.explore._metrics import METRICS
from foveasim.layout import Readout

__all__ = ["data_rate_gbit_per_s", "n_sites"]


@METRICS.register("n_sites")
def n_sites(shot: Shot, camera: Camera, capture: Capture) -> int:  # noqa: ARG001 -- the signature of metrics
    """Return the number of photosites of the layout."""
    return capture.layout.n_sites


@METRICS.register("data_rate_gbit_per_s")
def data_rate_gbit_per_s(shot: Shot, camera: Camera, capture: Capture) -> float:
    """
    Return the data rate of one lane, Gbit/s.

    The readout of the design rules determines the rate. Without a readout, one frame per exposure time is assumed.
    """
    if shot.rules is not None and shot.rules.readout is not None:
        readout = shot.rules.readout
    else:
        readout = Readout(frames_per_s=1.0 / shot.exposure_s, bits=camera.sensor.bits)
    return readout.gbit_per_s(capture.layout.n_sites)
