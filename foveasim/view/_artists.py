"""Matplotlib artists: an image of photosites at display resolution, and a scale bar."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.artist import Artist, allow_rasterization
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.image import AxesImage
from matplotlib.patches import FancyBboxPatch, Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Affine2D, IdentityTransform
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim.layout import Layout
from foveasim.view.id_map import SitePixels, site_at
from foveasim.view.site_colours import BOUNDARY, SiteColours
from foveasim.view.site_pictures import SiteMeans, cover

#: Samples of boundaries along a pixel side, fewer in pictures that would have more than 2^26 samples (256 MB).
N_SAMPLES, MAX_SAMPLES = 3, 2**26
#: Boundaries are drawn if at most this fraction of the pixels in every 16th row follows another site: sites of 7 pixels.
MAX_BOUNDARY_FRACTION, SAMPLED_ROWS = 0.15, 16
#: Largest length of a scale bar as a fraction of the axes.
MAX_BAR_FRACTION = 0.25


class SiteImage(AxesImage):
    """
    Image of coloured photosites, computed for each view and each file resolution.

    Pixels are exact area-weighted means, as in :func:`foveasim.view.site_picture`.

    ``ax``: with linear scales.
    """

    def __init__(self, ax: Axes, layout: Layout, colours: SiteColours) -> None:
        x_min, y_min, x_max, y_max = layout.bounds_um
        super().__init__(ax, interpolation="nearest", origin="lower", extent=(x_min, x_max, y_min, y_max))
        self.set_data(np.zeros((1, 1, 4), np.uint8))  # placeholder until the first draw
        self._layout, self._colours = layout, colours
        self.pixels: SitePixels | None = None
        self._means: SiteMeans | None = None
        self._lines: Floats | None = None

    def recolour(self, colours: SiteColours) -> None:
        """Change the colours of the sites without sampling the layout again."""
        self._colours = colours
        self.stale = True

    def site_at(self, x_um: float, y_um: float) -> int:
        """Return the site drawn at a point, -1 for none."""
        return site_at(self._layout, x_um, y_um) if self.pixels is None else int(self.pixels.site_at(x_um, y_um))

    def make_image(
        self, renderer: RendererBase, magnification: float = 1.0, unsampled: bool = False
    ) -> tuple[NDArray[np.uint8], float, float, Affine2D]:
        """Return the RGBA picture, lowest row first, and the position of its lower left corner."""
        del renderer, unsampled
        window = self.axes.bbox
        low, high = np.floor(window.min), np.ceil(window.max)
        n_x, n_y = (max(1, round(length * magnification)) for length in high - low)
        (x0, y0), (x1, y1) = self.axes.transData.inverted().transform((low, high))
        bounds_um = (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))
        if self.pixels is None or (self.pixels.bounds_um, self.pixels.shape) != (bounds_um, (n_y, n_x)):
            self.pixels = SitePixels.from_layout(self._layout, (n_y, n_x), bounds_um, n_samples=1)
            self._means, self._lines = SiteMeans(self._layout, (n_y, n_x), bounds_um), None
        assert self._means is not None  # created together with the pixels
        picture = self._means.picture(self._colours)
        if self._colours.has_boundaries and self._has_room_for_boundaries():
            if self._lines is None:
                n_samples = max(1, min(N_SAMPLES, math.isqrt(MAX_SAMPLES // (n_x * n_y))))
                samples = SitePixels.from_layout(self._layout, (n_y, n_x), bounds_um, n_samples=n_samples)
                self._lines = samples.boundary_fraction()
            picture[..., :3] = cover(picture[..., :3], np.full((n_y, n_x, 3), BOUNDARY, np.uint8), self._lines)
            picture[..., 3] = np.maximum(picture[..., 3], np.rint(255.0 * self._lines))
        alpha = self.get_alpha()
        if alpha is not None:
            picture[..., 3] = np.rint(picture[..., 3] * np.float64(alpha))
        picture = picture[:: 1 if y0 < y1 else -1, :: 1 if x0 < x1 else -1]
        return np.ascontiguousarray(picture), float(low[0]), float(low[1]), Affine2D()

    def _has_room_for_boundaries(self) -> bool:
        assert self.pixels is not None  # sampled by the caller
        rows = self.pixels.ids[::SAMPLED_ROWS]
        changes = rows[:, 1:] != rows[:, :-1]
        return bool(changes.size > 0 and changes.mean() < MAX_BOUNDARY_FRACTION)


class ScaleBar(Artist):
    """
    Scale bar in the lower left corner.

    Its length is the largest 1, 2 or 5 times a power of ten that fits at the current zoom.
    """

    def __init__(self) -> None:
        super().__init__()
        self.set_zorder(10)
        self.set_in_layout(False)

    @allow_rasterization  # type: ignore[untyped-decorator]
    def draw(self, renderer: RendererBase) -> None:
        """Draw the bar for the current axis limits."""
        if not self.get_visible() or self.axes is None:
            return
        window, pt = self.axes.bbox, float(renderer.points_to_pixels(1.0))  # type: ignore[arg-type]
        low_um, high_um = sorted(self.axes.get_xlim())
        length_um = nice_length_um(MAX_BAR_FRACTION * (high_um - low_um))
        length = length_um / (high_um - low_um) * window.width
        x, y, pad = window.x0 + 9 * pt, window.y0 + 9 * pt, 4 * pt
        text = Text(x + 0.5 * length, y + 5 * pt, format_length(length_um), fontsize=10, ha="center", va="bottom")
        text.set_figure(self.axes.figure)
        width = max(length, text.get_window_extent(renderer).width)
        x += 0.5 * (width - length)
        text.set_x(x + 0.5 * length)
        style: dict[str, Any] = {"transform": IdentityTransform(), "linewidth": 0.0}
        left = x - 0.5 * (width - length)
        parts = (
            FancyBboxPatch((left, y), width, 17 * pt, boxstyle=f"round,pad={pad}", fc="white", alpha=0.8, **style),
            Rectangle((x, y), length, 3 * pt, facecolor="black", **style),
            text,
        )
        for part in parts:
            part.set_figure(self.axes.figure)
            part.draw(renderer)
        self.stale = False


def nice_length_um(limit_um: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most a limit."""
    power = 10.0 ** math.floor(math.log10(limit_um))
    steps = [step * power for step in (1.0, 2.0, 5.0, 10.0)]
    return max(step for step in steps if step <= limit_um * (1.0 + 1e-12))


def format_length(length_um: float) -> str:
    """
    Format a length in nm, µm or mm.

    Examples
    --------
    >>> format_length(0.5), format_length(20.0), format_length(2000.0)
    ('500 nm', '20 µm', '2 mm')
    """
    if length_um < 1.0:
        return f"{1000.0 * length_um:.6g} nm"
    return f"{length_um:.6g} µm" if length_um < 1000.0 else f"{length_um / 1000.0:.6g} mm"
