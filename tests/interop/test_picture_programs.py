"""Pictures of other programs: light as they mean it."""

from __future__ import annotations

import os

import numpy as np
import pytest
from other_programs import other_program

from foveasim._io.images import as_encoded

cv2 = other_program("cv2")
io = other_program("skimage.io")
os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")

LIGHT = np.random.default_rng(4).random((12, 20, 3)).astype(np.float32)
CODES = np.random.default_rng(5).integers(0, 256, (12, 20, 3)).astype(np.uint8)


@pytest.mark.parametrize(("name", "tolerance"), [("p.hdr", 0.01), ("p.exr", 0.0), ("p.tif", 0.0), ("p.pfm", 0.0)])
def test_linear_files_of_opencv_are_linear(tmp_path, name, tolerance):
    grey = name == "p.pfm"  # Pillow reads grey only
    picture = LIGHT[..., 0].copy() if grey else LIGHT[..., ::-1].copy()
    try:
        is_written = cv2.imwrite(str(tmp_path / name), picture)
    except cv2.error:
        is_written = False
    if not is_written:
        pytest.skip("this build of OpenCV cannot write the format")
    found = as_encoded(tmp_path / name)
    assert found.encoding == "linear"
    # Radiance: 8-bit mantissas, of which OpenCV truncates the rest.
    assert found.pixels == pytest.approx(LIGHT[..., 0] if grey else LIGHT, abs=tolerance)


def test_exposure_of_radiance_differs_from_opencv(tmp_path):
    cv2.imwrite(str(tmp_path / "p.hdr"), LIGHT[..., ::-1].copy())
    content = (tmp_path / "p.hdr").read_bytes()
    at = content.index(b"\n") + 1
    (tmp_path / "q.hdr").write_bytes(content[:at] + b"EXPOSURE=4\n" + content[at:])
    stored = cv2.imread(str(tmp_path / "q.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    # OpenCV returns the stored values; by the manual of Radiance the light is these divided by EXPOSURE.
    assert stored == pytest.approx(as_encoded(tmp_path / "p.hdr").pixels)
    assert as_encoded(tmp_path / "q.hdr").pixels == pytest.approx(stored / 4.0)


@pytest.mark.parametrize("name", ["p.png", "p.tif", "p.bmp", "p.webp"])
def test_integers_of_other_programs_are_srgb(tmp_path, name):
    cv2.imwrite(str(tmp_path / name), CODES[..., ::-1].copy(), [cv2.IMWRITE_WEBP_QUALITY, 101])
    found = as_encoded(tmp_path / name)
    assert (found.encoding, found.pixels.tolist()) == ("srgb", CODES.tolist())
    if name == "p.webp":
        return  # lossy by default
    io.imsave(tmp_path / f"i{name}", CODES, check_contrast=False)
    found = as_encoded(tmp_path / f"i{name}")
    assert (found.encoding, found.pixels.tolist()) == ("srgb", CODES.tolist())


def test_deep_files_of_other_programs_are_exact(tmp_path):
    deep = CODES.astype(np.uint16) * np.uint16(257)
    for name in ("p.png", "p.tif"):
        cv2.imwrite(str(tmp_path / name), deep[..., ::-1].copy())
        assert np.array_equal(as_encoded(tmp_path / name).pixels, deep)
