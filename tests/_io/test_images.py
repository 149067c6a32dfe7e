"""Picture files: lossless and upright reading, writing, and errors for invalid files."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from waiting import DEADLINE_S

from foveasim._io.images import _limits, _reading, read_picture, write_picture
from foveasim.errors import FileError

#: A letter without symmetry, top row first, as in files.
F = np.array(
    [
        [0, 0, 0, 0, 0],
        [0, 1, 1, 1, 0],
        [0, 1, 0, 0, 0],
        [0, 1, 1, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, 0, 0, 0],
    ],
    np.uint8,
)
GREY8 = F * np.uint8(200) + np.uint8(7)
GREY16 = F * np.uint16(40_001) + np.uint16(258)
COLOUR8 = np.stack([F * 201, F * 102 + 3, 250 - F * 50], axis=-1).astype(np.uint8)
COLOUR16 = np.stack([F * np.uint16(50_001), F * np.uint16(301) + 5, 65_000 - F * np.uint16(999)], axis=-1).astype(
    np.uint16
)
ALPHA8 = np.arange(F.size, dtype=np.uint8).reshape(F.shape) + np.uint8(220)
ALPHA16 = np.arange(F.size, dtype=np.uint16).reshape(F.shape) + np.uint16(65_500)
#: Values that float32 represents exactly, one above 1.
RADIANCE = (F * np.float32(1.75) + np.float32(0.125)).astype(np.float32)
#: The letter with 16 x 16 pixels per element, and incompressible noise.
LARGE_F = np.kron(F, np.ones((16, 16), np.uint8)) * np.uint8(255)
NOISE = np.random.default_rng(5).integers(0, 256, (40, 30, 3), dtype=np.uint8)


def encoded(array, picture_format, **options):
    """Return the bytes of a file that Pillow writes."""
    image = array if isinstance(array, Image.Image) else Image.fromarray(array)
    file = io.BytesIO()
    image.save(file, format=picture_format, **options)
    return file.getvalue()


def tiff(array, **options):
    """Return the bytes of a file that tifffile writes."""
    file = io.BytesIO()
    tifffile.imwrite(file, array, **options)
    return file.getvalue()


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(*, width, height, depth, colour_type, rows):
    """Return a PNG with an arbitrary header."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks)


def palette_image(*, values=F, **info):
    image = Image.frombytes("P", values.shape[::-1], values.tobytes())
    image.putpalette([10, 20, 30, 200, 100, 50])
    image.info.update(info)
    return image


def is_letter(grey):
    """Return whether a picture with lossy compression shows the upright letter."""
    cells = grey.astype(float).reshape(7, 16, 5, 16).mean(axis=(1, 3))
    return np.array_equal(cells > 127.5, F == 1)


def read_bytes(tmp_path, content, name="picture.bin"):
    path = tmp_path / name
    path.write_bytes(content)
    return read_picture(path)


def assert_is_rejected(tmp_path, content, match, name="picture.bin"):
    """Check that reading raises a one-line FileError that begins with the path."""
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileError, match=match) as caught:
        read_picture(path)
    assert caught.value.path == path
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


# -- valid files ---------------------------------------------------------------------------------------------------

