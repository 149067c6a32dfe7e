"""Frames of videos, with the positions of the sensor."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from hashlib import blake2b
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError, type_name
from foveasim.fields import Grid, PowerMap
from foveasim.modes.frame_times import FrameTimes
from foveasim.scene import Scene

#: A position in the image plane, (x, y) in µm.
Position = tuple[float, float]
#: One frame: a scene or a power map, or either with the position of the sensor's centre in its image.
Frame = Scene | PowerMap | tuple[Scene | PowerMap, Sequence[float]]
#: Power maps behind each colour filter, on each grid.
ImageCache = dict[tuple[Grid, int], NDArray[Any]]


T = TypeVar("T")

#: Length of the digest of a path.
DIGEST_BYTES = 16


class PathPosition(tuple[float, float]):  # noqa: SLOT001 -- tuples have no slots with values
    """
    Sensor position (x, y) in µm that belongs to a gaze path.

    Attributes
    ----------
    gaze_um : (x, y), µm
        Point of the path.
    digests : sequence of bytes
        For every point, digest of the path from it to the end; the last is that of no point.
    number : int
        Number of the point.
    time_s : float or None, s
        Time of the point, if the path has times.
    """

    gaze_um: Position
    digests: Sequence[bytes]
    number: int
    time_s: float | None

    def __new__(
        cls,
        position_um: Position,
        gaze_um: Position = (0.0, 0.0),
        digests: Sequence[bytes] = (),
        number: int = 0,
        time_s: float | None = None,
    ) -> Self:
        """Create the position of a point; pickles set the attributes afterwards."""
        new = super().__new__(cls, position_um)
        new.gaze_um, new.digests, new.number, new.time_s = gaze_um, digests, number, time_s
        return new


class TimedFrames(Iterator[T]):
    """Frames with positions, and their times, which :meth:`foveasim.Camera.video` uses."""

    def __init__(self, frames: Iterable[T], times: FrameTimes) -> None:
        self._frames, self._times, self._n_read = iter(frames), times, 0

    def __next__(self) -> T:
        found = next(self._frames)
        self._n_read += 1
        return found

    @property
    def times_s(self) -> Floats | None:
        """Times of the frames to come, (n,) s; None at equal steps, or if there are none."""
        times_s = self._times.times_s
        return None if times_s is None or self._n_read >= times_s.size else times_s[self._n_read :]

    @property
    def frame_s(self) -> float | None:
        """Frame period in s; None for other times."""
        return self._times.frame_s


def carried_times(frames: object) -> FrameTimes | None:
    """
    Return the times that frames carry, as ``times_s`` or ``frame_s``; None without them.

    Raises FileError for a video file without time stamps.
    """
    times_s, frame_s = getattr(frames, "times_s", None), getattr(frames, "frame_s", None)
    return FrameTimes.of(None if times_s is not None else frame_s, times_s)


def path_digests(gaze_um: Floats) -> list[bytes]:
    """
    Return n + 1 digests of a path, (n, 2) µm: from each point to its end, and of no point.

    They identify the rest of a path, also when its beginning is skipped.
    """
    digests = [bytes(DIGEST_BYTES)]
    for x_um, y_um in gaze_um[::-1].tolist():
        point = struct.pack("<dd", x_um + 0.0, y_um + 0.0)  # + 0.0 removes the sign of zero
        digests.append(blake2b(point + digests[-1], digest_size=DIGEST_BYTES).digest())
    digests.reverse()
    return digests


def path_positions(gaze_um: Floats, times_s: Floats | None = None) -> Iterator[PathPosition]:
    """Yield the points of a path, (n, 2) µm, at times (n,) s, as sensor positions."""
    digests = path_digests(gaze_um)
    for k, (x_um, y_um) in enumerate(gaze_um.tolist()):
        time_s = None if times_s is None else float(times_s[k])
        yield PathPosition((x_um, y_um), (x_um, y_um), digests, k, time_s)


class Task(NamedTuple):
    """One frame of a video, with the cache of its images."""

    light: Scene | PowerMap
    position_um: Position
    images: ImageCache | None
    is_repeated: bool
    is_moving: bool


def tasks(frames: Iterable[Frame]) -> Iterator[Task]:
    """Yield the frames as tasks; frames of one scene with positions share their images."""
    before: Task | None = None
    for frame in _with_path(frames):
        light, position_um = _split_frame(frame)
        is_same = before is not None and light is before.light
        images: ImageCache | None = None
        if isinstance(frame, tuple) and isinstance(light, Scene):
            is_cached = before is not None and is_same and before.images is not None
            images = before.images if before is not None and is_cached else {}
        is_repeated = before is not None and is_same and position_um == before.position_um
        before = Task(light, position_um, images, is_repeated, isinstance(frame, tuple))
        yield before


def check_frames(frames: object) -> None:
    if not isinstance(frames, Iterable):
        hint = "put a single one into a list" if isinstance(frames, Scene | PowerMap) else ""
        raise ParameterError(
            "frames", f"must be an iterable of Scenes or PowerMaps, got {type_name(frames)}", hint=hint
        )


def position_settings(task: Task, every: int = 1) -> dict[str, Any]:
    """
    Return the gaze of a frame as settings of a capture.

    ``every`` is the number of frames per capture: the digest of the rest of the path begins at the next capture. Frames without
    positions have none of these settings. ``place_um`` is the position of the sensor where it is not the gaze, in a part of a
    larger scene.
    """
    if not task.is_moving:
        return {}
    position_um = task.position_um
    if not isinstance(position_um, PathPosition):
        return {"gaze_um": list(position_um)}
    ahead = min(position_um.number + every, len(position_um.digests) - 1)
    settings: dict[str, Any] = {
        "gaze_um": list(position_um.gaze_um),
        "gaze_path": position_um.digests[position_um.number].hex(),
        "next_gaze_path": position_um.digests[ahead].hex(),
    }
    return settings if position_um == position_um.gaze_um else settings | {"place_um": list(position_um)}


def _with_path(frames: Iterable[Frame]) -> Iterable[Frame]:
    """Return frames with a path, if all are in memory: their positions are known in advance."""
    if not isinstance(frames, list | tuple):  # other sequences may read each frame on access
        return frames
    if not all(isinstance(frame, tuple) and len(frame) == 2 for frame in frames):
        return frames
    if any(isinstance(position_um, PathPosition) for _, position_um in frames):
        return frames
    try:
        positions_um = np.array([position_um for _, position_um in frames], np.float64).reshape(len(frames), 2)
    except (TypeError, ValueError):  # reported with the frame
        return frames
    along = path_positions(positions_um)
    return [(light, position_um) for (light, _), position_um in zip(frames, along, strict=True)]


def _split_frame(frame: Frame) -> tuple[Scene | PowerMap, Position]:
    """Return the source and the position of the sensor's centre in its image."""
    if not isinstance(frame, tuple):
        return frame, (0.0, 0.0)
    position_um = finite_array("frames", frame[1], ndim=1) if len(frame) == 2 else np.zeros(0)
    if position_um.size != 2:
        raise ParameterError("frames", "must be Scenes or PowerMaps, or pairs (light, (x_um, y_um))", frame)
    found = float(position_um[0]), float(position_um[1])
    given = frame[1]
    if isinstance(given, PathPosition):
        return frame[0], PathPosition(found, given.gaze_um, given.digests, given.number, given.time_s)
    return frame[0], found
