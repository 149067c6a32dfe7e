"""Corrupt video files: frames or FileErrors."""

from __future__ import annotations

import random
from fractions import Fraction

import numpy as np
import pytest

from foveasim.errors import FileError
from foveasim.video import FrameSource

av = pytest.importorskip("av")
SCENE = {"pitch_um": 1.0, "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 1.0}


def write_film(path, codec):
    with av.open(str(path), mode="w") as container:
        container.metadata["title"] = "a title"
        stream = container.add_stream(codec, rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        for k in range(3):
            picture = np.random.default_rng(k).integers(0, 255, (32, 48, 3), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path.read_bytes()


def flipped(content, seed):
    """Return the content with some bits flipped; every tenth is also truncated."""
    draw = random.Random(seed)
    bad = bytearray(content if seed % 10 else content[: draw.randrange(1, len(content))])
    for _ in range(draw.choice((1, 1, 2, 5, 40))):
        bad[draw.randrange(len(bad))] ^= 1 << draw.randrange(8)
    return bytes(bad)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "libx264"), ("a.mkv", "ffv1")])
def test_flipped_bits_give_frames_or_file_errors(tmp_path, name, codec):
    content = write_film(tmp_path / name, codec)
    bad = tmp_path / f"bad{name}"
    n_read, messages = 0, set()
    for seed in range(200):
        bad.write_bytes(flipped(content, seed))
        try:
            footage = FrameSource(bad, **SCENE)
            n_read += sum(scene.basis.size > 0 for scene in footage)
            assert footage.frame_s is None or footage.frame_s > 0.0
        except FileError as error:
            messages.add(str(error).removeprefix(f"{bad}: "))

    assert n_read > 0
    assert messages
    assert all(len(message) < 300 and message.isprintable() for message in messages)


def test_non_utf8_metadata_are_ignored(tmp_path):
    content = write_film(tmp_path / "a.mp4", "libx264")
    bad = content.replace(b"a title", b"\xe1 t\xff\xfeit")
    assert bad != content
    (tmp_path / "bad.mp4").write_bytes(bad)
    expected = [scene.basis for scene in FrameSource(tmp_path / "a.mp4", **SCENE)]
    found = [scene.basis for scene in FrameSource(tmp_path / "bad.mp4", **SCENE)]

    assert len(found) == 3
    np.testing.assert_array_equal(found, expected)
