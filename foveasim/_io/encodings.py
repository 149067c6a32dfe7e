"""Transfer functions of pictures: relative radiance from encoded values, and the inverse."""

from __future__ import annotations

from typing import Literal

import numpy as np

from foveasim._core.validation import Floats

#: sRGB (photographs), the square root of the radiance (the paper), linear radiance.
Encoding = Literal["srgb", "sqrt", "linear"]


def decode(values: Floats, encoding: Encoding) -> Floats:
    """
    Decode values >= 0 to relative radiance.

    sRGB as in IEC 61966-2-1, extrapolated above 1.
    """
    if encoding == "sqrt":
        return values * values
    if encoding == "srgb":
        return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return values


def encode_srgb_values(values: Floats) -> Floats:
    """Encode relative radiance >= 0 in sRGB, IEC 61966-2-1."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1.0 / 2.4) - 0.055)
