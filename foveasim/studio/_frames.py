"""Frames of a video file or a camera: the current one is the picture of the scene."""

from __future__ import annotations

import copy
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io.images import write_picture
from foveasim._io.videos import SandboxedVideo
from foveasim.errors import FileError, ParameterError
from foveasim.studio._messages.models import CameraFrame, OpenVideo, ShowFrame, handles
from foveasim.studio._settings.changes import with_picture
from foveasim.video.frame_source import equal_step_s
from foveasim.video.writing import DEFAULT_FRAME_S

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Largest size of the decoded frames that are stored for steps back.
MAX_DECODED_BYTES = 64 << 20
#: Largest number of pixels of a camera frame: three bytes per pixel and a header are one message of a page.
MAX_CAMERA_PIXELS = (1 << 20) // 3 - 1024
#: Length of the digest in names of camera frames.
DIGEST_LENGTH = 8
#: Directory of the current frame, in the directory of uploaded files; settings cannot contain its files.
HIDDEN = ".frames"
#: Extensions of files that are a video or a single picture.
PICTURE_OR_VIDEO = (".gif", ".webp")


def camera_frame(message: bytes) -> CameraFrame:
    """
    Decode a camera frame.

    ``message``: length of the header as little-endian uint32; header in JSON with ``id``, ``width``, ``height`` and
    ``is_first``; pixels, RGB, uint8, top row first. Raises ParameterError when the message is invalid.
    """
    start = 4 + int.from_bytes(message[:4], "little")
    try:
        frame = CameraFrame.model_validate_json(message[4:start])
        if frame.width * frame.height > MAX_CAMERA_PIXELS:
            raise ValueError
        frame.pixels = np.frombuffer(message, np.uint8, offset=start).reshape(frame.height, frame.width, 3)
    except ValueError:
        raise ParameterError("frame", "must be a header and the pixels that it specifies") from None
    return frame


