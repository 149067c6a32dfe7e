"""Pictures of phones and cameras: AVIF, HEIC and raw files are upright, with the values of the scene; corrupt ones are rejected."""

from __future__ import annotations

import io
import sys

import numpy as np
import pillow_heif
import pytest
import tifffile
from PIL import Image, ImageOps

import foveasim as fs
from foveasim._io.images import ORIENTATION_TAG, _reading, picture_names, read_picture
from foveasim.errors import FileError
from foveasim.units import decode_srgb

#: A picture without symmetry, in flat areas, which lossy formats preserve.
FLAT = np.zeros((96, 128, 3), np.uint8)
FLAT[:32, :64], FLAT[32:64, 64:], FLAT[64:, :32] = (200, 40, 30), (30, 180, 60), (240, 240, 250)
#: XYZ to linear sRGB of the same white (IEC 61966-2-1), as the camera's own colours.
XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


def with_orientation(orientation):
    exif = Image.Exif()
    exif[ORIENTATION_TAG] = orientation
    return {"exif": exif.tobytes()} if orientation != 1 else {}


def heic(pixels, **options):
    file = io.BytesIO()
    if pixels.dtype == np.uint8:
        made = pillow_heif.from_pillow(Image.fromarray(pixels))
    else:
        made = pillow_heif.from_bytes("RGB;16", pixels.shape[1::-1], pixels.tobytes())
    made.save(file, quality=95, chroma=444, **options)
    return file.getvalue()


def avif(pixels, **options):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "AVIF", quality=95, subsampling="4:4:4", **options)
    return file.getvalue()


def dng(light, *, orientation=1, neutral=(1.0, 1.0, 1.0)):
    """Return a raw file of linear colours (n_y, n_x, 3), relative to saturation, whose camera has the primaries of sRGB."""
    mosaic = np.empty(light.shape[:2])
    for y, x, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[y::2, x::2] = light[y::2, x::2, channel] * neutral[channel]
    rational = [part for number in XYZ_TO_SRGB.ravel() for part in (round(1e4 * number), 10_000)]
    tags = [
        (ORIENTATION_TAG, "H", 1, orientation, True),
        (271, "s", 0, "Test", True),
        (272, "s", 0, "Camera", True),
        (33421, "H", 2, (2, 2), True),  # repeating block of the mosaic
        (33422, "B", 4, bytes([0, 1, 1, 2]), True),  # red, green, green, blue
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),  # version of DNG
        (50717, "H", 1, 65_535, True),  # saturation
        (50721, "2i", 9, rational, True),
        (50728, "2I", 3, [part for number in neutral for part in (round(1000 * number), 1000)], True),
        (50778, "H", 1, 21, True),  # calibrated at D65
    ]
    file = io.BytesIO()
    pixels = np.rint(65_535.0 * mosaic).astype(np.uint16)
    tifffile.imwrite(file, pixels, photometric=32803, extratags=tags, metadata=None)
    return file.getvalue()


@pytest.mark.slow(keep=6)
@pytest.mark.parametrize(("suffix", "encode"), [(".heic", heic), (".avif", avif)])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_picture_of_a_phone_is_upright(tmp_path, suffix, encode, orientation):
    path = tmp_path / f"photo{suffix}"
    path.write_bytes(encode(FLAT, **with_orientation(orientation)))
    image = Image.fromarray(FLAT)
    image.getexif()[ORIENTATION_TAG] = orientation
    expected = np.asarray(ImageOps.exif_transpose(image), np.int64)

    found = read_picture(path)
    assert (found.dtype, found.shape) == (np.uint8, expected.shape)
    assert np.percentile(np.abs(found - expected), 98) <= 4


