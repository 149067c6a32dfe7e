"""Measures of one camera: of its layout, and of its captures of scenes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Ints
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.compare.annuli import Annuli
from foveasim.compare.information import SceneCovariance, site_information_bits
from foveasim.compare.intervals import MedianInterval, format_interval, with_unit
from foveasim.errors import FoveasimWarning, ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.metrics import (
    aliasing_spectrum,
    flow_bound,
    nyquist_per_mm,
    polygon_mtf,
    size_classes_um,
)
from foveasim.sensor.model.linearisation import Linearisation
from foveasim.sensor.signal_to_noise import site_signals
from foveasim.units import per_mm_from_per_um

__all__ = [
    "MEASURES",
    "Measure",
    "Wave",
    "information_by_annulus",
    "layout_measures",
    "measure_rows",
    "scene_measures",
    "size_records",
]

#: Sites of an annulus that represent its aperture MTF, and directions of the waves.
MTF_SITES, MTF_ANGLES_DEG = 24, (0.0, 45.0, 90.0, 135.0)
#: Frequencies of the MTF, and the highest one in units of 1 / size of the smallest site.
MTF_FREQUENCIES, MAX_FREQUENCY = 200, 1.5
#: Smallest number of sites for the spectrum of a region.
MIN_REGION_SITES = 12
UM2_PER_MM2 = 1e6
#: Displacement of images for differences of first order, in cells, and largest uncovered area fraction of a site that is used.
SHIFT_CELLS, MAX_UNCOVERED_FRACTION = 0.05, 1e-9
#: Relative difference of two charges up to which they are equal.
ROUNDING = 1e-12
#: Level of MTF50.
HALF = 0.5


class Wave(NamedTuple):
    """Mean wavelength and distance of a scene, for the MTF of a lens."""

    wavelength_nm: float
    distance_m: float


@dataclass(frozen=True)
class Measure:
    """
    Title, unit and definition of a measure.

    ``has_scenes``: whether it depends on the scene. ``is_better_low``: whether lower values are better.
    """

    title: str
    unit: str
    definition: str
    has_scenes: bool
    is_better_low: bool = False


#: Measures by the names of their variables; each also has a variable ``NAME_by_eccentricity``.
MEASURES = {
    "psnr_db": Measure(
        "PSNR", "dB", "peak signal-to-noise ratio of the picture, with the range of the ideal picture as peak", True
    ),
    "ssim": Measure("SSIM", "", "structural similarity of the picture and the ideal picture", True),
    "snr_db": Measure(
        "SNR per site", "dB", "signal-to-noise ratio of a site, 0 if it is saturated, mean over the sites, 20 log₁₀", True
    ),
    "information_bit_per_site": Measure(
        "information per site", "bit", "Gaussian estimate of the information about the scenes, per site", True
    ),
    "information_bit_per_mm2": Measure(
        "information per area", "bit/mm²", "the same, per area of the sites", True
    ),
    "shift_sigma_um": Measure(
        "precision of a shift", "µm", "smallest standard deviation of an estimated image shift, rms of x and y", True,
        is_better_low=True,
    ),
    "nyquist_per_mm": Measure("Nyquist frequency", "1/mm", "median over the sites, from the spacing of their rows", False),
    "mtf50_per_mm": Measure(
        "MTF50", "1/mm", "frequency at which the product of optics and aperture MTF is one half", False
    ),
    "alias_fraction": Measure(
        "alias contrast",
        "",
        "largest contrast of an alias of a sine wave along x, at 1.5 times the Nyquist frequency of a square grid with as many "
        "sites per area as the cameras on average",
        False,
        is_better_low=True,
    ),
}  # fmt: skip


def layout_measures(camera: Camera, waves: Sequence[Wave], annuli: Annuli, wave_per_mm: float) -> dict[str, Any]:
    """
    Return the measures that do not depend on a scene, in total and by annulus.

    ``waves``: those of the scenes. The MTF of the lens is their mean.
    """
    layout = camera.layout
    annulus = annuli.index_of(layout.centroid_um)
    (x_um, y_um), edges_um = annuli
    nyquist = nyquist_per_mm(layout)
    frequency = np.linspace(
        0.0, MAX_FREQUENCY * float(per_mm_from_per_um(1.0 / np.sqrt(layout.area_um2.min()))), MTF_FREQUENCIES
    )

    def lens_mtf(per_mm: Floats) -> Floats:
        return np.asarray(
            np.mean(
                [camera.optics.mtf(per_mm, wave.wavelength_nm, distance_m=wave.distance_m) for wave in waves], axis=0
            )
        )

    lens = lens_mtf(frequency)

    def mtf50(sites: Ints) -> float:
        if not sites.size:
            return float("nan")
        chosen = sites[np.linspace(0, sites.size - 1, min(MTF_SITES, sites.size)).astype(np.int64)]
        apertures = [polygon_mtf(layout[chosen], frequency, angle_deg=angle).mean(axis=0) for angle in MTF_ANGLES_DEG]
        return _first_crossing(frequency, lens * np.mean(apertures, axis=0))

    def alias(middle_um: tuple[float, float], radius_um: float) -> float:
        if np.count_nonzero(np.hypot(*(layout.centroid_um - middle_um).T) < radius_um) < MIN_REGION_SITES:
            return float("nan")
        try:
            found = aliasing_spectrum(layout, (wave_per_mm, 0.0), centre_um=middle_um, radius_um=radius_um)
        except ParameterError:
            return float("nan")  # too few sites
        return found.alias_fraction * float(lens_mtf(np.array([wave_per_mm]))[0])

    order = np.argsort(layout.area_um2, kind="stable")
    by_annulus = [order[annulus[order] == k] for k in range(edges_um.size - 1)]
    ring_um = 0.5 * (edges_um[1:] + edges_um[:-1])
    # The innermost region is centred; others are to the right of the fixation point.
    centres = [(x_um + (r if k else 0.0), y_um) for k, r in enumerate(ring_um.tolist())]
    radii = [
        width if k == 0 else max(0.5 * width, 0.25 * ring_um[k]) for k, width in enumerate(np.diff(edges_um).tolist())
    ]
    alias_fraction = np.array([alias(c, r) for c, r in zip(centres, radii, strict=True)])
    # A larger region would contain waves of many local frequencies: the total is the mean over the area.
    area_um2 = np.array([layout.area_um2[sites].sum() for sites in by_annulus])
    weights = np.where(np.isfinite(alias_fraction), area_um2, 0.0)
    return {
        "nyquist_per_mm": _median(nyquist),
        "nyquist_per_mm_by_eccentricity": [_median(nyquist[sites]) for sites in by_annulus],
        "mtf50_per_mm": mtf50(order),
        "mtf50_per_mm_by_eccentricity": [mtf50(sites) for sites in by_annulus],
        "alias_fraction": np.nansum(weights * alias_fraction) / weights.sum() if weights.any() else math.nan,
        "alias_fraction_by_eccentricity": alias_fraction,
    }


def scene_measures(
    camera: Camera, capture: Capture, image: PowerMap, annuli: Annuli
) -> tuple[Linearisation, dict[str, Any]]:
    """
    Return the model of a capture of an image, its SNR and its precision of a shift.

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
            "snr_db": 20.0 * np.log10(ratio.mean()),
            "snr_db_by_eccentricity": 20.0 * np.log10(annuli.means(ratio, annulus)),
            "shift_sigma_um": _rms(flow_bound(gradient, model).sigma_um)[0],
            "shift_sigma_um_by_eccentricity": sigma_um,
        }


