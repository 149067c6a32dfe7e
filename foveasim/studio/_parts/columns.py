"""Values of the photosites."""

from __future__ import annotations

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, part
from foveasim.view.web._content import describe_sites


@part("Values of the photosites", capture_of, order=1)
def columns(result: Simulated) -> PartData:
    """Return the columns of the photosites: codes, electrons, signal to noise, filters."""
    about, arrays, _ = describe_sites(result.capture, sensor=result.shot.camera.sensor)
    return {key: about[key] for key in ("columns", "filter", "notes")}, arrays
