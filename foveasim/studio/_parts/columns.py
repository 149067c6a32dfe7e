"""Values of the photosites."""

from __future__ import annotations

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, part
from foveasim.view.web._content import describe_sites, signals_of


@part("Values of the photosites", capture_of, order=1)
def columns(result: Simulated) -> PartData:
    """Return the columns of the photosites: codes, filters, and those of the layout."""
    about, arrays, _ = describe_sites(result.capture, has_signals=False)
    return {key: about[key] for key in ("columns", "filter", "notes")}, arrays


@part("Signals of the photosites", capture_of, order=2, is_lazy=True)
def signals(result: Simulated) -> PartData:
    """Return further columns: electrons and signal to noise."""
    return {}, signals_of(result.capture, result.shot.camera.sensor)
