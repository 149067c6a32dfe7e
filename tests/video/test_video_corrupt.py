"""Corrupt video files: frames or FileErrors."""

from __future__ import annotations

import random

import numpy as np
import pytest
from films import random_pictures, write_film

from foveasim.errors import FileError
from foveasim.video import FrameSource

SCENE = {"pitch_um": 1.0, "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 1.0}


def film(path, codec):
    return write_film(path, random_pictures(3, 48, 32), codec=codec, pixels="yuv420p", title="a title").read_bytes()


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
    content = film(tmp_path / name, codec)
    bad = tmp_path / f"bad{name}"
    n_read, messages = 0, set()
    for seed in range(200):
        bad.write_bytes(flipped(content, seed))
        try:
            footage = FrameSource(bad, **SCENE)
            n_read += sum(scene.basis.size > 0 for scene in footage)
            assert footage.frame_s is None or footage.frame_s > 0.0
            assert np.all(np.diff(footage.times_s) > 0.0)
        except FileError as error:
            messages.add(str(error).removeprefix(f"{bad}: "))

    assert n_read > 0
    assert messages
    assert all(len(message) < 300 and message.isprintable() for message in messages)


def test_non_utf8_metadata_are_ignored(tmp_path):
    content = film(tmp_path / "a.mp4", "libx264")
    bad = content.replace(b"a title", b"\xe1 t\xff\xfeit")
    assert bad != content
    (tmp_path / "bad.mp4").write_bytes(bad)
    expected = [scene.basis for scene in FrameSource(tmp_path / "a.mp4", **SCENE)]
    found = [scene.basis for scene in FrameSource(tmp_path / "bad.mp4", **SCENE)]

    assert len(found) == 3
    np.testing.assert_array_equal(found, expected)