LOSSLESS = {
    "grey png": (encoded(GREY8, "PNG"), GREY8),
    "16-bit grey png": (encoded(GREY16, "PNG"), GREY16),
    "colour png": (encoded(COLOUR8, "PNG"), COLOUR8),
    "grey and alpha png": (encoded(np.dstack([GREY8, ALPHA8]), "PNG"), np.dstack([GREY8, ALPHA8])),
    "colour and alpha png": (encoded(np.dstack([COLOUR8, ALPHA8]), "PNG"), np.dstack([COLOUR8, ALPHA8])),
    "1-bit png": (encoded(Image.fromarray(F * np.uint8(255)).convert("1"), "PNG"), F * np.uint8(255)),
    "palette png": (encoded(palette_image(), "PNG"), np.array([[10, 20, 30], [200, 100, 50]], np.uint8)[F]),
    "palette png with transparency": (
        encoded(palette_image(), "PNG", transparency=b"\x40\xff"),
        np.array([[10, 20, 30, 64], [200, 100, 50, 255]], np.uint8)[F],
    ),
    "gif": (encoded(palette_image(), "GIF"), np.array([[10, 20, 30], [200, 100, 50]], np.uint8)[F]),
    "bmp": (encoded(COLOUR8, "BMP"), COLOUR8),
    "lossless webp": (encoded(COLOUR8, "WEBP", lossless=True), COLOUR8),
    "lossless jpeg 2000": (encoded(COLOUR8, "JPEG2000"), COLOUR8),
    "16-bit jpeg 2000": (encoded(GREY16, "JPEG2000"), GREY16),
    "tga": (encoded(COLOUR8, "TGA"), COLOUR8),
    "colour ppm": (encoded(COLOUR8, "PPM"), COLOUR8),
    "8-bit pgm": (b"P5 5 7 255\n" + GREY8.tobytes(), GREY8),
    "16-bit pgm": (b"P5 5 7 65535\n" + GREY16.astype(">u2").tobytes(), GREY16),
    "float pfm": (encoded(RADIANCE, "PPM"), RADIANCE),
    "grey tiff": (tiff(GREY8), GREY8),
    "16-bit grey tiff": (tiff(GREY16), GREY16),
    "16-bit big-endian tiff": (tiff(GREY16, byteorder=">"), GREY16),
    "BigTIFF": (tiff(GREY16, bigtiff=True), GREY16),
    "float tiff": (tiff(RADIANCE), RADIANCE),
    "half float tiff": (tiff(RADIANCE.astype(np.float16)), RADIANCE),
    "double tiff": (tiff(RADIANCE.astype(np.float64)), RADIANCE),
    "colour tiff": (tiff(COLOUR8, photometric="rgb"), COLOUR8),
    "16-bit colour tiff": (tiff(COLOUR16, photometric="rgb"), COLOUR16),
    "planar colour tiff": (
        tiff(np.moveaxis(COLOUR16, -1, 0), photometric="rgb", planarconfig="separate"),
        COLOUR16,
    ),
    "colour and alpha tiff": (
        tiff(np.dstack([COLOUR8, ALPHA8]), photometric="rgb", extrasamples=["unassalpha"]),
        np.dstack([COLOUR8, ALPHA8]),
    ),
    "1-bit tiff": (encoded(Image.fromarray(F * np.uint8(255)).convert("1"), "TIFF"), F * np.uint8(255)),
    "palette tiff": (
        tiff(F, photometric="palette", colormap=np.tile(np.array([257, 51_400], np.uint16), (3, 128))),
        np.tile(np.array([257, 51_400], np.uint16)[F][..., np.newaxis], 3),
    ),
    "miniswhite tiff": (tiff(255 - GREY8, photometric="miniswhite"), GREY8),
    "deflated tiff": (encoded(COLOUR8, "TIFF", compression="tiff_deflate"), COLOUR8),
    "packbits tiff": (encoded(COLOUR8, "TIFF", compression="packbits"), COLOUR8),
    "lzw tiff": (encoded(COLOUR8, "TIFF", compression="tiff_lzw"), COLOUR8),
}


@pytest.mark.parametrize(("content", "picture"), LOSSLESS.values(), ids=LOSSLESS)
def test_lossless_formats_are_read_exactly(tmp_path, content, picture):
    read = read_bytes(tmp_path, content)
    np.testing.assert_array_equal(read, picture, strict=True)


@pytest.mark.parametrize(
    "picture",
    [COLOUR16, np.dstack([COLOUR16, ALPHA16])],
    ids=["colour", "colour and alpha"],
)
def test_16_bit_colour_png_is_exact(tmp_path, picture):
    rows = b"".join(b"\0" + row.tobytes() for row in picture.astype(">u2"))
    colour_type = {3: 2, 4: 6}[picture.shape[2]]
    content = png(width=5, height=7, depth=16, colour_type=colour_type, rows=rows)
    np.testing.assert_array_equal(read_bytes(tmp_path, content), picture, strict=True)


def test_16_bit_grey_alpha_png_is_exact(tmp_path):
    samples = np.dstack([GREY16, ALPHA16]).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in samples)
    read = read_bytes(tmp_path, png(width=5, height=7, depth=16, colour_type=4, rows=rows))
    for channel in np.moveaxis(read[..., :-1], -1, 0):
        np.testing.assert_array_equal(channel, GREY16)
    np.testing.assert_array_equal(read[..., -1], ALPHA16)


