"""Outlines of the photosites."""

from __future__ import annotations

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, layout_of, part
from foveasim.view.web._content import describe_sites, outlines_of


@part("Photosites", layout_of, order=0)
def sites(result: Simulated) -> PartData:
    """Return the outlines of the photosites."""
    about, _, layout = describe_sites(result.capture.layout)
    return {key: about[key] for key in ("n_sites", "bounds_um", "palette")}, outlines_of(layout)
