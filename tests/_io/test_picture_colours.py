"""Colours of picture files: what files state, what their formats define, and what a caller orders."""

from __future__ import annotations

import contextlib
import io
import itertools
import struct
import sys
import zlib

import icc_profiles as icc
import imagecodecs
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image, ImageCms

import foveasim as fs
from foveasim._io import primaries
from foveasim._io.formats import FormatError
from foveasim._io.images import (
    EncodedPicture,
    _exr,
    _pillow,
    _png,
    _profiles,
    _reading,
    _tiff,
    as_encoded,
    write_picture,
)
from foveasim._io.images._colour import FilePicture, encoded_picture, h273_colour
from foveasim._io.images._profiles import profile_to_srgb
from foveasim.errors import FileError, FoveasimError, ParameterError
from foveasim.units import decode_srgb, encode_srgb

D65 = (0.3127, 0.3290)
P3_XY = np.array([[0.68, 0.32], [0.265, 0.69], [0.15, 0.06], D65])
ADOBE_XY = np.array([[0.64, 0.33], [0.21, 0.71], [0.15, 0.06], D65])
#: A patch of 8 and 16 bits.
PATCH8 = np.tile(np.array([200, 59, 39], np.uint8), (4, 6, 1))
PATCH16 = np.tile(np.array([51_401, 15_163, 10_023], np.uint16), (4, 6, 1))
D50_XYZ = np.array(icc.D50)


def srgb_of(linear, xy):
    """Return linear sRGB of linear colours in other primaries; the white becomes white."""
    white = primaries.xyz_of_xy(np.asarray(xy)[3:])[0]
    xyz = np.reshape(linear, (-1, 3)) @ primaries.xyz_of_primaries(np.asarray(xy))
    return primaries.srgb_of_xyz(xyz, white).reshape(np.shape(linear))


def profile_of(xy, gamma):
    """Return a profile of primaries and a gamma, adapted to D50 by Bradford."""
    xyz = primaries.xyz_of_primaries(xy)
    cones = xyz @ primaries.BRADFORD.T / (primaries.BRADFORD @ xyz.sum(axis=0)) * (primaries.BRADFORD @ D50_XYZ)
    return icc.rgb_profile(np.linalg.solve(primaries.BRADFORD, cones.T).T, gamma)


P3_PROFILE = profile_of(P3_XY, 2.2)
SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


@pytest.fixture
def no_sandbox(monkeypatch):
    monkeypatch.setattr(_reading, "read_in_sandbox", lambda reader, path, **_: reader(str(path)))


def light_of(picture, encoding="auto"):
    """Return linear values of a picture."""
    found = as_encoded(picture, encoding)
    pixels = found.pixels
    relative = pixels / np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else pixels
    return decode_srgb(relative) if found.encoding == "srgb" else np.asarray(relative, float)


def encoded(array, picture_format, **options):
    file = io.BytesIO()
    Image.fromarray(array).save(file, picture_format, **options)
    return file.getvalue()


def written(tmp_path, content, name="picture.bin"):
    path = tmp_path / name
    path.write_bytes(content)
    return path


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_with(*chunks, picture=PATCH8):
    content = encoded(picture, "PNG") if picture.dtype == np.uint8 else bytes(imagecodecs.png_encode(picture))
    return content[:33] + b"".join(chunk(*each) for each in chunks) + content[33:]


def iccp(profile):
    return b"iCCP", b"name\0\0" + zlib.compress(profile)


# -- defaults of formats -------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_sandbox")
@pytest.mark.parametrize("name", ["p.exr", "p.tif", "p.hdr", "p.pfm"])
def test_floating_point_files_are_linear(tmp_path, name):
    grey = np.full((4, 5), 0.1875, np.float32)
    if name == "p.hdr":
        written(tmp_path, imagecodecs.rgbe_encode(np.dstack([grey] * 3)), name)
    elif name == "p.pfm":
        Image.fromarray(grey).save(tmp_path / name, "PPM")
    else:
        write_picture(tmp_path / name, grey)
    scene = fs.Scene.from_picture(tmp_path / name, distance_m=1.0, illuminance_lux=500.0)
    assert scene.basis == pytest.approx(0.1875)
    ordered = fs.Scene.from_picture(tmp_path / name, distance_m=1.0, illuminance_lux=500.0, encoding="srgb")
    assert ordered.basis == pytest.approx(float(decode_srgb(0.1875)))


def test_arrays_and_integers_are_srgb(tmp_path):
    write_picture(tmp_path / "p.tif", PATCH16)
    for picture in (PATCH16, PATCH16 / 65535.0, tmp_path / "p.tif"):
        assert light_of(picture) == pytest.approx(decode_srgb(PATCH16 / 65535.0))


FORMATS = [
    *((name, bits) for name in ("p.png", "p.tif") for bits in (8, 16)),
    *(("p.tif", 32), ("p.exr", 32)),
    *((f"p.{name}", 8) for name in ("jpg", "webp", "jp2", "tga", "bmp", "ppm", "gif")),
]


@pytest.mark.usefixtures("no_sandbox")
@pytest.mark.parametrize("encode", [True, False], ids=["srgb", "linear"])
@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize(("name", "bits"), FORMATS)
def test_saved_picture_is_read_with_defaults(tmp_path, name, bits, n_channels, encode):
    data = np.empty((n_channels, 16, 16), np.float32)
    data[:] = np.array([0.687, 0.18, 0.02][:n_channels])[:, None, None]
    data[:, :8] = 1.0
    grid = fs.Grid.centred((16, 16), 1.0)
    picture = fs.Picture(data, np.ones((16, 16), np.float32), grid)
    if bits == 32:
        picture.save(tmp_path / name, bits=bits)
    elif not encode and name not in ("p.png", "p.tif"):
        with pytest.raises(ParameterError, match=r"^'encode_srgb' must be True for [^\n]*; use .png or .tif"):
            picture.save(tmp_path / name, 1.0, bits=bits, encode_srgb=False)
        return
    else:
        picture.save(tmp_path / name, 1.0, bits=bits, encode_srgb=encode)
    scene = fs.Scene.from_picture(tmp_path / name, distance_m=1.0, illuminance_lux=500.0)
    # Half a code of linear values, and that of sRGB at its largest slope; JPEG: a few codes of its cosine coefficients.
    step = 1e-7 if bits == 32 else (1.2 if encode else 0.51) / (2**bits - 1)
    tolerance = 0.02 if name in ("p.jpg", "p.gif") else step
    assert scene.basis == pytest.approx(np.broadcast_to(data, scene.basis.shape), abs=tolerance)


