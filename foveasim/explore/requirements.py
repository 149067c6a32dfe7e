"""Results of shots and their photosites, as metrics, and the check of requirements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import RegionResult, Requirement, Shot
from foveasim.errors import SimulationError
from foveasim.explore._metrics import METRICS
from foveasim.explore.metrics.psnr import PSNR_PIXELS, picture_psnr_db
from foveasim.explore.metrics.readout import data_rate_gbit_per_s
from foveasim.explore.metrics.snr import signal_to_noise_of
from foveasim.fields import Grid
from foveasim.layout import Layout
from foveasim.metrics import polygon_mtf, psnr_db
from foveasim.scene import Scene

__all__ = ["CheckedRequirement", "ResultMetric", "check_requirements", "measure"]

#: A function of a shot, its capture, a result and the sites of its region.
_Measure = Callable[[Shot, Capture, RegionResult, NDArray[np.intp]], float]
_FUNCTIONS: dict[str, _Measure] = {}


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
    ...     "scene": {"kind": "flat", "shape": [60, 60], "pitch_um": 300.0, "distance_m": 1.0, "illuminance_lux": 500.0},
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": {"generator": "grid", "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0}},
    ...     "sensor": {"preset": "machine_vision"},
    ...     "exposure_s": 0.002,
    ...     "requirements": [{"measure": "snr", "at_least": 20}, {"measure": "n_sites", "at_most": 200}],
    ... }
    >>> shot = fs.config.build_shot(None, settings)
    >>> capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=0)
    >>> [checked.is_met for checked in fs.explore.check_requirements(shot, capture)]
    [True, False]
    """
    return [CheckedRequirement(requirement, measure(requirement, shot, capture)) for requirement in shot.requirements]


def measure(result: RegionResult, shot: Shot, capture: Capture) -> float:
    """
    Return the value of a result, such as that of a requirement.

    Raises SimulationError when its region contains no photosite, or the result does not exist for the scene.

    Examples
    --------
    >>> import foveasim as fs
    >>> shot = fs.config.read_shot(fs.config.demo_settings()[0])
    >>> capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=0)
    >>> round(fs.explore.measure(fs.config.RegionResult(measure="smallest_size_um"), shot, capture), 1)
    6.0
    """
    sites = sites_of(result, capture.layout)
    if not sites.size:
        raise SimulationError(f"{result.subject}: the region contains no photosite")
    return float(_FUNCTIONS[result.measure](shot, capture, result, sites))


@dataclass(frozen=True)
class ResultMetric:
    """
    Metric of a result, of all photosites or of some.

    Examples
    --------
    >>> import foveasim as fs
    >>> fovea = fs.explore.ResultMetric(fs.config.RegionResult(measure="snr", annulus_um=(0.0, 200.0)))
    >>> shot = fs.config.demo_settings()[0]
    >>> found = fs.explore.sweep(shot, {"exposure_s": [0.01, 0.02]}, metrics={"fovea_snr": fovea}, workers=0)
    >>> found["fovea_snr"].shape
    (2,)
    """

    result: RegionResult

    __repr__ = short_repr

    def __call__(self, shot: Shot, camera: Camera, capture: Capture) -> float:  # noqa: ARG002 -- the signature of metrics
        """Return the value of the result."""
        return measure(self.result, shot, capture)


def sites_of(result: RegionResult, layout: Layout) -> NDArray[np.intp]:
    """Return the indices of the photosites in the region of a result."""
    if result.site is not None:
        if result.site >= layout.n_sites:
            raise SimulationError(f"{result.subject}: the layout has only {layout.n_sites:,} photosites")
        return np.array([result.site])
    if result.annulus_um is not None:
        radius_um = np.hypot(*(layout.centroid_um - centre_um_of(layout)).T)
        return np.flatnonzero((radius_um >= result.annulus_um[0]) & (radius_um < result.annulus_um[1]))
    if result.rectangle_um is not None:
        x0, y0, x1, y1 = result.rectangle_um
        x, y = layout.centroid_um.T
        return np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
    return np.arange(layout.n_sites)


def centre_um_of(layout: Layout) -> NDArray[np.float64]:
    """Return the centre of the bounding box, (x, y) µm."""
    x0, y0, x1, y1 = layout.bounds_um
    return np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])


def _function(name: str) -> Callable[[_Measure], _Measure]:
    def register(function: _Measure) -> _Measure:
        _FUNCTIONS[name] = function
        return function

    return register


@_function("snr")
def _snr(shot: Shot, capture: Capture, _result: RegionResult, sites: NDArray[np.intp]) -> float:
    return float(np.median(signal_to_noise_of(shot, shot.camera, capture)[sites]))


