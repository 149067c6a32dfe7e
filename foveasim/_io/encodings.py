"""Transfer functions of pictures: relative radiance from encoded values."""

from __future__ import annotations

from typing import Literal

import numpy as np

from foveasim._core.validation import Floats
from foveasim.units import decode_srgb, encode_srgb

#: sRGB (photographs), the square root of the radiance (the paper), linear radiance.
Encoding = Literal["srgb", "sqrt", "linear"]
#: What a caller may order: the encoding that the file states or its format defines, or one of these instead.
FileEncoding = Literal["auto", "srgb", "sqrt", "linear"]


def decode(values: Floats, encoding: Encoding) -> Floats:
    """
    Decode values >= 0 to relative radiance.

    sRGB as in IEC 61966-2-1, extrapolated above 1. Linear values may be negative.
    """
    if encoding == "sqrt":
        return values * values
    return decode_srgb(values) if encoding == "srgb" else values


def encode(value: Floats, encoding: Encoding) -> Floats:
    """Encode relative radiance >= 0: the inverse of :func:`decode`."""
    if encoding == "sqrt":
        return np.sqrt(value)
    return encode_srgb(value) if encoding == "srgb" else value
