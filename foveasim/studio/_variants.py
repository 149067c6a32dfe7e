"""Comparison of two variants: budgets, picture quality, and the same number of photosites."""

from __future__ import annotations

import copy
from contextlib import suppress
from typing import Any

import numpy as np

from foveasim._core.validation import Floats
from foveasim.compare import budget_of, quality_by_eccentricity
from foveasim.errors import FoveasimError, ParameterError
from foveasim.fields import Grid
from foveasim.layout import LAYOUTS, Layout
from foveasim.studio._engine import Simulated

#: Side of the compared pictures, pixels.
N_PIXELS = 160
#: Half side of the fovea as a fraction of that of the field.
FOVEA_FRACTION = 0.2
#: Sites of the fovea have at most this multiple of the area of the smallest ones, without the smallest 1 %, often slivers.
FOVEA_AREA_RATIO, SLIVER_QUANTILE = 2.0, 0.01
#: Parameters of raster generators that the number of sites in a field of given size replaces.
RASTER = ("grid", "hexagonal", "octagonal")
RASTER_PARAMETERS = ("n_x", "n_y", "n_columns", "n_rows", "pitch_um", "pitch_y_um")
#: Largest difference of the number of sites, in percent, where generators have no nearer possible number.
MAX_PERCENT = 8
MM2_PER_UM2 = 1e-6
#: Rows of the comparison: label and unit by name.
ROWS = {
    "n_sites": ("photosites", ""),
    "bits_per_frame": ("bits per frame", ""),
    "frames_per_s": ("frame rate", "1/s"),
    "readout_steps": ("longest line", "sites"),
    "area_mm2": ("area", "mm²"),
    "total_e": ("electrons", "e-"),
    "read_noise_e": ("read noise", "e-"),
    "fovea_psnr_db": ("PSNR, fovea", "dB"),
    "field_psnr_db": ("PSNR, field", "dB"),
    "fovea_ssim": ("SSIM, fovea", ""),
    "field_ssim": ("SSIM, field", ""),
}


def compare(a: Simulated, b: Simulated) -> dict[str, Any]:
    """
    Return budgets and picture quality of two variants.

    The data rate is that of A: with its readout, or one frame per exposure. Pictures are compared with the optical image in
    squares of equal size around the fovea of each variant.

    Returns
    -------
    about : dict
        Rows with the name, label, unit and the values of both variants; sides of the squares, µm.
    """
    half_um = min(_half_side_um(result.capture.layout) for result in (a, b))
    readout = None if a.shot.rules is None else a.shot.rules.readout
    exposure_s = a.shot.exposure_s
    frames_per_s = readout.frames_per_s if readout is not None else 1.0 / exposure_s if exposure_s > 0 else None
    rate_bit_per_s = frames_per_s and budget_of(a.shot.camera, frames_per_s).data_rate_bit_per_s
    found = [_measures(result, rate_bit_per_s, half_um) for result in (a, b)]
    rows = [
        {"name": name, "label": label, "unit": unit, "values": [each[name] for each in found]}
        for name, (label, unit) in ROWS.items()
    ]
    return {
        "rows": rows,
        "field_um": 2.0 * half_um,
        "fovea_um": 2.0 * FOVEA_FRACTION * half_um,
        "can_match": _is_generated(b.settings),
    }


def _measures(result: Simulated, rate_bit_per_s: float | None, half_um: float) -> dict[str, float | None]:
    budget = budget_of(result.shot.camera, 1.0)
    found: dict[str, float | None] = {
        "n_sites": budget.n_sites,
        "bits_per_frame": budget.data_rate_bit_per_s,
        "frames_per_s": rate_bit_per_s and rate_bit_per_s / budget.data_rate_bit_per_s,
        "readout_steps": budget.readout_steps,
        "area_mm2": budget.area_um2 * MM2_PER_UM2,
        "total_e": float(result.capture.electrons.sum(dtype=np.float64)),
        "read_noise_e": float(np.sqrt(budget.read_noise_e2)),
    }
    camera, scene, centre_um = result.shot.camera, result.shot.scene, fovea_um(result.capture.layout)
    for name, side_um in (("field", half_um), ("fovea", FOVEA_FRACTION * half_um)):
        grid = _square(centre_um, side_um)
        try:
            picture = result.capture.picture(of="light_e", per="um2", grid=grid, sensor=camera.sensor)
            reference = camera.reference(scene, grid, exposure_s=result.shot.exposure_s)
            quality = quality_by_eccentricity(picture, reference, edges_um=np.array([0.0, side_um]))
            found |= {f"{name}_psnr_db": quality.psnr_db, f"{name}_ssim": quality.ssim}
        except FoveasimError:  # such as a uniform image, or one outside the image circle
            found |= {f"{name}_psnr_db": None, f"{name}_ssim": None}
    return found