# -- ICC profiles ------------------------------------------------------------------------------------------------------

EXPECTED_P3 = srgb_of((PATCH8[0, 0] / 255.0) ** (563 / 256), P3_XY)  # 2.2 is stored as 563/256


@pytest.mark.parametrize(
    ("picture_format", "options"),
    [
        ("PNG", {}),
        ("JPEG", {"quality": 100, "subsampling": 0}),
        ("WEBP", {"lossless": True}),
        ("TIFF", {}),
        ("AVIF", {"quality": 100}),
    ],
)
def test_profile_is_applied_in_each_format(tmp_path, picture_format, options):
    path = written(tmp_path, encoded(PATCH8, picture_format, icc_profile=P3_PROFILE, **options))
    # JPEG and AVIF round to a code or two; a code at 200 is 0.7 % of the light.
    tolerance = 0.02 if picture_format in ("JPEG", "AVIF") else 2e-4
    assert light_of(path)[0, 0] == pytest.approx(EXPECTED_P3, abs=tolerance)


def test_bmp_and_gif_profiles_are_applied(tmp_path):
    body = PATCH8[::-1, :, ::-1].copy().view(np.uint8).reshape(4, -1)
    rows = np.pad(body, ((0, 0), (0, -body.shape[1] % 4))).tobytes()
    header = struct.pack("<IiiHHIIiiII", 124, 6, 4, 1, 24, 0, len(rows), 0, 0, 0, 0) + bytes(16)
    v5 = (
        header
        + struct.pack("<I", 0x4D424544)
        + bytes(48)
        + struct.pack("<IIII", 4, 124 + len(rows), len(P3_PROFILE), 0)
    )
    size = 14 + 124 + len(rows) + len(P3_PROFILE)
    content = struct.pack("<2sIII", b"BM", size, 0, 14 + 124) + v5 + rows + P3_PROFILE
    assert light_of(written(tmp_path, content))[0, 0] == pytest.approx(EXPECTED_P3, abs=2e-4)

    parts = [P3_PROFILE[k : k + 255] for k in range(0, len(P3_PROFILE), 255)]
    blocks = b"".join(bytes([len(part)]) + part for part in parts)
    gif = encoded(PATCH8, "GIF")
    begin = 13 + (3 << ((gif[10] & 7) + 1) if gif[10] & 0x80 else 0)
    content = gif[:begin] + b"\x21\xff\x0bICCRGBG1012" + blocks + b"\0" + gif[begin:]
    assert light_of(written(tmp_path, content))[0, 0] == pytest.approx(EXPECTED_P3, abs=2e-4)


def test_profile_keeps_sixteen_bits(tmp_path):
    noise = np.random.default_rng(2).integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    for alpha in (None, np.full((20, 30, 1), 30_000, np.uint16)):
        picture = noise if alpha is None else np.dstack([noise, alpha])
        found = as_encoded(written(tmp_path, png_with(iccp(P3_PROFILE), picture=picture)))
        expected = srgb_of((noise / 65535.0) ** (563 / 256), P3_XY)
        # The numbers of a profile have steps of 1/65536.
        assert found.pixels[..., :3] == pytest.approx(expected, abs=5e-5)
        if alpha is not None:
            assert found.pixels[..., 3] == pytest.approx(30_000 / 65535.0)


def test_profile_agrees_with_little_cms():
    # Pillow: 8 bits. Colours inside sRGB, where it does not clip.
    greens = np.stack(np.meshgrid(*[np.arange(60, 200, 35, dtype=np.uint8)] * 3), axis=-1).reshape(1, -1, 3)
    image = Image.fromarray(greens)
    profile, srgb = (ImageCms.ImageCmsProfile(io.BytesIO(each)) for each in (P3_PROFILE, SRGB_PROFILE))
    codes = np.asarray(ImageCms.profileToProfile(image, profile, srgb, ImageCms.Intent.RELATIVE_COLORIMETRIC), float)
    image.info["icc_profile"] = P3_PROFILE
    light = light_of(image)
    inside = (light > 0.0).all(axis=-1) & (light < 1.0).all(axis=-1)
    assert inside.mean() > 0.5
    assert 255.0 * encode_srgb(np.maximum(light, 0.0))[inside] == pytest.approx(codes[inside], abs=1.0)


@pytest.mark.parametrize("profile", [SRGB_PROFILE, imagecodecs.cms_profile("srgb")], ids=["Pillow", "imagecodecs"])
@pytest.mark.parametrize("picture", [PATCH8, PATCH16, PATCH8[..., 0]], ids=["8 bits", "16 bits", "grey"])
def test_srgb_profile_changes_nothing(tmp_path, monkeypatch, profile, picture):
    monkeypatch.setitem(sys.modules, "imagecodecs", imagecodecs)
    found = as_encoded(written(tmp_path, png_with(iccp(profile), picture=picture)))
    assert found.encoding == "srgb"
    assert np.array_equal(found.pixels, picture)


def test_grey_profiles_are_applied(tmp_path):
    for profile in (icc.grey_profile(2.2), profile_of(primaries.SRGB_XY, 2.2)):
        light = light_of(written(tmp_path, encoded(PATCH8[..., 0], "PNG", icc_profile=profile)))
        assert light == pytest.approx((200 / 255.0) ** (563 / 256), abs=2e-4)


