"""Colours of picture files: how their numbers encode light, and conversion to linear sRGB."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim._io.encodings import Encoding, FileEncoding, decode
from foveasim._io.formats import FormatError
from foveasim._io.images._profiles import profile_to_srgb
from foveasim._io.primaries import SRGB_XY, srgb_of_xyz, xyz_of_primaries, xyz_of_xy

#: How a caller ignores what a file states about its colours.
CURE = "to read its values without it, choose encoding='srgb' or 'linear'"
#: Chromaticities of the white D65 of Rec. ITU-R BT.709, and differences from those of sRGB that are rounding errors.
D65, ROUNDING_XY = (0.3127, 0.3290), 2e-3
#: Gamma of Adobe RGB (1998), and its primaries.
ADOBE_RGB_GAMMA, ADOBE_RGB_XY = 563.0 / 256.0, (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65)
#: Chromaticities (x, y) of red, green, blue and white by the codes of Rec. ITU-T H.273; None: those of sRGB.
H273_PRIMARIES: dict[int, tuple[float, ...] | None] = {
    1: None,
    2: None,  # unspecified
    4: (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *D65),
    6: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *D65),
    7: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *D65),
    8: (0.681, 0.319, 0.243, 0.692, 0.145, 0.049, 0.310, 0.316),
    9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
    10: (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0 / 3.0, 1.0 / 3.0),
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),
    22: (0.630, 0.340, 0.295, 0.605, 0.155, 0.077, *D65),
}
#: Transfer functions by the codes of Rec. ITU-T H.273: names, or gammas.
H273_TRANSFERS: dict[int, str | float] = {
    **dict.fromkeys((1, 6, 14, 15), "bt709"),
    **dict.fromkeys((2, 13), "srgb"),  # 2: unspecified
    4: 2.2,
    5: 2.8,
    7: "smpte240m",
    8: "linear",
    17: "st428",
}
#: Transfer functions whose white is not that of a relative scale.
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
#: Constants of Rec. ITU-R BT.709 and BT.2020 in full precision, and of SMPTE ST 240: offset, end of the linear part, slope.
OETF = {"bt709": (0.09929682680944, 0.018053968510807, 4.5), "smpte240m": (0.1115, 0.0228, 4.0)}


@dataclass(frozen=True, kw_only=True)
class Colour:
    """
    Relation between the numbers of a picture and light.

    ``transfer``: ``"srgb"``, ``"linear"``, ``"bt709"``, ``"smpte240m"``, ``"st428"``, a gamma (light is the value to this
    power), or a table (1 or 3, 2**bits) of the light of each integer. ``primaries``: chromaticities x and y of red, green, blue
    and white; None: those of sRGB. ``neutral``: chromaticity that becomes white; None: that of the primaries. ``profile``: ICC
    profile, which replaces these. ``problem``: why the colours are not defined; reported unless a caller chooses an encoding.
    """

    transfer: str | float | NDArray[Any] = "srgb"
    primaries: tuple[float, ...] | None = None
    neutral: tuple[float, float] | None = None
    profile: bytes = b""
    problem: str = ""


SRGB, LINEAR = Colour(), Colour(transfer="linear")


@dataclass(frozen=True, kw_only=True)
class FilePicture:
    """
    Pixels of a file as stored, upright, top row first, and what they mean.

    ``pixels`` (n_y, n_x) or (n_y, n_x, n_channel). ``has_inks``: whether the channels are cyan, magenta, yellow and black,
    where 0 is no ink, instead of grey or colour with or without alpha.
    """

    pixels: NDArray[Any]
    colour: Colour = SRGB
    has_inks: bool = False

    def values(self) -> NDArray[Any]:
        """Return the stored values; of inks, what an ideal printer without a profile shows."""
        return without_inks(self.pixels) if self.has_inks else self.pixels


@dataclass(frozen=True, kw_only=True)
class EncodedPicture:
    """
    Pixels in sRGB primaries, top row first, and their encoding.

    ``is_wide``: whether linear colour channels may be negative, for colours outside sRGB. ``is_array``: whether the picture was
    an array, whose channels a caller may have in another order.
    """

    pixels: NDArray[Any]
    encoding: Encoding
    is_wide: bool = False
    is_array: bool = False

    def crop(self, rows: slice, columns: slice) -> EncodedPicture:
        """Return a part of the picture."""
        return replace(self, pixels=self.pixels[rows, columns])


def h273_colour(primaries: int, transfer: int) -> Colour:
    """Return the colours of the codes of primaries and transfer of Rec. ITU-T H.273."""
    if transfer in HDR_TRANSFERS:
        return Colour(problem=f"has the transfer function {HDR_TRANSFERS[transfer]}, whose white is not defined")
    if transfer not in H273_TRANSFERS or primaries not in H273_PRIMARIES:
        return Colour(problem=f"has the unsupported colours {primaries}/{transfer} of Rec. ITU-T H.273")
    return Colour(transfer=H273_TRANSFERS[transfer], primaries=H273_PRIMARIES[primaries])


def encoded_picture(found: FilePicture, encoding: FileEncoding) -> EncodedPicture:
    """
    Return the pixels of a file in sRGB primaries with their encoding.

    An encoding other than "auto" replaces what the file states. Pixels in sRGB are returned unchanged; other colours become
    linear float32. Raises FormatError when the colours are not defined, or their profile is broken.
    """
    if encoding != "auto":
        return EncodedPicture(pixels=found.values(), encoding=encoding)
    colour, pixels = found.colour, found.pixels
    if colour.problem:
        raise FormatError(f"{colour.problem}; {CURE}")
    if found.has_inks and not colour.profile:
        raise FormatError(f"has CMYK without a colour profile, so that its colours are not defined; {CURE}")
    n_channels = pixels.shape[2] if pixels.ndim == 3 else 1
    n_colours = 4 if found.has_inks else n_channels - (n_channels in (2, 4))
    if colour.profile:
        convert = profile_to_srgb(colour.profile, n_colours)
        if convert is None:
            return EncodedPicture(pixels=pixels, encoding="srgb")
    elif (
        isinstance(colour.transfer, str)
        and colour.transfer in ("srgb", "linear")
        and not _needs_matrix(colour, n_colours)
    ):
        is_linear = colour.transfer == "linear"
        is_wide = is_linear and n_colours == 3 and pixels.dtype.kind == "f"
        return EncodedPicture(pixels=pixels, encoding="linear" if is_linear else "srgb", is_wide=is_wide)
    else:
        convert = _space_to_srgb(colour, n_colours)
    light = convert(pixels[..., :n_colours] if n_colours < n_channels else pixels)
    if n_colours == n_channels or found.has_inks:
        return EncodedPicture(pixels=light, encoding="linear", is_wide=n_colours > 1)
    alpha = pixels[..., -1:]
    peak = np.float32(np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1.0)
    joined = np.concatenate((np.atleast_3d(light), alpha / peak), axis=2, dtype=np.float32)
    return EncodedPicture(pixels=joined, encoding="linear", is_wide=n_colours > 1)


def without_inks(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return red, green and blue as the light that four ideal inks leave."""
    peak = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0
    light = (peak - pixels[..., :3].astype(np.float64)) * (peak - pixels[..., 3:]) / peak
    return np.rint(light).astype(pixels.dtype) if pixels.dtype.kind == "u" else light.astype(pixels.dtype)


