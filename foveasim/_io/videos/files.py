"""
Video files: frames by PyAV, in this process or in the sandbox process.

Understood: time stamps, edit lists, the display matrix, colour range, matrix, transfer and primaries, depth, alpha. Irrelevant
for pictures, and not read: sound, subtitles, chapters, titles, cover art, mastering and light levels, film grain parameters.
What would change the values otherwise is named in an error.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats
from foveasim._io.images import check_picture_size
from foveasim._io.sandbox import iterate_in_sandbox, read_in_sandbox
from foveasim._io.videos.colours import UNSPECIFIED, Colour, check_profile
from foveasim._io.videos.pixels import check_frame, pixels_of_frame, turned
from foveasim._io.videos.webp import WebPAnimation, WebPFrame, is_webp
from foveasim.errors import FileError, printable

KIND = "a video"
#: Limit of the memory of the sandbox process: threads of the decoder and its reference frames.
MAX_BYTES = 2**32
#: Containers without display times, whose decode times in ascending order are the display times.
DECODE_TIMES = ("avi",)
#: Range of the errors of rounded time stamps, in units of their resolution.
ROUNDED_TICKS = 1.0 - 1e-6
#: Codecs of PNG pictures.
PNG_CODECS = ("apng", "png")
#: Bit of the first byte of a VP8 frame that is shown.
VP8_SHOWN = 0x10


class Decoded(NamedTuple):
    """A decoded frame of PyAV, with transfer and primaries of its colours and other data."""

    frame: Any
    colour: Colour
    data: Mapping[str, bytes]


class VideoFile:
    """
    Decoded frames of a video file, before conversion to pixels.

    ``n_frames``: number of frames according to the file, which may be wrong. Raises FileError when the file is not a readable
    video, or the extra ``video`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._animation = WebPAnimation(path) if is_webp(path) else None
        if self._animation is not None:
            self.n_frames: int | None = self._animation.times_s.size
            return
        with _open_video(path) as container, _as_video_error(path, "is corrupt"):
            stream = _video_stream(path, container)
            self.n_frames = int(stream.frames) if stream.frames > 0 else None

    def __iter__(self) -> Iterator[Any]:
        if self._animation is not None:
            yield from self._animation
            return
        n_read = 0
        with _open_video(self.path) as container:
            with _as_video_error(self.path, "is corrupt"):
                stream = _video_stream(self.path, container)
                stream.thread_type = "AUTO"
                frames, codec = iter(container.decode(stream)), stream.codec_context
            while True:
                with _as_video_error(self.path, f"is corrupt after frame {n_read}"):
                    frame = next(frames, None)
                if frame is None:
                    break
                self._check_time(n_read, frame)
                transfer, primaries = (
                    int(getattr(frame, name, getattr(codec, name))) for name in ("color_trc", "color_primaries")
                )
                with _as_video_error(self.path, "has unknown data in its frames"):
                    data = self._data_of(frame, codec.name)
                yield Decoded(frame, Colour(self.path, transfer, primaries), data)
                n_read += 1
        if n_read == 0:
            raise FileError(self.path, "contains no frames")
        if "times_s" in self.__dict__ and n_read != self.times_s.size:
            raise FileError(
                self.path, f"contains {n_read} frames, but {self.times_s.size} time stamps; encode it again"
            )

    def pixels(self, start: int = 0, *, is_encoded: bool = True) -> Iterator[NDArray[Any]]:
        """
        Iterate over the pixels of frames, as :func:`frame_pixels` returns them.

        ``start``: first frame; earlier ones are decoded but not converted.
        """
        return (frame_pixels(self.path, frame, is_encoded=is_encoded) for frame in islice(self, start, None))

    @cached_property
    def times_s(self) -> Floats:
        """
        Display times of the frames after the first one, (n_frame,) s.

        They are read from the packets of the file, which are not decoded. Time stamps that a constant rate explains to their
        resolution are those of this rate. Raises FileError when frames have no or equal time stamps, or the file is corrupt.
        """
        if self._animation is not None:
            return self._animation.times_s
        with _open_video(self.path) as container, _as_video_error(self.path, "is corrupt"):
            stream = _video_stream(self.path, container)
            packets = [
                (packet.pts, packet.dts)
                for packet in container.demux(stream)
                if packet.size > 0 and not packet.is_discard and not _is_hidden(stream, packet)
            ]
            tick_s, is_avi = float(stream.time_base), container.format.name in DECODE_TIMES
            rates = [float(rate) for rate in (stream.average_rate, stream.base_rate) if rate and rate > 0]
        shown, decoded = zip(*packets, strict=True) if packets else ((), ())
        ticks = _ascending(shown)
        self._ticks = ticks  # compared with those of the frames
        if ticks is None and is_avi:
            ticks = _ascending(decoded)
        if not packets:
            raise FileError(self.path, "contains no frames")
        if ticks is None:
            problem = "without time stamps" if any(t is None for t in shown) else "with equal time stamps"
            raise FileError(
                self.path,
                f"has frames {problem}; specify the frame period, or convert it to a format with time stamps (.mp4)",
            )
        times_s = tick_s * (ticks - ticks[0])
        count = np.arange(ticks.size)
        for rate in rates:
            if np.ptp(times_s - count / rate) < ROUNDED_TICKS * tick_s:
                return np.asarray(count * (1.0 / rate))
        return np.asarray(times_s)

    def _data_of(self, frame: Any, codec: str) -> Mapping[str, bytes]:
        """Return data of a frame by their names in FFmpeg, such as the display matrix."""
        if codec in PNG_CODECS:  # PyAV 18 frees the metadata of colour profiles of PNG twice
            return {} if self._png_profile is None else {"ICC_PROFILE": self._png_profile}
        return {str(each.type).rpartition(".")[2]: bytes(each) for each in frame.side_data}

    @cached_property
    def _png_profile(self) -> bytes | None:
        """Colour profile (ICC) of an animated PNG file, None without it."""
        from PIL import Image

        try:
            with Image.open(self.path, formats=("PNG",)) as image:
                return image.info.get("icc_profile")
        except Exception:  # noqa: BLE001 -- PNG pictures in another container
            return None

    def _check_time(self, number: int, frame: Any) -> None:
        """Check that a decoded frame has the time stamp of its packet, if these have been read."""
        if "times_s" not in self.__dict__ or self._ticks is None:
            return
        if number >= self._ticks.size or frame.pts != self._ticks[number]:
            raise FileError(self.path, f"has another time stamp in frame {number} than in its packet; encode it again")


def frame_pixels(path: Path, decoded: Decoded | WebPFrame, *, is_encoded: bool = True) -> NDArray[Any]:
    """
    Return the pixels of a decoded frame: upright, top row first.

    ``is_encoded``: whether transfer and primaries of the file are converted to those of sRGB; otherwise they are ignored.
    Returns ``pixels`` (n_y, n_x) or (n_y, n_x, n_channel) uint8, or uint16 for more than 8 bits or after a conversion. The size
    is checked before memory is allocated, because corrupt files may claim any size. Raises FileError when the frame is corrupt,
    too large, or has a property that is not supported.
    """
    if isinstance(decoded, WebPFrame):
        if is_encoded:
            check_profile(path, decoded.profile)
        return decoded.pixels
    frame, colour, data = decoded
    check_picture_size(path, frame.width, frame.height)
    check_frame(path, frame, data)
    with _as_video_error(path, "is corrupt"):
        pixels = pixels_of_frame(path, frame)
        if is_encoded:
            check_profile(path, data.get("ICC_PROFILE"))
            if colour.transfer == UNSPECIFIED and "DOVI_METADATA" in data:
                raise FileError(
                    path, "is in Dolby Vision without another transfer; convert it, or specify the encoding"
                )
            pixels = colour.to_srgb(pixels)
        return turned(path, pixels, data.get("DISPLAYMATRIX"))


def _ascending(ticks: Any) -> NDArray[np.int64] | None:
    """Return time stamps in ascending order; None if there are missing or equal ones."""
    if any(tick is None for tick in ticks):
        return None
    ordered = np.sort(np.asarray(ticks, np.int64))
    return None if np.any(np.diff(ordered) <= 0) else ordered


def _is_hidden(stream: Any, packet: Any) -> bool:
    """Return whether the frame of a packet is only a reference of others."""
    return stream.codec_context.name in ("vp8", "libvpx") and not bytes(packet)[0] & VP8_SHOWN


def _open_video(path: Path) -> Any:
    av = import_optional(path, "av")
    with _as_video_error(path, "is not a readable video file"):
        # Metadata such as titles are not used and may be corrupt.
        return av.open(str(path), metadata_errors="replace")


def _video_stream(path: Path, container: Any) -> Any:
    """Return the only video stream, besides cover art."""
    streams = [stream for stream in container.streams.video if not _is_cover(stream)]
    if not streams:
        raise FileError(path, "contains no video stream")
    if len(streams) > 1:
        raise FileError(
            path, f"contains {len(streams)} videos; extract one of them, for example with: ffmpeg -map 0:v:0 -c copy"
        )
    if streams[0].codec_context is None:  # some versions of PyAV crash on decoding
        raise FileError(path, "has a video stream with an unsupported codec")
    aspect = streams[0].sample_aspect_ratio
    if aspect and aspect != 1:
        raise FileError(
            path,
            f"has pixels of the aspect ratio {aspect.numerator}:{aspect.denominator}; scale it to square ones, for example "
            "with: ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 OUT",
        )
    if streams[0].metadata.get("alpha_mode") == "1":
        raise FileError(
            path, "has alpha in a second stream of VP8 or VP9, which is not read; convert it to another codec"
        )
    return streams[0]


def _is_cover(stream: Any) -> bool:
    """Return whether a stream is a picture that belongs to the file."""
    return bool(stream.disposition.value & type(stream.disposition).attached_pic.value)


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
    Untrusted video file, read in the sandbox process: as :class:`VideoFile`.

    Raises FileError when the file is not a readable video, exceeds a limit, or has frames without time stamps.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _, (self.times_s,) = read_in_sandbox(
            _describe, path, kind=KIND, max_decompressed_bytes=lambda _: 0
        )  # decodes none
        self.n_frames = self.times_s.size

    def pixels(self, start: int = 0) -> Iterator[NDArray[Any]]:
        """
        Iterate over the pixels of frames, as :meth:`VideoFile.pixels`.

        Raises FileError when a frame is corrupt or too large, or takes too long.
        """
        return iterate_in_sandbox(_decode, self.path, {"start": start}, kind=KIND, max_bytes=MAX_BYTES)


def _describe(path: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Return the times of the frames, in the sandbox process."""
    return {}, [VideoFile(Path(path)).times_s]


def _decode(path: str, start: int) -> Iterator[NDArray[Any] | None]:
    """Yield the pixels of frames from the first one, and None for each before."""
    video = VideoFile(Path(path))
    for number, frame in enumerate(video):
        yield None if number < start else np.ascontiguousarray(frame_pixels(video.path, frame))
