"""Metrics of the resolution of layout and lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Floats, Ints
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.fields import PowerMap
from foveasim.layout import Layout
from foveasim.metrics.pixel_mtf import polygon_mtf
from foveasim.metrics.registry import METRICS, MetricInfo, MetricShot
from foveasim.metrics.sampling import nyquist_per_mm
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.units import per_mm_from_per_um

__all__ = [
    "LensCurve",
    "Wave",
    "aperture_and_lens_mtf50",
    "finite_median",
    "lens_curve",
    "lens_mtf",
    "median_nyquist_per_mm",
    "mtf",
    "mtf50_per_mm",
    "wave_of",
]

#: Sites that represent the aperture MTF of many, and directions of the waves.
MTF_SITES, MTF_ANGLES_DEG = 24, (0.0, 45.0, 90.0, 135.0)
#: Frequencies of the MTF, and the highest one in units of 1 / size of the smallest site.
MTF_FREQUENCIES, MAX_FREQUENCY = 200, 1.5
#: Level of MTF50.
HALF = 0.5


class Wave(NamedTuple):
    """Mean wavelength and distance of a scene, for the MTF of a lens."""

    wavelength_nm: float
    distance_m: float


def wave_of(light: Scene | PowerMap) -> Wave:
    """Return the wave of a scene; that of a power map comes from infinity."""
    distance_m = float(light.distance_m) if isinstance(light, Scene) else math.inf
    return Wave(float(np.mean(light.wavelength_nm)), distance_m)


def lens_mtf(optics: Optics, waves: Sequence[Wave], per_mm: Floats) -> Floats:
    """Return the mean MTF of a lens over waves."""
    found = [optics.mtf(per_mm, wave.wavelength_nm, distance_m=wave.distance_m) for wave in waves]
    return np.asarray(np.mean(found, axis=0))


class LensCurve(NamedTuple):
    """MTF of a lens at frequencies that suit a layout."""

    frequency_per_mm: Floats
    mtf: Floats


def lens_curve(optics: Optics, layout: Layout, waves: Sequence[Wave]) -> LensCurve:
    """Return the mean MTF of a lens at frequencies that suit a layout."""
    highest_per_mm = MAX_FREQUENCY * float(per_mm_from_per_um(1.0 / np.sqrt(layout.area_um2.min())))
    frequency = np.linspace(0.0, highest_per_mm, MTF_FREQUENCIES)
    return LensCurve(frequency, lens_mtf(optics, waves, frequency))


def aperture_and_lens_mtf50(layout: Layout, lens: LensCurve, sites: Ints) -> float:
    """
    Return the frequency at which the MTF of lens and sites is one half, per mm.

    ``sites``: indices, ordered by area. NaN for none.
    """
    if not sites.size:
        return float("nan")
    chosen = sites[np.linspace(0, sites.size - 1, min(MTF_SITES, sites.size)).astype(np.int64)]
    frequency_per_mm = lens.frequency_per_mm
    apertures = [
        polygon_mtf(layout[chosen], frequency_per_mm, angle_deg=angle).mean(axis=0) for angle in MTF_ANGLES_DEG
    ]
    product = lens.mtf * np.mean(apertures, axis=0)
    below = np.flatnonzero(product < HALF)
    if not below.size:
        return math.nan
    around = slice(max(below[0] - 1, 0), below[0] + 1)
    return float(np.interp(-HALF, -product[around], frequency_per_mm[around]))


def finite_median(values: Floats) -> float:
    """Return the median of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


@METRICS.register(
    "mtf", info=MetricInfo(better="high", title="MTF of lens and photosite"), example={"frequency_per_mm": 50.0}
)
def mtf(
    shot: MetricShot, camera: Camera, capture: Capture, *, frequency_per_mm: float, sites: Ints | None = None
) -> float:
    """Return the MTF of the lens on the axis times that of the photosite of median area."""
    layout, scene = capture.layout, shot.scene
    sites = np.arange(layout.n_sites) if sites is None else sites
    median = sites[np.argsort(layout.area_um2[sites], kind="stable")[sites.size // 2]]
    per_mm = np.array([frequency_per_mm])
    found = float(polygon_mtf(layout[np.array([median])], per_mm)[0, 0])
    if isinstance(scene, Scene):
        wavelength_nm = float(np.median(scene.wavelength_nm))
        found *= float(camera.optics.mtf(per_mm, wavelength_nm=wavelength_nm, distance_m=scene.distance_m)[0])
    return found


@METRICS.register(
    "nyquist_per_mm",
    info=MetricInfo(
        better="high",
        title="Nyquist frequency",
        unit="1/mm",
        definition="median over the sites, from the spacing of their rows",
        has_scene=False,
        is_logarithmic=True,
    ),
)
def median_nyquist_per_mm(
    shot: MetricShot,  # noqa: ARG001 -- the signature of metrics
    camera: Camera,  # noqa: ARG001
    capture: Capture,
    sites: Ints | None = None,
) -> float:
    """Return the median Nyquist frequency of the sites, per mm; NaN where no site has one."""
    found = nyquist_per_mm(capture.layout)
    return finite_median(found if sites is None else found[sites])


@METRICS.register(
    "mtf50_per_mm",
    info=MetricInfo(
        better="high",
        title="MTF50",
        unit="1/mm",
        definition="frequency at which the product of optics and aperture MTF is one half",
        has_scene=False,
        is_logarithmic=True,
    ),
)
def mtf50_per_mm(shot: MetricShot, camera: Camera, capture: Capture, sites: Ints | None = None) -> float:
    """Return the frequency at which the MTF is one half, per mm; NaN if none is."""
    layout = capture.layout
    order = np.argsort(layout.area_um2, kind="stable")
    order = order if sites is None else order[np.isin(order, sites)]
    return aperture_and_lens_mtf50(layout, lens_curve(camera.optics, layout, [wave_of(shot.scene)]), order)
