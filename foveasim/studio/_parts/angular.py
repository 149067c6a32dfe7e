"""Angular response of the photosites."""

from __future__ import annotations

from typing import Any

import numpy as np

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, curves_of, label_of, part

#: Number of annuli of equal width.
N_ANNULI = 64
#: Responses of an annulus that differ by more are shown.
SAME = 1e-3


def _cones_of(result: Simulated) -> tuple[Any, ...]:
    camera = result.shot.camera
    numbers = (*camera.position_um, *result.pinned)
    return (
        result.capture.layout,
        camera.optics,
        camera.distortion,
        camera.sensor.pixel_optics,
        result.shot.scene,
        numbers,
    )


@part("Angular response", _cones_of, order=85, group="Measure")
def angular(result: Simulated) -> PartData:
    """Return the response to uniform light against image height: means and extremes of annuli."""
    camera, source = result.shot.camera, result.shot.scene
    if camera.sensor.pixel_optics is None:
        return {"curves": [], "note": "All light is collected: the sensor has no pixel optics."}, {}
    response = camera.angular_response(source)
    height_um = camera.incidence(source).image_height_um
    low_um, high_um = float(height_um.min()), float(height_um.max())
    annulus = np.minimum((height_um - low_um) * (N_ANNULI / max(high_um - low_um, 1e-12)), N_ANNULI - 1).astype(
        np.int64
    )
    order = np.argsort(annulus, kind="stable")
    starts = np.unique(annulus[order], return_index=True)[1]
    n_sites = np.diff(starts, append=annulus.size)
    at_um = np.add.reduceat(height_um[order], starts) / n_sites
    curves = {
        "mean": np.add.reduceat(response[order], starts) / n_sites,
        "lowest": np.minimum.reduceat(response[order], starts),
        "highest": np.maximum.reduceat(response[order], starts),
    }
    if float((curves["highest"] - curves["lowest"]).max()) <= SAME:
        curves = {"mean": curves["mean"]}
    labels = [{"label": f"{name} of an annulus", "name": name, "unit_x": "µm", "unit_y": ""} for name in curves]
    about, arrays = curves_of(labels, [at_um] * len(curves), list(curves.values()))
    about["marks"] = [
        {"x": float(height_um[site]), "y": float(response[site]), "name": "mean"} for site in result.pinned
    ]
    smallest, largest = (int(find(camera.layout.area_um2)) for find in (np.argmin, np.argmax))
    sites = {label_of(site): site for site in result.pinned} or {"smallest site": smallest, "largest site": largest}
    about["note"] = "; ".join(f"{name} {response[site]:.3f}" for name, site in sites.items())
    return about, arrays
