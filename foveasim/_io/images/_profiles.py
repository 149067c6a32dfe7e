"""
ICC profiles of pictures, by littleCMS.

Pillow answers whether a profile is sRGB; imagecodecs converts others, with floating-point numbers. The intent is relative
colorimetric without black point compensation: the white of the profile becomes the white of sRGB.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.caches import BoundedCache
from foveasim._core.extras import import_optional, needs
from foveasim._core.validation import Floats
from foveasim._io.formats import FormatError
from foveasim._io.primaries import XYZ_OF_SRGB, srgb_of_xyz
from foveasim.errors import ParameterError, printable

#: Larger profiles are rejected; those of printers with fine tables have up to 4 MB.
MAX_PROFILE_BYTES = 2**24
#: Position of the colour space in a profile, and channels of the colour spaces that are read, with their names in imagecodecs.
SPACE = slice(16, 20)
SPACES = {b"GRAY": (1, "gray"), b"RGB ": (3, "rgb"), b"CMYK": (4, "cmyk")}
#: Largest difference from sRGB in codes of 8 bits: the rounding of 8-bit conversions.
SRGB_TOLERANCE = 1
#: White of the connection space (ICC.1:2022, section 7.2.16), and largest error of curves and a matrix for a profile.
D50_XYZ, MATRIX_TOLERANCE = np.array([0.9642, 1.0, 0.8249]), 2e-4
#: Pixels that are converted at once.
BLOCK_PIXELS = 2**20

#: From pixels (n_y, n_x, n_colour), or (n_y, n_x) of grey, to linear sRGB of the same shape, or of three channels.
Conversion = Callable[[NDArray[Any]], NDArray[np.float32]]
#: From relative values (n, n_channel), 0 to 1, to linear sRGB (n, 3).
Evaluation = Callable[[Floats], Floats]
_conversions = BoundedCache(16)


def profile_to_srgb(profile: bytes, n_colours: int) -> Conversion | None:
    """
    Return the conversion of pixels to linear sRGB; None if the profile is sRGB.

    The result is float32, beyond 0 to 1 for colours outside sRGB.

    ``n_colours``: 1 for grey, 3 for colour and 4 for inks. Raises FormatError when the profile is broken, is that of another
    colour space, or needs imagecodecs.
    """
    if len(profile) > MAX_PROFILE_BYTES:
        raise FormatError(f"has a colour profile of {len(profile)} bytes, more than the limit of {MAX_PROFILE_BYTES}")
    found: Conversion | None = _conversions.get((profile, n_colours), lambda: _conversion(profile, n_colours))
    return found


def _conversion(profile: bytes, n_colours: int) -> Conversion | None:
    cure = "to ignore it, choose encoding='srgb'"
    n_channels, space = SPACES.get(profile[SPACE], (0, ""))
    if n_channels == 0 and len(profile) >= 128:
        name = printable(profile[SPACE].decode("latin-1").strip())
        raise FormatError(f"has a colour profile of the unsupported colour space {name!r}; {cure}")
    # Grey pixels in a profile of colours have equal red, green and blue.
    if n_channels not in (0, n_colours) and (n_channels, n_colours) != (3, 1):
        raise FormatError(f"has a colour profile of {n_channels} channels, but {n_colours} colour channels; {cure}")
    broken = FormatError(f"has a broken colour profile; {cure}")
    title = _title(profile)
    if title is None or n_channels == 0:
        raise broken
    if n_channels < 4 and _is_srgb(profile, n_channels):
        return None
    try:
        imagecodecs = import_optional("picture", "imagecodecs")
    except ParameterError:
        message = f"has the colour profile {title!r}, whose conversion {needs('imagecodecs')}; {cure}"
        raise FormatError(message) from None
    try:
        evaluate = _evaluation(imagecodecs, profile, space)
        evaluate(np.ones((1, n_channels)))  # profiles may lack what a conversion needs
        matrix = _matrix(evaluate) if n_colours == n_channels == 3 else None
    except (imagecodecs.CmsError, ValueError, TypeError, RuntimeError):
        raise broken from None
    if n_colours == 1:
        return _GreyConversion(evaluate, n_channels)
    if matrix is not None:
        return _MatrixConversion(evaluate, matrix)
    return lambda pixels: _in_blocks(_relative(pixels), evaluate).reshape(*pixels.shape[:-1], 3)


def _title(profile: bytes) -> str | None:
    """Return the description of a profile; None if it is broken."""
    from PIL import ImageCms

    try:
        found = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except ImageCms.PyCMSError:
        return None
    except (ImportError, OSError, ValueError, TypeError, UnicodeError):
        return None
    return f"{printable(' '.join(found.split())):.60}"


def _is_srgb(profile: bytes, n_channels: int) -> bool:
    """Return whether a profile gives the codes of sRGB for greys and a lattice of colours."""
    from PIL import Image, ImageCms

    levels = np.arange(0, 256, 17, dtype=np.uint8)
    greys = np.arange(256, dtype=np.uint8)
    if n_channels == 1:
        codes = greys[np.newaxis]
    else:
        lattice = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
        codes = np.concatenate((lattice, np.repeat(greys, 3).reshape(-1, 3)))[np.newaxis]
    mode = "L" if n_channels == 1 else "RGB"
    try:
        transform = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)),
            ImageCms.createProfile("sRGB"),
            mode,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
        )
        found = ImageCms.applyTransform(Image.fromarray(codes), transform)
    except (ImageCms.PyCMSError, ValueError):
        return False
    assert found is not None
    expected = codes[..., np.newaxis] if n_channels == 1 else codes
    return bool(np.abs(np.asarray(found, np.int16) - expected).max() <= SRGB_TOLERANCE)


def _evaluation(imagecodecs: Any, profile: bytes, space: str) -> Evaluation:
    """Return the function from relative values (n, n_channel), 0 to 1, to linear sRGB (n, 3)."""
    xyz_profile = imagecodecs.cms_profile("xyz")
    scale = np.float32(100.0 if space == "cmyk" else 1.0)  # inks in per cent

    def evaluate(values: Floats) -> Floats:
        xyz = imagecodecs.cms_transform(
            np.ascontiguousarray(values[np.newaxis, :, 0] if space == "gray" else values[np.newaxis], np.float32)
            * scale,
            profile,
            xyz_profile,
            colorspace=space,
            outcolorspace="xyz",
            outdtype="float32",
            intent=imagecodecs.CMS.INTENT.RELATIVE_COLORIMETRIC,
        )
        return srgb_of_xyz(np.asarray(xyz, np.float64).reshape(-1, 3), D50_XYZ)

    return evaluate


def _matrix(evaluate: Evaluation) -> Floats | None:
    """Return linear sRGB (3, 3) of the primaries of curves and a matrix; None for tables."""
    levels = (0.05, 0.3, 0.6, 0.95)
    samples = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
    matrix = evaluate(np.eye(3)) - evaluate(np.zeros((1, 3)))
    if np.abs(evaluate(np.zeros((1, 3)))).max() > MATRIX_TOLERANCE or np.abs(matrix).sum(axis=1).min() <= 0.0:
        return None
    curves = np.stack([_curve(evaluate, samples[:, k], k, matrix) for k in range(3)], axis=-1)
    if np.abs(curves @ matrix - evaluate(samples)).max() > MATRIX_TOLERANCE:
        return None
    return np.asarray(matrix / matrix.sum(axis=0))  # the profile's numbers are rounded: white is exactly 1


def _curve(evaluate: Evaluation, values: Floats, channel: int, matrix: Floats) -> Floats:
    """Return the light of values (n,) of one channel, relative to that of the value 1."""
    colours = np.zeros((values.size, 3))
    colours[:, channel] = values
    direction = matrix[channel]
    return np.asarray(evaluate(colours) @ direction / (direction @ direction))


class _MatrixConversion:
    """Conversion by one table per channel and a matrix, which keeps the precision of 16 bits."""

    def __init__(self, evaluate: Evaluation, matrix: Floats) -> None:
        self.evaluate, self.matrix = evaluate, matrix
        self.tables: dict[int, list[NDArray[np.float32]]] = {}

    def __call__(self, pixels: NDArray[Any]) -> NDArray[np.float32]:
        if pixels.dtype.kind != "u":
            return _in_blocks(pixels, self.evaluate).reshape(pixels.shape)
        peak = int(np.iinfo(pixels.dtype).max)
        if peak not in self.tables:
            values, measured = np.arange(peak + 1) / peak, self.evaluate(np.eye(3))
            self.tables[peak] = [_curve(self.evaluate, values, k, measured).astype(np.float32) for k in range(3)]
        light = np.stack([table[pixels[..., k]] for k, table in enumerate(self.tables[peak])], axis=-1)
        return np.asarray(light @ self.matrix.astype(np.float32))


class _GreyConversion:
    """Conversion of grey, in a profile of grey or of colours."""

    def __init__(self, evaluate: Evaluation, n_channels: int) -> None:
        self.evaluate, self.n_channels = evaluate, n_channels

    def __call__(self, pixels: NDArray[Any]) -> NDArray[np.float32]:
        if pixels.dtype.kind != "u":
            return self._luminance(pixels.ravel()).reshape(pixels.shape)
        peak = np.iinfo(pixels.dtype).max
        return np.asarray(self._luminance(np.arange(peak + 1) / peak)[pixels])

    def _luminance(self, values: Floats) -> NDArray[np.float32]:
        colours = _in_blocks(np.repeat(values[:, np.newaxis], self.n_channels, axis=1), self.evaluate)
        return np.asarray(colours @ XYZ_OF_SRGB[:, 1].astype(np.float32))


def _relative(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return pixels from 0 to 1."""
    return pixels / np.float32(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else pixels


def _in_blocks(pixels: NDArray[Any], evaluate: Evaluation) -> NDArray[np.float32]:
    """Return linear sRGB (n, 3) of relative pixels (..., n_channel)."""
    flat = pixels.reshape(-1, pixels.shape[-1])
    found = np.empty((len(flat), 3), np.float32)
    for start in range(0, len(flat), BLOCK_PIXELS):
        found[start : start + BLOCK_PIXELS] = evaluate(flat[start : start + BLOCK_PIXELS])
    return found
