"""Pixels of decoded frames of PyAV: RGB or grey with the depth of the file, upright."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io.videos.colours import LUMA_WEIGHTS, MATRIX_NAMES
from foveasim.errors import FileError

#: Values of the colour range.
LIMITED, FULL = 1, 2
#: Parts of the names of formats whose numbers are not those of a picture.
OTHER_FORMATS = ("bayer", "xyz", "f16", "f32", "hsv", "uyyvyy", "vuy", "ayuv", "xv")
#: Depths of planar formats of the video library.
DEPTHS = (8, 9, 10, 12, 14, 16)
#: Fixed-point unit of the display matrix.
ONE = 1 << 16


def check_frame(path: Path, frame: Any, data: Mapping[str, bytes]) -> None:
    """
    Check that a frame is one flat picture of one moment.

    ``data``: data of the frame by their names in FFmpeg. Raises FileError when it is interlaced, stereoscopic or spherical.
    """
    if frame.interlaced_frame:
        raise FileError(path, "is interlaced; deinterlace it, for example with: ffmpeg -i IN -vf bwdif OUT")
    if any(data.get("STEREO3D", b"")[:4]):
        raise FileError(
            path, "is stereoscopic; extract one of the two pictures, for example with: ffmpeg -i IN -vf stereo3d=OUT"
        )
    if "SPHERICAL" in data:
        raise FileError(path, "is spherical; project it, for example with: ffmpeg -i IN -vf v360=e:flat OUT")


def pixels_of_frame(path: Path, frame: Any) -> NDArray[Any]:
    """
    Return the pixels of a frame as stored, top row first.

    (n_y, n_x) or (n_y, n_x, n_channel) uint8 from 0 to 255, or uint16 from 0 to 65535 for more than 8 bits; 1 to 4 channels:
    grey, grey and alpha, colour, colour and alpha. Raises FileError when the pixel format or the matrix of the colours is not
    supported.
    """
    form = frame.format
    bits = max((component.bits for component in form.components), default=0)
    if any(part in form.name for part in OTHER_FORMATS) or not 1 <= bits <= DEPTHS[-1]:
        raise FileError(
            path, f"has the pixel format {form.name}; convert it to another one, such as yuv444p or gbrp16le"
        )
    n_colours = sum(not component.is_alpha for component in form.components)
    has_alpha = form.has_palette or n_colours < len(form.components)
    if form.is_rgb or form.has_palette:
        return _rgb(frame, bits, has_alpha=has_alpha)
    if n_colours == 1:
        return _grey(frame, bits, has_alpha=has_alpha)
    return _from_luma(path, frame, bits, has_alpha=has_alpha)


def _rgb(frame: Any, bits: int, *, has_alpha: bool) -> NDArray[Any]:
    """Return the pixels of a frame in RGB, of any range full."""
    if bits <= 8:
        packed = frame.reformat(format="rgba" if has_alpha else "rgb24")
        return _plane(packed, 0, np.dtype(np.uint8), 4 if has_alpha else 3)
    depth = _depth(bits)
    name = f"gbr{'a' if has_alpha else ''}p{depth}le"
    planar = frame if frame.format.name == name else frame.reformat(format=name)
    planes = [_plane(planar, k, np.dtype("<u2")) for k in ((2, 0, 1, 3) if has_alpha else (2, 0, 1))]
    return _scaled(np.stack(planes, axis=-1), depth)


def _grey(frame: Any, bits: int, *, has_alpha: bool) -> NDArray[Any]:
    """Return the pixels of a grey frame, of full range unless the file specifies another."""
    if bits < 8:  # black and white
        frame, bits = frame.reformat(format="gray"), 8
    dtype = np.dtype(np.uint8) if bits == 8 else np.dtype(">u2" if frame.format.is_big_endian else "<u2")
    values = _plane(frame, 0, dtype, 2 if has_alpha else 1)
    if int(frame.color_range) != LIMITED:
        return _scaled(values, bits)
    values = values.reshape(*values.shape[:2], -1)
    step = 1 << (bits - 8)
    grey = (values[..., 0].astype(np.float32) - 16 * step) / np.float32(219 * step)
    if has_alpha:
        return np.stack([_rounded(grey, bits), _scaled(values[..., 1], bits)], axis=-1)
    return _rounded(grey, bits)


def _from_luma(path: Path, frame: Any, bits: int, *, has_alpha: bool) -> NDArray[Any]:
    """Return the pixels of a frame in luma and chroma."""
    matrix, name = int(frame.colorspace), frame.format.name
    if matrix not in LUMA_WEIGHTS:
        found = MATRIX_NAMES.get(matrix, f"number {matrix}")
        raise FileError(path, f"has the colour matrix {found}; convert it to BT.709")
    depth = _depth(bits)
    is_jpeg = name.startswith("yuvj")
    full_size = f"yuv{'a' if has_alpha else ''}{'j' if is_jpeg else ''}444p" + (f"{depth}le" if depth > 8 else "")
    sampled = frame if name == full_size else frame.reformat(format=full_size)
    dtype = np.dtype(np.uint8) if depth == 8 else np.dtype("<u2")
    luma, blue, red = (_plane(sampled, k, dtype).astype(np.float32) for k in range(3))
    if is_jpeg or int(frame.color_range) == FULL:
        black, luma_range, chroma_range = 0, (1 << depth) - 1, (1 << depth) - 1
    else:
        step = 1 << (depth - 8)
        black, luma_range, chroma_range = 16 * step, 219 * step, 224 * step
    red_weight, blue_weight = LUMA_WEIGHTS[matrix]
    luma = (luma - black) / np.float32(luma_range)
    red = (red - (1 << (depth - 1))) * np.float32(2.0 * (1.0 - red_weight) / chroma_range)
    blue = (blue - (1 << (depth - 1))) * np.float32(2.0 * (1.0 - blue_weight) / chroma_range)
    # G follows from luma: red_weight R + (1 - red_weight - blue_weight) G + blue_weight B.
    green = luma - (red_weight * red + blue_weight * blue) / np.float32(1.0 - red_weight - blue_weight)
    colours = [_rounded(values, depth) for values in (luma + red, green, luma + blue)]
    alpha = [_scaled(_plane(sampled, 3, dtype), depth)] if has_alpha else []
    return np.stack(colours + alpha, axis=-1)


def _depth(bits: int) -> int:
    """Return the smallest depth of planar formats that contains a number of bits."""
    return next(depth for depth in DEPTHS if depth >= bits)


def _plane(frame: Any, number: int, dtype: np.dtype[Any], n_channels: int = 1) -> NDArray[Any]:
    """Return the numbers of a plane, (n_y, n_x[, n_channel]), without the padding of rows."""
    plane = frame.planes[number]
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height]
    used = np.ascontiguousarray(rows[:, : plane.width * n_channels * dtype.itemsize]).view(dtype)
    values = used.astype(dtype.newbyteorder("="), copy=False)
    return values.reshape(plane.height, plane.width, n_channels) if n_channels > 1 else values


def _scaled(values: NDArray[Any], bits: int) -> NDArray[Any]:
    """Return numbers of a depth as uint8, or uint16 from 0 to 65535."""
    if bits in (8, 16):
        return values
    peak = (1 << bits) - 1
    return ((values.astype(np.uint32) * np.uint32(65535) + np.uint32(peak // 2)) // np.uint32(peak)).astype(np.uint16)


def _rounded(values: NDArray[Any], bits: int) -> NDArray[Any]:
    """Return values 0 to 1 as uint8, or uint16 for more than 8 bits."""
    dtype = np.uint8 if bits == 8 else np.uint16
    peak = np.float32(np.iinfo(dtype).max)
    return np.rint(np.clip(values, np.float32(0.0), np.float32(1.0)) * peak).astype(dtype)


def turned(path: Path, pixels: NDArray[Any], matrix: bytes | None) -> NDArray[Any]:
    """
    Return pixels turned and mirrored by the display matrix of the file, as phones write it.

    Raises FileError when the matrix is another one.
    """
    if matrix is None:
        return pixels
    # x' = a x + c y, y' = b x + d y, with y downwards.
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].tolist()
    if {abs(a), abs(d)} == {ONE} and b == c == 0:
        return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
    if {abs(b), abs(c)} == {ONE} and a == d == 0:
        return pixels.swapaxes(0, 1)[:: -1 if b < 0 else 1, :: -1 if c < 0 else 1]
    raise FileError(
        path, "has a display matrix other than turns by 90 degrees and mirror images; encode the picture upright"
    )
