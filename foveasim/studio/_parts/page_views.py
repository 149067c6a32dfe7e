"""Views of data that the page has: the map, the settings, the summary of the state."""

from __future__ import annotations

from typing import Any

import numpy as np

from foveasim.scene import Scene
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import page_part

page_part("histogram", "Histogram", order=20, group="Measure", is_first=True)
page_part("site", "Photosite", order=30, group="See", is_wide=True)
page_part("goal", "Goal seek", order=97)
page_part("sweep", "Sweep", order=98)
page_part("steps", "Steps", order=100)
page_part("summary", "Summary", order=110, group="Measure", is_first=True)
page_part("variants", "Variants", order=125)
page_part("selection", "Selection", order=120, group="See")


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
