"""
Pictures that Pillow reads, and its images.

Formats: JPEG, PNG of 8 bits, WebP, BMP, GIF, PPM, PFM, JPEG 2000, TGA, AVIF. Their colours, where nothing else is stated
sRGB:

- all: ICC profiles;
- JPEG: Adobe RGB by the interoperability index R03 of EXIF (DCF 2.0); CMYK by its profile, inverted as Adobe stores it;
- PNG: see the module of PNG;
- BMP: colour space, end points and gamma of version 4, profile of version 5; GIF: the profile of the extension ICCRGBG1012;
- PPM: sRGB, as all programs mean it, although the format says Rec. ITU-R BT.709; PFM: linear;
- JPEG 2000, AVIF: colour boxes; TGA: a gamma is reported, because programs disagree on its meaning.

Irrelevant: comments, other metadata of EXIF, XMP and IPTC, thumbnails, gain maps and depth of phones.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._io.formats import FormatError
from foveasim._io.images import _limits
from foveasim._io.images._boxes import avif_colour, jp2_colour
from foveasim._io.images._colour import ADOBE_RGB_GAMMA, ADOBE_RGB_XY, LINEAR, SRGB, Colour, FilePicture
from foveasim._io.images._limits import ORIENTATION_TAG, apply_orientation, check_size, check_square_pixels
from foveasim._io.images._png import chunks_of, colour_of_chunks, colour_of_gamma

if TYPE_CHECKING:
    from PIL import Image

#: Formats that are read with Pillow; its other formats are not photographs.
PILLOW_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "PPM", "JPEG2000", "TGA")
#: Modes of Pillow that are read unchanged, and conversions of other modes.
UNCHANGED_MODES = ("L", "LA", "RGB", "RGBA", "F", "CMYK")
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
#: Signature of the JPEG 2000 codestream; end marker of JPEG and JPEG 2000.
JPEG2000_MAGIC, END_MARKER = b"\xff\x4f\xff\x51", b"\xff\xd9"
#: JPEG marker before the image data, and length of a marker.
START_OF_SCAN, MARKER_BYTES = 0xDA, 2
#: Directories of EXIF, and the index of interoperability of pictures in Adobe RGB.
EXIF_DIRECTORY, INTEROPERABILITY_DIRECTORY, INDEX, ADOBE_RGB_INDEX = 0x8769, 0xA005, 1, "R03"
#: Colour spaces of BMP of version 4 and 5: end points, sRGB (also that of Windows), embedded profile.
CALIBRATED, SRGB_SPACES, EMBEDDED = 0, (0x73524742, 0x57696E20), 0x4D424544
BMP_HEADER, V4_BYTES, V5_BYTES = 14, 108, 124
#: Application extension of GIF with an ICC profile.
GIF_PROFILE = b"\x21\xff\x0bICCRGBG1012"
#: Footer of TGA 2.0, and offsets of aspect ratio and gamma in its extension area.
TGA_FOOTER_BYTES, TGA_SIGNATURE, TGA_ASPECT, TGA_GAMMA = 26, b"TRUEVISION-XFILE", 474, 478


def read_with_pillow(path: Path, formats: tuple[str, ...] = PILLOW_FORMATS) -> FilePicture:
    """Read a picture with Pillow, upright."""
    from PIL import Image, UnidentifiedImageError

    try:
        with _pillow_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # invalid metadata
            with Image.open(path, formats=formats) as image:
                check_size(image.width, image.height)
                n_pictures = getattr(image, "n_frames", 1)
                # MPO files of phones contain previews after the photograph.
                if n_pictures > 1 and image.format != "MPO":
                    raise FormatError(f"contains {n_pictures} pictures; provide a file with one picture")
                kind = str(image.format)
                content = path.read_bytes() if kind in _OF_CONTENT else b""
                _check_complete(content, kind)
                if kind in ("JPEG", "MPO", "BMP"):
                    check_square_pixels(*_resolution(image), "resolution")
                colour = _OF_CONTENT.get(kind, _unstated)(content)
                return picture_of_image(image, colour)
    except UnidentifiedImageError:
        raise FormatError("is not a picture in a supported format") from None
    except Image.DecompressionBombError:
        raise FormatError(f"has more than {_limits.MAX_PIXELS} pixels") from None


def picture_of_image(image: Image.Image, stated: Colour = SRGB) -> FilePicture:
    """
    Convert an image of Pillow.

    ``stated``: colours that the file states, if not in the metadata of the image. Raises Exception of any type, when the file
    is corrupt or the mode cannot be converted.
    """
    image.load()  # Pillow applies the orientation of TIFF on load and removes the tag
    orientation, colour = _orientation(image), _colour(image, stated)
    converted = _convert_mode(image)
    numbers = np.asarray(converted)
    if converted.mode == "I":
        is_16_bit = numbers.min() >= 0 and numbers.max() <= np.iinfo(np.uint16).max
        numbers = numbers.astype(np.uint16 if is_16_bit else np.float32)
    pixels = apply_orientation(numbers, orientation)
    return FilePicture(pixels=pixels, colour=colour, has_inks=converted.mode == "CMYK")


def _colour(image: Image.Image, stated: Colour) -> Colour:
    """Return the colours of an image by its metadata, or those that its file states."""
    info = image.info
    # Profiles replace the codes of AVIF; the order of PNG is that of its chunks.
    has_profile = "icc_profile" in info and info["icc_profile"] != b""
    if stated is not SRGB and not (has_profile and image.format == "AVIF"):
        return stated
    if image.mode == "F":  # floating-point TIFF, PFM; a pickled image does not know its format
        return LINEAR
    if has_profile:
        profile = info["icc_profile"]
        return Colour(profile=profile) if isinstance(profile, bytes) else Colour(problem="has a broken colour profile")
    if ("gamma" in info or "chromaticity" in info) and "srgb" not in info:
        gamma = info.get("gamma")
        if gamma is not None and not gamma > 0.0:
            return Colour(problem="has a broken chunk gAMA or cHRM")
        return colour_of_gamma(gamma, info.get("chromaticity"))
    if "exif" in info and _is_adobe_rgb(image):
        return Colour(transfer=ADOBE_RGB_GAMMA, primaries=ADOBE_RGB_XY)
    return SRGB


def _is_adobe_rgb(image: Image.Image) -> bool:
    """Return whether EXIF names the colour space Adobe RGB as cameras do."""
    try:
        exif = image.getexif()
        return EXIF_DIRECTORY in exif and exif.get_ifd(INTEROPERABILITY_DIRECTORY).get(INDEX) == ADOBE_RGB_INDEX
    except Exception:  # noqa: BLE001 -- the picture may be valid although its metadata are corrupt
        return False


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


def _resolution(image: Image.Image) -> tuple[float, float]:
    """
    Return the resolution along x and y of JFIF or BMP; 0 if it is unknown.

    That of EXIF is of prints, not of pixels.
    """
    x, y = image.info.get("dpi" if image.format == "BMP" else "jfif_density", (0.0, 0.0))
    return float(x), float(y)


@contextmanager
def _pillow_limit() -> Iterator[None]:
    """Set the pixel limit of Pillow to the limit of this package, inside the block."""
    from PIL import Image

    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = _limits.MAX_PIXELS
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


# -- completeness ------------------------------------------------------------------------------------------------------


def _check_complete(content: bytes, kind: str) -> None:
    """Reject files without an end marker, which Pillow accepts."""
    if kind not in ("JPEG", "MPO", "JPEG2000"):
        return
    begin = content.find(JPEG2000_MAGIC) if kind == "JPEG2000" else _first_scan(content)
    # Compressed image data never contain the end marker.
    if content.find(END_MARKER, max(begin, 0)) < 0:
        raise FormatError("is corrupt or truncated")


def _first_scan(content: bytes) -> int:
    """Return the offset of the image data of a JPEG, after metadata, which may contain a JPEG."""
    offset = MARKER_BYTES
    while content[offset : offset + 1] == b"\xff" and content[offset + 1] != START_OF_SCAN:
        is_filler = content[offset + 1] == 0xFF
        offset += 1 if is_filler else MARKER_BYTES + int.from_bytes(content[offset + 2 : offset + 4])
    return offset


# -- colours that formats state ------------------------------------------------------------------------------------------


def _unstated(_content: bytes) -> Colour:
    return SRGB


def _png_colour(content: bytes) -> Colour:
    return colour_of_chunks(chunks_of(content))


def _bmp_colour(content: bytes) -> Colour:
    size = int.from_bytes(content[14:18], "little")
    if size < V4_BYTES or len(content) < BMP_HEADER + size:
        return SRGB
    space = int.from_bytes(content[70:74], "little")
    if space in SRGB_SPACES:
        return SRGB
    if space == EMBEDDED and size >= V5_BYTES:
        begin, n_bytes = struct.unpack("<II", content[126:134])
        profile = content[BMP_HEADER + begin : BMP_HEADER + begin + n_bytes]
        is_complete = 0 < n_bytes == len(profile)
        return Colour(profile=profile) if is_complete else Colour(problem="has a broken colour profile")
    if space != CALIBRATED:
        return Colour(problem=f"has the unsupported colour space {space:#x} of BMP")
    xyz = np.frombuffer(content, "<i4", 9, 74).reshape(3, 3) / 2.0**30
    gammas = [number / 2.0**16 for number in struct.unpack("<III", content[110:122])]
    if len(set(gammas)) > 1:
        return Colour(problem="has different gammas of red, green and blue")
    primaries: tuple[float, ...] | None = None
    if xyz.any():
        white = xyz.sum(axis=0)
        sums = np.append(xyz, [white], axis=0).sum(axis=1)
        if sums.min() <= 0.0:
            return Colour(problem="has end points that are not colours")
        primaries = tuple((np.append(xyz, [white], axis=0)[:, :2] / sums[:, np.newaxis]).ravel().tolist())
    return Colour(transfer=gammas[0] or "srgb", primaries=primaries)


def _gif_colour(content: bytes) -> Colour:
    offset = content.find(GIF_PROFILE)
    if offset < 0:
        return SRGB
    offset, parts = offset + len(GIF_PROFILE), []
    while offset < len(content) and content[offset] != 0:
        parts.append(content[offset + 1 : offset + 1 + content[offset]])
        offset += 1 + content[offset]
    return Colour(profile=b"".join(parts)) if parts else Colour(problem="has a broken colour profile")


def _tga_colour(content: bytes) -> Colour:
    footer = content[-TGA_FOOTER_BYTES:]
    offset = int.from_bytes(footer[:4], "little")
    if footer[8:24] != TGA_SIGNATURE or offset == 0 or offset + TGA_GAMMA + 4 > len(content):
        return SRGB
    width, height, gamma, unit = struct.unpack_from("<4H", content, offset + TGA_ASPECT)
    check_square_pixels(width, height, "aspect ratio")
    return Colour(problem=f"has the gamma {gamma / unit:g}, on which programs disagree") if unit and gamma else SRGB


#: Functions from the content of a file to the colours that its format states outside the metadata of images of Pillow.
_OF_CONTENT: dict[str, Callable[[bytes], Colour]] = {
    "PNG": _png_colour,
    "BMP": _bmp_colour,
    "GIF": _gif_colour,
    "TGA": _tga_colour,
    "JPEG2000": jp2_colour,
    "AVIF": avif_colour,
    "JPEG": _unstated,
    "MPO": _unstated,
}


def encode_with_pillow(picture: Any, path: Path, **options: Any) -> bytes:
    """Return the bytes of a file in the format of an extension."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, Image.registered_extensions()[path.suffix.lower()], **options)
    return encoded.getvalue()
