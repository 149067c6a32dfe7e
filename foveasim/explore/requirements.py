"""Results of shots and their photosites, as metrics, and the check of requirements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from foveasim._core.short_repr import short_repr
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import RegionResult, Requirement, Shot
from foveasim.metrics.registry import METRICS, MetricInfo, number_of, sites_of

__all__ = ["CheckedRequirement", "ResultMetric", "check_requirements", "result_of"]


@dataclass(frozen=True)
class CheckedRequirement:
    """
    A requirement, and the result that it limits.

    Examples
    --------
    >>> import foveasim as fs
    >>> requirement = fs.config.Requirement(measure="n_sites", at_most=5000.0)
    >>> checked = fs.explore.CheckedRequirement(requirement, 4000.0)
    >>> checked.is_met, checked.margin
    (True, 1000.0)
    """

    requirement: Requirement
    value: float

    __repr__ = short_repr

    @property
    def margin(self) -> float:
        """Distance of the result from the nearest limit; negative or NaN where it is not met."""
        return self.requirement.margin(self.value)

    @property
    def is_met(self) -> bool:
        """Whether the result is within the limits."""
        return self.margin >= 0.0

    def __str__(self) -> str:
        unit = f" {self.requirement.unit}" if self.requirement.unit else ""
        return f"{'met' if self.is_met else 'NOT met'}: {self.requirement}; got {self.value:,.5g}{unit}"


def check_requirements(shot: Shot, capture: Capture) -> list[CheckedRequirement]:
    """
    Check the requirements of a shot.

    Parameters
    ----------
    shot : Shot
        With the requirements of its settings.
    capture : Capture
        Of the shot.

    Raises
    ------
    SimulationError
        When a region contains no photosite, or a result does not exist for the scene.

    Examples
    --------
    >>> import foveasim as fs
    >>> settings = {
    ...     "scene": {
    ...         "kind": "flat",
    ...         "shape": [60, 60],
    ...         "pitch_um": 300.0,
    ...         "distance_m": 1.0,
    ...         "illuminance_lux": 500.0,
    ...     },
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {
    ...         "generator": "grid",
    ...         "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0},
    ...     },
    ...     "sensor": {"preset": "machine_vision"},
    ...     "exposure_s": 0.002,
    ...     "requirements": [
    ...         {"measure": "snr", "at_least": 20},
    ...         {"measure": "n_sites", "at_most": 200},
    ...     ],
    ... }
    >>> shot = fs.config.build_shot(None, settings)
    >>> capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=0)
    >>> [checked.is_met for checked in fs.explore.check_requirements(shot, capture)]
    [True, False]
    """
    return [CheckedRequirement(requirement, result_of(requirement, shot, capture)) for requirement in shot.requirements]


def result_of(result: RegionResult, shot: Shot, capture: Capture) -> float:
    """
    Return the value of a result, such as that of a requirement.

    Raises SimulationError when its region contains no photosite, or the result does not exist for the scene.

    Examples
    --------
    >>> import foveasim as fs
    >>> shot = fs.config.read_shot(fs.config.demo_settings()[0])
    >>> capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=0)
    >>> round(
    ...     fs.explore.result_of(
    ...         fs.config.RegionResult(measure="smallest_size_um"), shot, capture
    ...     ),
    ...     1,
    ... )
    6.0
    """
    region = result if result.has_region else None
    return number_of(
        result.measure,
        shot,
        shot.camera,
        capture,
        sites=None if region is None else sites_of(region, capture.layout),
        region=region,
        frequency_per_mm=result.frequency_per_mm,
    )


@dataclass(frozen=True)
class ResultMetric:
    """
    Metric of a result, of all photosites or of some.

    Examples
    --------
    >>> import foveasim as fs
    >>> fovea = fs.explore.ResultMetric(
    ...     fs.config.RegionResult(measure="snr", annulus_um=(0.0, 200.0))
    ... )
    >>> shot = fs.config.demo_settings()[0]
    >>> found = fs.explore.sweep(
    ...     shot, {"exposure_s": [0.01, 0.02]}, metrics={"fovea_snr": fovea}, workers=0
    ... )
    >>> found["fovea_snr"].shape
    (2,)
    """

    result: RegionResult

    __repr__ = short_repr

    def __call__(self, shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG002 -- the signature of metrics
        """Return the value of the result."""
        return result_of(self.result, shot, capture)


@METRICS.register("requirements", info=MetricInfo(title="requirements", is_number=False))
def requirements(shot: Shot, camera: Camera, capture: Capture) -> dict[str, Any]:  # noqa: ARG001 -- the signature of metrics
    """
    Return whether all requirements of the shot are met, 1 or 0, and the margin of each.

    Margins have the number of the requirement, from 1.
    """
    found = check_requirements(shot, capture)
    margins = {f"margin_{k}": checked.margin for k, checked in enumerate(found, 1)}
    return {"are_met": float(all(checked.is_met for checked in found)), **margins}
