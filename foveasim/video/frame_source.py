"""Frame sources: scenes from sequences of pictures in memory, directories and video files."""

from __future__ import annotations

import copy
import inspect
import os
from collections.abc import Iterable, Iterator, Sized
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import Limits, OwnCheck
from foveasim._core.names import missing_path, possible_names
from foveasim._core.validation import Floats, read_only
from foveasim._io.images import PICTURE_EXTENSIONS, picture_names
from foveasim._io.text_files import read_columns
from foveasim._io.videos import VideoFile, frame_pixels
from foveasim.errors import FileError, ParameterError, type_name
from foveasim.modes.frame_times import FrameTimes, check_times
from foveasim.scene import Scene
from foveasim.sensor.limits import DURATION

__all__ = ["FrameSource", "list_pictures"]

#: Placeholder wavelengths, which the spectra of the template replace.
GREY_NM, COLOUR_NM = (550.0,), (620.0, 550.0, 450.0)
#: Upper limit of frame indices.
MAX_FRAMES = 2**31
#: Column of files with the times of frames, and their size limit.
TIMES_COLUMNS, MAX_TIMES_BYTES = ("t_s",), 1 << 28
#: Rounding error of times at equal steps, as a fraction of the step.
STEP_TOLERANCE = 1e-6
FRAMES = Limits(at_least=0, at_most=MAX_FRAMES)