def lab_of_inks(cyan, magenta, yellow, black):
    """Return inks of a printer: each darkens, cyan and yellow have a hue."""
    lightness = 100.0 * 0.55**cyan * 0.5**magenta * 0.9**yellow * 0.2**black
    return lightness, (60.0 * magenta - 30.0 * cyan) * (1 - black), (70.0 * yellow - 40.0 * cyan) * (1 - black)


CMYK_PROFILE = icc.cmyk_profile(lab_of_inks)
CORNERS = np.array(list(itertools.product((0, 255), repeat=4)), np.uint8).reshape(4, 4, 4)


def light_of_lab(lab):
    f_y = (lab[0] + 16.0) / 116.0
    f = np.array([f_y + lab[1] / 500.0, f_y, f_y - lab[2] / 200.0])
    relative = np.where(f > 6.0 / 29.0, f**3, 3.0 * (6.0 / 29.0) ** 2 * (f - 4.0 / 29.0))
    return primaries.srgb_of_xyz((relative * D50_XYZ)[np.newaxis], D50_XYZ)[0]


@pytest.mark.parametrize("bits", [8, 16])
def test_inks_are_converted_by_their_profile(tmp_path, bits):
    inks = CORNERS if bits == 8 else CORNERS.astype(np.uint16) * np.uint16(257)
    path = tmp_path / "inks.tif"
    tifffile.imwrite(path, inks, photometric="separated", iccprofile=CMYK_PROFILE)
    expected = np.array([light_of_lab(lab_of_inks(*corner)) for corner in CORNERS.reshape(-1, 4) / 255.0])
    assert light_of(path).reshape(-1, 3) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("corner", [(0, 0, 0, 0), (255, 0, 0, 0), (0, 255, 255, 0), (0, 0, 0, 255)])
def test_inverted_inks_of_adobe_are_read(tmp_path, corner):
    image = Image.new("CMYK", (16, 16), corner)
    file = io.BytesIO()
    image.save(file, "JPEG", quality=100, icc_profile=CMYK_PROFILE)
    assert b"Adobe" in file.getvalue()[:200]
    expected = light_of_lab(lab_of_inks(*np.array(corner) / 255.0))
    assert light_of(written(tmp_path, file.getvalue()))[0, 0] == pytest.approx(expected, abs=0.02)