def test_radiance_hdr_is_exact_to_mantissa_bits(tmp_path):
    colour = np.stack([F * 3.0 + 0.1, F * 0.5 + 0.2, F * 1.0 + 0.3], axis=-1).astype(np.float32)
    # Four bytes per pixel: three mantissas and a common exponent (Ward, Real Pixels, 1991).
    _, exponent = np.frexp(colour.max(axis=-1))
    mantissas = colour / np.ldexp(1.0, exponent - 8)[..., np.newaxis]
    pixels = np.dstack([mantissas, exponent + 128]).astype(np.uint8)
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {F.shape[0]} +X {F.shape[1]}\n".encode()
    # The brightest channel has a mantissa between 128 and 256; one step of it is the quantisation error.
    step = colour.max(axis=-1, keepdims=True) / 128.0
    assert np.all(np.abs(read_bytes(tmp_path, header + pixels.tobytes()) - colour) <= step)


def exr():
    """Return an uncompressed EXR: magic number, header attributes, line offsets, lines of B, G, R."""
    colour = np.stack([RADIANCE, RADIANCE * 2, RADIANCE * 3], axis=-1)
    height, width = F.shape

    def attribute(name, kind, value):
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(name + b"\0" + struct.pack("<iBxxxii", 2, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = (
        struct.pack("<II", 20000630, 2)
        + attribute(b"channels", b"chlist", channels)
        + attribute(b"compression", b"compression", b"\0")
        + attribute(b"dataWindow", b"box2i", window)
        + attribute(b"displayWindow", b"box2i", window)
        + attribute(b"lineOrder", b"lineOrder", b"\0")
        + attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1.0))
        + attribute(b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0))
        + attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1.0))
        + b"\0"
    )
    lines = [
        struct.pack("<ii", y, 12 * width) + np.moveaxis(colour[y, :, ::-1], -1, 0).astype("<f4").tobytes()
        for y in range(height)
    ]
    first = len(header) + 8 * height
    offsets = struct.pack(f"<{height}Q", *(first + len(lines[0]) * y for y in range(height)))
    return header + offsets + b"".join(lines), colour


def test_uncompressed_exr_is_read_exactly(tmp_path):
    content, colour = exr()
    np.testing.assert_array_equal(read_bytes(tmp_path, content), colour, strict=True)


@pytest.fixture
def no_sandbox(monkeypatch):
    """Read EXR in this process, because starting a sandbox process takes about a second per file."""
    monkeypatch.setattr(_reading, "read_in_sandbox", lambda reader, path, **_: reader(str(path)))


def saved_exr(path, picture, compression, *, is_tiled=False):
    kind = OpenEXR.tiledimage if is_tiled else OpenEXR.scanlineimage
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": kind}
    if is_tiled:
        header["tiles"] = OpenEXR.TileDescription()
    with OpenEXR.File(header, {"RGB": picture}) as file:
        file.write(str(path))
    return path.read_bytes()


@pytest.mark.usefixtures("no_sandbox")
@pytest.mark.parametrize("is_tiled", [False, True], ids=["lines", "tiles"])
@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ"])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_compressed_exr_is_read_exactly(tmp_path, compression, is_tiled, dtype):
    picture = np.random.default_rng(3).random((90, 70, 3)).astype(dtype)
    content = saved_exr(tmp_path / "complete.exr", picture, compression, is_tiled=is_tiled)
    np.testing.assert_array_equal(read_bytes(tmp_path, content), picture.astype(np.float32), strict=True)


@pytest.mark.usefixtures("no_sandbox")
def test_missing_library_gives_install_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    assert_is_rejected(tmp_path, exr()[0], r"needs OpenEXR; install it with: pip install 'foveasim\[pictures\]'")


@pytest.mark.parametrize(
    ("picture_format", "options"),
    [("JPEG", {}), ("JPEG", {"progressive": True}), ("WEBP", {})],
    ids=["jpeg", "progressive jpeg", "webp"],
)
def test_lossy_picture_is_upright(tmp_path, picture_format, options):
    colour = np.repeat(LARGE_F[..., np.newaxis], 3, axis=-1)
    assert is_letter(read_bytes(tmp_path, encoded(colour, picture_format, **options))[..., 1])


def test_cmyk_jpeg_is_converted_to_rgb(tmp_path):
    red = np.stack([LARGE_F, LARGE_F * 0, LARGE_F * 0], axis=-1)
    read = read_bytes(tmp_path, encoded(Image.fromarray(red).convert("CMYK"), "JPEG", quality=95))
    assert is_letter(read[..., 0])
    # Quantisation at quality 95 changes means by a few codes at most.
    assert read[..., 1:].mean() < 10.0


