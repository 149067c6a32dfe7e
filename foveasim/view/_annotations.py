"""Colour bars, legends and labels of parts next to rendered pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim.view.site_colours import Rgb, SiteColours, as_fractions

#: Height of text as a fraction of that of the picture, and its smallest number of pixels.
TEXT_FRACTION, MIN_TEXT_PX = 0.027, 12.0
#: Widths of a colour bar with its numbers, and of a character, in heights of text.
BAR_WIDTH, CHARACTER_WIDTH = 7.5, 0.62
#: Smallest distance between labels, in heights of text.
LABEL_STEP = 1.7


class Label(NamedTuple):
    """Name of a part, and the position in the picture that it refers to."""

    text: str
    x_px: float
    y_px: float
    """From the top of the picture."""


def _text_px(height_px: int) -> float:
    return max(MIN_TEXT_PX, TEXT_FRACTION * height_px)


def strip_width_px(shown: SiteColours | None, texts: Sequence[str], height_px: int) -> tuple[int, int]:
    """Return the widths of the strips for labels and for the colour bar or legend."""
    size_px = _text_px(height_px)
    labels_px = (max(map(len, texts)) * CHARACTER_WIDTH + 3.0) * size_px if texts else 0.0
    if shown is None or (shown.scale is None and not shown.legend):
        return round(labels_px), 0
    if shown.scale is not None:
        return round(labels_px), round(BAR_WIDTH * size_px)
    n_characters = max(len(shown.title), *(len(name) + 3 for name, _ in shown.legend))
    return round(labels_px), round((n_characters * CHARACTER_WIDTH + 3.0) * size_px)


def add_strip(
    picture: NDArray[np.uint8], shown: SiteColours | None, labels: Sequence[Label], background: Rgb
) -> NDArray[np.uint8]:
    """
    Return a picture with labels and a colour bar on its right side.

    ``picture`` (n_y, n_x, 3) uint8: top row first; unchanged in the result. ``shown``: with the scale of the colour bar, or
    the legend. ``background``: (r, g, b). Returns ``picture`` (n_y, n_x + sum of :func:`strip_width_px`, 3) uint8.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import PowerNorm
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    n_y, n_x = picture.shape[:2]
    labels_px, bar_px = strip_width_px(shown, [label.text for label in labels], n_y)
    width, dpi, size_px = n_x + labels_px + bar_px, 100.0, _text_px(n_y)
    figure = Figure(figsize=(width / dpi, n_y / dpi), dpi=dpi, facecolor=as_fractions(background))
    text: dict[str, Any] = {"fontsize": size_px * 72.0 / dpi, "color": "0.1"}
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, width), ylim=(n_y, 0.0))
    axes.set_axis_off()
    last_px = -np.inf
    for label in sorted(labels, key=lambda one: one.y_px):
        y_px = last_px = max(label.y_px, last_px + LABEL_STEP * size_px, size_px)
        x_px = n_x + size_px
        axes.plot((label.x_px, x_px - 0.4 * size_px), (label.y_px, y_px), color="0.25", linewidth=0.05 * size_px)
        axes.plot(label.x_px, label.y_px, "o", color="0.25", markersize=0.25 * size_px)
        axes.text(x_px, y_px, label.text, va="center", **text)
    if bar_px and shown is not None and shown.scale is not None:
        scale = shown.scale
        place = ((width - bar_px + 1.2 * size_px) / width, 0.14, size_px / width, 0.72)
        mapped = ScalarMappable(PowerNorm(scale.gamma, scale.low, scale.high), scale.colour_map)
        bar = figure.colorbar(mapped, cax=figure.add_axes(place))
        bar.set_label(shown.title, **text)
        bar.ax.tick_params(labelsize=0.92 * text["fontsize"])
    elif bar_px and shown is not None:
        patches = [Patch(facecolor=as_fractions(rgb), edgecolor="0.4", label=name) for name, rgb in shown.legend]
        figure.legend(
            handles=patches,
            title=shown.title or None,
            loc="center right",
            frameon=False,
            fontsize=text["fontsize"],
            title_fontsize=text["fontsize"],
            borderaxespad=0.8,
        )
    canvas = FigureCanvasAgg(figure)
    # Under the leader lines, pixel by pixel.
    figure.figimage(picture, 0, 0, origin="upper", zorder=-1)
    axes.patch.set_visible(False)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])  # type: ignore[no-untyped-call]