class FrameSource:
    """
    Iterable of scenes from a sequence of pictures, read lazily.

    Parameters
    ----------
    source : path, or iterable of paths or arrays
        A directory of pictures, in the natural order of their names (``frame 2`` before ``frame 10``); a video file, with the
        extra ``video``, or an animated WebP file; or pictures as :meth:`foveasim.Scene.from_picture` accepts them. If the
        source is an iterator, the frames can be iterated only once.
    start, stop, step : int
        Selection of frames, as in a slice.
    frame_s : float, optional, s
        Frame period; by default the frames of a video file have its time stamps.
    times_s : (n_frame,) float64, or path, optional, s
        Times of the frames (of the selected ones) in strictly ascending order, instead of ``frame_s``; or a CSV file with the
        column ``t_s``.
    template : Scene, optional
        Scene that specifies pitch or framing, distance and spectra of the frames; the pictures replace its basis images.
        Colours are converted to grey for a template with one basis image, and grey to colour for a template with three. A
        template with a display shows the frames on it.
    **scene
        Parameters of :meth:`foveasim.Scene.from_picture`: ``fit`` or ``pitch_um``, ``distance_m``,
        ``peak_radiance_w_m2_sr_nm``, and others; with ``template`` only ``encoding``.

    Raises
    ------
    FileError
        When the file is missing or a directory contains no pictures; during iteration when a frame is corrupt, of another
        size, or has a property that is not supported: interlaced frames, pixels that are not square, SMPTE ST 2084 (PQ), ...
    ParameterError
        When a value is out of range, a parameter of the scene is missing or unknown, or there are no frames.

    Notes
    -----
    Frames of video files keep the depth of the file, and are turned as its display matrix specifies. By default their colours
    are converted to sRGB by the matrix, range, transfer and primaries of the file: light is that of the scene, from which the
    camera encoded it (inverse OETF of BT.709, BT.601, BT.2020 and hybrid log-gamma, whose peak is 1). Without these values, the
    matrix is that of BT.601, as in FFmpeg and OpenCV, and the transfer that of pictures. With ``encoding``, transfer and
    primaries of the file are ignored. The times of frames are those of the file from its first selected frame on.

    Examples
    --------
    >>> import numpy as np
    >>> pictures = [np.full((4, 6), level) for level in (0.25, 0.5)]
    >>> footage = FrameSource(
    ...     pictures,
    ...     pitch_um=10.0,
    ...     distance_m=1.0,
    ...     peak_radiance_w_m2_sr_nm=0.1,
    ...     band_width_nm=10.0,
    ...     encoding="linear",
    ... )
    >>> [float(scene.basis.max()) for scene in footage]
    [0.25, 0.5]
    """

    def __init__(
        self,
        source: str | Path | Iterable[str | Path | ArrayLike],
        *,
        start: Annotated[int, FRAMES] = 0,
        stop: Annotated[int | None, FRAMES] = None,
        step: Annotated[int, Limits(at_least=1, at_most=MAX_FRAMES)] = 1,
        frame_s: Annotated[float | None, DURATION] = None,
        times_s: OwnCheck[str | Path | ArrayLike | None] = None,
        template: Scene | None = None,
        **scene: Any,
    ) -> None:
        if template is not None and template.display is None and template.basis.shape[0] not in (1, 3):
            raise ParameterError("template", f"must have 1 or 3 basis images, got {template.basis.shape[0]}")
        if template is not None and template.display is not None and scene:
            raise ParameterError(min(scene), "must not be given with a template that has a display")
        if template is not None and set(scene) - {"encoding"}:
            raise ParameterError(
                min(set(scene) - {"encoding"}), "must not be given with 'template', which specifies it"
            )
        if template is None:
            _check_settings(scene)
        self._template = template
        self._start, self._stop, self._step = start, stop, step
        self._scene = scene
        self._source: Iterable[Any]
        self._n_source: int | None = None
        self._n_skipped = 0
        if isinstance(source, str | Path):
            path = Path(source)
            if path.is_dir():
                self._source = list_pictures(path)
                self._n_source = len(self._source)
            elif path.is_file():
                self._source = VideoFile(path)
                self._n_source = self._source.n_frames
            else:
                raise FileError(path, missing_path(path, "file or directory"))
        elif isinstance(source, Iterable):
            self._source = _SinglePass(source) if isinstance(source, Iterator) else source
            self._n_source = len(source) if isinstance(source, Sized) else None
        else:
            raise ParameterError("source", f"must be a path or an iterable of pictures, got {type_name(source)}")
        given_s = read_times(times_s) if isinstance(times_s, str | Path) else times_s
        self._times = FrameTimes.of(frame_s, given_s)
        self._may_be_empty = False
        # The frame count of video files is an estimate.
        if self._n_source is not None and not isinstance(self._source, VideoFile):
            self._check_not_empty(self.n_frames)
            if self._times is not None and self.n_frames is not None:
                self._times.check_complete(self.n_frames)

    def __repr__(self) -> str:
        return f"FrameSource({self.n_frames or 'unknown number of'} frames)"

    @property
    def frame_s(self) -> float | None:
        """
        Frame period in seconds; None if it is unknown, or if the steps are not equal.

        Raises
        ------
        FileError
            When a video file is corrupt, or its frames have no time stamps.
        """
        if self._times is not None and self._times.frame_s is not None:
            return self._times.frame_s
        times_s = self._selected_times_s()
        return None if times_s is None else equal_step_s(times_s)

    @property
    def times_s(self) -> Floats | None:
        """
        Times of the frames, (n_frames,) float64 s; None if they are unknown.

        The first selected frame of a video file is at 0 s; those of :meth:`from_frame` keep their times. With ``frame_s``, None
        if the number of frames is unknown.

        Raises
        ------
        FileError
            When a video file is corrupt, or its frames have no time stamps.
        """
        if self._times is not None and self._times.frame_s is not None:
            n_frames = None if isinstance(self._source, VideoFile) else self.n_frames
            if not n_frames:
                return None
            return read_only(np.asarray((self._n_skipped + np.arange(n_frames)) * self._times.frame_s, np.float64))
        times_s = self._selected_times_s()
        if times_s is None or self._n_skipped >= times_s.size:
            return None
        return read_only(times_s[self._n_skipped :])

    def _selected_times_s(self) -> Floats | None:
        """Return given times or those of the file, also of frames before :meth:`from_frame`."""
        if self._times is not None:
            return self._times.times_s
        if not isinstance(self._source, VideoFile):
            return None
        first = self._start - self._n_skipped * self._step
        selected_s = self._source.times_s[first : self._stop : self._step]
        return np.asarray(selected_s - selected_s[0]) if selected_s.size else None

    @property
    def n_frames(self) -> int | None:
        """Number of frames; None if unknown before the last frame has been read."""
        if self._n_source is None:
            return None
        return len(
            range(self._start, min(self._n_source, self._n_source if self._stop is None else self._stop), self._step)
        )

    def from_frame(self, n: Annotated[int, FRAMES]) -> FrameSource:
        """
        Return a source without the first ``n`` frames, which are not converted to scenes.

        Parameters
        ----------
        n : int
            Number of frames to skip.

        Returns
        -------
        FrameSource

        Raises
        ------
        ParameterError
            When ``n`` is negative or not an integer.
        """
        source = copy.copy(self)
        source._start += n * self._step  # noqa: SLF001 -- same class
        source._n_skipped += n  # noqa: SLF001
        source._may_be_empty = True  # noqa: SLF001
        return source

    def _check_not_empty(self, n_frames: int | None) -> None:
        if n_frames == 0 and not self._may_be_empty:
            n_pictures = "an unknown number of" if self._n_source is None else f"{self._n_source:,}"
            upper_limit = "" if self._stop is None else f" and below {self._stop}"
            raise ParameterError(
                "source", f"must have a frame from {self._start}{upper_limit}, got {n_pictures} pictures"
            )

    def __iter__(self) -> Iterator[Scene]:
        """Iterate over the scenes."""
        shape: tuple[int, ...] | None = None
        pictures: Iterator[Any] = islice(iter(self._source), self._start, self._stop, self._step)
        settings = dict(self._scene)
        if isinstance(self._source, VideoFile):  # skipped frames are decoded but not converted to pixels
            is_srgb = settings.get("encoding", "auto") == "auto"
            settings |= {"encoding": "srgb"} if is_srgb else {}
            pictures = map(partial(frame_pixels, self._source.path, is_encoded=is_srgb), pictures)
        for k, picture in enumerate(pictures):
            scene = (
                Scene.from_picture(picture, **settings)
                if self._template is None
                else self._from_template(picture, self._template, settings)
            )
            if shape is not None and scene.basis.shape != shape:
                where = (
                    os.fspath(picture)
                    if isinstance(picture, str | os.PathLike)
                    else f"frame {self._start + k * self._step}"
                )
                raise FileError(
                    where,
                    f"has the shape {scene.basis.shape}, but previous frames have {shape}; use frames of equal shape",
                )
            shape = scene.basis.shape
            yield scene
        self._check_not_empty(0 if shape is None else None)

    @staticmethod
    def _from_template(picture: Any, template: Scene, settings: dict[str, Any]) -> Scene:
        if template.display is not None:
            return template.on_display(picture)
        n_basis = template.basis.shape[0]
        converted = Scene.from_picture(
            picture,
            distance_m=template.distance_m,
            peak_radiance_w_m2_sr_nm=1.0,
            # A single wavelength converts colours to grey. The template specifies the spectra.
            wavelength_nm=GREY_NM if n_basis == 1 else COLOUR_NM,
            band_width_nm=1.0,
            **settings,
        )
        basis = np.broadcast_to(converted.basis, (n_basis, *converted.basis.shape[1:]))
        # With a field of view, the pitch follows from the number of pixels of each frame.
        pitch_um = template.pitch_um if template.field_of_view_deg is None else None
        return replace(template, basis=basis, source=converted.source, pitch_um=pitch_um)