def test_heic_is_detected_by_content(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(heic(FLAT))

    assert read_picture(tmp_path / "photo.jpg").shape == FLAT.shape


def test_ten_bits_fill_the_range(tmp_path):
    """Levels of 10 bits in 16: the largest is 65,535."""
    levels = np.repeat(np.linspace(0, 65_535, 8).round().astype(np.uint16), 16)
    (tmp_path / "photo.heic").write_bytes(heic(np.broadcast_to(levels[:, np.newaxis], (64, 128, 3)).copy()))

    found = read_picture(tmp_path / "photo.heic")
    assert found.dtype == np.uint16
    assert found.max() == 65_535
    np.testing.assert_allclose(np.median(found, axis=(0, 2))[8::16], levels[8::16], atol=2 * 64)


def test_raw_file_has_linear_values(tmp_path):
    """Greys and saturated colours, flat over several periods of the mosaic; decoding of sRGB gives the light."""
    light = np.zeros((64, 96, 3))
    colours = np.array([[0.02] * 3, [0.2] * 3, [0.8] * 3, [0.6, 0.1, 0.05], [0.05, 0.5, 0.1], [0.1, 0.1, 0.7]])
    for k, colour in enumerate(colours):
        light[:, 16 * k : 16 * k + 16] = colour
    (tmp_path / "photo.dng").write_bytes(dng(light))

    found = read_picture(tmp_path / "photo.dng")
    assert (found.dtype, found.shape) == (np.uint16, light.shape)
    np.testing.assert_allclose(decode_srgb(found[32, 8::16] / 65_535.0), colours, atol=2e-3)


def test_raw_file_has_white_balance_of_camera(tmp_path):
    """A neutral grey whose red and blue readings are lower."""
    light = np.full((48, 48, 3), 0.3)
    (tmp_path / "photo.dng").write_bytes(dng(light, neutral=(0.5, 1.0, 0.7)))

    found = decode_srgb(read_picture(tmp_path / "photo.dng")[24, 24] / 65_535.0)
    np.testing.assert_allclose(found / found[1], 1.0, atol=5e-3)


def test_raw_file_is_upright(tmp_path):
    light = np.full((48, 64, 3), 0.1)
    light[:16, :16] = 0.8
    (tmp_path / "photo.dng").write_bytes(dng(light, orientation=6))

    found = read_picture(tmp_path / "photo.dng")
    assert found.shape == (64, 48, 3)
    assert found[8, 40, 1] > 2 * found[8, 8, 1]


def test_raw_files_and_heic_become_scenes(tmp_path):
    (tmp_path / "a.dng").write_bytes(dng(np.full((48, 64, 3), 0.25)))
    (tmp_path / "b.heic").write_bytes(heic(FLAT))
    options = {
        "pitch_um": 100.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.01,
        "wavelength_nm": [620.0, 550.0, 450.0],
    }
    raw, phone = (fs.Scene.from_picture(tmp_path / name, band_width_nm=60.0, **options) for name in ("a.dng", "b.heic"))

    assert phone.basis.shape == (3, 96, 128)
    np.testing.assert_allclose(raw.basis[:, 24, 32], 0.25, atol=2e-3)
    assert picture_names(["a.dng", "b.heic", "c.NEF", "d.avif", "e.txt"]) == ["a.dng", "b.heic", "c.NEF", "d.avif"]


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.95])
@pytest.mark.parametrize(("name", "encode"), [("a.heic", lambda: heic(FLAT)), ("a.dng", lambda: dng(FLAT / 255.0))])
def test_truncated_file_gives_one_line(tmp_path, capfd, name, encode, fraction):
    content = encode()
    (tmp_path / name).write_bytes(content[: int(fraction * len(content))])

    with pytest.raises(FileError) as raised:
        read_picture(tmp_path / name)
    assert "\n" not in str(raised.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("name", "module"), [("a.heic", "pillow_heif"), ("a.dng", "rawpy")])
def test_missing_library_names_the_extra(tmp_path, monkeypatch, name, module):
    (tmp_path / name).write_bytes(heic(FLAT) if name == "a.heic" else dng(FLAT / 255.0))
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(_reading, "read_in_sandbox", lambda reader, path, **_: reader(str(path)))

    with pytest.raises(FileError, match=rf"needs {module}; install it with: pip install 'foveasim\[pictures\]'"):
        read_picture(tmp_path / name)


def test_avif_without_support_names_the_version(tmp_path, monkeypatch):
    (tmp_path / "a.avif").write_bytes(avif(FLAT))
    monkeypatch.delitem(Image.OPEN, "AVIF")

    with pytest.raises(FileError, match=r"needs Pillow 11.3 or later"):
        read_picture(tmp_path / "a.avif")
