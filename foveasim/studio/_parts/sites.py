"""Views of photosites: outlines, values, design rules, and the summary."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.scene import Scene
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, layout_of, part
from foveasim.view.web._content import describe_sites, outlines_of, rules_of

__all__ = ["columns", "rules", "sites", "summary_of"]


@part("Photosites", layout_of)
def sites(result: Simulated) -> PartData:
    """Return the outlines of the photosites."""
    about, _, layout = describe_sites(result.capture.layout)
    return {key: about[key] for key in ("n_sites", "bounds_um", "palette")}, outlines_of(layout)


@part("Values of the photosites", capture_of)
def columns(result: Simulated) -> PartData:
    """Return the columns of the photosites: codes, electrons, signal to noise, filters."""
    about, arrays, _ = describe_sites(result.capture, sensor=result.shot.camera.sensor)
    return {key: about[key] for key in ("columns", "filter", "notes")}, arrays


@part("Design rules", lambda result: (result.capture.layout, result.shot.rules))
def rules(result: Simulated) -> PartData:
    """Return the results of the design-rule check."""
    if result.shot.rules is None:
        return {"rules": []}, {}
    arrays: dict[str, NDArray[Any]] = {}
    report = result.capture.layout.check(result.shot.rules)
    return {"rules": rules_of(report, arrays), "is_satisfied": bool(report.ok)}, arrays


def summary_of(result: Simulated) -> dict[str, Any]:
    """Return numbers of a capture, with units in their names."""
    capture, layout = result.capture, result.capture.layout
    x0, y0, x1, y1 = layout.bounds_um
    size_um = np.sqrt(layout.area_um2)
    found = {
        "n_sites": layout.n_sites,
        "bounds_um": [x0, y0, x1, y1],
        "width_um": x1 - x0,
        "height_um": y1 - y0,
        "min_size_um": float(size_um.min()),
        "max_size_um": float(size_um.max()),
        "exposure_s": result.shot.exposure_s,
        "bits": capture.bits,
        "mean_dn": float(capture.code.mean()),
        "median_e": float(np.median(capture.electrons)),
        "saturated_fraction": capture.saturated_fraction,
        "dark_fraction": float(np.mean(capture.code == 0)),
        "f_number": result.shot.camera.optics.f_number,
    }
    if isinstance(result.shot.scene, Scene):
        found["magnification"] = float(result.shot.camera.optics.magnification(result.shot.scene.distance_m))
    return found
