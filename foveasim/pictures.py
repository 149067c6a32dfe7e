"""
Picture files, in and out: what a photograph's file holds as an array, and arrays as files.

Arrays here are as in the file: (n_y, n_x) or (n_y, n_x, n_channel), the first row on top.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import FileError
from foveasim.files import written_whole

__all__ = ["read_picture", "write_picture"]

#: Larger pictures are refused: 2**28 pixels are 3 GiB as three float32 channels.
MAX_PIXELS = 2**28
#: Formats that Pillow is asked for; its other readers are for files that are no pictures of scenes.
PILLOW_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "PPM", "JPEG2000", "TGA")
#: Pillow's modes that hold the numbers of the file, and what every other mode is converted to.
PLAIN_MODES = ("L", "LA", "RGB", "RGBA", "I;16", "F")


def read_picture(path: str | Path) -> NDArray[Any]:
    """
    The numbers in a picture file.

    Parameters
    ----------
    path : path
        PNG, JPEG, TIFF, WebP, BMP, GIF, PPM, JPEG 2000; with the extra ``pictures`` also EXR and Radiance HDR, and PNG of
        16 bits in colour.

    Returns
    -------
    picture : (n_y, n_x) or (n_y, n_x, n_channel), uint8, uint16 or float32
        First row on top; 1 to 4 channels: grey, grey and alpha, colour, colour and alpha. Palettes are resolved, and a
        camera's note of how it was held is followed.

    Raises
    ------
    FileError
        When the file is missing, no picture, cut short, too large, or holds several pictures.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(path, "no such file" if not path.exists() else "is not a file")
    with path.open("rb") as file:
        head = file.read(32)
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        picture = _read_tiff(path)
    elif head[:4] == b"\x76\x2f\x31\x01" or head[:2] == b"#?" or _is_deep_colour_png(head):
        picture = _read_deep(path)
    else:
        picture = _read_with_pillow(path)
    if picture.ndim not in (2, 3) or 0 in picture.shape or (picture.ndim == 3 and picture.shape[2] > 4):
        raise FileError(path, f"must be one picture of 1 to 4 channels, got an array of the shape {picture.shape}")
    return picture


def _read_with_pillow(path: Path) -> NDArray[Any]:
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=PILLOW_FORMATS) as image:
                _check_size(path, image.width, image.height)
                n_pictures = getattr(image, "n_frames", 1)
                if n_pictures > 1:
                    raise FileError(path, f"holds {n_pictures} pictures; give a file with one")
                if image.mode == "I":
                    # Pillow's 32-bit mode is where 16-bit grey files may land.
                    return np.asarray(image).astype(np.float32)
                upright = ImageOps.exif_transpose(image)
                if upright.mode not in PLAIN_MODES:
                    upright = upright.convert("RGBA" if "transparency" in upright.info else _target_mode(upright.mode))
                return np.asarray(upright)
    except FileError:
        raise
    except UnidentifiedImageError:
        raise FileError(path, "is not a picture in a format that can be read") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise FileError(path, f"has more than {MAX_PIXELS} pixels") from None
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise FileError(path, f"is broken or cut short ({error})") from None


def _target_mode(mode: str) -> str:
    return {"1": "L", "PA": "RGBA", "La": "LA", "RGBa": "RGBA", "I;16B": "I;16", "I;16L": "I;16"}.get(mode, "RGB")


def _read_tiff(path: Path) -> NDArray[Any]:
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            if len(file.series) != 1 or len(file.pages) != 1:
                raise FileError(path, f"holds {len(file.pages)} pictures; give a file with one")
            page = file.pages[0]
            _check_size(path, page.shape[1], page.shape[0])
            picture = page.asarray()
            if page.photometric == tifffile.PHOTOMETRIC.PALETTE and page.colormap is not None:
                picture = np.moveaxis(page.colormap[:, picture], 0, -1)
            if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and picture.ndim == 3:
                picture = np.moveaxis(picture, 0, -1)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 -- tifffile raises whatever a broken file made it trip over
        raise FileError(path, f"is broken or cut short ({error})") from None
    if picture.dtype == np.bool_:
        return picture.astype(np.uint8) * 255
    if picture.dtype in (np.uint8, np.uint16):
        return picture
    if picture.dtype.kind == "f":
        return picture.astype(np.float32)
    raise FileError(path, f"must hold 8-bit, 16-bit or floating-point numbers, got {picture.dtype}")


def _is_deep_colour_png(head: bytes) -> bool:
    """Whether a file is a PNG of 16 bits in colour or with alpha, which Pillow would cut to 8 bits."""
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:25] == b"\x10" and head[25:26] in (b"\x02", b"\x04", b"\x06")


def _read_deep(path: Path) -> NDArray[Any]:
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))
    try:
        import cv2
    except ImportError:
        raise FileError(
            path, "needs a reader for EXR, HDR and 16-bit colour: pip install 'foveasim[pictures]'"
        ) from None
    try:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FileError(path, f"is broken or cut short ({str(error).strip().splitlines()[-1]})") from None
    if picture is None:
        raise FileError(path, "is broken or cut short, or not a picture that can be read")
    _check_size(path, picture.shape[1], picture.shape[0])
    if picture.ndim == 3 and picture.shape[2] >= 3:
        picture = picture[..., [2, 1, 0, 3][: picture.shape[2]]]  # OpenCV's colours come as blue, green, red
    return picture if picture.dtype in (np.uint8, np.uint16) else picture.astype(np.float32)


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise FileError(path, f"has {width} x {height} pixels, more than the limit of {MAX_PIXELS}")


def write_picture(path: str | Path, picture: NDArray[np.uint8]) -> None:
    """
    Write a picture file, whole or not at all.

    Parameters
    ----------
    path : path
        Its ending chooses the format: ``.png`` keeps every number.
    picture : (n_y, n_x) or (n_y, n_x, n_channel) uint8
        First row on top; grey, grey and alpha, colour, or colour and alpha.

    Raises
    ------
    FileError
        When the ending names no known format, or nothing can be written.
    """
    from PIL import Image

    target = Path(path)
    if Image.registered_extensions().get(target.suffix.lower()) not in PILLOW_FORMATS:
        raise FileError(target, "must end in the name of a picture format, such as .png")
    with written_whole(target) as temporary:
        Image.fromarray(np.ascontiguousarray(picture)).save(temporary)