def test_adobe_rgb_of_cameras_is_understood(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03", 2: b"0100"}
    path = written(tmp_path, encoded(PATCH8, "JPEG", quality=100, subsampling=0, exif=exif))
    expected = srgb_of((PATCH8[0, 0] / 255.0) ** (563 / 256), ADOBE_XY)
    assert light_of(path)[0, 0] == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize(
    "broken", [b"", b"x" * 40, b"x" * 300, P3_PROFILE[:200], P3_PROFILE[:140] + b"\xff" * 200], ids=range(5)
)
@pytest.mark.parametrize("picture_format", ["JPEG", "PNG", "TIFF"])
def test_broken_profile_gives_one_sentence(tmp_path, broken, picture_format):
    if picture_format == "PNG":
        content = png_with(iccp(broken))
    elif picture_format == "TIFF":
        file = io.BytesIO()
        tifffile.imwrite(
            file, PATCH8, photometric="rgb", extratags=[(34_675, "B", max(len(broken), 1), broken or b"\0", True)]
        )
        content = file.getvalue()
    else:
        marker = b"ICC_PROFILE\0\1\1" + broken
        content = encoded(PATCH8, "JPEG", quality=100, subsampling=0)
        content = content[:2] + b"\xff\xe2" + struct.pack(">H", len(marker) + 2) + marker + content[2:]
    path = written(tmp_path, content)
    if picture_format == "JPEG" and not broken:
        return  # Pillow treats an empty profile as none
    with pytest.raises(FileError, match=r"colour profile[^\n]*choose encoding='srgb'[^\n]*$"):
        as_encoded(path)
    assert as_encoded(path, "srgb").pixels.shape == PATCH8.shape


def test_missing_part_of_profile_is_reported(tmp_path):
    marker = b"ICC_PROFILE\0\1\2" + P3_PROFILE  # the first of two parts
    content = encoded(PATCH8, "JPEG")
    content = content[:2] + b"\xff\xe2" + struct.pack(">H", len(marker) + 2) + marker + content[2:]
    with pytest.raises(FileError, match="has a broken colour profile"):
        as_encoded(written(tmp_path, content))


def test_profile_of_other_channels_is_rejected(tmp_path):
    path = written(tmp_path, encoded(PATCH8, "JPEG", icc_profile=icc.grey_profile(2.2)))
    with pytest.raises(
        FileError, match=r"has a colour profile of 1 channels, but 3 colour channels; .* choose encoding='srgb'"
    ):
        as_encoded(path)


def test_large_profile_is_rejected(tmp_path, monkeypatch):
    path = written(tmp_path, encoded(PATCH8, "JPEG", icc_profile=P3_PROFILE))
    monkeypatch.setattr(_profiles, "MAX_PROFILE_BYTES", 100)
    with pytest.raises(FileError, match="more than the limit of 100"):
        as_encoded(path)


def test_profile_without_imagecodecs_names_the_extra(tmp_path, monkeypatch):
    profile = profile_of(P3_XY, 2.1)  # not in the cache
    path = written(tmp_path, encoded(PATCH8, "JPEG", icc_profile=profile))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(
        FileError, match=r"'by hand', whose conversion needs imagecodecs; install it with: .* choose encoding='srgb'$"
    ):
        as_encoded(path)
    assert as_encoded(written(tmp_path, encoded(PATCH8, "PNG", icc_profile=SRGB_PROFILE))).encoding == "srgb"


@pytest.mark.parametrize(
    ("profile", "n_channels"),
    [(P3_PROFILE, 3), (CMYK_PROFILE, 4), (icc.grey_profile(2.2), 1)],
    ids=["rgb", "cmyk", "grey"],
)
def test_flipped_profile_gives_light_or_error(profile, n_channels):
    rng = np.random.default_rng(7)
    pixels = np.zeros((2, 3, 4), np.uint8)[..., :n_channels] if n_channels > 1 else np.zeros((2, 3), np.uint8)
    n_found = 0
    for _ in range(1000):
        damaged = bytearray(profile)
        for at in rng.integers(0, len(damaged), 3):
            damaged[at] = rng.integers(256)
        with contextlib.suppress(FormatError):
            convert = profile_to_srgb(bytes(damaged), n_channels)
            assert convert is None or convert(pixels).shape[:2] == (2, 3)
            n_found += 1
    assert 0 < n_found < 1000


def test_explicit_encoding_replaces_profile(tmp_path):
    path = written(tmp_path, encoded(PATCH8, "PNG", icc_profile=P3_PROFILE))
    assert light_of(path, "srgb")[0, 0] == pytest.approx(decode_srgb(PATCH8[0, 0] / 255.0))
    assert light_of(path, "linear")[0, 0] == pytest.approx(PATCH8[0, 0] / 255.0)


# -- PNG -----------------------------------------------------------------------------------------------------------------

GAMMA_1 = b"gAMA", struct.pack(">I", 100_000)
SRGB_CHUNK = b"sRGB", b"\0"
P3_CHRM = b"cHRM", struct.pack(">8I", 31_270, 32_900, 68_000, 32_000, 26_500, 69_000, 15_000, 6_000)
PLAIN = decode_srgb(PATCH8[0, 0] / 255.0)
CHUNKS = {
    "none": ((), PLAIN),
    "sRGB": ((SRGB_CHUNK,), PLAIN),
    "gAMA 1": ((GAMMA_1,), PATCH8[0, 0] / 255.0),
    "gAMA 1/2": (((b"gAMA", struct.pack(">I", 50_000)),), (PATCH8[0, 0] / 255.0) ** 2),
    "gAMA of sRGB": (((b"gAMA", struct.pack(">I", 45_455)),), PLAIN),
    "cHRM": ((P3_CHRM,), srgb_of(PLAIN, P3_XY)),
    "cHRM and gAMA": ((P3_CHRM, GAMMA_1), srgb_of(PATCH8[0, 0] / 255.0, P3_XY)),
    "sRGB before gAMA and cHRM": ((SRGB_CHUNK, GAMMA_1, P3_CHRM), PLAIN),
    "iCCP before sRGB": ((SRGB_CHUNK, iccp(P3_PROFILE), GAMMA_1), EXPECTED_P3),
    "cICP before iCCP": (((b"cICP", bytes([12, 13, 0, 1])), iccp(SRGB_PROFILE), SRGB_CHUNK), srgb_of(PLAIN, P3_XY)),
    "cICP of sRGB": (((b"cICP", bytes([1, 13, 0, 1])), GAMMA_1), PLAIN),
    "cICP linear": (((b"cICP", bytes([1, 8, 0, 1])),), PATCH8[0, 0] / 255.0),
}


@pytest.mark.parametrize("is_deep", [False, True], ids=["8 bits", "16 bits"])
@pytest.mark.parametrize(("chunks", "expected"), CHUNKS.values(), ids=CHUNKS)
def test_png_chunks_have_precedence(tmp_path, chunks, expected, is_deep):
    picture = PATCH8.astype(np.uint16) * np.uint16(257) if is_deep else PATCH8
    assert light_of(written(tmp_path, png_with(*chunks, picture=picture)))[0, 0] == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ((b"cICP", bytes([9, 16, 0, 1])), "has the transfer function PQ, whose white is not defined"),
        ((b"cICP", bytes([9, 18, 0, 1])), "has the transfer function HLG"),
        ((b"cICP", bytes([1, 13, 0, 0])), "has a chunk cICP with matrix 0 and range 0"),
        ((b"cICP", b"\1"), "has a broken chunk cICP"),
        ((b"cICP", bytes([77, 13, 0, 1])), "has the unsupported colours 77/13"),
        ((b"gAMA", bytes(4)), "has a broken chunk gAMA or cHRM"),
        ((b"cHRM", bytes(32)), "has primaries that define no colours"),
    ],
)
def test_undefined_colours_of_png_are_reported(tmp_path, body, message):
    path = written(tmp_path, png_with(body))
    with pytest.raises(FileError, match=rf"{message}[^\n]*; to read its values without it, choose encoding='srgb'"):
        as_encoded(path)
    assert np.array_equal(as_encoded(path, "linear").pixels, PATCH8)


def test_png_chunks_are_sorted_into_classes(tmp_path):
    assert not _png.UNDERSTOOD & _png.IRRELEVANT
    assert not set(_png.REJECTED) & (_png.UNDERSTOOD | _png.IRRELEVANT)
    for kind, message in (
        (b"QzZz", "unknown critical chunk 'QzZz'"),
        (b"CgBI", "critical chunk 'CgBI'"),
        (b"pCAL", "chunk pCAL"),
        (b"sTER", "two views"),
    ):
        with pytest.raises(FileError, match=message):
            as_encoded(written(tmp_path, png_with((kind, b"\0"))))
    # Ancillary chunks of other programs may be ignored by the rules of the format.
    assert as_encoded(written(tmp_path, png_with((b"zzZz", b"\0"), (b"tEXt", b"a\0b")))).encoding == "srgb"


def test_deep_png_is_upright(tmp_path):
    exif = Image.Exif()
    exif[274] = 6
    content = png_with((b"eXIf", exif.tobytes()), picture=PATCH16)
    assert as_encoded(written(tmp_path, content)).pixels.shape == (6, 4, 3)


@pytest.mark.parametrize("resolution", [(3000, 6000, 1), (1, 2, 0)])
def test_pixels_that_are_not_square_are_reported(tmp_path, resolution):
    content = png_with((b"pHYs", struct.pack(">IIB", *resolution)))
    with pytest.raises(FileError, match=r"has pixels that are not square \(pHYs"):
        as_encoded(written(tmp_path, content))
    content = encoded(PATCH8, "JPEG", dpi=(72, 144))
    with pytest.raises(FileError, match="not square"):
        as_encoded(written(tmp_path, content))
    file = io.BytesIO()
    tifffile.imwrite(file, PATCH8, photometric="rgb", resolution=(72, 144))
    with pytest.raises(FileError, match="not square"):
        as_encoded(written(tmp_path, file.getvalue()))


