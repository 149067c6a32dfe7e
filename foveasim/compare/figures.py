"""Figures of a comparison: metrics against eccentricity, and area by size class."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim.compare.intervals import with_unit
from foveasim.errors import printable
from foveasim.metrics.registry import metric_info
from foveasim.view.web._report_page import style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

    from foveasim.compare.comparison import Comparison

__all__ = ["COLOURS", "draw_measure", "draw_sizes", "overview"]

#: Colours of the cameras, distinguishable with colour-vision deficiencies and on light and dark pages, and their markers.
COLOURS = ("#2f7fd6", "#e0862a", "#1f9e77", "#c95fb0", "#8a8f2e", "#c8474b", "#7a68d8", "#4aa3b5")
MARKERS = "osD^vP*X"
MAX_NAME = 28
#: Entry of the bands in a legend.
BAND = "95 % interval"


def draw_measure(comparison: Comparison, name: str, axes: Axes) -> None:
    """Draw a metric of all cameras against eccentricity, with its 95 % intervals."""
    info = metric_info(name)
    intervals = comparison.summary(name, by_eccentricity=True)
    r_um = 0.5 * (comparison.edges_um[1:] + comparison.edges_um[:-1])
    is_labelled = False
    for k, interval in enumerate(zip(*intervals, strict=True)):
        is_finite = np.isfinite(interval[0])
        x, y, low, high = (part[is_finite] for part in (r_um, *interval))
        axes.plot(x, y, linewidth=1.6, markersize=4, **_line_of(comparison, k))
        if info.has_scene and np.isfinite(high - low).any():
            colour = COLOURS[k % len(COLOURS)]
            axes.fill_between(
                x, low, high, color=colour, alpha=0.16, linewidth=0.0, label=None if is_labelled else BAND
            )
            is_labelled = True
    finite = intervals.median[np.isfinite(intervals.median)]
    if info.is_logarithmic and finite.size and (finite > 0.0).all():
        axes.set_yscale("log")
        axes.set_ylim(0.6 * finite.min(), 1.6 * finite.max())
        _label_plainly(axes.yaxis)
    axes.set_xlabel("eccentricity / µm")
    axes.set_ylabel(with_unit(info.title, info.unit))
    axes.set_xlim(0.0, comparison.edges_um[-1])


def draw_sizes(comparison: Comparison, axes: Axes) -> None:
    """Draw the area fraction of each size class of all cameras."""
    for k, name in enumerate(comparison.names):
        rows = comparison.sizes[name]
        size_um = [row["size_um"] for row in rows]
        fraction = [100.0 * row["area_fraction"] for row in rows]
        axes.vlines(size_um, 0.0, fraction, color=COLOURS[k % len(COLOURS)], linewidth=2.2, alpha=0.7)
        axes.plot(size_um, fraction, markersize=5, linewidth=0.8, **_line_of(comparison, k))
    axes.set_xscale("log")
    _label_plainly(axes.xaxis)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("site size / µm")
    axes.set_ylabel("area / %")


def overview(comparison: Comparison) -> NDArray[Any]:
    """Draw all metrics against eccentricity, and the size classes, on new axes."""
    from matplotlib import rc_context

    from foveasim.view.plots.figures import new_figure

    with rc_context({"text.parse_math": False}):
        draws = [
            *(partial(draw_measure, comparison, name) for name in comparison.metrics),
            partial(draw_sizes, comparison),
        ]
        n_columns = 3
        n_rows = math.ceil(len(draws) / n_columns)
        figure = new_figure((4.3 * n_columns, 2.9 * n_rows))
        axes: NDArray[Any] = figure.subplots(n_rows, n_columns).ravel()
        for draw, one in zip(draws, axes[: len(draws)], strict=True):
            draw(one)
            style_axes(one, "black", "0.9")
        for one in axes[len(draws) :]:
            one.set_visible(False)
        entries = {
            label: handle for one in axes for handle, label in zip(*one.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            list(entries.values()), list(entries), loc="outside upper center", ncols=len(entries), frameon=False
        )
    return axes[: len(draws)]


def _label_plainly(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, without the markup of powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}" if value < 1e6 else f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _line_of(comparison: Comparison, k: int) -> dict[str, Any]:
    """Return colour, marker and label of a camera."""
    name = printable(comparison.names[k])
    label = name if len(name) <= MAX_NAME else name[: MAX_NAME - 1] + "…"
    return {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)], "label": label}
