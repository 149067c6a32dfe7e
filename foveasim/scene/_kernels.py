"""Numba kernel of pictures."""

from __future__ import annotations

from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import array_of

_images = types.float32[:, :, ::1]
_table = array_of(types.float32)


@njit([types.void(types.Array(of, 3, "A", readonly=True), _table, _images) for of in (types.uint8, types.uint16)])
def look_up(pixels, table, out):
    """Write the values of a table at pixels (n_channel, n_y, n_x), in any memory order."""
    for y in range(pixels.shape[1]):
        for channel in range(pixels.shape[0]):
            for x in range(pixels.shape[2]):
                out[channel, y, x] = table[pixels[channel, y, x]]