class Frames:
    """
    Current frame of a video file or a camera.

    The settings contain a fixed path, :attr:`path`. Its file is written when it is required; simulations read the current frame
    from another file, whose name differs for each frame.

    ``uploads``: directory of uploaded files. ``new_path``: returns an unused path there.
    """

    def __init__(self, uploads: Path, new_path: Callable[[str], Path]) -> None:
        self.path: Path | None = None
        self._lock = threading.Lock()  # frames are exported in other threads
        self._directory, self._new_path = uploads / HIDDEN, new_path
        self._video: SandboxedVideo | None = None
        self._step_s: float | None = None
        self._sent_s: list[float] | None = None
        self._name = ""
        self._n_frames = 0
        self._number = 0
        self._pixels: NDArray[Any] | None = None
        self._stored: Path | None = None
        self._n_stored = 0
        self._reader: Iterator[NDArray[Any]] | None = None
        self._next = 0
        self._decoded: OrderedDict[int, NDArray[Any]] = OrderedDict()

    # -- sources ----------------------------------------------------------------------------------------------------

    def open_video(self, path: Path) -> bool:
        """
        Open a video file at its first frame.

        Returns ``is_video``: False for a single frame, which is a picture. Raises FileError when the file is not a video, is
        corrupt, or the extra ``video`` is not installed.
        """
        video = SandboxedVideo(path)
        n_frames = video.n_frames
        if n_frames <= 1 and path.suffix.lower() in PICTURE_OR_VIDEO:
            return False
        reader = video.pixels()
        first = next(reader)
        self.close()
        self._video, self._name, self._n_frames = video, path.name, n_frames
        self._step_s = equal_step_s(video.times_s)
        self._reader, self._next = reader, 1
        self.path = self._new_path(f"{path.stem}.png")
        self._use(0, first)
        return True

    def receive(self, pixels: NDArray[Any], *, is_first: bool) -> bool:
        """Use a frame of the camera; return False for a late frame of a camera that is not in use."""
        if is_first:
            self.close()
            self._name, self.path = "camera", self._new_path("camera.png")
        elif self.path is None or self._video is not None:
            return False
        self._use(0 if is_first else self._number + 1, pixels)
        return True

    def show(self, number: int) -> None:
        """
        Decode a frame of the video.

        Raises FileError when the frame is corrupt. Raises ParameterError when there is no video, or it has no such frame.
        """
        if self._video is None:
            raise ParameterError("n", "must be the number of a frame of an open video")
        if not 0 <= number < self._n_frames:
            raise ParameterError("n", f"must be 0 to {self._n_frames - 1}")
        if number not in self._decoded:
            self._decode(number)
        self._decoded.move_to_end(number)
        self._use(number, self._decoded[number])

    def _decode(self, number: int) -> None:
        """Decode frames up to a number, from the last one or the beginning."""
        assert self._video is not None
        if self._reader is None or number < self._next:
            self._reader, self._next = self._video.pixels(number), number
        while self._next <= number:
            try:
                pixels = next(self._reader, None)
            except FileError:
                self._reader = None
                raise
            if pixels is None:
                self._reader, self._n_frames = None, max(1, self._next)
                raise FileError(self._video.path, f"ends after {self._n_frames} frames")
            self._decoded[self._next] = pixels
            self._next += 1
            while len(self._decoded) > 1 and sum(each.nbytes for each in self._decoded.values()) > MAX_DECODED_BYTES:
                self._decoded.popitem(last=False)

    def _use(self, number: int, pixels: NDArray[Any]) -> None:
        """Store the current frame for the next simulation."""
        if self._pixels is not None and pixels is self._pixels:
            return
        self._directory.mkdir(exist_ok=True)
        stored = self._directory / f"{self._n_stored}{self._write(self._directory / str(self._n_stored), pixels)}"
        self._remove_stored()
        self._n_stored += 1
        with self._lock:
            self._stored, self._number, self._pixels = stored, number, pixels

    @staticmethod
    def _write(stem: Path, pixels: NDArray[Any]) -> str:
        """Write pixels to a file without compression; return the extension of its format."""
        if pixels.dtype == np.uint8 and pixels.ndim == 3 and pixels.shape[2] == 3:
            height, width = pixels.shape[:2]
            stem.with_suffix(".ppm").write_bytes(
                b"P6 %d %d 255\n" % (width, height) + np.ascontiguousarray(pixels).tobytes()
            )
            return ".ppm"
        import tifffile

        n_channels = (pixels.shape[2:] or (1,))[0]
        tifffile.imwrite(
            stem.with_suffix(".tif"),
            pixels,
            photometric="rgb" if n_channels > 2 else "minisblack",
            planarconfig="contig" if n_channels > 1 else None,
            extrasamples=["unassalpha"] if n_channels in (2, 4) else None,
            metadata=None,
        )
        return ".tif"

    def _remove_stored(self) -> None:
        if self._stored is not None:
            self._stored.unlink(missing_ok=True)
            self._stored = None

    def close(self) -> None:
        """Close the source; its last frame remains available at its path."""
        if self.path is not None and self._pixels is not None:
            write_picture(self.path, self._pixels)
        self._remove_stored()
        self.stop()
        with self._lock:
            self.path = self._video = self._pixels = None
        self._decoded.clear()

    def stop(self) -> None:
        """End the process that decodes a video."""
        self._reader = None

    # -- the current frame ------------------------------------------------------------------------------------------

    def about(self, settings: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return a description of the source if it is the scene of settings, otherwise None."""
        if self._pixels is None or not self._is_used(settings):
            return None
        height, width = self._pixels.shape[:2]
        return {
            "kind": "camera" if self._video is None else "video",
            "name": self._name,
            "n": self._number,
            "n_frames": self._n_frames if self._video is not None else None,
            "frame_s": self.frame_s or None,
            "width": width,
            "height": height,
        }

    @property
    def time_s(self) -> float:
        """Time of the current frame of a video, as in :func:`foveasim.config.run_video`."""
        if self._video is None or self._number >= self._video.times_s.size:
            return 0.0
        return float(self._video.times_s[self._number])

    @property
    def frame_s(self) -> float:
        """Frame period of a video, the mean one for other times; 0 for a camera."""
        if self._video is None:
            return 0.0
        times_s = self._video.times_s
        return self._step_s or (float(times_s[-1]) / (times_s.size - 1) if times_s.size > 1 else DEFAULT_FRAME_S)

    def times_message(self) -> dict[str, Any] | None:
        """Return the times of frames at unequal steps, or None if the page has them."""
        is_irregular = self._video is not None and self._step_s is None and self._video.times_s.size > 1
        times_s = self._video.times_s.tolist() if self._video is not None and is_irregular else None
        if times_s == self._sent_s:
            return None
        self._sent_s = times_s
        return {"kind": "film_times", "times_s": times_s}

    def forget(self) -> None:
        """Send the message again."""
        self._sent_s = None

    def _is_used(self, settings: Mapping[str, Any]) -> bool:
        scene = settings.get("scene")
        return self.path is not None and isinstance(scene, Mapping) and scene.get("picture") == str(self.path)

    def with_current(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Return settings whose scene is the file of the current frame, or the same object."""
        if self._stored is None or not self._is_used(settings):
            return settings
        found = copy.copy(settings)
        found["scene"] = {**settings["scene"], "picture": str(self._stored)}
        return found

    @property
    def stored_name(self) -> str | None:
        """Path of the current frame in the settings of simulations."""
        return None if self._stored is None else str(self._stored)

    def export(self, settings: Mapping[str, Any]) -> dict[str, Path]:
        """
        Write the current frame to a file with its own name, if it is the scene of settings.

        Returns ``files``: the file by the path in the settings; empty if the scene is another one.
        """
        with self._lock:
            if self.path is None or self._pixels is None or not self._is_used(settings):
                return {}
            key, pixels, suffix = str(self.path), self._pixels, f"frame_{self._number}"
        if self._video is None:
            suffix = hashlib.sha256(pixels.tobytes()).hexdigest()[:DIGEST_LENGTH]
        file = Path(key).with_name(f"{Path(key).stem}_{suffix}.png")
        if not file.exists():
            write_picture(file, pixels)
        return {key: file}

    def with_file(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Return settings whose scene is a stored file of the current frame, or the same object."""
        for file in self.export(settings).values():
            settings = {**settings, "scene": {**settings["scene"], "picture": str(file)}}
        return settings


@handles(OpenVideo)
def _open_video(session: Session, message: OpenVideo) -> dict[str, Any]:
    path = Path(session.files.available(message.path))
    shown = session.frames.path if session.frames.open_video(path) else path
    return with_picture(session.history.settings, session.start.settings, str(shown))


@handles(ShowFrame)
def _show_frame(session: Session, message: ShowFrame) -> dict[str, Any] | None:
    settings = session.history.settings
    if message.follows:
        session.gaze.required_path(settings)  # an error leaves the frame
    session.frames.show(message.n)
    return session.gaze.at(settings, session.frames.time_s) if message.follows else None


@handles(CameraFrame)
def _receive_frame(session: Session, message: CameraFrame) -> dict[str, Any] | None:
    if not session.frames.receive(message.pixels, is_first=message.is_first) or not message.is_first:
        return None
    return with_picture(session.history.settings, session.start.settings, str(session.frames.path))