def fovea_um(layout: Layout) -> Floats:
    """Return the mean centroid of the smallest photosites, (x, y) µm."""
    limit_um2 = FOVEA_AREA_RATIO * np.quantile(layout.area_um2, SLIVER_QUANTILE)
    centre_um: Floats = layout.centroid_um[layout.area_um2 <= limit_um2].mean(axis=0)
    return centre_um


def _half_side_um(layout: Layout) -> float:
    """Return half the shorter side of the bounding box."""
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um
    return 0.5 * min(x1_um - x0_um, y1_um - y0_um)


def _square(centre_um: Floats, half_um: float) -> Grid:
    pitch_um = 2.0 * half_um / N_PIXELS
    return Grid(
        (N_PIXELS, N_PIXELS), (pitch_um, pitch_um), (float(centre_um[0] - half_um), float(centre_um[1] - half_um))
    )


def _is_generated(settings: dict[str, Any]) -> bool:
    layout = settings.get("layout")
    return isinstance(layout, dict) and layout.get("generator") in LAYOUTS


def with_n_sites(settings: dict[str, Any], n_sites: int, layout: Layout) -> dict[str, Any]:
    """
    Return settings whose generator solves for a number of photosites.

    Rasters have the field of the present layout, and other pitches; of other generators, one parameter is solved for.

    ``layout``: present layout of the settings. Raises ParameterError when the layout has no generator, or its generator has no
    such parameter.
    """
    if not _is_generated(settings):
        raise ParameterError("layout", "must have a generator, whose number of photosites can be chosen")
    found = copy.deepcopy(settings)
    name = found["layout"]["generator"]
    parameters = found["layout"].setdefault("parameters", {})
    solvable = LAYOUTS[name].solve_for  # type: ignore[attr-defined]
    given = [unknown.name for unknown in solvable if parameters.get(unknown.name) is not None]
    if name in RASTER:
        x0_um, y0_um, x1_um, y1_um = layout.bounds_um
        if parameters.get("size_um") is None:
            parameters["size_um"] = [round(x1_um - x0_um, 6), round(y1_um - y0_um, 6)]
        candidates = [{key: value for key, value in parameters.items() if key not in RASTER_PARAMETERS}]
    elif solvable and parameters.get("n_sites") is None:
        if not given:
            raise ParameterError("layout", f"of {name} must contain {' or '.join(each.name for each in solvable)}")
        candidates = [{key: value for key, value in parameters.items() if key != other} for other in given]
    else:
        candidates = [parameters]
    chosen = candidates[0] | {"n_sites": n_sites}
    if solvable and LAYOUTS[name].picture is None:  # type: ignore[attr-defined]
        chosen = _nearest(name, candidates, n_sites) or chosen  # without any, the generator reports the reason
    found["layout"]["parameters"] = chosen
    return found


def _nearest(generator: str, candidates: list[dict[str, Any]], n_sites: int) -> dict[str, Any] | None:
    """Return the first parameters with a possible number of sites near the given one."""
    for percent in sorted(range(-MAX_PERCENT, MAX_PERCENT + 1), key=abs):
        for parameters in candidates:
            with suppress(FoveasimError):
                layout = LAYOUTS[generator](**{**parameters, "n_sites": round(n_sites * (1.0 + 0.01 * percent))})
                return parameters | {"n_sites": layout.n_sites if percent else n_sites}
    return None
