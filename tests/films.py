"""Video files for tests."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest


def random_pictures(n, width, height):
    """Return pictures of random colours, each from its number as the seed."""
    return [np.random.default_rng(k).integers(0, 255, (height, width, 3), dtype=np.uint8) for k in range(n)]


def write_film(
    path, pictures, *, rate=25, codec="ffv1", pixels="bgr0", title=None, times_s=None, tick_s=Fraction(1, 1000), start=0
):
    """
    Write pictures (height, width, 3) to a video file, by default without losses, and return its path.

    ``times_s``: times of the pictures instead of the rate, in multiples of ``tick_s`` after the tick ``start``.
    """
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        if title is not None:
            container.metadata["title"] = title
        stream = container.add_stream(codec, rate=Fraction(rate))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels
        if times_s is not None:
            stream.codec_context.time_base = tick_s
        for k, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pixels)
            if times_s is not None:
                frame.pts, frame.time_base = start + round(times_s[k] / tick_s), tick_s
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
