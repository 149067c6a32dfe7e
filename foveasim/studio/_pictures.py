"""Reduction of large photographs to what the sensor can resolve."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io.encodings import FileEncoding, decode, encode
from foveasim._io.images import EncodedPicture, as_encoded, write_picture
from foveasim.config import Shot

#: Pixels of a reduced picture per side of the smallest photosite, and per λN.
PER_SITE, PER_LAMBDA_N = 3.0, 4.0
#: Limits of the longer side of reduced pictures.
MIN_PIXELS, MAX_PIXELS = 1024, 8192


def resolved_pixels(shot: Shot) -> int:
    """Return the longer side of a picture beyond which a sensor resolves no more, pixels."""
    layout = shot.camera.layout
    x0_um, y0_um, x1_um, y1_um = layout.bounds_um
    lambda_n_um = 0.4 * shot.camera.optics.f_number  # at 400 nm
    pixel_um = max(float(np.sqrt(layout.area_um2.min())) / PER_SITE, lambda_n_um / PER_LAMBDA_N)
    return int(np.clip(math.ceil(max(x1_um - x0_um, y1_um - y0_um) / pixel_um), MIN_PIXELS, MAX_PIXELS))


class ReducedPictures:
    """
    Reduced copies of large pictures, with sentences about them.

    ``new_path``: returns an unused path for a name.
    """

    def __init__(self, new_path: Callable[[str], Path]) -> None:
        self._new_path = new_path
        self._notes: dict[str, str] = {}
        self._found: dict[tuple[str, int, FileEncoding], tuple[Path, str] | None] = {}

    def path_of(self, path: str, shot: Shot, encoding: FileEncoding) -> str:
        """Return the path of a picture, or of a reduced one if a shot cannot resolve its pixels."""
        key = (path, resolved_pixels(shot), encoding)
        if key not in self._found:
            self._found[key] = reduced_picture(Path(path), self._new_path, key[1], encoding)
        found = self._found[key]
        if found is None:
            return path
        self._notes[str(found[0])] = found[1]
        return str(found[0])

    def notes_of(self, settings: Mapping[str, Any]) -> list[str]:
        """Return the sentences about the picture of settings."""
        picture = settings.get("scene", {}).get("picture")
        return [note for path, note in self._notes.items() if picture == path]


def reduced_picture(
    path: Path, new_path: Callable[[str], Path], n_pixels: int, encoding: FileEncoding
) -> tuple[Path, str] | None:
    """
    Write a picture with means of blocks of pixels, unless it is small.

    The means are those of the relative radiance; with the same ``encoding`` the file is read as the picture.

    ``new_path``: returns an unused path for a name. ``n_pixels``: the shorter side of the result is not smaller. Returns the
    path of the new TIFF file, and a note in one line; None for a picture of less than twice this size. Raises FileError when
    the file is not a picture.
    """
    picture = as_encoded(path, encoding)
    n_y, n_x = picture.pixels.shape[:2]
    block = min(n_y, n_x) // n_pixels
    if block < 2:
        return None
    target = new_path(f"{path.stem}_{n_x // block}x{n_y // block}.tif")
    try:
        is_linear = picture.encoding == "linear"
        write_picture(target, _block_means(picture, block), encoding="linear" if is_linear else "srgb")
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    return target, (
        f"{path.name} has {n_x:,} × {n_y:,} pixels; it was reduced to {n_x // block:,} × {n_y // block:,}, more than this "
        "sensor can resolve"
    )


def _block_means(picture: EncodedPicture, block: int) -> NDArray[Any]:
    """
    Return means of square blocks, uint16 or float32.

    Incomplete blocks at the right and at the bottom are cropped; the result has no alpha.
    """
    pixels, encoding = picture.pixels, picture.encoding
    n_y, n_x = (n // block for n in pixels.shape[:2])
    n_channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    n_colours = n_channels - (n_channels in (2, 4))  # without alpha
    has_integers = np.issubdtype(pixels.dtype, np.integer)
    peak = np.iinfo(pixels.dtype).max if has_integers else 1.0
    table = decode(np.arange(peak + 1) / peak, encoding).astype(np.float32) if has_integers else None
    means = np.empty((n_y, n_x, n_colours), np.float32)
    for row in range(n_y):
        rows = pixels[row * block : (row + 1) * block, : n_x * block].reshape(block, n_x, block, n_channels)
        # Transparent pixels are black, as in scenes.
        alpha = rows[..., -1] / np.float32(peak) if n_colours < n_channels else None
        for channel in range(n_colours):
            values = rows[..., channel]
            if table is None:
                values = values if picture.is_wide else np.maximum(values, 0.0)
                values = decode(values.astype(np.float64), encoding)
            else:
                values = table[values]
            values = values if alpha is None else values * alpha
            means[row, :, channel] = values.mean(axis=(0, 2), dtype=np.float64)
    means = encode(means.astype(np.float64), encoding).astype(np.float32)
    found = means[..., 0] if n_colours == 1 else means
    return np.rint(np.clip(found, 0.0, 1.0) * 65535.0).astype(np.uint16) if has_integers else found