@_function("snr_db")
def _snr_db(shot: Shot, capture: Capture, result: RegionResult, sites: NDArray[np.intp]) -> float:
    ratio = _snr(shot, capture, result, sites)
    return 20.0 * float(np.log10(ratio)) if ratio > 0.0 else float("-inf" if ratio == 0.0 else "nan")


@_function("n_sites")
def _n_sites(_shot: Shot, _capture: Capture, _result: RegionResult, sites: NDArray[np.intp]) -> float:
    return sites.size


@_function("saturated_fraction")
def _saturated(_shot: Shot, capture: Capture, _result: RegionResult, sites: NDArray[np.intp]) -> float:
    return float(np.mean(capture.code[sites] == 2**capture.bits - 1))


@_function("mean_code_dn")
def _mean_code(_shot: Shot, capture: Capture, _result: RegionResult, sites: NDArray[np.intp]) -> float:
    return float(np.mean(capture.code[sites]))


@_function("mtf")
def _mtf(shot: Shot, capture: Capture, result: RegionResult, sites: NDArray[np.intp]) -> float:
    assert result.frequency_per_mm is not None
    layout, scene = capture.layout, shot.scene
    median = sites[np.argsort(layout.area_um2[sites], kind="stable")[sites.size // 2]]
    per_mm = np.array([result.frequency_per_mm])
    found = float(polygon_mtf(layout[np.array([median])], per_mm)[0, 0])
    if isinstance(scene, Scene):
        wavelength_nm = float(np.median(scene.wavelength_nm))
        found *= float(shot.camera.optics.mtf(per_mm, wavelength_nm=wavelength_nm, distance_m=scene.distance_m)[0])
    return found


@_function("psnr_db")
def _psnr(shot: Shot, capture: Capture, result: RegionResult, _sites: NDArray[np.intp]) -> float:
    if result.site is not None:
        raise SimulationError(f"{result.subject}: a picture quality needs an annulus or a rectangle")
    camera = shot.camera
    if result.annulus_um is None and result.rectangle_um is None:
        return picture_psnr_db(shot, camera, capture)
    if result.rectangle_um is not None:
        x0, y0, x1, y1 = result.rectangle_um
    else:
        assert result.annulus_um is not None
        x, y = centre_um_of(capture.layout)
        outer_um = result.annulus_um[1]
        x0, y0, x1, y1 = x - outer_um, y - outer_um, x + outer_um, y + outer_um
    pitch_um = max(x1 - x0, y1 - y0) / PSNR_PIXELS
    shape = (max(1, round((y1 - y0) / pitch_um)), max(1, round((x1 - x0) / pitch_um)))
    grid = Grid(shape, ((x1 - x0) / shape[1], (y1 - y0) / shape[0]), (x0, y0))
    reference = camera.reference(shot.scene, grid, exposure_s=shot.exposure_s)
    picture = capture.picture(of="light_e", per="um2", grid=grid, sensor=camera.sensor)
    if result.annulus_um is not None:
        x_um, y_um = (origin + (np.arange(n) + 0.5) * step for origin, n, step in (
            (x0, shape[1], grid.pitch_x_um), (y0, shape[0], grid.pitch_y_um)
        ))  # fmt: skip
        centre = centre_um_of(capture.layout)
        radius_um = np.hypot(x_um - centre[0], (y_um - centre[1])[:, None])
        inner, outer = result.annulus_um
        picture = replace(picture, data=np.where((radius_um >= inner) & (radius_um < outer), picture.data, np.nan))
    return psnr_db(picture, reference)


@_function("data_rate_gbit_per_s")
def _data_rate(shot: Shot, capture: Capture, _result: RegionResult, _sites: NDArray[np.intp]) -> float:
    return data_rate_gbit_per_s(shot, shot.camera, capture)


@_function("violations")
def _violations(shot: Shot, capture: Capture, result: RegionResult, _sites: NDArray[np.intp]) -> float:
    if shot.rules is None:
        raise SimulationError(f"{result.subject}: the layout has no design rules")
    return sum(len(rule) for rule in capture.layout.check(shot.rules).results)


@_function("smallest_size_um")
def _smallest(_shot: Shot, capture: Capture, _result: RegionResult, sites: NDArray[np.intp]) -> float:
    return float(capture.layout.size_um[sites].min())


@_function("exposure_s")
def _exposure(shot: Shot, _capture: Capture, _result: RegionResult, _sites: NDArray[np.intp]) -> float:
    return shot.exposure_s


@METRICS.register("requirements")
def requirements(shot: Shot, camera: Camera, capture: Capture) -> dict[str, Any]:  # noqa: ARG001 -- the signature of metrics
    """
    Return whether all requirements of the shot are met, 1 or 0, and the margin of each.

    Margins have the number of the requirement, from 1.
    """
    found = check_requirements(shot, capture)
    margins = {f"margin_{k}": checked.margin for k, checked in enumerate(found, 1)}
    return {"are_met": float(all(checked.is_met for checked in found)), **margins}
