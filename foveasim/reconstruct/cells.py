"""Pictures of what a sensor saw: every raster pixel takes the value of the photosites under it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from foveasim.arrays import Floats, Images, Ints, check_count, finite_array
from foveasim.encodings import encoded_srgb
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid, PackedRings, to_file_rows
from foveasim.integrate import Integrator
from foveasim.pictures import write_picture
from foveasim.rings import site_moments

__all__ = ["Picture", "cells", "fill_channels", "raster_grid"]

#: Sites whose values stand in for a colour that a site does not see.
NEIGHBOURS = 4
#: A raster pixel covered by less than this share is touched by rounding only.
NO_COVERAGE = 1e-9


@dataclass(frozen=True, eq=False)
class Picture:
    """
    A raster picture of per-site values.

    Attributes
    ----------
    data : (n_channel, n_y, n_x) float32
        Values in the sites' unit, row 0 lowest; NaN where no photosite is: no data is not black.
    coverage : (n_y, n_x) float32
        Share of each pixel that photosites cover.
    grid : Grid
        The pixels, in the sensor plane.
    """

    data: Images
    coverage: Images
    grid: Grid

    def to_image(self, white: float | Floats | None = None, *, encode_srgb: bool = False) -> NDArray[np.uint8]:
        """
        The picture as 8-bit numbers for a file or a screen, first row on top.

        Parameters
        ----------
        white : number or (n_channel,), optional
            Values that become 255; the largest value by default.
        encode_srgb : bool
            Whether the values are linear light and are to be encoded as a screen expects.

        Returns
        -------
        image : (n_y, n_x, n_channel + 1) uint8
            Grey or colour, and the coverage as alpha: where no photosite is, the picture is transparent.

        Raises
        ------
        ParameterError
            When the picture has neither 1 nor 3 channels, or white is not positive.
        """
        if self.data.shape[0] not in (1, 3):
            raise ParameterError("data", f"must have 1 or 3 channels to be shown, got {self.data.shape[0]}")
        if white is None:
            white = float(np.nanmax(self.data, initial=0.0)) or 1.0
        levels = finite_array("white", white, above=0.0)
        if levels.ndim > 1 or levels.size not in (1, self.data.shape[0]):
            raise ParameterError(
                "white", f"must be one number, or one for each of the {self.data.shape[0]} channels", white
            )
        share = np.clip(np.nan_to_num(self.data) / levels.reshape(-1, 1, 1), 0.0, 1.0)
        if encode_srgb:
            share = encoded_srgb(share)
        layers = np.concatenate((share, np.clip(self.coverage, 0.0, 1.0)[np.newaxis]))
        return np.ascontiguousarray(np.rint(255.0 * to_file_rows(layers)).astype(np.uint8))

    def save(self, path: str | Path, white: float | Floats | None = None, *, encode_srgb: bool = False) -> None:
        """Write :meth:`to_image` to a file (``.png``), whole or not at all."""
        write_picture(path, self.to_image(white, encode_srgb=encode_srgb))


def cells(layout: PackedRings, values: Floats, grid: Grid, *, n_threads: int | None = None) -> Picture:
    """
    Raster picture in which every pixel has the mean of the sites that it shows, weighted by area.

    Parameters
    ----------
    layout : Layout
    values : (n_site,) or (n_channel, n_site)
    grid : Grid
        The picture's pixels.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    Picture
        ``Wᵀ values / Wᵀ 1`` with the exact overlaps W of sites and pixels: borders are smooth, a flat field stays flat.
    """
    integrator = Integrator(layout, grid, n_threads=n_threads)
    channels = np.atleast_2d(finite_array("values", values))
    covered_um2 = integrator.spread(np.ones(integrator.n_sites))
    is_seen = covered_um2 > NO_COVERAGE * grid.cell_area_um2
    with np.errstate(invalid="ignore", divide="ignore"):
        data = np.where(is_seen, integrator.spread(channels) / covered_um2, np.nan)
    return Picture(data.astype(np.float32), (covered_um2 / grid.cell_area_um2).astype(np.float32), grid)


def fill_channels(layout: PackedRings, values: Floats, channel: Ints, n_channels: int) -> Floats:
    """
    Every channel's value at every site of a colour mosaic.

    Parameters
    ----------
    layout : Layout
    values : (n_site,)
    channel : (n_site,) int
    n_channels : int

    Returns
    -------
    filled : (n_channel, n_site) float64
        A site's own value in its own channel; in the others the mean of the nearest sites of that channel, weighted by
        the inverse of their distance. NaN for a channel without sites.
    """
    from scipy.spatial import cKDTree

    _, centroid_um = site_moments(layout.xy_um, layout.ring_offsets, layout.site_offsets)
    filled = np.full((n_channels, values.size), np.nan)
    for c in range(n_channels):
        own = np.flatnonzero(channel == c)
        if own.size == 0:
            continue
        distance_um, nearest = cKDTree(centroid_um[own]).query(
            centroid_um, k=np.arange(1, min(NEIGHBOURS, own.size) + 1)
        )
        weight = 1.0 / np.maximum(distance_um, 1e-12)
        filled[c] = (values[own][nearest] * weight).sum(axis=1) / weight.sum(axis=1)
        filled[c, own] = values[own]
    return filled


def raster_grid(layout: PackedRings, max_pixels: int) -> Grid:
    """Grid of square pixels over the layout, the longer side ``max_pixels`` long."""
    max_pixels = check_count("max_pixels", max_pixels, at_most=2**15)
    if layout.xy_um.size == 0:
        raise GeometryError("the layout has no sites, and so no picture")
    low, high = layout.xy_um.min(axis=0), layout.xy_um.max(axis=0)
    pitch_um = float((high - low).max()) / max_pixels
    n_x, n_y = (max(1, math.ceil(length / pitch_um - 1e-6)) for length in high - low)
    middle = 0.5 * (low + high)
    origin_um = (float(middle[0] - 0.5 * n_x * pitch_um), float(middle[1] - 0.5 * n_y * pitch_um))
    return Grid((n_y, n_x), pitch_um, origin_um)
