"""Plots and approximate colours of scenes, power maps and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import POSITIVE
from foveasim._core.validation import Floats, check_count
from foveasim._io.mapped_files import in_memory
from foveasim.errors import ParameterError
from foveasim.fields import Grid, PowerMap, to_file_rows
from foveasim.reconstruct import CorticalImage, Picture
from foveasim.scene import Scene
from foveasim.sensor import rgb_filters
from foveasim.units import encode_srgb
from foveasim.view.plots.figures import FIGURE_INCHES, new_axes
from foveasim.view.site_colours import BACKGROUND, as_fractions

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "cortical_pixels",
    "picture_pixels",
    "plot_cortical",
    "plot_image",
    "plot_picture",
    "plot_power_map",
    "plot_scene",
    "power_map_pixels",
    "scene_pixels",
]

#: Pixels along the longer side of a plot; larger rasters are averaged.
PLOT_PIXELS = 1600
#: Filter transmission below which bands have no colour, such as those of infrared.
MIN_TRANSMISSION = 1e-3
#: Number of labelled radii of a log-polar image.
RADIUS_LABELS = 7
#: Units of the axes of scenes: the smallest in which the longer side is below a thousand.
LENGTH_UNITS = (("µm", 1.0), ("mm", 1e3), ("m", 1e6), ("km", 1e9))


def plot_scene(scene: Scene, *, ax: Axes | None = None, figure_inches: Annotated[float, FIGURE_INCHES] = 8.0) -> Axes:
    """
    Draw a scene in approximate colours.

    Parameters
    ----------
    scene : Scene
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In the plane of the scene, centred on the optical axis; in pixels for a scene with ``fit``, whose size depends on the
        camera. The colours are those of a camera with generic RGB filters
        (:func:`foveasim.rgb_filters`), balanced for equal radiance in all bands, sRGB-encoded; grey outside the visible range.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.slanted_edge(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, luminance_cd_m2=100.0
    ... )
    >>> fs.view.plot_scene(scene).get_xlabel()
    'x / mm'
    """
    n_y, n_x = scene.basis.shape[1:]
    unit, per_pixel = "pixels", 1.0
    if scene.pitch_um is not None:
        size_um = max(n_x, n_y) * scene.pitch_um
        unit, um = next((u for u in LENGTH_UNITS if size_um < 1e3 * u[1]), LENGTH_UNITS[-1])
        per_pixel = scene.pitch_um / um
    half_x, half_y = 0.5 * n_x * per_pixel, 0.5 * n_y * per_pixel
    ax = new_axes(figure_inches, n_y / n_x) if ax is None else ax
    ax.imshow(scene_pixels(scene, PLOT_PIXELS), extent=(-half_x, half_x, -half_y, half_y))
    ax.set(xlabel=f"x / {unit}", ylabel=f"y / {unit}")
    return ax


def plot_power_map(
    power_map: PowerMap,
    band: int | None = None,
    *,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw the irradiance of a power map.

    Parameters
    ----------
    power_map : PowerMap
    band : int, optional
        Index of a wavelength band; by default the sum of all bands.
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In µm, with a colour bar in W/m².

    Raises
    ------
    ParameterError
        When there is no such band.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> power_map = fs.Optics(focal_length_mm=8.0, f_number=2.8).power_map(scene)
    >>> axes = fs.view.plot_power_map(power_map)
    >>> axes.figure.axes[1].get_ylabel()  # of the colour bar
    'irradiance / (W/m²)'
    """
    n_bands = power_map.data.shape[0]
    if band is not None:
        band = check_count("band", band, at_least=0, at_most=n_bands - 1)
    shown = power_map.data if band is None else power_map.data[band : band + 1]
    irradiance_w_m2 = block_means(shown, PLOT_PIXELS).sum(axis=0)
    label = "irradiance / (W/m²)" if band is None else f"irradiance at {power_map.wavelength_nm[band]:g} nm / (W/m²)"
    return _draw_values(irradiance_w_m2, power_map.grid.bounds_um, label, "viridis", ax, figure_inches)


