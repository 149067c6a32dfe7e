"""Animated WebP files, whose frames Pillow decodes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim._io.images import check_picture_size
from foveasim._io.images._pillow import picture_of_image
from foveasim.errors import FileError

#: Shortest time of a frame that browsers show, and the time that they use for shorter ones, in s.
MIN_FRAME_S, DEFAULT_FRAME_S = 0.011, 0.1
#: Largest size of a file whose chunks are searched, in bytes.
MAX_FILE_BYTES = 1 << 31


def is_webp(path: Path) -> bool:
    """Return whether a file is a WebP picture or animation."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:  # reported by the reader of other videos
        return False
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


class WebPFrame(NamedTuple):
    """Pixels of a frame, upright, and its colour profile (ICC)."""

    pixels: NDArray[Any]
    profile: bytes | None


class WebPAnimation:
    """
    Frames of an animated WebP file, with their times; a single picture is one frame.

    Raises FileError when the file is corrupt or too large.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        durations_s = _durations_s(path)
        self.times_s: Floats = np.concatenate(([0.0], np.cumsum(durations_s)[:-1]))

    def __iter__(self) -> Iterator[WebPFrame]:
        from PIL import Image

        n_read = 0
        try:
            with Image.open(self.path, formats=("WEBP",)) as image:
                check_picture_size(self.path, image.width, image.height)
                n_frames = getattr(image, "n_frames", 1)
                for n_read in range(n_frames):
                    image.seek(n_read)
                    yield WebPFrame(picture_of_image(image).values(), image.info.get("icc_profile"))
        except FileError:
            raise
        except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on corrupt files
            reason = " ".join(str(error).split()) or type(error).__name__
            raise FileError(self.path, f"is corrupt after frame {n_read} ({reason:.160})") from None
        if n_frames != self.times_s.size:
            raise FileError(self.path, f"contains {n_frames} frames, but {self.times_s.size} durations")


def _durations_s(path: Path) -> Floats:
    """Return the durations of the frames, from the chunks ANMF, without decoding."""
    n_bytes = path.stat().st_size
    found = []
    with path.open("rb") as file:
        offset = 12
        while offset + 8 <= n_bytes:
            file.seek(offset)
            name, size = struct.unpack("<4sI", file.read(8))
            if name == b"ANMF":
                head = file.read(16)
                if len(head) < 16:
                    raise FileError(path, "is corrupt or truncated")
                found.append(int.from_bytes(head[12:15], "little") / 1000.0)
            offset += 8 + size + size % 2
    durations_s = np.array(found or [0.0])
    return np.where(durations_s < MIN_FRAME_S, DEFAULT_FRAME_S, durations_s)
