"""From codes per site back to a raster picture."""

from __future__ import annotations

from foveasim.reconstruct.cells import Picture, cells, fill_channels, raster_grid

__all__ = ["Picture", "cells", "fill_channels", "raster_grid"]
