"""Pictures: the reconstruction from the codes, and the optical image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.fields import Grid, PowerMap
from foveasim.studio._engine import Simulated, block_means
from foveasim.studio._parts.registry import PartData, part
from foveasim.view.site_colours import encode_light

__all__ = ["picture", "scene"]

#: Fraction of the cells of an optical image that are not brighter than white.
WHITE_QUANTILE = 0.995
#: Levels of linear light in the table of sRGB bytes.
N_LEVELS = 1 << 14


@part("Picture", lambda result: (result.capture, (result.picture_pixels,)))
def picture(result: Simulated) -> PartData:
    """Return the picture that is reconstructed from the codes."""
    capture = result.capture
    # The picture of a layout that only moved is that of the earlier one, whose compiled outlines are cached.
    unmoved = capture if result.unmoved is None else replace(capture, layout=result.unmoved)
    found = unmoved.picture(max_pixels=result.picture_pixels)
    levels = found.data / capture.white_dn.reshape(-1, 1, 1).astype(np.float32)
    bounds_um = tuple(side + move for side, move in zip(found.grid.bounds_um, 2 * result.move_um, strict=True))
    return _picture(levels, found.coverage, bounds_um)


def _light_of(result: Simulated) -> tuple[Any, ...]:
    """Return the images, their position and the white level that scales them."""
    source, camera = result.shot.scene, result.shot.camera
    if isinstance(source, PowerMap):
        return source, (result.picture_pixels,)
    numbers = result.picture_pixels, *result.capture.white_dn.tolist(), *camera.image_grid(source).bounds_um
    return (*result.images.values(), tuple(result.images), numbers)


@part("Optical image", _light_of)
def scene(result: Simulated) -> PartData:
    """Return the optical image through each colour filter."""
    camera, source = result.shot.camera, result.shot.scene
    if isinstance(source, PowerMap):
        bands, grid = list(source.data[np.argsort(-source.wavelength_nm)]), source.grid
        white = np.ones(len(bands))
    else:
        # With lateral chromatic aberration, each wavelength has its own grid: the largest is shown.
        widest = max((key[0] for key in result.images), key=lambda each: each.pitch_x_um)
        found = {key[1]: image for key, image in result.images.items() if key[0] == widest}
        bounds_um = np.array(camera.image_grid(source).bounds_um)
        pitch_um = (bounds_um[2:] - bounds_um[:2]) / widest.shape[::-1]
        grid = Grid(widest.shape, (float(pitch_um[0]), float(pitch_um[1])), tuple(bounds_um[:2].tolist()))
        bands = [found[c] for c in sorted(found)]
        white = result.capture.white_dn[sorted(found)]
    data, grid = _reduced(bands, grid, result.picture_pixels)
    data /= np.asarray(white, np.float32).reshape(-1, 1, 1)
    scale = float(np.quantile(data, WHITE_QUANTILE)) or 1.0
    about, arrays = _picture(data / scale, np.ones(data.shape[1:], np.float32), grid.bounds_um)
    return about, arrays


def _reduced(bands: Sequence[NDArray[Any]], grid: Grid, n_pixels: int) -> tuple[NDArray[np.float32], Grid]:
    """Return means of blocks of cells; incomplete upper and right blocks are cropped."""
    n_y, n_x = bands[0].shape
    block = max(1, -(-max(n_y, n_x) // n_pixels))
    rows, n_columns = n_y // block, n_x // block
    data = np.empty((len(bands), rows, n_columns), np.float32)
    for band, cells in enumerate(bands):
        data[band] = block_means(cells, block)
    pitch_x_um, pitch_y_um = grid.pitch_x_um * block, grid.pitch_y_um * block
    return data, Grid((rows, n_columns), (pitch_x_um, pitch_y_um), grid.origin_um)


def _picture(light: NDArray[Any], coverage: NDArray[Any], bounds_um: tuple[float, ...]) -> PartData:
    """Return bytes of a picture, top row first, from linear (n_channel, n_y, n_x)."""
    if light.shape[0] not in (1, 3):
        light = light.mean(axis=0, keepdims=True)
    level = np.clip(np.nan_to_num(light) * np.float32(N_LEVELS - 1), 0, N_LEVELS - 1).astype(np.uint16)
    pixels = np.empty((*coverage.shape, 4), np.uint8)
    pixels[..., :3] = np.moveaxis(_srgb_table()[level], 0, -1)[::-1]
    pixels[..., 3] = np.rint(255.0 * np.clip(coverage, 0.0, 1.0))[::-1]
    about = {"width": pixels.shape[1], "height": pixels.shape[0], "bounds_um": list(bounds_um)}
    return about, {"rgba": pixels}


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    """Return the sRGB byte of each level of linear light."""
    return encode_light(np.linspace(0.0, 1.0, N_LEVELS))