# -- TIFF ------------------------------------------------------------------------------------------------------------------


def tiff_with(*tags, picture=PATCH8):
    file = io.BytesIO()
    tifffile.imwrite(file, picture, photometric="rgb", extratags=tags, metadata=None)
    return file.getvalue()


def rationals(*values):
    return [number for value in values for number in (round(value * 10_000), 10_000)]


P3_TAGS = ((319, "2I", 6, rationals(*P3_XY[:3].ravel()), True), (318, "2I", 2, rationals(*D65), True))


def test_tiff_primaries_and_transfer_are_applied(tmp_path):
    light = (np.arange(256) / 255.0) ** 1.8
    curve = (301, "H", 256, np.rint(65535 * light).astype(np.uint16), True)
    three = (301, "H", 768, np.rint(65535 * np.concatenate([light, light**2, light**3])).astype(np.uint16), True)
    assert light_of(written(tmp_path, tiff_with(*P3_TAGS)))[0, 0] == pytest.approx(srgb_of(PLAIN, P3_XY), abs=2e-4)
    assert light_of(written(tmp_path, tiff_with(curve)))[0, 0] == pytest.approx((PATCH8[0, 0] / 255.0) ** 1.8, abs=2e-5)
    expected = ((PATCH8[0, 0] / 255.0) ** 1.8) ** np.array([1, 2, 3])
    assert light_of(written(tmp_path, tiff_with(three)))[0, 0] == pytest.approx(expected, abs=2e-5)
    both = light_of(written(tmp_path, tiff_with(curve, *P3_TAGS)))[0, 0]
    assert both == pytest.approx(srgb_of((PATCH8[0, 0] / 255.0) ** 1.8, P3_XY), abs=2e-4)
    floats = light_of(written(tmp_path, tiff_with(*P3_TAGS, picture=(PATCH8 / 255.0).astype(np.float32))))[0, 0]
    assert floats == pytest.approx(srgb_of(PATCH8[0, 0] / 255.0, P3_XY), abs=1e-5)


def test_profile_of_floating_point_tiff_is_applied(tmp_path):
    path = tmp_path / "p.tif"
    tifffile.imwrite(path, (PATCH8 / 255.0).astype(np.float32), photometric="rgb", iccprofile=SRGB_PROFILE)
    assert light_of(path)[0, 0] == pytest.approx(PLAIN)
    tifffile.imwrite(path, (PATCH8 / 255.0).astype(np.float32), photometric="rgb", iccprofile=P3_PROFILE)
    assert light_of(path)[0, 0] == pytest.approx(EXPECTED_P3, abs=2e-4)


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        ((291, "H", 2, [0, 1], True), "has the tag 291, GrayResponseCurve"),
        ((342, "H", 6, [0, 128] * 3, True), r"has the tag TransferRange with \[0.0, 128.0"),
        ((532, "2I", 6, rationals(16, 235) * 3, True), "has the tag ReferenceBlackWhite"),
        ((50_706, "B", 4, bytes([1, 4, 0, 0]), True), "has the tag 50706, DNGVersion"),
        ((31_999, "H", 1, 1, True), "has the unknown tag 31999"),
    ],
)
def test_tiff_tags_that_change_pixels_are_rejected(tmp_path, tag, message):
    with pytest.raises(FileError, match=message):
        as_encoded(written(tmp_path, tiff_with(tag)))


@pytest.mark.parametrize("is_big", [False, True])
def test_profile_outside_tiff_is_reported(tmp_path, is_big):
    path = tmp_path / "p.tif"
    tifffile.imwrite(path, PATCH8, photometric="rgb", iccprofile=P3_PROFILE, bigtiff=is_big)
    with tifffile.TiffFile(path) as file:
        at = file.pages[0].tags[34_675].offset + (12 if is_big else 8)
    content = bytearray(path.read_bytes())
    content[at : at + 4] = struct.pack("<I", 2**31)
    with pytest.raises(FileError, match=r"has a broken colour profile or colour tag \(34675\)"):
        as_encoded(written(tmp_path, bytes(content)))


def test_tiff_tags_are_sorted_into_classes(tmp_path):
    classes = [
        _tiff.UNDERSTOOD,
        _tiff.IRRELEVANT,
        frozenset(_tiff.REJECTED),
        frozenset(_tiff.DEFAULTS) - _tiff.UNDERSTOOD,
    ]
    assert sum(map(len, classes)) == len(frozenset().union(*classes))
    private = (40_000, "H", 1, 1, True)
    assert as_encoded(written(tmp_path, tiff_with(private, (315, "s", 0, "artist", True)))).encoding == "srgb"


# -- EXR -------------------------------------------------------------------------------------------------------------------


def exr_with(tmp_path, channels=None, **header):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, channels or {"RGB": LINEAR_PATCH}) as file:
        file.write(str(tmp_path / "p.exr"))
    return tmp_path / "p.exr"


LINEAR_PATCH = np.tile(np.array([0.5, 0.25, 0.125], np.float32), (4, 6, 1))
AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
TUNGSTEN = (0.44757, 0.40745)


@pytest.mark.usefixtures("no_sandbox")
def test_exr_chromaticities_are_converted(tmp_path):
    for xy in (AP0, tuple(P3_XY.ravel())):
        found = as_encoded(exr_with(tmp_path, chromaticities=xy))
        assert found.pixels[0, 0] == pytest.approx(srgb_of(LINEAR_PATCH[0, 0], np.reshape(xy, (4, 2))), abs=1e-5)
        white = {"RGB": np.ones((4, 6, 3), np.float32)}
        assert as_encoded(exr_with(tmp_path, white, chromaticities=xy)).pixels == pytest.approx(1.0, abs=1e-5)


