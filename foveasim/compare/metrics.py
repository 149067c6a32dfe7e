"""Metrics of one camera in a comparison: of its layout, and of its captures of scenes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.compare._light import (
    behind_image,
    e_per_photon,
    field_of,
    framed,
    image_of,
    mean_spectrum,
    photons_per_um2,
    with_angular_response,
)
from foveasim.compare.annuli import Annuli
from foveasim.compare.information import SceneCovariance, scene_covariance, site_information_bits
from foveasim.compare.intervals import MedianInterval, format_interval, with_unit
from foveasim.errors import FoveasimWarning, ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.layout import DesignRules
from foveasim.metrics import aliasing_spectrum, flow_bound, nyquist_per_mm, size_classes_um
from foveasim.metrics.registry import METRICS, MetricInfo, MetricShot, metric_info, number_of, options_of
from foveasim.metrics.shots.resolution import (
    Wave,
    aperture_and_lens_mtf50,
    finite_median,
    lens_curve,
    lens_mtf,
    wave_of,
)
from foveasim.scene import Scene
from foveasim.sensor.model.linearisation import Linearisation
from foveasim.sensor.signal_to_noise import site_signals
from foveasim.units import per_mm_from_per_um

__all__ = [
    "BY_ECCENTRICITY",
    "COMPARED",
    "ComparedShot",
    "best_cameras",
    "further_metrics",
    "information_by_annulus",
    "layout_measures",
    "metric_rows",
    "scene_measures",
    "size_records",
    "wave_per_mm_of",
]

#: Smallest number of sites for the spectrum of a region.
MIN_REGION_SITES = 12
UM2_PER_MM2 = 1e6
#: Displacement of images for finite differences, in cells, and largest uncovered area fraction of a site that is used.
SHIFT_CELLS, MAX_UNCOVERED_FRACTION = 0.05, 1e-9
#: Relative difference of two charges up to which they are equal.
ROUNDING = 1e-12


#: Metrics of comparisons; each also has a variable ``NAME_by_eccentricity``.
COMPARED = (
    "psnr_db",
    "ssim",
    "snr_mean_db",
    "information_bit_per_site",
    "information_bit_per_mm2",
    "shift_sigma_um",
    "nyquist_per_mm",
    "mtf50_per_mm",
    "alias_fraction",
)
BY_ECCENTRICITY = "_by_eccentricity"
#: Frequency of the waves for aliases, in Nyquist frequencies of a square grid of as many sites.
WAVE_NYQUISTS = 1.5
#: Number of annuli around the optical axis for metrics of one shot.
N_ANNULI = 8


def wave_per_mm_of(n_sites: int, area_um2: float) -> float:
    """Return the frequency of the waves for aliases, from the number and the area of sites."""
    return WAVE_NYQUISTS * float(per_mm_from_per_um(0.5 * np.sqrt(n_sites / area_um2)))


def layout_measures(camera: Camera, waves: Sequence[Wave], annuli: Annuli, wave_per_mm: float) -> dict[str, Any]:
    """
    Return the measures that do not depend on a scene, in total and by annulus.

    ``waves``: waves of the scenes, over which the MTF of the lens is averaged.
    """
    layout = camera.layout
    annulus = annuli.index_of(layout.centroid_um)
    nyquist = nyquist_per_mm(layout)
    lens = lens_curve(camera.optics, layout, waves)
    order = np.argsort(layout.area_um2, kind="stable")
    by_annulus = [order[annulus[order] == k] for k in range(annuli.edges_um.size - 1)]
    alias, alias_by_annulus = alias_fractions(camera, waves, annuli, wave_per_mm)
    return {
        "nyquist_per_mm": finite_median(nyquist),
        "nyquist_per_mm_by_eccentricity": [finite_median(nyquist[sites]) for sites in by_annulus],
        "mtf50_per_mm": aperture_and_lens_mtf50(layout, lens, order),
        "mtf50_per_mm_by_eccentricity": [aperture_and_lens_mtf50(layout, lens, sites) for sites in by_annulus],
        "alias_fraction": alias,
        "alias_fraction_by_eccentricity": alias_by_annulus,
    }


def alias_fractions(camera: Camera, waves: Sequence[Wave], annuli: Annuli, wave_per_mm: float) -> tuple[float, Floats]:
    """Return the contrast of aliases of a wave along x, in total and by annulus."""
    layout = camera.layout
    annulus = annuli.index_of(layout.centroid_um)
    (x_um, y_um), edges_um = annuli
    contrast = float(lens_mtf(camera.optics, waves, np.array([wave_per_mm]))[0])

    def alias(middle_um: tuple[float, float], radius_um: float) -> float:
        if np.count_nonzero(np.hypot(*(layout.centroid_um - middle_um).T) < radius_um) < MIN_REGION_SITES:
            return float("nan")
        try:
            found = aliasing_spectrum(layout, (wave_per_mm, 0.0), centre_um=middle_um, radius_um=radius_um)
        except ParameterError:
            return float("nan")  # too few sites
        return found.alias_fraction * contrast

    ring_um = 0.5 * (edges_um[1:] + edges_um[:-1])
    # The innermost region is centred; others are to the right of the fixation point.
    centres = [(x_um + (r if k else 0.0), y_um) for k, r in enumerate(ring_um.tolist())]
    radii = [
        width if k == 0 else max(0.5 * width, 0.25 * ring_um[k]) for k, width in enumerate(np.diff(edges_um).tolist())
    ]
    alias_fraction = np.array([alias(c, r) for c, r in zip(centres, radii, strict=True)])
    # A larger region would contain waves of many local frequencies: the total is the mean over the area.
    order = np.argsort(layout.area_um2, kind="stable")
    area_um2 = np.array([layout.area_um2[order[annulus[order] == k]].sum() for k in range(edges_um.size - 1)])
    weights = np.where(np.isfinite(alias_fraction), area_um2, 0.0)
    total = np.nansum(weights * alias_fraction) / weights.sum() if weights.any() else math.nan
    return total, alias_fraction


def scene_measures(
    camera: Camera, capture: Capture, image: PowerMap, annuli: Annuli
) -> tuple[Linearisation, dict[str, Any]]:
    """
    Return the model of a capture, its SNR, and the precision of a shift of its image.

    Values of an annulus without sites are NaN.
    """
    sensor, layout = camera.sensor, camera.layout
    exposure_s = float(capture.settings["exposure_s"])
    dark_e = sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s)
    model = sensor.linearise(capture.expected_e, exposure_s=exposure_s)
    ratio = site_signals(model, dark_e).unsaturated_ratio
    annulus = annuli.index_of(layout.centroid_um)
    gradient = _shift_gradients_e_per_um(camera, image, exposure_s)
    parts = flow_bound(gradient, model, regions=annulus)
    sigma_um = np.full(annuli.edges_um.size - 1, np.nan)
    sigma_um[parts.regions] = _rms(parts.sigma_um)
    with np.errstate(divide="ignore"):
        return model, {
            "snr_mean_db": 20.0 * np.log10(ratio.mean()),
            "snr_mean_db_by_eccentricity": 20.0 * np.log10(annuli.means(ratio, annulus)),
            "shift_sigma_um": _rms(flow_bound(gradient, model).sigma_um)[0],
            "shift_sigma_um_by_eccentricity": sigma_um,
        }


def _shift_gradients_e_per_um(camera: Camera, image: PowerMap, exposure_s: float) -> Floats:
    """
    Return the change of expected charges per image displacement, (n_site, 2) e-/µm.

    It is 0 for sites that lie partly or entirely off the image.
    """
    grid, layout = image.grid, camera.layout
    uncovered_um2 = camera.integrator(
        grid, order=camera.order(image), projection=camera.projection(image)
    ).uncovered_um2
    moving = copy(camera)  # so that displaced images do not fill the cache of the camera

    def expected_e(x_um: float, y_um: float) -> Floats:
        x0_um, y0_um = grid.origin_um
        moved = replace(image, grid=Grid(grid.shape, grid.pitch_um, (x0_um + x_um, y0_um + y_um)))
        return camera.sensor.expected_electrons(moving.photoelectrons_per_s(moved), exposure_s)

    gradient = np.empty((layout.n_sites, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FoveasimWarning)  # the capture has issued them already
        for axis, step_um in enumerate((SHIFT_CELLS * grid.pitch_xy_um).tolist()):
            x_um, y_um = (step_um, 0.0) if axis == 0 else (0.0, step_um)
            ahead_e, behind_e = expected_e(x_um, y_um), expected_e(-x_um, -y_um)
            change_e = ahead_e - behind_e
            change_e[np.abs(change_e) <= ROUNDING * (ahead_e + behind_e)] = 0.0  # no precision from rounding
            gradient[:, axis] = change_e / (2.0 * step_um)
    gradient[uncovered_um2 > MAX_UNCOVERED_FRACTION * layout.area_um2] = 0.0
    return gradient


def information_by_annulus(
    camera: Camera,
    covariance: SceneCovariance,
    responses: Sequence[NDArray[np.float64]],
    models: Sequence[Linearisation],
    annuli: Annuli,
) -> dict[str, Any]:
    """
    Return the information per site and per mm², (n_scene,) and (n_scene, n_annulus).

    ``responses``: for each scene, the ratio of each site's expected charge per area to the irradiance of the covariance.
    """
    layout = camera.layout
    gain = [layout.area_um2 * model.forward(response) for model, response in zip(models, responses, strict=True)]
    bits = site_information_bits(layout, covariance, gain, models)
    annulus, area_mm2 = annuli.index_of(layout.centroid_um), layout.area_um2 / UM2_PER_MM2
    return {
        "information_bit_per_site": bits.mean(axis=1),
        "information_bit_per_site_by_eccentricity": [annuli.means(row, annulus) for row in bits],
        "information_bit_per_mm2": bits.sum(axis=1) / area_mm2.sum(),
        "information_bit_per_mm2_by_eccentricity": [annuli.means(row, annulus, area_mm2) for row in bits],
    }


@METRICS.register(
    "shift_sigma_um",
    info=MetricInfo(
        title="precision of a shift",
        unit="µm",
        definition="smallest standard deviation of an estimated image shift, rms of x and y",
        better="low",
        is_logarithmic=True,
    ),
)
def shift_sigma_um(shot: MetricShot, camera: Camera, capture: Capture) -> float:
    """Return the Cramér-Rao bound for a shift of the known image, µm."""
    camera, light = framed(camera, shot.scene)
    sensor, exposure_s = camera.sensor, shot.exposure_s
    model = sensor.linearise(capture.expected_e, exposure_s=exposure_s)
    gradient = _shift_gradients_e_per_um(behind_image(camera), image_of(camera, light, {}), exposure_s)
    return float(_rms(flow_bound(gradient, model).sigma_um)[0])


@METRICS.register(
    "alias_fraction",
    info=MetricInfo(
        title="alias contrast",
        definition=(
            "largest contrast of an alias of a sine wave along x, at 1.5 times the Nyquist frequency of a square grid with as "
            "many sites per area as the cameras on average"
        ),
        better="low",
        has_scene=False,
    ),
)
def alias_fraction(shot: MetricShot, camera: Camera, capture: Capture) -> float:
    """Return the mean contrast of aliases over the area; NaN for too few sites."""
    layout = capture.layout
    annuli, _, _ = field_of([camera], (0.0, 0.0), N_ANNULI, 16)
    wave_per_mm = wave_per_mm_of(layout.n_sites, layout.area_um2.sum())
    return alias_fractions(camera, [wave_of(shot.scene)], annuli, wave_per_mm)[0]


def _information(shot: MetricShot, camera: Camera, capture: Capture) -> dict[str, Any]:
    """Return the information about scenes that have the covariance of the shot's scene."""
    camera, light = framed(camera, shot.scene)
    annuli, _, grid = field_of([camera], (0.0, 0.0), 1, 16)
    image = image_of(camera.with_gaze((0.0, 0.0)), light, {})
    covariance = scene_covariance(photons_per_um2(image, grid, shot.exposure_s)[np.newaxis], grid.pitch_x_um)
    e_per_ph = e_per_photon(camera.sensor, [mean_spectrum(image, grid)])
    response = e_per_ph[camera.sensor.filter_of_site] * with_angular_response(camera, light).light_response()
    model = camera.sensor.linearise(capture.expected_e, exposure_s=shot.exposure_s)
    return information_by_annulus(camera, covariance, [response], [model], annuli)


