"""
Reading and writing of picture files.

Arrays have the shape (n_y, n_x) or (n_y, n_x, n_channel), top row first.
"""

from __future__ import annotations

import io
import math
import os
import posixpath
import re
import struct
import sys
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional, needs
from foveasim._core.names import missing_path
from foveasim._core.validation import as_any_array, unmasked
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, select_writer
from foveasim._io.sandbox import read_in_sandbox
from foveasim.errors import FileError, ParameterError, disk_problem

if TYPE_CHECKING:
    from PIL import Image

#: Larger pictures are rejected: 2**28 pixels are 3 GiB as three float32 channels.
MAX_PIXELS = 2**28
#: Limit of decompressed EXR data: a constant, plus the maximum compression ratio of deflate per byte of the file.
MIN_DECOMPRESSED_BYTES, MAX_DECOMPRESSION_RATIO = 2**28, 1032
#: Formats that are read with Pillow; its other formats are not photographs.
PILLOW_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "PPM", "JPEG2000", "TGA")
#: Modes of Pillow that are read unchanged, and conversions of other modes.
UNCHANGED_MODES = ("L", "LA", "RGB", "RGBA", "F")
CONVERTED_MODES = {
    "1": "L",
    "PA": "RGBA",
    "La": "LA",
    "RGBa": "RGBA",
    "I;16": "I",
    "I;16B": "I",
    "I;16L": "I",
    "I": "I",
}
#: Signatures of PNG and of the JPEG 2000 codestream; end marker of JPEG and JPEG 2000.
PNG_MAGIC, JPEG2000_MAGIC, END_MARKER = b"\x89PNG\r\n\x1a\n", b"\xff\x4f\xff\x51", b"\xff\xd9"
#: JPEG marker before the image data, and length of a marker.
START_OF_SCAN, MARKER_BYTES = 0xDA, 2
#: Orientation tag of TIFF and EXIF.
ORIENTATION_TAG = 274
TIFF_EXTENSIONS = (".tif", ".tiff")
#: Extensions of camera raw files, most of which are TIFF files by their first bytes.
RAW_EXTENSIONS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".dng", ".erf", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw", ".orf"),
    *(".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
#: Extensions of picture files in directories.
PICTURE_EXTENSIONS = (
    *(".avif", ".bmp", ".exr", ".hdr", ".heic", ".heif", ".jp2", ".jpeg", ".jpg", ".png", ".ppm", ".tga"),
    *TIFF_EXTENSIONS,
    ".webp",
    *RAW_EXTENSIONS,
)
#: Brands of the pictures in files of the ISO base media format: AVIF, and HEIC in all profiles.
AVIF_BRANDS = (b"avif", b"avis")
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1")
#: Parameters of libraw that give the sRGB encoding of linear values: exponent and slope of the linear part.
SRGB_GAMMA = (2.4, 12.92)


def picture_names(names: Iterable[str]) -> list[str]:
    """
    Return the names of pictures in natural order, ``2.png`` before ``10.png``.

    Hidden files are skipped.
    """
    pictures = (
        name
        for name in names
        if posixpath.splitext(name)[1].lower() in PICTURE_EXTENSIONS
        and not any(part != "." and part.startswith((".", "__MACOSX")) for part in name.split("/"))
    )

    def key(name: str) -> tuple[list[tuple[int, str]], str]:
        # Without leading zeros, integers compare by length and then digits; equal keys compare by name.
        pieces = enumerate(re.split(r"([0-9]+)", name))
        return [(len(n := p.lstrip("0")), n) if k % 2 else (-1, p) for k, p in pieces if p], name

    return sorted(set(pictures), key=key)


def read_picture(path: str | Path) -> NDArray[Any]:
    """
    Read a picture file.

    ``path``: PNG, JPEG, TIFF, WebP, BMP, GIF, PPM, JPEG 2000, AVIF; with the extra ``pictures`` also Radiance HDR, EXR, HEIC,
    and camera raw files, which are demosaiced with the white balance of the camera and encoded in sRGB. Returns ``picture``
    (n_y, n_x) or (n_y, n_x, n_channel), uint8, uint16 or float32: top row first; 1 to 4 channels: grey, grey and alpha, colour,
    colour and alpha. Palettes are converted to colours, and the orientation tag is applied. Raises FileError when the file is
    missing, not a picture, truncated, too large, or contains several pictures.

    Bit errors are detected in formats with checksums: PNG, and EXR and TIFF with deflate compression. EXR, HEIC and raw files
    are read in the sandbox process, because corrupt files can crash their libraries.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise FileError(path, missing_path(path))
        with path.open("rb") as file:
            head = file.read(32)
    except OSError as error:
        raise FileError(path, f"cannot be opened: {error.strerror or error}") from None
    try:
        picture = _select_reader(path, head)(path)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on corrupt files
        raise FileError(
            path, f"is corrupt or truncated ({' '.join(str(error).split()) or type(error).__name__})"
        ) from None
    if picture.ndim not in (2, 3) or 0 in picture.shape or (picture.ndim == 3 and picture.shape[2] > 4):
        raise FileError(path, f"must be one picture of 1 to 4 channels, got an array of the shape {picture.shape}")
    return picture


def _select_reader(path: Path, head: bytes) -> Any:
    """Return the reader for a file that begins with these bytes."""
    if path.suffix.lower() in RAW_EXTENSIONS:
        return partial(_read_in_sandbox, reader=_read_with_libraw, kind="raw")
    if head[4:8] == b"ftyp" and any(brand in head for brand in AVIF_BRANDS):
        return _read_avif
    if head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS:
        return partial(_read_in_sandbox, reader=_read_with_libheif, kind="HEIC")
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _read_tiff
    if head[:8] == PNG_MAGIC and head[24:25] == b"\x10":
        return _read_deep_png
    if head[:4] == b"\x76\x2f\x31\x01":
        # OpenEXR prints read errors and may continue without the data.
        return partial(_read_in_sandbox, reader=_read_with_openexr, kind="EXR", is_silent=True)
    if head[:2] == b"#?":
        return _read_radiance
    return _read_with_pillow


# -- readers: return the upright picture, or raise any exception ----------------------------------------------------


def _read_avif(path: Path) -> NDArray[Any]:
    from PIL import Image

    Image.init()
    if "AVIF" not in Image.OPEN:
        raise FileError(path, "needs Pillow 11.3 or later with AVIF; install it with: pip install --upgrade pillow")
    return _read_with_pillow(path, ("AVIF",))


def _read_with_pillow(path: Path, formats: tuple[str, ...] = PILLOW_FORMATS) -> NDArray[Any]:
    from PIL import Image, UnidentifiedImageError

    try:
        with _pillow_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # invalid metadata
            with Image.open(path, formats=formats) as image:
                check_picture_size(path, image.width, image.height)
                n_pictures = getattr(image, "n_frames", 1)
                if (
                    n_pictures > 1 and image.format != "MPO"
                ):  # MPO files of phones contain previews after the photograph
                    raise FileError(path, f"contains {n_pictures} pictures; provide a file with one picture")
                _check_complete(path, str(image.format))
                return pixels_of_image(image)
    except UnidentifiedImageError:
        raise FileError(path, "is not a picture in a supported format") from None
    except Image.DecompressionBombError:
        raise FileError(path, f"has more than {MAX_PIXELS} pixels") from None


def as_pixels(picture: Any) -> NDArray[Any]:
    """
    Return a picture as an array, as :func:`read_picture` does.

    ``picture``: path, image of Pillow, or array. Raises FileError for files, and ParameterError for None and for data that are
    not a picture.
    """
    if isinstance(picture, str | os.PathLike):
        return read_picture(Path(picture))
    if picture is None:
        hint = "cv2.imread returns None for files that it cannot read"
        raise ParameterError("picture", "must be a file, an image or an array", picture, hint=hint)
    pillow = sys.modules.get("PIL.Image")
    if pillow is None or not isinstance(picture, pillow.Image):
        return as_any_array("picture", picture)
    try:
        return pixels_of_image(picture)
    except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on corrupt files
        problem = " ".join(str(error).split()) or type(error).__name__
        raise ParameterError("picture", f"must be an image that Pillow can decode: {problem}") from None


def pixels_of_image(image: Image.Image) -> NDArray[Any]:
    """
    Convert an image of Pillow to an array as in :func:`read_picture`.

    Raises Exception of any type, when the file is corrupt or the mode cannot be converted.
    """
    image.load()  # Pillow applies the orientation of TIFF on load and removes the tag
    orientation = _orientation(image)
    converted = _convert_mode(image)
    numbers = np.asarray(converted)
    if converted.mode == "I":
        is_16_bit = numbers.min() >= 0 and numbers.max() <= np.iinfo(np.uint16).max
        numbers = numbers.astype(np.uint16 if is_16_bit else np.float32)
    return _apply_orientation(numbers, orientation)


def _check_complete(path: Path, kind: str) -> None:
    """Reject corrupt files that Pillow accepts: wrong checksums of PNG, missing end markers."""
    if kind not in ("PNG", "JPEG", "MPO", "JPEG2000"):
        return
    content = path.read_bytes()
    if kind == "PNG":
        is_complete = _has_valid_checksums(content)
    else:
        begin = content.find(JPEG2000_MAGIC) if kind == "JPEG2000" else _first_scan(content)
        # Compressed image data never contain the end marker.
        is_complete = content.find(END_MARKER, max(begin, 0)) >= 0
    if not is_complete:
        raise FileError(path, "is corrupt or truncated")


def _has_valid_checksums(content: bytes) -> bool:
    """Return whether the checksums of the image data chunks of a PNG are correct."""
    offset, view = len(PNG_MAGIC), memoryview(content)
    while offset + 12 <= len(content):
        begin = offset + 4
        end = begin + 4 + int.from_bytes(view[offset:begin])
        checksum = int.from_bytes(view[end : end + 4])
        if content.startswith(b"IDAT", begin) and zlib.crc32(view[begin:end]) != checksum:
            return False
        offset = end + 4
    return True


def _first_scan(content: bytes) -> int:
    """Return the offset of the image data of a JPEG, after metadata, which may contain a JPEG."""
    offset = MARKER_BYTES
    while content[offset : offset + 1] == b"\xff" and content[offset + 1] != START_OF_SCAN:
        is_filler = content[offset + 1] == 0xFF
        offset += 1 if is_filler else MARKER_BYTES + int.from_bytes(content[offset + 2 : offset + 4])
    return offset


def _convert_mode(image: Image.Image) -> Image.Image:
    """Return the image in a mode that preserves the values, with transparency as a channel."""
    if "transparency" in image.info and image.mode in ("1", "L", "RGB", "P"):
        return image.convert("LA" if image.mode in ("1", "L") else "RGBA")
    return image if image.mode in UNCHANGED_MODES else image.convert(CONVERTED_MODES.get(image.mode, "RGB"))


def _orientation(image: Image.Image) -> Any:
    """Return the orientation tag; 1, upright, where the metadata are corrupt."""
    try:
        return image.getexif().get(ORIENTATION_TAG, 1)
    except Exception:  # noqa: BLE001 -- the picture may be valid although its metadata are corrupt
        return 1


@contextmanager
def _pillow_limit() -> Iterator[None]:
    """Set the pixel limit of Pillow to the limit of this module, inside the block."""
    from PIL import Image

    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = MAX_PIXELS
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _read_tiff(path: Path) -> NDArray[Any]:
    import tifffile
    from tifffile import PHOTOMETRIC

    with tifffile.TiffFile(path) as file:
        if len(file.pages) != 1:
            raise FileError(path, f"contains {len(file.pages)} pictures; provide a file with one picture")
        page = file.pages[0]
        check_picture_size(path, page.imagewidth, page.imagelength)
        if page.photometric not in (
            PHOTOMETRIC.MINISWHITE,
            PHOTOMETRIC.MINISBLACK,
            PHOTOMETRIC.RGB,
            PHOTOMETRIC.PALETTE,
        ):
            name = getattr(page.photometric, "name", page.photometric)
            raise FileError(path, f"is a TIFF with the colour space {name}; save it as grey or RGB")
        if page.samplesperpixel > 4:
            raise FileError(path, f"must be one picture of 1 to 4 channels, got {page.samplesperpixel}")
        picture = pixels_of_page(path, page)
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and picture.ndim == 3:
            picture = np.moveaxis(picture, 0, -1)
        if page.photometric == PHOTOMETRIC.PALETTE:
            picture = np.moveaxis(np.asarray(page.colormap)[:, picture], 0, -1)
        orientation = page.tags[ORIENTATION_TAG].value if ORIENTATION_TAG in page.tags else 1
        is_inverted = page.photometric == PHOTOMETRIC.MINISWHITE
        has_premultiplied_alpha = tifffile.EXTRASAMPLE.ASSOCALPHA in (page.extrasamples or ())
    if picture.dtype == np.bool_:
        picture = picture.astype(np.uint8) * np.uint8(255)
    if picture.dtype not in (np.uint8, np.uint16) and picture.dtype.kind != "f":
        raise FileError(path, f"must contain 8-bit, 16-bit or floating-point numbers, got {picture.dtype}")
    if is_inverted:
        picture = (1 if picture.dtype.kind == "f" else np.iinfo(picture.dtype).max) - picture
    if has_premultiplied_alpha and picture.ndim == 3:
        picture = picture[..., :-1]  # premultiplied alpha: the colours are already composed with black
    return _apply_orientation(picture.astype(np.float32) if picture.dtype.kind == "f" else picture, orientation)


def pixels_of_page(path: Path, page: Any) -> NDArray[Any]:
    """
    Return the pixels of a TIFF page, after checking that the file contains all of them.

    ``path``: the file. ``page``: page of the open file; tifffile would read missing data as 0. Raises FileError when a strip
    or tile is outside the file or missing in the metadata.
    """
    n_bytes = path.stat().st_size
    segments = list(zip(page.dataoffsets, page.databytecounts, strict=False))
    n_expected = 1 if page.is_contiguous else math.prod(page.chunked)
    if len(segments) < n_expected or any(at <= 0 or n <= 0 or at + n > n_bytes for at, n in segments):
        raise FileError(path, "is corrupt or truncated")
    try:
        return np.asarray(page.asarray())
    except ValueError as error:
        if "imagecodecs" in str(error):
            raise FileError(path, f"has a compression that {needs('imagecodecs')}") from None
        raise


def _read_deep_png(path: Path) -> NDArray[Any]:
    """Read a 16-bit PNG, which Pillow would reduce to 8 bits in colour."""
    imagecodecs = import_optional(path, "imagecodecs")
    content = path.read_bytes()
    check_picture_size(path, *struct.unpack(">II", content[16:24]))
    return np.asarray(imagecodecs.png_decode(content))


def _read_radiance(path: Path) -> NDArray[Any]:
    imagecodecs = import_optional(path, "imagecodecs")
    content = path.read_bytes()
    size = next((line.split() for line in content[:4096].split(b"\n") if line[:2] in (b"-Y", b"+Y")), [])
    if len(size) != 4:
        raise FileError(path, "is corrupt or truncated (no size)")
    check_picture_size(path, int(size[3]), int(size[1]))
    return np.asarray(imagecodecs.rgbe_decode(content))


def _read_in_sandbox(path: Path, *, reader: Any, kind: str, is_silent: bool = False) -> NDArray[Any]:
    """Return the picture of a reader that runs in the sandbox process."""
    return read_in_sandbox(
        reader, path, kind=kind, max_decompressed_bytes=_max_decompressed_bytes, is_silent=is_silent
    )[1][0]


def _max_decompressed_bytes(n_bytes: int) -> int:
    return min(MIN_DECOMPRESSED_BYTES + MAX_DECOMPRESSION_RATIO * n_bytes, 16 * MAX_PIXELS)


def _read_with_openexr(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the picture of an EXR file, in the sandbox process."""
    path = Path(name)
    OpenEXR = import_optional(path, "OpenEXR")
    with OpenEXR.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise FileError(path, f"contains {len(file.parts)} pictures; provide a file with one picture")
        low, high = (np.asarray(corner, dtype=np.int64) for corner in file.header()["dataWindow"])
        n_x, n_y = (high - low + 1).tolist()
        check_picture_size(path, n_x, n_y)
    with OpenEXR.File(str(path)) as file:
        layers = {name: channel.pixels for name, channel in file.channels().items()}
    if len(layers) != 1:
        raise FileError(path, f"must have the channels of one picture, got {', '.join(map(repr, layers)):.200}")
    picture = np.asarray(next(iter(layers.values())), dtype=np.float32)
    if picture.shape[:2] != (n_y, n_x):
        raise FileError(path, f"must have channels of {n_x} x {n_y} pixels, got an array of the shape {picture.shape}")
    return {}, [picture]


def _read_with_libheif(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the primary picture of a HEIC file, upright, in the sandbox process."""
    path = Path(name)
    pillow_heif = import_optional(path, "pillow_heif")
    file = pillow_heif.open_heif(name, convert_hdr_to_8bit=False, hdr_to_16bit=False)
    check_picture_size(path, *file.size)
    picture = np.asarray(file)
    largest = 2 ** file.info.get("bit_depth", 8) - 1
    if picture.dtype != np.uint8:  # 10 or 12 bits
        picture = np.rint(picture * (np.iinfo(np.uint16).max / largest)).astype(np.uint16)
    return {}, [picture]


def _read_with_libraw(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Demosaic a raw file in sRGB, as white-balanced by the camera, in the sandbox process."""
    path = Path(name)
    rawpy = import_optional(path, "rawpy")
    with rawpy.imread(name) as raw:
        check_picture_size(path, raw.sizes.raw_width, raw.sizes.raw_height)
        picture = raw.postprocess(
            gamma=SRGB_GAMMA,
            no_auto_bright=True,
            adjust_maximum_thr=0.0,  # white is saturation, not the brightest pixel
            use_camera_wb=True,
            output_bps=16,
            output_color=rawpy.ColorSpace.sRGB,
        )
    return {}, [picture]


def _apply_orientation(picture: NDArray[Any], orientation: object) -> NDArray[Any]:
    """Apply the orientation tag 274 of EXIF and TIFF; values other than 2 to 8 mean upright."""
    if orientation in (5, 6, 7, 8):
        picture = picture.swapaxes(0, 1)
    return picture[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def check_picture_size(path: Path, width: int, height: int) -> None:
    """
    Check the picture size in a file header, before memory is allocated.

    Raises FileError when the number of pixels exceeds ``MAX_PIXELS``.
    """
    if width * height > MAX_PIXELS:
        raise FileError(path, f"has {width} x {height} pixels, more than the limit of {MAX_PIXELS}")


# -- writing ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PictureFormat(FileFormat):
    """
    A format of written pictures; entry of :data:`PICTURE_FORMATS`.

    ``types``: types of the numbers that the format stores; the first is the default. ``has_alpha``: whether the format stores
    the coverage of pixels.
    """

    types: tuple[str, ...] = ("uint8",)
    has_alpha: bool = False

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
    from PIL import Image

    # Encode in memory: on a full disk, encoders of Pillow leave a truncated file or never return.
    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, Image.registered_extensions()[path.suffix.lower()], **options)
    path.write_bytes(encoded.getbuffer())


def _write_png(path: Path, picture: NDArray[Any]) -> None:
    if picture.dtype == np.uint8:
        _write_with_pillow(path, picture)
        return
    imagecodecs = import_optional(path, "imagecodecs")
    path.write_bytes(imagecodecs.png_encode(picture))


def _write_tiff(path: Path, picture: NDArray[Any]) -> None:
    import tifffile

    n_channels = (picture.shape[2:] or (1,))[0]
    tifffile.imwrite(
        path,
        picture,
        photometric="rgb" if n_channels > 2 else "minisblack",
        planarconfig="contig" if n_channels > 1 else None,
        extrasamples=["unassalpha"] if n_channels in (2, 4) else None,
        compression="zlib",
        metadata=None,
    )


def _write_exr(path: Path, picture: NDArray[Any]) -> None:
    OpenEXR = import_optional(path, "OpenEXR")
    layers = picture.reshape(*picture.shape[:2], -1)
    names = ("Y", "YA", "RGB", "RGBA")[layers.shape[2] - 1]
    channels = {name: np.ascontiguousarray(layers[..., k]) for k, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


#: Formats of written pictures by name. JPEG and GIF are lossy: JPEG of high quality without chroma subsampling, GIF with a
#: palette of 256 colours.
PICTURE_FORMATS: dict[str, PictureFormat] = {
    "png": PictureFormat(title="PNG", suffixes=(".png",), write=_write_png, types=("uint8", "uint16"), has_alpha=True),
    "tiff": PictureFormat(
        title="TIFF", suffixes=TIFF_EXTENSIONS, write=_write_tiff, types=("float32", "uint8", "uint16"), has_alpha=True
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


def write_picture(path: str | Path, picture: NDArray[Any]) -> None:
    """
    Write a picture file atomically.

    ``path``: the extension selects one of :data:`PICTURE_FORMATS`. ``.png`` and ``.tif`` store uint8 and uint16 losslessly;
    ``.tif`` and, with the extra ``pictures``, ``.exr`` store float32 losslessly, including NaN; other formats store uint8.
    ``picture`` (n_y, n_x) or (n_y, n_x, n_channel) uint8, uint16 or float32: top row first; grey, grey and alpha, colour, or
    colour and alpha. Raises FileError when the extension is unknown, the format does not support the array, or the file cannot
    be written.
    """
    target = Path(path)
    chosen = picture_format(target)
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[..., 0]
    chosen.check(target, picture)
    picture = np.ascontiguousarray(unmasked("picture", picture))
    assert chosen.write is not None
    with atomic_write(target) as temporary:
        try:
            chosen.write(temporary, picture)
        except FileError as error:
            raise FileError(target, error.detail) from None
        except (OSError, ValueError, RuntimeError) as error:
            if disk_problem(error):
                raise
            raise FileError(target, f"cannot be written in this format ({error}); use .png") from None