@pytest.mark.usefixtures("no_sandbox")
def test_exr_adopted_neutral_becomes_white(tmp_path):
    xyz = primaries.xyz_of_xy(np.array([TUNGSTEN]))
    grey = np.linalg.solve(primaries.XYZ_OF_SRGB.T, xyz.T).T[0].astype(np.float32)
    path = exr_with(tmp_path, {"RGB": np.tile(grey, (4, 6, 1))}, adoptedNeutral=np.array(TUNGSTEN, np.float32))
    assert as_encoded(path).pixels == pytest.approx(1.0, abs=1e-4)


@pytest.mark.usefixtures("no_sandbox")
def test_exr_picture_is_the_display_window(tmp_path):
    ramp = np.arange(24, dtype=np.float32).reshape(4, 6)
    window = (np.array([2, 1], np.int32), np.array([7, 4], np.int32))
    display = (np.array([0, 0], np.int32), np.array([5, 5], np.int32))
    found = as_encoded(exr_with(tmp_path, {"Y": ramp}, dataWindow=window, displayWindow=display)).pixels
    expected = np.zeros((6, 6))
    expected[1:5, 2:6] = ramp[:, :4]
    assert np.array_equal(found, expected)


@pytest.mark.usefixtures("no_sandbox")
def test_exr_colours_are_premultiplied(tmp_path):
    picture = np.dstack([LINEAR_PATCH, np.full((4, 6), 0.5, np.float32)])
    assert np.array_equal(as_encoded(exr_with(tmp_path, {"RGBA": picture})).pixels, LINEAR_PATCH)
    write_picture(tmp_path / "w.exr", picture)
    assert np.array_equal(as_encoded(tmp_path / "w.exr").pixels, LINEAR_PATCH * 0.5)


PLANE = LINEAR_PATCH[..., 0].copy()
CHANNELS = {
    "depth": ({"RGB": LINEAR_PATCH, "Z": PLANE}, None),
    "one layer": ({"view.R": PLANE, "view.G": PLANE, "view.B": PLANE}, None),
    "picture and layers": ({"RGB": LINEAR_PATCH, "diffuse.R": PLANE, "diffuse.G": PLANE}, None),
    "layers": ({"a.R": PLANE, "b.R": PLANE}, "has several layers, 'a', 'b'"),
    "unknown channel": (
        {"RGB": LINEAR_PATCH, "AR": PLANE},
        "must have the channels of one picture, R, G, B or Y, got 'AR'",
    ),
    "luminance and chroma": ({"Y": PLANE, "RY": PLANE, "BY": PLANE}, "has channels of luminance and chroma"),
    "integers": ({"Y": np.ones((4, 6), np.uint32)}, "has channels of integers"),
}


@pytest.mark.usefixtures("no_sandbox")
@pytest.mark.parametrize(("channels", "message"), CHANNELS.values(), ids=CHANNELS)
def test_exr_channels_are_understood_or_named(tmp_path, channels, message):
    path = exr_with(tmp_path, channels)
    if message is None:
        assert as_encoded(path).pixels.shape == (4, 6, 3)
    else:
        with pytest.raises(FileError, match=message):
            as_encoded(path)


@pytest.mark.usefixtures("no_sandbox")
@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"pixelAspectRatio": 2.0}, r"not square \(pixelAspectRatio 2 x 1\)"),
        ({"multiView": ["left", "right"]}, r"contains several views \(left, right\)"),
        ({"oiio:ColorSpace": "sRGB"}, "has the attribute 'oiio:ColorSpace' with the value 'sRGB'; .* choose encoding"),
        ({"colorInteropID": "srgb_rec709_scene"}, "has the attribute 'colorInteropID'"),
        ({"my_gamma": 2.2}, "has the attribute 'my_gamma' with the value '2.2"),
        ({"chromaticities": (0.3,) * 8}, "has primaries that define no colours"),
    ],
)
def test_exr_attributes_that_change_light_are_named(tmp_path, header, message):
    path = exr_with(tmp_path, **header)
    with pytest.raises(FileError, match=message):
        as_encoded(path)


@pytest.mark.usefixtures("no_sandbox")
def test_exr_attributes_are_sorted_into_classes(tmp_path):
    assert not _exr.UNDERSTOOD & _exr.IRRELEVANT
    notes = {"whiteLuminance": 100.0, "Software": "a renderer", "oiio:ColorSpace": "lin_rec709", "owner": "me"}
    assert np.array_equal(as_encoded(exr_with(tmp_path, **notes)).pixels, LINEAR_PATCH)
    found = as_encoded(exr_with(tmp_path, colorInteropID="lin_p3d65_scene")).pixels
    assert found[0, 0] == pytest.approx(srgb_of(LINEAR_PATCH[0, 0], P3_XY), abs=1e-5)


@pytest.mark.usefixtures("no_sandbox")
def test_two_parts_of_exr_are_rejected(tmp_path):
    parts = [
        OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage}, {"RGB": LINEAR_PATCH}) for name in ("left", "right")
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "p.exr"))
    with pytest.raises(FileError, match="contains 2 pictures"):
        as_encoded(tmp_path / "p.exr")


# -- Radiance HDR ------------------------------------------------------------------------------------------------------------

#: Mantissas of red, green, blue, and the exponent of 1: values 1/2, 1/4, 1/8 and so on.
RGBE = bytes([128, 64, 32, 128, 64, 64, 64, 128, 32, 128, 16, 128, 16, 16, 128, 128, 8, 8, 8, 128, 4, 4, 4, 128])
STORED = np.frombuffer(RGBE, np.uint8).reshape(2, 3, 4)[..., :3] / 256.0


def hdr(*lines, resolution="-Y 2 +X 3", magic="#?RADIANCE"):
    return "\n".join([magic, *lines, "", resolution, ""]).encode() + RGBE


