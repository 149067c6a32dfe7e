"""Picture: the reconstruction from the codes."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, part
from foveasim.view.site_colours import encode_light

#: Levels of linear light in the table of sRGB bytes.
N_LEVELS = 1 << 14


@part("Picture", lambda result: (result.capture, (result.picture_pixels,)), order=3)
def picture(result: Simulated) -> PartData:
    """Return the picture that is reconstructed from the codes."""
    capture = result.capture
    found = capture.picture(max_pixels=result.picture_pixels)
    return pixels_of(found.to_rgb(capture.white_dn, clip=True).data, found.coverage, found.grid.bounds_um)


def pixels_of(light: NDArray[Any], coverage: NDArray[Any], bounds_um: tuple[float, ...]) -> PartData:
    """Return bytes of a picture, top row first, from linear (1 or 3, n_y, n_x)."""
    # fmax and fmin ignore NaN, which becomes 0.
    level = np.fmin(np.fmax(light * np.float32(N_LEVELS - 1), 0), N_LEVELS - 1).astype(np.uint16)
    pixels = np.empty((*coverage.shape, 4), np.uint8)
    pixels[..., :3] = np.moveaxis(_srgb_table()[level], 0, -1)[::-1]
    pixels[..., 3] = np.rint(255.0 * np.clip(coverage, 0.0, 1.0))[::-1]
    about = {"width": pixels.shape[1], "height": pixels.shape[0], "bounds_um": list(bounds_um)}
    return about, {"rgba": pixels}


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    """Return the sRGB byte of each level of linear light."""
    return encode_light(np.linspace(0.0, 1.0, N_LEVELS))
