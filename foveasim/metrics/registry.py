"""
Metrics of shots: scalar results by name, with title, unit and direction.

Sweeps, studies, requirements, goal seek, comparisons and the studio use the same metrics.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np

from foveasim._core.calls.docstrings import Docstring
from foveasim._core.registry import Registry
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, check_choice, title_and_unit
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import SimulationError
from foveasim.fields import PowerMap
from foveasim.layout import DesignRules, Layout
from foveasim.scene import Scene

__all__ = [
    "METRICS",
    "Metric",
    "MetricInfo",
    "MetricShot",
    "Region",
    "metric_info",
    "number_of",
    "options_of",
    "sites_of",
]


class MetricShot(Protocol):
    """Scene, camera, exposure and rules of a shot: :class:`foveasim.config.Shot`."""

    @property
    def scene(self) -> Scene | PowerMap:
        """Scene, or the power map in its place."""

    @property
    def camera(self) -> Camera:
        """Camera of the capture."""

    @property
    def exposure_s(self) -> float:
        """Exposure time, s."""

    @property
    def rules(self) -> DesignRules | None:
        """Rules that the layout is designed for."""


class Region(Protocol):
    """Photosites of a result, at most one of the three: :class:`foveasim.config.RegionResult`."""

    @property
    def annulus_um(self) -> tuple[float, float] | None:
        """Distances of the centroids from the centre of the layout's bounding box."""

    @property
    def rectangle_um(self) -> tuple[float, float, float, float] | None:
        """Rectangle (x0, y0, x1, y1) that contains the centroids."""

    @property
    def site(self) -> int | None:
        """Index of one photosite."""

    @property
    def subject(self) -> str:
        """The result in words, for messages."""


#: Function of a shot, its camera and its capture that returns a number, a mapping of names to numbers, or a labelled array.
#: It can be computed for a region if it has one of the optional parameters ``sites`` (indices of photosites) or ``region``.
Metric = Callable[..., Any]


@dataclass(frozen=True, kw_only=True)
class MetricInfo:
    """
    Facts about a metric, for tables, figures and pages.

    Attributes
    ----------
    title : str
        By default the name without its unit.
    unit : str
        By default that of the name's suffix, such as ``_dn``.
    definition : str
        By default the first line of the function's docstring.
    better : {"high", "low"}, optional
        Which values are better; None for neither, as of the mean code.
    has_scene : bool
        Whether the metric depends on the scene, or on the layout and the lens alone.
    is_logarithmic : bool
        Whether axes are logarithmic.
    headline : str
        Key of the number that represents a metric of several numbers where one is required.
    is_number : bool
        Whether the metric is one number, or has a headline.
    jumps_to_zero : bool
        Whether 0 means that there is no result, as the signal-to-noise ratio of saturated sites.
    is_of_signals : bool
        Whether saturated photosites contribute clipped signals, or none, so that their fraction belongs beside the result.
    reference : function of a shot and its camera, optional
        Computes the argument ``reference`` of the metric. It may depend only on the photoelectron rates of an ideal raster,
        the exposure time and the bit depth, because captures share the result.

    Examples
    --------
    >>> import foveasim as fs
    >>> info = fs.metrics.metric_info("saturated_fraction")
    >>> info.title, info.better
    ('saturated photosites', 'low')
    """

    title: str = ""
    unit: str = ""
    definition: str = ""
    better: Literal["high", "low"] | None = None
    has_scene: bool = True
    is_logarithmic: bool = False
    headline: str = ""
    is_number: bool = True
    jumps_to_zero: bool = False
    is_of_signals: bool = False
    reference: Callable[..., Any] | None = None

    __repr__ = short_repr


#: Metrics by name, for sweeps, studies, requirements, goal seek, comparisons and the studio. Facts are registered with
#: ``@METRICS.register(name, info=MetricInfo(...))``, and have defaults. Installed packages add metrics as entry points of the
#: group ``foveasim.metrics``.
METRICS: Registry[Metric] = Registry(
    "metric", "foveasim.metrics", modules=("foveasim.compare.metrics", "foveasim.explore.requirements")
)


def metric_info(name: str) -> MetricInfo:
    """
    Return the facts about a metric.

    Raises ParameterError when no metric has this name.
    """
    function = METRICS.find("metric", name)
    found: MetricInfo = METRICS.info(name) or MetricInfo()
    title, unit = title_and_unit(name, found.title, found.unit)
    summary = Docstring.of(function).summary
    return replace(
        found,
        title=title,
        unit=unit,
        definition=found.definition or summary.removeprefix("Return ").removesuffix("."),
    )


def options_of(metric: Metric) -> tuple[str, ...]:
    """Return the names of the parameters of a metric after shot, camera and capture."""
    return tuple(inspect.signature(metric).parameters)[3:]


def has_region(name: str) -> bool:
    """Return whether a metric can be computed for some of the photosites."""
    return not {"sites", "region"}.isdisjoint(options_of(METRICS.find("metric", name)))


def number_of(
    name: str,
    shot: MetricShot,
    camera: Camera,
    capture: Capture,
    *,
    sites: Ints | None = None,
    region: Region | None = None,
    frequency_per_mm: float | None = None,
) -> float:
    """
    Return a metric as one number.

    Raises ParameterError when no metric has this name, and SimulationError when it returns no number.
    """
    function = METRICS.find("metric", name)
    given = {"sites": sites, "region": region, "frequency_per_mm": frequency_per_mm}
    options = {option: given[option] for option in options_of(function) if given.get(option) is not None}
    found = function(shot, camera, capture, **options)
    if isinstance(found, Mapping):
        headline = metric_info(name).headline
        if headline not in found:
            raise SimulationError(
                f"the metric '{name}' has several numbers, {', '.join(map(str, found))}; register one as the headline of its "
                "MetricInfo"
            )
        found = found[headline]
    try:
        return float(found)
    except (TypeError, ValueError):
        raise SimulationError(f"the metric '{name}' must return one number, got {type(found).__name__}") from None


def sites_of(region: Region, layout: Layout) -> Ints:
    """Return the indices of the photosites in a region, at least one."""
    found = np.arange(layout.n_sites)
    if region.site is not None:
        if region.site >= layout.n_sites:
            raise SimulationError(f"{region.subject}: the layout has only {layout.n_sites:,} photosites")
        found = np.array([region.site])
    elif region.annulus_um is not None:
        radius_um = np.hypot(*(layout.centroid_um - centre_um_of(layout)).T)
        found = np.flatnonzero((radius_um >= region.annulus_um[0]) & (radius_um < region.annulus_um[1]))
    elif region.rectangle_um is not None:
        x0, y0, x1, y1 = region.rectangle_um
        x, y = layout.centroid_um.T
        found = np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
    if not found.size:
        raise SimulationError(f"{region.subject}: the region contains no photosite")
    return found


def centre_um_of(layout: Layout) -> Floats:
    """Return the centre of the bounding box, (x, y) µm."""
    x0, y0, x1, y1 = layout.bounds_um
    return np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])


def check_number_name(parameter: str, name: object) -> str:
    """Return the name of a metric that is one number, or raise a ParameterError."""
    return check_choice(parameter, name, [each for each in METRICS if metric_info(each).is_number])
