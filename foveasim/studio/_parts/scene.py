"""Optical image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.fields import Grid, PowerMap
from foveasim.reconstruct import Picture
from foveasim.studio._engine import Simulated, block_means
from foveasim.studio._parts.picture import pixels_of
from foveasim.studio._parts.registry import PartData, part

#: Fraction of the cells of an optical image that are not brighter than white.
WHITE_QUANTILE = 0.995


def _light_of(result: Simulated) -> tuple[Any, ...]:
    """Return the images, their position and the white level that scales them."""
    source, camera = result.shot.scene, result.shot.camera
    if isinstance(source, PowerMap):
        return source, (result.picture_pixels, *camera.position_um)
    colour = result.capture.colour_correction
    numbers = (
        result.picture_pixels,
        *result.capture.white_dn.tolist(),
        *(() if colour is None else colour.matrix.ravel().tolist()),
        *camera.image_grid(source).bounds_um,
        *camera.position_um,
    )
    return (*result.images.values(), tuple(result.images), numbers)


@part("Optical image", _light_of, order=4)
def scene(result: Simulated) -> PartData:
    """Return the optical image through each colour filter."""
    camera, source = result.shot.camera, result.shot.scene
    if isinstance(source, PowerMap):
        bands, grid, matrix = list(source.data[np.argsort(-source.wavelength_nm)]), source.grid, None
        white = np.ones(len(bands))
    else:
        # With lateral chromatic aberration, each wavelength has its own grid: the largest is shown.
        widest = max((key[0] for key in result.images), key=lambda each: each.pitch_x_um)
        found = {key[1]: image for key, image in result.images.items() if key[0] == widest}
        bounds_um = np.array(camera.image_grid(source).bounds_um)
        pitch_um = (bounds_um[2:] - bounds_um[:2]) / widest.shape[::-1]
        grid = Grid(widest.shape, (float(pitch_um[0]), float(pitch_um[1])), tuple(bounds_um[:2].tolist()))
        bands = [found[c] for c in sorted(found)]
        white, colour = result.capture.white_dn[sorted(found)], result.capture.colour_correction
        matrix = None if colour is None else colour.matrix[:, sorted(found)]  # 0 for filters without photosites
    data, grid = _reduced(bands, grid, result.picture_pixels)
    shown = Picture(data, np.ones(data.shape[1:], np.float32), grid, white, matrix).to_rgb()
    scale = float(np.quantile(shown.data, WHITE_QUANTILE)) or 1.0
    about, arrays = pixels_of(shown.data / scale, shown.coverage, grid.bounds_um)
    return about | {"position_um": list(camera.position_um)}, arrays


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
