"""Two-dimensional plots on matplotlib axes."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, check_choice, check_per_site, unmasked
from foveasim._io.atomic import atomic_write
from foveasim.capture import Capture
from foveasim.errors import FileError, ParameterError
from foveasim.layout import Layout, readout_order
from foveasim.view.id_map import site_at
from foveasim.view.plots.figures import FIGURE_INCHES, new_axes
from foveasim.view.site_colours import BACKGROUND, BOUNDARY, CATEGORY_COLOURS, SiteColours, as_fractions, colours_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import Collection
    from matplotlib.figure import Figure

    from foveasim.camera import Camera
    from foveasim.fields import PowerMap
    from foveasim.scene import Scene

__all__ = [
    "plot_angular_response",
    "plot_capture",
    "plot_curves",
    "plot_layout",
    "plot_noise_budget",
    "save_drawing",
    "save_figure",
]

#: Layouts of more sites are drawn as an image, which is faster than outlines.
MAX_OUTLINES = 4000
#: Layouts of more sites are not drawn with their adjacency, which would be illegible and slow to compute.
MAX_ADJACENCY_SITES = 50_000
#: Drawings of more sites open slowly in all viewers.
MAX_DRAWING_SITES = 20_000
#: Sizes that differ by a smaller fraction are equal.
SAME_SIZE = 1e-6
#: Brightness of readout lines relative to the category colours of their sites.
LINE_BRIGHTNESS = 0.55


def plot_layout(
    layout: Layout,
    by: str | ArrayLike | None = None,
    *,
    label: str = "",
    overlay: str | Sequence[str] = (),
    scale_bar: bool = True,
    legend: bool = True,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw photosites, filled by a value or a colour.

    Parameters
    ----------
    layout : Layout
    by : str or array, optional
        ``"channel"``, ``"area_um2"``, ``"size_um"``, ``"readout_line"`` or any other column; one value per site, NaN for no
        data; or a colour per site (n_site, 3). By default only the shapes. See :func:`foveasim.view.colours_of`.
    label : str
        Quantity and unit of an array.
    overlay : str or sequence of str
        ``"readout_lines"``: a line through the site centres in readout order, starting at a dot. ``"adjacency"``: a line
        between the centres of any two sites that share an edge.
    scale_bar : bool
        Whether to draw a scale bar.
    legend : bool
        Whether to draw a colour bar or a legend.
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In µm, x to the right and y up. In a window, the status bar shows the site under the mouse.

    Raises
    ------
    ParameterError
        When a column does not exist, the array does not have one row per site, or the layout does not support an overlay.

    Notes
    -----
    Up to 4,000 sites are drawn as outlines, which remain vector graphics in files. Larger layouts are drawn as an image, which
    is sampled again after each zoom and at the resolution of a saved file. Its boundaries are anti-aliased with 3 x 3 samples
    per pixel.

    Examples
    --------
    >>> import foveasim as fs
    >>> axes = fs.view.plot_layout(
    ...     fs.layout.hexagonal(n_columns=9, n_rows=9, pitch_um=3.0), "area_um2"
    ... )
    >>> axes.get_xlabel()
    'x / µm'
    """
    return _plot(layout, colours_of(layout, by, label=label), overlay, scale_bar, legend, ax, figure_inches)


