"""Plots of design rule violations, with one colour and one legend entry per rule."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.layout.drc.rules import Report, RuleResult
from foveasim.view.plots.figures import FIGURE_INCHES, new_axes
from foveasim.view.plots.sites import plot_layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_report"]

#: Saturated colours, one per rule, distinct from those of bare shapes.
RULE_COLOURS = ("#d62728", "#1f5fd0", "#c218b8", "#e07b00", "#0a8a5a", "#6a3fb5", "#8a5a2b", "#008ba3")
#: Number of violations that are drawn per rule, the worst first; and largest total number that is annotated with values.
MAX_SHOWN, MAX_ANNOTATIONS = 2000, 40
#: Circles of the first rule, in points; those of each further rule are wider, so that circles at one position differ.
CIRCLE_PT, CIRCLE_STEP_PT = 9.0, 4.0
#: Distance of the legend below the axes, clear of their tick labels and axis label.
LEGEND_BELOW_PT = 36.0
#: Length of the lines of the legend, so that they fit in the figure.
LEGEND_CHARACTERS_PER_INCH = 10
#: Margin around the markers if no layout is given, as a fraction of their extent.
MARGIN_FRACTION = 0.1


def plot_report(
    report: Report,
    layout: Layout | None = None,
    *,
    ax: Axes | None = None,
    figure_inches: Annotated[float, FIGURE_INCHES] = 8.0,
) -> Axes:
    """
    Draw the design rule violations of a layout.

    Parameters
    ----------
    report : Report
        From :meth:`foveasim.Layout.check`.
    layout : Layout, optional
        The checked layout, drawn below the violations; by default that of the report, if it has one.
    ax : matplotlib axes, optional
        New axes by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In µm. Each violation is drawn as its marker and a circle in the colour of its rule, with the measured value if there
        are at most 40 violations. The legend below lists the violated rules with their worst values. Waived violations are
        dashed. At most the worst 2,000 violations of each rule are drawn.

    Raises
    ------
    ParameterError
        When the number of sites differs from that of the checked layout.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    >>> report = layout.check(fs.DesignRules(min_size_um=2.5))
    >>> axes = fs.view.plot_report(report)
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['min_size_um: 16 violations, worst 2 µm, limit 2.5 µm']
    """
    from matplotlib.transforms import ScaledTranslation

    layout = report.layout if layout is None else layout
    if layout is not None and layout.n_sites != report.n_sites:
        raise ParameterError("layout", f"must be the checked layout of {report.n_sites} sites", layout.n_sites, "sites")
    violated = [result for result in report.results if len(result)]
    if layout is not None and layout.n_sites:
        ax = plot_layout(layout, ax=ax, figure_inches=figure_inches)
    else:
        ax = new_axes(figure_inches) if ax is None else ax
        ax.set_aspect("equal")
        ax.set(xlabel="x / µm", ylabel="y / µm")
    n_violations = sum(map(len, violated))
    corners = []
    for k, result in enumerate(violated):
        shown = result.worst_violations(MAX_SHOWN)
        markers = np.array([violation.marker for violation in shown], dtype=object)
        corners.append(shapely.total_bounds(markers))
        _draw_result(ax, result, markers, k)
        if n_violations <= MAX_ANNOTATIONS:
            for violation, position_um in zip(shown, _centres_um(markers), strict=True):
                text = f"{violation.value:.3g} {violation.unit}".strip()
                _annotate(ax, text, position_um, k)
    if layout is None and corners:
        low, high = np.min(corners, axis=0)[:2], np.max(corners, axis=0)[2:]
        margin = MARGIN_FRACTION * max(float((high - low).max()), 1.0)
        ax.set_xlim(low[0] - margin, high[0] + margin)
        ax.set_ylim(low[1] - margin, high[1] + margin)
    n_satisfied = len(report.results) - len(violated)
    ax.set_title(
        f"{n_violations:,} violation{'s' * (n_violations != 1)} on {report.n_sites:,} photosites, "
        f"{n_satisfied} of {len(report.results)} rules satisfied",
        fontsize="medium",
    )
    if violated:
        below = ax.transAxes + ScaledTranslation(0.0, -LEGEND_BELOW_PT / 72.0, ax.figure.dpi_scale_trans)
        ax.legend(
            loc="upper left", bbox_to_anchor=(0.0, 0.0), bbox_transform=below, borderaxespad=0.0, fontsize="medium",
            frameon=False, markerscale=CIRCLE_PT / (CIRCLE_PT + CIRCLE_STEP_PT * (len(violated) - 1)),
        )  # fmt: skip
    return ax


def _draw_result(ax: Axes, result: RuleResult, markers: NDArray[Any], k: int) -> None:
    """Draw the markers and circles of one rule."""
    from matplotlib.collections import LineCollection, PolyCollection

    colour = RULE_COLOURS[k % len(RULE_COLOURS)]
    style = "dashed" if result.waiver is not None else "solid"
    parts = shapely.get_parts(shapely.get_parts(markers))
    is_area = shapely.get_dimensions(parts) == 2
    outlines = [shapely.get_coordinates(ring) for ring in shapely.get_rings(parts[is_area])]
    lines = [shapely.get_coordinates(line) for line in parts[shapely.get_dimensions(parts) == 1]]
    solid = [shapely.get_coordinates(ring) for ring in shapely.get_exterior_ring(parts[is_area])]
    ax.add_collection(PolyCollection(solid, facecolors=colour, edgecolors="none", alpha=0.3, zorder=3))
    ax.add_collection(LineCollection(outlines + lines, colors=colour, linewidths=1.0, linestyles=style, zorder=4))
    x_um, y_um = _centres_um(markers).T
    shown = "" if len(result) == len(markers) else f" (the worst {len(markers):,} are drawn)"
    width = max(40, round(ax.figure.get_figure(root=True).get_size_inches()[0] * LEGEND_CHARACTERS_PER_INCH))
    ax.scatter(
        x_um, y_um, s=(CIRCLE_PT + k * CIRCLE_STEP_PT) ** 2, facecolors="none", edgecolors=colour, linewidths=1.4,
        linestyles=style, label=textwrap.fill(f"{result}{shown}", width), zorder=5,
    )  # fmt: skip


def _centres_um(markers: NDArray[Any]) -> NDArray[np.float64]:
    """Return the marker centroids, as in the records of the report, (n, 2)."""
    return np.asarray(shapely.get_coordinates(shapely.centroid(markers)))


def _annotate(ax: Axes, text: str, position_um: NDArray[np.float64], k: int) -> None:
    """Annotate a position of the k-th violated rule, legible on any background."""
    from matplotlib.patheffects import withStroke

    colour, offset_pt = RULE_COLOURS[k % len(RULE_COLOURS)], 0.4 * (CIRCLE_PT + k * CIRCLE_STEP_PT) + 2.0
    ax.annotate(
        text, (float(position_um[0]), float(position_um[1])), (offset_pt, offset_pt),
        textcoords="offset points", color=colour, fontsize=10, path_effects=[withStroke(linewidth=2.5, foreground="white")],
        zorder=6, annotation_clip=True,
    )  # fmt: skip
