"""Noise budget."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Floats
from foveasim.sensor import noise_budget
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, part, saturation_of


@part("Noise", capture_of, order=40, group="Measure", is_first=True)
def noise(result: Simulated) -> PartData:
    """Return the noise budget: median over the photosites by source, e-."""
    sensor, capture = result.shot.camera.sensor, result.capture
    budget = noise_budget(sensor, result.photo_e_per_s, result.shot.exposure_s)
    sources = [
        {"name": name, "label": name.replace("_", " "), "is_temporal": name in budget.temporal, "values": found}
        for name, values in budget.items()
        if (found := _median(values)) > 0.0
    ]
    return {
        "sources": sources,
        "unit": "e-",
        "median_electrons": float(np.median(capture.electrons)),
        "saturation": saturation_of(result),
        "is_coarse": _median(budget["quantisation"]) > result.read_noise_e > 0.0,
        "read_e": result.read_noise_e,
    }, {}


def _median(values: Floats) -> float:
    """Return the median; without sorting of equal values, as of uniform electronics."""
    return float(values[0] if values.min() == values.max() else np.median(values))
