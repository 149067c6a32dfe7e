"""Frames of videos, with the positions of the sensor."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import finite_array
from foveasim.errors import ParameterError, type_name
from foveasim.fields import Grid, PowerMap
from foveasim.scene import Scene

__all__ = ["Frame", "ImageCache", "Position", "Task", "check_frames", "position_settings", "tasks"]

#: A position in the image plane, (x, y) in µm.
Position = tuple[float, float]
#: One frame: a scene or a power map, or either with the position of the sensor's centre in its image.
Frame = Scene | PowerMap | tuple[Scene | PowerMap, Sequence[float]]
#: Power maps behind each colour filter, on each grid.
ImageCache = dict[tuple[Grid, int], NDArray[Any]]


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
    for frame in frames:
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


def position_settings(position_um: Position) -> dict[str, Any]:
    """Return the sensor position as settings of a capture; nothing at the origin."""
    return {"place_um": list(position_um)} if any(position_um) else {}


def _split_frame(frame: Frame) -> tuple[Scene | PowerMap, Position]:
    """Return the source and the position of the sensor's centre in its image."""
    if not isinstance(frame, tuple):
        return frame, (0.0, 0.0)
    position_um = finite_array("frames", frame[1], ndim=1) if len(frame) == 2 else np.zeros(0)
    if position_um.size != 2:
        raise ParameterError("frames", "must be Scenes or PowerMaps, or pairs (light, (x_um, y_um))", frame)
    return frame[0], (float(position_um[0]), float(position_um[1]))