@METRICS.register(
    "information_bit_per_site",
    info=MetricInfo(
        better="high",
        title="information per site",
        unit="bit",
        definition="Gaussian estimate of the information about the scenes, per site",
    ),
)
def information_bit_per_site(shot: MetricShot, camera: Camera, capture: Capture) -> float:
    """Estimate the information about the scene, bit per site."""
    return float(_information(shot, camera, capture)["information_bit_per_site"][0])


@METRICS.register(
    "information_bit_per_mm2",
    info=MetricInfo(
        better="high",
        title="information per area",
        unit="bit/mm²",
        definition="the same, per area of the sites",
        is_logarithmic=True,
    ),
)
def information_bit_per_mm2(shot: MetricShot, camera: Camera, capture: Capture) -> float:
    """Estimate the information about the scene, bit per mm² of the sites."""
    return float(_information(shot, camera, capture)["information_bit_per_mm2"][0])


class ComparedShot(NamedTuple):
    """A scene and a camera of a comparison, for metrics."""

    scene: Scene | PowerMap
    camera: Camera
    exposure_s: float
    rules: DesignRules | None = None


def further_metrics(names: Sequence[str], shot: ComparedShot, capture: Capture, annuli: Annuli) -> dict[str, Any]:
    """Return further metrics of a capture, in total and by annulus, NaN without sites."""
    found: dict[str, Any] = {}
    n_annuli = annuli.edges_um.size - 1
    annulus = annuli.index_of(shot.camera.layout.centroid_um)
    for name in names:
        found[name] = number_of(name, shot, shot.camera, capture)
        by_annulus = np.full(n_annuli, np.nan)
        if "sites" in options_of(METRICS[name]):
            for k in np.unique(annulus[annulus >= 0]).tolist():
                by_annulus[k] = number_of(name, shot, shot.camera, capture, sites=np.flatnonzero(annulus == k))
        found[name + BY_ECCENTRICITY] = by_annulus
    return found


