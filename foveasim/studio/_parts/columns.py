"""Values of the photosites."""

from __future__ import annotations

from typing import Any

import numpy as np

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, part
from foveasim.view.web._content import describe_sites, signals_of

#: Column of the response to uniform light, which is sent with the signals.
RESPONSE: dict[str, Any] = {
    "key": "angular_response",
    "label": "angular response",
    "unit": "",
    "kind": "linear",
    "is_signal": True,
}


@part("Values of the photosites", capture_of, order=1)
def columns(result: Simulated) -> PartData:
    """Return the columns of the photosites: codes, filters, and those of the layout."""
    about, arrays, _ = describe_sites(result.capture, has_signals=False)
    if result.shot.camera.sensor.pixel_optics is not None:
        about["columns"].append(RESPONSE)
    return {key: about[key] for key in ("columns", "filter", "notes")}, arrays


@part("Signals of the photosites", capture_of, order=2, is_lazy=True)
def signals(result: Simulated) -> PartData:
    """Return further columns: electrons, signal to noise and angular response."""
    camera = result.shot.camera
    found = signals_of(result.capture, camera.sensor)
    if camera.sensor.pixel_optics is not None:
        found[RESPONSE["key"]] = camera.angular_response(result.shot.scene).astype(np.float32)
    return {}, found
