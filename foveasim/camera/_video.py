"""Captures of a sequence of frames: each exposed alone, or by a shutter."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.random_streams import Streams
from foveasim._core.threads import in_order
from foveasim._core.validation import Floats, read_only
from foveasim.camera._clock import Clock
from foveasim.camera._exposure import AUTO_SETTINGS, ExposureTime, exposure_time
from foveasim.camera._frames import Frame, PathPosition, Task, carried_times, check_frames, position_settings, tasks
from foveasim.camera._rates import expected_rates
from foveasim.camera._steps import capture_for_time, capture_rates, check_exposure, seconds_of
from foveasim.capture import Capture
from foveasim.errors import FileError, FoveasimWarning, ParameterError, warn
from foveasim.layout.rows import Scan
from foveasim.modes import Between, Exposure, Shutter
from foveasim.modes.frame_times import FrameTimes
from foveasim.sensor.limits import EXPOSURE

if TYPE_CHECKING:
    from foveasim.camera._camera import Camera

#: Relative excess of an exposure over the time between exposures that counts as rounding.
TIME_ROUNDING = 1e-9


def video(
    camera: Camera,
    frames: Iterable[Frame],
    exposure_s: ExposureTime | Sequence[float],
    streams: Streams,
    frame_s: float | None,
    *,
    line_s: float,
    every: int,
    between: Between,
    scan: Scan | None,
    ahead: int,
    times_s: ArrayLike | None,
) -> Iterator[Capture]:
    """Yield captures of frames; see :meth:`foveasim.Camera.video`."""
    if isinstance(exposure_s, str):
        exposures: Sequence[ExposureTime] = [exposure_time(exposure_s, camera.optics.f_number)]
    else:
        exposures_s = EXPOSURE.check_array("exposure_s", exposure_s)
        if exposures_s.ndim > 1 or exposures_s.size == 0:
            raise ParameterError("exposure_s", "must be one time, or a sequence of times", exposure_s, "s")
        exposures = exposures_s.reshape(-1).tolist()
    check_frames(frames)
    if scan is not None and not line_s:
        raise ParameterError("scan", "requires 'line_s', the line time of a rolling shutter", scan)
    times = FrameTimes.of(frame_s, times_s, frames=frames)
    is_integrated = times is not None or bool(line_s) or between != "hold" or every != 1
    if times is None:
        times = _carried_times(frames, is_required=is_integrated)
    if not is_integrated:
        return _separate(camera, frames, exposures, streams, times, ahead)
    if times is None:
        name = "line_s" if line_s else "between" if between != "hold" else "every"
        raise ParameterError(name, "requires 'frame_s', the frame period, or 'times_s', the times of the frames")
    shutter = Shutter(camera.layout, times.frame_s, line_s, between, scan, times.times_s)
    longest_s = max((time_s for time_s in exposures if isinstance(time_s, float)), default=0.0)
    shortest_s = times.shortest_s(every)
    if longest_s > (1.0 + TIME_ROUNDING) * shortest_s:
        warn(
            f"the exposure of {longest_s:g} s is longer than the {shortest_s:g} s between the starts "
            "of exposures, and no photosite can be exposed twice at a time; reduce 'exposure_s' or increase 'every'",
            FoveasimWarning,
        )
    return _rolling(camera, frames, exposures, streams, shutter, every, ahead)


def _carried_times(frames: Iterable[Frame], *, is_required: bool) -> FrameTimes | None:
    """
    Return the times that frames carry.

    Raises FileError for a video file without time stamps, if the times are required.
    """
    try:
        return carried_times(frames)
    except FileError:
        if is_required:
            raise
        return None


def _separate(
    camera: Camera,
    frames: Iterable[Frame],
    exposures: Sequence[ExposureTime],
    streams: Streams,
    times: FrameTimes | None,
    ahead: int,
) -> Iterator[Capture]:
    """Yield one capture per frame, each exposed to this frame alone."""
    clock = Clock()
    for k, (task, rate_e_per_s) in enumerate(rates_of_frames(camera, frames, clock, ahead)):
        frame_streams = Streams(streams.seed, streams.frame + k)
        exposure_s = exposures[frame_streams.frame % len(exposures)]
        settings = _time_settings(times, k, streams.frame, task) | position_settings(task)
        capture = capture_for_time(
            camera, task.light, rate_e_per_s, exposure_s, frame_streams, clock.take(), **settings
        )
        check_exposure(camera, task.light, rate_e_per_s, capture)
        yield capture


def _time_settings(times: FrameTimes | None, number: int, first: int, task: Task) -> dict[str, float]:
    """Return the time of a frame as a setting of its capture; empty if it is unknown."""
    if times is not None:
        # Frames at equal steps continue those before the first one.
        times.check_number(number)
        return {"time_s": times.at_s(number + (first if times.times_s is None else 0))}
    time_s = task.position_um.time_s if isinstance(task.position_um, PathPosition) else None
    return {} if time_s is None else {"time_s": time_s}


def _rolling(
    camera: Camera,
    frames: Iterable[Frame],
    exposures: Sequence[ExposureTime],
    streams: Streams,
    shutter: Shutter,
    every: int,
    ahead: int,
) -> Iterator[Capture]:
    """Yield one capture per ``every`` frames, each a sum over its exposure."""
    auto, times = AUTO_SETTINGS if "auto" in exposures else {}, shutter.times
    common = {
        **({} if shutter.frame_s is None else {"frame_s": shutter.frame_s}),
        "line_s": shutter.line_s,
        "every": every,
        "between": shutter.between,
        "scan": shutter.scan,
        **auto,
    }
    # Frames at equal steps continue those before the first one.
    first = streams.frame * every if shutter.times_s is None else 0
    in_progress: deque[tuple[int, Task, Exposure]] = deque()
    clock = Clock()

    def finish_oldest(last_e_per_s: Floats) -> Capture:
        k, task, exposure = in_progress.popleft()
        frame_streams = Streams(streams.seed, streams.frame + k)
        mean_e_per_s = exposure.mean_e_per_s(last_e_per_s)
        settings = common | {"time_s": times.at_s(first + k * every)} | position_settings(task, every)
        arguments = task.light, mean_e_per_s, exposure.exposure_s, frame_streams, clock.take()
        return capture_rates(camera, camera.sensor, *arguments, **settings)

    rate_e_per_s, n_frames = np.zeros(1), 0
    for n, (task, rate_e_per_s) in enumerate(rates_of_frames(camera, frames, clock, ahead)):
        times.check_number(n)
        if n % every == 0:
            k = n // every
            exposure_s = seconds_of(camera, exposures[(streams.frame + k) % len(exposures)], rate_e_per_s)
            in_progress.append((k, task, Exposure(shutter, exposure_s, n)))
        n_frames = n + 1
        with clock.stage("shutter"):
            for *_, exposure in in_progress:
                exposure.add(rate_e_per_s)
        while in_progress and in_progress[0][-1].is_complete:
            yield finish_oldest(rate_e_per_s)
    while in_progress:
        yield finish_oldest(rate_e_per_s)
    times.check_complete(n_frames)


def rates_of_frames(camera: Camera, frames: Iterable[Frame], clock: Clock, ahead: int) -> Iterator[tuple[Task, Floats]]:
    """Yield each frame with its photoelectron rates; repeated frames share the array."""
    of_one_frame = camera.replace(n_threads=1) if ahead else camera
    image_lock = Lock()
    warned: set[str] = set()

    def compute(task: Task) -> tuple[Task, Floats | None, Clock]:
        task_clock = Clock()
        if task.is_repeated:
            return task, None, task_clock
        # The first frame of a scene computes the images that its next frames share.
        with image_lock if task.images == {} and camera.axis == "image" else nullcontext():
            gaze_um = task.position_um if task.is_moving else None
            return task, expected_rates(of_one_frame, task.light, task_clock, gaze_um, task.images, warned), task_clock

    rate_e_per_s = np.zeros(camera.layout.n_sites)
    for task, found, task_clock in in_order(compute, tasks(frames), camera.n_threads, ahead):
        rate_e_per_s = rate_e_per_s if found is None else read_only(found)
        clock.add(task_clock)
        yield task, rate_e_per_s
