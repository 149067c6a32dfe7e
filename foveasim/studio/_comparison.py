"""Comparison of variants: budgets and picture quality."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from foveasim._core.validation import Floats
from foveasim.camera import Camera
from foveasim.camera._framing import turned_instead
from foveasim.capture import Capture
from foveasim.compare import budget_of, quality_by_eccentricity
from foveasim.errors import FoveasimError, ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.layout import Layout
from foveasim.scene import Scene
from foveasim.studio._engine import Simulated
from foveasim.studio._settings.unknowns import is_generated, size_of

#: Side of the compared pictures, pixels.
N_PIXELS = 160
#: Half side of the fovea as a fraction of that of the field.
FOVEA_FRACTION = 0.2
#: Sites of the fovea have at most this multiple of the area of the smallest ones, without the smallest 1 %, often slivers.
FOVEA_AREA_RATIO, SLIVER_QUANTILE = 2.0, 0.01
MM2_PER_UM2 = 1e-6
#: Rows of the comparison: label, unit, and which values are better, by name.
ROWS = {
    "n_sites": ("photosites", "", None),
    "bits_per_frame": ("bits per frame", "", None),
    "frames_per_s": ("frame rate", "1/s", "high"),
    "readout_steps": ("longest line", "sites", "low"),
    "area_mm2": ("area", "mm²", None),
    "median_e": ("median signal of a site", "e-", None),
    "saturated_percent": ("saturated sites", "%", "low"),
    "read_noise_e": ("median read noise of a site", "e-", "low"),
    "fovea_psnr_db": ("PSNR, fovea", "dB", "high"),
    "field_psnr_db": ("PSNR, field", "dB", "high"),
    "fovea_ssim": ("SSIM, fovea", "", "high"),
    "field_ssim": ("SSIM, field", "", "high"),
}
#: Relative difference of widths and heights up to which fields are equal; also the size of a median photosite.
SAME_FIELD = 0.01
#: Relative difference up to which no value is better.
SAME_VALUE = 1e-3


def compare(variants: Sequence[tuple[str, Simulated]]) -> dict[str, Any]:
    """
    Return budgets and picture quality of variants with their names.

    The data rate is the highest of the variants: with its readout, or one frame per exposure. Scenes with ``fit`` are framed on
    all layouts together where the lenses are equal. Pictures are compared with the optical image in squares of equal size
    around the fovea of each variant.

    Returns
    -------
    about : dict
        Names; rows with the name, label, unit, the values of all variants and the indices of the better ones; sides of the
        squares, µm; width and height of each field, µm, and whether they are equal; whether the last variant can match others.
    """
    last = variants[-1][1]
    half_um = min(_half_side_um(result.capture.layout) for _, result in variants)
    rates_bit_per_s = [
        budget_of(result.shot.camera, rate).data_rate_bit_per_s
        for _, result in variants
        if (rate := _frame_rate(result))
    ]
    rate_bit_per_s = max(rates_bit_per_s, default=None)
    framed = _framed_together([result for _, result in variants])
    found = [
        _measures(*one, rate_bit_per_s, half_um) for one in zip((result for _, result in variants), framed, strict=True)
    ]
    values = {name: [each[name] for each in found] for name in ROWS}
    rows = [
        {"name": name, "label": label, "unit": unit, "values": values[name], "best": _best(values[name], better)}
        for name, (label, unit, better) in ROWS.items()
    ]
    layouts = [result.capture.layout for _, result in variants]
    sizes_um = np.array([size_of(layout) for layout in layouts])
    tolerance_um = np.maximum(SAME_FIELD * sizes_um.max(axis=0), max(np.median(layout.size_um) for layout in layouts))
    return {
        "names": [name for name, _ in variants],
        "rows": rows,
        "field_um": 2.0 * half_um,
        "fovea_um": 2.0 * FOVEA_FRACTION * half_um,
        "sizes_um": sizes_um.tolist(),
        "has_equal_fields": bool((np.ptp(sizes_um, axis=0) <= tolerance_um).all()),
        "can_match": is_generated(last.settings),
    }


def _best(values: Sequence[float | None], better: str | None) -> list[int]:
    """Return the indices of the best values; none if all are about equal."""
    known = [value for value in values if value is not None and not np.isnan(value)]
    if better is None or not known or math.isclose(min(known), max(known), rel_tol=SAME_VALUE):
        return []
    best = max(known) if better == "high" else min(known)
    return [k for k, value in enumerate(values) if value == best]


def _frame_rate(result: Simulated) -> float | None:
    """Return the frame rate of a variant's readout, or of its exposures; None without both."""
    readout = None if result.shot.rules is None else result.shot.rules.readout
    if readout is not None:
        return readout.frames_per_s
    return 1.0 / result.shot.exposure_s if result.shot.exposure_s > 0.0 else None


class _Framed(NamedTuple):
    """Scene of a variant, the camera for it, and the capture."""

    camera: Camera
    scene: Scene | PowerMap
    capture: Capture


def _framed_together(results: Sequence[Simulated]) -> list[_Framed]:
    """Return scene and capture of each variant, framed on all layouts with ``fit``."""
    shots = [result.shot for result in results]
    cameras = [shot.camera for shot in shots]
    own = [_Framed(shot.camera, shot.scene, result.capture) for shot, result in zip(shots, results, strict=True)]
    fits = {shot.scene.fit if isinstance(shot.scene, Scene) and shot.scene.pitch_um is None else None for shot in shots}
    if len(fits) > 1 or fits == {None}:
        return own
    found: list[_Framed] = []
    for shot, result in zip(shots, results, strict=True):
        camera, scene = turned_instead(shot.camera, shot.scene)
        assert isinstance(scene, Scene)
        try:
            framed, alone = camera.fit_scene(scene, others=cameras), camera.fit_scene(scene)
        except ParameterError:  # other lenses
            return own
        is_same = (framed.pitch_um, framed.axis_um) == (alone.pitch_um, alone.axis_um)
        capture = result.capture
        if not is_same:
            capture = camera.capture(framed, exposure_s=shot.exposure_s, seed=shot.seed)
        found.append(_Framed(camera, framed, capture))
    return found


def _measures(
    result: Simulated, framed: _Framed, rate_bit_per_s: float | None, half_um: float
) -> dict[str, float | None]:
    budget = budget_of(result.shot.camera, 1.0)
    found: dict[str, float | None] = {
        "n_sites": budget.n_sites,
        "bits_per_frame": budget.data_rate_bit_per_s,
        "frames_per_s": rate_bit_per_s and rate_bit_per_s / budget.data_rate_bit_per_s,
        "readout_steps": budget.readout_steps,
        "area_mm2": budget.area_um2 * MM2_PER_UM2,
        "median_e": float(np.median(result.capture.electrons)),
        "saturated_percent": 100.0 * result.capture.saturated_fraction,
        "read_noise_e": result.read_noise_e,
    }
    (camera, scene, capture), centre_um = framed, fovea_um(result.capture.layout)
    for name, side_um in (("field", half_um), ("fovea", FOVEA_FRACTION * half_um)):
        grid = _square(centre_um, side_um)
        try:
            picture = capture.picture(of="light_e", per="um2", grid=grid, sensor=camera.sensor)
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
    return 0.5 * min(size_of(layout))


def _square(centre_um: Floats, half_um: float) -> Grid:
    pitch_um = 2.0 * half_um / N_PIXELS
    return Grid(
        (N_PIXELS, N_PIXELS), (pitch_um, pitch_um), (float(centre_um[0] - half_um), float(centre_um[1] - half_um))
    )