def metric_rows(names: Sequence[str], interval_of: Callable[[str], MedianInterval]) -> list[list[str]]:
    """Return a row of text per metric: its title, and the interval of each camera."""
    return [
        [
            with_unit(info.title, info.unit),
            *(format_interval(*one) for one in zip(*interval_of(name), strict=True)),
        ]
        for name, info in ((name, metric_info(name)) for name in names)
    ]


def best_cameras(names: Sequence[str], interval_of: Callable[[str], MedianInterval]) -> list[int | None]:
    """Return the best camera of each metric; None for several, or no better direction."""
    found: list[int | None] = []
    for name in names:
        better = metric_info(name).better
        values = (-1.0 if better == "low" else 1.0) * np.asarray(interval_of(name).median, np.float64)
        best = np.flatnonzero(values == values.max(initial=-np.inf))
        found.append(int(best[0]) if best.size == 1 and better is not None else None)
    return found


def size_records(camera: Camera) -> list[dict[str, Any]]:
    """Return size, number of sites and area fraction of each size class."""
    layout = camera.layout
    size_um, position, counts = np.unique(size_classes_um(layout), return_inverse=True, return_counts=True)
    area_um2 = np.bincount(position.ravel(), layout.area_um2)
    rows = zip(size_um.tolist(), counts.tolist(), (area_um2 / area_um2.sum()).tolist(), strict=True)
    return [{"size_um": size, "n_sites": n, "area_fraction": part} for size, n, part in rows]


def _rms(values: NDArray[np.float64]) -> Floats:
    return np.sqrt(np.mean(np.square(values), axis=-1))