def plot_picture(
    picture: Picture,
    white: Annotated[float | Floats | None, POSITIVE] = None,
    *,
    encode_srgb: bool = True,
    channel: int | None = None,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw a picture.

    Parameters
    ----------
    picture : Picture
    white, encode_srgb
        Of colour pictures, as for :meth:`foveasim.Picture.to_image`.
    channel : int, optional
        Draws the values of one channel, with a colour bar, as for pictures of one channel. Required for pictures of neither
        1 nor 3 channels.
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In µm; transparent where no photosite lies.

    Raises
    ------
    ParameterError
        When there is no such channel, or as for :meth:`foveasim.Picture.to_image`.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=8, n_y=8, pitch_um=2.0)
    >>> picture = fs.reconstruct.cells(
    ...     layout, layout.area_um2, fs.Grid.centred((16, 16), 1.0)
    ... )
    >>> fs.view.plot_picture(picture).get_ylabel()
    'y / µm'
    """
    n_channels = picture.data.shape[0]
    if n_channels == 3 and channel is None:
        x0, y0, x1, y1 = picture.grid.bounds_um
        ax = new_axes(figure_inches, (y1 - y0) / (x1 - x0)) if ax is None else ax
        ax.imshow(picture.to_image(white, encode_srgb=encode_srgb), extent=(x0, x1, y0, y1))
        ax.set(xlabel="x / µm", ylabel="y / µm", facecolor=as_fractions(BACKGROUND))
        return ax
    if n_channels > 1 and channel is None:
        raise ParameterError("channel", f"must be given for a picture of {n_channels} channels")
    channel = check_count("channel", 0 if channel is None else channel, at_least=0, at_most=n_channels - 1)
    return _draw_values(picture.data[channel], picture.grid.bounds_um, "value", "gray", ax, figure_inches)


def plot_image(
    values: NDArray[Any],
    bounds: ArrayLike,
    x_label: str,
    y_label: str,
    *,
    label: str = "",
    colour_map: str = "viridis",
    ratio: float | None = None,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw an array as an image with labelled axes.

    Parameters
    ----------
    values : (n_y, n_x), or (n_y, n_x, 3 or 4) uint8
        Lowest row first; numbers have a colour bar, NaN is transparent.
    bounds : (x_min, y_min, x_max, y_max)
        Outer edges of the image in the units of the axes.
    x_label, y_label : str
        Quantity and unit of the axes.
    label : str
        Quantity and unit of the values.
    colour_map : str
        Name of a matplotlib colour map.
    ratio : float, optional
        Height over width of the image; by default x and y have the same scale.
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> values = np.random.default_rng(0).random((20, 30))
    >>> axes = fs.view.plot_image(
    ...     values,
    ...     (0.0, 0.0, 3.0, 2.0),
    ...     "time / s",
    ...     "frequency / Hz",
    ...     label="power",
    ...     ratio=0.5,
    ... )
    >>> [text.get_ylabel() for text in axes.figure.axes]  # image and colour bar
    ['frequency / Hz', 'power']
    """
    x0, y0, x1, y1 = np.asarray(bounds, np.float64).tolist()
    height_over_width = (y1 - y0) / (x1 - x0)
    ax = new_axes(figure_inches, ratio or height_over_width) if ax is None else ax
    aspect = 1.0 if ratio is None else ratio / height_over_width
    image = ax.imshow(values[::-1], cmap=colour_map, extent=(x0, x1, y0, y1), aspect=aspect)
    if np.ndim(values) == 2:
        ax.figure.colorbar(image, ax=ax, label=label, shrink=0.8, aspect=30.0, pad=0.02)
    ax.set(xlabel=x_label, ylabel=y_label, facecolor=as_fractions(BACKGROUND))
    return ax


