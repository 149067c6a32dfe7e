"""Reconstruction of raster pictures from photosite values."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.reconstruct.cells import cells, fill_channels
from foveasim.reconstruct.colour import ColourCorrection
from foveasim.reconstruct.cortical import CorticalImage, cortical, from_cortical, to_cortical
from foveasim.reconstruct.estimates import SiteEstimates, electrons_per_code, estimate_from_charge, estimate_from_code
from foveasim.reconstruct.interpolation import linear, natural
from foveasim.reconstruct.least_squares import least_squares
from foveasim.reconstruct.picture import Picture, raster_grid
from foveasim.reconstruct.rasters import blur_kernel, reference
from foveasim.reconstruct.unwrap import unwrap

__all__ = [
    "ColourCorrection",
    "CorticalImage",
    "Picture",
    "SiteEstimates",
    "blur_kernel",
    "cells",
    "cortical",
    "electrons_per_code",
    "estimate_from_charge",
    "estimate_from_code",
    "fill_channels",
    "from_cortical",
    "least_squares",
    "linear",
    "natural",
    "raster_grid",
    "reference",
    "to_cortical",
    "unwrap",
]

publish(__name__)