@pytest.mark.parametrize(
    ("lines", "factor"),
    [
        ((), 1.0),
        (("EXPOSURE=2.0", "# comment", "EXPOSURE= 4"), 1 / 8.0),
        (("COLORCORR=2 1 0.5", "EXPOSURE=2"), 1 / np.array([4.0, 2.0, 1.0])),
        (("rpict -vf view.vf", "\tEXPOSURE=5", "FORMAT=32-bit_rle_rgbe", "VIEW= -vtv"), 1.0),
        (("GAMMA=1", "PIXASPECT=1.0", "SOFTWARE=x"), 1.0),
    ],
)
def test_radiance_values_are_divided_by_exposure(tmp_path, lines, factor):
    found = as_encoded(written(tmp_path, hdr(*lines)))
    assert found.encoding == "linear"
    assert found.pixels == pytest.approx(STORED * factor)


def test_radiance_primaries_are_converted(tmp_path):
    path = written(tmp_path, hdr(f"PRIMARIES={' '.join(map(str, P3_XY.ravel()))}"))
    assert as_encoded(path).pixels == pytest.approx(srgb_of(STORED, P3_XY), abs=1e-6)


@pytest.mark.parametrize(
    ("resolution", "turn"),
    [
        ("-Y 2 +X 3", lambda p: p),
        ("+Y 2 +X 3", lambda p: p[::-1]),
        ("-Y 2 -X 3", lambda p: p[:, ::-1]),
        ("+Y 2 -X 3", lambda p: p[::-1, ::-1]),
        # Scan lines along Y: the first of 2 lines has X = 0, and 3 pixels.
        ("+X 2 -Y 3", lambda p: p.swapaxes(0, 1)),
        ("+X 2 +Y 3", lambda p: p.swapaxes(0, 1)[::-1]),
        ("-X 2 -Y 3", lambda p: p.swapaxes(0, 1)[:, ::-1]),
        ("-X 2 +Y 3", lambda p: p.swapaxes(0, 1)[::-1, ::-1]),
    ],
)
def test_radiance_picture_is_upright(tmp_path, resolution, turn):
    assert as_encoded(written(tmp_path, hdr(resolution=resolution))).pixels == pytest.approx(turn(STORED))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "FORMAT=32-bit_rle_xyze",
            "has the FORMAT '32-bit_rle_xyze', expected 32-bit_rle_rgbe; convert it with: ra_xyze -r",
        ),
        ("FORMAT=other", "has the FORMAT 'other'"),
        ("PIXASPECT=2", "not square"),
        ("GAMMA=2.2", "has GAMMA=2.2"),
        ("EXPOSURE=0", "has EXPOSURE=0 in its header, expected 1 positive number"),
        ("EXPOSURE=nan", "has EXPOSURE=nan"),
        ("COLORCORR=1 2", "expected 3 positive numbers"),
        ("NCOMP=16", "has NCOMP=16, expected 3 components"),
        ("BRIGHTNESS=3", "has the unknown variable 'BRIGHTNESS' in its header"),
    ],
)
def test_radiance_header_is_understood_or_named(tmp_path, line, message):
    with pytest.raises(FileError, match=message):
        as_encoded(written(tmp_path, hdr(line)))


# -- other formats ---------------------------------------------------------------------------------------------------------------


def box(kind, body):
    return struct.pack(">I4s", len(body) + 8, kind) + body


def test_jpeg_2000_colour_box_is_understood(tmp_path):
    content = encoded(PATCH8, "JPEG2000")
    at = content.index(b"colr") - 4
    size = int.from_bytes(content[at : at + 4])
    jp2h = content.index(b"jp2h") - 4

    def with_box(body):
        new = box(b"colr", body)
        changed = content[:at] + new + content[at + size :]
        length = int.from_bytes(content[jp2h : jp2h + 4]) + len(new) - size
        return written(tmp_path, changed[:jp2h] + struct.pack(">I", length) + changed[jp2h + 4 :])

    assert light_of(with_box(b"\2\0\0" + P3_PROFILE))[0, 0] == pytest.approx(EXPECTED_P3, abs=2e-4)
    assert light_of(with_box(b"\1\0\0" + struct.pack(">I", 16)))[0, 0] == pytest.approx(PLAIN)
    with pytest.raises(FileError, match="unsupported colour space 14 of JPEG 2000"):
        as_encoded(with_box(b"\1\0\0" + struct.pack(">I", 14)))


def test_avif_codes_are_understood(tmp_path):
    content = encoded(PATCH8, "AVIF", quality=100, subsampling="4:4:4")
    at = content.index(b"colrnclx") + 8
    path = written(tmp_path, content[:at] + struct.pack(">HH", 12, 13) + content[at + 4 :])
    assert light_of(path)[0, 0] == pytest.approx(srgb_of(PLAIN, P3_XY), abs=0.02)
    path = written(tmp_path, content[:at] + struct.pack(">HH", 9, 16) + content[at + 4 :])
    with pytest.raises(FileError, match="has the transfer function PQ"):
        as_encoded(path)


@pytest.mark.parametrize("with_profile", [True, False])
def test_heic_colours_cross_the_sandbox(tmp_path, with_profile):
    pillow_heif = pytest.importorskip("pillow_heif")
    image = Image.fromarray(np.tile(PATCH8[0, 0], (64, 64, 1)))
    if with_profile:
        image.info["icc_profile"] = P3_PROFILE
    options = {} if with_profile else {"color_primaries": 12, "transfer_characteristics": 13}
    pillow_heif.from_pillow(image).save(tmp_path / "p.heic", quality=100, chroma=444, save_nclx_profile=True, **options)
    found = as_encoded(tmp_path / "p.heic")
    expected = EXPECTED_P3 if with_profile else srgb_of(PLAIN, P3_XY)
    assert found.encoding == "linear"
    assert found.pixels[32, 32] == pytest.approx(expected, abs=0.02)