def plot_cortical(
    image: CorticalImage,
    channel: int | None = None,
    *,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw a log-polar image: angles along x, rings along y, the innermost ring at the bottom.

    Parameters
    ----------
    image : CorticalImage
    channel : int, optional
        Draws the values of one channel, with a colour bar, as for images of one channel. Required for images of neither 1 nor
        3 channels; images of 3 channels are shown in colours.
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In degrees and rings, with radii as labels of the rings. Staggered rings are shifted by half a sector.

    Raises
    ------
    ParameterError
        When there is no such channel.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(n_sectors=32, n_rings=8, r_min_um=10.0, r_max_um=60.0)
    >>> image = fs.reconstruct.cortical(layout, layout.size_um)
    >>> fs.view.plot_cortical(image).get_xlabel()
    'angle / degrees'
    """
    n_channels, n_rings, n_sectors = image.data.shape
    if n_channels not in (1, 3) and channel is None:
        raise ParameterError("channel", f"must be given for an image of {n_channels} channels")
    if n_channels == 3 and channel is None:
        values: NDArray[Any] = cortical_pixels(image, PLOT_PIXELS)[::-1]
    else:
        shown = check_count("channel", 0 if channel is None else channel, at_least=0, at_most=n_channels - 1)
        values = _unrolled(image)[shown]
    bounds = (0.0, 0.0, 360.0, float(n_rings))
    ax = plot_image(
        values, bounds, "angle / degrees", "radius / µm", label="value", colour_map="gray",
        ratio=min(1.0, max(0.25, n_rings / n_sectors)), ax=ax, figure_inches=figure_inches,
    )  # fmt: skip
    ticks = np.unique(np.linspace(0, n_rings, min(n_rings, RADIUS_LABELS - 1) + 1).round().astype(int))
    ax.set_yticks(ticks, [f"{image.radius_um[k]:.3g}" for k in ticks])
    ax.set_xticks(np.arange(0.0, 361.0, 60.0))
    return ax


def _draw_values(
    values: NDArray[Any],
    bounds_um: tuple[float, float, float, float],
    label: str,
    colour_map: str,
    ax: Axes | None,
    figure_inches: float,
) -> Axes:
    """Draw values in the sensor plane, lowest row first, with a colour bar."""
    return plot_image(
        values, bounds_um, "x / µm", "y / µm", label=label, colour_map=colour_map, ax=ax, figure_inches=figure_inches
    )


# -- pixels of thumbnails and plots ---------------------------------------------------------------------------------------


def scene_pixels(scene: Scene, max_pixels: int) -> NDArray[np.uint8]:
    """
    Return approximate colours of a scene.

    ``max_pixels``: pixels along the longer side, at most; larger scenes are averaged. Returns ``pixels`` (n_y, n_x, 3) uint8:
    sRGB-encoded, top row first; white is the brightest value.
    """
    weights = scene.spectrum_w_m2_sr_nm @ _colour_weights(scene.wavelength_nm)
    basis = scene.basis
    means = [block_means(in_memory(basis[b : b + 1]), max_pixels)[0] for b in range(basis.shape[0])]
    return _encode(np.tensordot(weights, means, (0, 0)))


def power_map_pixels(power_map: PowerMap, max_pixels: int) -> NDArray[np.uint8]:
    """Return approximate colours of a power map, as :func:`scene_pixels`."""
    weights = _colour_weights(power_map.wavelength_nm)
    return _encode(np.tensordot(weights, block_means(power_map.data, max_pixels), (0, 0)))


def picture_pixels(picture: Picture, max_pixels: int) -> NDArray[np.uint8]:
    """
    Return a picture as sRGB-encoded pixels, averaged to a smaller size.

    The result is (n_y, n_x, 2 or 4) uint8, with alpha.
    """
    data, coverage = block_means(picture.data, max_pixels), block_means(picture.coverage[np.newaxis], max_pixels)[0]
    smaller = Picture(data, coverage, picture.grid, picture.white, picture.colour_matrix)
    return np.asarray(smaller.to_image(), np.uint8)


def cortical_pixels(image: CorticalImage, max_pixels: int) -> NDArray[np.uint8]:
    """
    Return a log-polar image as sRGB-encoded pixels with alpha, the outermost ring first.

    Larger ones are averaged. There are two pixels per sector, so that staggered rings are shifted.
    """
    data = block_means(_unrolled(image), max_pixels)
    coverage = np.isfinite(data).all(axis=0).astype(np.float32)
    grid = Grid(coverage.shape, 1.0, (0.0, 0.0))
    picture = Picture(data.astype(np.float32), coverage, grid, image.white, image.colour_matrix)
    return np.asarray(picture.to_image(), np.uint8)


def _unrolled(image: CorticalImage) -> NDArray[Any]:
    """Return the rings at equal angles from 0 to 360 degrees, (n_channel, n_ring, 2 n_sector)."""
    n_rings, n_sectors = image.data.shape[1:]
    position = 0.5 * np.arange(2 * n_sectors) + 0.25 - image.start_rad[:, np.newaxis] * (n_sectors / (2.0 * np.pi))
    return np.asarray(image.data[:, np.arange(n_rings)[:, np.newaxis], np.floor(position).astype(int) % n_sectors])


def block_means(images: NDArray[Any], max_pixels: int) -> NDArray[Any]:
    """
    Return images (n, n_y, n_x) averaged over square blocks.

    The longer side of the result has at most ``max_pixels``. NaN means missing data. The remainder at the end of rows and
    columns, less than a block, is omitted.
    """
    n_images, n_y, n_x = images.shape
    side = -(-max(n_y, n_x) // max_pixels)
    if side == 1:
        return images
    side_y, side_x = min(side, n_y), min(side, n_x)
    n_y, n_x = n_y // side_y, n_x // side_x
    blocks = images[:, : n_y * side_y, : n_x * side_x].reshape(n_images, n_y, side_y, n_x, side_x)
    means = blocks.mean(axis=(2, 4))
    if np.isnan(means).any():
        has_data = ~np.isnan(blocks)
        count = has_data.sum(axis=(2, 4))
        with np.errstate(invalid="ignore"):
            means = np.where(has_data, blocks, 0.0).sum(axis=(2, 4)) / np.where(count, count, np.nan)
    return np.asarray(means, images.dtype)


def _colour_weights(wavelength_nm: Floats) -> Floats:
    """Return weights of the bands in red, green and blue, (n_wavelength, 3)."""
    transmission = rgb_filters().transmission(wavelength_nm)
    total = transmission.sum(axis=1, keepdims=True)
    if wavelength_nm.size == 1 or total.min() < MIN_TRANSMISSION:
        return np.full((wavelength_nm.size, 3), 1.0 / wavelength_nm.size)
    return np.asarray((transmission / total).T)


def _encode(rgb: NDArray[Any]) -> NDArray[np.uint8]:
    """Return linear channels (3, n_y, n_x) as sRGB pixels, top row first."""
    fraction = np.clip(rgb / (float(rgb.max(initial=0.0)) or 1.0), 0.0, 1.0)
    return np.ascontiguousarray(np.rint(255.0 * to_file_rows(encode_srgb(fraction))).astype(np.uint8))
