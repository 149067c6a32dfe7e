"""From codes per site back to a raster picture."""

from __future__ import annotations

from foveasim.reconstruct.cells import cells, fill_channels
from foveasim.reconstruct.interpolation import linear, natural
from foveasim.reconstruct.least_squares import least_squares
from foveasim.reconstruct.picture import Picture, raster_grid
from foveasim.reconstruct.rasters import blur_kernel, reference
from foveasim.reconstruct.readings import Readings, charge_readings, code_readings, electrons_per_code

__all__ = [
    "Picture",
    "Readings",
    "blur_kernel",
    "cells",
    "charge_readings",
    "code_readings",
    "electrons_per_code",
    "fill_channels",
    "least_squares",
    "linear",
    "natural",
    "raster_grid",
    "reference",
]
