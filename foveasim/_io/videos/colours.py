"""
Colours of videos: matrix, range, transfer and primaries.

The numbers are those of ITU-T H.273. Files without these values have them as FFmpeg and OpenCV assume: matrix of BT.601,
limited range of luma and chroma, full range of grey and RGB, and pictures in sRGB.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim.errors import FileError, printable
from foveasim.units import decode_srgb, encode_srgb

UNSPECIFIED = 2
#: Weights of red and blue in luma, by matrix coefficients; unspecified ones are those of BT.601.
LUMA_WEIGHTS = {
    1: (0.2126, 0.0722),  # BT.709
    UNSPECIFIED: (0.299, 0.114),
    3: (0.299, 0.114),  # reserved, and as unspecified in FFmpeg
    4: (0.30, 0.11),  # FCC
    5: (0.299, 0.114),  # BT.601, 625 lines
    6: (0.299, 0.114),  # BT.601, 525 lines
    7: (0.212, 0.087),  # SMPTE 240M
    9: (0.2627, 0.0593),  # BT.2020, non-constant luminance
}
MATRIX_NAMES = {0: "RGB", 8: "YCgCo", 10: "BT.2020 with constant luminance", 11: "SMPTE ST 2085", 14: "ICtCp"}
#: Chromaticities (x, y) of red, green and blue of primaries with the white D65.
PRIMARIES = {
    1: ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),  # BT.709, sRGB
    5: ((0.640, 0.330), (0.290, 0.600), (0.150, 0.060)),  # BT.601, 625 lines
    6: ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070)),  # BT.601, 525 lines
    7: ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070)),  # SMPTE 240M
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),  # BT.2020
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),  # Display P3
    22: ((0.630, 0.340), (0.295, 0.605), (0.155, 0.077)),  # EBU 3213
}
WHITE_D65 = (0.3127, 0.3290)
PRIMARY_NAMES = {4: "BT.470 System M", 8: "film", 10: "SMPTE ST 428", 11: "DCI-P3"}
#: Primaries and transfers that need no conversion to sRGB.
AS_SRGB_PRIMARIES, AS_SRGB_TRANSFERS = (0, 1, UNSPECIFIED, 3), (0, UNSPECIFIED, 3, 13)
TRANSFER_NAMES = {
    7: "SMPTE 240M", 9: "logarithmic", 10: "logarithmic", 11: "IEC 61966-2-4 (xvYCC)", 12: "BT.1361",
    16: "SMPTE ST 2084 (PQ)", 17: "SMPTE ST 428",
}  # fmt: skip
#: Parameters of BT.709, and of hybrid log-gamma (BT.2100).
BT709_OFFSET, BT709_SLOPE, BT709_EXPONENT = 0.09929682680944, 4.5, 0.45
BT709_LIMIT = 0.018053968510807
HLG_A = 0.17883277
HLG_B, HLG_C = 1.0 - 4.0 * HLG_A, 0.5 - HLG_A * float(np.log(4.0 * HLG_A))


def _from_bt709(value: Floats) -> Floats:
    """Return the light that a camera encodes by BT.709, BT.601 and BT.2020."""
    curve = ((value + BT709_OFFSET) / (1.0 + BT709_OFFSET)) ** (1.0 / BT709_EXPONENT)
    return np.where(value < BT709_SLOPE * BT709_LIMIT, value / BT709_SLOPE, curve)


def _from_hlg(value: Floats) -> Floats:
    """Return the light that a camera encodes by hybrid log-gamma; 1 is the peak."""
    return np.where(value <= 0.5, value * value / 3.0, (np.exp((value - HLG_C) / HLG_A) + HLG_B) / 12.0)


#: Light of the scene, relative to its peak, from encoded values 0 to 1.
TRANSFERS: dict[int, Callable[[Floats], Floats]] = {
    1: _from_bt709,
    4: lambda value: value**2.2,
    5: lambda value: value**2.8,
    6: _from_bt709,
    8: lambda value: value,
    14: _from_bt709,
    15: _from_bt709,
    18: _from_hlg,
    **dict.fromkeys(AS_SRGB_TRANSFERS, decode_srgb),
}


@dataclass(frozen=True)
class Colour:
    """Transfer and primaries of a video, as numbers of H.273."""

    path: Path
    transfer: int
    primaries: int

    def to_srgb(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """
        Return pixels in sRGB, (n_y, n_x) or (n_y, n_x, n_channel) uint8 or uint16.

        Other pixels than those of sRGB become uint16; colours outside sRGB are clipped. Raises FileError when transfer or
        primaries are not supported.
        """
        if self.transfer not in TRANSFERS:
            name = TRANSFER_NAMES.get(self.transfer, f"number {self.transfer}")
            raise FileError(
                self.path, f"has the transfer {name}; convert it to BT.709 or hybrid log-gamma, or specify the encoding"
            )
        is_grey = pixels.ndim == 2 or pixels.shape[2] == 2
        has_other_primaries = self.primaries not in AS_SRGB_PRIMARIES and not is_grey
        if has_other_primaries and self.primaries not in PRIMARIES:
            name = PRIMARY_NAMES.get(self.primaries, f"number {self.primaries}")
            raise FileError(
                self.path, f"has the primaries {name}; convert it to those of BT.709, or specify the encoding"
            )
        if self.transfer in AS_SRGB_TRANSFERS and not has_other_primaries:
            return pixels
        n_colours = 1 if pixels.ndim == 2 else 3 - 2 * is_grey
        channels = pixels[..., np.newaxis] if pixels.ndim == 2 else pixels
        peak = np.iinfo(pixels.dtype).max
        found = channels.astype(np.uint16) * np.uint16(np.iinfo(np.uint16).max // peak)
        if has_other_primaries:
            light = _light_table(self.transfer, peak)[channels[..., :3]]
            light = np.clip(light @ _to_bt709(self.primaries).T.astype(np.float32), 0.0, 1.0)
            found[..., :3] = np.rint(encode_srgb(light) * np.iinfo(np.uint16).max)
        else:
            found[..., :n_colours] = _srgb_table(self.transfer, peak)[channels[..., :n_colours]]
        return found[..., 0] if pixels.ndim == 2 else found


def check_profile(path: Path, profile: bytes | None) -> None:
    """
    Check that a colour profile (ICC) of a frame is that of sRGB, or None.

    Raises FileError when it is another one.
    """
    if profile is None:
        return
    from PIL import ImageCms

    try:
        name = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile))).strip()
    except (OSError, ImageCms.PyCMSError):
        name = "is not readable"
    if "srgb" not in name.lower():
        raise FileError(
            path, f"has the colour profile '{printable(name):.60}'; convert it to sRGB, or specify the encoding"
        )


@lru_cache(maxsize=4)
def _light_table(transfer: int, peak: int) -> NDArray[np.float32]:
    """Return the light of all encoded values, 0 to ``peak``."""
    return np.clip(TRANSFERS[transfer](np.arange(peak + 1) / peak), 0.0, 1.0).astype(np.float32)


@lru_cache(maxsize=4)
def _srgb_table(transfer: int, peak: int) -> NDArray[np.uint16]:
    """Return the sRGB values, uint16, of all encoded values, 0 to ``peak``."""
    light = np.clip(TRANSFERS[transfer](np.arange(peak + 1) / peak), 0.0, 1.0)
    return np.rint(encode_srgb(light) * np.iinfo(np.uint16).max).astype(np.uint16)


@lru_cache(maxsize=8)
def _to_bt709(primaries: int) -> Floats:
    """Return the matrix (3, 3) from linear colours of primaries to those of BT.709."""
    return np.asarray(np.linalg.solve(_to_xyz(PRIMARIES[1]), _to_xyz(PRIMARIES[primaries])), np.float64)


def _to_xyz(primaries: Any) -> Floats:
    """Return the matrix (3, 3) from linear colours to CIE XYZ."""
    of_primaries, white = (
        np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in xy]).T for xy in (primaries, [WHITE_D65])
    )
    return np.asarray(of_primaries * np.linalg.solve(of_primaries, white[:, 0]))
