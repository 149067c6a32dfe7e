"""Images of Pillow and arrays of OpenCV give the scene of their file."""

from __future__ import annotations

import numpy as np
import pytest
import skimage.data
from PIL import Image

import foveasim as fs
from foveasim.errors import FoveasimError, ParameterError

PHOTOGRAPH = Image.fromarray(skimage.data.astronaut()[:60:2, :80:2])
LIGHT = {"distance_m": 1.0, "luminance_cd_m2": 100.0}


def scene_of(picture, **options):
    return fs.Scene.from_picture(picture, **LIGHT | options)


@pytest.mark.parametrize(
    ("mode", "extension"),
    [
        ("1", "png"),
        ("L", "png"),
        ("LA", "png"),
        ("P", "png"),
        ("RGB", "png"),
        ("RGBA", "png"),
        ("I;16", "png"),
    ],
)
def test_image_gives_the_scene_of_its_file(tmp_path, mode, extension):
    image = PHOTOGRAPH.convert("I").convert(mode) if mode == "I;16" else PHOTOGRAPH.convert(mode)
    path = tmp_path / f"photo.{extension}"
    image.save(path)
    with Image.open(path) as opened:
        scene, expected = scene_of(opened), scene_of(path)

    assert np.array_equal(scene.basis, expected.basis)
    if extension == "png":
        assert np.array_equal(scene_of(image).basis, expected.basis)


@pytest.mark.parametrize("mode", ["HSV", "YCbCr"])
def test_colour_spaces_are_converted(mode):
    image = PHOTOGRAPH.convert(mode)

    assert np.array_equal(scene_of(image).basis, scene_of(np.asarray(image.convert("RGB"))).basis)


def test_inks_without_profile_need_an_encoding(tmp_path):
    image = PHOTOGRAPH.convert("CMYK")
    image.save(tmp_path / "photo.tif")
    expected = scene_of(np.asarray(image.convert("RGB"))).basis

    for picture in (image, tmp_path / "photo.tif"):
        assert np.array_equal(scene_of(picture, encoding="srgb").basis, expected)
        with pytest.raises(
            FoveasimError, match=r"has CMYK without a colour profile, .*; to read its values without it, "
        ):
            scene_of(picture)


@pytest.mark.parametrize(("orientation", "turn"), [(1, 0), (3, 2), (6, -1), (8, 1)])
def test_orientation_tag_is_applied(tmp_path, orientation, turn):
    exif = Image.Exif()
    exif[0x0112] = orientation
    PHOTOGRAPH.save(tmp_path / "photo.png", exif=exif)
    with Image.open(tmp_path / "photo.png") as image:
        scene = scene_of(image)

    assert np.array_equal(scene.basis, scene_of(np.rot90(np.asarray(PHOTOGRAPH), turn)).basis)


@pytest.mark.parametrize("n_channels", [3, 4])
def test_opencv_channels_are_reversed(tmp_path, n_channels):
    cv2 = pytest.importorskip("cv2")
    PHOTOGRAPH.convert("RGBA" if n_channels == 4 else "RGB").save(tmp_path / "photo.png")
    pixels = cv2.imread(str(tmp_path / "photo.png"), cv2.IMREAD_UNCHANGED)

    assert pixels.shape[2] == n_channels
    assert np.array_equal(scene_of(pixels, channels="bgr").basis, scene_of(tmp_path / "photo.png").basis)


def test_missing_array_gives_one_line():
    with pytest.raises(
        ParameterError, match=r"'picture' must be a file, an image or an array, got None; cv2\.imread ret"
    ):
        scene_of(None)


def test_files_have_their_own_order(tmp_path):
    PHOTOGRAPH.save(tmp_path / "photo.png")
    for picture in (tmp_path / "photo.png", PHOTOGRAPH):
        with pytest.raises(ParameterError, match="'channels' must be 'rgb' for files and images of Pillow, got 'bgr'"):
            scene_of(picture, channels="bgr")