@pytest.mark.parametrize("mode", ["CMYK", "YCbCr", "LAB"])
def test_non_rgb_tiff_is_converted_or_rejected(tmp_path, mode):
    red = np.zeros((7, 5, 3), np.uint8)
    red[..., 0] = 255
    try:
        read = read_bytes(tmp_path, encoded(Image.fromarray(red).convert(mode), "TIFF"))
    except FileError:
        return  # rejection is also correct
    assert read.shape == red.shape
    assert np.abs(read.astype(int) - red).max() <= 2


# Exif 2.32, tag 274: sides of the picture that the first row and the first column of the file represent.
STORED = {
    1: F,
    2: F[:, ::-1],  # top, right
    3: F[::-1, ::-1],  # bottom, right
    4: F[::-1],  # bottom, left
    5: F.T,  # left, top
    6: F[:, ::-1].T,  # right, top
    7: F[::-1, ::-1].T,  # right, bottom
    8: F[::-1].T,  # left, bottom
}


@pytest.mark.parametrize(("orientation", "stored"), STORED.items())
@pytest.mark.parametrize("picture_format", ["JPEG", "PNG", "TIFF"])
def test_orientation_tag_is_applied(tmp_path, orientation, stored, picture_format):
    large = np.ascontiguousarray(np.kron(stored, np.ones((16, 16), np.uint8)) * np.uint8(255))
    exif = Image.Exif()
    exif[274] = orientation
    assert is_letter(read_bytes(tmp_path, encoded(large, picture_format, exif=exif)))


@pytest.mark.parametrize(
    "exif",
    [
        b"Exif\0\0II*\0\x08\0\0\0\x05\0",  # five entries announced, none present
        b"Exif\0\0II*\0\xff\xff\0\0",  # offset beyond the end
        b"Exif\0\0nonsense",
        # orientation 6, and a width of type ASCII
        bytes.fromhex(
            "4578696600004d4d002a000000080002010000020000000600000026011200030000000100060000000000006d616b657200"
        ),
    ],
    ids=["truncated", "beyond the end", "nonsense", "text as number"],
)
@pytest.mark.parametrize("picture_format", ["JPEG", "PNG", "WEBP"])
def test_corrupt_exif_does_not_prevent_reading(tmp_path, exif, picture_format):
    read = read_bytes(tmp_path, encoded(np.full((16, 16, 3), 200, np.uint8), picture_format, exif=exif))
    assert np.abs(read.astype(int) - 200).max() <= 2


@pytest.mark.parametrize(
    ("picture", "key", "clear"),
    [
        (GREY8, 7, F == 0),
        (GREY16, 258, F == 0),
        (COLOUR8, (0, 3, 250), F == 0),
    ],
    ids=["grey", "16-bit grey", "colour"],
)
def test_transparent_png_colour_has_zero_alpha(tmp_path, picture, key, clear):
    read = read_bytes(tmp_path, encoded(picture, "PNG", transparency=key))
    assert read.ndim == 3
    assert read.shape[2] in (2, 4)
    np.testing.assert_array_equal(read[..., -1] == 0, clear)


@pytest.mark.parametrize(
    "content",
    [
        encoded(GREY8[1:2, 1:2], "PNG"),
        encoded(np.full((1, 1), 207, np.uint8), "JPEG", quality=100),
        tiff(GREY8[1:2, 1:2]),
        encoded(GREY8[1:2, 1:2], "BMP"),
    ],
    ids=["png", "jpeg", "tiff", "bmp"],
)
def test_single_pixel_picture_is_read(tmp_path, content):
    assert read_bytes(tmp_path, content).tolist() == [[207]]


@pytest.mark.parametrize("picture", [GREY8[1:2], GREY8[:, 1:2], GREY8[:, :4], GREY8[:3]], ids=lambda p: str(p.shape))
def test_short_axis_is_not_channel_axis(tmp_path, picture):
    np.testing.assert_array_equal(read_bytes(tmp_path, tiff(picture)), picture, strict=True)


def test_format_is_detected_by_content(tmp_path):
    np.testing.assert_array_equal(read_bytes(tmp_path, tiff(GREY16), name="picture.png"), GREY16, strict=True)


# -- rejected files -------------------------------------------------------------------------------------------------


def test_missing_file_is_rejected(tmp_path):
    with pytest.raises(FileError, match=r"nowhere\.png: no such file$"):
        read_picture(tmp_path / "nowhere.png")


def test_directory_is_rejected_as_file(tmp_path):
    directory = tmp_path / "directory.png"
    directory.mkdir()
    with pytest.raises(FileError, match=r"directory\.png: is not a file$"):
        read_picture(directory)


