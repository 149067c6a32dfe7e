"""Writing of picture files: integers in sRGB or marked as linear, linear floats."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.validation import unmasked
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, select_writer
from foveasim._io.images._limits import TIFF_EXTENSIONS
from foveasim._io.images._pillow import encode_with_pillow
from foveasim._io.images._png import MAGIC, UNIT
from foveasim._io.images._tiff import TRANSFER_FUNCTION
from foveasim.errors import FileError, disk_problem

#: Length of signature and header of a PNG, and the chunk that says that values are linear.
PNG_HEADER_BYTES = len(MAGIC) + 25
_GAMMA_BODY = b"gAMA" + struct.pack(">I", UNIT)
GAMMA_1 = struct.pack(">I", 4) + _GAMMA_BODY + struct.pack(">I", zlib.crc32(_GAMMA_BODY))


@dataclass(frozen=True, kw_only=True)
class PictureFormat(FileFormat):
    """
    A format of written pictures; entry of :data:`PICTURE_FORMATS`.

    ``types``: types of the numbers that the format stores; the first is the default. ``has_alpha``: whether the format stores
    the coverage of pixels. ``write_linear``: writer of linear integers, in formats that can say that they are linear.
    """

    types: tuple[str, ...] = ("uint8",)
    has_alpha: bool = False
    write_linear: Callable[[Path, NDArray[Any]], None] | None = None

    def check(self, path: Path, picture: NDArray[Any]) -> None:
        """
        Check that the format can store an array.

        Raises FileError when it cannot.
        """
        n_channels = (picture.shape[2:] or (1,))[0]
        if picture.dtype.name not in self.types or picture.ndim not in (2, 3) or 0 in picture.shape or n_channels > 4:
            raise FileError(
                path,
                f"cannot store an array of the shape {picture.shape} and type {picture.dtype}, only 1 to 4 channels of "
                f"{' or '.join(sorted(self.types, key=lambda name: (name[0] != 'u', name[-1] != '8')))}",
            )
        if n_channels in (2, 4) and not self.has_alpha:
            raise FileError(path, f"cannot store alpha: {self.title} has none; use .png, or a background colour")


def _write_with_pillow(path: Path, picture: NDArray[Any], **options: Any) -> None:
    # Encode in memory: on a full disk, encoders of Pillow leave a truncated file or never return.
    path.write_bytes(encode_with_pillow(picture, path, **options))


def _write_png(path: Path, picture: NDArray[Any], *, is_linear: bool = False) -> None:
    if picture.dtype == np.uint8:
        encoded = encode_with_pillow(picture, path)
    else:
        encoded = import_optional(path, "imagecodecs").png_encode(picture)
    path.write_bytes(encoded[:PNG_HEADER_BYTES] + (GAMMA_1 if is_linear else b"") + encoded[PNG_HEADER_BYTES:])


def _write_tiff(path: Path, picture: NDArray[Any], *, is_linear: bool = False) -> None:
    import tifffile

    n_channels = (picture.shape[2:] or (1,))[0]
    n_values = 2 ** (8 * picture.dtype.itemsize) if is_linear else 0
    light = np.rint(np.linspace(0.0, 65535.0, n_values)).astype(np.uint16)
    tifffile.imwrite(
        path,
        picture,
        photometric="rgb" if n_channels > 2 else "minisblack",
        planarconfig="contig" if n_channels > 1 else None,
        extrasamples=["unassalpha"] if n_channels in (2, 4) else None,
        compression="zlib",
        metadata=None,
        extratags=[(TRANSFER_FUNCTION, "H", n_values, light, True)] if is_linear else [],
    )


def _write_exr(path: Path, picture: NDArray[Any]) -> None:
    """Write linear values; colours are multiplied by alpha, as the format demands."""
    OpenEXR = import_optional(path, "OpenEXR")
    layers = picture.reshape(*picture.shape[:2], -1)
    names = ("Y", "YA", "RGB", "RGBA")[layers.shape[2] - 1]
    if names[-1] == "A":
        layers = np.concatenate((layers[..., :-1] * layers[..., -1:], layers[..., -1:]), axis=2)
    channels = {name: np.ascontiguousarray(layers[..., k]) for k, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


#: Formats of written pictures by name. JPEG and GIF are lossy: JPEG of high quality without chroma subsampling, GIF with a
#: palette of 256 colours.
PICTURE_FORMATS: dict[str, PictureFormat] = {
    "png": PictureFormat(
        title="PNG",
        suffixes=(".png",),
        write=_write_png,
        write_linear=partial(_write_png, is_linear=True),
        types=("uint8", "uint16"),
        has_alpha=True,
    ),
    "tiff": PictureFormat(
        title="TIFF",
        suffixes=TIFF_EXTENSIONS,
        write=_write_tiff,
        write_linear=partial(_write_tiff, is_linear=True),
        types=("float32", "uint8", "uint16"),
        has_alpha=True,
    ),
    "exr": PictureFormat(title="EXR", suffixes=(".exr",), write=_write_exr, types=("float32",), has_alpha=True),
    "jpeg": PictureFormat(
        title="JPEG", suffixes=(".jpg", ".jpeg"), write=partial(_write_with_pillow, quality=95, subsampling=0)
    ),
    "webp": PictureFormat(
        title="WebP",
        suffixes=(".webp",),
        write=partial(_write_with_pillow, lossless=True, exact=True),
        has_alpha=True,
    ),
    "jpeg2000": PictureFormat(title="JPEG 2000", suffixes=(".jp2",), write=_write_with_pillow, has_alpha=True),
    "tga": PictureFormat(title="TGA", suffixes=(".tga",), write=_write_with_pillow, has_alpha=True),
    "bmp": PictureFormat(title="BMP", suffixes=(".bmp",), write=_write_with_pillow),
    "ppm": PictureFormat(title="PPM", suffixes=(".ppm",), write=_write_with_pillow),
    "gif": PictureFormat(title="GIF", suffixes=(".gif",), write=_write_with_pillow),
}


def picture_format(path: str | Path) -> PictureFormat:
    """
    Return the format that has the extension of a file.

    Raises FileError when no format has it; the message lists the extensions.
    """
    found = select_writer(Path(path), PICTURE_FORMATS)
    assert isinstance(found, PictureFormat)
    return found


def write_picture(path: str | Path, picture: NDArray[Any], encoding: Literal["srgb", "linear"] = "srgb") -> None:
    """
    Write a picture file atomically.

    ``path``: the extension selects one of :data:`PICTURE_FORMATS`. ``.png`` and ``.tif`` store uint8 and uint16 losslessly;
    ``.tif`` and, with the extra ``pictures``, ``.exr`` store float32 losslessly, including NaN; other formats store uint8.
    ``picture`` (n_y, n_x) or (n_y, n_x, n_channel) uint8, uint16 or float32: top row first; grey, grey and alpha, colour, or
    colour and alpha. ``encoding``: that of integers; linear ones are marked so, in PNG (gAMA) and TIFF (TransferFunction).
    Floating-point values are linear, as readers expect them. Raises FileError when the extension is unknown, the format does
    not support the array, or the file cannot be written.
    """
    target = Path(path)
    chosen = picture_format(target)
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[..., 0]
    chosen.check(target, picture)
    picture = np.ascontiguousarray(unmasked("picture", picture))
    is_marked = encoding == "linear" and picture.dtype.kind == "u"
    write = chosen.write_linear if is_marked else chosen.write
    if write is None:
        raise FileError(target, f"cannot store linear integers: {chosen.title} has no mark for them; use .png or .tif")
    with atomic_write(target) as temporary:
        try:
            write(temporary, picture)
        except FileError as error:
            raise FileError(target, error.detail) from None
        except (OSError, ValueError, RuntimeError) as error:
            if disk_problem(error):
                raise
            raise FileError(target, f"cannot be written in this format ({error}); use .png") from None
