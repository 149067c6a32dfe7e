"""Writing of videos: zarr stores of all codes, picture sequences, and video files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Limits
from foveasim._core.extras import import_optional
from foveasim._io.atomic import atomic_directory, atomic_write
from foveasim._io.images import write_picture
from foveasim._io.zarr_stores import ZARR
from foveasim.capture import Capture
from foveasim.errors import FileError, FoveasimWarning, ParameterError, warn
from foveasim.fields import Grid
from foveasim.layout import Layout
from foveasim.reconstruct import fill_channels, raster_grid
from foveasim.reconstruct.picture import raster_of
from foveasim.sensor.limits import DURATION
from foveasim.video.recording import check_consistent, count_recorded_frames, record, resume_recording

__all__ = ["write_video"]

VIDEO_EXTENSIONS = (".mp4", ".mkv", ".mov", ".webm")
#: Background grey where there are no photosites, as a fraction of white.
BACKGROUND_GREY = 0.12

#: Shortest time between the frames of a video file: rates are ratios of integers of 32 bits.
MIN_FILE_FRAME_S = 1e-6
#: Display time of frames without times.
DEFAULT_FRAME_S = 1.0 / 25.0
#: File of the times in directories of pictures.
TIMES_FILE = "frame_times.csv"
#: Units of time stamps per second: that of MPEG, and a finer one for steps below a millisecond.
TICKS_PER_S, FINE_TICKS_PER_S = 90_000, 10_000_000
#: Matrix of BT.601, limited range, and transfer and primaries of sRGB, in ITU-T H.273.
COLOURS = {"colorspace": 6, "color_range": 1, "color_trc": 13, "color_primaries": 1}


class Animation(NamedTuple):
    """
    Animated pictures of Pillow.

    ``unit_s``: unit of durations. ``shortest_s``: shortest duration that players show, most of which show shorter ones longer.
    """

    name: str
    unit_s: float
    shortest_s: float
    options: Mapping[str, Any]


ANIMATIONS = {
    ".gif": Animation("GIF", 0.01, 0.02, {}),
    ".webp": Animation("WebP", 0.001, 0.011, {"lossless": True}),
}


def write_video(
    captures: Iterable[Capture],
    path: str | Path,
    *,
    frame_s: Annotated[float | None, DURATION] = None,
    max_pixels: Annotated[int, Limits(at_least=2)] = 512,
    n_frames: int | None = None,
    progress: bool = False,
    resume: bool = False,
    plan: Mapping[str, Any] | None = None,
) -> int:
    """
    Write captures to a file or directory incrementally, atomically or resumably.

    Parameters
    ----------
    captures : iterable of Capture
        Captures of the same layout, as from :meth:`foveasim.Camera.video`.
    path : path
        The extension selects the format. ``.zarr``: a store of all codes, which :func:`read_recording` reads. ``.mp4``,
        ``.mkv``, ``.mov``, ``.webm`` (with the extra ``video``), ``.gif`` and ``.webp``: pictures for viewing. Without an
        extension: a directory of pictures ``frame_000000.png`` ..., and ``frame_times.csv`` if the captures have times.
    frame_s : float, optional, s
        Display time of a frame. By default the video plays at the speed of the simulation: each frame is shown at the time of
        its capture (the setting ``time_s``, see :meth:`foveasim.Camera.video`), also at irregular steps, and the last one as
        long as the one before it. Captures without times, and a single one, are shown for 1/25 s.
    max_pixels : int
        Length of the longer side of pictures.
    n_frames : int, optional
        Total number of frames, for the progress bar.
    progress : bool
        Whether to show a progress bar with the remaining time.
    resume : bool
        Whether an interrupted ``.zarr`` recording can be resumed. Frames are stored in :func:`partial_path` of the target until
        the last frame is written. If it contains frames, ``captures`` must begin after :func:`count_recorded_frames` of them.
    plan : mapping, optional
        Plain data that describe the recording, stored in the ``.zarr`` store. A recording with another plan is not resumed; for
        a finished recording with the same plan, ``captures`` is not iterated.

    Returns
    -------
    n_frames : int
        Number of frames in the target, including those of earlier calls.

    Raises
    ------
    FileError
        When the extension is unknown, a library is missing, the target cannot be written, or the path contains other data;
        with ``resume`` also when it is another recording or another process is writing it.
    ParameterError
        When there are no captures, captures do not continue the recorded frames, their times are not ascending, or a value is
        out of range.

    Warns
    -----
    FoveasimWarning
        When frames are shorter than a format or its players can show: 20 ms in GIF, 11 ms in WebP. They are shown for that
        time.

    Notes
    -----
    Memory contains one chunk of codes or one frame, for any length of the video; in WebP all pictures. The target is created or
    replaced after the last frame is written. In GIF and WebP, equal successive pictures are one.

    Times are rounded to the unit of the format without adding up: 10 ms in GIF, 1 ms in WebP, Matroska and WebM, 1/90,000
    s or finer in MP4. Colours are sRGB; video files specify their matrix, range, transfer and primaries.

    With ``resume``, no frame is lost after Ctrl-C, an error in a frame or a full disk; after a crash of the process, the frames
    of the last 10 seconds are lost. A resumed recording must be the same recording: frame numbers continue, and all settings
    equal those of the first frame, except settings that already differed between frames. A gaze path must be the same from the
    first missing frame to its end: of :func:`foveasim.video.shift_sensor`, :func:`foveasim.video.pan_camera`, or a list of
    frames with positions. Of other iterators the rest of the path is unknown.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> sensor = fs.Sensor.from_preset(
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), "machine_vision"
    ... )
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=300.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> captures = camera.video([scene] * 3, exposure_s=0.001, seed=0)
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     print(fs.video.write_video(captures, Path(directory, "wall.gif"), frame_s=0.1))
    3

    The same lines start a recording, resume it after an interruption, and do nothing when it is finished::

        n = count_recorded_frames("long.zarr")
        captures = camera.video(
            footage.from_frame(n), exposure_s=0.01, seed=0, first_frame=n
        )
        write_video(captures, "long.zarr", resume=True)

    With a moving gaze, the first frames are skipped::

        frames = itertools.islice(shift_sensor(scene, path), n, None)
    """
    target = Path(path)
    extension = target.suffix.lower()
    if extension != ZARR and (resume or plan is not None):
        raise ParameterError(
            "resume" if resume else "plan",
            f"is supported for .zarr stores only; {target.name} is written atomically",
        )
    if progress:
        from foveasim._io.terminal import with_progress

        captures = with_progress(captures, "frames", n_frames, count_recorded_frames(target) if resume else 0)
    if extension == ZARR:
        return (resume_recording if resume else record)(captures, target, plan)
    timed = _with_durations(captures, frame_s)
    if extension in ANIMATIONS:
        return _write_animation(timed, target, ANIMATIONS[extension], max_pixels)
    if extension in VIDEO_EXTENSIONS:
        return _write_video_file(timed, target, frame_s, max_pixels)
    if extension:
        raise FileError(
            target,
            f"must end in .zarr, {', '.join(ANIMATIONS)}, {', '.join(VIDEO_EXTENSIONS)}, or have no extension for a directory "
            "of pictures",
        )
    return _write_pictures(captures, target, max_pixels)


# -- pictures ---------------------------------------------------------------------------------------------------------


class _Raster:
    """Renderer of captures of one layout, with the overlaps of sites and pixels computed once."""

    def __init__(self, layout: Layout, max_pixels: int, *, has_even_size: bool = False) -> None:
        grid = raster_grid(layout, max_pixels)
        if has_even_size:  # chroma subsampling of video formats needs even sizes
            grid = Grid(tuple(n + n % 2 for n in grid.shape), grid.pitch_um, grid.origin_um)  # type: ignore[arg-type]
        self._layout, self._raster = layout, raster_of(layout, grid, "fill", None)

    def image(self, capture: Capture) -> NDArray[np.uint8]:
        """Return sRGB values and coverage, (n_y, n_x, 2 or 4), top row first."""
        values = capture.code.astype(np.float64)[np.newaxis]
        n_filters = len(capture.filter_names)
        if n_filters > 1:
            values = fill_channels(self._layout, values[0], capture.filter_of_site, n_filters)
            values = np.where(np.isnan(values), 0.0, values)
        colour = capture.colour_correction
        picture = replace(self._raster.means(values), colour_matrix=None if colour is None else colour.matrix)
        return np.asarray(picture.to_image(capture.white_dn), np.uint8)

    def composite(self, capture: Capture) -> NDArray[np.uint8]:
        """Return sRGB values over a dark grey background, (n_y, n_x, 3)."""
        image = self.image(capture).astype(np.float64)
        colours, cover = image[..., :-1], image[..., -1:] / 255.0
        colours = colours * cover + 255.0 * BACKGROUND_GREY * (1.0 - cover)
        return np.ascontiguousarray(np.broadcast_to(np.rint(colours), (*colours.shape[:2], 3)).astype(np.uint8))


class _Shown(NamedTuple):
    """A capture, when it is shown after the first one, and how long."""

    capture: Capture
    shown_s: float
    duration_s: float


def _with_durations(captures: Iterable[Capture], frame_s: float | None) -> Iterator[_Shown]:
    """Yield captures with the times at which they are shown."""
    shown_s, duration_s = 0.0, frame_s or DEFAULT_FRAME_S
    before: Capture | None = None
    for capture in check_consistent(captures):
        if before is not None:
            if frame_s is None:
                duration_s = _step_s(before, capture)
            yield _Shown(before, shown_s, duration_s)
            shown_s += duration_s
        before = capture
    if before is not None:
        yield _Shown(before, shown_s, duration_s)


def _step_s(before: Capture, after: Capture) -> float:
    """Return the time between two captures, that of videos without times if one has none."""
    begin_s, end_s = (capture.settings.get("time_s") for capture in (before, after))
    if begin_s is None and end_s is None:
        return DEFAULT_FRAME_S
    if begin_s is None or end_s is None:
        raise ParameterError("captures", "must all have times, or none of them; specify 'frame_s'")
    if end_s <= begin_s:
        raise ParameterError(
            "captures", f"must have ascending times, got {end_s:g} s after {begin_s:g} s", hint="specify 'frame_s'"
        )
    return float(end_s - begin_s)


def _write_pictures(captures: Iterable[Capture], target: Path, max_pixels: int) -> int:
    def is_pictures(directory: Path) -> bool:
        return directory.is_dir() and all(
            p.name == TIMES_FILE or (p.name.startswith("frame_") and p.suffix == ".png") for p in directory.iterdir()
        )

    times_s: list[float | None] = []
    with atomic_directory(target, is_ours=is_pictures) as directory:
        raster: _Raster | None = None
        for capture in check_consistent(captures):
            raster = raster or _Raster(capture.layout, max_pixels)
            write_picture(directory / f"frame_{len(times_s):06d}.png", raster.image(capture))
            times_s.append(capture.settings.get("time_s"))
        if None not in times_s:
            np.savetxt(directory / TIMES_FILE, np.array(times_s, np.float64), fmt="%.17g", header="t_s", comments="")
    return len(times_s)


def _write_animation(timed: Iterable[_Shown], target: Path, form: Animation, max_pixels: int) -> int:
    from PIL import Image

    durations_ms: list[int] = []
    shortest_s = math.inf
    with atomic_write(target) as temporary:

        def pictures() -> Iterator[Image.Image]:
            nonlocal shortest_s
            raster: _Raster | None = None
            shown = 0
            for capture, shown_s, duration_s in timed:
                raster = raster or _Raster(capture.layout, max_pixels)
                # The end is rounded, so that errors of durations do not add up.
                least = round(form.shortest_s / form.unit_s)
                units = max(least, round((shown_s + duration_s) / form.unit_s) - shown)
                shown += units
                shortest_s = min(shortest_s, duration_s)
                durations_ms.append(round(1000.0 * units * form.unit_s))
                picture = Image.fromarray(raster.composite(capture))
                if form.name == "GIF":
                    picture = picture.quantize(256)
                picture.info["duration"] = durations_ms[-1]
                yield picture

        all_pictures = pictures()
        first = next(all_pictures)
        if form.name == "GIF":  # requests one picture after the other, with its duration
            first.save(temporary, format="GIF", save_all=True, append_images=all_pictures, loop=0)
        else:
            rest = list(all_pictures)
            first.save(
                temporary,
                format=form.name,
                save_all=True,
                append_images=rest,
                duration=durations_ms,
                loop=0,
                **form.options,
            )
    if shortest_s < (1.0 - 1e-9) * form.shortest_s:
        warn(
            f"{target.name} shows frames of {shortest_s:g} s for {form.shortest_s:g} s, the shortest time in {form.name}; "
            "write .mp4, or specify 'frame_s'",
            FoveasimWarning,
        )
    return len(durations_ms)


def _frame_rate(frame_s: float) -> Fraction:
    """Return a frame rate in 1/s, as a ratio of small integers such as 30000/1001."""
    if frame_s < 1.0:
        return Fraction(1.0 / frame_s).limit_denominator(1001)
    return 1 / Fraction(frame_s).limit_denominator(1001)


def _write_video_file(timed: Iterable[_Shown], target: Path, frame_s: float | None, max_pixels: int) -> int:
    av = import_optional(target, "av")
    codec = "libvpx-vp9" if target.suffix.lower() == ".webm" else "libx264"
    n_frames = 0
    with atomic_write(target) as temporary:
        try:
            with av.open(str(temporary), mode="w") as container:
                raster: _Raster | None = None
                stream: Any = None
                for capture, shown_s, duration_s in timed:
                    _check_duration("captures" if frame_s is None else "frame_s", duration_s)
                    raster = raster or _Raster(capture.layout, max_pixels, has_even_size=True)
                    pixels = raster.composite(capture)
                    if stream is None:
                        rate = _frame_rate(duration_s)
                        unit_s = _time_unit(duration_s) if frame_s is None else 1 / rate
                        stream = container.add_stream(codec, rate=rate)
                        stream.height, stream.width = pixels.shape[:2]
                        stream.pix_fmt = "yuv420p"
                        stream.codec_context.time_base = unit_s
                        for name, number in COLOURS.items():
                            setattr(stream.codec_context, name, number)
                    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                    frame.pts = n_frames if frame_s is not None else round(shown_s / float(unit_s))
                    frame.time_base = unit_s
                    container.mux(stream.encode(frame))
                    n_frames += 1
                container.mux(stream.encode())
        except av.FFmpegError as error:
            raise FileError(target, f"cannot be written as a video file ({error})") from None
    return n_frames


def _check_duration(name: str, duration_s: float) -> None:
    """Reject frames that are too short for a video file; ``name``: their argument."""
    if duration_s < MIN_FILE_FRAME_S:
        rule = ">=" if name == "frame_s" else "apart by >="
        hint = "a .zarr store has any frame rate"
        raise ParameterError(name, f"must be {rule} {MIN_FILE_FRAME_S:g} in a video file", duration_s, "s", hint)


def _time_unit(duration_s: float) -> Fraction:
    """Return the unit of time stamps in s, for frames of a duration."""
    return Fraction(1, TICKS_PER_S if duration_s >= 1e-3 else FINE_TICKS_PER_S)
