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

from foveasim._core.calls import Limits
from foveasim._core.names import missing_path, possible_names
from foveasim._io.images import PICTURE_EXTENSIONS, picture_names
from foveasim._io.videos import VideoFile, frame_pixels
from foveasim.errors import FileError, ParameterError, type_name
from foveasim.scene import Scene
from foveasim.sensor.limits import DURATION

__all__ = ["FrameSource", "list_pictures"]

#: Placeholder wavelengths, which the spectra of the template replace.
GREY_NM, COLOUR_NM = (550.0,), (620.0, 550.0, 450.0)
#: Upper limit of frame indices.
MAX_FRAMES = 2**31
FRAMES = Limits(at_least=0, at_most=MAX_FRAMES)


class FrameSource:
    """
    Iterable of scenes from a sequence of pictures, read lazily.

    Parameters
    ----------
    source : path, or iterable of paths or arrays
        A directory of pictures, in the natural order of their names (``frame 2`` before ``frame 10``); a video file, with the
        extra ``video``; or pictures as :meth:`foveasim.Scene.from_picture` accepts them. If the source is an iterator, the
        frames can be iterated only once.
    start, stop, step : int
        Selection of frames, as in a slice.
    frame_s : float, optional, s
        Frame period; by default that of the video file.
    template : Scene, optional
        Scene that specifies pitch or framing, distance and spectra of the frames; the pictures replace its basis images.
        Colours are converted to grey for a template with one basis image, and grey to colour for a template with three.
    **scene
        Parameters of :meth:`foveasim.Scene.from_picture`: ``fit`` or ``pitch_um``, ``distance_m``,
        ``peak_radiance_w_m2_sr_nm``, and others; with ``template`` only ``encoding``.

    Raises
    ------
    FileError
        When the file is missing or a directory contains no pictures; during iteration when a frame is corrupt or of another
        size.
    ParameterError
        When a value is out of range, a parameter of the scene is missing or unknown, or there are no frames.

    Examples
    --------
    >>> import numpy as np
    >>> pictures = [np.full((4, 6), level) for level in (0.25, 0.5)]
    >>> footage = FrameSource(
    ...     pictures, pitch_um=10.0, distance_m=1.0, peak_radiance_w_m2_sr_nm=0.1, band_width_nm=10.0, encoding="linear"
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
        template: Scene | None = None,
        **scene: Any,
    ) -> None:
        if template is not None and template.basis.shape[0] not in (1, 3):
            raise ParameterError("template", f"must have 1 or 3 basis images, got {template.basis.shape[0]}")
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
        period_s: float | None = None
        if isinstance(source, str | Path):
            path = Path(source)
            if path.is_dir():
                self._source = list_pictures(path)
                self._n_source = len(self._source)
            elif path.is_file():
                self._source = VideoFile(path)
                self._n_source, period_s = self._source.n_frames, self._source.frame_s
            else:
                raise FileError(path, missing_path(path, "file or directory"))
        elif isinstance(source, Iterable):
            self._source = _SinglePass(source) if isinstance(source, Iterator) else source
            self._n_source = len(source) if isinstance(source, Sized) else None
        else:
            raise ParameterError("source", f"must be a path or an iterable of pictures, got {type_name(source)}")
        if frame_s is not None:
            period_s = frame_s
        self._frame_s = None if period_s is None else period_s * (self._step if frame_s is None else 1)
        self._may_be_empty = False
        # The frame count of video files is an estimate.
        if self._n_source is not None and not isinstance(self._source, VideoFile):
            self._check_not_empty(self.n_frames)

    def __repr__(self) -> str:
        return f"FrameSource({self.n_frames or 'unknown number of'} frames)"

    @property
    def frame_s(self) -> float | None:
        """Frame period in seconds; None if unknown."""
        return self._frame_s

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
        if isinstance(self._source, VideoFile):  # skipped frames are decoded but not converted to pixels
            pictures = map(partial(frame_pixels, self._source.path), pictures)
        for k, picture in enumerate(pictures):
            scene = (
                Scene.from_picture(picture, **self._scene) if self._template is None else self._from_template(picture)
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

    def _from_template(self, picture: Any) -> Scene:
        template = self._template
        assert template is not None
        n_basis = template.basis.shape[0]
        converted = Scene.from_picture(
            picture,
            distance_m=template.distance_m,
            peak_radiance_w_m2_sr_nm=1.0,
            # A single wavelength converts colours to grey. The template specifies the spectra.
            wavelength_nm=GREY_NM if n_basis == 1 else COLOUR_NM,
            band_width_nm=1.0,
            **self._scene,
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
