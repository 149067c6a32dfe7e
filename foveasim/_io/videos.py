"""Video files: frames by PyAV, in this process or in the sandbox process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.images import check_picture_size
from foveasim._io.sandbox import iterate_in_sandbox, read_in_sandbox
from foveasim.errors import FileError, printable

KIND = "a video"
#: Limit of the memory of the sandbox process: threads of the decoder and its reference frames.
MAX_BYTES = 2**32


class VideoFile:
    """
    Decoded frames of a video file, before conversion to pixels.

    ``frame_s`` (float or None, s): frame period. ``n_frames``: number of frames according to the file, which may be wrong.
    Raises FileError when the file is not a readable video, or the extra ``video`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _open_video(path) as container, _as_video_error(path, "is corrupt"):
            stream = container.streams.video[0]
            rate = stream.average_rate or stream.base_rate
            self.frame_s = float(1 / rate) if rate and rate > 0 else None
            self.n_frames: int | None = int(stream.frames) if stream.frames > 0 else None

    def __iter__(self) -> Iterator[Any]:
        with _open_video(self.path) as container:
            n_read = 0
            with _as_video_error(self.path, "is corrupt"):
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                frames = iter(container.decode(stream))
            while True:
                with _as_video_error(self.path, f"is corrupt after frame {n_read}"):
                    frame = next(frames, None)
                if frame is None:
                    break
                yield frame
                n_read += 1
            if n_read == 0:
                raise FileError(self.path, "contains no frames")

    def pixels(self, start: int = 0) -> Iterator[NDArray[np.uint8]]:
        """
        Iterate over the pixels of frames, (n_y, n_x, 3) uint8, top row first.

        ``start``: first frame; earlier ones are decoded but not converted. Raises FileError when a frame is corrupt or too
        large.
        """
        return (frame_pixels(self.path, frame) for frame in islice(self, start, None))

    def count_frames(self) -> int:
        """
        Return the number of encoded frames, without decoding them.

        Raises FileError when the file is corrupt.
        """
        with _open_video(self.path) as container, _as_video_error(self.path, "is corrupt"):
            return sum(packet.size > 0 for packet in container.demux(container.streams.video[0]))


def frame_pixels(path: Path, frame: Any) -> NDArray[np.uint8]:
    """
    Return the pixels of a decoded frame, (n_y, n_x, 3) uint8, top row first.

    The size is checked before memory is allocated, because corrupt files may claim any size.
    """
    check_picture_size(path, frame.width, frame.height)
    with _as_video_error(path, "is corrupt"):
        return np.asarray(frame.to_ndarray(format="rgb24"))


def _open_video(path: Path) -> Any:
    av = import_optional(path, "av")
    with _as_video_error(path, "is not a readable video file"):
        # Metadata such as titles are not used and may be corrupt.
        container = av.open(str(path), metadata_errors="replace")
    if not container.streams.video:
        container.close()
        raise FileError(path, "contains no video stream")
    if container.streams.video[0].codec_context is None:  # some versions of PyAV crash on decoding
        container.close()
        raise FileError(path, "has a video stream with an unsupported codec")
    return container


@contextmanager
def _as_video_error(path: Path, problem: str) -> Iterator[None]:
    """Convert exceptions of the video library, which may be of any type, to FileErrors."""
    try:
        yield
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise FileError(path, f"{problem} ({printable(reason):.160})") from None


class SandboxedVideo:
    """
    Video file of unknown origin, read in the sandbox process: as :class:`VideoFile`.

    The number of frames is that of the encoded ones.

    Raises FileError when the file is not a readable video, or exceeds a limit.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        about, _ = read_in_sandbox(_describe, path, kind=KIND, max_decompressed_bytes=lambda _: 0)  # decodes no frames
        self.frame_s: float | None = about["frame_s"]
        self.n_frames: int = about["n_frames"]

    def pixels(self, start: int = 0) -> Iterator[NDArray[np.uint8]]:
        """
        Iterate over the pixels of frames, as :meth:`VideoFile.pixels`.

        Raises FileError when a frame is corrupt or too large, or takes too long.
        """
        return iterate_in_sandbox(_decode, self.path, {"start": start}, kind=KIND, max_bytes=MAX_BYTES)


def _describe(path: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Return the frame period and the number of frames, in the sandbox process."""
    video = VideoFile(Path(path))
    return {"frame_s": video.frame_s, "n_frames": video.count_frames()}, []


def _decode(path: str, start: int) -> Iterator[NDArray[np.uint8] | None]:
    """Yield the pixels of frames from the first one, and None for each before."""
    video = VideoFile(Path(path))
    for number, frame in enumerate(video):
        yield None if number < start else frame_pixels(video.path, frame)
