"""Picture: the reconstruction from the codes."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.config import Shot
from foveasim.layout import Layout
from foveasim.reconstruct import fill_channels
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.ahead import MANY_SITES, Ahead
from foveasim.studio._parts.registry import PartData, part
from foveasim.view.site_colours import encode_light

#: Levels of linear light in the table of sRGB bytes.
N_LEVELS = 1 << 14


def _start(shot: Shot) -> None:
    sensor, layout = shot.camera.sensor, shot.camera.layout
    if sensor.n_filters > 1 and layout.n_sites < MANY_SITES:
        _fill.start(layout, sensor.filter_of_site.tobytes(), sensor.n_filters)


@part("Picture", lambda result: (result.capture, (result.picture_pixels,)), order=3, work_ahead=_start)
def picture(result: Simulated) -> PartData:
    """Return the picture that is reconstructed from the codes."""
    capture = result.capture
    ahead = _fill.started(capture.layout, capture.filter_of_site.tobytes(), len(capture.filter_names))
    if ahead is not None:
        ahead.result()
    found = capture.picture(max_pixels=result.picture_pixels)
    return pixels_of(found.to_rgb(capture.white_dn, clip=True).data, found.coverage, found.grid.bounds_um)


@Ahead
def _fill(layout: Layout, filters: bytes, n_filters: int) -> None:
    """Find the neighbours of the photosites in each filter, which pictures of a layout share."""
    channel = np.frombuffer(filters, np.min_scalar_type(-n_filters))
    fill_channels(layout, np.zeros(layout.n_sites), channel, n_filters)


def pixels_of(light: NDArray[Any], coverage: NDArray[Any], bounds_um: tuple[float, ...]) -> PartData:
    """Return bytes of a picture, top row first, from linear (1 or 3, n_y, n_x)."""
    from foveasim.view import _kernels

    pixels = np.empty((*coverage.shape, 4), np.uint8)
    _kernels.encode_pixels(np.ascontiguousarray(light, np.float32), coverage, _srgb_table(), pixels)
    about = {"width": pixels.shape[1], "height": pixels.shape[0], "bounds_um": list(bounds_um)}
    return about, {"rgba": pixels}


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    """Return the sRGB byte of each level of linear light."""
    return encode_light(np.linspace(0.0, 1.0, N_LEVELS))