def test_end_points_of_bmp_are_understood(tmp_path):
    bmp = encoded(PATCH8, "BMP")
    offset, info = int.from_bytes(bmp[10:14], "little"), bmp[14:54]
    xyz = np.rint(2.0**30 * primaries.xyz_of_primaries(P3_XY)).astype("<i4").tobytes()

    def with_header(space, points, gammas):
        v4 = (
            struct.pack("<I", 108)
            + info[4:]
            + bytes(16)
            + struct.pack("<I", space)
            + points
            + struct.pack("<3I", *gammas)
        )
        return written(tmp_path, bmp[:10] + struct.pack("<I", 14 + 108) + v4 + bmp[offset:])

    gamma = round(1.8 * 65536)
    expected = srgb_of((PATCH8[0, 0] / 255.0) ** 1.8, P3_XY)
    assert light_of(with_header(0, xyz, [gamma] * 3))[0, 0] == pytest.approx(expected, abs=2e-4)
    for space in (0, 0x73524742, 0x57696E20):
        assert light_of(with_header(space, bytes(36), [0] * 3))[0, 0] == pytest.approx(PLAIN)
    for space, gammas in ((0, [1, 2, 3]), (0x4C494E4B, [0] * 3)):
        with pytest.raises(FileError, match=r"has different gammas|has the unsupported colour space 0x4c494e4b of BMP"):
            as_encoded(with_header(space, bytes(36), gammas))


def test_gamma_of_tga_is_reported(tmp_path):
    content = encoded(PATCH8, "TGA")
    content = content[:-26] if content[-18:-2] == b"TRUEVISION-XFILE" else content
    area = bytearray(495)
    area[478:482] = struct.pack("<HH", 22, 10)
    footer = struct.pack("<II", len(content), 0) + b"TRUEVISION-XFILE.\0"
    with pytest.raises(FileError, match=r"has the gamma 2\.2, on which programs disagree"):
        as_encoded(written(tmp_path, content + bytes(area) + footer))
    area[478:482] = bytes(4)
    assert as_encoded(written(tmp_path, content + bytes(area) + footer)).encoding == "srgb"


def test_transfer_functions_meet_their_standards():
    # Rec. ITU-R BT.709: 18 % grey has the signal 1.099 x 0.18**0.45 - 0.099.
    signal = np.full((1, 1, 3), 1.099 * 0.18**0.45 - 0.099)
    assert encoded_picture(FilePicture(pixels=signal, colour=h273_colour(1, 1)), "auto").pixels == pytest.approx(
        0.18, abs=1e-3
    )
    for code, gamma in ((4, 2.2), (5, 2.8)):
        found = encoded_picture(FilePicture(pixels=np.full((1, 1), 0.5), colour=h273_colour(1, code)), "auto").pixels
        assert found == pytest.approx(0.5**gamma)
    found = encoded_picture(FilePicture(pixels=np.full((1, 1), 0.01), colour=h273_colour(1, 7)), "auto").pixels
    assert found == pytest.approx(0.0025)


# -- scenes ----------------------------------------------------------------------------------------------------------------------

GREEN = np.zeros((4, 4, 3), np.uint8) + np.array([0, 255, 0], np.uint8)


def scene_of(picture, **options):
    return fs.Scene.from_picture(picture, **{"distance_m": 1.0, "illuminance_lux": 500.0, **options})


def test_colours_outside_srgb_are_clipped_in_bands(tmp_path):
    path = written(tmp_path, encoded(GREEN, "PNG", icc_profile=P3_PROFILE))
    wide = srgb_of([0.0, 1.0, 0.0], P3_XY)
    assert wide[0] < -0.2
    assert wide[1] > 1.0
    assert scene_of(path).basis[:, 0, 0] == pytest.approx(np.maximum(wide, 0.0), abs=2e-4)


def test_luminance_outside_srgb_is_kept_in_grey(tmp_path):
    path = written(tmp_path, encoded(GREEN, "PNG", icc_profile=P3_PROFILE))
    luminance = primaries.xyz_of_primaries(P3_XY)[1, 1]
    grey = scene_of(path, wavelength_nm=[550], band_width_nm=10)
    assert grey.basis == pytest.approx(luminance, abs=3e-4)


@pytest.mark.usefixtures("no_sandbox")
def test_negative_colours_of_exr_are_outside_srgb(tmp_path):
    picture = LINEAR_PATCH.copy()
    picture[..., 2] = -0.1
    assert scene_of(exr_with(tmp_path, {"RGB": picture})).basis[:, 0, 0].tolist() == [0.5, 0.25, 0.0]
    with pytest.raises(FoveasimError, match="must be finite and >= 0"):
        scene_of(exr_with(tmp_path, {"Y": picture[..., 2].copy()}))


@pytest.mark.usefixtures("no_sandbox")
def test_all_users_of_pictures_agree(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    paths = [exr_with(folder), written(folder, encoded(PATCH8, "PNG", icc_profile=P3_PROFILE), "q.png")]
    for path, n_pixels in zip(paths, ((4, 6), (4, 6)), strict=True):
        expected = scene_of(path)
        frame = next(iter(fs.video.FrameSource([path], distance_m=1.0, illuminance_lux=500.0)))
        assert np.array_equal(frame.basis, expected.basis)
        templated = next(iter(fs.video.FrameSource([path], template=expected)))
        assert np.array_equal(templated.basis, expected.basis)
        compared = fs.compare.photograph_scenes(100.0, pictures=[path], wavelength_nm=(620.0, 550.0, 450.0))
        assert np.array_equal(next(iter(compared.values())).basis, expected.basis[..., 1:5])
        assert expected.basis.shape == (3, *n_pixels)
    shot = {
        "scene": {"kind": "picture", "picture": "", "fit": "cover", "distance_m": 1.0, "illuminance_lux": 500.0},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
        "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 8.0}},
        "exposure_s": 0.01,
    }
    listed = fs.explore.Dataset([str(path) for path in paths], shot)
    for k, path in enumerate(paths):
        assert np.array_equal(listed.shot(k).scene.basis, scene_of(path).basis)


def test_result_of_reading_is_passed_through():
    found = as_encoded(PATCH8)
    assert isinstance(found, EncodedPicture)
    assert as_encoded(found, "linear") is found
    assert np.array_equal(scene_of(found).basis, scene_of(PATCH8).basis)


def test_formats_of_pillow_have_lists():
    assert set(_pillow._OF_CONTENT) >= {"PNG", "BMP", "GIF", "TGA", "JPEG2000", "AVIF"}
