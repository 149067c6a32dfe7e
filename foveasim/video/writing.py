"""Writing of videos: zarr stores of all codes, picture sequences, and video files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Limits
from foveasim._core.extras import import_optional
from foveasim._io.atomic import atomic_directory, atomic_write
from foveasim._io.images import write_picture
from foveasim._io.zarr_stores import ZARR
from foveasim.capture import Capture
from foveasim.errors import FileError, ParameterError
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


def write_video(
    captures: Iterable[Capture],
    path: str | Path,
    *,
    frame_s: Annotated[float, DURATION] = 1.0 / 25.0,
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
        ``.mkv``, ``.mov``, ``.webm`` (with the extra ``video``) and ``.gif``: pictures for viewing. Without an extension: a
        directory of pictures ``frame_000000.png`` ...
    frame_s : float, s
        Display time of a frame.
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
        When there are no captures, captures do not continue the recorded frames, or a value is out of range.

    Notes
    -----
    Memory contains one chunk of codes or one frame, for any length of the video. The target is created or replaced after the
    last frame is written.

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
    >>> sensor = fs.Sensor.from_preset(fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), "machine_vision")
    >>> camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    >>> scene = fs.Scene.flat(shape=(64, 64), pitch_um=300.0, distance_m=1.0, illuminance_lux=500.0)
    >>> captures = camera.video([scene] * 3, exposure_s=0.001, seed=0)
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     print(fs.video.write_video(captures, Path(directory, "wall.gif"), frame_s=0.1))
    3

    The same lines start a recording, resume it after an interruption, and do nothing when it is finished::

        n = count_recorded_frames("long.zarr")
        captures = camera.video(footage.from_frame(n), exposure_s=0.01, seed=0, first_frame=n)
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
    if extension == ".gif":
        return _write_gif(captures, target, frame_s, max_pixels)
    if extension in VIDEO_EXTENSIONS:
        return _write_video_file(captures, target, frame_s, max_pixels)
    if extension:
        raise FileError(
            target,
            f"must end in .zarr, .gif, {', '.join(VIDEO_EXTENSIONS)}, or have no extension for a directory of pictures",
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


def _write_pictures(captures: Iterable[Capture], target: Path, max_pixels: int) -> int:
    def is_pictures(directory: Path) -> bool:
        return directory.is_dir() and all(
            p.name.startswith("frame_") and p.suffix == ".png" for p in directory.iterdir()
        )

    n_frames = 0
    with atomic_directory(target, is_ours=is_pictures) as directory:
        raster: _Raster | None = None
        for capture in check_consistent(captures):
            raster = raster or _Raster(capture.layout, max_pixels)
            write_picture(directory / f"frame_{n_frames:06d}.png", raster.image(capture))
            n_frames += 1
    return n_frames


def _write_gif(captures: Iterable[Capture], target: Path, frame_s: float, max_pixels: int) -> int:
    from PIL import Image

    n_frames = 0

    def pictures() -> Iterator[Image.Image]:
        nonlocal n_frames
        raster: _Raster | None = None
        for capture in check_consistent(captures):
            raster = raster or _Raster(capture.layout, max_pixels)
            n_frames += 1
            yield Image.fromarray(raster.composite(capture)).quantize(256)

    with atomic_write(target) as temporary:
        all_pictures = pictures()
        first = next(all_pictures)
        first.save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=all_pictures,
            duration=max(20, round(1000.0 * frame_s)),
            loop=0,
        )
    return n_frames


def _frame_rate(frame_s: float) -> Fraction:
    """Return a frame rate in 1/s, as a ratio of small integers such as 30000/1001."""
    if frame_s < 1.0:
        return Fraction(1.0 / frame_s).limit_denominator(1001)
    return 1 / Fraction(frame_s).limit_denominator(1001)


def _write_video_file(captures: Iterable[Capture], target: Path, frame_s: float, max_pixels: int) -> int:
    av = import_optional(target, "av")
    if frame_s < MIN_FILE_FRAME_S:
        hint = "a .zarr store has any frame rate"
        raise ParameterError("frame_s", f"must be >= {MIN_FILE_FRAME_S:g} in a video file", frame_s, "s", hint)
    codec = "libvpx-vp9" if target.suffix.lower() == ".webm" else "libx264"
    n_frames = 0
    with atomic_write(target) as temporary:
        try:
            with av.open(str(temporary), mode="w") as container:
                raster: _Raster | None = None
                stream: Any = None
                for capture in check_consistent(captures):
                    raster = raster or _Raster(capture.layout, max_pixels, has_even_size=True)
                    pixels = raster.composite(capture)
                    if stream is None:
                        stream = container.add_stream(codec, rate=_frame_rate(frame_s))
                        stream.height, stream.width = pixels.shape[:2]
                        stream.pix_fmt = "yuv420p"
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
                    n_frames += 1
                container.mux(stream.encode())
        except av.FFmpegError as error:
            raise FileError(target, f"cannot be written as a video file ({error})") from None
    return n_frames
