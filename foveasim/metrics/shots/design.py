"""Metrics of the design: photosites, design rules, readout and exposure."""

from __future__ import annotations

from foveasim._core.validation import Ints
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import SimulationError
from foveasim.layout import Readout
from foveasim.metrics.registry import METRICS, MetricInfo, MetricShot

__all__ = ["data_rate_gbit_per_s", "exposure_s", "n_sites", "smallest_size_um", "violations"]


@METRICS.register("n_sites", info=MetricInfo(title="photosites", better="low", has_scene=False))
def n_sites(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> int:  # noqa: ARG001
    """Return the number of photosites of the layout."""
    return capture.layout.n_sites if sites is None else sites.size


@METRICS.register(
    "data_rate_gbit_per_s", info=MetricInfo(title="data rate", unit="Gbit/s", better="low", has_scene=False)
)
def data_rate_gbit_per_s(shot: MetricShot, camera: Camera, capture: Capture) -> float:
    """
    Return the data rate of one lane, Gbit/s.

    The readout of the design rules determines the rate. Without a readout, one frame per exposure time is assumed.
    """
    if shot.rules is not None and shot.rules.readout is not None:
        readout = shot.rules.readout
    else:
        readout = Readout(frames_per_s=1.0 / shot.exposure_s, bits=camera.sensor.bits)
    return readout.gbit_per_s(capture.layout.n_sites)


@METRICS.register("violations", info=MetricInfo(title="violations of design rules", better="low", has_scene=False))
def violations(shot: MetricShot, camera: Camera, capture: Capture) -> int:  # noqa: ARG001 -- the signature of metrics
    """Return the number of violations of the design rules."""
    if shot.rules is None:
        raise SimulationError("violations of design rules: the layout has no design rules")
    return sum(len(rule) for rule in capture.layout.check(shot.rules).results)


@METRICS.register("smallest_size_um", info=MetricInfo(title="smallest photosite", unit="µm", has_scene=False))
def smallest_size_um(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> float:  # noqa: ARG001
    """Return the size of the smallest photosite, µm."""
    size_um = capture.layout.size_um
    return float((size_um if sites is None else size_um[sites]).min())


@METRICS.register("exposure_s", info=MetricInfo(title="exposure", unit="s", better="low"))
def exposure_s(shot: MetricShot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001 -- the signature of metrics
    """Return the exposure time, s."""
    return shot.exposure_s
