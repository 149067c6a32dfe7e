"""What a point of a sweep is worth, in numbers: metrics by name, and any function of a shot, its camera and its capture."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.registry import Registry
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.errors import ParameterError
from foveasim.layout import Readout
from foveasim.metrics import psnr_db
from foveasim.reconstruct import Picture, raster_grid
from foveasim.sensor import signal_to_noise

__all__ = [
    "DEFAULT_METRICS",
    "METRICS",
    "REFERENCES",
    "Metric",
    "gives",
    "metric_of",
    "named_metrics",
    "with_more_metrics",
]

#: A function of a shot, its camera and its capture, which gives a number, a mapping of names to such, or an array with labels.
Metric = Callable[[Shot, Camera, Capture], Any]

#: Metrics by their names. Installed packages add theirs as entry points of the group ``foveasim.metrics``.
METRICS: Registry[Metric] = Registry("metric", "foveasim.metrics")
#: Side of the pictures that are compared.
PSNR_PIXELS = 256
#: Names that results have beside metrics.
RESERVED = ("seed", "error", "warning", "point", "repeat")
#: Metrics of a sweep that names none.
DEFAULT_METRICS = ("mean_code_dn", "saturated_fraction", "snr", "n_sites")


@METRICS.register("mean_code_dn")
def mean_code_dn(shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001 -- the signature of metrics
    """Mean of the codes, DN."""
    return float(np.mean(capture.code))


@METRICS.register("saturated_fraction")
def saturated_fraction(shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG001
    """Fraction of the sites that gave the highest code."""
    return capture.saturated_fraction


@METRICS.register("snr")
def snr(shot: Shot, camera: Camera, capture: Capture) -> dict[str, float]:
    """
    Signal over temporal noise, predicted without a draw: mean and median over the sites.

    The ratio of :func:`foveasim.sensor.signal_to_noise`. Saturated sites are left out; NaN where all are.
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
    """Photosites of the layout."""
    return capture.layout.n_sites


@METRICS.register("data_rate_gbit_per_s")
def data_rate_gbit_per_s(shot: Shot, camera: Camera, capture: Capture) -> float:
    """
    Data rate of one lane, Gbit/s.

    Of the readout in the layout's design rules; without one, of frames without a pause, one an exposure.
    """
    if shot.rules is not None and shot.rules.readout is not None:
        readout = shot.rules.readout
    else:
        readout = Readout(frames_per_s=1.0 / shot.exposure_s, bits=camera.sensor.bits)
    return readout.gbit_per_s(capture.layout.n_sites)


def light_behind_lens(shot: Shot, camera: Camera) -> Picture:
    """What the picture of a perfect sensor would be: of light, layout and exposure alone, and the same for any noise."""
    grid = raster_grid(camera.sensor.layout, PSNR_PIXELS)
    return camera.reference(shot.scene, grid, exposure_s=shot.exposure_s)


@METRICS.register("psnr_db")
def picture_psnr_db(shot: Shot, camera: Camera, capture: Capture, reference: Picture | None = None) -> float:
    """PSNR of the picture of cells, in photoelectrons per µm², against the light behind the lens, dB."""
    reference = light_behind_lens(shot, camera) if reference is None else reference
    picture = capture.picture(of="light_e", per="um2", grid=reference.grid, sensor=camera.sensor)
    return psnr_db(picture, reference)


#: What a metric may be given beside its capture, of light, layout and exposure alone: many captures share it.
REFERENCES: dict[Callable[..., Any], Callable[[Shot, Camera], Any]] = {picture_psnr_db: light_behind_lens}


def metric_of(name: str) -> Metric:
    """
    The function that ``"module:function"`` names, for the command line: it imports the module, and so runs it.

    Raises
    ------
    ParameterError
        When there is no such module or function.
    """
    module, _, function = name.partition(":")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        found = getattr(importlib.import_module(module), function)
    except Exception as error:  # noqa: BLE001 -- whatever a module raises while it is imported
        raise ParameterError(
            "metric", f"must be module:function of a module that can be imported ({error})", name
        ) from None
    if not callable(found):
        raise ParameterError("metric", "must name a function", name)
    metric: Metric = found
    return metric


def named_metrics(metrics: Iterable[str | Metric] | Mapping[str, Metric] | None) -> dict[str, Metric]:
    """
    Metrics by the names that results get.

    Raises
    ------
    ParameterError
        When a name is none of :data:`METRICS`, stands there twice, or a metric is no function.
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
                f"must be of {', '.join(sorted(METRICS))}",
                name,
                hint="functions of your own are given in Python, or with --metric module:function",
            )
        if not callable(metric):
            raise ParameterError("metrics", "must be names or functions", metric)
        if not isinstance(name, str) or not name.isidentifier():
            raise ParameterError("metrics", "must have names that are identifiers: name functions by a mapping", name)
        if name in RESERVED:
            raise ParameterError("metrics", f"must have names that results do not have already, not '{name}'")
        if name in found:
            raise ParameterError("metrics", "must have a name each; there are two of this one", name)
        found[name] = metric
    if not found:
        raise ParameterError("metrics", "must be at least one")
    return found


def with_more_metrics(metrics: Mapping[str, Metric], names: Iterable[str]) -> dict[str, Metric]:
    """
    Metrics of a file, and those that the command line names beside them.

    Parameters
    ----------
    metrics : mapping of str to function
    names : iterable of str
        Names of :data:`METRICS`, or ``module:function``, which is imported and so runs.

    Raises
    ------
    ParameterError
        When there is no such metric, or one of the same name.
    """
    found = dict(metrics)
    for name in names:
        for own, metric in named_metrics([metric_of(name) if ":" in name else name]).items():
            if own in found:
                raise ParameterError("metric", "must have a name of its own; there is one of this name already", own)
            found[own] = metric
    return found


def gives(metric: str, result: str) -> bool:
    """Whether a metric of a name may give a result of a name: its own, or one of the numbers in a mapping that it gives."""
    return result == metric or result.startswith(metric + "_")
