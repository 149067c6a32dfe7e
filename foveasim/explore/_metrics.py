"""Registered metrics of a capture, and the lookup of metrics by name or function."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.names import possible_names
from foveasim._core.registry import Registry
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.errors import ParameterError
from foveasim.layout import Readout
from foveasim.metrics import psnr_db
from foveasim.reconstruct import Picture, raster_grid
from foveasim.sensor import signal_to_noise

#: A function of a shot, its camera and its capture that returns a number, a mapping of names to numbers, or a labelled array.
Metric = Callable[[Shot, Camera, Capture], Any]

#: Metrics by name. Installed packages add metrics as entry points of the group ``foveasim.metrics``.
METRICS: Registry[Metric] = Registry("metric", "foveasim.metrics")
#: Side of the compared pictures, pixels.
PSNR_PIXELS = 256
#: Variables and dimensions of results that are not metrics.
RESERVED = ("seed", "error", "warning", "point", "repeat")
#: Hint for functions that are not registered.
OTHER_METRICS = "pass other functions in Python, or with --metric module:function"
#: Default metrics of a sweep.
DEFAULT_METRICS = ("mean_code_dn", "saturated_fraction", "snr", "n_sites")


@METRICS.register("mean_code_dn")
def mean_code_dn(shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001 -- the signature of metrics
    """Return the mean code, DN."""
    return float(np.mean(capture.code))


@METRICS.register("saturated_fraction")
def saturated_fraction(shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001
    """Return the fraction of sites with the highest code."""
    return capture.saturated_fraction


@METRICS.register("snr")
def snr(shot: Shot, camera: Camera, capture: Capture) -> dict[str, float]:
    """
    Compute the mean and median signal-to-noise ratio of the sites analytically.

    The ratio is that of :func:`foveasim.sensor.signal_to_noise`: signal over temporal noise. Saturated sites are excluded; the
    result is NaN when all sites are saturated.
    """
    sensor = camera.sensor
    dark_e = sensor.expected_electrons(np.zeros(sensor.layout.n_sites), shot.exposure_s)
    found = signal_to_noise(sensor, capture.expected_e, dark_e)
    ratio = found.ratio[~found.is_saturated]
    if not ratio.size:
        return {"mean": float("nan"), "median": float("nan")}
    return {"mean": float(ratio.mean()), "median": float(np.median(ratio))}


@METRICS.register("n_sites")
def n_sites(shot: Shot, camera: Camera, capture: Capture) -> int:  # noqa: ARG001
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


def ideal_picture(shot: Shot, camera: Camera) -> Picture:
    """Return the noise-free picture of an ideal sensor for a scene, layout and exposure."""
    grid = raster_grid(camera.sensor.layout, PSNR_PIXELS)
    return camera.reference(shot.scene, grid, exposure_s=shot.exposure_s)


@METRICS.register("psnr_db")
def picture_psnr_db(shot: Shot, camera: Camera, capture: Capture, reference: Picture | None = None) -> float:
    """
    Compute the PSNR of the reconstructed picture against the ideal picture, dB.

    Both are rasters of photoelectrons per µm²; the reference is that of :func:`ideal_picture`.
    """
    reference = ideal_picture(shot, camera) if reference is None else reference
    picture = capture.picture(of="light_e", per="um2", grid=reference.grid, sensor=camera.sensor)
    return psnr_db(picture, reference)


#: Functions that compute the reference of a metric. It depends on the photoelectron rates of an ideal raster, exposure time and
#: bit depth only, so captures share it.
REFERENCES: dict[Callable[..., Any], Callable[[Shot, Camera], Any]] = {picture_psnr_db: ideal_picture}


def import_metric(name: str) -> Metric:
    """
    Import the function that ``"module:function"`` names, for the command line.

    The import runs the code of the module. The current directory is searched too.

    Raises
    ------
    ParameterError
        When the module cannot be imported or has no such function.
    """
    module, _, function = name.partition(":")
    directory = str(Path.cwd())
    if directory not in sys.path:
        sys.path.insert(0, directory)
    try:
        found = getattr(importlib.import_module(module), function)
    except Exception as error:  # noqa: BLE001 -- a module may raise anything while it is imported
        raise ParameterError("metric", f"must be module:function of an importable module ({error})", name) from None
    if not callable(found):
        raise ParameterError("metric", "must name a function", name)
    metric: Metric = found
    return metric


def resolve_metrics(metrics: Iterable[str | Metric] | Mapping[str, Metric] | None) -> dict[str, Metric]:
    """
    Return metrics by the names of their results.

    Raises ParameterError when a name is not in :data:`METRICS` or occurs twice, or a metric is not a function.
    """
    if metrics is None:
        metrics = DEFAULT_METRICS
    if isinstance(metrics, str) or callable(metrics):
        metrics = (metrics,)
    if isinstance(metrics, Mapping):
        pairs = list(metrics.items())
    else:
        pairs = [
            (metric, METRICS.get(metric)) if isinstance(metric, str) else (getattr(metric, "__name__", ""), metric)
            for metric in metrics
        ]
    found: dict[str, Metric] = {}
    for name, metric in pairs:
        if metric is None:
            raise ParameterError(
                "metrics",
                "must be names of metrics",
                name,
                hint=f"{possible_names(name, sorted(METRICS))}; {OTHER_METRICS}",
            )
        if not callable(metric):
            raise ParameterError("metrics", "must be names of metrics or functions", metric)
        if not isinstance(name, str) or not name.isidentifier():
            raise ParameterError("metrics", "must have names that are identifiers (use a mapping of names)", name)
        if name in RESERVED:
            raise ParameterError("metrics", f"must not have the reserved name '{name}'")
        if name in found:
            raise ParameterError("metrics", "must have unique names", name)
        found[name] = metric
    if not found:
        raise ParameterError("metrics", "must contain at least one metric")
    return found


def add_metrics(metrics: Mapping[str, Metric], names: Iterable[str]) -> dict[str, Metric]:
    """
    Return the metrics of a file and those of the command line.

    ``metrics``: metrics of the file. ``names``: names in :data:`METRICS`, or ``module:function``. The import of a module runs
    its code. Raises ParameterError when a metric does not exist, or its name is already used.
    """
    found = dict(metrics)
    for name in names:
        for own, metric in resolve_metrics([import_metric(name) if ":" in name else name]).items():
            if own in found:
                raise ParameterError("metric", "must have a unique name; another metric has this name", own)
            found[own] = metric
    return found


def has_result(metric: str, result: str) -> bool:
    """Return whether a result name is that of a metric, or of an item of its mapping."""
    return result == metric or result.startswith(metric + "_")
