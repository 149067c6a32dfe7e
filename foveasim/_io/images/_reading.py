"""Reading of picture files."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import missing_path
from foveasim._core.validation import as_any_array
from foveasim._io.encodings import FileEncoding
from foveasim._io.formats import FormatError
from foveasim._io.images import _exr, _png, _tiff
from foveasim._io.images._camera import read_heif, read_raw
from foveasim._io.images._colour import Colour, EncodedPicture, FilePicture, encoded_picture, h273_colour
from foveasim._io.images._limits import RAW_EXTENSIONS, max_decompressed_bytes
from foveasim._io.images._pillow import picture_of_image, read_with_pillow
from foveasim._io.images._profiles import MAX_PROFILE_BYTES
from foveasim._io.images._radiance import read_radiance
from foveasim._io.sandbox import read_in_sandbox
from foveasim.errors import FileError, ParameterError

#: First bytes of EXR and Radiance HDR.
EXR_MAGIC, RADIANCE_MAGIC = b"\x76\x2f\x31\x01", b"#?"
#: Brands of the pictures in files of the ISO base media format: AVIF, and HEIC in all profiles.
AVIF_BRANDS = (b"avif", b"avis")
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1")


def read_picture(path: str | Path) -> NDArray[Any]:
    """
    Read the stored values of a picture file; for light see :func:`as_encoded`.

    ``path``: PNG, JPEG, TIFF, WebP, BMP, GIF, PPM, JPEG 2000, AVIF; with the extra ``pictures`` also Radiance HDR, EXR, HEIC,
    and camera raw files, which are demosaiced with the white balance of the camera and encoded in sRGB. Returns ``picture``
    (n_y, n_x) or (n_y, n_x, n_channel), uint8, uint16 or float32: top row first; 1 to 4 channels: grey, grey and alpha, colour,
    colour and alpha. Palettes are converted to colours, and the orientation tag is applied. Raises FileError when the file is
    missing, not a picture, truncated, too large, contains several pictures, or states what changes the meaning of its pixels
    and is not known.

    Bit errors are detected in formats with checksums: PNG, and EXR and TIFF with deflate compression. EXR, HEIC and raw files
    are read in the sandbox process, because corrupt files can crash their libraries.
    """
    return _read_file(Path(path)).values()


def as_encoded(picture: Any, encoding: FileEncoding = "auto") -> EncodedPicture:
    """
    Return a picture in sRGB primaries with its encoding, which is decided here alone.

    ``picture``: path, image of Pillow, array, or a result of this function, which is returned unchanged. ``encoding``: "auto"
    is what the file states (profiles, gamma, primaries), or its format defines: linear for EXR, Radiance HDR, PFM,
    floating-point TIFF, and images of Pillow of the mode F; sRGB for all others, and for arrays. Every other encoding replaces
    this. Raises FileError for files, and ParameterError for None and for data that are not a picture.
    """
    if isinstance(picture, EncodedPicture):
        return picture
    if isinstance(picture, str | os.PathLike):
        path = Path(picture)
        found = _read_file(path)
        try:
            return encoded_picture(found, encoding)
        except FormatError as error:
            raise FileError(path, str(error)) from None
        except MemoryError:
            raise FileError(path, "needs more memory than is available") from None
    if picture is None:
        hint = "cv2.imread returns None for files that it cannot read"
        raise ParameterError("picture", "must be a file, an image or an array", picture, hint=hint)
    pillow = sys.modules.get("PIL.Image")
    if pillow is None or not isinstance(picture, pillow.Image):
        pixels = as_any_array("picture", picture)
        return EncodedPicture(pixels=pixels, encoding="srgb" if encoding == "auto" else encoding, is_array=True)
    try:
        return encoded_picture(picture_of_image(picture), encoding)
    except FormatError as error:
        raise ParameterError("picture", f"must be an image with known colours, but {error}") from None
    except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on corrupt files
        problem = " ".join(str(error).split()) or type(error).__name__
        raise ParameterError("picture", f"must be an image that Pillow can decode: {problem}") from None


def _read_file(path: Path) -> FilePicture:
    """Read a file; raise FileError as :func:`read_picture`."""
    try:
        if not path.is_file():
            raise FileError(path, missing_path(path))
        with path.open("rb") as file:
            head = file.read(32)
    except OSError as error:
        raise FileError(path, f"cannot be opened: {error.strerror or error}") from None
    try:
        found = _select_reader(path, head)(path)
    except FileError:
        raise
    except FormatError as error:
        raise FileError(path, str(error)) from None
    except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on corrupt files
        raise FileError(
            path, f"is corrupt or truncated ({' '.join(str(error).split()) or type(error).__name__})"
        ) from None
    pixels = found.pixels
    if pixels.ndim not in (2, 3) or 0 in pixels.shape or (pixels.ndim == 3 and pixels.shape[2] > 4):
        raise FileError(path, f"must be one picture of 1 to 4 channels, got an array of the shape {pixels.shape}")
    return found


def _select_reader(path: Path, head: bytes) -> Callable[[Path], FilePicture]:
    """Return the reader for a file that begins with these bytes: it may raise any exception."""
    if path.suffix.lower() in RAW_EXTENSIONS:
        return _read_raw
    if head[4:8] == b"ftyp" and any(brand in head for brand in AVIF_BRANDS):
        return _read_avif
    if head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS:
        return _read_heif
    if head[:4] in _tiff.MAGICS:
        return _tiff.read_tiff
    if head[:8] == _png.MAGIC and head[24:25] == b"\x10":
        return _read_deep_png
    if head[:4] == EXR_MAGIC:
        return _read_exr
    if head[:2] == RADIANCE_MAGIC:
        return read_radiance
    return read_with_pillow


def _read_deep_png(path: Path) -> FilePicture:
    content = path.read_bytes()
    return _png.read_deep_png(path, content, _png.chunks_of(content))


def _read_avif(path: Path) -> FilePicture:
    from PIL import Image

    Image.init()
    if "AVIF" not in Image.OPEN:
        raise FormatError("needs Pillow 11.3 or later with AVIF; install it with: pip install --upgrade pillow")
    return read_with_pillow(path, ("AVIF",))


def _read_exr(path: Path) -> FilePicture:
    # OpenEXR prints read errors and may continue without the data.
    about, (pixels,) = read_in_sandbox(
        _exr.read_exr, path, kind="EXR", max_decompressed_bytes=max_decompressed_bytes, is_silent=True
    )
    primaries, neutral = about["primaries"], about["neutral"]
    if len(primaries or range(8)) != 8 or len(neutral or range(2)) != 2:
        raise FormatError("has a broken attribute chromaticities or adoptedNeutral")
    colour = Colour(
        transfer="linear",
        primaries=None if primaries is None else tuple(map(float, primaries)),
        neutral=None if neutral is None else (float(neutral[0]), float(neutral[1])),
        problem=str(about["problem"]),
    )
    return FilePicture(pixels=pixels, colour=colour)


def _read_heif(path: Path) -> FilePicture:
    about, (pixels, profile) = read_in_sandbox(
        read_heif, path, kind="HEIC", max_decompressed_bytes=max_decompressed_bytes
    )
    if profile.nbytes > MAX_PROFILE_BYTES:
        raise FormatError("has a colour profile that is too large")
    if profile.size:
        return FilePicture(pixels=pixels, colour=Colour(profile=profile.astype(np.uint8).tobytes()))
    codes = about["h273"]
    return FilePicture(pixels=pixels, colour=Colour() if codes is None else h273_colour(int(codes[0]), int(codes[1])))


def _read_raw(path: Path) -> FilePicture:
    _, (pixels,) = read_in_sandbox(read_raw, path, kind="raw", max_decompressed_bytes=max_decompressed_bytes)
    return FilePicture(pixels=pixels)