def test_file_without_permission_is_rejected(tmp_path, monkeypatch):
    path = tmp_path / "secret.png"
    path.write_bytes(encoded(GREY8, "PNG"))

    def reject(*_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("pathlib.Path.open", reject)
    monkeypatch.setattr("builtins.open", reject)
    with pytest.raises(FileError, match=r"(?i)secret\.png: .*permission"):
        read_picture(path)


def test_reading_too_long_name_is_rejected(tmp_path):
    with pytest.raises(FileError, match=r"\.png: "):
        read_picture(tmp_path / ("x" * 300 + ".png"))


INT_TIFFS = {
    str(dtype): (tiff(F.astype(dtype)), f"must contain 8-bit, 16-bit or floating-point numbers, got {dtype}$")
    for dtype in ("int8", "int16", "int32", "uint32", "int64")
}
BAD = {
    "empty file": (b"", "is not a picture in a supported format$"),
    "text": (b"This is text, not a picture.\n" * 9, "is not a picture in a supported format$"),
    "animated gif": (
        encoded(GREY8, "GIF", save_all=True, append_images=[Image.fromarray(255 - GREY8)]),
        "contains 2 pictures; provide a file with one picture$",
    ),
    "animated png": (
        encoded(GREY8, "PNG", save_all=True, append_images=[Image.fromarray(255 - GREY8)]),
        "contains 2 pictures; provide a file with one picture$",
    ),
    "animated webp": (
        encoded(COLOUR8, "WEBP", save_all=True, append_images=[Image.fromarray(255 - COLOUR8)]),
        "contains 2 pictures; provide a file with one picture$",
    ),
    "tiff of 3 pages": (
        tiff(np.stack([GREY8] * 3), photometric="minisblack"),
        "contains 3 (pages|pictures); provide a file with one picture$",
    ),
    "png without columns": (png(width=0, height=5, depth=8, colour_type=0, rows=b""), "is not a picture|is corrupt"),
    **{f"{dtype} tiff": case for dtype, case in INT_TIFFS.items()},
}


@pytest.mark.parametrize(("content", "message"), BAD.values(), ids=BAD)
def test_invalid_picture_is_rejected(tmp_path, content, message):
    assert_is_rejected(tmp_path, content, message, name="picture.png")


COMPLETE = {
    "png": encoded(NOISE, "PNG"),
    "jpeg": encoded(NOISE, "JPEG"),
    "progressive jpeg": encoded(NOISE, "JPEG", progressive=True),
    "tiff": tiff(NOISE, photometric="rgb"),
    "tiff in strips": tiff(NOISE, photometric="rgb", rowsperstrip=5),
    "deflated tiff": tiff(NOISE, photometric="rgb", compression="zlib", rowsperstrip=5),
    "webp": encoded(NOISE, "WEBP"),
    "bmp": encoded(NOISE, "BMP"),
    "gif": encoded(NOISE, "GIF"),
    "ppm": encoded(NOISE, "PPM"),
    "jpeg xr tiff": tiff(NOISE, photometric="rgb", compression="jpegxr", rowsperstrip=8),
    "jpeg 2000": encoded(NOISE, "JPEG2000"),
    "radiance hdr": imagecodecs.rgbe_encode(NOISE.astype(np.float32)),
    "exr": exr()[0],
    "16-bit colour png": png(
        width=5, height=40, depth=16, colour_type=2, rows=b"".join(b"\0" + row[:10].tobytes() for row in NOISE)
    ),
}


@pytest.mark.parametrize("fraction", [0.001, 0.02, 0.1, 0.25, 0.5, 0.75, 0.95])
@pytest.mark.parametrize("content", COMPLETE.values(), ids=COMPLETE)
def test_truncated_picture_is_rejected(tmp_path, content, fraction):
    truncated = content[: 1 + int(fraction * (len(content) - 1))]
    assert_is_rejected(tmp_path, truncated, "is corrupt or truncated|is not a picture in a supported format")


@pytest.mark.usefixtures("no_sandbox")
@pytest.mark.parametrize("is_tiled", [False, True], ids=["lines", "tiles"])
@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA"])
def test_truncated_exr_is_rejected_or_printed(tmp_path, capfd, compression, is_tiled):
    picture = np.random.default_rng(3).random((90, 70, 3)).astype(np.float16)
    path = tmp_path / "truncated.exr"
    content = saved_exr(path, picture, compression, is_tiled=is_tiled)
    for size in {*range(1, len(content), len(content) // 50), *range(len(content) - 9, len(content))}:
        path.write_bytes(content[:size])
        try:
            read_picture(path)
        except FileError:
            continue
        assert capfd.readouterr().out, size


def test_corrupt_exr_prints_nothing(tmp_path, capfd):
    assert_is_rejected(tmp_path, exr()[0][:-1], r"is corrupt or truncated$")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("side", [2**15, 2**31 - 1])
def test_exr_with_huge_tiles_is_rejected(tmp_path, side):
    content = saved_exr(tmp_path / "tiles.exr", NOISE.astype(np.float32), "ZIP", is_tiled=True)
    offset = content.index(b"tiledesc\0") + 13
    content = content[:offset] + struct.pack("<II", side, side) + content[offset + 8 :]
    assert_is_rejected(tmp_path, content, "is corrupt|is malformed")


def test_flipped_bit_in_png_data_is_detected(tmp_path):
    content = encoded(NOISE, "PNG")
    begin = content.index(b"IDAT")
    for offset in range(begin + 4, len(content) - 16, 97):
        flipped = bytearray(content)
        flipped[offset] ^= 8
        assert_is_rejected(tmp_path, flipped, "is corrupt or truncated")


@pytest.mark.parametrize("kind", ["png", "jpeg", "progressive jpeg", "jpeg 2000", "radiance hdr"])
def test_picture_with_zeroed_end_is_rejected(tmp_path, kind):
    content = COMPLETE[kind]
    for fraction in (0.3, 0.6, 0.9):
        n = int(fraction * len(content))
        # Pillow before 13 does not recognise a JPEG without tables.
        messages = "is corrupt or truncated|is not a picture in a supported format"
        assert_is_rejected(tmp_path, content[:n] + bytes(len(content) - n), messages)


def test_jpeg_2000_without_data_is_rejected(tmp_path):
    content = COMPLETE["jpeg 2000"]
    assert_is_rejected(tmp_path, content[: content.index(b"\xff\x90")], "is corrupt or truncated")


def test_end_marker_in_jpeg_metadata_is_ignored(tmp_path):
    metadata = b"Exif\0\0" + encoded(GREY8, "JPEG")
    content = encoded(NOISE, "JPEG", exif=metadata)
    assert read_bytes(tmp_path, content + b"after the end").shape == NOISE.shape
    assert_is_rejected(tmp_path, content[:-400] + bytes(400), "is corrupt or truncated")


def without_strips(content, name):
    """Remove the offsets or the lengths of the strips from a TIFF."""
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        offset = file.pages[0].tags[name].offset
    return content[:offset] + struct.pack("<H", 60_000) + content[offset + 2 :]


@pytest.mark.parametrize("name", ["StripOffsets", "StripByteCounts"])
@pytest.mark.parametrize("kind", ["tiff in strips", "deflated tiff"])
def test_tiff_without_strip_tags_is_rejected(tmp_path, kind, name):
    assert_is_rejected(tmp_path, without_strips(COMPLETE[kind], name), "is corrupt or truncated")


def huge_tiff():
    """Return a TIFF with 60000 x 60000 pixels in the header."""
    content = bytearray(tiff(GREY8))
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        offsets = [file.pages[0].tags[tag].offset for tag in (256, 257)]
    for offset in offsets:
        content[offset + 2 : offset + 12] = struct.pack("<HII", 4, 1, 60_000)
    return bytes(content)


def huge_jpeg():
    """Return a JPEG with 60000 x 60000 pixels in the header."""
    content = bytearray(encoded(NOISE, "JPEG"))
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = struct.pack(">HH", 60_000, 60_000)
    return bytes(content)


BOMBS = {
    "png": png(width=60_000, height=60_000, depth=8, colour_type=0, rows=b"\0" * 99),
    "largest png": png(width=2**31 - 1, height=2**31 - 1, depth=8, colour_type=0, rows=b"\0" * 99),
    "16-bit colour png": png(width=60_000, height=60_000, depth=16, colour_type=2, rows=b"\0" * 99),
    "jpeg": huge_jpeg(),
    "tiff": huge_tiff(),
}


@pytest.mark.parametrize("content", BOMBS.values(), ids=BOMBS)
def test_header_with_too_many_pixels_is_rejected(tmp_path, content):
    assert_is_rejected(tmp_path, content, r": has .*more than .*268435456")


def test_truncated_picture_below_limit_is_corrupt(tmp_path):
    # 144 million pixels, below the limit of 268 million; most of the data are missing.
    content = png(width=12_000, height=12_000, depth=8, colour_type=0, rows=b"\0" * 99)
    assert_is_rejected(tmp_path, content, r": is corrupt or truncated")


@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_pixel_limit_applies_to_planar_tiff(tmp_path, monkeypatch, planes):
    monkeypatch.setattr(_limits, "MAX_PIXELS", 1000)
    picture = NOISE if planes == "contig" else np.moveaxis(NOISE, -1, 0)
    assert_is_rejected(tmp_path, tiff(picture, photometric="rgb", planarconfig=planes), "more than the limit of 1000$")


# -- random corruption ----------------------------------------------------------------------------------------------


def test_tiff_with_cyclic_pages_terminates(tmp_path):
    content = bytearray(encoded(GREY8, "TIFF"))
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        next_page = file.pages[0].offset + 2 + 12 * len(file.pages[0].tags)
    content[next_page : next_page + 4] = struct.pack("<I", len(content))
    content += b"\0\0" + struct.pack("<I", len(content))  # a page without tags that links to itself
    path = tmp_path / "cycle.tif"
    path.write_bytes(content)
    program = (
        "import sys; from foveasim.errors import FileError; from foveasim._io.images import read_picture\n"
        "try: read_picture(sys.argv[1])\n"
        "except FileError: pass\n"
    )
    # In a separate process, with a timeout for an infinite loop.
    subprocess.run([sys.executable, "-c", program, str(path)], check=True, timeout=DEADLINE_S)


METADATA = PngInfo()
METADATA.add_text("Title", "F" * 99, zip=True)
METADATA.add_itxt("Author", "unknown", zip=True)
ORIENTATION = Image.Exif()
ORIENTATION[274] = 6
ORIENTATION[271] = "maker"
SEEDS = {
    "png": encoded(COLOUR8, "PNG"),
    "png with metadata": encoded(COLOUR8, "PNG", pnginfo=METADATA, exif=ORIENTATION),
    "palette png": encoded(palette_image(), "PNG", transparency=b"\x40\xff"),
    "jpeg": encoded(COLOUR8, "JPEG"),
    "progressive jpeg": encoded(COLOUR8, "JPEG", progressive=True),
    "jpeg with metadata": encoded(COLOUR8, "JPEG", exif=ORIENTATION),
    "tiff": tiff(COLOUR8, photometric="rgb"),
    "deflated tiff": tiff(GREY16, compression="zlib", predictor=True),
    "palette tiff": encoded(palette_image(), "TIFF"),
    "float tiff": tiff(RADIANCE, bigtiff=True),
}


def with_correct_checksums(content):
    """Correct the checksums of a PNG, so that readers accept its chunks."""
    fixed, offset = bytearray(content), 8
    while offset + 12 <= len(fixed):
        end = offset + 8 + int.from_bytes(fixed[offset : offset + 4])
        if end + 4 > len(fixed):
            break
        fixed[end : end + 4] = struct.pack(">I", zlib.crc32(fixed[offset + 4 : end]))
        offset = end + 4
    return bytes(fixed)


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", SEEDS)
def test_flipped_bits_give_picture_or_file_error(tmp_path, name):
    rng = np.random.default_rng([12, *name.encode()])
    path = tmp_path / "picture.bin"
    for case in range(120):
        content = bytearray(SEEDS[name])
        for offset in rng.integers(len(content), size=rng.integers(1, 4)):
            content[offset] ^= 1 << rng.integers(8)
        path.write_bytes(with_correct_checksums(content) if "png" in name and case % 2 else content)
        try:
            picture = read_picture(path)
        except FileError as error:
            is_correct = "\n" not in str(error)
        except Exception as error:
            raise AssertionError(f"case {case}: {error!r}") from error
        else:
            is_correct = picture.dtype in (np.uint8, np.uint16, np.float32) and 0 not in picture.shape
        assert is_correct, f"case {case}"


# -- writing --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "picture",
    [GREY8, np.dstack([GREY8, ALPHA8]), COLOUR8, np.dstack([COLOUR8, ALPHA8]), GREY8[1:2, 1:2]],
    ids=["grey", "grey and alpha", "colour", "colour and alpha", "one pixel"],
)
def test_png_is_lossless(tmp_path, picture):
    write_picture(tmp_path / "f.png", picture)
    np.testing.assert_array_equal(read_picture(tmp_path / "f.png"), picture, strict=True)


def test_one_channel_picture_is_grey(tmp_path):
    write_picture(tmp_path / "f.png", GREY8[..., np.newaxis])
    np.testing.assert_array_equal(read_picture(tmp_path / "f.png"), GREY8, strict=True)


@pytest.mark.parametrize("name", ["f.png", "f.PNG", "f.bmp", "f.ppm", "f.tga", "f.jp2"])
def test_flipped_view_is_written_correctly(tmp_path, name):
    write_picture(tmp_path / name, COLOUR8[::-1, ::-1])
    np.testing.assert_array_equal(read_picture(tmp_path / name), COLOUR8[::-1, ::-1])


def test_jpeg_is_written_upright(tmp_path):
    write_picture(tmp_path / "f.jpg", LARGE_F)
    assert is_letter(read_picture(tmp_path / "f.jpg"))


def test_written_picture_has_default_permissions(tmp_path):
    write_picture(tmp_path / "f.png", GREY8)
    (tmp_path / "other").touch()
    assert (tmp_path / "f.png").stat().st_mode == (tmp_path / "other").stat().st_mode


@pytest.mark.parametrize("name", ["f.xyz", "f", "f.txt", ".png"])
def test_unknown_extension_is_rejected(tmp_path, name):
    with pytest.raises(FileError, match=r"must end in one of \.bmp, \.exr, .*, \.webp"):
        write_picture(tmp_path / name, GREY8)
    assert list(tmp_path.iterdir()) == []


UNWRITABLE = {
    "alpha in a jpeg": ("f.jpg", np.dstack([COLOUR8, ALPHA8])),
    "float": ("f.png", RADIANCE),
    "64-bit numbers": ("f.png", GREY8.astype(np.int64)),
    "five channels": ("f.png", np.zeros((7, 5, 5), np.uint8)),
    "no rows": ("f.png", np.zeros((0, 5), np.uint8)),
    "too wide for webp": ("f.webp", np.zeros((1, 20_000), np.uint8)),
    "too wide for jpeg": ("f.jpg", np.zeros((1, 70_000), np.uint8)),
}


@pytest.mark.parametrize(("name", "picture"), UNWRITABLE.values(), ids=UNWRITABLE)
def test_unwritable_picture_is_rejected(tmp_path, name, picture):
    with pytest.raises(FileError, match=rf"{name}: [^\n]*$"):
        write_picture(tmp_path / name, picture)


@pytest.mark.parametrize(("name", "picture"), UNWRITABLE.values(), ids=UNWRITABLE)
def test_rejected_write_leaves_directory_unchanged(tmp_path, name, picture):
    (tmp_path / name).write_bytes(b"older")
    with pytest.raises(Exception, match=r"."):  # the test above checks the exception
        write_picture(tmp_path / name, picture)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {name: b"older"}


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize("exists", [False, True], ids=["new file", "existing file"])
def test_interrupted_write_leaves_directory_unchanged(tmp_path, monkeypatch, failure, exists):
    target = tmp_path / "f.png"
    if exists:
        target.write_bytes(b"older")

    def interrupted_write(path, _):
        with path.open("wb") as file:
            file.write(b"half a pic")
        raise failure

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", interrupted_write)
        with pytest.raises(FileError if isinstance(failure, OSError) else type(failure), match=r"No space left|^$"):
            write_picture(target, GREY8)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == ({"f.png": b"older"} if exists else {})


def test_existing_picture_is_replaced(tmp_path):
    write_picture(tmp_path / "f.png", GREY8)
    write_picture(tmp_path / "f.png", COLOUR8)
    np.testing.assert_array_equal(read_picture(tmp_path / "f.png"), COLOUR8)
    assert [path.name for path in tmp_path.iterdir()] == ["f.png"]


def test_missing_directory_is_reported(tmp_path):
    with pytest.raises(FileError, match=r"cannot be written: the directory .*nowhere does not exist$"):
        write_picture(tmp_path / "nowhere" / "f.png", GREY8)


def test_directory_is_not_overwritten(tmp_path):
    (tmp_path / "f.png").mkdir()
    with pytest.raises(FileError, match=r"cannot be written: it is a directory$"):
        write_picture(tmp_path / "f.png", GREY8)


def test_writing_too_long_name_is_rejected(tmp_path):
    with pytest.raises(FileError, match=r"\.png: cannot be written"):
        write_picture(tmp_path / ("x" * 300 + ".png"), GREY8)
