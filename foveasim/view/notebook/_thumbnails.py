"""Thumbnails as PNG files of limited size."""

from __future__ import annotations

import io
import math

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim.capture import Capture
from foveasim.layout import Layout
from foveasim.layout.drc.rules import Report
from foveasim.view.id_map import SitePixels
from foveasim.view.notebook._blocks import Html, picture
from foveasim.view.plots.rules import MAX_SHOWN, RULE_COLOURS
from foveasim.view.site_colours import BACKGROUND, BOUNDARY, Rgb, SiteColours, colours_of

#: Longer side of a thumbnail, and the largest size of its file.
THUMBNAIL_PIXELS, MAX_BYTES = 280, 45_000
#: Shorter side of a thumbnail of a narrow layout.
MIN_PIXELS = 8
#: Boundaries are drawn if the sites are at least this many pixels wide on average.
MIN_SITE_PIXELS = 6.0
#: Relative difference of areas below which sites have equal sizes.
SIZE_ROUNDING = 1e-3
#: Radius of the circle around a violation by the number of violations, and width of its line, in pixels. Pictures are drawn
#: larger by a factor and then reduced.
CIRCLE_PIXELS, LINE_PIXELS, DRAWING_SCALE = ((50, 5), (500, 3), (math.inf, 1)), 1.5, 3


def encode_png(pixels: NDArray[np.uint8], max_bytes: int = MAX_BYTES) -> tuple[bytes, tuple[int, int]]:
    """
    Encode pixels as a PNG file.

    ``pixels`` (n_y, n_x, n_channel) uint8: top row first: grey, grey with alpha, RGB or RGBA. ``max_bytes``: pictures that
    need more have fewer colours, then fewer pixels.
    """
    from PIL import Image

    image = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    png = _save(image)
    if len(png) <= max_bytes:
        return png, image.size
    image = image.convert("RGBA")
    while True:
        png = _save(image.quantize(128, method=Image.Quantize.FASTOCTREE))
        if len(png) <= max_bytes or min(image.size) <= MIN_PIXELS:
            return png, image.size
        scale = max(0.5, 0.97 * math.sqrt(max_bytes / len(png)))
        image = image.resize(
            (max(1, round(image.width * scale)), max(1, round(image.height * scale))), Image.Resampling.BOX
        )


def _save(image: object) -> bytes:
    encoded = io.BytesIO()
    image.save(encoded, "PNG", optimize=True)  # type: ignore[attr-defined]
    return encoded.getvalue()


def thumbnail(pixels: NDArray[np.uint8], alt: str, caption: str = "") -> Html:
    """Return pixels (n_y, n_x, n_channel) as a small embedded picture."""
    png, size = encode_png(pixels)
    # Small pictures are enlarged by the browser to the size of others.
    scale = THUMBNAIL_PIXELS / max(size)
    return picture(png, (max(1, round(size[0] * scale)), max(1, round(size[1] * scale))), alt, caption)


def site_thumbnail(data: Layout | Capture, alt: str) -> Html:
    """
    Return a picture of a layout, transparent between photosites, or of a capture.

    Captures in colour are shown as a picture, others by the codes of their photosites. They have the
    background of plots, on which black and white photosites are visible.
    """
    layout = data.layout if isinstance(data, Capture) else data
    if not layout.n_sites:
        return Html()
    if isinstance(data, Capture) and (len(data.filter_names) == 3 or data.colour_correction):
        pixels = data.picture(max_pixels=THUMBNAIL_PIXELS).to_image(background=BACKGROUND)
        return thumbnail(np.asarray(pixels, np.uint8), alt, "picture")
    by = "code" if isinstance(data, Capture) else _quantity_of(layout)
    colours = colours_of(data, by)
    scale = colours.scale
    caption = colours.title if scale is None else f"{colours.title}, {scale.low:.4g} to {scale.high:.4g}"
    background = BACKGROUND if isinstance(data, Capture) else None
    return thumbnail(_site_pixels(layout, colours, background=background), alt, caption)


def _quantity_of(layout: Layout) -> str | None:
    """Return the quantity that distinguishes the sites: filter, size, or None."""
    channel = layout.channel
    if channel.size and channel.min() != channel.max():
        return "channel"
    return "size_um" if layout.area_um2.max() > (1.0 + SIZE_ROUNDING) * layout.area_um2.min() else None


def _site_pixels(
    layout: Layout, colours: SiteColours, scale: int = 1, background: Rgb | None = None
) -> NDArray[np.uint8]:
    """Return the colours of the sites, (n_y, n_x, 4), or 3 with a background, top row first."""
    x0, y0, x1, y1 = layout.bounds_um
    um_per_pixel = max(x1 - x0, y1 - y0) / (scale * THUMBNAIL_PIXELS)
    n_x, n_y = (max(MIN_PIXELS, round(length / um_per_pixel)) for length in (x1 - x0, y1 - y0))
    pixels = SitePixels.from_layout(layout, (n_y, n_x))
    site_pixels = math.sqrt(float(np.median(layout.area_um2))) / um_per_pixel
    has_boundaries = colours.has_boundaries and site_pixels >= MIN_SITE_PIXELS * scale
    return pixels.picture(colours.rgb, background=background, boundary=BOUNDARY if has_boundaries else None)[::-1]


def report_thumbnail(report: Report, alt: str) -> Html:
    """Return the checked layout with circles at the worst violations of each rule."""
    from PIL import Image, ImageDraw

    layout = report.layout
    if layout is None or not layout.n_sites:
        return Html()
    image = Image.fromarray(_site_pixels(layout, colours_of(layout), DRAWING_SCALE))
    draw = ImageDraw.Draw(image)
    x0, y0, x1, y1 = layout.bounds_um
    violated = [result for result in report.results if len(result)]
    n_violations = sum(map(len, violated))
    radius = DRAWING_SCALE * next(pixels for limit, pixels in CIRCLE_PIXELS if n_violations <= limit)
    for k, result in enumerate(violated):
        markers = np.array([violation.marker for violation in result.worst_violations(MAX_SHOWN)], dtype=object)
        centre_um = shapely.get_coordinates(shapely.centroid(markers))
        x = (centre_um[:, 0] - x0) / (x1 - x0) * image.width
        y = (y1 - centre_um[:, 1]) / (y1 - y0) * image.height
        for at_x, at_y in zip(x.tolist(), y.tolist(), strict=True):
            box = (at_x - radius, at_y - radius, at_x + radius, at_y + radius)
            draw.ellipse(box, outline=RULE_COLOURS[k % len(RULE_COLOURS)], width=round(LINE_PIXELS * DRAWING_SCALE))
    return thumbnail(np.asarray(image.reduce(DRAWING_SCALE)), alt)