def list_pictures(directory: Path) -> list[Path]:
    """Return the paths of the pictures in a directory in natural order."""
    names = picture_names(path.name for path in directory.iterdir() if path.is_file())
    if not names:
        raise FileError(directory, f"contains no pictures ({', '.join(PICTURE_EXTENSIONS)})")
    return [directory / name for name in names]


def read_times(path: str | Path) -> Floats:
    """
    Read the times of frames from the column ``t_s`` of a CSV file, (n,) s.

    Raises FileError when the file cannot be read, or is not such a table with strictly ascending times.
    """
    path = Path(path)
    values = []
    for number, (cell,) in read_columns(path, "a table of times", TIMES_COLUMNS, MAX_TIMES_BYTES):
        try:
            values.append(float(cell))
        except ValueError:
            raise FileError(path, f"must have a number in line {number}, got {cell[:60]}") from None
    try:
        return check_times(TIMES_COLUMNS[0], values)
    except ParameterError as error:
        raise FileError(path, str(error)) from None


def equal_step_s(times_s: Floats) -> float | None:
    """Return the step of times at equal steps, None for others or a single one."""
    if times_s.size < 2:
        return None
    step_s = float(times_s[1] - times_s[0])
    is_equal = np.all(np.abs(times_s - times_s[0] - step_s * np.arange(times_s.size)) <= STEP_TOLERANCE * step_s)
    return step_s if is_equal else None


def _check_settings(scene: dict[str, Any]) -> None:
    """Reject unknown and missing parameters of Scene.from_picture before a picture is read."""
    parameters = list(inspect.signature(Scene.from_picture).parameters.values())[1:]
    names = [p.name for p in parameters]
    for name in scene:
        if name not in names:
            raise ParameterError(name, "must be a parameter of Scene.from_picture", hint=possible_names(name, names))
    for parameter in parameters:
        if parameter.default is parameter.empty and parameter.name not in scene:
            raise ParameterError(
                parameter.name, "is missing; Scene.from_picture requires it unless 'template' is given"
            )


class _SinglePass:
    """Items of an iterator, which can be iterated only once."""

    def __init__(self, pictures: Iterator[Any]) -> None:
        self._pictures: Iterator[Any] | None = pictures

    def __iter__(self) -> Iterator[Any]:
        if self._pictures is None:
            raise ParameterError(
                "source", "was an iterator and has been consumed by the first iteration", hint="pass a list of pictures"
            )
        pictures, self._pictures = self._pictures, None
        return pictures
