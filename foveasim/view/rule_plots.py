"""Broken design rules where they are: on the layout, a colour and a line of text for each rule."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.layout.drc.rules import Report, RuleResult
from foveasim.view.plots import new_axes, plot_layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_report"]

#: Strong colours, one a rule, none of them among those of bare shapes.
RULE_COLOURS = ("#d62728", "#1f5fd0", "#c218b8", "#e07b00", "#0a8a5a", "#6a3fb5", "#8a5a2b", "#008ba3")
#: Of each rule the worst violations are drawn, and these have their values beside them when there are few in all.
MOST_SHOWN, MOST_TEXTS = 2000, 40
#: Circles of the first rule, in points; each further rule's are wider, so that several at one place can be told apart.
CIRCLE_PT, CIRCLE_STEP_PT = 9.0, 4.0
#: How far below the axes the rules stand: under their numbers and their label.
LEGEND_BELOW_PT = 36.0
#: Room around the markers where no layout is given, as a fraction of their extent.
ROOM_SHARE = 0.1


def plot_report(
    report: Report, layout: Layout | None = None, *, ax: Axes | None = None, figure_inches: float = 8.0
) -> Axes:
    """
    Draw the places where a layout breaks its design rules.

    Parameters
    ----------
    report : Report
        From :meth:`foveasim.Layout.check`.
    layout : Layout, optional
        The layout that was checked, drawn below.
    ax : matplotlib axes, optional
        New ones by default.
    figure_inches : float
        Longer side of a new figure.

    Returns
    -------
    matplotlib axes
        In µm. The shape and a circle for each place, in the colour of its rule; what was measured beside it, where there
        are at most 40 places; the rules with their worst values below. What is waived is dashed. Of each rule at most the
        worst 2,000 places are drawn.

    Raises
    ------
    ParameterError
        When the layout has another number of sites than was checked.
    """
    from matplotlib.transforms import ScaledTranslation

    if layout is not None and layout.n_sites != report.n_sites:
        raise ParameterError(
            "layout", f"must be the one that was checked, of {report.n_sites} sites", layout.n_sites, "sites"
        )
    broken = [result for result in report.results if len(result)]
    if layout is not None and layout.n_sites:
        ax = plot_layout(layout, ax=ax, figure_inches=figure_inches)
    else:
        ax = new_axes(figure_inches) if ax is None else ax
        ax.set_aspect("equal")
        ax.set(xlabel="x / µm", ylabel="y / µm")
    n_violations = sum(map(len, broken))
    corners = []
    for k, result in enumerate(broken):
        shown = result.violations[:MOST_SHOWN]
        markers = np.array([violation.marker for violation in shown], dtype=object)
        corners.append(shapely.total_bounds(markers))
        _draw_result(ax, result, markers, k)
        if n_violations <= MOST_TEXTS:
            for violation, place_um in zip(shown, _middles_um(markers), strict=True):
                text = f"{violation.value:.3g} {violation.unit}".strip()
                _write(ax, text, place_um, k)
    if layout is None and corners:
        low, high = np.min(corners, axis=0)[:2], np.max(corners, axis=0)[2:]
        room = ROOM_SHARE * max(float((high - low).max()), 1.0)
        ax.set_xlim(low[0] - room, high[0] + room)
        ax.set_ylim(low[1] - room, high[1] + room)
    n_kept = len(report.results) - len(broken)
    ax.set_title(
        f"{n_violations:,} violation{'s' * (n_violations != 1)} on {report.n_sites:,} photosites, "
        f"{n_kept} of {len(report.results)} rules kept",
        fontsize="medium",
    )
    if broken:
        below = ax.transAxes + ScaledTranslation(0.0, -LEGEND_BELOW_PT / 72.0, ax.figure.dpi_scale_trans)
        ax.legend(
            loc="upper left", bbox_to_anchor=(0.0, 0.0), bbox_transform=below, borderaxespad=0.0, fontsize="small",
            frameon=False, markerscale=CIRCLE_PT / (CIRCLE_PT + CIRCLE_STEP_PT * (len(broken) - 1)),
        )  # fmt: skip
    return ax


def _draw_result(ax: Axes, result: RuleResult, markers: NDArray[Any], k: int) -> None:
    """The shapes and the circles of one rule."""
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
    x_um, y_um = _middles_um(markers).T
    shown = "" if len(result) == len(markers) else f" (the worst {len(markers):,} are drawn)"
    ax.scatter(
        x_um, y_um, s=(CIRCLE_PT + k * CIRCLE_STEP_PT) ** 2, facecolors="none", edgecolors=colour, linewidths=1.4,
        linestyles=style, label=f"{result}{shown}", zorder=5,
    )  # fmt: skip


def _middles_um(markers: NDArray[Any]) -> NDArray[np.float64]:
    """The middles that the report's records give, (n, 2)."""
    return np.asarray(shapely.get_coordinates(shapely.centroid(markers)))


def _write(ax: Axes, text: str, place_um: NDArray[np.float64], k: int) -> None:
    """A text beside a place of the k-th broken rule, legible on any ground."""
    from matplotlib.patheffects import withStroke

    colour, beside_pt = RULE_COLOURS[k % len(RULE_COLOURS)], 0.4 * (CIRCLE_PT + k * CIRCLE_STEP_PT) + 2.0
    ax.annotate(
        text, (float(place_um[0]), float(place_um[1])), (beside_pt, beside_pt),
        textcoords="offset points", color=colour, fontsize=8, path_effects=[withStroke(linewidth=2.5, foreground="white")],
        zorder=6, annotation_clip=True,
    )  # fmt: skip