def _shift_gradients_e_per_um(camera: Camera, image: PowerMap, exposure_s: float) -> Floats:
    """
    Return the change of expected charges per image displacement, (n_site, 2) e-/µm.

    It is 0 for sites that lie partly or entirely off the image.
    """
    grid, layout = image.grid, camera.layout
    uncovered_um2 = camera.integrator(grid, order=camera.order(image)).uncovered_um2
    moving = copy(camera)  # displaced images do not fill the camera's cache

    def expected_e(x_um: float, y_um: float) -> Floats:
        x0_um, y0_um = grid.origin_um
        moved = PowerMap(image.data, Grid(grid.shape, grid.pitch_um, (x0_um + x_um, y0_um + y_um)), image.wavelength_nm)
        return camera.sensor.expected_electrons(moving.photoelectrons_per_s(moved), exposure_s)

    gradient = np.empty((layout.n_sites, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FoveasimWarning)  # those of the capture
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


def measure_rows(interval_of: Callable[[str], MedianInterval]) -> list[list[str]]:
    """Return title and one value per camera of each measure, from a function of its name."""
    return [
        [
            with_unit(measure.title, measure.unit),
            *(format_interval(*one) for one in zip(*interval_of(name), strict=True)),
        ]
        for name, measure in MEASURES.items()
    ]


def best_cameras(interval_of: Callable[[str], MedianInterval]) -> list[int | None]:
    """Return the camera with the best value of each measure; None if there are several."""
    found: list[int | None] = []
    for name, measure in MEASURES.items():
        values = (-1.0 if measure.is_better_low else 1.0) * np.asarray(interval_of(name).median, np.float64)
        best = np.flatnonzero(values == values.max(initial=-np.inf))
        found.append(int(best[0]) if best.size == 1 else None)
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


def _median(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _first_crossing(frequency_per_mm: Floats, mtf: Floats) -> float:
    """Return the first frequency at which an MTF falls to one half; NaN if it does not."""
    below = np.flatnonzero(mtf < HALF)
    if not below.size:
        return math.nan
    around = slice(max(below[0] - 1, 0), below[0] + 1)
    return float(np.interp(-HALF, -mtf[around], frequency_per_mm[around]))
