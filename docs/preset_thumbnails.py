"""
Thumbnails of the bundled shots and layouts on the start page of the studio.

    python docs/preset_thumbnails.py        writes foveasim/studio/static/presets/*.webp
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import foveasim as fs
from foveasim.config import read_layout_file, read_shot
from foveasim.studio._files import preset_paths, thumbnail_name
from foveasim.view import SitePixels, colours_of

THUMBNAILS = Path(str(files("foveasim.studio"))) / "static" / "presets"
#: Size of the pictures: twice that on the page, for dense screens.
WIDTH_PX, HEIGHT_PX = 400, 300
#: Space around complete layouts, relative to their size.
MARGIN = 0.04
#: Layouts with more sites of equal size are shown in part: this number of sites around their centre.
MANY_SITES, N_SHOWN = 1000, 300
#: Relative difference of sizes that is rounding.
SAME_SIZE = 1e-6
#: Lines between sites, visible on all colours, in light and dark themes.
BOUNDARY = (40, 46, 58)
#: Samples along each side of a pixel; lines between sites have the width of one.
N_SAMPLES = 2


def frame_um(bounds_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bounds with the same centre, a margin, and the aspect ratio of thumbnails."""
    centre_um, size_um = (
        0.5 * (bounds_um[:2] + bounds_um[2:]),
        bounds_um[2:] - bounds_um[:2],
    )
    scale_um = (1.0 + MARGIN) * max(size_um[0] / WIDTH_PX, size_um[1] / HEIGHT_PX)
    half_um = 0.5 * scale_um * np.array([WIDTH_PX, HEIGHT_PX])
    return np.concatenate([centre_um - half_um, centre_um + half_um])


def window_um(layout: fs.Layout) -> NDArray[np.float64]:
    """Return the bounds of a layout, or of a part around its centre with the aspect ratio of thumbnails."""
    bounds_um = np.array(layout.bounds_um)
    if layout.n_sites <= MANY_SITES or not has_equal_sizes(layout):
        return frame_um(bounds_um)
    scale_um = np.sqrt(N_SHOWN * layout.area_um2.mean() / (WIDTH_PX * HEIGHT_PX))
    half_um = 0.5 * scale_um * np.array([WIDTH_PX, HEIGHT_PX])
    centre_um = 0.5 * (bounds_um[:2] + bounds_um[2:])
    return np.concatenate([centre_um - half_um, centre_um + half_um])


def has_equal_sizes(layout: fs.Layout) -> bool:
    """Return whether all sites have the same size."""
    return bool(np.ptp(layout.size_um) <= SAME_SIZE * layout.size_um.max())


def layout_picture(layout: fs.Layout) -> NDArray[np.uint8]:
    """Return a layout in the colours of its filters or sizes, transparent around it, top row first."""
    pixels = SitePixels.from_layout(
        layout, (HEIGHT_PX, WIDTH_PX), window_um(layout), n_samples=N_SAMPLES
    )
    has_filters = has_equal_sizes(layout) and layout.channel.max() > 0
    colours = colours_of(layout, "channel" if has_filters else "size_um")
    return pixels.picture(colours.rgb, background=None, boundary=BOUNDARY)[::-1]


def shot_picture(path: Path) -> NDArray[np.uint8]:
    """Return the picture of a shot, transparent around its layout, top row first."""
    shot = read_shot(path)
    capture = shot.camera.capture(
        shot.scene, exposure_s=shot.requested_s, seed=shot.seed
    )
    bounds_um = frame_um(np.array(capture.layout.bounds_um))
    pitch_um = (bounds_um[2] - bounds_um[0]) / WIDTH_PX
    grid = fs.Grid((HEIGHT_PX, WIDTH_PX), pitch_um, (bounds_um[0], bounds_um[1]))
    return np.asarray(capture.picture(grid=grid))


def thumbnail(name: str) -> Image.Image:
    """Return the thumbnail of a preset by its name, such as ``"layout:giotto_1"``."""
    path = preset_paths()[name]
    found = (
        shot_picture(path)
        if name.startswith("shot:")
        else layout_picture(read_layout_file(path).layout)
    )
    return Image.fromarray(found)


def main() -> None:
    """Write all thumbnails, and delete those of removed presets."""
    THUMBNAILS.mkdir(exist_ok=True)
    for path in THUMBNAILS.glob("*.webp"):
        path.unlink()
    for name in preset_paths():
        thumbnail(name).save(THUMBNAILS / thumbnail_name(name), lossless=True, method=6)


if __name__ == "__main__":
    main()
