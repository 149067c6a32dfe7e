"""Colours of photosites by measured value, filter, size or any column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, as_numbers, finite_array, frozen_array, unmasked, words_and_unit
from foveasim.capture import Capture
from foveasim.columns import MAIN, find_column
from foveasim.errors import ParameterError, type_name
from foveasim.layout import Layout
from foveasim.reconstruct.picture import NO_DATA_COLOUR
from foveasim.units import decode_srgb, encode_srgb

__all__ = [
    "BACKGROUND",
    "BOUNDARY",
    "CATEGORY_COLOURS",
    "FILTER_COLOURS",
    "NO_DATA",
    "ColourScale",
    "SiteColours",
    "as_fractions",
    "colours_of",
    "decode_light",
    "encode_light",
    "site_colours",
    "title_of",
]

#: Values within this relative difference are equal up to rounding, and have one colour.
EQUAL_TOLERANCE = 1e-9
#: Colours as red, green and blue from 0 to 255, sRGB-encoded.
Rgb: TypeAlias = tuple[int, int, int]
RgbArray: TypeAlias = NDArray[np.uint8]

#: Colours of filters by name.
FILTER_COLOURS: Mapping[str, Rgb] = {
    "R": (255, 64, 51), "G": (77, 230, 77), "B": (77, 115, 255), "W": (255, 255, 255), "C": (64, 220, 230),
    "M": (235, 80, 220), "Y": (245, 225, 60), "IR": (150, 60, 90), "NIR": (150, 60, 90), "all": (255, 255, 255),
}  # fmt: skip
#: Channel names of a layout without filters, in the order of :func:`foveasim.layout.mosaic`.
CHANNEL_NAMES = "RGBW"
#: Colours of categories, of medium brightness, so that lines and text on them are legible.
CATEGORY_COLOURS: tuple[Rgb, ...] = (
    (86, 140, 200), (236, 160, 60), (70, 165, 130), (205, 95, 80), (150, 120, 190),
    (130, 195, 225), (190, 180, 70), (225, 145, 185), (140, 110, 90), (150, 155, 160),
)  # fmt: skip
#: Pale shades of sites without values; neighbours mostly differ.
SHADES: tuple[Rgb, ...] = ((222, 226, 232), (202, 209, 218), (232, 228, 219), (212, 219, 212), (236, 236, 238))
#: Areas without photosites, as in picture files.
BACKGROUND: Rgb = NO_DATA_COLOUR
#: Boundaries between sites.
BOUNDARY: Rgb = (64, 64, 64)
#: Sites without a value (NaN): in none of the colour maps in use.
NO_DATA: Rgb = (217, 140, 150)
#: Colour maps of measured signals, and of other columns: the latter is perceptually uniform and colour-blind safe.
GREY, VIRIDIS = "gray", "viridis"
#: Exponent of values before they scale a filter colour on a mosaic, so that dark sites are distinguishable.
DISPLAY_GAMMA = 1.0 / 2.2
#: Integers with more distinct values are shown on a scale, and strings without a legend.
MAX_CATEGORIES = 10


@dataclass(frozen=True, slots=True)
class ColourScale:
    """
    Value range and colour map of a colour bar.

    Attributes
    ----------
    low, high : float
        Values at the ends of the colour map, ``low < high``.
    colour_map : str
        Name of a matplotlib colour map.
    gamma : float
        Exponent of a value's fraction of the scale.
    """

    low: float
    high: float
    colour_map: str
    gamma: float = 1.0

    def colours(self, values: Floats) -> RgbArray:
        """
        Return the colours of values on the scale.

        ``values`` (...) float64: values outside the scale have the colour of its end, NaN that of no data. Returns ``rgb``
        (..., 3) uint8.
        """
        from matplotlib import colormaps

        table = np.rint(255.0 * colormaps[self.colour_map](np.arange(256))[:, :3]).astype(np.uint8)
        table = np.concatenate((table, np.array([NO_DATA], np.uint8)))
        step = np.asarray(values - self.low, np.float64)
        step /= self.high - self.low
        np.clip(step, 0.0, 1.0, out=step)
        if self.gamma != 1.0:
            step **= self.gamma
        step *= 256.0
        np.minimum(step, 255.0, out=step)
        np.copyto(step, 256.0, where=np.isnan(step))
        return table.take(step.astype(np.intp), axis=0)


@dataclass(frozen=True, eq=False, slots=True)
class SiteColours:
    """
    Colours of photosites with their scale or legend.

    Attributes
    ----------
    rgb : (n_site, 3) uint8
        Red, green, blue, sRGB-encoded.
    title : str
        Quantity and unit, such as ``"area / µm²"``; empty for bare shapes.
    values : (n_site,) array or None
        Value of each site: numbers or strings.
    scale : ColourScale or None
        Scale of the colour bar of numerical values.
    legend : tuple of (str, (r, g, b))
        Names and colours of categories; empty if there are too many.
    has_boundaries : bool
        Whether boundaries between sites are drawn; not for measured signals and given colours.
    is_on_scale : bool
        Whether the colours are those of the scale; on a mosaic they are filter colours scaled by the values.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(n_sectors=32, n_rings=8, r_min_um=10.0, r_max_um=60.0)
    >>> colours = fs.view.colours_of(layout, "size_um")
    >>> colours.title, colours.rgb.shape
    ('size / µm', (256, 3))
    """

    rgb: RgbArray
    title: str = ""
    values: NDArray[Any] | None = None
    scale: ColourScale | None = None
    legend: tuple[tuple[str, Rgb], ...] = ()
    has_boundaries: bool = True
    is_on_scale: bool = False

    __repr__ = short_repr


def as_fractions(rgb: Rgb, factor: float = 1.0) -> tuple[float, float, float]:
    """Return a colour as fractions from 0 to 1, as in matplotlib, multiplied by a factor."""
    red, green, blue = (factor * c / 255.0 for c in rgb)
    return red, green, blue


def decode_light(rgb: NDArray[Any]) -> Floats:
    """Return sRGB bytes as linear light from 0 to 1."""
    return np.asarray(decode_srgb(np.arange(256) / 255.0)[rgb])


def encode_light(fraction: Floats) -> RgbArray:
    """Return linear light from 0 to 1 as sRGB bytes."""
    return np.rint(255.0 * encode_srgb(np.clip(fraction, 0.0, 1.0))).astype(np.uint8)


def site_colours(data: Layout | Capture, by: str | ArrayLike | None = None) -> RgbArray:
    """
    Return the RGB colours of photosites, (n_site, 3) uint8; see :func:`colours_of`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.mosaic(fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0), ["RG", "GB"])
    >>> fs.view.site_colours(layout, "channel").tolist()
    [[255, 64, 51], [77, 230, 77], [77, 230, 77], [77, 115, 255]]
    """
    return colours_of(data, by).rgb


def colours_of(data: Layout | Capture, by: str | ArrayLike | None = None, *, label: str = "") -> SiteColours:
    """
    Return a colour for each photosite, with its scale or legend.

    Parameters
    ----------
    data : Layout or Capture
    by : str or array, optional
        ``"code"``, ``"electrons"``, ``"expected_e"`` of a capture: in grey, or on a colour mosaic in the filter colours.
        ``"snr"`` and further :data:`~foveasim.columns.COLUMNS` of a capture. ``"channel"``: the colour of the filter; channels
        of a layout are R, G, B and W in this order. ``"area_um2"``, ``"size_um"`` (the square root of the area),
        ``"readout_line"`` or any other column. An array: one value per site, or a colour per site (n_site, 3), uint8 or from 0
        to 1. By default the code of a capture, or the bare shapes of a layout.
    label : str
        Quantity and unit of an array; replaces the title of a named column.

    Returns
    -------
    SiteColours

    Raises
    ------
    ParameterError
        When a column does not exist, there is not one value per site, or a value is infinite.

    Notes
    -----
    Strings, booleans and integers with at most ten distinct values are categories, with a legend. Readout lines are always
    categories; their colours repeat. Other numbers are shown on a scale from their smallest to their largest value. NaN is no
    data.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> colours_of(grid(n_x=2, n_y=1, pitch_um=3.0), [0.0, 1.0]).rgb.tolist()
    [[68, 1, 84], [253, 231, 37]]
    """
    capture = data if isinstance(data, Capture) else None
    layout = data if capture is None else capture.layout
    if not isinstance(layout, Layout):
        raise ParameterError("data", f"must be a Layout or a Capture, got {type_name(data)}")
    if by is None and capture is None:
        return SiteColours(np.array(SHADES, np.uint8)[_pseudo_random(layout.n_sites, len(SHADES))])
    by = MAIN if by is None else by
    if not isinstance(by, str):
        return _array_colours(by, layout.n_sites, label)
    if by == "channel" or (by == "filter_of_site" and capture is not None):
        names = _channel_names(layout) if capture is None else capture.filter_names
        return _filters(layout.channel if capture is None else capture.filter_of_site, names, label or "filter")
    values, info = find_column("by", by, layout, capture)
    title = label or info.heading
    if capture is not None and info.is_signal:
        return _signal_colours(capture, np.asarray(values, np.float64), title)
    is_categorical = by == "readout_line" or _is_categorical(values)
    return _categories(values, title) if is_categorical else _continuous(values.astype(np.float64), title, VIRIDIS)


def title_of(name: str) -> str:
    """Return the title of a column: its name in words and its unit, ``"area / µm²"``."""
    words, unit = words_and_unit(name)
    return f"{words} / {unit}" if unit else words


def _array_colours(by: ArrayLike, n_sites: int, label: str) -> SiteColours:
    """Return the colours of an array of values, or given colours."""
    by = unmasked("by", by, missing_is_nan=True)
    try:
        array = frozen_array(np.asarray(by))
    except ValueError:
        raise ParameterError("by", "must have one value for each site", by) from None
    if array.ndim == 0 or array.shape[0] != n_sites or array.shape[1:] not in ((), (3,)):
        raise ParameterError("by", f"must have one row for each of the {n_sites} sites, got {array.shape}")
    if array.ndim == 2:
        is_bytes = array.dtype == np.uint8
        given = array / 255.0 if is_bytes else np.clip(finite_array("by", array), 0.0, 1.0)
        return SiteColours(np.rint(255.0 * given).astype(np.uint8), label, has_boundaries=False)
    if array.dtype.kind == "U" or _is_categorical(array):
        return _categories(array, label)
    return _continuous(as_numbers("by", array), label, VIRIDIS)


def _signal_colours(capture: Capture, values: Floats, title: str) -> SiteColours:
    """Return measured values in shades of grey, or of the filter of each site."""
    if len(capture.filter_names) == 1:
        return _continuous(values, title, GREY)
    base = np.array([_filter_colour(k, name) for k, name in enumerate(capture.filter_names)], np.float64)
    high = max(float(values.max(initial=0.0)), 1.0)
    bright = base[capture.filter_of_site] * ((values / high) ** DISPLAY_GAMMA)[:, np.newaxis]
    scale = ColourScale(0.0, high, GREY, DISPLAY_GAMMA)
    return SiteColours(np.rint(bright).astype(np.uint8), title, values, scale, has_boundaries=False)


def _channel_names(layout: Layout) -> tuple[str, ...]:
    n_channels = int(layout.channel.max(initial=0)) + 1
    if n_channels == 1:
        return ("all",)
    return tuple(CHANNEL_NAMES[:n_channels]) if n_channels in (3, 4) else tuple(map(str, range(n_channels)))


def _filter_colour(position: int, name: str) -> Rgb:
    return FILTER_COLOURS.get(name, CATEGORY_COLOURS[position % len(CATEGORY_COLOURS)])


def _filters(channel: Ints, names: tuple[str, ...], title: str) -> SiteColours:
    colours = [_filter_colour(k, name) for k, name in enumerate(names)]
    legend = tuple(zip(names, colours, strict=True)) if len(names) <= MAX_CATEGORIES else ()
    return SiteColours(np.array(colours, np.uint8)[channel], title, np.array(names)[channel], None, legend)


def _is_categorical(values: NDArray[Any]) -> bool:
    if values.dtype.kind not in "iu":
        return values.dtype.kind in "bU"
    # The range is checked first: np.unique is slow for a million different numbers.
    span = int(values.max(initial=0)) - int(values.min(initial=0))
    return span < 2**16 and np.unique(values).size <= MAX_CATEGORIES


def _categories(values: NDArray[Any], title: str) -> SiteColours:
    names, kind = np.unique(values, return_inverse=True)
    # Integers select the colour directly, so that readout lines have the same colours in any part of a layout.
    if names.dtype.kind in "iu":
        kind = values.astype(np.int64)
    kind = kind % len(CATEGORY_COLOURS)
    colours = np.array(CATEGORY_COLOURS, np.uint8)
    legend = []
    if names.size <= MAX_CATEGORIES:
        first = [int(np.flatnonzero(values == name)[0]) for name in names]
        legend = [(str(name), CATEGORY_COLOURS[kind[i]]) for name, i in zip(names, first, strict=True)]
    return SiteColours(colours[kind], title, values, None, tuple(legend))


def _continuous(values: Floats, title: str, colour_map: str) -> SiteColours:
    """
    Return colours of a colour map from the smallest value to the largest.

    Equal values have the colour at the centre of the map.
    """
    has_data = ~np.isnan(values)
    if np.isinf(values).any():
        raise ParameterError("by", "must be finite everywhere, or NaN for no data", values)
    low = float(values.min(where=has_data, initial=np.inf)) if has_data.any() else 0.0
    high = float(values.max(where=has_data, initial=-np.inf)) if has_data.any() else 0.0
    if high - low <= EQUAL_TOLERANCE * max(abs(low), abs(high)):
        low, high = low - 0.5, high + 0.5
    scale = ColourScale(low, high, colour_map)
    has_boundaries = colour_map != GREY
    return SiteColours(scale.colours(values), title, values, scale, has_boundaries=has_boundaries, is_on_scale=True)


def _pseudo_random(n: int, n_values: int) -> Ints:
    """Return reproducible pseudo-random integers below ``n_values`` (MurmurHash3 finaliser)."""
    mixed = np.arange(n, dtype=np.uint64)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        mixed = ((mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)) & np.uint64(0xFFFFFFFF)
    return (mixed % np.uint64(n_values)).astype(np.int64)