def _needs_matrix(colour: Colour, n_colours: int) -> bool:
    if n_colours != 3:
        return False
    xy = SRGB_XY if colour.primaries is None else np.reshape(colour.primaries, (4, 2))
    if colour.neutral is not None and np.abs(np.array(colour.neutral) - xy[3]).max() > ROUNDING_XY:
        return True
    return bool(np.abs(xy - SRGB_XY).max() > ROUNDING_XY)


def _space_to_srgb(colour: Colour, n_colours: int) -> Callable[[NDArray[Any]], NDArray[np.float32]]:
    """Return the conversion of pixels by a transfer function and primaries."""
    matrix = _matrix(colour).astype(np.float32) if _needs_matrix(colour, n_colours) else None

    def convert(pixels: NDArray[Any]) -> NDArray[np.float32]:
        light = _linear(pixels, colour.transfer)
        return light if matrix is None else np.asarray(light @ matrix)

    return convert


def _matrix(colour: Colour) -> Floats:
    """Return the matrix (3, 3) from linear colours in rows to linear sRGB."""
    xy = SRGB_XY if colour.primaries is None else np.reshape(colour.primaries, (4, 2))
    neutral = xy[3:] if colour.neutral is None else np.reshape(colour.neutral, (1, 2))
    try:
        with np.errstate(all="raise"):
            # The values of this code are X, Y and Z.
            xyz = np.eye(3) if colour.primaries == H273_PRIMARIES[10] else xyz_of_primaries(xy)
            matrix = srgb_of_xyz(xyz, xyz_of_xy(neutral)[0])
    except (np.linalg.LinAlgError, FloatingPointError):
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        raise FormatError(f"has primaries that define no colours, {np.round(xy, 4).tolist()}; {CURE}")
    return matrix


def _linear(pixels: NDArray[Any], transfer: str | float | NDArray[Any]) -> NDArray[np.float32]:
    """Return relative light of encoded values."""
    if isinstance(transfer, np.ndarray):
        if len(transfer) == 1:
            return np.asarray(transfer[0].astype(np.float32)[pixels])
        channels = [table.astype(np.float32)[pixels[..., k]] for k, table in enumerate(transfer)]
        return np.stack(channels, axis=-1)
    if pixels.dtype.kind == "u":
        peak = np.iinfo(pixels.dtype).max
        table = _curve(np.arange(peak + 1) / peak, transfer).astype(np.float32)
        return np.asarray(table[pixels])
    # Curves are continued symmetrically: negative linear values are colours outside the primaries.
    light = np.copysign(_curve(np.abs(pixels.astype(np.float64)), transfer), pixels)
    return np.asarray(light.astype(np.float32))


def _curve(values: Floats, transfer: str | float) -> Floats:
    """Return light of values >= 0 by a transfer function."""
    if isinstance(transfer, str):
        if transfer in OETF:
            offset, end, slope = OETF[transfer]
            powers = ((values + offset) / (1.0 + offset)) ** (1.0 / 0.45)
            return np.where(values < slope * end, values / slope, powers)
        if transfer == "st428":
            return np.asarray(52.37 / 48.0 * values**2.6)
        return decode(values, "linear" if transfer == "linear" else "srgb")
    return np.asarray(values**transfer)
