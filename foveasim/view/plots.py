"""Two-dimensional plots on matplotlib axes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim.arrays import Floats, check_choice, finite_array
from foveasim.capture import Capture
from foveasim.errors import FileError, ParameterError
from foveasim.files import written_whole
from foveasim.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import Collection
    from matplotlib.figure import Figure

__all__ = ["plot_capture", "plot_layout", "plot_noise_budget", "save_figure"]

#: Colours of filters by their names; others take matplotlib's cycle.
FILTER_COLOURS = {"R": (1.0, 0.25, 0.2), "G": (0.3, 0.9, 0.3), "B": (0.3, 0.45, 1.0), "all": (1.0, 1.0, 1.0)}
#: Codes are raised to this power before they scale a colour, so that dark sites can be told apart.
DISPLAY_GAMMA = 1.0 / 2.2


def plot_layout(
    layout: Layout,
    values: Floats | None = None,
    *,
    label: str = "",
    colours: Floats | None = None,
    ax: Axes | None = None,
    figure_inches: float = 8.0,
) -> Axes:
    """
    Draw photosites, filled by a value or a colour each.

    Parameters
    ----------
    layout : Layout
    values : (n_site,), optional
        Shown in a colour map with a colour bar.
    label : str
        Of the colour bar, with its unit.
    colours : (n_site, 3), optional
        Red, green, blue from 0 to 1, in the place of values.
    ax : matplotlib axes, optional
        New ones by default.
    figure_inches : float
        Side of a new figure.

    Returns
    -------
    matplotlib axes
        In µm, x to the right and y up.

    Raises
    ------
    ParameterError
        When the arrays do not have one row a site.
    """
    from matplotlib.figure import Figure

    if ax is None:
        ax = Figure(figsize=(figure_inches, figure_inches), layout="constrained").add_subplot()
    for name, array in (("values", values), ("colours", colours)):
        if array is not None and np.shape(array)[:1] != (layout.n_sites,):
            raise ParameterError(
                name, f"must have one row for each of the {layout.n_sites} sites, got {np.shape(array)}"
            )
    sites = _outlines(layout)
    if colours is not None:
        sites.set_facecolor([tuple(c) for c in np.clip(finite_array("colours", colours, ndim=2), 0.0, 1.0)])
    elif values is not None:
        sites.set_array(finite_array("values", values, ndim=1))
        sites.set_cmap("gray")
    else:
        sites.set_facecolor("none")
        sites.set_edgecolor("black")
    ax.add_collection(sites)
    if values is not None and colours is None:
        ax.figure.colorbar(sites, ax=ax, label=label, shrink=0.8)
    x_min, y_min, x_max, y_max = layout.bounds_um
    ax.set_xlim(x_min, x_max)
    ax.set_ylim(y_min, y_max)
    ax.set_aspect("equal")
    ax.set_facecolor("#b9c4d6")  # what no photosite covers is neither black nor white
    ax.set_xlabel("x / µm")
    ax.set_ylabel("y / µm")
    return ax


def plot_capture(capture: Capture, *, of: str = "code", ax: Axes | None = None) -> Axes:
    """
    Draw the photosites of a capture, coloured by what they measured.

    Parameters
    ----------
    capture : Capture
    of : {"code", "electrons", "expected_e"}
    ax : matplotlib axes, optional
        New ones by default.

    Returns
    -------
    matplotlib axes
        On a colour mosaic each site has its filter's colour, as bright as its value.
    """
    check_choice("of", of, ("code", "electrons", "expected_e"))
    values = np.asarray(getattr(capture, of), dtype=np.float64)
    unit = "DN" if of == "code" else "e-"
    if len(capture.filter_names) == 1:
        return plot_layout(capture.layout, values, label=f"{of} / {unit}", ax=ax)
    base = np.array([FILTER_COLOURS.get(name, (1.0, 1.0, 1.0)) for name in capture.filter_names])
    share = (values / max(float(values.max(initial=0.0)), 1.0)) ** DISPLAY_GAMMA
    return plot_layout(capture.layout, colours=base[capture.filter_of_site] * share[:, np.newaxis], ax=ax)


def plot_noise_budget(
    noise_e: Mapping[str, Floats], *, classes: ArrayLike | None = None, ax: Axes | None = None
) -> Axes:
    """
    Draw the noise budget as bars: the root of the mean square of every source, temporal sources above fixed ones.

    Parameters
    ----------
    noise_e : mapping of (n_site,) arrays, e-
        From :func:`foveasim.sensor.noise_budget`.
    classes : (n_site,) integers, optional
        Sites of the same number share bars, such as a column of sizes or the channel; by default all do.
    ax : matplotlib axes, optional
        New ones by default.

    Returns
    -------
    matplotlib axes

    Raises
    ------
    ParameterError
        When there is not one class a site.
    """
    from matplotlib.figure import Figure

    if ax is None:
        ax = Figure(figsize=(7.0, 4.5), layout="constrained").add_subplot()
    n_sites = next(iter(noise_e.values())).size
    labels = np.zeros(n_sites, np.int64) if classes is None else np.asarray(classes)
    if labels.shape != (n_sites,):
        raise ParameterError("classes", f"must be one for each of the {n_sites} sites, got {labels.shape}")
    shown = {name: values for name, values in noise_e.items() if np.any(values > 0.0)}
    kinds = np.unique(labels)
    for k, kind in enumerate(kinds):
        sizes_e = [float(np.sqrt(np.mean(values[labels == kind] ** 2))) for values in shown.values()]
        places = np.arange(len(shown)) + (k - 0.5 * (kinds.size - 1)) * 0.8 / kinds.size
        ax.barh(places, sizes_e, height=0.8 / kinds.size, label=None if kinds.size == 1 else f"class {kind}")
    ax.set_yticks(range(len(shown)), list(shown))
    ax.invert_yaxis()
    ax.set_xscale("log")
    ax.set_xlabel("noise / e- rms")
    if kinds.size > 1:
        ax.legend()
    return ax


def save_figure(figure: Figure, path: str | Path, dpi: float = 150.0) -> None:
    """
    Write a figure, whole or not at all.

    Raises
    ------
    FileError
        When nothing can be written there.
    """
    with written_whole(path) as temporary:
        try:
            figure.savefig(temporary, dpi=dpi)
        except ValueError as error:
            raise FileError(path, f"cannot be written in this format: {' '.join(str(error).split())}") from None


def _outlines(layout: Layout) -> Collection:
    """All sites as one collection: polygons where none has a hole, which matplotlib draws faster, else paths."""
    from matplotlib.collections import PathCollection, PolyCollection
    from matplotlib.path import Path as Outline

    style: dict[str, Any] = {"linewidths": 0.3, "edgecolors": "face"}
    counts = np.diff(layout.ring_offsets)
    if counts.size == layout.n_sites:
        # One array where all have as many vertices: matplotlib's types know sequences only, its code takes both.
        is_even = counts.size > 0 and bool(np.all(counts == counts[0]))
        rings: Any = (
            layout.xy_um.reshape(layout.n_sites, -1, 2)
            if is_even
            else np.split(layout.xy_um, layout.ring_offsets[1:-1])
        )
        return PolyCollection(rings, **style)
    outlines = []
    for site in range(layout.n_sites):  # matplotlib wants an object for each site
        ids = range(layout.site_offsets[site], layout.site_offsets[site + 1])
        parts = [layout.xy_um[layout.ring_offsets[r] : layout.ring_offsets[r + 1]] for r in ids]
        outlines.append(Outline.make_compound_path(*(Outline(part, closed=False) for part in map(_closed, parts))))
    return PathCollection(outlines, **style)


def _closed(ring_um: Floats) -> Floats:
    return np.concatenate((ring_um, ring_um[:1]))
