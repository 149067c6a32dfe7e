"""
Pictures of photosites with area-correct pixels.

A pixel shows the mean over its area. Values on a colour scale are averaged and then mapped to a colour; all other colours are
averaged in linear light. Sites far smaller than a pixel therefore neither alias nor introduce colours that the colour map does
not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.rings import site_area_um2, site_bounds_um
from foveasim._core.validation import Bools, Floats, check_shape, unmasked
from foveasim.capture import Capture
from foveasim.errors import ParameterError
from foveasim.fields import Grid, PackedRings
from foveasim.integrate import Integrator
from foveasim.reconstruct.picture import raster_of
from foveasim.view.id_map import validate_bounds
from foveasim.view.site_colours import BACKGROUND, NO_DATA, Rgb, SiteColours, decode_light, encode_light

__all__ = ["SiteMeans", "cover", "picture_colours", "site_picture"]

#: Pixels that are drawn together: 32 MB per channel.
PIXELS_PER_BAND = 2**22
#: Fractions of a pixel up to this are rounding errors.
ROUNDING = 1e-9
#: Smallest number of filters of a colour capture, and number of colour channels of its picture.
N_COLOURS = 3


class SiteMeans:
    """
    Exact area-weighted means of photosite values over the pixels of a picture.

    Parameters
    ----------
    layout : Layout
        Sites without a positive area are left out.
    shape : (n_y, n_x)
        Numbers of pixels.
    bounds_um : (x_min, y_min, x_max, y_max), optional, µm
        Extent of the pixels; the bounds of the layout by default.
    n_threads : int, optional
        All cores by default; the result does not depend on it.

    Raises
    ------
    ParameterError
        When the shape or the bounds are invalid, or the layout has no sites and no bounds are given.
    """

    def __init__(
        self,
        layout: PackedRings,
        shape: tuple[int, int],
        bounds_um: Sequence[float] | Floats | None = None,
        *,
        n_threads: int | None = None,
    ) -> None:
        self.shape: tuple[int, int] = check_shape("shape", shape)
        self.bounds_um: tuple[float, float, float, float] = validate_bounds(layout, bounds_um)
        (n_y, n_x), (x_min, y_min, x_max, y_max) = self.shape, self.bounds_um
        self.n_sites: int = layout.site_offsets.size - 1
        pitch_um = ((x_max - x_min) / n_x, (y_max - y_min) / n_y)
        rings = (layout.xy_um, layout.ring_offsets, layout.site_offsets)
        reach_um, has_area = site_bounds_um(*rings), site_area_um2(*rings) > 0.0
        self._bands = []
        for first in range(0, n_y, max(1, PIXELS_PER_BAND // n_x)):
            n_rows = min(max(1, PIXELS_PER_BAND // n_x), n_y - first)
            grid = Grid((n_rows, n_x), pitch_um, (x_min, y_min + first * pitch_um[1]))
            low_um, high_um = grid.bounds_um[1], grid.bounds_um[3]
            is_near = has_area & (reach_um[:, 0] < x_max) & (reach_um[:, 2] > x_min)
            is_near &= (reach_um[:, 1] < high_um) & (reach_um[:, 3] > low_um)
            self._bands.append(_Band(layout, is_near, grid, first, n_threads))

    def picture(self, colours: SiteColours) -> NDArray[np.uint8]:
        """
        Return a picture of coloured sites.

        ``colours``: from :func:`foveasim.view.colours_of`. Returns ``picture`` (n_y, n_x, 4) uint8: red, green, blue, and the
        covered fraction as alpha; row 0 is the lowest y. Values on a colour scale are averaged and then mapped to a colour;
        other colours are averaged in linear light. Raises ParameterError when there is not one colour per site.
        """
        if colours.rgb.shape != (self.n_sites, 3):
            raise ParameterError(
                "colours", f"must have one colour for each of the {self.n_sites} sites, got {colours.rgb.shape[0]}"
            )
        picture = np.empty((*self.shape, 4), np.uint8)
        for band in self._bands:
            band.draw(colours, picture[band.rows])
        return picture


class _Band:
    """Sites on a band of rows of a picture."""

    def __init__(self, layout: PackedRings, is_near: Bools, grid: Grid, first_row: int, n_threads: int | None) -> None:
        part, self.sites = _select(layout, is_near)
        self.rows = slice(first_row, first_row + grid.shape[0])
        raster = raster_of(part, grid, "empty", n_threads)
        self.integrator = raster.sites
        self.alpha = np.rint(255.0 * raster.covered_fraction).astype(np.uint8)
        self.covered_um2 = np.where(raster.covered_fraction > 0.0, raster.covered_um2, np.inf)

    def means(self, values: Floats) -> Floats:
        """Return means (..., n_y, n_x) over the covered part of each pixel; 0 without sites."""
        return self.integrator.spread(values[..., self.sites]) / self.covered_um2

    def draw(self, colours: SiteColours, picture: NDArray[np.uint8]) -> None:
        """Write the band of a picture (n_y, n_x, 4)."""
        picture[..., 3] = self.alpha
        if not colours.is_on_scale or colours.scale is None or colours.values is None:
            picture[..., :3] = encode_light(np.moveaxis(self.means(decode_light(colours.rgb).T), 0, -1))
            return
        has_data = ~np.isnan(colours.values)
        if has_data.all():
            picture[..., :3] = colours.scale.colours(self.means(colours.values))
            return
        # A pixel that is partly without data mixes the colour of the mean value with that of missing data, by area.
        with_data, values = self.means(np.stack((has_data, np.where(has_data, colours.values, 0.0))))
        shown = colours.scale.colours(values / np.where(with_data > 0.0, with_data, np.inf))
        fraction = with_data[..., np.newaxis]
        mixed = fraction * decode_light(shown) + (1.0 - fraction) * decode_light(np.array(NO_DATA))
        picture[..., :3] = np.where(fraction >= 1.0 - ROUNDING, shown, encode_light(mixed))


def site_picture(
    layout: PackedRings,
    colours: SiteColours,
    shape: tuple[int, int],
    bounds_um: Sequence[float] | Floats | None = None,
    *,
    background: Rgb = BACKGROUND,
) -> NDArray[np.uint8]:
    """
    Return a picture of coloured sites on a background.

    Parameters
    ----------
    layout : Layout
    colours : SiteColours
        From :func:`foveasim.view.colours_of`.
    shape : (n_y, n_x)
        Numbers of pixels.
    bounds_um : (x_min, y_min, x_max, y_max), optional, µm
        Extent of the pixels; the bounds of the layout by default.
    background : (r, g, b)
        Colour of areas without sites.

    Returns
    -------
    picture : (n_y, n_x, 3) uint8
        Row 0 is the lowest y. A pixel shows the colour of the mean value of its sites, weighted by area; filters, categories
        and given colours are averaged in linear light.

    Raises
    ------
    ParameterError
        When the shape or the bounds are invalid, or there is not one colour per site.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> from foveasim.view import colours_of
    >>> pair = grid(n_x=2, n_y=1, pitch_um=3.0)
    >>> site_picture(pair, colours_of(pair, [0.0, 1.0]), (1, 1)).tolist()  # viridis at 0.5
    [[[33, 145, 140]]]
    """
    clear = SiteMeans(layout, shape, bounds_um).picture(colours)
    return cover(np.full((*clear.shape[:2], 3), background, np.uint8), clear[..., :3], clear[..., 3] / 255.0)


def colours_in_picture(capture: Capture) -> NDArray[np.uint8] | None:
    """Return the colours of photosites in their picture, (n_site, 3), or None if it is grey."""
    if len(capture.filter_names) < N_COLOURS:
        return None
    picture = capture.picture()
    image = picture.to_image()
    if image.shape[2] < N_COLOURS:
        return None
    return picture_colours(capture.layout, np.asarray(image[..., :N_COLOURS], np.uint8), picture.grid.bounds_um)


def picture_colours(
    layout: PackedRings, picture: ArrayLike, bounds_um: Sequence[float] | Floats | None = None
) -> NDArray[np.uint8]:
    """
    Return the mean colours of a photograph over the photosites.

    Parameters
    ----------
    layout : Layout
    picture : (n_y, n_x, 3) or (n_y, n_x) uint8
        sRGB or grey levels, top row first, such as ``np.asarray(PIL.Image.open(path).convert("RGB"))``.
    bounds_um : (x_min, y_min, x_max, y_max), optional, µm
        Extent of the picture; by default it covers the layout, centred and without distortion.

    Returns
    -------
    rgb : (n_site, 3) uint8
        Exact means in linear light, for ``by=`` of plots and columns; black for sites outside the picture.

    Raises
    ------
    ParameterError
        When the picture is not uint8 of this shape, or the bounds are invalid.

    Examples
    --------
    >>> import numpy as np
    >>> from foveasim.layout import grid
    >>> picture_colours(
    ...     grid(n_x=2, n_y=1, pitch_um=1.0), np.array([[[9, 8, 7], [255, 0, 0]]], np.uint8)
    ... ).tolist()
    [[9, 8, 7], [255, 0, 0]]
    """
    pixels = np.asarray(unmasked("picture", picture))
    if pixels.dtype != np.uint8 or pixels.size == 0 or (pixels.ndim != 2 and pixels.shape[2:] != (3,)):
        raise ParameterError(
            "picture", f"must be uint8 of shape (n_y, n_x, 3) or (n_y, n_x), got {pixels.dtype} of shape {pixels.shape}"
        )
    pixels = np.broadcast_to(pixels.reshape(*pixels.shape[:2], -1), (*pixels.shape[:2], 3))
    n_y, n_x = pixels.shape[:2]
    x_min, y_min, x_max, y_max = validate_bounds(layout, bounds_um)
    pitch_um = ((x_max - x_min) / n_x, (y_max - y_min) / n_y)
    if bounds_um is None:
        pitch_um = (max(pitch_um), max(pitch_um))
    centre_um = (0.5 * (x_min + x_max), 0.5 * (y_min + y_max))
    origin_um = (centre_um[0] - 0.5 * n_x * pitch_um[0], centre_um[1] - 0.5 * n_y * pitch_um[1])
    integrator = Integrator(layout, Grid((n_y, n_x), pitch_um, origin_um))
    light = integrator(np.moveaxis(decode_light(pixels[::-1]), -1, 0))
    covered_um2 = integrator(np.ones((n_y, n_x)))
    return encode_light((light / np.where(covered_um2 > 0.0, covered_um2, np.inf)).T)


def cover(under: NDArray[np.uint8], over: NDArray[np.uint8], weight: Floats) -> NDArray[np.uint8]:
    """
    Return a picture covered by another one in linear light.

    ``under``, ``over``: (n_y, n_x, 3) uint8. ``weight`` (n_y, n_x): from 0 to 1. Returns ``picture`` (n_y, n_x, 3) uint8:
    exactly one of the pictures where the weight is 0 or 1.
    """
    alpha = weight[..., np.newaxis]
    mixed = encode_light(alpha * decode_light(over) + (1.0 - alpha) * decode_light(under))
    return np.where(alpha == 0.0, under, np.where(alpha == 1.0, over, mixed))


def _select(layout: PackedRings, is_selected: Bools) -> tuple[PackedRings, NDArray[np.int64]]:
    """Return the packed rings of some sites, and their indices."""
    sites = np.flatnonzero(is_selected)
    if sites.size == is_selected.size:
        return layout, sites
    n_rings = np.diff(layout.site_offsets)
    keeps_ring = np.repeat(is_selected, n_rings)
    n_vertices = np.diff(layout.ring_offsets)
    return (
        SimpleNamespace(
            xy_um=np.ascontiguousarray(layout.xy_um[np.repeat(keeps_ring, n_vertices)]),
            ring_offsets=np.concatenate(([0], np.cumsum(n_vertices[keeps_ring]))),
            site_offsets=np.concatenate(([0], np.cumsum(n_rings[is_selected]))),
        ),
        sites,
    )