def plot_capture(
    capture: Capture,
    by: str | ArrayLike = "code",
    *,
    label: str = "",
    overlay: str | Sequence[str] = (),
    scale_bar: bool = True,
    legend: bool = True,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw the photosites of a capture, coloured by their measured values.

    Parameters
    ----------
    capture : Capture
    by : str or array
        ``"code"``, ``"electrons"``, ``"expected_e"``, ``"snr"`` or another column of the capture
        (:meth:`Capture.column`), or any value that :func:`plot_layout` accepts.
    label, overlay, scale_bar, legend, ax, figure_inches
        As for :func:`plot_layout`.

    Returns
    -------
    matplotlib axes
        On a colour mosaic each site has the colour of its filter, scaled by its value.

    Raises
    ------
    ParameterError
        As for :func:`plot_layout`, or as for :meth:`Capture.signal_to_noise`.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=16, n_y=16, pitch_um=3.45), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> axes = fs.view.plot_capture(
    ...     camera.capture(scene, exposure_s="auto", seed=0), "electrons"
    ... )
    >>> axes.get_xlabel()
    'x / µm'
    """
    return _plot(capture.layout, colours_of(capture, by, label=label), overlay, scale_bar, legend, ax, figure_inches)


def plot_angular_response(camera: Camera, light: Scene | PowerMap, *, ax: Axes | None = None) -> Axes:
    """
    Draw the response of photosites to uniform light against their image height.

    Parameters
    ----------
    camera : Camera
        Sensor with ``pixel_optics``; without, all responses are 1.
    light : Scene or PowerMap
        As for :meth:`foveasim.Camera.angular_response`.
    ax : matplotlib axes, optional
        New axes by default.

    Returns
    -------
    matplotlib axes
        A point per site, whose colour is the size of the site where sizes differ.

    Examples
    --------
    >>> import foveasim as fs
    >>> stack = fs.sensor.ApertureStack(height_um=4.0, refractive_index=1.5)
    >>> layout = fs.layout.log_polar(n_sectors=24, r_min_um=20.0, r_max_um=200.0, n_rings=9)
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8),
    ...     sensor=fs.Sensor(layout, pixel_optics=stack),
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> axes = fs.view.plot_angular_response(camera, scene)
    >>> axes.get_xlabel(), axes.get_ylabel()
    ('image height / µm', 'response to uniform light')
    """
    ax = new_axes(7.0, 0.64) if ax is None else ax
    height_um, size_um = camera.incidence(light).image_height_um, camera.layout.size_um
    has_sizes = np.ptp(size_um) > SAME_SIZE * size_um.max()
    points = ax.scatter(height_um, camera.angular_response(light), s=6.0, c=size_um if has_sizes else None)
    if has_sizes:
        ax.figure.colorbar(points, ax=ax, label="site size / µm")
    ax.set(xlabel="image height / µm", ylabel="response to uniform light")
    ax.grid(visible=True, alpha=0.3)
    return ax


def plot_noise_budget(
    noise_e: Mapping[str, Floats], *, classes: ArrayLike | None = None, ax: Axes | None = None
) -> Axes:
    """
    Draw the noise budget as a dot for the RMS of every source, temporal ones on top.

    Parameters
    ----------
    noise_e : mapping of (n_site,) arrays, e-
        From :func:`foveasim.sensor.noise_budget`.
    classes : (n_site,) integers, optional
        Sites with the same number share dots, for example a column of sizes or the channel; by default all sites do.
    ax : matplotlib axes, optional
        New axes by default.

    Returns
    -------
    matplotlib axes

    Raises
    ------
    ParameterError
        When there is not one class per site.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), read_noise_e=5.0, prnu_fraction=0.01
    ... )
    >>> budget = fs.sensor.noise_budget(sensor, np.full(64, 1e5), 0.01)
    >>> axes = fs.view.plot_noise_budget(budget)
    >>> axes.get_xlabel(), [label.get_text() for label in axes.get_yticklabels()]
    ('noise / e- rms', ['photon_shot', 'read', 'quantisation', 'prnu'])
    """
    ax = new_axes(7.0, 0.64) if ax is None else ax
    if not noise_e:
        raise ParameterError("noise_e", "must contain at least one source of noise")
    n_sites = next(iter(noise_e.values())).size
    labels = np.zeros(n_sites, np.int64) if classes is None else np.asarray(unmasked("classes", classes))
    check_per_site("classes", labels, n_sites)
    shown = {name: values for name, values in noise_e.items() if np.any(values > 0.0)}
    groups = np.unique(labels)
    for group in groups:
        rms_e = [float(np.sqrt(np.mean(values[labels == group] ** 2))) for values in shown.values()]
        # Dots: the length of a bar would depend on where a logarithmic axis begins.
        ax.plot(rms_e, range(len(shown)), "o", markersize=7, label=None if groups.size == 1 else f"class {group}")
    ax.set_yticks(range(len(shown)), list(shown))
    ax.set_ylim(len(shown) - 0.5, -0.5)
    ax.set_xscale("log")
    ax.grid(color="0.85")
    ax.set_axisbelow(True)
    ax.set_xlabel("noise / e- rms")
    if groups.size > 1:
        ax.legend()
    return ax


def plot_curves(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    x_label: str,
    y_label: str,
    *,
    logarithmic: Literal["", "x", "y", "xy"] = "",
    marker: str = "",
    ax: Axes | None = None,
) -> Axes:
    """
    Draw curves with labelled axes, such as results of :mod:`foveasim.metrics`.

    Parameters
    ----------
    curves : mapping of str to (x, y)
        Points of each curve by its name in the legend; an empty name for a single curve.
    x_label, y_label : str
        Quantity and unit.
    logarithmic : {"", "x", "y", "xy"}
        Axes with logarithmic scales, on which values <= 0 are not drawn.
    marker : str
        Marker of matplotlib at each point.
    ax : matplotlib axes, optional
        New axes by default.

    Returns
    -------
    matplotlib axes

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> frequency_per_mm = np.linspace(0.0, 300.0, 31)
    >>> lenses = {f"f/{n}": fs.Optics(focal_length_mm=8.0, f_number=n) for n in (2.8, 8.0)}
    >>> curves = {
    ...     name: (frequency_per_mm, lens.mtf(frequency_per_mm, 550.0))
    ...     for name, lens in lenses.items()
    ... }
    >>> axes = fs.view.plot_curves(curves, "spatial frequency / (1/mm)", "MTF")
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['f/2.8', 'f/8.0']
    """
    ax = new_axes(7.0, 0.64) if ax is None else ax
    for name, (x, y) in curves.items():
        ax.plot(x, y, marker=marker, label=name)
    if "x" in logarithmic:
        ax.set_xscale("log")
    if "y" in logarithmic:
        ax.set_yscale("log")
    ax.set(xlabel=x_label, ylabel=y_label)
    ax.grid(visible=True, alpha=0.3)
    if any(curves):
        ax.legend()
    return ax


def save_figure(figure: Figure, path: str | Path, dpi: float = 150.0) -> None:
    """
    Write a figure atomically.

    Raises
    ------
    FileError
        When the format is unknown, or the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> figure = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0).plot().figure
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     fs.view.save_figure(figure, Path(directory, "layout.pdf"))
    ...     print(Path(directory, "layout.pdf").read_bytes()[:4])
    b'%PDF'
    """
    # A few percent larger than at the default level 6, in half the time.
    options: dict[str, Any] = {"pil_kwargs": {"compress_level": 1}} if Path(path).suffix.lower() == ".png" else {}
    # Encoded in memory: on a full disk some encoders leave a partial file.
    encoded = io.BytesIO()
    with atomic_write(path) as temporary:
        try:
            figure.savefig(encoded, format=Path(path).suffix[1:].lower() or None, dpi=dpi, **options)
        except ValueError as error:
            raise FileError(path, f"cannot be written in this format: {' '.join(str(error).split())}") from None
        temporary.write_bytes(encoded.getbuffer())


def save_drawing(data: Layout | Capture, path: str | Path, by: str | ArrayLike | None = None) -> None:
    """
    Write a layout or a capture as an SVG drawing: one path per site, in µm, without axes.

    Parameters
    ----------
    data : Layout or Capture
    path : str or Path
        With the extension ``.svg``.
    by : str or array, optional
        Quantity shown by the colours; see :func:`foveasim.view.colours_of`.

    Raises
    ------
    ParameterError
        When there are more than 20,000 sites.
    FileError
        When the extension is another, or the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "layout.svg")
    ...     fs.view.save_drawing(
    ...         fs.layout.hexagonal(n_columns=4, n_rows=4, pitch_um=3.0), path
    ...     )
    ...     print(path.read_text("utf-8").count("<path"))
    16
    """
    layout = data.layout if isinstance(data, Capture) else data
    rgb = colours_of(data, by).rgb
    if Path(path).suffix.lower() != ".svg":
        raise FileError(path, "must end in .svg")
    if layout.n_sites > MAX_DRAWING_SITES:
        raise ParameterError(
            "data",
            f"must have at most {MAX_DRAWING_SITES:,} sites for a drawing, got {layout.n_sites:,}",
            hint="save a picture with save_figure, or draw a part of the layout",
        )
    colours, position = np.unique(rgb, axis=0, return_inverse=True)
    names = {k: "#{:02x}{:02x}{:02x}".format(*colour) for k, colour in enumerate(colours.tolist())}
    layout.with_columns(channel=position.ravel()).write(path, colours=names)


def _plot(
    layout: Layout,
    colours: SiteColours,
    overlay: str | Sequence[str],
    scale_bar: bool,
    legend: bool,
    ax: Axes | None,
    figure_inches: float,
) -> Axes:
    from foveasim.view._artists import ScaleBar, SiteImage

    overlays = [overlay] if isinstance(overlay, str) else overlay
    draw_over = [OVERLAYS[check_choice("overlay", name, OVERLAYS)] for name in overlays]
    x_min, y_min, x_max, y_max = layout.bounds_um
    if ax is None:
        ax = new_axes(figure_inches, (y_max - y_min) / (x_max - x_min))
    find: Callable[[float, float], int] = partial(site_at, layout)
    if layout.n_sites <= MAX_OUTLINES:
        ax.add_collection(_coloured_outlines(layout, colours))
    else:
        image = SiteImage(ax, layout, colours)
        ax.add_image(image)
        image.set_clip_path(ax.patch)
        find = image.site_at
    for draw in draw_over:
        draw(layout, ax)
    if scale_bar:
        ax.add_artist(ScaleBar())
    ax.set_xlim(x_min, x_max)
    ax.set_ylim(y_min, y_max)
    ax.set_aspect("equal")
    ax.set_facecolor(as_fractions(BACKGROUND))
    ax.set_xlabel("x / µm")
    ax.set_ylabel("y / µm")
    if legend:
        _add_legend(ax, colours)

    def format_coord(x: float, y: float) -> str:  # matplotlib calls with these names
        return _format_site(layout, colours, x, y, find(x, y))

    ax.format_coord = format_coord  # type: ignore[method-assign]
    return ax


def _add_legend(ax: Axes, colours: SiteColours) -> None:
    """Add a colour bar for a scale, or a legend for categories."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import PowerNorm
    from matplotlib.patches import Patch

    if colours.scale is not None:
        scale = colours.scale
        shown = ScalarMappable(PowerNorm(scale.gamma, scale.low, scale.high), scale.colour_map)
        ax.figure.colorbar(shown, ax=ax, label=colours.title, shrink=0.8, aspect=30.0, pad=0.02)
    elif colours.legend:
        patches = [Patch(facecolor=as_fractions(rgb), edgecolor="0.4", label=name) for name, rgb in colours.legend]
        ax.legend(handles=patches, title=colours.title or None, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    elif colours.values is not None:
        n_values = np.unique(colours.values).size
        ax.set_title(f"{colours.title or 'kind'}: {n_values} in {len(CATEGORY_COLOURS)} colours", fontsize="medium")


def _format_site(layout: Layout, colours: SiteColours, x_um: float, y_um: float, site: int) -> str:
    """Return the status bar text for the point under the mouse."""
    position = f"x = {x_um:.6g} µm, y = {y_um:.6g} µm"
    if site < 0:
        return position
    size_um = float(layout[[site]].size_um[0])
    text = f"{position}: site {site}, size {size_um:.4g} µm"
    if colours.values is None or colours.title == "size / µm":
        return text
    value = colours.values[site]
    name, _, unit = colours.title.partition(" / ")
    number = f"{value:.6g}" if colours.values.dtype.kind == "f" else str(value)
    return f"{text}, {name or 'value'} {number}{' ' if unit else ''}{unit}"


def _coloured_outlines(layout: Layout, colours: SiteColours) -> Collection:
    """
    Return all sites as one collection.

    Polygons if no site has a hole, which matplotlib draws faster, otherwise paths.
    """
    from matplotlib.collections import PathCollection, PolyCollection
    from matplotlib.path import Path as Outline

    style: dict[str, Any] = {"facecolors": colours.rgb / 255.0, "linewidths": 0.3}
    style["edgecolors"] = [as_fractions(BOUNDARY)] if colours.has_boundaries else "face"
    counts = np.diff(layout.ring_offsets)
    if counts.size == layout.n_sites:
        # One array if all sites have the same number of vertices: matplotlib accepts it, although its types ask for sequences.
        is_uniform = counts.size > 0 and bool(np.all(counts == counts[0]))
        rings: Any = (
            layout.xy_um.reshape(layout.n_sites, -1, 2)
            if is_uniform
            else np.split(layout.xy_um, layout.ring_offsets[1:-1])
        )
        return PolyCollection(rings, **style)
    outlines = []
    for site in range(layout.n_sites):  # matplotlib needs one object per site
        ids = range(layout.site_offsets[site], layout.site_offsets[site + 1])
        parts = [layout.xy_um[layout.ring_offsets[r] : layout.ring_offsets[r + 1]] for r in ids]
        outlines.append(Outline.make_compound_path(*(Outline(part, closed=False) for part in map(_close_ring, parts))))
    return PathCollection(outlines, **style)


def _close_ring(ring_um: Floats) -> Floats:
    return np.concatenate((ring_um, ring_um[:1]))


def _draw_readout_lines(layout: Layout, ax: Axes) -> None:
    """Draw a line through the site centres of each readout line, and a dot at its start."""
    from matplotlib.collections import LineCollection

    line = layout.index_column("readout_line")
    ordered = layout if "readout_order" in layout.columns else readout_order(layout)
    order = np.lexsort((ordered.index_column("readout_order"), line))
    starts = np.flatnonzero(np.diff(line[order], prepend=-1))
    colours = [as_fractions(CATEGORY_COLOURS[k % len(CATEGORY_COLOURS)], LINE_BRIGHTNESS) for k in line[order][starts]]
    through_um = layout.centroid_um[order]
    ax.add_collection(LineCollection(np.split(through_um, starts[1:]), colors=colours, linewidths=1.2))
    ax.scatter(
        through_um[starts, 0], through_um[starts, 1], s=20.0, c=colours, edgecolors="white", linewidths=0.6, zorder=3
    )


def _draw_adjacency(layout: Layout, ax: Axes) -> None:
    """Draw a line between the centres of any two sites that share an edge."""
    from matplotlib.collections import LineCollection

    if layout.n_sites > MAX_ADJACENCY_SITES:
        raise ParameterError(
            "overlay",
            f"must not be 'adjacency' above {MAX_ADJACENCY_SITES:,} sites, got {layout.n_sites:,}",
            hint="draw a part of the layout",
        )
    pairs = layout.adjacency().tocoo()
    is_once = pairs.row < pairs.col
    ends_um = layout.centroid_um[np.stack((pairs.row[is_once], pairs.col[is_once]), axis=1)]
    ax.add_collection(LineCollection(list(ends_um), colors="#202020", linewidths=0.9))


#: Overlays by their names.
OVERLAYS: Mapping[str, Callable[[Layout, Axes], None]] = {
    "readout_lines": _draw_readout_lines,
    "adjacency": _draw_adjacency,
}
